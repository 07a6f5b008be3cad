"""kcam against the textbook: PSF banks and rendering, timed side by side, each time next to its error.

    python -m benchmarks.bench             five to six minutes; prints the table, writes benchmarks/results/bench.json
    python -m benchmarks.bench --quick     seconds, toy sizes: checks that everything runs, judges no target

Both sides compute the same thing: the paraxial (Fresnel) model, both point-sampled or both integrated over the pixels,
gradients to the same parameters. Errors are L1 relative to the truth, over the wavelengths: against float64 quadrature
(tests/oracles.py) for smooth pupils, against a float64 pupil grid finer than the DOE's own pixels for DOEs, against
the float64 per-band picture for rendering.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import oracles
import torch
from rich.console import Console
from scipy.fft import next_fast_len
from torch import Tensor, nn

from benchmarks import whole
from benchmarks.baselines import doe_scale, per_band_render, textbook_psf_bank, transfer_functions
from benchmarks.common import ROOT, Contestant, environment, print_table, race, write_json
from kcam import optics, sensor
from kcam.optics.propagation.table import choose
from kcam.scene import Scene
from kcam.units import mm, nm, um

DOUBLE = torch.float64
RESULTS = ROOT / "benchmarks" / "results" / "bench.json"
FOCUS = 2.0  # m
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Sizes:
    """How large the work is, and how long each race may take [s]."""

    bands: int = 28
    window: int = 297
    pupil: int = 891
    picture: int = 1024
    seconds: float = 4.0

    @property
    def wavelengths(self) -> Tensor:
        return torch.linspace(420, 720, self.bands, dtype=DOUBLE) * nm

    @property
    def sample(self) -> Tensor:
        """Every seventh wavelength: what a textbook loop over 28 is timed on where all of them would take minutes."""
        return self.every(7)

    def every(self, step: int) -> Tensor:
        """The middle one of each `step` wavelengths."""
        return torch.arange(step // 2, self.bands, step) if self.bands >= step else torch.arange(self.bands)

    @property
    def shape(self) -> tuple[int, int]:
        return self.window, self.window


QUICK = Sizes(bands=2, window=33, pupil=101, picture=96, seconds=0)


def relative_l1(result: Tensor, truth: Tensor) -> dict[str, float]:
    """L1 error of each PSF relative to its truth: median and max over the bank."""
    errors = (result.to(DOUBLE) - truth).abs().sum((-2, -1)) / truth.abs().sum((-2, -1))
    return {"l1_median": float(errors.median()), "l1_max": float(errors.max())}


def gradient_error(gradient: Tensor, truth: Tensor) -> dict[str, float]:
    """Relative L2 error of a gradient, and what its cosine lacks of 1 where it is more than one number."""
    gradient, truth = gradient.detach().to(DOUBLE).flatten(), truth.flatten()
    error = {"gradient": float((gradient - truth).norm() / truth.norm())}
    if truth.numel() > 1:
        error["1 - cosine"] = 1 - float(gradient @ truth / (gradient.norm() * truth.norm()))
    return error


def with_gradient(parameter: Tensor, bank: Callable[[], Tensor], cotangent: Tensor) -> tuple[Tensor, Tensor]:
    """The bank and d(sum(bank * cotangent)) / d parameter."""
    parameter.grad = None
    result = bank()
    (result * cotangent.to(result.dtype)).sum().backward()
    return result.detach(), parameter.grad


def without_gradient(bank: Callable[[], Tensor]) -> Tensor:
    with torch.no_grad():
        return bank()


def usual_method(lens: optics.Lens, sizes: Sizes, *, propagator: str = "fresnel", **where: Any) -> str:
    """The transform that kcam takes unless told."""
    return choose(lens.query(sizes.wavelengths, shape=sizes.shape, **where), propagator=propagator).method


# ---- smooth pupils -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Singlet:
    """The numerics note's lens: f = 50 mm sphere (R = 25 mm, n = 1.5), 5 mm aperture, 3 um pixels, focused at 2 m."""

    sizes: Sizes
    distance: float  # of the object: 2 m is case A, 0.5 m case B
    integrate: bool

    diameter = 5 * mm
    radius = 25 * mm
    pitch = 3 * um
    sensor_distance = 1 / (1 / (50 * mm) - 1 / FOCUS)

    def truth(self, *, radius: float = radius) -> Tensor:
        """(L, n, n) by quadrature: Hankel, on one octant; pixels by 6 x 6 Gauss-Legendre nodes (4e-7 from 5 x 5)."""
        half = self.sizes.window // 2
        x, y = np.meshgrid(np.arange(half + 1), np.arange(half + 1))
        octant = x >= y
        centres = np.stack([x[octant], y[octant]], axis=1) * self.pitch
        opd = oracles.fresnel_opd(
            index=1.5, radius_of_curvature=radius, distance=self.distance, sensor_distance=self.sensor_distance
        )
        bank = []
        for wavelength in self.sizes.wavelengths.tolist():
            intensity = oracles.radial_function(
                lambda r, wavelength=wavelength: oracles.fresnel_radial(
                    r,
                    aperture_radius=self.diameter / 2,
                    sensor_distance=self.sensor_distance,
                    wavelength=wavelength,
                    opd=opd,
                ),
                largest=1.5 * (half + 1) * self.pitch,
                spacing=wavelength * self.sensor_distance / (8 * self.diameter),
            )
            quadrant = np.zeros_like(x, dtype=np.float64)
            quadrant[octant] = (
                oracles.pixel_integrate(intensity, centres, pitch=self.pitch, order=6)
                if self.integrate
                else intensity(centres) * self.pitch**2
            )
            quadrant = np.maximum(quadrant, quadrant.T)
            right = np.concatenate([quadrant[:, :0:-1], quadrant], axis=1)
            bank.append(np.concatenate([right[:0:-1], right]))
        return torch.from_numpy(np.stack(bank))

    def truth_slopes(self, cotangent: Tensor) -> Tensor:
        """d(sum(psf * cotangent)) / dR of each wavelength, by central differences (step 1e-5 R: good to 1e-6)."""
        step = 1e-5 * self.radius
        high, low = self.truth(radius=self.radius + step), self.truth(radius=self.radius - step)
        return ((high - low) * cotangent).sum((-2, -1)) / (2 * step)

    def textbook(self, radius: Tensor, *, oversample: int, members: Tensor) -> Tensor:
        wavelengths = self.sizes.wavelengths[members]
        return textbook_psf_bank(
            torch.zeros(self.sizes.pupil, self.sizes.pupil, dtype=DOUBLE),
            wavelengths=wavelengths,
            distances=torch.tensor([self.distance], dtype=DOUBLE),
            aperture_diameter=self.diameter,
            radius_of_curvature=radius,
            lens_index=torch.full_like(wavelengths, 1.5),
            sensor_distance=self.sensor_distance,
            pixel_pitch=self.pitch,
            shape=self.sizes.shape,
            oversample=oversample,
        )[0]

    def lens(self, radius: Tensor | float) -> optics.Lens:
        return optics.Lens(
            optics.CircularAperture(diameter=self.diameter),
            optics.PlanoConvexLens(radius_of_curvature=radius, glass=1.5),
            sensor_distance=self.sensor_distance,
        )

    def ours(self, lens: optics.Lens, *, method: str, samples: int | None = None) -> Tensor:
        return lens.psf(
            self.sizes.wavelengths,
            distances=self.distance,
            pixel_pitch=self.pitch,
            shape=self.sizes.shape,
            propagator="fresnel",
            method=method,
            samples=samples,
            integrate=self.integrate,
        )[0]


