"""Units, signs, axes and centring: the conventions of the whole package, and the guards of its physical entries.

**Units.** Everything inside kcam is SI: metres, seconds, radians, cd/m^2. Multiply where you call: ``550 * nm``.
*Phase* is in radians, *OPD* (optical path difference) in metres.

**Signs** (Goodman). Time factor exp(-i omega t): light that travels along +z gains exp(+ikz), a longer path (a delay)
is a positive OPD, and a thin lens is exp(-i k r^2 / 2f). A diverging source adds +V r^2 / 2 with the vergence
V = 1 / distance, which is 0 at infinity.

**Axes.** Tensors are (batch, channel, row, column). +x points right along the columns, +y down the rows. An OPD that
rises towards +x moves the PSF towards +x on the sensor; the picture is shown upright, so that in the picture the PSF
is turned by 180 degrees.

**Centring.** On an axis of n samples the origin is at index n // 2, for even and odd n.

**Signal.** Before the ADC 1.0 is the full well; after it 1.0 is full scale.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

nm = 1e-9
um = 1e-6
mm = 1e-3
cm = 1e-2

WAVELENGTH_RANGE = (1e-7, 2e-5)
PIXEL_PITCH_RANGE = (1e-7, 1e-3)


def wavelength_grid(wavelengths: Tensor | list[float] | None = None, *, count: int = 28) -> Tensor:
    """Wavelengths as a checked float64 vector on the CPU; by default `count` of them from 420 to 720 nm.

    Args:      wavelengths: (L,) [m], in any order; None for the default grid.
    Returns:   (L,) float64 [m].
    Raises:    ValueError for an empty or nested list, or a value outside 1e-7..2e-5 m.
    """
    if wavelengths is None:
        return torch.linspace(420, 720, count, dtype=torch.float64) * nm
    grid = torch.as_tensor(wavelengths, dtype=torch.float64).detach().cpu()
    if grid.ndim == 0:
        grid = grid[None]
    if grid.ndim != 1 or grid.numel() == 0:
        raise ValueError(f"wavelengths must be a vector (L,) with L >= 1, got shape {tuple(grid.shape)}.")
    low, high = WAVELENGTH_RANGE
    for value in grid.tolist():
        if not low <= value <= high:
            scale = "nm" if 100 <= value <= 20_000 else "um"
            raise ValueError(
                f"wavelength {value:g} is outside {low:g}..{high:g} m. Wavelengths are in metres; "
                f"did you mean {value:g} * {scale}?"
            )
    return grid


def check_pixel_pitch(pitch: float) -> float:
    """A pixel pitch in metres, 0.1 um to 1 mm; ValueError that names the likely mistake otherwise."""
    low, high = PIXEL_PITCH_RANGE
    if not low <= float(pitch) <= high:
        raise ValueError(
            f"pixel_pitch {float(pitch):g} is outside {low:g}..{high:g} m. Lengths are in metres; "
            f"did you mean {float(pitch):g} * {'nm' if float(pitch) >= 100 else 'um'}?"
        )
    return float(pitch)


def check_distances(distance: Tensor | float, *, name: str = "distance") -> Tensor:
    """Object distances in metres as float64, each > 0 or inf; ValueError for zero, negative or NaN."""
    values = torch.as_tensor(distance, dtype=torch.float64)
    bad = ~(values > 0)
    if bad.any():
        raise ValueError(
            f"{name} {values[bad].flatten()[0].item():g} is not a distance in front of the lens: expected metres > 0, "
            "or float('inf') for infinity."
        )
    return values


def check_positive(value: Tensor | float, *, name: str, unit: str = "m") -> None:
    """ValueError unless every element of `value` is finite and > 0."""
    number = float(torch.as_tensor(value).detach().min()) if torch.is_tensor(value) else float(value)
    if not (number > 0 and math.isfinite(number)):
        raise ValueError(f"{name} must be finite and > 0 {unit}, got {number:g}.")
