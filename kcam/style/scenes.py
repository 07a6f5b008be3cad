"""What a camera is trained on: scenes that are drawn by seed and step alone."""

from __future__ import annotations

import copy
import functools
import hashlib
import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from kcam import spectral
from kcam.data import PatchDataset
from kcam.data.patches.plan import fingerprint
from kcam.data.photos import PICTURES, files_in
from kcam.scene import PHOTOGRAPHS, Scene, read_picture
from kcam.style.generators import philox

SCALES = (2.0, 1.0, 0.7, 0.4)
"""Of the built-in photographs: strokes are as wide whatever the scale of what they show."""
DIMMEST, BRIGHTEST = -3.0, 0.3
"""Stops by which half of the scenes are lit otherwise: a camera meets dark pictures too."""
TINT = 1.5
"""Stops by which the colours of half of the scenes are changed: four photographs hold few."""
DISTANCE = 2.0
LONGEST = 512
"""Pixels on the longer side of a user's photograph at scale 1: about as many as the built-in ones have."""
KEPT = 2**30
"""Bytes of photographs that are kept shrunk, of two hundred or so: else each would be decoded for each crop."""


class Source(Protocol):
    """Where training scenes come from: the same ones for the same seed, step and rows, in any order.

    Example:
    >>> class Grays:  # scenes of one's own, for fit(source=Grays())
    ...     def __len__(self): return 1
    ...     def draw(self, rows, *, seed, step):
    ...         return Scene.from_rgb(torch.full((len(rows), 3, 64, 64), 0.5), depth=2.0), ["gray"] * len(rows)
    >>> Grays().draw([0, 1], seed=0, step=0)[0].shape
    (2, 64, 64)
    """

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

    Example:
    >>> from kcam.style import BuiltinScenes
    >>> scene, origins = BuiltinScenes(64, names=["chelsea"]).draw([0, 1], seed=0, step=0)
    >>> scene.shape, scene.depth, len(origins)
    ((2, 64, 64), 2.0, 2)
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
            crop, place = _varied_crop(scene.coefficients, self.size, random)
            planes.append(crop)
            origins.append(f"{name}, {place}")
        return _same_light(self.scenes[0][1], torch.cat(planes)), origins


def _varied_crop(planes: Tensor, size: int, random: np.random.Generator) -> tuple[Tensor, str]:
    """A square of linear RGB planes (1,3,H,W), lit otherwise, in other colours, or mirrored; and where it was."""
    top, left = (int(random.integers(length - size + 1)) for length in planes.shape[2:])
    crop = planes[..., top : top + size, left : left + size]
    if random.integers(2):
        crop = crop * 2 ** random.uniform(DIMMEST, BRIGHTEST)
    if random.integers(2):
        stops = torch.from_numpy(random.uniform(-TINT, BRIGHTEST, 3)).to(crop)
        crop = crop[:, random.permutation(3)] * (2**stops)[:, None, None]
    crop = crop.clamp(max=1)
    return crop.flip(-1) if random.integers(2) else crop, f"row {top}, column {left}"


def _same_light(scene: Scene, planes: Tensor) -> Scene:
    """Planes under the light of a scene; nothing of it is shared."""
    spectra, wavelengths, light = copy.deepcopy((scene.spectra, scene.wavelengths, scene.illuminant))
    return Scene(planes, spectra, wavelengths, DISTANCE, light)


@functools.lru_cache(maxsize=32)
def _photograph(name: str, scale: float) -> Scene:
    whole = Scene.builtin(name).with_depth(DISTANCE)
    return whole.resized(round(max(whole.shape[1:]) * scale))


