"""The textbook computations of the library against those of the benchmarks, and both converge on the same PSF."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from scipy.fft import next_fast_len

from benchmarks.baselines import angular_spectrum_psf, doe_scale, textbook_psf_bank
from kcam import optics
from kcam.optics.elements.materials import refractive_index
from kcam.optics.propagation.table import choose
from kcam.optics.propagation.textbook import (
    textbook_angular_spectrum,
    textbook_angular_spectrum_row,
    textbook_psf,
    textbook_row,
)
from kcam.units import mm, nm, um

DOUBLE = torch.float64
WAVELENGTHS = [450 * nm, 650 * nm]


def lens(*others: optics.Element, diameter: float = 2 * mm) -> optics.Lens:
    sphere = optics.PlanoConvexLens(radius_of_curvature=25.8 * mm, glass="N-BK7")
    return optics.Lens(optics.CircularAperture(diameter), sphere, *others, focus_distance=2.0)


def query(own: optics.Lens, *, shape: tuple[int, int] = (21, 17), distances: float | list[float] = 2.0, **others):
    distances = torch.tensor(distances, dtype=DOUBLE)
    return own.query(WAVELENGTHS, distances=distances, pixel_pitch=4 * um, shape=shape, dtype=DOUBLE, **others)


def l1(psf: torch.Tensor, truth: torch.Tensor) -> float:
    return float(((psf - truth).abs().sum((-2, -1)) / truth.sum((-2, -1))).max())


@pytest.mark.parametrize("points", [1, 3])
def test_it_is_the_benchmarks_baseline(points: int) -> None:
    phase = 3 * torch.rand(101, 101, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
    own = lens(optics.DOE(phase, design_wavelength=550 * nm, glass="fused silica"))
    asked = replace(query(own, distances=[1.0, 2.0]), paraxial=True)
    glass, silica = (refractive_index(name, wavelengths=asked.wavelengths) for name in ("N-BK7", "fused silica"))
    design = refractive_index("fused silica", wavelengths=torch.tensor([550 * nm], dtype=DOUBLE))
    theirs = textbook_psf_bank(
        phase,
        wavelengths=asked.wavelengths,
        distances=1 / asked.vergences,
        aperture_diameter=2 * mm,
        radius_of_curvature=25.8 * mm,
        lens_index=glass,
        sensor_distance=asked.sensor_distance,
        pixel_pitch=4 * um,
        shape=asked.shape,
        doe_factor=doe_scale(asked.wavelengths, silica, design_wavelength=550 * nm, design_index=design),
        oversample=points,
    )
    # its lens is a sphere's height and its sum loses digits: 1e-16 of 1e7 radians, and some more by cancellation
    assert l1(textbook_psf(asked, samples=101, points=points), theirs) < 1e-7


def test_the_angular_spectrum_is_the_benchmarks_baseline() -> None:
    own = lens(optics.Defocus(0.3))
    asked = query(own, shape=(31, 31))
    ours = textbook_angular_spectrum(asked)[0, 0]
    a, d, wavelength = 1 * mm, float(asked.sensor_distance), WAVELENGTHS[0]
    count = next_fast_len(math.ceil(2.2 * (a + asked.half_window) / (4 * um)), real=False)
    while count % 2 == 0:  # the same grid, for what wraps around differs between grids: 1.6e-3
        count = next_fast_len(count + 1, real=False)
    axis = (torch.arange(count, dtype=DOUBLE) - count // 2) * 4 * um
    r2 = axis[:, None] ** 2 + axis**2
    radius, index = 25.8 * mm, float(refractive_index("N-BK7", wavelengths=asked.wavelengths[:1]))
    path = torch.sqrt(4 + r2) + (index - 1) * torch.sqrt(radius**2 - r2)
    pupil = asked.pupil(axis[None, :] / a, axis[:, None] / a)
    path = path + sum(c * t for c, t in own.elements[2].terms(pupil, asked.wavelengths[:1]))
    path = path + own.elements[2].vergence(asked.wavelengths[:1]) * r2 / 2
    theirs = angular_spectrum_psf(
        path, wavelength=wavelength, aperture_diameter=2 * mm, sensor_distance=d, grid_pitch=4 * um, shape=(31, 31)
    )
    assert l1(ours, theirs) < 1e-7  # 1e-16 of 1e7 radians, and some more by cancellation


@pytest.mark.slow
def test_the_textbook_converges_on_the_fresnel_psf() -> None:
    asked = query(lens(), distances=[1.0, 2.0])
    truth = choose(asked, propagator="fresnel")(asked)
    errors = [l1(textbook_row(64, points=points)(asked), truth) for points in (1, 3)]
    errors.append(l1(textbook_row(256, points=3)(asked), truth))
    print("64 samples at 1 and 3 points, 256 at 3:", *(f"{error:.1e}" for error in errors))
    assert errors[0] > 2 * errors[1] > 2 * errors[2]  # in focus the centre of a pixel is not its mean
    assert errors[-1] < 0.02


def test_an_enormous_fft_is_refused() -> None:
    with pytest.raises(ValueError, match=r"needs an FFT of \d+ x \d+ here, more than 8192. Use fewer samples"):
        textbook_row(2048, points=3)(query(lens()))
    with pytest.raises(ValueError, match=r"needs an FFT of \d+ x \d+ here, more than 8192. Use fewer samples"):
        textbook_angular_spectrum_row(points=20)(query(lens()))


@pytest.mark.parametrize("points", [1, 2, 3])
@pytest.mark.parametrize("shape", [(21, 17), (20, 18)])
def test_the_angular_spectrum_is_centred_and_near(points: int, shape: tuple[int, int]) -> None:
    asked = query(
        lens(diameter=1 * mm), shape=shape, distances=0.3
    )  # far out of focus: point samples are near the pixels' means
    truth = choose(asked)(asked)
    assert l1(textbook_angular_spectrum_row(points=points)(asked), truth) < 0.05


@pytest.mark.parametrize(
    "aperture",
    [
        pytest.param(optics.SquareAperture(2 * mm), marks=pytest.mark.slow),
        optics.AnnularAperture(2 * mm, obscuration=0.4),
    ],
)
def test_every_aperture(aperture: optics.Element) -> None:
    own = optics.Lens(aperture, optics.ThinLens(focal_length=50 * mm), focus_distance=2.0)
    asked = query(own, distances=1.0)
    truth = choose(asked, propagator="fresnel")(asked)
    assert l1(textbook_row(300, points=3)(asked), truth) < 0.05
    assert l1(textbook_angular_spectrum_row(points=2)(asked), truth) < 0.05


def test_beyond_the_sphere_it_is_dark_and_finite() -> None:
    own = lens(diameter=44 * mm)  # the corners of its square are beyond R = 25.8 mm
    with pytest.warns(UserWarning, match="f/"):
        asked = query(own, shape=(5, 5))
    assert textbook_row(64)(asked).isfinite().all()
