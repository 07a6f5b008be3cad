"""What an augmentation draws for each sample: numbers from ranges, choices, and seeds of random fields."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from kornia.augmentation.random_generator import RandomGeneratorBase
from torch import Tensor, nn

from kcam.units import as_numbers

Bounds = tuple[float, float] | list[float] | float | Tensor
"""(low, high), or one number for always the same; an nn.Parameter (2,) trains."""


@dataclass(frozen=True)
class Uniform:
    """A number between two bounds.

    scale: what it is uniform in: itself, its logarithm (f-numbers, ISO), or its inverse (distances: an equal step in
        1/m is an equal step of blur).
    least, most: which bounds are allowed, both included. unit: for the error.
    steps: one of so many numbers, equally far apart on that scale and both bounds among them; 0 for any number.
    """

    bounds: Bounds
    scale: str = "linear"
    least: float = -math.inf
    most: float = math.inf
    unit: str = ""
    steps: int = 0

    def tensor(self, name: str) -> Tensor:
        """The bounds, (2,); ValueError or TypeError for what can be none."""
        expected = f"(low, high) or a number {self.unit}".rstrip()
        values = as_numbers(self.bounds, name=name, expected=expected)
        found = values.detach().flatten().tolist()
        if values.ndim > 1 or len(found) not in (1, 2):
            raise ValueError(f"{name} must be {expected}, got shape {tuple(values.shape)}.")
        low, high = found[0], found[-1]
        if not self.allows(self.bounds if isinstance(self.bounds, Tensor) else values):
            raise ValueError(
                f"{name} must be {expected} with {self.least:g} <= low <= high <= {self.most:g}"
                f"{'' if self.scale == 'vergence' else ', finite'}, got ({low:g}, {high:g})."
            )
        if isinstance(self.bounds, nn.Parameter):
            if values.shape != (2,):
                raise ValueError(f"{name} as a parameter must be (2,), its two bounds, got {tuple(values.shape)}.")
            return self.bounds
        # in the default type: Kornia's containers make pictures of a NumPy array in that of the first buffer
        return torch.tensor([low, high])

    def allows(self, bounds: Tensor) -> bool:
        """Whether these bounds are within least and most, to their type's rounding: float32's 0.49 is above 0.49."""
        low, high = bounds.detach().double().flatten()[[0, -1]].tolist()
        if self.scale != "vergence" and not (math.isfinite(low) and math.isfinite(high)):
            return False
        slack = torch.finfo(bounds.dtype if bounds.is_floating_point() else torch.float64).eps
        return self.least - slack * abs(self.least) <= low <= high <= self.most + slack * abs(self.most)

    def between(self, bounds: Tensor, share: Tensor) -> Tensor:
        """The number a share of the way from the lower bound to the upper one."""
        low, high = bounds
        if self.steps:
            index = (share * self.steps).floor().clamp(max=self.steps - 1)
            share = index / (self.steps - 1) if self.steps > 1 else torch.full_like(share, 0.5)
        if self.scale == "log":
            return low * (high / low) ** share
        if self.scale == "vergence":
            return 1 / (1 / high + (1 / low - 1 / high) * share)
        return low + (high - low) * share


@dataclass(frozen=True)
class Normal:
    """A vector of independent standard normal numbers."""

    count: int


@dataclass(frozen=True)
class Choice:
    """One of `count` things, as an index."""

    count: int


@dataclass(frozen=True)
class Seed:
    """The seed of a random field, 0 .. 2^62."""


Draw = Uniform | Normal | Choice | Seed


class Draws(RandomGeneratorBase):
    """Draws for each sample from torch's global generator, on the CPU, as Kornia's own generators do.

    Building one draws nothing. Bounds that are an nn.Parameter get gradients through the numbers drawn.

    Args:      draws: what is drawn, by the name under which it stands in the augmentation's parameters.
    Returns:   (B,) for each name, (B, count) of a `Normal`; with same_on_batch all rows are the same.
    """

    def __init__(self, draws: Mapping[str, Draw]) -> None:
        super().__init__()
        self.draws = dict(draws)
        for name, draw in self.draws.items():
            if isinstance(draw, Uniform):
                bounds = draw.tensor(name)
                if isinstance(bounds, nn.Parameter):
                    self.register_parameter(name, bounds)
                else:
                    self.register_buffer(name, bounds)

    def __repr__(self) -> str:
        shown = []
        for name, draw in self.draws.items():
            if isinstance(draw, Uniform):
                low, high = self.bounds(name)
                shown.append(f"{name}=({low:g}, {high:g})")
            elif isinstance(draw, Choice):
                shown.append(f"{name}=one of {draw.count}")
        return ", ".join(shown) or "drawn=seeds"

    def bounds(self, name: str) -> tuple[float, float]:
        """The bounds of a number as they are now."""
        low, high = getattr(self, name).detach().tolist()
        return low, high

    def make_samplers(self, device: torch.device, dtype: torch.dtype) -> None:
        """Nothing to prepare: bounds are read when they are needed, so loaded and trained ones count."""

    def forward(self, batch_shape: Sequence[int], same_on_batch: bool = False) -> dict[str, Tensor]:
        """Draw for `batch_shape[0]` samples."""
        batch = int(batch_shape[0])
        count = 1 if same_on_batch and batch else batch
        drawn: dict[str, Tensor] = {}
        for name, draw in self.draws.items():
            if isinstance(draw, Uniform):
                bounds = getattr(self, name)
                if not draw.allows(bounds):
                    low, high = self.bounds(name)
                    raise ValueError(
                        f"{name} was trained or loaded to ({low:g}, {high:g}), outside {draw.least:g} <= low <= high "
                        f"<= {draw.most:g}. Sort and clamp it after each step."
                    )
                value = draw.between(bounds, torch.rand(count, dtype=torch.float64).to(bounds.device))
            elif isinstance(draw, Normal):
                value = torch.randn(count, draw.count, dtype=torch.float64)
            else:
                value = torch.randint(draw.count if isinstance(draw, Choice) else 2**62, (count,))
            drawn[name] = value.expand(batch, *value.shape[1:]) if same_on_batch else value
        return drawn
