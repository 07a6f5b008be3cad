"""
A lens that writes a letter
===========================

The phase of this element is trained until a star becomes a letter. Its PSF is differentiable, so the loss is the
difference to the letter, and gradient descent finds the phase.
"""

# %%
# A map of 96 x 96 pixels behind a perfect lens, 80 steps of Adam from a random start. The letter is a picture of the
# font that matplotlib brings.

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath

from kcam import optics
from kcam.units import mm, nm, um

outline = TextPath((0, 0), "k", size=44, prop=FontProperties(weight="bold"))
centre = (outline.vertices.min(0) + outline.vertices.max(0)) / 2
grid = np.stack(np.meshgrid(np.arange(65) - 32, 32 - np.arange(65)), axis=-1).reshape(-1, 2)
target = torch.tensor(outline.contains_points(grid + centre)).reshape(65, 65).float()
target /= target.sum()

phase = torch.nn.Parameter(3 * torch.randn(96, 96, generator=torch.Generator().manual_seed(0)))
elements = optics.CircularAperture(2 * mm), optics.ThinLens(50 * mm), optics.DOE(phase, design_wavelength=550 * nm)
lens = optics.Lens(*elements, focus_distance=2.0)
optimiser, losses = torch.optim.Adam([phase], lr=0.2), []
for _ in range(80):
    psf = lens.psf([550 * nm], distances=2.0, pixel_pitch=8 * um, shape=(65, 65))[0, 0]
    # of amplitudes, so that a few bright pixels do not count for all
    loss = ((psf + 1e-6).sqrt() - target.sqrt()).square().sum()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    losses.append(loss.item())

fig, axes = plt.subplots(1, 3, figsize=(9, 3.2), layout="constrained")
axes[0].imshow(torch.remainder(phase.detach(), 2 * torch.pi).numpy(), cmap="twilight")
axes[0].set(title="Phase over the aperture", xticks=[], yticks=[])
axes[1].imshow(psf.detach().clamp(min=0).sqrt().numpy(), cmap="inferno")
axes[1].set(title="PSF, 520 µm wide", xticks=[], yticks=[])
axes[2].plot(losses)
axes[2].set(title="Loss", xlabel="step")
fig.suptitle("A diffractive element that turns a star into a letter")
plt.show()
print(f"{psf[target > 0].sum():.0%} of the light in the letter")
