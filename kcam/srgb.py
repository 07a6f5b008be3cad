"""The transfer function of sRGB (IEC 61966-2-1), both ways.

    coded to light   v / 12.92          v <= 0.04045,     ((v + 0.055) / 1.055)^2.4      above
    light to coded   12.92 x            x <= 0.0031308,   1.055 x^(1/2.4) - 0.055        above

Kornia's functions of the same, five passes over memory with masks, are what this is tested against. Numbers in float32
that need no gradient, nearly all, take a shorter way: a power is 2^(e log2 x), the two parts are added where Kornia
selects one, and it all happens in pieces that stay in the processor's cache. It is off by 3e-7 at most.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from kcam.cache import is_plain
from kcam.ste import clip_ste

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Of Rec. 709's primaries, which sRGB has: of linear light the luminance, of coded values the luma."""
_PIECE = 2**17
"""Numbers per thread: half a megabyte, and as much again for what is added."""
_CODED, _LIGHT = 0.0404482362771082, 0.00313066844250063
"""Where line and power really meet. The standard rounds them, and is 3e-8 from continuous there."""


def to_light(coded: Tensor) -> Tensor:
    """Coded sRGB to linear light, any shape; what is below 0 or above 1 goes on along the curve."""
    if coded.dtype == torch.float32 and is_plain(coded):
        return _in_pieces(coded, _light_of)
    power = ((coded.clamp(min=0.04045) + 0.055) / 1.055).pow(2.4)  # the clamp: no slope of NaN below -0.055
    return torch.where(coded <= 0.04045, coded / 12.92, power)


def to_code(light: Tensor) -> Tensor:
    """Linear light to coded sRGB, any shape, clipped to 0..1; beyond the clip the gradient is that of `clip_ste`."""
    if light.dtype == torch.float32 and is_plain(light):
        return _in_pieces(light, _code_of)
    clipped = clip_ste(light, 0.0, 1.0)
    power = 1.055 * clipped.clamp(min=0.0031308).pow(1 / 2.4) - 0.055
    return torch.where(clipped <= 0.0031308, 12.92 * clipped, power).clamp(max=1)


def _in_pieces(values: Tensor, curve: Callable[[Tensor, Tensor, Tensor], object]) -> Tensor:
    """curve(values, result, spare room), each of one dimension, a piece at a time; the result is laid out as they."""
    result = torch.empty_like(values)
    if result.stride() != values.stride():  # a slice, or something expanded
        values, result = values.contiguous(), torch.empty_like(values, memory_format=torch.contiguous_format)
    count = values.numel()
    size = _PIECE * torch.get_num_threads() if values.device.type == "cpu" else max(count, 1)
    spare = values.new_empty(min(size, count))
    line, target = (part.as_strided((count,), (1,)) for part in (values, result))
    for piece, out in zip(line.split(size), target.split(size), strict=True):
        curve(piece, out, spare[: len(piece)])
    return result


def _light_of(coded: Tensor, out: Tensor, spare: Tensor) -> None:
    _power_of_code(torch.clamp(coded, min=_CODED, out=out)).sub_(_zero(_power_of_code, _CODED, coded.device))
    out.add_(torch.clamp(coded, max=_CODED, out=spare), alpha=1 / 12.92)


def _code_of(light: Tensor, out: Tensor, spare: Tensor) -> None:
    _power_of_light(torch.clamp(light, min=_LIGHT, out=out)).sub_(_zero(_power_of_light, _LIGHT, light.device))
    out.add_(torch.clamp(light, max=_LIGHT, out=spare), alpha=12.92).clamp_(0, 1)


def _power_of_code(coded: Tensor) -> Tensor:
    return coded.add_(0.055).log2_().mul_(2.4).sub_(2.4 * math.log2(1.055)).exp2_()


def _power_of_light(light: Tensor) -> Tensor:
    return light.log2_().mul_(1 / 2.4).add_(math.log2(1.055)).exp2_()


@functools.cache
def _zero(power: Callable[[Tensor], Tensor], joint: float, device: torch.device) -> float:
    """The power where the line begins, to the last bit: what is on the line is then exactly on it, and black is 0."""
    return float(power(torch.full((1,), joint, dtype=torch.float32, device=device)))
