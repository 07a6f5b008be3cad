"""A sensor's numbers from pairs of frames: the photon transfer method of EMVA Standard 1288, release 4.0 Linear.

Two frames of one exposure differ by temporal noise alone, so their difference gives its variance, and their mean keeps
the fixed pattern. Over the levels of light the variance follows a line, in DN^2,

    sigma_y^2 = K^2 sigma_d^2 + q + K (mu_y - b),    q = 1/12 of the rounding, b the mean without light at no time

whose slope is the gain K and whose height at b is the read noise. Dark electrons arrive at random as photoelectrons do
and move along the same line, so darks of every exposure time lie on it.

Standard errors count everything that frames of this size leave open: the temporal noise of every mean and variance,
that the fixed pattern is seen on a finite number of pixels, and what the rounding can hide of a noise below one step.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np
from scipy.special import ndtr

from kcam import files
from kcam.calibration.frames import as_frame
from kcam.plain import to_json
from kcam.sensor.mosaic import CHANNELS, PATTERNS, pattern_tile

FORMAT = 1
LINEAR = 0.7
"""Of saturation: below it the standard fits the gain."""
USUAL_BITS = (10, 12, 14, 16)
MONO = "mono"
"""The channel of a sensor without colour filter."""
UNITS = {
    "gain": "DN / electron",
    "read_noise": "electrons",
    "prnu": "fraction",
    "dsnu": "electrons",
    "full_well": "electrons",
    "dark_current": "electrons / s",
    "linearity_error": "fraction",
}
"""What is measured of each channel, and its unit."""
_WIDER = 1.05
"""Standard errors are told so much wider than they are computed, since they are estimates themselves."""
_ORDER = 4
"""Of the polynomial in x and y that stands for uneven light: the falloff of a lens is one."""
_CUT = 0.005
"""Of the dark pixels: where more are 0, the standard asks for a higher black level."""
_ALIKE = 0.02
"""Relative: the signals of two frames of a pair differ by less."""
_NOT_NORMAL, _SKEWED = 0.02, 0.04
"""How far noise may be off the normal one: in its variance, relative; by its skewness, in a mean rounded [DN]."""
_GRAY = 0.01
"""Relative: colour filters whose four cells see light so alike are none."""


@dataclass(frozen=True)
class Quantity:
    """A measured value with its standard error, or the reason why the frames do not show it.

    Args:      value, standard_error: in `unit`; None where the frames do not show it.
               reason: why not; of a value, what to know about it.

    Example:
    >>> from kcam import calibration
    >>> print(calibration.Quantity(2.0312, 0.0213, "electrons"))
    2.031 ± 0.021 electrons
    """

    value: float | None
    standard_error: float | None
    unit: str
    reason: str = ""

    def __str__(self) -> str:
        if self.value is None or self.standard_error is None:
            return f"unknown: {self.reason}"
        if self.standard_error <= 0:
            return f"{self.value:.4g} ± 0 {self.unit}"
        digits = max(0, 1 - math.floor(math.log10(self.standard_error)))
        return f"{self.value:.{digits}f} ± {self.standard_error:.{digits}f} {self.unit}"


@dataclass(frozen=True)
class Level:
    """What the frames of one exposure say of one channel.

    Args:      mean, variance: of the values, and their temporal variance [DN, DN^2].
               time: exposure [s]; None if unknown.
               frames, pixels: how many were seen.  spread: variance of the mean frame over its pixels [DN^2].
               top, bottom: shares of the pixels at the highest number of the converter, and at 0.
               linear: whether the gain was fitted to it.  deviation: from a line over time, relative; None outside.

    Example:
    >>> from kcam import calibration
    >>> electrons = [torch.full((2, 64, 64), n) for n in (0.0, 500.0, 1000.0, 2000.0)]
    >>> frames = [(64 + 0.5 * torch.poisson(n) + torch.randn(n.shape)).round() for n in electrons]
    >>> found = calibration.photon_transfer(frames[1:], frames[:1], bits=12)
    >>> [level.linear for level in found.channels["mono"].flats]
    [True, True, True]
    """

    mean: float
    variance: float
    time: float | None
    frames: int
    pixels: int
    spread: float
    top: float
    bottom: float
    linear: bool = False
    deviation: float | None = None


@dataclass(frozen=True)
class Spatial:
    """The fixed pattern of one channel: maps, and the standard's split of their variance into columns, rows and pixels.

    Args:      map: what is left of the averaged frame [DN; of light, a fraction].
               column, row, pixel: standard deviations [same].

    Example:
    >>> from kcam import calibration
    >>> electrons = [torch.full((2, 64, 64), n) for n in (0.0, 500.0, 1000.0, 2000.0)]
    >>> frames = [(64 + 0.5 * torch.poisson(n) + torch.randn(n.shape)).round() for n in electrons]
    >>> found = calibration.photon_transfer(frames[1:], frames[:1], bits=12)
    >>> found.channels["mono"].dark_pattern.map.shape  # of a sensor without a pattern: what noise is left
    (64, 64)
    """

    map: np.ndarray
    column: float
    row: float
    pixel: float


@dataclass(frozen=True)
class ChannelCalibration:
    """The numbers of one channel, each with its standard error, and the levels they come from.

    Args:      gain ... linearity_error: as in `UNITS`.  black_level: the mean without light, of no exposure time [DN].
               saturation: mean of saturated flats [DN]; None if there are none.
               dark_variance: temporal, at the black level, without the rounding [DN^2].
               darks, flats: of the photon transfer curve, flats by rising mean.
               dark_pattern, light_pattern: for the plots; None where there is none.

    Example:
    >>> from kcam import calibration
    >>> electrons = [torch.full((2, 64, 64), n) for n in (0.0, 500.0, 1000.0, 2000.0)]
    >>> frames = [(64 + 0.5 * torch.poisson(n) + torch.randn(n.shape)).round() for n in electrons]
    >>> found = calibration.photon_transfer(frames[1:], frames[:1], bits=12)
    >>> found.channels["mono"].gain.unit
    'DN / electron'
    """

    gain: Quantity
    read_noise: Quantity
    prnu: Quantity
    dsnu: Quantity
    full_well: Quantity
    dark_current: Quantity
    linearity_error: Quantity
    black_level: float
    saturation: float | None
    dark_variance: float
    darks: tuple[Level, ...]
    flats: tuple[Level, ...]
    dark_pattern: Spatial | None = field(default=None, repr=False, compare=False)
    light_pattern: Spatial | None = field(default=None, repr=False, compare=False)

    def quantities(self) -> dict[str, Quantity]:
        """Name -> value, of all of `UNITS`."""
        return {name: getattr(self, name) for name in UNITS}


@dataclass(frozen=True)
class SensorCalibration:
    """A calibrated sensor: prints as a table, and is saved as the file that `sensor.from_calibration` reads.

    Args:      bits: of the converter.  black_level: mean over the channels [DN].  pattern: of the colour filter; None
               for a monochrome sensor.  channels: by name: R, G, B, W, or mono.  notes: what to know of the frames.

    Example:
    >>> from kcam import calibration
    >>> electrons = [torch.full((2, 64, 64), n) for n in (0.0, 500.0, 1000.0, 2000.0)]
    >>> frames = [(64 + 0.5 * torch.poisson(n) + torch.randn(n.shape)).round() for n in electrons]
    >>> found = calibration.photon_transfer(frames[1:], frames[:1], bits=12)
    >>> print(str(found).splitlines()[0])
    12 bits, black level 64.0 DN, mono
    """

    bits: int
    black_level: float
    pattern: str | None
    channels: dict[str, ChannelCalibration]
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        lines = [f"{self.bits} bits, black level {self.black_level:.1f} DN, {self.pattern or MONO}"]
        for name, channel in self.channels.items():
            for title, quantity in channel.quantities().items():
                lines.append(f"  {name:<5}{title.replace('_', ' '):<17}{quantity}")
        return "\n".join(lines + [f"  note: {note}" for note in self.notes])

    def document(self) -> dict[str, Any]:
        """What the file holds, as plain values."""
        channels = {}
        for name, channel in self.channels.items():
            numbers: dict[str, Any] = {}
            for title, found in channel.quantities().items():
                told = {"reason": found.reason} if found.reason else {}
                numbers[title] = {
                    "value": found.value,
                    "standard_error": found.standard_error,
                    "unit": found.unit,
                    **told,
                }
            curves = {what: [asdict(level) for level in getattr(channel, what)] for what in ("darks", "flats")}
            channels[name] = numbers | {"black_level": channel.black_level, "levels": curves}
        return {
            "format": FORMAT,
            "standard": "EMVA 1288 release 4.0 linear",
            "bits": self.bits,
            "black_level": self.black_level,
            "pattern": self.pattern,
            "channels": channels,
            "notes": list(self.notes),
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it as JSON: per channel {"value", "standard_error", "unit"} of each of `UNITS`.

        A value that the frames do not show is null, with its "reason".

        Raises:    ValueError where no such file can be.
        """
        files.check_place(path)
        files.replace(path, to_json(self.document()))


