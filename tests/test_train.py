"""`kcam train`, `kcam paint` and `kcam shoot` with what was trained: files, resuming, errors."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import commands
import pytest
import torch

from kcam import files, isp, plots, train
from kcam.camera import Camera
from kcam.cli import app
from kcam.scene import Scene
from kcam.style import PhotoScenes, TrainingError, painting, scenes, style_camera

CHOSEN = {"stage": False, "steps": 3, "size": 64, "batch": 1}


def invoke(command: str):
    return commands.invoke(app, *command.split())


def without_pictures(monkeypatch) -> None:
    monkeypatch.setattr(train, "_show", lambda *arguments, **named: {"pictures": []})
    monkeypatch.setattr(train, "_write_report", lambda *arguments: None)


def run(out: Path, *, resume: bool = False, threads: int | None = 1, advance=None, licence=None, **changes):
    lines: list[str] = []
    options = train.Options(**CHOSEN | {"out": str(out)} | changes)
    return train.run(options, resume=resume, threads=threads, advance=advance, say=lines.append, licence=licence), lines


@pytest.fixture(scope="module", autouse=True)
def small_ones(tmp_path_factory):
    """A style that is quickly painted, and one small scene on the contact sheets, which every checkpoint draws."""
    path = tmp_path_factory.mktemp("style") / "style.png"
    plots.write_picture(painting("woodcut", size=128), path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(CHOSEN, "style", str(path))
        patch.setattr(train, "SHOWN", ("coffee",))
        patch.setattr(train, "SHOWN_SIZE", 96)
        yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("run") / "strokes.safetensors"
    run(out, stage=True)
    return out


def test_it_writes_a_camera_and_a_report(trained: Path) -> None:
    folder = trained.with_suffix("")
    assert {path.name for path in folder.iterdir()} == {
        "checkpoints", "config.json", "sheet.png", "loss.png", "report.html"
    }  # fmt: skip
    configuration = json.loads((folder / "config.json").read_text())
    assert configuration["options"]["style"] == CHOSEN["style"]
    assert configuration["settings"]["steps"] == 3
    assert configuration["threads"] == 1
    assert "http" not in (folder / "report.html").read_text().replace("http-equiv", "")
    camera = Camera.load(trained)
    scene = Scene.builtin("coffee", 64)
    shots = [camera(scene, generator=torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
    assert torch.equal(shots[0], shots[1])
    assert not torch.equal(shots[0], shots[2])
    assert files.describe(trained)["configuration"]["class"] == "Camera"


def test_stopped_and_resumed_it_is_the_same_file(tmp_path: Path, trained: Path) -> None:
    """SIGTERM after the first step; then --resume."""
    out = tmp_path / "strokes.safetensors"

    def stop_once(progress, steps: int) -> None:
        if progress.step == 1:
            os.kill(os.getpid(), signal.SIGTERM)

    result, lines = run(out, stage=True, advance=stop_once, licence="CC0-1.0")
    assert not result.finished
    assert lines == ["stopped after 1 of 3 steps; go on with --resume"]
    assert not out.exists()
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    result, _ = run(out, stage=True, resume=True, threads=None)
    assert result.finished
    assert out.read_bytes() == trained.read_bytes()
    assert "licence: CC0-1.0" in out.with_suffix(".md").read_text()  # as the run was begun


def test_the_licence_of_a_run_that_never_began_is_not_the_next_ones(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"options": {}, "style": "", "threads": 1, "licence": "MIT"}')
    assert train._begun_licence(tmp_path, resume=True) is None
    (tmp_path / "checkpoints" / "step-000001").mkdir(parents=True)
    assert train._begun_licence(tmp_path, resume=True) == "MIT"
    assert train._begun_licence(tmp_path, resume=False) is None


@pytest.mark.slow
def test_a_run_goes_on_with_its_own_options(tmp_path: Path, monkeypatch) -> None:
    without_pictures(monkeypatch)
    out = tmp_path / "a.safetensors"
    run(out)
    with pytest.raises(ValueError, match=r"a holds a run. Go on with --resume, choose another --out"):
        run(out)
    with pytest.raises(ValueError, match=r"was begun with seed = 0, not 1. Use the same options"):
        run(out, resume=True, seed=1)
    with pytest.raises(ValueError, match=r"was begun without --style-size, not 64. Use the same options"):
        run(out, resume=True, style_size=64)
    picture = tmp_path / "style.png"
    plots.write_picture(painting("woodcut", size=128), picture)
    out = tmp_path / "b.safetensors"
    run(out, style=str(picture))
    plots.write_picture(painting("mosaic", size=128), picture)
    with pytest.raises(ValueError, match=r"style.png is not the picture that .*b was begun with"):
        run(out, style=str(picture), resume=True)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"style": "monet"}, r'unknown style "monet": expected a picture file, or one of strokes'),
        ({"style": "no.png"}, r"there is no file no.png"),
        ({"preset": "slow"}, r'unknown preset "slow"; there are: pieces, quick, standard, thesis'),
        ({"features": "resnet"}, r'unknown features "resnet"; there are: steerable, vgg16'),
        ({"features": "vgg16"}, r"needs --vgg-weights: the path of torchvision's vgg16-397923af.pth"),
        ({"vgg_weights": "w.pth"}, r"--vgg-weights are for --features vgg16"),
        ({"style_size": 4096}, r"style size 4096 is not within 1..128"),
        ({"style_size": 32}, r"a style of 32 x 32 is too small"),
        ({"patches": "nowhere"}, r"nowhere"),
        ({"camera": "nothing.safetensors"}, r"there is no file nothing.safetensors"),
        ({"out": "styled.pt"}, r"cannot write styled.pt: its name must end in one of .safetensors"),
        ({"device": "abacus"}, r'cannot train on "abacus": expected cpu, or cuda where torch finds a GPU'),
        ({"out": "/nowhere/at/all.safetensors"}, r"there is no folder /nowhere/at"),
    ],
)
def test_errors(tmp_path: Path, monkeypatch, changes: dict, match: str) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ValueError, FileNotFoundError), match=match):
        run(Path(changes.pop("out", "a.safetensors")), **changes)
    assert not (tmp_path / "a.safetensors").exists()


def test_a_run_that_could_not_begin_leaves_its_name_free(tmp_path: Path, monkeypatch) -> None:
    without_pictures(monkeypatch)
    out = tmp_path / "a.safetensors"
    with pytest.raises(ValueError, match="100 x 100 has no features"):
        run(out, size=100, steps=1)
    assert run(out, size=64, steps=1)[0].finished
    moved = tmp_path / "b.safetensors"
    out.with_suffix("").rename(moved.with_suffix(""))
    assert run(moved, size=64, steps=1, resume=True)[0].finished  # under another name


def test_it_writes_a_card_with_what_was_measured(tmp_path: Path, trained: Path) -> None:
    text = trained.with_suffix(".md").read_text()
    style = Path(CHOSEN["style"]).name
    assert f"\n{style}; licence: unknown." in text
    assert str(Path(CHOSEN["style"]).parent) not in text
    assert f"({trained.stem}/sheet.png)" in text
    rows = {
        line.split(" | ")[0][2:]: line.strip("| ").split(" | ")[1:] for line in text.splitlines() if "| loss: " in line
    }
    before, alone, painted = (float(value) for value in rows["loss: style"])
    assert painted < 0.5 * min(before, alone)  # pieces of the style itself
    assert float(rows["loss: content"][0]) == 0
    (tmp_path / "notes.md").write_text("mine")
    with pytest.raises(ValueError, match=r"notes.md is no model card of kcam's"):
        run(tmp_path / "notes.safetensors")


def test_nothing_that_is_read_is_written_over(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    camera, photo = tmp_path / "mine.safetensors", tmp_path / "photo.png"
    style_camera(stage=False).save(camera)
    plots.write_picture(torch.full((3, 64, 64), 0.5), photo)
    kept = camera.read_bytes(), photo.read_bytes()
    with pytest.raises(ValueError, match="is what is read, and would be lost"):
        run(camera, camera=str(camera))
    for command in ("paint photo.png --out ./photo.png", "paint --style photo.png --out photo.png"):
        result = invoke(command)
        assert result.exit_code == 2
        assert "is what is read, and would be lost" in " ".join(result.output.split())
    (tmp_path / "folder.safetensors").mkdir()
    with pytest.raises(ValueError, match="there is a folder of that name"):
        run(tmp_path / "folder.safetensors")
    assert (camera.read_bytes(), photo.read_bytes()) == kept


@pytest.mark.skipif(train.fcntl is None, reason="POSIX alone holds folders")
def test_one_process_trains_in_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    folder.mkdir()
    script = "import fcntl, os, sys; fcntl.flock(os.open(sys.argv[1], 0), fcntl.LOCK_EX); print(flush=True); input()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", script, folder], **pipes) as other:
        other.stdout.readline()
        with pytest.raises(ValueError, match="another process is training in"):
            run(tmp_path / "a.safetensors")
        other.communicate(b"\n")


def test_a_run_that_diverges_is_one_line(tmp_path: Path, monkeypatch) -> None:
    def diverge(*arguments, **named):
        named["say"]("a name in brackets: [/b]")  # is no markup
        raise TrainingError("training stopped at step 3: the style term is nan.")

    monkeypatch.setattr(train, "run", diverge)
    result = invoke(f"train woodcut --out {tmp_path / 'a.safetensors'}")
    assert result.exit_code == 2
    assert result.output.endswith("kcam: training stopped at step 3: the style term is nan.\n")
    assert "[/b]" in result.output


def test_a_style_smaller_than_the_crops_is_told(tmp_path: Path, monkeypatch) -> None:
    without_pictures(monkeypatch)
    for width, told in ((64, 0), (112, 1)):
        _, lines = run(tmp_path / f"{width}.safetensors", style_size=96, steps=1, size=width)
        assert len(lines) == told
    assert lines[0].startswith("the style has 96 x 96 pixels, less than the 112 x 112 that are trained on: ")
    flat = tmp_path / "flat.png"
    plots.write_picture(torch.full((3, 80, 80), 0.5), flat)
    with pytest.raises(ValueError, match=r"the exemplar is flat: .* A picture of one colour has no strokes"):
        run(tmp_path / "flat.safetensors", style=str(flat), stage=True)


def test_a_gray_style_and_a_smaller_one(tmp_path: Path) -> None:
    path = tmp_path / "gray.png"
    plots.write_picture(painting("woodcut", size=(96, 160)).mean(0, keepdim=True), path)
    picture = train.style_picture(str(path))
    assert picture.shape == (3, 96, 160)
    assert torch.equal(picture[0], picture[1])
    small = train.style_picture(str(path), size=80)
    assert small.shape == (3, 48, 80)
    assert (small - small.mean(0)).abs().max() < 1e-3  # gray stays gray
    light, kept = (float(Scene.from_rgb(p, illuminant="E").coefficients.mean()) for p in (picture, small))
    assert kept == pytest.approx(light, rel=0.03)  # filtered in linear light; coded values lose 10 %


@pytest.mark.slow
def test_it_starts_from_a_saved_camera(tmp_path: Path, trained: Path, monkeypatch) -> None:
    without_pictures(monkeypatch)
    with_stage, without = (
        run(tmp_path / f"{stage}.safetensors", camera=str(trained), stage=stage, steps=1)[0].camera
        for stage in (True, False)
    )
    assert isinstance(with_stage[-1], isp.TextureTransfer)
    assert len(without) == len(with_stage) - 1
    assert isinstance(without[-1], isp.ToneCurve)


@pytest.mark.slow
def test_threads_are_put_back(tmp_path: Path, monkeypatch) -> None:
    without_pictures(monkeypatch)
    before = torch.get_num_threads()
    run(tmp_path / "a.safetensors", threads=1, steps=1)
    assert torch.get_num_threads() == before
    with pytest.raises(ValueError, match=r"threads must be at least 1, got 0"):
        run(tmp_path / "b.safetensors", threads=0)


@pytest.mark.slow
def test_train_shoot_and_paint_as_commands(tmp_path: Path, trained: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    style = CHOSEN["style"]  # a file: one of kcam's own is painted larger, and is in the last command
    options = "--steps 1 --size 64 --batch 1 --no-stage --threads 1 --profile --out a.safetensors"
    result = invoke(f"train {style} {options}")
    assert result.exit_code == 0, result.output
    assert "a.safetensors\na.md\na/report.html" in result.output
    assert "s a step" in result.output
    plots.write_picture(Scene.builtin("chelsea", 96).to_srgb()[0], "photo.png")
    result = invoke(f"shoot photo.png --camera {trained} --out shot.png --seed 3")
    assert result.exit_code == 0, result.output
    assert Path("shot.png").exists()
    result = invoke(f"paint photo.png --style {style} --steps 2 --size 64 --out painted.png")
    assert result.exit_code == 0, result.output
    result = invoke("paint --style woodcut --steps 2 --size 64 --out texture.png")
    assert result.exit_code == 0, result.output
    assert Scene.from_file("texture.png").shape == (1, 64, 64)
    assert Scene.from_file("painted.png").shape[2] == 64
    result = invoke("paint --style nothing --out texture.png")
    assert result.exit_code == 2
    assert 'unknown style "nothing"' in " ".join(result.output.split())


# ---- a user's own photographs --------------------------------------------------------------------------------------


def photographs(folder: Path, *, count: int = 3, size: tuple[int, int] = (90, 120)) -> Path:
    """Pictures of every kind, in folders, with what is none between them."""
    (folder / "inside" / "more").mkdir(parents=True)
    (folder / ".hidden").mkdir()
    for index in range(count):
        pixels = torch.rand(3, *size, generator=torch.Generator().manual_seed(index))
        place = folder / ("", "inside", "inside/more")[index % 3]
        plots.write_picture(pixels, place / f"photo{index}.{('png', 'jpg', 'tif', 'webp')[index % 4]}")
    plots.write_picture(torch.rand(3, 40, 400), folder / "narrow.png")
    plots.write_picture(torch.rand(3, *size), folder / ".hidden.png")
    plots.write_picture(torch.rand(3, *size), folder / ".hidden" / "a.png")
    (folder / "text.jpg").write_text("no picture")
    (folder / "notes.txt").write_text("nor this")
    return folder


SKIPPED = [
    "skipped: narrow.png: it has 400 x 40 pixels, and crops of 64 x 64 are trained on.",
    "skipped: text.jpg: it cannot be read as a picture.",
]


def test_it_trains_on_photographs_and_goes_on_with_the_same(tmp_path: Path, monkeypatch) -> None:
    without_pictures(monkeypatch)
    photos = photographs(tmp_path / "photos")
    whole, stopped = tmp_path / "whole.safetensors", tmp_path / "stopped.safetensors"
    result, lines = run(whole, photos=str(photos))
    assert result.finished
    assert lines == SKIPPED
    document = json.loads((tmp_path / "whole" / "config.json").read_text())
    assert document["options"]["photos"] == str(photos)

    def stop_once(progress, steps: int) -> None:
        if progress.step == 1:
            os.kill(os.getpid(), signal.SIGTERM)

    run(stopped, photos=str(photos), advance=stop_once)
    with pytest.raises(ValueError, match=r"was begun with photos = '.*photos', not None. Use the same options"):
        run(stopped, resume=True)
    (photos / "narrow.png").unlink()  # was not trained on
    picture = (photos / "photo0.png").read_bytes()
    plots.write_picture(torch.full((3, 90, 120), 0.5), photos / "photo0.png")
    changed = (
        r"the photographs in .*photos are not those that .*stopped was begun with. Put them back, or choose another"
    )
    with pytest.raises(ValueError, match=changed):
        run(stopped, photos=str(photos), resume=True)
    (photos / "photo0.png").write_bytes(picture)
    plots.write_picture(torch.rand(3, 90, 120), photos / "new.png")
    with pytest.raises(ValueError, match=changed):
        run(stopped, photos=str(photos), resume=True)
    (photos / "new.png").unlink()
    assert run(stopped, photos=str(photos), resume=True, threads=None)[0].finished
    assert stopped.read_bytes() == whole.read_bytes()


def test_the_command_names_the_photographs_that_are_too_small(tmp_path: Path) -> None:
    photos = photographs(tmp_path / "photos")
    common = f"--steps 1 --size 64 --batch 1 --no-stage --threads 1 --out {tmp_path / 'a.safetensors'}"
    result = invoke(f"train {CHOSEN['style']} --photos {photos} {common}")
    assert result.exit_code == 0, result.output
    assert result.stderr.splitlines()[:2] == SKIPPED
    assert str(photos) in (tmp_path / "a" / "report.html").read_text()


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda folder: None, r"there is no folder .*photos. Expected one of photographs"),
        (lambda folder: folder.write_text(""), r"photos is a file. Expected a folder of photographs"),
        (lambda folder: folder.mkdir(), r"there is no picture in the folder .*photos: expected .png, .jpg, .*.bmp\.$"),
        (
            lambda folder: (folder.mkdir(), (folder / "a.heic").write_text(""), (folder / ".b.png").write_text("")),
            r"expected .png, .jpg, .*, and there are 1 other files\.$",
        ),
        (
            lambda folder: photographs(folder, count=0),
            r"none of the 2 pictures in .* can be trained on. narrow.png: it has 400 x 40 pixels.* or a smaller --size",
        ),
    ],
)
def test_photographs_that_are_none(make, match: str, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    make(folder)
    with pytest.raises((ValueError, OSError), match=match):
        run(tmp_path / "a.safetensors", photos=str(folder))


def test_patches_and_photographs_are_two_answers(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="patches and photos both say what to train on. Leave one of them out"):
        run(tmp_path / "a.safetensors", photos="a", patches="b")


def test_crops_of_photographs_are_drawn_by_seed_and_step_alone(tmp_path: Path, monkeypatch) -> None:
    folder = photographs(tmp_path / "photos", count=7)
    plots.write_picture(torch.rand(1, 100, 100), folder / "gray.png")
    source = PhotoScenes(folder, 64)
    assert len(source.photos) == 8
    assert len(source) == 8
    whole, origins = source.draw(range(6), seed=3, step=9)
    assert whole.shape == (6, 64, 64)
    assert 0 <= whole.coefficients.min() <= whole.coefficients.max() <= 1
    assert all(re.fullmatch(r"\w+\.\w+ at 1\d\d? pixels, row \d+, column \d+", origin) for origin in origins)
    monkeypatch.setattr(scenes, "KEPT", 0)  # whatever is kept, and in whatever company
    for rows in ([5], [0, 3], [2, 1]):
        part, where = PhotoScenes(folder, 64).draw(rows, seed=3, step=9)
        assert torch.equal(part.coefficients, whole.coefficients[rows])
        assert where == [origins[row] for row in rows]
    assert source.draw([0], seed=4, step=9)[1] != origins[:1]


def test_a_crop_is_the_photograph(tmp_path: Path) -> None:
    """Of one colour it keeps that colour, as one of the ways in which crops are varied leaves it as it is."""
    plots.write_picture(torch.tensor([0.8, 0.4, 0.2]).view(3, 1, 1).expand(3, 200, 300), tmp_path / "a.png")
    drawn, _ = PhotoScenes(tmp_path, 64).draw(range(24), seed=0, step=0)
    colours = drawn.to_srgb().mean((2, 3))
    assert (colours - torch.tensor([0.8, 0.4, 0.2])).abs().amax(1).min() < 0.005  # 8 bits


@pytest.mark.parametrize("seed", range(30))
def test_photographs_are_shrunk_as_far_as_a_crop_fits(seed: int) -> None:
    random = torch.Generator().manual_seed(seed)
    size, short, long = (int(torch.randint(low, 3000, (), generator=random)) for low in (16, 16, 16))
    short, long = sorted((max(short, size), max(long, size)))
    sides = scenes._sides(long, short, size)
    assert sides
    for side in sides:
        assert side <= long
        assert round(side * short / long) >= size
    assert max(sides) <= max(1024, size * long / short + 1)
    assert scenes._sides(4000, 3000, 128) == [1024, 512, 358, 205]
    assert scenes._sides(300, 200, 64) == [300, 205]


def test_a_photograph_that_is_cut_short_is_passed_over(tmp_path: Path) -> None:
    """It is found when it is drawn: its header is whole."""
    plots.write_picture(torch.rand(3, 90, 120), tmp_path / "a.jpg")
    plots.write_picture(torch.rand(3, 90, 120), tmp_path / "b.jpg")
    (tmp_path / "a.jpg").write_bytes((tmp_path / "a.jpg").read_bytes()[:2000])
    source = PhotoScenes(tmp_path, 64)
    assert not source.skipped
    with pytest.warns(
        UserWarning, match=r"cannot read .*a.jpg as a picture.* The next photograph is taken in its place"
    ):
        _, origins = source.draw(range(8), seed=0, step=0)
    assert {origin.split()[0] for origin in origins} == {"b.jpg"}
    (tmp_path / "b.jpg").write_bytes((tmp_path / "b.jpg").read_bytes()[:2000])
    with pytest.warns(UserWarning, match="cannot read"), pytest.raises(ValueError, match="none of the 2 photographs"):
        PhotoScenes(tmp_path, 64).draw([0], seed=0, step=0)
