"""A spectral cube, and the file that keeps it: a TIFF that other tools open, with wavelengths and unit inside.

One page per band, float32, uncompressed, so that any part of it can be read without the rest; a mask of invalid pixels,
where there are any, is a further page of bytes (0 invalid, 255 valid), and a depth map one of float32 [m]. The first
page's description is JSON:

    {"kcam_cube": 1, "name": ..., "wavelengths_nm": [...], "unit": "reflectance", "extrapolated": [false, ...],
     "source": {"format": ..., "scaling": ..., "group": ..., "licence": ..., "citation": ...}}
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import tifffile
import torch
from torch import Tensor

from kcam.files import replacing
from kcam.plain import from_json
from kcam.units import WAVELENGTH_RANGE, nm, wavelength_grid

SUFFIX = ".tif"
VERSION = 1
UNITS = ("reflectance", "radiance", "relative radiance")
MOST_VALUES = 2**32
"""In one cube: a 31-band cube of 138 megapixels. More is taken for a damaged header."""
_SLACK = 2**26  # bytes that a header may promise in any case


class CubeError(ValueError):
    """A cube that cannot be read or is not what it says; one line.

    Example:
    >>> import pathlib
    >>> written = pathlib.Path("notes.tif").write_text("no picture")
    >>> data.read_cube("notes.tif")
    Traceback (most recent call last):
    kcam.data.cube.CubeError: notes.tif: its format is not recognised. ...
    """


NOTHING_VALID = "it holds no valid pixel: all are NaN, infinite or marked as invalid."


def words_of(error: Exception, what: str = "it cannot be read") -> str:
    """What a library's error means for a cube, in one line of bounded length.

    Raises:    KeyboardInterrupt where that is its cause: compiled code into which Ctrl-C falls may end in SystemError.
    """
    if isinstance(error.__cause__, KeyboardInterrupt):
        raise error.__cause__
    if isinstance(error, MemoryError):
        return "it does not fit into memory."
    return f"{what}: {type(error).__name__}: {(str(error).strip().splitlines() or [''])[0][:200]}"


def check_size(shape: Iterable[int], what: str = "its array") -> tuple[int, ...]:
    """A shape as it stands in a header; CubeError for one that no cube has."""
    sizes = tuple(int(size) for size in shape)
    if not 1 <= prod(max(size, 0) for size in sizes) <= MOST_VALUES:
        raise CubeError(f"{what} says it is {' x '.join(map(str, sizes))}: no cube has that size.")
    return sizes


def check_promise(promised: int, stored: int, what: str = "its header") -> None:
    """CubeError where a header promises far more than its bytes can hold: no picture compresses to a 64th."""
    if promised > 64 * stored + _SLACK:
        raise CubeError(f"{what} promises {promised / 1e6:.0f} MB in {stored / 1e6:.3g} MB of data: it is damaged.")


def lacking(wanted: str, names: Iterable[str]) -> CubeError:
    """The error of a file that lacks what was asked for."""
    return CubeError(f"it has no {wanted}, only {', '.join(names) or 'nothing'}.")


@dataclass(frozen=True)
class Cube:
    """Spectral values of a scene.

    values: (L,H,W) float32, finite where the mask is True. wavelengths: (L,) float64 [m].
    unit: "reflectance" (white is 1), "radiance" [W / (m^2 sr nm)], or "relative radiance" (in any scale).
    mask: (L,H,W) bool, True where the value was measured: False for pixels that the source marks as invalid, and for
        whole bands that were extrapolated. None: all were measured.
    depth: (H,W) float32 [m], or None.
    name: of the scene. source: what is known of where it comes from (format, scaling, group, licence, citation).

    Example:
    >>> cube = data.Cube(torch.rand(8, 4, 6), torch.linspace(420, 700, 8) * nm, "reflectance", name="wall")
    >>> cube.values.shape, cube.unit
    (torch.Size([8, 4, 6]), 'reflectance')
    """

    values: Tensor
    wavelengths: Tensor
    unit: str = "relative radiance"
    mask: Tensor | None = None
    depth: Tensor | None = None
    name: str = ""
    source: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        values = torch.as_tensor(self.values)
        if values.ndim != 3 or not values.is_floating_point():
            raise CubeError(f"values must be floating-point (L,H,W), got {tuple(values.shape)} of {values.dtype}.")
        grid = wavelength_grid(self.wavelengths)
        if len(grid) != values.shape[0]:
            raise CubeError(f"{values.shape[0]} bands, but {len(grid)} wavelengths: expected one for each.")
        if self.unit not in UNITS:
            raise CubeError(f"unknown unit {self.unit!r}; known: {', '.join(UNITS)}.")
        if self.mask is not None:
            mask = torch.as_tensor(self.mask)
            if mask.dtype != torch.bool or mask.shape[-2:] != values.shape[1:] or mask.ndim not in (2, 3):
                raise CubeError(f"mask must be bool (L,H,W) or (H,W), got {tuple(mask.shape)} of {mask.dtype}.")
            object.__setattr__(self, "mask", mask.expand(values.shape))
        if self.depth is not None and torch.as_tensor(self.depth).shape != values.shape[1:]:
            raise CubeError(f"depth must be (H,W), got {tuple(torch.as_tensor(self.depth).shape)}.")
        object.__setattr__(self, "values", values.float())
        object.__setattr__(self, "wavelengths", grid)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(L,H,W)."""
        bands, height, width = self.values.shape
        return bands, height, width


