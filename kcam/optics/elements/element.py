"""What a thin element of a lens is, and what its arguments must be.

An element's OPD is a vergence times r^2 / 2 plus `terms`, a list of (coefficient of each wavelength, map over the
pupil): vergences are summed as float64 scalars, because in focus they cancel to nothing while each alone is thousands
of radians.
Pixel maps cannot be sampled like smooth paths; they come as `PixelMap` and pass a low-pass of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from kcam.context import arguments_text
from kcam.optics.numerics import Scalar
from kcam.optics.pupil.coordinates import Pupil
from kcam.optics.pupil.maps import PixelMap
from kcam.units import check_distances, check_positive, check_trained

Term = tuple[Tensor, Tensor]  # coefficients (L,), map over the pupil [the product is an OPD in metres]


def set_scalar(module: nn.Module, name: str, value: Scalar) -> None:
    """Store a scalar under its own name: a Parameter trains, a tensor is a buffer, a number stays a float64 number."""
    if isinstance(value, nn.Parameter):
        module.register_parameter(name, value)
    elif isinstance(value, Tensor):
        module.register_buffer(name, value)
    else:
        setattr(module, name, float(value))


def place_sensor(
    lens: nn.Module,
    focus_distance: float | None,
    sensor_distance: Scalar | None,
    *,
    image_distance: Callable[[float], float],
) -> None:
    """Store the sensor's distance [m], as given or where `image_distance` has the image of a focus.

    Raises: ValueError for both or neither, and what is no distance.
    """
    if focus_distance is not None and sensor_distance is None:
        sensor_distance = image_distance(float(check_distances(focus_distance, name="focus_distance")))
    elif focus_distance is not None or sensor_distance is None:
        raise ValueError("give either focus_distance= or sensor_distance= [m], not both and not neither.")
    check_positive(sensor_distance, name="sensor_distance")
    set_scalar(lens, "sensor_distance", sensor_distance)


def check_numbers(lens: nn.Module) -> None:
    """What the constructors refuse must not come in by an optimiser's step or a loaded file either."""
    for name, value in (*lens.named_parameters(), *lens.named_buffers()):
        check_trained(value, name=f"{name} of the lens")


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

    Example:
    >>> class Prism(optics.Element):
    ...     def terms(self, pupil, wavelengths):
    ...         return [(torch.ones_like(wavelengths), 2 * um * pupil.x)]  # x = 1 at the rim: 100 um on the sensor
    >>> lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(50 * mm), Prism(), focus_distance=math.inf)
    >>> int(lens.psf([550 * nm], distances=math.inf, pixel_pitch=10 * um, shape=(33, 33))[0, 0, 16].argmax()) - 16
    10
    """

    symmetric = False  # rotationally, by its type: never decided from values, whose gradient need not be symmetric
    even = True  # likewise in x and in y; what has no terms is
    knots: Sequence[float] | Tensor | None = ()
    focuses = True  # whether its vergence counts when the sensor is put in focus; a deliberate defocus must not

    def __init_subclass__(cls, **arguments: Any) -> None:
        """Terms of its own are neither symmetric nor smooth until the subclass says so: what it inherits was said of
        others.
        """
        super().__init_subclass__(**arguments)
        if "terms" in vars(cls):
            cls.symmetric = vars(cls).get("symmetric", False)
            cls.even = vars(cls).get("even", cls.symmetric)
            cls.knots = vars(cls).get("knots")

    def vergence(self, wavelengths: Tensor) -> Tensor:
        """Coefficient of r^2 / 2 in the OPD, (L,) float64 [1/m]; a converging lens has -1 / f."""
        return torch.zeros_like(wavelengths)

    def terms(self, pupil: Pupil, wavelengths: Tensor) -> list[Term]:
        """The rest of the OPD at a pupil's points, whatever axes these have: a grid may come as its four quadrants."""
        return []

    def pixel_map(self, wavelengths: Tensor) -> PixelMap | None:
        """What this element does in flat pixels, or None."""
        return None

    def check(self) -> None:
        """ValueError where training or loading brought in what the constructor refuses, beside NaN."""

    def extra_repr(self) -> str:
        """The arguments."""
        return arguments_text(self)


def is_even(element: Element) -> bool:
    """Whether its path tells neither x from -x nor y from -y, by its type."""
    return element.even and "terms" not in vars(element)


def set_tensor(module: nn.Module, name: str, value: Tensor) -> None:
    """Register a Parameter as such and any other tensor as a buffer."""
    if isinstance(value, nn.Parameter):
        module.register_parameter(name, value)
    else:
        module.register_buffer(name, value)


def check_map(values: Tensor, *, name: str) -> None:
    """TypeError, ValueError unless it is a square map of finite floats."""
    if not isinstance(values, Tensor) or not values.is_floating_point():
        raise TypeError(f"{name} must be a floating-point tensor (n, n), got {_describe(values)}.")
    if values.ndim != 2 or values.shape[0] != values.shape[1] or values.numel() == 0:
        raise ValueError(f"{name} must be square (n, n) with n >= 1, got shape {tuple(values.shape)}.")
    _check_finite(values, name=name)


def check_vector(values: Tensor, *, name: str) -> None:
    """TypeError, ValueError unless it is a vector of finite floats."""
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


def check_not_flat(metres: float, *, name: str) -> None:
    """Beyond 10 m a lens of camera size does nothing that a `Defocus` would not."""
    if abs(metres) > 10:
        raise ValueError(
            f"{name} {metres:g} m is beyond 10 m. Lengths are in metres; did you mean {metres:g} * mm? For a power "
            "as weak as that use Defocus(vergence)."
        )


def _describe(value: object) -> str:
    return f"{value.dtype} tensor" if isinstance(value, Tensor) else type(value).__name__
