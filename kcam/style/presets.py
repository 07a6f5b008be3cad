"""Named ways to train a camera per style: the camera, the loss and the settings of each."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from kcam import isp, optics, sensor
from kcam.camera import Camera
from kcam.context import Context
from kcam.style.settings import Settings
from kcam.texture.losses import StyleLoss
from kcam.units import mm, nm, um

DOE_SIDE = 64
DOE_START = 0.05  # RMS of the phase at the start [rad]: flat is a saddle for all even aberrations


def style_camera(*, stage: bool = True) -> Camera:
    """A camera to train, which takes an ordinary picture: 50 mm f/10 with a DOE, Bayer mosaic, bilinear demosaic.

    What trains: the phase of a 64 x 64 DOE, the curves of the filter (at a Nikon 5100's, non-negative), a 3 x 3
    convolution behind the demosaic (at the identity), the gains and the colour matrix (at the as-shot ones), and with
    `stage` a `StyleStage` at the end. The PSF has 12 wavelengths for any number of bands, and 41 x 41 pixels.

    Example:
    >>> from kcam.style import style_camera
    >>> [type(stage).__name__ for stage in style_camera()][-5:]
    ['Convolution', 'WhiteBalance', 'ColourMatrix', 'ToneCurve', 'StyleStage']
    """
    curves = sensor.ColourFilter.nikon()
    context = Context(colour_filter=curves)
    gains, matrix = isp.as_shot_gains(context).float(), isp.as_shot_colour_matrix(context).float()
    lens = optics.Lens(
        optics.CircularAperture(diameter=5 * mm),
        optics.ThinLens(focal_length=50 * mm),
        optics.DOE(nn.Parameter(smooth_phase(DOE_SIDE)), design_wavelength=550 * nm, glass="fused silica"),
        focus_distance=2.0,
    )
    return Camera(
        optics.Imaging(lens, pixel_pitch=4 * um, psf_shape=(41, 41), bands=12),
        curves.trainable(),
        sensor.Mosaic("RGGB"),
        sensor.Exposure(),
        sensor.ShotNoise(full_well=10_000),
        sensor.ReadNoise(3.0),
        sensor.ADC(bits=12),
        isp.Demosaic("bilinear", gains=gains),
        isp.Convolution(),
        isp.WhiteBalance(nn.Parameter(gains)),
        isp.ColourMatrix(nn.Parameter(matrix)),
        isp.ToneCurve(),
        *([isp.StyleStage()] if stage else []),
    )


def smooth_phase(side: int) -> Tensor:
    """A smooth phase map of 0.05 rad RMS, (side, side), the same every time: a few low cosines.

    A flat map is a saddle: by symmetry the gradient of every even aberration starts at 0.
    """
    place = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    waves = torch.cos(math.pi * torch.arange(4)[:, None] * place)
    seeded = torch.Generator("cpu").manual_seed(0)
    weights = torch.randn(4, 4, generator=seeded, dtype=torch.float64, device="cpu")
    weights[0, 0] = 0
    phase = waves.T @ weights @ waves
    return (DOE_START * phase / phase.square().mean().sqrt()).float()


THESIS_L2 = 300.0
"""The thesis gives no weights; with this one its two terms are of one size where training starts."""


@dataclass(frozen=True)
class Preset:
    """A way to train. note: for the help. camera: makes it. loss: arguments of `StyleLoss`. settings: of `fit`.

    epochs: where it is these that are given, not the steps. pieces: whether the trained camera paints with pieces of
    the style, by an `isp.TextureTransfer` behind it, which needs no training.

    Example:
    >>> from kcam.style import PRESETS
    >>> quick = PRESETS["quick"]
    >>> quick.settings.size, quick.settings.batch
    (128, 2)
    """

    note: str
    camera: Callable[..., Camera]
    loss: dict[str, Any]
    settings: Settings
    epochs: int | None = None
    pieces: bool = False

    def style_loss(self, picture: Tensor, *, features: nn.Module | None = None, **changes: Any) -> StyleLoss:
        """The loss for a style picture, with some of its arguments changed."""
        how = {"crop": self.settings.size} | self.loss | changes
        if features is not None and features.name != "steerable":
            how = {"content_by": "features", "content_layer": "relu3_3"} | how
        return StyleLoss(picture, features=features, **how)

    def for_scenes(self, count: int, **changes: Any) -> Settings:
        """The settings for so many training scenes, some of them changed."""
        settings = replace(self.settings, **changes)
        if self.epochs is not None and "steps" not in changes:
            settings = replace(settings, steps=self.epochs * math.ceil(count / settings.batch))
        return settings


AIM = 0.12
"""Content loss at which faces are still there, and strokes too."""
PAINTED: dict[str, Any] = {
    "colour": 0.7,
    "content": 0.5,
    "levels": (2, 4),
    "window": 15,
    "whole": True,
    "flat": 3e-4,
}
"""Contents are measured from half the size on, which leaves room for strokes; light and dark over the whole picture.

A face has less contrast than what is around it: with the default `flat` some cameras keep no more than its outline.
"""

PRESETS: dict[str, Preset] = {
    "pieces": Preset(
        "the camera alone is trained, and paints with pieces of the style: a minute on a laptop",
        partial(style_camera, stage=False),
        PAINTED,
        Settings(
            steps=150, every=150, rates={part: rate for part, rate in Settings().rates.items() if part != "stage"}
        ),
        pieces=True,
    ),
    "quick": Preset(
        "a network paints; built-in scenes, 128 pixels: minutes on a laptop",
        style_camera,
        PAINTED,
        Settings(steps=600, content_aim=AIM),
    ),
    "standard": Preset(
        "a network paints; built-in scenes, 256 pixels, more steps",
        style_camera,
        PAINTED,
        Settings(steps=1000, size=256, content_aim=AIM),
    ),
    "thesis": Preset(
        "the thesis's network and settings, its table 4.1: batch 2, 50 epochs, Adam",
        Camera.thesis,
        {"statistic": "gram", "colour": 0.0, "content": 0.0, "l2": THESIS_L2},
        Settings(
            size=256,
            rates={"optics": 1e-3, "filter": 1e-3, "demosaic": 1e-3},
            betas=(0.5, 0.999),
            weight_decay=1e-4,
            decayed=("optics", "filter", "demosaic"),
            warm_up=0,
            final=1.0,
            clip=math.inf,
            average=0.0,
            every=500,
        ),
        epochs=50,
    ),
}
"""Name -> a way to train, as `kcam train --preset` takes it."""
