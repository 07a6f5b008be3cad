"""Point spread functions over wavelength and distance, with their MTF and encircled energy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
import scipy
import torch
from matplotlib.figure import Figure
from torch import Tensor

from kcam import optics, spectral
from kcam.optics.source import Points
from kcam.plots.pictures import light_colours
from kcam.plots.sheet import INK, LABEL, MUTED, SMALL, TITLE, Sheet, draw_lines, metres, percent_or_more, quiet
from kcam.scene import Scene
from kcam.units import nm, um


def psf_image(psf: Tensor, colour: np.ndarray) -> np.ndarray:
    """A PSF (H,W) in the colour of its light, (H,W,3): scaled to its own peak, its square root shown.

    Example:
    >>> plots.psf_image(torch.rand(5, 7), plots.light_colours(torch.tensor([550 * nm]))[0]).shape
    (5, 7, 3)
    """
    return _square_root(psf[..., None].numpy() * colour**2.2)


def _square_root(image: np.ndarray) -> np.ndarray:
    return np.sqrt(image / max(image.max(), 1e-30)) ** (1 / 1.1)


_PSF_WAVELENGTHS = (450 * nm, 550 * nm, 650 * nm)
_LARGEST_PSF = 255  # pixels
SHARE_SHOWN = 0.97
"""Of the light of each PSF in its window of 255 pixels: what the panels of a PSF figure hold of it at least."""
CURVE_COLOURS = ("#c8553d", "#1c1c22", "#2a9d8f", "#3f6fd8", "#8f5fbf", "#b8860b")
"""Of curves by distance, the first ones: see `distance_colours`."""


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

    Example:
    >>> lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(20 * mm), focus_distance=2.0)
    >>> figure = plots.psf_figure(lens, distances=[1.0, 2.0], wavelengths=[550 * nm])
    >>> len(figure.axes)
    6
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
    smooth = scipy.interpolate.PchipInterpolator(radii.double().numpy(), light.double().numpy(), axis=1)(between)
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
    """The lens and its pixels in a line.

    Example:
    >>> plots.optics_text(Camera.phone()[0])
    'Focal length 4.3 mm, f/1.8, in focus at 2 m;  pixels of 1.4 µm'
    """
    lens, pixels = imaging.lens, f"pixels of {float(imaging.pixel_pitch) / um:.3g} \u00b5m"
    if not isinstance(lens, (optics.Lens, optics.CompoundLens)):
        return f"{type(lens).__name__};  {pixels}"
    return (
        f"Focal length {float(lens.focal_length()) * 1e3:.3g} mm, f/{float(lens.f_number):.2g}, "
        f"in focus at {metres(lens.focus_distance)};  {pixels}"
    )


def distance_colours(count: int) -> list[Any]:
    """A colour for each of so many curves, no two alike: a few by name, more along a scale.

    Example:
    >>> len(plots.distance_colours(9)), plots.distance_colours(2)
    (9, ['#c8553d', '#1c1c22'])
    """
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


def reach_of(psf: Tensor, *, share: float) -> int:
    """Half the width of the square around the origin that holds this share of every PSF's light in its window [pixels].

    6 at least, as far as the window goes.

    Example:
    >>> psf = torch.zeros(1, 1, 33, 33)
    >>> psf[..., 8:25, 8:25] = 1 / 17**2  # a blur of 17 x 17 pixels
    >>> plots.reach_of(psf, share=0.99)
    8
    """
    height, width = psf.shape[-2:]
    for reach in range(6, min(height, width) // 2):
        inside = centre(psf, reach).sum((-2, -1)) / psf.sum((-2, -1)).clamp(min=1e-30)
        if bool((inside >= share).all()):
            return reach
    return (min(height, width) - 1) // 2


def centre(psf: Tensor, reach: int) -> Tensor:
    """The square around the origin of PSFs (..., H, W), 2 * reach + 1 pixels wide.

    Example:
    >>> psf = torch.arange(25.0).view(1, 1, 5, 5)
    >>> plots.centre(psf, 1).shape, float(plots.centre(psf, 0))  # the origin is at n // 2
    (torch.Size([1, 1, 3, 3]), 12.0)
    """
    row, column = (size // 2 for size in psf.shape[-2:])
    return psf[..., row - reach : row + reach + 1, column - reach : column + reach + 1]


@dataclass(frozen=True)
class PSFRow:
    """PSFs (L,h,w) of a point, as they lie in the picture, at wavelengths (L,) [m]."""

    label: str
    psfs: Tensor
    wavelengths: Tensor


def psf_rows(imaging: optics.Imaging, scene: Scene) -> list[PSFRow]:
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
    return [PSFRow(label, psf, wavelengths) for label, psf in zip(labels, found, strict=False)]


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


def draw_psfs(sheet: Sheet, rows: Sequence[PSFRow], left: float, top: float) -> None:
    """Three of each row, side by side."""
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
