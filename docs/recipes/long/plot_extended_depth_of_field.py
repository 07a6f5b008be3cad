r"""
Extended depth of field: train optics and network together
==========================================================

A fast lens is sharp at one distance only. We put a diffractive element (DOE) into its aperture and a small network
behind its sensor, train both through the camera so that all from 0.5 m to infinity is sharp, and ask what an honest
comparison asks: is that better than the plain lens with a network of its own, or than stopping it down?
"""

# %%
# The lens, and how much depth it has
# -----------------------------------
#
# 6 mm at f/2, focused at 1 m, with pixels of 2 µm. In vergence :math:`V = 1/z` our range is 0 to 2 dioptres, one
# dioptre to each side of the focus. An aperture of diameter :math:`D` at a distance :math:`d` from the sensor blurs a
# point to a disc of diameter
#
# .. math:: b = D\, d\, |V - V_0| , \qquad\text{and}\qquad W = \frac{D^2}{8 \lambda} |V - V_0|
#
# is the defocus in waves.

import math
from itertools import pairwise

import matplotlib.pyplot as plt
import torch
from kornia.color import rgb_to_linear_rgb
from skimage import data
from torch import nn
from torch.nn import functional as F

from kcam import Camera, Scene, isp, optics, plots, sensor
from kcam.units import mm, nm, um

diameter, focal_length, focus, pixel_pitch = 3 * mm, 6 * mm, 1.0, 2 * um
wavelengths = torch.tensor([620, 540, 460]) * nm  # a picture's red, green and blue as three lines


def lens_of(diameter, *elements):
    """An ideal lens with an aperture, and more elements in it."""
    aperture, glass = optics.CircularAperture(diameter), optics.ThinLens(focal_length)
    return optics.Lens(aperture, glass, *elements, focus_distance=focus)


plain, stopped = lens_of(diameter), lens_of(diameter / 2)
blur = diameter * float(plain.sensor_distance) * 1.0
print(f"f/{plain.f_number:.2f}; one dioptre from the focus a point is a disc of {blur / pixel_pitch:.1f} pixels,")
print(f"and defocus is {diameter**2 / (8 * 540 * nm):.1f} waves at 540 nm")

# %%
# A DOE to start from
# -------------------
#
# A classical idea gives every ring of the aperture a focus of its own. If the ring at :math:`u = (r/R)^2` shall focus
# the vergence :math:`V_0 + 2u - 1`, equal areas serve equal parts of our range, and the phase is
#
# .. math:: \varphi(r) = -\frac{2\pi}{\lambda} \int_0^r (2u - 1)\, r' \mathrm{d}r' = \frac{\pi R^2}{\lambda} (u - u^2).
#
# ``RadialDOE`` holds a phase at equally spaced radii, here 24 numbers, and disperses it as etched fused silica does.
# Training goes on from there. A round element is cheap as well: its PSFs are Hankel transforms.

design_wavelength = 540 * nm
u = torch.linspace(0, 1, 24) ** 2
phase = nn.Parameter(math.pi * (diameter / 2) ** 2 / design_wavelength * (u - u**2))
start = phase.detach().clone()
doe = lens_of(diameter, optics.RadialDOE(phase, design_wavelength=design_wavelength))

# %%
# The camera and the network
# --------------------------
#
# The sensor has all three colours at each pixel; at f/2 white brings 2500 electrons, which are its full scale, and
# there are 3 electrons of read noise. Stopped down to f/4 the lens blurs half as much, but in the same time white
# brings a quarter of the electrons, and an amplifier makes up for that. No mosaic: what is lost here shall be lost to
# blur and noise. The network is small, a stack of 3 x 3 convolutions at half the resolution, and adds what it finds to the
# camera's picture.

electrons = 2500


def camera_of(lens):
    """Lens, noise and the sRGB curve."""
    aperture = float(lens.aperture.diameter)
    return Camera(
        optics.Imaging(lens, pixel_pitch=pixel_pitch, psf_shape=(41, 41)),
        sensor.ShotNoise(full_well=electrons * (aperture / diameter) ** 2), sensor.ReadNoise(3.0), isp.ToneCurve(),
    )  # fmt: skip


class Restoration(nn.Module):
    """A residual network for sRGB pictures (B, 3, H, W), H and W even; at first it changes nothing."""

    def __init__(self, width=32, depth=6):
        super().__init__()
        sizes = [12] + [width] * (depth - 1) + [12]
        layers = []
        for channels, following in pairwise(sizes):
            layers += [nn.Conv2d(channels, following, 3, padding=1, padding_mode="reflect"), nn.ReLU()]
        self.layers = nn.Sequential(*layers[:-1])
        nn.init.zeros_(self.layers[-1].weight)
        nn.init.zeros_(self.layers[-1].bias)

    def forward(self, picture):
        return picture + F.pixel_shuffle(self.layers(F.pixel_unshuffle(picture, 2)), 2)


