"""Stops: what bounds the pupil, as discs or as a map of pixels."""

from __future__ import annotations

import torch
from torch import Tensor

from kcam.optics.elements.element import Element, check_map, set_scalar, set_tensor
from kcam.optics.numerics import Scalar, float64
from kcam.optics.pupil.maps import PixelMap
from kcam.units import check_positive


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

    Example:
    >>> lens = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), focus_distance=math.inf)
    >>> psf = lens.psf([550 * nm], distances=math.inf, pixel_pitch=0.1 * um, shape=(161, 161), integrate=False)
    >>> round(float(psf[0, 0, 80, 80:].argmin()) * 0.1, 1)  # um; Airy's first dark ring: 1.22 lambda N
    6.7
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

    Example:
    >>> aperture = optics.AnnularAperture(10 * mm, obscuration=0.5)
    >>> round(aperture.open_share() / optics.CircularAperture(10 * mm).open_share(), 2)
    0.75
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

    Example:
    >>> lens = optics.Lens(optics.SquareAperture(5 * mm), optics.ThinLens(50 * mm), focus_distance=math.inf)
    >>> psf = lens.psf([550 * nm], distances=math.inf, pixel_pitch=0.5 * um, shape=(33, 33), integrate=False)
    >>> float(psf[0, 0, 16, 16:].argmin()) * 0.5  # um; the first zero of sinc^2 is at lambda N
    5.5
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

    Example:
    >>> diagonal = optics.ApertureMap(torch.eye(4), width=5 * mm)  # a coded aperture, a quarter of it open
    >>> float(diagonal.open_share())
    0.25
    """

    transmission: Tensor
    width: Scalar

    def __init__(self, transmission: Tensor, *, width: Scalar) -> None:
        super().__init__()
        _check_aperture(width, name="width")
        check_map(transmission, name="transmission")
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
        closed = torch.nn.functional.pad(self.transmission.detach(), (1, 1, 1, 1))
        return rim_per_area(closed, pitch=2 * float(self.semi_aperture().detach()) / self.transmission.shape[-1])


def rim_per_area(transmission: Tensor, *, pitch: float) -> float:
    """Length of the rims in a map of flat pixels over its open area [1/m]: a step of T diffracts T^2."""
    passed = float64(transmission)
    return sum(float(passed.diff(dim=dim).square().sum()) for dim in (0, 1)) / (float(passed.square().sum()) * pitch)


def _check_aperture(value: Scalar, *, name: str) -> None:
    check_positive(value, name=name)
    metres = float(float64(value).detach())
    if metres > 1:
        raise ValueError(f"{name} {metres:g} m is no aperture. Lengths are in metres; did you mean {metres:g} * mm?")
