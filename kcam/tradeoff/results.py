"""What a sweep found: a row for each setting, in words and in a file."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rich.table import Table

from kcam import measure
from kcam.optics.propagation.table import PHYSICS
from kcam.plain import from_json


@dataclass(frozen=True)
class Row:
    """What a setting was measured to cost. None stands for what it does not change, or could not be measured.

    psf_l1, psf_l1_worst: median and worst over wavelengths and distances, relative to the light.
    raw_rms: relative RMS error of the noiseless raw, before rounding. delta_e: mean CIEDE2000 of the picture.
    seconds: of a picture with new optics, nothing kept from one before; seconds_iqr: quartiles over the `calls`.
    seconds_kept: of one more picture with the same optics. share: of the PSFs that the time was measured on, if not 1.
    peak_memory: beyond what was in use before [bytes]. refused: why there is no result.

    Example:
    >>> from kcam.tradeoff import Row
    >>> row = Row("wavelengths", "7 wavelengths", raw_rms=0.002, seconds=0.2)
    >>> row.psf_l1 is None, row.refused is None
    (True, True)
    """

    knob: str
    name: str
    psf_l1: float | None = None
    psf_l1_worst: float | None = None
    raw_rms: float | None = None
    delta_e: float | None = None
    seconds: float | None = None
    seconds_iqr: tuple[float, float] | None = None
    seconds_kept: float | None = None
    share: float = 1.0
    calls: int = 0
    peak_memory: int | None = None
    default: bool = False
    baseline: bool = False
    pareto: bool = False
    refused: str | None = None


@dataclass(frozen=True)
class Sweep:
    """The rows, what they were measured against, and on what machine.

    reference: what was compared, and how far the reference is from itself at twice its sampling and from a closed form.

    Example:
    >>> from kcam.tradeoff import Row, Sweep
    >>> given = Row("default", "as it is", raw_rms=1e-4, seconds=0.4, default=True)
    >>> found = Sweep("Two settings", "a wall", (given, Row("wavelengths", "7", raw_rms=2e-3, seconds=0.1)))
    >>> found.save("sweep.json")
    >>> [row.name for row in Sweep.load("sweep.json").pareto()]
    ['7', 'as it is']
    """

    title: str
    scene: str
    rows: tuple[Row, ...]
    reference: dict[str, Any] = field(default_factory=dict)
    environment: dict[str, Any] = field(default_factory=dict)

    @property
    def default(self) -> Row:
        """The camera as it was given."""
        return next(row for row in self.rows if row.default)

    def pareto(self, error: str = "raw_rms") -> list[Row]:
        """The rows that no other beats in both time and error, from the fastest to the most accurate."""
        return front(self.rows, error)

    def sentence(self) -> str:
        """What the next factor of ten in accuracy costs here, and what the last one did."""
        here = self.default
        if here.raw_rms is None or here.seconds is None:
            return f"The camera as it is was not measured: {here.refused}"
        start = f"{_accuracy(here.raw_rms)} in {_time(here.seconds)}"
        closer = [row for row in self.pareto() if _error(row.raw_rms) <= here.raw_rms / 10]
        if closer:
            row = closer[0]
            text = (
                f"On this machine the next factor of ten in accuracy costs {_ratio(row, here)} times the time: "
                f"{row.name} has {_accuracy(row.raw_rms)} in {_time(row.seconds)}, the camera as it is {start}."
            )
        else:
            text = f"On this machine no setting is ten times as accurate as the camera as it is, {start}."
        coarser = [row for row in self.pareto() if _error(row.raw_rms) >= 10 * here.raw_rms]
        if coarser:
            row = coarser[-1]
            text += (
                f" Giving accuracy up, {row.name} takes {_ratio(row, here)} times the time for "
                f"{_accuracy(row.raw_rms)}."
            )
        return text + self._model()

    def _model(self) -> str:
        """On which model the knobs were turned, where that is not the camera's own."""
        own = self.default.name.split()[0]
        if own == "nonparaxial" or own not in PHYSICS:
            return ""
        return f" The camera's own model is {own}; all knobs but the propagator are turned on the non-paraxial one."

    def table(self) -> Table:
        """The rows for a terminal, knob by knob; * marks those on the front of raw error and time."""
        table = Table(title=f"[bold]{self.title}[/]  [dim]{self.scene}[/]", title_justify="left", box=None)
        table.add_column("", min_width=1, no_wrap=True)
        for name in ("knob", "setting"):
            table.add_column(name, no_wrap=True)
        for name in ("PSF L1", "worst", "raw RMS", "delta E", "time", "quartiles, ms", "MB"):
            table.add_column(name, justify="right", no_wrap=True)
        before = ""
        for row in self.rows:
            style = "bold" if row.pareto else "dim" if row.baseline else ""
            head = ["*" if row.pareto else "", "" if row.knob == before else row.knob, row.name]
            before = row.knob
            if row.refused is not None:
                table.add_row(*head, "refused", style="dim")
                continue
            quartiles = "" if row.seconds_iqr is None else "-".join(f"{end * 1e3:.0f}" for end in row.seconds_iqr)
            table.add_row(
                *head,
                *(_small(value) for value in (row.psf_l1, row.psf_l1_worst, row.raw_rms)),
                _number(row.delta_e, "{:.3f}"),
                ("~" if row.share < 1 else "") + _time(row.seconds),
                quartiles,
                _number(row.peak_memory, "{:.0f}", 1e-6),
                style=style,
            )
        table.caption = (
            "Empty: the knob does not change it, or it was not measured. ~: told from a few of the PSFs. Demosaics are "
            "held to the same camera with three full planes, so their delta E stands by itself."
        )
        table.caption += self._model() + "".join(
            f"\n{row.name} refused: {row.refused}" for row in self.rows if row.refused
        )
        table.caption_justify = "left"
        return table

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "title": self.title,
            "scene": self.scene,
            "reference": self.reference,
            "environment": self.environment,
            "rows": [asdict(row) for row in self.rows],
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the sweep as JSON, with four digits."""
        measure.write_json(Path(path), self.to_json())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Sweep:
        """Read what `save` wrote. Raises: FileNotFoundError; ValueError for another file."""
        wrong = f"{path} is not a sweep that kcam tradeoff wrote"
        found: Sweep = from_json(Path(path).read_bytes(), cls, wrong=wrong)
        if not any(row.default for row in found.rows):
            raise ValueError(f"{wrong}: no row of it is the camera as it was given.")
        return found


def front(rows: Sequence[Row], error: str) -> list[Row]:
    """The rows that no other beats in both time and error, from the fastest to the most accurate.

    Example:
    >>> from kcam.tradeoff import Row, front
    >>> measured = ("a", 1.0, 1.0), ("b", 2.0, 2.0), ("c", 0.1, 3.0)
    >>> rows = [Row("depth", name, raw_rms=error, seconds=seconds) for name, error, seconds in measured]
    >>> [row.name for row in front(rows, "raw_rms")]  # b is slower than a, and worse
    ['a', 'c']
    """
    measured = [row for row in rows if getattr(row, error) is not None and row.seconds is not None]
    best, result = math.inf, []
    for row in sorted(measured, key=lambda row: (row.seconds, getattr(row, error))):
        if getattr(row, error) < best:
            best = getattr(row, error)
            result.append(row)
    return result


def _error(value: float | None) -> float:
    return math.inf if value is None else value


def _accuracy(error: float | None) -> str:
    return f"a raw error of {_small(error)}"


def _small(error: float | None) -> str:
    """An error for people; nothing below 1e-9 was looked at."""
    return "" if error is None else f"{error:.1e}" if error >= 1e-9 else "< 1e-9"


def _time(seconds: float | None) -> str:
    seconds = seconds or 0.0
    return f"{seconds * 1e3:.0f} ms" if seconds < 1 else f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"


def _ratio(row: Row, other: Row) -> str:
    return f"{(row.seconds or 0) / (other.seconds or math.nan):.2g}"


def _number(value: float | None, form: str, scale: float = 1.0) -> str:
    return "" if value is None else form.format(value * scale)
