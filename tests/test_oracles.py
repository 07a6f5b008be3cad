"""The oracles against each other and against closed forms: independent derivations that must agree to rounding."""

from __future__ import annotations

import math

import numpy as np
import oracles
import pytest

WAVELENGTH = 550e-9
RADIUS = 2.5e-3
FOCUS = 1 / (1 / 50e-3 - 1 / 2.0)  # f = 50 mm focused at 2 m
LENS = {"index": 1.5, "radius_of_curvature": 25e-3}
CASE = {"wavelength": WAVELENGTH, "aperture_radius": RADIUS, "sensor_distance": FOCUS}
NYQUIST = WAVELENGTH * FOCUS / (4 * RADIUS)  # of the intensity


def no_opd(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.zeros(np.broadcast(u, v).shape)


@pytest.fixture
def points() -> np.ndarray:
    points = np.random.default_rng(0).uniform(-445e-6, 445e-6, (40, 2))
    points[0] = 0
    return points


def peak_error(a: np.ndarray, b: np.ndarray, *, peak: float) -> float:
    return float(np.abs(a - b).max() / peak)


def radial_l1(a: np.ndarray, b: np.ndarray, *, r: np.ndarray) -> float:
    return float(np.sum(np.abs(a - b) * r) / np.sum(b * r))


@pytest.mark.parametrize("obscuration", [0.0, 0.3])
def test_airy_agrees_with_the_polar_quadrature(points: np.ndarray, obscuration: float) -> None:
    closed = oracles.airy(*points.T, **CASE, obscuration=obscuration)
    quadrature = oracles.fresnel_polar(points, opd=no_opd, inner_radius=obscuration * RADIUS, **CASE)
    np.testing.assert_allclose(quadrature, closed, rtol=1e-10, atol=1e-15 * closed[0])


def test_encircled_energy_of_the_first_dark_rings() -> None:
    radius = np.array([1.21966989, 2.23313059]) * WAVELENGTH * FOCUS / (2 * RADIUS)
    # Born & Wolf, 8.5.2: 83.8 % and 91.0 %; in a dark ring J1 = 0, so 1 - J0^2 alone
    np.testing.assert_allclose(oracles.airy_encircled_energy(radius, **CASE), [0.838, 0.910], atol=5e-4)
    np.testing.assert_allclose(oracles.airy(radius, 0, **CASE), 0, atol=1e-14 * oracles.airy(0, 0, **CASE))
    inside = np.linspace(0, radius[0], 2001)
    ring = oracles.airy(inside, 0, **CASE) * 2 * math.pi * inside
    assert np.trapezoid(ring, inside) == pytest.approx(0.8378, abs=1e-4)


def test_energy_in_a_square_is_the_sum_of_its_pixels() -> None:
    half, pitch = 20e-6, 2e-6
    centre = np.arange(-half + pitch / 2, half, pitch)
    centres = np.stack(np.meshgrid(centre, centre), axis=-1).reshape(-1, 2)
    pixels = oracles.pixel_integrate(lambda p: oracles.airy(*p.T, **CASE), centres, pitch=pitch)
    assert pixels.sum() == pytest.approx(oracles.airy_square_energy(half, **CASE), rel=1e-12)


@pytest.mark.parametrize(
    "waves", [0.0, 1e-6, 0.06, *(pytest.param(n, marks=pytest.mark.slow) for n in (0.1, 1.0, 8.5)), -3.0, 20.0]
)
def test_lommel_agrees_with_the_radial_and_the_polar_quadrature(points: np.ndarray, waves: float) -> None:
    defocus = waves * WAVELENGTH
    opd = oracles.defocus_opd(vergence=2 * defocus / RADIUS**2)
    r = np.concatenate([np.linspace(0, 500e-6, 300), np.hypot(*points.T)])
    series = oracles.lommel(r, defocus=defocus, **CASE)
    assert peak_error(oracles.fresnel_radial(r, opd=opd, **CASE), series, peak=series.max()) < 1e-12
    assert peak_error(oracles.fresnel_polar(points, opd=opd, **CASE), series[300:], peak=series.max()) < 1e-12


def test_lommel_at_focus_is_airy_and_on_axis_is_a_sinc(points: np.ndarray) -> None:
    r = np.hypot(*points.T)
    airy = oracles.airy(r, 0, **CASE)
    np.testing.assert_allclose(oracles.lommel(r, defocus=0.0, **CASE), airy, rtol=1e-9, atol=1e-15 * airy[0])
    for waves in (0.05, 0.5, 1.0, 1.5):  # I(0) = I0 sinc^2(W20): dark at whole waves
        on_axis = oracles.lommel(0.0, defocus=waves * WAVELENGTH, **CASE)
        assert on_axis == pytest.approx(airy[0] * np.sinc(waves) ** 2, rel=1e-12, abs=1e-14 * airy[0])


@pytest.mark.parametrize("waves", [0.0, 2.0])
def test_the_intensity_integrates_to_one(waves: float) -> None:
    edges = np.linspace(0, 1.5e-3, 601)  # composite Gauss-Legendre, each panel about a Nyquist pitch
    node, weight = np.polynomial.legendre.leggauss(8)
    width = edges[1]
    r = edges[:-1, None] + width * (node + 1) / 2
    total = np.sum(oracles.lommel(r.ravel(), defocus=waves * WAVELENGTH, **CASE).reshape(r.shape) * r * weight)
    tail = 1 - oracles.airy_encircled_energy(edges[-1], **CASE)  # far out the rings fall off alike in any focus
    assert total * math.pi * width == pytest.approx(1 - tail, abs=1e-12 if waves == 0 else 1e-5)
    assert tail < 1e-3


def test_the_image_is_the_points_on_a_grid() -> None:
    coma = oracles.zernike_opd({7: 0.4 * WAVELENGTH, 6: 0.3 * WAVELENGTH}, aperture_radius=RADIUS)
    opd = oracles.fresnel_opd(**LENS, distance=0.5, sensor_distance=FOCUS, extra=coma)
    x, y = oracles.pixel_centres(9, 11e-6), oracles.pixel_centres(6, 7e-6)
    image = oracles.fresnel_image(x, y, opd=opd, **CASE)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    assert image.shape == (6, 9)
    assert x[4] == 0
    assert y[3] == 0
    np.testing.assert_allclose(image.ravel(), oracles.fresnel_polar(grid, opd=opd, **CASE), rtol=1e-9)


def test_noll_numbers_are_in_the_published_order() -> None:
    table = [(0, 0), (1, 1), (1, -1), (2, 0), (2, -2), (2, 2), (3, -1), (3, 1), (3, -3), (3, 3)]  # Noll 1976, table 1
    table += [(4, 0), (4, 2), (4, -2), (4, 4), (4, -4), (5, 1), (5, -1), (5, 3), (5, -3), (5, 5), (5, -5), (6, 0)]
    assert [oracles.noll_indices(j) for j in range(1, 23)] == table
    with pytest.raises(ValueError, match="start at 1"):
        oracles.noll_indices(0)


def test_zernikes_are_orthonormal_and_match_their_formulas() -> None:
    u, v, w = oracles.polar_nodes(aperture_radius=1.0, radial=20, angular=32)
    rho, theta = np.hypot(u, v), np.arctan2(v, u)
    basis = np.stack([oracles.noll_zernike(j, rho, theta) for j in range(1, 37)])
    np.testing.assert_allclose((basis * w) @ basis.T / math.pi, np.eye(36), atol=1e-12)
    np.testing.assert_allclose(basis[1], 2 * u, atol=1e-14)  # Z2 rises to +x, Z3 to +y
    np.testing.assert_allclose(basis[2], 2 * v, atol=1e-14)
    np.testing.assert_allclose(basis[3], math.sqrt(3) * (2 * rho**2 - 1), atol=1e-13)
    np.testing.assert_allclose(basis[10], math.sqrt(5) * (6 * rho**4 - 6 * rho**2 + 1), atol=1e-13)
    np.testing.assert_allclose(basis[7], math.sqrt(8) * (3 * rho**3 - 2 * rho) * np.cos(theta), atol=1e-13)


def test_a_tilt_moves_the_light_towards_the_rising_path() -> None:
    shift = np.array([30e-6, -12e-6])
    tilt = oracles.zernike_opd(
        {2: shift[0] * RADIUS / (2 * FOCUS), 3: shift[1] * RADIUS / (2 * FOCUS)}, aperture_radius=RADIUS
    )
    at = np.array([[0.0, 0.0], shift, shift + 2e-6])
    found = oracles.fresnel_polar(at, opd=tilt, **CASE)
    np.testing.assert_allclose(found, oracles.airy(*(at - shift).T, **CASE), rtol=1e-9)
    element = oracles.plano_convex_opd(**LENS, extra=tilt)
    exact = oracles.rayleigh_sommerfeld(at, element_opd=element, source_distance=2.0, **CASE)
    assert exact.argmax() == 1


def test_default_node_counts_have_converged_for_a_twenty_wave_freeform(points: np.ndarray) -> None:
    generator = np.random.default_rng(1)
    raw = {j: float(generator.normal()) for j in range(4, 16)}
    u, v, _ = oracles.polar_nodes(aperture_radius=RADIUS, radial=40, angular=90)
    scale = 20 * WAVELENGTH / np.ptp(oracles.zernike_opd(raw, aperture_radius=RADIUS)(u, v))
    freeform = oracles.zernike_opd({j: c * scale for j, c in raw.items()}, aperture_radius=RADIUS)
    opd = oracles.fresnel_opd(**LENS, distance=2.0, sensor_distance=FOCUS, extra=freeform)
    fine = oracles.fresnel_polar(points, opd=opd, radial_nodes=300, angular_nodes=1000, **CASE)
    assert peak_error(oracles.fresnel_polar(points, opd=opd, **CASE), fine, peak=fine.max()) < 1e-11
    element, few = oracles.plano_convex_opd(**LENS, extra=freeform), points[:10]
    exact = oracles.rayleigh_sommerfeld(few, element_opd=element, source_distance=2.0, **CASE)
    fine = oracles.rayleigh_sommerfeld(
        few, element_opd=element, source_distance=2.0, radial_nodes=300, angular_nodes=1000, **CASE
    )
    assert peak_error(exact, fine, peak=fine.max()) < 1e-11


@pytest.mark.parametrize("distance", [2.0, 0.5, math.inf])
def test_rayleigh_sommerfeld_has_converged_and_its_symmetric_form_is_the_same(distance: float) -> None:
    element = oracles.plano_convex_opd(**LENS)
    r = np.linspace(0, 300e-6, 12)
    angle = np.linspace(0, 3, 12)
    points = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)
    half = oracles.rayleigh_sommerfeld(points, element_opd=element, source_distance=distance, symmetric=True, **CASE)
    full = oracles.rayleigh_sommerfeld(
        points, element_opd=element, source_distance=distance, radial_nodes=250, angular_nodes=700, **CASE
    )
    assert peak_error(half, full, peak=full.max()) < 1e-11


