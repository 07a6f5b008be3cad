"""
Through a fence
===============

A fence in front of a large aperture vanishes: each point behind it is seen by some part of the lens. Through a small
aperture it stays. Light that is merely added up, without regard to what hides what, gets the picture wrong.
"""

# %%
# Wires at 25 cm before a photograph at 5 m, in focus. ``occlusion=False`` adds up the layers of depth. What
# stands right behind a wire no photograph knows: it is continued from beside, and leaves faint traces.

import matplotlib.pyplot as plt
import torch

from kcam import Camera, Scene, optics, plots
from kcam.units import mm, um

photo = Scene.builtin("chelsea", size=300).to_srgb()[0]
row, column = torch.meshgrid(torch.arange(photo.shape[1]), torch.arange(photo.shape[2]), indexing="ij")
wire = ((row + column) % 50 < 6) | ((row - column) % 50 < 6)
scene = Scene.from_rgb(torch.where(wire, 0.15, photo), depth=torch.where(wire, 0.25, 5.0))

panels = {"f/16": (16, True), "f/4": (4, True), "f/4, light added up": (4, False)}
fig, axes = plt.subplots(2, 2, figsize=(8, 5.8), layout="constrained")
axes[0, 0].imshow(plots.as_image(scene.to_srgb()[0]))
axes[0, 0].set_title("the scene")
for ax, (name, (f_number, occlusion)) in zip(axes.flat[1:], panels.items(), strict=True):
    lens = optics.Lens(optics.CircularAperture(16 * mm / f_number), optics.ThinLens(16 * mm), focus_distance=5.0)
    camera = Camera(optics.Imaging(lens, pixel_pitch=6 * um, occlusion=occlusion), *Camera.ideal())
    ax.imshow(plots.as_image(camera(scene)[0]))
    ax.set_title(name)
for ax in axes.flat:
    ax.axis("off")
fig.suptitle("A fence at 25 cm, and a cat behind it in focus")
plt.show()
