"""Noise reduction by the noise that the camera knows: a bilateral filter on the demosaiced signal."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from kcam.context import Context, Stage
from kcam.inputs import check_signal
from kcam.isp.colour import as_shot_gains
from kcam.sensor.arguments import check_full_well, check_not_negative, hold, in_float32, like
from kcam.units import check_positive

STRIP = 2**16
"""Pixels that are filtered at once: what bounds the memory, and stays in the processor's cache."""


def _strip(signal: Tensor, guide: Tensor, radius: int, luma: Tensor | float, chroma: Tensor | float) -> Tensor:
    """The filter on a strip that is padded by the radius on all sides."""
    height, width = signal.shape[-2] - 2 * radius, signal.shape[-1] - 2 * radius
    centre = guide[..., radius : radius + height, radius : radius + width]
    gray = signal.mean(1, keepdim=True)
    colour = signal - gray
    sums: list[Tensor | float] = [0.0, 0.0, 0.0, 0.0]
    for row in range(2 * radius + 1):
        for column in range(2 * radius + 1):
            part = (..., slice(row, row + height), slice(column, column + width))
            near = ((row - radius) ** 2 + (column - radius) ** 2) / (radius + 1) ** 2
            distance = (guide[part] - centre).square().mean(1, keepdim=True)
            fine = torch.exp(-distance / (2 * luma**2) - near)
            coarse = torch.exp(-distance / (2 * chroma**2) - near)
            for index, term in enumerate((fine, fine * gray[part], coarse, coarse * colour[part])):
                sums[index] = sums[index] + term
    return sums[1] / sums[0] + sums[3] / sums[2]  # type: ignore[return-value, operator]


@in_float32
def denoise(
    signal: Tensor,
    *,
    full_well: Tensor | float = 10_000.0,
    read_noise: Tensor | float = 0.0,
    gain: Tensor | float = 1.0,
    gains: Tensor | None = None,
    luma: Tensor | float = 1.0,
    chroma: Tensor | float = 1.5,
    radius: int = 2,
) -> Tensor:
    """Average each pixel with those around it that differ by no more than the noise; colour more widely than gray.

    t_c = (2 / S) sqrt(S x_c + 3 S^2 / 8 + O),   S = gain / N,   O = (S sigma_d)^2
    w(p,q) = exp(-|t(p) - t(q)|^2 / (2 C k^2) - |p - q|^2 / (radius + 1)^2)

    t has noise of deviation 1 at every brightness. The mean of the balanced channels (gray) is averaged with k = luma,
    what each channel has beside it (colour) with k = chroma; averaged are the linear values.

    Args:      signal: (B,C,H,W), demosaiced, black at 0, full scale 1.  full_well: N [electrons].
               read_noise: sigma_d [electrons].  gain: analogue gain, 1 at base ISO.
               gains: (C,) of the white balance, undone again in the result; None for ones.
               luma, chroma: k, in deviations of the noise, > 0.  radius: of the window [pixels].
    Returns:   same shape; differentiable. The picture goes through in strips.
    Valid when: the noise is that of independent pixels. The demosaic makes neighbours' noise alike, which leaves more
               of it in the picture than the weights suppose. The steps of the ADC are not counted.
    Source:    Tomasi and Manduchi, ICCV 1998 (bilateral filter); Starck, Murtagh and Bijaoui, "Image Processing and
               Data Analysis" (1998), generalised Anscombe transform.

    Example:
    >>> noisy = 0.2 + 0.01 * torch.randn(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    >>> quiet = isp.denoise(noisy, full_well=2000.0)  # shot noise of 400 electrons: 20 / 2000
    >>> bool(quiet.std() < 0.6 * noisy.std())
    True
    """
    check_signal(signal)
    if signal.ndim != 4:
        raise ValueError(f"expected a picture (B, C, H, W), got shape {tuple(signal.shape)}. Use signal[None].")
    if signal.numel() == 0:
        return signal
    full_well, read_noise, gain, luma, chroma = (
        like(value, signal) for value in (full_well, read_noise, gain, luma, chroma)
    )
    slope = gain / full_well
    offset = (slope * read_noise) ** 2 + 0.375 * slope**2
    guide = (2 / slope) * (slope * signal.clamp(min=0) + offset).sqrt()
    balance = torch.ones_like(signal[0, :, :1, :1]) if gains is None else gains.to(signal)[:, None, None]
    wide = [F.pad(values, [radius] * 4, mode="replicate") for values in (signal * balance, guide)]
    rows = max(STRIP // (signal.shape[0] * signal.shape[-1]), 1)
    strips = []
    for top in range(0, signal.shape[-2], rows):
        part, guide_part = (values[..., top : top + rows + 2 * radius, :] for values in wide)
        if torch.is_grad_enabled() and wide[0].requires_grad:
            strips.append(checkpoint(_strip, part, guide_part, radius, luma, chroma, use_reentrant=False))
        else:
            strips.append(_strip(part, guide_part, radius, luma, chroma))
    return torch.cat(strips, -2) / balance


class Denoise(Stage):
    """Noise reduction between Demosaic and WhiteBalance: `denoise`, by the camera's own noise.

    Args:      luma, chroma: how far, in deviations of the noise; > 0, an nn.Parameter trains.
               radius: of the window, 1..16 [pixels].
               full_well, read_noise [electrons], gain: None for those of the context.
    Raises:    TypeError, ValueError for a value out of range.

    Example:
    >>> noisy = 0.2 + 0.01 * torch.randn(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    >>> quiet = isp.Denoise(full_well=2000.0)(noisy)  # shot noise of 400 electrons
    >>> bool(quiet.std() < 0.6 * noisy.std())
    True
    """

    luma: Tensor | float
    chroma: Tensor | float
    full_well: Tensor | float | None
    read_noise: Tensor | float | None
    gain: Tensor | float | None

    def __init__(
        self,
        luma: Tensor | float = 1.0,
        chroma: Tensor | float = 1.5,
        *,
        radius: int = 2,
        full_well: Tensor | float | None = None,
        read_noise: Tensor | float | None = None,
        gain: Tensor | float | None = None,
    ):
        super().__init__()
        check_positive(luma, name="luma", unit="deviations of the noise")
        check_positive(chroma, name="chroma", unit="deviations of the noise")
        if isinstance(radius, bool) or not isinstance(radius, int):
            raise TypeError(f"radius must be an integer such as 2, got {radius!r}.")
        if not 1 <= radius <= 16:
            raise ValueError(f"radius {radius} is outside 1..16 pixels, such as 2.")
        check_full_well(full_well)
        if read_noise is not None:
            check_not_negative(read_noise, name="read_noise", unit="electrons")
        if gain is not None:
            check_positive(gain, name="gain", unit="(1 at base ISO)")
        hold(self, luma=luma, chroma=chroma, radius=radius, full_well=full_well, read_noise=read_noise, gain=gain)

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,C,H,W) to the same shape: see `denoise`."""
        check_signal(signal)
        known = context or Context()
        names = ("full_well", "read_noise", "gain")
        noise = {name: getattr(known if getattr(self, name) is None else self, name) for name in names}
        gains = as_shot_gains(known, channels=signal.shape[1]) if context is not None and signal.ndim == 4 else None
        return denoise(signal, **noise, gains=gains, luma=self.luma, chroma=self.chroma, radius=self.radius)
