"""Maps of flat pixels over the pupil, and the low-pass that brings them onto a grid."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from kcam.optics.numerics import Scalar
from kcam.optics.pupil.rim import kaiser_sinc, running_integral


@dataclass(frozen=True)
class PixelMap:
    """A map of flat square pixels over the pupil: a phase (times `factors`) or a transmission.

    values: (n, n), phase [rad] where `factors` (L,) is given, else transmission of the amplitude.
    half_width: half the map's width [m], or None where it spans the aperture's bounding square.
    """

    values: Tensor
    half_width: Scalar | None
    factors: Tensor | None

    def largest_phase(self) -> Tensor:
        """A phase at the wavelength that it is largest at, (n, n) float64 [rad], without a gradient."""
        scale = 1.0 if self.factors is None else float(self.factors.max())
        return self.values.detach().to(torch.float64) * scale

    def steps(self) -> tuple[Tensor, Tensor]:
        """What `largest_phase` steps by between neighbours, down and across, wrapped into [-pi, pi) [rad]."""
        down, across = (self.largest_phase().diff(dim=dim) for dim in (0, 1))
        return _wrapped(down), _wrapped(across)


def _wrapped(phase: Tensor) -> Tensor:
    return torch.remainder(phase + torch.pi, 2 * torch.pi) - torch.pi


_MAP_HALF_WIDTH = 12  # samples; half width of the low-pass that brings a pixel map onto the pupil grid
_MAP_BETA = 7.9  # 80 dB: passes 0.79 of the Nyquist frequency and stops from 1.21; kappa 2.5 needs 0.8 and 1.2


@functools.lru_cache(maxsize=1)
def _low_pass_integral() -> tuple[np.ndarray, np.ndarray]:
    """Running integral of the map low-pass, tabulated: (offsets in samples, integral from -inf)."""
    return running_integral(_MAP_HALF_WIDTH, beta=_MAP_BETA, steps=200)


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


def pixel_under(values: Tensor, half_width: float | Tensor | None, axis: Tensor, semi_aperture: Tensor) -> Tensor:
    """Value of the flat pixel under each point of a square grid with this axis [m]; the outermost pixels continue."""
    n = values.shape[-1]
    width = semi_aperture if half_width is None else half_width
    cell = torch.clamp(((axis / width + 1) / 2 * n).detach().floor().long(), 0, n - 1)
    return values[cell][:, cell]
