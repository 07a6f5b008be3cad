"""Diffractive elements: a phase at a design wavelength, dispersed by equation (3.8)."""

from __future__ import annotations

import torch
from torch import Tensor

from kcam.optics.elements.element import Element, Term, check_map, check_vector, set_tensor
from kcam.optics.elements.materials import refractive_index
from kcam.optics.elements.zernike import zernike_sum
from kcam.optics.numerics import float64
from kcam.optics.pupil.coordinates import Pupil
from kcam.optics.pupil.maps import PixelMap
from kcam.ste import round_ste
from kcam.units import DOE_PITCH_RANGE, check_length, wavelength_grid


class DOE(Element):
    """A diffractive element as a map of flat square pixels, equation (3.8).

    phi_lambda = lambda0 (n_lambda - 1) / (lambda (n_lambda0 - 1)) phi_lambda0.

    Args:
        phase: (n, n) at the design wavelength [rad], wrapped or not; rows along +y, columns along +x; a Parameter
        trains. design_wavelength: lambda0 [m]. glass: name or index.
        pitch: of the map's pixels [m]; None: the map spans the aperture's bounding square. A map that ends inside the
            aperture goes on with its outermost pixels to the rim; of one that reaches beyond it the rest is unused.
        levels: heights that a fab can etch in one wave of phase; None: continuous. The gradient passes straight
            through.
    Raises:  ValueError for a map that is not square or not finite, levels < 2, a wavelength not in metres, a pitch
        outside 1e-8..0.05 m.

    Example:
    >>> doe = optics.DOE((20 * torch.linspace(-1, 1, 64)).expand(64, 64))  # a prism of 20 rad at the rim
    >>> lens = optics.Lens(optics.SquareAperture(2 * mm), optics.ThinLens(50 * mm), doe, focus_distance=math.inf)
    >>> psf = lens.psf([550 * nm], distances=math.inf, pixel_pitch=8 * um, shape=(33, 33))
    >>> int(psf[0, 0, 16].argmax()) - 16  # 50 mm * 550 nm * 20 / (2 pi mm) is 88 um
    11
    """

    phase: Tensor

    def __init__(
        self,
        phase: Tensor,
        *,
        design_wavelength: float = 550e-9,
        glass: str | float = "fused silica",
        pitch: float | None = None,
        levels: int | None = None,
    ) -> None:
        super().__init__()
        check_map(phase, name="phase")
        if pitch is not None:
            check_length(pitch, name="pitch", within=DOE_PITCH_RANGE, example="10 * um")
        if levels is not None and not (isinstance(levels, int) and levels >= 2):
            raise ValueError(f"levels must be an integer >= 2 (heights per wave), got {levels!r}.")
        diffractive_factors(design_wavelength, glass, wavelength_grid([550e-9]))
        set_tensor(self, "phase", phase)
        self.design_wavelength = float(design_wavelength)
        self.glass, self.pitch, self.levels = glass, pitch, levels

    def pixel_map(self, wavelengths: Tensor) -> PixelMap:
        phase = self.phase
        if self.levels is not None:
            step = 2 * torch.pi / self.levels
            phase = round_ste(phase / step) * step
        half_width = None if self.pitch is None else self.pitch * self.phase.shape[-1] / 2
        return PixelMap(phase, half_width, diffractive_factors(self.design_wavelength, self.glass, wavelengths))

    def height_map(self) -> Tensor:
        """Height of the profile [m]: phase * lambda0 / (2 pi (n_lambda0 - 1)), equation (3.6)."""
        design = wavelength_grid([self.design_wavelength])
        index = float(refractive_index(self.glass, wavelengths=design))
        return self.pixel_map(design).values * (self.design_wavelength / (2 * torch.pi * (index - 1)))


class ZernikeDOE(Element):
    """A smooth diffractive element as Zernike coefficients, dispersed by equation (3.8).

    Args:
        coefficients: (K,) of Noll's j = 1..K at the design wavelength [rad RMS]; a Parameter trains.
        design_wavelength: [m]. glass: name or index.
    Raises: ValueError for coefficients that are no vector or not finite.
    Source: Noll, J. Opt. Soc. Am. 66, 207 (1976); normalised on the circle of the semi-aperture.

    Example:
    >>> tilt = optics.ZernikeDOE(torch.tensor([0.0, 5.0]))  # Z2 = 2 x: 10 rad at the rim
    >>> lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(50 * mm), tilt, focus_distance=math.inf)
    >>> psf = lens.psf([550 * nm], distances=math.inf, pixel_pitch=4 * um, shape=(33, 33))
    >>> int(psf[0, 0, 16].argmax()) - 16  # 50 mm * 550 nm * 10 / (2 pi mm) is 44 um
    11
    """

    coefficients: Tensor

    def __init__(
        self, coefficients: Tensor, *, design_wavelength: float = 550e-9, glass: str | float = "fused silica"
    ) -> None:
        super().__init__()
        check_vector(coefficients, name="coefficients")
        diffractive_factors(design_wavelength, glass, wavelength_grid([550e-9]))
        set_tensor(self, "coefficients", coefficients)
        self.design_wavelength, self.glass = float(design_wavelength), glass

    def terms(self, pupil: Pupil, wavelengths: Tensor) -> list[Term]:
        phase = zernike_sum(self.coefficients, pupil)
        factors = diffractive_factors(self.design_wavelength, self.glass, wavelengths)
        return [(factors * wavelengths / (2 * torch.pi), phase)]


