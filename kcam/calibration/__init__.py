"""Calibration: what a camera of one's own is, from pictures that it took."""

from kcam.calibration.chart import ChartPatches, ColourFit, chart_patches, colour_matrix, delta_e
from kcam.calibration.psf import PSFFit, fit_psf

__all__ = ["ChartPatches", "ColourFit", "PSFFit", "chart_patches", "colour_matrix", "delta_e", "fit_psf"]
