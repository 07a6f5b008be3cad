"""A plan as a value: which physics was chosen and why. It prints, is saved as JSON, and is applied to a camera."""

from __future__ import annotations

import json
import textwrap
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from kcam import files
from kcam.camera import DEMOSAICING, Camera
from kcam.context import Context
from kcam.optics import Imaging
from kcam.plain import from_json
from kcam.scene import Scene
from kcam.sensor import ADC

ENDS = (ADC, *DEMOSAICING)
"""What stands before the first of these is the raw signal, before rounding."""

SAFETY = 1.25
"""The sum of a plan's errors stays below the tolerance by this factor: what pricing each choice by itself misses."""


@dataclass(frozen=True)
class Decision:
    """A row of a plan: what was chosen instead of what, and why.

    error: estimated, relative RMS of the noiseless raw; of noise and rounding their own sigma, relative likewise.
    counted: whether the error is part of the plan's sum; noise and rounding are judged by themselves.
    seconds, memory: predicted for the raw, with this and all choices above [s, bytes].
    """

    effect: str
    chosen: str
    instead: str
    why: str
    error: float
    counted: bool
    seconds: float
    memory: float


@dataclass(frozen=True)
class Range:
    """What the scenes of a plan were like: outside of it the plan's errors are not known.

    farthest, nearest: vergences [1/m]. contrast: RMS of the differences between neighbouring pixels, relative to the
    RMS of the pixels. wavelengths [m].
    """

    height: int
    width: int
    farthest: float
    nearest: float
    contrast: float
    wavelengths: tuple[float, ...]

    @classmethod
    def of(cls, scenes: Sequence[Scene]) -> Range:
        """The range that scenes span."""
        ends, contrasts = [], []
        for scene in scenes:
            depth = torch.as_tensor(scene.depth, dtype=torch.float64).detach()
            ends += [] if depth.numel() == 0 else [1 / float(depth.max()), 1 / float(depth.min())]
            contrasts.append(_contrast(scene))
        return cls(
            height=max(scene.shape[1] for scene in scenes),
            width=max(scene.shape[2] for scene in scenes),
            farthest=min(ends, default=0.0),
            nearest=max(ends, default=0.0),
            contrast=max(contrasts),
            wavelengths=tuple(scenes[0].wavelengths.tolist()),
        )

    def leaves(self, scene: Scene) -> str | None:
        """In what a scene lies outside, or None; a tenth of the depth and a quarter of the contrast are let pass."""
        other = Range.of([scene])
        slack = 0.1 * (self.nearest - self.farthest) + 1e-9
        if other.wavelengths != self.wavelengths:
            return f"has other wavelengths ({len(other.wavelengths)}) than were planned for ({len(self.wavelengths)})"
        if other.nearest > self.nearest + slack:
            return f"comes as near as {_metres(other.nearest)}; the nearest planned for was {_metres(self.nearest)}"
        if other.farthest < self.farthest - slack:
            return f"goes out to {_metres(other.farthest)}; the farthest planned for was {_metres(self.farthest)}"
        if other.height * other.width > 1.2 * self.height * self.width:
            return f"has {other.height} x {other.width} pixels; the plan was for {self.height} x {self.width}"
        if other.contrast > 1.25 * self.contrast:
            return f"has {other.contrast / self.contrast:.3g} times the contrast between neighbours planned for"
        return None


