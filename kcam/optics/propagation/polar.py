"""PSFs of any smooth pupil with a round rim: Gauss-Legendre in radius times a trapezium in angle; spectral accuracy."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from kcam.optics.numerics import phasor, squared
from kcam.optics.propagation.question import Query, residual_path
from kcam.optics.propagation.radial import ring_amplitude, ring_nodes
from kcam.optics.pupil.coordinates import from_image_side


def polar_psf(query: Query, *, density: float = 1.0) -> Tensor:
    """PSFs of a smooth pupil by Gauss-Legendre in radius times a trapezium in angle, summed directly; (Z, L, H, W).

    density: of the nodes on both axes, relative to what converges to 1e-10.
    """
    wavelengths = query.wavelengths.to(query.device)
    a, d = query.image_side_semi_aperture, query.sensor_distance
    bands = []
    for index, wavelength in enumerate(query.wavelengths.tolist()):
        scale = 2 * math.pi / wavelengths[index] * a / d
        fringes = float(scale.detach()) * (math.sqrt(2) * query.half_window + float(query.displacement[index]))
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
        field = phasor(phase) * amplitude * 2 * math.pi
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
        kernel_x, kernel_y = phasor(-points[:, None] * xi[part]), phasor(-points[:, None] * eta[part])
        total = total + (kernel_y * field[:, None, part]) @ kernel_x.T
    return squared(total)
