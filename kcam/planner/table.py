"""A plan as a table of text."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

from kcam.planner.range import metres

if TYPE_CHECKING:
    from kcam.planner.plan import Plan

WIDTHS = (13, 19, 16, 23, 9, 8, 6)  # effect, chosen, instead of, why, error, time, memory: 100 columns in all


def table(plan: Plan) -> str:
    """A plan as text: each decision with its reason, its error, and what is spent after it; then the sums."""
    low, high = metres(plan.range.nearest), metres(plan.range.farthest)
    where = low if low == high else f"{low} to {high}"
    name = f'"{plan.tolerance}": ' if isinstance(plan.tolerance, str) else ""
    lines = [
        f"Plan for {plan.range.height} x {plan.range.width} pixels, {len(plan.range.wavelengths)} bands, {where}; "
        f"tolerance {name}{plan.allowed:.3g}" + (", for gradients too" if plan.gradients else ""),
        "",
        _row(("effect", "chosen", "instead of", "why", "error", "time", "MB")),
        "-" * 100,
    ]
    for row in plan.decisions:
        error = "" if row.error == 0 else f"{row.error:.1e}" if row.counted else f"({row.error:.1e})"
        cells = (
            row.effect,
            row.chosen,
            row.instead,
            row.why,
            error,
            duration(row.seconds),
            f"{row.memory / 1e6:.0f}",
        )
        lines.append(_row(cells))
    lines += ["-" * 100, *_summary(plan)]
    return "\n".join(lines)


def _summary(plan: Plan) -> list[str]:
    text = (
        f"Error of the noiseless raw: at most {plan.bound:.2g}, {plan.expected:.2g} expected (allowed "
        f"{plan.allowed:.3g}; in brackets: noise and rounding, outside the sum)."
    )
    if plan.checked is not None:
        text += f" The last trial found {plan.checked:.2g}."
    if plan.reference_seconds > 0:
        share = plan.planning_seconds / plan.reference_seconds
        late = plan.planning_seconds + plan.seconds > plan.reference_seconds
        text += (
            f" Time of the raw {duration(plan.seconds)} instead of {duration(plan.reference_seconds)}, "
            f"{plan.reference_seconds / max(plan.seconds, 1e-9):.3g} times as fast; memory {plan.memory / 1e6:.0f} MB "
            f"instead of {plan.reference_memory / 1e6:.0f}. Planning took {duration(plan.planning_seconds)}, "
            f"{share:.0%} of the reference's predicted time"
            + (": it pays for several pictures, not for one." if late else ": it pays at the first picture.")
        )
    else:
        text += " The camera has no optics to simplify."
    lines = textwrap.wrap(text, 100)
    if plan.measured:
        found = plan.measured
        lines += textwrap.wrap(
            f"Measured: error {found['error']:.2g}; time {duration(found['seconds'])} instead of "
            f"{duration(found['reference_seconds'])}, {found['reference_seconds'] / max(found['seconds'], 1e-9):.3g} "
            "times as fast.",
            100,
        )
    return lines


def _row(cells: Sequence[str]) -> str:
    """Cells in columns, wrapped; numbers stand right."""
    parts = [textwrap.wrap(cell, width) or [""] for cell, width in zip(cells, WIDTHS, strict=True)]
    lines = []
    for index in range(max(map(len, parts))):
        texts = [part[index] if index < len(part) else "" for part in parts]
        padded = [t.ljust(w) if n < 4 else t.rjust(w) for n, (t, w) in enumerate(zip(texts, WIDTHS, strict=True))]
        lines.append(" ".join(padded).rstrip())
    return "\n".join(lines)


def duration(seconds: float) -> str:
    """A time as text."""
    return f"{seconds:.3g} s" if seconds >= 1 else f"{seconds * 1e3:.3g} ms"
