"""`kcam shoot`: of one photo and of many, all or nothing of what can be known beforehand, in bounded memory."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import resident
from commands import fails, run
from PIL import Image
from stages import painting_stage

from kcam import Camera, plots, sensor
from kcam import shoot as module
from kcam.isp import style_stage
from kcam.optics.rendering import ways
from kcam.style import style_camera

WIDTH, HEIGHT = 56, 40


def make_photo(path: Path, seed: int = 0, *, width: int = WIDTH, height: int = HEIGHT) -> Path:
    """Soft shapes in colour."""
    coarse = np.random.default_rng(seed).integers(0, 256, (4, 5, 3)).astype(np.uint8)
    Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC).save(path)
    return path


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture).astype(int)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three photographs, and what is none."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for seed, name in enumerate(("a.jpg", "b.PNG", "c.tif")):
        make_photo(folder / name, seed)
    (folder / "notes.txt").write_text("no picture")
    return folder


@pytest.fixture(scope="module")
def styled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A camera whose stage paints."""
    path = tmp_path_factory.mktemp("camera") / "styled.safetensors"
    Camera(*style_camera(stage=False), painting_stage(width=4, dilations=(1, 2))).save(path)
    return path


# ---- what becomes of what -------------------------------------------------------------------------------------------


def test_one_photo_becomes_the_file(tmp_path: Path, styled: Path) -> None:
    photo = make_photo(tmp_path / "photo.jpg")
    out = tmp_path / "shot.jpg"
    assert run("shoot", photo, "--camera", styled, "--out", out).splitlines()[0] == str(out)
    with Image.open(out) as picture:
        assert (picture.size, picture.format) == ((WIDTH, HEIGHT), "JPEG")


@pytest.mark.parametrize("there", [True, False])
def test_one_photo_into_a_folder(tmp_path: Path, there: bool) -> None:
    photo, shots = make_photo(tmp_path / "photo.jpg"), tmp_path / "shots"
    if there:
        shots.mkdir()
    run("shoot", photo, "--camera", "ideal", "--out", shots)
    assert [path.name for path in shots.iterdir()] == ["photo.png"]


def test_several_photos_become_a_folder(folder: Path, tmp_path: Path) -> None:
    shots = tmp_path / "shots"
    some = [folder / "a.jpg", folder / "c.tif"]
    printed = run("shoot", *some, "--camera", "ideal", "--out", shots).splitlines()[::2]
    assert printed == [str(shots / "a.png"), str(shots / "c.png")]
    assert sorted(path.name for path in shots.iterdir()) == ["a.png", "c.png"]
    assert pixels(shots / "a.png").shape == (HEIGHT, WIDTH, 3)


def test_a_folder_is_the_pictures_in_it(folder: Path, tmp_path: Path) -> None:
    """In the order of their names; hidden files, folders and what is no picture are left out."""
    make_photo(folder / ".hidden.png")
    (folder / "folder.png").mkdir()
    shots = tmp_path / "shots"
    run("shoot", folder, "--camera", "ideal", "--out", shots)
    assert sorted(path.name for path in shots.iterdir()) == ["a.png", "b.png", "c.png"]
    extra = make_photo(tmp_path / "d.png")
    run("shoot", folder, extra, "--camera", "ideal", "--out", shots)
    assert sorted(path.name for path in shots.iterdir()) == ["a.png", "b.png", "c.png", "d.png"]


def test_a_picture_of_many_is_that_of_one(folder: Path, tmp_path: Path, styled: Path) -> None:
    run("shoot", folder, "--camera", styled, "--out", tmp_path / "shots", "--seed", 4)
    run("shoot", folder / "c.tif", "--camera", styled, "--out", tmp_path / "alone.png", "--seed", 4)
    assert (tmp_path / "alone.png").read_bytes() == (tmp_path / "shots" / "c.png").read_bytes()


