"""Maps of flat pixels and the aperture's rim on common cells, in which each pixel of each map is whole; their field."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcam.optics.autograd import apply_linear, once_differentiable
from kcam.optics.numerics import Pair, sines
from kcam.optics.propagation.question import Query
from kcam.optics.propagation.transforms import PlainLayout, Transform
from kcam.optics.pupil.banded import MapWeights
from kcam.optics.pupil.coordinates import grid_nodes
from kcam.optics.pupil.maps import PixelMap, pixel_weights
from kcam.optics.pupil.rim import disc_area_below
from kcam.optics.pupil.warp import Warp
from kcam.precision import full_precision

_MOST_CELLS = 3072  # that the rim asks for
_IN_CACHE = 2**17  # cells whose field is computed at once
Maps = tuple[tuple[int, float], ...]
"""Pixels and half width, in semi-apertures, of each map."""


@dataclass(frozen=True)
class Cells:
    """All pixel maps of a lens on common cells over the bounding square of the aperture, and the way to the pupil grid.

    edges: (C + 1,) of the cells along each axis, from -1 to 1 in units of the semi-aperture.
    amplitude, power: (C, C) what the aperture transmits; of power, the rim by the exact area of each cell.
    phases: (E, C, C) of the phase maps [rad], their `factors` (E, L).
    weights: from the cells to the pupil grid.
    """

    edges: Tensor
    amplitude: Tensor
    power: Tensor
    phases: Tensor
    factors: Tensor
    weights: MapWeights

    @staticmethod
    def of(query: Query, wavelengths: Tensor, *, count: int, spacing: float) -> Cells | None:
        """Those of a query on a pupil grid; None where its lens has no pixels."""
        discs = query.lens.aperture.discs()
        found = query.lens.pixel_maps(wavelengths)
        if not found:
            return None
        if query.semi_aperture.requires_grad and any(pixels.half_width is not None for pixels in found):
            raise ValueError(
                "a DOE with a pitch of its own does not follow a trainable aperture; leave pitch=None, so that the map "
                "spans the aperture, or give the aperture's size as a number."
            )
        maps = sizes(query, found)
        widest = 2 / min(query.how.cells_per_sample * count, max(_MOST_CELLS, 2 * count)) if discs else math.inf
        like: Any = {"dtype": query.dtype, "device": query.device}
        edges, _ = cell_edges(maps, widest)

        if discs:
            amplitude, power = disc_cells(discs, maps, widest, **like)
        else:
            amplitude = power = torch.ones((), **like).expand(len(edges) - 1, len(edges) - 1)
        phases, factors = [], []
        for pixels, (size, width) in zip(found, maps, strict=True):
            values = looked_up(pixels.values.to(**like), edges, size=size, half_width=width)
            if pixels.factors is None:
                amplitude, power = amplitude * values, power * values**2
            else:
                phases.append(values)
                factors.append(pixels.factors)
        weights = map_weights(maps, widest, count=count, spacing=spacing, **like)
        none = amplitude.new_empty(0, *amplitude.shape), amplitude.new_empty(0, len(wavelengths))
        turned, dispersed = (torch.stack(phases), torch.stack(factors).to(query.dtype)) if phases else none
        return Cells(torch.as_tensor(edges), amplitude, power, turned, dispersed, weights)

    def field(self, warp: Warp | None, layout: Transform | PlainLayout) -> Tensor:
        """Transmission and phase on the true plane's grid, or on to the image-side plane's by `warp`.

        Real and imaginary part, (2, L, ...) in a transform's layout.
        """
        onto = _Onto(self.weights, warp, layout)
        if len(self.phases):
            return _PixelField.apply(self.phases, self.factors, self.amplitude, onto)
        passed = apply_linear(self.amplitude, onto)  # at all wavelengths alike
        return torch.stack([passed, torch.zeros_like(passed)])[:, None].expand(-1, self.factors.shape[1], *passed.shape)

    def energy(self, semi_aperture: Tensor, vergences: Tensor) -> Tensor:
        """INT power / (1 + V^2 r^2) d^2 u of spherical waves, (Z,) [m^2].

        1 / (1 + s) = INT exp(-t) exp(-s t) dt by n nodes of Gauss and Laguerre, whose terms are products over x and y,
        to (s / (2 + s))^2n = 1e-10; sources nearer than a semi-aperture or so are summed cell by cell.
        """
        edges = self.edges.to(vergences.device) * semi_aperture
        centres, sides = (edges[1:] + edges[:-1]) / 2, edges.diff()
        steepest = 2 * float((vergences.detach() * semi_aperture.detach()).abs().max()) ** 2
        ratio = steepest / (2 + steepest)
        if not ratio < 0.4:  # or NaN, which stays NaN
            r2, area = centres[:, None] ** 2 + centres**2, sides[:, None] * sides
            return torch.stack([(self.power * (area / (1 + v**2 * r2))).sum() for v in vergences])
        nodes = math.ceil(math.log(1e-10) / (2 * math.log(max(ratio, 1e-12))))
        times, weights = (torch.as_tensor(v).to(vergences) for v in _laguerre(nodes))
        profile = torch.exp(-times[:, None] * (vergences[:, None, None] * centres) ** 2) * sides
        rows = (profile.to(self.power) @ self.power).to(profile)
        return (rows * profile).sum(-1) @ weights


_laguerre = functools.lru_cache(np.polynomial.laguerre.laggauss)


def sizes(query: Query, found: Sequence[PixelMap]) -> Maps:
    """Pixels and half width of the maps of a query's lens."""
    semi = float(query.semi_aperture.detach())
    widths = [1.0 if pixels.half_width is None else float(pixels.half_width) / semi for pixels in found]
    return tuple((pixels.values.shape[-1], width) for pixels, width in zip(found, widths, strict=True))


