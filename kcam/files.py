"""Modules in files: weights as safetensors, and a configuration in JSON that a person can read. Nothing is pickled.

The configuration lives in the safetensors metadata. It names each module's class and its constructor arguments, which
every kcam module stores as attributes of the same name, or gives by a method ``configuration()``; ``cls(**arguments)``
rebuilds it. Tensors stand in the file under their module path, as in ``state_dict()``. Only classes that the reader's
table lists are ever built, and those of torch's layers that `kcam.layers` lists.

    {"class": "sensor.ReadNoise", "arguments": {"sigma_electrons": 3.0, "full_well": null}}

Numbers, strings, true, false and null are themselves; an infinite float is {"float": "inf"}; an array is a tuple; a
tensor is {"tensor": key, "shape": ...}, a parameter {"parameter": key, "shape": ..., "trainable": ...}; a module that
occurs again is {"same": path}. A layer of torch's also names its "tensors", and says "training": false where it is.
"""

from __future__ import annotations

import builtins
import inspect
import json
import math
import os
import secrets
import sys
import types
import typing
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NotRequired, TypedDict

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_bytes
from torch import Tensor, nn

from kcam import layers
from kcam.context import Context
from kcam.plain import fitting, from_json

FORMAT = 1
"""Version of the file format: raised when an older kcam could no longer read what a newer one writes."""
FIX = "Save the camera again."


class _Version(TypedDict):
    format: int
    kcam: str


class _Document(_Version):
    configuration: Any
    aliases: dict[str, str]
    state: list[str]


class _Float(TypedDict):
    float: Literal["inf", "-inf", "nan"]


class _Same(TypedDict):
    same: str


class _Held(TypedDict):
    tensor: str
    shape: tuple[int, ...]


class _Trained(TypedDict):
    parameter: str
    shape: tuple[int, ...]
    trainable: bool


_Built = TypedDict(
    "_Built",
    {
        "class": str,
        "arguments": dict[str, Any],
        "tensors": NotRequired[dict[str, Any]],
        "training": NotRequired[bool],
    },
)
NODES = {"float": _Float, "same": _Same, "tensor": _Held, "parameter": _Trained, "class": _Built}
"""What a dict in a configuration is, by the key that it has."""


def save(module: nn.Module, path: str | os.PathLike[str], *, classes: Mapping[str, type], version: str) -> None:
    """Write a module's weights and configuration, so that `path` always holds either the old file or the whole new one.

    Args:      module: built from the argument types named above.
               path: the file; replaced if it exists.
               classes: name in the file -> class. A class that is not listed is written under its own name, and the
               reader must hand it in.
               version: of kcam, for the reader's information.
    Raises:    TypeError for an argument that cannot be written or that its class does not keep;
               ValueError for a name that does not end in .safetensors, or is a folder's, and for a layer of torch's
               that is not among `kcam.layers.NAMES`, was changed after it was made, or is subclassed without a
               constructor of its own;
               FileNotFoundError if the folder does not exist.

    Example:
    >>> from kcam import files
    >>> known = {"sensor.ReadNoise": sensor.ReadNoise}
    >>> files.save(sensor.ReadNoise(3.0), "noise.safetensors", classes=known, version=kcam.__version__)
    >>> files.load("noise.safetensors", classes=known).sigma_electrons
    3.0
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        better = f"{path.stem.removesuffix('.safetensors')}.safetensors"
        raise ValueError(f"cannot save {path.name}: its name must end in .safetensors. Use {better}.")
    if path.is_dir():
        raise ValueError(f"cannot save {path.name}: there is a folder of that name. Choose another name.")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot save {path.name}: there is no folder {path.parent}.")
    writer = _Writer({cls: name for name, cls in classes.items()})
    configuration = writer.encode(module, path="", owner="")
    state = module.state_dict(keep_vars=True)
    aliases = {key: writer.add(tensor, key) for key, tensor in state.items()}
    document = {
        "format": FORMAT,
        "kcam": version,
        "configuration": configuration,
        "aliases": {key: stored for key, stored in aliases.items() if key != stored},
        "state": list(aliases),
    }
    tensors = {key: tensor.detach().cpu().clone().contiguous() for key, tensor in writer.tensors.items()}
    replace(path, to_bytes(tensors, metadata={"kcam": json.dumps(document, indent=1)}))


def load(path: str | os.PathLike[str], *, classes: Mapping[str, type]) -> Any:
    """Rebuild the module that `save` wrote, on the CPU; the global random state stays as it was.

    Args:      path: the file.
               classes: name in the file -> class; nothing else is ever built.
    Raises:    FileNotFoundError; ValueError for a file that is damaged, from elsewhere, from a newer kcam, with a class
               that `classes` lacks, or with a tensor that is missing or has another shape.

    Example:
    >>> from kcam import files
    >>> noise = sensor.ReadNoise(torch.nn.Parameter(torch.tensor(3.0)))
    >>> files.save(noise, "noise.safetensors", classes={"noise": sensor.ReadNoise}, version=kcam.__version__)
    >>> files.load("noise.safetensors", classes={"noise": sensor.ReadNoise}).sigma_electrons
    Parameter containing:
    tensor(3., requires_grad=True)
    """
    document, tensors = _read(Path(path))
    reader = _Reader(layers.LAYERS | dict(classes), tensors, path)
    try:
        with torch.random.fork_rng(devices=[]):
            module = reader.decode(document["configuration"], path="")
    except RecursionError:
        raise reader.damaged("its configuration is nested too deeply") from None
    if not isinstance(module, nn.Module):
        raise reader.damaged(f"it holds a {type(module).__name__}, expected a module")
    aliases = document["aliases"]
    state = {key: reader.tensor(aliases.get(key, key)) for key in document["state"]}
    try:
        module.load_state_dict(state)
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{path}: the weights do not fit the configuration: {reason}") from error
    return module


def describe(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The configuration in a saved file, as plain values: what was saved, without building it. Raises: as `load`.

    Example:
    >>> from kcam import files
    >>> Camera(sensor.ReadNoise(3.0), sensor.ADC(bits=10)).save("camera.safetensors")
    >>> files.describe("camera.safetensors")["configuration"]["arguments"]["stages"][0]
    {'class': 'sensor.ReadNoise', 'arguments': {'sigma_electrons': 3.0, 'full_well': None}}
    """
    return _read(Path(path))[0]


