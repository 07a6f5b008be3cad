"""Arguments of a stage: held, checked, and brought to the signal that they act on."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from kcam.inputs import check_signal
from kcam.precision import full_precision
from kcam.units import as_numbers, check_positive

MOST_ELECTRONS = 1e30
"""In a full well, or as the spread of a noise: the square still is a float32."""


def hold(stage: nn.Module, **arguments: Any) -> None:
    """Store a stage's arguments under their own names: a plain tensor as a buffer, everything else as it is."""
    for name, value in arguments.items():
        if isinstance(value, Tensor) and not isinstance(value, nn.Parameter):
            stage.register_buffer(name, value)
        else:
            setattr(stage, name, value)


def like(value: Tensor | float, signal: Tensor) -> Tensor | float:
    """A number as it is; a tensor or parameter in the signal's dtype, on its device, with its gradient."""
    return value.to(signal) if isinstance(value, Tensor) else value


def check_not_negative(value: Tensor | float, *, name: str, unit: str, most: float = math.inf, fix: str = "") -> None:
    """ValueError unless every element of `value` is finite, >= 0, and not above `most`."""
    values = as_numbers(value, name=name, expected=f"a number >= 0 {unit}").detach()
    bad = ~((values >= 0) & values.isfinite())
    if bad.any():
        raise ValueError(f"{name} must be finite and >= 0 {unit}, got {values[bad].flatten()[0].item():g}.")
    if (values > most).any():
        raise ValueError(f"{name} must be at most {most:g} {unit}, got {values.max().item():g}.{fix and ' '}{fix}")


def check_full_well(value: Tensor | float | None) -> None:
    """ValueError unless every element of a full well is from 1e-3 to 1e30 electrons; None is left to the context."""
    if value is not None:
        check_positive(value, name="full_well", unit="electrons")
        low, high = (float(end) for end in torch.as_tensor(value, dtype=torch.float64).detach().aminmax())
        if not 1e-3 <= low <= high <= MOST_ELECTRONS:
            raise ValueError(
                f"full_well {low if low < 1e-3 else high:g} is outside 0.001..{MOST_ELECTRONS:g} electrons, such as "
                "10_000."
            )


def check_seed(seed: int) -> None:
    """TypeError unless the seed that names a sensor is an integer."""
    if isinstance(seed, bool) or not isinstance(seed, int):
        raise TypeError(f"seed must be an integer such as 0, got {seed!r}.")


def in_float32(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Compute a function of a signal in at least float32 and give the result back in the signal's own dtype."""

    @functools.wraps(function)
    def wrapper(signal: Tensor, **arguments: Any) -> Tensor:
        check_signal(signal)
        working = signal.float() if signal.dtype in (torch.float16, torch.bfloat16) else signal
        with full_precision(signal.device):
            return function(working, **arguments).to(signal.dtype)

    return wrapper
