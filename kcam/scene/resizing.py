"""Pictures and maps at another size."""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional as F


def target_shape(size: int | tuple[int, int] | None, shape: tuple[int, int]) -> tuple[int, int]:
    """(height, width) of what is resized: `size` of the longer side [pixels], or both; ValueError for less than 1."""
    if size is None:
        return shape
    height, width = shape
    match size:
        case int() if size >= 1:
            return max(1, round(size * height / max(shape))), max(1, round(size * width / max(shape)))
        case (int(height), int(width)) if height >= 1 and width >= 1:
            return height, width
    raise ValueError(f"size must be a number of pixels >= 1, or (height, width), got {size!r}.")


def fitted(planes: Tensor, shape: tuple[int, int], *, pick: bool = False) -> Tensor:
    """Planes (B,C,H,W) cropped in their middle to the proportions of `shape`, then resized to it.

    Args:      pick: the nearest pixels, for what has no mean, such as distances; else they are filtered.
    """
    height, width = planes.shape[-2:]
    scale = max(shape[0] / height, shape[1] / width)
    rows, columns = (max(1, min(n, round(to / scale))) for n, to in ((height, shape[0]), (width, shape[1])))
    top, left = (height - rows) // 2, (width - columns) // 2
    planes = planes[..., top : top + rows, left : left + columns]
    if pick:
        return F.interpolate(planes, shape, mode="nearest-exact")
    return F.interpolate(planes, shape, mode="bilinear", antialias=True)
