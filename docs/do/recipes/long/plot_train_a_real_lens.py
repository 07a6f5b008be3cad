r"""
Train a real lens through its picture
=====================================

A Cooke triplet with two of its six curvatures off by a tenth is blurred all over its field. We let the error of a
photograph, taken with exact rays and a PSF that varies over the picture, find the curvatures that make it sharp, while
the focal length is held.
"""

# %%
# The lens
# --------
#
# ``CompoundLens.preset`` has the triplet's prescription, of 50 mm. We scale it to 5 mm, so that its whole field fits on
# few pixels, and bend the first surface. Each radius is an ``nn.Parameter``, but the last: this one follows from the
# others.

import math

import matplotlib.pyplot as plt
import torch
from torch import nn

from kcam import Scene, optics, plots
from kcam.units import mm, nm, um

scale, focal_length = 0.1, 5 * mm


def triplet(*, first):
    """The Cooke triplet at a tenth of its size, its first curvature times a factor; all radii train but the last."""
    patent = optics.CompoundLens.preset("cooke_triplet")
    surfaces = []
    for index, surface in enumerate(patent.surfaces):
        radius = scale / surface.curvature / (first if index == 0 else 1)
        last = index == len(patent.surfaces) - 1
        surfaces.append(
            optics.Surface(
                radius=radius if last else nn.Parameter(radius),
                thickness=scale * surface.thickness,
                glass=surface.glass,
                semi_diameter=scale * surface.semi_diameter,
                stop=surface.stop,
            )
        )
    return optics.CompoundLens(*surfaces, sensor_distance=scale * patent.sensor_distance)


# %%
# Hold the focal length
# ---------------------
#
# The sensor stays where it is, so without any rule the easiest way to a smaller blur could be a lens of another focal
# length. Lens designers use a *solve*: one curvature is not free, but is what gives the lens its power. Power is linear
# in each single curvature,
#
# .. math:: \frac{1}{f} = a + b\, c_\text{last},
#
# so two evaluations give :math:`a` and :math:`b`, and the last radius is a function of all others, with a gradient.


def hold_focal_length(lens):
    """Give the last surface the curvature with which the lens has its focal length."""
    last = lens.surfaces[-1]
    plane, curved = torch.tensor([math.inf, -2 * mm], dtype=torch.float64)
    powers = []
    for last.radius in (plane, curved):
        powers.append(1 / lens.first_order().focal_length)
    last.radius = curved * (powers[1] - powers[0]) / (1 / focal_length - powers[0])
    return lens


patent = hold_focal_length(triplet(first=1.0))
bent = hold_focal_length(triplet(first=1.1255))
lens = hold_focal_length(triplet(first=1.1255))  # this one is trained
for name, one in {"patent": patent, "bent": bent}.items():
    print(f"{name:7s} f = {one.focal_length() / mm:.4f} mm, f/{one.f_number:.1f}")
assert math.isclose(bent.focal_length(), focal_length, rel_tol=1e-9)

# %%
# Spots over the field
# --------------------
#
# ``lens.spots`` sends rays of each wavelength through the lens. Their RMS distance from their centroid says how large
# a point's image is: with our pixels of 13 µm, two pixels and more.

pixel_pitch = 13 * um
wavelengths = torch.tensor([640, 550, 480], dtype=torch.float64) * nm  # red, green and blue as three lines
heights = torch.linspace(0, 0.33, 7)  # Y / D of points at infinity, up to the corners of the picture
field = torch.stack([0 * heights, heights], -1)


@torch.no_grad()
def spot_radii(lens):
    """RMS radius of all rays about their centroid, at each point of the field [m]."""
    points, weights = lens.spots(wavelengths, distances=math.inf, field=field)
    points, weights = points[:, 0].flatten(1, 2), weights[:, 0].flatten(1, 2)[..., None]
    weights = weights / weights.sum(1, keepdim=True)
    centroid = (weights * points).sum(1, keepdim=True)
    return (weights * (points - centroid) ** 2).sum((1, 2)).sqrt()


print("Y / D       " + "".join(f"{height:7.2f}" for height in heights.tolist()))
print("bent   [um] " + "".join(f"{radius / um:7.1f}" for radius in spot_radii(bent).tolist()))
print("patent [um] " + "".join(f"{radius / um:7.1f}" for radius in spot_radii(patent).tolist()))

# %%
# The picture
# -----------
#
# The scene is a photograph at infinity whose three colours are the light of three spectral lines. ``Imaging`` sees that
# the lens varies over its field and computes a PSF at every 48th pixel, distorts, darkens towards the corners, and
# blurs. The window and the places of PSFs are given, so that nothing but the lens changes the loss from step to step.

light = Scene.builtin("motorcycle", size=(144, 216)).to_srgb() ** 2.2


def photograph(lens, light):
    """The irradiance (1, 3, H, W) of a picture at infinity."""
    scene = Scene.from_bands(light, wavelengths=wavelengths, depth=math.inf)
    return optics.Imaging(lens, pixel_pitch=pixel_pitch, psf_shape=(25, 25), spacing=48)(scene)


