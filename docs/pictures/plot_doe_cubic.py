"""
A cubic phase for depth of field
================================

Behind a cubic phase the picture is blurred, but nearly alike at all distances. One filter sharpens it at all of them,
where a lens alone loses what is out of focus for good.
"""

# %%
# This is wavefront coding, of Dowski and Cathey (1995). The filter is Wiener's, from the PSF in focus; both pictures
# have noise of 0.1 % and get theirs.

import matplotlib.pyplot as plt
import torch

from kcam import Scene, optics
from kcam.units import mm, nm, um

side = (torch.arange(256) + 0.5) / 128 - 1
cubic = optics.DOE(20 * (side[:, None] ** 3 + side**3), design_wavelength=550 * nm)
scene = Scene.builtin("star", size=200, wavelengths=torch.tensor([550]) * nm)
distances, noise = (1.1, 1.35, 2.0, 3.0), 0.001
generator = torch.Generator().manual_seed(0)
shape, pitch = (121, 121), 4 * um

fig, axes = plt.subplots(2, 4, figsize=(8, 4.5), layout="constrained")
for row, (name, elements) in zip(axes, {"lens": (), "cubic and filter": (cubic,)}.items(), strict=True):
    lens = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), *elements, focus_distance=1.6)
    psf = lens.psf([550 * nm], distances=1.6, pixel_pitch=pitch, shape=shape)[0, 0]
    centred = torch.zeros(scene.shape[1:])
    centred[:121, :121] = psf.flip(0, 1)  # the picture is upright, light on the sensor is not
    transfer = torch.fft.fft2(centred.roll((-60, -60), (0, 1)))
    wiener = transfer.conj() / (transfer.abs() ** 2 + 2e-4)
    imaging = optics.Imaging(lens, pixel_pitch=pitch, psf_shape=shape, border="periodic")
    for ax, distance in zip(row, distances, strict=True):
        picture = imaging(scene.with_depth(distance))[0, 0]
        picture = picture + noise * torch.randn(picture.shape, generator=generator)
        sharpened = torch.fft.ifft2(torch.fft.fft2(picture) * wiener).real
        ax.imshow(sharpened[40:160, 40:160].numpy(), cmap="gray", vmin=0, vmax=1.1 * imaging(scene).max())
        ax.set_title(f"{name}: {distance:g} m", fontsize=10)
        ax.axis("off")
fig.suptitle("A Siemens star at four distances, sharpened by one filter")
plt.show()
