"""
Raw files in and out
====================

A raw signal of kcam goes into a 16-bit TIFF and comes back without loss, and a raw mosaic of any other camera is
developed by kcam's stages once its black level, white level and colours are known. There is no DNG yet.
"""

# %%
# The raw signal
# --------------
#
# ``camera.raw(scene)`` is what the sensor recorded: one plane, a mosaic, in which 1.0 is full scale. A file holds the
# numbers themselves (DN), so we multiply by :math:`2^b - 1`.

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import tifffile
import torch
from skimage.color import deltaE_ciede2000, rgb2lab

from kcam import Camera, Scene, isp, optics, plots, sensor, spectral
from kcam.units import mm, nm, um

bits, black_level = 12, 256
full_scale = 2**bits - 1
lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(8 * mm), focus_distance=2.0)
camera = Camera(
    optics.Imaging(lens, pixel_pitch=3.45 * um),
    sensor.ColourFilter.kodak(infrared_cut=680 * nm), sensor.Mosaic("GRBG"), sensor.Exposure(),
    sensor.ShotNoise(full_well=10_000), sensor.ReadNoise(2.4), sensor.ADC(bits, black_level=black_level),
    isp.Demosaic(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(),
)  # fmt: skip
scene = Scene.builtin("astronaut", size=256)
raw = camera.raw(scene, generator=torch.Generator().manual_seed(0))
numbers = (raw[0, 0] * full_scale).round().to(torch.uint16).numpy()
print(f"raw {tuple(raw.shape)}; numbers from {numbers.min()} to {numbers.max()}")

# %%
# Out: a TIFF of 16 bits
# ----------------------
#
# What a reader has to know beside the numbers are the pattern, the black level and the white level. They have tags of
# their own in a TIFF: the first two in this table are of TIFF/EP, the others of DNG.

CFA_REPEAT, CFA_PATTERN, BLACK_LEVEL, WHITE_LEVEL = 33421, 33422, 50714, 50717


def write_raw(path, numbers, *, pattern, black_level, white_level):
    """A Bayer mosaic (H,W) of whole numbers as a TIFF whose tags say how to read it."""
    colours = ["RGB".index(letter) for letter in pattern]
    tags = [  # code, type, count, value, only once
        (CFA_REPEAT, "H", 2, (2, 2), True),
        (CFA_PATTERN, "B", 4, bytes(colours), True),
        (BLACK_LEVEL, "H", 1, black_level, True),
        (WHITE_LEVEL, "H", 1, white_level, True),
    ]
    tifffile.imwrite(path, numbers, photometric="CFA", extratags=tags)


def read_raw(path):
    """The mosaic (H,W), its pattern, black level and white level."""
    with tifffile.TiffFile(path) as file:
        page = file.pages[0]
        tag = {code: page.tags[code].value for code in (CFA_PATTERN, BLACK_LEVEL, WHITE_LEVEL)}
        pattern = "".join("RGB"[colour] for colour in tag[CFA_PATTERN])
        return page.asarray(), pattern, tag[BLACK_LEVEL], tag[WHITE_LEVEL]


folder = tempfile.TemporaryDirectory()
path = Path(folder.name) / "astronaut.tif"
write_raw(path, numbers, pattern="GRBG", black_level=black_level, white_level=full_scale)
again, pattern, black, white = read_raw(path)
print(f"{path.name}: {again.shape}, {again.dtype}, {pattern}, black {black}, white {white}")
assert np.array_equal(again, numbers)

# %%
# In: developed by the camera's own stages
# ----------------------------------------
#
# A slice of a camera is a camera that still knows what the others said: ``camera[7:]``, from the demosaic on, knows the
# pattern, the black level, the filter's curves and, in a ``Context``, the light. It makes of the file the very picture
# that the camera makes of the scene.

signal = torch.from_numpy(again.astype(np.float32))[None, None] / full_scale
developed = camera[7:](signal)
picture = camera(scene, generator=torch.Generator().manual_seed(0))
print(f"largest difference to the camera's picture: {(developed - picture).abs().max():.0e}")
assert torch.allclose(developed, picture, atol=1e-5)

figure, axes = plt.subplots(1, 3, figsize=(9, 3.3), layout="constrained")
detail = slice(60, 92), slice(100, 132)
axes[0].imshow(numbers, cmap="gray")
axes[0].set_title("The numbers in the file")
axes[1].imshow(plots.false_colour(signal[0], plots.mosaic_tile(camera))[detail])
axes[1].set_title("32 x 32 of them, by filter")
axes[2].imshow(plots.as_image(developed[0]))
axes[2].set_title("Developed from the file")
for ax in axes:
    ax.axis("off")

# %%
# A raw of another camera
# -----------------------
#
# Of a camera that kcam did not simulate we have the numbers and the tags, but no curves of its filter. Here is one to
# try: 14 bits, whose white level is *not* full scale, and with a filter that we pretend not to know. It photographed a
# colour chart and a cup in the light of a bulb.

unknown = Camera(
    camera[0], sensor.ColourFilter.nikon(), sensor.Mosaic("RGGB"), sensor.Exposure(),
    sensor.ShotNoise(full_well=20_000), sensor.ReadNoise(3.0),
)  # fmt: skip
unknown_black, unknown_white = 512, 15_300
generator = torch.Generator().manual_seed(1)
for name in ("colour_chart", "coffee"):
    light = unknown(Scene.builtin(name, size=240, illuminant="A"), generator=generator)[0, 0]
    recorded = (unknown_black + light.clamp(max=1) * (unknown_white - unknown_black)).round().to(torch.uint16).numpy()
    write_raw(Path(folder.name) / f"{name}.tif", recorded, pattern="RGGB", black_level=512, white_level=15_300)


def read_signal(name):
    """A file as a signal (1,1,H,W) with black at 0 and white at 1, and its pattern."""
    numbers, pattern, black, white = read_raw(Path(folder.name) / f"{name}.tif")
    numbers = torch.from_numpy(numbers.astype(np.float32))[None, None]
    return (numbers - black) / (white - black), pattern


# %%
# Black level and white level are gone now, so the stages are told of none. White balance and colour matrix follow from
# the chart: the gains make its brightest patch, a gray, gray, and ``isp.fit_colour_matrix`` finds the matrix that takes
# the 24 patches closest to their colours in daylight.

chart, pattern = read_signal("colour_chart")
planes = isp.Demosaic(pattern=pattern)(chart)[0]
side = 40  # pixels of a patch; the outer 10 are left out
patches = planes.unfold(1, side, side).unfold(2, side, side)[..., 10:30, 10:30].mean((-2, -1))  # (3, 4, 6)
patches = patches.flatten(1).T.double()  # (24, 3), row by row

daylight = Scene.builtin("colour_chart", size=(4, 6))  # a pixel for each patch
colours = spectral.xyz_to_linear_srgb(daylight.xyz())[0].flatten(1).T.double()
brightest = 18  # "white 9.5 (.05 D)", the first of the last row
gains = patches[brightest, 1] / patches[brightest]
white = patches[brightest, 1] / colours[brightest, 1]  # what a perfect white would have
matrix = isp.fit_colour_matrix(patches * gains / white, colours=colours) / white
develop = Camera(
    isp.Demosaic(pattern=pattern, gains=gains), isp.WhiteBalance(gains), isp.ColourMatrix(matrix), isp.ToneCurve()
)
print("gains of red, green, blue:", [f"{gain:.2f}" for gain in gains.tolist()])
print(develop)


def lab(linear):
    """CIELAB of linear sRGB (K,3)."""
    return rgb2lab(isp.tone_curve(linear.T[:, :, None])[..., 0].T.numpy())


found = (patches * gains) @ matrix.T
difference = deltaE_ciede2000(lab(found), lab(colours))
print(f"CIEDE2000 of the 24 patches: mean {difference.mean():.1f}, largest {difference.max():.1f}")
assert difference.mean() < 4

cup, _ = read_signal("coffee")
with torch.no_grad():
    shown = {
        "The cup before white balance": isp.ToneCurve()(isp.Demosaic(pattern=pattern)(cup)),
        "The chart, developed": develop(chart),
        "The cup, developed": develop(cup),
    }
figure, axes = plt.subplots(1, 3, figsize=(9, 2.5), layout="constrained")
for ax, (title, image) in zip(axes, shown.items(), strict=True):
    ax.imshow(plots.as_image(image[0]))
    ax.set_title(title)
    ax.axis("off")
folder.cleanup()

# %%
# A photograph's own gray card will do for the gains, where there is no chart: ``gains = green / mean of each channel``
# over the card. In a scene without either, take the gains that the camera wrote into its file.
#
# What is not there yet
# ---------------------
#
# - **DNG.** kcam neither reads nor writes it. The file above has two of DNG's tags and is none: raw converters also ask
#   for the DNG version, a colour matrix and the neutral of the shot. To read DNG, CR3, NEF or ARW use ``rawpy`` and
#   go on as above:
#
#   .. code-block:: python
#
#       with rawpy.imread("photo.dng") as file:
#           numbers = torch.from_numpy(file.raw_image_visible.astype("float32"))[None, None]
#           black, white = file.black_level_per_channel[0], file.white_level
#           gains = torch.tensor(file.camera_whitebalance[:3]) / file.camera_whitebalance[1]
#
#   ``rawpy`` is not part of kcam, and nothing here was tested with it.
# - **Compression, lens corrections and defective pixels** of a manufacturer's file are not kcam's.
# - ``plots.write_picture(raw[0], "raw.tif")`` writes 16 bits too, but as a picture: full scale becomes 65 535, and
#   there are no tags.
