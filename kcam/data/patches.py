"""A store of patches that trains fast and can be trusted: one memory-mapped uint16 array per scene, and a manifest.

    patches/train/manifest.json
    patches/train/scenes/<scene>.npy       (N, L, size, size) uint16; value = number * scale, scale in the manifest
    patches/val/...

Whatever the folder, the time, the machine, the number of workers, the shards or the interruptions, the bytes are the
same. While it is being made, a folder .work holds a plan and a record of each scene that is done; the end removes it.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from kcam.data.cube import SUFFIX, CubeError, Source, open_cube
from kcam.files import replace, replacing
from kcam.units import nm

VERSION = 1
TOP = 65535
WORK = ".work"
_HEADER = 128  # bytes before the values of a .npy of this shape


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
        if not shares or min(shares) < 0 or abs(sum(shares) - 1) > 1e-6:
            raise StoreError(f"the shares of the split must be >= 0 and sum to 1, got {shares}.")
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
    """A scene of a plan: where it is, and what its header said."""

    name: str
    path: str
    group: str
    split: str
    shape: tuple[int, int, int]
    bytes: int


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
        scenes = [[job.name, job.group, job.split, job.shape, job.bytes] for job in self.scenes]
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
    height, width = shape
    rows = range(0, height - settings.size + 1, settings.stride)
    return [(y, x) for y in rows for x in range(0, width - settings.size + 1, settings.stride)]


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


def make_plan(cubes: Path, settings: Settings) -> StorePlan:
    """Plan a store from a folder of cube files, from their headers alone.

    Raises:    StoreError where there is no cube to read.
    """
    paths = sorted(cubes.glob(f"*{SUFFIX}")) if cubes.is_dir() else [cubes]
    paths = [path for path in paths if not path.name.startswith(".")]
    if not paths:
        raise StoreError(f"there are no cubes ({SUFFIX}) in {cubes}. Make some with data_tools/convert_cubes.py.")
    sources: dict[str, tuple[Path, Source]] = {}
    failed: dict[str, str] = {}
    for path in paths:
        try:
            sources[path.stem] = (path, _opened(path))
        except (CubeError, OSError) as error:
            failed[path.stem] = str(error)
    if not sources:
        raise StoreError(f"none of the {len(paths)} files in {cubes} is a cube: {next(iter(failed.values()))}")
    grids = Counter(tuple(np.round(source.wavelengths / nm, 4)) for _, source in sources.values())
    grid = min(grids, key=lambda found: (-grids[found], found))
    jobs = []
    for name, (path, source) in sources.items():
        if tuple(np.round(source.wavelengths / nm, 4)) != grid:
            failed[name] = f"its {len(source.wavelengths)} bands are others than the {len(grid)} of most cubes here."
            continue
        if min(source.shape[1:]) < settings.size:
            failed[name] = f"it is {source.shape[1]} x {source.shape[2]}, smaller than a patch of {settings.size}."
            continue
        group = group_of(name, source.facts, settings.group)
        jobs.append(
            SceneJob(name, str(path), group, split_of(group, settings.split), source.shape, path.stat().st_size)
        )
    return StorePlan(settings, grid, tuple(sorted(jobs, key=lambda job: job.name)), failed)


def _opened(path: Path) -> Source:
    try:
        return open_cube(path)
    except (CubeError, OSError):
        raise
    except Exception as error:
        raise CubeError(f"it cannot be read: {type(error).__name__}: {str(error).splitlines()[:1]}") from error


# ---- one scene -----------------------------------------------------------------------------------------------------


def extract_scene(job: SceneJob, settings: Settings, folder: Path) -> dict[str, Any]:
    """Write the patches of one scene; returns its record for the manifest. No more than a few strips are in memory."""
    source = _opened(Path(job.path))
    if source.shape != job.shape:
        raise CubeError(f"it is {source.shape} now and was {job.shape} when the store was planned.")
    bands, height, width = source.shape
    scale = _brightest(source, settings.size)
    found = positions((height, width), settings)
    kept: list[list[int]] = []
    dropped = {"invalid": 0, "empty": 0, "saturated": 0, "flat": 0}
    sums, squares = [0] * bands, [0] * bands
    digest = hashlib.sha256()
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{job.name}.npy"
    size = settings.size
    with replacing(target) as temporary, temporary.open("wb") as file:
        file.write(bytes(_HEADER))
        for top, values, valid in _strips(source, settings):
            for y, x in found:
                if y != top:
                    continue
                patch = values[:, :, x : x + size]
                reason = _reason(patch, None if valid is None else valid[:, x : x + size], scale, settings)
                if reason:
                    dropped[reason] += 1
                    continue
                numbers = np.rint(np.clip(patch, 0, scale) * np.float32(TOP / scale)).astype("<u2")
                file.write(numbers.tobytes())
                kept.append([y, x])
                whole = numbers.reshape(bands, -1).astype(np.uint64)
                for band in range(bands):
                    sums[band] += int(whole[band].sum())
                    squares[band] += int((whole[band] * whole[band]).sum())
        file.seek(0)
        header = {"descr": "<u2", "fortran_order": False, "shape": (len(kept), bands, size, size)}
        np.lib.format.write_array_header_1_0(file, header)
        if file.tell() != _HEADER:
            raise StoreError(f"the header of {target.name} takes {file.tell()} bytes, not {_HEADER}.")
        file.flush()
        with temporary.open("rb") as whole_file:
            for block in iter(lambda: whole_file.read(2**22), b""):
                digest.update(block)
    return {
        "scene": job.name,
        "group": job.group,
        "split": job.split,
        "file": f"scenes/{job.name}.npy",
        "sha256": digest.hexdigest(),
        "count": len(kept),
        "candidates": len(found),
        "dropped": dropped,
        "scale": float(scale) / TOP,
        "positions": kept,
        "sum": sums,
        "sum_of_squares": squares,
        "shape": list(job.shape),
        "unit": source.unit,
        "extrapolated": [] if source.extrapolated is None else np.flatnonzero(source.extrapolated).tolist(),
        "source": source.facts,
    }


def _brightest(source: Source, strip: int) -> np.float32:
    """The largest valid value: what 65535 stands for."""
    high = np.float32(0)
    for first in range(0, source.shape[1], strip):
        values, _ = source.checked_rows(first, min(first + strip, source.shape[1]))
        high = max(high, values.max())
    if not high > 0:
        raise CubeError("it is black: no value is above 0.")
    return np.float32(high)


def _strips(source: Source, settings: Settings) -> Iterator[tuple[int, np.ndarray, np.ndarray | None]]:
    """(y, rows y to y + size, their valid pixels); rows that two strips share are read once."""
    size, stride = settings.size, settings.stride
    values, valid = np.empty((0,)), np.empty((0,))
    last = 0
    for top in range(0, source.shape[1] - size + 1, stride):
        keep = max(0, last - top)
        new, pixels = source.checked_rows(top + keep, top + size)
        marks = np.ones(new.shape[1:], bool) if pixels is None else pixels
        if keep:
            values = np.concatenate([values[:, -keep:], new], axis=1)
            valid = np.concatenate([valid[-keep:], marks])
        else:
            values, valid = new, marks
        last = top + size
        yield top, values, None if valid.all() else valid


def _reason(patch: np.ndarray, valid: np.ndarray | None, scale: np.float32, settings: Settings) -> str | None:
    """Why a patch is left out, or None."""
    if valid is not None and 1 - valid.mean() > settings.max_invalid:
        return "invalid"
    gray = patch.mean(0, dtype=np.float64)
    mean = float(gray.mean())
    if mean < settings.min_mean * float(scale):
        return "empty"
    if float((patch >= scale).any(0).mean()) > settings.max_clipped:
        return "saturated"
    return "flat" if float(gray.std()) < settings.min_contrast * mean else None


# ---- the store -----------------------------------------------------------------------------------------------------


@dataclass
class Outcome:
    """What a run did. done, skipped: scenes made now, and found done. failed: scene to reason. finished: the manifests
    are written.
    """

    done: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    finished: bool = False
    patches: int = 0
    dropped: dict[str, int] = field(default_factory=dict)


def extract(
    plan: StorePlan,
    out: Path,
    *,
    workers: int = 1,
    resume: bool = False,
    shard: tuple[int, int] | None = None,
    advance: Callable[[str, int], None] | None = None,
    submit: Callable[..., Any] | None = None,
) -> Outcome:
    """Make a store, or go on with one.

    Args:      workers: processes. shard: (i, n), every n-th scene from the i-th, 1 <= i <= n; a run with resume and no
               shard then completes the manifests. advance: told of each scene that is done, and its bytes.
               submit: of an executor with futures of its own, such as that of a `dask.distributed.Client`.
    Raises:    StoreError for a folder that holds something else, a store of another plan, or too small a disk.
    """
    outcome = Outcome(failed=dict(plan.failed))
    work = out / WORK
    finished = _finished(out)
    if finished is not None:
        if not resume:
            raise StoreError(f"{out} holds a store already. Use another folder, or --resume.")
        if finished != plan.hash:
            raise StoreError(f"{out} holds a store of other cubes or settings. Use another folder.")
        outcome.finished, outcome.skipped = True, [job.name for job in plan.scenes]
        return outcome
    if out.exists() and any(out.iterdir()):
        begun = (work / "plan.json").is_file()
        if not begun or not (resume or shard):
            fix = "--resume goes on with it" if begun else "choose an empty folder"
            raise StoreError(f"{out} is not empty; {fix}.")
        if json.loads((work / "plan.json").read_text())["hash"] != plan.hash:
            raise StoreError(f"{out} was begun with other cubes or settings. Use another folder, or the same ones.")
    else:
        _check_disk(plan, out)
    (work / "done").mkdir(parents=True, exist_ok=True)
    replace(work / "plan.json", json.dumps({"hash": plan.hash}).encode())
    jobs = [job for index, job in enumerate(plan.scenes) if shard is None or index % shard[1] == shard[0] - 1]
    waiting = []
    for job in jobs:
        if _done(job, plan.settings, out) is None:
            waiting.append(job)
        else:
            outcome.skipped.append(job.name)
            if advance:
                advance(job.name, job.bytes)
    for job, failure in _run(waiting, plan.settings, out, workers=workers, submit=submit):
        if failure is None:
            outcome.done.append(job.name)
        else:
            outcome.failed[job.name] = failure
        if advance:
            advance(job.name, job.bytes)
    outcome.done.sort()
    if shard is None:
        _finish(plan, out, outcome)
    return outcome


def _run(
    jobs: Sequence[SceneJob], settings: Settings, out: Path, *, workers: int, submit: Callable[..., Any] | None
) -> Iterator[tuple[SceneJob, str | None]]:
    """Each job and why it failed, or None, as they are done."""
    if submit is not None:
        futures = {job: submit(work_on, job, settings, str(out)) for job in jobs}
        for job, future in futures.items():
            yield job, future.result()
    elif workers <= 1 or len(jobs) <= 1:
        for job in jobs:
            yield job, work_on(job, settings, str(out))
    else:
        with ProcessPoolExecutor(min(workers, len(jobs)), mp_context=get_context("spawn")) as pool:
            running = {pool.submit(work_on, job, settings, str(out)): job for job in jobs}
            for future in as_completed(running):
                yield running[future], future.result()


def work_on(job: SceneJob, settings: Settings, out: str) -> str | None:
    """One scene: its patches, then its record. Returns why it failed, or None."""
    try:
        record = extract_scene(job, settings, Path(out) / job.split / "scenes")
        replace(Path(out) / WORK / "done" / f"{job.name}.json", json.dumps(record, sort_keys=True).encode())
    except (CubeError, StoreError) as error:
        return str(error)
    except OSError as error:
        return f"{type(error).__name__}: {error.strerror or error}"
    return None


def _done(job: SceneJob, settings: Settings, out: Path) -> dict[str, Any] | None:
    """The record of a scene that is done: it is whole, and its file has the right size."""
    try:
        record = json.loads((out / WORK / "done" / f"{job.name}.json").read_text())
        expected = _HEADER + record["count"] * job.shape[0] * settings.size**2 * 2
        return record if (out / job.split / record["file"]).stat().st_size == expected else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _finish(plan: StorePlan, out: Path, outcome: Outcome) -> None:
    """Write the manifests, and take away what was only there to go on with."""
    records = [record for job in plan.scenes if (record := _done(job, plan.settings, out)) is not None]
    if not records:
        raise StoreError(f"none of the scenes could be cut: {next(iter(outcome.failed.values()), 'there are none')}")
    for name, _ in plan.settings.split:
        own = [record for record in records if record["split"] == name]
        if not own:
            outcome.warnings.append(f"the split {name} received no scene: there are too few groups for its share.")
        folder = out / name
        folder.mkdir(parents=True, exist_ok=True)
        for left in (folder / "scenes").glob(".*.tmp"):
            left.unlink()
        replace(folder / MANIFEST, _manifest(plan, name, own, sorted(outcome.failed)))
    outcome.patches = sum(record["count"] for record in records)
    for record in records:
        for reason, count in record["dropped"].items():
            outcome.dropped[reason] = outcome.dropped.get(reason, 0) + count
    shutil.rmtree(out / WORK / "done")
    (out / WORK / "plan.json").unlink()  # last, so that an interrupted end can be gone on with
    (out / WORK).rmdir()
    outcome.finished = True


MANIFEST = "manifest.json"


def _manifest(plan: StorePlan, split: str, records: list[dict[str, Any]], failed: list[str]) -> bytes:
    """All that is known of one split, as bytes that depend on nothing else."""
    bands, size = len(plan.wavelengths), plan.settings.size
    pixels = sum(record["count"] for record in records) * size**2
    total, squares = np.zeros(bands), np.zeros(bands)
    for record in records:
        total += record["scale"] * np.asarray(record["sum"], dtype=np.float64)
        squares += record["scale"] ** 2 * np.asarray(record["sum_of_squares"], dtype=np.float64)
    mean = total / max(pixels, 1)
    deviation = np.sqrt(np.maximum(squares / max(pixels, 1) - mean**2, 0))
    hidden = ("sum", "sum_of_squares", "split")
    document = {
        "kcam_patches": VERSION,
        "split": split,
        "plan": plan.hash,
        "settings": asdict(plan.settings),
        "wavelengths_nm": list(plan.wavelengths),
        "dtype": "<u2",
        "patch": [bands, size, size],
        "patches": sum(record["count"] for record in records),
        "mean": mean.tolist(),
        "deviation": deviation.tolist(),
        "failed": failed,
        "scenes": [{key: value for key, value in record.items() if key not in hidden} for record in records],
    }
    return (json.dumps(document, indent=1, sort_keys=True) + "\n").encode()


def _finished(out: Path) -> str | None:
    """The plan's hash of a finished store; None where there is none, or it is still being made."""
    if (out / WORK).exists():
        return None
    for path in sorted(out.glob(f"*/{MANIFEST}")):
        try:
            return str(json.loads(path.read_text())["plan"])
        except (OSError, ValueError, KeyError, TypeError):
            continue
    return None


