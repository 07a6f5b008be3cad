"""Small files in the layout of each public data set, written without any of kcam's code.

Each writer takes a cube (L,H,W) in 0..1 and its wavelengths [nm], and returns what a reader must give: the path, the
values (L,H,W) and the largest error that the format's own rounding makes.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import h5py
import numpy as np
import OpenEXR
import tifffile
from PIL import Image
from scipy.io import savemat

CASSI = (
    453.5, 457.5, 462, 466, 471.5, 476.5, 481.5, 487, 492.5, 498, 504, 510, 516, 522.5,
    529.5, 536.5, 544, 551.5, 558.5, 567.5, 575.5, 584.5, 594.5, 604, 614.5, 625, 636.5, 648,
)  # fmt: skip
GRID_400 = tuple(range(400, 701, 10))
GRID_420 = tuple(range(420, 721, 10))


@dataclass(frozen=True)
class Written:
    """path: to read. values: (L,H,W) that must come back, within `quantum`. nm: wavelengths, in their order."""

    path: Path
    values: np.ndarray
    nm: tuple[float, ...]
    quantum: float
    format: str
    unit: str
    mask: np.ndarray | None = None
    damaged: Path | None = None  # the file to damage, where the path is a folder or a header

    @property
    def target(self) -> Path:
        return self.damaged or self.path


def cube(bands: int, height: int = 12, width: int = 17, seed: int = 0) -> np.ndarray:
    """Values in 0.05..0.95 that no flip or transposition leaves as they are; smooth over wavelength."""
    random = np.random.default_rng(seed)
    knots = random.uniform(0.05, 0.95, (8, height, width))
    place = np.linspace(0, 6.999, bands)
    low = place.astype(int)
    share = (place - low)[:, None, None]
    return knots[low] * (1 - share) + knots[low + 1] * share


def _counts(values: np.ndarray, largest: int) -> np.ndarray:
    return np.rint(values * largest).astype(np.uint16)


# ---- EXR


def kaist(
    folder: Path,
    values: np.ndarray | None = None,
    nm: tuple[float, ...] = GRID_420,
    *,
    half: bool = False,
    compression: str = "ZIP_COMPRESSION",
    name: str = "scene_kaist",
) -> Written:
    values = cube(len(nm)) if values is None else values
    stored = values.astype(np.float16 if half else np.float32)
    channels = {f"w{wavelength:g}nm": plane.copy() for wavelength, plane in zip(nm, stored, strict=True)}
    for place, colour in enumerate("RGB"):
        channels[colour] = np.full_like(stored[0], 0.1 * place)
    shuffled = np.random.default_rng(1).permutation(sorted(channels))
    header = {"compression": getattr(OpenEXR, compression), "type": OpenEXR.scanlineimage}
    path = folder / f"{name}.exr"
    OpenEXR.File(header, {str(key): channels[str(key)] for key in shuffled}).write(str(path))
    order = np.argsort(nm)  # a reader is free in the order, so long as wavelengths and values go together
    return Written(
        path, stored[order].astype(np.float32), tuple(float(nm[i]) for i in order), 0, "kaist", "reflectance"
    )


# ---- CAVE


def cave(
    folder: Path, *, nested: bool = True, writer: str = "cv2", name: str = "toy_ms", colour: bool = False
) -> Written:
    values = cube(31)
    counts = _counts(values, 65535)
    scene = folder / name
    inner = scene / name if nested else scene
    inner.mkdir(parents=True)
    for number, plane in enumerate(counts, 1):
        path = inner / f"{name}_{number:02d}.png"
        if colour:
            assert cv2.imwrite(str(path), np.stack([plane] * 3, axis=-1))
        elif writer == "cv2":
            assert cv2.imwrite(str(path), plane)
        else:
            Image.fromarray(plane).save(path)
    Image.fromarray(np.zeros((12, 17, 3), np.uint8)).save(inner / f"{name.removesuffix('_ms')}_RGB.bmp")
    (inner / "Thumbs.db").write_bytes(b"\xd0\xcf\x11\xe0" + bytes(60))
    (folder / "__MACOSX" / name).mkdir(parents=True, exist_ok=True)
    (folder / "__MACOSX" / name / f"._{name}_01.png").write_bytes(b"\0\5\x16\7")
    (inner / f"._{name}_01.png").write_bytes(b"\0\5\x16\7")
    return Written(
        scene,
        counts / 65535,
        GRID_400,
        1e-7,
        "cave",
        "reflectance",
        damaged=inner / f"{name}_07.png",
    )


# ---- MATLAB 7.3


def _user_block(path: Path) -> None:
    """The 512 bytes that MATLAB 7.3 puts before its HDF5."""
    text = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Mon Jan  1 00:00:00 2018 HDF5 schema 1.00 ."
    with path.open("r+b") as file:
        file.write(text.ljust(116) + bytes(8) + b"\x00\x02IM")


def _matlab73(path: Path, arrays: dict[str, np.ndarray], **how: object) -> None:
    """Arrays in MATLAB's order of axes; in HDF5 they stand with their axes reversed."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for key, array in arrays.items():
            stored = np.ascontiguousarray(array.T)
            dataset = file.create_dataset(key, data=stored, **(how if stored.ndim == 3 else {}))
            dataset.attrs["MATLAB_class"] = np.bytes_("double" if array.dtype == np.float64 else "single")
    _user_block(path)


