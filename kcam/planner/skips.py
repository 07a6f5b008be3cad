"""Stages of the sensor, or of the user's, that a plan may leave out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from kcam.camera import Camera
from kcam.planner.evaluation import Evaluator
from kcam.sensor import ADC
from kcam.sensor.random_stage import RandomStage

NOISE_SHARE = 0.1
"""Of all noise, that a source may be and be left out where the sensor sets the tolerance: 0.5 % of the sum."""


class Skip:
    """A stage that may be left out, or take a cheaper form (`cheaper`): a ladder where its error counts."""

    def __init__(self, camera: Camera, index: int, evaluator: Evaluator) -> None:
        self.stage: Any = camera[index]
        self.index, self.position = index, 0
        self.counted = not isinstance(self.stage, (RandomStage, ADC))
        found = [given[index] for given in evaluator.signals]
        dimmed = zip(evaluator.dimmings, found, strict=True)
        errors = [times * self.stage.error_if_skipped(*signal) for times, signal in dimmed]
        worst = max(range(len(errors)), key=errors.__getitem__)
        seen = ", without blur" if evaluator.dimmed else ""
        self.error_if_skipped, self.reason = errors[worst], self.stage.reason(*found[worst]) + seen
        forms = getattr(self.stage, "cheaper", None)
        self.forms = [("left out", None, self.error_if_skipped), *(forms(*found[worst]) if callable(forms) else ())]

    @property
    def error(self) -> float:
        """Estimated, as it is now."""
        return 0.0 if self.at_top else self.forms[self.position][2]

    @property
    def at_top(self) -> bool:
        """Whether it is kept."""
        return self.position == len(self.forms)

    def price(self, evaluator: Evaluator, most: float) -> None:
        """It is known."""

    def climb(self, evaluator: Evaluator, most: float) -> None:
        """To the next form that does better, or the stage itself."""
        before = self.error
        self.position += 1
        while self.error >= before and not self.at_top:
            self.position += 1


def shortcuts_of(skips: Sequence[Skip], allowed: float, noise: float | None) -> dict[int, dict[str, Any] | None]:
    """Stages to leave out or to replace: by those whose errors count; noise and rounding that are small by
    themselves are left out.

    Together they stay below the tolerance; where the noise itself sets it, each source below a tenth of it.
    """
    chosen = {skip.index: skip.forms[skip.position][1] for skip in skips if skip.counted and not skip.at_top}
    left_out = 0.0
    for skip in sorted((skip for skip in skips if not skip.counted), key=lambda skip: skip.error):
        left_out = math.hypot(left_out, skip.error)
        if left_out <= (allowed if noise is None else NOISE_SHARE * noise):
            chosen[skip.index] = None
    return chosen
