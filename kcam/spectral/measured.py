"""What was measured: the eye's colour matching functions, the patches of a colour chart, sensitivities of cameras."""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

from kcam.spectral.bands import Grid, band_grid, cubic_weights, read_table
from kcam.units import nm

SENSITIVITIES = ("kodak", "nikon_5100", "sigma_sd_merrill")
"""The cameras that `sensitivity` knows."""


def observer(wavelengths: Tensor) -> Tensor:
    """The CIE 1931 2 degree colour matching functions xbar, ybar, zbar at the given wavelengths.

    Args:      wavelengths: (L,) [m].
    Returns:   (L, 3) float64, linear between the table's steps of 1 nm, 0 outside 360..830 nm.

    Example:
    >>> wavelengths = torch.arange(500, 601).double() * nm
    >>> round(float(wavelengths[spectral.observer(wavelengths)[:, 1].argmax()]) / nm)  # the eye sees green best
    555
    """
    table = read_table("observer")
    points = np.array(band_grid(wavelengths))
    curves = [np.interp(points, table["wavelengths"], curve, left=0, right=0) for curve in table["values"].T]
    return torch.tensor(np.stack(curves, axis=1))


@functools.lru_cache(maxsize=64)
def matching_integrals(grid: Grid) -> np.ndarray:
    """(L, 3): the integrals over the colour matching functions in `xyz_weights`."""
    table = read_table("observer")
    return cubic_weights(np.array(grid), table["wavelengths"]) @ table["values"] / table["values"][:, 1].sum()


def colour_chart() -> tuple[tuple[str, ...], Tensor, Tensor]:
    """The 24 patches of the ColorChecker as measured: names, wavelengths (36,) [m], reflectances (24, 36).

    Row by row, dark skin first. Source: BabelColor, average of 30 charts, through colour-science.

    Example:
    >>> names, wavelengths, values = spectral.colour_chart()
    >>> len(names), names[0], tuple(values.shape)
    (24, 'dark skin', (24, 36))
    """
    table = read_table("colour_chart")
    return tuple(table["names"].tolist()), torch.tensor(table["wavelengths"]) * nm, torch.tensor(table["values"])


def reflectances(wavelengths: Tensor) -> Tensor:
    """The 24 patches' reflectances at the given wavelengths, (24, L) float64.

    Cubic between the measurements, which are 10 nm apart; constant beyond 380..730 nm.

    Example:
    >>> red = spectral.colour_chart()[0].index("red")
    >>> [round(float(share), 2) for share in spectral.reflectances(torch.tensor([450.0, 650.0]) * nm)[red]]
    [0.05, 0.68]
    """
    table = read_table("colour_chart")
    return torch.tensor(table["values"] @ cubic_weights(table["wavelengths"], np.array(band_grid(wavelengths))))


def sensitivity(name: str, *, wavelengths: Tensor) -> Tensor:
    """Spectral sensitivities of a camera's red, green and blue pixels, per unit of energy.

    Args:      name: "nikon_5100" and "sigma_sd_merrill", measured with their infrared cut, each channel peaking at 1;
               or "kodak", a smooth approximation without infrared cut, not a measurement: sums of Gaussians whose peak
               places and heights are those of Kodak's interline CCD data sheets (see tools/make_tables.py).
               wavelengths: (L,) [m].
    Returns:   (3, L) float64, green peaking at 1; linear between the steps of the table (5 or 10 nm), 0 outside it.
    Raises:    ValueError for an unknown name.
    Source:    Darrodi et al., Reference data set for camera spectral sensitivity estimation, JOSA A 32 (2015) 381.

    Example:
    >>> wavelengths = torch.arange(400, 701, 10).double() * nm
    >>> curves = spectral.sensitivity("nikon_5100", wavelengths=wavelengths)
    >>> (wavelengths[curves.argmax(1)] / nm).round().tolist()  # red, green, blue
    [590.0, 530.0, 460.0]
    """
    if name not in SENSITIVITIES:
        raise ValueError(f"unknown sensitivity {name!r}. There are: {', '.join(SENSITIVITIES)}.")
    table, points = read_table(f"sensitivity_{name}"), np.array(band_grid(wavelengths))
    curves = [np.interp(points, table["wavelengths"], curve, left=0, right=0) for curve in table["values"]]
    return torch.tensor(np.stack(curves))
