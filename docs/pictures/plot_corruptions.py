"""
What cameras do to pictures, five times worse
=============================================

Corruptions for tests of robustness, in physical units at five severities: a lens out of focus, colour fringes, the
corner's shadow, distortion, and noise at ISO 400 to 25 600.
"""

# %%
# ``corrupt`` gives the same picture at every call.

import matplotlib.pyplot as plt
import torch

from kcam import Scene, plots
from kcam.augmentation import corrupt

image = Scene.builtin("chelsea", size=(120, 160)).to_srgb()[0]
names = ("defocus", "chromatic_aberration", "vignetting", "barrel_distortion", "shot_read_noise")
rows = [torch.cat([corrupt(image, name, severity=s) for s in range(1, 6)], dim=-1) for name in names]

fig, ax = plt.subplots(figsize=(9, 6.6), layout="constrained")
ax.imshow(plots.as_image(torch.cat(rows, dim=-2)))
ax.set(xticks=80 + 160 * torch.arange(5), xticklabels=range(1, 6), xlabel="severity")
ax.set(yticks=60 + 120 * torch.arange(5), yticklabels=[name.replace("_", "\n") for name in names])
fig.suptitle("Five corruptions at five severities")
plt.show()
