"""The sensor: from irradiance to the numbers of a raw picture."""

from kcam.sensor.adc import ADC, quantise
from kcam.sensor.calibrated import from_calibration
from kcam.sensor.colour_filter import ColourFilter, fit_gaussians
from kcam.sensor.exposure import Exposure
from kcam.sensor.mosaic import PATTERNS, Mosaic, channel_masks, mosaic
from kcam.sensor.noise import (
    DarkCurrent,
    FixedPattern,
    Mean,
    ReadNoise,
    ShotNoise,
    dark_current,
    fixed_pattern,
    poisson,
    read_noise,
    shot_noise,
)

__all__ = [
    "ADC",
    "PATTERNS",
    "ColourFilter",
    "DarkCurrent",
    "Exposure",
    "FixedPattern",
    "Mean",
    "Mosaic",
    "ReadNoise",
    "ShotNoise",
    "channel_masks",
    "dark_current",
    "fit_gaussians",
    "fixed_pattern",
    "from_calibration",
    "mosaic",
    "poisson",
    "quantise",
    "read_noise",
    "shot_noise",
]
