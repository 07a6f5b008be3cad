"""NumPy's npy and npz."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from kcam.data.cube import CubeError, Source, check_promise, check_size
from kcam.data.readers.format import (
    WAVELENGTHS,
    Format,
    Options,
    array_source,
    bands_first,
    cube_array,
    full_scale,
    in_metres,
    may_be_wavelengths,
)

_KEYS = ("values", "cube", "data", "bands", "img", "hsi")


def _head(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type of an array, read from its header alone."""
    first = npy.read_magic(file) == (1, 0)
    shape, _, dtype = (npy.read_array_header_1_0 if first else npy.read_array_header_2_0)(file)
    return shape, dtype


def _real(dtype: np.dtype) -> bool:
    return dtype.kind in "fui" and not dtype.hasobject


def _open_npy(path: Path, options: Options) -> Source:
    """npy: an array whose axes and wavelengths are named; 8 and 16 bits over their largest, others as they are."""
    if options.key is not None:
        raise CubeError(f"it holds one array without a name, and {options.key!r} is asked for. Leave --key out.")
    with path.open("rb") as file:
        shape, dtype = _head(file)
        promised = file.tell() + int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    cube_array({"array": (shape, _real(dtype))}, Options(key="array"))
    check_size(shape)
    if path.stat().st_size != promised:
        raise CubeError(f"it has {path.stat().st_size} bytes, and its header promises {promised}: it is damaged.")
    values = np.load(path, mmap_mode="r", allow_pickle=False)
    return _source(path, options, values, "array", None)


def _open_npz(path: Path, options: Options) -> Source:
    """npz: an array, wavelengths beside it or named; 8 and 16 bits over their largest, others as they are."""
    heads = {}
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            if member.filename.endswith(".npy"):
                with archive.open(member) as file:
                    heads[member.filename.removesuffix(".npy")] = (*_head(file), member)
    key, shape = cube_array({name: (head[0], _real(head[1])) for name, head in heads.items()}, options, usual=_KEYS)
    _, dtype, member = heads[key]
    check_size(shape, f"its {key!r}")
    check_promise(int(np.prod(shape, dtype=np.int64)) * dtype.itemsize, path.stat().st_size, f"its {key!r}")
    beside = next((heads[name] for name in WAVELENGTHS if name in heads and may_be_wavelengths(heads[name][0])), None)
    own = None
    with zipfile.ZipFile(path) as archive:
        values = _array(archive, member)
        if beside is not None:
            own = in_metres(_array(archive, beside[2]))
    return _source(path, options, values, key, own, usual="chw")


def _source(
    path: Path, options: Options, values: np.ndarray, key: str, own: np.ndarray | None, *, usual: str | None = None
) -> Source:
    order, axes = bands_first(values.shape, options, own, key, usual=usual)
    divisor = full_scale(values.dtype)
    upright = (values[0] if values.ndim == 4 else values).transpose(axes)
    return array_source(
        path, options, upright, f"{key} / {divisor:g}", own=own, divisor=divisor, orientation=f"axes {order}"
    )


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """An array of a zip; its checksum is compared where the member ends, so it is read to there."""
    with archive.open(member) as file:
        values = npy.read_array(file, allow_pickle=False)
        if file.read(1):
            raise CubeError(f"{member.filename} goes on after its array.")
    return values


NPY = Format(
    "npy", "NumPy's npy: an array of three axes (`--axes hwc`), wavelengths named", _open_npy, (".npy",), free=True
)
NPZ = Format(
    "npz",
    "npz: an array of three axes (`--key`, `--axes`), wavelengths beside it or named",
    _open_npz,
    (".npz",),
    free=True,
)
