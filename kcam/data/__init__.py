"""Spectral cubes from public data sets, and stores of patches to train on. The extras `data` and `exr` read more."""

from kcam.data.bands import PROFILES, parse_bands, resampling
from kcam.data.cube import Cube, CubeError, write_cube
from kcam.data.dataset import Patch, PatchDataset
from kcam.data.export import export_patches
from kcam.data.patches import Settings, StoreError, extract, make_plan, verify
from kcam.data.photos import Photo, PhotoDataset, read_depth
from kcam.data.readers import FORMATS, read_cube

__all__ = [
    "FORMATS", "PROFILES", "Cube", "CubeError", "Patch", "PatchDataset", "Photo", "PhotoDataset", "Settings",
    "StoreError", "export_patches", "extract", "make_plan", "parse_bands", "read_cube", "read_depth", "resampling",
    "verify", "write_cube",
]  # fmt: skip
