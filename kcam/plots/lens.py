"""Real lenses: in section, and what they do to points over their field."""

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

from kcam.optics import CompoundLens
from kcam.optics.compound.analysis import SPECTRAL_LINES, FieldCurves
from kcam.optics.compound.spots import rms_radius
from kcam.optics.numerics import Scalar, float64
from kcam.plots.pictures import light_colours
from kcam.plots.psf import CURVE_COLOURS
from kcam.plots.sheet import FAINT, INK, LABEL, MUTED, SMALL, TITLE, Sheet, metres, quiet
from kcam.units import mm, nm, um, wavelength_grid

GLASS_COLOUR = "#dde8f4"
FIELDS_IN_SECTION = (0.0, 0.7, 1.0)
"""Of the field's edge: points whose rays are drawn."""
FIELDS_IN_ROWS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Of the field's edge: points whose spots and wavefronts are drawn."""
_EDGE, _HEAD, _CELL, _GAP, _ROW = 0.5, 1.3, 2.1, 0.52, 0.55  # inches
_WIDTH = 5 * _CELL + 4 * _GAP
_HIGHEST = 4.0  # inches of a section
_TEXT_WIDTH = 4.6  # inches of `lens_text`
_SAMPLES = 49  # across the stop


@dataclass(frozen=True)
class _Section:
    """A lens in the plane of its axis [mm]: surfaces (z, y) from edge to edge, rays (F, N, K + 3, 2), where the sensor
    stands, and how much of both is drawn.
    """

    surfaces: list[np.ndarray]
    rays: np.ndarray
    sensor: float
    limits: tuple[float, float, float, float]

    def size(self, width: float) -> tuple[float, float]:
        """Inches for as wide a drawing as fits, in one scale along and across."""
        left, right, low, high = self.limits
        tall = min(width * (high - low) / (right - left), _HIGHEST)
        return tall * (right - left) / (high - low), tall


def section_figure(
    lens: CompoundLens,
    *,
    heights: Sequence[float] | None = None,
    distance: float = math.inf,
    title: str = "Lens in section",
) -> Figure:
    """Surfaces, glass and stop of a lens in the plane of its axis, with rays of points of its field.

    Args:      heights: of object points, Y / D; None for 0, 0.7 and 1 times the edge of the field.
               distance: of those points [m], inf allowed.
    Raises:    ValueError for a point of which no light passes.

    Example:
    >>> figure = plots.section_figure(optics.CompoundLens.preset("cooke_triplet"), heights=[0.0, 0.2])
    >>> len(figure.axes)
    1
    """
    up = _chosen(lens, heights, FIELDS_IN_SECTION, distance)
    section = _section(lens, up, distance)
    width, tall = section.size(_WIDTH)
    sheet = Sheet(2 * _EDGE + max(width, 9.0), _HEAD + tall + 0.3)
    _heading(sheet, lens, title, distance)
    _draw_section(sheet, lens, section, up, top=_HEAD)
    return sheet.figure


def spot_figure(
    lens: CompoundLens,
    *,
    heights: Sequence[float] | None = None,
    distance: float = math.inf,
    wavelengths: Sequence[float] | None = None,
    title: str = "Spots",
) -> Figure:
    """Where rays land about the chief ray of the focus wavelength, in the colours of their light; a box for each point.

    Args:      heights: of object points, Y / D, up to 5; None for five up to the edge of the field.
               wavelengths: [m]; None for `SPECTRAL_LINES`. distance: as of `section_figure`.

    Example:
    >>> lens = optics.CompoundLens.preset("cooke_triplet", focus_distance=2.0)
    >>> figure = plots.spot_figure(lens, heights=[0.0, 0.2], distance=2.0)
    >>> len(figure.axes)
    2
    """
    sheet = Sheet(2 * _EDGE + _WIDTH, _HEAD + _CELL + 0.95)
    _heading(sheet, lens, title, distance)
    _draw_spots(sheet, lens, _chosen(lens, heights, FIELDS_IN_ROWS, distance), distance, _colours(wavelengths), _HEAD)
    return sheet.figure


