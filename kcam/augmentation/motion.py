"""Motion while the shutter is open: blur along a path, and rows that see later moments."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from kcam.augmentation.base import CameraAugmentation
from kcam.augmentation.distributions import Bounds, Draw, Seed, Uniform
from kcam.augmentation.geometry import SmoothlyMoved
from kcam.sensor.motion import path_blur, tremor


class RandomMotion(CameraAugmentation):
    """Motion blur in linear light: straight, or the path of a trembling hand; exact, see `sensor.path_blur`.

    The path is centred: what a picture shows stays where it is, and so do its labels.

    Args:      length: of the path, for a tremor between its farthest points from its middle [pixels].
               angle: of its direction, from the right towards below [degrees].
               kind: "straight" or "tremor", `sensor.tremor` over a tenth of a second.
    Raises:    ValueError for bounds that cannot be, or another kind.

    Example:
    >>> point = torch.zeros(1, 3, 33, 33)
    >>> point[..., 16, 16] = 1.0
    >>> seen = KC.RandomMotion(length=8.0, angle=0.0, p=1.0)(point)[0, 0] > 0.2
    >>> int(seen.any(0).sum()), int(seen.any(1).sum())  # pixels wide and high
    (9, 1)
    """

    def __init__(
        self,
        length: Bounds = (0.0, 16.0),
        angle: Bounds = (0.0, 180.0),
        *,
        kind: Literal["straight", "tremor"] = "straight",
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        if kind not in ("straight", "tremor"):
            raise ValueError(f'kind must be "straight" or "tremor", got {kind!r}.')
        draws: dict[str, Draw] = {
            "length": Uniform(length, least=0.0, most=1000.0, unit="[pixels]"),
            "angle": Uniform(angle, least=-360.0, most=360.0, unit="[degrees]"),
        }
        if kind == "tremor":
            draws["path_seed"] = Seed()
        super().__init__(draws, same_on_batch=same_on_batch, p=p, keepdim=keepdim)
        self.flags = {"kind": kind}
        self.kind = kind

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """All rows at once, each along its own path."""
        angle = torch.deg2rad(drawn["angle"].to(signal))
        along = torch.stack([angle.cos(), angle.sin()], dim=-1)
        if self.kind == "straight":
            shape = torch.stack([-along, along], dim=1) / 2
        else:
            paths = torch.stack([tremor(0.1, seed=seed) for seed in drawn["path_seed"].tolist()]).to(signal)
            paths = paths - paths.mean(1, keepdim=True)
            paths = paths / (2 * paths.norm(dim=-1).amax(-1)).clamp(min=1e-12)[:, None, None]
            across = torch.stack([-along[:, 1], along[:, 0]], dim=-1)
            shape = paths[..., :1] * along[:, None] + paths[..., 1:] * across[:, None]
        return path_blur(signal, path=shape * drawn["length"].to(signal)[:, None, None])


class RandomRollingShutter(SmoothlyMoved):
    """A rolling shutter before a moving camera: the picture leans, is stretched, and wobbles.

    x_d = x + lean (y_d - c) + wobble H sin(2 pi (cycles y_d / H + phase)),   y_d = y + stretch (y_d - c)

    with c the middle row and H the height: what a global shutter images at (x, y) this one images at (x_d, y_d). Masks,
    boxes and keypoints go with the pixels, as of `RandomLensDistortion`. Beyond the picture it is black.

    Args:      lean: how far the last row has moved beside the first, of the height. stretch: likewise, along y.
               wobble: amplitude of a vibration along x, of the height. cycles: of it in a picture. phase: of a cycle.
               resample: of the picture, "bilinear" or "nearest".
    Raises:    ValueError for bounds that cannot be; a stretch is from -0.5 to 0.5.
    Source:    Liang, Chang and Chen, Analysis and compensation of rolling shutter effect, IEEE Trans. Image Processing
               17, 1323 (2008).

    Example:
    >>> line = torch.zeros(1, 1, 65, 65)
    >>> line[..., 32] = 1.0
    >>> leaning = KC.RandomRollingShutter(lean=0.25, stretch=0.0, wobble=0.0, p=1.0)(line)[0, 0]
    >>> leaning[[0, 32, 64]].argmax(-1).tolist()
    [24, 32, 40]
    """

    def __init__(
        self,
        lean: Bounds = (-0.1, 0.1),
        stretch: Bounds = (-0.05, 0.05),
        wobble: Bounds = (0.0, 0.005),
        *,
        cycles: Bounds = (1.0, 4.0),
        phase: Bounds = (0.0, 1.0),
        resample: str = "bilinear",
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        draws: dict[str, Draw] = {
            "lean": Uniform(lean, least=-10.0, most=10.0),
            "stretch": Uniform(stretch, least=-0.5, most=0.5),
            "wobble": Uniform(wobble, least=-1.0, most=1.0),
            "cycles": Uniform(cycles, least=0.0, most=100.0),
            "phase": Uniform(phase, least=-1.0, most=1.0),
        }
        super().__init__(draws, resample=resample, same_on_batch=same_on_batch, p=p, keepdim=keepdim)

    def _through(self, points: Tensor, params: dict[str, Tensor], shape: tuple[int, int], *, inverse: bool) -> Tensor:
        lean, stretch, wobble, cycles, phase = (
            params[name].double().to(points.device)[:, None] for name in self._param_generator.draws
        )
        height, middle = shape[0], (shape[0] - 1) / 2
        x, y = points.unbind(-1)
        row = y if inverse else (y - stretch * middle) / (1 - stretch)  # that records it
        moved = lean * (row - middle) + wobble * height * torch.sin(2 * math.pi * (cycles * row / height + phase))
        if inverse:
            return torch.stack([x - moved, y - stretch * (row - middle)], dim=-1)
        return torch.stack([x + moved, row], dim=-1)
