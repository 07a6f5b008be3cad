"""
Plans in training
=================

A plan leaves out what a picture does not need, and is then frozen: training through it computes less at each step. We
measure what that saves, what it does to gradients, and how a plan says that it no longer fits.
"""

# %%
# A camera to train
# -----------------
#
# A lens that is focused at 1.3 m sees a portrait at 0.9 m. A diffractive element (DOE) of 48 x 48 pixels is to bring it
# into focus, by a loss on the finished picture.

import time
import warnings

import matplotlib.pyplot as plt
import torch

from kcam import Camera, Scene, isp, optics, plots, sensor
from kcam.planner import OutOfRange, Planner, noiseless_raw
from kcam.units import mm, nm, um

phase = torch.nn.Parameter(0.1 * torch.randn(48, 48, generator=torch.Generator().manual_seed(0)))
lens = optics.Lens(
    optics.CircularAperture(2.5 * mm), optics.ThinLens(20 * mm), optics.DOE(phase, design_wavelength=550 * nm),
    focus_distance=1.3,
)  # fmt: skip
camera = Camera(
    optics.Imaging(lens, pixel_pitch=4 * um), sensor.ColourFilter.kodak(infrared_cut=680 * nm), sensor.Mosaic("RGGB"),
    sensor.Exposure(), sensor.ShotNoise(full_well=10_000), sensor.ReadNoise(3.0), sensor.ADC(bits=12),
    isp.Demosaic(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(),
)  # fmt: skip
portrait = Scene.builtin("astronaut", size=(80, 80)).with_depth(0.9)
target = portrait.to_srgb()


def picture_of(camera, seed=0):
    """The portrait, with the noise of a seed."""
    return camera(portrait, generator=torch.Generator().manual_seed(seed))


def loss_of(picture):
    """Mean square between a picture and what a perfect camera would show."""
    return (picture - target).square().mean()


# %%
# Plans for two tolerances
# ------------------------
#
# The tolerance is about the raw signal without noise: its relative RMS error. Where autograd is on and something
# trains, the gradient is held to it too, of a loss that stands for yours: the mean square between the raw and one
# without blur. Your own loss may ask for more, so measure it once, as here. (``camera.plan(scene, tolerance=0.02)``
# makes one plan; a ``Planner`` makes several, and keeps what it tried.)

planner = Planner(camera, portrait)
plans = {tolerance: planner.plan(tolerance) for tolerance in (0.02, 0.05)}
print(plans[0.05])


def gradient_and_time(camera):
    """d loss / d phase, and CPU seconds of the step."""
    start = time.process_time()
    gradient = torch.autograd.grad(loss_of(picture_of(camera)), phase)[0]
    return gradient, time.process_time() - start


exact, seconds = gradient_and_time(camera.noiseless())
print("\ntolerance  error of the raw  error of our gradient  faster by")
for tolerance, plan in plans.items():
    planned = plan.apply(camera).noiseless()
    gradient, own_seconds = gradient_and_time(planned)
    raw_error, error = plan.measure(camera, portrait), float((gradient - exact).norm() / exact.norm())
    print(f"{tolerance:9.2f}{raw_error:18.4f}{error:23.3f}{seconds / own_seconds:11.1f}")
    assert raw_error < tolerance
    assert error < 0.3

# %%
# The raw keeps the tolerance; the gradient of our loss, which the plan does not know, need not. The last column is a
# ratio of CPU seconds on the machine that built this page.
#
# Training
# --------
#
# ``plan.apply(camera)`` is a camera that shares the parameters: the optimiser trains ``phase``, and both cameras have
# it. Nothing plans anew on the way.

plan = plans[0.05]
planned = plan.apply(camera)
with torch.no_grad():
    before = picture_of(camera)
optimiser = torch.optim.Adam([phase], lr=0.3)
losses = []
for step in range(30):
    loss = loss_of(picture_of(planned, seed=step))
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    losses.append(loss.item())
with torch.no_grad():
    after = picture_of(camera)  # all physics
full_loss = float(loss_of(after))
print(f"loss through the plan {losses[0]:.4f} to {losses[-1]:.4f}; by all physics {full_loss:.4f}")
print(f"error of the raw after 30 steps: {plan.measure(camera, portrait):.4f}")
assert full_loss < 0.6 * losses[0]

figure, axes = plt.subplots(1, 3, figsize=(9, 3.2), layout="constrained")
axes[0].plot(losses)
axes[0].axhline(full_loss, color="k", linestyle=":", label="all physics, at the end")
axes[0].set(title="Loss through the plan", xlabel="step", ylabel="mean square error", ylim=(0, None))
axes[0].legend(frameon=False, fontsize=9)
for ax, picture, title in zip(axes[1:], (before, after), ("Before", "After 30 steps"), strict=True):
    ax.imshow(plots.as_image(picture[0]))
    ax.set_title(f"{title}, all physics")
    ax.axis("off")

# %%
# Out of range
# ------------
#
# A plan is for scenes like those that it was made for. One that is nearer is blurred more, so the planned camera warns:

with warnings.catch_warnings(record=True) as caught, torch.no_grad():
    warnings.simplefilter("always")
    planned(portrait.with_depth(0.5))
print(caught[0].message)
assert caught[0].category is OutOfRange

# %%
# It is also for the parameters that it saw. Each 50 steps of training the planned camera measures the error on one
# scene. To see it leave the tolerance, we start a second run from a phase that is as random as can be. That spreads the
# light far beyond the window that was enough for the first:

with torch.no_grad():
    phase.copy_(2 * torch.pi * torch.rand(48, 48, generator=torch.Generator().manual_seed(1)))
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    for step in range(30, 50):
        loss_of(picture_of(planned, seed=step)).backward()
assert [warning.category for warning in caught] == [OutOfRange]
print(caught[0].message)

# %%
# The plan is a value and stays what it was. ``plan.renew`` makes another with the same tolerance, for the camera as it
# is now; in a training script the warning is best made an error, ``warnings.simplefilter("error", OutOfRange)``, and
# caught around the step.

renewed = plan.renew(camera, portrait)
error = renewed.measure(camera, portrait)
print(f"error of the raw with the new plan: {error:.3f}")
assert error < 0.05
print("changed:", plan.changes, "to", renewed.changes)

# %%
# A single picture
# ----------------
#
# Where there is one picture to take, ``camera(scene, tolerance=0.02)`` plans for it, uses the PSFs that the plan took,
# and forgets the plan. It is there for long pictures: where all physics takes less than about a second it is all
# physics, since planning takes time too. While gradients are recorded it is refused.

motorcycle = Scene.builtin("motorcycle", size=(240, 360))
raws, times = [], []
with torch.no_grad():
    for tolerance in (None, 0.02):
        phone = noiseless_raw(Camera.phone())  # a new one each time: an Imaging keeps its PSFs
        start = time.process_time()
        raws.append(phone(motorcycle, tolerance=tolerance))
        times.append(time.process_time() - start)
difference = float((raws[0] - raws[1]).norm() / raws[0].norm())
print(f"noiseless raws {difference:.1%} apart; faster by {times[0] / times[1]:.1f}, planning included")
assert difference < 0.02
try:
    camera(portrait, tolerance=0.02)
except ValueError as error:
    print(error)
