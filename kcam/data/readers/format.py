"""What all readers share: the row of a format, what a user says beside the path, and how values become a source."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from kcam.data.bands import PROFILES
from kcam.data.cube import CubeError, Source, lacking
from kcam.units import nm

WAVELENGTHS = ("wavelengths", "wavelength", "bands")
"""Names of an array beside the cube that holds its wavelengths, in nm, um or m."""
_MOST_WAVELENGTHS = 10_000
_MOST_LISTED = 12


@dataclass(frozen=True)
class Options:
    """What a user says beside the path.

    wavelengths: [m] of a file that has none. key: of the array in the file. bands: that a photograph is upsampled to
    [m]. depth: of a photograph, (H,W) [m]. axes: the order of the array's axes, the letters h, w and c (the bands):
    "hwc", "chw", ...

    Raises:    ValueError for other axes.
    """

    wavelengths: np.ndarray | None = None
    key: str | None = None
    bands: np.ndarray | None = None
    depth: np.ndarray | None = None
    axes: str | None = None

    def __post_init__(self) -> None:
        if self.axes is None:
            return
        object.__setattr__(self, "axes", self.axes.lower())
        if sorted(self.axes) != ["c", "h", "w"]:
            raise ValueError(
                f"axes {self.axes!r} are not the letters h, w and c (the bands) in the order of the array's axes, such "
                "as hwc or chw."
            )


@dataclass(frozen=True)
class Format:
    """A row: what it is, how it is opened, which paths it recognises without being named, and what to cite.

    suffixes: of its files; none where `fits` says it all. fits: whether a path that ends so is of this format.
    free: whether it leaves open which axis is which, so that `Options.axes` may say it.
    """

    name: str
    what: str
    open: Callable[[Path, Options], Source]
    suffixes: tuple[str, ...] = ()
    fits: Callable[[Path], bool] = lambda path: True
    facts: dict[str, str] = field(default_factory=dict)
    free: bool = False

    def matches(self, path: Path) -> bool:
        """Whether the path is of this format by its own word."""
        ends = not self.suffixes or (path.suffix.lower() in self.suffixes and path.is_file())
        return ends and self.fits(path)


def scene_name(path: Path) -> str:
    """The name of a scene, from its file or folder: letters, digits, points, dashes and underscores."""
    stem = path.name if path.is_dir() else path.stem
    return re.sub(r"[^A-Za-z0-9._-]+", "_", stem).strip("._") or "scene"


def array_source(
    path: Path,
    options: Options,
    values: np.ndarray,
    scaling: str,
    *,
    own: np.ndarray | None = None,
    unit: str = "relative radiance",
    valid: np.ndarray | None = None,
    divisor: float = 1.0,
    orientation: str = "as stored",
) -> Source:
    """Values (L,H,W) in memory or mapped, over a divisor; the file's own wavelengths [m]; valid pixels (H,W)."""
    grid = known_wavelengths(options, len(values), own)

    def rows(first: int, last: int) -> tuple[np.ndarray, np.ndarray | None]:
        return scaled(values[:, first:last], divisor), None if valid is None else np.array(valid[first:last])

    facts = {"scaling": scaling, "orientation": orientation}
    return Source(scene_name(path), values.shape, grid, unit, rows, facts)


def known_wavelengths(options: Options, count: int, own: np.ndarray | None = None) -> np.ndarray:
    """The wavelengths that a user names, or else the file's own, [m]."""
    grid = own if options.wavelengths is None else options.wavelengths
    if grid is None:
        raise CubeError(
            f"it has {count} bands and no wavelengths. Say which: --wavelengths start:stop:count in nm, or --profile "
            f"{'|'.join(PROFILES)}."
        )
    if len(grid) != count:
        raise CubeError(f"it has {count} bands, but {len(grid)} wavelengths are named for it.")
    return np.asarray(grid, dtype=np.float64)


def in_metres(values: Any) -> np.ndarray:
    """Wavelengths that a file states in nm, um or m: [m]."""
    grid = np.asarray(values, dtype=np.float64).ravel()
    if not len(grid) or not np.isfinite(grid).all() or grid.min() <= 0:
        raise CubeError("its wavelengths are empty, not finite or not positive.")
    return grid * (1 if grid.max() < 1e-3 else 1e-6 if grid.max() < 20 else nm)


def scaled(values: np.ndarray, divisor: float) -> np.ndarray:
    """Values over a divisor, in float32."""
    return values.astype(np.float32) / np.float32(divisor)


