"""How fast patches are read from a store and written into it, beside the ways they are usually kept.

    python -m benchmarks.patches [--quick] [--out benchmarks/results/patches.json]

Random patches, one process, each as a float32 tensor, from the store, one .npy per patch, HDF5 and Zarr with a patch
per chunk, uncompressed; by turns, A B A B. Warm: the files are in the page cache. Cold: they were dropped from it
before (posix_fadvise), though the disk's own cache, or the host's, may still hold them. Extraction stands against
copying the files that it wrote, both synced to the disk. Wall-clock time, for most of it is waiting.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.common import ROOT, environment, write_json
from kcam.data import PatchDataset, Settings, export_patches, extract, make_plan
from kcam.data.cube import Source, write_source
from kcam.units import nm

RESULTS = ROOT / "benchmarks" / "results" / "patches.json"


@dataclass(frozen=True)
class Size:
    """Of the cubes and patches. draws: patches that are read in a round."""

    bands: int = 28
    side: int = 896
    cubes: int = 2
    patch: int = 256
    stride: int = 128
    draws: int = 36
    rounds: int = 9


QUICK = Size(bands=4, side=96, patch=32, stride=16, draws=6, rounds=2)
Reader = Callable[[int], Tensor]


def scene(number: int, size: Size) -> Source:
    """A cube with the look of a scene: soft shapes, texture, noise."""
    draw = np.random.default_rng(number)
    y, x = np.mgrid[: size.side, : size.side].astype(np.float32) / size.side
    shapes = 0.4 + 0.3 * np.sin(9 * x + 4 * np.sin(7 * y)) * np.cos(11 * y)
    tint = 0.5 + draw.random((size.bands, 1, 1), np.float32)

    def rows(first: int, last: int) -> tuple[np.ndarray, None]:
        noise = draw.random((size.bands, last - first, size.side), np.float32)
        return shapes[None, first:last] * tint + 0.05 * noise + 0.05, None

    grid = np.linspace(420, 720, size.bands) * nm
    return Source(f"scene{number}", (size.bands, size.side, size.side), grid, "reflectance", rows)


# ---- reading -------------------------------------------------------------------------------------------------------


def open_store(folder: Path) -> tuple[Reader, Any]:
    """kcam's own."""
    patches = PatchDataset(folder / "store" / "train")
    return lambda index: patches[index].values, patches


def open_files(folder: Path) -> tuple[Reader, Any]:
    """One .npy for each patch."""
    return lambda index: as_tensor(np.load(folder / "files" / f"{index}.npy"), SCALE), None


def open_hdf5(folder: Path) -> tuple[Reader, Any]:
    """One file, a patch per chunk."""
    import h5py

    file = h5py.File(folder / "patches.h5")
    patches = file["patches"]
    return lambda index: as_tensor(patches[index], SCALE), file


def open_zarr(folder: Path) -> tuple[Reader, Any]:
    """One array, a patch per chunk."""
    import zarr

    patches = zarr.open_group(folder / "patches.zarr", mode="r")["patches"]
    return lambda index: as_tensor(np.asarray(patches[index]), SCALE), None


SCALE = 1 / 65535  # any number: what matters is that all do the same work
STORES: dict[str, Callable[[Path], tuple[Reader, Any]]] = {
    "kcam store": open_store,
    "one .npy per patch": open_files,
    "HDF5": open_hdf5,
    "Zarr": open_zarr,
}


def as_tensor(numbers: np.ndarray, scale: float) -> Tensor:
    """Numbers of a file as values, as PatchDataset makes them."""
    return torch.from_numpy(numbers.astype(np.float32)).mul_(scale)


def make_stores(folder: Path) -> list[str]:
    """The other stores, with the patches of kcam's; names of those whose library is not installed."""
    split = folder / "store" / "train"
    patches = PatchDataset(split)
    (folder / "files").mkdir()
    number = 0
    for record in patches.scenes:
        for patch in np.load(split / record["file"], mmap_mode="r"):
            np.save(folder / "files" / f"{number}.npy", patch)
            number += 1
    skipped = []
    for name, path in (("HDF5", "patches.h5"), ("Zarr", "patches.zarr")):
        try:
            export_patches(split, folder / path)
        except ImportError:
            skipped.append(name)
    return skipped


def forget(folder: Path) -> bool:
    """Drop the files of a folder from the page cache; whether this system can."""
    if not hasattr(os, "posix_fadvise"):
        return False
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    return True


def close(opened: dict[str, tuple[Reader, Any]]) -> None:
    """Close what is open, and let go of what is mapped."""
    for _, handle in opened.values():
        if hasattr(handle, "close"):
            handle.close()
    opened.clear()


