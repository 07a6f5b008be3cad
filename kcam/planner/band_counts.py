"""How many wavelengths may stand for all of a scene's, and at how many choices are compared."""

from __future__ import annotations

import math
from typing import Any

FEW_BANDS = 2
"""Wavelengths of the settings beside which a choice is priced."""

GREY: dict[str, Any] = {"bands": 1}
"""Light of one wavelength. What a window costs in it, times what line spreads say of a few and of one, is 0.77 to 1.2
times what it costs in all (5 to 95 % of 55 windows of 20 random pairs); less of a lens that this one sees in focus, see
`ladders.COLOURFUL`.
"""

GRIDS = 3
"""Wavelengths at which grids of pupil samples are compared: what a coarse one leaves varies from one to the next."""

ROUND = 4
"""Wavelengths of round PSFs at which windows are compared: what they cost is then 0.97 to 1.09 times what it is at all
28; at 2 it is 0.68 to 1.2 times (227 windows of 90 cameras).
"""


def group_counts(total: int) -> list[int]:
    """Numbers of groups, ascending, each about four thirds of the one before, up to half of all; those into which
    `total` divides evenly first.

    Groups of one size are a better quadrature than more groups of two sizes: of 28 bands, 7 are as close to all as 8
    are, and 14 closer than 16.
    """
    found = [1]
    while found[-1] < total:
        near = range(max(found[-1] + 1, math.ceil(1.2 * found[-1])), max(found[-1] + 1, round(1.6 * found[-1])) + 1)
        even = [count for count in near if total % count == 0]
        found.append(even[-1] if even else max(found[-1] + 1, found[-1] * 4 // 3))
    return [count for count in found if 2 * count <= total + total % 2 and count < total]


def node_counts(total: int) -> list[int]:
    """Numbers of wavelengths between whose PSFs all others lie, ascending, each about four thirds of the one before; up
    to 0.7 of all, beyond which next to nothing is saved.
    """
    found = [1]
    while (more := max(found[-1] + 1, found[-1] * 4 // 3)) <= 0.7 * total:
        found.append(more)
    return found if total > 1 else []


def interpolated(count: int) -> dict[str, Any]:
    """Changes of an Imaging: the PSFs of so many wavelengths, and those between them."""
    return {"bands": count, "interpolate_bands": True}