def smooth_rows(sizes: Sizes, *, distance: float, integrate: bool, backward: bool) -> Rows:
    """The bank of a singlet, and with `backward` its gradient to the lens's radius of curvature.

    Integrated, the textbook averages 2 x 2 samples a pixel (its cheapest form; ratios of time refer to it), and forward
    also 3 x 3, where its error has reached its floor (ratios of errors refer to the better one). Forward and backward,
    and integrated, the textbook's loop is timed on every seventh wavelength (every fourteenth for both at once): less
    memory, so rather in its favour.
    """
    case = Singlet(sizes, distance, integrate)
    truth = case.truth()
    cotangent = truth / truth.amax((-2, -1), keepdim=True)  # a loss that concentrates the light
    slopes = case.truth_slopes(cotangent) if backward else None
    radius = nn.Parameter(torch.tensor(case.radius, dtype=DOUBLE))
    lens = case.lens(radius)
    usual = usual_method(lens, sizes, distances=distance, pixel_pitch=case.pitch, integrate=integrate)
    everything = torch.arange(sizes.bands)

    def textbook(oversample: int, members: Tensor, *, once: bool = False) -> Contestant:
        def bank() -> Tensor:
            return case.textbook(radius, oversample=oversample, members=members)

        return Contestant(
            "textbook" + (f", {oversample} x {oversample} a pixel" if integrate else ""),
            (lambda: with_gradient(radius, bank, cotangent[members])) if backward else (lambda: without_gradient(bank)),
            check=check(members),
            dtype="float64",
            share=members.numel() / sizes.bands,
            once=once,
        )

    def ours(method: str, samples: int | None = None) -> Contestant:
        def bank() -> Tensor:
            return case.ours(lens, method=method, samples=samples)

        return Contestant(
            f"kcam {method}" + (f", {samples} samples" if samples else ""),
            (lambda: with_gradient(radius, bank, cotangent)) if backward else (lambda: without_gradient(bank)),
            check=check(everything),
            default=samples is None and method == usual,
        )

    def check(members: Tensor) -> Callable[[Any], dict[str, float]]:
        def errors(result: Any) -> dict[str, float]:
            if not backward:
                return relative_l1(result, truth[members])
            return relative_l1(result[0], truth[members]) | gradient_error(result[1], slopes[members].sum()[None])

        return errors

    members = sizes.every(14) if integrate and backward else sizes.sample if integrate or backward else everything
    contestants = [textbook(2 if integrate else 1, members)]
    if integrate and not backward:
        contestants.append(textbook(3, sizes.sample, once=True))
    contestants += [ours("matrix"), ours("radial")]
    if not integrate and sizes.window == Sizes.window:
        contestants.append(ours("matrix", samples=256))  # the note's own, the same for all wavelengths
    return race(
        f"smooth pupil, {'focus' if distance == FOCUS else 'defocus'}, {'pixels' if integrate else 'points'}",
        size=f"{sizes.bands} x {sizes.window}^2",
        direction="forward + backward" if backward else "forward",
        contestants=contestants,
        seconds=sizes.seconds,
    )


