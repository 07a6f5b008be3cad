"""A picture on its way through a camera: what light, signal and picture look like after each stage."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor, nn
from torch.nn import functional as F

from kcam import isp, optics, sensor, spectral, srgb
from kcam.camera import DEMOSAICING, Camera
from kcam.context import Context
from kcam.inputs import describe
from kcam.optics.source import Points
from kcam.plots.pictures import as_image, false_colour, light_colours, mosaic_tile
from kcam.plots.psf import SHARE_SHOWN, centre, optics_text, psf_image, reach_of
from kcam.plots.sheet import FAINT, INK, MUTED, SMALL, TITLE, Sheet, duration, metres, shortened
from kcam.scene import Scene
from kcam.units import nm

WIDTH, EDGE, GAP, LINE = 12.8, 0.35, 0.18, 0.165  # inches
ZOOM = 56
"""Pixels of the scene across a detail."""
_HIGHEST = 3.2  # inches of a picture
_BRIGHT = 0.99  # of the pixels of a linear signal are not brighter than what is shown as white
_MOST = 20.0  # times darker than the brightest pixel that is
_ENOUGH = 1000  # pixels of a panel's longer side: more are averaged
_PSF_WAVELENGTHS = (450 * nm, 550 * nm, 650 * nm)
_LARGEST_PSF = 255  # pixels

DOES: tuple[tuple[type[nn.Module] | tuple[type[nn.Module], ...], str], ...] = (
    (optics.Imaging, "through the lens"),
    (sensor.ColourFilter, "bands to channels"),
    (sensor.Mosaic, "each pixel keeps one channel"),
    (sensor.Exposure, "how full the pixels become"),
    (sensor.ShotNoise, "photons are counted"),
    (sensor.ReadNoise, "noise of the electronics"),
    (sensor.DarkCurrent, "electrons without light"),
    (sensor.FixedPattern, "no two pixels are alike"),
    (sensor.ADC, "numbers of so many bits"),
    (DEMOSAICING, "every channel at every pixel"),
    (isp.WhiteBalance, "a gain per channel: white is grey"),
    (isp.ColourMatrix, "the filter's colours to those of sRGB"),
    (isp.ToneCurve, "coded for the screen"),
    (isp.Clip, "limited to 0..1"),
    (isp.Convolution, "a small kernel over all channels"),
    (isp.StyleStage, "painted anew"),
    (isp.TextureTransfer, "painted with pieces"),
)
"""What the stages do, in a few words; of others their docstring tells it."""


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
class Look:
    """A signal as it is shown, (H,W,3) in [0,1]: whole, its detail to the pixel, and what was done to show it.

    Both are None of what is no picture. box: left, top, columns and rows of the detail, as shares of the whole.
    """

    image: np.ndarray | None
    detail: np.ndarray | None
    shown: tuple[str, ...] = ()
    box: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)


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
    imaging = next((stage for stage in camera if isinstance(stage, optics.Imaging)), None)
    rows = [] if imaging is None else _psf_rows(imaging, scene)
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
        subtitle = f"{_lens(imaging)};  {where(scene)};  {duration(seconds)} in all"
    subtitle = shortened(subtitle, WIDTH - 2 * EDGE)
    sheet.text(EDGE, 0.66, subtitle, colour=MUTED, parse_math=False)
    left = EDGE
    for index, (name, own, lines) in enumerate(heads):
        if rows and index == len(heads) - 1:  # what the lens does stands between the scene and the picture
            _draw_psfs(sheet, rows, left, head)
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


# ---- what is shown -----------------------------------------------------------------------------------------------


def looked(
    signal: Any, behind: Sequence[nn.Module], context: Context, *, zoom: tuple[float, float], across: float
) -> Look:
    """The first sample of a signal as a picture, by the stages that are behind it.

    Args:      zoom: centre of the detail, as shares of the height and the width.  across: its width, as a share.
    """
    if not isinstance(signal, Tensor) or signal.ndim != 4 or 0 in signal.shape:
        return Look(None, None)
    planes = signal[0].detach().float().cpu().nan_to_num(0, 0, 0)
    tile = _tile(planes, behind)
    shown: tuple[str, ...] = ()
    if tile is None:
        planes, shown = _as_colours(planes, behind, context)
    if not _is_coded(behind):
        black = _black(behind, context)
        bright, dark = planes - black, "less black" if black else "shown"
        top = _top(bright.amax(0))
        planes = (bright / top).clamp(0, 1)
        shown += (f"{dark} \u00d7 {1 / top:.3g}, sRGB gamma",)
        planes = planes if tile is not None else srgb.to_code(planes).expand(3, -1, -1)
    if tile is None:
        image = as_image(planes)
        return cut(image, image, zoom=zoom, across=across, shown=shown)
    image = false_colour(planes, tile)  # which has a gamma of its own
    return cut(_brightened(_mixed(image, len(tile))), image, zoom=zoom, across=across, shown=shown)


def cut(
    image: np.ndarray,
    pixels: np.ndarray,
    *,
    zoom: tuple[float, float],
    across: float,
    shown: tuple[str, ...] = (),
) -> Look:
    """An image with the detail of `pixels`, of the same size, around a place: twice as wide as high."""
    height, width = image.shape[:2]
    columns = min(width, max(4, round(across * width)))
    rows = min(height, max(2, round(columns / 2)))
    y = int(np.clip(round(zoom[0] * height - rows / 2), 0, height - rows))
    x = int(np.clip(round(zoom[1] * width - columns / 2), 0, width - columns))
    step = max(1, max(height, width) // _ENOUGH)
    planes = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].float()
    small = F.avg_pool2d(planes, step, ceil_mode=True)[0].permute(1, 2, 0).numpy() if step > 1 else image
    box = (x / width, y / height, columns / width, rows / height)
    return Look(small, pixels[y : y + rows, x : x + columns], shown, box)


def _is_coded(behind: Sequence[nn.Module]) -> bool:
    return any(isinstance(stage, (isp.ToneCurve, isp.StyleStage, isp.TextureTransfer)) for stage in behind)


def _tile(planes: Tensor, behind: Sequence[nn.Module]) -> np.ndarray | None:
    """The colours of the filters over a mosaic's pixels; None for what is none, or is one no more."""
    filtered = any(isinstance(s, sensor.Mosaic) or (isinstance(s, sensor.ColourFilter) and s.is_tile) for s in behind)
    if len(planes) != 1 or not filtered or _is_coded(behind) or any(isinstance(s, DEMOSAICING) for s in behind):
        return None
    return mosaic_tile(behind)


