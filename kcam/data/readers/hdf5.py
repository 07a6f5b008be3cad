"""HDF5 of any layout, MATLAB 7.3 among it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from kcam.data.cube import CubeError, Source, check_promise, check_size, lacking
from kcam.data.readers.format import (
    WAVELENGTHS,
    Format,
    Options,
    bands_first,
    cube_array,
    full_scale,
    in_metres,
    known_wavelengths,
    may_be_wavelengths,
    scaled,
    scene_name,
)

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_PLACES = (0, 512, 1024, 2048)  # behind a block of the user's, such as MATLAB's 512 bytes


def h5py() -> Any:
    """The library. Raises: ImportError that names the extra."""
    try:
        import h5py
    except ImportError as error:
        raise ImportError("HDF5, and so MATLAB 7.3, is read by the extra: pip install 'kcam[data]'.") from error
    return h5py


def check_links(file: Any, key: str) -> None:
    """CubeError where the way to an object leaves the file, or is a link within it that may."""
    parts = key.split("/")
    for depth in range(1, len(parts) + 1):  # from the top: to look behind a link is to follow it
        link = file.get("/".join(parts[:depth]), getlink=True)
        if link is not None and not isinstance(link, h5py().HardLink):
            raise CubeError(f"its {key!r} is a link to elsewhere, which is not followed.")


def array_in(file: Any, key: str, path: Path) -> Any:
    """An array of numbers which lies in this file and nowhere else.

    Raises:    CubeError for what is none: a link, numbers in other files, or none at all.
    """
    check_links(file, key)
    if key not in file:
        raise lacking(f"array {key!r}", sorted(file))
    array = file[key]
    if not isinstance(array, h5py().Dataset) or array.ndim not in (3, 4) or array.dtype.kind not in "fui":
        raise CubeError(f"its {key!r} is no array of numbers with three axes.")
    if array.external or array.is_virtual:
        raise CubeError(f"its {key!r} lies in other files, which are not opened.")
    check_size(array.shape, f"its {key!r}")
    stored = array.id.get_storage_size()
    if not 0 < stored <= path.stat().st_size:
        raise CubeError(f"its {key!r} is not in the file: {stored} bytes of {path.stat().st_size}.")
    check_promise(array.nbytes, stored, f"its {key!r}")
    return array


def wavelengths_in(file: Any, name: str) -> np.ndarray | None:
    """Wavelengths [m] that stand in a file under a name, or None."""
    check_links(file, name)
    found = file.get(name)
    if not isinstance(found, h5py().Dataset) or found.dtype.kind not in "fui" or found.external or found.is_virtual:
        return None
    return in_metres(found[()]) if may_be_wavelengths(found.shape or ()) else None


def is_matlab(path: Path) -> bool:
    """Whether MATLAB 7.3 wrote a file: in it axes stand in the reverse of MATLAB's order."""
    with path.open("rb") as file:
        return file.read(10) == b"MATLAB 7.3"


def _is_hdf5(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(_PLACES[-1] + len(_SIGNATURE))
    return any(head[place : place + len(_SIGNATURE)] == _SIGNATURE for place in _PLACES)


def _open_hdf5(path: Path, options: Options) -> Source:
    """Any data set of HDF5, its wavelengths beside it or named; 8 and 16 bits over their largest, others as they are.

    Axes are counted as h5py shows them, in a file of MATLAB's as MATLAB does.
    """
    library, matlab = h5py(), is_matlab(path)
    found: dict[str, tuple[tuple[int, ...], bool]] = {}

    def direction(array: Any) -> int:
        return -1 if matlab or "MATLAB_class" in array.attrs else 1

    def note(name: str, item: Any) -> None:
        if isinstance(item, library.Dataset) and not name.startswith("#"):  # MATLAB's own: #refs#, #subsystem#
            found[name] = ((item.shape or ())[:: direction(item)], item.dtype.kind in "fui")

    with library.File(path, "r") as file:
        file.visititems(note)
        if options.key is not None:
            options = replace(options, key=options.key.strip("/"))
            check_links(file, str(options.key))
        key, shape = cube_array(found, options)
        array = array_in(file, key, path)
        divisor, turned = full_scale(array.dtype), direction(array)
        group = key.rpartition("/")[0]
        names = [f"{group}/{name}" for name in WAVELENGTHS if group] + list(WAVELENGTHS)
        grids = (wavelengths_in(file, name) for name in names)
        own = next((grid for grid in grids if grid is not None), None)
    order, axes = bands_first(shape, options, own, key)
    stored = list(range(len(shape)))[::turned]  # where each axis that is shown stands in the file
    places = [stored[len(shape) - 3 + axis] for axis in axes]
    rest = [axis for axis in stored if axis not in places]
    bands, height, width = (shape[::turned][place] for place in places)

    def rows(first: int, last: int) -> tuple[np.ndarray, None]:
        index = [slice(None)] * len(shape)
        index[places[1]] = slice(first, last)
        with library.File(path, "r") as file:
            part = file[key][tuple(index)].transpose(*places, *rest)
        return scaled(part.reshape(part.shape[:3]), divisor), None

    facts = {"scaling": f"{key} / {divisor:g}", "orientation": f"axes {order}"}
    grid = known_wavelengths(options, bands, own)
    return Source(scene_name(path), (bands, height, width), grid, "relative radiance", rows, facts)


HDF5 = Format(
    "hdf5",
    "any HDF5, MATLAB 7.3 too: an array of three axes (`--key`, `--axes`), wavelengths beside it or named",
    _open_hdf5,
    (".h5", ".hdf5", ".mat"),
    _is_hdf5,
    free=True,
)
