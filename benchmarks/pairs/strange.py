"""Strange pairs: everything of everything, as a reader with a generator of their own put it together."""

from __future__ import annotations

import math
import random
from typing import Any

import torch
from torch import Tensor

from benchmarks.pairs.parts import UNKIND, first_within
from kcam import Camera, Scene, optics, sensor
from kcam.units import mm, nm, um

STRANGE_SIDES = (16, 17, 24, 31, 40, 57, 64, 80, 96, 128, 160)


def strange_pair(seed: int, *, sides: tuple[int, ...] = STRANGE_SIDES) -> tuple[Camera, Scene, str, int]:
    """As `random_pair`, of parts that know nothing of each other: pictures of 16 to 160 px through blur of none of
    them or all, every aperture and element at f/1.8 to f/40, pixels with gaps or that are points, bands with a texture
    of their own each.
    """

    def draw_pair(draw: random.Random) -> tuple[Camera, Scene, str]:
        generator = torch.Generator().manual_seed(draw.randrange(2**31))
        lens, optic = strange_lens(draw, generator)
        scene, light = strange_scene(draw, sides, generator)
        imaging, how = strange_imaging(draw, lens)
        stages, name = strange_sensor(draw, generator)
        return Camera(imaging, *stages), scene, f"{optic}, {how}, {name}; {light}"

    return first_within(UNKIND, f"strange/{seed}", draw_pair)


def strange_lens(draw: random.Random, generator: torch.Generator) -> tuple[optics.Lens, str]:
    """A phone's to a telephoto's, behind any aperture and up to two elements of 0.01 to 8 waves."""
    focal, number = draw.choice([4.3, 8, 16, 25, 35, 50, 85]) * mm, 10 ** draw.uniform(0.26, 1.6)
    width = focal / number
    opening = draw.choice(["circle", "circle", "annulus", "square", "grey map", "binary map", "soft map"])
    parts: list[optics.Element] = [strange_aperture(draw, opening, width, generator)]
    radius = 0.5185 * focal  # of a plano-convex lens of N-BK7
    if number < 2.2 or draw.random() < 0.5 or width * math.sqrt(0.5) > 0.95 * radius:
        parts.append(optics.ThinLens(focal))
    else:
        parts.append(optics.PlanoConvexLens(radius, glass=draw.choice(["N-BK7", "N-SF11", 1.5185])))
    text = f"{opening} of {width / mm:.2g} mm, {focal / mm:g} mm"
    for _ in range(draw.choice([0, 0, 1, 1, 2])):
        element, name = strange_element(draw, width, generator)
        parts.append(element)
        text += f", {name}"
    focus = max(strange_distance(draw), 3 * focal)
    return optics.Lens(*parts, focus_distance=focus), f"{text}, focus {focus:.2g} m"


