import inspect
import math

import pytest
import torch
from scipy import optimize
from torch import nn

from kcam import spectral
from kcam.context import Context
from kcam.sensor import ColourFilter, fit_gaussians, mosaic
from kcam.sensor.colour_filter import LEAST_ALPHA, fitted, gaussian_basis
from kcam.units import nm, wavelength_grid

FINE = torch.arange(400, 741, dtype=torch.float64) * nm
PRESETS = {
    "kodak": ColourFilter.kodak,
    "nikon": ColourFilter.nikon,
    "sigma": ColourFilter.sigma,
    "rgbw": ColourFilter.rgbw,
    "learned": lambda: ColourFilter.learned(4),
}


def test_basis_is_the_normal_density_per_spacing():
    grid = torch.arange(200, 1001, dtype=torch.float64) * nm
    for width in (13, 18, 30):
        basis = gaussian_basis(grid, width=width * nm)
        torch.testing.assert_close(basis.sum(1) * nm, torch.full((12,), 300 / 11 * nm, dtype=torch.float64))
        inside = (grid > 460 * nm) & (grid < 680 * nm)
        assert (basis.sum(0)[inside] - 1).abs().max() < 0.04
        i, at = 4, 555 * nm  # eq. 3.9 by hand
        mu = 420 * nm + i * 300 * nm / 11
        by_hand = math.exp(-0.5 * ((at - mu) / (width * nm)) ** 2) / (width * math.sqrt(2 * math.pi)) * 300 / 11
        assert basis[i, 355].item() == pytest.approx(by_hand, rel=1e-9)


def test_fit_finds_the_coefficients_that_made_a_curve():
    alpha = torch.tensor([[0, 0, 0.2, 0.9, 0.4, 0, 0, 0, 0.1, 0, 0, 0.3]] * 3, dtype=torch.float64)
    curves = alpha @ gaussian_basis(FINE, width=20 * nm)
    fit = fit_gaussians(curves / curves[1].max(), wavelengths=FINE)
    assert fit.width == pytest.approx(20 * nm)
    assert max(fit.errors) < 1e-9
    torch.testing.assert_close(fit.coefficients * curves[1].max(), alpha, atol=1e-8, rtol=0)


@pytest.mark.parametrize("seed", range(6))
def test_a_fit_does_not_depend_on_the_scale_of_its_curves(seed):
    """Random humps, in any scale: the width is that of the least residual, and the errors are what they are said."""
    generator = torch.Generator().manual_seed(seed)
    count = int(torch.randint(1, 5, (), generator=generator))
    centres = 440 + 260 * torch.rand(count, 2, 1, generator=generator, dtype=torch.float64)
    widths = 15 + 60 * torch.rand(count, 2, 1, generator=generator, dtype=torch.float64)
    humps = torch.exp(-0.5 * ((FINE / nm - centres) / widths) ** 2).sum(1)
    humps = humps * (0.3 + torch.rand(count, 1, generator=generator))
    green = humps[min(1, count - 1)].max()
    one = fit_gaussians(humps / green, wavelengths=FINE)
    for factor in (1e-6, 0.37, 1.0, 4095.0, 1e12):
        fit = fit_gaussians(humps * factor, wavelengths=FINE)
        assert fit.width == one.width
        torch.testing.assert_close(fit.coefficients, one.coefficients, rtol=0, atol=1e-9)
        assert fit.errors == pytest.approx(one.errors, abs=1e-9)
    true = (one.coefficients @ gaussian_basis(FINE, width=one.width) - humps / green).square().mean(1).sqrt()
    assert one.errors == pytest.approx(true.tolist(), abs=1e-12)
    residuals = []
    for width in range(13, 31):  # independently, and without the scaling to a peak of 1, which costs up to 30 %
        basis = gaussian_basis(FINE, width=width * nm).T.numpy()
        residuals.append(math.hypot(*(optimize.nnls(basis, hump.numpy())[1] for hump in humps / green)))
    assert math.hypot(*one.errors) <= 1.5 * min(residuals) / math.sqrt(len(FINE)) + 1e-6


