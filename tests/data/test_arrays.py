"""Arrays of any data set: npy, npz, HDF5 and MATLAB, with axes in any order, and the commands that read them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from commands import invoke, run
from scipy.io import savemat
from stores import content, tool
from writers import _matlab73, cube

from kcam import cli
from kcam.cli import console
from kcam.cli import data as commands
from kcam.data import FORMATS, PROFILES, CubeError, PatchDataset, StoreError, make_plan, read_cube, verify
from kcam.data.patches import Settings
from kcam.data.readers import Options, open_source
from kcam.units import nm

GRID = np.linspace(410, 690, 7)
CONTAINERS = ("npy", "npz", "h5", "hdf5", "mat 7.3", "mat 5")
DTYPES = ("<u1", "<u2", ">u2", "<i2", "<i4", "<f2", "<f4", ">f4", "<f8")
SCALE = {"u1": 255, "u2": 65535, "i2": 1, "i4": 1, "f2": 1, "f4": 1, "f8": 1}


def stored(values: np.ndarray, dtype: str) -> tuple[np.ndarray, np.ndarray]:
    """An array of a type, and the values that it stands for."""
    scale = SCALE[dtype[1:]]
    counts = values * (scale if scale > 1 else 1000) if dtype[1] != "f" else values
    array = (np.rint(counts) if dtype[1] != "f" else counts).astype(dtype)
    return array, array.astype(np.float64) / scale


def write(folder: Path, container: str, arrays: dict[str, np.ndarray], name: str = "a") -> Path:
    """Arrays in a container, by another library; an npy holds the first."""
    path = folder / f"{name}.{container.split()[0]}"
    if container == "npy":
        np.save(path, next(iter(arrays.values())))
    elif container == "npz":
        np.savez(path, **arrays)
    elif container == "mat 7.3":
        _matlab73(path, arrays)
    elif container == "mat 5":
        savemat(path, arrays)
    else:
        with h5py.File(path, "w") as file:
            for key, array in arrays.items():
                file[key] = array
    return path


@pytest.mark.parametrize("seed", range(60))
def test_any_order_of_axes_in_any_type_and_container(seed: int, tmp_path: Path) -> None:
    random = np.random.default_rng(seed)
    container, dtype = CONTAINERS[seed % len(CONTAINERS)], str(random.choice(DTYPES))
    axes = "".join(random.permutation(list("hwc")))
    height, width, bands = (int(size) for size in random.integers(2, 9, 3))
    array, expected = stored(random.uniform(0.05, 0.95, (bands, height, width)), dtype)
    array = array.transpose(["chw".index(letter) for letter in axes])
    if random.integers(2) and container != "mat 7.3":
        array = np.asfortranarray(array)
    if random.integers(2):
        array = array[None]
    grid = random.permutation(np.linspace(420, 700, bands))
    arrays, how = {"cube": array}, {"axes": axes.upper() if seed % 5 == 0 else axes}
    if container != "npy" and random.integers(2):
        arrays |= {
            "other": array[..., :1],
            "flat": np.ones((3, 2)),
            "wavelengths": grid * random.choice([1, 1e-3, 1e-9]),
        }
        how["key"] = "cube"
    else:
        how["wavelengths"] = grid * nm
    path = write(tmp_path, container, arrays)
    found = read_cube(path, **how)
    np.testing.assert_allclose(found.values.numpy(), expected, rtol=1e-6)
    np.testing.assert_allclose(found.wavelengths.numpy() / nm, grid, rtol=1e-9)
    assert found.source["orientation"] == f"axes {axes}"
    assert found.source["format"] == {"h5": "hdf5", "mat 7.3": "hdf5", "mat 5": "mat"}.get(container, container)
    source = open_source(path, options=Options(grid * nm, how.get("key"), axes=axes))
    first, last = sorted(random.choice(height + 1, 2, replace=False))
    assert (source.checked_rows(first, last)[0] == found.values.numpy()[:, first:last]).all()


@pytest.mark.parametrize("container", CONTAINERS)
def test_axes_are_known_where_one_end_is_as_long_as_the_wavelengths(container: str, tmp_path: Path) -> None:
    values = cube(7, 4, 5)
    for axes in ("hwc", "chw"):
        path = write(tmp_path, container, {"x": values.transpose(["chw".index(letter) for letter in axes])})
        np.testing.assert_allclose(read_cube(path, wavelengths=GRID * nm).values.numpy(), values, rtol=1e-6)
    path = write(tmp_path, container, {"x": values.transpose(1, 0, 2)})
    text = (
        "4 bands, but 7 wavelengths"
        if container == "npz"
        else r"which axis is which is not known: 1 is as long .*--axes"
    )
    with pytest.raises(CubeError, match=text):
        read_cube(path, wavelengths=GRID * nm)


def test_an_order_that_is_not_known_is_asked_for(tmp_path: Path) -> None:
    path = write(tmp_path, "npy", {"x": np.ones((7, 5, 7))})
    with pytest.raises(CubeError, match="7 x 5 x 7, and which axis is which is not known: 2 are as long .*--axes hwc"):
        read_cube(path, wavelengths=GRID * nm)
    assert read_cube(path, wavelengths=GRID * nm, axes="hwc").shape == (7, 7, 5)
    with pytest.raises(
        CubeError, match="its 'array' is 7 x 5 x 7, and it has no wavelengths. Say which: --wavelengths"
    ):
        read_cube(path)
    with pytest.raises(CubeError, match="7 bands and no wavelengths. Say which: --wavelengths start:stop:count in nm"):
        read_cube(path, axes="hwc")
    with pytest.raises(CubeError, match="none of its axes is as long as there are wavelengths, 4"):
        read_cube(path, wavelengths=GRID[:4] * nm)
    with pytest.raises(CubeError, match="5 bands, but 7 wavelengths .*7 x 5 x 7, read as hcw. Are --axes right?"):
        read_cube(path, wavelengths=GRID * nm, axes="hcw")
    for axes in ("hw", "hwl", "hhwc", ""):
        with pytest.raises(ValueError, match=rf"axes '{axes}' are not the letters h, w and c .*such as hwc or chw"):
            read_cube(path, wavelengths=GRID * nm, axes=axes)
    with pytest.raises(CubeError, match="one array without a name, and 'x' is asked for. Leave --key out"):
        read_cube(path, wavelengths=GRID * nm, key="x")


@pytest.mark.parametrize("container", [name for name in CONTAINERS if name != "npy"])
def test_the_key_is_asked_for_and_what_there_is_is_listed(container: str, tmp_path: Path) -> None:
    whole, picture = cube(7, 4, 5).transpose(1, 2, 0), np.ones((4, 5))
    path = write(tmp_path, container, {"one": whole, "two": whole, "flat": picture})
    how = {"wavelengths": GRID * nm}
    with pytest.raises(
        CubeError, match=r"2 arrays of three axes. Say which .*--key (one|two) or another: flat \(4 x 5\), one"
    ):
        read_cube(path, **how)
    with pytest.raises(CubeError, match=r"no array 'three', only flat \(4 x 5\), one \(4 x 5 x 7\), two \(4 x 5 x 7\)"):
        read_cube(path, key="three", **how)
    with pytest.raises(CubeError, match="its 'flat' is 4 x 5, expected an array of numbers with three axes"):
        read_cube(path, key="flat", **how)
    np.testing.assert_allclose(read_cube(path, key="two", **how).values.numpy(), whole.transpose(2, 0, 1), rtol=1e-6)
    path = write(tmp_path, container, {"flat": picture})
    with pytest.raises(CubeError, match=r"no array of numbers with three axes, as a cube has, only flat \(4 x 5\)"):
        read_cube(path, **how)
    path = write(tmp_path, container, {f"p{index}": picture for index in range(40)})
    with pytest.raises(CubeError, match=r"p19 \(4 x 5\), and 28 more"):
        read_cube(path, **how)


@pytest.mark.parametrize(
    "array", [np.ones((4, 5)), np.ones((2, 7, 4, 5)), np.ones((7, 4, 5), bool), np.ones((7, 4, 5), "c8")]
)
def test_what_is_no_cube(array: np.ndarray, tmp_path: Path) -> None:
    for container in ("npy", "npz", "h5"):
        with pytest.raises(CubeError, match="array of numbers with three axes"):
            read_cube(write(tmp_path, container, {"x": array}), wavelengths=GRID * nm, axes="chw")


def test_nan_is_masked_and_nothing_but_nan_is_refused(tmp_path: Path) -> None:
    values = cube(7, 4, 5)
    values[2, 1, 3] = np.nan
    found = read_cube(write(tmp_path, "npy", {"x": values}), wavelengths=GRID * nm)
    assert (~found.mask).nonzero()[:, 1:].unique(dim=0).tolist() == [[1, 3]]
    with pytest.raises(CubeError, match="no valid pixel: all are NaN"):
        read_cube(write(tmp_path, "npy", {"x": values * np.nan}), wavelengths=GRID * nm)
    with pytest.raises(CubeError, match="wavelengths are empty, not finite or not positive"):
        read_cube(write(tmp_path, "npz", {"x": values, "wavelengths": GRID * np.nan}))


def test_a_damaged_npy_is_one_line(tmp_path: Path) -> None:
    path = write(tmp_path, "npy", {"x": cube(7, 4, 5)})
    whole = path.read_bytes()
    for damaged in (whole[:-1], whole + b"x"):
        path.write_bytes(damaged)
        with pytest.raises(CubeError, match=rf"it has {len(damaged)} bytes, and its header promises {len(whole)}"):
            read_cube(path, wavelengths=GRID * nm)
    path.write_bytes(whole[:20])
    with pytest.raises(CubeError, match="it cannot be read as npy"):
        read_cube(path, wavelengths=GRID * nm)
    np.save(path, np.array([[[None]]]), allow_pickle=True)
    with pytest.raises(CubeError, match="no real numbers"):
        read_cube(path, wavelengths=GRID * nm)


def test_hdf5_in_groups_and_never_beyond_its_own_file(tmp_path: Path) -> None:
    values = cube(7, 4, 5).astype("f4")
    write(tmp_path, "h5", {"x": values}, "other")
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("deep/er/cube", data=values, chunks=(7, 2, 2), compression="gzip")
        file["deep/er/wavelengths"] = GRID
        file["wavelengths"] = GRID + 1
        file["outside"] = h5py.ExternalLink("other.h5", "/")
        file["soft"] = h5py.SoftLink("/deep/er/cube")
    for key in (None, "deep/er/cube", "/deep/er/cube"):
        found = read_cube(path, key=key)
        assert (found.values.numpy() == values).all()
        np.testing.assert_allclose(found.wavelengths.numpy() / nm, GRID)  # of its own group
    for key in ("outside/x", "soft"):
        with pytest.raises(CubeError, match="link to elsewhere"):
            read_cube(path, key=key)
    with pytest.raises(CubeError, match=r"no array 'deep', only deep/er/cube \(7 x 4 x 5\)"):
        read_cube(path, key="deep")


def test_a_data_set_of_known_layout_may_be_read_as_an_array(tmp_path: Path) -> None:
    """ICVL's axes are its own; who names others reads numbers as they are."""
    values = cube(7, 4, 5)
    path = write(tmp_path, "mat 7.3", {"rad": values.transpose(1, 2, 0) * 4095, "bands": GRID[None]})
    assert read_cube(path).source["format"] == "icvl"
    found = read_cube(path, axes="hwc", key="rad")
    assert found.source["format"] == "hdf5"
    np.testing.assert_allclose(found.values.numpy(), values * 4095, rtol=1e-6)
    with pytest.raises(CubeError, match="format icvl has axes of its own, and --axes are named. .*npy, npz, hdf5, mat"):
        read_cube(path, axes="hwc", format="icvl")


