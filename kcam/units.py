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
import warnings
from typing import Any

import torch
from torch import Tensor

nm = 1e-9
um = 1e-6
mm = 1e-3
cm = 1e-2

WAVELENGTH_RANGE = (1e-7, 2e-5)
PIXEL_PITCH_RANGE = (1e-7, 1e-3)
DOE_PITCH_RANGE = (1e-8, 5e-2)
FAR = 300.0
"""Metres from which a depth without anything nearer is warned of: in millimetres it would be 0.3 m."""
IMAGE_SIDE_RANGE = (1e-5, 2.0)
"""Of a focal length, or of a pupil from the sensor, that is given without a lens [m]: in millimetres it is outside."""
LEAST_DISTANCE = 1e-7
"""Of an object, and of a focal length [m]: the shortest wavelength; far below, powers of 1 / distance overflow."""


def wavelength_grid(wavelengths: Tensor | list[float] | None = None, *, count: int = 28) -> Tensor:
    """Wavelengths as a checked float64 vector on the CPU; by default `count` of them from 420 to 720 nm.

    Args:      wavelengths: (L,) [m], in any order; None for the default grid.
    Returns:   (L,) float64 [m].
    Raises:    ValueError for an empty or nested list, or a value outside 1e-7..2e-5 m; TypeError for what is no number.

    Example:
    >>> from kcam.units import wavelength_grid
    >>> wavelength_grid().shape
    torch.Size([28])
    >>> wavelength_grid([550])
    Traceback (most recent call last):
    ValueError: wavelength 550 is outside 1e-07..2e-05 m. Wavelengths are in metres; did you mean 550 * nm?
    """
    if wavelengths is None:
        return torch.linspace(420, 720, count, dtype=torch.float64) * nm
    expected = "numbers of metres such as [450 * nm, 550 * nm]"
    grid = as_numbers(wavelengths, name="wavelengths", expected=expected).detach().cpu()
    if grid.ndim == 0:
        grid = grid[None]
    if grid.ndim != 1 or grid.numel() == 0:
        raise ValueError(f"wavelengths must be a vector (L,) with L >= 1, got shape {tuple(grid.shape)}.")
    low, high = WAVELENGTH_RANGE
    for value in grid.tolist():
        if not low <= value <= high:
            unit = "nm" if 100 <= value <= 20_000 else "um"
            raise ValueError(
                f"wavelength {value:g} is outside {low:g}..{high:g} m. Wavelengths are in metres"
                f"{_perhaps(value, unit, example='550 * nm')}"
            )
    return grid


def as_numbers(value: Any, *, name: str, expected: str) -> Tensor:
    """A number, a list or a tensor as float64; TypeError that says what was expected for anything else.

    Example:
    >>> from kcam.units import as_numbers
    >>> as_numbers([1, 2.5], name="distances", expected="numbers of metres")
    tensor([1.0000, 2.5000], dtype=torch.float64)
    """
    try:
        if isinstance(value, bool):
            raise TypeError("a flag is no number")
        return torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        fix = " Write a number, not text." if isinstance(value, str) else ""
        raise TypeError(f"{name} must be {expected}, got {value!r}.{fix}") from error


def _perhaps(value: float, unit: str, *, example: str) -> str:
    """What a length of the wrong scale was probably meant to be; an example where it can be nothing."""
    return f"; did you mean {value:g} * {unit}?" if 0 < value < math.inf else f", such as {example}."


def _unit_of(value: float, *, within: tuple[float, float], example: str) -> str:
    """In which unit a length was probably meant: of what is given in millimetres those, if it can be."""
    low, high = within
    if example.endswith("* mm") and low <= value * mm <= high:
        return "mm"
    return "nm" if value >= 100 else "um"


def check_length(value: Tensor | float, *, name: str, within: tuple[float, float], example: str) -> float:
    """A length in metres; ValueError that names the likely mistake outside a range, TypeError for what is no number.

    Example:
    >>> from kcam.units import check_length
    >>> check_length(4 * um, name="pixel_pitch", within=(1e-7, 1e-3), example="4 * um")
    4e-06
    >>> check_length(4, name="pixel_pitch", within=(1e-7, 1e-3), example="4 * um")
    Traceback (most recent call last):
    ValueError: pixel_pitch 4 is outside 1e-07..0.001 m. Lengths are in metres; did you mean 4 * um?
    """
    expected = f"a number of metres such as {example}"
    number = as_numbers(value, name=name, expected=expected).detach()
    if number.numel() != 1:
        raise TypeError(f"{name} must be {expected}, got {number.numel()} of them.")
    metres, (low, high) = number.item(), within
    if not low <= metres <= high:
        raise ValueError(
            f"{name} {metres:g} is outside {low:g}..{high:g} m. Lengths are in metres"
            f"{_perhaps(metres, _unit_of(metres, within=within, example=example), example=example)}"
        )
    return metres


