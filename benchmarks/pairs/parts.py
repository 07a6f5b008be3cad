"""What pairs of every kind are put together from."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import torch
from torch import Tensor

from kcam import Camera, Scene, isp, optics, sensor
from kcam.planner import Planner
from kcam.units import mm

LONGEST = 10.0  # seconds, predicted, of a reference picture
UNKIND = 3.0  # seconds, predicted, of a reference picture of the unkind ones: adversarial, assorted, strange


def first_within(
    longest: float, seed: str, draw_pair: Callable[[random.Random], tuple[Camera, Scene, str]]
) -> tuple[Camera, Scene, str, int]:
    """The first pair whose reference takes so long at most, predicted [s], and how many were drawn before."""
    for attempt in range(100):
        camera, scene, text = draw_pair(random.Random(f"{seed}/{attempt}"))
        if Planner(camera, scene, one=True).prices.of({})[0] <= longest:
            return camera, scene, text, attempt
    raise RuntimeError(f"seed {seed}: no pair within {longest:g} s in 100 draws.")


def bare_lens(diameter: float, *, ideal: bool) -> list[optics.Element]:
    """50 mm, ideal or of glass."""
    glass = optics.ThinLens(50 * mm) if ideal else optics.PlanoConvexLens(25.8 * mm, glass="N-BK7")
    return [optics.CircularAperture(diameter), glass]


def smooth_map(draw: random.Random, waves: float, generator: torch.Generator) -> Tensor:
    """A phase of few periods across, in 64 to 200 pixels [rad]."""
    side = draw.choice([64, 128, 200])
    return 2 * math.pi * waves * smooth_field((side, side), scale=draw.choice([3, 5]), generator=generator)


def random_sensor(draw: random.Random) -> tuple[list[torch.nn.Module], str]:
    """Three sensors: Bayer with noise, a dark one with a small well, and the thesis's learned tile."""
    name = draw.choice(["bayer", "small well", "tile"])
    if name == "tile":
        tile = sensor.ColourFilter.learned(tile=draw.choice([4, 28]))
        return [tile, sensor.Exposure(), isp.Clip(), isp.LearnedDemosaic(), isp.ToneCurve()], name
    bayer = [sensor.ColourFilter.kodak() if name == "bayer" else sensor.ColourFilter.nikon()]
    pattern = draw.choice(["RGGB", "GBRG", "BGGR", "GRBG"])
    well, bits, iso = (10_000, 12, None) if name == "bayer" else (2_000, 8, 800)
    return [
        *bayer,
        sensor.Mosaic(pattern),
        sensor.Exposure(iso=iso),
        sensor.ShotNoise(full_well=well),
        sensor.ReadNoise(3.0),
        sensor.ADC(bits=bits),
        isp.Demosaic(),
        isp.ToneCurve(),
    ], name


def random_distance(draw: random.Random) -> float:
    """Even in vergence, 0.3 m to infinity, which comes up by itself now and then."""
    return math.inf if draw.random() < 0.1 else 1 / draw.uniform(0.001, 1 / 0.3)


def random_crop(scene: Scene, height: int, width: int, draw: random.Random) -> Scene:
    """A window of a scene."""
    _, h, w = scene.shape
    height, width = min(height, h), min(width, w)
    return scene.crop(top=draw.randint(0, h - height), left=draw.randint(0, w - width), height=height, width=width)


def smooth_field(shape: tuple[int, int], *, scale: float | None, generator: torch.Generator) -> Tensor:
    """A random field in 0..1: of 1/f amplitude, or of a few periods (scale) across."""
    fy, fx = torch.fft.fftfreq(shape[0])[:, None], torch.fft.rfftfreq(shape[1])
    radius = torch.hypot(fy * shape[0], fx * shape[1])
    weight = 1 / radius.clamp(min=1) if scale is None else torch.exp(-((radius / scale) ** 2))
    noise = torch.randn(*shape, generator=generator, dtype=torch.float64)
    field = torch.fft.irfft2(torch.fft.rfft2(noise) * weight, s=shape)
    low, high = field.aminmax()
    return (field - low) / (high - low)