with torch.no_grad():
    before = photograph(bent, light)
    # what we want: each point a point, and as dark towards the corners as the lens has it
    sharp = light * photograph(bent, torch.ones_like(light))


def relative_error(picture):
    """RMS of the difference to the sharp picture, relative to the RMS of that."""
    return ((picture - sharp).square().mean() / sharp.square().mean()).sqrt()


print(f"the picture of the bent lens is {relative_error(before):.1%} off")

# %%
# Training
# --------
#
# Radii from 1.8 to 44 mm are of very different use to one optimiser. A step :math:`\Delta R` bends a surface by
# :math:`\Delta c = -\Delta R / R^2`, so a learning rate that goes with :math:`R^2` bends all surfaces alike. It starts
# at 4 per metre, a hundredth of the curvatures, and falls to 0 along a cosine.

steps, rate = 30, 4.0
groups = [{"params": [radius], "lr": rate * float(radius.detach()) ** 2} for radius in lens.parameters()]
optimiser = torch.optim.Adam(groups, betas=(0.8, 0.95))
schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
losses = []
for step in range(steps):
    loss = relative_error(photograph(hold_focal_length(lens), light))
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    schedule.step()
    losses.append(loss.item())
    if step % 5 == 0 or step == steps - 1:
        print(f"step {step:2d}: {losses[-1]:.1%} off")

with torch.no_grad():
    after = photograph(hold_focal_length(lens), light)
    goal = photograph(patent, light)
assert math.isclose(lens.focal_length(), focal_length, rel_tol=1e-9)
assert relative_error(after) < 0.3 * relative_error(before)

# %%
# Before and after
# ----------------
#
# The details are of the middle and of the lower right corner, each pixel shown as it is.

pictures = {"Bent": before, "Trained": after, "Sharp": sharp}
figure, axes = plt.subplots(3, 3, figsize=(9, 8.6), layout="constrained", height_ratios=(2, 3, 3))
figure.suptitle("One photograph through the bent lens, the trained lens, and as it should be")
for column, (name, picture) in zip(axes.T, pictures.items(), strict=True):
    image = plots.as_image(picture[0].detach().clamp(0, 1) ** (1 / 2.2))
    details = image, image[54:90, 90:126], image[100:136, 172:208]
    titles = f"{name}: {relative_error(picture):.1%} off", "middle", "corner"
    for ax, detail, title in zip(column, details, titles, strict=True):
        ax.imshow(detail, interpolation="nearest")
        ax.set_title(title)
        ax.axis("off")

# %%
# The loss falls within a few steps. The spots, which nobody asked for, are smaller everywhere, and the lens still has
# its focal length.

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
left.plot([100 * loss for loss in losses])
left.axhline(100 * float(relative_error(goal)), color="tab:green", linestyle="--", label="the patent's lens")
left.set(title="Error of the picture", xlabel="step", ylabel="relative error [%]", ylim=(0, None))
left.legend()
for name, one in {"bent": bent, "trained": lens, "patent": patent}.items():
    right.plot(heights, spot_radii(one) / um, marker="o", label=name)
right.axhline(pixel_pitch / math.sqrt(6) / um, color="0.5", linestyle=":", label="a pixel, evenly filled")
right.set(title="RMS spot radius over the field", xlabel="Y / D", ylabel="radius [µm]", ylim=(0, None))
right.legend()
print(f"f = {lens.focal_length() / mm:.4f} mm; {relative_error(after):.1%} off, the patent {relative_error(goal):.1%}")
print("trained [um]" + "".join(f"{radius / um:7.1f}" for radius in spot_radii(lens).tolist()))
assert spot_radii(bent).min() > 20 * um
assert spot_radii(lens).max() < 10 * um

# %%
# In section
# ----------
#
# The same rays before and after: those of the edge of the field did not meet in a point.

for name, one in {"before": bent, "after": lens}.items():
    plt.figure(plots.section_figure(one, heights=[0.0, 0.2, 0.33], title=f"The triplet {name} training"))

# %%
# The trained lens is not the patent's, nor does it have to be: what makes a picture sharp is a sum over surfaces, and
# much of it can be traded between them. The radii, in millimetres:

print("surface " + "".join(f"{index:9d}" for index in range(1, 7)))
for name, one in {"patent": patent, "bent": bent, "trained": lens}.items():
    print(f"{name:8s}" + "".join(f"{surface.radius.item() / mm:9.3f}" for surface in one.surfaces))

# %%
# What this is for: a lens whose last errors a network, a sensor or a task decides on. Anything behind ``Imaging`` may
# take part in the loss, and thicknesses, conic constants and aspheric terms train like radii do. It is no global
# search: where rays miss a surface there is no gradient, so start from a lens that images. The same training in one
# file, with a command line, is ``examples/train_lens.py``.

plt.show()
