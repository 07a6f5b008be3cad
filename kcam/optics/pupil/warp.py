"""From the true pupil plane, where a map's pixels are straight, to the image-side plane, where the kernel is.

The field there is band-limited and its samples hardly move (by 0.19 tau semi-apertures at most), so they are
interpolated along x, then along y, by a Kaiser-windowed sinc. Nodes beside each other move about alike: the weights of
a tile of them are a short power series in what each moves beyond the tile's middle, one small matrix product for all
terms, the same for all wavelengths on one grid.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass

import numpy as np
import scipy
import torch
from numpy.polynomial import chebyshev
from torch import Tensor

from kcam.optics.numerics import lagrange
from kcam.optics.pupil.banded import slab_width
from kcam.optics.pupil.coordinates import grid_nodes
from kcam.optics.pupil.rim import kaiser_sinc

_ALONG = 32  # nodes of a tile: narrow enough to leave out most zeros, wide enough for a matrix product
_WIDEST = 3.0  # samples that moves differ by along a tile, and across it, at most
_MOST_TERMS, _MOST = 28, 5.5  # enough for moves of so many samples to either side of a tile's middle
_HALF_WIDTH = 16  # samples; half width of the interpolating sinc
_BETA = 10.4  # both passes: 4e-6 of a field's mean off, 6e-5 at 0.76 of the Nyquist frequency; kappa 2.5 needs 0.8
_SMALLEST = 3e-5  # coefficient of the series that is kept
_FARTHEST, _BEYOND = 1.3, 0.03  # semi-apertures up to which moves are right, as what the rim's low-pass leaves needs
# them where there are few nodes; beyond the rim at most, times tau


@dataclass(frozen=True)
class _Tile:
    """Nodes `along` the axis of a pass and `across` it, interpolated from the nodes `source` along it.

    weights: of each power of their moves, (terms * along, source).
    """

    along: slice
    across: slice
    source: slice
    weights: Tensor


@dataclass(frozen=True)
class Warp:
    """Linear map (N, N) -> (N, N) by interpolation along rows, then along columns.

    tiles: of the nodes that light passes, for both passes. moves: of each node beyond the middle of its tile [samples],
    of each pass, the axis of the pass first, (2, N, N).
    """

    tiles: tuple[_Tile, ...]
    moves: Tensor

    @staticmethod
    @functools.lru_cache(maxsize=4)
    @torch.inference_mode(False)
    def build(
        count: int, *, spacing: float, tau: float, round: bool, dtype: torch.dtype, device: torch.device
    ) -> Warp | None:
        """For pupil grids (N, N), both planes alike; None where nothing moves. round: whether the corners are dark.

        Raises: ValueError for an aperture so wide that neighbours move too differently.
        """
        nodes = grid_nodes(count, spacing=spacing)
        farthest = min(float(nodes[-1]), _FARTHEST, 1 + _BEYOND / max(abs(tau), 1e-9))
        at, corner2 = nodes.to(dtype), (1 if round else 2) * farthest**2
        moves = _moves(at[:, None], at**2, tau, corner2) / spacing
        if float(moves.abs().max()) < 1e-4:
            return None
        alike = _alike(moves, nodes if round else None, width=slab_width(_ALONG, device))
        ends = torch.stack([torch.stack(moves[:, own, beside].aminmax()) for own, beside in alike]).double()
        middle, half = ends.mean(1), (ends[:, 1] - ends[:, 0]) / 2
        if float(half.max()) > _MOST:
            raise ValueError(
                "rays leave maps of pixels too steeply through an aperture of "
                f"f/{0.5 / math.sqrt(abs(tau)):.2g}. Use a smaller aperture, or a round one, or "
                'propagator="fresnel", which has no such rays.'
            )
        whole = middle.round()
        series, reach = _series((middle - whole).numpy(), half.clamp(min=1e-4).numpy())
        tiles = []
        for (own, beside), powers, moved, shift in zip(alike, series, middle.tolist(), whole.tolist(), strict=True):
            moves[:, own, beside] -= moved
            place = own.start + int(shift), own.stop + int(shift)
            first = min(max(0, place[0] - reach), count - 1)
            source = slice(first, max(first + 1, min(count, place[1] + reach)))
            lag = torch.arange(*place)[:, None] - torch.arange(first, source.stop)
            weights = torch.from_numpy(powers)[:, lag.clamp(-reach - 1, reach + 1) + reach + 1]
            tiles.append(_Tile(own, beside, source, weights.flatten(0, 1).to(device, dtype)))
        return Warp(tuple(tiles), moves.to(device))

    def forward(self, field: Tensor) -> Tensor:
        """(N, N) in the true plane -> (N, N) in the image-side plane."""
        return self._along(self._along(field.mT, self.moves[0]).mT, self.moves[1])

    def adjoint(self, grid: Tensor) -> Tensor:
        """The transpose of `forward`."""
        return self._back(self._back(grid, self.moves[1]).mT, self.moves[0]).mT

    def _along(self, field: Tensor, moves: Tensor) -> Tensor:
        out = torch.zeros_like(moves)
        for tile in self.tiles:
            move = moves[tile.along, tile.across]
            terms = (tile.weights @ field[tile.source, tile.across]).view(-1, *move.shape)
            total = terms[-1]
            for term in reversed(terms[:-1].unbind()):  # Horner's rule
                total = torch.addcmul(term, total, move)
            out[tile.along, tile.across] = total
        return out

    def _back(self, grid: Tensor, moves: Tensor) -> Tensor:
        field = torch.zeros_like(moves)
        for tile in self.tiles:
            move = moves[tile.along, tile.across]
            powers = grid.new_empty(tile.weights.shape[0] // len(move), *move.shape)
            powers[0] = grid[tile.along, tile.across]
            for before, power in itertools.pairwise(powers):
                torch.mul(before, move, out=power)
            field[tile.source, tile.across].addmm_(tile.weights.T, powers.flatten(0, 1))
        return field


def _moves(at: Tensor, other2: Tensor, tau: float, corner2: float) -> Tensor:
    """How far nodes move along an axis, (2, ...) [semi-apertures]: along x at a true y, along y at an image-side x.

    rho^2 = rho'^2 / (1 + tau - tau rho'^2), without a difference of what is nearly the same.
    """
    excess = tau * (1 - (at**2 + other2).clamp(max=corner2))
    rest = excess / (1 + tau - tau * at**2).clamp(min=0.1)
    excess = excess.clamp(min=-0.9)
    first = -at * rest / (1 + torch.sqrt(1 - rest))
    return torch.stack([first, -at * excess / (1 + excess + torch.sqrt(1 + excess))])


def _alike(moves: Tensor, nodes: Tensor | None, *, width: int) -> list[tuple[slice, slice]]:
    """Nodes that move about alike: along the axis of a pass, so many at most, and across it. nodes: of a pupil that is
    dark in the corners.
    """
    count, found, start = moves.shape[-1], [], 0
    steps = moves[..., :: max(1, count // 64)].diff(dim=1).abs().amax((0, 2)).tolist()
    while start < count:
        stop, apart = start + 1, 0.0
        while stop < min(start + width, count) and (apart := apart + steps[stop - 1]) < _WIDEST:
            stop += 1
        own, dark = slice(start, stop), 0
        if nodes is not None:  # the low-pass of the rim is as wide along x and y: along diagonals it reaches farther
            farthest = 1 + math.sqrt(2) * (float(nodes[-1]) - 1)
            dark = int((nodes**2 > farthest**2 - (nodes[own] ** 2).min()).sum()) // 2
        level = moves[:, (start + stop) // 2, dark : count - dark].mean(0) / _WIDEST
        ends = [dark, *(level.round().diff().nonzero().flatten() + dark + 1).tolist(), count - dark]
        found += [(own, slice(*pair)) for pair in itertools.pairwise(ends) if pair[0] < pair[1]]
        start = stop
    return found


def _series(middle: np.ndarray, half: np.ndarray) -> tuple[list[np.ndarray], int]:
    """Of tiles whose nodes move by middle +- half (T,) [samples], the interpolation kernel h(lag + middle + u) as a
    series of powers of u, (terms, lags) with a 0 on either side; and the largest lag.
    """
    reach = math.ceil(_HALF_WIDTH + float((np.abs(middle) + half).max()))
    nodes = np.cos(np.pi * (np.arange(_MOST_TERMS) + 0.5) / _MOST_TERMS)
    at = (middle[:, None] + half[:, None] * nodes)[..., None] + np.arange(-reach - 1, reach + 2)
    values = kaiser_sinc(at, half_width=_HALF_WIDTH, beta=_BETA)
    # Chebyshev polynomials are orthogonal at these nodes: this is the least-squares fit
    fitted = scipy.fft.dct(values, axis=1) / _MOST_TERMS
    fitted[:, 0] /= 2
    kept = (np.abs(fitted).max(-1) > _SMALLEST).cumsum(-1).argmax(-1) + 1
    return [
        _powers(terms) @ own[:terms] * wide ** -np.arange(terms)[:, None]
        for own, terms, wide in zip(fitted, kept.tolist(), half.tolist(), strict=True)
    ], reach


@functools.lru_cache(maxsize=_MOST_TERMS)
def _powers(terms: int) -> np.ndarray:
    """Chebyshev's polynomials as powers: (power, polynomial)."""
    rows = (chebyshev.cheb2poly(row[: order + 1]) for order, row in enumerate(np.eye(terms)))
    return np.stack([np.pad(row, (0, terms - len(row))) for row in rows], axis=1)


