"""Hard pairs: what a plan could overlook."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from benchmarks.pairs.parts import LONGEST, bare_lens, first_within, random_sensor
from kcam import Camera, Scene, optics
from kcam.units import mm, um

HARD_SIDES = (96, 192, 384, 560, 768)


def hard_pair(seed: int, *, sides: tuple[int, ...] = HARD_SIDES) -> tuple[Camera, Scene, str, int]:
    """As `random_pair`, of what a plan could overlook: lamps out of focus, batches with one item unlike the others,
    saturation, depth edges in colour, hot pixels, wrapped radial profiles; the larger pictures with fewer items.
    """

    def draw_pair(draw: random.Random) -> tuple[Camera, Scene, str]:
        camera, lens = hard_camera(draw)
        scene, light = hard_scene(draw, sides)
        return camera, scene, f"{lens}; {light}"

    return first_within(LONGEST, f"hard/{seed}", draw_pair)


def hard_camera(draw: random.Random) -> tuple[Camera, str]:
    """A lens of 50 mm that is open to 3 to 8 mm, with a wrapped radial profile now and then; a sensor."""
    diameter, focus = draw.uniform(3, 8) * mm, 1 / draw.uniform(0.1, 1.5)
    ideal, radial = draw.random() < 0.5, draw.random() < 0.25
    elements = bare_lens(diameter, ideal=ideal)
    waves = draw.uniform(1, 8)
    if radial:
        profile = 2 * math.pi * waves * torch.linspace(0, 1, draw.choice([101, 201]), dtype=torch.float64)
        elements.append(optics.RadialDOE(torch.remainder(profile, 2 * math.pi)))
    stages, name = random_sensor(draw)
    imaging = optics.Imaging(optics.Lens(*elements, focus_distance=focus), pixel_pitch=draw.choice([4, 6]) * um)
    text = f"{diameter / mm:.2g} mm, focus {focus:.2g} m, {'ideal' if ideal else 'BK7'}"
    text += f", wrapped radial profile of {waves:.2g} waves" if radial else ""
    return Camera(imaging, *stages), f"{text}, {name}"


def hard_scene(draw: random.Random, sides: Sequence[int] = HARD_SIDES) -> tuple[Scene, str]:
    """Photographs of one exposure or many, with things in them of another distance and another light."""
    kind = draw.choice(["lamps", "batch", "saturated", "colour edge", "hot pixels", "one bright tile"])
    height, width = draw.choice(sides), draw.choice(sides)
    generator = torch.Generator().manual_seed(draw.randrange(2**31))
    batch = 1
    if kind == "batch" or draw.random() < 0.2:
        batch = draw.randint(2, 16)
        height, width = (min(side, 96) for side in (height, width))
    name = draw.choice(["astronaut", "coffee", "chelsea"])
    planes = Scene.builtin(name, (height, width)).coefficients.repeat(batch, 1, 1, 1)
    far = draw.uniform(0.1, 0.8)  # vergences
    near = draw.uniform(far, 2.5)
    flat = draw.random() < 0.2
    vergence = torch.full((batch, 1, height, width), far, dtype=torch.float64)
    rows, columns = torch.arange(float(height))[:, None], torch.arange(float(width))[None, :]
    odd = draw.randrange(batch)

    def disc() -> Tensor:
        radius = draw.uniform(1, max(2, min(height, width) / 16))
        place = draw.randrange(height), draw.randrange(width)
        return torch.hypot(rows - place[0], columns - place[1]) <= radius

    for item in range(batch):
        planes[item] *= 10 ** draw.uniform(-1.5, 0.5)
        if kind == "batch":
            planes[item] = planes[item].roll((draw.randrange(height), draw.randrange(width)), (-2, -1))
            vergence[item] = near if item == odd or draw.random() < 0.1 else far * draw.uniform(1, 1.05)
        elif kind == "lamps":
            for _ in range(draw.randint(1, 4)):
                place = disc()
                planes[item] = torch.where(place, planes[item] * 10 ** draw.uniform(0.5, 2) + 0.1, planes[item])
                vergence[item] = torch.where(place, draw.uniform(far, near), vergence[item])
        elif kind == "saturated":
            planes[item] = planes[item] * 10 ** draw.uniform(0.5, 2)
            share = torch.linspace(0, 1, width, dtype=torch.float64)
            vergence[item] = (far + (near - far) * share).expand(height, width)
        elif kind == "colour edge":
            edge = columns > width * draw.uniform(0.2, 0.8) + height / 8 * torch.sin(rows / draw.uniform(5, 40))
            colours = [torch.tensor([draw.random() ** 3 for _ in range(3)])[:, None, None] for _ in range(2)]
            planes[item] = (0.2 + 0.8 * planes[item]) * torch.where(edge, colours[0], colours[1])
            vergence[item] = torch.where(edge, near, far)
        elif kind == "hot pixels":
            planes[item] *= 0.1
            for _ in range(draw.randint(1, 5)):
                planes[item, :, draw.randrange(height), draw.randrange(width)] = 10 ** draw.uniform(0, 4)
        else:
            top, left = draw.randrange(max(1, height - 48)), draw.randrange(max(1, width - 48))
            bright = planes[item, :, top : top + 48, left : left + 48].clone()
            planes[item] *= 1e-3
            planes[item, :, top : top + 48, left : left + 48] = bright
            vergence[item, 0, top : top + 48, left : left + 48] = near
    noise = 1 + 0.02 * torch.randn(planes.shape, generator=generator)
    scene = Scene.builtin(name, (height, width))
    depth = 1 / near if flat else 1 / vergence
    scene = replace(scene, coefficients=(planes * noise).clamp(min=0), depth=depth)
    where = f"at {1 / near:.2g} m" if flat else f"{1 / near:.2g} to {1 / far:.2g} m"
    return scene, f"{kind} on {name} {batch} x {height} x {width}, {where}"
