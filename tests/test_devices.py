"""Pictures, slopes and plans on a device that is not the CPU.

python -m pytest --device pretend      a device without hardware, see `pretend`
python -m pytest --device cuda
"""

from __future__ import annotations

import contextlib
import copy
import math
import re
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import pretend
import pytest
import torch
from stages import painting_stage
from torch import Tensor, nn

from benchmarks import pairs
from kcam import Camera, Scene, analysis, isp, optics, plots, sensor, style, train
from kcam.planner import noiseless_raw, relative_rms
from kcam.units import nm, um

PAIRS = {"random": pairs.random_pair, "adversarial": pairs.adversarial_pair}
ROUNDING = 1e-5  # float32
SLOPES = 1e-3


def pair(kind: str, seed: int) -> tuple[Camera, Scene]:
    own = {"longest": 2.0} if kind == "random" else {"sides": (48, 96)}
    camera, scene, *_ = PAIRS[kind](seed, **own)
    return pairs.with_effects(camera, scene, f"{kind} {seed}")[0], scene


def drawn(quick: int, slow: int, *, kinds: Collection[str] = PAIRS) -> list[Any]:
    """Kinds and seeds of pairs, those from `quick` on, and all of other kinds, as slow tests."""
    return [
        pytest.param(kind, seed, marks=[] if seed < quick and kind in kinds else [pytest.mark.slow])
        for kind in PAIRS
        for seed in range(slow)
    ]


def slopes(camera: Camera, scene: Scene) -> tuple[Tensor, dict[str, Tensor]]:
    """The raw picture without noise, and the slopes of a sum of its squares."""
    light = scene.spectra if scene.coefficients is None else scene.coefficients
    light.requires_grad_()
    raw = noiseless_raw(camera)(scene)
    raw.square().mean().backward()
    found = {name: parameter.grad for name, parameter in camera.named_parameters()} | {"scene": light.grad}
    return raw.detach(), {name: grad.cpu() for name, grad in found.items() if grad is not None}


def compared(camera: Camera, scene: Scene, device: torch.device) -> tuple[Camera, Scene, dict[str, Tensor]]:
    """Camera and scene there, whose raw picture and slopes are the CPU's, and those slopes."""
    there, far = copy.deepcopy(camera).to(device), copy.deepcopy(scene).to(device)
    raw, expected = slopes(camera, scene)
    found, grads = slopes(there, far)
    assert found.device == device
    assert relative_rms(found.cpu(), raw) < ROUNDING
    assert grads.keys() == expected.keys()
    for name, grad in grads.items():
        assert (grad - expected[name]).norm() <= SLOPES * expected[name].norm(), name
    return there, far, grads


@pytest.mark.parametrize(("kind", "seed"), drawn(1, 16, kinds=("random",)))
def test_pictures_and_slopes_are_the_cpus(kind: str, seed: int, device: torch.device) -> None:
    there, far, _ = compared(*pair(kind, seed), device)
    with torch.no_grad():
        picture = there(far, generator=torch.Generator(device).manual_seed(0))
    assert picture.device == device
    assert picture.isfinite().all()


@pytest.mark.parametrize(("kind", "seed"), drawn(1, 6, kinds=("random",)))
def test_plans_keep_their_tolerance(kind: str, seed: int, device: torch.device) -> None:
    camera, scene = pair(kind, seed)
    camera, scene = camera.to(device), scene.to(device)
    assert camera.plan(scene, tolerance=0.01).measure(camera, scene) <= 0.01


@pytest.mark.slow
@pytest.mark.parametrize("deep", [False, True])
def test_plans_over_the_field(deep: bool, device: torch.device) -> None:
    lens = optics.Lens(optics.CircularAperture(0.8e-3), optics.ThinLens(5e-3), focus_distance=2.0)
    scene = Scene.builtin("coffee", 24)
    scene = scene.with_depth(torch.linspace(1.9, 2.1, 24).expand(1, 1, *scene.shape[1:])) if deep else scene
    camera = Camera(optics.Imaging(lens, pixel_pitch=6 * um, field=True), sensor.ColourFilter.kodak()).to(device)
    scene = scene.to(device)
    with torch.no_grad():
        plan = camera.plan(scene, tolerance=0.05)
        assert plan.changes
        assert plan.measure(camera, scene) <= 0.05


@pytest.mark.slow
def test_a_real_lens_that_trains(device: torch.device) -> None:
    lens = optics.CompoundLens.preset("cooke_triplet", focus_distance=2.0)
    for surface in lens.surfaces:
        if abs(float(surface.radius)) < 1:
            surface.radius = nn.Parameter(torch.tensor(float(surface.radius), dtype=torch.float64))
    camera = Camera(optics.Imaging(lens, pixel_pitch=8 * um), sensor.ColourFilter.kodak())
    _, _, grads = compared(camera, Scene.builtin("coffee", (24, 32)).with_depth(2.0), device)
    assert len(grads) > 4


