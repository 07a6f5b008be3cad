"""Frames in, read one level of light at a time and checked against each other."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from kcam.calibration.frames import as_frame

USUAL_BITS = (10, 12, 14, 16)
_ALIKE = 0.02
"""Relative: the signals of two frames of a pair differ by less."""
_GRAY = 0.01
"""Relative: colour filters whose four cells see light so alike are none."""


class Frames:
    """Levels of frames, read one level at a time, each checked against all that were read before."""

    def __init__(self, given: Any, what: str, times: Sequence[float] | None) -> None:
        self.what = what
        self.levels = _levels(given, what)
        self.times: list[float | None] = [None] * len(self.levels)
        if times is not None:
            seconds = [float(time) for time in times]
            if len(seconds) == sum(map(len, self.levels)):  # one of each frame
                each = iter(seconds)
                by_level = [[next(each) for _ in level] for level in self.levels]
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
            self.times[:] = seconds

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


def check_pair(stack: np.ndarray, dark: float, names: Sequence[str]) -> None:
    """ValueError unless the frames of a level have the same light."""
    means = stack.mean((1, 2))
    error = 6 * math.sqrt(2 * (stack - means[:, None, None]).var() / stack[0].size)
    for name, mean in zip(names[1:], means[1:], strict=True):
        if abs(mean - means[0]) > max(_ALIKE * abs(means[0] - dark), error, 0.5):
            raise ValueError(
                f"{names[0]} and {name} are no pair: their means are {means[0]:.1f} and {mean:.1f} DN. Expected two "
                "frames of the same exposure and light; is one missing before them?"
            )


def check_bits(bits: int | None, highest: float, piled: float, steps: int, notes: list[str]) -> int:
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


def check_phase(means: dict[tuple[int, int], float], pattern: str | None, notes: list[str]) -> None:
    """ValueError where the light of the four cells of 2 x 2 pixels is that of another colour filter.

    Off by a row and a column greens stay greens, and flats cannot tell red from blue: a chart can, `colour_matrix`.
    """
    size = max(means.values())

    def unlike(one: tuple[int, int], other: tuple[int, int]) -> float:
        return abs(means[one] - means[other]) / size

    straight, crossed = unlike((0, 0), (1, 1)), unlike((0, 1), (1, 0))
    apart = max(unlike((0, 0), cell) for cell in means)
    if pattern is None:
        if apart > 0.05:
            green = "RGGB or BGGR" if crossed < straight else "GRBG or GBRG"
            raise ValueError(
                "the four cells of 2 x 2 pixels have light of their own, up to "
                f"{100 * (1 - min(means.values()) / size):.0f} % apart: a colour filter lies on this sensor. "
                f"Say its pattern, such as {green}."
            )
        return
    if apart < _GRAY:
        notes.append(
            f"the four cells of {pattern} see the same light within {100 * apart:.2g} %: is this a monochrome sensor? "
            "Then leave the pattern out"
        )
    greens, others = (crossed, straight) if pattern in ("RGGB", "BGGR") else (straight, crossed)
    if greens > 0.05 and others < greens / 3:
        row, column = pattern[2:] + pattern[:2], pattern[1::-1] + pattern[:1:-1]
        raise ValueError(
            f"the two greens of {pattern} differ by {100 * greens:.0f} %, its red and blue by {100 * others:.0f} %: "
            f"the colour filter is off by one pixel. Use pattern {column} (one column) or {row} (one row)."
        )
