"""A lens is found from pictures that an independent camera took: its terms, what is open, and what cannot be known."""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from kcam import Camera, Scene, optics
from kcam.calibration import PSFFit, fit_psf
from kcam.calibration.targets import check_saturation, find_targets
from kcam.optics.compound.tracing import trace
from kcam.units import mm, nm, um

sys.path.insert(0, str(Path(__file__).parent))
import independent

WAVELENGTH, PITCH = 550 * nm, 8 * um
ELECTRONS, READ_NOISE = 4e4, 3.0


def lens(terms: int | list[float], *, diameter: float = 2.5 * mm) -> optics.Lens:
    """f/20, so that the paraxial diffraction of the independent camera is good to 3e-4 of the peak."""
    values = torch.zeros(terms, dtype=torch.float64) if isinstance(terms, int) else torch.tensor(terms).double()
    aberration = optics.ZernikeAberration(nn.Parameter(values))
    return optics.Lens(optics.CircularAperture(diameter), optics.ThinLens(50 * mm), aberration, focus_distance=math.inf)


def behind(coefficients: dict[int, float], defocus: float) -> tuple[dict[int, float], float]:
    """Terms and f-number on a sensor moved back: light came together before, the rim is ahead by
    a^2 / 2 (1 / d - 1 / (d + dz)) = 2 sqrt(3) Z_4.
    """
    distance = 50 * mm + defocus
    ahead = (1.25 * mm) ** 2 / 2 * (1 / (50 * mm) - 1 / distance)
    return {**coefficients, 4: coefficients.get(4, 0.0) - ahead / (2 * math.sqrt(3))}, distance / (2.5 * mm)


def points(coefficients: dict[int, float], *, seed: int, count: int = 2, defocus: float = 0.0) -> torch.Tensor:
    """A picture of count^2 points by the independent camera, its sensor `defocus` behind; light as it falls."""
    draws = np.random.default_rng(1000 + seed)
    at = 18 + 34 * np.arange(count)
    places = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2) + draws.uniform(-0.5, 0.5, (count**2, 2))
    moved, f_number = behind(coefficients, defocus)
    expected = independent.point_picture(
        moved, wavelength=WAVELENGTH, f_number=f_number, pitch=PITCH, places=places, shape=(36 + 34 * (count - 1),) * 2,
        electrons=ELECTRONS, background=10.0,
    )  # fmt: skip
    return torch.from_numpy(independent.taken(expected, read_noise=READ_NOISE, seed=seed))[None, None]


def edge(coefficients: dict[int, float], *, angle: float, seed: int, defocus: float = 0.0) -> torch.Tensor:
    moved, f_number = behind(coefficients, defocus)
    expected = independent.edge_picture(
        moved, wavelength=WAVELENGTH, f_number=f_number, pitch=PITCH, angle=math.radians(angle), offset=0.3,
        shape=(40, 40), dark=100.0, bright=10_000.0,
    )  # fmt: skip
    return torch.from_numpy(independent.taken(expected, read_noise=READ_NOISE, seed=seed))[None, None]


def found(picture: torch.Tensor, terms: int | optics.Lens = 8, **more: object) -> PSFFit:
    known = {"full_well": 1.0, "read_noise": READ_NOISE} | more
    own = lens(terms) if isinstance(terms, int) else terms
    return fit_psf(picture, lens=own, pixel_pitch=PITCH, upright=False, wavelengths=[WAVELENGTH], **known)  # type: ignore[arg-type]


def member(seed: int) -> tuple[dict[int, float], torch.Tensor, tuple[float, float]]:
    """A random lens, and pictures at two focuses."""
    draws = np.random.default_rng(seed)
    coefficients = {j: float(draws.normal(0, 25 * nm)) for j in range(4, 9)}
    steps = (0.0, float(draws.uniform(0.6, 1.0) * mm))
    return (
        coefficients,
        torch.cat([points(coefficients, seed=2 * seed + k, defocus=s) for k, s in enumerate(steps)]),
        steps,
    )


