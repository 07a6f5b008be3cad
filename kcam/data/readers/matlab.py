"""MATLAB: ICVL and ARAD-1K in version 7.3, which is HDF5; Harvard, the CASSI papers and any other in version 5."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from kcam.data.bands import profile
from kcam.data.cube import CubeError, Source, check_promise, check_size, lacking
from kcam.data.readers.format import (
    WAVELENGTHS,
    Format,
    Options,
    array_source,
    bands_first,
    cube_array,
    full_scale,
    in_metres,
    known_wavelengths,
    may_be_wavelengths,
    scaled,
    scene_name,
)
from kcam.data.readers.hdf5 import array_in, h5py, is_matlab, wavelengths_in


def _is_version_5(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(10) == b"MATLAB 5.0"


def _is_hdf5(key: str, path: Path) -> bool:
    if not is_matlab(path):
        return False
    with h5py().File(path, "r") as file:
        return {key, "bands"} <= set(file)


def _open_hdf5(usual: str, divisor: float, path: Path, options: Options) -> Source:
    """An HDF5 array (L,W,H), the reverse of MATLAB's axes, with wavelengths beside it."""
    key = options.key or usual
    with h5py().File(path, "r") as file:
        array = array_in(file, key, path)
        if array.ndim != 3:
            raise CubeError(f"its {key!r} is no array of numbers with three axes.")
        count, width, height = array.shape
        bands = wavelengths_in(file, "bands")
    grid = known_wavelengths(options, count, bands)

    def rows(first: int, last: int) -> tuple[np.ndarray, None]:
        with h5py().File(path, "r") as file:
            return scaled(file[key][:, :, first:last].transpose(0, 2, 1), divisor), None

    facts = {"scaling": f"{key} / {divisor:g}", "orientation": "axes of MATLAB, reversed by HDF5, turned back"}
    return Source(scene_name(path), (count, height, width), grid, "relative radiance", rows, facts)


_open_icvl = partial(_open_hdf5, "rad", 4095)  # 12 bits; some lie on their side
_open_arad = partial(_open_hdf5, "cube", 1)  # already 0 to 1
_ECCV = {"citation": "Arad and Ben-Shahar, Sparse recovery of hyperspectral signal, ECCV 2016"}
_CVPRW = {"citation": "Arad et al., NTIRE 2022 spectral recovery challenge, CVPRW 2022"}
ICVL = Format("icvl", "MATLAB 7.3 with rad and bands", _open_icvl, (".mat",), partial(_is_hdf5, "rad"), _ECCV)
ARAD_1K = Format("arad1k", "MATLAB 7.3 with cube and bands", _open_arad, (".mat",), partial(_is_hdf5, "cube"), _CVPRW)


