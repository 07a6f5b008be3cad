"""A plan as a value: which physics was chosen and why. It prints, is saved as JSON, and is applied to a camera."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from kcam import files
from kcam.camera import DEVELOPING, Camera
from kcam.context import Context
from kcam.effects import relative_rms
from kcam.optics import Imaging
from kcam.optics.imaging import is_deep
from kcam.plain import from_json
from kcam.planner.range import Range
from kcam.planner.survey import survey
from kcam.planner.table import table
from kcam.scene import Scene
from kcam.sensor import ADC

ENDS = (ADC, *DEVELOPING)
"""What stands before the first of these is the raw signal, before rounding."""

ALIKE = 1.5
"""The power in which errors of choices add up: 1 where all are alike, 2 where none is like another. Of 115 plans the
whole was 0.86 to 1.36 times the root of the sum of squares, 1.14 times at most in 95 %.
"""

SAFETY = 1.25
"""A plan's errors together stay below the tolerance by this factor: what pricing each choice by itself misses."""
UNTRIED = 1.35
"""The same, of plans that no last trial has seen."""


Shortcuts = Mapping[int, Mapping[str, Any] | None]
"""Index of a stage -> the arguments of its `changed`, or None where it is left out."""

GROWTH = 4.0
"""Times the error of the last trial, up to which a later scene's is foretold."""

EACH = 50
"""Steps of training after which it is measured whether a plan still fits what has been trained, on one scene: some per
cent of their time.
"""

WAYS = {"direct", "tile", "max_memory"}
"""Changes of an Imaging that have one result."""


@dataclass(frozen=True)
class Decision:
    """A row of a plan: what was chosen instead of what, and why.

    error: estimated, relative RMS of the noiseless raw; of noise and rounding their own sigma, relative likewise.
    counted: whether the error is part of the plan's sum; noise and rounding are judged by themselves.
    seconds, memory: predicted for the raw, with this and all choices above [s, bytes]; in a plan for a single picture
        with all choices of optics.

    Example:
    >>> camera, scene = Camera.phone(), Scene.builtin("coffee", size=32)
    >>> plan = camera.plan(scene, tolerance=0.02)
    >>> [row.effect for row in plan.decisions][:2], sum(row.error for row in plan.decisions if row.counted) <= 0.02
    (['diffraction', 'wavelengths'], True)
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
class Plan:
    """What to simulate of a camera for a scene, as a value: print it, change it, save it, apply it.

    tolerance: as asked for; allowed: the number that it stands for.
    bound: the counted errors together, or what the last trial found if that is more; at most allowed / `SAFETY`, and
    allowed / `UNTRIED` where there was none.
    expected: root of the sum of their squares. checked: what the last trial found; None if there was none.
    changes: arguments of the camera's Imaging. skipped: indices of the stages that are left out. replaced: by index,
    the arguments of `changed` that make a stage's cheaper form.
    stages: classes of the camera's, by which it is known again. gradients: whether they were held to the tolerance, and
    trained: of which parameters; None where that was not kept.
    seconds, memory: predicted for the raw; reference_seconds, reference_memory: of the camera without the plan.
    planning_seconds: what making the plan took. measured: what `measure` found, beside what was predicted.

    Example:
    >>> camera, scene = Camera.phone(), Scene.builtin("coffee", size=32)
    >>> plan = camera.plan(scene, tolerance=0.02)
    >>> plan.apply(camera)(scene).shape, plan.measure(camera, scene) <= 0.02
    (torch.Size([1, 3, 21, 32]), True)
    >>> print(str(plan).splitlines()[0])
    Plan for 21 x 32 pixels, 28 bands, 2 m; tolerance 0.02
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
    checked: float | None = None
    trained: tuple[str, ...] | None = None
    replaced: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def shortcuts(self) -> Shortcuts:
        """Stages that are left out, and those that are replaced."""
        return dict.fromkeys(self.skipped) | {int(index): arguments for index, arguments in self.replaced.items()}

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
        if not self.changes and not self.shortcuts:
            return camera
        stages = shortened(camera, self.changes, self.shortcuts)
        known = self.trained if self.gradients else ()
        ahead = set() if known is None else {*noiseless_raw(camera).parameters()}  # by identity
        unplanned = [p for name, p in camera.named_parameters() if p in ahead and name not in (known or ())]
        return PlannedCamera(*stages, context=stages.context, plan=self, whole=camera, unplanned=unplanned)

    def outside(self, camera: Camera, scene: Scene) -> str | None:
        """In what a scene is unlike those that were planned for, such that the error may exceed the tolerance; or None.

        By gain x potential: an error grows with the root of the potentials that a scene has more of, and noise that is
        left out as there is less light. What grows beyond what the last trial left of the tolerance, or `GROWTH` times,
        is outside.
        """
        geometry, window = self.range.leaves(scene), self.changes.get("psf_shape", (1, 1))
        if self.changes.get("interpolate_bands") and is_deep(scene):
            geometry = "has a map of depth, through which bands share PSFs; the plan was for scenes at one distance"
        for own, planned, side in zip(scene.shape[1:], (self.range.height, self.range.width), window, strict=True):
            if side < max(window) and own > planned:  # the window was only as large as the picture
                geometry = f"is {own} pixels across where the plan was for {planned}, of which it needs more"
        if geometry or not self.range.potential or self.range.defocus is None:
            return geometry
        error = self.bound if self.checked is None else self.checked
        hidden = [row.error for row in self.decisions if row.chosen == "left out" and not row.counted]
        noise = math.sqrt(sum(value**2 for value in hidden))
        for found in survey(scene, camera, self.range.defocus):
            if noise * self.range.darkest > self.allowed * found.level:
                return f"has {self.range.darkest / max(found.level, 1e-30):.3g} times less light, and noise is left out"
            allowed = self.allowed
            if isinstance(self.tolerance, str):  # less noise in more light
                allowed *= min(1.0, self.range.brightest / max(found.level, 1e-30))
            if set(self.changes) <= WAYS and not error:
                continue
            most = min(GROWTH, allowed / max(error, 1e-30))
            for kind, growth in self.range.growth(found, self.changes, hides=self.checked is not None):
                if growth > most:
                    return f"has {growth:.3g} times the {kind} planned for, where {most:.3g} times is safe"
        return None

    def renew(self, camera: Camera, scenes: Scene | Sequence[Scene]) -> Plan:
        """A new plan, for the camera as it is now: of the same tolerance, memory and, if it was, for training.

        Args:      camera: that which this plan was made for, or a planned one, of which that is meant.
        Raises:    as `make_plan`.
        """
        from kcam.planner.planner import make_plan  # which makes plans of this file

        with torch.set_grad_enabled(self.gradients):
            whole = camera.whole if isinstance(camera, PlannedCamera) else camera
            memory = self.changes.get("max_memory")
            return make_plan(whole, scenes, tolerance=self.tolerance, max_memory=memory)

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
        found = asdict(self)
        return json.dumps(found if self.replaced else {k: v for k, v in found.items() if k != "replaced"}, indent=1)

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
        return table(self)

    def summary(self) -> str:
        """In one line, what was left out."""
        told = [row for row in self.decisions if row.instead and row.effect not in ("convolution", "memory")]
        fewer = [f"{row.effect} {row.chosen} (of {row.instead})" for row in told if row.chosen != "left out"]
        without = [row.effect for row in told if row.chosen == "left out"]
        parts = [*(fewer and [", ".join(fewer)]), *(without and [f"without {', '.join(without)}"])]
        return f"within {self.allowed:.2g}: {'; '.join(parts)}" if parts else "nothing left out"


