"""Training a camera's optics, filter and last layers by gradient descent, so that it stops and goes on bit for bit."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from kcam.camera import Camera
from kcam.planner import Plan
from kcam.style.processes import anywhere
from kcam.style.run import Run
from kcam.style.scenes import BuiltinScenes, Source
from kcam.style.settings import Settings
from kcam.texture.losses import StyleLoss
from kcam.threads import fixed


@dataclass(frozen=True)
class Progress:
    """What is known after a step: its number, the terms of its loss, and the seconds since the start.

    Example:
    >>> from kcam.style import Progress
    >>> done = Progress(step=10, terms={"total": 1.5, "style": 1.2}, seconds=4.0)
    >>> f"{done.step}: {done.terms['total']:.2f}"
    '10: 1.50'
    """

    step: int
    terms: dict[str, float]
    seconds: float


@dataclass(frozen=True)
class Trained:
    """A trained camera and how it came about.

    camera: with the averaged weights. history: (N, 1 + terms) float64, total and terms of each step. names: of its
    columns. profile: seconds by part of a step, over the `steps_timed` that this call took. advice: warnings that were
    given. plan: the last one, if any. finished: whether all steps were taken.

    Example:
    >>> from kcam.style import Settings, StyleLoss, fit, painting, style_camera
    >>> loss = StyleLoss(painting("woodcut", size=128))
    >>> trained = fit(style_camera(stage=False), loss, settings=Settings(steps=1, size=64, batch=1))
    >>> trained.names, tuple(trained.history.shape), trained.finished
    (('total', 'style', 'colour', 'content'), (1, 4), True)
    """

    camera: Camera
    history: Tensor
    names: tuple[str, ...]
    profile: dict[str, float]
    steps_timed: int
    advice: tuple[str, ...]
    plan: Plan | None
    finished: bool


@fixed()
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
    each process takes its rows of the batch from the first noise or the demosaic on, and all take what precedes that,
    for the whole batch: camera and loss curve are those of one process, bit for bit, with as many threads in each.

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

    Example:
    >>> from kcam.style import Settings, StyleLoss, fit, painting, style_camera
    >>> camera = style_camera(stage=False)
    >>> trained = fit(camera, StyleLoss(painting("woodcut", size=128)), settings=Settings(steps=1, size=64, batch=1))
    >>> tuple(trained.history.shape), trained.finished
    ((1, 4), True)
    """
    if not isinstance(camera, Camera) or not isinstance(loss, StyleLoss):
        raise TypeError(
            f"fit takes a Camera and a StyleLoss, got {type(camera).__name__} and {type(loss).__name__}. Use "
            "fit(camera, StyleLoss(picture))."
        )
    settings = settings or Settings()
    source = source or BuiltinScenes(settings.size)
    run = Run(camera, loss, source, settings, folder)
    if resume:
        run.resume()
    elif run.checkpoints is not None and run.checkpoints.steps():
        raise ValueError(f"{folder} holds the checkpoints of a run. Go on with resume=True, or choose another folder.")
    run.keep()
    while run.step < settings.steps:
        run.take_step()
        if advance is not None and run.history:
            advance(Progress(run.step, run.terms(), run.clock.total()))
        stopped = anywhere(stop is not None and stop(), run.world)
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
