"""Effects of light and sensor, drawn into any camera."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence

import torch

from benchmarks.pairs.parts import smooth_field
from kcam import Camera, Scene, isp, optics, sensor
from kcam.units import mm


def with_effects(camera: Camera, scene: Scene, seed: str) -> tuple[Camera, str]:
    """The camera with one to four of the effects that light and a sensor may have, from hardly any to too much."""
    draw = random.Random(f"effects/{seed}")
    chosen = draw.sample(sorted(INSERTS), draw.randint(1, 4))
    stages, named = list(camera), []
    for name in chosen:
        stage = INSERTS[name](draw, scene)
        place = _place(stages, stage)
        if place is not None:
            stages.insert(place, stage)
            named.append(name)
    return Camera(*stages, context=camera.context), " + ".join(named) or "no effect that fits"


def _much(draw: random.Random, low: float, high: float) -> float:
    return math.exp(draw.uniform(math.log(low), math.log(high)))


def _random_motion(draw: random.Random, scene: Scene) -> sensor.Motion:
    time, readout = 0.01, draw.choice([0.0, 0.0, 0.02])
    pixels, angle = _much(draw, 0.02, 12) / (time + readout), draw.uniform(0, 2 * math.pi)
    velocity = pixels * math.cos(angle), pixels * math.sin(angle)
    kind = draw.choice(["velocity", "path", "flow"])
    if kind == "velocity":
        return sensor.Motion(velocity, time=time, readout=readout)
    if kind == "path":
        path = sensor.tremor(time + readout, seed=draw.randrange(1000), count=9)
        return sensor.Motion(path=path / path.abs().max() * pixels * (time + readout), time=time, readout=readout)
    generator = torch.Generator().manual_seed(draw.randrange(2**31))
    fields = [smooth_field((scene.shape[1], scene.shape[2]), scale=2, generator=generator) - 0.5 for _ in range(2)]
    return sensor.Motion(flow=2 * pixels * torch.stack(fields).float(), time=time, readout=readout)


def _random_glass(draw: random.Random, scene: Scene) -> sensor.Transmission:
    nodes = torch.linspace(400e-9, 740e-9, 6, dtype=torch.float64)
    return sensor.Transmission(nodes, torch.tensor([draw.uniform(0.05, 1) for _ in range(6)]))


INSERTS: dict[str, Callable[[random.Random, Scene], torch.nn.Module]] = {
    "glass": _random_glass,
    "glare": lambda draw, _: optics.VeilingGlare(
        _much(draw, 1e-3, 0.1), core=_much(draw, 1e-3, 0.02), slope=draw.uniform(1.5, 2.5), focal_length=50 * mm
    ),
    "shading": lambda draw, _: sensor.MicrolensShading(draw.uniform(0.05, 0.8), pupil_distance=_much(draw, 1, 50) * mm),
    "motion": _random_motion,
    "crosstalk": lambda draw, _: sensor.Crosstalk(_much(draw, 1e-4, 0.1), electrical=_much(draw, 1e-4, 0.1)),
    "defects": lambda draw, _: sensor.DefectPixels(_much(draw, 1e-5, 1e-2), dead=_much(draw, 1e-5, 1e-2)),
    "banding": lambda draw, _: sensor.RowColumnNoise(_much(draw, 0.1, 30), fixed_column=_much(draw, 0.1, 30)),
    "bend": lambda draw, _: sensor.Nonlinearity(draw.choice([-1, 1]) * _much(draw, 1e-4, 0.1)),
}
"""What is drawn into a camera, by name."""


def _place(stages: Sequence[torch.nn.Module], stage: torch.nn.Module) -> int | None:
    """Where it belongs; None where a camera has no place for it."""

    def first(*kinds: type) -> int | None:
        return next((index for index, one in enumerate(stages) if isinstance(one, kinds)), None)

    colours, tile = first(sensor.ColourFilter), first(sensor.Mosaic) is None
    if isinstance(stage, sensor.Transmission):
        return colours
    timed = any(isinstance(one, sensor.Exposure) and one.time is not None for one in stages)
    if timed and isinstance(stage, sensor.Motion):  # whose own time would be another
        return None
    if isinstance(stage, (optics.VeilingGlare, sensor.Motion, sensor.MicrolensShading)):
        return None if colours is None or tile else colours + 1
    if isinstance(stage, sensor.Crosstalk):
        mosaic = first(sensor.Mosaic)
        return None if mosaic is None else mosaic + 1
    if isinstance(stage, sensor.DefectPixels):
        return first(sensor.ShotNoise, isp.Clip)
    return first(sensor.ADC, isp.Clip)