@pytest.mark.parametrize(("distance", "published"), [(2.0, 0.14), (0.5, 0.064)])
def test_rayleigh_sommerfeld_becomes_fresnel_as_the_aperture_closes(distance: float, published: float) -> None:
    errors = []
    for radius in (2.5e-3, 1.25e-3, 0.5e-3, 0.25e-3):
        case = CASE | {"aperture_radius": radius}
        r = np.linspace(0, 60e-6 * 2.5e-3 / radius, 150)
        points = np.stack([r, np.zeros_like(r)], axis=1)
        exact = oracles.rayleigh_sommerfeld(
            points, element_opd=oracles.plano_convex_opd(**LENS), source_distance=distance, symmetric=True, **case
        )
        paraxial = oracles.fresnel_radial(
            r, opd=oracles.fresnel_opd(**LENS, distance=distance, sensor_distance=FOCUS), **case
        )
        errors.append(radial_l1(paraxial, exact, r=r))
    assert errors[0] == pytest.approx(published, rel=0.15)  # notes/numerics.md, section 3, measured on its own window
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1e-4


def test_rayleigh_sommerfeld_of_a_perfect_wave_is_airy_at_small_aperture(points: np.ndarray) -> None:
    def perfect(u: np.ndarray, v: np.ndarray) -> np.ndarray:  # cancels source and propagation exactly on the axis
        r2 = u**2 + v**2
        return -r2 / (2.0 + np.sqrt(4.0 + r2)) - r2 / (FOCUS + np.sqrt(FOCUS**2 + r2))

    case = CASE | {"aperture_radius": 0.5e-3}
    exact = oracles.rayleigh_sommerfeld(points * 0.2, element_opd=perfect, source_distance=2.0, symmetric=True, **case)
    airy = oracles.airy(*(points * 0.2).T, **case)
    assert peak_error(exact, airy, peak=airy.max()) < 2e-4  # (a / d)^2 = 1e-4: obliquity and 1/R


