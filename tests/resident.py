"""The largest memory of this process, for scripts that tests start; Linux alone tells."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import pytest

PATH = os.pathsep.join([str(Path(__file__).parents[1]), str(Path(__file__).parent)])
"""PYTHONPATH for a script that imports kcam and this."""

on_linux = pytest.mark.skipif(sys.platform != "linux", reason="/proc/self/status is Linux's")


def peak() -> int:
    """Bytes. Not getrusage's: on Linux that counts what the parent held when it started this process."""
    found = re.search(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())
    assert found
    return 1024 * int(found[1])