# ---- the commands --------------------------------------------------------------------------------------------------


def test_the_help_names_what_there_is() -> None:
    assert ", ".join(FORMATS) == commands.FORMATS_HELP
    assert ", ".join(PROFILES) == commands.PROFILES_HELP
    assert {name for name, row in FORMATS.items() if row.free} == {"npy", "npz", "hdf5", "mat"}


HOW = ("--wavelengths", "410:690:7")


def scenes(folder: Path, axes: str = "wch", names: tuple[str, ...] = ("apple", "boat", "cat", "gate")) -> Path:
    folder.mkdir()
    for seed, name in enumerate(names):
        values = np.random.default_rng(seed).uniform(0.1, 0.9, (7, 20, 24)).astype("f4")
        values[:, 10, 12] = 1
        np.save(folder / f"{name}.npy", values.transpose(["chw".index(letter) for letter in axes]))
    return folder


def document(*arguments: object, status: int = 0) -> dict[str, Any]:
    """What a command gives to scripts."""
    result = invoke(cli.app, "data", *arguments)
    assert result.exit_code == status, result.output
    return json.loads(result.stdout)


@pytest.mark.slow
def test_arrays_are_converted_looked_at_and_cut(tmp_path: Path) -> None:
    folder = scenes(tmp_path / "in")
    (folder / "notes.txt").write_text("")
    assert "which axis is which is not known" in run("data", "convert", folder, "--out", tmp_path / "x", *HOW, status=1)
    how = (*HOW, "--axes", "wch")
    output = run("data", "convert", folder, "--out", tmp_path / "cubes", *how)
    assert "apple: 7 x 20 x 24, 0.1 to 1" in output
    assert f"skipped: {folder / 'notes.txt'}: it is no cube" in output
    facts = document("inspect", folder, "--out", tmp_path / "look", "--json", *how)
    assert [fact["shape"] for fact in facts["cubes"]] == [[7, 20, 24]] * 4
    assert list(facts["skipped"]) == [str(folder / "notes.txt")]
    cut = ("--size", 8, "--stride", 8, "--split", "0.6/0.4")
    run("data", "extract", tmp_path / "cubes", "--out", tmp_path / "one", *cut)
    output = run("data", "extract", folder, "--out", tmp_path / "two", *cut, *how, "--workers", 2)
    assert "skipped: notes.txt: it is no cube: expected files that end in .tif, .npy" in output
    arrays = [
        {key: value for key, value in content(tmp_path / name).items() if "npy" in key} for name in ("one", "two")
    ]
    assert arrays[0] == arrays[1]
    assert len(arrays[0]) == 4
    assert verify(tmp_path / "two") == []
    assert len(PatchDataset(tmp_path / "two" / "train")) > 0
    for other in ("hcw", "wch"):
        output = run("data", "extract", folder, "--out", tmp_path / "two", *cut, *HOW, "--axes", other, "--resume",
                     status=2 if other == "hcw" else 0)  # fmt: skip
    assert "is finished already" in output
    assert "skipped: apple: it was done by an earlier run." in output


