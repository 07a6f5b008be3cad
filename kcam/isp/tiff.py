"""The tags of TIFF/EP and DNG, in which a raw file says what stands beside its numbers: written and read."""

from __future__ import annotations

import io
import math
import statistics
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcam.sensor.mosaic import PATTERNS

COLOURED = tuple(name for name, tile in PATTERNS.items() if max(max(row) for row in tile) < 3)
"""Patterns of red, green and blue: DNG's colour tags have no room for white."""
MOST_DN = 65_535

# Tags of TIFF/EP and DNG 1.4, by their names there.
CFA_REPEAT_PATTERN_DIM, CFA_PATTERN, EXPOSURE_TIME, EXIF, ISO_SPEED = 33421, 33422, 33434, 34665, 34855
DNG_VERSION, DNG_BACKWARD_VERSION, UNIQUE_CAMERA_MODEL = 50706, 50707, 50708
CFA_PLANE_COLOR, CFA_LAYOUT, BLACK_LEVEL_REPEAT_DIM, BLACK_LEVEL, WHITE_LEVEL = 50710, 50711, 50713, 50714, 50717
DEFAULT_CROP_ORIGIN, DEFAULT_CROP_SIZE, ACTIVE_AREA = 50719, 50720, 50829
COLOR_MATRIX, CALIBRATION_ILLUMINANT, FORWARD_MATRIX = 50721, 50778, 50964  # those of the first of two lights
AS_SHOT_NEUTRAL, BASELINE_EXPOSURE, NOISE_PROFILE = 50728, 50730, 51041
PROFILE_NAME, PROFILE_TONE_CURVE, DEFAULT_BLACK_RENDER = 50936, 50940, 51110
PHOTOMETRIC, MAKE, MODEL, ORIENTATION, LINEAR_RAW = 262, 271, 272, 274, 34892
SHORT, LONG, RATIONAL, SRATIONAL = 3, 4, 5, 10
"""Types of a tag's values."""
D65_LIGHT, NO_BLACK_RENDER = 21, 1
Tag = tuple[int, str, int, Any, bool]


def _text(code: int, text: str) -> Tag:
    plain = text.encode("ascii", "replace") + b"\0"
    return code, "s", len(plain), plain, True