def _arrays(path: Path) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a MATLAB 5 file; nothing but headers is read."""
    from scipy.io import whosmat

    return {name: shape for name, shape, _ in whosmat(str(path))}


_NUMBERS = frozenset({1, 2, 3, 4, 5, 6, 7, 9, 12, 13})
"""The types that numbers may be stored as; scipy takes any other as a place in memory, and crashes."""


def _check_tags(path: Path) -> None:
    """CubeError where an array of numbers says that it is stored as a type that does not exist."""
    with path.open("rb") as file:
        order = ">" if file.read(128)[126:128] == b"MI" else "<"
        while len(tag := file.read(8)) == 8:
            kind, size = struct.unpack(order + "II", tag)
            following = file.tell() + size
            head = file.read(min(size, 4096))
            if kind == 15:
                head = zlib.decompressobj().decompress(head, 4096)[8:]
            place = 0
            for part in range(4):  # flags, sizes, name, values: each a tag and its bytes, or both in eight
                first, count = struct.unpack_from(order + "II", head, place)
                small = first >> 16
                if part == 0 and head[8 if order == "<" else 11] not in range(6, 16):
                    break  # no numbers: cells, structures, text
                if (first & 0xFFFF if small else first) not in _NUMBERS:
                    raise CubeError(f"an array in it is stored as type {first}, which does not exist.")
                place += 8 if small else 8 + (count + 7) // 8 * 8
            file.seek(following)


def _array(path: Path, name: str, *, axes: str = "") -> np.ndarray:
    """An array of numbers; with three axes, where those are named."""
    from scipy.io import loadmat

    _check_tags(path)
    arrays = _arrays(path)
    if name not in arrays:
        raise lacking(f"array {name!r}", sorted(arrays))
    sizes = check_size(arrays[name], f"its {name!r}")
    check_promise(int(np.prod(sizes, dtype=np.int64)), path.stat().st_size, f"its {name!r}")  # at a byte a value
    found = loadmat(str(path), variable_names=[name]).get(name)
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "fui":
        raise CubeError(f"its {name!r} is no array of numbers.")
    if axes and found.ndim != 3:
        raise CubeError(f"its {name!r} has shape {found.shape}, expected {axes}.")
    return found


def _open_harvard(path: Path, options: Options) -> Source:
    """Harvard (Chakrabarti and Zickler 2011): `ref` (H,W,31), `lbl` 0 where invalid; calib.txt beside it divides."""
    key = options.key or "ref"
    values = _array(path, key, axes="(H,W,31)")
    calibration = next((p for p in (path.parent / "calib.txt", path.parent.parent / "calib.txt") if p.is_file()), None)
    if calibration is None:
        raise CubeError("there is no calib.txt beside it, without which its bands cannot be compared.")
    divisors = np.loadtxt(calibration, dtype=np.float64).ravel()
    if len(divisors) != values.shape[2] or not (divisors > 0).all():
        raise CubeError(f"calib.txt holds {len(divisors)} factors for {values.shape[2]} bands, or some not above 0.")
    valid = None
    if "lbl" in _arrays(path):
        labels = _array(path, "lbl")
        if labels.shape != values.shape[:2]:
            raise CubeError(f"its mask 'lbl' is {labels.shape}, its cube {values.shape[:2]}.")
        valid = labels > 0
    cube = (values / divisors).transpose(2, 0, 1)
    return array_source(path, options, cube, f"{key} / calib.txt", own=profile("harvard31"), valid=valid)


def _is_harvard(path: Path) -> bool:
    return _is_version_5(path) and {"ref", "lbl"} <= set(_arrays(path))


_CVPR = {"citation": "Chakrabarti and Zickler, Statistics of real-world hyperspectral images, CVPR 2011"}
HARVARD = Format(
    "harvard", "MATLAB 5 with ref and lbl, calib.txt beside it", _open_harvard, (".mat",), _is_harvard, _CVPR
)

_CASSI_KEYS = {
    "HSI": (1.0, False, None),
    "img_expand": (65536.0, False, "cave_1024_28"),
    "data_slice": (65535.0, True, None),
    "img": (1.0, False, None),
    "img_hs": (65535.0, False, None),
}
"""Arrays of the CASSI papers: divisor, whether it is clipped to 0..1, and the group of scenes that are copies."""


def _open_cassi(path: Path, options: Options) -> Source:
    """28-band .mat files of the CASSI papers (DGSMP, TSA-Net, MST) and DeepCASSI's 31: (H,W,L)."""
    names = _arrays(path)
    key = next((name for name in _CASSI_KEYS if name in names), None) if options.key is None else options.key
    if key is None or key not in names:
        raise lacking(f"array {' or '.join(_CASSI_KEYS) if key is None else repr(key)}", names)
    divisor, clip, group = _CASSI_KEYS.get(key, (1.0, False, None))
    values = _array(path, key, axes="(H,W,L)")
    if key == "img" and float(values.max(initial=0)) > 2:  # the 1024 x 1024 set stores the same key in 16 bits
        divisor, group = 65536.0, "cave_1024_28"
    cube = scaled(values, divisor).transpose(2, 0, 1)
    own = in_metres(_array(path, "wvls2b")) if "wvls2b" in names else None
    if own is None and len(cube) == 28:
        own = profile("cassi28")
    source = array_source(path, options, np.clip(cube, 0, 1) if clip else cube, f"{key} / {divisor:g}", own=own)
    return source if group is None else replace(source, facts=source.facts | {"group": group})


def _is_cassi(path: Path) -> bool:
    return _is_version_5(path) and not set(_CASSI_KEYS).isdisjoint(_arrays(path))


CASSI = Format("cassi28", "MATLAB 5 with HSI, img_expand, data_slice, img or img_hs", _open_cassi, (".mat",), _is_cassi)


_REAL = frozenset({"double", "single", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))})


def _open_mat(path: Path, options: Options) -> Source:
    """Any array of MATLAB 5, its wavelengths beside it or named; 8 and 16 bits over their largest, else as they are."""
    from scipy.io import whosmat

    found = {name: (shape, kind in _REAL) for name, shape, kind in whosmat(str(path))}
    key, shape = cube_array(found, options)
    rows = [name for name, (sizes, real) in found.items() if real and may_be_wavelengths(sizes)]
    beside = next((name for name in WAVELENGTHS if name in rows), None)
    own = None if beside is None else in_metres(_array(path, beside))
    order, axes = bands_first(shape, options, own, key)
    values = _array(path, key)
    divisor = full_scale(values.dtype)
    upright = (values[0] if values.ndim == 4 else values).transpose(axes)
    how: dict[str, Any] = {"own": own, "divisor": divisor, "orientation": f"axes {order}"}
    return array_source(path, options, upright, f"{key} / {divisor:g}", **how)


MAT = Format(
    "mat",
    "any MATLAB 5: an array of three axes (`--key`, `--axes`), wavelengths beside it or named",
    _open_mat,
    (".mat",),
    _is_version_5,
    free=True,
)
