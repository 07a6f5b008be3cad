"""Veiling glare against Harvey's law in closed form, an explicit world of mirrors, and the bands."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from draws import Draw
from scipy import integrate
from torch import Tensor, nn

from kcam import Camera, Context, Scene, isp, optics, sensor
from kcam.optics.glare import glare_transfer
from kcam.units import mm, nm, um

LAWS = range(6)


def law(seed: int) -> dict[str, float]:
    """Harvey's law of any core from a twentieth of a pixel to the whole picture, in pixels; 2 is a slope of its own."""
    draw = Draw(seed)
    slope = 2.0 if seed == 0 else draw.number(0.8, 3.5)
    return {"core": 10 ** draw.number(-1.3, 1.5), "slope": slope, "reach": 10 ** draw.number(2.5, 3.5)}


def density(radius: float, *, core: float, slope: float, reach: float) -> float:
    return (1 + (radius / core) ** 2) ** (-slope / 2) if radius <= reach else 0.0


def power(radius: float, law: dict[str, float]) -> float:
    """Of the law within a radius, by quadrature in its logarithm."""

    def ring(u: float) -> float:
        return 2 * math.pi * math.exp(2 * u) * density(math.exp(u), **law)

    return integrate.quad(ring, -25, math.log(radius), limit=400)[0]


