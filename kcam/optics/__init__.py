"""Wave optics: from a point of light to its image on the sensor, and from a scene to the light in each pixel."""

from kcam.optics.batch import batch_psf
from kcam.optics.elements import (
    DOE,
    AnnularAperture,
    ApertureMap,
    CircularAperture,
    Defocus,
    Element,
    PlanoConvexLens,
    RadialDOE,
    SquareAperture,
    ThinLens,
    ZernikeAberration,
    ZernikeDOE,
)
from kcam.optics.imaging import Imaging
from kcam.optics.lens import Lens
from kcam.optics.materials import GLASSES, refractive_index
from kcam.optics.propagation import PROPAGATORS

__all__ = [
    "DOE",
    "GLASSES",
    "PROPAGATORS",
    "AnnularAperture",
    "ApertureMap",
    "CircularAperture",
    "Defocus",
    "Element",
    "Imaging",
    "Lens",
    "PlanoConvexLens",
    "RadialDOE",
    "SquareAperture",
    "ThinLens",
    "ZernikeAberration",
    "ZernikeDOE",
    "batch_psf",
    "refractive_index",
]
