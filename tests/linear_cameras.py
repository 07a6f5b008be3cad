"""Cameras of the tests' own, for calibrations: NumPy's draws, none of kcam's code."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass
class Frames:
    """Pairs of frames (levels, 2, H, W) of one camera, their exposure times [s], and what it truly is."""

    flats: np.ndarray
    darks: np.ndarray
    times: list[float]
    dark_times: list[float]
    bits: int
    truth: dict[str, float]

    def arguments(self) -> dict[str, Any]:
        return {"bits": self.bits, "exposure_times": self.times, "dark_times": self.dark_times}


def draw(seed: int, *, pattern: str | None = None, clamp: bool = False, **given: Any) -> Frames:
    """A random member of the class of linear cameras, and its frames from 4 % to beyond saturation."""
    rng = np.random.default_rng(seed)
    of = {
        "gain": math.exp(rng.uniform(math.log(0.05), math.log(5))),
        "read_noise": rng.uniform(1, 20),
        "prnu": rng.uniform(0.002, 0.03),
        "dsnu": rng.uniform(0, 10),
        "dark_current": rng.uniform(0, 100),
        "size": int(rng.choice([64, 96, 128, 160])),
        "levels": int(rng.integers(5, 31)),
        "bits": int(rng.choice([12, 14, 16])),
        "well": rng.uniform(0.4, 1.6),  # of what the converter holds
        "falloff": rng.choice([0.0, 0.2]),
        "brightest": 1.3,  # of saturation
        "dark_times": [0.01, 0.1, 1.0],
        "bend": 0.0,  # relative loss at saturation
        "late": False,  # whether the pixels' gains differ behind the well, so that dark electrons have a pattern too
    } | given
    size, gain, top = of["size"], of["gain"], 2 ** of["bits"] - 1
    black = of.get("black", math.ceil(6 * math.hypot(of["read_noise"], of["dsnu"]) * gain) + 16)
    well = of["well"] * (top - black) / gain
    saturation = min(well, (top - black) / gain)
    y, x = np.mgrid[-1 : 1 : size * 1j, -1 : 1 : size * 1j]
    light, gains = 1 - of["falloff"] * (x**2 + y**2), 1 + of["prnu"] * rng.standard_normal((size, size))
    light, late = (light, gains) if of["late"] else (light * gains, np.ones_like(gains))
    offset = of["dsnu"] * rng.standard_normal((size, size))
    for place, letter in enumerate(pattern or ""):
        light[place // 2 :: 2, place % 2 :: 2] *= {"R": 0.6, "G": 1.0, "B": 0.75}[letter]

    def frame(electrons: float, time: float) -> np.ndarray:
        expected = np.maximum(electrons * light, 0)
        expected = expected * (1 - of["bend"] * expected / saturation)
        counted = np.minimum(rng.poisson(expected + of["dark_current"] * time), well)
        counted = counted * late + offset + of["read_noise"] * rng.standard_normal((size, size))
        taken_off = of["dark_current"] * time if clamp else 0.0
        return np.clip(np.rint(gain * (counted - taken_off) + black), 0, top).astype(np.uint16)

    shares = np.linspace(of["brightest"] / of["levels"], of["brightest"], of["levels"])
    if pattern and of["brightest"] > 1:
        shares = np.append(shares, 3.0)
    times, dark_times = [0.1 * share for share in shares], of["dark_times"]
    return Frames(
        np.stack([[frame(saturation * share, time) for _ in "ab"] for share, time in zip(shares, times, strict=True)]),
        np.stack([[frame(0.0, time) for _ in "ab"] for time in dark_times]),
        times,
        dark_times,
        of["bits"],
        {name: of[name] for name in ("gain", "read_noise", "prnu", "dsnu", "dark_current")}
        | {"full_well": saturation, "linearity_error": 0.0, "black_level": black},
    )
