"""300 damaged files over all formats: no crash, no hang, no silent success. `fuzz.py` makes and judges them."""

from __future__ import annotations

import resource
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path

import fuzz
import pytest

HARMS = list(fuzz.HOSTILE)
FILES = 300
QUICK = (*range(1, 27), 28, 13548)  # each writer once; two that crashed OpenEXR and scipy
MEMORY = 4 * 2**30  # bytes of address space; torch and OpenCV take half of it
PATIENCE = 120.0  # s for a file of 100 kB, of which the slowest takes 1 s on a quiet machine


def judge(number: int) -> str:
    """The verdict on one file, in a folder of its own."""
    with tempfile.TemporaryDirectory() as folder:
        if number < len(HARMS):
            return fuzz.verdict(fuzz.hostile(HARMS[number], Path(folder)))
        return fuzz.verdict(fuzz.damaged(number, Path(folder)))


def _bound() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))


@pytest.mark.parametrize("name", [name for name in HARMS if name not in fuzz.BOMBS])
def test_hostile_files_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    assert fuzz.verdict(fuzz.hostile(name, tmp_path)).startswith("refused")


@pytest.mark.parametrize("seed", QUICK)
def test_damaged_files_are_refused_or_read_as_what_they_say(seed: int, tmp_path: Path) -> None:
    fuzz.verdict(fuzz.damaged(seed, tmp_path))


def test_the_judge_sees_a_silent_success(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = fuzz.Damaged("clean", fuzz.writers.npz(tmp_path).path, None)
    with pytest.raises(AssertionError, match="was read as"):
        fuzz.verdict(case)
    written = fuzz.writers.tiff(tmp_path)
    other = fuzz.writers.Written(written.path, written.values + 0.01, written.nm, 1e-7, "tiff", "radiance")
    for checked, text in ((True, "is not what was written"), (False, "is not what its bytes say")):
        if not checked:
            monkeypatch.setattr(fuzz, "plainly", lambda case: (other.values, fuzz.CAVE31 * 1e9, other.values[0] > 0))
        with pytest.raises(AssertionError, match=text):
            fuzz.verdict(fuzz.Damaged("x", written.path, other, {"wavelengths": fuzz.CAVE31}, checked))


@pytest.mark.slow
def test_300_files_crash_nothing_hang_nothing_and_fool_nobody(record_property) -> None:
    """In another process, with bounded memory, so that a crash of a library is seen and not suffered."""
    outcomes: Counter[str] = Counter()
    problems = []
    pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_bound)
    pool.submit(int).result()  # imports are not counted
    try:
        for number in range(FILES):
            future = pool.submit(judge, number)
            try:
                outcomes[future.result(timeout=PATIENCE).split(":")[0]] += 1
            except BrokenProcessPool:
                problems.append(f"{number}: a library crashed")
                pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_bound)
            except TimeoutError:
                problems.append(f"{number}: hangs")
                for process in list(pool._processes.values()):
                    process.kill()
                pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_bound)
            except Exception as error:
                problems.append(f"{number}: {type(error).__name__}: {error}")
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    assert not problems, "\n".join(problems)
    # that there is something of each, so that neither the damage nor the reader is all too simple
    assert outcomes["refused"] >= FILES // 2
    assert outcomes["as it says"] >= 20
    assert sum(outcomes.values()) == FILES
