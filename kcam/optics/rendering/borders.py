"""What lies beyond the borders of a picture."""

from __future__ import annotations

import torch
from torch import Tensor

BORDERS = ("reflect", "replicate", "periodic", "zero")
"""Those that users choose. "dark" is that of planes which come with window - 1 dark pixels before their first ones."""


def extend(planes: Tensor, window: tuple[int, int], border: str) -> Tensor:
    """The picture with the border that the window reaches: window // 2 before, the rest after."""
    for dim, m in zip((-2, -1), window, strict=True):
        planes = extend_along(planes, m, border, dim=dim)
    return planes


def extend_along(planes: Tensor, window: int, border: str, *, dim: int, length: int | None = None) -> Tensor:
    """`extend` along one axis, dim -2 or -1; to a length, a border other than zeros goes on up to there."""
    n, before, after = planes.shape[dim], window // 2, (window - 1) // 2
    if border == "dark":
        before, after = 0, window - 1
    if length is not None and border not in ("zero", "dark"):
        after = length - before - n
    return part(planes, -before, n + after, border, dim=dim)


def part(planes: Tensor, start: int, stop: int, border: str, *, dim: int) -> Tensor:
    """What stands at positions from start on, up to stop, along one axis, dim -2 or -1: some lie in the picture."""
    n = planes.shape[dim]
    if border in ("zero", "dark"):
        around = (-start, stop - n)  # less than none is cut off
        return torch.nn.functional.pad(planes, (0, 0, *around) if dim == -2 else around)
    index = border_index(torch.arange(start, stop, device=planes.device), n, border)
    if dim == -2:
        return planes.index_select(dim, index)
    rows = planes.flatten(0, -2).index_select(-1, index)  # measured: of a matrix it takes a quarter of the time
    return rows.unflatten(0, planes.shape[:-1])


def border_index(index: Tensor, n: int, border: str) -> Tensor:
    """Which pixel stands at each position beyond the picture; reflections repeat where the window is larger."""
    if border == "replicate" or n == 1:
        return index.clamp(0, n - 1)
    if border == "periodic":
        return index % n
    folded = index % (2 * n - 2)
    return torch.where(folded < n, folded, 2 * n - 2 - folded)
