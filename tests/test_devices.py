"""Pictures, slopes and plans on a device that is not the CPU.

python -m pytest --device pretend      a device without hardware, see `pretend`
python -m pytest --device cuda
"""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pretend
import pytest
import torch
from stages import painting_stage
from torch import Tensor, nn

from benchmarks import planner as campaign
from kcam import Camera, Scene, analysis, isp, optics, plots, sensor, style, train
from kcam.planner import noiseless_raw, relative_rms
from kcam.units import um

PAIRS = {"random": campaign.random_pair, "adversarial": campaign.adversarial_pair}
ROUNDING = 1e-5  # float32
SLOPES = 1e-3


def pair(kind: str, seed: int) -> tuple[Camera, Scene]:
    own = {"longest": 2.0} if kind == "random" else {"sides": (48, 96)}
    camera, scene, *_ = PAIRS[kind](seed, **own)
    return campaign.with_effects(camera, scene, f"{kind} {seed}")[0], scene


def drawn(quick: int, slow: int) -> list[Any]:
    """Kinds and seeds of pairs, those from `quick` on as slow tests."""
    seeds = [(kind, seed) for kind in PAIRS for seed in range(slow)]
    return [pytest.param(*own, marks=[pytest.mark.slow] if own[1] >= quick else []) for own in seeds]


def slopes(camera: Camera, scene: Scene) -> tuple[Tensor, dict[str, Tensor]]:
    """The raw picture without noise, and the slopes of a sum of its squares."""
    light = scene.spectra if scene.coefficients is None else scene.coefficients
    light.requires_grad_()
    raw = noiseless_raw(camera)(scene)
    raw.square().mean().backward()
    found = {name: parameter.grad for name, parameter in camera.named_parameters()} | {"scene": light.grad}
    return raw.detach(), {name: grad.cpu() for name, grad in found.items() if grad is not None}


@pytest.mark.parametrize(("kind", "seed"), drawn(2, 16))
def test_pictures_and_slopes_are_the_cpus(kind: str, seed: int, device: torch.device) -> None:
    camera, scene = pair(kind, seed)
    there, far = copy.deepcopy(camera).to(device), copy.deepcopy(scene).to(device)
    raw, expected = slopes(camera, scene)
    found, grads = slopes(there, far)
    assert found.device == device
    assert relative_rms(found.cpu(), raw) < ROUNDING
    assert grads.keys() == expected.keys()
    for name, grad in grads.items():
        assert (grad - expected[name]).norm() <= SLOPES * expected[name].norm(), name
    with torch.no_grad():
        picture = there(far, generator=torch.Generator(device).manual_seed(0))
    assert picture.device == device
    assert picture.isfinite().all()


@pytest.mark.parametrize(("kind", "seed"), drawn(1, 6))
def test_plans_keep_their_tolerance(kind: str, seed: int, device: torch.device) -> None:
    camera, scene = pair(kind, seed)
    camera, scene = camera.to(device), scene.to(device)
    assert camera.plan(scene, tolerance=0.01).measure(camera, scene) <= 0.01


def test_a_real_lens_that_trains(device: torch.device) -> None:
    lens = optics.CompoundLens.preset("cooke_triplet", focus_distance=2.0)
    for surface in lens.surfaces:
        if surface.radius == surface.radius and abs(float(surface.radius)) < 1:
            surface.radius = nn.Parameter(torch.tensor(float(surface.radius), dtype=torch.float64))
    camera = Camera(optics.Imaging(lens, pixel_pitch=8 * um), sensor.ColourFilter.kodak())
    scene = Scene.builtin("coffee", (24, 32)).with_depth(2.0)
    there, far = copy.deepcopy(camera).to(device), copy.deepcopy(scene).to(device)
    raw, expected = slopes(camera, scene)
    found, grads = slopes(there, far)
    assert relative_rms(found.cpu(), raw) < ROUNDING
    assert len(grads) > 4
    for name, grad in grads.items():
        assert (grad - expected[name]).norm() <= SLOPES * expected[name].norm(), name


