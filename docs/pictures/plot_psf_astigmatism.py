"""
Astigmatism: two foci at right angles
=====================================

A lens that is stronger in one direction than in the other has two foci. A star becomes an upright line in one of
them, a level line in the other, and between them a small square: the circle of least confusion.
"""

# %%
# Half a wave RMS of Zernike's Z6, and defocus that takes the sensor through both foci. Defocus is given as a vergence,
# in dioptres (1/m).

import matplotlib.pyplot as plt
import torch

from kcam import optics
from kcam.units import mm, nm, um

wavelength = 550 * nm
astigmatism = optics.ZernikeAberration(torch.tensor([0, 0, 0, 0, 0, 0.5 * wavelength]))
vergences = torch.linspace(-0.6, 0.6, 7)
panels = []
for vergence in vergences.tolist():
    elements = optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), astigmatism, optics.Defocus(vergence)
    lens = optics.Lens(*elements, focus_distance=float("inf"))
    psf = lens.psf([wavelength], distances=float("inf"), pixel_pitch=1 * um, shape=(121, 121))[0, 0]
    panels.append((psf / psf.max()).sqrt())

fig, ax = plt.subplots(figsize=(9, 2.3), layout="constrained")
ax.imshow(torch.cat(panels, dim=1).numpy(), cmap="magma")
ax.set(xticks=60 + 121 * torch.arange(7), xticklabels=[f"{v:+.1f}" for v in vergences.tolist()], yticks=[])
ax.set_xlabel("defocus [1/m]; each panel is 121 µm wide")
fig.suptitle("A star through the two foci of astigmatism: 50 mm at f/10")
plt.show()