def opd_figure(
    lens: CompoundLens,
    *,
    heights: Sequence[float] | None = None,
    distance: float = math.inf,
    wavelengths: Sequence[float] | None = None,
    title: str = "Wavefronts",
) -> Figure:
    """Wavefronts over the stop at the middle wavelength, and their fans at all, on the sphere about the chief ray.

    Args:      as of `spot_figure`.

    Example:
    >>> lens = optics.CompoundLens.preset("cooke_triplet", focus_distance=2.0)
    >>> figure = plots.opd_figure(lens, heights=[0.0, 0.2], distance=2.0)
    >>> len(figure.axes)
    4
    """
    sheet = Sheet(2 * _EDGE + _WIDTH, _HEAD + 2 * _CELL + 2 * _ROW + 0.75)
    _heading(sheet, lens, title, distance)
    up = _chosen(lens, heights, FIELDS_IN_ROWS, distance)
    _draw_wavefronts(sheet, lens, up, distance, _colours(wavelengths), _HEAD)
    return sheet.figure


def field_figure(lens: CompoundLens, curves: FieldCurves, *, title: str = "Over the field") -> Figure:
    """Relative illumination, distortion, lateral colour, spot size and MTF over the image height.

    Args:      curves: of `lens.field_curves(...)`.

    Example:
    >>> lens = optics.CompoundLens.preset("cooke_triplet")
    >>> figure = plots.field_figure(lens, lens.field_curves([0.0, 0.2]))
    >>> len(figure.axes)
    5
    """
    sheet = Sheet(2 * _EDGE + _WIDTH, _HEAD + _CELL + 0.95)
    _heading(sheet, lens, title)
    _draw_curves(sheet, curves, _HEAD)
    return sheet.figure


def lens_figure(
    lens: CompoundLens,
    curves: FieldCurves,
    *,
    distance: float = math.inf,
    title: str = "A lens",
) -> Figure:
    """Section, spots, wavefronts and field curves of a lens on one sheet, up to the last height of the curves.

    Args:      curves: of `lens.field_curves(...)`. distance: of the object [m], inf allowed.

    Example:
    >>> lens = optics.CompoundLens.preset("cooke_triplet")
    >>> figure = plots.lens_figure(lens, lens.field_curves([0.0, 0.2]), title="A Cooke triplet")
    >>> len(figure.axes)
    21
    """
    edge = float(curves.heights[-1])
    up, rows = ([edge * share for share in shares] for shares in (FIELDS_IN_SECTION, FIELDS_IN_ROWS))
    section = _section(lens, up, distance)
    tops = [_HEAD]
    for tall in (section.size(_WIDTH)[1] + 0.2, _CELL + 0.4, 2 * _CELL + 1.45, _CELL + 0.15):
        tops.append(tops[-1] + tall + _ROW)
    sheet = Sheet(2 * _EDGE + _WIDTH, tops[-1])
    _heading(sheet, lens, title, distance)
    _draw_section(sheet, lens, section, up, top=tops[0])
    _draw_spots(sheet, lens, rows, distance, curves.wavelengths, tops[1])
    _draw_wavefronts(sheet, lens, rows, distance, curves.wavelengths, tops[2])
    _draw_curves(sheet, curves, tops[3])
    return sheet.figure


def _chosen(
    lens: CompoundLens, heights: Sequence[float] | None, shares: Sequence[float], distance: float
) -> list[float]:
    if heights is not None:
        if not 1 <= len(heights) <= len(FIELDS_IN_ROWS):
            raise ValueError(f"a figure has 1 to {len(FIELDS_IN_ROWS)} heights, got {len(heights)}.")
        return [float(height) for height in heights]
    edge = lens.field_limit(distance=distance)
    return [edge * share for share in shares]


def _number(value: Scalar) -> float:
    """Of a lens, also where it trains."""
    return float(float64(value).detach())


