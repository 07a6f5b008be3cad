"""
Camera augmentations in a Kornia pipeline
=========================================

Camera effects stand in a Kornia pipeline like any other augmentation. Here is the whole of it: a data set, workers,
seeds that give the same pictures again, masks, boxes and keypoints, replay, depth, and tests of robustness.
"""

# %%
# A pipeline
# ----------
#
# ``import kcam.augmentation as KC`` beside Kornia's own. All augmentations work without arguments; here a few have
# ranges of their own. Order matters, as light has an order: optics, then sensor, then processing.

import warnings

import kornia.augmentation as K
import matplotlib.pyplot as plt
import torch
from matplotlib.patches import Rectangle
from torch.utils.data import DataLoader, Dataset

import kcam.augmentation as KC
from kcam import Scene, plots
from kcam.units import mm

augment = K.AugmentationSequential(
    K.RandomHorizontalFlip(p=0.5),
    KC.RandomDefocus(focus=(0.8, 3.0), distance=(0.8, 3.0), f_number=(1.8, 4.0), focal_length=8 * mm, p=0.8),
    KC.RandomLensDistortion(k1=(-0.3, 0.3), p=1.0),
    KC.RandomVignetting(p=0.5),
    KC.RandomBayer(pattern="random", p=1.0),
    KC.RandomShotReadNoise(iso=(400, 6400), p=1.0),
    KC.RandomWhiteBalance(p=0.5),
    K.RandomJPEG(jpeg_quality=(40.0, 90.0), p=0.5),
    data_keys=["input", "mask", "keypoints", "bbox_xyxy"],
)

# %%
# What flips and distorts a picture does the same to its mask, its keypoints and its boxes; what blurs it or adds noise
# leaves them as they are. The saucer of ``coffee`` has a mask and a box, its spoon a keypoint, all set by hand.

photograph = Scene.builtin("coffee", size=(160, 240)).to_srgb()
image = photograph.expand(4, -1, -1, -1)
y, x = torch.meshgrid(torch.arange(160.0), torch.arange(240.0), indexing="ij")
mask = (((x - 114) / 81) ** 2 + ((y - 89) / 66) ** 2 < 1).float().expand(4, 1, -1, -1)
box = torch.tensor([[[33.0, 23.0, 195.0, 155.0]]]).expand(4, -1, -1)
keypoint = torch.tensor([[[146.0, 114.0]]]).expand(4, -1, -1)

torch.manual_seed(0)  # Kornia draws from torch's default generator
out_image, out_mask, out_keypoint, out_box = augment(image, mask, keypoint, box)

figure, axes = plt.subplots(1, 4, figsize=(9, 2.1), layout="constrained")
figure.suptitle("Four draws of one pipeline: mask (white), box (cyan) and keypoint (yellow) follow")
for ax, picture, inside, (x0, y0, x1, y1), point in zip(
    axes, out_image, out_mask, out_box[:, 0].tolist(), out_keypoint[:, 0].tolist(), strict=True
):
    ax.imshow(plots.as_image(picture))
    ax.contour(inside[0].numpy(), levels=[0.5], colors="white", linewidths=1)
    ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor="cyan"))
    ax.plot(*point, "+", color="yellow", markersize=10)
    ax.axis("off")

# %%
# Exact replay
# ------------
#
# What was drawn is kept in ``augment._params``, Kornia's own name for it. With it a call repeats the last one bit for
# bit, noise included: noise is drawn from a seed for each sample, and the seeds are among the parameters.

again = augment(image, mask, keypoint, box, params=augment._params)
print("the same again:", all(torch.equal(one, other) for one, other in zip((out_image, out_mask), again, strict=False)))
assert torch.equal(out_image, again[0])
assert not torch.equal(out_image, augment(image, mask, keypoint, box)[0])

# %%
# A data set, workers and seeds
# -----------------------------
#
# A worker of a ``DataLoader`` has its own copy of torch's default generator, whose seed PyTorch draws from the loader's
# ``generator``. So with ``generator=torch.Generator().manual_seed(0)`` a run gives the same pictures again, and each
# epoch others, but with another number of workers other ones. A seed for each sample and epoch does not depend on that:


class Photographs(Dataset):
    """Pictures through a pipeline; sample i of an epoch is the same in any worker."""

    def __init__(self, pictures, augment, *, seed=0):
        self.pictures, self.augment, self.seed, self.epoch = pictures, augment, seed, 0

    def __len__(self):
        return len(self.pictures)

    def __getitem__(self, index):
        with torch.random.fork_rng(devices=[]):  # leaves the default generator as it was
            torch.manual_seed((self.seed * 1000 + self.epoch) * len(self) + index)
            return self.augment(self.pictures[index : index + 1])[0]


