"""What the tools share: options that mean the same everywhere, progress, and how a run ends."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

ALL_DONE, SOME_FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130
err = Console(stderr=True)

Json = Annotated[bool, typer.Option("--json", help="print the result as JSON, for scripts")]
Workers = Annotated[int, typer.Option("--workers", min=1, help="processes")]


class _Rate(ProgressColumn):
    """Scenes per second."""

    def render(self, task: Task) -> Text:
        return Text(f"{task.speed:.2g}/s" if task.speed else "")


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[str, int], None]]:
    """A bar with rate and time left on the terminal; nothing where there is none."""
    columns = (
        TextColumn(what),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("[dim]{task.description}"),
    )
    with Progress(*columns, console=err, disable=not err.is_terminal, transient=True) as bars:
        task = bars.add_task("", total=total or None)
        yield lambda name, known: bars.update(task, advance=1, description=name, total=max(total, known) or None)


def end(result: dict[str, Any], lines: list[str], *, as_json: bool, failed: dict[str, str], report: Path | None = None):
    """Say what was done and what failed, a line each, and exit."""
    if as_json:
        typer.echo(json.dumps(result | {"failed": failed}, indent=1))
    else:
        for line in lines:
            typer.echo(line)
    for name, reason in sorted(failed.items()):
        typer.echo(f"failed: {name}: {reason}", err=True)
    if report is not None:
        report.parent.mkdir(parents=True, exist_ok=True)
        report.write_text(json.dumps(result | {"failed": failed}, indent=1) + "\n")
    raise typer.Exit(SOME_FAILED if failed else ALL_DONE)


def command(main: Callable[..., Any]) -> typer.Typer:
    """A function as a command; its help as it is written, where typer.run would take [m] for markup and drop it."""
    app = typer.Typer(add_completion=False, rich_markup_mode=None)
    app.command()(main)
    return app


def run(main: Callable[..., Any]) -> None:
    """A function as the command of a script."""
    command(main)()


def usage(message: str) -> NoReturn:
    """One line, and the exit status of a wrong call."""
    stop(message, USAGE)


def stop(message: str, status: int) -> NoReturn:
    """One line, and an exit status."""
    typer.echo(f"{Path(sys.argv[0]).name}: {message}", err=True)
    raise typer.Exit(status)