def full_scale(dtype: np.dtype) -> float:
    """What values of a type are divided by: whole numbers of 8 or 16 bits by their largest, others by 1."""
    return {"u1": 255.0, "u2": 65535.0}.get(dtype.kind + str(dtype.itemsize), 1.0)


# ---- arrays of any data set: which one is the cube, and which of its axes is which ---------------------------------


def cube_array(
    arrays: Mapping[str, tuple[Sequence[int], bool]], options: Options, *, usual: Sequence[str] = ()
) -> tuple[str, tuple[int, ...]]:
    """Name and shape of the array that is the cube: the one that a user names, a usual one, or the only one.

    Args:      arrays: shapes, and whether they hold real numbers, by name.
    Raises:    CubeError that lists what there is, where it is none of those or has not three axes. A fourth one in
               front, of length 1, does not count.
    """
    listed = [f"{name} ({_sizes(shape)})" for name, (shape, _) in sorted(arrays.items())]
    more = f"and {len(listed) - _MOST_LISTED} more"
    listed = listed if len(listed) <= _MOST_LISTED else [*listed[:_MOST_LISTED], more]
    fitting = [name for name, (shape, real) in arrays.items() if real and len(without_first(shape)) == 3]
    key = options.key
    if key is None:
        key = next((name for name in usual if name in fitting), fitting[0] if len(fitting) == 1 else None)
    if key is None and fitting:
        raise CubeError(
            f"it has {len(fitting)} arrays of three axes. Say which is the cube, --key {fitting[0]} or another: "
            f"{', '.join(listed)}."
        )
    if key is None:
        raise lacking("array of numbers with three axes, as a cube has", listed)
    if key not in arrays:
        raise lacking(f"array {key!r}", listed)
    shape, real = arrays[key]
    if not real or len(without_first(shape)) != 3:
        what = "" if real else " of no real numbers"
        raise CubeError(f"its {key!r} is {_sizes(shape)}{what}, expected an array of numbers with three axes.")
    return key, tuple(shape)


def without_first(shape: Sequence[int]) -> tuple[int, ...]:
    """A shape without a first axis of length 1, where there are four."""
    return tuple(shape[1:] if len(shape) == 4 and shape[0] == 1 else shape)


def bands_first(
    shape: Sequence[int], options: Options, own: np.ndarray | None, name: str, *, usual: str | None = None
) -> tuple[str, tuple[int, int, int]]:
    """The order of an array's axes in letters, and its axes that are bands, rows and columns.

    It is what a user says; else hwc or chw, where the first axis or the last alone is as long as there are wavelengths.

    Args:      usual: the order where that does not tell; None to ask.
    Raises:    CubeError where it is not known, or the wavelengths are not, or are not as many.
    """
    sizes = without_first(shape)
    grid = own if options.wavelengths is None else options.wavelengths
    order = options.axes
    if order is None:
        fitting = [axis for axis in range(3) if grid is not None and sizes[axis] == len(grid)]
        order = "hwc" if fitting == [2] else "chw" if fitting == [0] else usual
        if order is None or grid is None:
            raise CubeError(_unknown_order(sizes, grid, fitting, name))
    elif grid is not None and sizes[order.index("c")] != len(grid):
        raise CubeError(
            f"it has {sizes[order.index('c')]} bands, but {len(grid)} wavelengths are named for it: its {name!r} is "
            f"{_sizes(sizes)}, read as {order}. Are --axes right?"
        )
    rows, columns, bands = (order.index(letter) for letter in "hwc")
    return order, (bands, rows, columns)


def may_be_wavelengths(shape: Sequence[int]) -> bool:
    """Whether an array is a row or a column of numbers, of which there are not too many."""
    return 0 < math.prod(shape) == max(shape, default=1) <= _MOST_WAVELENGTHS


def _unknown_order(sizes: Sequence[int], grid: np.ndarray | None, fitting: Sequence[int], name: str) -> str:
    if grid is None:
        return (
            f"its {name!r} is {_sizes(sizes)}, and it has no wavelengths. Say which: --wavelengths start:stop:count in "
            f"nm, or --profile {'|'.join(PROFILES)}; and --axes hwc, chw, ... where its sizes do not tell."
        )
    if not fitting:
        return f"its {name!r} is {_sizes(sizes)}: none of its axes is as long as there are wavelengths, {len(grid)}."
    return (
        f"its {name!r} is {_sizes(sizes)}, and which axis is which is not known: {len(fitting)} "
        f"{'is' if len(fitting) == 1 else 'are'} as long as there are wavelengths. Say it: --axes hwc, chw, ..."
    )


def _sizes(shape: Sequence[int]) -> str:
    return " x ".join(map(str, shape)) or "one number"
