"""Making a plan: climb from the cheapest physics until the errors fit the tolerance."""

from __future__ import annotations

import dataclasses
import functools
import math
import statistics
import time
from collections.abc import Iterable, Mapping, Sequence
from numbers import Real
from typing import Any

import torch

from kcam.cache import unchanged
from kcam.camera import Camera
from kcam.optics import Imaging
from kcam.optics.accuracy import check_memory
from kcam.optics.imaging import is_deep
from kcam.planner import costs
from kcam.planner.evaluation import UNTOLD, Evaluator
from kcam.planner.ladder import Ladder
from kcam.planner.ladders import ladders
from kcam.planner.light import FEW, lights
from kcam.planner.plan import ENDS, SAFETY, UNTRIED, Decision, Plan, noiseless_raw, shortened, together
from kcam.planner.prices import Prices
from kcam.planner.range import Range
from kcam.planner.skips import Skip, shortcuts_of
from kcam.scene import Scene
from kcam.sensor import ShotNoise
from kcam.threads import no_more_than_free

WORTH, WORTH_DEEP, WORTH_LIGHTS, WORTH_FIELD = 0.12, 0.19, 0.7, 5.0
"""Predicted seconds of a reference picture up to which a plan for it alone may take longer than it saves, with a map of
depth, of a few lights that stand out in any picture, and over the field; each picture of a batch adds an eighth:
measured.
"""

SENSOR = "sensor"
"""The tolerance that follows from what a sensor records."""


def make_plan(
    camera: Camera,
    scenes: Scene | Sequence[Scene],
    *,
    tolerance: float | str,
    max_memory: float | None = None,
) -> Plan:
    """The cheapest physics found whose raw stays within a tolerance of the camera's own, for the worst of the scenes.

    A plan starts at the foot of all ladders (`LADDERS`), of windows at the smallest that may do alone, and climbs, one
    rung at a time, that with the largest error, until all errors together are below the tolerance / `UNTRIED`. Where
    the raw is linear in the light but for the full well, those follow from spectra. Else (PSFs that vary over the
    picture, gradients) they are tried out, and the way goes on until a last trial is below the tolerance / `SAFETY`:
    the whole plan against the reference, each item of each batch by itself. Beyond `evaluation.WITNESSED` pixels it
    sees only the worst of them.

    Args:      scenes: one or several, of the same wavelengths.
               tolerance: relative RMS of the noiseless raw, >= 0; 0 gives the reference physics. "sensor": what this
               sensor records of this exposure, its noise and half a step of its ADC.
               max_memory: bytes for the transforms; None for the camera's own.
    Raises:    ValueError for a tolerance or a memory out of range, or no scenes; TypeError for other things than
               scenes.

    Example:
    >>> from kcam.planner import make_plan
    >>> near, far = (Scene.from_rgb(torch.rand(3, 24, 32), depth=depth) for depth in (0.5, 3.0))
    >>> plan = make_plan(Camera.phone(), [near, far], tolerance=0.02)
    >>> plan.bound <= 0.02, 1 / plan.range.nearest, round(1 / plan.range.farthest, 6)
    (True, 0.5, 3.0)
    """
    check_tolerance(tolerance)
    return Planner(camera, scenes, max_memory=max_memory).plan(tolerance)


def shoot(
    camera: Camera, scene: Scene, *, tolerance: float | str, generator: torch.Generator | None = None
) -> tuple[torch.Tensor, Plan]:
    """One picture within a tolerance, and the plan for it, made and used where that pays: with the PSFs that making it
    took. It is the reference where all of that takes less than a plan: up to `WORTH`, and over the field where choices
    are tried out.

    Arguments and errors: as `make_plan`, and as `Camera`.

    Example:
    >>> from kcam.planner import shoot
    >>> picture, plan = shoot(Camera.phone(), Scene.builtin("coffee", size=32), tolerance=0.02)
    >>> picture.shape, plan.tolerance
    (torch.Size([1, 3, 21, 32]), 0.02)
    """
    check_tolerance(tolerance)
    planner = Planner(camera, scene, one=True)
    plan = planner.plan(tolerance if planner.pays(tolerance) else 0)
    stages = list(camera)
    if plan.changes and planner.evaluator.index is not None and planner.evaluator.imaging is not None:
        stages[planner.evaluator.index] = planner.evaluator.imaging.knowing_enough()
    short = shortened(Camera(*stages, context=camera.context), plan.changes, plan.shortcuts)
    return short(scene, generator=generator), dataclasses.replace(plan, tolerance=tolerance)


