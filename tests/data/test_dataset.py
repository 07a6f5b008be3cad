"""PatchDataset: what training gets, and that it reads nothing else."""

from __future__ import annotations

import json
import pickle
import resource
from pathlib import Path

import numpy as np
import pytest
import torch
from stores import BANDS, NAMES, SETTINGS, make_cubes, make_store
from torch.utils.data import DataLoader, default_collate

from kcam.data import Patch, PatchDataset, StoreError, dataset
from kcam.data.patches import read_manifest
from kcam.units import nm


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dataset")
    return make_store(make_cubes(folder / "cubes"), folder / "store")


@pytest.fixture
def patches(store: Path) -> PatchDataset:
    return PatchDataset(store / "train")


def test_an_item_is_values_wavelengths_and_a_scene(patches: PatchDataset):
    item = patches[0]
    assert isinstance(item, Patch)
    assert item.values.shape == (BANDS, 16, 16)
    assert item.values.dtype == torch.float32
    assert item.wavelengths.dtype == torch.float64
    np.testing.assert_allclose(item.wavelengths / nm, np.linspace(420, 720, BANDS), rtol=1e-9)
    assert item.scene == "apple"
    assert len(patches) == 3 * 24
    assert [patches[index].scene for index in range(0, len(patches), 24)] == ["apple", "boat", "cat"]
    assert patches.mean.shape == patches.deviation.shape == (BANDS,)


def test_items_are_the_users_own(patches: PatchDataset):
    patches[5].values.zero_()
    assert patches[5].values.min() > 0.05


@pytest.mark.parametrize("kind", [int, np.int64, torch.tensor])
def test_indices_from_either_end(patches: PatchDataset, kind):
    count = len(patches)
    for index in (0, 23, 24, count - 1):
        assert torch.equal(patches[kind(index)].values, patches[kind(index - count)].values)
        assert patches.position(index) == patches.position(index - count)
    for index in (count, -count - 1):
        with pytest.raises(IndexError, match=f"patch {index} of {count}"):
            patches[kind(index)]
        with pytest.raises(IndexError, match=f"patch {index} of {count}"):
            patches.position(index)


@pytest.mark.parametrize(
    ("index", "fix"),
    [
        (1.5, r"Subset\(patches, \[0, 2, 5\]\)"),
        (1.0, "Subset"),
        (slice(3), r"Subset\(patches, range\(3\)\)"),
        ([0, 1], "Subset"),
        ("1", "Subset"),
        (None, "Subset"),
        (torch.tensor([0, 1]), "Subset"),
        (np.float64(2.0), "Subset"),
    ],
    ids=str,
)
def test_what_is_no_index_says_what_to_do(patches: PatchDataset, index, fix: str):
    for ask in (patches.__getitem__, patches.position):
        with pytest.raises(TypeError, match=f"a patch is asked for by a whole number, got .*{fix}"):
            ask(index)
    assert len(torch.utils.data.Subset(patches, range(3))) == 3


def test_iterating_ends(patches: PatchDataset):
    assert sum(1 for _ in patches) == len(patches)  # type: ignore[attr-defined]


def test_default_collate_makes_batches(patches: PatchDataset):
    batch = default_collate([patches[0], patches[30]])
    assert batch.values.shape == (2, BANDS, 16, 16)
    assert batch.wavelengths.shape == (2, BANDS)
    assert batch.scene == ("apple", "boat")
    loader = DataLoader(patches, batch_size=7, shuffle=True, generator=torch.Generator().manual_seed(0))
    assert sum(len(batch.values) for batch in loader) == len(patches)


@pytest.mark.slow  # two processes that import torch
def test_a_loader_with_two_workers(patches: PatchDataset):
    patches[0]  # an open map does not go along
    loader = DataLoader(patches, batch_size=5, num_workers=2, multiprocessing_context="spawn")
    values = torch.cat([batch.values for batch in loader])
    assert torch.equal(values, torch.stack([patches[index].values for index in range(len(patches))]))


def test_a_pickle_holds_no_values(patches: PatchDataset):
    for index in range(0, len(patches), 24):
        patches[index]
    content = pickle.dumps(patches)
    # 72 patches are 147 kB of values; the manifest is 5 kB
    assert len(content) < 10_000
    assert torch.equal(pickle.loads(content)[50].values, patches[50].values)


