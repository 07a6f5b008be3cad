"""Several pictures one after the other: bursts and brackets, of one still image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from kcam import optics, sensor
from kcam.camera import Camera
from kcam.scene import Scene
from kcam.sensor.arguments import check_not_negative
from kcam.units import as_numbers, check_positive

SEEDS = 2**63 - 1


def burst(
    camera: Camera,
    scene: Scene | Tensor,
    *,
    exposures: Sequence[float],
    motion: sensor.Motion | None = None,
    interval: float = 0.0,
    generator: torch.Generator | None = None,
) -> Tensor:
    """See `Camera.burst`.

    Raises:    TypeError, ValueError: see there.

    Example:
    >>> from kcam.burst import burst
    >>> burst(Camera.ideal(), Scene.builtin("coffee", size=16), exposures=[1.0, 2.0]).shape
    torch.Size([2, 1, 3, 10, 16])
    """
    factors = _as_exposures(exposures)
    if not factors:
        raise ValueError("there are no exposures: expected one for each picture, such as exposures=[0.25, 1, 4].")
    for factor in factors:
        check_positive(factor, name="exposures", unit="(seconds, or times the camera's own)")
    check_not_negative(interval, name="interval", unit="s")
    place = next((index for index, stage in enumerate(camera) if isinstance(stage, sensor.Exposure)), None)
    if place is None:
        raise ValueError("a burst needs a stage that exposes. Put sensor.Exposure() before the noise.")
    exposure: sensor.Exposure = camera[place]
    first, told = _still_until(camera), camera.resolve(scene)
    if motion is not None:
        _check_motion(motion, camera, first, place)
    first = min(first, place)
    own = 1.0 if exposure.compensation is None else exposure.compensation
    still: Any = camera[:first](scene) if first else scene
    still = still.bands() if isinstance(still, Scene) else still
    device = "cpu" if generator is None else generator.device
    seeds = torch.randint(SEEDS, (len(factors),), generator=generator, device=device).tolist()
    pictures, clock = [], 0.0
    for factor, seed in zip(factors, seeds, strict=True):
        change: dict[str, Any] = {"compensation": factor * own} if exposure.time is None else {"time": factor}
        stages = [*camera][first:]
        stages[place - first] = exposure.changed(**change)
        if motion is not None:
            time: Any = motion.time if exposure.time is None else factor
            stages.insert(0, motion.changed(time=time, start=motion.start + clock))
            clock += sum(float(torch.as_tensor(part).detach()) for part in (time, motion.readout, interval))
        shot = Camera(*stages, context=told)
        pictures.append(shot(still, generator=torch.Generator(still.device).manual_seed(seed)))
    return torch.stack(pictures)


def _as_exposures(exposures: Any) -> list[float]:
    try:
        return [float(as_numbers(one, name="exposures", expected="numbers")) for one in exposures]
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(
            "exposures must be a list of numbers such as [0.25, 1, 4], one for each picture: seconds for a camera with "
            f"Exposure(time=...), else times its own exposure. Got {exposures!r}."
        ) from None


def _still_until(camera: Camera) -> int:
    """How many stages make the still image: what moves is seen by what comes after."""
    count = 0
    for index, stage in enumerate(camera, start=1):
        if isinstance(stage, optics.Imaging) or (isinstance(stage, sensor.ColourFilter) and not stage.is_tile):
            count = index
    return count


def _check_motion(motion: Any, camera: Camera, first: int, place: int) -> None:
    if not isinstance(motion, sensor.Motion):
        raise TypeError(f"motion must be a sensor.Motion such as Motion(velocity=(100.0, 0.0)), got {motion!r}.")
    if any(isinstance(stage, sensor.Motion) for stage in camera):
        raise ValueError("the camera has a Motion of its own. Give it to the burst: motion=, and the camera none.")
    if motion.path is not None:
        raise ValueError("a path ends with its exposure, and a burst goes on. Give its motion a velocity or a flow.")
    if place < first:
        raise ValueError("Exposure stands before the optics, so no still image comes before it. Move it behind them.")
    if motion.time is None and camera[place].time is None:
        raise ValueError("the motion knows no exposure time: give it time= [s], or the camera an Exposure(time=...).")