def percent_hint(value: float) -> str:
    """What a share above 1 was probably meant to be.

    Example:
    >>> from kcam.units import percent_hint
    >>> percent_hint(30)
    ' It is a share, not percent; did you mean 0.3?'
    """
    return f" It is a share, not percent; did you mean {value / 100:g}?" if 1 < value <= 100 else ""


def check_flag(value: Any, *, name: str) -> None:
    """TypeError unless it is True or False: any text is true, "no" as well.

    Example:
    >>> from kcam.units import check_flag
    >>> check_flag("no", name="rounding")
    Traceback (most recent call last):
    TypeError: rounding must be True or False, got 'no'.
    """
    if not isinstance(value, bool):
        raise TypeError(f"{name} must be True or False, got {value!r}.")


def check_pixel_pitch(pitch: float) -> float:
    """A pixel pitch in metres, 0.1 um to 1 mm; errors as `check_length`.

    Example:
    >>> from kcam.units import check_pixel_pitch
    >>> check_pixel_pitch(4)
    Traceback (most recent call last):
    ValueError: pixel_pitch 4 is outside 1e-07..0.001 m. Lengths are in metres; did you mean 4 * um?
    """
    return check_length(pitch, name="pixel_pitch", within=PIXEL_PITCH_RANGE, example="4 * um")


def check_distances(distance: Tensor | float, *, name: str = "distance") -> Tensor:
    """Object distances in metres as float64, each > 0 or inf.

    Raises:    ValueError for zero, negative, NaN, or nearer than 1e-7 m; TypeError for what is no number.

    Example:
    >>> from kcam.units import check_distances
    >>> check_distances([0.5, float("inf")])
    tensor([0.5000,    inf], dtype=torch.float64)
    >>> check_distances(0.0)
    Traceback (most recent call last):
    ValueError: distance 0 is not a distance in front of the lens: expected metres > 0, ...
    """
    values = as_numbers(distance, name=name, expected="a number of metres such as 2.0")
    if bool((values >= LEAST_DISTANCE).all()):
        return values
    bad = ~(values > 0)
    if bad.any():
        raise ValueError(
            f"{name} {values[bad].flatten()[0].item():g} is not a distance in front of the lens: expected metres > 0, "
            "or float('inf') for infinity."
        )
    raise ValueError(f"{name} {values.min().item():g} is too near: expected metres >= {LEAST_DISTANCE:g}, such as 2.0.")


def warn_of_millimetres(depth: Tensor | float) -> None:
    """UserWarning where the nearest finite depth is 300 m or more: it was probably meant in millimetres.

    Example:
    >>> import warnings
    >>> from kcam.units import warn_of_millimetres
    >>> with warnings.catch_warnings(record=True, action="always") as said:
    ...     warn_of_millimetres(2000.0)
    >>> print(said[0].message)
    depth 2000 m: depths are in metres; did you mean 2000 * mm? ...
    """
    values = torch.as_tensor(depth).detach()
    nearest = float(torch.where(values.isfinite(), values, math.inf).amin()) if values.numel() else math.inf
    if FAR <= nearest < math.inf:
        warnings.warn(
            f"depth {nearest:g} m: depths are in metres; did you mean {nearest:g} * mm? For what is that far away, "
            "float('inf') looks the same and does not warn.",
            stacklevel=4,
        )


def check_trained(value: Tensor, *, name: str) -> None:
    """ValueError where an optimiser's step or a loaded file brought NaN or infinity in.

    Example:
    >>> from kcam.units import check_trained
    >>> check_trained(torch.tensor([1.0, math.nan]), name="phase")
    Traceback (most recent call last):
    ValueError: phase has 1 values that are NaN or infinite; ...
    """
    value = value.detach()
    if bool(value.sum().isfinite()):  # at every use of a lens: one pass, without a copy
        return
    bad = int((~torch.isfinite(value)).sum())
    if bad:
        raise ValueError(
            f"{name} has {bad} values that are NaN or infinite; expected finite ones everywhere. Load values from "
            "before they were lost, and train with a smaller step."
        )


def check_positive(value: Tensor | float, *, name: str, unit: str = "m") -> None:
    """ValueError unless every element of `value` is finite and > 0; TypeError for what is no number.

    Example:
    >>> from kcam.units import check_positive
    >>> check_positive(-1.0, name="sensor_distance")
    Traceback (most recent call last):
    ValueError: sensor_distance must be finite and > 0 m, got -1.
    """
    plain = type(value) in (float, int)  # at every use of a lens
    number = value if plain else float(as_numbers(value, name=name, expected=f"a number > 0 {unit}").detach().min())
    if not (number > 0 and math.isfinite(number)):
        raise ValueError(f"{name} must be finite and > 0 {unit}, got {number:g}.")
