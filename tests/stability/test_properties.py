"""What holds for every camera and scene, over random ones. Everything in float64, so that only rounding is left over.

Of the terms of a convolution by FFT the largest sets the rounding: 1e-12 of the picture's maximum is a thousand ulps.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from hypothesis import given
from hypothesis import strategies as st
from strategies import DOUBLE, between, distances, examples, imagings, lenses, scenes, sensors, tensors, wavelengths
from torch import Tensor

from kcam import Camera, Scene, optics, sensor
from kcam.optics.propagation.table import choose
from kcam.units import mm, nm, um

ROUNDING = 1e-12
# PSFs are integrals over pixels of what is known at points: the interpolation's tails leave a few 1e-5 of the light
# below zero and above one; the aperture's rim, and a DOE's pixels that it cuts, the sampling error that the row states
TAILS = 5e-5


def stated(imaging: optics.Imaging, scene: Scene, depth: float) -> float:
    """The L1 error that the non-paraxial row states for this PSF: that of the paraxial model says nothing of energy."""
    query = imaging.lens.query(
        scene.wavelengths, distances=depth, pixel_pitch=imaging.pixel_pitch, shape=imaging.psf_shape, dtype=DOUBLE
    )
    row = choose(query, propagator="nonparaxial")
    return row.error(query) + TAILS


def close(a: Tensor, b: Tensor, *, scale: Tensor) -> bool:
    return a.shape == b.shape and bool((a - b).abs().max() <= ROUNDING * scale.abs().max())


@examples(25)
@given(imagings(borders=("zero",)), scenes(mapped=False))
def test_energy_never_exceeds_what_enters(imaging: optics.Imaging, scene: Scene) -> None:
    """What a pixel gets is the mean irradiance over its sensitive part, times that part's area."""
    allowed = 1 + stated(imaging, scene, scene.depth)
    psf = imaging.lens.psf(
        scene.wavelengths, distances=scene.depth, pixel_pitch=imaging.pixel_pitch, shape=imaging.psf_shape,
        propagator=imaging.propagator, fill_factor=imaging.fill_factor, dtype=DOUBLE,
    )  # fmt: skip
    assert psf.min() >= -(allowed - 1) * psf.max()
    assert imaging.fill_factor * psf.sum((-2, -1)).max() <= allowed
    out, entering = (light.sum((-2, -1)) for light in (imaging(scene), scene.bands()))
    assert (imaging.fill_factor * out <= allowed * entering).all()


