"""What a PSF means for a picture: its modulation transfer function, and the light within a circle."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from kcam.optics.numerics import phasor, squared
from kcam.optics.propagation.question import Query
from kcam.optics.propagation.table import choose
from kcam.optics.pupil.quadrants import unfold
from kcam.optics.pupil.rim import disc_weights


def mtf(query: Query, *, propagator: str = "nonparaxial", method: str | None = None) -> Tensor:
    """As `Lens.mtf`, of a query."""
    height, width = query.shape
    curves = []
    for wavelength in query.wavelengths:
        # sampled finer than the pixels, and times the pixel's sinc: the pixels' own samples would alias
        fine = 2 * _points_per_pixel(query, wavelength) + 1
        points = _between_pixels(query, wavelength, fine=fine, shape=(height * fine, width * fine))
        image = choose(points, propagator=propagator, method=method)(points)[:, 0]
        otf = torch.fft.fftshift(torch.fft.fft2(image), dim=(-2, -1))
        # a floor far below the transform's own rounding: no NaN gradient at the zeros of an MTF
        modulation = torch.sqrt(squared(otf) + torch.finfo(query.dtype).tiny)
        total = modulation[..., height * fine // 2, width * fine // 2][..., None, None]
        for dim, n in zip((-2, -1), query.shape, strict=True):
            modulation = modulation.narrow(dim, n * fine // 2 - n // 2, n)
            frequency = (torch.arange(n, device=modulation.device) - n // 2) / n  # cycles per pixel
            if query.grid.integrate:
                sinc = torch.sinc(frequency * query.grid.active).abs().to(modulation)
                modulation = modulation * (sinc[:, None] if dim == -2 else sinc)
        curves.append(modulation / total)
    return torch.stack(curves, dim=1)


def encircled_energy(query: Query, *, propagator: str = "nonparaxial", method: str | None = None) -> Tensor:
    """As `Lens.encircled_energy`, of a query."""
    largest = min(query.shape) // 2
    curves = []
    for wavelength in query.wavelengths:
        fine = 3 * _points_per_pixel(query, wavelength)
        side = 2 * (largest * fine + 8) + 3
        points = _between_pixels(query, wavelength, fine=fine, shape=(side, side))
        image = choose(points, propagator=propagator, method=method)(points)[:, 0]
        curves.append(torch.stack([_disc_sum(image, k * fine) for k in range(largest + 1)], dim=-1))
    return torch.stack(curves, dim=1)


def _points_per_pixel(query: Query, wavelength: Tensor) -> int:
    """Whole points per pixel that sample the irradiance, whether or not the query integrates over its pixels."""
    return math.ceil(query.on(integrate=True).evaluation_grid(float(wavelength))[0])


def _between_pixels(query: Query, wavelength: Tensor, *, fine: int, shape: tuple[int, int]) -> Query:
    """The same question of one wavelength at points `fine` times as close, not integrated."""
    one = replace(query, wavelengths=wavelength[None])
    return one.on(pitch=query.pixel_pitch / fine, shape=shape, integrate=False)


def _disc_sum(image: Tensor, radius: int) -> Tensor:
    """Integral over a disc around the centre of an odd image (..., 2K+1, 2K+1), radius in samples; (...)."""
    if radius == 0:
        return image.sum((-2, -1)) * 0
    half = radius + 8
    centre = image.shape[-1] // 2
    weights = unfold(disc_weights(2 * half, spacing=1.0, radius=float(radius))).to(image)
    # the weights' nodes lie half-way between the image's points: shift by half a sample in the frequency domain
    window = image[..., centre - half : centre + half, centre - half : centre + half]
    return (window * _half_shifted(weights)).sum((-2, -1))


def _half_shifted(weights: Tensor) -> Tensor:
    """The weights at integer positions instead of half-integer ones, by their band-limited interpolation."""
    n = weights.shape[-1]
    frequency = torch.fft.fftfreq(n, device=weights.device, dtype=torch.float64)
    turn = phasor(-torch.pi * frequency)
    spectrum = torch.fft.fft2(weights.to(torch.float64)) * turn[:, None] * turn
    return torch.fft.ifft2(spectrum).real.to(weights)
