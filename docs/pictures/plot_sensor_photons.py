"""
From one photon to a thousand
=============================

Light comes in grains. With one photon to a pixel there is hardly a picture; a thousand make one whose noise is some
three per cent. A hundred times the light brings ten times the
signal to noise ratio.
"""

# %%
# Photons are counted exactly: Poisson draws, whose deviation is the square root of their mean. A white pixel counts as
# many as the titles say.

import matplotlib.pyplot as plt
import torch

from kcam import Scene, plots, sensor, spectral
from kcam.isp import tone_curve

scene, generator = Scene.builtin("astronaut", size=256), torch.Generator().manual_seed(0)
linear = spectral.xyz_to_linear_srgb(scene.xyz())[0].clamp(0, 1)
fig, axes = plt.subplots(2, 2, figsize=(7, 7.4), layout="constrained")
for ax, photons in zip(axes.flat, (1, 10, 100, 1000), strict=True):
    counted = sensor.poisson(photons * linear, generator=generator)
    ax.imshow(plots.as_image(tone_curve(counted / photons)))
    white = sensor.poisson(torch.full((10_000,), float(photons)), generator=generator)
    assert abs(white.std() / photons**0.5 - 1) < 0.05
    ax.set_title(f"{photons}: noise {photons**-0.5:.0%}")
    ax.axis("off")
fig.suptitle("Photons in a white pixel, for each of three colours, and their noise")
plt.show()