def _check_disk(plan: StorePlan, out: Path) -> None:
    existing = next(folder for folder in (out, *out.resolve().parents) if folder.exists())
    free = shutil.disk_usage(existing).free
    if plan.most_bytes > 0.95 * free:
        raise StoreError(
            f"up to {plan.most_bytes / 1e9:.3g} GB are needed and {free / 1e9:.3g} GB are free. Use a larger "
            "stride, or another disk."
        )


# ---- reading and checking ------------------------------------------------------------------------------------------


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of one split.

    Raises:    FileNotFoundError; StoreError for one that is damaged or of another version.
    """
    path = folder / MANIFEST
    if not path.is_file():
        splits = sorted(str(found.parent) for found in folder.glob(f"*/{MANIFEST}"))
        fix = f" Open one of its splits: {', '.join(splits)}." if splits else " Make one with extract_patches."
        raise FileNotFoundError(f"there is no {MANIFEST} in {folder}.{fix}")
    try:
        document = json.loads(path.read_text())
        if document["kcam_patches"] != VERSION:
            raise StoreError(f"{path} is of version {document['kcam_patches']}; this kcam reads {VERSION}.")
        bands, height, width = (int(size) for size in document["patch"])
        if len(document["wavelengths_nm"]) != bands or height != width or document["dtype"] != "<u2":
            raise StoreError(f"{path} does not fit together.")
        for record in document["scenes"]:
            count, positions_, scale = record["count"], record["positions"], record["scale"]
            if len(positions_) != count or not scale > 0 or not re.fullmatch(r"scenes/[^/\\]+\.npy", record["file"]):
                raise StoreError(f"{path}: the entry of {record['scene']} does not fit together.")
    except (ValueError, KeyError, TypeError) as error:
        if isinstance(error, StoreError):
            raise
        raise StoreError(f"{path} is damaged: {error}.") from error
    return document


def scene_array(folder: Path, document: dict[str, Any], record: dict[str, Any]) -> np.ndarray:
    """The patches of one scene, mapped: nothing is read until it is asked for. StoreError where they do not fit."""
    shape = (record["count"], *document["patch"])
    path = folder / record["file"]
    expected = _HEADER + int(np.prod(shape, dtype=np.int64)) * 2
    try:
        if path.stat().st_size != expected:
            raise StoreError(f"{path} has {path.stat().st_size} bytes, expected {expected}: it is cut off or another.")
        if not record["count"]:
            return np.empty(shape, "<u2")
        found = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError) as error:
        if isinstance(error, StoreError):
            raise
        raise StoreError(f"{path} cannot be read: {error}.") from error
    if found.shape != shape or found.dtype != np.dtype("<u2"):
        raise StoreError(f"{path} holds {found.shape} of {found.dtype}, expected {shape} of uint16.")
    return found


def verify(store: Path) -> list[str]:
    """What is wrong with a store, a line each; nothing where all files are as they were written.

    Every file against its sha256, no file too many, no group of scenes in two splits, one plan.
    """
    folders = [store] if (store / MANIFEST).is_file() else sorted(path.parent for path in store.glob(f"*/{MANIFEST}"))
    problems = []
    if (store / WORK).exists():
        problems.append(f"{store} is not finished: go on with extract_patches --resume.")
    if not folders:
        return [*problems, f"{store} holds no {MANIFEST}: it is no patch store."]
    groups: dict[str, str] = {}
    plans = set()
    for folder in folders:
        try:
            document = read_manifest(folder)
        except (StoreError, OSError) as error:
            problems.append(str(error))
            continue
        plans.add(document["plan"])
        known = {folder / record["file"] for record in document["scenes"]}
        problems += [
            f"{path} is in no manifest." for path in sorted((folder / "scenes").glob("*")) if path not in known
        ]
        for record in document["scenes"]:
            other = groups.setdefault(record["group"], folder.name)
            if other != folder.name:
                problems.append(f"the group {record['group']} stands in {other} and in {folder.name}.")
            problems += _file_problems(folder, document, record)
    if len(plans) > 1:
        problems.append("the splits are of different plans.")
    return problems


def _file_problems(folder: Path, document: dict[str, Any], record: dict[str, Any]) -> list[str]:
    try:
        scene_array(folder, document, record)
        digest = hashlib.sha256()
        with (folder / record["file"]).open("rb") as file:
            for block in iter(lambda: file.read(2**22), b""):
                digest.update(block)
    except (StoreError, OSError) as error:
        return [str(error)]
    if digest.hexdigest() != record["sha256"]:
        return [f"{folder / record['file']} is not what was written: its sha256 differs."]
    return []
