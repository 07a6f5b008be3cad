"""A picture that is moved downhill on a loss."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F

from kcam.ste import clip_ste
from kcam.texture.features import GRAY
from kcam.texture.losses import StyleLoss
from kcam.threads import no_more_than_free

CORNERS = 0.1


def descend(
    loss: StyleLoss,
    picture: Tensor,
    *,
    scene: Tensor | None = None,
    steps: int,
    rate: float,
    advance: Callable[[int, dict[str, float]], None] | None = None,
) -> Tensor:
    """A picture after some steps of Adam, each frequency on a scale that falls as 1 / f like a picture's own.

    A step moves wide areas as readily as fine detail, where on the pixels it would move the detail alone.

    Args:      picture, scene: (1,3,H,W) in [0,1]; the features' own steps are met by a border, which is cut off again.
               rate: of Adam, at its start; it falls to 0 by half a cosine.
               advance: called with each step's number and the terms of its loss.
    Returns:   (1,3,H,W) in [0,1], without a gradient.
    Raises:    ValueError for a loss that is not finite.
    Source:    Olah, Mordvintsev and Schubert, Feature visualization (2017), the preconditioning.
    """
    height, width = picture.shape[-2:]
    multiple, least = (int(size) for size in (loss.features.multiple, loss.features.least))
    shape = tuple(max(least, math.ceil(size / multiple) * multiple) for size in (height, width))

    def bordered(x: Tensor) -> Tensor:
        return F.pad(x, (0, shape[1] - width, 0, shape[0] - height), mode="replicate")

    with torch.inference_mode(False), torch.enable_grad():
        scene = None if scene is None else bordered(scene.detach().clone())
        begun = bordered(picture.detach().clone())
        scale = spectral_scale(*shape).to(begun)
        spectrum = torch.view_as_real(torch.fft.rfft2(begun - GRAY, norm="ortho") / scale).clone().requires_grad_()

        def shown() -> Tensor:
            values = torch.fft.irfft2(torch.view_as_complex(spectrum) * scale, s=shape, norm="ortho")
            return clip_ste(values + GRAY, 0.0, 1.0)

        optimiser = torch.optim.Adam([spectrum], lr=rate)
        for step in range(steps):
            with no_more_than_free():
                optimiser.param_groups[0]["lr"] = rate * 0.5 * (1 + math.cos(math.pi * step / steps))
                optimiser.zero_grad()
                terms = loss.terms(shown(), scene, turn=step)
                total = torch.stack(list(terms.values())).sum()
                if not total.isfinite():
                    raise ValueError(f"the loss is {total.item():g} at step {step}. Use a lower rate than {rate:g}.")
                total.backward()
                optimiser.step()
            if advance is not None:
                advance(step + 1, {name: float(value.detach()) for name, value in terms.items()})
        return shown().detach()[..., :height, :width].clone()


def spectral_scale(height: int, width: int) -> Tensor:
    """The 1 / f that a picture's spectrum falls by, (H, W/2+1), of mean square 1.

    Beyond 0.5 cycles per pixel, in the corners of the spectrum, features see little: there it is a tenth, or noise
    would grow.
    """
    frequency = torch.hypot(torch.fft.fftfreq(height)[:, None], torch.fft.rfftfreq(width))
    scale = 1 / frequency.clamp(min=1 / max(height, width))
    scale = torch.where(frequency > 0.5, CORNERS * scale, scale)
    return scale / scale.square().mean().sqrt()
