"""Calibration of a real camera from its frames: sensor curves, noise and fixed pattern."""

from kcam.calibration.frames import exposure_time, find, pairs, read_frame, read_times
from kcam.calibration.photon_transfer import (
    UNITS,
    ChannelCalibration,
    Level,
    Quantity,
    SensorCalibration,
    Spatial,
    photon_transfer,
)

__all__ = [
    "UNITS",
    "ChannelCalibration",
    "Level",
    "Quantity",
    "SensorCalibration",
    "Spatial",
    "exposure_time",
    "find",
    "pairs",
    "photon_transfer",
    "read_frame",
    "read_times",
]
