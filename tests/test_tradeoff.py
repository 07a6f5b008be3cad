"""The sweep of accuracy against time: that errors behave, nothing is dropped, and the words and pictures follow."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import commands
import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from kcam import Camera, demo, isp, optics, plots, sensor, tradeoff
from kcam.optics.propagation import reference
from kcam.scene import Scene
from kcam.tradeoff import Row, Sweep, measurement
from kcam.units import mm, um, wavelength_grid


def of(result: Sweep, knob: str) -> list[Row]:
    return [row for row in result.rows if row.knob == knob]


def row(result: Sweep, name: str) -> Row:
    return next(row for row in result.rows if row.name == name)


@pytest.fixture(scope="module")
def tiny() -> Sweep:
    """The demo's lens on 22 x 32 pixels with depth; everything but the slow ways to propagate."""
    knobs = [name for name in tradeoff.KNOBS if name not in ("propagator", "baseline")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measurement, "LONGEST", math.inf)  # else a stall of a busy machine leaves a row without errors
        return tradeoff.sweep(demo.singlet(), Scene.builtin("motorcycle", 32), knobs=knobs, seconds=0.2, title="tiny")


def with_doe() -> Camera:
    lens = optics.Lens(
        optics.CircularAperture(1 * mm),
        optics.ThinLens(focal_length=50 * mm),
        optics.DOE(torch.rand(8, 8, generator=torch.Generator().manual_seed(0))),
        focus_distance=2.0,
    )
    imaging = optics.Imaging(lens, pixel_pitch=6 * um, propagator="fresnel", psf_shape=(21, 21))
    return Camera(imaging, sensor.ColourFilter.nikon(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve())


@pytest.fixture(scope="module")
def rows_of_every_propagator() -> Sweep:
    """Without the textbook's large grid, which takes as long as all others together and has a slow test."""
    scene, every = Scene.builtin("star", 20, wavelengths=wavelength_grid(count=2)), tradeoff.KNOBS["baseline"]

    def baselines(*arguments: Any) -> Iterator[tradeoff.Setting]:
        return (setting for setting in every(*arguments) if setting.name != "textbook 891")

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(tradeoff.KNOBS, "baseline", baselines)
        return tradeoff.sweep(with_doe(), scene, knobs=["propagator", "baseline"], seconds=0)


def test_the_camera_as_it_is_is_accurate(tiny: Sweep) -> None:
    assert tiny.default.raw_rms < 1e-6  # float32
    assert tiny.default.delta_e < 1e-2  # a level of 12 bits here and there
    assert tiny.default.psf_l1 < 3e-5  # the pixel's filter, cut 8 pixels beyond this window of 23
    assert row(tiny, "float64").raw_rms < 1e-12


@pytest.mark.parametrize(
    ("knob", "names", "falls"),
    [
        ("wavelengths", ("3 wavelengths", "7 wavelengths", "14 wavelengths"), 2.0),
        ("depth", ("1 layer", "3 layers", "9 layers"), 2.0),
        ("depth", ("3 layers, nearest", "9 layers, nearest", "18 layers, nearest"), 1.5),
        ("support", ("9 px", "17 px"), 1.5),
        ("rank", ("rank 1", "rank 2", "as bands"), 2.0),
    ],
)
def test_more_work_less_error(tiny: Sweep, knob: str, names: tuple[str, ...], falls: float) -> None:
    rows = [row(tiny, name) for name in names]
    assert {row.knob for row in rows} == {knob}
    errors = [row.raw_rms for row in rows]
    assert all(a > falls * b for a, b in pairwise(errors)), errors
    assert errors[-1] > 0.5 * tiny.default.raw_rms
    assert rows[0].delta_e > rows[-1].delta_e


def test_samples(tiny: Sweep) -> None:
    rows = of(tiny, "samples")
    counts = [int(row.name.split()[0]) for row in rows]
    assert counts == sorted(set(counts))
    assert rows[0].raw_rms > 10 * rows[-1].raw_rms  # kappa 1.3 against 5
    assert rows[0].psf_l1 > rows[-1].psf_l1


def test_what_a_knob_does_not_change_is_left_empty(tiny: Sweep) -> None:
    for other in tiny.rows:
        assert (other.psf_l1 is None) == (other.knob in ("depth", "rank", "demosaic"))
        assert (other.raw_rms is None) == (other.knob == "demosaic")
        assert other.refused is None
        assert other.seconds > 0
        assert other.calls >= 1
    assert {row.name for row in of(tiny, "demosaic")} == {n for n, m in isp.DEMOSAICS.items() if "RGGB" in m.patterns}
    assert all(0.1 < row.delta_e < 20 for row in of(tiny, "demosaic"))
    assert row(tiny, "point samples").psf_l1 > 1e-2


def test_every_propagator_is_there_or_says_why_not(rows_of_every_propagator: Sweep) -> None:
    result = rows_of_every_propagator
    names = {row.name for row in of(result, "propagator")} | {result.default.name}
    assert names == {f"{physics} {method}" for physics, method in optics.PROPAGATORS}
    refused = {row.name: row.refused for row in result.rows if row.refused}
    assert set(refused) == {"nonparaxial radial", "fresnel radial", "geometric rays", "textbook 891, 3x3 a pixel"}
    assert "needs a lens of rotationally symmetric elements" in refused["fresnel radial"]
    assert result.default.name.startswith("fresnel")
    for other in of(result, "propagator"):
        if other.refused is None and not other.name.startswith("angular"):
            assert other.psf_l1 < 5e-3  # at f/50 the models agree
    assert row(result, "textbook 256").baseline
    assert row(result, "reference quadrature").psf_l1 == result.reference["doubled_sampling_changes"]


def test_a_camera_with_another_model_turns_its_knobs_on_the_nonparaxial_one() -> None:
    every = tradeoff.settings(with_doe(), Scene.builtin("star", 20), knobs=["wavelengths", "propagator"])
    assert [s.camera[0].propagator for s in every if s.default] == ["fresnel"]
    assert {s.camera[0].propagator for s in every if s.knob == "wavelengths"} == {"nonparaxial"}
    assert [s.default for s in every].count(True) == 1


def made(*rows: tuple[str, float, float | None], default: str = "here") -> Sweep:
    return Sweep("t", "s", tuple(Row("k", name, raw_rms=e, seconds=t, default=name == default) for name, t, e in rows))


HAND = made(("here", 1.0, 1e-3), ("fast", 0.25, 2e-2), ("slow", 4.0, 1e-4), ("bad", 3.0, 1e-3), ("no", 0.1, None))


def test_the_front_of_rows_by_hand() -> None:
    assert [row.name for row in HAND.pareto()] == ["fast", "here", "slow"]
    same = made(("here", 1.0, 1e-3), ("tie", 1.0, 1e-3), ("worse", 1.0, 2e-3))
    assert [row.name for row in same.pareto()] == ["here"]
    assert HAND.pareto("psf_l1") == []
    assert tradeoff.front([*HAND.rows, Row("k", "no", refused="x")], "raw_rms") == HAND.pareto()


def test_the_sentence_of_rows_by_hand() -> None:
    assert HAND.sentence() == (
        "On this machine the next factor of ten in accuracy costs 4 times the time: slow has a raw error of 1.0e-04 in "
        "4.0 s, the camera as it is a raw error of 1.0e-03 in 1.0 s. Giving accuracy up, fast takes 0.25 times the "
        "time for a raw error of 2.0e-02."
    )
    best = made(("here", 0.5, 1e-3), ("near", 2.0, 2e-4))
    assert best.sentence() == (
        "On this machine no setting is ten times as accurate as the camera as it is, a raw error of 1.0e-03 in 500 ms."
    )
    fresnel = made(("fresnel fft", 0.5, 1e-3), default="fresnel fft")
    assert fresnel.sentence().endswith(
        "The camera's own model is fresnel; all knobs but the propagator are turned on the non-paraxial one."
    )
    refused = Sweep("t", "s", (Row("k", "here", default=True, refused="it is too dark."),))
    assert refused.sentence() == "The camera as it is was not measured: it is too dark."


def test_the_sweep_marks_its_front(tiny: Sweep) -> None:
    assert [row for row in tiny.rows if row.pareto] == sorted(tiny.pareto(), key=tiny.rows.index)
    assert row(tiny, "float64").pareto


def test_json_round_trip(tiny: Sweep, tmp_path: Path) -> None:
    refused = Row("k", "no", refused="because", seconds_iqr=None)
    tiny = replace(tiny, rows=(*tiny.rows, refused))
    tiny.save(tmp_path / "one.json")
    loaded = Sweep.load(tmp_path / "one.json")
    loaded.save(tmp_path / "two.json")
    assert (tmp_path / "one.json").read_text() == (tmp_path / "two.json").read_text()
    assert [row.name for row in loaded.rows] == [row.name for row in tiny.rows]
    assert loaded.rows[-1] == refused
    for a, b in zip(loaded.rows, tiny.rows, strict=True):
        for name in ("raw_rms", "seconds", "psf_l1"):
            assert getattr(a, name) == (getattr(b, name) and pytest.approx(getattr(b, name), rel=1e-3))
    content = json.loads((tmp_path / "one.json").read_text())
    assert content["environment"].keys() >= {"versions", "machine", "threads", "date", "clock"}
    assert content["environment"]["threads"] == 1
    assert content["reference"]["doubled_sampling_changes"] < content["reference"]["limit"]
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(ValueError, match="is not a sweep that kcam tradeoff wrote"):
        Sweep.load(tmp_path / "other.json")


def test_the_table_shows_every_row(tiny: Sweep) -> None:
    refused = Row("k", "no", refused="a reason")
    table = replace(tiny, rows=(*tiny.rows, refused)).table()
    assert table.row_count == len(tiny.rows) + 1
    cells = [list(column.cells) for column in table.columns]
    assert cells[0].count("*") == len(tiny.pareto())
    assert cells[3][-1] == "refused"
    assert table.caption.endswith("no refused: a reason")


def test_every_point_of_the_figure_has_a_label_of_its_own(tiny: Sweep) -> None:
    figure = plots.tradeoff_figure(tiny)
    renderer = FigureCanvasAgg(figure).get_renderer()
    for axes, error in zip(figure.axes, ("raw_rms", "psf_l1"), strict=True):
        shown = [row for row in tiny.rows if getattr(row, error) is not None]
        assert sorted(text.get_text() for text in axes.texts) == sorted(row.name for row in shown)
        boxes = [text.get_window_extent(renderer) for text in axes.texts]
        assert not any(a.shrunk(0.97, 0.75).overlaps(b.shrunk(0.97, 0.75)) for a, b in combinations(boxes, 2))
        frame = axes.get_window_extent(renderer)
        assert all(frame.x0 - 1 <= box.x0 and box.x1 <= frame.x1 + 1 for box in boxes)


def test_bad_input(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene.builtin("star", 16)
    with pytest.raises(ValueError, match="no optics.Imaging, so no knob trades its accuracy. Try Camera.phone"):
        tradeoff.sweep(Camera.ideal(), scene)
    with pytest.raises(ValueError, match="unknown knob lens; there are: propagator, samples, precision"):
        tradeoff.sweep(demo.singlet(), scene, knobs=["lens"])
    monkeypatch.setattr(Scene, "device", property(lambda self: torch.device("cuda")))
    with pytest.raises(ValueError, match=r"the scene is on cuda. Use scene.to\('cpu'\)"):
        tradeoff.sweep(demo.singlet(), scene)


def run(*arguments: object, status: int = 0) -> str:
    return commands.run("tradeoff", *arguments, status=status)


def test_the_command_writes_both_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = functools.partial(tradeoff.sweep, knobs=["wavelengths"], seconds=0)
    monkeypatch.setattr(tradeoff, "sweep", few)
    photo = np.random.default_rng(0).integers(0, 256, (60, 90, 3), dtype=np.uint8)
    Image.fromarray(photo).save(tmp_path / "photo.png")
    output = run("--scene", tmp_path / "photo.png", "--size", 24, "--out", tmp_path / "new" / "folder")
    assert "On this machine" in output
    assert "7 wavelengths" in output
    sweep = Sweep.load(tmp_path / "new" / "folder" / "tradeoff.json")
    assert (sweep.title, sweep.scene) == ("singlet on photo", "16 x 24 pixels, 28 wavelengths, 2 m")
    with Image.open(tmp_path / "new" / "folder" / "tradeoff.png") as figure:
        assert figure.width > 900


def test_the_command_says_what_stands_in_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file keeps four digits: 465.46 ms is 465 ms as measured, and 465.5, so 466 ms, as written."""
    rows = (
        Row("default", "here", raw_rms=1e-4, seconds=0.3, default=True, pareto=True),
        Row("k", "close", raw_rms=1e-6, seconds=0.46546, pareto=True),
    )
    monkeypatch.setattr(tradeoff, "sweep", lambda *_, **__: Sweep("t", "s", rows))
    output = run("--scene", "star", "--size", 16, "--out", tmp_path)
    sentence = Sweep.load(tmp_path / "tradeoff.json").sentence()
    assert sentence != Sweep("t", "s", rows).sentence()
    assert sentence in " ".join(output.split())


def test_what_the_user_got_wrong_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert 'unknown scene "moon"' in run("--scene", "moon", "--out", tmp_path, status=2)
    assert "no optics.Imaging" in run("--camera", "ideal", "--out", tmp_path, status=2)
    monkeypatch.setattr(reference, "SMOOTH_LIMIT", 1e-20)
    line = run("--scene", "star", "--size", 16, "--out", tmp_path, status=2)
    assert line.startswith("kcam: the reference is not converged here: twice its sampling changes it by")
    assert line.count("\n") == 1
    assert not (tmp_path / "tradeoff.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["singlet", "thesis"])
def test_the_command_measures_every_knob(camera: str, tmp_path: Path) -> None:
    output = run("--camera", camera, "--out", tmp_path)
    result = Sweep.load(tmp_path / "tradeoff.json")
    assert {row.knob for row in result.rows} >= {
        "default",
        "propagator",
        "samples",
        "wavelengths",
        "support",
        "baseline",
    }
    assert result.sentence() in " ".join(output.split())
    assert all(row.seconds is not None or row.refused for row in result.rows)
