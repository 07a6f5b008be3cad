"""Training a camera's optics, filter and last layers by gradient descent, so that it stops and goes on bit for bit."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from kcam import isp, optics, sensor
from kcam.camera import DEMOSAICING, Camera, is_random
from kcam.context import Stage
from kcam.isp.style_stage import LEAST_SHOWN
from kcam.planner import Plan
from kcam.scene import Scene
from kcam.style.checkpoints import Checkpoints
from kcam.style.draws import torch_generator
from kcam.style.losses import StyleLoss, luminance
from kcam.style.optimiser import load_optimiser_state, optimiser_state
from kcam.style.scenes import BuiltinScenes, Source

PARTS: dict[str, tuple[type[nn.Module], ...]] = {
    "optics": (optics.Imaging,),
    "filter": (sensor.ColourFilter,),
    "demosaic": (isp.LearnedDemosaic, isp.Convolution),
    "tone": (isp.WhiteBalance, isp.ColourMatrix, isp.ToneCurve),
    "stage": (isp.StyleStage,),
}
"""What can train, and the stages that hold it."""

NOISE_STREAM = 2**40  # streams of the camera's noise lie beyond those of the scenes: one for each row and stage
MOST_STAGES = 2**10
DIVERGED = 10.0  # times the median of the last losses
MEMORY = 50  # losses
LOOK = 20  # steps between looks at the pictures
AIMED_FROM = 50  # steps: before, there is more scene than style in any picture
AIM_GAIN, AIM_MEMORY, AIM_RANGE = 0.02, 0.95, 2.0
MOST_RETURNS = 3
CLIPPED, NEGATIVE, DEAD = 0.1, 0.3, 0.05


class StyleWarning(UserWarning):
    """A camera in training turns negative, clips, or sees nothing in a channel."""


class TrainingError(RuntimeError):
    """Training cannot go on: at which step, by which term, on which scenes."""


@dataclass(frozen=True)
class Settings:
    """How a camera is trained.

    steps: of the optimiser. batch: scenes per step. size: of their crops [pixels]. seed: of everything random.
    rates: learning rate of each of `PARTS`; a part that is left out does not train.
    betas, weight_decay: of Adam; the decay acts on `decayed` parts only.
    warm_up: steps of linearly growing rates; then they fall, by half a cosine, to `final` of theirs at the last step.
    clip: largest norm of the gradient; inf for any.
    average: of the weights, that is what is exported: share of the past, 0 for the last weights as they are.
    every: steps between checkpoints.
    content_aim: None leaves the content term at its weight; else its weight follows, within a factor of 2, so that the
        content loss itself settles here: strong strokes and faint ones then leave as much of the scene. For the loss by
        correlation alone; that by features has another unit for each network.
    tolerance: None trains through the reference physics; else through a plan for the training scenes, which is frozen
        between checkpoints and made anew where it is measured to miss the tolerance: see `kcam.Plan`.
    """

    steps: int = 400
    batch: int = 2
    size: int = 128
    seed: int = 0
    rates: dict[str, float] = field(
        default_factory=lambda: {"optics": 0.01, "filter": 0.05, "demosaic": 0.01, "tone": 0.01, "stage": 2e-2}
    )
    betas: tuple[float, float] = (0.9, 0.99)
    weight_decay: float = 0.0
    decayed: tuple[str, ...] = ()
    warm_up: int = 10
    final: float = 0.05
    clip: float = 1.0
    average: float = 0.99
    every: int = 100
    content_aim: float | None = None
    tolerance: float | None = None

    def __post_init__(self) -> None:
        unknown = (set(self.rates) | set(self.decayed)) - set(PARTS)
        if unknown:
            raise ValueError(f"unknown part {sorted(unknown)[0]!r} of a camera; what trains: {', '.join(PARTS)}.")
        for name, least in {"steps": 1, "batch": 1, "size": 1, "every": 1, "warm_up": 0}.items():
            value = getattr(self, name)
            if not isinstance(value, int) or value < least:
                raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}.")
        for name in ("weight_decay", "final", "tolerance"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < math.inf:
                raise ValueError(f"{name} must be a finite number >= 0, got {value!r}.")
        if not all(0 <= rate < math.inf for rate in self.rates.values()) or not any(self.rates.values()):
            raise ValueError(f"learning rates must be finite and >= 0, and one of them above, got {self.rates}.")
        if self.content_aim is not None and not 0 < self.content_aim < 2:
            raise ValueError(f"content_aim must be within 0..2, got {self.content_aim:g}. Use 0.16 or None.")
        if not self.clip > 0 or not 0 <= self.average < 1:
            raise ValueError(f"expected clip > 0 and 0 <= average < 1, got {self.clip:g} and {self.average:g}.")

    def rate(self, step: int) -> float:
        """Share of the learning rates at a step."""
        grown = min(1.0, (step + 1) / self.warm_up) if self.warm_up else 1.0
        return grown * (self.final + (1 - self.final) * 0.5 * (1 + math.cos(math.pi * step / self.steps)))


@dataclass(frozen=True)
class Progress:
    """What is known after a step: its number, the terms of its loss, and the seconds since the start."""

    step: int
    terms: dict[str, float]
    seconds: float


@dataclass(frozen=True)
class Trained:
    """A trained camera and how it came about.

    camera: with the averaged weights. history: (N, 1 + terms) float64, total and terms of each step. names: of its
    columns. profile: seconds by part of a step, over the `steps_timed` that this call took. advice: warnings that were
    given. plan: the last one, if any. finished: whether all steps were taken.
    """

    camera: Camera
    history: Tensor
    names: tuple[str, ...]
    profile: dict[str, float]
    steps_timed: int
    advice: tuple[str, ...]
    plan: Plan | None
    finished: bool


def part_of(stage: nn.Module) -> str | None:
    """Which of `PARTS` a stage of a camera is; None for none."""
    return next((part for part, kinds in PARTS.items() if isinstance(stage, kinds)), None)


def trained_parameters(camera: Camera, settings: Settings) -> dict[str, list[tuple[str, nn.Parameter]]]:
    """The parameters of each part that trains, with their names in the camera's state."""
    found: dict[str, list[tuple[str, nn.Parameter]]] = {}
    for index, stage in enumerate(camera):
        part = part_of(stage)
        if part is not None and settings.rates.get(part, 0):
            named = [(f"stages.{index}.{name}", p) for name, p in stage.named_parameters() if p.requires_grad]
            found.setdefault(part, []).extend(named)
    found = {part: named for part, named in found.items() if named}
    if not found:
        raise ValueError(
            f"nothing of this camera trains: no part of {', '.join(settings.rates)} holds an nn.Parameter. "
            "Use style_camera(), or give its DOE, filter or convolution an nn.Parameter."
        )
    return found


