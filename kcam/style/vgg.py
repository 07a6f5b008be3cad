"""The features of the papers: layers of a pretrained VGG16, whose weights the user brings in a file."""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from kcam.scene import PHOTOGRAPHS
from kcam.texture.features import check_pictures

TAPS = {3: "relu1_2", 8: "relu2_2", 15: "relu3_3", 22: "relu4_3"}
"""Which of the trunk's modules, counted as in torchvision, give a layer."""
CHANNELS = (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512)  # of each convolution; 0: a pooling
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, sRGB
POOLS = {"max": nn.MaxPool2d, "avg": nn.AvgPool2d}
PRECISIONS = {None: None, "float32": None, "bfloat16": torch.bfloat16}
NAMED_HASH = re.compile(r"-([0-9a-f]{8,64})\.")  # as torch.hub reads it from a name
SAMPLE = 128  # side of the photographs that the weights are measured on


class VGG16Features(nn.Module):
    """VGG16's activations at relu1_2, relu2_2, relu3_3 and relu4_3, the layers of Johnson et al. and of the thesis.

    (x - mean) / deviation of ImageNet, ten 3x3 convolutions with their ReLUs, a pooling by 2 before each new width;
    nothing behind relu4_3 is computed or kept. The weights are frozen; the gradient flows to the picture.

    The file is torchvision's state dict, a .pth or a .safetensors: `features.N.weight` and `.bias`, N = 0 .. 21; other
    keys are ignored. Nothing in it is run (weights_only). If its name carries a hash, as vgg16-397923af.pth does, its
    sha256 must begin with that; under any other name it is taken for what it is.

    `natural`, which a style without contrast is measured against, is the variance per channel of each layer on kcam's
    built-in photographs, measured with these weights as they load.

    Args:
        weights: path of the file.
        pool: "max", as the network was trained; "avg", as Gatys et al. painted.
        precision: "float32", "bfloat16" for the convolutions, or None: bfloat16 on a GPU, float32 elsewhere.
        picture, to the call: (B,3,H,W) sRGB in [0,1], H and W multiples of 8 and at least 32.
    Returns:   from the call: {"relu1_2", .., "relu4_3"}: (B,C,h,w) of 64 to 512 channels at 1 to 1/8 of the size, in
               the type of the weights: float32, or that of `.to(dtype)`.
    Raises:    FileNotFoundError where there is no file; ValueError for one that does not hold VGG16, and for an unknown
               pool or precision. From the call as `SteerableFeatures`.
    Source:    Simonyan and Zisserman, Very deep convolutional networks for large-scale image recognition (2015);
               Johnson, Alahi and Fei-Fei, Perceptual losses for real-time style transfer and super-resolution (2016).

    Example:
    >>> from kcam.style import VGG16Features
    >>> VGG16Features("vgg16-397923af.pth")  # kcam downloads nothing
    Traceback (most recent call last):
    FileNotFoundError: there is no file vgg16-397923af.pth. The weights of VGG16 are torchvision's ...
    """

    multiple = 8
    least = 32
    mean: Tensor
    deviation: Tensor

    def __init__(self, weights: str | os.PathLike[str], *, pool: str = "max", precision: str | None = None) -> None:
        super().__init__()
        if pool not in POOLS:
            raise ValueError(f"unknown pool {pool!r}; known: {', '.join(POOLS)}.")
        if precision not in PRECISIONS:
            known = ", ".join(str(name) for name in PRECISIONS)
            raise ValueError(f"unknown precision {precision!r}; known: {known}.")
        path = Path(weights)
        self.fingerprint = _fingerprint(path)
        self.name = f"vgg16-{self.fingerprint[:8]}" + ("" if pool == "max" else f"-{pool}")
        self.precision = precision
        with torch.device("meta"):  # shapes alone: nothing is drawn from the global generator
            self.features = _trunk(pool)
        self.features.load_state_dict(_checked(_read(path), self.features.state_dict(), path), assign=True)
        self.requires_grad_(False)
        for name, values in (("mean", MEAN), ("deviation", DEVIATION)):
            self.register_buffer(name, torch.tensor(values, device="cpu")[:, None, None], persistent=False)
        self.natural = self._natural(path)

    def forward(self, picture: Tensor) -> dict[str, Tensor]:
        """The layers of a picture."""
        check_pictures(picture, multiple=self.multiple, least=self.least)
        dtype = self.mean.dtype
        with self._mixed(picture.device):
            x = (picture.to(dtype) - self.mean) / self.deviation
            layers = {}
            for index, module in enumerate(self.features):
                x = module(x)
                if index in TAPS:
                    layers[TAPS[index]] = x
        return {name: layer.to(dtype) for name, layer in layers.items()}

    def _mixed(self, device: torch.device) -> contextlib.AbstractContextManager[Any]:
        short = torch.bfloat16 if self.precision is None and device.type == "cuda" else PRECISIONS[self.precision]
        return torch.autocast(device.type, dtype=short, enabled=short is not None)

    def _natural(self, path: Path) -> dict[str, float]:
        """Variance per channel of each layer; to two digits, which no machine's rounding changes."""
        pictures = [torch.tensor(read()[0], device="cpu") for read in PHOTOGRAPHS.values()]
        corners = [[(size - SAMPLE) // 2 for size in picture.shape[:2]] for picture in pictures]
        sample = torch.stack(
            [
                picture[top : top + SAMPLE, left : left + SAMPLE].permute(2, 0, 1) / 255
                for picture, (top, left) in zip(pictures, corners, strict=True)
            ]
        )
        with torch.no_grad():
            layers = self(sample)
        natural = {name: float(f"{layer.var((0, 2, 3), correction=0).mean():.2g}") for name, layer in layers.items()}
        for name, variance in natural.items():
            if not 0 < variance < float("inf"):
                raise ValueError(
                    f"{path}: on photographs its layer {name} has a variance of {variance:g}, expected a finite one "
                    "above 0: these are no trained weights. Use torchvision's vgg16-397923af.pth."
                )
        return natural


def _trunk(pool: str) -> nn.Sequential:
    """The modules up to relu4_3 at torchvision's places. In place, a ReLU spares the memory of what it cuts."""
    modules: list[nn.Module] = []
    before = 3
    for channels in CHANNELS:
        if channels:
            modules += [nn.Conv2d(before, channels, 3, padding=1), nn.ReLU(inplace=True)]
            before = channels
        else:
            modules.append(POOLS[pool](2))
    return nn.Sequential(*modules)


def _fingerprint(path: Path) -> str:
    """The first 16 hex digits of a file's sha256, which agree with a hash in its name."""
    if not path.is_file():
        what = f"{path} is a folder" if path.is_dir() else f"there is no file {path}"
        raise FileNotFoundError(
            f"{what}. The weights of VGG16 are torchvision's vgg16-397923af.pth: see "
            "torchvision.models.VGG16_Weights.IMAGENET1K_V1.url. SteerableFeatures, the default, needs none."
        )
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    named = NAMED_HASH.search(path.name)
    if named and not digest.startswith(named[1]):
        raise ValueError(
            f"{path}: its name says that its sha256 begins with {named[1]}, and it begins with "
            f"{digest[: len(named[1])]}: it is damaged, or another file. Get it again, or rename it."
        )
    return digest[:16]


def _read(path: Path) -> Any:
    """What a file holds; nothing in it is run."""
    if path.suffix == ".safetensors":
        try:
            return load_file(path)
        except Exception as error:  # of a header that is no such thing, too
            raise ValueError(f"{path} is not a whole safetensors file ({error}). Get it again.") from error
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise ValueError(
            f"{path} is damaged, or holds more than tensors: pickled objects, which could run code, are not read. Save "
            "the weights alone: torch.save(model.state_dict(), path)."
        ) from error
    except Exception as error:  # a damaged file makes torch.load raise anything, in words about something else
        raise ValueError(f"{path} is damaged, or no file that torch.save wrote. Get it again.") from error


def _checked(held: Any, expected: Mapping[str, Tensor], path: Path) -> dict[str, Tensor]:
    """Of what a file holds, the trunk's tensors in float32, by the names that they have in the trunk."""
    fix = "Use the state dict of torchvision's vgg16, such as vgg16-397923af.pth"
    if not isinstance(held, Mapping):
        raise ValueError(f"{path} holds a {type(held).__name__}, expected names and tensors. {fix}.")
    found = {}
    for name, meta in expected.items():
        key, shape = f"features.{name}", tuple(meta.shape)
        tensor = held.get(key)
        if tensor is None:
            others = ", ".join(str(other) for other in list(held)[:3]) or "nothing"
            raise ValueError(f"{path} has no {key}, expected {shape}; it has {others} .. {fix}, not another network's.")
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point() or tensor.layout != torch.strided:
            got = f"{tensor.layout} {tensor.dtype}" if isinstance(tensor, Tensor) else type(tensor).__name__
            raise ValueError(f"{path}: {key} is a {got}, expected a dense tensor of floating-point numbers. {fix}.")
        if tensor.shape != meta.shape:
            raise ValueError(f"{path}: {key} has shape {tuple(tensor.shape)}, expected {shape}. {fix}.")
        values = tensor.detach().float().contiguous()
        odd = int((~values.isfinite()).sum())
        if odd:
            raise ValueError(
                f"{path}: {key} has {odd} of {values.numel()} values that are not finite in float32, expected none. "
                f"{fix}, or the weights of an earlier epoch."
            )
        found[name] = values
    return found
