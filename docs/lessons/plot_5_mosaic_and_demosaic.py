"""
5. Mosaic and demosaic
======================

Each pixel of a sensor records one colour, and two thirds of every photograph are made up afterwards. This lesson shows
what the mosaic cannot record, compares the methods that fill it in, and finds out which of them to take in the dark.
"""

# %%
# A question
# ----------
#
# A pixel counts photons; it does not know their colour. So a mosaic of filters lies on the sensor, and a pixel under
# red glass tells nothing of green and blue. How much detail and colour is lost?
#
# ``sensor.PATTERNS`` lists the mosaics that kcam knows. Bayer's, here ``"RGGB"``, has twice as many green pixels as red
# ones, because the eye sees fine detail in green best. The others have larger tiles; the last has clear pixels.

import math

import matplotlib.pyplot as plt
import numpy as np
import torch
from skimage.color import rgb2lab

from kcam import Camera, Scene, isp, optics, plots, sensor
from kcam.units import mm, nm, um

names = ("RGGB", "quad_bayer", "x_trans", "rgbw")
figure, axes = plt.subplots(1, 4, figsize=(9, 2.7), layout="constrained")
figure.suptitle("Four mosaics, 12 x 12 pixels of each")
for ax, name in zip(axes, names, strict=True):
    masks = sensor.channel_masks(name, 12, 12)  # (C, 12, 12): where each channel is recorded
    shares = masks.double().mean((1, 2)).tolist()
    print(f"{name:10s}", "  ".join(f"{channel} {share:.2f}" for channel, share in zip("RGBW", shares, strict=False)))
    colours = np.array(plots.CHANNEL_COLOURS[: len(masks)])
    ax.imshow(colours[masks.long().argmax(0)])
    ax.set_title(name)
    ax.axis("off")
assert sensor.channel_masks("RGGB", 12, 12).double().mean((1, 2)).tolist() == [0.25, 0.5, 0.25]

# %%
# Sampling: what is too fine comes back coarse
# --------------------------------------------
#
# Along a row with red pixels every second one is red. Samples at a distance of :math:`2p`, where :math:`p` is the pixel
# pitch, hold frequencies up to :math:`1 / 4p`. A finer stripe of frequency :math:`f` is not lost but seen at
#
# .. math:: f_\mathrm{alias} = \frac{1}{2p} - f, \qquad \frac{1}{4p} < f < \frac{1}{2p}
#
# which is **aliasing**. Grey stripes of 0.4 cycles per pixel should come back in red as 0.1.

size, frequency = 160, 0.4
column = torch.arange(size, dtype=torch.float64)
stripes = 0.5 + 0.4 * torch.cos(2 * math.pi * frequency * column).expand(1, 3, size, size)
raw = sensor.mosaic(stripes, pattern="RGGB")
red = raw[0, 0, 0, ::2]
spectrum = torch.fft.rfft(red - red.mean()).abs()
alias = float(spectrum.argmax()) / size  # of 80 samples, two pixels apart: 1 / 160 cycles per pixel and step
print(f"stripes of {frequency} cycles per pixel are seen by red pixels as {alias} cycles per pixel")
assert math.isclose(alias, 0.5 - frequency)

figure, ax = plt.subplots(figsize=(8, 2.8), layout="constrained")
fine = torch.linspace(0, 40, 1001, dtype=torch.float64)
ax.plot(fine, 0.5 + 0.4 * torch.cos(2 * math.pi * frequency * fine), color="0.7", label="grey stripes")
ax.plot(column[:41:2], red[:21], "o", color="tab:red", label="what red pixels see")
ax.plot(fine, 0.5 + 0.4 * torch.cos(2 * math.pi * alias * fine), color="tab:red", lw=1, label="the alias")
ax.set(title="Aliasing in the red pixels of one row", xlabel="column [pixels]", ylabel="signal", ylim=(0, 1.3))
ax.legend(frameon=False, ncols=3)

# %%
# In the green pixels the same stripes have another alias, and so a grey picture gets colours. A zone plate shows all
# frequencies at once: they grow from the middle outwards, to 0.5 cycles per pixel at the edges. Wherever they come near
# one of the frequencies of the mosaic itself, (1/2, 0), (0, 1/2) and (1/2, 1/2) cycles per pixel, grey detail looks
# exactly as coloured areas do, and the **demosaic**, which guesses the missing channels, makes colours of it.

