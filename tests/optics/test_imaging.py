"""Imaging: against a plain convolution, in all its rewrites, and everything that may go stale or out of bounds."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from kcam import Camera, optics, sensor
from kcam.context import Context
from kcam.optics import source
from kcam.optics.propagation.question import Query
from kcam.optics.propagation.row import Propagator
from kcam.optics.propagation.table import PROPAGATORS, choose
from kcam.scene import Scene
from kcam.units import mm, nm, um, wavelength_grid

PITCH = 4 * um
BORDERS = {"reflect": "reflect", "replicate": "replicate", "periodic": "circular", "zero": "constant"}


def random(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def lens(*others: optics.Element, diameter: float = 2.5 * mm, focus_distance: float = 2.0) -> optics.Lens:
    elements = optics.CircularAperture(diameter), optics.PlanoConvexLens(25.8 * mm, glass="N-BK7")
    return optics.Lens(*elements, *others, focus_distance=focus_distance)


def rough_doe(*, trains: bool = False, n: int = 24) -> optics.DOE:
    phase = 5 * random(n, n, seed=9)
    return optics.DOE(nn.Parameter(phase) if trains else phase)


def imaging(*others: optics.Element, **arguments) -> optics.Imaging:
    return optics.Imaging(lens(*others), **({"pixel_pitch": PITCH} | arguments))


def cube(*, size: tuple[int, int] = (40, 33), bands: int = 5, batch: int = 1, seed: int = 1, **arguments) -> Scene:
    wavelengths = wavelength_grid(count=bands)
    return Scene.from_bands(random(batch, bands, *size, seed=seed), wavelengths=wavelengths, **arguments)


def factored(*, size: tuple[int, int] = (40, 33), bands: int = 28, dtype: torch.dtype = torch.float64) -> Scene:
    return Scene.from_rgb(random(2, 3, *size, seed=2, dtype=dtype), depth=1.5, wavelengths=wavelength_grid(count=bands))


def plain(scene: Scene, stage: optics.Imaging, *, depth: float) -> Tensor:
    """Each band correlated with its PSF by conv2d on a padded picture: the definition, slowly."""
    bands = scene.bands().double()
    window = stage.psf_window(scene.wavelengths, vergences=torch.tensor([1 / depth]), picture=bands.shape[-2:])
    psf = stage.lens.psf(
        scene.wavelengths, distances=depth, pixel_pitch=stage.pixel_pitch, shape=window, dtype=torch.float64,
        propagator=stage.propagator, method=stage.method, fill_factor=stage.fill_factor,
    )[0]  # fmt: skip
    (h, w) = window
    pad = (w // 2, (w - 1) // 2, h // 2, (h - 1) // 2)
    padded = F.pad(bands, pad, mode=BORDERS[stage.border])
    return F.conv2d(padded, psf[:, None], groups=psf.shape[0])  # conv2d correlates: the PSF turned by 180 degrees


def relative(a: Tensor, b: Tensor) -> float:
    a, b = a.detach().double(), b.detach().double()
    return float((a - b).abs().max() / b.abs().max())


# ---- against the definition --------------------------------------------------------------------------------------


@pytest.mark.parametrize("border", BORDERS)
@pytest.mark.parametrize("psf_shape", [(9, 9), (8, 7), (1, 1), (31, 29)])
def test_a_picture_is_the_plain_correlation(border: str, psf_shape: tuple[int, int]) -> None:
    scene = cube(depth=0.8, batch=2)
    stage = imaging(rough_doe(), psf_shape=psf_shape, border=border)
    assert relative(stage(scene), plain(scene, stage, depth=0.8)) < 1e-12  # the same sum in another order


@pytest.mark.parametrize("propagator", ["fresnel", "geometric"])
def test_the_named_physics_is_used(propagator: str) -> None:
    scene = cube(depth=0.8, bands=2)
    stage = imaging(psf_shape=(15, 15), propagator=propagator)
    assert relative(stage(scene), plain(scene, stage, depth=0.8)) < 1e-12
    assert relative(stage(scene), imaging(psf_shape=(15, 15))(scene)) > 1e-4


@pytest.mark.parametrize("kind", ["full rank", "factored", "one factor"])
@pytest.mark.parametrize("name", ["kodak", "tile", "rgbw"])
def test_fused_equals_staged(name: str, kind: str, dtype: torch.dtype) -> None:
    colour_filter = {
        "kodak": sensor.ColourFilter.kodak,
        "tile": lambda: sensor.ColourFilter.learned(tile=6),
        "rgbw": sensor.ColourFilter.rgbw,
    }[name]()
    scene = {
        "full rank": lambda: cube(bands=28, depth=1.5),
        "factored": factored,
        "one factor": lambda: Scene.from_rgb(random(1, 40, 33), depth=1.5),
    }[kind]().to(dtype=dtype)
    stage = imaging(rough_doe())
    context = Context(wavelengths=scene.wavelengths)
    fused, staged = stage(scene, colour_filter=colour_filter), colour_filter(stage(scene), context)
    assert fused.shape == staged.shape
    assert fused.dtype == staged.dtype == dtype
    error = relative(fused, staged)
    print(f"fused {name} {kind} {dtype}: {error:.1e}")
    assert error < (1e-5 if dtype == torch.float32 else 1e-12)  # Done-when: 1e-5; in float64 it is rounding


def test_fused_equals_staged_for_depth() -> None:
    """Coverage is per channel when fused and per band when not: noise averages out; see test_depth_layers.py."""
    colour_filter = sensor.ColourFilter.kodak()
    depth = torch.where(torch.arange(33) < 15, 0.7, 3.0).expand(1, 1, 40, 33)
    scene = cube(bands=28, depth=depth)
    stage = imaging()
    fused = stage(scene, colour_filter=colour_filter)
    staged = colour_filter(stage(scene), Context(wavelengths=scene.wavelengths))
    error = relative(fused, staged)
    print(f"fused against staged at a depth edge: {error:.1e}")
    assert error < 0.05  # the note: 0.01-0.8 %, at worst 4.1 %


@pytest.mark.parametrize("fused", [True, False])
@pytest.mark.parametrize("kind", ["full rank", "factored"])
def test_max_memory_splits_with_the_same_result(kind: str, fused: bool) -> None:
    scene = cube(bands=28, batch=2, depth=1.0) if kind == "full rank" else factored()
    colour_filter = sensor.ColourFilter.learned(tile=4) if fused else None
    whole, split = (
        imaging(rough_doe(), max_memory=m, psf_shape=(21, 21))(scene, colour_filter=colour_filter) for m in (2e9, 1e4)
    )
    assert relative(split, whole) < 1e-13


def test_max_memory_splits_layers_with_the_same_result() -> None:
    depth = torch.linspace(0.7, 3.0, 33, dtype=torch.float64).expand(1, 1, 40, 33)
    scene = cube(bands=4, depth=depth)
    whole, split = (imaging(rough_doe(), max_memory=m, psf_shape=(21, 21), layers=7)(scene) for m in (2e9, 1e4))
    assert relative(split, whole) < 1e-5  # the pupil's sampling follows the largest blur of the layers at hand


def test_max_memory_bounds_what_is_held() -> None:
    """The transfer functions of 28 bands take 19 MB: they are kept between calls only where there is room."""
    scene = cube(bands=28, size=(256, 256))
    largest = []

    class Watch(torch.utils._python_dispatch.TorchDispatchMode):
        def __torch_dispatch__(self, function, types, args=(), kwargs=None):
            out = function(*args, **(kwargs or {}))
            if isinstance(out, Tensor) and out.is_complex():
                held.append(out.numel() * out.element_size())
            return out

    for max_memory in (2e9, 1.2e7):
        held: list[int] = []
        with Watch():
            imaging(max_memory=max_memory, psf_shape=(31, 31))(scene, colour_filter=sensor.ColourFilter.kodak())
        largest.append(max(held))
    assert largest[0] > 1.8e7
    assert largest[1] < 1.2e7


# ---- depth -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fused", [True, False])
@pytest.mark.parametrize("depth", [0.8, 2.0, math.inf])
def test_a_map_of_one_value_is_the_number(depth: float, fused: bool) -> None:
    colour_filter = sensor.ColourFilter.kodak() if fused else None
    number = cube(depth=depth, bands=28)
    mapped = number.with_depth(torch.full((1, 1, 40, 33), depth, dtype=torch.float64))
    stage = imaging(rough_doe())
    assert relative(stage(mapped, colour_filter=colour_filter), stage(number, colour_filter=colour_filter)) < 1e-6


def test_a_map_of_nearly_one_value_is_nearly_the_number() -> None:
    number = cube(depth=2.0)
    nearly = 2.0 + 1e-6 * random(1, 1, 40, 33, seed=5)
    stage = imaging(rough_doe())
    assert relative(stage(number.with_depth(nearly)), stage(number)) < 1e-4  # two layers of 3e-7 waves


@pytest.mark.parametrize("layers", [None, 1, 2, 9])
def test_layers_cover_the_range_in_equal_steps_of_vergence(layers: int | None) -> None:
    stage = imaging(layers=layers, pixel_pitch=PITCH)
    depth = 1 / torch.linspace(0, 2, 100, dtype=torch.float64).view(10, 10)
    wavelengths = wavelength_grid()
    vergences = stage.depth_layers(depth, wavelengths)
    steps = vergences.diff()
    if layers is not None:
        assert len(vergences) == layers
    else:
        waves = steps * (1.25 * mm) ** 2 / (2 * 420 * nm)
        assert (waves <= 0.125 * (1 + 1e-9)).all()
        assert (waves > 0.1).all(), "no more layers than the rule asks for"
    if len(vergences) > 1:
        assert (vergences[0], vergences[-1]) == (0, 2)
        assert float(steps.std(unbiased=False)) < 1e-12
    else:
        assert float(vergences) == 1


def test_between_layers_the_picture_is_interpolated() -> None:
    """A constant plane between two layers is their mixture, and close to its own rendering."""
    stage = imaging(border="periodic", psf_shape=(41, 41))
    ends = torch.tensor([1 / 0.8, 1 / 0.9], dtype=torch.float64)
    middle = float(1 / ends.mean())
    depth = torch.full((1, 1, 40, 40), middle, dtype=torch.float64)
    depth[..., 0, 0], depth[..., 0, 1] = 0.8, 0.9  # two pixels that make it a map with layers
    scene = cube(size=(40, 40), bands=3, depth=depth)
    direct = stage(scene.with_depth(middle))
    errors = []
    for layers in (2, 4, 8, 16):
        stage.layers = layers
        errors.append(relative(stage(scene)[..., 10:-10, 10:-10], direct[..., 10:-10, 10:-10]))
    print("layers 2, 4, 8, 16:", *(f"{error:.1e}" for error in errors))
    assert errors[0] < 0.1
    assert errors == sorted(errors, reverse=True)


def step_edge(*, near: float = 0.6, far: float = 3.0, near_light: float = 1.0, far_light: float = 1.0) -> Scene:
    """Near on the left, far on the right, each of one brightness."""
    columns = torch.arange(80)
    depth = torch.where(columns < 40, near, far).expand(1, 1, 60, 80).double()
    light = torch.where(columns < 40, near_light, far_light).double().expand(1, 1, 60, 80)
    return Scene.from_bands(light, wavelengths=torch.tensor([550 * nm]), depth=depth)


def test_an_even_wall_with_a_depth_edge_stays_even() -> None:
    stage = imaging(border="replicate")
    picture = stage(step_edge())
    assert torch.isfinite(picture).all()
    # the bare convolution would show a dark or a bright line where one blur ends before the other begins
    error = (picture / picture[0, 0, 30, 5] - 1).abs().max()
    print(f"even wall with a depth edge: {error:.1e}")
    assert error < 0.02  # coverage is relative, light is not: the two windows differ in what they catch


def test_what_is_far_goes_on_behind_what_is_near() -> None:
    """A black near half: beyond its blurred edge the far wall is as bright as everywhere, not darker."""
    stage = imaging(border="replicate")
    reach = 24  # pixels: the near blur has a radius of 1.25 mm * 52 mm * 1.17 / m = 76 um = 19
    dark = stage(step_edge(near_light=0.0))[0, 0, 30]
    even = stage(step_edge())[0, 0, 30]
    assert dark[40 + reach :].min() > 0.98 * even[40 + reach :].min()
    assert dark[: 40 - reach].max() < 0.02 * even.max()
    within = dark[40 - reach : 40 + reach]
    assert (within.diff() > -1e-3).all(), "from the near half to the far one it only gets brighter"
    # the near half's own blur decides how it fades: half at its geometric edge
    assert float(dark[39] + dark[40]) / 2 == pytest.approx(float(even[39] + even[40]) / 4, rel=0.1)


def test_a_bright_near_half_bleeds_over_the_far_one() -> None:
    stage = imaging(border="replicate")
    bright = stage(step_edge(far_light=0.0))[0, 0, 30]
    even = stage(step_edge())[0, 0, 30]
    assert torch.isfinite(bright).all()
    assert bright[45] > 0.1 * even[45], "the near blur reaches 19 pixels"
    assert (bright <= even * 1.02).all()
    assert (bright >= -1e-6).all()


@pytest.mark.parametrize("border", BORDERS)
def test_occlusion_with_many_layers_and_borders_is_finite_and_positive(border: str) -> None:
    depth = 0.5 + 5 * random(1, 1, 40, 33, seed=6) ** 2
    depth[..., :5] = math.inf
    scene = cube(bands=3, depth=depth)
    picture = imaging(border=border, layers=9)(scene)
    assert torch.isfinite(picture).all()
    assert picture.min() >= 0
    assert picture.max() <= 1.3 * scene.bands().max()  # normalised compositing may gain light near an edge, not much


def test_depth_gradients_are_finite() -> None:
    depth = (0.5 + 2 * random(1, 1, 20, 20, seed=6)).requires_grad_()
    phase = rough_doe(trains=True)
    scene = cube(size=(20, 20), bands=2, depth=depth)
    picture = imaging(phase, layers=4, psf_shape=(15, 15))(scene)
    gradients = torch.autograd.grad(picture.square().sum(), (depth, phase.phase))
    assert all(torch.isfinite(g).all() for g in gradients)
    assert all(g.abs().max() > 0 for g in gradients)


# ---- borders and sizes -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("border", BORDERS)
def test_an_even_picture_stays_even_up_to_the_border(border: str) -> None:
    scene = Scene.from_bands(torch.ones(1, 2, 30, 21, dtype=torch.float64), wavelengths=wavelength_grid(count=2))
    stage = imaging(border=border, psf_shape=(15, 15))
    picture = stage(scene)
    psf = stage.lens.psf(scene.wavelengths, distances=2.0, pixel_pitch=PITCH, shape=(15, 15), dtype=torch.float64)
    whole = psf[0].sum((-2, -1))[:, None, None]
    if border == "zero":
        assert (picture[0, :, 0, 0] < 0.8 * whole[:, 0, 0]).all()
        assert relative(picture[0, :, 10:-10, 10:-8], whole.expand(-1, 10, 3)) < 1e-9
    else:
        assert relative(picture[0], whole.expand(-1, 30, 21)) < 1e-12


@pytest.mark.parametrize("border", BORDERS)
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (2, 3)])
def test_a_window_larger_than_the_picture(border: str, size: tuple[int, int]) -> None:
    scene = cube(size=size, bands=2, depth=0.7)
    stage = imaging(rough_doe(), border=border, psf_shape=(19, 21))
    picture = stage(scene)
    psf = stage.lens.psf(scene.wavelengths, distances=0.7, pixel_pitch=PITCH, shape=(19, 21), dtype=torch.float64)[0]
    bands = scene.bands()[0]

    def at(row: int, column: int) -> Tensor:
        found = []
        for position, n in ((row, size[0]), (column, size[1])):
            if border == "zero" and not 0 <= position < n:
                return torch.zeros(2, dtype=torch.float64)
            if border == "periodic":
                position %= n
            elif border == "replicate":
                position = min(max(position, 0), n - 1)
            else:  # a mirror at both ends, as often as needed
                while not 0 <= position < n and n > 1:
                    position = -position if position < 0 else 2 * (n - 1) - position
                position = 0 if n == 1 else position
            found.append(position)
        return bands[:, found[0], found[1]]

    for row in range(size[0]):
        for column in range(size[1]):
            expected = sum(
                psf[:, i, j] * at(row + i - 19 // 2, column + j - 21 // 2) for i in range(19) for j in range(21)
            )
            assert torch.allclose(picture[0, :, row, column], expected, rtol=1e-10, atol=1e-15)


@pytest.mark.parametrize("shape", [(0, 28, 5, 6)])
def test_an_empty_batch_gives_an_empty_picture(shape: tuple[int, ...]) -> None:
    scene = Scene.from_bands(torch.zeros(shape))
    assert imaging()(scene).shape == (0, 28, 5, 6)
    assert imaging()(scene, colour_filter=sensor.ColourFilter.kodak()).shape == (0, 3, 5, 6)
    assert imaging()(scene, colour_filter=sensor.ColourFilter.learned(tile=4)).shape == (0, 1, 5, 6)


def test_a_batch_is_each_picture_alone() -> None:
    scene = cube(batch=3, bands=4, depth=1.0)
    stage = imaging(rough_doe())
    together = stage(scene)
    for index in range(3):
        one = Scene.from_bands(scene.bands()[index], wavelengths=scene.wavelengths, depth=1.0)
        assert relative(stage(one)[0], together[index]) < 1e-12


def test_each_picture_of_a_batch_has_its_own_depth() -> None:
    depth = torch.tensor([0.8, 3.0], dtype=torch.float64).view(2, 1, 1, 1).expand(2, 1, 40, 33)
    scene = cube(batch=2, bands=2, depth=depth.clone())
    picture = imaging()(scene)
    for index, distance in enumerate((0.8, 3.0)):
        bands = scene.bands()[index]
        alone = imaging(psf_shape=imaging().psf_window(
            scene.wavelengths, vergences=torch.tensor([1 / 0.8]), picture=(40, 33)
        ))(Scene.from_bands(bands, wavelengths=scene.wavelengths, depth=distance))  # fmt: skip
        assert relative(picture[index], alone[0]) < 1e-3  # coverage 1 within its own plane, windows of their own


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_the_picture_has_the_scenes_dtype(dtype: torch.dtype) -> None:
    scene = cube(bands=3, depth=1.0)
    stage = imaging(rough_doe())
    picture = stage(scene.to(dtype=dtype))
    assert picture.dtype == dtype
    bound = {torch.float16: 1e-3, torch.bfloat16: 1e-2, torch.float32: 2e-6, torch.float64: 1e-13}[dtype]
    assert relative(picture, stage(scene)) < bound  # the rounding of input and output: half of 2^-10, 2^-7, 2^-23


@pytest.mark.parametrize("mapped", [False, True])
def test_the_picture_is_on_the_scenes_device(device: torch.device, mapped: bool) -> None:
    depth = 0.7 + random(1, 1, 40, 33, seed=6) if mapped else 1.0
    scene = cube(bands=28, depth=depth).to(dtype=torch.float32)
    expected = imaging(rough_doe(), layers=3)(scene, colour_filter=sensor.ColourFilter.kodak())
    stage, colour_filter = imaging(rough_doe(), layers=3).to(device), sensor.ColourFilter.kodak().to(device)
    picture = stage(scene.to(device=device), colour_filter=colour_filter)
    assert picture.device.type == device.type
    assert relative(picture.cpu(), expected) < 1e-5  # float32, in another order


def test_autocast_does_not_cost_precision() -> None:
    scene = cube(bands=3, depth=1.0).to(dtype=torch.float32)
    stage = imaging(rough_doe())
    expected = stage(scene)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        fresh = imaging(rough_doe())(scene)
    assert fresh.dtype == torch.float32
    assert relative(fresh, expected) < 1e-5


def test_gradients_reach_the_scene() -> None:
    bands = random(1, 3, 12, 11).requires_grad_()
    stage = imaging(border="zero", psf_shape=(7, 7))
    picture = stage(Scene.from_bands(bands, wavelengths=wavelength_grid(count=3), depth=1.0))
    assert picture.requires_grad
    weight = random(1, 3, 12, 11, seed=4)
    (gradient,) = torch.autograd.grad((picture * weight).sum(), bands)
    # the adjoint of a correlation is the convolution with the same PSF: <w, K b> = <K^T w, b>
    assert float((gradient * bands).sum().detach()) == pytest.approx(
        float((picture * weight).sum().detach()), rel=1e-12
    )


def test_the_scene_is_not_edited() -> None:
    scene = cube(bands=3, depth=random(1, 1, 40, 33) + 0.5)
    before = scene.coefficients.clone(), scene.depth.clone()
    imaging(layers=3)(scene)
    assert torch.equal(scene.coefficients, before[0])
    assert torch.equal(scene.depth, before[1])


# ---- plain tensors -----------------------------------------------------------------------------------------------


def test_a_tensor_in_a_sequential() -> None:
    bands = random(2, 28, 30, 31, dtype=torch.float32)
    network = nn.Sequential(imaging(rough_doe()), sensor.ColourFilter.kodak(), nn.Conv2d(3, 3, 3))
    assert network(bands).shape == (2, 3, 28, 29)
    stage = network[0]
    expected = stage(Scene.from_bands(bands, depth=stage.lens.focus_distance))
    assert relative(stage(bands), expected) < 1e-6


def test_a_tensor_stands_where_the_lens_is_focused_unless_told() -> None:
    bands = random(1, 28, 20, 20)
    elsewhere = optics.Imaging(lens(), pixel_pitch=PITCH, distance=0.6)
    assert relative(elsewhere(bands), imaging()(Scene.from_bands(bands, depth=0.6))) < 1e-12
    assert relative(elsewhere(bands), imaging()(bands)) > 0.01


def test_a_tensor_with_wavelengths_of_its_own() -> None:
    bands = random(1, 3, 20, 20)
    context = Context(wavelengths=wavelength_grid(count=3))
    expected = imaging()(Scene.from_bands(bands, wavelengths=context.wavelengths, depth=2.0))
    assert relative(imaging()(bands, context), expected) < 1e-9


# ---- the window --------------------------------------------------------------------------------------------------

WINDOW_LENSES = {
    "singlet in focus": (lambda: lens(), 2.0),
    "singlet at 0.5 m": (lambda: lens(), 0.5),
    "fast singlet": (lambda: lens(diameter=5 * mm), 2.0),
    "fast, defocused": (lambda: lens(diameter=5 * mm), 0.7),
    "slow": (lambda: lens(diameter=0.8 * mm), 2.0),
    "annulus": (
        lambda: optics.Lens(
            optics.AnnularAperture(3 * mm, obscuration=0.6), optics.ThinLens(50 * mm), focus_distance=math.inf
        ),
        math.inf,
    ),
    "square": (
        lambda: optics.Lens(optics.SquareAperture(3 * mm), optics.ThinLens(50 * mm), focus_distance=math.inf),
        math.inf,
    ),
    "square, defocused": (
        lambda: optics.Lens(optics.SquareAperture(3 * mm), optics.ThinLens(50 * mm), focus_distance=2.0),
        0.6,
    ),
    "coded": (
        lambda: optics.Lens(
            optics.ApertureMap((random(3, 3, seed=3) > 0.4).double(), width=4 * mm),
            optics.ThinLens(50 * mm),
            focus_distance=2.0,
        ),
        2.0,
    ),
    "zernike": (lambda: lens(optics.ZernikeDOE(2 * random(12, seed=4) - 1)), 2.0),
    "smooth DOE": (
        lambda: lens(
            optics.DOE(12 * torch.sin(torch.linspace(-3, 3, 800).double())[:, None] * torch.ones(800).double())
        ),
        2.0,
    ),
    "tilted DOE": (lambda: lens(optics.DOE(torch.linspace(0, 60, 800).double().expand(800, 800))), 2.0),
    "flat DOE": (lambda: lens(optics.DOE(torch.zeros(100, 100))), 2.0),
}


QUICK = ("singlet in focus", "singlet at 0.5 m", "fast singlet", "fast, defocused", "zernike")


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in WINDOW_LENSES]
)
def test_the_default_window_holds_the_light(name: str) -> None:
    make, distance = WINDOW_LENSES[name]
    stage = optics.Imaging(make(), pixel_pitch=8 * um)
    vergence = torch.tensor([1 / distance], dtype=torch.float64)
    wavelength = torch.tensor([720], dtype=torch.float64) * nm  # the longest has the widest tail
    window = stage.psf_window(wavelength, vergences=vergence, picture=(4001, 4001))
    assert window[0] == window[1] < 4001, "the picture must not be what limits the window here"
    share = float(stage.lens.psf(wavelength, distances=distance, pixel_pitch=8 * um, shape=window).sum())
    print(f"window of {name}: {window[0]} pixels of 8 um hold {share:.5f}")
    # the sampling error of the matrix form, larger behind flat pixels
    assert share >= 0.999 - (2e-4 if "DOE" in name else 2e-5)


def test_the_orders_of_coarse_flat_pixels_make_the_picture_the_window() -> None:
    """0.6 rad from pixel to pixel: 0.5 % of the light beyond the first orders, which would need 60 of them at 0.1 %."""
    stage = optics.Imaging(lens(optics.DOE(torch.linspace(0, 60, 100).double().expand(100, 100))), pixel_pitch=8 * um)
    wavelength, vergence = torch.tensor([720e-9], dtype=torch.float64), torch.tensor([0.5])
    assert stage.psf_window(wavelength, vergences=vergence, picture=(501, 501)) == (501, 501)


def test_a_window_is_never_larger_than_the_picture_and_always_odd() -> None:
    wavelengths, vergence = wavelength_grid(count=2), torch.tensor([0.5])
    for picture in ((10, 13), (1, 1), (2, 5000)):
        window = imaging().psf_window(wavelengths, vergences=vergence, picture=picture)
        assert all(m % 2 == 1 for m in window)
        assert all(m <= n + 1 for m, n in zip(window, picture, strict=True))
    assert imaging(psf_shape=(8, 9)).psf_window(wavelengths, vergences=vergence, picture=(5, 5)) == (8, 9)


# ---- never stale -------------------------------------------------------------------------------------------------


def fresh(stage: optics.Imaging) -> optics.Imaging:
    """A new stage with the same optics and nothing kept."""
    return stage.changed(lens=copy.deepcopy(stage.lens))


def change_data(stage: optics.Imaging) -> None:
    stage.lens.elements[2].phase.data.mul_(0.5)


def change_one_pixel(stage: optics.Imaging) -> None:
    with torch.no_grad():
        stage.lens.elements[2].phase[3, 4] += 1.0


def change_by_a_step(stage: optics.Imaging) -> None:
    optimizer = torch.optim.Adam(stage.parameters(), lr=0.3)
    stage(SCENE).square().mean().backward()
    optimizer.step()


def change_by_loading(stage: optics.Imaging) -> None:
    state = {name: value * 0.7 for name, value in stage.state_dict().items()}
    stage.load_state_dict(state)


def change_a_float(stage: optics.Imaging) -> None:
    stage.lens.elements[0].diameter = 2.0 * mm


def change_the_glass(stage: optics.Imaging) -> None:
    stage.lens.elements[1].glass = 1.49


def change_the_sensor(stage: optics.Imaging) -> None:
    stage.lens.sensor_distance *= 1.01


def change_the_pitch(stage: optics.Imaging) -> None:
    stage.pixel_pitch = 5 * um


def change_the_physics(stage: optics.Imaging) -> None:
    stage.propagator = "fresnel"


def change_the_fill_factor(stage: optics.Imaging) -> None:
    stage.fill_factor = 0.3


def change_the_samples(stage: optics.Imaging) -> None:
    stage.samples = 40  # coarse: kappa 1.5 in this window


def change_the_integration(stage: optics.Imaging) -> None:
    stage.integrate = False


def change_the_number_of_psfs(stage: optics.Imaging) -> None:
    stage.bands = 2


def change_the_elements(stage: optics.Imaging) -> None:
    stage.lens.elements.append(optics.Defocus(0.4))


def change_the_levels(stage: optics.Imaging) -> None:
    stage.lens.elements[2].levels = 3


SCENE = cube(size=(24, 24), bands=4, depth=1.2)
CHANGES = [
    change_data, change_one_pixel, change_by_a_step, change_by_loading, change_a_float, change_the_glass,
    change_the_sensor, change_the_pitch, change_the_physics, change_the_fill_factor, change_the_elements,
    change_the_levels, change_the_samples, change_the_integration, change_the_number_of_psfs,
]  # fmt: skip


@pytest.mark.parametrize("change", CHANGES, ids=lambda c: c.__name__)
@pytest.mark.parametrize("trains", [True, False])
def test_what_is_kept_is_never_stale(change, trains: bool) -> None:
    if change is change_by_a_step and not trains:
        pytest.skip("nothing to step")
    stage = imaging(rough_doe(trains=trains), psf_shape=(15, 15))
    colour_filter = sensor.ColourFilter.learned(tile=4)
    with torch.no_grad():
        before = stage(SCENE, colour_filter=colour_filter)
        again = stage(SCENE, colour_filter=colour_filter)
    assert torch.equal(before, again)
    change(stage)
    with torch.no_grad():
        after = stage(SCENE, colour_filter=colour_filter)
        expected = fresh(stage)(SCENE, colour_filter=colour_filter)
    assert relative(after, before) > 1e-4, "the change must show for this test to test anything"
    assert relative(after, expected) < 1e-12


def test_a_copy_and_its_original_keep_apart() -> None:
    stage = imaging(rough_doe(), psf_shape=(15, 15))
    before = stage(SCENE)
    copied = copy.deepcopy(stage)
    copied.lens.elements[2].phase.zero_()
    assert relative(copied(SCENE), imaging(optics.DOE(torch.zeros(24, 24)), psf_shape=(15, 15))(SCENE)) < 1e-6
    assert torch.equal(stage(SCENE), before)


def test_moving_to_another_dtype_is_not_stale() -> None:
    stage = imaging(optics.DOE(5 * random(24, 24, seed=9, dtype=torch.float32)), psf_shape=(15, 15))
    single = stage(SCENE.to(dtype=torch.float32))
    stage.to(torch.float64)
    double = stage(SCENE)
    assert double.dtype == torch.float64
    assert 0 < relative(single, double) < 1e-5
    assert relative(stage(SCENE.to(dtype=torch.float32)), double) < 1e-5


def test_other_wavelengths_distances_and_sizes_are_not_stale() -> None:
    stage = imaging(psf_shape=(15, 15))
    for scene in (
        SCENE,
        SCENE.with_depth(0.7),
        cube(size=(24, 24), bands=5, depth=0.7),
        cube(size=(20, 31), bands=5, depth=0.7),
        Scene.from_bands(random(1, 4, 24, 24), wavelengths=wavelength_grid([5e-7, 5.2e-7, 6e-7, 6.4e-7]), depth=0.7),
    ):
        assert relative(stage(scene), fresh(stage)(scene)) < 1e-13


def test_inference_mode_does_not_poison_training() -> None:
    stage = imaging(rough_doe(), psf_shape=(15, 15))
    colour_filter = sensor.ColourFilter.learned(tile=4)
    bands = SCENE.bands().clone().requires_grad_()
    with torch.inference_mode():
        stage(SCENE, colour_filter=colour_filter)
    scene = Scene.from_bands(bands, wavelengths=SCENE.wavelengths, depth=1.2)
    stage(scene, colour_filter=colour_filter).sum().backward()
    assert torch.isfinite(bands.grad).all()
    with torch.no_grad():
        stage(SCENE, colour_filter=colour_filter)
    stage(scene, colour_filter=colour_filter).sum().backward()


def test_training_after_no_grad_has_gradients() -> None:
    stage = imaging(rough_doe(trains=True), psf_shape=(15, 15))
    with torch.no_grad():
        stage(SCENE)
    stage(SCENE).square().sum().backward()
    assert stage.lens.elements[2].phase.grad.abs().max() > 0


def test_keeping_saves_the_second_call() -> None:
    stage = imaging(rough_doe(), psf_shape=(15, 15))
    calls = []

    class Watch(torch.utils._python_dispatch.TorchDispatchMode):
        def __torch_dispatch__(self, function, types, args=(), kwargs=None):
            calls.append(function)
            return function(*args, **(kwargs or {}))

    counts = []
    for _ in range(3):
        calls.clear()
        with torch.no_grad(), Watch():
            stage(SCENE, colour_filter=sensor.ColourFilter.kodak())
        counts.append(sum("bmm" in str(f) or "cos" in str(f) for f in calls))
    assert counts[0] > 3 * counts[1], counts  # sines, cosines and products of the PSFs are not formed again
    assert counts[2] == counts[1]


# ---- what trades accuracy for time ---------------------------------------------------------------------------------


def test_fewer_psfs_than_bands_are_those_of_their_groups() -> None:
    order = torch.tensor([3, 0, 4, 1, 2])  # groups are neighbours in wavelength, not in the scene's order
    scene = cube(depth=1.5)
    shuffled = replace(scene, coefficients=scene.coefficients[:, order], wavelengths=scene.wavelengths[order])
    few, each = imaging(rough_doe(), bands=2, psf_shape=(15, 15)), imaging(rough_doe(), psf_shape=(15, 15))
    means = torch.stack([scene.wavelengths[:2].mean(), scene.wavelengths[2:].mean()])
    psfs = each.psf_bank(means, vergences=torch.tensor([1 / 1.5]), shape=(15, 15), like=scene.coefficients)
    bank = few.psf_bank(
        shuffled.wavelengths, vergences=torch.tensor([1 / 1.5]), shape=(15, 15), like=scene.coefficients
    )
    assert torch.equal(bank, psfs[:, (order >= 2).long()])
    assert relative(few(shuffled), few(scene)[:, order]) < 1e-13
    errors = []
    for bands in (1, 2, 4, 5, 99):
        few.bands = bands
        errors.append(relative(few(scene), each(scene)))
    assert errors[0] > errors[1] > errors[2] > 1e-4
    assert errors[3:] == [0, 0]  # every band has its own again


def test_without_interpolation_each_pixel_is_in_its_nearest_layer() -> None:
    ends = torch.tensor([0.5, 1.0], dtype=torch.float64)  # of the vergence; 0.7 is nearer to the first
    depth = 1 / torch.tensor([0.5, 1.0, 0.7, 0.9], dtype=torch.float64).expand(1, 1, 40, 4)
    rounded = 1 / ends[torch.tensor([0, 1, 0, 1])].expand(1, 1, 40, 4)
    stage = imaging(layers=2, interpolate=False, psf_shape=(15, 15))
    scene = cube(size=(40, 4), bands=3, depth=depth)
    assert relative(stage(scene), stage(scene.with_depth(rounded))) < 1e-13
    stage.interpolate = True
    assert relative(stage(scene), stage(scene.with_depth(rounded))) > 1e-3


def test_point_samples_on_request() -> None:
    scene = cube(depth=1.5, bands=3)
    points = imaging(integrate=False, psf_shape=(15, 15))
    arguments = {"distances": 1.5, "pixel_pitch": PITCH, "shape": (15, 15), "dtype": torch.float64}
    vergences = torch.tensor([1 / 1.5], dtype=torch.float64)
    bank = points.psf_bank(scene.wavelengths, vergences=vergences, shape=(15, 15), like=scene.coefficients)
    assert relative(bank, points.lens.psf(scene.wavelengths, integrate=False, **arguments)) < 1e-12
    assert relative(points(scene), imaging(psf_shape=(15, 15))(scene)) > 1e-3


def test_a_propagator_of_ones_own() -> None:
    def spread(query: Query) -> Tensor:
        count = query.shape[0] * query.shape[1]
        return torch.full((len(query.vergences), len(query.wavelengths), *query.shape), 1 / count, dtype=query.dtype)

    row = Propagator("flat", "none", function=spread, error=lambda q: 0, cost=lambda q: 0, valid=lambda q: None)
    stage = imaging(propagator=row, psf_shape=(3, 3), border="zero")
    scene = cube(depth=1.5, bands=2)
    assert relative(stage(scene), F.avg_pool2d(scene.bands(), 3, 1, 1)) < 1e-13
    query = stage.lens.query(scene.wavelengths, distances=1.0, pixel_pitch=stage.pixel_pitch, shape=(3, 3))
    assert choose(query, propagator=row) is row


def test_a_fill_factor_computes_a_bank_once() -> None:
    asked = []

    def counted(query: Query) -> Tensor:
        asked.append(query)
        return PROPAGATORS["nonparaxial", "radial"](query)

    row = Propagator("counted", "radial", function=counted, error=lambda q: 0, cost=lambda q: 1)
    stage = imaging(propagator=row, psf_shape=(9, 9), fill_factor=0.4)
    wavelengths = cube(depth=1.5, bands=2).wavelengths
    how = {"vergences": torch.tensor([0.4]), "shape": (9, 9), "like": torch.empty(0, dtype=torch.float64)}
    psfs = stage.psf_bank(wavelengths, **how)
    assert len(asked) == 1
    whole = stage.changed(fill_factor=1.0).psf_bank(wavelengths, **how)
    assert torch.allclose(psfs.sum((-2, -1)), whole.sum((-2, -1)), rtol=1e-12)
    assert relative(psfs, whole) > 1e-3


def test_a_changed_stage_differs_in_what_was_named() -> None:
    stage = imaging(bands=3, layers=2, border="zero")
    changed = stage.changed(bands=None, psf_shape=(9, 9))
    assert (changed.bands, changed.psf_shape, changed.layers, changed.border) == (None, (9, 9), 2, "zero")
    assert changed.lens is stage.lens
    assert (stage.bands, stage.psf_shape) == (3, None)
    with pytest.raises(TypeError, match="unexpected keyword argument 'band'"):
        stage.changed(band=3)


def test_what_trades_accuracy_for_time_is_saved(tmp_path: Path) -> None:
    stage = imaging(bands=7, interpolate=False, integrate=False, layers=3, samples=64, psf_shape=(9, 9))
    Camera(stage).save(tmp_path / "camera.safetensors")
    loaded = Camera.load(tmp_path / "camera.safetensors")[0]
    for name in ("bands", "interpolate", "integrate", "layers", "samples", "psf_shape"):
        assert getattr(loaded, name) == getattr(stage, name)


# ---- bad input ---------------------------------------------------------------------------------------------------

BAD = [
    (lambda: optics.Imaging(optics.ThinLens(0.05)), TypeError, r"source of PSFs, got ThinLens"),
    (lambda: imaging(pixel_pitch=4), ValueError, r"pixel_pitch 4 is outside .* did you mean 4 \* um"),
    (lambda: imaging(propagator="ray"), ValueError, r"unknown propagator 'ray'; known: nonparaxial, fresnel"),
    (lambda: imaging(method="hankel")(SCENE), ValueError, r"nonparaxial has no method 'hankel'; known: matrix"),
    (
        lambda: imaging(border="mirror"),
        ValueError,
        r"unknown border 'mirror'; known: reflect, replicate, periodic, zero",
    ),
    (lambda: imaging(layers=0), ValueError, r"layers must be a positive number of depth layers, or None, got 0"),
    (lambda: imaging(bands=0), ValueError, r"bands must be a positive number of wavelengths, or None, got 0"),
    (lambda: imaging(distance=-1.0), ValueError, r"distance -1 is not a distance in front of the lens"),
    (lambda: imaging(max_memory=0), ValueError, r"max_memory must be a positive number of bytes, got 0"),
    (lambda: imaging(fill_factor=0.0), ValueError, r"fill_factor 0 must be in \(0, 1\]"),
    (lambda: imaging(psf_shape=(9, 0)), ValueError, r"must be two positive integers \(H, W\).*\(9, 0\)"),
    (lambda: imaging()(torch.zeros(28, 9, 9)), ValueError, r"\(28, 9, 9\), expected \(B,L,H,W\) .* Use bands\[None\]"),
    (lambda: imaging()([1.0]), TypeError, r"floating-point tensor \(B,L,H,W\), got a list"),
    (lambda: imaging()(torch.zeros(1, 3, 9, 9)), ValueError, r"with 28 bands, .* a picture: use Scene.from_rgb\(bands"),
    (
        lambda: optics.Imaging(
            optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(50 * mm), sensor_distance=40 * mm)
        )(torch.zeros(1, 28, 9, 9)),
        ValueError,
        r"the lens is focused on -0.2 m, behind itself; say where the bands are: Imaging\(distance=2.0\)",
    ),
]


@pytest.mark.parametrize(("make", "error", "text"), BAD, ids=range(len(BAD)))
def test_bad_input_says_what_is_wrong(make, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        make()


def test_provides_its_optics() -> None:
    stage = imaging(fill_factor=0.5)
    assert stage.provides() == {"lens": stage.lens, "pixel_pitch": PITCH, "fill_factor": 0.5}
    assert imaging().fill_factor == 1.0


def each_border_once() -> Iterator[Any]:
    """Every border with every way to hold spectra; in the quick tests two of them, and with those each way."""
    ways = list(itertools.product({"strips": 1, "whole": 2**17}.items(), {"again": 0, "held": 1000}.items()))
    for index, border in enumerate(["reflect", "replicate", "periodic", "zero"]):
        for number, ((cut, strips), (kept, held)) in enumerate(ways):
            marks = [] if number == index == 3 else [pytest.mark.slow]
            yield pytest.param(border, strips, held, marks=marks, id=f"{border}-{cut}-spectra {kept}")


@pytest.mark.parametrize(("border", "strips", "held"), list(each_border_once()))
@pytest.mark.parametrize("factors", [pytest.param(None, marks=pytest.mark.slow), 5])
@pytest.mark.parametrize(
    "bands", [pytest.param(3, id="in parts"), pytest.param(1000, id="at once", marks=pytest.mark.slow)]
)
def test_the_contraction_has_the_gradient_of_its_formula(
    monkeypatch, border: str, factors: int | None, bands: int, held: int, strips: int
) -> None:
    """To the planes, the PSFs, the scene's spectra and the filter: the hand-written adjoint against differences."""
    from kcam.optics.numerics import fast_length
    from kcam.optics.rendering import convolution
    from kcam.optics.rendering.contraction import Contraction
    from kcam.optics.rendering.convolution import Convolution

    monkeypatch.setattr(convolution, "_STRIP", strips)
    monkeypatch.setattr(convolution, "_LINE", 3)

    picture, window = (5, 6), (4, 9)  # an even window, and one wider than the picture
    size = tuple(fast_length(n + m) for n, m in zip(picture, window, strict=True))
    plan = Convolution(picture=picture, window=window, border=border, size=size, bands=bands, held=held)
    planes = random(2, 3 if factors is None else factors, *picture).requires_grad_()
    psfs = random(3, *window, seed=7).requires_grad_()
    weights = random(2, 3, seed=8).requires_grad_()
    spectra = None if factors is None else random(factors, 3, seed=9).requires_grad_()

    def contract(planes: Tensor, psfs: Tensor, weights: Tensor, *spectra: Tensor) -> Tensor:
        return Contraction.apply(planes, psfs, spectra[0] if spectra else None, weights, None, plan)

    inputs = (planes, psfs, weights) if spectra is None else (planes, psfs, weights, spectra)
    assert torch.autograd.gradcheck(contract, inputs)


