from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from stages import painting_stage
from torch import Tensor, nn

import kcam.augmentation as KC
from kcam import Camera, Context, Scene, isp
from kcam.isp import StyleStage, style_stage
from kcam.isp.style_stage import DARKEST, stroke_kernels

SMALL = {"width": 4, "dilations": (1, 2)}


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def painted(stage: StyleStage, picture: Tensor, seed: int = 0) -> Tensor:
    with torch.no_grad():
        return stage(picture, Context(generator=seeded(seed)))


def random_picture(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.rand(*shape, generator=seeded(7), dtype=dtype)


def smooth_picture(height: int, width: int) -> Tensor:
    """Soft shapes: what is sharp in its painting the stage has made."""
    coarse = random_picture(1, 3, 1 + height // 40, 1 + width // 40)
    return nn.functional.interpolate(coarse, size=(height, width), mode="bicubic").clamp(0, 1)


def camera_with(stage: StyleStage) -> Camera:
    return Camera(*Camera.phone(), stage)


# ---- as it starts ---------------------------------------------------------------------------------------------------


def test_at_first_nothing_changes_but_black_and_white() -> None:
    picture = random_picture(2, 3, 20, 24)
    picture[0, :, 0, :4] = torch.tensor([0.0, 0.02, 0.98, 1.0])
    result = painted(StyleStage(), picture)
    # sigmoid of logit in float32 near 1: a rounding of 1.2e-7 in p, so 1e-6 for a few of them
    assert (result - picture.clamp(DARKEST, 1 - DARKEST)).abs().max() < 1e-6
    assert result.min() >= DARKEST - 1e-6
    assert result.max() <= 1 - DARKEST + 1e-6


def test_every_stage_starts_alike_and_leaves_torchs_own_random_state_alone() -> None:
    torch.manual_seed(1)
    before = torch.get_rng_state()
    one = StyleStage(**SMALL)
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(2)
    two = StyleStage(**SMALL)
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), two.parameters(), strict=True))
    one.mean()
    assert torch.equal(torch.get_rng_state(), torch.manual_seed(2).get_state())


def test_it_can_be_built_where_tensors_are_not_on_the_cpu_by_default() -> None:
    with torch.device("meta"):
        assert StyleStage(**SMALL).leave.weight.shape == (3, 8, 5, 5)


# ---- randomness -----------------------------------------------------------------------------------------------------


def test_the_generator_decides_the_picture() -> None:
    stage, picture = painting_stage(**SMALL), random_picture(1, 3, 24, 28)
    one = painted(stage, picture, seed=1)
    assert torch.equal(one, painted(stage, picture, seed=1))
    assert (one - painted(stage, picture, seed=2)).abs().mean() > 1e-3  # 0.25 of a step of 8 bits on average
    with torch.no_grad():
        torch.manual_seed(1)
        free = stage(picture)
        torch.manual_seed(1)
        assert torch.equal(free, stage(picture))


def test_rows_of_a_batch_have_their_own_noise() -> None:
    stage, picture = painting_stage(**SMALL), random_picture(1, 3, 24, 28)
    one, two = painted(stage, picture.expand(2, -1, -1, -1))
    assert not torch.equal(one, two)


@pytest.mark.parametrize("noise", [(1, 4, 4), (0, 0, 0), (0, 3, 0), (2, 0, 1)])
def test_without_noise_the_picture_is_one(noise: tuple[int, int, int]) -> None:
    stage, picture = painting_stage(noise=noise, **SMALL), random_picture(1, 3, 24, 28)
    quiet = stage.mean()
    assert torch.equal(painted(quiet, picture, seed=1), painted(quiet, picture, seed=2))
    assert torch.equal(painted(quiet, picture), painted(quiet.mean(), picture))
    assert (painted(stage, picture) - painted(quiet, picture)).abs().max() > (1e-3 if sum(noise) else -1)


def test_the_mean_shares_the_weights() -> None:
    stage = painting_stage(**SMALL)
    quiet = stage.mean()
    assert quiet.level == 0
    assert {id(p) for p in quiet.parameters()} == {id(p) for p in stage.parameters()}
    assert quiet.state_dict().keys() == stage.state_dict().keys()
    before = painted(quiet, picture := random_picture(1, 3, 12, 12))
    with torch.no_grad():
        stage.leave.bias += 1
        stage.colour *= 0.5
    assert not torch.equal(before, painted(quiet, picture))


