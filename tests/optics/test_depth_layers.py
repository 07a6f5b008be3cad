"""Layers of depth on scenes that are against them: lone points between two, colours that hide colours, few layers."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from draws import Draw
from torch import Tensor

from kcam import Camera, optics
from kcam.context import Context
from kcam.optics.numerics import bracketed
from kcam.optics.rendering import depth as depth_module
from kcam.optics.rendering.depth import Layers, few_values, layer_shares
from kcam.optics.rendering.renderer import Renderer
from kcam.scene import Scene
from kcam.sensor import ColourFilter
from kcam.units import mm, um, wavelength_grid

QUICK, ALL = range(3), range(3, 50)
BANDS = 10


def random_lens(draw: Draw, kind: str) -> optics.Lens:
    """An ideal lens, a singlet whose colours are in focus at different distances, or that behind a rough DOE."""
    focal = draw.number(10, 50) * mm
    glass: optics.Element = optics.ThinLens(focal)
    if kind != "ideal":
        name, index = draw.one_of(("N-BK7", 1.517), ("N-SF11", 1.785))
        glass = optics.PlanoConvexLens((index - 1) * focal, glass=name)
    others = (optics.DOE(draw.number(0, 12) * draw.noise(24, 24)),) if kind == "rough" else ()
    aperture = optics.CircularAperture(focal / draw.number(6, 20))
    return optics.Lens(aperture, glass, *others, focus_distance=draw.one_of(0.5, 1.0, 2.0, 5.0))


def largest(found: Tensor, truth: Tensor) -> float:
    """Largest error, of the channel's largest value."""
    return float(((found - truth).abs().amax((-2, -1)) / truth.amax((-2, -1))).max())


# ---- between the layers ------------------------------------------------------------------------------------------


def between_layers(seed: int, kind: str) -> tuple[float, float]:
    """Largest error of (the channels, the bands) of light midway between two layers, of their largest value.

    The map holds many distances: a dark strip at its lower edge, out of the window's reach, runs over half a wave.
    """
    draw = Draw(seed)
    lens = random_lens(draw, draw.one_of("ideal", "singlet", "rough"))
    semi = float(lens.aperture.semi_aperture())
    wavelengths = wavelength_grid(count=BANDS)
    distance = lens.query(wavelengths, distances=2.0, pixel_pitch=4 * um, shape=(1, 1)).sensor_distance
    pitch = draw.number(0.4, 1.4) * float(distance) / (2 * semi) * 0.55 * um
    stage = optics.Imaging(lens, pixel_pitch=pitch, border="zero", psf_shape=(25, 25))
    step, steps = (0.125, 3) if kind != "lamp" else (0.0625, 5)
    wave = 2 * float(wavelengths.min()) / semi**2
    middle = max(1 / lens.focus_distance + draw.number(-3, 3) * wave, 0.3 * wave)
    half = 0.499 * steps * step * wave
    low, high = middle - half, middle + half
    size = 44
    vergence = torch.full((size, size), middle, dtype=torch.float64)
    vergence[-2:] = torch.linspace(low, high, 2 * size, dtype=torch.float64).view(2, size)
    light = torch.zeros(BANDS, size, size, dtype=torch.float64)
    if kind == "noise":
        light[:] = draw.noise(BANDS, size, size)
    elif kind == "point":
        light[:] = 0.001  # so that it is no lamp
        light[:, 14, 20] = 1
    else:
        light[:] = 1e-5
        light[:, 14, 20] = 1
    light[:, -2:] = 0
    scene = Scene.from_bands(light, wavelengths=wavelengths, depth=2.0)
    mapped = scene.with_depth(1 / vergence[None, None])
    errors = []
    for colours in (ColourFilter.kodak(), None):
        found, truth = (stage(s, colour_filter=colours)[..., :28, :] for s in (mapped, scene.with_depth(1 / middle)))
        errors.append(largest(found, truth))
    layers = stage.layers_of(mapped, mapped.coefficients)[0]
    assert float(layers.diff().max()) / wave == pytest.approx(step, rel=0.01)
    assert float((layers - middle).abs().min()) / wave == pytest.approx(step / 2, rel=0.01)
    return errors[0], errors[1]


BETWEEN = {"noise": (0.01, 0.02), "point": (0.08, 0.10), "lamp": (0.02, 0.025)}


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", BETWEEN)
def test_light_between_two_layers(kind: str, seed: int) -> None:
    """At worst, midway, of the largest value: noise, a lone point, and a lamp, which has layers half as far apart."""
    check_between(seed, kind)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2, 40))
