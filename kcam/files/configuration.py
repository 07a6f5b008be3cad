"""A module as plain values and tensors, and built again from them: the configuration in a file."""

from __future__ import annotations

import builtins
import inspect
import math
import sys
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal, NotRequired, TypedDict

from torch import Tensor, nn

from kcam import layers
from kcam.context import Context
from kcam.plain import fitting, join

FIX = "Save the camera again."


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


class Writer:
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
            return [self.encode(item, path=join(path, index), owner=owner) for index, item in enumerate(value)]
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
                name: self.encode(member, path=join(path, name), owner=f"{cls.__qualname__}({name}=)")
                for name, member in members.items()
            }
        if not node["tensors"]:
            del node["tensors"]
        return node | ({"training": False} if layer and not value.training else {})


class Reader:
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
            return tuple(self.decode(item, path=join(path, index)) for index, item in enumerate(value))
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
            {key: self.decode(item, path=join(path, key)) for key, item in part.items()}
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