def one_psf_rows(sizes: Sizes) -> Rows:
    """One PSF of the singlet, again by the same lens, and by a lens that was focused anew, as a training step does."""
    case = Singlet(replace(sizes, bands=1), 0.5, integrate=False)
    truth = case.truth()
    lens, steps = case.lens(case.radius), itertools.count()

    def focused_anew() -> Tensor:
        moved = case.lens(case.radius)
        moved.sensor_distance = case.sensor_distance + 1e-9 * next(steps)
        return case.ours(moved, method="radial")

    def check(result: Any) -> dict[str, float]:
        return relative_l1(result, truth)

    return race(
        "one PSF",
        size=f"{sizes.window}^2",
        direction="forward",
        contestants=[
            Contestant(
                "textbook",
                lambda: without_gradient(
                    lambda: case.textbook(torch.tensor(case.radius), oversample=1, members=torch.arange(1))
                ),
                check,
                dtype="float64",
            ),
            Contestant(
                "kcam radial", lambda: without_gradient(lambda: case.ours(lens, method="radial")), check, default=True
            ),
            Contestant("kcam radial, focused anew", lambda: without_gradient(focused_anew), check),
        ],
        seconds=sizes.seconds / 2,
    )


# ---- a trainable DOE -----------------------------------------------------------------------------------------------


