"""
3. Aberrations and real lenses
==============================

A real lens does not bring all rays to one point. This lesson describes what is left over by Zernike polynomials,
predicts how much sharpness it costs, finds it in a simple lens of glass, and then looks at a photographic lens over its
field.
"""

# %%
# A question
# ----------
#
# How good must a lens be? Light from a point should reach the sensor as a sphere that closes in on the image point. The
# **wavefront error** :math:`W` is how much later it comes through each place of the pupil, a length in metres. It is
# written as a sum of Zernike's polynomials, which are orthogonal over the disc and of unit variance in Noll's order:
#
# .. math:: W(\rho, \theta) = \sum_j c_j Z_j(\rho, \theta), \qquad \sigma^2 = \sum_{j > 1} c_j^2
#
# so that the square of the RMS error :math:`\sigma` is the sum of squares of the coefficients. Some have names.

import math

import matplotlib.pyplot as plt
import torch

from kcam import optics, plots
from kcam.units import mm, nm, um

wavelength = 550 * nm
infinity = math.inf
terms = {  # Noll's index and the polynomial
    "defocus": (4, lambda rho, theta: math.sqrt(3) * (2 * rho**2 - 1)),
    "astigmatism": (6, lambda rho, theta: math.sqrt(6) * rho**2 * torch.cos(2 * theta)),
    "coma": (8, lambda rho, theta: math.sqrt(8) * (3 * rho**3 - 2 * rho) * torch.cos(theta)),
    "spherical": (11, lambda rho, theta: math.sqrt(5) * (6 * rho**4 - 6 * rho**2 + 1)),
}


def aberrated_psf(j, rms):
    """PSF of a lens of 50 mm at f/10 with an RMS error [m] in Zernike's term j."""
    coefficients = torch.zeros(11, dtype=torch.float64)
    coefficients[j - 1] = rms
    lens = optics.Lens(
        optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), optics.ZernikeAberration(coefficients),
        focus_distance=infinity,
    )  # fmt: skip
    window = {"pixel_pitch": 0.5 * um, "shape": (97, 97), "integrate": False, "dtype": torch.float64}
    return lens.psf([wavelength], distances=infinity, **window)[0, 0]


axis = torch.linspace(-1, 1, 201, dtype=torch.float64)
rho, theta = torch.hypot(axis[:, None], axis), torch.atan2(axis[:, None], axis)
colour = plots.light_colours(torch.tensor([wavelength]))[0]
figure, axes = plt.subplots(2, 4, figsize=(9, 4.8), layout="constrained")
figure.suptitle("Wavefront errors of 0.2 waves RMS (late is red) and their PSFs, 48 µm wide")
for (top, bottom), (name, (j, polynomial)) in zip(axes.T, terms.items(), strict=True):
    wavefront = torch.where(rho <= 1, polynomial(rho, theta), torch.nan)
    variance = wavefront[rho <= 1].square().mean()  # 1, but for the steps of the grid
    assert abs(variance - 1) < 0.03
    top.imshow(wavefront.numpy(), cmap="RdBu_r", vmin=-3, vmax=3)
    top.set_title(f"{name}, $Z_{{{j}}}$")
    bottom.imshow(plots.psf_image(aberrated_psf(j, 0.2 * wavelength), colour))
    top.axis("off")
    bottom.axis("off")

# %%
# How much sharpness it costs
# ---------------------------
#
# The **Strehl ratio** :math:`S` is the irradiance in the middle of the PSF over that of a perfect lens. For small
# errors it follows from the RMS error alone, whatever its shape, as Maréchal and Mahajan found:
#
# .. math:: S \approx \exp\left(-(2 \pi \sigma / \lambda)^2\right)
#
# A lens counts as diffraction-limited at :math:`S = 0.8`, where :math:`\sigma = \lambda / 14`.

perfect = aberrated_psf(4, 0.0)[48, 48]
waves = torch.linspace(0, 0.25, 11)
figure, ax = plt.subplots(figsize=(7, 3.6), layout="constrained")
for name, (j, _) in terms.items():
    strehl = torch.stack([aberrated_psf(j, rms * wavelength)[48, 48] / perfect for rms in waves.tolist()])
    ax.plot(waves, strehl, "o-", ms=4, label=name)
    at_limit = aberrated_psf(j, wavelength / 14)[48, 48] / perfect
    print(f"{name:12s} Strehl ratio at 1/14 wave: {at_limit:.3f}; Maréchal {math.exp(-((math.pi / 7) ** 2)):.3f}")
    assert abs(at_limit - math.exp(-((math.pi / 7) ** 2))) < 0.005
