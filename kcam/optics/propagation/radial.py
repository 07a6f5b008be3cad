"""PSFs of rotationally symmetric pupils: Gauss-Legendre in radius from rim to rim, so that no edge is cut."""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from kcam.optics.numerics import BesselJ0, lagrange
from kcam.optics.propagation.estimates import paraxial_error, trace
from kcam.optics.propagation.question import Query, radial_phase, residual_path
from kcam.optics.propagation.rings import fewer_nodes, panel_nodes, panel_orders
from kcam.optics.propagation.row import Propagator, Rate
from kcam.optics.pupil.coordinates import Pupil, from_image_side

_TABLE_STEP = math.pi / 12  # of the Hankel table; eight-point interpolation is then good to 2e-8
_MOST_RINGS = 2**20
_RINGS_AT_ONCE = 2**24  # entries of the Hankel table: 128 MB
LOOKUPS = Rate("radial", 1.5e-10)
"""Of operations of which most look numbers up."""


def radial_psf(query: Query) -> Tensor:
    """PSFs of a rotationally symmetric pupil by one Hankel transform, U(t) = 2 pi INT A exp(ikW) J0(t rho) rho d rho.

    Gauss-Legendre nodes from rim to rim, so that the edge is exact; J0 is tabulated over t = k a' r / d, in which all
    wavelengths and distances share one table, and U is interpolated onto the pixels' radii by eight points.
    """
    wavelengths = query.wavelengths.to(query.device)
    a, d = query.image_side_semi_aperture, query.sensor_distance
    scales = 2 * math.pi / wavelengths * a / d
    largest = float(scales.detach().max())
    corner = math.sqrt(2) * query.half_window
    rho, weights = ring_nodes(query, largest * corner)

    x, y = from_image_side(rho, torch.zeros_like(rho), query.tau)
    pupil = query.pupil(x, y)
    coefficients, maps = residual_path(query, pupil)
    phase = 2 * math.pi / wavelengths[:, None, None] * (coefficients @ maps)  # (L, Z, n)
    amplitude, energy = ring_amplitude(query, pupil, rho * weights)
    field = torch.stack([phase.cos(), phase.sin()]) * amplitude  # (2, L, Z, n)
    field, rho = fewer_nodes(field, rho, frequency=largest * corner)

    steps = math.ceil(largest * corner / _TABLE_STEP) + 8
    t = torch.arange(steps, dtype=torch.float64, device=query.device) * _TABLE_STEP
    parts = list(zip(*(part.split(max(1, _RINGS_AT_ONCE // t.numel()), dim=-1) for part in (field, rho)), strict=True))
    if len(parts) == 1:
        transformed = _hankel(field, t, rho)  # (2, L, Z, T)
    else:  # the table of each part is built again in the backward pass, not kept
        transformed = torch.stack([checkpoint(_hankel, f, t, r, use_reentrant=False) for f, r in parts]).sum(0)

    bands = []
    for index, wavelength in enumerate(query.wavelengths.tolist()):
        arguments = (transformed[:, index], scales[index], query, wavelength)
        image = (
            checkpoint(_ring_image, *arguments, use_reentrant=False)
            if transformed.requires_grad
            else (_ring_image(*arguments))
        )
        factor = (a * query.pixel_pitch / (wavelengths[index] * d)) ** 2 / energy
        bands.append(image * factor[:, None, None].to(query.dtype))
    return torch.stack(bands, dim=1)


def hankel_kernel(t: Tensor, rho: Tensor) -> Tensor:
    """2 pi J0(t rho), (n, T): what a field over rings (..., n) is multiplied with."""
    return 2 * math.pi * BesselJ0.apply(t[:, None] * rho).T


def _hankel(field: Tensor, t: Tensor, rho: Tensor) -> Tensor:
    return field @ hankel_kernel(t, rho)


def ring_nodes(query: Query, frequency: float, *, density: float = 1.0) -> tuple[Tensor, Tensor]:
    """Gauss-Legendre nodes and weights over the open part of the radius, image-side coordinates.

    Args: frequency: of the kernel, in radians per image-side semi-aperture; density: of the nodes, relative to what
    converges to 1e-9.
    """
    discs = query.lens.aperture.discs()
    inner = discs[1][0] if len(discs) > 1 else 0.0
    edges = query.panels
    edges = torch.cat([edges.new_full((1,), inner), edges[edges > inner]])
    orders = panel_orders(edges, radial_phase(query), frequency=frequency, density=density)
    if float(orders.sum()) > _MOST_RINGS:
        raise ValueError(
            f"this PSF needs {float(orders.sum()):.3g} rings of the pupil, more than {_MOST_RINGS}: rays at the rim of "
            "the lens are sent too far beyond the window. Use a smaller aperture or a larger radius of curvature."
        )
    # edges move with tau, for a step there moves light; 0 and 1 do not, and nodes without a gradient cost less
    tau = query.tau if edges.numel() > 2 or inner > 0 else query.tau.detach()
    return panel_nodes(edges * torch.sqrt((1 + tau) / (1 + tau * edges**2)), orders)


def ring_amplitude(query: Query, pupil: Pupil, quadrature: Tensor) -> tuple[Tensor, Tensor]:
    """Amplitude times quadrature (1 or Z, n), and the energy that passes in units of a'^2, (1 or Z,)."""
    amplitude = energy = quadrature[None]
    if not query.paraxial:
        falloff = 1 / (1 + query.vergences[:, None] ** 2 * pupil.rho2 * query.semi_aperture**2)
        amplitude = quadrature * pupil.measure * torch.sqrt(falloff)
        energy = quadrature * pupil.measure**2 * falloff
    return amplitude, 2 * math.pi * energy.sum(-1)


def _ring_image(transformed: Tensor, scale: Tensor, query: Query, wavelength: float) -> Tensor:
    """Intensity on the pixels from the tabulated transform (2, Z, T) of one wavelength."""
    per_pixel, reach = query.evaluation_grid(wavelength)
    radii2, inverse = _lattice(reach, query.device)
    position = scale * torch.sqrt(radii2) * (query.pixel_pitch / per_pixel) / _TABLE_STEP
    low = torch.clamp(position.detach().floor().long() - 3, max=transformed.shape[-1] - 8)
    offset = position - low
    value = torch.zeros_like(transformed[..., low])
    for tap, weight in enumerate(lagrange(offset, taps=range(8))):
        value = value + weight * transformed[..., torch.abs(low + tap)]  # U is even in t
    intensity = value.square().sum(0).to(query.dtype)  # (Z, radii)
    return query.pixels(per_pixel).of_quadrant(intensity[:, inverse].view(-1, reach + 1, reach + 1))


@functools.lru_cache(maxsize=8)
@torch.inference_mode(False)
def _lattice(reach: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Distinct squared radii of the grid points in one quadrant, and where each point finds its own."""
    squares = torch.arange(reach + 1, device=device) ** 2
    distinct, inverse = torch.unique(squares[:, None] + squares, return_inverse=True)
    return distinct.to(torch.float64), inverse.flatten()


def _error(query: Query) -> float:
    """Interpolation in the Hankel table, 2e-7 measured, and the model."""
    return min(2.0, 3e-7 + max(paraxial_error(rays, query) for rays in trace(query)))


def lookup_cost(query: Query) -> float:
    """Operations of 40 for each point at which the intensity is evaluated."""
    return query.vergences.numel() * sum(40.0 * m * m for m in query.points_per_axis)


def _needs_symmetry(query: Query) -> str | None:
    if query.symmetric:
        return None
    names = sorted({type(element).__name__ for element in query.lens.elements if not element.symmetric})
    return f"needs a lens of rotationally symmetric elements, but has {', '.join(names)}; use method='matrix'."


RADIAL = Propagator(
    "nonparaxial",
    "radial",
    function=radial_psf,
    error=_error,
    cost=lookup_cost,
    rate=LOOKUPS,
    valid=_needs_symmetry,
    about="one Hankel transform",
)
