"""A PNG per band: CAVE."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from kcam.data.bands import profile
from kcam.data.cube import CubeError, Source, check_promise, check_size
from kcam.data.readers.format import Format, Options, array_source, scaled


def _files(path: Path) -> list[tuple[int, Path]]:
    """The PNGs of one CAVE scene by their number, from X_ms, X_ms/X_ms, or a folder that holds only the inner one."""
    found: list[tuple[int, Path]] = []
    for folder in (path, path / path.name):
        for file in folder.iterdir() if folder.is_dir() and not found else ():
            match = re.fullmatch(r"(?!\.).*_ms_(\d+)\.png", file.name, re.IGNORECASE)
            if match and file.is_file():
                found.append((int(match[1]), file))
    return sorted(found)


def _read_png(path: Path) -> np.ndarray:
    """A PNG as it is; OpenCV says nothing about what it cannot read."""
    import cv2

    with path.open("rb") as file:
        head = file.read(24)
    if head[:8] != b"\x89PNG\r\n\x1a\n" or len(head) < 24:
        raise CubeError(f"{path.name} is no PNG.")
    width, height = check_size((int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")), path.name)
    check_promise(2 * width * height, path.stat().st_size, path.name)
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
    files = _files(path)
    if not files:
        raise CubeError("it holds no bands such as X_ms_01.png.")
    numbers = [number for number, _ in files]
    count = 31 if options.wavelengths is None else len(options.wavelengths)
    if numbers != list(range(1, count + 1)):
        missing = ", ".join(str(number) for number in range(1, count + 1) if number not in numbers)
        raise CubeError(f"bands missing: {missing}." if missing else f"it has {len(numbers)} PNGs for {count} bands.")
    planes = [_read_png(file) for _, file in files]
    if len({plane.shape for plane in planes}) != 1:
        raise CubeError("its bands have different sizes.")
    values = scaled(np.stack(planes), 65535)
    return array_source(path, options, values, "/ 65535", own=profile("cave31"), unit="reflectance")


_YASUMA = {"citation": "Yasuma et al., Generalized assorted pixel camera, TIP 2010"}
CAVE = Format("cave", "a folder X_ms of 31 PNGs of 16 bits", _open_cave, (), lambda path: bool(_files(path)), _YASUMA)
