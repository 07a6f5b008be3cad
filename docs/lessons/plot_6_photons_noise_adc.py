"""
6. Photons, noise and the ADC
=============================

Two photographs of the same scene are never equal. This lesson counts photons, measures a sensor from its frames alone
as its maker would, and asks how anything can be trained through chance and rounding.
"""

# %%
# A question
# ----------
#
# A pixel reads 1024. How sure is that? Light arrives in photons, each of which frees an electron or does not. When
# :math:`\lambda` electrons are expected, their number is random, with Poisson's distribution:
#
# .. math:: P(N) = \frac{\lambda^N e^{-\lambda}}{N!}, \qquad \text{mean } \lambda, \quad \text{variance } \lambda
#
# So the noise of light is :math:`\sqrt\lambda`, and the signal to noise ratio is :math:`\lambda / \sqrt\lambda =
# \sqrt\lambda`: four times the light is twice as clean. ``sensor.poisson`` draws the numbers. All chance in kcam comes
# from a ``torch.Generator`` that the caller may give: the same seed is the same noise.

import math

import matplotlib.pyplot as plt
import numpy as np
import torch

from kcam import Camera, Scene, isp, plots, sensor

random = torch.Generator().manual_seed(0)
figure, ax = plt.subplots(figsize=(8, 3), layout="constrained")
for expected, colour in ((4.0, "tab:blue"), (12.0, "tab:orange"), (40.0, "tab:green")):
    count = sensor.poisson(torch.full((100_000,), expected), generator=random)
    print(f"expected {expected:4.0f} electrons: mean {count.mean():.2f}, variance {count.var():.2f}")
    assert math.isclose(count.mean(), expected, rel_tol=0.02)
    assert math.isclose(count.var(), expected, rel_tol=0.03)
    number = np.arange(70)
    law = [math.exp(n * math.log(expected) - expected - math.lgamma(n + 1)) for n in number]
    ax.bar(number, np.bincount(count.int(), minlength=70)[:70] / len(count), color=colour, alpha=0.4)
    ax.plot(number, law, ".-", color=colour, label=f"{expected:.0f} expected")
ax.set(title="Electrons of a pixel: draws (bars) and Poisson's law", xlabel="electrons", ylabel="probability")
ax.legend(frameon=False)

# %%
# A sensor
# --------
#
# A pixel holds a number of electrons, the **full well**. Three more things happen before a number comes out: pixels
# differ in sensitivity by a per cent or so (photo response non-uniformity, **PRNU**, the same in each frame), the
# amplifier adds **read noise**, and the analogue-to-digital converter (**ADC**) rounds to one of :math:`2^b` numbers.
# The signal between kcam's stages is a share: of the full well before the ADC, of full scale after it.

full_well, read_noise, prnu, bits, black_level = 10_000, 6.0, 0.01, 12, 64
gain = (2**bits - 1) / full_well  # the overall system gain K of the standard EMVA 1288 [DN / electron]
pixels = Camera(
    sensor.ShotNoise(full_well=full_well),
    sensor.FixedPattern(prnu, dsnu=0.0),
    sensor.ReadNoise(read_noise),
    sensor.ADC(bits=bits, black_level=black_level),
)
print(pixels)


def frame(share):
    """A frame of an even light that fills a share of the well, in digital numbers (DN)."""
    return pixels(torch.full((1, 1, 200, 200), share), generator=random).double() * (2**bits - 1)


# %%
# The photon transfer curve
# -------------------------
#
# Photograph an even wall at many exposures, and a single number per electron comes to light, though nobody can see the
# electrons. With :math:`K` digital numbers per electron the mean is :math:`\mu = K N` above black and the variance in
# time
#
# .. math:: \sigma^2 = \underbrace{K^2 \sigma_d^2}_\text{read noise} + \underbrace{1/12}_\text{rounding}
#           + \underbrace{K \mu}_\text{photons}
#
# a straight line with the slope :math:`K`. The fixed pattern is not noise in time: half the variance of the
# *difference* of two frames is free of it.

shares = torch.logspace(-3, -0.25, 24).tolist()
pairs = [(frame(share), frame(share)) for share in (0.0, *shares)]
mean = np.array([float((one + two).mean()) / 2 - black_level for one, two in pairs])
in_time = np.array([float((one - two).var()) / 2 for one, two in pairs])
in_one_frame = np.array([float(one.var()) for one, _ in pairs])

slope, offset = np.polyfit(mean, in_time, 1, w=1 / in_time)  # their own spread is proportional to the variances
dark = math.sqrt(in_time[0] - 1 / 12) / slope
print(f"K = {slope:.4f} DN per electron (set {gain:.4f}); read noise {dark:.2f} electrons (set {read_noise})")
assert math.isclose(slope, gain, rel_tol=0.02)
assert math.isclose(dark, read_noise, rel_tol=0.03)

# %%
# The fixed pattern is what one frame has beyond that. It grows with the light itself, not with its root, so that it is
# the noise of bright pictures, unless it is calibrated away.

