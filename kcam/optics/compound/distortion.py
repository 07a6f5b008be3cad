"""Functions of the distance from the axis: where light falls without distortion, and how much of it there is."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from kcam.optics.compound.aiming import nodes
from kcam.optics.compound.prescription import Prescription
from kcam.optics.numerics import chebyshev, chebyshev_points

_SMALL = 1e-11  # of the sum: terms that move light by less are left out
_NODES = 16
_MANY = 2**14  # places
_STEPS = 10  # towards the point whose image lies at the sensor's corner, at most


@dataclass(frozen=True)
class Even:
    """sum_k c_k T_k(2 (r / R)^2 - 1): a function of the distance r from the axis, even and smooth, up to r = R."""

    coefficients: Tensor
    reach: float

    @classmethod
    def through(cls, values: Tensor, radii: Tensor, *, reach: float) -> Even:
        """That of values (n,) at radii (n,) [m], nearly the Chebyshev points of a range from 0."""
        found = torch.linalg.solve(chebyshev(2 * (radii / reach) ** 2 - 1, len(radii) - 1).T, values)
        significant = (found.detach().abs() > _SMALL * found.detach().abs().sum()).nonzero()
        return cls(found[: int(significant.max()) + 1], reach)

    def at(self, squared_radii: Tensor) -> Tensor:
        """At squared radii [m^2]. Where gradients are asked for at many, it is computed again on the way back."""
        if torch.is_grad_enabled() and squared_radii.numel() > _MANY:
            return checkpoint(self._sum, squared_radii, use_reentrant=False)
        return self._sum(squared_radii)

    def _sum(self, squared_radii: Tensor) -> Tensor:
        v = (2 / self.reach**2) * squared_radii - 1
        after, last = torch.zeros_like(v), torch.zeros_like(v)
        for coefficient in self.coefficients.flip(0)[:-1]:  # Clenshaw's recurrence
            after, last = coefficient + 2 * v * after - last, after
        return self.coefficients[0] + v * after - last


def chebyshev_radii(reach: float) -> Tensor:
    """Where to know an `Even` function, (n,)."""
    return reach * chebyshev_points(2 * _NODES)[:_NODES]


@dataclass(frozen=True)
class ImageHeights:
    """From places on the sensor back to object points.

    over_radius: their height over that of the image [1/m]. scale: of a point near the axis, its image's height over its
    own [m], > 0.
    """

    over_radius: Even
    scale: Tensor


def image_heights(lens: Prescription, reach: float) -> ImageHeights:
    """How images lie on the sensor, up to `reach` from the axis [m]: see `CompoundLens.image_heights`."""
    scale = lens.image_scale
    if reach == 0:
        return ImageHeights(Even(1 / scale[None], 1.0), scale)
    grid, focus = lens.focus_line, lens.focus()[None]

    def landed(heights: Tensor) -> Tensor:
        return -nodes(lens, grid, focus, heights).chief.y[:, 0, 0, 0]

    with torch.no_grad():
        highest = reach / scale
        try:
            for _ in range(_STEPS):
                before, highest = highest, highest * reach / landed(highest[None])[0]
                if bool((highest / before - 1).abs() < 1e-4):
                    break
            highest = 1.005 * highest
            landed(highest[None])
        except ValueError as error:
            raise ValueError(
                f"the sensor reaches {reach * 1e3:.3g} mm from the axis, beyond the field of this lens: {error}"
            ) from error
    heights = chebyshev_radii(1.0) * highest
    radii = landed(heights)
    over_radius = Even.through(heights / radii, radii, reach=float(radii.detach().max()))
    return ImageHeights(over_radius, scale)