@pytest.mark.parametrize("max_memory", [1e9, 1.0], ids=["held", "again"])
def test_spectra_are_computed_again_where_they_do_not_fit(monkeypatch, max_memory: float) -> None:
    from kcam.optics.rendering.contraction import Contraction
    from kcam.optics.rendering.convolution import Convolution

    calls = []
    whole = Convolution.rows
    monkeypatch.setattr(Convolution, "rows", lambda self, planes: calls.extend(planes) or whole(self, planes))
    plan = Convolution.of((12, 10), (5, 4), border="reflect", itemsize=4, max_memory=max_memory)
    psfs = torch.rand(5, 5, 4, requires_grad=True)
    Contraction.apply(torch.rand(2, 5, 12, 10), psfs, None, torch.rand(3, 5), None, plan).sum().backward()
    assert len(calls) == (10 if max_memory == 1e9 else 20)


@pytest.mark.parametrize(("tile", "layers", "held"), [(None, 1, True), (None, 8, False), (64, 1, False)])
def test_what_is_held_stays_within_a_quarter_of_the_memory(tile: int | None, layers: int, held: bool) -> None:
    """Of all layers together; tiles hold nothing."""
    from kcam.optics.rendering.renderer import Renderer

    bands, saved = 28, []

    def pack(tensor: Tensor) -> Tensor:
        if tensor.is_complex():
            saved.append(tensor.nbytes)
        return tensor

    most = 8 * bands * 108 * (108 // 2 + 1)  # half spectra of 96 + 8 pixels, or a few more
    renderer = Renderer(
        torch.rand(layers, bands, 9, 9, requires_grad=True),
        spectra=None,
        weights=torch.rand(bands, bands),  # so many channels that the bands' way is the cheapest for one layer
        picture=(96, 96),
        tile=tile,
        max_memory=4 * 1.1 * most,
    )
    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        total = sum(renderer.blur(torch.rand(1, bands, 96, 96), layer=z).sum() for z in range(layers))
    assert sum(saved) == (most if held else 0)
    total.backward()


@pytest.mark.parametrize("side", [40, 300], ids=["few planes", "many"])
def test_a_rendered_picture_can_be_changed_in_place(side: int) -> None:
    """A view from inside the hand-written adjoint could not."""
    from kcam.optics.rendering.renderer import Renderer

    psfs = torch.rand(1, 6, 21, 21, requires_grad=True)
    renderer = Renderer(psfs, spectra=None, weights=torch.rand(3, 6), picture=(side, side))
    light = torch.rand(2, 6, side, side)
    (expected,) = torch.autograd.grad(2 * renderer.blur(light, layer=0).sum(), psfs)
    picture = renderer.blur(light, layer=0)
    assert picture.is_contiguous()
    (found,) = torch.autograd.grad(picture.mul_(2).sum(), psfs)
    assert torch.allclose(found, expected, rtol=1e-4)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")  # dynamo looks at it
@pytest.mark.parametrize("planes", [None, 8], ids=["bands", "planes"])
def test_a_rendering_compiles(planes: int | None) -> None:
    """The contraction stands aside: fake tensors cannot follow its views of complex numbers."""
    from kcam.optics.rendering.renderer import Renderer

    psfs = torch.rand(1, 6, 21, 21, requires_grad=True)
    spectra = None if planes is None else torch.rand(planes, 6)
    renderer = Renderer(psfs, spectra=spectra, weights=torch.rand(3, 6), picture=(90, 80))
    compiled = torch.compile(lambda light: renderer.blur(light, layer=0), backend="eager")
    for batch in (1, 2):
        light = torch.rand(batch, planes or 6, 90, 80)
        expected, found = renderer.blur(light, layer=0), compiled(light)
        assert torch.equal(found, expected)
        (gradient,) = torch.autograd.grad(found.square().sum(), psfs)
        assert torch.equal(gradient, torch.autograd.grad(expected.square().sum(), psfs)[0])


def test_the_rows_of_a_part_of_the_bands_fit_into_a_quarter_of_the_memory() -> None:
    from kcam.optics.rendering.convolution import Convolution

    batch, bands, memory = 2, 28, 1e8
    plan = Convolution.of((300, 200), (41, 31), border="reflect", itemsize=4, max_memory=memory)
    parts = plan.parts(bands, batch)
    assert [index for part in parts for index in range(part.start, part.stop)] == list(range(bands))
    planes, psfs = torch.rand(batch, bands, 300, 200), torch.rand(bands, 41, 31)
    sizes = [plan.rows(planes[:, part]).nbytes + plan.conjugate_rows(psfs[part]).nbytes for part in parts]
    assert 0.3 * memory / 4 < max(sizes) <= memory / 4


def test_a_window_wider_than_a_picture_in_the_dark_trains() -> None:
    """Zeros around a picture of 16 pixels, and a PSF of 41: it has a gradient in all of its pixels."""
    from kcam.optics.rendering.contraction import Contraction
    from kcam.optics.rendering.convolution import Convolution

    plan = Convolution.of((7, 6), (19, 18), border="zero", itemsize=8, max_memory=1e9)
    psfs, planes, weights = random(2, 19, 18).requires_grad_(), random(1, 2, 7, 6), random(1, 2)
    assert torch.autograd.gradcheck(lambda psfs: Contraction.apply(planes, psfs, None, weights, None, plan), psfs)


@pytest.mark.parametrize("pixels_in_cache", [1, 2**16])
@pytest.mark.parametrize("border", ["reflect", "replicate", "periodic", "zero"])
def test_transforms_are_those_of_the_extended_picture(monkeypatch, border: str, pixels_in_cache: int) -> None:
    """The rows of the border are not transformed again, nor planes all at once: it is one FFT of the whole still."""
    from kcam.optics.rendering import convolution
    from kcam.optics.rendering.borders import extend
    from kcam.optics.rendering.convolution import Convolution

    monkeypatch.setattr(convolution, "_PIXELS_IN_CACHE", pixels_in_cache)
    plan = Convolution.of((12, 10), (5, 8), border=border, itemsize=8, max_memory=1e9)
    planes = random(2, 3, 12, 10)
    spectrum = plan.transform(planes)
    kernel = random(5, 8, seed=3)
    transfer = plan.transfer(kernel)
    assert torch.allclose(transfer.mT, torch.fft.rfft2(kernel, s=plan.size).conj(), atol=1e-12)
    expected = torch.fft.rfft2(extend(planes, (5, 8), border), s=plan.size) * transfer.mT
    assert torch.allclose(plan.transform(planes[0, 0]), spectrum[0, 0], atol=1e-12)
    cropped = torch.fft.irfft2(expected, s=plan.size)[..., :12, :10]
    assert torch.allclose(plan.back(spectrum * transfer), cropped, atol=1e-12)
    strip = plan.columns(plan.rows(planes), slice(2, 5))
    assert torch.allclose(strip, spectrum[..., 2:5, :], atol=1e-12)


def test_a_batch_shares_the_transforms_of_its_psfs(monkeypatch: pytest.MonkeyPatch) -> None:
    from kcam.optics.rendering.contraction import Contraction
    from kcam.optics.rendering.convolution import Convolution

    transformed = []
    whole = Convolution.conjugate_rows
    monkeypatch.setattr(
        Convolution, "conjugate_rows", lambda self, planes: transformed.append(planes.shape) or whole(self, planes)
    )
    batch, bands = 3, 5
    planes, weights = torch.rand(batch, bands, 12, 10), torch.rand(2, bands)
    psfs = torch.rand(bands, 5, 4, requires_grad=True)
    plan = Convolution.of((12, 10), (5, 4), border="reflect", itemsize=4, max_memory=1e9)
    picture = Contraction.apply(planes, psfs, None, weights, None, plan)
    assert transformed == [psfs.shape]
    picture.sum().backward()
    assert transformed == [psfs.shape, picture.shape]  # optics that train alone need no way forth again


# ---- what a new user found ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("focus", [1.0, 2.0], ids=["near", "far"])
def test_a_black_object_before_a_white_wall_covers_it_with_its_blurred_mask(focus: float) -> None:
    """Whatever the wall's blur: 1 - K * mask, K the object's PSF. A halo of the wall's light lay over the object once.

    6e-3: the light that the two windows leave out, which the picture bounds here to 61 pixels.
    """
    optic = optics.Lens(optics.CircularAperture(4 * mm), optics.ThinLens(20 * mm), focus_distance=focus)
    mask = (torch.arange(121) < 60).double().expand(28, 61, 121)
    depth = torch.where(mask[:1, None] > 0, 1.0, 2.0)
    stage = optics.Imaging(optic, pixel_pitch=PITCH)
    seen = stage(Scene.from_bands(1 - mask, depth=depth))
    truth = 1 - stage(Scene.from_bands(mask, depth=1.0))
    assert float((seen - truth)[..., 20:100].abs().max()) < 6e-3
    assert float(seen[..., 30:100].diff().min()) > -1e-9  # no hard edge, no halo


@pytest.mark.parametrize("case", ["one distance", "a number", "two planes", "close planes"])
def test_gradients_reach_the_depth(case: str) -> None:
    """Also where all pixels, or the nearest and farthest, lie in one layer: the layer moves with them."""
    depth = {
        "one distance": torch.full((1, 1, 17, 19), 2.0, dtype=torch.float64),
        "a number": torch.tensor(2.0, dtype=torch.float64),
        "two planes": torch.where(torch.arange(19) < 9, 2.0, 2.5).double().expand(1, 1, 17, 19),
        "close planes": torch.where(torch.arange(19) < 9, 2.0, 2.01).double().expand(1, 1, 17, 19),
    }[case]
    stage = imaging(psf_shape=(17, 17))

    def energy(depth: Tensor) -> Tensor:
        scene = Scene.from_rgb(random(1, 3, 17, 19), depth=depth, wavelengths=wavelength_grid(count=3))
        return stage(scene).square().sum()

    moved = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (found,) = torch.autograd.grad(energy(depth + moved), moved)
    step = 1e-5
    expected = float(energy(depth + step) - energy(depth - step)) / (2 * step)
    assert float(found) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("fill_factor", [0.9, 0.5, 0.1])
def test_an_even_scene_is_as_bright_whatever_the_fill_factor(fill_factor: float) -> None:
    white = Scene.from_bands(torch.ones(1, 3, 24, 24, dtype=torch.float64), wavelengths=wavelength_grid(count=3))
    sharp = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(20 * mm), focus_distance=2.0)
    whole, part = (
        optics.Imaging(sharp, pixel_pitch=3 * um, fill_factor=f, psf_shape=(25, 25))(white) for f in (1.0, fill_factor)
    )
    torch.testing.assert_close(part, whole, rtol=1e-9, atol=1e-9)


def test_a_lens_whose_sensor_distance_trains_is_a_source() -> None:
    """isinstance with a protocol does not see it from Python 3.12 on."""
    distance = nn.Parameter(torch.tensor(0.0513, dtype=torch.float64))
    lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(50 * mm), sensor_distance=distance)
    assert source.is_source(lens)
    assert source.is_field_source(lens)
    assert not source.is_source(nn.Identity())
    optics.Imaging(lens)
