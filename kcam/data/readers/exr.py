"""OpenEXR: KAIST."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np

from kcam.data.cube import CubeError, Source, check_promise, check_size
from kcam.data.readers.format import Format, Options, in_metres, scene_name


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
    check_size((len(names), height, width), "its data window")
    found = {name: float(match[1]) for name in names if (match := re.fullmatch(r"w(\d+(?:\.\d+)?)nm", name))}
    strange = sorted(set(names) - set(found) - set("RGBAYZ"))
    if not found or strange:
        raise CubeError(f"its channels are no wavelengths such as w420nm: {', '.join((strange or names)[:6])}.")
    check_promise(2 * len(found) * height * width, path.stat().st_size)
    ordered = sorted(found, key=found.__getitem__)
    grid = in_metres([found[name] for name in ordered])
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


_CHOI = {"citation": "Choi et al., High-quality hyperspectral reconstruction using a spectral prior, ToG 2017"}
KAIST = Format("kaist", "EXR with channels w420nm ... w720nm", _open_kaist, (".exr",), facts=_CHOI)
