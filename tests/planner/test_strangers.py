"""Classes of cameras and scenes that someone found with a generator of their own: plans hold for random members."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from draws import Draw
from torch import Tensor, nn

from benchmarks.planner import worst
from kcam import Camera, Scene, optics, sensor
from kcam.planner import Planner, cross_spectra, evaluation, make_plan, noiseless_raw, transfers
from kcam.units import mm, nm, um

TOLERANCES = (0.1, 0.03, 0.01)
TOO_LOW = 0.7  # of what a plan errs, that it says at least


def some(*, quick: int, slow: int) -> list[Any]:
    return [*range(quick), *(pytest.param(n, marks=pytest.mark.slow) for n in range(quick, slow))]


def check(camera: Camera, scene: Scene, *, too_low: float = TOO_LOW) -> None:
    with torch.no_grad():
        planner, truth = Planner(camera, scene), noiseless_raw(camera)(scene)
        for tolerance in TOLERANCES:
            plan = planner.plan(tolerance)
            raw = noiseless_raw(plan.apply(camera))(scene)
            error = worst(raw, truth)
            assert error <= tolerance, f"{error / tolerance:.2f} of {tolerance} with {plan.changes}"
            assert error < 1e-5 or plan.bound > too_low * error, f"{plan.bound / error:.2f} with {plan.changes}"


def bayer() -> tuple[nn.Module, ...]:
    return sensor.ColourFilter.kodak(infrared_cut=660 * nm), sensor.Mosaic("RGGB"), sensor.Exposure()


def light_of(draw: Draw, size: int) -> Tensor:
    """1/f noise of any power, of colours of its own, (1, 3, n, n)."""
    frequencies = torch.hypot(torch.fft.fftfreq(size)[:, None], torch.fft.rfftfreq(size))
    fall = frequencies.clamp(min=1 / size) ** -draw.number(0, 2)
    noise = torch.fft.irfft2(torch.fft.rfft2(draw.noise(1, 3, size, size).double()) * fall, s=(size, size))
    low, high = noise.amin((-1, -2), keepdim=True), noise.amax((-1, -2), keepdim=True)
    return ((noise - low) / (high - low)).float()


@pytest.mark.parametrize("seed", some(quick=3, slow=24))
def test_bands_that_are_as_bright_as_each_other(seed: int) -> None:
    """Each with a texture of its own: their sum shows little of it, and a raw of all bands, or a filter, shows all."""
    draw = Draw(seed)
    count, size = draw.one_of(3, 8, 15), draw.one_of(40, 64)
    cube = 0.3 + 0.4 * torch.rand(1, count, size, size, generator=draw.generator)
    depth = torch.full((1, 1, size, size), draw.number(0.8, 3))
    depth[..., size // 2 :, :] = draw.number(0.25, 0.5)
    wavelengths = torch.linspace(420, 700, count, dtype=torch.float64) * nm
    lens = optics.Lens(
        optics.CircularAperture(draw.number(1, 8) * mm), optics.ThinLens(16 * mm), focus_distance=draw.number(0.3, 1)
    )
    stages = draw.one_of((), bayer())
    camera = Camera(optics.Imaging(lens, pixel_pitch=draw.number(5, 12) * um), *stages)
    check(camera, Scene.from_bands(cube, wavelengths=wavelengths, depth=depth))


@pytest.mark.parametrize("seed", some(quick=4, slow=24))
def test_pixels_with_gaps(seed: int) -> None:
    draw = Draw(seed)
    focal = draw.one_of(4.3, 8, 25) * mm
    plate = optics.ZernikeAberration(60 * nm * torch.randn(8, generator=draw.generator, dtype=torch.float64))
    lens = optics.Lens(
        draw.one_of(optics.CircularAperture, optics.SquareAperture)(focal / draw.number(4, 12)),
        optics.ThinLens(focal),
        *draw.one_of((), (plate,)),
        focus_distance=1.0,
    )
    imaging = optics.Imaging(lens, pixel_pitch=draw.number(3, 12) * um, fill_factor=draw.number(0.08, 0.9))
    check(Camera(imaging, *bayer()), Scene.builtin("coffee", size=draw.one_of(48, 96)).with_depth(draw.number(0.6, 2)))


@pytest.mark.parametrize("fill", [0.1, 0.4, 0.8])
@pytest.mark.parametrize(
    "plate", [(), (optics.ZernikeAberration(torch.tensor([0, 0, 0, 0, 8e-8, 3e-8])),)], ids=["table", "lines"]
)
def test_transfer_functions_of_pixels_with_gaps_are_those_of_psfs(fill: float, plate: tuple[nn.Module, ...]) -> None:
    """Both scaled to what whole pixels receive, in windows of any size."""
    lens = optics.Lens(optics.CircularAperture(0.7 * mm), optics.ThinLens(8 * mm), *plate, focus_distance=1.0)
    imaging = optics.Imaging(lens, pixel_pitch=(4 if plate else 10) * um, fill_factor=fill)  # else PSFs tell
    light = Scene.from_rgb(Draw(0).noise(1, 3, 48, 48).float(), depth=1.0)
    told, asked = transfers.Transfers(imaging, light, (48, 48)), (torch.ones(1).double(), light.wavelengths[::9])
    with torch.no_grad():
        for side in (5, 17, 49):
            own = imaging.changed(psf_shape=(side, side))
            ways = transfers.Way.LINES, transfers.Way.PSFS
            found, expected = (told.slices(own, *asked, way, grey=False) for way in ways)
            near = told.frequencies < 0.35
            assert float((found - expected)[..., near].abs().max()) < 0.02 + 0.03 * bool(plate)
            assert float((found / expected - 1)[..., 0].abs().max()) < 0.01 + 0.03 * bool(plate)


@pytest.mark.parametrize("seed", some(quick=4, slow=16))
def test_blur_far_wider_than_the_picture(seed: int) -> None:
    """Hardly any light falls into it, and of many layers that which is nearest to focus lights most of it."""
    draw = Draw(seed)
    focal = draw.one_of(35, 50, 85) * mm
    coefficients = torch.randn(15, generator=draw.generator, dtype=torch.float64)
    coefficients[:3] = 0
    plate = optics.ZernikeAberration(coefficients * draw.number(0.3, 3) * 550 * nm / coefficients.norm())
    aperture = optics.CircularAperture(focal / draw.number(4, 32))
    lens = optics.Lens(aperture, optics.ThinLens(focal), *draw.one_of((), (plate,)), focus_distance=draw.number(1, 3))
    size = draw.one_of(24, 32, 48)
    depth: Any = draw.number(0.35, 0.8)
    if draw.one_of(True, False):
        depth = 1 / torch.linspace(1 / depth, 0.4, size * size).view(1, 1, size, size)
    imaging = optics.Imaging(lens, pixel_pitch=draw.number(1, 3.5) * um)
    check(Camera(imaging, *draw.one_of((), bayer())), Scene.from_rgb(light_of(draw, size), depth=depth))


@pytest.mark.parametrize("seed", some(quick=1, slow=12))
def test_far_more_layers_than_a_plan_compares_at_once(seed: int) -> None:
    """Of which each with each, at every frequency, would take gigabytes: a plan took 22 of them."""
    draw = Draw(seed)
    side, focal = draw.whole(16, 28), draw.number(20, 50) * mm
    lens = optics.Lens(
        optics.CircularAperture(focal / draw.number(2, 4)),
        optics.ThinLens(focal),
        focus_distance=draw.number(0.4, 3.0),
    )
    near, far = 1 / draw.number(0.3, 0.5), 1 / draw.number(1.0, 4.0)
    depth = 1 / (far + (near - far) * torch.rand(1, 1, side, side, generator=draw.generator, dtype=torch.float64))
    scene = Scene.from_rgb(light_of(draw, side), depth=depth)
    imaging = optics.Imaging(lens, pixel_pitch=draw.number(1.5, 3) * um, border=draw.one_of("reflect", "zero"))
    assert len(imaging.vergences(scene, depth)) > 2 * cross_spectra.MANY
    check(Camera(imaging, *bayer()), scene)


@pytest.mark.parametrize("seed", some(quick=3, slow=24))
def test_pixels_that_see_points_of_what_maps_scatter(seed: int) -> None:
    draw = Draw(seed)
    focal = draw.one_of(25, 35, 50) * mm
    map_ = torch.rand(draw.one_of(4, 8, 16), 1, generator=draw.generator)
    values = (map_ * torch.rand(1, len(map_), generator=draw.generator)).clamp(min=0.05)
    width = focal / draw.number(8, 16)
    element = draw.one_of(optics.ApertureMap(values, width=width), optics.CircularAperture(width))
    plate = draw.one_of((), (optics.DOE(2 * torch.rand(8, 8, generator=draw.generator)),))
    lens = optics.Lens(element, optics.ThinLens(focal), *plate, focus_distance=draw.number(0.6, 2))
    imaging = optics.Imaging(lens, pixel_pitch=draw.number(8, 12) * um, integrate=False)
    check(Camera(imaging, *bayer()), Scene.from_rgb(light_of(draw, 48), depth=draw.number(0.4, 1.5)))


@pytest.mark.parametrize("seed", some(quick=4, slow=24))
def test_what_is_near_covers_by_its_mask_however_wide_it_blurs(seed: int) -> None:
    """Hardly any of its light falls into the picture, and yet it hides what is behind it."""
    draw = Draw(seed)
    focal, size = draw.one_of(25, 50, 85) * mm, draw.one_of(24, 40, 64)
    width = focal / draw.number(2.5, 6)
    aperture = draw.one_of(optics.CircularAperture(width), optics.AnnularAperture(width, obscuration=0.4))
    lens = optics.Lens(aperture, optics.ThinLens(focal), focus_distance=draw.one_of(math.inf, 5.0))
    depth = torch.full((1, 1, size, size), 5.0)
    row, column = draw.whole(2, size - 4), draw.whole(0, size // 2)
    depth[..., row:, column:] = draw.number(0.25, 0.5)
    how = draw.one_of({}, {"border": "periodic"}, {"border": "zero"}, {"fill_factor": 0.3})
    imaging = optics.Imaging(lens, pixel_pitch=draw.number(1.5, 6) * um, **how)
    check(Camera(imaging, *draw.one_of((), bayer())), Scene.from_rgb(light_of(draw, size), depth=depth))


@pytest.mark.parametrize("seed", some(quick=4, slow=24))
def test_optics_that_are_astigmatic_along_the_diagonals(seed: int) -> None:
    """Of which slices along x and y would not see what depth changes."""
    draw = Draw(seed)
    focal, size = draw.one_of(16, 25, 50) * mm, draw.one_of(40, 64)
    axis = torch.linspace(-1, 1, 48, dtype=torch.float64)
    twist = draw.number(4, 25) * draw.one_of(-1, 1)
    coefficients = torch.zeros(6, dtype=torch.float64)
    coefficients[4] = twist / (2 * math.pi) * 550 * nm / 2.45 / 2  # sqrt(6) rho^2 sin 2 theta
    plate = draw.one_of(optics.ZernikeAberration(coefficients), optics.DOE(twist * axis * axis[:, None]))
    aperture = draw.one_of(optics.CircularAperture, optics.SquareAperture)(focal / draw.number(8, 24))
    lens = optics.Lens(aperture, optics.ThinLens(focal), plate, focus_distance=1.0)
    middle = 1 + draw.number(-0.3, 0.3)
    vergence = torch.linspace(middle - 0.4, middle + 0.4, size, dtype=torch.float64)
    depth = (1 / vergence).expand(1, 1, size, size)
    imaging = optics.Imaging(
        lens, pixel_pitch=draw.number(1.5, 4) * um, occlusion=False, border=draw.one_of("reflect", "zero")
    )
    check(Camera(imaging, *draw.one_of((), bayer())), Scene.from_rgb(light_of(draw, size), depth=depth))


@pytest.mark.parametrize("seed", some(quick=4, slow=24))
def test_spectra_that_pixels_see_only_as_each_band_is_blurred_by_its_own(seed: int) -> None:
    """A grey pixel sums over bands: what one has more and another less adds up to nothing, before the lens."""
    draw = Draw(seed)
    count, size = draw.whole(3, 9), draw.one_of(40, 64)
    cube = torch.cat([light_of(draw, size) for _ in range(-(-count // 3))], dim=1)[:, :count].double()
    cube = 0.5 + draw.number(0.05, 0.9) * (cube - 0.5)
    if draw.one_of(True, False):
        cube = cube / cube.sum(1, keepdim=True) * (0.5 + draw.number(0, 0.5) * light_of(draw, size)[:, :1])
    wavelengths = torch.linspace(420, 680, count, dtype=torch.float64) * nm
    focal = draw.one_of(8, 25) * mm
    glass = draw.one_of(optics.PlanoConvexLens(0.5185 * focal, glass="N-SF11"), optics.ThinLens(focal))
    plate = draw.one_of((), (optics.ZernikeDOE(torch.tensor([0, 0, 0, draw.number(1, 9), 0, 2])),))
    lens = optics.Lens(optics.CircularAperture(focal / draw.number(4, 12)), glass, *plate, focus_distance=2.0)
    grey = sensor.ColourFilter.from_curves(torch.tensor([380.0, 1000]) * nm, torch.tensor([[0.5, 0.5]]))
    scene = Scene.from_bands(cube.float(), wavelengths=wavelengths, depth=draw.number(1, 4))
    check(Camera(optics.Imaging(lens, pixel_pitch=draw.number(1.5, 6) * um), grey, sensor.Exposure()), scene)


@pytest.mark.parametrize("seed", some(quick=3, slow=16))
def test_hardly_any_light_from_behind_maps_of_pixels(seed: int) -> None:
    """Falls into the picture: line spreads know little of it, and the models differ in it."""
    draw = Draw(seed)
    focal, size = draw.one_of(35, 50, 85) * mm, draw.one_of(17, 24, 40)
    width, pixels = focal / draw.number(4, 16), draw.one_of(5, 16, 33)
    values = torch.rand(pixels, pixels, generator=draw.generator)
    first = draw.one_of(optics.ApertureMap(values, width=width), optics.CircularAperture(width))
    plate = draw.one_of((), (optics.DOE(draw.number(0.5, 6) * (values - 0.5)),))
    lens = optics.Lens(first, optics.ThinLens(focal), *plate, focus_distance=draw.one_of(0.4, 1.0, math.inf))
    depth: Any = draw.number(0.22, 0.35)
    if draw.one_of(True, False):
        depth = torch.full((1, 1, size, size), depth)
        depth[..., : size // 2] = draw.number(0.8, 4)
    imaging = optics.Imaging(lens, pixel_pitch=draw.number(1, 4) * um, border=draw.one_of("reflect", "periodic"))
    check(Camera(imaging, *draw.one_of((), bayer())), Scene.from_rgb(light_of(draw, size), depth=depth))


@pytest.mark.parametrize("seed", some(quick=3, slow=16))
def test_blur_of_less_than_a_pixel_that_differs_between_many_bands(seed: int) -> None:
    draw = Draw(seed)
    count, size, focal = draw.whole(9, 24), draw.one_of(32, 48), 4.3 * mm
    cube = torch.cat([light_of(draw, size) for _ in range(8)], dim=1)[:, :count]
    glass = optics.PlanoConvexLens(0.5185 * focal, glass=draw.one_of("N-BK7", "N-SF11"))
    lens = optics.Lens(optics.CircularAperture(focal / draw.number(4, 12)), glass, focus_distance=1.0)
    wavelengths = torch.linspace(*draw.one_of((420, 720), (380, 900)), count, dtype=torch.float64) * nm
    imaging = optics.Imaging(lens, pixel_pitch=draw.number(10, 25) * um, fill_factor=draw.one_of(1.0, 0.6))
    check(Camera(imaging), Scene.from_bands(cube, wavelengths=wavelengths, depth=draw.number(0.8, 1.2)))


@pytest.mark.parametrize("seed", some(quick=4, slow=24))
def test_lights_at_one_of_many_distances(seed: int) -> None:
    """One plane, and few planes of which one is there, blur them as all do, and hide nothing of them, or otherwise."""
    draw = Draw(seed)
    focal, size = draw.one_of(25, 50) * mm, draw.one_of(40, 64, 96)
    lens = optics.Lens(
        optics.CircularAperture(focal / draw.number(8, 18)),
        draw.one_of(optics.ThinLens(focal), optics.PlanoConvexLens(0.5185 * focal, glass="N-BK7")),
        focus_distance=draw.number(0.5, 2),
    )
    light = torch.full((1, 3, size, size), draw.one_of(0.0, 0.05))
    count, nearest = draw.one_of(3, 4, 64), 1 / draw.number(0.4, 0.8)
    columns = torch.arange(size) * count // size  # distances in bars, or a ramp
    vergence = torch.linspace(0.2, nearest, count, dtype=torch.float64)[columns]
    across = draw.whole(size // 4, 3 * size // 4)
    for _ in range(draw.whole(1, 4)):
        light[..., draw.whole(2, size - 3), across] = torch.rand(3, generator=draw.generator)
    depth = (1 / vergence).expand(1, 1, size, size)
    imaging = optics.Imaging(
        lens, pixel_pitch=draw.number(2, 6) * um, border=draw.one_of("reflect", "zero", "periodic")
    )
    narrow = torch.linspace(540, 544, 3, dtype=torch.float64) * nm  # what colours cost there is another question
    check(Camera(imaging, *bayer()), Scene.from_bands(light, wavelengths=narrow, depth=depth))


@pytest.mark.parametrize("seed", some(quick=3, slow=24))
def test_light_of_a_few_bands_on_a_ramp_before_a_pupil_that_is_not_round(seed: int) -> None:
    """A little out of focus wavelengths differ more than in focus, and than at the ends of the ramp."""
    draw = Draw(seed)
    size, far, near = draw.one_of(32, 40, 56), 1 / draw.number(1, 3), 1 / draw.number(0.4, 0.5)
    wavelengths = torch.linspace(draw.number(450, 650), draw.number(750, 950), 28, dtype=torch.float64) * nm
    light = torch.zeros(1, 28, size, size)
    for _ in range(draw.one_of(1, 2, 4)):
        light[:, draw.whole(0, 27), :, draw.whole(8, size - 9) :] += draw.number(0.1, 10)
    ramp = 1 / torch.linspace(far, near, size, dtype=torch.float64)
    depth = (ramp[:, None] if draw.one_of(True, False) else ramp).expand(1, 1, size, size).contiguous()
    width = draw.number(3, 4.2) * mm
    plate: tuple[nn.Module, ...] = (optics.SquareAperture(width), optics.ThinLens(8 * mm))
    if draw.one_of(True, False):
        waves = torch.tensor([0.0, 0.0, 0.0, 0.0, *(draw.number(-0.2, 0.2) for _ in range(3))])
        plate = (optics.CircularAperture(width), optics.ThinLens(8 * mm), optics.ZernikeAberration(waves * 550 * nm))
    lens = optics.Lens(*plate, focus_distance=draw.number(0.5, 0.9))
    imaging = optics.Imaging(lens, pixel_pitch=draw.number(1.5, 3) * um, integrate=draw.one_of(True, False))
    scene = Scene.from_bands(light, wavelengths=wavelengths, depth=depth)
    check(Camera(imaging, sensor.Exposure()), scene, too_low=0.55)  # of a window that errs 0.002, one in 24


@pytest.mark.parametrize("seed", some(quick=3, slow=24))
def test_lights_of_which_crops_hold_some(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """At distances of their own, the nearest in any part of its tile."""
    monkeypatch.setattr(evaluation, "LARGEST", 128**2)
    monkeypatch.setattr(evaluation, "CROP", 64)
    draw = Draw(seed)
    lens = optics.Lens(
        optics.CircularAperture(draw.number(2, 6) * mm), optics.ThinLens(50 * mm), focus_distance=draw.number(0.7, 1.5)
    )
    scene = Scene.builtin("chelsea", size=256)
    _, height, width = scene.shape
    light, depth = scene.coefficients.clone(), torch.full((1, 1, height, width), 2.1)
    for _ in range(draw.whole(2, 5)):
        top, left, side = draw.whole(0, height - 40), draw.whole(0, width - 40), draw.whole(2, 40)
        depth[..., top : top + side, left : left + side] = draw.number(0.9, 1.9)
        light[..., top + side // 2, left + side // 2] = draw.number(1, 40)
    camera = Camera(optics.Imaging(lens, pixel_pitch=6 * um), *bayer())
    scene = replace(scene, coefficients=light, depth=depth)
    samples = Planner(camera, scene).evaluator.samples
    ends = torch.cat([torch.as_tensor(sample.scene.depth).flatten() for sample in samples]).aminmax()
    assert ends == depth.double().aminmax()
    check(camera, scene)


@pytest.mark.parametrize("seed", some(quick=3, slow=24))
def test_light_of_few_bands_at_edges_of_depth(seed: int) -> None:
    """Masks are white: behind edges light is divided by what they leave, and its colour is blurred otherwise."""
    draw = Draw(seed)
    focal, size, count = 16 * mm, draw.one_of(48, 72), draw.whole(5, 16)
    lens = optics.Lens(
        optics.CircularAperture(focal / draw.number(3, 6)), optics.ThinLens(focal), focus_distance=draw.number(0.8, 2)
    )
    wavelengths = torch.linspace(*draw.one_of((380, 780), (430, 670)), count, dtype=torch.float64) * nm
    lines = torch.zeros(1, count)
    lines[:, [draw.whole(0, count - 1) for _ in range(draw.whole(1, 2))]] = 1
    depth = torch.full((1, 1, size, size), draw.number(1, 2))
    for _ in range(4):
        top, left = draw.whole(0, size - 8), draw.whole(0, size - 8)
        depth[..., top : top + size // 3, left : left + size // 3] = draw.number(0.5, 0.9)
    scene = Scene(0.2 + light_of(draw, size)[:, :1], spectra=lines, wavelengths=wavelengths, depth=depth)
    check(Camera(optics.Imaging(lens, pixel_pitch=draw.number(1.2, 3) * um), *bayer()), scene)


# ---- stages of one's own -----------------------------------------------------------------------------------------


class Squared(optics.Imaging):
    """Of a user's own, which does more than a plan can know."""

    def forward(self, *arguments: Any, **named: Any) -> Tensor:
        return super().forward(*arguments, **named).square()


