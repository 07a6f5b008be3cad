"""What a patch store will hold: the settings, the scenes, and the split that each belongs to."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from kcam.data.cube import SUFFIX, CubeError, Source, open_cube, words_of
from kcam.units import nm

VERSION = 1
"""Of the store's format."""


class StoreError(ValueError):
    """A patch store that cannot be made, continued or read; one line."""


@dataclass(frozen=True)
class Settings:
    """What decides which patches there are.

    size, stride: of the patches [pixels]. split: names and shares, by groups of scenes.
    group: a regular expression on the scene's name; its first group, or all that it matches, names the scene's group.
    min_mean: least mean of a patch, relative to the scene's brightest value. min_contrast: least standard deviation of
        the mean over the bands, relative to its mean. max_clipped: largest share of pixels with a band at the scene's
        brightest value. max_invalid: largest share of invalid pixels, which become 0.
    """

    size: int = 256
    stride: int = 128
    split: tuple[tuple[str, float], ...] = (("train", 0.9), ("val", 0.1))
    group: str | None = None
    min_mean: float = 1e-3
    min_contrast: float = 0.02
    max_clipped: float = 0.05
    max_invalid: float = 0.0

    def __post_init__(self) -> None:
        for name in ("size", "stride"):
            if getattr(self, name) < 1:
                raise StoreError(f"{name} must be 1 pixel or more, got {getattr(self, name)}.")
        shares = [share for _, share in self.split]
        if not shares or min(shares) < 0 or not abs(sum(shares) - 1) <= 1e-6:
            raise StoreError(f"the shares of the split must be >= 0 and sum to 1, got {shares}.")
        for name in ("min_mean", "min_contrast", "max_clipped", "max_invalid"):
            if not 0 <= getattr(self, name) < math.inf:
                raise StoreError(f"{name} must be 0 or more, got {getattr(self, name)}.")
        if self.group is not None:
            try:
                re.compile(self.group)
            except re.error as error:
                raise StoreError(f"group {self.group!r} is no regular expression: {error}.") from error


def parse_split(text: str) -> tuple[tuple[str, float], ...]:
    """Names (train, val, test) and shares from "0.9/0.1" or "0.8/0.1/0.1"."""
    names = ("train", "val", "test")
    try:
        shares = [float(part) for part in text.split("/")]
    except ValueError as error:
        raise StoreError(f"split {text!r} is not shares such as 0.9/0.1.") from error
    if not 1 <= len(shares) <= len(names):
        raise StoreError(f"split {text!r} has {len(shares)} parts, expected 1 to 3: train/val/test.")
    return tuple(zip(names, shares, strict=False))


@dataclass(frozen=True)
class SceneJob:
    """A scene of a plan: where it is, what its header said, and a fingerprint of its file."""

    name: str
    path: str
    group: str
    split: str
    shape: tuple[int, int, int]
    bytes: int
    fingerprint: str


@dataclass(frozen=True)
class StorePlan:
    """What a store will hold. failed: inputs that cannot be part of it, and why."""

    settings: Settings
    wavelengths: tuple[float, ...]
    scenes: tuple[SceneJob, ...]
    failed: dict[str, str] = field(default_factory=dict)

    @property
    def hash(self) -> str:
        """Of everything that decides the bytes of the store."""
        scenes = [[job.name, job.group, job.split, job.shape, job.bytes, job.fingerprint] for job in self.scenes]
        text = json.dumps([VERSION, asdict(self.settings), self.wavelengths, scenes], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def most_patches(self) -> int:
        """Before the filters."""
        return sum(len(positions(job.shape[1:], self.settings)) for job in self.scenes)

    @property
    def most_bytes(self) -> int:
        """On the disk, before the filters."""
        return self.most_patches * len(self.wavelengths) * self.settings.size**2 * 2


def positions(shape: tuple[int, int] | tuple[int, ...], settings: Settings) -> list[tuple[int, int]]:
    """Top left corners (y, x) of the patches that fit into a picture."""
    rows, columns = (starts(length, settings) for length in shape)
    return [(y, x) for y in rows for x in columns]


def starts(length: int, settings: Settings) -> range:
    """Where patches start along a side of a picture."""
    return range(0, length - settings.size + 1, settings.stride)


def split_of(group: str, split: Sequence[tuple[str, float]]) -> str:
    """The split that a group belongs to, by a hash of its name: adding scenes never moves others."""
    place = int.from_bytes(hashlib.sha256(group.encode()).digest()[:8], "big") / 2**64
    total = 0.0
    for name, share in split:
        total += share
        if place < total:
            return name
    return split[-1][0]


def group_of(name: str, facts: dict[str, Any], pattern: str | None) -> str:
    """The group of a scene: what its source says, what the pattern finds in its name, or the name."""
    if pattern is not None:
        found = re.search(pattern, name)
        if found:
            return found[1] if found.groups() and found[1] is not None else found[0]
    return str(facts.get("group", name))


def make_plan(cubes: str | os.PathLike[str], settings: Settings) -> StorePlan:
    """Plan a store from a folder of cube files, from their headers alone.

    Raises:    StoreError where there is no cube to read.
    """
    cubes = Path(cubes)
    paths = sorted(cubes.glob(f"*{SUFFIX}")) if cubes.is_dir() else [cubes]
    paths = [path for path in paths if not path.name.startswith(".")]
    if not paths:
        raise StoreError(f"there are no cubes ({SUFFIX}) in {cubes}. Make some with data_tools/convert_cubes.py.")
    sources: dict[str, tuple[Path, Source]] = {}
    failed: dict[str, str] = {}
    for path in paths:
        try:
            sources[path.stem] = (path, open_cube(path))
        except (CubeError, OSError) as error:
            failed[path.stem] = str(error)
        except Exception as error:
            failed[path.stem] = words_of(error)
    if not sources:
        raise StoreError(f"none of the {len(paths)} files in {cubes} is a cube: {next(iter(failed.values()))}")
    grids = Counter(tuple(np.round(source.wavelengths / nm, 4)) for _, source in sources.values())
    grid = min(grids, key=lambda found: (-grids[found], found))
    jobs = []
    for name, (path, source) in sources.items():
        group = group_of(name, source.facts, settings.group)
        if tuple(np.round(source.wavelengths / nm, 4)) != grid:
            failed[name] = f"its {len(source.wavelengths)} bands are others than the {len(grid)} of most cubes here."
        elif min(source.shape[1:]) < settings.size:
            failed[name] = f"it is {source.shape[1]} x {source.shape[2]}, smaller than a patch of {settings.size}."
        elif re.search(r"[\\\x00-\x1f\ud800-\udfff]", name + group):
            failed[name] = f"its name {name!r} cannot be that of a file everywhere. Rename it."
        else:
            split, place = split_of(group, settings.split), str(path.resolve())
            jobs.append(SceneJob(name, place, group, split, source.shape, path.stat().st_size, _fingerprint(path)))
    return StorePlan(settings, grid, tuple(sorted(jobs, key=lambda job: job.name)), failed)


def _fingerprint(path: Path) -> str:
    """Of 16 blocks of a file, its first and last among them: tells another cube of the same size without reading it."""
    size, digest = path.stat().st_size, hashlib.sha256()
    with path.open("rb") as file:
        for place in range(16):
            file.seek(max(0, size - 4096) * place // 15)
            digest.update(file.read(4096))
    return digest.hexdigest()
