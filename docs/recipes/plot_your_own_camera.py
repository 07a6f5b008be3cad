"""
Your own camera
===============

A data sheet, a handful of frames and a raw file in hand: from these to the camera that took them, in the order of the
light. All that follows is measured on cameras made up here, so that what is found can be held beside what was put in.
"""

# %%
# Its curves
# ----------
#
# Data sheets give the quantum efficiency of each channel over wavelength. A table of nanometres is read as it is, with
# no model between; a glass before the sensor, or a lamp, is a table too. Exposure, white balance and colour matrix see
# the filter behind the glass.

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import torch

import kcam.analysis
import kcam.calibration
from kcam import Camera, Raw, Scene, isp, optics, plots, sensor
from kcam.units import mm, nm, um

folder = tempfile.TemporaryDirectory()
here = Path(folder.name)
grid = torch.arange(400, 1001, 20)
curves = {"red": (600, 45, 0.48), "green": (535, 40, 0.55), "blue": (460, 35, 0.47)}
rows = ["nm, " + ", ".join(curves)]
for wavelength in grid.tolist():
    leak = 0.25 / (1 + 2.0 ** ((820 - wavelength) / 20))  # silicon and dyes: all see infrared
    values = [peak * 2 ** (-(((wavelength - mean) / half) ** 2)) + leak for mean, half, peak in curves.values()]
    rows.append(f"{wavelength}, " + ", ".join(f"{value:.3f}" for value in values))
(here / "qe.csv").write_text("\n".join(rows))
(here / "glass.csv").write_text("nm, T [%]\n400, 90\n620, 92\n650, 50\n680, 2\n1000, 1\n")

