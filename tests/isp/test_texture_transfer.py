"""Pictures painted with pieces of another one: they show the exemplar, where the picture asks for it."""

from __future__ import annotations

import copy
import importlib
import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from kcam import Camera, Scene, isp
from kcam.isp import exemplar as exemplars
from kcam.isp import pieces, texture_transfer
from kcam.style import StyleLoss, painting

transfer: Any = importlib.import_module("kcam.isp.texture_transfer")  # the module, not the function


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def stripes(side: int = 64, *, angle: float = 0.0, period: float = 8.0) -> Tensor:
    """Even waves whose lines run along an angle from +x to +y."""
    y, x = torch.meshgrid(torch.arange(side) * 1.0, torch.arange(side) * 1.0, indexing="ij")
    wave = torch.sin(2 * math.pi * (y * math.cos(angle) - x * math.sin(angle)) / period)
    return (0.5 + 0.4 * wave).expand(3, side, side)


def direction(picture: Tensor) -> float:
    """Of the lines that a gray picture is made of, 0..pi."""
    gray = picture.mean(0)
    dx, dy = (gray[1:-1, 2:] - gray[1:-1, :-2]), (gray[2:, 1:-1] - gray[:-2, 1:-1])
    turned = torch.atan2((2 * dx * dy).sum(), (dx * dx - dy * dy).sum())  # of the slope, twice
    return float((turned / 2 + math.pi / 2) % math.pi)


def between(one: float, other: float) -> float:
    return abs((one - other + math.pi / 2) % math.pi - math.pi / 2)


