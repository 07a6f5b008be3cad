"""
Diffraction on a Siemens star
=============================

Stopped down, a lens without any fault still loses fine detail: the grey spot in the middle of the star grows with the
f-number.
"""

# %%
# Nothing finer than :math:`1 / \lambda N` passes a lens of f-number :math:`N`. The 36 spokes are that fine at the
# radius :math:`36 \, \lambda N / 2 \pi`, which is dashed for 550 nm.

import math

import matplotlib.pyplot as plt

from kcam import Camera, Scene, optics, plots
from kcam.units import mm, nm, um

scene, pitch = Scene.builtin("star", size=300), 2 * um
fig, axes = plt.subplots(2, 2, figsize=(7, 7.4), layout="constrained")
for ax, f_number in zip(axes.flat, (4, 8, 16, 32), strict=True):
    aperture = optics.CircularAperture(50 * mm / f_number)
    lens = optics.Lens(aperture, optics.ThinLens(50 * mm), focus_distance=2.0)
    camera = Camera(optics.Imaging(lens, pixel_pitch=pitch), *Camera.ideal())
    ax.imshow(plots.as_image(camera(scene)[0])[50:250, 50:250])
    radius = 36 * 550 * nm * lens.f_number / (2 * math.pi) / pitch  # pixels; f_number counts the lens's extension
    ax.add_patch(plt.Circle((99.5, 99.5), radius, fill=False, color="tab:red", ls="--"))
    ax.set_title(f"f/{f_number}")
    ax.axis("off")
fig.suptitle("A Siemens star stopped down: 400 µm of the sensor, and the limit of diffraction")
plt.show()