@dataclass(frozen=True)
class Source:
    """A cube that is read strip by strip.

    shape: (L,H,W). wavelengths: (L,) float64 [m]. extrapolated: (L,) bool. facts: see `Cube.source`.
    rows(first, last): values (L, last - first, W) float32, and which pixels are valid (last - first, W) bool or None.
    depth: (H,W) float32 [m], or None.
    """

    name: str
    shape: tuple[int, int, int]
    wavelengths: np.ndarray
    unit: str
    rows: Callable[[int, int], tuple[np.ndarray, np.ndarray | None]]
    facts: dict[str, Any] = field(default_factory=dict)
    extrapolated: np.ndarray | None = None
    depth: np.ndarray | None = None

    def check(self) -> Source:
        """Itself; CubeError for a shape that no cube has, or wavelengths that do not fit."""
        bands, height, width = self.shape
        if min(self.shape) < 1 or bands * height * width > MOST_VALUES:
            raise CubeError(f"its header says {bands} x {height} x {width}: no cube has that size.")
        if len(self.wavelengths) != bands:
            raise CubeError(f"it has {bands} bands, but {len(self.wavelengths)} wavelengths.")
        low, high = WAVELENGTH_RANGE
        outside = [value for value in self.wavelengths if not low <= value <= high]
        if outside:
            raise CubeError(f"it says a wavelength of {outside[0] / nm:g} nm, outside {low / nm:g}..{high / nm:g} nm.")
        if len(np.unique(self.wavelengths)) != bands:
            raise CubeError("two of its bands have the same wavelength.")
        return self

    def cube(self) -> Cube:
        """All of it, in memory."""
        values, valid = self.checked_rows(0, self.shape[1])
        if valid is not None and not valid.any():
            raise CubeError(NOTHING_VALID)
        mask = None
        if valid is not None or (self.extrapolated is not None and self.extrapolated.any()):
            pixels = np.ones(self.shape[1:], bool) if valid is None else valid
            bands = np.zeros(self.shape[0], bool) if self.extrapolated is None else self.extrapolated
            mask = torch.from_numpy(pixels[None] & ~bands[:, None, None])
        depth = None if self.depth is None else torch.from_numpy(np.ascontiguousarray(self.depth, dtype=np.float32))
        grid = torch.from_numpy(np.asarray(self.wavelengths, dtype=np.float64))
        return Cube(torch.from_numpy(values), grid, self.unit, mask, depth, self.name, self.facts)

    def checked_rows(self, first: int, last: int) -> tuple[np.ndarray, np.ndarray | None]:
        """`rows`, with pixels that are not finite marked, and set to 0 with those that are not valid.

        Raises:    CubeError where they cannot be read.
        """
        try:
            with np.errstate(all="ignore"):  # what overflows float32 is infinite, and marked
                values, valid = self.rows(first, last)
                values = np.ascontiguousarray(values, dtype=np.float32)
        except (CubeError, ImportError):
            raise
        except Exception as error:
            raise CubeError(words_of(error, f"rows {first} to {last} cannot be read")) from error
        finite = np.isfinite(values).all(0)
        valid = finite if valid is None else valid & finite
        if valid.all():
            return values, None
        return np.where(valid, values, np.float32(0)), valid  # not in place: the rows may be the caller's own