def test_level_scales_the_noise() -> None:
    one, half = (StyleStage(level=level)._noise(torch.zeros(1, 3, 16, 16), seeded()) for level in (1.0, 0.5))
    for a, b in zip(one, half, strict=True):
        torch.testing.assert_close(0.5 * a, b)


def noise_planes(seed: int = 0) -> tuple[Tensor, Tensor]:
    return StyleStage(noise=(1, 2, 4))._noise(torch.zeros(1, 3, 256, 320), seeded(seed))


def test_noise_has_unit_variance_everywhere() -> None:
    fine, coarse = noise_planes()
    assert fine.shape == (1, 5, 256, 320)
    assert coarse.shape == (1, 4, 64, 80)
    # the variance of n independent samples strays by sqrt(2 / n): 0.005 for 82 000, 0.02 for 5120; four times that.
    assert (fine[:, :1].var((2, 3)) - 1).abs().max() < 0.02
    assert (coarse.var((2, 3)) - 1).abs().max() < 0.08
    # drawn-out noise has an independent sample per 4 pi sigma1 sigma2 = 132 pixels: 620 of them, 0.057
    assert (fine[:, 1:3].var((2, 3)) - 1).abs().max() < 0.23
    # the wide planes have a quarter of these samples, 0.11, and lose 4 % where they are doubled: means of neighbours
    assert (fine[:, 3:].var((2, 3)) - 0.96).abs().max() < 0.45


def test_drawn_out_noise_is_no_weaker_at_the_border() -> None:
    rims = []
    for seed in range(8):
        fine = noise_planes(seed)[0][:, 1:3]
        rims.append(torch.cat([fine[..., 0, :], fine[..., -1, :], fine[..., 0], fine[..., -1]], dim=-1))
    # 8 rims of 1152 pixels, an independent sample per 2 sqrt(pi) 7 = 25 pixels at most: 370 of them, 0.074; three times
    # that. With zeros around the picture half of the kernel would be missing: 0.5.
    assert (torch.cat(rims, -1).var(-1) - 1).abs().max() < 0.23


def directions(plane: Tensor, *, window: int | None) -> Tensor:
    """(2,..): (a - b) / (a + b) of the structure tensor's eigenvalues, along twice the angle of its first axis."""
    dy = (plane[2:, 1:-1] - plane[:-2, 1:-1])[None]
    dx = (plane[1:-1, 2:] - plane[1:-1, :-2])[None]
    products = torch.stack([dx * dx - dy * dy, 2 * dx * dy, dx * dx + dy * dy], dim=1)
    means = products.mean((2, 3)) if window is None else torch.nn.functional.avg_pool2d(products, window)
    return means[0, :2] / means[0, 2]


def coherence(plane: Tensor, *, window: int | None) -> Tensor:
    """1 where all is drawn out along one direction, 0 where none is preferred."""
    return torch.linalg.vector_norm(directions(plane, window=window), dim=0)


def test_drawn_out_noise_has_one_direction_at_each_place_and_all_over_the_picture() -> None:
    """Gradients of Gaussians of 7 by 2.2 pixels: (49 - 4.8) / (49 + 4.8) = 0.82, and less where they turn."""
    fine = torch.cat([noise_planes(seed)[0][0] for seed in range(4)])
    white, *drawn_out = fine[::5], fine[1::5], fine[2::5]
    for plane in torch.cat(drawn_out):
        assert coherence(plane, window=16).mean() > 0.6
        assert coherence(plane, window=None) < 0.35  # some 150 places of their own direction: 0.06 for each seed
    for plane in white:
        assert coherence(plane, window=16).mean() < 0.2


def test_every_second_plane_is_drawn_out_across_the_one_before() -> None:
    """Twice the angle is then opposite. Windows grow with the strokes, so that they hold as many."""
    fine = noise_planes()[0][0]
    for along, across, window in ((fine[1], fine[2], 16), (fine[3], fine[4], 32)):
        a, b = (directions(plane, window=window) for plane in (along, across))
        agreement = (a * b).sum(0) / (torch.linalg.vector_norm(a, dim=0) * torch.linalg.vector_norm(b, dim=0))
        assert agreement.mean() < -0.7


