"""Time and memory of a call, and the machine that they were measured on.

The machine is shared as a rule, so time is that of the process: CPU seconds, of one thread where they are to be
compared. Compare two calls by turns, A B A B.
"""

from __future__ import annotations

import ctypes
import json
import platform
import re
import time
from collections.abc import Callable
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

VERSIONS = ("torch", "numpy", "scipy", "kornia")


def cpu_time(call: Callable[[], Any]) -> float:
    """CPU seconds of a call.

    Example:
    >>> from kcam.measure import cpu_time
    >>> 0 <= cpu_time(lambda: torch.rand(100, 100) @ torch.rand(100, 100)) < 10  # seconds
    True
    """
    start = time.process_time()
    call()
    return time.process_time() - start


def watched(call: Callable[[], Any]) -> tuple[Any, float, int | None]:
    """(result, CPU seconds, bytes of memory at the peak beyond those at the start; None where Linux does not say).

    Example:
    >>> from kcam.measure import watched
    >>> result, seconds, peak = watched(lambda: torch.ones(1_000_000).sum())
    >>> float(result), seconds >= 0
    (1000000.0, True)
    """
    before = _resident(reset=True)
    start = time.process_time()
    result = call()
    seconds = time.process_time() - start
    peak = _resident()
    return result, seconds, None if before is None or peak is None else max(0, peak - before)


def _resident(*, reset: bool = False) -> int | None:
    """Peak resident memory of this process since the last reset [bytes]."""
    try:
        if reset:
            ctypes.CDLL(None).malloc_trim(0)  # what the allocator keeps would hide what the call needs
            Path("/proc/self/clear_refs").write_text("5")
        found = re.search(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())
        return int(found[1]) * 1024 if found else None
    except (OSError, AttributeError):
        return None


def environment() -> dict[str, Any]:
    """Where and when: versions, machine, threads, date.

    Example:
    >>> from kcam.measure import environment
    >>> sorted(environment())
    ['date', 'machine', 'threads', 'versions']
    """
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {"python": platform.python_version(), **{name: metadata.version(name) for name in VERSIONS}},
        "machine": f"{platform.system()} {platform.machine()}, {_processor()}",
        "threads": torch.get_num_threads(),
    }


def _processor() -> str:
    try:
        found = re.search(r"model name\s*:\s*(.+)", Path("/proc/cpuinfo").read_text())
    except OSError:
        found = None
    return found[1] if found else platform.processor() or "unknown processor"


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Numbers with four digits: more would only make diffs.

    Example:
    >>> from pathlib import Path
    >>> from kcam.measure import write_json
    >>> write_json(Path("found.json"), {"seconds": 0.123456})
    >>> print(Path("found.json").read_text())
    {
     "seconds": 0.1235
    }
    """

    def rounded(value: Any) -> Any:
        if isinstance(value, float):
            return float(f"{value:.4g}")
        if isinstance(value, dict):
            return {key: rounded(item) for key, item in value.items()}
        return [rounded(item) for item in value] if isinstance(value, list) else value

    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(rounded(content), indent=1) + "\n")
