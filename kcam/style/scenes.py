"""What a camera is trained on: scenes that are drawn by seed and step alone."""

from __future__ import annotations

import copy
import functools
import os
from collections.abc import Sequence
from typing import Any, Protocol

import torch

from kcam import spectral
from kcam.data import PatchDataset
from kcam.scene import PHOTOGRAPHS, Scene
from kcam.style.generators import philox

SCALES = (2.0, 1.0, 0.7, 0.4)
"""Of the built-in photographs: strokes are as wide whatever the scale of what they show."""
DIMMEST, BRIGHTEST = -3.0, 0.3
"""Stops by which half of the scenes are lit otherwise: a camera meets dark pictures too."""
TINT = 1.5
"""Stops by which the colours of half of the scenes are changed: four photographs hold few."""
DISTANCE = 2.0


class Source(Protocol):
    """Where training scenes come from: the same ones for the same seed, step and rows, in any order."""

    def __len__(self) -> int:
        """How many scenes make an epoch."""
        ...

    def draw(self, rows: Sequence[int], *, seed: int, step: int) -> tuple[Scene, list[str]]:
        """These rows of a step's batch as one Scene, and where each was taken from."""
        ...


class BuiltinScenes:
    """Square crops of the built-in photographs, 2 m away, at four scales.

    So that a camera that saw four photographs can take others, half of the crops are mirrored, half lit by up to 3
    stops less, and half in other colours: channels swapped, and each dimmed by up to 1.5 stops.

    Args:      size: of the crops [pixels], at most 300.
               names: of the photographs; by default all.
    Raises:    ValueError for an unknown name, or a size that no photograph holds.
    """

    def __init__(self, size: int, *, names: Sequence[str] = tuple(PHOTOGRAPHS)) -> None:
        self.size = size
        self.scenes: list[tuple[str, Scene]] = []
        for name in names:
            if name not in PHOTOGRAPHS:
                raise ValueError(f"no built-in photograph {name!r}. There are: {', '.join(PHOTOGRAPHS)}.")
            for scale in SCALES:
                scene = _photograph(name, scale)
                if 1 <= size <= min(scene.shape[1:]):
                    self.scenes.append((f"{name} at {scale:g}", scene))
        if not self.scenes:
            raise ValueError(f"no built-in photograph holds a crop of {size} pixels. Use a size of at most 300.")

    def __len__(self) -> int:
        return sum((scene.shape[1] // self.size) * (scene.shape[2] // self.size) for _, scene in self.scenes)

    def draw(self, rows: Sequence[int], *, seed: int, step: int) -> tuple[Scene, list[str]]:
        """As in `Source`."""
        planes, origins = [], []
        for row in rows:
            random = philox(seed, step, stream=row)
            name, scene = self.scenes[random.integers(len(self.scenes))]
            top, left = (int(random.integers(length - self.size + 1)) for length in scene.shape[1:])
            crop = scene.coefficients[..., top : top + self.size, left : left + self.size]
            if random.integers(2):
                crop = crop * 2 ** random.uniform(DIMMEST, BRIGHTEST)
            if random.integers(2):
                stops = torch.from_numpy(random.uniform(-TINT, BRIGHTEST, 3)).to(crop)
                crop = crop[:, random.permutation(3)] * (2**stops)[:, None, None]
            crop = crop.clamp(max=1)
            planes.append(crop.flip(-1) if random.integers(2) else crop)
            origins.append(f"{name}, row {top}, column {left}")
        _, first = self.scenes[0]
        spectra, wavelengths, light = copy.deepcopy((first.spectra, first.wavelengths, first.illuminant))
        return Scene(torch.cat(planes), spectra, wavelengths, DISTANCE, light), origins


@functools.lru_cache(maxsize=32)
def _photograph(name: str, scale: float) -> Scene:
    whole = Scene.builtin(name).with_depth(DISTANCE)
    return whole.resized(round(max(whole.shape[1:]) * scale))


class PatchScenes:
    """Patches of a store that `data_tools/extract_patches.py` wrote, 2 m away; on reflectances daylight falls.

    Half of them are mirrored, and half lit by up to 3 stops less, by a light up to 1.5 stops bluer or redder.

    Args:      patches: the split's folder, or a store, whose "train" is then taken.
               size: side of the crop that is taken of each patch [pixels]; None: the whole patch.
    Raises:    FileNotFoundError, StoreError for what is no store; ValueError for an empty one, or a size that its
               patches do not have.
    """

    def __init__(self, patches: str | os.PathLike[str] | PatchDataset, *, size: int | None = None) -> None:
        self.patches: Any = patches if isinstance(patches, PatchDataset) else PatchDataset(_split(patches))
        if not len(self.patches):
            raise ValueError(f"{self.patches.folder} holds no patches. Extract some: data_tools/extract_patches.py.")
        height, width = self.patches[0].values.shape[1:]
        self.size = min(height, width) if size is None else size
        if self.size > min(height, width):
            raise ValueError(
                f"the patches of {self.patches.folder} have {height} x {width} pixels, and {self.size} are trained on. "
                f"Use --size {min(height, width)}, or extract larger ones."
            )
        self.light = spectral.illuminant("D65", wavelengths=self.patches.wavelengths).float()[:, None, None]
        self.reflecting = {r["scene"] for r in self.patches.scenes if r["unit"] == "reflectance"}

    def __len__(self) -> int:
        return len(self.patches)

    def draw(self, rows: Sequence[int], *, seed: int, step: int) -> tuple[Scene, list[str]]:
        """As in `Source`."""
        values, origins = [], []
        for row in rows:
            random = philox(seed, step, stream=row)
            index = int(random.integers(len(self.patches)))
            patch, _, scene = self.patches[index]
            patch = patch * self.light if scene in self.reflecting else patch
            top, left = (int(random.integers(length - self.size + 1)) for length in patch.shape[1:])
            crop = patch[:, top : top + self.size, left : left + self.size]
            if random.integers(2):
                tilt = torch.linspace(-0.5, 0.5, len(crop)) * random.uniform(-TINT, TINT)
                crop = crop * (2 ** (random.uniform(DIMMEST, BRIGHTEST) + tilt))[:, None, None]
            values.append(crop.flip(-1) if random.integers(2) else crop)
            name, y, x = self.patches.position(index)
            origins.append(f"{name}, row {y + top}, column {x + left}")
        return Scene(torch.stack(values), None, self.patches.wavelengths, DISTANCE), origins


def _split(folder: str | os.PathLike[str]) -> str:
    path = os.fspath(folder)
    train = os.path.join(path, "train")
    return train if os.path.isdir(train) else path
