from __future__ import annotations

import functools
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import pytest
import torch
from draws import Draw
from torch import Tensor, nn

from kcam import Camera, Context, Scene, Stage, isp, optics, sensor
from kcam.linear import LinearCamera
from kcam.optics.rendering.borders import BORDERS
from kcam.units import mm, nm, um

FEW = torch.linspace(430, 690, 5, dtype=torch.float64) * nm
HEIGHT, WIDTH = 14, 17


def singlet(focus: float = 1.2, **arguments: Any) -> optics.Imaging:
    lens = optics.Lens(
        optics.CircularAperture(2 * mm), optics.PlanoConvexLens(10.3 * mm, glass="N-BK7"), focus_distance=focus
    )
    return optics.Imaging(lens, pixel_pitch=6 * um, **arguments)


def measured(*, places: bool = False) -> optics.MeasuredPSF:
    draw = Draw(2)
    psfs = draw.noise(*((4,) if places else ()), 2, 2, 5, 5)
    corners = torch.tensor([[-40.0, -40], [40, -40], [-40, 40], [40, 40]], dtype=torch.float64) * um
    return optics.MeasuredPSF(
        psfs / psfs.sum((-2, -1), keepdim=True),
        wavelengths=[420 * nm, 700 * nm],
        distances=[1.0, 4.0],
        pixel_pitch=6 * um,
        positions=corners if places else None,
    )


def behind(pattern: str | None = "RGGB", filter_: sensor.ColourFilter | None = None) -> list[nn.Module]:
    mosaic = [] if pattern is None else [sensor.Mosaic(pattern)]
    return [
        filter_ or sensor.ColourFilter.kodak(),
        *mosaic,
        sensor.Exposure(iso=200.0),
        sensor.ShotNoise(full_well=9_000),
        sensor.DarkCurrent(20.0, time=0.1),
        sensor.FixedPattern(),
        sensor.ReadNoise(2.0),
        sensor.ADC(bits=12, black_level=200, rounding=False),
    ]


def pictured(draw: Draw, *, batch: int = 1, depth: Any = 2.0) -> Scene:
    return Scene.from_rgb(0.05 + 0.9 * draw.noise(batch, 3, HEIGHT, WIDTH), depth=depth, wavelengths=FEW)


def cube(draw: Draw) -> Scene:
    return Scene.from_bands(draw.noise(1, len(FEW), HEIGHT, WIDTH), wavelengths=FEW, depth=2.0)


def steps_of_depth() -> Tensor:
    depth = torch.full((HEIGHT, WIDTH), 4.0, dtype=torch.float64)
    depth[4:10, 5:12], depth[7:, 10:] = 1.2, 0.8
    return depth


@dataclass(frozen=True)
class Case:
    """A camera, and a scene for it."""

    camera: Callable[[], Camera]
    scene: Callable[[Draw], Scene] = pictured


def through(imaging: Callable[[], optics.Imaging], *rest: Any, **arguments: Any) -> Callable[[], Camera]:
    return lambda: Camera(imaging(), *behind(*rest, **arguments), isp.Demosaic())


def mapped(draw: Draw) -> Scene:
    return pictured(draw, depth=steps_of_depth())


def over_the_field() -> optics.Imaging:
    lens = optics.CompoundLens.preset("cooke_triplet", focus_distance=3.0)
    return optics.Imaging(lens, pixel_pitch=60 * um, psf_shape=(7, 7), centre=(9 * mm, 5 * mm))


