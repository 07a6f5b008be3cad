"""Thin lenses of glass, ideal ones, and a change of focus."""

from __future__ import annotations

import torch
from torch import Tensor

from kcam.optics.elements.element import Element, Term, check_not_flat, set_scalar
from kcam.optics.elements.materials import refractive_index
from kcam.optics.numerics import Scalar, float64
from kcam.optics.pupil.coordinates import Pupil
from kcam.units import LEAST_DISTANCE, as_numbers, check_positive, wavelength_grid


class ThinLens(Element):
    """An ideal thin lens: achromatic, and free of aberration at the distance that it is focused on.

    OPD = -r^2 / 2f, and beyond the paraxial range minus what the two spherical waves of the focused pair of points have
    beyond their parabolas. At other distances the non-paraxial terms leave the aberration that a real lens cannot
    avoid.

    Args:    focal_length: [m], not 0; negative for a diverging lens; may be a Parameter.
    Raises:  ValueError for 0, NaN or inf, or above 10 m (millimetres by mistake; a tenth of a dioptre is a `Defocus`).

    Example:
    >>> lens = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), focus_distance=0.1)
    >>> f"{lens.sensor_distance / mm:.1f} mm"  # 2 f to 2 f
    '100.0 mm'
    """

    symmetric, knots = True, ()
    focal_length: Scalar

    def __init__(self, focal_length: Scalar) -> None:
        super().__init__()
        as_numbers(focal_length, name="focal_length", expected="a number of metres such as 50 * mm")
        set_scalar(self, "focal_length", focal_length)
        self.check()
        check_not_flat(float(float64(focal_length).detach()), name="focal_length")

    def check(self) -> None:
        value = float(float64(self.focal_length).detach())
        if value == 0 or value != value or abs(value) == float("inf"):
            raise ValueError(f"focal_length must be finite and not 0 m, got {value:g}. Use one such as 50 * mm.")
        if abs(value) < LEAST_DISTANCE:
            raise ValueError(
                f"focal_length {value:g} m is shorter than {LEAST_DISTANCE:g} m, than light itself. Use one such as "
                "50 * mm."
            )

    def vergence(self, wavelengths: Tensor) -> Tensor:
        return -1 / float64(self.focal_length).to(wavelengths.device) * torch.ones_like(wavelengths)

    def terms(self, pupil: Pupil, wavelengths: Tensor) -> list[Term]:
        image = 1 / pupil.sensor_distance
        source = 1 / float64(self.focal_length).to(image.device) - image
        return [(torch.ones_like(wavelengths), -pupil.beyond_paraxial(image) - pupil.beyond_paraxial(source))]


class PlanoConvexLens(Element):
    """A thin plano-convex lens with a spherical surface, equation (3.7): OPD = (n - 1) (sqrt(R^2 - r^2) - R).

    Split into -(n - 1) r^2 / 2R and its spherical aberration -(n - 1) r^4 / (2 R (R + sqrt(R^2 - r^2))^2), which does
    not cancel.

    Args:
        radius_of_curvature: R [m], > 0; may be a Parameter.
        glass: a name in `materials.GLASSES`, or a refractive index.
    Raises:  ValueError for R <= 0, R above 10 m (millimetres by mistake), an unknown glass, or (from `Lens`) an
        aperture that reaches R.
    Valid paraxially at any f-number. Its spherical aberration is that of one surface in the plane of the pupil: exact
    rays through a real one of N-BK7, however thin, have 0.46 of it with the curved side to a distant object and
    1.8 times with the flat one (Seidel). A `CompoundLens` has that.
    Source:  Goodman, Introduction to Fourier Optics, 3rd ed., section 5.1; thesis (3.7).

    Example:
    >>> lens = optics.Lens(optics.CircularAperture(5 * mm), optics.PlanoConvexLens(25.84 * mm), focus_distance=2.0)
    >>> f"{lens.focal_length(587.56 * nm) / mm:.2f} mm"  # R / (n - 1) with n_d = 1.5168
    '50.00 mm'
    """

    symmetric, knots = True, ()
    radius_of_curvature: Scalar

    def __init__(self, radius_of_curvature: Scalar, *, glass: str | float = "N-BK7") -> None:
        super().__init__()
        check_positive(radius_of_curvature, name="radius_of_curvature")
        check_not_flat(float(float64(radius_of_curvature).detach()), name="radius_of_curvature")
        refractive_index(glass, wavelengths=wavelength_grid([550e-9]))
        set_scalar(self, "radius_of_curvature", radius_of_curvature)
        self.glass = glass

    def vergence(self, wavelengths: Tensor) -> Tensor:
        index = refractive_index(self.glass, wavelengths=wavelengths)
        return -(index - 1) / float64(self.radius_of_curvature).to(wavelengths.device)

    def terms(self, pupil: Pupil, wavelengths: Tensor) -> list[Term]:
        radius = float64(self.radius_of_curvature).to(pupil.rho2.device)
        r2 = pupil.rho2 * pupil.semi_aperture**2
        # beyond the rim (r > R) the edge weights die away; the clamp keeps value and gradient finite there
        root = torch.sqrt(torch.clamp(radius**2 - r2, min=1e-6 * float(radius.detach()) ** 2))
        sag = r2**2 / (2 * radius * (radius + root) ** 2)
        return [(-(refractive_index(self.glass, wavelengths=wavelengths) - 1), sag)]


class Defocus(Element):
    """A pure change of focus: OPD = vergence * r^2 / 2, the same at all wavelengths; `focus_distance=` does not undo
    it.

    Args: vergence: [1/m], positive as if the object came nearer; may be a Parameter. W20 = vergence * a^2 / 2.

    Example:
    >>> parts = optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), optics.Defocus(0.5)
    >>> lens = optics.Lens(*parts, focus_distance=1.0)
    >>> psf = lens.psf([550 * nm], distances=[1.0, 2.0], pixel_pitch=4 * um, shape=(33, 33))
    >>> int(psf.amax((1, 2, 3)).argmax())  # the second is the sharp one: 1 / 2 + 0.5 is 1 / 1
    1
    """

    symmetric = True
    focuses = False
    added_vergence: Scalar

    def __init__(self, vergence: Scalar) -> None:
        super().__init__()
        value = float(float64(vergence).detach())
        if not abs(value) < float("inf"):
            raise ValueError(f"vergence must be a finite number of 1/m, got {value:g}.")
        set_scalar(self, "added_vergence", vergence)

    def configuration(self) -> dict[str, Scalar]:
        """Constructor arguments, for saving."""
        return {"vergence": self.added_vergence}

    def vergence(self, wavelengths: Tensor) -> Tensor:
        return float64(self.added_vergence).to(wavelengths.device) * torch.ones_like(wavelengths)
