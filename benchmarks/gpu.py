"""kcam on a GPU: pictures and plans, a training step, augmentations, styles; each time beside its error and the CPU's.

    python -m benchmarks.gpu                          about six minutes; writes benchmarks/results/gpu.json
    python -m benchmarks.gpu --only styles,commands   measures these anew, the others stay
    python -m benchmarks.gpu --device cpu --quick --out FILE     toy sizes: checks that everything runs

Times are wall seconds between two synchronisations, the median of five calls after a warm-up; where that would take
long, of one call, which is told. The CPU's are of the machine that the GPU is in, with as many threads as torch has
there. Errors are the raw picture's relative RMS without noise: of the GPU's reference from the CPU's, of plans from the
reference where they run.
"""

from __future__ import annotations

import argparse
import copy
import functools
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

import kcam.augmentation as KC
from benchmarks.common import ROOT, environment, write_json
from benchmarks.style_step import random_vgg16
from kcam import Camera, Scene, isp, optics, planner, sensor, style
from kcam.units import mm, um

RESULTS = ROOT / "benchmarks" / "results" / "gpu.json"
TOLERANCES = (0.03, 0.01, 0.003)
LONG = 2.0  # seconds of a call above which one must do
ROUNDS = 5
Row = dict[str, Any]


def wall(where: str, call: Callable[[], Any], *, device: torch.device, most: float = LONG) -> Row:
    """Wall seconds of a call, the median of `ROUNDS` after one that warms up; where each takes long of one after it, or
    of the first.
    """

    def once() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize()
        start = time.perf_counter()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter() - start

    times = [once()]
    if times[0] < 5 * most:
        times = [once()]
        if times[0] < most:
            times += [once() for _ in range(ROUNDS - 1)]
    return {where: statistics.median(times), f"{where}_calls": len(times)}


# ---- pictures ------------------------------------------------------------------------------------------------------


def cases(quick: bool) -> dict[str, tuple[Camera, Scene]]:
    """Cameras and scenes, small ones to large ones."""

    def scene(name: str, side: int) -> Scene:
        return Scene.builtin(name, 32 if quick else side)

    trained = optics.DOE(style.presets.smooth_phase(64) * 40)
    doe = optics.Lens(
        optics.CircularAperture(5 * mm), optics.PlanoConvexLens(25.8 * mm, glass="N-BK7"), trained, focus_distance=1.0
    )
    real = optics.CompoundLens.preset("cooke_triplet", focus_distance=2.0)
    bayer = [sensor.ColourFilter.kodak(), sensor.Mosaic("RGGB"), sensor.Exposure(), isp.Demosaic(), isp.ToneCurve()]
    return {
        "phone camera": (Camera.phone(), scene("coffee", 1024).with_depth(2.0)),
        "the thesis's camera": (Camera.thesis(), scene("coffee", 256).with_depth(2.0)),
        "singlet and DOE, a depth map": (
            Camera(optics.Imaging(doe, pixel_pitch=4 * um), *bayer),
            scene("motorcycle", 512),
        ),
        "real lens over the field": (
            Camera(optics.Imaging(real, pixel_pitch=4 * um), *bayer),
            scene("astronaut", 512).with_depth(2.0),
        ),
    }


def pictures(device: torch.device, quick: bool) -> list[Row]:
    return [row for name, (camera, scene) in cases(quick).items() for row in pictures_of(name, camera, scene, device)]


def pictures_of(name: str, camera: Camera, scene: Scene, device: torch.device) -> list[Row]:
    """The reference, there and here, its slope in the scene's light, and plans."""

    def shot(chosen: Camera, light: Scene) -> Tensor:
        """With new optics, of which nothing is kept."""
        return planner.timed(chosen, light)[1]

    def row(plan: str, error: float, **others: Any) -> Row:
        return {"camera": name, "pixels": list(scene.shape[-2:]), "plan": plan, "error": error, **others}

    here: list[Tensor] = []
    with torch.no_grad():
        own = copy.deepcopy(camera)
        cpu = wall("cpu", lambda: here.append(shot(own, scene)), device=torch.device("cpu"), most=0.5)
        camera, scene = camera.to(device), scene.to(device)
        reference = shot(camera, scene)
        gpu = wall("gpu", lambda: shot(camera, scene), device=device)
        rows = [row("reference", planner.relative_rms(reference.cpu(), here[0]), **gpu, **cpu)]
        for tolerance in TOLERANCES:
            start = time.perf_counter()
            plan = camera.plan(scene, tolerance=tolerance)
            planning = time.perf_counter() - start
            planned = plan.apply(camera)
            error = planner.relative_rms(shot(planned, scene), reference)
            gpu = wall("gpu", functools.partial(shot, planned, scene), device=device)
            rows.append(row(f"tolerance {tolerance:g}", error, **gpu, planning=planning, changes=str(plan.changes)))
    light = scene.coefficients if scene.spectra is None else scene.spectra
    light.requires_grad_()
    rows[0] |= wall("gradient", lambda: shot(camera, scene).square().mean().backward(), device=device)
    return rows