class DiffractiveCamera:
    """A BK7 singlet (R = 25.8 mm, 5 mm aperture, focused at 2 m) with a smooth random DOE of 20 waves, 4 um pixels."""

    diameter = 5 * mm
    radius = 25.8 * mm
    pitch = 4 * um

    def __init__(self, sizes: Sizes) -> None:
        self.sizes = sizes
        self.map = random_phase(sizes.pupil, waves=20.0)
        self.phase = nn.Parameter(self.map.clone())  # the textbook's
        self.doe = optics.DOE(nn.Parameter(self.map.float()))
        self.lens = self.build(self.doe)
        generator = torch.Generator().manual_seed(1)
        # white noise: every frequency of the gradient counts
        self.cotangent = torch.randn(sizes.bands, *sizes.shape, generator=generator)

    def build(self, doe: optics.DOE) -> optics.Lens:
        glass = optics.PlanoConvexLens(radius_of_curvature=self.radius, glass="N-BK7")
        aperture = optics.CircularAperture(diameter=self.diameter)
        return optics.Lens(aperture, glass, doe, focus_distance=FOCUS)

    def truth(self, *, integrate: bool, members: Tensor) -> tuple[Tensor, Tensor]:
        """Bank (L', n, n) and gradient in float64 on a pupil grid of twice the DOE's own (5e-5 from a finer one)."""
        doe = optics.DOE(nn.Parameter(self.map.clone()))
        lens = self.build(doe)
        return with_gradient(
            doe.phase,
            lambda: self.ours(
                lens,
                distances=[FOCUS],
                integrate=integrate,
                members=members,
                propagator="fresnel",
                method="matrix",
                samples=2 * self.sizes.pupil + 12,
                dtype=DOUBLE,
            )[0],
            self.cotangent[members],
        )

    def textbook(self, *, distances: list[float], oversample: int, members: Tensor) -> Tensor:
        wavelengths = self.sizes.wavelengths[members]
        design = 550 * nm
        index, design_index = (
            optics.refractive_index("fused silica", wavelengths=w)
            for w in (wavelengths, torch.tensor([design], dtype=DOUBLE))
        )
        return textbook_psf_bank(
            self.phase,
            wavelengths=wavelengths,
            distances=torch.tensor(distances, dtype=DOUBLE),
            aperture_diameter=self.diameter,
            radius_of_curvature=self.radius,
            lens_index=optics.refractive_index("N-BK7", wavelengths=wavelengths),
            sensor_distance=self.lens.sensor_distance,
            pixel_pitch=self.pitch,
            shape=self.sizes.shape,
            doe_factor=doe_scale(wavelengths, index, design_wavelength=design, design_index=float(design_index)),
            oversample=oversample,
        )

    def ours(self, lens: optics.Lens, *, distances: list[float], members: Tensor, **options: Any) -> Tensor:
        return lens.psf(
            self.sizes.wavelengths[members],
            distances=torch.tensor(distances, dtype=DOUBLE),
            pixel_pitch=self.pitch,
            shape=self.sizes.shape,
            **options,
        )


def doe_rows(
    camera: DiffractiveCamera, *, distances: list[float], integrate: bool, truth: tuple[Tensor, Tensor]
) -> Rows:
    """The bank of a camera with a DOE, forward, and forward with its gradient to every pixel of the DOE.

    The `nonparaxial` row is kcam's default physics, which the textbook does not compute: time alone, and no verdict.
    """
    sizes = camera.sizes
    everything, sample = torch.arange(sizes.bands), sizes.sample
    focus = distances.index(FOCUS)
    oversample = 2 if integrate else 1

    def usual(propagator: str) -> str:
        where = {"distances": torch.tensor(distances), "pixel_pitch": camera.pitch, "integrate": integrate}
        return usual_method(camera.lens, sizes, propagator=propagator, **where)

    def contestant(who: str, bank: Callable[[Tensor], Tensor], members: Tensor, parameter: Tensor, **rest: Any):
        timed = {
            "forward": lambda: without_gradient(lambda: bank(members)),
            "forward + backward": lambda: with_gradient(parameter, lambda: bank(members), camera.cotangent[members]),
        }

        def check(result: Any) -> dict[str, float]:
            if "nonparaxial" in who:
                return {}
            psfs = result if isinstance(result, Tensor) else result[0]
            own = psfs[focus] if members is sample else psfs[focus][sample]
            error = relative_l1(own, truth[0])
            if backward and len(distances) == 1:
                gradient = result[1]
                if members is not sample:  # of the sampled wavelengths alone, as the truth has it
                    _, gradient = with_gradient(parameter, lambda: bank(sample), camera.cotangent[sample])
                error |= gradient_error(gradient, truth[1])
            return error

        return Contestant(who, timed[direction], check, share=members.numel() / sizes.bands, **rest)

    def ours(propagator: str, method: str) -> Contestant:
        options = {"propagator": propagator, "method": method, "integrate": integrate}

        def bank(members: Tensor) -> Tensor:
            return camera.ours(camera.lens, distances=distances, members=members, **options)

        who, default = f"kcam {propagator} {method}", method == usual(propagator)
        return contestant(who, bank, everything, camera.doe.phase, default=default)

    rows = []
    for direction in ("forward", "forward + backward"):
        backward = direction != "forward"
        contestants = [
            contestant(
                "textbook" + (f", {oversample} x {oversample} a pixel" if integrate else ""),
                lambda members: camera.textbook(distances=distances, oversample=oversample, members=members),
                everything if (direction, integrate, len(distances)) == ("forward", False, 1) else sample,
                camera.phase,
                dtype="float64",
            ),
            ours("fresnel", "matrix"),
            ours("fresnel", "chirp_z"),
        ]
        if len(distances) == 1:
            contestants.append(ours("nonparaxial", "matrix"))
        rows += race(
            f"DOE, {len(distances)} distance{'s' * (len(distances) > 1)}, {'pixels' if integrate else 'points'}",
            size=f"{len(distances)} x {sizes.bands} x {sizes.window}^2, DOE {sizes.pupil}^2",
            direction=direction,
            contestants=contestants,
            seconds=sizes.seconds,
        )
    return rows


