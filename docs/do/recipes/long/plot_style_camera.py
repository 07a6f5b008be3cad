"""
A camera that paints
====================

We teach a camera the manner of a painting: first what optics, filter and colours can learn of it, then with a small
network behind them, the style stage. We see what each of them brings on photographs that no training saw, save the
camera, and load it again.
"""

# %%
# The style
# ---------
#
# The painting is one that kcam makes by rule and chance; a picture of your own, as a tensor (3, H, W) in [0, 1], does
# as well. ``StyleLoss`` compares pictures with it: *style* are moments of oriented features at several scales, *colour*
# is how far the pixels' colours have to move, and *content* is how much of the scene's light and dark is lost. The
# preset "quick" of ``kcam train`` has weights for them; we take 400 of its 600 steps.

import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from skimage import data

from kcam import Camera, Scene, files, plots
from kcam.style import PRESETS, BuiltinScenes, StyleWarning, fit, painting, style_camera

style = painting("strokes", size=384)
another = painting("strokes", size=384, seed=1)  # by the same rule: as near to the style as one can get
quick = PRESETS["quick"]
loss = quick.style_loss(style)
settings = replace(quick.settings, steps=400)

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4.6), layout="constrained")
figure.suptitle("Two paintings by one rule")
for ax, picture, title in (left, style, "The style that is learned"), (right, another, "Another, to compare with"):
    ax.imshow(plots.as_image(picture))
    ax.set_title(title)
    ax.axis("off")

# %%
# The cameras
# -----------
#
# ``style_camera`` takes an ordinary picture: 50 mm at f/10, a Bayer mosaic, noise, 12 bits. What trains are the phase
# of a DOE in its aperture, the curves of its colour filter, a 3 x 3 convolution behind the demosaic, the gains and the
# colour matrix; and with ``stage=True``, the default, the style stage at its end. Training sees three of the built-in
# photographs. The cat and the rocket are kept for the test.
#
# ``fit`` looks at its own pictures: it warns of negatives, of pictures that clip, and of a filter that goes blind. The
# same words stand in ``advice``, so we print them at the end.

source = BuiltinScenes(settings.size, names=["astronaut", "coffee", "motorcycle"])
with warnings.catch_warnings():
    warnings.simplefilter("ignore", StyleWarning)
    alone = fit(style_camera(stage=False), loss, source=source, settings=replace(settings, steps=200))
    painter = fit(style_camera(), loss, source=source, settings=settings)
for name, trained in {"camera alone": alone, "with style stage": painter}.items():
    first, last = trained.history[:10, 0].mean(), trained.history[-10:, 0].mean()
    print(f"{name:17s} loss {first:.2f} -> {last:.2f}", *trained.advice, sep="\n    ")

figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained", sharey=True)
figure.suptitle("The loss and its terms, mean of 15 steps")
for ax, title, trained in zip(axes, ("Camera alone", "Camera and style stage"), (alone, painter), strict=True):
    smooth = trained.history.unfold(0, 15, 1).mean(-1)
    ax.semilogy(torch.arange(len(smooth)) + 8, smooth, label=trained.names)
    ax.set(title=title, xlabel="step", ylabel="loss")
axes[1].legend(ncols=2)

# %%
# Photographs that no training saw
# --------------------------------

rocket = torch.from_numpy(data.rocket()).permute(2, 0, 1)[:, :384, 150:534] / 255
scenes = {
    "cat": Scene.builtin("chelsea", size=(192, 192)),
    "rocket": Scene.from_rgb(torch.nn.functional.interpolate(rocket[None], size=(192, 192), mode="area")),
}
cameras = {
    "Ordinary camera": style_camera(stage=False),
    "Camera alone, trained": alone.camera,
    "With style stage": painter.camera,
}
with torch.no_grad():
    shots = {
        name: [camera(scene, generator=torch.Generator().manual_seed(0)) for scene in scenes.values()]
        for name, camera in cameras.items()
    }
rows = [[shots[name][row][0] for name in cameras] for row in range(len(scenes))]
plt.figure(plots.contact_sheet(rows, titles=list(cameras), labels=list(scenes)))