@examples(15)
@given(imagings(), scenes(size=(26, 25), mapped=False), sensors(), st.integers(0, 1), st.integers(0, 1))
def test_shift_by_whole_periods_shifts_the_raw(
    imaging: optics.Imaging, scene: Scene, stages: tuple, down: int, across: int
) -> None:
    stages, (rows, columns) = stages
    camera = Camera(imaging, *stages)
    shift = (down * rows, across * columns)
    moved = replace(scene, coefficients=scene.coefficients.roll(shift, dims=(-2, -1)))
    before, after = camera(scene), camera(moved)
    top, left = (n // 2 + 1 + s for n, s in zip(imaging.psf_shape, shift, strict=True))
    inside = (..., slice(top, 26 - top), slice(left, 25 - left))
    assert after[inside].numel()
    assert close(after[inside], before.roll(shift, dims=(-2, -1))[inside], scale=before)


@examples(15)
@given(imagings(), scenes(), sensors(), between(0, 1), st.data())
def test_linear_before_saturation(
    imaging: optics.Imaging, scene: Scene, stages: tuple, share: float, data: st.DataObject
) -> None:
    """Also over a depth map: occlusion weighs by the coverage, which the light does not enter."""
    camera = Camera(imaging, *stages[0], sensor.ShotNoise(full_well=1e4), sensor.ReadNoise(3.0)).noiseless()
    other = replace(scene, coefficients=2 * data.draw(tensors(*scene.coefficients.shape)))
    dim = 0.02  # of exposures up to white in green at 1, and light up to twice white: the well is never full
    mix = share * scene.coefficients + (1 - share) * other.coefficients
    a, b, mixed = (camera(replace(scene, coefficients=dim * light)) for light in (
        scene.coefficients, other.coefficients, mix,
    ))  # fmt: skip
    assert a.max() < 1
    assert b.max() < 1
    assert close(mixed, share * a + (1 - share) * b, scale=torch.stack([a, b]))


@examples(15)
@given(imagings(), scenes(), sensors(), between(1, 30), st.data())
def test_more_light_is_never_darker(
    imaging: optics.Imaging, scene: Scene, stages: tuple, factor: float, data: st.DataObject
) -> None:
    camera = Camera(imaging, *stages[0], sensor.ShotNoise(full_well=1e4), sensor.ADC(bits=8, black_level=3)).noiseless()
    dark = camera(scene)
    # all over, through the well's edge and the converter's steps: exactly
    assert (camera(replace(scene, coefficients=factor * scene.coefficients)) >= dark).all()
    # somewhere, before the steps: but for what a PSF is below zero
    camera = camera[:-1]
    added = data.draw(tensors(*scene.coefficients.shape))
    dark, bright = camera(scene), camera(replace(scene, coefficients=scene.coefficients + added))
    assert (bright - dark).min() >= -1e-3 * bright.max()


@examples(15)
@given(imagings(), scenes(), sensors(), st.randoms(use_true_random=False))
def test_the_order_of_the_bands_changes_nothing(imaging: optics.Imaging, scene: Scene, stages: tuple, random) -> None:
    camera = Camera(imaging, *stages[0])
    order = list(range(scene.wavelengths.numel()))
    random.shuffle(order)
    shuffled = replace(
        scene,
        coefficients=scene.coefficients[:, order],
        wavelengths=scene.wavelengths[order],
        illuminant=scene.illuminant[order],
    )
    raw = camera(scene)
    assert close(camera(shuffled), raw, scale=raw)


@examples(15)
@given(imagings(), scenes(batch=3), sensors())
def test_a_batch_is_its_members(imaging: optics.Imaging, scene: Scene, stages: tuple) -> None:
    """At one distance; over a map the layers follow the whole batch's range, and a member alone has its own."""
    if isinstance(scene.depth, Tensor):
        scene = scene.with_depth(scene.depth[:1].expand(3, -1, -1, -1))
    camera = Camera(imaging, *stages[0])
    raw = camera(scene)
    for index in range(3):
        depth = scene.depth if isinstance(scene.depth, float) else scene.depth[index : index + 1]
        member = replace(scene, coefficients=scene.coefficients[index : index + 1], depth=depth)
        assert close(camera(member), raw[index : index + 1], scale=raw)


@examples(25)
@given(
    st.data(), between(0.8, 4), between(25, 60), distances, distances, wavelengths(), between(1, 12), between(0.3, 3),
)  # fmt: skip
def test_all_lengths_scale_together(
    data: st.DataObject, width: float, focal: float, focus: float, distance: float, grid: Tensor, pitch: float,
    scale: float,
) -> None:  # fmt: skip
    """An ideal lens has no index; and its aberrations are lengths too."""
    aberrations = 300 * nm * (data.draw(tensors(6)) - 0.5)
    propagator = data.draw(st.sampled_from(["nonparaxial", "fresnel"]))
    shape = data.draw(st.tuples(st.integers(1, 21), st.integers(1, 21)))

    def psf(s: float) -> Tensor:
        lens = optics.Lens(
            optics.CircularAperture(s * width * mm), optics.ThinLens(s * focal * mm),
            optics.ZernikeAberration(s * aberrations), focus_distance=s * focus, focus_wavelength=s * 550 * nm,
        )  # fmt: skip
        return lens.psf(
            s * grid,
            distances=s * distance,
            pixel_pitch=s * pitch * um,
            shape=shape,
            propagator=propagator,
            method="matrix",
            samples=512,  # by the rule, a step function of ratios, rounding could push it over a step
            dtype=DOUBLE,
        )

    large, small = psf(scale), psf(1.0)
    assert small.max() > 0
    # the vergences 1/z, 1/d and 1/f cancel from a thousand radians down to the defocus, which leaves 1e-13 of one
    assert (large - small).abs().max() <= 1e-11 * small.max()


@examples(15)
@given(lenses(), wavelengths(), st.lists(distances, min_size=1, max_size=3))
def test_wavelengths_and_distances_are_independent(lens: optics.Lens, grid: Tensor, zs: list[float]) -> None:
    """Each PSF of a bank is the one that is asked for alone, on the grid that the bank shares."""
    settings = {"pixel_pitch": 6 * um, "shape": (9, 7), "samples": 256, "method": "matrix", "dtype": DOUBLE}
    bank = lens.psf(grid, distances=torch.tensor(zs, dtype=DOUBLE), **settings)
    z, band = len(zs) - 1, grid.numel() - 1
    alone = lens.psf(grid[band:], distances=zs[z], **settings)[0, 0]
    assert close(bank[z, band], alone, scale=bank)
