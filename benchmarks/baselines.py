"""The textbook computations that kcam is measured against: plain, readable, and not made slow on purpose.

`textbook_psf_bank` is eq. 3.4 of the thesis as one writes it down first: every phase sampled one by one, a binary
aperture, one zero-padded complex128 FFT per wavelength and distance, |U|^2 interpolated onto the pixels.
`angular_spectrum_psf` is the other textbook way. `per_band_render` convolves band by band. All three are plain torch
and differentiable by autograd. Energies are relative to what passes the aperture, as in kcam, so that no
normalisation hides an error. Nothing here imports kcam.

Conventions: SI units, exp(-i omega t), delay positive; x along columns, y down rows, index n // 2 the origin.
"""

from __future__ import annotations

import math

import torch
from scipy.fft import next_fast_len
from torch import Tensor
from torch.nn import functional

DOUBLE = torch.float64


def doe_scale(wavelengths: Tensor, indices: Tensor, *, design_wavelength: float, design_index: float) -> Tensor:
    """Eq. 3.8: what a phase at the design wavelength is multiplied with at each wavelength (L,)."""
    return design_wavelength * (indices - 1) / (wavelengths * (design_index - 1))


def pupil_axis(samples: int, *, aperture_diameter: float) -> Tensor:
    """Centres of `samples` pixels that span the aperture's diameter [m]."""
    return (torch.arange(samples, dtype=DOUBLE) - (samples - 1) / 2) * (aperture_diameter / samples)


def textbook_psf_bank(
    doe_phase: Tensor,
    *,
    wavelengths: Tensor,
    distances: Tensor,
    aperture_diameter: float,
    radius_of_curvature: Tensor | float,
    lens_index: Tensor,
    sensor_distance: Tensor | float,
    pixel_pitch: float,
    shape: tuple[int, int],
    doe_factor: Tensor | None = None,
    padded: int | None = None,
    oversample: int = 1,
    field_dtype: torch.dtype = torch.complex128,
) -> Tensor:
    """PSFs by eq. 3.2-3.5: source chirp + lens + DOE + propagation chirp, padded FFT, |U|^2, bilinear resampling.

    Args:      doe_phase: (N, N) phase at the design wavelength [rad]; a zero map for a plain lens. N, 891 in the
               thesis, is the pupil grid. Differentiable, as are the curvature and the sensor distance; Zernike or
               defocus coefficients enter as the map that they make.
               wavelengths: (L,) [m]. distances: (D,) object distances, inf allowed [m].
               radius_of_curvature: of the plano-convex lens [m]. lens_index: (L,) its index.
               doe_factor: (L,) from `doe_scale`; None for 1.
               padded: FFT length. None takes for each wavelength the fast length whose output pitch comes next below
               the pixel's (or the oversampled pixel's), so that little is left to interpolate: `matched_length`.
               oversample: samples per pixel and axis that are averaged; 1 is point sampling at the pixel's centre.
               field_dtype: of the field and its FFT; phases of thousands of radians are float64 in any case.
    Returns:   (D, L, h, w), float64 or as the field, share of the light per pixel.
    Measured:  with a fixed 2 N (2.8 um against 3 um pixels) bilinear interpolation costs 9 % in focus, with the matched
               length 1 %; the staircase of the binary mask is 0.14 % at N = 891.
    """
    samples = doe_phase.shape[-1]
    step = aperture_diameter / samples
    u = pupil_axis(samples, aperture_diameter=aperture_diameter)
    r2 = u[:, None] ** 2 + u[None, :] ** 2
    mask = (r2 <= (aperture_diameter / 2) ** 2).to(DOUBLE)
    lens_height = torch.sqrt((radius_of_curvature**2 - r2).clamp(min=0))  # the corners may lie outside the sphere
    factor = torch.ones_like(wavelengths) if doe_factor is None else doe_factor
    area = math.pi * aperture_diameter**2 / 4
    doe_phase = doe_phase.to(DOUBLE)

    bank = []
    for distance in distances:
        for wavelength, index, scale in zip(wavelengths, lens_index, factor, strict=True):
            k = 2 * math.pi / wavelength
            source = k * r2 / (2 * distance)  # eq. 3.2
            lens = k * (index - 1) * lens_height  # eq. 3.7
            propagation = k * r2 / (2 * sensor_distance)  # eq. 3.4, the chirp inside the integral
            field = torch.polar(mask, source + lens + scale * doe_phase + propagation).to(field_dtype)
            per_pixel = float(wavelength * sensor_distance / step) / (pixel_pitch / oversample)
            length = padded or matched_length(per_pixel, samples=samples)
            spectrum = torch.fft.fft2(field, s=(length, length))  # padded at the end: only a phase, gone in |U|^2
            intensity = torch.fft.fftshift(spectrum.real**2 + spectrum.imag**2)
            density = intensity * step**4 / (area * (wavelength * sensor_distance) ** 2)
            native = wavelength * sensor_distance / (length * step)  # pitch of the FFT's output
            bank.append(
                resample(density, native_pitch=native, pixel_pitch=pixel_pitch, shape=shape, oversample=oversample)
            )
    return torch.stack(bank).reshape(len(distances), len(wavelengths), *shape) * pixel_pitch**2


