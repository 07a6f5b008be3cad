"""Light, reflectance, sensitivity and colour over wavelength.

A spectrum is a vector over the bands at hand, `wavelengths` (L,) [m], in any order and at any distances. The tables
(`kcam/tables`, written by `tools/make_tables.py` from colour-science) are resampled to it in float64 on the CPU.

**Light is relative**: the spectrum E of the light on a perfect white is scaled so that the white has Y = 1. A band's
radiance is reflectance times E, so its colour needs no further mention of the light: see `spectrum_to_xyz`.

**Bands are samples of a curve.** Between them, reflectance and radiance are interpolated by cubics, and beyond the
outermost bands held constant; colours are integrals of that curve at steps of 1 nm. Lamps have lines far narrower than
a band, so E is the lamp's average over each band, not its value at one wavelength.
"""

from kcam.spectral.bands import SINGLE_BAND_WIDTH, band_widths
from kcam.spectral.bands import Grid as Grid
from kcam.spectral.colour import adaptation, spectrum_to_xyz, xyz_to_linear_srgb, xyz_to_srgb_matrix, xyz_weights
from kcam.spectral.curves import SpectralTable, interpolation, read_csv, rising
from kcam.spectral.illuminants import illuminant, illuminant_names
from kcam.spectral.measured import SENSITIVITIES, colour_chart, observer, reflectances, sensitivity
from kcam.spectral.upsampling import rgb_basis, rgb_error

__all__ = [
    "SENSITIVITIES",
    "SINGLE_BAND_WIDTH",
    "SpectralTable",
    "adaptation",
    "band_widths",
    "colour_chart",
    "illuminant",
    "illuminant_names",
    "interpolation",
    "observer",
    "read_csv",
    "reflectances",
    "rgb_basis",
    "rgb_error",
    "rising",
    "sensitivity",
    "spectrum_to_xyz",
    "xyz_to_linear_srgb",
    "xyz_to_srgb_matrix",
    "xyz_weights",
]
