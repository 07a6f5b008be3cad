"""
Two bits to eight
=================

An ADC rounds to its steps. With few of them a smooth background breaks into bands; a little noise before the rounding
hides them, for then chance decides between two steps, and the eye takes the mean.
"""

# %%
# Steps are of linear light, so the dark ones are the widest to the eye. Below, read noise of half a step is added.

import matplotlib.pyplot as plt
import torch

from kcam import Camera, Scene, isp, plots, sensor

scene = Scene.builtin("coffee", size=240)
fig, axes = plt.subplots(2, 4, figsize=(9, 3.7), layout="constrained")
for column, bits in zip(axes.T, (2, 3, 4, 8), strict=True):
    half_step = 0.5 / (2**bits - 1)
    for ax, sigma in zip(column, (0.0, half_step), strict=True):
        camera = Camera(
            sensor.ColourFilter.nikon(), sensor.Exposure(),
            sensor.ReadNoise(sigma * 10_000, full_well=10_000), sensor.ADC(bits=bits),
            isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(),
        )  # fmt: skip
        ax.imshow(plots.as_image(camera(scene, generator=torch.Generator().manual_seed(0))[0]))
        ax.axis("off")
    column[0].set_title(f"{bits} bits")
fig.suptitle("A picture in few steps, and (below) with half a step of noise before the rounding")
plt.show()
