"""Photon transfer finds the constants of sensors that numpy simulates, and says what the frames do not show."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from calibration.simulated import Sensor, frames_of, random_sensor
from commands import fails, run

from kcam import Camera, sensor
from kcam.calibration import SensorCalibration, frames, photon_transfer

NAMES = ("gain", "read_noise", "prnu", "dsnu", "full_well", "dark_current", "linearity_error")


def truth(made: Sensor) -> dict[str, float]:
    return {
        "gain": made.gain, "read_noise": made.read_noise, "prnu": made.prnu, "dsnu": made.dsnu,
        "full_well": made.saturation, "dark_current": made.dark_current, "linearity_error": 0.0,
    }  # fmt: skip


def campaign(seeds: range) -> dict[str, list[float]]:
    """How many standard errors each quantity of each sensor is off."""
    off = defaultdict(list)
    for seed in seeds:
        made = random_sensor(seed)
        levels = int(np.random.default_rng(seed).integers(6, 25))
        found = photon_transfer(**frames_of(made, levels=levels)).channels["mono"]
        for name, value in truth(made).items():
            if (measured := found[name]).value is not None:
                off[name].append((measured.value - value) / measured.standard_error)
    return off


def inside(off: dict[str, list[float]]) -> float:
    """The share that is within two standard errors."""
    return float(np.mean([abs(one) <= 2 for ones in off.values() for one in ones]))


def test_random_sensors_are_recovered() -> None:
    off = campaign(range(1000, 1020))
    assert set(off) == set(NAMES)
    assert sum(map(len, off.values())) > 130
    assert inside(off) >= 0.95
    assert max(abs(one) for ones in off.values() for one in ones) < 5


@pytest.mark.slow
def test_many_random_sensors_are_recovered() -> None:
    off = campaign(range(2000, 2300))
    for name, ones in off.items():
        assert inside({name: ones}) >= 0.94, name  # 0.95 less two sigma of 300 draws
        assert abs(np.mean(ones)) < (1.0 if name == "linearity_error" else 0.4), name
        assert 0.2 < np.std(ones) < 1.2, name  # errors are neither too small nor empty words


@pytest.mark.parametrize("pattern", ["RGGB", "GBRG"])
def test_each_colour_by_itself(pattern: str) -> None:
    """Colours under one lamp fill unequally; each finds the one gain, and its own saturation is the sensor's."""
    made = Sensor(shape=(128, 96), seed=3)
    share = {"R": 0.5, "G": 1.0, "B": 0.7}
    tile = np.array([[share[pattern[0]], share[pattern[1]]], [share[pattern[2]], share[pattern[3]]]])
    light = np.tile(tile, (64, 48))
    flats = [made.pair(light * n) for n in np.linspace(500, 45_000, 12)]
    found = photon_transfer(flats, [made.pair(0.0), made.pair(0.0)], pattern=pattern, bits=14)
    assert list(found.channels) == ["R", "G", "B"]
    for quantities in found.channels.values():
        for name in ("gain", "read_noise", "prnu"):
            measured = quantities[name]
            assert abs(measured.value - truth(made)[name]) < 3 * measured.standard_error, name
    text = str(found)
    assert "14 bits, black level" in text
    assert "DN / electron" in text


def test_a_bent_response_is_measured() -> None:
    made = Sensor(bend=0.05, prnu=0.002, shape=(128, 128), seed=5)
    measured = photon_transfer(**frames_of(made, levels=20)).channels["mono"]["linearity_error"]
    n = np.linspace(0.05, 0.95, 2000) * made.full_well  # the standard's own, without noise
    y = n * (1 - made.bend * n / made.full_well)
    slope, first = np.polyfit(n, y, 1, w=1 / y)
    assert measured.value == pytest.approx(float(np.abs(y / (first + slope * n) - 1).mean()), rel=0.3)


