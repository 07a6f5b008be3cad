"""What a lens file holds, and how its numbers become ours: exactly, as decimals."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Literal, NotRequired, TypedDict

import torch
from torch import Tensor

from kcam.optics.compound.prescription import Prescription, indices_at
from kcam.optics.compound.surface import Surface
from kcam.optics.compound.tracing import system_matrix
from kcam.optics.elements.materials import Glass
from kcam.optics.numerics import float64

_NUMBER = re.compile(r"[+-]?(\d{1,40}\.?\d{0,40}|\.\d{1,40})([eEdD][+-]?\d{1,3})?")
DEFAULT_WAVELENGTH = 550e-9
"""Of focus, where a file names none [m]."""


class SurfaceArguments(TypedDict):
    """As of `Surface`, without the stop."""

    radius: float
    thickness: float
    glass: str | float | Glass | None
    semi_diameter: float | None
    conic: NotRequired[float]
    asphere2: NotRequired[float]
    asphere: NotRequired[tuple[float, ...]]
    odd_asphere: NotRequired[tuple[float, ...]]


@dataclass(frozen=True)
class Aperture:
    """What bounds the light of the whole lens: the diameter of the entrance pupil or the stop [m], or the focal length
    over that of the entrance pupil.
    """

    kind: Literal["entrance pupil", "stop", "f-number"]
    value: float


def number(text: str) -> Decimal:
    """A decimal number. Raises: ValueError for other text, NaN and infinities among it."""
    if _NUMBER.fullmatch(text) is None:
        raise ValueError(f"{text!r} is no number")
    return Decimal(text.upper().replace("D", "E"))


def finite(value: Decimal) -> float:
    """Raises: ValueError for what no float holds."""
    found = float(value)
    if math.isinf(found):
        raise ValueError(f"{value} is too large")
    return found


def decimal(value: Tensor | float) -> Decimal:
    """A number of ours to the last bit: its shortest decimals."""
    return Decimal(repr(float(float64(value).detach())))


def inverse(value: Decimal) -> Decimal:
    """1 / value, where 0 and infinity are each other's: a plane's curvature and radius."""
    if value.is_infinite():
        return Decimal(0)
    return 1 / value if value else Decimal("inf")


def terms(surface: Surface) -> dict[int, Decimal]:
    """Coefficients of r^n that are not 0 [m^(1 - n)], by their power n."""
    found = {2: decimal(surface.asphere2)}
    for first, name in ((4, "asphere"), (1, "odd_asphere")):
        values = torch.as_tensor(getattr(surface, name), dtype=torch.float64).detach().tolist()
        found |= {first + 2 * index: decimal(value) for index, value in enumerate(values)}
    return {power: value for power, value in sorted(found.items()) if value}


def asphere_arguments(coefficients: dict[int, float]) -> dict[str, object]:
    """`Surface`'s arguments for sum_n A_n r^n, given by n >= 1 [m^(1 - n)]."""
    found: dict[str, object] = {}
    if 2 in coefficients:
        found["asphere2"] = coefficients[2]
    for name, first in (("asphere", 4), ("odd_asphere", 1)):
        powers = [power for power in coefficients if power >= first and (power - first) % 2 == 0]
        if powers:
            found[name] = tuple(coefficients.get(power, 0.0) for power in range(first, max(powers) + 1, 2))
    return found


def refusal(name: str, place: str, reason: str) -> ValueError:
    """What is wrong with a file of this name, and at which place in it."""
    end = "" if reason.endswith(("?", ".")) else "."
    return ValueError(f"{name}{place and ', '}{place}: {reason}{end}")


@dataclass(frozen=True)
class Found:
    """A surface in a file: its arguments, and the words that name its place in an error."""

    arguments: SurfaceArguments
    place: str


def build(
    found: Sequence[Found],
    *,
    stop: int,
    aperture: Aperture | None,
    focus_wavelength: float,
    error: Callable[[str, str], ValueError],
) -> Prescription:
    """The lens, the last surface's thickness the sensor's distance, and the stop's semi-diameter the smaller one of its
    own and of what fills the aperture.

    error: makes the exception from a place and a reason. Raises: what it makes, for a surface that cannot be, and a
        stop without a size.
    """

    def made(item: Found, *, stop: bool) -> Surface:
        try:
            return Surface(**item.arguments, stop=stop)
        except (ValueError, TypeError) as reason:
            raise error(item.place, str(reason)) from None

    distance = found[-1].arguments["thickness"]
    found = [*found[:-1], Found(found[-1].arguments | {"thickness": 0.0}, found[-1].place)]
    surfaces = [made(item, stop=False) for item in found]
    own = found[stop].arguments["semi_diameter"]
    if aperture is not None:
        try:
            filled = _stop_of(surfaces, stop, aperture, focus_wavelength)
        except ValueError as reason:
            raise error(found[stop].place, str(reason)) from None
        own = filled if own is None else min(own, filled)
    if own is None:
        raise error(found[stop].place, "the stop has no semi-diameter, and the file no aperture that gives it one")
    resized = Found(found[stop].arguments | {"semi_diameter": own}, found[stop].place)
    surfaces[stop] = made(resized, stop=True)
    return Prescription(surfaces, distance, focus_wavelength)


def _stop_of(surfaces: Sequence[Surface], stop: int, aperture: Aperture, wavelength: float) -> float:
    """Semi-diameter of a stop that an aperture fills, paraxially [m]."""
    if aperture.kind == "stop":
        return aperture.value / 2
    indices = indices_at(surfaces, wavelength)
    diameter = aperture.value
    if aperture.kind == "f-number":
        power = -float(system_matrix(surfaces, indices)[1, 0])
        if not (power and aperture.value > 0):
            raise ValueError(f"an f-number of {aperture.value:g} gives no aperture, with a power of {power:g} / m")
        diameter = 1 / abs(power * aperture.value)
    front = system_matrix(surfaces[: stop + 1], indices, refract_last=False)
    return diameter / 2 * abs(float(front[0, 0]))