def write_cube(path: str | os.PathLike[str], cube: Cube) -> None:
    """Write a cube as TIFF: see the head of this file. An old file of that name stays until the new one is whole.

    Raises:    CubeError for a name that does not end in .tif; FileNotFoundError if the folder does not exist.

    Example:
    >>> cube = data.Cube(torch.rand(8, 4, 6), torch.linspace(420, 700, 8) * nm, "reflectance")
    >>> data.write_cube("wall.tif", cube)
    >>> (data.read_cube("wall.tif").wavelengths / nm).round().tolist()
    [420.0, 460.0, 500.0, 540.0, 580.0, 620.0, 660.0, 700.0]
    """
    pixels: np.ndarray | None = None
    bands: np.ndarray = np.zeros(cube.shape[0], bool)
    if cube.mask is not None:
        mask = cube.mask.numpy()
        bands = np.asarray(~mask.any((1, 2)) & mask.any())
        pixels = np.asarray(mask[~bands].all(0))

    def rows(first: int, last: int) -> tuple[np.ndarray, np.ndarray | None]:
        return cube.values[:, first:last].numpy(), None if pixels is None else pixels[first:last]

    name, grid, depth = cube.name or Path(path).stem, cube.wavelengths.numpy(), cube.depth
    depths = None if depth is None else depth.numpy()
    write_source(path, Source(name, cube.shape, grid, cube.unit, rows, dict(cube.source), bands, depths))


STRIP = 2**24
"""Values of a cube that are held at once: 64 MB, some three times over."""


