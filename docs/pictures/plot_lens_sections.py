"""
Four lenses in section
======================

A triplet of 50 mm, a fast double Gauss, a telephoto that is shorter than its focal length, and a wide angle whose first
lens bends light apart so that there is room for a mirror. Rays of the middle of the field are dark, those of its edge
orange.
"""

# %%
# The prescriptions are those of patents and samples; ``CompoundLens.from_file`` reads Zemax and Optiland files too.

import matplotlib.pyplot as plt
import numpy as np
import torch

from kcam import optics
from kcam.units import mm

names = {"cooke_triplet": 0.34, "double_gauss": 0.2, "telephoto": 0.05, "wide_angle": 0.6}  # and a height Y / D
fig, axes = plt.subplots(2, 2, figsize=(9, 5), layout="constrained")
for ax, (name, height) in zip(axes.flat, names.items(), strict=True):
    lens = optics.CompoundLens.preset(name)
    for rays, colour in zip(lens.paths([0.0, height]), ("0.25", "tab:orange"), strict=True):
        ax.plot(*(rays / mm).permute(2, 1, 0), color=colour, lw=0.8)
    vertex, glass, last = 0.0, None, None
    for surface in lens.surfaces:
        semi = float(surface.semi_diameter)
        y = torch.linspace(-semi, semi, 61, dtype=torch.float64)
        z = vertex + surface.sag(y**2)[0]
        if glass is not None:  # glass between the last surface and this one
            ax.fill(np.r_[last[0], z.flip(0) / mm], np.r_[last[1], y.flip(0) / mm], color="lightsteelblue", zorder=0)
        glass, last = surface.glass, (z / mm, y / mm)
        ax.plot(*last, color="0.2", lw=1)
        vertex += float(surface.thickness)
    sensor = vertex + float(lens.sensor_distance)
    ax.axvline(sensor / mm, color="0.2", lw=2)
    ax.set(title=f"{name.replace('_', ' ')}: {lens.focal_length() / mm:.0f} mm f/{lens.f_number:.1f}", aspect="equal")
    ax.set(xlabel="z [mm]", ylabel="y [mm]")
fig.suptitle("Four lenses in section, focused at infinity, and their sensors")
plt.show()
