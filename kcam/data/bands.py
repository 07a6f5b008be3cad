"""Grids of wavelengths: their names, and from one to another by a fixed matrix, with what it would have to guess."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from kcam.data.cube import CubeError, Source
from kcam.units import nm, wavelength_grid

METHODS = ("pchip", "cubic")
EDGES = ("error", "hold")
COARSER = 1.5
"""A target band this many times as far from its neighbours as the source's is averaged over its width."""
_SLACK = 0.1 * nm  # a band may lie this far outside the source without counting as a guess
_MOST_BANDS = 10_000
_AVERAGED = 33  # samples across a band
CASSI_NM = (
    453.5, 457.5, 462, 466, 471.5, 476.5, 481.5, 487, 492.5, 498, 504, 510, 516, 522.5,
    529.5, 536.5, 544, 551.5, 558.5, 567.5, 575.5, 584.5, 594.5, 604, 614.5, 625, 636.5, 648,
)  # fmt: skip
"""The 28 bands of the CASSI papers: caiyuanhao1998/MST, visualization/show_simulation.m."""
PROFILES: dict[str, np.ndarray] = {
    "cassi28": np.asarray(CASSI_NM),
    "cave31": np.arange(400.0, 701.0, 10.0),
    "harvard31": np.arange(420.0, 721.0, 10.0),
    "kaist31": np.arange(420.0, 721.0, 10.0),
}
"""Wavelengths [nm] that a user may name for files that hold none."""


@dataclass(frozen=True)
class Resampling:
    """values_new = matrix @ values, (T,S) float64; extrapolated: (T,) bool, bands outside of the source.

    floored: whether what falls below 0, and below all values that it comes from, is raised to the higher of the two.
    """

    matrix: np.ndarray
    extrapolated: np.ndarray
    floored: bool = False

    def apply(self, values: np.ndarray) -> np.ndarray:
        """Values (S, ...) on the new grid, (T, ...) float32."""
        new = np.tensordot(self.matrix.astype(np.float32), values, axes=1)
        return np.maximum(new, np.minimum(values.min(0), 0)) if self.floored else new


def parse_bands(text: str) -> np.ndarray:
    """Wavelengths (L,) [m] from "420:720:28", start:stop:count in nm.

    Raises:    ValueError for anything else.

    Example:
    >>> [round(1e9 * float(wavelength)) for wavelength in data.parse_bands("420:720:4")]  # nm
    [420, 520, 620, 720]
    """
    complaint = f"bands {text!r} is not start:stop:count in nm, such as 420:720:28."
    try:
        start, stop, count = text.split(":")
        first, last, number = float(start), float(stop), int(count)
    except ValueError as error:
        raise ValueError(complaint) from error
    if not 1 <= number <= _MOST_BANDS or not (0 < first <= last) or (number > 1 and first == last):
        raise ValueError(complaint)
    return wavelength_grid(list(np.linspace(first, last, number) * nm)).numpy()


def profile(name: str) -> np.ndarray:
    """Wavelengths [m] of a named profile; ValueError for an unknown name."""
    if name not in PROFILES:
        raise ValueError(f"unknown profile {name!r}; known: {', '.join(PROFILES)}.")
    return PROFILES[name] * nm


