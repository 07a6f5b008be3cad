"""Rays over the stop of a real lens and their light: spots, their best focus, and the edge of the field."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcam.inputs import as_values
from kcam.optics.compound.aiming import Asked, Nodes, chiefs, nodes
from kcam.optics.compound.prescription import Prescription
from kcam.optics.compound.pupil import OVERFILL
from kcam.optics.compound.tracing import Rays

CRITERIA = ("rms",)
"""What `CompoundLens.refocus` can make least."""
_STEP = 1e-5  # of the stop's radius: between the rays whose directions tell how much light one stands for
_WIDEST, _INTERVALS, _NESTED = 60.0, 16, 4  # degrees; of a search for the edge of the field


def landed(lens: Prescription, asked: Asked, rings: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points [m] and slopes of rays on the sensor's axes (F, Z, L, R, 2), and their light (F, Z, L, R): see
    `CompoundLens.spots`.
    """
    found = nodes(
        lens,
        torch.cat([asked.wavelengths, lens.focus_line]),
        asked.vergences,
        torch.cat([asked.heights, asked.heights.new_zeros(1)]),
    )
    rays, light = _sent(found, rings)
    whole = light.sum(-1, keepdim=True)
    if not bool((whole > 0).all()):
        height = float(asked.heights[(whole[:-1] <= 0).flatten(1).any(1)].max())
        raise ValueError(
            f"no ray of a point at {height:.3g} (Y / D) passes this lens. Use smaller fields, or a larger "
            "semi_diameter."
        )
    cx, cy = (part[:, None, None, None] for part in asked.directions.unbind(1))

    def on_sensor(x: Tensor, y: Tensor) -> Tensor:
        x, y = x[0, :-1, :, :-1], y[0, :-1, :, :-1]
        return torch.stack([x * cy + y * cx, y * cy - x * cx], dim=-1)

    points = on_sensor(rays.x, rays.y - found.chief.y[:, :, -1:])
    return points, on_sensor(rays.dx / rays.dz, rays.dy / rays.dz), light[:-1, :, :-1] / whole[-1:, :, :-1]


def rms_radius(points: Tensor, weights: Tensor) -> Tensor:
    """Root of the mean squared distance from the centroid, (...), of points (..., R, 2) by weights (..., R) [m]."""
    share = (weights / weights.sum(-1, keepdim=True))[..., None]
    away = points - (share * points).sum(-2, keepdim=True)
    return (share * away.square()).sum((-2, -1)).sqrt()


@torch.no_grad()
def best_focus(lens: Prescription, asked: Asked, weights: Tensor | None) -> float:
    """The sensor's distance at which spots are least [m]: see `CompoundLens.refocus`. weights: (F, L)."""
    counts = torch.ones(len(asked.heights), len(asked.wavelengths), dtype=torch.float64)
    if weights is not None:
        given = as_values(weights, name="weights", unit="of each field and wavelength").to("cpu", torch.float64)
        if given.shape != counts.shape or not bool((given >= 0).all() and (given.sum(1) > 0).any()):
            raise ValueError(
                f"weights must be {tuple(counts.shape)} for fields and wavelengths, >= 0 and not all 0, got shape "
                f"{tuple(given.shape)}."
            )
        counts = given
    points, slopes, light = (part[:, 0] for part in landed(lens, asked, rings=24))
    light = light / light.sum(-1, keepdim=True) * counts[..., None]
    lit = counts.sum(1) > 0
    shift = _sharpest(*(part[lit].flatten(1, 2) for part in (points, slopes, light)))
    best = float(lens.sensor_away.detach()) + shift
    if best <= 0:
        raise ValueError(f"the best focus is {-best:g} m inside the lens, not behind it: focus farther away.")
    return best