def point(*shape: int) -> Tensor:
    light = torch.zeros(1, 1, *shape, dtype=torch.float64)
    light[..., shape[0] // 2, shape[1] // 2] = 1.0
    return light


@pytest.mark.parametrize("seed", LAWS)
def test_the_share_within_an_angle_is_harvey_s_law_integrated(seed: int) -> None:
    own, draw = law(seed), Draw(100 + seed)
    for _ in range(5):
        radius = own["reach"] * 10 ** draw.number(-3, 0)
        assert float(optics.scattered_within(radius, **own)) == pytest.approx(
            power(radius, own) / power(own["reach"], own), rel=1e-6
        )


def test_slopes_near_two_are_no_special_case() -> None:
    near = [float(optics.scattered_within(0.1, core=0.01, slope=2 + step)) for step in (-1e-5, -1e-9, 0, 1e-9, 1e-5)]
    assert near == sorted(near)
    assert near[3] - near[1] < 1e-8
    assert near[4] - near[2] == pytest.approx(near[2] - near[0], rel=1e-3)


@pytest.mark.parametrize("seed", LAWS)
def test_light_is_conserved_in_a_world_of_mirrors(seed: int) -> None:
    draw, own = Draw(seed), law(seed)
    shape = draw.one_of((17, 23), (1, 1), (1, 30), (48, 5), (32, 32))
    light, share = draw.noise(2, 2, *shape), draw.number(0, 0.9)
    spread = optics.veiling_glare(light, share=share, **own)
    torch.testing.assert_close(spread.sum((-2, -1)), light.sum((-2, -1)), rtol=1e-12, atol=0)
    even = torch.full_like(light, 0.7)
    torch.testing.assert_close(optics.veiling_glare(even, share=share, **own), even, rtol=1e-12, atol=0)
    assert (spread >= 0).all()


@pytest.mark.parametrize("seed", LAWS)
def test_a_point_keeps_its_share_and_spreads_the_rest_by_the_law(seed: int) -> None:
    own, share, size = law(seed), 0.3, 129
    spread = optics.veiling_glare(point(size, size), share=share, border="zero", **own)[0, 0]
    y, x = (torch.arange(size, dtype=torch.float64) - size // 2 for _ in "yx")
    radius = torch.hypot(y[:, None], x)
    for within in (10.0, 30.0, 60.0):
        found = float(spread[radius <= within].sum())
        rim = math.sqrt(float((radius <= within).sum()) / math.pi)  # of a disc with as many pixels
        expected = 1 - share + share * float(optics.scattered_within(rim, **own))
        assert found == pytest.approx(expected, abs=2e-3 * share)
    # pixel by pixel: the middle, one beside it and one in the tail
    for dy, dx in ((0, 1), (2, 2), (7, 20)):
        exact = integrate.dblquad(
            lambda b, a: density(math.hypot(a, b), **own), dy - 0.5, dy + 0.5, dx - 0.5, dx + 0.5
        )[0] / power(own["reach"], own)
        assert float(spread[size // 2 + dy, size // 2 + dx]) == pytest.approx(share * exact, rel=5e-3)


@pytest.mark.parametrize("seed", range(3))
def test_mirrors_are_what_a_world_of_mirrored_pictures_gives(seed: int) -> None:
    """Written out: 9 x 9 pictures, each point's tail by its density; beyond those light is taken as even."""
    draw, n, repeats = Draw(seed), 12, 9
    own = {"core": draw.number(2, 6), "slope": draw.number(1.6, 2.6), "reach": 1000.0}
    light = draw.noise(n, n)
    row = [light if i % 2 == 0 else light.flip(-1) for i in range(repeats)]
    world = torch.cat([torch.cat(row, 1) if i % 2 == 0 else torch.cat(row, 1).flip(0) for i in range(repeats)], 0)
    side, first = torch.arange(n * repeats, dtype=torch.float64), (repeats // 2) * n
    nodes = torch.tensor([-0.4, -0.2, 0.0, 0.2, 0.4], dtype=torch.float64)
    glare, total = torch.empty(n, n, dtype=torch.float64), power(1000.0, own)
    for y in range(n):
        for x in range(n):
            dy, dx = (side - first - y)[:, None] + nodes, (side - first - x)[:, None] + nodes
            tail = (1 + (dy[:, :, None, None] ** 2 + dx**2) / own["core"] ** 2) ** (-own["slope"] / 2)
            kernel = tail.mean((1, 3)) / total
            glare[y, x] = (world * kernel).sum() + (1 - kernel.sum()) * light.mean()
    if (repeats // 2) % 2:
        glare = glare.flip(0, 1)
    found = optics.veiling_glare(light[None, None], share=0.5, **own)[0, 0]
    torch.testing.assert_close(found, 0.5 * light + 0.5 * glare, rtol=0, atol=2e-3)


@pytest.mark.parametrize("radius", [6.0, 15.0, 30.0])
def test_a_black_spot_has_its_veiling_glare_index(radius: float) -> None:
    """ISO 9358: what is recorded in the middle of black, of the white around it."""
    size, share, angle = 201, 0.03, 1 / 2000
    y = torch.arange(size, dtype=torch.float64) - size // 2
    white = (torch.hypot(y[:, None], y) > radius).double()[None, None]
    stage = optics.VeilingGlare(share, core=0.002, slope=2.2, focal_length=8 * mm)
    found = float(stage(white, Context(pixel_pitch=4 * um))[0, 0, size // 2, size // 2])
    black = float((white == 0).sum())
    rim = math.sqrt(black / math.pi) * angle
    expected = share * (1 - float(optics.scattered_within(rim, core=0.002, slope=2.2)))
    assert expected * (1 - black / size**2) < found < expected * 1.001  # mirrors have black spots too


def test_the_transfer_function_is_real_and_one_for_even_light() -> None:
    transfer = glare_transfer((9, 14), core=1.5, slope=1.8, reach=300.0, border="mirror")
    assert transfer.shape == (18, 15)
    assert float(transfer[0, 0]) == pytest.approx(1.0, abs=1e-12)
    assert transfer.abs().max() <= 1 + 1e-12


def test_smooth_surfaces_scatter_by_the_square_of_the_wavelength() -> None:
    roughness = 4 * math.pi * 2 * nm  # an RMS of 2 nm, seen twice
    grid = torch.tensor([450.0, 550.0, 650.0], dtype=torch.float64) * nm
    exact = 1 - torch.exp(-((roughness / grid) ** 2))
    torch.testing.assert_close(optics.scattered_share(float(exact[1]), grid), exact, rtol=1e-12, atol=0)
    gray = optics.scattered_share(0.02, grid, power=0.0)
    torch.testing.assert_close(gray, torch.full_like(gray, 0.02), rtol=1e-12, atol=0)


FILTERS = {"kodak": (sensor.ColourFilter.kodak, 0.08), "nikon": (sensor.ColourFilter.nikon, 0.08)}
FILTERS |= {"sigma": (sensor.ColourFilter.sigma, 0.12)}


@pytest.mark.parametrize("name", FILTERS)
def test_channels_come_near_to_the_bands(name: str) -> None:
    build, most = FILTERS[name]
    stages, stage = build(), optics.VeilingGlare(0.03, core=0.003, focal_length=4 * mm)
    for scene, bound in (
        (Scene.builtin("colour_chart", 64), most),
        (Scene.from_rgb((torch.rand(1, 48, 48, generator=torch.Generator().manual_seed(1))).expand(3, -1, -1)), 1e-3),
    ):
        context = Camera(stage, stages).resolve(scene)
        bands = scene.bands().double()
        sharp = stages(bands, context)
        exact, near = stages(stage(bands, context), context), stage(sharp, context)
        off = (near - exact).square().mean((0, 2, 3)).sqrt() / (exact - sharp).square().mean((0, 2, 3)).sqrt()
        assert float(off.max()) < bound


def test_blue_is_scattered_more_than_red() -> None:
    shares, cores = optics.VeilingGlare(0.02).scattering(3, Context(colour_filter=sensor.ColourFilter.kodak()))
    assert shares[2] > shares[1] > shares[0]
    assert cores[2] < cores[1] < cores[0]
    assert float(shares[1]) == pytest.approx(0.02, rel=0.1)  # green is about at 550 nm


def test_gradients_are_those_of_finite_differences() -> None:
    light = Draw(0).noise(1, 2, 4, 5).requires_grad_()
    numbers = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.1, 0.7, 1.7)]

    def spread(light: Tensor, share: Tensor, core: Tensor, slope: Tensor) -> Tensor:
        return optics.veiling_glare(light, share=share, core=core, slope=slope, reach=50.0)

    assert torch.autograd.gradcheck(spread, (light, *numbers))
    numbers[2] = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)  # where the law's integral is a logarithm
    assert torch.autograd.gradcheck(spread, (light, *numbers))


@pytest.mark.parametrize("channels", [3, 7])
@pytest.mark.slow
def test_the_stage_s_own_numbers_train(channels: int) -> None:
    grid = torch.linspace(430, 690, 7, dtype=torch.float64) * nm
    context = Context(wavelengths=grid, colour_filter=sensor.ColourFilter.kodak(), pixel_pitch=100 * um)
    light = Draw(1).noise(1, channels, 3, 4)

    def spread(*numbers: Tensor) -> Tensor:
        stage = optics.VeilingGlare(0.1, core=0.2, slope=1.9, power=1.5, focal_length=4 * mm)
        for name, value in zip(("share", "core", "slope", "power", "focal_length"), numbers, strict=True):
            delattr(stage, name)
            setattr(stage, name, value)
        return stage(light, context)

    values = [0.1, 0.2, 1.9, 1.5, 4 * mm]
    given = tuple(torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in values)
    assert torch.autograd.gradcheck(spread, given, eps=1e-7, atol=1e-5)


def test_a_filter_that_trains_learns_what_its_light_scatters() -> None:
    """Its curves decide which share of a channel's light is scattered too."""
    grid = torch.linspace(430, 690, 5, dtype=torch.float64) * nm
    bands, stage = Draw(5).noise(1, 5, 3, 4), optics.VeilingGlare(0.3, core=0.1, focal_length=4 * mm)

    def hazy(coefficients: Tensor) -> Tensor:
        own = sensor.ColourFilter.kodak()
        del own.coefficients
        own.coefficients = coefficients
        return Camera(own, stage, context=Context(wavelengths=grid, pixel_pitch=100 * um))(bands)

    coefficients = (0.1 + Draw(6).noise(3, 12)).requires_grad_()
    assert torch.autograd.gradcheck(hazy, (coefficients,), atol=1e-6)
    blind = torch.zeros(3, 12, dtype=torch.float64)
    assert torch.equal(hazy(blind), torch.zeros(1, 3, 3, 4, dtype=torch.float64))


@pytest.mark.parametrize("share", [0.0, 1e-12])
def test_without_scatter_there_is_a_slope_to_start_from(share: float) -> None:
    own = nn.Parameter(torch.tensor(share, dtype=torch.float64))
    context = Context(colour_filter=sensor.ColourFilter.kodak(), pixel_pitch=4 * um)
    light = Draw(7).noise(1, 3, 6, 6)
    hazy = optics.VeilingGlare(own, focal_length=8 * mm)(light, context)
    torch.testing.assert_close(hazy.detach(), light, rtol=0, atol=1e-11)
    hazy.square().sum().backward()
    assert own.grad is not None
    assert float(own.grad) < 0


def test_a_parameter_trains_and_what_is_kept_is_renewed() -> None:
    share = nn.Parameter(torch.tensor(0.1))
    stage = optics.VeilingGlare(share, focal_length=8 * mm)
    light = Draw(2).noise(1, 1, 6, 6)
    stage(light).square().sum().backward()
    assert share.grad is not None
    assert float(share.grad) < 0  # more glare is less contrast
    fixed = optics.VeilingGlare(0.1, core=0.01, focal_length=8 * mm)
    first = fixed(light)
    assert torch.equal(first, fixed(light))
    fixed.core = 0.0001
    assert not torch.allclose(first, fixed(light))
    torch.testing.assert_close(fixed(light), optics.VeilingGlare(0.1, core=0.0001, focal_length=8 * mm)(light))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(0, 3, 4, 4), (2, 3, 1, 1), (1, 1, 1, 9), (1, 4, 5, 3), (1, 1, 0, 4)])
def test_any_shape_and_dtype(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    light = torch.rand(shape, generator=torch.Generator().manual_seed(0)).to(dtype).requires_grad_()
    spread = optics.VeilingGlare(focal_length=8 * mm)(light)
    assert spread.shape == light.shape
    assert spread.dtype == dtype
    assert spread.isfinite().all()
    spread.sum().backward()
    assert light.grad is not None
    assert light.grad.isfinite().all()


def test_a_lamp_in_the_dark_makes_no_dark_negative() -> None:
    light = 1e12 * point(64, 64).float()
    spread = optics.VeilingGlare(0.02, core=0.001, focal_length=50 * mm)(light)
    assert (spread >= 0).all()
    assert float(spread.sum()) == pytest.approx(1e12, rel=1e-6)
    assert torch.equal(optics.VeilingGlare(0.02, focal_length=8 * mm)(0 * light), 0 * light)


def test_the_lens_says_how_large_an_angle_is() -> None:
    thin = optics.Lens(optics.CircularAperture(4 * mm), optics.ThinLens(50 * mm), sensor_distance=52 * mm)
    light, stage = Draw(3).noise(1, 1, 9, 9), optics.VeilingGlare(0.2, core=0.001)
    same = optics.VeilingGlare(0.2, core=0.001, focal_length=52 * mm)(light)
    torch.testing.assert_close(stage(light, Context(lens=thin)), same)
    real = optics.CompoundLens.preset("ef50")
    scale = float(real.image_scale)
    assert scale == pytest.approx(real.focal_length(), rel=1e-3)
    same = optics.VeilingGlare(0.2, core=0.001, focal_length=scale)(light)
    torch.testing.assert_close(stage(light, Context(lens=real)).detach(), same)


def camera(*behind_the_lens: nn.Module) -> Camera:
    lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(20 * mm), focus_distance=2.0)
    imaging = optics.Imaging(lens, pixel_pitch=4 * um, psf_shape=(9, 9))
    stages = [sensor.Mosaic(), sensor.Exposure(), sensor.ADC(bits=12), isp.Demosaic(), isp.ToneCurve()]
    return Camera(imaging, *behind_the_lens, *stages)


def test_a_camera_with_glare_is_saved_and_is_linear(tmp_path: Path) -> None:
    scene = Scene.from_rgb(torch.rand(3, 12, 14, generator=torch.Generator().manual_seed(0))).to(dtype=torch.float64)
    kodak, glare = sensor.ColourFilter.kodak(), optics.VeilingGlare(torch.tensor(0.2), core=0.002, border="zero")
    for shot in (camera(kodak, glare), camera(glare, kodak)):
        with torch.no_grad():
            shot.save(tmp_path / "hazy.safetensors")
            assert torch.equal(Camera.load(tmp_path / "hazy.safetensors")(scene), shot(scene))
        a = shot.linear(scene)
        draw = Draw(4)
        x, y = draw.noise(*a.scene_shape), draw.noise(*a.raw_shape)
        assert float((a(x) * y).sum()) == pytest.approx(float((x * a.adjoint(y)).sum()), rel=1e-9)


@pytest.mark.parametrize(
    ("build", "text"),
    [
        (lambda: optics.VeilingGlare(1.5), r"share must be a number from 0 to 0.999, got 1.5"),
        (lambda: optics.VeilingGlare(-0.1), r"share must be a number from 0 to 0.999, got -0.1"),
        (lambda: optics.VeilingGlare(core=0.0), r"core must be a number from 1e-06 to 1, got 0"),
        (lambda: optics.VeilingGlare(slope=9), r"slope must be a number from 0.1 to 6, got 9"),
        (lambda: optics.VeilingGlare(power=float("nan")), r"power must be a number from 0 to 4, got nan"),
        (lambda: optics.VeilingGlare(torch.ones(2)), r"share must be .* got 2 of them"),
        (lambda: optics.VeilingGlare(wavelength=550), r"did you mean 550 \* nm"),
        (lambda: optics.VeilingGlare(border="reflect"), r"unknown border 'reflect'; known: mirror, zero"),
        (lambda: optics.VeilingGlare(10), r"share must be .*got 10. It is a share, not percent; did you mean 0.1\?"),
        (lambda: optics.VeilingGlare(0.1, focal_length=8), r"focal_length 8 is outside .*did you mean 8 \* mm\?"),
        (lambda: optics.VeilingGlare(focal_length=-1.0), r"focal_length -1 is outside .* such as 8 \* mm"),
        (lambda: optics.VeilingGlare()(torch.rand(1, 1, 4, 4)), r"no lens that says so: .* give focal_length=50 \* mm"),
        (
            lambda: optics.VeilingGlare(focal_length=8 * mm)(
                torch.rand(1, 1, 4, 4), Context(colour_filter=sensor.ColourFilter.kodak())
            ),
            r"one plane behind a filter of 3 curves, a mosaic: .* Put it before the Mosaic",
        ),
        (
            lambda: optics.veiling_glare(torch.rand(3, 4, 4), share=torch.rand(2), core=1.0, slope=2.0, reach=9.0),
            r"share has 2 values for 3 channels",
        ),
        (
            lambda: optics.veiling_glare(torch.rand(4, 4), share=0.1, core=1.0, slope=2.0, reach=9.0),
            r"expected \(..., C, H, W\), got shape \(4, 4\). Use signal\[None\]",
        ),
    ],
)
def test_errors(build, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        build()
