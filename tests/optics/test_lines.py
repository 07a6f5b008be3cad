"""Line spreads from rows of the pupil are those of the PSF."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import torch
from draws import Draw
from torch import Tensor

from kcam import optics
from kcam.optics.propagation import lines
from kcam.optics.propagation.grid import MATRIX
from kcam.optics.propagation.question import Query
from kcam.optics.propagation.row import Propagator
from kcam.optics.source import PixelGrid, Points
from kcam.units import mm, nm, um

FREQUENCIES = torch.linspace(0, math.sqrt(0.5), 40, dtype=torch.float64)
KINDS = "glass", "zernike", "map", "coded", "ring"


def random_question(seed: int, kind: str) -> Query:
    """A lens of that kind at f/6 to f/25, two distances and three wavelengths; of half, the window cuts light off."""
    draw = Draw(seed)
    diameter, focus = draw.number(2, 8) * mm, draw.number(0.5, 3)
    elements: list[optics.Element] = [optics.PlanoConvexLens(25.8 * mm, glass="N-BK7")]
    if kind == "zernike":
        elements.append(optics.ZernikeDOE(3 * (draw.noise(9) - 0.5)))
    elif kind == "map":
        smooth = torch.nn.functional.interpolate(draw.noise(1, 1, 5, 5), size=(48, 48), mode="bicubic")[0, 0]
        phase = 2 * math.pi * draw.number(1, 8) * smooth
        elements.append(optics.DOE(torch.remainder(phase, 2 * math.pi) if draw.one_of(True, False) else phase))
    stop: optics.Aperture = optics.CircularAperture(diameter)
    if kind == "coded":
        stop = optics.ApertureMap((draw.noise(9, 9) > 0.4).float(), width=diameter)
    elif kind == "ring":
        stop = optics.AnnularAperture(diameter, obscuration=draw.number(0.2, 0.6))
    lens = optics.Lens(stop, *elements, focus_distance=focus)
    vergences = torch.tensor([1 / focus, 1 / focus + draw.number(-0.3, 0.3)], dtype=torch.float64)
    shape = draw.one_of((97, 65), (49, 97), (129, 129))
    pixels = PixelGrid(draw.number(2, 5) * um, shape, draw.number(0.6, 1.0), True, torch.float64)
    wavelengths = torch.tensor([450.0, 470.0, 640.0], dtype=torch.float64) * nm
    return lens.question(Points(vergences), wavelengths, pixels)


def slices(psfs: Tensor, *, turned: bool = False) -> Tensor:
    """Of the transfer functions of PSFs (Z, L, h, w) along x and y, and on from 0.5 along the edge, (Z, L, 2, F);
    turned: along the diagonals.
    """
    along = FREQUENCIES.clamp(max=0.5)
    across = (FREQUENCIES.square() - along.square()).clamp(min=0).sqrt()
    y, x = (torch.arange(n, dtype=torch.float64) - n // 2 for n in psfs.shape[-2:])
    found = []
    slanted = FREQUENCIES * math.sqrt(0.5)
    for fx, fy in ((slanted, slanted), (-slanted, slanted)) if turned else ((along, across), (across, along)):
        waves = torch.exp(-2j * math.pi * (y[:, None, None] * fy + x[:, None] * fx))
        found.append(torch.einsum("zlyx,yxf->zlf", psfs.to(waves), waves))
    return torch.stack(found, dim=2)


def norm(values: Tensor) -> float:
    return float(values.abs().square().mean().sqrt())


@pytest.mark.parametrize(("kind", "turned"), [*((kind, False) for kind in KINDS), ("zernike", True), ("ring", True)])
@pytest.mark.parametrize("seed", [*range(2), *(pytest.param(n, marks=pytest.mark.slow) for n in range(2, 12))])
def test_lines_tell_what_wavelengths_and_distances_change(kind: str, turned: bool, seed: int) -> None:
    query, row = dataclasses.replace(random_question(seed, kind), turned=turned), MATRIX
    told = row.lines(query)
    assert told is not None
    found, expected = told(FREQUENCIES, query.shape, range(3)), slices(row(query), turned=turned)
    assert found.shape == expected.shape == (2, 3, 2, 40)
    assert norm(found - expected) < 0.03
    for ours, theirs in (
        (found[:, 0] - found[:, 1], expected[:, 0] - expected[:, 1]),
        (found[:, 0] - found[:, 2], expected[:, 0] - expected[:, 2]),
        (found[0] - found[1], expected[0] - expected[1]),
    ):
        if norm(theirs) > 3e-3:
            assert 0.7 < norm(ours) / norm(theirs) < 1.5, f"{norm(ours):.3g} for {norm(theirs):.3g}"


@pytest.mark.parametrize("seed", [*range(4), *(pytest.param(n, marks=pytest.mark.slow) for n in range(4, 16))])
def test_lines_tell_what_the_paraxial_model_of_pixels_leaves_out(seed: int) -> None:
    """Pixels that are curved in the image-side plane, of which the paraxial model knows nothing: f/6 to f/25."""
    query, rows = random_question(seed, "map"), (MATRIX, MATRIX.in_fresnel_range())
    told = [row.lines(query)(FREQUENCIES, query.shape, range(3)) for row in rows]
    psfs = [slices(row(query)) for row in rows]
    assert 0.9 < norm(told[0] - told[1]) / norm(psfs[0] - psfs[1]) < 1.4


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_what_falls_into_a_smaller_window_is_about_told(kind: str, seed: int) -> None:
    """To two thirds of what that leaves out, by the light that misses it along either axis."""
    query = random_question(seed, kind)
    told, smaller = MATRIX.in_fresnel_range().lines(query), (33, 41)
    assert told is not None
    psfs = MATRIX.in_fresnel_range()(query)
    top, left = (psfs.shape[-2] - 33) // 2, (psfs.shape[-1] - 41) // 2
    expected = slices(psfs[..., top : top + 33, left : left + 41]) - slices(psfs)
    found = told(FREQUENCIES, smaller, range(3)) - told(FREQUENCIES, query.shape, range(3))
    if norm(expected) > 3e-3:
        assert 0.9 < norm(found) / norm(expected) < 1.7


@pytest.mark.parametrize("seed", range(8))
def test_edges_of_windows_cut_light_that_is_linear_between_steps(seed: int) -> None:
    """Wherever they fall, also between two steps around the middle: an edge that goes on in whole steps as these grow
    with the wavelength would be told as colour.
    """
    draw = Draw(seed)
    count, step = draw.whole(20, 60), torch.tensor([draw.number(0.05, 5), draw.number(0.05, 5)], dtype=torch.float64)
    shape = draw.whole(1, 40), draw.whole(1, 40)
    light, x = draw.noise(count).double(), torch.fft.fftfreq(count, 1 / count, dtype=torch.float64)
    found = (light * lines.LineTransfer._inside(shape, step, x)).sum(-1)[..., 0]  # (L, 2)
    order = x.argsort()
    for own, along in zip(step, found, strict=True):
        for half, told in zip((shape[1] / 2, shape[0] / 2), along, strict=True):
            end = min(half / float(own), count)
            fine = torch.linspace(-end, end, 200_001, dtype=torch.float64)
            padded = torch.nn.functional.pad(light[order], (1, 1))
            low = (fine - float(x.min()) + 1).clamp(0, count + 1)
            before = low.floor().clamp(max=count).long()
            between = torch.lerp(padded[before], padded[before + 1], low - before)
            assert float(told) == pytest.approx(float(torch.trapezoid(between, fine)), rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(4))
def test_distances_take_what_others_have_found(kind: str, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the rows, and of the light from distances that both have; spheres from many distances lie between three."""
    draw, query, row = Draw(100 + seed), random_question(seed, kind), MATRIX
    ends = query.vergences.sort().values
    between = ends[0] + (ends[1] - ends[0]) * draw.noise(5).sort().values
    many = dataclasses.replace(query, points=Points(torch.cat([ends[:1], between, ends[1:]])))
    alone = row.lines(many)
    assert alone is not None
    first = row.lines(query)
    shared = row.lines(many, first)
    assert shared.spreads is first.spreads
    first(FREQUENCIES, query.shape, [0, 2])
    looked_at: dict[int, int] = {}  # of wavelengths, at how many distances
    spread = lines._Spreads._spread

    def counted(self: lines._Spreads, wavelengths: Tensor, bands: list[int], lit: Any, onto: Any) -> Tensor:
        looked_at.update((band, len(lit[0].coefficients[band])) for band in bands)
        return spread(self, wavelengths, bands, lit, onto)

    monkeypatch.setattr(lines._Spreads, "_spread", counted)
    found = shared(FREQUENCIES, query.shape, range(3))
    assert looked_at == {0: 5, 1: 7, 2: 5}
    torch.testing.assert_close(found, alone(FREQUENCIES, query.shape, range(3)), rtol=0, atol=2e-3)
    each = row.lines(dataclasses.replace(query, points=Points(between[2:3])), first)
    torch.testing.assert_close(each(FREQUENCIES, query.shape, range(3))[0], found[3], rtol=0, atol=2e-3)


