"""The cube file: exact, opened by other tools, kept whole by a crash."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
import torch
import writers
from PIL import Image

from kcam.data import Cube, CubeError, read_cube, write_cube
from kcam.data import cube as module
from kcam.data.cube import Source, is_cube, open_cube, write_source
from kcam.units import nm

GRID = np.linspace(420, 720, 28) * nm


def toy(shape: tuple[int, int, int] = (28, 12, 17), **others: Any) -> Cube:
    values = torch.from_numpy(writers.cube(*shape)).float()
    grid = torch.linspace(420, 720, shape[0], dtype=torch.float64) * nm
    return Cube(values, grid, **{"unit": "reflectance", "name": "toy", **others})


def source_of(cube: Cube) -> Source:
    def rows(first: int, last: int) -> tuple[np.ndarray, None]:
        return cube.values[:, first:last].numpy(), None

    return Source(cube.name, cube.shape, cube.wavelengths.numpy(), cube.unit, rows)


# L, H and W at which TIFF could take an axis for colours or drop it
@pytest.mark.parametrize(
    "shape", [(28, 12, 17), (1, 5, 6), (3, 5, 6), (4, 5, 3), (3, 1, 1), (31, 2, 4), (5, 3, 3), (1, 1, 1), (2, 1, 4)]
)
def test_round_trip_is_exact(shape: tuple[int, int, int], tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    values = torch.from_numpy(random.standard_normal(shape) * 10.0 ** random.integers(-30, 30)).float()
    wavelengths = torch.from_numpy(np.sort(random.uniform(400, 1000, shape[0])) * nm)
    source = {"format": "kaist", "group": "a", "licence": "CC BY 4.0", "citation": 'Müller, "Spectra" 2020'}
    depth = torch.from_numpy(random.uniform(1, 5, shape[1:]).astype(np.float32))
    for unit in ("reflectance", "radiance", "relative radiance"):
        write_cube(tmp_path / "a.tif", Cube(values, wavelengths, unit, None, depth, "näme / ..", source))
        again = read_cube(tmp_path / "a.tif")
        assert again.values.dtype == torch.float32
        assert torch.equal(again.values, values)
        assert torch.equal(again.depth, depth)
        # written with 1e-6 nm
        torch.testing.assert_close(again.wavelengths, wavelengths, atol=1e-6 * nm, rtol=0)
        assert (again.unit, again.name, again.mask) == (unit, "näme / ..", None)
        assert again.source == source  # the format stays the one that it came from


def test_a_second_round_trip_changes_no_byte(tmp_path: Path) -> None:
    write_cube(tmp_path / "a.tif", toy(depth=torch.ones(12, 17), source={"format": "npz"}))
    write_cube(tmp_path / "b.tif", read_cube(tmp_path / "a.tif"))
    assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()


def test_the_mask_and_bands_that_were_extrapolated_are_kept(tmp_path: Path) -> None:
    pixels = torch.ones(12, 17, dtype=torch.bool)
    pixels[3, 4:7] = False
    bands = torch.ones(28, dtype=torch.bool)
    bands[[0, 27]] = False
    cube = toy(mask=pixels & bands[:, None, None], depth=torch.full((12, 17), torch.inf))
    before = cube.values.clone()
    write_cube(tmp_path / "a.tif", cube)
    assert torch.equal(cube.values, before)  # the caller's cube is not touched
    again = read_cube(tmp_path / "a.tif")
    assert torch.equal(again.mask, cube.mask)
    assert torch.equal(again.values[:, pixels], cube.values[:, pixels])
    assert (again.values[:, ~pixels] == 0).all()
    assert again.depth.isinf().all()
    assert open_cube(tmp_path / "a.tif").extrapolated.tolist() == [True] + [False] * 26 + [True]


def test_a_mask_of_one_band_masks_the_pixel(tmp_path: Path) -> None:
    mask = torch.ones(28, 12, 17, dtype=torch.bool)
    mask[5, 2, 3] = False
    write_cube(tmp_path / "a.tif", toy(mask=mask))
    again = read_cube(tmp_path / "a.tif")
    assert (~again.mask).sum() == 28
    assert not again.mask[:, 2, 3].any()


def test_nothing_valid_is_refused(tmp_path: Path) -> None:
    for cube in (toy(mask=torch.zeros(12, 17, dtype=torch.bool)), Cube(torch.full((2, 3, 4), torch.nan), GRID[:2])):
        with pytest.raises(CubeError, match="no valid pixel"):
            write_cube(tmp_path / "a.tif", cube)
    assert not list(tmp_path.iterdir())


def test_other_tools_open_it(tmp_path: Path) -> None:
    cube = toy(mask=torch.arange(17).expand(12, 17) > 2, depth=torch.full((12, 17), 1.5))
    path = tmp_path / "a.tif"
    write_cube(path, cube)
    expected = torch.where(cube.mask, cube.values, 0.0).numpy()
    with tifffile.TiffFile(path) as file:
        assert len(file.pages) == 30
        assert (np.stack([page.asarray() for page in file.pages[:28]]) == expected).all()
        document = json.loads(file.pages[0].description)
        assert file.pages[0].tags["Software"].value == "kcam"
    np.testing.assert_allclose(document["wavelengths_nm"], np.linspace(420, 720, 28), atol=1e-6)
    assert document["unit"] == "reflectance"
    whole, pages = cv2.imreadmulti(str(path), flags=cv2.IMREAD_UNCHANGED)
    assert whole
    assert len(pages) == 30
    assert (np.stack(pages[:28]) == expected).all()
    assert (pages[28] == cube.mask[0].numpy() * 255).all()
    assert (pages[29] == 1.5).all()
    with Image.open(path) as picture:
        assert picture.n_frames == 30
        for index in (0, 13, 27):
            picture.seek(index)
            assert (np.asarray(picture) == expected[index]).all()
        picture.seek(28)
        assert (np.asarray(picture) == cube.mask[0].numpy() * 255).all()


@pytest.mark.parametrize("strip", [1, 28 * 17, 28 * 17 * 5, 2**25])
def test_strips_write_the_same_bytes(strip: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cube = toy(mask=torch.arange(12)[:, None].expand(12, 17) > 2)  # three whole rows invalid: strips without a pixel
    write_cube(tmp_path / "a.tif", cube)
    monkeypatch.setattr(module, "STRIP", strip)
    write_cube(tmp_path / "b.tif", cube)
    assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()


def test_rows_of_nan_are_masked_whatever_the_strip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = toy().values.clone()
    values[:, 4:6] = torch.nan
    monkeypatch.setattr(module, "STRIP", 1)
    facts = write_source(tmp_path / "a.tif", source_of(Cube(values, GRID)))
    assert facts["invalid"] == pytest.approx(2 / 12)
    assert facts["low"] == 0
    assert not read_cube(tmp_path / "a.tif").mask[:, 4:6].any()


def test_strips_of_a_file_are_the_whole(tmp_path: Path) -> None:
    cube = toy(mask=torch.arange(17).expand(12, 17) > 2)
    write_cube(tmp_path / "a.tif", cube)
    source = open_cube(tmp_path / "a.tif")
    for first, last in ((0, 1), (5, 9), (11, 12)):
        values, valid = source.checked_rows(first, last)
        assert (values == read_cube(tmp_path / "a.tif").values[:, first:last].numpy()).all()
        assert (valid == cube.mask[0, first:last].numpy()).all()


def test_a_file_beyond_4_gb_is_a_big_tiff(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    memmap = tifffile.memmap

    def big(path: Path, **how: Any) -> np.ndarray:
        asked.append(how["bigtiff"])
        return memmap(path, **{**how, "bigtiff": True})

    monkeypatch.setattr(module.tifffile, "memmap", big)
    cube = toy(mask=torch.arange(17).expand(12, 17) > 2, depth=torch.ones(12, 17))
    write_cube(tmp_path / "a.tif", cube)
    assert asked == [False]
    assert (tmp_path / "a.tif").read_bytes()[:4] == b"II+\0"
    again = read_cube(tmp_path / "a.tif")
    assert torch.equal(again.mask, cube.mask)
    assert (again.depth == 1).all()
    assert torch.equal(again.values[:, again.mask[0]], cube.values[:, cube.mask[0]])

    class AskedForIt(Exception):
        pass

    def stop(path: Path, **how: Any) -> np.ndarray:
        raise AskedForIt(how["bigtiff"])

    monkeypatch.setattr(module.tifffile, "memmap", stop)
    for bands, large in ((31, False), (118, True)):  # 4 bytes x 118 x 2704 x 3376 = 4.3e9, more than 2^32
        grid = np.linspace(400, 900, bands) * nm
        with pytest.raises(AskedForIt, match=str(large)):
            write_source(
                tmp_path / "b.tif", Source("b", (bands, 2704, 3376), grid, "radiance", lambda *_: (None, None))
            )


def test_a_crash_in_the_middle_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.tif"
    write_cube(path, toy())
    before = path.read_bytes()
    monkeypatch.setattr(module, "STRIP", 1)

    def rows(first: int, last: int) -> tuple[np.ndarray, None]:
        if first == 7:
            raise OSError("the disk is gone")
        return np.ones((28, last - first, 17), np.float32), None

    with pytest.raises(CubeError, match="rows 7 to 8 cannot be read: OSError: the disk is gone"):
        write_source(path, Source("a", (28, 12, 17), GRID, "radiance", rows))
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.tif"]


def test_is_cube(tmp_path: Path) -> None:
    write_cube(tmp_path / "a.tif", toy())
    assert is_cube(tmp_path / "a.tif")
    (tmp_path / "b.tif").write_bytes(b"II*\0")
    (tmp_path / "c.tif").mkdir()
    stack = writers.tiff(tmp_path).path
    for path in (tmp_path / "b.tif", tmp_path / "c.tif", tmp_path / "none.tif", stack):
        assert not is_cube(path)


def test_what_a_cube_must_be() -> None:
    values = torch.ones(2, 3, 4)
    grid = torch.tensor([500, 600], dtype=torch.float64) * nm
    for arguments, error, text in (
        ((torch.ones(3, 4), grid), CubeError, r"floating-point \(L,H,W\), got \(3, 4\)"),
        ((values.int(), grid), CubeError, "floating-point"),
        ((values, grid[:1]), CubeError, "2 bands, but 1 wavelengths"),
        ((values, grid * 1e9), ValueError, "did you mean"),
        ((values, grid, "lux"), CubeError, "unknown unit 'lux'; known: reflectance, radiance"),
        ((values, grid, "radiance", torch.ones(3, 4)), CubeError, "mask must be bool"),
        ((values, grid, "radiance", torch.ones(4, 3, dtype=torch.bool)), CubeError, "mask must be bool"),
        ((values, grid, "radiance", None, torch.ones(4, 3)), CubeError, r"depth must be \(H,W\)"),
    ):
        with pytest.raises(error, match=text):
            Cube(*arguments)
    assert Cube(values.double(), grid).values.dtype == torch.float32
    assert Cube(values, grid, mask=torch.ones(3, 4, dtype=torch.bool)).mask.shape == (2, 3, 4)


def test_where_it_may_be_written(tmp_path: Path) -> None:
    with pytest.raises(CubeError, match=r"a cube's name ends in \.tif\. Use a\.tif"):
        write_cube(tmp_path / "a.png", toy())
    with pytest.raises(FileNotFoundError):
        write_cube(tmp_path / "none" / "a.tif", toy())


def test_sizes_that_no_cube_has(tmp_path: Path) -> None:
    for shape, text in (((0, 2, 3), "no cube has that size"), ((28, 10**5, 10**5), "no cube has that size")):
        with pytest.raises(CubeError, match=text):
            Source("a", shape, GRID, "radiance", lambda *_: (None, None)).check()
    for grid, text in (
        (GRID[:5], "28 bands, but 5 wavelengths"),
        (np.full(28, np.nan), "wavelength of nan"),
        (GRID * 1e9, "outside 100"),
        (np.repeat(GRID[:14], 2), "same wavelength"),
    ):
        with pytest.raises(CubeError, match=text):
            Source("a", (28, 2, 3), grid, "radiance", lambda *_: (None, None)).check()


def _described(tmp_path: Path, **changes: Any) -> Path:
    """A cube file whose description was changed by someone."""
    written = writers.kcam_cube(tmp_path)
    with tifffile.TiffFile(written.path) as file:
        pages = [page.asarray() for page in file.pages]
        document = json.loads(file.pages[0].description) | changes
    with tifffile.TiffWriter(written.path) as file:
        how: dict[str, Any] = {"photometric": "minisblack", "metadata": None}
        file.write(np.stack(pages[:28]), description=json.dumps(document), **how)
        for page in pages[28:]:
            file.write(page, **how)
    return written.path


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"kcam_cube": 2}, "version 2; this kcam reads 1"),
        ({"unit": "lux"}, "of 'lux'"),
        ({"extrapolated": [False] * 27}, "27 marks for 28 bands"),
        ({"wavelengths_nm": [400.0] * 28}, "same wavelength"),
        ({"wavelengths_nm": [1.0] * 28}, "outside 100"),
        ({"wavelengths_nm": list(range(400, 425))}, "30 pages and 28 marks for 25 bands"),
        ({"wavelengths_nm": list(range(400, 431)), "extrapolated": [False] * 31}, "30 pages and 31 marks for 31 bands"),
        ({"wavelengths_nm": list(range(400, 429)), "extrapolated": [False] * 29}, "not as kcam writes them"),
        ({"wavelengths_nm": "x"}, "description is damaged"),
        ({"source": 5}, "description is damaged"),
    ],
)
def test_a_description_that_does_not_fit(changes: dict[str, Any], text: str, tmp_path: Path) -> None:
    with pytest.raises(CubeError, match=text):
        read_cube(_described(tmp_path, **changes))


def test_a_cube_that_another_tool_wrote_anew_is_refused(tmp_path: Path) -> None:
    written = writers.kcam_cube(tmp_path)
    with tifffile.TiffFile(written.path) as file:
        pages, text = [page.asarray() for page in file.pages], file.pages[0].description
    with tifffile.TiffWriter(written.path) as file:
        for index, page in enumerate(pages):
            how = {"description": text} if index == 0 else {}
            file.write(page, photometric="minisblack", metadata=None, compression="zlib", **how)
    with pytest.raises(CubeError, match="not as kcam writes it"):
        read_cube(written.path)
