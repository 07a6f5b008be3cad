"""Photographs with depth: folders of pictures, and of the distances of their pixels."""

from __future__ import annotations

import math
import operator
import os
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy
import tifffile
import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional as F
from torch.utils.data import Dataset

from kcam import srgb
from kcam.data.cube import words_of
from kcam.scene import Scene, fitted, read_picture, target_shape
from kcam.units import as_numbers, check_distances

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
DEPTH_MAPS = (".png", ".npy", ".tif", ".tiff", ".exr")
MILLIMETRES = 1e-3
"""Metres per count of a depth map in whole numbers, as RGB-D cameras write them."""
_NO_DISTANCE = 65504.0
"""The largest number of half precision: floats from here on are codes for infinity, not distances [m]."""
_DEPTH_CHANNELS = ("Z", "Y", "V", "depth", "Depth", "R")  # of an EXR, by what is asked first
_SHOWN = 3  # names in an error


class Photo(NamedTuple):
    """image: (3,H,W) float32 sRGB in [0,1]. depth: (1,H,W) float32 [m], > 0 everywhere. mask: (1,H,W) bool, where it
    was measured. name: of the file, as seen from the folder.

    Example:
    >>> depth = torch.full((1, 4, 6), 2.0)
    >>> photo = data.Photo(torch.rand(3, 4, 6), depth, mask=depth.isfinite(), name="wall.png")
    >>> Scene.from_rgb(photo.image, depth=photo.depth).shape
    (1, 4, 6)
    """

    image: Tensor
    depth: Tensor
    mask: Tensor
    name: str


