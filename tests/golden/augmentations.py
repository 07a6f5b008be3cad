"""Questions about augmentations that use optics: on pictures and cubes, with depth, in a container, with a seed."""

from __future__ import annotations

from functools import partial
from typing import Any

import kornia.augmentation as K
import torch
from draws import Draw
from golden.cameras import noiseless
from golden.lenses import lens
from golden.plans import DEFAULT_RATES
from golden.psfs import DTYPES
from golden.question import Answer, Question, gradients, projected
from torch import Tensor

import kcam.augmentation as KC
from kcam import Camera, demo, isp, optics, sensor
from kcam.units import um

SIZE = 22, 28

BLURS: dict[str, dict[str, Any]] = {
    "RandomDefocus": {},
    "RandomDiffraction": {},
    "RandomAberration": {"f_number": (4.0, 8.0), "rms": (0.1, 0.4)},
    "RandomChromaticAberration": {},
    "RandomVignetting": {},
}


def images(seed: int, channels: int, dtype: torch.dtype) -> Tensor:
    return Draw(seed).noise(2, channels, *SIZE).to(dtype)


def blurred(name: str, dtype: torch.dtype, seed: int) -> Answer:
    """A picture and a cube, and the gradient to the picture."""
    answer: Answer = {}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        augment = getattr(KC, name)(p=1.0, **BLURS[name])
        for what, channels in (("picture", 3), ("cube", 6)):
            image = images(seed, channels, dtype).requires_grad_()
            result = augment(image)
            answer |= {what: result, f"{what} again": augment(image, params=augment._params)}
            slopes = gradients(projected(result, Draw(seed).noise(*result.shape) - 0.5), {what: image})
            answer |= slopes
    return answer


def with_depth(dtype: torch.dtype, seed: int) -> Answer:
    """Maps of inverse depth, as masks in a container and handed over."""
    image = images(seed, 3, dtype)
    depth = (0.2 + 1.5 * Draw(seed).noise(2, 1, *SIZE)).to(dtype)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        together = KC.CameraSequential(
            K.RandomHorizontalFlip(p=0.5), KC.RandomDefocus(p=1.0), K.RandomCrop((16, 18)), data_keys=["input", "mask"]
        )
        out, mask = together(image, depth)
        alone = KC.RandomDefocus(p=1.0)(image, inverse_depth=depth)
    return {"picture": out, "depth": mask, "alone": alone}


def staged(dtype: torch.dtype, seed: int) -> Answer:
    """Plain stages, optics among them, in the container."""
    draw = Draw(seed)
    imaging = optics.Imaging(lens("round convex", draw, dtype), pixel_pitch=4 * um, layers=3)
    stages = imaging, sensor.ColourFilter.kodak(), sensor.Mosaic("RGGB"), isp.Demosaic("bilinear")
    cubes = images(seed, 28, dtype)
    depth = (1 / torch.linspace(0.5, 2.0, SIZE[1], dtype=torch.float64)).expand(2, 1, *SIZE).to(dtype)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        out, _ = KC.CameraSequential(K.RandomVerticalFlip(p=0.5), *stages, data_keys=["input", "mask"])(cubes, depth)
    return {"picture": out}


def photographed(seed: int) -> Answer:
    """By cameras that are drawn; with noise and steps in float64, without where a plan may choose float32."""
    image = images(seed, 3, torch.float64)
    with torch.random.fork_rng(devices=[]), DEFAULT_RATES, torch.no_grad():
        torch.manual_seed(seed)
        reference = KC.RandomCamera(cameras=["phone", "ideal"], tolerance=0)(image)
        planned = KC.RandomCamera(cameras=[noiseless(Camera.phone()), noiseless(demo.singlet())], tolerance=0.05)
        return {"reference": reference, "planned": planned(image).to(torch.float32)}


def corrupted() -> Answer:
    """By name."""
    image = images(9, 3, torch.float32)
    names = "defocus", "diffraction", "aberration", "chromatic_aberration", "vignetting"
    return {name: KC.corrupt(image, name, severity=2, seed=1) for name in names}


def _questions() -> list[Question]:
    found = []
    for name, dtype in DTYPES.items():
        for seed, which in enumerate(BLURS):
            found.append(Question(f"augmentation {which}, {name}", partial(blurred, which, dtype, 900 + seed)))
        found.append(Question(f"augmentation with depth, {name}", partial(with_depth, dtype, 910)))
        found.append(Question(f"augmentation by stages, {name}", partial(staged, dtype, 911)))
    found.append(Question("augmentation RandomCamera", partial(photographed, 912)))
    found.append(Question("corruptions", corrupted))
    return found


QUESTIONS = _questions()
