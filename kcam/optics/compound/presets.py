"""Lenses from their patents: numbers with their source, in millimetres."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from kcam.optics.compound.surface import Surface
from kcam.optics.elements.materials import Glass
from kcam.units import mm


class Row(NamedTuple):
    """Radius, thickness to the next surface, (nd, vd) of what is between or None for air, semi-diameter [mm]; for an
    asphere the conic constant, and A_3, A_4, ... of sum_n A_n r^n [mm^(1 - n)].
    """

    radius: float
    thickness: float
    glass: tuple[float, float] | None
    semi_diameter: float
    conic: float = 0.0
    terms: tuple[float, ...] = ()


@dataclass(frozen=True)
class Prescription:
    """source: who published the numbers, and what was added to them. stop: which row is the aperture stop. field: the
    tangent up to which the lens is meant to image, from the axis.
    """

    source: str
    stop: int
    field: float
    rows: tuple[Row, ...]


def _even(*terms: float) -> tuple[float, ...]:
    """A_4, A_6, ... as terms of a row."""
    return tuple(value for term in terms for value in (0.0, term))


PRESETS = {
    "cooke_triplet": Prescription(
        "Cooke triplet, f = 50 mm f/5, 40 degrees: a sample of Zemax OpticStudio; its stop is open to f/4.3 here",
        3,
        0.36,
        (
            Row(22.01359, 3.25896, (1.62041, 60.32), 9.0),
            Row(-435.76044, 6.00755, None, 9.0),
            Row(-22.21328, 0.99997, (1.62004, 36.37), 6.0),
            Row(20.29192, 4.75041, None, 4.4),
            Row(79.6836, 2.95208, (1.62041, 60.32), 7.5),
            Row(-18.39533, 0.0, None, 7.5),
        ),
    ),
    "double_gauss": Prescription(
        "A. W. Tronnier, US 2,673,491 (1954), f = 50 mm f/2, 22 degrees; semi-diameters from W. J. Smith, Modern Lens "
        "Design (1992), p. 312, scaled from 100 mm",
        5,
        0.40,
        (
            Row(29.475, 3.76, (1.67125, 47.1), 12.6),
            Row(84.83, 0.12, None, 12.6),
            Row(19.275, 4.025, (1.67125, 47.1), 11.5),
            Row(40.77, 3.275, (1.69842, 30.1), 11.5),
            Row(12.75, 5.466, None, 9.0),
            Row(math.inf, 4.741, None, 8.55),
            Row(-14.495, 1.18, (1.60266, 38.4), 8.5),
            Row(40.77, 6.065, (1.65953, 57.0), 10.0),
            Row(-20.385, 0.19, None, 10.0),
            Row(437.065, 3.22, (1.7174, 48.1), 10.0),
            Row(-39.73, 0.0, None, 10.0),
        ),
    ),
    "ef50": Prescription(
        "Canon EF 50 mm f/1.8: Japanese patent application S62-87922, example 1; the Abbe number 25.6 of its third "
        "glass, as DeepLens has it too, leaves 0.65 % of axial colour, where 32 would leave 0.1 %",
        6,
        0.43,
        (
            Row(34.3, 4.5, (1.628, 57.0), 15.495),
            Row(247.65, 2.4, None, 15.495),
            Row(21.51, 4.35, (1.70154, 41.2), 12.805),
            Row(40.31, 0.92, None, 12.075),
            Row(78.44, 1.4, (1.6727, 25.6), 12.805),
            Row(15.32, 6.75, None, 9.985),
            Row(math.inf, 4.95, None, 9.645),
            Row(-15.83, 1.1, (1.699, 30.1), 9.685),
            Row(135.97, 5.7, (1.7995, 42.2), 11.88),
            Row(-21.24, 0.15, None, 11.88),
            Row(162.15, 3.0, (1.72, 55.2), 11.8),
            Row(-49.97, 0.0, None, 11.8),
        ),
    ),
    "phone": Prescription(
        "A phone's lens of three elements, f = 3.74 mm f/2.8, 30 degrees: Kyocera, US 8,558,939, indices and diameters "
        "as BeamletOptics has them from pencilofrays.com, Abbe numbers from that file's glass codes",
        0,
        0.6,
        (
            Row(
                1.054, 0.72, (1.5802, 56.0), 0.666512, -0.14294,
                _even(3.8162e-2, 6.317e-2, -2.0792e-2, 0.18432, -4.827e-2, 9.4529e-2),
            ),
            Row(
                2.027, 0.39, None, 0.608236, 8.0226,
                _even(7.4974e-3, 6.4686e-2, 0.19354, -0.50703, -0.34529, 5.9938),
            ),
            Row(
                -3.116, 0.55, (1.8047, 24.0), 0.7, -49.984,
                _even(-0.31608, 0.34755, -0.17102, -0.41506, -1.342, 5.0594, -2.7483),
            ),
            Row(
                -4.835, 0.63, None, 0.95, 1.6674,
                _even(-7.9727e-2, 0.13899, -4.4057e-2, -1.9369e-2, 1.6993e-2, 9.3716e-2, -8.0329e-2),
            ),
            Row(
                3.618, 0.7, (1.5802, 56.0), 1.52, -44.874,
                _even(-0.14756, 3.5194e-2, -3.2262e-3, 1.8592e-3, 3.6658e-4, -1.6039e-4, -3.1846e-5),
            ),
            Row(
                2.161, 0.19, None, 1.85, -10.719,
                _even(-9.6568e-2, 2.6771e-2, -1.1261e-2, 1.9879e-3, 1.5579e-4, -1.2433e-4, 1.5264e-5),
            ),
            Row(math.inf, 0.15, (1.5168, 64.0), 2.1),
            Row(math.inf, 0.18, None, 2.1),
            Row(math.inf, 0.5, (1.4692, 61.0), 2.45),
            Row(math.inf, 0.0, None, 2.45),
        ),
    ),
    "phone_odd": Prescription(
        "A phone's lens of four elements with odd aspheres, f = 5.56 mm f/3.5, 32 degrees: US 7,535,658, as ray-optics "
        "has it among its examples; semi-diameters let the whole bundle of each point up to that height pass. Rays are "
        "those that ray-optics lists, but the field is curved by 0.2 mm: perhaps a misprint",
        0,
        0.63,
        (
            Row(math.inf, 0.0, None, 0.79358),
            Row(
                1.962, 1.19, (1.471, 76.6), 0.94, 1.153,
                (-1.895e-2, 2.426e-2, -5.123e-2, 8.371e-4, 7.850e-3, 4.091e-3, -7.732e-3, -4.265e-3),
            ),
            Row(
                33.398, 0.93, None, 1.09, 39.18,
                (-4.966e-3, -1.434e-2, -6.139e-3, -9.284e-5, 6.438e-3, -5.72e-3, -2.385e-2, 1.108e-2),
            ),
            Row(
                -2.182, 0.75, (1.603, 27.5), 1.14, 1.105,
                (-4.388e-2, -2.555e-2, 5.16e-2, -4.307e-2, -2.831e-2, 3.162e-2, 4.630e-2, -4.877e-2),
            ),
            Row(
                -6.367, 0.1, None, 1.55, 2.382,
                (-1.131e-1, -7.863e-2, 1.094e-1, 6.228e-3, -2.216e-2, -5.89e-3, 4.123e-3, 1.041e-3),
            ),
            Row(
                5.694, 0.89, (1.51, 56.2), 1.84, -222.1,
                (-7.876e-2, 7.02e-2, 1.575e-3, -9.958e-3, -7.322e-3, 6.914e-4, 2.54e-3, -7.65e-4),
            ),
            Row(
                9.192, 0.16, None, 2.41, -0.0669,
                (9.694e-3, -2.516e-3, -3.606e-3, -2.497e-4, -6.84e-4, -1.414e-4, 2.932e-4, -7.284e-5),
            ),
            Row(
                1.674, 0.85, (1.51, 56.2), 2.5, -8.617,
                (7.429e-2, -6.933e-2, -5.811e-3, 2.396e-3, 2.1e-3, -3.119e-4, -5.552e-5, 7.969e-6),
            ),
            Row(
                1.509, 0.7, None, 2.95, -3.707,
                (1.767e-3, -4.652e-2, 1.625e-2, -3.522e-3, -7.106e-4, 3.825e-4, 6.271e-5, -2.631e-5),
            ),
            Row(math.inf, 0.4, (1.516, 64.1), 3.33),
            Row(math.inf, 0.0, None, 3.43),
        ),
    ),
    "telephoto": Prescription(
        "Kreitzer, US 4,359,272, f = 100 mm f/5.6, 3 degrees, with indices to three digits and semi-diameters as in "
        "W. J. Smith, Modern Lens Design (1992); the stop is set to f/5.6",
        8,
        0.055,
        (
            Row(33.072, 2.366, (1.518, 59.0), 8.9),
            Row(-53.387, 0.077, None, 8.9),
            Row(27.825, 2.657, (1.518, 59.0), 8.4),
            Row(-35.934, 1.025, (1.749, 35.0), 8.3),
            Row(40.9, 22.084, None, 7.8),
            Row(math.inf, 1.794, (1.785, 25.7), 4.7),
            Row(-16.775, 0.641, (1.835, 43.0), 4.6),
            Row(27.153, 8.607, None, 4.5),
            Row(math.inf, 1.0, None, 2.667),
            Row(-120.75, 1.035, (1.517, 52.2), 4.8),
            Row(-12.105, 4.705, None, 4.8),
            Row(-9.386, 0.641, (1.773, 49.6), 4.0),
            Row(-24.331, 0.0, None, 4.1),
        ),
    ),
    "tessar": Prescription(
        "Brendel, US 2,854,889, f = 100 mm f/2.8, 24 degrees, with semi-diameters as in W. J. Smith, Modern Lens "
        "Design (1992); the stop is set to f/2.8",
        3,
        0.45,
        (
            Row(42.97, 9.8, (1.691, 54.8), 19.2),
            Row(-115.33, 2.1, (1.5486, 45.4), 19.2),
            Row(306.84, 4.16, None, 19.2),
            Row(math.inf, 4.0, None, 14.61),
            Row(-59.06, 1.87, (1.6398, 34.6), 17.3),
            Row(40.93, 10.64, None, 17.3),
            Row(183.92, 7.05, (1.691, 54.8), 16.5),
            Row(-48.91, 0.0, None, 16.5),
        ),
    ),
    "wide_angle": Prescription(
        "S. Matsui, US 4,099,850 (1978), example 5, f = 28 mm f/3.5, 37 degrees, scaled from 100 mm; the patent has "
        "the diaphragm between the third lens and the fourth, and no semi-diameters: it stands in the middle, set to "
        "f/3.5, and the others let the whole bundle pass up to 20 degrees, and 40 % of it at 37",
        6,
        0.75,
        (
            Row(99.91016, 2.9372, (1.62374, 47.0), 18.2),
            Row(607.38468, 0.098, None, 17.2),
            Row(55.80428, 1.56632, (1.62041, 60.3), 15.2),
            Row(15.4686, 26.7274, None, 12.0),
            Row(23.7902, 2.7412, (1.70154, 41.1), 7.5),
            Row(-52.41684, 2.7412, None, 7.3),
            Row(math.inf, 2.7412, None, 5.685),
            Row(-21.042, 4.40552, (1.7552, 27.5), 5.8),
            Row(34.16784, 1.07688, None, 6.7),
            Row(-88.1118, 2.64348, (1.62041, 60.3), 6.8),
            Row(-17.70076, 0.098, None, 7.3),
            Row(80.27964, 2.44748, (1.58913, 61.2), 7.8),
            Row(-48.75528, 0.0, None, 8.2),
        ),
    ),
}  # fmt: skip
"""Lenses by their name."""


def preset_surfaces(name: str) -> list[Surface]:
    """The surfaces of a lens in `PRESETS`. Raises: ValueError for an unknown name."""
    if name not in PRESETS:
        raise ValueError(f"unknown lens {name!r}; known: {', '.join(sorted(PRESETS))}.")
    lens = PRESETS[name]
    return [_surface(row, stop=k == lens.stop) for k, row in enumerate(lens.rows)]


def _surface(row: Row, *, stop: bool) -> Surface:
    terms = [value * mm ** (1 - power) for power, value in enumerate(row.terms, start=3)]
    return Surface(
        radius=row.radius * mm,
        thickness=row.thickness * mm,
        glass=None if row.glass is None else Glass(*row.glass),
        semi_diameter=row.semi_diameter * mm,
        conic=row.conic,
        asphere=terms[1::2],
        odd_asphere=(0.0, *terms[::2]) if any(terms[::2]) else (),
        stop=stop,
    )
