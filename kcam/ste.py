"""Straight-through gradients: exact steps and clips going forward, a stated and useful slope going back.

Rounding has a slope of 0 almost everywhere and a clip has one of 0 outside its range, so that a camera with an ADC, or
an overexposed picture, would not train at all. The functions here compute the exact values; only the gradient is
replaced, by the formula in each docstring.
"""

from __future__ import annotations

import torch
from torch import Tensor


class _Round(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        return torch.round(x)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        pass

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tensor:
        return grad


class _Clip(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor, low: float | None, high: float | None) -> Tensor:
        return x.clamp(low, high)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        x, ctx.low, ctx.high = inputs
        ctx.save_for_backward(x)

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None]:
        (x,) = ctx.saved_tensors
        if ctx.low is not None:
            grad = grad.masked_fill((x < ctx.low) & (grad > 0), 0)
        if ctx.high is not None:
            grad = grad.masked_fill((x > ctx.high) & (grad < 0), 0)
        return grad, None, None


def round_ste(x: Tensor) -> Tensor:
    """Round to the nearest integer (halves to even), with the gradient of the identity.

    y = round(x),  dy/dx := 1

    Args:      x: any shape, floating point.
    Returns:   integers in the dtype of `x`, exactly what `torch.round` gives.
    Source:    Bengio, Leonard and Courville, arXiv 1308.3432 (2013), the straight-through estimator.
    """
    return _Round.apply(x)


def clip_ste(x: Tensor, low: float | None = None, high: float | None = None) -> Tensor:
    """Clip to low..high, with a gradient that leads back into the range and never further out of it.

    y = min(max(x, low), high).  With g = dL/dy, the gradient that reaches x is

        0   where x > high and g < 0   (descending the loss would raise an x that is already too high),
        0   where x < low  and g > 0   (likewise at the lower end),
        g   elsewhere.

    The true gradient is 0 at every clipped element: a saturated pixel could then never be made darker.

    Args:      x: any shape, floating point.  low, high: bounds in the unit of `x`; None for no bound.
    Returns:   the clipped values, exactly what `torch.clamp` gives.
    Raises:    ValueError if both bounds are None, or low > high.
    """
    if low is None and high is None:
        raise ValueError("clip_ste needs a bound: got low=None and high=None; give low=, high=, or both.")
    if low is not None and high is not None and low > high:
        raise ValueError(f"clip_ste expects low <= high, got low={low:g} and high={high:g}; swap them.")
    return _Clip.apply(x, low, high)
