"""What the planner asks of a stage: what it would cost to leave its effect out, and what its work is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from kcam.context import Context, Stage


@dataclass(frozen=True)
class Work:
    """Counts of operations by their kind (see `kcam.planner.costs.RATES`), and memory at the peak [bytes].

    Two works one after the other add up their operations and need the larger memory.

    Example:
    >>> from kcam.effects import Work
    >>> both = Work({"touch": 10.0}, memory=4e6) + Work({"touch": 5.0}, memory=1e6)
    >>> both.operations, both.memory
    ({'touch': 15.0}, 4000000.0)
    """

    operations: Mapping[str, float] = field(default_factory=dict)
    memory: float = 0.0

    def __add__(self, other: Work) -> Work:
        kinds = {**self.operations, **other.operations}
        total = {kind: self.operations.get(kind, 0.0) + other.operations.get(kind, 0.0) for kind in kinds}
        return Work(total, max(self.memory, other.memory))


@runtime_checkable
class Skippable(Protocol):
    """A stage that a `Plan` may leave out: three methods. A stage without them is always kept.

    Left out means that the signal passes unchanged, or through the stage that its method ``bypass()`` gives. A stage
    with a parameter that requires grad is kept whatever it says. One that has cheaper forms names them by a method
    ``cheaper(signal, context)``: (what it is called, arguments of its method `changed`, its error), the cheapest first.
    One whose effect depends on the place in the picture says so, ``whole_picture = True``, and ``only_whole = True`` if
    it cannot be tried on a part of one.

    Example:
    >>> from kcam.effects import Skippable
    >>> noise, signal = sensor.ReadNoise(3.0), torch.full((1, 1, 8, 8), 0.5)  # 5000 electrons
    >>> isinstance(noise, Skippable), round(noise.error_if_skipped(signal, kcam.Context()), 5)
    (True, 0.0006)
    >>> noise.reason(signal, kcam.Context())
    'sigma 3 of 5000 electrons'
    """

    def error_if_skipped(self, signal: Tensor, context: Context) -> float:
        """RMS change of the signal (B,C,H,W), relative to its RMS: what the picture loses without this stage."""

    def cost(self, signal: Tensor, context: Context) -> float:
        """How often the stage touches an element of the signal: about 1 for a sum, 10 for an exponential."""

    def reason(self, signal: Tensor, context: Context) -> str:
        """What decides, with its number: "sigma 3 electrons of 10 000"."""


def relative_rms(a: Tensor, b: Tensor) -> float:
    """sqrt(mean (a - b)^2 / mean b^2): 0 for two black pictures, and without a bound for one.

    Example:
    >>> from kcam.effects import relative_rms
    >>> raw = torch.rand(1, 1, 8, 8)
    >>> round(relative_rms(1.01 * raw, raw), 4)
    0.01
    """
    a, b = a.detach().double(), b.detach().double()
    if not b.numel():
        return 0.0
    return float((a - b).square().mean().sqrt() / b.square().mean().sqrt().clamp(min=1e-30))


def relative_change(stage: Stage, signal: Tensor, context: Context | None = None) -> float:
    """What a stage without noise changes of a signal: RMS of the change over the RMS of the signal, by computing it.

    Args:      stage: keeps the shape of the signal.  signal: (B,C,H,W).  context: that the stage is told.

    Example:
    >>> from kcam.effects import relative_change
    >>> round(relative_change(isp.Clip(), torch.tensor([[[[0.5, 1.1]]]])), 3)  # 0.1 of the root of 0.25 + 1.21
    0.083
    """
    with torch.no_grad():
        return relative_rms(stage(signal, context), signal) if signal.numel() else 0.0
