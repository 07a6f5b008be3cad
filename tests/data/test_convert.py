"""Many scenes to cube files: the lines of the README, exit status, reports; one bad scene stops no other."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import fuzz
import numpy as np
import pytest
import resident
import stores
import tifffile
import typer
import writers
from commands import invoke

from kcam.cli import console
from kcam.data import convert as module
from kcam.data import parse_bands, read_cube
from kcam.data.bands import resampling
from kcam.data.convert import Conversion, convert
from kcam.units import nm

TOOLS = Path(__file__).parents[2] / "data_tools"


def tool(name: str):
    """A tool's command, as typer.run would make it."""
    import importlib

    import typer

    if str(TOOLS) not in sys.path:
        sys.path.insert(0, str(TOOLS))
    app = typer.Typer(add_completion=False)
    app.command()(importlib.import_module(name).main)
    return app


def run(name: str, *arguments: object, status: int = 0):
    result = invoke(tool(name), *arguments)
    assert result.exit_code == status, result.output
    assert "Traceback" not in result.output
    return result


def convert_cubes(*arguments: object, status: int = 0):
    return run("convert_cubes", *arguments, status=status)


FORMATS = {
    "kaist": ("kaist", []),
    "cave": ("cave", []),
    "icvl": ("icvl", ["--edge", "hold"]),
    "arad1k": ("arad1k", ["--edge", "hold"]),
    "harvard": ("harvard", []),
    "cassi28": ("cassi HSI", ["--edge", "hold"]),
    "envi": ("envi bil u2 little", ["--edge", "hold"]),
    "npz": ("npz", ["--edge", "hold"]),
    "tiff": ("tiff pages u2", ["--profile", "cave31", "--edge", "hold"]),
}


@pytest.mark.parametrize("inside", [(), ("notes.txt",), ("sub",), (".hidden.npz",)])
def test_a_folder_without_scenes_is_a_failure(inside: tuple[str, ...], tmp_path: Path) -> None:
    """Alone, and beside one that has scenes, which are converted."""
    empty, full = tmp_path / "empty", tmp_path / "full"
    empty.mkdir()
    full.mkdir()
    for name in inside:
        (empty / name).mkdir() if name == "sub" else (empty / name).write_text("")
    report = convert([empty], tmp_path / "out")
    assert report.failed == {str(empty): report.failed[str(empty)]}
    assert "there is no scene in it: expected .exr, .mat" in report.failed[str(empty)]
    writers.npz(full)
    report = convert([empty, full], tmp_path / "out")
    assert len(report.written) == 1
    assert list(report.failed) == [str(empty)]
    result = stores.call("convert_cubes", empty, "--out", tmp_path / "cubes", status=1)
    assert f"failed: {empty}: there is no scene in it" in result


@pytest.mark.parametrize("name", sorted(path.stem for path in stores.TOOLS.glob("*_*.py")))
def test_help_prints_what_was_written(name: str) -> None:
    """[m], [pixels] and kcam[dask] are no markup."""
    app = console.command(stores.tool(name).main)
    printed = invoke(app, "--help").output.replace("\u2502", " ")
    command: Any = typer.main.get_command(app)
    for sentence in (command.help, *(getattr(parameter, "help", None) for parameter in command.params)):
        assert "".join((sentence or "").split()) in "".join(printed.split())


@pytest.mark.parametrize("name", FORMATS)
def test_the_line_of_the_issue_for_each_format(name: str, tmp_path: Path) -> None:
    writer, more = FORMATS[name]
    (tmp_path / "in").mkdir()
    written = (writers.ALL | writers.TIFFS)[writer](tmp_path / "in")
    if name == "cave":
        more = ["--edge", "hold"]
    out = tmp_path / "cubes"
    result = convert_cubes(written.path, "--format", name, "--bands", "420:720:28", "--out", out, *more)
    cubes = list(out.iterdir())
    assert len(cubes) == 1
    assert result.stdout.splitlines()[-1] == f"1 cubes in {out}"
    cube = read_cube(cubes[0])
    target = parse_bands("420:720:28")
    np.testing.assert_allclose(cube.wavelengths.numpy(), target, atol=1e-6 * nm)
    assert cube.unit == written.unit
    assert cube.source["format"] == name
    assert cube.source["resampled"] == f"pchip from {len(written.nm)} bands"
    outside = (target < min(written.nm) * nm - 0.1 * nm) | (target > max(written.nm) * nm + 0.1 * nm)
    guessed = ~cube.mask.numpy().any((1, 2)) if cube.mask is not None else np.zeros(28, bool)
    assert (guessed == outside).all()
    if outside.any():
        assert f"{outside.sum()} bands extrapolated and marked" in result.stdout
    matrix = resampling(np.asarray(written.nm) * nm, target, edge="hold").matrix
    mask = np.ones(cube.shape[1:], bool) if written.mask is None else written.mask
    expected = np.einsum("ts,shw->thw", matrix, written.values)
    np.testing.assert_allclose(cube.values.numpy()[:, mask], expected[:, mask], atol=2e-6)  # float32


