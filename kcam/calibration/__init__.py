"""Calibration: what a camera of one's own is, from pictures that it took."""

from kcam.calibration.psf import PSFFit, fit_psf

__all__ = ["PSFFit", "fit_psf"]
