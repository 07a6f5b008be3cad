"""Extraction holds a strip of the cube, never the cube."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import resident
from stores import cube, values

from kcam.data import PatchDataset, write_cube
from kcam.data import cube as cube_files
from kcam.data.cube import Source, open_cube, write_source
from kcam.data.patches import Settings
from kcam.data.patches.scene import brightest, strips
from kcam.units import nm

SCRIPT = """
import json, sys
from pathlib import Path
from kcam.data.cube import open_cube
from kcam.data.patches import Settings, extract, make_plan
from kcam.data.patches.scene import brightest
from resident import peak

start = peak()
cubes, out = map(Path, sys.argv[1:])
brightest(open_cube(cubes), 256)
first = peak()
outcome = extract(make_plan(cubes, Settings(256, 128, (("train", 1.0),))), out)
print(json.dumps({"start": start, "brightest": first, "extract": peak(), "patches": outcome.patches}))
"""


@resident.on_linux
@pytest.mark.slow  # 4 GB of disk for a minute
def test_a_cube_of_a_gigabyte_takes_800_megabytes_at_most(tmp_path: Path):
    bands, height, width = 31, 2704, 3376
    draw = np.random.default_rng(0)
    row = draw.random((bands, 1, width), np.float32)

    def rows(first: int, last: int) -> tuple[np.ndarray, None]:
        slow = np.sin(np.arange(first, last, dtype=np.float32))[:, None]
        return np.abs(row * slow), None

    path, out = tmp_path / "large.tif", tmp_path / "out"
    try:
        write_source(path, Source("large", (bands, height, width), np.linspace(400, 700, bands) * nm, "radiance", rows))
        assert path.stat().st_size > 4 * bands * height * width
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT, path, out], capture_output=True, text=True, check=False,
            env=os.environ | {"PYTHONPATH": resident.PATH, "OMP_NUM_THREADS": "1"},
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout)
        assert found["patches"] == 20 * 25
        assert found["extract"] < 800e6, found
        # beyond what importing torch takes: a strip of 107 MB, half of another, and a patch
        assert found["extract"] - found["start"] < 350e6, found
        patches = PatchDataset(out / "train")
        _, y, x = patches.position(333)
        truth = rows(y, y + 256)[0][:, :, x : x + 256]
        assert np.abs(patches[333].values.numpy() - truth).max() < 1 / 65535
    finally:
        path.unlink(missing_ok=True)
        for left in out.rglob("*.npy"):
            left.unlink()


def test_no_more_than_a_strip_is_asked_for(tmp_path: Path):
    """The same at toy size: no call reads more rows than a patch has, and no row is read twice in a pass."""
    write_cube(tmp_path / "one.tif", cube(values(0, height=100, width=40)))
    source = open_cube(tmp_path / "one.tif")
    asked: list[tuple[int, int]] = []

    def rows(first: int, last: int):
        asked.append((first, last))
        return source.rows(first, last)

    watched = Source(source.name, source.shape, source.wavelengths, source.unit, rows)
    brightest(watched, 16)
    assert asked[0][0] == 0
    assert asked[-1][1] == 100
    assert all(one[1] == two[0] for one, two in pairwise(asked))
    assert max(last - first for first, last in asked) <= 16
    asked.clear()
    truth = source.rows(0, 100)[0]
    for top, strip, valid in strips(watched, Settings(size=16, stride=6)):
        assert np.array_equal(strip, truth[:, top : top + 16])
        assert valid is None
    assert asked == [(0, 16), *((top + 10, top + 16) for top in range(6, 85, 6))]


def test_writing_a_cube_asks_for_strips(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cube_files, "STRIP", 4 * 40 * 7)
    asked: list[int] = []
    content = values(0, height=100, width=40).numpy()

    def rows(first: int, last: int):
        asked.append(last - first)
        return content[:, first:last].copy(), None

    write_source(tmp_path / "one.tif", Source("one", content.shape, np.linspace(4e-7, 7e-7, 4), "radiance", rows))
    assert max(asked) == 7
    assert sum(asked) == 100
    assert np.array_equal(open_cube(tmp_path / "one.tif").rows(0, 100)[0], content)
