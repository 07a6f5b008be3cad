"""Questions about plans, made now and saved before: what is chosen, the stated errors and prices, and the pictures.

Prices are those of the default rates. Left out is what a clock says: how long planning took, and measured times.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from unittest import mock

import torch
from draws import Draw
from golden.cameras import FILES, behind, noiseless, noisy, painted, ramped, small_thesis
from golden.question import Answer, Question, gradients, in_float32, parameter, projected
from torch import nn

from kcam import Camera, Plan, Scene, demo, optics
from kcam.units import mm

ERRORS = ("bound", "expected", "checked")
TIMED = ("planning_seconds", "measured")
DEFAULT_RATES = mock.patch.dict(os.environ, {"KCAM_CACHE": "/nowhere"})
"""Not those that `kcam calibrate` may have kept on this machine."""


def of_plan(plan: Plan) -> Answer:
    """What it says, its errors as one tensor apart: rounding moves the small ones."""
    plain = json.loads(json.dumps(asdict(plan)))
    rows = plain.pop("decisions")
    for name in TIMED:
        plain.pop(name)
    errors = [plain.pop(name) or 0.0 for name in ERRORS] + [row.pop("error") for row in rows]
    for row in rows:
        row.pop("why")  # the same numbers in words
    plain["range"].pop("contrast")
    if not plain["replaced"]:  # of stages that have cheaper forms, which came later
        plain.pop("replaced")
    if not plain["range"]["rings"]:  # of optics that vary over the picture, which came later
        plain["range"].pop("rings")
    seen = plain["range"].pop("potential"), plain["range"].pop("light"), plain["range"].pop("depths")
    levels = [plain["range"].pop(name) for name in ("saturated", "darkest", "brightest")] + [plain.pop("allowed")]
    return {
        "plan": plain,
        "rows": rows,
        "errors": torch.tensor(errors, dtype=torch.float64),
        "levels": torch.tensor(levels, dtype=torch.float64),
        **{f"seen {index}": torch.tensor(part, dtype=torch.float64) for index, part in enumerate(seen)},
    }


def made(
    make: Callable[[], Camera], scenes: Callable[[], list[Scene]], tolerance: float | str, *, trains: bool = False
) -> Answer:
    """A plan that is made now, the picture of the planned camera, and what is measured."""
    camera, found = make(), scenes()
    with DEFAULT_RATES, torch.set_grad_enabled(trains):
        plan = camera.plan(found if len(found) > 1 else found[0], tolerance=tolerance)
        answer = of_plan(plan)
        taken = plan.apply(camera)
        raw = noiseless(taken)(found[0])
        answer |= {"picture": raw, "error": torch.tensor(plan.measure(camera, found[0]))}
        if trains:
            weights = Draw(1).noise(*raw.shape) - 0.5
            leaves = {name: p for name, p in camera.named_parameters() if p.requires_grad}
            answer |= gradients(projected(raw, weights), leaves)
    return in_float32(answer)  # which the plans choose


def explained() -> Answer:
    """By the camera's own method, in the words of a table but for its times."""
    camera, scene = demo.singlet(), painted()
    with DEFAULT_RATES, torch.no_grad():
        plan = camera.explain(scene, tolerance=0.02, measure=True)
        short = noiseless(camera)(scene, tolerance=0.05).to(torch.float32)
    rows = [row.split("  ")[0] for row in str(plan).splitlines()]
    error = torch.tensor(plan.measured["error"])
    return {"rows": rows[:-4], "error": error, "short": short, "measured": sorted(plan.measured)}


def of_a_file(name: str) -> Answer:
    """A plan that was saved before, applied to the camera that it was made for."""
    make, scenes, _ = SAVED[name]
    plan, camera, scene = Plan.load(FILES / f"{name}.json"), make(), scenes()[0]
    with torch.no_grad():
        taken = plan.apply(camera)
        picture = noiseless(taken)(scene)
        error = plan.measure(camera, scene)
    again, kept = json.loads(plan.to_json()), json.loads((FILES / f"{name}.json").read_text())
    added = again["range"].keys() - kept["range"].keys()  # by later commits
    same = not any(again["range"].pop(name) for name in added) and again == kept
    stages = [type(stage).__name__ for stage in taken]
    return in_float32({"same": same, "stages": stages, "picture": picture, "error": torch.tensor(error)})


