"""The pupil plane: where it is sampled, and with which quadrature weights.

Coordinates are normalised by the semi-aperture a. A smooth pupil is sampled in the *image-side* coordinate

    xi' = u' / a',   u' = u / sqrt(1 + r^2 / d^2),   a' = a / sqrt(1 + tau),   tau = (a / d)^2,

which is proportional to the direction cosine towards the sensor, so that the Fourier kernel exp(-i k x u' / d) holds
beyond the paraxial range (the Debye map). tau = 0 gives the paraxial (Fresnel) plane, where u' = u. Flat pixels, whose
edges would be curved there, are sampled in the true plane; `transforms.CurvedTransform` then curves the kernel instead.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

EDGE_MARGIN = 12  # samples of the grid beyond the rim, where low-passed edges still differ from zero
_EDGE_HALF_WIDTH = 6  # samples; half width of the low-pass for edge weights
FINE = 5  # cells per sample in which the area of the rim is measured exactly
_NODES_AT_ONCE = 32  # rows of edge weights; more take more memory than the cells that they share take time
_SLAB_NODES, _SLAB_PIXELS = 16, 32  # narrow enough to leave out most zeros, wide enough for a matrix product
_MAP_HALF_WIDTH = 12  # samples; half width of the low-pass that brings a pixel map onto the pupil grid
_MAP_BETA = 7.9  # 80 dB: passes 0.79 of the Nyquist frequency and stops from 1.21; kappa 2.5 needs 0.8 and 1.2


@dataclass(frozen=True)
class Pupil:
    """Sample positions in the pupil plane, in units of the semi-aperture, and the geometry they stand in.

    x, y:             true pupil coordinates u / a and v / a; float64, broadcastable against each other.
    semi_aperture:    a [m], half the width of the aperture's bounding square; 0-d float64, may carry a gradient.
    sensor_distance:  d [m], likewise.
    paraxial:         True where the Fresnel approximation holds by definition of the model.
    round:            True where no light passes beyond rho = 1.
    """

    x: Tensor
    y: Tensor
    semi_aperture: Tensor
    sensor_distance: Tensor
    paraxial: bool
    round: bool = False

    @property
    def rho2(self) -> Tensor:
        """Squared normalised radius; kept squared, because sqrt has no gradient at 0."""
        return self.x**2 + self.y**2

    @property
    def tau(self) -> Tensor:
        """(a / d)^2 where the model is non-paraxial, else 0."""
        return pupil_tau(self.semi_aperture, self.sensor_distance, paraxial=self.paraxial)

    @property
    def measure(self) -> Tensor:
        """Amplitude factor 1 / cos^2(theta) of the Debye map (Jacobian times obliquity and 1 / R)."""
        return 1 + self.tau * self.rho2

    def beyond_paraxial(self, vergence: Tensor) -> Tensor:
        """OPD that a spherical wave of this vergence has beyond its parabola: -V^3 r^4 / (2 (1 + q)^2) [m].

        q = sqrt(1 + V^2 r^2). This is sqrt(z^2 + r^2) - z - r^2 / 2z in a form that neither cancels nor divides by 1/z
        = 0.
        """
        if self.paraxial:
            return torch.zeros_like(self.rho2)
        r2 = self.rho2 * self.semi_aperture**2
        q = torch.sqrt(1 + vergence**2 * r2)
        return -(vergence**3) * r2**2 / (2 * (1 + q) ** 2)


def pupil_tau(semi_aperture: Tensor, sensor_distance: Tensor, *, paraxial: bool) -> Tensor:
    """tau = (a / d)^2, or 0 in the paraxial model."""
    tau = (semi_aperture / sensor_distance) ** 2
    return torch.zeros_like(tau) if paraxial else tau


def grid_nodes(count: int, *, spacing: float | None = None) -> Tensor:
    """Nodes xi' of a pupil grid, (count,) float64, symmetric about 0; by default the rim is EDGE_MARGIN inside."""
    spacing = grid_spacing(count) if spacing is None else spacing
    return (torch.arange(count, dtype=torch.float64) + 0.5 - count / 2) * spacing


def grid_spacing(count: int) -> float:
    """Spacing of `grid_nodes` in units of the semi-aperture."""
    return 2.0 / (count - 2 * EDGE_MARGIN)


def from_image_side(x: Tensor, y: Tensor, tau: Tensor) -> tuple[Tensor, Tensor]:
    """True pupil coordinates of image-side nodes: rho^2 = rho'^2 / (1 + tau (1 - rho'^2)).

    Nodes beyond the rim (where the edge weights die away) are held at a positive denominator.
    """
    scale = torch.rsqrt(torch.clamp(1 + tau * (1 - x**2 - y**2), min=1e-3))
    return x * scale, y * scale


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
    quadrant = torch.empty(half, half, dtype=torch.float64)
    for first in range(0, half, _NODES_AT_ONCE):  # of cells 25 times as many as nodes only a few rows are held
        last = min(first + _NODES_AT_ONCE, half)
        rows = edges[first * FINE : (last - 1) * FINE + taps + 1, None]
        area = disc_area_below(np.abs(rows), np.abs(edges)) * np.sign(rows) * np.sign(edges)
        signal = torch.as_tensor(np.diff(np.diff(area, axis=0), axis=1) / cell**2)
        for _ in range(2):  # along the rows, then (transposed) along the columns
            signal = torch.nn.functional.conv1d(signal[:, None], kernel, stride=FINE)[:, 0].T
        quadrant[first:last] = signal
    return quadrant