def resampling(source: np.ndarray, target: np.ndarray, *, method: str = "pchip", edge: str = "error") -> Resampling:
    """The matrix that takes spectra from one grid of wavelengths to another.

    It is the interpolant of each unit spectrum: one matrix for all spectra. Where the target is coarser than the source
    (`COARSER`) it is averaged over the width of the target's band, half-way to its neighbours.

    Args:      source: (S,), target: (T,) [m], in any order, no two of the source equal.
               method: "pchip", piecewise cubic Hermite polynomials through the bands, with the slopes of parabolas
               through three of them; where `apply` would get less than 0 from values that are not, it gives 0. (The
               limiter of Fritsch and Carlson, which some mean by this name, depends on the data: it is no matrix.)
               "cubic": a spline, three times as accurate on smooth spectra, left to overshoot.
               edge: what to do with bands beyond the source's ends (by more than 0.1 nm): "error", or "hold" the last
               value and mark them.
    Raises:    ValueError for a grid with equal wavelengths, an unknown method or edge, or bands that would be
        extrapolated.
    Error      of 31 bands (400 to 700 nm) onto 28 (420 to 700 nm), RMS over the 24 patches of the colour chart: see
        tests/data/test_bands.py.

    Example:
    >>> import numpy
    >>> source, target = numpy.linspace(400e-9, 700e-9, 31), numpy.linspace(420e-9, 700e-9, 15)
    >>> spectra = data.resampling(source, target).apply(numpy.ones((31, 2)))
    >>> spectra.shape, bool(numpy.allclose(spectra, 1.0, atol=1e-6))  # even stays even
    ((15, 2), True)
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}; known: {', '.join(METHODS)}.")
    if edge not in EDGES:
        raise ValueError(f"unknown edge {edge!r}; known: {', '.join(EDGES)}.")
    order = np.argsort(source)
    grid = np.asarray(source, dtype=np.float64)[order]
    if len(grid) > 1 and not (np.diff(grid) > 0).all():
        twice = grid[:-1][np.diff(grid) <= 0][0] / nm
        raise ValueError(f"two bands of the source have the same wavelength, {twice:g} nm.")
    target = np.asarray(target, dtype=np.float64)
    outside = (target < grid[0] - _SLACK) | (target > grid[-1] + _SLACK)
    if outside.any() and edge == "error":
        raise ValueError(
            f"{outside.sum()} of {len(target)} bands lie outside of the source's {grid[0] / nm:g} to "
            f"{grid[-1] / nm:g} nm and would be guesses. Choose bands inside, or edge hold to repeat the last value "
            "and mark them."
        )
    weights = _averaged(grid, target, method) if _is_coarser(grid, target) else _interpolated(grid, target, method)
    matrix = np.zeros_like(weights)
    matrix[:, order] = weights
    return Resampling(matrix, outside, floored=method == "pchip")


def resampled(source: Source, target: np.ndarray, *, method: str = "pchip", edge: str = "error") -> Source:
    """A source on another grid of wavelengths: see `resampling`. Bands that were guessed are marked."""
    if len(target) == len(source.wavelengths) and np.allclose(target, source.wavelengths, rtol=0, atol=1e-4 * nm):
        return source
    try:
        found = resampling(source.wavelengths, target, method=method, edge=edge)
    except ValueError as error:
        raise CubeError(str(error)) from error

    def rows(first: int, last: int) -> tuple[np.ndarray, np.ndarray | None]:
        values, valid = source.checked_rows(first, last)
        return found.apply(values), valid

    guessed = found.extrapolated
    if source.extrapolated is not None:  # a band that leans on a guess is one
        guessed = guessed | (found.matrix[:, source.extrapolated] != 0).any(1)
    facts = {**source.facts, "resampled": f"{method} from {len(source.wavelengths)} bands"}
    shape = (len(target), *source.shape[1:])
    return replace(source, shape=shape, wavelengths=target, rows=rows, facts=facts, extrapolated=guessed)


def _interpolated(grid: np.ndarray, points: np.ndarray, method: str) -> np.ndarray:
    inside = np.clip(points, grid[0], grid[-1])
    if len(grid) == 1:
        return np.ones((len(points), 1))
    unit = np.eye(len(grid))
    if method == "cubic":
        return scipy.interpolate.CubicSpline(grid, unit)(inside)
    slopes = np.gradient(unit, grid, axis=0, edge_order=2 if len(grid) > 2 else 1)
    return scipy.interpolate.CubicHermiteSpline(grid, unit, slopes)(inside)


def _averaged(grid: np.ndarray, target: np.ndarray, method: str) -> np.ndarray:
    order = np.argsort(target)
    ascending = target[order]
    middles = (ascending[1:] + ascending[:-1]) / 2
    ends = np.concatenate([[2 * ascending[0] - middles[0]], middles, [2 * ascending[-1] - middles[-1]]])
    rows = np.empty((len(target), len(grid)))
    share = (np.arange(_AVERAGED) + 0.5) / _AVERAGED
    for place, low, high in zip(order, ends[:-1], ends[1:], strict=True):
        rows[place] = _interpolated(grid, low + (high - low) * share, method).mean(0)
    return rows


def _is_coarser(grid: np.ndarray, target: np.ndarray) -> bool:
    if len(target) < 2 or len(grid) < 2:
        return False
    return float(np.median(np.diff(np.sort(target)))) >= COARSER * float(np.median(np.diff(grid))) * (1 - 1e-9)


def band_text(wavelengths: np.ndarray) -> str:
    """A grid in words: "28 bands, 420 to 720 nm"."""
    low, high = float(np.min(wavelengths)) / nm, float(np.max(wavelengths)) / nm
    count = len(wavelengths)
    return f"{count} band{'s' * (count != 1)}, {low:.4g} to {high:.4g} nm" if count else "no bands"
