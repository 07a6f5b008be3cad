"""
8. Training through all of it
=============================

From glass to the finished picture each stage of a camera has a gradient. This lesson holds that gradient to finite
differences, focuses a lens by it, sees what happens where light is clipped and rounded, and lets a diffractive element
find out what is wrong with a lens from its photographs alone.
"""

# %%
# A question
# ----------
#
# Lens designers make spots small. But nobody looks at spots. Can a lens be judged, and improved, by the *picture*,
# after the mosaic, the noise, the ADC and the tone curve? A camera is a function of its parameters :math:`\theta` and
# of chance :math:`n`, so training is what it always is:
#
# .. math:: \min_\theta\ \mathbb{E}_n \left[ \ell\big(\text{picture}(\theta, n)\big) \right], \qquad
#           \theta \leftarrow \theta - \eta\, \frac{\partial \ell}{\partial \theta}
#
# In kcam an ``nn.Parameter`` trains and a plain number does not. The camera of this lesson has a lens of one piece of
# glass, with the radius of its front as the parameter; the sensor stands fixed behind it.

import math

import matplotlib.pyplot as plt
import torch
from torch import nn

from kcam import Camera, Scene, isp, optics, plots, sensor
from kcam.units import mm, nm, um, wavelength_grid


def camera_of(lens, *, rounding=True):
    """All stages of a camera, behind any lens."""
    return Camera(
        optics.Imaging(lens, pixel_pitch=4 * um), sensor.ColourFilter.nikon(), sensor.Mosaic("RGGB"),
        sensor.Exposure(), sensor.ShotNoise(full_well=10_000), sensor.ReadNoise(3.0),
        sensor.ADC(bits=12, rounding=rounding), isp.Demosaic(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(),
    )  # fmt: skip


focal_length, distance = 50 * mm, 2.0
sensor_distance = 1 / (1 / focal_length - 1 / distance)


def singlet(radius):
    """A plano-convex lens of N-BK7, 5 mm wide, before a sensor that is right for a focal length of 50 mm."""
    glass = optics.PlanoConvexLens(radius, glass="N-BK7")
    return optics.Lens(optics.CircularAperture(5 * mm), glass, sensor_distance=sensor_distance)


bands = wavelength_grid(count=14)  # half of the usual ones, to be quick
scene = Scene.builtin("coffee", size=96, wavelengths=bands).with_depth(distance)
wanted = scene.to_srgb()  # what a perfect camera would show

radius = nn.Parameter(torch.tensor(27.0 * mm))
camera = camera_of(singlet(radius))
loss = (camera(scene, generator=torch.Generator().manual_seed(0)) - wanted).square().mean()
loss.backward()
print(f"loss {loss.item():.4f}, d loss / d radius = {radius.grad:.2f} per metre")

# %%
# Is the gradient right?
# ----------------------
#
# A derivative can be checked against finite differences, :math:`(\ell(\theta + h) - \ell(\theta - h)) / 2h`, where
# the function is smooth. So take the noise at its mean, ``noiseless()``, and the ADC without its steps, in float64.

exact = nn.Parameter(torch.tensor(27.0 * mm, dtype=torch.float64))
smooth = camera_of(singlet(exact), rounding=False).noiseless()
double = scene.to(dtype=torch.float64)


def picture_loss():
    """Mean square error of the finished picture."""
    return (smooth(double) - wanted.double()).square().mean()


(gradient,) = torch.autograd.grad(picture_loss(), exact)
values, step = [], 1e-7  # 0.1 um
with torch.no_grad():
    for shift in (step, -2 * step):
        exact += shift
        values.append(picture_loss().item())
difference = (values[0] - values[1]) / (2 * step)
print(f"gradient {gradient.item():.6f}, finite difference {difference:.6f}")
assert math.isclose(gradient, difference, rel_tol=1e-6)

# %%
# Thirty steps to the focus
# -------------------------
#
# Now with everything: chance, rounding, clips. Each step is a new photograph with new noise. The formula of a thin lens
# says where it should end: :math:`R = (n - 1) f`.

optimiser = torch.optim.Adam([radius], lr=0.15 * mm)
schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 30)
path = []
for step in range(30):
    picture = camera(scene, generator=torch.Generator().manual_seed(step))
    loss = (picture - wanted).square().mean()
    path.append((radius.item() / mm, loss.item(), picture.detach()))
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    schedule.step()
    if step % 10 == 9:
        print(f"step {step + 1}: radius {radius.item() / mm:.2f} mm, loss {loss.item():.4f}")

index = optics.refractive_index("N-BK7", wavelengths=torch.tensor([550 * nm]))
formula = (index.item() - 1) * focal_length
print(f"(n - 1) f at 550 nm = {formula / mm:.2f} mm")
assert math.isclose(radius.item(), formula, rel_tol=0.01)

