"""The sensor: from irradiance to the numbers of a raw picture."""

from kcam.sensor.adc import ADC, quantise
from kcam.sensor.calibrated import from_calibration
from kcam.sensor.colour_filter import ColourFilter, fit_gaussians
from kcam.sensor.exposure import Exposure
from kcam.sensor.mosaic import PATTERNS, Mosaic, channel_masks, mosaic
from kcam.sensor.motion import Motion, move_rows, path_blur, tremor, warp
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
from kcam.sensor.transmission import Transmission

__all__ = [
    "ADC",
    "PATTERNS",
    "ColourFilter",
    "DarkCurrent",
    "Exposure",
    "FixedPattern",
    "Mean",
    "Mosaic",
    "Motion",
    "ReadNoise",
    "ShotNoise",
    "Transmission",
    "channel_masks",
    "dark_current",
    "fit_gaussians",
    "fixed_pattern",
    "from_calibration",
    "mosaic",
    "move_rows",
    "path_blur",
    "poisson",
    "quantise",
    "read_noise",
    "shot_noise",
    "tremor",
    "warp",
]
