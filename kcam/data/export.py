"""Patch stores for other tools: HDF5 and Zarr. Training reads the store itself, which is faster."""

from __future__ import annotations

import json
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from kcam.data.patches.manifest import read_manifest, scene_array
from kcam.data.patches.plan import StoreError
from kcam.files import replacing
from kcam.units import nm


def export_patches(
    folder: str | os.PathLike[str], path: str | os.PathLike[str], *, advance: Callable[[str, int], None] | None = None
) -> int:
    """Write one split of a store as HDF5 (.h5, .hdf5; the extra `data`) or Zarr (.zarr; the extra `zarr`).

    patches       (N,L,H,W) uint16, a chunk each; value = number * scale of its patch
    scale         (N,) float64
    scene         (N,) int32, its place among the manifest's scenes
    position      (N,2) int32: y, x of the top left pixel
    wavelengths   (L,) float64 [m]
    manifest      the manifest's JSON: in HDF5 a string, in Zarr an attribute

    One patch at a time is in memory, and the path is there only when all of it is.

    Args:      folder: a split, such as "patches/train". advance: told of each scene that is done, and their number.
    Returns:   the number of patches.
    Raises:    FileNotFoundError; StoreError for a damaged store, another suffix, or a path that exists; ImportError.

    Example:
    >>> data.write_cube("wall.tif", data.Cube(torch.rand(8, 64, 64), torch.linspace(420, 700, 8) * nm, "reflectance"))
    >>> done = data.extract(data.make_plan(".", data.Settings(size=32, stride=32, split=(("train", 1.0),))), "patches")
    >>> data.export_patches("patches/train", "train.h5")
    4
    """
    folder, path = Path(folder), Path(path)
    if path.suffix not in WRITERS:
        raise StoreError(f"cannot export to {path.name}: known are {', '.join(WRITERS)}.")
    if path.exists():
        raise StoreError(f"{path} exists already. Use another name.")
    document = read_manifest(folder)
    records = document["scenes"]
    counts = [record["count"] for record in records]
    tables: dict[str, np.ndarray] = {
        "scale": np.repeat([record["scale"] for record in records], counts),
        "scene": np.repeat(np.arange(len(records), dtype=np.int32), counts),
        "position": np.asarray([place for record in records for place in record["positions"]], np.int32).reshape(-1, 2),
        "wavelengths": np.asarray(document["wavelengths_nm"], dtype=np.float64) * nm,
    }
    with WRITERS[path.suffix](path, (sum(counts), *document["patch"]), tables, document) as patches:
        place = 0
        for record in records:
            for patch in scene_array(folder, document, record):
                patches[place] = patch
                place += 1
            if advance:
                advance(record["scene"], len(records))
    return sum(counts)


@contextmanager
def _hdf5(path: Path, shape: tuple[int, ...], tables: dict[str, np.ndarray], document: dict[str, Any]) -> Iterator[Any]:
    try:
        import h5py
    except ImportError as error:
        raise ImportError("HDF5 needs h5py: pip install 'kcam[data]'.") from error
    with replacing(path) as temporary, h5py.File(temporary, "w") as file:
        for name, values in tables.items():
            file.create_dataset(name, data=values, track_times=False)
        file.create_dataset("manifest", data=json.dumps(document, sort_keys=True), track_times=False)
        chunks = (1, *shape[1:]) if shape[0] else None
        yield file.create_dataset("patches", shape, "<u2", chunks=chunks, track_times=False)


@contextmanager
def _zarr(path: Path, shape: tuple[int, ...], tables: dict[str, np.ndarray], document: dict[str, Any]) -> Iterator[Any]:
    try:
        import zarr
    except ImportError as error:
        raise ImportError("Zarr needs zarr: pip install 'kcam[zarr]'.") from error
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        group = zarr.open_group(temporary, mode="w", attributes={"manifest": document})
        for name, values in tables.items():
            group.create_array(name, data=values)
        yield group.create_array("patches", shape=shape, dtype="<u2", chunks=(1, *shape[1:]), compressors=None)
        for file in temporary.rglob("*"):
            if file.is_file():
                with file.open("rb+") as opened:
                    os.fsync(opened.fileno())
        temporary.rename(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


WRITERS: dict[str, Callable[..., Any]] = {".h5": _hdf5, ".hdf5": _hdf5, ".zarr": _zarr}