pattern = math.sqrt(in_one_frame[-1] - in_time[-1]) / mean[-1]
print(f"PRNU = {pattern:.2%} (set {prnu:.2%})")
assert math.isclose(pattern, prnu, rel_tol=0.05)

figure, ax = plt.subplots(figsize=(8, 3.8), layout="constrained")
ax.loglog(mean[1:], np.sqrt(in_one_frame[1:]), "s", mfc="none", color="0.5", label="one frame")
ax.loglog(mean[1:], np.sqrt(in_time[1:]), "o", color="tab:blue", label="in time, from pairs")
line = np.logspace(0.3, 3.5, 100)
ax.loglog(line, np.sqrt(gain**2 * read_noise**2 + 1 / 12 + gain * line), color="tab:blue", label="the law")
ax.loglog(line, np.full_like(line, gain * read_noise), ":", color="tab:red", label="read noise, slope 0")
ax.loglog(line, np.sqrt(gain * line), ":", color="tab:green", label="photons, slope 1/2")
ax.loglog(line, prnu * line, ":", color="0.3", label="PRNU, slope 1")
ax.set(title="Photon transfer curve", xlabel="mean above black [DN]", ylabel="standard deviation [DN]", ylim=(0.5, 100))
ax.legend(frameon=False, ncols=2, fontsize=9)

# %%
# Rounding
# --------
#
# Where does the 1/12 come from? The error of rounding lies evenly between -1/2 and 1/2 of a step, the least significant
# bit (LSB), so its standard deviation is :math:`\mathrm{LSB} / \sqrt{12}`. Each bit halves it.

ramp = torch.linspace(0.0, 1.0, 1_000_001, dtype=torch.float64)
for b in (6, 8, 10, 12):
    error = (sensor.quantise(ramp, bits=b) - ramp).square().mean().sqrt()
    print(f"{b:2d} bits: error {error:.1e} of full scale, {error * (2**b - 1):.4f} LSB; 1 / sqrt(12) = {12**-0.5:.4f}")
    assert math.isclose(error * (2**b - 1), 12**-0.5, rel_tol=1e-2)

# %%
# What happens at a higher ISO?
# -----------------------------
#
# ISO does not make a sensor more sensitive. It says that there is less light: at ISO 1600 white is a sixteenth of the
# electrons, and the amplifier restores the brightness of the picture. With :math:`N` electrons and the analogue gain
# :math:`g`, one step of the ADC is :math:`1 / gK` electrons, and
#
# .. math:: \mathrm{SNR} = \frac{N}{\sqrt{N + \sigma_d^2 + 1 / 12 (g K)^2}}
#
# The gain comes before the rounding, so that this fades at a high ISO. The photons do not.

isos = np.array([100, 200, 400, 800, 1600, 3200, 6400])
electrons = 0.2 * 0.8 * full_well * 100 / isos  # a grey of 20 %, where white fills 0.8 of full scale
measured = []
for iso, count in zip(isos, electrons, strict=True):
    converter = sensor.ADC(bits, black_level=black_level, gain=float(iso) / 100)
    grey = torch.full((1, 1, 200, 200), count / full_well)
    out = Camera(sensor.ShotNoise(full_well), sensor.ReadNoise(read_noise), converter)(grey, generator=random).double()
    measured.append(float((out.mean() - black_level / (2**bits - 1)) / out.std()))
variance = electrons + read_noise**2 + 1 / (12 * (isos / 100 * gain) ** 2)
law = electrons / np.sqrt(variance)
for iso, count, ratio, expected in zip(isos, electrons, measured, law, strict=True):
    print(f"ISO {iso:5d}: {count:6.1f} electrons, SNR {ratio:5.2f}, by the equation {expected:5.2f}")
assert np.allclose(measured, law, rtol=0.03)

figure, ax = plt.subplots(figsize=(7, 3.4), layout="constrained")
ax.loglog(isos, measured, "o", label="measured")
ax.loglog(isos, law, "k:", label="equation")
ax.loglog(isos, np.sqrt(electrons), color="tab:green", label="photons alone")
ax.set(title="Signal to noise ratio of a grey of 20 %", xlabel="ISO", ylabel="SNR")
ax.set_xticks(isos, isos)
ax.set_yticks((1, 3, 10, 30), (1, 3, 10, 30))
ax.minorticks_off()
ax.legend(frameon=False)

# %%
# In a camera ``Exposure(iso=)`` does both: less light, and the gain that the ADC takes from it. The demosaic, the
# colour matrix and the tone curve then make of the noise what one knows from photographs: coloured grain, most visible
# in the shadows.

scene = Scene.builtin("chelsea", size=160)
figure, axes = plt.subplots(1, 4, figsize=(9, 2.2), layout="constrained")
figure.suptitle("One scene at four ISO")
for ax, iso in zip(axes, (100, 800, 3200, 12800), strict=True):
    camera = Camera(
        sensor.ColourFilter.nikon(), sensor.Mosaic("RGGB"), sensor.Exposure(iso=iso), sensor.ShotNoise(full_well),
        sensor.ReadNoise(read_noise), sensor.ADC(bits, black_level=black_level), isp.Demosaic(), isp.WhiteBalance(),
        isp.ColourMatrix(), isp.ToneCurve(),
    )  # fmt: skip
    ax.imshow(plots.as_image(camera(scene, generator=torch.Generator().manual_seed(0))[0]))
    ax.set_title(f"ISO {iso}")
    ax.axis("off")