class PhotoScenes:
    """Square crops of a user's photographs, in folders of any depth, 2 m away, and varied as in `BuiltinScenes`.

    Each is shrunk to 1024, 512, 358 or 205 pixels on its longer side, as far as it is that large and a crop fits; what
    a wide photograph shows is then in a crop, and strokes are as wide whatever the camera that took it. Hidden files
    are ignored. A photograph that turns out to be damaged is warned of (UserWarning), and the next one taken.

    Args:      folder: of PNG, JPEG, TIFF, WebP or BMP files.
               size: of the crops [pixels].
    Attributes: photos: what is trained on.  skipped: names of those that are smaller than a crop, or no pictures, and
               why.  mark: of the photographs' names and contents; other photographs have another.
    Raises:    FileNotFoundError, NotADirectoryError for what is no folder; ValueError for one without photographs, or
               none as large as a crop.

    Example:
    >>> from kcam.style import PhotoScenes
    >>> plots.write_picture(torch.rand(3, 80, 100), "photo.png")
    >>> scenes = PhotoScenes(".", 64)
    >>> len(scenes.photos), scenes.draw([0], seed=0, step=0)[0].shape
    (1, (1, 64, 64))
    """

    def __init__(self, folder: str | os.PathLike[str], size: int) -> None:
        self.folder, self.size = Path(folder), size
        self.photos: list[Path] = []
        self.skipped: dict[str, str] = {}
        self._sides: list[list[int]] = []
        self._kept: dict[int, Tensor] = {}
        self._damaged: set[int] = set()
        self._count = 0
        paths = _pictures(self.folder)
        for path in paths:
            name = path.relative_to(self.folder).as_posix()
            try:
                with Image.open(path) as picture:  # its header alone
                    shape = picture.size
            except Exception:  # a damaged header makes Pillow raise anything
                self.skipped[name] = "it cannot be read as a picture."
                continue
            if min(shape) < size:
                width, height = shape
                self.skipped[name] = f"it has {width} x {height} pixels, and crops of {size} x {size} are trained on."
                continue
            sides = _sides(max(shape), min(shape), size)
            self.photos.append(path)
            self._sides.append(sides)
            self._count += sum((side // size) * (round(side * min(shape) / max(shape)) // size) for side in sides)
        if not self.photos:
            name, reason = next(iter(self.skipped.items()))
            raise ValueError(
                f"none of the {len(paths)} pictures in {self.folder} can be trained on. {name}: {reason} Use larger "
                "pictures, or a smaller --size."
            )
        marks = [f"{path.relative_to(self.folder).as_posix()} {fingerprint(path)}" for path in self.photos]
        self.mark = hashlib.sha256("\n".join(marks).encode()).hexdigest()[:16]
        self._light = Scene.from_rgb(torch.zeros(3, 1, 1), depth=DISTANCE)

    def __len__(self) -> int:
        return self._count

    def draw(self, rows: Sequence[int], *, seed: int, step: int) -> tuple[Scene, list[str]]:
        """As in `Source`."""
        planes, origins = [], []
        for row in rows:
            random = philox(seed, step, stream=row)
            index, whole = self._photo(int(random.integers(len(self.photos))))
            side = self._sides[index][random.integers(len(self._sides[index]))]
            crop, place = _varied_crop(self._shrunk(whole, side), self.size, random)
            planes.append(crop)
            origins.append(f"{self.photos[index].name} at {side} pixels, {place}")
        return _same_light(self._light, torch.cat(planes)), origins

    def _photo(self, index: int) -> tuple[int, Tensor]:
        """A photograph at its largest scale, (1,3,H,W) linear RGB, or the next one that is whole."""
        for following in range(index, index + len(self.photos)):
            place = following % len(self.photos)
            if place in self._damaged:
                continue
            found = self._kept.pop(place, None)
            if found is None:
                try:
                    found = self._read(place)
                except ValueError as error:
                    self._damaged.add(place)
                    warnings.warn(f"{error} The next photograph is taken in its place.", stacklevel=3)
                    continue
            self._kept[place] = found
            while len(self._kept) > 1 and sum(kept.nbytes for kept in self._kept.values()) > KEPT:
                del self._kept[next(iter(self._kept))]
            return place, found
        raise ValueError(f"none of the {len(self.photos)} photographs in {self.folder} can be read.")

    def _read(self, index: int) -> Tensor:
        """In half precision, twice as fine as 8 bits in the dark: what is kept is the same as what is read again."""
        picture = read_picture(self.photos[index]).expand(3, -1, -1)
        whole = Scene.from_rgb(picture, depth=DISTANCE).coefficients
        return self._shrunk(whole, max(self._sides[index])).half()

    def _shrunk(self, planes: Tensor, side: int) -> Tensor:
        return replace(self._light, coefficients=planes.float()).resized(side).coefficients.clamp(min=0)


def _pictures(folder: Path) -> list[Path]:
    """The picture files of a folder and the folders in it."""
    if not folder.is_dir():
        if folder.exists():
            raise NotADirectoryError(f"{folder} is a file. Expected a folder of photographs.")
        raise FileNotFoundError(f"there is no folder {folder}. Expected one of photographs.")
    found = files_in(folder)
    if not found:
        others = sum(path.is_file() and not path.name.startswith(".") for path in folder.rglob("*"))
        more = f", and there are {others} other files" if others else ""
        raise ValueError(f"there is no picture in the folder {folder}: expected {', '.join(PICTURES)}{more}.")
    return found


def _sides(longest: int, shortest: int, size: int) -> list[int]:
    """Longer sides to which a photograph is shrunk: those of the scales that it has and that hold a crop."""
    sides = {min(round(LONGEST * scale), longest) for scale in SCALES}
    fitting = sorted((side for side in sides if round(side * shortest / longest) >= size), reverse=True)
    return fitting or [min(longest, math.ceil(size * longest / shortest))]


class PatchScenes:
    """Patches of a store that `kcam data extract` wrote, 2 m away; on reflectances daylight falls.

    Half of them are mirrored, and half lit by up to 3 stops less, by a light up to 1.5 stops bluer or redder.

    Args:      patches: the split's folder, or a store, whose "train" is then taken.
               size: side of the crop that is taken of each patch [pixels]; None: the whole patch.
    Raises:    FileNotFoundError, StoreError for what is no store; ValueError for an empty one, or a size that its
               patches do not have.

    Example:
    >>> from kcam.style import PatchScenes
    >>> data.write_cube("cube.tif", data.Cube(torch.rand(8, 64, 64), torch.linspace(420, 700, 8) * nm, "reflectance"))
    >>> done = data.extract(data.make_plan(".", data.Settings(size=64, stride=64)), "patches")
    >>> PatchScenes("patches").draw([0, 1], seed=0, step=0)[0].shape
    (2, 64, 64)
    """

    def __init__(self, patches: str | os.PathLike[str] | PatchDataset, *, size: int | None = None) -> None:
        self.patches: Any = patches if isinstance(patches, PatchDataset) else PatchDataset(_split(patches))
        if not len(self.patches):
            raise ValueError(f"{self.patches.folder} holds no patches. Extract some: kcam data extract.")
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
