"""What accuracy costs in time: every knob of a camera turned by itself, its error beside its time.

Each setting differs from the camera in one thing. The errors are against the non-paraxial physics in float64: of the
PSFs against the `reference` propagator, of the raw and of the picture against the same camera, finely sampled.
"""

from __future__ import annotations

import functools
import math
import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.table import Table
from skimage.color import deltaE_ciede2000, rgb2lab
from torch import Tensor
from torch.nn import functional as F

from kcam import isp, measure, sensor, threads
from kcam.camera import Camera
from kcam.optics import PROPAGATORS, Imaging
from kcam.optics.accuracy import Recipe
from kcam.optics.propagation.grid import samples_by_rule
from kcam.optics.propagation.question import Query
from kcam.optics.propagation.reference import Convergence, checked_psf
from kcam.optics.propagation.row import Propagator
from kcam.optics.propagation.table import PHYSICS, choose
from kcam.optics.propagation.textbook import textbook_angular_spectrum_row, textbook_row
from kcam.optics.source import Points
from kcam.plain import from_json
from kcam.planner.plan import ENDS, with_imaging
from kcam.scene import Scene

WINDOW, THOROUGH_WINDOW = 33, 65  # pixels in which PSFs are compared: the reference takes 4 to 24 s for six of 65 x 65
MARGIN = 8  # pixels that the reference is computed beyond them: light cut off there is missing in the pixels' filter
SECONDS, THOROUGH_SECONDS = 160.0, 900.0  # the sweep's time in all, as far as it can choose
LONGEST, THOROUGH_LONGEST = 4.0, 120.0  # seconds of a picture above which its time is told from a few of its PSFs
ONCE = 2.5  # seconds of a picture above which one more call must do
REFERENCE_KAPPA = 4.5  # of the reference picture's pupil sampling: a thousandth of the default's error
KAPPAS, THOROUGH_KAPPAS = (1.3, 1.6, 2.0, 2.7, 3.5, 5.0), (1.15, 1.3, 1.6, 2.0, 2.35, 2.7, 3.5, 4.2, 5.0)


@dataclass(frozen=True)
class Setting:
    """A camera and a scene in which one knob is turned.

    optics: whether the knob changes the PSFs. default: the camera as it was given. baseline: not kcam's own way.
    """

    knob: str
    name: str
    camera: Camera
    scene: Scene
    optics: bool = False
    default: bool = False
    baseline: bool = False


@dataclass(frozen=True)
class Row:
    """What a setting was measured to cost. None stands for what it does not change, or could not be measured.

    psf_l1, psf_l1_worst: median and worst over wavelengths and distances, relative to the light.
    raw_rms: relative RMS error of the noiseless raw, before rounding. delta_e: mean CIEDE2000 of the picture.
    seconds: of a picture with new optics, nothing kept from one before; seconds_iqr: quartiles over the `calls`.
    seconds_kept: of one more picture with the same optics. share: of the PSFs that the time was measured on, if not 1.
    peak_memory: beyond what was in use before [bytes]. refused: why there is no result.
    """

    knob: str
    name: str
    psf_l1: float | None = None
    psf_l1_worst: float | None = None
    raw_rms: float | None = None
    delta_e: float | None = None
    seconds: float | None = None
    seconds_iqr: tuple[float, float] | None = None
    seconds_kept: float | None = None
    share: float = 1.0
    calls: int = 0
    peak_memory: int | None = None
    default: bool = False
    baseline: bool = False
    pareto: bool = False
    refused: str | None = None


