"""Products with banded matrices, in slabs that leave out most zeros."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

_SLAB_NODES, _SLAB_PIXELS = 16, 32  # narrow enough to leave out most zeros, wide enough for a matrix product
_WIDE = 512  # on a GPU, where a small product costs what a large one does


def pieces(slabs: Sequence[Tensor], starts: Sequence[int]) -> Iterator[tuple[Tensor, slice, slice]]:
    """(slab, its inputs, its outputs) of a banded matrix in slabs of columns."""
    at = 0
    for slab, start in zip(slabs, starts, strict=True):
        yield slab, slice(start, start + slab.shape[0]), slice(at, at + slab.shape[1])
        at += slab.shape[1]


def slab_width(narrow: int, device: torch.device) -> int:
    """Columns of a slab."""
    return narrow if device.type == "cpu" else _WIDE


@dataclass(frozen=True)
class Banded:
    """A banded matrix (n, N) that acts on both axes: field (n, n) -> matrix^T field matrix (N, N).

    slabs: the matrix cut into slabs of columns, each with only the band of rows that it needs; starts: of the bands.
    """

    slabs: tuple[Tensor, ...]
    starts: tuple[int, ...]
    outputs: int

    @staticmethod
    def build(matrix: Tensor, *, width: int, dtype: torch.dtype, device: torch.device) -> Banded:
        """Cut the bands out of a dense matrix, in slabs of `width` columns."""
        outputs = matrix.shape[1]
        slabs, starts = [], []
        for columns in matrix.split(width, dim=1):
            rows = (columns != 0).any(1).nonzero().flatten()
            low, high = (int(rows[0]), int(rows[-1]) + 1) if rows.numel() else (0, 1)
            slabs.append(columns[low:high].to(device, dtype))
            starts.append(low)
        return Banded(tuple(slabs), tuple(starts), outputs)

    def __call__(self, field: Tensor) -> Tensor:
        half = field.new_empty(field.shape[0], self.outputs)
        for matrix, source, target in pieces(self.slabs, self.starts):
            torch.mm(field[:, source], matrix, out=half[:, target])
        grid = field.new_empty(self.outputs, self.outputs)
        for matrix, source, target in pieces(self.slabs, self.starts):
            torch.mm(matrix.T, half[source], out=grid[target])
        return grid


@dataclass(frozen=True)
class MapWeights:
    """Linear map from an n x n pixel map onto an N x N pupil grid, separable: one matrix (n, N) for both axes."""

    forward: Banded
    """(n, n) -> (N, N)."""
    adjoint: Banded
    """(N, N) -> (n, n), the transpose of `forward`."""

    @staticmethod
    def build(matrix: Tensor, *, dtype: torch.dtype, device: torch.device) -> MapWeights:
        """From the dense matrix (n, N)."""
        nodes, pixels = (slab_width(narrow, device) for narrow in (_SLAB_NODES, _SLAB_PIXELS))
        return MapWeights(
            forward=Banded.build(matrix, width=nodes, dtype=dtype, device=device),
            adjoint=Banded.build(matrix.T, width=pixels, dtype=dtype, device=device),
        )
