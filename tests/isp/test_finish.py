"""Local tone mapping, sharpening and JPEG."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch
from kornia.filters import unsharp_mask
from PIL import Image
from torch.nn import functional as F

from kcam import isp

STAGES = [isp.LocalToneMapping(), isp.Sharpen(), isp.JPEG()]


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def smooth(*shape: int, seed: int = 0) -> torch.Tensor:
    """A soft picture of 8 bits."""
    coarse = torch.rand(1, 3, 5, 6, generator=seeded(seed))
    return (255 * F.interpolate(coarse, size=shape, mode="bicubic").clamp(0, 1)).round() / 255


@pytest.mark.parametrize("shape", [(64, 64), (37, 51), (16, 9), (1, 1)])
@pytest.mark.parametrize("quality", [40, 75, 90, 100])
@pytest.mark.parametrize("channels", [1, 3])
def test_jpeg_is_that_of_libjpeg(shape, quality, channels):
    picture = smooth(*shape)[:, :channels]
    array = (255 * picture[0]).round().byte().permute(1, 2, 0).numpy()
    file = io.BytesIO()
    Image.fromarray(array.squeeze(2) if channels == 1 else array).save(file, "JPEG", quality=quality)
    read = torch.tensor(np.array(Image.open(file))).reshape(*shape, channels).permute(2, 0, 1)
    error = (255 * isp.jpeg(picture, quality=quality)[0] - read).abs()
    assert error.mean() < 0.5 if min(shape) > 1 else error.max() <= 2  # one block: halves in its steps may round apart


def test_the_gradient_of_jpeg_is_that_of_its_steps_without_rounding():
    gray = (0.2 + 0.6 * torch.rand(1, 1, 8, 16, generator=seeded())).requires_grad_()
    weights = torch.rand(1, 1, 8, 16, generator=seeded(1))
    (gradient,) = torch.autograd.grad((weights * isp.jpeg(gray, quality=95)).sum(), gray)
    torch.testing.assert_close(gradient, weights, atol=1e-4, rtol=1e-4)  # the DCT there and back is the identity


@pytest.mark.parametrize("stage", STAGES[:2], ids=lambda stage: type(stage).__name__)
def test_gradients_are_those_of_finite_differences(stage):
    picture = (0.1 + 0.8 * torch.rand(1, 3, 5, 4, generator=seeded(), dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(stage, picture)


def test_sharpening_is_kornias_unsharp_mask_where_overshoot_is_free():
    picture = 0.4 + 0.2 * torch.rand(1, 1, 20, 20, generator=seeded(), dtype=torch.float64)
    expected = unsharp_mask(picture, (7, 7), (1.0, 1.0))
    actual = isp.sharpen(picture, amount=1.0, overshoot=1.0)
    torch.testing.assert_close(actual[..., 4:-4, 4:-4], expected[..., 4:-4, 4:-4])


def test_a_linear_ramp_is_sharp_already():
    ramp = torch.linspace(0.2, 0.8, 30, dtype=torch.float64).expand(1, 3, 10, 30)
    torch.testing.assert_close(isp.sharpen(ramp)[..., 4:-4], ramp[..., 4:-4])


def test_nothing_is_done_at_strength_and_amount_zero():
    picture = torch.rand(1, 3, 20, 30, generator=seeded())
    torch.testing.assert_close(isp.map_tones_locally(picture, strength=0.0), picture)
    torch.testing.assert_close(isp.sharpen(picture, amount=0.0), picture)


def test_local_tone_mapping_keeps_hue_white_and_range():
    picture = torch.rand(2, 3, 40, 30, generator=seeded())
    mapped = isp.map_tones_locally(picture, strength=0.5)
    ratio = mapped / picture.clamp(min=1e-6)
    assert (ratio.amax(1) - ratio.amin(1)).abs().max() < 1e-3
    assert mapped.min() >= 0
    assert mapped.max() <= 1 + 1e-6
    white = torch.ones(1, 3, 9, 9)
    torch.testing.assert_close(isp.map_tones_locally(white), white)


@pytest.mark.parametrize("level", [0.02, 0.3])
def test_a_flat_region_is_brightened_by_the_closed_form(level):
    flat = torch.full((1, 1, 300, 200), level, dtype=torch.float64)
    e = 2.0**-6
    expected = flat * ((1 + e) / (level + e)) ** 0.3
    torch.testing.assert_close(isp.map_tones_locally(flat, strength=0.3), expected)


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: type(stage).__name__)
@pytest.mark.parametrize("shape", [(0, 3, 4, 4), (1, 1, 1, 1), (2, 3, 1, 1), (2, 1, 5, 4)])
def test_small_pictures_and_none(stage, shape):
    result = stage(torch.full(shape, 0.4).half())
    assert result.shape == shape
    assert result.dtype == torch.half
    assert bool(result.isfinite().all())


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: type(stage).__name__)
def test_other_channels_are_refused(stage):
    with pytest.raises(ValueError, match=r"channel|shape|picture"):
        stage(torch.rand(1, 5, 8, 8))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: isp.JPEG(0), "quality 0 is outside 1..100"),
        (lambda: isp.Sharpen(-1.0), "amount"),
        (lambda: isp.LocalToneMapping(radius=0.7), r"more than 0\.5"),
    ],
)
def test_values_out_of_range_are_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()
