"""Readers of public data sets: one table, `FORMATS`. Bands are known by their wavelength, never by their place.

A reader opens a path as a `Source`, which says the unit, the wavelengths and the scaling, and turns the array upright:
(L,H,W), row 0 at the top as the data set shows it. To add a format, write a function and a row.
"""

from __future__ import annotations

import os
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import torch

from kcam import spectral
from kcam.data.bands import resampling
from kcam.data.cube import MOST_VALUES, Cube, CubeError, Source, is_cube, open_cube, words_of
from kcam.scene import Scene, read_picture
from kcam.units import nm, wavelength_grid

CASSI_NM = (
    453.5, 457.5, 462, 466, 471.5, 476.5, 481.5, 487, 492.5, 498, 504, 510, 516, 522.5,
    529.5, 536.5, 544, 551.5, 558.5, 567.5, 575.5, 584.5, 594.5, 604, 614.5, 625, 636.5, 648,
)  # fmt: skip
"""The 28 bands of the CASSI papers: caiyuanhao1998/MST, visualization/show_simulation.m."""
PROFILES: dict[str, np.ndarray] = {
    "cassi28": np.asarray(CASSI_NM),
    "cave31": np.arange(400.0, 701.0, 10.0),
    "harvard31": np.arange(420.0, 721.0, 10.0),
    "kaist31": np.arange(420.0, 721.0, 10.0),
}
"""Wavelengths [nm] that a user may name for files that hold none."""


@dataclass(frozen=True)
class Options:
    """What a user says beside the path.

    wavelengths: [m] of a file that has none. key: of the array in the file. bands: that a photograph is upsampled to
    [m]. depth: of a photograph, (H,W) [m].
    """

    wavelengths: np.ndarray | None = None
    key: str | None = None
    bands: np.ndarray | None = None
    depth: np.ndarray | None = None


@dataclass(frozen=True)
class Format:
    """A row: what it is, which paths it recognises without being named, how it is opened, and what to cite."""

    name: str
    what: str
    matches: Callable[[Path], bool]
    open: Callable[[Path, Options], Source]
    facts: dict[str, str] = field(default_factory=dict)


def profile(name: str) -> np.ndarray:
    """Wavelengths [m] of a named profile; ValueError for an unknown name."""
    if name not in PROFILES:
        raise ValueError(f"unknown profile {name!r}; known: {', '.join(PROFILES)}.")
    return PROFILES[name] * nm


def read_cube(
    path: str | Path,
    *,
    format: str | None = None,
    wavelengths: Any = None,
    key: str | None = None,
    bands: Any = None,
    depth: np.ndarray | None = None,
) -> Cube:
    """A spectral cube from a file or a folder of any known format.

    Args:      format: a name in `FORMATS`; None where the file says what it is.
               wavelengths: (L,) [m], for files that hold none. key: name of the array inside the file.
               bands: (L,) [m] that a photograph is upsampled to; None for 28 from 420 to 720 nm.
               depth: of a photograph, (H,W) [m].
    Returns:   a `Cube`, values float32.
    Raises:    FileNotFoundError; CubeError with its name for a file that is damaged, of another layout, or without
               wavelengths; ValueError for an unknown format; ImportError for a format whose reader is not installed.
    """
    grids = [None if grid is None else wavelength_grid(grid).numpy() for grid in (wavelengths, bands)]
    try:
        return open_source(Path(path), format=format, options=Options(grids[0], key, grids[1], depth)).cube()
    except CubeError as error:
        raise CubeError(f"{path}: {error}") from error


def open_source(path: Path, *, format: str | None = None, options: Options | None = None) -> Source:
    """A cube that is read strip by strip. Errors as `read_cube`."""
    if not path.exists():
        raise FileNotFoundError(f"there is no file or folder {path}.")
    if not (path.is_file() or path.is_dir()):
        raise CubeError("it is neither a file nor a folder.")
    row = None if format is None else FORMATS.get(format)
    if format is not None and row is None:
        raise ValueError(f"unknown format {format!r}; known: {', '.join(FORMATS)}.")
    row = row or recognised(path)
    if row is None:
        raise CubeError(
            f"its format is not recognised. Name it: --format {'|'.join(FORMATS)}, and --profile or --wavelengths for "
            "files that hold no wavelengths. Or it is damaged."
        )
    try:
        with np.errstate(all="ignore"):  # what overflows float32 is infinite, and marked when it is read
            source = row.open(path, options or Options())
        return replace(source, facts={"format": row.name} | row.facts | source.facts).check()
    except (CubeError, ImportError, FileNotFoundError):
        raise
    except MemoryError as error:
        raise CubeError("it does not fit into memory.") from error
    except Exception as error:
        raise CubeError(f"it cannot be read as {row.name}: {words_of(error)}") from error