@pytest.mark.parametrize("paraxial", [True, False])
@pytest.mark.parametrize("seed", range(6))
def test_of_maps_only_what_rows_and_nodes_take_is_computed(
    seed: int, paraxial: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of fine maps before windows of any size: the same as if all of it were."""
    draw = Draw(seed)
    size = draw.whole(100, 260)
    fine = optics.DOE(
        draw.number(1, 6) * torch.nn.functional.avg_pool2d(draw.noise(1, 1, size + 8, size + 8), 9, 1)[0, 0]
    )
    stop = optics.CircularAperture(draw.number(2, 6) * mm)
    lens = optics.Lens(stop, optics.ThinLens(25 * mm), fine, focus_distance=2.0)
    vergences = torch.tensor([0.4, 0.7], dtype=torch.float64)
    shape = draw.one_of((97, 129), (193, 129), (129, 129))
    pixels = PixelGrid(draw.number(2, 5) * um, shape, 1.0, True, torch.float64)
    wavelengths = torch.tensor([450.0, 640.0], dtype=torch.float64) * nm
    query = lens.question(Points(vergences), wavelengths, pixels).modelled(paraxial=paraxial)
    told = []
    for most in (1.1, 0.0):
        monkeypatch.setattr(lines, "_MOST", most)
        own = lines.LineTransfer(query)
        told.append(own(FREQUENCIES, shape, range(2)))
        ((_, onto),) = own.spreads.lit.values()
        for parts in (own.spreads.maps.parts, *(rows.parts for rows in onto)):
            assert (len(parts) > 1) == (most > 0)
    torch.testing.assert_close(*told, rtol=0, atol=2e-6)


def test_in_focus_they_are_the_autocorrelation_of_the_disc() -> None:
    """2 / pi (arccos v - v sqrt(1 - v^2)), v = f lambda d / 2a, times the pixel's sinc (Goodman, 6.34)."""
    lens = optics.Lens(optics.CircularAperture(4 * mm), optics.ThinLens(50 * mm), focus_distance=math.inf)
    wavelength, pitch = 550 * nm, 2 * um
    pixels = PixelGrid(pitch, (257, 257), 1.0, True, torch.float64)
    query = lens.question(Points(torch.zeros(1, dtype=torch.float64)), torch.tensor([wavelength]).double(), pixels)
    row = MATRIX.in_fresnel_range()
    found = row.lines(query)(FREQUENCIES, (257, 257), [0])[0, 0]
    v = (FREQUENCIES / pitch * wavelength * 50 * mm / (4 * mm)).clamp(max=1)
    expected = 2 / math.pi * (v.arccos() - v * (1 - v**2).sqrt()) * torch.sinc(FREQUENCIES)
    torch.testing.assert_close(found.real, expected.expand(2, -1), rtol=0, atol=6e-3)  # the window leaves 0.3 % out
    assert found.imag.abs().max() < 1e-3


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("row", [MATRIX, MATRIX.in_fresnel_range()], ids=lambda row: row.physics)
def test_they_are_told_on_the_device_of_the_query(row: Propagator, kind: str, device: torch.device) -> None:
    query = random_question(1, kind)
    expected = row.lines(query)(FREQUENCIES, query.shape, range(3))
    grid = dataclasses.replace(query.grid, device=device)
    there = dataclasses.replace(query, points=Points(query.vergences.to(device)), grid=grid)
    there.lens.to(device)
    found = row.lines(there)(FREQUENCIES.to(device), there.shape, range(3))
    assert found.device.type == device.type
    torch.testing.assert_close(found.cpu(), expected, rtol=0, atol=1e-5)


def test_only_those_are_told_that_can_be() -> None:
    smooth = random_question(0, "zernike")
    aside = Points(smooth.vergences, torch.full((2, 2), 1e-3, dtype=torch.float64))
    assert MATRIX.lines(smooth.lens.question(aside, smooth.wavelengths, smooth.grid)) is None
    with pytest.raises(ValueError, match="window"):
        MATRIX.lines(smooth)(FREQUENCIES, (9, 999), [0])
