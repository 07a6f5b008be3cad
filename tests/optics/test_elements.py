"""What each element adds to the optical path and what it lets through, against formulas written down here again."""

from __future__ import annotations

import math

import numpy as np
import oracles
import pytest
import torch
from torch import nn

from kcam import optics
from kcam.optics.elements.element import Element
from kcam.optics.elements.zernike import noll_indices, zernike_sum
from kcam.optics.pupil.coordinates import Pupil
from kcam.units import mm, nm

WAVELENGTHS = torch.tensor([450, 550, 650], dtype=torch.float64) * nm


def pupil(*, semi_aperture: float = 2.5 * mm, sensor_distance: float = 50 * mm, paraxial: bool = True) -> Pupil:
    generator = torch.Generator().manual_seed(1)
    radius = torch.rand(200, generator=generator, dtype=torch.float64).sqrt()
    angle = 2 * math.pi * torch.rand(200, generator=generator, dtype=torch.float64)
    radius[0] = 0
    scalars = (torch.tensor(value, dtype=torch.float64) for value in (semi_aperture, sensor_distance))
    return Pupil(radius * angle.cos(), radius * angle.sin(), *scalars, paraxial)


def path(element: Element, at: Pupil, wavelengths: torch.Tensor = WAVELENGTHS) -> torch.Tensor:
    """The whole OPD of an element, (L, points) [m]."""
    opd = element.vergence(wavelengths)[:, None] * at.rho2 * at.semi_aperture**2 / 2
    for coefficients, term in element.terms(at, wavelengths):
        opd = opd + coefficients[:, None] * term
    return opd


# ---- optical paths -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("glass", [1.5, "N-BK7"])
def test_plano_convex_lens_is_the_exact_sphere(glass: str | float) -> None:
    at = pupil()
    radius = 25.8 * mm
    n = optics.refractive_index(glass, wavelengths=WAVELENGTHS)
    r2 = at.rho2 * at.semi_aperture**2
    sphere = (n[:, None] - 1) * (torch.sqrt(radius**2 - r2) - radius)
    error = (path(optics.PlanoConvexLens(radius, glass=glass), at) - sphere).abs().max()
    assert error < 1e-17  # the sphere's own cancellation: eps * R = 6e-18 m; a wave is 5e-7 m


def test_thin_lens_is_a_parabola_in_the_paraxial_model() -> None:
    at = pupil()
    expected = -at.rho2 * at.semi_aperture**2 / (2 * 40 * mm)
    torch.testing.assert_close(path(optics.ThinLens(40 * mm), at)[1], expected, rtol=1e-14, atol=0)


@pytest.mark.parametrize("distance", [math.inf, 2.0, 0.1])
def test_thin_lens_focuses_its_own_pair_of_points_exactly(distance: float) -> None:
    sensor = 50 * mm
    at = pupil(semi_aperture=10 * mm, sensor_distance=sensor, paraxial=False)
    focal = 1 / (1 / sensor + 1 / distance)
    r2 = at.rho2 * at.semi_aperture**2
    source = r2 / (distance + torch.sqrt(distance**2 + r2)) if distance < math.inf else 0 * r2
    converging = r2 / (sensor + torch.sqrt(sensor**2 + r2))
    total = source + converging + path(optics.ThinLens(focal), at)[0]
    assert total.abs().max() < 1e-17  # a stigmatic pair: no path is left over, to rounding of 2e-3 m


def test_defocus_is_a_vergence() -> None:
    at = pupil()
    expected = 0.7 * at.rho2 * at.semi_aperture**2 / 2
    torch.testing.assert_close(path(optics.Defocus(0.7), at), expected.expand(3, -1), rtol=1e-14, atol=0)


def test_zernike_polynomials_are_nolls() -> None:
    at = pupil()
    rho, theta = np.sqrt(at.rho2.numpy()), np.arctan2(at.y.numpy(), at.x.numpy())
    for j in range(1, 67):  # up to the tenth radial degree
        one = torch.zeros(j, dtype=torch.float64)
        one[j - 1] = 1
        expected = oracles.noll_zernike(j, rho, theta)
        # the Horner form loses a digit or two near the rim in the higher degrees
        np.testing.assert_allclose(zernike_sum(one, at).numpy(), expected, rtol=0, atol=1e-11, err_msg=f"Z_{j}")
        assert noll_indices(j) == oracles.noll_indices(j)


