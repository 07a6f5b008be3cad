"""Radial profiles that are wrapped, noisy, stepped or fine, against a dense quadrature in each of their intervals."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from scipy.special import j0, jvp
from torch import Tensor, nn

from kcam import optics
from kcam.optics import PROPAGATORS
from kcam.optics.numerics import BesselJ0 as _BesselJ0
from kcam.optics.propagation.grid import samples_by_rule
from kcam.optics.propagation.question import Query
from kcam.optics.propagation.radial import hankel
from kcam.optics.propagation.rings import fewer_nodes, panels_of
from kcam.optics.propagation.spectrum import spectrum_grids
from kcam.optics.pupil.coordinates import Pupil
from kcam.units import mm, nm, um
from tests import oracles

RADIAL = PROPAGATORS["nonparaxial", "radial"]
FLOOR = 1e-6  # as in test_estimates


def log_uniform(rng: random.Random, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))


@dataclass(frozen=True)
class Rings:
    """A thin lens with a profile, what is asked of it, and the truth."""

    lens: optics.Lens
    profile: Tensor
    focus: float
    wavelength: float
    distance: float
    pitch: float
    size: int

    def query(self, **changed: object) -> Query:
        asked = self.lens.query(
            [self.wavelength], distances=self.distance, pixel_pitch=self.pitch, shape=(self.size, self.size),
            integrate=False, dtype=torch.float64,
        )  # fmt: skip
        return asked.sampled(**changed)

    @property
    def truth(self) -> oracles.RadialPupil:
        n = len(self.profile)
        index = [float(optics.refractive_index("fused silica", wavelengths=torch.tensor([w],
                 dtype=torch.float64))) for w in (self.wavelength, 550 * nm)]  # fmt: skip
        factor = 550 * nm * (index[0] - 1) / (self.wavelength * (index[1] - 1))
        spline, discs = oracles.catmull_rom(factor * self.profile.double().numpy()), self.lens.aperture.discs()
        return oracles.RadialPupil(
            np.linspace(0, 1, n), lambda rho: spline(rho * (n - 1)),
            aperture_radius=float(self.lens.aperture.semi_aperture()), sensor_distance=self.lens.sensor_distance,
            wavelength=self.wavelength, distance=self.distance, focus=self.focus,
            inner=discs[1][0] if len(discs) > 1 else 0.0,
        )  # fmt: skip

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Distinct radii of the pixels' centres, and which of them each pixel has."""
        axis = np.arange(self.size) - self.size // 2
        squares, where = np.unique(axis[:, None] ** 2 + axis**2, return_inverse=True)
        return np.sqrt(squares) * self.pitch, where.reshape(self.size, self.size)

    def image(self) -> np.ndarray:
        r, where = self.points()
        return (np.abs(self.truth.amplitude(r)) ** 2 * self.pitch**2)[where]

    def error(self, psf: Tensor, image: np.ndarray) -> float:
        return float(np.abs(psf[0, 0].detach().double().numpy() - image).sum() / image.sum())


def make(
    profile: Tensor, *, diameter: float = 5 * mm, focal: float = 50 * mm, size: int = 65, obscuration: float = 0.0,
    focus: float = 2.0, distance: float = 2.0, wavelength: float = 550 * nm, pitch: float = 4 * um,
) -> Rings:  # fmt: skip
    stop = optics.AnnularAperture(diameter, obscuration=obscuration)
    lens = optics.Lens(stop, optics.ThinLens(focal), optics.RadialDOE(profile), focus_distance=focus)
    return Rings(lens, profile.detach(), focus, wavelength, distance, pitch, size)


def noise(rings: int, amplitude: float) -> Tensor:
    generator = torch.Generator().manual_seed(rings)
    return amplitude * (2 * torch.rand(rings, generator=generator, dtype=torch.float64) - 1)


def line(rings: int) -> Tensor:
    return torch.linspace(0, 1, rings, dtype=torch.float64)


