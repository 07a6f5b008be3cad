"""
Measured PSFs and wavefronts
============================

A lens of which you have no prescription, but photographs of points of light, PSFs of another program, or a wavefront of
an interferometer, takes pictures in kcam too. We measure one over its field, save it, and see what is lost.
"""

# %%
# Photographs of points
# ---------------------
#
# Our unknown lens is a single piece of glass with a field of strong coma and field curvature. In the laboratory it sees
# a plate with 25 pinholes at 1 m, through four narrow colour filters one after the other. The sensor adds noise, and
# stray light adds a background.

import math
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from kcam import Camera, Scene, isp, optics, plots, sensor
from kcam.units import mm, nm, um, wavelength_grid

pixel_pitch, side, distance = 8 * um, 320, 1.0
glass = (
    optics.Surface(thickness=1 * mm, glass="N-BK7", semi_diameter=0.7 * mm, stop=True),
    optics.Surface(radius=-4.1 * mm),
)
unknown = optics.CompoundLens(*glass, focus_distance=distance)
filters = torch.tensor([420, 520, 620, 720]) * nm
pinholes = torch.arange(32, side, 64)  # rows and columns

plate = torch.zeros(1, len(filters), side, side)
plate[:, :, pinholes[:, None], pinholes] = 1
generator = torch.Generator().manual_seed(0)
plate = Scene.from_bands(plate, wavelengths=filters, depth=distance)
light = optics.Imaging(unknown, pixel_pitch=pixel_pitch)(plate)
exposed = 0.9 * light / light.amax((-2, -1), keepdim=True) + 0.02  # of the full well; each colour by itself


def frame():
    """One photograph of the plate: photons, and the noise of the read-out."""
    counted = sensor.shot_noise(exposed, full_well=20_000, generator=generator)
    return sensor.read_noise(counted, sigma_electrons=3.0, full_well=20_000, generator=generator)


photograph = torch.stack([frame() for _ in range(16)]).mean(0)[0].detach()  # (4, H, W)

# %%
# From photographs to PSFs
# ------------------------
#
# ``MeasuredPSF`` wants the energy in each pixel, relative to what passes the optics, as the light *falls* on the
# sensor. A photograph is shown upright, turned by 180 degrees to that, so we turn it back: the pixels of each PSF, and
# the positions. What else there is to do is what every photograph of a point needs: the background off, noise off where
# there is no light (a plain clamp at 0 would leave a veil of half of the noise), and one scale for all.

reach = 24  # pixels to each side of a pinhole
corner = photograph[:, :9, :9].flatten(1)  # no pinhole shines there
above = photograph - corner.mean(1)[:, None, None]
dark = torch.where(above > 3 * corner.std(1)[:, None, None], above, 0)
psfs, positions = [], []
for row in pinholes.tolist():
    for column in pinholes.tolist():
        window = dark[:, row - reach : row + reach + 1, column - reach : column + reach + 1]
        psfs.append(window.flip(-2, -1))
        positions.append([-(at - (side - 1) / 2) * pixel_pitch for at in (column, row)])  # from the middle
psfs = torch.stack(psfs)[:, None]  # (positions, distances, wavelengths, rows, columns)
middle = len(positions) // 2
psfs = psfs / psfs[middle].sum((-2, -1), keepdim=True)
print("psfs", tuple(psfs.shape))

folder = tempfile.TemporaryDirectory()
path = Path(folder.name) / "singlet.npz"
np.savez(
    path, psfs=psfs.numpy(), positions=np.array(positions), wavelengths=filters.numpy(), distances=[distance],
    pixel_pitch=pixel_pitch, focus_distance=distance,
)  # fmt: skip
measured = optics.MeasuredPSF.from_file(path)  # every array in SI units, under the argument's name
folder.cleanup()

