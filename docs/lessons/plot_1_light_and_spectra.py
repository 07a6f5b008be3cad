"""
1. Light and spectra
====================

What arrives at a camera is not colour but a spectrum from every direction. This lesson makes spectra from lamps and
paints, reduces them to the three numbers of a photograph, and measures what those three numbers have lost.
"""

# %%
# A question
# ----------
#
# A photograph has three numbers in each pixel. Is that enough to simulate a *camera* that looks at the same scene?
# A lens bends blue light more than red, and a colour filter weighs wavelengths as no eye does. Both act on the light
# itself, so a simulated camera has to start there.
#
# The light that comes from a point of the scene in a direction, at a wavelength, is the **spectral radiance**
# :math:`L(\lambda)`, in :math:`\mathrm{W\,m^{-2}\,sr^{-1}\,nm^{-1}}`. A matt paint with the reflectance
# :math:`R(\lambda)`, between 0 and 1, under a lamp with the spectral irradiance :math:`E(\lambda)` sends out
#
# .. math:: L(\lambda) = \frac{R(\lambda)\, E(\lambda)}{\pi}
#
# in all directions. kcam keeps the factor :math:`1 / \pi` and the absolute scale out of the spectra: light is
# relative to what a perfect white, :math:`R = 1`, sends out, and one number says how bright that white is.

import matplotlib.pyplot as plt
import numpy as np
import torch
from skimage.color import deltaE_ciede2000, xyz2lab

from kcam import Scene, plots, spectral
from kcam.units import nm, wavelength_grid

wavelengths = wavelength_grid()  # in metres; every scene has these bands unless told otherwise
print(f"{len(wavelengths)} bands from {wavelengths[0] / nm:.0f} to {wavelengths[-1] / nm:.0f} nm")

# %%
# Lamps and paints
# ----------------
#
# ``spectral.illuminant`` has CIE's lamps by name. ``spectral.reflectances`` has the 24 patches of the colour chart that
# photographers use. The product of the two is what a camera sees.

chart_names, _, _ = spectral.colour_chart()
paints = spectral.reflectances(wavelengths)  # (24, 28)
lamps = {"D65": "daylight, D65", "A": "light bulb, A", "FL11": "fluorescent tube, FL11"}
light = {lamp: spectral.illuminant(lamp, wavelengths=wavelengths) for lamp in lamps}
shown = {"blue": "tab:blue", "green": "tab:green", "red": "tab:red", "yellow": "goldenrod"}

figure, axes = plt.subplots(1, 3, figsize=(9, 3.4), sharex=True, layout="constrained")
for lamp, name in lamps.items():
    axes[0].plot(wavelengths / nm, light[lamp], label=name)
for paint, colour in shown.items():
    reflectance = paints[chart_names.index(paint)]
    axes[1].plot(wavelengths / nm, reflectance, color=colour, label=paint)
    axes[2].plot(wavelengths / nm, reflectance * light["A"], color=colour)
titles = ("Light on a white", "Reflectance of paints", "Radiance: paint times light bulb")
for ax, title in zip(axes, titles, strict=True):
    ax.set(title=title, xlabel="wavelength [nm]", ylim=(0, None))
axes[0].set(ylabel="relative to Y = 1", ylim=(0, 5))  # room for the names
for ax in axes[:2]:
    ax.legend(fontsize=9, frameon=False)

# %%
# From a spectrum to a colour
# ---------------------------
#
# The eye has three kinds of cones, so it too makes three numbers of a spectrum. The CIE 1931 standard observer states
# them as integrals over three curves:
#
# .. math:: X = \int L(\lambda)\,\bar x(\lambda)\,d\lambda, \quad Y = \int L\,\bar y\,d\lambda, \quad
#           Z = \int L\,\bar z\,d\lambda
#
# With bands an integral is a sum, and the whole observer is one matrix, ``spectral.xyz_weights``. Its scale is such
# that the white has :math:`Y = 1`. The colours of the lamps themselves are published, as chromaticities
# :math:`x = X / (X + Y + Z)` and :math:`y`, so we can check.