def deviations(seeds: range, **more: object) -> np.ndarray:
    """(members, 5) of the values from the truth, in standard errors."""
    rows = []
    for seed in seeds:
        coefficients, pictures, steps = member(seed)
        fit = found(pictures, defocus=steps, **more)
        assert fit.ambiguous == ()
        rows.append([(fit.values[f"Z{j}"] - c) / fit.standard_errors[f"Z{j}"] for j, c in coefficients.items()])
    return np.array(rows)


def test_the_independent_camera_agrees_with_the_lens_in_the_slow_limit() -> None:
    coefficients = {4: 30 * nm, 5: -20 * nm, 7: 25 * nm, 8: -15 * nm}
    own = lens([0.0, 0, 0, *(coefficients.get(j, 0.0) for j in range(4, 9))], diameter=1 * mm)
    ours = own.psf([WAVELENGTH], distances=math.inf, pixel_pitch=20 * um, shape=(21, 21), dtype=torch.float64)
    theirs = independent.pixel_psf(coefficients, wavelength=WAVELENGTH, f_number=50.0, pitch=20 * um, window=21)
    assert np.abs(ours[0, 0].detach().numpy() - theirs).max() < 2e-4 * theirs.max()


@pytest.mark.slow
def test_two_focuses_give_all_terms_within_their_errors() -> None:
    found_ = deviations(range(1))
    assert (np.abs(found_) < 2).mean() >= 0.8
    assert np.abs(found_).max() < 3


@pytest.mark.slow
def test_95_times_in_100_within_two_standard_errors() -> None:
    found_ = deviations(range(30))
    share, spread = (np.abs(found_) < 2).mean(), np.sqrt((found_**2).mean())
    assert share >= 0.95 - 2 * math.sqrt(0.95 * 0.05 / found_.size)
    assert 0.85 < spread < 1.15


@pytest.mark.slow
def test_as_well_where_the_noise_is_estimated() -> None:
    found_ = deviations(range(100, 115), full_well=None)
    assert (np.abs(found_) < 2).mean() >= 0.95 - 2 * math.sqrt(0.95 * 0.05 / found_.size)
    assert 0.8 < np.sqrt((found_**2).mean()) < 1.2


@pytest.mark.slow
def test_one_focus_leaves_the_sign_of_the_even_terms_open() -> None:
    truth = {4: 30 * nm, 5: -20 * nm, 6: 15 * nm, 7: 25 * nm, 8: -15 * nm}
    given = lens(8)
    fit = found(points(truth, seed=3), given)
    assert set(fit.ambiguous) == {"Z4", "Z5", "Z6"}
    assert fit.alternative is not None
    near, other = fit.values, fit.alternative
    if near["Z4"] < 0:
        near, other = other, near
    for j, value in truth.items():
        error = 3 * fit.standard_errors[f"Z{j}"]
        assert near[f"Z{j}"] == pytest.approx(value, abs=error)
        assert other[f"Z{j}"] == pytest.approx(-value if j < 7 else value, abs=error)
    assert {"Z1", "Z2", "Z3"} == set(fit.unobservable)
    assert all(math.isinf(fit.standard_errors[name]) for name in fit.unobservable)
    assert 0.9 < fit.chi_squared < 1.1
    assert float(given.elements[2].coefficients.detach().abs().max()) == 0  # what was given is as it was
    assert float(fit.lens.elements[2].coefficients.detach()[7]) == fit.values["Z8"]
    assert "the sign is ambiguous" in str(fit)