def test_shading_of_the_lamp_is_no_non_uniformity() -> None:
    made = Sensor(shape=(128, 128), seed=7, prnu=0.005)
    y, x = np.meshgrid(np.linspace(-1, 1, 128), np.linspace(-1, 1, 128), indexing="ij")
    shade = 1 - 0.2 * (x**2 + y**2) + 0.05 * x
    flats = [made.pair(shade * n) for n in np.linspace(500, 16_000, 10)]
    measured = photon_transfer(flats, [made.pair(0.0)], bits=14).channels["mono"]["prnu"]
    assert abs(measured.value - made.prnu) < 3 * measured.standard_error


def test_what_the_frames_do_not_show_is_none_with_the_reason() -> None:
    made = Sensor(seed=1)
    flats = [made.pair(n) for n in (1000, 3000, 6000)]
    found = photon_transfer(flats, [made.pair(0.0)]).channels["mono"]
    for name, text in (
        ("full_well", "no flat saturates: the brightest is at"),
        ("dark_current", "exposure times of the darks are not known"),
        ("linearity_error", "exposure times of the flats are not known"),
    ):
        assert found[name].value is None
        assert found[name].standard_error is None
        assert text in found[name].reason
    same = photon_transfer(flats, [made.pair(0.0)], dark_times=[0.1], exposure_times=[0.1, 0.3, 0.3])
    assert "one exposure time alone" in same.channels["mono"]["dark_current"].reason
    assert "fewer than three" in same.channels["mono"]["linearity_error"].reason
    quiet = Sensor(gain=0.05, read_noise=2.0, seed=2)
    hidden = photon_transfer([quiet.pair(n) for n in (2000, 6000, 15_000)], [quiet.pair(0.0)]).channels["mono"]
    for name in ("read_noise", "dsnu"):
        assert "below 0.49 DN" in hidden[name].reason
    assert hidden["gain"].value == pytest.approx(0.05, rel=0.1)


def test_a_camera_of_the_calibration_gives_it_back(tmp_path: Path) -> None:
    """Frames of kcam's own stages, as the calibration of a numpy sensor made them, are calibrated again."""
    made = Sensor(seed=4, dark_current=50.0, shape=(128, 128))
    first = photon_transfer(**frames_of(made, levels=15))
    first.save(tmp_path / "sensor.json")
    stages = sensor.from_calibration(tmp_path / "sensor.json", exposure_time=0.5)
    assert [type(stage).__name__ for stage in stages] == [
        "ShotNoise", "DarkCurrent", "FixedPattern", "ReadNoise", "ADC"
    ]  # fmt: skip
    camera = Camera(*(stage for stage in stages if not isinstance(stage, sensor.DarkCurrent)))
    generator = torch.Generator().manual_seed(0)

    def pair(share: float) -> list[torch.Tensor]:
        light = torch.full((1, 1, 128, 128), share)
        return [(camera(light, generator=generator)[0, 0] * (2**14 - 1)).round() for _ in range(2)]

    again = photon_transfer([pair(s) for s in np.linspace(0.03, 1.3, 15)], [pair(0.0)], bits=14)
    for name in ("gain", "read_noise", "prnu", "dsnu", "full_well"):
        one, two = first.channels["mono"][name], again.channels["mono"][name]
        assert abs(one.value - two.value) < 4 * math.hypot(one.standard_error, two.standard_error), name
    assert stages[1].electrons() == pytest.approx(25, rel=0.1)
    assert abs(again.black_level - first.black_level) < 0.2


