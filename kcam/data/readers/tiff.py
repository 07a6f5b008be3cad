"""TIFF of any writer; kcam's own cube files are read by `kcam.data.cube`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import tifffile

from kcam.data.cube import CubeError, Source, check_promise, check_size
from kcam.data.readers.format import Format, Options, array_source, full_scale


def _open_tiff(path: Path, options: Options) -> Source:
    """TIFF: a page per band, or all bands in one page; 8 and 16 bits over their largest value, floats as they are."""
    with tifffile.TiffFile(path) as file:
        if not file.series:
            raise CubeError("it has no pages.")
        series = file.series[0]
        sizes = check_size(series.shape, "its first series")
        check_promise(sum(page.nbytes for page in series.pages if page is not None), file.filehandle.size)
        if len(file.series) > 1:
            raise CubeError(f"its pages are of {len(file.series)} kinds, expected one size and type.")
        for index, page in enumerate(file.pages):
            ends = [at + count for at, count in zip(page.dataoffsets, page.databytecounts, strict=True)]
            if not ends or min(page.databytecounts) < 1 or max(ends) > file.filehandle.size:
                raise CubeError(f"page {index} is cut off: the file ends before it does.")
        values, names = series.asarray(), series.axes
    if values.ndim == 2:
        values = values[None]
    if values.ndim != 3 or values.dtype.kind not in "fui":
        raise CubeError(f"it holds {' x '.join(map(str, sizes))} of {values.dtype}, expected bands of numbers.")
    grid, divisor = options.wavelengths, full_scale(values.dtype)
    if names.endswith("S") or (grid is not None and len(values) != len(grid) == values.shape[-1]):
        values = values.transpose(2, 0, 1)
    return array_source(path, options, values, f"/ {divisor:g}", divisor=divisor)


def _is_stack(path: Path) -> bool:
    """No photograph of three or four colours."""
    with tifffile.TiffFile(path) as file:
        first: Any = file.pages[0]
        return len(file.pages) > 1 or first.samplesperpixel not in (1, 3, 4)


TIFF = Format("tiff", "TIFF, a page per band or all in one", _open_tiff, (".tif", ".tiff"), _is_stack)
