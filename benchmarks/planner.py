"""Whether plans keep their word: random pairs of camera and scene, planned at five tolerances and measured.

    python -m benchmarks.planner [--pairs 300] [--start 0] [--out benchmarks/results/planner.json]

It goes on where it stopped: pairs that are in the file of partial results are not measured again. Each pair follows
from its seed alone. A pair whose reference would take more than a minute is drawn again, and counted.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import statistics
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kcam import Camera, Scene, isp, measure, optics, sensor
from kcam.planner import Planner, relative_rms, timed
from kcam.units import mm, um, wavelength_grid

TOLERANCES = (0.1, 0.03, 0.01, 0.003, 0.001)
LONGEST = 60.0  # seconds, predicted, of a reference picture
SLOW = 5.0  # seconds of a reference picture above which one of each must do
SIDES = (48, 64, 96, 128, 160, 192)
RESULTS = Path(__file__).parent / "results" / "planner.json"


# ---- random pairs --------------------------------------------------------------------------------------------------


def random_pair(seed: int) -> tuple[Camera, Scene, str, int]:
    """A camera, a scene, what they are, and how many pairs were drawn before because they would have taken too long."""
    for attempt in range(100):
        draw = random.Random(f"{seed}/{attempt}")
        camera, lens = random_camera(draw)
        scene, light = random_scene(draw)
        if Planner(camera, scene).prices.of({})[0] <= LONGEST:
            return camera, scene, f"{lens}; {light}", attempt
    raise RuntimeError(f"seed {seed}: no pair within {LONGEST:g} s in 100 draws.")


def random_camera(draw: random.Random) -> tuple[Camera, str]:
    """Aperture 1 to 10 mm, 50 mm focal length, focus 0.3 m to infinity, no DOE or one of up to 30 waves; a sensor."""
    diameter = 10 ** draw.uniform(0, 1) * mm
    focus = random_distance(draw)
    elements: list[optics.Element] = [optics.CircularAperture(diameter)]
    ideal = draw.random() < 0.3
    elements.append(optics.ThinLens(50 * mm) if ideal else optics.PlanoConvexLens(25.8 * mm, glass="N-BK7"))
    kind, waves = draw.choice(["none", "none", "zernike", "smooth map", "wrapped map"]), draw.uniform(0, 30)
    generator = torch.Generator().manual_seed(draw.randrange(2**31))
    if kind == "zernike":
        coefficients = torch.randn(9, generator=generator, dtype=torch.float64)
        coefficients[:3] = 0
        elements.append(optics.ZernikeDOE(coefficients * waves / (2 * coefficients.abs().sum())))
    elif kind != "none":
        side = draw.choice([64, 128, 200])
        phase = smooth_field((side, side), scale=draw.choice([3, 5]), generator=generator)
        phase = 2 * math.pi * waves * phase
        elements.append(optics.DOE(torch.remainder(phase, 2 * math.pi) if kind == "wrapped map" else phase))
    lens = optics.Lens(*elements, focus_distance=focus)
    pitch = draw.choice([3, 4, 6]) * um
    imaging = optics.Imaging(lens, pixel_pitch=pitch, border=draw.choice(["reflect", "reflect", "replicate", "zero"]))
    stages, name = random_sensor(draw)
    text = f"{diameter / mm:.2g} mm, focus {focus:.2g} m, {'ideal' if ideal else 'BK7'}"
    text += "" if kind == "none" else f", {kind} of {waves:.2g} waves"
    return Camera(imaging, *stages), f"{text}, {pitch / um:g} um, {name}"


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


# ---- the measurement -----------------------------------------------------------------------------------------------


def measure_pair(seed: int, *, tolerances: tuple[float, ...] = TOLERANCES, rounds: int = 3) -> dict[str, Any]:
    """One pair: for each tolerance the estimate, the truth, and the times of the raw, by turns with the reference's."""
    camera, scene, text, again = random_pair(seed)
    with torch.no_grad():
        planner = Planner(camera, scene)
        plans = [planner.plan(tolerance) for tolerance in tolerances]
        reference, truth = timed(camera, scene)
        shots: list[list[tuple[float, Tensor]]] = [[] for _ in plans]
        references = [reference]
        for turn in range(rounds if reference < SLOW else 1):
            for shot, plan in zip(shots, plans, strict=True):
                shot.append(timed(plan.apply(camera), scene))
            if turn:
                references.append(timed(camera, scene)[0])
    rows = []
    for tolerance, plan, shot in zip(tolerances, plans, shots, strict=True):
        rows.append(
            {
                "tolerance": tolerance,
                "bound": plan.bound,
                "expected": plan.expected,
                "error": relative_rms(shot[0][1], truth),
                "seconds": statistics.median(seconds for seconds, _ in shot),
                "reference_seconds": statistics.median(references),
                "predicted_seconds": plan.seconds,
                "predicted_reference_seconds": plan.reference_seconds,
                "planning_seconds": plan.planning_seconds,
                "changes": plan.changes,
            }
        )
    return {"seed": seed, "pair": text, "drawn_again": again, "tolerances": rows}


