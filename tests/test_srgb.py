"""The sRGB curve against Kornia's, in numbers, gradients and layouts."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor

from kcam import srgb

CURVES = pytest.mark.parametrize(
    ("ours", "kornias"), [(srgb.to_light, rgb_to_linear_rgb), (srgb.to_code, linear_rgb_to_rgb)], ids=["light", "code"]
)
Curve = Callable[[Tensor], Tensor]


def values(*, size: int = 1000, seed: int = 0) -> Tensor:
    """Of a picture (1,3,size,1) float64: as many in the dark, where line and power meet, as above."""
    found = torch.rand(1, 3, size, 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.where(found < 0.5, 0.1 * found, found)


@CURVES
@pytest.mark.parametrize(("dtype", "within"), [(torch.float32, 5e-7), (torch.float64, 1e-14), (torch.float16, 2e-3)])
def test_it_is_kornias(ours: Curve, kornias: Curve, dtype: torch.dtype, within: float) -> None:
    x = values().to(dtype)
    found = ours(x)
    assert found.dtype == dtype
    torch.testing.assert_close(found.double(), kornias(x.double()), rtol=0, atol=within)


@CURVES
def test_the_two_ways_of_computing_it_agree_in_float32(ours: Curve, kornias: Curve) -> None:
    x = values(size=100_000).float()
    assert (ours(x) - ours(x.clone().requires_grad_()).detach()).abs().max() < 5e-7


@CURVES
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ends_and_order(ours: Curve, kornias: Curve, dtype: torch.dtype) -> None:
    ends = ours(torch.tensor([0.0, 1.0], dtype=dtype))
    assert ends[0] == 0
    assert abs(float(ends[1]) - 1) < 2e-7
    assert ours(torch.linspace(0, 1, 10_000, dtype=dtype)).diff().min() >= 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_outside(dtype: torch.dtype) -> None:
    """The code is clipped, light is not; NaN stays what it is."""
    x = torch.tensor([-math.inf, -0.3, 1.2, math.inf, math.nan], dtype=dtype)
    torch.testing.assert_close(srgb.to_code(x), torch.tensor([0, 0, 1, 1, math.nan], dtype=dtype), equal_nan=True)
    light = srgb.to_light(x)
    torch.testing.assert_close(light[1:3], torch.tensor([-0.3 / 12.92, (1.255 / 1.055) ** 2.4], dtype=dtype))
    assert light[[0, 3]].isinf().all()
    assert light[4].isnan()


@CURVES
@pytest.mark.parametrize(
    "arranged",
    [
        lambda x: x.contiguous(memory_format=torch.channels_last), lambda x: x[:, :, ::2, 1:], lambda x: x[:, 1:2],
        lambda x: x[:1].expand(4, -1, -1, -1), lambda x: x.mT, lambda x: x[:0], lambda x: x[0, 0, 0, 0],
    ],
    ids=["channels last", "strided", "slice", "expanded", "transposed", "empty", "one number"],
)  # fmt: skip
def test_layouts(ours: Curve, kornias: Curve, arranged: Curve) -> None:
    x = values(size=4 * 9 * 10).reshape(4, 3, 9, 10).float()
    view = arranged(x)
    before, found = x.clone(), ours(view)
    assert torch.equal(x, before)
    assert found.shape == view.shape
    torch.testing.assert_close(found, ours(view.double()).float(), rtol=0, atol=5e-7)
    if view.is_contiguous(memory_format=torch.channels_last) if view.ndim == 4 else False:
        assert found.is_contiguous(memory_format=torch.channels_last)


def test_more_than_one_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    x = values().float()
    whole = srgb.to_light(x), srgb.to_code(x)
    monkeypatch.setattr("kcam.srgb._PIECE", 128)
    assert torch.equal(srgb.to_light(x), whole[0])
    assert torch.equal(srgb.to_code(x), whole[1])


@CURVES
def test_gradients(ours: Curve, kornias: Curve) -> None:
    x = values(size=20).requires_grad_()
    assert torch.autograd.gradcheck(ours, (x,))
    assert torch.autograd.gradgradcheck(ours, (x,))
    found = torch.autograd.grad(ours(x.float()).sum(), x)[0]
    torch.testing.assert_close(found, torch.autograd.grad(kornias(x).sum(), x)[0], rtol=1e-5, atol=1e-6)


def test_gradients_stay_finite_outside() -> None:
    for curve in (srgb.to_light, srgb.to_code):
        x = torch.tensor([-0.4, -0.055, 0.0, 1.0, 2.0], requires_grad=True)
        curve(x).sum().backward()
        assert x.grad is not None
        assert x.grad.isfinite().all()


@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # torch's own, of forward mode
@CURVES
def test_under_torch_func(ours: Curve, kornias: Curve) -> None:
    x = values(size=5).float()[0]
    torch.testing.assert_close(torch.vmap(ours)(x), ours(x))
    primal, tangent = torch.func.jvp(srgb.to_light, (x,), (torch.ones_like(x),))
    torch.testing.assert_close(primal, srgb.to_light(x))
    torch.testing.assert_close(tangent, torch.func.grad(lambda values: srgb.to_light(values).sum())(x))


@CURVES
def test_parameters_without_a_gradient(ours: Curve, kornias: Curve) -> None:
    x = values(size=5).float().requires_grad_()
    with torch.no_grad():
        assert torch.equal(ours(x), ours(x.detach()))
    with torch.inference_mode():
        assert torch.equal(ours(x), ours(x.detach()))
