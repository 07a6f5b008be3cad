"""
Contrast through focus
======================

Contrast over spatial frequency while the sensor moves through focus. A perfect lens is symmetric; spherical aberration
has another best focus for coarse detail than for fine; astigmatism is sharp for level and upright lines in turn.
"""

# %%
# Each column is an MTF at 550 nm, without pixels. The aberrations are a quarter of a wave RMS.

import matplotlib.pyplot as plt
import torch

from kcam import optics
from kcam.units import mm, nm, um

wavelength, side, pitch = 550 * nm, 201, 2 * um
spherical, astigmatism = torch.zeros(11), torch.zeros(6)
spherical[10] = astigmatism[5] = 0.25 * wavelength  # Noll's Z11 and Z6
vergences = torch.linspace(-0.5, 0.5, 31)


def through_focus(coefficients):
    """The MTF along x and along y, (2, frequencies, vergences)."""
    found = []
    for vergence in vergences.tolist():
        elements = optics.ThinLens(50 * mm), optics.ZernikeAberration(coefficients), optics.Defocus(vergence)
        lens = optics.Lens(optics.CircularAperture(5 * mm), *elements, focus_distance=float("inf"))
        arguments = {"distances": float("inf"), "pixel_pitch": pitch, "shape": (side, side), "integrate": False}
        mtf = lens.mtf([wavelength], **arguments)[0, 0]
        found.append(torch.stack([mtf[side // 2, side // 2 :], mtf[side // 2 :, side // 2]]))
    return torch.stack(found, dim=-1)


upright, level = through_focus(astigmatism)
panels = {"perfect": through_focus(torch.zeros(1))[0], "spherical\naberration": through_focus(spherical)[0]}
panels |= {"astigmatism,\nupright lines": upright, "astigmatism,\nlevel lines": level}
finest = (side // 2 + 0.5) / (side * pitch) * mm
fig, axes = plt.subplots(1, 4, figsize=(9, 3.4), layout="constrained", sharey=True)
for ax, (name, mtf) in zip(axes, panels.items(), strict=True):
    shown = ax.imshow(mtf.numpy(), aspect="auto", origin="lower", extent=(-0.5, 0.5, 0, finest), vmin=0, vmax=1)
    ax.set(title=name, xlabel="defocus [1/m]", ylim=(0, 180))
axes[0].set_ylabel("line pairs per mm")
fig.colorbar(shown, ax=axes, label="contrast")
fig.suptitle("Modulation transfer through focus, 50 mm at f/10")
plt.show()