REFUSED: dict[str, Callable[[Tensor, Tensor, torch.device], Any]] = {
    "a sum": lambda here, there, device: here + there,
    "in place": lambda here, there, device: there.add_(here),
    "a product": lambda here, there, device: there @ here,
    "a choice": lambda here, there, device: torch.where(there > 0, here, there),
    "joined": lambda here, there, device: torch.cat([here, there]),
    "numbers joined": lambda here, there, device: torch.stack([here.sum(), there.sum()]),
    "selected by the CPU": lambda here, there, device: there.index_select(0, here[0].long()),
    "indexed from there": lambda here, there, device: here[there[0].long()],
    "put by index": lambda here, there, device: there.index_put_((there[0].long(),), here),
    "a convolution": lambda here, there, device: nn.functional.conv2d(there[None, None], here[None, None]),
    "an array": lambda here, there, device: there.numpy(),
    "a generator": lambda here, there, device: torch.rand(3, device=device, generator=torch.Generator()),
    "its generator": lambda here, there, device: torch.rand(3, generator=torch.Generator(device)),
    "noise by the CPU's": lambda here, there, device: torch.poisson(there, generator=torch.Generator()),
}
TAKEN: dict[str, Callable[[Tensor, Tensor, torch.device], Any]] = {
    "a number": lambda here, there, device: there * here.sum() + 1,
    "an index": lambda here, there, device: there[here[0].long()],
    "a copy": lambda here, there, device: there.copy_(here),
    "a number put by index": lambda here, there, device: there.index_put_((here[0].long(),), here.sum()),
    "its generator": lambda here, there, device: torch.rand(3, device=device, generator=torch.Generator(device)),
}


@pytest.mark.parametrize("mix", REFUSED)
def test_mixes_are_refused(mix: str, device: torch.device) -> None:
    here = torch.eye(3)
    with pytest.raises((RuntimeError, TypeError)):
        REFUSED[mix](here, here.to(device), device)


@pytest.mark.parametrize("mix", TAKEN)
def test_what_cuda_takes_is_taken(mix: str, device: torch.device) -> None:
    here = torch.eye(3)
    assert TAKEN[mix](here, here.to(device), device).device == device


def test_vectors_keep_their_shape_on_either_device(device: torch.device) -> None:
    here = torch.eye(3)
    for one in (here, here.to(device)):
        assert (one[0] @ one[:, :1]).shape == (1,)  # torch squeezes the row away in place


def picture(*shape: int) -> Tensor:
    coarse = torch.rand(*shape[:-2], 9, 9, generator=torch.Generator().manual_seed(0))
    return nn.functional.interpolate(coarse, shape[-2:], mode="bicubic").clamp(0, 1)


ELSEWHERE = {"pieces": math.inf, "texture transfer": math.inf, "style stage": 1e-3, "JPEG": 0.01}
"""Other rounding may choose another piece, or step; a network's convolutions are as torch has them, in TF32."""
PRETENDED = {"texture transfer": 0.01}
"""Kornia's boxes are rounded otherwise where it knows no CPU, and the steps go by the signs of slopes."""
STAGES: dict[str, Callable[[], nn.Module]] = {
    "style stage": lambda: painting_stage().mean(),
    "pieces": lambda: isp.TextureTransfer(style.painting("strokes", size=64), seed=0, steps=0),
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


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in ("pieces", "texture transfer") else n for n in STAGES]
)
def test_stages_of_pictures(name: str, device: torch.device) -> None:
    shown, stage = picture(1, 3, 72, 80), STAGES[name]()
    with torch.no_grad():
        here = stage(shown)
        there = copy.deepcopy(stage).to(device)(shown.to(device))
    assert there.device == device
    assert there.isfinite().all()
    off = (there.cpu() - here).square().mean().sqrt()
    assert (there.cpu() - here).mean((0, 2, 3)).abs().max() < 0.05  # other pieces, of the same painting
    assert off < (PRETENDED if device.type == pretend.NAME else ELSEWHERE).get(name, ROUNDING)


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
    "a real lens's PSF": lambda camera, scene: real(scene).psf(
        [550 * nm], distances=torch.tensor([2.0]).to(scene.device), pixel_pitch=4 * um, shape=(9, 9)
    ),
    "a real lens's distortion": lambda camera, scene: real(scene).distortion(field(scene)),
    "a real lens's light": lambda camera, scene: real(scene).relative_illumination(field(scene)),
    "a real lens in focus": lambda camera, scene: real(scene).refocus(weights=torch.ones(1, 3).to(scene.device)),
}


def real(scene: Scene) -> optics.CompoundLens:
    return optics.CompoundLens.preset("cooke_triplet", focus_distance=2.0).to(scene.device)


def field(scene: Scene) -> Tensor:
    return torch.tensor([[0.0, 0.0], [0.05, 0.1]]).to(scene.device)


def numbers(found: Any) -> list[float]:
    """Of an answer: itself, or those that a report or a figure's text tells."""
    if isinstance(found, Tensor):
        return found.detach().double().cpu().flatten().tolist()
    return [float(number) for number in re.findall(r"-?\d+\.\d+", repr(found))]


@pytest.mark.slow
@pytest.mark.parametrize("asked", ASKED)
def test_what_cameras_are_asked_there(asked: str, device: torch.device) -> None:
    noiseless = asked in ("raw", "burst", "edge")  # elsewhere noise is drawn by another generator
    camera, scene = Camera.phone(), Scene.builtin("motorcycle", 40)
    camera = camera.noiseless() if noiseless else camera
    expected = numbers(ASKED[asked](camera, scene))
    found = numbers(ASKED[asked](camera.to(device), scene.to(device)))
    if asked not in ("explain", "compare", "pipeline"):  # times, and figures
        assert found == pytest.approx(expected, rel=1e-3, abs=1e-5)
        assert expected


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
