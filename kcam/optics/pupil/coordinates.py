"""The pupil plane: where it is sampled.

Coordinates are normalised by the semi-aperture a. A smooth pupil is sampled in the *image-side* coordinate

    xi' = u' / a',   u' = u / sqrt(1 + r^2 / d^2),   a' = a / sqrt(1 + tau),   tau = (a / d)^2,

which is proportional to the direction cosine towards the sensor, so that the Fourier kernel exp(-i k x u' / d) holds
beyond the paraxial range (the Debye map). tau = 0 gives the paraxial (Fresnel) plane, where u' = u. Flat pixels, whose
edges would be curved there, are sampled in the true plane; `CurvedTransform` then curves the kernel instead.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from kcam.optics.pupil.quadrants import signs

EDGE_MARGIN = 12  # samples of the grid beyond the rim, where low-passed edges still differ from zero


@dataclass(frozen=True)
class Pupil:
    """Sample positions in the pupil plane, in units of the semi-aperture, and the geometry they stand in.

    x, y:             true pupil coordinates u / a and v / a; float64, broadcastable against each other.
    semi_aperture:    a [m], half the width of the aperture's bounding square; 0-d float64, may carry a gradient.
    sensor_distance:  d [m], likewise.
    paraxial:         True where the Fresnel approximation holds by definition of the model.
    round:            True where no light passes beyond rho = 1.
    quadrant:         of points that are mirrored, the first of the four: what is even is the same in the others.
    """

    x: Tensor
    y: Tensor
    semi_aperture: Tensor
    sensor_distance: Tensor
    paraxial: bool
    round: bool = False
    quadrant: Pupil | None = None

    def mirrored(self) -> Pupil:
        """That of points of one quadrant in all four, x and y (4, ...) in the order of `quadrants`."""
        across, down = signs(self.x)
        return replace(self, x=across * self.x, y=down * self.y, quadrant=self)

    @functools.cached_property
    def rho2(self) -> Tensor:
        """Squared normalised radius; kept squared, because sqrt has no gradient at 0."""
        if self.quadrant is not None:
            return self.quadrant.rho2.expand(torch.broadcast_shapes(self.x.shape, self.y.shape))
        return self.x.square() + self.y.square()

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
        q = torch.sqrt(1 + vergence.square() * r2)
        return -(vergence**3) / 2 * (r2 / (1 + q)).square()


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


def to_image_side(rho: Any, tau: Any, *, aside: float = 0.0) -> Any:
    """Image-side radius of a true one, a tensor or a number each: rho'^2 = rho^2 (1 + tau) / (1 + tau rho^2); or x' of
    x, where y^2 is `aside`.
    """
    return rho * ((1 + tau) / (1 + tau * (rho**2 + aside))) ** 0.5


def from_image_side(x: Tensor, y: Tensor, tau: Tensor) -> tuple[Tensor, Tensor]:
    """True pupil coordinates of image-side nodes: rho^2 = rho'^2 / (1 + tau (1 - rho'^2)).

    Nodes beyond the rim (where the edge weights die away) are held at a positive denominator.
    """
    scale = torch.rsqrt(torch.clamp(1 + tau * (1 - x**2 - y**2), min=1e-3))
    return x * scale, y * scale