def _rational(code: int, values: Sequence[float], *, signed: bool = False) -> Tag:
    """Numbers as fractions of 32 bits, as close as these come."""
    parts: list[int] = []
    for value in values:
        most = min(10**8, 2**31 // (math.ceil(abs(value)) + 1))
        fraction = Fraction(value).limit_denominator(max(1, most))
        if value and not fraction:  # shorter than any denominator in use
            fraction = Fraction(1, min(2**31 - 1, round(1 / abs(value)))) * (1 if value > 0 else -1)
        parts += [fraction.numerator, fraction.denominator]
    return code, "2i" if signed else "2I", len(values), tuple(parts), True


def _black_tags(level: float | Tensor) -> list[Tag]:
    black = torch.as_tensor(level, dtype=torch.float64)
    shape = tuple(black.shape) or (1, 1)
    return [(BLACK_LEVEL_REPEAT_DIM, "H", 2, shape, True), _rational(BLACK_LEVEL, black.flatten().tolist())]


def _pattern_tags(pattern: str) -> list[Tag]:
    tile = np.array(PATTERNS[pattern], dtype=np.uint8)
    return [(CFA_REPEAT_PATTERN_DIM, "H", 2, tile.shape, True), (CFA_PATTERN, "B", tile.size, tile.tobytes(), True)]


WRITTEN: dict[str, Callable[[Any], list[Tag]]] = {
    "camera": lambda name: [_text(UNIQUE_CAMERA_MODEL, name)],
    "black_level": _black_tags,
    "white_level": lambda level: [(WHITE_LEVEL, "I", 1, round(level), True)],
    "baseline_exposure": lambda stops: [_rational(BASELINE_EXPOSURE, [stops], signed=True)],
    "pattern": _pattern_tags,
    "neutral": lambda neutral: [_rational(AS_SHOT_NEUTRAL, neutral.tolist())],
    "colour_matrix": lambda matrix: [_rational(COLOR_MATRIX, matrix.flatten().tolist(), signed=True)],
    "noise_profile": lambda profile: [(NOISE_PROFILE, "d", 2, profile, True)],
    "exposure_time": lambda time: [_rational(EXPOSURE_TIME, [time])],  # here by TIFF/EP; and again as EXIF
    "iso": lambda iso: [(ISO_SPEED, "H", 1, min(MOST_DN, max(1, round(iso))), True)],
}
"""Field of a `kcam.Raw` -> the tags that say it."""


def field_tags(fields: Mapping[str, Any]) -> list[Tag]:
    """The tags of the fields that are known, those that are not None."""
    return [tag for name, tags in WRITTEN.items() if fields[name] is not None for tag in tags(fields[name])]


def dng_tags(*, camera: str, size: Sequence[int], forward_matrix: Tensor | None) -> list[Tag]:
    """The tags that make a DNG of it.

    Args:      camera: its name.  size: (H,W).  forward_matrix: from balanced channels to XYZ under D50; None for
               monochrome.
    """
    height, width = size
    tags: list[Tag] = [
        (DNG_VERSION, "B", 4, bytes((1, 4, 0, 0)), True),
        (DNG_BACKWARD_VERSION, "B", 4, bytes((1, 1, 0, 0)), True),
        _text(MAKE, "kcam"),
        _text(MODEL, camera),
        (ORIENTATION, "H", 1, 1, True),
        (ACTIVE_AREA, "I", 4, (0, 0, height, width), True),
        (DEFAULT_CROP_ORIGIN, "I", 2, (0, 0), True),
        (DEFAULT_CROP_SIZE, "I", 2, (width, height), True),
    ]
    if forward_matrix is None:
        return tags
    return [
        *tags,
        (CFA_PLANE_COLOR, "B", 3, bytes((0, 1, 2)), True),
        (CFA_LAYOUT, "H", 1, 1, True),  # rectangular
        (CALIBRATION_ILLUMINANT, "H", 1, D65_LIGHT, True),
        _rational(FORWARD_MATRIX, forward_matrix.flatten().tolist(), signed=True),
        _text(PROFILE_NAME, "kcam"),  # without a curve of its own a converter would take one that flatters
        (PROFILE_TONE_CURVE, "f", 4, (0.0, 0.0, 1.0, 1.0), True),
        (DEFAULT_BLACK_RENDER, "I", 1, NO_BLACK_RENDER, True),
    ]


def encode(words: np.ndarray, tags: Sequence[Tag], *, photometric: str) -> bytes:
    """A TIFF of one plane, (H,W) uint16, with these tags.

    Args:      photometric: what the numbers are: "cfa", "linear_raw", or "minisblack" for a gray picture.
    """
    import tifffile

    exif = (EXIF - 1, "I", 1, 0, True)  # tifffile refuses the tag of EXIF: one beside it keeps its place
    options: dict[str, Any] = {"metadata": None, "software": False, "byteorder": "<"}
    with io.BytesIO() as file:
        known = "cfa" if photometric == "cfa" else "minisblack"
        tifffile.imwrite(file, words, photometric=known, extratags=[*tags, exif], **options)
        _complete(file, tags, linear_raw=photometric == "linear_raw")
        return file.getvalue()


def _complete(file: io.BytesIO, written: Sequence[Tag], *, linear_raw: bool) -> None:
    """What tifffile does not write: exposure time and ISO as EXIF at the end, and that one plane is linear."""
    content = file.getvalue()
    (start,) = struct.unpack_from("<I", content, 4)
    (tags,) = struct.unpack_from("<H", content, start)
    end = len(content) + len(content) % 2
    for at in range(start + 2, start + 2 + 12 * tags, 12):
        (code,) = struct.unpack_from("<H", content, at)
        file.seek(at)
        if code == PHOTOMETRIC and linear_raw:
            file.write(struct.pack("<HHIHH", PHOTOMETRIC, SHORT, 1, LINEAR_RAW, 0))
        if code == EXIF - 1:
            file.write(struct.pack("<HHII", EXIF, LONG, 1, end))
    exif = {code: value for code, _, _, value, _ in written if code in (EXPOSURE_TIME, ISO_SPEED)}
    entries, fraction = [], b""
    if EXPOSURE_TIME in exif:
        fraction = struct.pack("<2I", *exif[EXPOSURE_TIME])
        entries.append(struct.pack("<HHII", EXPOSURE_TIME, RATIONAL, 1, end + 2 + 12 * len(exif) + 4))
    if ISO_SPEED in exif:
        entries.append(struct.pack("<HHIHH", ISO_SPEED, SHORT, 1, exif[ISO_SPEED], 0))
    file.seek(end)
    file.write(struct.pack("<H", len(exif)) + b"".join(entries) + bytes(4) + fraction)


def _reals(value: Any) -> list[float]:
    """The numbers of a tag, one or many."""
    parts = list(value) if isinstance(value, (tuple, list)) else [value]
    return [float(part) for part in parts]


def _divided(value: Any) -> list[float]:
    """The numbers of a tag of fractions, which tifffile gives as numerators and denominators in turn."""
    parts = _reals(value)
    return [above / below for above, below in zip(parts[::2], parts[1::2], strict=True)]


@contextmanager
def damaged_tags(path: Path) -> Iterator[None]:
    """Whatever goes wrong inside is an error that names the file."""
    try:
        yield
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise ValueError(f"{path} has damaged tags: {error}. Give its numbers to kcam.Raw(mosaic, ...).") from error


def said_by(tags: dict[int, Any]) -> dict[str, Any]:
    """Fields that tags of DNG hold, and LibRaw does not give of cameras that it does not know."""
    fields: dict[str, Any] = {}
    if BASELINE_EXPOSURE in tags:
        fields["baseline_exposure"] = _reals(tags[BASELINE_EXPOSURE])[0]
    if NOISE_PROFILE in tags:
        pairs = _reals(tags[NOISE_PROFILE])  # one pair, or one per colour
        fields["noise_profile"] = tuple(statistics.fmean(pairs[first::2]) for first in (0, 1))
    lights = {tags.get(CALIBRATION_ILLUMINANT + which): which for which in (0, 1) if COLOR_MATRIX + which in tags}
    if lights:  # that of daylight, else the second, which is the cooler light's
        which = lights.get(D65_LIGHT, max(lights.values()))
        numbers = _reals(tags[COLOR_MATRIX + which])
        if len(numbers) == 9:
            fields["colour_matrix"] = np.reshape(numbers, (3, 3))
    name = tags.get(UNIQUE_CAMERA_MODEL) or " ".join(str(tags[code]) for code in (MAKE, MODEL) if code in tags)
    return fields | ({"camera": str(name)} if name else {})


def _tags_of(page: Any) -> dict[int, Any]:
    """Tags of a page and of the pages inside of it, fractions as numbers; the first that has one."""
    found: dict[int, Any] = {}
    for each in (page, *(page.pages or ())):
        for tag in getattr(each, "tags", ()):
            found.setdefault(tag.code, _divided(tag.value) if tag.dtype in (RATIONAL, SRATIONAL) else tag.value)
    return found


def tags_in(path: Path) -> dict[int, Any]:
    """Tags of a raw file; none for one that is not built on TIFF, or only for those who know it."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            return _tags_of(file.pages.first)
    except Exception:
        return {}


def read(path: Path) -> dict[str, Any]:
    """The fields of a TIFF by `Raw.write`, or of any of 16 bits with its levels in DNG's tags."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            page = file.pages.first
            words, tags = page.asarray(), _tags_of(page)
    except Exception as error:  # a damaged header makes tifffile raise anything
        raise ValueError(f"{path} is damaged, or no TIFF: {error}.") from error
    if words.dtype != np.uint16 or words.ndim != 2:
        refused = " 8 bits are refused for raw data." if words.dtype.itemsize == 1 else ""
        raise ValueError(
            f"{path} holds {words.dtype} of shape {words.shape}, expected one plane of 16 bits, uint16 (H,W).{refused}"
        )
    lacking = [name for name, code in (("BlackLevel", BLACK_LEVEL), ("WhiteLevel", WHITE_LEVEL)) if code not in tags]
    if lacking:
        raise ValueError(
            f"{path} is a picture without the tags {' and '.join(lacking)} of raw data. Use Raw(torch.from_numpy("
            f"tifffile.imread({path.name!r}))[None, None], pattern='RGGB', black_level=64, white_level=1023)."
        )
    with damaged_tags(path):
        exif = tags.get(EXIF, {})
        fields: dict[str, Any] = {
            "black_level": np.reshape(_reals(tags[BLACK_LEVEL]), tags.get(BLACK_LEVEL_REPEAT_DIM, (1, 1))),
            "white_level": _reals(tags[WHITE_LEVEL])[0],
            "neutral": tags.get(AS_SHOT_NEUTRAL),
            "exposure_time": _divided(exif["ExposureTime"])[0] if "ExposureTime" in exif else None,
            "iso": float(exif["ISOSpeedRatings"]) if "ISOSpeedRatings" in exif else None,
        } | said_by(tags)
        tile = tile_in(tags).tolist() if CFA_PATTERN in tags else None
    mosaic = torch.from_numpy(words.astype(np.float32))[None, None]
    return fields | {"mosaic": mosaic, "pattern": None if tile is None else _named(tile, path)}


def tile_in(tags: dict[int, Any]) -> np.ndarray:
    """The tile in CFA tags."""
    shape = tuple(tags.get(CFA_REPEAT_PATTERN_DIM, (2, 2)))
    return np.frombuffer(bytes(tags[CFA_PATTERN]), dtype=np.uint8).reshape(shape)


def _named(tile: list[list[int]], path: Path) -> str:
    for name in COLOURED:
        if [list(row) for row in PATTERNS[name]] == tile:
            return name
    raise ValueError(f"{path} has the mosaic {tile}, which is none of {', '.join(COLOURED)}.")
