"""Painting: the picture itself is what is optimised, equation (3.13), from white noise or from a photograph."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from kcam.inputs import check_picture
from kcam.style.generators import torch_generator
from kcam.texture.descent import GRAY, descend
from kcam.texture.losses import StyleLoss

STARTS = ("photo", "noise")
NOISE = 0.15  # RMS of the white noise that a picture may start from, around gray


def paint(
    loss: StyleLoss,
    *,
    photo: Tensor | None = None,
    shape: tuple[int, int] | None = None,
    start: str | None = None,
    steps: int = 200,
    rate: float = 0.1,
    seed: int = 0,
    advance: Callable[[int, dict[str, float]], None] | None = None,
) -> Tensor:
    """Optimise a picture: y = argmin of the loss (eq. 3.13), Gatys et al.'s style transfer or texture synthesis.

    Adam works on the picture's spectrum, each frequency on a scale that falls as 1 / f like a picture's own: a step
    moves wide areas as readily as fine detail, where on the pixels it would move the detail alone.

    Args:      loss: with its weights; without a photo its content and l2 must be 0.
               photo: what the picture should show, (3,H,W) sRGB in [0,1]; None for a texture of the style alone.
               shape: (H,W) of a texture; the features' own steps are met by painting a little more than is kept.
               start: "photo" or "noise"; None for the photo if there is one.
               rate: of Adam, at its start; it falls to 0 by half a cosine.
               seed: of the noise.
               advance: called with each step's number and the terms of its loss.
    Returns:   (3,H,W) in [0,1].
    Raises:    ValueError for a start that is not there, neither photo nor shape, or a loss that is not finite;
               what the features raise for a picture that is too small.
    Source:    Gatys, Ecker and Bethge, Image style transfer using convolutional neural networks (2016); the
               preconditioning after Olah, Mordvintsev and Schubert, Feature visualization (2017).

    Example:
    >>> from kcam.style import StyleLoss, paint, painting
    >>> loss = StyleLoss(painting("woodcut", size=128), content=0.0)
    >>> texture = paint(loss, shape=(64, 64), steps=2)
    >>> texture.shape, bool((texture >= 0).all() and (texture <= 1).all())
    (torch.Size([3, 64, 64]), True)
    """
    start = start or ("noise" if photo is None else "photo")
    if start not in STARTS or (start == "photo" and photo is None):
        raise ValueError(f'start must be "photo", with a photo, or "noise"; got {start!r}.')
    if shape is not None and (not isinstance(shape, Sequence) or len(shape) != 2):
        raise TypeError(f"shape must be two whole numbers (H, W), got {shape!r}. Use shape=(256, 256).")
    if photo is None and shape is None:
        raise ValueError("a texture needs a size: pass shape=(256, 256), or a photo to paint.")
    if photo is None and (loss.weights["content"] or loss.weights["l2"]):
        raise ValueError("there is no photo for the content to be compared with. Pass StyleLoss(..., content=0).")
    if photo is not None:
        check_picture(photo, name="photo", channels=(3,), ndims=(3,))
    height, width = photo.shape[-2:] if photo is not None else shape or (0, 0)
    device: Any = loss.quantiles.device
    scene = None if photo is None else photo[None].float().to(device)
    begun = scene
    if start == "noise" or begun is None:
        noise = torch.randn(1, 3, height, width, generator=torch_generator(seed, 0))
        begun = (GRAY + NOISE * noise).clamp(0, 1).to(device)
    return descend(loss, begun, scene=scene, steps=steps, rate=rate, advance=advance)[0]
