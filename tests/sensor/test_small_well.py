"""A sensor whose well is full before its converter, such as a calibrated one: what saturates there is the well."""

from __future__ import annotations

import random

import pytest
import torch

import kcam
from kcam import Camera, Scene, analysis, isp, sensor
from kcam.units import nm


def camera(gain: float, *, full_well: float = 5_000.0, **exposure: float) -> Camera:
    return Camera(
        sensor.ColourFilter.kodak(infrared_cut=680 * nm),
        sensor.Mosaic("RGGB"),
        sensor.Exposure(**exposure),
        sensor.ShotNoise(full_well),
        sensor.ReadNoise(3.0),
        sensor.ADC(12, black_level=64, gain=gain),
        isp.Demosaic(),
        isp.WhiteBalance(),
        isp.ColourMatrix(),
        isp.ToneCurve(),
    )


GAINS = [random.Random(0).uniform(0.2, 0.99) for _ in range(3)]
WALL = Scene.from_rgb(torch.full((3, 32, 32), 0.8))


@pytest.mark.parametrize("gain", [*GAINS, 1.0, 4.0])
def test_white_is_exposed_to_a_share_of_what_is_full_first(gain: float) -> None:
    one = camera(gain)
    white = one[1 + 1].factor(one.resolve(WALL)) * one[0].white(one.resolve(WALL).wavelengths)[1]
    assert float(white * max(gain, 1.0)) == pytest.approx(0.8, rel=1e-6)
    picture = one.noiseless()(WALL)
    assert float((picture - 0.8).abs().max()) < 5e-3


@pytest.mark.parametrize("gain", GAINS)
def test_what_is_too_bright_is_white(gain: float) -> None:
    picture = camera(gain, compensation=8.0)(WALL, generator=torch.Generator().manual_seed(0))
    assert float(picture.min()) > 0.999


@pytest.mark.parametrize("gain", [*GAINS, 1.0])
def test_a_raw_file_ends_at_the_full_well_and_develops_to_the_picture(gain: float) -> None:
    one = camera(gain)
    full = min(4095.0, 64 + gain * 4095)
    signal = camera(gain, compensation=8.0).noiseless().raw(WALL)
    assert float(signal.max() * 4095) == pytest.approx(full, abs=1)
    raw = kcam.Raw.from_camera(one, one.raw(WALL, generator=torch.Generator().manual_seed(1)))
    assert raw.white_level == pytest.approx(full, abs=1)
    slope, _ = raw.noise_profile
    assert 1 / slope == pytest.approx((full - 64) / 4095 / gain * 5_000, rel=2e-3)  # electrons from black to white
    picture = one(WALL, generator=torch.Generator().manual_seed(1))
    assert float((isp.develop(raw) - picture).abs().max()) < 1e-4


@pytest.mark.parametrize("gain", [*GAINS, 1.0])
def test_dynamic_range_and_snr_go_by_the_well(gain: float) -> None:
    one = camera(gain)
    full = 5_000.0 * min(1.0, (1 - 64 / 4095) / gain)
    assert analysis.dynamic_range(one).saturation == pytest.approx(full, rel=2e-3)
    curve = analysis.signal_to_noise(one, [0.25, 0.9])
    expected = [share * full for share in (0.25, 0.9)]
    assert curve.electrons.tolist() == pytest.approx(expected, rel=5e-3)
    step = 5_000 / gain / 4095
    for value, electrons in zip(curve.snr.tolist(), expected, strict=True):
        assert value == pytest.approx(electrons / (electrons + 9 + step**2 / 12) ** 0.5, rel=0.03)