def summary(pairs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """For each tolerance: how many are inside, how good the estimates are, and how much faster the plans."""
    rows = []
    for index, tolerance in enumerate(TOLERANCES):
        found = [pair["tolerances"][index] for pair in pairs]
        ratios = [row["expected"] / row["error"] for row in found if row["error"] > 0 and row["expected"] > 0]
        gains = sorted(row["reference_seconds"] / row["seconds"] for row in found)
        predicted = [row["predicted_seconds"] / row["seconds"] for row in found]
        rows.append(
            {
                "tolerance": tolerance,
                "pairs": len(found),
                "inside": sum(row["error"] <= tolerance for row in found),
                "worst": max(row["error"] / tolerance for row in found),
                "estimate_over_truth": statistics.median(ratios) if ratios else None,
                "speed_up": statistics.median(gains),
                "speed_up_quartiles": [gains[len(gains) // 4], gains[3 * len(gains) // 4]],
                "speed_up_least": gains[0],
                "predicted_over_measured": statistics.median(predicted),
                "planning_share": statistics.median(
                    row["planning_seconds"] / row["reference_seconds"] for row in found
                ),
            }
        )
    return rows


def main() -> None:
    """Measure what is missing, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=300)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    partial = arguments.out.with_suffix(".partial.jsonl")
    known = [json.loads(line) for line in partial.read_text().splitlines()] if partial.exists() else []
    done = {pair["seed"]: pair for pair in known}
    seeds = range(arguments.start, arguments.start + arguments.pairs)
    for seed in seeds:
        if seed not in done:
            done[seed] = measure_pair(seed)
            with partial.open("a") as file:
                file.write(json.dumps(done[seed]) + "\n")
            worst = max(row["error"] / row["tolerance"] for row in done[seed]["tolerances"])
            third = done[seed]["tolerances"][2]
            gain = third["reference_seconds"] / third["seconds"]
            text = f"worst {worst:.2f} of the tolerance; {gain:.1f} times as fast at 0.01"
            print(f"{seed}: {done[seed]['pair']}: {text}", flush=True)
    pairs = [done[seed] for seed in seeds]
    failures = [
        {"seed": pair["seed"], "pair": pair["pair"], **row}
        for pair in pairs
        for row in pair["tolerances"]
        if row["error"] > row["tolerance"]
    ]
    again = sum(pair["drawn_again"] for pair in pairs)
    content = {
        "environment": measure.environment(),
        "summary": summary(pairs),
        "drawn_again": again,
        "failures": failures,
        "pairs": pairs,
    }
    measure.write_json(arguments.out, content)
    for row in content["summary"]:
        print(row)
    print(f"{len(failures)} failures, {again} pairs drawn again")


if __name__ == "__main__":
    main()
