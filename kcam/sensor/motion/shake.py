"""The path of a camera in hands that tremble."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcam.sensor.arguments import check_not_negative
from kcam.sensor.motion.resampling import LONGEST
from kcam.units import check_positive


def tremor(
    time: float, *, amplitude: float = 1.0, seed: int = 0, count: int = 65, peak: float = 9.0, share: float = 0.3
) -> Tensor:
    """The path of a camera in hands that tremble: a random walk, and a physiological tremor about 9 Hz.

    u(t) = amplitude [ sqrt(1 - share^2) W(t) + share sum_k a_k (sin(2 pi f_k t + phi_k) - sin phi_k) ]

    with a Brownian motion W of unit variance after a second in each direction, and eight tremors a_k = 1 / sqrt(8) with
    f_k from 0.8 to 1.2 times the peak.

    Args:      time: exposure, with the readout of a rolling shutter [s].
               amplitude: RMS distance in x, and in y, after a second [pixels]: angle times focal length / pixel pitch.
               seed: names the path.  count: of its points.  peak [Hz].  share: of the tremor, 0..1.
    Returns:   (count, 2) float64 [pixels], from (0, 0) on: a `path` for `Motion`.
    Raises:    ValueError for a time, a peak or an amplitude out of range, or fewer than two points.
    Source:    Gavant et al., A physiological camera shake model for image stabilization systems, IEEE Sensors (2011):
               drift and a tremor of 8 to 12 Hz; Xiao et al., Camera-motion and effective spatial resolution, ICIS
               (2006): hand-held cameras drift like a random walk.

    Example:
    >>> ends = torch.stack([sensor.tremor(1.0, amplitude=3.0, seed=seed)[-1] for seed in range(400)])
    >>> [round(float(value)) for value in ends.square().mean(0).sqrt()]  # pixels, in x and y
    [3, 3]
    """
    check_positive(time, name="time", unit="s")
    check_positive(peak, name="peak", unit="Hz")
    check_not_negative(amplitude, name="amplitude", unit="pixels", most=LONGEST)
    check_not_negative(share, name="share", unit="(of the tremor)", most=1.0)
    if count < 2:
        raise ValueError(f"a path has two points or more, got count={count}.")
    generator = torch.Generator().manual_seed(seed)
    steps = torch.randn(count - 1, 2, generator=generator, dtype=torch.float64) * math.sqrt(time / (count - 1))
    walk = torch.cat([torch.zeros(1, 2, dtype=torch.float64), steps.cumsum(0)])
    rates = 2 * math.pi * peak * (0.8 + 0.4 * torch.rand(8, generator=generator, dtype=torch.float64))
    phases = 2 * math.pi * torch.rand(8, 2, generator=generator, dtype=torch.float64)
    moments = torch.linspace(0, time, count, dtype=torch.float64)[:, None, None]
    waves = torch.sin(rates[:, None] * moments + phases) - torch.sin(phases)
    return amplitude * (math.sqrt(1 - share**2) * walk + share * waves.sum(1) / math.sqrt(8))
