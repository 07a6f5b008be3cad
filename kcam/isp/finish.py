"""What a phone does last: local tone mapping in linear light, then sharpening and JPEG on the coded picture."""

from __future__ import annotations

import math

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn import functional as F

from kcam.context import Context, Stage
from kcam.inputs import check_signal
from kcam.sensor.arguments import check_not_negative, hold, in_float32, like
from kcam.srgb import LUMINANCE
from kcam.ste import clip_ste, round_ste
from kcam.units import check_positive

LUMA = (0.299, 0.587, 0.114)
BLACK = 2.0**-6
"""Of white: darker tones are brightened no further."""
COARSE = 128
"""Pixels along the shorter side in which local tone mapping finds its base."""
TABLE_LUMA = (
    (16, 11, 10, 16, 24, 40, 51, 61),
    (12, 12, 14, 19, 26, 58, 60, 55),
    (14, 13, 16, 24, 40, 57, 69, 56),
    (14, 17, 22, 29, 51, 87, 80, 62),
    (18, 22, 37, 56, 68, 109, 103, 77),
    (24, 35, 55, 64, 81, 104, 113, 92),
    (49, 64, 78, 87, 103, 121, 120, 101),
    (72, 92, 95, 98, 112, 100, 103, 99),
)
TABLE_CHROMA = ((17, 18, 24, 47), (18, 21, 26, 66), (24, 26, 56, 99), (47, 66, 99, 99))
"""Its upper left; all others are 99."""


def _picture(signal: Tensor) -> Tensor:
    check_signal(signal, channels=(1, 3))
    if signal.ndim != 4 or signal.shape[1] not in (1, 3):
        raise ValueError(
            f"expected a picture (B, 3, H, W), or (B, 1, H, W) of gray, got shape {tuple(signal.shape)}. "
            "Put a ColourMatrix before it; one picture is signal[None]."
        )
    return signal


def _gray(signal: Tensor, weights: tuple[float, ...]) -> Tensor:
    if signal.shape[1] == 1:
        return signal
    return (signal * signal.new_tensor(weights)[:, None, None]).sum(1, keepdim=True)


@in_float32
def map_tones_locally(signal: Tensor, *, strength: Tensor | float = 0.25, radius: float = 1 / 8) -> Tensor:
    """Brighten dark regions and keep the contrast within them: a smaller range of the base, the detail as it is.

    b = base(log2((Y + e) / (1 + e))),  y = x min(2^(-strength b), max(1, 1 / max_c x_c)),  e = 2^-6

    The base is a guided filter of the luminance by itself, its coefficients found on a small picture. All channels
    have one factor, which keeps the hue; it takes no value above white that was not.

    Args:      signal: (B,3,H,W) linear sRGB, or one channel.  strength: 0 (nothing) to 1 (no base left).
               radius: of the regions, in shares of the shorter side.
    Returns:   same shape; differentiable.
    Source:    Durand and Dorsey, SIGGRAPH 2002; He and Sun, "Fast Guided Filter", arXiv 1505.00996.

    Example:
    >>> dark = torch.full((1, 3, 8, 8), 0.05)
    >>> round(float(isp.map_tones_locally(dark, strength=0.25).mean()), 4)  # 0.05 (1.0156 / 0.0656)^0.25
    0.0992
    """
    if _picture(signal).numel() == 0:
        return signal
    tone = ((_gray(signal, LUMINANCE).clamp(min=0) + BLACK) / (1 + BLACK)).log2()
    height, width = tone.shape[-2:]
    shrink = max(min(height, width) / COARSE, 1.0)
    size = [max(round(side / shrink), 1) for side in (height, width)]
    small = F.interpolate(tone, size=size, mode="area")
    reach = max(round(radius * min(size)), 1)

    def local(values: Tensor) -> Tensor:
        for axes in ((reach, reach, 0, 0), (0, 0, reach, reach)):
            kernel = (2 * reach + 1, 1) if axes[2] else (1, 2 * reach + 1)
            values = F.avg_pool2d(F.pad(values, axes, mode="replicate"), kernel, stride=1)
        return values

    mean = local(small)
    variance = (local(small.square()) - mean.square()).clamp(min=0)
    slope = variance / (variance + 0.25)  # edges of more than half a stop are the base's
    pair = torch.cat([local(slope), local(mean - slope * mean)], 1)
    slope, level = F.interpolate(pair, size=(height, width), mode="bilinear").split(1, 1)
    factor = torch.exp2(-like(strength, signal) * (slope * tone + level).clamp(max=0))
    peak = signal.amax(1, keepdim=True).clamp(min=BLACK)
    return signal * torch.minimum(factor, (1 / peak).clamp(min=1))


