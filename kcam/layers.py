"""torch's own layers as stages of a camera: which there are, what they were made from, and how they are made again.

A layer's constructor arguments are read back from its attributes, where torch keeps them; its tensors are set as they
were. Layers are built without memory of their own (torch's "meta" device), so a file's numbers cannot ask for any.
"""

from __future__ import annotations

import inspect
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

NAMES = (
    "Sequential", "Identity", "Flatten", "Unflatten",
    "Linear", "Conv1d", "Conv2d", "Conv3d", "ConvTranspose1d", "ConvTranspose2d", "ConvTranspose3d",
    "BatchNorm1d", "BatchNorm2d", "BatchNorm3d", "InstanceNorm1d", "InstanceNorm2d", "InstanceNorm3d", "GroupNorm",
    "LayerNorm", "RMSNorm", "LocalResponseNorm",
    "ReLU", "ReLU6", "LeakyReLU", "PReLU", "RReLU", "ELU", "CELU", "SELU", "GELU", "GLU", "SiLU", "Mish", "Sigmoid",
    "LogSigmoid", "Hardsigmoid", "Tanh", "Hardtanh", "Hardswish", "Hardshrink", "Softshrink", "Tanhshrink", "Softplus",
    "Softsign", "Softmax", "Softmin", "Softmax2d", "LogSoftmax", "Threshold",
    "MaxPool1d", "MaxPool2d", "MaxPool3d", "AvgPool1d", "AvgPool2d", "AvgPool3d", "LPPool1d", "LPPool2d", "LPPool3d",
    "AdaptiveAvgPool1d", "AdaptiveAvgPool2d", "AdaptiveAvgPool3d", "AdaptiveMaxPool1d", "AdaptiveMaxPool2d",
    "AdaptiveMaxPool3d", "Upsample", "UpsamplingNearest2d", "UpsamplingBilinear2d", "PixelShuffle", "PixelUnshuffle",
    "ChannelShuffle", "Dropout", "Dropout1d", "Dropout2d", "Dropout3d", "AlphaDropout", "FeatureAlphaDropout",
    "ZeroPad1d", "ZeroPad2d", "ZeroPad3d", "ConstantPad1d", "ConstantPad2d", "ConstantPad3d", "ReflectionPad1d",
    "ReflectionPad2d", "ReflectionPad3d", "ReplicationPad1d", "ReplicationPad2d", "ReplicationPad3d", "CircularPad1d",
    "CircularPad2d", "CircularPad3d",
)  # fmt: skip
LAYERS: dict[str, type[nn.Module]] = {f"torch.nn.{name}": getattr(nn, name) for name in NAMES if hasattr(nn, name)}
"""Name in a file -> class: the only ones of torch's that a file can ask for. Older versions of torch lack some."""
KINDS = frozenset(LAYERS.values())


def is_layer(module: object) -> bool:
    """Whether it is of torch's classes, in the table or not; a subclass of one that is someone else's is not."""
    return isinstance(module, nn.Module) and type(module).__module__.partition(".")[0] == "torch"


def arguments(layer: nn.Module) -> dict[str, Any]:
    """The constructor arguments that would build a layer again; of a Sequential its layers by name.

    Raises:    ValueError that names it, for a class that is not in the table, and for a layer to which something was
               done that its arguments do not tell: hooks, other weights, layers or settings, a forward of its own.
    """
    cls = type(layer)
    if cls not in KINDS:
        raise ValueError(
            f"cannot save a {_full_name(cls)}: it is none of torch's layers that a camera's file can hold (Sequential, "
            "Linear, convolutions, norms, activations, pooling, upsampling, padding, dropout). Put it into a class of "
            "your own whose constructor arguments are attributes, and load it with Camera.load(path, custom=[...])."
        )
    if cls is nn.Sequential:
        found: dict[str, Any] = dict(layer._modules)  # named_children() would name one that stands in it twice once
    else:
        found = {name: getattr(layer, name) for name in _parameters(cls) if hasattr(layer, name)}
        if "bias" in found:
            found["bias"] = found["bias"] is not None
    changed = bool(layer._forward_hooks or layer._forward_pre_hooks or "forward" in vars(layer))
    try:
        again = empty(cls, found)
        changed |= _shapes(again) != _shapes(layer) or again._modules.keys() != layer._modules.keys()
        changed |= any(vars(layer).get(name) != value for name, value in _settings(again).items())
    except Exception:  # what its attributes say cannot be built any more
        changed = True
    if changed:
        raise ValueError(
            f"cannot save a {_full_name(cls)} to which something was done after it was made (a hook, a normalisation "
            "of its weights, another setting, a forward of its own). Put it into a class of your own, and load it with "
            "Camera.load(path, custom=[...])."
        )
    return found


def empty(cls: type[nn.Module], arguments: Mapping[str, Any]) -> nn.Module:
    """A layer whose tensors have shapes but no values. Raises: whatever torch does for arguments that do not fit."""
    if cls is nn.Sequential:
        strange = [name for name, layer in arguments.items() if not isinstance(layer, nn.Module)]
        if strange:
            raise ValueError(f"its layer {strange[0]!r} is no module")
        return nn.Sequential(OrderedDict(arguments))
    with torch.device("meta"):
        return cls(**arguments)


def tensors(layer: nn.Module) -> dict[str, Tensor]:
    """Its own parameters and buffers by name, those of its layers left out."""
    return {name: tensor for name, tensor in (layer._parameters | layer._buffers).items() if tensor is not None}


def fill(layer: nn.Module, values: Mapping[str, Tensor]) -> nn.Module:
    """Give a layer that `empty` made its tensors. Raises: ValueError where these are others than it has."""
    shapes = {name: (isinstance(value, nn.Parameter), tuple(value.shape)) for name, value in values.items()}
    if shapes != _shapes(layer):
        raise ValueError(f"its tensors are {_listed(shapes)}, expected {_listed(_shapes(layer))}")
    for name, value in values.items():
        setattr(layer, name, value)
    return layer


def _parameters(cls: type[nn.Module]) -> list[str]:
    """Of the constructor, but where and as what its tensors are made."""
    names = inspect.signature(cls).parameters
    return [name for name in names if name not in ("device", "dtype", "args", "kwargs")]


def _shapes(layer: nn.Module) -> dict[str, tuple[bool, tuple[int, ...]]]:
    return {name: (isinstance(t, nn.Parameter), tuple(t.shape)) for name, t in tensors(layer).items()}


def _settings(layer: nn.Module) -> dict[str, Any]:
    """What a constructor leaves beside tensors and layers, what it derives from its arguments too."""
    apart = vars(nn.Module()).keys()
    return {name: value for name, value in vars(layer).items() if name not in apart}


def _listed(shapes: Mapping[str, tuple[bool, tuple[int, ...]]]) -> str:
    return ", ".join(f"{name} {shape}" for name, (_, shape) in shapes.items()) or "none"


def _full_name(cls: type) -> str:
    return f"torch.nn.{cls.__name__}" if getattr(nn, cls.__name__, None) is cls else f"{cls.__module__}.{cls.__name__}"
