"""The knobs: a function and a row of `KNOBS` each, which gives a camera with one thing changed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from kcam import isp, sensor
from kcam.camera import Camera
from kcam.optics import PROPAGATORS, Imaging
from kcam.optics.accuracy import Recipe
from kcam.optics.propagation.grid import samples_by_rule
from kcam.optics.propagation.question import Query
from kcam.optics.propagation.row import Propagator
from kcam.optics.propagation.table import choose
from kcam.optics.propagation.textbook import textbook_angular_spectrum_row, textbook_row
from kcam.optics.source import Points
from kcam.planner.plan import with_imaging
from kcam.scene import Scene

REFERENCE_KAPPA = 4.5  # of the reference picture's pupil sampling: a thousandth of the default's error
KAPPAS, THOROUGH_KAPPAS = (1.3, 1.6, 2.0, 2.7, 3.5, 5.0), (1.15, 1.3, 1.6, 2.0, 2.35, 2.7, 3.5, 4.2, 5.0)


@dataclass(frozen=True)
class Setting:
    """A camera and a scene in which one knob is turned.

    optics: whether the knob changes the PSFs. default: the camera as it was given. baseline: not kcam's own way.

    Example:
    >>> from kcam.tradeoff import settings
    >>> given = settings(Camera.phone(), Scene.builtin("coffee", size=32), knobs=["wavelengths"])[0]
    >>> given.name, given.default
    ('nonparaxial radial', True)
    """

    knob: str
    name: str
    camera: Camera
    scene: Scene
    optics: bool = False
    default: bool = False
    baseline: bool = False


Knob = Callable[[Camera, Scene, bool], Iterator[Setting]]


def settings(
    camera: Camera, scene: Scene, *, thorough: bool = False, knobs: Sequence[str] | None = None
) -> list[Setting]:
    """The camera as it is, and every setting of every knob, each turned by itself.

    A camera with another propagator than nonparaxial is as it is in its first row only: the knobs are turned on the
    non-paraxial one, because beside a model's error no other would show.

    Raises:    ValueError for a camera without optics, or an unknown knob.

    Example:
    >>> from kcam.tradeoff import settings
    >>> [s.name for s in settings(Camera.phone(), Scene.builtin("coffee", size=32), knobs=["wavelengths"])]
    ['nonparaxial radial', '3 wavelengths', '7 wavelengths', '14 wavelengths']
    """
    unknown = set(knobs or ()) - set(KNOBS)
    if unknown:
        raise ValueError(f"unknown knob {', '.join(sorted(unknown))}; there are: {', '.join(KNOBS)}.")
    imaging = imaging_of(camera)
    query = query_of(imaging, scene)
    row = choose(query, propagator=imaging.accuracy.propagator, method=imaging.accuracy.method)
    result = [Setting("default", called(row), camera, scene, optics=True, default=True)]
    if imaging.accuracy.propagator != "nonparaxial":
        camera = with_imaging(camera, propagator="nonparaxial", method=None)
    for name, knob in KNOBS.items():
        if knobs is None or name in knobs:
            result += knob(camera, scene, thorough)
    return [s for s in result if s.default or (s.knob, s.name) != ("propagator", called(row))]


def _propagators(camera: Camera, scene: Scene, thorough: bool) -> Iterator[Setting]:
    for row in PROPAGATORS.values():
        changed = with_imaging(camera, propagator=row.physics, method=row.method)
        yield Setting("propagator", called(row), changed, scene, optics=True)


def _samples(camera: Camera, scene: Scene, thorough: bool) -> Iterator[Setting]:
    for count in sample_counts(imaging_of(camera), scene, THOROUGH_KAPPAS if thorough else KAPPAS):
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
    rule = len(imaging_of(camera).depth_layers(torch.as_tensor(scene.depth), scene.wavelengths))
    for count in (1, 2, 3, 5, 9, 2 * rule) if thorough else (1, 3, 9):
        if rule > 1 and count not in (1, rule):
            yield Setting("depth", f"{count} layers", with_imaging(camera, layers=count), scene)
    for count in (1, 3, 9, rule):
        if rule > 1 and count <= rule:
            name = "1 layer" if count == 1 else f"{count} layers, nearest"
            yield Setting("depth", name, with_imaging(camera, layers=count, interpolate=False), scene)


def _support(camera: Camera, scene: Scene, thorough: bool) -> Iterator[Setting]:
    window = query_of(imaging_of(camera), scene).shape
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


def imaging_of(camera: Camera) -> Imaging:
    """The optics of a camera. Raises: ValueError where it has none."""
    for stage in camera:
        if isinstance(stage, Imaging):
            return stage
    raise ValueError("this camera has no optics.Imaging, so no knob trades its accuracy. Try Camera.phone().")


def called(row: Propagator) -> str:
    """A row's name in the table."""
    return f"{row.physics} {row.method}"


def query_of(imaging: Imaging, scene: Scene) -> Query:
    """What a bank of PSFs of this scene asks for: at its nearest and its farthest point."""
    if imaging.varies:
        raise ValueError("kcam tradeoff takes a camera that sees one PSF in all its pixels: Imaging(..., field=False).")
    vergences = ends_of(scene)
    window = imaging.psf_window(scene.wavelengths, vergences=vergences, picture=scene.shape[1:])
    lens, pixels = imaging.computed_lens(by="kcam tradeoff"), imaging.pixels(window, scene.coefficients)
    return lens.question(Points(vergences), scene.wavelengths, pixels, Recipe(samples=imaging.accuracy.samples))


def ends_of(scene: Scene) -> Tensor:
    """Vergences of the farthest and the nearest point, those that differ [1/m]."""
    depth = torch.as_tensor(scene.depth, dtype=torch.float64)
    return torch.unique(1 / torch.stack([depth.max(), depth.min()]))


def sample_counts(imaging: Imaging, scene: Scene, kappas: Sequence[float]) -> list[int]:
    """Pupil samples that each kappa gives at the shortest wavelength, ascending."""
    query = query_of(imaging, scene)
    shortest = int(query.wavelengths.argmin())
    return sorted({samples_by_rule(query.sampled(kappa=kappa, samples=None), shortest) for kappa in kappas})
