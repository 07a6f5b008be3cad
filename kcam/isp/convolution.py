"""A small convolution of full planes: the trainable part of a camera's demosaic that keeps its picture ordinary."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from kcam.context import Context, Stage
from kcam.inputs import remedy
from kcam.sensor.arguments import hold, in_float32


@in_float32
def convolve_planes(signal: Tensor, *, weight: Tensor, bias: Tensor) -> Tensor:
    """out_n = bias_n + sum_c weight_nc * signal_c,   * the correlation that networks call convolution

    Args:      signal: (..., C, H, W), continued by its border.  weight: (N,C,k,k), k odd.  bias: (N,).
    Returns:   (..., N, H, W).
    Raises:    ValueError for another number of channels.

    Example:
    >>> mean = torch.ones(1, 3, 3, 3) / 27
    >>> torch.allclose(isp.convolve_planes(torch.ones(3, 8, 8), weight=mean, bias=torch.zeros(1)), torch.ones(1, 8, 8))
    True
    """
    channels = weight.shape[1]
    if signal.ndim < 3 or signal.shape[-3] != channels:
        raise ValueError(
            f"a kernel of shape {tuple(weight.shape)} takes {channels} planes (..., {channels}, H, W), got shape "
            f"{tuple(signal.shape)}. Put it behind a Demosaic."
            f"{remedy(signal, name='signal', channels=(channels,), scaled=False)}"
        )
    if signal.numel() == 0:
        return signal.new_zeros(*signal.shape[:-3], len(weight), *signal.shape[-2:])
    planes = signal.reshape(-1, *signal.shape[-3:])
    border = weight.shape[-1] // 2
    planes = F.conv2d(F.pad(planes, (border,) * 4, mode="replicate"), weight.to(planes), bias.to(planes))
    return planes.reshape(*signal.shape[:-3], *planes.shape[-3:])


class Convolution(Stage):
    """A convolution of full planes, which starts as the identity: behind a bilinear `Demosaic` a trainable demosaic.

    Unlike `LearnedDemosaic`, which sees the mosaic itself, it cannot tell its pixels apart, so what it learns shows no
    screen of two pixels.

    Args:      weight: (N,C,k,k), k odd, and bias: (N,); None for trainable ones, 3 x 3 x 3 x 3, at the identity.
    Raises:    ValueError for other shapes.

    Example:
    >>> picture = torch.rand(1, 3, 8, 8)
    >>> stage = isp.Convolution()
    >>> torch.allclose(stage(picture), picture), sum(p.numel() for p in stage.parameters())  # 3 x 3 x 3 x 3 + 3
    (True, 84)
    """

    weight: Tensor
    bias: Tensor

    def __init__(self, weight: Tensor | None = None, bias: Tensor | None = None) -> None:
        super().__init__()
        if weight is None:
            weight = torch.zeros(3, 3, 3, 3, device="cpu")
            weight[range(3), range(3), 1, 1] = 1
            weight = nn.Parameter(weight)
        if bias is None:
            bias = nn.Parameter(torch.zeros(len(weight), device="cpu"))
        square = weight.ndim == 4 and weight.shape[2] == weight.shape[3] and weight.shape[2] % 2 == 1
        if not square or bias.shape != weight.shape[:1]:
            raise ValueError(
                f"weight of shape {tuple(weight.shape)} and bias of shape {tuple(bias.shape)} are no convolution of "
                "planes: expected (N, C, k, k) with k odd, and (N,), such as (3, 3, 3, 3) and (3,)."
            )
        hold(self, weight=weight, bias=bias)

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,C,H,W) to (B,N,H,W)."""
        return convolve_planes(signal, weight=self.weight, bias=self.bias)

    def output_channels(self, channels: int, context: Context | None = None) -> int:
        """Those of the kernel."""
        return self.weight.shape[0]

    def extra_repr(self) -> str:
        """The shape of the kernel."""
        return f"{tuple(self.weight.shape)}"