def icvl(folder: Path, *, name: str = "lst_0924-1015", **how: object) -> Written:
    values = cube(31)
    counts = _counts(values, 4095)
    path = folder / f"{name}.mat"
    upright = counts.transpose(1, 2, 0).astype(np.float64)  # MATLAB's (H,W,31)
    rgb = np.zeros((12, 17, 3))
    _matlab73(path, {"rad": upright, "bands": np.asarray([GRID_400], dtype=np.float64), "rgb": rgb}, **how)
    return Written(path, counts / 4095, GRID_400, 1e-7, "icvl", "relative radiance")


def arad1k(folder: Path, *, name: str = "ARAD_1K_0001", **how: object) -> Written:
    values = cube(31).astype(np.float32)
    path = folder / f"{name}.mat"
    bands = np.asarray([GRID_400], dtype=np.float64)
    _matlab73(path, {"cube": values.transpose(1, 2, 0), "bands": bands}, **how)
    return Written(path, values, GRID_400, 0, "arad1k", "relative radiance")


# ---- MATLAB 5


def harvard(folder: Path, *, name: str = "img1", compressed: bool = True) -> Written:
    values = cube(31)
    divisors = np.linspace(0.6, 1.7, 31)
    labels = np.ones((12, 17), np.uint8)
    labels[3:5, 4:9] = 0
    labels[8:, 10:] = 2  # regions are numbered; 0 alone is invalid
    ref = (values * divisors[:, None, None]).transpose(1, 2, 0)
    path = folder / f"{name}.mat"
    savemat(path, {"ref": ref, "lbl": labels}, do_compression=compressed)
    (folder / "calib.txt").write_text("\n".join(f"{value:.9f}" for value in divisors) + "\n")
    return Written(path, values, GRID_420, 1e-6, "harvard", "relative radiance", mask=labels > 0)


def cassi(folder: Path, key: str = "HSI", *, name: str | None = None, compressed: bool = True) -> Written:
    """The five variants: `img` in 0..1, and as `img16` the same key with counts."""
    grid: tuple[float, ...] = GRID_400 if key == "img_hs" else CASSI
    values = cube(len(grid))
    divisor = {"img_expand": 65536, "img16": 65536, "data_slice": 65535, "img_hs": 65535}.get(key)
    stored = values if divisor is None else _counts(values, 65535)
    arrays = {key.removesuffix("16"): stored.transpose(1, 2, 0)}
    if key == "img_hs":
        arrays["wvls2b"] = np.asarray([grid], dtype=np.float64)
    path = folder / f"{name or 'scene01_' + key}.mat"
    savemat(path, arrays, do_compression=compressed)
    expected = stored / (divisor or 1)
    return Written(path, expected, grid, 1e-7, "cassi28", "relative radiance")


