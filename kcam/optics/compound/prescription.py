"""A real lens as data: its surfaces, where the sensor stands behind them, and what both are paraxially."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from kcam.optics.compound.surface import Surface
from kcam.optics.compound.tracing import system_matrix
from kcam.optics.numerics import Scalar, float64
from kcam.units import wavelength_grid


@dataclass(frozen=True)
class FirstOrder:
    """Paraxial quantities at one wavelength [m]; positions are along the axis, of the entrance pupil from the first
    vertex and of the others from the last, positive behind it.
    """

    focal_length: Tensor
    back_focus: Tensor
    entrance_pupil: Tensor
    entrance_semi_diameter: Tensor
    exit_pupil: Tensor
    exit_semi_diameter: Tensor


@dataclass(frozen=True)
class Prescription:
    """Surfaces, one of them the stop; from the last vertex to the sensor [m], and the wavelength of focus [m]."""

    surfaces: Sequence[Surface]
    sensor_distance: Scalar
    focus_wavelength: float

    @property
    def stop(self) -> int:
        """Which surface is the aperture stop."""
        return next(k for k, surface in enumerate(self.surfaces) if surface.stop)

    @property
    def stop_semi_diameter(self) -> Tensor:
        """[m]."""
        return float64(self.surfaces[self.stop].semi_diameter).cpu()  # type: ignore[arg-type]

    @property
    def sensor_away(self) -> Tensor:
        """From the last vertex [m]."""
        return float64(self.sensor_distance).cpu()

    @property
    def focus_line(self) -> Tensor:
        """The wavelength of focus, (1,) [m]."""
        return wavelength_grid([self.focus_wavelength])

    def first_order(self, wavelength: float | None = None) -> FirstOrder:
        """At a wavelength [m]; None for that of focus."""
        indices = indices_at(self.surfaces, self.focus_wavelength if wavelength is None else wavelength)
        matrix = system_matrix(self.surfaces, indices)
        front = system_matrix(self.surfaces[: self.stop + 1], indices, refract_last=False)
        # behind the stop: from its vertex, which refracts, to the last
        back = system_matrix(self.surfaces[self.stop :], indices[self.stop :])
        semi = self.stop_semi_diameter
        return FirstOrder(
            focal_length=-1 / matrix[1, 0],
            back_focus=-matrix[0, 0] / matrix[1, 0],
            entrance_pupil=front[0, 1] / front[0, 0],
            entrance_semi_diameter=semi / front[0, 0].abs(),
            exit_pupil=-back[0, 1] / back[1, 1],
            exit_semi_diameter=semi / back[1, 1].abs(),
        )

    def focus(self, wavelength: float | None = None) -> Tensor:
        """Vergence of what the sensor is focused on [1/m]; 0 where that lies beyond infinity."""
        indices = indices_at(self.surfaces, self.focus_wavelength if wavelength is None else wavelength)
        (a, b), (c, d) = system_matrix(self.surfaces, indices)
        away = self.sensor_away
        return (-(a + away * c) / (b + away * d)).clamp(min=0)

    @property
    def image_scale(self) -> Tensor:
        """Height of the image of a point near the axis over the point's own (Y / D) [m]."""
        first = self.first_order()
        away = self.sensor_away - first.exit_pupil
        return away * first.entrance_semi_diameter / first.exit_semi_diameter


def refractive_indices(surfaces: Sequence[Surface], wavelengths: Tensor) -> list[Tensor]:
    """In front of the first surface and behind each, K + 1 of (L,) float64."""
    return [torch.ones_like(wavelengths), *(surface.index(wavelengths) for surface in surfaces)]


def indices_at(surfaces: Sequence[Surface], wavelength: float) -> list[Tensor]:
    """The same at one wavelength [m], as numbers."""
    return [index[0] for index in refractive_indices(surfaces, wavelength_grid([wavelength]))]


def image_distance(surfaces: Sequence[Surface], wavelength: float, distance: float) -> float:
    """From the last vertex to the paraxial image of an object at a distance [m].

    Raises: ValueError where there is no real one, or none behind the lens.
    """
    matrix = system_matrix(surfaces, [index.detach() for index in indices_at(surfaces, wavelength)]).detach()
    ray = matrix @ torch.tensor([1.0, 1 / distance], dtype=torch.float64)  # of height 1 at the first vertex
    if float(ray[1]) >= 0:
        raise ValueError(
            f"an object at {distance:g} m has no real image: the focal length is {-1 / float(matrix[1, 0]):g} m. "
            "Focus farther away."
        )
    image = float(-ray[0] / ray[1])
    if image <= 0:
        raise ValueError(f"an object at {distance:g} m is imaged {-image:g} m inside the lens, not behind it.")
    return image