def _read(text: str | bytes, wrong: str) -> Plan:
    plan: Plan = from_json(text, Plan, wrong=wrong)
    try:
        if plan.measured and not {"error", "seconds", "reference_seconds"} <= plan.measured.keys():
            raise ValueError("measured has no error, seconds or reference_seconds")
        return replace(plan, changes=files.fitting_arguments(Imaging, plan.changes))
    except ValueError as error:
        raise ValueError(f"{wrong}: {error}.") from None


class OutOfRange(UserWarning):
    """A scene, or a gradient, is outside of what a plan was made for.

    Example:
    >>> camera, picture = Camera.phone(), torch.rand(3, 32, 32)
    >>> plan = camera.plan(Scene.from_rgb(picture, depth=2.0), tolerance=0.02)
    >>> plan.outside(camera, Scene.from_rgb(picture, depth=0.5))  # what the warning says
    'comes as near as 0.5 m; the nearest planned for was 2 m'
    """


class PlannedCamera(Camera):
    """A camera with a plan applied: it warns (`OutOfRange`) where a scene leaves the range that was planned for, where
    gradients flow that were not planned for, and where training has left it, which is measured each `EACH` steps.

    whole: the camera without the plan, which it shares all parameters with.

    unplanned: parameters through whose gradients the plan's shortcuts act, and that it does not know.

    Example:
    >>> camera, scene = Camera.phone(), Scene.builtin("coffee", size=32)
    >>> short = camera.plan(scene, tolerance=0.1).apply(camera)
    >>> type(short).__name__, short.whole is camera
    ('PlannedCamera', True)
    """

    def __init__(
        self,
        *stages: nn.Module,
        plan: Plan,
        whole: Camera,
        context: Context | None = None,
        unplanned: Sequence[nn.Parameter] = (),
    ) -> None:
        super().__init__(*stages, context=context)
        self.plan_applied, self.unplanned = plan, tuple(unplanned)
        self._trained = [0]  # of training; one count for this camera and its parts
        self._whole = (whole,)  # not a module of its own: its parameters are known already

    @property
    def whole(self) -> Camera:
        """The camera without the plan."""
        return self._whole[0]

    def steps(self, scene: Scene | Tensor, *, generator: torch.Generator | None = None) -> Iterator[tuple[str, Tensor]]:
        """As `Camera.steps`."""
        plan = self.plan_applied
        outside = plan.outside(self, scene) if isinstance(scene, Scene) else None
        if outside:
            warnings.warn(
                f"the scene {outside}: the error may exceed the tolerance of {plan.allowed:g}. Plan for such scenes "
                "too: camera.plan([scene, ...], tolerance=...).",
                OutOfRange,
                stacklevel=3,
            )
        if torch.is_grad_enabled():
            self._trained[0] += 1
            if isinstance(scene, Scene) and self._trained[0] % EACH == 0 and len(scene.coefficients):
                error = plan.measure(self.whole, scene.samples([0]))
                if error > plan.allowed:
                    warnings.warn(
                        f"after {self._trained[0]} steps of training the plan is off by {error:.2g}, more than the "
                        f"tolerance of {plan.allowed:g}. Plan anew for what it has become: plan.renew(camera, scenes).",
                        OutOfRange,
                        stacklevel=3,
                    )
            flows = [p for p in self.unplanned if p.requires_grad]
            towards = [
                name
                for name in ("coefficients", "depth", "spectra")
                if isinstance(value := getattr(scene, name, None), Tensor) and value.requires_grad
            ]
            if flows or towards:
                what = f"{len(flows)} parameter{'s' * (len(flows) > 1)}" if flows else f"the scene's {towards[0]}"
                fix = "with autograd on: plan = camera.plan(scene, tolerance=...) outside torch.no_grad()"
                fix = f"Make it {fix}" if flows else "Use the camera without a plan"
                warnings.warn(
                    f"gradients flow to {what} through a plan that was not made for them, and may be wrong by any "
                    f"amount. {fix}, or take the picture under torch.no_grad().",
                    OutOfRange,
                    stacklevel=3,
                )
        return super().steps(scene, generator=generator)

    def noiseless(self) -> Camera:
        """As `Camera.noiseless`; it warns as this camera does."""
        return self._like(super().noiseless())

    def __getitem__(self, key: int | slice) -> Any:
        part = super().__getitem__(key)
        return self._like(part) if isinstance(key, slice) and key.start in (None, 0) else part

    def _like(self, camera: Camera) -> PlannedCamera:
        """A camera from the scene on, such as `raw` takes, under the same plan."""
        found = PlannedCamera(
            *camera, plan=self.plan_applied, whole=self.whole, context=camera.context, unplanned=self.unplanned
        )
        found._trained = self._trained
        return found

    def save(self, path: str | PathLike[str]) -> None:
        """Write it as a plain camera that has the plan's choices."""
        Camera(*self, context=self.context).save(path)