# ---- cameras and scenes ----------------------------------------------------------------------------------------------


def doe_camera() -> Camera:
    """Whose DOE trains."""
    phase = nn.Parameter((Draw(5).noise(16, 16) - 0.5) * 2)
    elements = optics.CircularAperture(2 * mm), optics.PlanoConvexLens(12.9 * mm), optics.DOE(phase)
    return behind(optics.Lens(*elements, focus_distance=1.0), *noisy())


def aberrated_camera() -> Camera:
    """A pupil grid whose sampling is a choice."""
    elements = [
        optics.CircularAperture(2 * mm),
        optics.ThinLens(20 * mm),
        optics.ZernikeAberration(parameter((Draw(6).noise(10) - 0.5) * 2e-7, torch.float64).detach()),
    ]
    return behind(optics.Lens(*elements, focus_distance=1.0), *noisy(), fill_factor=0.5)


def flat() -> list[Scene]:
    return [painted()]


def plain() -> list[Scene]:
    """In float32."""
    return [painted(seed=2).to(torch.float32)]


def deep() -> list[Scene]:
    return [ramped(painted(seed=3))]


def several() -> list[Scene]:
    return [painted().with_depth(1.0), painted(26, 40, seed=4).with_depth(0.6)]


def batch() -> list[Scene]:
    scene = painted(28, 30)
    both = torch.cat([scene.coefficients, scene.coefficients.flip(-1) * 0.5])
    return [Scene(both, scene.spectra, scene.wavelengths, torch.tensor([0.8, 2.5]), scene.illuminant)]


def cube() -> list[Scene]:
    scene = painted(28, 30)
    bands = scene.bands() * (0.8 + 0.4 * Draw(8).noise(*scene.bands().shape))
    return [Scene.from_bands(bands, wavelengths=scene.wavelengths, depth=0.9)]


MADE: dict[str, tuple[Callable[[], Camera], Callable[[], list[Scene]], float | str, bool]] = {
    "singlet, flat, 0.05": (demo.singlet, flat, 0.05, False),
    "singlet, flat, 0.003": (demo.singlet, flat, 0.003, False),
    "singlet, flat, sensor": (demo.singlet, flat, "sensor", False),
    "singlet, float32, 0.01": (demo.singlet, plain, 0.01, False),
    "phone, deep, 0.03": (Camera.phone, deep, 0.03, False),
    "singlet, deep, 0.02": (demo.singlet, deep, 0.02, False),
    "singlet, several, 0.02": (demo.singlet, several, 0.02, False),
    "singlet, a batch, 0.02": (demo.singlet, batch, 0.02, False),
    "aberrated, a cube, 0.02": (aberrated_camera, cube, 0.02, False),
    "aberrated, deep, 0.1": (aberrated_camera, deep, 0.1, False),
    "a DOE that trains, 0.1": (doe_camera, flat, 0.1, True),
    "a DOE that trains, deep, 0.2": (doe_camera, deep, 0.2, True),
}

SAVED: dict[str, tuple[Callable[[], Camera], Callable[[], list[Scene]], float | str]] = {
    "plan_singlet": (demo.singlet, flat, 0.02),
    "plan_sensor": (Camera.phone, deep, "sensor"),
    "plan_doe": (doe_camera, deep, 0.1),
    "plan_thesis": (small_thesis, flat, 0.3),
}
"""Those that were saved, as files/NAME.json."""


def _questions() -> list[Question]:
    found = []
    for name, (make, scenes, tolerance, trains) in MADE.items():
        found.append(Question(f"plan {name}", partial(made, make, scenes, tolerance, trains=trains)))
    found += [Question(f"plan from a file, {name}", partial(of_a_file, name)) for name in SAVED]
    return [*found, Question("plan explained", explained)]


QUESTIONS = _questions()
