"""What all commands share: the standard error, progress on it, errors of one line, and how a run ends."""

from __future__ import annotations

import json
import sys
import time
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn, Protocol

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from kcam.camera import PRESETS
from kcam.inputs import named

ALL_DONE, SOME_FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130
OFTEN, SELDOM, SHARE = 1.0, 10.0, 0.05
"""A line of progress: none before so many seconds are over, and one after so many, or after this share of the work."""
CAMERAS = f"{', '.join(PRESETS)}, singlet, or a file that Camera.save wrote"
"""What `open_camera` takes, for the help."""
err = Console(stderr=True, highlight=False, soft_wrap=True)


# ---- progress ------------------------------------------------------------------------------------------------------


class Advance(Protocol):
    """Says what is being done, of how many steps, and how many are done: by default one more than before."""

    def __call__(self, note: str = "", total: int | None = None, done: int | None = None) -> None:
        """As above."""
        ...


@contextmanager
def progress(what: str, total: int | None = None, *, clock: Callable[[], float] = time.monotonic) -> Iterator[Advance]:
    """A bar on the terminal; where there is none, a line every so often. Either on the standard error.

    Args:      what: is done, or what a step is called.  total: of the steps, where it is known.
               clock: wall time [s].
    """
    if not err.is_terminal or err.is_dumb_terminal:
        yield Lines(what, total, clock=clock)
        return
    text = TextColumn("{task.description}", markup=False)
    columns = (SpinnerColumn(), text, BarColumn(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True) as bar:
        task = bar.add_task(what, total=total)

        def advance(note: str = "", total: int | None = None, done: int | None = None) -> None:
            state = bar.tasks[0]
            count = int(state.completed) + 1 if done is None else done
            most = state.total if total is None else total
            told = f"{_count(what, count, None if most is None else int(most))}: {note}"
            bar.update(task, completed=count, total=most, description=told)

        yield advance


class Lines:
    """Progress as plain lines, such as "step 120 of 600, loss 0.123, 34 s, 2 min left".

    One a second at most; one after 10 s, or 5 % of the steps. What takes less than a second says nothing.

    Args:      as for `progress`.  write: what a line is given to.
    """

    def __init__(
        self,
        what: str,
        total: int | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
        write: Callable[[str], None] = lambda line: err.print(line, markup=False),
    ) -> None:
        self.what, self.total, self._clock, self._write = what, total, clock, write
        self._began = self._last = clock()
        self._done, self._told = 0, 0
        self._marks: list[tuple[float, int]] = [(self._began, 0)]

    def __call__(self, note: str = "", total: int | None = None, done: int | None = None) -> None:
        """As in `Advance`."""
        now = self._clock()
        if done is not None and not self._done:
            self._marks.clear()  # a run that goes on: what was done before took none of this time
            self._told = done - 1
        self._done = self._done + 1 if done is None else done
        self.total = self.total if total is None else total
        self._marks.append((now, self._done))
        waited, moved = now - self._last, abs(self._done - self._told)
        if waited >= SELDOM or (waited >= OFTEN and self.total is not None and moved >= SHARE * self.total):
            left = time_left(self._marks, self.total)
            rest = f"{rounded(left)} left" if left is not None and left >= 0.5 else ""
            parts = (_count(self.what, self._done, self.total), note, rounded(now - self._began), rest)
            self._write(", ".join(part for part in parts if part))
            self._last, self._told = now, self._done


def time_left(marks: list[tuple[float, int]], total: int | None) -> float | None:
    """Seconds that the steps that are left take, by the pace of the later half of the time; None while it is unknown.

    A first step that compiles or reads for long is thus soon forgotten, and so are steps that were found done.

    Args:      marks: (when [s], how many steps were done then), the first of them where it all began.
    """
    if total is None or len(marks) < 3:
        return None
    (began, _), (now, done) = marks[0], marks[-1]
    place = min(bisect_left(marks, (began + now) / 2, key=lambda mark: mark[0]), len(marks) - 2)
    since, before = marks[max(place, 1)]
    if done <= before or now <= since:
        return None
    return max(0, total - done) * (now - since) / (done - before)


def rounded(seconds: float) -> str:
    """A time in whole seconds or minutes, and hours with a tenth."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 99.5 * 60 else f"{seconds / 3600:.1f} h"


def _count(what: str, done: int, total: int | None) -> str:
    return f"{what} {done}" if total is None else f"{what} {done} of {total}"


def losses(terms: Mapping[str, float]) -> str:
    """A loss and its terms: "loss 0.812 (style 0.6, content 0.212)"."""
    parts = {name: value for name, value in terms.items() if name != "total"}
    total = terms["total"] if "total" in terms else sum(parts.values())
    return f"loss {total:.3f} ({', '.join(f'{name} {value:.3f}' for name, value in parts.items())})"


# ---- errors, and the end -------------------------------------------------------------------------------------------


@contextmanager
def one_line_errors() -> Iterator[None]:
    """What the user got wrong is one clear line and exit status 2; what we got wrong stays a traceback."""
    try:
        yield
    except (ValueError, TypeError, OSError) as error:
        complain(str(error))
        raise typer.Exit(USAGE) from error


def complain(text: str) -> None:
    """One line on the standard error, in the name of the program: kcam, or a script of data_tools/."""
    name = Path(sys.argv[0]).name
    program = name if name.endswith(".py") and name != "__main__.py" else "kcam"
    err.print(f"[bold red]{program}:[/] ", end="")
    err.print(" ".join(text.split()), markup=False)


def usage(message: str) -> NoReturn:
    """One line, and the exit status of a wrong call."""
    stop(message, USAGE)


def stop(message: str, status: int) -> NoReturn:
    """One line, and an exit status."""
    complain(message)
    raise typer.Exit(status)


def end(
    result: dict[str, Any],
    lines: list[str],
    *,
    as_json: bool,
    failed: dict[str, str],
    skipped: dict[str, str] | None = None,
    report: Path | None = None,
) -> NoReturn:
    """Say what was done, and what was skipped and what failed, a line each with the reason, and exit.

    Args:      skipped: None where a command skips nothing.  report: a file for the result as JSON.
    """
    document = result | ({} if skipped is None else {"skipped": skipped}) | {"failed": failed}
    text = json.dumps(document, indent=1)
    for line in [text] if as_json else lines:
        typer.echo(line)
    for word, reasons in (("skipped", skipped or {}), ("failed", failed)):
        for line in named(word, reasons, rest="--json"):
            typer.echo(line, err=True)
    if report is not None:
        report.parent.mkdir(parents=True, exist_ok=True)
        report.write_text(text + "\n")
    raise typer.Exit(SOME_FAILED if failed else ALL_DONE)


def command(main: Callable[..., Any]) -> typer.Typer:
    """A function as a command; its help as it is written, where typer.run would take [m] for markup and drop it."""
    app = typer.Typer(add_completion=False, rich_markup_mode=None)
    app.command()(main)
    return app


def run(main: Callable[..., Any]) -> None:
    """A function as the command of a script."""
    command(main)()