def test_files_are_mapped_when_they_are_needed(patches: PatchDataset):
    assert patches._arrays == {}
    patches[30]
    assert list(patches._arrays) == [1]
    found = patches._arrays[1]
    assert isinstance(found, np.memmap)
    assert found.mode == "r"
    with pytest.raises(ValueError, match="read-only"):
        found[0] = 0


def test_reading_a_patch_reads_nothing_else(tmp_path: Path):
    """A scene of 64 MB, of which one patch in the middle is touched: the process grows by less than 8 MB."""
    whole = make_store(make_cubes(tmp_path / "cubes", ("apple",), height=720, width=720), tmp_path / "store",
                       replace_size(128, 24))  # fmt: skip
    patches = PatchDataset(whole / "train")
    size = sum(path.stat().st_size for path in whole.rglob("*.npy"))
    assert size > 64e6
    patches[0]
    before = mapped()
    patches[len(patches) // 2]
    assert mapped() - before < 8e6  # a patch of 0.13 MB, and what the kernel maps around a page that is missed


def replace_size(size: int, stride: int):
    return type(SETTINGS)(size=size, stride=stride, split=(("train", 1.0),))


def mapped() -> int:
    """Resident bytes of this process, mapped files among them."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) * 1024


def test_many_scenes_do_not_use_up_the_open_files(store: Path, monkeypatch: pytest.MonkeyPatch):
    assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] > dataset.MOST_OPEN
    monkeypatch.setattr(dataset, "MOST_OPEN", 2)
    patches = PatchDataset(store / "train")
    one = [patches[index].values for index in range(0, 72, 24)]
    assert list(patches._arrays) == [1, 2]
    two = [patches[index].values for index in (24, 0)]
    assert list(patches._arrays) == [1, 0], "the one that was not asked for longest goes"
    assert torch.equal(one[1], two[0])
    assert torch.equal(one[0], two[1])


def test_a_file_that_is_cut_off_or_gone_is_an_error_at_access(tmp_path: Path):
    store = make_store(make_cubes(tmp_path / "cubes", NAMES[:2]), tmp_path / "store")
    patches = PatchDataset(store / "train")
    path = store / "train" / "scenes" / "boat.npy"
    path.write_bytes(path.read_bytes()[:-100])
    patches[0]
    with pytest.raises(StoreError, match=r"boat.npy has \d+ bytes, expected \d+: it is cut off"):
        patches[24]
    path.unlink()
    with pytest.raises(StoreError, match=r"boat.npy cannot be read: .*No such file"):
        patches[24]


def test_a_file_of_another_shape_is_an_error(tmp_path: Path):
    store = make_store(make_cubes(tmp_path / "cubes", NAMES[:1]), tmp_path / "store")
    path = store / "train" / "scenes" / "apple.npy"
    np.save(path, np.load(path).transpose(0, 2, 3, 1).copy())
    with pytest.raises(StoreError, match=r"apple.npy holds \(24, 16, 16, 4\) of uint16, expected \(24, 4, 16, 16\)"):
        PatchDataset(store / "train")[0]


def test_no_pickle_is_opened(tmp_path: Path):
    store = make_store(make_cubes(tmp_path / "cubes", NAMES[:1]), tmp_path / "store")
    path = store / "train" / "scenes" / "apple.npy"
    size = path.stat().st_size
    np.save(path, np.array([Trap()], dtype=object), allow_pickle=True)
    path.write_bytes(path.read_bytes().ljust(size, b" "))
    with pytest.raises(StoreError, match=r"apple.npy cannot be read"):
        PatchDataset(store / "train")[0]


class Trap:
    def __reduce__(self):
        return (pytest.fail, ("a pickle was opened",))


def test_what_is_no_split_is_an_error(store: Path, tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"Open one of its splits: .*train, .*val"):
        PatchDataset(store)
    with pytest.raises(FileNotFoundError, match="Make one with kcam data extract"):
        PatchDataset(tmp_path)
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(StoreError, match="is damaged"):
        PatchDataset(tmp_path)
    (tmp_path / "manifest.json").write_text("[]")
    with pytest.raises(StoreError, match="is damaged"):
        PatchDataset(tmp_path)
    document = json.loads((store / "train" / "manifest.json").read_text())
    document["scenes"][0]["count"] = 5
    (tmp_path / "manifest.json").write_text(json.dumps(document))
    with pytest.raises(StoreError, match="its own sha256 differs"):
        read_manifest(tmp_path)
