"""The lens: where it focuses, what it says about itself, MTF and encircled energy, and how it refuses bad input."""

from __future__ import annotations

import math

import numpy as np
import oracles
import pytest
import torch
from torch import nn

from kcam import optics
from kcam.optics.propagation.table import choose
from kcam.units import mm, nm, um

WAVELENGTH = 550 * nm
PSF = {"wavelengths": [WAVELENGTH], "distances": math.inf, "pixel_pitch": 3 * um, "shape": (33, 33)}


def thin_lens(**arguments) -> optics.Lens:
    arguments = arguments or {"focus_distance": math.inf}
    return optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), **arguments)


def singlet(radius: float = 25.8 * mm, diameter: float = 5 * mm, **arguments) -> optics.Lens:
    arguments = arguments or {"focus_distance": 2.0}
    lens = optics.PlanoConvexLens(radius, glass="N-BK7")
    return optics.Lens(optics.CircularAperture(diameter), lens, **arguments)


# ---- paraxial numbers --------------------------------------------------------------------------------------------


def test_focal_length_is_the_lensmakers() -> None:
    lens = singlet()
    # 1/f = (n - 1) / R with Schott's own n_d
    assert lens.focal_length(587.5618 * nm) == pytest.approx(25.8e-3 / 0.51680, rel=2e-5)
    several = lens.focal_length(torch.tensor([486.1327 * nm, 656.2725 * nm], dtype=torch.float64))
    assert several.tolist() == pytest.approx([25.8e-3 / 0.52238, 25.8e-3 / 0.51432], rel=2e-5)
    assert several[0] < several[1], "blue is bent more"


@pytest.mark.parametrize("distance", [0.06, 0.5, 2.0, 1e4, math.inf])
def test_the_sensor_stands_where_the_thin_lens_equation_says(distance: float) -> None:
    lens = thin_lens(focus_distance=distance)
    assert 1 / lens.sensor_distance == pytest.approx(1 / 50e-3 - 1 / distance, rel=1e-14)
    assert lens.focus_distance == pytest.approx(distance, rel=1e-9)
    assert lens.f_number == pytest.approx(lens.sensor_distance / 5e-3, rel=1e-14)


def test_focus_wavelength_sets_the_sensor() -> None:
    red = singlet(focus_distance=math.inf, focus_wavelength=656.2725 * nm)
    assert red.sensor_distance == pytest.approx(25.8e-3 / 0.51432, rel=2e-5)


def test_powers_of_elements_add() -> None:
    elements = optics.ThinLens(100 * mm), optics.ThinLens(200 * mm), optics.Defocus(0.5)
    lens = optics.Lens(optics.CircularAperture(2 * mm), *elements, focus_distance=math.inf)
    # a deliberate defocus is not focused away
    assert lens.focal_length() == pytest.approx(1 / 15, rel=1e-14)
    assert lens.sensor_distance == pytest.approx(1 / 15, rel=1e-14)


def test_training_the_lens_does_not_move_the_sensor() -> None:
    focal = nn.Parameter(torch.tensor(50 * mm, dtype=torch.float64))
    lens = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(focal), focus_distance=2.0)
    before = lens.sensor_distance
    with torch.no_grad():
        focal *= 1.1
    assert lens.sensor_distance == before
    assert lens.focal_length() == pytest.approx(55 * mm)


def test_a_lens_is_rebuilt_from_its_configuration() -> None:
    lens = optics.Lens(
        optics.AnnularAperture(5 * mm, obscuration=0.3),
        optics.PlanoConvexLens(25.8 * mm),
        optics.DOE(torch.rand(20, 20), levels=4, pitch=200 * um),
        optics.Defocus(0.2),
        focus_distance=3.0,
        focus_wavelength=600 * nm,
    )
    configuration = lens.configuration()
    other = optics.Lens(*configuration.pop("elements"), **configuration)
    torch.testing.assert_close(other.psf(**PSF), lens.psf(**PSF), rtol=0, atol=0)


