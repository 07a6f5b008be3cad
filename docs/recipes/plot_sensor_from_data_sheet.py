"""
A sensor from its data sheet
============================

Curves of quantum efficiency, full well, read noise, dark current and gain, as a data sheet prints them, become a
camera. Then we measure this camera as a laboratory would, by the EMVA 1288 standard, and get the data sheet back.
"""

# %%
# The data sheet
# --------------
#
# These numbers are of no real product; they are of a size that colour sensors with pixels of 3.45 µm have. The quantum
# efficiency (QE) counts electrons per photon, in per cent, and includes an infrared cut filter.

import math

import matplotlib.pyplot as plt
import numpy as np
import torch

from kcam import Camera, Scene, isp, optics, plots, sensor, spectral
from kcam.units import mm, nm, um

full_well = 10_000  # electrons
read_noise = 2.4  # electrons
dark_current = 40.0  # electrons / s, at 25 degrees C
prnu, dsnu = 0.006, 1.5  # relative; electrons
system_gain = 0.4  # DN / electron
bits, black_level = 12, 64  # black level in DN
pixel_pitch = 3.45 * um

sheet = np.array([  # nm; QE of red, green and blue pixels in per cent
    [400, 2, 4, 28], [420, 2, 5, 40], [440, 2, 7, 48], [460, 2, 12, 50], [480, 3, 25, 44], [500, 4, 46, 30],
    [520, 5, 58, 17], [540, 6, 60, 9], [560, 11, 54, 6], [580, 30, 40, 4], [600, 48, 24, 3], [620, 51, 13, 3],
    [640, 47, 9, 3], [660, 36, 7, 3], [680, 20, 5, 2], [700, 8, 2, 1], [720, 2, 1, 0], [740, 0, 0, 0],
])  # fmt: skip
wavelengths = torch.from_numpy(sheet[:, 0]) * nm
efficiency = torch.from_numpy(sheet[:, 1:].T) / 100  # (3, L)

# %%
# From quantum efficiency to a colour filter
# ------------------------------------------
#
# kcam's filter curves are responses per unit of *energy*, and their scale is that green peaks at 1. A photon of
# wavelength :math:`\lambda` has the energy :math:`h c / \lambda`, so the curve is the quantum efficiency times
# :math:`\lambda`. ``sensor.fit_gaussians`` writes it as a sum of twelve Gaussians, the form that a filter can be
# trained in, and says what that costs.

fit = sensor.fit_gaussians(efficiency * wavelengths, wavelengths=wavelengths)
colour_filter = sensor.ColourFilter(fit.coefficients.float(), width=fit.width)
print(f"width of the Gaussians {fit.width / nm:.0f} nm")
print("RMS error of red, green, blue, of green's peak:", [f"{error:.1%}" for error in fit.errors])
assert max(fit.errors) < 0.04

fine = torch.linspace(400, 740, 341, dtype=torch.float64) * nm
fitted = colour_filter.response(fine) / fine  # per photon again
fitted = fitted * efficiency[1].max() / fitted[1].max()

figure, ax = plt.subplots(figsize=(9, 3.6), layout="constrained")
for curve, points, colour in zip(fitted, efficiency, ("tab:red", "tab:green", "tab:blue"), strict=True):
    ax.plot(fine / nm, curve, color=colour)
    ax.plot(wavelengths / nm, points, "o", color=colour, markersize=4)
ax.set(title="Quantum efficiency: data sheet (dots) and the fit by Gaussians (lines)", xlabel="wavelength [nm]")
ax.set(ylabel="electrons per photon", ylim=(0, None))

# %%
# The stages of the sensor
# ------------------------
#
# Each number goes to the stage of its name. In kcam 1.0 is the full well before the ``ADC`` and full scale after it, so
# the system gain :math:`K` of EMVA 1288 fixes the analogue gain, :math:`K = \mathrm{gain}\,(2^b - 1) / N_\mathrm{sat}`.
# The exposure in seconds needs a lens: here 8 mm at f/4.

lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(8 * mm), focus_distance=2.0)
full_scale = 2**bits - 1


