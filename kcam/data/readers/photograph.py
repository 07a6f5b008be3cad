"""Photographs, upsampled to spectra."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from kcam import spectral
from kcam.data.cube import CubeError, Source
from kcam.data.readers.format import Format, Options, scene_name
from kcam.scene import Scene, read_picture
from kcam.units import wavelength_grid


def _open_rgb(path: Path, options: Options) -> Source:
    """A photograph: reflectances with its colours, upsampled by `spectral.rgb_basis`; light is not put on them."""
    picture = read_picture(path)
    grid = wavelength_grid() if options.bands is None else torch.from_numpy(options.bands)
    scene = Scene.from_rgb(picture, wavelengths=grid, illuminant="E")
    coefficients = scene.coefficients[0].numpy()
    basis = scene.spectra if scene.spectra is not None else torch.eye(len(grid))
    weights = (basis / spectral.illuminant("E", wavelengths=grid).to(basis)).numpy().T.astype(np.float32)  # (L,K)
    _, height, width = coefficients.shape

    def rows(first: int, last: int) -> tuple[np.ndarray, None]:
        return np.maximum(np.einsum("lk,khw->lhw", weights, coefficients[:, first:last]), 0), None

    if options.depth is not None and options.depth.shape != (height, width):
        raise CubeError(f"its depth map is {options.depth.shape}, the photograph {(height, width)}.")
    facts = {"scaling": "linear sRGB, upsampled (Mallett and Yuksel 2019)", "orientation": "as EXIF says"}
    shape = (len(grid), height, width)
    return Source(scene_name(path), shape, grid.numpy(), "reflectance", rows, facts, depth=options.depth)


_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp")
RGB = Format("rgb", "a photograph, upsampled to spectra", _open_rgb, _SUFFIXES, lambda path: False)
"""Never recognised: that spectra are to be made up must be said."""
