"""
Astigmatism: two foci at right angles
=====================================

A lens that is stronger in one direction than in the other has two foci. A star becomes an upright line in one of
them, a level line in the other, and between them a small square: the circle of least confusion.
"""

# %%
# Two strengths of Zernike's Z6, in waves RMS, and defocus that takes the sensor through both foci. Defocus is given as
# a vergence, in dioptres (1/m).

import matplotlib.pyplot as plt
import torch

from kcam import optics
from kcam.units import mm, nm, um

wavelength, vergences = 550 * nm, torch.linspace(-0.4, 0.4, 5)
fig, axes = plt.subplots(2, 1, figsize=(8, 4.4), layout="constrained", sharex=True)
for ax, waves in zip(axes, (0.25, 0.5), strict=True):
    astigmatism = optics.ZernikeAberration(torch.tensor([0, 0, 0, 0, 0, waves]) * wavelength)
    panels = []
    for vergence in vergences.tolist():
        elements = optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), astigmatism, optics.Defocus(vergence)
        lens = optics.Lens(*elements, focus_distance=float("inf"))
        psf = lens.psf([wavelength], distances=float("inf"), pixel_pitch=1 * um, shape=(101, 101))[0, 0]
        panels.append((psf / psf.max()).clamp(min=0).sqrt())
    ax.imshow(torch.cat(panels, dim=1).numpy(), cmap="magma")
    ax.set(xticks=50 + 101 * torch.arange(5), xticklabels=[f"{v:+.1f}" for v in vergences.tolist()], yticks=[])
    ax.set_ylabel(f"{waves:g} waves")
axes[1].set_xlabel("defocus [1/m]; each panel is 101 µm wide")
fig.suptitle("A star through the two foci of astigmatism: 50 mm at f/10")
plt.show()
