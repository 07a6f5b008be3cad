"""Camera effects as Kornia augmentations: one more line in a pipeline. ``import kcam.augmentation as KC``."""

from kcam.augmentation.base import RGB_WAVELENGTHS, CameraAugmentation
from kcam.augmentation.camera import RandomCamera
from kcam.augmentation.corruptions import CORRUPTIONS, Corruption, corrupt
from kcam.augmentation.geometry import RandomLensDistortion
from kcam.augmentation.isp import RandomColourMatrix, RandomToneCurve, RandomWhiteBalance
from kcam.augmentation.lens import RandomLens
from kcam.augmentation.motion import RandomMotion, RandomRollingShutter
from kcam.augmentation.optics import (
    RandomAberration,
    RandomChromaticAberration,
    RandomDefocus,
    RandomDiffraction,
    RandomVeilingGlare,
    RandomVignetting,
)
from kcam.augmentation.sensor import (
    RandomBanding,
    RandomBayer,
    RandomExposure,
    RandomFixedPattern,
    RandomHotPixels,
    RandomQuantisation,
    RandomShotReadNoise,
)
from kcam.augmentation.sequential import CameraSequential

__all__ = [
    "CORRUPTIONS",
    "RGB_WAVELENGTHS",
    "CameraAugmentation",
    "CameraSequential",
    "Corruption",
    "RandomAberration",
    "RandomBanding",
    "RandomBayer",
    "RandomCamera",
    "RandomChromaticAberration",
    "RandomColourMatrix",
    "RandomDefocus",
    "RandomDiffraction",
    "RandomExposure",
    "RandomFixedPattern",
    "RandomHotPixels",
    "RandomLens",
    "RandomLensDistortion",
    "RandomMotion",
    "RandomQuantisation",
    "RandomRollingShutter",
    "RandomShotReadNoise",
    "RandomToneCurve",
    "RandomVeilingGlare",
    "RandomVignetting",
    "RandomWhiteBalance",
    "corrupt",
]
