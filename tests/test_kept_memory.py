"""Freed memory that stays with the process."""

from __future__ import annotations

import ctypes
import resource
import subprocess
import sys

import pytest

from kcam import memory

GLIBC = sys.platform.startswith("linux") and hasattr(ctypes.CDLL(None), "gnu_get_libc_version")

AGAIN = """
import resource, torch
from kcam import memory

def faults():
    torch.ones(2**25)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(8):
        torch.ones(2**25)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

as_it_is = faults()
assert memory.keep()
print(as_it_is, faults())
"""


@pytest.mark.skipif(not GLIBC, reason="a setting of glibc")
@pytest.mark.slow
def test_blocks_are_taken_from_the_system_once() -> None:
    """128 MB eight times, a page fault for each page: with memory that is kept none is cleared anew."""
    done = subprocess.run([sys.executable, "-c", AGAIN], capture_output=True, text=True, check=True)
    faults = [int(count) for count in done.stdout.split()]
    assert faults[0] > 8 * 2**27 / resource.getpagesize() / 4  # huge pages are fewer
    assert faults[1] < faults[0] / 3  # where a block lies may change once


def test_elsewhere_it_is_said_that_memory_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory.sys, "platform", "darwin")
    assert memory.keep() is False