def test_the_seed_decides_the_strokes(tmp_path: Path, styled: Path) -> None:
    photo = make_photo(tmp_path / "photo.png")
    one, same, other = (tmp_path / f"{name}.png" for name in ("one", "same", "other"))
    for out, seed in ((one, 3), (same, 3), (other, 4)):
        run("shoot", photo, "--camera", styled, "--out", out, "--seed", seed)
    assert one.read_bytes() == same.read_bytes()
    assert one.read_bytes() != other.read_bytes()


def test_the_size_is_that_of_the_longer_side(tmp_path: Path, styled: Path) -> None:
    photo = make_photo(tmp_path / "photo.png")
    small = tmp_path / "small.png"
    run("shoot", photo, "--camera", styled, "--out", small, "--size", 28)
    assert pixels(small).shape == (20, 28, 3)
    whole, same = tmp_path / "whole.png", tmp_path / "same.png"
    run("shoot", photo, "--camera", styled, "--out", whole)
    run("shoot", photo, "--camera", styled, "--out", same, "--size", WIDTH)
    assert whole.read_bytes() == same.read_bytes()
    line = fails("shoot", photo, "--camera", styled, "--out", tmp_path / "x.png", "--size", 100)
    assert "photo.png has 56 pixels on its longer side, and --size asks for 100" in line
    assert not (tmp_path / "x.png").exists()


def test_a_photo_without_colour(tmp_path: Path, styled: Path) -> None:
    photo = tmp_path / "gray.png"
    Image.fromarray(np.linspace(0, 255, 30 * 41).astype(np.uint8).reshape(30, 41)).save(photo)
    run("shoot", photo, "--camera", styled, "--out", tmp_path / "shot.png")
    assert pixels(tmp_path / "shot.png").shape == (30, 41, 3)


# ---- what cannot be, said before anything is taken ------------------------------------------------------------------