@pytest.mark.parametrize("kind", BETWEEN)
def test_light_between_two_layers_of_many_lenses(kind: str, seed: int) -> None:
    check_between(seed, kind)


def check_between(seed: int, kind: str) -> None:
    channels, bands = between_layers(seed, kind)
    print(f"{kind} {seed}: channels {channels:.4f}, bands {bands:.4f}")
    assert channels < BETWEEN[kind][0]
    assert bands < BETWEEN[kind][1]


@pytest.mark.parametrize("border", optics.imaging.BORDERS)
def test_two_layers_of_one_blur_are_one_convolution(border: str) -> None:
    """Whatever the border: beyond zeros it is dark, and what is at the border does not shine to make up for it."""
    scene = scene_of(2.0)
    nearly = scene.with_depth(planes_of(2.0, 2.0 + 1e-7))
    stage = imaging(border=border)
    assert largest(stage(nearly), stage(scene)) < 1e-6


# ---- distances ---------------------------------------------------------------------------------------------------


def planes_of(*distances: float, size: int = 24, seed: int = 1) -> Tensor:
    """A map of these distances, each somewhere."""
    index = torch.randint(len(distances), (1, 1, size, size), generator=torch.Generator().manual_seed(seed))
    index[0, 0, 0, : len(distances)] = torch.arange(len(distances))
    return torch.tensor(distances, dtype=torch.float64)[index]


def simple_lens() -> optics.Lens:
    return optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), focus_distance=2.0)


def imaging(**arguments) -> optics.Imaging:
    return optics.Imaging(simple_lens(), **({"pixel_pitch": 4 * um, "psf_shape": (21, 21)} | arguments))


def scene_of(depth: float | Tensor, *, size: int = 24, bands: int = 3) -> Scene:
    light = torch.rand(bands, size, size, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    return Scene.from_bands(light, wavelengths=wavelength_grid(count=bands), depth=depth)


@pytest.mark.parametrize("distances", [(0.7, 2.0), (0.7, 1.1, 5.0), (0.6, 0.9, 1.3, math.inf)])
def test_few_distances_are_layers_of_their_own(distances: tuple[float, ...]) -> None:
    """A map of objects on few planes is cut into these, and nothing is interpolated; said or found."""
    scene = scene_of(planes_of(*distances))
    stage = imaging()
    layers = stage.depth_layers(scene.depth, scene.wavelengths)
    assert torch.equal(layers, 1 / torch.tensor(sorted(distances, reverse=True), dtype=torch.float64))
    for given in (distances, list(distances), torch.tensor(distances, dtype=torch.float64), distances * 2):
        assert torch.equal(imaging(layers=given)(scene), stage(scene))
    fine = imaging(layers=2000)(scene)  # 0.01 waves apart
    assert float((stage(scene) - fine).abs().max() / fine.max()) < 2e-3


def test_a_number_is_a_number_of_layers_whoever_counted() -> None:
    assert imaging(layers=np.int64(3)).layers == 3
    assert imaging(layers=3.0).layers == (3.0,)
    assert imaging(layers=np.array([1.0, 3.0])).layers == (3.0, 1.0)


def test_a_camera_of_given_distances_is_planned() -> None:
    scene = scene_of(planes_of(0.7, 1.1, 5.0), bands=6)
    camera = Camera(imaging(layers=(0.7, 1.1, 5.0)), ColourFilter.kodak())
    plan = camera.plan(scene, tolerance=0.01)
    found, truth = plan.apply(camera)(scene), camera(scene)
    assert float((found - truth).detach().norm() / truth.detach().norm()) < 0.01


def test_a_map_that_trains_is_cut_into_equal_steps() -> None:
    depth = planes_of(0.7, 1.1, 5.0).requires_grad_()
    layers = imaging().depth_layers(depth, wavelength_grid(count=3)).detach()
    assert len(layers) > 3
    torch.testing.assert_close(layers.diff(), layers.diff()[:1].expand(len(layers) - 1))


def test_many_distances_are_equal_steps() -> None:
    depth = 1 / torch.linspace(0.2, 1.4, 576, dtype=torch.float64).view(1, 1, 24, 24)
    layers = imaging().depth_layers(depth, wavelength_grid(count=3))
    assert (float(layers[0]), float(layers[-1])) == (pytest.approx(0.2), pytest.approx(1.4))
    torch.testing.assert_close(layers.diff(), layers.diff()[:1].expand(len(layers) - 1))


def test_shares_of_uneven_layers() -> None:
    layers = torch.tensor([0.0, 0.1, 1.0], dtype=torch.float64)
    vergence = torch.tensor([-1.0, 0.0, 0.05, 0.1, 0.325, 1.0, 2.0], dtype=torch.float64).view(1, 1, 1, 7)
    expected = [[1, 1, 0.5, 0, 0, 0, 0], [0, 0, 0.5, 1, 0.75, 0, 0], [0, 0, 0, 0, 0.25, 1, 1]]
    torch.testing.assert_close(layer_shares(vergence, layers)[0, :, 0], torch.tensor(expected, dtype=torch.float64))
    nearest = layer_shares(vergence, layers, interpolate=False)[0, :, 0]
    assert torch.equal(nearest.sum(0), torch.ones(7, dtype=torch.float64))
    assert nearest[1].tolist() == [0, 0, 0, 1, 1, 0, 0] or nearest[1].tolist() == [0, 0, 1, 1, 1, 0, 0]
    inner = torch.tensor([0.03, 0.07, 0.3, 0.8], dtype=torch.float64).view(1, 1, 2, 2).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: layer_shares(v, layers), inner)