def strange_aperture(draw: random.Random, opening: str, width: float, generator: torch.Generator) -> optics.Aperture:
    if opening == "circle":
        return optics.CircularAperture(width)
    if opening == "annulus":
        return optics.AnnularAperture(width, obscuration=draw.uniform(0.05, 0.9))
    if opening == "square":
        return optics.SquareAperture(width)
    side = draw.choice([3, 7, 16, 33, 64])
    values = torch.rand(side, side, generator=generator)
    if opening == "binary map":
        values = (values > 0.5).float()
        values[side // 2, side // 2] = 1  # never dark
    elif opening == "soft map":
        axis = torch.linspace(-1, 1, side)
        values = torch.exp(-2 * (axis[:, None] ** 2 + axis**2))
    return optics.ApertureMap(values, width=width)


def strange_element(draw: random.Random, width: float, generator: torch.Generator) -> tuple[optics.Element, str]:
    """An aberration or a DOE: polynomials, rings, pixels; noise, steps or a smooth surface, of any pitch."""
    waves = 10 ** draw.uniform(-2, 0.9)
    kind = draw.choice(["aberration", "zernike", "rings", "noise", "noise", "levels", "surface"])
    text = f"{kind} of {waves:.2g} waves"

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    if kind == "aberration":
        return optics.ZernikeAberration(normal(draw.choice([4, 6, 11, 15])) * waves / 4 * 550 * nm), text
    if kind == "zernike":
        design = draw.choice([450, 550, 650]) * nm
        return optics.ZernikeDOE(normal(draw.choice([5, 11])) * waves * 2, design_wavelength=design), text
    if kind == "rings":
        return optics.RadialDOE(normal(draw.choice([4, 9, 40, 120])) * min(waves, 1.5)), text
    side = draw.choice([2, 5, 16, 40, 90])
    phase = normal(side, side) * min(waves, 2)
    if kind == "surface":
        axis = torch.linspace(-1, 1, side, dtype=torch.float64)
        tilt, bend, twist = (2 * math.pi * waves * draw.uniform(-1, 1) for _ in range(3))
        phase = tilt * axis[:, None] ** 2 + bend * axis**3 + twist * axis * axis[:, None]
    levels = draw.choice([2, 4, 8]) if kind == "levels" else None
    pitch = width / side * draw.uniform(0.5, 1.5) if draw.random() < 0.3 else None
    return optics.DOE(phase, levels=levels, pitch=pitch), f"{text}, {side} px"


def strange_distance(draw: random.Random) -> float:
    """Even in vergence, 0.2 to 100 m, and infinity now and then."""
    return math.inf if draw.random() < 0.12 else 1 / draw.uniform(0.01, 5)


def strange_imaging(draw: random.Random, lens: optics.Lens) -> tuple[optics.Imaging, str]:
    """Pixels of any pitch and fill, points at worst; any border, some options."""
    choices: dict[str, tuple[float, tuple[Any, ...]]] = {
        "fill_factor": (0.3, (0.1, 0.5, 0.9)),
        "integrate": (0.15, (False,)),
        "interpolate": (0.1, (False,)),
        "coverage": (0.1, ("band",)),
        "occlusion": (0.07, (False,)),
        "bands": (0.05, (1, 3)),
    }
    options = {name: draw.choice(values) for name, (share, values) in choices.items() if draw.random() < share}
    pitch = draw.choice([1, 1.4, 2.2, 3.45, 5, 8, 12])
    border = draw.choice(["reflect", "replicate", "periodic", "zero"])
    text = ", ".join([f"{pitch:g} um", border, *(f"{name} {value}" for name, value in options.items())])
    return optics.Imaging(lens, pixel_pitch=pitch * um, border=border, **options), text


def strange_sensor(draw: random.Random, generator: torch.Generator) -> tuple[list[torch.nn.Module], str]:
    """None, or any filter behind a glass now and then; exposed for the scene or not; of a small well or a large one."""
    name = draw.choice(["kodak", "nikon", "sigma", "curves", "grey", "tile", "rgbw", "bare"])
    glass = sensor.Transmission(torch.tensor([400, 600, 700], dtype=torch.float64) * nm, torch.tensor([0.3, 1, 0.4]))
    stages: list[torch.nn.Module] = [glass] if draw.random() < 0.15 else []
    if name == "bare":
        return stages, name
    if name in ("kodak", "nikon", "sigma"):
        stages.append(getattr(sensor.ColourFilter, name)(infrared_cut=draw.choice([None, 660 * nm])))
        if draw.random() < 0.8:
            stages.append(sensor.Mosaic(draw.choice(["RGGB", "BGGR", "GRBG", "GBRG"])))
    elif name == "curves":
        nodes, count = draw.choice([2, 4, 9]), draw.choice([2, 3])
        curves = 0.05 + 0.9 * torch.rand(count, nodes, generator=generator)
        stages.append(sensor.ColourFilter.from_curves(torch.linspace(380, 900, nodes) * nm, curves))
    elif name == "grey":
        stages.append(sensor.ColourFilter.from_curves(torch.tensor([380, 1000]) * nm, torch.tensor([[0.5, 0.6]])))
    elif name == "tile":
        stages.append(sensor.ColourFilter.learned(tile=draw.choice([1, 2, 4, 7])))
    else:
        stages += [sensor.ColourFilter.rgbw(), sensor.Mosaic("rgbw")]
    exposure = draw.choice(["metered", "metered", "bright", "dark", "timed"])
    how: dict[str, Any] = {
        "metered": {},
        "bright": {"compensation": draw.choice([4, 30])},
        "dark": {"iso": 1600},
        "timed": {"time": 10 ** draw.uniform(-4, -1)},
    }[exposure]
    stages.append(sensor.Exposure(**how))
    if draw.random() < 0.8:
        stages.append(sensor.ShotNoise(full_well=draw.choice([500, 10_000])))
    if draw.random() < 0.5:
        stages += [sensor.ReadNoise(2.0), sensor.ADC(bits=10)]
    return stages, f"{name} {exposure}"


def strange_scene(draw: random.Random, sides: tuple[int, ...], generator: torch.Generator) -> tuple[Scene, str]:
    """1 to 31 bands or RGB, each of 1/f^p noise of its own; lamps, lines, a hot spot or edges in it."""
    height, width, batch = draw.choice(sides), draw.choice(sides), draw.choice([1, 1, 1, 2, 3])
    if batch > 1:
        height, width = min(height, 64), min(width, 64)
    rgb = draw.random() < 0.5
    kind = draw.choice(["noise", "noise", "noise", "lamps", "lines", "hot spot", "edges"])
    count = 3 if rgb else draw.choice([1, 2, 3, 5, 8, 15, 28, 31])
    low, high = draw.choice([(420, 720), (400, 700), (500, 600), (380, 900)])
    planes = fractal_noise((batch, count, height, width), draw.uniform(0, 2.5), generator).float()
    if kind == "lamps":
        planes *= draw.choice([0, 1e-3, 0.05])
        for _ in range(draw.randint(1, 12)):
            place = draw.randrange(batch), slice(None), draw.randrange(height), draw.randrange(width)
            planes[place] = torch.rand(count, generator=generator) * (1 if rgb else 10 ** draw.uniform(0, 3))
    elif kind == "lines":
        planes[..., :: draw.randint(2, 9)] = 0
    elif kind == "hot spot":
        planes[..., height // 3 : height // 3 + 3, width // 2 : width // 2 + 2] = 1
        planes *= torch.where(torch.rand(batch, 1, 1, 1, generator=generator) > 0.5, 1.0, 0.1)
    elif kind == "edges":
        planes = 0.02 + 0.9 * (planes > 0.5).float()
    depth, where = strange_depth(draw, batch, height, width, generator)
    luminance = 10 ** draw.uniform(0, 4)
    if rgb:
        scene = Scene.from_rgb(planes, depth=depth, luminance=luminance)
    else:
        lone = torch.tensor([draw.uniform(low, high)], dtype=torch.float64)
        wavelengths = (torch.linspace(low, high, count, dtype=torch.float64) if count > 1 else lone) * nm
        scene = Scene.from_bands(planes, wavelengths=wavelengths, depth=depth, luminance=luminance)
    bands = "RGB" if rgb else f"{count} bands of {low} to {high} nm"
    return scene, f"{kind} {batch} x {height} x {width}, {where}, {bands}"


def fractal_noise(shape: tuple[int, int, int, int], power: float, generator: torch.Generator) -> Tensor:
    """In 0..1 for each plane, of a spectrum that falls as frequency^-power."""
    frequencies = torch.hypot(torch.fft.fftfreq(shape[-2])[:, None], torch.fft.rfftfreq(shape[-1]))
    fall = frequencies.clamp(min=1 / max(shape[-2:])) ** -power
    noise = torch.fft.irfft2(torch.fft.rfft2(torch.randn(shape, generator=generator)) * fall, s=shape[-2:])
    low, high = noise.amin((-2, -1), keepdim=True), noise.amax((-2, -1), keepdim=True)
    return (noise - low) / (high - low).clamp(min=1e-9)


def strange_depth(
    draw: random.Random, batch: int, height: int, width: int, generator: torch.Generator
) -> tuple[float | Tensor, str]:
    """A number, one for each item, or a map: a ramp, a step, holes, a smooth one, a block before all."""
    kind = draw.choice(["plane", "plane", "each its own", "ramp", "step", "holes", "smooth", "block"])
    near, far = sorted([strange_distance(draw), strange_distance(draw)])
    if kind == "plane":
        return near, f"at {near:.2g} m"
    if kind == "each its own":
        return torch.tensor([strange_distance(draw) for _ in range(batch)]), kind
    close = torch.zeros(batch, 1, height, width, dtype=torch.float64)  # 1: at `near`
    if kind == "ramp":
        close[:] = torch.linspace(0, 1, width, dtype=torch.float64)
    elif kind == "step":
        close[..., draw.randrange(1, height) :, :] = 1
    elif kind == "holes":
        close[torch.rand(close.shape, generator=generator) < draw.choice([0.02, 0.3])] = 1
    elif kind == "smooth":
        close = fractal_noise((batch, 1, height, width), 2.0, generator).double()
    else:
        close[..., height // 4 : height // 2, width // 4 : width // 2] = 1
    return 1 / ((1 - close) / far + close / near), f"{kind} {near:.2g} to {far:.2g} m"