ax.plot(waves, torch.exp(-((2 * math.pi * waves) ** 2)), "k:", label="Maréchal")
ax.set(title="Strehl ratio of four aberrations", xlabel="RMS wavefront error [waves]", ylabel="Strehl ratio")
ax.legend(frameon=False)

# %%
# A lens of glass
# ---------------
#
# A sphere is the surface that is easy to grind, and the wrong one: rays at its rim are bent too much. kcam's
# ``PlanoConvexLens`` is a thin element, a delay by the thickness of its glass, :math:`(n - 1)(\sqrt{R^2 - r^2} - R)`.
# A perfect lens for light from infinity would delay by :math:`f - \sqrt{f^2 + r^2}`. To the fourth order in
# :math:`r` the two differ by the **spherical aberration** of the rim, at :math:`r = a`,
#
# .. math:: W_{040} = \frac{a^4}{8 f^3}\left(1 + \frac{1}{(n - 1)^2}\right)
#
# whose RMS error is :math:`2 W_{040} / 3\sqrt 5`. Moving the sensor to the best focus, by a defocus of
# :math:`-W_{040}` at the rim, leaves a quarter of that, :math:`W_{040} / 6 \sqrt 5`. It is the reason why cheap lenses
# are stopped down: the error grows as the fourth power of the aperture.

radius = 25.9 * mm
index = float(optics.refractive_index("N-BK7", wavelengths=torch.tensor([wavelength])))
focal_length = radius / (index - 1)


def strehl_of_glass(diameter, *, refocused):
    """Strehl ratio of the plano-convex lens, with its paraxial focus on the sensor or its best one."""
    error = (diameter / 2) ** 4 / (8 * focal_length**3) * (1 + 1 / (index - 1) ** 2)
    defocus = optics.Defocus(2 * error / (diameter / 2) ** 2 if refocused else 0.0)
    aperture = optics.CircularAperture(diameter)
    glass = optics.Lens(aperture, optics.PlanoConvexLens(radius), defocus, focus_distance=infinity)
    ideal = optics.Lens(aperture, optics.ThinLens(focal_length), focus_distance=infinity)
    window = {"distances": infinity, "pixel_pitch": 0.5 * um, "shape": (3, 3), "integrate": False}
    strehl = glass.psf([wavelength], **window)[0, 0, 1, 1] / ideal.psf([wavelength], **window)[0, 0, 1, 1]
    rms = error / (6 if refocused else 1.5) / math.sqrt(5)
    return float(strehl), math.exp(-((2 * math.pi * rms / wavelength) ** 2))


for f_number in (14, 10, 8):
    for refocused in (False, True):
        strehl, expected = strehl_of_glass(focal_length / f_number, refocused=refocused)
        focus = "best" if refocused else "paraxial"
        print(f"f/{f_number:<2d} {focus:8s} focus: Strehl ratio {strehl:.3f}; from the formula {expected:.3f}")
        assert abs(strehl - expected) < 0.02 or expected < 0.6  # Maréchal is for small errors

# %%
# Which side faces the light
# --------------------------
#
# A delay knows no sides. In a real lens the ray is bent at the first surface and meets the second one at another
# height, and the error depends on which side faces the object. ``CompoundLens`` traces exact rays through surfaces, and
# ``opd`` is the wavefront in waves. The textbook's thin lens, with :math:`q = \pm 1` for its flat side behind or in
# front, has
#
# .. math:: W_{040} = \frac{a^4}{32 f^3 n (n - 1)} \left(\frac{n + 2}{n - 1} - 4 (n + 1) q + (3 n + 2)(n - 1)
#                     + \frac{n^3}{n - 1}\right)