def warp_terms(count: int, tau: float) -> float:
    """About how many terms the series of a pupil of so many samples has, without building it."""
    return 2.4 + 1.9 * (0.19 * tau * count / 2) ** 0.6


@dataclass(frozen=True)
class Interpolation:
    """Values along rows (..., R, N), 0 beyond them, at positions of each row (R, n).

    first: of the neighbours of each position, (R, n). weights: of these, (taps, R, n). length: N.
    """

    first: Tensor
    weights: Tensor
    length: int

    @staticmethod
    def by_sinc(positions: Tensor, length: int, *, dtype: torch.dtype) -> Interpolation:
        """As a `Warp`, of any displacement; positions in samples, 0 of the first."""
        low, offset = _split(positions, dtype)
        taps = torch.arange(1 - _HALF_WIDTH, _HALF_WIDTH + 1, device=positions.device)[:, None, None]
        inside = (1 - ((offset - taps) / _HALF_WIDTH) ** 2).clamp(min=0)
        weights = torch.sinc(offset - taps) * torch.special.i0(_BETA * inside.sqrt()) / float(np.i0(_BETA))
        return Interpolation(low + int(taps[0]), weights, length)

    @staticmethod
    def by_polynomial(positions: Tensor, length: int, *, dtype: torch.dtype) -> Interpolation:
        """Through the eight nearest: for what is sampled a little finer than it must be; differentiable."""
        low, offset = _split(positions, dtype)
        taps = range(-3, 5)
        return Interpolation(low + taps[0], torch.stack(lagrange(offset, taps=taps)), length)

    def forward(self, rows: Tensor) -> Tensor:
        """(..., R, N) -> (..., R, n)."""
        rows = torch.nn.functional.pad(rows, (1, 1))
        found = rows.new_zeros(*rows.shape[:-1], self.first.shape[-1])
        for tap, weight in enumerate(self.weights):
            found = torch.addcmul(found, rows.gather(-1, self._index(tap, found)), weight)
        return found

    def adjoint(self, values: Tensor) -> Tensor:
        """Transpose of `forward`."""
        rows = values.new_zeros(*values.shape[:-1], self.length + 2)
        for tap, weight in enumerate(self.weights):
            rows.scatter_add_(-1, self._index(tap, values), values * weight)
        return rows[..., 1:-1]

    def _index(self, tap: int, like: Tensor) -> Tensor:
        return (self.first + (tap + 1)).clamp(0, self.length + 1).expand(like.shape)


def _split(positions: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    low = positions.detach().floor()
    return low.long(), (positions - low).to(dtype)
