"""ENVI: a text header beside raw values."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from kcam.data.cube import CubeError, Source, check_size
from kcam.data.readers.format import Format, Options, in_metres, known_wavelengths, scaled, scene_name
from kcam.units import nm

_TYPES = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 12: "u2", 13: "u4", 14: "i8", 15: "u8"}
_AXES = {"bsq": (0, 1, 2), "bil": (1, 0, 2), "bip": (2, 0, 1)}  # of the file's array, that make (L,H,W)
_UNITS = {"nanometer": nm, "nm": nm, "micrometer": 1e-6, "micron": 1e-6, "um": 1e-6, "angstrom": 1e-10}


def _header(path: Path) -> dict[str, str]:
    text = path.read_text(errors="replace")
    if not text.lstrip().startswith("ENVI"):
        raise CubeError("its header does not begin with ENVI.")
    fields = re.findall(r"^[ \t]*([^=\n{};]+?)[ \t]*=[ \t]*(\{[^}]*\}|[^\n]*)", text, re.MULTILINE)
    return {name.strip().lower(): value.strip() for name, value in fields}


def _wavelengths(header: dict[str, str]) -> np.ndarray | None:
    if "wavelength" not in header:
        return None
    listed = np.asarray([float(value) for value in header["wavelength"].strip("{} \n\t,").split(",")])
    unit = header.get("wavelength units", "").lower()
    if unit in ("", "unknown"):
        return in_metres(listed)
    scale = _UNITS.get(unit.replace("metre", "meter").removesuffix("s"))
    if scale is None:
        raise CubeError(f"its wavelengths are in {unit!r}, not in nm or um. Say them: --wavelengths.")
    return listed * scale


def _open_envi(path: Path, options: Options) -> Source:
    """ENVI: a .hdr beside raw values, bsq, bil or bip; wavelengths in the header, values over its factor."""
    if path.suffix.lower() != ".hdr":
        path = next((p for p in (Path(f"{path}.hdr"), path.with_suffix(".hdr")) if p.is_file()), path)
    header = _header(path)
    try:
        shape = bands, height, width = tuple(int(header[name]) for name in ("bands", "lines", "samples"))
        kind, interleave = _TYPES[int(header["data type"])], header["interleave"].lower()
        axes = _AXES[interleave]
        offset, order = int(header.get("header offset", 0)), int(header.get("byte order", 0))
    except (KeyError, ValueError) as error:
        raise CubeError(f"its header lacks or garbles {error}.") from error
    check_size(shape, "its header")
    candidates = [path.with_suffix(s) for s in ("", ".raw", ".dat", ".img", ".bin", f".{interleave}")]
    raw = next((p for p in candidates if p.is_file() and p != path), None)
    if raw is None:
        raise CubeError(f"there are no values beside {path.name}.")
    dtype = np.dtype(kind).newbyteorder(">" if order else "<")
    wanted = offset + bands * height * width * dtype.itemsize
    if offset < 0 or raw.stat().st_size != wanted:
        raise CubeError(
            f"{raw.name} has {raw.stat().st_size} bytes, its header says {wanted}: {bands} x {height} x {width} of "
            f"{dtype} behind {offset} bytes."
        )
    stored = tuple(shape[axis] for axis in np.argsort(axes))
    values = np.memmap(raw, dtype, "r", offset, stored).transpose(axes)
    own = _wavelengths(header)
    divisor = float(header.get("reflectance scale factor", 1) or 1)
    if not divisor > 0:
        raise CubeError(f"its reflectance scale factor is {divisor:g}, expected more than 0.")
    ignored = header.get("data ignore value")
    unit = "reflectance" if "reflectance scale factor" in header else "relative radiance"

    def rows(first: int, last: int) -> tuple[np.ndarray, np.ndarray | None]:
        part = np.asarray(values[:, first:last])
        valid = None if ignored is None else (part != float(ignored)).all(0)
        return scaled(part, divisor), valid

    grid = known_wavelengths(options, bands, own)
    facts = {"scaling": f"/ {divisor:g}", "orientation": "as stored"}
    return Source(scene_name(path), (bands, height, width), grid, unit, rows, facts)


ENVI = Format("envi", "ENVI: .hdr beside raw values", _open_envi, (".hdr",))
