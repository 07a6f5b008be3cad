"""What a training run shows: the contact sheet of a checkpoint, the loss curve, and a page that holds both."""

from __future__ import annotations

import base64
import math
import os
from collections.abc import Sequence
from html import escape
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from torch import Tensor

from kcam import files, isp, optics, plots, sensor
from kcam.camera import PAINTING, Camera
from kcam.optics.pupil.coordinates import Pupil
from kcam.optics.source import Points
from kcam.plots import INK, MUTED, SMALL, TITLE, Sheet
from kcam.scene import Scene
from kcam.units import nm, wavelength_grid

WIDTH, EDGE, GAP, HEAD = 12.4, 0.4, 0.12, 1.3  # inches
PANEL, APART = 1.4, 0.42  # height of the panels below the pictures, and the space between two kinds of them
PSF_WAVELENGTHS = (450 * nm, 550 * nm, 650 * nm)
FILTER_COLOURS = ("#c8553d", "#2a9d5f", "#3f6fd8", MUTED)
CSS_PIXELS_PER_INCH = (62, 96)  # of a figure: narrower than that it scrolls sideways, wider it does not grow


@torch.no_grad()
def style_sheet(
    camera: Camera,
    *,
    style: Tensor,
    scenes: Sequence[Scene],
    step: int | None = None,
    start: Camera | None = None,
    seed: int = 0,
    pictures: Sequence[Sequence[Tensor]] | None = None,
) -> Figure:
    """The contact sheet of a camera in training: the style, scenes and its pictures of them, and what it has learned.

    The camera's picture before what paints (`StyleStage`, `TextureTransfer`) and the one after it have a column each;
    a camera without one has one column. Below, as far as the camera has them: the phase of its DOE, PSFs at the first
    scene's (median) distance, its filter, the weights of its convolution.

    Args:      style: (3,H,W) sRGB; below the whole, parts of it are shown at the scale of the pictures.
               scenes: two to four, of a batch the first. step: for the title. start: the camera before training, whose
               filter curves are dashed. seed: each picture is the one that the camera takes with this generator.
               pictures: of each scene, as `photographed` gives them, where they are there already.
    Raises:    ValueError for no scenes; TypeError, ValueError for a style that is no picture.
    """
    if not scenes:
        raise ValueError("a sheet shows at least one scene, got none. Use scenes=[Scene.builtin('astronaut', 128)].")
    taken = [photographed(camera, scene, seed) for scene in scenes] if pictures is None else pictures
    rows = [[plots.as_image(picture[0]) for picture in row] for row in taken]
    heads = ("Style", "Scene", "Camera alone", "Camera and style stage")[: len(rows[0]) + 1]
    side = (WIDTH - 2 * EDGE + GAP) / len(heads) - GAP
    heights = [side * row[0].shape[0] / row[0].shape[1] for row in rows]
    panels = HEAD + sum(heights) + GAP * len(rows) + 0.5
    imaging = next((stage for stage in camera if isinstance(stage, optics.Imaging)), None)
    sheet = Sheet(WIDTH, panels + PANEL + 0.7)
    sheet.text(EDGE, 0.32, "The camera" if step is None else f"After step {step}", size=TITLE, weight="bold")
    sheet.text(EDGE, 0.64, "No lens" if imaging is None else plots.optics_text(imaging), colour=MUTED)
    for column, head in enumerate(heads):
        sheet.text(EDGE + column * (side + GAP), HEAD - 0.26, head, weight="bold")
    top, painting = HEAD, plots.as_image(style)
    for index, (row, height) in enumerate(zip(rows, heights, strict=True)):
        if index == 0:
            scale = min(side / painting.shape[1], height / painting.shape[0])
            sheet.picture(painting, EDGE, top, painting.shape[1] * scale, painting.shape[0] * scale)
        else:
            part, scale = _part(painting, row[0].shape[:2], share=index / len(rows)), side / row[0].shape[1]
            sheet.picture(part, EDGE, top, part.shape[1] * scale, part.shape[0] * scale)
        for column, image in enumerate(row, start=1):
            sheet.picture(image, EDGE + column * (side + GAP), top, side, height)
        top += height + GAP
    left, right = EDGE, WIDTH - EDGE
    if imaging is not None:
        left = _draw_optics(sheet, imaging, left, panels, distance=float(torch.as_tensor(scenes[0].depth).median()))
    for stage in camera:
        if isinstance(stage, (isp.Convolution, isp.LearnedDemosaic)):
            right = _draw_kernel(sheet, stage.weight.double().cpu(), right, panels)
    before, now = (
        next((stage for stage in whose or () if isinstance(stage, sensor.ColourFilter)), None)
        for whose in (start, camera)
    )
    if now is not None:
        tile = plots.mosaic_tile(camera) if now.is_tile else None
        _draw_filter(sheet, now, before, tile, left=left, right=right, top=panels)
    return sheet.figure


