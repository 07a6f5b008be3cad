"""Bands, the samples of a curve over wavelength: what each stands for, and what lies between them."""

from __future__ import annotations

import functools
from importlib import resources

import numpy as np
import torch
from torch import Tensor

from kcam.spectral.curves import interpolation
from kcam.units import nm, wavelength_grid

SINGLE_BAND_WIDTH = 10 * nm
"""Width of a band that has no neighbour to reach half-way to."""

Grid = tuple[float, ...]  # wavelengths in nm, the key of caches


@functools.cache
def read_table(name: str) -> dict[str, np.ndarray]:
    """One of `kcam/tables`."""
    with resources.files("kcam").joinpath("tables", f"{name}.npz").open("rb") as file, np.load(file) as archive:
        return dict(archive)


def band_grid(wavelengths: Tensor) -> Grid:
    """Distinct bands, rounded to 1e-6 nm, so that 420e-9 / 1e-9 = 420.00000000000006 is a point of the tables."""
    grid = tuple(np.round(wavelength_grid(wavelengths).numpy() / nm, 6).tolist())
    if len(set(grid)) < len(grid):
        twice = next(value for value in grid if grid.count(value) > 1)
        raise ValueError(f"wavelength {twice:g} nm occurs more than once: expected distinct bands. Average them first.")
    return grid


def band_widths(wavelengths: Tensor) -> Tensor:
    """How much of the spectrum each band stands for: sum(values * widths) approximates an integral over wavelength.

    A band reaches half-way to its neighbours; the outermost ones reach as far outwards as inwards.

    Args:      wavelengths: (L,) [m], in any order.
    Returns:   (L,) float64 [m], in the same order; 10 nm for a single band.

    Example:
    >>> (spectral.band_widths(torch.tensor([500.0, 510.0, 530.0]) * nm) / nm).round().tolist()  # nm
    [10.0, 15.0, 20.0]
    """
    grid = np.array(band_grid(wavelengths)) * nm
    if len(grid) == 1:
        return torch.tensor([SINGLE_BAND_WIDTH], dtype=torch.float64)
    order = np.argsort(grid)
    gaps = np.diff(grid[order])
    widths = np.empty_like(grid)
    widths[order] = (np.append(gaps[0], gaps) + np.append(gaps, gaps[-1])) / 2
    return torch.tensor(widths)


def band_averages(curves: np.ndarray, grid: Grid, fine: np.ndarray) -> np.ndarray:
    """Curves (..., N) at fine wavelengths (N,) [nm] in steps of 1 nm, averaged over each band's triangle: (..., L).

    The triangles of the outermost bands are symmetric, as are their widths in `band_widths`.
    """
    bands = np.array(grid)
    order = np.argsort(bands)
    nodes = bands[order]
    first, last = (nodes[1] - nodes[0], nodes[-1] - nodes[-2]) if len(nodes) > 1 else [SINGLE_BAND_WIDTH / nm] * 2
    triangles = np.empty((len(bands), len(fine)))
    triangles[order] = _linear_weights(np.concatenate([[nodes[0] - first], nodes, [nodes[-1] + last]]), fine)[1:-1]
    for band in np.flatnonzero(triangles.sum(axis=1) == 0):  # it falls between two steps, or outside the range
        triangles[band, np.abs(fine - bands[band]).argmin()] = 1
    return curves @ (triangles / triangles.sum(axis=1, keepdims=True)).T


def cubic_weights(grid: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Weights (L, N) that interpolate values on `grid` at `points`: cubic in between, constant beyond the ends.

    Where neighbouring distances are so unequal that a cubic would amplify errors, linear in between.
    """
    order = np.argsort(grid)
    nodes, points = grid[order], np.clip(points, grid.min(), grid.max())
    size = min(4, len(nodes))
    first = np.clip(np.searchsorted(nodes, points, side="right") - size // 2, 0, len(nodes) - size)
    stencil = nodes[first[:, None] + np.arange(size)]
    weights = np.zeros((len(nodes), len(points)))
    for k in range(size):
        others = np.delete(stencil, k, axis=1)
        lagrange = np.prod((points[:, None] - others) / (stencil[:, [k]] - others), axis=1)
        weights[first + k, np.arange(len(points))] = lagrange
    if np.abs(weights).max() > 1.3:  # 1.06 for equal distances
        weights = _linear_weights(nodes, points)
    result = np.empty_like(weights)
    result[order] = weights
    return result


def _linear_weights(nodes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """`interpolation` of arrays."""
    return interpolation(torch.tensor(nodes), torch.tensor(points)).numpy()
