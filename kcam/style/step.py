"""A training step: scenes to pictures to the terms of the loss, and their gradients, row by row of the batch.

What precedes the demosaic and the first noise takes all rows at once. From there on each row is developed, compared and
differentiated alone, and what belongs to all of them is summed in their order: so no number depends on which process
has which row, and several processes take the steps of one, bit for bit. Sums in another order, as torch's
DistributedDataParallel takes them, are 1e-8 off; then a photon falls otherwise, and in ten steps losses are 10 % off.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from kcam import optics
from kcam.camera import DEMOSAICING, Camera, is_random
from kcam.context import Context, Stage
from kcam.scene import Scene
from kcam.style.losses import StyleLoss
from kcam.style.processes import gathered, of_the_first, place

Generators = Callable[[int, int], torch.Generator]
"""The generator of a row of the batch and a stage."""
Mark = Callable[[str], None]


@dataclass(frozen=True)
class Recording:
    """What the sensor records of a batch before any noise, and the stages from there on.

    light: (B,C,H,W). flat: the same without optics, a constant: the other side of the thesis's L2 content loss (its
    figure 4.1); None where nobody asked.
    """

    light: Tensor
    flat: Tensor | None
    stages: Sequence[nn.Module]
    context: Context

    def develop(self, signal: Tensor, row: int, generator: Generators) -> Tensor:
        """The picture (1,3,H,W) of one row's light (1,C,H,W), with a generator for each stage.

        No noise depends on an earlier one: a Poisson draw takes as many numbers as it needs, which rounding can change.
        """
        for index, stage in enumerate(self.stages):
            own = dataclasses.replace(self.context, generator=generator(row, index))
            signal = stage(signal, own) if isinstance(stage, Stage) else stage(signal)
        return signal


def record(camera: Camera, scene: Scene, *, recorded: bool = False) -> Recording:
    """Take a batch up to the first stage that is random or demosaics; with `recorded` without optics too."""
    stops = (i for i, stage in enumerate(camera) if isinstance(stage, DEMOSAICING) or is_random(stage))
    split = next(stops, len(camera))
    context = camera.resolve(scene)
    front = Camera(*camera.stages[:split], context=context)
    flat = None
    if recorded:
        sensor = Camera(*(stage for stage in front if not isinstance(stage, optics.Imaging)), context=context)
        with torch.no_grad():  # a target: it does not move towards the picture
            flat = sensor(scene.bands())
    return Recording(front(scene), flat, list(camera)[split:], context)


def photograph(
    camera: Camera, scene: Scene, generator: Generators, *, recorded: bool = False
) -> tuple[Tensor, tuple[Tensor, Tensor] | None]:
    """Pictures of a batch (B,3,H,W), and with `recorded` what the sensor records with and without optics."""
    taken = record(camera, scene, recorded=recorded)
    pictures = [taken.develop(light[None], row, generator) for row, light in enumerate(taken.light)]
    return torch.cat(pictures), None if taken.flat is None else (taken.light, taken.flat)


@dataclass(frozen=True)
class Taken:
    """What a step found.

    values: of the total and its terms, means over the batch, by name. pictures, shown: (R,3,H,W) of the rows that this
    process had, and their scenes.
    """

    values: dict[str, float]
    pictures: Tensor
    shown: Tensor


def gradients(
    camera: Camera,
    loss: StyleLoss,
    scene: Scene,
    generator: Generators,
    *,
    parameters: Sequence[nn.Parameter],
    turn: int,
    emphasis: float,
    mark: Mark,
) -> Taken:
    """The loss of a batch, its mean over the rows, and its gradient as `grad` of these parameters.

    Args:      emphasis: factor of the content term. mark: told what was done since it was told before.
    """
    rank, world = place()
    taken = record(camera, scene, recorded=bool(loss.weights["l2"]))
    light, shown = taken.light, scene.to_srgb()
    mark("camera")
    behind = {p for stage in taken.stages for p in stage.parameters()}
    behind_trained = [p for p in parameters if p in behind]
    pictures, values, slopes, rows = [], [], [], range(rank, len(light), world)
    for row in rows:
        signal = light[row : row + 1].detach().requires_grad_(light.requires_grad)
        pictures.append(taken.develop(signal, row, generator))
        mark("camera")
        pair = None if taken.flat is None else (signal, taken.flat[row : row + 1])
        terms = loss.terms(pictures[-1], shown[row : row + 1], recorded=pair, turn=turn)
        if "content" in terms:
            terms["content"] = terms["content"] * emphasis
        total = torch.stack(list(terms.values())).sum()
        values.append(torch.stack([total, *terms.values()]).detach().double())
        mark("loss")
        slopes.append(_slopes(total / len(light), [signal, *behind_trained]))
        mark("gradient")
    found = gathered(torch.stack(values), world).mean(0).tolist()
    all_slopes = gathered(torch.stack(slopes), world)
    onto_light, of_parameters = all_slopes.split([light[0].numel(), all_slopes.shape[1] - light[0].numel()], dim=1)
    trained = _unflatten(of_parameters.sum(0), behind_trained)
    for parameter in parameters:
        parameter.grad = trained.get(parameter)
    if light.requires_grad:
        before = [p for p in parameters if p.requires_grad]
        through = torch.autograd.grad(light, before, onto_light.view_as(light), allow_unused=True)
        for parameter, slope in zip(before, through, strict=True):
            if slope is not None:
                slope = of_the_first(slope, world)
                parameter.grad = slope if parameter.grad is None else parameter.grad + slope
    mark("gradient")
    names = ("total", *terms)
    return Taken(dict(zip(names, found, strict=True)), torch.cat(pictures).detach(), shown[list(rows)])


def _slopes(total: Tensor, of: Sequence[Tensor]) -> Tensor:
    """The gradient of a number, in one row; 0 for what it does not depend on."""
    asked = [value for value in of if value.requires_grad]
    found = iter(torch.autograd.grad(total, asked, allow_unused=True) if total.requires_grad else [None] * len(asked))
    slopes = [next(found) if value.requires_grad else None for value in of]
    flat = [torch.zeros_like(v) if slope is None else slope for v, slope in zip(of, slopes, strict=True)]
    return torch.cat([slope.flatten() for slope in flat])


def _unflatten(flat: Tensor, parameters: Sequence[nn.Parameter]) -> dict[nn.Parameter, Tensor]:
    parts = flat.split([p.numel() for p in parameters])
    return {p: part.view_as(p) for p, part in zip(parameters, parts, strict=True)}
