"""What accuracy costs: error against time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from kcam.plots.sheet import INK, LABEL, MUTED, SMALL, TITLE, Sheet, quiet
from kcam.tradeoff import Row, Sweep, front

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
"""Of the points of each knob in `tradeoff_figure`."""


def tradeoff_figure(result: Sweep) -> Figure:
    """Error against time, log-log: of the raw, and of the PSFs; the front of each drawn, each point labelled.

    Filled marks were timed on whole pictures, open ones on a few of their PSFs. An error too small for the axis stands
    on its lower edge as a triangle.

    Example:
    >>> from kcam.tradeoff import Row, Sweep
    >>> rows = (Row("default", "as it is", raw_rms=1e-4, psf_l1=1e-4, seconds=0.4, default=True),
    ...         Row("wavelengths", "7 wavelengths", raw_rms=2e-3, psf_l1=0.1, seconds=0.1))
    >>> len(plots.tradeoff_figure(Sweep("Two settings", "a wall", rows)).axes)
    2
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
