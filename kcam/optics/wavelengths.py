"""The wavelengths whose PSFs are computed, and what each of these gives to the bands of a scene."""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

from kcam.optics.numerics import chebyshev_between, cubic_weights, lagrange_weights

_NEAR = 0.25  # of a step, all that bands may lie beside its middle to be taken for it: of more cubics err more


def few_wavelengths(wavelengths: Tensor, count: int, *, interpolate: bool) -> tuple[Tensor, Tensor]:
    """`count` wavelengths (G,) [m], and the share of each of their PSFs in that of a band, (L, G) in float64.

    Interpolated: the middles of equal steps in 1/wavelength, in which fringes are even, or the bands next to them, and
    cubics through the four nearest, which go on for half a step at the ends. Else neighbouring bands share the PSF of
    their group's mean wavelength; the larger groups lie at long wavelengths, where a step is less of a fringe.
    """
    nodes, shares = _few(tuple(wavelengths.tolist()), count, interpolate)
    return nodes.to(wavelengths, copy=True), shares.clone()


def chebyshev_wavelengths(wavelengths: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The same by one polynomial through all of them, as PSFs over the field are found, which few resolve."""
    numbers = 1 / wavelengths
    nodes = chebyshev_between(*numbers.aminmax(), count)
    return 1 / nodes, lagrange_weights(nodes, numbers)


@functools.lru_cache(maxsize=256)
@torch.inference_mode(False)
def _few(wavelengths: tuple[float, ...], count: int, interpolate: bool) -> tuple[Tensor, Tensor]:
    own = np.array(wavelengths)
    low, high = 1 / own.max(), 1 / own.min()
    if not interpolate or low == high:
        shares = np.zeros((len(own), count))
        for index, group in enumerate(np.array_split((-own).argsort(kind="stable"), count)[::-1]):
            shares[group, index] = 1
        means = own @ shares / shares.sum(0)
        near = own[np.abs(own - means[:, None]).argmin(1)]
        means = np.where(np.isclose(near, means, rtol=1e-9, atol=0), near, means)  # a band is itself
        return torch.from_numpy(means), torch.from_numpy(shares)
    step = (high - low) / count
    place = (1 / own - low) / step - 0.5
    nodes, nearest = np.arange(count, dtype=float), np.abs(place - np.arange(count)[:, None]).argmin(1)
    bands = bool((np.abs(place[nearest] - nodes) <= _NEAR).all())
    nodes = place[nearest] if bands else nodes
    found = own[nearest] if bands else 1 / (low + step * (nodes + 0.5))
    return torch.from_numpy(found), cubic_weights(torch.from_numpy(nodes), torch.from_numpy(place))
