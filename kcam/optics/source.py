"""What a picture asks of optics: PSFs of points of the scene on a sensor's pixels, whoever knows them.

    bank (N, L, h, w) of N source points, at L wavelengths, on pixels h x w

`optics.Lens` computes them, `optics.MeasuredPSF` has them from elsewhere, and `optics.Imaging` takes anything that
follows the protocol here.
"""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any, Protocol, TypeGuard

import torch
from torch import Tensor

from kcam.context import Photometric

_CPU = torch.device("cpu")


@dataclass(frozen=True)
class Points:
    """Where the light of a bank comes from: N points.

    vergences: (N,) float64, 1 / distance [1/m], 0 for infinity; may carry gradients.
    positions: (N, 2), where the light falls on the sensor, x and y from its middle [m], +x right and +y down; None for
        points on the axis.
    """

    vergences: Tensor
    positions: Tensor | None = None


@dataclass(frozen=True)
class PixelGrid:
    """The pixels that a PSF fills: its window on the sensor; index n // 2 is the origin.

    pitch [m]. shape: (h, w). fill_factor: light-sensitive share of a pixel. integrate: over that share; False takes
    the value at the centre. dtype, device: of the bank.
    Raises: ValueError for a shape that is not two positive integers, a fill factor outside (0, 1], a dtype other than
        float32 and float64.
    """

    pitch: float
    shape: tuple[int, int]
    fill_factor: float = 1.0
    integrate: bool = True
    dtype: torch.dtype = torch.float32
    device: torch.device = _CPU

    def __post_init__(self) -> None:
        shape, dtype = self.shape, self.dtype
        if not isinstance(shape, Sequence) or len(shape) != 2 or not all(map(is_count, shape)):
            fix = f" Use shape=({shape}, {shape})." if is_count(shape) else ""
            raise ValueError(f"shape must be two positive integers (H, W) in pixels, got {shape!r}.{fix}")
        if not 0 < self.fill_factor <= 1:
            raise ValueError(
                f"fill_factor {self.fill_factor:g} must be in (0, 1]: the light-sensitive share of a pixel."
            )
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype}; cast the result instead.")
        plain = {"pitch": float(self.pitch), "shape": (int(shape[0]), int(shape[1]))}
        vars(self).update(plain, fill_factor=float(self.fill_factor))

    @property
    def active(self) -> float:
        """Width of the light-sensitive part of a pixel, in pixels."""
        return math.sqrt(self.fill_factor)


def is_count(value: object) -> bool:
    """Whether it is a whole number of 1 or more."""
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= 1


@dataclass(frozen=True)
class Defocus:
    """How far optics send light that is out of focus, in pixels: floor + spread |V - focus|.

    focus: the vergences in focus of the shortest and the longest wavelengths [1/m]. spread [m]. floor: of what is in
    focus, with aberrations, DOEs and diffraction.
    """

    focus: tuple[float, float] = (0.0, 0.0)
    spread: float = 0.0
    floor: float = 0.0

    def radius(self, vergence: Tensor) -> Tensor:
        """Radius of the blur of what lies at a vergence [pixels]."""
        low, high = self.focus
        return self.floor + self.spread * torch.maximum((vergence - low).abs(), (vergence - high).abs())


class PSFSource(Photometric, Protocol):
    """Optics, as `Imaging` asks them; an nn.Module where it trains. To be saved, it keeps its arguments.

    One that has PSFs at some vergences alone may say so, `vergences` (Z,) ascending [1/m]: layers of depth lie there.
    One that has them at places of the sensor says `positions` (F, 2) [m]: pixels between are shared out among these.
    """

    @property
    def focus_distance(self) -> float | None:
        """Where a tensor without a distance is put [m]; None where that is not known."""

    def bank(self, points: Points, wavelengths: Tensor, pixels: PixelGrid) -> Tensor:
        """Energy in each pixel (N, L, h, w), >= 0, relative to what passes the optics, as light falls: not turned.

        Whatever the fill factor, a bank sums to the share of the light in its window. wavelengths: (L,) float64 [m].
        """

    def window(self, points: Points, wavelengths: Tensor, pixels: PixelGrid) -> tuple[int, int]:
        """The window (h, w) that holds all but 0.1 % of the light; `pixels.shape` does not count."""

    def defocus_waves(self, wavelengths: Tensor) -> float:
        """Waves of defocus at the rim for each unit of vergence, at most [m]: how finely depth is cut into layers."""

    def defocus(self, wavelengths: Tensor, pixel_pitch: float) -> Defocus:
        """How far light is spread, for a planner."""


