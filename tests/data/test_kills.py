"""Killed at any moment, gone on with, and the same in every byte; nothing is left over."""

from __future__ import annotations

import contextlib
import random
import signal
import subprocess
import time
from pathlib import Path

import pytest
import stores
from deaths import Death, Killed
from stores import SETTINGS, content, make_cubes, make_store

from kcam.data import extract, make_plan, verify


@pytest.mark.parametrize("after", [False, True], ids=["before", "after"])
def test_death_at_every_change_of_the_disk(tmp_path: Path, after: bool):
    cubes = make_cubes(tmp_path / "cubes", ("apple", "gate"), height=24, width=24)
    whole = content(make_store(cubes, tmp_path / "whole"))
    deaths = 0
    while True:
        out = tmp_path / f"out{deaths}"
        with pytest.MonkeyPatch.context() as patch:
            death = Death(patch, deaths, after=after)
            with contextlib.suppress(Killed):
                extract(make_plan(cubes, SETTINGS), out)
        if not death.dead:
            break
        outcome = extract(make_plan(cubes, SETTINGS), out, resume=True)
        assert outcome.finished, deaths
        assert content(out) == whole, deaths
        assert verify(out) == []
        assert not (out / ".work").exists()
        deaths += 1
    # a plan, two scenes and their records, two manifests: 7 files, each synced and renamed; folders; the end
    assert deaths > 25


def test_death_upon_death(tmp_path: Path):
    """On the same folder, again and again, until a run comes through: the last part alone takes some 40 steps."""
    cubes = make_cubes(tmp_path / "cubes", ("apple", "gate", "ink"), height=24, width=24)
    whole = content(make_store(cubes, tmp_path / "whole"))
    out, draw = tmp_path / "out", random.Random(0)
    for _ in range(200):
        with pytest.MonkeyPatch.context() as patch:
            death = Death(patch, draw.randrange(1, 60), after=draw.random() < 0.5)
            with contextlib.suppress(Killed):
                extract(make_plan(cubes, SETTINGS), out, resume=True)
        if not death.dead:
            break
    assert not death.dead
    assert content(out) == whole


KILLS = 20


@pytest.mark.slow  # 30 processes that import torch, and their workers
@pytest.mark.parametrize("workers", [1, 2])
def test_sigkill_at_random_moments(tmp_path: Path, workers: int):
    """Killed, gone on with, killed again, until it is done; then from the start, until 20 kills are used up."""
    names = tuple(f"scene {index}" for index in range(8))
    cubes = make_cubes(tmp_path / "cubes", names, height=384, width=384)
    options = ("--size", 64, "--stride", 24, "--split", "0.7/0.3", "--workers", workers)

    def begin(out: Path) -> subprocess.Popen[str]:
        return stores.start("extract_patches", cubes, "--out", out, "--resume", *options)

    def finish(out: Path) -> float:
        """Run it to its end: the seconds from the first file to the last."""
        process = begin(out)
        first = wait_for_work(process, out)
        _, err = process.communicate(timeout=300)
        assert process.returncode == 0, err
        assert not stores.left(process.pid)
        return time.monotonic() - first

    working = finish(tmp_path / "whole")
    whole = content(tmp_path / "whole")
    assert verify(tmp_path / "whole") == []
    draw, kills, round_, progress = random.Random(workers), 0, 0, set()
    while kills < KILLS:
        out = tmp_path / f"out{round_}"
        round_ += 1
        for _ in range(4):  # at most, so that most kills meet young stores and old ones
            process = begin(out)
            wait_for_work(process, out)
            time.sleep(draw.random() * working)
            if process.poll() is None:
                process.send_signal(signal.SIGKILL)  # the process alone: its workers must end by themselves
                kills += 1
                progress.add(len(list(out.glob(".work/done/*.json"))))
            process.communicate(timeout=300)
            assert not stores.left(process.pid), "workers outlive their parent"
            if process.returncode == 0 or kills == KILLS:
                break
        finish(out)
        assert content(out) == whole
        assert not (out / ".work").exists()
    # how many scenes are done at a kill is the machine's affair: 3 to 8 different numbers were met
    assert len(progress) > 1, "all kills met the same stage of the work"


def wait_for_work(process: subprocess.Popen[str], out: Path) -> float:
    """Until a run has started to write, or is over; the time."""
    before = written(out)
    deadline = time.monotonic() + 120
    while process.poll() is None and written(out) in (None, before) and time.monotonic() < deadline:
        time.sleep(0.005)
    return time.monotonic()


def written(out: Path) -> int | None:
    """When the plan of the work was written; None where there is none, or it is being taken away."""
    try:
        return (out / ".work" / "plan.json").stat().st_mtime_ns
    except OSError:
        return None
