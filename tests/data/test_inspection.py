"""What is wrong with a cube is found, and nothing is found where nothing is wrong."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import stores
import torch
import writers
from PIL import Image
from test_convert import TOOLS, run

from kcam import Scene, spectral
from kcam.data import Cube, CubeError, write_cube
from kcam.data.inspection import Findings, inspect, thumbnail
from kcam.data.readers import open_source
from kcam.units import nm

SCENES = ("astronaut", "chelsea", "coffee", "colour_chart", "motorcycle", "star")


def scene(name: str, size: int = 160) -> Cube:
    made = Scene.builtin(name, size)
    return Cube(made.bands()[0].clamp(min=0), made.wavelengths, "relative radiance", name=name)


def noisy() -> Cube:
    """A photograph with a little noise of its own in each value, as measured cubes have it."""
    cube = scene("astronaut")
    noise = 0.003 * np.random.default_rng(0).standard_normal(cube.shape)
    return Cube((cube.values + torch.from_numpy(noise)).clamp(min=0), cube.wavelengths, cube.unit, name="noisy")


def findings(folder: Path, cube: Cube) -> Findings:
    write_cube(folder / "a.tif", cube)
    return inspect(folder / "a.tif")[0]


def changed(cube: Cube, change) -> Cube:
    values = cube.values.clone()
    change(values)
    return Cube(values, cube.wavelengths, cube.unit, cube.mask, cube.depth, cube.name)


@pytest.mark.parametrize("name", SCENES)
def test_no_false_alarm_on_the_built_in_scenes(name: str, tmp_path: Path) -> None:
    assert findings(tmp_path, scene(name)).remarks() == []


def test_no_false_alarm_under_noise(tmp_path: Path) -> None:
    assert findings(tmp_path, noisy()).remarks() == []


@pytest.mark.parametrize("band", [0, 13, 27])
@pytest.mark.parametrize("what", ["constant", "noise"])
def test_a_dead_band_is_found(band: int, what: str, tmp_path: Path) -> None:
    def change(values: torch.Tensor) -> None:
        random = torch.rand(values.shape[1:], generator=torch.Generator().manual_seed(0))
        values[band] = 0.2 if what == "constant" else random

    found = findings(tmp_path, changed(noisy(), change))
    assert found.bad_bands == (band,)
    assert found.remarks()[0] == f"bad bands at {420 + band * 300 / 27:.0f} nm"


def test_hot_and_dead_pixels_are_found_and_counted(tmp_path: Path) -> None:
    cube = noisy()
    random = np.random.default_rng(1)
    count = 400  # of 28 x 160 x 160: 0.06 %
    places = [random.integers(1, 27, count), random.integers(0, 160, count), random.integers(0, 160, count)]

    def change(values: torch.Tensor) -> None:
        values[tuple(torch.from_numpy(place) for place in places)] = 3.0

    found = findings(tmp_path, changed(cube, change))
    planted = count / (26 * 160 * 160)  # the outer bands have a neighbour on one side only
    assert found.bad_pixels == pytest.approx(planted, rel=0.1)  # a few fall on one another or beside one another
    assert "hot or dead values" in " ".join(found.remarks())


def test_clipping_is_found(tmp_path: Path) -> None:
    cube = noisy()
    limit = float(torch.quantile(cube.values.flatten()[::7], 0.95))
    found = findings(tmp_path, changed(cube, lambda values: values.clamp_(max=limit)))
    assert found.clipped == pytest.approx(0.05, abs=0.003)  # a quantile of every 7th value
    assert found.top == pytest.approx(limit)
    assert any(remark.endswith("% clipped") for remark in found.remarks())


def test_negative_values_are_counted(tmp_path: Path) -> None:
    found = findings(tmp_path, changed(noisy(), lambda values: values[:, :16].sub_(5)))
    assert found.negative == pytest.approx(0.1)
    assert "10.00% negative" in found.remarks()


def test_invalid_pixels_and_extrapolated_bands_are_told(tmp_path: Path) -> None:
    cube = noisy()
    mask = torch.ones(cube.shape, dtype=torch.bool)
    mask[:, :8] = False
    mask[:2] = False
    found = findings(tmp_path, Cube(cube.values + 0.1, cube.wavelengths, cube.unit, mask, None, "a"))
    assert found.invalid == pytest.approx(0.05)
    assert found.extrapolated == (0, 1)
    assert found.remarks() == ["2 bands extrapolated", "5.00% invalid pixels"]
    assert found.low >= 0.1  # what is invalid is 0 and does not count


def test_numbers_are_those_of_the_values(tmp_path: Path) -> None:
    cube = noisy()
    found = findings(tmp_path, cube)
    values = cube.values.numpy()
    assert found.shape == cube.shape
    low, middle, high = np.percentile(values, (1, 50, 99))
    assert (found.low, found.middle, found.high) == pytest.approx((low, middle, high), rel=1e-5)
    assert found.top == pytest.approx(values.max())
    np.testing.assert_allclose(found.spectrum, values.mean((1, 2)), rtol=1e-5)
    # Noise over the middle: 0.003 was put in. A 3 x 3 median takes some of it along, details of the picture add some.
    assert found.noise * found.middle == pytest.approx(0.003, rel=0.5)
    assert found.stops == pytest.approx(np.log2(np.percentile(values, 99.9) / (found.noise * found.middle)), abs=0.01)


def test_small_and_odd_cubes(tmp_path: Path) -> None:
    for shape in ((1, 1, 1), (2, 1, 5), (3, 2, 2), (31, 1, 40)):
        grid = torch.linspace(400, 700, shape[0], dtype=torch.float64) * nm
        assert findings(tmp_path, Cube(torch.rand(shape) + 0.1, grid)).shape == shape


def test_a_large_cube_is_looked_at_in_its_middle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from kcam.data import inspection

    monkeypatch.setattr(inspection, "LOOKED_AT", 160 * 20)
    found = findings(tmp_path, changed(noisy(), lambda values: values[:, 85:].fill_(9)))
    assert found.top == 9  # rows 70 to 90
    found = findings(tmp_path, changed(noisy(), lambda values: values[:, 95:].fill_(9)))
    assert found.top < 9


def test_a_thumbnail_has_the_colours_of_the_scene(tmp_path: Path) -> None:
    """A reflectance that is white is grey in it, in daylight; a red one is red."""
    grid = torch.linspace(420, 720, 28, dtype=torch.float64) * nm
    values = torch.ones(28, 8, 8)
    values[:, :, 4:] = spectral.rgb_basis(grid)[0].float()[:, None, None]
    write_cube(tmp_path / "a.tif", Cube(values, grid, "reflectance"))
    source = open_source(tmp_path / "a.tif")
    picture = thumbnail(source.rows(0, 8)[0], source)
    torch.testing.assert_close(picture[:, 0, 0], torch.ones(3), atol=0.01, rtol=0)
    torch.testing.assert_close(picture[:, 0, 6], torch.tensor([1.0, 0, 0]), atol=0.01, rtol=0)
    assert thumbnail(np.ones((28, 500, 900), np.float32), source).shape[1:] == (100, 180)  # 160 at least, every 5th


def test_the_tool(tmp_path: Path) -> None:
    folder = tmp_path / "cubes"
    folder.mkdir()
    write_cube(folder / "fine.tif", noisy())
    write_cube(folder / "bad.tif", changed(noisy(), lambda values: values[5].fill_(0)))
    (folder / "broken.tif").write_bytes(b"II*\0")
    out = tmp_path / "report"
    result = run("inspect_cubes", folder, "--out", out, status=1)
    assert "bad bands at 476 nm" in result.stdout
    assert result.stderr.startswith(f"failed: {folder / 'broken.tif'}: its format is not recognised")
    assert result.stderr.count("\n") == 1
    assert sorted(path.name for path in out.iterdir()) == ["contact_sheet.png", "cubes.json", "spectra.png"]
    for name in ("contact_sheet.png", "spectra.png"):
        with Image.open(out / name) as picture:
            assert np.asarray(picture).std() > 5
    facts = json.loads((out / "cubes.json").read_text())
    assert [fact["remarks"] for fact in facts] == [["bad bands at 476 nm"], []]
    (folder / "broken.tif").unlink()
    document = json.loads(run("inspect_cubes", folder, "--out", out, "--json").stdout)
    assert [fact["bad_bands"] for fact in document["cubes"]] == [[5], []]


def test_the_tool_on_other_formats_and_wrong_calls(tmp_path: Path) -> None:
    for folder in ("in", "empty"):
        (tmp_path / folder).mkdir()
    writers.cave(tmp_path / "in")
    writers.kaist(tmp_path / "in")
    run("inspect_cubes", tmp_path / "in", "--out", tmp_path / "out")
    assert "there are no cubes" in run("inspect_cubes", tmp_path / "empty", "--out", tmp_path, status=2).stderr
    assert "no file or folder" in run("inspect_cubes", tmp_path / "none", "--out", tmp_path, status=2).stderr
    (tmp_path / "file").write_text("")
    assert "is a file" in run("inspect_cubes", tmp_path / "in", "--out", tmp_path / "file", status=2).stderr


def test_what_cannot_be_inspected(tmp_path: Path) -> None:
    (tmp_path / "a.tif").write_bytes(b"x")
    with pytest.raises(CubeError, match="not recognised"):
        inspect(tmp_path / "a.tif")
    with pytest.raises(FileNotFoundError, match="no file or folder"):
        inspect(tmp_path / "b.tif")


@pytest.mark.slow
def test_the_tool_as_a_process(tmp_path: Path) -> None:
    write_cube(tmp_path / "a.tif", noisy())
    environment = os.environ | {"PYTHONPATH": str(TOOLS.parent), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(TOOLS / "inspect_cubes.py"), str(tmp_path / "a.tif"), "--out", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120, check=False)
    assert done.returncode == 0
    assert stores.quiet(done.stderr) == ""  # no terminal: no bar
    assert "\x1b" not in done.stdout
    assert "noisy" in done.stdout
