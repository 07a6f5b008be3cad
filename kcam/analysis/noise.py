"""Noise power over frequency."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class NoisePower:
    """Noise power over frequency: `power` (H,W) over `fy` (H,), `fx` (W,), and `radial` over `frequencies`.

    Frequencies are cycles/pixel, or cycles/m where a pixel pitch was given; the integral of `power` over both is the
    variance, also where single directions are not alike.

    Example:
    >>> power = kcam.analysis.noise_power_spectrum(torch.randn(4, 32, 32).double())
    >>> power.power.shape
    torch.Size([32, 32])
    """

    fy: Tensor
    fx: Tensor
    power: Tensor
    frequencies: Tensor
    radial: Tensor

    @property
    def variance(self) -> float:
        """The integral of the power (Parseval)."""
        return float(self.power.sum() * (self.fy[1] - self.fy[0]).abs() * (self.fx[1] - self.fx[0]).abs())


def noise_power_spectrum(pictures: Tensor, *, pixel_pitch: float | None = None) -> NoisePower:
    """The noise power spectrum of pictures of an even scene.

    NPS(f) = p^2 / (H W) < |DFT(x - mean x)|^2 >,   variance = INT NPS df

    Args:      pictures: (H,W), or (N,H,W) over which is averaged, (N,1,H,W) too; of linear values, 8 x 8 at least.
               pixel_pitch: p [m]; None: in pixels.
    Returns:   a `NoisePower`; its radial mean is over rings of 1/min(H,W), up to the pixels' limit, without f = 0.
    Raises:    TypeError for no tensor; ValueError for values that are not finite, other shapes, a pitch not above 0.
    Valid when the scene is even: shading of the pictures counts as noise of the lowest frequencies.
    Source:    IEC 62220-1-1:2015, 6.3.2; ISO 15739:2017.

    Example:
    >>> noise = torch.randn(8, 64, 64, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    >>> power = kcam.analysis.noise_power_spectrum(noise)
    >>> variance = float(noise.var((1, 2), correction=0).mean())
    >>> abs(power.variance / variance - 1) < 1e-12, round(float(power.radial.mean()))
    (True, 1)
    """
    if not isinstance(pictures, Tensor):
        raise TypeError(f"pictures must be a tensor (N,H,W), got {type(pictures).__name__}.")
    shape = tuple(pictures.shape)
    values = pictures[:, 0] if pictures.ndim == 4 and shape[1] == 1 else pictures[None] if len(shape) == 2 else pictures
    if values.ndim != 3 or len(values) == 0 or min(values.shape[1:]) < 8:
        raise ValueError(f"pictures have shape {shape}, expected (N,H,W) of one plane, 8 x 8 pixels or more.")
    if pixel_pitch is not None and not 0 < pixel_pitch < 1:
        raise ValueError(f"pixel_pitch must be a length in metres above 0, got {pixel_pitch}. Use e.g. 4e-6.")
    values = values.detach().double().cpu()
    if not bool(values.isfinite().all()):
        raise ValueError(f"{int((~values.isfinite()).sum())} values of the pictures are not finite. Cut them out.")
    pitch, (height, width) = pixel_pitch or 1.0, values.shape[1:]
    centred = values - values.mean((1, 2), keepdim=True)
    power = torch.fft.fft2(centred).abs().square().mean(0) * pitch**2 / (height * width)
    fy, fx = (torch.fft.fftfreq(n, d=pitch, dtype=torch.float64) for n in (height, width))
    radius = torch.hypot(fy[:, None], fx) * pitch
    count = min(height, width)
    ring = torch.round(radius * count).long()
    used = (ring >= 1) & (ring <= count // 2)
    weights = torch.bincount(ring[used], minlength=count // 2 + 1)[1:].double()
    radial = torch.bincount(ring[used], weights=power[used], minlength=count // 2 + 1)[1:] / weights
    frequencies = torch.bincount(ring[used], weights=radius[used], minlength=count // 2 + 1)[1:] / weights / pitch
    return NoisePower(fy, fx, power, frequencies, radial)
