"""A small camera, style and settings: what the tests of training share."""

from __future__ import annotations

from torch import nn

from kcam import isp, optics, sensor
from kcam.camera import Camera
from kcam.style import Settings, StyleLoss, painting
from kcam.style.presets import smooth_phase
from kcam.style.scenes import BuiltinScenes
from kcam.units import mm, nm, um

SIZE = 64


def camera(*, stage: bool = True) -> Camera:
    """All parts that train, each as small as it gets."""
    lens = optics.Lens(
        optics.CircularAperture(diameter=5 * mm),
        optics.ThinLens(focal_length=50 * mm),
        optics.DOE(nn.Parameter(smooth_phase(16)), design_wavelength=550 * nm, glass="fused silica"),
        focus_distance=2.0,
    )
    return Camera(
        optics.Imaging(lens, pixel_pitch=8 * um, psf_shape=(9, 9), bands=3),
        sensor.ColourFilter.kodak(infrared_cut=680 * nm).trainable(),
        sensor.Mosaic("RGGB"),
        sensor.Exposure(),
        sensor.ShotNoise(full_well=10_000),
        sensor.ADC(bits=12),
        isp.Demosaic("bilinear"),
        isp.Convolution(),
        isp.ToneCurve(),
        *([isp.StyleStage(width=4, dilations=(1,), noise=(1, 2, 1))] if stage else []),
    )


def loss(**changes) -> StyleLoss:
    return StyleLoss(painting("woodcut", size=128)[:, :SIZE, :SIZE], **changes)


def source() -> BuiltinScenes:
    return BuiltinScenes(SIZE, names=["chelsea"])


def settings(**changes) -> Settings:
    return Settings(**{"steps": 8, "size": SIZE, "every": 3} | changes)
