"""
Moiré of a mosaic
=================

Each pixel of a sensor sees one colour only. Where grey rings are finer than the mosaic, the demosaic cannot tell detail
from colour, and invents both.
"""

# %%
# Rings that grow finer outwards, up to half a period in a pixel at the edges: seen by full pixels, through a Bayer
# mosaic, and through it behind a lens of f/11, whose diffraction takes the finest detail away before it can do harm.

import matplotlib.pyplot as plt
import torch

from kcam import Camera, Scene, isp, optics, plots, sensor
from kcam.units import mm, um

side = torch.arange(240) - 119.5
rings = 0.5 + 0.5 * torch.cos(torch.pi * (side[:, None] ** 2 + side**2) / 240)
scene = Scene.from_rgb(rings[None], depth=2.0)
lens = optics.Lens(optics.CircularAperture(50 * mm / 11), optics.ThinLens(50 * mm), focus_distance=2.0)
development = isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve()
bayer = sensor.ColourFilter.nikon(), sensor.Mosaic("RGGB"), sensor.Exposure(), isp.Demosaic(), *development
cameras = {
    "three colours in each pixel": Camera.ideal(),
    "Bayer": Camera(*bayer),
    "Bayer behind f/11": Camera(optics.Imaging(lens, pixel_pitch=2 * um), *bayer),
}
fig, axes = plt.subplots(1, 3, figsize=(9, 3.5), layout="constrained")
for ax, (name, camera) in zip(axes, cameras.items(), strict=True):
    ax.imshow(plots.as_image(camera(scene)[0]), interpolation="nearest")
    ax.set_title(name)
    ax.axis("off")
fig.suptitle("Grey rings that grow finer outwards, 240 pixels wide")
plt.show()