def sensor_stages(time, amplification=1.0):
    """The sensor up to the raw signal, at an exposure time [s] and an amplification before the ADC."""
    return (
        colour_filter,
        sensor.Mosaic("RGGB"),
        sensor.Exposure(time=time, quantum_efficiency=float(efficiency[1].max())),
        sensor.ShotNoise(full_well=full_well),
        sensor.DarkCurrent(dark_current, time=time),
        sensor.FixedPattern(prnu, dsnu=dsnu, seed=7),  # the seed names one copy of the sensor
        sensor.ReadNoise(read_noise),
        sensor.ADC(bits, black_level=black_level, gain=amplification * system_gain * full_well / full_scale),
    )


imaging = optics.Imaging(lens, pixel_pitch=pixel_pitch)
developing = isp.Demosaic(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve()
camera = Camera(imaging, *sensor_stages(time=1 / 500), *developing)
print(camera[3:9])

# %%
# How many electrons does a white pixel get?
# ------------------------------------------
#
# The number follows from photometry: the illuminance of a white of luminance :math:`L_v` behind a lens, then photons
# per wavelength, then the quantum efficiency of the data sheet, dots and not fit:
#
# .. math:: N = t\,a\,\frac{A}{d^2} \int L_e(\lambda)\,\mathrm{QE}(\lambda)\,\frac{\lambda}{h c}\,d\lambda,
#           \qquad L_v = 683\,\mathrm{lm/W} \int L_e(\lambda)\,\bar y(\lambda)\,d\lambda
#
# with the area :math:`a` of a pixel, the area :math:`A` of the aperture and its distance :math:`d` from the sensor.

luminance, time = 500.0, 1 / 500  # cd/m^2, s
white = spectral.illuminant("D65", wavelengths=wavelengths)
radiance = white * luminance / 683 / float(torch.trapezoid(white * spectral.observer(wavelengths)[:, 1], wavelengths))
photons = radiance * wavelengths / (6.626e-34 * 2.998e8)  # per second, m^2, steradian and metre of wavelength
solid_angle = math.pi * (1 * mm) ** 2 / lens.sensor_distance**2
electrons = time * pixel_pitch**2 * solid_angle * torch.trapezoid(photons * efficiency, wavelengths)

flat = Scene.from_rgb(torch.ones(1, 256, 256), wavelengths=wavelengths, luminance=luminance)  # a white wall
irradiance = imaging(flat).detach()  # is computed once: all frames of the wall share it
mean = Camera(*sensor_stages(time)[:3], context=camera.resolve(flat))(irradiance)[0, 0] * full_well
middle = mean[126:130, 126:130]
simulated = torch.stack([middle[0, 0], middle[0, 1], middle[1, 1]])  # red, green, blue of an RGGB tile
print("red, green, blue by the formula:", [f"{value:.0f}" for value in electrons.tolist()])
print("red, green, blue in kcam:       ", [f"{value:.0f}" for value in simulated.tolist()])
assert torch.allclose(simulated.double(), electrons, rtol=0.04)

# %%
# The photon transfer curve
# -------------------------
#
# Now we forget all that and measure. Two frames of the wall at each exposure time; half of the variance of their
# *difference* is the temporal noise, since what is fixed in the pixels cancels. Photons come at random, so the variance
# of :math:`N` electrons is :math:`N`, and in numbers (DN) it rises with the mean on a line
#
# .. math:: \sigma_y^2 = K^2 \sigma_d^2 + \tfrac{1}{12} + K\,(\mu_y - \mu_\mathrm{dark})
#
# whose slope is the system gain and whose foot is the read noise, with the twelfth for the rounding. The variance falls
# where the first pixels reach the full well, so its peak is the saturation, or a little less.

generator = torch.Generator().manual_seed(0)


def frames(signal, time, count):
    """Numbers [DN] of the green pixels beside red in so many frames, (count, H/2, W/2)."""
    stages = Camera(*sensor_stages(time), context=camera.resolve(flat))
    raw = [stages(signal, generator=generator)[0, 0, 0::2, 1::2] for _ in range(count)]
    return torch.stack(raw).double() * full_scale


def mean_and_variance(signal, time):
    """Mean [DN] and temporal variance [DN^2] of two frames."""
    first, second = frames(signal, time, 2)
    return float((first + second).mean() / 2), float((first - second).var() / 2)


saturating = time * full_well / float(electrons[1])  # s: a white wall fills the well
times = saturating * torch.cat([torch.linspace(0.02, 0.9, 12), torch.linspace(0.94, 1.1, 6)])
curve = torch.tensor([mean_and_variance(irradiance, float(t)) for t in times], dtype=torch.float64)
dark_mean, dark_variance = mean_and_variance(0 * irradiance, 1e-6)

means, variances = curve.T
linear = means < 0.7 * means.max()  # EMVA's range: below 70 % of saturation
design = means[linear] - dark_mean
measured_gain = float((design * (variances[linear] - dark_variance)).sum() / design.square().sum())
measured_noise = math.sqrt(dark_variance - 1 / 12) / measured_gain
measured_well = (float(means[variances.argmax()]) - dark_mean) / measured_gain

figure, ax = plt.subplots(figsize=(9, 3.6), layout="constrained")
ax.plot(means - dark_mean, variances, "o", label="pairs of frames")
ax.plot(means - dark_mean, dark_variance + measured_gain * (means - dark_mean), label="line below 70 %")
ax.set(title="Photon transfer curve of the green pixels: the slope is the gain; where it breaks off the well is full")
ax.set(xlabel="mean above dark [DN]", ylabel="temporal variance [DN²]", ylim=(0, 1.1 * float(variances.max())))
ax.legend(frameon=False)

# %%
# What does not change from frame to frame
# ----------------------------------------
#
# Dark current comes from the mean of dark frames over the exposure time. The fixed pattern is what is left of the
# spread between pixels when frames are averaged: in the dark it is the DSNU, and of the light the PRNU.

dark_times = torch.linspace(0.1, 10, 5, dtype=torch.float64)
dark_means = torch.tensor([float(frames(0 * irradiance, float(t), 2).mean()) for t in dark_times], dtype=torch.float64)
measured_current = float(np.polyfit(dark_times, dark_means, 1)[0]) / measured_gain


def spread_of_pixels(signal, time, count=16):
    """Mean [DN], and variance between pixels without what noise is left in the mean of the frames [DN^2]."""
    stack = frames(signal, time, count)
    return float(stack.mean()), float(stack.mean(0).var() - stack.var(0).mean() / count)


dark_level, dark_spread = spread_of_pixels(0 * irradiance, 1e-6)
level, spread = spread_of_pixels(irradiance, float(saturating / 2))
measured_dsnu = math.sqrt(dark_spread) / measured_gain
measured_prnu = math.sqrt(spread - dark_spread) / (level - dark_level)

rows = {  # name: data sheet, measured, relative tolerance
    "system gain [DN / e]": (system_gain, measured_gain, 0.02),
    "read noise [e]": (read_noise, measured_noise, 0.03),
    "saturation [e]": (full_well, measured_well, 0.08),
    "dark current [e / s]": (dark_current, measured_current, 0.02),
    "PRNU [%]": (100 * prnu, 100 * measured_prnu, 0.04),
    "DSNU [e]": (dsnu, measured_dsnu, 0.06),
}
print(f"{'':22s}{'data sheet':>12s}{'measured':>12s}")
for name, (expected, measured, tolerance) in rows.items():
    print(f"{name:22s}{expected:12.4g}{measured:12.4g}")
    assert math.isclose(measured, expected, rel_tol=tolerance)

# %%
# A picture with it
# -----------------
#
# The exposure time that fills 0.8 of the well with white makes a picture as bright as the colour matrix expects. In a
# sixteenth of the light the same time leaves a sixteenth of the electrons, and an amplification of 16 before the ADC,
# ISO 1600 if this sensor's base is 100, makes it as bright, but not as clean.

figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
figure.suptitle("One sensor in two lights, equal exposure times")
for ax, amplification in zip(axes, (1, 16), strict=True):
    shooting = Camera(imaging, *sensor_stages(0.8 * saturating, amplification), *developing)
    scene = Scene.builtin("coffee", size=300, luminance=luminance / amplification)
    picture = shooting(scene, generator=generator)
    ax.imshow(plots.as_image(picture[0]))
    ax.set_title(f"{scene.luminance:.3g} cd/m², amplification {amplification}")
    ax.axis("off")

# %%
# ``camera.save("mine.safetensors")`` keeps the camera in one file, for ``Camera.load`` and for
# ``kcam shoot --camera mine.safetensors``. Not in the model are crosstalk between pixels, column noise and a quantum
# efficiency that changes with the angle of the light; of the fixed pattern only its white part is.
