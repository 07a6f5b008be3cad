"""
Raw files in and out
====================

A raw signal of kcam goes into a DNG that any raw converter opens, and the raw file of any camera is developed by kcam's
own stages: ``kcam.Raw`` is both ways.
"""

# %%
# Out: a DNG
# ----------
#
# ``camera.raw(scene)`` is what the sensor recorded: one plane, a mosaic, in which 1.0 is full scale.
# ``Raw.from_camera`` makes of it what a raw file holds: whole numbers (DN), and beside them all that the picture needs,
# from the camera's own stages: pattern, black and white level, what a white gives in each channel (the neutral), the
# colour matrix and the noise.

import dataclasses
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import rawpy
import torch
from skimage.color import deltaE_ciede2000, rgb2lab

from kcam import Camera, Raw, Scene, isp, optics, plots, sensor, spectral
from kcam.units import mm, nm, um

lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(8 * mm), focus_distance=2.0)
camera = Camera(
    optics.Imaging(lens, pixel_pitch=3.45 * um),
    sensor.ColourFilter.kodak(infrared_cut=680 * nm), sensor.Mosaic("GRBG"), sensor.Exposure(),
    sensor.ShotNoise(full_well=10_000), sensor.ReadNoise(2.4), sensor.ADC(bits=12, black_level=256),
    isp.Demosaic(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(),
)  # fmt: skip
scene = Scene.builtin("astronaut", size=256)
generator = torch.Generator().manual_seed(0)
raw = Raw.from_camera(camera, camera.raw(scene, generator=generator))
slope, offset = raw.noise_profile
print(f"{raw.pattern}, black {raw.black_level:g}, white {raw.white_level:g}, gains {raw.gains.numpy().round(2)}")
print(f"variance of a signal x in 0..1: {slope:.2e} x + {offset:.1e}")

folder = tempfile.TemporaryDirectory()
path = Path(folder.name) / "astronaut.dng"
raw.write(path)  # .tif and .npy are the other suffixes

# %%
# A converter makes of it what kcam does
# --------------------------------------
#
# LibRaw, which is inside many raw converters, reads the very numbers, and develops them with the file's white balance
# and colours. What differs from kcam's picture is its demosaic. A white fills only 0.8 of full scale in this camera: by
# how much the picture is to be brightened stands in the DNG's ``BaselineExposure``, which LibRaw leaves to the caller.

with rawpy.imread(str(path)) as file:
    theirs = file.postprocess(
        use_camera_wb=True, no_auto_bright=True, adjust_maximum_thr=0.0, gamma=(2.4, 12.92), output_bps=16,
        bright=2**raw.baseline_exposure * float(raw.gains.min()),
    )  # fmt: skip

again = Raw.from_file(path)
developed = isp.develop(again)
picture = camera(scene, generator=torch.Generator().manual_seed(0))
print(f"largest difference of isp.develop to the camera's own picture: {(developed - picture).abs().max():.0e}")
assert torch.equal(again.mosaic, raw.mosaic)
assert torch.allclose(developed, picture, atol=1e-5)

figure, axes = plt.subplots(1, 3, figsize=(9, 3.3), layout="constrained")
detail = slice(60, 92), slice(100, 132)
signal = raw.mosaic[0] / raw.white_level
axes[0].imshow(plots.false_colour(signal, plots.mosaic_tile(camera))[detail])
axes[0].set_title("32 x 32 of the numbers")
axes[1].imshow(theirs / 65535)
axes[1].set_title("The DNG, developed by LibRaw")
axes[2].imshow(plots.as_image(developed[0]))
axes[2].set_title("The DNG, developed by kcam")
for ax in axes:
    ax.axis("off")

# %%
# In: a photograph
# ----------------
#
# ``Raw.from_file("photo.nef")`` reads .dng, .nef, .cr2, .arw, ... through LibRaw (``pip install "kcam[raw]"``), and
# ``isp.develop(raw)`` makes the picture. It is differentiable in ``raw.mosaic``, and its demosaic has a name:
# ``isp.develop(raw, method="menon")``.
#
# A camera whose colours nobody knows
# -----------------------------------
#
# Of a camera on a bench we may have the numbers and the levels, but neither neutral nor colours. Here is one to try: 14
# bits, whose white level is *not* full scale, and with a filter that we pretend not to know. It photographed a colour
# chart and a cup in the light of a bulb.

unknown = Camera(
    camera[0], sensor.ColourFilter.nikon(), sensor.Mosaic("RGGB"), sensor.Exposure(),
    sensor.ShotNoise(full_well=20_000), sensor.ReadNoise(3.0),
)  # fmt: skip
generator = torch.Generator().manual_seed(1)
found = {}
for name in ("colour_chart", "coffee"):
    light = unknown(Scene.builtin(name, size=240, illuminant="A"), generator=generator)
    numbers = (512 + light.clamp(max=1) * (15_300 - 512)).round()
    Raw(numbers, pattern="RGGB", black_level=512, white_level=15_300).write(Path(folder.name) / f"{name}.tif")
    found[name] = Raw.from_file(Path(folder.name) / f"{name}.tif")

# %%
# Both follow from the chart: the neutral is what its brightest patch, a gray, gives in each channel, and
# ``isp.fit_colour_matrix`` finds the matrix that takes the 24 patches closest to their colours in daylight. A raw file
# holds the way back, from XYZ to the camera.

chart = found["colour_chart"]
signal = (chart.mosaic - chart.black_level) / (chart.white_level - chart.black_level)
planes = isp.Demosaic(pattern=chart.pattern)(signal)[0]
side = 40  # pixels of a patch; the outer 10 are left out
patches = planes.unfold(1, side, side).unfold(2, side, side)[..., 10:30, 10:30].mean((-2, -1))  # (3, 4, 6)
patches = patches.flatten(1).T.double()  # (24, 3), row by row

daylight = Scene.builtin("colour_chart", size=(4, 6))  # a pixel for each patch
colours = spectral.xyz_to_linear_srgb(daylight.xyz())[0].flatten(1).T.double()
brightest = 18  # "white 9.5 (.05 D)", the first of the last row
neutral = patches[brightest] / patches[brightest, 1]
white = patches[brightest, 1] / colours[brightest, 1]  # what a perfect white would have
to_srgb = isp.fit_colour_matrix(patches / neutral / white, colours=colours)
known = {
    "neutral": neutral,
    "colour_matrix": torch.linalg.inv(to_srgb) @ spectral.xyz_to_srgb_matrix(),
    "baseline_exposure": -float(white.log2()),
}
chart, cup = (dataclasses.replace(found[name], **known) for name in ("colour_chart", "coffee"))
print("gains of red, green, blue:", [f"{gain:.2f}" for gain in chart.gains.tolist()])


def lab(linear):
    """CIELAB of linear sRGB (K,3)."""
    return rgb2lab(isp.tone_curve(linear.T[:, :, None])[..., 0].T.numpy())


difference = deltaE_ciede2000(lab((patches / neutral / white) @ to_srgb.T), lab(colours))
print(f"CIEDE2000 of the 24 patches: mean {difference.mean():.1f}, largest {difference.max():.1f}")
assert difference.mean() < 4

shown = {
    "The cup before white balance": isp.develop(
        dataclasses.replace(cup, neutral=torch.ones(3), colour_matrix=spectral.xyz_to_srgb_matrix())
    ),
    "The chart, developed": isp.develop(chart),
    "The cup, developed": isp.develop(cup),
}
figure, axes = plt.subplots(1, 3, figsize=(9, 2.5), layout="constrained")
for ax, (title, image) in zip(axes, shown.items(), strict=True):
    ax.imshow(plots.as_image(image[0]))
    ax.set_title(title)
    ax.axis("off")
folder.cleanup()

# %%
# A photograph's own gray card will do for the neutral, where there is no chart. In a scene without either, take the
# neutral of another shot in the same light.
#
# What is left to others
# ----------------------
#
# - **Turning, lens corrections, defective pixels and compression**: a ``Raw`` lies as it lay on the sensor, without the
#   corrections that a manufacturer's file may ask for, and is written without compression.
# - ``plots.write_picture(raw.mosaic[0] / raw.white_level, "raw.tif")`` writes 16 bits too, but as a picture: full scale
#   becomes 65 535, and there are no tags.