def noiseless_raw(camera: Camera) -> Camera:
    """The stages whose result a tolerance is about: expected electrons after the full well, before the ADC rounds.

    Example:
    >>> from kcam.planner import noiseless_raw
    >>> [type(stage).__name__ for stage in noiseless_raw(Camera.phone())]
    ['Imaging', 'ColourFilter', 'Mosaic', 'Exposure', 'Mean', 'Mean']
    """
    stages = list(camera)
    end = next((index for index, stage in enumerate(stages) if isinstance(stage, ENDS)), len(stages))
    return Camera(*stages[:end], context=camera.resolve()).noiseless()


def with_imaging(camera: Camera, **arguments: Any) -> Camera:
    """The camera with arguments of its Imaging changed, which has kept nothing; all else is shared.

    Example:
    >>> from kcam.planner import with_imaging
    >>> with_imaging(Camera.phone(), bands=4)[0].bands
    4
    """
    stages = [stage.changed(**arguments) if isinstance(stage, Imaging) else stage for stage in camera]
    return Camera(*stages, context=camera.context)


def shortened(camera: Camera, changes: Mapping[str, Any], shortcuts: Shortcuts) -> Camera:
    """The camera with its Imaging changed, without some stages or with cheaper forms of them; all else is shared."""
    stages: list[nn.Module] = []
    for index, stage in enumerate(camera):
        kept: Any = stage
        if isinstance(stage, Imaging) and changes:
            kept = stage.changed(**changes)
        elif (arguments := shortcuts.get(index)) is not None:
            kept = kept.changed(**arguments)
        elif index in shortcuts:
            bypass: Any = getattr(stage, "bypass", None)
            kept = bypass() if callable(bypass) else None
        if kept is not None:
            stages.append(kept)
    return Camera(*stages, context=camera.resolve())


def together(errors: Iterable[float]) -> float:
    """What choices with such errors cost all at once.

    Example:
    >>> from kcam.planner.plan import together
    >>> together([0.01]), round(together([0.01, 0.01]), 4)
    (0.01, 0.0159)
    """
    found = [error for error in errors if error]
    return math.fsum(error**ALIKE for error in found) ** (1 / ALIKE) if len(found) > 1 else math.fsum(found)
