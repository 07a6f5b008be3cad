"""Pupils over the field: exact at a few heights, wavelengths and vergences, and polynomials between them.

A lens that is symmetric about its axis is known from heights h >= 0: with the sign of h the sign of dy changes, so that
terms even in dy are polynomials of h^2, and odd ones h times such a polynomial. PSFs are never interpolated between
places: between two of them a PSF changes by much more than its pupil (notes/field.md: 1e-4 from six heights, where
PSFs at 17 heights leave 0.15).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from kcam.optics.compound.images import Frame, areas
from kcam.optics.compound.pupil import PupilFit, odd_terms
from kcam.optics.numerics import chebyshev_between, chebyshev_points, lagrange_products, lagrange_weights

Fitted = Callable[[Tensor, Tensor, Tensor], PupilFit]
"""Pupils of F x Z x L nodes: heights (F,), vergences (Z,), wavelengths (L,)."""

DEVIATION = 3e-3  # that a table may have: of a PSF's light, about
_HEIGHTS = (6, 10, 17, 28)
_OTHERS = (3, 5, 8)  # wavelengths, vergences
_ALL = 4  # so many values are nodes themselves
_BEYOND = 1.01  # of the largest height


@dataclass(frozen=True)
class PupilTable:
    """Pupils of one lens. heights (F,), vergences (Z,), wavelengths (L,): of the nodes. highest: of the range of
    heights; fitted: of F x Z x L nodes; deviation: of the PSFs' light (L1), about, as hidden nodes tell it.
    """

    heights: Tensor
    vergences: Tensor
    wavelengths: Tensor
    highest: float
    fitted: PupilFit
    deviation: float = 0.0

    def at(self, heights: Tensor, vergences: Tensor, wavelengths: Tensor) -> PupilFit:
        """Pupils of N points, (N,) each; differentiable in all that comes in, and in the nodes."""
        colours = lagrange_weights(self.wavelengths**-2, wavelengths**-2)  # in which indices are nearly straight
        others = _outer(lagrange_weights(self.vergences, vergences), colours)
        even, odd = (_outer(own, others) for own in _parities(self.heights, heights, self.highest))
        fitted = self.fitted
        turns = odd_terms(fitted.degree).to(even.device)

        def between(values: Tensor, odd_in_height: Tensor | bool) -> Tensor:
            flat = values.reshape(len(values), -1)
            mixed = torch.where(torch.as_tensor(odd_in_height, device=even.device), odd @ flat, even @ flat)
            return mixed.view(-1, *values.shape[1:])

        clearances = fitted.clearances
        return PupilFit(
            fitted.degree,
            between(fitted.centre, True),
            between(fitted.half_width, False),
            between(fitted.wavefront, turns),
            between(clearances, turns.repeat(clearances.shape[1])),
            between(fitted.chief, True),
            between(fitted.residual.detach(), False).abs(),
        )


def tabulate(fitted: Fitted, *, highest: float, vergences: Tensor, wavelengths: Tensor) -> PupilTable:
    """A table for heights up to `highest`, vergences (Z,) and wavelengths (L,): with more nodes until hidden ones
    between them are within `DEVIATION`, or there are no more.
    """
    counts = [0, 0, 0]
    with torch.no_grad():
        while True:
            table = _table(fitted, highest, vergences, wavelengths, counts)
            off = [_hidden(fitted, table, axis) if _grows(table, counts, axis) else 0.0 for axis in range(3)]
            table = replace(table, deviation=max(off))
            worse = [axis for axis in range(3) if off[axis] > DEVIATION and counts[axis] + 1 < len(_steps(axis))]
            if not worse:
                break
            for axis in worse:
                counts[axis] += 1
    if not torch.is_grad_enabled():
        return table
    traced = checkpoint(_table, fitted, highest, vergences, wavelengths, counts, use_reentrant=False)
    return replace(traced, deviation=table.deviation)


_NODES = ("heights", "vergences", "wavelengths")


def _steps(axis: int) -> tuple[int, ...]:
    return _HEIGHTS if axis == 0 else _OTHERS


def _table(fitted: Fitted, highest: float, vergences: Tensor, wavelengths: Tensor, counts: list[int]) -> PupilTable:
    heights = torch.zeros(1, dtype=torch.float64)
    if highest > 0:
        n = _HEIGHTS[counts[0]]
        heights = _BEYOND * highest * chebyshev_points(2 * n)[:n]
    near, colours = _nodes(vergences, _OTHERS[counts[1]]), _nodes(wavelengths**-2, _OTHERS[counts[2]]) ** -0.5
    return PupilTable(heights, near, colours, _BEYOND * highest, fitted(heights, near, colours))


def _nodes(values: Tensor, count: int) -> Tensor:
    """The values themselves where they are few, else Chebyshev points of their range."""
    order = values.detach().argsort()
    ordered = values[order]
    own = ordered[torch.cat([ordered.new_ones(1, dtype=torch.bool), ordered.detach().diff() > 0])]
    if len(own) <= max(_ALL, count):
        return own
    return chebyshev_between(*own.detach().aminmax(), count)


def _grows(table: PupilTable, counts: list[int], axis: int) -> bool:
    """Whether an axis has nodes that values lie between."""
    return getattr(table, _NODES[axis]).numel() == _steps(axis)[counts[axis]]


def _hidden(fitted: Fitted, table: PupilTable, axis: int) -> float:
    """How far the table is from hidden nodes between its own along an axis: 2 pi times the wavefront's rms in waves,
    and the share of the pupil that is open in one and not in the other.
    """
    nodes = {name: getattr(table, name).detach() for name in _NODES}
    own = nodes[_NODES[axis]].sort().values
    between = (own[1:] + own[:-1]) / 2
    for name in _NODES:
        nodes[name] = between[[-1, len(between) // 2]] if name == _NODES[axis] else nodes[name][:1]
    truth = fitted(*(nodes[name] for name in _NODES))
    grid = torch.meshgrid(*(nodes[name] for name in _NODES), indexing="ij")
    found = table.at(*(part.flatten() for part in grid))
    return float(difference(truth, found, grid[2].flatten()).max())


def difference(first: PupilFit, second: PupilFit, wavelengths: Tensor) -> Tensor:
    """Between two descriptions of the same N pupils: 2 pi times the rms of the wavefronts' difference in waves, without
    what only moves the image, and how much of the area is open in one and not in the other.
    """
    nodes = torch.arange(len(first.centre))
    side = torch.linspace(-1, 1, 41, dtype=torch.float64)
    r, centre = first.radius[:, None, None], first.centre[:, None, None]
    dx, dy = torch.broadcast_tensors(r * side, centre + r * side[:, None])
    (path, clearances), (other, others) = (fitted.at(nodes, dx, dy) for fitted in (first, second))
    both = (clearances > 0).all(1) & (others > 0).all(1)
    off = torch.where(both, path - other, 0.0)
    count = both.sum((1, 2)).clamp(min=1)[:, None, None]
    off = torch.where(both, off - off.sum((1, 2), keepdim=True) / count, 0.0)
    phase = 2 * math.pi * (off.square().sum((1, 2)) / count[:, 0, 0]).sqrt() / wavelengths
    one, two = (areas(fitted, Frame.upright(fitted)) for fitted in (first, second))
    return phase + (two / one - 1).abs()


def _parities(nodes: Tensor, at: Tensor, highest: float) -> tuple[Tensor, Tensor]:
    """Weights for what is even and what is odd in the height: nodes stand on both sides of the axis."""
    if len(nodes) == 1:
        one = at.new_ones(len(at), 1, dtype=torch.float64)
        return one, one
    both = lagrange_products(2 / highest * torch.cat([nodes, -nodes]), 2 / highest * at)
    right, left = both.split(len(nodes), dim=1)
    return right + left, right - left


def _outer(first: Tensor, second: Tensor) -> Tensor:
    return (first[:, :, None] * second[:, None, :]).flatten(1)