# ---- ENVI

_TYPES = {"u1": 1, "i2": 2, "i4": 3, "f4": 4, "f8": 5, "u2": 12, "u4": 13}


def envi(
    folder: Path,
    *,
    interleave: str = "bsq",
    kind: str = "u2",
    big_endian: bool = False,
    offset: int = 0,
    factor: int | None = 10000,
    units: str = "Nanometers",
    ignore: bool = False,
    nm: tuple[float, ...] = GRID_400,
    name: str = "envi_scene",
    suffix: str = "",
) -> Written:
    values = cube(len(nm))
    scale = factor or (100 if kind[0] != "f" else 1)
    stored = (np.rint(values * scale) if kind[0] != "f" else values * scale).astype(kind)
    mask = None
    if ignore:
        stored[:, 2:4, 5:8] = 9999
        mask = np.ones(stored.shape[1:], bool)
        mask[2:4, 5:8] = False
    axes = {"bsq": (0, 1, 2), "bil": (1, 0, 2), "bip": (1, 2, 0)}[interleave]
    raw = folder / f"{name}{suffix}"
    raw.write_bytes(bytes(offset) + stored.transpose(axes).astype((">" if big_endian else "<") + kind).tobytes())
    listed = [f"{value / (1000 if units.startswith('Micro') else 1):.6f}" for value in nm]
    lines = [
        "ENVI",
        "description = {",
        "  a toy, samples = 5, made by a test}",
        f"samples = {stored.shape[2]}",
        f"lines   = {stored.shape[1]}",
        f"bands   = {stored.shape[0]}",
        f"header offset = {offset}",
        "file type = ENVI Standard",
        f"data type = {_TYPES[kind]}",
        f"interleave = {interleave}",
        f"byte order = {int(big_endian)}",
        f"wavelength units = {units}",
        "wavelength = {",
        ",\n".join(" " + ", ".join(listed[start : start + 6]) for start in range(0, len(listed), 6)) + "}",
    ]
    if factor:
        lines.append(f"reflectance scale factor = {factor}")
    if ignore:
        lines.append("data ignore value = 9999")
    header = folder / f"{name}.hdr"
    header.write_text("\n".join(lines) + "\n")
    expected = stored.astype(np.float64) / (factor or 1)
    unit = "reflectance" if factor else "relative radiance"
    return Written(header, expected, nm, 1e-6, "envi", unit, mask=mask, damaged=raw)


# ---- TIFF and npz


def tiff(
    folder: Path, *, layout: str = "pages", kind: str = "u2", name: str = "stack", compression: str | None = None
) -> Written:
    """layout: pages, contiguous (one page of 31 samples a pixel) or planar (one page, a plane for each)."""
    values = cube(31)
    largest = {"u1": 255, "u2": 65535}.get(kind)
    stored = np.rint(values * largest).astype(kind) if largest else values.astype(kind)
    path = folder / f"{name}_{layout}_{kind}.tif"
    how: dict[str, object] = {"photometric": "minisblack", "metadata": None, "compression": compression}
    if layout == "pages":
        tifffile.imwrite(path, stored, **how)
    elif layout == "contiguous":
        tifffile.imwrite(path, stored.transpose(1, 2, 0).copy(), planarconfig="contig", **how)
    else:
        tifffile.imwrite(path, stored, planarconfig="separate", **how)
    return Written(path, stored / (largest or 1), GRID_400, 1e-7, "tiff", "relative radiance")


def npz(
    folder: Path,
    *,
    key: str = "cube",
    units: str = "nm",
    last: bool = False,
    compressed: bool = True,
    name: str = "arr",
) -> Written:
    values = cube(31).astype(np.float32)
    grid = np.asarray(GRID_400) * {"nm": 1, "um": 1e-3, "m": 1e-9}[units]
    path = folder / f"{name}_{key}_{units}.npz"
    save = np.savez_compressed if compressed else np.savez
    save(path, **{key: values.transpose(1, 2, 0) if last else values, "wavelengths": grid})
    return Written(path, values, GRID_400, 0, "npz", "relative radiance")


