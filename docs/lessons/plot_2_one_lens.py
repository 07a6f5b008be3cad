"""
2. One lens: focus, diffraction, colour
=======================================

A lens turns a point of light into a spot on the sensor, the point spread function (PSF). This lesson computes it, holds
it to the formulas of the textbook (Airy's disc, the blur circle, the modulation transfer function) and then gives the
lens real glass, in which each colour has a focus of its own.
"""

# %%
# A question
# ----------
#
# How sharp can a picture be? A lens of focal length :math:`f` at the distance :math:`d` from the sensor is in focus
# for objects at the distance :math:`z` where
#
# .. math:: \frac{1}{f} = \frac{1}{z} + \frac{1}{d}
#
# In kcam a ``Lens`` is a list of thin elements in one plane, in front of a sensor. ``focus_distance`` sets the sensor
# by this formula. Everything is in metres.

import math

import matplotlib.pyplot as plt
import torch

from kcam import Scene, optics, plots
from kcam.units import mm, nm, um

focal_length, focus, wavelength = 50 * mm, 2.0, 550 * nm


def ideal(diameter):
    """A perfect lens of 50 mm, focused at 2 m."""
    return optics.Lens(optics.CircularAperture(diameter), optics.ThinLens(focal_length), focus_distance=focus)


lens = ideal(5 * mm)
print(f"sensor at {lens.sensor_distance / mm:.3f} mm, f-number N = d / D = {lens.f_number:.3f}")
assert math.isclose(lens.sensor_distance, 1 / (1 / focal_length - 1 / focus))

# %%
# Diffraction: the smallest spot
# ------------------------------
#
# Light is a wave, and the edge of the aperture bends it. In focus the spot of a round lens is Airy's pattern:
#
# .. math:: I(r) = I_0 \left(\frac{2 J_1(v)}{v}\right)^2, \qquad v = \frac{\pi r}{\lambda N}, \qquad
#           \text{first dark ring at } r = 1.22\,\lambda N
#
# ``lens.psf`` computes the PSF on pixels of any pitch. Here these are far smaller than the spot, and
# ``integrate=False`` takes the irradiance at their centres.

pitch = 0.25 * um
window = {"distances": focus, "pixel_pitch": pitch, "shape": (129, 129), "integrate": False, "dtype": torch.float64}
psf = lens.psf([wavelength], **window)[0, 0]  # of (distances, wavelengths, rows, columns)
radius = pitch * torch.arange(65, dtype=torch.float64)
profile = psf[64, 64:] / psf[64, 64]  # the origin is at index 129 // 2

v = math.pi * radius / (wavelength * lens.f_number)
airy = torch.ones_like(v)
airy[1:] = (2 * torch.special.bessel_j1(v[1:]) / v[1:]) ** 2
dark_ring = 1.21967 * wavelength * lens.f_number
darkest = radius[(profile[1:] > profile[:-1]).nonzero()[0, 0]]  # from there on it rises again
print(f"largest difference from Airy's pattern: {(profile - airy).abs().max():.0e} of the peak")
print(f"first dark ring: {darkest / um:.2f} um in steps of {pitch / um:g} um; 1.22 lambda N = {dark_ring / um:.2f} um")
assert (profile - airy).abs().max() < 2e-3  # the formula takes the sine of the cone's angle for its tangent
assert abs(darkest - dark_ring) < pitch

figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
colour = plots.light_colours(torch.tensor([wavelength]))[0]
reach = 64 * pitch / um
axes[0].imshow(plots.psf_image(psf, colour), extent=(-reach, reach, reach, -reach))
axes[0].set(title="PSF of a perfect lens, square root", xlabel="x [µm]", ylabel="y [µm]")
axes[1].semilogy(radius / um, profile, label="kcam")
axes[1].semilogy(radius / um, airy, "k:", label="Airy")
axes[1].axvline(dark_ring / um, color="0.7", label="1.22 λN")
axes[1].set(title="Along the radius", xlabel="radius [µm]", ylabel="irradiance / peak", ylim=(1e-6, 2))
axes[1].legend(frameon=False)

# %%
# Defocus: the blur circle
# ------------------------
#
# Rays from another distance :math:`z` meet in front of the sensor or behind it. Similar triangles give the diameter of
# the disc that they fill on the sensor:
#
# .. math:: c = D\,d\,\left|\frac{1}{z} - \frac{1}{z_\mathrm{focus}}\right|
#
# An even disc has half of its light within :math:`r_{50} = c / (2\sqrt 2)`. We measure this radius in the PSF of a
# wider lens. Far from focus geometry is right; near to it the spot stays as large as diffraction makes it, 0.53
# :math:`\lambda N`.


def half_light_radius(psf, pitch):
    """The radius of the circle about the middle that holds half of the light."""
    offset = torch.arange(psf.shape[-1], dtype=torch.float64) - psf.shape[-1] // 2
    distance, order = torch.hypot(offset[:, None], offset[None]).flatten().sort()
    within = psf.flatten()[order].cumsum(0)
    return pitch * float(distance[torch.searchsorted(within, 0.5 * within[-1])])


