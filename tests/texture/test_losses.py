"""The losses: each against its equation in numpy, what it sees and what not, and their sum."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view
from torch import Tensor, nn

from kcam.scene import PHOTOGRAPHS
from kcam.style import SteerableFeatures, StyleLoss, painting
from kcam.texture.losses import (
    DIRECTIONS,
    TURNS,
    colour_directions,
    colour_loss,
    content_loss,
    correlation_loss,
    gram_loss,
    gram_matrix,
    l2_loss,
    luminance,
    moment_loss,
    moments,
    resampled,
    style_crops,
    total_variation,
)


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.fixture(scope="module")
def photograph() -> Tensor:
    return torch.tensor(PHOTOGRAPHS["astronaut"]()[0]).permute(2, 0, 1)[None, :, 128:256, 128:256] / 255


@pytest.fixture(scope="module")
def style() -> Tensor:
    return painting("strokes", size=128)


# ---- the thesis's equations ----------------------------------------------------------------------------------------


def test_content_is_eq_3_10():
    y, t = noise(2, 5, 6, 7), noise(2, 5, 6, 7, seed=1)
    each = [np.sum((y[b] - t[b]).numpy() ** 2) / (5 * 6 * 7) for b in range(2)]
    assert content_loss(y, t).item() == pytest.approx(np.mean(each), rel=1e-12)


def test_gram_is_eq_3_11():
    phi = noise(2, 4, 5, 6)
    gram = gram_matrix(phi)
    for b, c, d in np.ndindex(2, 4, 4):
        expected = sum(phi[b, c, h, w].item() * phi[b, d, h, w].item() for h, w in np.ndindex(5, 6)) / (4 * 5 * 6)
        assert gram[b, c, d].item() == pytest.approx(expected, rel=1e-12)


def test_style_is_eq_3_12():
    gram, target = noise(3, 4, 4), noise(4, 4, seed=1)
    each = [np.linalg.norm((gram[b] - target).numpy(), "fro") ** 2 for b in range(3)]
    assert gram_loss(gram, target).item() == pytest.approx(np.mean(each), rel=1e-12)


def test_l2_and_total_variation():
    y, t = noise(2, 3, 6, 7), noise(2, 3, 6, 7, seed=1)
    assert l2_loss(y, t).item() == pytest.approx(np.mean((y - t).numpy() ** 2), rel=1e-12)
    x = y.numpy()
    expected = np.mean(np.diff(x, axis=2) ** 2) + np.mean(np.diff(x, axis=3) ** 2)
    assert total_variation(y).item() == pytest.approx(expected, rel=1e-12)
    assert total_variation(torch.full((1, 3, 4, 4), 0.7)) == 0


def test_the_thesis_loss_by_hand(style: Tensor, photograph: Tensor):
    """Eq. 3.13 with the Gram matrices of a style of one crop: the weighted sum, layer by layer."""
    features = SteerableFeatures()
    weights = {"style": 2.0, "colour": 0.0, "content": 0.7, "l2": 3.0, "tv": 0.5}
    loss = StyleLoss(style, statistic="gram", content_by="features", content_layer="scale 1", **weights)
    y, scene = noise(2, 3, 128, 128).float(), photograph.expand(2, -1, -1, -1)
    phi, phi_style, phi_scene = (
        {name: layer.double().numpy() for name, layer in features(x).items()} for x in (y, style[None], scene)
    )

    def gram(layer: np.ndarray) -> np.ndarray:
        return np.einsum("chw,dhw->cd", layer, layer) / layer.size

    expected = {
        "style": 2.0 * sum(
            np.mean([np.sum((gram(phi[name][b]) - gram(phi_style[name][0])) ** 2) for b in range(2)]) for name in phi
        ),
        "content": 0.7 * np.mean((phi["scale 1"] - phi_scene["scale 1"]) ** 2),
        "l2": 3.0 * np.mean((y - scene).numpy() ** 2),
        "tv": 0.5 * total_variation(y).item(),
    }  # fmt: skip
    terms = loss.terms(y, scene)
    assert list(terms) == list(expected)
    for name, value in expected.items():
        assert terms[name].item() == pytest.approx(value, rel=1e-4), name  # sums over 16384 pixels in float32
    assert loss(y, scene).item() == pytest.approx(sum(expected.values()), rel=1e-4)


# ---- mean and covariance -------------------------------------------------------------------------------------------


def test_moments_are_numpys():
    phi = noise(2, 4, 5, 6)
    mean, covariance = moments(phi)
    for b in range(2):
        flat = phi[b].flatten(1).numpy()
        assert np.abs(mean[b].numpy() - flat.mean(1)).max() < 1e-14
        assert np.abs(covariance[b].numpy() - np.cov(flat, bias=True)).max() < 1e-14


def test_moments_have_the_gradient_of_their_formula():
    """To the second order: who penalises gradients may."""
    phi = noise(2, 3, 2, 4).requires_grad_()
    assert torch.autograd.gradcheck(moments, phi)
    assert torch.autograd.gradgradcheck(moments, phi)


def test_moments_under_torch_func():
    phi = noise(4, 2, 3, 2, 4)

    def total(phi: Tensor) -> Tensor:
        mean, covariance = moments(phi)
        return mean.square().sum() + covariance.square().sum()

    each = torch.func.vmap(torch.func.grad(total))(phi)
    for own, one in zip(each, phi, strict=True):
        one = one.clone().requires_grad_()
        torch.testing.assert_close(own, torch.autograd.grad(total(one), one)[0])


def test_moment_loss_by_its_equation():
    mean, covariance = noise(2, 3), noise(2, 3, 3)
    target_mean, target_covariance = noise(3, seed=1), noise(3, 3, seed=1)
    v = 0.1 * 0.7
    each = []
    for b in range(2):
        of_mean = np.sum((mean[b] - target_mean).numpy() ** 2) / (np.trace(target_covariance.numpy()) + 3 * v)
        norm = np.linalg.norm(target_covariance.numpy()) ** 2 + 3 * v**2
        each.append(of_mean + np.linalg.norm((covariance[b] - target_covariance).numpy()) ** 2 / norm)
    found = moment_loss(mean, covariance, target_mean=target_mean, target_covariance=target_covariance, natural=0.7)
    assert found.item() == pytest.approx(np.mean(each), rel=1e-12)


def test_moment_loss_does_not_weigh_by_scale():
    """Features ten times as large, of ten times the natural deviation, give the same loss: a Gram matrix, 10^4."""
    x, y = noise(1, 4, 16, 16), noise(1, 4, 16, 16, seed=1) ** 2
    losses = []
    for gain in (1, 10):
        mean, covariance = moments(gain * y)
        losses.append(moment_loss(*moments(gain * x), target_mean=mean[0], target_covariance=covariance[0],
                                  natural=0.5 * gain**2).item())  # fmt: skip
    assert losses[0] == pytest.approx(losses[1], rel=1e-12)


def test_the_style_is_pooled_over_its_crops():
    """Of crops side by side: mean and covariance of all their pixels, not a mean of covariances."""
    picture = noise(3, 64, 192)
    picture[:, :, 64:128] *= 0.3
    loss = StyleLoss(picture, crop=64)
    crops = style_crops(picture, side=64, multiple=16, least=64)
    assert torch.equal(crops, torch.stack(picture.split(64, dim=2)))
    for name, layer in SteerableFeatures()(crops).items():
        mean, covariance = moments(layer.transpose(0, 1).flatten(1)[None, :, None])
        assert torch.allclose(loss.targets[name][0], mean[0], rtol=0, atol=1e-12)
        assert torch.allclose(loss.targets[name][1], covariance[0], rtol=0, atol=1e-12)


# ---- colour --------------------------------------------------------------------------------------------------------


def test_directions_are_spread_over_the_half_sphere():
    directions = colour_directions()
    assert directions.shape == (DIRECTIONS, 3)
    assert (directions.norm(dim=1) - 1).abs().max() < 1e-15
    # Even ones have I / 3, and 16 caps of equal area on half of the sphere are 29 degrees wide.
    assert (directions.T @ directions / DIRECTIONS - torch.eye(3) / 3).abs().max() < 0.03
    between = (directions @ directions.T).abs().fill_diagonal_(0).max()
    assert math.degrees(math.acos(between)) > 15  # 19


def one_direction(picture: Tensor, style: Tensor, direction: tuple[float, ...], deviation: float = 1.0) -> float:
    d = torch.tensor([direction], dtype=torch.float64)
    quantiles = torch.einsum("dc,cn->dn", d, style.flatten(1)).sort(-1).values
    found = colour_loss(picture, directions=d, quantiles=quantiles, deviation=torch.tensor([deviation]).double())
    return found.item()


def test_colour_of_a_shift_is_the_shift():
    style = noise(3, 8, 8)
    shift = torch.tensor([0.2, -0.1, 0.4], dtype=torch.float64)[:, None, None]
    for direction in ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (0.6, 0.8, 0.0)):
        expected = abs(direction[0] * 0.2 - direction[1] * 0.1 + direction[2] * 0.4) / 0.5
        assert one_direction((style + shift)[None], style, direction, 0.5) == pytest.approx(expected, rel=1e-12)


def test_colour_of_a_stretch():
    """Uniform on [0,1] against uniform on [0,2]: W1 = mean of q = 1/2."""
    values = ((torch.arange(100).double() + 0.5) / 100).reshape(1, 10, 10).expand(3, -1, -1)
    assert one_direction(2 * values[None], values, (1.0, 0.0, 0.0)) == pytest.approx(0.5, rel=1e-12)


def test_colour_is_blind_to_place(style: Tensor):
    loss = StyleLoss(style, style=0, content=0, colour=1)
    order = torch.randperm(128 * 128, generator=torch.Generator().manual_seed(0))
    shuffled = style.flatten(1)[:, order].reshape(1, 3, 128, 128)
    # The same projections in another order of pixels: rounding of a sum of three products, 6e-8.
    assert loss(shuffled).item() < 1e-6
    exchanged = style[None, [1, 0, 2]]
    assert loss(exchanged).item() > 0.05
    assert loss(1 - style[None]).item() > loss(exchanged).item()


def test_all_turns_together_are_all_directions(style: Tensor, photograph: Tensor):
    loss = StyleLoss(style, style=0, content=0, colour=1)
    assert DIRECTIONS % TURNS == 0
    turns = [loss.terms(photograph, turn=turn)["colour"].item() for turn in range(2 * TURNS)]
    assert turns[:TURNS] == turns[TURNS:]
    assert len(set(turns)) == TURNS
    full = loss.terms(photograph)["colour"].item()
    assert np.mean(turns) == pytest.approx(full, rel=1e-6)
    own = StyleLoss(style[:, :64, :64], style=0, content=0, colour=1)
    for index, direction in enumerate(colour_directions().float()):
        own.quantiles[index] += 1  # seen along that direction alone, so in one turn of the four
        seen = [turn for turn in range(TURNS) if own.terms(style[None, :, :64, :64], turn=turn)["colour"] > 1e-6]
        own.quantiles[index] -= 1
        assert len(seen) == 1, direction


def test_colour_of_another_size(style: Tensor):
    """The style's quantiles, at the picture's ranks: another painting of the same manner is near at any size."""
    loss = StyleLoss(style, style=0, content=0, colour=1)
    assert loss.quantiles.shape == (DIRECTIONS, 128 * 128)
    for size in (64, (96, 160), 192):
        repeated = painting("strokes", size=size, seed=1)[None]
        assert loss(repeated).item() < 0.3 * loss(noise(1, 3, 64, 64).float()).item()
    # A quarter of the pixels, evenly taken, has the same distribution but for the ranks in between.
    assert loss(style[None, :, ::2, ::2]).item() < 0.02


@pytest.mark.parametrize(("own", "count"), [(8, 8), (8, 4), (8, 16), (8, 5), (5, 12), (1, 3), (3, 1), (2, 7)])
def test_resampled_is_numpys_interpolation(own: int, count: int):
    values = noise(2, own).sort(-1).values
    ranks = [(np.arange(n) + 0.5) / n for n in (own, count)]
    expected = np.stack([np.interp(ranks[1], ranks[0], row) for row in values.numpy()])
    found = resampled(values, count)
    assert found.shape == (2, count)
    # Ranks are float32 numbers of up to 16: 1e-6 of a step.
    assert np.abs(found.numpy() - expected).max() < 1e-5
    assert (found.diff(dim=-1) >= 0).all()


def test_resampled_to_many():
    """Ranks stay right where float32 has few digits left: a million pixels from a crop's 16384."""
    values = ((torch.arange(16384) + 0.5) / 16384).double()[None]
    expected = ((torch.arange(2**20).double() + 0.5) / 2**20).clamp(0.5 / 16384, 1 - 0.5 / 16384)
    assert (resampled(values, 2**20)[0] - expected).abs().max() < 0.1 / 16384