def recognised(path: Path) -> Format | None:
    """The first row of the table that knows the path."""
    for row in FORMATS.values():
        try:
            if row.matches(path):
                return row
        except ImportError:
            raise
        except Exception:  # whatever a damaged file makes a library raise
            continue
    return None


def scenes_in(path: Path) -> Iterator[Path]:
    """The scenes of a path: itself, or what a folder of scenes holds, sorted; folders of one scene are not entered.

    A link to a folder that the path itself lies in is passed over.
    """
    if path.is_file() or (path.is_dir() and _cave_files(path)):
        yield path
        return
    if not path.is_dir():
        raise FileNotFoundError(f"there is no file or folder {path}.")
    for child in sorted(path.iterdir()):
        if child.name.startswith(".") or child.name in ("__MACOSX", "Thumbs.db", "calib.txt"):
            continue
        if child.is_dir():
            if child.is_symlink() and child.resolve() in (path.resolve(), *path.resolve().parents):
                continue
            yield from scenes_in(child)
        elif child.suffix.lower() in SUFFIXES:
            yield child


def scene_name(path: Path) -> str:
    """The name of a scene, from its file or folder: letters, digits, points, dashes and underscores."""
    stem = path.name if path.is_dir() else path.stem
    return re.sub(r"[^A-Za-z0-9._-]+", "_", stem).strip("._") or "scene"


# ---- what readers share --------------------------------------------------------------------------------------------


_SLACK = 2**26  # bytes that a header may promise in any case


def _check_bomb(promised: int, stored: int, what: str = "its header") -> None:
    """CubeError where a header promises far more than its bytes can hold: no picture compresses to a 64th."""
    if promised > 64 * stored + _SLACK:
        raise CubeError(f"{what} promises {promised / 1e6:.0f} MB in {stored / 1e6:.3g} MB of data: it is damaged.")


def _known(path: Path, options: Options, count: int, otherwise: np.ndarray | None = None) -> np.ndarray:
    """The wavelengths of a file that does not hold them, [m]."""
    grid = otherwise if options.wavelengths is None else options.wavelengths
    if grid is None:
        raise CubeError(
            f"it has {count} bands and no wavelengths. Say which: --wavelengths start:stop:count in nm, or --profile "
            f"{'|'.join(PROFILES)}."
        )
    if len(grid) != count:
        raise CubeError(f"it has {count} bands, but {len(grid)} wavelengths are named for it.")
    return np.asarray(grid, dtype=np.float64)


def _nanometres(values: Any) -> np.ndarray:
    """Wavelengths that a file states in nm, or in um: [m]."""
    grid = np.asarray(values, dtype=np.float64).ravel()
    if not len(grid) or not np.isfinite(grid).all() or grid.min() <= 0:
        raise CubeError("its wavelengths are empty, not finite or not positive.")
    return grid * (1e-6 if grid.max() < 20 else nm)


def _whole(values: np.ndarray, valid: np.ndarray | None = None) -> Callable[[int, int], tuple[np.ndarray, Any]]:
    """Rows of an array (L,H,W) that is in memory, or mapped."""

    def rows(first: int, last: int) -> tuple[np.ndarray, np.ndarray | None]:
        part = np.array(values[:, first:last], dtype=np.float32)
        return part, None if valid is None else np.array(valid[first:last])

    return rows


def _without(wanted: str, names: Iterable[str]) -> CubeError:
    """The error of a file that lacks what was asked for."""
    return CubeError(f"it has no {wanted}, only {', '.join(names) or 'nothing'}.")


def _check_size(shape: Iterable[int], what: str = "its array") -> tuple[int, ...]:
    """A shape as it stands in a header, before anything is read; CubeError for one that no cube has."""
    sizes = tuple(int(size) for size in shape)
    product = 1
    for size in sizes:
        product *= max(size, 0)
    if product < 1 or product > MOST_VALUES:
        raise CubeError(f"{what} says it is {' x '.join(map(str, sizes))}: no cube has that size.")
    return sizes


def _largest(dtype: np.dtype) -> float:
    """What whole numbers of 8 or 16 bits are divided by; others are taken as they are."""
    return {"u1": 255.0, "u2": 65535.0}.get(dtype.kind + str(dtype.itemsize), 1.0)


def _scaled(values: np.ndarray, divisor: float, clip: bool = False) -> np.ndarray:
    scaled = values.astype(np.float32) / np.float32(divisor)
    return np.clip(scaled, 0, 1) if clip else scaled