def _as_colours(planes: Tensor, behind: Sequence[nn.Module], context: Context) -> tuple[Tensor, tuple[str, ...]]:
    """Channels (C,H,W) as linear red, green and blue or as one grey, and what was done where it is not plain."""
    filters = [stage for stage in behind if isinstance(stage, sensor.ColourFilter)]
    count, bands = len(planes), len(context.wavelengths)
    if not filters and count == bands:
        xyz = torch.einsum("lhw,lc->chw", planes, spectral.xyz_weights(context.wavelengths).float())
        return spectral.xyz_to_linear_srgb(xyz), ("as the eye sees its bands",)
    if count in (1, 3):
        return planes, ()
    if filters and not filters[-1].is_tile and len(filters[-1].coefficients) == count:
        curves = filters[-1].response(context.wavelengths).detach().double().cpu()
        colours = (curves @ spectral.observer(context.wavelengths) @ spectral.xyz_to_srgb_matrix().T).clamp(min=0)
        colours = (colours / colours.sum(0).clamp(min=1e-12)).float()  # all of them together are white
        return torch.einsum("chw,cr->rhw", planes, colours), ("channels in their own colours",)
    return planes.mean(0, keepdim=True), (f"mean of {count} channels",)


def _black(behind: Sequence[nn.Module], context: Context) -> float:
    """The black level that still lies under a signal, of full scale: a demosaic takes it off."""
    here = any(isinstance(s, sensor.ADC) for s in behind) and not any(isinstance(s, DEMOSAICING) for s in behind)
    return float(torch.as_tensor(context.black_level).detach().max()) if here else 0.0