class _Writer:
    """Turns modules into plain values, and collects their tensors."""

    def __init__(self, names: dict[type, str]) -> None:
        self.names = names
        self.tensors: dict[str, Tensor] = {}
        self.seen: dict[int, str] = {}  # id of a tensor or module -> where it stands in the file
        self.alive: list[Any] = []  # an id is only good while its object lives

    def add(self, tensor: Tensor, key: str) -> str:
        """Note a tensor; returns the key under which it is stored, which is another one if it is shared."""
        stored = self.seen.setdefault(id(tensor), key)
        self.tensors.setdefault(stored, tensor)
        self.alive.append(tensor)
        return stored

    def encode(self, value: Any, *, path: str, owner: str) -> Any:
        if value is None or isinstance(value, (bool, int, str)):
            return value
        if isinstance(value, float):
            return value if math.isfinite(value) else {"float": str(value)}
        if isinstance(value, (tuple, list)):
            return [self.encode(item, path=_join(path, index), owner=owner) for index, item in enumerate(value)]
        if isinstance(value, nn.Parameter):
            key = self.add(value, path)
            return {"parameter": key, "shape": list(value.shape), "trainable": value.requires_grad}
        if isinstance(value, Tensor):
            return {"tensor": self.add(value, path), "shape": list(value.shape)}
        if isinstance(value, (nn.Module, Context)) or type(value) in self.names:
            return self.encode_object(value, path=path)
        raise TypeError(
            f"cannot save {owner}: a {type(value).__name__} is none of number, string, bool, None, tuple, tensor, "
            "module. Store what it was made from instead."
        )

    def encode_object(self, value: Any, *, path: str) -> Any:
        if id(value) in self.seen:
            return {"same": self.seen[id(value)]}
        self.seen[id(value)] = path
        self.alive.append(value)
        cls = type(value)
        layer = layers.is_layer(value)
        given = layers.arguments(value) if layer else _arguments(value)
        node: dict[str, Any] = {"class": self.names.get(cls, f"torch.nn.{cls.__name__}" if layer else cls.__qualname__)}
        for part, members in (("arguments", given), ("tensors", layers.tensors(value) if layer else {})):
            node[part] = {
                name: self.encode(member, path=_join(path, name), owner=f"{cls.__qualname__}({name}=)")
                for name, member in members.items()
            }
        if not node["tensors"]:
            del node["tensors"]
        return node | ({"training": False} if layer and not value.training else {})