def _colours(wavelengths: Sequence[float] | None) -> Tensor:
    return wavelength_grid(list(SPECTRAL_LINES if wavelengths is None else wavelengths))


def _points(heights: Sequence[float]) -> Tensor:
    return torch.tensor([[0.0, height] for height in heights], dtype=torch.float64)


def _heading(sheet: Sheet, lens: CompoundLens, title: str, distance: float | None = None) -> None:
    first = lens.first_order()
    where = "" if distance is None else f", object at {metres(distance)}"
    sheet.text(_EDGE, 0.3, title, size=TITLE, weight="bold")
    sheet.text(
        _EDGE,
        0.64,
        f"Focal length {_number(first.focal_length) / mm:.4g} mm, f/{lens.f_number:.3g}, "
        f"{len(lens.surfaces)} surfaces, sensor {_number(lens.sensor_distance) / mm:.4g} mm behind the last{where}",
        colour=MUTED,
    )


def lens_text(lens: CompoundLens) -> str:
    """Focal length, f-number, back focus and pupils at the focus wavelength, a line for each.

    Example:
    >>> print(plots.lens_text(optics.CompoundLens.preset("cooke_triplet")))
    focal length    50 mm at 550 nm
    f-number        f/4.32
    back focus      42.42 mm
    sensor          42.42 mm behind the last vertex
    entrance pupil  11.58 mm wide, 11.51 mm behind the first vertex
    exit pupil      11.85 mm wide, 8.754 mm before the last vertex
    """
    first, at = lens.first_order(), f"at {lens.focus_wavelength / nm:.0f} nm"
    sensor = _number(lens.sensor_distance)

    def length(value: float) -> str:
        return f"{value / mm:.4g} mm"

    def pupil(position: Tensor, semi: Tensor, vertex: str) -> str:
        side = "behind" if _number(position) >= 0 else "before"
        return f"{length(2 * _number(semi))} wide, {length(abs(_number(position)))} {side} the {vertex} vertex"

    lines = (
        ("focal length", f"{length(_number(first.focal_length))} {at}"),
        ("f-number", f"f/{lens.f_number:.3g}"),
        ("back focus", length(_number(first.back_focus))),
        ("sensor", f"{length(sensor)} behind the last vertex"),
        ("entrance pupil", pupil(first.entrance_pupil, first.entrance_semi_diameter, "first")),
        ("exit pupil", pupil(first.exit_pupil, first.exit_semi_diameter, "last")),
    )
    return "\n".join(f"{name:<16}{value}" for name, value in lines)


def _micrometres(value: float) -> str:
    return f"{value / um:.3g} \u00b5m" if value < 1e-3 else f"{value / mm:.3g} mm"


def _name(sheet: Sheet, text: str, top: float) -> None:
    sheet.text(_EDGE, top - 0.32, text, weight="bold")


# ---- section -------------------------------------------------------------------------------------------------------


def _section(lens: CompoundLens, heights: Sequence[float], distance: float) -> _Section:
    with torch.no_grad():
        vertices = np.cumsum([0.0, *(_number(surface.thickness) for surface in lens.surfaces[:-1])])
        sensor = vertices[-1] + _number(lens.sensor_distance)
        lead = min(0.12 * sensor, 0.9 * distance)
        rays = lens.paths(list(heights), distance=distance, lead=lead).numpy() / mm
        surfaces = []
        for index, (surface, vertex) in enumerate(zip(lens.surfaces, vertices, strict=True)):
            lit = 1.02 * np.abs(rays[:, :, index + 1, 1]).max() * mm  # what clips nothing is drawn as wide as its light
            reach = lit if surface.semi_diameter is None else _number(surface.semi_diameter)
            y = torch.linspace(-reach, reach, 121, dtype=torch.float64)
            surfaces.append(np.stack([vertex + surface.sag(y**2)[0].numpy(), y.numpy()], 1) / mm)
    tall = max(np.abs(part[:, 1]).max() for part in surfaces)
    seen = np.concatenate([rays.reshape(-1, 2), *surfaces])
    low, high = seen[:, 1].min(), max(seen[:, 1].max(), 1.2 * tall)
    low = min(low, -1.2 * tall)
    room = 0.03 * (high - low)
    left, right = float(seen[:, 0].min()), 1.01 * sensor / mm
    inch = (right - left) / _WIDTH  # where the drawing is as wide as the sheet: room for the scale and the stop's name
    limits = (left, right, float(low - room - 0.3 * inch), float(high + room + 0.15 * inch))
    return _Section(surfaces, rays, sensor / mm, limits)