@pytest.mark.parametrize("size", [33, 128])
def test_a_flat_map_sums_to_the_polar_quadrature_up_to_the_cut_pixels(points: np.ndarray, size: int) -> None:
    opd = oracles.fresnel_opd(**LENS, distance=0.5, sensor_distance=FOCUS)
    (_, _, w), index = oracles.pixel_map_nodes((size, size), pitch=2 * RADIUS / size, aperture_radius=RADIUS, order=3)
    assert w.sum() == pytest.approx(math.pi * RADIUS**2, rel=1e-8)
    assert index.max() < size**2
    flat = {"phase_map": np.zeros((size, size)), "points": points[:8], "pitch": 2 * RADIUS / size}
    found = oracles.direct_sum_psf(**flat, opd=opd, **CASE)
    expected = oracles.fresnel_polar(points[:8], opd=opd, **CASE)
    peak = oracles.fresnel_radial(np.linspace(0, 3e-4, 200), opd=opd, **CASE).max()
    assert peak_error(found, expected, peak=peak) < 1e-7
    element = oracles.plano_convex_opd(**LENS)
    found = oracles.direct_sum_psf(**flat, opd=element, source_distance=0.5, **CASE)
    expected = oracles.rayleigh_sommerfeld(points[:8], element_opd=element, source_distance=0.5, **CASE)
    assert peak_error(found, expected, peak=peak) < 1e-7


