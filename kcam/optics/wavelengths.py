"""The wavelengths whose PSFs are computed, and what each of these gives to the bands of a scene."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from kcam.optics.numerics import lagrange

_CUBIC = 4  # nodes


def few_wavelengths(wavelengths: Tensor, count: int, *, interpolate: bool) -> tuple[Tensor, Tensor]:
    """`count` wavelengths (G,) [m], and the share of each of their PSFs in that of a band, (L, G) in float64.

    Interpolated: the middles of equal steps in 1/wavelength, in which fringes are even, and between them cubics through
    the four nearest. Else neighbouring bands share the PSF of their group's mean wavelength.
    """
    nodes, shares = _few(tuple(wavelengths.tolist()), count, interpolate)
    return nodes.to(wavelengths), shares


@functools.lru_cache(maxsize=256)
@torch.inference_mode(False)
def _few(wavelengths: tuple[float, ...], count: int, interpolate: bool) -> tuple[Tensor, Tensor]:
    own = torch.tensor(wavelengths, dtype=torch.float64)
    low, high = (1 / own).aminmax()
    if not interpolate or low == high:
        owner = torch.empty(len(own), dtype=torch.long)
        for index, group in enumerate(own.argsort().tensor_split(count)):
            owner[group] = index
        shares = torch.nn.functional.one_hot(owner).double()
        return (own @ shares) / shares.sum(0), shares
    step = (high - low) / count
    place = (1 / own - low) / step - 0.5
    order = min(count, _CUBIC)
    first = (place.floor().long() - (order // 2 - 1)).clamp(0, count - order)
    shares = torch.zeros(len(own), count, dtype=torch.float64)
    for tap, weight in enumerate(lagrange(place - first, taps=range(order))):
        shares[torch.arange(len(own)), first + tap] = weight
    return 1 / (low + step * (torch.arange(count, dtype=torch.float64) + 0.5)), shares
