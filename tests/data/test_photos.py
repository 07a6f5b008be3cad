"""PhotoDataset and Scene.from_folder: pictures with the distances of their pixels, whatever files they come in."""

from __future__ import annotations

import pickle
import warnings
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from draws import Draw
from PIL import Image
from scipy.spatial import cKDTree
from torch.utils.data import DataLoader

from kcam import Camera, Scene
from kcam.data import Photo, PhotoDataset, read_depth
from kcam.scene import read_picture

inf, nan = float("inf"), float("nan")


def save_picture(
    path: Path, height: int = 12, width: int = 16, *, seed: int = 0, mode: str = "RGB", turn: int = 1
) -> None:
    """A picture of noise of any mode; `turn`: its EXIF orientation."""
    path.parent.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(seed)
    channels = {"L": 1, "RGB": 3, "RGBA": 4, "I;16": 1}[mode]
    values = random.integers(0, 65536 if mode == "I;16" else 256, (height, width, channels))
    values = values.astype(np.uint16 if mode == "I;16" else np.uint8)
    image = Image.fromarray(values[..., 0] if channels == 1 else values)
    exif = Image.Exif()
    exif[0x0112] = turn
    image.save(path, **({"exif": exif} if turn != 1 else {}))


def save_depth(path: Path, metres: np.ndarray, *, scale: float = 1e-3) -> None:
    """Metres, 0 for what was not measured, in the format that the suffix names."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".png":
        Image.fromarray((metres / scale).round().astype(np.uint16)).save(path)
    elif path.suffix == ".npy":
        np.save(path, metres.astype(np.float32))
    elif path.suffix == ".exr":
        OpenEXR = pytest.importorskip("OpenEXR")
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {"Z": np.ascontiguousarray(metres, np.float32)}) as file:
            file.write(str(path))
    else:
        tifffile.imwrite(path, metres.astype(np.float32))


def wall(height: int = 12, width: int = 16, *, metres: float = 2.0) -> np.ndarray:
    return np.full((height, width), metres)


def make(folder: Path, names: list[str], *, suffix: str = ".png") -> tuple[Path, Path]:
    """Pictures, each before a wall at as many metres as its number says, from 1."""
    for index, name in enumerate(names, start=1):
        save_picture(folder / "rgb" / name, seed=index)
        save_depth((folder / "depth" / name).with_suffix(suffix), wall(metres=index))
    return folder / "rgb", folder / "depth"


# ---- which files -------------------------------------------------------------------------------------------------


def test_pictures_are_found_everywhere_in_natural_order(tmp_path: Path) -> None:
    names = ["2.png", "10.jpg", "a/1.webp", "a/b/3.tif", "B/9.JPEG", "b/10.bmp"]
    rgb, depth = make(tmp_path, names)
    for hidden in (".DS_Store", "._2.png", ".cache/7.png", "__MACOSX/7.png", "notes.txt"):
        (rgb / hidden).parent.mkdir(exist_ok=True)
        (rgb / hidden).write_bytes(b"no picture")
    photos = PhotoDataset(rgb, depth)
    assert photos.names == names
    assert [photo.name for photo in photos] == names
    assert [round(float(photo.depth.mean())) for photo in photos] == [1, 2, 3, 4, 5, 6]
    assert len(photos) == 6
    assert photos[-1].name == names[-1]


def test_an_item_is_a_picture_with_depth_and_mask(tmp_path: Path) -> None:
    photos = PhotoDataset(*make(tmp_path, ["1.png"]))
    item = photos[0]
    assert isinstance(item, Photo)
    assert [(part.shape, part.dtype) for part in item[:3]] == [
        ((3, 12, 16), torch.float32),
        ((1, 12, 16), torch.float32),
        ((1, 12, 16), torch.bool),
    ]
    torch.testing.assert_close(item.image, read_picture(tmp_path / "rgb/1.png"), rtol=0, atol=0)
    assert item.mask.all()


def test_maps_may_lie_in_one_folder_or_inside_that_of_the_pictures(tmp_path: Path) -> None:
    save_picture(tmp_path / "kitchen/1.png")
    save_picture(tmp_path / "hall/2.png")
    for name in ("1", "2"):
        save_depth(tmp_path / "depth" / f"{name}.png", wall(metres=float(name)))
    photos = PhotoDataset(tmp_path, tmp_path / "depth")
    assert photos.names == ["hall/2.png", "kitchen/1.png"]  # the maps are no pictures
    assert [float(photo.depth.max()) for photo in photos] == [2.0, 1.0]


def test_a_name_that_several_folders_have_is_not_guessed(tmp_path: Path) -> None:
    save_picture(tmp_path / "rgb/kitchen/1.png")
    save_picture(tmp_path / "rgb/hall/1.png")
    save_depth(tmp_path / "depth/1.png", wall())
    with pytest.raises(
        FileNotFoundError, match=r"2 of 2 pictures have no depth map in .*: hall/1.png, kitchen/1.png\."
    ):
        PhotoDataset(tmp_path / "rgb", tmp_path / "depth")


def test_links_that_lead_back_are_followed_once(tmp_path: Path) -> None:
    rgb, depth = make(tmp_path, ["a/1.png", "2.png"])
    (rgb / "a/back").symlink_to(rgb)
    assert PhotoDataset(rgb, depth).names == ["2.png", "a/1.png"]


def test_missing_maps_are_named_or_skipped(tmp_path: Path) -> None:
    rgb, depth = make(tmp_path, [f"{n}.png" for n in range(8)])
    for n in (1, 3, 4, 6):
        (depth / f"{n}.png").unlink()
    expected = (
        r"4 of 8 pictures have no depth map in .*depth: 1.png, 3.png, 4.png and 1 more. Expected 1.png there "
        r'\(or .npy, .tif, .tiff, .exr\). Use missing="skip" to leave them out, or depth=2.0'
    )
    with pytest.raises(FileNotFoundError, match=expected):
        PhotoDataset(rgb, depth)
    photos = PhotoDataset(rgb, depth, missing="skip")
    assert photos.skipped == ["1.png", "3.png", "4.png", "6.png"]
    assert photos.names == ["0.png", "2.png", "5.png", "7.png"]
    assert [photos[i].depth.max().item() for i in range(4)] == [1.0, 3.0, 6.0, 8.0]
    whole = PhotoDataset(rgb, depth, depth=7.5)
    assert [photo.depth.max().item() for photo in whole] == [1.0, 7.5, 3.0, 7.5, 7.5, 6.0, 7.5, 8.0]
    assert [bool(photo.mask.all()) for photo in whole] == [True, False, True, False, False, True, False, True]
    assert not whole[1].mask.any()


def test_folders_that_cannot_be_right(tmp_path: Path) -> None:
    rgb, depth = make(tmp_path, ["1.png"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match="there is no folder .*nowhere"):
        PhotoDataset(tmp_path / "nowhere", depth)
    with pytest.raises(FileNotFoundError, match="1.png is a file. Expected a folder"):
        PhotoDataset(rgb, depth / "1.png")
    with pytest.raises(ValueError, match=r"no picture in the folder .*empty: expected .png, .jpg"):
        PhotoDataset(tmp_path / "empty", depth)
    with pytest.raises(FileNotFoundError, match=r"1 of 1 pictures have no depth map .* paired with pictures by name"):
        PhotoDataset(rgb, tmp_path / "empty", missing="skip")
    with pytest.raises(ValueError, match="depth_folder is the folder of the pictures"):
        PhotoDataset(rgb, rgb)
    save_depth(depth / "1.npy", wall())
    with pytest.raises(ValueError, match=r"1.png has two depth maps in .*: 1.npy and 1.png. Keep one of them"):
        PhotoDataset(rgb, depth)


def test_arguments_that_cannot_be_right(tmp_path: Path) -> None:
    rgb, depth = make(tmp_path, ["1.png"])
    with pytest.raises(ValueError, match="photographs need distances: depth_folder=, of their maps, or depth=2.0"):
        PhotoDataset(rgb)
    with pytest.raises(ValueError, match=r"outside 0..1 m per count, .* Use depth_scale=1/5000\."):
        PhotoDataset(rgb, depth, depth_scale=5000)
    with pytest.raises(ValueError, match="depth_scale 0 is outside"):
        PhotoDataset(rgb, depth, depth_scale=0)
    with pytest.raises(TypeError, match="depth_scale must be a number of metres per count"):
        PhotoDataset(rgb, depth, depth_scale="mm")
    with pytest.raises(ValueError, match="depth 0 is not a distance"):
        PhotoDataset(rgb, depth=0)
    with pytest.raises(TypeError, match="depth must be one number of metres .* got 2"):
        PhotoDataset(rgb, depth=[1.0, 2.0])
    with pytest.raises(ValueError, match='missing must be "error" or "skip", got True'):
        PhotoDataset(rgb, depth, missing=True)
    with pytest.raises(ValueError, match=r'which missing="skip" leaves out. Give one of them'):
        PhotoDataset(rgb, depth, missing="skip", depth=2.0)
    for crop in (0, (4,), 2.5, True):
        with pytest.raises(ValueError, match="crop must be a number of pixels >= 1"):
            PhotoDataset(rgb, depth, crop=crop)
    with pytest.raises(ValueError, match="size must be a number of pixels >= 1"):
        PhotoDataset(rgb, depth, size=0)
    photos = PhotoDataset(rgb, depth)
    with pytest.raises(IndexError, match="photograph 1 of 1"):
        photos[1]
    with pytest.raises(
        TypeError, match=r"got slice.*Use torch.utils.data.Subset|For several use torch.utils.data.Subset"
    ):
        photos[:1]


# ---- depth -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".png", ".npy", ".tif", ".tiff", ".exr"])
@pytest.mark.parametrize("seed", range(3))
def test_every_format_gives_the_same_metres(suffix: str, seed: int, tmp_path: Path) -> None:
    random = np.random.default_rng(seed)
    metres = random.uniform(0.3, 60, random.integers(1, 40, 2)).round(3)
    metres[random.random(metres.shape) < 0.2] = 0
    path = tmp_path / f"map{suffix}"
    save_depth(path, metres)
    found = read_depth(path)
    assert found.shape == (1, *metres.shape)
    assert found.dtype == torch.float32
    expected = torch.tensor(np.where(metres > 0, metres, nan), dtype=torch.float32)[None]
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=0, equal_nan=True)


def test_counts_of_another_scale(tmp_path: Path) -> None:
    save_depth(tmp_path / "tum.png", wall(metres=3.2), scale=1 / 5000)
    assert read_depth(tmp_path / "tum.png", scale=1 / 5000).unique().item() == pytest.approx(3.2)
    np.save(tmp_path / "counts.npy", np.full((4, 5), 1500, np.int32))
    assert read_depth(tmp_path / "counts.npy").unique().item() == pytest.approx(1.5)
    tifffile.imwrite(tmp_path / "counts.tif", np.full((4, 5), 1500, np.uint16))
    assert read_depth(tmp_path / "counts.tif").unique().item() == pytest.approx(1.5)
    np.save(tmp_path / "bytes.npy", np.full((4, 5), 100, np.uint8))
    assert read_depth(tmp_path / "bytes.npy", scale=0.05).unique().item() == pytest.approx(5)


@pytest.mark.parametrize("code", [0.0, -1.0, nan, inf, -inf, 65504.0, 1e10])
def test_what_was_not_measured_is_nan(code: float, tmp_path: Path) -> None:
    metres = wall(4, 5)
    metres[1, 2:4] = code
    np.save(tmp_path / "map.npy", metres)
    unknown = read_depth(tmp_path / "map.npy").isnan()[0]
    assert unknown.nonzero().tolist() == [[1, 2], [1, 3]]


@pytest.mark.parametrize("name", ["map.png", "map.npy", "map.tif"])
def test_the_largest_count_is_no_distance(name: str, tmp_path: Path) -> None:
    counts = np.full((4, 5), 2000, np.uint16)
    counts[0, 0] = 65535
    {".png": lambda p, v: Image.fromarray(v).save(p), ".npy": np.save, ".tif": tifffile.imwrite}[Path(name).suffix](
        tmp_path / name, counts
    )
    assert read_depth(tmp_path / name).isnan().nonzero().tolist() == [[0, 0, 0]]


@pytest.mark.parametrize("seed", range(6))
def test_holes_take_the_nearest_distance_that_was_measured(seed: int, tmp_path: Path) -> None:
    draw = Draw(seed)
    height, width = int(draw.number(2, 50)), int(draw.number(2, 50))
    metres = (1 + 5 * draw.noise(height, width)).numpy().round(3)
    holes = (draw.noise(height, width) < draw.number(0.05, 0.98)).numpy()
    holes[int(draw.number(0, height)), int(draw.number(0, width))] = False
    metres[holes] = 0
    save_picture(tmp_path / "rgb/1.png", height, width)
    save_depth(tmp_path / "depth/1.png", metres)
    photo = PhotoDataset(tmp_path / "rgb", tmp_path / "depth")[0]
    np.testing.assert_array_equal(photo.mask[0], ~holes)
    np.testing.assert_allclose(photo.depth[0][photo.mask[0]], metres[~holes], rtol=1e-6)
    known = np.argwhere(~holes)
    away, _ = cKDTree(known).query(np.argwhere(holes))
    for place, distance in zip(np.argwhere(holes), away, strict=True):
        nearest = known[np.abs(np.linalg.norm(known - place, axis=1) - distance) < 1e-9]
        assert np.isclose(metres[tuple(nearest.T)], photo.depth[0][tuple(place)], rtol=1e-6).any()


def test_maps_that_cannot_be_right(tmp_path: Path) -> None:
    np.save(tmp_path / "none.npy", np.zeros((12, 16)))
    np.save(tmp_path / "cube.npy", np.ones((3, 4, 5)))
    np.save(tmp_path / "words.npy", np.array([["a"]]))
    save_picture(tmp_path / "colours.png")
    save_picture(tmp_path / "bytes.png", mode="L")
    (tmp_path / "damaged.png").write_bytes((tmp_path / "bytes.png").read_bytes()[:60])
    (tmp_path / "damaged.exr").write_bytes(b"no exr")
    (tmp_path / "map.jpg").write_bytes(b"")
    with pytest.raises(ValueError, match=r"cube.npy holds \(3, 4, 5\) of float64, expected one plane"):
        read_depth(tmp_path / "cube.npy")
    with pytest.raises(ValueError, match=r"words.npy holds \(1, 1\) of <U1, expected one plane"):
        read_depth(tmp_path / "words.npy")
    with pytest.raises(ValueError, match=r"colours.png: it is a picture in colours \(mode RGB\), expected one plane"):
        read_depth(tmp_path / "colours.png")
    with pytest.raises(ValueError, match=r"bytes.png has 8 bits: at 0.001 m per count nothing .* than 0.255 m"):
        read_depth(tmp_path / "bytes.png")
    for name in ("damaged.png", "damaged.exr"):
        with pytest.raises(ValueError, match=f"{name}: it cannot be read as a depth map"):
            read_depth(tmp_path / name)
    with pytest.raises(ValueError, match=r"map.jpg is no depth map: expected .png, .npy"):
        read_depth(tmp_path / "map.jpg")
    with pytest.raises(FileNotFoundError, match="there is no depth map .*nothing.png"):
        read_depth(tmp_path / "nothing.png")
    save_picture(tmp_path / "rgb/none.png")
    photos = PhotoDataset(tmp_path / "rgb", tmp_path)
    with pytest.raises(ValueError, match=r"none.npy holds no distance: all its pixels are zero, NaN or infinite"):
        photos[0]


def test_an_exr_without_depth_names_its_channels(tmp_path: Path) -> None:
    OpenEXR = pytest.importorskip("OpenEXR")
    planes = {name: np.ones((4, 5), np.float32) for name in ("G", "B")}
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, planes) as file:
        file.write(str(tmp_path / "colours.exr"))
    with pytest.raises(ValueError, match=r"colours.exr: its channels are B, G: expected one of Z"):
        read_depth(tmp_path / "colours.exr")


# ---- sizes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(12))
def test_pictures_of_any_mode_and_orientation(seed: int, tmp_path: Path) -> None:
    """The map is upright as the picture is, and has any size of its proportions."""
    draw = Draw(seed)
    height, width = int(draw.number(3, 60)), int(draw.number(3, 60))
    mode, turn = draw.one_of("L", "RGB", "RGBA", "I;16"), int(draw.number(1, 9))
    suffix = ".png" if mode in ("RGBA", "I;16") else draw.one_of(".png", ".jpg", ".tif", ".webp")
    save_picture(tmp_path / f"rgb/1{suffix}", height, width, seed=seed, mode=mode, turn=turn)
    upright = (width, height) if turn >= 5 else (height, width)
    times = draw.one_of(1, 2, 3)
    metres = np.random.default_rng(seed).uniform(1, 9, upright).round(3)
    save_depth(tmp_path / "depth/1.png", metres.repeat(times, 0).repeat(times, 1))
    photo = PhotoDataset(tmp_path / "rgb", tmp_path / "depth")[0]
    assert photo.image.shape == (3, *upright)
    assert 0 <= photo.image.min() <= photo.image.max() <= 1
    np.testing.assert_allclose(photo.depth[0], metres, rtol=1e-6)
    if mode in ("L", "I;16"):
        assert (photo.image == photo.image[:1]).all()
    scene = PhotoDataset(tmp_path / "rgb", tmp_path / "depth").scene(0)
    torch.testing.assert_close(scene.to_srgb()[0], photo.image, rtol=0, atol=1e-5)


@pytest.mark.parametrize(("own", "fits"), [((6, 8), True), ((24, 32), True), ((5, 7), True), ((12, 12), False)])
def test_a_map_of_another_size(own: tuple[int, int], fits: bool, tmp_path: Path) -> None:
    save_picture(tmp_path / "rgb/1.png", 12, 16)
    save_depth(tmp_path / "depth/1.png", np.arange(1, own[0] * own[1] + 1).reshape(own) * 0.05)
    photos = PhotoDataset(tmp_path / "rgb", tmp_path / "depth")
    if not fits:
        with pytest.raises(ValueError, match=r"depth/1.png has 12 x 12 pixels, and 1.png 12 x 16: their proportions"):
            photos[0]
        return
    photo = photos[0]
    rows, columns = (((np.arange(n) + 0.5) * m / n).astype(int) for n, m in ((12, own[0]), (16, own[1])))
    expected = (np.arange(1, own[0] * own[1] + 1).reshape(own) * 0.05)[rows][:, columns]
    np.testing.assert_allclose(photo.depth[0], expected, rtol=1e-6)  # picked, not mixed


def test_a_map_that_lies_on_its_side(tmp_path: Path) -> None:
    save_picture(tmp_path / "rgb/1.jpg", 12, 16, turn=6)
    save_depth(tmp_path / "depth/1.png", wall(12, 16))
    with pytest.raises(ValueError, match="It lies on its side: a picture is turned as its EXIF orientation says"):
        PhotoDataset(tmp_path / "rgb", tmp_path / "depth")[0]


def test_resized_as_a_scene_is(tmp_path: Path) -> None:
    save_picture(tmp_path / "rgb/1.png", 30, 40)
    metres = np.random.default_rng(0).uniform(1, 9, (30, 40)).round(3)
    metres[:4] = 0
    save_depth(tmp_path / "depth/1.png", metres)
    folders = tmp_path / "rgb", tmp_path / "depth"
    for size in (20, (10, 10), (30, 40), 80):
        small, whole = PhotoDataset(*folders, size=size).scene(0), PhotoDataset(*folders).scene(0)
        torch.testing.assert_close(small.to_srgb(), whole.resized(size).to_srgb(), rtol=0, atol=2e-6)
        torch.testing.assert_close(small.depth, whole.resized(size).depth)
    photo = PhotoDataset(*folders, size=20)[0]
    assert photo.image.shape == (3, 15, 20)
    assert not photo.mask[0, :2].any()
    assert photo.mask[0, 2:].all()


def test_windows_at_random(tmp_path: Path) -> None:
    save_picture(tmp_path / "rgb/1.png", 30, 40)
    save_picture(tmp_path / "rgb/2.png", 30, 40)
    place = np.arange(1, 30 * 40 + 1).reshape(30, 40)
    for name in ("1", "2"):
        save_depth(tmp_path / f"depth/{name}.png", place * 1e-3)
    folders = tmp_path / "rgb", tmp_path / "depth"
    whole = PhotoDataset(*folders)[0]

    def corner(photo: Photo) -> tuple[int, int]:
        return divmod(round(float(photo.depth[0, 0, 0]) * 1000) - 1, 40)

    seeded = PhotoDataset(*folders, crop=(8, 10), seed=4)
    top, left = corner(seeded[0])
    assert seeded[0].image.shape == (3, 8, 10)
    torch.testing.assert_close(seeded[0].image, whole.image[:, top : top + 8, left : left + 10])
    assert corner(seeded[0]) == corner(PhotoDataset(*folders, crop=(8, 10), seed=4)[0])
    assert corner(seeded[0]) != corner(seeded[1])
    assert corner(seeded[0]) != corner(PhotoDataset(*folders, crop=(8, 10), seed=5)[0])
    free = PhotoDataset(*folders, crop=8)
    torch.manual_seed(0)
    found = {corner(free[0]) for _ in range(300)}
    assert len(found) > 200
    assert {min(y for y, _ in found), max(y for y, _ in found)} == {0, 22}
    assert {min(x for _, x in found), max(x for _, x in found)} == {0, 32}
    assert PhotoDataset(*folders, crop=(30, 40))[0].image.shape == (3, 30, 40)
    with pytest.raises(ValueError, match=r"1.png has 15 x 20 pixels, fewer than crop=\(16, 16\). Give size= that is"):
        PhotoDataset(*folders, size=20, crop=16)[0]


# ---- in training -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("workers", [0, 2])
def test_a_loader_makes_batches(workers: int, tmp_path: Path) -> None:
    photos = PhotoDataset(*make(tmp_path, [f"{n}.png" for n in range(5)]), crop=8, seed=0)
    photos = pickle.loads(pickle.dumps(photos))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*fork.*", category=DeprecationWarning)
        batches = list(DataLoader(photos, batch_size=2, num_workers=workers))
    assert [batch.image.shape[0] for batch in batches] == [2, 2, 1]
    assert batches[0].image.shape == (2, 3, 8, 8)
    assert batches[0].mask.dtype == torch.bool
    assert [name for batch in batches for name in batch.name] == photos.names
    for index, image in enumerate(torch.cat([batch.image for batch in batches])):
        torch.testing.assert_close(image, photos[index].image)
    scene = Scene.from_rgb(batches[0].image, depth=batches[0].depth)
    assert scene.shape == (2, 8, 8)


def test_one_distance_stays_a_number(tmp_path: Path) -> None:
    """A map of one distance would be rendered in layers."""
    rgb, _ = make(tmp_path, ["1.png"])
    assert PhotoDataset(rgb, depth=3.0).scene(0).depth == 3.0
    assert PhotoDataset(rgb, depth=inf).scene(0).depth == inf
    assert PhotoDataset(rgb, depth=inf)[0].depth.unique().item() == inf


def test_a_damaged_picture_is_named(tmp_path: Path) -> None:
    rgb, depth = make(tmp_path, ["1.png"])
    (rgb / "1.png").write_bytes((rgb / "1.png").read_bytes()[:80])
    with pytest.raises(ValueError, match=r"cannot read .*1.png as a picture"):
        PhotoDataset(rgb, depth)[0]


# ---- Scene.from_folder -------------------------------------------------------------------------------------------


def test_a_folder_is_a_batch(tmp_path: Path) -> None:
    rgb, depth = make(tmp_path, ["2.png", "10.png", "1.jpg"])
    scene = Scene.from_folder(rgb, depth, luminance=300.0, illuminant="A")
    assert scene.shape == (3, 12, 16)
    assert scene.luminance == 300.0
    assert scene.depth.amax((1, 2, 3)).tolist() == [3.0, 1.0, 2.0]
    one = PhotoDataset(rgb, depth).scene(1, luminance=300.0, illuminant="A")
    torch.testing.assert_close(scene.samples([1]).bands(), one.bands())
    assert Camera.ideal()(scene).shape == (3, 3, 12, 16)


def test_a_folder_without_maps(tmp_path: Path) -> None:
    rgb, depth = make(tmp_path, ["1.png", "2.png"])
    assert Scene.from_folder(rgb).depth == 2.0
    assert Scene.from_folder(str(rgb), depth=inf).depth == inf
    assert Scene.from_folder(rgb, size=8).shape == (2, 6, 8)
    (depth / "2.png").unlink()
    assert Scene.from_folder(rgb, depth, depth=5.0).depth.amax((1, 2, 3)).tolist() == [1.0, 5.0]
    with pytest.raises(FileNotFoundError, match="1 of 2 pictures have no depth map"):
        Scene.from_folder(rgb, depth)


def test_pictures_of_several_sizes_are_no_batch(tmp_path: Path) -> None:
    rgb, _ = make(tmp_path, ["1.png"])
    save_picture(rgb / "2.png", 10, 20)
    expected = r"1.png has 12 x 16 pixels, 2.png 10 x 20. Crop them to one, size=\(10, 16\), or take them one by one"
    with pytest.raises(ValueError, match=expected):
        Scene.from_folder(rgb)
    assert Scene.from_folder(rgb, size=(10, 16)).shape == (2, 10, 16)


def test_millimetres_in_floats_are_warned_of(tmp_path: Path) -> None:
    save_picture(tmp_path / "rgb/1.png")
    save_depth(tmp_path / "depth/1.npy", wall(metres=1500))
    with pytest.warns(UserWarning, match=r"did you mean 1500 \* mm"):
        Scene.from_folder(tmp_path / "rgb", tmp_path / "depth")