def random_phase(pixels: int, *, waves: float) -> Tensor:
    """A smooth random phase: cosines up to 1.25 periods, `waves` from its lowest to its highest point in the circle."""
    generator = torch.Generator().manual_seed(0)
    axis = torch.linspace(-1, 1, pixels, dtype=DOUBLE)
    order = torch.arange(6, dtype=DOUBLE)
    weights = torch.randn(6, 6, generator=generator, dtype=DOUBLE) / (1 + order[:, None] ** 2 + order**2)
    basis = torch.cos(math.pi / 2 * order[:, None] * (axis + 1))
    phase = basis.T @ weights @ basis
    inside = phase[axis[:, None] ** 2 + axis**2 <= 1]
    return (phase - inside.mean()) * (2 * math.pi * waves / float(inside.max() - inside.min()))


# ---- rendering -----------------------------------------------------------------------------------------------------


CALLS = {"second call": (False, True), "first call": (False, False), "all kept": (True, True)}
"""Whether the transfer functions are at hand: the textbook's, and kcam's."""


class Renderers:
    """One bank of PSFs, one filter, and the two ways to render a scene through them."""

    def __init__(self, sizes: Sizes, scene: Scene) -> None:
        lens = optics.Lens(
            optics.CircularAperture(diameter=5 * mm),
            optics.PlanoConvexLens(radius_of_curvature=25.8 * mm, glass="N-BK7"),
            focus_distance=FOCUS,
        )
        self.scene = scene
        self.filter = sensor.ColourFilter.kodak()
        self.imaging = optics.Imaging(lens, pixel_pitch=4 * um, psf_shape=sizes.shape)
        psfs = lens.psf(sizes.wavelengths, distances=scene.depth, pixel_pitch=4 * um, shape=sizes.shape)[0]
        self.psfs = psfs.flip(-2, -1)  # the picture is upright
        self.weights = self.filter.contraction(sizes.wavelengths).to(psfs)
        self.transfers = transfer_functions(self.psfs, picture=tuple(scene.shape[-2:]))

    def ours(self, scene: Scene, *, kept: bool) -> Tensor:
        """The picture. PSFs stay in Imaging's own cache; without `kept` what it has made of them is dropped first."""
        if not kept:
            self.imaging._transfer_cache = type(self.imaging._transfer_cache)()
        return self.imaging(scene, colour_filter=self.filter)

    def textbook(self, bands: Tensor, *, kept: bool) -> Tensor:
        return per_band_render(bands, self.psfs, self.weights, transfers=self.transfers if kept else None)

    def truth(self, cotangent: Tensor) -> tuple[Tensor, Tensor]:
        """The picture and the gradient to the scene's coefficients, per band in float64."""
        scene = self.scene.to(device="cpu", dtype=DOUBLE)
        coefficients = scene.coefficients.requires_grad_()
        picture = per_band_render(scene.bands(), self.psfs.to(DOUBLE), self.weights.to(DOUBLE))
        (picture * cotangent).sum().backward()
        return picture.detach(), coefficients.grad


def relative_max(result: Tensor, truth: Tensor) -> float:
    """Largest difference relative to the largest value."""
    return float((result.detach().to(DOUBLE) - truth).abs().max() / truth.abs().max())


