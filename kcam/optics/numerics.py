"""Small numerics that the rooms share: lengths that FFTs like, sines, Bessel functions that train, quadrature."""

from __future__ import annotations

import functools
import math
from itertools import accumulate
from operator import mul
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor

_CUBIC = 4  # nodes

Pair = tuple[Tensor, Tensor]  # real and imaginary part: complex tensors cost twice here, in layout and in polar()


def fast_length(minimum: int) -> int:
    """The smallest length >= `minimum` that FFTs like: no prime factor above 7, a multiple of 32 from 256 up."""
    step = 32 if minimum >= 256 else 2 if minimum > 2 else 1
    steps = max(1, math.ceil(minimum / step))
    odd = [1]  # a power of two is below 2 * steps, so nothing beyond that is shortest
    for factor in (3, 5, 7):
        for known in odd:  # grows meanwhile, by all powers of the factor
            if known * factor < 2 * steps:
                odd.append(known * factor)
    return step * min(known << (math.ceil(steps / known) - 1).bit_length() for known in odd)


def sines(angle: Tensor) -> Pair:
    """Cosine and sine, for the inside of an `autograd.Function`: without a graph.

    Measured: in float32 numpy takes half of torch's time, but one thread; torch.polar costs five times as much.
    """
    if angle.dtype != torch.float32 or angle.device.type != "cpu" or torch.get_num_threads() > 2:
        return angle.cos(), angle.sin()
    values = angle.numpy()
    with np.errstate(invalid="ignore"):  # of an infinite phase: NaN, as torch has it
        return torch.from_numpy(np.cos(values)), torch.from_numpy(np.sin(values))


def phasor(angle: Tensor) -> Tensor:
    """exp(i angle), complex."""
    return torch.complex(angle.cos(), angle.sin())


def squared(field: Tensor) -> Tensor:
    """|field|^2 without a root, whose slope at 0 is infinite."""
    return field.real.square() + field.imag.square()


def _bessel(order: int, x: Tensor) -> Tensor:
    """J0 or J1. On a CPU by scipy in as much time: torch's are off by 4e-7 at x = 5."""
    if x.device.type != "cpu" or x.dtype != torch.float64:
        return (torch.special.bessel_j0, torch.special.bessel_j1)[order](x)
    bessel = (scipy.special.j0, scipy.special.j1)[order]
    return torch.as_tensor(bessel(x.detach().numpy()))


class BesselJ0(torch.autograd.Function):
    """J0 with its derivative -J1, which torch.special leaves out without a word; any number of times."""

    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return _bessel(0, x)

    @staticmethod
    def backward(ctx, grad):
        (x,) = ctx.saved_tensors
        return -grad * BesselJ1.apply(x)


class BesselJ1(torch.autograd.Function):
    """J1 with its derivative J0 - J1(x) / x."""

    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return _bessel(1, x)

    @staticmethod
    def backward(ctx, grad):
        (x,) = ctx.saved_tensors
        near = x.abs() < 1e-3  # where the quotient's own derivatives would cancel: its series, to 1e-20
        ratio = BesselJ1.apply(x) / torch.where(near, 1, x)
        series = 0.5 - x**2 / 16 + x**4 / 384
        return grad * (BesselJ0.apply(x) - torch.where(near, series, ratio))


def lagrange(offset: Any, *, taps: range) -> list[Any]:
    """Weights of the Lagrange polynomial through the taps at `offset`, a tensor or an array."""
    off = [offset - tap for tap in taps]
    below = accumulate(off[:-1], mul, initial=1.0)
    above = reversed([*accumulate(off[:0:-1], mul, initial=1.0)])
    apart = (math.prod(tap - other for other in taps if other != tap) for tap in taps)
    return [low * high / scale for low, high, scale in zip(below, above, apart, strict=True)]


