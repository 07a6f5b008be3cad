"""How things are timed and written down: side by side in one process, A B A B, in CPU seconds of one thread.

The machine is shared, so a time alone says little: each round runs the baseline and then every contestant, and the
ratio is taken within the round. What is published is the median of the rounds' ratios.
"""

from __future__ import annotations

import io
import statistics
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from rich.console import Console
from rich.table import Table

from kcam import measure, plots
from kcam.measure import write_json as write_json

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Contestant:
    """One way to compute something.

    who: for the table. call: what is timed. check: errors of its result against the float64 reference, by name.
    dtype: of the result. default: whether it is what kcam does unless told. share: part of the whole work that `call`
    does (a loop over a fair sample of the wavelengths, say); its time is divided by it. once: it is there for its
    error, and too slow to be timed more than once.
    """

    who: str
    call: Callable[[], Any]
    check: Callable[[Any], dict[str, float]]
    dtype: str = "float32"
    default: bool = False
    share: float = 1.0
    once: bool = False

    @property
    def ours(self) -> bool:
        """Whether this is kcam."""
        return self.who.startswith("kcam")


def race(
    op: str, *, size: str, direction: str, contestants: list[Contestant], seconds: float, most_rounds: int = 9
) -> list[dict[str, Any]]:
    """Time the contestants side by side; the first is the baseline that all ratios refer to.

    Args:      op, size, direction: for the rows. seconds: roughly how long the rounds may take; at least 3 of them
               (1 where seconds is 0), after a warm-up, which gives memory and errors.
    Returns:   a row for each contestant: its time, the ratio of times (baseline over it), its errors, and the ratio of
               errors (the best baseline's over it, the least over the kinds of error that are called l1).
    """
    rows, once = [], []
    for contestant in contestants:
        result, first_call, memory = measure.watched(contestant.call)
        rows.append(
            {
                "op": op,
                "who": contestant.who,
                "direction": direction,
                "size": size,
                "dtype": contestant.dtype,
                "device": "cpu",
                "threads": torch.get_num_threads(),
                "default": contestant.default,
                "baseline": not contestant.ours,
                "share_timed": contestant.share,
                "error": contestant.check(result),
                "peak_memory": memory,
                "first_call": first_call / contestant.share,
            }
        )
        del result
        once.append(measure.cpu_time(contestant.call) if contestant.ours else first_call)
    repeats = [0 if c.once else max(1, min(5, int(0.25 * once[0] / t))) for c, t in zip(contestants, once, strict=True)]
    round_time = sum(t * r for t, r in zip(once, repeats, strict=True))
    rounds = max(3, min(most_rounds, int(seconds / round_time))) if seconds else 1
    times: list[list[list[float]]] = [
        [] if not c.once else [[t / c.share]] for c, t in zip(contestants, once, strict=True)
    ]
    for _ in range(rounds):
        for own, contestant, count in zip(times, contestants, repeats, strict=True):
            if count:
                own.append([measure.cpu_time(contestant.call) / contestant.share for _ in range(count)])
    for row, own in zip(rows, times, strict=True):
        every = [t for part in own for t in part]
        # zip: a contestant that is timed once meets the first round alone
        ratios = [statistics.median(base) / statistics.median(part) for base, part in zip(times[0], own, strict=False)]
        row["seconds"] = statistics.median(every)
        row["seconds_iqr"] = np.percentile(every, [25, 75]).tolist()
        row["ratio"] = statistics.median(ratios)
        row["ratio_iqr"] = np.percentile(ratios, [25, 75]).tolist()
        row["rounds"], row["calls"] = len(own), len(every)
        row["error_ratio"] = None if row["baseline"] else _error_ratio(row, rows)
    return rows


def _error_ratio(row: dict[str, Any], rows: list[dict[str, Any]]) -> float | None:
    """How many times lower the error is than the best baseline's: the least over median, max and so on."""
    kinds = [kind for kind in row["error"] if kind.startswith("l1")]
    best = {kind: min(other["error"][kind] for other in rows if other["baseline"]) for kind in kinds}
    return min((best[kind] / row["error"][kind] for kind in kinds), default=None)


# ---- what is written ---------------------------------------------------------------------------------------------


def environment() -> dict[str, Any]:
    """Where and when: commit, versions, machine, date."""
    clock = "CPU seconds of the process; ratios are taken within a round, and their median is given"
    return measure.environment() | {"commit": _commit(), "clock": clock}


def _commit() -> str:
    """Hash of HEAD, marked where the working tree differs from it."""
    try:
        head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True)
        changed = subprocess.run(
            ["git", "status", "--porcelain", "--", "kcam", "benchmarks/*.py"],
            cwd=ROOT, capture_output=True, text=True, check=True,
        )  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return head.stdout.strip() + (" with changes" if changed.stdout.strip() else "")


def print_table(console: Console, rows: list[dict[str, Any]]) -> None:
    """The rows, one small table for each race, in the same columns."""
    for op, direction in dict.fromkeys((row["op"], row["direction"]) for row in rows):
        race_rows = [row for row in rows if (row["op"], row["direction"]) == (op, direction)]
        table = Table(
            title=f"[bold]{op}[/], {direction}  [dim]{race_rows[0]['size']}[/]", box=None, title_justify="left"
        )
        table.add_column("", min_width=33)
        for name, width in (("error: median/max", 17), ("gradient: L2/1-cos", 17)):
            table.add_column(name, min_width=width, no_wrap=True)
        for name, width in (("CPU ms", 6), ("IQR", 11), ("MB", 5), ("first", 6), ("faster", 6), ("lower error", 6)):
            table.add_column(name, justify="right", min_width=width, no_wrap=True)
        for row in race_rows:
            low, high = row["seconds_iqr"]
            table.add_row(
                row["who"] + (" [dim](default)[/]" if row["default"] else ""),
                _errors(row["error"], "l1_median", "l1_max", "relative_max"),
                _errors(row["error"], "gradient", "1 - cosine"),
                f"{row['seconds'] * 1e3:.0f}",
                f"{low * 1e3:.0f}-{high * 1e3:.0f}",
                "-" if row["peak_memory"] is None else f"{row['peak_memory'] / 1e6:.0f}",
                f"{row['first_call'] * 1e3:.0f}",
                "-" if row is race_rows[0] else f"{row['ratio']:.3g}",
                "-" if row["error_ratio"] is None else f"{row['error_ratio']:.3g}",
            )
        console.print(table, "")


def _errors(error: dict[str, float], *kinds: str) -> str:
    return " / ".join(f"{error[kind]:.1e}" for kind in kinds if kind in error)


def save_jpeg(figure: Any, path: Path, *, resolutions: Sequence[float] = (200,), largest: int = 400_000) -> None:
    """A figure as a JPEG of at most `largest` bytes, at the first of `resolutions` [dots per inch] that allows it."""
    for resolution in resolutions:
        picture = Image.open(io.BytesIO(plots.figure_bytes(figure, resolution=resolution))).convert("RGB")
        for quality in (92, 88, 84, 80, 75, 70):
            picture.save(path, quality=quality, subsampling=0, optimize=True)  # colours at full resolution
            if path.stat().st_size < largest:
                return
    raise ValueError(f"{path.name} has {path.stat().st_size} bytes at quality {quality}; expected < {largest}.")
