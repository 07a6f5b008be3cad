"""Readers of public data sets: one table, `FORMATS`. Bands are known by their wavelength, never by their place.

A reader opens a path as a `Source`, which says the unit, the wavelengths and the scaling, and turns the array upright:
(L,H,W), row 0 at the top as the data set shows it. To add a format, write a file with its row, and list it.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from kcam.data.bands import CASSI_NM, PROFILES, profile, resampled
from kcam.data.cube import Cube, CubeError, Source, is_cube, open_cube, words_of
from kcam.data.readers import envi, exr, hdf5, matlab, npy, photograph, png, tiff
from kcam.data.readers.format import Format, Options, scene_name
from kcam.units import wavelength_grid

FORMATS = {
    row.name: row
    for row in (
        Format("kcam", "the cube files of kcam", lambda path, _: open_cube(path), fits=is_cube),
        exr.KAIST,
        png.CAVE,
        matlab.ICVL,
        matlab.ARAD_1K,
        matlab.HARVARD,
        matlab.CASSI,
        envi.ENVI,
        tiff.TIFF,
        npy.NPY,
        npy.NPZ,
        hdf5.HDF5,
        matlab.MAT,
        photograph.RGB,
    )
}
"""In the order in which a path that no format is named for is tried.

npy, npz, hdf5 and mat hold arrays of any data set. Which of them is the cube is told by `key`, where more than one has
three axes (a fourth in front, of length 1, is dropped). Which axis is which is told by `axes`, where it is not the
first or last alone that is as long as there are wavelengths: in the order in which NumPy or h5py shows them, and for a
MATLAB file in MATLAB's, in HDF5 too. The wavelengths stand beside it, as `wavelengths`, `wavelength` or `bands`, or are
named. Whole numbers of 8 and 16 bits are divided by their largest, others taken as they are; pixels with NaN or inf are
masked.
"""
ARRAYS = tuple(dict.fromkeys(suffix for row in FORMATS.values() if row.free for suffix in row.suffixes))
"""Endings of files that hold arrays of any data set."""
SUFFIXES = tuple(dict.fromkeys(suffix for row in FORMATS.values() for suffix in row.suffixes))


def read_cube(
    path: str | Path,
    *,
    format: str | None = None,
    wavelengths: Any = None,
    key: str | None = None,
    axes: str | None = None,
    bands: Any = None,
    depth: np.ndarray | None = None,
) -> Cube:
    """A spectral cube from a file or a folder of any known format.

    Args:      format: a name in `FORMATS`; None where the file says what it is.
               wavelengths: (L,) [m], for files that hold none. key: name of the array inside the file.
               axes: the order of its axes, the letters h, w and c (the bands), such as "hwc": see `FORMATS`.
               bands: (L,) [m] that a photograph is upsampled to; None for 28 from 420 to 720 nm.
               depth: of a photograph, (H,W) [m].
    Returns:   a `Cube`, values float32.
    Raises:    FileNotFoundError; CubeError with its name for a file that is damaged, of another layout, or without
               wavelengths; ValueError for an unknown format or other axes; ImportError for a format whose reader is
               not installed.

    Example:
    >>> cube = data.Cube(torch.rand(8, 4, 6), torch.linspace(420, 700, 8) * nm, "reflectance")
    >>> data.write_cube("wall.tif", cube)
    >>> torch.equal(data.read_cube("wall.tif").values, cube.values)
    True
    """
    grids = [None if grid is None else wavelength_grid(grid).numpy() for grid in (wavelengths, bands)]
    try:
        return open_source(Path(path), format=format, options=Options(grids[0], key, grids[1], depth, axes)).cube()
    except CubeError as error:
        raise CubeError(f"{path}: {error}") from error


def open_source(path: Path, *, format: str | None = None, options: Options | None = None) -> Source:
    """A cube that is read strip by strip. Errors as `read_cube`."""
    if not path.exists():
        raise FileNotFoundError(f"there is no file or folder {path}.")
    if not (path.is_file() or path.is_dir()):
        raise CubeError("it is neither a file nor a folder.")
    if format is not None and format not in FORMATS:
        raise ValueError(f"unknown format {format!r}; known: {', '.join(FORMATS)}.")
    options = options or Options()
    if format is not None:
        row: Format | None = FORMATS[format]
    else:
        row = (recognised(path, free=True) if options.axes else None) or recognised(path)
    if row is not None and options.axes is not None and not row.free:
        free = ", ".join(name for name, other in FORMATS.items() if other.free)
        raise CubeError(f"format {row.name} has axes of its own, and --axes are named. Leave them out, or use {free}.")
    if row is None:
        raise CubeError(
            f"its format is not recognised. Name it: --format {'|'.join(FORMATS)}, and --profile or --wavelengths for "
            "files that hold no wavelengths. Or it is damaged."
        )
    try:
        with np.errstate(all="ignore"):  # what overflows float32 is infinite, and marked when it is read
            source = row.open(path, options)
        return replace(source, facts={"format": row.name} | row.facts | source.facts).check()
    except (CubeError, ImportError, FileNotFoundError):
        raise
    except Exception as error:
        raise CubeError(words_of(error, f"it cannot be read as {row.name}")) from error


def recognised(path: Path, *, free: bool = False) -> Format | None:
    """The first row of the table that knows the path; free: of those whose axes a user may name."""
    for row in FORMATS.values():
        try:
            if row.free >= free and row.matches(path):
                return row
        except ImportError:
            raise
        except Exception:  # whatever a damaged file makes a library raise
            continue
    return None


def scenes_in(path: Path) -> Iterator[Path]:
    """The scenes of a path: itself, or what a folder of scenes holds, sorted; folders of one scene are not entered.

    A link to a folder that the path itself lies in is passed over.
    """
    return (found for found, reason in _walk(path) if reason is None)


def _walk(path: Path) -> Iterator[tuple[Path, str | None]]:
    """Scenes, and what is none and why; nothing of what is hidden or belongs to a scene."""
    if path.is_file() or (path.is_dir() and recognised(path)):
        yield path, None
        return
    if not path.is_dir():
        raise FileNotFoundError(f"there is no file or folder {path}.")
    children = sorted(path.iterdir())
    names = {child.name for child in children}
    for child in children:
        if child.name.startswith(".") or child.name in ("__MACOSX", "Thumbs.db", "calib.txt"):
            continue
        if child.is_dir():
            if child.is_symlink() and child.resolve() in (path.resolve(), *path.resolve().parents):
                yield child, "it is a link to a folder that it lies in."
            else:
                yield from _walk(child)
        elif child.suffix.lower() in SUFFIXES:
            yield child, None
        elif not {f"{child.name}.hdr", f"{child.stem}.hdr"} & names:  # ENVI's values belong to their header
            yield child, f"it is no cube: its name ends in none of {', '.join(SUFFIXES)}."


@dataclass
class Found:
    """Scenes of several paths, and what else was met, with the reason: what is passed over, and what is wrong."""

    scenes: list[Path] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)


def find_scenes(paths: Iterable[str | os.PathLike[str]], *, apart: Path | None = None) -> Found:
    """The scenes of files, scene folders and folders of scenes, each once.

    Args:      apart: a folder of other things, such as depth maps, which is not entered.
    """
    found = Found()
    seen: dict[Path, Path] = {}
    for given in map(Path, paths):
        empty = True
        try:
            for path, reason in _walk(given):
                whole = path.resolve()
                if apart is not None and apart.resolve() in whole.parents:
                    continue
                empty &= reason is not None
                if reason is None and whole in seen:
                    reason = f"it is there already: {seen[whole]}." if path != seen[whole] else "it is named twice."
                if reason is None:
                    seen[whole] = path
                    found.scenes.append(path)
                else:
                    found.skipped[str(path)] = reason
        except OSError as error:
            found.failed[str(given)] = str(error)
        else:
            if empty:
                expected = f"expected {', '.join(SUFFIXES)}, or a folder X_ms of PNGs"
                found.failed[str(given)] = f"there is no scene in it: {expected}."
    return found


__all__ = [
    "ARRAYS", "CASSI_NM", "FORMATS", "PROFILES", "SUFFIXES", "Format", "Found", "Options", "find_scenes", "open_source",
    "profile", "read_cube", "recognised", "resampled", "scene_name", "scenes_in",
]  # fmt: skip
