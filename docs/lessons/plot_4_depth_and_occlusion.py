"""
4. Depth and occlusion
======================

A lens is in focus at one distance. This lesson computes how blur grows before and behind it, photographs a scene with a
depth map, and looks closely at the hardest place of such a picture: the edge of something near, in front of something
far.
"""

# %%
# A question
# ----------
#
# How deep is the range that looks sharp? Lesson 2 had the blur circle of a point at the distance :math:`z`. With the
# diameter :math:`D` of the aperture and the sensor at :math:`d`, it is
#
# .. math:: c(z) = D\,d\,\left|\frac{1}{z} - \frac{1}{z_\mathrm{focus}}\right|
#
# Blur is linear in :math:`1 / z`, the *vergence*, and not in :math:`z`. If a circle of :math:`c_0` passes for a point,
# sharp is what lies between
#
# .. math:: \frac{1}{z_\mathrm{near}} = \frac{1}{z_\mathrm{focus}} + \frac{c_0}{D d}, \qquad
#           \frac{1}{z_\mathrm{far}} = \frac{1}{z_\mathrm{focus}} - \frac{c_0}{D d}
#
# The far limit reaches infinity where the lens is focused at the **hyperfocal distance**,
# :math:`H = f + f^2 / N c_0`.

import math
import warnings

import matplotlib.pyplot as plt
import torch

from kcam import Scene, optics, plots
from kcam.units import mm, nm, um

wavelength, pitch = 550 * nm, 4 * um


def perfect(focal_length, f_number, focus):
    """An ideal lens; its f-number is that for infinity."""
    aperture = optics.CircularAperture(focal_length / f_number)
    return optics.Lens(aperture, optics.ThinLens(focal_length), focus_distance=focus)


def blur_circle(lens, distance):
    """Diameter of the disc by similar triangles [m]."""
    diameter = 2 * float(lens.aperture.semi_aperture())
    return diameter * lens.sensor_distance * abs(1 / distance - 1 / lens.focus_distance)


allowed = 2 * pitch  # of the blur circle: two pixels
hyperfocal = 25 * mm + (25 * mm) ** 2 / (5 * allowed)
lens = perfect(25 * mm, 5, hyperfocal)
print(f"25 mm f/5: focused at {hyperfocal:.2f} m, infinity is blurred by {blur_circle(lens, math.inf) / um:.2f} um")
print(f"and so is half that distance: {blur_circle(lens, hyperfocal / 2) / um:.2f} um")
assert math.isclose(blur_circle(lens, math.inf), allowed, rel_tol=1e-6)
assert math.isclose(blur_circle(lens, hyperfocal / 2), allowed, rel_tol=1e-6)

# %%
# Geometry says nothing about the waves. The MTF has both: here the contrast of fine stripes against their distance, for
# three apertures, with the limits :math:`z_\mathrm{near}` and :math:`z_\mathrm{far}` as dots. A small aperture sees
# deep, but its contrast is lower even in focus, as lesson 2 found.