def test_drawn_out_noise_in_strips(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = noise_planes()[0]
    monkeypatch.setattr(style_stage, "TILE", 64)
    torch.testing.assert_close(noise_planes()[0], whole)


def test_stroke_kernels_turn_with_their_number() -> None:
    kernels = stroke_kernels()
    assert kernels.shape == (8, 29, 29)
    torch.testing.assert_close(kernels.square().sum((-2, -1)), torch.ones(8, dtype=torch.float64))
    torch.testing.assert_close(kernels[0].T, kernels[4])
    torch.testing.assert_close(kernels[2].flip(-1), kernels[6])
    overlaps = (kernels[:-1] * kernels[1:]).sum((1, 2))
    assert overlaps.max() < 1.02 * overlaps.min()  # one number serves all neighbours


@pytest.mark.parametrize("size", [(40, 57), (29, 64)])
def test_noise_is_drawn_out_by_the_convolution(size: tuple[int, int]) -> None:
    kernels = stroke_kernels()
    white = torch.randn(2, 3, *size, dtype=torch.float64, generator=seeded())
    sums = torch.nn.functional.conv2d(white.flatten(0, 1)[:, None], kernels[:, None]).unflatten(0, (2, 3))
    torch.testing.assert_close(style_stage._drawn_out(white, kernels), sums)


def test_whole_numbers_are_no_picture() -> None:
    with pytest.raises(TypeError, match=r"of torch.uint8. Use signal.float\(\) / 255"):
        StyleStage()(torch.full((1, 3, 8, 8), 200, dtype=torch.uint8))


# ---- gradients ------------------------------------------------------------------------------------------------------


def test_what_went_too_far_can_come_back() -> None:
    """A sigmoid at 60 has no gradient; at its bound it has one, and only inwards."""
    stage, picture = painting_stage(**SMALL), random_picture(1, 3, 16, 16)
    with torch.no_grad():
        stage.leave.bias.fill_(60.0)
    bias = stage.leave.bias
    bright = stage(picture, Context(generator=seeded()))
    torch.testing.assert_close(bright, torch.full_like(bright, torch.sigmoid(torch.tensor(4.0)).item()))
    darker, brighter = (torch.autograd.grad(sign * bright.sum(), bias, retain_graph=True)[0] for sign in (1, -1))
    assert (darker > 1).all()
    assert (brighter == 0).all()


def test_the_gradient_is_the_slope() -> None:
    """In float64, along random directions of picture and weights, against a central difference."""
    stage = painting_stage(width=2, dilations=(1,), noise=(1, 2, 1)).double()
    picture = random_picture(1, 3, 9, 11, dtype=torch.float64) * 0.8 + 0.1
    weights = random_picture(1, 3, 9, 11, dtype=torch.float64)
    values = [picture.requires_grad_(), *stage.parameters()]

    def loss() -> Tensor:
        return (stage(picture, Context(generator=seeded())) * weights).sum()

    slopes = torch.autograd.grad(loss(), values)
    directions = seeded(3)
    for value, slope in zip(values, slopes, strict=True):
        along = torch.randn(value.shape, generator=directions, dtype=torch.float64)
        step = 1e-6  # the error of the difference is step^2 = 1e-12, of the rounding 1e-16 / 1e-6 = 1e-10
        with torch.no_grad():
            value += step * along
            up = loss()
            value -= 2 * step * along
            down = loss()
            value += step * along
        expected = float((up - down) / (2 * step))
        # a few of the ReLUs may lie within 1e-6 of their corner: 1e-5 of the slope, not 1e-9
        assert float((slope * along).sum()) == pytest.approx(expected, rel=1e-5, abs=1e-7)


def test_at_the_start_the_last_layer_learns_and_then_all_others() -> None:
    stage, picture = StyleStage(**SMALL), random_picture(1, 3, 16, 16)
    stage(picture, Context(generator=seeded())).square().mean().backward()
    assert stage.leave.weight.grad.abs().max() > 0
    assert stage.colour.grad.abs().max() > 0
    with torch.no_grad():
        stage.leave.weight -= 0.1 * stage.leave.weight.grad
    stage.zero_grad()
    stage(picture, Context(generator=seeded())).square().mean().backward()
    for name, parameter in stage.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        # a bias in front of a normalisation is taken off again
        if not name.endswith("bias") or "norm" in name or name in ("leave.bias", "enter_norm.bias"):
            assert parameter.grad.abs().max() > 0, name


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_an_even_picture_has_finite_gradients(value: float) -> None:
    """No variance to divide by, and no logit at 0 and 1."""
    stage = painting_stage(level=0.0, **SMALL)
    picture = torch.full((1, 3, 16, 16), value, requires_grad=True)
    stage(picture).sum().backward()
    assert picture.grad.isfinite().all()
    assert all(p.grad.isfinite().all() for p in stage.parameters())


# ---- sizes, types, devices ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(1, 1), (5, 7), (1, 9), (4, 4), (13, 8), (30, 31)])
def test_any_size(size: tuple[int, int]) -> None:
    stage = painting_stage()  # with its widest dilation, beyond the whole of a small picture
    picture = random_picture(2, 3, *size).requires_grad_()
    result = stage(picture, Context(generator=seeded()))
    assert result.shape == (2, 3, *size)
    result.sum().backward()
    assert result.isfinite().all()
    assert picture.grad.isfinite().all()
    assert (result > 0).all()
    assert (result < 1).all()


def test_an_empty_batch() -> None:
    stage = painting_stage(**SMALL)
    assert stage(torch.zeros(0, 3, 8, 9)).shape == (0, 3, 8, 9)
    assert stage(torch.zeros(2, 3, 0, 9)).shape == (2, 3, 0, 9)


def test_what_lies_beyond_the_size_does_not_matter() -> None:
    """A side is filled up to a multiple of 4 by the border: 0 levels of 8 bits would not do, 0.02 is 5."""
    stage, picture = painting_stage(level=0.0, strength=0.01, **SMALL), smooth_picture(64, 64)
    cut, whole = painted(stage, picture[..., :61, :62]), painted(stage, picture)[..., :61, :62]
    assert (cut - whole)[..., :32, :32].abs().max() < 0.02


def test_dtype_and_device_are_the_pictures(device: torch.device, dtype: torch.dtype) -> None:
    stage = painting_stage(**SMALL).to(device)
    picture = random_picture(1, 3, 12, 16).to(device, dtype)
    result = painted(stage, picture)
    assert (result.dtype, result.device) == (picture.dtype, picture.device)
    expected = painted(painting_stage(**SMALL), random_picture(1, 3, 12, 16))
    torch.testing.assert_close(result.cpu().float(), expected, atol=1e-3, rtol=0)  # TF32 or the order of sums


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16])
def test_half_precision_pictures(kind: torch.dtype) -> None:
    stage, picture = painting_stage(**SMALL), random_picture(1, 3, 12, 16)
    result = painted(stage, picture.to(kind))
    assert result.dtype == kind
    # 0.004 is half a step of bfloat16 below 1; the stage may stretch it
    torch.testing.assert_close(result.float(), painted(stage, picture), atol=0.03, rtol=0)


