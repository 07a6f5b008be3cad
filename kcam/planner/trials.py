"""What a choice changes in the noiseless raw: tried out on the scene, or on a few crops of it.

    E^2 = sum_c share_c sum_f | sum_l kappa_cl I_l(f) (H_l(f) - G_l(f)) |^2

is what replacing the transfer functions H by G changes. By Parseval it is the energy of a picture, and is computed as
one: amplitudes added over wavelengths before squaring, inside the camera's own borders, mosaic, layers and full well,
so that none of the caveats of a formula in radial averages applies (numerics note, section 11). It is cheap because a
choice is tried beside others that are cheap: few wavelengths, few layers of depth.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from kcam.camera import Camera
from kcam.context import Context
from kcam.effects import Skippable
from kcam.optics import Imaging
from kcam.planner.plan import ENDS, noiseless_raw, relative_rms, with_imaging
from kcam.scene import Scene
from kcam.sensor import ADC
from kcam.sensor.noise import RandomStage

LARGEST = 320**2  # pixels of a scene that is tried whole
CROP, CROPS = 160, 3  # else: side of the crops [pixels], and how many
MOST = 4  # scenes of a batch


@dataclass(frozen=True)
class Sample:
    """A scene to try choices on, or a crop of one.

    origin: which scene it is of. depth_share: of that scene's range of vergence, that the crop has.
    """

    scene: Scene
    origin: int
    depth_share: float = 1.0


@dataclass(frozen=True)
class Answer:
    """A noiseless raw, and the gradient of each parameter where gradients are wanted."""

    raw: Tensor
    gradients: tuple[Tensor, ...]


class Trials:
    """A camera's noiseless raw of some samples under changes of its Imaging, each computed once.

    Gradients are wanted where autograd is on and a parameter of the raw's stages requires them: then an error is the
    largest of the raw's and of each parameter's gradient. They are those of the mean square between the raw and the
    raw of a camera that does not blur, a picture that a camera may be trained for.
    """

    def __init__(self, camera: Camera, scenes: Sequence[Scene]) -> None:
        self.camera, self.raw_camera = camera, noiseless_raw(camera)
        stages: list[Any] = list(self.raw_camera)
        self.index = next((i for i, stage in enumerate(stages) if isinstance(stage, Imaging)), None)
        self.imaging: Imaging | None = None if self.index is None else stages[self.index]
        self.parameters = [p for p in self.raw_camera.parameters() if p.requires_grad]
        self.gradients = torch.is_grad_enabled() and bool(self.parameters)
        items = [item for scene in scenes for item in _items(scene) if item.coefficients.numel()]
        self.samples = [sample for origin, item in enumerate(items) for sample in _samples(item, origin)]
        self._answers: dict[tuple[Any, ...], list[Answer]] = {}

    def error(self, changes: Mapping[str, Any], against: Mapping[str, Any]) -> float:
        """Relative RMS of the raw (and gradients) of one setting against another's, the worst over the scenes.

        The crops of one scene are one picture: their squares add up.
        """
        worst = 0.0
        ours, theirs = self.answers(changes), self.answers(against)
        for origin in {sample.origin for sample in self.samples}:
            of = [index for index, sample in enumerate(self.samples) if sample.origin == origin]
            pairs = [(join([ours[i].raw for i in of]), join([theirs[i].raw for i in of]))]
            for k in range(len(ours[of[0]].gradients)):
                pairs.append((sum_of(ours[i].gradients[k] for i in of), sum_of(theirs[i].gradients[k] for i in of)))
            worst = max(worst, *(relative_rms(a, b) for a, b in pairs if bool(b.any())), 0.0)
        return worst

    def answers(self, changes: Mapping[str, Any]) -> list[Answer]:
        """The raw of every sample under changes of the Imaging."""
        key = tuple(sorted(changes.items()))
        if key not in self._answers:
            self._answers[key] = [self._answer(sample, changes) for sample in self.samples]
        return self._answers[key]

    def _answer(self, sample: Sample, changes: Mapping[str, Any]) -> Answer:
        with torch.set_grad_enabled(self.gradients):
            raw = self._shoot(sample, changes)
            if not self.gradients or not raw.requires_grad:
                return Answer(raw.detach(), tuple(torch.zeros_like(p) for p in self.parameters if self.gradients))
            with torch.no_grad():
                sharp = self._shoot(sample, {"blur": False})
            loss = (raw - sharp).square().mean() / 2
            found = torch.autograd.grad(loss, self.parameters, allow_unused=True)
        pairs = zip(found, self.parameters, strict=True)
        return Answer(raw.detach(), tuple(torch.zeros_like(p) if g is None else g for g, p in pairs))

    def _shoot(self, sample: Sample, changes: Mapping[str, Any]) -> Tensor:
        return self._with(sample, changes)(sample.scene)

    def _with(self, sample: Sample, changes: Mapping[str, Any]) -> Camera:
        if self.imaging is None:
            return self.raw_camera
        changes = dict(changes)
        if changes.get("layers", 1) > 1:  # of the whole scene's range: as far apart in the sample's
            changes["layers"] = 1 + math.ceil((changes["layers"] - 1) * sample.depth_share)
        return with_imaging(self.raw_camera, **changes)

    # ---- the stages of the sensor --------------------------------------------------------------------------------

    def skippable(self) -> list[int]:
        """Indices of the stages up to the ADC that say what leaving them out would cost, and may be."""
        found = []
        for index, stage in enumerate(self.camera):
            trained = any(p.requires_grad for p in stage.parameters())
            if isinstance(stage, Skippable) and not trained and not isinstance(stage, Imaging):
                found.append(index)
            if isinstance(stage, ENDS):
                break
        return found

    def signals(self, settings: Mapping[str, Any]) -> list[dict[int, tuple[Tensor, Context]]]:
        """For each sample: what every stage up to the ADC is given, without noise, with these optics."""
        result = []
        with torch.no_grad():
            for sample in self.samples:
                camera = self._with(sample, settings)
                context = self.camera.resolve(sample.scene)
                given: dict[int, tuple[Tensor, Context]] = {}
                if self.index != 0:
                    given[0] = (sample.scene.bands(), context)
                index = 0
                for name, signal in camera.steps(sample.scene):
                    index += 1 + name.count(" + ")  # an Imaging that absorbs its filter is one step
                    given[index] = (signal, context)
                result.append(given)
        return result

    def noise(self, given: Mapping[int, tuple[Tensor, Context]]) -> float:
        """Of one sample: sigma of all noise and half a step of the ADC, relative to the raw's RMS."""
        total = 0.0
        for index, stage in enumerate(self.camera):
            if isinstance(stage, RandomStage) and index in given:
                total += stage.error_if_skipped(*given[index]) ** 2
            if isinstance(stage, ADC) and index in given:
                total += 3 * stage.error_if_skipped(*given[index]) ** 2  # half a step is sqrt(3) of its sigma
            if isinstance(stage, ENDS):
                break
        return math.sqrt(total)