def bracketed(nodes: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """Which of two or more ascending nodes comes before each value, and the value's share of the way to the next.

    Values beyond the outermost nodes belong to the first or the last two, with shares below 0 or above 1.
    """
    before = torch.bucketize(at.detach().contiguous(), nodes.detach()[1:-1], right=True)
    low, step = nodes[:-1], nodes.diff()
    if len(step) > 1:
        low, step = (values.index_select(0, before.flatten()).view(at.shape) for values in (low, step))
    return before, (at - low) / step


def linear_weights(nodes: Tensor, at: Tensor) -> Tensor:
    """Weights (N, n) of linear interpolation between nodes in any order; the outermost hold on beyond."""
    ordered, order = nodes.sort()
    if len(nodes) == 1:
        return torch.ones(len(at), 1, dtype=at.dtype, device=at.device)
    low, share = bracketed(ordered, at.clamp(ordered[0], ordered[-1]))
    weights = torch.zeros(len(at), len(nodes), dtype=at.dtype, device=at.device)
    rows = torch.arange(len(at), device=at.device)
    return weights.index_put((rows, order[low]), 1 - share).index_put((rows, order[low + 1]), share)


def cubic_weights(nodes: Tensor, at: Tensor) -> Tensor:
    """Weights (N, n) of cubics through the four nearest of ascending nodes, which go on beyond the outermost; of the
    polynomial through all of fewer.
    """
    order = min(len(nodes), _CUBIC)
    first = (torch.searchsorted(nodes, at) - order // 2).clamp(0, len(nodes) - order)
    taps = first[:, None] + torch.arange(order, device=at.device)
    return at.new_zeros(len(at), len(nodes)).scatter(1, taps, lagrange_products(nodes[taps], at))


def chebyshev(v: Tensor, degree: int) -> Tensor:
    """T_0 .. T_degree of values, (degree + 1, ...)."""
    terms = [torch.ones_like(v), v]
    while len(terms) <= degree:
        terms.append(2 * v * terms[-1] - terms[-2])
    return torch.stack(terms[: degree + 1])


def chebyshev_points(count: int) -> Tensor:
    """Zeros of T_count, falling from 1 to -1, (count,): where to know what is to be a polynomial. The first half of an
    even count, for what is even.
    """
    return torch.cos((torch.arange(count, dtype=torch.float64) + 0.5) * (math.pi / count))


def chebyshev_between(low: Tensor, high: Tensor, count: int) -> Tensor:
    """The same for a range, (count,)."""
    return (low + high) / 2 + (high - low) / 2 * chebyshev_points(count).to(low.device)


def lagrange_weights(nodes: Tensor, at: Tensor) -> Tensor:
    """Weights (N, n) of the polynomial through values at nodes (n,); one each where all of `at` (N,) are nodes."""
    if len(nodes) == 1:
        return at.new_ones(len(at), 1, dtype=torch.float64)
    equal = (nodes.detach() - at.detach()[:, None]).abs() <= 1e-12 * nodes.detach().abs().max()
    if bool(equal.any(1).all()):
        return equal.double()
    scale = 4 / float((nodes.detach().max() - nodes.detach().min()).clamp(min=1e-300))
    return lagrange_products(nodes.detach() * scale, at * scale)


def lagrange_products(nodes: Tensor, at: Tensor) -> Tensor:
    """The same without a scale: nodes, (n,) or for each value its own (N, n), and values near 1 in size."""
    off = (at[:, None] - nodes)[:, None, :].expand(-1, nodes.shape[-1], -1)
    own = torch.eye(nodes.shape[-1], dtype=torch.bool, device=nodes.device)
    apart = torch.where(own, 1.0, nodes[..., :, None] - nodes[..., None, :])
    return (torch.where(own, 1.0, off) / apart).prod(-1)


MOST_NODES = 512  # nodes that one Gauss-Legendre rule has at most: they are eigenvalues, at the cost of n^3


@functools.lru_cache(maxsize=64)
def legendre(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights on [-1, 1]: one rule, or panels of one rule that together resolve as much.

    By scipy, of a banded matrix: numpy's full one takes a second a rule where another process keeps a core from it.
    """
    panels = math.ceil(count / MOST_NODES)
    order = count if panels == 1 else math.ceil(count / panels) + 32
    nodes, weights = scipy.special.roots_legendre(order)
    centres = (2 * np.arange(panels) + 1) / panels - 1
    return (centres[:, None] + nodes / panels).ravel(), np.tile(weights / panels, panels)


Scalar = float | Tensor


def float64(value: Scalar) -> Tensor:
    """A number or tensor as a float64 tensor, its gradient kept."""
    return torch.as_tensor(value, dtype=torch.float64)
