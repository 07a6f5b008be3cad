"""Light: CIE's illuminants and measured lamps, on bands."""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

from kcam.spectral.bands import Grid, band_averages, band_grid, read_table
from kcam.spectral.curves import SpectralTable, rising
from kcam.spectral.measured import matching_integrals, observer
from kcam.units import nm


def illuminant(light: str | Tensor | SpectralTable, *, wavelengths: Tensor) -> Tensor:
    """The spectrum of the light on a perfect white, per band, relative: the white has Y = 1.

    E_l = average of the lamp over the triangle between band l's neighbours, then adjusted by the smallest relative
    amount that gives the lamp's own white point on these bands: by at most 0.04 % for D65, 2 % for a sodium lamp, with
    the 28 default bands. (Samples at the bands would make the white of a fluorescent tube wrong by 7 delta-E2000, of
    the sodium lamp by 14.) No band changes by more than 90 %; more is wanted only where bands miss much of the light.

    Args:      light: a name in `illuminant_names()`, CIE's; a lamp that was measured, a table of one column such as
               `read_csv` gives, dark outside of it; or a relative power per band (L,), which is only scaled.
               wavelengths: (L,) [m].
    Returns:   (L,) float64; all ones for "E", equal energy.
    Raises:    ValueError for an unknown name, or a power that is negative, not finite, all zero or of another length;
               TypeError for neither a name nor a tensor.
    Source:    CIE 15 tables in steps of 5 nm, linear between; constant beyond their ends, as in ASTM E308.

    Example:
    >>> wavelengths = kcam.units.wavelength_grid()
    >>> red, blue = (spectral.illuminant("A", wavelengths=wavelengths)[band] for band in (-1, 0))
    >>> round(float(red / blue))  # a filament is mostly red
    10
    """
    grid = band_grid(wavelengths)
    if isinstance(light, str):
        return torch.tensor(lamp_on_bands(light, grid))
    if isinstance(light, SpectralTable):
        return torch.tensor(_on_bands(*_measured_at_1nm(light, grid), grid))
    if not isinstance(light, Tensor):
        raise TypeError(
            f"illuminant must be a name such as 'D65', a tensor (L,) or a table of spectral.read_csv, got "
            f"{type(light).__name__}."
        )
    power = light.detach().double().cpu()
    if power.shape != (len(grid),):
        raise ValueError(f"illuminant has shape {tuple(power.shape)}, expected one value per band: ({len(grid)},).")
    _check_power(power)
    return power / (torch.tensor(matching_integrals(grid))[:, 1] @ power)


def illuminant_names() -> tuple[str, ...]:
    """The lights that `illuminant` knows by name.

    Example:
    >>> "D65" in spectral.illuminant_names(), len(spectral.illuminant_names())
    (True, 14)
    """
    return tuple(read_table("illuminants")["names"].tolist())


def _check_power(power: Tensor) -> None:
    if not (power.isfinite().all() and (power >= 0).all() and power.any()):
        raise ValueError(f"illuminant must be finite, >= 0 and not all zero, got {power.min():g} to {power.max():g}.")


def lamp_at_1nm(name: str) -> np.ndarray:
    """A lamp by name at the observer's wavelengths."""
    table, names = read_table("illuminants"), illuminant_names()
    if name not in names:
        raise ValueError(f"unknown illuminant {name!r}. There are: {', '.join(names)}; or give a tensor (L,).")
    return np.interp(read_table("observer")["wavelengths"], table["wavelengths"], table["values"][names.index(name)])


def _measured_at_1nm(light: SpectralTable, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """A lamp of a table in steps of 1 nm that reach over the eye's and all bands: mean powers, and where [nm]."""
    if len(light.values) != 1:
        raise ValueError(
            f"an illuminant has one column, and this table {len(light.values)} ({', '.join(light.names)}). Take one: "
            "table._replace(values=table.values[:1], names=table.names[:1])."
        )
    nodes, measured = rising(light.wavelengths).numpy() / nm, light.values[0].detach().double().cpu()
    _check_power(measured)
    power = measured.numpy()
    eye = read_table("observer")["wavelengths"]
    fine = np.arange(min(eye[0], math.floor(min(grid) - 50)), max(eye[-1], math.ceil(max(grid) + 50)) + 1)
    area = np.concatenate([[0.0], np.cumsum(np.diff(nodes) * (power[1:] + power[:-1]) / 2)])

    def integral(ends: np.ndarray) -> np.ndarray:
        ends = np.clip(ends, nodes[0], nodes[-1])
        before = np.clip(np.searchsorted(nodes, ends, side="right") - 1, 0, len(nodes) - 2)
        step = ends - nodes[before]
        slope = np.diff(power)[before] / np.diff(nodes)[before]
        return area[before] + step * (power[before] + slope * step / 2)

    return integral(fine + 0.5) - integral(fine - 0.5), fine


@functools.lru_cache(maxsize=64)
def lamp_on_bands(name: str, grid: Grid) -> np.ndarray:
    """`illuminant` of a lamp by name, cached."""
    return _on_bands(lamp_at_1nm(name), read_table("observer")["wavelengths"], grid)


def _on_bands(lamp: np.ndarray, fine: np.ndarray, grid: Grid) -> np.ndarray:
    """The power of a lamp, in steps of 1 nm, on bands."""
    matching_1nm = observer(torch.tensor(fine) * nm).numpy()
    matching = matching_integrals(grid)
    power = band_averages(lamp, grid, fine)
    if not (lamp @ matching_1nm[:, 1] > 0 and power @ matching[:, 1] > 0):
        raise ValueError(
            "the illuminant has no light that the eye sees, or none on these bands, so its white has no luminance. "
            "Give a relative power per band (L,) with some in 360..830 nm."
        )
    white = lamp @ matching_1nm / (lamp @ matching_1nm[:, 1])
    power = power / (power @ matching[:, 1])
    relative = power[:, None] * matching  # d XYZ by a relative change of each band; least squares keeps it small
    change = np.linalg.lstsq(relative.T, white - relative.sum(axis=0), rcond=None)[0]
    power = power * (1 + change * min(1.0, 0.9 / max(np.abs(change).max(), 1e-300)))
    return power / (power @ matching[:, 1])
