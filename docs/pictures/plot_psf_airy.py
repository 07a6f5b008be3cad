"""
Airy discs from blue to red
===========================

A perfect lens does not image a star as a point: light bends at the rim of its aperture and makes a disc with rings.
They are larger in red than in blue, for they grow with the wavelength.
"""

# %%
# The first dark ring of an f-number :math:`N` has the radius :math:`1.22 \, \lambda N`, which is dashed. The square
# root of the irradiance is shown, or the rings would be too dark to see.

import matplotlib.pyplot as plt
import torch

from kcam import optics, plots
from kcam.units import mm, nm, um

wavelengths = torch.tensor([450, 520, 590, 660]) * nm
lens = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), focus_distance=float("inf"))
psfs = lens.psf(wavelengths, distances=float("inf"), pixel_pitch=0.2 * um, shape=(251, 251), integrate=False)[0]

fig, axes = plt.subplots(2, 2, figsize=(6.6, 6.9), layout="constrained")
for ax, psf, wavelength, colour in zip(axes.flat, psfs, wavelengths, plots.light_colours(wavelengths), strict=True):
    radius = 1.22 * float(wavelength) * lens.f_number
    dark = psf[125, 125:].diff().gt(0).nonzero()[0].item() * 0.2 * um  # where the irradiance rises again
    assert abs(dark - radius) < 0.2 * um
    ax.imshow(plots.psf_image(psf, colour), extent=(-25.1, 25.1, 25.1, -25.1))
    ax.add_patch(plt.Circle((0, 0), radius / um, fill=False, color="white", ls=":", lw=1))
    ax.set(title=f"{wavelength / nm:.0f} nm: {radius / um:.1f} µm", xlabel="x [µm]", ylabel="y [µm]")
fig.suptitle(f"Airy discs behind a lens of f/{lens.f_number:.0f}, and the radius of their first dark ring")
plt.show()