# %%
# In numbers: the part of the way from the ordinary camera's picture (0 %) to the other painting (100 %), in style and
# in colour.


@torch.no_grad()
def style_and_colour(picture):
    """How far pictures (B, 3, H, W) are from the style in strokes and in colour, without content."""
    terms = loss.terms(picture, picture)
    return torch.stack([terms["style"], terms["colour"]])


goal = style_and_colour(another[None, :, :192, :192])
far = {name: torch.stack([style_and_colour(shot) for shot in of_camera]).mean(0) for name, of_camera in shots.items()}
start = far["Ordinary camera"]
closed = {name: (start - now) / (start - goal) for name, now in far.items()}
for name, (of_style, of_colour) in closed.items():
    print(f"{name:22s} style {of_style:4.0%}   colour {of_colour:4.0%}")
assert closed["With style stage"].min() > closed["Camera alone, trained"][0] + 0.2

# %%
# What a camera can and cannot bring
# ----------------------------------
#
# The camera alone brings some of the colours and next to nothing of the strokes. That is no lack of training. Before
# any clipping its picture is each band, convolved with a PSF of positive light, weighted by positive curves, and mapped
# by matrices: the same at every place, so that *an even wall stays even*. Only what comes behind can paint on it. We
# photograph a grey wall, first without noise:

wall = Scene.from_rgb(torch.full((3, 96, 96), 0.5))
before_stage = painter.camera.noiseless()[:-1]  # a slice of a camera is a camera
with torch.no_grad():
    even = {"camera alone": alone.camera.noiseless()(wall)[0], "before the stage": before_stage(wall)[0]}
for name, picture in even.items():
    red, green, blue = picture.mean((-2, -1)).tolist()
    print(f"{name:17s} colour ({red:.2f}, {green:.2f}, {blue:.2f}), deviations up to {picture.std((-2, -1)).max():.5f}")
    assert picture.std((-2, -1)).max() < 1e-3

# %%
# Now with noise. The style stage has noise of its own, besides the sensor's, along which it draws its strokes: each
# seed is another painting of the same wall.

figure, axes = plt.subplots(1, 3, figsize=(9, 3.8), layout="constrained")
figure.suptitle("One even grey wall, three pictures")
with torch.no_grad():
    walls = {
        "Camera alone": alone.camera(wall, generator=torch.Generator().manual_seed(0)),
        "With style stage, seed 0": painter.camera(wall, generator=torch.Generator().manual_seed(0)),
        "With style stage, seed 1": painter.camera(wall, generator=torch.Generator().manual_seed(1)),
    }
for ax, (name, picture) in zip(axes, walls.items(), strict=True):
    print(f"{name:24s} standard deviation {picture[0].std((-2, -1)).mean():.3f}")
    ax.imshow(plots.as_image(picture[0]))
    ax.set_title(name)
    ax.axis("off")

# %%
# Save and load
# -------------
#
# One file holds the weights and a description in JSON; nothing is pickled. The camera that comes back takes the same
# picture, to the last bit.

with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "painter.safetensors"
    painter.camera.save(path)
    same = Camera.load(path)
    stages = files.describe(path)["configuration"]["arguments"]["stages"]
    print(f"{path.stat().st_size / 1e3:.0f} kB: " + ", ".join(stage["class"].split(".")[1] for stage in stages))
with torch.no_grad():
    again = same(scenes["cat"], generator=torch.Generator().manual_seed(0))
assert torch.equal(again, shots["With style stage"][0])

# %%
# In the shell
# ------------
#
# The command line does all of this, with checkpoints, a contact sheet and a report beside the camera, and goes on where
# it was stopped with ``--resume``. Without ``--steps`` it takes the whole preset.
#
# .. code-block:: sh
#
#    kcam train strokes --preset quick --steps 400 --out painter.safetensors
#    kcam train starry_night.jpg --photos holiday/ --out painter.safetensors   # pictures of your own
#    kcam train strokes --no-stage --out alone.safetensors                     # the camera alone
#    kcam shoot photo.jpg --camera painter.safetensors --seed 3 --out shot.png
#
# How far each part gets with full schedules, with four styles and several seeds, is measured in
# :doc:`What a camera can learn of a style </understand/style>`.

plt.show()
