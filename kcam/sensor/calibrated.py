"""A sensor as it was measured: the stages of a calibration file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TypedDict

from torch import nn

from kcam.plain import from_json
from kcam.sensor.adc import ADC
from kcam.sensor.noise import DarkCurrent, FixedPattern, ReadNoise, ShotNoise

MONO = "mono"
"""The channel of a sensor without a mosaic."""
QUANTITIES = {
    "gain": "DN / electron",
    "read_noise": "electrons",
    "prnu": "fraction",
    "dsnu": "electrons",
    "full_well": "electrons",
    "dark_current": "electrons / s",
    "linearity_error": "fraction",
}
"""What a calibration says of each channel -> its unit."""


class _Quantity(TypedDict):
    value: float | None
    standard_error: float | None
    unit: str


class _Calibration(TypedDict):
    format: int
    bits: int
    black_level: float
    channels: dict[str, dict[str, _Quantity]]


def from_calibration(
    path: str | os.PathLike[str], *, exposure_time: float | None = None, seed: int = 0
) -> list[nn.Module]:
    """The stages of a sensor that `kcam calibrate-sensor` measured: from its noise to its ADC.

    ``Camera(imaging, colour_filter, Mosaic("RGGB"), Exposure(), *from_calibration("sensor.json"), Demosaic(), ...)``

    K = gain (2^bits - 1) / full_well gives the ADC its gain. Channels of one sensor share well, read-out and ADC: of
    several the mean is taken, weighted by their standard errors. A full well that was not seen is where the ADC ends.

    Args:      path: of the JSON file.  exposure_time: [s], for `DarkCurrent`; without it there is none.
               seed: of the pattern of gains and offsets, which is drawn with the spreads that were measured.
    Returns:   ShotNoise, DarkCurrent where asked for and known, FixedPattern, ReadNoise, ADC; what the file does not
               know (null) is left out.
    Raises:    FileNotFoundError; ValueError for a file that is no calibration, or without a gain.

    Example:
    >>> from pathlib import Path
    >>> gain = '{"value": 0.5, "standard_error": 0.01, "unit": "DN / electron"}'
    >>> text = '{"format": 1, "bits": 12, "black_level": 64, "channels": {"mono": {"gain": %s}}}' % gain  # noqa: UP031
    >>> written = Path("sensor.json").write_text(text)
    >>> [type(stage).__name__ for stage in sensor.from_calibration("sensor.json")]
    ['ShotNoise', 'ADC']
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"there is no file {path}. Expected a calibration, such as kcam calibrate-sensor writes."
        )
    wrong = f"{path} is no calibration of a sensor"
    found: _Calibration = from_json(path.read_bytes(), _Calibration, wrong=wrong)
    if found["format"] > 1:
        raise ValueError(f"{path} is of format {found['format']}; this kcam reads format 1. Update kcam.")

    def mean(name: str) -> float | None:
        known = [channel[name] for channel in found["channels"].values() if name in channel]
        pairs = [(one["value"], one["standard_error"]) for one in known]
        values = [(value, error) for value, error in pairs if value is not None and error is not None]
        weights = [1 / max(error, 1e-6 * abs(value), 1e-12) ** 2 for value, error in values]
        return sum(w * value for w, (value, _) in zip(weights, values, strict=True)) / sum(weights) if values else None

    gain = mean("gain")
    if gain is None or not gain > 0:
        raise ValueError(
            f"{path} knows no gain [DN / electron], so electrons are no numbers of it. Calibrate with flats."
        )
    top = 2 ** found["bits"] - 1
    full_well = mean("full_well") or (top - found["black_level"]) / gain
    stages: list[nn.Module] = [ShotNoise(full_well)]
    current = mean("dark_current")
    if exposure_time is not None and current is not None:
        stages.append(DarkCurrent(max(current, 0.0), time=exposure_time))
    prnu, dsnu, noise = mean("prnu"), mean("dsnu"), mean("read_noise")
    if prnu is not None or dsnu is not None:
        stages.append(FixedPattern(prnu or 0.0, dsnu=dsnu or 0.0, seed=seed))
    if noise is not None:
        stages.append(ReadNoise(noise))
    return [*stages, ADC(found["bits"], black_level=max(found["black_level"], 0.0), gain=gain * full_well / top)]
