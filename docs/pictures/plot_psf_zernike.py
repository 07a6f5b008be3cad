"""
The pyramid of Zernike polynomials
==================================

Whatever is wrong with a wavefront is a sum of these shapes: here is what each of them alone makes of a star. Rows are
the radial order, columns the angular frequency; defocus and spherical aberration stand in the middle.
"""

# %%
# Each has 0.15 waves RMS of optical path. Noll counts them row by row, even numbers to the right (cosines) and odd ones
# to the left (sines).

import matplotlib.pyplot as plt
import torch

from kcam import optics
from kcam.units import mm, nm, um

wavelength, side, orders = 550 * nm, 61, 6
canvas = torch.zeros(orders * side, orders * side)
fig, ax = plt.subplots(figsize=(6.5, 6.5), layout="constrained")
j = 0
for n in range(orders):
    for m in [k for k in range(n % 2, n + 1, 2) for _ in range(2 if k else 1)]:
        j += 1
        coefficients = torch.zeros(j)
        coefficients[-1] = 0.15 * wavelength
        aberration = optics.ZernikeAberration(coefficients)
        lens = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), aberration, focus_distance=2.0)
        psf = lens.psf([wavelength], distances=2.0, pixel_pitch=1 * um, shape=(side, side))[0, 0]
        column = (orders - 1 + (m if j % 2 == 0 else -m)) * side // 2
        canvas[n * side : (n + 1) * side, column : column + side] = (psf / psf.max()).sqrt()
        ax.text(column + 4, n * side + 11, f"Z{j}", color="white", fontsize=9)
ax.imshow(canvas.numpy(), cmap="inferno")
ax.set(xticks=[side / 2 * (k + 1) for k in range(11)], xticklabels=range(-5, 6), xlabel="angular frequency m")
ax.set(yticks=[side * (n + 0.5) for n in range(orders)], yticklabels=range(orders), ylabel="radial order n")
fig.suptitle("What each Zernike polynomial makes of a star: 61 µm wide, f/10")
plt.show()
