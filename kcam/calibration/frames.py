"""Raw frames to calibrate from: as arrays or as files, with the exposure times that files tell."""

from __future__ import annotations

import csv
import glob
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from kcam.isp.raw import Raw

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}
_TIME = re.compile(r"(?<![a-z0-9.])(\d+(?:\.\d+)?|\.\d+)(s|ms|us|µs)(?![a-z])", re.IGNORECASE)
_EXPOSURE_TIME, _EXIF = 33434, 34665


def read_frame(path: str | os.PathLike[str]) -> np.ndarray:
    """One raw frame as the numbers that the converter gave, (H,W).

    Args:      path: a .tif, .png or .npy of 16 bits, or a camera's raw file (`kcam.Raw`, with the extra ``kcam[raw]``).
    Raises:    FileNotFoundError; ValueError for another suffix, a colour picture, 8 bits, or a damaged file.

    Example:
    >>> import numpy as np
    >>> from kcam import calibration
    >>> np.save("dark.npy", np.full((4, 6), 64, dtype=np.uint16))
    >>> calibration.read_frame("dark.npy").shape
    (4, 6)
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}. Expected a raw frame such as flat_01.tif.")
    read = READERS.get(path.suffix.lower())
    if read is None:
        raise ValueError(f"{path.name} is no raw frame that can be read: expected one of {', '.join(sorted(READERS))}.")
    try:
        frame = read(path)
    except ImportError:
        raise
    except Exception as error:  # of a damaged file a reader may say anything
        raise ValueError(f"{path.name} is damaged, or no {path.suffix} file: {' '.join(str(error).split())}") from error
    check_kind(frame, path.name)
    return frame


def check_kind(frame: np.ndarray, name: str) -> None:
    """ValueError unless it is one plane of numbers, of more than 8 bits."""
    if frame.ndim != 2 or 0 in frame.shape:
        raise ValueError(
            f"{name} has shape {frame.shape}, expected one plane (H,W) of raw numbers, not yet demosaiced."
        )
    if frame.dtype.kind not in "uif":
        raise ValueError(f"{name} holds {frame.dtype}, expected whole numbers such as uint16.")
    if frame.dtype.itemsize == 1:
        raise ValueError(f"{name} has 8 bits: what is left of a noise there is rounding. Save the raw with 16 bits.")


def _read_tiff(path: Path) -> np.ndarray:
    import tifffile

    return tifffile.imread(path)


def _read_png(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as file:
        return np.asarray(file)


def _read_raw(path: Path) -> np.ndarray:
    return Raw.from_file(path).mosaic[0, 0].numpy()


RAW_SUFFIXES = (".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".orf", ".rw2", ".pef")
READERS: dict[str, Callable[[Path], np.ndarray]] = dict.fromkeys(RAW_SUFFIXES, _read_raw) | {
    ".npy": lambda path: np.load(path, allow_pickle=False),
    ".png": _read_png,
    ".tif": _read_tiff,
    ".tiff": _read_tiff,
}
"""Suffix -> what reads such a file. A raw format is a row."""


def as_frame(frame: Any, name: str) -> np.ndarray:
    """A frame in memory or in a file as whole numbers (H,W) in float64; ValueError for what a converter never gives."""
    if isinstance(frame, (str, os.PathLike)):
        frame = read_frame(frame)
    array = frame.detach().cpu().numpy() if isinstance(frame, Tensor) else np.asarray(frame)
    check_kind(array, name)
    values = array.astype(np.float64)
    if not np.isfinite(values).all():
        count = int((~np.isfinite(values)).sum())
        raise ValueError(f"{name} has {count} values that are NaN or inf. Leave that frame out, or read it again.")
    if array.dtype.kind == "f" and (values != np.rint(values)).any():
        fix = "Give the raw as it was read, before averages and corrections."
        if values.min() >= -1 and values.max() <= 1:
            fix = "They are shares of full scale: use (frame * (2**bits - 1)).round()."
        raise ValueError(f"{name} has values that are no whole numbers, such as {values[values % 1 != 0][0]:g}. {fix}")
    if values.min() < 0:
        raise ValueError(
            f"{name} has values below 0, such as {values.min():g}: the black level was subtracted. Give the raw as it "
            "was read."
        )
    return values


def natural(path: str | os.PathLike[str]) -> list[tuple[int, int, str]]:
    """A key that sorts f2 before f10."""
    parts = re.split(r"(\d+)", str(path))
    return [(1, int(part), part) if part.isdigit() else (0, 0, part) for part in parts]


def find(patterns: Sequence[str], *, option: str) -> list[Path]:
    """Files by name or glob, each once, in natural order.

    Raises:    FileNotFoundError for a name or glob without a file.

    Example:
    >>> import numpy as np
    >>> from kcam import calibration
    >>> for index in (10, 2): np.save(f"d{index}.npy", np.zeros((2, 2), dtype=np.uint16))
    >>> [path.name for path in calibration.find(["d*.npy"], option="--darks")]
    ['d2.npy', 'd10.npy']
    """
    found: dict[Path, None] = {}
    for pattern in patterns:
        paths = [pattern] if Path(pattern).is_file() else glob.glob(str(pattern), recursive=True)
        files = [Path(path) for path in paths if Path(path).is_file()]
        if not files:
            raise FileNotFoundError(f'{option} "{pattern}" matches no file in {Path.cwd()}. Expected e.g. "d*.tif".')
        found |= dict.fromkeys(files)
    return sorted(found, key=natural)


def exposure_time(path: str | os.PathLike[str]) -> float | None:
    """The exposure time of a file [s]: as its name says (flat_0.010s_1.tif, d_10ms.npy), or its EXIF; None if neither.

    Example:
    >>> from kcam import calibration
    >>> [calibration.exposure_time(name) for name in ("f_0.010s_1.npy", "d_20ms.npy", "flat3.npy")]
    [0.01, 0.02, None]
    """
    path = Path(path)
    found = _TIME.findall(path.stem.replace("_", " ").replace("-", " "))
    if len(found) == 1:
        number, unit = found[0]
        return float(number) * SECONDS[unit.lower()]
    if path.suffix.lower() in RAW_SUFFIXES and path.is_file():
        try:
            return Raw.from_file(path).exposure_time
        except ValueError:
            return None  # what cannot be read says so when it is read as a frame
    if path.suffix.lower() in (".tif", ".tiff", ".png") and path.is_file():
        from PIL import Image

        try:
            with Image.open(path) as file:
                exif = file.getexif()
                told = exif.get_ifd(_EXIF).get(_EXPOSURE_TIME) or exif.get(_EXPOSURE_TIME)
        except Exception:  # of a damaged file Pillow may say anything
            return None  # what cannot be read says so when it is read as a frame
        return None if told is None else float(told)
    return None


def read_times(path: str | os.PathLike[str]) -> dict[str, float]:
    r"""Exposure times from a table of two columns, file name and seconds, separated by commas.

    Returns:   file name (without its folder) -> seconds.
    Raises:    FileNotFoundError; ValueError that names the file and line of what is no time.

    Example:
    >>> from pathlib import Path
    >>> from kcam import calibration
    >>> written = Path("times.csv").write_text("file,seconds\nf1.tif,0.01\nf2.tif,0.01\n")
    >>> calibration.read_times("times.csv")
    {'f1.tif': 0.01, 'f2.tif': 0.01}
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}. Expected lines such as f1.tif,0.01 (seconds).")
    times: dict[str, float] = {}
    with path.open(newline="", encoding="utf-8-sig") as file:
        for number, row in enumerate(csv.reader(file), start=1):
            cells = [cell.strip() for cell in row]
            if not any(cells):
                continue
            try:
                name, seconds = cells
                times[Path(name).name] = float(seconds)
            except ValueError:
                if number == 1 and len(cells) == 2:
                    continue  # the heading
                raise ValueError(
                    f'{path.name}, line {number}: "{",".join(row)}" is no file and its seconds, such as f1.tif,0.01.'
                ) from None
    return times


