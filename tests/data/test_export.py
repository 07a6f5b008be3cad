"""HDF5 and Zarr for other tools: the same patches, and all that is known of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from stores import BANDS, NAMES, call, make_cubes, make_store

from kcam.data import PatchDataset, StoreError, export, export_patches
from kcam.data.patches import read_manifest
from kcam.units import nm


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export")
    return make_store(make_cubes(folder / "cubes"), folder / "store") / "val"


def check(split: Path, found: dict[str, np.ndarray], manifest: dict) -> None:
    patches = PatchDataset(split)
    document = read_manifest(split)
    assert manifest == json.loads(json.dumps(document))
    assert found["patches"].dtype == np.uint16
    assert found["patches"].shape == (len(patches), BANDS, 16, 16)
    np.testing.assert_allclose(found["wavelengths"], np.linspace(420, 720, BANDS) * nm, rtol=1e-9)
    for index in range(0, len(patches), 5):
        values = found["patches"][index].astype(np.float32) * np.float32(found["scale"][index])
        # the same product of the same two numbers, at most a rounding apart
        np.testing.assert_allclose(values, patches[index].values.numpy(), rtol=2e-7)
        name = document["scenes"][found["scene"][index]]["scene"]
        assert (name, *found["position"][index].tolist()) == patches.position(index)


TABLES = ("patches", "scale", "scene", "position", "wavelengths")


@pytest.mark.parametrize("suffix", [".h5", ".hdf5"])
def test_hdf5(split: Path, tmp_path: Path, suffix: str):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / f"val{suffix}"
    assert export_patches(split, path) == 72
    with h5py.File(path) as file:
        assert file["patches"].chunks == (1, BANDS, 16, 16)
        check(split, {name: file[name][()] for name in TABLES}, json.loads(file["manifest"].asstr()[()]))
    assert [left.name for left in tmp_path.iterdir()] == [path.name]
    export_patches(split, tmp_path / f"again{suffix}")
    assert path.read_bytes() == (tmp_path / f"again{suffix}").read_bytes()


def test_zarr(split: Path, tmp_path: Path):
    zarr = pytest.importorskip("zarr")
    assert export_patches(split, tmp_path / "val.zarr") == 72
    group = zarr.open_group(tmp_path / "val.zarr", mode="r")
    assert group["patches"].chunks == (1, BANDS, 16, 16)
    check(split, {name: group[name][:] for name in TABLES}, group.attrs["manifest"])
    assert [left.name for left in tmp_path.iterdir()] == ["val.zarr"]


@pytest.mark.parametrize("suffix", [".h5", ".zarr"])
def test_what_is_interrupted_leaves_nothing(split: Path, tmp_path: Path, suffix: str):
    pytest.importorskip({".h5": "h5py", ".zarr": "zarr"}[suffix])

    def stop(name: str, count: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export_patches(split, tmp_path / f"val{suffix}", advance=stop)
    assert list(tmp_path.iterdir()) == []


def test_a_split_without_patches(tmp_path: Path):
    pytest.importorskip("h5py")
    store = make_store(make_cubes(tmp_path / "cubes", NAMES[:1]), tmp_path / "store")
    assert export_patches(store / "val", tmp_path / "val.h5") == 0


def test_the_tool(split: Path, tmp_path: Path):
    pytest.importorskip("h5py")
    assert "72 patches in" in call("export_patches", split, "--out", tmp_path / "val.h5")
    assert "exists already" in call("export_patches", split, "--out", tmp_path / "val.h5", status=2)
    assert "known are .h5, .hdf5, .zarr" in call("export_patches", split, "--out", tmp_path / "val.csv", status=2)
    assert "Open one of its splits" in call("export_patches", split.parent, "--out", tmp_path / "x.h5", status=2)


@pytest.mark.parametrize(("suffix", "module"), [(".h5", "h5py"), (".zarr", "zarr")])
def test_what_is_not_installed_is_said(split: Path, tmp_path: Path, suffix: str, module: str, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, module, None)
    with pytest.raises(ImportError, match="pip install 'kcam"):
        export_patches(split, tmp_path / f"val{suffix}")


def test_a_damaged_store_leaves_nothing(tmp_path: Path):
    pytest.importorskip("h5py")
    store = make_store(make_cubes(tmp_path / "cubes", NAMES[:2]), tmp_path / "store")
    path = store / "train" / "scenes" / "boat.npy"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(StoreError, match="cut off"):
        export_patches(store / "train", tmp_path / "x.h5")
    assert not list(tmp_path.glob("*x.h5*"))
    assert export.WRITERS.keys() == {".h5", ".hdf5", ".zarr"}
