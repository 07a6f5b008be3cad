"""
A star through focus
====================

A point of white light comes nearer, through the distance of focus at 2 m, before a perfect lens and before one of
plain glass. Glass bends blue light more than red, so on one side of focus its rim is blue, and on the other red.
"""

# %%
# One strip for each lens. Each point is scaled to nearly its own peak, and its square root is shown.

import matplotlib.pyplot as plt
import torch

from kcam import optics, spectral
from kcam.units import mm, um, wavelength_grid

bands = wavelength_grid(count=16)
distances = 1 / torch.linspace(1 / 2 - 0.45, 1 / 2 + 0.45, 7)  # even steps of vergence are even steps of blur
lenses = {"perfect": optics.ThinLens(50 * mm), "N-BK7": optics.PlanoConvexLens(25.8 * mm, glass="N-BK7")}

fig, axes = plt.subplots(2, 1, figsize=(9, 3.6), layout="constrained", sharex=True)
for ax, (name, glass) in zip(axes, lenses.items(), strict=True):
    lens = optics.Lens(optics.CircularAperture(5 * mm), glass, focus_distance=2.0)
    psf = lens.psf(bands, distances=distances, pixel_pitch=2 * um, shape=(91, 91))
    xyz = torch.einsum("zlhw,lc->zchw", psf.double(), spectral.xyz_weights(bands, "D65"))
    colours = spectral.xyz_to_linear_srgb(xyz).clamp(min=0)
    colours = (colours / colours.flatten(1).quantile(0.998, dim=1)[:, None, None, None]).clamp(max=1).sqrt()
    ax.imshow(torch.cat(list(colours), dim=-1).permute(1, 2, 0).numpy())
    ax.set_ylabel(name)
    ax.set(xticks=45 + 91 * torch.arange(7), xticklabels=[f"{z:.2f}" for z in distances.tolist()], yticks=[])
axes[1].set_xlabel("distance of the point [m]; each panel is 182 µm wide")
fig.suptitle("A white point through focus: 50 mm at f/10, focused at 2 m")
plt.show()
