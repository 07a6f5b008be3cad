"""A store's own account of itself: a record of each scene while it is made, then a manifest of each split."""

from __future__ import annotations

import hashlib
import json
import math
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypedDict

import numpy as np

from kcam import __version__
from kcam.data.patches.plan import VERSION, SceneJob, Settings, StoreError, StorePlan
from kcam.files import replace
from kcam.plain import from_json
from kcam.units import nm, wavelength_grid

MANIFEST = "manifest.json"
WORK = ".work"
FILE = re.compile(r"scenes/[^/\\]+\.npy")
HEADER = 128
"""Bytes before the values of a .npy of this shape."""


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


def digest(document: dict[str, Any], *, without: str = "sha256") -> str:
    """Of a manifest, or a scene's record, without its own digest."""
    own = {key: value for key, value in document.items() if key != without}
    return hashlib.sha256(json.dumps(own, sort_keys=True).encode()).hexdigest()


def sha256(path: Path) -> str:
    """Of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _place(job: SceneJob, out: Path) -> Path:
    return out / WORK / "done" / f"{job.name}.json"


def write_record(job: SceneJob, record: dict[str, Any], out: Path) -> None:
    """A scene is done: what is known of it."""
    held = record | {"digest": digest(record, without="digest")}
    replace(_place(job, out), json.dumps(held, sort_keys=True).encode())


def read_record(job: SceneJob, settings: Settings, out: Path) -> dict[str, Any] | None:
    """The record of a scene that is done: it is whole, and its file has the right size."""
    path = _place(job, out)
    try:
        record: dict[str, Any] = from_json(path.read_bytes(), _Done, wrong=f"{path} is damaged", hook=None)
        if record["digest"] != digest(record, without="digest"):
            return None
        expected = HEADER + record["count"] * job.shape[0] * settings.size**2 * 2
        return record if (out / job.split / record["file"]).stat().st_size == expected else None
    except (OSError, ValueError):
        return None


def manifest_bytes(plan: StorePlan, split: str, records: list[dict[str, Any]], failed: list[str]) -> bytes:
    """All that is known of one split, as bytes that depend on nothing else."""
    bands, size = len(plan.wavelengths), plan.settings.size
    pixels = sum(record["count"] for record in records) * size**2
    sums, squares = np.zeros(bands), np.zeros(bands)
    for record in records:
        sums += record["scale"] * np.asarray(record["sum"], dtype=np.float64)
        squares += record["scale"] ** 2 * np.asarray(record["sum_of_squares"], dtype=np.float64)
    mean = sums / max(pixels, 1)
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
    return (json.dumps(document | {"sha256": digest(document)}, indent=1, sort_keys=True) + "\n").encode()


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of one split.

    Raises:    FileNotFoundError; StoreError for one that is damaged or of another version.
    """
    path = folder / MANIFEST
    if not path.is_file():
        splits = sorted(str(found.parent) for found in folder.glob(f"*/{MANIFEST}"))
        fix = f" Open one of its splits: {', '.join(splits)}." if splits else " Make one with kcam data extract."
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
    if document["sha256"] != digest(document):
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
    expected = HEADER + int(np.prod(shape, dtype=np.int64)) * 2
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
