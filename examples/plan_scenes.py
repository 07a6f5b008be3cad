"""What a scene calls for: one scene at three tolerances, two scenes with one camera, one sensor in two lights.

    python examples/plan_scenes.py [--out plans/] [--size 240]

Writes tolerances.png, scenes.png and the plans as JSON, and prints the plans.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from kcam import Camera, Plan, Scene, isp, optics, plots, sensor, threads
from kcam.units import mm, um

TOLERANCES = (0.1, 0.03, 0.01)


def camera(*, focus: float = 5.0, time: float | None = None) -> Camera:
    """50 mm f/10, focused at a distance [m]; its exposure automatic, or of a time [s]."""
    lens = optics.Lens(
        optics.CircularAperture(5 * mm), optics.PlanoConvexLens(25.8 * mm, glass="N-BK7"), focus_distance=focus
    )
    return Camera(
        optics.Imaging(lens, pixel_pitch=6 * um),
        sensor.ColourFilter.nikon(),
        sensor.Mosaic("RGGB"),
        sensor.Exposure(time=time),
        sensor.ShotNoise(full_well=10_000),
        sensor.ReadNoise(3.0),
        sensor.ADC(bits=12),
        isp.Demosaic(),
        isp.WhiteBalance(),
        isp.ColourMatrix(),
        isp.ToneCurve(),
    )


def wall(size: int) -> Scene:
    """A flat wall at 5 m: soft shading, no edges."""
    y, x = torch.meshgrid(torch.linspace(0, 1, size), torch.linspace(0, 1, size), indexing="ij")
    shade = 0.55 + 0.2 * torch.sin(5 * x + 2 * y) * torch.cos(4 * y)
    return Scene.from_rgb(torch.stack([shade, 0.95 * shade, 0.85 * shade]), depth=5.0)


def night_street(size: int) -> Scene:
    """A street at night, 2.5 m to infinity: dark houses, lit windows, lamps as points of light."""
    generator = torch.Generator().manual_seed(7)
    picture, depth = torch.full((3, size, size), 0.02), torch.full((1, 1, size, size), 1e4, dtype=torch.float64)
    for side, distance in enumerate((12.0, 8.0, 5.0, 3.5, 2.5)):
        left = int(size * (0.04 + 0.19 * side))
        top = int(size * (0.62 - 0.11 * side))
        part = (slice(top, size), slice(left, left + int(0.17 * size)))
        picture[(slice(None), *part)] = 0.05 + 0.02 * side * torch.tensor([1.0, 0.9, 0.8])[:, None, None]
        depth[(0, 0, *part)] = distance
        for row in range(top + size // 24, size - size // 16, size // 14):
            for column in range(left + size // 40, left + int(0.15 * size), size // 22):
                if torch.rand((), generator=generator) < 0.55:
                    window = (slice(None), slice(row, row + size // 40), slice(column, column + size // 55))
                    picture[window] = torch.tensor([0.9, 0.72, 0.4])[:, None, None]
    scene = Scene.from_rgb(picture, depth=depth)
    lamps = torch.zeros(1, 1, size, size)
    for index in range(9):
        lamps[..., int(size * (0.1 + 0.035 * index)), int(size * (0.06 + 0.105 * index))] = 60.0
    return replace(scene, coefficients=scene.coefficients + lamps)


def shot(shooter: Camera, scene: Scene) -> Tensor:
    """A picture with the same noise each time."""
    return shooter(scene, generator=torch.Generator().manual_seed(0))[0].clamp(0, 1)


def title(plan: Plan) -> str:
    """Tolerance, true error and time of a measured plan."""
    found = plan.measured
    return f"{plan.tolerance:g}: error {found['error']:.4f}, {found['seconds'] * 1e3:.0f} ms"


def main(arguments: list[str] | None = None) -> None:
    """Plan, measure, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("plans"), help="folder")
    parser.add_argument("--size", type=int, default=240)
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    with torch.no_grad(), threads.fixed(1):
        motorcycle, near = Scene.builtin("motorcycle", options.size), camera(focus=2.3)
        plans = [near.explain(motorcycle, tolerance=tolerance, measure=True) for tolerance in TOLERANCES]
        pictures = [shot(plan.apply(near), motorcycle) for plan in plans] + [shot(near, motorcycle)]
        seconds = plans[-1].measured["reference_seconds"]
        figure = plots.contact_sheet(
            [pictures],
            titles=[*(title(plan) for plan in plans), f"everything: {seconds * 1e3:.0f} ms"],
            labels=["tolerance: true error of the noiseless raw, its time on one thread"],
        )
        plots.save_figure(figure, options.out / "tolerances.png")

        optic = camera()
        scenes = {"wall": wall(options.size), "night": night_street(options.size)}
        found = {name: optic.explain(scene, tolerance=0.02, measure=True) for name, scene in scenes.items()}
        rows = [[shot(found[name].apply(optic), scene) for name, scene in scenes.items()]]
        plots.save_figure(
            plots.contact_sheet(rows, titles=["A flat wall at 5 m", "A street at night"], labels=["tolerance 0.02"]),
            options.out / "scenes.png",
        )
        timed = camera(focus=2.3, time=1 / 60)
        for name, luminance in (("bright", 1200.0), ("dim", 10.0)):
            lit = replace(motorcycle, luminance=luminance)
            found[name] = timed.explain(lit, tolerance="sensor", measure=True)
    for name, plan in found.items():
        plan.save(options.out / f"{name}.json")
        print(f"{name}\n\n{plan}\n")
    for name in ("tolerances.png", "scenes.png"):
        print(options.out / name)


if __name__ == "__main__":
    main()