class _Reader:
    """Turns plain values and tensors back into modules."""

    def __init__(self, classes: Mapping[str, type], tensors: dict[str, Tensor], file: Any) -> None:
        self.classes = classes
        self.tensors = tensors
        self.file = file
        self.built: dict[str, Any] = {}  # path or key -> what stands there, so that what was shared stays shared

    def damaged(self, reason: str) -> ValueError:
        return ValueError(f"{self.file}: {reason}: the file is damaged. {FIX}")

    def tensor(self, key: str) -> Tensor:
        if key not in self.tensors:
            raise ValueError(f"{self.file} lacks the tensor {key!r}: the file is damaged. {FIX}")
        return self.tensors[key]

    def decode(self, value: Any, *, path: str) -> Any:
        if isinstance(value, list):
            return tuple(self.decode(item, path=_join(path, index)) for index, item in enumerate(value))
        if not isinstance(value, dict):
            return value
        kind = next((key for key in NODES if key in value), None)
        if kind is None:
            raise self.damaged(f"what {path or 'it'} is, is none of {', '.join(NODES)}")
        try:
            node = fitting(value, NODES[kind], path)
        except ValueError as error:
            raise self.damaged(f"{error}") from None
        match kind:
            case "float":
                return float(node["float"])
            case "same" if node["same"] not in self.built:
                raise self.damaged(f"{path} is the same as {node['same']!r}, which comes before it nowhere")
            case "same":
                return self.built[node["same"]]
            case "class":
                self.built[path] = self.build(node, path=path)
                return self.built[path]
        key: str = node[kind]
        tensor = self.tensor(key)
        if tuple(tensor.shape) != node["shape"]:
            raise ValueError(
                f"{self.file}: the tensor {key!r} has shape {tuple(tensor.shape)}, but the configuration says "
                f"{node['shape']}: the file is damaged. {FIX}"
            )
        if kind == "tensor":
            return tensor
        if not isinstance(self.built.get(key), nn.Parameter):
            if node["trainable"] and not (tensor.is_floating_point() or tensor.is_complex()):
                raise self.damaged(f"the parameter {key!r} is of {tensor.dtype}, which cannot be trained")
            self.built[key] = nn.Parameter(tensor, requires_grad=node["trainable"])
        return self.built[key]

    def build(self, node: dict[str, Any], *, path: str) -> Any:
        name = node["class"]
        if name not in self.classes:
            raise ValueError(
                f"{self.file} needs the class {name!r}, which is not one of kcam's. If it is yours, hand it in: "
                f"Camera.load({str(self.file)!r}, custom=[{name.split('.')[-1]}])."
            )
        cls = self.classes[name]
        values, tensors = (
            {key: self.decode(item, path=_join(path, key)) for key, item in part.items()}
            for part in (node["arguments"], node.get("tensors", {}))
        )
        try:
            values = fitting_arguments(cls, values)
            if cls in layers.KINDS:
                layer = layers.fill(layers.empty(cls, values), tensors)
                return layer.train(node.get("training", True))
            positional: list[Any] = []
            for key, parameter in _constructor(cls).items():
                if parameter.kind is parameter.VAR_POSITIONAL:
                    positional.extend(values.pop(key, ()))
                elif parameter.kind is parameter.POSITIONAL_ONLY and key in values:
                    positional.append(values.pop(key))
            return cls(*positional, **values)
        except RecursionError:
            raise
        except Exception as error:  # a constructor that is given anything may raise anything
            raise ValueError(f"{self.file}: {name} no longer takes the saved arguments: {error}") from error


def _constructor(cls: type) -> dict[str, inspect.Parameter]:
    """The constructor's parameters."""
    if cls.__init__ is nn.Module.__init__:  # type: ignore[misc]
        return {}  # its (*args, **kwargs) only pass through
    return dict(inspect.signature(cls).parameters)


class _Names(dict[str, Any]):
    """Names of a module and Python's own; what is imported for the type checker alone may be anything."""

    def __missing__(self, name: str) -> Any:
        return getattr(builtins, name, Any)


