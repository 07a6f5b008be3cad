"""A sensor's constants from pairs of frames: the photon transfer method of EMVA 1288.

The difference of two frames of equal exposure holds temporal noise alone, their covariance over the pixels what is
fixed. In DN, with the overall system gain K [DN / electron], the mean mu of a frame and its temporal variance are

    mu = mu_dark + K N,     sigma^2 = K^2 sigma_d^2 + 1/12 + K (mu - mu_dark)                (release 4.0, eq. 9, 13)

so the slope of the variance over the mean is K, and what is left in the dark is the noise of the read-out. The pattern
that both frames share has the variance K^2 DSNU^2 + PRNU^2 (mu - mu_dark)^2.

Lines are fitted with weights from the model's own variances, not the measured ones, which would pull them down.
Standard errors are of the frames' own noise, and of the fixed pattern being a sample of one sensor's pixels.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from torch import Tensor

from kcam import files
from kcam.plain import to_json
from kcam.sensor import PATTERNS
from kcam.sensor.calibrated import MONO, QUANTITIES
from kcam.sensor.mosaic import pattern_tile

LINEAR_RANGE = 0.7
"""Share of the saturation up to which the photon transfer line is fitted: EMVA 1288, section 6.6."""
LINEARITY_RANGE = (0.05, 0.95)
"""Shares of the saturation between which linearity is measured: EMVA 1288, section 6.7."""
LEAST_VARIANCE = 0.24
"""Of temporal noise in the dark [DN^2], below which it drowns in the steps of the ADC: EMVA 1288, section 6.6."""
QUANTISATION = 1 / 12
CLIPPED = 1e-3
"""Share of a dark frame's pixels at 0 that its read noise can lose without harm."""
EQUAL_EXPOSURE = 0.03
"""How far the means of a pair may differ, relative to their signal."""
LEAST_PIXELS = 256
"""Of a channel: below, a variance is not known to a tenth."""


@dataclass(frozen=True)
class Measured:
    """A quantity with its standard error, or None with the reason why the frames do not show it.

    Example:
    >>> from kcam.calibration import Measured
    >>> print(Measured(0.52, 0.004, "DN / electron"), "|", Measured(None, None, "electrons", "no flat saturates"))
    0.520 +- 0.004 DN / electron | none: no flat saturates
    """

    value: float | None
    standard_error: float | None
    unit: str
    reason: str = ""

    def __str__(self) -> str:
        if self.value is None or self.standard_error is None:
            return f"none: {self.reason}"
        size = self.standard_error or abs(self.value) or 1.0
        digits = max(0, 1 - math.floor(math.log10(size)) - (size >= 2 * 10 ** math.floor(math.log10(size))))
        return f"{self.value:.{digits}f} +- {self.standard_error:.{digits}f} {self.unit}"


@dataclass(frozen=True)
class Curve:
    """What a channel's frames show, for plots: level by level, (N,) in the order of rising signal.

    signal: mean less the dark's [DN].  variance: temporal [DN^2].  fixed: variance of what both frames share [DN^2].
    exposure_times [s], empty where unknown.  dark_variance [DN^2].  fitted: whether a level is on the line's range.
    """

    signal: tuple[float, ...]
    variance: tuple[float, ...]
    fixed: tuple[float, ...]
    fitted: tuple[bool, ...]
    exposure_times: tuple[float, ...]
    dark_variance: float