def _draw_section(sheet: Sheet, lens: CompoundLens, section: _Section, heights: Sequence[float], *, top: float) -> None:
    width, tall = section.size(_WIDTH)
    where = sheet.width - _EDGE - _TEXT_WIDTH
    if _EDGE + width + 0.2 <= where:
        sheet.text(where, top + 0.3, lens_text(lens), size=SMALL, family="monospace", colour=MUTED, linespacing=1.7)
    left = _EDGE
    for height, colour in zip(heights, CURVE_COLOURS, strict=False):
        text = f"Y / D = {height:.3g} ({math.degrees(math.atan(height)):.1f}\u00b0)"
        sheet.text(left, top - 0.32, text, colour=colour)
        left += 0.5 + 0.076 * len(text)
    axes = sheet.axes(_EDGE, top, width, tall)
    axes.set(xlim=section.limits[:2], ylim=section.limits[2:])
    axes.axis("off")
    axes.axhline(0, color=MUTED, lw=0.6, dashes=(12, 3, 2, 3), zorder=1)
    for index, surface in enumerate(lens.surfaces):
        if surface.glass is not None:
            outline = _element(section.surfaces[index], section.surfaces[index + 1])
            axes.fill(*outline.T, facecolor=GLASS_COLOUR, edgecolor=INK, lw=0.8, zorder=2, gid=f"glass {index}")
    for index, surface in enumerate(lens.surfaces):
        before = lens.surfaces[index - 1].glass if index else None
        if surface.glass is not None or before is not None:
            axes.plot(*section.surfaces[index].T, color=INK, lw=1.1, zorder=3, gid=f"surface {index}")
    beyond = 0.1 * max(part[:, 1].max() for part in section.surfaces)
    for end, side in ((0, -1), (-1, 1)):
        z, y = section.surfaces[lens.stop][end]
        axes.plot([z, z], [y, y + side * beyond], color=INK, lw=3, solid_capstyle="butt", zorder=5, gid="stop")
    near = section.surfaces[max(lens.stop - 1, 0) : lens.stop + 2]
    above = max(part[:, 1].max() for part in near) + 0.3 * beyond
    axes.annotate("stop", (z, max(above, y + 1.25 * beyond)), ha="center", va="bottom", size=SMALL, color=INK)
    for bundle, colour in zip(section.rays, CURVE_COLOURS, strict=False):
        for ray in bundle:
            axes.plot(*ray.T, color=colour, lw=0.7, alpha=0.85, zorder=4)
    ends = section.rays[:, :, -1, 1]
    reach = 1.05 * max(np.abs(ends).max(), 1e-3)
    axes.plot([section.sensor] * 2, [-reach, 0.05 * reach], color=INK, lw=2.5, zorder=5, gid="sensor")
    step = _round_length(0.2 * (section.limits[1] - section.limits[0]))
    across = section.limits[2] + 0.06 * (section.limits[1] - section.limits[0]) / _WIDTH
    start = section.limits[0] + 0.01 * (section.limits[1] - section.limits[0])
    axes.plot([start, start + step], [across] * 2, color=MUTED, lw=1.5, solid_capstyle="butt")
    axes.annotate(f"{step:g} mm", (start, across), (0, 3), textcoords="offset points", size=SMALL, color=MUTED)


