"""
A pinhole camera
================

Without a lens, a hole makes the picture. A large one blurs by its size and a small one by diffraction; in between is
the sharpest, and yet it gets a fraction of the light of a lens.
"""

# %%
# The hole is 5 mm from the sensor. The two blurs are alike near :math:`d = \sqrt{2.44 \, \lambda z}`, 82 µm here.
# Exposure is automatic: the titles say how many times as long it takes as behind the lens of f/2.

import math

import matplotlib.pyplot as plt

from kcam import Camera, Scene, optics, plots
from kcam.units import mm, nm, um

distance, scene = 5 * mm, Scene.builtin("astronaut", size=256)
best = math.sqrt(2.44 * 550 * nm * distance)
assert round(best / um) == 82
cases = {f"{d / um:.0f} µm": (optics.CircularAperture(d),) for d in (240 * um, best, 52 * um)}
cases["lens of f/2"] = (optics.CircularAperture(2.5 * mm), optics.ThinLens(distance))
fig, axes = plt.subplots(2, 2, figsize=(7, 7.4), layout="constrained")
for ax, (name, elements) in zip(axes.flat, cases.items(), strict=True):
    lens = optics.Lens(*elements, sensor_distance=distance)
    camera = Camera(optics.Imaging(lens, pixel_pitch=10 * um), *Camera.ideal())
    ax.imshow(plots.as_image(camera(scene.with_depth(float("inf")))[0]))
    ax.set_title(f"{name}: {(lens.f_number / 2) ** 2:,.0f} ×")  # noqa: RUF001
    ax.axis("off")
fig.suptitle("Three pinholes and a lens, and the exposure time that each needs")
plt.show()
