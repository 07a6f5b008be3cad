"""From the true pupil plane, where a map's pixels are straight, to the image-side plane, where the kernel is.

The field there is band-limited and its samples hardly move (by 0.19 tau semi-apertures at most), so they are
interpolated along x, then along y, by a Kaiser-windowed sinc. Its weights are a short Chebyshev series in the
displacement: a few banded matrix products, the same for all wavelengths on one grid.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy
import torch
from torch import Tensor

from kcam.optics.numerics import lagrange
from kcam.optics.pupil.banded import pieces, slab_width
from kcam.optics.pupil.coordinates import grid_nodes
from kcam.optics.pupil.rim import kaiser_sinc

_SLAB = 64  # columns: narrow enough to leave out most zeros, wide enough for a matrix product
_HALF_WIDTH = 16  # samples; half width of the interpolating sinc
_BETA = 10.4  # both passes: 4e-6 of a field's mean off, 6e-5 at 0.76 of the Nyquist frequency; kappa 2.5 needs 0.8
_SMALLEST = 3e-5  # coefficient of the series that is kept
_MOST_TERMS = 64


@dataclass(frozen=True)
class Warp:
    """Linear map (N, N) -> (N, N) by interpolation along rows, then along columns.

    slabs: (band, terms * columns), one for each slab of columns, for both passes; starts: of the bands.
    displacements: (N, N) in units of the largest, in which the series are Chebyshev's, for each pass.
    """

    slabs: tuple[Tensor, ...]
    starts: tuple[int, ...]
    terms: int
    displacements: tuple[Tensor, Tensor]

    @staticmethod
    @functools.lru_cache(maxsize=4)
    @torch.inference_mode(False)
    def build(
        count: int, *, spacing: float, tau: float, corner: float, dtype: torch.dtype, device: torch.device
    ) -> Warp | None:
        """For pupil grids (N, N), both planes alike; None where nothing moves. corner: largest rho that matters."""
        nodes = grid_nodes(count, spacing=spacing)
        x, y = nodes[None, :], nodes[:, None]
        # along x at a true y, then along y at an image-side x: rho'^2 = rho^2 (1 + tau) / (1 + tau rho^2)
        along_x = x * (torch.sqrt((1 + tau * y**2) / (1 + tau - tau * x**2).clamp(min=0.1)) - 1)
        along_y = y * (torch.rsqrt((1 + tau * (1 - x**2 - y**2)).clamp(min=0.1)) - 1)
        inside = x**2 + y**2 <= corner**2
        limit = max(float((d.abs() * inside).max()) for d in (along_x, along_y)) / spacing
        if limit < 1e-4:
            return None
        coefficients, reach = _series(limit)
        terms = coefficients.shape[0]
        slabs, starts = [], []
        width = slab_width(_SLAB, device)
        for first in range(0, count, width):
            columns = torch.arange(first, min(first + width, count))
            low, high = max(0, first - reach), min(count, int(columns[-1]) + reach + 1)
            lag = columns[None, :] - torch.arange(low, high)[:, None]
            inside_reach = lag.abs() <= reach
            values = coefficients[:, (lag.clamp(-reach, reach) + reach)] * inside_reach  # (terms, band, columns)
            slabs.append(values.permute(1, 0, 2).reshape(high - low, -1).to(device, dtype))
            starts.append(low)
        displacements = [
            (d / (spacing * limit)).clamp_(-1, 1).to(device, dtype).contiguous() for d in (along_x, along_y.T)
        ]
        return Warp(tuple(slabs), tuple(starts), terms, (displacements[0], displacements[1]))

    def forward(self, field: Tensor) -> Tensor:
        """(N, N) in the true plane -> (N, N) in the image-side plane."""
        return self._along(self._along(field, self.displacements[0]).T, self.displacements[1]).T

    def adjoint(self, grid: Tensor) -> Tensor:
        """The transpose of `forward`."""
        return self._back(self._back(grid.T, self.displacements[1]).T, self.displacements[0])

    def _along(self, field: Tensor, displacement: Tensor) -> Tensor:
        out = torch.empty_like(displacement)
        for slab, source, target in pieces(self.slabs, self.starts, terms=self.terms):
            terms = (field[:, source] @ slab).view(field.shape[0], self.terms, -1)
            result = terms[:, 0]
            for term, polynomial in zip(terms[:, 1:].unbind(1), _chebyshev(displacement[:, target]), strict=False):
                result.addcmul_(term, polynomial)
            out[:, target] = result
        return out

    def _back(self, grid: Tensor, displacement: Tensor) -> Tensor:
        field = torch.zeros_like(displacement)
        for slab, source, target in pieces(self.slabs, self.starts, terms=self.terms):
            terms = slab.new_empty(grid.shape[0], self.terms, slab.shape[1] // self.terms)
            terms[:, 0] = part = grid[:, target]
            for term, polynomial in zip(terms[:, 1:].unbind(1), _chebyshev(displacement[:, target]), strict=False):
                torch.mul(part, polynomial, out=term)
            field[:, source].addmm_(terms.flatten(1), slab.T)
        return field


def warp_terms(count: int, tau: float) -> float:
    """About how many terms the series of a pupil of so many samples has, without building it."""
    return 3 + 7 * (0.19 * tau * count / 2) ** 0.6


def _chebyshev(u: Tensor) -> Iterator[Tensor]:
    """T1(u), T2(u), ... without end."""
    before, now = torch.ones_like(u), u.clone()
    while True:
        yield now
        before, now = now, (2 * u * now).sub_(before)


def _series(limit: float) -> tuple[Tensor, int]:
    """Chebyshev coefficients (terms, 2 reach + 1) of the interpolation kernel h(lag + u * limit), |u| <= 1."""
    reach = int(np.ceil(_HALF_WIDTH + limit))
    nodes = np.cos(np.pi * (np.arange(2 * _MOST_TERMS) + 0.5) / (2 * _MOST_TERMS))
    values = kaiser_sinc(np.arange(-reach, reach + 1)[:, None] + limit * nodes, half_width=_HALF_WIDTH, beta=_BETA)
    # Chebyshev polynomials are orthogonal at these nodes: this is the least-squares fit
    fitted = scipy.fft.dct(values, axis=1)[:, :_MOST_TERMS].T / len(nodes)
    fitted[0] /= 2
    kept = np.nonzero(np.abs(fitted).max(1) > _SMALLEST)[0]
    return torch.as_tensor(fitted[: max(int(kept[-1]) + 1, 2)]), reach


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