@dataclass(frozen=True)
class Sweep:
    """The rows, what they were measured against, and on what machine.

    reference: what was compared, and how far the reference is from itself at twice its sampling and from a closed form.
    """

    title: str
    scene: str
    rows: tuple[Row, ...]
    reference: dict[str, Any] = field(default_factory=dict)
    environment: dict[str, Any] = field(default_factory=dict)

    @property
    def default(self) -> Row:
        """The camera as it was given."""
        return next(row for row in self.rows if row.default)

    def pareto(self, error: str = "raw_rms") -> list[Row]:
        """The rows that no other beats in both time and error, from the fastest to the most accurate."""
        return front(self.rows, error)

    def sentence(self) -> str:
        """What the next factor of ten in accuracy costs here, and what the last one did."""
        here = self.default
        if here.raw_rms is None or here.seconds is None:
            return f"The camera as it is was not measured: {here.refused}"
        start = f"{_accuracy(here.raw_rms)} in {_time(here.seconds)}"
        closer = [row for row in self.pareto() if _error(row.raw_rms) <= here.raw_rms / 10]
        if closer:
            row = closer[0]
            text = (
                f"On this machine the next factor of ten in accuracy costs {_ratio(row, here)} times the time: "
                f"{row.name} has {_accuracy(row.raw_rms)} in {_time(row.seconds)}, the camera as it is {start}."
            )
        else:
            text = f"On this machine no setting is ten times as accurate as the camera as it is, {start}."
        coarser = [row for row in self.pareto() if _error(row.raw_rms) >= 10 * here.raw_rms]
        if coarser:
            row = coarser[-1]
            text += (
                f" Giving accuracy up, {row.name} takes {_ratio(row, here)} times the time for "
                f"{_accuracy(row.raw_rms)}."
            )
        return text + self._model()

    def _model(self) -> str:
        """On which model the knobs were turned, where that is not the camera's own."""
        own = self.default.name.split()[0]
        if own == "nonparaxial" or own not in PHYSICS:
            return ""
        return f" The camera's own model is {own}; all knobs but the propagator are turned on the non-paraxial one."

    def table(self) -> Table:
        """The rows for a terminal, knob by knob; * marks those on the front of raw error and time."""
        table = Table(title=f"[bold]{self.title}[/]  [dim]{self.scene}[/]", title_justify="left", box=None)
        table.add_column("", min_width=1, no_wrap=True)
        for name in ("knob", "setting"):
            table.add_column(name, no_wrap=True)
        for name in ("PSF L1", "worst", "raw RMS", "delta E", "time", "quartiles, ms", "MB"):
            table.add_column(name, justify="right", no_wrap=True)
        before = ""
        for row in self.rows:
            style = "bold" if row.pareto else "dim" if row.baseline else ""
            head = ["*" if row.pareto else "", "" if row.knob == before else row.knob, row.name]
            before = row.knob
            if row.refused is not None:
                table.add_row(*head, "refused", style="dim")
                continue
            quartiles = "" if row.seconds_iqr is None else "-".join(f"{end * 1e3:.0f}" for end in row.seconds_iqr)
            table.add_row(
                *head,
                *(_small(value) for value in (row.psf_l1, row.psf_l1_worst, row.raw_rms)),
                _number(row.delta_e, "{:.3f}"),
                ("~" if row.share < 1 else "") + _time(row.seconds),
                quartiles,
                _number(row.peak_memory, "{:.0f}", 1e-6),
                style=style,
            )
        table.caption = (
            "Empty: the knob does not change it, or it was not measured. ~: told from a few of the PSFs. Demosaics are "
            "held to the same camera with three full planes, so their delta E stands by itself."
        )
        table.caption += self._model() + "".join(
            f"\n{row.name} refused: {row.refused}" for row in self.rows if row.refused
        )
        table.caption_justify = "left"
        return table

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "title": self.title,
            "scene": self.scene,
            "reference": self.reference,
            "environment": self.environment,
            "rows": [asdict(row) for row in self.rows],
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the sweep as JSON, with four digits."""
        measure.write_json(Path(path), self.to_json())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Sweep:
        """Read what `save` wrote. Raises: FileNotFoundError; ValueError for another file."""
        wrong = f"{path} is not a sweep that kcam tradeoff wrote"
        found: Sweep = from_json(Path(path).read_bytes(), cls, wrong=wrong)
        if not any(row.default for row in found.rows):
            raise ValueError(f"{wrong}: no row of it is the camera as it was given.")
        return found


def front(rows: Sequence[Row], error: str) -> list[Row]:
    """The rows that no other beats in both time and error, from the fastest to the most accurate."""
    measured = [row for row in rows if getattr(row, error) is not None and row.seconds is not None]
    best, result = math.inf, []
    for row in sorted(measured, key=lambda row: (row.seconds, getattr(row, error))):
        if getattr(row, error) < best:
            best = getattr(row, error)
            result.append(row)
    return result


# ---- the knobs: a function and a row of KNOBS each -------------------------------------------------------------------

Knob = Callable[[Camera, Scene, bool], Iterator[Setting]]


def settings(
    camera: Camera, scene: Scene, *, thorough: bool = False, knobs: Sequence[str] | None = None
) -> list[Setting]:
    """The camera as it is, and every setting of every knob, each turned by itself.

    A camera with another propagator than nonparaxial is as it is in its first row only: the knobs are turned on the
    non-paraxial one, because beside a model's error no other would show.

    Raises:    ValueError for a camera without optics, or an unknown knob.
    """
    unknown = set(knobs or ()) - set(KNOBS)
    if unknown:
        raise ValueError(f"unknown knob {', '.join(sorted(unknown))}; there are: {', '.join(KNOBS)}.")
    imaging = _imaging(camera)
    query = _query(imaging, scene)
    row = choose(query, propagator=imaging.accuracy.propagator, method=imaging.accuracy.method)
    result = [Setting("default", _called(row), camera, scene, optics=True, default=True)]
    if imaging.accuracy.propagator != "nonparaxial":
        camera = with_imaging(camera, propagator="nonparaxial", method=None)
    for name, knob in KNOBS.items():
        if knobs is None or name in knobs:
            result += knob(camera, scene, thorough)
    return [s for s in result if s.default or (s.knob, s.name) != ("propagator", _called(row))]


def _propagators(camera: Camera, scene: Scene, thorough: bool) -> Iterator[Setting]:
    for row in PROPAGATORS.values():
        changed = with_imaging(camera, propagator=row.physics, method=row.method)
        yield Setting("propagator", _called(row), changed, scene, optics=True)


def _samples(camera: Camera, scene: Scene, thorough: bool) -> Iterator[Setting]:
    for count in _sample_counts(_imaging(camera), scene, THOROUGH_KAPPAS if thorough else KAPPAS):
        changed = with_imaging(camera, samples=count, method="matrix")  # the radial transform has no pupil grid
        yield Setting("samples", f"{count} samples", changed, scene, optics=True)


def _precision(camera: Camera, scene: Scene, thorough: bool) -> Iterator[Setting]:
    other = torch.float32 if scene.dtype == torch.float64 else torch.float64
    yield Setting("precision", str(other).removeprefix("torch."), camera, scene.to(dtype=other), optics=True)


def _wavelengths(camera: Camera, scene: Scene, thorough: bool) -> Iterator[Setting]:
    for count in (1, 3, 5, 7, 10, 14, 20) if thorough else (3, 7, 14):
        if count < len(scene.wavelengths):
            yield Setting("wavelengths", f"{count} wavelengths", with_imaging(camera, bands=count), scene, optics=True)


def _layers(camera: Camera, scene: Scene, thorough: bool) -> Iterator[Setting]:
    rule = len(_imaging(camera).depth_layers(torch.as_tensor(scene.depth), scene.wavelengths))
    for count in (1, 2, 3, 5, 9, 2 * rule) if thorough else (1, 3, 9):
        if rule > 1 and count not in (1, rule):
            yield Setting("depth", f"{count} layers", with_imaging(camera, layers=count), scene)
    for count in (1, 3, 9, rule):
        if rule > 1 and count <= rule:
            name = "1 layer" if count == 1 else f"{count} layers, nearest"
            yield Setting("depth", name, with_imaging(camera, layers=count, interpolate=False), scene)


def _support(camera: Camera, scene: Scene, thorough: bool) -> Iterator[Setting]:
    window = _query(_imaging(camera), scene).shape
    for side in (5, 9, 17, 33, 65, 129, 257) if thorough else (9, 17, 33, 65, 129):
        if side < max(window):
            shape = (min(side, window[0]), min(side, window[1]))
            yield Setting("support", f"{side} px", with_imaging(camera, psf_shape=shape), scene, optics=True)


def _integration(camera: Camera, scene: Scene, thorough: bool) -> Iterator[Setting]:
    yield Setting("pixels", "point samples", with_imaging(camera, integrate=False), scene, optics=True)


def _rank(camera: Camera, scene: Scene, thorough: bool) -> Iterator[Setting]:
    own = scene.coefficients.shape[1]
    if scene.spectra is None:
        yield Setting("rank", f"rank {own}", camera, scene.low_rank(own))
    else:
        bands = scene.bands().clamp(min=0)  # a factored scene may dip below zero by the error of its factors
        yield Setting("rank", "as bands", camera, replace(scene, coefficients=bands, spectra=None))
    for rank in (1, 2, 3, 6) if thorough else (1, 2):
        if rank < own:
            yield Setting("rank", f"rank {rank}", camera, scene.low_rank(rank))


def _demosaics(camera: Camera, scene: Scene, thorough: bool) -> Iterator[Setting]:
    found = [stage for stage in camera if isinstance(stage, isp.Demosaic)]
    if not found or not any(isinstance(stage, sensor.Mosaic) for stage in camera):
        return
    own: Any = found[0]
    pattern = own.pattern or camera.resolve().pattern
    for name, row in isp.DEMOSAICS.items():
        if pattern in row.patterns:
            stage = isp.Demosaic(name, domain=own.domain, pattern=own.pattern, gains=own.gains)
            stages = [stage if old is own else old for old in camera]
            yield Setting("demosaic", name, Camera(*stages, context=camera.context), scene)


def _baselines(camera: Camera, scene: Scene, thorough: bool) -> Iterator[Setting]:
    for samples, points in ((256, 1), (891, 1), (891, 3)) + (((512, 1), (1783, 1)) if thorough else ()):
        name = f"textbook {samples}" + ("" if points == 1 else f", {points}x{points} a pixel")
        changed = with_imaging(camera, propagator=textbook_row(samples, points=points), method=None)
        yield Setting("baseline", name, changed, scene, optics=True, baseline=True)
    for points in (1, 2, 3) if thorough else (1, 2):
        name = "plain ASM" if points == 1 else f"plain ASM, {points}x{points} a pixel"
        changed = with_imaging(camera, propagator=textbook_angular_spectrum_row(points=points), method=None)
        yield Setting("baseline", name, changed, scene, optics=True, baseline=True)


KNOBS: dict[str, Knob] = {
    "propagator": _propagators,
    "samples": _samples,
    "precision": _precision,
    "wavelengths": _wavelengths,
    "depth": _layers,
    "support": _support,
    "pixels": _integration,
    "rank": _rank,
    "demosaic": _demosaics,
    "baseline": _baselines,
}
"""Knob -> a function that gives its settings. To add one, write a function and a row."""


def _imaging(camera: Camera) -> Imaging:
    for stage in camera:
        if isinstance(stage, Imaging):
            return stage
    raise ValueError("this camera has no optics.Imaging, so no knob trades its accuracy. Try Camera.phone().")


def _called(row: Propagator) -> str:
    return f"{row.physics} {row.method}"


def _query(imaging: Imaging, scene: Scene) -> Query:
    """What a bank of PSFs of this scene asks for: at its nearest and its farthest point."""
    vergences = _vergences(scene)
    window = imaging.psf_window(scene.wavelengths, vergences=vergences, picture=scene.shape[1:])
    lens, pixels = imaging.computed_lens(by="kcam tradeoff"), imaging.pixels(window, scene.coefficients)
    return lens.question(Points(vergences), scene.wavelengths, pixels, Recipe(samples=imaging.accuracy.samples))


def _vergences(scene: Scene) -> Tensor:
    depth = torch.as_tensor(scene.depth, dtype=torch.float64)
    return torch.unique(1 / torch.stack([depth.max(), depth.min()]))


def _sample_counts(imaging: Imaging, scene: Scene, kappas: Sequence[float]) -> list[int]:
    """Pupil samples that each kappa gives at the shortest wavelength, ascending."""
    query = _query(imaging, scene)
    shortest = int(query.wavelengths.argmin())
    return sorted({samples_by_rule(query.sampled(kappa=kappa, samples=None), shortest) for kappa in kappas})


# ---- the measurement -------------------------------------------------------------------------------------------------


def sweep(
    camera: Camera,
    scene: Scene,
    *,
    thorough: bool = False,
    knobs: Sequence[str] | None = None,
    seconds: float | None = None,
    advance: Callable[[str], None] | None = None,
    title: str = "What accuracy costs",
) -> Sweep:
    """Turn every knob of a camera and measure error, time and memory, on one thread of the CPU.

    Args:      thorough: more settings, a larger window for the PSFs, and 15 minutes rather than 3.
               knobs: of `KNOBS`; None for all.
               seconds: to spend on timing in rounds after everything was computed once; None: what `thorough` says.
               advance: told what is being done.
               title: of the table and the figure.
    Raises:    ValueError for a camera without optics, a scene that is not on the CPU, or optics for which the reference
               is not converged.
    """
    if scene.device.type != "cpu":
        raise ValueError(f"the sweep measures the CPU, but the scene is on {scene.device}. Use scene.to('cpu').")
    started = time.monotonic()
    advance = advance or (lambda what: None)
    every = settings(camera, scene, thorough=thorough, knobs=knobs)
    with torch.no_grad(), threads.fixed(1):
        advance("reference")
        truth = _Truth.of(camera, scene, window=THOROUGH_WINDOW if thorough else WINDOW)
        rows = []
        for index, setting in enumerate(every):
            advance(f"{index + 1} of {len(every)}, {setting.name}")
            rows.append(_measured(setting, truth, longest=THOROUGH_LONGEST if thorough else LONGEST))
        budget = (THOROUGH_SECONDS if thorough else SECONDS) if seconds is None else seconds
        deadline = time.monotonic() + seconds if seconds is not None else started + budget
        rows = _timed(every, rows, deadline=deadline, advance=advance)
        environment = measure.environment() | {"clock": "CPU seconds of one thread"}
    best = {id(row) for row in front(rows, "raw_rms")}
    rows = [replace(row, pareto=id(row) in best) for row in rows]
    return Sweep(title, _described(scene), tuple(rows), truth.facts(), environment)


@dataclass(frozen=True)
class _Truth:
    """What everything is compared with."""

    query: Query  # at three wavelengths
    bands: Tensor  # which of the scene's they are
    psfs: Tensor  # in the small window
    beyond: Tensor  # the light that the picture's window holds outside it
    seconds: float  # that the query took
    convergence: Convergence
    raw: Tensor
    picture: Tensor
    full_picture: Tensor | None  # of the camera without a mosaic

    @classmethod
    def of(cls, camera: Camera, scene: Scene, *, window: int) -> _Truth:
        imaging = _imaging(camera)
        order = scene.wavelengths.argsort()
        bands = torch.unique(torch.stack([order[0], order[len(order) // 2], order[-1]]))
        whole = _query(imaging, scene)
        window = (min(window, *whole.shape) - 1) // 2 * 2 + 1  # odd, and no larger than what the picture uses
        shape = (window + 2 * MARGIN, window + 2 * MARGIN)
        query = replace(whole, wavelengths=scene.wavelengths[bands]).sampled(samples=None)
        query = query.on(shape=shape, dtype=torch.float64, integrate=True)
        start = time.process_time()
        psfs, measured = checked_psf(query)
        seconds = time.process_time() - start
        count = _sample_counts(imaging, scene, [REFERENCE_KAPPA])[0]
        # the Hankel form has no pupil grid, and no error of one
        finely = {} if imaging.computed_lens(by="kcam tradeoff").symmetric else {"samples": count}
        fine = with_imaging(camera, propagator="nonparaxial", method=None, **finely)
        double = scene.to(dtype=torch.float64)
        bank = _imaging(fine).psf_bank(query.wavelengths, vergences=query.vergences, shape=whole.shape, like=psfs)
        raw, picture = _shot(fine.noiseless(), double)
        full = None
        if any(isinstance(stage, isp.Demosaic) for stage in camera):
            others = [s for s in fine.noiseless() if not isinstance(s, (sensor.Mosaic, isp.Demosaic))]
            full = _shot(Camera(*others, context=camera.resolve()), double)[1]
        beyond = _light(bank) - _light(_centred(bank, window))
        return cls(query, bands, _centred(psfs, window), beyond, seconds, measured, raw, picture, full)

    def facts(self) -> dict[str, Any]:
        """For the JSON."""
        return {
            "psf": "non-paraxial in float64: the reference propagator",
            "window": list(self.psfs.shape[-2:]),  # beyond it, all light as one number
            "wavelengths": self.query.wavelengths.tolist(),
            "vergences": self.query.vergences.tolist(),
            "doubled_sampling_changes": self.convergence.doubled,
            "closed_form_differs": self.convergence.closed_form,
            "limit": self.convergence.limit,
            "picture": f"the same camera, non-paraxial, in float64, pupil sampled with kappa {REFERENCE_KAPPA}",
        }


def _shot(camera: Camera, scene: Scene) -> tuple[Tensor, Tensor]:
    """The raw signal before rounding, and the picture, of a noiseless camera."""
    ends = {cls.__name__ for cls in ENDS}
    raw = picture = torch.empty(0)
    reached = False
    for name, signal in camera.steps(scene):
        reached = reached or name in ends
        raw = raw if reached else signal
        picture = signal
    return raw, picture


def _measured(setting: Setting, truth: _Truth, *, longest: float) -> Row:
    """The errors and the memory of a setting, and the time of its first picture."""
    row = Row(setting.knob, setting.name, default=setting.default, baseline=setting.baseline)
    imaging, scene = _imaging(setting.camera), setting.scene
    try:
        if imaging.accuracy.propagator == "reference":  # known PSFs: their time, for all pixels, bands and layers
            pixels = math.prod(_query(imaging, scene).shape) / math.prod(truth.query.shape)
            all_of_them = pixels * _psf_count(imaging, scene) / truth.psfs.shape[:2].numel()
            error = truth.convergence.doubled
            return replace(
                row, psf_l1=error, psf_l1_worst=error, seconds=truth.seconds * all_of_them, share=1 / all_of_them
            )
        if setting.optics:
            errors, seconds, share = _psf_errors(imaging, scene, truth, longest=longest)
            row = replace(row, psf_l1=float(np.median(errors)), psf_l1_worst=max(errors))
            if seconds / share > longest:
                return replace(row, seconds=seconds / share, share=share)
        camera = setting.camera.noiseless()
        fresh = with_imaging(camera)
        (raw, picture), first, memory = measure.watched(lambda: _shot(fresh, scene))
        kept = measure.cpu_time(lambda: _shot(fresh, scene)) if first < ONCE else None
    except (ValueError, MemoryError) as error:
        return replace(row, refused=str(error))
    row = replace(row, seconds=first, seconds_kept=kept, peak_memory=memory, calls=1)
    if setting.knob == "demosaic":
        assumed = truth.full_picture
        return row if assumed is None else replace(row, delta_e=_delta_e(picture, assumed))
    rms = float(((raw.double() - truth.raw).square().mean() / truth.raw.square().mean()).sqrt())
    return replace(row, raw_rms=rms, delta_e=_delta_e(picture, truth.picture))


def _psf_count(imaging: Imaging, scene: Scene) -> int:
    """How many PSFs a picture takes."""
    layers = imaging.depth_layers(torch.as_tensor(scene.depth), scene.wavelengths)
    return len(layers) * min(imaging.accuracy.bands or len(scene.wavelengths), len(scene.wavelengths))


def _psf_errors(imaging: Imaging, scene: Scene, truth: _Truth, *, longest: float) -> tuple[list[float], float, float]:
    """(L1 errors of the PSFs that are compared, CPU seconds that these took, their share of a picture's PSFs).

    The PSFs are computed in the window that the picture needs and compared pixel by pixel in the middle of it; the
    light around the middle is compared as one number, so that a window too small shows. If those of the middle
    wavelength alone take a third of `longest`, they must do.
    """
    like = scene.coefficients[:0]
    vergences, shape = truth.query.vergences, _query(imaging, scene).shape
    part = torch.tensor([len(truth.bands) // 2])

    def compute() -> tuple[Tensor, float]:
        wanted = scene.wavelengths if imaging.accuracy.bands else scene.wavelengths[truth.bands[part]]
        start = time.process_time()
        bank = imaging.changed().psf_bank(wanted, vergences=vergences, shape=shape, like=like)
        return bank, time.process_time() - start

    bank, seconds = compute()
    if seconds < longest / 3:
        part = torch.arange(len(truth.bands))
        bank, seconds = compute()
    computed = min(imaging.accuracy.bands, len(scene.wavelengths)) if imaging.accuracy.bands else len(part)
    share = len(vergences) * computed / _psf_count(imaging, scene)
    if seconds < longest / 3 and seconds / share > longest:
        seconds = compute()[1]  # tables that every bank shares are there now
    bank = (bank[:, truth.bands[part]] if imaging.accuracy.bands else bank).double()
    inner, expected, beyond = _centred(bank, truth.psfs.shape[-1]), truth.psfs[:, part], truth.beyond[:, part]
    difference = _light((inner - expected).abs()) + (_light(bank) - _light(inner) - beyond).abs()
    return (difference / (_light(expected) + beyond)).flatten().tolist(), seconds, share


def _light(bank: Tensor) -> Tensor:
    return bank.sum((-2, -1))


def _centred(bank: Tensor, side: int) -> Tensor:
    """The middle of PSFs, (..., side, side), dark where they end before."""
    half = side // 2
    row, column = (size // 2 for size in bank.shape[-2:])
    return F.pad(bank, (half,) * 4)[..., row : row + side, column : column + side]


def _delta_e(picture: Tensor, truth: Tensor) -> float | None:
    """Mean CIEDE2000 between two sRGB pictures (B,3,H,W), or None where they are none."""
    if picture.shape[1] != 3:
        return None
    lab, other = (rgb2lab(p.double().clamp(0, 1).permute(0, 2, 3, 1).numpy()) for p in (picture, truth))
    return float(deltaE_ciede2000(lab, other).mean())


def _timed(every: Sequence[Setting], rows: list[Row], *, deadline: float, advance: Callable[[str], None]) -> list[Row]:
    """Time all settings by turns, A B A B, until the deadline; the first calls, with cold caches, do not count then."""
    times: list[list[float]] = [[] for _ in every]
    runs = [setting.camera.noiseless() for setting in every]
    turn = 0
    while time.monotonic() < deadline:
        before = sum(map(len, times))
        for own, row, setting, camera in zip(times, rows, every, runs, strict=True):
            wanted = row.calls and (turn == 0 or (row.seconds or 0) < ONCE)
            if wanted and time.monotonic() + (row.seconds or 0) < deadline:
                advance(f"round {turn + 1}, {setting.name}")
                fresh = with_imaging(camera)
                own.append(measure.cpu_time(functools.partial(_shot, fresh, setting.scene)))
        if sum(map(len, times)) == before:
            break
        turn += 1
    return [
        replace(
            row,
            seconds=statistics.median(own),
            seconds_iqr=(float(np.percentile(own, 25)), float(np.percentile(own, 75))),
            calls=len(own),
        )
        if own
        else row
        for row, own in zip(rows, times, strict=True)
    ]


# ---- words -----------------------------------------------------------------------------------------------------------


def _described(scene: Scene) -> str:
    _, height, width = scene.shape
    light = f"{len(scene.wavelengths)} wavelengths"
    near, far = (1 / _vergences(scene)[index].item() for index in (-1, 0))
    depth = f"{near:.3g} m" if near == far else f"{near:.3g} to {far:.3g} m"
    return f"{height} x {width} pixels, {light}, {depth}"


def _error(value: float | None) -> float:
    return math.inf if value is None else value


def _accuracy(error: float | None) -> str:
    return f"a raw error of {_small(error)}"


def _small(error: float | None) -> str:
    """An error for people; nothing below 1e-9 was looked at."""
    return "" if error is None else f"{error:.1e}" if error >= 1e-9 else "< 1e-9"


def _time(seconds: float | None) -> str:
    seconds = seconds or 0.0
    return f"{seconds * 1e3:.0f} ms" if seconds < 1 else f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"


def _ratio(row: Row, other: Row) -> str:
    return f"{(row.seconds or 0) / (other.seconds or math.nan):.2g}"


def _number(value: float | None, form: str, scale: float = 1.0) -> str:
    return "" if value is None else form.format(value * scale)
