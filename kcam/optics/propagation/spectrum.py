"""A second opinion: the field behind the lens, propagated by its band-limited angular spectrum."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor, nn

from kcam.optics.numerics import fast_length, phasor, squared
from kcam.optics.propagation.estimates import jumps
from kcam.optics.propagation.question import Query, residual_path
from kcam.optics.propagation.row import FFT_SLOWNESS, PRODUCTS, Propagator
from kcam.optics.pupil.coordinates import Pupil
from kcam.optics.pupil.maps import pixel_under
from kcam.optics.pupil.quadrants import unfold
from kcam.optics.pupil.rim import round_weights

_MOST_SAMPLES = 8192  # on each axis, of a field in complex128: 1 GB


def angular_spectrum_psf(query: Query) -> Tensor:
    """PSFs by the band-limited angular spectrum of the field behind the lens, which must sample the converging wave.

    H = exp(i k d (sqrt(1 - lambda^2 f^2) - 1)), zero where the sampled H would alias. The spectrum is summed straight
    onto the evaluation points, so that the grid behind the lens need not fit the pixels.
    Source: Goodman, Introduction to Fourier Optics, angular spectrum; Matsushima and Shimobaba, Opt. Express 17, 19662
        (2009).
    """
    grids = enumerate(spectrum_grids(query))
    return torch.stack([_spectrum_band(query, index, count=n, pitch=pitch) for index, (n, pitch) in grids], dim=1)


def spectrum_grids(query: Query) -> list[tuple[int, float]]:
    """(samples, pitch [m]) behind the lens for each wavelength; `Query.samples` spread over the same width instead.

    Raises: ValueError for samples too few to sample the converging wave at the rim.
    """
    a, d = float(query.semi_aperture.detach()), float(query.sensor_distance.detach())
    grids = []
    for wavelength, spread in zip(query.wavelengths.tolist(), query.displacement.tolist(), strict=True):
        # from the rim light goes to the far edge of the window, and a little further: its cycles per metre in the grid
        reach = max(query.half_window, spread)
        across = a + reach + 10 * wavelength * d / (2 * a)
        steepest = across / math.hypot(across, d) / wavelength
        # beyond the rays the rim diffracts light into tails, which must not wrap around into the window
        tails = 50 * wavelength * d / (2 * a)
        width = 1.25 * (2 * a + 2 * reach + 2 * tails)
        count = fast_length(math.ceil(width * 2.2 * steepest))
        count += count % 2
        pitch = 1 / (2.2 * steepest)
        if query.how.samples is not None:
            count, pitch = query.how.samples + query.how.samples % 2, width / query.how.samples
            if pitch > 1 / (2 * a / math.hypot(a, d) / wavelength):
                raise ValueError(
                    f"{query.how.samples} samples are too coarse for angular_spectrum at {wavelength * 1e9:.4g} nm: "
                    f"the wave converging from the rim would alias. Use samples >= {math.ceil(width * 2 * steepest)}."
                )
        grids.append((count, pitch))
    return grids


def _spectrum_band(query: Query, index: int, *, count: int, pitch: float) -> Tensor:
    wavelength = query.wavelengths[index].to(query.device)
    wavenumber = 2 * math.pi / wavelength
    a, d = query.semi_aperture, query.sensor_distance
    axis = (torch.arange(count, dtype=torch.float64, device=query.device) - count // 2 + 0.5) * pitch
    pupil = query.pupil(axis[None, :] / a, axis[:, None] / a)
    one = replace(query, wavelengths=query.wavelengths[index : index + 1])
    coefficients, maps = residual_path(one, pupil)
    r2 = pupil.rho2 * a**2
    converging = r2 / (d * (1 + torch.sqrt(1 + r2 / d**2)))  # sqrt(d^2 + r^2) - d without cancellation
    phase = wavenumber * (torch.einsum("zt,tvu->zvu", coefficients[0], maps) - converging)

    transmission, power = _point_transmission(query, pupil, pitch=pitch, count=count)
    falloff = 1 / (1 + query.vergences[:, None, None] ** 2 * r2)
    field = phasor(phase) * (transmission * torch.sqrt(falloff))
    for pixels in query.lens.pixel_maps(one.wavelengths.to(query.device)):
        if pixels.factors is not None:
            field = field * phasor(pixels.factors * pixel_under(pixels.values.to(a), pixels.half_width, axis, a))
    energy = (power * falloff).sum((-2, -1)) * pitch**2

    frequency = torch.fft.fftfreq(count, pitch, dtype=torch.float64, device=query.device)
    sine2 = wavelength**2 * (frequency[:, None] ** 2 + frequency**2)
    travel = -wavenumber * d * sine2 / (1 + torch.sqrt(torch.clamp(1 - sine2, min=0)))
    limit = 1 / (wavelength * torch.sqrt((2 * d.detach() / (count * pitch)) ** 2 + 1))
    inside = (frequency.abs() <= limit)[:, None] & (frequency.abs() <= limit) & (sine2 < 1)
    transfer = phasor(travel) * inside

    complex_dtype = query.dtype.to_complex()
    spectrum = torch.fft.fft2(field.to(complex_dtype)) * transfer.to(complex_dtype)
    per_pixel, reach = query.evaluation_grid(float(wavelength))
    points = torch.arange(-reach, reach + 1, dtype=torch.float64, device=query.device) * query.pixel_pitch / per_pixel
    kernel = phasor(2 * math.pi * frequency * (points[:, None] - axis[0])).to(complex_dtype) / count
    intensity = squared(kernel @ spectrum @ kernel.T)
    factor = query.pixel_pitch**2 / energy
    return query.pixels(per_pixel).of_image(intensity) * factor[:, None, None].to(query.dtype)


def _point_transmission(query: Query, pupil: Pupil, *, pitch: float, count: int) -> tuple[Tensor, Tensor]:
    """Amplitude and power that pass on the true pupil plane: edge weights of discs, a look-up in maps."""
    discs, a = query.lens.aperture.discs(), float(query.semi_aperture.detach())
    passed = query.transmission(pupil.x[0] * a)
    if not discs:
        values = passed * ((pupil.x.abs() <= 1) & (pupil.y.abs() <= 1))
        return values, values**2
    half = min(count // 2, math.ceil(a / pitch) + 8)
    quadrant = round_weights(discs, 2 * half, spacing=pitch / a)
    margin = count // 2 - half
    weights = nn.functional.pad(unfold(quadrant).to(query.device), (margin, margin, margin, margin))
    return weights * passed, weights * passed**2


def _error(query: Query) -> float:
    """1e-3 for a smooth pupil; pixels are looked up at the grid's points, which misplaces every jump by up to half one.

    White noise of 6 radians is then off by 0.3, a square rim by 1e-2; rings that scatter beyond its grid by 3e-3.
    """
    rim, rings = 0.0 if query.lens.round else 7e-3, 2e-3 if query.has_rings else 0.0
    return 1e-3 + rim + rings + 0.12 * jumps(query)


def _cost(query: Query) -> float:
    query = query.sampled(samples=None)  # a cost is no refusal
    total = sum(FFT_SLOWNESS * 10 * n**2 * math.log2(n) for n, _ in spectrum_grids(query))
    return query.vergences.numel() * total


def _needs_few_samples(query: Query) -> str | None:
    try:
        count = max((count for count, _ in spectrum_grids(query)), default=0)
    except ValueError as error:  # samples that the user gave
        return str(error)
    if count <= _MOST_SAMPLES:
        return None
    return (
        f"needs a grid of {count} to sample the wave that converges from the aperture, more than {_MOST_SAMPLES}; use "
        "propagator='nonparaxial', which samples the residual only."
    )


ANGULAR_SPECTRUM = Propagator(
    "angular_spectrum",
    "fft",
    function=angular_spectrum_psf,
    error=_error,
    cost=_cost,
    rate=PRODUCTS,
    valid=_needs_few_samples,
    about="band-limited, from the plane behind the lens; an error above a grid of 8192",
)