class Planner:
    """Plans for one camera and some scenes; what was tried for one tolerance is known for the next.

    Arguments and errors: as `make_plan`. one: for a single picture, so that only that is looked at which pays for it.

    Example:
    >>> from kcam.planner import Planner
    >>> planner = Planner(Camera.phone(), Scene.builtin("coffee", size=32))
    >>> [planner.plan(tolerance).bound <= tolerance for tolerance in (0.1, 0.01)]
    [True, True]
    """

    @no_more_than_free()
    @unchanged()
    def __init__(
        self, camera: Camera, scenes: Scene | Sequence[Scene], *, max_memory: float | None = None, one: bool = False
    ) -> None:
        start = time.perf_counter()
        self.camera, self.one = camera, one
        self.scenes = list(scenes) if isinstance(scenes, Iterable) and not isinstance(scenes, Scene) else [scenes]
        _check_scenes(self.scenes, max_memory)
        self.evaluator = Evaluator(camera, self.scenes)
        always = {} if max_memory is None else {"max_memory": float(max_memory)}
        self.prices = Prices(camera, self.evaluator, self.scenes, always, one=one)
        self._checked: dict[tuple[Any, ...], float] = {}
        self._known: tuple[list[Ladder], list[Skip]] | None = None
        self._setup = time.perf_counter() - start

    @no_more_than_free()
    @unchanged()
    def pays(self, tolerance: float | str) -> bool:
        """Whether a plan for a single picture takes less time than it saves: see `shoot`."""
        start = time.perf_counter()
        pays = self._pays(tolerance)
        self._setup += time.perf_counter() - start
        return pays

    def _pays(self, tolerance: float | str) -> bool:
        scene, imaging = self.prices.scene, self.evaluator.imaging
        if imaging is None or not scene.coefficients.numel():
            return False
        varies = self.evaluator.varies
        worth = WORTH_FIELD if varies else WORTH_DEEP if is_deep(scene) else WORTH
        if bool((lights(scene.coefficients.detach().sum(1, keepdim=True)) < FEW).any()):
            worth = max(worth, WORTH_LIGHTS)
        usual = self.prices.rates | costs.RATES  # on a slower machine a plan takes longer, too
        if costs.seconds(self.prices.work({}), usual) <= worth * (1 + scene.shape[0] / 8):
            return False
        if not varies:
            return True
        if not isinstance(tolerance, str) and tolerance < UNTOLD:
            return False
        if self.evaluator.over_field is None or self.evaluator.few_lights:  # which takes a look at the scene
            return False
        self._ways()  # which looks at what the sensor is given
        return self.evaluator.foretells(self.evaluator.noise() if isinstance(tolerance, str) else tolerance)

    @no_more_than_free()
    @unchanged()
    def plan(self, tolerance: float | str) -> Plan:
        """The plan for a tolerance."""
        start = time.perf_counter()
        check_tolerance(tolerance)
        tolerance = tolerance if isinstance(tolerance, str) else float(tolerance)
        rows = _Rows(self.prices)
        shortcuts: dict[int, dict[str, Any] | None] = {}
        allowed, checked = 0.0, None
        if tolerance != 0 and self.evaluator.samples:
            ladders, skips = self._ways()
            noise = self.evaluator.noise()
            allowed = noise if isinstance(tolerance, str) else float(tolerance)
            if allowed == 0:  # a sensor without noise or steps records everything
                ladders, skips = [], []
            movable: list[Any] = [*ladders, *skips]
            for choice in movable:
                choice.position = 0
            checked = self._settle(ladders, skips, allowed, noise if isinstance(tolerance, str) else None)
            shortcuts = shortcuts_of(skips, allowed, noise if isinstance(tolerance, str) else None)
            if self.one:
                rows.change(_changes(ladders))  # priced at once
            for ladder in _relevant(ladders):
                rows.add_ladder(ladder)
            rows.add_way()
            for skip in skips:
                rows.add_skip(skip, left_out=skip.index in shortcuts and shortcuts[skip.index] is None)
            rows.add_saturation(self.camera, self.evaluator)
        rows.add_memory()
        errors = [row.error for row in rows.decisions if row.counted]
        reference = self.prices.of({})
        return Plan(
            tolerance=tolerance,
            allowed=allowed,
            bound=max(together(errors), checked or 0.0),
            expected=math.sqrt(sum(error**2 for error in errors)),
            checked=checked,
            decisions=tuple(rows.decisions),
            changes=rows.changes,
            skipped=tuple(sorted(index for index, arguments in shortcuts.items() if arguments is None)),
            replaced={str(index): arguments for index, arguments in shortcuts.items() if arguments is not None},
            stages=tuple(type(stage).__name__ for stage in self.camera),
            range=Range.of(
                self.scenes,
                self.evaluator.items if tolerance != 0 else (),  # the reference is right for every scene
                self.evaluator.defocus,
                varies=self.evaluator.varies,
            ),
            gradients=self.evaluator.gradients,
            trained=tuple(name for name, p in self.camera.named_parameters() if p.requires_grad)
            if self.evaluator.gradients
            else (),
            seconds=rows.spent[0] + rows.beside,
            memory=rows.spent[1],
            reference_seconds=reference[0] + sum(self.prices.stages.values()),
            reference_memory=reference[1],
            planning_seconds=self._setup + time.perf_counter() - start,
        )

    def _settle(self, steps: list[Ladder], skips: list[Skip], allowed: float, noise: float | None) -> float | None:
        """Climb until the estimates fit, and where those of one choice tell little of another's on until the last trial
        does; gives the error that it found.
        """
        counted = [skip for skip in skips if skip.counted]
        if self.evaluator.foretells(allowed):
            self._foretell(steps, counted, allowed / UNTRIED)
            return None
        while True:
            _climb(steps, counted, self.evaluator, allowed / SAFETY)
            ways: list[Any] = [*_relevant(steps), *counted]
            below = [way for way in ways if not way.at_top]
            if not below:
                return 0.0
            changes = _changes(steps)
            shortcuts = shortcuts_of(skips, allowed, noise)
            key = tuple(sorted(changes.items())), repr(sorted(shortcuts.items()))
            if key not in self._checked:
                self._checked[key] = self.evaluator.last(changes, shortcuts)
            if self._checked[key] <= allowed / SAFETY:
                return self._checked[key]
            max(below, key=_urgency).climb(self.evaluator, allowed / SAFETY)

    def _foretell(self, steps: list[Ladder], counted: list[Skip], most: float) -> None:
        """Climb until the estimates fit, and then look at what is looked at last."""
        ways: list[Any] = [*steps, *counted]
        climb = functools.partial(_climb, steps, counted, self.evaluator, most)
        for ladder in steps:
            if ladder.bounds or self._last(ladder):
                ladder.position = ladder.bounded(most)
        climb()
        for ladder in filter(self._last, steps):
            before, places = _changes(steps), [way.position for way in ways]
            if ladder.position == 0 or not self._fits(ladder, steps, counted, most):
                continue
            if not (ladder.nothing or self.prices.worth(ladder, before)):
                continue
            ladder.position = 0
            climb()
            if self.prices.of(_changes(steps))[0] > self.prices.of(before)[0]:  # others climbed for it
                for way, position in zip(ways, places, strict=True):
                    way.position = position
                climb()  # finer rungs may have told more of these

    def _fits(self, ladder: Ladder, steps: list[Ladder], counted: list[Skip], most: float) -> bool:
        """Whether what is foreseen, if anything, may do; for a single picture beside what others take now."""
        if not ladder.foreseen or not self.one:
            return ladder.foreseen <= most
        others: list[Any] = [way for way in (*_relevant(steps), *counted) if way is not ladder]
        return together([ladder.foreseen, *(way.error for way in others)]) <= most

    def _last(self, ladder: Ladder) -> bool:
        """Whether it is looked at when the others stand, where it then saves enough."""
        return ladder.tried or (ladder.doubtful and self.one)

    def _ways(self) -> tuple[list[Ladder], list[Skip]]:
        """All choices."""
        if self._known is None:
            prices = self.prices
            every = ladders(self.evaluator, prices.scene, one=self.one)
            later = self.one and self.evaluator.certain  # `_settle` asks whether they are worth it
            steps = [ladder for ladder in every if later or not ladder.doubtful or prices.saves(ladder)]
            skips = [Skip(self.camera, index, self.evaluator) for index in self.evaluator.skippable()]
            self._known = steps, skips
        return self._known


