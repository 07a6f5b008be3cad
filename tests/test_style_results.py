"""The committed results of styles: all arms are there, and what the text says of them is so."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import style as benchmark
from kcam.style import STYLES

ROOT = Path(__file__).parents[1]
ALL = json.loads((ROOT / "benchmarks" / "results" / "style.json").read_text())["rows"]
ROWS = [row for row in ALL if row["seed"] == 0]
AGAIN = [row for row in ALL if row["seed"]]


def mean(style: str, arm: str) -> dict[str, float]:
    return next(row for row in ROWS if (row["style"], row["arm"]) == (style, arm))["mean"]


def test_every_arm_was_run_for_each_of_its_styles() -> None:
    expected = {(style, name) for name, arm in benchmark.ARMS.items() for style in arm.styles}
    assert {(row["style"], row["arm"]) for row in ROWS} == expected
    assert {(row["style"], row["arm"], row["seed"]) for row in AGAIN} == {
        ("strokes", "stage", 1),
        ("strokes", "stage", 2),
    }


@pytest.mark.parametrize("style", STYLES)
def test_a_camera_alone_brings_colour_and_no_strokes(style: str) -> None:
    camera, stage = mean(style, "convolution"), mean(style, "stage")
    assert camera["oriented_texture"] < 0.15
    assert stage["oriented_texture"] > camera["oriented_texture"] + 0.2
    assert stage["training_loss"] > camera["training_loss"] + 0.2
    assert camera["luminance_correlation"] > 0.9


AIMS = {"training_loss": 0.9, "patch_swd": 0.85, "oriented_texture": 0.55}


@pytest.mark.parametrize("style", STYLES)
def test_what_docs_say_of_the_aims(style: str) -> None:
    found = mean(style, "stage")
    missed = {name for name, aim in AIMS.items() if found[name] < aim}
    assert missed == ({"training_loss", "patch_swd"} if style == "woodcut" else set())
    assert min(found["luminance_correlation"], found["detail_correlation"]) >= 0.6
    row = next(row for row in ROWS if (row["style"], row["arm"]) == (style, "stage"))
    assert all(round(photo["luminance_correlation"], 2) >= 0.6 for photo in row["photographs"].values())


def test_what_docs_say_of_seeds() -> None:
    for row in AGAIN:
        missed = {name for name, aim in AIMS.items() if row["mean"][name] < aim}
        assert missed == ({"oriented_texture"} if row["seed"] == 1 else set())
        assert row["mean"]["oriented_texture"] >= 0.535
        for name in ("luminance_correlation", "detail_correlation"):
            assert all(round(photo[name], 2) >= 0.6 for photo in row["photographs"].values())


@pytest.mark.parametrize("style", STYLES)
def test_no_shot_is_a_wallpaper(style: str) -> None:
    row = next(row for row in ROWS if (row["style"], row["arm"]) == (style, "stage"))
    assert row["wallpaper"] < 0.45


@pytest.mark.parametrize("name", ["style", "style-parts", "style-thesis", "painted"])
def test_pictures_are_of_readme_size(name: str) -> None:
    assert 50_000 < (ROOT / "docs" / f"{name}.jpg").stat().st_size < 700_000