class TestErrors:
    @staticmethod
    def frames() -> tuple[list, list]:
        made = Sensor(seed=1, shape=(32, 32))
        return [made.pair(n) for n in (1000, 5000, 12_000)], [made.pair(0.0)]

    def test_frames(self) -> None:
        flats, darks = self.frames()
        nan = (flats[0][0].copy(), flats[0][1])
        nan[0][3, 4] = math.nan
        full = [(np.full((32, 32), 16_383.0),) * 2] * 2
        for arguments, text in (
            ((flats, []), "there are no darks: expected at least one pair of frames with the lens capped"),
            (([], darks), "there are no flats"),
            ((flats[:1], darks), "one pair of flats"),
            (([(f[0],) for f in flats], darks), r"flats\[0\] holds 1 frames.*take each level twice"),
            (([nan, *flats], darks), r"flats\[0\] has 1 values that are NaN"),
            ((flats, [(d[:16], e[:16]) for d, e in darks]), r"darks\[0\] is 16 x 32 pixels, and flats\[0\] 32 x 32"),
            ((full, darks), "every flat is saturated: the dimmest"),
            (([darks[0], *darks], darks), "no level of light between the dark and 70 %"),
            (
                ([(f[0], g[0]) for f, g in pairwise(flats)], darks),
                "flat pair 1 have means of.*Are the frames in",
            ),
            (
                (flats, [(np.maximum(d - 100, 0), np.maximum(e - 100, 0)) for d, e in darks]),
                "are 0 DN: the noise is cut",
            ),
            (([(f.astype(np.uint8), g.astype(np.uint8)) for f, g in flats], darks), r"of 8 bits, a developed picture"),
            (
                ([(16 * f, 16 * g) for f, g in flats], [(16 * f, 16 * g) for f, g in darks]),
                "multiples of 16: numbers of 12 bits",
            ),
        ):
            with pytest.raises(ValueError, match=text):
                photon_transfer(*arguments)

    def test_arguments(self) -> None:
        flats, darks = self.frames()
        for arguments, text in (
            ({"bits": 10}, r"outside of 0..1023 DN, 10 bits"),
            ({"bits": 40}, "bits must be 8 to 24"),
            ({"exposure_times": [0.0, 0.1, 0.2]}, "exposure_times must be seconds > 0.*got 0"),
            ({"exposure_times": [0.1]}, "exposure_times has 1 values for 3 pairs"),
            ({"dark_times": [-1.0]}, "dark_times must be seconds >= 0"),
            ({"pattern": "RGGR"}, "unknown pattern"),
            ({"pattern": "x_trans"}, "channel . has .* pixels: expected 256"),
        ):
            with pytest.raises(ValueError, match=text):
                photon_transfer(flats, darks, **arguments)

    def test_a_pattern_that_is_off_by_one(self) -> None:
        made = Sensor(seed=2, shape=(64, 64))
        light = np.tile(np.array([[0.5, 1.0], [1.0, 0.7]]), (32, 32))
        flats, darks = [made.pair(light * n) for n in (2000, 6000, 12_000)], [made.pair(0.0)]
        photon_transfer(flats, darks, pattern="RGGB")
        with pytest.raises(ValueError, match="two greens of GRBG differ by.*Try RGGB or BGGR"):
            photon_transfer(flats, darks, pattern="GRBG")

    def test_files_that_are_no_calibration(self, tmp_path: Path) -> None:
        path = tmp_path / "sensor.json"
        with pytest.raises(FileNotFoundError, match="no file .*sensor.json"):
            sensor.from_calibration(path)
        null = {"value": None, "standard_error": None, "unit": ""}
        for text, said in (
            ("{", "is no calibration of a sensor"),
            ("{}", "has no 'bits'"),
            (json.dumps({"format": 2, "bits": 12, "black_level": 1.0, "channels": {}}), "is of format 2"),
            (
                json.dumps({"format": 1, "bits": 12, "black_level": 1.0, "channels": {"mono": {"gain": null}}}),
                "knows no gain",
            ),
        ):
            path.write_text(text)
            with pytest.raises(ValueError, match=said):
                sensor.from_calibration(path)


