"""
Depth of field at four f-numbers
================================

A lens of 50 mm is focused on the motorcycle's tank, 2.3 m away. Wide open only the tank is sharp; the smaller the
aperture, the more of the room is.
"""

# %%
# The scene has a true depth map, from 2.1 m to 5 m. It is cut into planes that are an even step of vergence apart, as
# steps of blur are: a map of few distances is rendered plane by plane, in a fraction of the time.

import matplotlib.pyplot as plt
import torch

from kcam import Camera, Scene, optics, plots
from kcam.units import mm, um

scene = Scene.builtin("motorcycle", size=300)
scene = scene.with_depth(1 / (torch.round(40 / scene.depth) / 40))
fig, axes = plt.subplots(2, 2, figsize=(8, 5.8), layout="constrained")
for ax, f_number in zip(axes.flat, (2.8, 5.6, 11, 22), strict=True):
    lens = optics.Lens(optics.CircularAperture(50 * mm / f_number), optics.ThinLens(50 * mm), focus_distance=2.3)
    camera = Camera(optics.Imaging(lens, pixel_pitch=8 * um, psf_shape=(63, 63)), *Camera.ideal())
    ax.imshow(plots.as_image(camera(scene)[0]))
    ax.set_title(f"f/{f_number}")
    ax.axis("off")
fig.suptitle("Depth of field: 50 mm, focused at 2.3 m")
plt.show()
