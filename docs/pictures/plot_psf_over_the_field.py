"""
Stars over the field of a real lens
===================================

A double Gauss, wide open, images a star as a point only in the middle. Towards the corners coma and astigmatism stretch
it into crosses, and its colours come apart.
"""

# %%
# The lens is Tronnier's patent of 1954. Each panel stands where its star is on the sensor, is scaled to its own peak,
# and shows the square root. One quarter is computed, for the lens is round: the others are its mirror images.

import matplotlib.pyplot as plt
import torch

from kcam import optics, spectral
from kcam.units import um, wavelength_grid

lens = optics.CompoundLens.preset("double_gauss", focus_distance=20.0)
bands = wavelength_grid(count=7)
x, y = torch.meshgrid(torch.linspace(0, 0.28, 5), torch.linspace(0, 0.14, 3), indexing="xy")
field = -torch.stack([x, y], dim=-1).reshape(-1, 2)  # the image on the sensor is upside down
psf = lens.psf(bands, distances=20.0, pixel_pitch=1.5 * um, shape=(81, 81), field=field)[:, 0]
xyz = torch.einsum("flhw,lc->fchw", psf.double(), spectral.xyz_weights(bands, "D65"))
colours = spectral.xyz_to_linear_srgb(xyz).clamp(min=0)
colours = (colours / colours.amax((1, 2, 3), keepdim=True)).sqrt()
quarter = colours.unflatten(0, x.shape).permute(0, 3, 1, 4, 2).flatten(2, 3).flatten(0, 1)  # panels to a picture
half = torch.cat([quarter[:, 81:].flip(1), quarter], dim=1)
chart = torch.cat([half[81:].flip(0), half])

width, height = 14 * 9 / 8, 7 * 5 / 4  # mm from the middle to the edge of the outermost panels
fig, ax = plt.subplots(figsize=(9, 5.2), layout="constrained")
ax.imshow(chart.numpy(), extent=(-width, width, height, -height))
ax.set(xlabel="x on the sensor [mm]", ylabel="y on the sensor [mm]")
fig.suptitle(f"White stars over the sensor, 50 mm at f/{lens.f_number:.0f}; each panel is 122 µm wide")
plt.show()