names = ("astronaut", "coffee", "chelsea", "motorcycle")
pictures = torch.cat([Scene.builtin(name, size=(96, 96)).to_srgb() for name in names]).repeat(2, 1, 1, 1)
in_worker = K.ImageSequential(KC.RandomDefocus(p=0.8), KC.RandomShotReadNoise(iso=(400, 6400)), KC.RandomBayer(p=1.0))
dataset = Photographs(pictures, in_worker)


def epoch(number, workers):
    """All pictures of an epoch, (N,3,H,W)."""
    dataset.epoch = number  # before the workers start: each has a copy of the data set
    context = "fork" if workers else None
    loader = DataLoader(dataset, batch_size=4, num_workers=workers, multiprocessing_context=context)
    with warnings.catch_warnings():
        # Python from 3.12 on warns where a process with threads forks. PyTorch's workers compute with one thread.
        warnings.filterwarnings("ignore", message=".*fork", category=DeprecationWarning)
        return torch.cat(list(loader))


first, again, second = epoch(0, workers=2), epoch(0, workers=2), epoch(1, workers=2)
print("epoch 0 again:", torch.equal(first, again))
print("epoch 0 without workers:", torch.equal(first, epoch(0, workers=0)))
print("epoch 1 is another:", not torch.equal(first, second))
assert torch.equal(first, again)
assert torch.allclose(first, epoch(0, workers=0), atol=1e-5)
assert not torch.equal(first, second)

figure, axes = plt.subplots(2, 4, figsize=(9, 4.6), layout="constrained")
figure.suptitle("Four samples in epoch 0 (above) and epoch 1 (below)")
for ax, picture in zip(axes.flat, torch.cat([first[:4], second[:4]]), strict=True):
    ax.imshow(plots.as_image(picture))
    ax.axis("off")

# %%
# In a script of your own the loader stands below ``if __name__ == "__main__":``, as always where workers start by
# ``spawn`` (macOS, Windows) or ``forkserver`` (Python from 3.14 on): these import the script anew, and so find the
# class of the data set. The augmentations themselves can be pickled. On a GPU leave the workers to load and crop, and
# augment whole batches there: ``augment(batch.cuda())``.
#
# Depth
# -----
#
# ``CameraSequential`` is ``K.AugmentationSequential`` in which the first mask is a map of inverse depth, in 1/m and 0
# at infinity. Defocus then follows the distances in the picture, and the map is flipped and cropped with it.

motorcycle = Scene.builtin("motorcycle", size=(160, 240))
inverse_depth = 1 / motorcycle.depth
near, far = float(motorcycle.depth.min()), float(motorcycle.depth.max())
figure, axes = plt.subplots(1, 3, figsize=(9, 2.3), layout="constrained")
axes[0].imshow(motorcycle.depth[0, 0].numpy(), cmap="viridis")
axes[0].set_title(f"Depth, {near:.1f} to {far:.1f} m")
for ax, focus in zip(axes[1:], (near, far), strict=True):
    focused = KC.CameraSequential(
        KC.RandomDefocus(focus=focus, f_number=1.4, focal_length=25 * mm, p=1.0), data_keys=["input", "mask"]
    )
    picture, _ = focused(motorcycle.to_srgb(), inverse_depth)
    ax.imshow(plots.as_image(picture[0]))
    ax.set_title(f"Focused at {focus:.1f} m")
for ax in axes:
    ax.axis("off")

# %%
# Tests of robustness
# -------------------
#
# ``KC.corrupt`` is the opposite of an augmentation: nothing is left to chance. Fifteen corruptions have five severities
# each, in physical units, and are the same at every call; what is random in them, such as noise, has a seed.

shown = ("defocus", "vignetting", "shot_read_noise", "white_balance")
figure, axes = plt.subplots(2, 4, figsize=(9, 3.6), layout="constrained")
figure.suptitle("Corruptions at severity 2 (above) and 5 (below)")
for column, name in zip(axes.T, shown, strict=True):
    for ax, severity in zip(column, (2, 5), strict=True):
        ax.imshow(plots.as_image(KC.corrupt(photograph, name, severity=severity, seed=0)[0]))
        ax.axis("off")
    column[0].set_title(name)
assert torch.equal(KC.corrupt(photograph, "shot_read_noise"), KC.corrupt(photograph, "shot_read_noise"))
print(len(KC.CORRUPTIONS), "corruptions:", ", ".join(KC.CORRUPTIONS))
print("defocus at severity 1 to 5, distance in metres:", [s["distance"] for s in KC.CORRUPTIONS["defocus"].severities])