def _top(plane: Tensor) -> float:
    """What is shown as white of a linear signal: above all but its brightest hundredth, which may be single lights."""
    values = plane.flatten()
    values = values[:: max(1, len(values) // 1_000_000)]
    top = max(float(np.quantile(values.numpy(), _BRIGHT)), float(values.amax()) / _MOST)
    return top if top > 1e-12 else 1.0


def _mixed(image: np.ndarray, tile: int) -> np.ndarray:
    """The mean over a tile around each pixel: shown smaller than it is, a mosaic would make moire."""
    width = min(tile, 6, *image.shape[:2])
    means = F.avg_pool2d(torch.from_numpy(image).permute(2, 0, 1), width, stride=1)
    return F.pad(means, (0, width - 1, 0, width - 1), "replicate").permute(1, 2, 0).numpy()


def _brightened(image: np.ndarray) -> np.ndarray:
    """Scaled so that all but its brightest hundredth keeps its colour: pixels of one colour are dark between others."""
    top = max(float(np.quantile(image, _BRIGHT)), float(image.max()) / _MOST ** (1 / 2.2))
    return np.clip(image / max(top, 1e-6), 0, 1)


# ---- what is said ------------------------------------------------------------------------------------------------


def _panel(number: int, step: Step, behind: Sequence[nn.Module], look: Look) -> _Panel:
    shape, span = _facts(step.signal, behind)
    arguments = ", ".join(filter(None, (_arguments(stage) for stage in step.stages)))
    lines = (arguments, f"{shape},  {duration(step.seconds)}", span, *look.shown)
    does = ", ".join(filter(None, (_does(stage) for stage in step.stages)))
    return _Panel(f"{number}  {step.name}", does, tuple(filter(None, lines)), look, span)


def _does(stage: nn.Module) -> str:
    for kind, words in DOES:
        if isinstance(stage, kind):
            return words
    own = type(stage).__doc__ if "__doc__" in vars(type(stage)) else None
    return (inspect.cleandoc(own).splitlines() or [""])[0].rstrip(".:") if own else ""


def _arguments(stage: nn.Module) -> str:
    """Those that a stage prints, unless they are many or say little."""
    if isinstance(stage, optics.Imaging):
        return f"pixels of {float(stage.pixel_pitch) * 1e6:.3g} \u00b5m"
    if isinstance(stage, sensor.ColourFilter):
        shape = stage.coefficients.shape
        return f"tile of {shape[0]} \u00d7 {shape[1]} filters" if stage.is_tile else _plural(shape[0], "channel")
    if isinstance(stage, (isp.LearnedDemosaic, isp.Convolution)):
        return f"kernel of {_times(stage.weight.shape)}"
    if isinstance(stage, nn.Sequential):
        return f"{len(stage)} layers"
    return re.sub(r"\w+=None(, |$)", "", " ".join(stage.extra_repr().split())).rstrip(", ")


def _plural(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _times(shape: Sequence[int]) -> str:
    return " \u00d7 ".join(map(str, shape))


def _facts(signal: Any, behind: Sequence[nn.Module]) -> tuple[str, str]:
    """The shape of a sample, and from what to what it goes, in which unit."""
    if not isinstance(signal, Tensor):
        return type(signal).__name__, ""
    values = signal[0].detach() if signal.ndim else signal.detach()
    lost = int((~values.isfinite()).sum())
    finite = values[values.isfinite()] if lost else values
    low, high = (float(end) for end in finite.aminmax()) if finite.numel() else (0.0, 0.0)
    span = f"{low:.3g} to {high:.3g} {_unit(behind)}" if finite.numel() else ""
    return _times(values.shape) or "a number", f"{span}{f', {lost} not finite' if lost else ''}"


def _unit(behind: Sequence[nn.Module]) -> str:
    if _is_coded(behind):
        return "in sRGB"
    for kind, unit in ((isp.ColourMatrix, "in linear sRGB"), (sensor.ADC, "of full scale")):
        if any(isinstance(stage, kind) for stage in behind):
            return unit
    exposed = any(isinstance(stage, sensor.Exposure) for stage in behind)
    return "of full well" if exposed else "relative to white" if behind else "relative"


def _lens(imaging: optics.Imaging | None) -> str:
    return "No lens" if imaging is None else optics_text(imaging)


def where(scene: Scene) -> str:
    """How far away a scene is, and how large."""
    depth = torch.as_tensor(scene.depth)
    near, far = metres(float(depth.min())), metres(float(depth.max()))
    _, height, width = scene.shape
    return f"{near if near == far else f'{near} to {far}'} away;  {width} \u00d7 {height} pixels"


def _heads(scene: Scene, last: _Panel, *, zoom: tuple[float, float]) -> list[tuple[str, Look, tuple[str, ...]]]:
    """Scene, depth and picture: name, look, caption."""
    seen = scene_look(scene, zoom=zoom)
    factors = "" if scene.spectra is None else f" of {_plural(len(scene.spectra), 'factor')}"
    bands = f"{_plural(len(scene.wavelengths), 'band')}{factors},  white {scene.luminance:g} cd/m\u00b2"
    found = [("Scene", seen, (bands, *seen.shown))]
    if isinstance(scene.depth, Tensor) and scene.depth.ndim == 4:
        vergence = (1 / scene.depth[0, 0].detach().double()).cpu().numpy()
        low, high = float(vergence.min()), float(vergence.max())
        image = matplotlib.colormaps["viridis"]((vergence - low) / max(high - low, 1e-12))[..., :3]
        ends = [metres(1 / value) if value > 0 else "infinity" for value in (high, low)]
        lines = (f"yellow {ends[0]}, violet {ends[1]},", "even steps of 1 / distance")
        found.append(("Depth", cut(image, image, zoom=zoom, across=ZOOM / scene.shape[2]), lines))
    return [*found, ("Picture", last.look, (last.span, *last.look.shown))]


def scene_look(scene: Scene, *, zoom: tuple[float, float]) -> Look:
    """The first sample of a scene in sRGB."""
    image = as_image(scene.samples([0]).to_srgb()[0])
    return cut(image, image, zoom=zoom, across=ZOOM / scene.shape[2], shown=("as sRGB",))


# ---- PSFs --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _PSFRow:
    """PSFs (L,h,w) of a point, as they lie in the picture, at wavelengths (L,) [m]."""

    label: str
    psfs: Tensor
    wavelengths: Tensor


def _psf_rows(imaging: optics.Imaging, scene: Scene) -> list[_PSFRow]:
    """Of the nearest, the middle and the farthest distance; of a lens with a field also in the corner."""
    if not imaging.accuracy.blur:
        return []
    depth = torch.as_tensor(scene.depth).detach().double().cpu().flatten()
    near, middle, far = float(depth.min()), float(depth.median()), float(depth.max())
    has_field = imaging.varies or getattr(imaging.lens, "positions", None) is not None
    chosen = [near, far] if has_field else [near, middle, far]
    distances = [each for index, each in enumerate(chosen) if metres(each) not in map(metres, chosen[:index])]
    low, high = (float(end) for end in scene.wavelengths.aminmax())
    visible = low <= _PSF_WAVELENGTHS[0] and high >= _PSF_WAVELENGTHS[-1]
    middles = _PSF_WAVELENGTHS if visible else (low, (low + high) / 2, high)
    wavelengths = torch.tensor(middles, dtype=torch.float64)
    vergences = 1 / torch.tensor(distances, dtype=torch.float64)
    shape = imaging.psf_window(wavelengths, vergences=vergences, picture=(scene.shape[1], scene.shape[2]))
    rows, columns = (min(side, _LARGEST_PSF) | 1 for side in shape)
    pixels = imaging.pixels((rows, columns), torch.empty(0, device=scene.device))
    if not has_field:
        found = imaging.bank(Points(vergences), wavelengths, pixels)
        labels = [metres(each) for each in distances]
    else:
        middle_of = torch.tensor(imaging.centre or (0.0, 0.0), dtype=torch.float64)
        corner = torch.tensor([scene.shape[2], scene.shape[1]]) / 2 * float(imaging.pixel_pitch)
        places = torch.stack([middle_of, middle_of + 0.95 * corner])  # upper left: light falls turned about
        found = _over_field(imaging, places, vergences, wavelengths, pixels)
        labels = [f"{place},\n{metres(each)}" for each in distances for place in ("middle", "corner")][:3]
    found = found.double().cpu().flip((-2, -1))
    return [_PSFRow(label, psf, wavelengths) for label, psf in zip(labels, found, strict=False)]


def _over_field(imaging: optics.Imaging, places: Tensor, vergences: Tensor, wavelengths: Tensor, pixels: Any) -> Tensor:
    """PSFs (2 Z, L, h, w) at two places, those of a distance together."""
    if imaging.varies:
        lens: Any = imaging.lens
        reach = float(places.norm(dim=1).max())
        found = lens.over_field(reach, vergences, wavelengths).bank(places, pixels)
    else:
        found = torch.stack(
            [imaging.bank(Points(vergences, place.expand(len(vergences), 2)), wavelengths, pixels) for place in places]
        )
    return found.transpose(0, 1).flatten(0, 1)


def _draw_psfs(sheet: Sheet, rows: Sequence[_PSFRow], left: float, top: float) -> None:
    sheet.text(left, top, "PSFs of the lens", weight="bold")
    reach = reach_of(torch.stack([row.psfs for row in rows]), share=SHARE_SHOWN)
    first, cell, gap = left + 0.75, 1.0, 0.06
    wavelengths = rows[0].wavelengths
    for column, colour in enumerate(light_colours(wavelengths)):
        at = first + column * (cell + gap)
        sheet.text(
            at + cell / 2, top + 0.26, f"{wavelengths[column] / nm:.0f} nm", size=SMALL, colour=MUTED, ha="center"
        )
        for line, row in enumerate(rows):
            image = psf_image(centre(row.psfs[column], reach), colour)
            sheet.picture(image, at, top + 0.46 + line * (cell + gap), cell, cell, smooth=False)
    for line, row in enumerate(rows):
        y = top + 0.46 + line * (cell + gap) + cell / 2
        sheet.text(first - 0.08, y, row.label, size=SMALL, colour=MUTED, ha="right", va="center")
    below = top + 0.46 + len(rows) * (cell + gap)
    lines = (f"{2 * reach + 1} pixels across, as they lie in the picture;", "each to its own peak, square root shown")
    draw_lines(sheet, lines, left, below, 0.75 + 3 * (cell + gap))


# ---- drawing -----------------------------------------------------------------------------------------------------


def draw_look(
    sheet: Sheet,
    look: Look,
    left: float,
    top: float,
    width: float,
    high: float,
    detail: float,
    *,
    beside: bool = False,
) -> None:
    """A picture as large as fits; where it has a detail its frame, and the detail below or beside it."""
    if look.image is None:
        axes = sheet.axes(left, top, width, high)
        axes.set(xticks=[], yticks=[], facecolor=FAINT)
        axes.spines[:].set_visible(False)
        axes.text(0.5, 0.5, "no picture", color=MUTED, size=SMALL, ha="center", va="center", transform=axes.transAxes)
        return
    axes = sheet.picture(look.image, left, top, *_fitting(look.image, width, high))
    if look.detail is None:
        return
    rows, columns = look.image.shape[:2]
    x, y, across, down = (share * size for share, size in zip(look.box, (columns, rows, columns, rows), strict=True))
    for line, colour in ((2.2, INK), (1.0, "white")):
        frame = matplotlib.patches.Rectangle((x - 0.5, y - 0.5), across, down, fill=False, lw=line, ec=colour)
        axes.add_patch(frame)
    at = (left + width + GAP, top) if beside else (left, top + high + 0.08)
    sheet.picture(look.detail, *at, *_fitting(look.detail, width, detail), smooth=False)


def _fitting(image: np.ndarray, width: float, high: float) -> tuple[float, float]:
    scale = min(width / image.shape[1], high / image.shape[0])
    return image.shape[1] * scale, image.shape[0] * scale


def columns_of(count: int) -> int:
    """Four or five, or as many as there are: those that leave the fewest places empty."""
    return count if count < 4 else min((4, 5), key=lambda columns: (-count % columns, -columns))


def draw_lines(sheet: Sheet, lines: Sequence[str], left: float, top: float, width: float) -> None:
    """Lines of a caption, each cut off where it would leave its column."""
    for index, line in enumerate(lines):
        text = shortened(line, width, size=SMALL)
        sheet.text(left, top + index * LINE, text, size=SMALL, colour=MUTED, parse_math=False)


# ---- what goes in by mistake -------------------------------------------------------------------------------------


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