Generators = Callable[[int, int], torch.Generator]
"""The generator of a row of the batch and a stage."""


class Step(nn.Module):
    """A training step as one module: scenes to the terms of the loss; what torch's data parallel engine wraps."""

    def __init__(self, camera: Camera, loss: StyleLoss) -> None:
        super().__init__()
        self.camera, self.loss = camera, loss
        self.through: Camera = camera

    def forward(
        self, scene: Scene, generator: Generators, turn: int, mark: Callable[[str], None]
    ) -> tuple[dict[str, Tensor], Tensor]:
        """The terms, and the pictures (B,3,H,W)."""
        picture, recorded = photograph(self.through, scene, generator, recorded=bool(self.loss.weights["l2"]))
        mark("camera")
        shown = scene.to_srgb()
        terms = self.loss.terms(picture, shown, recorded=recorded, turn=turn)
        mark("loss")
        return terms, picture


def photograph(
    camera: Camera, scene: Scene, generator: Generators, *, recorded: bool = False
) -> tuple[Tensor, tuple[Tensor, Tensor] | None]:
    """Pictures of a batch with a generator for each row and stage: no noise depends on a neighbour's or an earlier one.

    An earlier one would: a Poisson draw takes as many numbers as it needs, which rounding can change.

    Returns:   the pictures, and with `recorded` what the sensor records with and without optics, before any noise:
               the two sides of the thesis's L2 content loss (its figure 4.1).
    """
    stops = (i for i, stage in enumerate(camera) if isinstance(stage, DEMOSAICING) or is_random(stage))
    split = next(stops, len(camera))
    context = camera.resolve(scene)
    front = Camera(*camera.stages[:split], context=context)
    light = front(scene)
    rows = []
    for number, row in enumerate(light):
        signal = row[None]
        for index, stage in enumerate(camera.stages[split:]):
            own = dataclasses.replace(context, generator=generator(number, index))
            signal = stage(signal, own) if isinstance(stage, Stage) else stage(signal)
        rows.append(signal)
    pair = None
    if recorded:
        flat = Camera(*(stage for stage in front if not isinstance(stage, optics.Imaging)), context=context)
        with torch.no_grad():  # a target: it does not move towards the picture
            pair = (light, flat(scene.bands()))
    return torch.cat(rows), pair


