"""What a patch store will hold: the settings, the scenes, and the split that each belongs to."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from kcam.data.cube import SUFFIX, CubeError, Source, open_cube, words_of
from kcam.units import nm

VERSION = 1
"""Of the store's format."""


class StoreError(ValueError):
    """A patch store that cannot be made, continued or read; one line.

    Example:
    >>> import pathlib
    >>> pathlib.Path("cubes").mkdir()
    >>> data.make_plan("cubes", data.Settings())
    Traceback (most recent call last):
    kcam.data.patches.plan.StoreError: there are no cubes (.tif) in cubes. ...
    """


@dataclass(frozen=True)
class Settings:
    """What decides which patches there are.

    size, stride: of the patches [pixels]. split: names and shares, by groups of scenes.
    group: a regular expression on the scene's name; its first group, or all that it matches, names the scene's group.
    min_mean: least mean of a patch, relative to the scene's brightest value. min_contrast: least standard deviation of
        the mean over the bands, relative to its mean. max_clipped: largest share of pixels with a band at the scene's
        brightest value. max_invalid: largest share of invalid pixels, which become 0.

    Example:
    >>> settings = data.Settings(size=64, stride=32, split=(("train", 0.8), ("test", 0.2)))
    >>> settings.size, dict(settings.split)
    (64, {'train': 0.8, 'test': 0.2})
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
    """A scene of a plan: where it is, what its header said, a fingerprint of its file, and what opens it."""

    name: str
    path: str
    group: str
    split: str
    shape: tuple[int, int, int]
    bytes: int
    fingerprint: str
    open: Callable[[Path], Source] = open_cube


@dataclass(frozen=True)
class StorePlan:
    """What a store will hold. failed: inputs that cannot be part of it, and why. skipped: what is no input, and why."""

    settings: Settings
    wavelengths: tuple[float, ...]
    scenes: tuple[SceneJob, ...]
    failed: dict[str, str] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)

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


Readers = Mapping[str, Callable[[Path], Source]]
"""What opens files that are no cube files, by the ending of their name; another process can be sent it."""


def make_plan(
    cubes: str | os.PathLike[str], settings: Settings, *, readers: Readers | None = None, told: str = ""
) -> StorePlan:
    """Plan a store from a folder of cube files, from their headers alone.

    Args:      cubes: or one file.  readers: of other files there.
               told: what the readers were told, which decides the bytes as much as a file does.
    Raises:    StoreError where there is no cube to read.

    Example:
    >>> data.write_cube("wall.tif", data.Cube(torch.rand(8, 64, 64), torch.linspace(420, 700, 8) * nm, "reflectance"))
    >>> plan = data.make_plan(".", data.Settings(size=32, stride=32))
    >>> [(scene.name, scene.split, scene.shape) for scene in plan.scenes]
    [('wall', 'train', (8, 64, 64))]
    """
    cubes = Path(cubes)
    opened: Readers = {SUFFIX: open_cube, **(readers or {})}
    paths, skipped = _inputs(cubes, opened) if cubes.is_dir() else ([cubes], {})
    if not paths:
        raise StoreError(f"there are no cubes ({', '.join(opened)}) in {cubes}. Make some with kcam data convert.")
    sources: dict[str, tuple[Path, Source]] = {}
    failed: dict[str, str] = {}
    for path in paths:
        if path.stem in sources or path.stem in failed:
            failed[path.name] = f"another file here is called {path.stem} too."
            continue
        try:
            source = opened.get(path.suffix.lower(), open_cube)(path)
            sources[path.stem] = (path, replace(source, rows=_unread))  # an array in memory would stay there
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
            split, place, size = split_of(group, settings.split), str(path.resolve()), path.stat().st_size
            opening = opened.get(path.suffix.lower(), open_cube)
            mark = fingerprint(path, told=told if opening is not open_cube else "")
            jobs.append(SceneJob(name, place, group, split, source.shape, size, mark, opening))
    return StorePlan(settings, grid, tuple(sorted(jobs, key=lambda job: job.name)), failed, skipped)


def _inputs(folder: Path, readers: Readers) -> tuple[list[Path], dict[str, str]]:
    """The files of a folder that are opened, and what else is in it, with the reason; nothing of what is hidden."""
    paths, skipped = [], {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        if path.suffix.lower() in readers:
            paths.append(path)
        else:
            what = "a folder, which is not entered" if path.is_dir() else "no cube"
            skipped[path.name] = f"it is {what}: expected files that end in {', '.join(readers)}."
    return paths, skipped


def _unread(first: int, last: int) -> tuple[np.ndarray, np.ndarray | None]:
    raise CubeError(f"rows {first} to {last} are not read while a store is planned.")


def fingerprint(path: Path, *, told: str = "") -> str:
    """Of 16 blocks of a file, its first and last among them: tells another cube of the same size without reading it.

    told: what else decides what is read of it.
    """
    size, digest = path.stat().st_size, hashlib.sha256(told.encode())
    with path.open("rb") as file:
        for place in range(16):
            file.seek(max(0, size - 4096) * place // 15)
            digest.update(file.read(4096))
    return digest.hexdigest()
