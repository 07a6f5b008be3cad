"""What a calibration finds: numbers with their standard errors, levels, maps, and the file that holds them."""

from __future__ import annotations

import math
import os
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from kcam import files
from kcam.plain import to_json
from kcam.sensor.calibrated import FORMAT

MONO = "mono"
"""The channel of a sensor without colour filter."""
UNITS = {
    "gain": "DN / electron",
    "read_noise": "electrons",
    "prnu": "fraction",
    "dsnu": "electrons",
    "full_well": "electrons",
    "dark_current": "electrons / s",
    "linearity_error": "fraction",
}
"""What is measured of each channel, and its unit."""


@dataclass(frozen=True)
class Quantity:
    """A measured value with its standard error, or the reason why the frames do not show it.

    Args:      value, standard_error: in `unit`; None where the frames do not show it.
               reason: why not; of a value, what to know about it.

    Example:
    >>> from kcam import calibration
    >>> print(calibration.Quantity(2.0312, 0.0213, "electrons"))
    2.031 ± 0.021 electrons
    """

    value: float | None
    standard_error: float | None
    unit: str
    reason: str = ""

    def __str__(self) -> str:
        if self.value is None or self.standard_error is None:
            return f"unknown: {self.reason}"
        if self.standard_error <= 0:
            return f"{self.value:.4g} ± 0 {self.unit}"
        digits = max(0, 1 - math.floor(math.log10(self.standard_error)))
        return f"{self.value:.{digits}f} ± {self.standard_error:.{digits}f} {self.unit}"


@dataclass(frozen=True)
class Level:
    """What the frames of one exposure say of one channel.

    Args:      mean, variance: of the values, and their temporal variance [DN, DN^2].
               time: exposure [s]; None if unknown.
               frames, pixels: how many were seen.  spread: variance of the mean frame over its pixels [DN^2].
               top, bottom: shares of the pixels at the highest number of the converter, and at 0.
               linear: whether the gain was fitted to it.  deviation: from a line over time, relative; None outside.

    Example:
    >>> from kcam import calibration
    >>> electrons = [torch.full((2, 64, 64), n) for n in (0.0, 500.0, 1000.0, 2000.0)]
    >>> frames = [(64 + 0.5 * torch.poisson(n) + torch.randn(n.shape)).round() for n in electrons]
    >>> found = calibration.photon_transfer(frames[1:], frames[:1], bits=12)
    >>> [level.linear for level in found.channels["mono"].flats]
    [True, True, True]
    """

    mean: float
    variance: float
    time: float | None
    frames: int
    pixels: int
    spread: float
    top: float
    bottom: float
    linear: bool = False
    deviation: float | None = None


@dataclass(frozen=True)
class Spatial:
    """The fixed pattern of one channel: maps, and the standard's split of their variance into columns, rows and pixels.

    Args:      map: what is left of the averaged frame [DN; of light, a fraction].
               column, row, pixel: standard deviations [same].

    Example:
    >>> from kcam import calibration
    >>> electrons = [torch.full((2, 64, 64), n) for n in (0.0, 500.0, 1000.0, 2000.0)]
    >>> frames = [(64 + 0.5 * torch.poisson(n) + torch.randn(n.shape)).round() for n in electrons]
    >>> found = calibration.photon_transfer(frames[1:], frames[:1], bits=12)
    >>> found.channels["mono"].dark_pattern.map.shape  # of a sensor without a pattern: what noise is left
    (64, 64)
    """

    map: np.ndarray
    column: float
    row: float
    pixel: float


@dataclass(frozen=True)
class ChannelCalibration:
    """The numbers of one channel, each with its standard error, and the levels they come from.

    Args:      gain ... linearity_error: as in `UNITS`.  black_level: the mean without light, of no exposure time [DN].
               saturation: mean of saturated flats [DN]; None if there are none.
               dark_variance: temporal, at the black level, without the rounding [DN^2].
               darks, flats: of the photon transfer curve, flats by rising mean.
               dark_pattern, light_pattern: for the plots; None where there is none.

    Example:
    >>> from kcam import calibration
    >>> electrons = [torch.full((2, 64, 64), n) for n in (0.0, 500.0, 1000.0, 2000.0)]
    >>> frames = [(64 + 0.5 * torch.poisson(n) + torch.randn(n.shape)).round() for n in electrons]
    >>> found = calibration.photon_transfer(frames[1:], frames[:1], bits=12)
    >>> found.channels["mono"].gain.unit
    'DN / electron'
    """

    gain: Quantity
    read_noise: Quantity
    prnu: Quantity
    dsnu: Quantity
    full_well: Quantity
    dark_current: Quantity
    linearity_error: Quantity
    black_level: float
    saturation: float | None
    dark_variance: float
    darks: tuple[Level, ...]
    flats: tuple[Level, ...]
    dark_pattern: Spatial | None = field(default=None, repr=False, compare=False)
    light_pattern: Spatial | None = field(default=None, repr=False, compare=False)

    def quantities(self) -> dict[str, Quantity]:
        """Name -> value, of all of `UNITS`."""
        return {name: getattr(self, name) for name in UNITS}


@dataclass(frozen=True)
class SensorCalibration:
    """A calibrated sensor: prints as a table, and is saved as the file that `sensor.from_calibration` reads.

    Args:      bits: of the converter.  black_level: mean over the channels [DN].  pattern: of the colour filter; None
               for a monochrome sensor.  channels: by name: R, G, B, W, or mono.  notes: what to know of the frames.

    Example:
    >>> from kcam import calibration
    >>> electrons = [torch.full((2, 64, 64), n) for n in (0.0, 500.0, 1000.0, 2000.0)]
    >>> frames = [(64 + 0.5 * torch.poisson(n) + torch.randn(n.shape)).round() for n in electrons]
    >>> found = calibration.photon_transfer(frames[1:], frames[:1], bits=12)
    >>> print(str(found).splitlines()[0])
    12 bits, black level 64.0 DN, mono
    """

    bits: int
    black_level: float
    pattern: str | None
    channels: dict[str, ChannelCalibration]
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        lines = [f"{self.bits} bits, black level {self.black_level:.1f} DN, {self.pattern or MONO}"]
        for name, channel in self.channels.items():
            for title, quantity in channel.quantities().items():
                lines.append(f"  {name:<5}{title.replace('_', ' '):<17}{quantity}")
        return "\n".join(lines + [f"  note: {note}" for note in self.notes])

    def document(self) -> dict[str, Any]:
        """What the file holds, as plain values."""
        channels = {}
        for name, channel in self.channels.items():
            numbers: dict[str, Any] = {
                title: {what: told for what, told in asdict(quantity).items() if what != "reason" or told}
                for title, quantity in channel.quantities().items()
            }
            curves = {what: [asdict(level) for level in getattr(channel, what)] for what in ("darks", "flats")}
            channels[name] = numbers | {"black_level": channel.black_level, "levels": curves}
        return {
            "format": FORMAT,
            "standard": "EMVA 1288 release 4.0 linear",
            "bits": self.bits,
            "black_level": self.black_level,
            "pattern": self.pattern,
            "channels": channels,
            "notes": list(self.notes),
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it as JSON: per channel {"value", "standard_error", "unit"} of each of `UNITS`.

        A value that the frames do not show is null, with its "reason".

        Raises:    ValueError where no such file can be.
        """
        files.check_place(path)
        files.replace(path, to_json(self.document()))