def render_rows(sizes: Sizes, scene: Scene, *, kind: str) -> Rows:
    """A picture of three channels, forward, and forward with the gradient to the scene's own coefficients.

    `second call`: as users write both, the textbook transforms its PSFs in each call and kcam has kept its own.
    `first call`: the PSFs' transforms are computed in each call, on both sides. `all kept`: at hand on both sides.
    Forward the textbook is handed its bands; backward both start from the coefficients, which both have to reach.
    """
    renderers = Renderers(sizes, scene)
    bands = scene.bands()
    generator = torch.Generator().manual_seed(2)
    cotangent = torch.rand(1, 3, *scene.shape[-2:], generator=generator)
    picture, gradient = renderers.truth(cotangent.to(DOUBLE))
    rows: Rows = []

    def backward(render: Callable[[Scene], Tensor]) -> tuple[Tensor, Tensor]:
        coefficients = scene.coefficients.detach().requires_grad_()
        return with_gradient(coefficients, lambda: render(replace(scene, coefficients=coefficients)), cotangent)

    for direction in ("forward", "forward + backward"):
        for mode, (theirs, own) in CALLS.items():
            if direction == "forward":
                calls = [lambda kept=theirs: renderers.textbook(bands, kept=kept)]
                calls += [lambda kept=own: renderers.ours(scene, kept=kept)]
            else:
                calls = [lambda kept=theirs: backward(lambda s: renderers.textbook(s.bands(), kept=kept))]
                calls += [lambda kept=own: backward(lambda s: renderers.ours(s, kept=kept))]

            def check(result: Any) -> dict[str, float]:
                if isinstance(result, Tensor):
                    return {"relative_max": relative_max(result, picture)}
                return {"relative_max": relative_max(result[0], picture)} | gradient_error(result[1], gradient)

            floor = [
                Contestant("bare FFTs", lambda kept=own: bare_transforms(bands, sizes.window, kept=kept), no_error)
            ]
            rows += race(
                f"render {kind}, {mode}",
                size=f"{sizes.bands} x {scene.shape[-1]}^2, PSF {sizes.window}^2",
                direction=direction,
                contestants=[
                    Contestant("textbook per band", calls[0], check),
                    Contestant("kcam Imaging", calls[1], check, default=True),
                    *floor[: direction == "forward" and kind == "cube"],
                ],
                seconds=sizes.seconds / 2,
            )
    return rows


def bare_transforms(bands: Tensor, window: int, *, kept: bool) -> list[Tensor]:
    """A transform of each band of (1, L, H, W) and back of three channels, plane by plane, at the least good length;
    unless it is kept, one of each PSF too.
    """
    size = [next_fast_len(n + window - 1, real=True) for n in bands.shape[-2:]]
    psfs = [] if kept else [band[:window, :window] for band in bands[0]]
    spectra = [torch.fft.rfft2(plane, s=size) for plane in (*bands[0], *psfs)]
    return [torch.fft.irfft2(spectrum, s=size) for spectrum in spectra[:3]]


def no_error(result: Any) -> dict[str, float]:
    """It is no picture."""
    return {}


def random_scene(sizes: Sizes, *, picture: int) -> Scene:
    """A cube of full rank."""
    generator = torch.Generator().manual_seed(3)
    bands = torch.rand(1, sizes.bands, picture, picture, generator=generator)
    return Scene.from_bands(bands, wavelengths=sizes.wavelengths, depth=1.0)


def rgb_scene(sizes: Sizes, *, picture: int) -> Scene:
    """An sRGB picture, upsampled: three planes times three spectra."""
    image = torch.rand(3, picture, picture, generator=torch.Generator().manual_seed(4))
    return Scene.from_rgb(image, depth=1.0, wavelengths=sizes.wavelengths)


# ---- the whole -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Target:
    """What issue 3 asks of the races whose op starts with `op`: so many times faster, at so many times lower error."""

    what: str
    op: str
    faster: float
    lower_error: float = 0.0
    same_to: float = math.inf
    direction: str = ""
    who: str = ""
    than: str = ""

    def judge(self, rows: Rows) -> list[dict[str, Any]]:
        """A verdict for each op and direction, on the method that kcam takes unless told, or on `who`: how much faster
        it is than the baseline, or than another contestant.
        """
        verdicts = []
        for row in rows:
            chosen = row["who"] == self.who if self.who else row["default"] and bool(row["error"])
            if not (row["op"].startswith(self.op) and chosen and self.direction in ("", row["direction"])):
                continue
            if self.than:
                race_of = [other for other in rows if all(other[key] == row[key] for key in ("op", "direction"))]
                other = next((other for other in race_of if other["who"] == self.than), None)
                if other is None:
                    continue
                row = row | {"ratio": other["seconds"] / row["seconds"], "error_ratio": None}
            met = row["ratio"] >= self.faster and (row["error_ratio"] or math.inf) >= self.lower_error
            met = met and all(row["error"].get(kind, 0) <= self.same_to for kind in ("relative_max", "gradient"))
            verdict = {"target": self.what, "met": met}
            verdicts.append(verdict | {key: row[key] for key in ("op", "direction", "who", "ratio", "error_ratio")})
        return verdicts


