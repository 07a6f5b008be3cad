"""How finely a PSF must be sampled: rules that are evaluated before anything is computed, and pixel integration."""

from __future__ import annotations

import math

import numpy as np
import scipy
import torch
from torch import Tensor

from kcam.optics.pupil.coordinates import EDGE_MARGIN

KAPPA = 2.7  # pupil samples per cycle of the fastest fringe that reaches the window
WINDOW_MARGIN = 8  # pixels evaluated beyond the window, so that the pixel's sinc filter finds its light there
_NYQUIST_SHARE = 0.95  # of the intensity's Nyquist pitch lambda d / 4a that the evaluation grid may use
_CONTINUED = 64  # points over which the outermost value continues
_SEEN = 1e-9  # of a frequency, and of its light
_MOST_FOLDS = 12  # to either side; light of f/1.8 at 550 nm reaches as far on pixels of 12 um
MAX_PUPIL_SAMPLES = 8192
"""Across a pupil grid. A PSF takes up to 40 float64 numbers for each sample: 21 GB at this limit, 86 GB at twice it."""


def pupil_samples(
    *,
    semi_aperture: float,
    sensor_distance: float,
    wavelength: float,
    half_window: float,
    displacement: float,
    kappa: float = KAPPA,
) -> int:
    """Samples across the pupil grid: N = kappa 2a (w + s_max) / (lambda d) and the rim's margin, a multiple of 32.

    Args:
        semi_aperture: a, of the image-side plane [m]; sensor_distance: d [m]; wavelength [m].
        half_window: w, from the origin to the edge of what is evaluated [m].
        displacement: s_max, how far the smooth part of the pupil sends its rays on the sensor [m].
    Returns:   N >= 64.
    Valid when kappa > 1: below, the transform's replicas enter the window and energy is counted twice.
    Source:    the project's numerics note, section 5.1: kappa 2.5 gives a median L1 error of 5e-5 and a worst of
        1.7e-3.
    """
    fringes = 2 * semi_aperture * (half_window + displacement) / (wavelength * sensor_distance)
    return max(64, 32 * math.ceil((kappa * fringes + 2 * EDGE_MARGIN) / 32))


def kappa_of(
    count: int,
    *,
    semi_aperture: float,
    sensor_distance: float,
    wavelength: float,
    half_window: float,
    displacement: float,
) -> float:
    """The kappa that a pupil grid of `count` samples gives: the inverse of `pupil_samples`."""
    fringes = 2 * semi_aperture * (half_window + displacement) / (wavelength * sensor_distance)
    return (count - 2 * EDGE_MARGIN) / fringes


def points_per_pixel(*, pixel_pitch: float, semi_aperture: float, sensor_distance: float, wavelength: float) -> float:
    """Evaluation points per pixel and axis: p / (0.95 lambda d / 4a), the intensity's Nyquist rate, in quarters, >= 1.

    It need not be whole: the pixel's integral of a band-limited intensity is a sum over any grid that is fine enough.
    """
    nyquist = wavelength * sensor_distance / (4 * semi_aperture)
    return max(1.0, math.ceil(4 * pixel_pitch / (_NYQUIST_SHARE * nyquist)) / 4)


def pixel_box(pixels: int, *, per_pixel: float, reach: int, active: float = 1.0) -> Tensor:
    """Integral over each pixel of what is known at a grid of points: row m is the integral of sinc(q x - k) over pixel
    m.

    Exact for an intensity that is band-limited to the grid's Nyquist rate, as |U|^2 is, up to the light beyond `reach`.

    Args:
        pixels: n, pixel i is centred on i - n // 2.
        per_pixel: q points per pixel at k / q, |k| <= reach.
        active: width of the light-sensitive part of a pixel; the integral is divided by it.
    Returns: (n, 2 reach + 1) float64; rows sum to 1 up to the truncation.
    """
    centres = np.arange(pixels) - pixels // 2
    beyond = 0 if float(per_pixel).is_integer() else _CONTINUED
    points = np.arange(-reach - beyond, reach + beyond + 1)
    ends = (np.pi * ((centres[:, None] + side * active / 2) * per_pixel - points) for side in (1, -1))
    upper, lower = (scipy.special.sici(end)[0] for end in ends)
    box = (upper - lower) / (np.pi * per_pixel * active)
    if beyond:  # the tails of a sinc between the points: the outermost value continues, instead of an edge to darkness
        box[:, beyond] += box[:, :beyond].sum(1)
        box[:, -beyond - 1] += box[:, -beyond:].sum(1)
        box = box[:, beyond:-beyond]
    return torch.as_tensor(np.ascontiguousarray(box))


def along_axis(frequencies: Tensor, *, turned: bool = False) -> tuple[Tensor, Tensor]:
    """Where a slice of a transfer function along an axis lies, (along, across) it [cycles per pixel]: from 0.5 on, as
    light along the axis is an alias there, on the edge of the pixels' own frequencies, up to its corner. Turned: along
    a diagonal.
    """
    if turned:
        return frequencies * math.sqrt(0.5), frequencies * math.sqrt(0.5)
    along = frequencies.clamp(max=0.5)
    return along, (frequencies.square() - along.square()).clamp(max=0.25).sqrt()


def of_whole_pixels(found: Tensor, alone: Tensor) -> Tensor:
    """Slices of a transfer function (..., F), from frequency 0 on, of pixels with gaps, scaled to the light that whole
    ones receive: that which no aliases fold onto frequency 0, (..., 1).
    """
    light = found[..., :1].real if found.is_complex() else found[..., :1]
    return found * (alone / light.clamp(min=1e-30))


def folded(
    frequencies: Tensor, cutoff: float, active: float, *, turned: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Light up to a cutoff, 2 a / (lambda d) [cycles per pixel], that pixels of an active width fold into frequencies
    along an axis (F,), see `along_axis`: into which of them, (N,); its own frequency, below 0 on the other side of the
    axis; and what pixels record of it.
    """
    most = min(max(1, math.floor(cutoff + 0.5)), _MOST_FOLDS)
    folds = torch.arange(-most, most + 1).to(frequencies)
    along, across = (part[:, None, None] for part in along_axis(frequencies, turned=turned))
    along, across = (along + folds[:, None]).expand(-1, -1, len(folds)), across + folds
    radius, weights = torch.hypot(along, across), torch.sinc(along * active) * torch.sinc(across * active)
    seen = (radius < cutoff + _SEEN) & (weights.abs() > _SEEN)  # pixels without gaps fold nothing across the axis
    return seen.nonzero()[:, 0], torch.copysign(radius, along)[seen], weights[seen]
