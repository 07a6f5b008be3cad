"""Linear maps that bring their own transpose."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor


class LinearMap(Protocol):
    """A linear map with its transpose."""

    def forward(self, values: Tensor) -> Tensor:
        """The map."""

    def adjoint(self, values: Tensor) -> Tensor:
        """Its transpose."""


class _Apply(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values, linear):
        ctx.linear = linear
        return linear.forward(values)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        return ctx.linear.adjoint(grad), None


def apply_linear(values: Tensor, linear: LinearMap) -> Tensor:
    """linear.forward(values), differentiable once by its transpose."""
    return _Apply.apply(values, linear)
