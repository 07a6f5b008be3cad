"""A training step: scenes to pictures to the terms of the loss."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor, nn

from kcam import optics
from kcam.camera import DEMOSAICING, Camera, is_random
from kcam.context import Stage
from kcam.scene import Scene
from kcam.style.losses import StyleLoss

Generators = Callable[[int, int], torch.Generator]
"""The generator of a row of the batch and a stage."""


class Step(nn.Module):
    """A training step as one module: scenes to the terms of the loss; what torch's data parallel engine wraps."""

    def __init__(self, camera: Camera, loss: StyleLoss) -> None:
        super().__init__()
        self.camera, self.loss = camera, loss
        self.through: Camera = camera

    def forward(
        self, scene: Scene, generator: Generators, turn: int, mark: Callable[[str], None]
    ) -> tuple[dict[str, Tensor], Tensor]:
        """The terms, and the pictures (B,3,H,W)."""
        picture, recorded = photograph(self.through, scene, generator, recorded=bool(self.loss.weights["l2"]))
        mark("camera")
        shown = scene.to_srgb()
        terms = self.loss.terms(picture, shown, recorded=recorded, turn=turn)
        mark("loss")
        return terms, picture


def photograph(
    camera: Camera, scene: Scene, generator: Generators, *, recorded: bool = False
) -> tuple[Tensor, tuple[Tensor, Tensor] | None]:
    """Pictures of a batch with a generator for each row and stage: no noise depends on a neighbour's or an earlier one.

    An earlier one would: a Poisson draw takes as many numbers as it needs, which rounding can change.

    Returns:   the pictures, and with `recorded` what the sensor records with and without optics, before any noise:
               the two sides of the thesis's L2 content loss (its figure 4.1).
    """
    stops = (i for i, stage in enumerate(camera) if isinstance(stage, DEMOSAICING) or is_random(stage))
    split = next(stops, len(camera))
    context = camera.resolve(scene)
    front = Camera(*camera.stages[:split], context=context)
    light = front(scene)
    rows = []
    for number, row in enumerate(light):
        signal = row[None]
        for index, stage in enumerate(camera.stages[split:]):
            own = dataclasses.replace(context, generator=generator(number, index))
            signal = stage(signal, own) if isinstance(stage, Stage) else stage(signal)
        rows.append(signal)
    pair = None
    if recorded:
        flat = Camera(*(stage for stage in front if not isinstance(stage, optics.Imaging)), context=context)
        with torch.no_grad():  # a target: it does not move towards the picture
            pair = (light, flat(scene.bands()))
    return torch.cat(rows), pair
