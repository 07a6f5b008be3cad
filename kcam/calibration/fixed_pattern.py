"""What stays in the mean of frames: a pattern over columns, rows and pixels, and light that is uneven."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from kcam.calibration.results import Spatial

_ORDER = 4
"""Of the polynomial in x and y that stands for uneven light: the falloff of a lens is one."""


@dataclass(frozen=True)
class Sums:
    """Frames added up, pixel by pixel: their sum, the temporal variance of this sum, frames, and degrees of freedom."""

    total: np.ndarray
    variance: np.ndarray
    frames: int
    freedom: int

    @classmethod
    def of(cls, stack: np.ndarray) -> Sums:
        """Of frames (n,H,W) of one exposure. What the light changed between them is no noise of the pixels."""
        level = stack - stack.mean((1, 2), keepdims=True)
        count, pixels = len(stack), stack[0].size
        temporal = level.var(0, ddof=1) * (pixels / (pixels - 1))
        return cls(stack.sum(0), count * temporal, count, count - 1)

    def __add__(self, other: Sums) -> Sums:
        return Sums(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    @property
    def mean(self) -> np.ndarray:
        return self.total / self.frames

    @property
    def mean_variance(self) -> np.ndarray:
        return self.variance / self.frames**2


def added(before: list[Sums], more: list[Sums]) -> list[Sums]:
    """The planes of one colour, each to its own; `more` alone where there is none before."""
    return [one + other for one, other in zip(before, more, strict=True)] if before else more


@dataclass(frozen=True)
class Split:
    """Variances of a pattern over columns, rows and pixels, with the error of their sum."""

    column: float
    row: float
    pixel: float
    error: float

    @property
    def total(self) -> float:
        return self.column + self.row + self.pixel

    def spatial(self, pattern: np.ndarray) -> Spatial:
        """With the plane that is drawn for it."""
        column, row, pixel = (math.sqrt(max(value, 0.0)) for value in (self.column, self.row, self.pixel))
        return Spatial(pattern - pattern.mean(), column, row, pixel)


def split_variance(pattern: np.ndarray, *, temporal: float, freedom: int, fitted: int = 0) -> Split:
    """The variance of a pattern (H,W) over columns, rows and pixels: the analysis of variance of a two-way layout.

    Its mean squares, of columns MS_c, of rows MS_r and of the rest MS, have the expected values

        MS = s_pixel^2 + temporal,   MS_c = MS + H s_column^2,   MS_r = MS + W s_row^2

    Args:      temporal: what is left of the temporal noise in each pixel, known from so many degrees of `freedom`.
               fitted: order of the polynomial that was taken off.
    """
    height, width = pattern.shape
    centred = pattern - pattern.mean()
    columns, rows = centred.mean(0), centred.mean(1)
    rest = centred - columns - rows[:, None]
    crossed = fitted * (fitted - 1) // 2  # terms of the polynomial in both x and y
    squares = (
        height * (columns**2).sum() / (width - 1 - fitted),
        width * (rows**2).sum() / (height - 1 - fitted),
        (rest**2).sum() / ((height - 1) * (width - 1) - crossed),
    )
    column, row = (squares[0] - squares[2]) / height, (squares[1] - squares[2]) / width
    errors = (
        math.sqrt(2 / (width - 1)) * squares[0] / height,
        math.sqrt(2 / (height - 1)) * squares[1] / width,
        float((rest**2).std()) / math.sqrt(pattern.size),
        math.sqrt(2 / (freedom * pattern.size)) * temporal,
    )
    return Split(float(column), float(row), float(squares[2] - temporal), math.hypot(*errors))


def pooled(splits: Sequence[Split]) -> Split:
    """The mean over the planes of one colour."""
    count = len(splits)
    column, row, pixel = (sum(getattr(s, part) for s in splits) / count for part in ("column", "row", "pixel"))
    return Split(column, row, pixel, math.hypot(*(s.error for s in splits)) / count)


def uneven_light(image: np.ndarray) -> tuple[np.ndarray, int]:
    """Uneven light: the polynomial in x and y of order `_ORDER` nearest to an image, and its order; a mean if small."""
    height, width = image.shape
    order = _ORDER if min(height, width) >= 16 else 0
    x, y = (np.polynomial.legendre.legvander(np.linspace(-1, 1, size), order) for size in (width, height))
    terms = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
    basis = np.stack([np.multiply.outer(y[:, i], x[:, j]).ravel() for i, j in terms], axis=1)
    weights = np.linalg.solve(basis.T @ basis, basis.T @ image.ravel())
    return (basis @ weights).reshape(image.shape), order
