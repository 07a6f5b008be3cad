"""Stages with noise, and what stands in for them: their mean."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from kcam.context import Context, Stage


def rms(signal: Tensor) -> float:
    """Of all elements, and 1e-12 at least; 1 where there are none."""
    return max(float(signal.detach().double().square().mean().sqrt()), 1e-12) if signal.numel() else 1.0


class Mean(Stage):
    """A random stage at its mean: it holds that stage, so parameters are shared, and calls its `expected`.

    Example:
    >>> noise = sensor.ShotNoise(full_well=10_000)
    >>> sensor.Mean(noise)(torch.tensor([0.25, 1.5])).tolist()  # as expected, up to the full well
    [0.25, 1.0]
    """

    def __init__(self, stage: RandomStage):
        super().__init__()
        self.stage = stage

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """The expected result of the stage."""
        return self.stage.expected(signal, context)

    def provides(self) -> dict[str, Any]:
        """What the stage itself provides."""
        return self.stage.provides()


class RandomStage(Stage):
    """A stage with noise. A subclass draws in `forward`, and gives its mean over all draws in `expected`."""

    full_well: Tensor | float | None

    def expected(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """The signal without the noise: by default unchanged (noise of zero mean)."""
        return signal

    def mean(self) -> Mean:
        """The same stage at its mean, sharing parameters."""
        return Mean(self)

    def sigma(self, signal: Tensor, context: Context | None = None) -> Tensor | float:
        """Standard deviation of the noise [share of the full well]: a number, or for each element of the signal."""
        raise NotImplementedError(f"{type(self).__name__} does not say how large its noise is.")

    def error_if_skipped(self, signal: Tensor, context: Context | None = None) -> float:
        """RMS of `sigma` relative to the RMS of the signal; see `kcam.effects.Skippable`."""
        sigma = torch.as_tensor(self.sigma(signal, context)).detach().double()
        return float(sigma.square().mean().sqrt() / rms(signal))

    def cost(self, signal: Tensor, context: Context | None = None) -> float:
        """Passes over the signal: a random number takes some ten of them."""
        return 10.0

    def reason(self, signal: Tensor, context: Context | None = None) -> str:
        """How many electrons it is, beside the signal's."""
        full_well = float(torch.as_tensor(self._well(context)).detach().max())
        sigma, level = self.error_if_skipped(signal, context), rms(signal) * full_well
        return f"sigma {sigma * level:.3g} of {level:.{0 if level >= 10 else 2}f} electrons"

    def bypass(self) -> Mean:
        """What stands in for it when it is left out: its mean."""
        return self.mean()

    def provides(self) -> dict[str, Any]:
        """The full well, where it was given."""
        return {} if self.full_well is None else {"full_well": self.full_well}

    def _well(self, context: Context | None) -> Tensor | float:
        return (context or Context()).full_well if self.full_well is None else self.full_well

    def _resolve(
        self, context: Context | None, generator: torch.Generator | None
    ) -> tuple[Tensor | float, torch.Generator | None]:
        return self._well(context), (context or Context()).generator if generator is None else generator