published = {"D65": (0.3127, 0.3290), "A": (0.4476, 0.4074), "FL11": (0.3805, 0.3769)}  # CIE 15
for lamp, expected in published.items():
    white = light[lamp] @ spectral.xyz_weights(wavelengths)
    x, y = (white[:2] / white.sum()).tolist()
    print(f"{lamps[lamp]:24s} x = {x:.4f}  y = {y:.4f}  Y = {white[1]:.6f}")
    assert abs(white[1] - 1) < 1e-9
    assert np.allclose((x, y), expected, atol=3e-4)

# %%
# A Scene
# -------
#
# A ``Scene`` is spectral radiance for each pixel, with a depth, a lamp and the luminance of its white. The chart is
# stored as 24 planes times 24 spectra, which are 28 bands only where somebody asks for them. ``to_srgb`` is the picture
# that an eye behind no lens would see; it does not adapt to the lamp, as yours does in a room.

charts = {lamp: Scene.builtin("colour_chart", size=150, illuminant=lamp) for lamp in lamps}
print(charts["D65"], tuple(charts["D65"].bands().shape))

figure, axes = plt.subplots(1, 3, figsize=(9, 2.6), layout="constrained")
figure.suptitle("One chart, three lamps: the paints are the same")
for ax, (lamp, scene) in zip(axes, charts.items(), strict=True):
    ax.imshow(plots.as_image(scene.to_srgb()[0]))
    ax.set_title(lamps[lamp])
    ax.axis("off")

# %%
# The second number of XYZ, times ``scene.luminance``, is photometric: the luminance in :math:`\mathrm{cd/m^2}`. The
# scene's pixel and the sum over the paint's spectrum agree, to the rounding of float32 in which pictures are kept.

gray = chart_names.index("neutral 5 (.70 D)")
row, column = divmod(gray, 6)
scene = charts["D65"]
luminance = scene.luminance * float(scene.xyz()[0, 1, 25 * row + 12, 25 * column + 12])  # patches have 25 pixels
expected = scene.luminance * float((paints[gray] * light["D65"]) @ spectral.xyz_weights(wavelengths)[:, 1])
print(f"neutral 5: {luminance:.1f} cd/m^2; from its spectrum {expected:.1f}")
assert abs(luminance / expected - 1) < 1e-5

# %%
# What a photograph lacks
# -----------------------
#
# Three sums of 28 bands leave 25 directions in which a spectrum can change and nobody sees it. Cohen called them
# *metameric blacks*. The part of a spectrum that the eye does see is its projection onto the three weighting curves,
# which linear algebra gives:

weights = spectral.xyz_weights(wavelengths, "D65")  # (28, 3): from a reflectance under D65 to XYZ
seen = weights @ torch.linalg.pinv(weights)  # projects a reflectance onto what is seen of it
unseen = torch.eye(len(wavelengths), dtype=torch.float64) - seen
print(f"directions seen: {torch.trace(seen):.0f}; unseen: {torch.trace(unseen):.0f}")
black = paints[chart_names.index("red")] @ unseen
print(f"XYZ of a black with values up to {black.abs().max():.2f}: {(black @ weights).abs().max():.0e}")
assert (black @ weights).abs().max() < 1e-12

# %%
# So a spectrum that belongs to three numbers is a *choice*. Mallett and Yuksel chose three smooth reflectances, one for
# each primary of sRGB, that stay between 0 and 1 and add up to 1; a colour mixes them:
#
# .. math:: R(\lambda) = r\,B_r(\lambda) + g\,B_g(\lambda) + b\,B_b(\lambda), \qquad B_r + B_g + B_b = 1
#
# ``Scene.from_rgb`` and ``Scene.from_file`` do this for photographs. The way back is exact: these spectra have the
# colours of the photograph under D65. Let us give it the colours of the chart and compare with the paints.

basis = spectral.rgb_basis(wavelengths)  # (3, 28)
to_rgb = weights @ spectral.xyz_to_srgb_matrix().T  # (28, 3): from a reflectance under D65 to linear sRGB
assert basis.min() >= 0
assert torch.allclose(basis.sum(0), torch.ones_like(wavelengths))
assert torch.allclose(basis @ to_rgb, torch.eye(3, dtype=torch.float64), atol=1e-9)

