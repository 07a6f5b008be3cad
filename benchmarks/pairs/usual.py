"""Random pairs: what users have."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import torch

from benchmarks.pairs.parts import (
    LONGEST,
    bare_lens,
    first_within,
    random_crop,
    random_distance,
    random_sensor,
    smooth_field,
    smooth_map,
)
from kcam import Camera, Scene, optics
from kcam.units import mm, um, wavelength_grid

SIDES = (48, 64, 96, 128, 160, 192)


def random_pair(seed: int, *, longest: float = LONGEST) -> tuple[Camera, Scene, str, int]:
    """A camera, a scene, what they are, and how many pairs were drawn before because they would have taken too long."""

    def draw_pair(draw: random.Random) -> tuple[Camera, Scene, str]:
        camera, lens = random_camera(draw)
        scene, light = random_scene(draw)
        return camera, scene, f"{lens}; {light}"

    return first_within(longest, f"{seed}", draw_pair)


def random_camera(draw: random.Random) -> tuple[Camera, str]:
    """Aperture 1 to 10 mm, 50 mm focal length, focus 0.3 m to infinity, no DOE or one of up to 30 waves; a sensor."""
    diameter = 10 ** draw.uniform(0, 1) * mm
    focus = random_distance(draw)
    elements = bare_lens(diameter, ideal=(ideal := draw.random() < 0.3))
    kind, waves = draw.choice(["none", "none", "zernike", "smooth map", "wrapped map"]), draw.uniform(0, 30)
    generator = torch.Generator().manual_seed(draw.randrange(2**31))
    if kind == "zernike":
        coefficients = torch.randn(9, generator=generator, dtype=torch.float64)
        coefficients[:3] = 0
        elements.append(optics.ZernikeDOE(coefficients * waves / (2 * coefficients.abs().sum())))
    elif kind != "none":
        phase = smooth_map(draw, waves, generator)
        elements.append(optics.DOE(torch.remainder(phase, 2 * math.pi) if kind == "wrapped map" else phase))
    lens = optics.Lens(*elements, focus_distance=focus)
    pitch = draw.choice([3, 4, 6]) * um
    imaging = optics.Imaging(lens, pixel_pitch=pitch, border=draw.choice(["reflect", "reflect", "replicate", "zero"]))
    stages, name = random_sensor(draw)
    text = f"{diameter / mm:.2g} mm, focus {focus:.2g} m, {'ideal' if ideal else 'BK7'}"
    text += "" if kind == "none" else f", {kind} of {waves:.2g} waves"
    return Camera(imaging, *stages), f"{text}, {pitch / um:g} um, {name}"


def random_scene(draw: random.Random) -> tuple[Scene, str]:
    """Photographs, crops, 1/f noise, points, the chart, the motorcycle; on a plane, a ramp, a step or its own depth."""
    height, width = draw.choice(SIDES), draw.choice(SIDES)
    kind = draw.choice(["photograph", "crop", "1/f", "points", "chart", "motorcycle"])
    generator = torch.Generator().manual_seed(draw.randrange(2**31))
    if kind in ("photograph", "crop"):
        name = draw.choice(["astronaut", "coffee", "chelsea"])
        scene = Scene.builtin(name, (height, width))
        if kind == "crop":
            scene = random_crop(Scene.builtin(name, 384), height, width, draw)
    elif kind == "motorcycle":
        scene = random_crop(Scene.builtin("motorcycle", 400), height, width, draw)
    elif kind == "1/f":
        field = torch.stack([smooth_field((height, width), scale=None, generator=generator) for _ in range(3)])
        scene = Scene.from_rgb(field.clamp(0, 1).float(), depth=2.0)
        if draw.random() < 0.3:  # a full-rank cube
            tint = 1 + 0.2 * torch.rand(28, 1, 1, generator=generator)
            scene = Scene.from_bands(scene.bands().clamp(min=0) * tint, wavelengths=wavelength_grid(), depth=2.0)
    elif kind == "points":
        scene = Scene.builtin("point_grid", (height, width))
    else:
        scene = Scene.builtin("colour_chart", (height, width))
    where = draw.choice(["plane", "plane", "ramp", "step"])
    if kind == "motorcycle" and draw.random() < 0.6:
        return scene, f"{kind} {height} x {width}, its own depth"
    near, far = sorted([random_distance(draw), random_distance(draw)])
    if where == "plane":
        return scene.with_depth(near), f"{kind} {height} x {width}, {near:.2g} m"
    share = torch.linspace(0, 1, width, dtype=torch.float64)
    if where == "step":
        share = (share > draw.uniform(0.2, 0.8)).double()
    vergence = (1 / near) * (1 - share) + (1 / far) * share
    depth = (1 / vergence).expand(1, 1, height, width)
    return replace(scene, depth=depth), f"{kind} {height} x {width}, {where} {near:.2g} to {far:.2g} m"