focus, size, line = 2.0, 65, 10  # `line` periods in the window
distances = 1 / torch.linspace(1 / 1.2, 1 / 6, 41)
figure, ax = plt.subplots(figsize=(7, 3.6), layout="constrained")
for f_number in (5, 10, 20):
    lens = perfect(25 * mm, f_number, focus)
    mtf = lens.mtf([wavelength], distances=distances, pixel_pitch=pitch, shape=(size, size))
    contrast = mtf[:, 0, size // 2, size // 2 + line]
    (drawn,) = ax.plot(distances, contrast, label=f"f/{f_number}")
    change = allowed * f_number / (25 * mm * lens.sensor_distance)
    limits = [1 / (1 / focus + change), 1 / (1 / focus - change)]
    at_limits = lens.mtf([wavelength], distances=limits, pixel_pitch=pitch, shape=(size, size))
    ax.plot(limits, at_limits[:, 0, size // 2, size // 2 + line], "o", color=drawn.get_color())
    print(f"f/{f_number:<2d} sharp from {limits[0]:.2f} to {limits[1]:.2f} m")
frequency = line / (size * pitch) * mm
ax.set(title="Depth of field of 25 mm, focused at 2 m", xlabel="distance [m]", xlim=(1.2, 6))
ax.set_ylabel(f"contrast at {frequency:.0f} line pairs / mm")
ax.legend(frameon=False)

# %%
# A scene with depth
# ------------------
#
# ``Scene.builtin("motorcycle")`` has a measured distance for each pixel. ``Imaging`` cuts the depth map into layers at
# equal steps of vergence, an eighth of a wave of defocus apart, blurs each with its own PSFs, and lays them over one
# another from far to near.

motorcycle = Scene.builtin("motorcycle", size=160)


def photograph(scene, **settings):
    """What 50 mm f/10 makes of a scene, as light again."""
    lens = perfect(50 * mm, 10, settings.pop("focus", 2.3))
    imaging = optics.Imaging(lens, pixel_pitch=pitch, **settings)
    return Scene.from_bands(imaging(scene), wavelengths=scene.wavelengths)


near, far = photograph(motorcycle), photograph(motorcycle, focus=4.5)
figure, axes = plt.subplots(1, 4, figsize=(9, 2.4), layout="constrained")
figure.suptitle("One scene, two distances of focus")
for ax, (title, scene) in zip(
    axes, {"scene": motorcycle, "focus at 2.3 m": near, "at 4.5 m": far}.items(), strict=False
):
    ax.imshow(plots.as_image(scene.to_srgb()[0]))
    ax.set_title(title)
depth = axes[3].imshow(motorcycle.depth[0, 0].numpy(), cmap="viridis_r")
axes[3].set_title("depth map [m]")
figure.colorbar(depth, ax=axes, shrink=0.6, pad=0.01)
for ax in axes:
    ax.axis("off")

# %%
# How many layers are enough? The error falls fast with their number, and where given layers are few, kcam says so in a
# warning. Leave ``layers`` out for as many as this lens and this scene need.

imaging = optics.Imaging(perfect(50 * mm, 10, 2.3), pixel_pitch=pitch)
layers = imaging.depth_layers(motorcycle.depth, motorcycle.wavelengths)
print(f"by default {len(layers)} layers, from {1 / layers[-1]:.2f} to {1 / layers[0]:.2f} m")
errors = []
for given in (1, 3, 9):
    chosen = tuple((1 / torch.linspace(float(layers[0]), float(layers[-1]), given)).tolist())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that they are few is what we want to see
        coarse = photograph(motorcycle, layers=chosen).bands()
    errors.append(float((coarse - near.bands()).norm() / near.bands().norm()))
    print(f"{given} layers: error {errors[-1]:.1%}")
assert errors[0] > 4 * errors[1] > 16 * errors[2]

# %%
# The edge of something near
# --------------------------
#
# Blurring each layer and *adding* them up is not enough: near things hide far ones. Consider a card at 1 m that covers
# the left half of the view, in front of a far wall in focus. Seen from a point of the wall's image, the card covers a
# part of the aperture, and that part of the light is missing. For a disc of radius :math:`\rho = c / 2`, the covered
# share at the distance :math:`x` from the edge is the part of a disc left of a line:
#
# .. math:: \alpha(x) = \frac{1}{2} - \frac{1}{\pi}\left(u \sqrt{1 - u^2} + \arcsin u\right), \quad u = x / \rho,
#           \qquad I = \alpha\, I_\mathrm{card} + (1 - \alpha)\, I_\mathrm{wall}

lens, card_at, wall_at, size = perfect(25 * mm, 5, 4.0), 1.0, 4.0, 128
x = (torch.arange(size) + 0.5 - size / 2) * pitch
u = (x / (blur_circle(lens, card_at) / 2)).clamp(-1, 1)
covered = 0.5 - (u * (1 - u**2).sqrt() + u.asin()) / math.pi
on_card = (x < 0).expand(size, size)


def card_before(wall, card=0.0, *, occlusion=True):
    """Irradiance along the middle row, of a card of one brightness in front of a wall (columns,)."""
    bands = torch.where(on_card, torch.tensor(card), wall.expand(size, size))[None]
    depth = torch.where(on_card, card_at, wall_at)
    scene = Scene.from_bands(bands, wavelengths=torch.tensor([wavelength]), depth=depth, illuminant="E")
    return optics.Imaging(lens, pixel_pitch=pitch, occlusion=occlusion)(scene)[0, 0, size // 2]


plain = torch.ones(size)
black_card = card_before(plain)
print(f"black card before a white wall: {(black_card - (1 - covered)).abs().max():.3f} from the formula at most")
assert (black_card - (1 - covered)).abs().max() < 0.03  # diffraction softens the rim of the disc
even = card_before(plain, card=1.0)
added = card_before(plain, card=1.0, occlusion=False)
print(
    f"white before white: {even.min():.3f} to {even.max():.3f}; layers added up: {added.min():.2f} to {added.max():.2f}"
)
assert (even - 1).abs().max() < 0.02
assert added.max() > 1.3

# %%
# White in front of white stays white. Layers that are added up show a seam there: too bright beside the edge, where the
# card's blur is added to the whole wall, and too dark on it.
#
# What is a guess
# ---------------
#
# With a large aperture the lens looks *around* the edge of the card: some of its points see wall that the middle does
# not. A depth map is taken from the middle, so what stands there is not known. kcam continues the wall by its visible
# neighbours. Here we know better, as we painted the wall with stripes that go on behind the card.

stripes = torch.where((torch.arange(size) // 8) % 2 == 0, 1.0, 0.2)
seen = card_before(stripes, card=0.1)
added = card_before(stripes, card=0.1, occlusion=False)
truth = covered * 0.1 + (1 - covered) * stripes
reach = blur_circle(lens, card_at) / 2
right, behind = (x > 0), (x < 0) & (x > -reach)
print(f"right of the edge kcam is off by {(seen - truth)[right].square().mean().sqrt():.3f} RMS,")
print(f"left of it, where the wall is not known, by {(seen - truth)[behind].square().mean().sqrt():.3f}")

figure, ax = plt.subplots(figsize=(8, 3.8), layout="constrained")
ax.axvspan(-reach / um, 0, color="0.93", label="seen around the edge: a guess")
ax.plot(x / um, truth, "k", lw=1, label="all of the wall known")
ax.plot(x / um, seen, label="kcam")
ax.plot(x / um, added, ":", label="layers added up")
ax.set(title="A dark card at 1 m, blurred, before stripes at 4 m, in focus", xlabel="x on the sensor [µm]")
ax.set(ylabel="irradiance, white is 1", xlim=(-120, 160), ylim=(0, 1.6))
ax.legend(frameon=False, fontsize=9, ncols=2)

# %%
# The blur of the stripes themselves, by diffraction, is in kcam's curve and not in the formula's; that is the
# difference on the right. In the grey band kcam has an even wall where the stripes go on.
#
# The rest is physics and can be relied on: how the near edge fades, that nothing shines through it, that an even scene
# stays even. ``Imaging(occlusion=False)`` adds the layers up, and is there to measure what that would cost.
#
# Depth has a gradient
# --------------------
#
# The depth of a scene may be a tensor that requires a gradient: then how blurred a picture is tells how far away things
# are. We photograph a star at 1.7 m, forget where it stood, and let an optimiser find it from the squared error. Blur
# is even about the focus in :math:`1 / z`, so that from behind the focus it finds the *other* distance with this blur,
#
# .. math:: \frac{1}{z'} = \frac{2}{z_\mathrm{focus}} - \frac{1}{z}.
#
# One picture through a round lens cannot tell the two apart. A diffractive element that is trained for it can.

star = Scene.builtin("star", size=64, wavelengths=torch.tensor([wavelength]), illuminant="E")
imaging = optics.Imaging(perfect(25 * mm, 5, 2.0), pixel_pitch=pitch)
with torch.no_grad():
    taken = imaging(star.with_depth(1.7))


def distance_of_star(start):
    """The distance at which the star looks as it was taken, searched from `start` [m]."""
    distance = torch.tensor(start, requires_grad=True)
    optimiser = torch.optim.LBFGS([distance], max_iter=10, line_search_fn="strong_wolfe")

    def loss():
        optimiser.zero_grad()
        error = 1e3 * (imaging(star.with_depth(distance)) - taken).square().mean()
        error.backward()
        return error

    optimiser.step(loss)
    return distance.item()


twin = 1 / (2 / 2.0 - 1 / 1.7)
for start, expected in ((1.85, 1.7), (2.3, twin)):
    found = distance_of_star(start)
    print(f"from {start} m: {found:.3f} m; expected {expected:.3f} m")
    assert math.isclose(found, expected, rel_tol=2e-3)

# %%
# Exercises
# ---------
#
# 1. Set ``allowed`` to ``pitch``, one pixel. By which factor does the hyperfocal distance grow?
# 2. Move the card to 2 m, ``card_at = 2.0``. The band of the guess shrinks to a third, as the difference of the
#    vergences does. What becomes of the diffraction at its edge?
# 3. Give the lens of the last block ``optics.ZernikeAberration(torch.tensor([0, 0, 0, 0, 0, 100 * nm]))`` beside its
#    other elements: astigmatism, which blurs differently before and behind the focus. The search from 2.3 m now ends at
#    1.7 m as well, and the assertion about the twin fails.
#
# Read on
# -------
#
# Kingslake, *Optics in Photography* (SPIE 1992), chapter 5: depth of field. Ikoma et al., *Depth from Defocus with
# Learned Optics*, ICCP 2021: layers, laid over one another and normalised by what is visible. Scharstein et al., GCPR
# 2014: the depth map of the motorcycle. Potmesil and Chakravarty, SIGGRAPH 1981: the first pictures with a lens, and
# the light that leaks past edges.
#
# In the gallery: :doc:`/gallery/plot_aperture_depth_of_field`, :doc:`/gallery/plot_aperture_bokeh`,
# :doc:`/gallery/plot_depth_fence`.
#
# Next: :doc:`plot_5_mosaic_and_demosaic`.
