"""A kernel that is curved beyond the paraxial range: a short series of straight ones."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from kcam.optics.numerics import Pair
from kcam.optics.propagation.pixels import Pixels
from kcam.optics.propagation.transforms import Transform


def mean_slope(tau: float) -> float:
    """What of 1 / q = 1 / sqrt(1 + tau rho^2) is split off as its mean: leaves the least max |rho delta|, rho <= 1.

    Near tau / 8 for small tau, where 1 / q - 1 itself reaches tau / 2.
    """
    return 1 - 0.75 * (1 - 1 / math.sqrt(1 + tau))


@dataclass(frozen=True)
class Curvature:
    """The terms of a curved kernel that all wavelengths on one grid share.

    terms: (p, r, (xi delta)^p (eta delta)^r over the pupil, (x / extent)^p (y / extent)^r over the points), by p + r,
    in the layout of the transform that they go with. extent: from the origin to the edge of the points [m].
    """

    terms: tuple[tuple[int, int, Tensor, Tensor], ...]
    extent: float

    @staticmethod
    def order_for(strength: float, *, tau: float, error: float, corner: float) -> int:
        """The highest power p + r that leaves `error` at the corner of window and pupil.

        strength: scale * extent. corner: largest rho, 1 in a round pupil and sqrt 2 in a square one.
        """
        rho = torch.linspace(0, corner, 33, dtype=torch.float64)
        delta = torch.rsqrt(1 + tau * rho**2) - mean_slope(tau)
        phase = math.sqrt(2) * strength * float((rho * delta).abs().max())
        order, remainder = 0, phase
        while remainder > error:
            order += 1
            remainder *= phase / (order + 1)
        return order

    @staticmethod
    def build(layout: Transform, nodes: Tensor, *, tau: float, step: float, reach: int, order: int, like: Tensor):
        """Terms up to `order` on pupil nodes (N,) and points m * step, |m| <= reach."""
        extent = max(reach, 1) * step
        delta = torch.rsqrt(1 + tau * (nodes[:, None] ** 2 + nodes**2)) - mean_slope(tau)
        along_x, along_y = nodes[None, :] * delta, nodes[:, None] * delta
        points = torch.arange(-reach, reach + 1, dtype=torch.float64) * (step / extent)
        terms = []
        for p, r in ((p, total - p) for total in range(order + 1) for p in range(total + 1)):
            over_pupil = layout.arrange((along_x**p * along_y**r).to(like))
            over_points = layout.arrange_points((points[None, :] ** p * points[:, None] ** r).to(like))
            terms.append((p, r, over_pupil, over_points))
        return Curvature(tuple(terms), extent)


@dataclass(frozen=True)
class CurvedTransform:
    """The kernel beyond the paraxial range, exp(-i s (x xi + y eta) / q), q = sqrt(1 + tau rho^2), in the true plane.

    The inner transform has the mean of 1 / q; the rest, delta, is a phase of a radian or so, and its exponential a
    short series, each term of which is separable:

        sum_pr (-i s x)^p (-i s y)^r / (p! r!) T[(xi delta)^p (eta delta)^r P],  p + r <= order.

    inner: built with scale * mean_slope(tau). strength: scale * extent.
    """

    inner: Transform
    curvature: Curvature
    strength: float
    order: int

    def _terms(self) -> Iterator[tuple[int, float, Tensor, Tensor]]:
        for p, r, over_pupil, over_points in self.curvature.terms:
            if p + r <= self.order:
                weight = self.strength ** (p + r) / (math.factorial(p) * math.factorial(r))
                yield p + r, weight, over_pupil, over_points

    def forward(self, pupil: Pair) -> Pair:
        total = self.inner.forward(pupil)
        for power, weight, over_pupil, over_points in itertools.islice(self._terms(), 1, None):
            part = self.inner.forward((pupil[0] * over_pupil, pupil[1] * over_pupil))
            for sums, values in zip(total, _times_power_of_i(part, -power), strict=True):
                sums.addcmul_(values, over_points, value=weight)
        return total

    def adjoint(self, field: Pair) -> Pair:
        total = self.inner.adjoint(field)
        for power, weight, over_pupil, over_points in itertools.islice(self._terms(), 1, None):
            part = self.inner.adjoint((field[0] * over_points, field[1] * over_points))
            for sums, values in zip(total, _times_power_of_i(part, power), strict=True):
                sums.addcmul_(values, over_pupil, value=weight)
        return total

    def arrange(self, maps: Tensor) -> Tensor:
        return self.inner.arrange(maps)

    def disarrange(self, maps: Tensor) -> Tensor:
        return self.inner.disarrange(maps)

    def arrange_quadrants(self, maps: Tensor) -> Tensor:
        return self.inner.arrange_quadrants(maps)

    def arrange_points(self, image: Tensor) -> Tensor:
        return self.inner.arrange_points(image)

    def to_pixels(self, intensity: Tensor, pixels: Pixels) -> Tensor:
        return self.inner.to_pixels(intensity, pixels)


def _times_power_of_i(values: Pair, power: int) -> Pair:
    re, im = values
    return ((re, im), (-im, re), (-re, -im), (im, -re))[power % 4]
