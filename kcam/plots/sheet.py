"""What figures share, drawn with matplotlib's object interface, so that nothing global changes."""

from __future__ import annotations

import functools
import io
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath

from kcam import files
from kcam.plots.pictures import check_writable

INK = "#1c1c22"
"""Colour of text and curves."""
MUTED = "#75757f"
"""Colour of what explains."""
FAINT = "#e2e2e8"
"""Colour of grids and frames."""
TITLE = 15.0
"""Size of a figure's title [points]."""
LABEL = 10.0
"""Size of labels and of the titles of axes [points]."""
SMALL = 8.5
"""Size of captions and ticks [points]."""
WIDTH, EDGE, GAP, LINE = 12.8, 0.35, 0.18, 0.165
"""Of figures in panels: all of it, its rim, between panels, and of a line of a caption [inches]."""
FIGURE_SUFFIXES = (".png", ".pdf", ".svg", ".jpg")
"""Formats that `save_figure` writes."""


def save_figure(figure: Figure, path: str | os.PathLike[str], *, resolution: float = 144) -> None:
    """Write a figure at `resolution` dots per inch; ValueError as in `check_writable`.

    Example:
    >>> figure = plots.contact_sheet([[torch.rand(3, 8, 8)]], titles=["noise"], labels=["one"])
    >>> plots.save_figure(figure, "sheet.png", resolution=72)
    >>> bool(abs(Scene.from_file("sheet.png", depth=2.0).shape[2] - 72 * figure.get_figwidth()) < 1)  # pixels
    True
    """
    check_writable(path, suffixes=FIGURE_SUFFIXES)
    files.replace(path, figure_bytes(figure, resolution=resolution, format=Path(path).suffix.lower()[1:]))


def figure_bytes(figure: Figure, *, resolution: float = 144, format: str = "png") -> bytes:
    """A figure as the content of a file, at `resolution` dots per inch.

    Example:
    >>> figure = plots.contact_sheet([[torch.rand(3, 8, 8)]], titles=["noise"], labels=["one"])
    >>> plots.figure_bytes(figure)[1:4]  # a PNG says so
    b'PNG'
    """
    content = io.BytesIO()
    figure.savefig(content, dpi=resolution, facecolor="white", format=format)
    return content.getvalue()


class Sheet:
    """A figure whose parts are placed in inches from its top left corner, so that nothing overlaps at any size.

    Example:
    >>> sheet = plots.Sheet(6.0, 4.0)
    >>> axes = sheet.axes(0.5, 0.5, 2.0, 1.5)
    >>> [float(inches) for inches in sheet.figure.get_size_inches()]
    [6.0, 4.0]
    """

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


def shortened(text: str, width: float, *, size: float = LABEL, weight: str = "normal") -> str:
    """A text in one line that is at most so wide [inches]: cut off at its end, which an ellipsis shows.

    Example:
    >>> plots.shortened("a text that is too long for its place", width=1.0)
    'a text...…'
    """
    wide = functools.partial(_width, size=size, weight=weight)
    text = " ".join(text.split())[: int(width * 72)]  # a point and more for each letter
    if wide(text) <= width:
        return text
    kept = min(len(text) - 1, int(len(text) * width / wide(text)) + 3)
    while kept > 0 and wide(f"{text[:kept]}\u2026") > width:
        kept -= 1
    return f"{text[:kept].rstrip(' ,;')}\u2026"


def draw_lines(sheet: Sheet, lines: Sequence[str], left: float, top: float, width: float) -> None:
    """Lines of a caption, each cut off where it would leave its column."""
    for index, line in enumerate(lines):
        text = shortened(line, width, size=SMALL)
        sheet.text(left, top + index * LINE, text, size=SMALL, colour=MUTED, parse_math=False)


def columns_of(count: int) -> int:
    """Four or five, or as many as there are: those that leave the fewest places empty."""
    return count if count < 4 else min((4, 5), key=lambda columns: (-count % columns, -columns))


@functools.lru_cache(4096)  # outlines take milliseconds, and figures of several cameras have most captions in common
def _width(text: str, *, size: float, weight: str) -> float:
    """Of a text in one line [inches]."""
    text = text.strip().replace("$", "S")  # no formula
    font = FontProperties(size=size, weight=weight)
    return 1.06 * TextPath((0, 0), text, prop=font).get_extents().x1 / 72 if text else 0.0  # hinting widens it


def duration(seconds: float) -> str:
    """A time for people, from milliseconds to days: three figures at most.

    Example:
    >>> [plots.duration(seconds) for seconds in (0.0042, 7.5, 4000.0)]
    ['4.2 ms', '7.5 s', '66.7 min']
    """
    for unit, size in (("days", 86_400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {unit}"
    if seconds >= 0.9995:
        return f"{seconds:.3g} s" if seconds < 100 else f"{seconds:.0f} s"
    return f"{seconds * 1e3:.0f} ms" if seconds >= 0.01 else f"{seconds * 1e3:.1f} ms"


def quiet(axes: Any) -> None:
    """Axes that stand back behind their curves: a faint grid, two spines, small ticks.

    Example:
    >>> axes = plots.Sheet(6.0, 4.0).axes(0.5, 0.5, 2.0, 1.5)
    >>> plots.quiet(axes)
    >>> axes.spines["top"].get_visible()
    False
    """
    axes.grid(color=FAINT, lw=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED)
    axes.tick_params(labelsize=SMALL, colors=MUTED, length=3, which="both")
    axes.xaxis.label.set(size=SMALL + 0.5, color=MUTED)


def percent_or_more(share: float) -> str:
    """A share that is not less than the text says: "97% or more", "less than 1%".

    Example:
    >>> plots.percent_or_more(0.978), plots.percent_or_more(0.004)
    ('97% or more', 'less than 1%')
    """
    return f"{math.floor(100 * min(share, 1.0))}% or more" if share >= 0.01 else "less than 1%"


def metres(distance: float) -> str:
    """A distance for people.

    Example:
    >>> [plots.metres(distance) for distance in (0.05, 2.0, math.inf)]
    ['5 cm', '2 m', 'infinity']
    """
    if math.isinf(distance):
        return "infinity"
    return f"{distance:.3g} m" if distance >= 1 else f"{distance * 100:.3g} cm"