scanned = torch.linspace(25, 27.2, 15).tolist()
with torch.no_grad():
    errors = [camera_of(singlet(r * mm))(scene, generator=torch.Generator().manual_seed(0)) - wanted for r in scanned]
figure, axes = plt.subplots(1, 3, figsize=(9, 2.9), width_ratios=(1.4, 1, 1), layout="constrained")
figure.suptitle("Focusing by the gradient of the picture")
axes[0].plot(scanned, [error.square().mean() for error in errors], color="0.6", label="all radii")
axes[0].plot([r for r, _, _ in path], [value for _, value, _ in path], "o-", ms=3, color="tab:red", label="30 steps")
axes[0].set(xlabel="radius [mm]", ylabel="mean square error")
axes[0].legend(frameon=False)
for ax, (r, _, picture) in zip(axes[1:], (path[0], path[-1]), strict=True):
    ax.imshow(plots.as_image(picture[0]))
    ax.set_title(f"R = {r:.2f} mm", size=10)
    ax.axis("off")

# %%
# The best picture is not where green light alone is sharpest, for the other colours count too.
#
# What the gradient looks like on its way
# ---------------------------------------
#
# ``camera.steps`` gives the signal behind each stage, and autograd the gradient there. It starts as the error of the
# picture. The demosaic hands it on to the pixels that it asked for, the mosaic to the one channel in three that a pixel
# has recorded. Behind the lens it is blurred by the PSF and summed, with the slope of the PSF, to one number.

signals = []
for name, signal in camera.steps(scene, generator=torch.Generator().manual_seed(0)):
    signal.retain_grad()
    signals.append((name, signal))
(signals[-1][1] - wanted).square().mean().backward()
gradients = {name: signal.grad for name, signal in signals}
for name, value in gradients.items():
    print(f"{name:23s} {value.shape[1]} channels, gradient at {(value != 0).double().mean():4.0%} of the values")
assert math.isclose((gradients["Imaging + ColourFilter"] != 0).double().mean(), 1 / 3, abs_tol=0.01)

figure, axes = plt.subplots(1, 3, figsize=(9, 2.8), layout="constrained")
figure.suptitle("The gradient of the loss, grey is 0: at the picture, at the raw, at the light behind the filter")
for ax, name in zip(axes, ("ToneCurve", "ADC", "Imaging + ColourFilter"), strict=True):
    value = gradients[name][0, :, 8:48, 40:100]
    ax.imshow(plots.as_image(0.5 + value / (6 * value.std())))
    ax.set_title(f"behind {name}", size=10)
    ax.axis("off")

# %%
# Clips and steps
# ---------------
#
# Where a stage is a staircase or a limit, its own slope is 0, and nothing would learn. Rounding passes the gradient
# straight through, and a Poisson count passes the slope of its expectation (lesson 6). A **clip** passes what leads
# back into its range, and stops what leads further out. The worst case is an exposure that is six times too long:


def plain(signal):
    """An ADC of 8 bits as one would write it: its slope is 0."""
    return torch.round(signal.clamp(0, 1) * 255) / 255


light = torch.linspace(0.2, 0.9, 200)
learnt = {}
for name, convert in {"plain": plain, "kcam": lambda signal: sensor.quantise(signal, bits=8)}.items():
    exposure = nn.Parameter(torch.tensor(6.0))
    optimiser = torch.optim.Adam([exposure], lr=0.3)
    for _ in range(100):
        optimiser.zero_grad()
        (convert(exposure * light) - light).square().mean().backward()
        optimiser.step()
    learnt[name] = exposure.item()
    print(f"{name}: exposure 6.00 -> {learnt[name]:.2f}")
assert learnt["plain"] == 6
assert math.isclose(learnt["kcam"], 1, abs_tol=0.03)

# %%
# A corrector plate
# -----------------
#
# The Hubble telescope had a mirror of the wrong shape, and astronomers worked out from pictures of stars which optics
# would correct it. Here is a lens with astigmatism, coma and spherical aberration (lesson 3), and before it a
# diffractive element (DOE) that knows nothing of that. It learns eleven Zernike coefficients, from photographs of a cup
# of coffee. What it should find are the lens's own coefficients with the other sign: the two optical paths then cancel.

faults = torch.zeros(11)
faults[[5, 6, 10]] = torch.tensor([-0.2, 0.15, 0.1]) * 550 * nm  # Noll's Z6, Z7 and Z11 [m RMS]


def corrected(phase):
    """The camera of the faulty lens and a DOE with these coefficients [rad RMS]."""
    lens = optics.Lens(
        optics.CircularAperture(5 * mm), optics.ThinLens(focal_length), optics.ZernikeAberration(faults),
        optics.ZernikeDOE(phase, design_wavelength=550 * nm), focus_distance=distance,
    )  # fmt: skip
    return camera_of(lens)


