r"""
Reconstruct: the camera as an operator
======================================

``A = camera.linear(scene)`` is a camera's linear part, with its exact transpose: all that a method of image
reconstruction asks for. We test it, and sharpen a photograph that is out of focus by Wiener's filter and by total
variation.
"""

# %%
# What the operator is
# --------------------
#
# From light to the raw signal a camera is linear, but for noise, limits and steps:
#
# .. math:: y = A x + \text{offset} + \text{noise}
#
# :math:`x` are a scene's coefficient planes, here three of linear sRGB; :math:`A` is blur, filter, mosaic and gain; the
# offset is black level and dark current. Depth, spectra and size are those of the scene that the operator is made for.

import math

import matplotlib.pyplot as plt
import torch
from torch.nn.functional import pad

from kcam import Camera, Scene, isp, optics, plots, sensor
from kcam.units import mm, nm, um

full_well, read_noise = 10_000, 3.0  # electrons


def singlet(focus_distance):
    """50 mm f/10 of one piece of glass, with a sensor of 4 µm pixels."""
    glass = optics.PlanoConvexLens(25.8 * mm, glass="N-BK7")
    lens = optics.Lens(optics.CircularAperture(5 * mm), glass, focus_distance=focus_distance)
    return Camera(
        optics.Imaging(lens, pixel_pitch=4 * um), sensor.ColourFilter.kodak(infrared_cut=680 * nm),
        sensor.Mosaic("RGGB"), sensor.Exposure(), sensor.ShotNoise(full_well=full_well), sensor.ReadNoise(read_noise),
        sensor.ADC(bits=12, black_level=64), isp.Demosaic(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(),
    )  # fmt: skip


camera = singlet(focus_distance=1.7)  # what stands at 2 m, as our scenes do, is out of focus
scene = Scene.builtin("astronaut", size=160)
A = camera.linear(scene)
x = A.light  # of this scene, (1, 3, H, W)
y = camera.raw(scene, generator=torch.Generator().manual_seed(0)) - A.offset
recorded = A.record(A(x), generator=torch.Generator().manual_seed(0))
print(A)
print(f"offset {A.offset.max():.4f} of full scale, norm {A.norm():.3f}")
print(f"camera.raw(scene) - A.offset and A.record(A(x)) differ by {(y - recorded).abs().max():.0e}")
assert torch.allclose(A.offset, torch.tensor(64 / 4095))
assert torch.allclose(y, recorded, atol=1 / 4095)  # a step of the ADC

# %%
# The dot-product test
# --------------------
#
# ``A.adjoint`` is the transpose: :math:`\langle A u, v \rangle = \langle u, A^T v \rangle` for every light :math:`u`
# and every raw :math:`v`, of any sign. What is left is rounding, so in double precision the test is sharp.

exact = camera.linear(scene.to(dtype=torch.float64))
generator = torch.Generator().manual_seed(1)
u = torch.randn(exact.scene_shape, generator=generator, dtype=torch.float64)
v = torch.randn(exact.raw_shape, generator=generator, dtype=torch.float64)
left, right = (exact(u) * v).sum(), (u * exact.adjoint(v)).sum()
print(f"<A u, v> = {left:.12f}\n<u, A'v> = {right:.12f}")
assert abs(left - right) < 1e-9 * abs(left)

# %%
# A column of :math:`A` is what one point of light does to the raw: its PSF, seen through the mosaic. A row is from
# where one pixel gets its light, and in what colours; the adjoint of a raw with one bright pixel shows it.

middle = scene.shape[1] // 2
point = torch.zeros_like(x)
point[:, :, middle, middle] = 1  # white
pixel = torch.zeros_like(y)
pixel[:, :, middle, middle] = 1  # a red one, of an RGGB mosaic
column, row = A(point)[0], A.adjoint(pixel)[0]
figure, axes = plt.subplots(1, 2, figsize=(9, 4.3), layout="constrained")
figure.suptitle("A column and a row of the operator, square root shown")
box = (-12.5, 12.5, 12.5, -12.5)
near = slice(middle - 12, middle + 13)
titles = "A of one white point: a raw signal", "The adjoint of one red pixel: light"
for ax, title, planes in zip(axes, titles, (column, row), strict=True):
    shown = planes[:, near, near].clamp(min=0)
    ax.imshow(plots.as_image((shown / shown.max()).sqrt().expand(3, -1, -1)), extent=box, interpolation="nearest")
    ax.set(title=title, xlabel="x [pixels]", ylabel="y [pixels]")

# %%
# Wiener's filter
# ---------------
#
# Light with a period is blurred by a product at each spatial frequency, so the least mean square error has a closed
# form. :math:`H` are the 3 x 3 transfer functions from planes of light to channels, :math:`N` and :math:`S` the power
# spectra of noise and of pictures, the latter falling as :math:`1 / f^2`:
#
# .. math:: X = (H^\dagger H + N / S)^{-1} H^\dagger Y
#
# This asks for one PSF over the whole picture and for a sensor without a mosaic, so it starts from the demosaiced raw.
# kcam's scenes go on beyond their border as in a mirror: they have a period of 2 n - 2 pixels.


def wiener(channels, A, *, noise):
    """Light (1,3,H,W) from three full channels; noise: its standard deviation. A is without a mosaic."""
    height, width = channels.shape[-2:]
    around = (0, width - 2, 0, height - 2)
    points = torch.zeros(3, 3, height, width)
    points[range(3), range(3), height // 2, width // 2] = 1  # one in each plane
    psfs = pad(A(points), around).roll((-(height // 2), -(width // 2)), (-2, -1))
    H = torch.fft.rfft2(psfs).permute(2, 3, 1, 0)  # (frequencies, channel, plane)
    Y = torch.fft.rfft2(pad(channels, around, mode="reflect")).permute(2, 3, 1, 0)
    rows, columns = psfs.shape[-2:]
    f2 = torch.fft.fftfreq(rows)[:, None] ** 2 + torch.fft.rfftfreq(columns) ** 2 + 1e-4
    signal = channels.var() / (f2 * (1 / f2).mean())
    normal = H.mH @ H + (noise**2 / signal)[..., None, None] * torch.eye(3)
    X = torch.linalg.solve(normal, H.mH @ Y).permute(3, 2, 0, 1)
    return torch.fft.irfft2(X, s=(rows, columns))[..., :height, :width].clamp(min=0)


# %%
# Total variation
# ---------------
#
# .. math:: \min_{x \ge 0} \ \tfrac12 \, \| A x - y \|^2 + w \, \| \nabla x \|
#
# Pictures are mostly smooth, with few edges. This takes the raw as it is, mosaic and all, and knows no Fourier
# transform: depth, or a lens whose PSF varies over the field, would be no different. The algorithm is the first of
# Chambolle and Pock (2011), which asks for ``A``, ``A.adjoint`` and ``A.norm``. We start it from Wiener's light.


def gradient(x):
    """Differences to the next pixel below and to the right, (2, *x.shape)."""
    return torch.stack([pad(x.diff(dim=-2), (0, 0, 0, 1)), pad(x.diff(dim=-1), (0, 1))])


def gradient_transposed(g):
    down, across = g[0, ..., :-1, :], g[1, ..., :-1]
    return pad(down, (0, 0, 1, 0)) - pad(down, (0, 0, 0, 1)) + pad(across, (1, 0)) - pad(across, (0, 1))


def total_variation(y, A, *, start, weight, steps=100, ratio=10.0):
    """Light (1,3,H,W) from a raw less its offset. ratio: of the steps in light and in the dual; any converges."""
    x = ahead = start
    p, q = torch.zeros_like(y), torch.zeros_like(gradient(x))  # duals of the raw and of the gradient
    length = math.sqrt(1.02 * A.norm() ** 2 + 8)  # of A and gradient together; the norm is found from below
    rise, fall = 1 / (ratio * length), ratio / length
    for _ in range(steps):
        p = (p + rise * (A(ahead) - y)) / (1 + rise)
        q = q + rise * gradient(ahead)
        q = q / (q.square().sum((0, 2), keepdim=True).sqrt() / weight).clamp(min=1)  # planes share their edges
        before, x = x, (x - fall * (A.adjoint(p) + gradient_transposed(q))).clamp(min=0)
        ahead = 2 * x - before
    return x


# %%
# Constants, from another scene
# -----------------------------
#
# Each method has one number that no formula gives: how much noise a demosaic adds, and how much edges cost. To choose
# them by the result that we report would be cheating, so a cup of coffee decides, and the astronaut judges.


def sigma(y):
    """Standard deviation of the noise at the raw's mean: photons and read-out."""
    return math.sqrt(float(y.mean()) / full_well + (read_noise / full_well) ** 2)


def by_wiener(y, scene, *, factor):
    full = Camera(*(stage for stage in camera if not isinstance(stage, sensor.Mosaic))).linear(scene)
    return wiener(isp.demosaic(y, pattern="RGGB"), full, noise=factor * sigma(y))


def psnr(picture, scene):
    return float(-10 * (picture - scene.to_srgb()).square().mean().log10())


cup = Scene.builtin("coffee", size=160)
B = camera.linear(cup)
z = camera.raw(cup, generator=torch.Generator().manual_seed(2)) - B.offset

found = {factor: psnr(B.scene(by_wiener(z, cup, factor=factor)).to_srgb(), cup) for factor in (1, 2, 3, 5, 8)}
factor = max(found, key=found.get)
print("Wiener: noise in sigmas:", ", ".join(f"{key} ({value:.2f} dB)" for key, value in found.items()), "->", factor)

start, found = by_wiener(z, cup, factor=factor), {}
for relative in (10, 100, 1000):
    light = total_variation(z, B, start=start, weight=relative * sigma(z) ** 2)
    found[relative] = psnr(B.scene(light).to_srgb(), cup)
relative = max(found, key=found.get)
print("Total variation: weight in sigmas^2:", ", ".join(f"{k} ({v:.2f} dB)" for k, v in found.items()), "->", relative)

# %%
# The result
# ----------
#
# ``camera[7:]`` develops the raw as the camera does. ``A.scene(x)`` makes a scene of light, and ``to_srgb`` shows it.
# For comparison we also take the picture by the same camera in focus. A single piece of glass has one focus for each
# colour, so even that picture is soft: the reconstructions, which know the PSF of every colour, pass it.

smooth = by_wiener(y, scene, factor=factor)
sharp = total_variation(y, A, start=smooth, weight=relative * sigma(y) ** 2)
pictures = {
    "The camera's": camera[7:](y + A.offset),
    "Wiener": A.scene(smooth).to_srgb(),
    "Total variation": A.scene(sharp).to_srgb(),
    "In focus": singlet(focus_distance=2.0)(scene, generator=torch.Generator().manual_seed(0)),
}
decibels = {name: psnr(picture, scene) for name, picture in pictures.items()}
for name, value in decibels.items():
    print(f"{name:16s} {value:5.2f} dB")
assert decibels["The camera's"] < decibels["In focus"] < decibels["Wiener"] < decibels["Total variation"]

shown = {**pictures, "In focus": scene.to_srgb()}
names = [f"{name}\n{decibels[name]:.1f} dB" for name in list(pictures)[:3]] + ["The scene\n"]
detail = slice(10, 70), slice(50, 110)
figure, axes = plt.subplots(2, 4, figsize=(9, 5.3), layout="constrained")
figure.suptitle("A singlet out of focus, sharpened from its raw; below, a detail")
for above, below, name, picture in zip(*axes, names, shown.values(), strict=True):
    image = plots.as_image(picture[0])
    above.imshow(image)
    above.set_title(name)
    below.imshow(image[detail])
    for ax in (above, below):
        ax.axis("off")

# %%
# This is the friendly case: the operator that sharpens is the one that blurred. With a lens of glass on your desk,
# measure its PSFs first (see the recipe on measured PSFs).
#
# With deepinv
# ------------
#
# `deepinv <https://deepinv.github.io>`_ has many more priors and algorithms, learned ones too. ``A.physics()`` is the
# same operator as one of its ``LinearPhysics``, with the sensor's own noise. It is an extra, ``pip install
# kcam[deepinv]``, and needs the torchvision that was built for your torch. It is not run on this page, since the
# machine that builds it has no such torchvision.
#
# .. code-block:: python
#
#     import deepinv as dinv
#
#     physics = A.physics()
#     y = physics(x)  # a raw less its offset, with noise
#     model = dinv.optim.FISTA(
#         data_fidelity=dinv.optim.L2(), prior=dinv.optim.TVPrior(), lambda_reg=100 * sigma(y) ** 2,
#         stepsize=1 / A.norm() ** 2, max_iter=100,
#     )
#     picture = A.scene(model(y, physics)).to_srgb()
#
# ``examples/reconstruct.py`` does what this page does from the command line.