TARGETS = (
    Target("smooth pupil: >= 30 times faster at >= 50 times lower error", "smooth", 30, lower_error=50),
    Target("trainable DOE: >= 8 times faster", "DOE", 8),
    Target("DOE, 1 distance, points: >= 10 times faster", "DOE, 1 distance, points", 10, direction="forward"),
    Target(
        "DOE, 1 distance, points, with gradient: >= 12 times faster", "DOE, 1 distance, points", 12,
        direction="forward + backward",
    ),
    Target(
        "nonparaxial with a DOE: <= 1.3 times as long as fresnel", "DOE", 1 / 1.3, who="kcam nonparaxial matrix",
        than="kcam fresnel matrix",
    ),
    Target("full-rank cube: <= 1.3 times as long as its bare FFTs", "render cube", 1 / 1.3, than="bare FFTs"),
    Target("full-rank cube: >= 2 times faster, same to 1e-5", "render cube", 2, same_to=1e-5),
    Target("RGB scene: >= 5 times faster, same to 1e-5", "render RGB", 5, same_to=1e-5),
)


def measure(sizes: Sizes, console: Console) -> Rows:
    """All races, in the order of the issue."""
    rows: Rows = []
    with console.status("") as status:
        for distance, integrate, backward in (
            (FOCUS, False, False),
            (0.5, False, False),
            (0.5, False, True),
            (0.5, True, False),
            (0.5, True, True),
        ):
            status.update(f"smooth pupil, object at {distance} m, {'pixels' if integrate else 'points'} ...")
            rows += smooth_rows(sizes, distance=distance, integrate=integrate, backward=backward)
        status.update("DOE: the truth ...")
        camera = DiffractiveCamera(sizes)
        for integrate in (False, True):
            truth = camera.truth(integrate=integrate, members=sizes.sample)
            for distances in ([FOCUS], [1.0, FOCUS, math.inf]):
                if integrate and len(distances) > 1:
                    continue
                status.update(f"DOE, {len(distances)} distances, {'pixels' if integrate else 'points'} ...")
                rows += doe_rows(camera, distances=distances, integrate=integrate, truth=truth)
        status.update("one PSF ...")
        rows += one_psf_rows(sizes)
        status.update("rendering a cube ...")
        rows += render_rows(sizes, random_scene(sizes, picture=sizes.picture), kind="cube")
        status.update("rendering an RGB scene ...")
        rows += render_rows(sizes, rgb_scene(sizes, picture=sizes.picture), kind="RGB")
    return rows


def print_verdicts(console: Console, verdicts: Rows) -> None:
    """Each target with its verdicts."""
    for what in dict.fromkeys(verdict["target"] for verdict in verdicts):
        console.print(f"[bold]{what}[/]")
        for verdict in verdicts:
            if verdict["target"] == what:
                met = "[green]met   [/]" if verdict["met"] else "[red]missed[/]"
                lower = f", error {verdict['error_ratio']:.3g} times lower" if verdict["error_ratio"] else ""
                race_of = f"{verdict['op']}, {verdict['direction']}"
                console.print(f"  {met} {verdict['ratio']:.3g} times faster{lower}: {race_of} ({verdict['who']})")


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench", description="kcam against the textbook")
    parser.add_argument("--quick", action="store_true", help="toy sizes; nothing is judged, nothing written")
    where = f"where to write JSON (default: {RESULTS.relative_to(ROOT)}; quick: nowhere)"
    parser.add_argument("--out", type=Path, help=where)
    options = parser.parse_args(arguments)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        console = Console()
        console.width = max(console.width, 130)
        rows = measure(QUICK if options.quick else Sizes(), console)
        verdicts = [] if options.quick else [verdict for target in TARGETS for verdict in target.judge(rows)]
        commands = [] if options.quick else [whole.imports(), whole.megapixels(), whole.shoot()]
        content = {"environment": environment(), "targets": verdicts, "rows": rows, "commands": commands}
    finally:
        torch.set_num_threads(threads)
    print_table(console, rows)
    print_verdicts(console, verdicts)
    out = options.out or (None if options.quick else RESULTS)
    if out is not None:
        write_json(out, content)
        console.print(f"written to {out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