CASES = {
    "ideal": Case(Camera.ideal),
    "phone": Case(Camera.phone),
    "singlet": Case(through(singlet)),
    "x_trans": Case(through(singlet, "x_trans")),
    "rgbw": Case(lambda: Camera(singlet(), *behind("rgbw", sensor.ColourFilter.rgbw()), isp.Demosaic())),
    "monochrome": Case(lambda: Camera(singlet(), *behind(None, sensor.ColourFilter(torch.ones(1, 12))))),
    "tile": Case(lambda: Camera(singlet(), *behind(None, sensor.ColourFilter.learned(6)), isp.LearnedDemosaic())),
    "all bands": Case(lambda: Camera(singlet())),
    "bands alone": Case(lambda: Camera(*behind(), isp.Demosaic())),
    "cube": Case(through(singlet), cube),
    "cube of rank 3": Case(through(singlet), lambda draw: cube(draw).low_rank(3)),
    "depth": Case(through(singlet), mapped),
    "depth without occlusion": Case(through(lambda: singlet(occlusion=False)), mapped),
    "depth per band": Case(through(lambda: singlet(coverage="band")), mapped),
    "depth of all bands": Case(lambda: Camera(singlet()), mapped),
    "distances": Case(through(singlet), lambda draw: pictured(draw, batch=3, depth=[1.0, 4.0, 1.0])),
    "few bands": Case(through(lambda: singlet(bands=2))),
    "in squares": Case(through(lambda: singlet(tile=8))),
    "sums": Case(through(lambda: singlet(direct=True, psf_shape=(5, 5)))),
    "no blur": Case(through(lambda: singlet(blur=False))),
    "lights": Case(through(singlet), lambda draw: replace(mapped(draw), coefficients=lights())),
    "measured": Case(through(lambda: optics.Imaging(measured(), pixel_pitch=6 * um)), mapped),
    "measured at places": Case(through(lambda: optics.Imaging(measured(places=True), pixel_pitch=4 * um))),
    "convolution": Case(lambda: Camera(singlet(), *behind(None)[:-1], isp.Convolution(), isp.Demosaic())),
    "field": Case(through(over_the_field)),
} | {border: Case(through(lambda border=border: singlet(border=border)), mapped) for border in BORDERS}
SLOW = {
    "thesis": Case(Camera.thesis),
    "slr": Case(Camera.slr),
    "field with depth": Case(through(over_the_field), mapped),
}


def lights() -> Tensor:
    """A few that stand out of the dark: they are computed in float64, whatever their dtype."""
    planes = torch.full((1, 3, HEIGHT, WIDTH), 1e-3)
    planes[..., 3, 4] = 1e3
    return planes.double()


def made(name: str, dtype: torch.dtype) -> tuple[Camera, Scene, LinearCamera, Draw]:
    """A case, which no test changes: made once, and with it its PSFs. Each test draws from where the scene left off."""
    camera, scene, operator, state = _made(name, dtype)
    draw = Draw(0)
    draw.generator.set_state(state)
    return camera, scene, operator, draw


@functools.cache
def _made(name: str, dtype: torch.dtype) -> tuple[Camera, Scene, LinearCamera, Tensor]:
    draw = Draw(len(name))
    case = (CASES | SLOW)[name]
    camera, scene = case.camera(), case.scene(draw).to(dtype)
    with torch.no_grad():
        return camera, scene, camera.linear(scene), draw.generator.get_state()


