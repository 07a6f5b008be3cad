"""The benchmarks run, at toy sizes, and what they write down is what they measured."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import pytest
import torch

sys.path.append(str(Path(__file__).parents[1]))

from benchmarks import bench
from benchmarks.common import Contestant, race


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> dict:
    path = tmp_path_factory.mktemp("bench") / "bench.json"
    assert bench.main(["--quick", "--out", str(path)]) == 0
    return json.loads(path.read_text())


def test_each_race_has_a_textbook_and_kcam_with_its_default(content):
    races = {}
    for row in content["rows"]:
        races.setdefault((row["op"], row["direction"]), []).append(row)
    assert {direction for _, direction in races} == {"forward", "forward + backward"}
    assert len(races) == 5 + 6 + 12
    for rows in races.values():
        assert rows[0]["baseline"]
        assert rows[0]["ratio"] == 1
        assert any(row["default"] for row in rows)


def test_rows_say_where_when_and_how_exactly(content):
    assert {"date", "commit", "versions", "machine", "threads"} <= content["environment"].keys()
    for row in content["rows"]:
        assert row["seconds"] > 0
        assert row["device"] == "cpu"
        assert row["threads"] == 1
        assert all(math.isfinite(value) for value in row["error"].values())


def test_kcam_is_closer_to_the_truth_than_the_textbook(content):
    for row in content["rows"]:
        if not row["baseline"] and "l1_max" in row["error"]:
            assert row["error"]["l1_max"] < 2e-3
            assert row["error_ratio"] > 10
        assert row["error"].get("relative_max", 0) < 1e-5
        if not row["baseline"]:
            assert row["error"].get("gradient", 0) < 5e-3
            assert row["error"].get("1 - cosine", 0) < 1e-5


def test_time_is_counted_for_the_whole_where_a_share_is_run():
    def work() -> torch.Tensor:
        return torch.ones(400, 400) @ torch.ones(400, 400)

    contestants = [
        Contestant("textbook", work, lambda _: {"l1_max": 1e-2}, share=0.1),
        Contestant("textbook, finer", work, lambda _: {"l1_max": 1e-3}, once=True),
        Contestant("kcam", work, lambda _: {"l1_max": 1e-5}),
    ]
    base, finer, ours = race("toy", size="1", direction="forward", contestants=contestants, seconds=0.05)
    assert base["rounds"] >= 3
    assert finer["calls"] == 1
    assert 3 < ours["ratio"] < 40
    assert ours["error_ratio"] == pytest.approx(100)


@pytest.mark.parametrize(("ratio", "difference", "met"), [(2.1, 1e-6, True), (1.9, 1e-6, False), (2.1, 1e-4, False)])
def test_a_target_is_met_only_when_fast_and_the_same(ratio, difference, met):
    row = {"op": "render cube", "direction": "forward", "who": "kcam", "default": True, "ratio": ratio}
    row |= {"error": {"relative_max": difference}, "error_ratio": None}
    target = bench.Target("cube", "render cube", 2, same_to=1e-5)
    assert [verdict["met"] for verdict in target.judge([row])] == [met]
