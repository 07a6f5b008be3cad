"""Noise in whole numbers: its variance, its root and its mean as before the rounding, and what the rounding hides."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtr

from kcam.calibration.results import Level

_NOT_NORMAL, _SKEWED = 0.02, 0.04
"""How far noise may be off the normal one: in its variance, relative; by its skewness, in a mean rounded [DN]."""


def rounding_variance(variance: np.ndarray | float) -> np.ndarray:
    """What rounding to whole numbers adds to a temporal variance, where pixels lie anywhere between two steps.

    q(s) = 1/12 - 1/(2 pi^2) sum_k exp(-4 pi^2 k^2 s) / k^2,   1/12 from s = 0.1 DN^2 on, 0 at s = 0

    Two values that differ by d before rounding differ by d rounded down or up afterwards, so their squared difference
    grows by f (1 - f), f the fractional part of d; its Fourier series over d ~ N(0, 2 s) is this sum.

    Args:      variance: of the noise before the rounding, s >= 0 [DN^2].

    Example:
    >>> from kcam.calibration.rounding import rounding_variance
    >>> [round(12 * float(rounding_variance(s)), 3) for s in (0.0, 0.01, 1.0)]
    [0.006, 0.557, 1.0]
    """
    k = np.arange(1, 101, dtype=np.float64)
    terms = np.exp(-4 * np.pi**2 * k**2 * np.maximum(np.asarray(variance, np.float64), 0.0)[..., None]) / k**2
    return 1 / 12 - terms.sum(-1) / (2 * np.pi**2)


def unrounded(variance: float) -> float:
    """The temporal variance before rounding: s of s + q(s) = `variance` [DN^2]; below 0 where it is less than q."""
    if variance > 0.25:
        return variance - 1 / 12
    low, high = 0.0, 0.3
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if middle + rounding_variance(middle) > variance else (middle, high)
    return low


def hidden_by_rounding(variance: float, total: float) -> float:
    """How far rounding may move a variance [DN^2], where most pixels lie at one place between two steps: its spread.

    The first term of the Fourier series over that place m, (1/pi^2 + 4 s) exp(-2 pi^2 total) cos(2 pi m).

    Args:      variance: of what is rounded, s.  total: the same with what spreads the pixels over the steps.
    """
    return (1 / math.pi**2 + 4 * max(variance, 0.0)) / math.sqrt(2) * math.exp(-2 * math.pi**2 * max(total, 0.0))


def root(variance: float, error: float) -> tuple[float, float]:
    """The root of a variance that has an error, and its own: half of what two errors up or down move it by.

    Example:
    >>> from kcam.calibration.rounding import root
    >>> [round(part, 3) for part in root(4.0, 0.04)], [round(part, 3) for part in root(-0.1, 0.02)]
    ([2.0, 0.01], [0.0, 0.1])
    """
    kept = max(variance, 0.0)
    value = math.sqrt(kept)
    up, down = math.sqrt(kept + 2 * error) - value, value - math.sqrt(max(kept - 2 * error, 0.0))
    return value, max(up, down) / 2


def before_rounding(level: Level) -> tuple[float, float]:
    """A level's mean before rounding and its standard error [DN].

    Rounding draws the mean of noise below a step to the nearest number. Which place between two numbers has the mean
    that was seen is told by sigma: those count by how well a normal noise of theirs has the variance that was seen.
    """
    drawn = math.sqrt((unrounded(level.variance) + 1 / 12) / (level.frames * level.pixels))
    total = level.spread + level.variance * (1 - 1 / level.frames)  # of single frames, over the pixels
    if total > 0.8:  # rounding moves it by less than 1e-6
        return level.mean, drawn
    step, numbers = math.floor(level.mean), np.arange(-5, 7)
    place, sigma = np.linspace(-0.5, 1.5, 201), np.geomspace(0.02, 0.9, 60)
    share = np.diff(ndtr((numbers + 0.5 - place[:, None]) / sigma[:, None, None]), prepend=0.0)
    means = share @ numbers
    variances = share @ numbers**2 - means**2

    def before(mean: float) -> np.ndarray:
        """For each sigma; in the middle of the places that are all rounded to one number."""
        return np.array([np.interp(mean - step, row + 1e-6 * place, place) for row in means])

    found = before(level.mean)
    expected = np.array([np.interp(at, place, row) for at, row in zip(found, variances, strict=True)])
    missed = (total - expected) / (total * (_NOT_NORMAL + math.sqrt(2 / level.pixels)) + 1e-9)
    weight = np.exp((np.square(missed).min() - missed**2) / 2)
    weight /= weight.sum()
    middle = float(weight @ found)
    open_ = math.sqrt(float(weight @ (found - middle) ** 2))
    drawn = float(weight @ (before(level.mean + drawn) - before(level.mean - drawn))) / 2
    skewed = _SKEWED * float(weight @ np.exp(-2 * math.pi**2 * sigma**2))
    return step + middle, math.hypot(drawn, open_, skewed)