def test_a_known_defocus_settles_the_sign() -> None:
    """Of a lens whose own defocus is not in question."""
    truth = [0.0, 0, 0, 0, -20 * nm, 15 * nm]

    class Fixed(optics.ZernikeAberration):
        """Without defocus."""

        def terms(self, pupil, wavelengths):  # type: ignore[no-untyped-def]
            keep = torch.tensor([0.0, 0, 0, 0, 1, 1], dtype=torch.float64)
            return [
                (torch.ones_like(wavelengths), optics.elements.zernike.zernike_sum(keep * self.coefficients, pupil))
            ]

    own = optics.Lens(
        optics.CircularAperture(2.5 * mm), optics.ThinLens(50 * mm),
        Fixed(nn.Parameter(torch.zeros(6, dtype=torch.float64))), focus_distance=math.inf,
    )  # fmt: skip
    picture = points({5: truth[4], 6: truth[5]}, seed=5, defocus=0.8 * mm)
    fit = found(picture, own, defocus=0.8 * mm)
    assert fit.ambiguous == ()
    for j in (5, 6):
        assert fit.values[f"Z{j}"] == pytest.approx(truth[j - 1], abs=3 * fit.standard_errors[f"Z{j}"])


def test_an_edge_shows_what_its_orientation_shows() -> None:
    """One of defocus alone: how much, but not on which side."""
    own = optics.Lens(
        optics.CircularAperture(2.5 * mm), optics.ThinLens(50 * mm), optics.Defocus(nn.Parameter(torch.zeros(()))),
        focus_distance=math.inf,
    )  # fmt: skip
    truth = 60 * nm  # Z4: W = 2 sqrt(3) Z4 rho^2 = V a^2 rho^2 / 2
    vergence = 4 * math.sqrt(3) * truth / (1.25 * mm) ** 2
    fit = found(edge({4: truth}, angle=5, seed=1), own)
    (name,) = fit.values
    assert fit.ambiguous == (name,)
    assert abs(fit.values[name]) == pytest.approx(vergence, abs=3 * fit.standard_errors[name])
    assert fit.standard_errors[name] < 0.05 * vergence
    assert float(fit.places[0, 1]) == pytest.approx(math.radians(5), abs=2e-3)


@pytest.mark.slow
def test_edges_at_any_angle_give_the_defocus_within_its_error() -> None:
    draws, found_ = np.random.default_rng(11), []
    for seed in range(20):
        angle = float(draws.choice([0, 90, 180, 270]) + draws.choice([-1, 1]) * draws.uniform(3, 20))
        truth = float(draws.uniform(40, 90) * nm)
        own = optics.Lens(
            optics.CircularAperture(2.5 * mm), optics.ThinLens(50 * mm), optics.Defocus(nn.Parameter(torch.zeros(()))),
            focus_distance=math.inf,
        )  # fmt: skip
        fit = found(edge({4: truth}, angle=angle, seed=seed), own)
        (name,) = fit.values
        assert fit.ambiguous == (name,)
        vergence = 4 * math.sqrt(3) * truth / (1.25 * mm) ** 2
        found_.append((abs(fit.values[name]) - vergence) / fit.standard_errors[name])
    assert (np.abs(found_) < 2).mean() >= 0.85  # 95 % less two of its own standard errors
    assert 0.6 < np.sqrt(np.square(found_).mean()) < 1.4


@pytest.mark.slow
def test_light_of_several_wavelengths_counts_by_its_shares() -> None:
    seen = lens([0.0] * 7 + [40 * nm])
    colours, shares = [480 * nm, 550 * nm, 640 * nm], torch.tensor([0.2, 0.5, 0.3])
    psf = seen.psf(colours, distances=math.inf, pixel_pitch=PITCH, shape=(35, 35), dtype=torch.float64).detach()
    picture = (psf * shares[:, None, None]).sum(1)
    fit = fit_psf(
        picture, lens=lens(8), pixel_pitch=PITCH, wavelengths=colours, weights=2 * shares, upright=False
    )  # fmt: skip
    assert fit.values["Z8"] == pytest.approx(40 * nm, abs=0.5 * nm)


