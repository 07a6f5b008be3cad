"""What rounding does to a picture: where float32's transforms do not hold its light, and what they take below 0."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcam.cache import differentiated
from kcam.scene import Scene

_RANGE = 4000.0  # of light in one picture that float32's transforms hold to 1e-3; a picture of 8 bits has 3300
_FEW_BRIGHT, _MUCH_DARK = 0.05, 0.01  # shares of the pixels


def wide_range(scene: Scene) -> bool:
    """Whether the light of a picture spans more than float32's transforms hold: 4000 : 1 between what matters.

    They err by about 1e-7 of the brightest, everywhere. That is 1e-3 of what is 4000 times darker, so the transforms
    are float64 where a few lights stand out of the rest (fewer than 5 % of the pixels within 4000 of the brightest),
    or where much is so dark (more than 1 % of what is not black). Black beside large bright areas is left to float32:
    what comes there is off by up to 1e-6 of these. Pictures of 8 bits end at 3300 : 1. All bands count together: beside
    a patch of one band in 28 that band may be off by 5e-3.
    """
    planes = scene.coefficients.detach()
    if not planes.numel():
        return False
    planes = planes if planes.dtype == torch.float64 else planes.float()
    if scene.spectra is None:
        light = planes.sum(1)
    else:
        light = torch.einsum("bkyx,k->byx", planes, scene.spectra.detach().to(planes).sum(1))
    light = light.flatten(1)
    bright, lit = _counts(light >= light.amax(1, keepdim=True) / _RANGE), _counts(light > 0)
    return bool(((bright < _FEW_BRIGHT * light.shape[1]) | (lit - bright > _MUCH_DARK * lit)).any())


def _counts(masks: Tensor) -> Tensor:
    """Of each row (B, N): one by one, which is twenty times as fast as along a dimension."""
    return torch.stack([row.count_nonzero() for row in masks])


def not_negative(light: Tensor, weights: Tensor | None) -> Tensor:
    """Irradiance (B, C, H, W) in which nothing took a pixel below 0, neither rounding nor a PSF between others, as none
    can be where the filter has no negative weights; the gradient is that of what was computed.
    """
    floor = light.new_zeros(1)
    if weights is not None:
        floor = floor.where((weights.detach() >= 0).all(1), -math.inf)[:, None, None]
    if not differentiated(light):
        return torch.maximum(light, floor, out=light)
    return torch.where(light < floor, light - light.detach(), light)
