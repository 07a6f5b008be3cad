"""Lenses in files: Zemax's sequential text (.zmx), and Optiland's JSON (.json)."""

from __future__ import annotations

import os
from pathlib import Path

from kcam.files import check_place, replace
from kcam.optics.compound import optiland, zemax
from kcam.optics.compound.prescription import Prescription
from kcam.optics.numerics import float64

_FORMATS = {".zmx": zemax, ".json": optiland}
SUFFIXES = tuple(_FORMATS)


def read_lens(path: str | os.PathLike[str], *, focused: bool) -> Prescription:
    """The lens in a file.

    Args:      path: its name ends in .zmx or .json.
               focused: whether the sensor will stand elsewhere than the file has it.
    Raises:    FileNotFoundError; ValueError for another suffix, and for what is no such file, damaged, or holds what
               kcam has not: it names the line or surface, and the word.
    """
    path = Path(path)
    module = _FORMATS[_suffix(path)]
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}.")
    found = module.read(path.read_bytes(), name=path.name)
    distance = float(float64(found.sensor_distance))
    if not focused and not distance > 0:
        raise ValueError(
            f"{path.name} has the image {distance:g} m behind the last surface, where no sensor can stand. Give "
            "focus_distance=, such as math.inf."
        )
    return found


def write_lens(path: str | os.PathLike[str], lens: Prescription) -> None:
    """Write a lens so that `path` always holds either the old file or the whole new one.

    Raises:    ValueError for another suffix than .zmx and .json, for a name where no file can be, and for asphere terms
               that a .zmx file has no place for.
    """
    path = Path(path)
    module = _FORMATS[_suffix(path)]
    check_place(path)
    replace(path, module.written(lens))


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in _FORMATS:
        raise ValueError(f"{path.name} is no lens file: its name must end in .zmx (Zemax) or .json (Optiland).")
    return suffix
