"""Lenses of every kind of element, all of whose numbers train, from seeded draws."""

from __future__ import annotations

import torch
from draws import Draw
from golden.question import parameter
from torch import Tensor

from kcam import optics
from kcam.units import nm, um

GLASSES = ("N-BK7", "N-SF11", "fused silica", "CaF2", "N-LASF9", "F2", "sapphire", 1.62)


class Coma(optics.Element):
    """A user's own element: a path that tells x from -x."""

    def __init__(self, height: Tensor) -> None:
        super().__init__()
        self.height = height

    def terms(self, pupil, wavelengths):
        return [(torch.ones_like(wavelengths), self.height.double() * (3 * pupil.rho2 - 2) * pupil.x)]


class Bowl(optics.Element):
    """A user's own element that promises symmetry and smoothness."""

    symmetric, knots = True, ()

    def __init__(self, height: Tensor) -> None:
        super().__init__()
        self.height = height

    def terms(self, pupil, wavelengths):
        return [(torch.ones_like(wavelengths), self.height.double() * pupil.rho2**2)]


def round_stop(draw: Draw, width: float, dtype: torch.dtype) -> optics.Element:
    return optics.CircularAperture(parameter(width, dtype))


def fixed_stop(draw: Draw, width: float, dtype: torch.dtype) -> optics.Element:
    return optics.CircularAperture(width)


def annulus(draw: Draw, width: float, dtype: torch.dtype) -> optics.Element:
    return optics.AnnularAperture(parameter(width, dtype), obscuration=draw.number(0.2, 0.6))


def square(draw: Draw, width: float, dtype: torch.dtype) -> optics.Element:
    return optics.SquareAperture(parameter(width, dtype))


def coded(draw: Draw, width: float, dtype: torch.dtype) -> optics.Element:
    side = draw.one_of(5, 8)
    open_ = (draw.noise(side, side) > 0.4) * draw.noise(side, side)
    return optics.ApertureMap(parameter(open_, dtype), width=parameter(width, dtype))


def thin(draw: Draw, focal: float, dtype: torch.dtype) -> list[optics.Element]:
    return [optics.ThinLens(parameter(focal, dtype))]


def convex(draw: Draw, focal: float, dtype: torch.dtype) -> list[optics.Element]:
    return [optics.PlanoConvexLens(parameter(0.55 * focal, dtype), glass=draw.one_of(*GLASSES))]


def two(draw: Draw, focal: float, dtype: torch.dtype) -> list[optics.Element]:
    glasses = draw.one_of("N-BK7", "N-FK51A"), draw.one_of("N-SF5", "N-SF6")
    return [
        optics.PlanoConvexLens(parameter(0.4 * focal, dtype), glass=glasses[0]),
        optics.ThinLens(parameter(-6 * focal, dtype)),
        optics.PlanoConvexLens(parameter(2.4 * focal, dtype), glass=glasses[1]),
    ]


def defocus(draw: Draw, width: float, dtype: torch.dtype) -> optics.Element:
    return optics.Defocus(parameter(draw.number(-1, 1) * 3 * 550 * nm / width**2, dtype))


def zernike(draw: Draw, width: float, dtype: torch.dtype) -> optics.Element:
    return optics.ZernikeAberration(parameter((draw.noise(11) - 0.5) * 200 * nm, dtype))


def zernike_doe(draw: Draw, width: float, dtype: torch.dtype) -> optics.Element:
    return optics.ZernikeDOE(parameter((draw.noise(8) - 0.5) * 3, dtype), design_wavelength=draw.number(500, 600) * nm)


def doe(draw: Draw, width: float, dtype: torch.dtype) -> optics.Element:
    side = draw.one_of(16, 21)
    return optics.DOE(parameter((draw.noise(side, side) - 0.5) * 4, dtype))