# ---- EXR: KAIST ----------------------------------------------------------------------------------------------------


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what a C library writes to the process's standard error: our own line says what is wrong with a file."""
    try:
        kept = os.dup(2)
    except OSError:  # there is none
        yield
        return
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)


def _open_kaist(path: Path, options: Options) -> Source:
    """KAIST (Choi et al. 2017): one scanline EXR, channels w420nm ... w720nm; reflectance against Spectralon."""
    try:
        import Imath
        import OpenEXR
    except ImportError as error:
        raise ImportError("KAIST's files are OpenEXR, which the extra reads: pip install 'kcam[exr]'.") from error
    # InputFile.header() can crash
    with _quiet(), OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
        if len(file.parts) != 1:
            raise CubeError(f"it has {len(file.parts)} parts, expected one.")
        channels = [(channel.name, channel.xSampling, channel.ySampling) for channel in file.header()["channels"]]
        (left, top), (right, bottom) = ((int(x), int(y)) for x, y in file.header()["dataWindow"])
    names = [name for name, _, _ in channels]
    if any(steps != [1, 1] for _, *steps in channels):
        raise CubeError("some of its channels have fewer pixels than others.")
    height, width = bottom - top + 1, right - left + 1
    _check_size((len(names), height, width), "its data window")
    found = {name: float(match[1]) for name in names if (match := re.fullmatch(r"w(\d+(?:\.\d+)?)nm", name))}
    strange = sorted(set(names) - set(found) - set("RGBAYZ"))
    if not found or strange:
        raise CubeError(f"its channels are no wavelengths such as w420nm: {', '.join((strange or names)[:6])}.")
    _check_bomb(2 * len(found) * height * width, path.stat().st_size)
    ordered = sorted(found, key=found.__getitem__)
    grid = _nanometres([found[name] for name in ordered])
    pixel_type = Imath.PixelType(Imath.PixelType.FLOAT)

    def rows(first: int, last: int) -> tuple[np.ndarray, None]:
        with _quiet(), closing(OpenEXR.InputFile(str(path))) as file:
            if not file.isComplete():
                raise CubeError("it is cut off: lines are missing.")
            lines = file.channels(ordered, pixel_type, top + first, top + last - 1)
        values = np.empty((len(ordered), last - first, width), np.float32)
        for plane, pixels in zip(values, lines, strict=True):
            plane[:] = np.frombuffer(pixels, np.float32).reshape(plane.shape)
        return values, None

    facts = {"scaling": "as stored", "orientation": "as stored"}
    return Source(scene_name(path), (len(ordered), height, width), grid, "reflectance", rows, facts)


# ---- MATLAB: ICVL, ARAD-1K, Harvard, CASSI -------------------------------------------------------------------------


def _is_matlab(path: Path, version: str) -> bool:
    if path.suffix.lower() != ".mat" or not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(10) == f"MATLAB {version}".encode()


def _hdf5_keys(path: Path) -> set[str]:
    h5py = _h5py()
    with h5py.File(path, "r") as file:
        return set(file)


def _h5py() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise ImportError("MATLAB 7.3 files are HDF5, which the extra reads: pip install 'kcam[data]'.") from error
    return h5py


def _open_hdf5(
    path: Path, options: Options, *, key: str, axes: tuple[int, int, int], divisor: float, unit: str
) -> Source:
    """An HDF5 array with wavelengths beside it; `axes` brings it to (L,H,W)."""
    h5py = _h5py()
    with h5py.File(path, "r") as file:
        for name in (key, "bands"):
            link = file.get(name, getlink=True)
            if link is not None and not isinstance(link, h5py.HardLink):
                raise CubeError(f"its {name!r} is a link to elsewhere, which is not followed.")
        if key not in file:
            raise _without(f"array {key!r}", sorted(file))
        array = file[key]
        if not isinstance(array, h5py.Dataset) or array.ndim != 3 or array.dtype.kind not in "fui":
            raise CubeError(f"its {key!r} is no array of numbers with three axes.")
        if array.external or array.is_virtual:
            raise CubeError(f"its {key!r} lies in other files, which are not opened.")
        sizes = _check_size(array.shape, f"its {key!r}")
        stored = array.id.get_storage_size()
        if not 0 < stored <= path.stat().st_size:
            raise CubeError(f"its {key!r} is not in the file: {stored} bytes of {path.stat().st_size}.")
        _check_bomb(array.nbytes, stored, f"its {key!r}")
        bands = None
        if "bands" in file and isinstance(file["bands"], h5py.Dataset) and file["bands"].size <= 10_000:
            bands = _nanometres(file["bands"][()])
    shape = tuple(sizes[axis] for axis in axes)
    grid = _known(path, options, shape[0], bands)
    row_axis = axes[1]

    def rows(first: int, last: int) -> tuple[np.ndarray, None]:
        part = [slice(None)] * 3
        part[row_axis] = slice(first, last)
        with h5py.File(path, "r") as file:
            return _scaled(file[key][tuple(part)].transpose(axes), divisor), None

    bands_count, height, width = shape
    return Source(
        scene_name(path),
        (bands_count, height, width),
        grid,
        unit,
        rows,
        {"scaling": f"{key} / {divisor:g}", "orientation": "axes of MATLAB, reversed by HDF5, turned back"},
    )


