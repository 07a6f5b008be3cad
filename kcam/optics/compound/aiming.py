"""Rays from points of the field of a real lens, aimed through its stop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from kcam.inputs import as_values
from kcam.optics.compound.prescription import FirstOrder, Prescription, refractive_indices
from kcam.optics.compound.tracing import Rays, trace
from kcam.units import check_distances, wavelength_grid

_AIMING = 10  # steps of the secant that aims a chief ray, at most
_INNER = 0.4  # of the stop's radius: rays that tell how the stop lies in the entrance pupil
_AIMED = 1e-11  # of the entrance pupil: a last Newton step squares what is left
_STEP = 1e-3  # of differences in the entrance pupil, of that


@dataclass(frozen=True)
class Asked:
    """wavelengths (L,), vergences (Z,); heights (F,) of field points, and their directions on the sensor (F, 2)."""

    wavelengths: Tensor
    vergences: Tensor
    heights: Tensor
    directions: Tensor

    @classmethod
    def of(cls, wavelengths: Tensor | list[float], distances: Tensor | float, field: Tensor | None) -> Asked:
        """In numbers of ours; field: (F, 2) of X / D and Y / D, None for the axis. Raises: ValueError for another."""
        points = torch.zeros(1, 2, dtype=torch.float64)
        if field is not None:
            points = as_values(field, name="field", unit="X / D, Y / D").to("cpu", torch.float64)
        if points.ndim != 2 or points.shape[1] != 2 or not len(points) or not bool(points.isfinite().all()):
            raise ValueError(f"field must be finite, (F, 2) of X / D and Y / D, got shape {tuple(points.shape)}.")
        heights = points.square().sum(1).clamp(min=1e-300).sqrt() * (points != 0).any(1)
        away = torch.where(heights[:, None] > 0, points / heights.clamp(min=1e-150)[:, None], points.new_tensor([0, 1]))
        return cls(wavelength_grid(wavelengths), 1 / check_distances(distances).reshape(-1).cpu(), heights, away)


def launch(heights: Tensor, vergences: Tensor, px: Tensor, py: Tensor, *, entrance: Tensor) -> Rays:
    """Rays at the plane of the first vertex: see `CompoundLens.launch`."""
    e = entrance
    v = vergences / (1 + vergences * e)  # from the entrance pupil
    sx, sy = px * v, py * v - heights
    n = torch.rsqrt(1 + sx**2 + sy**2)
    x, y = px - e * sx, py - e * sy
    tau = heights * (1 + vergences * e)
    # from the object to here, less what its ray through the vertex travels: does not cancel at any distance
    root = torch.sqrt((vergences * x) ** 2 + (vergences * y - tau) ** 2 + 1)
    path = (vergences * (x**2 + y**2) - 2 * y * tau) / (root + torch.sqrt(tau**2 + 1))
    alive = torch.ones_like(n, dtype=torch.bool)
    x, y, dx, dy, path = torch.broadcast_tensors(x, y, sx * n, sy * n, path)
    return Rays(x, y, dx, dy, path, alive)


@dataclass(frozen=True)
class Beam:
    """From points at heights (Y / D) and vergences [1/m] through a lens of these indices and this `first_order()`; all
    broadcast against rays. Rays cross the entrance pupil at px and py [m].
    """

    lens: Prescription
    heights: Tensor
    vergences: Tensor
    indices: Sequence[Tensor]
    first: FirstOrder

    def launched(self, px: Tensor, py: Tensor) -> Rays:
        """Rays at the plane of the first vertex."""
        return launch(self.heights, self.vergences, px, py, entrance=self.first.entrance_pupil)

    def at(self, surface: int, px: Tensor, py: Tensor) -> Rays:
        """Where rays meet a surface, before it refracts."""
        return trace(self.lens.surfaces, self.launched(px, py), self.indices, until=surface)

    def at_sensor(self, px: Tensor, py: Tensor) -> Rays:
        """Where rays meet the sensor, whether they pass the lens or not."""
        rays = trace(self.lens.surfaces, self.launched(px, py), self.indices)
        t = self.lens.sensor_away / rays.dz
        return replace(rays, x=rays.x + t * rays.dx, y=rays.y + t * rays.dy, path=rays.path + t)


@dataclass(frozen=True)
class Nodes:
    """What rays to F x Z x L nodes start from: their beam, (..., R); where chief rays cross the entrance pupil, and how
    the stop follows it there: see `aimed`; the chief rays at the sensor, (F, Z, L, 1); and what leads to places of the
    stop, (F, Z, L, 3): see `_towards`.
    """

    beam: Beam
    aim: Tensor
    across: Tensor
    along: Tensor
    chief: Rays
    stop: Tensor

    def towards(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Where rays that come to (x, y) of the stop, in its radii, cross the entrance pupil, about: px and py [m]."""
        beside, above, bent = self.stop.split(1, dim=-1)
        return x * beside.abs(), self.aim + y * above.abs() + y**2 * bent