def join(pictures: Sequence[Tensor]) -> Tensor:
    """Pictures as one row of numbers."""
    return torch.cat([picture.flatten() for picture in pictures])


def sum_of(tensors: Iterable[Tensor]) -> Tensor:
    """Sum of tensors."""
    return torch.stack(list(tensors)).sum(0)


def _items(scene: Scene) -> list[Scene]:
    """The scenes of a batch, or some of a large one."""
    batch = scene.shape[0]
    chosen = range(batch) if batch <= MOST else sorted({round(i * (batch - 1) / (MOST - 1)) for i in range(MOST)})
    items = []
    for index in chosen:
        depth = scene.depth[index : index + 1] if isinstance(scene.depth, Tensor) else scene.depth
        items.append(replace(scene, coefficients=scene.coefficients[index : index + 1], depth=depth))
    return items


def _samples(scene: Scene, origin: int) -> list[Sample]:
    """A small scene whole; of a large one, crops: the most detailed of each of some strata of detail."""
    if scene.shape[1] * scene.shape[2] <= LARGEST:
        return [Sample(scene, origin)]
    return _crops(scene, origin)


def _crops(scene: Scene, origin: int) -> list[Sample]:
    _, height, width = scene.shape
    size = (min(CROP, height), min(CROP, width))
    found: list[tuple[float, int, Scene]] = []
    for row in range(math.ceil(height / size[0])):
        for column in range(math.ceil(width / size[1])):
            top, left = min(row * size[0], height - size[0]), min(column * size[1], width - size[1])
            crop = scene.crop(top=top, left=left, height=size[0], width=size[1])
            planes = crop.coefficients.detach()
            detail = sum(float(planes.diff(dim=dim).square().mean()) for dim in (-2, -1))
            found.append((detail / max(float(planes.square().mean()), 1e-30), len(found), crop))
    found.sort(key=lambda item: item[:2], reverse=True)
    strata = [found[len(found) * index // CROPS] for index in range(min(CROPS, len(found)))]
    whole = _vergence_range(scene)
    return [Sample(crop, origin, _vergence_range(crop) / whole if whole else 1.0) for _, _, crop in strata]


def _vergence_range(scene: Scene) -> float:
    if not isinstance(scene.depth, Tensor) or not scene.depth.numel():
        return 0.0
    vergence = 1 / scene.depth.detach().double()
    return float(vergence.max() - vergence.min())