def test_a_picture_is_made_of_colours_of_the_exemplar() -> None:
    levels = torch.tensor([0.1, 0.5, 0.9])
    exemplar = levels[torch.arange(64) % 12 // 4].expand(3, 64, 64)
    plain: Any = {"glaze": 0.0, "palette": 0.0, "turns": 1, "detail": 4.0}
    picture = torch.rand(1, 3, 40, 48, generator=seeded(1))
    painted = texture_transfer(picture, exemplar=exemplar, generator=seeded(), **plain)
    apart = (painted[..., None] - levels).abs().amin(-1)
    assert float((apart < 1e-5).float().mean()) > 0.7  # the others are where two pieces meet
    assert float(painted.min()) >= 0.1 - 1e-5
    assert float(painted.max()) <= 0.9 + 1e-5


def test_an_exemplar_asked_for_itself_comes_back() -> None:
    exemplar = painting("woodcut", size=96)
    painted = texture_transfer(exemplar[None], exemplar=exemplar, turns=1, local=0.0, seam=2.0, generator=seeded())
    gray = torch.stack([exemplar.mean(0).flatten(), painted[0].mean(0).flatten()])
    assert float(torch.corrcoef(gray)[0, 1]) > 0.5  # its lights and darks, of other pieces


@pytest.mark.parametrize(
    "angle", [pytest.param(a, marks=[] if a == 1.2 else [pytest.mark.slow]) for a in (0.3, 1.2, 2.2)]
)
def test_strokes_follow_the_picture(angle: float) -> None:
    """Stripes of another width: the exemplar's, turned as they are."""
    picture = stripes(64, angle=angle, period=24.0)[None]
    painted = texture_transfer(picture, exemplar=stripes(96, period=6.0), flow=2.0, turns=12, generator=seeded())
    assert between(direction(painted[0]), angle) < 0.35
    left = texture_transfer(picture, exemplar=stripes(96, period=6.0), flow=2.0, turns=1, generator=seeded())
    assert between(direction(left[0]), 0.0) < between(direction(left[0]), angle) + 0.2 or angle < 0.5


@pytest.mark.slow
def test_light_and_dark_are_kept_and_more_of_them_by_more_weight() -> None:
    picture = Scene.builtin("astronaut", size=96).to_srgb()
    exemplar = painting("strokes", size=128)
    kept = []
    for detail in (0.0, 2.0, 20.0):
        painted = texture_transfer(picture, exemplar=exemplar, detail=detail, glaze=0.0, generator=seeded())
        soft = [torch.nn.functional.avg_pool2d(x.mean(1, keepdim=True), 5, 1, 2) for x in (picture, painted)]
        beside = [(x - torch.nn.functional.avg_pool2d(x, 21, 1, 10)).flatten() for x in soft]
        kept.append(float(torch.corrcoef(torch.stack(beside))[0, 1]))
    assert kept[0] < kept[1] < kept[2]
    assert kept[2] > 0.6


@pytest.mark.slow
def test_the_same_seed_is_the_same_picture_and_another_is_another() -> None:
    picture, exemplar = torch.rand(1, 3, 32, 32), painting("mosaic", size=64)
    stage = isp.TextureTransfer(exemplar)
    one, again, other = (Camera(stage)(picture, generator=seeded(seed)) for seed in (1, 1, 2))
    assert torch.equal(one, again)
    assert not torch.equal(one, other)
    still = stage.mean()
    assert torch.equal(still(picture), still(picture))
    assert still.exemplar is stage.exemplar
    assert torch.equal(isp.TextureTransfer(exemplar, seed=0)(picture), still(picture))


def test_pieces_cost_nothing_inside_and_offers_lower_the_sum() -> None:
    """The sum by its definition, for each pair of neighbours; no round raises it."""
    exemplar = exemplar_of(painting("woodcut", size=64))
    book = exemplar.books[-1]
    asked = torch.randn(12 * 10, 6, generator=seeded())
    laid = pieces._Laid(book, asked, torch.ones_like(asked), (12, 10), seam=2.0, joint=0.05)
    laid.lay(book.places[torch.randint(len(book.places), (120,), generator=seeded())])

    def total() -> float:
        places = laid.places.view(12, 10)
        found = float((book.compared[laid.places] - asked).square().sum())
        for dy, dx in ((0, 1), (1, 0)):
            here, there = places[: 12 - dy, : 10 - dx].flatten(), places[dy:, dx:].flatten()
            step = dy * book.width + dx
            found += 2.0 * float((book.shown[here] - book.shown[there - step]).square().sum())
            found += 2.0 * float((book.shown[here + step] - book.shown[there]).square().sum())
            found += 2.0 * 0.05 * float((here + step != there).sum())
        return found

    sums = [total()]
    for seed in range(3):
        laid.round(seeded(seed))
        sums.append(total())
        assert torch.equal(laid.shown, book.shown[laid.places])
    assert sums[0] > sums[1] >= sums[2] >= sums[3]
    assert bool(book.allowed[laid.places].all())


def exemplar_of(picture: Tensor, turns: int = 8):
    return exemplars.Exemplar.of(picture, turns=turns, detail=3.0, flow=0.5, colour=0.1)


def test_the_palette_is_that_of_the_exemplar_and_what_is_brighter_stays_so() -> None:
    """Mean and covariance of colours that cover all of the exemplar's come out; a nearly even picture stays one."""
    exemplar = painting("strokes", size=96)
    picture = 0.3 + 0.4 * torch.rand(3, 64, 64, generator=seeded())
    moved = transfer._with_colours_of(picture, exemplar)
    own, theirs = moved.flatten(1), exemplar.flatten(1)
    assert torch.allclose(own.mean(1), theirs.mean(1), atol=1e-4)
    before, after = (exemplars.luma_of(x).flatten() for x in (picture, moved))
    assert torch.equal(before.argsort()[::64], after.argsort()[::64])
    again = transfer._with_colours_of(exemplar + 0.0, exemplar)
    assert torch.allclose(again, exemplar, atol=1e-4)
    even = transfer._with_colours_of(0.5 + 0.01 * torch.randn(3, 64, 64, generator=seeded()), exemplar)
    assert float(even.flatten(1).std(1).max()) < 0.15  # 1.1 / 0.1 of the variance at most


@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2))])
def test_what_is_shown_has_paints_of_the_exemplar(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Inks that are mixed two by two, never all three: what a loss tints to make up for them goes back to them."""
    inks = torch.tensor([[0.9, 0.9, 0.8], [0.1, 0.1, 0.3], [0.8, 0.3, 0.2]]).roll(seed, 1)
    cover = painting("woodcut", size=96, seed=seed)[1] * 2
    exemplar = torch.lerp(inks[0][:, None, None], inks[1][:, None, None], cover.clamp(max=1))
    exemplar = torch.lerp(exemplar, inks[2][:, None, None], (cover - 1).clamp(min=0))
    paints = torch.cat([torch.lerp(inks[k], inks[k + 1], torch.linspace(0, 1, 65)[:, None]) for k in (0, 1)])

    def off() -> float:
        picture = torch.rand(1, 3, 72, 80, generator=seeded(seed))
        painted = texture_transfer(picture, exemplar=exemplar, generator=seeded())[0]
        return float(torch.cdist(painted.flatten(1).T, paints).amin(1).mean())

    found = off()
    monkeypatch.setattr(transfer, "_by_paints", lambda picture, exemplar: picture)
    assert found < 0.75 * off()


def test_directions_turn_with_the_exemplar() -> None:
    """Those of a turned picture are the turned ones."""
    exemplar = exemplar_of(stripes(96, angle=0.4, period=6.0), turns=8)
    book = exemplar.books[-1]
    for turn in range(8):
        own = (torch.arange(len(book.allowed)) // (book.height * book.width) == turn) & book.allowed
        vector = book.compared[own, 4:6].mean(0)
        found = float(torch.atan2(vector[1], vector[0]) / 2 % math.pi)
        assert between(found, 0.4 + turn * math.pi / 4) < 0.1
        seen = book.shown.view(8, book.height, book.width, 3)[turn, 30:66, 30:66].permute(2, 0, 1)
        assert between(direction(seen), 0.4 + turn * math.pi / 4) < 0.08


def with_spectrum(slope: float, seed: int, *, contrast: float = 0.15) -> Tensor:
    """Noise (3,96,96) whose amplitude falls as a power of the frequency."""
    frequency = torch.hypot(torch.fft.fftfreq(96)[:, None], torch.fft.rfftfreq(96)).clamp(min=1 / 96)
    spectrum = torch.fft.rfft2(torch.randn(96, 96, generator=seeded(seed))) * frequency**-slope
    noise = torch.fft.irfft2(spectrum, s=(96, 96))
    return (0.5 + contrast * noise / noise.std()).clamp(0, 1).expand(3, 96, 96)


@pytest.mark.parametrize("seed", range(3))
def test_what_is_asked_for_has_the_octaves_of_the_exemplar(seed: int) -> None:
    """Whatever falls off with frequency in the picture, and whatever its contrast: random spectra."""
    low, high = (torch.rand(2, generator=seeded(10 + seed)) * 0.5 + torch.tensor([0.2, 1.2])).tolist()
    slopes = (low, high) if seed % 2 else (high, low)
    exemplar = exemplar_of(with_spectrum(slopes[0], seed), turns=1)
    picture = with_spectrum(slopes[1], 20 + seed, contrast=0.05 + 0.05 * seed)
    _, _, tone = exemplars.asked_of(picture, exemplar, 1.0, torch.zeros(2, 96, 96))
    fine = tone[0] - exemplars._with_tones_of(exemplars._tones(picture[0])[-1], exemplar.tones[-1])

    def shares(tones: Tensor) -> Tensor:
        found = exemplars._deviation(exemplars._tones(tones)[:-1]).flatten()
        return found / found.norm()

    theirs, before = (tones[:-1].sum(0) for tones in (exemplar.tones, exemplars._tones(picture[0])))
    assert float((shares(fine) - shares(theirs)).norm()) < 0.5 * float((shares(before) - shares(theirs)).norm())


def test_steps_of_8_bit_values_in_a_smooth_sky_are_no_detail() -> None:
    exemplar = exemplar_of(painting("strokes", size=96), turns=1)
    sky = torch.linspace(0.3, 0.7, 96).expand(3, 96, 96)
    still = torch.zeros(2, 96, 96)
    smooth, stepped = (exemplars.asked_of(x, exemplar, 1.0, still)[2] for x in (sky, (sky * 255).round() / 255))
    assert float((smooth - stepped).std()) < 0.25 * float(smooth.std())


@pytest.mark.parametrize("seed", range(3))
def test_the_tone_of_a_picture_that_shows_little_counts_more(seed: int) -> None:
    """Noise on a random part of a wall, of random contrast: the smaller the part, the more its tone counts there."""
    exemplar = exemplar_of(painting("strokes", size=96), turns=1)
    noise = torch.randn(96, 96, generator=seeded(seed))
    contrast, brightness = (0.02 + 0.2 * torch.rand(2, generator=seeded(30 + seed))).tolist()
    counts = []
    for side in (96, 48, 24, 12):
        part = torch.zeros(96, 96)
        part[:side, :side] = noise[:side, :side]
        picture = (0.3 + brightness + contrast * part).expand(3, 96, 96)
        weight = exemplars.asked_of(picture, exemplar, 1.0, torch.zeros(2, 96, 96))[1]
        counts.append(float(weight[:side, :side].mean()))
    assert counts == sorted(counts)
    assert counts[-1] > 8 * counts[0]
    wall = exemplars.asked_of(torch.full((3, 96, 96), brightness), exemplar, 1.0, torch.zeros(2, 96, 96))[1]
    assert float(wall.max()) < 0.05


@pytest.mark.parametrize("seed", range(3))
def test_what_is_laid_over_follows_the_strokes(seed: int) -> None:
    """Random cells of random colours, each to be made so much brighter: a Gaussian would cross their edges."""
    at, tones = torch.rand(40, 2, generator=seeded(seed)) * 96, torch.rand(2, 40, generator=seeded(40 + seed))
    rows, columns = torch.meshgrid(torch.arange(96.0), torch.arange(96.0), indexing="ij")
    cell = (torch.stack([rows, columns], -1)[:, :, None] - at).square().sum(-1).argmin(-1)
    painted, wanted = tones[0][cell].expand(3, 96, 96), 0.2 * tones[:1, cell]
    noisy = wanted + 0.1 * torch.randn(1, 96, 96, generator=seeded(50 + seed))
    off = float((transfer._by_strokes(noisy, painted) - wanted).square().mean())
    assert off < 0.7 * min(float((exemplars.blur(noisy, sigma) - wanted).square().mean()) for sigma in (2.0, 3.0, 5.0))


def test_gradients_of_exemplar_glaze_and_picture(monkeypatch) -> None:
    """With pieces that stay where they are, against differences: float64."""
    laid: list[Tensor] = []

    def once(*given: Any, **how: Any) -> Tensor:
        laid.append(laid[0] if laid else pieces.lay_pieces(*given, **how))
        return laid[0]

    monkeypatch.setattr(transfer, "lay_pieces", once)
    soft = torch.nn.functional.avg_pool2d(torch.rand(3, 66, 66, dtype=torch.float64, generator=seeded(4)), 3, 1)
    exemplar = nn.Parameter(soft)  # no two of its pixels alike: no ties
    glaze = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    picture = (0.2 + 0.6 * torch.rand(1, 3, 16, 16, dtype=torch.float64, generator=seeded())).requires_grad_()
    weights = torch.randn(1, 3, 16, 16, dtype=torch.float64, generator=seeded(1))

    def painted(*values: Tensor) -> Tensor:
        one, two, three = values
        return (weights * texture_transfer(one, exemplar=two, glaze=three, turns=2, generator=seeded())).sum()

    given = (picture, exemplar, glaze)
    slopes = torch.autograd.grad(painted(*given), given)
    for index, (value, slope) in enumerate(zip(given, slopes, strict=True)):
        assert bool(slope.isfinite().all())
        assert float(slope.abs().max()) > 0
        along = torch.randn(value.shape, dtype=torch.float64, generator=seeded(2))
        step = 1e-9
        ends = [painted(*(v.detach() + sign * step * along if i == index else v.detach() for i, v in enumerate(given)))
                for sign in (1, -1)]  # fmt: skip
        assert float((ends[0] - ends[1]) / (2 * step)) == pytest.approx(float((slope * along).sum()), rel=1e-4)


def test_steps_bring_the_style_and_what_is_shown_nearer() -> None:
    """On a loss that it is not moved down on: of other crops, and content of whole pixels' contrast."""
    picture, exemplar = Scene.builtin("astronaut", size=96).to_srgb(), painting("watercolour", size=160)
    zero, some = (texture_transfer(picture, exemplar=exemplar, steps=steps, generator=seeded()) for steps in (0, 20))
    loss = StyleLoss(exemplar, crop=96, colour=0.5, levels=(2,), flat=1e-3)
    before, after = (loss.terms(painted, scene=picture) for painted in (zero, some))
    assert all(float(after[name]) < float(before[name]) for name in ("style", "colour", "content"))
    assert float((some - zero).abs().mean()) < 0.1  # it is the same picture still


@pytest.mark.slow
def test_steps_are_for_what_the_features_can_see() -> None:
    """64 pixels each way, of the picture and of the exemplar."""
    for side, own in ((63, 80), (80, 63)):
        picture, exemplar = torch.rand(1, 3, side, 80, generator=seeded()), painting("mosaic", size=80)[:, :own]
        one, other = (
            texture_transfer(picture, exemplar=exemplar, turns=1, steps=steps, generator=seeded()) for steps in (0, 2)
        )
        assert torch.equal(one, other)


@pytest.mark.slow
def test_steps_in_inference_mode_and_with_slopes() -> None:
    picture, stage = (
        torch.rand(1, 3, 64, 70),
        isp.TextureTransfer(painting("mosaic", size=64), turns=1, steps=2, seed=0),
    )
    with torch.inference_mode():
        frozen = stage(picture)
    shown = picture.clone().requires_grad_()
    painted = stage(shown)
    assert torch.equal(painted.detach(), frozen)
    bare = isp.TextureTransfer(stage.exemplar, turns=1, steps=0, seed=0)
    slopes = (torch.autograd.grad(of(shown).clamp(0.05, 0.95).sum(), shown)[0] for of in (stage, bare))
    assert all(bool(slope.isfinite().all()) and float(slope.abs().max()) > 0 for slope in slopes)


def test_transforms_without_steps() -> None:
    exemplar, picture = painting("mosaic", size=64), torch.rand(1, 3, 64, 64, generator=seeded())

    def total(shown: Tensor) -> Tensor:
        return texture_transfer(shown, exemplar=exemplar, turns=1, steps=0, generator=seeded()).sum()

    shown = picture.clone().requires_grad_()
    assert torch.allclose(torch.func.grad(total)(picture), torch.autograd.grad(total(shown), shown)[0], atol=1e-5)


@pytest.mark.parametrize("shape", [(100, 2000), (64, 9000), (40, 1000), (900, 800)])
def test_a_long_exemplar_keeps_its_shorter_side(shape: tuple[int, int]) -> None:
    cropped = exemplars.cropped(torch.rand(3, 1, 1).expand(3, *shape))
    assert min(cropped.shape[1:]) == min(*(side // 8 * 8 for side in shape), 720)
    assert cropped[0].numel() <= exemplars.MOST


def test_a_large_picture_is_moved_in_parts_without_seams(monkeypatch) -> None:
    monkeypatch.setattr(transfer, "AT_ONCE", 96)
    for length in (1, 95, 96, 97, 129, 500):
        parts = transfer._parts(length)
        covered, most = torch.zeros(length), torch.zeros(length)
        for part, share in parts:
            assert part.stop - part.start == len(share) <= 96
            covered[part] += share
            most[part] = torch.maximum(most[part], share)
        assert float(covered.min()) > 0
        steepest = torch.stack([F.pad(s, (p.start, length - p.stop)) / covered for p, s in parts]).diff(dim=1).abs()
        assert len(parts) == 1 or float(steepest.max()) < 0.06  # from one part to the next over some 64 pixels
    asked: list[tuple[int, ...]] = []

    def same(loss: Any, picture: Tensor, **how: Any) -> Tensor:
        asked.append(tuple(picture.shape))
        assert how["scene"].shape == picture.shape
        return picture

    monkeypatch.setattr(transfer, "descend", same)
    painted = torch.rand(3, 100, 200)
    loss: Any = None
    assert torch.allclose(transfer._finished(painted, torch.rand(3, 100, 200), loss, 1), painted, atol=1e-6)
    assert len(asked) == 10


@pytest.mark.parametrize(("shape", "value"), [((1, 1), None), ((5, 70), 0.5), ((33, 8), None), ((33, 8), 0.0)])
def test_pictures_of_any_size_and_even_ones(shape: tuple[int, int], value: float | None) -> None:
    picture = torch.rand(2, 3, *shape) if value is None else torch.full((2, 3, *shape), value)
    painted = texture_transfer(picture, exemplar=painting("strokes", size=64), generator=seeded())
    assert painted.shape == picture.shape
    assert bool(painted.isfinite().all())


@pytest.mark.slow
def test_half_precision_and_large_exemplars() -> None:
    exemplar = torch.rand(3, 800, 900)
    assert isp.texture_transfer(torch.rand(1, 3, 16, 16).half(), exemplar=exemplar).dtype == torch.float16
    assert 3 * 2**18 < exemplars.cropped(exemplar).numel() <= 3 * 2**19


def test_saved_and_loaded_it_paints_the_same(tmp_path) -> None:
    camera = Camera(isp.TextureTransfer(painting("watercolour", size=64), turns=4, glaze=0.1, seed=3))
    camera.save(tmp_path / "camera.safetensors")
    picture = torch.rand(1, 3, 24, 24)
    assert torch.equal(Camera.load(tmp_path / "camera.safetensors")(picture), camera(picture))


@pytest.mark.parametrize(
    ("exemplar", "arguments", "text"),
    [
        (torch.rand(3, 16, 64), {}, r"16 x 64 is too small: expected at least 32"),
        (torch.full((3, 64, 64), 0.5), {}, r"flat: its luma deviates by 0, .* no strokes"),
        (255 * torch.rand(3, 64, 64), {}, r"exemplar has values from .* / 255"),
        (torch.rand(64, 64, 3), {}, r"exemplar has shape"),
        (torch.rand(3, 64, 64), {"detail": -1.0}, r"detail must be"),
        (torch.rand(3, 64, 64), {"local": 2.0}, r"local must be"),
        (torch.rand(3, 64, 64), {"palette": 2.0}, r"palette must be"),
        (torch.rand(3, 64, 64), {"turns": 0}, r"turns must be a whole number of at least 1, got 0"),
        (torch.rand(3, 64, 64), {"steps": -1}, r"steps must be a whole number of at least 0, got -1"),
        (torch.rand(3, 64, 64), {"seed": -1}, r"seed must be a whole number of at least 0, got -1"),
    ],
)
def test_what_cannot_be_painted_with(exemplar: Tensor, arguments: dict, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        isp.TextureTransfer(exemplar, **arguments)


def test_nan_is_refused() -> None:
    picture = torch.rand(1, 3, 16, 16)
    picture[0, 1, 2, 3] = math.nan
    with pytest.raises(ValueError, match=r"picture has 1 values that are NaN or infinite. Use picture.nan_to_num"):
        isp.TextureTransfer(torch.rand(3, 64, 64))(picture)


def test_it_repaints_pictures_only() -> None:
    with pytest.raises(ValueError, match=r"TextureTransfer repaints pictures \(B,3,H,W\)"):
        isp.TextureTransfer(torch.rand(3, 64, 64))(torch.rand(1, 1, 8, 8))


@pytest.mark.slow
def test_what_was_made_of_an_exemplar_is_kept_until_it_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    real = exemplars.Exemplar.of.__func__
    monkeypatch.setattr(
        exemplars.Exemplar, "of", classmethod(lambda cls, *args, **how: made.append(0) or real(cls, *args, **how))
    )
    shown = torch.rand(1, 3, 64, 64, generator=seeded())
    stage = isp.TextureTransfer(painting("strokes", size=64), seed=0, turns=1, steps=1)
    with torch.no_grad():
        first, second = stage(shown), stage(shown)
        assert len(made) == 1
        assert torch.equal(first, second)
        stage.exemplar.mul_(0.5)  # in place, as load_state_dict does
        changed = stage(shown)
        assert len(made) == 2
        fresh = isp.TextureTransfer(stage.exemplar.clone(), seed=0, turns=1, steps=1)(shown)
        assert torch.equal(changed, fresh)
        stage.detail = 1.0
        assert not torch.equal(stage(shown), changed)
        assert torch.equal(copy.deepcopy(stage)(shown), stage(shown))
    trained = isp.TextureTransfer(nn.Parameter(painting("strokes", size=64)), seed=0, turns=1, steps=1)
    made.clear()
    slopes = [torch.autograd.grad(trained(shown).sum(), trained.exemplar)[0] for _ in range(2)]
    assert len(made) == 2  # a graph is never kept
    assert torch.equal(*slopes)
    with torch.no_grad():
        for _ in range(2):
            trained(shown)
    assert len(made) == 3
