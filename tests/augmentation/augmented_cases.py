"""The table of all augmentations: to add one, write a row; `test_contract` runs every test over it.

The lenses are small (10 um pixels, PSFs of some ten pixels) so that the whole table takes seconds.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import kornia.augmentation as K
import pytest
import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

import kcam.augmentation as KC
from kcam import Camera, isp, optics, sensor
from kcam.units import mm, um

SIZE = (17, 23)
Range = tuple[float, float]


@dataclass(frozen=True)
class Case:
    """A row of the table.

    build: the augmentation, given ranges and Kornia's own arguments. ranges: all its drawn numbers that have a slope,
    with bounds of which each end has an effect on `picture()`. fixed: other arguments. seeded: it has random fields.
    rough: steps, Poisson noise or straight-through gradients, so that its slope is no difference quotient.
    slow: a call takes a second: `make test` takes a sample of its tests.
    """

    name: str
    build: Callable[..., nn.Module]
    ranges: dict[str, Range] = field(default_factory=dict)
    fixed: dict[str, Any] = field(default_factory=dict)
    cubes: bool = True
    gray: bool = True
    cube_to_picture: bool = False
    gray_to_picture: bool = False
    geometric: bool = False
    seeded: bool = False
    rough: bool = False
    changes_gray: bool = True
    slow: bool = False

    def __call__(self, **arguments: Any) -> Any:
        return self.build(**{**self.fixed, **self.ranges, **arguments})

    def channels(self) -> tuple[int, ...]:
        """Numbers of channels that it takes."""
        return (3, *([1] if self.gray else []), *([28] if self.cubes else []))

    def marks(self) -> list[pytest.MarkDecorator]:
        """Of the tests that are not in the sample."""
        return [pytest.mark.slow] if self.slow else []

    def channels_after(self, channels: int) -> int:
        """What it gives for them."""
        becomes_picture = self.cube_to_picture if channels == 28 else self.gray_to_picture
        return 3 if becomes_picture else channels


def picture(*shape: int, dtype: torch.dtype = torch.float32, seed: int = 0) -> Tensor:
    """Detail of all sizes between 0.1 and 0.7, so that a small step in any range stays inside of every clip."""
    shape = shape or (2, 3, *SIZE)
    noise = torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (0.1 + 0.6 * noise).to(dtype)


@functools.cache
def small_camera() -> Camera:
    """With every stage of a real one, and the cheapest optics: a plan would take longer than the picture."""
    lens = optics.Lens(
        optics.CircularAperture(diameter=2 * mm), optics.ThinLens(focal_length=8 * mm), focus_distance=2.0
    )
    return Camera(
        optics.Imaging(lens, pixel_pitch=10 * um, psf_shape=(9, 9), propagator="fresnel", integrate=False, bands=6),
        sensor.ColourFilter.kodak(),
        sensor.Mosaic("RGGB"),
        sensor.Exposure(),
        sensor.ShotNoise(),
        sensor.ReadNoise(3.0),
        sensor.ADC(10),
        isp.Demosaic(),
        isp.WhiteBalance(),
        isp.ColourMatrix(),
        isp.ToneCurve(),
    ).requires_grad_(False)


@functools.cache
def shared_camera(**arguments: Any) -> nn.Module:
    """One RandomCamera for the same arguments in all tests: what it planned is kept."""
    return KC.RandomCamera(cameras=(small_camera(),), **arguments)


@functools.cache
def small_lens() -> optics.CompoundLens:
    """A single lens of 0.6 mm: few rays, and pixels that are not many wavelengths wide."""
    glass = optics.Glass(1.5168, 64.2)
    front = optics.Surface(radius=0.6 * mm, thickness=0.1 * mm, glass=glass, semi_diameter=0.06 * mm, stop=True)
    back = optics.Surface(radius=-0.6 * mm, thickness=0.0, semi_diameter=0.1 * mm)
    return optics.CompoundLens(front, back, focus_distance=2.0).requires_grad_(False)


@functools.cache
def shared_lens(**arguments: Any) -> nn.Module:
    """One RandomLens for the same arguments in all tests: its PSFs are kept."""
    return KC.RandomLens(small_lens(), **arguments)


LENS = {"pixel_pitch": 10 * um, "outside": 0.05}
CASES: tuple[Case, ...] = (
    Case(
        "defocus",
        KC.RandomDefocus,
        {"focus": (1.0, 4.0), "f_number": (2.0, 4.0), "distance": (0.3, 0.6), "focal_length": (7 * mm, 9 * mm)},
        LENS,
    ),
    Case("diffraction", KC.RandomDiffraction, {"f_number": (16.0, 32.0)}, LENS),
    Case("aberration", KC.RandomAberration, {"rms": (0.05, 0.1), "f_number": (8.0, 12.0)}, LENS),
    Case(
        "chromatic_aberration",
        KC.RandomChromaticAberration,
        {"axial": (0.2, 0.6), "lateral": (0.01, 0.03), "f_number": (2.0, 4.0)},
        LENS,
    ),
    Case(
        "lens_distortion",
        KC.RandomLensDistortion,
        {"k1": (-0.2, -0.1), "k2": (0.01, 0.05), "p1": (0.001, 0.01), "p2": (0.001, 0.01)},
        geometric=True,
    ),
    Case(
        "rolling_shutter",
        KC.RandomRollingShutter,
        {
            "lean": (0.05, 0.1),
            "stretch": (0.01, 0.05),
            "wobble": (0.01, 0.02),
            "cycles": (1.0, 1.5),
            "phase": (0.1, 0.2),
        },
        geometric=True,
    ),
    Case("motion", KC.RandomMotion, {"length": (3.0, 5.0), "angle": (20.0, 40.0)}),
    Case("tremor", KC.RandomMotion, {"length": (3.0, 5.0), "angle": (20.0, 40.0)}, {"kind": "tremor"}, seeded=True),
    Case("lens", shared_lens, fixed={"reach": (0.2, 0.4), "steps": 2}, geometric=True, slow=True),
    Case(
        "veiling_glare",
        KC.RandomVeilingGlare,
        {"share": (0.05, 0.1), "core": (0.002, 0.005), "slope": (1.6, 2.4)},
        {"pixel_pitch": 10 * um},
    ),
    Case("vignetting", KC.RandomVignetting, {"field": (40.0, 80.0), "shade": (0.1, 0.4)}),
    Case("bayer", KC.RandomBayer, cube_to_picture=True),
    Case("x_trans", KC.RandomBayer, fixed={"pattern": "x_trans"}, cube_to_picture=True),
    Case(
        "shot_read_noise",
        KC.RandomShotReadNoise,
        {"iso": (400.0, 3200.0), "full_well": (5e3, 1e4), "read_noise": (2.0, 5.0)},
        seeded=True,
        rough=True,
    ),
    Case("fixed_pattern", KC.RandomFixedPattern, {"prnu": (0.01, 0.03), "dsnu": (20.0, 50.0)}, seeded=True),
    Case("banding", KC.RandomBanding, {"row": (5.0, 15.0), "column": (5.0, 15.0)}, seeded=True),
    Case(
        "hot_pixels", KC.RandomHotPixels, {"electrons": (100.0, 200.0)}, {"hot": (0.05, 0.1), "dead": 0.02}, seeded=True
    ),
    Case("exposure", KC.RandomExposure, {"stops": (-1.5, -0.5)}),
    Case("quantisation", KC.RandomQuantisation, fixed={"bits": (3, 6)}, rough=True),
    Case(
        "white_balance",
        KC.RandomWhiteBalance,
        {"temperature": (3000.0, 5000.0), "tint": (-0.3, -0.1)},
        changes_gray=False,
    ),
    Case("colour_matrix", KC.RandomColourMatrix, {"strength": (0.005, 0.01)}, cubes=False, gray=False),
    Case("tone_curve", KC.RandomToneCurve, {"gamma": (1.1, 1.4), "contrast": (0.1, 0.3)}),
    Case(
        "camera",
        shared_camera,
        {"distance": (0.4, 0.8)},
        {"tolerance": 0},
        cube_to_picture=True,
        gray_to_picture=True,
        seeded=True,
        rough=True,
    ),
)
BY_NAME = {case.name: case for case in CASES}


class Pictures(Dataset):
    """Pictures, each through a pipeline, as a worker of a DataLoader makes them."""

    def __init__(self, pipeline: nn.Module, count: int) -> None:
        self.pipeline, self.count = pipeline, count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Tensor:
        return self.pipeline(picture(1, 3, *SIZE))[0]


def pipeline() -> K.ImageSequential:
    """Optics, noise with a seed, and a stage of Kornia's own."""
    noise = BY_NAME["shot_read_noise"]
    return K.ImageSequential(BY_NAME["defocus"](p=1.0), noise(p=1.0), K.RandomHorizontalFlip(p=0.5))
