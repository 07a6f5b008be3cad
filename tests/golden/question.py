"""What is asked of kcam before and after a change: a name, and a function that gives named tensors and plain values.

Only public names are used, so that a question can be put to any version.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

Answer = dict[str, Any]
"""Tensors, and plain values as JSON has them."""


@dataclass(frozen=True)
class Question:
    """One row of the table.

    slow: whether it takes more than a second or two.
    """

    name: str
    ask: Callable[[], Answer]
    slow: bool = False


def parameter(value: float | Tensor, dtype: torch.dtype) -> nn.Parameter:
    """A number or tensor that trains."""
    return nn.Parameter(torch.as_tensor(value).to(dtype, copy=True))


def projected(result: Tensor, weights: Tensor) -> Tensor:
    """A fixed random projection of a result, to differentiate."""
    return (result * weights.to(result)).sum()


@dataclass(frozen=True)
class Scaled:
    """A tensor that is compared beside a scale that may be larger than its own norm."""

    value: Tensor
    scale: float


def gradients(of: Tensor, to: Mapping[str, Tensor]) -> Answer:
    """Of a number to named tensors, as exact as the number; "none" where it does not depend on one.

    In float32 the gradient to a length is a sum that cancels, so its scale is what the most sensitive of the lengths
    gives if each changes by the same share. In float64 each stands for itself.
    """
    found = torch.autograd.grad(of, list(to.values()), allow_unused=True)
    slopes = {name: g.to(of.dtype) for name, g in zip(to, found, strict=True) if g is not None}
    if of.dtype == torch.float32:
        slopes |= _scaled({name: g for name, g in slopes.items() if g.numel() <= LENGTHS}, to)
    return {f"d {name}": slopes.get(name, "none") for name in to}


LENGTHS = 3
"""So few numbers are lengths: scalars of a lens, or distances."""


def _scaled(slopes: dict[str, Tensor], to: Mapping[str, Tensor]) -> dict[str, Scaled]:
    finite = {name: to[name].detach().where(to[name].isfinite(), 0) for name in slopes}
    effects = [float((g.double() * finite[name].double()).norm()) for name, g in slopes.items()]
    most = max(effects, default=0.0)
    return {name: Scaled(g, most / max(float(finite[name].norm()), 1e-30)) for name, g in slopes.items()}


def in_float32(answer: Answer) -> Answer:
    """What is computed in float32, though given in float64."""
    cast = {name: v.to(torch.float32) for name, v in answer.items() if isinstance(v, Tensor) and v.is_floating_point()}
    return answer | cast
