"""Adversarial pairs: through what no estimate was made for."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import torch

from benchmarks.pairs.hard import HARD_SIDES, hard_scene
from benchmarks.pairs.parts import UNKIND, bare_lens, first_within, random_sensor, smooth_map
from kcam import Camera, Scene, optics
from kcam.optics.compound.presets import PRESETS
from kcam.units import mm, um


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