def _sharpest(points: Tensor, slopes: Tensor, weights: Tensor) -> float:
    """How much farther the sensor must stand for the least sum of the squared rms radii of F spots [m].

    The spot of a ray at distance s farther is p + s u, so that the variance of each is a quadratic in s: its least is
    at s = -sum cov(p, u) / sum var(u).

    Args: points (F, R, 2) [m], slopes (F, R, 2): dx / dz and dy / dz; weights (F, R), whose sum in each row is what
        that spot counts.
    """
    share = (weights / weights.sum(-1, keepdim=True))[..., None]
    p, u = (part - (share * part).sum(1, keepdim=True) for part in (points, slopes))
    return -float((weights[..., None] * p * u).sum() / (weights[..., None] * u.square()).sum())


@torch.no_grad()
def field_limit(lens: Prescription, vergences: Tensor, least: float) -> float:
    """Largest height Y / D up to which more light than `least` passes: see `CompoundLens.field_limit`."""
    low, high = 0.0, math.radians(_WIDEST)
    for _ in range(_NESTED):
        angles = torch.linspace(low, high, _INTERVALS + 1, dtype=torch.float64)
        found = chiefs(lens, lens.focus_line, vergences, torch.cat([angles.new_zeros(1), angles.tan()]))
        light = _sent(found, rings=8)[1].sum(-1)[:, 0, 0]
        passes = found.chief.alive[:, 0, 0, 0] & (light > least * light[0])
        fails = torch.nonzero(~passes[1:])
        if not len(fails):
            return math.tan(high)
        first = int(fails[0])
        low, high = float(angles[max(first - 1, 0)]), float(angles[first])
    return math.tan(low)


def _sent(found: Nodes, rings: int) -> tuple[Rays, Tensor]:
    """Rays over the stop, at the sensor, and beside these two more, (3, F, Z, L, R); and their light: see `_light`."""
    x, y, area = _hexapolar(rings)
    beside = _STEP * torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    x, y = (part + step[:, None, None, None, None] for part, step in zip((x, y), beside, strict=True))
    rays = found.beam.at_sensor(*found.towards(x, y))
    return rays, _light(rays, area)


def _hexapolar(rings: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points x, y of a disc a little larger than 1, and the area that each stands for, (R,) each.

    6 k points on ring k, mirrored left and right, R = 1 + 3 rings (rings + 1).
    Raises: ValueError for fewer than 2 rings.
    """
    if rings < 2:
        raise ValueError(f"rays need rings >= 2 around the chief ray, got {rings}. Use 12, which are 469 rays.")
    ring = torch.cat([torch.full((max(6 * k, 1),), k, dtype=torch.float64) for k in range(rings + 1)])
    angle = torch.cat([(torch.arange(max(6 * k, 1)) + 0.5) / max(6 * k, 1) for k in range(rings + 1)]) * 2 * math.pi
    step = OVERFILL / (rings + 0.5)
    area = torch.where(ring == 0, math.pi * step**2 / 4, math.pi * step**2 / 3)
    return step * ring * angle.double().sin(), step * ring * angle.double().cos(), area


def _light(rays: Rays, area: Tensor) -> Tensor:
    """Area in image-side direction cosines that each ray stands for, (..., R): 0 where it does not pass.

    A ray whose cell an edge cuts counts with the open part of the cell: counted by whole rays, the light of a vignetted
    pupil would be off by percents.

    Args: rays: (3, ..., R), of each point of the stop, and of those `_STEP` of its radius beside it in x and in y.
        area: of its cell in the stop, relative to the stop's radius squared (R,).
    """
    dx, dy = rays.dx[1:] - rays.dx[0], rays.dy[1:] - rays.dy[0]
    found = (dx[0] * dy[1] - dx[1] * dy[0]).abs() / _STEP**2 * area
    for q in rays.clearance:
        slope = ((q[1:] - q[0]) / _STEP).square().sum(0).clamp(min=1e-18).sqrt()
        found = found * (0.5 + q[0] / (slope * area.sqrt())).clamp(0, 1)
    return torch.where(rays.alive.all(0), found, 0.0)
