"""What a camera is worth: resolution, noise, dynamic range, colour, distortion, shading, measured as for real ones."""

from kcam.analysis.camera import (
    LIGHTS,
    ColourError,
    DynamicRange,
    NotMeasured,
    SignalToNoise,
    colour_error,
    distortion,
    dynamic_range,
    edge_response,
    half_diagonal,
    imaging_of,
    noise_power,
    shading,
    signal_to_noise,
)
from kcam.analysis.edge import EdgeResponse, slanted_edge_mtf
from kcam.analysis.noise import NoisePower, noise_power_spectrum
from kcam.analysis.page import STEPS, Report, report

__all__ = [
    "LIGHTS",
    "STEPS",
    "ColourError",
    "DynamicRange",
    "EdgeResponse",
    "NoisePower",
    "NotMeasured",
    "Report",
    "SignalToNoise",
    "colour_error",
    "distortion",
    "dynamic_range",
    "edge_response",
    "half_diagonal",
    "imaging_of",
    "noise_power",
    "noise_power_spectrum",
    "report",
    "shading",
    "signal_to_noise",
    "slanted_edge_mtf",
]  # fmt: skip
