"""From sRGB to spectra, and how exactly that comes back."""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

from kcam.spectral.bands import Grid, band_averages, band_grid, read_table
from kcam.spectral.colour import srgb_of_xyz
from kcam.spectral.illuminants import lamp_on_bands
from kcam.spectral.measured import matching_integrals


def rgb_basis(wavelengths: Tensor) -> Tensor:
    """Three reflectance spectra that a linear sRGB colour mixes: reflectance = rgb @ basis.

    B = inv(M A) M,   M: Mallett's basis, averaged over the bands,  A: reflectance to linear sRGB under D65, (L, 3)

    The factor inv(M A) makes the way back exact: B A = 1. All values are between 0 and 1 and the rows add up to 1, so
    a colour in [0,1] is a possible reflectance, and white is 1 in every band. Where B would leave [0,1], it is the one
    nearest to M that does not and has B A = 1; where there is none such, the one with the least error.

    Args:      wavelengths: (L,) [m].
    Returns:   (3, L) float64.
    Valid when there is such a B: with 11 or more even bands over 420..720 nm, or uneven ones without gaps in which a
               primary would fall. `rgb_error` states what is lost elsewhere. Below 3 bands it is M itself.
    Source:    Mallett, Yuksel, Spectral Primary Decomposition for Rendering with sRGB Reflectance, EGSR 2019.

    Example:
    >>> basis = spectral.rgb_basis(kcam.units.wavelength_grid())
    >>> torch.allclose(basis.sum(0), torch.ones(28).double()), bool((basis >= 0).all())  # white is 1 everywhere
    (True, True)
    """
    return torch.tensor(_rgb_basis(band_grid(wavelengths)))


def rgb_error(wavelengths: Tensor) -> float:
    """By how much sRGB colours come back changed from `rgb_basis` under D65: the most of any, over a grid of 9^3.

    Args:      wavelengths: (L,) [m].
    Returns:   of coded sRGB, 0..1: some 1e-14 where the bands carry the colours, 0.1 for 10 even bands, 0.4 for 6.

    Example:
    >>> [spectral.rgb_error(kcam.units.wavelength_grid(count=count)) > 0.01 for count in (28, 6)]
    [False, True]
    """
    return _rgb_error(band_grid(wavelengths))


def _srgb_weights(grid: Grid) -> np.ndarray:
    """(L, 3): from reflectances under D65 to linear sRGB."""
    return matching_integrals(grid) * lamp_on_bands("D65", grid)[:, None] @ srgb_of_xyz().T


@functools.lru_cache(maxsize=64)
def _rgb_basis(grid: Grid) -> np.ndarray:
    table, fine = read_table("rgb_basis"), read_table("observer")["wavelengths"]
    curves = np.stack([np.interp(fine, table["wavelengths"], curve) for curve in table["values"]])
    mallett = band_averages(curves / curves.sum(axis=0), grid, fine)  # the table's sums differ from 1 by 1e-7
    if len(grid) < 3:
        return mallett
    to_rgb = _srgb_weights(grid)
    exact = np.linalg.pinv(mallett @ to_rgb) @ mallett
    exact -= (exact - mallett).mean(axis=0)  # already so where the lamp's white is exact: the rows go on adding up to 1
    return exact if exact.min() >= 0 and exact.max() <= 1 else _nearest_basis(mallett, to_rgb)


def _nearest_basis(start: np.ndarray, to_rgb: np.ndarray) -> np.ndarray:
    """The reflectances nearest to `start`, (3, L), with columns >= 0 that add up to 1, and B to_rgb = 1.

    Where there are none such, those with the least error of it, near to them.

    minimise |B - start|^2 / 2 + weight |1 - B A + P / weight|^2 / 2 over the columns' simplices, by its dual: for
    multipliers Y (3, 3) each column of B is that of start + Y A^T brought onto the simplex, and Newton's method finds
    the nine numbers. P, the multipliers so far, takes the rest of the error away (method of multipliers).
    """
    unit, multipliers, before = np.eye(3), np.zeros((3, 3)), np.zeros((3, 3))
    weight, found = 1e5, []

    def at(now: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        basis = _on_simplex(start + now @ to_rgb.T)
        missing = unit - basis @ to_rgb
        dual = 0.5 * ((basis - start) ** 2).sum() + (now * missing).sum() - ((now - before) ** 2).sum() / (2 * weight)
        return basis, missing, dual

    for power in range(5, 20):
        weight, before = 10.0 ** min(power, 10), multipliers  # what is barely possible needs more of it
        basis, missing, dual = at(multipliers)
        for _ in range(60):
            slope = missing - (multipliers - before) / weight
            free = (basis > 0).astype(float)
            moves = free[:, None] * unit[:, :, None] - free[:, None] * free / free.sum(axis=0)  # of each column
            hessian = np.einsum("abl,lk,lm->akbm", moves, to_rgb, to_rgb).reshape(9, 9) + np.eye(9) / weight
            step = np.linalg.solve(hessian, slope.ravel()).reshape(3, 3)
            rise, length = (slope * step).sum(), 1.0
            floor = dual - 1e-14 * max(1.0, abs(dual))  # of rounding
            while length > 1e-6 and at(multipliers + length * step)[2] < floor + 1e-4 * length * rise:
                length /= 2
            if length <= 1e-6 or np.abs(slope).max() < 2e-16:
                break
            multipliers = multipliers + length * step
            basis, missing, dual = at(multipliers)
        found.append((float(np.abs(missing).max()), basis))
        if found[-1][0] < 4e-16:
            break
    error, nearest = min(found, key=lambda pair: pair[0])
    return nearest if error < 1e-7 else found[0][1]


def _on_simplex(columns: np.ndarray) -> np.ndarray:
    """The nearest columns with entries >= 0 that add up to 1."""
    falling = -np.sort(-columns, axis=0)
    excess = (falling.cumsum(axis=0) - 1) / np.arange(1, len(columns) + 1)[:, None]
    kept = (falling > excess).sum(axis=0)
    return np.maximum(columns - excess[kept - 1, np.arange(columns.shape[1])], 0)


@functools.lru_cache(maxsize=64)
def _rgb_error(grid: Grid) -> float:
    rgb = np.stack(np.meshgrid(*[np.linspace(0, 1, 9)] * 3), axis=-1).reshape(-1, 3)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    back = (linear @ _rgb_basis(grid) @ _srgb_weights(grid)).clip(0, 1)
    return float(np.abs(np.where(back <= 0.0031308, 12.92 * back, 1.055 * back ** (1 / 2.4) - 0.055) - rgb).max())
