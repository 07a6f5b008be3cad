"""The ways to convolve give one result, and each shortcut of Imaging errs as its definition says."""

from __future__ import annotations

import itertools
import math
import random as draws

import pytest
import torch
from torch import Tensor

from kcam import optics
from kcam.context import Context
from kcam.optics.rendering import ways
from kcam.optics.rendering.borders import BORDERS, part, part_of
from kcam.optics.rendering.renderer import Renderer
from kcam.optics.rendering.ways import WAYS as TABLE
from kcam.optics.rendering.ways import choose
from kcam.scene import Scene
from kcam.sensor import ColourFilter
from kcam.units import mm, um, wavelength_grid

WAYS = {"direct": {"direct": True}, "tiles": {"tile": 8}, "one tile": {"tile": 64}, "odd tiles": {"tile": 13}}
CONTENTS = {"bands": (None, None), "filter": (None, 2), "kernels": (2, 2), "spectra": (5, 2), "planes": (5, None)}
CONTENTS |= {"tile": (2, 7), "grey": (1, None)}  # fewer planes than channels


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def imaging(**arguments) -> optics.Imaging:
    lens = optics.Lens(
        optics.CircularAperture(2.5 * mm), optics.PlanoConvexLens(25.8 * mm, glass="N-BK7"), focus_distance=2.0
    )
    return optics.Imaging(lens, **({"pixel_pitch": 4 * um} | arguments))


def ramp(*, near: float = 0.8, far: float = 3.0, size: tuple[int, int] = (24, 30)) -> Scene:
    depth = torch.linspace(near, far, size[1], dtype=torch.float64).expand(1, 1, *size)
    return Scene.from_rgb(random(1, 3, *size), depth=depth, wavelengths=wavelength_grid(count=6))


def rms(a: Tensor, b: Tensor) -> float:
    return float((a - b).square().mean().sqrt() / b.square().mean().sqrt())