def _element(front: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Outline of the glass between two surfaces: the smaller goes on flat to the edge of the larger."""
    tall = max(front[-1, 1], back[-1, 1])

    def widened(curve: np.ndarray) -> np.ndarray:
        ends = [np.array([[curve[end, 0], side * tall]]) for end, side in ((0, -1), (-1, 1))]
        return np.concatenate([ends[0], curve, ends[1]])

    return np.concatenate([widened(front), widened(back)[::-1]])


def _round_length(length: float) -> float:
    """1, 2 or 5 times a power of ten, not more than a length."""
    power = 10.0 ** math.floor(math.log10(length))
    return next(step * power for step in (5, 2, 1) if step * power <= length)


# ---- points of the field -------------------------------------------------------------------------------------------


def _left(column: int) -> float:
    return _EDGE + column * (_CELL + _GAP)


def _draw_spots(
    sheet: Sheet, lens: CompoundLens, heights: Sequence[float], distance: float, wavelengths: Tensor, top: float
) -> None:
    with torch.no_grad():
        points, weights = (part[:, 0] for part in lens.spots(wavelengths, distances=distance, field=_points(heights)))
    radii = rms_radius(points.flatten(1, 2), weights.flatten(1, 2))
    lines = ", ".join(f"{value / nm:.0f}" for value in wavelengths.tolist())
    _name(sheet, f"Spots about the chief ray of {lens.focus_wavelength / nm:.0f} nm, in light of {lines} nm", top)
    for column, height in enumerate(heights):
        seen = points[column][weights[column] > 0].abs().max()
        half = 1.1 * max(float(seen), 1e-9)
        axes = sheet.axes(_left(column), top, _CELL, _CELL)
        axes.set(xlim=(-half / um, half / um), ylim=(half / um, -half / um), xticks=[], yticks=[])
        axes.spines[:].set_color(FAINT)
        axes.axhline(0, color=FAINT, lw=0.8, zorder=0)
        axes.axvline(0, color=FAINT, lw=0.8, zorder=0)
        for spot, light, colour in zip(points[column], weights[column], light_colours(wavelengths), strict=True):
            passed = spot[light > 0] / um
            axes.scatter(*passed.T, s=2.5, color=tuple(0.8 * part for part in colour), lw=0, alpha=0.7)
        text = f"Y / D = {height:.3g};  rms {_micrometres(float(radii[column]))}\nbox {_micrometres(2 * half)} wide"
        sheet.text(_left(column), top + _CELL + 0.06, text, size=SMALL, colour=MUTED)


def _draw_wavefronts(
    sheet: Sheet, lens: CompoundLens, heights: Sequence[float], distance: float, wavelengths: Tensor, top: float
) -> None:
    with torch.no_grad():
        opd = lens.opd(wavelengths, distances=distance, field=_points(heights), samples=_SAMPLES)
    waves, passes = (part[:, 0].numpy() for part in opd)
    middle, half = len(wavelengths) // 2, _SAMPLES // 2
    name = f"{float(wavelengths[middle]) / nm:.0f} nm"
    _name(sheet, f"Optical path difference over the stop at {name}, in waves: late is red", top)
    colours = [tuple(0.8 * part for part in colour) for colour in light_colours(wavelengths)]
    below = top + _CELL + 0.5 + _ROW
    _name(sheet, "Its fans, in waves: along the meridian (lines) and across it (dashes)", below)
    side = np.linspace(-1, 1, _SAMPLES)
    for column in range(len(heights)):
        shown = np.where(passes[column, middle], waves[column, middle], np.nan)
        largest = max(float(np.nanmax(np.abs(shown))), 1e-6)
        axes = sheet.axes(_left(column), top, _CELL, _CELL)
        axes.imshow(shown, cmap=matplotlib.colormaps["RdBu_r"], vmin=-largest, vmax=largest, extent=(-1, 1, 1, -1))
        axes.set(xticks=[], yticks=[], xlim=(-1.08, 1.08), ylim=(1.08, -1.08))
        axes.spines[:].set_color(FAINT)
        axes.add_patch(matplotlib.patches.Circle((0, 0), 1, fill=False, color=MUTED, lw=0.6))
        deviation, span = float(np.nanstd(shown)), float(np.nanmax(shown) - np.nanmin(shown))
        text = f"Y / D = {heights[column]:.3g};  rms {deviation:.3g}\npeak to valley {span:.3g}"
        sheet.text(_left(column), top + _CELL + 0.06, text, size=SMALL, colour=MUTED)
        fans = sheet.axes(_left(column), below, _CELL, _CELL)
        for index, colour in enumerate(colours):
            for cut, style in (((slice(None), half), "-"), ((half, slice(None)), "--")):
                values = np.where(passes[column, index][cut], waves[column, index][cut], np.nan)
                fans.plot(side, values, style, color=colour, lw=1.1)
        _finish(fans, "across the stop")
        fans.set(xlim=(-1, 1), xticks=[-1, 0, 1])


# ---- curves over the field -----------------------------------------------------------------------------------------


def _draw_curves(sheet: Sheet, curves: FieldCurves, top: float) -> None:
    at = curves.image_heights.detach().numpy() / mm
    between = np.linspace(0, at[-1], 201)

    def drawn(axes: Any, curve: Tensor, **style: Any) -> None:
        values = curve.detach().numpy()
        smooth = scipy.interpolate.PchipInterpolator(at, values)(between) if len(at) > 1 else values
        axes.plot(between if len(at) > 1 else at, smooth, lw=1.5, **style)

    panels = [sheet.axes(_left(column), top, _CELL, _CELL) for column in range(5)]
    illumination, distortion, colour, spot, contrast = panels
    drawn(illumination, 100 * curves.relative_illumination, color=INK)
    illumination.set(ylim=(0, 105 * max(1.0, _number(curves.relative_illumination.max()))))
    drawn(distortion, 100 * curves.distortion, color=INK)
    low, high = distortion.get_ylim()
    distortion.set(ylim=(min(low, -0.2), max(high, 0.2)))  # what nobody sees is shown as little
    distortion.locator_params(axis="y", nbins=5)  # with fewer decimals, which have their place
    hues = [tuple(0.8 * part for part in hue) for hue in light_colours(curves.wavelengths)]
    for index, hue in enumerate(hues):
        name = f"{float(curves.wavelengths[index]) / nm:.0f}"
        drawn(colour, curves.lateral_colour[:, index] / um, color=hue, label=name)
    drawn(spot, curves.rms_spot / um, color=INK)
    spot.set(ylim=(0, None))
    for index, frequency in enumerate(curves.frequencies.tolist()):
        for which, style in enumerate(("-", "--")):
            name = f"{frequency * mm:.3g} / mm" if which == 0 else "_"  # which a legend leaves out
            drawn(contrast, curves.mtf[:, which, index], color=CURVE_COLOURS[index], ls=style, label=name)
    contrast.set(ylim=(0, 1.25), yticks=[0, 0.2, 0.4, 0.6, 0.8, 1])
    titles = ("Relative illumination [%]", "Distortion [%]", "Lateral colour [\u00b5m], nm", "Rms spot [\u00b5m]")
    for axes, title in zip(panels, (*titles, "MTF, tangential dashed"), strict=True):
        axes.set_title(title, size=LABEL, weight="bold", loc="left", color=INK)
        _finish(axes, "image height [mm]")
        axes.set(xlim=(0, at[-1]))
    low, high = colour.get_ylim()
    colour.set(ylim=(low, high + 0.25 * (high - low)))  # room for the names of the lines, which then hide none
    key = {"frameon": False, "fontsize": SMALL, "labelcolor": INK, "handlelength": 1.0, "columnspacing": 1.0}
    for axes in (colour, contrast):
        axes.legend(loc="upper left", ncols=3, borderaxespad=0.1, handletextpad=0.4, **key)


def _finish(axes: Any, label: str) -> None:
    quiet(axes)
    axes.set_xlabel(label)
