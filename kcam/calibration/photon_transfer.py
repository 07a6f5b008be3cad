"""The photon transfer method of EMVA Standard 1288, release 4.0 Linear: from pairs of frames to a sensor's numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from kcam.calibration.channel import Transfer
from kcam.calibration.fixed_pattern import Sums, added
from kcam.calibration.levels import Frames, check_bits, check_pair, check_phase
from kcam.calibration.results import MONO, Level, SensorCalibration
from kcam.sensor.mosaic import CHANNELS, pattern_tile


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
    dark_frames, flat_frames = Frames(darks, "darks", dark_times), Frames(flats, "flats", exposure_times)
    notes: list[str] = []
    survey = _Survey(pattern)
    for frames in (dark_frames, flat_frames):
        for index in range(len(frames.levels)):
            survey.look(frames, index)
    bits = check_bits(bits, survey.highest, survey.piled, survey.steps or 1, notes)
    lit = max(survey.light.values()) > 0.05 * (survey.highest - survey.black)
    if lit and max(survey.tile) <= 2:
        check_phase(survey.light, pattern, notes)
    scale = float(2**bits - 1)
    transfers = {
        name: Transfer(name, survey.levels(name, "darks", scale), survey.levels(name, "flats", scale), scale)
        for name in survey.cells
    }
    patterns: dict[str, list[Sums]] = {name: [] for name in transfers}
    for index in range(len(flat_frames.levels)):  # once more through those that show the pattern of the gain
        wanted = [name for name, transfer in transfers.items() if index in transfer.even]
        if wanted:
            stack = flat_frames.read(index, survey.shape)
            for name in wanted:
                patterns[name] = added(patterns[name], survey.sums(stack, name))
    channels = {name: t.result(survey.dark[name], patterns[name], notes=notes) for name, t in transfers.items()}
    black = float(np.mean([channel.black_level for channel in channels.values()]))
    return SensorCalibration(bits, black, pattern, channels, tuple(dict.fromkeys(notes)))


class _Survey:
    """What one look at all frames tells: the levels of each channel, and what the values are.

    highest, piled: the highest value, and the share of a level that stands there.  steps: what all values are multiples
    of.  light: sum of the means above black by cell of 2 x 2 pixels.  dark: by channel, each level of darks added up.
    """

    def __init__(self, pattern: str | None) -> None:
        names, tile = (CHANNELS, pattern_tile(pattern).numpy()) if pattern else ((MONO,), np.zeros((1, 1), int))
        self.tile = tile.shape
        self.cells = {names[c]: [(int(y), int(x)) for y, x in np.argwhere(tile == c)] for c in np.unique(tile)}
        self.shape: tuple[int, int] | None = None
        self.highest, self.piled, self.steps, self.black = 0.0, 0.0, 0, 0.0
        self.light = dict.fromkeys([(0, 0), (0, 1), (1, 0), (1, 1)], 0.0)
        self.dark: dict[str, list[list[Sums]]] = {name: [] for name in self.cells}
        self.seen: dict[tuple[str, str], list[tuple[float, Level]]] = {}

    def planes(self, stack: np.ndarray, name: str) -> list[np.ndarray]:
        """The pixels of one channel, a plane (n,H,W) for each of its places in the tile."""
        height, width = (size // step * step for size, step in zip(stack.shape[1:], self.tile, strict=True))
        return [stack[:, y : height : self.tile[0], x : width : self.tile[1]] for y, x in self.cells[name]]

    def sums(self, stack: np.ndarray, name: str) -> list[Sums]:
        """The planes of one channel, added up."""
        return [Sums.of(plane) for plane in self.planes(stack, name)]

    def look(self, frames: Frames, index: int) -> None:
        """Take the frames of one level into account."""
        stack = frames.read(index, self.shape)
        if self.shape is None:
            self.shape = (stack.shape[1], stack.shape[2])
            least = [8 * step for step in self.tile]
            if any(size < small for size, small in zip(self.shape, least, strict=True)):
                told = f"{self.shape[0]} x {self.shape[1]}"
                raise ValueError(f"frames of {told} pixels are too small: expected at least {least[0]} x {least[1]}.")
            self.black = float(stack.mean())
        check_pair(stack, self.black, [frames.name(index, number) for number in range(len(stack))])
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

    def levels(self, name: str, what: str, scale: float) -> list[Level]:
        """Darks or flats of a channel, of a converter whose highest number is `scale` [DN]."""
        return [level if top == scale else replace(level, top=0.0) for top, level in self.seen[name, what]]
