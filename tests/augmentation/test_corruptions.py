"""`corrupt`: fixed corruptions at five severities."""

from __future__ import annotations

import functools
from itertools import pairwise

import numpy as np
import pytest
import torch
from PIL import Image
from skimage import data
from torch import Tensor

import kcam.augmentation as KC

NAMES = tuple(KC.CORRUPTIONS)
SOME = [pytest.param(name, marks=pytest.mark.slow) if name == "real_lens" else name for name in NAMES]  # it traces
SEEDED = ("aberration", "shot_read_noise", "fixed_pattern")


@functools.cache
def photograph(name: str) -> Tensor:
    """A part of it, 80 x 100, with detail and colours: (1,3,H,W)."""
    whole = {"astronaut": data.astronaut, "coffee": data.coffee}[name]()
    return torch.tensor(whole[60:140, 180:280]).permute(2, 0, 1)[None] / 255


def rms(name: str, severity: int, picture: Tensor) -> float:
    return float((KC.corrupt(picture, name, severity=severity) - picture).square().mean().sqrt())


@pytest.mark.parametrize("severity", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 3, 4)), 5])
@pytest.mark.parametrize("name", SOME)
def test_every_row(name: str, severity: int) -> None:
    for x in (photograph("coffee")[..., :33, :47], photograph("coffee")[0, :, :32, :32].double()):
        before, state = x.clone(), torch.get_rng_state()
        y = KC.corrupt(x, name, severity=severity)
        assert y.shape == x.shape
        assert y.dtype == x.dtype
        assert y.isfinite().all()
        assert y.min() >= 0
        assert y.max() <= 1
        assert torch.equal(x, before)
        assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("name", SOME)
def test_a_higher_severity_is_worse(name: str) -> None:
    errors = [rms(name, severity, photograph("coffee")) for severity in (1, 2, 3, 4, 5)]
    for milder, stronger in pairwise(errors):
        assert stronger > 1.02 * milder  # 2 %: a step that can be told
    assert errors[0] > 1 / 255  # of the range: less than a step of 8 bits on average is no corruption


@pytest.mark.parametrize("name", SOME)
def test_a_seed_decides(name: str) -> None:
    x = photograph("coffee")[..., :32, :32]
    torch.manual_seed(1)
    y = KC.corrupt(x, name, severity=2, seed=5)
    torch.manual_seed(2)
    assert torch.equal(KC.corrupt(x, name, severity=2, seed=5), y)
    assert torch.equal(KC.corrupt(x, name, severity=2, seed=6), y) == (name not in SEEDED)


def test_takes_what_kornia_takes() -> None:
    pixels = (photograph("coffee")[0, :, :16, :20].permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
    expected = KC.corrupt(torch.tensor(pixels).permute(2, 0, 1).double() / 255, "defocus", severity=3, seed=0)
    for guest in (pixels, Image.fromarray(pixels), pixels / np.float32(255)):
        y = KC.corrupt(guest, "defocus", severity=3, seed=0)
        torch.testing.assert_close(y.double().reshape(expected.shape), expected, atol=1e-6, rtol=0)


def test_leaves_the_gpus_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    # Seeding them would reset the user's stream there, and in a forked worker fail.
    monkeypatch.setattr(torch.cuda, "manual_seed_all", lambda seed: pytest.fail("seeded the GPUs"))
    KC.corrupt(photograph("coffee")[..., :16, :16], "shot_read_noise", severity=1)


def test_a_whole_float_is_a_severity() -> None:
    x = photograph("coffee")[..., :16, :16]
    assert torch.equal(KC.corrupt(x, "vignetting", severity=2.0), KC.corrupt(x, "vignetting", severity=2))


def test_each_row_of_a_batch_has_its_own_noise() -> None:
    x = photograph("coffee")[..., :16, :16].expand(2, -1, -1, -1)
    y = KC.corrupt(x, "shot_read_noise", severity=3)
    assert not torch.equal(y[0], y[1])


def test_a_table_row_can_be_built() -> None:
    row = KC.CORRUPTIONS["defocus"]
    assert len(row.severities) == 5
    augment = row.build(3)
    x = photograph("coffee")[..., :16, :16]
    assert torch.equal(augment(x), KC.corrupt(x, "defocus", severity=3))


@pytest.mark.parametrize("severity", [0, 6, -1, 1.5, True, "3", None])
def test_wrong_severity(severity: object) -> None:
    with pytest.raises(ValueError, match="severity must be 1, 2, 3, 4 or 5, got"):
        KC.corrupt(photograph("coffee"), "defocus", severity=severity)


def test_unknown_name() -> None:
    with pytest.raises(ValueError, match="unknown corruption 'fog'. There are: defocus, diffraction"):
        KC.corrupt(photograph("coffee"), "fog", severity=1)
