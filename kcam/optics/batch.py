"""PSFs of a batch of lenses in one call, for augmentations that draw a lens per sample."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcam.optics import sampling
from kcam.optics.elements import zernike_sum
from kcam.optics.pupil import Pupil, disc_weights, grid_nodes, grid_spacing, unfold_quadrant
from kcam.optics.transforms import MatrixTransform, pupil_intensity
from kcam.units import check_pixel_pitch, check_positive, wavelength_grid


def batch_psf(
    vergences: Tensor,
    *,
    radii: Tensor,
    coefficients: Tensor | None = None,
    wavelengths: Tensor | list[float],
    sensor_distance: Tensor | float,
    pixel_pitch: float,
    shape: tuple[int, int],
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """PSFs of a batch of ideal round lenses, each with its own defocus, aperture and aberrations.

    W = V r^2 / 2 + sum_j c_j Z_j(r / a), the same at all wavelengths, propagated paraxially. No module is built per
    sample: an augmentation draws these numbers and calls this once.

    Args:
        vergences: residual V, (B,) or (B, Z) [1/m]; 0 is in focus, 1/z - 1/z_focus for an object at z.
        radii: semi-apertures a, (B,) [m], > 0.
        coefficients: (B, K) of Noll's Zernikes j = 1..K [m RMS], or None.
        wavelengths: (L,) [m]. sensor_distance: d, a number or (B,) [m]. pixel_pitch: [m]. shape: (H, W) pixels.
    Returns:   (B, Z, L, H, W) energy in each pixel relative to what passes the aperture; Z is 1 for vergences (B,).
               Differentiable in vergences, radii, coefficients and sensor_distance.
    Raises:    ValueError for shapes that do not fit, radii or distances that are not > 0, a pupil grid beyond the
        limit.
    Valid in the paraxial range: 1 % where w4 = a^4 / (8 d^3 lambda) is below 0.005 waves.
    Source:    equation (3.4), and Noll, J. Opt. Soc. Am. 66, 207 (1976).
    """
    grid = wavelength_grid(wavelengths)
    check_pixel_pitch(pixel_pitch)
    check_positive(radii, name="radii")
    check_positive(sensor_distance, name="sensor_distance")
    device = vergences.device
    residual = vergences.to(torch.float64)
    residual = residual[:, None] if residual.ndim == 1 else residual  # (B, Z)
    batch = residual.shape[0]
    a = torch.as_tensor(radii, dtype=torch.float64, device=device).expand(batch)
    d = torch.as_tensor(sensor_distance, dtype=torch.float64, device=device).expand(batch)
    if coefficients is not None and (coefficients.ndim != 2 or coefficients.shape[0] != batch):
        raise ValueError(f"coefficients must be (B, K) with B = {batch}, got {tuple(coefficients.shape)}.")
    if batch == 0:
        return residual.new_zeros(0, residual.shape[1], grid.numel(), *shape, dtype=dtype)

    def zernikes(x: Tensor, y: Tensor) -> list[Tensor]:
        pupil = Pupil(x, y, torch.ones_like(a[0]), torch.ones_like(a[0]), paraxial=True)
        count = 0 if coefficients is None else coefficients.shape[1]
        unit = torch.eye(count, dtype=torch.float64, device=device)
        return [pupil.rho2, *(zernike_sum(unit[j], pupil) for j in range(count))]

    # OPD as coefficients of rho^2 and of the Zernikes, (B, Z, T)
    opd = (residual * a[:, None] ** 2 / 2)[..., None]
    if coefficients is not None:
        own = coefficients.to(device, torch.float64)[:, None].expand(-1, residual.shape[1], -1)
        opd = torch.cat([opd, own], dim=-1)
    with torch.no_grad():
        side = torch.linspace(-1, 1, 65, dtype=torch.float64, device=device)
        coarse = torch.stack(zernikes(side[None, :], side[:, None]))
        inside = (side[None, :] ** 2 + side[:, None] ** 2 <= 1.0001).flatten()
        slopes = [
            (opd @ g.flatten(1)[:, inside]).square() for g in torch.gradient(coarse, spacing=2 / 64, dim=(-2, -1))
        ]
        displacement = torch.stack(slopes).sum(0).sqrt().amax(dim=(1, 2)) * d / a
        widest = a / d
        half_window = (max(shape) // 2 + sampling.WINDOW_MARGIN) * pixel_pitch
        shortest = float(grid.min())
        count = max(
            sampling.pupil_samples(
                semi_aperture=float(a_b),
                sensor_distance=float(d_b),
                wavelength=shortest,
                half_window=half_window,
                displacement=float(s_b),
            )
            for a_b, d_b, s_b in zip(a, d, displacement, strict=True)
        )
        if count > sampling.MAX_PUPIL_SAMPLES:
            raise ValueError(
                f"this batch needs {count} pupil samples, more than {sampling.MAX_PUPIL_SAMPLES}: the largest blur "
                f"reaches {float(displacement.max()) * 1e3:.3g} mm. Use smaller radii, vergences or shape."
            )
        per_pixel = sampling.points_per_pixel(
            pixel_pitch=pixel_pitch, semi_aperture=float(widest.max()), sensor_distance=1.0, wavelength=shortest
        )
    reach = math.ceil(per_pixel * (max(shape) // 2 + sampling.WINDOW_MARGIN))
    step = pixel_pitch / per_pixel
    nodes = grid_nodes(count)
    maps = torch.stack([m.expand(count, count) for m in zernikes(nodes[None, :].to(device), nodes[:, None].to(device))])
    wavenumbers = (2 * math.pi / grid).to(device)
    weights = unfold_quadrant(disc_weights(count, spacing=grid_spacing(count))).to(device)
    scales = (wavenumbers * (a / d)[:, None]).flatten()  # (B L,)
    like = torch.empty(0, dtype=dtype, device=device)
    intensity = pupil_intensity(
        (wavenumbers[:, None, None] * opd[:, None]).flatten(0, 1).to(dtype),
        maps=maps.to(dtype),
        amplitude=weights[None].to(dtype),
        field=None,
        scales=scales.to(dtype),
        transforms=[
            MatrixTransform.build(nodes, scale=float(s), step=step, reach=reach, like=like) for s in scales.detach()
        ],
        nodes=nodes,
        step=step,
    )
    area = grid_spacing(count) ** 2 / float(weights.sum())
    factor = area * (a[:, None] * pixel_pitch / (grid.to(device) * d[:, None])) ** 2  # (B, L)
    rows, columns = (sampling.pixel_box(n, per_pixel=per_pixel, reach=reach).to(like) for n in shape)
    images = (rows @ intensity @ columns.mT).unflatten(0, (batch, -1)) * factor[..., None, None, None].to(dtype)
    return images.transpose(1, 2)
