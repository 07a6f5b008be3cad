"""PSFs of places between those where they are known: by cubic polynomials along x and y.

The error is of fourth order in their distance, where windows between neighbouring PSFs leave one of second order: a
picture may have four times as many nodes as there are PSFs, or sixteen.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

Bank = Callable[[Tensor], Tensor]
_POINTS = 4


@dataclass(frozen=True)
class Between:
    """PSFs at rows (Y,) and columns (X,) [pixels from the picture's middle], ascending.

    psfs: (Y, X, ..., h, w); mirrored: those of rows and columns from the middle on, which the others mirror. spacing:
    pixels between nodes along y and x that share out what lies between them, see `cubic_weights`.
    """

    rows: Tensor
    columns: Tensor
    psfs: Tensor
    mirrored: bool = False
    spacing: tuple[float, float] = (1.0, 1.0)

    @classmethod
    def known(cls, bank: Bank, picture: tuple[int, int], *, apart: float, mirrored: bool = False) -> Between:
        """PSFs at most so many pixels apart."""
        rows, columns = (grid(n, apart=apart) for n in picture)
        y, x = (nodes[len(nodes) // 2 :] if mirrored else nodes for nodes in (rows, columns))
        return cls(rows, columns, torch.stack([bank(torch.cartesian_prod(at[None], x).flip(1)) for at in y]), mirrored)

    def shared(self, rows: Tensor, columns: Tensor) -> Between:
        """For nodes at rows and columns that share out what lies between them."""
        spacing = [float(nodes[1] - nodes[0]) if len(nodes) > 1 else 1.0 for nodes in (rows, columns)]
        return replace(self, spacing=(spacing[0], spacing[1]))

    def middle(self, place: Tensor) -> Tensor:
        """Of the cell around a place (1, 2)."""
        nodes = [(own[1:] + own[:-1]) / 2 if len(own) > 1 else own for own in (self.columns, self.rows)]
        return torch.stack([own[(own - at).abs().argmin()] for own, at in zip(nodes, place[0], strict=True)])[None]

    def __call__(self, places: Tensor) -> Tensor:
        """PSFs (N, ...) of places (N, 2), x and y."""
        return torch.stack(list(self.each(places)))

    def each(self, places: Tensor) -> Iterator[Tensor]:
        """PSFs of places (N, 2), row by row, one after the other."""
        along = self._weights(self.rows, places[:, 1], self.spacing[0])
        across = self._weights(self.columns, places[:, 0], self.spacing[1])
        for _, group in itertools.groupby(range(len(places)), key=places[:, 1].tolist().__getitem__):
            own = list(group)
            row = _sum([weights[own[0]] for weights in along], self.psfs, dim=-2)
            if row.requires_grad:  # on the way back each would fill a row of its own with zeros
                turned = zip(across, (row, row.flip(-1)), strict=False)
                sums = [weights[own].to(row) @ psfs.flatten(1) for weights, psfs in turned]
                yield from torch.stack(sums).sum(0).unflatten(1, row.shape[1:])
            else:
                yield from (_sum([weights[index] for weights in across], row, dim=-1) for index in own)

    def _weights(self, nodes: Tensor, at: Tensor, spacing: float) -> list[Tensor]:
        """Of the PSFs that are known, (N, n); mirrored: of these turned about, too."""
        weights, count = cubic_weights(nodes, at, spacing=spacing), len(nodes)
        if not self.mirrored:
            return [weights]
        turned = weights.flip(1)[:, count // 2 :].clone()
        turned[:, : count % 2] = 0  # the middle is its own mirror image
        return [weights[:, count // 2 :], turned]


def grid(n: int, *, apart: float) -> Tensor:
    """Places of a side of n pixels: both ends, and between them at most `apart` from the next; at least four."""
    if n == 1:
        return torch.zeros(1, dtype=torch.float64)
    count = max(_POINTS, 1 + math.ceil((n - 1) / apart))
    return torch.linspace(-(n - 1) / 2, (n - 1) / 2, count, dtype=torch.float64)


def _sum(sides: list[Tensor], psfs: Tensor, *, dim: int) -> Tensor:
    """Of PSFs (N, ...) with weights (N,), few of them other than 0; those of a second side are turned about `dim`."""
    found = []
    for weights, turned in zip(sides, (False, True), strict=False):
        near = weights.nonzero()[:, 0]
        if len(near):
            few = slice(int(near[0]), int(near[-1]) + 1)
            own = (weights[few].to(psfs) @ psfs[few].flatten(1)).view(psfs.shape[1:])
            found.append(own.flip(dim) if turned else own)
    return functools.reduce(torch.add, found)


def cubic_weights(nodes: Tensor, at: Tensor, *, spacing: float = 1.0) -> Tensor:
    """Weights (N, n) of the cubic p through the four of the even nodes (n,) that are next to `at` (N,).

    spacing: pixels a between places that share out what lies between them, linearly. p + (a^2 - 1) p'' / 12 is what
    these make of p in the mean over the pixels between, so that with p - (a^2 - 1) p'' / 12 they are right in the mean:
    what is left is 0.4 times as much (rms), of either sign.
    """
    if len(nodes) == 1:
        return at.new_ones(len(at), 1)
    step = float(nodes[1] - nodes[0])
    position = (at - nodes[0]) / step
    first = (position.floor() - 1).clamp(0, len(nodes) - _POINTS)
    own = torch.arange(_POINTS, dtype=at.dtype)
    off = (position - first)[:, None] - own
    bent = (spacing**2 - 1) / 12 / step**2
    weights = []
    for k in range(_POINTS):
        rest = own[own != k].long()
        scale = (k - own[rest]).prod()
        weights.append((off[:, rest].prod(1) - bent * 2 * off[:, rest].sum(1)) / scale)
    index = first.long()[:, None] + own.long()
    return at.new_zeros(len(at), len(nodes)).scatter(1, index, torch.stack(weights, dim=1))
