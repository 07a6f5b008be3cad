"""Lenses from their patents: numbers with their source, in millimetres."""

from __future__ import annotations

import math

from kcam.optics.compound.surface import Surface
from kcam.optics.elements.materials import Glass
from kcam.units import mm

Row = tuple[float, float, tuple[float, float] | None, float]
"""Radius, thickness to the next surface, (nd, vd) of what is between or None for air, semi-diameter [mm]."""

PRESETS: dict[str, tuple[str, int, tuple[Row, ...]]] = {
    "ef50": (
        "Canon EF 50 mm f/1.8: Japanese patent application S62-87922, example 1",
        6,
        (
            (34.3, 4.5, (1.628, 57.0), 15.495),
            (247.65, 2.4, None, 15.495),
            (21.51, 4.35, (1.70154, 41.2), 12.805),
            (40.31, 0.92, None, 12.075),
            (78.44, 1.4, (1.6727, 25.6), 12.805),
            (15.32, 6.75, None, 9.985),
            (math.inf, 4.95, None, 9.645),
            (-15.83, 1.1, (1.699, 30.1), 9.685),
            (135.97, 5.7, (1.7995, 42.2), 11.88),
            (-21.24, 0.15, None, 11.88),
            (162.15, 3.0, (1.72, 55.2), 11.8),
            (-49.97, 0.0, None, 11.8),
        ),
    ),
    "cooke_triplet": (
        "Cooke triplet, f = 50 mm f/5, 40 degrees: a sample of Zemax OpticStudio",
        3,
        (
            (22.01359, 3.25896, (1.62041, 60.32), 9.0),
            (-435.76044, 6.00755, None, 9.0),
            (-22.21328, 0.99997, (1.62004, 36.37), 6.0),
            (20.29192, 4.75041, None, 4.4),
            (79.6836, 2.95208, (1.62041, 60.32), 7.5),
            (-18.39533, 0.0, None, 7.5),
        ),
    ),
}
"""Name -> its source, which surface is the stop, and its rows."""


def preset_surfaces(name: str) -> list[Surface]:
    """The surfaces of a lens in `PRESETS`. Raises: ValueError for an unknown name."""
    if name not in PRESETS:
        raise ValueError(f"unknown lens {name!r}; known: {', '.join(sorted(PRESETS))}.")
    _, stop, rows = PRESETS[name]
    return [
        Surface(
            radius=radius * mm,
            thickness=thickness * mm,
            glass=None if glass is None else Glass(*glass),
            semi_diameter=reach * mm,
            stop=k == stop,
        )
        for k, (radius, thickness, glass, reach) in enumerate(rows)
    ]
