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
from kcam.context import Context, applied
from kcam.scene import Scene
from kcam.style.processes import gathered, of_the_first, place
from kcam.texture.losses import StyleLoss

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
            signal = applied(stage, signal, own)
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
        slopes.append(_slopes(total / len(light), [signal, *parameters]))
        mark("gradient")
    found = gathered(torch.stack(values), world).mean(0).tolist()
    _assign(slopes, light=light, parameters=parameters, world=world)
    mark("gradient")
    names = ("total", *terms)
    return Taken(dict(zip(names, found, strict=True)), torch.cat(pictures).detach(), shown[list(rows)])


def _assign(
    slopes: Sequence[Sequence[Tensor | None]], *, light: Tensor, parameters: Sequence[nn.Parameter], world: int
) -> None:
    """Make `grad` of the rows' gradients onto the light and the parameters: behind the light, and through it."""
    depends = torch.tensor([[slope is not None for slope in row] for row in slopes], device=light.device)
    reached = gathered(depends, world).any(0).tolist()
    members = [(index, value) for index, value in enumerate([light[:1], *parameters]) if reached[index]]
    summed: dict[int, Tensor] = {}
    if members:
        flat = gathered(torch.stack([_flat(row, members) for row in slopes]), world)
        for (index, value), part in zip(members, flat.split([v.numel() for _, v in members], dim=1), strict=True):
            summed[index] = (part if index == 0 else part.sum(0)).to(value.dtype)
    for index, parameter in enumerate(parameters, start=1):
        parameter.grad = summed[index].view_as(parameter) if index in summed else None
    if 0 in summed:
        through = torch.autograd.grad(light, parameters, summed[0].view_as(light), allow_unused=True)
        for parameter, slope in zip(parameters, through, strict=True):
            if slope is not None:
                own = of_the_first(slope, world)
                parameter.grad = own if parameter.grad is None else parameter.grad + own


def _slopes(total: Tensor, of: Sequence[Tensor]) -> list[Tensor | None]:
    """The gradient of a number; None for what it does not depend on."""
    asked = [value for value in of if value.requires_grad]
    found = iter(torch.autograd.grad(total, asked, allow_unused=True) if total.requires_grad else [None] * len(asked))
    return [next(found) if value.requires_grad else None for value in of]


def _flat(slopes: Sequence[Tensor | None], members: Sequence[tuple[int, Tensor]]) -> Tensor:
    """Those of the members in one row; 0 for what this row of the batch does not depend on."""
    parts = [slopes[index] for index, _ in members]
    return torch.cat(
        [(torch.zeros_like(v) if part is None else part).flatten() for part, (_, v) in zip(parts, members, strict=True)]
    )