def nodes(lens: Prescription, wavelengths: Tensor, vergences: Tensor, heights: Tensor) -> Nodes:
    """Chief rays of heights (F,), vergences (Z,) and wavelengths (L,). Raises: ValueError where one is lost."""
    found = chiefs(lens, wavelengths, vergences, heights)
    alive = found.chief.alive
    if not bool(alive.all()):
        height = float(found.beam.heights.expand(alive.shape)[~alive].max())
        raise ValueError(
            f"the chief ray of a point at {height:.3g} (Y / D) misses a surface or is totally reflected: the field "
            "of this lens is smaller. Use smaller fields."
        )
    return found


def chiefs(lens: Prescription, wavelengths: Tensor, vergences: Tensor, heights: Tensor) -> Nodes:
    """The same where some may be lost: `chief.alive` says which are not."""
    indices = [index[None, None, :, None] for index in refractive_indices(lens.surfaces, wavelengths)]
    beam = Beam(lens, heights[:, None, None, None], vergences[None, :, None, None], indices, lens.first_order())
    aim, across, along = aimed(beam)
    chief = beam.at_sensor(torch.zeros_like(aim), aim)
    return Nodes(beam, aim, across, along, chief, _towards(beam, aim, across, along))


def aimed(beam: Beam) -> tuple[Tensor, Tensor, Tensor]:
    """Where chief rays cross the entrance pupil, and how the stop follows it there: see `CompoundLens.aimed`."""
    semi, stop = beam.first.entrance_semi_diameter.detach(), beam.lens.stop
    step = _STEP * semi
    zero = torch.zeros_like(torch.broadcast_tensors(beam.heights, beam.vergences, *beam.indices)[0])
    with torch.no_grad():
        before, now = zero, zero + step
        low, high = (beam.at(stop, zero, at).y for at in (before, now))
        for _ in range(_AIMING):
            slope = (high - low) / torch.where(now == before, 1.0, now - before)
            slope = torch.where(slope.abs() < 1e-6, 1.0, slope)
            before, low, now = now, high, now - high / slope
            high = beam.at(stop, zero, now).y
            if bool((high.abs() < _AIMED * semi).all()):
                break
        along = (beam.at(stop, zero, now + step).y - high) / step
        across = beam.at(stop, zero + step, now).x / step
    return now - beam.at(stop, zero, now).y / along, across, along


@torch.no_grad()
def _towards(beam: Beam, aim: Tensor, across: Tensor, along: Tensor) -> Tensor:
    """Where rays cross the entrance pupil that come to (x, y) of the stop, in its radii, about: coefficients of x, y
    and y^2 beside the chief ray's height, (..., 3) [m]. By rays to points `_INNER` of the radius from its middle.
    """
    semi = beam.lens.stop_semi_diameter
    beside = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64, device=aim.device)
    above = torch.tensor([0.0, 1.0, -1.0], dtype=torch.float64, device=aim.device)
    x, y = _INNER * semi * beside / across, _INNER * semi * above / along
    rays = beam.at(beam.lens.stop, x, aim + y)
    up, down = rays.y[..., 1:2], rays.y[..., 2:]
    slope, bend = (up - down) / (2 * y[..., 1:2]), (up + down) / (2 * y[..., 1:2] ** 2)
    straight = semi / torch.cat([rays.x[..., :1] / x[..., :1], slope], dim=-1)
    curved = torch.cat([straight, -bend / slope * straight[..., 1:] ** 2], dim=-1)
    linear = torch.cat([semi / across, semi / along, torch.zeros_like(along)], dim=-1)
    return torch.where(rays.alive.all(-1, keepdim=True), curved, linear)
