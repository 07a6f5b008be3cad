"""Cameras' raw files, read through LibRaw."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from kcam.isp import tiff
from kcam.sensor.mosaic import PATTERNS

TILES = ((2, 2), (6, 6))
"""Those that LibRaw knows; of others it takes what it finds for one of these."""


def read(path: Path) -> dict[str, Any]:
    """The fields of a file, by LibRaw and by its tags."""
    try:
        import rawpy
    except ImportError as error:
        raise ImportError(f"{path} is read by LibRaw, which comes with the extra: pip install 'kcam[raw]'.") from error
    try:
        with rawpy.imread(str(path)) as file:
            fields = _fields_of(file, path, tags := tiff.tags_in(path))
            with tiff.damaged_tags(path):
                return fields | tiff.said_by(tags)
    except ValueError:
        raise
    except Exception as error:  # a damaged header makes rawpy raise anything
        reason = error.args[0].decode() if error.args and isinstance(error.args[0], bytes) else str(error)
        raise ValueError(
            f"{path} is damaged, or no raw file that LibRaw reads, of 22 x 22 pixels at least: {reason}."
        ) from error


def _fields_of(file: Any, path: Path, tags: dict[int, Any]) -> dict[str, Any]:
    """The fields that LibRaw knows."""
    import rawpy

    if file.raw_type is not rawpy.RawType.Flat:
        raise ValueError(f"{path} holds full colours and no mosaic. Use Scene.from_file for a picture.")
    words = np.array(file.raw_image_visible)
    other = file.other
    fields: dict[str, Any] = {
        "white_level": file.white_level,
        "exposure_time": other.shutter_speed or None,
        "iso": other.iso_speed or None,
    }
    if file.num_colors == 1:
        return fields | {
            "mosaic": torch.from_numpy(words.astype(np.float32))[None, None],
            "pattern": None,
            "black_level": file.black_level_per_channel[0],
        }
    cells, letters = np.array(file.raw_colors_visible), file.color_desc.decode()
    if not set(letters) <= set("RGB"):
        raise ValueError(f"{path} has a mosaic of {letters}, expected red, green and blue.")
    channels = np.array(["RGB".index(letter) for letter in letters])[cells]
    shape = tuple(tags.get(tiff.CFA_REPEAT_PATTERN_DIM, (2, 2)))
    if shape not in TILES and not any(tags.get(tiff.ACTIVE_AREA, (0,))[:2]):
        with tiff.damaged_tags(path):
            cells = channels = _repeated(tiff.tile_in(tags), words.shape)
    name, top, left = _found(channels, path)
    words, cells = words[top:, left:], cells[top:, left:]
    rows, columns = len(PATTERNS[name]), len(PATTERNS[name][0])
    black = np.array(file.black_level_per_channel, dtype=float)[cells[:rows, :columns]]
    gains = np.array(file.camera_whitebalance[:3])
    gains = gains if (gains > 0).all() else np.array(file.daylight_whitebalance[:3])
    matrix = file.rgb_xyz_matrix[:3].astype(float)
    return fields | {
        "mosaic": torch.from_numpy(words.astype(np.float32))[None, None],
        "pattern": name,
        "black_level": float(black.flat[0]) if (black == black.flat[0]).all() else black,
        "neutral": gains[1] / gains if (gains > 0).all() else None,
        "colour_matrix": matrix if matrix.any() else None,
    }


def _repeated(tile: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A tile over (H,W)."""
    return tile[np.arange(size[0])[:, None] % len(tile), np.arange(size[1]) % len(tile[0])]


def _found(channels: np.ndarray, path: Path) -> tuple[str, int, int]:
    """The pattern whose tile repeats over (H,W) channels, and the row and column where it begins."""
    for name in tiff.COLOURED:
        tile = np.array(PATTERNS[name])
        offsets = [(0, 0)] if tile.shape == (2, 2) else list(np.ndindex(*tile.shape))
        for top, left in offsets:
            if np.array_equal(_repeated(np.roll(tile, (top, left), (0, 1)), channels.shape), channels):
                return name, top, left
    raise ValueError(f"{path} has the mosaic {channels[:6, :6].tolist()}, which is none of {', '.join(tiff.COLOURED)}.")