def test_zernike_doe_disperses_by_equation_3_8() -> None:
    at = pupil()
    coefficients = torch.tensor([0, 0, 0, 2.0, -1.0, 0.5], dtype=torch.float64)
    opd = path(optics.ZernikeDOE(coefficients, design_wavelength=500 * nm, glass="N-BK7"), at)
    n = optics.refractive_index(
        "N-BK7", wavelengths=torch.cat([WAVELENGTHS, torch.tensor([500 * nm], dtype=torch.float64)])
    )
    height = zernike_sum(coefficients, at) * 500 * nm / (2 * math.pi) / (n[3] - 1)  # (3.6) at the design wavelength
    torch.testing.assert_close(opd, (n[:3, None] - 1) * height, rtol=1e-12, atol=0)


def test_zernike_aberration_is_the_same_path_at_all_wavelengths() -> None:
    at = pupil()
    opd = path(optics.ZernikeAberration(torch.tensor([0, 0, 0, 50 * nm], dtype=torch.float64)), at)
    torch.testing.assert_close(opd, (50 * nm * math.sqrt(3) * (2 * at.rho2 - 1)).expand(3, -1), rtol=1e-12, atol=1e-22)


def test_radial_doe_passes_through_its_samples_and_follows_a_smooth_profile() -> None:
    radii = torch.linspace(0, 1, 65, dtype=torch.float64)
    smooth = 3 * torch.cos(4 * radii**2)
    element = optics.RadialDOE(smooth, glass=1.5)
    scalars = torch.tensor([2.5 * mm, 50 * mm], dtype=torch.float64)

    def phase(rho: torch.Tensor) -> torch.Tensor:
        opd = path(element, Pupil(rho, 0 * rho, *scalars, True), torch.tensor([550 * nm], dtype=torch.float64))
        return opd[0] * 2 * math.pi / (550 * nm)

    torch.testing.assert_close(phase(radii), smooth, rtol=0, atol=1e-12)
    between = torch.linspace(0, 1, 1001, dtype=torch.float64)
    # Catmull-Rom errs by h^3 f''' / 24-ish at worst: (1/64)^3 * 400 / 24 = 6e-5, and by h^2 f'' / 8 in the last cell
    assert (phase(between) - 3 * torch.cos(4 * between**2)).abs()[: -1001 // 64].max() < 1e-4


def test_doe_heights_and_dispersion() -> None:
    phase = torch.rand(5, 5, dtype=torch.float64) * 9
    doe = optics.DOE(phase, design_wavelength=500 * nm, glass="fused silica")
    n = optics.refractive_index("fused silica", wavelengths=torch.tensor([500 * nm, 650 * nm], dtype=torch.float64))
    height = phase * 500 * nm / (2 * math.pi * (n[0] - 1))
    torch.testing.assert_close(doe.height_map(), height, rtol=1e-12, atol=0)
    pixels = doe.pixel_map(torch.tensor([650 * nm], dtype=torch.float64))
    expected = height * (n[1] - 1) * 2 * math.pi / (650 * nm)  # (3.6) at the other wavelength
    torch.testing.assert_close(pixels.values * pixels.factors, expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("levels", [2, 4, 16])
def test_levels_round_to_what_can_be_etched_and_gradients_pass_straight_through(levels: int) -> None:
    phase = nn.Parameter(torch.linspace(-7, 9, 49, dtype=torch.float64).view(7, 7))
    values = optics.DOE(phase, levels=levels).pixel_map(WAVELENGTHS).values
    steps = values.detach() / (2 * math.pi / levels)
    assert (steps - steps.round()).abs().max() < 1e-12
    assert len(torch.unique(steps.round() % levels)) <= levels
    assert (values - phase).detach().abs().max() <= math.pi / levels + 1e-12
    weight = torch.arange(49, dtype=torch.float64).view(7, 7)
    (values * weight).sum().backward()
    torch.testing.assert_close(phase.grad, weight)


# ---- apertures ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("aperture", "area", "rim"),
    [
        (optics.CircularAperture(5 * mm), math.pi * 6.25e-6, math.pi * 5e-3),
        (optics.AnnularAperture(5 * mm, obscuration=0.4), math.pi * 6.25e-6 * (1 - 0.16), math.pi * 7e-3),
        (optics.SquareAperture(4 * mm), 16e-6, 16e-3),
        (optics.ApertureMap(torch.eye(2), width=4 * mm), 8e-6, 16e-3),
        (optics.ApertureMap(torch.full((3, 3), 0.5), width=3 * mm), 9e-6 / 4, 12e-3 / 4),  # energy: |0.5|^2
    ],
)
def test_open_area_and_rim(aperture: optics.Element, area: float, rim: float) -> None:
    lens = optics.Lens(aperture, optics.ThinLens(50 * mm), focus_distance=math.inf)
    assert lens.aperture_area() == pytest.approx(area, rel=1e-6)  # float32 transmissions
    assert aperture.rim_per_area() == pytest.approx(rim / area, rel=1e-6)


# ---- parameters and buffers --------------------------------------------------------------------------------------

ELEMENTS = [
    lambda wrap: optics.CircularAperture(wrap(5 * mm)),
    lambda wrap: optics.AnnularAperture(wrap(5 * mm), obscuration=0.2),
    lambda wrap: optics.SquareAperture(wrap(5 * mm)),
    lambda wrap: optics.ApertureMap(torch.ones(3, 3), width=wrap(5 * mm)),
    lambda wrap: optics.ThinLens(wrap(50 * mm)),
    lambda wrap: optics.PlanoConvexLens(wrap(25 * mm)),
    lambda wrap: optics.Defocus(wrap(0.1)),
]


@pytest.mark.parametrize("make", ELEMENTS)
def test_a_parameter_trains_and_a_tensor_is_a_buffer(make) -> None:
    def parameter(value: float) -> nn.Parameter:
        return nn.Parameter(torch.tensor(value, dtype=torch.float64))

    assert len(list(make(parameter).parameters())) == 1
    fixed = make(torch.tensor)
    assert not list(fixed.parameters())
    assert len(list(fixed.buffers())) >= 1
    assert not list(make(float).parameters())


@pytest.mark.parametrize(
    "make",
    [
        lambda t: optics.DOE(t.view(4, 4)),
        lambda t: optics.ZernikeDOE(t),
        lambda t: optics.ZernikeAberration(t),
        lambda t: optics.RadialDOE(t),
        lambda t: optics.ApertureMap(t.view(4, 4).clamp(0, 1), width=1 * mm),
    ],
)
def test_tensor_arguments_are_buffers_unless_parameters(make) -> None:
    assert [b.numel() for b in make(torch.ones(16)).buffers()] == [16]
    assert not list(make(torch.ones(16)).parameters())


def test_symmetry_is_a_matter_of_type_not_of_value() -> None:
    flat = torch.zeros(8, 8)
    lens = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), optics.DOE(flat), focus_distance=2.0)
    assert not lens.symmetric
    assert not optics.ZernikeDOE(torch.zeros(4)).symmetric
    assert optics.RadialDOE(torch.zeros(8)).symmetric
    assert not optics.SquareAperture(5 * mm).symmetric