semi = focal_length / 20  # f/10
thickness = 0.1 * mm
convex_first = (
    optics.Surface(radius=radius, thickness=thickness, glass="N-BK7", semi_diameter=semi, stop=True),
    optics.Surface(radius=infinity),
)
flat_first = (
    optics.Surface(radius=infinity, thickness=thickness, glass="N-BK7", semi_diameter=semi, stop=True),
    optics.Surface(radius=-radius),
)
for name, surfaces, q in (("convex side first", convex_first, 1), ("flat side first", flat_first, -1)):
    lens = optics.CompoundLens(*surfaces, focus_distance=infinity)
    wavefront, passes = lens.opd([wavelength], distances=infinity)
    at_rim = abs(float(wavefront[0, 0, 32, 64]))  # of 65 x 65 points: the right end of the middle row
    shape = (index + 2) / (index - 1) - 4 * (index + 1) * q + (3 * index + 2) * (index - 1) + index**3 / (index - 1)
    expected = semi**4 / (32 * focal_length**3 * index * (index - 1)) * shape / wavelength
    print(f"{name:18s} {at_rim:.3f} waves at the rim, f/10; formula {expected:.3f}")
    assert math.isclose(at_rim, expected, rel_tol=0.05)
thin = semi**4 / (8 * focal_length**3) * (1 + 1 / (index - 1) ** 2) / wavelength
print(f"the thin element   {thin:.3f} waves")

# %%
# The thin element lies between the two. It is a good model of a DOE or a weak lens and a rough one of thick glass:
# where the difference counts, trace surfaces.
#
# A photographic lens
# -------------------
#
# One lens cannot be right in all colours and at all angles. Designers combine several, so that their errors cancel.
# kcam has eight lenses from patents; the Cooke triplet of 1893 is the simplest good one. A point of the field is given
# as the tangent of its angle, here up to 20 degrees.

triplet = optics.CompoundLens.preset("cooke_triplet")
heights = (0.0, 0.18, 0.36)
figure = plt.figure(plots.section_figure(triplet, heights=heights, title=" "))
figure.suptitle("Cooke triplet in section, with rays of three points of the field")

# %%
# ``refocus`` moves the sensor to where spots are smallest over the field. Then, point by point, the PSF in three
# colours: round on the axis, and drawn out towards the corner.

field = torch.tensor([[0.0, height] for height in heights])
triplet = triplet.refocus(field=field)
wavelengths = torch.tensor([486, 546, 656], dtype=torch.float64) * nm
psfs = triplet.psf(wavelengths, distances=infinity, pixel_pitch=1 * um, shape=(121, 121), field=field)[:, 0]
hues = torch.tensor(plots.light_colours(wavelengths))
figure, axes = plt.subplots(1, 3, figsize=(9, 3.4), layout="constrained")
figure.suptitle("Cooke triplet at f/4.3: PSF over the field, 121 µm wide, three colours")
for ax, psf, height in zip(axes, psfs, heights, strict=True):
    picture = torch.einsum("lhw,lc->hwc", psf / psf.amax((-2, -1), keepdim=True), hues.to(psf))
    ax.imshow((picture / picture.max()).sqrt().clamp(0, 1).numpy())
    ax.set_title(f"{math.degrees(math.atan(height)):.0f} degrees")
    ax.axis("off")

# %%
# Distortion and the place of the stop
# ------------------------------------
#
# Straight lines should stay straight: an object at the tangent :math:`t` belongs at the height :math:`f t`. By how much
# the chief ray misses it is the **distortion**. It comes from where the stop stands. A stop in front of a single lens
# makes a barrel, one behind it a cushion; a symmetric lens with the stop in its middle cancels them, and the triplet
# nearly does.


def singlet_with_stop(where):
    """A biconvex lens of about 50 mm with its stop in front of it or behind it."""
    stop = optics.Surface(thickness=10 * mm, semi_diameter=2 * mm, stop=True)
    front = optics.Surface(radius=51 * mm, thickness=3 * mm, glass="N-BK7")
    if where == "in front":
        surfaces = (stop, front, optics.Surface(radius=-51 * mm))
    else:
        stop = optics.Surface(semi_diameter=2 * mm, stop=True)
        surfaces = (front, optics.Surface(radius=-51 * mm, thickness=10 * mm), stop)
    return optics.CompoundLens(*surfaces, focus_distance=infinity)


