"""Estimates against truth, over random cameras: never 3 times too small, seldom 10 times too large."""

from __future__ import annotations

import copy
import dataclasses
import math
import random
from collections.abc import Iterator

import pytest
import torch
from draws import Draw

from kcam import optics
from kcam.optics import PROPAGATORS
from kcam.optics.propagation.estimates import beyond_paraxial, is_oblique, trace
from kcam.optics.propagation.grid import samples_by_rule
from kcam.optics.propagation.question import Query
from kcam.optics.propagation.reference import _evaluate, _refined, convergence
from kcam.optics.propagation.spectrum import spectrum_grids
from kcam.optics.source import PixelGrid, Points
from kcam.units import mm, nm, um

FLOOR = 1e-6  # of float32: below it an estimate may be as much too small as it likes
ROWS = [key for key in PROPAGATORS if key[0] != "reference"]


def log_uniform(rng: random.Random, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def elements(rng: random.Random, kind: str, diameter: float, focal: float) -> Iterator[optics.Element]:
    generator = torch.Generator().manual_seed(rng.randrange(1 << 30))
    if kind == "square":
        yield optics.SquareAperture(diameter)
    elif kind == "annular":
        yield optics.AnnularAperture(diameter, obscuration=rng.uniform(0.1, 0.6))
    else:
        yield optics.CircularAperture(diameter)
    ideal = kind in ("thin", "annular") or rng.random() < 0.3
    yield optics.ThinLens(focal) if ideal else optics.PlanoConvexLens(focal * 0.5185, glass="N-BK7")
    if kind == "zernike":
        coefficients = torch.randn(rng.randint(4, 21), dtype=torch.float64, generator=generator)
        coefficients[:3] = 0
        yield optics.ZernikeDOE(coefficients / coefficients.norm() * log_uniform(rng, 0.2, 20))
    if kind in ("smooth", "noise", "flat"):
        n = rng.choice([33, 64, 101, 200, 301])
        phase = torch.zeros(n, n, dtype=torch.float64)
        if kind == "noise":
            phase = torch.rand(n, n, generator=generator, dtype=torch.float64) * rng.uniform(1, 6.3)
        if kind == "smooth":
            coarse = torch.randn(1, 1, 5, 5, generator=generator, dtype=torch.float64)
            phase = torch.nn.functional.interpolate(coarse, size=(n, n), mode="bicubic", align_corners=True)[0, 0]
            phase = phase / (phase.max() - phase.min()) * log_uniform(rng, 0.5, 60)
        yield optics.DOE(phase)


def random_query(seed: int) -> Query:
    """A lens of f/3 to f/30, 0.3 to 10 mm wide, in focus or up to 40 waves off it, on 17 to 129 pixels of 1 to 8 um."""
    rng = random.Random(seed)
    while True:
        focal = log_uniform(rng, 12 * mm, 100 * mm)
        diameter = min(max(focal / log_uniform(rng, 3, 30), 0.3 * mm), 10 * mm)
        kind = rng.choice(["thin", "sphere", "zernike", "annular", "square", "smooth", "noise", "flat"])
        focus = rng.choice([math.inf, log_uniform(rng, 0.3, 10)])
        wavelength = rng.uniform(420, 720) * nm
        off = rng.choice([0, 1]) * log_uniform(rng, 0.1, 40) * 8 * wavelength / diameter**2 * rng.choice([-1, 1])
        vergence = 1 / focus + off
        distance = math.inf if vergence <= 1e-6 else max(1 / vergence, 0.1)
        size = rng.choice([17, 33, 48, 65] if kind == "zernike" else [17, 33, 48, 65, 96, 129])
        lens = optics.Lens(*elements(rng, kind, diameter, focal), focus_distance=focus)
        asked = lens.query(
            [wavelength], distances=distance, pixel_pitch=log_uniform(rng, 1, 8) * um, shape=(size, size),
            integrate=rng.random() < 0.7,
        )  # fmt: skip
        # the reference is to take a second, not a minute
        if samples_by_rule(asked, 0) <= 400:
            return asked


def truth(query: Query) -> torch.Tensor:
    """The reference; where the Hankel form is exact it stands in for the quadrature, 1e-7 away and much faster."""
    exact = query.on(dtype=torch.float64)
    return PROPAGATORS[("nonparaxial", "radial") if query.lens.symmetric else ("reference", "quadrature")](exact)


def ratios(query: Query) -> dict[tuple[str, str], float]:
    """Error over estimate of each row that answers, both down to the floor."""
    answer = truth(query)
    found = {}
    for key in ROWS:
        row = PROPAGATORS[key]
        if row.valid_for(query) is not None:
            continue
        if key[0] == "angular_spectrum" and spectrum_grids(query)[0][0] > 1200:
            continue  # 10 s each
        error = float((row(query).double() - answer).abs().sum() / answer.abs().sum())
        found[key] = max(error, FLOOR) / max(row.error(query), FLOOR)
    return found


@pytest.mark.parametrize("seed", range(40))
def test_one_radius_tells_what_the_paraxial_model_leaves_out(seed: int) -> None:
    query = random_query(seed)
    traced = max(rays.beyond for rays in trace(query))
    if traced > 0.1:
        assert 0.95 < beyond_paraxial(query) / traced < (1.15 if query.lens.round else 2.2)


def judge(seeds: range) -> None:
    gathered: dict[tuple[str, str], list[tuple[float, int]]] = {key: [] for key in ROWS}
    for seed in seeds:
        for key, ratio in ratios(random_query(seed)).items():
            gathered[key].append((ratio, seed))
    for key, found in gathered.items():
        worst, seed = max(found)
        median = sorted(ratio for ratio, _ in found)[len(found) // 2]
        print(f"{'/'.join(key)}: {len(found)} cameras, error over estimate: median {median:.2f}, worst {worst:.2f}")
        assert worst <= 3, f"{key}: the estimate is {worst:.2g} times too small for camera {seed}"
        assert median >= 0.1, f"{key}: the estimate is {1 / median:.2g} times too large in the median"


def test_estimates_hold_over_random_cameras() -> None:
    judge(range(1, 4))  # rotationally symmetric ones and one that is not, of a second together; 0 takes four


@pytest.mark.slow
@pytest.mark.parametrize("first", range(1000, 1220, 55))
def test_estimates_hold_over_many_random_cameras(first: int) -> None:
    judge(range(first, first + 55))


def noise(size: int, *, waves: float = 1.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(size)
    return 2 * math.pi * waves * torch.rand(size, size, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize(
    ("aperture", "elements"),
    [
        (optics.CircularAperture(2 * mm), [optics.DOE(noise(109))]),
        (optics.AnnularAperture(2 * mm, obscuration=0.4), [optics.DOE(noise(109))]),
        (optics.AnnularAperture(2 * mm, obscuration=0.7), [optics.DOE(noise(56))]),
        (optics.AnnularAperture(2 * mm, obscuration=0.4), [optics.DOE(noise(38))]),
        (optics.CircularAperture(2 * mm), [optics.DOE(noise(33)), optics.DOE(noise(20), pitch=2 * mm / 15.3)]),
        (optics.ApertureMap((noise(16) > 3).double(), width=2 * mm), [optics.DOE(noise(33))]),
        (optics.SquareAperture(2 * mm), [optics.DOE(noise(33), pitch=2 * mm / 28.3)]),
    ],
    ids=["cells are pixels", "annulus", "thin annulus", "cells in pixels", "two maps", "mask and DOE", "cut square"],
)
def test_estimates_hold_for_maps_however_the_rim_cuts_them(
    aperture: optics.Aperture, elements: list[optics.Element]
) -> None:
    lens = optics.Lens(aperture, optics.ThinLens(20 * mm), *elements, focus_distance=math.inf)
    asked = lens.query([550 * nm], distances=math.inf, pixel_pitch=2 * um, shape=(33, 33))
    row = PROPAGATORS["nonparaxial", "matrix"]
    # the reference may refuse noise at its own 3e-4; unchecked it is finer by far than what is judged
    answer = _evaluate(_refined(asked), doubling=1)
    error, estimate = float((row(asked).double() - answer).abs().sum() / answer.abs().sum()), row.error(asked)
    print(f"error {error:.1e}, estimate {estimate:.1e}: {error / estimate:.2f}")
    assert error <= 3 * estimate
    assert estimate <= 5e-3


@pytest.mark.parametrize("samples", [96, 128, 192, 400])
@pytest.mark.parametrize("seed", [*(pytest.param(seed, marks=pytest.mark.slow) for seed in range(3)), 3])
def test_estimates_hold_for_samples_that_the_user_gives(seed: int, samples: int) -> None:
    asked = random_query(seed)
    row = PROPAGATORS["nonparaxial", "matrix"]
    asked = asked.sampled(samples=samples)
    try:
        psf = row(asked)
    except ValueError as refusal:
        pytest.skip(str(refusal))
    answer = truth(asked.sampled(samples=None))
    error = float((psf.double() - answer).abs().sum() / answer.abs().sum())
    assert max(error, FLOOR) <= 3 * max(row.error(asked), FLOOR)


# ---- the reference -------------------------------------------------------------------------------------------------


def singlet(*others: optics.Element, aperture: optics.Aperture | None = None) -> optics.Lens:
    glass = optics.PlanoConvexLens(25.8 * mm, glass="N-BK7")
    return optics.Lens(aperture or optics.CircularAperture(5 * mm), glass, *others, focus_distance=2.0)


@pytest.mark.parametrize(
    ("lens", "bound"),
    # polar quadrature converges to rounding; flat pixels are cut by the rim in cells of a seventh of a sample
    [
        (singlet(), 1e-12),
        (singlet(aperture=optics.AnnularAperture(5 * mm, obscuration=0.4)), 1e-12),
        (singlet(optics.ZernikeDOE(torch.tensor([0, 0, 0, 3.0, 1.0, 0, 2.0]))), 1e-11),
        (singlet(aperture=optics.SquareAperture(4 * mm)), 4e-5),
        (singlet(aperture=optics.ApertureMap(torch.eye(9), width=4 * mm)), 2e-4),
        (singlet(optics.DOE(torch.rand(33, 33, generator=torch.Generator().manual_seed(0)) * 6)), 2e-4),
    ],
    ids=["circle", "annulus", "zernike", "square", "map", "noise"],
)
def test_the_reference_is_converged_and_meets_a_closed_form(lens: optics.Lens, bound: float) -> None:
    measured = convergence(lens.query([550 * nm], distances=1.0, pixel_pitch=4 * um, shape=(33, 33)))
    print(f"doubled {measured.doubled:.1e}, closed form {measured.closed_form:.1e}")
    assert measured.doubled < bound
    assert measured.closed_form < bound
    assert measured.reached


def test_a_reference_that_is_not_converged_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing a user can ask for seems to get there, so its sampling is made coarse."""
    monkeypatch.setattr("kcam.optics.propagation.reference._KAPPA", 0.0)
    lens = singlet(optics.DOE(torch.rand(65, 65, generator=torch.Generator().manual_seed(0)) * 6))
    asked = lens.query([550 * nm], distances=2.0, pixel_pitch=4 * um, shape=(65, 65))
    asked = asked.sampled(kappa=1.2, cells_per_sample=1.0)
    with pytest.raises(ValueError, match=r"reference is not converged here: twice its sampling changes it by .*Use"):
        PROPAGATORS["reference", "quadrature"](asked)


# ---- explain -------------------------------------------------------------------------------------------------------


def test_explain_names_the_row_its_sampling_its_error_and_the_energy() -> None:
    lens = singlet()
    arguments = {"distances": torch.tensor([1.0, math.inf]), "pixel_pitch": 4 * um, "shape": (65, 65)}
    told = lens.explain([450 * nm, 650 * nm], **arguments)
    assert (told.propagator, told.method) == ("nonparaxial", "radial")
    assert told.samples is None
    psf = lens.psf([450 * nm, 650 * nm], **arguments)
    torch.testing.assert_close(told.energy.double(), psf.sum((-2, -1)).double(), rtol=1e-4, atol=0)
    assert told.distances.tolist() == [1.0, math.inf]
    text = str(told)
    assert "> nonparaxial/radial" in text
    for words in ("estimated error", "captured energy", "no grid", "Rayleigh-Sommerfeld"):
        assert words in text
    assert max(map(len, text.splitlines())) <= 100


def test_explain_takes_the_arguments_of_psf_and_shows_what_is_refused() -> None:
    lens = singlet(optics.DOE(torch.zeros(33, 33)))
    told = lens.explain(
        [550 * nm], distances=2.0, pixel_pitch=4 * um, shape=(33, 33), propagator="fresnel", method="chirp_z",
        samples=256, fill_factor=0.5, integrate=False, dtype=torch.float64,
    )  # fmt: skip
    assert (told.propagator, told.method, told.samples) == ("fresnel", "chirp_z", (256, 256))
    refused = {f"{row.propagator}/{row.method}" for row in told.candidates if row.refusal}
    assert {"nonparaxial/radial", "fresnel/radial", "geometric/rays"} <= refused
    assert "needs a lens of rotationally symmetric elements" in str(told)
    with pytest.raises(ValueError, match="unknown propagator 'wave'"):
        lens.explain([550 * nm], distances=2.0, pixel_pitch=4 * um, shape=(33, 33), propagator="wave")


@pytest.mark.parametrize("seed", range(12))
def test_how_far_rays_go_is_told_wavelength_by_wavelength(seed: int) -> None:
    """Whatever was asked before; of rings by the outermost wavelengths that are asked; and anew of another lens."""
    query = random_query(seed)
    grid = torch.linspace(400, 700, 13, dtype=torch.float64) * nm
    every = dataclasses.replace(query, wavelengths=grid)
    some = torch.tensor([3, 11, 7, 3])
    asked = dataclasses.replace(query, wavelengths=grid[some])
    first, whole = asked.spread(1e-6), every.spread(1e-6)
    if not query.has_rings:
        assert torch.equal(first, whole[some])
        alone = dataclasses.replace(query, lens=copy.deepcopy(query.lens), wavelengths=grid[8:9]).spread(1e-6)
        torch.testing.assert_close(alone, whole[8:9], rtol=1e-12, atol=0)
    assert bool((whole >= 0).all())
    other = copy.deepcopy(query.lens)
    other.sensor_distance = torch.as_tensor(other.sensor_distance) * 1.01
    assert not torch.equal(dataclasses.replace(every, lens=other).spread(1e-6), whole)


@pytest.mark.parametrize("aperture", [optics.CircularAperture(4 * mm), optics.SquareAperture(4 * mm)])
def test_rays_go_where_their_slope_says(aperture: optics.Element) -> None:
    """Of an ideal lens out of focus, in the paraxial model: by a d |V - focus|, and by sqrt 2 of that from corners."""
    lens = optics.Lens(aperture, optics.ThinLens(50 * mm), focus_distance=2.0)
    corner = 1.0 if lens.round else math.sqrt(2)
    for distance in (0.7, 1.3, 5.0, math.inf):
        query = lens.query([550 * nm], distances=distance, pixel_pitch=4 * um, shape=(65, 65)).modelled(paraxial=True)
        expected = corner * 2 * mm * float(query.sensor_distance) * abs(1 / distance - 1 / 2.0)
        assert float(query.displacement) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("seed", range(12))
def test_where_defocus_shows_along_the_diagonals(seed: int) -> None:
    """A pupil's path and a map of pixels with it say the same; turned by an eighth they say the other."""
    draw = Draw(seed)
    power, focus = draw.number(6, 20) * draw.one_of(-1, 1), draw.number(-0.3, 0.3)
    coma = draw.number(-2, 2)
    axis = torch.linspace(-1, 1, 95, dtype=torch.float64)[1::2]  # middles of pixels
    x, y = axis, axis[:, None]
    phases = {True: power * x * y, False: power * (x**2 - y**2) / 2}
    for oblique, index in ((True, 4), (False, 5)):
        coefficients = torch.zeros(9, dtype=torch.float64)
        coefficients[index], coefficients[7] = power / (2 * math.pi) * 550 * nm / (2 * math.sqrt(6)), coma * 20 * nm
        for plate in (optics.ZernikeAberration(coefficients), optics.DOE(phases[oblique])):
            lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(25 * mm), plate, focus_distance=1.0)
            vergences = torch.tensor([1 + focus - 0.2, 1 + focus + 0.2], dtype=torch.float64)
            wide = optics.DOE(torch.zeros(3, 3), pitch=4 * mm)  # no corner of its pixels is in the pupil
            for own in (lens, optics.Lens(*lens.elements, wide, focus_distance=1.0)):
                question = own.question(
                    Points(vergences), torch.tensor([550 * nm], dtype=torch.float64), PixelGrid(3 * um, (65, 65))
                )
                assert is_oblique(question) == oblique