# ---- bad input ---------------------------------------------------------------------------------------------------

NAN = float("nan")
BAD = [
    (lambda: optics.CircularAperture(5.0), ValueError, r"diameter 5 m is no aperture.*did you mean 5 \* mm"),
    (lambda: optics.CircularAperture(0.0), ValueError, r"diameter must be finite and > 0 m, got 0"),
    (lambda: optics.CircularAperture(NAN), ValueError, r"diameter must be finite and > 0 m, got nan"),
    (lambda: optics.AnnularAperture(-1 * mm, obscuration=0.2), ValueError, r"diameter must be finite and > 0 m"),
    (lambda: optics.AnnularAperture(5 * mm, obscuration=1.0), ValueError, r"obscuration 1 must be in \[0, 1\)"),
    (lambda: optics.AnnularAperture(5 * mm, obscuration=-0.1), ValueError, r"obscuration -0.1 must be in \[0, 1\)"),
    (lambda: optics.SquareAperture(4.0), ValueError, r"width 4 m is no aperture"),
    (lambda: optics.ApertureMap(torch.ones(3, 3), width=4.0), ValueError, r"width 4 m is no aperture"),
    (lambda: optics.ApertureMap(torch.ones(3, 4), width=4 * mm), ValueError, r"transmission must be square .*\(3, 4\)"),
    (lambda: optics.ApertureMap(2 * torch.ones(3, 3), width=4 * mm), ValueError, r"in \[0, 1\], got 2\.\.2; divide by"),
    (lambda: optics.ApertureMap(torch.zeros(3, 3), width=4 * mm), ValueError, r"0 everywhere: no light.*Open at least"),
    (lambda: optics.ApertureMap(NAN * torch.ones(3, 3), width=4 * mm), ValueError, r"transmission has 9 values .* NaN"),
    (
        lambda: optics.ApertureMap(torch.ones(3, 3).bool(), width=4 * mm),
        TypeError,
        r"floating-point .* torch.bool tens",
    ),
    (lambda: optics.ThinLens(0.0), ValueError, r"focal_length must be finite and not 0 m, got 0"),
    (lambda: optics.ThinLens(math.inf), ValueError, r"focal_length must be finite and not 0 m, got inf"),
    (lambda: optics.ThinLens(1e-300), ValueError, r"focal_length 1e-300 m is shorter than 1e-07 m, .* 50 \* mm"),
    (lambda: optics.ThinLens("50mm"), TypeError, r"focal_length must be a number of metres .*, got '50mm'"),
    (lambda: optics.CircularAperture("5mm"), TypeError, r"diameter must be a number > 0 m, got '5mm'"),
    (lambda: optics.ThinLens(50), ValueError, r"focal_length 50 m is beyond 10 m.*did you mean 50 \* mm\? .* Defocus"),
    (lambda: optics.ThinLens(-10.1), ValueError, r"focal_length -10.1 m is beyond 10 m"),
    (lambda: optics.PlanoConvexLens(25.8), ValueError, r"radius_of_curvature 25.8 m is beyond .* mean 25.8 \* mm"),
    (lambda: optics.PlanoConvexLens(-25 * mm), ValueError, r"radius_of_curvature must be finite and > 0 m, got -0.025"),
    (lambda: optics.PlanoConvexLens(25 * mm, glass="BK7"), ValueError, r"unknown glass 'BK7'; known: .*N-BK7"),
    (lambda: optics.PlanoConvexLens(25 * mm, glass=1.0), ValueError, r"refractive index 1 must be > 1"),
    (lambda: optics.Defocus(NAN), ValueError, r"vergence must be a finite number of 1/m, got nan"),
    (lambda: optics.DOE(torch.zeros(4, 5)), ValueError, r"phase must be square \(n, n\) with n >= 1, got .*\(4, 5\)"),
    (lambda: optics.DOE(torch.zeros(0, 0)), ValueError, r"phase must be square \(n, n\) with n >= 1"),
    (
        lambda: optics.DOE(torch.zeros(4, 4, dtype=torch.long)),
        TypeError,
        r"phase must be a floating-point .*torch.int64",
    ),
    (lambda: optics.DOE(np.zeros((4, 4))), TypeError, r"phase must be a floating-point tensor .* got ndarray"),
    (lambda: optics.DOE(torch.full((4, 4), NAN)), ValueError, r"phase has 16 values that are NaN or infinite"),
    (lambda: optics.DOE(torch.zeros(4, 4), levels=1), ValueError, r"levels must be an integer >= 2 .* got 1"),
    (lambda: optics.DOE(torch.zeros(4, 4), levels=2.5), ValueError, r"levels must be an integer >= 2 .* got 2.5"),
    (lambda: optics.DOE(torch.zeros(4, 4), pitch=0.0), ValueError, r"pitch 0 is outside .* such as 10 \* um"),
    (lambda: optics.DOE(torch.zeros(4, 4), pitch=10), ValueError, r"pitch 10 is outside .* did you mean 10 \* um\?"),
    (lambda: optics.DOE(torch.zeros(4, 4), pitch=1.0), ValueError, r"pitch 1 is outside 1e-08..0.05 m. Lengths are in"),
    (lambda: optics.DOE(torch.zeros(4, 4), pitch=800), ValueError, r"pitch 800 is outside .* did you mean 800 \* nm\?"),
    (lambda: optics.DOE(torch.zeros(4, 4), pitch=NAN), ValueError, r"pitch nan is outside .* such as 10 \* um\.$"),
    (lambda: optics.DOE(torch.zeros(4, 4), pitch="10um"), TypeError, r"pitch must be a number of metres .* got '10um'"),
    (lambda: optics.DOE(torch.zeros(4, 4), design_wavelength=550), ValueError, r"did you mean 550 \* nm"),
    (lambda: optics.DOE(torch.zeros(4, 4), design_wavelength=0.55), ValueError, r"did you mean 0.55 \* um"),
    (lambda: optics.DOE(torch.zeros(4, 4), glass="window"), ValueError, r"unknown glass 'window'"),
    (lambda: optics.ZernikeDOE(torch.zeros(2, 3)), ValueError, r"coefficients must be a vector \(K,\) with K >= 1"),
    (
        lambda: optics.ZernikeDOE(torch.tensor([1, 2])),
        TypeError,
        r"coefficients must be a floating-point .*torch.int64",
    ),
    (lambda: optics.ZernikeDOE(torch.tensor([NAN, 0])), ValueError, r"coefficients has 1 values that are NaN"),
    (lambda: optics.ZernikeAberration(torch.zeros(0)), ValueError, r"coefficients must be a vector \(K,\) with K >= 1"),
    (lambda: optics.RadialDOE(torch.zeros(3)), ValueError, r"profile needs at least 4 radii .* got 3"),
    (lambda: optics.RadialDOE(torch.zeros(4, 4)), ValueError, r"profile must be a vector \(K,\)"),
    (lambda: optics.RadialDOE([0.0, 1.0]), TypeError, r"profile must be a floating-point tensor \(K,\), got list"),
]