@pytest.mark.parametrize("seed", range(8))
def test_a_fit_says_nothing_of_light_that_its_curves_do_not_reach(seed):
    """Random curves on random short or coarse grids: a Gaussian that is far from all of it had 1e52 once."""
    generator = torch.Generator().manual_seed(seed)
    first = float(400 + 300 * torch.rand((), generator=generator))
    count = int(torch.randint(1, 12, (), generator=generator))
    step = float(1 + 30 * torch.rand((), generator=generator))
    grid = (first + step * torch.arange(count, dtype=torch.float64))[: max(1, int((760 - first) / step))] * nm
    curves = 0.1 + torch.rand(3, len(grid), generator=generator, dtype=torch.float64)
    fit = fit_gaussians(curves, wavelengths=grid)
    far = (torch.linspace(420, 720, 12, dtype=torch.float64)[:, None] * nm - grid).abs().amin(1) > 60 * nm
    assert float(fit.coefficients[:, far].sum()) == 0
    assert 0 < float(fit.coefficients.max()) < 100


@pytest.mark.parametrize(
    ("curves", "wavelengths", "text"),
    [
        (torch.ones(3, 341), FINE / nm, r"wavelength 400 is outside 1e-07..2e-05 m.*did you mean 400 \* nm\?"),
        (torch.ones(341), FINE, r"curves must be a tensor \(C, 341\), one value per wavelength, got \(341,\)"),
        (torch.ones(3, 340), FINE, r"curves must be a tensor \(C, 341\).*got \(3, 340\)"),
        (torch.zeros(3, 341), FINE, r"green's peak \(channel 1\) above 0; it is 0"),
        (torch.full((1, 341), math.nan), FINE, "curves must be finite"),
        (torch.ones(1, 3), torch.tensor([1000, 1001, 1002]) * nm, "peaks at 1000 nm; the Gaussians, at 420 to 720 nm"),
    ],
)
def test_what_cannot_be_fitted_is_said(curves, wavelengths, text):
    with pytest.raises(ValueError, match=text):
        fit_gaussians(curves, wavelengths=wavelengths)


@pytest.mark.parametrize(
    ("name", "errors"),
    [
        ("kodak", (0.016, 0.006, 0.005)),
        ("nikon_5100", (0.069, 0.017, 0.05)),
        ("sigma_sd_merrill", (0.038, 0.031, 0.025)),
    ],
)
def test_fits_are_as_close_as_stated(name, errors):
    fit = fitted(name)
    assert (fit.coefficients >= 0).all()
    assert all(error <= limit for error, limit in zip(fit.errors, errors, strict=True))
    curves = fit.coefficients @ gaussian_basis(FINE, width=fit.width)
    true = spectral.sensitivity(name, wavelengths=FINE)
    torch.testing.assert_close((curves - true).square().mean(1).sqrt(), torch.tensor(fit.errors, dtype=torch.float64))
    assert curves[1].max().item() == pytest.approx(1.0, abs=1e-12)


def test_white_of_rgbw_lies_above_the_colours():
    response = ColourFilter.rgbw().response(FINE)
    assert response.shape == (4, 341)
    assert (response[3] > response[:3].amax(0))[30:311].all()  # 430 to 710 nm
    torch.testing.assert_close(response[:3], ColourFilter.kodak().response(FINE))


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("wavelengths", [None, [550 * nm], [700 * nm, 450 * nm, 520 * nm, 610 * nm]])
def test_forward_is_finish_of_the_contraction(name, wavelengths):
    colour_filter, grid = PRESETS[name](), wavelength_grid(wavelengths)
    bands = torch.rand(2, len(grid), 5, 7, dtype=torch.float64)
    planes = torch.einsum("kl,blhw->bkhw", colour_filter.contraction(grid), bands)
    result = colour_filter(bands, Context(wavelengths=grid))
    torch.testing.assert_close(result, colour_filter.finish(planes), rtol=1e-12, atol=1e-12)
    assert result.shape == (2, {"rgbw": 4, "learned": 1}.get(name, 3), 5, 7)


def test_a_channel_is_the_integral_of_curve_times_light():
    colour_filter = ColourFilter.kodak()
    grid = torch.arange(420, 721, dtype=torch.float64) * nm
    bands = (1 + torch.sin(grid / (40 * nm)))[None, :, None, None]
    expected = torch.trapezoid(colour_filter.response(grid) * bands[0, :, 0, 0], grid) / (100 * nm)
    result = colour_filter(bands, Context(wavelengths=grid))[0, :, 0, 0]
    torch.testing.assert_close(result, expected, rtol=0.01, atol=1e-3)
    torch.testing.assert_close(colour_filter.white(grid, illuminant=bands[0, :, 0, 0]), result, rtol=1e-9, atol=1e-9)


