"""
Vortices: rings of light
========================

A phase that winds around the axis leaves a dark hole in the middle of the focus, where all phases meet and cancel. The
more often it winds, the larger the ring.
"""

# %%
# Above the height of the element, below its PSF at 550 nm behind a perfect lens.

import matplotlib.pyplot as plt
import torch

from kcam import optics
from kcam.units import mm, nm, um

side = (torch.arange(256) + 0.5) / 128 - 1
angle = torch.atan2(side[:, None], side[None])
disc = torch.hypot(side[:, None], side[None]) <= 1

fig, axes = plt.subplots(2, 4, figsize=(8, 4.5), layout="constrained")
for column, charge in zip(axes.T, (1, 2, 4, 8), strict=True):
    vortex = optics.DOE(torch.remainder(charge * angle, 2 * torch.pi), design_wavelength=550 * nm)
    lens = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), vortex, focus_distance=2.0)
    psf = lens.psf([550 * nm], distances=2.0, pixel_pitch=0.5 * um, shape=(101, 101))[0, 0]
    assert psf[50, 50] < 0.01 * psf.max()
    shown = column[0].imshow(torch.where(disc, vortex.height_map() / um, torch.nan).numpy(), cmap="twilight")
    column[1].imshow(psf.clamp(min=0).sqrt().numpy(), cmap="inferno")
    column[0].set_title(f"{charge} turn{'s' if charge > 1 else ''}")
    for ax in column:
        ax.axis("off")
fig.colorbar(shown, ax=axes[0], label="height [µm]")
fig.suptitle("Vortices of fused silica, and their PSFs (50 µm wide, square root)")
plt.show()
