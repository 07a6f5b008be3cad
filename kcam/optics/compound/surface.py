"""A refracting surface of a real lens: its shape, the glass behind it, and how far it is open."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from kcam.context import arguments_text
from kcam.optics.elements.element import set_scalar, set_tensor
from kcam.optics.elements.materials import Glass, refractive_index
from kcam.optics.numerics import Scalar, float64
from kcam.units import as_numbers, wavelength_grid

LENGTHS = (1e-6, 1.0)  # of a semi-diameter and a thickness [m]
RADII = (1e-5, 10.0)  # [m]
_LEAST_ROOT = 1e-6  # of 1 - (1 + k) c^2 r^2: nearer to its edge a surface has no slope to speak of


class Surface(nn.Module):
    """A rotationally symmetric surface, and what follows it up to the next.

    z(r) = c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)) + A_2 r^2 + sum_i A_(2i+4) r^(2i+4) + sum_i B_(2i+1) r^(2i+1)

    Args:
        radius: of curvature at the vertex, 1 / c [m], inf for a plane; positive where the centre lies behind.
        thickness: to the next surface along the axis [m]; of the last it is not used.
        glass: behind the surface: a name in `GLASSES`, a `Glass`, an index, or None for air.
        semi_diameter: beyond it no light passes [m]; None clips nothing.
        conic: k; 0 is a sphere, -1 a parabola. asphere: (A_4, A_6, ...) [1/m^3, 1/m^5, ...]. asphere2: A_2 [1/m].
        odd_asphere: (B_1, B_3, B_5, ...) of |r|^n [1, 1/m^2, ...].
        stop: whether it is the aperture stop; that one needs a semi_diameter.
    Any of the numbers may be a Parameter.
    Raises: ValueError for NaN, lengths that are not in metres, an unknown glass, a stop without a semi-diameter, a
        semi-diameter beyond where the surface exists.

    Example:
    >>> parabola = optics.Surface(radius=100 * mm, conic=-1.0)
    >>> sag = parabola.sag(torch.tensor((10 * mm) ** 2))[0]
    >>> f"{float(sag) / mm:.3f} mm"  # r^2 / 2 R
    '0.500 mm'
    """

    radius: Scalar
    thickness: Scalar
    semi_diameter: Scalar | None
    conic: Scalar
    asphere2: Scalar

    def __init__(
        self,
        *,
        radius: Scalar = math.inf,
        thickness: Scalar = 0.0,
        glass: str | float | Glass | None = None,
        semi_diameter: Scalar | None = None,
        conic: Scalar = 0.0,
        asphere: Sequence[float] | Tensor = (),
        asphere2: Scalar = 0.0,
        odd_asphere: Sequence[float] | Tensor = (),
        stop: bool = False,
    ) -> None:
        super().__init__()
        if glass is not None:
            refractive_index(glass, wavelengths=wavelength_grid([550e-9]))
        if stop and semi_diameter is None:
            raise ValueError("the stop needs a semi_diameter [m]: it bounds the light of every point.")
        for name, value in (("radius", radius), ("thickness", thickness), ("conic", conic), ("asphere2", asphere2)):
            as_numbers(value, name=name, expected="a number")
            set_scalar(self, name, value)
        self.semi_diameter = None
        if semi_diameter is not None:
            as_numbers(semi_diameter, name="semi_diameter", expected="a number of metres such as 5 * mm")
            del self.semi_diameter
            set_scalar(self, "semi_diameter", semi_diameter)
        for name, values in (("asphere", asphere), ("odd_asphere", odd_asphere)):
            as_numbers(values, name=name, expected="numbers")
            if isinstance(values, Tensor):
                set_tensor(self, name, values)
            else:
                setattr(self, name, tuple(float(value) for value in values))
        self.glass, self.stop = glass, stop
        self.check()

    def check(self) -> None:
        """ValueError where a number is none that a surface can have, also after training."""
        radius, thickness = float(float64(self.radius).detach()), float(float64(self.thickness).detach())
        for name in ("radius", "thickness", "conic", "asphere2", "asphere", "odd_asphere", "semi_diameter"):
            value = getattr(self, name)
            if value is not None and bool(torch.as_tensor(value, dtype=torch.float64).isnan().any()):
                raise ValueError(f"{name} of a surface is NaN. Was it trained with a step that was too large?")
        if abs(radius) < RADII[0] or (abs(radius) > RADII[1] and not math.isinf(radius)):
            raise ValueError(
                f"radius {radius:g} m is outside {RADII[0]:g}..{RADII[1]:g} m. Lengths are in metres; a plane is inf."
            )
        if thickness != 0 and not LENGTHS[0] <= abs(thickness) <= LENGTHS[1]:
            raise ValueError(f"thickness {thickness:g} m is outside 0, {LENGTHS[0]:g}..{LENGTHS[1]:g} m; in metres?")
        if self.semi_diameter is None:
            return
        reach = float(float64(self.semi_diameter).detach())
        if not LENGTHS[0] <= reach <= LENGTHS[1]:
            raise ValueError(f"semi_diameter {reach:g} m is outside {LENGTHS[0]:g}..{LENGTHS[1]:g} m; in metres?")
        root = 1 - (1 + float(float64(self.conic).detach())) * (reach / radius) ** 2
        if root <= _LEAST_ROOT:
            raise ValueError(
                f"semi_diameter {reach:g} m is beyond where a surface of radius {radius:g} m exists. Use less than "
                f"{reach / math.sqrt(1 - root):g} m."
            )

    @property
    def curvature(self) -> Tensor:
        """1 / radius [1/m], 0-d float64."""
        return 1 / float64(self.radius)

    @property
    def vertex_curvature(self) -> Tensor:
        """What paraxial rays see [1/m]."""
        return self.curvature + 2 * float64(self.asphere2)

    def index(self, wavelengths: Tensor) -> Tensor:
        """Of what is behind the surface, (L,) float64."""
        if self.glass is None:
            return torch.ones_like(wavelengths, dtype=torch.float64)
        return refractive_index(self.glass, wavelengths=wavelengths)

    def sag(self, r2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """z [m], dz / d(r^2) [1/m] and 1 - (1 + k) c^2 r^2, which is above 0 where the surface exists, at r^2 [m^2]."""
        c, k = self.curvature.to(r2.device), float64(self.conic).to(r2.device)
        inside = 1 - (1 + k) * c**2 * r2
        root = torch.sqrt(inside.clamp(min=_LEAST_ROOT))
        z = c * r2 / (1 + root) + float64(self.asphere2).to(r2.device) * r2
        slope = c / (2 * root) + float64(self.asphere2).to(r2.device)
        for index, a in enumerate(torch.as_tensor(self.asphere, dtype=torch.float64, device=r2.device).unbind()):
            power = index + 2  # of r^2
            z, slope = z + a * r2**power, slope + power * a * r2 ** (power - 1)
        safe = r2.clamp(min=1e-24)  # a cone has no slope on the axis
        for index, b in enumerate(torch.as_tensor(self.odd_asphere, dtype=torch.float64, device=r2.device).unbind()):
            half = index + 0.5
            z, slope = z + b * safe**half, slope + half * b * safe ** (half - 1)
        return z, slope, inside

    def extra_repr(self) -> str:
        """The arguments."""
        return arguments_text(self)
