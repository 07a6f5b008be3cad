"""The patches of one scene: what is cut, what is left out, and the file that keeps them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from kcam.data.cube import NOTHING_VALID, CubeError, Source
from kcam.data.patches.manifest import HEADER, sha256
from kcam.data.patches.plan import SceneJob, Settings, StoreError, positions, starts
from kcam.files import replacing

TOP = 65535


def extract_scene(job: SceneJob, settings: Settings, folder: Path) -> dict[str, Any]:
    """Write the patches of one scene; returns its record for the manifest. No more than a few strips are in memory."""
    source = job.open(Path(job.path))
    if source.shape != job.shape:
        raise CubeError(f"it is {source.shape} now and was {job.shape} when the store was planned.")
    bands, height, width = source.shape
    scale = brightest(source, settings.size)
    kept: list[list[int]] = []
    dropped = {"invalid": 0, "empty": 0, "saturated": 0, "flat": 0}
    sums, squares = [0] * bands, [0] * bands
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{job.name}.npy"
    size = settings.size
    with replacing(target) as temporary, temporary.open("wb") as file:
        file.write(bytes(HEADER))
        for top, values, valid in strips(source, settings):
            for x in starts(width, settings):
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
        if file.tell() != HEADER:
            raise StoreError(f"the header of {target.name} takes {file.tell()} bytes, not {HEADER}.")
        file.flush()
        digest = sha256(temporary)
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


def brightest(source: Source, strip: int) -> np.float32:
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


def strips(source: Source, settings: Settings) -> Iterator[tuple[int, np.ndarray, np.ndarray | None]]:
    """(y, rows y to y + size, their valid pixels); rows that two strips share are read once."""
    size, (bands, height, width) = settings.size, source.shape
    values, valid = np.empty((bands, size, width), np.float32), np.empty((size, width), bool)
    last = 0
    for top in starts(height, settings):
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