@torch.no_grad()
def photographed(camera: Camera, scene: Scene, seed: int = 0) -> list[Tensor]:
    """The scene, the camera's picture before its style stage, and after it if there is one: (1,3,H,W) each."""
    scene = scene.samples([0])
    split = next((i for i, stage in enumerate(camera) if isinstance(stage, PAINTING)), len(camera))
    generator = torch.Generator(scene.device).manual_seed(seed)
    pictures = [scene.to_srgb(), camera[:split](scene, generator=generator)]
    if split < len(camera):
        pictures.append(camera[split:](pictures[-1], generator=generator))
    return pictures


def _part(image: np.ndarray, shape: Sequence[int], *, share: float) -> np.ndarray:
    """A part of a picture, at most of this shape: so far down, and so far from the right."""
    height, width = (min(pair) for pair in zip(shape, image.shape, strict=False))
    y, x = round((image.shape[0] - height) * share), round((image.shape[1] - width) * (1 - share))
    return image[y : y + height, x : x + width]


# ---- what a camera has learned ---------------------------------------------------------------------------------------


def _label(sheet: Sheet, left: float, top: float, title: str, caption: str = "") -> None:
    sheet.text(left, top - 0.25, title, weight="bold")
    sheet.text(left, top + PANEL + 0.09, caption, size=SMALL, colour=MUTED, linespacing=1.35)


def _draw_optics(sheet: Sheet, imaging: optics.Imaging, left: float, top: float, *, distance: float) -> float:
    """Phase map and PSFs; returns where they end."""
    phase = _doe_phase(imaging.lens) if isinstance(imaging.lens, optics.Lens) else None
    if phase is not None:
        span, largest = float(np.nanmax(phase) - np.nanmin(phase)), float(np.nanmax(np.abs(phase)))
        wrapped = largest > math.pi
        caption = f"spans {span:.3g} rad,\nwrapped to \u00b1\u03c0" if wrapped else f"\u00b1{largest:.2g} rad"
        phase = np.angle(np.exp(1j * phase)) / math.pi if wrapped else phase / max(largest, 1e-12)
        _label(sheet, left, top, "DOE phase", caption if largest > 1e-6 else "flat")
        sheet.picture(_coloured("twilight_shifted", phase), left, top, PANEL, PANEL, smooth=False)
        left += PANEL + APART
    pixels = imaging.pixels(imaging.accuracy.psf_shape or (255, 255), torch.empty(0))
    points = Points(torch.tensor([1 / distance], dtype=torch.float64))
    psf = imaging.bank(points, torch.tensor(PSF_WAVELENGTHS, dtype=torch.float64), pixels)[0]
    psf = psf.double().cpu()
    psf = plots.centre(psf, plots.reach_of(psf[None], share=plots.SHARE_SHOWN))
    light = plots.percent_or_more(float(psf.sum((-2, -1)).min()))
    caption = (
        f"PSFs at {plots.metres(distance)}: {psf.shape[-1]} pixels across,\n{light} of the light, square root shown"
    )
    for one, colour, wavelength in zip(
        psf, plots.light_colours(torch.tensor(PSF_WAVELENGTHS)), PSF_WAVELENGTHS, strict=True
    ):
        _label(sheet, left, top, f"{wavelength / nm:.0f} nm", caption)
        sheet.picture(plots.psf_image(one, colour), left, top, PANEL, PANEL, smooth=False)
        left, caption = left + PANEL + 0.07, ""
    return left - 0.07 + APART


