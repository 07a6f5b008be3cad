"""The photon transfer curve of one channel, and the numbers that it shows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from kcam.calibration.fixed_pattern import Split, Sums, added, pooled, split_variance, uneven_light
from kcam.calibration.results import UNITS, ChannelCalibration, Level, Quantity
from kcam.calibration.rounding import before_rounding, hidden_by_rounding, root, rounding_variance, unrounded

LINEAR = 0.7
"""Of saturation: below it the standard fits the gain."""
_WIDER = 1.05
"""Standard errors are told so much wider than they are computed, since they are estimates themselves."""
_CUT = 0.005
"""Of the dark pixels: where more are 0, the standard asks for a higher black level."""
_CUT_OFF = "the darks are cut off at 0 DN: raise the black level, so that less than 0.5 % of the pixels are 0"


class Transfer:
    """The photon transfer curve of one channel.

    Two frames of one exposure differ by temporal noise alone, so their difference gives its variance, and their mean
    keeps the fixed pattern. Over the levels of light the variance follows a line, in DN^2,

        sigma_y^2 = K^2 sigma_d^2 + q + K (mu_y - b),    q = 1/12 of the rounding, b the mean without light at no time

    whose slope is the gain K and whose height at b is the read noise. Dark electrons arrive at random as photoelectrons
    do and move along the same line, so darks of every exposure time lie on it.

    Standard errors count everything that frames of this size leave open: the temporal noise of every mean and variance,
    that the fixed pattern is seen on a finite number of pixels, and what the rounding can hide of a noise below one
    step.

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
        self.even = set(half or [inside[-1][0]])

    def _shortest(self, darks: list[list[Sums]]) -> list[Sums]:
        """The darks whose pattern is the offsets' alone: in others that of the dark current comes in."""
        least = min(self.darks, key=lambda level: level.mean if level.time is None else level.time)
        found: list[Sums] = []
        for level, sums in zip(self.given, darks, strict=True):
            alike = abs(level.mean - least.mean) < 4 * math.hypot(_mean_error(level), _mean_error(least))
            if level is least or (level.time == least.time and alike):
                found = added(found, sums)
        return found

    def _black(self) -> tuple[float, float, float, float]:
        """Mean without light at no time [DN], and the dark signal [DN / s], each with its error: NaN if unknown."""
        means, errors = np.array([before_rounding(level) for level in self.darks]).T
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
        self.slope, self.height, self.covariance = self._line(rate)
        self.variance_rate = (rate / self.slope, error / self.slope)
        return True

    def _line(self, extra: float = 0.0) -> tuple[float, float, np.ndarray]:
        """Gain [DN / electron], variance at the black level without rounding [DN^2], and their covariance.

        Args:      extra: variance that every second of exposure adds without a mean [DN^2 / s].
        """
        linear = [level for level, linear in zip(self.flats, self.linear, strict=True) if linear]
        points = linear if self.cut else self.darks + linear
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
        hidden = hidden_by_rounding(temporal, temporal + uneven)
        drawn = 2 * (rounded**2 + slope**2 * uneven) / (level.frames - 1) + slope**3 * signal / level.frames
        moved = slope**2 * rounded / (level.frames * level.pixels)
        return drawn / level.pixels + moved + hidden**2

    def result(self, darks: list[list[Sums]], flats: list[Sums], *, notes: list[str]) -> ChannelCalibration:
        """All numbers of the channel.

        Args:      darks: each level of darks added up, as they were given.  flats: those of `even`, added up.
                   notes: takes what there is to say of the frames.
        """
        gain_error = math.sqrt(self.covariance[1, 1])
        if self.cut:
            notes.append(
                f"{100 * max(d.bottom for d in self.darks):.0f} % of the dark pixels are 0: raise the black level by "
                f"{math.ceil(4 * math.sqrt(max(self.height, 0.0)) + 1)} DN and take all frames again"
            )
        short = self._shortest(darks)
        split = pooled([split_variance(s.mean, temporal=s.mean_variance.mean(), freedom=s.freedom) for s in short])
        light, light_map = self._light(short, flats)
        linearity, deviations = self._linearity()
        return ChannelCalibration(
            gain=_known("gain", self.slope, gain_error),
            read_noise=self._read_noise(),
            prnu=_known("prnu", *root(light.total, light.error)),
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
            dark_pattern=split.spatial(short[0].mean),
            light_pattern=light.spatial(light_map),
        )

    def _per_electron(self, value: float, error: float) -> tuple[float, float]:
        """A number in DN as electrons."""
        relative = math.sqrt(self.covariance[1, 1]) / self.slope
        return value / self.slope, math.hypot(error / self.slope, value / self.slope * relative)

    def _tail(self, variance: float) -> float:
        """What the few dark pixels that are cut off at 0 may take from a variance: 1.7 times their share at 0.5 %."""
        return 2 * max(level.bottom for level in self.darks) * variance

    def _read_noise(self) -> Quantity:
        if self.cut:
            return _unknown("read_noise", _CUT_OFF)
        # what rounding hides is alike in all darks, and what is cut off at 0 was the tail of the noise
        hidden = max(
            hidden_by_rounding(self.height, self.height + max(d.spread - self.height / d.frames, 0.0))
            for d in self.darks
        )
        error = math.sqrt(
            self.covariance[0, 0] + (self.slope * self.black_error) ** 2 + hidden**2 + self._tail(self.height) ** 2
        )
        if max(d.variance for d in self.darks) < 0.24 and error > 0.5 * max(self.height, 0.0):
            most = 0.4 / self.slope
            return _unknown(
                "read_noise", f"rounding hides it: it is below 0.4 DN, {most:.3g} electrons. Raise the gain"
            )
        with_dark = "with the shot noise of the dark current, as the darks have one exposure time or none is known"
        reason = with_dark if math.isnan(self.rate) else ""
        return _known("read_noise", *self._per_electron(*root(self.height, error)), reason)

    def _dsnu(self, split: Split) -> Quantity:
        if self.cut:
            return _unknown("dsnu", _CUT_OFF)
        temporal = max(self.height, 0.0)
        spread = max(split.total, 0.0)
        if all(d.variance == 0 for d in self.darks) and spread == 0:
            return _unknown(
                "dsnu",
                f"rounding hides it: all dark pixels are the same number, {self.darks[0].mean:g} DN. Raise the gain",
            )
        hidden = hidden_by_rounding(temporal + spread, temporal + spread)
        variance = split.total - (1 / 12 - float(rounding_variance(temporal)))
        return _known(
            "dsnu", *self._per_electron(*root(variance, math.hypot(split.error, hidden, self._tail(temporal + spread))))
        )

    def _light(self, darks: list[Sums], flats: list[Sums]) -> tuple[Split, np.ndarray]:
        """The pattern of the gain, relative to the even light, and its map."""
        splits, maps = [], []
        # darks of other times than the flats' differ in their mean, but not in their pattern
        times = [level.time for index, level in self.order if index in self.even]
        exposed = 0.0 if None in times else float(np.mean([time or 0.0 for time in times]))
        level_of_dark = self.black + np.nan_to_num(self.rate) * exposed
        for dark, flat in zip(darks, flats, strict=True):
            image = flat.mean - (dark.mean - dark.mean.mean()) - level_of_dark
            smooth, order = uneven_light(image)
            smooth = np.maximum(smooth, 0.02 * smooth.mean())
            pattern = image / smooth - 1
            temporal = float(((flat.mean_variance + dark.mean_variance) / smooth**2).mean())
            split = split_variance(pattern, temporal=temporal, freedom=flat.freedom, fitted=order)
            if self.cut:  # then the darks show but a part of the offsets
                hidden = 3 * float(dark.mean.var()) / float(smooth.mean()) ** 2
                split = replace(split, error=math.hypot(split.error, hidden))
            splits.append(split)
            maps.append(pattern)
        return pooled(splits), maps[0]

    def _full_well(self) -> Quantity:
        if self.saturation is None:
            share = (self.flats[-1].mean - self.black) / (self.scale - self.black)
            return _unknown(
                "full_well", f"no flat saturates: the brightest is {share:.2f} of full scale. Expose longer"
            )
        error = math.hypot(self.saturation_error, self.black_error)
        ends = f"the converter ends at {self.scale:g} DN before the well is full"
        reason = ends if self.saturation > self.scale - 1 else ""
        return _known("full_well", *self._per_electron(self.saturation - self.black, error), reason)

    def _dark_current(self) -> Quantity:
        if math.isnan(self.rate):
            known = [d.time for d in self.darks if d.time is not None]
            what = f"all darks were exposed {known[0]:g} s" if known else "the exposure times of the darks are unknown"
            return _unknown("dark_current", f"{what}: expected two times or more, such as 0.1 s and 10 s")
        if self.cut:
            return _unknown("dark_current", _CUT_OFF)
        if self.clamped:
            reason = "from the variance, as the camera takes the mean dark signal off"
            return _known("dark_current", *self._per_electron(*self.variance_rate), reason)
        return _known("dark_current", *self._per_electron(self.rate, self.rate_error))

    def _linearity(self) -> tuple[Quantity, dict[Level, float]]:
        """Mean relative deviation from the line of least relative deviations, 5 to 95 % of saturation, and each one."""
        name = "linearity_error"
        if any(level.time is None for level in self.flats):
            return _unknown(name, "the exposure times of the flats are unknown: name them, at one light"), {}
        rate = np.nan_to_num(self.rate)
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


def _mean_error(level: Level) -> float:
    """Standard error of a level's mean, by its noise and its rounding [DN]."""
    return before_rounding(level)[1]


def _known(name: str, value: float, error: float, reason: str = "") -> Quantity:
    return Quantity(float(value), _WIDER * float(error), UNITS[name], reason)


def _unknown(name: str, reason: str) -> Quantity:
    return Quantity(None, None, UNITS[name], reason)