@pytest.mark.slow
def test_an_edge_does_not_tell_defocus_from_astigmatism_along_it() -> None:
    fit = found(edge({4: 60 * nm, 8: 30 * nm, 11: 20 * nm}, angle=5, seed=1), 11)
    assert {"Z1", "Z2", "Z3", "Z4", "Z6", "Z7"} <= set(fit.unobservable)
    assert abs(fit.values["Z11"]) == pytest.approx(20 * nm, abs=3 * fit.standard_errors["Z11"])
    assert "Z11" in fit.ambiguous
    seen = 2 * math.sqrt(3) * fit.values["Z4"] + math.sqrt(6) * fit.values["Z6"]  # of x^2
    assert abs(seen) == pytest.approx(2 * math.sqrt(3) * 60 * nm, rel=0.1)


@pytest.mark.slow
def test_a_picture_of_a_camera_is_turned_against_the_light() -> None:
    """The camera's own picture of points, and the lens that it has: coma points to the other side as light falls."""
    seen = lens([0.0] * 6 + [30 * nm, -50 * nm])
    planes = torch.zeros(1, 1, 31, 31)
    planes[0, 0, 15, 15] = 1.0
    scene = Scene.from_bands(planes, wavelengths=torch.tensor([WAVELENGTH]), depth=math.inf)
    with torch.no_grad():
        picture = Camera(optics.Imaging(seen, pixel_pitch=PITCH))(scene)
    fit = fit_psf(picture, lens=lens(8), pixel_pitch=PITCH)
    assert fit.values["Z7"] == pytest.approx(30 * nm, abs=1 * nm)
    assert fit.values["Z8"] == pytest.approx(-50 * nm, abs=1 * nm)


@pytest.mark.parametrize("what", ["diameter", pytest.param("sensor_distance", marks=pytest.mark.slow)])
def test_whatever_trains_is_found(what: str) -> None:
    """Under no_grad, too; the search tries apertures beyond those that are tested, and does not say so."""
    picture = points({}, seed=9, defocus=0.3 * mm)
    given = {"diameter": 2.4 * mm, "sensor_distance": 50 * mm}
    truth = {"diameter": 2.5 * mm, "sensor_distance": 50.3 * mm}
    values = truth | {what: nn.Parameter(torch.tensor(given[what], dtype=torch.float64))}
    own = optics.Lens(
        optics.CircularAperture(values["diameter"]), optics.ThinLens(50 * mm), sensor_distance=values["sensor_distance"]
    )
    with torch.no_grad():
        fit = found(picture, own, distances=math.inf)
    (name,) = fit.values
    assert name.endswith(what)
    assert fit.values[name] == pytest.approx(truth[what], abs=2.5 * fit.standard_errors[name])
    assert fit.standard_errors[name] < 2e-3 * truth[what]


def triplet(change: float) -> optics.CompoundLens:
    surfaces = list(optics.CompoundLens.preset("cooke_triplet").surfaces)
    one = surfaces[1]
    gap = torch.tensor(float(one.thickness) + change, dtype=torch.float64)
    surfaces[1] = optics.Surface(radius=one.radius, thickness=nn.Parameter(gap), semi_diameter=one.semi_diameter)
    focused = optics.CompoundLens.preset("cooke_triplet")
    return optics.CompoundLens(*surfaces, sensor_distance=focused.sensor_distance)


