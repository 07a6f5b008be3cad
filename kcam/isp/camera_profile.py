"""What the stages of a camera say to a raw file: its pattern, its colours, and the noise of what it records."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from kcam import spectral
from kcam.context import Context, Stage
from kcam.inputs import describe
from kcam.isp.colour import ColourMatrix, WhiteBalance, as_shot_colour_matrix, as_shot_gains
from kcam.isp.demosaic import Demosaic
from kcam.isp.tiff import COLOURED
from kcam.sensor.adc import ADC
from kcam.sensor.noise import FixedPattern
from kcam.sensor.random_stage import RandomStage


def check_recorded(raw: Any) -> None:
    """TypeError, ValueError unless it is one picture's raw signal, (1,1,H,W) in 0..1."""
    if not isinstance(raw, Tensor) or not raw.is_floating_point():
        raise TypeError(f"raw must be what camera.raw(scene) gives, a float tensor (1,1,H,W), got {describe(raw)}.")
    if raw.ndim == 4 and raw.shape[1] > 1:
        raise ValueError(
            f"raw has {raw.shape[1]} full planes, {tuple(raw.shape)}, and no mosaic, expected (1,1,H,W). Put "
            "sensor.Mosaic('RGGB') before the ADC, and use camera.raw(scene)."
        )
    if raw.ndim == 4 and len(raw) != 1:
        raise ValueError(
            f"raw is a batch of {len(raw)}, and a file holds one picture. Use [Raw.from_camera(camera, one[None]) for "
            "one in raw]."
        )
    if raw.ndim != 4 or raw.numel() == 0:
        raise ValueError(f"raw has shape {tuple(raw.shape)}, expected (1,1,H,W) of at least one pixel.")
    low, high = (float(end) for end in raw.detach().aminmax())
    if not (low >= 0 and high <= 1):
        odd = "NaN" if math.isnan(low) else f"{low if low < 0 else high:g}"
        raise ValueError(
            f"raw must be in 0..1, 1.0 = full scale, got {odd}. Use what camera.raw(scene) gives; numbers "
            "are divided by 2**bits - 1."
        )


def pattern_of(stages: Sequence[nn.Module], context: Context) -> str | None:
    """The name of the mosaic, None for a monochrome sensor; ValueError for what raw files cannot say."""
    if getattr(context.colour_filter, "is_tile", False):
        raise ValueError(
            "the camera's colour filter is a learned tile, whose pixels have curves of their own: raw files know named "
            "patterns only. Use ColourFilter.nikon() with sensor.Mosaic('RGGB')."
        )
    named = any("pattern" in stage.provides() for stage in stages if isinstance(stage, Stage))
    if not named and not any(isinstance(stage, Demosaic) for stage in stages):
        return None
    if context.pattern not in COLOURED:
        raise ValueError(
            f"pattern {context.pattern!r} has white pixels, for which raw files have no colours. Expected one of "
            f"{', '.join(COLOURED)}."
        )
    return context.pattern


def colours(stages: Sequence[nn.Module], context: Context, *, mono: bool, share: float) -> dict[str, Any]:
    """Neutral, colour matrix and baseline exposure that develop as the camera does.

    Args:      share: what of full scale lies above the black level.
    """
    channels = 1 if mono else 3
    gains = next((stage.gains for stage in stages if isinstance(stage, WhiteBalance)), None)
    matrix = next((stage.matrix for stage in stages if isinstance(stage, ColourMatrix)), None)
    gains = as_shot_gains(context, channels=channels) if gains is None else gains
    matrix = as_shot_colour_matrix(context, channels=channels) if matrix is None else matrix
    whole = (matrix.detach().double() * gains.detach().double().to(matrix.device)).cpu()  # channels to linear sRGB
    if mono:
        if not float(whole.mean()) > 0:
            raise ValueError(
                f"the colour matrix makes {float(whole.mean()):g} of a white; expected more than 0, such as 1."
            )
        return {"baseline_exposure": math.log2(float(whole.mean()) * share)}
    # What becomes gray: 1 / gains, if the matrix leaves white white.
    neutral, failed = torch.linalg.solve_ex(whole, torch.ones(3, dtype=torch.float64))
    if int(failed) or not bool((neutral > 0).all() & neutral.isfinite().all()):
        raise ValueError(
            f"with its gains and colour matrix no light becomes gray in this camera (channels {neutral.tolist()}), and "
            "a raw file must name its neutral. Give ColourMatrix rows that add up to one positive number."
        )
    brightness, neutral = 1 / float(neutral[1]), neutral / neutral[1]
    to_srgb = whole * neutral / brightness
    daylight = neutral
    if context.colour_filter is not None:
        daylight = context.colour_filter.white(context.wavelengths).detach().double().cpu()
        daylight = daylight / daylight[1]
    colour_matrix = daylight[:, None] * torch.linalg.solve(to_srgb, spectral.xyz_to_srgb_matrix())
    return {"neutral": neutral, "colour_matrix": colour_matrix, "baseline_exposure": math.log2(brightness * share)}


def gain(adc: ADC, context: Context) -> float:
    """That of the converter, or else the camera's."""
    return float(torch.as_tensor(adc.gain_in(context)).detach())


def noise_profile(
    stages: Sequence[nn.Module], context: Context, adc: ADC, *, range_: float, size: Sequence[int]
) -> tuple[float, float] | None:
    """(S, O) of the variance S x + O of a signal with black at 0 and white at 1; None if a stage does not say it.

    Args:      range_: from black to white level [DN].
    """
    half = torch.full((1, 1, *size), 0.5, dtype=torch.float64)
    in_half = in_dark = 0.0
    for stage in stages:
        if stage is adc:
            break
        if isinstance(stage, RandomStage) and not isinstance(stage, FixedPattern):
            try:
                light, dark = (torch.as_tensor(stage.sigma(at, context)).detach() for at in (half, 0 * half))
            except NotImplementedError:
                return None
            in_half += float(light.double().square().mean())
            in_dark += float(dark.double().square().mean())
    scale = gain(adc, context) * (2**adc.bits - 1) / range_
    step = 1 / range_ if adc.rounding else 0.0
    return scale * (in_half - in_dark) / 0.5, scale**2 * in_dark + step**2 / 12
