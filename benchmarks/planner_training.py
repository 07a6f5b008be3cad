"""Training a DOE through a plan: gradients beside the reference camera's, and the loss after 100 steps beside its time.

    python -m benchmarks.planner_training [--steps 100] [--tolerance 0.1]

The plan is made once, at the start, with gradients on, and frozen. Every 25 steps its true error and that of its
gradient are measured again; it is not made anew. Both trainings start from the same phase and see the same scene.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from torch import Tensor, nn

from kcam import Camera, Scene, files, measure, optics, sensor
from kcam.planner import Plan, noiseless_raw
from kcam.units import mm, um

RESULTS = Path(__file__).parent / "results" / "planner_training.json"
EVERY = 25


def doe_camera(side: int = 128) -> Camera:
    """A singlet out of focus, whose DOE learns to bring a plane at 1 m into focus."""
    phase = nn.Parameter(0.1 * torch.randn(side, side, generator=torch.Generator().manual_seed(0)))
    lens = optics.Lens(
        optics.CircularAperture(3 * mm),
        optics.PlanoConvexLens(25.8 * mm, glass="N-BK7"),
        optics.DOE(phase),
        focus_distance=2.0,
    )
    imaging = optics.Imaging(lens, pixel_pitch=6 * um)
    return Camera(imaging, sensor.ColourFilter.kodak(), sensor.Mosaic("RGGB"), sensor.Exposure(), sensor.ShotNoise())


def loss_of(camera: Camera, scene: Scene, target: Tensor) -> Tensor:
    """Mean square of the noiseless raw against the raw of a camera that does not blur."""
    return (noiseless_raw(camera)(scene) - target).square().mean()


def train(start: Camera, scene: Scene, target: Tensor, plan: Plan | None, *, steps: int) -> dict[str, Any]:
    """Adam on the DOE's phase, through the plan or without; seconds of the steps alone, and true errors now and then.

    The losses are those of the camera without a plan, measured at the end.
    """
    camera = plan.apply(start) if plan is not None else start
    phase = next(parameter for parameter in camera.parameters() if parameter.requires_grad)
    optimiser = torch.optim.Adam([phase], lr=0.1)
    seconds, checks, losses = 0.0, [], []
    for step in range(steps):
        if plan is not None and step % EVERY == 0:
            found = compare(camera, start, scene, target)
            checks.append({"step": step, "raw_error": plan.measure(start, scene)} | found)
        begin = perf_counter()
        optimiser.zero_grad()
        loss = loss_of(camera, scene, target)
        loss.backward()
        optimiser.step()
        seconds += perf_counter() - begin
        losses.append(float(loss.detach()))
    with torch.no_grad():
        final = float(loss_of(start, scene, target))
    return {"seconds": seconds, "first_loss": losses[0], "final_loss": final, "losses": losses, "checks": checks}


def compare(planned: Camera, camera: Camera, scene: Scene, target: Tensor) -> dict[str, float]:
    """Gradient through the plan beside that of the camera: cosine, ratio of norms, relative difference."""
    phase = next(parameter for parameter in camera.parameters() if parameter.requires_grad)
    ours, theirs = (torch.autograd.grad(loss_of(c, scene, target), phase)[0] for c in (planned, camera))
    return {
        "gradient_cosine": float((ours * theirs).sum() / (ours.norm() * theirs.norm())),
        "gradient_norm_ratio": float(ours.norm() / theirs.norm()),
        "gradient_error": float((ours - theirs).norm() / theirs.norm()),
    }


def main() -> None:
    """Train twice, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--tolerance", type=float, default=0.1)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    scene = Scene.builtin("coffee", (arguments.size, arguments.size)).with_depth(1.0)
    sharp = doe_camera()
    with torch.no_grad():
        blurless = [sharp[0].changed(blur=False), *list(sharp)[1:]]
        target = noiseless_raw(Camera(*blurless, context=sharp.context))(scene)
    planned, whole = doe_camera(), doe_camera()
    plan = planned.plan(scene, tolerance=arguments.tolerance)
    print(plan)
    content: dict[str, Any] = {
        "environment": measure.environment(),
        "tolerance": arguments.tolerance,
        "changes": plan.changes,
        "bound": plan.bound,
        "planning_seconds": plan.planning_seconds,
        "with_plan": train(planned, scene, target, plan, steps=arguments.steps),
        "without": train(whole, scene, target, None, steps=arguments.steps),
    }
    files.replace(arguments.out, (json.dumps(content, indent=1) + "\n").encode())
    for name in ("with_plan", "without"):
        result = content[name]
        print(name, f"{result['seconds']:.1f} s", f"{result['first_loss']:.3g} -> {result['final_loss']:.3g}")
    for check in content["with_plan"]["checks"]:
        print(check)


if __name__ == "__main__":
    main()
