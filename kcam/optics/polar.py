"""Pupils in polar coordinates: Gauss-Legendre in radius from rim to rim, so that no edge is cut.

`radial_psf` is one Hankel transform, for rotationally symmetric lenses; `polar_psf` adds a trapezium in angle, for any
smooth pupil with a round rim, and converges spectrally.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from kcam.optics.psf import Query, radial_phase, residual_path
from kcam.optics.pupil import Pupil, from_image_side
from kcam.optics.rings import fewer_nodes, panel_nodes, panel_orders

_TABLE_STEP = math.pi / 12  # of the Hankel table; eight-point interpolation is then good to 2e-8
_MOST_RINGS = 2**20
_RINGS_AT_ONCE = 2**24  # entries of the Hankel table: 128 MB


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

    t = torch.arange(math.ceil(largest * corner / _TABLE_STEP) + 8, dtype=torch.float64, device=query.device)
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


def _hankel(field: Tensor, t: Tensor, rho: Tensor) -> Tensor:
    """2 pi SUM field J0(t rho) at the table's arguments: (..., n) -> (..., T)."""
    return 2 * math.pi * field @ _BesselJ0.apply(t[:, None] * _TABLE_STEP * rho).T


class _BesselJ0(torch.autograd.Function):
    """J0 with its derivative -J1, which torch.special leaves out without a word; any number of times."""

    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return torch.special.bessel_j0(x)

    @staticmethod
    def backward(ctx, grad):
        (x,) = ctx.saved_tensors
        return -grad * _BesselJ1.apply(x)


class _BesselJ1(torch.autograd.Function):
    """J1 with its derivative J0 - J1(x) / x."""

    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return torch.special.bessel_j1(x)

    @staticmethod
    def backward(ctx, grad):
        (x,) = ctx.saved_tensors
        near = x.abs() < 1e-3  # where the quotient's own derivatives would cancel: its series, to 1e-20
        ratio = _BesselJ1.apply(x) / torch.where(near, 1, x)
        series = 0.5 - x**2 / 16 + x**4 / 384
        return grad * (_BesselJ0.apply(x) - torch.where(near, series, ratio))


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
    for tap, weight in enumerate(_lagrange(offset)):
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


def _lagrange(offset: Tensor, points: int = 8) -> list[Tensor]:
    """Weights of the Lagrange polynomial through 0..points-1 at `offset`."""
    weights = []
    for tap in range(points):
        weight = torch.ones_like(offset)
        for other in range(points):
            if other != tap:
                weight = weight * (offset - other) / (tap - other)
        weights.append(weight)
    return weights


def polar_psf(query: Query, *, density: float = 1.0) -> Tensor:
    """PSFs of a smooth pupil by Gauss-Legendre in radius times a trapezium in angle, summed directly; (Z, L, H, W).

    density: of the nodes on both axes, relative to what converges to 1e-10.
    """
    wavelengths = query.wavelengths.to(query.device)
    a, d = query.image_side_semi_aperture, query.sensor_distance
    displacement = query.displacement
    bands = []
    for index, wavelength in enumerate(query.wavelengths.tolist()):
        scale = 2 * math.pi / wavelengths[index] * a / d
        fringes = float(scale.detach()) * (math.sqrt(2) * query.half_window + float(displacement[index]))
        rho, weights = ring_nodes(query, fringes, density=1.5 * density)
        angles = 2 * math.ceil(density * (1.2 * fringes + 32))
        theta = torch.arange(angles, dtype=torch.float64, device=query.device) * (2 * math.pi / angles)
        xi, eta = (rho[:, None] * theta.cos()).flatten(), (rho[:, None] * theta.sin()).flatten()
        x, y = from_image_side(xi, eta, query.tau)
        pupil = query.pupil(x, y)
        quadrature = (rho * weights)[:, None].expand(-1, angles).flatten() / angles
        coefficients, maps = residual_path(replace(query, wavelengths=query.wavelengths[index : index + 1]), pupil)
        phase = 2 * math.pi / wavelengths[index] * (coefficients[0] @ maps)
        amplitude, energy = ring_amplitude(query, pupil, quadrature)
        field = torch.complex(phase.cos(), phase.sin()) * amplitude * 2 * math.pi
        per_pixel, reach = query.evaluation_grid(wavelength)
        points = torch.arange(-reach, reach + 1, dtype=torch.float64, device=query.device)
        points = points * (query.pixel_pitch / per_pixel) * scale
        image = _direct_intensity(field, points, xi, eta)
        factor = (a * query.pixel_pitch / (wavelengths[index] * d)) ** 2 / energy
        bands.append(query.pixels(per_pixel).of_image(image) * factor[:, None, None])
    return torch.stack(bands, dim=1)


def _direct_intensity(field: Tensor, points: Tensor, xi: Tensor, eta: Tensor) -> Tensor:
    """|sum_p field_p exp(-i (x xi_p + y eta_p))|^2 at all pairs of points."""
    total = field.new_zeros(field.shape[0], points.numel(), points.numel())
    for part in torch.arange(xi.numel(), device=xi.device).split(16_384):
        along_x, along_y = points[:, None] * xi[part], points[:, None] * eta[part]
        kernel_x = torch.complex(along_x.cos(), -along_x.sin())
        kernel_y = torch.complex(along_y.cos(), -along_y.sin())
        total = total + (kernel_y * field[:, None, part]) @ kernel_x.T
    return total.real.square() + total.imag.square()