def test_float64_weights_take_float32_pictures() -> None:
    assert painted(painting_stage(**SMALL).double(), random_picture(1, 3, 8, 8)).dtype == torch.float32


def test_autocast(hardware: torch.device) -> None:
    """Type of the picture, values to what bfloat16 resolves."""
    stage, picture = painting_stage(**SMALL).to(hardware), random_picture(1, 3, 24, 28).to(hardware)
    expected = painted(stage, picture)
    with torch.autocast(hardware.type, dtype=torch.bfloat16):
        result = painted(stage, picture)
    assert result.dtype == torch.float32
    assert (result - expected).abs().mean() < 0.01  # 8 bits of mantissa, 2 to 3 levels of 8 bits
    assert result.isfinite().all()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"width": 0}, "width must be .* got \\(0,\\)"),
        ({"width": 2.5}, "width must be"),
        ({"dilations": ()}, "dilations must be .* got \\(\\)"),
        ({"dilations": (1, 0)}, "dilations must be"),
        ({"noise": (1, -1, 1)}, "noise must be three whole numbers >= 0"),
        ({"noise": (1, 4)}, "noise must be three whole numbers >= 0"),
        ({"level": -0.1}, "level must be a finite number >= 0, got -0.1"),
        ({"level": math.nan}, "level must be a finite number >= 0, got nan"),
        ({"level": math.inf}, "level must be a finite number >= 0, got inf"),
    ],
)
def test_errors(arguments: dict, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        StyleStage(**arguments)


@pytest.mark.parametrize("shape", [(3, 8, 8), (1, 1, 8, 8), (1, 4, 8, 8)])
def test_what_is_no_picture(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="repaints pictures .B,3,H,W., got shape .* behind the ToneCurve"):
        StyleStage(**SMALL)(torch.zeros(shape))


# ---- tiles ----------------------------------------------------------------------------------------------------------


def with_tiles(monkeypatch: pytest.MonkeyPatch, tile: int, pixels: int = 0) -> None:
    monkeypatch.setattr(style_stage, "SEEN_AT_ONCE", pixels)
    monkeypatch.setattr(style_stage, "TILE", tile)


@pytest.mark.parametrize("size", [(160, 200), (96, 333), (41, 250)])
def test_tiles_are_the_whole_with_its_statistics(size: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    stage, picture = painting_stage(), smooth_picture(*size)
    height, width = size
    filled = nn.functional.pad(picture, (0, -width % 4, 0, -height % 4), mode="replicate")
    seen: list = []
    with torch.no_grad():
        whole = stage._paint(filled, stage._noise(filled, seeded()), seen=seen)[..., :height, :width]
    with_tiles(monkeypatch, 48)
    own = StyleStage._paint

    def with_those_of_the_whole(self, picture, noise, *, given=None, seen=None):
        return own(self, picture, noise, given=None if given is None else statistics, seen=seen)

    statistics = seen
    monkeypatch.setattr(StyleStage, "_paint", with_those_of_the_whole)
    tiled = painted(stage, picture)
    # convolutions may sum in another order: 1e-6 in float32, in values up to 1
    assert (tiled - whole).abs().max() < 1e-5


def test_the_reach_is_as_far_as_a_pixel_acts() -> None:
    """And not much farther, which would cost time: within 12 pixels."""
    stage = painting_stage(width=2, dilations=(1, 2)).double()
    side = 2 * stage.reach + 61
    picture = random_picture(1, 3, side, side, dtype=torch.float64) * 0.8 + 0.1
    filled = nn.functional.pad(picture, (0, -side % 4, 0, -side % 4), mode="replicate")
    noise = stage._noise(filled, seeded())
    seen: list = []
    furthest = 0
    with torch.no_grad():
        before = stage._paint(filled, noise, seen=seen)
        for place in range(stage.reach + 28, stage.reach + 32):  # all four phases
            touched = filled.clone()
            touched[..., place, place] += 0.1
            moved = (stage._paint(touched, noise, given=seen) - before).abs().amax((0, 1)) > 1e-14
            furthest = max(furthest, int((moved.nonzero() - place).abs().max()))
    assert stage.reach - 12 <= furthest <= stage.reach


def seam(picture: Tensor, tile: int) -> float:
    """The mean step across the borders of tiles, over that of the four columns (or rows) on both sides."""
    found = []
    for steps in (picture.diff(dim=-1).abs().mean((0, 1, 2)), picture.diff(dim=-2).abs().mean((0, 1, 3))):
        at = torch.arange(tile - 1, len(steps) - 4, tile)
        beside = torch.stack([steps[at + offset] for offset in range(-4, 5) if offset])
        found.append(float(steps[at].mean() / beside.mean()))
    return max(found)


@pytest.mark.slow
def test_no_seams(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the statistics of windows the steps across the borders of tiles are those of their neighbourhood."""
    stage, picture = painting_stage(), smooth_picture(260, 324)
    with_tiles(monkeypatch, 64)
    assert seam(painted(stage, picture), 64) < 1.05  # measured 0.99, and 1.01 at these places without tiles
    monkeypatch.setattr(StyleStage, "reach", 4)  # tiles that do not see what is around them
    assert seam(painted(stage, picture), 64) > 1.05


def test_tiles_of_a_batch_are_those_of_its_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    stage = painting_stage(level=0.0, **SMALL)
    picture = random_picture(2, 3, 40, 52)
    with_tiles(monkeypatch, 16)
    both = painted(stage, picture)
    for one, alone in zip(both, picture, strict=True):
        torch.testing.assert_close(one[None], painted(stage, alone[None]), atol=1e-6, rtol=0)


def test_gradients_pass_through_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    stage, picture = painting_stage(**SMALL), random_picture(1, 3, 40, 52).requires_grad_()
    with_tiles(monkeypatch, 16)
    stage(picture, Context(generator=seeded())).sum().backward()
    assert (picture.grad.abs().amax((0, 1)) > 0).all()


# ---- in a camera ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.builtin("coffee", 40)


def test_save_and_load(scene: Scene, tmp_path: Path) -> None:
    camera = camera_with(painting_stage(width=4, dilations=(1, 3), noise=(0, 2, 1), level=0.7))
    camera.save(tmp_path / "styled.safetensors")
    before = torch.get_rng_state()
    loaded = Camera.load(tmp_path / "styled.safetensors")
    assert torch.equal(before, torch.get_rng_state())
    stage = loaded[-1]
    assert (stage.width, stage.dilations, stage.noise, stage.level) == (4, (1, 3), (0, 2, 1), 0.7)
    with torch.no_grad():
        one, two = (each(scene, generator=seeded(3)) for each in (camera, loaded))
        assert torch.equal(one, two)
        assert not torch.equal(one, loaded(scene, generator=seeded(4)))


def test_a_camera_without_noise_is_without_the_stages_too(scene: Scene) -> None:
    camera = camera_with(painting_stage(**SMALL)).noiseless()
    with torch.no_grad():
        assert torch.equal(camera(scene, generator=seeded(1)), camera(scene, generator=seeded(2)))
    assert camera[-1].level == 0


def test_plans_hold_for_what_comes_before_the_stage(scene: Scene) -> None:
    camera = camera_with(painting_stage(**SMALL))
    with torch.no_grad():
        plan = camera.plan(scene, tolerance=0.05)
        planned = plan.apply(camera)
        assert isinstance(planned[-1], StyleStage)
        assert {id(p) for p in planned[-1].parameters()} == {id(p) for p in camera[-1].parameters()}
        assert planned(scene, generator=seeded()).shape == (1, 3, *scene.shape[1:])
        explained = camera.explain(scene, tolerance=0.05, measure=True)
        assert explained.measured["error"] <= 0.05
        assert "Measured: error" in str(explained)
        assert camera(scene, generator=seeded(), tolerance=0.05).isfinite().all()


def test_a_picture_that_a_camera_takes_of_pictures() -> None:
    """As an augmentation: a picture of the same size in [0,1], another one at each call."""
    camera = camera_with(painting_stage(**SMALL))
    augmentation = KC.RandomCamera(cameras=[camera], p=1.0)
    pictures = random_picture(2, 3, 24, 32)
    torch.manual_seed(0)
    with torch.no_grad():
        one, two = augmentation(pictures), augmentation(pictures)
    assert one.shape == pictures.shape
    assert one.min() >= 0
    assert one.max() <= 1
    assert not torch.equal(one, two)


def test_a_float64_scene_gives_a_float64_picture(scene: Scene) -> None:
    camera = camera_with(painting_stage(**SMALL))
    with torch.no_grad():
        assert camera(scene.to(dtype=torch.float64), generator=seeded()).dtype == torch.float64


def test_it_stands_behind_the_tone_curve_and_says_what_it_is() -> None:
    assert "width=16, dilations=(1, 2, 4, 8), noise=(0, 2, 8), level=1" in repr(isp.StyleStage())


def test_a_normalisation_with_given_statistics_is_that_with_its_own() -> None:
    """Pictures in tiles and whole ones take two ways to one formula."""
    norm = style_stage._Norm(3).double()
    with torch.no_grad():
        norm.weight.copy_(torch.tensor([0.5, 1.0, 2.0]))
        norm.bias.copy_(torch.tensor([-1.0, 0.0, 1.0]))
    x = torch.randn(1, 3, 6, 5, dtype=torch.float64, generator=seeded())
    seen: list = []
    pooled = norm(x, None, seen)
    torch.testing.assert_close(norm(x, None, None), pooled)
    torch.testing.assert_close(norm(x, iter(seen), None), pooled)
    expected = (x - x.mean((2, 3), keepdim=True)) / (x.var((2, 3), correction=0, keepdim=True) + 1e-5).sqrt()
    torch.testing.assert_close(pooled, expected * norm.weight[:, None, None] + norm.bias[:, None, None])


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_weights_of_16_bits(dtype: torch.dtype) -> None:
    picture = random_picture(1, 3, 24, 32)
    with torch.no_grad():
        painted = painting_stage(**SMALL).to(dtype)(picture, Context(generator=seeded()))
    assert painted.isfinite().all()