def rate(read: Reader, order: np.ndarray) -> float:
    """Patches per second."""
    start = time.perf_counter()
    for index in order:
        read(int(index))
    return len(order) / (time.perf_counter() - start)


def reading(folder: Path, size: Size) -> list[dict[str, Any]]:
    """A row for each store, warm and cold."""
    skipped = make_stores(folder)
    names = [name for name in STORES if name not in skipped]
    count = len(PatchDataset(folder / "store" / "train"))
    draw = np.random.default_rng(0)
    opened = {name: STORES[name](folder) for name in names}
    same = [read(1) for read, _ in opened.values()]
    close(opened)
    same = [values / values.max() for values in same]
    if not all(torch.allclose(values, same[0], atol=1e-6) for values in same):
        raise RuntimeError("the stores hold different patches.")
    del same
    found: dict[tuple[str, str], list[float]] = {}
    opened = {name: STORES[name](folder) for name in names}  # kept open, as through a training
    for name in names:
        rate(opened[name][0], np.arange(count))
    for _ in range(size.rounds):
        order = draw.permutation(count)[: size.draws]
        for name in names:
            found.setdefault((name, "warm"), []).append(rate(opened[name][0], order))
    close(opened)
    for _ in range(size.rounds if forget(folder) else 0):
        order = draw.permutation(count)[: size.draws]
        for name in names:
            forget(folder)
            opened = {name: STORES[name](folder)}  # what is mapped is not forgotten
            found.setdefault((name, "cold"), []).append(rate(opened[name][0], order))
            close(opened)
    return [
        {"store": name, "state": state} | spread(rates, found["kcam store", state], "patches_per_second")
        for (name, state), rates in found.items()
    ] + [{"store": name, "state": "skipped"} for name in skipped]


def spread(rates: list[float], ours: list[float], key: str) -> dict[str, Any]:
    """Median and quartiles, and the median of kcam's ratio to it in the same round."""
    ratios = [one / two for one, two in zip(ours, rates, strict=True)]
    return {
        key: statistics.median(rates),
        f"{key}_iqr": np.percentile(rates, [25, 75]).tolist(),
        "kcam_is_faster": statistics.median(ratios),
        "rounds": len(rates),
    }


# ---- extraction ----------------------------------------------------------------------------------------------------


def extraction(folder: Path, size: Size) -> list[dict[str, Any]]:
    """Making the store with one worker, and copying its files, by turns; in MB of patches per second."""
    settings = Settings(size.patch, size.stride, (("train", 1.0),))
    store, copy = folder / "store", folder / "copy"
    rates: dict[str, list[float]] = {"extract": [], "copy": []}
    for turn in range(max(2, size.rounds // 2) + 1):
        shutil.rmtree(store, ignore_errors=True)
        start = time.perf_counter()
        extract(make_plan(folder / "cubes", settings), store)
        one = time.perf_counter() - start
        written = sum(path.stat().st_size for path in store.rglob("*.npy"))
        copy.mkdir()
        start = time.perf_counter()
        for path in store.rglob("*.npy"):
            shutil.copyfile(path, copy / path.name)
            with (copy / path.name).open("rb+") as file:
                os.fsync(file.fileno())
        two = time.perf_counter() - start
        shutil.rmtree(copy)
        if turn:  # the first reads the cubes from the disk
            rates["extract"].append(written / one / 1e6)
            rates["copy"].append(written / two / 1e6)
    return [
        {"what": what, "bytes": written} | spread(own, rates["extract"], "MB_per_second") for what, own in rates.items()
    ]


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="toy sizes")
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--folder", type=Path, help="on the disk to measure; 1.5 GB")
    options = parser.parse_args(arguments)
    size = QUICK if options.quick else Size()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(dir=options.folder) as name:
        folder = Path(name)
        (folder / "cubes").mkdir()
        for number in range(size.cubes):
            write_source(folder / "cubes" / f"scene{number}.tif", scene(number, size))
        content = {
            "environment": environment() | {"clock": "wall-clock seconds"},
            "patch": [size.bands, size.patch, size.patch],
            "extraction": extraction(folder, size),
            "patches": len(PatchDataset(folder / "store" / "train")),
            "reading": reading(folder, size),
        }
    write_json(options.out, content)
    for row in content["extraction"]:
        print(f"{row['what']:20s}      {row['MB_per_second']:8.0f} MB/s")
    for row in content["reading"]:
        if row["state"] == "skipped":
            print(f"{row['store']:20s} is not installed")
        else:
            print(f"{row['store']:20s} {row['state']} {row['patches_per_second']:8.0f} patches/s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
