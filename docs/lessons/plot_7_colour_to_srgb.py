"""
7. From the sensor's colours to sRGB
====================================

What a sensor records is green and dull. This lesson develops it by hand, with three gains, a matrix and a curve,
measures how far the colours are off, and finds the reason why no camera gets all of them right.
"""

# %%
# A question
# ----------
#
# The three numbers of a sensor are not the red, green and blue of a screen. Which arithmetic takes the one to the
# other, and how right can it be?
#
# Behind the filter curve :math:`\kappa_c`, of the channel :math:`c`, light with the spectrum :math:`E` from a paint of
# reflectance :math:`R` gives
#
# .. math:: s_c = \int \kappa_c(\lambda)\, R(\lambda)\, E(\lambda)\, d\lambda
#
# The eye does the same with its own three curves (lesson 1). No camera has the eye's curves:

import matplotlib.pyplot as plt
import torch
from skimage.color import deltaE_ciede2000, xyz2lab

from kcam import Camera, Scene, isp, plots, sensor, spectral
from kcam.units import nm, wavelength_grid

wavelengths = wavelength_grid()
filters = {
    "Nikon 5100": sensor.ColourFilter.nikon(),
    "Sigma SD Merrill": sensor.ColourFilter.sigma(),
    "Kodak": sensor.ColourFilter.kodak(),
}
curves = {"the eye": spectral.observer(wavelengths).T, **{name: f.response(wavelengths) for name, f in filters.items()}}

figure, axes = plt.subplots(1, 4, figsize=(9, 2.8), layout="constrained")
figure.suptitle("Three curves each: the CIE observer, and three colour filters")
for ax, (name, three) in zip(axes, curves.items(), strict=True):
    for curve, colour in zip(three, ("tab:red", "tab:green", "tab:blue"), strict=True):
        ax.plot(wavelengths / nm, curve, color=colour)
    ax.set(title=name, xlabel="wavelength [nm]", ylim=(0, None))
axes[0].set_ylabel("response")

# %%
# White balance
# -------------
#
# First the colours of the 24 patches of the chart, and of a perfect white, in the sensor's own numbers.
# ``filter.contraction`` is the integral as a sum over bands. White has most green, so that the raw picture looks green.
# **White balance** is one gain per channel that makes white equal:
#
# .. math:: g_c = \frac{s_\mathrm{green}(\text{white})}{s_c(\text{white})}

names, own_wavelengths, own_reflectances = spectral.colour_chart()
paints = spectral.reflectances(wavelengths)  # (24, 28)
daylight = spectral.illuminant("D65", wavelengths=wavelengths)
weights = filters["Nikon 5100"].contraction(wavelengths)  # (3, 28)
white = weights @ daylight
raw = (paints * daylight) @ weights.T
gains = white[1] / white
balanced = raw * gains / white[1]  # a perfect white is 1 in each channel
print("white:", [f"{value:.3f}" for value in (white / white[1]).tolist()])
print("gains:", [f"{gain:.3f}" for gain in gains.tolist()])

# %%
# The colour matrix
# -----------------
#
# To linear sRGB it then takes one 3 x 3 matrix :math:`M`. What should come out is known for the chart: the colours that
# the eye sees in daylight, :math:`t_k`. So :math:`M` is a least squares fit, held to leave white white, and kept from
# large entries, which would multiply the noise of the sensor:
#
# .. math:: \min_M\ \frac{1}{24} \sum_{k=1}^{24} |M s_k - t_k|^2 + \epsilon^2 |M|^2
#           \quad\text{with}\quad M (1,1,1)^T = (1,1,1)^T

colours = own_reflectances @ spectral.xyz_weights(own_wavelengths, "D65") @ spectral.xyz_to_srgb_matrix().T
matrix = isp.fit_colour_matrix(balanced, colours=colours, noise=0.003)
print("colour matrix:")
for row in matrix.tolist():
    print("   ", "  ".join(f"{value:+.3f}" for value in row))
assert torch.allclose(matrix.sum(1), torch.ones(3, dtype=torch.float64))

# %%
# The entries beyond the diagonal are negative: the curves of the filter overlap more than those that a screen would
# need, and the matrix takes the overlap away. How right is it? CIEDE2000, :math:`\Delta E`, is a difference of colours
# of which 1 is just visible.

to_xyz = torch.linalg.inv(spectral.xyz_to_srgb_matrix())


def lab(linear_srgb):
    """CIELAB under D65."""
    return xyz2lab((linear_srgb @ to_xyz.T).numpy())


def delta_e(linear_srgb):
    """How far the 24 patches are from what the eye sees."""
    return deltaE_ciede2000(lab(linear_srgb), lab(colours))


for name, patches in {"raw": raw / white[1], "balanced": balanced, "with matrix": balanced @ matrix.T}.items():
    error = delta_e(patches)
    print(f"{name:12s} delta E mean {error.mean():4.1f}, largest {error.max():4.1f} ({names[error.argmax()]})")
