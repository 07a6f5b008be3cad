"""
Distortion and vignetting of four lenses
========================================

A grid of straight lines as four lenses draw it. Where it bends outwards the magnification grows towards the corner,
where it bends inwards it falls; and each lens is darker at its edge than in its middle.
"""

# %%
# Grey is the irradiance of an even wall, relative to the middle. The bends are drawn five times as strong as they are.

import matplotlib.pyplot as plt
import numpy as np
import torch

from kcam import optics
from kcam.units import mm

names = {"tessar": 0.38, "telephoto": 0.05, "wide_angle": 0.68, "phone": 0.52}  # and how far the field reaches, Y / D
fig, axes = plt.subplots(2, 2, figsize=(7.5, 6.4), layout="constrained")
for ax, (name, reach) in zip(axes.flat, names.items(), strict=True):
    lens = optics.CompoundLens.preset(name)
    heights = torch.linspace(0, reach, 12)
    along = torch.stack([torch.zeros(12), heights], dim=-1)
    distortion, light = lens.distortion(along), lens.relative_illumination(along)
    x, y = np.meshgrid(*[np.linspace(-reach, reach, 33) / 2**0.5] * 2)  # the corner is at `reach`
    radius = np.hypot(x, y)
    x, y = (-lens.focal_length() / mm * side * (1 + 5 * np.interp(radius, heights, distortion)) for side in (x, y))
    shade = np.interp(radius, heights, light)
    shown = ax.pcolormesh(x, y, shade, vmin=0, vmax=1, cmap="gray", shading="gouraud")
    for u, v in ((x[:, ::4], y[:, ::4]), (x[::4].T, y[::4].T)):
        ax.plot(u, v, color="tab:orange", lw=1)
    ax.set(title=f"{name.replace('_', ' ')}: {distortion[-1]:+.1%}", aspect="equal", xlabel="x [mm]", ylabel="y [mm]")
fig.colorbar(shown, ax=axes, label="relative irradiance", shrink=0.7)
fig.suptitle("Distortion at the corner, drawn five times as strong, and vignetting")
plt.show()