figure, axes = plt.subplots(1, 2, figsize=(9, 4.4), layout="constrained")
shown = dark[[2, 1, 0]]  # 620, 520 and 420 nm as red, green and blue
axes[0].imshow(plots.as_image((shown / shown.max()).sqrt()))
axes[0].set(title="Photograph of the plate, square root", xlabel="x [pixels]", ylabel="y [pixels]")
shown = psfs[0, 0, [2, 1, 0]]
axes[1].imshow(plots.as_image((shown / shown.max()).sqrt()), extent=(-reach, reach, reach, -reach))
axes[1].set(title="PSF of the upper left pinhole, as light falls", xlabel="x [pixels]", ylabel="y [pixels]")

# %%
# Pictures
# --------
#
# The measured lens stands in ``Imaging`` as any other. Pixels between the pinholes share their light out among the PSFs
# around them. Since we know the unknown lens after all, we can say by how much the picture is off, and what one PSF for
# the whole picture would have cost.

centre_alone = optics.MeasuredPSF(
    psfs[middle], wavelengths=filters, distances=[distance], pixel_pitch=pixel_pitch, focus_distance=distance
)
scene = Scene.builtin("chelsea", size=(side, side), wavelengths=wavelength_grid(count=14)).with_depth(distance)
lenses = {"The lens itself": unknown, "Measured at 25 places": measured, "Measured in the middle": centre_alone}
colour_filter = sensor.ColourFilter.nikon()
developing = sensor.Exposure(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve()
figure, axes = plt.subplots(1, 3, figsize=(9, 3.4), layout="constrained")
truth = None
with torch.no_grad():
    for ax, (name, lens) in zip(axes, lenses.items(), strict=True):
        camera = Camera(optics.Imaging(lens, pixel_pitch=pixel_pitch), colour_filter, *developing)
        linear, picture = camera[:3](scene), camera(scene)
        truth = linear if lens is unknown else truth
        error = float((linear - truth).norm() / truth.norm())
        print(f"{name:24s} {error:.1%} off")
        ax.imshow(plots.as_image(picture[0, :, :160, :160]))
        ax.set_title(name)
        ax.axis("off")

# %%
# How many to measure
# -------------------
#
# Between the distances and wavelengths that were measured PSFs are interpolated linearly, in wavelength and in vergence
# (1 / distance). ``deviation`` states what that, and another pixel pitch, costs, as the L1 difference of the worst PSF,
# of its light; it leaves out one that was measured and predicts it from its neighbours. Here PSFs of an ideal lens
# stand for those of another program, and we hold the statement to the truth half-way between two distances. With three
# distances it cannot know how sharp the focus between them is; and of the places in the field it says nothing.

ideal = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(8 * mm), focus_distance=1.0)
window = {"pixel_pitch": 4 * um, "shape": (33, 33)}
bands = wavelength_grid(count=7)
counts, stated, true = (3, 5, 9, 17), [], []
for count in counts:
    distances = 1 / torch.linspace(0.5, 2.5, count, dtype=torch.float64)  # 2 m to 0.4 m, in equal steps of 1 / distance
    known = optics.MeasuredPSF(
        ideal.psf(bands, distances=distances, **window), wavelengths=bands, distances=distances, pixel_pitch=4 * um
    )
    between = 2 / (1 / distances[1:] + 1 / distances[:-1])
    exact = ideal.psf(bands, distances=between, **window)
    linear = (known.psfs[1:] + known.psfs[:-1]) / 2
    stated.append(known.deviation().between_distances)
    true.append(float(((linear - exact).abs().sum((-2, -1)) / exact.sum((-2, -1))).max()))
    print(f"{count:2d} distances: stated {stated[-1]:.2f}, true {true[-1]:.2f}")
assert all(0.3 < one / other < 3 for one, other in zip(stated[1:], true[1:], strict=True))
print(known.deviation(pixel_pitch=5 * um))

figure, ax = plt.subplots(figsize=(9, 3.4), layout="constrained")
ax.semilogx(counts, stated, "o-", label="as deviation() states it")
ax.semilogx(counts, true, "s--", label="true, half-way between two")
ax.set(title="What linear interpolation between distances costs", xlabel="distances measured, 0.4 to 2 m")
ax.set(ylabel="error of the worst PSF (L1)", xticks=counts, xticklabels=counts, ylim=(0, None))
ax.minorticks_off()
ax.legend(frameon=False)

