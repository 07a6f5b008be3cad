"""Figures of pictures and PSFs, drawn with matplotlib's object interface, so that nothing global changes."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from scipy.interpolate import PchipInterpolator
from torch import Tensor
from torch.nn import functional as F

from kcam import files, optics, sensor, spectral
from kcam.inputs import check_picture
from kcam.sensor.mosaic import pattern_tile
from kcam.tradeoff import Row, Sweep, front
from kcam.units import nm, um

INK, MUTED, FAINT = "#1c1c22", "#75757f", "#e2e2e8"
TITLE, LABEL, SMALL = 15.0, 10.0, 8.5
CHANNEL_COLOURS = ((1.0, 0.18, 0.12), (0.2, 0.9, 0.25), (0.2, 0.35, 1.0), (1.0, 1.0, 1.0))
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
FIGURE_SUFFIXES = (".png", ".pdf", ".svg", ".jpg")


def check_writable(path: str | os.PathLike[str], *, suffixes: Sequence[str] = PICTURE_SUFFIXES) -> None:
    """Fail before the work and not after it: ValueError for a suffix that cannot be written, or no place for it."""
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"path must be the name of a file, got {type(path).__name__}. The picture comes first.")
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"cannot write {path.name}: its name must end in one of {', '.join(suffixes)}.")
    files.check_place(path)


def write_picture(picture: Tensor, path: str | os.PathLike[str], *, quality: int = 95) -> None:
    """Write a picture (3,H,W) or (1,H,W) in [0,1] as 8 bits; the suffix names the format.

    One plane is written as one, and in a TIFF, where it is a raw signal as often as a picture, with 16 bits. Highlights
    and colours a little outside are clipped; the file is whole or not there.

    Raises:    as `check_writable`; TypeError, ValueError for another shape, NaN, or values beyond -1..2.
    """
    check_writable(path)
    check_picture(picture, name="picture", ndims=(3,), within=(-1.0, 2.0))
    image = as_image(picture)
    suffix = Path(path).suffix.lower()
    options: dict[str, Any] = {"quality": quality} if suffix in {".jpg", ".jpeg", ".webp"} else {}
    content = io.BytesIO()
    if len(picture) == 1:
        image = image[..., 0]
    deep = len(picture) == 1 and suffix in {".tif", ".tiff"}
    values = image.astype(np.float64) * (65535 if deep else 255)
    pixels = Image.fromarray(values.round().astype(np.uint16 if deep else np.uint8))
    pixels.save(content, format=Image.registered_extensions()[suffix], **options)
    files.replace(path, content.getvalue())


def save_figure(figure: Figure, path: str | os.PathLike[str], *, resolution: float = 144) -> None:
    """Write a figure at `resolution` dots per inch; ValueError as in `check_writable`."""
    check_writable(path, suffixes=FIGURE_SUFFIXES)
    files.replace(path, figure_bytes(figure, resolution=resolution, format=Path(path).suffix.lower()[1:]))


def figure_bytes(figure: Figure, *, resolution: float = 144, format: str = "png") -> bytes:
    """A figure as the content of a file, at `resolution` dots per inch."""
    content = io.BytesIO()
    figure.savefig(content, dpi=resolution, facecolor="white", format=format)
    return content.getvalue()


def as_image(picture: Tensor) -> np.ndarray:
    """A picture (C,H,W), C = 1 or 3, as an array (H,W,3) in [0,1]. Raises: TypeError, ValueError for what is none."""
    check_picture(picture, name="picture", ndims=(3,), within=None)
    image = picture.detach().float().clamp(0, 1).cpu().nan_to_num()
    return image.expand(3, -1, -1).permute(1, 2, 0).numpy()


def psf_image(psf: Tensor, colour: np.ndarray) -> np.ndarray:
    """A PSF (H,W) in the colour of its light, (H,W,3): scaled to its own peak, its square root shown."""
    return _square_root(psf[..., None].numpy() * colour**2.2)


def _square_root(image: np.ndarray) -> np.ndarray:
    return np.sqrt(image / max(image.max(), 1e-30)) ** (1 / 1.1)


def light_colours(wavelengths: Tensor) -> np.ndarray:
    """A colour for each wavelength, (L,3) sRGB in [0,1]: as the CIE 1931 observer sees it, as pure as a screen can.

    Light that nobody sees is white.
    """
    seen = spectral.observer(wavelengths).double()
    linear = seen @ spectral.xyz_to_srgb_matrix().T
    linear = linear - linear.amin(-1, keepdim=True).clamp(max=0)  # the least white that makes it a real colour
    return _pure(torch.where(seen.sum(-1, keepdim=True) > 0, linear, 1.0))


def _pure(linear: Tensor) -> np.ndarray:
    """Linear sRGB (..., 3) at full brightness, coded."""
    return ((linear / linear.amax(-1, keepdim=True).clamp(min=1e-9)) ** (1 / 2.2)).numpy()


def mosaic_tile(camera: Any) -> np.ndarray:
    """The colours of a camera's filter tile, (rows, columns, 3): the mosaic's pattern, or the learned tile's own."""
    filters = [stage for stage in camera if isinstance(stage, sensor.ColourFilter)]
    if filters and filters[0].is_tile:
        wavelengths = torch.linspace(420, 720, 61, dtype=torch.float64) * nm
        curves = (filters[0].alpha().double() @ filters[0].basis(wavelengths)).detach().cpu()
        return _pure((curves @ spectral.observer(wavelengths).double() @ spectral.xyz_to_srgb_matrix().T).clamp(min=0))
    mosaics = [stage for stage in camera if isinstance(stage, sensor.Mosaic)]
    if not mosaics:
        return np.ones((1, 1, 3))
    return np.asarray(CHANNEL_COLOURS)[pattern_tile(mosaics[0].pattern).numpy()]