# ---- MTF and encircled energy ------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrate", [True, False])
@pytest.mark.parametrize("pitch", [2 * um, 5 * um])
def test_mtf_of_a_perfect_lens_is_the_discs_overlap_times_the_pixel(pitch: float, integrate: bool) -> None:
    lens = thin_lens()
    n = round(1.2e-3 / pitch) | 1
    arguments = {"wavelengths": [WAVELENGTH], "distances": math.inf, "pixel_pitch": pitch, "shape": (n, n)}
    arguments |= {"samples": 512, "fill_factor": 0.5, "integrate": integrate}
    mtf = lens.mtf(**arguments, propagator="fresnel", dtype=torch.float64)[0, 0].numpy()
    f = (np.arange(n) - n // 2) / (n * pitch)
    assert mtf[n // 2, n // 2] == pytest.approx(1, abs=1e-12)

    def expected(fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        overlap = oracles.circular_mtf(
            np.hypot(fx, fy), wavelength=WAVELENGTH, aperture_radius=2.5e-3, sensor_distance=50e-3
        )
        side = math.sqrt(0.5) * pitch if integrate else 0
        return overlap * np.sinc(fx * side) * np.sinc(fy * side)

    fx, fy = np.meshgrid(f, f)
    # the window leaves out 2 N lambda / pi^2 w = 0.2 % of the light, which dents the MTF around frequency 0
    error = np.abs(mtf - np.abs(expected(fx, fy))).max()
    print(f"MTF at {pitch / um:.0f} um: {error:.1e}")
    assert error < 2.5e-3


def test_encircled_energy_of_a_perfect_lens_is_rayleighs() -> None:
    shape = (65, 65)
    for pitch in (2 * um, 4 * um):
        curve = thin_lens().encircled_energy(
            [WAVELENGTH, 450 * nm], distances=math.inf, pixel_pitch=pitch, shape=shape, propagator="fresnel",
            dtype=torch.float64,
        )  # fmt: skip
        assert curve.shape == (1, 2, 33)
        assert curve[..., 0].tolist() == [[0, 0]]
        for index, wavelength in enumerate((WAVELENGTH, 450 * nm)):
            expected = oracles.airy_encircled_energy(
                np.arange(33) * pitch, wavelength=wavelength, aperture_radius=2.5e-3, sensor_distance=50e-3
            )
            error = np.abs(curve[0, index].numpy() - expected).max()
            print(f"encircled energy at {wavelength / nm:.0f} nm, {pitch / um:.0f} um: {error:.1e}")
            assert error < 1e-4  # of all the light; the matrix form's own error is 2.5e-5


def test_encircled_energy_rises_and_agrees_between_transforms() -> None:
    lens = singlet()
    arguments = {"wavelengths": [WAVELENGTH], "distances": [1.0, 2.0], "pixel_pitch": 4 * um, "shape": (41, 41)}
    arguments |= {"samples": 256, "fill_factor": 0.5, "integrate": False}
    matrix = lens.encircled_energy(**arguments, method="matrix", dtype=torch.float64)
    radial = lens.encircled_energy(**arguments, method="radial", dtype=torch.float64)
    assert matrix.shape == (2, 1, 21)
    assert (matrix - radial).abs().max() < 2e-4  # the sampling error of the matrix form
    assert (radial.diff(dim=-1) > 0).all()
    assert (radial[1, 0, 1:] > radial[0, 0, 1:]).all(), "in focus more light lies within any circle"


def test_mtf_and_encircled_energy_have_finite_gradients() -> None:
    phase = nn.Parameter(torch.zeros(16, 16))
    lens = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), optics.DOE(phase), focus_distance=2.0)
    arguments = {"wavelengths": [WAVELENGTH], "distances": 1.0, "pixel_pitch": 4 * um, "shape": (17, 17)}
    for curve in (lens.mtf(**arguments), lens.encircled_energy(**arguments)):
        (gradient,) = torch.autograd.grad(curve.square().sum(), phase)
        assert torch.isfinite(gradient).all()
        assert gradient.abs().max() > 0


# ---- bad input ---------------------------------------------------------------------------------------------------

ROUND = optics.CircularAperture(5 * mm)
LENSES = [
    (
        lambda: optics.Lens(optics.ThinLens(0.05), focus_distance=2.0),
        ValueError,
        r"exactly one aperture, got 0; add Cir",
    ),
    (
        lambda: optics.Lens(ROUND, optics.SquareAperture(4 * mm), optics.ThinLens(0.05), focus_distance=2.0),
        ValueError,
        r"exactly one aperture, got 2; .*remove all but one",
    ),
    (lambda: optics.Lens(ROUND, nn.Linear(1, 1), focus_distance=2.0), TypeError, r"takes elements .* got Linear"),
    (lambda: thin_lens(focus_distance=2.0, sensor_distance=0.05), ValueError, r"either focus_distance= or sensor_dist"),
    (lambda: optics.Lens(ROUND, optics.ThinLens(0.05)), ValueError, r"either focus_distance= or sensor_distance="),
    (lambda: thin_lens(focus_distance=0.04), ValueError, r"0.04 m is inside the focal length 0.05 m.*beyond 0.05 m"),
    (lambda: thin_lens(focus_distance=0.05), ValueError, r"inside the focal length"),
    (lambda: thin_lens(focus_distance=-2.0), ValueError, r"focus_distance -2 is not a distance in front of the lens"),
    (lambda: thin_lens(focus_distance=float("nan")), ValueError, r"focus_distance nan is not a distance"),
    (lambda: thin_lens(sensor_distance=0.0), ValueError, r"sensor_distance must be finite and > 0 m, got 0"),
    (lambda: thin_lens(sensor_distance=math.inf), ValueError, r"sensor_distance must be finite and > 0 m, got inf"),
    (lambda: optics.Lens(ROUND, focus_distance=2.0), ValueError, r"has a power of -?0 1/m at 550 nm and cannot focus"),
    (
        lambda: optics.Lens(ROUND, optics.ThinLens(-0.05), focus_distance=2.0),
        ValueError,
        r"power of -20 1/m .* cannot focus: add a ThinLens",
    ),
    (lambda: singlet(radius=2.5 * mm), ValueError, r"r = 0.0025 m, .*R = 0.0025 m \(r >= R\).* below 0.005 m"),
    (lambda: thin_lens(focus_distance=2.0, focus_wavelength=550), ValueError, r"did you mean 550 \* nm"),
]


@pytest.mark.parametrize(("make", "error", "text"), LENSES, ids=range(len(LENSES)))
def test_bad_lenses_say_what_is_wrong(make, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        make()


QUERIES = [
    ({"wavelengths": [550]}, r"wavelength 550 is outside .* did you mean 550 \* nm"),
    ({"wavelengths": [0.55]}, r"wavelength 0.55 is outside .* did you mean 0.55 \* um"),
    ({"wavelengths": []}, r"wavelengths must be a vector \(L,\) with L >= 1"),
    ({"wavelengths": torch.zeros(2, 2)}, r"wavelengths must be a vector .* got shape \(2, 2\)"),
    ({"wavelengths": [float("nan")]}, r"wavelength nan is outside .* in metres, such as 550 \* nm\.$"),
    ({"wavelengths": [-550 * nm]}, r"wavelength -5.5e-07 is outside .* in metres, such as 550 \* nm\.$"),
    ({"pixel_pitch": float("nan")}, r"pixel_pitch nan is outside .* in metres, such as 4 \* um\.$"),
    ({"pixel_pitch": 4.0}, r"pixel_pitch 4 is outside .* did you mean 4 \* um"),
    ({"pixel_pitch": 4000.0}, r"pixel_pitch 4000 is outside .* did you mean 4000 \* nm"),
    ({"pixel_pitch": -4 * um}, r"pixel_pitch -4e-06 is outside"),
    ({"distances": 0.0}, r"distance 0 is not a distance in front of the lens"),
    ({"distances": [2.0, -1.0]}, r"distance -1 is not a distance"),
    ({"distances": float("nan")}, r"distance nan is not a distance"),
    ({"distances": torch.ones(2, 2)}, r"distances must be a number or a vector \(Z,\) .* got shape \(2, 2\)"),
    ({"distances": []}, r"distances must be .* a vector \(Z,\) with Z >= 1, got shape \(0,\)"),
    ({"distances": torch.zeros(0)}, r"distances must be .* a vector \(Z,\) with Z >= 1, got shape \(0,\)"),
    ({"distances": 1e-300}, r"distance 1e-300 is too near: expected metres >= 1e-07"),
    ({"shape": (33,)}, r"shape must be two positive integers \(H, W\) in pixels, got \(33,\)"),
    ({"shape": 33}, r"shape must be two positive .* got 33. Use shape=\(33, 33\)"),
    ({"shape": (33, 0)}, r"shape must be two positive integers"),
    ({"shape": (33.0, 33)}, r"shape must be two positive integers"),
    ({"propagator": "fraunhofer"}, r"unknown propagator 'fraunhofer'; known: nonparaxial, fresnel"),
    ({"method": "nufft"}, r"nonparaxial has no method 'nufft'; known: matrix, chirp_z, fft, radial"),
    ({"propagator": "geometric", "method": "fft"}, r"geometric has no method 'fft'; known: rays"),
    ({"samples": 16}, r"samples must be an integer >= 32 .* got 16"),
    ({"samples": 10**6}, r"samples 1000000 across the pupil is above the limit of 8192. Leave samples out"),
    ({"samples": 64.0}, r"samples must be an integer >= 32 .* got 64.0"),
    ({"fill_factor": 0.0}, r"fill_factor 0 must be in \(0, 1\]"),
    ({"fill_factor": 1.5}, r"fill_factor 1.5 must be in \(0, 1\]"),
    ({"dtype": torch.float16}, r"dtype must be torch.float32 or torch.float64, got torch.float16; cast"),
]


@pytest.mark.parametrize(("change", "text"), QUERIES, ids=range(len(QUERIES)))
def test_bad_queries_say_what_is_wrong(change: dict, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        thin_lens().psf(**(PSF | change))


def test_the_nearest_distance_still_has_a_psf() -> None:
    assert thin_lens().psf(**(PSF | {"distances": 1e-7})).isfinite().all()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"wavelengths": "all"}, r"wavelengths must be numbers of metres such as \[450 \* nm.*got 'all'. Write a"),
        ({"wavelengths": ["550 nm"]}, r"wavelengths must be numbers of metres .* got \['550 nm'\]"),
        ({"distances": "2 m"}, r"distance must be a number of metres such as 2.0, got '2 m'. Write a number, not text"),
        ({"distances": None}, r"distance must be a number of metres such as 2.0, got None"),
        ({"pixel_pitch": "3um"}, r"pixel_pitch must be a number of metres such as 4 \* um, got '3um'. Write a number"),
        ({"pixel_pitch": [3 * um, 3 * um]}, r"pixel_pitch must be a number of metres .*, got 2 of them"),
    ],
)
def test_what_is_no_number_is_named(change: dict, text: str) -> None:
    with pytest.raises(TypeError, match=text):
        thin_lens().psf(**(PSF | change))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, r"focal_length must be finite and not 0 m, got 0. Use one such as 50 \* mm"),
        (1e-30, r"focal_length 1e-30 m is shorter than 1e-07 m"),
    ],
)
def test_a_focal_length_trained_to_nothing_is_an_error(value: float, text: str) -> None:
    focal = nn.Parameter(torch.tensor(50 * mm))
    lens = optics.Lens(ROUND, optics.ThinLens(focal), focus_distance=2.0)
    with torch.no_grad():
        focal.fill_(value)
    with pytest.raises(ValueError, match=text):
        lens.psf(**PSF)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "transmission is 0 everywhere: no light passes this aperture. Open at least one pixel"),
        (-1.0, r"transmission must be in \[0, 1\], got -1..-1; .* where it trains, clamp_\(0, 1\) it after each step"),
        (3.0, r"transmission must be in \[0, 1\], got 3..3"),
    ],
)
def test_a_transmission_trained_out_of_its_range_is_an_error(value: float, text: str) -> None:
    transmission = nn.Parameter(torch.ones(4, 4))
    aperture = optics.ApertureMap(transmission, width=5 * mm)
    lens = optics.Lens(aperture, optics.ThinLens(50 * mm), focus_distance=2.0)
    with torch.no_grad():
        transmission.fill_(value)
    with pytest.raises(ValueError, match=text):
        lens.psf(**PSF)


