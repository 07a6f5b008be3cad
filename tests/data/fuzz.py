"""Damaged and hostile files, each made from a seed, and what a reader may say of them.

A reader either refuses a file in one clear line, or gives the values of the undamaged file. Where a format has no
checksum, a change inside it reads as what it says: as `plainly`, a decoder without any of kcam's code, reads it.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import OpenEXR
import tifffile
import writers
from PIL import Image
from scipy.io import loadmat, savemat
from writers import Written

from kcam.data import CubeError, read_cube
from kcam.units import nm

CAVE31 = np.asarray(writers.GRID_400) * nm


@dataclass(frozen=True)
class Damaged:
    """path, how: for read_cube. clean: values and wavelengths [nm] before the damage; None: it must be refused."""

    name: str
    path: Path
    clean: Written | None
    how: dict[str, Any] = field(default_factory=dict)
    checked: bool = False  # every byte of the values is under a checksum, or its size is
    canary: Path | None = None  # a file that appears if something was unpickled


# ---- damage that may happen to any file


def _rgb(folder: Path) -> Written:
    pixels = np.random.default_rng(3).integers(0, 256, (12, 17, 3), np.uint8)
    path = folder / "photo.png"
    Image.fromarray(pixels).save(path)
    cube = read_cube(path, format="rgb")  # against itself: here only the damage is looked at
    return Written(path, cube.values.numpy(), tuple((cube.wavelengths / nm).tolist()), 0, "rgb", "reflectance")


WRITERS: dict[str, Callable[[Path], Written]] = {
    **{
        name: writers.ALL[name]
        for name in (
            "kaist", "kaist half", "kaist uncompressed", "cave", "cave flat", "icvl", "icvl gzip", "arad1k",
            "arad1k gzip", "harvard", "harvard raw", "cassi HSI", "cassi img_expand", "cassi img_hs",
            "envi bsq u2 little", "envi bil f4 big", "envi bip i2 big", "npz", "npz m raw", "kcam", "kcam plain",
        )
    },
    "cassi raw": lambda folder: writers.cassi(folder, "data_slice", compressed=False),
    "tiff pages u2": writers.TIFFS["tiff pages u2"],
    "tiff contiguous f4": writers.TIFFS["tiff contiguous f4"],
    "tiff planar u1": writers.TIFFS["tiff planar u1"],
    "tiff zlib": lambda folder: writers.tiff(folder, compression="zlib"),
    "rgb": _rgb,
}  # fmt: skip
_CHECKED = ("cave", "npz", "rgb", "tiff zlib", "harvard", "cassi HSI", "cassi img_expand", "cassi img_hs", "cave flat")
"""Values under a checksum: PNG and zip by CRC, MATLAB 5 and TIFF by zlib's Adler."""


def _truncate(content: bytearray, random: np.random.Generator) -> bytearray:
    return content[: int(random.integers(1, len(content)))]


def _flip(content: bytearray, random: np.random.Generator) -> bytearray:
    for place in random.integers(0, len(content), random.integers(1, 5)):
        content[place] ^= 1 << int(random.integers(0, 8))
    return content