def matched_length(per_pixel: float, *, samples: int) -> int:
    """FFT length >= samples that is fast and just above a multiple of `per_pixel`, the length that hits the pixels."""
    multiple = math.ceil(samples / per_pixel)
    return next_fast_len(math.ceil(multiple * per_pixel), real=False)


def resample(
    density: Tensor, *, native_pitch: Tensor | float, pixel_pitch: float, shape: tuple[int, int], oversample: int = 1
) -> Tensor:
    """Bilinear interpolation of a square density onto other pixels, averaging oversample^2 samples in each."""
    length = density.shape[-1]
    axes = []
    for count in shape:
        centre = (torch.arange(count, dtype=DOUBLE) - count // 2)[:, None]
        within = (torch.arange(oversample, dtype=DOUBLE) + 0.5)[None] / oversample - 0.5
        index = (centre + within).flatten() * pixel_pitch / native_pitch + length // 2
        axes.append(2 * index / (length - 1) - 1)
    grid = torch.stack(torch.meshgrid(axes[1], axes[0], indexing="xy"), dim=-1).to(density.dtype)
    pixels = functional.grid_sample(density[None, None], grid[None], mode="bilinear", align_corners=True)
    return functional.avg_pool2d(pixels, oversample)[0, 0] if oversample > 1 else pixels[0, 0]


def angular_spectrum_psf(
    opd: Tensor,
    *,
    wavelength: float,
    aperture_diameter: float,
    sensor_distance: float,
    grid_pitch: float,
    shape: tuple[int, int],
) -> Tensor:
    """PSF by the textbook angular spectrum on one fine grid: |IFFT[ FFT[U] exp(i k d sqrt(1 - (lambda f)^2)) ]|^2.

    Args:      opd: (N, N) path of source and elements at `grid_pitch`, not the propagation's; its N * grid_pitch must
               cover aperture and window together, or the edges wrap [m].
               grid_pitch: of pupil and sensor alike; <= lambda / (2 sin(edge angle)), or the lens's chirp aliases [m].
    Returns:   (h, w) float64, share of the light per cell of grid_pitch^2, point-sampled.
    """
    samples = opd.shape[-1]
    u = (torch.arange(samples, dtype=DOUBLE) - samples // 2) * grid_pitch
    r2 = u[:, None] ** 2 + u[None, :] ** 2
    mask = (r2 <= (aperture_diameter / 2) ** 2).to(DOUBLE)
    field = torch.polar(mask, 2 * math.pi / wavelength * opd.to(DOUBLE))
    frequency = torch.fft.fftfreq(samples, d=grid_pitch, dtype=DOUBLE)
    cosine = torch.sqrt((1 - wavelength**2 * (frequency[:, None] ** 2 + frequency[None, :] ** 2)).clamp(min=0))
    transfer = torch.polar(torch.ones_like(cosine), 2 * math.pi / wavelength * sensor_distance * cosine)
    sensor = torch.fft.ifft2(torch.fft.fft2(field) * transfer)
    top, left = (samples // 2 - count // 2 for count in shape)
    window = sensor[top : top + shape[0], left : left + shape[1]]
    area = math.pi * aperture_diameter**2 / 4
    return (window.real**2 + window.imag**2) * grid_pitch**2 / area


def per_band_render(
    bands: Tensor, psfs: Tensor, weights: Tensor, *, border: str = "reflect", transfers: Tensor | None = None
) -> Tensor:
    """Convolve every band with its PSF, then sum the bands with the filter's weights: one FFT triple per band.

    Args:      bands: (B, L, H, W). psfs: (L, h, w), index n // 2 the origin, applied as a true convolution: kcam's
               upright picture takes them turned by 180 degrees. weights: (C, L), or (C, L, H, W) of a filter that
               differs from pixel to pixel. border: a mode of torch's pad.
               transfers: `transfer_functions` of the PSFs where these have not changed; None computes them here.
    Returns:   (B, C, H, W), in the bands' dtype; the PSF's linear convolution with the padded picture.
    """
    height, width = bands.shape[-2:]
    h, w = psfs.shape[-2:]
    size = transform_size((height, width), (h, w))
    padding = (w - 1 - w // 2, w // 2, h - 1 - h // 2, h // 2)
    weights = weights if weights.ndim == 4 else weights[:, :, None, None]
    out = bands.new_zeros(bands.shape[0], weights.shape[0], height, width)
    for band in range(bands.shape[1]):
        picture = functional.pad(bands[:, band : band + 1], padding, mode=border)
        transfer = torch.fft.rfft2(psfs[band], s=size) if transfers is None else transfers[band]
        spectrum = torch.fft.rfft2(picture, s=size) * transfer
        blurred = torch.fft.irfft2(spectrum, s=size)[..., h - 1 : h - 1 + height, w - 1 : w - 1 + width]
        out = out + weights[:, band] * blurred
    return out


def transform_size(picture: tuple[int, int], window: tuple[int, int]) -> list[int]:
    """Fast FFT lengths for a picture with the border that the window reaches."""
    return [next_fast_len(n + m - 1, real=True) for n, m in zip(picture, window, strict=True)]


def transfer_functions(psfs: Tensor, *, picture: tuple[int, int]) -> Tensor:
    """rfft2 of PSFs (L, h, w) at the length that `per_band_render` uses, to be kept between pictures."""
    return torch.fft.rfft2(psfs, s=transform_size(picture, tuple(psfs.shape[-2:])))
