"""A style stage as training might leave it: what it paints differs from what it is given."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from kcam.isp import StyleStage


def painting_stage(*, strength: float = 0.05, **arguments: Any) -> StyleStage:
    """Weights of the last convolution as by training, the others and the biases a little off their start."""
    stage = StyleStage(**arguments)
    seeded = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in stage.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=seeded))
        nn.init.normal_(stage.leave.weight, std=strength, generator=seeded)
    return stage