# %%
# Photographs
# -----------
#
# Crops of three photographs train; the network never sees the three others on which we test. Each crop is a plane at
# a random vergence, so near and far count alike, and nobody tells the network which. A photograph's sRGB is what should
# come out again: the sRGB curve undoes ``rgb_to_linear_rgb``.

training = [
    Scene.builtin("astronaut", size=(256, 256)).to_srgb(),
    Scene.builtin("coffee", size=(256, 384)).to_srgb(),
    Scene.builtin("motorcycle", size=(256, 384)).to_srgb(),
]


def held_out(image, size):
    """A photograph of scikit-image (H, W[, 3]) as sRGB (1, 3, *size)."""
    image = torch.from_numpy(image).float().reshape(*image.shape[:2], -1) / 255
    return F.interpolate(image.permute(2, 0, 1)[None].expand(-1, 3, -1, -1), size=size, mode="area")


testing = {
    "cat": held_out(data.chelsea(), (192, 288)),
    "rocket": held_out(data.rocket(), (192, 288)),
    "cameraman": held_out(data.camera(), (192, 192)),
}


def photograph(camera, pictures, vergences, generator):
    """Noisy pictures of planes at these vergences [1/m]; the generator draws the noise."""
    scene = Scene.from_bands(rgb_to_linear_rgb(pictures), wavelengths=wavelengths, depth=1 / vergences)
    return camera(scene, generator=generator)


def random_crops(generator, count=4, side=64):
    """Crops (count, 3, side, side) of the training photographs, turned at random."""
    crops = []
    for _ in range(count):
        picture = training[torch.randint(len(training), (), generator=generator)][0]
        top, left = (int(torch.randint(size - side, (), generator=generator)) for size in picture.shape[1:])
        quarters = int(torch.randint(4, (), generator=generator))
        crops.append(picture[:, top : top + side, left : left + side].rot90(quarters, (1, 2)))
    return torch.stack(crops)


# %%
# Training
# --------
#
# The same for all three: as many steps, the same crops, distances and seeds, the mean squared error. Where the lens
# holds a parameter it trains with the network, by the same gradient.

steps = 800


def train(lens):
    """A network for this lens, and the losses; the lens's own parameters train too."""
    torch.manual_seed(0)  # of the network's weights
    generator = torch.Generator().manual_seed(0)
    camera, network = camera_of(lens), Restoration()
    groups = [{"params": list(network.parameters()), "lr": 2e-3}]
    if list(lens.parameters()):
        groups.append({"params": list(lens.parameters()), "lr": 0.1})  # radians
    optimiser = torch.optim.Adam(groups, betas=(0.9, 0.99))
    rates = [group["lr"] for group in groups]
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rates, total_steps=steps, pct_start=0.1)
    losses = []
    for _ in range(steps):
        crops, vergences = random_crops(generator), 2 * torch.rand(4, generator=generator)
        restored = network(photograph(camera, crops, vergences, generator))
        loss = (restored - crops).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        losses.append(loss.item())
    return network, losses


lenses = {"f/2": plain, "f/4": stopped, "f/2 with DOE": doe}
networks, losses = {}, {}
for name, lens in lenses.items():
    networks[name], losses[name] = train(lens)
    print(f"{name:13s} mean squared error of the last 100 steps {sum(losses[name][-100:]) / 100:.5f}")

# %%
# What the DOE has become
# -----------------------

radii = torch.linspace(0, diameter / 2, len(start)) / mm
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
left.plot(radii, start - start.mean(), "--", label="at the start")
left.plot(radii, (phase - phase.mean()).detach(), marker=".", label="trained")
left.set(title="Phase of the DOE at 540 nm", xlabel="radius [mm]", ylabel="phase [rad]")
left.legend()
for name, of_lens in losses.items():
    smooth = torch.tensor(of_lens).unfold(0, 80, 1).mean(-1)
    right.plot(torch.arange(len(smooth)) + 40, 1e3 * smooth, label=name)
right.set(title="Mean squared error, mean of 80 steps", xlabel="step", ylabel="error of sRGB [1e-3]", ylim=(0, None))
right.legend()

# %%
# The plain lens's PSF is a point at 1 m and a disc of nine pixels at both ends. With the DOE it is more alike: a narrow
# core in a veil of light, at every distance. A network can undo *one* blur, so long as no detail has fallen to zero.

distances = [math.inf, 2.0, 1.0, 0.5]
figure, axes = plt.subplots(2, 4, figsize=(9, 5.2), layout="constrained")
figure.suptitle("PSFs in red, green and blue over distance, each to its own peak, square root shown")
with torch.no_grad():
    for row, name, lens in zip(axes, ("f/2", "DOE"), (plain, doe), strict=True):
        psfs = lens.psf(wavelengths, distances=distances, pixel_pitch=pixel_pitch, shape=(25, 25))
        for ax, psf, distance in zip(row, psfs, distances, strict=True):
            ax.imshow(plots.as_image((psf / psf.max()).sqrt()), extent=(-25, 25, 25, -25), interpolation="nearest")
            ax.set_title(f"{name}, {plots.metres(distance)}")
            ax.set(xticks=(-20, 0, 20), yticks=(-20, 0, 20))
        row[0].set_ylabel("y [µm]")
