"""Thin elements of a lens. Each says what optical path it adds and what it transmits, in one common pupil plane.

An element's OPD is a vergence times r^2 / 2 plus `terms`, a list of (coefficient of each wavelength, map over the
pupil): vergences are summed as float64 scalars, because in focus they cancel to nothing while each alone is thousands
of radians.
Pixel maps cannot be sampled like smooth paths; they come as `PixelMap` and pass a low-pass of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from kcam.context import arguments_text
from kcam.optics.materials import refractive_index
from kcam.optics.pupil import Pupil
from kcam.ste import round_ste
from kcam.units import DOE_PITCH_RANGE, LEAST_DISTANCE, as_numbers, check_length, check_positive, wavelength_grid

Term = tuple[Tensor, Tensor]  # coefficients (L,), map over the pupil [the product is an OPD in metres]
Scalar = float | Tensor


@dataclass(frozen=True)
class PixelMap:
    """A map of flat square pixels over the pupil: a phase (times `factors`) or a transmission.

    values: (n, n), phase [rad] where `factors` (L,) is given, else transmission of the amplitude.
    half_width: half the map's width [m], or None where it spans the aperture's bounding square.
    """

    values: Tensor
    half_width: Scalar | None
    factors: Tensor | None

    def largest_phase(self) -> Tensor:
        """A phase at the wavelength that it is largest at, (n, n) float64 [rad], without a gradient."""
        scale = 1.0 if self.factors is None else float(self.factors.max())
        return self.values.detach().to(torch.float64) * scale

    def steps(self) -> tuple[Tensor, Tensor]:
        """What `largest_phase` steps by between neighbours, down and across, wrapped into [-pi, pi) [rad]."""
        down, across = (self.largest_phase().diff(dim=dim) for dim in (0, 1))
        return _wrapped(down), _wrapped(across)


def _wrapped(phase: Tensor) -> Tensor:
    return torch.remainder(phase + torch.pi, 2 * torch.pi) - torch.pi


def set_scalar(module: nn.Module, name: str, value: Scalar) -> None:
    """Store a scalar under its own name: a Parameter trains, a tensor is a buffer, a number stays a float64 number."""
    if isinstance(value, nn.Parameter):
        module.register_parameter(name, value)
    elif isinstance(value, Tensor):
        module.register_buffer(name, value)
    else:
        setattr(module, name, float(value))


def float64(value: Scalar) -> Tensor:
    """A number or tensor as a float64 tensor, its gradient kept."""
    return torch.as_tensor(value, dtype=torch.float64)


class Element(nn.Module):
    """A thin element of a lens. Subclasses override what they do; by default an element does nothing.

    A subclass whose terms are rotationally symmetric says `symmetric = True` beside them: then a Hankel transform may
    take the place of the grid, and one quadrant that of four. `knots` are the radii, relative to the semi-aperture,
    between which symmetric terms are smooth: () where they are smooth everywhere, and None where that is not known, as
    for terms of a subclass that does not say. Then the values tell, halved panel by panel; gradients to more than 500
    rings need the knots.

    What the methods of one's own class read cannot be known, so PSFs of a lens that has one are computed anew for each
    picture. A class that says `pure = True` in its own body promises that all its methods, inherited ones too, are a
    function of their arguments and of what the element and its class hold (parameters, numbers, arrays, lists, modules
    that are torch's or promise the same), that they read no global, file or clock, and draw nothing. PSFs are then kept
    until something held has another value: see `kcam.cache`.
    """

    symmetric = False  # rotationally, by its type: never decided from values, whose gradient need not be symmetric
    knots: Sequence[float] | Tensor | None = ()
    focuses = True  # whether its vergence counts when the sensor is put in focus; a deliberate defocus must not

    def __init_subclass__(cls, **arguments: Any) -> None:
        """Terms of its own are neither symmetric nor smooth until the subclass says so: what it inherits was said of
        others.
        """
        super().__init_subclass__(**arguments)
        if "terms" in vars(cls):
            cls.symmetric = vars(cls).get("symmetric", False)
            cls.knots = vars(cls).get("knots")

    def vergence(self, wavelengths: Tensor) -> Tensor:
        """Coefficient of r^2 / 2 in the OPD, (L,) float64 [1/m]; a converging lens has -1 / f."""
        return torch.zeros_like(wavelengths)

    def terms(self, pupil: Pupil, wavelengths: Tensor) -> list[Term]:
        """The rest of the OPD."""
        return []

    def pixel_map(self, wavelengths: Tensor) -> PixelMap | None:
        """What this element does in flat pixels, or None."""
        return None

    def check(self) -> None:
        """ValueError where training or loading brought in what the constructor refuses, beside NaN."""

    def extra_repr(self) -> str:
        """The arguments."""
        return arguments_text(self)


class Aperture(Element):
    """An element that bounds the pupil. Every lens has exactly one."""

    def semi_aperture(self) -> Tensor:
        """Half the width of the bounding square [m], 0-d float64."""
        raise NotImplementedError

    def discs(self) -> tuple[tuple[float, float], ...]:
        """The transmission as (radius relative to the semi-aperture, weight) of discs; empty where it is a pixel
        map.
        """
        return ()

    def open_share(self) -> float | Tensor:
        """Open area relative to the bounding square."""
        raise NotImplementedError

    def rim_per_area(self) -> float:
        """Length of the rim over the open area [1/m]: what diffracts light into the tails of a PSF."""
        raise NotImplementedError


class CircularAperture(Aperture):
    """A round stop.

    Args:    diameter: [m], > 0; may be a Parameter.
    Raises:  ValueError for a diameter that is not > 0, or is above 1 m (millimetres by mistake).
    """

    symmetric = True
    diameter: Scalar

    def __init__(self, diameter: Scalar) -> None:
        super().__init__()
        _check_aperture(diameter, name="diameter")
        set_scalar(self, "diameter", diameter)

    def semi_aperture(self) -> Tensor:
        return float64(self.diameter) / 2

    def discs(self) -> tuple[tuple[float, float], ...]:
        return ((1.0, 1.0),)

    def open_share(self) -> float:
        return torch.pi / 4

    def rim_per_area(self) -> float:
        return 2 / float(self.semi_aperture().detach())


class AnnularAperture(Aperture):
    """A round stop with a central obstruction.

    Args:    diameter: outer diameter [m]; obscuration: inner over outer diameter, 0 <= obscuration < 1.
    Raises:  ValueError outside these ranges.
    """

    symmetric = True
    diameter: Scalar

    def __init__(self, diameter: Scalar, *, obscuration: float) -> None:
        super().__init__()
        _check_aperture(diameter, name="diameter")
        if not 0 <= obscuration < 1:
            raise ValueError(f"obscuration {obscuration:g} must be in [0, 1): inner over outer diameter.")
        set_scalar(self, "diameter", diameter)
        self.obscuration = float(obscuration)

    def semi_aperture(self) -> Tensor:
        return float64(self.diameter) / 2

    def discs(self) -> tuple[tuple[float, float], ...]:
        # below 1e-8 its area is beyond float64's digits, and far below, 1 / obscuration^2 overflows
        return ((1.0, 1.0), (self.obscuration, -1.0)) if self.obscuration > 1e-8 else ((1.0, 1.0),)

    def open_share(self) -> float:
        return torch.pi / 4 * (1 - self.obscuration**2)

    def rim_per_area(self) -> float:
        return 2 / (float(self.semi_aperture().detach()) * (1 - self.obscuration))


class SquareAperture(Aperture):
    """A square stop with sides along x and y.

    Args:    width: [m], > 0; may be a Parameter.
    Raises:  ValueError for a width that is not > 0, or is above 1 m.
    """

    width: Scalar

    def __init__(self, width: Scalar) -> None:
        super().__init__()
        _check_aperture(width, name="width")
        set_scalar(self, "width", width)

    def semi_aperture(self) -> Tensor:
        return float64(self.width) / 2

    def pixel_map(self, wavelengths: Tensor) -> PixelMap:
        return PixelMap(torch.ones(1, 1, dtype=torch.float64), half_width=None, factors=None)

    def open_share(self) -> float:
        return 1.0

    def rim_per_area(self) -> float:
        return 2 / float(self.semi_aperture().detach())


class ApertureMap(Aperture):
    """A stop of any shape: amplitude transmission on flat square pixels (a coded aperture, an apodiser).

    Args:
        transmission: (n, n) in [0, 1], rows along +y, columns along +x; a Parameter trains.
        width: side of the square that the map spans [m].
    Raises: ValueError for a map that is not square, leaves [0, 1], has NaN, or is closed everywhere.
    """

    transmission: Tensor
    width: Scalar

    def __init__(self, transmission: Tensor, *, width: Scalar) -> None:
        super().__init__()
        _check_aperture(width, name="width")
        _check_map(transmission, name="transmission")
        set_tensor(self, "transmission", transmission)
        set_scalar(self, "width", width)
        self.check()

    def check(self) -> None:
        low, high = (float(value) for value in self.transmission.detach().aminmax())
        if low < 0 or high > 1:
            raise ValueError(
                f"transmission must be in [0, 1], got {low:g}..{high:g}; divide by its maximum, and where it trains, "
                "clamp_(0, 1) it after each step."
            )
        if high == 0:
            raise ValueError("transmission is 0 everywhere: no light passes this aperture. Open at least one pixel.")

    def semi_aperture(self) -> Tensor:
        return float64(self.width) / 2

    def pixel_map(self, wavelengths: Tensor) -> PixelMap:
        return PixelMap(self.transmission, half_width=None, factors=None)

    def open_share(self) -> Tensor:
        return float64(self.transmission).square().mean()

    def rim_per_area(self) -> float:
        closed = torch.nn.functional.pad(float64(self.transmission.detach()), (1, 1, 1, 1))
        rim = sum(float(closed.diff(dim=dim).square().sum()) for dim in (0, 1))  # a step of T diffracts T^2
        side = 2 * float(self.semi_aperture().detach())
        return rim / (float(float64(self.transmission.detach()).square().sum()) * side / self.transmission.shape[-1])


class ThinLens(Element):
    """An ideal thin lens: achromatic, and free of aberration at the distance that it is focused on.

    OPD = -r^2 / 2f, and beyond the paraxial range minus what the two spherical waves of the focused pair of points have
    beyond their parabolas. At other distances the non-paraxial terms leave the aberration that a real lens cannot
    avoid.

    Args:    focal_length: [m], not 0; negative for a diverging lens; may be a Parameter.
    Raises:  ValueError for 0, NaN or inf, or above 10 m (millimetres by mistake; a tenth of a dioptre is a `Defocus`).
    """

    symmetric, knots = True, ()
    focal_length: Scalar

    def __init__(self, focal_length: Scalar) -> None:
        super().__init__()
        as_numbers(focal_length, name="focal_length", expected="a number of metres such as 50 * mm")
        set_scalar(self, "focal_length", focal_length)
        self.check()
        _check_not_flat(float(float64(focal_length).detach()), name="focal_length")

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
    Valid when the lens is thin: the ray's shift inside the glass is neglected.
    Source:  Goodman, Introduction to Fourier Optics, 3rd ed., section 5.1; thesis (3.7).
    """

    symmetric, knots = True, ()
    radius_of_curvature: Scalar

    def __init__(self, radius_of_curvature: Scalar, *, glass: str | float = "N-BK7") -> None:
        super().__init__()
        check_positive(radius_of_curvature, name="radius_of_curvature")
        _check_not_flat(float(float64(radius_of_curvature).detach()), name="radius_of_curvature")
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
        _check_map(phase, name="phase")
        if pitch is not None:
            check_length(pitch, name="pitch", within=DOE_PITCH_RANGE, example="10 * um")
        if levels is not None and not (isinstance(levels, int) and levels >= 2):
            raise ValueError(f"levels must be an integer >= 2 (heights per wave), got {levels!r}.")
        _diffractive_factors(design_wavelength, glass, wavelength_grid([550e-9]))
        set_tensor(self, "phase", phase)
        self.design_wavelength = float(design_wavelength)
        self.glass, self.pitch, self.levels = glass, pitch, levels

    def pixel_map(self, wavelengths: Tensor) -> PixelMap:
        phase = self.phase
        if self.levels is not None:
            step = 2 * torch.pi / self.levels
            phase = round_ste(phase / step) * step
        half_width = None if self.pitch is None else self.pitch * self.phase.shape[-1] / 2
        return PixelMap(phase, half_width, _diffractive_factors(self.design_wavelength, self.glass, wavelengths))

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
    """

    coefficients: Tensor

    def __init__(
        self, coefficients: Tensor, *, design_wavelength: float = 550e-9, glass: str | float = "fused silica"
    ) -> None:
        super().__init__()
        _check_vector(coefficients, name="coefficients")
        _diffractive_factors(design_wavelength, glass, wavelength_grid([550e-9]))
        set_tensor(self, "coefficients", coefficients)
        self.design_wavelength, self.glass = float(design_wavelength), glass

    def terms(self, pupil: Pupil, wavelengths: Tensor) -> list[Term]:
        phase = zernike_sum(self.coefficients, pupil)
        factors = _diffractive_factors(self.design_wavelength, self.glass, wavelengths)
        return [(factors * wavelengths / (2 * torch.pi), phase)]


class ZernikeAberration(Element):
    """Aberrations of the lens as Zernike coefficients of OPD, the same at all wavelengths.

    Args:   coefficients: (K,) of Noll's j = 1..K [m RMS]; a Parameter trains.
    Raises: ValueError for coefficients that are no vector or not finite.
    Source: Noll, J. Opt. Soc. Am. 66, 207 (1976).
    """

    coefficients: Tensor

    def __init__(self, coefficients: Tensor) -> None:
        super().__init__()
        _check_vector(coefficients, name="coefficients")
        set_tensor(self, "coefficients", coefficients)

    def terms(self, pupil: Pupil, wavelengths: Tensor) -> list[Term]:
        return [(torch.ones_like(wavelengths), zernike_sum(self.coefficients, pupil))]


class RadialDOE(Element):
    """A rotationally symmetric diffractive element: phase at equally spaced radii, dispersed by equation (3.8).

    Between the samples a cubic through the neighbours (Catmull-Rom), so that the slope is continuous.

    Args:
        profile: (n,), n >= 4, phase at radii 0 .. semi-aperture at the design wavelength [rad]; a Parameter trains.
        design_wavelength: [m]. glass: name or index.
    Raises: ValueError for a profile shorter than 4 or not finite.
    """

    symmetric = True
    profile: Tensor

    def __init__(
        self, profile: Tensor, *, design_wavelength: float = 550e-9, glass: str | float = "fused silica"
    ) -> None:
        super().__init__()
        _check_vector(profile, name="profile")
        if profile.numel() < 4:
            raise ValueError(f"profile needs at least 4 radii from 0 to the rim, got {profile.numel()}.")
        _diffractive_factors(design_wavelength, glass, wavelength_grid([550e-9]))
        set_tensor(self, "profile", profile)
        self.design_wavelength, self.glass = float(design_wavelength), glass

    @property
    def knots(self) -> Tensor:  # type: ignore[override]
        """The radii of the profile."""
        return torch.linspace(0, 1, self.profile.numel(), dtype=torch.float64)

    def terms(self, pupil: Pupil, wavelengths: Tensor) -> list[Term]:
        factors = _diffractive_factors(self.design_wavelength, self.glass, wavelengths)
        return [
            (
                factors * wavelengths / (2 * torch.pi),
                _radial_cubic(float64(self.profile).to(pupil.rho2.device), pupil),
            )
        ]


def set_tensor(module: nn.Module, name: str, value: Tensor) -> None:
    """Register a Parameter as such and any other tensor as a buffer."""
    if isinstance(value, nn.Parameter):
        module.register_parameter(name, value)
    else:
        module.register_buffer(name, value)


def _diffractive_factors(design_wavelength: float, glass: str | float, wavelengths: Tensor) -> Tensor:
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


def noll_indices(j: int) -> tuple[int, int]:
    """(n, m) of Noll's single index j >= 1; m < 0 for the sine terms."""
    n = 0
    while (n + 1) * (n + 2) // 2 < j:
        n += 1
    rest = j - n * (n + 1) // 2 - 1
    m = (-1) ** j * ((n % 2) + 2 * ((rest + (n + 1) % 2) // 2))
    return n, m


def zernike_sum(coefficients: Tensor, pupil: Pupil) -> Tensor:
    """sum_j c_j Z_j over the pupil, Noll-normalised (unit variance on the unit circle), float64.

    Z = sqrt(n + 1) [sqrt 2] rho^|m| R'(rho^2) cos or sin(m theta), with rho^|m| exp(i m theta) = (x + iy)^|m|: a
    polynomial, so value and gradient are finite on the axis.
    """
    total = torch.zeros_like(pupil.rho2)
    rho2 = pupil.rho2
    x, y = torch.broadcast_tensors(pupil.x, pupil.y)
    powers = {0: (torch.ones_like(rho2), torch.zeros_like(rho2))}
    for index, coefficient in enumerate(float64(coefficients).unbind()):
        n, m = noll_indices(index + 1)
        order = abs(m)
        for k in range(1, order + 1):
            if k not in powers:
                re, im = powers[k - 1]
                powers[k] = (re * x - im * y, re * y + im * x)
        radial = torch.zeros_like(rho2)
        term = 1.0  # coefficients of R_n^m by their ratio, highest power first (Horner)
        half = (n - order) // 2
        for s in range(half + 1):
            radial = radial * rho2 + term
            term *= -((n - s - half) * (half - s)) / ((s + 1) * (n - s)) if n > s else 0.0
        scale = _zernike_scale(n, m)
        total = total + coefficient.to(rho2.device) * scale * radial * powers[order][1 if m < 0 else 0]
    return total


def _zernike_scale(n: int, m: int) -> float:
    """Leading coefficient of R_n^m times Noll's normalisation."""
    order = abs(m)
    leading = 1.0
    half_sum, half_difference = (n + order) // 2, (n - order) // 2
    for i in range(1, half_difference + 1):  # binomial(n, half_difference) = n! / (half_sum! half_difference!)
        leading *= (half_sum + i) / i
    return leading * (n + 1) ** 0.5 * (2**0.5 if m else 1.0)


def _check_map(values: Tensor, *, name: str) -> None:
    if not isinstance(values, Tensor) or not values.is_floating_point():
        raise TypeError(f"{name} must be a floating-point tensor (n, n), got {_describe(values)}.")
    if values.ndim != 2 or values.shape[0] != values.shape[1] or values.numel() == 0:
        raise ValueError(f"{name} must be square (n, n) with n >= 1, got shape {tuple(values.shape)}.")
    _check_finite(values, name=name)


def _check_vector(values: Tensor, *, name: str) -> None:
    if not isinstance(values, Tensor) or not values.is_floating_point():
        raise TypeError(f"{name} must be a floating-point tensor (K,), got {_describe(values)}.")
    if values.ndim != 1 or values.numel() == 0:
        raise ValueError(f"{name} must be a vector (K,) with K >= 1, got shape {tuple(values.shape)}.")
    _check_finite(values, name=name)


def _check_finite(values: Tensor, *, name: str) -> None:
    bad = int((~torch.isfinite(values)).sum())
    if bad:
        raise ValueError(
            f"{name} has {bad} values that are NaN or infinite; expected finite ones everywhere. Use "
            f"torch.nan_to_num({name})."
        )


def _check_aperture(value: Scalar, *, name: str) -> None:
    check_positive(value, name=name)
    metres = float(float64(value).detach())
    if metres > 1:
        raise ValueError(f"{name} {metres:g} m is no aperture. Lengths are in metres; did you mean {metres:g} * mm?")


def _check_not_flat(metres: float, *, name: str) -> None:
    """Beyond 10 m a lens of camera size does nothing that a `Defocus` would not."""
    if abs(metres) > 10:
        raise ValueError(
            f"{name} {metres:g} m is beyond 10 m. Lengths are in metres; did you mean {metres:g} * mm? For a power "
            "as weak as that use Defocus(vergence)."
        )


def _describe(value: object) -> str:
    return f"{value.dtype} tensor" if isinstance(value, Tensor) else type(value).__name__
