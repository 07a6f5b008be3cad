"""Linear maps that bring their own transpose."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from kcam.precision import full_precision


class LinearMap(Protocol):
    """A linear map with its transpose."""

    def forward(self, values: Tensor) -> Tensor:
        """The map."""

    def adjoint(self, values: Tensor) -> Tensor:
        """Its transpose."""


class _Apply(torch.autograd.Function):
    @staticmethod
    def forward(values, linear, transposed):
        with full_precision(values.device):
            return linear.adjoint(values) if transposed else linear.forward(values)

    @staticmethod
    def setup_context(ctx, inputs, output):
        _, ctx.linear, ctx.transposed = inputs

    @staticmethod
    def backward(ctx, grad):
        return _Apply.apply(grad, ctx.linear, not ctx.transposed), None, None

    @staticmethod
    def jvp(ctx, tangent, *_):
        return _Apply.apply(tangent, ctx.linear, ctx.transposed)


def apply_linear(values: Tensor, linear: LinearMap) -> Tensor:
    """linear.forward(values), differentiable any number of times by the map's own transpose."""
    return _Apply.apply(values, linear, False)
