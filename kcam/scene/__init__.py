"""Scenes: the light that arrives from every direction and at every wavelength, and how far away it started.

A scene is a cube of spectral radiance. It is stored as bands, or factored: K coefficient planes times K spectra, as
pictures are (three planes and three spectra stand for 28 bands), and rendering makes use of the factors.
"""

from kcam.scene.builtin import BUILTIN, CHARTS, PHOTOGRAPHS
from kcam.scene.picture import read_picture
from kcam.scene.resizing import fitted, target_shape
from kcam.scene.scene import ROUGH, Scene

__all__ = ["BUILTIN", "CHARTS", "PHOTOGRAPHS", "ROUGH", "Scene", "fitted", "read_picture", "target_shape"]
