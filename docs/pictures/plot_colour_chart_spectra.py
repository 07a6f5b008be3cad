"""
Twenty-four spectra
===================

The reflectances of the colour chart, each curve in the colour that it looks. Greys are flat, reds rise at the end, and
no paint is as pure as the light of one wavelength.
"""

# %%
# The band below is the light of each wavelength, as pure as a screen can show it.

import matplotlib.pyplot as plt
import torch

from kcam import plots, spectral
from kcam.isp import tone_curve
from kcam.units import nm

names, wavelengths, reflectances = spectral.colour_chart()
linear = reflectances @ spectral.xyz_weights(wavelengths, "D65") @ spectral.xyz_to_srgb_matrix().T
colours = tone_curve(linear.T[:, None])[:, 0].T.numpy()
assert len(names) == len(colours) == 24
fine = torch.linspace(380, 730, 351) * nm

fig, ax = plt.subplots(figsize=(9, 4.6), layout="constrained")
ax.set_facecolor("0.15")
for curve, colour in zip(reflectances, colours, strict=True):
    ax.plot(wavelengths / nm, curve, color=colour, lw=2.5)
ax.imshow(plots.light_colours(fine)[None], extent=(380, 730, -0.08, -0.02), aspect="auto")
ax.set(xlim=(380, 730), ylim=(-0.08, 1), xlabel="wavelength [nm]", ylabel="reflectance")
fig.suptitle("The 24 patches of the colour chart, as measured")
plt.show()