@functools.lru_cache(maxsize=12)
def cell_edges(maps: Maps, widest: float) -> tuple[np.ndarray, np.ndarray]:
    """Edges of the coarsest cells over [-1, 1] in which each pixel of each map is whole, and none wider than `widest`.

    A map that ends inside continues with its outermost pixels; of one that reaches beyond, what is inside counts.

    Returns:   (C + 1,) ascending, and which of them are edges of pixels, (C + 1,) bool.
    """
    lines = np.concatenate([[-1.0, 1.0], *(np.linspace(-width, width, size + 1) for size, width in maps)])
    lines = np.unique(lines[np.abs(lines) <= 1].round(12))  # 2 / 3 and 4 / 6 are one
    parts = np.maximum(1, np.ceil(np.diff(lines) / widest - 1e-9)).astype(int)
    within = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    edges = np.repeat(lines[:-1], parts) + within * np.repeat(np.diff(lines) / parts, parts)
    return np.append(edges, 1.0), np.append(within == 0, True)


@functools.lru_cache(maxsize=8)
@torch.inference_mode(False)
def disc_cells(
    discs: tuple[tuple[float, float], ...], maps: Maps, widest: float, *, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Centred discs (radius, weight) in the cells of `cell_edges`: amplitude and power, (C, C) each.

    power: the share of each cell that is inside, exact. amplitude: what the cells must hold to diffract as the rim
    does. A share is the rim averaged over its cell, and a flat cell averages it again: both droop as sinc^2 of the
    frequency in cycles per cell, which a twelfth of the second differences undoes to the fourth order. Only cells of
    one pixel exchange it; the next pixel may have any phase. So nothing is undone where cells are pixels.
    """
    edges, of_pixels = cell_edges(maps, widest)
    share = np.zeros((len(edges) - 1, len(edges) - 1))
    for radius, weight in discs:
        at, side = np.abs(edges / radius), np.diff(edges / radius)
        area = disc_area_below(at[:, None], at[None, :]) * np.sign(edges)[:, None] * np.sign(edges)
        share += weight * (np.diff(np.diff(area, axis=0), axis=1) / (side[:, None] * side)).clip(0, 1)
    amplitude = share
    for _ in range(2):  # along x, then (transposed) along y
        slope = np.diff(amplitude, prepend=0, append=0)
        slope[:, of_pixels] = 0
        amplitude = (amplitude - np.diff(slope) / 12).T
    return torch.as_tensor(amplitude).to(device, dtype).contiguous(), torch.as_tensor(share).to(device, dtype)


def looked_up(values: Tensor, edges: np.ndarray, *, size: int, half_width: float) -> Tensor:
    """A map (n, n) in the cells (C, C); its outermost pixels continue."""
    if size == len(edges) - 1 and half_width == 1:
        return values
    centres = (edges[1:] + edges[:-1]) / 2
    index = np.floor((centres / half_width + 1) / 2 * size).astype(np.int64).clip(0, size - 1)
    index = torch.as_tensor(index, device=values.device)
    return values.index_select(1, index).index_select(0, index)  # whole rows last: they are copied at once


@functools.lru_cache(maxsize=6)
@torch.inference_mode(False)
def map_weights(
    maps: Maps, widest: float, *, count: int, spacing: float, dtype: torch.dtype, device: torch.device
) -> MapWeights:
    """Weights that bring the cells of `cell_edges` onto the true pupil plane, through a low-pass at its Nyquist.

    Args:
        count, spacing: of the pupil grid.
        dtype: of the weights, which are built in float64.
    Valid when the grid has at least 2.5 samples per cycle of what reaches the window (the default sampling).
    """
    edges = torch.as_tensor(cell_edges(maps, widest)[0])
    nodes = grid_nodes(count, spacing=spacing)
    return MapWeights.build(pixel_weights(edges, nodes, spacing=spacing).T, dtype=dtype, device=device)


@dataclass(frozen=True)
class _Onto:
    """Cells onto the true plane's grid, from there to the image-side plane where there is a warp, in a layout."""

    weights: MapWeights
    warp: Warp | None
    layout: Transform | PlainLayout

    def forward(self, field: Tensor) -> Tensor:
        grid = self.weights.forward(field)
        return self.layout.arrange(grid if self.warp is None else self.warp.forward(grid))

    def adjoint(self, values: Tensor) -> Tensor:
        grid = self.layout.disarrange(values)
        return self.weights.adjoint(grid if self.warp is None else self.warp.adjoint(grid))


class _PixelField(torch.autograd.Function):
    """Low-passed amplitude * exp(i sum_e factor_e * phase_e) of each wavelength, real and imaginary part (2, L, ...).

    Sines are computed a few rows at a time, near the processor: of all cells at once they take twice the time. None are
    kept for the backward pass.
    """

    @staticmethod
    def forward(ctx, phases, factors, amplitude, onto):
        ctx.save_for_backward(phases, factors, amplitude)
        ctx.onto = onto
        field = amplitude.new_empty(2, *amplitude.shape)
        grids = []
        for factor in factors.T:
            for rows in _few_rows(amplitude):
                for values, part in zip(_sines(factor, phases[:, rows]), field, strict=True):
                    torch.mul(values, amplitude[rows], out=part[rows])
            grids.append([onto.forward(part) for part in field])
        return torch.stack([part for parts in zip(*grids, strict=True) for part in parts]).unflatten(0, (2, -1))

    @staticmethod
    @once_differentiable
    def backward(ctx, saved, grad):
        phases, factors, amplitude = saved
        d_phases = torch.zeros_like(phases)
        d_amplitude = torch.zeros_like(amplitude) if ctx.needs_input_grad[2] else None
        for index, factor in enumerate(factors.T):
            with full_precision(grad.device):
                onto_re, onto_im = (ctx.onto.adjoint(part[index]) for part in grad)
            for rows in _few_rows(amplitude):
                cosine, sine = _sines(factor, phases[:, rows])
                if d_amplitude is not None:
                    d_amplitude[rows].addcmul_(cosine, onto_re[rows]).addcmul_(sine, onto_im[rows])
                d_angle = cosine.mul_(onto_im[rows]).addcmul_(sine, onto_re[rows], value=-1)
                for d_phase, own in zip(d_phases, factor, strict=True):
                    d_phase[rows].addcmul_(d_angle, own)
        return d_phases.mul_(amplitude), None, d_amplitude, None


def _few_rows(cells: Tensor) -> list[slice]:
    """Rows of a square of cells, as many at once as stay in a CPU's cache."""
    count = len(cells)
    step = max(1, _IN_CACHE // count) if cells.device.type == "cpu" else count
    return [slice(start, start + step) for start in range(0, count, step)]


def _sines(factor: Tensor, phases: Tensor) -> Pair:
    """Cosine and sine of sum_e factor_e * phase_e."""
    angle = factor[0] * phases[0]
    for own, phase in zip(factor[1:], phases[1:], strict=True):
        angle.addcmul_(own, phase)
    return sines(angle)