def huygens(own: optics.CompoundLens, field: tuple[float, float], *, pitch: float, size: int) -> np.ndarray:
    """Light per pixel of a point's image by a sum over rays, |sum of exp(ik path) d^2 cosines|^2, on 6 x 6 subpixels.

    The window's middle is where the ray through the middle of the entrance pupil lands.
    """
    rays, wavelength = 221, torch.tensor([WAVELENGTH], dtype=torch.float64)
    height = math.hypot(*field)
    up = np.array(field) / height if height else np.array([0.0, 1.0])  # rays are traced for points at (0, height)
    first = own.first_order()
    reach = 1.3 * float(first.entrance_semi_diameter.detach())
    side = torch.linspace(-reach, reach, rays, dtype=torch.float64)
    zero = torch.zeros((), dtype=torch.float64)
    indices = [index.detach()[0] for index in own.indices(wavelength)]
    found_ = {}
    with torch.no_grad():
        for name, (px, py) in {"all": (side[None, :], side[:, None]), "chief": (zero, zero)}.items():
            traced = trace(own.surfaces, own.launch(zero + height, zero, px, py), indices)
            run = float(own.sensor_distance) / traced.dz
            x, y, path = traced.x + run * traced.dx, traced.y + run * traced.dy, traced.path + run
            passes = traced.alive & (torch.stack([c for c in traced.clearance if c is not None]) >= 0).all(0)
            found_[name] = [part.numpy() for part in (x, y, traced.dx, traced.dy, path, passes)]
    x, y, dx, dy, path, passes = found_["all"]
    wave = path - dx * x - dy * (y - found_["chief"][1])
    (xy, xx), (yy, yx) = (np.gradient(part) for part in (dx, dy))
    area = np.abs(xx * yy - xy * yx)
    inside = passes & np.isfinite(wave) & np.isfinite(area)
    k, (ux, uy) = 2 * np.pi / WAVELENGTH, up
    amplitude = area[inside] * np.exp(1j * k * (wave[inside] - wave[inside].mean()))
    at = (np.arange(6 * size) - (6 * size - 1) / 2) / 6 * pitch
    # from the sensor's axes to those of the trace
    cosines_x, cosines_y = dx[inside] * uy + dy[inside] * ux, dy[inside] * uy - dx[inside] * ux
    columns = np.exp(1j * k * np.outer(at, cosines_x))
    light = np.abs((np.exp(1j * k * np.outer(at, cosines_y)) * amplitude) @ columns.T) ** 2
    pixels = light.reshape(size, 6, size, 6).sum((1, 3)) * (pitch / 6) ** 2
    return pixels / (area[inside].sum() * WAVELENGTH**2)


@pytest.mark.slow
@pytest.mark.parametrize("change", [0.04 * mm, -0.07 * mm])
def test_the_gap_of_a_triplet_comes_back(change: float) -> None:
    """Points in the field of a lens with another gap, light as it falls, drawn by a sum over rays."""
    true = triplet(change)
    pitch, draws = 3 * um, np.random.default_rng(7)
    picture = np.full((95, 95), 10.0)
    middle = 47
    for x, y in ((23, 23), (71, 23), (47, 47), (23, 71), (71, 71)):
        place = torch.tensor([(x - middle) * pitch, (y - middle) * pitch], dtype=torch.float64)
        field = (-place / true.image_scale.detach()).tolist()
        picture[y - 20 : y + 21, x - 20 : x + 21] += 3e4 * huygens(true, field, pitch=pitch, size=41)
    taken = torch.from_numpy(draws.poisson(picture) + draws.normal(0, 2, picture.shape))
    fit = fit_psf(
        taken, lens=triplet(0.0), pixel_pitch=pitch, distances=math.inf, full_well=1.0, read_noise=2.0, upright=False
    )
    (name,) = fit.values
    assert name == "surfaces.1.thickness"
    truth = float(true.surfaces[1].thickness.detach())
    assert fit.values[name] == pytest.approx(truth, abs=2 * fit.standard_errors[name])
    assert fit.standard_errors[name] < 1 * um


@pytest.mark.slow
def test_float32_parameters_and_pictures_will_do() -> None:
    aberration = optics.ZernikeAberration(nn.Parameter(torch.zeros(8)))
    own = optics.Lens(optics.CircularAperture(2.5 * mm), optics.ThinLens(50 * mm), aberration, focus_distance=math.inf)
    fit = found(points({8: 30 * nm}, seed=1, count=1).float(), own)
    assert fit.values["Z8"] == pytest.approx(30 * nm, abs=4 * fit.standard_errors["Z8"])
    assert fit.lens.elements[2].coefficients.dtype == torch.float32