def test_what_decides_how_an_array_is_read_decides_the_plan(tmp_path: Path) -> None:
    folder = scenes(tmp_path / "in", names=("apple",))
    np.save(folder / "apple.npy", np.random.default_rng(0).uniform(0.1, 1, (7, 20, 20)))  # square
    settings = Settings(size=8, stride=8, split=(("train", 1.0),))
    plans = set()
    for axes in ("chw", "cwh"):
        how = commands._readers(folder, Options(GRID * nm, axes=axes))
        plans.add(make_plan(folder, settings, **how).hash)
    assert len(plans) == 2


def test_cubes_beside_arrays(tmp_path: Path) -> None:
    """What is no cube file is passed over, until a user says how it is read; of two of one name the second fails."""
    folder = scenes(tmp_path / "in", "chw")
    cut = ("--size", 8, "--stride", 8, "--split", "1", "--dry-run", "--json")
    run("data", "convert", folder / "apple.npy", folder / "boat.npy", "--out", folder, *HOW)
    plan = document("extract", folder, "--out", tmp_path / "x", *cut)
    assert plan["scenes"] == 2
    assert plan["skipped"].keys() == {"apple.npy", "boat.npy", "cat.npy", "gate.npy"}
    plan = document("extract", folder, "--out", tmp_path / "x", *cut, *HOW, status=1)
    assert plan["scenes"] == 4
    assert plan["failed"] == {f"{name}.tif": f"another file here is called {name} too." for name in ("apple", "boat")}
    with pytest.raises(StoreError, match=r"no cubes \(.tif\) in .*Make some with kcam data convert"):
        make_plan(scenes(tmp_path / "arrays"), Settings())


