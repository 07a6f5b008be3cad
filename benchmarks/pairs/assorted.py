"""Assorted pairs: through every aperture and with every option."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from benchmarks.pairs.parts import UNKIND, first_within, smooth_field
from kcam import Camera, Scene, optics, sensor
from kcam.units import mm, nm, um

ASSORTED_SIDES = (40, 64, 120, 200)
BANDS = ((400, 700), (420, 720), (530, 570), (380, 780), (650, 950))  # [nm]


def assorted_pair(seed: int, *, sides: tuple[int, ...] = ASSORTED_SIDES) -> tuple[Camera, Scene, str, int]:
    """As `random_pair`, of what is seldom put together: apertures of every shape up to f/1.9, rings and maps, 3 to 45
    wavelengths from 380 to 950 nm, every border and option of `Imaging`, cubes of noise, lines and single pixels.
    """

    def draw_pair(draw: random.Random) -> tuple[Camera, Scene, str]:
        generator = torch.Generator().manual_seed(draw.randrange(2**31))
        low, high = draw.choice(BANDS)
        wavelengths = torch.linspace(low, high, draw.choice([3, 5, 9, 16, 28, 31, 45]), dtype=torch.float64) * nm
        lens, optic = assorted_lens(draw, wavelengths, generator)
        imaging, how = assorted_imaging(draw, lens)
        stages, name = assorted_sensor(draw, wavelengths)
        scene, light = assorted_scene(draw, wavelengths, sides, generator)
        return Camera(imaging, *stages), scene, f"{optic}, {how}, {name}; {light} of {low} to {high} nm"

    return first_within(UNKIND, f"assorted/{seed}", draw_pair)


def assorted_lens(draw: random.Random, wavelengths: Tensor, generator: torch.Generator) -> tuple[optics.Lens, str]:
    """Of 8 to 85 mm, f/1.9 or slower, behind any aperture and element."""
    focal = draw.choice([8, 16, 25, 50, 85]) * mm
    diameter = min(10 ** draw.uniform(0.2, 1.0) * mm, focal / 1.9)
    opening = draw.choice(["circle", "circle", "annulus", "square", "code"])
    if opening == "code":
        aperture: optics.Aperture = optics.ApertureMap(
            (torch.rand(9, 9, generator=generator) > 0.4).float(), width=diameter
        )
    elif opening == "annulus":
        aperture = optics.AnnularAperture(diameter, obscuration=draw.uniform(0.2, 0.8))
    else:
        aperture = {"circle": optics.CircularAperture, "square": optics.SquareAperture}[opening](diameter)
    glass = draw.choice(["none", "none", "N-BK7", "N-SF11"])
    thin = optics.ThinLens(focal) if glass == "none" else optics.PlanoConvexLens(focal * 0.5168, glass=glass)
    more, waves = draw.choice(["bare", "bare", "zernike", "rings", "map", "zone plate"]), 10 ** draw.uniform(-0.5, 1.2)
    parts: list[optics.Element] = [aperture, thin]
    if more == "zernike":
        coefficients = torch.randn(12, generator=generator, dtype=torch.float64)
        coefficients[0] = 0
        parts.append(optics.ZernikeDOE(coefficients * waves / (2 * coefficients.abs().sum())))
    elif more == "rings":
        steps = torch.rand(draw.choice([8, 30, 100]), generator=generator, dtype=torch.float64)
        parts.append(optics.RadialDOE(2 * math.pi * waves * steps))
    elif more == "zone plate":
        profile = 2 * math.pi * waves * torch.linspace(0, 1, draw.choice([64, 256]), dtype=torch.float64) ** 2
        design = float(wavelengths.mean())
        parts.append(optics.RadialDOE(torch.remainder(profile, 2 * math.pi), design_wavelength=design))
    elif more == "map":
        side = draw.choice([16, 64, 150])
        phase = 2 * math.pi * waves * smooth_field((side, side), scale=draw.choice([2, 6]), generator=generator)
        parts.append(optics.DOE(torch.remainder(phase, 2 * math.pi) if draw.random() < 0.5 else phase))
    focus = 1 / draw.uniform(0.05, 3)
    text = f"{opening} of {diameter / mm:.2g} mm, {focal / mm:.0f} mm of {'no glass' if glass == 'none' else glass}"
    text += "" if more == "bare" else f", {more} of {waves:.2g} waves"
    return optics.Lens(*parts, focus_distance=focus), f"{text}, focus {focus:.2g} m"


def assorted_imaging(draw: random.Random, lens: optics.Lens) -> tuple[optics.Imaging, str]:
    """Any border, and some of the options."""
    choices: dict[str, tuple[float, tuple[Any, ...]]] = {
        "fill_factor": (0.2, (0.5,)),
        "integrate": (0.1, (False,)),
        "propagator": (0.1, ("fresnel",)),
        "coverage": (0.15, ("band",)),
        "interpolate": (0.15, (False,)),
        "bands": (0.15, (4, 9)),
        "psf_shape": (0.15, ((33, 33), (65, 41))),
    }
    options = {name: draw.choice(values) for name, (share, values) in choices.items() if draw.random() < share}
    pitch = draw.choice([1.5, 3, 5, 9])
    border = draw.choice(["reflect", "reflect", "replicate", "zero", "periodic"])
    text = ", ".join([f"{pitch:g} um", border, *(f"{name} {value}" for name, value in options.items())])
    return optics.Imaging(lens, pixel_pitch=pitch * um, border=border, **options), text


def assorted_sensor(draw: random.Random, wavelengths: Tensor) -> tuple[list[torch.nn.Module], str]:
    """None, a filter, a mosaic or a noisy sensor; of one or three curves that follow the wavelengths."""
    kind = draw.choice(["bare", "three filters", "mosaic", "grey", "sensor", "sensor"])
    if kind == "bare":
        return [], kind
    place, at = torch.linspace(0, 1, 61), torch.linspace(0, 1, 61, dtype=torch.float64)
    curves = [
        torch.exp(-(((place - draw.uniform(0.1, 0.9)) / draw.uniform(0.05, 0.4)) ** 2))
        for _ in range(1 if kind == "grey" else 3)
    ]
    low, high = wavelengths.aminmax()
    stages: list[torch.nn.Module] = [sensor.ColourFilter.from_curves(low + (high - low) * at, torch.stack(curves))]
    if kind in ("mosaic", "sensor"):
        stages.append(sensor.Mosaic(draw.choice(["RGGB", "BGGR"])))
    if kind != "three filters":
        stages.append(sensor.Exposure())
    if kind == "sensor":
        well, bits = draw.choice([1000, 20_000]), draw.choice([8, 12])
        stages += [sensor.ShotNoise(full_well=well), sensor.ReadNoise(2.0), sensor.ADC(bits=bits)]
    return stages, kind


def assorted_scene(
    draw: random.Random, wavelengths: Tensor, sides: Sequence[int], generator: torch.Generator
) -> tuple[Scene, str]:
    """One to four patterns of a spectrum each, from even noise to one bright pixel, at any distances."""
    height, width, batch = draw.choice(sides), draw.choice(sides), draw.choice([1, 1, 1, 2, 4])
    rows, columns = torch.arange(float(height))[:, None], torch.arange(float(width))[None, :]
    even = torch.ones(height, width)

    def stripes() -> Tensor:
        angle = draw.uniform(0, math.pi)
        place = columns * math.cos(angle) + rows * math.sin(angle)
        return ((place * (2 * math.pi / draw.uniform(2, 30))).sin() > 0).float()

    def checker() -> Tensor:
        side = draw.choice([1, 3, 10])
        return (columns // side + rows // side) % 2

    def lamp() -> Tensor:
        far2 = (columns - draw.uniform(0, width)) ** 2 + (rows - draw.uniform(0, height)) ** 2
        dim = 0.05 * torch.rand(height, width, generator=generator)
        return dim + 10 ** draw.uniform(0, 4) * (far2 < draw.uniform(0.5, 40)).float()

    def one_pixel() -> Tensor:
        return ((columns == draw.randrange(width)) & (rows == draw.randrange(height))).float()

    patterns: dict[str, Callable[[], Tensor]] = {
        "stripes": stripes,
        "checker": checker,
        "spots": lambda: (torch.rand(height, width, generator=generator) > 0.98).float(),
        "lamp": lamp,
        "smooth": lambda: smooth_field((height, width), scale=4, generator=generator).float(),
        "noise": lambda: torch.rand(height, width, generator=generator),
        "edge": lambda: (columns > draw.uniform(0.2, 0.8) * width) * even + 0.02,
        "one pixel": one_pixel,
        "1/f": lambda: smooth_field((height, width), scale=None, generator=generator).float(),
        "half dark": lambda: torch.rand(height, width, generator=generator) * torch.where(rows > height / 2, 1.0, 1e-4),
    }
    kind, lines = draw.choice(sorted(patterns)), draw.random() < 0.15
    place = torch.linspace(0, 1, len(wavelengths))

    def spectrum() -> Tensor:
        if lines:
            return torch.nn.functional.one_hot(torch.tensor(draw.randrange(len(wavelengths))), len(wavelengths)).float()
        return torch.exp(-(((place - draw.random()) / draw.uniform(0.05, 0.6)) ** 2))

    items = []
    for item in range(batch):
        parts = [spectrum()[:, None, None] * patterns[kind]() for _ in range(draw.choice([1, 2, 4]))]
        items.append(sum(parts[1:], parts[0]) * 10 ** draw.uniform(-1, 1) * (draw.choice([1, 1, 1e-3]) if item else 1))
    depth, where = assorted_depth(draw, batch, height, width, generator)
    scene = Scene.from_bands(torch.stack(items), wavelengths=wavelengths, depth=depth)
    scene = scene.low_rank(min(3, len(wavelengths))) if draw.random() < 0.3 else scene
    text = f"{'lines of ' if lines else ''}{kind} {batch} x {height} x {width}, {where}, {len(wavelengths)} bands"
    return scene, text


def assorted_depth(
    draw: random.Random, batch: int, height: int, width: int, generator: torch.Generator
) -> tuple[float | Tensor, str]:
    """A number, one for each item, or a map: a ramp, steps, blobs, or a noisy one."""
    kind = draw.choice(["plane", "plane", "ramp", "steps", "blobs", "noisy", "each its own"])
    first, second = draw.uniform(0.02, 3), draw.uniform(0.02, 3)  # vergences
    if kind == "plane":
        return 1 / first, f"at {1 / first:.2g} m"
    if kind == "each its own":
        return torch.tensor([1 / draw.uniform(0.02, 3) for _ in range(batch)], dtype=torch.float64), kind
    if kind == "ramp":
        share = torch.linspace(0, 1, height, dtype=torch.float64)[:, None].expand(height, width)
    elif kind == "steps":
        share = (torch.linspace(0, 1, width, dtype=torch.float64) * 3.99).floor().expand(height, width) / 3
    elif kind == "blobs":
        share = (smooth_field((height, width), scale=5, generator=generator) > 0.5).double()
    else:
        noise = torch.randn(height, width, generator=generator, dtype=torch.float64)
        share = (smooth_field((height, width), scale=3, generator=generator) + 0.05 * noise).clamp(0, 1)
    depth = 1 / (first + (second - first) * share)
    return depth.expand(batch, 1, height, width), f"{kind} {1 / first:.2g} to {1 / second:.2g} m"
