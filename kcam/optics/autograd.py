"""Derivatives by hand: linear maps that bring their transpose, and Functions that can be differentiated once."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Protocol

import torch
from torch import Tensor

from kcam.precision import full_precision


class LinearMap(Protocol):
    """A linear map with its transpose; for `apply_linear` under vmap, of any leading dimensions."""

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

    @staticmethod
    def vmap(info, in_dims, values, linear, transposed):
        return _Apply.apply(values.movedim(in_dims[0], 0), linear, transposed), 0


def apply_linear(values: Tensor, linear: LinearMap) -> Tensor:
    """linear.forward(values), differentiable any number of times by the map's own transpose."""
    return _Apply.apply(values, linear, False)


class _Cut(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values, places):
        ctx.shape, ctx.places = values.shape, places
        return tuple(values[(..., *place)] for place in places)

    @staticmethod
    def backward(ctx, *grads):
        whole = next(grad for grad in grads if grad is not None).new_zeros(ctx.shape)
        for grad, place in zip(grads, ctx.places, strict=True):
            whole = add_at(whole, grad, place)
        return whole, None


class _AddAt(torch.autograd.Function):
    @staticmethod
    def forward(ctx, whole, part, place):
        ctx.mark_dirty(whole)
        ctx.place = place
        whole[(..., *place)] += part
        return whole

    @staticmethod
    def backward(ctx, grad):
        return grad, grad[(..., *ctx.place)], None


Place = tuple[slice, slice]
"""Rows and columns of a picture."""


def cut(values: Tensor, places: list[Place]) -> tuple[Tensor, ...]:
    """Parts of values (..., H, W), not to be changed. On the way back all are added up in one tensor: of slices each
    would fill a whole one with zeros.
    """
    return _Cut.apply(values, places)


def add_at(whole: Tensor, part: Tensor, place: Place) -> Tensor:
    """The whole (..., H, W) with a part added to it in place. The way back takes its gradient as it is: of a slice that
    is changed in place it would copy the whole.
    """
    return _AddAt.apply(whole, part, place)


def once_differentiable(backward: Callable[..., Any]) -> Callable[..., Any]:
    """For `backward(ctx, saved, *grads)` of a Function: a second derivative through it is a RuntimeError.

    torch's decorator of this name raises only where the incoming gradient has a graph. Where it has none, as for a loss
    that is linear in the result, the second derivative would come out as 0.
    """

    @functools.wraps(backward)
    def once(ctx: Any, *grads: Tensor) -> Any:
        saved = ctx.saved_tensors  # once: a checkpoint gives them out only once
        with torch.no_grad():
            found = backward(ctx, saved, *grads)
        if not torch.is_grad_enabled():
            return found
        sources = [t for t in (*saved, *grads) if t is not None and t.requires_grad]
        return tuple(None if d is None else _Refuse.apply(d, *sources) for d in found)

    return once


class _Refuse(torch.autograd.Function):
    """The identity in its first argument; its derivative to any of them is refused."""

    @staticmethod
    def forward(ctx, value, *sources):
        return value.view_as(value)

    @staticmethod
    def backward(ctx, grad):
        raise RuntimeError(
            "this stage has first derivatives only. Take second ones by differences of the first, or for a "
            "symmetric lens alone with method='radial'."
        )