colours = sensor.ColourFilter.from_csv(here / "qe.csv", quantum_efficiency=True)
glass = sensor.Transmission.from_csv(here / "glass.csv", percent=True)
lens = optics.Lens(optics.CircularAperture(4 * mm), optics.ThinLens(12 * mm), focus_distance=2.0)
camera = Camera(
    optics.Imaging(lens, pixel_pitch=3.45 * um), glass, colours, sensor.Mosaic("RGGB"), sensor.Exposure(time=0.005),
    sensor.ShotNoise(full_well=10_000), sensor.ReadNoise(2.4), sensor.ADC(bits=12, black_level=64),
    isp.Demosaic(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(),
)  # fmt: skip
scene = Scene.builtin("astronaut", size=192)

figure, axes = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
fine = torch.arange(400, 1001).double() * nm
for curve, colour in zip(colours.coefficients, ("#c8553d", "#2a9d5f", "#3f6fd8"), strict=True):
    axes[0].plot(grid, curve, color=colour)
axes[0].plot(fine / nm, glass.transmission(fine), color="0.5", label="the glass")
axes[0].set(xlabel="wavelength [nm]", ylabel="electrons per photon, transmission")
axes[0].legend(frameon=False)
axes[1].imshow(plots.as_image(camera(scene, generator=torch.Generator().manual_seed(0))[0]))
axes[1].set_title("5 ms in daylight")
axes[1].axis("off")

# %%
# The sensor, from pairs of frames
# --------------------------------
#
# Cap the lens and take two frames; light a white wall evenly and take two frames at each of ten or twenty exposures,
# until the picture is white. Two frames of one exposure differ by noise alone, so their difference says how large it
# is, and over the exposures the noise says how many electrons a number is worth: the photon transfer method of EMVA
# Standard 1288. Here the frames are drawn; from files the command is
#
# .. code-block:: text
#
#    kcam calibrate-sensor --darks "d*.tif" --flats "f*.tif" --pattern RGGB --out sensor.json

generator = torch.Generator().manual_seed(0)
gains = 1 + 0.01 * torch.randn(128, 128, generator=generator)  # PRNU 1 %


def frame(light, time):
    """0.4 DN per electron, 3 electrons of read noise, 20 dark electrons a second, a well of 9000, 12 bits."""
    electrons = torch.poisson(light * time * gains + 20 * time, generator=generator).clamp(max=9000)
    electrons = electrons + 3 * torch.randn(128, 128, generator=generator)
    return (0.4 * electrons + 64).round().clamp(0, 4095)


times, dark_times = [0.01 * i for i in range(1, 14)], [0.01, 1.0, 10.0]
flats = [[frame(90_000, time) for _ in range(2)] for time in times]
darks = [[frame(0, time) for _ in range(2)] for time in dark_times]
found = kcam.calibration.photon_transfer(flats, darks, bits=12, exposure_times=times, dark_times=dark_times)
found.save(here / "sensor.json")
stages = sensor.from_calibration(here / "sensor.json", exposure_time=0.01)
print(found)
assert abs(found.channels["mono"].gain.value - 0.4) < 3 * found.channels["mono"].gain.standard_error

from kcam.calibration.report import transfer_figure

figure = transfer_figure(found)

# %%
# What the frames do not show is null in the file, with the reason. The stages of the file are the sensor, from its shot
# noise to its ADC.

print(*stages, sep="\n")

# %%
# Colour, from a picture of the chart
# -----------------------------------
#
# The four outer corners of the grid of patches are enough to find them: pixels (x, y), from that of *dark skin* over
# those of *bluish green* and *black* to *white*. Of a mosaic each channel is averaged over its own pixels. The matrix
# keeps white white, and has the least CIEDE2000.

chart = Scene.builtin("colour_chart", size=(96, 144), illuminant="A")
shot = Camera(*camera[1:4], sensor.Exposure(0.7), *stages)(chart, generator=torch.Generator().manual_seed(0))
recorded = shot - stages[-1].black_level / 4095
corners = [(-0.5, -0.5), (143.5, -0.5), (143.5, 95.5), (-0.5, 95.5)]
colour = kcam.calibration.colour_matrix(
    kcam.calibration.chart_patches(recorded, corners=corners, pattern="RGGB"), illuminant="A"
)
developed = Camera(isp.Demosaic("bilinear", pattern="RGGB"), *colour.stages(), isp.ToneCurve())(recorded)

figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
daylight = Scene.builtin("colour_chart", size=(96, 144)).to_srgb()
for ax, shown, title in zip(axes, (daylight, developed), ("in daylight", "your camera, by a filament"), strict=True):
    ax.imshow(plots.as_image(shown[0]), extent=(0, 6, 4, 0))
    ax.set_title(title)
    ax.axis("off")
for patch, value in enumerate(colour.delta_e.tolist()):
    dark = bool(daylight[0, :, patch // 6 * 24 + 12, patch % 6 * 24 + 12].mean() < 0.45)
    place = patch % 6 + 0.5, patch // 6 + 0.5
    axes[1].text(*place, f"{value:.1f}", ha="center", va="center", color="white" if dark else "black")

# %%
# The lens, from a picture of points
# ----------------------------------
#
# A foil with pinholes before a lamp shows what the lens does. Whatever is a Parameter of the lens is fitted, by descent
# through the camera. With one focus the even terms have one sign that no picture tells; a second one, here with the
# sensor 0.2 mm farther back, tells it.


def lens_with(terms):
    aberration = optics.ZernikeAberration(torch.nn.Parameter(terms))
    return optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), aberration, focus_distance=2.0)


truth = lens_with(torch.tensor([0, 0, 0, 30.0, 0, -20, 0, 25]) * nm)
points = torch.zeros(1, 1, 64, 64)
points[0, 0, 20, 20] = points[0, 0, 44, 40] = 1.0
pinholes = Scene.from_bands(points, wavelengths=torch.tensor([550 * nm]), depth=2.0)
focuses = []
for step in (0.0, 0.2 * mm):
    truth.sensor_distance = 1 / (1 / 0.05 - 1 / 2.0) + step
    with torch.no_grad():
        light = Camera(optics.Imaging(truth, pixel_pitch=4 * um))(pinholes)
    seed = torch.Generator().manual_seed(len(focuses))
    focuses.append(sensor.shot_noise(light, full_well=50_000, generator=seed))
asked = {"lens": lens_with(torch.zeros(8)), "pixel_pitch": 4 * um, "distances": 2.0, "full_well": 50_000}
single = kcam.calibration.fit_psf(focuses[0], **asked)
fit = kcam.calibration.fit_psf(torch.cat(focuses), defocus=(0.0, 0.2 * mm), **asked)
print("of one focus alone these have an open sign:", single.ambiguous)

names = [f"Z{index}" for index in range(4, 9)]
figure, axis = plt.subplots(figsize=(6, 3), layout="constrained")
errors = [2 * fit.standard_errors[name] / nm for name in names]
axis.errorbar(names, [fit.values[name] / nm for name in names], errors, fmt="o", label="found, two standard errors")
axis.plot(names, [30, 0, -20, 0, 25], "k_", markersize=18, label="the lens")
axis.set_ylabel("nm RMS")
axis.legend(frameon=False)

# %%
# Its raw files
# -------------
#
# ``Raw.from_camera(camera, shot).write("shot.dng")`` makes a DNG of a simulated shot, with levels, pattern, matrices,
# noise and exposure in its tags; ``Raw.from_file("photo.nef")`` reads that of a real one, and ``isp.develop`` is kcam's
# own pipeline on it. There is a :doc:`recipe for that alone <plot_raw_files>`.

shot = camera.raw(scene, generator=torch.Generator().manual_seed(0))
Raw.from_camera(camera, shot, scene=scene).write(here / "shot.dng")
again = isp.develop(Raw.from_file(here / "shot.dng"))
apart = (again - camera(scene, generator=torch.Generator().manual_seed(0))).abs().max()
print(f"from file to picture, beside the camera's own: {float(apart):.0e}")

# %%
# What moves
# ----------
#
# Light is collected over a time, and by most sensors row by row: ``sensor.Motion`` takes a velocity, the path of a
# trembling hand, a flow, or the camera's own translation, with a rolling shutter by ``readout=``. ``camera.burst``
# takes several pictures, and the motion goes on from one to the next.

hand = sensor.Motion(path=sensor.tremor(0.1, amplitude=25.0, seed=3), time=0.1)
passing = sensor.Motion(velocity=(-2000.0, 0.0), time=0.002, readout=0.03)
moving = {"a trembling hand, 0.1 s": hand, "passing by, rows in 30 ms": passing}
figure, axes = plt.subplots(1, 3, figsize=(9, 3.3), layout="constrained")
for ax, (title, motion) in zip(axes, moving.items(), strict=False):
    shaken = Camera(*camera[:3], motion, camera[3], sensor.Exposure(), *camera[5:])  # as bright, whatever the time
    ax.imshow(plots.as_image(shaken(scene, generator=torch.Generator().manual_seed(0))[0]))
    ax.set_title(title)
bracket = camera.burst(scene, exposures=[0.001, 0.005, 0.025], generator=torch.Generator().manual_seed(0))
axes[2].imshow(plots.as_image(torch.cat([part[0, :, :, i * 64 : i * 64 + 64] for i, part in enumerate(bracket)], -1)))
axes[2].set_title("a bracket: 1, 5 and 25 ms")
for ax in axes:
    ax.axis("off")

# %%
# Light that goes astray
# ----------------------
#
# Some light ends where it was not aimed at, and some of what is recorded never was light. Each is a stage of its own;
# what each alone does to a window in a dark room, much too strong:

seen = torch.full((3, 96, 144), 0.1)
seen[:, 30:66, 30:56] = 1.0
seen[:, 20:80, 76:124] = Scene.builtin("coffee", (60, 48)).to_srgb()[0]
room = Scene.from_rgb(seen)
before = [sensor.ColourFilter.kodak(), sensor.Mosaic("RGGB"), sensor.Exposure()]
behind = [isp.Demosaic(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve()]
ways = {
    "none of it": before,
    "veiling glare of 10 %": [before[0], optics.VeilingGlare(0.1, core=0.003, focal_length=8 * mm), *before[1:]],
    "micro-lens shading": [before[0], sensor.MicrolensShading(0.3, pupil_distance=1 * mm), *before[1:]],
    "crosstalk": [*before[:2], sensor.Crosstalk(0.1, electrical=(0.2, 0.12, 0.08)), before[2]],
    "hot and dead pixels": [*before, sensor.DefectPixels(hot=5e-3, dead=2e-3, electrons=5000.0)],
    "rows and columns": [*before, sensor.RowColumnNoise(60.0, fixed_column=60.0)],
}
figure, axes = plt.subplots(2, 3, figsize=(9, 4.6), layout="constrained")
for ax, (name, own) in zip(axes.flat, ways.items(), strict=True):
    picture = Camera(*own, *behind)(room, generator=torch.Generator().manual_seed(0))
    ax.imshow(plots.as_image(picture[0].detach()))
    ax.set_title(name)
    ax.axis("off")

# %%
# A plan says what leaving each out would change, and leaves out what this scene does not show.

plan = Camera(*camera[:3], optics.VeilingGlare(0.02), sensor.MicrolensShading(0.5), *camera[3:]).plan(
    scene, tolerance=0.02
)
print(plan)

# %%
# The pipeline that phones have
# -----------------------------
#
# Denoising by the noise that the camera knows, local tone mapping, sharpening and JPEG: ``Camera.preset("phone_lens")``
# has all four, elsewhere they are off until they are put in.

plain = [
    sensor.ColourFilter.nikon(), sensor.Mosaic("RGGB"), sensor.Exposure(iso=1600),
    sensor.ShotNoise(full_well=4500), sensor.ReadNoise(1.5), sensor.ADC(bits=10, black_level=64),
    isp.Demosaic(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(),
]  # fmt: skip
phone = [*plain[:7], isp.Denoise(), *plain[7:9], isp.LocalToneMapping(), plain[9], isp.Sharpen(), isp.JPEG(90)]
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
coffee = Scene.builtin("coffee", (200, 300))
for ax, (title, own) in zip(axes, {"developed": plain, "as a phone shows it": phone}.items(), strict=True):
    ax.imshow(plots.as_image(Camera(*own)(coffee, generator=torch.Generator().manual_seed(1))[0]))
    ax.set_title(f"ISO 1600, {title}")
    ax.axis("off")

# %%
# What it is worth
# ----------------
#
# ``kcam report camera.safetensors --out report.html`` photographs charts with the camera, as a laboratory would, and
# says of each number by which method; what a camera lacks is stated with its reason. Each measurement also stands by
# itself in ``kcam.analysis``.

optics_alone, finished = (kcam.analysis.edge_response(camera, whole=whole) for whole in (False, True))
noise = kcam.analysis.dynamic_range(camera)
print(f"MTF50: {optics_alone.mtf50:.3f} of the light on the pixels, {finished.mtf50:.3f} of the picture [cycles/pixel]")
print(f"dynamic range {noise.decibels:.1f} dB, {noise.stops:.1f} stops")

figure, axis = plt.subplots(figsize=(6, 3), layout="constrained")
for response, label in ((optics_alone, "light on the pixels"), (finished, "finished picture")):
    axis.plot(response.frequencies, response.mtf, label=label)
axis.set(xlabel="cycles per pixel", ylabel="contrast", xlim=(0, 1), ylim=(0, None))
axis.legend(frameon=False)
folder.cleanup()
