"""What is said of a scene, of a stage and of the signal behind it, in a few words each."""

from __future__ import annotations

import inspect
import re
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from kcam import isp, optics, sensor
from kcam.camera import DEMOSAICING, Camera
from kcam.plots.looks import is_coded
from kcam.plots.psf import optics_text
from kcam.plots.sheet import metres
from kcam.scene import Scene

DOES: tuple[tuple[type[nn.Module] | tuple[type[nn.Module], ...], str], ...] = (
    (optics.Imaging, "through the lens"),
    (sensor.ColourFilter, "bands to channels"),
    (sensor.Mosaic, "each pixel keeps one channel"),
    (sensor.Exposure, "how full the pixels become"),
    (sensor.ShotNoise, "photons are counted"),
    (sensor.ReadNoise, "noise of the electronics"),
    (sensor.DarkCurrent, "electrons without light"),
    (sensor.FixedPattern, "no two pixels are alike"),
    (sensor.ADC, "numbers of so many bits"),
    (DEMOSAICING, "every channel at every pixel"),
    (isp.WhiteBalance, "a gain per channel: white is grey"),
    (isp.ColourMatrix, "the filter's colours to those of sRGB"),
    (isp.ToneCurve, "coded for the screen"),
    (isp.Clip, "limited to 0..1"),
    (isp.Convolution, "a small kernel over all channels"),
    (isp.StyleStage, "painted anew"),
    (isp.TextureTransfer, "painted with pieces"),
)
"""What the stages do, in a few words; of others their docstring tells it."""


def purpose_of(stage: nn.Module) -> str:
    """What a stage does, or the first line of its docstring."""
    for kind, words in DOES:
        if isinstance(stage, kind):
            return words
    own = type(stage).__doc__ if "__doc__" in vars(type(stage)) else None
    return (inspect.cleandoc(own).splitlines() or [""])[0].rstrip(".:") if own else ""


def arguments_of(stage: nn.Module) -> str:
    """Those that a stage prints, unless they are many or say little."""
    if isinstance(stage, optics.Imaging):
        return f"pixels of {float(stage.pixel_pitch) * 1e6:.3g} \u00b5m"
    if isinstance(stage, sensor.ColourFilter):
        shape = stage.coefficients.shape
        return f"tile of {shape[0]} \u00d7 {shape[1]} filters" if stage.is_tile else plural(shape[0], "channel")
    if isinstance(stage, (isp.LearnedDemosaic, isp.Convolution)):
        return f"kernel of {_times(stage.weight.shape)}"
    if isinstance(stage, nn.Sequential):
        return f"{len(stage)} layers"
    return re.sub(r"\w+=None(, |$)", "", " ".join(stage.extra_repr().split())).rstrip(", ")


def plural(count: int, what: str) -> str:
    """A count of things."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def _times(shape: Sequence[int]) -> str:
    return " \u00d7 ".join(map(str, shape))


def facts(signal: Any, behind: Sequence[nn.Module]) -> tuple[str, str]:
    """The shape of a sample, and from what to what it goes, in which unit."""
    if not isinstance(signal, Tensor):
        return type(signal).__name__, ""
    values = signal[0].detach() if signal.ndim else signal.detach()
    lost = int((~values.isfinite()).sum())
    finite = values[values.isfinite()] if lost else values
    low, high = (float(end) for end in finite.aminmax()) if finite.numel() else (0.0, 0.0)
    span = f"{low:.3g} to {high:.3g} {_unit(behind)}" if finite.numel() else ""
    return _times(values.shape) or "a number", f"{span}{f', {lost} not finite' if lost else ''}"


def _unit(behind: Sequence[nn.Module]) -> str:
    if is_coded(behind):
        return "in sRGB"
    for kind, unit in ((isp.ColourMatrix, "in linear sRGB"), (sensor.ADC, "of full scale")):
        if any(isinstance(stage, kind) for stage in behind):
            return unit
    exposed = any(isinstance(stage, sensor.Exposure) for stage in behind)
    return "of full well" if exposed else "relative to white" if behind else "relative"


def where(scene: Scene) -> str:
    """How far away a scene is, and how large."""
    depth = torch.as_tensor(scene.depth)
    near, far = metres(float(depth.min())), metres(float(depth.max()))
    _, height, width = scene.shape
    return f"{near if near == far else f'{near} to {far}'} away;  {width} \u00d7 {height} pixels"


def imaging_of(camera: Camera) -> optics.Imaging | None:
    """The stage of its lens, if it has one."""
    return next((stage for stage in camera if isinstance(stage, optics.Imaging)), None)


def lens_line(camera: Camera, *, otherwise: str) -> str:
    """The lens and its pixels, `otherwise` where there is none."""
    imaging = imaging_of(camera)
    return otherwise if imaging is None else optics_text(imaging)
