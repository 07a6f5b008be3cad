"""
White light behind one lens
===========================

Glass bends blue light more than red, so a single lens has a focus for each colour. Seen from the side, daylight
becomes a spectrum: blue nearest to the lens, red farthest from it.
"""

# %%
# Each column is the middle line of the PSF on a sensor at that distance, in the colours of its light.

import matplotlib.pyplot as plt
import torch

from kcam import optics, spectral
from kcam.units import mm, um, wavelength_grid

bands = wavelength_grid(count=20)
elements = optics.CircularAperture(8 * mm), optics.PlanoConvexLens(25.94 * mm, glass="N-BK7")
focus = optics.Lens(*elements, focus_distance=float("inf")).sensor_distance
shifts = torch.linspace(-1.0, 1.0, 121) * mm
section = []
for shift in shifts.tolist():
    lens = optics.Lens(*elements, sensor_distance=focus + shift)
    section.append(lens.psf(bands, distances=float("inf"), pixel_pitch=1 * um, shape=(1, 121))[0, :, 0])
xyz = torch.einsum("slh,lc->chs", torch.stack(section).double(), spectral.xyz_weights(bands, "D65"))
colours = spectral.xyz_to_linear_srgb(xyz).clamp(min=0)
colours = (colours / colours.quantile(0.995)).clamp(max=1) ** 0.45

fig, ax = plt.subplots(figsize=(9, 4), layout="constrained")
ax.imshow(colours.permute(1, 2, 0).numpy(), aspect="auto", extent=(-1.0, 1.0, 60.5, -60.5))
ax.set(xlabel="sensor behind the focus of 550 nm [mm]", ylabel="height [µm]")
fig.suptitle("Daylight near the focus of one lens of N-BK7: 50 mm at f/6.2")
plt.show()
