"""Modules in safetensors files, their configuration in the metadata."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypedDict

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_bytes
from torch import Tensor, nn

from kcam import layers
from kcam.files.atomic import replace
from kcam.files.configuration import FIX, Reader, Writer
from kcam.plain import from_json

FORMAT = 1
"""Version of the file format: raised when an older kcam could no longer read what a newer one writes."""


class _Version(TypedDict):
    format: int
    kcam: str


class _Document(_Version):
    configuration: Any
    aliases: dict[str, str]
    state: list[str]


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
    writer = Writer({cls: name for name, cls in classes.items()})
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
    reader = Reader(layers.LAYERS | dict(classes), tensors, path)
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


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The configuration and the tensors in a file; the tensors do not depend on the file any more."""
    if not path.is_file():
        what = f"{path} is a folder. Name the file in it" if path.is_dir() else f"there is no file {path}"
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