assert delta_e(balanced @ matrix.T).mean() < 1 < 5 < delta_e(balanced).mean() < delta_e(raw / white[1]).mean()

# %%
# The stages ``isp.WhiteBalance`` and ``isp.ColourMatrix`` do exactly this: a camera hands them its filter and the light
# of the scene. The patch in the chart's picture is the patch that we have computed.

chart = Scene.builtin("colour_chart", size=150)
camera = Camera(
    filters["Nikon 5100"], sensor.Exposure(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve()
)  # no lens, no mosaic, no noise
steps = dict(camera.steps(chart))
patch = names.index("orange")
pixel = steps["ColourMatrix"][0, :, 25 * (patch // 6) + 12, 25 * (patch % 6) + 12]
by_hand = (balanced @ matrix.T)[patch]
print("orange:", [f"{value:.4f}" for value in pixel.tolist()], "by hand:", [f"{v:.4f}" for v in by_hand.tolist()])
assert torch.allclose(pixel.double(), by_hand, atol=1e-4)

shown = {"raw": steps["Exposure"], "balanced": steps["WhiteBalance"], "with matrix": steps["ColourMatrix"]}
figure, axes = plt.subplots(1, 4, figsize=(9, 2.2), layout="constrained")
figure.suptitle("The chart on its way to sRGB, each with the tone curve")
for ax, (name, linear) in zip(axes, shown.items(), strict=False):
    ax.imshow(plots.as_image(isp.tone_curve(linear)[0]))
    ax.set_title(name)
axes[3].imshow(plots.as_image(chart.to_srgb()[0]))
axes[3].set_title("the eye")
for ax in axes:
    ax.axis("off")

# %%
# Luther's condition
# ------------------
#
# What remains is not the fit's fault. Colours are right for *all* spectra exactly if the filter's curves are a mixture
# of the eye's, :math:`\kappa = T\,(\bar x, \bar y, \bar z)` with an invertible :math:`T`: then :math:`M` undoes it.
# This is **Luther's condition**. Vora and Trussell measure how nearly it holds, by the share of the eye's three
# directions, among the 28 of a spectrum, that the filter has too. We add an invented filter that meets it.

eye = spectral.xyz_weights(wavelengths, "D65").T  # (3, 28)
mixture = torch.tensor([[0.8, 0.3, 0.1], [0.2, 0.8, 0.2], [0.1, 0.3, 0.7]], dtype=torch.float64)


def developed(curves, noise=0.003):
    """Patches through three curves (3, 28), the light included: linear sRGB, and the matrix."""
    signals = paints @ curves.T / curves.sum(1)
    matrix = isp.fit_colour_matrix(signals, colours=colours, noise=noise)
    return signals @ matrix.T, matrix


def vora(curves):
    """How much of the eye's three directions three curves share, 0..1."""
    one, other = torch.linalg.qr(curves.T)[0], torch.linalg.qr(eye.T)[0]
    return float((one.T @ other).square().sum() / 3)


three = {name: colour_filter.contraction(wavelengths) * daylight for name, colour_filter in filters.items()}
for name, curves in {"a mixture of the eye's": mixture @ eye, **three}.items():
    patches, own_matrix = developed(curves)
    error, amplified = delta_e(patches), own_matrix.square().sum(1).sqrt().max()
    print(f"{name:22s}  Vora {vora(curves):.2f}", end="  ")
    print(f"delta E mean {error.mean():.1f}, largest {error.max():.1f}  noise x {amplified:.1f}")
without_guard = delta_e(developed(mixture @ eye, noise=1e-6)[0]).max()
print(f"the mixture, fitted without a guard against noise: delta E {without_guard:.2f} at most")
assert without_guard < 0.6  # what 28 bands leave of the integrals
assert vora(mixture @ eye) > 1 - 1e-9

figure, axes = plt.subplots(1, 3, figsize=(9, 3.4), sharey=True, layout="constrained")
figure.suptitle("Colours of the chart: what the eye sees (dots), and what the camera makes of it (lines' ends)")
for ax, (name, curves) in zip(axes, three.items(), strict=True):
    seen, taken = lab(colours), lab(developed(curves)[0])
    ax.plot([seen[:, 1], taken[:, 1]], [seen[:, 2], taken[:, 2]], color="0.4", lw=1.5)
    ax.scatter(seen[:, 1], seen[:, 2], c=isp.tone_curve(colours.T[:, None])[:, 0].T.numpy(), edgecolors="0.4", s=45)
    ax.set(title=name, xlabel="a*: green to red")
axes[0].set_ylabel("b*: blue to yellow")

# %%
# The last column is the largest root of the sum of squares of a row of :math:`M`: by so much the matrix multiplies
# noise. Curves that overlap cost most, such as those of the Sigma, whose silicon absorbs blue near its surface and red
# deeper, and those of the eye itself. So to meet the condition is not all that a filter is for.
#
# Where the condition fails, there are paints that the camera takes for one and the eye does not. The camera is blind to
# 25 of 28 directions of a spectrum; some of these the eye sees. Add one to a grey, and no matrix, no curve and no
# network behind the sensor can find the difference:

blind = torch.eye(28, dtype=torch.float64) - torch.linalg.pinv(three["Nikon 5100"]) @ three["Nikon 5100"]
unseen = blind @ eye[0]  # of the eye's first curve what the camera does not see
unseen = 0.15 * unseen / unseen.abs().max()
grey = paints[names.index("neutral 5 (.70 D)")]
pair = torch.stack([grey, grey + unseen])
signals = pair @ three["Nikon 5100"].T
linear = pair @ eye.T @ spectral.xyz_to_srgb_matrix().T
difference, to_the_eye = (signals[0] - signals[1]).abs().max(), deltaE_ciede2000(*lab(linear))
print(f"reflectances {pair.min():.2f} to {pair.max():.2f}: the camera's signals differ by {difference:.0e}")
print(f"to the eye they differ by delta E {to_the_eye:.1f}")
assert difference < 1e-12
assert to_the_eye > 2

# %%
# The tone curve
# --------------
#
# Files have 8 bits, and the eye sees ratios. So sRGB stores linear light :math:`x` as
#
# .. math:: v = 1.055\, x^{1 / 2.4} - 0.055, \qquad v = 12.92\, x \quad \text{below } x = 0.0031308
#
# which is near to the lightness that one perceives. Of 256 numbers the darkest hundredth of the light gets far more.

x = torch.linspace(0, 1, 1001, dtype=torch.float64)
coded = isp.tone_curve(x[None, None])[0, 0]
formula = torch.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
assert torch.allclose(coded, formula, atol=1e-6)
lightness = lab(x[:, None].expand(-1, 3))[:, 0]
print(f"a grey of 18 % is stored as {coded[180]:.3f}; its lightness L* is {lightness[180]:.1f} of 100")
print(f"numbers below 1 % of white: {255 * 0.01:.0f} without the curve, {255 * coded[10]:.0f} with it")

figure, ax = plt.subplots(figsize=(6, 3.2), layout="constrained")
ax.plot(x, coded, label="sRGB")
ax.plot(x, lightness / 100, "k:", label="lightness L* / 100")
ax.set(title="The tone curve, and the lightness that is seen", xlabel="linear light", ylabel="stored value")
ax.legend(frameon=False)

# %%
# What happens under another lamp?
# --------------------------------
#
# Gains and matrix belong to a light. With those of daylight a photograph by a light bulb is orange. A camera that knows
# the light, as kcam's does, removes it.

cup = Scene.builtin("coffee", size=150, illuminant="A")
fixed = Camera(
    filters["Nikon 5100"], sensor.Exposure(), isp.WhiteBalance(gains), isp.ColourMatrix(matrix / 0.8), isp.ToneCurve()
)  # 0.8 is the share of full scale to which Exposure brings white
figure, axes = plt.subplots(1, 3, figsize=(9, 2.6), layout="constrained")
figure.suptitle("Coffee by a light bulb, and by daylight")
pictures = {
    "balanced for daylight": fixed(cup),
    "balanced for the bulb": camera(cup),
    "by daylight": camera(Scene.builtin("coffee", size=150)),
}
for ax, (name, picture) in zip(axes, pictures.items(), strict=True):
    ax.imshow(plots.as_image(picture[0]))
    ax.set_title(name)
    ax.axis("off")

# %%
# Exercises
# ---------
#
# An assertion that fails is part of the answer.
#
# 1. Set ``noise=0.1`` where the matrix is fitted by hand. Its entries shrink, and with them the noise, but the mean
#    :math:`\Delta E` is now larger than without any matrix. At which value do you gain most? Cameras choose another
#    matrix at a high ISO for this.
# 2. Use ``sensor.ColourFilter.kodak(infrared_cut=650 * nm)``. The Kodak curves hold no filter against infrared, and
#    their red reaches into light that the eye hardly sees. The mean :math:`\Delta E` falls by a third.
# 3. Replace ``daylight`` by ``spectral.illuminant("FL11", wavelengths=wavelengths)``, a fluorescent tube. Gains bring
#    white back, but the mean :math:`\Delta E` behind the matrix nearly doubles. Where are the lines of its spectrum?
#
# Read on
# -------
#
# Luther, Z. tech. Phys. 8, 540 (1927), and Ives (1915): the condition. Vora and Trussell, J. Opt. Soc. Am. A 10, 1499
# (1993): a measure of it. Sharma, Wu and Dalal, Color Res. Appl. 30, 21 (2005): CIEDE2000. IEC 61966-2-1: sRGB. Darrodi
# et al., J. Opt. Soc. Am. A 32, 381 (2015): measured filter curves.
#
# In the gallery: :doc:`/gallery/plot_colour_filters`, :doc:`/gallery/plot_colour_illuminants`.
#
# Next: :doc:`plot_8_training`.