def test_extrapolation_is_refused_unless_asked_for(tmp_path: Path) -> None:
    path = writers.cassi(tmp_path).path
    result = convert_cubes(path, "--bands", "420:720:28", "--out", tmp_path / "out", status=1)
    assert "failed:" in result.stderr
    assert "11 of 28 bands lie outside" in result.stderr
    assert result.stderr.count("\n") == 1
    assert not list((tmp_path / "out").iterdir())
    result = convert_cubes(path, "--bands", "420:720:28", "--edge", "hold", "--out", tmp_path / "out")
    assert "11 bands extrapolated and marked" in result.stdout


def photographs(folder: Path) -> Path:
    folder.mkdir()
    random = np.random.default_rng(0)
    for name in ("one", "two"):
        cv2.imwrite(str(folder / f"{name}.png"), random.integers(0, 256, (9, 14, 3), np.uint8))
    return folder


def test_photographs_with_and_without_depth(tmp_path: Path) -> None:
    photos = photographs(tmp_path / "photos")
    result = convert_cubes(photos, "--out", tmp_path / "a", status=1)
    assert result.stderr.count("format is not recognised") == 2
    convert_cubes(photos, "--format", "rgb", "--bands", "420:720:31", "--out", tmp_path / "a")
    assert read_cube(tmp_path / "a" / "one.tif").shape == (31, 9, 14)
    assert read_cube(tmp_path / "a" / "one.tif").depth is None
    depths = tmp_path / "depths"
    depths.mkdir()
    np.save(depths / "one.npy", np.full((9, 14), 1.25))
    np.save(depths / "two.npy", np.zeros((9, 14)))
    result = convert_cubes(photos, "--format", "rgb", "--depth", depths, "--out", tmp_path / "b", status=1)
    assert (read_cube(tmp_path / "b" / "one.tif").depth == 1.25).all()
    assert r"two.npy must be (H,W), all above 0 m" in result.stderr
    (depths / "two.npy").write_bytes(np.array([object()]).dumps())  # a pickle
    result = convert_cubes(photos, "--format", "rgb", "--depth", depths, "--out", tmp_path / "b", status=1)
    assert "two.npy cannot be read" in result.stderr
    (depths / "two.npy").unlink()
    result = convert_cubes(photos, "--format", "rgb", "--depth", depths, "--out", tmp_path / "b", status=1)
    assert "there is no depth map two.npy" in result.stderr
    np.save(depths / "two.npy", np.ones((3, 3)))
    result = convert_cubes(photos, "--format", "rgb", "--depth", depths, "--out", tmp_path / "b", status=1)
    assert "depth map is (3, 3), the photograph (9, 14)" in result.stderr


def mixed(folder: Path) -> Path:
    """Four scenes of four formats in folders, and four bad ones."""
    for name in ("a", "b", "c", "d"):
        (folder / name).mkdir(parents=True)
    writers.kaist(folder / "a")
    writers.cave(folder / "b")
    writers.icvl(folder / "c")
    writers.harvard(folder / "d")
    (folder / "a" / "empty.exr").write_bytes(b"")
    (folder / "c" / "bomb.npz").write_bytes(fuzz._npz_with(folder, fuzz._head_of("(31, 316227, 316227)")).read_bytes())
    (folder / "a.npz").unlink()
    (folder / "d" / "other.mat").write_bytes(b"MATLAB 5.0" + bytes(200))
    (folder / "readme.txt").write_text("not a scene")
    np.savez(folder / "c" / "objects.npz", cube=np.array([[[None]]]))
    return folder


GOOD = ["img1", "lst_0924-1015", "scene_kaist", "toy_ms"]
BAD = ["bomb.npz", "empty.exr", "objects.npz", "other.mat"]


