"""
Paintings that nobody painted
=============================

The styles that cameras are trained on are made, not taken: each a program that paints from a seed. So there is no
licence to ask for, and no two seeds are alike.
"""

# %%
# ``kcam train watercolour`` teaches a camera to take pictures in one of them.

import matplotlib.pyplot as plt

from kcam import plots
from kcam.style import STYLES, painting

fig, axes = plt.subplots(2, 3, figsize=(10.5, 7.2), layout="constrained")
for ax, name in zip(axes.flat, STYLES, strict=True):
    ax.imshow(plots.as_image(painting(name, size=256, seed=1)))
    ax.set_title(name)
    ax.axis("off")
fig.suptitle("Six styles, painted by seed")
plt.show()