lens = ideal(10 * mm)
pitch, distances = 1 * um, torch.tensor([1.2, 1.4, 1.6, 1.7, 1.8, 1.9, 2.0, 2.1, 2.25, 2.5, 3.0, 4.0, 6.0])
psfs = lens.psf([wavelength], distances=distances, pixel_pitch=pitch, shape=(301, 301))[:, 0]
measured = torch.tensor([half_light_radius(psf, pitch) for psf in psfs])
circle = 10 * mm * lens.sensor_distance * (1 / distances - 1 / focus).abs()
wide = circle > 40 * um
print("r50 / geometry, wide discs:", [f"{ratio:.2f}" for ratio in (measured / (circle / math.sqrt(8)))[wide].tolist()])
assert torch.allclose(measured[wide], circle[wide] / math.sqrt(8), rtol=0.1)

figure = plt.figure(figsize=(9, 3.6), layout="constrained")
figure.suptitle("Out of focus the PSF is a disc with a fringe of diffraction, f/5")
left, right = figure.subfigures(1, 2)
for ax, index in zip(left.subplots(1, 3), (2, 4, 6), strict=True):
    ax.imshow(plots.psf_image(plots.centre(psfs[index], 70), colour))
    ax.set_title(f"{distances[index]:.1f} m")
    ax.axis("off")
ax = right.subplots()
ax.plot(distances, measured / um, "o-", label="PSF")
fine = torch.linspace(1.2, 6, 400)
ax.plot(fine, 10 * mm * lens.sensor_distance * (1 / fine - 1 / focus).abs() / math.sqrt(8) / um, "k:", label="geometry")
ax.axhline(0.53 * wavelength * lens.f_number / um, color="0.7", label="diffraction")
ax.set(title="Radius of half the light", xlabel="distance of the point [m]", ylabel="radius [µm]", ylim=(0, 80))
ax.legend(frameon=False)

# %%
# Contrast: the modulation transfer function
# ------------------------------------------
#
# A picture is the scene convolved with the PSF, so fine stripes lose contrast by its Fourier transform. Its modulus,
# the MTF, is known in closed form for a perfect round lens (paraxially: for lenses faster than f/8 say
# :math:`N \sqrt{1 + 1 / 4 N^2}` for :math:`N`). It is zero beyond the cutoff :math:`1 / \lambda N`:
#
# .. math:: \mathrm{MTF}(\nu) = \frac{2}{\pi}\left(\arccos \nu - \nu \sqrt{1 - \nu^2}\right), \qquad
#           \nu = \lambda N \cdot \text{frequency}
#
# A pixel of pitch :math:`p` adds up the light that falls on it, which multiplies the MTF by
# :math:`\mathrm{sinc}(p \cdot \text{frequency})`. ``integrate=True``, the default, is a PSF on such pixels. A PSF in a
# window lacks the light outside, a fraction of a per cent; ``lens.mtf`` divides by the light that is there, and we
# multiply it back.