def test_counts_may_be_numpys() -> None:
    lens, plain = thin_lens(), PSF | {"shape": (33, 31), "samples": 64}
    numpys = plain | {"shape": (np.int64(33), np.int32(31)), "samples": np.int64(64)}
    for ask in (lens.psf, lens.mtf, lens.encircled_energy):
        torch.testing.assert_close(ask(**numpys), ask(**plain), rtol=0, atol=0)


def test_glass_and_wavelength_must_fit() -> None:
    with pytest.raises(ValueError, match=r"wavelength 2800 nm is outside the Sellmeier range of N-BK7"):
        singlet().psf(**(PSF | {"wavelengths": [2.8 * um]}))


def test_a_pupil_too_coarse_for_the_window_is_an_error_that_names_the_sampling() -> None:
    lens = thin_lens()
    arguments = PSF | {"shape": (297, 297), "method": "matrix"}
    with pytest.raises(ValueError, match=r"a pupil of 64 samples is too coarse .* Use samples >= (\d+)") as caught:
        lens.psf(**arguments, samples=64)
    enough = int(str(caught.value).split(">= ")[1].split(",")[0])
    assert lens.psf(**arguments, samples=enough).shape == (1, 1, 297, 297)


def test_a_blur_beyond_all_sampling_is_an_error() -> None:
    lens = optics.Lens(optics.CircularAperture(20 * mm), optics.ThinLens(50 * mm), focus_distance=2.0)
    with pytest.raises(ValueError, match=r"needs \d+ pupil samples at 550 nm .* the limit of 8192. Use a smaller"):
        lens.psf(**(PSF | {"distances": 0.02}), method="matrix")