def fitting_arguments(cls: type, values: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of the types that a constructor's annotations name, as far as they do: see `plain.fitting`.

    Only of kcam's classes and torch's, for others may say of their types what they like.

    Raises:    ValueError for an argument of another type, or that the constructor does not have.

    Example:
    >>> from kcam import files
    >>> files.fitting_arguments(sensor.ADC, {"bits": 12, "black_level": 64})
    {'bits': 12, 'black_level': 64}
    """
    if cls.__module__.partition(".")[0] not in ("kcam", "torch") or cls in (nn.Sequential, nn.Identity):
        return dict(values)
    start: Any = cls.__init__  # type: ignore[misc]
    hints = typing.get_type_hints(start, localns=_Names(vars(sys.modules[cls.__module__])))
    known: dict[str, Any] = {}
    for name, parameter in inspect.signature(cls).parameters.items():
        expected = hints.get(name, Any)
        if typing.get_origin(expected) is typing.Unpack:  # **arguments: Unpack[...], the names and types of a TypedDict
            known |= typing.get_type_hints(typing.get_args(expected)[0])
        else:
            many = parameter.kind is parameter.VAR_POSITIONAL
            known[name] = types.GenericAlias(tuple, (expected, ...)) if many else expected
    for name in values.keys() - known.keys():
        raise ValueError(f"there is no argument {name!r}")
    return {name: fitting(value, known[name], name) for name, value in values.items()}


def _arguments(value: Any) -> dict[str, Any]:
    """The constructor arguments that would build this object again."""
    if hasattr(value, "configuration"):
        return value.configuration()
    cls = type(value)
    start: Any = cls.__init__
    if start is not nn.Module.__init__ and (start.__module__ or "").partition(".")[0] == "torch":
        raise ValueError(
            f"cannot save a {cls.__qualname__}: it inherits the constructor of {start.__qualname__.partition('.')[0]}. "
            "Give it an __init__ of its own, whose arguments it stores as attributes of the same names."
        )
    arguments = {}
    for name, parameter in _constructor(cls).items():
        if parameter.kind is parameter.VAR_KEYWORD:
            raise TypeError(f"cannot save {cls.__qualname__}: its constructor takes **kwargs. Name its arguments.")
        if not hasattr(value, name):
            raise TypeError(
                f"cannot save {cls.__qualname__}({name}=): the module does not keep it. Store every "
                f"constructor argument as an attribute of the same name: self.{name} = {name}."
            )
        argument = getattr(value, name)
        arguments[name] = tuple(argument) if isinstance(argument, nn.ModuleList) else argument
    return arguments


def _join(path: str, name: str | int) -> str:
    return f"{path}.{name}" if path else str(name)


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The configuration and the tensors in a file; the tensors do not depend on the file any more."""
    if not path.is_file():
        what = f"{path} is a folder. Name the file in it" if path.is_dir() else f"there is no file {path}"
        run = path if path.is_dir() else path.with_suffix("")
        if (run / "checkpoints").is_dir():  # of `kcam train`, whose last act is to write the camera
            what = f"{path} is no camera yet: its training was stopped. Go on with the same kcam train ... --resume"
        raise FileNotFoundError(f"{what}.")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {key: file.get_tensor(key).clone() for key in file.keys()}  # noqa: SIM118 (no iterator)
    except SafetensorError as error:
        raise ValueError(f"{path} is not a whole safetensors file ({error}): it is damaged, or no camera.") from error
    if "kcam" not in metadata:
        raise ValueError(f"{path} holds weights but no camera: it was not written by Camera.save.")
    damaged = f"{path} is damaged, or no camera"
    version: _Version = from_json(metadata["kcam"], _Version, wrong=damaged, fix=FIX, hook=None)
    if version["format"] > FORMAT:
        raise ValueError(
            f"{path} was written by kcam {version['kcam']} in format {version['format']}; this kcam reads up to "
            f"format {FORMAT}. Update kcam."
        )
    return from_json(metadata["kcam"], _Document, wrong=damaged, fix=FIX, hook=None), tensors


def check_place(path: str | os.PathLike[str]) -> None:
    """ValueError where no file of that name can be: where there is a folder, or none to put it into.

    Example:
    >>> from kcam import files
    >>> files.check_place("nowhere/picture.png")
    Traceback (most recent call last):
    ValueError: cannot write picture.png: there is no folder nowhere.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"cannot write {path.name}: there is a folder of that name. Choose another name.")
    if not path.absolute().parent.is_dir():
        raise ValueError(f"cannot write {path.name}: there is no folder {path.parent}.")


def check_other(path: str | os.PathLike[str], given: str | os.PathLike[str] | None) -> None:
    """ValueError where a file that will be written is the one that is read.

    Example:
    >>> from kcam import files
    >>> plots.write_picture(torch.rand(3, 8, 8), "photo.png")
    >>> files.check_other("photo.png", "photo.png")
    Traceback (most recent call last):
    ValueError: photo.png is what is read, and would be lost. Choose another name for --out.
    """
    if given and Path(path).exists() and Path(given).exists() and Path(path).samefile(given):
        raise ValueError(f"{path} is what is read, and would be lost. Choose another name for --out.")


def replace(path: str | os.PathLike[str], content: bytes) -> None:
    """Write beside the file, then take its place: a crash or a full disk leaves the old file whole.

    Example:
    >>> from pathlib import Path
    >>> from kcam import files
    >>> files.replace("notes.txt", b"the whole of it")
    >>> Path("notes.txt").read_bytes()
    b'the whole of it'
    """
    with replacing(path) as temporary:
        temporary.write_bytes(content)


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Where to write a file that takes the place of `path` when all of it is on the disk, and not before.

    Example:
    >>> from pathlib import Path
    >>> from kcam import files
    >>> with files.replacing("notes.txt") as beside:
    ...     written = beside.write_text("the whole of it")
    >>> Path("notes.txt").read_text(), beside.exists()
    ('the whole of it', False)
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