lens, pitch, size = ideal(5 * mm), 2.8 * um, 255
frequency = torch.arange(size // 2 + 1) / (size * pitch)  # up to 1 / (2 pitch): just what this lens can show
nu = (wavelength * lens.f_number * frequency).clamp(max=1)
perfect = 2 / math.pi * (nu.arccos() - nu * (1 - nu**2).sqrt())

figure, ax = plt.subplots(figsize=(7, 3.6), layout="constrained")
for integrate, label in ((False, "lens alone"), (True, "lens and pixel of 2.8 µm")):
    window = {"distances": focus, "pixel_pitch": pitch, "shape": (size, size), "integrate": integrate}
    light = lens.psf([wavelength], **window).sum()
    mtf = light * lens.mtf([wavelength], **window)[0, 0, size // 2, size // 2 :]
    expected = perfect * torch.sinc(pitch * frequency) if integrate else perfect
    print(f"{label}: {light:.2%} of the light in the window, MTF to {(mtf - expected)[1:].abs().max():.0e}")
    assert (mtf - expected)[1:].abs().max() < 3e-3
    ax.plot(frequency * mm, mtf, label=label)
    ax.plot(frequency * mm, expected, "k:")
ax.set(title="MTF of a perfect lens, f/10, and its closed form (dots)", xlabel="line pairs per mm", ylabel="contrast")
ax.legend(frameon=False)

# %%
# Colour: glass disperses
# -----------------------
#
# Glass slows blue light more than red. For a thin lens with one spherical and one flat surface the focal length is
# :math:`f(\lambda) = R / (n(\lambda) - 1)`. How much glass disperses is stated by Abbe's number
# :math:`V = (n_d - 1) / (n_F - n_C)` at three lines of the Sun's spectrum; the focus then shifts by :math:`f / V` from
# blue to red.

d, F, C = 587.56 * nm, 486.13 * nm, 656.27 * nm
lines = torch.tensor([F, d, C], dtype=torch.float64)
n_F, n_d, n_C = optics.refractive_index("N-BK7", wavelengths=lines).tolist()
abbe = (n_d - 1) / (n_F - n_C)
singlet = optics.Lens(
    optics.CircularAperture(5 * mm), optics.PlanoConvexLens(25.8 * mm, glass="N-BK7"), focus_distance=focus
)
f_F, f_d, f_C = singlet.focal_length(lines).tolist()
print(f"N-BK7: n_d = {n_d:.4f}, V = {abbe:.2f} (catalogue: 1.5168, 64.17)")
print(f"f = {f_d / mm:.2f} mm; from F to C it grows by {(f_C - f_F) / mm:.3f} mm, f / V = {f_d / abbe / mm:.3f} mm")
assert abs(abbe - 64.17) < 0.02
assert math.isclose(f_C - f_F, f_d / abbe, rel_tol=0.02)

# %%
# The sensor stands where 550 nm is in focus. The other colours form discs, of a diameter
# :math:`D\,|1 - d / d(\lambda)|`, so that a white point gets a rim of blue and red.

wavelengths = torch.tensor([450, 500, 550, 650], dtype=torch.float64) * nm
psfs = singlet.psf(wavelengths, distances=focus, pixel_pitch=1 * um, shape=(65, 65))[0]
image_distance = 1 / (1 / singlet.focal_length(wavelengths) - 1 / focus)
circle = 5 * mm * (1 - singlet.sensor_distance / image_distance).abs()

figure, axes = plt.subplots(1, 4, figsize=(9, 3), layout="constrained")
figure.suptitle("One point through N-BK7, 64 µm wide: every colour has its own focus")
for ax, psf, colour, value, width in zip(
    axes, psfs, plots.light_colours(wavelengths), wavelengths, circle, strict=True
):
    ax.imshow(plots.psf_image(psf, colour))
    ax.set_title(f"{value / nm:.0f} nm\ndisc {width / um:.0f} µm", size=10)
    ax.axis("off")

# %%
# What it does to a picture
# -------------------------
#
# ``optics.Imaging`` convolves a scene, band by band, with the PSFs. What it gives is light again, so that we can look
# at it as a scene.

star = Scene.builtin("star", size=128)


def seen_through(lens, distance):
    light = optics.Imaging(lens, pixel_pitch=4 * um)(star.with_depth(distance))
    return plots.as_image(Scene.from_bands(light, wavelengths=star.wavelengths).to_srgb()[0])


views = {
    "perfect, f/5, in focus": (ideal(10 * mm), focus),
    "perfect, f/5, at 1.8 m": (ideal(10 * mm), 1.8),
    "perfect, f/50, in focus": (ideal(1 * mm), focus),
    "N-BK7, f/10, in focus": (singlet, focus),
}
figure, axes = plt.subplots(1, 4, figsize=(9, 2.8), layout="constrained")
figure.suptitle("A star of 36 periods, 0.5 mm on the sensor")
for ax, (name, (lens, distance)) in zip(axes, views.items(), strict=True):
    ax.imshow(seen_through(lens, distance))
    ax.set_title(name, size=9)
    ax.axis("off")

# %%
# The lens at f/50 is soft everywhere, and the lens of glass is sharp in green light alone: blue spreads into the dark
# wedges. Near the middle of the star that is out of focus black and white have changed places. There a period is
# shorter than 0.82 :math:`c`, where the Fourier transform of the disc is negative. Along a circle we can measure it.

angle = torch.linspace(0, 2 * math.pi, 721)[:-1]
stripes = torch.sin(36 * angle)
picture = torch.tensor(seen_through(ideal(10 * mm), 1.8))[..., 1]
for radius in (25, 55):
    row, column = (64 + radius * torch.sin(angle)).long(), (64 + radius * torch.cos(angle)).long()
    amplitude = 2 * (picture[row, column] * stripes).mean()
    print(f"{radius} pixels from the middle, period {2 * math.pi * radius / 36 * 4:.0f} um: amplitude {amplitude:+.2f}")
    assert amplitude < 0 if radius == 25 else amplitude > 0

# %%
# Exercises
# ---------
#
# 1. Change ``ideal(5 * mm)`` in the first block to ``2.5 * mm``. The dark ring moves to twice the radius, and the
#    window of 129 pixels no longer holds the second.
# 2. Change ``glass="N-BK7"`` to ``"N-SF11"`` and the radius to ``39 * mm``: nearly the same focal length, Abbe's number
#    of 25.7. The assertions about N-BK7 fail, and the discs of blue and red grow by the ratio of Abbe's numbers.
# 3. Focus the singlet for blue: ``focus_wavelength=450 * nm``. Which colour do the dark wedges of the star have now?
#
# Read on
# -------
#
# Goodman, *Introduction to Fourier Optics*, chapters 5 (lenses) and 6 (PSF and MTF of incoherent imaging). Born and
# Wolf, *Principles of Optics*, 7th ed., 8.5.2: Airy's pattern. Lens: ``kcam/optics/lens.py``; the propagators that
# compute PSFs, and how accurate each is, are printed by ``lens.explain``.
#
# In the gallery: :doc:`/gallery/plot_psf_airy`, :doc:`/gallery/plot_psf_through_focus`,
# :doc:`/gallery/plot_psf_singlet_colours`.
#
# Next: :doc:`plot_3_aberrations_and_real_lenses`, or why a perfect lens cannot be bought.
