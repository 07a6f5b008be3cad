"""Exposure: how much of the full well the light fills, by convention or by photometry."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from kcam.context import Context, Stage
from kcam.inputs import check_signal
from kcam.sensor.arguments import hold
from kcam.sensor.colour_filter import PHOTON_WAVELENGTH, REFERENCE_BANDWIDTH, ColourFilter
from kcam.units import as_numbers, check_positive, nm

PLANCK_TIMES_LIGHT = 1.986445857e-25
"""h c [J m], from the exact SI values of both."""

LUMINOUS_EFFICACY = 683.002
"""K_m, lumens per watt at the peak of V(lambda)."""

LUMINOUS_BANDWIDTH = 106.856895e-9
"""Integral of ybar of the CIE 1931 2 degree observer over 360..830 nm [m]: CIE 018."""


DEFAULT_QUANTUM_EFFICIENCY = 0.5
"""Of green's peak [electrons / photon], of curves that are only known in proportion."""


def white_gain(*, white: Tensor, white_share: Tensor | float, gain: Tensor | float = 1.0) -> Tensor:
    """What brings a perfect white to a share of what is full first in green, the converter behind the gain or the well.

    factor = white_share / (max(gain, 1) white_green)

    Args:      white: (C,) signal of a perfect white per channel; green is channel 1, or the only one.
               white_share: of full scale after the gain, or of the full well.  gain: analogue gain (ISO / 100).
    Returns:   0-d factor on the signal. A filter that sees nothing of the light (white < 1e-6) keeps a finite one.
    """
    most = gain.clamp(min=1) if isinstance(gain, Tensor) else max(gain, 1.0)
    return white_share / (most * _green(white).clamp(min=1e-6))


def electrons_per_unit(
    *,
    response: Tensor,
    wavelengths: Tensor,
    luminance: Tensor | float,
    aperture_area: Tensor | float,
    sensor_distance: Tensor | float,
    pixel_area: Tensor | float,
    time: Tensor | float,
    quantum_efficiency: Tensor | float,
) -> Tensor:
    """Photoelectrons in a pixel where the colour filter's signal is 1.

    The scene's radiance is relative: a perfect white has the spectrum E(lambda) of its light, with
    INT E ybar dlambda = INT ybar dlambda = 106.857 nm =: Y. Its luminance L_v fixes the absolute radiance s E,

        L_v = K_m s INT E ybar dlambda,   so   s = L_v / (K_m Y)                          [W / (m^2 sr m)]

    A pupil of area A at distance d from the sensor fills the solid angle A / d^2, so the spectral irradiance is
    s E A / d^2, the energy in a pixel of light-sensitive area a in the time t is s E (A / d^2) a t per wavelength,
    and with QE(lambda) electrons for each photon of energy h c / lambda

        electrons = s (A / d^2) a t INT E QE lambda / (h c) dlambda

    The filter's curve r is per unit energy, so QE(lambda) = q r(lambda) / (lambda m), where m = max(r_green / lambda)
    makes green peak at q electrons per photon. The wavelength cancels, and INT E r dlambda is the filter's signal S
    times its reference of 100 nm:

        electrons = S  s (A / d^2) a t q 100 nm / (h c m)

    Args:      response: (L,) curve of green on a fine grid of wavelengths (L,) [m].
               luminance: of a perfect white, L_v [cd/m^2].
               aperture_area: A [m^2].  sensor_distance: pupil to sensor, d [m].
               pixel_area: a, the light-sensitive area of one pixel, pitch^2 fill_factor [m^2].
               time: t [s].  quantum_efficiency: q, the peak of green [electrons / photon].
    Returns:   0-d tensor [electrons].
    Valid when the pupil is seen under a small angle: A / d^2 is 6 % more than the projected solid angle at f/2, 1.6 %
    at f/4. Light outside the wavelengths of the scene is not counted.
    Source:    the definition of the candela; EMVA 1288 release 4.0, section 2.1 (photons from irradiance).
    """
    per_photon = (response / wavelengths.to(response.device)).amax().clamp(min=1e-6 / REFERENCE_BANDWIDTH)
    radiance = luminance / (LUMINOUS_EFFICACY * LUMINOUS_BANDWIDTH)
    energy = radiance * (aperture_area / sensor_distance**2) * pixel_area * time * REFERENCE_BANDWIDTH
    return energy * quantum_efficiency / (PLANCK_TIMES_LIGHT * per_photon)


