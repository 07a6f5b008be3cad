"""Errors against the non-paraxial physics in float64, and times side by side."""

from __future__ import annotations

import functools
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from skimage.color import deltaE_ciede2000, rgb2lab
from torch import Tensor
from torch.nn import functional as F

from kcam import isp, measure, sensor, threads
from kcam.camera import Camera
from kcam.optics import Imaging
from kcam.optics.propagation.question import Query
from kcam.optics.propagation.reference import Convergence, checked_psf
from kcam.planner.plan import ENDS, with_imaging
from kcam.scene import Scene
from kcam.tradeoff.knobs import REFERENCE_KAPPA, Setting, ends_of, imaging_of, query_of, sample_counts, settings
from kcam.tradeoff.results import Row, Sweep, front

WINDOW, THOROUGH_WINDOW = 33, 65  # pixels in which PSFs are compared: the reference takes 4 to 24 s for six of 65 x 65
MARGIN = 8  # pixels that the reference is computed beyond them: light cut off there is missing in the pixels' filter
SECONDS, THOROUGH_SECONDS = 160.0, 900.0  # the sweep's time in all, as far as it can choose
LONGEST, THOROUGH_LONGEST = 4.0, 120.0  # seconds of a picture above which its time is told from a few of its PSFs
ONCE = 2.5  # seconds of a picture above which one more call must do


def sweep(
    camera: Camera,
    scene: Scene,
    *,
    thorough: bool = False,
    knobs: Sequence[str] | None = None,
    seconds: float | None = None,
    advance: Callable[[str, int], None] | None = None,
    title: str = "What accuracy costs",
) -> Sweep:
    """Turn every knob of a camera and measure error, time and memory, on one thread of the CPU.

    Args:      thorough: more settings, a larger window for the PSFs, and 15 minutes rather than 3.
               knobs: of `KNOBS`; None for all.
               seconds: to spend on timing in rounds after everything was computed once; None: what `thorough` says.
               advance: told what is being done, and how many such steps there will be, as far as one can tell.
               title: of the table and the figure.
    Raises:    ValueError for a camera without optics, a scene that is not on the CPU, or optics for which the reference
               is not converged.

    Example:
    >>> from kcam.tradeoff import sweep
    >>> lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(50 * mm), focus_distance=2.0)
    >>> camera = Camera(optics.Imaging(lens, pixel_pitch=8 * um), sensor.ColourFilter.kodak())
    >>> found = sweep(camera, Scene.builtin("coffee", size=8), knobs=["precision"], seconds=0.0)
    >>> [(row.name, row.raw_rms < 1e-4) for row in found.rows]
    [('nonparaxial radial', True), ('float64', True)]
    """
    if scene.device.type != "cpu":
        raise ValueError(f"the sweep measures the CPU, but the scene is on {scene.device}. Use scene.to('cpu').")
    started = time.monotonic()
    advance = advance or (lambda what, steps: None)
    every = settings(camera, scene, thorough=thorough, knobs=knobs)
    with torch.no_grad(), threads.fixed(1):
        advance("reference", 1 + 2 * len(every))
        truth = _Truth.of(camera, scene, window=THOROUGH_WINDOW if thorough else WINDOW)
        rows = []
        for setting in every:
            advance(setting.name, 1 + 2 * len(every))
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
        imaging = imaging_of(camera)
        order = scene.wavelengths.argsort()
        bands = torch.unique(torch.stack([order[0], order[len(order) // 2], order[-1]]))
        whole = query_of(imaging, scene)
        window = (min(window, *whole.shape) - 1) // 2 * 2 + 1  # odd, and no larger than what the picture uses
        shape = (window + 2 * MARGIN, window + 2 * MARGIN)
        query = replace(whole, wavelengths=scene.wavelengths[bands]).sampled(samples=None)
        query = query.on(shape=shape, dtype=torch.float64, integrate=True)
        start = time.process_time()
        psfs, measured = checked_psf(query)
        seconds = time.process_time() - start
        count = sample_counts(imaging, scene, [REFERENCE_KAPPA])[0]
        # the Hankel form has no pupil grid, and no error of one
        finely = {} if imaging.computed_lens(by="kcam tradeoff").symmetric else {"samples": count}
        fine = with_imaging(camera, propagator="nonparaxial", method=None, **finely)
        double = scene.to(dtype=torch.float64)
        bank = imaging_of(fine).psf_bank(query.wavelengths, vergences=query.vergences, shape=whole.shape, like=psfs)
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
    imaging, scene = imaging_of(setting.camera), setting.scene
    try:
        if imaging.accuracy.propagator == "reference":  # known PSFs: their time, for all pixels, bands and layers
            pixels = math.prod(query_of(imaging, scene).shape) / math.prod(truth.query.shape)
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
    vergences, shape = truth.query.vergences, query_of(imaging, scene).shape
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


def _timed(
    every: Sequence[Setting], rows: list[Row], *, deadline: float, advance: Callable[[str, int], None]
) -> list[Row]:
    """Time all settings by turns, A B A B, until the deadline; the first calls, with cold caches, do not count then."""
    times: list[list[float]] = [[] for _ in every]
    runs = [setting.camera.noiseless() for setting in every]
    turn, began = 0, time.monotonic()
    while time.monotonic() < deadline:
        before = sum(map(len, times))
        for own, row, setting, camera in zip(times, rows, every, runs, strict=True):
            wanted = row.calls and (turn == 0 or (row.seconds or 0) < ONCE)
            if wanted and time.monotonic() + (row.seconds or 0) < deadline:
                calls, now = sum(map(len, times)), time.monotonic()
                more = max(1.0, calls * (deadline - now) / (now - began)) if calls else len(every)
                advance(f"round {turn + 1}, {setting.name}", 1 + len(every) + calls + round(more))
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


def _described(scene: Scene) -> str:
    _, height, width = scene.shape
    light = f"{len(scene.wavelengths)} wavelengths"
    near, far = (1 / ends_of(scene)[index].item() for index in (-1, 0))
    depth = f"{near:.3g} m" if near == far else f"{near:.3g} to {far:.3g} m"
    return f"{height} x {width} pixels, {light}, {depth}"