def test_one_array_is_cut_and_one_without_axes_says_what_it_lacks(tmp_path: Path) -> None:
    path = scenes(tmp_path / "in", "hwc") / "apple.npy"
    cut = ("--size", 8, "--stride", 8, "--split", "1", "--dry-run")
    assert "1 scenes (1 train)" in run("data", "extract", path, "--out", tmp_path / "x", *cut, *HOW)
    output = run("data", "extract", path, "--out", tmp_path / "x", *cut, status=2)
    assert "its 'array' is 20 x 24 x 7, and it has no wavelengths. Say which: --wavelengths" in output
    output = run("data", "extract", path, "--out", tmp_path / "x", *cut, "--axes", "xyz", status=2)
    assert output.startswith("kcam: axes 'xyz' are not the letters h, w and c")


def test_the_first_ten_that_are_passed_over_are_named(tmp_path: Path) -> None:
    folder = scenes(tmp_path / "in", "hwc")
    for index in range(25):
        (folder / f"{index:02}.txt").write_text("")
        (folder / f"{index:02}.npz").write_text("")
    output = run("data", "convert", folder, "--out", tmp_path / "a", "--report", tmp_path / "a.json", *HOW, status=1)
    lines = output.splitlines()
    for word in ("skipped", "failed"):
        named = [line for line in lines if line.startswith(f"{word}: {folder}")]
        assert len(named) == 10
        assert f"{word}: and 15 more, which --json names" in lines
    found = json.loads((tmp_path / "a.json").read_text())
    assert len(found["skipped"]) == len(found["failed"]) == 25


