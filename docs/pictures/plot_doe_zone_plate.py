"""
A lens that diffracts
=====================

The phase of a glass lens, cut back to one wave, is a lens hardly thicker than a micrometre. Its focal length is
inversely proportional to the wavelength: red is in focus nearest to it and blue farthest away, unlike with glass.
"""

# %%
# Left the profile that would be etched into fused silica, right daylight behind it, from the side. Green, for which it
# is designed, has its focus at 100 mm.

import matplotlib.pyplot as plt
import torch

from kcam import optics, spectral
from kcam.units import mm, nm, um, wavelength_grid

focal_length, design, diameter = 100 * mm, 550 * nm, 2 * mm
side = (torch.arange(256, dtype=torch.float64) + 0.5) / 256 - 0.5
r2 = (side[:, None] ** 2 + side**2) * diameter**2
phase = torch.remainder(-torch.pi * r2 / (design * focal_length), 2 * torch.pi)
element = optics.DOE(phase, design_wavelength=design)

bands = wavelength_grid(count=15)
places = torch.linspace(75, 135, 41)
section = []
for place in places.tolist():
    lens = optics.Lens(optics.CircularAperture(diameter), element, sensor_distance=place * mm)
    section.append(lens.psf(bands, distances=float("inf"), pixel_pitch=4 * um, shape=(101, 1))[0, :, :, 0])
xyz = torch.einsum("slh,lc->chs", torch.stack(section).double(), spectral.xyz_weights(bands, "D65"))
colours = spectral.xyz_to_linear_srgb(xyz).clamp(min=0)
colours = (colours / colours.quantile(0.998)).clamp(max=1).sqrt()

fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained", width_ratios=[1, 1.6])
shown = left.imshow(element.height_map().numpy() / um, extent=(-1, 1, 1, -1), cmap="bone")
left.set(title="Height [µm]", xlabel="x [mm]", ylabel="y [mm]")
fig.colorbar(shown, ax=left)
right.imshow(colours.permute(1, 2, 0).numpy(), aspect="auto", extent=(75, 135, 202, -202))
right.set(title="Daylight behind it", xlabel="distance behind the lens [mm]", ylabel="height [µm]")
fig.suptitle("A diffractive lens of 2 mm, and the rainbow of its foci")
plt.show()