class PhotoDataset(Dataset[Photo]):
    """The photographs in a folder and below it, each with the depth map of the same name in another folder.

    Pictures are PNG, JPEG, TIFF, WebP or BMP, read as `read_picture` does (turned as EXIF says, alpha on white), gray
    ones in three equal channels; hidden files are none. They stand in natural order, 2.png before 10.png. A map has the
    picture's name in the same folder below `depth_folder`, or anywhere there if no other has it. Depth is read by
    `read_depth`. What was not measured takes the distance of the nearest pixel that was, and False in the mask; so a
    depth always makes a `Scene`, and ``torch.where(mask, depth, nan)`` shows the holes.

    A map of another size is brought to the picture's by picking the nearest pixels; its proportions must be the
    picture's, to a pixel of the map. Nothing is read before it is asked for and no file stays open, so that a
    DataLoader may have workers; where sizes agree, it makes batches of these tuples.

    Args:      folder: of the pictures.
               depth_folder: of the maps; None if there are none. It may lie inside `folder`.
               depth: of pictures that have no map [m], inf allowed; their mask is False. None to have maps for all.
               depth_scale: metres per count of maps in whole numbers. RGB-D cameras (RealSense, Kinect, and with them
               NYU's and ScanNet's data) write millimetres; TUM's benchmark 1/5000 m.
               missing: "error", or "skip" for pictures that have no map: they are left out, and named in `skipped`.
               size: of the longer side [pixels], or (height, width), cropped in the middle; see `Scene.resized`.
               crop: side, or (height, width), of a window at random [pixels], cut after that.
               seed: of the windows, which are then the same each time; None for torch's default generator.
    Raises:    FileNotFoundError for a folder that is not there, and where depth maps are missing, with the first of
               them; ValueError for a folder without pictures, two maps for one picture, or arguments out of range.
               At access: ValueError with the file for one that is damaged, a map of other proportions or without any
               distance, or a picture smaller than the window; IndexError, TypeError for an index that is none.

    Example:
    >>> plots.write_picture(torch.rand(3, 40, 60), "wall.png")
    >>> photos = data.PhotoDataset(".", depth=2.0, size=30)
    >>> len(photos), photos[0].image.shape, float(photos[0].depth.mean())
    (1, torch.Size([3, 20, 30]), 2.0)
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        depth_folder: str | os.PathLike[str] | None = None,
        *,
        depth: float | None = None,
        depth_scale: float = MILLIMETRES,
        missing: Literal["error", "skip"] = "error",
        size: int | tuple[int, int] | None = None,
        crop: int | tuple[int, int] | None = None,
        seed: int | None = None,
    ) -> None:
        self.folder, self.depth_folder = _folder(folder), None if depth_folder is None else _folder(depth_folder)
        self.depth, self.depth_scale = None if depth is None else _one_distance(depth), check_scale(depth_scale)
        if missing not in ("error", "skip"):
            raise ValueError(f'missing must be "error" or "skip", got {missing!r}.')
        if depth is not None and missing == "skip":
            raise ValueError('depth= is for pictures without a map, which missing="skip" leaves out. Give one of them.')
        if depth is None and depth_folder is None:
            raise ValueError("photographs need distances: depth_folder=, of their maps, or depth=2.0 for all of them.")
        if self.depth_folder is not None and self.folder.resolve() == self.depth_folder.resolve():
            raise ValueError(
                f"depth_folder is the folder of the pictures, {folder}: a map has the name of its picture. Put them "
                "apart."
            )
        target_shape(size, (1, 1))
        self.size, self.seed = size, seed
        self.crop = None if crop is None else _window(crop)
        self.skipped: list[str] = []
        pictures = files_in(self.folder, but=self.depth_folder)
        if not pictures:
            raise ValueError(f"there is no picture in the folder {self.folder}: expected {', '.join(PICTURES)}.")
        maps: list[Path | None] = [None] * len(pictures)
        if self.depth_folder is not None:
            maps = _maps(self.folder, pictures, self.depth_folder)
        self._pairs = list(zip(pictures, maps, strict=True))
        without = [self._name(picture) for picture, found in self._pairs if found is None]
        if without and depth is None:
            if missing == "error" or len(without) == len(pictures):
                raise FileNotFoundError(self._lacking(without, pictures))
            self.skipped = without
            self._pairs = [pair for pair in self._pairs if pair[1] is not None]

    def __len__(self) -> int:
        return len(self._pairs)

    @property
    def names(self) -> list[str]:
        """Of the pictures, in order."""
        return [self._name(picture) for picture, _ in self._pairs]

    def __getitem__(self, index: int) -> Photo:
        index = self._index(index)
        path, map_path = self._pairs[index]
        image = read_picture(path)
        image = image.expand(3, -1, -1)
        shape = (image.shape[1], image.shape[2])
        if map_path is None:
            depth, mask = torch.full((1, *shape), self.depth or math.inf), torch.zeros(1, *shape, dtype=torch.bool)
        else:
            measured = read_depth(map_path, scale=self.depth_scale)
            _check_proportions(measured, shape, map_path, path)
            planes = torch.cat([filled(measured, name=str(map_path)), measured.isfinite().float()])
            if planes.shape[1:] != shape:
                planes = F.interpolate(planes[None], shape, mode="nearest-exact")[0]
            depth, mask = planes[:1], planes[1:] > 0
        if self.size is not None:
            shape = target_shape(self.size, shape)
            image = srgb.to_code(fitted(srgb.to_light(image)[None], shape)[0])
            planes = fitted(torch.cat([depth, mask.float()])[None], shape, pick=True)[0]
            depth, mask = planes[:1], planes[1:] > 0
        window: tuple[slice, ...] = (slice(None),)
        if self.crop is not None:
            top, left = self._place(index, shape)
            window = (slice(None), slice(top, top + self.crop[0]), slice(left, left + self.crop[1]))
        image, depth, mask = (part[window].contiguous() for part in (image, depth, mask))
        return Photo(image, depth, mask, self._name(path))

    def scene(
        self,
        index: int,
        *,
        wavelengths: Tensor | None = None,
        illuminant: str | Tensor = "D65",
        luminance: float = 1000.0,
    ) -> Scene:
        """A picture as a `Scene`, with its depth. Arguments: as `Scene.from_rgb`."""
        photo = self[index]
        depth = photo.depth if self._pairs[self._index(index)][1] is not None or self.depth is None else self.depth
        return Scene.from_rgb(
            photo.image, depth=depth, wavelengths=wavelengths, illuminant=illuminant, luminance=luminance
        )

    def _place(self, index: int, shape: tuple[int, int]) -> tuple[int, int]:
        """Where the window is cut, row and column of its upper left pixel."""
        height, width = self.crop or shape
        free = [size - own + 1 for size, own in zip(shape, (height, width), strict=True)]
        if min(free) < 1:
            raise ValueError(
                f"{self._name(self._pairs[index][0])} has {shape[0]} x {shape[1]} pixels, fewer than crop={self.crop}. "
                "Give size= that is larger, or a smaller crop."
            )
        if self.seed is None:
            top, left = (int(torch.randint(count, ())) for count in free)
        else:
            top, left = np.random.default_rng((self.seed, index)).integers(free).tolist()
        return top, left

    def _index(self, index: int) -> int:
        count = len(self)
        try:
            index = operator.index(index)
        except TypeError:
            raise TypeError(
                f"a photograph is asked for by a whole number, got {index!r}. For several use "
                "torch.utils.data.Subset(photos, range(3))."
            ) from None
        if not -count <= index < count:
            raise IndexError(f"photograph {index} of {count}.")
        return index % count

    def _name(self, path: Path) -> str:
        return path.relative_to(self.folder).as_posix()

    def _lacking(self, names: Sequence[str], pictures: Sequence[Path]) -> str:
        shown = ", ".join(names[:_SHOWN]) + (f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else "")
        example = Path(names[0]).with_suffix("")
        rest = (
            ' Use missing="skip" to leave them out, or depth=2.0 to put them at 2 m.'
            if len(names) < len(pictures)
            else " Maps are paired with pictures by name; for pictures without maps give depth=2.0 alone."
        )
        return (
            f"{len(names)} of {len(pictures)} pictures have no depth map in {self.depth_folder}: {shown}. Expected "
            f"{example}.png there (or {', '.join(DEPTH_MAPS[1:])}).{rest}"
        )


def read_depth(path: str | os.PathLike[str], *, scale: float = MILLIMETRES) -> Tensor:
    """A depth map (1,H,W) float32 [m]; NaN where nothing was measured.

    Whole numbers are counts: a PNG of 16 bits, a TIFF, an .npy; floats are metres: a TIFF, an .npy, an EXR's channel Z
    (or Y, V, depth, R, or its only one). Nothing was measured where there is 0, less, NaN, infinity or what stands for
    it: the largest whole number of the type, and floats of 65504 m (the largest of half precision) or more.

    Args:      scale: metres per count; floats are taken as they are.
    Raises:    FileNotFoundError; ValueError with the file's name for one that is damaged, in colours, of other than
               one plane, or of 8 bits, in which no scene fits; ImportError for an EXR whose reader is not installed.

    Example:
    >>> import numpy
    >>> numpy.save("depth.npy", numpy.array([[500, 0], [2000, 65535]], dtype=numpy.uint16))  # millimetres
    >>> data.read_depth("depth.npy")[0]
    tensor([[0.5000,    nan],
            [2.0000,    nan]])
    """
    path = Path(path)
    check_scale(scale)
    if not path.is_file():
        raise FileNotFoundError(f"there is no depth map {path}.")
    if path.suffix.lower() not in DEPTH_MAPS:
        raise ValueError(f"{path} is no depth map: expected {', '.join(DEPTH_MAPS)}.")
    try:
        values = _READERS[path.suffix.lower()](path)
    except ImportError:
        raise
    except Exception as error:  # whatever a damaged file makes a library raise
        words = str(error) if isinstance(error, _NoMap) else words_of(error, "it cannot be read as a depth map")
        raise ValueError(f"{path}: {words}") from error
    planes = values.shape
    values = values[..., 0] if values.ndim == 3 and values.shape[-1] == 1 else values
    values = values[0] if values.ndim == 3 and values.shape[0] == 1 else values
    if values.ndim != 2 or 0 in values.shape or values.dtype.kind not in "fui":
        raise ValueError(f"{path} holds {planes} of {values.dtype}, expected one plane (H,W) of numbers.")
    if values.dtype.kind == "f":
        metres = values.astype(np.float32)
        good = np.isfinite(values) & (values > 0) & (values < _NO_DISTANCE)
    else:
        if values.dtype.itemsize == 1 and scale * 255 < 1:
            raise ValueError(
                f"{path} has 8 bits: at {scale:g} m per count nothing in it is farther than {scale * 255:.3g} m. "
                "Expected 16 bits; if its counts are larger, give depth_scale= in metres, such as 0.05."
            )
        top = 65535 if path.suffix.lower() == ".png" and values.dtype.itemsize > 1 else np.iinfo(values.dtype).max
        metres = (values * scale).astype(np.float32)
        good = (values > 0) & (values < top)
    return torch.from_numpy(np.where(good, metres, np.float32(np.nan)))[None]


def filled(depth: Tensor, *, name: str = "depth") -> Tensor:
    """A depth map (1,H,W) in which what is NaN takes the value of the nearest pixel that is not.

    Raises:    ValueError where all are NaN.
    """
    known = depth[0].isfinite().numpy()
    if not known.any():
        raise ValueError(f"{name} holds no distance: all its pixels are zero, NaN or infinite.")
    if known.all():
        return depth
    rows, columns = scipy.ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return depth[:, torch.from_numpy(rows).long(), torch.from_numpy(columns).long()]


# ---- files -------------------------------------------------------------------------------------------------------


class _NoMap(ValueError):
    """A file that can be read, but is no depth map."""


def _read_png(path: Path) -> np.ndarray:
    with Image.open(path) as file:
        if file.mode != "L" and not file.mode.startswith("I"):
            raise _NoMap(
                f"it is a picture in colours (mode {file.mode}), expected one plane of 16 bits. Is it the photograph, "
                "or a depth map drawn for looking at?"
            )
        return np.asarray(file)


def _read_exr(path: Path) -> np.ndarray:
    try:
        import OpenEXR
    except ImportError as error:
        raise ImportError(f"{path} is OpenEXR, which the extra reads: pip install 'kcam[exr]'.") from error
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    name = next((name for name in _DEPTH_CHANNELS if name in channels), None)
    if name is None and len(channels) == 1:
        name = next(iter(channels))
    if name is None:
        raise _NoMap(f"its channels are {', '.join(channels)}: expected one of {', '.join(_DEPTH_CHANNELS)}.")
    return np.array(channels[name]).astype(np.float32)


_READERS: dict[str, Callable[[Path], np.ndarray]] = {
    ".png": _read_png,
    ".npy": lambda path: np.load(path, allow_pickle=False),
    ".tif": tifffile.imread,
    ".tiff": tifffile.imread,
    ".exr": _read_exr,
}


def _folder(path: str | os.PathLike[str]) -> Path:
    path = Path(path)
    if not path.is_dir():
        what = f"{path} is a file" if path.exists() else f"there is no folder {path}"
        raise FileNotFoundError(f"{what}. Expected a folder of pictures or depth maps.")
    return path


def files_in(
    folder: Path, suffixes: Sequence[str] = PICTURES, *, below: bool = True, but: Path | None = None
) -> list[Path]:
    """Those in a folder, and in the folders below it, in natural order; not what is hidden, nor what lies in `but`.

    Some systems keep a file of notes beside each picture, ._photo.jpg: it is hidden.
    """
    found: list[Path] = []
    entered = set() if but is None else {but.resolve()}

    def enter(place: Path) -> None:
        if place.resolve() in entered:  # a link may lead back
            return
        entered.add(place.resolve())
        for child in sorted(place.iterdir()):
            if child.name.startswith(".") or child.name == "__MACOSX":
                continue
            if child.is_dir():
                if below:
                    enter(child)
            elif child.suffix.lower() in suffixes and child.is_file():
                found.append(child)

    enter(folder)
    return sorted(found, key=lambda path: _natural(path.relative_to(folder).as_posix()))


def _natural(name: str) -> tuple[list[Any], str]:
    """A key by which 2 comes before 10."""
    parts = re.split(r"(\d+)", name)
    return [int(part) if index % 2 else part.casefold() for index, part in enumerate(parts)], name


def _maps(folder: Path, pictures: Sequence[Path], depth_folder: Path) -> list[Path | None]:
    """The depth map of each picture, None where there is none. Raises: ValueError for two."""
    by_place, by_stem = defaultdict(list), defaultdict(list)
    for path in files_in(depth_folder, DEPTH_MAPS, but=folder):
        by_place[path.relative_to(depth_folder).with_suffix("")].append(path)
        by_stem[path.stem].append(path)
    stems = Counter({path.relative_to(folder).with_suffix("") for path in pictures})
    alone = Counter(place.name for place in stems)
    found: list[Path | None] = []
    for picture in pictures:
        own = by_place.get(picture.relative_to(folder).with_suffix(""))
        if own is None and alone[picture.stem] == 1:
            own = by_stem.get(picture.stem)
        if own is not None and len(own) > 1:
            names = " and ".join(path.relative_to(depth_folder).as_posix() for path in own[:2])
            raise ValueError(f"{picture.name} has two depth maps in {depth_folder}: {names}. Keep one of them.")
        found.append(own[0] if own else None)
    return found


# ---- what goes in by mistake -------------------------------------------------------------------------------------


def check_scale(scale: Any) -> float:
    """Metres per count. Raises: TypeError, ValueError, for counts per metre too."""
    value = float(as_numbers(scale, name="depth_scale", expected="a number of metres per count such as 1e-3"))
    if not 0 < value <= 1:
        fix = f" Are these counts per metre? Use depth_scale=1/{value:g}." if 1 < value < math.inf else ""
        raise ValueError(f"depth_scale {value:g} is outside 0..1 m per count, such as 1e-3 for millimetres.{fix}")
    return value


def _one_distance(depth: Any) -> float:
    values = check_distances(depth, name="depth")
    if values.numel() != 1:
        raise TypeError(f"depth must be one number of metres for all that have no map, got {values.numel()} of them.")
    return float(values)


def _window(crop: Any) -> tuple[int, int]:
    match crop:
        case bool():
            pass
        case int() if crop >= 1:
            return crop, crop
        case (int(height), int(width)) if height >= 1 and width >= 1:
            return height, width
    raise ValueError(f"crop must be a number of pixels >= 1, or (height, width), got {crop!r}.")


def _check_proportions(depth: Tensor, shape: tuple[int, int], map_path: Path, path: Path) -> None:
    """ValueError unless a map fits a picture to one of the map's own pixels."""
    own = (depth.shape[1], depth.shape[2])
    if _fits(own, shape):
        return
    turned = _fits(own, shape[::-1])
    fix = (
        "It lies on its side: a picture is turned as its EXIF orientation says, and its map must be so too."
        if turned
        else "Cut both to the same part of the scene."
    )
    raise ValueError(
        f"{map_path} has {own[0]} x {own[1]} pixels, and {path.name} {shape[0]} x {shape[1]}: their proportions "
        f"differ. {fix}"
    )


def _fits(own: tuple[int, int], shape: tuple[int, int]) -> bool:
    (height, width), (rows, columns) = own, shape
    return abs(height - rows * width / columns) <= 1 or abs(width - columns * height / rows) <= 1
