"""Making a store, by several processes, in shards, and gone on with after any interruption."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypedDict

from kcam.data.cube import CubeError, words_of
from kcam.data.patches.manifest import MANIFEST, WORK, manifest_bytes, read_manifest, read_record, write_record
from kcam.data.patches.plan import SceneJob, Settings, StoreError, StorePlan
from kcam.data.patches.scene import extract_scene
from kcam.data.workers import Workers
from kcam.files import replace
from kcam.plain import from_json


class StoreStopped(StoreError):
    """A store that is not finished, for a reason that lies in none of its cubes; resume goes on with it."""


class _Begun(TypedDict):
    hash: str


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

    Example:
    >>> data.write_cube("wall.tif", data.Cube(torch.rand(8, 64, 64), torch.linspace(420, 700, 8) * nm, "reflectance"))
    >>> plan = data.make_plan(".", data.Settings(size=32, stride=32, split=(("train", 1.0),)))
    >>> done = data.extract(plan, "patches")
    >>> done.done, done.patches, done.failed
    (['wall'], 4, {})
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
    waiting = [job for job in jobs if read_record(job, plan.settings, out) is None]
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
    with Workers(min(workers, len(jobs))) as pool:
        running = {pool.submit(work_on, job, settings, folder): job for job in jobs}
        try:
            for future in as_completed(running):
                yield running[future], future.result()
        except BrokenProcessPool as error:
            raise StoreStopped("a worker process was killed; out of memory? Go on with fewer --workers.") from error


def work_on(job: SceneJob, settings: Settings, out: str) -> str | None:
    """One scene: its patches, then its record. Returns why it failed, or None.

    Raises:    StoreStopped where the disk takes no more: that is no fault of the scene.
    """
    try:
        write_record(job, extract_scene(job, settings, Path(out) / job.split / "scenes"), Path(out))
    except (CubeError, StoreError) as error:
        return str(error)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS):
            raise StoreStopped(f"{job.name} cannot be written: {error.strerror}.") from error
        return f"{type(error).__name__}: {error.strerror or error}"
    except Exception as error:
        return words_of(error)
    return None


def _finish(plan: StorePlan, out: Path, outcome: Outcome) -> None:
    """Write the manifests, and take away what was only there to go on with."""
    records = [record for job in plan.scenes if (record := read_record(job, plan.settings, out)) is not None]
    if not records:
        raise StoreError(f"none of the scenes could be cut: {next(iter(outcome.failed.values()), 'there are none')}")
    for name, _ in plan.settings.split:
        own = [record for record in records if record["split"] == name]
        if not own:
            outcome.warnings.append(
                f"the split {name} received no scene: there are too few groups for its share. "
                "Try other shares, such as 0.5/0.5: --dry-run shows what they give."
            )
        elif not any(record["count"] for record in own):
            outcome.warnings.append(f"the split {name} has no patch: the filters left out all of them.")
        folder = out / name
        folder.mkdir(parents=True, exist_ok=True)
        for left in folder.rglob(".*.tmp"):
            left.unlink()
        replace(folder / MANIFEST, manifest_bytes(plan, name, own, sorted(outcome.failed)))
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


def _finished(out: Path) -> dict[str, Any] | None:
    """A manifest of a finished store; None where there is none, or it is still being made."""
    if (out / WORK / "plan.json").exists():
        return None
    for path in sorted(out.glob(f"*/{MANIFEST}")):
        with suppress(OSError, StoreError):
            return read_manifest(path.parent)
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
