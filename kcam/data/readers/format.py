"""What all readers share: the row of a format, what a user says beside the path, and how values become a source."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from kcam.data.bands import PROFILES
from kcam.data.cube import CubeError, Source
from kcam.units import nm


@dataclass(frozen=True)
class Options:
    """What a user says beside the path.

    wavelengths: [m] of a file that has none. key: of the array in the file. bands: that a photograph is upsampled to
    [m]. depth: of a photograph, (H,W) [m].
    """

    wavelengths: np.ndarray | None = None
    key: str | None = None
    bands: np.ndarray | None = None
    depth: np.ndarray | None = None


@dataclass(frozen=True)
class Format:
    """A row: what it is, how it is opened, which paths it recognises without being named, and what to cite.

    suffixes: of its files; none where `fits` says it all. fits: whether a path that ends so is of this format.
    """

    name: str
    what: str
    open: Callable[[Path, Options], Source]
    suffixes: tuple[str, ...] = ()
    fits: Callable[[Path], bool] = lambda path: True
    facts: dict[str, str] = field(default_factory=dict)

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
) -> Source:
    """Values (L,H,W) that are in memory, the file's own wavelengths [m], and which pixels are valid (H,W)."""
    grid = known_wavelengths(options, len(values), own)

    def rows(first: int, last: int) -> tuple[np.ndarray, np.ndarray | None]:
        part = np.array(values[:, first:last], dtype=np.float32)
        return part, None if valid is None else np.array(valid[first:last])

    facts = {"scaling": scaling, "orientation": "as stored"}
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
    """Wavelengths that a file states in nm, or in um: [m]."""
    grid = np.asarray(values, dtype=np.float64).ravel()
    if not len(grid) or not np.isfinite(grid).all() or grid.min() <= 0:
        raise CubeError("its wavelengths are empty, not finite or not positive.")
    return grid * (1e-6 if grid.max() < 20 else nm)


def bands_first(values: np.ndarray, grid: np.ndarray | None) -> np.ndarray:
    """Values (H,W,L) as (L,H,W), where it is their last axis alone that is as long as the wavelengths."""
    last = grid is not None and len(values) != len(grid) and values.shape[-1] == len(grid)
    return values.transpose(2, 0, 1) if last else values


def scaled(values: np.ndarray, divisor: float) -> np.ndarray:
    """Values over a divisor, in float32."""
    return values.astype(np.float32) / np.float32(divisor)


def normalised(values: np.ndarray) -> tuple[np.ndarray, float]:
    """Whole numbers of 8 or 16 bits over their largest, others as they are; and what they were divided by."""
    divisor = {"u1": 255.0, "u2": 65535.0}.get(values.dtype.kind + str(values.dtype.itemsize), 1.0)
    return scaled(values, divisor), divisor