def test_depth_maps_are_no_cubes(tmp_path: Path) -> None:
    folder = scenes(tmp_path / "in", "hwc", ("apple",))
    (folder / "depths").mkdir()
    np.save(folder / "depths" / "apple.npy", np.ones((20, 24)))
    run("data", "convert", folder, "--depth", folder / "depths", "--out", tmp_path / "a", *HOW)
    output = run("data", "convert", folder, "--out", tmp_path / "b", *HOW, status=1)
    assert f"failed: {folder / 'depths' / 'apple.npy'}: " in output


# ---- the scripts ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", [False, True])
def test_scripts_and_subcommands_give_the_same(wrong: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same options, files, output and exit status."""
    results: list[list[object]] = [[], []]
    for place, (folder, kept) in enumerate(zip(("one", "two"), results, strict=True)):
        (tmp_path / folder).mkdir()
        monkeypatch.chdir(tmp_path / folder)
        scenes(Path("in"), "hwc")
        Path("in/notes.txt").write_text("")
        Path("in/bad.npz").write_text("")
        how = ("--wavelengths", "410:690:8" if wrong else "410:690:7")
        calls = (
            ("convert", "convert_cubes", "in", "--out", "cubes", "--report", "report.json", *how),
            ("convert", "convert_cubes", "in", "--out", "cubes", "--json", *how),
            ("inspect", "inspect_cubes", "cubes", "--out", "look", "--json"),
            ("extract", "extract_patches", "cubes", "--out", "store", "--size", 8, "--stride", 8, "--split", "0.6/0.4"),
            ("extract", "extract_patches", "cubes", "--out", "store", "--size", 9, "--resume", "--json"),
            ("verify", "verify_patches", "store", "--json"),
            ("export", "export_patches", "store/train", "--out", "train.h5"),
        )
        for command, script, *arguments in calls:
            app = cli.app if place else console.command(tool(script).main)
            words = ["data", command, *arguments] if place else arguments
            result = invoke(app, *words)
            assert "Traceback" not in result.output
            kept += [command, result.exit_code, result.stdout, result.stderr]
        kept += [content(Path()), [code for code in kept if isinstance(code, int)]]
    assert results[0] == results[1]
    assert results[0][-1] == ([1, 1, 2, 2, 2, 2, 2] if wrong else [1, 1, 0, 0, 2, 0, 0])