class Exposure(Stage):
    """The exposure: scales the signal so that 1.0 is the full well. It works before and after the mosaic.

    Without `time` it is automatic: a perfect white under the scene's light fills `white_share` of full scale in green
    (a learned tile: on average over the tile), divided by the ISO gain that the ADC restores; with a gain below 1 the
    well is full before the converter, and white fills that share of the well. With `time` it is physical,
    `electrons_per_unit` / full_well, from the scene's luminance, the lens's aperture, the pixel and the time: stopping
    down costs photons, and ISO changes the gain but not the electrons. `white_share` then only tells the stages behind
    the ADC what counts as white. So `iso` without `time` keeps the picture's brightness and sets its noise, like a
    camera that shortens its time: at ISO 800 white is an eighth of the electrons.

    The signal is the *mean* relative irradiance over the light-sensitive area of a pixel (a uniform white is 1,
    whatever the fill factor); this stage alone multiplies by that area, pitch^2 fill_factor.

    Args:      white_share: of full scale, 0 < share <= 1; None for the context's (0.8).
               time: exposure time [s]; None for automatic exposure.
               iso: sensitivity, gain = iso / 100; None for the context's gain (1).
               quantum_efficiency: peak of green [electrons / photon], 0 < q <= 1; only used with `time`. None for the
               filter's own where it knows them (`ColourFilter.from_curves(..., quantum_efficiency=True)`), else 0.5.
               compensation: times that exposure, > 0: 2 is a stop brighter; None for 1.
    Raises:    ValueError for a value out of range, and at the call for `time` without a lens in the context.

    Example:
    >>> white = sensor.ColourFilter.kodak().white(kcam.Context().wavelengths)[None, :, None, None]
    >>> [round(float(sensor.Exposure(iso=iso)(white)[0, 1]), 3) for iso in (100, 800)]  # of the full well, in green
    [0.8, 0.1]
    """

    white_share: Tensor | float | None
    time: Tensor | float | None
    iso: Tensor | float | None
    quantum_efficiency: Tensor | float | None
    compensation: Tensor | float | None

    def __init__(
        self,
        white_share: Tensor | float | None = None,
        *,
        time: Tensor | float | None = None,
        iso: Tensor | float | None = None,
        quantum_efficiency: Tensor | float | None = None,
        compensation: Tensor | float | None = None,
    ):
        super().__init__()
        for name, share in (("white_share", white_share), ("quantum_efficiency", quantum_efficiency)):
            expected = "a share, above 0 and at most 1, such as 0.8"
            value = 1.0 if share is None else as_numbers(share, name=name, expected=expected).detach()
            if not 0 < value <= 1:
                raise ValueError(f"{name} must be {expected}; got {value:g}.")
        if time is not None:
            check_positive(time, name="time", unit="s")
        if iso is not None:
            check_positive(iso, name="iso", unit="(100 is base)")
        if compensation is not None:
            check_positive(compensation, name="compensation", unit="(1 is none)")
        hold(self, white_share=white_share, time=time, iso=iso, quantum_efficiency=quantum_efficiency)
        hold(self, compensation=compensation)

    def changed(self, **arguments: Any) -> Exposure:
        """The same exposure with other arguments; it shares the rest."""
        names = ("white_share", "time", "iso", "quantum_efficiency", "compensation")
        return Exposure(**{name: getattr(self, name) for name in names} | arguments)

    def factor(self, context: Context | None = None) -> Tensor:
        """What the signal is multiplied by, as a 0-d float64 tensor (1.0 is the full well)."""
        context = context or Context()
        colour_filter = context.colour_filter or _default_filter()
        if self.time is None:
            white = colour_filter.white(context.wavelengths, illuminant=context.illuminant)
            share = context.white_share if self.white_share is None else self.white_share
            return white_gain(white=white, white_share=share, gain=context.gain if self.iso is None else self.iso / 100)
        if context.lens is None:
            raise ValueError(
                "Exposure(time=...) needs the lens for its aperture, and there is none: put "
                "optics.Imaging(lens, ...) before it, pass Context(lens=lens), or leave time=None for automatic "
                "exposure."
            )
        area, distance = context.lens.aperture_area(), context.lens.sensor_distance
        if area is None or distance is None:
            raise ValueError(
                f"Exposure(time=...) needs aperture_area= and sensor_distance= of the {type(context.lens).__name__}. "
                "Give them, or leave time=None for automatic exposure."
            )
        grid = torch.arange(300, 1101, dtype=torch.float64) * nm
        bare: Any = getattr(colour_filter, "bare", colour_filter)  # glass before the sensor takes light, no efficiency
        response, peak = _green(bare.response(grid)), self.quantum_efficiency
        if peak is None:
            peak = DEFAULT_QUANTUM_EFFICIENCY
            if getattr(colour_filter, "photons", False):  # per photon it is what it says
                response, peak = grid / PHOTON_WAVELENGTH, 1.0
        electrons = electrons_per_unit(
            response=response,
            wavelengths=grid,
            luminance=context.luminance,
            aperture_area=area,
            sensor_distance=distance,
            pixel_area=context.pixel_pitch**2 * context.fill_factor,
            time=self.time,
            quantum_efficiency=peak,
        )
        return electrons / context.full_well

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,C,H,W) relative irradiance to a share of the full well, not clipped."""
        check_signal(signal)
        factor = self.factor(context) if self.compensation is None else self.factor(context) * self.compensation
        return signal * factor.to(signal)

    def provides(self) -> dict[str, Any]:
        """The gain, the exposure time and the white share, where they were given."""
        fields: dict[str, Any] = {} if self.iso is None else {"gain": self.iso / 100}
        fields |= {} if self.time is None else {"exposure_time": self.time}
        return fields if self.white_share is None else {**fields, "white_share": self.white_share}


@functools.cache
def _default_filter() -> ColourFilter:
    return ColourFilter.kodak()


def _green(channels: Tensor) -> Tensor:
    return channels[min(1, len(channels) - 1)]
