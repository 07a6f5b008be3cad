"""What rays and pupils of a real lens mean for a picture: spots, their best focus, and the modulation that is left."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from kcam.inputs import as_values
from kcam.optics.compound.images import Frame
from kcam.optics.compound.pupil import OVERFILL, PupilFit
from kcam.optics.compound.tracing import Rays
from kcam.optics.numerics import fast_length, phasor, squared
from kcam.optics.propagation import sampling
from kcam.optics.pupil.rim import opening

SPECTRAL_LINES = (486.1e-9, 546.1e-9, 656.3e-9)
"""F, e and C [m]: the colours in which a lens is looked at unless others are named."""
CRITERIA = ("rms",)
"""What `CompoundLens.refocus` can make least."""
STEP = 1e-5  # of the stop's radius: between the rays whose directions tell how much light one stands for
_RIM = 7  # samples of a grid beyond the pupil's edge, where the edge's low-pass ends
_COARSE = 65  # samples across a pupil that tell how finely it must be sampled
_FEWEST, _FEWEST_OF_MAP = 96, 384  # samples across a pupil for a curve, and for a map, which has no weights at the edge
_PER_FRINGE = 4  # samples across the fastest fringe between two copies of a pupil


@dataclass(frozen=True)
class FieldCurves:
    """What a lens does over its field, at F heights.

    heights: Y / D of object points (F,). image_heights: of chief rays of the focus wavelength, from the axis (F,) [m].
    Printed, a table: light is the relative illumination, the difference of two wavelengths is lateral colour, and MTFs
    are sagittal and tangential.
    relative_illumination, distortion (F,). lateral_colour: how much farther from the axis than the focus wavelength
    each wavelength lands (F, L) [m]. rms_spot: of all light about its centroid (F,) [m]. mtf: of all wavelengths
    together, sagittal and tangential at each frequency (F, 2, K). wavelengths (L,) [m], frequencies (K,) [cycles per
    metre].
    """

    heights: Tensor
    image_heights: Tensor
    relative_illumination: Tensor
    distortion: Tensor
    lateral_colour: Tensor
    rms_spot: Tensor
    mtf: Tensor
    wavelengths: Tensor
    frequencies: Tensor

    def __str__(self) -> str:
        lines = [f"{value * 1e9:.0f}" for value in self.wavelengths.tolist()]
        columns = {
            "Y / D": [f"{value:.3f}" for value in self.heights.tolist()],
            "image [mm]": [f"{value * 1e3:.2f}" for value in self.image_heights.tolist()],
            "light [%]": [f"{100 * value:.1f}" for value in self.relative_illumination.tolist()],
            "distortion [%]": [f"{100 * value:.2f}" for value in self.distortion.tolist()],
            f"{lines[-1]} - {lines[0]} nm [um]": [
                f"{value * 1e6:.2f}" for value in (self.lateral_colour[:, -1] - self.lateral_colour[:, 0]).tolist()
            ],
            "rms spot [um]": [f"{value * 1e6:.1f}" for value in self.rms_spot.tolist()],
        }
        for index, frequency in enumerate(self.frequencies.tolist()):
            columns[f"MTF at {frequency / 1e3:.3g} / mm"] = [
                f"{sagittal:.2f} {tangential:.2f}" for sagittal, tangential in self.mtf[:, :, index].tolist()
            ]
        widths = [max(len(name), *map(len, values)) for name, values in columns.items()]
        rows = [list(columns), *map(list, zip(*columns.values(), strict=True))]
        text = ("  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)) for row in rows)
        return "\n".join(text)


def hexapolar(rings: int) -> tuple[Tensor, Tensor, Tensor]:
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


def upwards(heights: Tensor | list[float]) -> Tensor:
    """Object points (F, 2) on the y axis at heights Y / D (F,)."""
    up = as_values(heights, name="heights", unit="Y / D").to(torch.float64).reshape(-1)
    return torch.stack([torch.zeros_like(up), up], dim=1)


def evenly(passes: Tensor, count: int) -> Tensor:
    """Which of R rays to draw, (F, count): so many of those that pass (F, R), from the first to the last.

    Raises: ValueError for a row in which none passes.
    """
    if not bool(passes.any(1).all()):
        raise ValueError("no ray of a point passes this lens in the plane of the axis. Use smaller heights.")
    chosen = [torch.nonzero(row)[:, 0] for row in passes]
    return torch.stack([open_[torch.linspace(0, len(open_) - 1, count).round().long()] for open_ in chosen])


def first(rays: Rays) -> Rays:
    """The first of stacked bundles."""
    clearance = tuple(part[0] for part in rays.clearance)
    return Rays(rays.x[0], rays.y[0], rays.dx[0], rays.dy[0], rays.path[0], rays.alive[0], clearance)


def light(rays: Rays, area: Tensor) -> Tensor:
    """Area in image-side direction cosines that each ray stands for, (..., R): 0 where it does not pass.

    A ray whose cell an edge cuts counts with the open part of the cell: counted by whole rays, the light of a vignetted
    pupil would be off by percents.

    Args: rays: (3, ..., R), of each point of the stop, and of those `STEP` of its radius beside it in x and in y. area:
        of its cell in the stop, relative to the stop's radius squared (R,).
    """
    dx, dy = rays.dx[1:] - rays.dx[0], rays.dy[1:] - rays.dy[0]
    found = (dx[0] * dy[1] - dx[1] * dy[0]).abs() / STEP**2 * area
    for q in rays.clearance:
        slope = ((q[1:] - q[0]) / STEP).square().sum(0).clamp(min=1e-18).sqrt()
        found = found * (0.5 + q[0] / (slope * area.sqrt())).clamp(0, 1)
    return torch.where(rays.alive.all(0), found, 0.0)


def rms_radius(points: Tensor, weights: Tensor) -> Tensor:
    """Root of the mean squared distance from the centroid, (...), of points (..., R, 2) by weights (..., R) [m]."""
    share = (weights / weights.sum(-1, keepdim=True))[..., None]
    away = points - (share * points).sum(-2, keepdim=True)
    return (share * away.square()).sum((-2, -1)).sqrt()


def sharpest(points: Tensor, slopes: Tensor, weights: Tensor) -> float:
    """How much farther the sensor must stand for the least sum of the squared rms radii of F spots [m].

    The spot of a ray at distance s farther is p + s u, so that the variance of each is a quadratic in s: its least is
    at s = -sum cov(p, u) / sum var(u).

    Args: points (F, R, 2) [m], slopes (F, R, 2): dx / dz and dy / dz; weights (F, R), whose sum in each row is what
        that spot counts.
    """
    share = (weights / weights.sum(-1, keepdim=True))[..., None]
    p, u = (part - (share * part).sum(1, keepdim=True) for part in (points, slopes))
    return -float((weights[..., None] * p * u).sum() / (weights[..., None] * u.square()).sum())


# ---- modulation ----------------------------------------------------------------------------------------------------


def _open_part(fitted: PupilFit, node: int) -> tuple[float, float]:
    """Half the width of the square around what is open, and dy of its middle."""
    frame = Frame.upright(fitted.one(node))
    return float(frame.half), float(frame.middle[0, 1])


def _slopes(fitted: PupilFit, node: int) -> tuple[float, float]:
    """Largest distance of a ray from the chief ray [m], and the largest change of it with direction [m]."""
    half, middle = _open_part(fitted, node)
    side = torch.linspace(-half, half, _COARSE, dtype=torch.float64)
    with torch.no_grad():
        path, q = fitted.at(node, side[None, :], middle + side[:, None])
        first = torch.gradient(path, spacing=float(side[1] - side[0]))
        second = [part for one in first for part in torch.gradient(one, spacing=float(side[1] - side[0]))]
        inside = (q > 0).all(0)
        return tuple(  # type: ignore[return-value]
            float(torch.where(inside, torch.stack(tuple(parts)).square().sum(0).sqrt(), 0.0).max())
            for parts in (first, second)
        )


def _check_count(count: int, spread: float) -> None:
    """ValueError for more samples across a pupil than fit."""
    if count > sampling.MAX_PUPIL_SAMPLES:
        raise ValueError(
            f"this MTF needs {count} pupil samples (blur {spread * 1e3:.3g} mm), more than "
            f"{sampling.MAX_PUPIL_SAMPLES}. Use lower frequencies, a smaller field or a distance nearer to the focus."
        )


def transfer(fitted: PupilFit, node: int, frequencies: Tensor, *, wavelength: float) -> Tensor:
    """OTF of one node, complex (2, K), about its own chief ray: sagittal, and tangential.

    OTF(f) = integral of P(p + lambda f / 2) P*(p - lambda f / 2) dp / integral of |P|^2,   P = exp(2 pi i W / lambda)

    over direction cosines, where both copies of the pupil are open: edges get quadrature weights, as for a PSF.

    Args: frequencies: (K,) [cycles per metre]. wavelength: [m].
    Raises: ValueError for a blur that takes too many samples.
    """
    spread, bend = _slopes(fitted, node)
    reach, middle = _open_part(fitted, node)

    def overlap(frequency: float, axis: int) -> Tensor:
        shift = wavelength * frequency / 2
        fringes = 2 * reach * min(frequency * bend, 2 * spread / wavelength)
        count = max(_FEWEST, 32 * math.ceil(_PER_FRINGE * fringes / 32))
        _check_count(count, spread)
        spacing = 2 * reach / (count - 2 * _RIM)
        counts, to = [count, count], [0.0, 0.0]
        counts[axis], to[axis] = math.ceil(count - 2 * shift / spacing), shift
        if counts[axis] <= 2 * _RIM:  # the copies lie beside each other
            return fitted.wavefront.new_zeros((), dtype=torch.complex128)
        x, y = (_centred(n, spacing) for n in counts)
        (ahead, q), (behind, other) = (
            fitted.at(node, (x + sign * to[0])[None, :], (middle + y + sign * to[1])[:, None]) for sign in (1, -1)
        )
        weights = opening(torch.minimum(q, other)[None])[0]
        return (weights * phasor(2 * math.pi / wavelength * (ahead - behind))).sum() * spacing**2

    whole = overlap(0.0, 0).real
    return (
        torch.stack([torch.stack([overlap(frequency, axis) for frequency in frequencies.tolist()]) for axis in (0, 1)])
        / whole
    )


def _centred(count: int, spacing: float) -> Tensor:
    """So many points about 0, (count,)."""
    return (torch.arange(count, dtype=torch.float64) + 0.5 - count / 2) * spacing


def modulation_map(
    fitted: PupilFit,
    node: int,
    *,
    direction: Tensor,
    wavelength: float,
    pixel_pitch: float,
    shape: tuple[int, int],
) -> Tensor:
    """|OTF| / OTF(0) of one node at frequencies k / (n pixel_pitch) on the sensor's axes, (H, W), 0 at index n // 2.

    The autocorrelation of its pupil, by FFT, on a grid whose spacing divides lambda / (n pixel_pitch).

    Args: direction: in which the point's image lies on the sensor (2,).
    Raises: ValueError for a blur that takes too many samples.
    """
    spread, _ = _slopes(fitted, node)
    reach, at_middle = _open_part(fitted, node)
    window = max(shape) * pixel_pitch / 2
    fringes = 2 * reach * (spread + window) / wavelength
    count = max(_FEWEST_OF_MAP, 32 * math.ceil(sampling.KAPPA * fringes / 32))
    _check_count(count, spread)
    widest = 2 * reach / (count - 2 * _RIM)
    every = [math.ceil(wavelength / (n * pixel_pitch) / widest) for n in shape]  # samples for one step in frequency
    spacing = [wavelength / (n * pixel_pitch * steps) for n, steps in zip(shape, every, strict=True)]
    counts = [math.ceil(2 * reach / step) + 2 * _RIM for step in spacing]
    middle = at_middle * direction.flip(0)
    y, x = (at + _centred(n, step) for at, n, step in zip(middle.tolist(), counts, spacing, strict=True))
    across = x[None, :] * direction[1] - y[:, None] * direction[0]
    along = x[None, :] * direction[0] + y[:, None] * direction[1]
    path, q = fitted.at(node, across, along)
    field = phasor(2 * math.pi / wavelength * path) * opening(q[None])[0]
    shifts = [(torch.arange(n) - n // 2) * steps for n, steps in zip(shape, every, strict=True)]
    lengths = [fast_length(n + min(n, int(-part[0]))) for n, part in zip(counts, shifts, strict=True)]
    otf = torch.fft.ifft2(squared(torch.fft.fft2(field, s=lengths)))
    rows, columns = (part % length for part, length in zip(shifts, lengths, strict=True))
    # a floor far below the transform's own rounding: no NaN gradient at the zeros of an MTF
    modulation = torch.sqrt(squared(otf[rows[:, None], columns[None, :]]) + torch.finfo(torch.float64).tiny)
    overlap = [part.abs() < n for part, n in zip(shifts, counts, strict=True)]  # beyond, the shift wraps around
    return torch.where(overlap[0][:, None] & overlap[1][None, :], modulation / otf[0, 0].real, 0.0)
