"""A picture on its way through a camera: what light, signal and picture look like after each stage."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import matplotlib
import torch
from matplotlib.figure import Figure
from torch import Tensor, nn

from kcam.camera import Camera
from kcam.inputs import describe
from kcam.plots.captions import DOES as DOES
from kcam.plots.captions import arguments_of, facts, imaging_of, lens_line, plural, purpose_of, where
from kcam.plots.looks import ZOOM, Look, cut, draw_look, looked, scene_look
from kcam.plots.psf import draw_psfs, psf_rows
from kcam.plots.sheet import (
    EDGE,
    GAP,
    LINE,
    MUTED,
    TITLE,
    WIDTH,
    Sheet,
    columns_of,
    draw_lines,
    duration,
    metres,
    shortened,
)
from kcam.scene import Scene

_HIGHEST = 3.2  # inches of a picture


@dataclass(frozen=True)
class Step:
    """A signal (B,C,H,W), what made it (an Imaging with the filter that it absorbs is one step), and in which time.

    Example:
    >>> step = next(iter(plots.steps(Camera.ideal(), Scene.builtin("star", size=16))))
    >>> step.name, tuple(step.signal.shape), step.seconds >= 0
    ('ColourFilter', (1, 3, 16, 16), True)
    """

    name: str
    stages: tuple[nn.Module, ...]
    signal: Tensor
    seconds: float


@dataclass(frozen=True)
class _Panel:
    name: str
    does: str
    lines: tuple[str, ...]
    look: Look
    span: str


def pipeline(
    camera: Camera,
    scene: Scene,
    *,
    generator: torch.Generator | None = None,
    title: str = "From scene to picture",
    zoom: tuple[float, float] = (0.5, 0.5),
) -> Figure:
    """Take a picture and show all of it: the scene, its depth, the lens's PSFs, the signal after each stage, a detail
    of each, the picture.

    A mosaic is shown in the colours of its filters, bands as the eye sees them, other channels as red, green and blue.
    What is linear in light is too dark for a screen: it is brightened until all but its brightest hundredth fit, and
    given the display's gamma; the captions say by how much, and state the signal's own range.

    Args:      camera: any, with whatever stages.  scene: of a batch the first is taken.
               generator: of the noise; None for torch's default one.
               title: of the figure.  zoom: centre of the detail, as shares of the height and the width.
    Returns:   a matplotlib Figure, 12.8 inches wide; `save_figure` or ``figure.savefig`` writes it.
    Raises:    TypeError for what is no Camera or no Scene; ValueError for a camera without stages, an empty batch, or a
               zoom outside 0..1.

    Example:
    >>> figure = plots.pipeline(Camera.phone(), Scene.builtin("coffee", size=24))
    >>> float(figure.get_figwidth())
    12.8
    """
    first = first_of(scene, by="plots.pipeline")
    check_camera(camera, by="plots.pipeline")
    check_zoom(zoom)
    with torch.no_grad():
        return pipeline_figure(camera, first, steps(camera, first, generator=generator), title=title, zoom=zoom)


def steps(camera: Camera, scene: Scene, *, generator: torch.Generator | None = None) -> Iterator[Step]:
    """Take a picture step by step, with the time of each. Arguments: as `Camera.forward`.

    Example:
    >>> steps = list(plots.steps(Camera.phone(), Scene.builtin("coffee", size=24)))
    >>> [step.name for step in steps][:3]
    ['Imaging + ColourFilter', 'Mosaic', 'Exposure']
    """
    behind, start = 0, perf_counter()
    for count, name, signal in camera.walk(scene, generator=generator):
        yield Step(name, tuple(camera.stages[behind:count]), signal, perf_counter() - start)
        behind, start = count, perf_counter()


@torch.no_grad()
def pipeline_figure(
    camera: Camera,
    scene: Scene,
    taken: Iterable[Step],
    *,
    title: str = "From scene to picture",
    subtitle: str | None = None,
    zoom: tuple[float, float] = (0.5, 0.5),
) -> Figure:
    """`pipeline` of a picture that is being taken, or was: `steps` of this camera and scene, one sample.

    Args:      subtitle: None for the lens, the scene's size and distance, and the time in all.

    Example:
    >>> camera, scene = Camera.phone(), Scene.builtin("coffee", size=24)
    >>> taken = list(plots.steps(camera, scene))
    >>> figure = plots.pipeline_figure(camera, scene, taken, subtitle="a cup")
    >>> [step.name for step in taken][:2]
    ['Imaging + ColourFilter', 'Mosaic']
    """
    panels: list[_Panel] = []
    behind: list[nn.Module] = []
    seconds = 0.0
    context = camera.resolve(scene)
    for number, step in enumerate(taken, start=1):
        behind += step.stages
        seconds += step.seconds
        look = looked(step.signal, behind, context, zoom=zoom, across=ZOOM / scene.shape[2])
        panels.append(_panel(number, step, behind, look))
    imaging = imaging_of(camera)
    rows = [] if imaging is None else psf_rows(imaging, scene)
    heads = _heads(scene, panels[-1], zoom=zoom)
    columns = max(4, columns_of(len(panels)))
    cell = (WIDTH - 2 * EDGE + GAP) / columns - GAP
    aspect = scene.shape[2] / scene.shape[1]
    tall, detail = min(cell / aspect, 1.1 * cell), 0.5 * cell
    row = 0.24 + 0.2 + tall + 0.08 + detail + 0.06 + max(len(panel.lines) for panel in panels) * LINE + 0.3

    psf_width = 0.75 + 3 * 1.06 if rows else 0.0
    beside = len(heads) == 2 and not rows  # the details, where nothing else is
    room = WIDTH - 2 * EDGE - psf_width - GAP * (3 if beside or (rows and len(heads) == 3) else 2)
    side = min(room / (4 if beside else len(heads)), 4.2, _HIGHEST * aspect)
    high, head = side / aspect, 1.12
    captions = max(len(lines) for _, _, lines in heads) * LINE
    under = 0.26 + (max(high, 0.5 * side + captions) if beside else high + 0.08 + 0.5 * side + captions)
    below = head + max(under, 0.46 + 1.06 * len(rows) + 2 * LINE if rows else 0) + 0.4
    sheet = Sheet(WIDTH, below + 0.1 + math.ceil(len(panels) / columns) * row)
    sheet.text(EDGE, 0.3, shortened(title, WIDTH - 2 * EDGE, size=TITLE), size=TITLE, weight="bold", parse_math=False)
    if subtitle is None:
        subtitle = f"{lens_line(camera, otherwise='No lens')};  {where(scene)};  {duration(seconds)} in all"
    subtitle = shortened(subtitle, WIDTH - 2 * EDGE)
    sheet.text(EDGE, 0.66, subtitle, colour=MUTED, parse_math=False)
    left = EDGE
    for index, (name, own, lines) in enumerate(heads):
        if rows and index == len(heads) - 1:  # what the lens does stands between the scene and the picture
            draw_psfs(sheet, rows, left, head)
            left += psf_width + GAP
        sheet.text(left, head, name, weight="bold")
        draw_look(sheet, own, left, head + 0.26, side, high, 0.5 * side, beside=beside)
        text = (left + side + GAP, head + 0.26) if beside else (left, head + 0.26 + high + 0.08)
        draw_lines(sheet, lines, text[0], text[1] + 0.5 * side + 0.06, side)
        left += (side + GAP) * (2 if beside else 1)
    for index, panel in enumerate(panels):
        left = EDGE + index % columns * (cell + GAP)
        top = below + index // columns * row
        sheet.text(left, top, shortened(panel.name, cell, weight="bold"), weight="bold", parse_math=False)
        draw_lines(sheet, (panel.does,), left, top + 0.21, cell)
        draw_look(sheet, panel.look, left, top + 0.44, cell, tall, detail)
        draw_lines(sheet, panel.lines, left, top + 0.44 + tall + 0.08 + detail + 0.06, cell)
    return sheet.figure


def _panel(number: int, step: Step, behind: Sequence[nn.Module], look: Look) -> _Panel:
    shape, span = facts(step.signal, behind)
    arguments = ", ".join(filter(None, (arguments_of(stage) for stage in step.stages)))
    lines = (arguments, f"{shape},  {duration(step.seconds)}", span, *look.shown)
    does = ", ".join(filter(None, (purpose_of(stage) for stage in step.stages)))
    return _Panel(f"{number}  {step.name}", does, tuple(filter(None, lines)), look, span)


def _heads(scene: Scene, last: _Panel, *, zoom: tuple[float, float]) -> list[tuple[str, Look, tuple[str, ...]]]:
    """Scene, depth and picture: name, look, caption."""
    seen = scene_look(scene, zoom=zoom)
    factors = "" if scene.spectra is None else f" of {plural(len(scene.spectra), 'factor')}"
    bands = f"{plural(len(scene.wavelengths), 'band')}{factors},  white {scene.luminance:g} cd/m\u00b2"
    found = [("Scene", seen, (bands, *seen.shown))]
    if isinstance(scene.depth, Tensor) and scene.depth.ndim == 4:
        vergence = (1 / scene.depth[0, 0].detach().double()).cpu().numpy()
        low, high = float(vergence.min()), float(vergence.max())
        image = matplotlib.colormaps["viridis"]((vergence - low) / max(high - low, 1e-12))[..., :3]
        ends = [metres(1 / value) if value > 0 else "infinity" for value in (high, low)]
        lines = (f"yellow {ends[0]}, violet {ends[1]},", "even steps of 1 / distance")
        found.append(("Depth", cut(image, image, zoom=zoom, across=ZOOM / scene.shape[2]), lines))
    return [*found, ("Picture", last.look, (last.span, *last.look.shown))]


def first_of(scene: Any, *, by: str) -> Scene:
    """The first sample. Raises: TypeError, ValueError for what is no scene, or an empty batch."""
    if not isinstance(scene, Scene):
        raise TypeError(
            f"{by} takes a Scene, got {describe(scene)}. Use Scene.from_rgb(image, depth=2.0) or "
            "Scene.from_file(path, depth=2.0)."
        )
    if not scene.shape[0]:
        raise ValueError(f"{by} shows the first scene of a batch, and this one is empty: shape {scene.shape}.")
    return scene.samples([0])


def check_camera(camera: Any, *, by: str) -> None:
    """TypeError for what is no camera, ValueError for one without stages."""
    if not isinstance(camera, Camera):
        fix = f"Camera({type(camera).__name__}(...))" if isinstance(camera, nn.Module) else "Camera.phone()"
        raise TypeError(f"{by} takes a Camera, got {describe(camera)}. Use {fix}.")
    if not len(camera):
        raise ValueError(f"{by} shows the stages of a camera, and this one has none. Use Camera.phone().")


def check_zoom(zoom: Any) -> None:
    """ValueError unless it is a place: two shares."""
    if not isinstance(zoom, (tuple, list)) or len(zoom) != 2 or not all(0 <= share <= 1 for share in zoom):
        raise ValueError(f"zoom must be two shares 0..1 of the height and the width such as (0.5, 0.5), got {zoom!r}.")
