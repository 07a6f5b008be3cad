"""Maps of flat pixels on common cells: their edges, the rim in them, and maps whose pixels do not fit."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import special

from kcam import optics
from kcam.optics.propagation.cells import cell_edges, disc_cells
from kcam.units import mm, nm, um

LIKE = {"dtype": torch.float64, "device": torch.device("cpu")}


# ---- cells -------------------------------------------------------------------------------------------------------


def test_every_pixel_is_whole_in_the_cells() -> None:
    edges, of_pixels = cell_edges(((4, 1.0), (6, 1.0), (3, 0.7), (10, 2.0)), math.inf)
    quarters, sixths, own, beyond = np.linspace(-1, 1, 5), np.linspace(-1, 1, 7), np.linspace(-0.7, 0.7, 4), 0.4
    expected = sorted({round(v, 9) for v in (*quarters, *sixths, *own, *(beyond * np.arange(-2, 3)))})
    np.testing.assert_allclose(edges, expected, atol=1e-9)
    assert of_pixels.all()


def test_cells_are_as_narrow_as_the_rim_asks() -> None:
    edges, of_pixels = cell_edges(((3, 1.0), (2, 0.5)), 0.11)
    assert np.diff(edges).max() <= 0.11
    np.testing.assert_allclose(edges[of_pixels], [-1, -0.5, -1 / 3, 0, 1 / 3, 0.5, 1], atol=1e-12)
    for low, high in zip(edges[of_pixels][:-1], edges[of_pixels][1:], strict=True):
        sides = np.diff(edges[(edges >= low) & (edges <= high)])
        assert len(sides) == math.ceil((high - low) / 0.11)
        np.testing.assert_allclose(sides, sides[0], rtol=1e-9)


# ---- the rim -----------------------------------------------------------------------------------------------------


def spectrum(values: torch.Tensor, edges: np.ndarray, frequency: float) -> float:
    """The Fourier transform of flat cells, even in x and y, at (frequency, 0) [cycles per unit]."""
    below = np.sin(2 * math.pi * frequency * edges) / (2 * math.pi * frequency)
    return float(values.numpy().T @ np.diff(below) @ np.diff(edges))


@pytest.mark.parametrize(("frequency", "bound"), [(0.5, 2e-7), (1.3, 1e-4), (3.3, 1e-3)])
def test_discs_of_cells_diffract_as_their_rim(frequency: float, bound: float) -> None:
    """Against J1(2 pi f) / f, and beside the shares of light alone, which droop. Frequency in cycles per radius."""
    maps, widest = ((1, 1.0),), 0.01
    edges, _ = cell_edges(maps, widest)
    cells = disc_cells(((1.0, 1.0),), maps, widest, **LIKE)
    truth = special.j1(2 * math.pi * frequency) / frequency
    error, plain = (abs(spectrum(values, edges, frequency) - truth) for values in cells)
    envelope = 1 / (math.pi * frequency**1.5)
    print(f"disc of cells at {frequency}: {error / envelope:.1e} of the envelope, by shares {plain / envelope:.1e}")
    assert error <= bound * envelope
    assert plain > 3 * error
    assert float(cells[1].sum()) * 0.01**2 == pytest.approx(math.pi, rel=1e-12)


@pytest.mark.parametrize("pixels", [1, 9, 54])
def test_light_at_the_rim_stays_in_its_pixel(pixels: int) -> None:
    """The next pixel may have any phase."""
    maps = ((pixels, 1.0),)
    amplitude, power = disc_cells(((1.0, 1.0), (0.4, -1.0)), maps, 2 / 54, **LIKE)
    assert amplitude.shape == (54, 54)
    moved = (amplitude - power).reshape(pixels, 54 // pixels, pixels, 54 // pixels)
    assert float(moved.sum((1, 3)).abs().max()) < 1e-13
    assert torch.equal(amplitude, power) == (pixels == 54)


# ---- maps whose pixels do not fit --------------------------------------------------------------------------------


def noise(size: int, *, seed: int) -> torch.Tensor:
    return 6 * torch.rand(size, size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def bank(*elements: optics.Element, aperture: optics.Aperture) -> torch.Tensor:
    lens = optics.Lens(aperture, optics.ThinLens(20 * mm), *elements, focus_distance=math.inf)
    shape = {"pixel_pitch": 3 * um, "shape": (33, 33), "samples": 192}
    return lens.psf([550 * nm, 650 * nm], distances=1.0, dtype=torch.float64, **shape)


def finer(values: torch.Tensor, times: int) -> torch.Tensor:
    return values.repeat_interleave(times, 0).repeat_interleave(times, 1)


def difference(one: torch.Tensor, other: torch.Tensor) -> float:
    return float((one - other).abs().sum() / other.sum())


@pytest.mark.parametrize("round_aperture", [False, True])
def test_maps_of_any_sizes_are_one_on_a_common_lattice(round_aperture: bool) -> None:
    """10 and 14 pixels; on a lattice of 70, which each of them divides, the same optics is one map of each."""
    first, second = noise(10, seed=0), noise(14, seed=1)
    aperture = optics.CircularAperture(2 * mm) if round_aperture else optics.SquareAperture(2 * mm)
    apart = bank(optics.DOE(first), optics.DOE(second), aperture=aperture)
    together = bank(optics.DOE(finer(first, 7)), optics.DOE(finer(second, 5)), aperture=aperture)
    # 3e-9 measured; where the rim is cut in other cells 9e-4
    assert difference(apart, together) <= (2e-3 if round_aperture else 1e-7)


def test_a_mask_and_a_doe_of_other_pixels() -> None:
    mask, phase = (noise(6, seed=2) > 3).double(), noise(10, seed=3)
    apart = bank(optics.DOE(phase), aperture=optics.ApertureMap(mask, width=2 * mm))
    together = bank(optics.DOE(finer(phase, 3)), aperture=optics.ApertureMap(finer(mask, 5), width=2 * mm))
    assert difference(apart, together) <= 1e-7


@pytest.mark.parametrize("pitch", [2 * mm / 10.3, 2 * mm / 7.9])
def test_a_pitch_that_the_square_cuts_anywhere(pitch: float) -> None:
    """A flat map is nothing, wherever its pixels end."""
    flat = optics.DOE(torch.zeros(10, 10), pitch=pitch)
    square = optics.SquareAperture(2 * mm)
    assert difference(bank(flat, aperture=square), bank(aperture=square)) <= 1e-5
