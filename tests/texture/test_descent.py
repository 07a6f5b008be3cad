"""Pictures that are moved down on a loss."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from kcam.style import StyleLoss, painting
from kcam.texture.descent import descend, spectral_scale


def test_it_goes_down_and_leaves_what_it_began_with() -> None:
    loss = StyleLoss(painting("woodcut", size=96), content=0.0)
    begun = torch.rand(1, 3, 64, 80, generator=torch.Generator().manual_seed(0))
    before = begun.clone()
    moved = descend(loss, begun, steps=8, rate=0.05)
    assert float(loss(moved)) < 0.7 * float(loss(begun))
    assert torch.equal(begun, before)
    assert not moved.requires_grad
    assert 0 <= float(moved.min()) <= float(moved.max()) <= 1


@pytest.mark.parametrize("shape", [(1, 1), (65, 70), (100, 64)])
def test_any_size_with_a_scene(shape: tuple[int, int]) -> None:
    picture, seen = torch.rand(1, 3, *shape, generator=torch.Generator().manual_seed(0)), []
    loss = StyleLoss(painting("mosaic", size=64), content=0.2)
    moved = descend(loss, picture, scene=picture, steps=2, rate=0.01, advance=lambda step, terms: seen.append(terms))
    assert moved.shape == picture.shape
    assert bool(moved.isfinite().all())
    assert not torch.equal(moved, picture)
    assert [list(terms) for terms in seen] == [["style", "colour", "content"]] * 2


def test_no_steps_are_the_picture() -> None:
    picture = torch.rand(1, 3, 64, 64)
    loss = StyleLoss(painting("mosaic", size=64), content=0.0)
    assert torch.allclose(descend(loss, picture, steps=0, rate=0.1), picture, atol=1e-6)


def test_a_loss_that_is_not_finite_is_told() -> None:
    class Endless(StyleLoss):
        def terms(self, picture: Any, *rest: Any, **how: Any) -> dict:
            return {"style": picture.sum() * math.inf}

    with pytest.raises(ValueError, match=r"the loss is inf at step 0. Use a lower rate than 0.1"):
        descend(Endless(painting("mosaic", size=64)), torch.rand(1, 3, 64, 64), steps=1, rate=0.1)


def test_each_frequency_has_the_scale_of_pictures() -> None:
    scale = spectral_scale(32, 48)
    assert float(scale.square().mean()) == pytest.approx(1)
    assert float(scale[0, 1] / scale[0, 2]) == pytest.approx(2)
    assert float(scale[16, 20] * math.hypot(0.5, 20 / 48) / scale[0, 1] * 48) == pytest.approx(0.1)


def test_rounding_shows() -> None:
    """As far as limits.md says: Adam's first step is as large where the slope is rounding."""
    generator = torch.Generator().manual_seed(0)
    style = painting("strokes", size=160)
    picture = style[None, :, :96, :96] + 0.0
    loss = StyleLoss(style, colour=1.0, content=1.0, flat=1e-2)
    noisy = picture + 1e-7 * torch.randn(picture.shape, generator=generator)
    one, other = (descend(loss, x, scene=picture, steps=20, rate=0.0075) for x in (picture, noisy))
    assert float((one - other).abs().max()) < 0.1
    assert float((one - other).square().mean().sqrt()) < 0.01