lenses = {"stop in front": singlet_with_stop("in front"), "stop behind": singlet_with_stop("behind")}
lenses["triplet"] = triplet
tangents = torch.linspace(0, 0.36, 10)
field = torch.stack([torch.zeros_like(tangents), tangents], dim=1)
figure, axes = plt.subplots(1, 4, figsize=(9, 2.9), layout="constrained", width_ratios=(1, 1, 1, 1.5))
figure.suptitle("Images of a grid, distortion drawn 5 times as large, and its size")
ruler = torch.linspace(-0.25, 0.25, 21)
for ax, (name, lens) in zip(axes, lenses.items(), strict=False):
    for line in torch.linspace(-0.25, 0.25, 6):
        points = torch.stack([line.expand_as(ruler), ruler], dim=1)
        for own in (points, points.flip(1)):
            x, y = (own * (1 + 5 * lens.distortion(own)[:, None])).T
            ax.plot(x, y, "k", lw=0.8)
    ax.set(title=name, aspect="equal")
    ax.axis("off")
    distortion = lens.distortion(field)
    axes[3].plot(100 * tangents, 100 * distortion, label=name)
    print(f"{name:14s} distortion at 20 degrees: {distortion[-1]:+.2%}")
axes[3].set(xlabel="tangent of the field angle [%]", ylabel="distortion [%]")
axes[3].legend(frameon=False, fontsize=9)
assert lenses["stop in front"].distortion(field)[-1] < -0.005
assert lenses["stop behind"].distortion(field)[-1] > 0.005
assert triplet.distortion(field).abs().max() < 0.001

# %%
# Vignetting
# ----------
#
# Corners are darker than the middle. Geometry alone costs a thin lens :math:`\cos^4` of the field angle: the light
# travels farther, which counts twice, and meets pupil and sensor aslant. Rims in front of the stop and behind it cut
# more, which also takes away the worst rays. A wide angle can stay above :math:`\cos^4` for a while: its pupil looks
# larger from the side.

figure, ax = plt.subplots(figsize=(7, 3.6), layout="constrained")
for name, widest in (("cooke_triplet", 0.36), ("ef50", 0.43), ("wide_angle", 0.75)):
    tangents = torch.linspace(0, widest, 9, dtype=torch.float64)
    light = optics.CompoundLens.preset(name).relative_illumination(torch.stack([0 * tangents, tangents], dim=1))
    ax.plot(tangents.atan().rad2deg(), light, "o-", ms=4, label=name)
angle = torch.linspace(0, 37, 100)
ax.plot(angle, torch.cos(angle.deg2rad()) ** 4, "k:", label="cos⁴")
ax.set(title="Relative illumination of three lenses, wide open", xlabel="field angle [degrees]", ylabel="light / axis")
ax.set_ylim(0, 1.1)
ax.legend(frameon=False)

thin = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), focus_distance=infinity)
light = float(thin.relative_illumination(torch.tensor([[0.0, 0.36]])))
print(f"thin lens at 20 degrees: {light:.4f}; cos^4 {math.cos(math.atan(0.36)) ** 4:.4f}")
assert math.isclose(light, math.cos(math.atan(0.36)) ** 4, rel_tol=0.01)

# %%
# Exercises
# ---------
#
# 1. In the first figure, change ``0.2 * wavelength`` to ``-0.2 * wavelength``. Three PSFs stay as they are, and one is
#    mirrored. Why can one picture in focus not tell the sign of a defocus?
# 2. Change ``semi`` to ``focal_length / 10``, which is f/5. The errors at the rim grow 16 times, and the formula, of
#    the fourth order, begins to miss: by how much?
# 3. Move the stop of ``singlet_with_stop`` from 10 mm to 1 mm, and most of the distortion is gone. Print
#    ``lens.field_curves([0, 0.1, 0.2])`` of both: how does the spot grow over the field?
#
# Read on
# -------
#
# Noll, J. Opt. Soc. Am. 66, 207 (1976): Zernike polynomials in this order. Mahajan, J. Opt. Soc. Am. 72, 1258 (1982):
# the Strehl ratio as an exponential. Born and Wolf, *Principles of Optics*, 7th ed., 5.3 (primary aberrations) and 9.3
# (tolerances). Welford, *Aberrations of Optical Systems* (Hilger 1986): thin lenses and the stop. The formula with
# :math:`q` is in Jenkins and White, *Fundamentals of Optics*, 4th ed., 9.5, for the longitudinal aberration
# :math:`4 W_{040} f^2 / a^2`.
#
# In the gallery: :doc:`/gallery/plot_psf_zernike`, :doc:`/gallery/plot_psf_astigmatism`,
# :doc:`/gallery/plot_psf_over_the_field`.
#
# Next: :doc:`plot_4_depth_and_occlusion`.