def explain(
    camera: Camera, scene: Scene, *, tolerance: float | str, measure: bool = False, max_memory: float | None = None
) -> Plan:
    """A plan for a scene; with `measure`, also its true error and times: the raw with and without it, by turns.

    Arguments and errors: as `make_plan`.

    Example:
    >>> from kcam.planner import explain
    >>> plan = explain(Camera.phone(), Scene.builtin("coffee", size=32), tolerance=0.02, measure=True)
    >>> plan.measured["error"] <= 0.02
    True
    """
    plan = make_plan(camera, scene, tolerance=tolerance, max_memory=max_memory)
    return dataclasses.replace(plan, measured=measured(plan, camera, scene)) if measure else plan


def measured(plan: Plan, camera: Camera, scene: Scene, *, rounds: int = 3) -> dict[str, float]:
    """True error of a plan, and the median times of the raw with it and without, by turns [s].

    Example:
    >>> from kcam.planner import measured
    >>> camera, scene = Camera.phone(), Scene.builtin("coffee", size=32)
    >>> found = measured(camera.plan(scene, tolerance=0.02), camera, scene, rounds=1)
    >>> sorted(found), found["error"] <= 0.02
    (['error', 'reference_seconds', 'seconds'], True)
    """
    found: dict[str, list[float]] = {"seconds": [], "reference_seconds": []}
    error = plan.measure(camera, scene)
    with torch.no_grad():
        for _ in range(rounds):
            for name, shot in (("seconds", plan.apply(camera)), ("reference_seconds", camera)):
                found[name].append(timed(shot, scene)[0])
    return {"error": error} | {name: statistics.median(times) for name, times in found.items()}