class LocalToneMapping(Stage):
    """Local tone mapping between ColourMatrix and ToneCurve: `map_tones_locally`.

    Args:      strength: 0..1; an nn.Parameter trains.  radius: of the regions, in shares of the shorter side, 0..0.5.
    Raises:    ValueError for a value out of range.

    Example:
    >>> round(float(isp.LocalToneMapping()(torch.full((1, 3, 8, 8), 0.05)).mean()), 4)
    0.0992
    """

    strength: Tensor | float

    def __init__(self, strength: Tensor | float = 0.25, *, radius: float = 1 / 8):
        super().__init__()
        check_not_negative(strength, name="strength", unit="(0 for nothing)", most=1.0)
        check_positive(radius, name="radius", unit="of the shorter side")
        if radius > 0.5:
            raise ValueError(f"radius {radius:g} is more than 0.5 of the shorter side; expected such as 0.125.")
        hold(self, strength=strength, radius=radius)

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,C,H,W) to the same shape."""
        return map_tones_locally(signal, strength=self.strength, radius=self.radius)


@in_float32
def sharpen(
    signal: Tensor, *, amount: Tensor | float = 0.5, radius: float = 1.0, overshoot: Tensor | float = 0.03
) -> Tensor:
    """Unsharp masking of the luma, with limited overshoot.

    z = Y + amount (Y - G Y),  taken as no more than `overshoot` beyond the 3 x 3 neighbours;  y = clip(x + z - Y)

    Args:      signal: (B,3,H,W) coded sRGB in 0..1, or one channel.  amount: >= 0.  radius: sigma of G [pixels].
               overshoot: in shares of white.
    Returns:   same shape, in 0..1; the clip has the gradient of `clip_ste`.

    Example:
    >>> edge = torch.cat([torch.full((1, 1, 9, 8), 0.2), torch.full((1, 1, 9, 8), 0.8)], -1)
    >>> round(float(isp.sharpen(edge, amount=1.0).max()), 3)
    0.83
    """
    if _picture(signal).numel() == 0:
        return signal
    luma = _gray(signal, LUMA)
    reach = math.ceil(3 * radius)
    soft = gaussian_blur2d(F.pad(luma, [reach] * 4, mode="replicate"), 2 * reach + 1, (radius, radius))
    soft = soft[..., reach:-reach, reach:-reach]
    around = F.pad(luma, [1] * 4, mode="replicate")
    beyond = like(overshoot, signal)
    highest, lowest = F.max_pool2d(around, 3, 1) + beyond, -F.max_pool2d(-around, 3, 1) - beyond
    sharp = torch.maximum(torch.minimum(luma + like(amount, signal) * (luma - soft), highest), lowest)
    return clip_ste(signal + sharp - luma, 0.0, 1.0)


class Sharpen(Stage):
    """Sharpening after ToneCurve: `sharpen`.

    Args:      amount: >= 0; an nn.Parameter trains.  radius: sigma, up to 50 [pixels].  overshoot: >= 0, of white.
    Raises:    ValueError for a value out of range.

    Example:
    >>> edge = torch.cat([torch.full((1, 1, 9, 8), 0.2), torch.full((1, 1, 9, 8), 0.8)], -1)
    >>> round(float(isp.Sharpen(1.0)(edge).max()), 3)
    0.83
    """

    amount: Tensor | float
    overshoot: Tensor | float

    def __init__(self, amount: Tensor | float = 0.5, *, radius: float = 1.0, overshoot: Tensor | float = 0.03):
        super().__init__()
        check_not_negative(amount, name="amount", unit="(0 for nothing)")
        check_positive(radius, name="radius", unit="pixels")
        if radius > 50:
            raise ValueError(f"radius {radius:g} is more than 50 pixels; expected such as 1.0.")
        check_not_negative(overshoot, name="overshoot", unit="of white")
        hold(self, amount=amount, radius=radius, overshoot=overshoot)

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,C,H,W) to the same shape."""
        return sharpen(signal, amount=self.amount, radius=self.radius, overshoot=self.overshoot)


