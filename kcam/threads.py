"""How many threads torch computes with: no more than the cores that other work leaves free.

Threads that share a core with other work wait for each other at the end of every operation, and the OpenMP that torch
comes with lets them spin meanwhile, in the very time that the late one waits for. On two cores that two other processes
kept busy, a first picture of 512 x 512 took 16 s of CPU with two threads, and 1.05 s with one.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import torch

LOAD = Path("/proc/loadavg")
_LOOK_EVERY = 0.05  # seconds; a look takes a few per cent of a millisecond

_held: ContextVar[bool] = ContextVar("held", default=False)
_seen: ContextVar[tuple[float, int]] = ContextVar("seen", default=(-1.0, 1))


@contextmanager
def fixed(count: int | None = None) -> Iterator[None]:
    """So many threads for a while (None: as many as there are), whatever else runs: for the same last bits."""
    token = _held.set(True)
    try:
        with _threads(torch.get_num_threads() if count is None else count):
            yield
    finally:
        _held.reset(token)


@contextmanager
def no_more_than_free() -> Iterator[None]:
    """No more threads than cores are free now, and never more than there were: the last bits of sums may differ."""
    now = 1 if torch.compiler.is_compiling() else torch.get_num_threads()
    if now == 1 or _held.get():
        yield
        return
    with _threads(max(1, min(now, _free_now()))):
        yield


def free_cores() -> int:
    """Cores that this process may use, less what else wants to run on them; all where the system does not say."""
    total = os.cpu_count() or 1
    own = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else total
    return round(own * (1 - _running_elsewhere() / total))


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    if count == before:
        yield
        return
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _free_now() -> int:
    last, free = _seen.get()
    if not 0 <= time.monotonic() - last < _LOOK_EVERY:
        free = free_cores()
        _seen.set((time.monotonic(), free))
    return free


def _running_elsewhere() -> int:
    """Threads of other processes that run or wait for a core, at this moment; 0 where the system does not say."""
    try:
        running = int(LOAD.read_text().split()[3].partition("/")[0])
        if running <= 1:
            return 0
        own = sum(_runs(task) for task in Path("/proc/self/task").iterdir())
    except (OSError, ValueError, IndexError):
        return 0
    return max(0, running - own)


def _runs(task: Path) -> bool:
    return (task / "stat").read_text().rpartition(")")[2].split()[0] == "R"
