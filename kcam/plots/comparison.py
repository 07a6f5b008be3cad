"""Cameras side by side on one scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from skimage.color import deltaE_ciede2000, rgb2lab
from torch import Tensor

from kcam.camera import Camera
from kcam.inputs import describe
from kcam.plots.captions import lens_line, where
from kcam.plots.looks import ZOOM, Look, cut, draw_look, scene_look
from kcam.plots.pictures import as_image
from kcam.plots.sheet import EDGE, GAP, LINE, MUTED, TITLE, WIDTH, Sheet, columns_of, draw_lines, shortened
from kcam.plots.stages import check_camera, check_zoom, first_of
from kcam.scene import Scene

_STRONGEST = 32  # times that a difference is shown


def compare(
    cameras: Mapping[str, Camera] | Sequence[Camera],
    scene: Scene,
    *,
    seed: int = 0,
    title: str = "One scene, several cameras",
    zoom: tuple[float, float] = (0.5, 0.5),
) -> Figure:
    """Pictures of one scene by several cameras: whole, a detail, what differs, and by how much in numbers.

    Below each picture stand its PSNR and its mean colour difference, CIEDE2000, to the scene as sRGB (what a perfect
    camera would show) and to the picture of the first camera. The lowest row is the difference to the first picture,
    and for the first that to the scene: grey where they agree.

    Args:      cameras: by name, ``{"phone": Camera.phone(), "singlet": lens}``; or a list, named by its numbers.
               scene: of a batch the first is taken.
               seed: of the noise, the same for each camera.
               title: of the figure.  zoom: centre of the detail, as shares of the height and the width.
    Returns:   a matplotlib Figure, 12.8 inches wide; `save_figure` or ``figure.savefig`` writes it.
    Raises:    TypeError for one camera alone, or what is no camera or no scene; ValueError for none, for a camera whose
               result has other than 1 or 3 channels, or a zoom outside 0..1.

    Example:
    >>> figure = plots.compare({"phone": Camera.phone(), "ideal": Camera.ideal()}, Scene.builtin("coffee", size=24))
    >>> float(figure.get_figwidth())
    12.8
    """
    named = _named(cameras)
    scene = first_of(scene, by="plots.compare")
    check_zoom(zoom)
    pictures = {}
    with torch.no_grad():
        for name, camera in named.items():
            generator = torch.Generator(scene.device).manual_seed(seed)
            pictures[name] = _picture(camera(scene, generator=generator), name)
        seen = scene.to_srgb()[0].double().cpu()
        return _drawn(named, pictures, seen, scene, title=title, zoom=zoom)


def psnr(picture: Tensor, truth: Tensor) -> float:
    """Peak signal to noise ratio of pictures in [0,1]: -10 log10 of the mean squared error [dB]; inf where equal."""
    error = float((picture.double() - truth.double()).square().mean())
    return -10 * math.log10(error) if error > 0 else math.inf


def mean_delta_e(picture: Tensor, truth: Tensor) -> float:
    """Mean CIEDE2000 between two pictures (3,H,W) in sRGB."""
    lab, other = (rgb2lab(image.double().permute(1, 2, 0).numpy()) for image in (picture, truth))
    return float(deltaE_ciede2000(lab, other).mean())


def _named(cameras: Any) -> dict[str, Camera]:
    example = 'plots.compare({"phone": Camera.phone(), "ideal": Camera.ideal()}, scene)'
    if isinstance(cameras, Camera) or not isinstance(cameras, (Mapping, Sequence)) or isinstance(cameras, str):
        what = "one Camera" if isinstance(cameras, Camera) else describe(cameras)
        raise TypeError(f"cameras must be a dict by name or a list of them, got {what}. Use {example}.")
    if not isinstance(cameras, Mapping):
        cameras = {f"camera {number}": camera for number, camera in enumerate(cameras, start=1)}
    if not cameras:
        raise ValueError(f"there is no camera to compare: got an empty {type(cameras).__name__}. Use {example}.")
    for camera in cameras.values():
        check_camera(camera, by="plots.compare")
    return {str(name): camera for name, camera in cameras.items()}


def _picture(result: Tensor, name: str) -> Tensor:
    """What a camera gave, as (3,H,W) in [0,1]."""
    if result.ndim != 4 or result.shape[1] not in (1, 3) or 0 in result.shape:
        raise ValueError(
            f"{name} gives {' x '.join(map(str, result.shape))}, expected a picture (B,3,H,W) or (B,1,H,W). Let it end "
            "in isp.ToneCurve; plots.pipeline shows any signal."
        )
    return result[0].double().cpu().nan_to_num(0, 1, 0).clamp(0, 1).expand(3, -1, -1)


def _drawn(
    cameras: Mapping[str, Camera],
    pictures: Mapping[str, Tensor],
    seen: Tensor,
    scene: Scene,
    *,
    title: str,
    zoom: tuple[float, float],
) -> Figure:
    first, across = next(iter(pictures)), ZOOM / scene.shape[2]
    truths = {name: ("scene", seen) if name == first else (first, pictures[first]) for name in pictures}
    apart = {name: own - truths[name][1] for name, own in pictures.items() if own.shape == truths[name][1].shape}
    largest = max((float(np.quantile(own.abs().numpy(), 0.99)) for own in apart.values()), default=1.0)
    factor = 2 ** int(np.clip(math.floor(math.log2(0.5 / max(largest, 1e-9))), 0, math.log2(_STRONGEST)))
    count = len(pictures) + 1
    columns = columns_of(count)
    cell = min((WIDTH - 2 * EDGE + GAP) / columns - GAP, 4.0)
    tall, detail = min(cell * scene.shape[1] / scene.shape[2], 1.2 * cell), 0.5 * cell
    texts = 0.47 + tall + 0.08 + detail + 0.08  # where the text below the detail starts
    row, head = texts + 3 * LINE + 0.08 + tall + 0.06 + LINE + 0.35, 1.12
    sheet = Sheet(WIDTH, head + math.ceil(count / columns) * row)
    sheet.text(EDGE, 0.3, shortened(title, WIDTH - 2 * EDGE, size=TITLE), size=TITLE, weight="bold", parse_math=False)
    facts = f"{where(scene)};  differences are shown about grey, \u00d7 {factor}"
    sheet.text(EDGE, 0.66, shortened(facts, WIDTH - 2 * EDGE), colour=MUTED)

    def cell_of(index: int, name: str, line: str, look: Look, lines: Sequence[str]) -> tuple[float, float]:
        left, top = EDGE + index % columns * (cell + GAP), head + index // columns * row
        sheet.text(left, top, shortened(name, cell, weight="bold"), weight="bold", parse_math=False)
        draw_lines(sheet, (line,), left, top + 0.21, cell)
        draw_look(sheet, look, left, top + 0.44, cell, tall, detail)
        draw_lines(sheet, lines, left, top + texts, cell)
        return left, top + texts + 3 * LINE + 0.08

    legend = ("PSNR and mean CIEDE2000 to", "the scene as sRGB, and to", f"the picture of {first}")
    cell_of(0, "Scene", "as sRGB", scene_look(scene, zoom=zoom), legend)
    for index, (name, own) in enumerate(pictures.items(), start=1):
        other, _ = truths[name]
        lines = [_numbers("scene", own, seen)]
        if name != first:
            lines.append(_numbers(first, own, pictures[first]))
        look = cut(as_image(own), as_image(own), zoom=zoom, across=across)
        left, top = cell_of(index, name, lens_line(cameras[name], otherwise="no lens"), look, lines)
        if name in apart:
            shown = as_image(0.5 + factor * apart[name])
            image = cut(shown, shown, zoom=zoom, across=across).image
            draw_look(sheet, Look(image, None), left, top, cell, tall, 0)
            caption = f"{name} \u2212 {other}"
        else:
            caption = f"no difference to {other}: {_size(own)} and {_size(truths[name][1])} pixels"
        draw_lines(sheet, (caption,), left, top + tall + 0.06, cell)
    return sheet.figure


def _numbers(name: str, picture: Tensor, truth: Tensor) -> str:
    if picture.shape != truth.shape:
        return f"to {name}: another size"
    if bool((picture == truth).all()):
        return f"to {name}: equal"
    return f"to {name}: {psnr(picture, truth):.1f} dB, \u0394E {mean_delta_e(picture, truth):.2f}"


def _size(picture: Tensor) -> str:
    return f"{picture.shape[-1]} \u00d7 {picture.shape[-2]}"
