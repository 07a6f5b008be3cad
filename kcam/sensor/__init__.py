"""The sensor: from irradiance to the numbers of a raw picture."""

from kcam.sensor.adc import ADC, quantise, saturation
from kcam.sensor.banding import RowColumnNoise, fixed_stripes, row_column_noise
from kcam.sensor.calibrated import from_calibration
from kcam.sensor.colour_filter import ColourFilter, fit_gaussians
from kcam.sensor.crosstalk import Crosstalk, crosstalk, crosstalk_kernel
from kcam.sensor.defects import DefectPixels, defect_pixels
from kcam.sensor.exposure import Exposure
from kcam.sensor.microlens import MicrolensShading, exit_pupil_distance, microlens_response
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
from kcam.sensor.nonlinearity import Nonlinearity, linearity_error, nonlinear_response
from kcam.sensor.transmission import Transmission

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
    "Motion",
    "Nonlinearity",
    "ReadNoise",
    "RowColumnNoise",
    "ShotNoise",
    "Transmission",
    "channel_masks",
    "crosstalk",
    "crosstalk_kernel",
    "dark_current",
    "defect_pixels",
    "exit_pupil_distance",
    "fit_gaussians",
    "fixed_pattern",
    "fixed_stripes",
    "from_calibration",
    "linearity_error",
    "microlens_response",
    "mosaic",
    "move_rows",
    "nonlinear_response",
    "path_blur",
    "poisson",
    "quantise",
    "read_noise",
    "row_column_noise",
    "saturation",
    "shot_noise",
    "tremor",
    "warp",
]
