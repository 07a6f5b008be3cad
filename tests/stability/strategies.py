"""Random lenses, cameras and scenes for hypothesis: small pictures, few bands, one draw in a few milliseconds.

Numbers are drawn by hypothesis, tensors from a drawn seed: a picture that shrinks pixel by pixel teaches nothing.
"""

from __future__ import annotations

import math

import torch
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from kcam import Scene, optics, sensor
from kcam.sensor.mosaic import PATTERNS
from kcam.units import mm, nm, um

DOUBLE = torch.float64


def examples(count: int) -> settings:
    """The same examples at every run, without a database or a clock."""
    return settings(
        max_examples=count, derandomize=True, deadline=None, database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )  # fmt: skip


def between(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_infinity=False)


@st.composite
def tensors(draw: st.DrawFn, *shape: int) -> Tensor:
    """Uniform in 0..1."""
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    return torch.rand(*shape, generator=generator, dtype=DOUBLE)


@st.composite
def apertures(draw: st.DrawFn) -> optics.Element:
    width = draw(between(0.8, 4)) * mm  # beyond f/100 a warning says that nothing was tested there
    kind = draw(st.sampled_from(["circle", "ring", "square", "mask"]))
    if kind == "circle":
        return optics.CircularAperture(width)
    if kind == "ring":
        return optics.AnnularAperture(width, obscuration=draw(between(0, 0.7)))
    if kind == "square":
        return optics.SquareAperture(width)
    mask = draw(tensors(5, 5))
    mask[2, 2] = 1  # a mask that is closed everywhere is refused
    return optics.ApertureMap(mask, width=width)


@st.composite
def others(draw: st.DrawFn) -> list[optics.Element]:
    """None or one element beside aperture and lens."""
    kind = draw(st.sampled_from(["none", "map", "aberration", "profile", "defocus"]))
    if kind == "map":
        n = draw(st.integers(1, 16))
        return [optics.DOE(draw(between(0, 3)) * (draw(tensors(n, n)) - 0.5))]
    if kind == "aberration":
        return [optics.ZernikeAberration(300 * nm * (draw(tensors(10)) - 0.5))]
    if kind == "profile":
        return [optics.RadialDOE(draw(between(0, 6)) * draw(tensors(6)))]
    if kind == "defocus":
        return [optics.Defocus(draw(between(-2, 2)))]
    return []


@st.composite
def lenses(draw: st.DrawFn) -> optics.Lens:
    """f/6 and slower."""
    glass = st.sampled_from(["N-BK7", "F2", 1.5])
    lens = draw(
        st.one_of(
            between(25, 60).map(lambda f: optics.ThinLens(f * mm)),
            st.builds(lambda r, g: optics.PlanoConvexLens(r * mm, glass=g), between(15, 30), glass),
        )
    )
    focus = draw(st.one_of(between(0.3, 10), st.just(math.inf)))
    return optics.Lens(draw(apertures()), lens, *draw(others()), focus_distance=focus)


@st.composite
def imagings(draw: st.DrawFn, *, borders: tuple[str, ...] = optics.imaging.BORDERS) -> optics.Imaging:
    return optics.Imaging(
        draw(lenses()),
        pixel_pitch=draw(between(3, 12)) * um,
        propagator=draw(st.sampled_from(["nonparaxial", "fresnel"])),
        psf_shape=(draw(st.integers(1, 9)), draw(st.integers(1, 9))),
        layers=2,
        border=draw(st.sampled_from(borders)),
        fill_factor=draw(between(0.3, 1)),
    )


@st.composite
def wavelengths(draw: st.DrawFn) -> Tensor:
    """1 to 4 of them, at least a nanometre apart, in any order."""
    grid = draw(st.lists(st.integers(420, 720), min_size=1, max_size=4, unique=True))
    return torch.tensor(grid, dtype=DOUBLE) * nm


distances = st.one_of(between(0.3, 100), st.just(math.inf))


@st.composite
def scenes(draw: st.DrawFn, *, size: tuple[int, int] | None = None, batch: int = 1, mapped: bool = True) -> Scene:
    """A cube of up to twice white in float64, at one distance or over a map of two."""
    grid = draw(wavelengths())
    height, width = size or (draw(st.integers(1, 20)), draw(st.integers(1, 20)))
    bands = 2 * draw(tensors(batch, grid.numel(), height, width))
    depth: float | Tensor = draw(distances)
    if mapped and draw(st.booleans()):
        depth = torch.where(draw(tensors(batch, 1, height, width)) < 0.5, depth, draw(distances))
    return Scene.from_bands(bands, wavelengths=grid, depth=depth)


@st.composite
def colour_filters(draw: st.DrawFn) -> sensor.ColourFilter:
    kind = draw(st.sampled_from(["kodak", "nikon", "sigma", "rgbw", "learned"]))
    if kind == "learned":
        return sensor.ColourFilter.learned(tile=draw(st.integers(1, 4))).double()
    return getattr(sensor.ColourFilter, kind)().double()


@st.composite
def sensors(draw: st.DrawFn) -> tuple[list[nn.Module], tuple[int, int]]:
    """Filter, mosaic and exposure, linear in the light, and the period of the mosaic."""
    colour_filter = draw(colour_filters())
    exposure = sensor.Exposure(draw(between(0.05, 1)))
    if colour_filter.is_tile:
        side = colour_filter.coefficients.shape[0]
        return [colour_filter, exposure], (side, side)
    white = len(colour_filter.coefficients) == 4
    pattern = draw(st.sampled_from([name for name in PATTERNS if (name == "rgbw") == white]))
    tile = PATTERNS[pattern]
    return [colour_filter, sensor.Mosaic(pattern), exposure], (len(tile), len(tile[0]))
