from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate
from torch import nn

from kcam import Camera
from kcam.isp import Convolution
from kcam.isp.convolution import convolve_planes


def random(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def by_scipy(signal: np.ndarray, weight: np.ndarray, bias: np.ndarray) -> np.ndarray:
    planes = [sum(correlate(plane, kernel, mode="nearest") for plane, kernel in zip(signal, own, strict=True))
              for own in weight]  # fmt: skip
    return np.stack(planes) + bias[:, None, None]


@pytest.mark.parametrize("size", [(6, 9), (1, 1), (1, 4), (2, 2)])
@pytest.mark.parametrize(("out", "channels", "side"), [(3, 3, 3), (2, 4, 5), (1, 3, 1), (3, 1, 3)])
def test_it_is_the_correlation(out: int, channels: int, side: int, size: tuple[int, int]) -> None:
    signal, weight, bias = random(2, channels, *size), random(out, channels, side, side, seed=1), random(out, seed=2)
    result = Convolution(weight, bias)(signal)
    expected = np.stack([by_scipy(each.numpy(), weight.numpy(), bias.numpy()) for each in signal])
    assert result.shape == (2, out, *size)
    # at most 100 products of values of about 1 in float64, each rounded to 1e-16
    assert np.abs(result.numpy() - expected).max() < 1e-13


def test_it_starts_as_the_identity(dtype: torch.dtype, device: torch.device) -> None:
    signal = random(2, 3, 7, 8, dtype=dtype).to(device)
    stage = Convolution().to(device)
    assert torch.equal(stage(signal), signal)
    assert [(name, tuple(p.shape)) for name, p in stage.named_parameters()] == [
        ("weight", (3, 3, 3, 3)),
        ("bias", (3,)),
    ]
    assert "(3, 3, 3, 3)" in repr(stage)
    with torch.device("meta"):
        assert torch.equal(Convolution()(signal.cpu()), signal.cpu())


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16])
def test_half_precision_is_kept_and_computed_in_float32(kind: torch.dtype) -> None:
    signal = random(1, 3, 5, 6).to(kind)
    stage = Convolution(random(3, 3, 3, 3, seed=1).float(), torch.zeros(3))
    result = stage(signal)
    assert result.dtype == kind
    assert torch.equal(result, stage(signal.float()).to(kind))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(stage(signal.float()), stage(signal.float()))
        assert stage(signal.float()).dtype == torch.float32


def test_any_number_of_leading_dimensions() -> None:
    stage, signal = Convolution(random(2, 3, 3, 3), random(2)), random(2, 4, 3, 5, 6)
    whole = stage(signal)
    assert whole.shape == (2, 4, 2, 5, 6)
    assert torch.equal(whole[1, 2], stage(signal[1, 2]))
    assert stage(signal[:0]).shape == (0, 4, 2, 5, 6)
    assert stage(signal[..., :0]).shape == (2, 4, 2, 5, 0)


def test_the_gradient_is_the_slope() -> None:
    values = [
        random(*shape, seed=seed).requires_grad_() for seed, shape in enumerate([(2, 2, 3, 4), (3, 2, 3, 3), (3,)])
    ]
    assert torch.autograd.gradcheck(lambda s, w, b: convolve_planes(s, weight=w, bias=b), values)


@pytest.mark.parametrize(
    ("weight", "bias"),
    [
        (torch.zeros(3, 3, 2, 2), None),
        (torch.zeros(3, 3, 3, 1), None),
        (torch.zeros(3, 3, 3), None),
        (torch.zeros(3, 3, 3, 3), torch.zeros(2)),
        (None, torch.zeros(3, 1)),
    ],
)
def test_no_convolution(weight: torch.Tensor | None, bias: torch.Tensor | None) -> None:
    with pytest.raises(
        ValueError, match=r"are no convolution of planes: expected \(N, C, k, k\) with k odd, and \(N,\)"
    ):
        Convolution(weight, bias)


@pytest.mark.parametrize("shape", [(1, 1, 4, 4), (4, 4), (2, 4, 5, 5)])
def test_other_planes(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"takes 3 planes \(..., 3, H, W\), got shape .* Put it behind a Demosaic"):
        Convolution()(torch.zeros(shape))


def test_a_signal_of_integers() -> None:
    with pytest.raises(TypeError, match="expected a floating-point signal"):
        Convolution()(torch.zeros(1, 3, 4, 4, dtype=torch.uint8))


def test_parameters_train_and_tensors_do_not() -> None:
    assert not list(Convolution(torch.zeros(3, 3, 1, 1), torch.zeros(3)).parameters())
    assert [name for name, _ in Convolution(torch.zeros(2, 3, 1, 1)).named_parameters()] == ["bias"]
    assert Convolution(torch.zeros(2, 3, 1, 1)).output_channels(3) == 2


def test_save_and_load(tmp_path: Path) -> None:
    stage = Convolution(nn.Parameter(random(2, 3, 5, 5).float()), random(2).float())
    Camera(stage).save(tmp_path / "camera.safetensors")
    loaded = Camera.load(tmp_path / "camera.safetensors")
    signal = random(1, 3, 6, 7).float()
    with torch.no_grad():
        assert torch.equal(loaded(signal), stage(signal))
    assert [name for name, _ in loaded[0].named_parameters()] == ["weight"]
