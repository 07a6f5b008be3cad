"""From frames, charts and pictures of points to the constants of a camera."""

from kcam.calibration.photon_transfer import Curve, Measured, SensorCalibration, photon_transfer

__all__ = [
    "Curve",
    "Measured",
    "SensorCalibration",
    "photon_transfer",
]