def fit(
    camera: Camera,
    loss: StyleLoss,
    *,
    source: Source | None = None,
    settings: Settings | None = None,
    folder: str | os.PathLike[str] | None = None,
    resume: bool = False,
    advance: Callable[[Progress], None] | None = None,
    on_checkpoint: Callable[[Camera, int, Tensor], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Trained:
    """Train a camera to take its pictures in the manner of a style.

    What is random is drawn by seed and step, so that a run that was killed goes on from its last checkpoint with the
    same weights, bit for bit, on the same machine, torch and number of threads. One exception: a run that was stopped
    between two checkpoints and then meets a loss that is not finite goes back to where it was stopped. Under torchrun
    each process takes its rows of the batch, and torch's DistributedDataParallel averages their gradients: the curve is
    that of one process up to rounding, which training makes grow, and until a photon or a step of the ADC falls the
    other way.

    Args:      camera: trains in place; its nn.Parameters in the parts with a learning rate.
               loss: the style.
               source: of the scenes; None: `BuiltinScenes` of the settings' size.
               settings: None for `Settings()`.
               folder: for checkpoints; None keeps none. One run owns it.
               resume: go on from the newest whole checkpoint in the folder; from the start if there is none.
               advance: called after each step.
               on_checkpoint: called with the camera as it would be exported, the number of steps done and the history.
               stop: asked after each step; True saves a checkpoint and returns what there is.
    Returns:   the camera, with averaged weights, and its history.
    Raises:    ValueError for a camera in which nothing trains, or a checkpoint of another run; TrainingError where the
               loss is not finite or diverges again and again.
    """
    settings = settings or Settings()
    source = source or BuiltinScenes(settings.size)
    run = _Run(camera, loss, source, settings, folder)
    if resume:
        run.resume()
    elif run.checkpoints is not None and run.checkpoints.steps():
        raise ValueError(f"{folder} holds the checkpoints of a run. Go on with resume=True, or choose another folder.")
    run.keep()
    while run.step < settings.steps:
        run.take_step()
        if advance is not None and run.history:
            advance(Progress(run.step, run.terms(), run.clock.total()))
        stopped = _anywhere(stop is not None and stop(), run.world)
        if run.step % settings.every == 0 or run.step == settings.steps or stopped:
            run.save()
            if on_checkpoint is not None and run.leads:
                with run.averaged():
                    on_checkpoint(camera, run.step, run.table())
        if stopped:
            break
    run.finish()
    return Trained(
        camera,
        history=run.table(),
        names=run.names,
        profile=run.clock.seconds,
        steps_timed=run.clock.steps,
        advice=tuple(run.advice),
        plan=run.plan,
        finished=run.step >= settings.steps,
    )


class _Run:
    """What changes while a camera trains."""

    def __init__(self, camera: Camera, loss: StyleLoss, source: Source, settings: Settings, folder: Any) -> None:
        self.camera, self.loss, self.source, self.settings = camera, loss, source, settings
        self.parts = trained_parameters(camera, settings)
        self.named = {name: p for part in self.parts.values() for name, p in part}
        self.rank, self.world = _place()
        self.leads = self.rank == 0
        if settings.batch % self.world:
            raise ValueError(
                f"a batch of {settings.batch} cannot be shared by {self.world} processes. Use a multiple of it."
            )
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
        self.module = Step(camera, loss)
        self.engine: Any = self.module
        if self.world > 1:
            others = [p for p in camera.parameters() if not any(p is own for own in self.named.values())]
            for parameter in others:
                parameter.requires_grad_(False)  # the engine waits for the gradient of each that has one
            self.engine = nn.parallel.DistributedDataParallel(self.module)
        self._white = self._responses()

    # ---- one step --------------------------------------------------------------------------------------------------

    def take_step(self) -> None:
        settings = self.settings
        rows = range(self.rank, settings.batch, self.world)
        self.clock.start()
        scene, origins = self.source.draw(rows, seed=settings.seed, step=self.step)
        device = next(iter(self.named.values())).device
        scene = scene.to(device=device)
        if self.plan is None:
            self._make_plan()

        def generator(number: int, stage: int) -> torch.Generator:
            stream = NOISE_STREAM + MOST_STAGES * rows[number] + stage
            return torch_generator(settings.seed, self.step, stream=stream, device=device)

        self.clock.mark("scenes")
        terms, picture = self.engine(scene, generator, self.step, self.clock.mark)
        if "content" in terms:
            terms["content"] = terms["content"] * self.emphasis
        total = torch.stack(list(terms.values())).sum()
        self.optimiser.zero_grad()
        total.backward()
        norm = nn.utils.clip_grad_norm_(self.named.values(), settings.clip)
        self.clock.mark("gradient")
        self.names = ("total", *terms)
        values = _mean_over_processes(torch.stack([total, *terms.values()]).detach().double(), self.world).tolist()
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
        if self.step % LOOK == 0:
            self._look(picture.detach(), scene)

    def _aim(self) -> None:
        """Move the content's weight towards what makes its loss the one that is aimed at."""
        aim = self.settings.content_aim
        if aim is None or "content" not in self.names or self.loss.content_by != "correlation":
            return
        now = self.terms()["content"] / (self.emphasis * self.loss.weights["content"])
        past = AIM_MEMORY if self.step > 1 else 0.0
        self.lost = past * self.lost + (1 - past) * now
        if self.step > AIMED_FROM and self.lost > 0:
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

    def _look(self, picture: Tensor, scene: Scene) -> None:
        """Warn, once each, of a negative, of clipped pictures, and of a channel that goes blind."""
        shown = luminance(scene.to_srgb()).flatten(1)
        pairs = torch.stack([luminance(picture).flatten(1), shown], dim=1)
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
        scenes = [self.source.draw([row], seed=self.settings.seed, step=self.step)[0] for row in range(2)]
        with torch.no_grad():
            plan = self.plan
            if plan is None or max(plan.measure(self.camera, scene) for scene in scenes) > tolerance:
                self.plan = plan = self.camera.plan(scenes, tolerance=tolerance)
        self._use_plan(plan)

    def _use_plan(self, plan: Plan | None) -> None:
        if plan is not None:
            planned = plan.apply(self.camera)  # a plain camera: a planned one would warn of each scene unlike its own
            self.module.through = Camera(*planned, context=self.camera.context)

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
        settings, loss = dataclasses.asdict(self.settings), self.loss
        return {
            "settings": {name: list(v) if isinstance(v, tuple) else v for name, v in settings.items()},
            "style": style,
            "loss": {"weights": loss.weights, "statistic": loss.statistic, "content_by": loss.content_by},
            "correlation": {"levels": list(loss.levels), "window": loss.window, "whole": loss.whole},
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
        state = None if found is None else {"tensors": found.tensors, "document": found.document}
        if self.world > 1:
            shared = [state]
            torch.distributed.broadcast_object_list(shared)
            state = shared[0]
        if state is None:
            return
        there, here = state["document"]["run"], self._identity()
        for key, value in here.items():
            if there.get(key) != value:
                raise ValueError(f"the checkpoint is of another run: {_difference(key, there.get(key), value)}")
        self._restore(state)

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


def _place() -> tuple[int, int]:
    """This process and how many there are, as torchrun set them up."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return 0, 1


def _mean_over_processes(values: Tensor, world: int) -> Tensor:
    if world > 1:
        torch.distributed.all_reduce(values)
    return values / world


def _anywhere(said: bool, world: int) -> bool:
    """Whether one of the processes says so: they stop together."""
    if world == 1:
        return said
    flag = torch.tensor(float(said))
    if torch.distributed.get_backend() == "nccl":
        flag = flag.cuda()
    torch.distributed.all_reduce(flag)
    return bool(flag > 0)


def _difference(key: str, there: Any, here: Any) -> str:
    if isinstance(there, dict) and isinstance(here, dict):
        for name in here:
            if there.get(name) != here[name]:
                return _difference(f"{key}.{name}", there.get(name), here[name])
    return f"its {key} is {there!r}, this one's {here!r}. Use the same settings and style, or another folder."