def test_scaling_the_coefficients_scales_the_signal():
    one = ColourFilter.kodak()
    two = ColourFilter(2 * one.coefficients, width=one.width)
    bands = torch.rand(1, 28, 3, 3)
    torch.testing.assert_close(two(bands), 2 * one(bands))


@pytest.mark.parametrize("size", [(8, 8), (9, 5), (1, 1), (3, 2)])
@pytest.mark.parametrize("tile", [1, 3, 4])
def test_the_tile_repeats_from_the_top_left(tile, size):
    colour_filter = ColourFilter(torch.rand(tile, tile, 12, dtype=torch.float64))
    planes = torch.rand(2, 12, *size, dtype=torch.float64)
    result = colour_filter.finish(planes)
    assert result.shape == (2, 1, *size)
    for y in range(size[0]):
        for x in range(size[1]):
            expected = planes[:, :, y, x] @ colour_filter.coefficients[y % tile, x % tile]
            torch.testing.assert_close(result[:, 0, y, x], expected)


def test_the_learned_tile_starts_as_a_mosaic_of_the_kodak_filter():
    tile, kodak = ColourFilter.learned(), ColourFilter.kodak()
    assert tile.coefficients.shape == (28, 28, 12)
    assert isinstance(tile.coefficients, nn.Parameter)
    assert tile.coefficients.isfinite().all()
    bands = torch.rand(1, 28, 30, 31)
    raw = mosaic(kodak(bands), pattern="RGGB")
    assert (tile(bands) - raw).abs().max() < 0.02  # coefficients of 0 start at 0.01
    torch.testing.assert_close(
        tile.response(FINE)[0], kodak.response(FINE).T @ torch.tensor([0.25, 0.5, 0.25]).double(), atol=0.011, rtol=0
    )
    assert ColourFilter.learned(3).coefficients.shape == (3, 3, 12)


def test_the_learned_tile_stays_non_negative_and_learns():
    colour_filter = ColourFilter.learned(2)
    optimiser = torch.optim.Adam(colour_filter.parameters(), lr=0.1)
    for _ in range(60):
        optimiser.zero_grad()
        colour_filter(torch.ones(1, 28, 2, 2)).sum().backward()  # asks for a filter as dark as possible
        optimiser.step()
    assert (colour_filter.alpha() >= 0).all()
    assert colour_filter(torch.ones(1, 28, 2, 2)).max() < 0.05


def test_gradients_reach_the_coefficients():
    bands = torch.rand(1, 5, 3, 4, dtype=torch.float64, requires_grad=True)
    grid = torch.linspace(430, 700, 5, dtype=torch.float64) * nm
    for shape, softplus in (((3, 12), False), ((2, 2, 12), True)):
        raw = torch.rand(shape, dtype=torch.float64, requires_grad=True)
        cut = torch.tensor(650.0, dtype=torch.float64, requires_grad=True)

        def run(bands, raw, cut, softplus=softplus):
            colour_filter = ColourFilter(raw, softplus=softplus, infrared_cut=cut * nm)
            return colour_filter(bands, Context(wavelengths=grid))

        assert torch.autograd.gradcheck(run, (bands, raw, cut))


def test_infrared_cut_halves_at_its_edge_and_is_smooth():
    plain, cut = ColourFilter.kodak(), ColourFilter.kodak(infrared_cut=650 * nm)
    ratio = cut.response(FINE)[0] / plain.response(FINE)[0]
    assert ratio[250].item() == pytest.approx(0.5)
    assert ratio[200] > 0.99
    assert ratio[300] < 0.01
    assert (ratio.diff() < 0).all()
    trained = ColourFilter(plain.coefficients, infrared_cut=nn.Parameter(torch.tensor(650 * nm)))
    trained(torch.rand(1, 28, 2, 2)).sum().backward()
    assert trained.infrared_cut.grad.isfinite()


