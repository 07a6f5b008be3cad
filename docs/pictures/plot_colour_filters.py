"""
The colour filters of three cameras
===================================

How strongly the red, green and blue pixels of three sensors answer to each wavelength. Two were measured behind their
infrared cut, the third follows data sheets. Twelve Gaussians stand for each curve, so that a filter can be trained.
"""

# %%
# Points are the tables, lines the Gaussians. Without an infrared cut the third goes on into the infrared.

import matplotlib.pyplot as plt
import torch

from kcam import sensor, spectral
from kcam.units import nm

wavelengths = torch.linspace(400, 720, 161) * nm
cameras = {
    "Nikon 5100": (sensor.ColourFilter.nikon(), "nikon_5100"),
    "Sigma SD Merrill": (sensor.ColourFilter.sigma(), "sigma_sd_merrill"),
    "Kodak CCD": (sensor.ColourFilter.kodak(), "kodak"),
}
fig, axes = plt.subplots(1, 3, figsize=(9, 3.2), layout="constrained", sharey=True)
for ax, (name, (colour_filter, table)) in zip(axes, cameras.items(), strict=True):
    curves = colour_filter.response(wavelengths).detach()
    measured = spectral.sensitivity(table, wavelengths=wavelengths)
    for curve, points, colour in zip(curves, measured, ("tab:red", "tab:green", "tab:blue"), strict=True):
        scale = curves[1].max()
        ax.fill_between(wavelengths / nm, curve / scale, color=colour, alpha=0.25)
        ax.plot(wavelengths / nm, curve / scale, color=colour)
        ax.plot(wavelengths[::5] / nm, points[::5], ".", color=colour, ms=5)
    ax.set(title=name, xlabel="wavelength [nm]")
axes[0].set_ylabel("sensitivity, green peaks at 1")
fig.suptitle("Colour filters: tables (points) and twelve Gaussians (lines)")
plt.show()
