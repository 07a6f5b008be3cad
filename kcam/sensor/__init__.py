"""The sensor: from irradiance to the numbers of a raw picture."""

from kcam.sensor.adc import ADC, quantise
from kcam.sensor.banding import RowColumnNoise, fixed_stripes, row_column_noise
from kcam.sensor.colour_filter import ColourFilter, fit_gaussians
from kcam.sensor.crosstalk import Crosstalk, crosstalk, crosstalk_kernel
from kcam.sensor.defects import DefectPixels, defect_pixels
from kcam.sensor.exposure import Exposure
from kcam.sensor.microlens import MicrolensShading, exit_pupil_distance, microlens_response
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
from kcam.sensor.nonlinearity import Nonlinearity, linearity_error, nonlinear_response

__all__ = [
    "ADC",
    "PATTERNS",
    "ColourFilter",
    "Crosstalk",
    "DarkCurrent",
    "DefectPixels",
    "Exposure",
    "FixedPattern",
    "Mean",
    "MicrolensShading",
    "Mosaic",
    "Nonlinearity",
    "ReadNoise",
    "RowColumnNoise",
    "ShotNoise",
    "channel_masks",
    "crosstalk",
    "crosstalk_kernel",
    "dark_current",
    "defect_pixels",
    "exit_pupil_distance",
    "fit_gaussians",
    "fixed_pattern",
    "fixed_stripes",
    "linearity_error",
    "microlens_response",
    "mosaic",
    "nonlinear_response",
    "poisson",
    "quantise",
    "read_noise",
    "row_column_noise",
    "shot_noise",
]