def false_colour(raw: Tensor, tile: np.ndarray) -> np.ndarray:
    """A raw plane (1,H,W) with each pixel in the colour of its filter, (H,W,3), bright enough for a screen."""
    plane = raw[0].detach().float().clamp(0, 1).cpu()
    plane = (plane / plane.amax().clamp(min=1e-6)) ** (1 / 2.2)
    rows, columns, _ = tile.shape
    height, width = plane.shape
    colours = np.tile(tile, (-(-height // rows), -(-width // columns), 1))[:height, :width]
    return np.clip(plane.numpy()[..., None] * colours, 0, 1)


class Sheet:
    """A figure whose parts are placed in inches from its top left corner, so that nothing overlaps at any size."""

    def __init__(self, width: float, height: float) -> None:
        self.width, self.height = width, height
        self.figure = Figure(figsize=(width, height))

    def axes(self, left: float, top: float, width: float, height: float) -> Any:
        """Axes at a place in inches."""
        box = (left / self.width, 1 - (top + height) / self.height, width / self.width, height / self.height)
        return self.figure.add_axes(box)

    def text(self, left: float, top: float, text: str, *, size: float = LABEL, colour: str = INK, **style: Any) -> None:
        """Text whose top left corner is at a place in inches, unless `style` aligns it otherwise."""
        style = {"va": "top", "ha": "left"} | style
        self.figure.text(left / self.width, 1 - top / self.height, text, size=size, color=colour, **style)

    def picture(
        self, image: np.ndarray, left: float, top: float, width: float, height: float, *, smooth: bool = True
    ) -> Any:
        """A picture without axes."""
        axes = self.axes(left, top, width, height)
        axes.imshow(image, interpolation="antialiased" if smooth else "nearest", aspect="auto", vmin=0, vmax=1)
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
        return axes


def pipeline_figure(
    *,
    scene: Tensor,
    raw: Tensor,
    picture: Tensor,
    tile: np.ndarray,
    times: Sequence[tuple[str, float]],
    title: str,
    subtitle: str,
    zoom: tuple[float, float] = (0.5, 0.5),
    zoom_size: int = 56,
) -> Figure:
    """From scene to picture: both, the raw mosaic between them, a detail of each, and the time that each stage took.

    Args:      scene, picture: (3,H,W) sRGB.  raw: (1,H,W), its black level taken off.  tile: see `mosaic_tile`.
               times: (stage, seconds).
               zoom: centre of the detail as shares of the height and the width.  zoom_size: its width [pixels].
    """
    raw_colours = false_colour(raw, tile)
    panels = [
        ("Scene", as_image(scene)),
        ("Raw above black, in the filters' colours", _brightened(_mixed(raw_colours, len(tile)))),
        ("Picture", as_image(picture)),
    ]
    height, width = panels[0][1].shape[:2]
    side, gap, edge, head, caption = 3.5, 0.22, 0.4, 1.0, 0.3
    tall = side * height / width
    detail = side * 0.62
    rows = round(zoom_size * detail / side)
    y = int(np.clip(round(zoom[0] * height - rows / 2), 0, max(height - rows, 0)))
    x = int(np.clip(round(zoom[1] * width - zoom_size / 2), 0, max(width - zoom_size, 0)))

    bars = 3.1
    sheet = Sheet(2 * edge + 3 * side + 3 * gap + bars + 0.25, head + caption + tall + gap + detail + edge)
    sheet.text(edge, 0.32, title, size=TITLE, weight="bold")
    sheet.text(edge, 0.64, subtitle, colour=MUTED)
    for index, (label, image) in enumerate(panels):
        left, top = edge + index * (side + gap), head
        sheet.text(left, top, label, weight="bold")
        axes = sheet.picture(image, left, top + caption, side, tall)
        for line, colour in ((2.6, "black"), (1.2, "white")):
            axes.add_patch(
                matplotlib.patches.Rectangle((x - 0.5, y - 0.5), zoom_size, rows, fill=False, lw=line, ec=colour)
            )
        crop = (raw_colours if index == 1 else image)[y : y + rows, x : x + zoom_size]
        sheet.picture(crop, left, top + caption + tall + gap, side, detail, smooth=False)
    left = edge + 3 * (side + gap) + 0.25
    _time_bars(sheet, times, left=left, top=head, width=bars - edge / 2, height=caption + tall + gap + detail)
    return sheet.figure


def _mixed(image: np.ndarray, tile: int) -> np.ndarray:
    """The mean over a tile around each pixel: shown smaller than it is, a mosaic would make moire."""
    width = min(tile, 6)
    planes = F.pad(torch.from_numpy(image).permute(2, 0, 1), (0, width - 1, 0, width - 1), "replicate")
    return F.avg_pool2d(planes, width, stride=1).permute(1, 2, 0).numpy()


def _brightened(image: np.ndarray) -> np.ndarray:
    """Scaled so that all but its brightest hundredth keeps its colour: pixels of one colour are dark between others."""
    return np.clip(image / max(float(np.quantile(image, 0.99)), 1e-6), 0, 1)


def _time_bars(
    sheet: Sheet, times: Sequence[tuple[str, float]], *, left: float, top: float, width: float, height: float
) -> None:
    total = sum(seconds for _, seconds in times)
    sheet.text(left, top, f"Time of each stage, {duration(total)} in all", weight="bold")
    step = min((height - 0.3) / len(times), 0.52)
    longest = max(seconds for _, seconds in times)
    for index, (name, seconds) in enumerate(times):
        line = top + 0.36 + index * step
        sheet.text(left, line, name, size=SMALL + 0.5)
        sheet.text(left + width, line, duration(seconds), size=SMALL + 0.5, colour=MUTED, ha="right")
        axes = sheet.axes(left, line + 0.2, width, 0.07)
        axes.set(xlim=(0, 1), ylim=(0, 1))
        axes.axis("off")
        axes.barh(0.5, 1, height=1, color=FAINT)
        axes.barh(0.5, seconds / longest, height=1, color="#3f6fd8")


def duration(seconds: float) -> str:
    """A time for people, from milliseconds to days: three figures at most."""
    for unit, size in (("days", 86_400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {unit}"
    if seconds >= 0.9995:
        return f"{seconds:.3g} s" if seconds < 100 else f"{seconds:.0f} s"
    return f"{seconds * 1e3:.0f} ms" if seconds >= 0.01 else f"{seconds * 1e3:.1f} ms"


SHARE_SHOWN = 0.97
"""Of the light of each PSF in its window of 255 pixels: what the panels of a PSF figure hold of it at least."""

CURVE_COLOURS = ("#c8553d", "#1c1c22", "#2a9d8f", "#3f6fd8", "#8f5fbf", "#b8860b")


def psf_figure(
    imaging: optics.Imaging | optics.Lens,
    *,
    distances: Sequence[float] | None = None,
    wavelengths: Sequence[float] | None = None,
    title: str = "Point spread functions",
) -> Figure:
    """PSFs over wavelength and distance, in the colour of their light, beside the MTF and the encircled energy.

    Each PSF is scaled to its own peak, and its square root is shown, so that a hundredth of the peak is still visible.

    Args:      imaging: an Imaging stage; a Lens is drawn on its default pixels, of 4 um.
               distances: [m], inf allowed; None for 0.4 times the focus, the focus, 2.5 times that, and infinity.
               wavelengths: [m]; None for 450, 500, 550, 600 and 650 nm.
    Raises:    TypeError for what is neither.
    """
    if isinstance(imaging, optics.Lens):
        imaging = optics.Imaging(imaging)
    if not isinstance(imaging, optics.Imaging):
        fix = " Use camera[0], where its optics stand." if hasattr(imaging, "stages") else ""
        raise TypeError(f"a PSF figure is of an optics.Imaging or a Lens, got {type(imaging).__name__}.{fix}")
    lens, pitch = imaging.computed_lens(by="a PSF figure"), float(imaging.pixel_pitch)
    focus = lens.focus_distance
    if distances is None:
        distances = [1.0, 3.0, 10.0, math.inf] if not 0 < focus < 1e3 else [0.4 * focus, focus, 2.5 * focus, math.inf]
    colours_at = torch.tensor(wavelengths or [450 * nm, 500 * nm, 550 * nm, 600 * nm, 650 * nm], dtype=torch.float64)
    bands = torch.linspace(420, 720, 28, dtype=torch.float64) * nm
    shape = imaging.accuracy.psf_shape or (255, 255)
    arguments: dict[str, Any] = {
        "distances": torch.tensor(distances, dtype=torch.float64),
        "pixel_pitch": pitch,
        "shape": tuple(shape),
        "propagator": imaging.accuracy.propagator,
        "method": imaging.accuracy.method,
    }
    psf = lens.psf(colours_at, fill_factor=imaging.fill_factor, **arguments).detach().double().cpu()
    reach = reach_of(psf, share=SHARE_SHOWN)
    window = {"shape": (2 * reach + 1, 2 * reach + 1)}
    daylight = lens.psf(bands, fill_factor=imaging.fill_factor, **(arguments | window)).detach().double().cpu()
    luminance = spectral.xyz_weights(bands, "D65")[:, 1]
    shares = [centre(psf, reach).sum((-2, -1)), daylight.sum((-2, -1)) @ luminance / luminance.sum()]
    least = min(float(share.min()) for share in shares)
    daylight = torch.einsum("dlhw,lc->dchw", daylight, spectral.xyz_weights(bands, "D65"))
    daylight = spectral.xyz_to_linear_srgb(daylight).clamp(min=0)
    lit = [light_colours(colours_at)[index] for index in range(len(colours_at))]
    cell, gap, edge, head, rim = 1.3, 0.07, 0.4, 1.6, 0.75
    columns = len(lit) + 1
    grid_width, grid_height = rim + columns * (cell + gap), len(distances) * (cell + gap) - gap
    beside = len(distances) > 2  # the curves stand beside a high grid and below a flat one
    plots_left = edge + grid_width + 0.95 if beside else edge + rim
    plots_top = head if beside else head + grid_height + 0.75
    plot_width = 4.2 if beside else max((grid_width - rim - gap - 0.85) / 2, 3.2)
    plot_height = max((grid_height - 0.85) / 2, 1.8) if beside else 2.2
    step = (0.0, plot_height + 0.85) if beside else (plot_width + 0.85, 0.0)
    sheet = Sheet(
        plots_left + plot_width + step[0] + edge, max(head + grid_height, plots_top + plot_height + step[1]) + 0.75
    )
    sheet.text(edge, 0.32, title, size=TITLE, weight="bold")
    sheet.text(
        edge,
        0.64,
        f"{optics_text(imaging)}\n"
        f"Panels: the middle {2 * reach + 1} of {min(shape)} pixels, with {percent_or_more(least)} of their light; "
        "each scaled to its own peak, square root shown",
        colour=MUTED,
        linespacing=1.4,
    )
    curve_colours = distance_colours(len(distances))
    for column in range(columns):
        name = f"{colours_at[column] / nm:.0f} nm" if column < len(lit) else "daylight"
        sheet.text(edge + rim + column * (cell + gap) + cell / 2, head - 0.24, name, ha="center")
    for row, distance in enumerate(distances):
        top = head + row * (cell + gap)
        sheet.text(
            edge + rim - 0.14, top + cell / 2, metres(distance), ha="right", va="center", colour=curve_colours[row]
        )
        for column in range(columns):
            if column < len(lit):
                image = psf_image(centre(psf[row, column], reach), lit[column])
            else:
                image = _square_root(daylight[row].permute(1, 2, 0).numpy())
            sheet.picture(image, edge + rim + column * (cell + gap), top, cell, cell, smooth=False)
    middle = colours_at[len(colours_at) // 2]
    contrast, energy = (
        sheet.axes(plots_left + index * step[0], plots_top + index * step[1], plot_width, plot_height)
        for index in (0, 1)
    )
    frequencies, mtf = _mtf(imaging, arguments, wavelength=float(middle))
    count = min(40, int(reach * pitch / (0.2 * um)))  # much finer than the light itself
    radii = torch.linspace(0, reach * pitch, count + 1)
    disc = {"pixel_pitch": reach * pitch / count, "shape": (2 * count + 1, 2 * count + 1)}
    light = lens.encircled_energy(middle[None], **(arguments | disc))[:, 0].detach().cpu()
    between = np.linspace(0, reach * pitch, 401)  # a monotone cubic through the radii: a few of them make corners
    smooth = PchipInterpolator(radii.double().numpy(), light.double().numpy(), axis=1)(between)
    for index, distance in enumerate(distances):
        style = {"color": curve_colours[index], "lw": 1.6, "label": metres(distance)}
        contrast.plot(frequencies / 1e3, mtf[index], **style)
        energy.plot(between / um, smooth[index], **style)
    name = f"{middle / nm:.0f} nm"
    _finish(
        contrast,
        title=f"MTF at {name}, of lens and pixel",
        label="line pairs per mm, up to the pixels' limit",
        end=0.5 / pitch / 1e3,
    )
    _finish(
        energy,
        title=f"Light within a radius, {name}",
        label="radius [\u00b5m], up to the panels' edge",
        end=reach * pitch / um,
    )
    contrast.legend(frameon=False, fontsize=SMALL, labelcolor=INK, ncols=1 if len(distances) <= 6 else 2)
    return sheet.figure


def optics_text(imaging: optics.Imaging) -> str:
    """The lens and its pixels in a line."""
    lens, pixels = imaging.lens, f"pixels of {float(imaging.pixel_pitch) / um:.3g} \u00b5m"
    if not isinstance(lens, optics.Lens):
        return f"{type(lens).__name__};  {pixels}"
    return (
        f"Focal length {lens.focal_length() * 1e3:.3g} mm, f/{lens.f_number:.2g}, "
        f"in focus at {metres(lens.focus_distance)};  {pixels}"
    )


def distance_colours(count: int) -> list[Any]:
    """A colour for each of so many curves, no two alike: a few by name, more along a scale."""
    if count <= len(CURVE_COLOURS):
        return list(CURVE_COLOURS[:count])
    scale = matplotlib.colormaps["turbo"](np.linspace(0.05, 0.95, count))[:, :3]
    return list(scale * 0.85)  # its yellow is too bright for text on white


def _mtf(imaging: optics.Imaging, arguments: dict[str, Any], *, wavelength: float) -> tuple[Tensor, Tensor]:
    """Frequencies [1/m] up to the pixels' limit, and at each distance the contrast of optics and pixel."""
    height, width = arguments["shape"]
    lens = imaging.computed_lens(by="an MTF")
    mtf = lens.mtf([wavelength], **arguments)[:, 0, height // 2, width // 2 :].detach().double().cpu()
    return torch.arange(mtf.shape[-1], dtype=torch.float64) / (width * float(imaging.pixel_pitch)), mtf


def _finish(axes: Any, *, title: str, label: str, end: float) -> None:
    axes.set(xlim=(0, end), ylim=(0, 1.02), xlabel=label)
    axes.set_title(title, size=LABEL, weight="bold", loc="left", color=INK)
    quiet(axes)


def quiet(axes: Any) -> None:
    """Axes that stand back behind their curves: a faint grid, two spines, small ticks."""
    axes.grid(color=FAINT, lw=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED)
    axes.tick_params(labelsize=SMALL, colors=MUTED, length=3, which="both")
    axes.xaxis.label.set(size=SMALL + 0.5, color=MUTED)


def reach_of(psf: Tensor, *, share: float) -> int:
    """Half the width of the square around the origin that holds this share of every PSF's light in its window."""
    height, width = psf.shape[-2:]
    for reach in range(6, min(height, width) // 2):
        inside = centre(psf, reach).sum((-2, -1)) / psf.sum((-2, -1)).clamp(min=1e-30)
        if bool((inside >= share).all()):
            return reach
    return (min(height, width) - 1) // 2


def centre(psf: Tensor, reach: int) -> Tensor:
    """The square around the origin of PSFs (..., H, W), 2 * reach + 1 pixels wide."""
    row, column = (size // 2 for size in psf.shape[-2:])
    return psf[..., row - reach : row + reach + 1, column - reach : column + reach + 1]


def percent_or_more(share: float) -> str:
    """A share that is not less than the text says: "97% or more", "less than 1%"."""
    return f"{math.floor(100 * min(share, 1.0))}% or more" if share >= 0.01 else "less than 1%"


def metres(distance: float) -> str:
    """A distance for people."""
    if math.isinf(distance):
        return "infinity"
    return f"{distance:.3g} m" if distance >= 1 else f"{distance * 100:.3g} cm"


KNOB_COLOURS = {
    "propagator": "#3f6fd8",
    "samples": "#1f9bb5",
    "precision": "#8f5fbf",
    "wavelengths": "#c8553d",
    "depth": "#2a9d5f",
    "support": "#c98a00",
    "pixels": "#d0478f",
    "rank": "#7a5230",
}


def tradeoff_figure(result: Sweep) -> Figure:
    """Error against time, log-log: of the raw, and of the PSFs; the front of each drawn, each point labelled.

    Filled marks were timed on whole pictures, open ones on a few of their PSFs. An error too small for the axis stands
    on its lower edge as a triangle.
    """
    edge, head, width, height, gap = 0.75, 1.55, 8.2, 4.9, 0.95
    sheet = Sheet(edge + width + 0.25, head + 2 * height + gap + 0.6)
    sheet.text(edge, 0.2, result.title, size=TITLE, weight="bold")
    about = f"{result.scene};  one thread of {str(result.environment.get('machine', 'this machine')).split(', ')[-1]}"
    sheet.text(edge, 0.52, about, size=SMALL, colour=MUTED)
    knobs = [name for name in KNOB_COLOURS if any(row.knob == name for row in result.rows)]
    entries = [("as it is", INK), *((name, KNOB_COLOURS[name]) for name in knobs), ("baselines", MUTED)]
    left = edge
    for name, colour in entries:
        sheet.text(left, 0.82, "\u25cf", colour=colour, size=LABEL)
        sheet.text(left + 0.15, 0.83, name, size=SMALL)
        left += 0.3 + 0.069 * len(name)
    for index, (error, title) in enumerate(
        (("raw_rms", "Error of the noiseless raw, relative RMS"), ("psf_l1", "Error of the PSFs, median L1"))
    ):
        axes = sheet.axes(edge, head + index * (height + gap), width, height)
        axes.set_title(f"{title}, against the time of a picture", size=LABEL, weight="bold", loc="left", color=INK)
        _draw_tradeoff(axes, result.rows, error)
    return sheet.figure


def _draw_tradeoff(axes: Any, rows: Sequence[Row], error: str) -> None:
    points = [
        (row, row.seconds, value)
        for row, value in ((row, getattr(row, error)) for row in rows)
        if row.seconds is not None and value is not None
    ]
    axes.set(xscale="log", yscale="log", xlabel="CPU seconds of a picture with new optics")
    quiet(axes)
    if not points:
        return
    seen = [value for _, _, value in points if value > 1e-9] or [1.0]
    floor = min(seen) / 6
    times = [seconds for _, seconds, _ in points]
    axes.set(xlim=(min(times) / 1.8, max(times) * 2.5), ylim=(floor / 1.6, max(seen) * 4))
    best = front(rows, error)
    on_front = [(seconds, max(value, floor)) for row in best for own, seconds, value in points if own is row]
    corners = on_front[:1]
    for seconds, value in on_front[1:]:
        corners += [(seconds, corners[-1][1]), (seconds, value)]
    corners.append((max(times) * 2.5, corners[-1][1]))
    axes.plot(*zip(*corners, strict=True), color=INK, lw=1.1, alpha=0.35, zorder=1)
    labels = []
    for row, seconds, value in points:
        colour = INK if row.default else MUTED if row.baseline else KNOB_COLOURS.get(row.knob, INK)
        axes.plot(
            seconds,
            max(value, floor),
            marker="v" if value < floor else "D" if row.default else "o",
            ms=7 if row.default else 5.5,
            mec=colour,
            mfc="white" if row.share < 1 else colour,
            ls="",
            zorder=3,
        )
        name = row.name.removeprefix("nonparaxial ") if row.knob == "propagator" else row.name
        labels.append((name, seconds, max(value, floor), colour, row in best or row.default))
    _place_labels(axes, labels, corners)


def _place_labels(
    axes: Any, labels: Sequence[tuple[str, float, float, str, bool]], path: Sequence[tuple[float, float]]
) -> None:
    """Write (text, x, y, colour, bold) beside its point, at the nearest place that is free of points, other labels and
    a path.
    """
    figure = axes.figure
    renderer = FigureCanvasAgg(figure).get_renderer()
    scale = figure.dpi / 72
    frame = axes.get_window_extent(renderer)
    points = axes.transData.transform([(x, y) for _, x, y, _, _ in labels])
    corners = axes.transData.transform(path)
    drawn = np.concatenate([np.linspace(a, b, 200) for a, b in pairwise(corners)])
    taken: list[tuple[float, float, float, float]] = []  # boxes: left, bottom, right, top
    lines: list[np.ndarray] = []

    def inside(box: tuple[float, float, float, float], places: np.ndarray) -> int:
        left, bottom, right, top = box
        x, y = places.T
        return int(((x > left) & (x < right) & (y > bottom) & (y < top)).sum())

    order = sorted(range(len(labels)), key=lambda i: (not labels[i][4], points[i][0]))  # bold ones choose first
    for index in order:
        text, _, _, colour, bold = labels[index]
        style = {"size": SMALL - 1, "color": colour, "weight": "bold" if bold else "normal"}
        probe = axes.text(0, 0, text, **style)
        extent = probe.get_window_extent(renderer)
        probe.remove()
        wide, high = extent.width * 1.04, extent.height * 0.85  # hinting makes text wider at other resolutions
        choices = []
        for radius in (7, 11, 17, 25, 34, 45, 58, 74, 92, 112, 135):
            for step in range(24):
                angle = 2 * math.pi * step / 24
                dx, dy = radius * scale * math.cos(angle), radius * scale * math.sin(angle)
                left = points[index][0] + dx - wide * (0.5 - 0.5 * math.cos(angle))
                bottom = points[index][1] + dy - high * (0.5 - 0.5 * math.sin(angle))
                box = (left - 1.5, bottom - 1, left + wide + 1.5, bottom + high + 1)
                line = np.linspace(points[index], points[index] + (dx, dy), 16)
                out = box[0] < frame.x0 or box[1] < frame.y0 or box[2] > frame.x1 or box[3] > frame.y1
                clash = sum(box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in taken)
                around = (box[0] - 4 * scale, box[1] - 3.5 * scale, box[2] + 4 * scale, box[3] + 3.5 * scale)
                covered = inside(around, points)
                struck = sum(inside(b, line) > 0 for b in taken) + sum(inside(box, own) > 0 for own in lines)
                struck += inside(box, drawn) > 0
                sideways = 0 if abs(dy) < 0.5 * abs(dx) else 2  # a label beside its point reads best
                choices.append((1e4 * out + 1e3 * clash + 300 * covered + 150 * struck + radius + sideways, box, line))
            if min(choices, key=lambda choice: choice[0])[0] < radius + 3:
                break  # farther away it can only be worse
        _, box, line = min(choices, key=lambda choice: choice[0])
        taken.append(box)
        lines.append(line)
        where = axes.transData.inverted().transform((box[0] + 1.5, box[1] + 1))
        axes.text(*where, text, va="bottom", ha="left", zorder=4, **style)
        if np.hypot(*(line[-1] - line[0])) > 12 * scale:
            axes.plot(*axes.transData.inverted().transform(line[[0, -1]]).T, color=colour, lw=0.5, alpha=0.7, zorder=2)


def contact_sheet(rows: Sequence[Sequence[Tensor]], *, titles: Sequence[str], labels: Sequence[str]) -> Figure:
    """Pictures (3,H,W) in rows; all in a row have one shape.

    Args:      rows: pictures.  titles: one per column.  labels: one per row.
    """
    side, gap, edge, head = 3.6, 0.12, 0.35, 0.75
    heights = [side * row[0].shape[-2] / row[0].shape[-1] for row in rows]
    columns = len(titles)
    sheet = Sheet(2 * edge + columns * (side + gap) - gap, head + sum(heights) + len(rows) * 0.34 + edge / 2)
    for index, title in enumerate(titles):
        sheet.text(edge + index * (side + gap), 0.35, title, size=TITLE - 2, weight="bold")
    top = head
    for row, label, height in zip(rows, labels, heights, strict=True):
        for index, picture in enumerate(row):
            sheet.picture(as_image(picture), edge + index * (side + gap), top, side, height)
        sheet.text(edge, top + height + 0.07, label, size=SMALL, colour=MUTED)
        top += height + 0.34
    return sheet.figure