@pytest.mark.parametrize("name", PRESETS)
def test_arguments_are_attributes_that_rebuild_the_filter(name):
    one = PRESETS[name]()
    two = ColourFilter(**{key: getattr(one, key) for key in inspect.signature(ColourFilter).parameters})
    bands = torch.rand(1, 28, 4, 4)
    assert torch.equal(one(bands), two(bands))
    assert isinstance(two.coefficients, nn.Parameter) is (name == "learned")
    assert "coefficients" in one.state_dict()
    assert one.provides() == {"colour_filter": one}
    assert "12" in repr(one)


def test_a_white_pixel_fills_faster_than_a_green_one():
    white = ColourFilter.rgbw().white(wavelength_grid())
    assert (0.27 * white[3] / white[1]).item() == pytest.approx(0.8, abs=0.03)


def test_a_parameter_trains_and_a_tensor_is_a_buffer():
    assert list(ColourFilter.kodak().buffers())
    assert not list(ColourFilter.kodak().parameters())
    assert list(ColourFilter(nn.Parameter(torch.rand(1, 12))).parameters())


def test_one_channel_any_dtype_and_an_empty_batch():
    mono = ColourFilter(torch.rand(1, 12))
    for dtype in (torch.float16, torch.bfloat16, torch.float32, torch.float64):
        out = mono(torch.rand(2, 28, 3, 5, dtype=dtype))
        assert out.shape == (2, 1, 3, 5)
        assert out.dtype == dtype
        assert ColourFilter.learned(2)(torch.rand(1, 28, 3, 5, dtype=dtype)).dtype == dtype
    assert mono(torch.rand(0, 28, 3, 5)).shape == (0, 1, 3, 5)
    assert ColourFilter.learned(2)(torch.rand(0, 28, 3, 5)).shape == (0, 1, 3, 5)
    assert mono(torch.rand(28, 3, 5)).shape == (1, 3, 5)


@pytest.mark.parametrize(
    ("build", "error", "text"),
    [
        (lambda: ColourFilter(torch.rand(3, 11)), ValueError, r"curves \(C, 12\) or a tile.*got shape \(3, 11\)"),
        (lambda: ColourFilter(torch.rand(12)), ValueError, r"got shape \(12,\)"),
        (lambda: ColourFilter(torch.rand(0, 12)), ValueError, r"got shape \(0, 12\)"),
        (lambda: ColourFilter(-torch.ones(3, 12)), ValueError, "finite and >= 0: light is absorbed.*from -1 to -1"),
        (lambda: ColourFilter(torch.full((3, 12), torch.nan), softplus=True), ValueError, "must be finite: light"),
        (lambda: ColourFilter([[1.0] * 12]), TypeError, "floating-point tensor, got list"),
        (lambda: ColourFilter(torch.ones(3, 12, dtype=torch.int64)), TypeError, "got a tensor of torch.int64"),
        (
            lambda: ColourFilter(torch.rand(3, 12), width=18.0),
            ValueError,
            r"width 18 is outside.*did you mean 18 \* nm",
        ),
        (lambda: ColourFilter.kodak(infrared_cut=650.0), ValueError, r"did you mean 650 \* nm"),
        (lambda: ColourFilter.learned(0), ValueError, "tile must be >= 1 pixel, got 0"),
        (lambda: ColourFilter.learned(2.5), TypeError, "tile must be a whole number of pixels such as 28, got 2.5"),
    ],
)
def test_errors(build, error, text):
    with pytest.raises(error, match=text):
        build()


@pytest.mark.parametrize("name", ["coefficients", "infrared_cut"])
def test_a_filter_trained_into_nan_is_an_error(name):
    cut = torch.nn.Parameter(torch.tensor(650e-9))
    kodak = ColourFilter(torch.nn.Parameter(torch.rand(3, 12)), infrared_cut=cut)
    with torch.no_grad():
        getattr(kodak, name).fill_(torch.nan)
    for ask in (lambda: kodak(torch.rand(1, 28, 4, 4)), lambda: kodak.contraction(wavelength_grid())):
        with pytest.raises(ValueError, match=f"{name} of the colour filter has .* NaN or infinite; .* a smaller step"):
            ask()