def pairs(
    paths: Sequence[Path], *, what: str, times: dict[str, float] | None = None
) -> tuple[list[tuple[Path, Path]], list[float] | None]:
    """Files two by two, in the order of their exposure times, where all tell one, and names; and the time of each pair.

    Args:      what: "flats" or "darks", for errors.  times: by file name [s], in place of what the files tell.
    Raises:    ValueError for an odd number of files, a file without a time in `times`, or a pair of two times.

    Example:
    >>> from pathlib import Path
    >>> from kcam import calibration
    >>> names = [Path(f"{i}_{time}.npy") for i in (1, 2) for time in ("10ms", "5ms")]
    >>> made, times = calibration.pairs(names, what="flats")
    >>> [(a.name, b.name) for a, b in made], times
    ([('1_5ms.npy', '2_5ms.npy'), ('1_10ms.npy', '2_10ms.npy')], [0.005, 0.01])
    """
    if times is None:
        told = {path: exposure_time(path) for path in paths}
        known = {path: time for path, time in told.items() if time is not None}
        if len(known) < len(paths):
            known = {}
    else:
        missing = [path.name for path in paths if path.name not in times]
        if missing:
            raise ValueError(
                f"the table of times has no line for {missing[0]} (of {len(missing)}): add {missing[0]},0.01."
            )
        known = {path: times[path.name] for path in paths}
    if len(paths) % 2:
        alike: dict[str, list[str]] = {}
        for path in paths:
            alike.setdefault(f"{known[path]:.6g} s" if known else "", []).append(path.name)
        time, names = next((time, names) for time, names in alike.items() if len(names) % 2)
        which = f"of {time} there is {len(names)}: {', '.join(names)}" if time else f"does {names[-1]} or another"
        end = ". Add its twin, or leave it out." if time else " lack its twin?"
        raise ValueError(f"{len(paths)} {what} are no pairs: expected two frames of each exposure; {which}{end}")
    ordered = sorted(paths, key=lambda path: (known.get(path, 0.0), natural(path)))
    made = list(zip(ordered[::2], ordered[1::2], strict=True))
    for one, two in made:
        if known and abs(known[one] - known[two]) > 1e-6 * abs(known[one]):
            raise ValueError(
                f"{one.name} ({known[one]:g} s) and {two.name} ({known[two]:g} s) would be a pair: expected two frames "
                "of each exposure time."
            )
    return made, [known[one] for one, _ in made] if known else None
