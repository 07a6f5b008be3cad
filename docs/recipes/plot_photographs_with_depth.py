"""
Photographs with depth
======================

A folder of photographs and a folder of depth maps, as an RGB-D camera writes them, become a data set, scenes for a
camera, and batches for augmentations that know the distance of each pixel. Depth that was not measured is filled, and
marked in a mask.
"""

# %%
# A folder
# --------
#
# Here we write one: three parts of the built-in motorcycle, whose distances come from a pair of stereo pictures. Depth
# is a PNG of 16 bits in millimetres, and 0 where nothing was measured: stereo pictures have no match where one camera
# sees what the other does not. The built-in scene has such pixels filled, so we ask the disparity which they are.

import tempfile
import textwrap
from pathlib import Path

import kornia.augmentation as K
import matplotlib.pyplot as plt
import numpy as np
import skimage.data
import torch
from PIL import Image
from torch.utils.data import DataLoader

import kcam.augmentation as KC
from kcam import Camera, Scene, isp, optics, plots, sensor
from kcam.data import PhotoDataset
from kcam.units import mm, um

motorcycle = Scene.builtin("motorcycle")
picture, depth = motorcycle.to_srgb()[0], motorcycle.depth[0, 0].numpy()
measured = np.isfinite(skimage.data.stereo_motorcycle()[2])
millimetres = np.where(measured, 1000 * depth, 0).round().astype(np.uint16)

folder = tempfile.TemporaryDirectory()
rgb, depths = Path(folder.name, "rgb"), Path(folder.name, "depth")
rgb.mkdir()
depths.mkdir()
corners = {"left": (150, 0), "middle": (200, 230), "right": (120, 421)}  # top and left, in pixels
for name, (top, left) in corners.items():
    window = slice(top, top + 240), slice(left, left + 320)
    plots.write_picture(picture[:, *window], rgb / f"{name}.png")
    Image.fromarray(millimetres[window]).save(depths / f"{name}.png")

# %%
# A data set
# ----------
#
# ``PhotoDataset`` pairs pictures and maps by name. An item has the picture in sRGB, the distance in metres, a mask that
# is True where it was measured, and the name. What was not measured takes the distance of the nearest pixel that was,
# so depth always makes a scene.

photos = PhotoDataset(rgb, depths)  # depth_scale=1e-3, millimetres, is the default
print(len(photos), photos.names)
for image, depth, mask, name in photos:
    shape, range_ = tuple(image.shape), f"{depth.min():.2f} to {depth.max():.2f} m"
    print(f"{name:10s} {shape}, {range_}, measured: {mask.float().mean():.1%}")

image, depth, mask, _ = photos[2]
holes = torch.where(mask, depth, torch.nan)
figure, axes = plt.subplots(1, 3, figsize=(9, 2.7), layout="constrained")
axes[0].imshow(plots.as_image(image))
axes[0].set_title("Photograph")
for ax, title, shown in zip(axes[1:], ("As measured", "As filled"), (holes, depth), strict=True):
    drawn = ax.imshow(shown[0].numpy(), cmap="viridis", vmin=2, vmax=4.5)
    ax.set_title(f"Depth: {title.lower()}")
figure.colorbar(drawn, ax=axes, shrink=0.75, label="distance [m]")
for ax in axes:
    ax.axis("off")

# %%
# A picture without its map is an error that names it, so that none is lost by a typing mistake. To leave such pictures
# out say ``missing="skip"``; to put them all at one distance, ``depth=``.

plots.write_picture(Scene.builtin("coffee", size=(240, 320)).to_srgb()[0], rgb / "cup.png")
try:
    PhotoDataset(rgb, depths)
except FileNotFoundError as error:
    print(textwrap.fill(str(error).replace(folder.name, "..."), 100))
skipping = PhotoDataset(rgb, depths, missing="skip")
print("left out:", skipping.skipped)
flat = PhotoDataset(rgb, depths, depth=1.5)
print(f"{flat.names[0]}: {flat[0].depth.unique().item()} m, measured: {bool(flat[0].mask.any())}")
(rgb / "cup.png").unlink()

# %%
# Through a camera
# ----------------
#
# ``photos.scene(i)`` is one picture as a ``Scene``, here of 200 pixels: ``size=`` shrinks pictures in linear light, and
# picks distances without mixing them. A lens of 25 mm at f/5.6 sees it twice, focused at the motorcycle and at the
# boxes behind it.


