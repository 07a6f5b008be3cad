"""Each trap of float32 and autograd: the usual form fails, kcam holds, and both numbers are bounded."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable

import pytest
import torch
import traps

NAN = math.nan
# What the usual form exceeds (NaN: it gives none), and what kcam stays below, or how it refuses.
BOUNDS: dict[str, tuple[float, float | str]] = {
    # half of all light and more in the wrong place; ours is float32's rounding of the residual, 3e-7
    "path from the source": (0.5, 1e-6),
    "a piston": (0.3, 1e-6),
    "a piston taken off after the root": (0.3, 1e-6),
    # sums of hundreds of radians: ulp 6e-5, averaged over the pupil
    "large opposite chirps": (3e-6, 1e-6),
    # ulp(k z) = 0.5 over half a metre; ours at its sampling, of which the row states 3e-3
    "angular spectrum": (1e-2, 3e-3),
    # a blur of 2.8 waves has more radians to round than a focus
    "object at infinity": (NAN, 3e-6),
    # at 1e3 m the source's own 0.036 radians are missing
    "objects at 1e3 .. 1e12 m": (3e-3, 3e-6),
    # no slope at all, or that of rounding noise; ours as the PSFs, with the truth's differences good to 1e-6
    "gradient to z at 1e3 .. 1e12 m": (0.99, 1e-5),
    "gradient to z at infinity": (NAN, 0.0),
    "gradient to a lens, object at infinity": (NAN, 1e-5),
    "aperture beyond the sphere, r >= R": (NAN, r"reaches r = 0\.03 m, .* Use an aperture below 0\.05 m"),
    # near the rim the path bends within few samples: 1e-5 at 1024 of them
    "corners beyond the sphere, aperture 0.95 R": (NAN, 5e-5),
    "Zernike terms on the axis": (NAN, 5e-6),
    # two flat pixels are low-passed onto the pupil grid; stated for pixel maps is 1.5e-3
    "a dark pixel": (NAN, 1e-4),
    "Poisson noise where nothing arrives": (NAN, 0.0),
    "no light in the window": (NAN, 0.0),
    # 3e-4 of the light arrives; told to 1 % of it
    "light beside the window": (0.99, 3e-6),
    "pupil sampled too coarsely": (5.0, r"256 samples is too coarse at 550 nm.* Use samples >= \d+"),
    # the pixel's integral is exact for |U|^2, up to the light beyond the window's margin
    "PSF smaller than a pixel": (50.0, 1e-5),
    # 10 bits of mantissa, 5e-4, averaged over 256 x 256 samples
    'float32 products set to "high"': (2e-5, 1e-6),
    # issue 1: a cosine of 0.999 and better
    "DOE finer than the pupil grid": (0.2, 1e-3),
}


@functools.cache
def row_of(trap: Callable[[], traps.Row]) -> traps.Row:
    return trap()


def check(row: traps.Row) -> None:
    at_least, allowed = BOUNDS[row.case]
    print(f"{row.case}: {row.measure}: usual {row.naive:.1e}, kcam {row.kcam}")
    assert math.isnan(row.naive) if math.isnan(at_least) else row.naive > at_least
    if isinstance(allowed, str):
        assert isinstance(row.kcam, str)
        assert re.search(f"^ValueError: .*{allowed}", row.kcam)
    else:
        assert row.kcam <= allowed


@pytest.mark.parametrize("trap", traps.TRAPS, ids=lambda trap: trap.__name__.strip("_"))
def test_the_usual_form_fails_and_kcam_holds(trap: Callable[[], traps.Row]) -> None:
    check(row_of(trap))


def test_every_bound_has_its_trap() -> None:
    assert sorted(row_of(trap).case for trap in traps.TRAPS) == sorted(BOUNDS)


@pytest.mark.parametrize("case", traps.PHASES)
def test_the_usual_phases_are_right_in_float64(case: str) -> None:
    """So that it is float32 that fails, and not the formula."""
    # where the source is a sphere and not the parabola of the truth: k a^4 / 8 z^3 = 7e-6 rad; ulp(k z) is 4e-9
    assert traps.phase_error(traps.PHASES[case][1], torch.float64) < 1e-5


def test_reduced_precision_products(device: torch.device) -> None:
    """On a GPU the products themselves are in TF32; on a CPU "high" changes nothing, and TF32 is written out."""
    check(traps.reduced_products(device))
    assert torch.get_float32_matmul_precision() == "highest"
