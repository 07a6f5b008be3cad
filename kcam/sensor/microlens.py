"""How much less a pixel sees of light that comes in at an angle: the shading of micro-lenses.

The lens over each pixel images the exit pupil onto its photodiode; light that comes at another angle than it was made
for lands beside. Towards the edge of the picture chief rays are steeper, so the corners are darker than the lens alone
makes them, unless the micro-lenses are shifted for the lens that is used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcam.context import Context, Photometric, Stage
from kcam.effects import relative_change
from kcam.inputs import check_signal
from kcam.optics.regions import pixel_positions
from kcam.sensor.arguments import hold, in_float32
from kcam.sensor.crosstalk import _numbers
from kcam.sensor.mosaic import at_pixels
from kcam.units import IMAGE_SIDE_RANGE, as_numbers, check_length


def microlens_response(
    radius: Tensor,
    *,
    acceptance: Tensor | float,
    pupil_distance: Tensor | float,
    design_distance: Tensor | float = math.inf,
) -> Tensor:
    """Share of its light that a pixel keeps at the chief ray's angle.

    R = 2^(-(delta / acceptance)^2),   delta = atan(r / d) - atan(r / d_0)

    Args:      radius: r, of the pixel from the axis [m].  acceptance: angle off its own at which half is left [rad].
               pupil_distance: d, from the exit pupil to the sensor [m].
               design_distance: d_0, that which the micro-lenses are shifted for [m]; inf: not shifted.
    Returns:   0..1, 1 where the angles agree.
    Valid when the cone of light is narrow beside the acceptance: a wider one only smooths the curve.
    Source:    P. B. Catrysse, X. Liu and A. El Gamal, QE reduction due to pixel vignetting in CMOS image sensors, Proc.
               SPIE 3965, 420 (2000); the Gaussian is an approximation to its measured curves.

    Example:
    >>> corner = torch.tensor(3 * mm)  # of a sensor 6 mm behind the pupil: 26.6 degrees
    >>> round(float(sensor.microlens_response(corner, acceptance=math.radians(26.565), pupil_distance=6 * mm)), 3)
    0.5
    >>> float(sensor.microlens_response(corner, acceptance=0.3, pupil_distance=6 * mm, design_distance=6 * mm))
    1.0
    """
    return torch.exp2(
        -(((torch.atan(radius / pupil_distance) - torch.atan(radius / design_distance)) / acceptance) ** 2)
    )


@in_float32
def _shaded(signal: Tensor, *, response: Tensor) -> Tensor:
    return signal * response.to(signal)


class MicrolensShading(Stage):
    """What pixels lose of light at an angle, by the chief ray's: `microlens_response` over the picture.

    It stands before or behind the Mosaic, and before Exposure, which does not make up for it: that goes by the white in
    the middle.

    Args:      acceptance: angle off the design's at which half the light is left [rad], 0.01 to pi / 2; a number, or
               one for each channel in the order of the pattern, for light of long wavelengths lands deeper.
               design_distance: exit pupil that the micro-lenses are shifted for [m]; None: not shifted.
               pupil_distance: from the exit pupil to the sensor [m]; None to take it from the context's lens: of a
               CompoundLens its exit pupil, of others their sensor distance.
               centre: of the picture, x and y on the sensor from the axis [m], as that of `optics.Imaging`.
    Raises:    ValueError for a value out of range; at the call where nothing says how far the pupil is.
    Source:    Catrysse, Liu and El Gamal (2000).

    Example:
    >>> shading = sensor.MicrolensShading(math.radians(25), pupil_distance=4 * mm)
    >>> white = shading(torch.ones(1, 1, 751, 1001), kcam.Context(pixel_pitch=4 * um))  # corners 2.5 mm off: 32 degrees
    >>> round(float(white[0, 0, 375, 500]), 3), round(float(white[0, 0, 0, 0]), 2)
    (1.0, 0.32)
    """

    whole_picture = True
    """It depends on where in the picture a pixel is: what a crop of it changes by tells little of the whole."""

    acceptance: Tensor | float
    design_distance: Tensor | float | None
    pupil_distance: Tensor | float | None

    def __init__(
        self,
        acceptance: Tensor | float | Sequence[float] = 0.5,
        *,
        design_distance: Tensor | float | None = None,
        pupil_distance: Tensor | float | None = None,
        centre: tuple[float, float] = (0.0, 0.0),
    ):
        super().__init__()
        expected = "an angle in rad, or one for each channel, such as 0.5"
        angles = as_numbers(acceptance, name="acceptance", expected=expected).detach()
        bad = ~((angles >= 0.01) & (angles <= math.pi / 2 + 1e-6))
        if angles.ndim > 1 or not angles.numel() or bad.any():
            what = float(angles[bad].flatten()[0]) if bad.any() else math.nan
            fix = f"; did you mean math.radians({what:g})?" if math.pi / 2 < what <= 90 else "."
            shown = f"{what:g}" if bad.any() else f"shape {tuple(angles.shape)}"
            raise ValueError(f"acceptance must be 0.01 to pi / 2 rad, a number or one each (C,), got {shown}{fix}")
        for name, distance in (("design_distance", design_distance), ("pupil_distance", pupil_distance)):
            if distance is not None:
                check_length(distance, name=name, within=IMAGE_SIDE_RANGE, example="5 * mm")
        place = as_numbers(centre, name="centre", expected="x and y in metres, such as (0.0, 0.0)").flatten()
        if len(place) != 2 or not bool((place.abs() < 1).all()):
            raise ValueError(f"centre must be x and y on the sensor, less than 1 m, got {centre!r}. * mm?")
        hold(
            self,
            acceptance=_numbers(acceptance),
            design_distance=design_distance,
            pupil_distance=pupil_distance,
            centre=(float(place[0]), float(place[1])),
        )

    def response(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """The share that each pixel keeps, (C or 1, H, W) float64."""
        context = context or Context()
        acceptance = at_pixels(self.acceptance, signal, pattern=context.pattern, name="acceptance").double()
        picture = (signal.shape[-2], signal.shape[-1])
        places = pixel_positions(picture, context.pixel_pitch).to(signal.device)
        radius = (places + places.new_tensor(self.centre)).norm(dim=-1)
        design = math.inf if self.design_distance is None else self.design_distance
        return microlens_response(
            radius, acceptance=acceptance, pupil_distance=self._pupil_distance(context), design_distance=design
        )

    def _pupil_distance(self, context: Context) -> Tensor | float:
        found = self.pupil_distance
        if found is None and context.lens is not None:
            found = exit_pupil_distance(context.lens)
        if found is None:
            raise ValueError(
                "MicrolensShading needs the distance of the exit pupil, and there is no lens that knows it: put "
                "optics.Imaging(lens, ...) before it, or give pupil_distance=5 * mm."
            )
        return found

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,C,H,W) to the same shape: times `response`."""
        check_signal(signal)
        return _shaded(signal, response=self.response(signal, context))

    def error_if_skipped(self, signal: Tensor, context: Context | None = None) -> float:
        """The change of this signal, as a picture of its own; see `kcam.effects.Skippable`."""
        return relative_change(self, signal, context)

    def cost(self, signal: Tensor, context: Context | None = None) -> float:
        """Two arc tangents and a power for each pixel in float64."""
        return 40.0

    def reason(self, signal: Tensor, context: Context | None = None) -> str:
        """What is left in the worst corner."""
        with torch.no_grad():
            found = self.response(signal, context)
        least = float(found.min()) if found.numel() else 1.0
        return f"{1 - least:.2%} lost at most, {self.error_if_skipped(signal, context):.1e} of the signal's RMS"


def exit_pupil_distance(lens: Photometric) -> Tensor | float | None:
    """From the exit pupil of a lens to the sensor [m], negative where the pupil lies behind it; None where unknown.

    Example:
    >>> lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(8 * mm), sensor_distance=9 * mm)
    >>> round(sensor.exit_pupil_distance(lens) / mm, 6)
    9.0
    """
    first_order = getattr(lens, "first_order", None)
    if first_order is None or lens.sensor_distance is None:
        return lens.sensor_distance
    return torch.as_tensor(lens.sensor_distance, dtype=torch.float64) - first_order().exit_pupil
