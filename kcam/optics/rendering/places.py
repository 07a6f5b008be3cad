"""PSFs of places between those where they are known: by cubic polynomials along x and y.

The error is of fourth order in their distance, where windows between neighbouring PSFs leave one of second order: a
picture may have four times as many nodes as there are PSFs, or sixteen.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

Bank = Callable[[Tensor], Tensor]
_POINTS = 4


@dataclass(frozen=True)
class Between:
    """PSFs (Y, X, ...) at rows (Y,) and columns (X,) [pixels from the picture's middle], ascending."""

    rows: Tensor
    columns: Tensor
    psfs: Tensor

    @classmethod
    def known(cls, bank: Bank, picture: tuple[int, int], *, apart: float) -> Between:
        """PSFs at most so many pixels apart."""
        rows, columns = (grid(n, apart=apart) for n in picture)
        return cls(rows, columns, _computed(bank, rows, columns))

    def refined(self, bank: Bank) -> Between:
        """With those in the middle between them too."""
        rows, columns = halved(self.rows), halved(self.columns)
        upper = _woven(self.psfs, _computed(bank, self.rows, columns[1::2]), dim=1)
        return Between(rows, columns, _woven(upper, _computed(bank, rows[1::2], columns), dim=0))

    def middle(self, place: Tensor) -> Tensor:
        """Of the cell around a place (1, 2)."""
        nodes = (self.columns, self.rows)
        middles = [(own[1:] + own[:-1]) / 2 if len(own) > 1 else own for own in nodes]
        return torch.stack([own[(own - at).abs().argmin()] for own, at in zip(middles, place[0], strict=True)])[None]

    def __call__(self, places: Tensor) -> Tensor:
        """PSFs (N, ...) of places (N, 2), x and y."""
        return torch.stack(list(self.each(places)))

    def each(self, places: Tensor) -> Iterator[Tensor]:
        """PSFs of places (N, 2), row by row, one after the other."""
        across = cubic_weights(self.columns, places[:, 0]).to(self.psfs)
        along = cubic_weights(self.rows, places[:, 1]).to(self.psfs)
        for _, group in itertools.groupby(range(len(places)), key=places[:, 1].tolist().__getitem__):
            own = list(group)
            row = _sum(along[own[0]], self.psfs)
            if row.requires_grad:  # on the way back each would fill a row of its own with zeros
                yield from (across[own] @ row.flatten(1)).unflatten(1, row.shape[1:])
            else:
                yield from (_sum(across[index], row) for index in own)


def grid(n: int, *, apart: float) -> Tensor:
    """Places of a side of n pixels: both ends, and between them at most `apart` from the next; at least four."""
    if n == 1:
        return torch.zeros(1, dtype=torch.float64)
    count = max(_POINTS, 1 + math.ceil((n - 1) / apart))
    return torch.linspace(-(n - 1) / 2, (n - 1) / 2, count, dtype=torch.float64)


def halved(nodes: Tensor) -> Tensor:
    """Even nodes, and the middles between them."""
    return _woven(nodes, (nodes[1:] + nodes[:-1]) / 2, dim=0)


def _sum(weights: Tensor, psfs: Tensor) -> Tensor:
    """Of PSFs (N, ...) with weights (N,), few of them other than 0."""
    near = weights.nonzero()[:, 0]
    few = psfs[int(near[0]) : int(near[-1]) + 1]
    return (weights[near[0] : near[-1] + 1] @ few.flatten(1)).view(psfs.shape[1:])


def _woven(own: Tensor, between: Tensor, *, dim: int) -> Tensor:
    """n tensors along a dimension, and n - 1 between them."""
    if own.shape[dim] == 1:
        return own
    pairs = torch.stack([own.narrow(dim, 0, between.shape[dim]), between], dim + 1).flatten(dim, dim + 1)
    return torch.cat([pairs, own.narrow(dim, -1, 1)], dim)


def _computed(bank: Bank, rows: Tensor, columns: Tensor) -> Tensor:
    """PSFs (Y, X, ...), none of no places. Where gradients are asked for, they are computed again on the way back."""
    if not len(rows) * len(columns):
        return rows.new_empty(0)
    count = len(rows)
    found: dict[int, Tensor] = {}
    for first in range((count + 1) // 2):
        pair = sorted({first, count - 1 - first})  # rows mirror each other: their PSFs too, where optics are centred
        places = torch.cartesian_prod(rows[pair], columns).flip(1)
        psfs = checkpoint(bank, places, use_reentrant=False) if torch.is_grad_enabled() else bank(places)
        found |= dict(zip(pair, psfs.unflatten(0, (len(pair), -1)), strict=True))
    return torch.stack([found[row] for row in range(count)])


def cubic_weights(nodes: Tensor, at: Tensor) -> Tensor:
    """Weights (N, n) of the cubic through the four of the even nodes (n,) that are next to `at` (N,)."""
    if len(nodes) == 1:
        return at.new_ones(len(at), 1)
    position = (at - nodes[0]) / (nodes[1] - nodes[0])
    first = (position.floor() - 1).clamp(0, len(nodes) - _POINTS)
    own = torch.arange(_POINTS, dtype=at.dtype)
    off = (position - first)[:, None] - own
    others = [own[own != k].long() for k in range(_POINTS)]
    weights = torch.stack([(off[:, rest] / (k - own[rest])).prod(1) for k, rest in enumerate(others)], dim=1)
    index = first.long()[:, None] + own.long()
    return at.new_zeros(len(at), len(nodes)).scatter(1, index, weights)