for ax in axes[1]:
    ax.set_xlabel("x [µm]")

# %%
# Pictures that no training saw
# -----------------------------
#
# PSNR in sRGB at nine vergences, each with its own noise.

vergences = torch.linspace(0, 2, 9)


@torch.no_grad()
def results(lens, network, picture):
    """Pictures at all vergences: the camera's, and the network's of them."""
    generator = torch.Generator().manual_seed(1)
    taken = photograph(camera_of(lens), picture.expand(len(vergences), -1, -1, -1), vergences, generator)
    return taken, network(taken).clamp(0, 1)


def psnr(pictures, truth):
    """Peak signal to noise ratio of each picture [dB], the peak being 1."""
    return -10 * torch.log10((pictures - truth).square().mean((1, 2, 3)))


shots, scores = {}, {}
for picture_name, picture in testing.items():
    shots[picture_name] = {}
    for name, lens in lenses.items():
        taken, restored = results(lens, networks[name], picture)
        shots[picture_name] |= {f"{name}, no network": taken, name: restored}
    scores[picture_name] = {arm: psnr(pictures, picture) for arm, pictures in shots[picture_name].items()}

styles = {"f/2, no network": "C0:", "f/2": "C0-o", "f/4": "C2-o", "f/2 with DOE": "C1-o"}
figure, axes = plt.subplots(1, 3, figsize=(9, 3.8), layout="constrained")
figure.suptitle("PSNR over distance on pictures that no training saw; the focus is at 1 / m")
for ax, (picture_name, of_arm) in zip(axes, scores.items(), strict=True):
    for arm, style in styles.items():
        ax.plot(vergences, of_arm[arm], style, markersize=4, label=arm)
    ax.set(title=picture_name, xlabel="1 / distance [1/m]")
axes[0].set_ylabel("PSNR [dB]")
figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)

# %%
# At both ends, infinity and 0.5 m, the DOE with its network is ahead of the plain lens with its own. In focus it is
# behind: it spreads light on purpose, and its network has to gather it out of the noise. Mind also the dotted line: a
# network that does not know the distance costs the plain lens in focus, as it must mistrust what looks sharp.

mean = {arm: torch.stack([of_arm[arm] for of_arm in scores.values()]).mean(0) for arm in scores["cat"]}
print("mean PSNR [dB] at " + "".join(f"{v:6.2f}" for v in vergences.tolist()) + "  per metre")
for arm, values in mean.items():
    print(f"{arm:25s}" + "".join(f"{value:6.1f}" for value in values.tolist()))
for other in ("f/2", "f/4", "f/2, no network"):
    gain = mean["f/2 with DOE"] - mean[other]
    print(f"DOE against {other}: {gain[0]:+.1f} dB at infinity, {gain[4]:+.1f} at 1 m, {gain[-1]:+.1f} at 0.5 m")
gain = mean["f/2 with DOE"] - mean["f/2"]
assert min(gain[0], gain[-1]) > 0 > gain[4]  # better at both ends, and worse in focus
for picture_name, of_arm in scores.items():
    gain = of_arm["f/2 with DOE"] - of_arm["f/2"]
    print(f"against f/2, {picture_name}: {gain[0]:+.1f} dB at infinity and {gain[-1]:+.1f} dB at 0.5 m")

# %%
# The same in pictures: a part of the cameraman.

part = (..., slice(30, 126), slice(50, 146))
of_picture, truth = shots["cameraman"], testing["cameraman"]
rows = {"infinity": 0, "1 m": 4, "0.5 m": 8}
figure, axes = plt.subplots(3, 4, figsize=(9, 7.4), layout="constrained")
figure.suptitle("A part of a held-out picture at three distances, and its PSNR as a whole")
for row, (distance, index) in zip(axes, rows.items(), strict=True):
    for ax, arm in zip(row, ("f/2, no network", "f/2", "f/4", "f/2 with DOE"), strict=True):
        ax.imshow(plots.as_image(of_picture[arm][index].clamp(0, 1)[part]), interpolation="nearest")
        ax.set_title(f"{arm}\n{distance}: {scores['cameraman'][arm][index]:.1f} dB", fontsize=10)
        ax.axis("off")

# %%
# What this is, and what it is not
# --------------------------------
#
# - The gain is one over a network that *knows* the plain lens, not over a blurred picture.
# - In focus the plain lens stays better. If your scene is in focus, no DOE helps.
# - Stopping down is the rival that is often left out. What it costs is light, so it is a question of how much there is:
#   train again with more or fewer ``electrons``.
# - Training is chaotic: another seed gives another phase, and some tenths of a decibel.
# - Each colour is one spectral line here. With broad bands and a mosaic, ``Scene.from_rgb``, ``sensor.ColourFilter``,
#   ``sensor.Mosaic`` and ``isp.Demosaic`` stand in the same ``Camera``, and a step takes longer.
# - Planes at one distance train. A scene with a depth map goes through the same camera, with its occlusions.

plt.show()
