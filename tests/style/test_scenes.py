"""What a camera is trained on: the same scenes for the same numbers, in any company."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import pytest
import torch
from data.stores import HEIGHT, NAMES, WIDTH, make_cubes, make_store, values
from torch import Tensor

from kcam import Scene, spectral
from kcam.data import Cube, StoreError, write_cube
from kcam.scene import PHOTOGRAPHS
from kcam.style import BuiltinScenes, PatchScenes, Source
from kcam.style.scenes import BRIGHTEST, DIMMEST, SCALES, TINT
from kcam.units import nm

CROP = 12


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    return make_store(make_cubes(folder / "cubes"), folder / "store")


@pytest.fixture(scope="module")
def radiance(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The values of `store` under another unit."""
    folder = tmp_path_factory.mktemp("radiance")
    cubes = make_cubes(folder / "cubes")
    for name in NAMES:
        grid = torch.linspace(420, 720, 4, dtype=torch.float64) * nm
        content = values_of(name)
        write_cube(cubes / f"{name}.tif", Cube(content, grid, "radiance", name=name, source={"format": "test"}))
    return make_store(cubes, folder / "store")


def values_of(name: str) -> Tensor:
    return values(int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big"))


@pytest.fixture(scope="module")
def builtin() -> BuiltinScenes:
    return BuiltinScenes(48)


@pytest.fixture(params=["builtin", "patches"])
def source(request: pytest.FixtureRequest, builtin: BuiltinScenes, store: Path) -> Source:
    return builtin if request.param == "builtin" else PatchScenes(store, size=CROP)


def test_a_row_does_not_know_of_the_others(source: Source) -> None:
    whole, origins = source.draw(range(4), seed=3, step=9)
    assert whole.shape[0] == len(origins) == 4
    for rows in ([0, 2], [1, 3], [3]):  # as two processes share a batch
        part, where = source.draw(rows, seed=3, step=9)
        assert torch.equal(part.coefficients, whole.coefficients[list(rows)])
        assert where == [origins[row] for row in rows]


def test_seed_step_and_row_decide(source: Source) -> None:
    state = torch.get_rng_state()
    keys = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    drawn = {(seed, step, row): source.draw([row], seed=seed, step=step) for seed, step, row in keys}
    again, origins = source.draw([0], seed=0, step=0)
    first, where = drawn[0, 0, 0]
    assert torch.equal(again.coefficients, first.coefficients)
    assert origins == where
    others = [scene.coefficients for key, (scene, _) in drawn.items() if key != (0, 0, 0)]
    assert not any(torch.equal(first.coefficients, other) for other in others)
    assert torch.equal(state, torch.get_rng_state())


def test_scenes_are_light(source: Source) -> None:
    for step in range(30):
        scene, _ = source.draw([0, 1], seed=0, step=step)
        bands = scene.bands()
        assert bands.isfinite().all()
        assert bands.min() >= -1e-3 * bands.max()  # the factors of a colour dip below zero by their own error
        assert scene.coefficients.min() >= 0
        assert scene.depth == 2.0
        assert scene.coefficients.dtype == torch.float32


def test_a_drawn_scene_may_be_changed(builtin: BuiltinScenes) -> None:
    """The photographs are kept for all who draw from them."""
    before, _ = builtin.draw([0], seed=1, step=0)
    for tensor in (before.coefficients, before.spectra, before.wavelengths, before.illuminant):
        tensor.mul_(0)
    after, _ = builtin.draw([0], seed=1, step=0)
    for tensor in (after.coefficients, after.spectra, after.wavelengths, after.illuminant):
        assert tensor.abs().max() > 0


def test_what_an_epoch_is(builtin: BuiltinScenes, store: Path) -> None:
    assert len(PatchScenes(store)) == 3 * 24
    assert len(builtin) > len(BuiltinScenes(96)) > 0


# ---- built-in -------------------------------------------------------------------------------------------------------


def test_every_photograph_at_every_scale_comes(builtin: BuiltinScenes) -> None:
    seen = set()
    for step in range(50):
        scene, origins = builtin.draw(range(4), seed=0, step=step)
        assert scene.shape == (4, 48, 48)
        assert scene.coefficients.max() <= 1
        for origin in origins:
            found = re.fullmatch(r"(\w+) at ([\d.]+), row (\d+), column (\d+)", origin)
            assert found is not None, origin
            seen.add((found[1], float(found[2])))
    # 200 draws of 16: one is missed with a probability of 16 exp(-12.5) = 6e-5, and the seed is fixed
    assert seen == {(name, scale) for name in PHOTOGRAPHS for scale in SCALES}


def test_a_crop_is_where_its_name_says(builtin: BuiltinScenes) -> None:
    """But for mirroring, light and colours: where none was drawn it is the photograph itself."""
    plain = 0
    for step in range(40):
        scene, (origin,) = builtin.draw([0], seed=0, step=step)
        name, scale, row, column = re.fullmatch(r"(\w+) at ([\d.]+), row (\d+), column (\d+)", origin).groups()
        whole = next(own for label, own in builtin.scenes if label == f"{name} at {scale}")
        crop = whole.crop(top=int(row), left=int(column), height=48, width=48).coefficients.clamp(max=1)
        same = [torch.equal(scene.coefficients, each) for each in (crop, crop.flip(-1))]
        plain += any(same)
    assert 4 <= plain <= 18  # a quarter of 40 is expected: 10, with a deviation of 2.7; three of them


def test_dimmed_scenes_are_within_the_stated_stops(builtin: BuiltinScenes) -> None:
    light = torch.tensor([float(builtin.draw([0], seed=1, step=s)[0].coefficients.mean()) for s in range(60)])
    usual = torch.tensor([float(scene.coefficients.mean()) for _, scene in builtin.scenes])
    # at the darkest: 3 stops for the light and 1.5 for the colours of the darkest of crops
    assert light.max() < 4 * usual.max()
    assert light.min() < 0.5 * usual.min()
    assert light.min() > usual.min() * 2 ** (DIMMEST - TINT) / 16
    assert BRIGHTEST < 1


def test_the_crop_may_be_as_large_as_a_photograph() -> None:
    scene, _ = BuiltinScenes(300).draw([0], seed=0, step=0)
    assert scene.shape == (1, 300, 300)


@pytest.mark.parametrize("size", [2000, 0, -3])
def test_a_size_that_no_photograph_has(size: int) -> None:
    with pytest.raises(ValueError, match=f"photograph holds a crop of {size} pixels. Use a size of at most 300"):
        BuiltinScenes(size)


@pytest.mark.parametrize("name", ["starry_night", "colour_chart"])
def test_what_is_no_photograph(name: str) -> None:
    with pytest.raises(ValueError, match=f"no built-in photograph {name!r}. There are: motorcycle, astronaut"):
        BuiltinScenes(48, names=["coffee", name])


def test_only_the_photographs_that_are_named() -> None:
    some = BuiltinScenes(48, names=["chelsea"])
    assert all("chelsea" in origin for origin in some.draw(range(6), seed=0, step=0)[1])


# ---- a patch store --------------------------------------------------------------------------------------------------


def test_a_store_is_its_training_split(store: Path) -> None:
    one, two = PatchScenes(store), PatchScenes(store / "train")
    assert torch.equal(one.draw([0], seed=0, step=0)[0].bands(), two.draw([0], seed=0, step=0)[0].bands())
    assert PatchScenes(store / "val").patches.scenes != one.patches.scenes
    assert len(PatchScenes(one.patches)) == len(one)


def test_daylight_falls_on_reflectances_only(store: Path, radiance: Path) -> None:
    lit, own = PatchScenes(store), PatchScenes(radiance)
    light = spectral.illuminant("D65", wavelengths=lit.patches.wavelengths).float()[:, None, None]
    assert light.flatten().diff().abs().max() > 0.05
    for step in range(6):
        one, two = (each.draw([0, 1], seed=2, step=step)[0].bands() for each in (lit, own))
        torch.testing.assert_close(one, two * light)  # of the same patches: rounding of float32 alone


def test_a_patch_is_where_its_name_says(radiance: Path) -> None:
    """But for mirroring, and a factor for each band."""
    source = PatchScenes(radiance, size=CROP)
    wide, mirrored, lit = set(), 0, 0
    for step in range(40):
        scene, (origin,) = source.draw([0], seed=0, step=step)
        name, row, column = re.fullmatch(r"(\w+), row (\d+), column (\d+)", origin).groups()
        assert scene.shape == (1, CROP, CROP)
        assert int(row) + CROP <= HEIGHT
        assert int(column) + CROP <= WIDTH
        wide.add((int(row) % 8, int(column) % 8))
        crop = values_of(name)[:, int(row) : int(row) + CROP, int(column) : int(column) + CROP]
        ratios = [scene.bands()[0] / each for each in (crop, crop.flip(-1))]
        spread = [float(((r.amax((1, 2)) - r.amin((1, 2))) / r.mean((1, 2))).max()) for r in ratios]
        # values are stored as float16, in steps of 1e-3 of themselves
        assert min(spread) < 3e-3
        mirrored += spread[1] < spread[0]
        factors = ratios[spread.index(min(spread))].mean((1, 2))
        lit += bool((factors - 1).abs().max() > 0.01)
        stops = torch.log2(factors)
        assert stops.min() > DIMMEST - TINT / 2 - 0.01
        assert stops.max() < BRIGHTEST + TINT / 2 + 0.01
    assert len(wide) > 10  # crops lie anywhere in a patch, not at its corner
    for count in (mirrored, lit):
        assert 10 <= count <= 30  # 20 are expected, with a deviation of 3.2; three of them


def test_the_whole_patch_without_a_size(store: Path) -> None:
    assert PatchScenes(store).draw([0, 1], seed=0, step=0)[0].shape == (2, 16, 16)
    assert isinstance(PatchScenes(store).draw([0], seed=0, step=0)[0], Scene)


@pytest.mark.parametrize("size", [17, 256])
def test_patches_that_are_too_small(store: Path, size: int) -> None:
    with pytest.raises(ValueError, match=f"have 16 x 16 pixels, and {size} are trained on. Use --size 16, or extract"):
        PatchScenes(store, size=size)


def test_no_store(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        PatchScenes(tmp_path / "nowhere")
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "manifest.json").write_text("{")
    with pytest.raises(StoreError):
        PatchScenes(tmp_path)


def test_an_empty_store(tmp_path: Path) -> None:
    store = make_store(make_cubes(tmp_path / "cubes", ("apple",)), tmp_path / "store")
    with pytest.raises(ValueError, match="val holds no patches. Extract some: kcam data extract"):
        PatchScenes(store / "val")