def _open_icvl(path: Path, options: Options) -> Source:
    """ICVL (Arad and Ben-Shahar 2016): `rad` as (L,W,H) in HDF5 order, 12 bits; some lie on their side."""
    return _open_hdf5(path, options, key=options.key or "rad", axes=(0, 2, 1), divisor=4095, unit="relative radiance")


def _open_arad(path: Path, options: Options) -> Source:
    """ARAD-1K (NTIRE 2022): `cube` as (L,W,H) in HDF5 order, already 0 to 1."""
    return _open_hdf5(path, options, key=options.key or "cube", axes=(0, 2, 1), divisor=1, unit="relative radiance")


def _mat_arrays(path: Path) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a MATLAB 5 file; nothing but headers is read."""
    from scipy.io import whosmat

    return {name: shape for name, shape, _ in whosmat(str(path))}


_MAT_NUMBERS = frozenset({1, 2, 3, 4, 5, 6, 7, 9, 12, 13})
"""The types that numbers may be stored as; scipy takes any other as a place in memory, and crashes."""


def _check_mat_tags(path: Path) -> None:
    """CubeError where an array of numbers in a MATLAB 5 file says that it is stored as a type that does not exist."""
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
                if (first & 0xFFFF if small else first) not in _MAT_NUMBERS:
                    raise CubeError(f"an array in it is stored as type {first}, which does not exist.")
                place += 8 if small else 8 + (count + 7) // 8 * 8
            file.seek(following)


def _mat_array(path: Path, name: str) -> np.ndarray:
    from scipy.io import loadmat

    _check_mat_tags(path)
    arrays = _mat_arrays(path)
    if name not in arrays:
        raise _without(f"array {name!r}", sorted(arrays))
    sizes = _check_size(arrays[name], f"its {name!r}")
    _check_bomb(int(np.prod(sizes, dtype=np.int64)), path.stat().st_size, f"its {name!r}")  # at a byte a value
    found = loadmat(str(path), variable_names=[name]).get(name)
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "fui":
        raise CubeError(f"its {name!r} is no array of numbers.")
    return found


def _open_harvard(path: Path, options: Options) -> Source:
    """Harvard (Chakrabarti and Zickler 2011): `ref` (H,W,31), `lbl` 0 where invalid; calib.txt beside it divides."""
    key = options.key or "ref"
    values = _mat_array(path, key)
    if values.ndim != 3:
        raise CubeError(f"its {key!r} has shape {values.shape}, expected (H,W,31).")
    calibration = next((p for p in (path.parent / "calib.txt", path.parent.parent / "calib.txt") if p.is_file()), None)
    if calibration is None:
        raise CubeError("there is no calib.txt beside it, without which its bands cannot be compared.")
    divisors = np.loadtxt(calibration, dtype=np.float64).ravel()
    if len(divisors) != values.shape[2] or not (divisors > 0).all():
        raise CubeError(f"calib.txt holds {len(divisors)} factors for {values.shape[2]} bands, or some not above 0.")
    valid = None
    if "lbl" in _mat_arrays(path):
        labels = _mat_array(path, "lbl")
        if labels.shape != values.shape[:2]:
            raise CubeError(f"its mask 'lbl' is {labels.shape}, its cube {values.shape[:2]}.")
        valid = labels > 0
    cube = (values / divisors).transpose(2, 0, 1)
    grid = _known(path, options, len(cube), PROFILES["harvard31"] * nm)
    facts = {"scaling": f"{key} / calib.txt", "orientation": "as stored"}
    return Source(scene_name(path), cube.shape, grid, "relative radiance", _whole(cube, valid), facts)


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
    names = _mat_arrays(path)
    key = options.key or next((name for name in _CASSI_KEYS if name in names), None)
    if options.key is not None and options.key not in names:
        raise _without(f"array {options.key!r}", names)
    if key is None:
        raise _without(f"array {' or '.join(_CASSI_KEYS)}", names)
    divisor, clip, group = _CASSI_KEYS.get(key, (1.0, False, None))
    values = _mat_array(path, key)
    if values.ndim != 3:
        raise CubeError(f"its {key!r} has shape {values.shape}, expected (H,W,L).")
    if key == "img" and float(values.max(initial=0)) > 2:  # the 1024 x 1024 set stores the same key in 16 bits
        divisor, group = 65536.0, "cave_1024_28"
    cube = _scaled(values, divisor, clip).transpose(2, 0, 1)
    own = _nanometres(_mat_array(path, "wvls2b")) if "wvls2b" in names else None
    if own is None and len(cube) == 28:
        own = PROFILES["cassi28"] * nm
    facts = {"scaling": f"{key} / {divisor:g}", "orientation": "as stored"}
    facts |= {} if group is None else {"group": group}
    return Source(
        scene_name(path), cube.shape, _known(path, options, len(cube), own), "relative radiance", _whole(cube), facts
    )


# ---- PNG per band: CAVE --------------------------------------------------------------------------------------------


def _cave_files(path: Path) -> list[tuple[int, Path]]:
    """The PNGs of one CAVE scene by their number, from X_ms, X_ms/X_ms, or a folder that holds only the inner one."""
    for folder in (path, path / path.name):
        if not folder.is_dir():
            continue
        found = []
        for file in folder.iterdir():
            match = re.fullmatch(r".*_ms_(\d+)\.png", file.name, re.IGNORECASE)
            if match and not file.name.startswith(".") and file.is_file():
                found.append((int(match[1]), file))
        if found:
            return sorted(found)
    return []


def _read_png(path: Path) -> np.ndarray:
    """A PNG as it is; OpenCV says nothing about what it cannot read."""
    import cv2

    with path.open("rb") as file:
        head = file.read(24)
    if head[:8] != b"\x89PNG\r\n\x1a\n" or len(head) < 24:
        raise CubeError(f"{path.name} is no PNG.")
    width, height = _check_size((int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")), path.name)
    _check_bomb(2 * width * height, path.stat().st_size, path.name)
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise CubeError(f"{path.name} is damaged.")
    if pixels.ndim == 3:
        planes = pixels[..., :3]
        if not (planes == planes[..., :1]).all():
            raise CubeError(f"{path.name} is a colour picture, expected one band.")
        pixels = planes[..., 0]
    if pixels.dtype != np.uint16:
        raise CubeError(f"{path.name} has {pixels.dtype.itemsize * 8} bits, expected 16.")
    return pixels


def _open_cave(path: Path, options: Options) -> Source:
    """CAVE (Yasuma et al. 2010): X_ms/X_ms_01.png to 31, 16 bits; band i at 400 + 10 (i - 1) nm."""
    files = _cave_files(path)
    if not files:
        raise CubeError("it holds no bands such as X_ms_01.png.")
    numbers = [number for number, _ in files]
    count = 31 if options.wavelengths is None else len(options.wavelengths)
    if numbers != list(range(1, count + 1)):
        missing = ", ".join(str(number) for number in range(1, count + 1) if number not in numbers)
        raise CubeError(f"bands missing: {missing}." if missing else f"it has {len(numbers)} PNGs for {count} bands.")
    grid = _known(path, options, len(files), PROFILES["cave31"] * nm)
    planes = [_read_png(file) for _, file in files]
    if len({plane.shape for plane in planes}) != 1:
        raise CubeError("its bands have different sizes.")
    values = _scaled(np.stack(planes), 65535)
    facts = {"scaling": "/ 65535", "orientation": "as stored"}
    return Source(scene_name(path), values.shape, grid, "reflectance", _whole(values), facts)


# ---- ENVI ----------------------------------------------------------------------------------------------------------

_ENVI_TYPES = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 12: "u2", 13: "u4", 14: "i8", 15: "u8"}
_ENVI_AXES = {"bsq": (0, 1, 2), "bil": (1, 0, 2), "bip": (2, 0, 1)}  # of the file's array, that make (L,H,W)


def _envi_header(path: Path) -> dict[str, str]:
    text = path.read_text(errors="replace")
    if not text.lstrip().startswith("ENVI"):
        raise CubeError("its header does not begin with ENVI.")
    fields = re.findall(r"^[ \t]*([^=\n{};]+?)[ \t]*=[ \t]*(\{[^}]*\}|[^\n]*)", text, re.MULTILINE)
    return {name.strip().lower(): value.strip() for name, value in fields}


_ENVI_UNITS = {"nanometer": nm, "nm": nm, "micrometer": 1e-6, "micron": 1e-6, "um": 1e-6, "angstrom": 1e-10}


def _envi_grid(listed: np.ndarray, unit: str) -> np.ndarray:
    if unit in ("", "unknown"):
        return _nanometres(listed)
    scale = _ENVI_UNITS.get(unit.replace("metre", "meter").removesuffix("s"))
    if scale is None:
        raise CubeError(f"its wavelengths are in {unit!r}, not in nm or um. Say them: --wavelengths.")
    return listed * scale


def _open_envi(path: Path, options: Options) -> Source:
    """ENVI: a .hdr beside raw values, bsq, bil or bip; wavelengths in the header, values over its factor."""
    header_path = (
        path
        if path.suffix.lower() == ".hdr"
        else next((p for p in (Path(f"{path}.hdr"), path.with_suffix(".hdr")) if p.is_file()), path)
    )
    header = _envi_header(header_path)
    try:
        bands, height, width = (int(header[name]) for name in ("bands", "lines", "samples"))
        kind, interleave = _ENVI_TYPES[int(header["data type"])], header["interleave"].lower()
        axes = _ENVI_AXES[interleave]
        offset, order = int(header.get("header offset", 0)), int(header.get("byte order", 0))
    except (KeyError, ValueError) as error:
        raise CubeError(f"its header lacks or garbles {error}.") from error
    _check_size((bands, height, width), "its header")
    candidates = [header_path.with_suffix(s) for s in ("", ".raw", ".dat", ".img", ".bin", f".{interleave}")]
    raw = next((p for p in candidates if p.is_file() and p != header_path), None)
    if raw is None:
        raise CubeError(f"there are no values beside {header_path.name}.")
    dtype = np.dtype(kind).newbyteorder(">" if order else "<")
    wanted = offset + bands * height * width * dtype.itemsize
    if offset < 0 or raw.stat().st_size != wanted:
        raise CubeError(
            f"{raw.name} has {raw.stat().st_size} bytes, its header says {wanted}: {bands} x {height} x {width} of "
            f"{dtype} behind {offset} bytes."
        )
    sizes = {"bsq": (bands, height, width), "bil": (height, bands, width), "bip": (height, width, bands)}[interleave]
    values = np.memmap(raw, dtype, "r", offset, sizes).transpose(axes)
    grid = None
    if "wavelength" in header:
        listed = np.asarray([float(value) for value in header["wavelength"].strip("{} \n\t,").split(",")])
        grid = _envi_grid(listed, header.get("wavelength units", "").lower())
    divisor = float(header.get("reflectance scale factor", 1) or 1)
    if not divisor > 0:
        raise CubeError(f"its reflectance scale factor is {divisor:g}, expected more than 0.")
    ignored = header.get("data ignore value")
    unit = "reflectance" if "reflectance scale factor" in header else "relative radiance"

    def rows(first: int, last: int) -> tuple[np.ndarray, np.ndarray | None]:
        part = np.asarray(values[:, first:last])
        valid = None if ignored is None else (part != float(ignored)).all(0)
        return _scaled(part, divisor), valid

    return Source(
        scene_name(header_path),
        (bands, height, width),
        _known(path, options, bands, grid),
        unit,
        rows,
        {"scaling": f"/ {divisor:g}", "orientation": "as stored"},
    )


# ---- TIFF and npz --------------------------------------------------------------------------------------------------


def _open_tiff(path: Path, options: Options) -> Source:
    """TIFF: a page per band, or all bands in one page; 8 and 16 bits over their largest value, floats as they are."""
    with tifffile.TiffFile(path) as file:
        if not file.series:
            raise CubeError("it has no pages.")
        series = file.series[0]
        sizes = _check_size(series.shape, "its first series")
        wanted = sum(page.nbytes for page in series.pages if page is not None)
        _check_bomb(wanted, file.filehandle.size)
        if len(file.series) > 1:
            raise CubeError(f"its pages are of {len(file.series)} kinds, expected one size and type.")
        for index, page in enumerate(file.pages):
            ends = [at + count for at, count in zip(page.dataoffsets, page.databytecounts, strict=True)]
            if not ends or min(page.databytecounts) < 1 or max(ends) > file.filehandle.size:
                raise CubeError(f"page {index} is cut off: the file ends before it does.")
        values = series.asarray()
        names = series.axes
    if values.ndim == 2:
        values = values[None]
    if values.ndim != 3 or values.dtype.kind not in "fui":
        raise CubeError(f"it holds {' x '.join(map(str, sizes))} of {values.dtype}, expected bands of numbers.")
    if names.endswith("S") or (options.wavelengths is not None and _last_is_bands(values, options)):
        values = values.transpose(2, 0, 1)
    divisor = _largest(values.dtype)
    grid = _known(path, options, len(values))
    facts = {"scaling": f"/ {divisor:g}", "orientation": "as stored"}
    return Source(scene_name(path), values.shape, grid, "relative radiance", _whole(_scaled(values, divisor)), facts)


def _is_tiff_stack(path: Path) -> bool:
    """A TIFF that is no photograph of three or four colours."""
    if path.suffix.lower() not in (".tif", ".tiff") or not path.is_file():
        return False
    with tifffile.TiffFile(path) as file:
        first: Any = file.pages[0]
        return len(file.pages) > 1 or first.samplesperpixel not in (1, 3, 4)


def _last_is_bands(values: np.ndarray, options: Options) -> bool:
    count = 0 if options.wavelengths is None else len(options.wavelengths)
    return values.shape[0] != count and values.shape[-1] == count


_NPZ_KEYS = ("values", "cube", "data", "bands", "img", "hsi")


def _open_npz(path: Path, options: Options) -> Source:
    """npz: an array (L,H,W) (or (H,W,L)) and `wavelengths` in nm, um or m beside it; values as they are."""
    heads = {}
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            if member.filename.endswith(".npy"):
                with archive.open(member) as file:
                    version = np.lib.format.read_magic(file)
                    reader = (
                        np.lib.format.read_array_header_1_0
                        if version == (1, 0)
                        else (np.lib.format.read_array_header_2_0)
                    )
                    shape, _, dtype = reader(file)
                heads[member.filename.removesuffix(".npy")] = (shape, dtype, member)
    key = options.key or next((name for name in _NPZ_KEYS if name in heads and len(heads[name][0]) == 3), None)
    if options.key is not None and options.key not in heads:
        raise _without(f"array {options.key!r}", heads)
    if key is None:
        raise _without(f"array {' or '.join(_NPZ_KEYS)} of three axes", heads)
    shape, dtype, member = heads[key]
    if dtype.hasobject or dtype.kind not in "fui" or len(shape) != 3:
        raise CubeError(f"its {key!r} is {shape} of {dtype}, expected numbers with three axes.")
    _check_size(shape, f"its {key!r}")
    _check_bomb(int(np.prod(shape, dtype=np.int64)) * dtype.itemsize, path.stat().st_size, f"its {key!r}")
    own = None
    with zipfile.ZipFile(path) as archive:
        values = _npy(archive, member)
        if "wavelengths" in heads and np.prod(heads["wavelengths"][0], dtype=np.int64) <= 10_000:
            own = _npy(archive, heads["wavelengths"][2]).astype(np.float64).ravel()
            own = own if 0 < own.max(initial=0) < 1e-3 else _nanometres(own)
    grid = own if options.wavelengths is None else options.wavelengths
    if grid is not None and values.shape[0] != len(grid) and values.shape[2] == len(grid):
        values = values.transpose(2, 0, 1)
    divisor = _largest(values.dtype)
    grid = _known(path, options, len(values), own)
    facts = {"scaling": f"{key} / {divisor:g}", "orientation": "as stored"}
    return Source(scene_name(path), values.shape, grid, "relative radiance", _whole(_scaled(values, divisor)), facts)


def _npy(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """An array of a zip; its checksum is compared where the member ends, so it is read to there."""
    with archive.open(member) as file:
        values = np.lib.format.read_array(file, allow_pickle=False)
        if file.read(1):
            raise CubeError(f"{member.filename} goes on after its array.")
    return values


# ---- photographs ---------------------------------------------------------------------------------------------------


def _open_rgb(path: Path, options: Options) -> Source:
    """A photograph: reflectances with its colours, upsampled by `spectral.rgb_basis`; light is not put on them."""
    picture = read_picture(path)
    grid = wavelength_grid() if options.bands is None else torch.from_numpy(options.bands)
    scene = Scene.from_rgb(picture, wavelengths=grid, illuminant="E")
    coefficients = scene.coefficients[0].numpy()
    basis = scene.spectra if scene.spectra is not None else torch.eye(len(grid))
    weights = (basis / spectral.illuminant("E", wavelengths=grid).to(basis)).numpy().T.astype(np.float32)  # (L,K)
    _, height, width = coefficients.shape

    def rows(first: int, last: int) -> tuple[np.ndarray, None]:
        return np.maximum(np.einsum("lk,khw->lhw", weights, coefficients[:, first:last]), 0), None

    if options.depth is not None and options.depth.shape != (height, width):
        raise CubeError(f"its depth map is {options.depth.shape}, the photograph {(height, width)}.")
    facts = {"scaling": "linear sRGB, upsampled (Mallett and Yuksel 2019)", "orientation": "as EXIF says"}
    shape = (len(grid), height, width)
    return Source(scene_name(path), shape, grid.numpy(), "reflectance", rows, facts, depth=options.depth)


def resampled(source: Source, target: np.ndarray, *, method: str = "pchip", edge: str = "error") -> Source:
    """A source on another grid of wavelengths: see `bands.resampling`. Bands that were guessed are marked."""
    if len(target) == len(source.wavelengths) and np.allclose(target, source.wavelengths, rtol=0, atol=1e-4 * nm):
        return source
    try:
        found = resampling(source.wavelengths, target, method=method, edge=edge)
    except ValueError as error:
        raise CubeError(str(error)) from error

    def rows(first: int, last: int) -> tuple[np.ndarray, np.ndarray | None]:
        values, valid = source.checked_rows(first, last)
        return found.apply(values), valid

    guessed = found.extrapolated
    if source.extrapolated is not None:  # a band that leans on a guess is one
        guessed = guessed | (found.matrix[:, source.extrapolated] != 0).any(1)
    facts = {**source.facts, "resampled": f"{method} from {len(source.wavelengths)} bands"}
    shape = (len(target), *source.shape[1:])
    return replace(source, shape=shape, wavelengths=target, rows=rows, facts=facts, extrapolated=guessed)


def _suffix(*suffixes: str) -> Callable[[Path], bool]:
    return lambda path: path.is_file() and path.suffix.lower() in suffixes


PICTURES = (".jpg", ".jpeg", ".png", ".webp", ".bmp")
SUFFIXES = (".exr", ".mat", ".hdr", ".tif", ".tiff", ".npz", *PICTURES)

FORMATS: dict[str, Format] = {
    row.name: row
    for row in (
        Format("kcam", "the cube files of kcam", is_cube, lambda path, _: open_cube(path)),
        Format(
            "kaist",
            "EXR with channels w420nm ... w720nm",
            _suffix(".exr"),
            _open_kaist,
            {"citation": "Choi et al., High-quality hyperspectral reconstruction using a spectral prior, ToG 2017"},
        ),
        Format(
            "cave",
            "a folder X_ms of 31 PNGs of 16 bits",
            lambda path: path.is_dir() and bool(_cave_files(path)),
            _open_cave,
            {"citation": "Yasuma et al., Generalized assorted pixel camera, TIP 2010"},
        ),
        Format(
            "icvl",
            "MATLAB 7.3 with rad and bands",
            lambda path: _is_matlab(path, "7.3") and {"rad", "bands"} <= _hdf5_keys(path),
            _open_icvl,
            {"citation": "Arad and Ben-Shahar, Sparse recovery of hyperspectral signal, ECCV 2016"},
        ),
        Format(
            "arad1k",
            "MATLAB 7.3 with cube and bands",
            lambda path: _is_matlab(path, "7.3") and {"cube", "bands"} <= _hdf5_keys(path),
            _open_arad,
            {"citation": "Arad et al., NTIRE 2022 spectral recovery challenge, CVPRW 2022"},
        ),
        Format(
            "harvard",
            "MATLAB 5 with ref and lbl, calib.txt beside it",
            lambda path: _is_matlab(path, "5.0") and {"ref", "lbl"} <= set(_mat_arrays(path)),
            _open_harvard,
            {"citation": "Chakrabarti and Zickler, Statistics of real-world hyperspectral images, CVPR 2011"},
        ),
        Format(
            "cassi28",
            "MATLAB 5 with HSI, img_expand, data_slice, img or img_hs",
            lambda path: _is_matlab(path, "5.0") and bool(set(_CASSI_KEYS) & set(_mat_arrays(path))),
            _open_cassi,
        ),
        Format("envi", "ENVI: .hdr beside raw values", _suffix(".hdr"), _open_envi),
        Format("tiff", "TIFF, a page per band or all in one", _is_tiff_stack, _open_tiff),
        Format("npz", "npz with an array of three axes and wavelengths", _suffix(".npz"), _open_npz),
        Format("rgb", "a photograph, upsampled to spectra", lambda path: False, _open_rgb),
    )
}
"""Photographs are never recognised: that spectra are to be made up for them must be said."""
