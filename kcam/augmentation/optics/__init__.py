"""Wave optics: defocus, diffraction, aberrations and colour fringes by PSFs that are drawn per sample; vignetting."""

from kcam.augmentation.base import LEAST_VERGENCE, finite_vergence
from kcam.augmentation.optics.aberrations import (
    FocusedBlur,
    RandomAberration,
    RandomChromaticAberration,
    RandomDiffraction,
    magnify,
)
from kcam.augmentation.optics.blur import (
    DESIGN,
    FOCAL_LENGTH,
    FOCAL_LENGTH_RANGE,
    PIXEL_PITCH,
    BlurOptions,
    RandomBlur,
    convolve,
)
from kcam.augmentation.optics.defocus import RandomDefocus
from kcam.augmentation.optics.glare import RandomVeilingGlare
from kcam.augmentation.optics.vignetting import RandomVignetting

__all__ = [
    "DESIGN", "FOCAL_LENGTH", "FOCAL_LENGTH_RANGE", "LEAST_VERGENCE", "PIXEL_PITCH", "BlurOptions", "FocusedBlur",
    "RandomAberration", "RandomBlur", "RandomChromaticAberration", "RandomDefocus", "RandomDiffraction",
    "RandomVeilingGlare", "RandomVignetting", "convolve", "finite_vergence", "magnify",
]  # fmt: skip
