"""A picture on its way through a camera."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor
from torch.nn import functional as F

from kcam.plots.pictures import as_image, false_colour
from kcam.plots.sheet import FAINT, MUTED, SMALL, TITLE, Sheet, duration


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
