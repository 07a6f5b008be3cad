"""Convert many scenes into cube files: one failing scene does not stop the others."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from kcam.data.bands import resampled
from kcam.data.cube import SUFFIX, CubeError, words_of, write_source
from kcam.data.readers import find_scenes, open_source
from kcam.data.readers.format import Options, scene_name
from kcam.data.workers import Workers


@dataclass(frozen=True)
class Conversion:
    """How scenes are converted.

    format: a name in `readers.FORMATS`, or None where the files say. options: see `readers.Options`.
    bands: target wavelengths [m], or None for the source's own. method, edge: see `bands.resampling`.
    depths: a folder of depth maps [m] for photographs, <scene>.npy (H,W).
    """

    format: str | None = None
    options: Options = field(default_factory=Options)
    bands: np.ndarray | None = None
    method: str = "pchip"
    edge: str = "error"
    depths: Path | None = None


@dataclass
class Report:
    """What came of each scene: facts of those that were written, reasons of those that failed or were passed over."""

    written: dict[str, dict[str, Any]] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)


def convert(
    inputs: Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    how: Conversion | None = None,
    *,
    workers: int = 1,
    advance: Callable[[str, int], None] | None = None,
) -> Report:
    """Convert files, scene folders, or folders of scenes into ``out/<scene>.tif``.

    An old cube of the same name is replaced when the new one is whole. Of two inputs of one name the first is taken.

    Args:      advance: told of each scene that is done, and how many there are.
    """
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    how = how or Conversion()
    found = find_scenes(inputs, apart=how.depths)
    report = Report(failed=found.failed, skipped=found.skipped)
    jobs: dict[str, Path] = {}
    for path in found.scenes:
        name = scene_name(path)
        first = jobs.setdefault(name, path)
        if first is not path:
            report.failed[str(path)] = f"another input is called {name} too: {first}."
    for path, facts in _run(list(jobs.values()), out, how, workers):
        if isinstance(facts, str):
            report.failed[str(path)] = " ".join(facts.split())
        else:
            report.written[str(path)] = facts
        if advance:
            advance(path.name, len(jobs))
    return report


def _run(
    paths: Sequence[Path], out: Path, how: Conversion, workers: int
) -> Iterator[tuple[Path, dict[str, Any] | str]]:
    if workers <= 1 or len(paths) <= 1:
        for path in paths:
            yield path, convert_one(path, out, how)
        return
    left, several = list(paths), list(paths)
    while left:  # a library that crashes takes its process along: what was not done is done again, one by one
        with Workers(min(workers, len(several))) as pool:
            running = {pool.submit(convert_one, path, out, how): path for path in several}
            for future in as_completed(running):
                try:
                    found = future.result()
                except BrokenProcessPool:
                    if len(several) > 1:
                        continue
                    found = "reading it crashed the process: it is damaged."
                left.remove(running[future])
                yield running[future], found
        several = left[:1]


def convert_one(path: Path, out: Path, how: Conversion) -> dict[str, Any] | str:
    """One scene: its facts, or why it failed."""
    name = scene_name(path)
    try:
        options = replace(how.options, bands=how.bands)
        if how.depths is not None:
            options = replace(options, depth=_depth(how.depths / f"{name}.npy"))
        source = open_source(path, format=how.format, options=options)
        if how.bands is not None:
            source = resampled(source, how.bands, method=how.method, edge=how.edge)
        return write_source(out / f"{name}{SUFFIX}", replace(source, name=name))
    except (CubeError, ImportError, FileNotFoundError) as error:
        return str(error)
    except OSError as error:
        return f"{type(error).__name__}: {error.strerror or error}"
    except Exception as error:
        return words_of(error)


def _depth(path: Path) -> np.ndarray:
    """A depth map [m]: (H,W), all above 0, inf allowed."""
    if not path.is_file():
        raise CubeError(f"there is no depth map {path.name} in {path.parent}.")
    try:
        depth = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise CubeError(f"the depth map {path.name} cannot be read: {error}.") from error
    if depth.ndim != 2 or depth.dtype.kind not in "fui" or not (depth > 0).all():
        raise CubeError(f"the depth map {path.name} must be (H,W), all above 0 m, got {depth.shape} of {depth.dtype}.")
    return depth.astype(np.float32)