# %%
# A slope through chance
# ----------------------
#
# To train what stands before the sensor, a gradient must pass through the draw. What one wants is the slope of the
# *expected* loss. kcam writes the draw as :math:`N = \lambda + \sqrt\lambda\, e` with :math:`e` kept, and takes the
# slope
#
# .. math:: \frac{dN}{d\lambda} := 1 + \frac{N - \lambda}{2 \max(\lambda, 1)}
#
# The second term knows that more light is also more noise. Take the loss :math:`(N - t)^2`: its expectation is
# :math:`\lambda + (\lambda - t)^2`, with the slope :math:`1 + 2 (\lambda - t)`. Without the second term the 1 is lost.

light, target = 9.0, 5.0
expected = torch.tensor(light, requires_grad=True)
count = sensor.poisson(expected.expand(400_000), generator=random)
(slope,) = torch.autograd.grad((count - target).square().mean(), expected)
naive = float(2 * (count.detach() - target).mean())  # as if N grew by 1 with lambda, whatever was drawn
exact = 1 + 2 * (light - target)
print(f"slope {slope:.2f}, exact {exact:.2f}; with the noise held fixed {naive:.2f}")
assert math.isclose(slope, exact, rel_tol=0.02)
assert naive < exact - 0.9

# %%
# A slope through rounding
# ------------------------
#
# A staircase has the slope 0 everywhere, so ``torch.round`` would end all training. kcam rounds exactly and passes the
# gradient on as if nothing had been rounded, the *straight-through* estimator. That looks like a trick, but look at the
# mean of many frames: noise of half a step lifts a pixel over the edge as often as its value is near it, and the
# *expected* number is a straight line, to within :math:`e^{-2 \pi^2 \sigma^2} / \pi` steps.

value = torch.linspace(0, 3, 121, dtype=torch.float64)  # in steps of an ADC of 8 bits
figure, ax = plt.subplots(figsize=(7, 3.4), layout="constrained")
for sigma, style in ((0.0, "0.6"), (0.2, "tab:orange"), (0.5, "tab:blue")):
    noise = sigma * torch.randn(20_000, 121, generator=random, dtype=torch.float64)
    recorded = (255 * sensor.quantise((value + 20 + noise) / 255, bits=8)).mean(0) - 20
    ax.plot(value, recorded, color=style, label=f"noise of {sigma} LSB")
ripple, bound = float((recorded - value).abs().max()), math.exp(-2 * (math.pi * sigma) ** 2) / math.pi
print(f"noise of {sigma} LSB: off the line by {ripple:.3f} LSB, by the formula {bound:.3f} and what the draws scatter")
print(f"the read noise of our sensor is {gain * read_noise:.1f} LSB")
assert ripple < bound + 5 * sigma / math.sqrt(20_000)
ax.set(title="Mean of 20 000 frames, rounded", xlabel="signal [LSB]", ylabel="mean recorded [LSB]")
ax.legend(frameon=False)

signal = value.clone().requires_grad_()
print("slope of torch.round:", torch.autograd.grad(torch.round(signal).sum(), signal)[0].unique().tolist())
slope = torch.autograd.grad((255 * sensor.quantise(signal / 255, bits=8)).sum(), signal)[0]
print("slope of sensor.quantise:", slope.round(decimals=6).unique().tolist())
assert torch.allclose(slope, torch.ones_like(slope))

# %%
# Exercises
# ---------
#
# 1. Set ``bits`` to 8. One step is then 39 electrons, far above the read noise, and ``dark`` is the root of a negative
#    number: noise of 0.15 LSB in the dark rarely leaves its step, so there is no 1/12 to subtract.
# 2. Add ``sensor.DarkCurrent(50.0, time=2.0, temperature=41.0)`` behind the shot noise, and print ``mean[0]``. The dark
#    current doubles with each 8 degrees, here from 50 electrons per second at 25 degrees. The assertion about the read
#    noise fails: to which value has it grown, and by which law?
# 3. Append 12800 to ``isos``. The measured SNR is higher than the equation's, and yet no picture is better for it. The
#    black level of 64 DN is then worth 1.2 electrons: what happens to noise below that? Try ``black_level = 512``.
#
# Read on
# -------
#
# EMVA Standard 1288, release 4.0: all quantities of this lesson and how to measure them. Janesick, *Photon Transfer*
# (SPIE 2007): the curve. Kingma and Welling, arXiv 1312.6114: gradients through chance. Bengio, Leonard and
# Courville, arXiv 1308.3432: the straight-through estimator. Widrow and Kollar, *Quantization Noise* (Cambridge 2008):
# when 1/12 is right.
#
# In the gallery: :doc:`/gallery/plot_sensor_photons`, :doc:`/gallery/plot_sensor_bits`.
#
# Next: :doc:`plot_7_colour_to_srgb`, from these numbers to a picture that looks right.