offset = torch.arange(size, dtype=torch.float64) - size // 2
squared = offset[:, None] ** 2 + offset**2
zone_plate = (0.5 + 0.4 * torch.cos(math.pi * squared * 0.5 / (size // 2))).expand(1, 3, size, size)
raw = sensor.mosaic(zone_plate, pattern="RGGB")


def false_colour(picture):
    """RMS difference of red and blue from green: 0 where a grey picture has stayed grey."""
    return float((picture[:, ::2] - picture[:, 1:2]).square().mean().sqrt())


figure, axes = plt.subplots(1, 4, figsize=(9, 2.8), layout="constrained")
figure.suptitle("A grey zone plate, and what demosaics make of its mosaic")
axes[0].imshow(plots.as_image(zone_plate[0]))
axes[0].set_title("the scene")
for ax, method in zip(axes[1:], ("bilinear", "malvar", "menon"), strict=True):
    picture = isp.demosaic(raw, pattern="RGGB", method=method)
    print(f"{method:10s} false colour {false_colour(picture):.3f}")
    ax.imshow(plots.as_image(picture[0]))
    ax.set_title(method)
for ax in axes:
    ax.axis("off")

# %%
# Three ideas for the missing two thirds
# --------------------------------------
#
# - ``bilinear``: the mean of the neighbours that recorded the channel. It blurs.
# - ``malvar``: red, green and blue mostly change together. So the curvature of the recorded channel is added to the
#   mean of the neighbours: one 5 x 5 filter for each case, the default.
# - ``menon``: interpolate along the row or along the column, whichever changes less, so never across an edge.
#
# ``difference`` is the one for all patterns. We compare them on a photograph, against the same camera with three full
# channels at each pixel. Three numbers say how good they are: the PSNR, :math:`-10 \log_{10}` of the mean square error;
# the error of the colour alone, :math:`(a^*, b^*)` of CIELAB; and the **zipper**, the share of pixels that are
# no longer as similar to their most similar neighbour, by more than 2.3 units of CIELAB (Lu and Tan).


def photograph(*sensor_and_demosaic):
    """A picture without optics, through a Nikon's filter; the noise is the same each time."""
    camera = Camera(
        sensor.ColourFilter.nikon(), *sensor_and_demosaic, isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve()
    )
    return camera(scene, generator=torch.Generator().manual_seed(0))


def demosaiced(method, *, noise=(), iso=100):
    """The same, with a mosaic."""
    return photograph(sensor.Mosaic("RGGB"), sensor.Exposure(iso=iso), *noise, isp.Demosaic(method))


def psnr(picture):
    """Against the picture without a mosaic [dB]; the rim, where neighbours are missing, is left out."""
    return -10 * float((picture - truth)[..., 8:-8, 8:-8].square().mean().log10())


def lab(picture):
    """CIELAB, (H, W, 3)."""
    return rgb2lab(picture[0].permute(1, 2, 0).numpy())


def to_neighbours(lab_picture):
    """Distance in CIELAB to each of the 8 neighbours, (8, H, W)."""
    steps = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)]
    return np.stack([np.linalg.norm(lab_picture - np.roll(lab_picture, step, (0, 1)), axis=-1) for step in steps])


def zipper(picture):
    """Share of pixels that have left their most similar neighbour, or come nearer to it."""
    before, after = to_neighbours(lab(truth)), to_neighbours(lab(picture))
    nearest = before.argmin(0)[None]
    change = np.take_along_axis(after, nearest, 0) - np.take_along_axis(before, nearest, 0)
    return (np.abs(change[0, 8:-8, 8:-8]) > 2.3).mean()


scene = Scene.builtin("astronaut", size=200)
truth = photograph(sensor.Exposure())
methods = ("bilinear", "difference", "malvar", "menon")
pictures = {method: demosaiced(method) for method in methods}
for method, picture in pictures.items():
    chroma = np.sqrt(((lab(picture) - lab(truth))[8:-8, 8:-8, 1:] ** 2).sum(-1).mean())
    print(f"{method:10s} {psnr(picture):.1f} dB   colour error {chroma:4.1f}   zipper {zipper(picture):.0%}")
assert psnr(pictures["menon"]) > psnr(pictures["malvar"]) + 2 > psnr(pictures["bilinear"]) + 4

figure, axes = plt.subplots(1, 4, figsize=(9, 2.8), layout="constrained")
figure.suptitle("A detail of 64 x 64 pixels: three full channels, and three demosaics")
for ax, name in zip(axes, ("no mosaic", "bilinear", "malvar", "menon"), strict=True):
    picture = pictures.get(name, truth)
    ax.imshow(plots.as_image(picture[0, :, 90:154, 40:104]))
    ax.set_title(name)
    ax.axis("off")

# %%
# Noise decides otherwise
# -----------------------
#
# The filters of a demosaic pass noise on. Independent noise of variance :math:`\sigma^2` in the mosaic, weighted by
# taps :math:`w`, has the variance :math:`\sigma^2 \sum w^2`. Green at a red pixel is four taps of 1/4 in ``bilinear``,
# but taps of 8, 4 and -2 sixteenths in ``malvar``. The sharper filter keeps more of the noise:

noise = 0.5 + 0.01 * torch.randn(1, 1, 512, 512, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
taps = {"bilinear": [1 / 4] * 4, "malvar": [8 / 16] + [4 / 16] * 4 + [-2 / 16] * 4}
for method, weights in taps.items():
    green = isp.demosaic(noise, pattern="RGGB", method=method, domain="linear")[0, 1]
    kept, expected = float(green[2:-2:2, 2:-2:2].var()) / 1e-4, sum(weight**2 for weight in weights)
    print(f"{method}: {kept:.3f} of the variance, sum of squared taps {expected:.4f}")
    assert math.isclose(kept, expected, rel_tol=0.04)

# %%
# ``menon`` looks for the calmer direction, and noise misleads it. So photograph the astronaut in less and less light.
# ``Exposure(iso=)`` keeps the brightness of the picture: white fills 0.8 of the well at ISO 100, and an ISO that is
# larger by a factor means so much less light.

isos = (100, 400, 1600, 6400, 25600)
electronics = (sensor.ShotNoise(full_well=10_000), sensor.ReadNoise(3.0), sensor.ADC(bits=12))
curves = {method: [psnr(demosaiced(method, noise=electronics, iso=iso)) for iso in isos] for method in methods}

figure, ax = plt.subplots(figsize=(7, 3.6), layout="constrained")
for method, curve in curves.items():
    ax.semilogx(isos, curve, "o-", label=method)
ax.set(title="Quality of demosaics against ISO", xlabel="ISO", ylabel="PSNR [dB]")
ax.set_xticks(isos, isos)
ax.minorticks_off()
ax.legend(frameon=False)

print("electrons of white:", ", ".join(f"{0.8 * 10_000 * 100 / iso:.0f}" for iso in isos))
lead = np.subtract(curves["menon"], curves["difference"])
print("menon is better than difference by", ", ".join(f"{gain:+.1f}" for gain in lead), "dB")
assert lead[0] > 4
assert lead[-1] < 0.5

# %%
# What happens when the lens is stopped down?
# -------------------------------------------
#
# Aliasing cannot be undone afterwards, but it can be prevented: what does not reach the sensor has no alias. A lens of
# f-number :math:`N` ends at the frequency :math:`1 / \lambda N` (lesson 2). It spares the red and blue pixels all
# aliases where this is :math:`1 / 4p`, so at :math:`N = 4p / \lambda`. Long before that the contrast near the cutoff
# is low.

chart = Scene.from_rgb(zone_plate[:, :1].float(), depth=math.inf)
stops, seen = (4, 8, 16, 32), []
print(f"4 p / lambda = {4 * 4 * um / (550 * nm):.0f} for pixels of 4 um in green light")
for stop in stops:
    lens = optics.Lens(optics.CircularAperture(20 * mm / stop), optics.ThinLens(20 * mm), focus_distance=math.inf)
    camera = Camera(
        optics.Imaging(lens, pixel_pitch=4 * um), sensor.ColourFilter.nikon(), sensor.Mosaic("RGGB"),
        sensor.Exposure(), isp.Demosaic("malvar"), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(),
    )  # fmt: skip
    seen.append(camera(chart))
    print(f"f/{stop:<2d} cutoff {4 * um / (550 * nm * stop):.2f} cycles per pixel, false {false_colour(seen[-1]):.3f}")
assert false_colour(seen[-1]) < 0.1 * false_colour(seen[0])

figure, axes = plt.subplots(1, 4, figsize=(9, 2.8), layout="constrained")
figure.suptitle("Stopping down removes false colours, and detail")
for ax, stop, picture in zip(axes, stops, seen, strict=True):
    ax.imshow(plots.as_image(picture[0]))
    ax.set_title(f"f/{stop}")
    ax.axis("off")

# %%
# Some cameras have a plate of birefringent quartz before the sensor for this, the optical low-pass filter. It splits
# each ray in four, a pixel apart, and does not darken the picture as a small aperture does.
#
# Exercises
# ---------
#
# 1. In ``demosaiced`` write ``isp.Demosaic(method, domain="linear")``. The default works on the square root of the
#    light, in which edges in shadows are as steep as they look. Which method loses least without it?
# 2. Print ``psnr(photograph(sensor.Mosaic(name), sensor.Exposure(), isp.Demosaic("difference")))`` for ``"RGGB"``,
#    ``"x_trans"`` and ``"quad_bayer"``. Two of them are within 1 dB; the third is far behind, for its samples of one
#    colour lie in blocks, and the gaps between them are wider.
# 3. Paint the zone plate red: ``zone_plate * torch.tensor([1.0, 0.2, 0.2])[:, None, None]``. Print the RMS error of
#    each method in the middle, ``[..., 40:120, 40:120]``. On grey ``menon`` is five times as good as ``bilinear``, on
#    red hardly better: what it assumes, that channels change together by equal amounts, no longer holds.
#
# Read on
# -------
#
# Alleysson, Süsstrunk and Hérault, IEEE Trans. Image Processing 14, 439 (2005): the mosaic as luminance and modulated
# colour. Malvar, He and Cutler, ICASSP 2004, figure 2: the filters. Menon, Andriani and Calvagno, IEEE Trans. Image
# Processing 16, 132 (2007). Lu and Tan, IEEE Trans. Image Processing 12, 1194 (2003): the zipper. All methods with
# their PSNR and cost: ``isp.DEMOSAICS``.
#
# In the gallery: :doc:`/gallery/plot_sensor_mosaics`, :doc:`/gallery/plot_sensor_moire`,
# :doc:`/gallery/plot_isp_demosaics`.
#
# Next: :doc:`plot_6_photons_noise_adc`, or where the noise came from.
