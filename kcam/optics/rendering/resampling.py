"""Distortion: the scene's radiance onto the pixels where a lens brings it, by areas.

A pixel of the picture shows the mean of the scene over the part that it sees: an even scene stays even, nothing
aliases, and no light is moved by more than it was moved by the lens. Two passes, along rows and then along columns
(Catmull and Smith, SIGGRAPH 1980): each is a mean over stretches of pixels, exact for scene pixels that are squares of
even light. By areas alone a point would lie off by half of what its pixel is stretched by: see `_shares`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from kcam.optics.autograd import cut
from kcam.optics.rendering.borders import part, part_of

Ideal = Callable[[Tensor], Tensor]
"""Where without distortion the light would fall that falls at places (..., 2) [pixels]."""

Take = Callable[..., Tensor]
"""Planes from a place to another along one axis: `borders.part`."""

_STEP, _LONG = 4, 512  # pixels between computed places, on longer sides; linear between: 2e-3 pixels for 5 %
_UNMOVED = 1e-3  # pixels: less is not moved
_NEWTON, _CROSSED, _FLATTEST = 8, 1e-3, 0.1  # steps to where a row of the scene meets a column, pixels, and slope
_NARROWEST = 0.75  # pixels to each side of a tent: there is one in it
_UNSTRETCHED = 0.03  # of a pixel: less moves its light by less than 0.02 pixels
_AT_ONCE = 2**17  # pixels of a plane: they stay in the processor's cache


@dataclass(frozen=True)
class Smooth:
    """A smooth function at the rows and columns of a picture, linear between values (R, W) of a few rows.

    before, share (H,): which of them comes before each row, and how far from there to the next it lies.
    """

    values: Tensor
    before: Tensor
    share: Tensor

    def strips(self, rows: list[slice]) -> list[Callable[[], Tensor]]:
        """What computes it at strips of rows, (n, W)."""
        spans = [self.before[own][[0, -1]].tolist() for own in rows]
        parts = cut(self.values, [(slice(first, last + 2), slice(None)) for first, last in spans])

        def at(part: Tensor, own: slice, first: int) -> Tensor:
            before = self.before[own] - first
            return torch.lerp(part[before], part[before + 1], self.share[own, None])

        return [
            functools.partial(at, part, own, first) for part, own, (first, _) in zip(parts, rows, spans, strict=True)
        ]


@dataclass(frozen=True)
class Resampling:
    """From scene pixels to those of a picture of the same size. across (H, W + 1): where the left edge of each column,
    and the right one of the last, meets each *scene* row, in scene columns; down (H + 1, W): where edges between rows
    meet columns, in scene rows.
    """

    across: Smooth
    down: Smooth
    border: str

    def __call__(self, planes: Tensor) -> Tensor:
        """Means (B, K, H, W) of planes (B, K, H, W)."""
        strips = _strips(*planes.shape[-2:])
        found = []
        for own, edges in zip(planes.split(strips[0].stop, dim=-2), self.across.strips(strips), strict=True):
            found.append(_means(own, functools.partial(part, own), edges, self.border, dim=-1))
        planes = torch.cat(found, dim=-2)
        rows = planes.split(strips[0].stop if planes.requires_grad else planes.shape[-2], dim=-2)
        found = []
        for edges in self.down.strips([slice(own.start, own.stop + 1) for own in strips]):
            found.append(_means(planes, functools.partial(part_of, rows), edges, self.border, dim=-2))
        return torch.cat(found, dim=-2)


def resampling(ideal: Ideal, picture: tuple[int, int], border: str) -> Resampling | None:
    """That of a picture whose middle is (0, 0), x to the right and y down [pixels]; None where nothing moves."""
    height, width = picture
    y, x = (_coarse(n) for n in picture)
    places = torch.stack(torch.broadcast_tensors(x[None, :], y[:, None]), dim=-1)
    moved = ideal(places)
    if float((moved.detach() - places).abs().max()) < _UNMOVED:
        return None
    down = moved[..., 1]
    across = ideal(torch.stack([x.expand(len(y), -1), _crossing(ideal, x, y)], dim=-1))[..., 0]
    across, down = across + (width - 1) / 2, down + (height - 1) / 2
    return Resampling(
        _fine(across, x, y, columns=_edges(width), rows=_centres(height)),
        _fine(down, x, y, columns=_centres(width), rows=_edges(height)),
        border,
    )


def _crossing(ideal: Ideal, x: Tensor, y: Tensor) -> Tensor:
    """Where columns x meet rows y of the scene, (len(y), len(x)): y' with ideal_y(x, y') = y. By Newton's method, of
    which the last step carries the derivative.
    """

    def met(row: Tensor) -> Tensor:
        return ideal(torch.stack([x.expand_as(row), row], dim=-1))[..., 1]

    rows = y[:, None].expand(-1, len(x))
    with torch.no_grad():
        row = rows
        for _ in range(_NEWTON):
            off = met(row) - rows
            slope = (met(row + 0.5) - met(row - 0.5)).clamp(min=_FLATTEST)
            row = row - off / slope
            if float(off.abs().max()) < _CROSSED:
                break
    return row - (met(row) - rows) / slope


def multiplied(planes: Tensor, function: Callable[[Tensor], Tensor]) -> Tensor:
    """Planes (B, K, H, W) times a smooth function of places (..., 2) at their pixels, linear between a few."""
    height, width = picture = (planes.shape[-2], planes.shape[-1])
    y, x = (_coarse(n) for n in picture)
    values = function(torch.stack(torch.broadcast_tensors(x[None, :], y[:, None]), dim=-1))
    light, strips = _fine(values, x, y, columns=_centres(width), rows=_centres(height)), _strips(height, width)

    def product(own: Tensor, light: Callable[[], Tensor]) -> Tensor:
        return own * light().to(own)

    pairs = zip(planes.split(strips[0].stop, dim=-2), light.strips(strips), strict=True)
    return torch.cat([_again(product, *pair) for pair in pairs], dim=-2)


def _coarse(n: int) -> Tensor:
    """Places from edge to edge of n pixels about their middle, at most some pixels apart."""
    return torch.linspace(-n / 2, n / 2, 2 + math.ceil(n / (_STEP if n > _LONG else 1)), dtype=torch.float64)


def _edges(n: int) -> Tensor:
    return torch.arange(n + 1, dtype=torch.float64) - n / 2


def _centres(n: int) -> Tensor:
    return torch.arange(n, dtype=torch.float64) - (n - 1) / 2


def _fine(values: Tensor, x: Tensor, y: Tensor, *, columns: Tensor, rows: Tensor) -> Smooth:
    """Linear between values on a coarse grid (len(y), len(x))."""
    before, share = _between(x, columns)
    fine = torch.lerp(values[:, before], values[:, before + 1], share)
    return Smooth(fine, *_between(y, rows))


def _between(nodes: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """Which of even nodes comes before each place, and how far from there to the next it lies."""
    position = (at - nodes[0]) / (nodes[1] - nodes[0])
    before = position.floor().clamp(0, len(nodes) - 2)
    return before.long(), position - before


def _strips(height: int, width: int) -> list[slice]:
    """Rows that are worked on together."""
    step = max(1, _AT_ONCE // max(1, width))
    return [slice(first, min(first + step, height)) for first in range(0, height, step)]


def _again(function: Callable[..., Tensor], *arguments: Any) -> Tensor:
    """function(*arguments). Where gradients are asked for, what that takes is computed again on the way back."""
    return checkpoint(function, *arguments, use_reentrant=False) if torch.is_grad_enabled() else function(*arguments)


def _means(planes: Tensor, take: Take, edges: Callable[[], Tensor], border: str, *, dim: int) -> Tensor:
    """What pixels between edges (H, W), one more along dim -1 or -2, see of planes along it [pixels; pixel i is i -+
    1/2]: see `_shares`.
    """
    n = planes.shape[dim]

    def stretches() -> tuple[Tensor, Tensor]:
        """Middles and widths."""
        places = edges().to(planes.device)
        start, stop = places.narrow(dim, 0, places.shape[dim] - 1), places.narrow(dim, 1, places.shape[dim] - 1)
        return (start + stop) / 2, stop - start

    with torch.no_grad():
        middle, width = stretches()
        reach = width.clamp(min=1)
        first = (middle - reach).floor() + 1
        reached = int(((middle + reach).ceil() - first).max())
        low = min(int(first.min()), n - 1)
        high = max(int(first.max()) + reached, 1, low + 1)

    def means(stretches: Callable[[], tuple[Tensor, Tensor]]) -> Tensor:
        seen, (middle, width) = take(low, high, border, dim=dim), stretches()
        middle, width, index = (middle - first).to(seen), width.to(seen), (first - low).long()
        shape = (*seen.shape[:-2], *middle.shape)
        shares = _shares([middle - step for step in range(reached)], width)
        result = seen.new_zeros(())
        for step, share in enumerate(shares):
            result = torch.addcmul(result, seen.gather(dim, (index + step).expand(shape)), share)
        return result

    return _again(means, stretches)


def _shares(away: list[Tensor], width: Tensor) -> list[Tensor]:
    """What pixels so far away show in one of a width, in the middle of which they are 0 away: all they have together
    is 1.

    By the stretch of each that it sees, a pixel's light keeps the area that it covers, and lies off by half of what it
    is stretched by. By a tent it keeps its place, and light of one pixel alone is off by the square of the stretch.
    Where nothing is stretched these are the same; the tent counts for as much as keeps its place to 0.02 pixels.
    """
    stretches = [((width + 1) / 2 - off.abs()).clamp(min=0).minimum(width.clamp(max=1)) / width for off in away]
    share = 1 - _UNSTRETCHED / (1 / width - 1).abs().clamp(min=_UNSTRETCHED)
    if not bool((share > 0).any()):
        return stretches
    tents = [(1 - off.abs() / width.clamp(min=_NARROWEST)).clamp(min=0) for off in away]
    whole = functools.reduce(torch.add, tents)
    return [torch.lerp(stretch, tent / whole, share) for stretch, tent in zip(stretches, tents, strict=True)]