@pytest.fixture
def never(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing may be taken."""

    def taken(*arguments: object, **options: object) -> None:
        raise AssertionError("a picture was taken")

    monkeypatch.setattr(module, "shoot", taken)


@pytest.mark.usefixtures("never")
def test_two_photos_of_one_name(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    make_photo(other / "b.jpg")
    line = fails("shoot", folder, other / "b.jpg", "--out", tmp_path / "shots")
    assert "two of the photos would both become b.png" in line
    assert not (tmp_path / "shots").exists()


@pytest.mark.usefixtures("never")
def test_the_same_photo_twice(folder: Path, tmp_path: Path) -> None:
    line = fails("shoot", folder / "a.jpg", folder / "a.jpg", "--out", tmp_path / "shots")
    assert "would both become a.png" in line


@pytest.mark.usefixtures("never")
@pytest.mark.parametrize("inside", [(), ("notes.txt",), (".hidden.png",)])
def test_a_folder_without_pictures(inside: tuple[str, ...], tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    for name in inside:
        (empty / name).write_bytes(b"")
    line = fails("shoot", empty, "--out", tmp_path / "shots")
    assert f"there is no picture in the folder {empty}: expected .png, .jpg" in line


@pytest.mark.usefixtures("never")
def test_out_is_the_photo(folder: Path, tmp_path: Path) -> None:
    before = (folder / "b.PNG").read_bytes()
    assert "b.PNG is what is read" in fails("shoot", folder / "b.PNG", "--out", folder / "b.PNG")
    photo = make_photo(tmp_path / "photo.png")
    assert "is what is read, and would be lost" in fails("shoot", photo, "--out", tmp_path)
    assert "is what is read" in fails("shoot", photo, folder / "a.jpg", "--out", tmp_path)
    (tmp_path / "link.png").symlink_to(photo)
    assert "is what is read" in fails("shoot", photo, "--out", tmp_path / "link.png")
    assert (folder / "b.PNG").read_bytes() == before


@pytest.mark.usefixtures("never")
def test_several_photos_do_not_fit_into_one_file(folder: Path, tmp_path: Path) -> None:
    some = [folder / "a.jpg", folder / "b.PNG"]
    assert "2 photos do not fit into the one file" in fails("shoot", *some, "--out", tmp_path / "shot.png")
    assert "3 photos do not fit into the one file shot.png. Name a folder" in fails("shoot", folder)
    (tmp_path / "shots").write_text("a file")
    assert "is a file, and 2 photos need a folder" in fails("shoot", *some, "--out", tmp_path / "shots")
    assert (tmp_path / "shots").read_text() == "a file"


@pytest.mark.usefixtures("never")
def test_names_that_cannot_be_written(folder: Path, tmp_path: Path) -> None:
    photo = folder / "a.jpg"
    assert "must end in one of" in fails("shoot", photo, "--out", tmp_path / "shot.xyz")
    assert "there is no folder" in fails("shoot", photo, "--out", tmp_path / "no" / "shot.png")
    assert "there is no folder" in fails("shoot", folder, "--out", tmp_path / "no" / "shots")
    shots = tmp_path / "shots"
    (shots / "b.png").mkdir(parents=True)
    assert "cannot write b.png: there is a folder of that name" in fails("shoot", folder, "--out", shots)
    assert [path.name for path in shots.iterdir()] == ["b.png"]


@pytest.mark.usefixtures("never")
def test_a_photo_that_is_not_there(folder: Path, tmp_path: Path) -> None:
    """Also where it is the last of many."""
    line = fails("shoot", folder, tmp_path / "nothing.jpg", "--out", tmp_path / "shots")
    assert f"there is no file {tmp_path / 'nothing.jpg'}" in line


def test_many_photos_are_sorted_out_in_no_time(tmp_path: Path) -> None:
    """2000 of them: a search for equal names that compares each with each would take 2 million comparisons."""
    photos = [tmp_path / f"{index}.png" for index in range(2000)]
    for photo in photos:
        photo.write_bytes(b"")
    compared = 0

    class Counted(type(tmp_path)):
        def __eq__(self, other: object) -> bool:
            nonlocal compared
            compared += 1
            return super().__eq__(other)

        __hash__ = type(tmp_path).__hash__

    assert len(module.outputs([Counted(photo) for photo in photos], Counted(tmp_path / "shots"))) == 2000
    assert compared < 10_000


# ---- what goes wrong on the way -------------------------------------------------------------------------------------


@pytest.mark.parametrize("damaged", [("a.jpg",), ("c.tif",), ("a.jpg", "c.tif"), ("a.jpg", "b.PNG", "c.tif", "d.png")])
def test_what_cannot_be_read_stops_none_of_the_others(damaged: tuple[str, ...], folder: Path, tmp_path: Path) -> None:
    """As with cp: each of the others is taken, each failure is said, and the status is not 0."""
    make_photo(folder / "d.png")
    for name in damaged:
        (folder / name).write_bytes((folder / name).read_bytes()[:60])
    whole = [name for name in ("a.jpg", "b.PNG", "c.tif", "d.png") if name not in damaged]
    lines = run("shoot", folder, "--camera", "ideal", "--out", tmp_path / "shots", status=2).splitlines()
    shots = [tmp_path / "shots" / f"{name[0]}.png" for name in whole]
    assert lines[: 2 * len(whole) : 2] == [str(shot) for shot in shots]
    for name, line in zip(damaged, lines[2 * len(whole) : -1], strict=True):
        assert line.startswith(f"kcam: cannot read {folder / name} as a picture")
    assert lines[-1] == f"kcam: {len(damaged)} of 4 photos could not be taken."
    for shot in shots:
        assert pixels(shot).shape == (HEIGHT, WIDTH, 3)
    assert len(shots) == (len(list((tmp_path / "shots").iterdir())) if shots else 0)


def test_an_error_of_the_camera_says_which_photo(folder: Path, tmp_path: Path) -> None:
    """The third is so small that the blur is wider than it."""
    make_photo(folder / "c.tif", width=8, height=6)
    shots = tmp_path / "shots"
    how = ("--camera", "phone", "--distance", "0.2", "--out", shots)
    *_, line, last = run("shoot", folder, *how, status=2).splitlines()
    assert line.startswith("kcam: c.tif: distance 0.2 m is too near")
    assert last == "kcam: 1 of 3 photos could not be taken."
    assert len(list((tmp_path / "shots").iterdir())) == 2


# ---- large photographs ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["style", "phone"])
def test_a_large_photo_goes_through_tiles(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The convolution in squares is the same up to rounding, of which an ADC would make whole steps."""
    camera = (style_camera(stage=False) if name == "style" else Camera.phone()).noiseless()
    camera = Camera(*(stage for stage in camera if not isinstance(stage, sensor.ADC)))
    photo = make_photo(tmp_path / "photo.png", width=203, height=150)
    whole, tiled = tmp_path / "whole.png", tmp_path / "tiled.png"
    module.shoot(camera, photo, whole, distance=2.0)
    monkeypatch.setattr(ways, "_WHOLE", 150 * 203 - 1)
    monkeypatch.setattr(ways, "_SIDE", 64)
    squares = []
    own = ways.Bank.in_squares
    monkeypatch.setattr(ways.Bank, "in_squares", lambda bank, *given: squares.append(bank.squares) or own(bank, *given))
    module.shoot(camera, photo, tiled, distance=2.0)
    assert set(squares) == {(3, 4)}
    assert np.abs(pixels(whole) - pixels(tiled)).max() <= 1
    assert camera[0].tile is None  # the user's own camera stays as it was


def test_strokes_of_a_large_photo(tmp_path: Path, styled: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tiled through camera and stage: the same bytes for the same seed, and no line at the borders of tiles."""
    photo = make_photo(tmp_path / "photo.png", width=203, height=150)
    whole, tiled, again = (tmp_path / f"{name}.png" for name in ("whole", "tiled", "again"))
    run("shoot", photo, "--camera", styled, "--out", whole)
    for place, name, value in ((ways, "_WHOLE", 0), (ways, "_SIDE", 64)):
        monkeypatch.setattr(place, name, value)
    for place, name, value in ((style_stage, "SEEN_AT_ONCE", 0), (style_stage, "TILE", 96)):
        monkeypatch.setattr(place, name, value)
    run("shoot", photo, "--camera", styled, "--out", tiled)
    run("shoot", photo, "--camera", styled, "--out", again)
    assert tiled.read_bytes() == again.read_bytes()
    # the noise is the same, the statistics those of windows
    assert np.corrcoef(pixels(whole).ravel(), pixels(tiled).ravel())[0, 1] > 0.98


MEASURE = """
import sys
from pathlib import Path
from kcam import Camera, shoot
from resident import peak
shoot.shoot(Camera.load(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), distance=2.0)
print(peak())
"""


@pytest.mark.slow
@resident.on_linux
def test_twelve_megapixels_in_bounded_memory(tmp_path: Path) -> None:
    """Measured 2.0 GB, at the convolution behind the demosaic: 0.4 for Python and torch, eleven planes of 0.14 GB."""
    camera, photo, out = tmp_path / "camera.safetensors", tmp_path / "photo.jpg", tmp_path / "shot.png"
    Camera(*style_camera(stage=False), painting_stage()).save(camera)
    make_photo(photo, width=4000, height=3000)
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, str(camera), str(photo), str(out)],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": resident.PATH, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    with Image.open(out) as picture:
        assert picture.size == (4000, 3000)
    assert int(done.stdout) < 2.5e9  # a quarter more, for other allocators


def test_suffixes_that_are_read_in_a_folder_can_be_written() -> None:
    """One list for both; if that changes, `outputs` must too."""
    assert all(suffix == suffix.lower() for suffix in plots.PICTURE_SUFFIXES)
