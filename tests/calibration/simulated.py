"""Sensors in numpy alone, independent of kcam: Poisson electrons, normal read noise, fixed patterns, an ADC."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass
class Sensor:
    gain: float = 0.5  # DN / electron
    read_noise: float = 5.0  # electrons
    prnu: float = 0.01
    dsnu: float = 2.0  # electrons
    full_well: float = 20_000.0  # electrons
    dark_current: float = 0.0  # electrons / s
    black: float = 100.0
    bits: int = 14
    shape: tuple[int, int] = (96, 96)
    seed: int = 0
    bend: float = 0.0  # of the response, relative at the full well

    def __post_init__(self) -> None:
        self.draw = np.random.default_rng(self.seed)
        self.gains = 1 + self.prnu * self.draw.standard_normal(self.shape)
        self.offsets = self.dsnu * self.draw.standard_normal(self.shape)

    def frame(self, electrons, time: float = 0.0) -> np.ndarray:
        """electrons: expected, a number or one for each pixel."""
        light = np.maximum(electrons * self.gains, 0)
        count = self.draw.poisson(np.broadcast_to(light, self.shape)) + self.draw.poisson(
            self.dark_current * time, self.shape
        )
        count = count * (1 - self.bend * count / self.full_well)
        count = (
            np.minimum(count, self.full_well) + self.offsets + self.read_noise * self.draw.standard_normal(self.shape)
        )
        return np.rint(self.black + self.gain * count).clip(0, 2**self.bits - 1)

    def pair(self, electrons, time: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        return self.frame(electrons, time), self.frame(electrons, time)

    @property
    def saturation(self) -> float:
        """Electrons that are recorded at most."""
        return min(self.full_well, (2**self.bits - 1 - self.black) / self.gain)


def random_sensor(seed: int) -> Sensor:
    draw = np.random.default_rng(10_000 + seed)
    bits = int(draw.choice([10, 12, 14, 16]))
    noise = float(np.exp(draw.uniform(np.log(1.0), np.log(15.0))))
    most = 2**bits / noise  # the noise is above half a step
    gain = float(np.exp(draw.uniform(np.log(0.7 / noise), np.log(min(5.0, most / 60)))))
    black = float(np.ceil(6 * gain * noise + 6 * gain * 8 + 8))
    ends = (2**bits - 1 - black) / gain
    well = float(ends * draw.choice([0.7, 0.9, 1.5]))
    side = int(draw.choice([64, 96, 160]))
    return Sensor(
        gain=gain,
        read_noise=noise,
        prnu=float(draw.uniform(0.002, 0.03)),
        dsnu=float(draw.uniform(0.0, 8.0)),
        full_well=well,
        dark_current=float(draw.choice([0.0, 1.0, 20.0, 100.0])),
        black=black,
        bits=bits,
        shape=(side, int(draw.choice([64, 96, 160]))),
        seed=seed,
    )


def frames_of(sensor: Sensor, *, levels: int, exposure: float = 0.1) -> dict:
    """Arguments of `photon_transfer`: levels of light by exposure time up to 1.4 times saturation."""
    times = exposure * np.linspace(0.03, 1.4, levels)
    per_second = sensor.saturation / exposure
    flats = [sensor.pair(per_second * t, t) for t in times]
    dark_times = [times[0], 0.5, 2.0]
    darks = [sensor.pair(0.0, t) for t in dark_times]
    return {
        "flats": flats,
        "darks": darks,
        "exposure_times": list(times),
        "dark_times": dark_times,
        "bits": sensor.bits,
    }
