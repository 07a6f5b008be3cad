"""
What a tolerance leaves out
===========================

A plan computes no more of the physics than a tolerance asks for. Here is what three plans leave out of a picture,
brightened twenty times: the looser the tolerance, the more of it, first where edges are out of focus.
"""

# %%
# The tolerance is the RMS error of the raw signal, relative to its own RMS. Each plan keeps its word.

import matplotlib.pyplot as plt

from kcam import Camera, Scene, plots

scene, camera = Scene.builtin("motorcycle", size=240), Camera.phone().noiseless()
exact, raw = camera(scene)[0], camera.raw(scene)
fig, axes = plt.subplots(2, 2, figsize=(8, 5.9), layout="constrained")
axes[0, 0].imshow(plots.as_image(exact))
axes[0, 0].set_title("everything computed")
for ax, tolerance in zip(axes.flat[1:], (0.1, 0.03, 0.01), strict=True):
    planned = camera.plan(scene, tolerance=tolerance).apply(camera)
    error = (planned.raw(scene) - raw).norm() / raw.norm()
    assert error <= tolerance
    difference = (planned(scene)[0] - exact).norm(dim=0)
    shown = ax.imshow(difference.numpy(), cmap="magma", vmin=0, vmax=0.05)
    ax.set_title(f"tolerance {tolerance:g}: error {error:.4f}")
for ax in axes.flat:
    ax.axis("off")
fig.colorbar(shown, ax=axes, label="difference of the picture")
fig.suptitle("A motorcycle through a phone, and what three plans leave out")
plt.show()