def fine_doe(draw: Draw, width: float, dtype: torch.dtype) -> optics.Element:
    """A map with a pitch of its own, smaller than the aperture; not quantised, whose steps rounding could turn."""
    phase = torch.cumsum(draw.noise(24, 24) - 0.5, 0) * 1.5
    return optics.DOE(
        parameter(phase, dtype),
        pitch=0.8 * width / 24,
        glass=draw.one_of("N-BK7", "N-K5", 1.5),
        design_wavelength=500 * nm,
    )


def etched_doe(draw: Draw, width: float, dtype: torch.dtype) -> optics.Element:
    return optics.DOE(parameter((draw.noise(12, 12) - 0.5) * 9, dtype), levels=draw.one_of(2, 4, 8))


def radial_doe(draw: Draw, width: float, dtype: torch.dtype) -> optics.Element:
    return optics.RadialDOE(parameter((draw.noise(9) - 0.5) * 5, dtype), glass=draw.one_of("fused silica", "N-BK7"))


def wrapped_radial_doe(draw: Draw, width: float, dtype: torch.dtype) -> optics.Element:
    """A diffractive lens of three waves, wrapped: rings with jumps between their samples."""
    phase = torch.linspace(0, 1, 60, dtype=torch.float64).square() * 6 * torch.pi
    return optics.RadialDOE(parameter(phase.remainder(2 * torch.pi), dtype))


def coma(draw: Draw, width: float, dtype: torch.dtype) -> optics.Element:
    return Coma(parameter(draw.number(100, 300) * nm, dtype))


def bowl(draw: Draw, width: float, dtype: torch.dtype) -> optics.Element:
    return Bowl(parameter(draw.number(100, 300) * nm, dtype))


KINDS = {
    "round thin": (round_stop, thin, ()),
    "annular thin": (annulus, thin, ()),
    "fixed stop": (fixed_stop, thin, ()),
    "round convex": (round_stop, convex, ()),
    "annular convex": (annulus, convex, (defocus,)),
    "two glasses": (round_stop, two, ()),
    "radial DOE": (round_stop, convex, (radial_doe,)),
    "wrapped radial DOE": (round_stop, thin, (wrapped_radial_doe,)),
    "own symmetric": (annulus, thin, (bowl,)),
    "square convex": (square, convex, ()),
    "coded": (coded, thin, (defocus,)),
    "Zernike": (round_stop, convex, (zernike,)),
    "Zernike DOE": (annulus, convex, (zernike_doe,)),
    "own": (round_stop, thin, (coma,)),
    "square aberrated": (square, thin, (zernike, zernike_doe, defocus)),
    "DOE": (round_stop, thin, (doe,)),
    "DOE, own pitch": (fixed_stop, convex, (fine_doe,)),
    "DOE, etched": (annulus, thin, (etched_doe,)),
    "DOE and all else": (coded, convex, (doe, zernike, radial_doe)),
}
"""Name -> stop, lens, and what else there is."""
SYMMETRIC = tuple(KINDS)[:9]
SMOOTH = tuple(KINDS)[:15]


def lens(kind: str, draw: Draw, dtype: torch.dtype, *, f_number: tuple[float, float] = (7, 14)) -> optics.Lens:
    """A small lens of a kind: the pupil of a lens of 10 mm takes few samples."""
    stop, glass, others = KINDS[kind]
    focal = draw.number(8, 16) * 1e-3
    width = focal / draw.number(*f_number)
    elements = [stop(draw, width, dtype), *glass(draw, focal, dtype), *(make(draw, width, dtype) for make in others)]
    if draw.one_of(True, False):
        return optics.Lens(*elements, focus_distance=draw.one_of(0.4, 2.0, float("inf")))
    focused = optics.Lens(*elements, focus_distance=draw.number(0.3, 3.0), focus_wavelength=draw.number(500, 600) * nm)
    return optics.Lens(*elements, sensor_distance=parameter(focused.sensor_distance, dtype))


def wavelengths(draw: Draw, count: int) -> Tensor:
    """Ascending, unevenly spaced."""
    return (430 + 250 * (torch.arange(count, dtype=torch.float64) + draw.noise(count)) / count) * nm


def pitch(draw: Draw) -> float:
    return draw.number(2, 5) * um
