"""This version against an earlier one, on the races of `make bench`: what got slower, beside what noise looks like.

    python -m benchmarks.against 6be9aaf          half an hour; writes benchmarks/results/against.json
    python -m benchmarks.against 6be9aaf --quick  a minute, toy sizes: checks that everything runs

Three processes stop at the same call of the same race: two of the earlier version and one of this. They are timed in
turns, in CPU seconds of one thread, and the first is the baseline: what the second differs from it, in three rounds of
four, is the spread of a version raced against itself. A race is lost where this version takes more than 3 % plus that
spread longer, in the median of the rounds; one that seems lost is run four times as long before it counts.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve()
ROOT = HERE.parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "against.json"
ALLOWED = 0.03
LASTING = 0.2  # seconds of calls in a turn
CONTESTANTS = ("earlier", "earlier again", "this")


def serve(*, quick: bool) -> None:
    """Stop at each race of kcam's, and time it on demand: the version that PYTHONPATH names."""
    import torch
    from rich.console import Console

    from benchmarks import bench
    from kcam import measure

    answers, sys.stdout = sys.stdout, sys.stderr

    def race(op: str, *, direction: str, contestants: list[Any], **_: Any) -> list[Any]:
        for contestant in contestants:
            if contestant.who.startswith("kcam") and not contestant.once:
                contestant.call()
                print(json.dumps({"op": op, "direction": direction, "who": contestant.who}), file=answers, flush=True)
                while sys.stdin.readline().strip() == "go":
                    times = [measure.cpu_time(contestant.call)]
                    while sum(times) < LASTING:
                        times.append(measure.cpu_time(contestant.call))
                    print(json.dumps(statistics.median(times)), file=answers, flush=True)
        return []

    torch.set_num_threads(1)
    bench.race = race  # type: ignore[assignment]
    bench.measure(bench.QUICK if quick else bench.Sizes(), Console(file=sys.stderr))
    print(json.dumps(None), file=answers, flush=True)


@contextmanager
def checked_out(revision: str) -> Iterator[Path]:
    """A folder with the files of another version."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(
            ["git", "worktree", "add", "--detach", folder, revision], cwd=ROOT, check=True, stdout=sys.stderr
        )
        try:
            yield Path(folder)
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", folder], cwd=ROOT, check=True)


def started(root: Path, *, quick: bool) -> subprocess.Popen[str]:
    """A process that serves the version in a folder."""
    environment = os.environ | {"PYTHONPATH": f"{root}{os.pathsep}{root / 'tests'}", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-P", str(HERE), "--serve", *(["--quick"] if quick else []), "-"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    return subprocess.Popen(command, cwd=root, env=environment, text=True, **pipes)  # type: ignore[call-overload]


def told(process: subprocess.Popen[str]) -> Any:
    """What a process says next."""
    line = process.stdout.readline() if process.stdout else ""
    if not line:
        raise RuntimeError(f"a contestant ended with {process.wait()} before its races did.")
    return json.loads(line)


def say(process: subprocess.Popen[str], word: str) -> None:
    """Tell a process to go, or to go on."""
    assert process.stdin is not None
    print(word, file=process.stdin, flush=True)


def raced(processes: list[subprocess.Popen[str]], *, rounds: int) -> Iterator[dict[str, Any]]:
    """A row for each race; the order within a round turns, for what comes first finds the caches of the last."""
    while True:
        where = [told(process) for process in processes]
        if where[0] is None:
            return
        if any(one != where[0] for one in where):
            raise RuntimeError(f"the versions race differently: {where}")
        times: list[list[float]] = [[] for _ in processes]
        judged: dict[str, Any] = {"lost": True}
        while judged["lost"] and len(times[0]) < 4 * rounds:
            for index in range(rounds):
                for turn in range(len(processes)):
                    who = (index + turn) % len(processes)
                    say(processes[who], "go")
                    times[who].append(told(processes[who]))
            judged = verdict(times)
        for process in processes:
            say(process, "on")
        yield where[0] | judged


def verdict(times: list[list[float]]) -> dict[str, Any]:
    """What the rounds of the three say."""
    repeated, ratios = ([a / b for a, b in zip(part, times[0], strict=True)] for part in times[1:])
    spread = statistics.quantiles((abs(ratio - 1) for ratio in repeated), n=4, method="inclusive")[-1]
    ratio, seconds = statistics.median(ratios), dict(zip(CONTESTANTS, map(statistics.median, times), strict=True))
    lost = ratio > 1 + ALLOWED + spread
    return {"seconds": seconds, "rounds": len(ratios), "ratio": ratio, "spread": spread, "lost": lost}


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.against", description="this version against another")
    parser.add_argument("revision", help="commit of the earlier version")
    parser.add_argument("--quick", action="store_true", help="toy sizes; nothing is written")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.serve:
        serve(quick=options.quick)
        return 0

    from benchmarks.common import environment, write_json

    rows = []
    with checked_out(options.revision) as folder:
        processes = [started(root, quick=options.quick) for root in (folder, folder, ROOT)]
        try:
            for row in raced(processes, rounds=3 if options.quick else options.rounds):
                rows.append(row)
                mark = "LOST" if row["lost"] else "    "
                took = f"{row['ratio']:.3f} times {row['seconds']['earlier'] * 1e3:.1f} ms, spread {row['spread']:.3f}"
                print(f"{mark} {took}: {row['op']}, {row['direction']} ({row['who']})", flush=True)
        finally:
            for process in processes:
                process.kill()
    if not options.quick:
        write_json(RESULTS, {"environment": environment(), "earlier": options.revision, "rows": rows})
        print(f"written to {RESULTS}")
    return int(any(row["lost"] for row in rows) and not options.quick)


if __name__ == "__main__":
    raise SystemExit(main())
