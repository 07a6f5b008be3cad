"""A store of patches that trains fast and can be trusted: one memory-mapped uint16 array per scene, and a manifest.

    patches/train/manifest.json
    patches/train/scenes/<scene>.npy       (N, L, size, size) uint16; value = number * scale, scale in the manifest
    patches/val/...

Whatever the folder, the time, the machine, the number of workers, the shards or the interruptions, the bytes are the
same. While it is being made, a folder .work holds a plan and a record of each scene that is done; the end removes it.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import re
import shutil
import signal
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field
from multiprocessing import active_children, connection, get_context, parent_process
from pathlib import Path
from threading import Thread
from typing import Any, TypedDict

import numpy as np

from kcam import __version__
from kcam.data.cube import NOTHING_VALID, SUFFIX, CubeError, Source, open_cube, words_of
from kcam.files import replace, replacing
from kcam.plain import from_json
from kcam.units import nm, wavelength_grid

VERSION = 1
TOP = 65535
WORK = ".work"
FILE = re.compile(r"scenes/[^/\\]+\.npy")
_HEADER = 128  # bytes before the values of a .npy of this shape


class StoreError(ValueError):
    """A patch store that cannot be made, continued or read; one line."""


class StoreStopped(StoreError):
    """A store that is not finished, for a reason that lies in none of its cubes; resume goes on with it."""


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
        if re.search(r"[\\\x00-\x1f\ud800-\udfff]", name + group):
            failed[name] = f"its name {name!r} cannot be that of a file everywhere. Rename it."
            continue
        split, size = split_of(group, settings.split), path.stat().st_size
        jobs.append(SceneJob(name, str(path.resolve()), group, split, source.shape, size, _fingerprint(path, size)))
    return StorePlan(settings, grid, tuple(sorted(jobs, key=lambda job: job.name)), failed)


def _fingerprint(path: Path, size: int) -> str:
    """Of 16 blocks of a file, its first and last among them: tells another cube of the same size without reading it."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        for place in range(16):
            file.seek(max(0, size - 4096) * place // 15)
            digest.update(file.read(4096))
    return digest.hexdigest()


def _opened(path: Path) -> Source:
    try:
        return open_cube(path)
    except (CubeError, OSError):
        raise
    except Exception as error:
        raise CubeError(f"it cannot be read: {words_of(error)}") from error


# ---- one scene -----------------------------------------------------------------------------------------------------


def extract_scene(job: SceneJob, settings: Settings, folder: Path) -> dict[str, Any]:
    """Write the patches of one scene; returns its record for the manifest. No more than a few strips are in memory."""
    source = _opened(Path(job.path))
    if source.shape != job.shape:
        raise CubeError(f"it is {source.shape} now and was {job.shape} when the store was planned.")
    bands, height, width = source.shape
    scale = _brightest(source, settings.size)
    kept: list[list[int]] = []
    dropped = {"invalid": 0, "empty": 0, "saturated": 0, "flat": 0}
    sums, squares = [0] * bands, [0] * bands
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{job.name}.npy"
    size = settings.size
    with replacing(target) as temporary, temporary.open("wb") as file:
        file.write(bytes(_HEADER))
        for top, values, valid in _strips(source, settings):
            for x in range(0, width - size + 1, settings.stride):
                patch = values[:, :, x : x + size]
                reason = _reason(patch, None if valid is None else valid[:, x : x + size], scale, settings)
                if reason:
                    dropped[reason] += 1
                    continue
                numbers = np.rint(np.clip(patch, 0, scale) * np.float32(TOP / scale)).astype("<u2")
                file.write(numbers.tobytes())
                kept.append([top, x])
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
        digest = _sha256(temporary)
    return {
        "scene": job.name,
        "group": job.group,
        "split": job.split,
        "file": f"scenes/{job.name}.npy",
        "sha256": digest,
        "count": len(kept),
        "candidates": len(positions((height, width), settings)),
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


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _brightest(source: Source, strip: int) -> np.float32:
    """The largest valid value: what 65535 stands for."""
    high, any_valid = np.float32(0), False
    for first in range(0, source.shape[1], strip):
        values, valid = source.checked_rows(first, min(first + strip, source.shape[1]))
        high, any_valid = max(high, values.max()), any_valid or valid is None or bool(valid.any())
    if not any_valid:
        raise CubeError(NOTHING_VALID)
    if not high > 1e-30:  # below, 65535 / high leaves float32
        raise CubeError("it is black: no value is above 0.")
    return np.float32(high)


def _strips(source: Source, settings: Settings) -> Iterator[tuple[int, np.ndarray, np.ndarray | None]]:
    """(y, rows y to y + size, their valid pixels); rows that two strips share are read once."""
    size, (bands, height, width) = settings.size, source.shape
    values, valid = np.empty((bands, size, width), np.float32), np.empty((size, width), bool)
    last = 0
    for top in range(0, height - size + 1, settings.stride):
        keep = max(0, last - top)
        for plane in (*values, valid):  # a plane at a time: numpy copies what overlaps
            plane[:keep] = plane[size - keep :]
        values[:, keep:], marks = source.checked_rows(top + keep, top + size)
        valid[keep:] = True if marks is None else marks
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
    are written; found: they were before.
    """

    done: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    finished: bool = False
    found: bool = False
    patches: int = 0
    dropped: dict[str, int] = field(default_factory=dict)


def extract(
    plan: StorePlan,
    out: str | os.PathLike[str],
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
    out = Path(out)
    outcome = Outcome(failed=dict(plan.failed))
    work = out / WORK
    finished = _finished(out)
    if finished is not None:
        if not resume:
            raise StoreError(f"{out} holds a store already. Use another folder, or --resume.")
        if finished["plan"] != plan.hash:
            raise StoreError(f"{out} holds a store of other cubes or settings. Use another folder.")
        shutil.rmtree(work, ignore_errors=True)  # empty, where a run was killed in its last moment
        missing = sorted({*finished["failed"], *plan.failed})
        outcome.finished, outcome.found, outcome.failed = True, True, {}
        outcome.warnings = [f"{name} is not in it: it failed when the store was made." for name in missing]
        outcome.skipped = [job.name for job in plan.scenes if job.name not in missing]
        return outcome
    _check_folder(plan, out, goes_on=resume or shard is not None)
    jobs = [job for index, job in enumerate(plan.scenes) if shard is None or index % shard[1] == shard[0] - 1]
    waiting = [job for job in jobs if _done(job, plan.settings, out) is None]
    _check_disk(plan, waiting, out)
    (work / "done").mkdir(parents=True, exist_ok=True)
    replace(work / "plan.json", json.dumps({"hash": plan.hash}).encode())
    for job in jobs:
        if job not in waiting:
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


def _check_folder(plan: StorePlan, out: Path, *, goes_on: bool) -> None:
    """StoreError for a folder that holds something else than the beginning of this store."""
    if not out.exists():
        return
    if not out.is_dir():
        raise StoreError(f"{out} is a file. Choose a folder.")
    found = {path.name for path in out.iterdir()}
    begun = out / WORK / "plan.json"
    # a run that was killed before it could write its plan leaves the folder of it, and nothing else
    if found and not (begun.is_file() or found == {WORK}):
        raise StoreError(f"{out} is not empty; choose an empty folder.")
    if found and not goes_on:
        raise StoreError(f"{out} is not empty; --resume goes on with it.")
    if begun.is_file():
        how: dict[str, Any] = {"wrong": f"{begun} is damaged", "fix": "Choose an empty folder.", "error": StoreError}
        if from_json(begun.read_bytes(), _Begun, **how)["hash"] != plan.hash:
            raise StoreError(f"{out} was begun with other cubes or settings. Use another folder, or the same ones.")


def _run(
    jobs: Sequence[SceneJob], settings: Settings, out: Path, *, workers: int, submit: Callable[..., Any] | None
) -> Iterator[tuple[SceneJob, str | None]]:
    """Each job and why it failed, or None, as they are done."""
    folder = str(out.resolve())  # a worker may be at home in another folder
    if submit is not None:
        futures = {job: submit(work_on, job, settings, folder) for job in jobs}
        for job, future in futures.items():
            try:
                failure = future.result()
            except StoreError:
                raise
            except Exception as error:
                raise StoreStopped(f"a worker failed at {job.name}: {type(error).__name__}: {error}") from error
            yield job, failure
    elif workers <= 1 or len(jobs) <= 1:
        for job in jobs:
            yield job, work_on(job, settings, folder)
    else:
        yield from _spread(jobs, settings, folder, workers)


def _spread(
    jobs: Sequence[SceneJob], settings: Settings, folder: str, workers: int
) -> Iterator[tuple[SceneJob, str | None]]:
    """`_run` over processes here. They end with this one, however it ends."""
    others = active_children()
    with ProcessPoolExecutor(min(workers, len(jobs)), mp_context=get_context("spawn"), initializer=_as_worker) as pool:
        running = {pool.submit(work_on, job, settings, folder): job for job in jobs}
        try:
            for future in as_completed(running):
                yield running[future], future.result()
        except BrokenProcessPool as error:
            raise StoreStopped("a worker process was killed; out of memory? Go on with fewer --workers.") from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for child in active_children():
                if child not in others:
                    child.terminate()
            raise


def _as_worker() -> None:
    """Leave Ctrl-C to the parent, and end with it: a worker that outlives it would wait for work forever."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:

        def end() -> None:
            connection.wait([parent.sentinel])
            os._exit(1)

        Thread(target=end, daemon=True).start()


def work_on(job: SceneJob, settings: Settings, out: str) -> str | None:
    """One scene: its patches, then its record. Returns why it failed, or None.

    Raises:    StoreStopped where the disk takes no more: that is no fault of the scene.
    """
    try:
        record = extract_scene(job, settings, Path(out) / job.split / "scenes")
        record["digest"] = _digest(record, without="digest")
        replace(Path(out) / WORK / "done" / f"{job.name}.json", json.dumps(record, sort_keys=True).encode())
    except (CubeError, StoreError) as error:
        return str(error)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS):
            raise StoreStopped(f"{job.name} cannot be written: {error.strerror}.") from error
        return f"{type(error).__name__}: {error.strerror or error}"
    except MemoryError:
        return "it does not fit into memory."
    except Exception as error:
        return f"it cannot be read: {words_of(error)}"
    return None


def _done(job: SceneJob, settings: Settings, out: Path) -> dict[str, Any] | None:
    """The record of a scene that is done: it is whole, and its file has the right size."""
    path = out / WORK / "done" / f"{job.name}.json"
    try:
        record: dict[str, Any] = from_json(path.read_bytes(), _Done, wrong=f"{path} is damaged", hook=None)
        if record["digest"] != _digest(record, without="digest"):
            return None
        expected = _HEADER + record["count"] * job.shape[0] * settings.size**2 * 2
        return record if (out / job.split / record["file"]).stat().st_size == expected else None
    except (OSError, ValueError):
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
        elif not any(record["count"] for record in own):
            outcome.warnings.append(f"the split {name} has no patch: the filters left out all of them.")
        folder = out / name
        folder.mkdir(parents=True, exist_ok=True)
        for left in folder.rglob(".*.tmp"):
            left.unlink()
        replace(folder / MANIFEST, _manifest(plan, name, own, sorted(outcome.failed)))
    outcome.patches = sum(record["count"] for record in records)
    for record in records:
        for reason, count in record["dropped"].items():
            outcome.dropped[reason] = outcome.dropped.get(reason, 0) + count
    shutil.rmtree(out / WORK / "done")
    for left in (out / WORK).glob(".*.tmp"):
        left.unlink()
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
    hidden = ("sum", "sum_of_squares", "split", "digest")
    document = {
        "kcam_patches": VERSION,
        "kcam": __version__,
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
    return (json.dumps(document | {"sha256": _digest(document)}, indent=1, sort_keys=True) + "\n").encode()


def _digest(document: dict[str, Any], *, without: str = "sha256") -> str:
    """Of a manifest, or a scene's record, without its own digest."""
    own = {key: value for key, value in document.items() if key != without}
    return hashlib.sha256(json.dumps(own, sort_keys=True).encode()).hexdigest()


def _finished(out: Path) -> dict[str, Any] | None:
    """A manifest of a finished store; None where there is none, or it is still being made."""
    if (out / WORK / "plan.json").exists():
        return None
    for path in sorted(out.glob(f"*/{MANIFEST}")):
        try:
            return read_manifest(path.parent)
        except (OSError, StoreError):
            continue
    return None


def _check_disk(plan: StorePlan, jobs: Sequence[SceneJob], out: Path) -> None:
    """StoreError where the scenes may not fit onto the disk."""
    existing = next(folder for folder in (out, *out.resolve().parents) if folder.exists())
    free = shutil.disk_usage(existing).free
    needed = StorePlan(plan.settings, plan.wavelengths, tuple(jobs)).most_bytes
    if needed > 0.95 * free:
        raise StoreError(
            f"up to {needed / 1e9:.3g} GB are needed and {free / 1e9:.3g} GB are free. Use a larger "
            "stride, or another disk."
        )


# ---- reading and checking ------------------------------------------------------------------------------------------


class _Begun(TypedDict):
    hash: str


class _Record(TypedDict):
    """What is known of a scene."""

    scene: str
    group: str
    file: str
    sha256: str
    count: int
    candidates: int
    dropped: dict[str, int]
    scale: float
    positions: list[list[int]]
    shape: list[int]
    unit: str
    extrapolated: list[int]
    source: dict[str, Any]


class _Done(_Record):
    """And what only the manifest's sums need."""

    split: str
    sum: list[int]
    sum_of_squares: list[int]
    digest: str


class _Shares(TypedDict):
    split: tuple[tuple[str, float], ...]


class _Version(TypedDict):
    kcam_patches: int


class _Manifest(_Version):
    split: str
    plan: str
    settings: _Shares
    wavelengths_nm: list[float]
    dtype: str
    patch: tuple[int, int, int]
    patches: int
    mean: list[float]
    deviation: list[float]
    failed: list[str]
    scenes: list[_Record]
    sha256: str


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of one split.

    Raises:    FileNotFoundError; StoreError for one that is damaged or of another version.
    """
    path = folder / MANIFEST
    if not path.is_file():
        splits = sorted(str(found.parent) for found in folder.glob(f"*/{MANIFEST}"))
        fix = f" Open one of its splits: {', '.join(splits)}." if splits else " Make one with extract_patches."
        raise FileNotFoundError(f"there is no {MANIFEST} in {folder}.{fix}")
    held = path.read_bytes()
    how: dict[str, Any] = {"wrong": f"{path} is damaged", "error": StoreError, "hook": None}
    version = from_json(held, _Version, **how)["kcam_patches"]
    if version != VERSION:
        raise StoreError(f"{path} is of version {version}; this kcam reads {VERSION}.")
    document: dict[str, Any] = from_json(held, _Manifest, **how)
    bands, height, width = document["patch"]
    curves = [len(document[name]) for name in ("wavelengths_nm", "mean", "deviation")]
    if curves != [bands] * 3 or height != width or min(bands, width) < 1 or document["dtype"] != "<u2":
        raise StoreError(f"{path} does not fit together.")
    if document["sha256"] != _digest(document):
        raise StoreError(f"{path} is not what was written: its own sha256 differs.")
    try:
        wavelength_grid([value * nm for value in document["wavelengths_nm"]])
    except ValueError as error:
        raise StoreError(f"{path} is damaged: {error}") from error
    for record in document["scenes"]:
        lengths = [len(place) for place in record["positions"]]
        if lengths != [2] * record["count"] or not 0 < record["scale"] < math.inf or not FILE.fullmatch(record["file"]):
            raise StoreError(f"{path}: the entry of {record['scene']} does not fit together.")
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
    except StoreError:
        raise
    except Exception as error:  # a damaged header is a TypeError, a SyntaxError and others
        raise StoreError(f"{path} cannot be read: {error}.") from error
    if found.shape != shape or found.dtype != np.dtype("<u2"):
        raise StoreError(f"{path} holds {found.shape} of {found.dtype}, expected {shape} of uint16.")
    return found


def verify(store: str | os.PathLike[str]) -> list[str]:
    """What is wrong with a store, or with one split of it, a line each; nothing where all files are as written.

    Every file against its sha256, none missing and none too many (but run logs, *.log), all splits there and of one
    plan, every group of scenes in the split that its name's hash says and in no other.
    """
    store = Path(store)
    one = (store / MANIFEST).is_file()
    folders = [store] if one else sorted(path.parent for path in store.glob(f"*/{MANIFEST}"))
    problems = []
    if (store / WORK).exists():
        problems.append(f"{store} is not finished: go on with extract_patches --resume.")
    if not folders:
        return [*problems, f"{store} holds no {MANIFEST}: it is no patch store."]
    groups: dict[str, str] = {}
    known = {folder / MANIFEST for folder in folders}
    documents = {}
    for folder in folders:
        try:
            documents[folder] = read_manifest(folder)
        except (StoreError, OSError) as error:
            problems.append(str(error))
    for folder, document in documents.items():
        split, shares = document["split"], document["settings"]["split"]
        if not one and split != folder.name:
            problems.append(f"{folder} holds the split {split}.")
        for record in document["scenes"]:
            known.add(folder / record["file"])
            group = record["group"]
            other = groups.setdefault(group, split)
            if other != split:
                problems.append(f"the group {group} stands in {other} and in {split}.")
            elif split_of(group, shares) != split:
                problems.append(f"the group {group} stands in {split} and belongs to {split_of(group, shares)}.")
            problems += _file_problems(folder, document, record)
    if not one:
        expected = {name for document in documents.values() for name, _ in document["settings"]["split"]}
        missing = sorted(name for name in expected if not (store / name / MANIFEST).is_file())
        problems += [f"{store / name} has no {MANIFEST}." for name in missing]
    if len({document["plan"] for document in documents.values()}) > 1:
        problems.append("the splits are of different plans.")
    if len(documents) == len(folders):  # else, all that a damaged manifest speaks of would be too much
        for path in sorted(store.rglob("*")):
            inside = WORK in path.relative_to(store).parts
            if path not in known and not inside and path.suffix != ".log" and not path.is_dir():
                problems.append(f"{path} is in no manifest.")
    return problems


def _file_problems(folder: Path, document: dict[str, Any], record: dict[str, Any]) -> list[str]:
    try:
        scene_array(folder, document, record)
        digest = _sha256(folder / record["file"])
    except (StoreError, OSError) as error:
        return [str(error)]
    if digest != record["sha256"]:
        return [f"{folder / record['file']} is not what was written: its sha256 differs."]
    return []