@dataclass(frozen=True)
class Plan:
    """What to simulate of a camera for a scene, as a value: print it, change it, save it, apply it.

    tolerance: as asked for; allowed: the number that it stands for.
    bound: sum of the counted errors, at most allowed / `SAFETY`. expected: root of the sum of their squares.
    changes: arguments of the camera's Imaging. skipped: indices of the stages that are left out.
    stages: classes of the camera's, by which it is known again. gradients: whether they were held to the tolerance.
    seconds, memory: predicted for the raw; reference_seconds, reference_memory: of the camera without the plan.
    planning_seconds: what making the plan took. measured: what `measure` found, beside what was predicted.
    """

    tolerance: float | str
    allowed: float
    bound: float
    expected: float
    decisions: tuple[Decision, ...]
    changes: dict[str, Any]
    skipped: tuple[int, ...]
    stages: tuple[str, ...]
    range: Range
    gradients: bool
    seconds: float
    memory: float
    reference_seconds: float
    reference_memory: float
    planning_seconds: float
    measured: dict[str, float] = field(default_factory=dict)

    def apply(self, camera: Camera) -> Camera:
        """The camera with only the chosen physics; it shares all parameters, and warns of scenes out of range.

        Raises:    ValueError for a camera of other stages than the plan was made for.
        """
        found = tuple(type(stage).__name__ for stage in camera)
        if found != self.stages:
            raise ValueError(
                f"the plan is for a camera of {', '.join(self.stages)}; this one has {', '.join(found) or 'no stages'}."
                " Make another: camera.plan(scene, tolerance=...)."
            )
        if not self.changes and not self.skipped:
            return camera
        stages: list[nn.Module] = []
        for index, stage in enumerate(camera):
            kept: Any = stage
            if isinstance(stage, Imaging) and self.changes:
                kept = stage.changed(**self.changes)
            elif index in self.skipped:
                bypass: Any = getattr(stage, "bypass", None)
                kept = bypass() if callable(bypass) else None
            if kept is not None:
                stages.append(kept)
        return PlannedCamera(*stages, context=camera.resolve(), plan=self)

    def measure(self, camera: Camera, scene: Scene, *, truth: Tensor | None = None) -> float:
        """True error of the plan: relative RMS of its noiseless raw against that of the camera without it (`truth`)."""
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore", OutOfRange)
            expected = noiseless_raw(camera)(scene) if truth is None else truth
            return relative_rms(noiseless_raw(self.apply(camera))(scene), expected)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the plan as JSON; an old file of that name is replaced when the new one is whole."""
        files.replace(path, (self.to_json() + "\n").encode())

    def to_json(self) -> str:
        """The plan as text; numbers come back as they were."""
        return json.dumps(asdict(self), indent=1)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Plan:
        """Read what `save` wrote. Raises: FileNotFoundError; ValueError for another file."""
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"there is no file {path}. A plan is written by plan.save({str(path)!r}).")
        return _read(path.read_bytes(), f"{path} is not a plan that Plan.save wrote")

    @classmethod
    def from_json(cls, text: str) -> Plan:
        """The plan that `to_json` wrote. Raises: ValueError for another text."""
        return _read(text, "the text is not a plan that Plan.to_json wrote")

    def __str__(self) -> str:
        return _table(self)


def _read(text: str | bytes, wrong: str) -> Plan:
    plan: Plan = from_json(text, Plan, wrong=wrong)
    try:
        if plan.measured and not {"error", "seconds", "reference_seconds"} <= plan.measured.keys():
            raise ValueError("measured has no error, seconds or reference_seconds")
        return replace(plan, changes=files.fitting_arguments(Imaging, plan.changes))
    except ValueError as error:
        raise ValueError(f"{wrong}: {error}.") from None


class OutOfRange(UserWarning):
    """A scene is outside of what a plan was made for."""


class PlannedCamera(Camera):
    """A camera with a plan applied: it warns (`OutOfRange`) where a scene leaves the range that was planned for."""

    def __init__(self, *stages: nn.Module, plan: Plan, context: Context | None = None) -> None:
        super().__init__(*stages, context=context)
        self.plan_applied = plan

    def steps(self, scene: Scene | Tensor, *, generator: torch.Generator | None = None) -> Iterator[tuple[str, Tensor]]:
        """As `Camera.steps`."""
        outside = self.plan_applied.range.leaves(scene) if isinstance(scene, Scene) else None
        if outside:
            warnings.warn(
                f"the scene {outside}: the error may exceed the tolerance of {self.plan_applied.allowed:g}. Plan for "
                "such scenes too: camera.plan([scene, ...], tolerance=...).",
                OutOfRange,
                stacklevel=3,
            )
        return super().steps(scene, generator=generator)

    def save(self, path: str | PathLike[str]) -> None:
        """Write it as a plain camera that has the plan's choices."""
        Camera(*self, context=self.context).save(path)


