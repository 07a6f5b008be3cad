"""A sensor as it was measured: the stages that a calibration file stands for."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TypedDict

from kcam.context import Stage
from kcam.plain import from_json
from kcam.sensor.adc import ADC
from kcam.sensor.noise import DarkCurrent, FixedPattern, ReadNoise, ShotNoise
from kcam.units import check_positive

FORMAT = 1


class _Quantity(TypedDict):
    value: float | None
    standard_error: float | None
    unit: str


class _Channel(TypedDict):
    gain: _Quantity
    read_noise: _Quantity
    prnu: _Quantity
    dsnu: _Quantity
    full_well: _Quantity
    dark_current: _Quantity


class _Document(TypedDict):
    format: int
    bits: int
    black_level: float
    channels: dict[str, _Channel]


def from_calibration(
    path: str | os.PathLike[str], *, channel: str | None = None, exposure_time: float | None = None, seed: int = 0
) -> list[Stage]:
    """The stages of a calibrated sensor, from electrons to numbers, in the order of the camera.

    ShotNoise, DarkCurrent (where the exposure time is given), FixedPattern, ReadNoise, ADC;
    the ADC's gain is K full_well / (2^bits - 1).

    Of a colour sensor each number is the mean over its channels, weighted by their standard errors: the stages stand
    behind the mosaic, where all pixels share one converter, so channels differ by what their filter lets through.
    What the file does not know is left out; without a full well, it is what full scale holds.

    Args:      path: of a sensor.json, as `kcam calibrate-sensor` writes it.
               channel: one of the file's, such as "G", in place of the mean.
               exposure_time: of the dark current [s], > 0; None leaves dark current out.
               seed: names the sensor of the fixed pattern.
    Returns:   stages to put behind `Exposure`, such as of ``Camera(imaging, colour_filter, Exposure(), *stages)``.
    Raises:    FileNotFoundError; ValueError for a file that is none, an unknown channel, a time <= 0, or a time where
               the file has no dark current.

    Example:
    >>> from kcam import calibration
    >>> electrons = [torch.full((2, 64, 64), n) for n in (0.0, 1e3, 2e3, 4e3, 1e5)]
    >>> frames = [(64 + 0.5 * torch.poisson(n) + torch.randn(n.shape)).round().clamp(max=4095) for n in electrons]
    >>> calibration.photon_transfer(frames[1:], frames[:1], bits=12).save("sensor.json")
    >>> [type(stage).__name__ for stage in sensor.from_calibration("sensor.json")]
    ['ShotNoise', 'FixedPattern', 'ReadNoise', 'ADC']
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}. Write one with: kcam calibrate-sensor --out {path}.")
    document: _Document = from_json(
        path.read_bytes(), _Document, wrong=f"{path} is no calibration of a sensor", fix="Calibrate again."
    )
    if document["format"] > FORMAT:
        raise ValueError(f"{path} has format {document['format']}; this kcam reads up to {FORMAT}. Update kcam.")
    channels = document["channels"]
    if not channels or (channel is not None and channel not in channels):
        raise ValueError(f"{path} has no channel {channel!r}: expected one of {', '.join(channels) or 'R, G, B'}.")
    chosen = list(channels.values()) if channel is None else [channels[channel]]

    gain, full_well, read_noise, prnu, dsnu, dark_current = (
        _mean([part[name] for part in chosen])  # type: ignore[literal-required]
        for name in ("gain", "full_well", "read_noise", "prnu", "dsnu", "dark_current")
    )
    if gain is None or not gain > 0:
        raise ValueError(f"{path} has no gain, got {gain}: without it electrons are unknown. Calibrate again.")
    top, black = 2 ** document["bits"] - 1, document["black_level"]
    capacity = (top - black) / gain if full_well is None else full_well
    stages: list[Stage] = [ShotNoise(capacity)]
    if exposure_time is not None:
        check_positive(exposure_time, name="exposure_time", unit="s")
        if dark_current is None:
            raise ValueError(
                f"{path} has no dark current for an exposure of {exposure_time:g} s: leave exposure_time out, or "
                "calibrate with darks of several exposure times."
            )
        stages.append(DarkCurrent(max(dark_current, 0.0), time=exposure_time, full_well=capacity))
    if prnu is not None or dsnu is not None:
        stages.append(FixedPattern(prnu or 0.0, dsnu=dsnu or 0.0, seed=seed, full_well=capacity))
    if read_noise is not None:
        stages.append(ReadNoise(read_noise, full_well=capacity))
    return [*stages, ADC(document["bits"], black_level=black, gain=gain * capacity / top)]


def _mean(quantities: list[_Quantity]) -> float | None:
    """The mean of what is known, weighted by its errors."""
    known = [(q["value"], q["standard_error"]) for q in quantities if q["value"] is not None]
    if not known:
        return None
    errors = [error if error is not None and error > 0 else math.nan for _, error in known]
    weights = [1.0] * len(known) if any(map(math.isnan, errors)) else [1 / error**2 for error in errors]
    return sum(w * value for w, (value, _) in zip(weights, known, strict=True)) / sum(weights)
