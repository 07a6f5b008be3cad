"""Patches for training: a torch Dataset over a patch store."""

from __future__ import annotations

import bisect
import operator
import os
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from kcam.data.patches.manifest import read_manifest, scene_array
from kcam.units import nm

MOST_OPEN = 256
"""Files that a data set holds mapped: each is an open file, of which a process often has 1024."""


class Patch(NamedTuple):
    """values: (L,H,W) float32. wavelengths: (L,) float64 [m]. scene: its name.

    Example:
    >>> patch = data.Patch(torch.rand(8, 64, 64), torch.linspace(420, 700, 8) * nm, "wall")
    >>> values, wavelengths, scene = patch
    >>> values.shape, scene
    (torch.Size([8, 64, 64]), 'wall')
    """

    values: Tensor
    wavelengths: Tensor
    scene: str


class PatchDataset(Dataset[Patch]):
    """The patches of one split of a store, in the order of scenes and positions.

    Files are mapped into memory when they are first needed, in each worker of a DataLoader on its own; reading a patch
    touches nothing but its bytes.

    Args:      folder: a split, such as "patches/train".
    Raises:    FileNotFoundError; StoreError for a damaged manifest, and at access for a file that is cut off; at access
               TypeError for an index that is no whole number, IndexError for one beyond the last.

    Example:
    >>> data.write_cube("wall.tif", data.Cube(torch.rand(8, 64, 64), torch.linspace(420, 700, 8) * nm, "reflectance"))
    >>> done = data.extract(data.make_plan(".", data.Settings(size=32, stride=32, split=(("train", 1.0),))), "patches")
    >>> patches = data.PatchDataset("patches/train")
    >>> len(patches), patches[0].values.shape, patches[0].scene
    (4, torch.Size([8, 32, 32]), 'wall')
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self.manifest = read_manifest(self.folder)
        self.scenes: list[dict[str, Any]] = self.manifest["scenes"]
        self.wavelengths = torch.tensor(self.manifest["wavelengths_nm"], dtype=torch.float64) * nm
        self._ends = list(accumulate(record["count"] for record in self.scenes))
        self._arrays: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __getitem__(self, index: int) -> Patch:
        place, number = self._place(index)
        record = self.scenes[place]
        numbers = self._array(place)[number]
        values = torch.from_numpy(numbers.astype(np.float32)).mul_(record["scale"])
        return Patch(values, self.wavelengths, record["scene"])

    def _array(self, place: int) -> np.ndarray:
        """The patches of a scene, mapped; of many scenes those that were asked for last."""
        found = self._arrays.pop(place, None)
        if found is None:
            if len(self._arrays) >= MOST_OPEN:
                del self._arrays[next(iter(self._arrays))]
            found = scene_array(self.folder, self.manifest, self.scenes[place])
        self._arrays[place] = found
        return found

    def position(self, index: int) -> tuple[str, int, int]:
        """Where a patch was cut: (scene, y, x) of its top left pixel."""
        place, number = self._place(index)
        y, x = self.scenes[place]["positions"][number]
        return self.scenes[place]["scene"], y, x

    @property
    def mean(self) -> Tensor:
        """Of each band over the split, (L,) float64."""
        return torch.tensor(self.manifest["mean"], dtype=torch.float64)

    @property
    def deviation(self) -> Tensor:
        """Standard deviation of each band over the split, (L,) float64."""
        return torch.tensor(self.manifest["deviation"], dtype=torch.float64)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_arrays": {}}

    def _place(self, index: int) -> tuple[int, int]:
        count = len(self)
        try:
            index = operator.index(index)
        except TypeError:
            some = "range(3)" if isinstance(index, slice) else "[0, 2, 5]"
            raise TypeError(
                f"a patch is asked for by a whole number, got {index!r}. For several use "
                f"torch.utils.data.Subset(patches, {some})."
            ) from None
        if not -count <= index < count:
            raise IndexError(f"patch {index} of {count}.")
        index %= count
        place = bisect.bisect_right(self._ends, index)
        return place, index - (self._ends[place - 1] if place else 0)
