"""The rim of a pupil on a Cartesian grid: quadrature weights of high order, although it cuts through cells."""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

_EDGE_HALF_WIDTH = 6  # samples; half width of the low-pass for edge weights
_PROFILE_STEPS = 256
_BENT = 0.5  # of a distance, by which it is corrected at most: right at an edge it is not
_NEAR = _EDGE_HALF_WIDTH + 1.0  # samples from an edge within which it is felt, and one more
FINE = 5  # cells per sample in which the area of the rim is measured exactly
_NODES_AT_ONCE = 32  # rows of edge weights; more take more memory than the cells that they share take time


def disc_area_below(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Area of the unit disc's part in [0, x] x [0, y], x and y >= 0 (closed form)."""
    x, y = np.minimum(x, 1.0), np.minimum(y, 1.0)
    rim = np.sqrt(1 - y**2)

    def under_arc(t: np.ndarray) -> np.ndarray:
        return 0.5 * (t * np.sqrt(1 - t**2) + np.arcsin(t))

    return np.where(x <= rim, x * y, y * rim + under_arc(x) - under_arc(rim))


def kaiser_sinc(offset: np.ndarray, *, half_width: float, beta: float) -> np.ndarray:
    """Kaiser-windowed sinc with its zeros at the integers."""
    inside = np.clip(1 - (offset / half_width) ** 2, 0, None)
    return np.where(np.abs(offset) < half_width, np.sinc(offset) * np.i0(beta * np.sqrt(inside)) / np.i0(beta), 0.0)


def running_integral(half_width: int, *, beta: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Of a `kaiser_sinc` at so many steps for each sample: (offsets in samples, integral from -inf, up to 1)."""
    offset = np.linspace(-half_width, half_width, steps * 2 * half_width + 1)
    kernel = kaiser_sinc(offset, half_width=half_width, beta=beta)
    # Simpson-like correction of the trapezium: h^2/12 times the slope at the ends vanishes, the kernel is 0 there
    integral = np.concatenate([[0.0], np.cumsum((kernel[1:] + kernel[:-1]) / 2)]) * (offset[1] - offset[0])
    return offset, integral / integral[-1]


@functools.lru_cache(maxsize=1)
def _edge_taps() -> np.ndarray:
    """The low-pass of edge weights, a tap for each fine cell; the outer taps undo the droop of the cell average."""
    reach = _EDGE_HALF_WIDTH * FINE
    taps = kaiser_sinc(np.arange(-reach, reach + 1) / FINE, half_width=_EDGE_HALF_WIDTH, beta=13.2)
    taps = np.convolve(taps, [-1 / 24, 13 / 12, -1 / 24])
    return taps / taps.sum()


@functools.lru_cache(maxsize=1)
def _edge_spectrum() -> tuple[np.ndarray, np.ndarray]:
    frequency = np.linspace(0, 1.5, 1501)
    taps = _edge_taps()
    offset = (np.arange(taps.size) - taps.size // 2) / FINE
    response = (taps * np.cos(2 * np.pi * frequency[:, None] * offset)).sum(1) * np.sinc(frequency / FINE)
    return frequency, response


def edge_response(frequency: np.ndarray) -> np.ndarray:
    """What edge weights leave of the light that a rim diffracts, at a frequency in cycles per sample, >= 0."""
    return np.interp(frequency, *_edge_spectrum(), right=0.0)


@functools.lru_cache(maxsize=1)
@torch.inference_mode(False)
def _edge_integral() -> Tensor:
    """Of the low-pass, from far outside an edge to far inside, at _PROFILE_STEPS points for each sample."""
    return torch.as_tensor(running_integral(_EDGE_HALF_WIDTH, beta=13.2, steps=_PROFILE_STEPS)[1])


def edge_profile(distance: Tensor) -> Tensor:
    """Weight of a sample so far inside a straight edge [samples]: the low-passed step, 0 outside and 1 inside."""
    table = _edge_integral().to(distance)
    near = (distance.detach().abs() < _EDGE_HALF_WIDTH).flatten().nonzero()[:, 0]  # few of a pupil's samples
    position = (distance.flatten()[near] + _EDGE_HALF_WIDTH) * _PROFILE_STEPS
    low = position.detach().long().clamp(max=len(table) - 2)
    weights = table[low] + (position - low) * (table[low + 1] - table[low])
    far = (distance.detach() > 0).to(distance.dtype).flatten()
    return far.index_put((near,), weights).view(distance.shape)


@functools.lru_cache(maxsize=64)
@torch.inference_mode(False)
def disc_weights(count: int, *, spacing: float, radius: float = 1.0) -> Tensor:
    """Quadrature weights of a disc on one quadrant of a grid: high order, although the rim cuts through cells.

    The disc's exact area in cells of a fifth of the spacing, low-passed by a Kaiser-windowed sinc (half width 6
    samples, beta 13.2) at the nodes (j + 1/2) * spacing. They are weights, not a transmission: some are negative.

    Args:      count: samples along the whole axis, even; spacing and radius in the same unit.
    Returns:   (count // 2, count // 2) float64 for x, y > 0, ordered away from the axis; sum * 4 * spacing^2 = area.
    Source:    the Cartesian cousin of Barnett, arXiv 2010.05978; measured in the project's numerics note, section 3.
    """
    if radius <= 0:
        return torch.zeros(count // 2, count // 2, dtype=torch.float64)
    half = count // 2
    cell = spacing / FINE / radius
    kernel = torch.as_tensor(_edge_taps())[None, None]
    taps = kernel.shape[-1]
    # node j sits at the centre of cell 5 j + 2; its taps reach across the axis, where the area is odd in each edge
    edges = (np.arange((half - 1) * FINE + taps + 1) + (FINE - 1) // 2 - taps // 2) * cell
    quadrant = torch.zeros(half, half, dtype=torch.float64)
    for first in range(0, half, _NODES_AT_ONCE):  # of cells 25 times as many as nodes only a few rows are held
        last = min(first + _NODES_AT_ONCE, half)
        start, stop = (min(end, half) for end in _near_rim(first, last, radius / spacing))
        quadrant[first:last, :start] = 1.0
        if start >= stop:
            continue
        rows, columns = (edges[a * FINE : (b - 1) * FINE + taps + 1] for a, b in ((first, last), (start, stop)))
        area = disc_area_below(np.abs(rows[:, None]), np.abs(columns)) * np.sign(rows[:, None]) * np.sign(columns)
        signal = torch.as_tensor(np.diff(np.diff(area, axis=0), axis=1) / cell**2)
        for _ in range(2):  # along the rows, then (transposed) along the columns
            signal = torch.nn.functional.conv1d(signal[:, None], kernel, stride=FINE)[:, 0].T
        quadrant[first:last, start:stop] = signal
    return quadrant


def _near_rim(first: int, last: int, radius: float) -> tuple[int, int]:
    """From and to where columns of nodes feel the rim of a disc in some rows of them; radius: in samples."""
    low, high = max(0.0, first - _NEAR), last + _NEAR
    outer, inner = (math.sqrt(max(0.0, radius**2 - y**2)) for y in (low, high))
    return max(0, math.floor(inner - _NEAR)), math.ceil(outer + _NEAR) if low < radius else 0


def round_weights(discs: tuple[tuple[float, float], ...], count: int, *, spacing: float) -> Tensor:
    """`disc_weights` of an aperture made of discs (radius, weight), (count // 2, count // 2)."""
    quadrant = torch.zeros(count // 2, count // 2, dtype=torch.float64)
    for radius, weight in discs:
        quadrant = quadrant + weight * disc_weights(count, spacing=spacing, radius=radius)
    return quadrant


def opening(clearances: Tensor) -> Tensor:
    """Quadrature weights of what passes at the points of grids, (N, S, A, B) -> (N, A, B): 1 inside, 0 outside, and
    low-passed between.
    """
    return functools.reduce(torch.mul, edge_profile(edge_distance(clearances)).unbind(1))


def edge_distance(clearances: Tensor) -> Tensor:
    """How far inside an edge points of grids lie, right near the edge, [samples], (..., A, B).

    An edge is straight as far as the low-pass reaches, some samples; d = 1 - sqrt(1 - q) is nearly the distance from
    it, and d / |d'| (1 + d d'' / (2 |d'|^2)) along the normal, Halley's step to it, more nearly.
    """
    # in float32 q may be 1 at the middle, and the slope of a root of 0, which is infinite, times no light is NaN
    depth = clearances / (1 + torch.sqrt((1 - clearances).clamp(min=1e-12)))
    along = torch.gradient(depth, dim=(-2, -1))
    slope = functools.reduce(torch.add, (part.square() for part in along)).clamp(min=1e-18)
    turns = torch.gradient(slope, dim=(-2, -1))  # d' . grad |d'|^2 = 2 |d'|^2 d''
    bent = functools.reduce(torch.add, map(torch.mul, along, turns)) * depth / (4 * slope.square())
    return depth * slope.rsqrt() * (1 + bent.clamp(-_BENT, _BENT))


class Openings:
    """What passes at the points of grids at many wavelengths, from distances at a few, (N, E, S, A, B)."""

    def __init__(self, distances: Tensor) -> None:
        with torch.no_grad():
            self._open = (distances[:, 0] > 0).all(1).to(distances.dtype)
            lowest, highest = distances.amin(1), distances.amax(1)
            near = ((lowest < _NEAR) & (highest > -_NEAR)).any(1)
            self._near = near.flatten().nonzero()[:, 0]
        self._distances = distances.permute(1, 0, 3, 4, 2).flatten(1, 3)[:, self._near]

    def at(self, weights: Tensor) -> Tensor:
        """Quadrature weights as of `opening`, (N, A, B), where each of the few counts so much, (E,)."""
        distances = torch.tensordot(weights.to(self._distances), self._distances, dims=1)
        passed = edge_profile(distances).prod(-1)
        return self._open.flatten().index_put((self._near,), passed).view(self._open.shape)