@pytest.mark.parametrize(("make", "error", "text"), BAD, ids=range(len(BAD)))
def test_bad_elements_say_what_is_wrong(make, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        make()


def test_an_aperture_must_say_its_shape() -> None:
    aperture = optics.elements.Aperture()
    for method in (aperture.semi_aperture, aperture.open_share, aperture.rim_per_area):
        with pytest.raises(NotImplementedError):
            method()


@pytest.mark.parametrize(
    ("element", "text"),
    [
        (optics.CircularAperture(torch.nn.Parameter(torch.tensor(5 * mm))), "CircularAperture(diameter=0.005)"),
        (optics.AnnularAperture(5 * mm, obscuration=0.3), "AnnularAperture(diameter=0.005, obscuration=0.3)"),
        (optics.ThinLens(10.0), "ThinLens(focal_length=10)"),
        (optics.PlanoConvexLens(25.8 * mm), "PlanoConvexLens(radius_of_curvature=0.0258, glass='N-BK7')"),
        (optics.Defocus(torch.tensor(0.5)), "Defocus(vergence=0.5)"),
        (
            optics.DOE(torch.zeros(4, 4), levels=8),
            "DOE(phase=(4, 4), design_wavelength=5.5e-07, glass='fused silica', levels=8)",
        ),
        (Element(), "Element()"),
    ],
)
def test_an_element_prints_its_values(element: Element, text: str) -> None:
    assert repr(element) == text


def test_a_plain_element_does_nothing() -> None:
    element = Element()
    assert element.vergence(WAVELENGTHS).tolist() == [0, 0, 0]
    assert element.terms(pupil(), WAVELENGTHS) == []
    assert element.pixel_map(WAVELENGTHS) is None