def _doe_phase(lens: optics.Lens) -> np.ndarray | None:
    """The phase of a lens's first diffractive element at its design wavelength about its mean [rad].

    NaN outside a round aperture; None without such an element.
    """
    kinds = (optics.DOE, optics.RadialDOE, optics.ZernikeDOE)
    element = next((element for element in lens.elements if isinstance(element, kinds)), None)
    if element is None:
        return None
    design, semi_aperture = wavelength_grid([element.design_wavelength]), lens.aperture.semi_aperture().cpu()
    pixels = element.pixel_map(design)
    count = 255 if pixels is None else len(pixels.values)
    axis = (torch.arange(count, dtype=torch.float64) + 0.5) * (2 / count) - 1
    if pixels is None:
        pupil = Pupil(axis, axis[:, None], semi_aperture, torch.as_tensor(lens.sensor_distance), paraxial=True)
        ((factor, shape),) = element.terms(pupil, design)
        phase = factor.cpu() * shape.cpu() * (2 * math.pi / design)
    else:
        phase = pixels.values.double().cpu()
        axis = axis if pixels.half_width is None else axis * float(pixels.half_width) / float(semi_aperture)
    outside = (axis.square() + axis[:, None].square() > 1) & lens.round
    return (phase - phase[~outside].mean()).masked_fill(outside, math.nan).numpy()


def _coloured(name: str, values: np.ndarray) -> np.ndarray:
    """Values in [-1,1] in the colours of a map, (H,W,3); white where they are NaN."""
    colours = matplotlib.colormaps[name](np.nan_to_num(0.5 + 0.5 * values))[..., :3]
    return np.where(np.isnan(values)[..., None], 1.0, colours)


def _draw_kernel(sheet: Sheet, kernel: Tensor, right: float, top: float) -> float:
    """Weights (N,C,k,k) as N kernels down and C across, blue above 0, red below; returns where they begin."""
    largest = float(kernel.abs().max())
    apart = np.pad(kernel.numpy() / max(largest, 1e-12), ((0, 0), (0, 0), (0, 1), (0, 1)), constant_values=math.nan)
    image = _coloured("RdBu", apart.transpose(0, 2, 1, 3).reshape(len(kernel) * apart.shape[2], -1)[:-1, :-1])
    width = PANEL * image.shape[1] / image.shape[0]
    left = right - max(width, 1.15)
    _label(
        sheet, left, top, "{} x {} weights".format(*kernel.shape[2:]), f"blue +{largest:.2g}\nred \u2212{largest:.2g}"
    )
    sheet.picture(image, left, top, width, PANEL, smooth=False)
    for row, name in enumerate("RGB" if len(kernel) == 3 else ""):
        place = (left - 0.07, top + (row + 0.5) * PANEL / 3)
        sheet.text(*place, name, size=SMALL, colour=FILTER_COLOURS[row], ha="right", va="center")
    return left - APART - 0.1


def _draw_filter(
    sheet: Sheet,
    now: sensor.ColourFilter,
    start: sensor.ColourFilter | None,
    tile: np.ndarray | None,
    *,
    left: float,
    right: float,
    top: float,
) -> None:
    if tile is not None:
        _label(sheet, left, top, "Filter tile", "{} x {} pixels".format(*tile.shape[:2]))
        sheet.picture(tile, left, top, PANEL, PANEL, smooth=False)
        left += PANEL + APART
    _label(sheet, left, top, "Filter curves" if tile is None else "Mean curve")
    axes = sheet.axes(left, top, min(right - left, 3.2), PANEL)
    wavelengths = torch.linspace(420, 720, 151, dtype=torch.float64) * nm
    for colour_filter, style in ((start, {"lw": 1.1, "ls": (0, (3, 2)), "alpha": 0.75}), (now, {"lw": 1.7})):
        curves = () if colour_filter is None else colour_filter.response(wavelengths).cpu()
        for index, curve in enumerate(curves):
            colour = INK if len(curves) == 1 else FILTER_COLOURS[index % len(FILTER_COLOURS)]
            axes.plot(wavelengths / nm, curve, color=colour, **style)
    peak = f"peak {float(now.response(wavelengths).max()):.2f}"
    axes.set_xlabel(peak if start is None else f"{peak};  dashed: start", loc="left")
    axes.set_xticks([450, 550, 650], ["450", "550", "650 nm"])
    axes.set(xlim=(420, 720))
    axes.set_ylim(bottom=0)
    plots.quiet(axes)
    axes.tick_params(labelleft=False)


