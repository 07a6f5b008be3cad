"""What of a camera trains, and how."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from torch import nn

from kcam import isp, optics, sensor
from kcam.camera import Camera

PARTS: dict[str, tuple[type[nn.Module], ...]] = {
    "optics": (optics.Imaging,),
    "filter": (sensor.ColourFilter,),
    "demosaic": (isp.LearnedDemosaic, isp.Convolution),
    "tone": (isp.WhiteBalance, isp.ColourMatrix, isp.ToneCurve),
    "stage": (isp.StyleStage,),
}
"""What can train, and the stages that hold it."""


@dataclass(frozen=True)
class Settings:
    """How a camera is trained.

    steps: of the optimiser. batch: scenes per step. size: of their crops [pixels]. seed: of everything random.
    rates: learning rate of each of `PARTS`; a part that is left out does not train.
    betas, weight_decay: of Adam; the decay acts on `decayed` parts only.
    warm_up: steps of linearly growing rates; then they fall, by half a cosine, to `final` of theirs at the last step.
    clip: largest norm of the gradient; inf for any.
    average: of the weights, that is what is exported: share of the past, 0 for the last weights as they are.
    every: steps between checkpoints.
    content_aim: None leaves the content term at its weight; else its weight follows, within a factor of 2, so that the
        content loss itself settles here: strong strokes and faint ones then leave as much of the scene. For the loss by
        correlation alone; that by features has another unit for each network.
    tolerance: None trains through the reference physics; else through a plan for the training scenes, which is frozen
        between checkpoints and made anew where it is measured to miss the tolerance: see `kcam.Plan`.

    Example:
    >>> from kcam.style import Settings
    >>> settings = Settings(steps=100, rates={"optics": 0.02, "tone": 0.01})  # filter and demosaic do not train
    >>> settings.steps, settings.rates["optics"]
    (100, 0.02)
    """

    steps: int = 400
    batch: int = 2
    size: int = 128
    seed: int = 0
    rates: dict[str, float] = field(
        default_factory=lambda: {"optics": 0.01, "filter": 0.05, "demosaic": 0.01, "tone": 0.01, "stage": 2e-2}
    )
    betas: tuple[float, float] = (0.9, 0.99)
    weight_decay: float = 0.0
    decayed: tuple[str, ...] = ()
    warm_up: int = 10
    final: float = 0.05
    clip: float = 1.0
    average: float = 0.99
    every: int = 100
    content_aim: float | None = None
    tolerance: float | None = None

    def __post_init__(self) -> None:
        unknown = (set(self.rates) | set(self.decayed)) - set(PARTS)
        if unknown:
            raise ValueError(f"unknown part {sorted(unknown)[0]!r} of a camera; what trains: {', '.join(PARTS)}.")
        for name, least in {"steps": 1, "batch": 1, "size": 1, "every": 1, "warm_up": 0}.items():
            value = getattr(self, name)
            if not isinstance(value, int) or value < least:
                raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}.")
        for name in ("weight_decay", "final", "tolerance"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < math.inf:
                raise ValueError(f"{name} must be a finite number >= 0, got {value!r}.")
        if not all(0 <= rate < math.inf for rate in self.rates.values()) or not any(self.rates.values()):
            raise ValueError(f"learning rates must be finite and >= 0, and one of them above, got {self.rates}.")
        if self.content_aim is not None and not 0 < self.content_aim < 2:
            raise ValueError(f"content_aim must be within 0..2, got {self.content_aim:g}. Use 0.12 or None.")
        if not self.clip > 0 or not 0 <= self.average < 1:
            raise ValueError(f"expected clip > 0 and 0 <= average < 1, got {self.clip:g} and {self.average:g}.")

    def rate(self, step: int) -> float:
        """Share of the learning rates at a step."""
        grown = min(1.0, (step + 1) / self.warm_up) if self.warm_up else 1.0
        return grown * (self.final + (1 - self.final) * 0.5 * (1 + math.cos(math.pi * step / self.steps)))


def part_of(stage: nn.Module) -> str | None:
    """Which of `PARTS` a stage of a camera is; None for none."""
    return next((part for part, kinds in PARTS.items() if isinstance(stage, kinds)), None)


def trained_parameters(camera: Camera, settings: Settings) -> dict[str, list[tuple[str, nn.Parameter]]]:
    """The parameters of each part that trains, with their names in the camera's state."""
    found: dict[str, list[tuple[str, nn.Parameter]]] = {}
    for index, stage in enumerate(camera):
        part = part_of(stage)
        if part is not None and settings.rates.get(part, 0):
            named = [(f"stages.{index}.{name}", p) for name, p in stage.named_parameters() if p.requires_grad]
            found.setdefault(part, []).extend(named)
    found = {part: named for part, named in found.items() if named}
    if not found:
        raise ValueError(
            f"nothing of this camera trains: no part of {', '.join(settings.rates)} holds an nn.Parameter. "
            "Use style_camera(), or give its DOE, filter or convolution an nn.Parameter."
        )
    return found