def test_bands_and_wavelengths_must_agree():
    kodak, grid = ColourFilter.kodak(), wavelength_grid()
    with pytest.raises(ValueError, match="the signal has 31 bands, but there are 28 wavelengths"):
        kodak(torch.rand(1, 31, 4, 4))
    with pytest.raises(ValueError, match="the illuminant has 3 bands, but there are 28 wavelengths"):
        kodak.white(grid, illuminant=torch.ones(3))
    with pytest.raises(ValueError, match=r"expected bands \(\.\.\., L, H, W\), got shape \(28, 4\)"):
        kodak(torch.rand(28, 4))
    with pytest.raises(ValueError, match=r"expects the 3 planes.*got shape \(1, 28, 4, 4\)"):
        kodak.finish(torch.rand(1, 28, 4, 4))
    with pytest.raises(ValueError, match=r"expects the 12 planes.*got shape \(1, 3, 4, 4\)"):
        ColourFilter.learned(2).finish(torch.rand(1, 3, 4, 4))


TO_TRAIN = {
    "kodak": ColourFilter.kodak,
    "nikon": lambda: ColourFilter.nikon(infrared_cut=650 * nm),
    "sigma": ColourFilter.sigma,
    "rgbw": ColourFilter.rgbw,
    "tile": lambda: ColourFilter(torch.rand(3, 2, 12) * (torch.rand(3, 2, 12) > 0.5)),
    "dark": lambda: ColourFilter(torch.zeros(1, 12)),
}


@pytest.mark.parametrize("name", TO_TRAIN)
def test_a_trainable_filter_starts_as_its_curves(name):
    torch.manual_seed(0)
    fixed = TO_TRAIN[name]()
    learned = fixed.trainable()
    assert isinstance(learned.coefficients, nn.Parameter)
    assert learned.softplus
    assert (learned.width, learned.infrared_cut, learned.is_tile) == (fixed.width, fixed.infrared_cut, fixed.is_tile)
    # float32 behind a softplus of values up to 12: a rounding of 1e-6 at most
    torch.testing.assert_close(learned.alpha(), fixed.alpha().clamp(min=LEAST_ALPHA), atol=2e-6, rtol=0)
    raised = learned.response(FINE) - fixed.response(FINE)
    # Gaussians that add up to at most 1.04 (see the first test), each raised by 0.01 at most
    assert raised.min() > -1e-5
    assert raised.max() < 1.04 * LEAST_ALPHA + 1e-5
    torch.testing.assert_close(fixed.coefficients, before := fixed.coefficients.clone())  # it is another filter
    with torch.no_grad():
        learned.coefficients += 1
    assert torch.equal(fixed.coefficients, before)


@pytest.mark.parametrize("name", TO_TRAIN)
def test_every_coefficient_of_a_trainable_filter_learns(name):
    torch.manual_seed(0)
    learned = TO_TRAIN[name]().trainable()
    channels = 1 if learned.is_tile else len(learned.coefficients)
    bands = torch.rand(1, 28, 6, 6) + 0.1
    (learned(bands) * torch.arange(1, channels + 1)[:, None, None]).sum().backward()
    gradient = learned.coefficients.grad
    assert gradient.isfinite().all()
    # the slope of the softplus at 0.01 is 0.095; an infrared cut at 650 nm leaves 5e-4 of the last Gaussian, at 720 nm
    slope = 1 - math.exp(-10 * LEAST_ALPHA)
    assert gradient.min() > 0.5 * slope * gradient.max() * (5e-5 if learned.infrared_cut else 5e-2)


@pytest.mark.parametrize("step", [-1e4, -3.0, 3.0, 1e4])
@pytest.mark.parametrize("name", TO_TRAIN)
def test_a_trainable_filter_is_not_negative_after_a_wild_step(name, step):
    learned = TO_TRAIN[name]().trainable()
    with torch.no_grad():
        learned.coefficients += step * torch.randn(learned.coefficients.shape, generator=torch.manual_seed(0))
    assert (learned.alpha() >= 0).all()
    assert learned.alpha().isfinite().all()
    result = learned(torch.rand(1, 28, 4, 4))
    assert (result >= 0).all()
    result.sum().backward()
    assert learned.coefficients.grad.isfinite().all()
    assert (learned.coefficients.grad >= 0).all()  # less than no light is never asked for


def test_training_a_trained_filter_changes_nothing():
    once = ColourFilter.nikon().trainable()
    torch.testing.assert_close(once.trainable().alpha(), once.alpha(), atol=1e-6, rtol=0)
    assert ColourFilter(torch.rand(1, 12).double()).trainable().coefficients.dtype == torch.float32
