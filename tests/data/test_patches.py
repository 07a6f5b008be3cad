"""The patch store: what is in it, what is refused, and that its bytes follow from the cubes and settings alone."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import socket
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import stores
import tifffile
import torch
from stores import BANDS, HEIGHT, NAMES, SETTINGS, WIDTH, call, content, cube, make_cubes, make_store, values

import kcam
from kcam.data import PatchDataset, Settings, StoreError, extract, make_plan, verify, write_cube
from kcam.data.cube import CubeError
from kcam.data.patches import StoreStopped, group_of, parse_split, positions, read_manifest, split_of
from kcam.data.patches import plan as planning
from kcam.data.patches.manifest import digest


@pytest.fixture(scope="module")
def cubes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_cubes(tmp_path_factory.mktemp("data") / "cubes")


@pytest.fixture(scope="module")
def store(cubes: Path) -> Path:
    """For reading only."""
    return make_store(cubes, cubes.parent / "store")


ALL = replace(SETTINGS, split=(("train", 1.0),))


# ---- what is in it -------------------------------------------------------------------------------------------------


def test_a_patch_is_its_place_in_the_cube(cubes: Path, store: Path):
    seen = 0
    for split in ("train", "val"):
        dataset = PatchDataset(store / split)
        for index in range(len(dataset)):
            patch, (name, y, x) = dataset[index], dataset.position(index)
            truth = stores.pixels(cubes / f"{name}.tif")[:, y : y + 16, x : x + 16]
            scale = 1 / 65535  # the brightest value of every cube here is 1
            # half a step, and the rounding of float32 near 65535: 2^-8 of a step, twice
            assert np.abs(patch.values.numpy() - truth).max() <= (0.5 + 2**-7) * scale
            assert patch.scene == name
            seen += 1
    assert seen == len(NAMES) * 4 * 6


@pytest.mark.parametrize(
    ("shape", "size", "stride", "rows", "columns"),
    [
        ((40, 56), 16, 8, [0, 8, 16, 24], [0, 8, 16, 24, 32, 40]),
        ((40, 56), 16, 24, [0, 24], [0, 24]),  # 48 + 16 > 56
        ((16, 16), 16, 1, [0], [0]),
        ((17, 15), 16, 1, [], []),
        ((20, 50), 10, 20, [0], [0, 20, 40]),
    ],
)
def test_positions(shape, size, stride, rows, columns):
    found = positions(shape, Settings(size=size, stride=stride))
    assert found == [(y, x) for y in rows for x in columns]


@pytest.mark.parametrize("stride", [1, 7, 16, 20])
def test_every_stride_reads_the_right_rows(tmp_path: Path, stride: int):
    make_cubes(tmp_path / "cubes", ("one",), height=37)
    store = make_store(tmp_path / "cubes", tmp_path / "out", replace(ALL, stride=stride))
    dataset = PatchDataset(store / "train")
    assert len(dataset) == len(positions((37, WIDTH), replace(ALL, stride=stride)))
    truth = stores.pixels(tmp_path / "cubes" / "one.tif")
    for index in range(0, len(dataset), 5):
        _, y, x = dataset.position(index)
        assert np.abs(dataset[index].values.numpy() - truth[:, y : y + 16, x : x + 16]).max() < 0.51 / 65535


def test_each_filter_leaves_out_its_own_and_counts_it(tmp_path: Path):
    grid = values(0, height=16, width=16 * 6)
    grid[:, :, 16:32] = 1e-5  # empty
    grid[:, :6, 32:48] = 1.0  # 6 of 16 rows at the brightest value
    grid[:, :, 48:64] = 0.5  # flat
    made = cube(grid)
    mask = torch.ones(16, 96, dtype=torch.bool)
    mask[3, 70] = False  # one invalid pixel
    (tmp_path / "cubes").mkdir()
    write_cube(tmp_path / "cubes" / "one.tif", kcam.data.Cube(grid, made.wavelengths, "reflectance", mask))
    settings = replace(ALL, stride=16)
    outcome = extract(make_plan(tmp_path / "cubes", settings), tmp_path / "out")
    assert outcome.dropped == {"invalid": 1, "empty": 1, "saturated": 1, "flat": 1}
    assert outcome.patches == 2
    record = read_manifest(tmp_path / "out" / "train")["scenes"][0]
    assert record["positions"] == [[0, 0], [0, 80]]
    assert (record["candidates"], record["dropped"]) == (6, outcome.dropped)
    # each threshold moved lets its own patch in, and no other
    for change in ({"min_mean": 0.0, "min_contrast": 0.0}, {"max_clipped": 0.4}, {"max_invalid": 0.01}):
        out = tmp_path / next(iter(change))
        kept = extract(make_plan(tmp_path / "cubes", replace(settings, **change)), out).patches
        assert kept == (4 if "min_mean" in change else 3)  # what is empty here is flat too
    output = call("extract_patches", tmp_path / "cubes", "--size", 16, "--stride", 16, "--split", "1",
                  "--out", tmp_path / "said")  # fmt: skip
    assert "2 patches in" in output
    assert "left out: 1 empty, 1 flat, 1 invalid, 1 saturated" in output


def test_a_black_cube_and_one_of_nothing_but_nan_fail_by_name(tmp_path: Path):
    folder = make_cubes(tmp_path / "cubes", ("good",))
    write_cube(folder / "black.tif", cube(torch.zeros(BANDS, HEIGHT, WIDTH)))
    shutil.copy(folder / "good.tif", folder / "nan.tif")
    with tifffile.TiffFile(folder / "nan.tif") as file:
        place = file.pages[0].dataoffsets[0]
    with (folder / "nan.tif").open("rb+") as file:
        file.seek(place)
        file.write(np.full(BANDS * HEIGHT * WIDTH, np.nan, "<f4").tobytes())
    outcome = extract(make_plan(folder, ALL), tmp_path / "out")
    assert outcome.failed.keys() == {"black", "nan"}
    assert "black" in outcome.failed["black"]
    assert "NaN" in outcome.failed["nan"]
    assert read_manifest(tmp_path / "out" / "train")["failed"] == ["black", "nan"]
    assert verify(tmp_path / "out") == []


def test_statistics_are_those_of_numpy(store: Path):
    for split in ("train", "val"):
        dataset = PatchDataset(store / split)
        everything = torch.stack([dataset[index].values for index in range(len(dataset))]).double()
        # float32 values are off by 2^-25 of themselves, at random: far less in the mean of 10^4
        torch.testing.assert_close(dataset.mean, everything.mean((0, 2, 3)), rtol=1e-7, atol=0)
        torch.testing.assert_close(dataset.deviation, everything.std((0, 2, 3), correction=0), rtol=1e-6, atol=0)


def test_the_manifest_says_all_that_a_user_needs(cubes: Path, tmp_path: Path):
    folder = make_cubes(tmp_path / "cubes", ("a",))
    write_cube(folder / "b.tif", cube(values(1), "b", licence="CC0", citation="Someone 2026"))
    out = make_store(folder, tmp_path / "out", ALL)
    document = json.loads((out / "train" / "manifest.json").read_text())
    assert document.keys() == {
        "kcam_patches", "kcam", "sha256", "split", "plan", "settings", "wavelengths_nm", "dtype", "patch", "patches",
        "mean", "deviation", "failed", "scenes",
    }  # fmt: skip
    assert document["kcam"] == kcam.__version__
    assert document["wavelengths_nm"] == pytest.approx(np.linspace(420, 720, BANDS).tolist(), abs=1e-4)
    assert document["patch"] == [BANDS, 16, 16]
    assert document["patches"] == sum(record["count"] for record in document["scenes"]) == 48
    for record in document["scenes"]:
        assert record.keys() == {
            "scene", "group", "file", "sha256", "count", "candidates", "dropped", "scale", "positions", "shape", "unit",
            "extrapolated", "source",
        }  # fmt: skip
        assert record["unit"] == "reflectance"
    assert document["scenes"][1]["source"] == {"format": "test", "licence": "CC0", "citation": "Someone 2026"}


def test_no_path_time_host_or_argument_is_in_the_store(tmp_path: Path):
    folder = make_cubes(tmp_path / "kubes-xyzzy", NAMES[:3])
    out = make_store(folder, tmp_path / "out-plugh", workers=1)
    words = ["xyzzy", "plugh", str(tmp_path), str(Path.home()), socket.gethostname(), f"/{os.getpid()}"]
    words += [time.strftime("%Y-%m"), time.strftime("%Y:%m"), "resume", "workers"]
    for path in out.rglob("*.json"):
        text = path.read_bytes()
        assert not [word for word in words if len(word) > 3 and word.encode() in text], path
    for path in out.rglob("*.npy"):
        assert not [word for word in words if len(word) > 3 and word.encode() in path.read_bytes()[:128]], path
    assert {path.name for path in out.rglob("*") if path.is_file()} <= {"manifest.json", *(f"{n}.npy" for n in NAMES)}


# ---- splits --------------------------------------------------------------------------------------------------------


def test_splits_are_by_hash_and_adding_scenes_moves_none():
    split = (("train", 0.8), ("val", 0.1), ("test", 0.1))
    names = [f"scene_{index}" for index in range(3000)]
    found = {name: split_of(name, split) for name in names}
    assert found["scene_0"] == split_of("scene_0", split)  # of nothing but its name
    for name, share in split:
        # 3000 draws: a standard deviation of 0.0073 at 0.8; four of them
        assert np.mean([value == name for value in found.values()]) == pytest.approx(share, abs=0.03)
    # pinned: another hash would move the scenes of everyone's stores
    assert [split_of(name, (("train", 0.5), ("val", 0.5))) for name in NAMES] == PINNED


PINNED = ["train", "train", "train", "val", "val", "val"]


@pytest.mark.parametrize(
    ("name", "facts", "pattern", "group"),
    [
        ("scene7", {}, None, "scene7"),
        ("scene7", {"group": "toys"}, None, "toys"),
        ("toys_3", {}, r"(.*)_\d+", "toys"),
        ("toys_3", {"group": "facts"}, r"^[a-z]+", "toys"),
        ("toys", {"group": "facts"}, r"\d+", "facts"),  # a pattern that finds nothing leaves it to the source
        ("a_b", {}, r"(x)?_b", "_b"),
    ],
)
def test_the_group_of_a_scene(name, facts, pattern, group):
    assert group_of(name, facts, pattern) == group


def test_no_group_stands_in_two_splits(tmp_path: Path):
    folder = tmp_path / "cubes"
    make_cubes(folder, tuple(f"{name}_{copy}" for name in NAMES for copy in range(2)))
    for copy in range(3):
        write_cube(folder / f"other{copy}.tif", cube(values(copy), group="same"))
    out = make_store(folder, tmp_path / "out", replace(SETTINGS, group=r"^([a-z]+)_"))
    groups = {split: {r["group"] for r in read_manifest(out / split)["scenes"]} for split in ("train", "val")}
    assert groups["train"] | groups["val"] == {*NAMES, "same"}
    assert not groups["train"] & groups["val"]
    assert min(len(found) for found in groups.values()) > 0
    assert verify(out) == []


def test_a_split_without_scenes_is_a_warning(cubes: Path, tmp_path: Path):
    folder = make_cubes(tmp_path / "cubes", ("apple",))
    output = call("extract_patches", folder, "--size", 16, "--out", tmp_path / "out", "--split", "0.999/0.001")
    assert "warning: the split val received no scene" in output
    assert len(PatchDataset(tmp_path / "out" / "val")) == 0
    assert verify(tmp_path / "out") == []


@pytest.mark.parametrize(
    ("split", "message"),
    [
        ("0.5/0.4", "sum to 1"), ("a/b", "not shares such as"), ("1.5/-0.5", ">= 0"), ("nan/1", "sum to 1"),
        ("0.4/0.3/0.2/0.1", "4 parts"), ("", "not shares"),
    ],
)  # fmt: skip
def test_a_wrong_split_is_a_usage_error(cubes: Path, tmp_path: Path, split: str, message: str):
    output = call("extract_patches", cubes, "--out", tmp_path / "out", "--split", split, status=2)
    assert message in output
    assert output.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"size": 0}, "size must be 1 pixel or more, got 0"),
        ({"stride": 0}, "stride must be 1 pixel"),
        ({"split": ()}, "sum to 1"),
        ({"group": "("}, "no regular expression"),
        ({"min_mean": float("nan")}, "min_mean must be 0 or more"),
        ({"max_clipped": -0.1}, "max_clipped must be 0 or more"),
    ],
)
def test_wrong_settings(change, message):
    with pytest.raises(StoreError, match=message):
        replace(SETTINGS, **change)


def test_parse_split_names_its_parts():
    assert parse_split("0.8/0.1/0.1") == (("train", 0.8), ("val", 0.1), ("test", 0.1))
    assert parse_split("1") == (("train", 1.0),)


# ---- cubes that do not fit -----------------------------------------------------------------------------------------


def test_cubes_that_do_not_fit_fail_by_name_and_the_rest_goes_on(tmp_path: Path):
    folder = make_cubes(tmp_path / "cubes", NAMES[:2])
    make_cubes(folder, ("grid",), bands=5)
    make_cubes(folder, ("small",), height=15)
    (folder / "text.tif").write_text("no cube at all")
    (folder / "empty.tif").touch()
    whole = (folder / "apple.tif").read_bytes()
    (folder / "cut.tif").write_bytes(whole[: len(whole) // 2])
    (folder / "back\\slash.tif").write_bytes(whole)
    (folder / "line\nbreak.tif").write_bytes(whole)
    output = call("extract_patches", folder, "--size", 16, "--out", tmp_path / "out", "--split", "1", status=1)
    failed = dict(re.findall(r"^failed: ([^:]+): (.*)", output, re.MULTILINE))
    assert "5 bands" in failed["grid"]
    assert "15 x 56, smaller than a patch of 16" in failed["small"]
    assert failed.keys() >= {"text", "empty", "cut", "back\\slash"}
    document = read_manifest(tmp_path / "out" / "train")
    assert [record["scene"] for record in document["scenes"]] == ["apple", "boat"]
    assert document["failed"] == sorted(["back\\slash", "cut", "empty", "grid", "line\nbreak", "small", "text"])
    assert verify(tmp_path / "out") == []
    options = ("--size", 16, "--out", tmp_path / "out", "--split", "1", "--resume")
    again = call("extract_patches", folder, *options)  # a finished store: nothing to do, and that succeeds
    assert "finished already" in again
    assert "warning: cut is not in it" in again


def test_names_that_are_no_unicode_fail_by_name(tmp_path: Path):
    folder = make_cubes(tmp_path / "cubes", NAMES[:1])
    try:
        (folder / os.fsdecode(b"caf\xe9.tif")).write_bytes((folder / "apple.tif").read_bytes())
    except OSError:
        pytest.skip("this file system knows only unicode")
    plan = make_plan(folder, SETTINGS)
    assert next(iter(plan.failed.values())).startswith("its name 'caf\\udce9' cannot be")
    assert len(plan.scenes) == 1


def test_tricky_names_are_names(tmp_path: Path):
    names = ("größe 1", "a.b.c", "with space ", "日本", "'quoted\"", "-dash", "x" * 200, "%s {0} $HOME", "train")
    folder = make_cubes(tmp_path / "cubes dir.v1", names)
    out = make_store(folder, tmp_path / "out dir.v2", ALL)
    dataset = PatchDataset(out / "train")
    assert {dataset.position(index)[0] for index in range(len(dataset))} == set(names)
    assert verify(out) == []


def test_a_folder_without_cubes_is_a_usage_error(tmp_path: Path):
    assert "there are no cubes" in call("extract_patches", tmp_path, "--out", tmp_path / "out", status=2)
    assert "there is no" in call("extract_patches", tmp_path / "absent", "--out", tmp_path / "out", status=2)
    (tmp_path / "bad.tif").write_text("x")
    assert "none of the 1 files" in call("extract_patches", tmp_path, "--out", tmp_path / "out", status=2)
    assert not (tmp_path / "out").exists()


def test_a_cube_that_changed_after_the_plan_fails_by_name(tmp_path: Path):
    folder = make_cubes(tmp_path / "cubes", NAMES[:3])
    plan = make_plan(folder, ALL)
    (folder / "boat.tif").write_bytes((folder / "boat.tif").read_bytes()[:5000])
    (folder / "cat.tif").unlink()
    outcome = extract(plan, tmp_path / "out")
    assert outcome.failed.keys() == {"boat", "cat"}
    assert outcome.done == ["apple"]


def test_one_cube_is_enough(cubes: Path, tmp_path: Path):
    out = make_store(cubes / "ink.tif", tmp_path / "out", ALL)
    assert len(PatchDataset(out / "train")) == 24


# ---- --out, --resume, --shard --------------------------------------------------------------------------------------


def extract_tool(cubes: Path, out: Path, *more: object, status: int = 0) -> str:
    options = ("--size", 16, "--stride", 8, "--split", "0.6/0.4")
    return call("extract_patches", cubes, "--out", out, *options, *more, status=status)


def test_a_folder_that_is_not_empty_is_refused(cubes: Path, store: Path, tmp_path: Path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("x")
    assert "is not empty" in extract_tool(cubes, tmp_path / "out", status=2)
    assert "is not empty" in extract_tool(cubes, tmp_path / "out", "--resume", status=2)
    assert content(tmp_path / "out").keys() == {"mine.txt"}
    assert "holds a store already" in extract_tool(cubes, store, status=2)
    assert "is a file" in extract_tool(cubes, tmp_path / "out" / "mine.txt", status=2)


def test_resume_starts_on_an_absent_or_empty_folder_and_does_nothing_on_a_finished_one(cubes, store, tmp_path):
    extract_tool(cubes, tmp_path / "absent", "--resume")
    (tmp_path / "empty").mkdir()
    extract_tool(cubes, tmp_path / "empty", "--resume")
    assert content(tmp_path / "absent") == content(tmp_path / "empty") == content(store)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "empty").rglob("*")}
    assert "finished already" in extract_tool(cubes, tmp_path / "empty", "--resume")
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "empty").rglob("*")} == before


def test_another_plan_is_refused(cubes: Path, store: Path, tmp_path: Path):
    other = replace(SETTINGS, stride=9)
    with pytest.raises(StoreError, match="of other cubes or settings"):
        extract(make_plan(cubes, other), store, resume=True)
    extract(make_plan(cubes, SETTINGS), tmp_path / "begun", shard=(1, 2))
    with pytest.raises(StoreError, match="begun with other cubes or settings"):
        extract(make_plan(cubes, other), tmp_path / "begun", resume=True)
    with pytest.raises(StoreError, match="--resume goes on with it"):
        extract(make_plan(cubes, SETTINGS), tmp_path / "begun")
    (tmp_path / "begun" / ".work" / "plan.json").write_text("{")
    with pytest.raises(StoreError, match="damaged"):
        extract(make_plan(cubes, SETTINGS), tmp_path / "begun", resume=True)


@pytest.mark.parametrize("change", ["content", "size", "band", "added", "renamed", "group"])
def test_the_plan_follows_what_decides_the_bytes(tmp_path: Path, change: str):
    folder = make_cubes(tmp_path / "cubes", NAMES[:2])
    before = make_plan(folder, SETTINGS).hash
    assert before == make_plan(folder, SETTINGS).hash
    settings = SETTINGS
    if change == "content":  # of the same size: as when a data set was converted again with another scaling
        write_cube(folder / "boat.tif", cube(values(77), "boat"))
    elif change == "size":
        make_cubes(folder, ("boat",), height=48)
    elif change == "band":
        settings = replace(SETTINGS, min_contrast=0.03)
    elif change == "added":
        make_cubes(folder, ("cat",))
    elif change == "renamed":
        (folder / "boat.tif").rename(folder / "ship.tif")
    else:
        settings = replace(SETTINGS, group="(b)")
    assert make_plan(folder, settings).hash != before


@pytest.mark.parametrize("order", [(1, 2, 3), (3, 1, 2), (2, 2, 1, 3)])
def test_shards_in_any_order_make_the_same_bytes(cubes: Path, store: Path, tmp_path: Path, order: tuple[int, ...]):
    for index in order:
        output = extract_tool(cubes, tmp_path / "out", "--shard", f"{index}/3")
        assert "--resume completes the store" in output
        assert not list((tmp_path / "out").glob("*/manifest.json"))
    extract_tool(cubes, tmp_path / "out", "--resume")
    assert content(tmp_path / "out") == content(store)


def test_resume_completes_shards_that_never_ran(cubes: Path, store: Path, tmp_path: Path):
    extract_tool(cubes, tmp_path / "out", "--shard", "2/4")
    assert verify(tmp_path / "out")[0].endswith("is not finished: go on with kcam data extract --resume.")
    extract_tool(cubes, tmp_path / "out", "--resume")
    assert content(tmp_path / "out") == content(store)


@pytest.mark.parametrize("shard", ["0/2", "3/2", "1", "a/b", "1/0", "-1/2"])
def test_a_wrong_shard_is_a_usage_error(cubes: Path, tmp_path: Path, shard: str):
    assert "is not i/n" in extract_tool(cubes, tmp_path / "out", f"--shard={shard}", status=2)


@pytest.mark.slow
def test_two_workers_make_the_same_bytes(cubes: Path, store: Path, tmp_path: Path):
    extract_tool(cubes, tmp_path / "out", "--workers", 2)
    assert content(tmp_path / "out") == content(store)


def test_other_folders_make_the_same_bytes(cubes: Path, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    shutil.copytree(cubes, tmp_path / "elsewhere")
    for path in (tmp_path / "elsewhere").iterdir():
        os.utime(path, (0, 0))
    monkeypatch.chdir(tmp_path)
    make_store(Path("elsewhere"), Path("here/and/there"))
    assert content(tmp_path / "here" / "and" / "there") == content(store)
    shutil.move("here", "moved")
    assert verify(Path("moved/and/there")) == []
    assert torch.equal(PatchDataset("moved/and/there/val")[3].values, PatchDataset(store / "val")[3].values)


def test_dry_run_writes_nothing(cubes: Path, tmp_path: Path):
    output = extract_tool(cubes, tmp_path / "out", "--dry-run")
    assert "6 scenes" in output
    assert f"at most {6 * 24} patches, {6 * 24 * BANDS * 16 * 16 * 2 / 1e9:.3g} GB" in output
    assert not (tmp_path / "out").exists()
    result = json.loads(extract_tool(cubes, tmp_path / "out", "--dry-run", "--json", "--report", tmp_path / "r.json"))
    assert result["bytes"] == 6 * 24 * BANDS * 16 * 16 * 2
    assert result == json.loads((tmp_path / "r.json").read_text())
    assert sorted(tmp_path.iterdir()) == [tmp_path / "r.json"]


def test_json_says_what_was_done(cubes: Path, tmp_path: Path):
    result = json.loads(extract_tool(cubes, tmp_path / "out", "--json"))
    assert result["done"] == sorted(NAMES)
    assert result["patches"] == 6 * 24
    assert result["finished"]
    assert result["failed"] == {}


def test_the_disk_is_checked_before_anything_is_written(cubes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    needed = make_plan(cubes, SETTINGS).most_bytes
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=needed))
    output = extract_tool(cubes, tmp_path / "out", status=2)
    assert "are needed and" in output
    assert not (tmp_path / "out").exists()
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=int(needed / 0.95) + 1))
    extract_tool(cubes, tmp_path / "out", "--shard", "1/2")
    # half of it is there: what is left to do fits
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=int(0.6 * needed)))
    extract_tool(cubes, tmp_path / "out", "--resume")


def test_a_full_disk_stops_and_resume_goes_on(cubes: Path, store: Path, tmp_path: Path, monkeypatch):
    fsync, calls = os.fsync, []

    def full(number: int) -> None:
        calls.append(number)
        if len(calls) > 4:
            raise OSError(errno.ENOSPC, "No space left on device")
        fsync(number)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        output = extract_tool(cubes, tmp_path / "out", status=1)
    assert "cannot be written: No space left on device. --resume goes on." in output
    assert not list((tmp_path / "out").glob("*/manifest.json"))
    extract_tool(cubes, tmp_path / "out", "--resume")
    assert content(tmp_path / "out") == content(store)


def fail_to_read(name: str, error: Exception, patch: pytest.MonkeyPatch) -> None:
    """The rows of this scene raise an error."""
    opened = planning.open_cube

    def broken(path: Path):
        source = opened(path)

        def rows(first: int, last: int):
            raise error

        return replace(source, rows=rows) if path.stem == name else source

    patch.setattr(planning, "open_cube", broken)


def test_a_disk_that_cannot_be_read_fails_the_scene_alone(cubes: Path, tmp_path: Path, monkeypatch):
    fail_to_read("cat", OSError(errno.EIO, "Input/output error"), monkeypatch)
    assert "failed: cat: rows 0 to 16 cannot be read: OSError: " in extract_tool(cubes, tmp_path / "out", status=1)


def test_ctrl_c_inside_compiled_code_is_no_damage(cubes: Path, store: Path, tmp_path: Path, monkeypatch):
    """There it may end in a SystemError whose cause it is."""
    error = SystemError("returned a result with an exception set")
    error.__cause__ = KeyboardInterrupt()
    with monkeypatch.context() as patch:
        fail_to_read("cat", error, patch)
        assert "interrupted; --resume goes on." in extract_tool(cubes, tmp_path / "out", status=130)
    extract_tool(cubes, tmp_path / "out", "--resume")
    assert content(tmp_path / "out") == content(store)


class Futures:
    """An executor of the simplest kind: its futures run when they are asked."""

    def __init__(self, error: Exception | None = None) -> None:
        self.error = error

    def submit(self, call, *arguments):
        class Future:
            def result(_) -> object:
                if self.error:
                    raise self.error
                return call(*arguments)

        return Future()


def test_another_executor_makes_the_same_bytes(cubes: Path, store: Path, tmp_path: Path):
    make_store(cubes, tmp_path / "out", submit=Futures().submit)
    assert content(tmp_path / "out") == content(store)


def test_a_worker_that_dies_elsewhere_leaves_a_store_to_go_on_with(cubes: Path, store: Path, tmp_path: Path):
    plan = make_plan(cubes, SETTINGS)
    with pytest.raises(StoreStopped, match=r"a worker failed at apple: RuntimeError: killed"):
        extract(plan, tmp_path / "out", submit=Futures(RuntimeError("killed")).submit)
    extract(plan, tmp_path / "out", resume=True)
    assert content(tmp_path / "out") == content(store)


def test_an_absent_scheduler_is_a_usage_error(cubes: Path, tmp_path: Path):
    pytest.importorskip("distributed")
    output = extract_tool(cubes, tmp_path / "out", "--scheduler", "nonsense://x", status=2)
    assert "no Dask scheduler at nonsense://x" in output


@pytest.mark.slow  # starts two processes that import torch
@pytest.mark.filterwarnings("ignore")  # Dask's own, at shutdown
def test_dask_makes_the_same_bytes(cubes: Path, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setenv("PYTHONPATH", str(stores.ROOT))
    monkeypatch.chdir(tmp_path)
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        shutil.copytree(cubes, "cubes")
        make_cubes(Path("cubes"), ("small",), height=15)  # fails in the plan
        extract_tool(Path("cubes"), Path("out"), "--scheduler", cluster.scheduler_address, status=1)
        os.unlink("cubes/small.tif")
        extract_tool(Path("cubes"), Path("again"), "--scheduler", cluster.scheduler_address)
    assert content(tmp_path / "again") == content(store)
    assert {k: v for k, v in content(tmp_path / "out").items() if k.endswith("npy")} == {
        k: v for k, v in content(store).items() if k.endswith("npy")
    }


# ---- verify --------------------------------------------------------------------------------------------------------


@pytest.fixture
def copy(store: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(store, tmp_path / "copy"))


def flip(path: Path, place: int) -> None:
    with path.open("rb+") as file:
        file.seek(place)
        byte = file.read(1)[0]
        file.seek(place)
        file.write(bytes([byte ^ 4]))


def test_a_good_store_is_good(store: Path):
    assert "2 splits, all as written" in call("verify_patches", store)
    assert verify(store / "val") == []
    assert json.loads(call("verify_patches", store, "--json"))["problems"] == []


@pytest.mark.parametrize("place", [20, 130, 5000, -1])
def test_a_flipped_bit_is_found(copy: Path, place: int):
    path = next((copy / "train" / "scenes").iterdir())
    flip(path, place % path.stat().st_size)
    output = call("verify_patches", copy, status=1)
    assert path.name in output


def test_every_flipped_bit_of_a_manifest_is_found(copy: Path):
    path = copy / "val" / "manifest.json"
    whole = path.read_bytes()
    for place in range(0, len(whole), 97):
        flip(path, place)
        if json_or_none(path) != json.loads(whole):  # some bits are white space
            assert verify(copy), place
        path.write_bytes(whole)
    assert verify(copy) == []


def json_or_none(path: Path) -> object:
    try:
        return json.loads(path.read_text())
    except ValueError:
        return None


def test_missing_extra_and_cut_files_are_found(copy: Path):
    first, second, third = sorted((copy / "train" / "scenes").iterdir())[:3]
    first.unlink()
    second.write_bytes(second.read_bytes()[:-2])
    (copy / "val" / "scenes" / "stray.npy").write_bytes(b"x")
    (copy / "note.txt").write_text("x")
    (copy / "run.log").write_text("allowed")
    problems = "\n".join(verify(copy))
    assert first.name in problems
    assert f"{second} has" in problems
    assert third.name not in problems
    assert "stray.npy is in no manifest" in problems
    assert "note.txt is in no manifest" in problems
    assert "run.log" not in problems
    assert len(verify(copy)) == 4


def test_swapped_splits_are_found(copy: Path):
    (copy / "train").rename(copy / "x")
    (copy / "val").rename(copy / "train")
    (copy / "x").rename(copy / "val")
    assert len(verify(copy)) == 2
    assert "holds the split" in call("verify_patches", copy, status=1)


def test_a_scene_that_was_moved_into_the_other_split_is_found(copy: Path):
    paths = {split: copy / split / "manifest.json" for split in ("train", "val")}
    documents = {split: json.loads(path.read_text()) for split, path in paths.items()}
    record = documents["train"]["scenes"].pop(0)
    documents["val"]["scenes"].append(record)
    shutil.move(copy / "train" / record["file"], copy / "val" / record["file"])
    for split, path in paths.items():  # by someone who knows the digest
        path.write_text(json.dumps(documents[split] | {"sha256": digest(documents[split])}))
    assert [p for p in verify(copy) if f"the group {record['group']} stands in val and belongs to train" in p]
    documents["train"]["scenes"].insert(0, record)
    paths["train"].write_text(json.dumps(documents["train"] | {"sha256": digest(documents["train"])}))
    assert [p for p in verify(copy) if f"the group {record['group']} stands in train and in val" in p]


def test_a_lost_split_and_another_plan_are_found(cubes: Path, copy: Path, tmp_path: Path):
    shutil.rmtree(copy / "val")
    assert verify(copy) == [f"{copy / 'val'} has no manifest.json."]
    other = make_store(cubes, tmp_path / "other", replace(SETTINGS, stride=16))
    shutil.copytree(other / "val", copy / "val")
    assert verify(copy) == ["the splits are of different plans."]


def test_what_is_no_store_is_said(tmp_path: Path):
    assert "is no patch store" in call("verify_patches", tmp_path, status=1)
    assert "there is no folder" in call("verify_patches", tmp_path / "absent", status=2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kcam_patches": 99}, "of version 99"),
        ({"dtype": "<f4"}, "does not fit together"),
        ({"patch": [BANDS + 1, 16, 16]}, "does not fit together"),
        ({"scenes": None}, "damaged"),
        ({"mean": [0.0] * BANDS}, "its own sha256 differs"),
    ],
)
def test_a_wrong_manifest_is_refused(copy: Path, change: dict, message: str):
    path = copy / "val" / "manifest.json"
    document = json.loads(path.read_text()) | change
    if "mean" not in change:
        document["sha256"] = digest(document)
    path.write_text(json.dumps(document))
    with pytest.raises(StoreError, match=message):
        PatchDataset(copy / "val")


@pytest.mark.parametrize("file", ["scenes/../../x.npy", "/etc/passwd", "scenes/a/b.npy", "x.npy", "scenes/a\\b.npy"])
def test_a_manifest_cannot_lead_out_of_its_folder(copy: Path, file: str):
    path = copy / "val" / "manifest.json"
    document = json.loads(path.read_text())
    document["scenes"][0]["file"] = file
    path.write_text(json.dumps(document | {"sha256": digest(document)}))
    with pytest.raises(StoreError, match="does not fit together"):
        read_manifest(copy / "val")


# ---- Ctrl-C --------------------------------------------------------------------------------------------------------


@pytest.mark.slow  # three processes that import torch
@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("whole_group", [False, True], ids=["process", "terminal"])
def test_ctrl_c_ends_in_one_line_and_resume_goes_on(tmp_path: Path, workers: int, whole_group: bool):
    folder = make_cubes(tmp_path / "cubes", tuple(f"s{index}" for index in range(12)), height=600, width=600)
    options = ("--size", 64, "--stride", 24, "--split", "1", "--workers", workers, "--out", tmp_path / "out")
    process = stores.start("extract_patches", folder, *options)
    deadline = time.monotonic() + 120
    while not list((tmp_path / "out").glob(".work/done/*.json")) and time.monotonic() < deadline:
        time.sleep(0.02)
    if whole_group:
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    else:
        process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 130, err
    assert (out, stores.quiet(err)) == ("", "extract_patches.py: interrupted; --resume goes on.\n")
    assert not stores.left(process.pid)
    call("extract_patches", folder, *options[:-4], "--out", tmp_path / "out", "--resume")
    whole = make_store(folder, tmp_path / "whole", Settings(size=64, stride=24, split=(("train", 1.0),)))
    assert content(tmp_path / "out") == content(whole)


@pytest.mark.slow  # processes that import torch
@pytest.mark.parametrize("tool", ["extract_patches", "convert_cubes"])
def test_ctrl_c_at_any_moment_is_heard_by_the_parent_alone(tmp_path: Path, tool: str):
    """Also while workers are still loading, which is where most of the moments lie."""
    folder = make_cubes(tmp_path / "cubes", tuple(f"s{index}" for index in range(6)), height=300, width=300)
    options = ("--size", 64, "--stride", 8, "--split", "1") if tool == "extract_patches" else ()
    random = np.random.default_rng(7)
    for index in range(4):
        process = stores.start(tool, folder, *options, "--workers", 2, "--out", tmp_path / f"out{index}")
        while len(stores.running(process.pid)) < 3 and process.poll() is None:
            time.sleep(0.01)  # the parent, what multiprocessing keeps beside it, the first worker
        time.sleep(random.uniform(0, 2))
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGINT)
        _out, err = process.communicate(timeout=300)
        assert process.returncode in (0, 130), err
        assert "Traceback" not in err, err
        assert not stores.left(process.pid)


def test_errors_cross_processes():
    import pickle

    for error in (StoreStopped("a"), CubeError("b")):
        assert str(pickle.loads(pickle.dumps(error))) == str(error)
