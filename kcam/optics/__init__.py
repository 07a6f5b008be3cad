"""Wave optics: from a point of light to its image on the sensor, and from a scene to the light in each pixel."""

from kcam.optics.accuracy import Accuracy
from kcam.optics.compound.lens import CompoundLens
from kcam.optics.compound.surface import Surface
from kcam.optics.elements import (
    DOE,
    AnnularAperture,
    ApertureMap,
    CircularAperture,
    Defocus,
    Element,
    MeasuredPupil,
    PlanoConvexLens,
    RadialDOE,
    SquareAperture,
    ThinLens,
    ZernikeAberration,
    ZernikeDOE,
)
from kcam.optics.elements.materials import GLASSES, Glass, refractive_index
from kcam.optics.glare import VeilingGlare, scattered_share, scattered_within, veiling_glare
from kcam.optics.imaging import Imaging
from kcam.optics.lens import Lens
from kcam.optics.measured import MeasuredPSF
from kcam.optics.propagation import textbook
from kcam.optics.propagation.batch import batch_psf
from kcam.optics.propagation.table import PROPAGATORS

__all__ = [
    "DOE",
    "GLASSES",
    "PROPAGATORS",
    "Accuracy",
    "AnnularAperture",
    "ApertureMap",
    "CircularAperture",
    "CompoundLens",
    "Defocus",
    "Element",
    "Glass",
    "Imaging",
    "Lens",
    "MeasuredPSF",
    "MeasuredPupil",
    "PlanoConvexLens",
    "RadialDOE",
    "SquareAperture",
    "Surface",
    "ThinLens",
    "VeilingGlare",
    "ZernikeAberration",
    "ZernikeDOE",
    "batch_psf",
    "refractive_index",
    "scattered_share",
    "scattered_within",
    "textbook",
    "veiling_glare",
]