def fresh(stage: Any) -> Any:
    """The stage, of which an Imaging has kept nothing."""
    return stage.fresh() if isinstance(stage, Imaging) else stage


def timed(camera: Camera, scene: Scene) -> tuple[float, torch.Tensor]:
    """Seconds of the noiseless raw with new optics, of which nothing is kept, and the raw.

    Example:
    >>> from kcam.planner import timed
    >>> seconds, raw = timed(Camera.phone(), Scene.builtin("coffee", size=32))
    >>> seconds > 0, raw.shape
    (True, torch.Size([1, 1, 21, 32]))
    """
    raw = noiseless_raw(Camera(*(fresh(stage) for stage in camera), context=camera.context))
    start = time.perf_counter()
    result = raw(scene)
    return time.perf_counter() - start, result


def _check_scenes(scenes: Sequence[Any], max_memory: float | None) -> None:
    if not scenes:
        raise ValueError("there is no scene to plan for. Give one, or several: camera.plan([scene, ...], ...).")
    for scene in scenes:
        if not isinstance(scene, Scene):
            raise TypeError(f"a plan is for scenes, got {type(scene).__name__}. Use Scene.from_rgb(image, depth=2.0).")
    if len({tuple(scene.wavelengths.tolist()) for scene in scenes}) > 1:
        raise ValueError("the scenes have different wavelengths. Plan together for those of the same.")
    if max_memory is not None:
        check_memory(max_memory)


def check_tolerance(tolerance: Any) -> None:
    """ValueError for what is no tolerance of a plan."""
    if isinstance(tolerance, str) and tolerance != SENSOR:
        raise ValueError(f'unknown tolerance "{tolerance}": expected a number such as 0.01, or "{SENSOR}".')
    number = isinstance(tolerance, Real) and not isinstance(tolerance, bool)
    if not isinstance(tolerance, str) and not (number and 0 <= tolerance < math.inf):
        raise ValueError(f'tolerance must be a relative error >= 0 such as 0.01, or "{SENSOR}", got {tolerance!r}.')


def _relevant(steps: Sequence[Ladder]) -> list[Ladder]:
    """Ladders that matter: without blur, none of those that say how to compute it."""
    sharp = any(ladder.level.changes.get("blur") is False for ladder in steps)
    return [ladder for ladder in steps if not (sharp and ladder.blurs)]


def _changes(steps: Sequence[Ladder]) -> dict[str, Any]:
    """What they change, as they stand."""
    return {key: value for ladder in _relevant(steps) for key, value in ladder.level.changes.items()}