def test_folders_of_scenes_with_bad_ones_between_them(tmp_path: Path) -> None:
    out = tmp_path / "cubes"
    out.mkdir()
    (out / "older.tif").write_bytes(b"of another day")
    (out / "toy_ms.tif").write_bytes(b"is replaced")
    report = tmp_path / "reports" / "report.json"
    folder = mixed(tmp_path / "in")
    result = convert_cubes(folder, "--out", out, "--report", report, status=1)
    assert sorted(path.stem for path in out.iterdir()) == sorted([*GOOD, "older"])
    assert (out / "older.tif").read_bytes() == b"of another day"
    np.testing.assert_allclose(read_cube(out / "toy_ms.tif").values.numpy(), writers.cube(31), atol=1e-5)  # 16 bits
    skipped, *lines = result.stderr.splitlines()
    assert skipped.startswith(f"skipped: {folder / 'readme.txt'}: it is no cube: its name ends in none of .exr, .mat")
    assert [Path(line.split(": ")[1]).name for line in lines] == sorted(BAD, key=lambda n: str(next(folder.rglob(n))))
    assert all(line.startswith("failed: ") for line in lines)
    assert [line.split(":")[0] for line in result.stdout.splitlines()] == [
        "scene_kaist", "toy_ms", "lst_0924-1015", "img1", f"4 cubes in {out}"
    ]  # fmt: skip
    document = json.loads(report.read_text())
    assert sorted(facts["name"] for facts in document["written"].values()) == GOOD
    assert sorted(Path(path).name for path in document["failed"]) == BAD
    assert list(document["skipped"]) == [str(folder / "readme.txt")]
    harvard = next(facts for facts in document["written"].values() if facts["name"] == "img1")
    assert harvard["shape"] == [31, 12, 17]
    assert harvard["invalid"] == pytest.approx(10 / (12 * 17))  # lbl is 0 on 2 x 5 pixels


def test_json_for_scripts(tmp_path: Path) -> None:
    result = convert_cubes(mixed(tmp_path / "in"), "--out", tmp_path / "out", "--json", status=1)
    document = json.loads(result.stdout)
    assert sorted(facts["name"] for facts in document["written"].values()) == GOOD
    assert sorted(Path(path).name for path in document["failed"]) == BAD


def test_no_wavelengths_then_a_profile_then_a_grid(tmp_path: Path) -> None:
    path = writers.tiff(tmp_path).path
    result = convert_cubes(path, "--out", tmp_path / "out", status=1)
    assert "31 bands and no wavelengths" in result.stderr
    convert_cubes(path, "--profile", "harvard31", "--out", tmp_path / "out")
    np.testing.assert_allclose(read_cube(tmp_path / "out" / path.name).wavelengths.numpy(), parse_bands("420:720:31"))
    convert_cubes(path, "--wavelengths", "400:700:31", "--out", tmp_path / "out")
    np.testing.assert_allclose(read_cube(tmp_path / "out" / path.name).wavelengths.numpy(), parse_bands("400:700:31"))
    result = convert_cubes(path, "--profile", "cassi28", "--out", tmp_path / "out", status=1)
    assert "31 bands, but 28 wavelengths" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--format", "x"], "--format x is unknown; known: kcam, kaist"),
        (["--resample", "x"], "--resample x is unknown; known: pchip, cubic"),
        (["--edge", "x"], "--edge x is unknown; known: error, hold"),
        (["--bands", "420"], "bands '420' is not start:stop:count"),
        (["--bands", "1:2:2"], "outside 1e-07..2e-05 m"),
        (["--profile", "x"], "unknown profile 'x'; known: cassi28"),
        (["--profile", "cave31", "--wavelengths", "400:700:31"], "say the same thing"),
    ],
)
def test_wrong_calls(arguments: list[str], text: str, tmp_path: Path) -> None:
    result = convert_cubes(tmp_path, "--out", tmp_path / "out", *arguments, status=2)
    assert text in result.stderr
    assert result.stderr.count("\n") == 1


def test_wrong_calls_without_files(tmp_path: Path) -> None:
    convert_cubes("--out", tmp_path / "out", status=2)
    convert_cubes(tmp_path, status=2)
    (tmp_path / "file").write_text("")
    assert "is a file, expected a folder" in convert_cubes(tmp_path, "--out", tmp_path / "file", status=2).stderr
    result = convert_cubes(tmp_path / "none", "--out", tmp_path / "out", status=1)
    assert "no file or folder" in result.stderr