def round_weights(discs: tuple[tuple[float, float], ...], count: int, *, spacing: float) -> Tensor:
    """`disc_weights` of an aperture made of discs (radius, weight), (count // 2, count // 2)."""
    quadrant = torch.zeros(count // 2, count // 2, dtype=torch.float64)
    for radius, weight in discs:
        quadrant = quadrant + weight * disc_weights(count, spacing=spacing, radius=radius)
    return quadrant


@functools.lru_cache(maxsize=1)
def _low_pass_integral() -> tuple[np.ndarray, np.ndarray]:
    """Running integral of the map low-pass, tabulated: (offsets in samples, integral from -inf)."""
    offset = np.linspace(-_MAP_HALF_WIDTH, _MAP_HALF_WIDTH, 200 * 2 * _MAP_HALF_WIDTH + 1)
    kernel = kaiser_sinc(offset, half_width=_MAP_HALF_WIDTH, beta=_MAP_BETA)
    step = offset[1] - offset[0]
    # Simpson-like correction of the trapezium: h^2/12 times the slope at the ends vanishes, the kernel is 0 there
    integral = np.concatenate([[0.0], np.cumsum((kernel[1:] + kernel[:-1]) / 2)]) * step
    return offset, integral / integral[-1]


@functools.lru_cache(maxsize=1)
def _map_spectrum() -> tuple[np.ndarray, np.ndarray]:
    offset = np.linspace(-_MAP_HALF_WIDTH, _MAP_HALF_WIDTH, 20 * 2 * _MAP_HALF_WIDTH + 1)
    kernel = kaiser_sinc(offset, half_width=_MAP_HALF_WIDTH, beta=_MAP_BETA)
    frequency = np.linspace(0, 1.5, 601)
    return frequency, (kernel * np.cos(2 * np.pi * frequency[:, None] * offset)).sum(1) / kernel.sum()


def map_response(frequency: np.ndarray) -> np.ndarray:
    """What the low-pass of pixel maps leaves of a frequency in cycles per sample, >= 0."""
    return np.interp(frequency, *_map_spectrum(), right=0.0)


def pixel_weights(edges: Tensor, nodes: Tensor, *, spacing: float) -> Tensor:
    """What each flat pixel contributes to each node: the low-passed indicator of [edge_j, edge_j+1] at the nodes.

    Args:      edges: (n + 1,) ascending; nodes: (N,), both in units of the semi-aperture; spacing of the nodes.
    Returns:   (N, n) float64.
    """
    offset, integral = _low_pass_integral()
    position = (edges - nodes[:, None]) / spacing
    below = torch.as_tensor(np.interp(position.numpy(), offset, integral, left=0.0, right=1.0))
    return below[:, 1:] - below[:, :-1]


@dataclass(frozen=True)
class _Banded:
    """A banded matrix (n, N) that acts on both axes: field (n, n) -> matrix^T field matrix (N, N).

    slabs: the matrix cut into slabs of columns, each with only the band of rows that it needs; starts: of the bands.
    """

    slabs: tuple[Tensor, ...]
    starts: tuple[int, ...]
    outputs: int

    @staticmethod
    def build(matrix: Tensor, *, width: int, dtype: torch.dtype, device: torch.device) -> _Banded:
        """Cut the bands out of a dense matrix, in slabs of `width` columns."""
        outputs = matrix.shape[1]
        slabs, starts = [], []
        for columns in matrix.split(width, dim=1):
            rows = (columns != 0).any(1).nonzero().flatten()
            low, high = (int(rows[0]), int(rows[-1]) + 1) if rows.numel() else (0, 1)
            slabs.append(columns[low:high].to(device, dtype))
            starts.append(low)
        return _Banded(tuple(slabs), tuple(starts), outputs)

    def _pieces(self) -> Iterator[tuple[Tensor, slice, slice]]:
        """(matrix, its inputs, its outputs)."""
        at = 0
        for slab, start in zip(self.slabs, self.starts, strict=True):
            yield slab, slice(start, start + slab.shape[0]), slice(at, at + slab.shape[1])
            at += slab.shape[1]

    def __call__(self, field: Tensor) -> Tensor:
        half = field.new_empty(field.shape[0], self.outputs)
        for matrix, source, target in self._pieces():
            torch.mm(field[:, source], matrix, out=half[:, target])
        grid = field.new_empty(self.outputs, self.outputs)
        for matrix, source, target in self._pieces():
            torch.mm(matrix.T, half[source], out=grid[target])
        return grid


@dataclass(frozen=True)
class MapWeights:
    """Linear map from an n x n pixel map onto an N x N pupil grid, separable: one matrix (n, N) for both axes."""

    forward: _Banded
    """(n, n) -> (N, N)."""
    adjoint: _Banded
    """(N, N) -> (n, n), the transpose of `forward`."""

    @staticmethod
    def build(matrix: Tensor, *, dtype: torch.dtype, device: torch.device) -> MapWeights:
        """From the dense matrix (n, N)."""
        return MapWeights(
            forward=_Banded.build(matrix, width=_SLAB_NODES, dtype=dtype, device=device),
            adjoint=_Banded.build(matrix.T, width=_SLAB_PIXELS, dtype=dtype, device=device),
        )


def pixel_under(values: Tensor, half_width: float | Tensor | None, axis: Tensor, semi_aperture: Tensor) -> Tensor:
    """Value of the flat pixel under each point of a square grid with this axis [m]; the outermost pixels continue."""
    n = values.shape[-1]
    width = semi_aperture if half_width is None else half_width
    cell = torch.clamp(((axis / width + 1) / 2 * n).detach().floor().long(), 0, n - 1)
    return values[cell][:, cell]