def camera(focus_distance):
    aperture = optics.CircularAperture(25 * mm / 5.6)
    lens = optics.Lens(aperture, optics.ThinLens(25 * mm), focus_distance=focus_distance)
    return Camera(
        optics.Imaging(lens, pixel_pitch=4 * um), sensor.ColourFilter.nikon(), sensor.Mosaic("RGGB"),
        sensor.Exposure(), sensor.ShotNoise(full_well=10_000), sensor.ReadNoise(3.0), sensor.ADC(bits=12),
        isp.Demosaic(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(),
    )  # fmt: skip


near, far = camera(2.2), camera(3.7)
photos = PhotoDataset(rgb, depths, size=200)
scene = photos.scene(2)
print(scene)
named = {"Focused at 2.2 m": near, "Focused at 3.7 m": far}
figure = plt.figure(plots.compare(named, scene, zoom=(0.25, 0.45), title=" "))
title = figure.suptitle("A photograph with depth through one lens, focused at two distances", fontsize=15)

# %%
# ``Scene.from_folder`` is the whole folder at once, as one batch, where all pictures have one size and fit into memory.

batch = Scene.from_folder(rgb, depths, size=160)
pictures = near(batch, generator=torch.Generator().manual_seed(0))
print(batch)
print("pictures", tuple(pictures.shape))

# %%
# In batches, with augmentations
# ------------------------------
#
# For training, a ``DataLoader`` makes batches of these tuples. ``crop=`` cuts a window at random from each picture, the
# same from its map and its mask; ``seed=`` makes them the same each time.

windows = PhotoDataset(rgb, depths, size=200, crop=128, seed=0)
loader = DataLoader(windows, batch_size=3, shuffle=True, generator=torch.Generator().manual_seed(0))
batch = next(iter(loader))
print(batch.name, tuple(batch.image.shape), tuple(batch.depth.shape), tuple(batch.mask.shape))

# %%
# ``KC.CameraSequential`` is Kornia's container in which the first mask is inverse depth [1/m]. ``RandomDefocus`` sees
# it as the flips before it left it. The second mask, of what was measured, goes the same way.

augment = KC.CameraSequential(
    K.RandomHorizontalFlip(p=0.5),
    KC.RandomDefocus(focus=(2.1, 4.5), f_number=(2.0, 4.0), focal_length=(25 * mm, 25 * mm), p=1.0),
    KC.RandomShotReadNoise(iso=(100, 800), p=1.0),
    data_keys=["input", "mask", "mask"],
)
torch.manual_seed(5)
image, inverse_depth, valid = augment(batch.image, 1 / batch.depth, batch.mask.float())
figure, axes = plt.subplots(2, 3, figsize=(9, 6), layout="constrained")
figure.suptitle("Three windows, and what the augmentation made of them")
for above, below, before, after in zip(*axes, batch.image, image, strict=True):
    above.imshow(plots.as_image(before))
    below.imshow(plots.as_image(after))
    for ax in (above, below):
        ax.axis("off")

# %%
# What was not measured
# ---------------------
#
# *As a target* it is worth nothing, so leave it out of a loss: here of a guess that all is equally far.

measured = valid > 0.5  # (B, 1, H, W)
guess = inverse_depth[measured].mean().expand_as(inverse_depth)
loss = (guess - inverse_depth)[measured].abs().mean()
print(f"mean error {loss:.3f} 1/m, over {measured.float().mean():.1%} of the pixels")

# %%
# *As a place in a scene* it needs some distance, and the nearest measured pixel's is a guess. The built-in motorcycle
# guesses otherwise: what only one camera sees lies behind an edge, so it takes the farther of the neighbours on both
# sides. We take the picture with both.

top, left = corners["right"]
behind = motorcycle.crop(top=top, left=left, height=240, width=320).resized(200).depth
unknown = ~photos[2].mask[None]
assert torch.allclose(behind[~unknown], scene.depth[~unknown], atol=1e-3)  # the map's millimetres
farther = (behind - scene.depth)[unknown] > 0.1

quiet = near.noiseless()
difference = (quiet(scene.with_depth(behind)) - quiet(scene)).square().mean(1, keepdim=True)
inside, outside = (difference[where].mean().sqrt() for where in (unknown, ~unknown))
print(f"farther by over 10 cm: {farther.float().mean():.0%} of the unmeasured pixels")
print(f"RMS difference of the pictures: {inside:.3f} where depth was not measured, {outside:.3f} elsewhere")
assert outside < inside < 0.05
folder.cleanup()

# %%
# A small difference: holes are narrow, and what is wrong in them reaches no farther than the blur. Where it counts,
# fill the map yourself and give it to ``scene.with_depth(...)``, or save it as a float TIFF in metres.
# ``kcam.data.read_depth`` reads a map alone, with NaN where nothing was measured.
