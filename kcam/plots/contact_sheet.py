"""Pictures in rows, for a look at a training."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure
from torch import Tensor

from kcam.plots.pictures import as_image
from kcam.plots.sheet import MUTED, SMALL, TITLE, Sheet


def contact_sheet(rows: Sequence[Sequence[Tensor]], *, titles: Sequence[str], labels: Sequence[str]) -> Figure:
    """Pictures (3,H,W) in rows; all in a row have one shape.

    Args:      rows: pictures.  titles: one per column.  labels: one per row.

    Example:
    >>> pictures = [[torch.rand(3, 8, 8), torch.rand(3, 8, 8)]]
    >>> figure = plots.contact_sheet(pictures, titles=["before", "after"], labels=["noise"])
    >>> len(figure.axes)
    2
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