# ---- content -------------------------------------------------------------------------------------------------------


def test_luminance_is_rec_709():
    picture = noise(2, 3, 4, 5)
    expected = 0.2126 * picture[:, 0] + 0.7152 * picture[:, 1] + 0.0722 * picture[:, 2]
    assert (luminance(picture)[:, 0] - expected).abs().max() < 1e-7


@pytest.mark.parametrize("flat", [1e-3, 3e-4, 0.1])
@pytest.mark.parametrize(("level", "shape"), [(1, (16, 20)), (2, (32, 40)), (4, (32, 36))])
def test_correlation_by_its_equation(level: int, shape: tuple[int, int], flat: float):
    picture, scene = noise(2, 3, *shape), noise(2, 3, *shape, seed=1)
    weights = np.array([0.2126, 0.7152, 0.0722])
    planes = []
    for x in (picture, scene):
        gray = np.einsum("c,bchw->bhw", weights, x.numpy())
        gray = gray.reshape(2, shape[0] // level, level, shape[1] // level, level).mean((2, 4))
        side = min(11, *gray.shape[1:])
        windows = sliding_window_view(gray, (side, side), (1, 2))
        planes.append(windows.reshape(*windows.shape[:3], -1))
    y, t = planes
    covariance = (y * t).mean(-1) - y.mean(-1) * t.mean(-1)
    weight = t.var(-1) / (t.var(-1) + flat)
    lost = weight * (1 - covariance / np.sqrt((y.var(-1) + 1e-5) * (t.var(-1) + 1e-5)))
    expected = np.mean(lost)
    assert correlation_loss(picture, scene, levels=(level,), flat=flat).item() == pytest.approx(expected, rel=1e-5)
    assert flat != 1e-3 or correlation_loss(picture, scene, levels=(level,)).item() == pytest.approx(expected, rel=1e-5)
    shown = weight.mean((1, 2))
    for sparse in (1e-3, 0.5 * float(shown.sum()), 1.0):  # below both, between them, and above
        found = correlation_loss(picture, scene, levels=(level,), flat=flat, sparse=sparse).item()
        assert found == pytest.approx(np.mean(lost.mean((1, 2)) / np.maximum(shown, sparse)), rel=1e-5)


def test_a_sparse_scene_counts_like_a_full_one():
    """What is lost of a scene that shows something in one corner, by what it shows there."""
    full, lost = noise(1, 3, 64, 64), noise(1, 3, 64, 64, seed=1)
    corner = torch.full_like(full, 0.5)
    corner[..., :16, :16] = full[..., :16, :16]
    ways = [
        [correlation_loss(lost, x, levels=(1,), sparse=sparse).item() for x in (full, corner)] for sparse in (1, 0.01)
    ]
    assert ways[0][1] < 0.25 * ways[0][0]
    assert ways[1][1] > 0.75 * ways[1][0]


def test_the_whole_picture_is_a_level_more():
    picture, scene = noise(1, 3, 32, 48), noise(1, 3, 32, 48, seed=1)
    coarse, both = (correlation_loss(picture, scene, levels=(2,), whole=whole).item() for whole in (False, True))
    y, t = (luminance(x).flatten().numpy() for x in (picture, scene))
    r = np.cov(y, t, bias=True)[0, 1] / np.sqrt((y.var() + 1e-5) * (t.var() + 1e-5))
    assert 2 * both - coarse == pytest.approx(t.var() / (t.var() + 1e-3) * (1 - r), rel=1e-5)


@pytest.mark.parametrize("levels", [(1,), (1, 2, 4), (2, 4, 8)])
def test_correlation_sees_the_sign_and_not_the_colour(photograph: Tensor, levels: tuple[int, ...]):
    def lost(picture: Tensor) -> float:
        return correlation_loss(picture, photograph, levels=levels).item()

    # Measured at (1, 2, 4): itself .002 (not 0: 1e-5 is added to its variances), flat .785, negative 1.57.
    itself, flat, negative = lost(photograph), lost(torch.full_like(photograph, 0.5)), lost(1 - photograph)
    assert 0 <= itself < 0.004
    assert 0.6 < flat < 1
    assert negative == pytest.approx(2 * flat, rel=0.02)
    assert lost(noise(*photograph.shape).float()) > 0.6
    tint = torch.tensor([0.2, 0.5, 0.9])[:, None, None]
    for same in (0.3 * photograph + 0.1, luminance(photograph).expand(-1, 3, -1, -1), luminance(photograph) * tint):
        assert lost(same) < 0.02


def test_coarse_levels_leave_room_for_strokes(photograph: Tensor):
    stroked = photograph + 0.1 * (painting("strokes", size=128) - 0.45)
    fine, coarse = (correlation_loss(stroked, photograph, levels=(level,)).item() for level in (1, 8))
    assert coarse < 0.5 * fine


# ---- all together --------------------------------------------------------------------------------------------------


def test_the_total_is_the_sum_of_its_terms(style: Tensor, photograph: Tensor):
    weights = {"style": 0.7, "colour": 0.3, "content": 0.2, "l2": 0.4, "tv": 0.6}
    loss = StyleLoss(style, **weights)
    terms = loss.terms(photograph, photograph.flip(-1))
    assert list(terms) == list(weights)
    assert loss(photograph, photograph.flip(-1)).item() == pytest.approx(sum(terms.values()).item(), rel=1e-6)
    for name, weight in weights.items():
        alone = StyleLoss(style, **(dict.fromkeys(weights, 0.0) | {name: 2 * weight}))
        only = alone.terms(photograph, photograph.flip(-1))
        assert list(only) == [name]
        assert only[name].item() == pytest.approx(2 * terms[name].item(), rel=1e-6)


def test_a_batch_is_a_mean(style: Tensor, photograph: Tensor):
    loss = StyleLoss(style, l2=0.1, tv=0.1)
    pictures, scenes = torch.cat([photograph, style[None]]), torch.cat([photograph.flip(-1), photograph])
    both = loss.terms(pictures, scenes)
    each = [loss.terms(pictures[i : i + 1], scenes[i : i + 1]) for i in range(2)]
    for name, value in both.items():
        assert value.item() == pytest.approx((each[0][name] + each[1][name]).item() / 2, rel=1e-5), name


class Counted(nn.Module):
    """Features that count how often they are taken."""

    name, multiple, least = "counted", 1, 4
    natural = {"itself": 1.0}  # noqa: RUF012 (never changed)

    def __init__(self) -> None:
        super().__init__()
        self.calls = 0

    def forward(self, picture: Tensor) -> dict[str, Tensor]:
        self.calls += 1
        return {"itself": picture}


@pytest.mark.parametrize(
    ("how", "calls"),
    [
        ({"style": 1, "content": 1}, 1),
        ({"style": 0, "content": 1}, 0),
        ({"style": 1, "content": 0}, 1),
        ({"style": 1, "content": 1, "content_by": "features"}, 2),
        ({"style": 0, "content": 1, "content_by": "features"}, 2),
        ({"style": 0, "content": 0, "content_by": "features"}, 0),
    ],
)
def test_features_are_taken_only_where_they_are_used(photograph: Tensor, how: dict[str, Any], calls: int):
    features = Counted()
    loss = StyleLoss(photograph[0], features=features, content_layer="itself", **how)
    features.calls = 0
    loss(photograph, photograph)
    assert features.calls == calls


def test_what_was_recorded_takes_the_place_of_the_picture_in_l2(style: Tensor, photograph: Tensor):
    loss = StyleLoss(style, style=0, colour=0, content=0, l2=2)
    seen, expected = noise(1, 1, 8, 8), noise(1, 1, 8, 8, seed=1)
    found = loss.terms(photograph, recorded=(seen, expected))["l2"].item()
    assert found == pytest.approx(2 * (seen - expected).square().mean().item(), rel=1e-12)


@pytest.mark.parametrize("shape", [(70, 250), (64, 64), (200, 100)])
def test_styles_of_any_shape(shape: tuple[int, int]):
    """Smaller than a crop, or not square: cut to what the features take; itself and its like are near, noise is not."""
    picture = painting("strokes", size=shape)
    loss = StyleLoss(picture, content=0)
    assert loss.crop == min(128, *shape) // 16 * 16
    like, unlike = painting("strokes", size=128, seed=2)[None], noise(1, 3, 128, 128).float()
    assert loss(like) < 0.35 * loss(unlike)


def test_nothing_is_saved_and_nothing_trains(style: Tensor, device: torch.device):
    loss = StyleLoss(style, l2=1).to(device)
    assert not loss.state_dict()
    assert not list(loss.parameters())
    shown = style[None].to(device).requires_grad_()
    total = loss(shown, shown.detach())
    total.backward()
    assert (total.shape, total.device.type) == ((), device.type)


def test_double_precision_throughout(style: Tensor, photograph: Tensor):
    single, double = StyleLoss(style, l2=1, tv=1), StyleLoss(style.double(), l2=1, tv=1)
    terms = double.terms(photograph.double(), photograph.double().flip(-1))
    for name, value in single.terms(photograph, photograph.flip(-1)).items():
        assert terms[name].dtype == torch.float64
        assert value.item() == pytest.approx(terms[name].item(), rel=1e-4), name


def test_style_crops_cover_the_picture_at_its_own_pixels():
    picture = noise(3, 130, 300)
    crops = style_crops(picture, side=64, multiple=16, least=64)
    windows = picture.unfold(1, 64, 1).unfold(2, 64, 1)[:, ::33, ::59].permute(1, 2, 0, 3, 4).flatten(0, 1)
    assert len(crops) == 3 * 5
    assert torch.equal(crops, windows)  # rows from 0, 33, 66; columns from 0, 59, .., 236
    assert len(style_crops(noise(3, 1024, 1024), side=64, multiple=16, least=64)) == 64
    assert style_crops(noise(3, 300, 70), side=None, multiple=16, least=64).shape == (5 * 2, 3, 64, 64)


# ---- wrong calls ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("picture", "error", "message"),
    [
        (np.ones((3, 64, 64)), TypeError, "tensor (3,H,W) in [0,1], got an array (3, 64, 64) of float64."),
        (torch.ones(3, 64, 64).byte(), TypeError, "(3, 64, 64) of torch.uint8. Use picture.float() / 255."),
        (torch.ones(1, 3, 64, 64), ValueError, "shape (1, 3, 64, 64), expected 3 channels: (C,H,W)."),
        (torch.ones(64, 64, 3), ValueError, "channels last: use picture.permute(2, 0, 1)."),
        (255 * torch.ones(3, 64, 64), ValueError, "values from 255 to 255, expected sRGB in [0,1]. Use picture / 255."),
        (-torch.ones(3, 64, 64), ValueError, "values from -1 to -1, expected sRGB in [0,1]. Probably scaled to [-1,1]"),
        (torch.full((3, 64, 64), math.nan), ValueError, "values from nan to nan, expected sRGB in [0,1]. Remove NaN"),
        (torch.ones(3, 63, 200), ValueError, "63 x 200 is too small: its features need at least 64 pixels each way."),
    ],
)
def test_wrong_styles(picture: Any, error: type[Exception], message: str):
    with pytest.raises(error, match=re.escape(message)):
        StyleLoss(picture)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"statistic": "mean"}, "unknown statistic 'mean'; known: moments, gram."),
        ({"content_by": "pixels"}, "unknown content_by 'pixels'; known: correlation, features."),
        ({"content_by": "features"}, "unknown content_layer 'relu3_3'; known: colour, low, scale 0, scale 1, scale 2"),
        ({"style": -1}, "the weight of style must be a finite number >= 0, got -1."),
        ({"tv": math.inf}, "the weight of tv must be a finite number >= 0, got inf."),
        ({"l2": math.nan}, "the weight of l2 must be a finite number >= 0, got nan."),
        ({"style": 0, "colour": 0, "content": 0}, "all weights are 0: no term is left. Give one, such as style=1."),
        ({"levels": ()}, "levels must be whole numbers of at least 1, got (). Use levels=(1, 2, 4)."),
        ({"levels": (0, 1)}, "levels must be whole numbers of at least 1, got (0, 1)."),
        ({"flat": 0.0}, "flat must be a finite variance > 0, got 0.0. Use flat=1e-3."),
        ({"flat": math.nan}, "flat must be a finite variance > 0, got nan."),
        ({"sparse": 0.0}, "sparse must be a share of the windows within 0..1, not 0, got 0.0. Use sparse=1."),
        ({"sparse": 1.5}, "sparse must be a share of the windows within 0..1, not 0, got 1.5."),
        ({"sparse": math.nan}, "sparse must be a share of the windows within 0..1, not 0, got nan."),
        ({"crop": 48}, "crops of 48 pixels are too small: the features need at least 64. Use crop=64."),
        ({"crop": 0}, "crops of 0 pixels are too small"),
    ],
)
def test_wrong_options(style: Tensor, how: dict[str, Any], message: str):
    with pytest.raises(ValueError, match=re.escape(message)):
        StyleLoss(style, **how)


@pytest.mark.parametrize("term", ["content", "l2"])
def test_terms_that_lack_a_scene(style: Tensor, photograph: Tensor, term: str):
    loss = StyleLoss(style, **({"content": 0.0} | {term: 1.0}))
    message = f"the {term} term compares with a scene, and none was given. Pass scene=, or {term}=0."
    with pytest.raises(ValueError, match=re.escape(message)):
        loss(photograph)
