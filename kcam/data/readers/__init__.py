"""Readers of public data sets: one table, `FORMATS`. Bands are known by their wavelength, never by their place.

A reader opens a path as a `Source`, which says the unit, the wavelengths and the scaling, and turns the array upright:
(L,H,W), row 0 at the top as the data set shows it. To add a format, write a file with its row, and list it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from kcam.data.bands import CASSI_NM, PROFILES, profile, resampled
from kcam.data.cube import Cube, CubeError, Source, is_cube, open_cube, words_of
from kcam.data.readers import envi, exr, matlab, npz, photograph, png, tiff
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
        npz.NPZ,
        photograph.RGB,
    )
}
"""In the order in which a path that no format is named for is tried."""
SUFFIXES = tuple(dict.fromkeys(suffix for row in FORMATS.values() for suffix in row.suffixes))


def read_cube(
    path: str | Path,
    *,
    format: str | None = None,
    wavelengths: Any = None,
    key: str | None = None,
    bands: Any = None,
    depth: np.ndarray | None = None,
) -> Cube:
    """A spectral cube from a file or a folder of any known format.

    Args:      format: a name in `FORMATS`; None where the file says what it is.
               wavelengths: (L,) [m], for files that hold none. key: name of the array inside the file.
               bands: (L,) [m] that a photograph is upsampled to; None for 28 from 420 to 720 nm.
               depth: of a photograph, (H,W) [m].
    Returns:   a `Cube`, values float32.
    Raises:    FileNotFoundError; CubeError with its name for a file that is damaged, of another layout, or without
               wavelengths; ValueError for an unknown format; ImportError for a format whose reader is not installed.
    """
    grids = [None if grid is None else wavelength_grid(grid).numpy() for grid in (wavelengths, bands)]
    try:
        return open_source(Path(path), format=format, options=Options(grids[0], key, grids[1], depth)).cube()
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
    row = recognised(path) if format is None else FORMATS[format]
    if row is None:
        raise CubeError(
            f"its format is not recognised. Name it: --format {'|'.join(FORMATS)}, and --profile or --wavelengths for "
            "files that hold no wavelengths. Or it is damaged."
        )
    try:
        with np.errstate(all="ignore"):  # what overflows float32 is infinite, and marked when it is read
            source = row.open(path, options or Options())
        return replace(source, facts={"format": row.name} | row.facts | source.facts).check()
    except (CubeError, ImportError, FileNotFoundError):
        raise
    except Exception as error:
        raise CubeError(words_of(error, f"it cannot be read as {row.name}")) from error


def recognised(path: Path) -> Format | None:
    """The first row of the table that knows the path."""
    for row in FORMATS.values():
        try:
            if row.matches(path):
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
    if path.is_file() or (path.is_dir() and recognised(path)):
        yield path
        return
    if not path.is_dir():
        raise FileNotFoundError(f"there is no file or folder {path}.")
    for child in sorted(path.iterdir()):
        if child.name.startswith(".") or child.name in ("__MACOSX", "Thumbs.db", "calib.txt"):
            continue
        if child.is_dir():
            if child.is_symlink() and child.resolve() in (path.resolve(), *path.resolve().parents):
                continue
            yield from scenes_in(child)
        elif child.suffix.lower() in SUFFIXES:
            yield child


__all__ = [
    "CASSI_NM", "FORMATS", "PROFILES", "SUFFIXES", "Format", "Options", "open_source", "profile", "read_cube",
    "recognised", "resampled", "scene_name", "scenes_in",
]  # fmt: skip
