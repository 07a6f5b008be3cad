"""
The shape of an aperture is the shape of its blur
=================================================

What is far out of focus shows the hole through which the light came: round, a polygon of blades, the ring of a mirror
lens, a heart cut out of paper, or a code.
"""

# %%
# A point of daylight at 0.8 m, while the lens is focused at 2 m. Edges diffract, so the rims have fringes.

import math

import matplotlib.pyplot as plt
import torch

from kcam import optics, spectral
from kcam.units import mm, um, wavelength_grid

y, x = torch.meshgrid(*[torch.linspace(-1, 1, 256)] * 2, indexing="ij")
angle, radius = torch.atan2(y, x), torch.hypot(x, y)


def polygon(sides):
    half = math.pi / sides
    return radius * torch.cos(torch.remainder(angle + math.pi / 2, 2 * half) - half) < math.cos(half)


u, v = 1.25 * x, 0.1 - 1.25 * y
shapes = {
    "five blades": polygon(5),
    "six blades": polygon(6),
    "heart": (u**2 + v**2 - 1) ** 3 < u**2 * v**3,
    "star": radius < 0.62 + 0.36 * torch.cos(5 * (angle + math.pi / 2)),
    "crescent": (radius < 1) & (torch.hypot(x - 0.45, y) > 0.75),
    "code": torch.kron(torch.rand(7, 7, generator=torch.Generator().manual_seed(4)) > 0.45, torch.ones(36, 36)) > 0,
}
apertures = {"round": optics.CircularAperture(8 * mm), "mirror lens": optics.AnnularAperture(8 * mm, obscuration=0.5)}
apertures |= {name: optics.ApertureMap(shape.float(), width=8 * mm) for name, shape in shapes.items()}
bands = wavelength_grid(count=8)
fig, axes = plt.subplots(2, 4, figsize=(8, 4.5), layout="constrained")
for ax, (name, aperture) in zip(axes.flat, apertures.items(), strict=True):
    lens = optics.Lens(aperture, optics.ThinLens(50 * mm), focus_distance=2.0)
    psf = lens.psf(bands, distances=0.8, pixel_pitch=4 * um, shape=(101, 101))[0].double()
    xyz = torch.einsum("lhw,lc->chw", psf, spectral.xyz_weights(bands, "D65"))
    colours = spectral.xyz_to_linear_srgb(xyz).clamp(min=0)
    ax.imshow((colours / colours.quantile(0.998)).clamp(max=1).sqrt().permute(1, 2, 0).numpy())
    ax.set(title=name, xticks=[], yticks=[])
fig.suptitle("Eight apertures, and what they make of a point out of focus (404 µm wide)")
plt.show()
