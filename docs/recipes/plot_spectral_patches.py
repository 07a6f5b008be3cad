"""
Spectral data to a patch store
==============================

Arrays of your own, in .npy or HDF5, become cube files with wavelengths, a report on what is wrong with them, a store of
patches that is checked and fast, and batches for training. Then a phone photographs one of the patches.
"""

# %%
# Three cubes
# -----------
#
# Here we write what a laboratory might hand us: arrays of rows, columns and bands without a word about wavelengths, two
# as .npy and one as HDF5. They are built-in scenes in daylight, in 31 bands from 400 to 700 nm. The patches of the
# colour chart are measured reflectances; the spectra of the two photographs are upsampled from sRGB.

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import h5py
import matplotlib.pyplot as plt
import numpy as np
import torch
from torch.utils.data import DataLoader

from kcam import Camera, Scene, plots
from kcam.data import PatchDataset, export_patches, read_cube, verify
from kcam.units import nm

temporary = tempfile.TemporaryDirectory()
folder = Path(temporary.name)
(folder / "in").mkdir()
wavelengths = torch.linspace(400, 700, 31, dtype=torch.float64) * nm
for name in ("astronaut", "coffee", "colour_chart"):
    bands = Scene.builtin(name, size=192, wavelengths=wavelengths).bands()[0]
    array = bands.clamp(min=0).permute(1, 2, 0).numpy()  # (H, W, C)
    if name == "coffee":
        with h5py.File(folder / "in" / f"{name}.h5", "w") as file:
            file["radiance"] = array
    else:
        np.save(folder / "in" / f"{name}.npy", array)
    print(name, array.shape, array.dtype)


def kcam(command):
    """Run a command as the shell does, and show what it says."""
    print("$ kcam", command)
    words = [sys.executable, "-m", "kcam", *command.split()]
    print(subprocess.run(words, cwd=folder, check=True, capture_output=True, text=True).stdout)


# %%
# Convert
# -------
#
# An array does not know the order of its axes nor its wavelengths, so we say both. Each becomes a TIFF of one page per
# band that other tools open, with wavelengths inside. ``--bands`` would resample them to another grid, and public data
# sets are read by ``--format``.

kcam("data convert in/ --axes hwc --wavelengths 400:700:31 --out cubes/")
cube = read_cube(folder / "cubes" / "coffee.tif")
print(tuple(cube.values.shape), cube.unit, f"{cube.wavelengths[0] / nm:.0f} to {cube.wavelengths[-1] / nm:.0f} nm")

# %%
# Inspect
# -------
#
# Before anything is trained on data, look at it: what is bad, dark, clipped or noisy stands in the table, and each cube
# as daylight shows it on a contact sheet.

kcam("data inspect cubes/ --out report/")
figure, ax = plt.subplots(figsize=(9, 3.9), layout="constrained")
ax.set_title("The contact sheet of the three cubes")
ax.axis("off")
sheet = ax.imshow(plt.imread(folder / "report" / "contact_sheet.png"))

# %%
# Extract
# -------
#
# The defaults are for cubes of some thousand pixels: patches of 256, every 128. Ours are small. The split is by scene,
# so that no scene stands on both sides, and by a hash of the scene's name, so that new scenes move no old ones; of
# three, that can be any share. Patches that teach little are left out and counted. Contrast is the standard deviation
# of a patch's grey over its mean: the default of 0.02 leaves out bare walls, and we ask for 0.45 to see some go.

kcam("data extract cubes/ --size 64 --stride 32 --min-contrast 0.45 --split 0.6/0.4 --out patches/")

# %%
# Verify, and export
# ------------------
#
# A store has a sha256 of every file. ``verify`` says whether it is as it was written, and its exit status is 1 if not:
# run it after copying.

kcam("data verify patches/")

# %%
# Each command has a function behind it in ``kcam.data``. Here a copy of the store loses one bit, and is found out.

copy = shutil.copytree(folder / "patches", folder / "copy")
broken = next(copy.glob("val/scenes/*.npy"))
content = bytearray(broken.read_bytes())
content[-1] ^= 1
broken.write_bytes(content)
problems = verify(copy)
print(*(problem.replace(str(folder), "...") for problem in problems), sep="\n")
assert len(problems) == 1
assert not verify(folder / "patches")

# %%
# For other tools ``kcam data export patches/train --out train.h5`` writes one file, and so does ``export_patches``.

count = export_patches(folder / "patches" / "train", folder / "train.h5")
with h5py.File(folder / "train.h5") as file:
    for name, values in file.items():
        print(name, values.shape, values.dtype)

# %%
# Train on it
# -----------
#
# ``PatchDataset`` reads the patch that is asked for and no more. An item is (L,H,W) in the cube's unit, with
# wavelengths in metres and the scene's name; the mean and deviation of each band are there for a network that wants
# them.

patches = PatchDataset(folder / "patches" / "train")
assert len(patches) == count
loader = DataLoader(patches, batch_size=8, shuffle=True, generator=torch.Generator().manual_seed(0))
batch = next(iter(loader))
print(len(patches), "patches;", tuple(batch.values.shape), batch.values.dtype)
print("of", ", ".join(batch.scene))

number = 3
values, wavelengths, name = patches[number]
_, y, x = patches.position(number)
original = read_cube(folder / "cubes" / f"{name}.tif").values[:, y : y + 64, x : x + 64]
error = float((values - torch.as_tensor(original)).abs().max())
print(f"{name} from row {y}, column {x}: the store's 16 bits are off by {error:.0e} at most")
assert error < 2e-5

# %%
# A patch through a camera
# ------------------------
#
# A patch is spectral radiance, so it makes a scene as it is; a batch of them does too. White here has the radiance of
# daylight, as the built-in scenes had it. Of cubes in another unit tell ``Scene.from_bands`` the radiance of a white:
# ``illuminant=``.

scene = Scene.from_bands(values, wavelengths=wavelengths, depth=2.0)
picture = Camera.phone()(scene, generator=torch.Generator().manual_seed(0))
print(scene)

figure, axes = plt.subplots(1, 3, figsize=(9, 3.1), layout="constrained")
low, high = patches.mean - patches.deviation, patches.mean + patches.deviation
axes[0].plot(wavelengths / nm, patches.mean)
axes[0].fill_between(wavelengths / nm, low, high, alpha=0.2)
axes[0].set(title="Mean and deviation of bands", xlabel="wavelength [nm]", ylabel="relative radiance")
for ax, title, shown in zip(axes[1:], ("A patch in daylight", "By a phone"), (scene.to_srgb(), picture), strict=True):
    ax.imshow(plots.as_image(shown[0]))
    ax.set_title(title)
    ax.axis("off")
temporary.cleanup()
