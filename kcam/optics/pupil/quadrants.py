"""Grids that are symmetric about the axis, as four quadrants: the even and odd parts on both axes take half the work.

Quadrants stand in the order ++, +-, -+, -- (sign of y, of x), each ordered away from the axis. A grid of an even number
of points has none on the axis; where the number is odd, the points on the axis belong to the quadrants on both sides.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def signs(like: Tensor) -> tuple[Tensor, Tensor]:
    """Of x, and of y, in each quadrant, (4, 1, 1) each."""
    x, y = like.new_tensor([[1, -1, 1, -1], [1, 1, -1, -1]])[..., None, None]
    return x, y


def split(grid: Tensor) -> Tensor:
    """Quadrants (..., 4, h, w) of a grid (..., H, W), h = ceil(H / 2)."""
    rows, columns = grid.shape[-2:]
    high, low = grid[..., rows // 2 :, :], grid[..., : rows - rows // 2, :].flip(-2)
    right, left = slice(columns // 2, None), slice(columns - columns // 2)
    return torch.stack([high[..., right], high[..., left].flip(-1), low[..., right], low[..., left].flip(-1)], dim=-3)


def join(quadrants: Tensor, *, odd: bool) -> Tensor:
    """The grid of quadrants (..., 4, h, w): the inverse of `split`; the axis is taken from the positive side."""
    pp, pm, mp, mm = quadrants.unbind(-3)
    shared = int(odd)
    high = torch.cat([pm[..., shared:].flip(-1), pp], dim=-1)
    low = torch.cat([mm[..., shared:].flip(-1), mp], dim=-1)
    return torch.cat([low[..., shared:, :].flip(-2), high], dim=-2)


def join_adjoint(grid: Tensor) -> Tensor:
    """Transpose of `join`: what belongs to several quadrants goes to the positive side."""
    quadrants = split(grid)
    if grid.shape[-2] % 2:
        quadrants[..., 2:, 0, :] = 0
    if grid.shape[-1] % 2:
        quadrants[..., 1::2, :, 0] = 0
    return quadrants


def unfold(quadrant: Tensor) -> Tensor:
    """The even grid (..., 2n, 2n) of one quadrant (..., n, n)."""
    return join(quadrant.unsqueeze(-3).expand(*quadrant.shape[:-2], 4, *quadrant.shape[-2:]), odd=False)


def parities(quadrants: Sequence[Tensor], out: Sequence[Tensor]) -> None:
    """Sums and differences of four values a, b, c, d over both axes: a + b + c + d, a - b + c - d, a + b - c - d and
    a - b - c + d. Its own transpose, and its inverse but for a factor of 4.
    """
    a, b, c, d = quadrants
    left, right = a + b, c + d
    torch.add(left, right, out=out[0])
    torch.sub(left, right, out=out[2])
    torch.sub(a, b, out=left)
    torch.sub(c, d, out=right)
    torch.add(left, right, out=out[1])
    torch.sub(left, right, out=out[3])


def of_parities(even: Tensor, odd_x: Tensor | None, odd_y: Tensor | None, odd: Tensor | None) -> Tensor:
    """Quadrants (..., 4, h, w) of a sum of what is even, odd in x, in y and in both, given for x, y > 0; with a
    derivative.
    """
    zero = torch.zeros_like(even)
    b, c, d = (zero if part is None else part for part in (odd_x, odd_y, odd))
    (left, turned), (right, other) = ((first + second, first - second) for first, second in ((even, b), (c, d)))
    return torch.stack([left + right, turned + other, left - right, turned - other], dim=-3)


def by_x(quadrants: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Quadrants (B, 4, h, w) in the order ++, -+, +-, --, whose `parities` are by x first, then by y."""
    pp, pm, mp, mm = quadrants.unbind(1)
    return pp, mp, pm, mm
