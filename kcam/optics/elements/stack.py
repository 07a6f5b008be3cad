"""Thin elements in one pupil plane, at a distance from the sensor: what a lens is, before anything is asked of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor, nn

from kcam.cache import ValueCache, seen
from kcam.optics.elements.apertures import Aperture, rim_per_area
from kcam.optics.elements.diffractive import DOE
from kcam.optics.elements.element import Element, check_numbers, is_even, place_sensor
from kcam.optics.elements.refractive import PlanoConvexLens
from kcam.optics.numerics import Scalar, float64
from kcam.optics.pupil.maps import PixelMap, pixel_under
from kcam.units import check_positive, wavelength_grid

_FINE = 1024  # samples on each axis that an area is summed over
_SCATTERED = ValueCache()  # the last: each window asks how far pixels scatter
_ORDERS_LEFT_OUT = 3e-4  # share of the light in the grating orders of a pixel map that a default window leaves out


class ElementStack(nn.Module):
    """The elements, where the sensor is, and the numbers that follow from them paraxially; arguments: as of `Lens`."""

    elements: Sequence[Element]  # held by an nn.ModuleList
    sensor_distance: Scalar

    def __init__(
        self,
        *elements: Element,
        focus_distance: float | None = None,
        sensor_distance: Scalar | None = None,
        focus_wavelength: float = 550e-9,
    ) -> None:
        super().__init__()
        for element in elements:
            if not isinstance(element, Element):
                raise TypeError(f"a lens takes elements such as CircularAperture or DOE, got {type(element).__name__}.")
        apertures = [element for element in elements if isinstance(element, Aperture)]
        if len(apertures) != 1:
            raise ValueError(
                f"a lens has exactly one aperture, got {len(apertures)}; add CircularAperture(diameter=5 * mm) or "
                "remove all but one."
            )
        self.elements = nn.ModuleList(elements)  # type: ignore[assignment]
        self.focus_wavelength = float(wavelength_grid([focus_wavelength]))
        place_sensor(
            self,
            focus_distance=focus_distance,
            sensor_distance=sensor_distance,
            image_distance=self._sensor_distance_for,
        )
        self._check_curvature()

    def configuration(self) -> dict[str, object]:
        """Constructor arguments, for saving: the sensor's distance, which was set once, rather than the focus."""
        return {
            "elements": list(self.elements),
            "sensor_distance": self.sensor_distance,
            "focus_wavelength": self.focus_wavelength,
        }

    def extra_repr(self) -> str:
        """The sensor's place, for print()."""
        return f"sensor_distance={float(float64(self.sensor_distance).detach()):.6g}"

    @property
    def aperture(self) -> Aperture:
        """The element that bounds the pupil."""
        return next(element for element in self.elements if isinstance(element, Aperture))

    def aperture_alone(self, *, pixels: int | None = None) -> Self:
        """The same pupil at the same distance from the sensor, with nothing in it, or with a flat DOE of n pixels."""
        flat = [] if pixels is None else [DOE(torch.zeros(pixels, pixels))]
        return type(self)(self.aperture, *flat, sensor_distance=self.sensor_distance)

    @property
    def symmetric(self) -> bool:
        """Whether every element is rotationally symmetric by its type."""
        return all(element.symmetric for element in self.elements)

    @property
    def has_rings(self) -> bool:
        """Whether a rotationally symmetric path may have structure along the radius, by its type."""
        return any(e.symmetric and (e.knots is None or len(e.knots) > 0) for e in self.elements)

    @property
    def even(self) -> bool:
        """Whether no element's path tells x from -x and y from -y, by its type; maps of pixels may."""
        return all(map(is_even, self.elements))

    @property
    def round(self) -> bool:
        """Whether the rim of the aperture is a circle."""
        return bool(self.aperture.discs())

    @property
    def has_pixels(self) -> bool:
        """Whether an element is a map of flat pixels, a phase or a transmission."""
        return bool(self._maps)

    @property
    def has_pixel_phase(self) -> bool:
        """Whether an element has its phase on flat pixels, which has no slope."""
        return any(self._maps)

    @property
    def _maps(self) -> list[bool]:
        """Of each map of flat pixels, whether it is one of the phase."""

        def look() -> list[bool]:
            grid = wavelength_grid([self.focus_wavelength])
            return [pixels.factors is not None for pixels in self.pixel_maps(grid)]

        return seen(self, "maps", look)

    def pixel_maps(self, wavelengths: Tensor) -> list[PixelMap]:
        """The maps of flat pixels among the elements, for wavelengths (L,) [m], in the order of the light."""
        return [pixels for pixels in (e.pixel_map(wavelengths) for e in self.elements) if pixels is not None]

    def pixel_phase_displacement(self, wavelengths: Tensor) -> float:
        """How far flat pixels send all but a few 1e-4 of their light on the sensor [m].

        A step of delta radians between neighbours turns light by delta lambda d / 2 pi p, at most to the pixels'
        Nyquist angle; and flat pixels on a slope are a blazed grating, of whose light delta^2 / 2 pi^2 M lies beyond
        order M. Without a gradient.
        """
        if not self.has_pixel_phase:
            return 0.0
        with torch.no_grad():
            return _SCATTERED.get((self, wavelengths), lambda: self._pixel_phase_displacement(wavelengths))

    def _pixel_phase_displacement(self, wavelengths: Tensor) -> float:
        total = 0.0
        for pixels in self.pixel_maps(wavelengths):
            if pixels.factors is None or pixels.values.shape[-1] < 2:
                continue
            half_width = self.aperture.semi_aperture().detach() if pixels.half_width is None else pixels.half_width
            pitch = 2 * float(half_width) / pixels.values.shape[-1]
            steps = pixels.steps()
            sizes = torch.cat([step.abs().flatten() for step in steps])
            slope = float(sizes.kthvalue(math.ceil(0.999 * sizes.numel())).values) / (2 * torch.pi)
            lost = sum(float(step.square().mean()) for step in steps) / (2 * torch.pi**2)
            orders = math.ceil(lost / _ORDERS_LEFT_OUT) if lost > _ORDERS_LEFT_OUT else 0
            cycle = float(wavelengths.max()) * float(float64(self.sensor_distance).detach()) / pitch
            total += (slope + orders) * cycle
        return total

    def power(self, wavelengths: Tensor) -> Tensor:
        """Paraxial power at each wavelength, (L,) float64 [1/m], without any `Defocus`."""
        vergences = (element.vergence(wavelengths) for element in self.elements if element.focuses)
        return -sum(vergences, torch.zeros_like(wavelengths))

    def focal_length(self, wavelength: float | Tensor = 550e-9) -> float | Tensor:
        """Paraxial focal length [m]: a float for a float, (L,) float64 for wavelengths (L,); inf without power."""
        grid = wavelength_grid(wavelength if isinstance(wavelength, Tensor) else [wavelength])
        focal = 1 / self.power(grid).detach()
        return focal if isinstance(wavelength, Tensor) and wavelength.ndim else float(focal[0])

    @property
    def focus_distance(self) -> float:
        """Object distance that is imaged onto the sensor paraxially at `focus_wavelength`, without any `Defocus` [m];
        inf, or < 0 if virtual.
        """
        vergence = float(self.power(wavelength_grid([self.focus_wavelength])).detach()[0]) - 1 / float(
            float64(self.sensor_distance).detach()
        )
        # below 1e-9 1/m nothing tells the distance from infinity: 1e-14 waves in a 5 mm aperture
        return math.inf if abs(vergence) < 1e-9 else 1 / vergence

    @property
    def f_number(self) -> float:
        """Working f-number: sensor distance over the width of the aperture."""
        return float(float64(self.sensor_distance).detach() / (2 * self.aperture.semi_aperture().detach()))

    def aperture_area(self) -> float:
        """Open area of the aperture [m^2], to 1e-3 where a `MeasuredPupil` dims it."""
        side = 2 * float(self.aperture.semi_aperture().detach())
        area = side**2 * float(torch.as_tensor(self.aperture.open_share()).detach())
        return area * self._passed() if self._dimming() else area

    def rim_per_area(self) -> float:
        """Length of all rims over the open area [1/m]: what diffracts light into the tails of a PSF."""
        rims = self.aperture.rim_per_area()
        for pixels in self._dimming():
            half_width = torch.as_tensor(pixels.half_width).detach()
            rims += rim_per_area(pixels.values.detach(), pitch=2 * float(half_width) / pixels.values.shape[-1])
        return rims

    def _dimming(self) -> list[PixelMap]:
        """Maps of other elements than the aperture that let part of the light pass."""
        grid = wavelength_grid([self.focus_wavelength])
        maps = (element.pixel_map(grid) for element in self.elements if element is not self.aperture)
        return [pixels for pixels in maps if pixels is not None and pixels.factors is None]

    def _passed(self) -> float:
        """The share of the aperture's light that other elements let pass."""
        semi = self.aperture.semi_aperture().detach().cpu()
        axis = ((torch.arange(_FINE, dtype=torch.float64) + 0.5) * (2 / _FINE) - 1) * semi
        rho2 = (axis[:, None] ** 2 + axis**2) / semi**2
        light = torch.ones_like(rho2)
        if discs := self.aperture.discs():
            light = sum((weight * (rho2 <= radius**2) for radius, weight in discs), torch.zeros_like(rho2))
        own = self.aperture.pixel_map(wavelength_grid([self.focus_wavelength]))
        totals = []
        for pixels in ([] if own is None else [own], self._dimming()):
            for one in pixels:
                light = light * pixel_under(one.values.detach().to(axis), one.half_width, axis, semi) ** 2
            totals.append(float(light.sum()))
        return totals[1] / totals[0]

    def _sensor_distance_for(self, focus_distance: float) -> float:
        power = float(self.power(wavelength_grid([self.focus_wavelength])).detach()[0])
        if power <= 0:
            raise ValueError(
                f"this lens has a power of {power:g} 1/m at {self.focus_wavelength * 1e9:.4g} nm and cannot focus: add "
                "a ThinLens or a PlanoConvexLens, or give sensor_distance=."
            )
        image_vergence = power - 1 / focus_distance
        if image_vergence <= 0:
            raise ValueError(
                f"focus_distance {focus_distance:g} m is inside the focal length {1 / power:g} m: no real image. "
                f"Focus beyond {1 / power:g} m."
            )
        return 1 / image_vergence

    def check(self) -> None:
        """What the constructors refuse must not come in by an optimiser's step or a loaded file either."""
        check_numbers(self)
        for element in self.elements:
            element.check()
        check_positive(self.sensor_distance, name="sensor_distance")
        check_positive(self.aperture.semi_aperture(), name="semi-aperture")
        self._check_curvature()

    def _check_curvature(self) -> None:
        reach = float(self.aperture.semi_aperture().detach()) * (1 if self.round else math.sqrt(2))
        for element in self.elements:
            if not isinstance(element, PlanoConvexLens):
                continue
            radius = float(float64(element.radius_of_curvature).detach())
            if reach >= radius:
                raise ValueError(
                    f"the aperture reaches r = {reach:g} m, but the surface ends at its radius of curvature "
                    f"R = {radius:g} m (r >= R). Use an aperture below {2 * radius:g} m across or a larger R."
                )
