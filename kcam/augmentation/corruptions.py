"""Fixed corruptions at five severities, for tests of robustness: what cameras do to pictures, in physical units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import kornia.augmentation as K
import torch

from kcam.augmentation.base import TAKES, check_layout
from kcam.augmentation.geometry import RandomLensDistortion
from kcam.augmentation.isp import RandomWhiteBalance
from kcam.augmentation.lens import RandomLens
from kcam.augmentation.optics import (
    RandomAberration,
    RandomChromaticAberration,
    RandomDefocus,
    RandomDiffraction,
    RandomVignetting,
)
from kcam.augmentation.sensor import (
    RandomBayer,
    RandomExposure,
    RandomFixedPattern,
    RandomQuantisation,
    RandomShotReadNoise,
)
from kcam.inputs import check_array, check_floats


@dataclass(frozen=True)
class Corruption:
    """An augmentation and its arguments at each of the five severities.

    Example:
    >>> mild = KC.CORRUPTIONS["overexposure"].build(severity=1)
    >>> round(float(mild(torch.full((1, 3, 4, 4), 0.5))[0, 0, 0, 0]), 3)  # half a stop more light, as sRGB
    0.586
    """

    augmentation: type[K.base._AugmentationBase]
    severities: tuple[Mapping[str, Any], ...]

    def build(self, severity: int) -> K.base._AugmentationBase:
        """The augmentation at a severity, for every sample."""
        return self.augmentation(**self.severities[severity - 1], p=1.0, keepdim=True)


def _growing(augmentation: type, name: str, values: Sequence[Any], **fixed: Any) -> Corruption:
    """One argument grows with the severity."""
    return Corruption(augmentation, tuple({name: value, **fixed} for value in values))


CORRUPTIONS: dict[str, Corruption] = {
    "defocus": _growing(RandomDefocus, "distance", (1.4, 1.0, 0.8, 0.6, 0.5), focus=2.0, f_number=1.8, outside=0.003),
    "diffraction": _growing(RandomDiffraction, "f_number", (8.0, 11.0, 16.0, 22.0, 32.0)),
    "aberration": _growing(RandomAberration, "rms", (0.1, 0.25, 0.5, 1.0, 2.0), f_number=4.0),
    "chromatic_aberration": _growing(
        RandomChromaticAberration, "lateral", (0.002, 0.005, 0.01, 0.015, 0.02), axial=0.2, f_number=2.8
    ),
    "vignetting": _growing(RandomVignetting, "field", (50.0, 65.0, 80.0, 95.0, 110.0), shade=0.2),
    "barrel_distortion": _growing(RandomLensDistortion, "k1", (-0.05, -0.1, -0.15, -0.2, -0.25)),
    "pincushion_distortion": _growing(RandomLensDistortion, "k1", (0.05, 0.1, 0.2, 0.3, 0.4)),
    "real_lens": _growing(RandomLens, "reach", (0.3, 0.45, 0.6, 0.75, 0.95), lens="phone", distance=0.5, stops=0.0),
    "mosaic": Corruption(  # by the loss that isp.demosaic's table shows
        RandomBayer,
        (
            {"pattern": "RGGB"},
            {"pattern": "x_trans"},
            {"pattern": "RGGB", "method": "bilinear"},
            {"pattern": "quad_bayer"},
            {"pattern": "quad_bayer", "method": "bilinear"},
        ),
    ),
    "shot_read_noise": _growing(RandomShotReadNoise, "iso", (400.0, 1600.0, 6400.0, 12_800.0, 25_600.0)),
    "fixed_pattern": _growing(RandomFixedPattern, "prnu", (0.01, 0.02, 0.05, 0.1, 0.15), dsnu=20.0),
    "overexposure": _growing(RandomExposure, "stops", (0.5, 1.0, 1.5, 2.0, 3.0)),
    "underexposure": _growing(RandomExposure, "stops", (-1.0, -2.0, -3.0, -4.0, -5.0)),
    "quantisation": _growing(RandomQuantisation, "bits", (7, 6, 5, 4, 3)),
    "white_balance": _growing(RandomWhiteBalance, "temperature", (5500.0, 4800.0, 4200.0, 3600.0, 3000.0), tint=0.0),
}
"""Names for `corrupt`."""


def corrupt(image: Any, corruption: str, *, severity: int = 1, seed: int = 0) -> Any:
    """A picture as a bad camera gives it, the same at every call; the i-th of a batch is drawn from seed + i.

    Args:      image: (B,3,H,W), (3,H,W), or a NumPy array or PIL image as Kornia's containers take them; sRGB in [0,1].
               corruption: a name in `CORRUPTIONS`. severity: 1 to 5. seed: of what is random in it, such as noise; the
               global generator is left as it is.
    Returns:   a tensor of the shape, type and device of the picture, in [0,1].
    Raises:    ValueError for an unknown name or severity; TypeError for a path, or a seed that is no integer.

    Example:
    >>> picture = torch.rand(3, 32, 32)
    >>> one, two = (KC.corrupt(picture, "shot_read_noise", severity=3, seed=7) for _ in range(2))
    >>> one.shape, torch.equal(one, two)
    (torch.Size([3, 32, 32]), True)
    """
    if isinstance(image, torch.Tensor):
        check_floats(image, name="image", takes=TAKES, channels=None)
        check_layout(image, alpha=True)
    else:
        check_array(image, name="image")
    if isinstance(seed, bool) or not isinstance(seed, int):
        raise TypeError(f"seed must be an integer such as 0, got {seed!r}.")
    if corruption not in CORRUPTIONS:
        raise ValueError(f"unknown corruption {corruption!r}. There are: {', '.join(CORRUPTIONS)}.")
    if isinstance(severity, bool) or severity not in (1, 2, 3, 4, 5):
        raise ValueError(f"severity must be 1, 2, 3, 4 or 5, got {severity!r}.")
    pipeline = K.ImageSequential(CORRUPTIONS[corruption].build(int(severity)), keepdim=True)
    pictures = image.split(1) if isinstance(image, torch.Tensor) and image.ndim == 4 and len(image) > 1 else [image]
    found = []
    with torch.random.fork_rng(devices=[]):  # all is drawn on the CPU; a worker must not wake a GPU
        for index, picture in enumerate(pictures):
            torch.default_generator.manual_seed(seed + index)
            found.append(pipeline(picture))
    return found[0] if len(found) == 1 else torch.cat(found)
