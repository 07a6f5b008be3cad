"""Pictures as files, and the colours in which light, mosaics and raw signals are shown."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from kcam import files, sensor, spectral
from kcam.inputs import check_picture
from kcam.sensor.mosaic import pattern_tile
from kcam.units import nm

CHANNEL_COLOURS = ((1.0, 0.18, 0.12), (0.2, 0.9, 0.25), (0.2, 0.35, 1.0), (1.0, 1.0, 1.0))
"""Of the channels red, green, blue and white of a mosaic, sRGB in [0,1]."""
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
"""Formats that `write_picture` writes."""


def check_writable(path: str | os.PathLike[str], *, suffixes: Sequence[str] = PICTURE_SUFFIXES) -> None:
    """Fail before the work and not after it: ValueError for a suffix that cannot be written, or no place for it.

    Example:
    >>> plots.check_writable("picture.doc")
    Traceback (most recent call last):
    ValueError: cannot write picture.doc: its name must end in one of .png, ...
    """
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"path must be the name of a file, got {type(path).__name__}. The picture comes first.")
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"cannot write {path.name}: its name must end in one of {', '.join(suffixes)}.")
    files.check_place(path)


def write_picture(picture: Tensor, path: str | os.PathLike[str], *, quality: int = 95) -> None:
    """Write a picture (3,H,W) or (1,H,W) in [0,1] as 8 bits; the suffix names the format.

    One plane is written as one, and in a TIFF, where it is a raw signal as often as a picture, with 16 bits. Highlights
    and colours a little outside are clipped; the file is whole or not there.

    Raises:    as `check_writable`; TypeError, ValueError for another shape, NaN, or values beyond -1..2.

    Example:
    >>> plots.write_picture(torch.rand(3, 8, 12), "noise.png")
    >>> Scene.from_file("noise.png", depth=2.0).shape
    (1, 8, 12)
    """
    check_writable(path)
    check_picture(picture, name="picture", ndims=(3,), within=(-1.0, 2.0))
    image = as_image(picture)
    suffix = Path(path).suffix.lower()
    options: dict[str, Any] = {"quality": quality} if suffix in {".jpg", ".jpeg", ".webp"} else {}
    if suffix == ".png":
        options["compress_level"] = 4  # half the time of Pillow's 6, and photographs are no larger
    content = io.BytesIO()
    if len(picture) == 1:
        image = image[..., 0]
    deep = len(picture) == 1 and suffix in {".tif", ".tiff"}
    values = image.astype(np.float64) * 65535 if deep else image * np.float32(255)
    pixels = Image.fromarray(np.rint(values).astype(np.uint16 if deep else np.uint8))
    pixels.save(content, format=Image.registered_extensions()[suffix], **options)
    files.replace(path, content.getvalue())


def as_image(picture: Tensor) -> np.ndarray:
    """A picture (C,H,W), C = 1 or 3, as an array (H,W,3) in [0,1]. Raises: TypeError, ValueError for what is none.

    Example:
    >>> plots.as_image(torch.rand(1, 4, 6)).shape  # gray, in three channels
    (4, 6, 3)
    """
    check_picture(picture, name="picture", ndims=(3,), within=None)
    image = picture.detach().float().clamp(0, 1).cpu().nan_to_num()
    return image.expand(3, -1, -1).permute(1, 2, 0).numpy()


def light_colours(wavelengths: Tensor) -> np.ndarray:
    """A colour for each wavelength, (L,3) sRGB in [0,1]: as the CIE 1931 observer sees it, as pure as a screen can.

    Light that nobody sees is white.

    Example:
    >>> violet, green, red = plots.light_colours(torch.tensor([430.0, 530.0, 650.0]) * nm)
    >>> int(violet.argmax()), int(green.argmax()), int(red.argmax())  # blue, green and red are strongest
    (2, 1, 0)
    """
    seen = spectral.observer(wavelengths).double()
    linear = seen @ spectral.xyz_to_srgb_matrix().T
    linear = linear - linear.amin(-1, keepdim=True).clamp(max=0)  # the least white that makes it a real colour
    return _pure(torch.where(seen.sum(-1, keepdim=True) > 0, linear, 1.0))


def _pure(linear: Tensor) -> np.ndarray:
    """Linear sRGB (..., 3) at full brightness, coded."""
    return ((linear / linear.amax(-1, keepdim=True).clamp(min=1e-9)) ** (1 / 2.2)).numpy()


def mosaic_tile(camera: Any) -> np.ndarray:
    """The colours of a camera's filter tile, (rows, columns, 3): the mosaic's pattern, or the learned tile's own.

    Example:
    >>> plots.mosaic_tile(Camera(sensor.Mosaic("RGGB"))).shape
    (2, 2, 3)
    """
    filters = [stage for stage in camera if isinstance(stage, sensor.ColourFilter)]
    if filters and filters[0].is_tile:
        wavelengths = torch.linspace(420, 720, 61, dtype=torch.float64) * nm
        curves = (filters[0].alpha().double() @ filters[0].basis(wavelengths)).detach().cpu()
        return _pure((curves @ spectral.observer(wavelengths).double() @ spectral.xyz_to_srgb_matrix().T).clamp(min=0))
    mosaics = [stage for stage in camera if isinstance(stage, sensor.Mosaic)]
    if not mosaics:
        return np.ones((1, 1, 3))
    return np.asarray(CHANNEL_COLOURS)[pattern_tile(mosaics[0].pattern).numpy()]


def false_colour(raw: Tensor, tile: np.ndarray) -> np.ndarray:
    """A raw plane (1,H,W) with each pixel in the colour of its filter, (H,W,3), bright enough for a screen.

    Example:
    >>> raw = torch.full((1, 4, 4), 0.2)
    >>> plots.false_colour(raw, plots.mosaic_tile(Camera(sensor.Mosaic("RGGB")))).shape
    (4, 4, 3)
    """
    plane = raw[0].detach().float().clamp(0, 1).cpu()
    plane = (plane / plane.amax().clamp(min=1e-6)) ** (1 / 2.2)
    rows, columns, _ = tile.shape
    height, width = plane.shape
    colours = np.tile(tile, (-(-height // rows), -(-width // columns), 1))[:height, :width]
    return np.clip(plane.numpy()[..., None] * colours, 0, 1)
