"""Predicted time and memory of a picture under choices of a plan."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch

from kcam.camera import Camera
from kcam.context import Stage
from kcam.effects import Skippable, Work
from kcam.optics import Imaging
from kcam.planner import costs
from kcam.planner.evaluation import Evaluator
from kcam.planner.ladder import Ladder
from kcam.planner.plan import ENDS
from kcam.scene import Scene
from kcam.sensor import ColourFilter

GAIN = 0.98  # of the time, that a choice must leave to be considered
SAVED = 0.15  # of the time, that one must save which is looked at last, for a plan of many pictures


class Prices:
    """Predicted time and memory of the raw of the scene that takes longest.

    stages: seconds of each stage that says its cost, beside the optics, by its index.
    """

    def __init__(
        self, camera: Camera, evaluator: Evaluator, scenes: Sequence[Scene], always: dict[str, Any], *, one: bool
    ) -> None:
        self.evaluator, self.imaging, self.always, self.one = evaluator, evaluator.imaging, always, one
        self.apart = evaluator.apart if evaluator.varies and evaluator.samples and not one else None
        self.rates = costs.current_rates("" if self.imaging is None else self.imaging.accuracy.propagator)
        self.channels = self._channels(camera)
        self.kept: dict[tuple[Any, ...], Work] = {}
        self.scene = scenes[0]
        if len(scenes) > 1:
            self.scene = max(scenes, key=lambda scene: self._seconds(scene))
        self.context = camera.resolve(self.scene)
        self.given = dict(self._given(camera))
        self.stages = {index: self.of_stage(index, camera[index]) for index in self.given}

    def _given(self, camera: Camera) -> Iterator[tuple[int, torch.Tensor]]:
        """Index of each stage that says its cost, up to the ADC, and a signal as large as the one that it is given."""
        batch, height, width = self.scene.shape
        channels = self.channels or 1
        for index, stage in enumerate(camera):
            if isinstance(stage, Skippable) and not isinstance(stage, Imaging):
                yield index, torch.zeros(()).expand(batch, channels, height, width)
            channels = stage.output_channels(channels, self.context) if isinstance(stage, Stage) else channels
            if isinstance(stage, ENDS):
                return

    def of_stage(self, index: int, stage: Any) -> float:
        """Seconds of a stage in this place."""
        signal = self.given[index]
        return self.rates["touch"] * signal.numel() * stage.cost(signal, self.context)

    @staticmethod
    def _channels(camera: Camera) -> int | None:
        return next((stage.planes for stage in camera if isinstance(stage, ColourFilter)), None)

    def _seconds(self, scene: Scene) -> float:
        return 0.0 if self.imaging is None else costs.seconds(self._work(scene, {}), self.rates)

    def work(self, changes: Mapping[str, Any]) -> Work:
        """With changes of the Imaging; kept, because tables ask for all of them again."""
        key = tuple(sorted(changes.items()))
        if key not in self.kept:
            self.kept[key] = self._work(self.scene, changes)
        return self.kept[key]

    def _work(self, scene: Scene, changes: Mapping[str, Any]) -> Work:
        if self.imaging is None:
            return Work()
        imaging = self.imaging.changed(**self.always | dict(changes))
        known = None
        if torch.as_tensor(scene.depth).ndim != 1:  # else each distance is a picture of its own
            known = self.evaluator.laid_out(imaging, scene)
        return imaging.work(scene, channels=self.channels, apart=self.apart, known=known)

    def of(self, changes: Mapping[str, Any]) -> tuple[float, float]:
        """(seconds, bytes) with changes of the Imaging."""
        work = self.work(changes)
        return costs.seconds(work, self.rates), work.memory

    def saves(self, ladder: Ladder) -> bool:
        """Whether its cheapest rung takes less time than its top."""
        return self.of(ladder.levels[0].changes)[0] <= GAIN * self.of({})[0] or len(ladder.levels) == 1

    def worth(self, ladder: Ladder, changes: Mapping[str, Any]) -> bool:
        """Whether its cheapest rung saves enough beside such changes, for a single picture more than pricing takes."""
        foot, beside, now = ladder.levels[0].changes, ladder.beside, self.of(changes)[0]
        saved = now - self.of({**changes, **foot})[0]
        if not self.one:
            return saved > SAVED * now
        takes = self.of(beside)[0] + self.of({**beside, **foot})[0] if ladder.takes is None else ladder.takes
        return saved > (1 - GAIN) * now and saved > takes