rgb = paints @ to_rgb
outside = [name for name, colour in zip(chart_names, rgb, strict=True) if colour.min() < 0]
guess = rgb.clamp(min=0) @ basis
error = (guess - paints).square().mean(1).sqrt()
print(f"outside sRGB: {', '.join(outside)}")
worst = chart_names[error.argmax()]
print(f"RMS error of the guessed reflectance: median {error.median():.2f}, largest {error.max():.2f} ({worst})")

figure, axes = plt.subplots(1, 4, figsize=(9, 3), sharey=True, layout="constrained")
figure.suptitle("Reflectance: measured (lines) and guessed from sRGB (dashes)")
for ax, (paint, colour) in zip(axes, shown.items(), strict=True):
    index = chart_names.index(paint)
    ax.plot(wavelengths / nm, paints[index], color=colour)
    ax.plot(wavelengths / nm, guess[index], "--", color=colour)
    ax.set(title=paint, xlabel="wavelength [nm]", ylim=(0, 1))
axes[0].set_ylabel("reflectance")

# %%
# Two paints of one colour
# ------------------------
#
# The measured spectrum and its guess are a **metameric pair**: the same colour in daylight, two colours elsewhere. How
# different they look is the colour difference CIEDE2000, where 1 is about what one can just see.


def lab(reflectances, lamp):
    """CIELAB of reflectances under a lamp, for an eye that has adapted to it."""
    weights = spectral.xyz_weights(wavelengths, lamp)
    adapted = reflectances @ weights / weights.sum(0) * torch.tensor([0.95047, 1.0, 1.08883])  # xyz2lab's own D65
    return xyz2lab(adapted.numpy())


inside = [index for index, name in enumerate(chart_names) if name not in outside]
for lamp, name in lamps.items():
    difference = deltaE_ciede2000(lab(paints[inside], lamp), lab(guess[inside], lamp))
    print(f"{name:24s} mean {difference.mean():.2f}, largest {difference.max():.2f}")
    if lamp == "D65":
        assert difference.max() < 1e-6  # the same colour
    else:
        assert difference.max() > 2  # another one, for somebody who looks

# %%
# Behind a lens it is no different. What the guess says about 450 nm, and so about the blue fringe of a lens, is
# plausible but not measured. Where spectra matter, take a scene that has them: ``Scene.from_bands`` with a cube from a
# hyperspectral camera.

# %%
# Exercises
# ---------
#
# 1. Replace ``"FL11"`` by ``"HP1"``, a sodium street lamp, in ``lamps`` and in ``published`` (its chromaticity is
#    0.533, 0.415), and print ``lab(paints, "HP1")[13:15]`` beside ``lab(paints, "D65")[13:15]``: the patches "green"
#    and "red", whose second number runs from green to red. Where has most of the difference gone?
# 2. Add some of the black to the red paint, ``paints[14] + 0.3 * black``, and plot both. Print ``lab(...)`` of the two
#    under ``"D65"``, where they are equal, and under ``"A"``.
# 3. Print ``spectral.rgb_error(wavelength_grid(count=n))`` for n from 6 to 14: by how much colours of sRGB come back
#    changed. How many even bands carry them all?
#
# Read on
# -------
#
# Wyszecki and Stiles, *Color Science*, 2nd ed. (Wiley 1982), chapter 3: colorimetry and metamerism. Cohen and Kappauf,
# Am. J. Psychol. 95, 537 (1982): metameric blacks. Mallett and Yuksel, *Spectral Primary Decomposition for Rendering
# with sRGB Reflectance*, EGSR 2019. CIE 15, *Colorimetry*: the observer and the lamps.
#
# In the gallery: :doc:`/gallery/plot_colour_chart_spectra`, :doc:`/gallery/plot_colour_illuminants`.
#
# Next: :doc:`plot_2_one_lens`, in which this light is focused, and colours part.