# ---- the loss --------------------------------------------------------------------------------------------------------


def loss_figure(history: Tensor, names: Sequence[str]) -> Figure:
    """The loss over the steps, on a log scale: the total and its weighted terms, each step faint, their median on top.

    Args:      history: (N, K), as `Trained.history`; values that are not positive are left out. names: of its columns.
    """
    width, height, edge, head = 6.2, 3.1, 0.75, 0.75
    sheet = Sheet(edge + width + 1.5, head + height + 0.65)
    sheet.text(edge, 0.24, "Loss", size=TITLE - 2, weight="bold")
    axes = sheet.axes(edge, head, width, height)
    values = history.detach().double().cpu().numpy()
    values = np.where(np.isfinite(values) & (values > 0), values, np.nan)
    shown = [column for column in range(min(len(names), values.shape[-1])) if not np.isnan(values[:, column]).all()]
    axes.set(xlabel="step", xlim=(1, len(values)) if len(values) > 1 else (0.5, 1.5))
    plots.quiet(axes)
    if not shown:
        axes.set(xticks=[], yticks=[])
        axes.text(0.5, 0.5, "no steps yet", ha="center", va="center", color=MUTED, transform=axes.transAxes)
        return sheet.figure
    window = min(len(values) // 15, 50) * 2 + 1
    if window > 1:
        sheet.text(edge + 0.6, 0.29, f"faint: each step;  bold: the median of {window}", colour=MUTED, size=SMALL)
    low, high = np.nanmin(values[:, shown]), np.nanmax(values[:, shown])
    widen = max(1.15, math.sqrt(3 * low / high))  # at least a factor of 3, so that there is a tick
    axes.set(yscale="log", ylim=(low / widen, high * widen))
    axes.xaxis.set_major_locator(MaxNLocator(nbins=7, integer=True, min_n_ticks=1, steps=[1, 2, 5, 10]))
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0,) if high > 300 * low else (1.0, 2.0, 3.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    others = iter(colour for colour in plots.distance_colours(len(shown) + 1) if colour != INK)
    ends = []
    for column in shown:
        colour = INK if names[column] == "total" else next(others)
        line, steps = _running_median(values[:, column], window), np.arange(1, len(values) + 1)
        if window > 1:
            axes.plot(steps, values[:, column], color=colour, lw=0.6, alpha=0.3)
        axes.plot(steps, line, color=colour, lw=1.8, marker="o" if len(values) < 15 else "", ms=3.5, clip_on=False)
        ends.append((float(line[~np.isnan(line)][-1]), names[column], colour))
    ends.sort()
    bottom, top = np.log(axes.get_ylim())
    places = _apart([(math.log(last) - bottom) / (top - bottom) for last, _, _ in ends], least=0.065)
    for place, (last, name, colour) in zip(places, ends, strict=True):
        style: dict[str, Any] = {"color": colour, "size": SMALL + 0.5, "va": "center", "transform": axes.transAxes}
        axes.text(1.025, place, f"{name}  {last:.3g}", **style)
    return sheet.figure


def _running_median(values: np.ndarray, window: int) -> np.ndarray:
    """The median of so many values around each, mirrored at the ends; NaN where all are."""
    views = np.lib.stride_tricks.sliding_window_view(np.pad(values, window // 2, mode="reflect"), window)
    empty = np.isnan(views).all(1)
    return np.where(empty, np.nan, np.nanmedian(np.where(empty[:, None], 0.0, views), 1))


def _apart(places: Sequence[float], *, least: float) -> list[float]:
    """Places in rising order, moved up, and then down below 1, until neighbours are this far from each other."""
    moved: list[float] = []
    for place in places:
        moved.append(max(place, moved[-1] + least) if moved else place)
    ceiling = 1.0
    for index in reversed(range(len(moved))):
        moved[index] = min(moved[index], ceiling)
        ceiling = moved[index] - least
    return moved


# ---- the page --------------------------------------------------------------------------------------------------------


def write_report(
    path: str | os.PathLike[str],
    *,
    title: str,
    summary: Sequence[tuple[str, str]],
    figures: Sequence[tuple[str, Figure]],
    advice: Sequence[str] = (),
    notes: Sequence[str] = (),
    table: Sequence[Sequence[str]] = (),
) -> None:
    """Write a page that holds all it shows: one HTML file without scripts and without links to other places.

    Args:      path: ends in .html; replaced if it exists, whole or not at all.
               summary: (name, value). figures: (title, figure). advice: what the run warned of. notes: paragraphs.
               table: rows below the summary, the first of them the heads; the first cell of each names it.
    Raises:    ValueError for another suffix, a folder of that name, or no place for it: see `plots.check_writable`.
    """
    plots.check_writable(path, suffixes=(".html",))
    facts = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in summary)
    warned = "".join(f"<li>{escape(text)}</li>" for text in advice)
    parts = [f"<h1>{escape(title)}</h1>", f"<dl>{facts}</dl>"]
    if table:
        heads = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in table[0])
        rows = "".join(
            f'<tr><th scope="row">{escape(name)}</th>{"".join(f"<td>{escape(cell)}</td>" for cell in cells)}</tr>'
            for name, *cells in table[1:]
        )
        parts.append(f"<table><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table>")
    if advice:
        parts.append(f'<section class="advice"><h2>Advice</h2><ul>{warned}</ul></section>')
    parts += [_figure_html(name, figure) for name, figure in figures]
    parts += ["<h2>Notes</h2>"] * bool(notes) + [f"<p>{escape(text)}</p>" for text in notes]
    body = "\n".join(parts)
    page = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head>\n<body><main>\n{body}\n</main></body></html>\n"
    )
    files.replace(path, page.encode())


