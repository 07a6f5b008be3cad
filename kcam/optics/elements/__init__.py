"""Thin elements of a lens: what optical path each adds, and what it transmits, in one common pupil plane."""

from kcam.optics.elements.apertures import AnnularAperture, Aperture, ApertureMap, CircularAperture, SquareAperture
from kcam.optics.elements.diffractive import DOE, RadialDOE, ZernikeDOE
from kcam.optics.elements.element import Element, Term
from kcam.optics.elements.refractive import Defocus, PlanoConvexLens, ThinLens
from kcam.optics.elements.wavefront import MeasuredPupil
from kcam.optics.elements.zernike import ZernikeAberration, noll_indices, zernike_sum
from kcam.optics.pupil.maps import PixelMap

__all__ = [
    "DOE",
    "AnnularAperture",
    "Aperture",
    "ApertureMap",
    "CircularAperture",
    "Defocus",
    "Element",
    "MeasuredPupil",
    "PixelMap",
    "PlanoConvexLens",
    "RadialDOE",
    "SquareAperture",
    "Term",
    "ThinLens",
    "ZernikeAberration",
    "ZernikeDOE",
    "noll_indices",
    "zernike_sum",
]
