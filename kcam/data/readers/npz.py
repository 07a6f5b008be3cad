"""NumPy's npz."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from kcam.data.cube import CubeError, Source, check_promise, check_size, lacking
from kcam.data.readers.format import Format, Options, array_source, bands_first, in_metres, normalised

_KEYS = ("values", "cube", "data", "bands", "img", "hsi")


def _open_npz(path: Path, options: Options) -> Source:
    """npz: an array (L,H,W) (or (H,W,L)) and `wavelengths` in nm, um or m beside it; values as they are."""
    heads = {}
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            if member.filename.endswith(".npy"):
                with archive.open(member) as file:
                    first = npy.read_magic(file) == (1, 0)
                    shape, _, dtype = (npy.read_array_header_1_0 if first else npy.read_array_header_2_0)(file)
                heads[member.filename.removesuffix(".npy")] = (shape, dtype, member)
    usual = next((name for name in _KEYS if name in heads and len(heads[name][0]) == 3), None)
    key = usual if options.key is None else options.key
    if key is None:
        raise lacking(f"array {' or '.join(_KEYS)} of three axes", heads)
    if key not in heads:
        raise lacking(f"array {key!r}", heads)
    shape, dtype, member = heads[key]
    if dtype.hasobject or dtype.kind not in "fui" or len(shape) != 3:
        raise CubeError(f"its {key!r} is {shape} of {dtype}, expected numbers with three axes.")
    check_size(shape, f"its {key!r}")
    check_promise(int(np.prod(shape, dtype=np.int64)) * dtype.itemsize, path.stat().st_size, f"its {key!r}")
    own = None
    with zipfile.ZipFile(path) as archive:
        values = _array(archive, member)
        if "wavelengths" in heads and np.prod(heads["wavelengths"][0], dtype=np.int64) <= 10_000:
            own = _array(archive, heads["wavelengths"][2]).astype(np.float64).ravel()
            own = own if 0 < own.max(initial=0) < 1e-3 else in_metres(own)
    values = bands_first(values, own if options.wavelengths is None else options.wavelengths)
    values, divisor = normalised(values)
    return array_source(path, options, values, f"{key} / {divisor:g}", own=own)


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """An array of a zip; its checksum is compared where the member ends, so it is read to there."""
    with archive.open(member) as file:
        values = npy.read_array(file, allow_pickle=False)
        if file.read(1):
            raise CubeError(f"{member.filename} goes on after its array.")
    return values


NPZ = Format("npz", "npz with an array of three axes and wavelengths", _open_npz, (".npz",))
