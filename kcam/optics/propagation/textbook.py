"""What one writes down first: every phase sampled by itself, in float64, and one padded FFT. For comparison only.

These are the computations that kcam is measured against, for any lens of kcam's: `kcam.tradeoff` puts them beside its
own rows. They are not made slow on purpose, and not in `PROPAGATORS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import scipy
import torch
from torch import Tensor
from torch.nn import functional as F

from kcam.optics.numerics import phasor, squared
from kcam.optics.propagation.question import Query
from kcam.optics.propagation.row import Propagator
from kcam.optics.pupil.maps import pixel_under

_LONGEST = 8192  # on each axis, of an FFT in complex128: 1 GB a field


def textbook_psf(query: Query, *, samples: int, points: int = 1) -> Tensor:
    """PSFs by equations (3.2) to (3.5): source, lens and propagation chirps, a padded FFT, |U|^2 interpolated.

    The aperture is a staircase; each FFT is as long as puts its bins nearest to the pixels; the rest is bilinear.

    Args:      samples: across the pupil.
               points: per pixel and axis that are averaged; 1 is the pixel's centre.
    Returns:   (Z, L, H, W) in the query's dtype, computed in float64.
    Raises:    ValueError for an FFT longer than 8192.
    """
    a, d = query.semi_aperture, query.sensor_distance
    axis = (torch.arange(samples, dtype=torch.float64, device=query.device) - (samples - 1) / 2) * 2 * a / samples
    step = float(2 * a / samples)
    bank = []
    for index, wavelength in enumerate(query.wavelengths.tolist()):
        fields, energy = _behind_the_lens(query, index, axis)
        r2 = axis[:, None] ** 2 + axis**2
        fields = fields * phasor(2 * math.pi / wavelength * r2 / (2 * d))  # the chirp inside the integral of (3.4)
        per_pixel = wavelength * float(d) / step / (query.pixel_pitch / points)
        length = scipy.fft.next_fast_len(math.ceil(math.ceil(samples / per_pixel) * per_pixel), real=False)
        _check_length(length)
        density = torch.stack([squared(torch.fft.fft2(field, s=(length, length))) for field in fields])
        density = torch.fft.fftshift(density, dim=(-2, -1)) * step**4 / (wavelength * d) ** 2
        density = _interpolated(density, bins_per_point=length / per_pixel, shape=query.shape, points=points)
        bank.append(density * query.pixel_pitch**2 / energy)
    return torch.stack(bank, dim=1).to(query.dtype)


def textbook_angular_spectrum(query: Query, *, points: int = 1) -> Tensor:
    """PSFs by the angular spectrum on one grid: |IFFT[ FFT[U] exp(i k d sqrt(1 - (lambda f)^2)) ]|^2.

    From lens to sensor it is `points` times as fine as the pixels, and must sample the lens's own chirp:
    what it does not, aliases.

    Args, Returns, Raises: as `textbook_psf`.
    """
    a, d = float(query.semi_aperture.detach()), float(query.sensor_distance.detach())
    pitch = query.pixel_pitch / points
    count = scipy.fft.next_fast_len(math.ceil(1.1 * 2 * (a + query.half_window) / pitch), real=False)
    while (count - points) % 2:  # a pixel's centre is the middle one of its points, or between them
        count = scipy.fft.next_fast_len(count + 1, real=False)
    _check_length(count)
    axis = (torch.arange(count, dtype=torch.float64, device=query.device) - (count - 1) / 2) * pitch
    frequency = torch.fft.fftfreq(count, pitch, dtype=torch.float64, device=query.device)
    height, width = query.shape
    rows, columns = (_middle(count, (n + 1 - n % 2) * points) for n in query.shape)  # odd: symmetric about the origin
    bank = []
    for index, wavelength in enumerate(query.wavelengths.tolist()):
        fields, energy = _behind_the_lens(query, index, axis)
        cosine = torch.sqrt((1 - wavelength**2 * (frequency[:, None] ** 2 + frequency**2)).clamp(min=0))
        transfer = phasor(2 * math.pi / wavelength * d * cosine)
        density = torch.stack([squared(torch.fft.ifft2(torch.fft.fft2(f) * transfer)[rows, columns]) for f in fields])
        pixels = F.avg_pool2d(density[:, None], points)[:, 0, :height, :width]
        bank.append(pixels * query.pixel_pitch**2 / energy)
    return torch.stack(bank, dim=1).to(query.dtype)


def textbook_row(samples: int, *, points: int = 1) -> Propagator:
    """`textbook_psf` as a propagator, for `Imaging(propagator=...)`."""
    return _row("fft", lambda query: textbook_psf(query, samples=samples, points=points), paraxial=True)


def textbook_angular_spectrum_row(*, points: int = 1) -> Propagator:
    """`textbook_angular_spectrum` as a propagator."""
    return _row("angular_spectrum", lambda query: textbook_angular_spectrum(query, points=points), paraxial=False)


def _row(method: str, function: Callable[[Query], Tensor], *, paraxial: bool) -> Propagator:
    return Propagator(
        "textbook",
        method,
        function=function,
        error=lambda query: math.inf,  # it has none: that is what kcam adds
        cost=lambda query: math.inf,
        paraxial=paraxial,
        exact=False,
    )


def _behind_the_lens(query: Query, index: int, axis: Tensor) -> tuple[Tensor, Tensor]:
    """The field of each distance behind the lens on a square grid, (Z, N, N), and the energy that passes, (Z,)."""
    a, wavelength = query.semi_aperture, query.wavelengths[index : index + 1].to(query.device)
    pupil = query.pupil(axis[None, :] / a, axis[:, None] / a)
    r2 = axis[:, None] ** 2 + axis**2
    path = torch.zeros_like(r2)
    discs, passed = query.lens.aperture.discs(), query.transmission(axis)
    inside = ((axis.abs() <= a)[:, None] & (axis.abs() <= a)).to(r2)
    if discs:
        inside = torch.stack([w * (r2 <= (r * a) ** 2) for r, w in discs]).sum(0).to(r2)
    transmission = inside * passed
    if discs and not passed.ndim:
        area = sum(w * r**2 for r, w in discs) * math.pi * a**2
    else:
        area = transmission.square().sum() * (axis[1] - axis[0]) ** 2
    phase = torch.zeros_like(r2)
    for element in query.lens.elements:
        path = path + element.vergence(wavelength) * r2 / 2
        for coefficient, term in element.terms(pupil, wavelength):
            path = path + coefficient * term
        pixels = element.pixel_map(wavelength)
        if pixels is not None and pixels.factors is not None:
            phase = phase + pixels.factors * pixel_under(pixels.values.to(r2), pixels.half_width, axis, a)
    fields = []
    for vergence in query.vergences:
        source = vergence * r2 / 2
        source = source if query.paraxial else source + pupil.beyond_paraxial(vergence)
        fields.append(phasor(2 * math.pi / wavelength * (source + path) + phase) * transmission)
    # nothing is added up where it is dark: beyond the aperture a lens's surface may end
    fields = [torch.where(transmission == 0, torch.zeros_like(field), field) for field in fields]
    return torch.stack(fields), area


def _check_length(length: int) -> None:
    if length > _LONGEST:
        raise ValueError(
            f"the textbook needs an FFT of {length} x {length} here, more than {_LONGEST}. Use fewer samples or "
            "points, or propagator='nonparaxial', which needs none."
        )


def _middle(count: int, width: int) -> slice:
    return slice((count - width) // 2, (count - width) // 2 + width)


def _interpolated(density: Tensor, *, bins_per_point: float, shape: tuple[int, int], points: int) -> Tensor:
    """Bilinear values of (Z, n, n) at `points` x `points` places in each pixel, averaged, (Z, H, W)."""
    length = density.shape[-1]
    axes = []
    for count in shape:
        places = (torch.arange(count, dtype=torch.float64) - count // 2)[:, None] * points
        within = torch.arange(points, dtype=torch.float64) - (points - 1) / 2
        axes.append(2 * ((places + within).flatten() * bins_per_point + length // 2) / (length - 1) - 1)
    grid = torch.stack(torch.meshgrid(axes[1], axes[0], indexing="xy"), dim=-1).to(density.device)
    fine = F.grid_sample(density[:, None], grid.expand(len(density), -1, -1, -1), mode="bilinear", align_corners=True)
    return F.avg_pool2d(fine, points)[:, 0]
