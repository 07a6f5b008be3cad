"""Frames of a film: where what a pixel shows was in the frame before."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F


def motions(motion: Any, frames: Tensor) -> Tensor:
    """What moves from each of the frames (T,C,H,W) to the next, (T-1,2,H,W) pixels (x, y).

    Args:      motion: (2,) of all, (T-1,2) of each whole frame, or (T-1,2,H,W) of each pixel of the later frame.
    Raises:    TypeError, ValueError for anything else, or what is not finite.
    """
    count, size = len(frames) - 1, tuple(frames.shape[-2:])
    try:
        moved = torch.as_tensor(motion, dtype=torch.float64, device=frames.device).detach()
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"motion must be numbers or a tensor, got {type(motion).__name__}.") from error
    if moved.shape not in ((2,), (count, 2), (count, 2, *size)):
        raise ValueError(
            f"motion must be (x, y) in pixels, ({count}, 2) or ({count}, 2, {size[0]}, {size[1]}) for {len(frames)} "
            f"frames of {size[0]} x {size[1]}, got shape {tuple(moved.shape)}."
        )
    if not moved.isfinite().all():
        raise ValueError("motion has values that are NaN or infinite. Use 0 where nothing is known to move.")
    return (moved if moved.ndim == 4 else moved[..., None, None]).expand(count, 2, *size)


def in_whole_pixels(motion: Tensor) -> Tensor:
    """Motions (T-1,2,H,W) in whole pixels; what is left of each is added to the next one of what moved, never lost."""
    found: list[Tensor] = []
    owed = motion.new_zeros(motion.shape[1:])
    for one in motion:
        wanted = one + carried(owed, torch.zeros_like(owed), one)
        found.append(_rounded(wanted))
        owed = wanted - found[-1]
    return torch.stack(found) if found else motion


def _rounded(values: Tensor) -> Tensor:
    """Halves up: to even numbers every second pixel of 0.5 would stand still."""
    return (values + 0.5).floor()


def origins(motion: Tensor) -> tuple[Tensor, Tensor]:
    """For each pixel, by its motion (2,H,W), the index of the pixel that it was, (H,W), and whether there was one."""
    height, width = motion.shape[-2:]
    rows, columns = (torch.arange(size, device=motion.device) for size in (height, width))
    x, y = (columns - _rounded(motion[0])).long(), (rows[:, None] - _rounded(motion[1])).long()
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    return y.clamp(0, height - 1) * width + x.clamp(0, width - 1), inside


def carried(planes: Tensor, fresh: Tensor, motion: Tensor) -> Tensor:
    """Planes (...,H,W) moved to the next frame; fresh ones where something comes into view."""
    index, inside = origins(motion)
    return torch.where(inside, planes.flatten(-2)[..., index], fresh)


def anchored(planes: Tensor, motion: Tensor) -> Tensor:
    """Planes of all frames (T,C,h,w), such as noise: each frame's are those before it, moved, as far as they reach.

    motion: (T-1,2,H,W) in pixels of a picture that is a whole number of times as large.
    """
    scale = motion.shape[-1] // planes.shape[-1]
    moved = in_whole_pixels(F.avg_pool2d(motion, scale) / scale)
    frames = [planes[0]]
    for fresh, one in zip(planes[1:], moved, strict=True):
        frames.append(carried(frames[-1], fresh, one))
    return torch.stack(frames)