ISSUE = {
    "wrapped 60 rad, 201 rings": lambda: torch.remainder(60 * line(201), 2 * math.pi),
    "wrapped 100 rad, 385 rings": lambda: torch.remainder(100 * line(385) ** 2, 2 * math.pi),
    "noise of 3 rad": lambda: noise(385, 3.0),
    "mild noise": lambda: noise(280, 0.4),
    "a start of 0.1 rad": lambda: noise(385, 0.1),
    "steps": lambda: 2.0 * (torch.arange(201) // 4 % 2).double(),
    "steps between the scanned radii": lambda: 2.0 * (torch.arange(193) % 4 == 2).double(),
    "smooth": lambda: 30 * line(201) ** 2,
}


def random_rings(seed: int) -> Rings:
    """f/3 to f/30, 0.3 to 10 mm wide, 5 to 500 rings wrapped, noisy, stepped or chirped, in focus or up to 20 waves
    off.
    """
    rng = random.Random(seed)
    focal = log_uniform(rng, 8 * mm, 100 * mm)
    diameter = min(max(focal / log_uniform(rng, 3, 30), 0.3 * mm), 10 * mm)
    count = int(log_uniform(rng, 5, 500))
    generator = torch.Generator().manual_seed(rng.randrange(1 << 30))
    white, rho = torch.rand(count, generator=generator, dtype=torch.float64), line(count)
    profile = {
        "wrapped": lambda: torch.remainder(log_uniform(rng, 3, 120) * rho ** rng.choice([1, 2, 3]), 2 * math.pi),
        "noise": lambda: (2 * white - 1) * log_uniform(rng, 0.05, 4),
        "steps": lambda: log_uniform(rng, 0.1, 3.2) * (white > 0.5)[torch.arange(count) // rng.randint(1, 9)].double(),
        "chirp": lambda: log_uniform(rng, 0.05, 4) * torch.cos(log_uniform(rng, 3, 120) * rho**2),
        "both": lambda: torch.remainder(log_uniform(rng, 3, 60) * rho**2, 2 * math.pi) + white,
    }[rng.choice(["wrapped", "noise", "steps", "chirp", "both"])]()
    wavelength, focus = rng.uniform(420, 720) * nm, rng.choice([math.inf, log_uniform(rng, 0.3, 10)])
    off = rng.choice([0, 1]) * log_uniform(rng, 0.1, 20) * 8 * wavelength / diameter**2 * rng.choice([-1, 1])
    vergence = 1 / focus + off
    return make(
        profile, diameter=diameter, focal=focal, obscuration=rng.choice([0.0, rng.uniform(0.1, 0.6)]), focus=focus,
        distance=math.inf if vergence <= 1e-6 else max(1 / vergence, 0.1), wavelength=wavelength,
        pitch=log_uniform(rng, 1, 8) * um, size=rng.choice([9, 17, 33, 64]),
    )  # fmt: skip


def window_loss(rings: Rings) -> float:
    """Share of the light outside the default window of a picture that bounds nothing."""
    imaging = optics.Imaging(rings.lens, pixel_pitch=rings.pitch)
    vergences = torch.tensor([1 / rings.distance], dtype=torch.float64)
    wavelengths = torch.tensor([rings.wavelength], dtype=torch.float64)
    window = imaging.psf_window(wavelengths, vergences=vergences, picture=(10**6 + 1, 10**6 + 1))
    return rings.truth.outside(window[0] / 2 * rings.pitch)


def test_profiles_are_what_the_oracle_takes() -> None:
    profile = noise(9, 2.0)
    rho = torch.linspace(0, 1, 57, dtype=torch.float64)
    one = torch.ones((), dtype=torch.float64)
    element = optics.RadialDOE(profile)
    pupil = Pupil(rho, 0 * rho, one, one, paraxial=True)
    ((_, found),) = element.terms(pupil, torch.tensor([550 * nm], dtype=torch.float64))
    np.testing.assert_allclose(found.numpy(), oracles.catmull_rom(profile.numpy())(rho.numpy() * 8), atol=1e-12)


@pytest.mark.parametrize("name", ISSUE)
def test_the_default_row_is_right_for_any_profile(name: str) -> None:
    rings = make(ISSUE[name]())
    image = rings.image()
    psf = rings.lens.psf(
        [rings.wavelength], distances=2.0, pixel_pitch=rings.pitch, shape=(65, 65), integrate=False, dtype=torch.float64
    )
    error = rings.error(psf, image)
    stated = rings.lens.explain([rings.wavelength], distances=2.0, pixel_pitch=rings.pitch, shape=(65, 65)).error
    print(f"{name}: {error:.1e}, stated {stated:.1e}")
    assert error <= stated <= 1e-6


@pytest.mark.parametrize("name", ISSUE)
def test_the_gradient_reaches_every_ring_rightly(name: str) -> None:
    parameter = nn.Parameter(ISSUE[name]())
    rings = make(parameter, size=33)
    weights = torch.rand(33, 33, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    (RADIAL(rings.query())[0, 0] * weights).sum().backward()
    r, where = rings.points()
    sums = np.bincount(where.ravel(), weights=weights.numpy().ravel()) * rings.pitch**2
    truth = rings.truth.gradient(r, sums, len(parameter))  # 550 nm is the design wavelength: the factor is 1
    found = parameter.grad.numpy()
    cosine = float(found @ truth / np.linalg.norm(found) / np.linalg.norm(truth))
    print(f"{name}: 1 - cosine {1 - cosine:.1e}, length {np.linalg.norm(found) / np.linalg.norm(truth) - 1:.1e}")
    np.testing.assert_allclose(found, truth, atol=1e-6 * np.abs(truth).max())


@pytest.mark.parametrize("seed", range(8))
def test_random_profiles_are_right(seed: int) -> None:
    rings = random_rings(seed)
    error = rings.error(RADIAL(rings.query()), rings.image())
    print(f"{len(rings.profile)} rings: {error:.1e}")
    assert error <= RADIAL.error(rings.query()) <= 1e-6


@pytest.mark.parametrize("name", ["mild noise", "a start of 0.1 rad", "steps", "smooth"])
def test_the_default_window_holds_the_light_of_rings(name: str) -> None:
    assert window_loss(make(ISSUE[name](), diameter=2 * mm)) <= 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("first", range(1000, 1060, 10))
def test_many_random_profiles_are_right_in_every_row_and_their_windows_hold_the_light(first: int) -> None:
    gathered: dict[str, list[float]] = {}
    for seed in range(first, first + 10):
        rings = random_rings(seed)
        asked, image = rings.query(), rings.image()
        airy = rings.wavelength * rings.lens.f_number
        reach = float(asked.spread(1e-4)[0])
        if reach < 300 * airy:  # else the truth takes minutes
            assert window_loss(rings) <= 1e-3, seed
        for (physics, method), row in PROPAGATORS.items():
            heavy = samples_by_rule(asked, 0) > 700
            if physics == "reference" or (heavy and method in ("matrix", "chirp_z", "fft", "rays")):
                continue
            if row.valid_for(asked) or (physics == "angular_spectrum" and spectrum_grids(asked)[0][0] > 600):
                continue
            error, stated = rings.error(row(asked), image), row.error(asked)
            assert error <= 3 * max(stated, FLOOR), (seed, physics, method, error, stated)
            gathered.setdefault(f"{physics}/{method}", []).append(error / stated)
    for name, found in gathered.items():
        print(f"{name}: {len(found)}, error over estimate: median {np.median(found):.2g}, worst {max(found):.2g}")


@pytest.mark.parametrize("samples", [None, 256])
@pytest.mark.parametrize(("rings", "amplitude"), [(30, 0.4), (60, 0.1), (20, 3.0)])
def test_grids_state_what_rings_cost_them(rings: int, amplitude: float, samples: int | None) -> None:
    asked = make(noise(rings, amplitude), diameter=2 * mm, size=33)
    row = PROPAGATORS["nonparaxial", "matrix"]
    error = asked.error(row(asked.query(samples=samples)), asked.image())
    stated = row.error(asked.query(samples=samples))
    print(f"{error:.1e}, stated {stated:.1e}")
    assert error <= 3 * stated
    assert samples is not None or stated <= 2e-2


def test_rings_beside_an_element_that_is_not_symmetric() -> None:
    zernike = optics.ZernikeDOE(torch.tensor([0, 0, 0, 0, 1.0, 0, 0.5]))
    lens = optics.Lens(
        optics.CircularAperture(2 * mm), optics.ThinLens(50 * mm), zernike, optics.RadialDOE(noise(24, 0.6)),
        focus_distance=2.0,
    )  # fmt: skip
    asked = lens.query([550 * nm], distances=2.0, pixel_pitch=4 * um, shape=(9, 9), dtype=torch.float64)
    truth = PROPAGATORS["reference", "quadrature"](asked)
    for key in (("nonparaxial", "matrix"), ("nonparaxial", "fft")):
        row = PROPAGATORS[key]
        error = float((row(asked) - truth).abs().sum() / truth.sum())
        print(f"{key}: {error:.1e}, stated {row.error(asked):.1e}")
        assert error <= 3 * row.error(asked) <= 1e-2


# ---- elements of one's own -----------------------------------------------------------------------------------------


class Own(optics.Element):
    """A symmetric path of 550 nm / 2 pi times any function of rho [rad]."""

    symmetric = True

    def __init__(self, phase: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.phase = phase

    def terms(self, pupil: Pupil, wavelengths: Tensor) -> list:
        rho = torch.sqrt(pupil.rho2.clamp(min=1e-24))
        return [(torch.full_like(wavelengths, 550 * nm / (2 * math.pi)), self.phase(rho))]


OWN = {  # the phase [rad], and where it is not smooth
    "steps": (lambda rho: 2.0 * ((rho * 23).floor() % 2), np.arange(1, 23) / 23),
    "steps at no place of a grid": (
        lambda rho: 1.5 * ((rho**2 * math.e * 5).floor() % 2),
        np.sqrt(np.arange(1, 14) / math.e / 5),
    ),
    "kinks": (lambda rho: 3 * (torch.remainder(rho * 7.3, 1) - 0.5).abs(), np.arange(1, 15) / 14.6),
    "wrapped": (lambda rho: torch.remainder(60 * rho**2, 2 * math.pi), np.sqrt(np.arange(1, 10) * 2 * math.pi / 60)),
    "fast": (lambda rho: 0.5 * torch.cos(900 * rho), np.linspace(0, 1, 400)),
    "smooth": (lambda rho: 20 * rho**4, []),
}


@pytest.mark.parametrize("name", OWN)
def test_structure_of_an_element_that_does_not_tell_is_found(name: str) -> None:
    phase, edges = OWN[name]
    element = Own(phase)
    assert element.knots is None
    lens = optics.Lens(optics.CircularAperture(4 * mm), optics.ThinLens(50 * mm), element, focus_distance=2.0)
    rings = Rings(lens, torch.zeros(0), 2.0, 550 * nm, 2.0, 4 * um, 33)
    truth = oracles.RadialPupil(
        edges, lambda rho: phase(torch.as_tensor(rho)).numpy(), aperture_radius=2 * mm,
        sensor_distance=lens.sensor_distance, wavelength=550 * nm, distance=2.0, focus=2.0,
    )  # fmt: skip
    r, where = rings.points()
    image = (np.abs(truth.amplitude(r)) ** 2 * rings.pitch**2)[where]
    error = rings.error(RADIAL(rings.query()), image)
    print(f"{name}: {error:.1e}, {rings.query().panels.numel()} panels")
    assert error <= RADIAL.error(rings.query()) <= 1e-6


def test_a_flat_profile_of_ones_own_trains_rightly() -> None:
    """Its values are smooth, and say nothing of its gradient."""

    class OwnProfile(Own):
        def __init__(self, rings: int) -> None:
            super().__init__(self.linear)
            self.profile = nn.Parameter(torch.zeros(rings, dtype=torch.float64))

        def linear(self, rho: Tensor) -> Tensor:
            place = rho.clamp(max=1) * (len(self.profile) - 1)
            low = place.detach().floor().long().clamp(max=len(self.profile) - 2)
            return torch.lerp(self.profile[low], self.profile[low + 1], place - low)

        @property
        def knots(self) -> Tensor | None:
            return self.told

    found = []
    for told in (None, torch.linspace(0, 1, 160)):
        element = OwnProfile(160)
        element.told = told
        lens = optics.Lens(optics.CircularAperture(4 * mm), optics.ThinLens(50 * mm), element, focus_distance=1.0)
        psf = lens.psf([550 * nm], distances=2.0, pixel_pitch=4 * um, shape=(33, 33), dtype=torch.float64)
        (psf * torch.rand(33, 33, generator=torch.Generator().manual_seed(0))).sum().backward()
        found.append(element.profile.grad)
    error = float((found[0] - found[1]).norm() / found[1].norm())
    print(f"gradient without the knots: {error:.1e}")
    assert error < 1e-3


def test_structure_that_no_panels_resolve_is_refused() -> None:
    lens = optics.Lens(
        optics.CircularAperture(4 * mm), optics.ThinLens(50 * mm), Own(lambda rho: torch.cos(1e7 * rho)),
        focus_distance=2.0,
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"not smooth in 16384 panels between 0 and the rim. Let .* as `knots`"):
        lens.psf([550 * nm], distances=2.0, pixel_pitch=4 * um, shape=(9, 9))


def test_a_subclass_with_terms_of_its_own_tells_nothing_until_it_says_so() -> None:
    class Inherits(optics.RadialDOE):
        pass

    class Overrides(optics.RadialDOE):
        def terms(self, pupil: Pupil, wavelengths: Tensor) -> list:
            return super().terms(pupil, wavelengths)

    assert len(Inherits(noise(9, 1.0)).knots) == 9
    assert Overrides(noise(9, 1.0)).knots is None
    assert not optics.Lens(optics.CircularAperture(1 * mm), optics.ThinLens(50 * mm), focus_distance=2.0).has_rings


@pytest.mark.parametrize("seed", range(12))
def test_a_lone_groove_is_found_wherever_it_is(seed: int) -> None:
    """Also between the nodes of the first panels, and at their ends."""
    rng = random.Random(seed)
    width = log_uniform(rng, 3e-5, 1e-2)
    first = rng.choice([rng.uniform(0, 0.99), rng.randrange(32) / 32 + rng.choice([1e-4, 1e-6]), 0.5 - width / 2])
    knot = torch.tensor([0.0, 1.0], dtype=torch.float64)
    flat = panels_of(lambda rho: 3.0 * ((rho >= first) & (rho < first + width)).to(rho)[None], knot)
    for edge in (first, first + width):
        assert float((flat - edge).abs().min()) < 2**-25
    smooth = panels_of(lambda rho: torch.exp(-(((rho - first) / width) ** 2))[None], knot)
    widths = smooth.diff()[(smooth[1:] > first - width) & (smooth[:-1] < first + width)]
    assert float(widths.max()) < 4 * width
    assert smooth.numel() < 200


def test_panels_close_in_on_a_step() -> None:
    edges = panels_of(lambda rho: (rho > 0.3).to(rho)[None], torch.tensor([0.0, 1.0], dtype=torch.float64))
    assert float((edges - 0.3).abs().min()) < 2**-25
    assert edges.numel() < 80
    assert torch.equal(edges[[0, -1]], torch.tensor([0.0, 1.0], dtype=torch.float64))


@pytest.mark.parametrize("seed", range(6))
def test_fewer_nodes_tell_a_kernel_as_much(seed: int) -> None:
    """Of a rough field, at random frequencies up to that of the kernel, of one part of the radius and of many."""
    rng, generator = random.Random(seed), torch.Generator().manual_seed(seed)
    frequency, inner = log_uniform(rng, 30, 5000), rng.choice([0.0, rng.uniform(0, 0.8)])
    nodes = inner + (1 - inner) * torch.rand(int(4 * frequency) + 200, generator=generator, dtype=torch.float64)
    values = torch.randn(2, len(nodes), generator=generator, dtype=torch.float64) / len(nodes)
    fewer, places = fewer_nodes(values, nodes, frequency=frequency)
    assert len(places) < 0.7 * len(nodes)
    t = frequency * torch.rand(50, 1, generator=generator, dtype=torch.float64)
    truth, found = ((v @ torch.cos(t * x).T) for v, x in ((values, nodes), (fewer, places)))
    assert float((found - truth).abs().max()) < 1e-8


@pytest.mark.parametrize("seed", range(8))
def test_a_window_cuts_a_psf_and_changes_nothing_else(seed: int) -> None:
    """Wherever the table of the light ends: of random windows, pitches and lenses, in and out of focus."""
    rng = random.Random(seed)
    lens = optics.Lens(
        optics.CircularAperture(rng.uniform(1, 6) * mm), optics.ThinLens(25 * mm), focus_distance=rng.uniform(0.5, 3)
    )
    shape = rng.randint(1, 40), rng.randint(1, 40)
    wide = tuple(n + 2 * rng.randint(1, 30) for n in shape)
    asked = {
        "distances": rng.uniform(0.5, 3), "pixel_pitch": rng.uniform(1, 6) * um, "method": "radial",
        "fill_factor": rng.choice([1.0, 0.5]), "integrate": rng.random() < 0.7, "dtype": torch.float64,
    }  # fmt: skip
    wavelengths = [rng.uniform(400, 700) * nm for _ in range(2)]
    small, large = (lens.psf(wavelengths, shape=own, **asked) for own in (shape, wide))
    top, left = (b // 2 - a // 2 for a, b in zip(shape, wide, strict=True))
    part = large[..., top : top + shape[0], left : left + shape[1]]
    torch.testing.assert_close(small, part, rtol=0, atol=5e-6 * float(large.max()))


@pytest.mark.parametrize("seed", range(8))
def test_transfer_functions_of_fast_optics_on_large_pixels(seed: int) -> None:
    """Whose light has frequencies of many cycles per pixel: all of them are folded into those of the pixels."""
    rng = random.Random(seed)
    f_number, wavelengths = log_uniform(rng, 1.8, 6), [450 * nm, 650 * nm]
    aperture = optics.AnnularAperture(25 * mm / f_number, obscuration=rng.choice([0.0, rng.uniform(0.1, 0.7)]))
    lens = optics.Lens(aperture, optics.ThinLens(25 * mm), focus_distance=2.0)
    asked = {"distances": rng.uniform(1.7, 2.4), "pixel_pitch": rng.uniform(4, 12) * um, "shape": (65, 65)}
    psf = lens.psf(wavelengths, dtype=torch.float64, **asked)
    frequencies = torch.linspace(0, 0.5, 40, dtype=torch.float64)
    x = torch.arange(65, dtype=torch.float64) - 32
    truth = torch.stack([psf.sum(dim) @ torch.cos(2 * math.pi * x[:, None] * frequencies) for dim in (-2, -1)], dim=2)
    found = RADIAL.transfer(lens.query(wavelengths, **asked))(frequencies, (65, 65), [0, 1])
    assert float((found - truth).abs().max()) < 4e-3


@pytest.mark.parametrize("steps", [1, 17, 100, 1000])
def test_the_refined_table_is_that_of_each_step(steps: int) -> None:
    """Of random rings, the outermost among them: it has the highest frequency."""
    generator = torch.Generator().manual_seed(steps)
    rho = torch.rand(50, generator=generator, dtype=torch.float64).index_fill_(0, torch.tensor(0), 1.0)
    field = torch.randn(3, 50, generator=generator, dtype=torch.float64)
    t = torch.arange(steps, dtype=torch.float64) * math.pi / 12
    direct = 2 * math.pi * field @ torch.as_tensor(j0((t[:, None] * rho).numpy())).T
    assert hankel(field, steps, rho, finer=6).shape == direct.shape
    assert float((hankel(field, steps, rho, finer=6) - direct).abs().max()) < 1e-8 * float(field.abs().sum())


# ---- second derivatives --------------------------------------------------------------------------------------------


def test_bessel_functions_can_be_differentiated_again() -> None:
    x = torch.tensor([0.0, 1e-9, 1e-4, 0.1, 3.0, 40.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(_BesselJ0.apply, (x,))
    assert torch.autograd.gradgradcheck(_BesselJ0.apply, (x,))
    once = torch.autograd.grad(_BesselJ0.apply(x).sum(), x, create_graph=True)[0]
    twice = torch.autograd.grad(once.sum(), x, create_graph=True)[0]
    thrice = torch.autograd.grad(twice.sum(), x)[0]
    for order, found in ((1, once), (2, twice), (3, thrice)):
        np.testing.assert_allclose(found.detach().numpy(), jvp(0, x.detach().numpy(), order), atol=1e-9)
    near = torch.linspace(4.9, 5.1, 201, dtype=torch.float64)  # torch's own are 4e-7 off here
    np.testing.assert_allclose(_BesselJ0.apply(near).numpy(), j0(near.numpy()), atol=1e-14)


@pytest.mark.parametrize("profile", [None, noise(12, 1.0)], ids=["bare", "rings"])
@pytest.mark.parametrize("aperture", ["circle", "annulus"])
def test_the_second_derivative_of_the_radial_row_is_that_of_differences(aperture: str, profile: Tensor | None) -> None:
    weights = torch.rand(9, 9, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def slope(distance: float, *, graph: bool = False) -> tuple[Tensor, Tensor]:
        d = nn.Parameter(torch.tensor(distance, dtype=torch.float64))
        stop = optics.CircularAperture(4 * mm)
        if aperture == "annulus":
            stop = optics.AnnularAperture(4 * mm, obscuration=0.5)
        more = [] if profile is None else [optics.RadialDOE(profile)]
        lens = optics.Lens(stop, optics.ThinLens(12 * mm), *more, sensor_distance=d)
        psf = lens.psf(
            [550 * nm], distances=2.0, pixel_pitch=2 * um, shape=(9, 9), method="radial", dtype=torch.float64
        )
        return torch.autograd.grad((psf[0, 0] * weights).sum(), d, create_graph=graph)[0], d

    first, d = slope(12.1 * mm, graph=True)
    second = float(torch.autograd.grad(first, d)[0])
    h = 1e-8
    by_difference = float(slope(12.1 * mm + h)[0] - slope(12.1 * mm - h)[0]) / (2 * h)
    print(f"{second:.8e} against {by_difference:.8e}")
    assert second == pytest.approx(by_difference, rel=1e-5)
