"""The geometrical limit: rays along the slope of the residual path, shared among pixels."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcam.optics.propagation.estimates import ring_turns, trace
from kcam.optics.propagation.question import Query, residual_path
from kcam.optics.propagation.radial import LOOKUPS, lookup_cost
from kcam.optics.propagation.row import Propagator
from kcam.optics.pupil.quadrants import unfold
from kcam.optics.pupil.rim import round_weights


def geometric_psf(query: Query) -> Tensor:
    """PSFs by rays: each pupil sample lands at x = d grad W and is shared among its four nearest pixels.

    Source: the geometrical limit of equation (3.4) by stationary phase.
    """
    displacement = float(query.displacement.max())
    count = min(1024, max(256, 32 * math.ceil(4 * displacement / query.pixel_pitch / 32)))
    half = count // 2
    spacing = 2.0 / count
    axis = (torch.arange(count, dtype=torch.float64, device=query.device) + 0.5 - half) * spacing
    with torch.enable_grad():
        x = axis[None, :].expand(count, count).clone().requires_grad_()
        y = axis[:, None].expand(count, count).clone().requires_grad_()
        pupil = query.pupil(x, y)
        coefficients, maps = residual_path(query, pupil)
        slopes = [torch.autograd.grad(m.sum(), (x, y), create_graph=True, allow_unused=True) for m in maps]
    slopes_x, slopes_y = (torch.stack([torch.zeros_like(x) if s[i] is None else s[i] for s in slopes]) for i in (0, 1))
    power = query.transmission(axis * query.semi_aperture) ** 2
    if query.lens.round:
        power = power * unfold(round_weights(query.lens.aperture.discs(), count, spacing=spacing)).to(query.device)
    power = power.expand(query.vergences.numel(), count, count)
    if not query.paraxial:
        power = power / (1 + query.vergences[:, None, None] ** 2 * pupil.rho2.detach() * query.semi_aperture**2)
    power = power / power.sum((-2, -1), keepdim=True)
    scale = query.sensor_distance / query.semi_aperture / query.pixel_pitch
    bands = []
    for coefficient in coefficients:
        column = torch.einsum("zt,tvu->zvu", coefficient, slopes_x) * scale + query.shape[1] // 2
        row = torch.einsum("zt,tvu->zvu", coefficient, slopes_y) * scale + query.shape[0] // 2
        bands.append(_splat(power, row, column, query.shape))
    images = torch.stack(bands, dim=1).to(query.dtype)
    # the rays' own coordinates carry a graph; the result does only where something else in the path has a gradient
    centre = torch.zeros(1, dtype=torch.float64, device=query.device)
    trained = any(part.requires_grad for part in residual_path(query, query.pupil(centre, centre)))
    return images if trained else images.detach()


def _splat(power: Tensor, row: Tensor, column: Tensor, shape: tuple[int, int]) -> Tensor:
    """Add each ray's power to its four nearest pixels, (Z, N, N) -> (Z, H, W)."""
    distances = power.shape[0]
    image = power.new_zeros(distances, shape[0] * shape[1])
    low_row, low_column = row.detach().floor(), column.detach().floor()
    for dr in (0, 1):
        for dc in (0, 1):
            r, c = low_row + dr, low_column + dc
            weight = (1 - (row - r).abs()) * (1 - (column - c).abs()) * power
            inside = (r >= 0) & (r < shape[0]) & (c >= 0) & (c < shape[1])
            target = (r.clamp(0, shape[0] - 1) * shape[1] + c.clamp(0, shape[1] - 1)).long()
            image = image.scatter_add(1, target.flatten(1), (weight * inside).flatten(1))
    return image.view(distances, *shape)


def _error(query: Query) -> float:
    """1.2 / (1 + phase / 3)^(1/3), phase the rms of the residual [rad]: the decay with waves of numerics note, 5.5.

    Rings between which the phase turns have no rays of their own: twice the turn is added.
    """
    return min(2.0, max(1.2 / (1 + rays.phase / 3) ** (1 / 3) for rays in trace(query)) + 2 * ring_turns(query))


def _needs_smooth_path(query: Query) -> str | None:
    if query.has_pixel_phase:
        return "has no rays for a DOE of flat pixels, whose slope is 0 or infinite; use propagator='nonparaxial'."
    return None


RAYS = Propagator(
    "geometric",
    "rays",
    function=geometric_psf,
    error=_error,
    cost=lookup_cost,
    rate=LOOKUPS,
    valid=_needs_smooth_path,
    exact=False,
    about="no diffraction, splatted onto the pixels",
)