# ---- statistics of frames --------------------------------------------------------------------------------------------


def rounding_variance(variance: np.ndarray | float) -> np.ndarray:
    """What rounding to whole numbers adds to a temporal variance, where pixels lie anywhere between two steps.

    q(s) = 1/12 - 1/(2 pi^2) sum_k exp(-4 pi^2 k^2 s) / k^2,   1/12 from s = 0.1 DN^2 on, 0 at s = 0

    Two values that differ by d before rounding differ by d rounded down or up afterwards, so their squared difference
    grows by f (1 - f), f the fractional part of d; its Fourier series over d ~ N(0, 2 s) is this sum.

    Args:      variance: of the noise before the rounding, s >= 0 [DN^2].

    Example:
    >>> from kcam.calibration.photon_transfer import rounding_variance
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


def _hidden(variance: float, total: float) -> float:
    """How far rounding may move a variance [DN^2], where most pixels lie at one place between two steps: its spread.

    The first term of the Fourier series over that place m, (1/pi^2 + 4 s) exp(-2 pi^2 total) cos(2 pi m).

    Args:      variance: of what is rounded, s.  total: the same with what spreads the pixels over the steps.
    """
    return (1 / math.pi**2 + 4 * max(variance, 0.0)) / math.sqrt(2) * math.exp(-2 * math.pi**2 * max(total, 0.0))


def root(variance: float, error: float) -> tuple[float, float]:
    """The root of a variance that has an error, and its own: half of what two errors up or down move it by.

    Example:
    >>> from kcam.calibration.photon_transfer import root
    >>> [round(part, 3) for part in root(4.0, 0.04)], [round(part, 3) for part in root(-0.1, 0.02)]
    ([2.0, 0.01], [0.0, 0.1])
    """
    kept = max(variance, 0.0)
    value = math.sqrt(kept)
    up, down = math.sqrt(kept + 2 * error) - value, value - math.sqrt(max(kept - 2 * error, 0.0))
    return value, max(up, down) / 2


@dataclass(frozen=True)
class _Sums:
    """Frames added up, pixel by pixel: their sum, the temporal variance of this sum, frames, and degrees of freedom."""

    total: np.ndarray
    variance: np.ndarray
    frames: int
    freedom: int

    def __add__(self, other: _Sums) -> _Sums:
        parts = (getattr(self, f.name) + getattr(other, f.name) for f in fields(_Sums))
        return _Sums(*parts)

    @property
    def mean(self) -> np.ndarray:
        return self.total / self.frames

    @property
    def mean_variance(self) -> np.ndarray:
        return self.variance / self.frames**2


def _sums(stack: np.ndarray) -> _Sums:
    """Of frames (n,H,W) of one exposure. What the light changed between them is no noise of the pixels."""
    level = stack - stack.mean((1, 2), keepdims=True)
    count, pixels = len(stack), stack[0].size
    temporal = level.var(0, ddof=1) * (pixels / (pixels - 1))
    return _Sums(stack.sum(0), count * temporal, count, count - 1)


@dataclass(frozen=True)
class _Split:
    """Variances of a pattern over columns, rows and pixels, with the error of their sum."""

    column: float
    row: float
    pixel: float
    error: float

    @property
    def total(self) -> float:
        return self.column + self.row + self.pixel

    def spatial(self, pattern: np.ndarray) -> Spatial:
        column, row, pixel = (math.sqrt(max(value, 0.0)) for value in (self.column, self.row, self.pixel))
        return Spatial(pattern, column, row, pixel)


def _split(pattern: np.ndarray, *, temporal: float, freedom: int, fitted: int = 0) -> _Split:
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
    return _Split(float(column), float(row), float(squares[2] - temporal), math.hypot(*errors))


def _pooled(splits: Sequence[_Split]) -> _Split:
    """The mean over the planes of one colour."""
    count = len(splits)
    column, row, pixel = (sum(getattr(s, part) for s in splits) / count for part in ("column", "row", "pixel"))
    return _Split(column, row, pixel, math.hypot(*(s.error for s in splits)) / count)


def _smooth(image: np.ndarray) -> tuple[np.ndarray, int]:
    """Uneven light: the polynomial in x and y of order `_ORDER` nearest to an image, and its order; a mean if small."""
    height, width = image.shape
    order = _ORDER if min(height, width) >= 16 else 0
    x, y = (np.polynomial.legendre.legvander(np.linspace(-1, 1, size), order) for size in (width, height))
    terms = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
    basis = np.stack([np.multiply.outer(y[:, i], x[:, j]).ravel() for i, j in terms], axis=1)
    weights = np.linalg.solve(basis.T @ basis, basis.T @ image.ravel())
    return (basis @ weights).reshape(image.shape), order


# ---- frames in, checked ----------------------------------------------------------------------------------------------


class _Frames:
    """Levels of frames, read one level at a time, each checked against all that were read before."""

    def __init__(self, given: Any, what: str, times: Sequence[float] | None) -> None:
        self.what = what
        self.levels = _levels(given, what)
        self.times: list[float | None] = [None] * len(self.levels)
        if times is not None:
            seconds = [float(time) for time in times]
            counts = [len(level) for level in self.levels]
            if len(seconds) == sum(counts):  # one of each frame
                by_level = [seconds[sum(counts[:i]) : sum(counts[: i + 1])] for i in range(len(counts))]
                for index, told in enumerate(by_level):
                    if len(set(told)) > 1:
                        raise ValueError(
                            f"the frames of {what}[{index}] have exposure times of {told} s: expected one."
                        )
                seconds = [told[0] for told in by_level]
            if len(seconds) != len(self.levels):
                raise ValueError(
                    f"{len(seconds)} exposure times for {len(self.levels)} levels of {what}: expected one each."
                )
            for index, time in enumerate(seconds):
                if not (math.isfinite(time) and (time > 0 or (time == 0 and what == "darks"))):
                    frame = self.levels[index][0]
                    name = str(frame) if isinstance(frame, (str, os.PathLike)) else f"{what}[{index}]"
                    fix = " A frame of no exposure is a dark: give it to --darks." if time == 0 else ""
                    raise ValueError(
                        f"{name} has an exposure time of {time:g} s: expected seconds > 0, such as 0.01.{fix}"
                    )
            self.times = list(seconds)

    def read(self, index: int, shape: tuple[int, int] | None) -> np.ndarray:
        """The frames of one level (n,H,W)."""
        stack = []
        for number, frame in enumerate(self.levels[index]):
            name = self.name(index, number)
            values = as_frame(frame, name)
            shape = shape or values.shape
            if values.shape != shape:
                raise ValueError(
                    f"{name} has {values.shape[0]} x {values.shape[1]} pixels, the frames before it {shape[0]} x "
                    f"{shape[1]}: expected one size. Crop all to the same part, from an even row and column."
                )
            stack.append(values)
        return np.stack(stack)

    def name(self, index: int, number: int) -> str:
        frame = self.levels[index][number]
        return str(frame) if isinstance(frame, (str, os.PathLike)) else f"{self.what}[{index}][{number}]"


def _levels(given: Any, what: str) -> list[list[Any]]:
    """Frames by level: of levels (n,H,W), of lists of frames, or of frames (H,W) two by two."""
    if given is None or (not hasattr(given, "shape") and len(given) == 0) or getattr(given, "shape", (1,))[0] == 0:
        light = "with the lens capped" if what == "darks" else "of even light"
        raise ValueError(f"there are no {what}: expected at least one pair of frames {light}.")
    if getattr(given, "ndim", 3) < 3 or isinstance(given, (str, os.PathLike)):
        raise ValueError(f"{what}: one frame is no pair: expected two frames (H,W) of each exposure.")
    single = [getattr(item, "ndim", 2 if isinstance(item, (str, os.PathLike)) else 3) == 2 for item in given]
    if all(single):
        if len(single) % 2:
            number = "one frame is no pair" if len(single) == 1 else f"{len(single)} frames are no pairs"
            raise ValueError(f"{what}: {number}: expected two frames (H,W) of each exposure.")
        frames = list(given)
        return [list(pair) for pair in zip(frames[::2], frames[1::2], strict=True)]
    levels = [list(level) for level in given]
    for index, level in enumerate(levels):
        if len(level) < 2:
            raise ValueError(
                f"{what}[{index}] is {len(level)} frame: expected a pair (2,H,W), whose difference is the noise."
            )
    return levels


def _cells(pattern: str | None) -> dict[str, list[tuple[int, int]]]:
    """Channel -> where its pixels stand in the tile."""
    if pattern is None:
        return {MONO: [(0, 0)]}
    tile = pattern_tile(pattern)
    return {
        CHANNELS[channel]: [(int(y), int(x)) for y, x in (tile == channel).nonzero()]
        for channel in sorted(int(value) for value in tile.unique())
    }


def _check_pair(stack: np.ndarray, dark: float, names: Sequence[str]) -> None:
    """ValueError unless the frames of a level have the same light."""
    means = stack.mean((1, 2))
    error = 6 * math.sqrt(2 * (stack - means[:, None, None]).var() / stack[0].size)
    for name, mean in zip(names[1:], means[1:], strict=True):
        if abs(mean - means[0]) > max(_ALIKE * abs(means[0] - dark), error, 0.5):
            raise ValueError(
                f"{names[0]} and {name} are no pair: their means are {means[0]:.1f} and {mean:.1f} DN. Expected two "
                "frames of the same exposure and light; is one missing before them?"
            )


def _check_bits(bits: int | None, highest: float, piled: float, steps: int, notes: list[str]) -> int:
    """The bits of the converter: as given, if the values can be of such a one, or as they show."""
    if bits is not None and (isinstance(bits, bool) or not isinstance(bits, int) or not 9 <= bits <= 24):
        raise ValueError(f"bits must be a whole number from 9 to 24, such as 12, got {bits!r}.")
    if steps > 1:
        raise ValueError(
            f"all values are multiples of {steps}: {16 - round(math.log2(steps))}-bit numbers shifted up, or scaled. "
            f"Divide the frames by {steps}."
        )
    if highest <= 255 and (bits is None or (piled > 0.01 and highest == 255)):
        dim = "" if bits else " If the frames are only that dim, say bits, such as 12, or take brighter flats."
        raise ValueError(
            f"the highest value of all frames is {highest:g} DN: 8-bit numbers, whatever the files hold, and what is "
            f"left of a noise there is rounding. Save the raw with all its bits.{dim}"
        )
    exact = math.log2(highest + 1)
    if piled > 0.01 and exact.is_integer() and exact >= 9:
        if bits is not None and int(exact) < bits:
            raise ValueError(
                f"saturated pixels stand at {highest:g} DN, full scale of {int(exact)} bits, but bits is {bits}. Use "
                f"bits={int(exact)}."
            )
        bits = bits or int(exact)
    if bits is None:
        bits = next((usual for usual in USUAL_BITS if highest < 2**usual), math.ceil(exact))
        notes.append(f"{bits} bits are a guess from the highest value, {highest:g} DN: say bits to be sure")
    if highest > 2**bits - 1:
        raise ValueError(
            f"the highest value is {highest:g} DN, above {2**bits - 1}, full scale of {bits} bits: say "
            f"bits={math.ceil(exact)}."
        )
    return bits


def _check_phase(means: dict[tuple[int, int], float], pattern: str | None, notes: list[str]) -> None:
    """ValueError where the light of the four cells of 2 x 2 pixels is that of another colour filter.

    Off by a row and a column greens stay greens, and flats cannot tell red from blue: a chart can, `colour_matrix`.
    """
    pattern_cells = {cell: means[cell] for cell in ((0, 0), (0, 1), (1, 0), (1, 1))}
    size = max(pattern_cells.values())

    def unlike(one: tuple[int, int], other: tuple[int, int]) -> float:
        return abs(means[one] - means[other]) / size

    straight, crossed = unlike((0, 0), (1, 1)), unlike((0, 1), (1, 0))
    if pattern is None:
        if max(unlike((0, 0), cell) for cell in pattern_cells) > 0.05:
            green = "RGGB or BGGR" if crossed < straight else "GRBG or GBRG"
            raise ValueError(
                "the four cells of 2 x 2 pixels have light of their own, up to "
                f"{100 * (1 - min(pattern_cells.values()) / size):.0f} % apart: a colour filter lies on this sensor. "
                f"Say its pattern, such as {green}."
            )
        return
    apart = max(unlike((0, 0), cell) for cell in pattern_cells)
    if apart < _GRAY:
        notes.append(
            f"the four cells of {pattern} see the same light within {100 * apart:.2g} %: is this a monochrome sensor? "
            "Then leave the pattern out"
        )
    greens, others = (crossed, straight) if pattern in ("RGGB", "BGGR") else (straight, crossed)
    if greens > 0.05 and others < greens / 3:
        row, column = {
            "RGGB": ("GBRG", "GRBG"),
            "BGGR": ("GRBG", "GBRG"),
            "GRBG": ("BGGR", "RGGB"),
            "GBRG": ("RGGB", "BGGR"),
        }[pattern]
        raise ValueError(
            f"the two greens of {pattern} differ by {100 * greens:.0f} %, its red and blue by {100 * others:.0f} %: "
            f"the colour filter is off by one pixel. Use pattern {column} (one column) or {row} (one row)."
        )


# ---- the photon transfer ---------------------------------------------------------------------------------------------


def photon_transfer(
    flats: Any,
    darks: Any,
    *,
    bits: int | None = None,
    pattern: str | None = None,
    exposure_times: Sequence[float] | None = None,
    dark_times: Sequence[float] | None = None,
) -> SensorCalibration:
    """Calibrate a sensor from pairs of frames, as EMVA 1288 does: gain, noises, fixed pattern, full well.

    sigma_y^2 = K^2 sigma_d^2 + 1/12 + K (mu_y - b),   sigma_y^2 = var(a - b) / 2 of a pair

    Args:      flats: pairs of frames of even light, at levels from dark to saturated: (levels, 2, H, W), a list of
               (2,H,W) or of pairs of frames, or frames (H,W) that are taken two by two. Arrays, tensors or names of
               files; whole numbers as the converter gave them. More than two frames a level are better.
               darks: the same without light, at one exposure time or several.
               bits: of the converter; None to see from saturated pixels, or else from the highest value.
               pattern: of the colour filter, a name in `sensor.PATTERNS`; None for a monochrome sensor.
               exposure_times, dark_times: one of each level [s]; None where unknown. Linearity needs those of flats at
               one light, dark current those of darks.
    Returns:   a value and its standard error for each of `UNITS`, by channel.
    Raises:    ValueError for no darks, one frame, sizes that differ, NaN, values that are not raw, the wrong number of
               bits, 8 bits, a pattern that is off by a row or by a column (by both, red is taken for blue: flats
               cannot tell, `colour_matrix` warns), exposures of 0, flats that are all saturated or all dark.
    Valid when the light is even up to a polynomial of 4th order in x and y, which is taken off with what PRNU is as
    smooth, and the response is linear up to 70 % of saturation.
    Source:    EMVA 1288 release 4.0 Linear: temporal noise and gain, nonuniformity, linearity.

    Example:
    >>> from kcam import calibration
    >>> electrons = [torch.full((2, 256, 256), n) for n in (0.0, 500.0, 1000.0, 2000.0)]
    >>> frames = [(64 + 0.5 * torch.poisson(n) + torch.randn(n.shape)).round() for n in electrons]
    >>> found = calibration.photon_transfer(frames[1:], frames[:1], bits=12).channels["mono"]
    >>> abs(found.gain.value - 0.5) < 0.01, abs(found.read_noise.value - 2.0) < 0.1  # DN / electron, electrons
    (True, True)
    """
    pattern = pattern or None
    dark_frames, flat_frames = _Frames(darks, "darks", dark_times), _Frames(flats, "flats", exposure_times)
    notes: list[str] = []
    survey = _Survey(pattern)
    for frames in (dark_frames, flat_frames):
        for index in range(len(frames.levels)):
            survey.look(frames, index)
    bits = _check_bits(bits, survey.highest, survey.piled, survey.steps or 1, notes)
    lit = max(survey.light.values()) > 0.05 * (survey.highest - survey.black)
    if lit and (pattern is None or len(PATTERNS[pattern]) == 2):
        _check_phase(survey.light, pattern, notes)
    transfers = {name: _Transfer(name, *survey.levels(name, float(2**bits - 1))) for name in survey.cells}
    patterns: dict[str, list[_Sums]] = {name: [] for name in transfers}
    for index in range(len(flat_frames.levels)):  # once more through those that show the pattern of the gain
        wanted = [name for name, transfer in transfers.items() if index in transfer.even]
        if wanted:
            stack = flat_frames.read(index, survey.shape)
            for name in wanted:
                patterns[name] = _added(patterns[name], survey.sums(stack, name))
    channels = {
        name: t.result(t.shortest(survey.dark[name]), patterns[name], notes=notes) for name, t in transfers.items()
    }
    black = float(np.mean([channel.black_level for channel in channels.values()]))
    return SensorCalibration(bits, black, pattern, channels, tuple(dict.fromkeys(notes)))


def _added(before: list[_Sums], more: list[_Sums]) -> list[_Sums]:
    return [one + other for one, other in zip(before, more, strict=True)] if before else more


class _Survey:
    """What one look at all frames tells: the levels of each channel, and what the values are.

    highest, piled: the highest value, and the share of a level that stands there.  steps: what all values are multiples
    of.  light: sum of the means above black by cell of 2 x 2 pixels.  dark: by channel, each level of darks added up.
    """

    def __init__(self, pattern: str | None) -> None:
        self.cells = _cells(pattern)
        self.tile = (1, 1) if pattern is None else (len(PATTERNS[pattern]), len(PATTERNS[pattern][0]))
        self.shape: tuple[int, int] | None = None
        self.highest, self.piled, self.steps, self.black = 0.0, 0.0, 0, 0.0
        self.light = dict.fromkeys([(0, 0), (0, 1), (1, 0), (1, 1)], 0.0)
        self.dark: dict[str, list[list[_Sums]]] = {name: [] for name in self.cells}
        self.seen: dict[tuple[str, str], list[tuple[float, Level]]] = {}

    def planes(self, stack: np.ndarray, name: str) -> list[np.ndarray]:
        """The pixels of one channel, a plane (n,H,W) for each of its places in the tile."""
        height, width = (size // step * step for size, step in zip(stack.shape[1:], self.tile, strict=True))
        return [stack[:, y : height : self.tile[0], x : width : self.tile[1]] for y, x in self.cells[name]]

    def sums(self, stack: np.ndarray, name: str) -> list[_Sums]:
        """The planes of one channel, added up."""
        return [_sums(plane) for plane in self.planes(stack, name)]

    def look(self, frames: _Frames, index: int) -> None:
        """Take the frames of one level into account."""
        stack = frames.read(index, self.shape)
        if self.shape is None:
            self.shape = (stack.shape[1], stack.shape[2])
            least = [8 * step for step in self.tile]
            if any(size < small for size, small in zip(self.shape, least, strict=True)):
                told = f"{self.shape[0]} x {self.shape[1]}"
                raise ValueError(f"frames of {told} pixels are too small: expected at least {least[0]} x {least[1]}.")
            self.black = float(stack.mean())
        _check_pair(stack, self.black, [frames.name(index, number) for number in range(len(stack))])
        top = float(stack.max())
        share = float((stack == top).mean())
        self.piled = share if top > self.highest else max(share, self.piled) if top == self.highest else self.piled
        self.highest = max(top, self.highest)
        self.steps = math.gcd(self.steps, int(np.gcd.reduce(stack.astype(np.int64).ravel())))
        if frames.what == "flats" and share < 0.01:
            for y, x in self.light:
                self.light[y, x] += float(stack[:, y::2, x::2].mean()) - self.black
        for name in self.cells:
            planes, sums = self.planes(stack, name), self.sums(stack, name)
            if frames.what == "darks":
                self.dark[name].append(sums)
            level = Level(
                mean=float(np.mean([s.mean.mean() for s in sums])),
                variance=float(np.mean([s.variance.mean() / s.frames for s in sums])),
                time=frames.times[index],
                frames=len(stack),
                pixels=sum(s.total.size for s in sums),
                spread=float(np.mean([s.mean.var(ddof=1) for s in sums])),
                top=float(np.mean([(plane == top).mean() for plane in planes])),
                bottom=float(np.mean([(plane == 0).mean() for plane in planes])),
            )
            self.seen.setdefault((name, frames.what), []).append((top, level))

    def levels(self, name: str, scale: float) -> tuple[list[Level], list[Level], float]:
        """Darks and flats of a channel, and full scale [DN]."""
        darks, flats = (
            [level if top == scale else replace(level, top=0.0) for top, level in self.seen[name, what]]
            for what in ("darks", "flats")
        )
        return darks, flats, scale


class _Transfer:
    """The photon transfer curve of one channel.

    Args:      darks, flats: its levels, as they were given.  scale: highest number of the converter [DN].
    """

    def __init__(self, name: str, darks: list[Level], flats: list[Level], scale: float) -> None:
        self.name, self.given, self.scale = name, darks, scale
        self.darks = [d for d in darks if d.top <= 1e-3 and d.mean + 3 * math.sqrt(d.variance + d.spread) < scale]
        if not self.darks:
            raise ValueError(
                f"all darks are saturated in {name}: their lowest mean is {min(d.mean for d in darks):.1f} DN. Did "
                "light fall on the sensor? Cap the lens, and expose for 0.1 s or less."
            )
        self.order = sorted(enumerate(flats), key=lambda item: item[1].mean)
        self.flats = [level for _, level in self.order]
        self.cut = max(level.bottom for level in darks) > _CUT
        self.black, self.black_error, self.rate, self.rate_error = self._black()
        if self.flats[-1].mean - self.black < 3 * max(_mean_error(self.flats[-1]), 0.05):
            raise ValueError(
                f"the flats show no light in {name}: their highest mean, {self.flats[-1].mean:.2f} DN, is "
                "that of the darks. Are darks and flats mixed up?"
            )
        self.saturation, self.saturation_error, self.saturates = self._saturation()
        self.linear = self._linear()
        self.slope, self.height, self.covariance = self._line()
        self.clamped = self._clamp()
        inside = [(index, level) for (index, level), linear in zip(self.order, self.linear, strict=True) if linear]
        half = [i for i, level in inside if level.mean - self.black > 0.1 * (self.limit - self.black)]
        self.even = set(half or [index for index, _ in inside[-1:]])

    def shortest(self, darks: list[list[_Sums]]) -> list[_Sums]:
        """The darks whose pattern is the offsets' alone: in others that of the dark current comes in."""
        least = min(self.darks, key=lambda level: level.mean if level.time is None else level.time)
        found: list[_Sums] = []
        for level, sums in zip(self.given, darks, strict=True):
            alike = abs(level.mean - least.mean) < 4 * math.hypot(_mean_error(level), _mean_error(least))
            if level is least or (level.time == least.time and alike):
                found = _added(found, sums)
        return found

    def _black(self) -> tuple[float, float, float, float]:
        """Mean without light at no time [DN], and the dark signal [DN / s], each with its error: NaN if unknown."""
        means, errors = np.array([_mean(level) for level in self.darks]).T
        times = [level.time for level in self.darks]
        if None not in times and len(set(times)) > 1:
            solved, covariance = _weighted(np.array(times, float), means, errors**2)
            return solved[0], math.sqrt(covariance[0, 0]), solved[1], math.sqrt(covariance[1, 1])
        lowest = int(np.argmin(means))
        alike = np.abs(means - means[lowest]) < 4 * np.hypot(errors, errors[lowest])
        weights = alike / errors**2
        error = float(1 / math.sqrt(weights.sum()))
        if self.cut:
            error = math.hypot(error, 0.4 * math.sqrt(self.darks[lowest].variance))
        return float((weights * means).sum() / weights.sum()), error, math.nan, math.nan

    def _saturation(self) -> tuple[float | None, float, list[bool]]:
        """Mean at saturation [DN] and its error, None if no flat shows it; and which flats saturate."""
        dark = min(level.variance for level in self.darks)
        signal = np.array([level.mean - self.black for level in self.flats])
        noise = np.array([level.variance - dark for level in self.flats])
        peak = int(np.argmax(noise))
        safe = (signal > 0) & (signal <= LINEAR * signal[peak]) | (np.arange(len(signal)) == 0)
        weights = np.where(safe, signal, 0.0)
        slope = (weights * noise).sum() / max((weights * signal).sum(), 1e-12)  # minimises relative errors
        expected = np.maximum(slope, 1e-12) * signal
        saturates = [
            level.top > 1e-3 or (index > peak and noise[index] < 0.8 * expected[index])
            for index, level in enumerate(self.flats)
        ]
        if not any(saturates):
            return None, math.nan, saturates
        if all(saturates):
            raise ValueError(
                f"all flats are saturated in {self.name}: the darkest has a mean of {self.flats[0].mean:.1f} DN. "
                "Expected levels from dark to bright, several below 70 % of saturation: shorten the exposure, 10 times "
                "for one of them."
            )
        plateau = [
            level
            for index, level in enumerate(self.flats)
            if saturates[index] and (level.top > 0.99 or noise[index] < 0.05 * expected[index])
        ]
        if plateau:
            means = [level.mean for level in plateau]
            error = max(max(map(_mean_error, plateau)), float(np.std(means)))
            return float(np.mean(means)), error, saturates
        if max(level.top for level in self.flats) > 1e-3:
            return self.scale, 0.3, saturates
        # a well that fills only in part: where the noise is 4/5 of what it should be, the end is 1.3 sigma away
        sigma = math.sqrt(max(expected[-1], 0.0) + dark)
        return self.flats[-1].mean + sigma / 2, sigma / 2, saturates

    @property
    def limit(self) -> float:
        """Mean up to which flats may go: saturation, or full scale if none saturates [DN]."""
        return self.scale if self.saturation is None else self.saturation

    def _linear(self) -> list[bool]:
        """Which flats the gain is fitted to: up to 70 % of saturation, and with all of their pixels below it."""

        def fits(level: Level, most: float, sigmas: float) -> bool:
            reach = sigmas * math.sqrt(level.variance + level.spread)
            return bool(level.mean - self.black <= most * (self.limit - self.black) and level.mean + reach < self.limit)

        for most, sigmas in ((LINEAR, 4.0), (LINEAR, 3.0), (1.0, 4.0), (1.0, 3.0)):
            chosen = [
                fits(level, most, sigmas) and not full and level.bottom < _CUT
                for level, full in zip(self.flats, self.saturates, strict=True)
            ]
            if any(chosen):
                return chosen
        raise ValueError(
            f"no flat in {self.name} lies between black and saturation, {self.black:.0f} to {self.limit:.0f} DN with "
            "its noise: add levels at 10 to 70 % of saturation."
        )

    def _clamp(self) -> bool:
        """Whether the camera takes the dark signal off, so that darks of long exposure gain in variance alone.

        The dark current is then in the variance: d sigma_y^2 / dt = K^2 mu_I.
        """
        if math.isnan(self.rate) or self.cut:
            return False
        times = np.array([level.time for level in self.darks], float)
        noise = np.array([unrounded(level.variance) for level in self.darks])
        errors = np.array([self._variance_error(level, self.slope, self.height) for level in self.darks])
        solved, covariance = _weighted(times, noise, errors)
        rate, error = float(solved[1]), math.sqrt(covariance[1, 1])
        expected = self.slope * self.rate
        if rate - expected < 5 * math.hypot(error, self.slope * self.rate_error) or expected > 0.2 * rate:
            return False
        slope, height, line = self._line(rate)
        self.slope, self.height, self.covariance = slope, height, line
        self.variance_rate = (rate / slope, error / slope)
        return True

    def _line(self, extra: float = 0.0) -> tuple[float, float, np.ndarray]:
        """Gain [DN / electron], variance at the black level without rounding [DN^2], and their covariance.

        Args:      extra: variance that every second of exposure adds without a mean [DN^2 / s].
        """
        points = [level for level, linear in zip(self.flats, self.linear, strict=True) if linear]
        points = ([] if self.cut else self.darks) + points
        signal = np.array([level.mean - self.black for level in points])
        noise = np.array([unrounded(level.variance) - extra * (level.time or 0.0) for level in points])
        slope, height = max(float(noise[-1] / signal[-1]), 1e-12), max(min(noise), 1e-3)
        covariance = np.full((2, 2), math.nan)
        for _ in range(20):
            errors = np.array([self._variance_error(level, slope, height) for level in points])
            if len(points) == 1:
                slope, covariance = noise[0] / signal[0], np.diag([0.0, errors[0] / signal[0] ** 2])
                break
            solved, covariance = _weighted(signal, noise, errors)
            height, slope = float(solved[0]), float(solved[1])
            if slope <= 0:
                break
        if slope <= 0 or slope < 3 * math.sqrt(covariance[1, 1]):
            raise ValueError(
                f"the noise in {self.name} does not grow with the light: variances from {noise.min():.3g} to "
                f"{noise.max():.3g} DN^2. Are the two frames of each pair taken anew, and raw?"
            )
        return slope, height, covariance

    def _variance_error(self, level: Level, slope: float, height: float) -> float:
        """The variance of a level's temporal variance [DN^4], of noise as the line has it."""
        signal = max(level.mean - self.black, 0.0)
        temporal = max(height, 0.0) + slope * signal
        uneven = max(level.spread - temporal / level.frames, 0.0)
        rounded = temporal + 1 / 12
        hidden = _hidden(temporal, temporal + uneven)
        drawn = 2 * (rounded**2 + slope**2 * uneven) / (level.frames - 1) + slope**3 * signal / level.frames
        moved = slope**2 * rounded / (level.frames * level.pixels)
        return drawn / level.pixels + moved + hidden**2

    def result(self, darks: list[_Sums], flats: list[_Sums], *, notes: list[str]) -> ChannelCalibration:
        """All numbers of the channel."""
        gain_error = math.sqrt(self.covariance[1, 1])
        if self.cut:
            notes.append(
                f"{100 * max(d.bottom for d in self.darks):.0f} % of the dark pixels are 0: raise the black level by "
                f"{math.ceil(4 * math.sqrt(max(self.height, 0.0)) + 1)} DN and take all frames again"
            )
        split = _pooled([_split(s.mean, temporal=s.mean_variance.mean(), freedom=s.freedom) for s in darks])
        light, light_map = self._light(darks, flats)
        linearity, deviations = self._linearity()
        return ChannelCalibration(
            gain=_known("gain", self.slope, gain_error),
            read_noise=self._read_noise(),
            prnu=_known("prnu", *root(light.total, light.error)) if light else _unknown("prnu", "no flat is linear"),
            dsnu=self._dsnu(split),
            full_well=self._full_well(),
            dark_current=self._dark_current(),
            linearity_error=linearity,
            black_level=self.black,
            saturation=self.saturation,
            dark_variance=max(self.height, 0.0),
            darks=tuple(self.darks),
            flats=tuple(
                replace(f, linear=x, deviation=deviations.get(f)) for f, x in zip(self.flats, self.linear, strict=True)
            ),
            dark_pattern=split.spatial(_shown([s.mean for s in darks])),
            light_pattern=light.spatial(light_map) if light else None,
        )

    def _per_electron(self, value: float, error: float) -> tuple[float, float]:
        """A number in DN as electrons."""
        relative = math.sqrt(self.covariance[1, 1]) / self.slope
        return value / self.slope, math.hypot(error / self.slope, value / self.slope * relative)

    def _below_black(self) -> str:
        return "the darks are cut off at 0 DN: raise the black level, so that less than 0.5 % of the pixels are 0"

    def _tail(self, variance: float) -> float:
        """What the few dark pixels that are cut off at 0 may take from a variance: 1.7 times their share at 0.5 %."""
        return 2 * max(level.bottom for level in self.darks) * variance

    def _read_noise(self) -> Quantity:
        if self.cut:
            return _unknown("read_noise", self._below_black())
        # what rounding hides is alike in all darks, and what is cut off at 0 was the tail of the noise
        hidden = max(
            _hidden(self.height, self.height + max(d.spread - self.height / d.frames, 0.0)) for d in self.darks
        )
        error = math.sqrt(
            self.covariance[0, 0] + (self.slope * self.black_error) ** 2 + hidden**2 + self._tail(self.height) ** 2
        )
        if max(d.variance for d in self.darks) < 0.24 and error > 0.5 * max(self.height, 0.0):
            most = 0.4 / self.slope
            return _unknown(
                "read_noise", f"rounding hides it: it is below 0.4 DN, {most:.3g} electrons. Raise the gain"
            )
        found = _known("read_noise", *self._per_electron(*root(self.height, error)))
        if math.isnan(self.rate):
            return Quantity(
                found.value,
                found.standard_error,
                found.unit,
                "with the shot noise of the dark current, as the darks have one exposure time or none is known",
            )
        return found

    def _dsnu(self, split: _Split) -> Quantity:
        if self.cut:
            return _unknown("dsnu", self._below_black())
        temporal = max(self.height, 0.0)
        spread = max(split.total, 0.0)
        if all(d.variance == 0 for d in self.darks) and spread == 0:
            return _unknown(
                "dsnu",
                f"rounding hides it: all dark pixels are the same number, {self.darks[0].mean:g} DN. Raise the gain",
            )
        hidden = _hidden(temporal + spread, temporal + spread)
        variance = split.total - (1 / 12 - float(rounding_variance(temporal)))
        return _known(
            "dsnu", *self._per_electron(*root(variance, math.hypot(split.error, hidden, self._tail(temporal + spread))))
        )

    def _light(self, darks: list[_Sums], flats: list[_Sums]) -> tuple[_Split | None, np.ndarray]:
        """The pattern of the gain, relative to the even light."""
        splits, maps = [], []
        # darks of other times than the flats' differ in their mean, but not in their pattern
        times = [level.time for index, level in self.order if index in self.even]
        exposed = 0.0 if None in times or math.isnan(self.rate) else float(np.mean([time or 0.0 for time in times]))
        level_of_dark = self.black + (0.0 if math.isnan(self.rate) else self.rate) * exposed
        for dark, flat in zip(darks, flats, strict=bool(flats)) if flats else ():
            image = flat.mean - (dark.mean - dark.mean.mean()) - level_of_dark
            smooth, order = _smooth(image)
            smooth = np.maximum(smooth, 0.02 * smooth.mean())
            pattern = image / smooth - 1
            temporal = float(((flat.mean_variance + dark.mean_variance) / smooth**2).mean())
            split = _split(pattern, temporal=temporal, freedom=flat.freedom, fitted=order)
            if self.cut:  # then the darks show but a part of the offsets
                hidden = 3 * float(dark.mean.var()) / float(smooth.mean()) ** 2
                split = replace(split, error=math.hypot(split.error, hidden))
            splits.append(split)
            maps.append(pattern)
        return (_pooled(splits), _shown(maps)) if splits else (None, np.empty((0, 0)))

    def _full_well(self) -> Quantity:
        if self.saturation is None:
            share = (self.flats[-1].mean - self.black) / (self.scale - self.black)
            return _unknown(
                "full_well", f"no flat saturates: the brightest is {share:.2f} of full scale. Expose longer"
            )
        error = math.hypot(self.saturation_error, self.black_error)
        value, error = self._per_electron(self.saturation - self.black, error)
        reason = (
            f"the converter ends at {self.scale:g} DN before the well is full"
            if self.saturation > self.scale - 1
            else ""
        )
        return Quantity(float(value), _WIDER * float(error), UNITS["full_well"], reason)

    def _dark_current(self) -> Quantity:
        if math.isnan(self.rate):
            known = [d.time for d in self.darks if d.time is not None]
            what = f"all darks were exposed {known[0]:g} s" if known else "the exposure times of the darks are unknown"
            return _unknown("dark_current", f"{what}: expected two times or more, such as 0.1 s and 10 s")
        if self.cut:
            return _unknown("dark_current", self._below_black())
        if self.clamped:
            found = _known("dark_current", *self._per_electron(*self.variance_rate))
            return replace(found, reason="from the variance, as the camera takes the mean dark signal off")
        return _known("dark_current", *self._per_electron(self.rate, self.rate_error))

    def _linearity(self) -> tuple[Quantity, dict[Level, float]]:
        """Mean relative deviation from the line of least relative deviations, 5 to 95 % of saturation, and each one."""
        name = "linearity_error"
        if any(level.time is None for level in self.flats):
            return _unknown(name, "the exposure times of the flats are unknown: name them, at one light"), {}
        rate = 0.0 if math.isnan(self.rate) else self.rate
        top = self.limit - self.black if self.saturation is not None else (self.flats[-1].mean - self.black) / 0.95
        points: dict[Level, tuple[float, float, float]] = {}
        for level, full in zip(self.flats, self.saturates, strict=True):
            time = level.time or 0.0
            signal = level.mean - self.black - rate * time
            below = level.mean + 4 * math.sqrt(level.variance + level.spread) < self.limit and not full
            if 0.05 * top <= signal <= 0.9501 * top and below:
                points[level] = (time, signal, math.hypot(_mean_error(level), self.black_error) / signal)
        if len({time for time, _, _ in points.values()}) < 3:
            return _unknown(name, "fewer than 3 exposure times lie within 5 to 95 % of saturation: take more"), {}
        times, signals, errors = np.array(list(points.values())).T
        solved, _ = _weighted(times, signals, signals**2)
        deviations = signals / (solved[0] + solved[1] * times) - 1
        floor = math.sqrt(2 / math.pi) * float(errors.mean())  # of a straight sensor, by noise alone
        error = float(np.sqrt((errors**2).sum())) / len(errors) + floor / 2
        found = _known(name, float(np.abs(deviations).mean()), error)
        return found, dict(zip(points, map(float, deviations), strict=True))


def _weighted(x: np.ndarray, y: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height and slope of a line, and their covariance, widened where the points lie farther off than they should."""
    basis = np.stack([np.ones_like(x), x], axis=1)
    normal = basis.T @ (basis / variance[:, None])
    covariance = np.linalg.inv(normal)
    solved = covariance @ (basis.T @ (y / variance))
    freedom = len(x) - 2
    excess = float(((y - basis @ solved) ** 2 / variance).sum()) / freedom if freedom > 0 else 1.0
    return solved, covariance * max(1.0, excess)


def _mean(level: Level) -> tuple[float, float]:
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


def _mean_error(level: Level) -> float:
    """Standard error of a level's mean, by its noise and its rounding [DN]."""
    return _mean(level)[1]


def _shown(maps: Sequence[np.ndarray]) -> np.ndarray:
    """The first plane of a colour, for the plots."""
    return maps[0] - maps[0].mean()


def _known(name: str, value: float, error: float) -> Quantity:
    return Quantity(float(value), _WIDER * float(error), UNITS[name])


def _unknown(name: str, reason: str) -> Quantity:
    return Quantity(None, None, UNITS[name], reason)