def test_two_inputs_of_one_name(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        writers.npz(tmp_path / folder)
    first = tmp_path / "a" / "arr_cube_nm.npz"
    result = convert_cubes(tmp_path / "a", tmp_path / "b", first, "--out", tmp_path / "out", status=1)
    skipped, failed = result.stderr.splitlines()  # the same file twice is no failure
    assert skipped == f"skipped: {first}: it is named twice."
    assert failed == f"failed: {tmp_path / 'b' / first.name}: another input is called arr_cube_nm too: {first}."
    assert len(list((tmp_path / "out").iterdir())) == 1


def test_a_cube_converted_again_is_the_same(tmp_path: Path) -> None:
    convert_cubes(writers.icvl(tmp_path).path, "--out", tmp_path / "a")
    convert_cubes(tmp_path / "a", "--out", tmp_path / "b")
    (a,), (b,) = (list((tmp_path / name).iterdir()) for name in "ab")
    assert a.read_bytes() == b.read_bytes()
    convert_cubes(tmp_path / "a", "--out", tmp_path / "a")  # in place
    assert a.read_bytes() == b.read_bytes()


def test_cubes_hold_no_path_and_no_time(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        writers.harvard(tmp_path / name)
        convert_cubes(tmp_path / name, "--out", tmp_path / name / "out")
    one, two = ((tmp_path / name / "out" / "img1.tif").read_bytes() for name in ("one", "two"))
    assert one == two
    assert str(tmp_path).encode() not in one


def test_the_disk_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tifffile, "memmap", full)
    report = convert([writers.npz(tmp_path).path], tmp_path / "out")
    assert list(report.failed.values()) == ["OSError: No space left on device"]
    assert not list((tmp_path / "out").iterdir())


def test_a_reader_that_runs_wild_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for error, text in ((MemoryError(), "does not fit into memory"), (RuntimeError("a\nb"), "RuntimeError: a")):
        monkeypatch.setattr(module, "open_source", lambda *_, error=error, **__: (_ for _ in ()).throw(error))
        report = convert([writers.npz(tmp_path).path], tmp_path / "out")
        (line,) = report.failed.values()
        assert text in line
        assert "\n" not in line


def _process(*arguments: object) -> subprocess.CompletedProcess[str]:
    """As a user calls it: another process, no terminal."""
    environment = os.environ | {"PYTHONPATH": str(TOOLS.parent), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(TOOLS / "convert_cubes.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120, check=False)


@pytest.mark.slow
def test_as_a_process_it_is_quiet_without_a_terminal(tmp_path: Path) -> None:
    written = writers.kaist(tmp_path)
    (tmp_path / "bad.npz").write_bytes(b"no")
    done = _process(tmp_path, "--bands", "420:720:28", "--out", tmp_path / "cubes")
    assert done.returncode == 1
    name = written.path.stem
    assert done.stdout.splitlines()[0].startswith(f"{name}: 28 x 12 x 17, ")
    assert stores.quiet(done.stderr).splitlines() == [
        f"failed: {tmp_path / 'bad.npz'}: it cannot be read as npz: BadZipFile: File is not a zip file"
    ]
    assert "\x1b" not in done.stdout + done.stderr


@pytest.mark.slow
def test_two_workers_write_the_same_bytes(tmp_path: Path) -> None:
    folder = mixed(tmp_path / "in")
    for workers in (1, 2):
        done = _process(folder, "--out", tmp_path / str(workers), "--workers", workers)
        assert done.returncode == 1, done.stderr
        assert len(re.findall(r"^failed: ", done.stderr, re.MULTILINE)) == len(BAD)
    for name in GOOD:
        assert (tmp_path / "1" / f"{name}.tif").read_bytes() == (tmp_path / "2" / f"{name}.tif").read_bytes()


def _crash(path: Path, out: Path, how: Conversion) -> str | dict[str, Any]:
    if path.stem == "bad":
        os.kill(os.getpid(), 11)
    time.sleep(0.5)  # when the process dies, none of the others is done
    return {"name": path.stem}


@pytest.mark.slow
def test_a_library_that_crashes_takes_one_scene_along(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "convert_one", _crash)
    for name in ("bad", "c", "d"):
        (tmp_path / f"{name}.npz").write_bytes(b"x")
    report = convert([tmp_path], tmp_path / "out", workers=2)
    assert sorted(facts["name"] for facts in report.written.values()) == ["c", "d"]
    assert report.failed == {str(tmp_path / "bad.npz"): "reading it crashed the process: it is damaged."}


_PEAK = """
import sys
from kcam.data import parse_bands
from kcam.data.convert import Conversion, convert
from resident import peak
import scipy.interpolate  # which is imported when it is used
base = peak()
report = convert([sys.argv[1]], sys.argv[2], Conversion(bands=parse_bands("420:720:28")))
assert not report.failed, report.failed
print((peak() - base) / 1e6)
"""


@resident.on_linux
@pytest.mark.slow
def test_memory_is_bounded_by_strips_of_a_large_exr(tmp_path: Path) -> None:
    """A KAIST scene of full size, 31 x 2704 x 3376: 1.1 GB as float32, and 0.3 GB of halves in its file."""
    import OpenEXR

    base = np.random.default_rng(0).random((2704, 3376), dtype=np.float32).astype(np.float16) / 2
    channels = {f"w{wavelength}nm": base + np.float16(wavelength / 10000) for wavelength in writers.GRID_420}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(str(tmp_path / "a.exr"))
    del channels
    environment = os.environ | {"PYTHONPATH": resident.PATH, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", _PEAK, str(tmp_path / "a.exr"), str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < 400  # MB above the imports; measured 225: strips of 64 MB, read and resampled
