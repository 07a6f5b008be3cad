"""A signal as it is shown: in colours that a screen has, whole, and a detail of it to the pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from kcam import isp, sensor, spectral, srgb
from kcam.camera import DEMOSAICING
from kcam.context import Context
from kcam.plots.pictures import as_image, false_colour, mosaic_tile
from kcam.plots.sheet import FAINT, GAP, INK, MUTED, SMALL, Sheet
from kcam.scene import Scene

ZOOM = 56
"""Pixels of the scene across a detail."""
_BRIGHT = 0.99  # of the pixels of a linear signal are not brighter than what is shown as white
_MOST = 20.0  # times darker than the brightest pixel that is
_ENOUGH = 1000  # pixels of a panel's longer side: more are averaged


@dataclass(frozen=True)
class Look:
    """A signal as it is shown, (H,W,3) in [0,1]: whole, its detail to the pixel, and what was done to show it.

    Both are None of what is no picture. box: left, top, columns and rows of the detail, as shares of the whole.
    """

    image: np.ndarray | None
    detail: np.ndarray | None
    shown: tuple[str, ...] = ()
    box: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)


def looked(
    signal: Any, behind: Sequence[nn.Module], context: Context, *, zoom: tuple[float, float], across: float
) -> Look:
    """The first sample of a signal as a picture, by the stages that are behind it.

    Args:      zoom: centre of the detail, as shares of the height and the width.  across: its width, as a share.
    """
    if not isinstance(signal, Tensor) or signal.ndim != 4 or 0 in signal.shape:
        return Look(None, None)
    planes = signal[0].detach().float().cpu().nan_to_num(0, 0, 0)
    tile = _tile(planes, behind)
    shown: tuple[str, ...] = ()
    if tile is None:
        planes, shown = _as_colours(planes, behind, context)
    if not is_coded(behind):
        black = _black(behind, context)
        bright, dark = planes - black, "less black" if black else "shown"
        top = _top(bright.amax(0))
        planes = (bright / top).clamp(0, 1)
        shown += (f"{dark} \u00d7 {1 / top:.3g}, sRGB gamma",)
        planes = planes if tile is not None else srgb.to_code(planes).expand(3, -1, -1)
    if tile is None:
        image = as_image(planes)
        return cut(image, image, zoom=zoom, across=across, shown=shown)
    image = false_colour(planes, tile)  # which has a gamma of its own
    return cut(_brightened(_mixed(image, len(tile))), image, zoom=zoom, across=across, shown=shown)


def scene_look(scene: Scene, *, zoom: tuple[float, float]) -> Look:
    """The first sample of a scene in sRGB."""
    image = as_image(scene.samples([0]).to_srgb()[0])
    return cut(image, image, zoom=zoom, across=ZOOM / scene.shape[2], shown=("as sRGB",))


def cut(
    image: np.ndarray,
    pixels: np.ndarray,
    *,
    zoom: tuple[float, float],
    across: float,
    shown: tuple[str, ...] = (),
) -> Look:
    """An image with the detail of `pixels`, of the same size, around a place: twice as wide as high."""
    height, width = image.shape[:2]
    columns = min(width, max(4, round(across * width)))
    rows = min(height, max(2, round(columns / 2)))
    y = int(np.clip(round(zoom[0] * height - rows / 2), 0, height - rows))
    x = int(np.clip(round(zoom[1] * width - columns / 2), 0, width - columns))
    step = max(1, max(height, width) // _ENOUGH)
    planes = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].float()
    small = F.avg_pool2d(planes, step, ceil_mode=True)[0].permute(1, 2, 0).numpy() if step > 1 else image
    box = (x / width, y / height, columns / width, rows / height)
    return Look(small, pixels[y : y + rows, x : x + columns], shown, box)


def is_coded(behind: Sequence[nn.Module]) -> bool:
    """Whether a signal is coded for the screen: all others are linear in light."""
    return any(isinstance(stage, (isp.ToneCurve, isp.StyleStage, isp.TextureTransfer)) for stage in behind)


def _tile(planes: Tensor, behind: Sequence[nn.Module]) -> np.ndarray | None:
    """The colours of the filters over a mosaic's pixels; None for what is none, or is one no more."""
    filtered = any(isinstance(s, sensor.Mosaic) or (isinstance(s, sensor.ColourFilter) and s.is_tile) for s in behind)
    if len(planes) != 1 or not filtered or is_coded(behind) or any(isinstance(s, DEMOSAICING) for s in behind):
        return None
    return mosaic_tile(behind)