def write_source(path: str | os.PathLike[str], source: Source) -> dict[str, Any]:
    """Write what a source gives, strip by strip, as a cube file. Returns what it was: size, range, invalid pixels."""
    path = Path(path)
    if path.suffix != SUFFIX:
        raise CubeError(f"cannot write {path.name}: a cube's name ends in {SUFFIX}. Use {path.stem}{SUFFIX}.")
    bands, height, width = source.check().shape
    strip = max(1, min(height, STRIP // (bands * width)))
    invalid = np.zeros((height, width), bool)
    low, high = np.inf, -np.inf
    extrapolated = np.zeros(bands, bool) if source.extrapolated is None else source.extrapolated
    document = {
        "kcam_cube": VERSION,
        "name": source.name,
        "wavelengths_nm": [round(float(value) / nm, 6) for value in source.wavelengths],
        "unit": source.unit,
        "extrapolated": [bool(value) for value in extrapolated],
        "source": source.facts,
    }
    how: dict[str, Any] = {"photometric": "minisblack", "metadata": None, "software": "kcam"}
    with replacing(path) as temporary:
        text = json.dumps(document, sort_keys=True)
        large = 4 * bands * height * width > 2**32 - 2**26
        made = tifffile.memmap(
            temporary, shape=source.shape, dtype=np.float32, description=text, bigtiff=large, byteorder="<", **how
        )
        start = made.offset
        del made
        with temporary.open("rb+") as file:  # through the mapping, all that was written would stay in memory
            for first in range(0, height, strip):
                last = min(first + strip, height)
                part, valid = source.checked_rows(first, last)
                for band, plane in enumerate(part.astype("<f4", copy=False)):
                    file.seek(start + 4 * width * (band * height + first))
                    file.write(plane.tobytes())
                if valid is not None:
                    invalid[first:last] = ~valid
                low, high = min(low, float(part.min())), max(high, float(part.max()))
        if invalid.all():
            raise CubeError(NOTHING_VALID)
        with tifffile.TiffWriter(temporary, append=True) as file:
            if invalid.any():
                file.write((~invalid).astype(np.uint8) * 255, **how)
            if source.depth is not None:
                file.write(np.ascontiguousarray(source.depth, dtype=np.float32), **how)
    return {
        "name": source.name,
        "shape": [bands, height, width],
        "low": low,
        "high": high,
        "invalid": float(invalid.mean()),
        "extrapolated": int(np.sum(extrapolated)),
    }


def is_cube(path: Path) -> bool:
    """Whether a file looks like one that `write_cube` wrote."""
    if path.suffix.lower() not in (".tif", ".tiff") or not path.is_file():
        return False
    try:
        with tifffile.TiffFile(path) as file:
            first: Any = file.pages[0]
            return '"kcam_cube"' in (first.description or "")
    except Exception:
        return False


class _Version(TypedDict):
    kcam_cube: int


class _Document(_Version):
    name: str
    unit: str
    wavelengths_nm: list[float]
    extrapolated: list[bool]
    source: dict[str, Any]


def open_cube(path: Path) -> Source:
    """A cube file as a source: its strips are read from the disk when they are asked for."""
    with tifffile.TiffFile(path) as file:
        pages: list[Any] = list(file.pages)
        how: dict[str, Any] = {"wrong": "its description is damaged", "error": CubeError, "hook": None}
        version = from_json(pages[0].description, _Version, **how)["kcam_cube"]
        if version != VERSION:
            raise CubeError(f"it is a cube of version {version}; this kcam reads {VERSION}.")
        document: _Document = from_json(pages[0].description, _Document, **how)
        name, unit, facts = document["name"], document["unit"], document["source"]
        grid = np.asarray(document["wavelengths_nm"], dtype=np.float64) * nm
        extrapolated = np.asarray(document["extrapolated"], dtype=bool)
        bands, (height, width) = len(grid), pages[0].shape[:2]
        if not bands <= len(pages) <= bands + 2 or len(extrapolated) != bands or unit not in UNITS:
            raise CubeError(f"it has {len(pages)} pages and {len(extrapolated)} marks for {bands} bands of {unit!r}.")
        places = [_place(page, index, (height, width), file) for index, page in enumerate(pages)]
    kinds = [dtype.kind for _, dtype in places]
    if "u" in kinds[:bands] or len(set(kinds[bands:])) != len(kinds[bands:]):
        raise CubeError("its pages are not as kcam writes them: values, then one mask at most and one depth map.")
    size = 4 * height * width
    if any(start != places[0][0] + index * size for index, (start, _) in enumerate(places[:bands])):
        raise CubeError("its bands do not follow one another: a header is damaged, or another tool wrote it anew.")

    def page_rows(index: int, first: int, last: int) -> np.ndarray:
        start, dtype = places[index]
        count = (last - first) * width
        found = np.fromfile(path, dtype, count, offset=start + first * width * dtype.itemsize)
        return found.reshape(last - first, width)

    extra = {places[index][1].kind: index for index in range(bands, len(pages))}  # "u": the mask, "f": the depth

    def rows(first: int, last: int) -> tuple[np.ndarray, np.ndarray | None]:
        values = np.empty((bands, last - first, width), np.float32)
        for index in range(bands):
            values[index] = page_rows(index, first, last)
        return values, page_rows(extra["u"], first, last) > 0 if "u" in extra else None

    depth = page_rows(extra["f"], 0, height).astype(np.float32) if "f" in extra else None
    return Source(name, (bands, height, width), grid, unit, rows, facts, extrapolated, depth).check()


def _place(page: Any, index: int, shape: tuple[int, int], file: tifffile.TiffFile) -> tuple[int, np.dtype]:
    """Where a page's values stand in the file, and their type; CubeError where they are not as kcam writes them."""
    dtype = np.dtype(page.dtype).newbyteorder(file.byteorder)
    if page.shape != shape or dtype.kind + str(dtype.itemsize) not in ("f4", "u1") or page.compression != 1:
        raise CubeError(f"page {index} is {page.shape} of {page.dtype}, not as kcam writes it.")
    if not page.is_contiguous or sum(page.databytecounts) != page.nbytes:
        raise CubeError(f"page {index} is not in one piece: its header is damaged.")
    if page.dataoffsets[0] + page.nbytes > file.filehandle.size:
        raise CubeError(f"page {index} is cut off: the file ends before it does.")
    return page.dataoffsets[0], dtype