def test_an_fft_that_would_take_too_many_samples_leaves_it_to_others() -> None:
    """Bins that fall on the points ask for twice the samples, each of 320 bytes."""
    aberration = torch.zeros(11)
    aberration[10] = 1e-6
    lens = optics.Lens(ROUND, optics.ThinLens(50 * mm), optics.ZernikeAberration(aberration), focus_distance=2.0)
    query = PSF | {"pixel_pitch": 6 * um, "shape": (4001, 4001)}
    with pytest.raises(ValueError, match=r"nonparaxial/fft needs \d+ pupil samples .* the limit of 8192; use method="):
        lens.psf(**query, method="fft")
    assert choose(lens.query(**query)).method == "chirp_z"


def test_a_curvature_trained_into_the_aperture_is_an_error() -> None:
    radius = nn.Parameter(torch.tensor(25 * mm))
    lens = optics.Lens(optics.CircularAperture(5 * mm), optics.PlanoConvexLens(radius), focus_distance=2.0)
    with torch.no_grad():
        radius.fill_(2 * mm)
    with pytest.raises(ValueError, match=r"\(r >= R\)"):
        lens.psf(**PSF)


def test_the_corners_of_a_square_aperture_must_stay_on_the_surface_too() -> None:
    with pytest.raises(ValueError, match=r"\(r >= R\)"):  # the corner is at 2.83 mm, the surface ends at 2.5 mm
        optics.Lens(optics.SquareAperture(4 * mm), optics.PlanoConvexLens(2.5 * mm), focus_distance=2.0)


def test_a_parameter_in_millimetres_is_named_as_a_number() -> None:
    with pytest.raises(ValueError, match=r"diameter 5 m is no aperture.*did you mean 5 \* mm"):
        optics.CircularAperture(nn.Parameter(torch.tensor(5.0)))


def test_a_lone_shape_is_refused_by_every_question() -> None:
    arguments = {"distances": 2.0, "pixel_pitch": 4 * um, "shape": 65}
    for ask in (thin_lens().psf, thin_lens().mtf, thin_lens().encircled_energy, thin_lens().explain):
        with pytest.raises(ValueError, match=r"shape must be two positive integers .*65"):
            ask([WAVELENGTH], **arguments)


def test_a_lens_prints_where_its_sensor_is() -> None:
    assert "sensor_distance=0.05" in repr(thin_lens())