SHARP = 1e-3 * torch.rand(1, 1, 41, 41, generator=torch.Generator().manual_seed(0))
STAR = SHARP.clone()
STAR[0, 0, 19:22, 19:22] += 0.5


@pytest.mark.parametrize(
    ("picture", "more", "text"),
    [
        (STAR.numpy(), {}, "picture must be a floating-point tensor"),
        (STAR.expand(1, 3, 41, 41), {}, r"shape \(1, 3, 41, 41\), expected \(N,1,H,W\)"),
        (STAR / 0, {}, "NaN or infinite"),
        (SHARP, {"target": "points"}, "shows no points"),
        (STAR[..., 17:25, 17:25], {"target": "points"}, "too small"),
        ((STAR * 3).clamp(max=1.0), {}, "saturated"),
        (STAR, {"target": "star"}, "target 'star' is unknown"),
        (STAR, {"target": "edge"}, "no straight edge"),
        (STAR, {"pixel_pitch": 8.0}, r"did you mean 8 \* um"),
        (STAR, {"defocus": 50.0}, r"defocus 50 is outside"),
        (STAR, {"defocus": (0.0, 1e-4)}, "defocus has 2 values, expected one, or one for each of 1"),
        (STAR, {"weights": [1.0, 2.0]}, "weights must be 1 numbers"),
        (STAR, {"fill_factor": 1.5}, "fill_factor 1.5 must be in"),
        (STAR, {"points": [1.0, 2.0]}, r"points must be finite x and y in pixels, \(K, 2\)"),
        (STAR, {"points": [[2.0, 20.0]]}, "too small"),
        (STAR, {"full_well": -1.0}, "full_well must be > 0"),
        (torch.where(torch.arange(41) > 20, 0.8, 0.1).expand(1, 1, 41, 41), {}, "Slant it by 5 degrees"),
        (torch.where(torch.arange(9) > 4, 0.8, 0.1).expand(1, 1, 9, 9), {"target": "edge"}, "too small for a slanted"),
    ],
)  # fmt: skip
def test_what_cannot_be_fitted_says_why(picture: torch.Tensor, more: dict[str, object], text: str) -> None:
    arguments = {"lens": lens(8), "pixel_pitch": PITCH} | more
    with pytest.raises((TypeError, ValueError), match=text):
        fit_psf(picture, **arguments)  # type: ignore[arg-type]


def test_black_taken_off_a_saturated_picture_leaves_a_plateau_that_is_seen() -> None:
    seen = points({4: 30 * nm}, seed=3, count=1)
    black = 64 / 4095
    raw = ((seen / seen.max() * 3 + black).clamp(0, 1) * 4095).round() / 4095 - black
    for picture in (raw, raw.float(), (raw * 4095).round()):
        with pytest.raises(ValueError, match=r"\d pixels of the target near x = 18, .* saturated, so that the shape"):
            found(picture)
    bright = edge({4: 30 * nm}, angle=5, seed=1)
    with pytest.raises(ValueError, match="saturated"):
        found(bright.clamp(max=9800.0))


def test_two_photon_counts_that_are_the_same_are_no_plateau() -> None:
    draws = np.random.default_rng(0)
    for _ in range(10):
        coefficients = {j: float(draws.normal(0, 25 * nm)) for j in range(4, 9)}
        share = independent.pixel_psf(
            coefficients, wavelength=WAVELENGTH, f_number=20.0, pitch=PITCH, window=31,
            moved=tuple(draws.uniform(-0.5, 0.5, 2)),
        )  # fmt: skip
        for _ in range(20):
            electrons = math.exp(draws.uniform(math.log(300), math.log(1e5)))
            picture = torch.from_numpy(draws.poisson(electrons * share + 2.0).astype(float))[None, None]
            check_saturation(find_targets(picture, kind="points", points=None), picture)


