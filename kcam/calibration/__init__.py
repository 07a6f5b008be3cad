"""Calibration: what a camera of one's own is, from frames and pictures that it took."""

from __future__ import annotations

import os

from kcam.calibration.chart import ChartPatches, ColourFit, chart_patches, colour_matrix, delta_e
from kcam.calibration.frames import exposure_time, find, pairs, read_frame, read_times
from kcam.calibration.photon_transfer import photon_transfer
from kcam.calibration.psf import PSFFit, fit_psf
from kcam.calibration.results import UNITS, ChannelCalibration, Level, Quantity, SensorCalibration, Spatial


def save_report(found: SensorCalibration, path: str | os.PathLike[str]) -> None:
    """Write the report of a calibration, one HTML file that holds its figures: `kcam.calibration.report.save_report`.

    Args:      found: as `photon_transfer` gives it.  path: ends in .html.
    Raises:    ValueError as `plots.check_writable`.

    Example:
    >>> from kcam import calibration
    >>> electrons = [torch.full((2, 64, 64), n) for n in (0.0, 500.0, 1000.0, 2000.0)]
    >>> frames = [(64 + 0.5 * torch.poisson(n) + torch.randn(n.shape)).round() for n in electrons]
    >>> calibration.save_report(calibration.photon_transfer(frames[1:], frames[:1], bits=12), "sensor.html")
    """
    from kcam.calibration import report  # matplotlib only when it draws

    report.save_report(found, path)


__all__ = [
    "UNITS",
    "ChannelCalibration",
    "ChartPatches",
    "ColourFit",
    "Level",
    "PSFFit",
    "Quantity",
    "SensorCalibration",
    "Spatial",
    "chart_patches",
    "colour_matrix",
    "delta_e",
    "exposure_time",
    "find",
    "fit_psf",
    "pairs",
    "photon_transfer",
    "read_frame",
    "read_times",
    "save_report",
]
