"""
The caustic of spherical aberration
===================================

Light behind a lens, seen from the side. A perfect lens gathers all of it in one waist; a plain spherical surface bends
the rim too strongly, so its rays cross too early and pile up along a caustic.
"""

# %%
# Each column is a PSF on a sensor at that distance: one line of pixels through its middle. Where the paraxial rays
# meet, the distance is 0.

import matplotlib.pyplot as plt
import torch

from kcam import optics
from kcam.units import mm, nm, um

wavelength, aperture = 550 * nm, optics.CircularAperture(12 * mm)
glasses = {"Perfect lens": optics.ThinLens(50 * mm), "Plano-convex lens": optics.PlanoConvexLens(25.94 * mm)}
shifts = torch.linspace(-1.6, 0.4, 161) * mm

fig, axes = plt.subplots(2, 1, figsize=(9, 5), layout="constrained", sharex=True)
for ax, (name, glass) in zip(axes, glasses.items(), strict=True):
    focus = optics.Lens(aperture, glass, focus_distance=float("inf"), focus_wavelength=wavelength).sensor_distance
    section = []
    for shift in shifts.tolist():
        lens = optics.Lens(aperture, glass, sensor_distance=focus + shift)
        line = lens.psf([wavelength], distances=float("inf"), pixel_pitch=1 * um, shape=(1, 301), integrate=False)
        section.append(line[0, 0, 0])
    image = torch.stack(section, dim=1)
    image = (image / image.quantile(0.998)).clamp(max=1) ** 0.4
    ax.imshow(image.numpy(), cmap="magma", aspect="auto", extent=(-1.6, 0.4, 150, -150))
    ax.set(title=name, ylabel="height [µm]")
axes[1].set_xlabel("sensor behind the paraxial focus [mm]")
fig.suptitle("Light near the focus of 50 mm at f/4.2, from the side")
plt.show()