@dataclass(frozen=True)
class SensorCalibration:
    """What `photon_transfer` found.

    channels: name of the channel -> name of the quantity -> `Measured`; a monochrome sensor has the channel "mono".
    bits, black_level (mean of the dark frames, at no exposure) [DN], pattern: of the frames.
    curves: by channel, for plots. notes: what else the frames show.
    """

    channels: Mapping[str, Mapping[str, Measured]]
    bits: int
    black_level: float
    pattern: str | None
    curves: Mapping[str, Curve] = field(default_factory=dict, repr=False)
    notes: tuple[str, ...] = ()

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write what was found as JSON: see `sensor.from_calibration`, which reads it.

        Raises:    ValueError where no file of that name can be.
        """
        files.check_place(path)
        channels = {
            name: {
                quantity: {key: value for key, value in asdict(found).items() if key != "reason" or found.reason}
                for quantity, found in quantities.items()
            }
            for name, quantities in self.channels.items()
        }
        document: dict[str, Any] = {"format": 1, "standard": "EMVA 1288 release 4.0, linear", "bits": self.bits}
        document |= {"black_level": self.black_level, "pattern": self.pattern, "channels": channels}
        files.replace(path, to_json(document | {"notes": list(self.notes)}))

    def __str__(self) -> str:
        lines = [f"{self.bits} bits, black level {self.black_level:.2f} DN, {self.pattern or 'no mosaic'}"]
        for name, quantities in self.channels.items():
            lines += [f"{name:>6}  {quantity:16} {found}" for quantity, found in quantities.items()]
        return "\n".join([*lines, *self.notes])


def photon_transfer(
    flats: Sequence[Any] | Tensor | np.ndarray,
    darks: Sequence[Any] | Tensor | np.ndarray,
    *,
    exposure_times: Sequence[float] | None = None,
    dark_times: Sequence[float] | None = None,
    pattern: str | None = None,
    bits: int | None = None,
) -> SensorCalibration:
    """The gain, noise, non-uniformity and well of a sensor from pairs of raw frames, by EMVA 1288.

    Args:      flats: pairs of frames of an even light, from dim to saturated: (N, 2, H, W) [DN], or N pairs (a, b) of
                   (H, W). Several levels; those above saturation tell the full well.
               darks: pairs without light, likewise: at least one.
               exposure_times, dark_times: of each pair [s]; None where they are not known, and what needs them.
               pattern: a name in `sensor.PATTERNS`, for each colour by itself; None for a monochrome sensor.
               bits: of the ADC; None for the fewest even number, from 8 on, that holds the frames.
    Returns:   for each channel `gain` [DN / electron], `read_noise` [electrons] (temporal, without quantisation),
               `prnu` [fraction], `dsnu` [electrons] (trends over the frame removed), `full_well` [electrons] (what of
               well and ADC ends first), `dark_current` [electrons / s], `linearity_error` [fraction].
    Raises:    ValueError for no darks, no pairs, fewer than two levels, frames of unequal size, NaN, values outside of
               0..2^bits - 1, 8-bit frames, values that are all multiples of 4, 16 or 64, pairs whose exposures differ,
               darks cut off at 0, flats that are all saturated or all dark, exposure times that are not > 0, a pattern
               that is out of step with the frames.
    Valid when the response is linear, and the dark noise is above 0.49 DN; a channel has 256 pixels or more.
    Source:    EMVA Standard 1288 release 4.0 (2021), linear: sections 6.6 (gain, noise, saturation), 6.7 (linearity),
               7.1 (dark current), 8 (non-uniformity).

    Example:
    >>> import numpy as np
    >>> draw = np.random.default_rng(0)
    >>> def frame(electrons):  # 0.5 DN per electron, 4 electrons of read noise, 64 DN of black, 12 bits
    ...     counts = draw.poisson(electrons, (64, 64)) + draw.normal(0, 4.0, (64, 64))
    ...     return np.rint(64 + 0.5 * counts).clip(0, 4095)
    >>> flats = [(frame(n), frame(n)) for n in (500, 1500, 3000, 5000, 1e4, 2e4)]
    >>> found = kcam.calibration.photon_transfer(flats, [(frame(0), frame(0))]).channels["mono"]
    >>> abs(found["gain"].value - 0.5) < 2 * found["gain"].standard_error, round(found["read_noise"].value)
    (True, 4)
    """
    bright, dark = _as_pairs(flats, name="flats"), _as_pairs(darks, name="darks")
    times = _as_times(exposure_times, len(bright), name="exposure_times", zero=False)
    dark_seconds = _as_times(dark_times, len(dark), name="dark_times", zero=True)
    _check_sizes(bright, dark)
    bits = _checked_bits(bright, dark, bits)
    tiles = _tiles(pattern, bright[0][0].shape)
    if pattern is not None:
        _check_phase(bright, pattern)
    for index, pair in enumerate(dark):
        cut = float(np.mean([(frame == 0).mean() for frame in pair]))
        if cut > CLIPPED:
            raise ValueError(
                f"{cut:.1%} of the pixels of dark pair {index + 1} are 0 DN: the noise is cut off below. Raise the "
                "camera's black level until no dark pixel is 0, and take the frames again."
            )
    channels, curves, notes = {}, {}, []
    blacks = []
    for name, mask in tiles.items():
        levels, blank = [_Level.of(pair, mask) for pair in bright], [_Level.of(pair, mask) for pair in dark]
        for kind, found in (("flat", levels), ("dark", blank)):
            _check_equal(found, blank, kind=kind)
        channel = _Channel(levels, blank, times, dark_seconds, bits)
        channels[name], curves[name] = channel.quantities(), channel.curve()
        notes += [f"{name}: {note}" for note in channel.notes]
        blacks.append(channel.black)
    return SensorCalibration(channels, bits, float(np.mean(blacks)), pattern, curves, tuple(notes))


# ---- frames ----------------------------------------------------------------------------------------------------------


def _as_pairs(given: Any, *, name: str) -> list[tuple[np.ndarray, np.ndarray]]:
    if isinstance(given, Tensor):
        given = given.detach().cpu().numpy()
    pairs = []
    for index, pair in enumerate(given):
        frames = [
            frame.detach().cpu().numpy() if isinstance(frame, Tensor) else np.asarray(frame)
            for frame in (pair if isinstance(pair, (list, tuple)) else list(pair))
        ]
        if len(frames) != 2 or any(frame.ndim != 2 for frame in frames):
            shapes = ", ".join(str(frame.shape) for frame in frames[:3])
            raise ValueError(
                f"{name}[{index}] holds {len(frames)} frames of shapes {shapes}: expected a pair (a, b) of (H, W), "
                "both of one exposure. One frame shows no temporal noise: take each level twice."
            )
        for frame in frames:
            if frame.dtype == np.uint8:
                raise ValueError(f"{name}[{index}] is of 8 bits, a developed picture. Expected raw frames of 10 to 16.")
            if not np.isfinite(frame).all():
                raise ValueError(f"{name}[{index}] has {int((~np.isfinite(frame)).sum())} values that are NaN.")
        pairs.append((frames[0].astype(np.float64), frames[1].astype(np.float64)))
    if not pairs:
        fix = "with the lens capped, at the flats' exposure times" if name == "darks" else "of an even light"
        raise ValueError(f"there are no {name}: expected at least one pair of frames {fix}.")
    if name == "flats" and len(pairs) < 2:
        raise ValueError("there is one pair of flats: a line needs two levels of light or more, such as ten.")
    return pairs


def _as_times(given: Sequence[float] | None, count: int, *, name: str, zero: bool) -> np.ndarray | None:
    if given is None:
        return None
    times = np.asarray(given, dtype=np.float64).reshape(-1)
    if len(times) != count:
        raise ValueError(f"{name} has {len(times)} values for {count} pairs: expected one for each pair.")
    wrong = ~(np.isfinite(times) & ((times >= 0) if zero else (times > 0)))
    if wrong.any():
        raise ValueError(f"{name} must be seconds {'>=' if zero else '>'} 0, such as 0.01; got {times[wrong][0]:g}.")
    return times


def _check_sizes(bright: list, dark: list) -> None:
    shape = bright[0][0].shape
    for name, pairs in (("flats", bright), ("darks", dark)):
        for index, pair in enumerate(pairs):
            for frame in pair:
                if frame.shape != shape:
                    raise ValueError(
                        f"{name}[{index}] is {frame.shape[0]} x {frame.shape[1]} pixels, and flats[0] {shape[0]} x "
                        f"{shape[1]}: all frames must be of one sensor, read out alike."
                    )


def _checked_bits(bright: list, dark: list, bits: int | None) -> int:
    frames = [frame for pair in (*bright, *dark) for frame in pair]
    high, low = max(float(frame.max()) for frame in frames), min(float(frame.min()) for frame in frames)
    if bits is None:
        bits = next((count for count in range(8, 26, 2) if high <= 2**count - 1), 26)
    if isinstance(bits, bool) or not isinstance(bits, int) or not 8 <= bits <= 24:
        raise ValueError(f"bits must be 8 to 24, got {bits!r} (frames up to {high:g} DN).")
    if low < 0 or high > 2**bits - 1:
        raise ValueError(
            f"frames have values from {low:g} to {high:g}, outside of 0..{2**bits - 1} DN, {bits} bits. Give the ADC's "
            "own bits, and frames as they were read out, the black level not subtracted."
        )
    for step in (64, 16, 4):
        if all((frame % step == 0).all() for frame in frames):
            raise ValueError(
                f"all values are multiples of {step}: numbers of {16 - int(math.log2(step))} bits shifted up. Divide "
                f"the frames by {step}."
            )
    return bits


def _tiles(pattern: str | None, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Name of each channel -> where its pixels are, (H, W)."""
    if pattern is None:
        return {MONO: np.ones(shape, dtype=bool)}
    if pattern not in PATTERNS:
        raise ValueError(
            f"unknown pattern {pattern!r}. There are: {', '.join(PATTERNS)}; None for a monochrome sensor."
        )
    tile = pattern_tile(pattern).numpy()
    rows, columns = (-(-size // side) for size, side in zip(shape, tile.shape, strict=True))
    index = np.tile(tile, (rows, columns))[: shape[0], : shape[1]]
    tiles = {"RGBW"[channel]: index == channel for channel in range(int(tile.max()) + 1)}
    few = [name for name, mask in tiles.items() if mask.sum() < LEAST_PIXELS]
    if few:
        raise ValueError(
            f"channel {few[0]} has {int(tiles[few[0]].sum())} pixels: expected {LEAST_PIXELS} or more, such as frames "
            "of 64 x 64."
        )
    return tiles


def _check_phase(bright: list, pattern: str) -> None:
    """ValueError where two cells of one colour see another light, and those of another pattern of 2 x 2 do not."""
    tile = pattern_tile(pattern).numpy()
    if tile.shape != (2, 2):
        return
    means = np.stack(
        [[sum(frame[r::2, c::2].mean() for frame in pair) / 2 for r in range(2) for c in range(2)] for pair in bright]
    ).reshape(-1, 2, 2)
    least = means.min(axis=(1, 2), keepdims=True).min(axis=0)
    signal = (means - least).sum(axis=0)  # of all levels together
    main, other = abs(signal[0, 0] - signal[1, 1]), abs(signal[0, 1] - signal[1, 0])
    greens_on_main = tile[0, 0] == 1
    own, across = (main, other) if greens_on_main else (other, main)
    if own > 0.05 * signal.max() and across < 0.3 * own:
        meant = [name for name in ("RGGB", "BGGR", "GRBG", "GBRG") if (name[0] == "G") != greens_on_main]
        raise ValueError(
            f"the two greens of {pattern} differ by {own / signal.max():.0%} of the light, and the other two cells by "
            f"{across / signal.max():.0%}: the pattern is off by one pixel. Try {' or '.join(meant)}."
        )


# ---- a level, and a channel ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Level:
    """A pair of frames in one channel: means, temporal variance, and covariance of what is left of a trend."""

    means: tuple[float, float]
    variance: float
    fixed: float
    top: float  # share of pixels at the highest value that occurs
    highest: float
    count: int

    @classmethod
    def of(cls, pair: tuple[np.ndarray, np.ndarray], mask: np.ndarray) -> _Level:
        a, b = (frame[mask] for frame in pair)
        means = float(a.mean()), float(b.mean())
        variance = float(np.square(a - b).mean() - (means[0] - means[1]) ** 2) / 2
        if len(a) < LEAST_PIXELS:
            raise ValueError(
                f"frames have {len(a)} pixels of a channel: expected {LEAST_PIXELS} or more, such as 64 x 64."
            )
        y, x = (place / max(1, size - 1) - 0.5 for place, size in zip(np.nonzero(mask), mask.shape, strict=True))
        trend = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
        basis, _ = np.linalg.qr(trend)
        left = [values - basis @ (basis.T @ values) for values in (a, b)]
        highest = float(max(a.max(), b.max()))
        top = float(np.mean([(a == highest).mean(), (b == highest).mean()]))
        return cls(means, variance, float(left[0] @ left[1]) / (len(a) - trend.shape[1]), top, highest, len(a))

    @property
    def mean(self) -> float:
        return sum(self.means) / 2


def _check_equal(levels: Sequence[_Level], blank: Sequence[_Level], *, kind: str) -> None:
    black = min(level.mean for level in blank)
    for index, level in enumerate(levels):
        apart = abs(level.means[0] - level.means[1])
        noise = 6 * math.sqrt(2 * max(level.variance, 0) / level.count)
        if apart > EQUAL_EXPOSURE * abs(level.mean - black) + noise + 1.0:
            raise ValueError(
                f"the frames of {kind} pair {index + 1} have means of {level.means[0]:.1f} and {level.means[1]:.1f} "
                "DN: a pair is of one exposure. Are the frames in order, two of each?"
            )


class _Channel:
    """All of one colour."""

    def __init__(
        self,
        levels: Sequence[_Level],
        blank: Sequence[_Level],
        times: np.ndarray | None,
        dark_times: np.ndarray | None,
        bits: int,
    ) -> None:
        self.top, self.notes, self.count = 2**bits - 1, list[str](), blank[0].count
        seconds = np.zeros(len(blank)) if dark_times is None else dark_times
        order = np.argsort(seconds, kind="stable")
        variances = np.array([blank[index].variance for index in order])
        full = variances < 0.7 * np.maximum.accumulate(variances)  # so long that the dark current fills the well
        kept = order[: int(full.argmax()) if full.any() else len(order)]
        self.blank, self.dark_times = [blank[index] for index in kept], seconds[kept]
        self.knows_dark_times = dark_times is not None
        self._fit_dark()
        dark = 0.0 if times is None else self.rise * times
        signal = np.array([level.mean for level in levels]) - self.black - dark
        order = np.argsort(signal, kind="stable")
        self.levels = [levels[index] for index in order]
        self.total = np.array([level.mean - self.black for level in self.levels])
        self.signal, self.times = signal[order], None if times is None else times[order]
        self.variance = np.array([level.variance for level in self.levels])
        self.fixed = np.array([level.fixed for level in self.levels])
        self._find_saturation()
        self._fit_gain()

    def _fit_dark(self) -> None:
        """Mean of the dark frames over exposure time: b + rise t [DN], with the rise's standard error."""
        means = np.array([level.mean for level in self.blank])
        errors = np.sqrt(np.array([max(level.variance, QUANTISATION) for level in self.blank]) / (2 * self.count))
        if len(np.unique(self.dark_times)) < 2:
            self.black, self.rise, self.rise_error = float(np.average(means, weights=errors**-2)), 0.0, math.inf
            return
        design = np.stack([np.ones_like(self.dark_times), self.dark_times], axis=1)
        (self.black, self.rise), covariance, _ = weighted_line(design, means, errors)
        self.rise_error = math.sqrt(covariance[1, 1])

    @property
    def dark_variance(self) -> float:
        """Temporal, at the shortest exposure [DN^2]."""
        first = self.dark_times == self.dark_times.min()
        return float(np.mean([level.variance for level, use in zip(self.blank, first, strict=True) if use]))

    def _find_saturation(self) -> None:
        """Which levels are below saturation, and where that is [DN above black]; None where no flat reaches it."""
        full = np.array([level.highest >= self.top and level.top > 1e-4 for level in self.levels])
        peak = int(self.variance.argmax())
        falls = np.zeros(len(self.levels), dtype=bool)
        if peak + 1 < len(self.levels):
            falls[peak + 1 :] = self.variance[peak + 1 :] < 0.9 * self.variance[peak]
        clipped = full | falls
        self.below = ~clipped
        if clipped.any():  # what comes after the first of them is beyond it too
            self.below[int(clipped.argmax()) :] = False
        if not self.below.any():
            raise ValueError(
                f"every flat is saturated: the dimmest has a mean of {self.levels[0].mean:.0f} of {self.top} DN. Take "
                "flats from a tenth of saturation on."
            )
        self.saturation, self.saturation_error, self.adc_ends = None, 0.0, False
        if clipped.any():
            last, dim = self.levels[-1], float(self.total[self.below].max())
            self.adc_ends = last.highest >= self.top and last.top > 0.05  # else it is noise about the well's end
            plateau = last.variance < 0.05 * self.variance[peak] + self.dark_variance
            if self.adc_ends:
                self.saturation = self.top - self.black
            elif plateau:
                self.saturation = float(self.total[-1])
                self.saturation_error = math.sqrt(max(last.variance + last.fixed, 0) / (2 * self.count))
            else:
                self.saturation = max(float(self.total[peak]), dim)
                self.saturation_error = max(float(self.total[-1]) - self.saturation, self.saturation - dim, 0.0) / 2

    def _fit_gain(self) -> None:
        """K from the slope of the temporal variance over the signal, up to 70 % of saturation."""
        limit = LINEAR_RANGE * (self.saturation if self.saturation is not None else self.top - self.black)
        quiet = self.dark_variance < LEAST_VARIANCE
        self.fitted = self.below & (self.signal <= limit) & (self.variance >= LEAST_VARIANCE)
        if self.saturation is None:
            self.fitted = self.below & (self.variance >= LEAST_VARIANCE)
        # electrons of the dark current are counted as well, and are as noisy as those of light
        x, y = self.total[self.fitted], self.variance[self.fitted] - QUANTISATION
        if not quiet:
            x = np.append(x, [level.mean - self.black for level in self.blank])
            y = np.append(y, [level.variance - QUANTISATION for level in self.blank])
        if (
            self.fitted.sum() < 1
            or len(x) < 2
            or x.max() - x.min() < 10 * math.sqrt(max(self.dark_variance, 1) / self.count)
        ):
            raise ValueError(
                "the flats have no level of light between the dark and 70 % of saturation "
                f"({self.signal.min():.1f} to {self.signal.max():.1f} DN above black). Take some there."
            )
        design, gain, offset = np.stack([np.ones_like(x), x], axis=1), 0.0, 0.0
        errors = np.sqrt(2 / self.count) * np.maximum(y, 1e-3)
        for _ in range(4):
            (offset, gain), covariance, chi = weighted_line(design, y, errors)
            gain = max(gain, 1e-9)
            model = np.maximum(offset + gain * x, QUANTISATION) + QUANTISATION
            # of a variance from pairs: of normal noise, and of the Poisson's own kurtosis; and of the signal's mean
            errors = np.sqrt(2 * model**2 / self.count + gain**3 * np.maximum(x, 0) / (2 * self.count))
            errors = np.hypot(errors, gain * np.sqrt(model / (2 * self.count)))
        self.offset, self.gain, self.covariance = offset, gain, covariance
        self.gain_error = math.sqrt(covariance[1, 1])
        if len(x) > 4 and chi > 4:  # the light flickers, or the response bends
            self.notes.append(f"variances scatter about the line by {math.sqrt(chi):.1f} times their own noise")

    # ---- what is reported ----

    def quantities(self) -> dict[str, Measured]:
        found = {
            "gain": Measured(self.gain, self.gain_error, QUANTITIES["gain"]),
            "read_noise": self._read_noise(),
            "prnu": self._prnu(),
            "dsnu": self._dsnu(),
            "full_well": self._full_well(),
            "dark_current": self._dark_current(),
            "linearity_error": self._linearity(),
        }
        return found

    @property
    def _hidden(self) -> str:
        low = self.dark_variance < LEAST_VARIANCE
        return (
            f"the noise in the dark is {math.sqrt(max(self.dark_variance, 0)):.2f} DN: below 0.49 DN the steps of the "
            "ADC hide it. Raise the gain"
            if low
            else ""
        )

    def _read_noise(self) -> Measured:
        if self._hidden:
            return Measured(None, None, QUANTITIES["read_noise"], self._hidden)
        slope = np.array([1 / self.gain**2, -2 * self.offset / self.gain**3])  # of offset / gain^2
        value, spread = root(self.offset / self.gain**2, math.sqrt(slope @ self.covariance @ slope))
        return Measured(value, spread, QUANTITIES["read_noise"])

    def _dark_pattern(self) -> tuple[float, float]:
        """Covariance of dark pairs [DN^2], and its standard error without that of one sensor's being a sample."""
        fixed = np.array([level.fixed for level in self.blank])
        total = np.array([level.variance + max(level.fixed, 0) for level in self.blank])
        errors = np.sqrt((total**2 + fixed**2) / self.count)
        return float(np.average(fixed, weights=errors**-2)), float((errors**-2).sum() ** -0.5)

    def _dsnu(self) -> Measured:
        if self._hidden:
            return Measured(None, None, QUANTITIES["dsnu"], self._hidden)
        squares, error = self._dark_pattern()
        value, spread = root(squares, math.hypot(error, max(squares, 0) * math.sqrt(2 / self.count)))
        spread = math.hypot(spread, value * self.gain_error / self.gain)
        return Measured(value / self.gain, spread / self.gain, QUANTITIES["dsnu"])

    def _prnu(self) -> Measured:
        use = self.fitted & (self.signal > 0.02 * self.signal[self.fitted].max())
        dark, dark_error = self._dark_pattern()
        x, own = self.signal[use], self.fixed[use] - dark
        total = self.variance[use] + np.maximum(self.fixed[use], 0)
        errors = np.sqrt((total**2 + self.fixed[use] ** 2) / self.count) / x**2
        # the offsets' covariance with the gains, that of a sample, is not 0: it adds to what a level shows
        mixed = 2 * math.sqrt(max(dark, 0) * max(float((own / x**2).mean()), 0) / self.count) / x
        weights = (errors**2 + mixed**2 + (dark_error / x**2) ** 2) ** -1
        squares = float(np.average(own / x**2, weights=weights))
        error = math.sqrt(
            1 / float((errors**-2).sum()) + float(np.average(mixed + dark_error / x**2, weights=weights)) ** 2
        )
        value, spread = root(squares, math.hypot(error, max(squares, 0) * math.sqrt(2 / self.count)))
        return Measured(value, spread, QUANTITIES["prnu"])

    def _full_well(self) -> Measured:
        unit = QUANTITIES["full_well"]
        if self.saturation is None:
            bright = float(self.signal[-1] / (self.top - self.black))
            return Measured(None, None, unit, f"no flat saturates: the brightest is at {bright:.0%} of full scale")
        if self.adc_ends:
            self.notes.append(f"the ADC ends at {self.top} DN before the well is full, or with it")
        value = self.saturation / self.gain
        return Measured(value, math.hypot(value * self.gain_error / self.gain, self.saturation_error / self.gain), unit)

    def _dark_current(self) -> Measured:
        unit = QUANTITIES["dark_current"]
        if not self.knows_dark_times:
            return Measured(None, None, unit, "the exposure times of the darks are not known")
        if not math.isfinite(self.rise_error):
            return Measured(
                None, None, unit, "darks of one exposure time alone: take others, such as ten times as long"
            )
        if self.rise < -3 * self.rise_error:
            return Measured(None, None, unit, "darks get darker with exposure time: the camera takes the current away")
        value = self.rise / self.gain
        return Measured(value, math.hypot(self.rise_error, self.rise * self.gain_error / self.gain) / self.gain, unit)

    def _linearity(self) -> Measured:
        unit = QUANTITIES["linearity_error"]
        if self.times is None:
            return Measured(None, None, unit, "the exposure times of the flats are not known")
        most = self.saturation if self.saturation is not None else float(self.signal.max())
        use = self.below & (self.signal >= LINEARITY_RANGE[0] * most) & (self.signal <= LINEARITY_RANGE[1] * most)
        if len(np.unique(self.times[use])) < 3:
            return Measured(None, None, unit, "fewer than three exposure times between 5 and 95 % of saturation")
        x, y = self.times[use], self.signal[use]
        noise = np.sqrt(np.maximum(self.variance[use], QUANTISATION) / (2 * self.count)) / y
        design = np.stack([np.ones_like(x), x], axis=1)
        (first, slope), _, _ = weighted_line(design, y, y)  # least relative deviations
        off = y / (first + slope * x) - 1
        return Measured(float(np.abs(off).mean()), float(np.sqrt(np.square(noise).mean())), unit)

    def curve(self) -> Curve:
        return Curve(
            tuple(self.signal.tolist()),
            tuple(self.variance.tolist()),
            tuple(self.fixed.tolist()),
            tuple(map(bool, self.fitted)),
            () if self.times is None else tuple(self.times.tolist()),
            self.dark_variance,
        )


def weighted_line(design: np.ndarray, values: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Least squares with known errors: parameters, their covariance, and chi^2 per degree of freedom.

    The covariance grows with what the values scatter more than their errors say: Birge's ratio, if it is above 1.

    Example:
    >>> import numpy as np
    >>> from kcam.calibration.photon_transfer import weighted_line
    >>> design = np.stack([np.ones(4), np.arange(4.0)], axis=1)
    >>> weighted_line(design, np.array([1.0, 3.0, 5.0, 7.0]), np.full(4, 0.1))[0].round(6).tolist()
    [1.0, 2.0]
    """
    scaled = design / errors[:, None]
    covariance = np.linalg.inv(scaled.T @ scaled)
    parameters = covariance @ (scaled.T @ (values / errors))
    free = len(values) - design.shape[1]
    chi = float(np.square((values - design @ parameters) / errors).sum() / free) if free else 1.0
    return parameters, covariance * max(1.0, chi), chi


def root(squares: float, error: float) -> tuple[float, float]:
    """The root of a variance, and half of the interval that its two standard errors become; 0 where it is negative.

    Example:
    >>> from kcam.calibration.photon_transfer import root
    >>> root(4.0, 0.04), root(-0.1, 0.2)[0]  # near 0 a root is uncertain by the root of the error
    ((2.0, 0.01000...), 0.0)
    """
    value = math.sqrt(max(squares, 0.0))
    above, below = math.sqrt(max(squares, 0.0) + 2 * error), math.sqrt(max(squares - 2 * error, 0.0))
    return value, max(above - value, value - below) / 2