def _through_blocks(plane: Tensor, table: Tensor) -> Tensor:
    """(B,1,H,W) in DN about 0, each block of 8 x 8 through the DCT, its steps and back."""
    batch, _, height, width = plane.shape
    index = torch.arange(8, device=plane.device, dtype=plane.dtype)
    basis = torch.cos(math.pi / 16 * index[:, None] * (2 * index + 1)) / 2
    basis = basis * torch.where(index[:, None] == 0, 0.5**0.5, 1.0).to(plane)
    tall, wide = -height % 8, -width % 8
    blocks = F.pad(plane, (0, wide, 0, tall), mode="replicate")
    blocks = blocks.reshape(batch, (height + tall) // 8, 8, (width + wide) // 8, 8).transpose(2, 3)
    steps = round_ste(basis @ blocks @ basis.T / table) * table
    back = (basis.T @ steps @ basis).transpose(2, 3).reshape(batch, 1, height + tall, width + wide)
    return back[..., :height, :width]


@in_float32
def jpeg(signal: Tensor, *, quality: int = 90) -> Tensor:
    """What a JPEG file of this quality gives back: 8 bits, YCbCr, colour at half the size, steps in the DCT.

    Args:      signal: (B,3,H,W) coded sRGB, or one channel; clipped to 0..1.  quality: 1..100, as of libjpeg.
    Returns:   same shape, multiples of 1/255. Rounding has the gradient of `round_ste`, clips that of `clip_ste`: the
               gradient is that of the same steps without rounding.
    Source:    ITU-T T.81 (1992), annex K; JFIF 1.02; libjpeg's scaling of the tables and "fancy" upsampling.

    Example:
    >>> (255 * isp.jpeg(torch.full((1, 3, 16, 16), 0.5))).unique().tolist()  # DN
    [128.0]
    """
    if _picture(signal).numel() == 0:
        return signal
    scale = 5000 // quality if quality < 50 else 200 - 2 * quality
    coarse = torch.full((8, 8), 99, dtype=torch.int64)
    coarse[:4, :4] = torch.tensor(TABLE_CHROMA)
    tables = [((t * scale + 50) // 100).clamp(1, 255).to(signal) for t in (torch.tensor(TABLE_LUMA), coarse)]
    levels = round_ste(255 * clip_ste(signal, 0.0, 1.0))
    luma = round_ste(_gray(levels, LUMA)) if signal.shape[1] == 3 else levels
    gray = clip_ste(round_ste(_through_blocks(luma - 128, tables[0]) + 128), 0.0, 255.0)
    if signal.shape[1] == 1:
        return gray / 255
    height, width = signal.shape[-2:]
    uneven = signal.new_tensor([-1 / 8, 1 / 8]).repeat(width // 4 + 8)  # libjpeg rounds halves down, then up
    colour = []
    for channel, weight in ((2, 1.772), (0, 1.402)):
        full = round_ste((levels[:, channel : channel + 1] - _gray(levels, LUMA)) / weight)
        half = F.avg_pool2d(F.pad(full, (0, -width % 16, 0, height % 2), mode="replicate"), 2)
        half = round_ste(half + uneven[: half.shape[-1]])
        half = clip_ste(round_ste(_through_blocks(half, tables[1])), -128.0, 127.0)[..., : (width + 1) // 2]
        double = F.interpolate(half, scale_factor=2, mode="bilinear")[..., :height, :width]
        colour.append(round_ste(double))
    blue, red = colour
    green = gray - 0.344136 * blue - 0.714136 * red
    return clip_ste(round_ste(torch.cat([gray + 1.402 * red, green, gray + 1.772 * blue], 1)), 0.0, 255.0) / 255


class JPEG(Stage):
    """The picture as a JPEG file gives it back, last of all stages: `jpeg`.

    Args:      quality: 1..100, as of libjpeg.
    Raises:    TypeError, ValueError for any other quality.

    Example:
    >>> (255 * isp.JPEG(90)(torch.full((1, 3, 16, 16), 0.5))).unique().tolist()  # DN
    [128.0]
    """

    def __init__(self, quality: int = 90):
        super().__init__()
        if isinstance(quality, bool) or not isinstance(quality, int):
            raise TypeError(f"quality must be an integer such as 90, got {quality!r}.")
        if not 1 <= quality <= 100:
            raise ValueError(f"quality {quality} is outside 1..100, such as 90.")
        hold(self, quality=quality)

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,C,H,W) to the same shape."""
        return jpeg(signal, quality=self.quality)
