"""Light of any range: what is dark beside a lamp is as right as the lamp, and never negative."""

from __future__ import annotations

import math

import pytest
import torch
from draws import Draw
from torch import Tensor

from kcam import optics
from kcam.optics.rendering.borders import BORDERS
from kcam.optics.rendering.rounding import not_negative, wide_range
from kcam.scene import Scene
from kcam.sensor import ColourFilter
from kcam.units import mm, um, wavelength_grid

WAYS: list[dict] = [{}, {"tile": 16}, {"direct": True}, {"max_memory": 1e5}]
QUICK, ALL = range(12), range(12, 130)


def random_lens(draw: Draw) -> optics.Lens:
    focal = draw.number(10, 50) * mm
    glass = draw.one_of(
        optics.ThinLens(focal), optics.PlanoConvexLens(0.517 * focal, glass="N-BK7"), optics.ThinLens(focal)
    )
    aperture = optics.CircularAperture(focal / draw.number(6, 20))
    return optics.Lens(aperture, glass, focus_distance=draw.number(1, 5))


def lamps(draw: Draw, size: int, *, ratio: float) -> tuple[str, Tensor]:
    """A picture (1, size, size) of lamps of `ratio` on 1, on texture, on black, or half of it bright."""
    ground = draw.one_of("even", "texture", "black")
    light = {"even": torch.ones(1, size, size), "texture": 0.5 + draw.noise(1, size, size)}.get(ground)
    light = torch.zeros(1, size, size) if light is None else light
    light = light.double()
    kind = draw.one_of("points", "patch", "corner", "half")
    top, left = (int(draw.number(0, size - 6)) for _ in range(2))
    if kind == "points":
        for _ in range(draw.one_of(1, 2, 5)):
            light[:, int(draw.number(0, size)), int(draw.number(0, size))] = ratio * draw.number(0.3, 1)
    elif kind == "patch":
        light[:, top : top + 5, left : left + 5] = ratio
    elif kind == "corner":
        light[:, 0, -1] = ratio
    else:
        light[..., : size // 2] = ratio
    return f"{kind} on {ground}", light


def lamp_scene(draw: Draw, size: int) -> tuple[str, Scene]:
    """In float32: bands or factors, coloured lamps, a batch of which one item has a lamp, one depth or several."""
    ratio = 10 ** draw.number(3.7, 6.5)
    what, light = lamps(draw, size, ratio=ratio)
    count = 8
    wavelengths = wavelength_grid(count=count)
    if draw.one_of(True, False):
        colours = 0.2 + draw.noise(3)
        planes, spectra = light * colours[:, None, None], None
        scene = Scene.from_rgb((planes / planes.max())[None], depth=2.0, wavelengths=wavelengths)
        planes, spectra = scene.coefficients * planes.max(), scene.spectra
    else:
        colours = 0.2 + draw.noise(count)
        planes, spectra = (light * colours[:, None, None])[None], None
    if draw.one_of(True, False):
        planes = torch.cat([draw.noise(*planes.shape), planes])
    depth: float | Tensor = draw.number(0.8, 4)
    if draw.one_of(True, False, False):
        near, far = draw.number(0.8, 1.2), draw.number(1.3, 4)
        depth = torch.where(torch.arange(size) < draw.number(3, size - 3), near, far).expand(1, 1, size, size).double()
    planes = planes.float()
    scene = Scene(planes, spectra=spectra, wavelengths=wavelengths, depth=2.0).with_depth(
        depth.expand(len(planes), -1, -1, -1) if isinstance(depth, Tensor) else depth
    )
    return f"{what} {ratio:.2g}", scene


def check_lamps(seed: int) -> None:
    draw = Draw(seed)
    what, scene = lamp_scene(draw, draw.one_of(24, 31, 40))
    border, way, fused = draw.one_of(*BORDERS), draw.one_of(*WAYS), draw.one_of(True, False)
    stage = optics.Imaging(
        random_lens(draw), pixel_pitch=draw.number(2, 6) * um, border=border, psf_shape=(17, 15), **way
    )
    colours = ColourFilter.kodak() if fused else None
    found = stage(scene, colour_filter=colours)
    truth = stage(scene.to(dtype=torch.float64), colour_filter=colours)
    beside = 1e-6 if "half on black" in what else 1e-12  # of the brightest: where no light comes
    error = (found - truth).abs() - beside * truth.amax()
    worst = float((error / truth.clamp(min=1e-30)).max())
    print(f"{seed}: {what}, {border}, {way}, fused {fused}, {tuple(scene.coefficients.shape)}: {worst:.1e}")
    assert found.dtype == torch.float32
    assert worst < 1e-3
    assert float(found.min()) >= 0


@pytest.mark.parametrize("seed", QUICK)
def test_what_is_dark_beside_lamps_is_right(seed: int) -> None:
    """5e3 : 1 to 3e6 : 1 in float32, against float64: each pixel to 1e-3 of itself, and none negative."""
    check_lamps(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", ALL)
def test_what_is_dark_beside_lamps_is_right_in_many_scenes(seed: int) -> None:
    check_lamps(seed)


@pytest.mark.parametrize("ratio", [1.0, 1e3, 3.9e3, 1e5, 3e6, 1e8, 1e12])
@pytest.mark.parametrize("kind", ["one", "patch"])
def test_no_range_is_left_out(ratio: float, kind: str) -> None:
    """On both sides of the step to float64, and beyond what the issue asks."""
    light = torch.ones(1, 1, 48, 48, dtype=torch.float64)
    side = 1 if kind == "one" else 6
    light[..., 10 : 10 + side, 20 : 20 + side] = ratio
    scene = Scene.from_bands(light.expand(-1, 8, -1, -1).float(), wavelengths=wavelength_grid(count=8), depth=1.5)
    lens = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), focus_distance=2.0)
    stage = optics.Imaging(lens, pixel_pitch=4 * um, psf_shape=(21, 21))
    found, truth = stage(scene), stage(scene.to(dtype=torch.float64))
    assert float(((found - truth).abs() / truth).max()) < 1e-3
    assert float(found.min()) > 0


