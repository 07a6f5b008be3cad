"""
A blur from elsewhere: the shake of a hand
==========================================

A PSF need not come from a lens: here it is the path of a hand that shakes while the shutter is open. Each point of
the picture becomes that path.
"""

# %%
# Any array may be a PSF: measured, from another program, or drawn as this one. Light falls onto a sensor upside down,
# so the picture shows the path turned by half a turn.

import matplotlib.pyplot as plt
import torch

from kcam import Camera, Scene, optics, plots
from kcam.units import nm, um

speed = torch.randn(2, 400, generator=torch.Generator().manual_seed(6)).cumsum(1)
path = (speed - speed.mean(1, keepdim=True)).cumsum(1)  # a hand that comes back to where it was
path = (path - path.mean(1, keepdim=True)) / path.abs().max() * 15 + 16
trail = torch.zeros(33, 33)
trail.index_put_((path[1].round().long().clamp(0, 32), path[0].round().long().clamp(0, 32)), torch.tensor(1.0), True)
trail /= trail.sum()
shake = optics.MeasuredPSF(
    trail.expand(1, 2, 33, 33), wavelengths=[420 * nm, 720 * nm], distances=2.0, pixel_pitch=4 * um, focus_distance=2.0
)
scene, ideal = Scene.builtin("chelsea", size=360), Camera.ideal()
shaken = Camera(optics.Imaging(shake, pixel_pitch=4 * um), *ideal)

fig, axes = plt.subplots(1, 3, figsize=(9, 2.6), layout="constrained", width_ratios=[2, 3, 3])
axes[0].imshow(trail.flip(0, 1).numpy(), cmap="magma")
axes[0].set_title("The path, 132 µm wide")
for ax, (name, camera) in zip(axes[1:], {"At rest": ideal, "Shaken": shaken}.items(), strict=True):
    ax.imshow(plots.as_image(camera(scene)[0]))
    ax.set_title(name)
for ax in axes:
    ax.axis("off")
fig.suptitle("A hand that shakes, as a measured PSF")
plt.show()