def _climb(steps: Sequence[Ladder], skips: Sequence[Skip], evaluator: Evaluator, most: float) -> None:
    """One rung at a time, on the ladder with the largest error, until all together fit; followers last."""
    movable: list[Any] = [skip for skip in skips if skip.counted]
    while True:
        relevant: list[Any] = [*_relevant(steps), *movable]
        for follows in (False, True):
            own = [ladder for ladder in relevant if follows or not (isinstance(ladder, Ladder) and ladder.follows)]
            for ladder in own:
                ladder.price(evaluator, most)
            if together(ladder.error for ladder in own) > most:
                max(own, key=_urgency).climb(evaluator, most)
                break
        else:
            return


def _urgency(way: Ladder | Skip) -> float:
    """Its error, counted more where leaving it saves nothing."""
    return way.error * (way.urgency if isinstance(way, Ladder) else 1.0)


class _Rows:
    """The decisions, one after the other, and what is spent after each."""

    def __init__(self, price: Prices) -> None:
        self.price = price
        self.decisions: list[Decision] = []
        self.changes: dict[str, Any] = dict(price.always)
        self.spent, self.beside = price.of(self.changes), sum(price.stages.values())

    def _add(self, effect: str, chosen: str, instead: str, why: str, error: float = 0.0, counted: bool = True) -> None:
        self.decisions.append(
            Decision(effect, chosen, instead, why, error, counted, self.spent[0] + self.beside, self.spent[1])
        )

    def change(self, changes: Mapping[str, Any]) -> None:
        """Of the optics."""
        self.changes |= changes
        self.spent = self.price.of(self.changes)

    def add_ladder(self, ladder: Ladder) -> None:
        """A choice of optics."""
        self.change(ladder.level.changes)
        top = ladder.levels[-1].label
        instead = "" if ladder.level.label == top else top
        self._add(ladder.effect, ladder.level.label, instead, ladder.why(), ladder.error)

    def add_way(self) -> None:
        """The convolution, by predicted time alone: all ways have one result."""
        if self.price.imaging is None:
            return
        before = self.spent[0]
        after = self.price.of(self.changes | {"direct": True})[0]
        if after < before:
            self.change({"direct": True})
            self._add("convolution", "direct", "by FFT", f"{before / max(after, 1e-12):.2g} times as fast")
        else:
            self._add("convolution", "by FFT", "", "")

    def add_skip(self, skip: Skip, *, left_out: bool) -> None:
        """A stage of the sensor, or of the user's."""
        name = type(skip.stage).__name__
        error = skip.error_if_skipped if left_out or not skip.counted else skip.error
        replaced = skip.counted and not skip.at_top
        form, arguments, _ = skip.forms[skip.position] if replaced else ("kept", None, 0.0)
        chosen, instead = ("left out", "kept") if left_out else (form, "kept" if replaced else "")
        saved = self.price.stages[skip.index] if left_out else 0.0
        if arguments is not None:
            saved = self.price.stages[skip.index] - self.price.of_stage(skip.index, skip.stage.changed(**arguments))
        self.beside -= saved
        why = f"{skip.reason}; saves {saved * 1e3:.2g} ms" if left_out else skip.reason
        self._add(name, chosen, instead, why, error, skip.counted)

    def add_saturation(self, camera: Camera, evaluator: Evaluator) -> None:
        """What the full well cuts off."""
        for index, stage in enumerate(camera):
            if isinstance(stage, ShotNoise):
                lights = (given[index][0] for given in evaluator.signals)
                peak = max((float(light.max()) for light in lights if light.numel()), default=0.0)
                fills = "would fill, without blur," if evaluator.dimmed else "fills"
                why = f"the brightest pixel {fills} {peak:.2g} of the well"
                self._add("saturation", "kept", "", why)
            if isinstance(stage, ENDS):
                return

    def add_memory(self) -> None:
        """How the work is split."""
        if self.price.imaging is None:
            return
        most = self.changes.get("max_memory", self.price.imaging.accuracy.max_memory)
        now, before = (f"{memory / 1e6:.0f} MB" for memory in (self.spent[1], self.price.of({})[1]))
        self._add("memory", now, before, f"max_memory {most / 1e6:.0f} MB")