def train(camera, phase, steps=30):
    """Adam, with new noise in each step: the losses."""
    optimiser = torch.optim.Adam([phase], lr=0.15)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    losses = []
    for step in range(steps):
        loss = (camera(scene, generator=torch.Generator().manual_seed(step)) - wanted).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        losses.append(loss.item())
    return losses


phase = nn.Parameter(torch.zeros(11))
with torch.no_grad():
    before = corrected(phase)(scene, generator=torch.Generator().manual_seed(0))
losses = train(corrected(phase), phase)
with torch.no_grad():
    after = corrected(phase)(scene, generator=torch.Generator().manual_seed(0))
found, waves = phase.detach() / (2 * math.pi), faults / (550 * nm)
print(f"PSNR {-10 * math.log10(losses[0]):.1f} -> {-10 * math.log10(losses[-1]):.1f} dB")
rest = (found + waves)[1:].norm()  # the first, piston, is no aberration
print(f"wavefront {waves.norm():.3f} -> {rest:.3f} waves RMS; Marechal's limit is 1 / 14 = {1 / 14:.3f}")
assert rest < 1 / 14

figure, axes = plt.subplots(1, 3, figsize=(9, 2.9), width_ratios=(1.4, 1, 1), layout="constrained")
figure.suptitle("What the DOE has learnt of the lens, and the pictures before and after")
axes[0].bar(range(1, 12), (-waves).tolist(), color="0.8", label="lens, sign changed")
axes[0].plot(range(1, 12), found, "o", color="tab:blue", label="DOE")
axes[0].set(xlabel="Zernike polynomial, Noll's number", ylabel="waves RMS")
axes[0].legend(frameon=False, fontsize=9)
for ax, name, picture in zip(axes[1:], ("before", "after"), (before, after), strict=True):
    ax.imshow(plots.as_image(picture[0]))
    ax.set_title(name, size=10)
    ax.axis("off")

# %%
# Training through a plan
# -----------------------
#
# Most of the time of a step goes into PSFs at 14 wavelengths. Does it have to? A **plan** finds out, for a camera, a
# scene and a tolerance, what may be left out. While something trains, the gradient is held to the tolerance too, and a
# plan that the training outgrows warns.

fresh = nn.Parameter(torch.zeros(11))
whole = corrected(fresh)
plan = whole.plan(scene, tolerance=0.1)
planned = plan.apply(whole)  # shares the parameters
pair = [
    torch.autograd.grad((c(scene, generator=torch.Generator().manual_seed(0)) - wanted).square().mean(), fresh)[0]
    for c in (whole, planned)
]
cosine = torch.cosine_similarity(*pair, dim=0)
print(plan.summary().replace("; ", ";\n  "))
print(f"error of the raw {plan.measure(whole, scene):.3f}; cosine of the two gradients {cosine:.3f}")
assert plan.measure(whole, scene) <= 0.1
assert cosine > 0.95
train(planned, fresh)
rest = (fresh.detach() / (2 * math.pi) + waves)[1:].norm()
print(f"trained through the plan: {rest:.3f} waves RMS are left")
assert rest < 1 / 14

# %%
# Exercises
# ---------
#
# 1. Start the radius at ``25.0 * mm``: the slope leads back from the other side. Then at ``22.0 * mm``: it still does,
#    but thirty steps of this size end on the way. Which learning rate would do, and what does it cost near the focus?
# 2. In ``camera_of`` write ``sensor.Exposure(iso=6400)``. A picture is then hardly better than 19 dB, and yet the plate
#    learns nearly as well. Why is the mean over many noisy gradients enough?
# 3. Replace ``optics.ZernikeDOE(phase, ...)`` by a map of pixels, ``optics.DOE(phase)``, with the first ``phase`` of
#    ``0.1 * torch.randn(64, 64)``. That is 4096 parameters instead of 11, the PSNR comes as far, and a step takes not
#    much longer: reverse mode does not count parameters. (What compares coefficients then has to go.)
#
# Read on
# -------
#
# Sitzmann et al., *End-to-end Optimization of Optics and Image Processing*, ACM Trans. Graphics 37, 114 (2018). Bengio,
# Leonard and Courville, arXiv 1308.3432 (2013): straight-through gradients. Noll, J. Opt. Soc. Am. 66, 207 (1976):
# Zernike polynomials. Mahajan, J. Opt. Soc. Am. 73, 860 (1983): Marechal's limit.
#
# In the gallery: :doc:`/gallery/plot_doe_letter`, :doc:`/gallery/plot_doe_cubic`,
# :doc:`/gallery/plot_style_paintings`.
#
# This was the last lesson. ``examples/train_doe.py`` and ``examples/train_lens.py`` train a DOE for depth of field and
# a triplet over its field; ``kcam train`` teaches a whole camera a style.
