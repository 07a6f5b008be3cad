"""The scenes that need no file: photographs of scikit-image, and charts that are drawn."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from kcam import spectral


def _photograph(name: str) -> tuple[np.ndarray, float | Tensor]:
    from skimage import data

    return getattr(data, name)(), 2.0


def _motorcycle() -> tuple[np.ndarray, float | Tensor]:
    """The left picture, and Z = f b / (d + doffs) with the calibration in scikit-image's docstring.

    The 7 % of the pixels that have no disparity are mostly hidden from the right camera, so they belong to what is
    behind: they take the farther one of the nearest valid distances to their left and right.
    """
    from skimage import data

    picture, _, disparity = data.stereo_motorcycle()
    focal_length, baseline, offset = 994.978, 0.193001, 31.086  # pixels, m, pixels
    valid = np.isfinite(disparity)
    width = disparity.shape[1]
    column = np.arange(width)
    before = np.maximum.accumulate(np.where(valid, column, -1), axis=1)
    after = np.minimum.accumulate(np.where(valid, column, width)[:, ::-1], axis=1)[:, ::-1]
    padded = np.pad(disparity, ((0, 0), (1, 1)), constant_values=np.inf)  # beyond the borders: nearer than anything
    disparity = np.minimum(*(np.take_along_axis(padded, index + 1, axis=1) for index in (before, after)))
    return picture, torch.tensor(focal_length * baseline / (disparity + offset))


def _colour_chart(height: int, width: int, wavelengths: Tensor) -> tuple[Tensor, Tensor]:
    """Four rows of six patches in a black frame: a plane and a reflectance for each patch."""
    row, row_place = np.divmod((np.arange(height) + 0.5) * 4 / height, 1)
    column, column_place = np.divmod((np.arange(width) + 0.5) * 6 / width, 1)
    frame = (np.abs(row_place - 0.5) > 0.42)[:, None] | (np.abs(column_place - 0.5) > 0.42)
    patch = torch.tensor(np.where(frame, 24, row[:, None] * 6 + column))
    planes = (patch == torch.arange(25)[:, None, None]).float()
    black = planes[23] + 0.3 * planes[24]  # the frame is darker than the black patch, so that this one shows
    return torch.cat([planes[:23], black[None]])[None], spectral.reflectances(wavelengths)


def _star(height: int, width: int, wavelengths: Tensor) -> tuple[Tensor, Tensor]:
    samples = 4
    y = (torch.arange(height * samples) + 0.5) / samples - height / 2
    x = (torch.arange(width * samples) + 0.5) / samples - width / 2
    angle, radius = torch.atan2(y[:, None], x), torch.hypot(y[:, None], x)
    white = (torch.sin(36 * angle) >= 0) | (radius > 0.48 * min(height, width))
    return F.avg_pool2d(white.float()[None, None], samples), torch.ones(1, len(wavelengths))


def _point_grid(height: int, width: int, wavelengths: Tensor) -> tuple[Tensor, Tensor]:
    pitch = min(64, height, width)
    planes = torch.zeros(1, 1, height, width)
    planes[..., pitch // 2 :: pitch, pitch // 2 :: pitch] = 30.0
    return planes, torch.ones(1, len(wavelengths))


PHOTOGRAPHS: dict[str, Callable[[], tuple[np.ndarray, float | Tensor]]] = {
    "motorcycle": _motorcycle,
    **{name: functools.partial(_photograph, name) for name in ("astronaut", "coffee", "chelsea")},
}
"""Name -> a function that gives the picture (H,W,3) in 8 bits, and the depth."""

CHARTS: dict[str, tuple[Callable[[int, int, Tensor], tuple[Tensor, Tensor]], tuple[int, int]]] = {
    "colour_chart": (_colour_chart, (400, 600)),
    "star": (_star, (512, 512)),
    "point_grid": (_point_grid, (512, 512)),
}
"""Name -> a function of height, width and wavelengths that draws planes (1,K,H,W) and reflectances (K,L); a shape."""

BUILTIN = (*PHOTOGRAPHS, *CHARTS)
"""The scenes that `Scene.builtin` knows."""
