"""What changes while a camera trains: weights, moments, losses, the plan; kept, saved, and gone back to."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypedDict

import torch
from torch import Tensor, nn

from kcam import isp, sensor
from kcam.camera import Camera
from kcam.isp.style_stage import LEAST_SHOWN
from kcam.plain import fitting
from kcam.planner import Plan
from kcam.style.checkpoints import Checkpoints
from kcam.style.generators import torch_generator
from kcam.style.optimiser import load_optimiser_state, optimiser_state
from kcam.style.processes import place, start_alike, told_by_the_first
from kcam.style.scenes import Source
from kcam.style.settings import Settings, trained_parameters
from kcam.style.step import gradients
from kcam.texture.losses import StyleLoss, luminance

NOISE_STREAM = 2**40  # streams of the camera's noise lie beyond those of the scenes: one for each row and stage
MOST_STAGES = 2**10
DIVERGED = 10.0  # times the median of the last losses
MEMORY = 50  # losses
LOOK = 20  # steps between looks at the pictures
SETTLED = 50  # steps: before, pictures are neither the scene nor the style yet, and say nothing
AIM_GAIN, AIM_MEMORY, AIM_RANGE = 0.02, 0.95, 2.0
MOST_RETURNS = 3
CLIPPED, NEGATIVE, DEAD = 0.1, 0.3, 0.05


class StyleWarning(UserWarning):
    """A camera in training turns negative, clips, or sees nothing in a channel.

    Example:
    >>> from kcam.style import StyleWarning
    >>> issubclass(StyleWarning, UserWarning)
    True
    """


class TrainingError(RuntimeError):
    """Training cannot go on: at which step, by which term, on which scenes.

    Example:
    >>> from kcam.style import TrainingError
    >>> issubclass(TrainingError, RuntimeError)
    True
    """


class _State(TypedDict):
    """Of a checkpoint, what is no tensor."""

    step: int
    returns: int
    slower: float
    emphasis: float
    lost: float
    names: list[str]
    advice: list[str]
    optimiser: dict[str, Any]
    plan: str | None
    run: dict[str, Any]


class Run:
    """What changes while a camera trains."""

    def __init__(self, camera: Camera, loss: StyleLoss, source: Source, settings: Settings, folder: Any) -> None:
        self.camera, self.loss, self.source, self.settings = camera, loss, source, settings
        self.parts = trained_parameters(camera, settings)
        self.named = {name: p for part in self.parts.values() for name, p in part}
        self.rank, self.world = place()
        self.leads = self.rank == 0
        if settings.batch % self.world:
            raise ValueError(
                f"a batch of {settings.batch} cannot be shared by {self.world} processes. Use a multiple of it."
            )
        start_alike([*camera.parameters(), *camera.buffers()], self.world)
        groups = [
            {
                "params": [p for _, p in named],
                "lr": settings.rates[part],
                "weight_decay": settings.weight_decay if part in settings.decayed else 0.0,
            }
            for part, named in self.parts.items()
        ]
        self.optimiser = torch.optim.Adam(groups, betas=settings.betas)
        self.checkpoints = Checkpoints(folder) if folder is not None and self.leads else None
        self.average = {name: p.detach().clone() for name, p in self.named.items()}
        self.step, self.returns, self.slower = 0, 0, 1.0
        self.emphasis, self.lost = 1.0, 0.0  # factor of the content's weight, and the content loss of late
        self.names: tuple[str, ...] = ()
        self.history: list[list[float]] = []
        self.advice: list[str] = []
        self.clock = _Clock()
        self.plan: Plan | None = None
        self._snapshot: dict[str, Any] = {}
        self.through = camera  # a plan puts another one here
        self._white = self._responses()

    # ---- one step --------------------------------------------------------------------------------------------------

    def take_step(self) -> None:
        settings = self.settings
        self.clock.start()
        scene, origins = self.source.draw(range(settings.batch), seed=settings.seed, step=self.step)
        device = next(iter(self.named.values())).device
        scene = scene.to(device=device)
        if self.plan is None:
            self._make_plan()

        def generator(row: int, stage: int) -> torch.Generator:
            stream = NOISE_STREAM + MOST_STAGES * row + stage
            return torch_generator(settings.seed, self.step, stream=stream, device=device)

        self.clock.mark("scenes")
        taken = gradients(
            self.through,
            self.loss,
            scene,
            generator,
            parameters=list(self.named.values()),
            turn=self.step,
            emphasis=self.emphasis,
            mark=self.clock.mark,
        )
        norm = nn.utils.clip_grad_norm_(self.named.values(), settings.clip)
        self.names, values = tuple(taken.values), list(taken.values.values())
        wrong = self._what_is_wrong(values, float(norm))
        if wrong:
            self._go_back(wrong, origins)
            return
        rate = settings.rate(self.step) * self.slower
        for group, part in zip(self.optimiser.param_groups, self.parts, strict=True):
            group["lr"] = settings.rates[part] * rate
        self.optimiser.step()
        self.step += 1
        with torch.no_grad():  # the share of the past grows from nothing: the start does not count
            past = min(settings.average, self.step / (self.step + 9)) if settings.average else 0.0
            for name, p in self.named.items():
                self.average[name].lerp_(p, 1 - past)
        self.history.append(values)
        self._aim()
        self.clock.mark("update")
        if self.step % LOOK == 0 and self.step > SETTLED:
            self._look(taken.pictures, taken.shown)

    def _aim(self) -> None:
        """Move the content's weight towards what makes its loss the one that is aimed at."""
        aim = self.settings.content_aim
        if aim is None or "content" not in self.names or self.loss.content_by != "correlation":
            return
        now = self.terms()["content"] / (self.emphasis * self.loss.weights["content"])
        past = AIM_MEMORY if self.step > 1 else 0.0
        self.lost = past * self.lost + (1 - past) * now
        if self.step > SETTLED and self.lost > 0:
            moved = self.emphasis * (self.lost / aim) ** AIM_GAIN
            self.emphasis = min(AIM_RANGE, max(1 / AIM_RANGE, moved))

    def _what_is_wrong(self, values: list[float], norm: float) -> str | None:
        for name, value in zip(self.names, values, strict=True):
            if name != "total" and not math.isfinite(value):
                return f"the {name} term is {value:g}"
        if not math.isfinite(norm):
            return f"the norm of the gradient is {norm:g}"
        recent = sorted(row[0] for row in self.history[-MEMORY:])
        if len(recent) == MEMORY and values[0] > DIVERGED * max(recent[MEMORY // 2], 1e-3):
            return f"the loss is {values[0]:.3g}, {values[0] / recent[MEMORY // 2]:.0f} times its recent median"
        return None

    def _go_back(self, wrong: str, origins: list[str]) -> None:
        """To the last good state with half the learning rate, or stop."""
        where = f"step {self.step}: {wrong}, on {'; '.join(origins)}"
        self.returns += 1
        if self.returns > MOST_RETURNS:
            raise TrainingError(
                f"training stopped at {where}. It went back {MOST_RETURNS} times, each time with half the learning "
                "rates. Look at these scenes, or lower the rates."
            )
        returns, slower = self.returns, self.slower / 2
        self._restore(self._snapshot)
        self.returns, self.slower = returns, slower
        self._advise(f"{where}. Back to step {self.step}, with half the learning rates.")

    # ---- what a user should know -----------------------------------------------------------------------------------

    def _advise(self, text: str) -> None:
        self.advice.append(text)
        if self.leads:
            warnings.warn(text, StyleWarning, stacklevel=4)

    def _look(self, picture: Tensor, shown: Tensor) -> None:
        """Warn, once each, of a negative, of clipped pictures, and of a channel that goes blind."""
        pairs = torch.stack([luminance(picture).flatten(1), luminance(shown).flatten(1)], dim=1)
        alike = float(torch.stack([torch.corrcoef(pair)[0, 1] for pair in pairs]).nan_to_num(1.0).mean())
        end = LEAST_SHOWN + 1e-3 if any(isinstance(s, isp.StyleStage) for s in self.camera) else 1 / 512
        clipped = float(((picture <= end) | (picture >= 1 - end)).float().mean())
        curves = zip(self._responses(), self._white, strict=True)
        blind = [index for index, (now, start) in enumerate(curves) if now < DEAD * start]
        for key, happens, text in (
            ("negative", alike < NEGATIVE, f"the pictures look like negatives: luminance correlation {alike:.2f}"),
            ("clipped", clipped > CLIPPED, f"{clipped:.0%} of the pictures is black or white: they clip"),
            ("filter", bool(blind), f"channel {blind} of the colour filter has gone blind"),
        ):
            if happens and not any(key in text for text in self.advice):
                self._advise(f"step {self.step}: {text} ({key}). More content weight, or lower rates, may help.")

    def _responses(self) -> list[float]:
        """How much of white light each curve of the filter takes."""
        filters = [stage for stage in self.camera if isinstance(stage, sensor.ColourFilter)]
        with torch.no_grad():
            return [float(v) for f in filters for v in f.white(self.camera.resolve().wavelengths)]

    # ---- plans -----------------------------------------------------------------------------------------------------

    def _make_plan(self) -> None:
        """A plan for scenes that training draws; where one was made before, only if it now misses the tolerance.

        Without a tolerance there is none.
        """
        tolerance = self.settings.tolerance
        if tolerance is None:
            return
        if self.leads:  # what a plan chooses depends on how fast its machine is
            scenes = [self.source.draw([row], seed=self.settings.seed, step=self.step)[0] for row in range(2)]
            plan = self.plan
            if plan is None or max(plan.measure(self.camera, scene) for scene in scenes) > tolerance:
                with torch.enable_grad():  # the plan is trained through: it holds gradients to the tolerance too
                    self.plan = self.camera.plan(scenes, tolerance=tolerance)
        self.plan = told_by_the_first(self.plan, self.world)
        self._use_plan(self.plan)

    def _use_plan(self, plan: Plan | None) -> None:
        if plan is not None:
            planned = plan.apply(self.camera)  # a plain camera: a planned one would warn of each scene unlike its own
            self.through = Camera(*planned, context=self.camera.context)

    # ---- keeping and going on --------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """All that the next steps depend on: tensors and plain values."""
        moments, groups = optimiser_state(self.optimiser, self._by_parameter())
        tensors = {f"camera/{name}": value for name, value in self.camera.state_dict().items()}
        tensors |= {f"average/{name}": value for name, value in self.average.items()}
        tensors |= moments
        tensors["history"] = self.table()
        document = {
            "step": self.step,
            "returns": self.returns,
            "slower": self.slower,
            "emphasis": self.emphasis,
            "lost": self.lost,
            "names": list(self.names),
            "advice": self.advice,
            "optimiser": groups,
            "plan": None if self.plan is None else self.plan.to_json(),
            "run": self._identity(),
        }
        return {"tensors": {name: value.detach().clone() for name, value in tensors.items()}, "document": document}

    def _by_parameter(self) -> dict[Tensor, str]:
        return {p: name for name, p in self.named.items()}

    def _identity(self) -> dict[str, Any]:
        """What must be the same for a run to go on."""
        quantiles = self.loss.quantiles.detach().cpu().numpy()
        style = hashlib.sha256(quantiles.tobytes()).hexdigest()[:16]
        loss = self.loss
        return {
            "settings": _as_in_json(dataclasses.asdict(self.settings)),
            "style": style,
            "loss": {"weights": loss.weights, "statistic": loss.statistic, "content_by": loss.content_by},
            "correlation": _as_in_json(loss.correlation),
            "features": [loss.features.name, loss.content_layer],
            "source": [type(self.source).__name__, len(self.source)],
            "parameters": {name: list(p.shape) for name, p in self.named.items()},
        }

    def keep(self) -> None:
        """Remember this state as the last good one."""
        self._snapshot = self.state()

    def save(self) -> None:
        """A checkpoint; a plan that no longer holds is made anew first, so that it is the one that is kept.

        But not where a run was stopped in between: one that was not would have kept its plan.
        """
        if self.step % self.settings.every == 0:
            self._make_plan()
        self.keep()
        if self.checkpoints is not None:
            self.checkpoints.save(self.step, tensors=self._snapshot["tensors"], document=self._snapshot["document"])

    def resume(self) -> None:
        found = None if self.checkpoints is None else self.checkpoints.latest()
        told = None if found is None else (str(found.path), {"tensors": found.tensors, "document": found.document})
        told = told_by_the_first(told, self.world)
        if told is None:
            return
        path, state = told
        wrong = f"the checkpoint {path} is damaged"
        try:
            there, here = fitting(state["document"], _State)["run"], self._identity()
        except ValueError as error:
            raise ValueError(f"{wrong}: {error}.") from error
        for key, value in here.items():
            if there.get(key) != value:
                raise ValueError(f"the checkpoint is of another run: {_difference(key, there.get(key), value)}")
        try:
            self._restore(state)
        except Exception as error:  # of the right run and another content: torch says this in many ways
            raise ValueError(f"{wrong}: {error}") from error

    def _restore(self, state: dict[str, Any]) -> None:
        tensors, document = state["tensors"], state["document"]

        def group(prefix: str) -> dict[str, Tensor]:
            return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}

        self.camera.load_state_dict(group("camera/"))
        for name, value in group("average/").items():
            self.average[name].copy_(value)
        load_optimiser_state(self.optimiser, self._by_parameter(), tensors, document["optimiser"])
        self.step, self.returns, self.slower = document["step"], document["returns"], document["slower"]
        self.emphasis, self.lost = document["emphasis"], document["lost"]
        self.names, self.advice = tuple(document["names"]), list(document["advice"])
        self.history = tensors["history"].tolist()
        self.plan = None if document["plan"] is None else Plan.from_json(document["plan"])
        self._use_plan(self.plan)

    def table(self) -> Tensor:
        """The loss curve so far, (N, 1 + terms)."""
        return torch.tensor(self.history, dtype=torch.float64).reshape(len(self.history), max(1, len(self.names)))

    def terms(self) -> dict[str, float]:
        """Of the last step."""
        return dict(zip(self.names, self.history[-1], strict=True))

    @contextmanager
    def averaged(self) -> Iterator[None]:
        """The camera with its averaged weights, for a while."""
        if not self.settings.average:
            yield
            return
        last = {name: p.detach().clone() for name, p in self.named.items()}
        self._put(self.average)
        try:
            yield
        finally:
            self._put(last)

    def finish(self) -> None:
        """Leave the camera with its averaged weights."""
        if self.settings.average:
            self._put(self.average)

    def _put(self, values: dict[str, Tensor]) -> None:
        with torch.no_grad():
            for name, p in self.named.items():
                p.copy_(values[name])


class _Clock:
    """Seconds by part of a step."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.steps = 0
        self._began = self._last = time.perf_counter()

    def start(self) -> None:
        self.steps += 1
        self._last = time.perf_counter()

    def mark(self, part: str) -> None:
        now = time.perf_counter()
        self.seconds[part] = self.seconds.get(part, 0.0) + now - self._last
        self._last = now

    def total(self) -> float:
        return time.perf_counter() - self._began


def _as_in_json(values: dict[str, Any]) -> dict[str, Any]:
    """With lists for tuples, as they come back."""
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def _difference(key: str, there: Any, here: Any) -> str:
    if isinstance(there, dict) and isinstance(here, dict):
        for name in here:
            if there.get(name) != here[name]:
                return _difference(f"{key}.{name}", there.get(name), here[name])
    return f"its {key} is {there!r}, this one's {here!r}. Use the same settings and style, or another folder."