def _figure_html(title: str, figure: Figure) -> str:
    content = base64.b64encode(plots.figure_bytes(figure)).decode()
    least, most = (round(figure.get_figwidth() * scale) for scale in CSS_PIXELS_PER_INCH)
    return (
        f'<h2>{escape(title)}</h2><figure><img alt="{escape(title)}" style="min-width:{least}px;max-width:{most}px" '
        f'src="data:image/png;base64,{content}"></figure>'
    )


STYLE = """
:root{color-scheme:light dark;--ink:#1c1c22;--muted:#63636d;--line:#e2e2e8;--paper:#fff;--warm:#fdf5e6;--edge:#d9a441}
@media(prefers-color-scheme:dark){
:root{--ink:#ececf1;--muted:#a2a2ad;--line:#34343d;--paper:#17171b;--warm:#2b2416;--edge:#b8860b}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:1rem/1.5 system-ui,sans-serif;overflow-wrap:anywhere}
main{max-width:76rem;margin:0 auto;padding:1.5rem 1rem 3rem}
h1{font-size:1.6rem;line-height:1.2;margin:0 0 1rem}
h2{font-size:1.1rem;margin:2rem 0 .6rem}
dl{display:grid;grid-template-columns:repeat(auto-fill,minmax(10rem,1fr));gap:.8rem 1.5rem;margin:0}
dl>div{border-top:1px solid var(--line);padding-top:.4rem}
dt{color:var(--muted);font-size:.85rem}
dd{margin:0;font-variant-numeric:tabular-nums}
table{border-collapse:collapse;width:100%;margin-top:1.5rem;font-size:.9rem}
th,td{text-align:left;vertical-align:top;padding:.35rem .6rem .35rem 0;border-bottom:1px solid var(--line)}
th{font-weight:600}
td{font-variant-numeric:tabular-nums}
.advice{background:var(--warm);border-left:4px solid var(--edge);border-radius:4px;padding:.8rem 1rem;margin-top:1.5rem}
.advice h2{margin:0}
.advice ul{margin:.4rem 0 0;padding-left:1.1rem}
figure{margin:0;background:#fff;border:1px solid var(--line);border-radius:8px;overflow-x:auto}
img{display:block;width:100%;height:auto}
p{max-width:44rem}
"""