@pytest.mark.parametrize("border", BORDERS)
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("content", CONTENTS)
def test_every_way_gives_the_same_result_and_gradients(content: str, way: str, border: str) -> None:
    factors, channels = CONTENTS[content]
    picture, window, bands = (21, 18), (6, 9), 5
    spectra = None if factors is None else random(factors, bands, seed=3)
    weights = None if channels is None else random(channels, bands, seed=4)
    results = []
    for arguments in ({}, WAYS[way]):
        planes = random(2, factors or bands, *picture, seed=1).requires_grad_()
        psfs = random(1, bands, *window, seed=2).requires_grad_()
        mask = random(2, 1, *picture, seed=6)
        renderer = Renderer(psfs, spectra=spectra, weights=weights, picture=picture, border=border, **arguments)
        light, cover = renderer.blur(planes, layer=0), renderer.coverage(mask, layer=0)
        loss = (light * random(*light.shape, seed=5)).sum()
        results.append((light, cover, *torch.autograd.grad(loss, (planes, psfs))))
    for found, expected in zip(results[1], results[0], strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("seed", range(8))
def test_a_large_picture_is_cut_into_even_squares(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """With one result, and the gradients of the whole; no square is larger than it must be."""
    draw = draws.Random(seed)
    border = draw.choice(BORDERS)
    picture, window = ((draw.randint(9, 40), draw.randint(9, 40)), (draw.randint(1, 12), draw.randint(1, 12)))
    factors, channels = CONTENTS[draw.choice(list(CONTENTS))]
    spectra = None if factors is None else random(factors, 5, seed=3)
    weights = None if channels is None else random(channels, 5, seed=4)
    results = []
    for whole in (10**9, math.prod(picture) - 1):
        monkeypatch.setattr(ways, "_WHOLE", whole)
        monkeypatch.setattr(ways, "_SIDE", 8)
        planes = random(2, factors or 5, *picture, seed=1).requires_grad_()
        psfs = random(1, 5, *window, seed=2).requires_grad_()
        renderer = Renderer(psfs, spectra=spectra, weights=weights, picture=picture, border=border)
        light = renderer.blur(planes, layer=0)
        results.append((light, *torch.autograd.grad((light * random(*light.shape, seed=5)).sum(), (planes, psfs))))
    assert renderer.squares == (-(-picture[0] // 8), -(-picture[1] // 8))
    assert all(n * count - n < side for n, count, side in zip(renderer.square, renderer.squares, picture, strict=True))
    for found, expected in zip(results[1], results[0], strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("way", [{}, *WAYS.values()], ids=["whole", *WAYS])
@pytest.mark.parametrize("content", CONTENTS)
@pytest.mark.parametrize("between", [0, 3, 7], ids=["one PSF", "between few", "between as many"])
def test_bands_that_share_psfs(content: str, way: dict, between: int) -> None:
    """The same as a bank in which each band has its own, whatever is contracted first."""
    factors, channels = CONTENTS[content]
    picture, window, bands = (21, 18), (6, 9), 7
    shares = torch.nn.functional.one_hot(torch.tensor([1, 0, 0, 1, 2, 2, 1])).double()
    if between:
        shares = random(bands, between, seed=5)
    spectra = None if factors is None else random(factors, bands, seed=3)
    weights = None if channels is None else random(channels, bands, seed=4)
    planes, few = random(2, factors or bands, *picture, seed=1), random(1, between or 3, *window, seed=2)
    fixed = {"spectra": spectra, "weights": weights, "picture": picture}
    shared = Renderer(few, shares=shares, **fixed, **way)
    copied = Renderer(torch.einsum("lg,zghw->zlhw", shares, few), **fixed)
    torch.testing.assert_close(shared.blur(planes, layer=0), copied.blur(planes, layer=0))
    mask = random(2, 1, *picture, seed=6)
    torch.testing.assert_close(shared.coverage(mask, layer=0), copied.coverage(mask, layer=0))


@pytest.mark.parametrize("content", CONTENTS)
@pytest.mark.parametrize("name", TABLE)
def test_every_row_of_the_table_gives_what_the_chosen_one_gives(name: str, content: str) -> None:
    """Also where another is cheaper; each band by itself knows no filter, which then weights its result."""
    factors, channels = CONTENTS[content]
    picture, bands = (21, 18), 5
    spectra = None if factors is None else random(factors, bands, seed=3)
    weights = None if channels is None else random(channels, bands, seed=4)
    planes, psfs = random(2, factors or bands, *picture, seed=1), random(1, bands, 6, 9, seed=2)
    renderer = Renderer(psfs, spectra=spectra, weights=weights, picture=picture)
    light = TABLE[name].blur(renderer, psfs[0])(planes)
    if name == "each" and weights is not None:
        light = torch.einsum("cl,blyx->bcyx", weights, light)
    torch.testing.assert_close(light, renderer.blur(planes, layer=0))


@pytest.mark.parametrize("way", [{}, *WAYS.values()])
def test_in_the_dark_all_that_the_window_reaches_is_seen(way: dict) -> None:
    """The whole light of a zone, with nothing beside it."""
    window, zone = (6, 9), random(2, 3, 14, 11, seed=1)
    results = []
    for border in ("dark", "zero"):
        planes, psfs = zone.clone().requires_grad_(), random(1, 3, *window, seed=2).requires_grad_()
        (above, below), (left, right) = (((m - 1) // 2, m // 2) for m in window)
        pads = (left, right, above, below) if border == "zero" else (0, 0, 0, 0)
        padded = torch.nn.functional.pad(planes, pads)
        picture = (padded.shape[-2], padded.shape[-1])
        renderer = Renderer(psfs, spectra=None, weights=random(2, 3, seed=4), picture=picture, border=border, **way)
        light = renderer.blur(padded, layer=0)
        results.append((light, *torch.autograd.grad((light * random(*light.shape, seed=5)).sum(), (planes, psfs))))
    for own, expected in zip(*results, strict=True):
        torch.testing.assert_close(own, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("border", BORDERS)
@pytest.mark.parametrize("dim", [-1, -2])
def test_a_part_of_strips_is_that_of_the_whole(border: str, dim: int) -> None:
    generator = torch.Generator().manual_seed(3)
    for n, step in ((17, 5), (12, 4), (3, 7), (1, 1)):
        planes = random(1, 2, n, 6, seed=n) if dim == -2 else random(1, 2, 6, n, seed=n)
        for _ in range(20):
            start = int(torch.randint(-2 * n, n, (), generator=generator))
            stop = int(torch.randint(max(start + 1, 1), 3 * n + 2, (), generator=generator))
            whole = part(planes, start, stop, border, dim=dim)
            for index, place in enumerate(range(start, stop)):
                if border == "zero" and not 0 <= place < n:
                    assert not bool(whole.select(dim, index).any())
                elif 0 <= place < n:
                    assert torch.equal(whole.select(dim, index), planes.select(dim, place))
            assert torch.equal(part_of(planes.split(step, dim), start, stop, border, dim=dim), whole)


@pytest.mark.parametrize("way", WAYS)
def test_every_way_renders_layers(way: str) -> None:
    scene, colours = ramp(), ColourFilter.kodak()
    whole = imaging()(scene, colour_filter=colours)
    assert rms(imaging(**WAYS[way])(scene, colour_filter=colours), whole) < 1e-12


def test_without_blur_the_picture_is_the_scene() -> None:
    scene = ramp()
    assert rms(imaging(blur=False)(scene), scene.bands()) < 1e-15
    colours = ColourFilter.kodak()
    context = Context(wavelengths=scene.wavelengths)
    assert rms(imaging(blur=False)(scene, colour_filter=colours), colours(scene.bands(), context)) < 1e-12


def test_a_renormalised_psf_has_all_its_light() -> None:
    scene = Scene.from_bands(torch.ones(1, 3, 20, 20, dtype=torch.float64), wavelengths=wavelength_grid(count=3))
    cut = imaging(psf_shape=(5, 5))(scene)
    whole = imaging(psf_shape=(5, 5), renormalise=True)(scene)
    assert float(cut.max()) < 0.99
    assert rms(whole, torch.ones_like(whole)) < 1e-12


def test_without_occlusion_layers_add_up() -> None:
    """Far light that a near edge would hide is counted: more light, none lost, and nothing changes on one plane."""
    depth = torch.full((1, 1, 24, 30), 3.0, dtype=torch.float64)
    depth[..., 15:] = 0.8
    planes = torch.ones(1, 3, 24, 30, dtype=torch.float64)
    scene = Scene.from_rgb(planes, depth=depth, wavelengths=wavelength_grid(count=4))
    hidden, added = imaging()(scene), imaging(occlusion=False)(scene)
    assert 1e-3 < rms(added, hidden) < 0.2
    flat = scene.with_depth(1.1)
    assert torch.equal(imaging()(flat), imaging(occlusion=False)(flat))


def test_precision_follows_the_argument_and_the_dtype_stays() -> None:
    scene = ramp()
    single = imaging(precision="float32")(scene)
    assert single.dtype == torch.float64
    assert 1e-9 < rms(single, imaging()(scene)) < 1e-5
    wide = imaging(precision="float64")(scene.to(dtype=torch.float32))
    assert wide.dtype == torch.float32


def test_rank_is_the_scene_s_own_low_rank() -> None:
    scene = Scene.from_bands(random(1, 6, 20, 20), wavelengths=wavelength_grid(count=6))
    torch.testing.assert_close(imaging(rank=2)(scene), imaging()(scene.low_rank(2)))
    assert torch.equal(imaging(rank=6)(scene), imaging()(scene))


def test_kappa_sets_the_pupil_sampling() -> None:
    phase = 3 * random(12, 12)
    rough = optics.Lens(*imaging().lens.elements, optics.DOE(phase), focus_distance=2.0)
    scene = Scene.from_rgb(random(1, 3, 60, 60), depth=1.0, wavelengths=wavelength_grid(count=3))
    fine, coarse = (optics.Imaging(rough, pixel_pitch=4 * um, kappa=kappa)(scene) for kappa in (5.0, 1.2))
    assert rms(optics.Imaging(rough, pixel_pitch=4 * um)(scene), fine) < rms(coarse, fine)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"tile": 0}, "tile must be a positive number of pixels, or None, got 0"),
        ({"rank": 0}, "rank must be a positive number of factors, or None, got 0"),
        ({"kappa": 1.0}, "kappa must be above 1 sample per fringe, got 1. Its default is 2.7"),
        ({"precision": "half"}, 'precision must be "float32", "float64" or None for the scene\'s, got \'half\''),
    ],
)
def test_bad_shortcuts_say_what_is_wrong(arguments: dict, text: str) -> None:
    with pytest.raises(ValueError, match=text.replace("(", r"\(")):
        imaging(**arguments)


@pytest.mark.parametrize("span", [range(1, 1200), range(99_000, 99_100)], ids=["short", "long"])
def test_fast_lengths_are_the_shortest(span: range) -> None:
    from kcam.optics.numerics import fast_length

    def smooth(n: int) -> bool:
        for factor in (2, 3, 5, 7):
            while n % factor == 0:
                n //= factor
        return n == 1

    for least in span:
        step = 32 if least >= 256 else 2 if least > 2 else 1
        candidates = range(math.ceil(least / step) * step, 4 * least + 4, step)
        assert fast_length(least) == next(n for n in candidates if smooth(n))
    assert 10**15 < fast_length(10**15 + 1) < 1.001e15  # by products, not by trying


def test_few_planes_and_psfs_before_many_channels_take_few_transforms() -> None:
    """Each plane through each PSF, not each channel."""
    shares = torch.nn.functional.one_hot(torch.arange(28) // 4).double()
    bank = Renderer(random(1, 7, 9, 9), shares=shares, spectra=random(3, 28), weights=random(12, 28), picture=(40, 30))
    apart, groups = choose(bank, 1).takes(bank), TABLE["groups"].takes(bank)
    assert [way.inputs + way.kernels + way.outputs for way in (apart, groups)] == [3 + 7 + 21, 84 + 7 + 12]


@pytest.mark.parametrize("batch", [1, 10])
@pytest.mark.parametrize(("factors", "channels"), [(3, 1), (3, 3), (3, 4), (2, 9), (4, 16)])
def test_fewer_psfs_take_no_more(factors: int, channels: int, batch: int) -> None:
    """Transforms, and products, of which ten take as long. What is transformed once for a batch, as PSFs are, counts
    once where a way is chosen.
    """
    bands, window, picture = 28, (9, 9), (40, 30)
    fixed = {"spectra": random(factors, bands, seed=1), "weights": random(channels, bands, seed=2), "picture": picture}
    counts = []
    for groups in range(1, bands):
        shares = torch.nn.functional.one_hot(torch.arange(bands) * groups // bands).double()
        renderer = Renderer(random(1, groups, *window, seed=3), shares=shares, **fixed)
        takes = choose(renderer, batch).takes(renderer)
        counts.append(batch * (takes.inputs + takes.outputs + takes.products / 10) + takes.kernels)
    assert all(fewer <= 1.001 * more for fewer, more in itertools.pairwise(counts))