def test_four_pixels_around_a_point_of_no_noise_are_no_plateau() -> None:
    share = independent.pixel_psf({}, wavelength=WAVELENGTH, f_number=20.0, pitch=PITCH, window=31, moved=(0.5, 0.5))
    assert (share > 0.999999 * share.max()).sum() == 4
    for dtype in (torch.float32, torch.float64):
        picture = torch.from_numpy(share).to(dtype).double()[None, None]
        check_saturation(find_targets(picture, kind="points", points=None), picture)


def test_a_wide_peak_in_few_steps_is_no_plateau() -> None:
    blurred = {4: 200 * nm}
    share = independent.pixel_psf(blurred, wavelength=WAVELENGTH, f_number=20.0, pitch=PITCH / 2, window=61)
    for top in (20, 50, 100, 250):
        picture = torch.from_numpy((share / share.max() * top).round())[None, None]
        check_saturation(find_targets(picture, kind="points", points=None), picture)


def focused() -> optics.Lens:
    """Whose diameter trains."""
    diameter = nn.Parameter(torch.tensor(2.45 * mm, dtype=torch.float64))
    return optics.Lens(optics.CircularAperture(diameter), optics.ThinLens(50 * mm), sensor_distance=50.3 * mm)


def test_errors_are_widened_and_a_warning_given_where_the_noise_is_more_than_was_said() -> None:
    picture = points({}, seed=9, count=1, defocus=0.3 * mm)
    right = found(picture, focused(), distances=math.inf, read_noise=READ_NOISE)
    assert right.chi_squared < 1.1
    with pytest.warns(UserWarning, match=r"chi\^2 per degree of freedom is .* expected 1: .* Check pixel_pitch"):
        wrong = found(picture, focused(), distances=math.inf, full_well=10.0, read_noise=10 * READ_NOISE / 10**0.5)
    assert wrong.chi_squared == pytest.approx(10 * right.chi_squared, rel=0.02)
    (name,) = right.values
    assert wrong.standard_errors[name] == pytest.approx(right.standard_errors[name], rel=0.1)
    assert float(wrong.covariance.sqrt()) == pytest.approx(wrong.standard_errors[name])


def test_a_wrong_pixel_pitch_warns() -> None:
    picture = points({}, seed=9, count=1, defocus=0.3 * mm)
    with pytest.warns(UserWarning, match="no such lens makes this picture"):
        fit_psf(
            picture, lens=focused(), pixel_pitch=0.7 * PITCH, upright=False, wavelengths=[WAVELENGTH], full_well=1.0,
            read_noise=READ_NOISE, distances=math.inf,
        )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("sharp", [False, True])
def test_an_edge_of_eight_terms_takes_seconds_also_where_no_lens_makes_it(sharp: bool) -> None:
    """What an edge does not tell must not lead to lenses of a hundred waves, whose PSFs take seconds each."""
    picture = edge({4: 60 * nm, 5: -20 * nm, 6: 15 * nm, 8: 30 * nm}, angle=5, seed=1)
    began = time.process_time()
    if sharp:  # than any lens makes it
        with pytest.warns(UserWarning, match="per degree of freedom"):
            found((picture - 5050).sign() * (4950 + 0.05 * (picture - 5050).abs().sqrt()) + 5050)
    else:
        assert 0.8 < found(picture).chi_squared < 1.2
    assert time.process_time() - began < 60


def test_a_lens_in_which_nothing_trains_is_refused() -> None:
    plain = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), focus_distance=2.0)
    with pytest.raises(ValueError, match="nothing trains in this lens"):
        fit_psf(STAR, lens=plain, pixel_pitch=PITCH)
    with pytest.raises(TypeError, match="lens must be an optics.Lens"):
        fit_psf(STAR, lens=nn.Linear(2, 2), pixel_pitch=PITCH)
    with pytest.raises(ValueError, match="has 100 numbers that train, more than 64"):
        fit_psf(STAR, lens=lens(100), pixel_pitch=PITCH)
