"""Distortion: the scene's radiance onto the pixels where a lens brings it, by areas.

A pixel of the picture shows the mean of the scene over the part that it sees: an even scene stays even, nothing
aliases, and no light is moved by more than it was moved by the lens. Two passes, along rows and then along columns
(Catmull and Smith, SIGGRAPH 1980): each is a mean over stretches of pixels, exact for scene pixels that are squares of
even light. A pixel's light is even over it: where pixels are stretched by 10 %, a point may lie 0.05 pixels off.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from kcam.optics.rendering.borders import border_index

Ideal = Callable[[Tensor], Tensor]
"""Where without distortion the light would fall that falls at places (..., 2) [pixels]."""

_STEP, _LONG = 4, 512  # pixels between computed places, on longer sides; linear between: 2e-3 pixels for 5 %
_UNMOVED = 1e-3  # pixels: less is not moved
_FIXED_POINT = 12  # steps to where a row of the scene crosses a column of the picture
_AT_ONCE = 2**22  # pixels of a plane


@dataclass(frozen=True)
class Resampling:
    """From scene pixels to those of a picture of the same size. across (H, W + 1): where the left edge of each column,
    and the right one of the last, meets each *scene* row, in scene columns; down (H + 1, W): where edges between rows
    meet columns, in scene rows.
    """

    across: Tensor
    down: Tensor
    border: str

    def __call__(self, planes: Tensor) -> Tensor:
        """Means (B, K, H, W) of planes (B, K, H, W)."""
        along_rows = _means(planes, self.across, self.border)
        return _means(along_rows.mT, self.down.T, self.border).mT


def resampling(ideal: Ideal, picture: tuple[int, int], border: str) -> Resampling | None:
    """That of a picture whose middle is (0, 0), x to the right and y down [pixels]; None where nothing moves."""
    height, width = picture
    y, x = (_coarse(n) for n in picture)
    places = torch.stack(torch.broadcast_tensors(x[None, :], y[:, None]), dim=-1)
    moved = ideal(places)
    if float((moved.detach() - places).abs().max()) < _UNMOVED:
        return None
    down = moved[..., 1]
    # where the column x meets the scene's row y: y' with ideal_y(x, y') = y
    row = y[:, None].expand(-1, len(x))
    for _ in range(_FIXED_POINT):
        places = torch.stack([x.expand_as(row), row], dim=-1)
        row = row + (y[:, None] - ideal(places)[..., 1])
    across = ideal(torch.stack([x.expand_as(row), row], dim=-1))[..., 0]
    return Resampling(
        _fine(across, x, y, columns=_edges(width), rows=_centres(height)) + (width - 1) / 2,
        _fine(down, x, y, columns=_centres(width), rows=_edges(height)) + (height - 1) / 2,
        border,
    )


def smooth_map(function: Callable[[Tensor], Tensor], picture: tuple[int, int]) -> Tensor:
    """A function of places (..., 2) at the pixels of a picture about its middle, (H, W): linear between a few."""
    (y, x), (height, width) = (_coarse(n) for n in picture), picture
    places = torch.stack(torch.broadcast_tensors(x[None, :], y[:, None]), dim=-1)
    return _fine(function(places), x, y, columns=_centres(width), rows=_centres(height))


def _coarse(n: int) -> Tensor:
    """Places from edge to edge of n pixels about their middle, at most some pixels apart."""
    return torch.linspace(-n / 2, n / 2, 2 + math.ceil(n / (_STEP if n > _LONG else 1)), dtype=torch.float64)


def _edges(n: int) -> Tensor:
    return torch.arange(n + 1, dtype=torch.float64) - n / 2


def _centres(n: int) -> Tensor:
    return torch.arange(n, dtype=torch.float64) - (n - 1) / 2


def _fine(values: Tensor, x: Tensor, y: Tensor, *, columns: Tensor, rows: Tensor) -> Tensor:
    """Linear between values on a coarse grid, (rows, columns)."""
    for nodes, at in ((x, columns), (y, rows)):
        position = (at - nodes[0]) / (nodes[1] - nodes[0])
        before = position.floor().clamp(0, len(nodes) - 2).long()
        share = position - before
        values = (values[..., before] * (1 - share) + values[..., before + 1] * share).mT
    return values


def _means(planes: Tensor, edges: Tensor, border: str) -> Tensor:
    """Mean along each row (B, K, R, W) between neighbouring edges (R, W + 1) [pixels; pixel i is i -+ 1/2]."""
    rows, edges = max(1, _AT_ONCE // max(1, planes.shape[-1])), edges.to(planes.device)
    parts = zip(planes.split(rows, dim=-2), edges.split(rows), strict=True)
    return torch.cat([_means_of(part, own, border) for part, own in parts], dim=-2)


def _means_of(planes: Tensor, edges: Tensor, border: str) -> Tensor:
    start, stop = edges[:, :-1], edges[:, 1:]
    with torch.no_grad():
        first = (start + 0.5).floor()
        count = int(((stop + 0.5).ceil() - first).max())
    start, stop, first = (start - first).to(planes), (stop - first).to(planes), first.long()
    width = stop - start
    result = planes.new_zeros(())
    for step in range(count):
        share = (stop.clamp(max=step + 0.5) - start.clamp(min=step - 0.5)).clamp(min=0) / width
        index = first + step
        index = border_index(index, planes.shape[-1], border) if border != "zero" else index
        if border == "zero":
            share = torch.where((index >= 0) & (index < planes.shape[-1]), share, 0)
            index = index.clamp(0, planes.shape[-1] - 1)
        result = result + planes.gather(-1, index.expand(planes.shape)) * share
    return result
