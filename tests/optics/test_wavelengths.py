"""PSFs of a few wavelengths that stand for all bands: shared by groups, or interpolated between them."""

from __future__ import annotations

import pytest
import torch
from draws import Draw

from kcam import Camera, Scene, optics, sensor
from kcam.optics.numerics import cubic_weights
from kcam.optics.wavelengths import few_wavelengths
from kcam.units import mm, nm, um, wavelength_grid


def some_wavelengths(draw: Draw) -> torch.Tensor:
    """Uneven, in any order, at times with two that are the same."""
    count = draw.one_of(2, 3, 9, 28)
    numbers = torch.tensor([draw.number(400, 700) for _ in range(count)], dtype=torch.float64)
    numbers[-1] = draw.one_of(numbers[-1], numbers[0])
    return numbers * nm


@pytest.mark.parametrize("seed", range(30))
def test_shares_reproduce_every_cubic(seed: int) -> None:
    draw = Draw(seed)
    own = some_wavelengths(draw)
    for count in range(1, len(own)):
        nodes, shares = few_wavelengths(own, count, interpolate=True)
        assert nodes.shape == (count,)
        assert shares.shape == (len(own), count)
        assert own.min() <= nodes.min() <= nodes.max() <= own.max()
        for power in range(min(count, 4)):
            expected, found = (1e-7 / own) ** power, shares @ (1e-7 / nodes) ** power
            torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 6, 9])
@pytest.mark.parametrize("total", [28, 31, 61])
def test_nodes_are_bands_where_these_are_dense(total: int, count: int) -> None:
    """So that what is known of bands, as of a plan's line spreads, is known of them, and theirs are the own PSFs."""
    own = torch.linspace(400, 720, total, dtype=torch.float64) * nm
    nodes, shares = few_wavelengths(own, count, interpolate=True)
    places = [own.tolist().index(node) for node in nodes.tolist()]
    torch.testing.assert_close(shares[places], torch.eye(count, dtype=torch.float64), rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(100))
def test_no_share_is_large(seed: int) -> None:
    """However bands lie: rounding of a PSF is not enlarged, as it were between nodes next to each other."""
    own = some_wavelengths(Draw(seed))
    for count in range(1, len(own)):
        assert float(few_wavelengths(own, count, interpolate=True)[1].abs().sum(1).max()) < 15


@pytest.mark.parametrize("seed", range(30))
def test_groups_share_the_psf_of_their_mean(seed: int) -> None:
    own = some_wavelengths(Draw(seed))
    for count in range(1, len(own)):
        nodes, shares = few_wavelengths(own, count, interpolate=False)
        assert bool(((shares == 0) | (shares == 1)).all())
        assert bool((shares.sum(1) == 1).all())
        assert int(shares.sum(0).max()) - int(shares.sum(0).min()) <= 1
        assert shares.sum(0).tolist() == sorted(shares.sum(0).tolist())  # the larger ones at long wavelengths
        for index, node in enumerate(nodes):
            torch.testing.assert_close(node, own[shares[:, index] == 1].mean())


def test_one_colour_needs_one_psf() -> None:
    nodes, shares = few_wavelengths(torch.full((5,), 550 * nm, dtype=torch.float64), 2, interpolate=True)
    torch.testing.assert_close(nodes, torch.full((2,), 550 * nm, dtype=torch.float64))
    assert bool((shares.sum(1) == 1).all())


def stage(*, zernike: float = 1.0, **accuracy) -> optics.Imaging:
    coefficients = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 0.2, 0.1, 0.3], dtype=torch.float64) * zernike
    aberrated = optics.ZernikeDOE(torch.nn.Parameter(coefficients))
    glass = optics.PlanoConvexLens(25.8 * mm, glass="N-BK7")
    lens = optics.Lens(optics.CircularAperture(4 * mm), glass, aberrated, focus_distance=2.0)
    return optics.Imaging(lens, pixel_pitch=5 * um, **accuracy)


def picture_scene(depth: float | torch.Tensor = 2.5) -> Scene:
    generator = torch.Generator().manual_seed(4)
    return Scene.from_rgb(torch.rand(3, 30, 40, generator=generator, dtype=torch.float64), depth=depth)


def test_the_bank_is_the_cubic_between_psfs() -> None:
    wavelengths, vergences = wavelength_grid(), torch.tensor([0.4, 0.6], dtype=torch.float64)
    asked = {"vergences": vergences, "shape": (17, 21), "like": torch.empty(0, dtype=torch.float64)}
    few = stage(bands=6, interpolate_bands=True)
    nodes, shares = few_wavelengths(wavelengths, 6, interpolate=True)
    torch.testing.assert_close(few.psf_wavelengths(wavelengths), nodes)
    expected = torch.einsum("lg,zghw->zlhw", shares, stage().psf_bank(nodes, **asked))
    torch.testing.assert_close(few.psf_bank(wavelengths, **asked), expected)