# ---- augmentations -------------------------------------------------------------------------------------------------


def augmentations(device: torch.device, quick: bool) -> list[Row]:
    """A batch of 64 pictures of 224 x 224, ranges as they are by default."""
    shape = (2, 3, 32, 32) if quick else (64, 3, 224, 224)
    batch = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    there, rows = batch.to(device), []
    for name in KC.__all__:
        if not name.startswith("Random") or name in ("RandomCamera", "RandomLens"):
            continue
        augmentation = getattr(KC, name)(p=1.0)
        with torch.no_grad():
            gpu = wall("gpu", functools.partial(augmentation, there), device=device)
            cpu = wall("cpu", functools.partial(augmentation, batch), device=torch.device("cpu"), most=0.3)
        rows.append({"augmentation": name, "shape": list(shape)} | gpu | cpu)
    return rows


# ---- styles --------------------------------------------------------------------------------------------------------


def styles(device: torch.device, quick: bool) -> list[Row]:
    """A shot with pieces, 20 steps of painting, and of training."""
    side, steps = (64, 2) if quick else (512, 20)
    photo = Scene.builtin("astronaut", side).to_srgb().to(device)
    picture = style.painting("strokes", size=side).to(device)
    rows: list[Row] = []

    def row(what: str, call: Callable[[], Any]) -> None:
        rows.append({"what": what} | wall("gpu", call, device=device, most=0.1))

    pieces, laid = (isp.TextureTransfer(picture, seed=0, steps=count).to(device) for count in (20, 0))
    with torch.no_grad():
        row(f"shot of {side} x {side} with pieces", lambda: pieces(photo))
        row("the same as laid, steps=0", lambda: laid(photo))
    loss = style.StyleLoss(picture).to(device)
    row(f"{steps} steps of style.paint, {side} x {side}", lambda: style.paint(loss, photo=photo[0], steps=steps))
    preset = style.PRESETS["quick"]
    camera, source = preset.camera().to(device), style.BuiltinScenes(preset.settings.size)
    loss = preset.style_loss(style.painting("strokes").to(device)).to(device)
    settings = replace(preset.settings, steps=steps, every=1000)
    row(f"{steps} steps of preset quick", lambda: style.fit(camera, loss, source=source, settings=settings))
    return rows


# ---- whole commands ------------------------------------------------------------------------------------------------


def commands(device: torch.device, quick: bool) -> list[Row]:
    """kcam train from start to file; the thesis's size with VGG16 of random weights."""
    with tempfile.TemporaryDirectory() as folder:
        weights = Path(folder) / "vgg16.pth"
        random_vgg16(weights)
        vgg = ["--features", "vgg16", "--vgg-weights", str(weights)]
        few = [] if not quick else ["--steps", "2"]
        return [
            train(device, "pieces", *few),
            train(device, "quick", *few),
            *(train(device, "thesis", *vgg, "--steps", str(count)) for count in ((1, 3) if quick else (20, 60))),
        ]


def train(device: torch.device, preset: str, *arguments: str) -> Row:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "camera.safetensors"
        command = [sys.executable, "-m", "kcam", "train", "strokes", "--preset", preset, "--device", device.type]
        start = time.perf_counter()
        done = subprocess.run([*command, "--out", str(out), *arguments], capture_output=True, text=True, check=False)
        took = time.perf_counter() - start
        if done.returncode or not out.exists():
            raise RuntimeError((done.stdout + done.stderr)[-2000:])
    return {"what": " ".join(("kcam train --preset", preset, *arguments[-2:])), "gpu": took}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", default=",".join(MEASURED))
    parser.add_argument("--out", type=Path, default=RESULTS)
    given = parser.parse_args(arguments)
    device, console = torch.device(given.device), Console(width=150)
    content: dict[str, Any] = json.loads(given.out.read_text()) if given.out.exists() else {}
    told = environment() | {"clock": "wall seconds between two synchronisations"}
    if device.type == "cuda":
        told["gpu"] = torch.cuda.get_device_name()
    failed = 0
    for part in given.only.split(","):
        start = time.perf_counter()
        try:
            rows = MEASURED[part](device, given.quick)
        except Exception:  # the other parts are worth their time, and what was measured before stays
            console.print_exception()
            failed = 1
            continue
        content[part] = {"environment": told, "rows": rows}
        write_json(given.out, content)  # a lease may end at any moment
        table = Table(title=f"{part}, {time.perf_counter() - start:.0f} s", box=None, title_justify="left")
        names = list(dict.fromkeys(name for row in rows for name in row))
        for name in names:
            table.add_column(name)
        for row in rows:
            table.add_row(*(_text(row.get(name)) for name in names))
        console.print(table, "")
    return failed


MEASURED: dict[str, Callable[[torch.device, bool], list[Row]]] = {
    "pictures": pictures,
    "augmentations": augmentations,
    "styles": styles,
    "commands": commands,
}


def _text(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else "" if value is None else str(value)[:60]


if __name__ == "__main__":
    raise SystemExit(main())
