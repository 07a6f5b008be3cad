"""Raw frames and their exposure times from files, in pairs."""

from __future__ import annotations

import csv
import glob
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

READ = (".tif", ".tiff", ".png", ".npy")
"""Files of frames, by their ends."""
_TIME = re.compile(r"(?<![\d.])(\d+(?:\.\d+)?|\.\d+)\s*(us|µs|ms|s|sec)(?![a-z])", re.IGNORECASE)
_SECONDS = {"us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0, "sec": 1.0}
_EXPOSURE_TAG = "ExposureTime"


def expanded(patterns: Sequence[str], *, name: str) -> list[Path]:
    """The files that names and globs stand for, in the order of their numbers: f2 before f10.

    Raises:    FileNotFoundError for a pattern that stands for no file.

    Example:
    >>> from pathlib import Path
    >>> from kcam.calibration.frames import expanded
    >>> for index in (1, 2, 10):
    ...     Path(f"f{index}.npy").touch()
    >>> [path.name for path in expanded(["f*.npy"], name="flats")]
    ['f1.npy', 'f2.npy', 'f10.npy']
    """
    found: dict[str, None] = {}
    for pattern in patterns:
        matches = (
            [pattern] if os.path.isfile(pattern) else [path for path in glob.glob(pattern) if os.path.isfile(path)]
        )
        if not matches:
            raise FileNotFoundError(f'there is no file "{pattern}" for {name}. Expected frames ({", ".join(READ)}).')
        found |= dict.fromkeys(matches)
    return sorted(
        map(Path, found), key=lambda path: [int(p) if p.isdigit() else p for p in re.split(r"(\d+)", str(path))]
    )


def read_frame(path: Path) -> np.ndarray:
    """A raw frame (H, W) in DN, as it is in the file.

    Raises:    ValueError for another kind of file, one that is damaged, of 8 bits, or of several channels.

    Example:
    >>> import numpy as np
    >>> from pathlib import Path
    >>> from kcam.calibration.frames import read_frame
    >>> np.save("dark.npy", np.full((4, 6), 64, dtype=np.uint16))
    >>> read_frame(Path("dark.npy")).shape
    (4, 6)
    """
    suffix = path.suffix.lower()
    if suffix not in READ:
        raise ValueError(f"{path} is none of {', '.join(READ)}. Write the raw frames as 16-bit TIFF.")
    try:
        if suffix == ".npy":
            frame = np.load(path, allow_pickle=False)
        elif suffix == ".png":
            from PIL import Image

            with Image.open(path) as image:
                frame = np.array(image)
        else:
            import tifffile

            frame = tifffile.imread(path)
    except Exception as error:  # a decoder may raise anything
        raise ValueError(f"{path} cannot be read: {str(error) or type(error).__name__}. Write it again.") from error
    frame = np.squeeze(frame)
    if frame.ndim != 2:
        raise ValueError(
            f"{path} has shape {frame.shape}: expected one plane (H, W) of raw numbers. A picture that was demosaiced "
            "is no raw frame."
        )
    if frame.dtype in (np.uint8, np.int8, np.bool_):
        raise ValueError(f"{path} is of 8 bits, a developed picture. Expected a raw frame of 10 to 16 bits.")
    if not (np.issubdtype(frame.dtype, np.integer) or np.issubdtype(frame.dtype, np.floating)):
        raise ValueError(f"{path} holds {frame.dtype}, no numbers. Expected a raw frame of 16 bits.")
    return frame


def exposure_time(path: Path, given: Mapping[str, float] | None = None) -> float | None:
    """Seconds of a frame: from a table, the ExposureTime of a TIFF, or the file's name, such as flat_10ms_1.tif.

    Example:
    >>> from pathlib import Path
    >>> from kcam.calibration.frames import exposure_time
    >>> exposure_time(Path("flat_10ms_1.npy")), exposure_time(Path("dark_0.5s.npy")), exposure_time(Path("f7.npy"))
    (0.01, 0.5, None)
    """
    if given is not None:
        return given.get(path.name)
    if path.suffix.lower() in (".tif", ".tiff") and path.is_file():
        import tifffile

        try:
            with tifffile.TiffFile(path) as file:
                tags = file.pages.first.tags
                exif = tags.get("ExifTag")
                tag = tags.get(_EXPOSURE_TAG)
                value = tag.value if tag is not None else (exif.value if exif is not None else {}).get(_EXPOSURE_TAG)
        except Exception:  # tags of any kind; the frame itself is read, and checked, elsewhere
            value = None
        if value is not None:
            return float(value[0] / value[1]) if isinstance(value, tuple) else float(value)
    found = _TIME.search(path.stem)
    return float(found[1]) * _SECONDS[found[2].lower()] if found else None


def read_times(path: str | os.PathLike[str]) -> dict[str, float]:
    r"""A table of exposure times: a header, then the name of a file and its seconds in each line.

    Raises:    FileNotFoundError; ValueError that names the line.

    Example:
    >>> from pathlib import Path
    >>> from kcam.calibration.frames import read_times
    >>> written = Path("times.csv").write_text("file, seconds\nf1.tif, 0.01\nf2.tif, 0.01\n")
    >>> read_times("times.csv")
    {'f1.tif': 0.01, 'f2.tif': 0.01}
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no file {path}. Expected a table of exposure times: file, seconds.")
    found = {}
    with open(path, newline="", encoding="utf-8-sig") as file:
        for number, row in enumerate(csv.reader(file), start=1):
            if number == 1 or not any(cell.strip() for cell in row):
                continue
            try:
                name, seconds = row[0].strip(), float(row[1])
            except (IndexError, ValueError):
                raise ValueError(
                    f"{path}, line {number}: expected a file and its seconds, got {', '.join(row)}."
                ) from None
            if not 0 <= seconds < float("inf"):
                raise ValueError(f"{path}, line {number}: {seconds:g} s is no exposure time. Expected seconds >= 0.")
            found[name] = seconds
    return found


def pairs_of(
    paths: Sequence[Path], *, name: str, times: Mapping[str, float] | None = None
) -> tuple[list[tuple[np.ndarray, np.ndarray]], list[float] | None]:
    """Frames two by two, and the exposure time of each pair, or None where one of them is not known.

    Files are paired by their exposure times where these are known, else in their order.

    Raises:    ValueError for an odd number of files, or of one exposure time, and as `read_frame`.

    Example:
    >>> import numpy as np
    >>> from pathlib import Path
    >>> from kcam.calibration.frames import pairs_of
    >>> for name in ("a_1ms", "a_2ms", "b_1ms", "b_2ms"):
    ...     np.save(f"{name}.npy", np.zeros((4, 4), dtype=np.uint16))
    >>> pairs, seconds = pairs_of([Path(f"{name}.npy") for name in ("a_1ms", "a_2ms", "b_1ms", "b_2ms")], name="flats")
    >>> len(pairs), seconds
    (2, [0.001, 0.002])
    """
    seconds = [exposure_time(path, times) for path in paths]
    known = [value for value in seconds if value is not None]
    if len(paths) % 2:
        raise ValueError(
            f"there are {len(paths)} {name}: frames come in pairs of equal exposure. Take {paths[-1]} twice."
        )
    order = list(range(len(paths)))
    if len(known) == len(paths):
        order.sort(key=lambda index: known[index])
        for first, second in zip(order[::2], order[1::2], strict=True):
            if known[first] != known[second]:
                raise ValueError(
                    f"{paths[first]} of {known[first]:g} s has no second frame: the next of the {name} is of "
                    f"{known[second]:g} s. Frames come in pairs of equal exposure."
                )
    frames = [read_frame(path) for path in paths]
    pairs = []
    for first, second in zip(order[::2], order[1::2], strict=True):
        if frames[first].shape != frames[second].shape:
            raise ValueError(
                f"{paths[first]} is {frames[first].shape} pixels and {paths[second]} {frames[second].shape}: a pair is "
                "of one size."
            )
        pairs.append((frames[first], frames[second]))
    return pairs, [known[index] for index in order[::2]] if len(known) == len(paths) else None