# %%
# A wavefront
# -----------
#
# An interferometer, or another program, gives the optical path difference (OPD) over the exit pupil instead: in metres,
# on a square grid, without values (NaN) outside of the pupil. ``MeasuredPupil`` adds it to an ideal lens, and kcam
# computes the PSF at every distance and wavelength from this one map. Ours has a tenth of a wave of spherical
# aberration and of coma, RMS, in the normalisation of Zernike's polynomials, and 2 nm of noise.

wavelength, width, count = 633 * nm, 5 * mm, 96
side = (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * (2 / count)  # centres of the map's squares
x, y = side[None, :], side[:, None]
rho2 = x**2 + y**2
spherical = 5**0.5 * (6 * rho2**2 - 6 * rho2 + 1)
coma = 8**0.5 * (3 * rho2 - 2) * x
noise = 2 * nm * torch.randn(count, count, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
opd = torch.where(rho2 <= 1, 0.1 * wavelength * (spherical + coma) + noise, torch.nan)

coefficients = torch.zeros(11, dtype=torch.float64)
coefficients[[10, 7]] = 0.1 * wavelength  # Noll's Z11 and Z8
window = {"distances": 2.0, "pixel_pitch": 1 * um, "shape": (65, 65)}


def psf(*elements):
    """The PSF of a perfect 50 mm lens with something in its pupil."""
    lens = optics.Lens(optics.CircularAperture(width), optics.ThinLens(50 * mm), *elements, focus_distance=2.0)
    return lens.psf([wavelength], **window)[0, 0]


perfect, from_map = psf(), psf(optics.MeasuredPupil(opd, width=width))
from_zernikes = psf(optics.ZernikeAberration(coefficients))
print(f"map against Zernike polynomials: {float((from_map - from_zernikes).abs().sum() / from_zernikes.sum()):.1%}")
assert (from_map - from_zernikes).abs().sum() < 0.03 * from_zernikes.sum()

figure, axes = plt.subplots(1, 3, figsize=(9, 3.2), layout="constrained")
shown = axes[0].imshow((opd / nm).numpy(), extent=(-2.5, 2.5, 2.5, -2.5), cmap="RdBu", vmin=-300, vmax=300)
axes[0].set(title="Measured OPD", xlabel="x [mm]", ylabel="y [mm]")
figure.colorbar(shown, ax=axes[0], label="OPD [nm]", shrink=0.8)
for ax, image, title in zip(axes[1:], (from_map, perfect), ("Its PSF, square root", "A perfect lens"), strict=True):
    ax.imshow(image.sqrt().numpy(), extent=(-32, 32, 32, -32), cmap="gray")
    ax.set(title=title, xlabel="x [µm]")
axes[1].set_ylabel("y [µm]")

# %%
# The peak of the PSF over that of the perfect lens is the Strehl ratio. Maréchal's formula estimates it from the RMS
# :math:`\sigma` of the wavefront alone,
#
# .. math:: S \approx e^{-(2 \pi \sigma / \lambda)^2}
#
# and is a few per cent off at aberrations of this size.

sigma = float(opd[rho2 <= 1].std())
strehl = float(from_map.max() / perfect.max())
marechal = math.exp(-((2 * math.pi * sigma / wavelength) ** 2))
print(f"RMS {sigma / nm:.0f} nm; Strehl ratio {strehl:.3f}, by Marechal {marechal:.3f}")
assert abs(strehl - marechal) < 0.1

# %%
# The signs are kcam's: a longer path, a delay, is positive, and an OPD that rises towards +x moves the PSF towards +x.
# A tool that counts a wavefront *ahead* as positive has the other sign; arrays of prysm are in nanometres.
# ``MeasuredPupil.from_zemax("map.txt")`` reads OpticStudio's wavefront map, ``MeasuredPSF.from_file`` also .h5 and
# .fits files.