def noiseless_raw(camera: Camera) -> Camera:
    """The stages whose result a tolerance is about: expected electrons after the full well, before the ADC rounds."""
    stages = list(camera)
    end = next((index for index, stage in enumerate(stages) if isinstance(stage, ENDS)), len(stages))
    return Camera(*stages[:end], context=camera.resolve()).noiseless()


def with_imaging(camera: Camera, **arguments: Any) -> Camera:
    """The camera with arguments of its Imaging changed, which has kept nothing; all else is shared."""
    stages = [stage.changed(**arguments) if isinstance(stage, Imaging) else stage for stage in camera]
    return Camera(*stages, context=camera.context)


def relative_rms(a: Tensor, b: Tensor) -> float:
    """sqrt(mean (a - b)^2 / mean b^2): 0 for two black pictures, and without a bound for one."""
    a, b = a.detach().double(), b.detach().double()
    if not b.numel():
        return 0.0
    return float((a - b).square().mean().sqrt() / b.square().mean().sqrt().clamp(min=1e-30))


def _contrast(scene: Scene) -> float:
    planes = scene.coefficients.detach().float()
    if not planes.numel():
        return 0.0
    steps = sum(float(planes.diff(dim=dim).square().sum()) for dim in (-2, -1))
    return (steps / max(float(planes.square().sum()), 1e-30)) ** 0.5


# ---- the table -----------------------------------------------------------------------------------------------------

WIDTHS = (13, 19, 16, 23, 9, 8, 6)  # effect, chosen, instead of, why, error, time, memory: 100 columns in all


def _table(plan: Plan) -> str:
    low, high = _metres(plan.range.nearest), _metres(plan.range.farthest)
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
        cells = (row.effect, row.chosen, row.instead, row.why, error, _time(row.seconds), f"{row.memory / 1e6:.0f}")
        lines.append(_row(cells))
    lines += ["-" * 100, *_summary(plan)]
    return "\n".join(lines)


def _summary(plan: Plan) -> list[str]:
    text = (
        f"Error of the noiseless raw: at most {plan.bound:.2g}, {plan.expected:.2g} expected (allowed "
        f"{plan.allowed:.3g}; in brackets: noise and rounding, outside the sum)."
    )
    if plan.reference_seconds > 0:
        share = plan.planning_seconds / plan.reference_seconds
        text += (
            f" Time of the raw {_time(plan.seconds)} instead of {_time(plan.reference_seconds)}, "
            f"{plan.reference_seconds / max(plan.seconds, 1e-9):.3g} times as fast; memory {plan.memory / 1e6:.0f} MB "
            f"instead of {plan.reference_memory / 1e6:.0f}. Planning took {_time(plan.planning_seconds)}, "
            f"{share:.0%} of the reference's predicted time"
            + (": it pays for several pictures, not for one." if share > 0.1 else ".")
        )
    else:
        text += " The camera has no optics to simplify."
    lines = textwrap.wrap(text, 100)
    if plan.measured:
        found = plan.measured
        lines += textwrap.wrap(
            f"Measured: error {found['error']:.2g}; time {_time(found['seconds'])} instead of "
            f"{_time(found['reference_seconds'])}, {found['reference_seconds'] / max(found['seconds'], 1e-9):.3g} "
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


def _time(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 1 else f"{seconds * 1e3:.3g} ms"


def _metres(vergence: float) -> str:
    distance = 1 / vergence if vergence > 1e-9 else float("inf")
    return "infinity" if distance > 1e9 else f"{distance:.3g} m" if distance < 1000 else f"{distance:.0f} m"