def signed(draw: Draw, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    return (2 * draw.noise(*shape) - 1).to(dtype)


every = pytest.mark.parametrize("name", [*CASES, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
ROUNDING = {torch.float32: 1e-5, torch.float64: 1e-12}
HIDDEN = {"field with depth": 5.0}  # what is seen of a layer that nearer ones hide is divided by down to 1e-4


# ---- the map ------------------------------------------------------------------------------------------------------


@every
@torch.no_grad()
def test_light_of_any_sign_adds_up(name: str, dtype: torch.dtype) -> None:
    *_, operator, draw = made(name, dtype)
    one, other = (signed(draw, operator.scene_shape, dtype) for _ in range(2))
    parts = 3 * operator(one) - 2 * operator(other)
    allowed = HIDDEN.get(name, 1.0) * ROUNDING[dtype]
    assert (operator(3 * one - 2 * other) - parts).norm() < allowed * parts.norm()
    assert operator(one).dtype == dtype


@every
@torch.no_grad()
def test_the_adjoint_is_the_transpose(name: str, dtype: torch.dtype) -> None:
    *_, operator, draw = made(name, dtype)
    x, y = signed(draw, operator.scene_shape, dtype), signed(draw, operator.raw_shape, dtype)
    raw, light = operator(x), operator.adjoint(y)
    assert light.dtype == dtype
    assert tuple(light.shape) == operator.scene_shape
    assert tuple(raw.shape) == operator.raw_shape
    products = (raw.double() * y.double()).sum(), (x.double() * light.double()).sum()
    assert abs(products[0] - products[1]) < ROUNDING[dtype] * raw.double().norm() * y.double().norm()


@every
@torch.no_grad()
def test_a_scene_s_own_light_gives_what_the_camera_records(name: str, dtype: torch.dtype) -> None:
    camera, scene, operator, _ = made(name, dtype)
    ends = next((k for k, stage in enumerate(camera) if isinstance(stage, (isp.Demosaic, isp.LearnedDemosaic))), None)
    ends = 2 if name == "ideal" else ends
    stages = [stage.bypass() if isinstance(stage, sensor.ADC) else stage for stage in list(camera)[:ends]]
    raw = Camera(*stages, context=camera.resolve()).noiseless()(scene)
    clean = operator(operator.light) + operator.offset
    if name in ("lights", "rgbw"):  # of which some saturate
        clean, raw = clean.clamp(max=0.9), raw.clamp(max=0.9)
    assert (clean - raw).norm() <= 10 * ROUNDING[dtype] * raw.norm()


@pytest.mark.parametrize("seed", range(12))
@torch.no_grad()
def test_random_cameras_are_linear_and_transposed(seed: int, dtype: torch.dtype) -> None:
    draw = Draw(seed)
    imaging = singlet(
        draw.number(0.5, 4),
        border=draw.one_of(*BORDERS),
        occlusion=draw.one_of(True, False),
        tile=draw.one_of(None, 8),
        bands=draw.one_of(None, 2),
        integrate=draw.one_of(True, False),
    )
    pattern = draw.one_of(None, "RGGB", "GBRG", "quad_bayer", "x_trans")
    camera = Camera(imaging, *behind(pattern, draw.one_of(None, sensor.ColourFilter.nikon())))
    depth = draw.one_of(0.7, math.inf, 0.6 + 4 * draw.noise(HEIGHT, WIDTH), steps_of_depth())
    operator = camera.linear(draw.one_of(pictured, cube)(draw).with_depth(depth).to(dtype))
    x, other = (signed(draw, operator.scene_shape, dtype) for _ in range(2))
    y, raw = signed(draw, operator.raw_shape, dtype), operator(x)
    parts = 3 * raw - 2 * operator(other)
    assert (operator(3 * x - 2 * other) - parts).norm() < ROUNDING[dtype] * parts.norm()
    products = (raw.double() * y.double()).sum(), (x.double() * operator.adjoint(y).double()).sum()
    assert abs(products[0] - products[1]) < ROUNDING[dtype] * raw.double().norm() * y.double().norm()


@pytest.mark.parametrize("name", ["singlet", "depth", "measured at places", "field"])
@torch.no_grad()
def test_one_scene_stands_for_all_of_a_batch(name: str) -> None:
    *_, operator, draw = made(name, torch.float64)
    x = signed(draw, (3, *operator.scene_shape[1:]), torch.float64)
    raw = operator(x)
    torch.testing.assert_close(raw, torch.cat([operator(one[None]) for one in x]), rtol=0, atol=1e-12)
    torch.testing.assert_close(
        operator.adjoint(raw), torch.cat([operator.adjoint(one[None]) for one in raw]), rtol=0, atol=1e-12
    )


@torch.no_grad()
def test_the_norm_is_the_largest_singular_value() -> None:
    for name in ("singlet", "depth", "cube of rank 3"):
        *_, operator, _ = made(name, torch.float64)
        size = math.prod(operator.scene_shape)
        columns = operator(torch.eye(size, dtype=torch.float64).view(size, *operator.scene_shape[1:]))
        largest = float(torch.linalg.matrix_norm(columns.flatten(1), ord=2))
        assert 0.99 * largest < operator.norm() <= largest * (1 + 1e-9)
        assert operator.norm(tolerance=1e-7, steps=1000) == pytest.approx(largest, rel=1e-3)


@torch.no_grad()
def test_what_is_recorded_is_what_the_camera_records() -> None:
    camera, scene, operator, _ = made("singlet", torch.float64)
    raws = [
        take(generator=torch.Generator().manual_seed(4))
        for take in (
            lambda generator: camera.raw(scene, generator=generator) - operator.offset,
            lambda generator: operator.record(operator(operator.light), generator=generator),
        )
    ]
    assert (raws[0] - operator(operator.light)).abs().max() > 1e-3  # there is noise
    assert ((raws[0] - raws[1]).abs() > 1e-6).double().mean() < 0.01  # an electron, where rounding decides


@torch.no_grad()
def test_light_becomes_a_scene_again() -> None:
    camera, scene, operator, _ = made("depth", torch.float64)
    again = operator.scene(operator.light)
    torch.testing.assert_close(camera.noiseless()(again), camera.noiseless()(scene), rtol=0, atol=0)
    assert operator.scene(operator.light - 0.5).coefficients.min() == 0
    assert len(operator.scene(operator.light.expand(4, -1, -1, -1)).bands()) == 4
    assert repr(operator) == "LinearCamera((1, 3, 14, 17) -> (1, 1, 14, 17))"


# ---- derivatives --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene_of", [*(pytest.param(own, marks=pytest.mark.slow) for own in (pictured, cube)), mapped])
def test_gradients_reach_light_raw_lens_and_filter(scene_of: Callable[[Draw], Scene]) -> None:
    draw = Draw(5)
    scene = scene_of(draw).crop(top=4, left=5, height=5, width=6)
    phase, curves = 0.3 * draw.noise(9, 9), 0.1 + draw.noise(3, 12)
    shape = (1, len(scene.coefficients[0]), 5, 6)
    x, y = (signed(draw, of, torch.float64) for of in (shape, (1, 1, 5, 6)))

    def unrolled(phase: Tensor, curves: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        doe = optics.DOE(phase, design_wavelength=550 * nm, glass="fused silica")
        lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(20 * mm), doe, sensor_distance=20.2 * mm)
        imaging = optics.Imaging(lens, pixel_pitch=6 * um, psf_shape=(3, 3), layers=2)
        operator = Camera(imaging, sensor.ColourFilter(curves), sensor.Mosaic(), sensor.Exposure()).linear(scene)
        return operator(x), operator.adjoint(y), x - 0.4 * operator.adjoint(operator(x) - y)

    inputs = tuple(of.requires_grad_() for of in (phase, curves, x, y))
    assert torch.autograd.gradcheck(unrolled, inputs, fast_mode=True, atol=1e-6)


def test_a_step_of_training_is_that_of_finite_differences() -> None:
    draw = Draw(1)
    camera = Camera(singlet(), sensor.ColourFilter.kodak().trainable().double(), sensor.Mosaic(), sensor.Exposure())
    operator = camera.linear(pictured(draw))
    y = signed(draw, operator.raw_shape, torch.float64)
    weights = camera[1].coefficients
    loss = operator.adjoint(y).square().sum()
    loss.backward()
    direction = signed(draw, tuple(weights.shape), torch.float64)
    found = float((weights.grad * direction).sum())
    losses = []
    for step in (1e-5, -2e-5):  # the operator follows its parameters
        with torch.no_grad():
            weights.add_(step * direction)
            losses.append(float(operator.adjoint(y).square().sum()))
    assert (losses[0] - losses[1]) / 2e-5 == pytest.approx(found, rel=1e-6)


def test_the_adjoint_can_be_differentiated_twice() -> None:
    *_, operator, draw = made("singlet", torch.float64)
    y = signed(draw, operator.raw_shape, torch.float64).requires_grad_()
    assert torch.autograd.gradgradcheck(operator.adjoint, (y,), fast_mode=True)
    assert torch.autograd.gradcheck(operator, operator.light.clone().requires_grad_(), fast_mode=True)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
@pytest.mark.parametrize("trains", [False, True])
def test_psfs_are_computed_once(mode: Any, trains: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    lens = optics.Lens(
        optics.CircularAperture(2 * mm),
        optics.ThinLens(20 * mm),
        *[optics.DOE(nn.Parameter(torch.zeros(9, 9)), design_wavelength=550 * nm, glass="fused silica")] * trains,
        focus_distance=1.0,
    )
    banks = []
    bank = optics.Lens.bank
    monkeypatch.setattr(optics.Lens, "bank", lambda *arguments: banks.append(1) or bank(*arguments))
    scene = pictured(Draw(0))
    with torch.no_grad():
        operator = Camera(optics.Imaging(lens, pixel_pitch=6 * um), *behind()).linear(scene)
    with mode():
        for _ in range(3):
            raw = operator(operator.light)
            light = operator.adjoint(raw)
    assert light.shape == operator.light.shape
    assert not light.requires_grad
    assert len(banks) == 1


# ---- what cannot be ----------------------------------------------------------------------------------------------


class Squared(nn.Module):
    def forward(self, signal: Tensor) -> Tensor:
        return signal * (1 + 1e-3 * signal)


class Limited(Stage):
    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        return signal.clamp(0, 1)


def test_stages_that_are_not_linear_are_named() -> None:
    scene = pictured(Draw(0))
    for stage in (Squared(), Limited()):
        camera = Camera(singlet(), sensor.ColourFilter.kodak(), stage, isp.Demosaic())
        name = type(stage).__name__
        with pytest.raises(ValueError, match=rf"{name} \(stage 2\) is not linear .*camera\[:2\], \*camera\[3:\]"):
            camera.linear(scene)
    Camera(singlet(), sensor.ColourFilter.kodak(), isp.Demosaic(), Squared()).linear(scene)  # behind the raw
    with pytest.raises(ValueError, match=r"Imaging \(stage 1\) stands behind Identity"):
        Camera(nn.Identity(), singlet()).linear(scene)
    with pytest.raises(ValueError, match=r"Imaging\(rank=2\) fits spectra to each scene.*low_rank\(2\)"):
        Camera(singlet(rank=2)).linear(scene)
    Camera(singlet(rank=3)).linear(scene)
    own = type("Own", (optics.Imaging,), {})
    with pytest.raises(ValueError, match="nobody knows what is linear of Own"):
        Camera(own(singlet().lens)).linear(scene)
    with pytest.raises(TypeError, match="takes a Scene, got .*Scene.from_rgb"):
        Camera(singlet()).linear(scene.coefficients)


def test_what_does_not_fit_is_refused() -> None:
    *_, operator, _ = made("singlet", torch.float64)
    with pytest.raises(TypeError, match="x must be a floating-point tensor"):
        operator(operator.light.long())
    with pytest.raises(ValueError, match=r"x has shape \(1, 5, 14, 17\), expected \(B, 3, 14, 17\)"):
        operator(torch.zeros(1, 5, HEIGHT, WIDTH))
    with pytest.raises(ValueError, match=r"y has shape \(1, 3, 14, 17\), expected \(B, 1, 14, 17\)"):
        operator.adjoint(operator.light)
    with pytest.raises(ValueError, match=r"x is on meta.*scene.to\('meta'\)"):
        operator(operator.light.to("meta"))
    *_, operator, _ = made("distances", torch.float64)
    with pytest.raises(ValueError, match=r"expected \(3, 3, 14, 17\)"):
        operator(operator.light[:1])
    early = Camera(singlet(), sensor.ColourFilter.kodak(), sensor.ShotNoise(), sensor.Mosaic(), sensor.ADC())
    operator = early.linear(pictured(Draw(0)))
    with pytest.raises(ValueError, match="ShotNoise stands before Mosaic"):
        operator.record(operator(operator.light))


# ---- deepinv -----------------------------------------------------------------------------------------------------


class StandIn(nn.Module):
    """What `deepinv.physics.LinearPhysics` 0.5 does with what it is given."""

    def __init__(self, A: Any, A_adjoint: Any, img_size: Any, noise_model: Any, device: Any) -> None:
        super().__init__()
        self.forw, self.A_adj, self.img_size, self.noise_model = A, A_adjoint, img_size, noise_model
        self.to(device)

    def A(self, x: Tensor, **arguments: Any) -> Tensor:
        return self.forw(x, **arguments)

    def A_adjoint(self, y: Tensor, **arguments: Any) -> Tensor:
        return self.A_adj(y, **arguments)

    def forward(self, x: Tensor, **arguments: Any) -> Tensor:
        return self.noise_model(self.A(x), **arguments)


def check_physics(operator: LinearCamera) -> None:
    physics = operator.physics()
    x = operator.light
    torch.testing.assert_close(physics.A(x), operator(x))
    torch.testing.assert_close(physics.A_adjoint(operator(x)), operator.adjoint(operator(x)))
    torch.manual_seed(0)
    recorded = physics(x)
    torch.manual_seed(0)
    torch.testing.assert_close(recorded, operator.record(operator(x)))
    assert physics.img_size == operator.scene_shape[1:]
    assert {id(of) for of in operator.parameters()} <= {id(of) for of in physics.parameters()}


def test_physics_is_what_deepinv_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    physics = ModuleType("deepinv.physics")
    physics.LinearPhysics = StandIn
    monkeypatch.setitem(sys.modules, "deepinv", ModuleType("deepinv"))
    monkeypatch.setitem(sys.modules, "deepinv.physics", physics)
    check_physics(made("tile", torch.float32)[2])


def test_physics_is_deepinv_s_own() -> None:
    try:
        import deepinv  # noqa: F401
    except (ImportError, RuntimeError) as error:
        pytest.skip(f"deepinv does not load: {error}")
    operator = made("tile", torch.float32)[2]
    check_physics(operator)
    physics = operator.physics()
    assert abs(float(physics.adjointness_test(operator.light))) < 1e-3
    assert float(physics.compute_norm(operator.light)) == pytest.approx(operator.norm() ** 2, rel=0.02)


def test_physics_says_how_to_get_deepinv(monkeypatch: pytest.MonkeyPatch) -> None:
    *_, operator, _ = made("ideal", torch.float32)
    monkeypatch.setitem(sys.modules, "deepinv.physics", None)
    with pytest.raises(ImportError, match=r"pip install kcam\[deepinv\]"):
        operator.physics()
    broken = ModuleType("deepinv.physics")

    def failing(name: str) -> Any:
        raise RuntimeError("operator torchvision::nms does not exist")

    broken.__getattr__ = failing
    monkeypatch.setitem(sys.modules, "deepinv.physics", broken)
    with pytest.raises(ImportError, match=r"nms does not exist. Install the torchvision that was built for torch"):
        operator.physics()