def hooked(imaging: optics.Imaging) -> optics.Imaging:
    imaging.register_forward_hook(lambda _module, _given, light: light.square())
    return imaging


@pytest.mark.parametrize("make", [lambda **how: Squared(**how), lambda **how: hooked(optics.Imaging(**how))])
def test_what_changes_an_imaging_keeps_what_a_user_made_of_it(make: Callable[..., optics.Imaging]) -> None:
    lens = optics.Lens(optics.CircularAperture(4 * mm), optics.ThinLens(25 * mm), focus_distance=1.0)
    imaging = make(lens=lens, pixel_pitch=5 * um).eval()
    changed = imaging.changed(bands=4)
    assert type(changed) is type(imaging)
    assert not changed.training
    assert changed.bands == 4
    assert imaging.bands is None
    assert changed.lens is lens
    check(Camera(imaging), Scene.builtin("coffee", size=32).with_depth(1.4))


def test_a_channel_that_sees_none_of_the_light_is_dark() -> None:
    """Where layers hide each other, too."""
    lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(50 * mm), focus_distance=1.0)
    curves = torch.tensor([[0.0, 0, 0.5, 0.5], [0.5, 0.5, 0, 0]])
    blind = sensor.ColourFilter.from_curves(torch.tensor([400.0, 500, 510, 700]) * nm, curves)
    depth = torch.full((1, 1, 32, 32), 1.0)
    depth[..., 16:] = 2.0
    light = torch.rand(1, 3, 32, 32, generator=Draw(0).generator).requires_grad_()
    scene = Scene.from_bands(light, wavelengths=torch.tensor([600.0, 620, 640]) * nm, depth=depth)
    camera = Camera(optics.Imaging(lens, pixel_pitch=4 * um), blind, sensor.Exposure(time=0.01))
    raw = camera(scene)
    assert bool(raw.isfinite().all())
    assert float(raw[:, 0].detach().min()) > 0
    assert float(raw[:, 1].detach().abs().max()) == 0
    assert bool(torch.autograd.grad(raw.sum(), light)[0].isfinite().all())


def test_what_is_no_scene_and_numbers_of_numpy() -> None:
    camera, scene = Camera.phone(), Scene.builtin("coffee", size=24)
    with pytest.raises(TypeError, match="a plan is for scenes, got NoneType"):
        make_plan(camera, None, tolerance=0.01)  # type: ignore[arg-type]
    plan = make_plan(camera, scene, tolerance=np.float32(0.02))  # type: ignore[arg-type]
    assert type(plan.tolerance) is float
    assert math.isclose(plan.tolerance, 0.02, rel_tol=1e-6)
    with pytest.raises(TypeError, match="max_memory must be a positive number of bytes, got '1GB'"):
        make_plan(camera, scene, tolerance=0.01, max_memory="1GB")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="kappa must be a number above 1 sample per fringe, got 'a'"):
        optics.Accuracy(kappa="a")  # type: ignore[arg-type]
