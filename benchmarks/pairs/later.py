"""What a camera with a plan may see later."""

from __future__ import annotations

import random
from dataclasses import replace

import torch
from torch import Tensor

from kcam import Scene

LATER = (
    ("moved", "exposed a little", "noisy", "mirrored", "alone"),
    ("exposed", "photograph", "colours", "narrow band", "lamp", "contrast", "depth", "noise", "flat"),
)
"""What a camera may see after the scene that was planned for: much like it, or not."""


def later_scene(draw: random.Random, scene: Scene) -> tuple[Scene, str]:
    """Another scene that a camera with a plan for `scene` may meet, one of `LATER`."""
    planes, depth = scene.coefficients.clone(), scene.depth
    batch, count, height, width = planes.shape
    kind = draw.choice(draw.choice(LATER))
    if kind == "moved":
        shift = draw.randint(-8, 8), draw.randint(-8, 8)
        planes = planes.roll(shift, (-2, -1))
        depth = depth.roll(shift, (-2, -1)) if isinstance(depth, Tensor) else depth
    elif kind == "exposed a little":
        planes *= draw.uniform(0.95, 1.05)
    elif kind == "noisy":
        planes *= 1 + 0.01 * torch.randn(planes.shape, generator=torch.Generator().manual_seed(draw.randrange(2**31)))
        planes = planes.clamp(min=0)
    elif kind == "mirrored":
        planes, depth = planes.flip(-1), depth.flip(-1) if isinstance(depth, Tensor) else depth
    elif kind == "alone":
        item = draw.randrange(batch)
        planes, depth = planes[item : item + 1], depth[item : item + 1] if isinstance(depth, Tensor) else depth
    elif kind == "exposed":
        planes *= 10 ** draw.uniform(-2, 1.5)
    elif kind == "photograph" and count == 3:
        name = draw.choice(["astronaut", "coffee", "chelsea", "motorcycle", "star", "point_grid"])
        other = Scene.from_rgb(Scene.builtin(name, (height, width)).to_srgb(), depth=2.0).coefficients
        planes = (other * 10 ** draw.uniform(-1, 0.3)).expand(batch, -1, -1, -1)
    elif kind == "colours":
        planes = (
            planes[:, draw.sample(range(count), count)]
            * torch.tensor([[[[draw.random()]], [[draw.random()]], [[draw.random()]]]])
            if count == 3
            else planes.flip(1)
        )
    elif kind == "narrow band" and scene.spectra is not None:
        line = torch.zeros(len(scene.wavelengths))
        line[draw.randrange(len(line))] = draw.uniform(1, 8)
        spectra = scene.spectra.mean(0) * 0.02 + line
        return Scene(
            planes.mean(1, keepdim=True), spectra[None], scene.wavelengths, depth, scene.illuminant, scene.luminance
        ), kind
    elif kind == "lamp":
        radius, row, column = draw.uniform(0.5, 6), draw.randrange(height), draw.randrange(width)
        rows, columns = torch.arange(float(height))[:, None], torch.arange(float(width))[None, :]
        place = torch.hypot(rows - row, columns - column) <= radius
        planes = torch.where(place, planes + 10 ** draw.uniform(0, 3), planes)
    elif kind == "contrast":
        planes = planes ** draw.uniform(0.3, 4)
    elif kind == "depth" and isinstance(depth, Tensor):
        low, high = (1 / depth).aminmax()
        share = torch.linspace(0, 1, height, dtype=torch.float64)[:, None].expand(batch, 1, height, width)
        depth = 1 / (low + (high - low) * (share if draw.random() < 0.5 else (share > draw.random()).double()))
    elif kind == "noise":
        planes = torch.rand(planes.shape, generator=torch.Generator().manual_seed(draw.randrange(2**31)))
    elif kind == "flat":
        planes = planes.mean((-2, -1), keepdim=True).expand_as(planes).contiguous()
    return replace(scene, coefficients=planes, depth=depth), kind
