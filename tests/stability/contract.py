"""What a hard case is, and what is recorded of it: a camera and a scene, photographed with and without noise."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from kcam import Camera, Scene, isp, sensor

SINGLE, DOUBLE = torch.float32, torch.float64
VALUES = 3e-6
"""float32 against float64 in raw and picture, relative RMS, unless a row says otherwise: the largest of the ordinary
rows is 1e-6 (the residual path's 3e-7 .. 1e-6 of numerics.md, section 6, and an FFT of 5e-7), times 3."""

GRADIENTS = 1e-3
"""float32 against float64 in each gradient, relative L2, unless a row says otherwise: what issue 4 asks of whole-camera
gradients (8e-5 measured in numerics.md, section 12)."""

STATIONARY = 1e-2
"""Where all of a parameter moves the loss by less than this share of it, the gradient counts as 0, and its error is
relative to that share: in focus the slope in focal length cancels, and of a cancelled sum float32 leaves rounding."""


@dataclass(frozen=True)
class Case:
    """A row of the table: `build` gives a camera and a scene in float32, `limit` checks what nature knows of them.

    item: of the issue's list, see `ITEMS`.  values, gradients: bounds of float32 against float64, with the `reason`
    where they are not the usual ones.  warns: what a UserWarning must say; without it there must be none.
    """

    name: str
    item: str
    build: Callable[[], tuple[Camera, Scene]]
    limit: Callable[[Shot], None] | None = None
    values: float = VALUES
    gradients: float = GRADIENTS
    reason: str = ""
    warns: str | None = None
    slow: bool = False


@dataclass(frozen=True)
class BadCase:
    """Input that cannot be right: `attempt` raises an error that says the value, what is expected, and a fix."""

    name: str
    item: str
    attempt: Callable[[], Any]
    error: type[Exception]
    value: str
    expected: str
    fix: str


@dataclass(frozen=True)
class Shot:
    """A case as photographed. `raw`, `picture` and `gradients` are those of the `exact` camera: no noise, 24 bits."""

    camera: Camera
    exact: Camera
    scene: Scene
    dtype: torch.dtype
    device: torch.device
    signals: dict[str, Tensor]
    noisy_gradients: dict[str, Tensor]
    raw: Tensor
    picture: Tensor
    gradients: dict[str, Tensor]
    least: dict[str, float]
    warnings: tuple[str, ...]

    def bound(self, single: float, double: float) -> float:
        """The one of two bounds that belongs to this dtype."""
        return single if self.dtype == SINGLE else double

    def generator(self) -> torch.Generator:
        return torch.Generator(self.device).manual_seed(0)


@functools.cache
def photograph(case: Case, dtype: torch.dtype, device: torch.device) -> Shot:
    """Both dtypes see the same numbers, those of float32; a scene in half precision stays so."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warnings.filterwarnings("ignore", message="these [0-9]+ bands do not carry")  # few bands are quick
        warnings.filterwarnings("ignore", message="depth .* depths are in metres")  # far is what some cases are about
        camera, scene = case.build()
        camera = camera.float().to(device, dtype)
        scene = scene.to(device, dtype if scene.dtype == SINGLE else None)
        leaf = scene.coefficients.detach().requires_grad_()
        depth = scene.depth.detach().clone().requires_grad_() if isinstance(scene.depth, Tensor) else scene.depth
        scene = replace(scene, coefficients=leaf, depth=depth)
        generator = torch.Generator(device).manual_seed(0)
        signals, noisy_gradients = _develop(camera, scene, generator)
        precise = exact(camera)
        clean, gradients = _develop(precise, scene, generator)
    loss = float(last(clean).double().square().mean()) if last(clean).numel() else 0.0
    sizes = {name: float(parameter.detach().norm()) or 1.0 for name, parameter in camera.named_parameters()}
    return Shot(
        camera, precise, scene, dtype, device, signals, noisy_gradients,
        recorded(precise, clean), last(clean), gradients,
        {name: STATIONARY * loss / size for name, size in sizes.items()},
        tuple(str(warning.message) for warning in caught),
    )  # fmt: skip


def exact(camera: Camera) -> Camera:
    """The same camera at its mean, with an ADC that takes no steps."""
    stages = [stage.bypass() if isinstance(stage, sensor.ADC) else stage for stage in camera.noiseless()]
    return Camera(*stages, context=camera.resolve())


def _develop(camera: Camera, scene: Scene, generator: torch.Generator) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    signals = {f"{index} {name}": s for index, (name, s) in enumerate(camera.steps(scene, generator=generator))}
    picture = last(signals).float() if last(signals).dtype in (torch.half, torch.bfloat16) else last(signals)
    loss = picture.square().sum() / max(1, picture.numel())
    leaves = {"scene": scene.coefficients} | ({"depth": scene.depth} if isinstance(scene.depth, Tensor) else {})
    leaves |= {name: parameter for name, parameter in camera.named_parameters() if parameter.requires_grad}
    found = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
    gradients = {name: gradient for name, gradient in zip(leaves, found, strict=True) if gradient is not None}
    return {name: signal.detach() for name, signal in signals.items()}, gradients


def last(signals: dict[str, Tensor]) -> Tensor:
    return [*signals.values()][-1]


def recorded(camera: Camera, signals: dict[str, Tensor]) -> Tensor:
    """The signal before the demosaic."""
    ends = len(camera) - next(i for i, s in enumerate(camera) if isinstance(s, (isp.Demosaic, isp.LearnedDemosaic)))
    return [*signals.values()][-1 - ends]


def relative(value: Tensor, truth: Tensor, *, least: float = 0.0) -> float:
    """L2 norm of the difference over that of the truth, or over `least` if that is more; 0 where both are 0."""
    value, truth = value.detach().double(), truth.detach().double()
    scale = truth.square().sum().sqrt().clamp(min=least)
    difference = (value - truth).square().sum().sqrt()
    return float(difference / scale) if scale > 0 else float(difference)


def l1(value: Tensor, truth: Tensor) -> float:
    """Sum of the absolute differences over the sum of the truth."""
    value, truth = value.detach().double().cpu(), torch.as_tensor(truth).detach().double().cpu()
    return float((value - truth).abs().sum() / truth.sum())