@pytest.mark.parametrize(
    ("layers", "few"),
    [
        (3, True),
        (1, True),
        (200, False),
        (None, False),
        ((0.7, 1.1, 5.0), False),
        ((0.7, 5.0), True),
        ((2.0,), True),
        ((0.7, 1.1, 1.9, 5.0, math.inf), False),
        ((1.1, 5.0), True),
    ],
)
def test_too_few_layers_are_said(layers: int | tuple[float, ...] | None, few: bool) -> None:
    """Of three distances: equal steps, that miss the middle one, and layers that leave one out or end before it."""
    scene = scene_of(planes_of(0.7, 1.1, 5.0))
    stage = imaging(layers=layers)
    if few:
        with pytest.warns(UserWarning, match=r"layers=.* lie up to .* waves of defocus from the map's distances \(at"):
            stage(scene)
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            stage(scene)
            imaging(layers=3).changed(layers=2)(scene)  # as a plan does, which has weighed it
            imaging(layers=3, blur=False)(scene)


@pytest.mark.parametrize("layers", [(0.7, 1.1, math.inf), 5, None])
def test_distances_are_saved(tmp_path, layers: int | tuple[float, ...] | None) -> None:
    Camera(imaging(layers=layers, coverage="band")).save(tmp_path / "camera.safetensors")
    loaded = Camera.load(tmp_path / "camera.safetensors")[0]
    assert loaded.coverage == "band"
    scene = scene_of(planes_of(0.7, 1.1, 5.0))
    assert torch.equal(loaded(scene), imaging(layers=layers)(scene))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"layers": ()}, r"layers holds no distance; give some, such as layers=\(0.5, 2.0\) in metres"),
        ({"layers": (0.5, -1.0)}, "distance -1 is not a distance in front of the lens"),
        ({"layers": (0.5, 0.0)}, "distance 0 is not a distance in front of the lens"),
        ({"coverage": "wavelength"}, "unknown coverage 'wavelength'; known: channel, band"),
    ],
)
def test_bad_layers_say_what_is_wrong(arguments: dict, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        imaging(**arguments)


@pytest.mark.parametrize("layers", ["a", (1, None), {2.0}, True, 2 + 1j])
def test_what_names_no_layers_is_said(layers) -> None:
    with pytest.raises(TypeError, match="layers must be a number, distances in metres"):
        imaging(layers=layers)


# ---- colours that hide colours -----------------------------------------------------------------------------------


def colour_scene(draw: Draw, size: int = 32) -> tuple[str, Scene]:
    """Colours before others: spectra that share no band, sRGB primaries, blocks, or each pixel by itself."""
    kind = draw.one_of("bands", "line", "sRGB edge", "blocks", "random")
    near, far = draw.number(0.45, 1.5), draw.number(1.5, 6)
    left = (torch.arange(size) < size // 2).double()
    edge = torch.where(left > 0, near, far).expand(1, 1, size, size)
    index = torch.arange(28)
    if kind in ("bands", "line"):
        cut = 1 + draw.one_of(*range(26))
        first = (index < cut) if kind == "bands" else (index == cut)
        second = ~first if kind == "bands" else (index == draw.one_of(*range(28)))
        first, second = (first, second) if draw.one_of(True, False) else (second, first)
        light = first.double()[:, None, None] * left + second.double()[:, None, None] * (1 - left)
        return kind, Scene.from_bands(light.expand(28, size, size), depth=edge)
    if kind == "sRGB edge":
        picture = torch.zeros(1, 3, size, size, dtype=torch.float64)
        one, two = torch.randperm(3, generator=draw.generator)[:2].tolist()
        picture[:, one], picture[:, two] = left, 1 - left
        return kind, Scene.from_rgb(picture, depth=edge)
    side = 1 if kind == "random" else draw.one_of(4, 8)
    picture = draw.noise(1, 3, size // side, size // side)
    picture = (picture > 0.5).double() if draw.one_of(True, False) else picture
    places = 1 / far + (1 / near - 1 / far) * draw.noise(1, 1, size // side, size // side)
    maps = (m.repeat_interleave(side, -1).repeat_interleave(side, -2) for m in (picture, places))
    picture, places = maps
    return kind, Scene.from_rgb(picture, depth=1 / places)


COVERAGE = {"ideal": 0.06, "singlet": 0.3, "rough": 0.3}


def check_coverage(seed: int, lens: str) -> None:
    draw = Draw(seed)
    kind, scene = colour_scene(draw)
    colours = ColourFilter.kodak() if draw.one_of(True, False) else ColourFilter.learned(tile=4)
    stage = optics.Imaging(random_lens(draw, lens), pixel_pitch=draw.one_of(2, 4, 6) * um, layers=4, psf_shape=(33, 33))
    with torch.no_grad():
        truth = colours(stage(scene), Context(wavelengths=scene.wavelengths))
        channel, band = (stage.changed(coverage=c)(scene, colour_filter=colours) for c in ("channel", "band"))
    error = float((channel - truth).abs().max() / truth.max())
    print(f"{lens} {seed}: {kind}: {error:.4f}")
    assert float((band - truth).abs().max() / truth.max()) < 1e-12
    assert error < COVERAGE[lens]


@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in QUICK[1:])])
@pytest.mark.parametrize("lens", COVERAGE)
def test_colours_that_hide_colours(lens: str, seed: int) -> None:
    """Per band it is the picture of all bands, filtered; per channel it is off by what a lens's own colours do."""
    check_coverage(seed, lens)


@pytest.mark.slow
@pytest.mark.parametrize("seed", ALL)
@pytest.mark.parametrize("lens", COVERAGE)
def test_colours_that_hide_colours_in_many_scenes(lens: str, seed: int) -> None:
    check_coverage(seed, lens)


def test_coverage_per_band_is_priced() -> None:
    scene = scene_of(planes_of(0.7, 1.1, 5.0), bands=28)
    channel, band = (imaging(coverage=c).work(scene, channels=3) for c in ("channel", "band"))
    assert band.operations["transform"] > 1.5 * channel.operations["transform"]
    flat = scene.with_depth(2.0)
    assert imaging(coverage="band").work(flat, channels=3) == imaging().work(flat, channels=3)


def test_gradients_of_coverage_per_band() -> None:
    scene = scene_of(planes_of(0.7, 1.1, size=4), size=4, bands=3)
    colours = ColourFilter.kodak()
    stage = imaging(coverage="band", psf_shape=(5, 5))

    def picture(planes: Tensor) -> Tensor:
        return stage(Scene(planes, wavelengths=scene.wavelengths, depth=scene.depth), colour_filter=colours)

    assert torch.autograd.gradcheck(picture, scene.coefficients.clone().requires_grad_())


# ---- where a layer is --------------------------------------------------------------------------------------------


def scattered(draw: Draw) -> tuple[Tensor, Tensor, Renderer, bool]:
    """Planes and shares of layers that are in few places of few items, PSFs of them, and whether they hide."""
    batch, count, layers = draw.one_of(1, 2, 5), draw.one_of(1, 3), draw.one_of(2, 4)
    height, width = draw.whole(20, 70), draw.whole(20, 70)
    depth = torch.zeros(batch, 1, height, width, dtype=torch.float64)
    for item in range(batch):
        depth[item] = draw.number(0, layers - 1)  # between two layers, all over
        for _ in range(draw.whole(0, 2)):
            top, left = draw.whole(0, height - 6), draw.whole(0, width - 6)
            depth[item, :, top : top + draw.whole(1, 6), left : left + draw.whole(1, 6)] = draw.whole(0, layers - 1)
    shares = layer_shares(depth, torch.arange(layers, dtype=torch.float64))
    window = (draw.whole(1, 15), draw.whole(1, 15))
    psfs = draw.noise(layers, 2, *window).abs() + 0.01
    renderer = Renderer(
        psfs / psfs.sum((-2, -1), keepdim=True),
        spectra=draw.noise(count, 2).abs(),
        weights=draw.noise(3, 2).abs(),
        picture=(height, width),
        border=draw.one_of("reflect", "replicate", "zero", "periodic"),
        direct=draw.one_of(True, False, False),
        tile=draw.one_of(None, None, 16),
    )
    return draw.noise(batch, count, height, width).abs(), shares, renderer, draw.one_of(True, False)


def laid(planes: Tensor, shares: Tensor, renderer: Renderer, *, occlusion: bool) -> Tensor:
    layers = Layers(planes, shares, occlusion=occlusion)
    layers.add(renderer, first=0)
    return layers.light


@pytest.mark.parametrize("seed", [*range(20), *(pytest.param(n, marks=pytest.mark.slow) for n in range(20, 200))])
def test_layers_are_rendered_where_they_are(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Light, and its gradient to planes and PSFs, are those of layers that are rendered everywhere."""
    planes, shares, renderer, occlusion = scattered(Draw(seed))
    given = planes.requires_grad_(), renderer.psfs.requires_grad_()
    probe, found = Draw(seed).noise(1), []
    for whole in (False, True):
        if whole:
            monkeypatch.setattr(Renderer, "near", lambda *args, **kwargs: None)
        light = laid(planes, shares, renderer, occlusion=occlusion)
        found.append([light.detach(), *torch.autograd.grad((light * torch.cos(7 * light * probe)).sum(), given)])
        with torch.no_grad():
            torch.testing.assert_close(
                laid(planes, shares, renderer, occlusion=occlusion), light, rtol=1e-12, atol=1e-12
            )
    for near, everywhere in zip(*found, strict=True):
        torch.testing.assert_close(near, everywhere, rtol=1e-9, atol=1e-9 * float(everywhere.abs().max()))


def test_a_layer_is_rendered_for_the_items_and_the_part_that_it_is_in() -> None:
    shares = torch.zeros(4, 2, 64, 64)
    shares[:, 0], shares[1, 1, 20:24, 30:40] = 1, 1
    shares[1, 0, 20:24, 30:40] = 0
    renderer = Renderer(torch.ones(2, 1, 5, 5) / 25, spectra=None, weights=None, picture=(64, 64))
    (whole, part) = Layers(torch.ones(4, 1, 64, 64), shares)._places or ()
    assert whole is not None
    assert renderer.near(whole, batch=4) is None
    assert part is not None
    assert part.items == (1,)
    near = renderer.near(part, batch=4)
    assert near is not None
    assert near.picture == (4 + 4, 10 + 4)
    items, share = renderer.reached(part, batch=4)
    assert items == 1
    assert share < 0.1


@pytest.mark.parametrize("interpolate", [True, False])
@pytest.mark.parametrize("seed", range(8))
def test_of_large_maps_some_rows_and_columns_are_looked_at(
    seed: int, interpolate: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is found is there, and as far as those are apart; the ends, however small, always."""
    draw = Draw(seed)
    batch, height, width = draw.whole(1, 3), draw.whole(20, 60), draw.whole(20, 60)
    vergence = draw.number(0.5, 2) + torch.linspace(0, 1, width).expand(batch, 1, height, width).clone().double()
    for end in (0.1, 4.0):  # one pixel each
        vergence[draw.whole(0, batch - 1), 0, draw.whole(0, height - 1), draw.whole(0, width - 1)] = end
    layers = torch.linspace(0.1, 4.0, draw.whole(3, 40), dtype=torch.float64)
    beyond = torch.tensor([0.02, 0.05]), torch.tensor([5.0, 9.0])  # of the map, where nothing is
    layers = torch.cat([beyond[0][: draw.whole(0, 2)].double(), layers, beyond[1][: draw.whole(0, 2)].double()])
    exact = depth_module.places(vergence, layers, interpolate=interpolate)
    every = draw.whole(2, 5)
    on_grid = depth_module.places(vergence[..., ::every, ::every], layers, interpolate=interpolate)
    monkeypatch.setattr(depth_module, "_LOOKED_AT", height * width // every**2)
    found = depth_module.places(vergence, layers, interpolate=interpolate)
    there = [place is not None for place in exact]
    ends = there.index(True), len(there) - 1 - there[::-1].index(True)
    assert all(found[end] is not None for end in ends)
    for ours, whole, seen in zip(found, exact, on_grid, strict=True):
        assert ours is not None or seen is None
        if ours is not None:
            assert whole is not None
            assert set(ours.items) <= set(whole.items)
            sides = zip((ours.rows, ours.columns), (whole.rows, whole.columns), strict=True)
            for (start, stop), (first, last) in sides:
                assert first <= start < stop <= last + every
            if seen is not None:
                assert ours.rows[0] == every * seen.rows[0]
                assert ours.columns[1] >= every * (seen.columns[1] - 1) + 1


def test_a_batch_of_distances_takes_what_its_pictures_take() -> None:
    """Each picture's map is in layers of its own, of which the others have nothing."""
    depth = torch.linspace(0.5, 2.0, 6)[:, None, None, None].expand(6, 1, 32, 32).clone()
    depth[..., 16:] *= 1.01
    scene = Scene(Draw(1).noise(6, BANDS, 32, 32).abs(), wavelengths=wavelength_grid(count=BANDS), depth=depth)
    stage = optics.Imaging(random_lens(Draw(1), "ideal"), pixel_pitch=4 * um)
    together = stage.work(scene).operations["transform"]
    alone = sum(stage.work(scene.samples([row])).operations["transform"] for row in range(6))
    assert together < 1.5 * alone
    with torch.no_grad():
        light = stage(scene)
        for row in range(6):
            one = scene.samples([row])
            layers = tuple((1 / stage.depth_layers(depth, scene.wavelengths)).tolist())
            torch.testing.assert_close(light[row : row + 1], stage.changed(layers=layers)(one), rtol=1e-5, atol=1e-6)


def test_a_zone_without_any_layer_is_dark() -> None:
    shares = torch.zeros(1, 2, 20, 24)
    renderer = Renderer(torch.ones(2, 1, 5, 5) / 25, spectra=None, weights=None, picture=(20, 24), border="zero")
    assert torch.equal(laid(torch.ones(1, 1, 20, 24), shares, renderer, occlusion=True), torch.zeros(1, 1, 20, 24))


@pytest.mark.filterwarnings("ignore:There is a performance drop")
def test_layers_under_vmap() -> None:
    planes, shares, renderer, _ = scattered(Draw(3))
    scales = torch.tensor([1.0, 2.0], dtype=torch.float64)

    def light(scale: Tensor, own: Tensor = shares) -> Tensor:
        return laid(planes, own, replace(renderer, psfs=renderer.psfs * scale), occlusion=True)

    torch.testing.assert_close(torch.func.vmap(light)(scales), torch.stack([light(one) for one in scales]))
    both = torch.func.vmap(light)(scales, torch.stack([shares, shares]))
    torch.testing.assert_close(both, torch.stack([light(one) for one in scales]))


@pytest.mark.parametrize("different", [1, 2, 7, 16, 17, 40])
def test_few_values_are_all_that_there_are(different: int) -> None:
    """One that a single pixel of many has, too."""
    draw = Draw(different)
    known = torch.linspace(0.3, 4.0, different, dtype=torch.float64)
    values = known[(draw.noise(1, 1, 120, 130) * different).long().clamp(max=different - 1)]
    torch.testing.assert_close(few_values(values, at_most=different), values.unique())
    values[0, 0, 3, 1] = 9.0
    torch.testing.assert_close(few_values(values, at_most=different + 1), values.unique())
    assert few_values(values, at_most=different) is None


@pytest.mark.parametrize("count", [2, 3, 9])
def test_values_lie_between_the_nodes_beside_them(count: int) -> None:
    draw = Draw(count)
    nodes, at = draw.noise(count).sort().values, 3 * draw.noise(5, 40) - 1
    before, share = bracketed(nodes, at)
    assert before.min() >= 0
    assert before.max() <= count - 2
    torch.testing.assert_close(nodes[before] + share * (nodes[before + 1] - nodes[before]), at)
    inside = (at >= nodes[0]) & (at < nodes[-1])
    assert ((share[inside] >= 0) & (share[inside] < 1)).all()
    nodes.requires_grad_()
    assert torch.autograd.gradcheck(lambda own: bracketed(own, at)[1], nodes)