def kcam_cube(folder: Path, *, name: str = "canonical", mask: bool = True, depth: bool = True) -> Written:
    """kcam's own file, page by page as the head of kcam/data/cube.py describes it."""
    import json

    values = cube(28).astype(np.float32)
    grid = tuple(float(value) for value in np.round(np.linspace(420, 720, 28), 6))
    valid = np.ones((12, 17), bool)
    valid[1:3, 2:4] = not mask
    values[:, ~valid] = 0
    document = {
        "kcam_cube": 1,
        "name": name,
        "wavelengths_nm": grid,
        "unit": "reflectance",
        "extrapolated": [False] * 28,
        "source": {"licence": "CC0"},
    }
    path = folder / f"{name}.tif"
    with tifffile.TiffWriter(path) as file:
        how: dict[str, object] = {"photometric": "minisblack", "metadata": None}
        file.write(values, description=json.dumps(document), **how)
        if mask:
            file.write(valid.astype(np.uint8) * 255, **how)
        if depth:
            file.write(np.full((12, 17), 2.5, np.float32), **how)
    return Written(path, values, grid, 0, "kcam", "reflectance", mask=valid if mask else None)


ALL: dict[str, Callable[[Path], Written]] = {
    "kaist": kaist,
    "kaist half": lambda folder: kaist(folder, half=True),
    "kaist uncompressed": lambda folder: kaist(folder, compression="NO_COMPRESSION"),
    "cave": cave,
    "cave flat": lambda folder: cave(folder, nested=False, writer="PIL"),
    "cave grey colour": lambda folder: cave(folder, colour=True),
    "icvl": icvl,
    "icvl gzip": lambda folder: icvl(folder, compression="gzip", chunks=(1, 5, 6)),
    "arad1k": arad1k,
    "arad1k gzip": lambda folder: arad1k(folder, compression="gzip", shuffle=True, fletcher32=True, chunks=(4, 17, 4)),
    "harvard": harvard,
    "harvard raw": lambda folder: harvard(folder, compressed=False),
    **{f"cassi {key}": (lambda folder, key=key: cassi(folder, key)) for key in ("HSI", "img_expand", "data_slice")},
    **{f"cassi {key}": (lambda folder, key=key: cassi(folder, key)) for key in ("img", "img16", "img_hs")},
    **{
        f"envi {interleave} {kind} {'big' if big else 'little'}": (
            lambda folder, i=interleave, k=kind, b=big: envi(folder, interleave=i, kind=k, big_endian=b)
        )
        for interleave in ("bsq", "bil", "bip")
        for kind, big in (("u2", False), ("f4", True), ("i2", True))
    },
    "envi offset": lambda folder: envi(folder, offset=77, suffix=".raw"),
    "envi um, ignored": lambda folder: envi(folder, units="Micrometers", ignore=True, suffix=".dat"),
    "envi radiance": lambda folder: envi(folder, factor=None, kind="f8", units="nm", suffix=".img"),
    "npz": npz,
    "npz um last": lambda folder: npz(folder, units="um", last=True),
    "npz m raw": lambda folder: npz(folder, key="values", units="m", compressed=False),
    "kcam": kcam_cube,
    "kcam plain": lambda folder: kcam_cube(folder, mask=False, depth=False),
}
"""Everything that a reader must recognise by itself."""
TIFFS: dict[str, Callable[[Path], Written]] = {
    f"tiff {layout} {kind}": (lambda folder, la=layout, k=kind: tiff(folder, layout=la, kind=k))
    for layout in ("pages", "contiguous", "planar")
    for kind in ("u1", "u2", "f4")
}
"""Recognised too, but without wavelengths: the profile cave31 must be named."""


def png_header(width: int, height: int) -> bytes:
    """The start of a PNG that says it has this size, checksum included."""
    import zlib

    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
