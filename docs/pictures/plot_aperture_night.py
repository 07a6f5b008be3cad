"""
A street at night, out of focus
===============================

Each lamp that is out of focus becomes a picture of the aperture, here of six blades: the larger, the farther it is from
the distance of focus. In focus it is a point with the rays of a star, for light diffracts at the six straight edges.
"""

# %%
# Lamps of four colours, at 1.4, 2, 4 and 50 m, behind a lens of 40 mm at about f/4.

from dataclasses import replace

import matplotlib.pyplot as plt
import torch

from kcam import Camera, Scene, isp, optics, plots, sensor
from kcam.units import mm, um, wavelength_grid

height, width = 200, 300
row, column = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
sky = torch.stack([0.10 + 0.05 * column, 0.10 + 0.02 * row, 0.20 - 0.08 * row])
generator = torch.Generator().manual_seed(2)
lamps, depth = torch.zeros(3, height, width), torch.full((height, width), 50.0)
palette = torch.tensor([[1.0, 0.75, 0.4], [1.0, 0.4, 0.3], [0.5, 1.0, 0.6], [0.6, 0.8, 1.0]])
for _ in range(70):
    y, x, kind, place = (int(n * torch.rand((), generator=generator)) for n in (height, width, 4, 4))
    lamps[:, y, x] = 120 * palette[kind]
    depth[y, x] = (50.0, 4.0, 2.0, 1.4)[place]
scene = Scene.from_rgb(sky, depth=depth, wavelengths=wavelength_grid(count=12))
scene = replace(scene, coefficients=scene.coefficients + lamps)  # brighter than white, which from_rgb does not take

y, x = torch.meshgrid(torch.linspace(-1, 1, 64), torch.linspace(-1, 1, 64), indexing="ij")
blades = [(x * torch.cos(a) + y * torch.sin(a)).abs() < 0.86 for a in torch.tensor([0, 1, 2]) * torch.pi / 3]
hexagon = optics.ApertureMap(torch.stack(blades).all(0).float(), width=12 * mm)
lens = optics.Lens(hexagon, optics.ThinLens(40 * mm), focus_distance=2.0)
camera = Camera(
    optics.Imaging(lens, pixel_pitch=6 * um, bands=4, psf_shape=(71, 71)),
    sensor.ColourFilter.nikon(), sensor.Exposure(), sensor.ShotNoise(),
    isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(),
)  # fmt: skip
picture = camera(scene, generator=torch.Generator().manual_seed(0))

fig, ax = plt.subplots(figsize=(8, 5.6), layout="constrained")
ax.imshow(plots.as_image(picture[0]))
ax.axis("off")
fig.suptitle("Lamps from 1.4 m to 50 m behind six blades, focused at 2 m")
plt.show()