def picture(*shape: int) -> Tensor:
    coarse = torch.rand(*shape[:-2], 9, 9, generator=torch.Generator().manual_seed(0))
    return nn.functional.interpolate(coarse, shape[-2:], mode="bicubic").clamp(0, 1)


ELSEWHERE = {"texture transfer": math.inf, "style stage": 1e-3, "JPEG": 0.01}
"""Other rounding may choose another piece, or step; a network's convolutions are as torch has them, in TF32."""
STAGES: dict[str, Callable[[], nn.Module]] = {
    "style stage": lambda: painting_stage().mean(),
    "texture transfer": lambda: isp.TextureTransfer(style.painting("strokes", size=64), seed=0, steps=2),
    "learned demosaic": lambda: nn.Sequential(sensor.Mosaic("RGGB"), isp.LearnedDemosaic()),
    "malvar": lambda: nn.Sequential(sensor.Mosaic("RGGB"), isp.Demosaic("malvar", pattern="RGGB")),
    "menon": lambda: nn.Sequential(sensor.Mosaic("RGGB"), isp.Demosaic("menon", pattern="RGGB")),
    "convolution": isp.Convolution,
    "denoise": isp.Denoise,
    "sharpen": isp.Sharpen,
    "local tones": isp.LocalToneMapping,
    "JPEG": isp.JPEG,
}


@pytest.mark.parametrize("name", STAGES)
def test_stages_of_pictures(name: str, device: torch.device) -> None:
    shown, stage = picture(1, 3, 72, 80), STAGES[name]()
    with torch.no_grad():
        here = stage(shown)
        there = copy.deepcopy(stage).to(device)(shown.to(device))
    assert there.device == device
    assert there.isfinite().all()
    off = (there.cpu() - here).square().mean().sqrt()
    assert off < (ROUNDING if device.type == pretend.NAME else ELSEWHERE.get(name, ROUNDING))


ASKED: dict[str, Callable[[Camera, Scene], Any]] = {
    "explain": lambda camera, scene: camera.explain(scene, tolerance=0.02),
    "raw": lambda camera, scene: camera.raw(scene),
    "burst": lambda camera, scene: camera.burst(scene, exposures=[1.0, 2.0]),
    "linear": lambda camera, scene: camera.linear(scene).adjoint(camera.linear(scene)(scene.coefficients)),
    "compare": lambda camera, scene: plots.compare({"one": camera, "other": camera}, scene),
    "pipeline": plots.pipeline,
    "dynamic range": lambda camera, scene: analysis.dynamic_range(camera),
    "signal to noise": lambda camera, scene: analysis.signal_to_noise(camera),
    "colours": lambda camera, scene: analysis.colour_error(camera),
    "noise power": lambda camera, scene: analysis.noise_power(camera),
    "edge": lambda camera, scene: analysis.edge_response(camera),
}


@pytest.mark.slow
@pytest.mark.parametrize("asked", ASKED)
def test_what_cameras_are_asked_there(asked: str, device: torch.device) -> None:
    camera, scene = Camera.phone().to(device), Scene.builtin("motorcycle", 40).to(device)
    found = ASKED[asked](camera, scene)
    assert not isinstance(found, Tensor) or (found.device == device and found.isfinite().all())


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["pieces", "quick"])
def test_a_whole_training(preset: str, device: torch.device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As `kcam train --device` runs it: the sheet, the report, the card, and a camera that any machine loads."""
    if device.type == pretend.NAME:
        monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
        monkeypatch.setattr(train, "joined", lambda name: contextlib.nullcontext((True, device)))
    out = tmp_path / "camera.safetensors"
    done = train.run(train.Options(style="strokes", out=str(out), preset=preset, steps=3, size=64, device="cuda"))
    assert len(done.history) == 3
    assert {path.name for path in out.with_suffix("").iterdir()} >= {"sheet.png", "loss.png", "report.html"}
    found = Camera.load(out)
    assert all(part.device.type == "cpu" for part in (*found.parameters(), *found.buffers()))
    assert found(Scene.builtin("coffee", 48).with_depth(2.0)).isfinite().all()
