"""Where light falls without distortion: the height of an object point as a polynomial of its image's.

h(r) = r sum_k c_k T_k(2 (r / R)^2 - 1),   r = |place on the sensor| <= R
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kcam.optics.numerics import chebyshev

_SMALL = 1e-11  # of the sum: terms that move light by less are left out
NODES = 16


@dataclass(frozen=True)
class ImageHeights:
    """From places on the sensor back to object points. coefficients (K,) [1/m]; reach: R [m]; scale: of a point near
    the axis, its image's height over its own [m], > 0.
    """

    coefficients: Tensor
    reach: float
    scale: Tensor

    @classmethod
    def through(cls, heights: Tensor, radii: Tensor, scale: Tensor) -> ImageHeights:
        """That of points (n,) whose images lie at radii (n,) [m], nearly the Chebyshev points of a range from 0."""
        reach = float(radii.detach().max())
        terms = chebyshev(2 * (radii / reach) ** 2 - 1, len(radii) - 1)
        found = torch.linalg.solve(terms.T, heights / radii)
        significant = (found.detach().abs() > _SMALL * found.detach().abs().sum()).nonzero()
        return cls(found[: int(significant.max()) + 1], reach, scale)

    def over_radius(self, squared_radii: Tensor) -> Tensor:
        """h / r [1/m] at squared radii [m^2]."""
        v = (2 / self.reach**2) * squared_radii - 1
        after, last = torch.zeros_like(v), torch.zeros_like(v)
        for coefficient in self.coefficients.flip(0)[:-1]:  # Clenshaw's recurrence
            after, last = coefficient + 2 * v * after - last, after
        return self.coefficients[0] + v * after - last
