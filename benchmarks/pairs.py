"""Pairs of camera and scene drawn at random, on which plans are tried: each follows from its seed alone.

Random ones are what users have; hard ones what a plan could overlook, `hard_pair`; adversarial ones are through other
optics, `adversarial_pair`; assorted ones through every aperture and with every option, `assorted_pair`. Into all of
them effects of light and sensor may be drawn, `with_effects`. A pair whose reference would take too long is drawn
again, and counted.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from kcam import Camera, Scene, isp, optics, sensor
from kcam.optics.compound.presets import PRESETS
from kcam.planner import Planner
from kcam.units import mm, nm, um, wavelength_grid

LONGEST = 10.0  # seconds, predicted, of a reference picture
SIDES = (48, 64, 96, 128, 160, 192)


# ---- random pairs --------------------------------------------------------------------------------------------------


def random_pair(seed: int, *, longest: float = LONGEST) -> tuple[Camera, Scene, str, int]:
    """A camera, a scene, what they are, and how many pairs were drawn before because they would have taken too long."""

    def draw_pair(draw: random.Random) -> tuple[Camera, Scene, str]:
        camera, lens = random_camera(draw)
        scene, light = random_scene(draw)
        return camera, scene, f"{lens}; {light}"

    return first_within(longest, f"{seed}", draw_pair)


def first_within(
    longest: float, seed: str, draw_pair: Callable[[random.Random], tuple[Camera, Scene, str]]
) -> tuple[Camera, Scene, str, int]:
    """The first pair whose reference takes so long at most, predicted [s], and how many were drawn before."""
    for attempt in range(100):
        camera, scene, text = draw_pair(random.Random(f"{seed}/{attempt}"))
        if Planner(camera, scene, one=True).prices.of({})[0] <= longest:
            return camera, scene, text, attempt
    raise RuntimeError(f"seed {seed}: no pair within {longest:g} s in 100 draws.")


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


# ---- hard pairs ----------------------------------------------------------------------------------------------------

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


# ---- adversarial pairs ---------------------------------------------------------------------------------------------

UNKIND = 3.0  # seconds, predicted, of a reference picture of these


def adversarial_pair(seed: int, *, sides: tuple[int, ...] = HARD_SIDES) -> tuple[Camera, Scene, str, int]:
    """As `hard_pair`, through what no estimate was made for: wrapped and noisy maps of pixels, rings with noise, real
    lenses over the field, measured PSFs; in narrow-band light now and then.
    """

    def draw_pair(draw: random.Random) -> tuple[Camera, Scene, str]:
        optic, name = adversarial_optics(draw)
        varies = isinstance(optic, optics.CompoundLens)
        scene, light = hard_scene(draw, [side for side in sides if side <= 192] if varies else sides)
        if varies:  # out of focus as no photographer would have it, their PSFs take minutes
            vergence = 1 / torch.as_tensor(scene.depth, dtype=torch.float64)
            scene = replace(scene, depth=1 / (1 / optic.focus_distance + 0.1 * (vergence - vergence.mean()) + 0.005))
        if draw.random() < 0.35:
            centre, width = draw.uniform(430, 710) * 1e-9, draw.uniform(3, 25) * 1e-9
            line = 0.01 + torch.exp(-(((scene.wavelengths - centre) / width) ** 2)).float()
            scene = replace(scene, spectra=None if scene.spectra is None else scene.spectra * line)
            light += f", {centre * 1e9:.0f} nm"
        border = draw.choice(["reflect", "reflect", "replicate", "zero"])
        stages, other = random_sensor(draw)
        camera = Camera(optics.Imaging(optic, pixel_pitch=draw.choice([3, 4, 6]) * um, border=border), *stages)
        return camera, scene, f"{name}, {other}; {light}"

    return first_within(UNKIND, f"adversarial/{seed}", draw_pair)


def adversarial_optics(draw: random.Random) -> tuple[optics.Lens | optics.CompoundLens | optics.MeasuredPSF, str]:
    """A lens with a map of pixels or of rings, a real one, or PSFs from elsewhere."""
    kind = draw.choice(["wrapped map", "noisy map", "noisy rings", "real lens", "real lens", "measured PSFs"])
    generator = torch.Generator().manual_seed(draw.randrange(2**31))
    focus, waves = 1 / draw.uniform(0.1, 1.5), draw.uniform(0.2, 12)
    if kind == "real lens":
        preset = draw.choice(sorted(PRESETS))
        return optics.CompoundLens.preset(preset, focus_distance=focus), f"{preset}, focus {focus:.2g} m"
    if kind == "measured PSFs":
        return measured_psfs(draw, generator)
    diameter = draw.uniform(1, 8) * mm
    parts = bare_lens(diameter, ideal=draw.random() < 0.5)
    noise = draw.choice([0.0, 0.1, 1.0])
    if kind == "noisy rings":
        profile = 2 * math.pi * waves * torch.linspace(0, 1, draw.choice([51, 201]), dtype=torch.float64) ** 2
        profile = profile + noise * torch.randn(len(profile), generator=generator, dtype=torch.float64)
        parts.append(optics.RadialDOE(torch.remainder(profile, 2 * math.pi)))
    else:
        phase = smooth_map(draw, waves, generator)
        phase = phase + noise * torch.randn(phase.shape, generator=generator, dtype=torch.float64)
        parts.append(optics.DOE(torch.remainder(phase, 2 * math.pi) if kind == "wrapped map" else phase))
    text = f"{diameter / mm:.2g} mm, focus {focus:.2g} m, {kind} of {waves:.2g} waves and {noise:g} rad of noise"
    return optics.Lens(*parts, focus_distance=focus), text


def measured_psfs(draw: random.Random, generator: torch.Generator) -> tuple[optics.MeasuredPSF, str]:
    """Spots that grow with the distance from focus and move with the wavelength, under noise; at one place or five."""
    side, count, layers = draw.choice([15, 31, 64]), draw.choice([3, 7, 16]), draw.choice([1, 3, 5])
    places = draw.choice([1, 1, 5])
    axis = torch.arange(side, dtype=torch.float64) - side // 2
    radius = 0.7 + side / 8 * torch.rand(places, layers, count, 1, 1, generator=generator, dtype=torch.float64)
    shift = side / 16 * torch.randn(2, places, 1, count, 1, 1, generator=generator, dtype=torch.float64)
    psfs = torch.exp(-((axis - shift[0]) ** 2 + (axis[:, None] - shift[1]) ** 2) / (2 * radius**2))
    psfs = psfs * (1 + 0.1 * torch.randn(psfs.shape, generator=generator, dtype=torch.float64)).clamp(min=0)
    psfs = psfs / psfs.sum((-2, -1), keepdim=True)
    positions = torch.tensor([[0, 0], [-1, -1], [1, -1], [-1, 1], [1, 1]], dtype=torch.float64) * 0.3 * mm
    wavelengths = torch.linspace(415e-9, 725e-9, count, dtype=torch.float64)
    distances = 1 / torch.linspace(0.1, 2.5, layers, dtype=torch.float64)
    found = optics.MeasuredPSF(
        psfs if places > 1 else psfs[0],
        wavelengths=wavelengths,
        distances=distances,
        pixel_pitch=draw.choice([2, 4]) * um,
        positions=positions if places > 1 else None,
    )
    return found, f"measured PSFs of {side} px, {count} wavelengths, {layers} distances, {places} places"


# ---- assorted pairs ------------------------------------------------------------------------------------------------

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


# ---- effects -------------------------------------------------------------------------------------------------------


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
    if isinstance(stage, (optics.VeilingGlare, sensor.Motion, sensor.MicrolensShading)):
        return None if colours is None or tile else colours + 1
    if isinstance(stage, sensor.Crosstalk):
        mosaic = first(sensor.Mosaic)
        return None if mosaic is None else mosaic + 1
    if isinstance(stage, sensor.DefectPixels):
        return first(sensor.ShotNoise, isp.Clip)
    return first(sensor.ADC, isp.Clip)


LATER = (
    ("moved", "exposed a little", "noisy", "mirrored", "alone"),
    ("exposed", "photograph", "colours", "narrow band", "lamp", "contrast", "depth", "noise", "flat"),
)
"""What a camera may see after the scene that was planned for: much like it, or not."""


def later_scene(draw: random.Random, scene: Scene) -> tuple[Scene, str]:
    """Another scene that a camera with a plan for `scene` may meet, one of `LATER`."""
    planes, depth = scene.coefficients.clone(), scene.depth
    batch, count, height, width = planes.shape
    kind = draw.choice(draw.choice(LATER))
    if kind == "moved":
        shift = draw.randint(-8, 8), draw.randint(-8, 8)
        planes = planes.roll(shift, (-2, -1))
        depth = depth.roll(shift, (-2, -1)) if isinstance(depth, Tensor) else depth
    elif kind == "exposed a little":
        planes *= draw.uniform(0.95, 1.05)
    elif kind == "noisy":
        planes *= 1 + 0.01 * torch.randn(planes.shape, generator=torch.Generator().manual_seed(draw.randrange(2**31)))
        planes = planes.clamp(min=0)
    elif kind == "mirrored":
        planes, depth = planes.flip(-1), depth.flip(-1) if isinstance(depth, Tensor) else depth
    elif kind == "alone":
        item = draw.randrange(batch)
        planes, depth = planes[item : item + 1], depth[item : item + 1] if isinstance(depth, Tensor) else depth
    elif kind == "exposed":
        planes *= 10 ** draw.uniform(-2, 1.5)
    elif kind == "photograph" and count == 3:
        name = draw.choice(["astronaut", "coffee", "chelsea", "motorcycle", "star", "point_grid"])
        other = Scene.from_rgb(Scene.builtin(name, (height, width)).to_srgb(), depth=2.0).coefficients
        planes = (other * 10 ** draw.uniform(-1, 0.3)).expand(batch, -1, -1, -1)
    elif kind == "colours":
        planes = (
            planes[:, draw.sample(range(count), count)]
            * torch.tensor([[[[draw.random()]], [[draw.random()]], [[draw.random()]]]])
            if count == 3
            else planes.flip(1)
        )
    elif kind == "narrow band" and scene.spectra is not None:
        line = torch.zeros(len(scene.wavelengths))
        line[draw.randrange(len(line))] = draw.uniform(1, 8)
        spectra = scene.spectra.mean(0) * 0.02 + line
        return Scene(
            planes.mean(1, keepdim=True), spectra[None], scene.wavelengths, depth, scene.illuminant, scene.luminance
        ), kind
    elif kind == "lamp":
        radius, row, column = draw.uniform(0.5, 6), draw.randrange(height), draw.randrange(width)
        rows, columns = torch.arange(float(height))[:, None], torch.arange(float(width))[None, :]
        place = torch.hypot(rows - row, columns - column) <= radius
        planes = torch.where(place, planes + 10 ** draw.uniform(0, 3), planes)
    elif kind == "contrast":
        planes = planes ** draw.uniform(0.3, 4)
    elif kind == "depth" and isinstance(depth, Tensor):
        low, high = (1 / depth).aminmax()
        share = torch.linspace(0, 1, height, dtype=torch.float64)[:, None].expand(batch, 1, height, width)
        depth = 1 / (low + (high - low) * (share if draw.random() < 0.5 else (share > draw.random()).double()))
    elif kind == "noise":
        planes = torch.rand(planes.shape, generator=torch.Generator().manual_seed(draw.randrange(2**31)))
    elif kind == "flat":
        planes = planes.mean((-2, -1), keepdim=True).expand_as(planes).contiguous()
    return replace(scene, coefficients=planes, depth=depth), kind


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