class FieldPSFs(Protocol):
    """PSFs over the sensor, of points at some vergences (Z,) and wavelengths (L,)."""

    def bank(
        self,
        places: Tensor,
        pixels: PixelGrid,
        *,
        whole: bool = False,
        mixing: Tensor | None = None,
        colours: float = math.inf,
    ) -> Tensor:
        """PSFs (F, Z, L, h, w) of what the chief ray of the focus brings to places (F, 2) [m], as light falls; relative
        to the light of a point on the axis. The window's middle is that place.

        whole: light outside is put back. mixing: weights (M, L) of sums that stand instead, (F, Z, M, h, w). colours:
        at how many wavelengths PSFs are computed, at most, between which they are polynomials.
        """

    @property
    def fewer_colours(self) -> tuple[int, ...]:
        """How many wavelengths may stand for all, ascending."""

    @property
    def held(self) -> int:
        """Bytes of the PSFs that are kept."""

    @property
    def mirrored(self) -> bool:
        """Whether PSFs of places that mirror each other in x or y do so too."""

    def window(self, pixels: PixelGrid) -> tuple[int, int]:
        """The window (h, w) that holds all but 0.5 % of the light of any place; `pixels.shape` does not count."""

    def undistorted(self, places: Tensor) -> Tensor:
        """Where a lens without distortion would bring what falls at places (..., 2) [m]."""

    def illumination(self, places: Tensor) -> Tensor:
        """About the irradiance of an even scene at places (..., 2) [m], over that on the axis: a smooth curve > 0."""

    def points(self, pixels: PixelGrid) -> float:
        """Points of the transforms that one PSF takes, about: for a planner."""

    def at_wavelengths(self, wavelengths: Tensor, *, lateral_colour: bool = True) -> FieldPSFs:
        """Of others (L,) [m] in the same range; without `lateral_colour` all fall where the middle one does."""

    def at_vergences(self, vergences: Tensor) -> FieldPSFs:
        """Of others (Z,) [1/m] in the same range."""

    def deviations(self, pixels: PixelGrid, *, colours: float = math.inf) -> dict[str, float]:
        """What PSFs of so many colours may be off by, of their light: pupils, sampling, outside; see
        `field.FieldEstimate`.
        """


class FieldSource(PSFSource, Protocol):
    """Optics whose PSF varies over the sensor, computed for any place.

    varies: whether a picture does so unless `Imaging` is told.
    """

    varies: bool

    def over_field(self, reach: float, vergences: Tensor, wavelengths: Tensor) -> FieldPSFs:
        """For places up to `reach` from the axis [m], points at vergences (Z,) [1/m], wavelengths (L,) [m]."""


def is_source(thing: Any) -> TypeGuard[PSFSource]:
    """Whether `Imaging` can take its picture through a thing.

    Example:
    >>> from kcam.optics.source import is_source
    >>> is_source(optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(50 * mm), focus_distance=2.0))
    True
    >>> is_source("a lens")
    False
    """
    return _follows(thing, PSFSource)


def is_field_source(thing: Any) -> TypeGuard[FieldSource]:
    """Whether a thing's PSF may vary over the sensor.

    Example:
    >>> from kcam.optics.source import is_field_source
    >>> is_field_source(optics.CompoundLens.preset("phone"))
    True
    """
    return _follows(thing, FieldSource)


def _follows(thing: Any, protocol: Any) -> bool:
    """Whether it has all that is asked for; isinstance overlooks, from Python 3.12 on, what trains."""
    return all(hasattr(type(thing), name) or hasattr(thing, name) for name in _asked_by(protocol))


@functools.cache
def _asked_by(protocol: Any) -> tuple[str, ...]:
    parts = [part for part in protocol.__mro__ if getattr(part, "_is_protocol", False)]
    names = {name for part in parts for name in (*vars(part), *inspect.get_annotations(part))}
    return tuple(sorted(name for name in names if not name.startswith("_")))