@pytest.mark.parametrize("scale", [1e-8, 1e-3, 1e6])
def test_the_unit_of_light_decides_nothing(scale: float) -> None:
    light = torch.ones(1, 4, 20, 20)
    light[..., 3, 3] = 1e5
    wavelengths = wavelength_grid(count=4)
    assert wide_range(Scene.from_bands(scale * light, wavelengths=wavelengths))
    light[..., 3, 3] = 1e3
    assert not wide_range(Scene.from_bands(scale * light, wavelengths=wavelengths))
    assert not wide_range(Scene.from_bands(0 * light, wavelengths=wavelengths))


@pytest.mark.parametrize("name", ["astronaut", "coffee", "chelsea", "rocket", "hubble_deep_field", "retina"])
def test_pictures_of_8_bits_stay_in_float32(name: str) -> None:
    """They are not slower: black sky, black borders and stars included."""
    data = pytest.importorskip("skimage.data")
    picture = torch.tensor(getattr(data, name)())[..., :3].permute(2, 0, 1)[None] / 255
    assert not wide_range(Scene.from_rgb(picture))


def test_one_s_own_precision_is_kept() -> None:
    light = torch.ones(1, 4, 20, 20)
    light[..., 3, 3] = 1e6
    scene = Scene.from_bands(light, wavelengths=wavelength_grid(count=4))
    lens = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), focus_distance=2.0)
    own, single, double = (
        optics.Imaging(lens, psf_shape=(9, 9), precision=precision)(scene) for precision in (None, "float32", "float64")
    )
    assert torch.equal(own, double)
    assert not torch.equal(own, single)
    wide, narrow = (optics.Imaging(lens, psf_shape=(9, 9), precision=p).work(scene) for p in (None, "float32"))
    assert wide.operations["transform"] > 1.5 * narrow.operations["transform"]


@pytest.mark.parametrize("ground", [0.0, 1.0])
@pytest.mark.parametrize("factored", [True, False])
def test_gradients_beside_a_lamp(factored: bool, ground: float) -> None:
    """To the scene, the lens and the filter; also of pixels whose light rounding would have taken below 0."""
    light = torch.full((1, 3 if factored else 6, 20, 20), ground)
    light[..., 7, 9] = 1e6
    spectra = (0.1 + Draw(3).noise(3, 6)).float() if factored else None
    weight = Draw(4).noise(1, 3, 20, 20)
    found = []
    for dtype in (torch.float32, torch.float64):
        planes = light.to(dtype).requires_grad_()
        phase = torch.nn.Parameter(Draw(5).noise(12, 12).to(dtype))
        colours = ColourFilter.kodak().to(dtype)
        lens = optics.Lens(
            optics.CircularAperture(2 * mm), optics.ThinLens(20 * mm), optics.DOE(phase), focus_distance=2.0
        )
        scene = Scene(planes, spectra=spectra, wavelengths=wavelength_grid(count=6), depth=1.0)
        picture = optics.Imaging(lens, pixel_pitch=4 * um, psf_shape=(11, 11))(scene, colour_filter=colours)
        inputs = (planes, phase, *(p for p in colours.parameters() if p.requires_grad))
        found.append(torch.autograd.grad((picture * weight.to(dtype)).sum(), inputs))
    for single, double in zip(*found, strict=True):
        assert float((single - double).norm() / double.norm()) < 1e-5


def test_only_what_cannot_be_below_0_is_not() -> None:
    """A filter with negative weights may give less than nothing; gradients pass whatever is taken away."""
    light = torch.tensor([-1e-9, 0.5, math.inf]).expand(1, 2, 1, 3).clone().requires_grad_()
    found = not_negative(light, torch.tensor([[0.3, 0.0], [0.3, -0.1]]))
    assert found[0, :, 0].tolist() == [[0.0, 0.5, math.inf], light[0, 1, 0].tolist()]
    found.sum().backward()
    assert torch.equal(light.grad, torch.ones_like(light))
    assert float(not_negative(light, None).detach().min()) == 0