class RadialDOE(Element):
    """A rotationally symmetric diffractive element: phase at equally spaced radii, dispersed by equation (3.8).

    Between the samples a cubic through the neighbours (Catmull-Rom), so that the slope is continuous.

    Args:
        profile: (n,), n >= 4, phase at radii 0 .. semi-aperture at the design wavelength [rad]; a Parameter trains.
        design_wavelength: [m]. glass: name or index.
    Raises: ValueError for a profile shorter than 4 or not finite.

    Example:
    >>> r = torch.linspace(0, 1, 200) * mm
    >>> parts = optics.RadialDOE(-math.pi * r**2 / (550 * nm * 100 * mm)), optics.ThinLens(100 * mm)  # one focal length
    >>> lenses = (optics.Lens(optics.CircularAperture(2 * mm), part, sensor_distance=100 * mm) for part in parts)
    >>> one, other = (lens.psf([550 * nm], distances=math.inf, pixel_pitch=4 * um, shape=(17, 17)) for lens in lenses)
    >>> torch.allclose(one, other, atol=1e-5)
    True
    """

    symmetric = True
    profile: Tensor

    def __init__(
        self, profile: Tensor, *, design_wavelength: float = 550e-9, glass: str | float = "fused silica"
    ) -> None:
        super().__init__()
        check_vector(profile, name="profile")
        if profile.numel() < 4:
            raise ValueError(f"profile needs at least 4 radii from 0 to the rim, got {profile.numel()}.")
        diffractive_factors(design_wavelength, glass, wavelength_grid([550e-9]))
        set_tensor(self, "profile", profile)
        self.design_wavelength, self.glass = float(design_wavelength), glass

    @property
    def knots(self) -> Tensor:  # type: ignore[override]
        """The radii of the profile."""
        return torch.linspace(0, 1, self.profile.numel(), dtype=torch.float64)

    def terms(self, pupil: Pupil, wavelengths: Tensor) -> list[Term]:
        factors = diffractive_factors(self.design_wavelength, self.glass, wavelengths)
        return [
            (
                factors * wavelengths / (2 * torch.pi),
                _radial_cubic(float64(self.profile).to(pupil.rho2.device), pupil),
            )
        ]


def diffractive_factors(design_wavelength: float, glass: str | float, wavelengths: Tensor) -> Tensor:
    """phi_lambda / phi_lambda0 of equation (3.8), (L,)."""
    design = wavelength_grid([design_wavelength])
    design_index = refractive_index(glass, wavelengths=design).to(wavelengths.device)
    index = refractive_index(glass, wavelengths=wavelengths)
    return float(design) * (index - 1) / (wavelengths * (design_index - 1))


def _radial_cubic(profile: Tensor, pupil: Pupil) -> Tensor:
    """Catmull-Rom interpolation of a profile over rho in [0, 1], mirrored at the axis.

    Beyond the rim it is held, as in the corners of a square aperture; of a round one only low-passed edges are left
    there, which ask for a path that goes on as it ends.
    """
    n = profile.numel()
    # the floor keeps d rho / d rho2 finite on the axis, where the mirrored profile is flat anyway
    position = torch.sqrt(torch.clamp(pupil.rho2, min=1e-24)) * (n - 1)
    low = torch.clamp(position.detach().floor().long(), max=n - 2)
    t = torch.clamp(position - low, max=1.0)
    padded = torch.cat([profile[1:2], profile, (2 * profile[-1:] - profile[-2:-1])])
    p0, p1, p2, p3 = (padded[low + i] for i in range(4))
    cubic = p1 + t / 2 * (p2 - p0 + t * (2 * p0 - 5 * p1 + 4 * p2 - p3 + t * (3 * (p1 - p2) + p3 - p0)))
    if not pupil.round:
        return cubic
    return cubic + (profile[-1] - profile[-2]) * torch.clamp(position - (n - 1), min=0)