def test_a_random_square_map_in_focus_is_its_fourier_sum_under_a_sinc(points: np.ndarray) -> None:
    rows, columns, pitch = 24, 30, 150e-6
    phase = np.random.default_rng(2).uniform(-3, 3, (rows, columns))
    case = {"wavelength": WAVELENGTH, "sensor_distance": FOCUS}
    found = oracles.direct_sum_psf(phase, points, pitch=pitch, aperture_radius=None, opd=no_opd, **case)
    frequency = points / (WAVELENGTH * FOCUS)
    across = np.exp(-2j * math.pi * np.outer(frequency[:, 0], (np.arange(columns) - (columns - 1) / 2) * pitch))
    down = np.exp(-2j * math.pi * np.outer(frequency[:, 1], (np.arange(rows) - (rows - 1) / 2) * pitch))
    field = np.einsum("pr,rc,pc->p", down, np.exp(1j * phase), across) * np.prod(np.sinc(frequency * pitch), axis=1)
    expected = np.abs(field) ** 2 * pitch**2 / (rows * columns * (WAVELENGTH * FOCUS) ** 2)
    assert peak_error(found, expected, peak=expected.max()) < 1e-8


def test_a_map_smaller_than_the_aperture_is_refused() -> None:
    with pytest.raises(ValueError, match="larger than the map"):
        oracles.pixel_map_nodes((10, 12), pitch=1e-4, aperture_radius=0.51e-3, order=2)


def test_square_pupil_agrees_with_a_product_quadrature(points: np.ndarray) -> None:
    nodes = oracles.rectangle_nodes(half_width=RADIUS, half_height=RADIUS, order=160)
    case = {"wavelength": WAVELENGTH, "sensor_distance": FOCUS}
    found = oracles.fresnel_sum(points * 0.3, nodes=nodes, opd=no_opd(*nodes[:2]), **case)
    closed = oracles.square_pupil(*(points * 0.3).T, half_width=RADIUS, **case)
    assert peak_error(found, closed, peak=closed.max()) < 1e-12


def test_mtf_is_the_fourier_transform_of_airy() -> None:
    pitch = 0.9 * NYQUIST
    x = oracles.pixel_centres(1501, pitch)
    line = oracles.airy(x[None], x[:, None], **CASE).sum(axis=0) * pitch**2
    frequency = np.array([0.1, 0.4, 0.8]) * 2 * RADIUS / (WAVELENGTH * FOCUS)
    found = np.cos(2 * math.pi * np.outer(frequency, x)) @ line
    np.testing.assert_allclose(found, oracles.circular_mtf(frequency, **CASE), atol=5e-4)
    assert oracles.circular_mtf(np.array([0.0, 1e9]), **CASE).tolist() == [1.0, 0.0]


def test_pixel_integration_has_converged_and_the_radial_spline_follows_its_function(points: np.ndarray) -> None:
    def function(p: np.ndarray) -> np.ndarray:
        return oracles.lommel(np.hypot(*p.T), defocus=2 * WAVELENGTH, **CASE)

    centres = points * 0.1
    fine = oracles.pixel_integrate(function, centres, pitch=4e-6, order=16)
    np.testing.assert_allclose(oracles.pixel_integrate(function, centres, pitch=4e-6), fine, rtol=1e-8)
    spline = oracles.radial_function(
        lambda r: oracles.lommel(r, defocus=2 * WAVELENGTH, **CASE), largest=100e-6, spacing=NYQUIST / 4
    )
    peak = function(np.stack([np.linspace(0, 60e-6, 300), np.zeros(300)], axis=1)).max()
    assert peak_error(spline(centres), function(centres), peak=peak) < 2e-6


def test_published_indices_agree_with_published_abbe_numbers() -> None:
    published = oracles.sellmeier_published()
    assert len(published) >= 10
    lines = oracles.LINES
    checked = 0
    for name, abbe in oracles.ABBE_NUMBERS.items():
        n, precision = published[name]
        if lines["F"] in n:
            assert n[lines["F"]] - n[lines["C"]] == pytest.approx((n[lines["d"]] - 1) / abbe, abs=1.5 * precision)
            checked += 1
    assert checked >= 10
    for n, _ in published.values():  # normal dispersion: shorter waves refract more
        ordered = [n[wavelength] for wavelength in sorted(n)]
        assert ordered == sorted(ordered, reverse=True)