def _as_colours(planes: Tensor, behind: Sequence[nn.Module], context: Context) -> tuple[Tensor, tuple[str, ...]]:
    """Channels (C,H,W) as linear red, green and blue or as one grey, and what was done where it is not plain."""
    filters = [stage for stage in behind if isinstance(stage, sensor.ColourFilter)]
    count, bands = len(planes), len(context.wavelengths)
    if not filters and count == bands:
        xyz = torch.einsum("lhw,lc->chw", planes, spectral.xyz_weights(context.wavelengths).float())
        return spectral.xyz_to_linear_srgb(xyz), ("as the eye sees its bands",)
    if count in (1, 3):
        return planes, ()
    if filters and not filters[-1].is_tile and len(filters[-1].coefficients) == count:
        curves = filters[-1].response(context.wavelengths).detach().double().cpu()
        colours = (curves @ spectral.observer(context.wavelengths) @ spectral.xyz_to_srgb_matrix().T).clamp(min=0)
        colours = (colours / colours.sum(0).clamp(min=1e-12)).float()  # all of them together are white
        return torch.einsum("chw,cr->rhw", planes, colours), ("channels in their own colours",)
    return planes.mean(0, keepdim=True), (f"mean of {count} channels",)


def _black(behind: Sequence[nn.Module], context: Context) -> float:
    """The black level that still lies under a signal, of full scale: a demosaic takes it off."""
    here = any(isinstance(s, sensor.ADC) for s in behind) and not any(isinstance(s, DEMOSAICING) for s in behind)
    return float(torch.as_tensor(context.black_level).detach().max()) if here else 0.0


def _top(plane: Tensor) -> float:
    """What is shown as white of a linear signal: above all but its brightest hundredth, which may be single lights."""
    values = plane.flatten()
    values = values[:: max(1, len(values) // 1_000_000)]
    top = max(float(np.quantile(values.numpy(), _BRIGHT)), float(values.amax()) / _MOST)
    return top if top > 1e-12 else 1.0


def _mixed(image: np.ndarray, tile: int) -> np.ndarray:
    """The mean over a tile around each pixel: shown smaller than it is, a mosaic would make moire."""
    width = min(tile, 6, *image.shape[:2])
    means = F.avg_pool2d(torch.from_numpy(image).permute(2, 0, 1), width, stride=1)
    return F.pad(means, (0, width - 1, 0, width - 1), "replicate").permute(1, 2, 0).numpy()


def _brightened(image: np.ndarray) -> np.ndarray:
    """Scaled so that all but its brightest hundredth keeps its colour: pixels of one colour are dark between others."""
    top = max(float(np.quantile(image, _BRIGHT)), float(image.max()) / _MOST ** (1 / 2.2))
    return np.clip(image / max(top, 1e-6), 0, 1)


def draw_look(
    sheet: Sheet,
    look: Look,
    left: float,
    top: float,
    width: float,
    high: float,
    detail: float,
    *,
    beside: bool = False,
) -> None:
    """A picture as large as fits; where it has a detail its frame, and the detail below or beside it."""
    if look.image is None:
        axes = sheet.axes(left, top, width, high)
        axes.set(xticks=[], yticks=[], facecolor=FAINT)
        axes.spines[:].set_visible(False)
        axes.text(0.5, 0.5, "no picture", color=MUTED, size=SMALL, ha="center", va="center", transform=axes.transAxes)
        return
    axes = sheet.picture(look.image, left, top, *_fitting(look.image, width, high))
    if look.detail is None:
        return
    rows, columns = look.image.shape[:2]
    x, y, across, down = (share * size for share, size in zip(look.box, (columns, rows, columns, rows), strict=True))
    for line, colour in ((2.2, INK), (1.0, "white")):
        frame = matplotlib.patches.Rectangle((x - 0.5, y - 0.5), across, down, fill=False, lw=line, ec=colour)
        axes.add_patch(frame)
    at = (left + width + GAP, top) if beside else (left, top + high + 0.08)
    sheet.picture(look.detail, *at, *_fitting(look.detail, width, detail), smooth=False)


def _fitting(image: np.ndarray, width: float, high: float) -> tuple[float, float]:
    scale = min(width / image.shape[1], high / image.shape[0])
    return image.shape[1] * scale, image.shape[0] * scale
