"""PSFs of places between those where they are known: by cubic polynomials along x and y.

The error is of fourth order in their distance, where windows between neighbouring PSFs leave one of second order: a
picture may have four times as many nodes as there are PSFs, or sixteen.
"""

from __future__ import annotations

import math
from collections.abc import Callable
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
        """PSFs at most so many pixels apart. Where gradients are asked for, they are computed again on the way back."""
        rows, columns = (grid(n, apart=apart) for n in picture)
        count = len(rows)
        found: dict[int, Tensor] = {}
        for first in range((count + 1) // 2):  # rows that mirror each other: their PSFs too, where optics are centred
            pair = sorted({first, count - 1 - first})
            places = torch.cartesian_prod(rows[pair], columns).flip(1)
            psfs = checkpoint(bank, places, use_reentrant=False) if torch.is_grad_enabled() else bank(places)
            found |= dict(zip(pair, psfs.unflatten(0, (len(pair), -1)), strict=True))
        return cls(rows, columns, torch.stack([found[row] for row in range(count)]))

    def middle(self, place: Tensor) -> Tensor:
        """Of the cell around a place (1, 2)."""
        nodes = (self.columns, self.rows)
        middles = [(own[1:] + own[:-1]) / 2 if len(own) > 1 else own for own in nodes]
        return torch.stack([own[(own - at).abs().argmin()] for own, at in zip(middles, place[0], strict=True)])[None]

    def __call__(self, places: Tensor) -> Tensor:
        """PSFs (N, ...) of places (N, 2), x and y."""
        across = cubic_weights(self.columns, places[:, 0]).to(self.psfs)
        along = cubic_weights(self.rows, places[:, 1]).to(self.psfs)
        found = [places.new_zeros(())] * len(places)
        for y in places[:, 1].unique().tolist():
            own = (places[:, 1] == y).nonzero()[:, 0]
            weights = along[own[0]]
            near = weights.nonzero()[:, 0]
            row = torch.tensordot(weights[near], self.psfs[near], dims=1)
            for index, psf in zip(own.tolist(), torch.tensordot(across[own], row, dims=1), strict=True):
                found[index] = psf
        return torch.stack(found)


def grid(n: int, *, apart: float) -> Tensor:
    """Places of a side of n pixels: both ends, and between them at most `apart` from the next; at least four."""
    if n == 1:
        return torch.zeros(1, dtype=torch.float64)
    count = max(_POINTS, 1 + math.ceil((n - 1) / apart))
    return torch.linspace(-(n - 1) / 2, (n - 1) / 2, count, dtype=torch.float64)


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