@pytest.mark.parametrize("filtered", [True, False], ids=["through a filter", "all bands"])
@pytest.mark.parametrize("full_rank", [True, False], ids=["full rank", "factored"])
def test_a_picture_is_that_of_its_own_bank(filtered: bool, full_rank: bool) -> None:
    """By whatever way it is rendered: that of a PSF that was measured so."""
    scene = picture_scene()
    if full_rank:
        scene = Scene.from_bands(scene.bands(), wavelengths=scene.wavelengths, depth=2.5)
    few = stage(bands=5, interpolate_bands=True, psf_shape=(17, 17))
    vergence = torch.tensor([1 / 2.5], dtype=torch.float64)
    bank = few.psf_bank(scene.wavelengths, vergences=vergence, shape=(17, 17), like=scene.coefficients)
    planes = torch.nn.functional.pad(scene.bands(), (8, 8, 8, 8), mode="reflect")
    expected = torch.nn.functional.conv2d(planes, bank[0][:, None], groups=28)
    found = few(scene)
    if filtered:
        colours = sensor.ColourFilter.nikon()
        found = Camera(few, colours)(scene)
        expected = torch.einsum("cl,blhw->bchw", colours.contraction(scene.wavelengths).double(), expected)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("zernike", [0.0, 1.0], ids=["a round lens", "aberrated"])
def test_once_fringes_are_resolved_errors_fall_with_a_higher_power(zernike: float) -> None:
    """Of a lens of glass, out of focus: with the second and more, where groups have the first."""
    scene = picture_scene()
    whole = stage(zernike=zernike)(scene)

    def off(count: int, *, between: bool) -> float:
        few = stage(zernike=zernike, bands=count, interpolate_bands=between)
        return float((few(scene) - whole).detach().norm() / whole.detach().norm())

    assert off(14, between=True) < off(7, between=True) / 4
    assert off(14, between=False) > off(7, between=False) / 3
    assert off(7, between=True) < 0.6 * off(7, between=False)


def test_what_hides_must_not_be_below_zero() -> None:
    """So bands share PSFs wherever there is a map of depth: the same under every shortcut that a plan may take."""
    ramp = (1 / torch.linspace(0.3, 0.9, 40, dtype=torch.float64)).expand(1, 1, 30, 40)
    deep = picture_scene(ramp)
    for shortcut in ({}, {"occlusion": False}, {"layers": 1}, {"layers": 4, "interpolate": False}):
        between, shared = stage(bands=5, interpolate_bands=True, **shortcut), stage(bands=5, **shortcut)
        torch.testing.assert_close(between(deep), shared(deep))
    flat = picture_scene(2.5)
    between, shared = stage(bands=5, interpolate_bands=True), stage(bands=5)
    assert float((between(flat) - shared(flat)).detach().abs().max()) > 1e-4


def test_what_is_handed_out_is_the_caller_s_own() -> None:
    few, own = stage(bands=5, interpolate_bands=True), wavelength_grid()
    nodes, shares = few.psf_wavelengths(own), few.shares(own)
    kept = nodes.clone(), shares.clone()
    nodes.zero_()
    shares.zero_()
    assert torch.equal(few.psf_wavelengths(own), kept[0])
    assert torch.equal(few.shares(own), kept[1])


def test_gradients_go_through_the_psfs_between() -> None:
    few = stage(bands=2, interpolate_bands=True, psf_shape=(9, 9), samples=64, precision="float64")
    light = torch.rand(3, 8, 9, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    scene = Scene.from_rgb(light, depth=2.5)
    zernike = few.lens.elements[2].coefficients
    (gradient,) = torch.autograd.grad(few(scene).square().sum(), zernike)
    for index in (5, 7):
        values = []
        for step in (1e-5, -1e-5):
            with torch.no_grad():
                zernike[index] += step
                values.append(float(few(scene).square().sum()))
                zernike[index] -= step
        assert float(gradient[index]) == pytest.approx((values[0] - values[1]) / 2e-5, rel=1e-5)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 9])
def test_cubics_are_exact_for_what_they_are(count: int) -> None:
    """Polynomials of as many terms as there are nodes, four at most, at nodes, between and beyond them."""
    generator = torch.Generator().manual_seed(count)
    nodes = torch.rand(count, dtype=torch.float64, generator=generator).sort().values
    at = torch.cat([nodes, torch.linspace(-0.1, 1.1, 40, dtype=torch.float64)])
    powers = torch.arange(min(count, 4))
    weights = cubic_weights(nodes, at)
    torch.testing.assert_close(weights @ nodes[:, None] ** powers, at[:, None] ** powers, rtol=1e-6, atol=1e-6)
    assert int((weights.abs() > 1e-12).sum(1).max()) <= 4