def _zero(content: bytearray, random: np.random.Generator) -> bytearray:
    start = int(random.integers(0, len(content)))
    length = int(random.integers(1, max(2, len(content) // 8)))
    content[start : start + length] = bytes(min(length, len(content) - start))
    return content


def _head(content: bytearray, random: np.random.Generator) -> bytearray:
    for _ in range(3):
        content[int(random.integers(0, min(600, len(content))))] = int(random.integers(0, 256))
    return content


def _absurd(content: bytearray, random: np.random.Generator) -> bytearray:
    """A number of a header becomes as large as it can: sizes, counts, offsets."""
    start = int(random.integers(0, min(2000, len(content) - 4))) // 4 * 4
    value = [b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x7f\xff\xff\xff", b"\0\0\0\x80"][int(random.integers(0, 4))]
    content[start : start + 4] = value
    return content


def _cross(content: bytearray, random: np.random.Generator) -> bytearray:
    heads = (b"\x89PNG\r\n\x1a\n", b"II*\0", b"MM\0*", b"\x76\x2f\x31\x01", b"PK\3\4", b"\x89HDF\r\n\x1a\n", b"ENVI\n")
    head = heads[int(random.integers(0, len(heads)))] + random.bytes(24)
    content[: len(head)] = head
    return content


DAMAGES: dict[str, Callable[[bytearray, np.random.Generator], bytearray]] = {
    "truncated": _truncate,
    "flipped": _flip,
    "zeroed": _zero,
    "head": _head,
    "absurd": _absurd,
    "crossed": _cross,
}


def damaged(seed: int, folder: Path) -> Damaged:
    """Any format, any damage; the same for the same seed."""
    random = np.random.default_rng(seed)
    name = list(WRITERS)[seed % len(WRITERS)]
    what = list(DAMAGES)[int(random.integers(0, len(DAMAGES)))]
    written = WRITERS[name](folder)
    target = written.target
    if name.startswith("envi") and random.random() < 0.5:
        target = written.path
    if name.startswith("harvard") and random.random() < 0.2:
        target = folder / "calib.txt"
    content = DAMAGES[what](bytearray(target.read_bytes()), random)
    target.write_bytes(content)
    how: dict[str, Any] = {"wavelengths": CAVE31} if name.startswith("tiff") else {}
    how |= {"format": "rgb"} if name == "rgb" else {}
    checked = target.suffix != ".txt" and (name in _CHECKED or (what == "truncated" and target.suffix != ".hdr"))
    return Damaged(f"{seed}: {name}, {what} {target.name}", written.path, written, how, checked)


# ---- files that mean harm


class _Harm:
    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return (open, (self.path, "w"))


def _objects(folder: Path) -> np.ndarray:
    return np.array([[[_Harm(str(folder / "canary"))] * 2] * 2] * 3, dtype=object)


def _npy_bytes(header: str, data: bytes = b"") -> bytes:
    text = header.encode() + b" " * (63 - (10 + len(header)) % 64) + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text + data


def _zip(path: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def _npz_with(folder: Path, header: str, data: bytes = b"") -> Path:
    grid = io.BytesIO()
    np.save(grid, np.arange(400.0, 431.0))
    return _zip(folder / "a.npz", {"cube.npy": _npy_bytes(header, data), "wavelengths.npy": grid.getvalue()})


def _head_of(shape: str, kind: str = "<f4") -> str:
    return f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"


def _hdf5(folder: Path, make: Callable[[h5py.File], object], *, bands: Any = None) -> Path:
    path = folder / "a.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        file.create_dataset("bands", data=np.arange(400.0, 701.0, 10)[:, None] if bands is None else bands)
        make(file)
    writers._user_block(path)
    return path


def _external(folder: Path) -> Path:
    (folder / "secret").write_bytes(bytes(1000))
    return _hdf5(
        folder, lambda f: f.create_dataset("rad", (31, 4, 5), "u1", external=[(str(folder / "secret"), 0, 620)])
    )


def _link(folder: Path) -> Path:
    with h5py.File(folder / "b.h5", "w") as file:
        file["rad"] = np.ones((31, 4, 5))

    def make(file: h5py.File) -> None:
        file["rad"] = h5py.ExternalLink(str(folder / "b.h5"), "rad")

    return _hdf5(folder, make)


def _cycle(folder: Path) -> Path:
    def make(file: h5py.File) -> None:
        file["rad"] = h5py.SoftLink("/rad")

    return _hdf5(folder, make)


def _hdf5_bomb(folder: Path) -> Path:
    how = {"chunks": (1, 1300, 1300), "compression": "gzip", "compression_opts": 9}
    return _hdf5(folder, lambda f: f.create_dataset("rad", data=np.zeros((31, 1300, 1300), "f4"), **how))


def _mat_bomb(folder: Path) -> Path:
    savemat(folder / "a.mat", {"HSI": np.zeros((1300, 1300, 56), np.uint8)}, do_compression=True)
    return folder / "a.mat"


def _mat_of(value: Any) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        savemat(folder / "a.mat", {"HSI": value})
        return folder / "a.mat"

    return make


def _png_bomb(width: int, height: int) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        written = writers.cave(folder)
        data = zlib.compress(bytes(2_000_000), 9)
        chunk = b"IDAT" + data
        end = b"IDAT" + data
        written.target.write_bytes(
            writers.png_header(width, height)
            + struct.pack(">I", len(data)) + chunk + struct.pack(">I", zlib.crc32(end))
            + struct.pack(">I", 0) + b"IEND" + struct.pack(">I", zlib.crc32(b"IEND"))
        )  # fmt: skip
        return written.path

    return make


def _tiff_with(tag: int, value: int) -> Callable[[Path], Path]:
    """A stack whose first page has another value in a tag."""

    def make(folder: Path) -> Path:
        path = writers.tiff(folder).path
        with tifffile.TiffFile(path, mode="r+") as file:
            file.pages[0].tags[tag].overwrite(value)
        return path

    return make


def _tiff_loop(folder: Path) -> Path:
    path = writers.tiff(folder).path
    with tifffile.TiffFile(path) as file:
        pages = list(file.pages)
        first, last = pages[0].offset, pages[-1].offset
    content = bytearray(path.read_bytes())
    count = struct.unpack_from("<H", content, last)[0]
    struct.pack_into("<I", content, last + 2 + 12 * count, first)
    path.write_bytes(content)
    return path


def _tiff_bomb(folder: Path) -> Path:
    path = folder / "a.tif"
    tifffile.imwrite(path, np.zeros((31, 1300, 1300), "f4"), photometric="minisblack", compression="zlib")
    return path


def _exr_window(right: int, bottom: int) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = writers.kaist(folder).path
        content = path.read_bytes()
        old = struct.pack("<iiii", 0, 0, 16, 11)
        assert old in content
        path.write_bytes(content.replace(old, struct.pack("<iiii", 0, 0, right, bottom)))
        return path

    return make


def _envi_with(pattern: str, text: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        written = writers.envi(folder)
        header = written.path.read_text()
        changed = re.sub(pattern, text, header, count=1)
        assert changed != header
        written.path.write_text(changed)
        return written.path

    return make


def _kcam_with(**changes: Any) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = folder / "a.tif"
        document = {
            "kcam_cube": 1,
            "name": "../../evil",
            "wavelengths_nm": [500, 600],
            "unit": "radiance",
            "extrapolated": [False, False],
            "source": {},
        }
        text = json.dumps(document | changes)
        tifffile.imwrite(path, np.ones((2, 4, 5), "f4"), photometric="minisblack", metadata=None, description=text)
        return path

    return make


def _empty(suffix: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / f"a{suffix}").write_bytes(b"")
        return folder / f"a{suffix}"

    return make


def _folder(suffix: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / f"a{suffix}").mkdir()
        return folder / f"a{suffix}"

    return make


def _loop(folder: Path) -> Path:
    (folder / "a.mat").symlink_to(folder / "b.mat")
    (folder / "b.mat").symlink_to(folder / "a.mat")
    return folder / "a.mat"


def _fifo(folder: Path) -> Path:
    os.mkfifo(folder / "a.mat")
    return folder / "a.mat"


def _fifo_in_cave(folder: Path) -> Path:
    written = writers.cave(folder)
    written.target.unlink()
    os.mkfifo(written.target)
    return written.path


def _pickle(folder: Path) -> Path:
    (folder / "a.npz").write_bytes(pickle.dumps(_objects(folder)))
    return folder / "a.npz"


def _npz_objects(folder: Path) -> Path:
    np.savez(folder / "a.npz", cube=_objects(folder), wavelengths=np.array([400.0, 500, 600]))
    return folder / "a.npz"


def _npz_object_grid(folder: Path) -> Path:
    np.savez(folder / "a.npz", cube=np.ones((3, 2, 2)), wavelengths=_objects(folder)[:, 0, 0])
    return folder / "a.npz"


def _npz_bomb(folder: Path) -> Path:
    return _npz_with(folder, _head_of("(31, 1300, 1300)"), bytes(31 * 1300 * 1300 * 4))


HOSTILE: dict[str, tuple[Callable[[Path], Path], dict[str, Any]]] = {
    "npz of pickled objects": (_npz_objects, {}),
    "npz with pickled wavelengths": (_npz_object_grid, {}),
    "npz that is a pickle": (_pickle, {}),
    "npz bomb": (_npz_bomb, {}),
    "npz with a shape of 3e12": (lambda f: _npz_with(f, _head_of("(31, 316227, 316227)")), {}),
    "npz with a negative shape": (lambda f: _npz_with(f, _head_of("(31, -4, -5)")), {}),
    "npz with a shape of text": (lambda f: _npz_with(f, _head_of("'x'")), {}),
    "npz with code for a shape": (lambda f: _npz_with(f, _head_of("(__import__('os').getpid(), 2, 3)")), {}),
    "npz with nested brackets": (lambda f: _npz_with(f, "(" * 5000 + ")" * 5000), {}),
    "npz too short": (lambda f: _npz_with(f, _head_of("(31, 4, 5)"), bytes(100)), {}),
    "npz too long": (lambda f: _npz_with(f, _head_of("(31, 4, 5)"), bytes(31 * 80 + 1)), {}),
    "npz with a path": (lambda f: _zip(f / "a.npz", {"../../cube.npy": _npy_bytes(_head_of("(3, 4, 5)"))}), {}),
    "npz of text": (lambda f: _zip(f / "a.npz", {"cube.npy": b"hello"}), {}),
    "npz of nothing": (lambda f: _zip(f / "a.npz", {}), {}),
    "npz of structures": (
        lambda f: _npz_with(f, "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (3,)}"), {}),
    "npz of complex numbers": (lambda f: _npz_with(f, _head_of("(31, 1, 1)", "<c8"), bytes(248)), {}),
    "hdf5 with values elsewhere": (_external, {}),
    "hdf5 with a link elsewhere": (_link, {}),
    "hdf5 link to itself": (_cycle, {}),
    "hdf5 bomb": (_hdf5_bomb, {}),
    "hdf5 without its chunks": (
        lambda f: _hdf5(f, lambda g: g.create_dataset("rad", (31, 9000, 9000), "f4", chunks=(1, 64, 64))), {}),
    "hdf5 of strings": (lambda f: _hdf5(f, lambda g: g.create_dataset("rad", (3, 4, 5), h5py.string_dtype())), {}),
    "hdf5 of references": (lambda f: _hdf5(f, lambda g: g.create_dataset("rad", (3, 4, 5), h5py.ref_dtype)), {}),
    "hdf5 with bands of text": (
        lambda f: _hdf5(f, lambda g: g.create_dataset("rad", data=np.ones((3, 4, 5))), bands=[b"a", b"b", b"c"]), {}),
    "hdf5 with bands of nan": (
        lambda f: _hdf5(f, lambda g: g.create_dataset("rad", data=np.ones((3, 4, 5))), bands=[400, np.nan, 500]), {}),
    "hdf5 of nan": (lambda f: _hdf5(f, lambda g: g.create_dataset("rad", data=np.full((31, 4, 5), np.nan))), {}),
    "mat bomb": (_mat_bomb, {}),
    "mat of cells": (_mat_of(_objects(Path("/nowhere"))[:, :, 0].astype(str).astype(object)), {}),
    "mat of a structure": (_mat_of({"a": np.ones(3)}), {}),
    "mat of text": (_mat_of("hello"), {}),
    "mat of complex numbers": (_mat_of(np.ones((4, 5, 28)) * 1j), {}),
    "mat of two axes": (_mat_of(np.ones((4, 28))), {}),
    "mat of nothing": (_mat_of(np.ones((4, 0, 28))), {}),
    "png of 1e10 pixels": (_png_bomb(100_000, 100_000), {}),
    "png of 9e8 pixels": (_png_bomb(30_000, 30_000), {}),
    "png of no width": (_png_bomb(0, 12), {}),
    "tiff 4e9 wide": (_tiff_with(256, 2**32 - 1), {"wavelengths": CAVE31}),
    "tiff 60000 high": (_tiff_with(257, 60_000), {"wavelengths": CAVE31}),
    "tiff of 60000 samples": (_tiff_with(277, 60_000), {"wavelengths": CAVE31}),
    "tiff of unknown compression": (_tiff_with(259, 77), {"wavelengths": CAVE31}),
    "tiff with values beyond its end": (_tiff_with(273, 2**31), {"wavelengths": CAVE31}),
    "tiff with pages in a circle": (_tiff_loop, {"wavelengths": CAVE31}),
    "tiff bomb": (_tiff_bomb, {"wavelengths": CAVE31}),
    "exr of 4e18 pixels": (_exr_window(2**31 - 2, 2**31 - 2), {}),
    "exr of 1e9 pixels": (_exr_window(30_000, 30_000), {}),
    "exr upside down": (_exr_window(-5, -5), {}),
    "envi of 1e9 lines": (_envi_with(r"lines   = 12", "lines = 1000000000"), {}),
    "envi of -12 lines": (_envi_with(r"lines   = 12", "lines = -12"), {}),
    "envi of one line fewer": (_envi_with(r"lines   = 12", "lines = 11"), {}),
    "envi of no bands": (_envi_with(r"bands   = 31", "bands = 0"), {}),
    "envi of type 6": (_envi_with(r"data type = 12", "data type = 6"), {}),
    "envi interleaved somehow": (_envi_with(r"interleave = bsq", "interleave = bxx"), {}),
    "envi that begins before its file": (_envi_with(r"header offset = 0", "header offset = -10"), {}),
    "envi with factor 0": (_envi_with(r"factor = 10000", "factor = 0"), {}),
    "envi with factor nan": (_envi_with(r"factor = 10000", "factor = nan"), {}),
    "envi with wavelengths of text": (_envi_with(r"410\.0", "4x10.0"), {}),
    "kcam with wavelengths of NaN": (_kcam_with(wavelengths_nm=[500, float("nan")]), {}),
    "kcam with wavelengths in the x-rays": (_kcam_with(wavelengths_nm=[500, 1e-3]), {}),
    "kcam of version 99": (_kcam_with(kcam_cube=99), {}),
    "kcam without its marks": (_kcam_with(extrapolated=[]), {}),
    "kcam with a list for its facts": (_kcam_with(source=[1, 2]), {}),
    **{f"empty {suffix}": (_empty(suffix), {}) for suffix in (".exr", ".mat", ".hdr", ".tif", ".npz", ".npy", ".png")},
    **{
        f"empty {suffix} as {name}": (_empty(suffix), {"format": name})
        for suffix, name in (
            (".exr", "kaist"), (".mat", "icvl"), (".mat", "harvard"), (".tif", "tiff"), (".png", "rgb"),
        )
    },
    **{
        f"a folder as {name}": (_folder(suffix), {"format": name})
        for suffix, name in (
            (".exr", "kaist"), (".mat", "arad1k"), (".mat", "cassi28"), (".hdr", "envi"), (".tif", "kcam"),
            (".npz", "npz"), ("_ms", "cave"), (".png", "rgb"),
        )
    },
    "a folder a.mat": (_folder(".mat"), {}),
    "links in a circle": (_loop, {}),
    "a pipe": (_fifo, {"format": "icvl"}),
    "a pipe in CAVE": (_fifo_in_cave, {}),
}  # fmt: skip
BOMBS = [name for name in HOSTILE if name.endswith("bomb")]
"""These take a second each to make."""


def hostile(name: str, folder: Path) -> Damaged:
    make, how = HOSTILE[name]
    return Damaged(name, make(folder), None, how, canary=folder / "canary")


# ---- the verdict


def plainly(case: Damaged) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values, wavelengths [nm] and mask as the bytes say, by the libraries alone."""
    assert case.clean is not None
    path, kind = case.path, case.clean.format
    valid = None
    if kind == "kaist":
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {key: np.asarray(channel.pixels) for key, channel in file.channels().items()}
        bands = sorted((float(key[1:-2]), key) for key in channels if key.startswith("w"))
        values, grid = np.stack([channels[key] for _, key in bands]), np.array([value for value, _ in bands])
    elif kind in ("icvl", "arad1k"):
        with h5py.File(path, "r") as file:
            with np.errstate(all="ignore"):  # cubes are float32: what is beyond it has no value
                values = file["rad" if kind == "icvl" else "cube"][()].transpose(0, 2, 1).astype(np.float32)
            values = values / np.float32(4095 if kind == "icvl" else 1)
            grid = file["bands"][()].ravel()
    elif kind == "harvard":
        content = loadmat(path)
        values = (content["ref"] / np.loadtxt(path.parent / "calib.txt")).transpose(2, 0, 1)
        valid, grid = content["lbl"] > 0, np.asarray(writers.GRID_420, float)
    elif kind == "cassi28":
        key = next(key for key in loadmat(path) if not key.startswith("_"))
        values = np.clip(loadmat(path)[key].transpose(2, 0, 1) / 65535, 0, 1)
        grid = np.asarray(writers.CASSI)
    elif kind == "envi":
        text = path.read_text(errors="replace")
        got = {key: re.search(rf"^{key} *= *(.*)$", text, re.MULTILINE) for key in ("samples", "bands", "data type")}
        number = {key: int(found[1]) for key, found in got.items() if found}
        number["lines"] = int(re.search(r"^lines *= *(\d+)", text, re.MULTILINE)[1])
        kind_of = {code: name for name, code in writers._TYPES.items()}[number["data type"]]
        order = ">" if re.search(r"byte order *= *1", text) else "<"
        size = {"l": number["lines"], "s": number["samples"], "b": number["bands"]}
        axes = {"bsq": "bls", "bil": "lbs", "bip": "lsb"}[re.search(r"interleave *= *(\w+)", text)[1].lower()]
        stored = np.fromfile(case.clean.target, order + kind_of).reshape([size[axis] for axis in axes])
        factor = re.search(r"^reflectance scale factor *= *(\S+)", text, re.MULTILINE | re.IGNORECASE)
        with np.errstate(all="ignore"):  # damaged floats
            values = stored.transpose([axes.index(axis) for axis in "bls"]) / (float(factor[1]) if factor else 1)
        listed = re.search(r"^wavelength *= *\{([^}]*)\}", text, re.MULTILINE)[1]
        grid = np.array([float(value) for value in listed.split(",")])
    elif kind == "tiff":
        with tifffile.TiffFile(path) as file:
            values = file.series[0].asarray()
        values = values if len(values) == 31 else values.transpose(2, 0, 1)
        values = values / {"uint8": 255.0, "uint16": 65535.0}.get(values.dtype.name, 1.0)
        grid = np.asarray(writers.GRID_400, float)
    else:
        assert kind == "kcam", kind
        with tifffile.TiffFile(path) as file:
            grid = np.asarray(json.loads(file.pages[0].description)["wavelengths_nm"])
            values = np.stack([page.asarray() for page in file.pages[: len(grid)]])
            masks = [page.asarray() > 0 for page in file.pages[len(grid) :] if page.dtype == np.uint8]
        valid = masks[0] if masks else None
    with np.errstate(all="ignore"):
        values = values.astype(np.float32)
    finite = np.isfinite(values).all(0)
    return values, grid, finite if valid is None else finite & valid


def verdict(case: Damaged) -> str:
    """ "refused", "same" or "as it says"; AssertionError for anything else."""
    try:
        cube = read_cube(case.path, **case.how)
    except (CubeError, FileNotFoundError) as error:
        text = str(error)
        assert text.strip() and "\n" not in text and len(text) < 600, f"{case.name}: no clear line: {text!r}"  # noqa: PT018
        outcome = f"refused: {text}"
    else:
        assert case.clean is not None, f"{case.name} was read as {cube.shape}"
        values, grid = cube.values.numpy(), cube.wavelengths.numpy() / nm
        mask = np.ones(values.shape[1:], bool) if cube.mask is None else cube.mask.all(0).numpy()
        clean = case.clean
        whole = np.ones(clean.values.shape[1:], bool) if clean.mask is None else clean.mask
        if _equal((values, grid, mask), (clean.values, np.asarray(clean.nm), whole), clean.quantum):
            outcome = "same"
        else:
            assert not case.checked, f"{case.name}: was read, and is not what was written"
            assert _equal((values, grid, mask), plainly(case), 2e-6), f"{case.name}: is not what its bytes say"
            outcome = "as it says"
    assert case.canary is None or not case.canary.exists(), f"{case.name} was unpickled"
    return outcome


def _equal(one: tuple[np.ndarray, ...], other: tuple[np.ndarray, ...], quantum: float) -> bool:
    (values, grid, mask), (values_2, grid_2, mask_2) = one, other
    if values.shape != values_2.shape or grid.shape != grid_2.shape or not (mask == mask_2).all():
        return False
    close = np.isclose(values[:, mask], values_2[:, mask], rtol=1e-6, atol=quantum)
    return bool(close.all()) and np.allclose(grid, grid_2, rtol=1e-9, atol=1e-6)
