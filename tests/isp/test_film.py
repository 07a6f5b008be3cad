"""Films: strokes that move with what is shown, behind noise that is another one in each frame."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from kcam import Scene, isp
from kcam.isp.film import anchored, carried, in_whole_pixels, motions, origins
from kcam.style import painting


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def pan(dx: int, dy: int, *, count: int = 3, side: int = 72) -> Tensor:
    """Crops of a photograph, whose contents move by (dx, dy)."""
    photo = Scene.builtin("astronaut", size=192).to_srgb()[0]
    places = [(60 - dy * t, 60 - dx * t) for t in range(count)]
    return torch.stack([photo[:, y : y + side, x : x + side] for y, x in places])


def flicker(film: Tensor, dx: int, dy: int) -> float:
    """RMS difference of frames where both show the same."""
    height, width = film.shape[-2:]
    y, x = slice(max(dy, 0), height + min(dy, 0)), slice(max(dx, 0), width + min(dx, 0))
    v, u = slice(max(-dy, 0), height + min(-dy, 0)), slice(max(-dx, 0), width + min(-dx, 0))
    return float((film[1:, :, y, x] - film[:-1, :, v, u]).square().mean().sqrt())


def test_a_pan_is_where_it_says() -> None:
    for motion in ((-5, 0), (3, -4)):
        assert flicker(pan(*motion), *motion) < 1e-6


@pytest.mark.parametrize("motion", [(-5, 0), (3, -4)])
@pytest.mark.slow
def test_strokes_stay_on_what_they_show(motion: tuple[int, int]) -> None:
    """Less than half of the difference of frames that are painted by themselves, with the same seed."""
    frames = pan(*motion)
    frames = (frames + 0.01 * torch.randn(frames.shape, generator=seeded())).clamp(0, 1)  # as a camera's
    stage = isp.TextureTransfer(painting("strokes", size=128), turns=4, seed=0)
    alone = flicker(torch.cat([stage(frame[None]) for frame in frames]), *motion)
    film = stage.film(frames, motion)
    assert flicker(film, *motion) < 0.45 * alone
    of_each_pixel = torch.tensor(motion, dtype=torch.float64)[:, None, None].expand(2, 2, 72, 72)
    assert torch.equal(film, stage.film(frames, of_each_pixel))
    assert torch.equal(film[:1], stage(frames[:1]))


def test_the_networks_noise_moves_along() -> None:
    stage = isp.StyleStage(width=8)
    with torch.no_grad():
        stage.leave.weight.normal_(0, 0.3, generator=seeded())
        motion, frames = (-8, 4), pan(-8, 4)
        alone, film = stage(frames), stage.film(frames, motion, generator=seeded())
        assert flicker(film, *motion) < 0.75 * flicker(alone, *motion)


def test_origins_are_the_pixels_that_were() -> None:
    """Against a loop; what was not in view is fresh."""
    motion = 4 * torch.randn(2, 7, 9, dtype=torch.float64, generator=seeded())
    planes, fresh = torch.rand(3, 7, 9, generator=seeded(1)), torch.rand(3, 7, 9, generator=seeded(2))
    moved = carried(planes, fresh, motion)
    _, inside = origins(motion)
    for y in range(7):
        for x in range(9):
            v, u = y - math.floor(float(motion[1, y, x]) + 0.5), x - math.floor(float(motion[0, y, x]) + 0.5)
            seen = 0 <= v < 7 and 0 <= u < 9
            assert bool(inside[y, x]) == seen
            assert torch.equal(moved[:, y, x], planes[:, v, u] if seen else fresh[:, y, x])


@pytest.mark.parametrize("speed", [0.4, 0.5, 1.4, -0.5, -1.7, 3.0])
@pytest.mark.parametrize("scale", [1, 4])
def test_parts_of_pixels_add_up(speed: float, scale: int) -> None:
    """After twelve frames noise is where it should be, to half of its own pixel, and as white as it was."""
    frames, side = 13, 240
    noise = torch.randn(frames, 1, side // scale, side // scale, generator=seeded())
    motion = motions((speed, 0.0), torch.empty(frames, 3, side, side))
    last, first = anchored(noise, motion)[-1, 0], noise[0, 0]
    reach, width = 40 // scale, side // scale
    middle = first[:, reach:-reach].flatten()
    alike = {
        shift: float(
            torch.corrcoef(torch.stack([last[:, reach + shift : width - reach + shift].flatten(), middle]))[0, 1]
        )
        for shift in range(-reach, reach + 1)
    }
    assert abs(max(alike, key=alike.__getitem__) - 12 * speed / scale) <= 0.5 + 1e-6
    beside = torch.corrcoef(torch.stack([last[:, 1:].flatten(), last[:, :-1].flatten()]))[0, 1]
    assert abs(float(beside)) < 0.2  # with halves to even numbers every second pixel would be its neighbour's
    assert abs(float(in_whole_pixels(motion).sum(0)[0].mean()) - 12 * speed) <= 0.6


def test_coarser_planes_move_by_as_much() -> None:
    planes = torch.rand(3, 2, 6, 8)
    moved = anchored(planes, torch.tensor([4.0, -8.0])[None, :, None, None].expand(2, 2, 24, 32))
    assert torch.equal(moved[0], planes[0])
    assert torch.equal(moved[2, :, :2, 2:], planes[0, :, 4:, :-2])
    assert torch.equal(moved[1, :, :, 0], planes[1, :, :, 0])


@pytest.mark.parametrize(
    ("motion", "error", "text"),
    [
        ((1, 2, 3), ValueError, r"motion must be \(x, y\) in pixels, \(2, 2\) or \(2, 2, 8, 8\) for 3 frames of 8 x 8"),
        (torch.zeros(3, 2), ValueError, r"got shape \(3, 2\)"),
        ((float("nan"), 0), ValueError, r"motion has values that are NaN"),
        ("left", TypeError, r"motion must be numbers or a tensor, got str"),
    ],
)
def test_what_is_no_motion(motion: Any, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        motions(motion, torch.rand(3, 3, 8, 8))
