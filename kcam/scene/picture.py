"""Pictures in files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from kcam.inputs import describe, remedy


def read_picture(path: str | os.PathLike[str]) -> Tensor:
    """Read a picture of 8 or 16 bits as it is meant to be seen: (3,H,W) float32 sRGB in [0,1], (1,H,W) if it is grey.

    It is turned as its EXIF orientation says. What is transparent is laid on white. Its values are taken as sRGB: an
    embedded colour profile is not read.

    Raises:    FileNotFoundError; ValueError for a file that is no picture, damaged or cut short, or holds floats.
    """
    from kornia.io import ImageLoadType, load_image
    from PIL import Image

    if not isinstance(path, (str, os.PathLike)):
        code = f" What is no file goes to Scene.from_rgb.{remedy(path, name='image')}"
        raise TypeError(f"path must be the name of a file, got {describe(path)}.{code}")
    path = Path(path)
    if not path.is_file():
        what = f"{path} is a folder" if path.is_dir() else f"there is no file {path}"
        raise FileNotFoundError(f"{what}. Expected a picture: PNG, JPEG, TIFF, WebP, ...")
    try:
        with Image.open(path) as file:
            if file.format in ("PNG", "TIFF") and ";16" in str(file.tile):
                # Pillow would cut 16-bit colours to 8 bits; Kornia keeps them, but knows fewer formats.
                pixels = load_image(path, ImageLoadType.UNCHANGED).float() / 65535
            elif file.mode in ("F", "I"):
                raise ValueError("it holds 32-bit values. For linear radiance use Scene.from_bands")
            else:
                mode = ("L" if file.mode in ("1", "L", "LA") else "RGB") + "A" * file.has_transparency_data
                pixels = torch.tensor(np.atleast_3d(np.asarray(file.convert(mode)))).permute(2, 0, 1) / 255
            orientation = file.getexif().get(0x0112, 1)  # after decoding: Pillow has turned a TIFF by then
    except Image.DecompressionBombError as error:
        raise ValueError(
            f"{path} has more than {2 * (Image.MAX_IMAGE_PIXELS or 0) / 1e6:.0f} million pixels, more than can be "
            "photographed in one piece. Make it smaller first."
        ) from error
    except Exception as error:  # a damaged header makes Pillow raise anything: SyntaxError, KeyError, struct.error, ...
        raise ValueError(f"cannot read {path} as a picture of 8 or 16 bits: {error}.") from error
    if len(pixels) in (2, 4):
        pixels, alpha = pixels[:-1], pixels[-1:]
        pixels = pixels * alpha + (1 - alpha)
    if orientation in (5, 6, 7, 8):
        pixels = pixels.transpose(1, 2)
    flips = [axis for axis, cases in ((1, (3, 4, 7, 8)), (2, (2, 3, 6, 7))) if orientation in cases]
    return pixels.flip(flips)
