from __future__ import annotations

import json
import time
from pathlib import Path

import torch

from kcam import measure


def test_memory_at_the_peak_is_seen_after_it_is_freed() -> None:
    def work() -> int:
        return len(torch.ones(50_000_000))  # 200 MB that do not outlive the call

    result, seconds, memory = measure.watched(work)
    assert result == 50_000_000
    assert seconds > 0
    assert memory is None or 190e6 < memory < 260e6  # None where Linux does not say


def test_waiting_takes_no_cpu_time() -> None:
    assert measure.cpu_time(lambda: time.sleep(0.2)) < 0.1


def test_json_has_four_digits(tmp_path: Path) -> None:
    measure.write_json(tmp_path / "new" / "x.json", {"a": [1.23456, (2.0, 3)], "b": {"c": 1e-7 / 3}, "d": True})
    content = json.loads((tmp_path / "new" / "x.json").read_text())
    assert content == {"a": [1.235, [2.0, 3]], "b": {"c": 3.333e-08}, "d": True}
