"""Exact rays through surfaces, in float64, batched over whatever leads; and paraxial ones.

What is invalid (a ray that misses, or is totally reflected) goes on along the axis with finite numbers, and is said in
`alive`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from kcam.optics.compound.surface import Surface
from kcam.optics.numerics import float64

_ITERATIONS = 12  # of Newton's method; a sphere hit at half its radius is exact after five
_CLOSE = 1e-9  # m: after one more of Newton's steps, which squares what is off, nothing is
_HIT = 1e-12  # m: farther from the surface a ray has missed it


@dataclass(frozen=True)
class Rays:
    """Rays at a plane: positions x, y [m], direction cosines dx, dy towards +x, +y, and the optical path so far [m].

    alive: whether it has met every surface. clearance: for each clipping surface 1 - r^2 / R^2, below 0 where it does
    not pass. margin: the least of what falls to 0 where surfaces end, and where rays graze them.
    """

    x: Tensor
    y: Tensor
    dx: Tensor
    dy: Tensor
    path: Tensor
    alive: Tensor
    clearance: tuple[Tensor, ...] = ()
    margin: Tensor | None = None

    @property
    def dz(self) -> Tensor:
        """Direction cosine along the axis."""
        return _along(self.dx, self.dy)


def _along(dx: Tensor, dy: Tensor) -> Tensor:
    return torch.sqrt((1 - dx**2 - dy**2).clamp(min=1e-12))


def trace(surfaces: Sequence[Surface], rays: Rays, indices: Sequence[Tensor], *, until: int | None = None) -> Rays:
    """Rays from the plane of the first vertex to that of the last, behind it.

    Args:
        rays: at the plane of the first vertex, before it. indices: of the space before each surface and behind the
            last, K + 1 tensors that broadcast against the rays.
        until: stop in the plane of this surface's vertex, before it refracts: positions are where rays meet the
            surface.
    Source: Spencer and Murty, J. Opt. Soc. Am. 52, 672 (1962).
    """
    x, y, dx, dy, path, alive = rays.x, rays.y, rays.dx, rays.dy, rays.path, rays.alive
    z, clearance, margin = torch.zeros_like(x), [], torch.ones_like(x)
    last = len(surfaces) - 1
    for k, surface in enumerate(surfaces):
        dz = _along(dx, dy)
        t, hit = _met(surface, x, y, z, dx, dy, dz)
        x, y, z, path = x + t * dx, y + t * dy, z + t * dz, path + indices[k] * t
        r2 = x**2 + y**2
        _, slope, inside = surface.sag(r2)
        alive = alive & hit & (inside.detach() > 0)
        if surface.semi_diameter is not None:
            clearance.append(1 - r2 / float64(surface.semi_diameter).to(r2.device) ** 2)
        if k == until:
            return Rays(x, y, dx, dy, path, alive, tuple(clearance))
        dx, dy, passes, grazing = _refracted(dx, dy, dz, x, y, slope, indices[k], indices[k + 1])
        margin = torch.minimum(margin, torch.minimum(inside, grazing))
        alive = alive & passes
        x, y, z, dx, dy = (torch.where(alive, v, torch.zeros_like(v)) for v in (x, y, z, dx, dy))
        if k < last:
            z = z - float64(surface.thickness).to(z.device)
    t = -z / _along(dx, dy)
    return Rays(x + t * dx, y + t * dy, dx, dy, path + indices[-1] * t, alive, tuple(clearance), margin)


def _met(
    surface: Surface, x: Tensor, y: Tensor, z: Tensor, dx: Tensor, dy: Tensor, dz: Tensor
) -> tuple[Tensor, Tensor]:
    """How far along each ray the surface is, and whether it is met; Newton's last step carries the derivative."""

    def residual(t: Tensor) -> tuple[Tensor, Tensor]:
        a, b = x + t * dx, y + t * dy
        sag, slope, _ = surface.sag(a**2 + b**2)
        steepness = dz - 2 * slope * (a * dx + b * dy)
        return z + t * dz - sag, torch.where(steepness.abs() < 1e-6, 1e-6, steepness)

    with torch.no_grad():
        t = -z / dz
        for _ in range(_ITERATIONS):
            away, steepness = residual(t)
            t = t - away / steepness
            if not bool((away.abs() > _CLOSE).any()):
                break
        t = torch.where(t.isfinite(), t, 0.0)
    away, steepness = residual(t)
    return t - away / steepness.detach(), away.detach().abs() < _HIT


def _refracted(
    dx: Tensor, dy: Tensor, dz: Tensor, x: Tensor, y: Tensor, slope: Tensor, before: Tensor, behind: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Directions behind a surface by Snell's law, which are not totally reflected, and how far they are from it: the
    squared cosine to the normal.
    """
    gx, gy = -2 * slope * x, -2 * slope * y  # the normal is (gx, gy, 1) / length
    length = torch.sqrt(1 + gx**2 + gy**2)
    cosine = (dx * gx + dy * gy + dz) / length
    ratio = before / behind
    squared = 1 - ratio**2 * (1 - cosine**2)
    turned = (torch.sqrt(squared.clamp(min=1e-9)) - ratio * cosine) / length
    passes = (squared.detach() > 0) & (cosine.detach() > 0)
    return ratio * dx + turned * gx, ratio * dy + turned * gy, passes, squared


def system_matrix(surfaces: Sequence[Surface], indices: Sequence[Tensor], *, refract_last: bool = True) -> Tensor:
    """Paraxial (2, 2) matrix of (height, index times slope) from the first vertex to the last, for one wavelength.

    refract_last: whether the last surface refracts; without it the matrix ends in front of it.
    """
    one, zero = torch.ones((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)
    matrix = torch.eye(2, dtype=torch.float64)
    for k, surface in enumerate(surfaces):
        if k < len(surfaces) - 1 or refract_last:
            power = (indices[k + 1] - indices[k]) * surface.vertex_curvature.cpu()
            matrix = torch.stack([torch.stack([one, zero]), torch.stack([-power, one])]) @ matrix
        if k < len(surfaces) - 1:
            reduced = float64(surface.thickness).cpu() / indices[k + 1]
            matrix = torch.stack([torch.stack([one, reduced]), torch.stack([zero, one])]) @ matrix
    return matrix