class TestCommand:
    @staticmethod
    def write(folder: Path, *, levels: int = 8, tags: bool = False) -> Sensor:
        made = Sensor(seed=6, shape=(96, 96), dark_current=40.0)
        for index, time in enumerate(np.linspace(0.01, 0.12, levels)):
            for twin in "ab":
                name = f"f{twin}{index}" if tags else f"flat_{1e3 * time:.4g}ms_{twin}"
                extra = [("ExposureTime", "2I", 1, (round(time * 1e6), 1_000_000), True)] if tags else []
                frame = made.frame(200_000 * time, time).astype(np.uint16)
                tifffile.imwrite(folder / f"{name}.tif", frame, extratags=extra)
        for time in (0.01, 1.0, 3.0):
            for twin in "ab":
                np.save(folder / f"dark_{time}s_{twin}.npy", made.frame(0.0, time).astype(np.uint16))
        return made

    @pytest.mark.parametrize("tags", [False, True])
    def test_from_files_to_stages(self, tags: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        made = self.write(tmp_path, tags=tags)
        monkeypatch.chdir(tmp_path)
        flats = ["--flats", "f*.tif"] if tags else ["--flats", "flat_*ms_a.tif", "--flats", "flat_*ms_b.tif"]
        run("calibrate-sensor", "--darks", "dark*.npy", *flats, "--bits", "14", "--out", "sensor.json")
        found = json.loads((tmp_path / "sensor.json").read_text())
        assert set(found["channels"]["mono"]) == set(NAMES)
        for name, value in truth(made).items():
            measured = found["channels"]["mono"][name]
            assert measured["unit"]
            assert abs(measured["value"] - value) < 3.5 * measured["standard_error"], name
        assert len(sensor.from_calibration("sensor.json")) == 4
        page = (tmp_path / "sensor.html").read_text()
        assert page.count("<img") == 4
        assert "Photon transfer" in page

    def test_errors_are_one_line(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.write(tmp_path, levels=3)
        monkeypatch.chdir(tmp_path)
        np.save("flat_7ms_a.npy", np.full((96, 96), 200, dtype=np.uint16))
        np.save("wide_1s_a.npy", np.full((96, 98), 200, dtype=np.uint16))
        np.save("wide_1s_b.npy", np.full((96, 96), 200, dtype=np.uint16))
        tifffile.imwrite("small.tif", np.zeros((8, 8), dtype=np.uint8))
        tifffile.imwrite("colour.tif", np.zeros((8, 8, 3), dtype=np.uint16), photometric="rgb")
        Path("broken.tif").write_bytes(b"II*")
        Path("times.csv").write_text("file,seconds\nflat_10ms_a.tif,ten\n")
        flats, darks = ["--flats", "flat*.tif"], ["--darks", "dark*.npy"]
        for arguments, text in (
            ([*flats, "--darks", "no*.tif"], 'no file "no*.tif" for --darks'),
            ([*darks, *flats, "--flats", "flat_7ms_a.npy"], "there are 7 flats: frames come in pairs"),
            ([*darks, *flats, "--flats", "flat_7ms_a.npy", "--flats", "dark_1.0s_a.npy"], "has no second frame"),
            ([*darks, "--flats", "wide*.npy"], "a pair is of one size"),
            ([*darks, "--flats", "small.tif", "--flats", "small.tif"], "there are 1 flats"),
            ([*darks, "--flats", "small.tif", "--flats", "flat_10ms_a.tif"], "is of 8 bits"),
            ([*darks, "--flats", "colour.tif", "--flats", "flat_10ms_a.tif"], "expected one plane"),
            ([*darks, "--flats", "broken.tif", "--flats", "flat_10ms_a.tif"], "broken.tif cannot be read"),
            ([*darks, *flats, "--times", "times.csv"], "times.csv, line 2"),
            ([*darks, *flats, "--times", "none.csv"], "no file none.csv"),
            ([*darks, *flats, "--pattern", "RGBG"], "unknown pattern"),
            ([*darks, *flats, "--bits", "8"], "8 bits"),
            ([*darks, *flats, "--out", "sensor.txt"], "a calibration ends in .json"),
        ):
            assert text in fails("calibrate-sensor", *arguments)
            assert not list(tmp_path.glob("sensor.json"))


def test_frames_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for index in (10, 9, 1):
        np.save(tmp_path / f"f{index}.npy", np.zeros((2, 2)))
    assert [path.stem for path in frames.expanded([str(tmp_path / "f*")], name="x")] == ["f1", "f9", "f10"]


def test_a_calibration_prints_its_numbers_with_their_errors() -> None:
    made = Sensor(seed=1)
    found = photon_transfer([made.pair(n) for n in (1000, 3000, 6000)], [made.pair(0.0)])
    assert isinstance(found, SensorCalibration)
    assert "gain" in str(found)
    assert "none: no flat saturates" in str(found)
