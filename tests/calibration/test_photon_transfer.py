"""A calibration finds what a camera is, says how sure it is, and refuses frames that cannot show it."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
import tifffile
import torch
from commands import fails, run
from linear_cameras import Frames, draw
from PIL import Image

from kcam import Camera, Raw, calibration, sensor
from kcam.calibration import UNITS, exposure_time, photon_transfer, read_frame
from kcam.calibration.rounding import root, rounding_variance, unrounded


def found(frames: Frames, **more: Any) -> calibration.SensorCalibration:
    return photon_transfer(frames.flats, frames.darks, **frames.arguments() | more)


def within_two_errors(seeds: range, **given: Any) -> dict[str, list[bool]]:
    """By quantity, whether each channel of each camera was recovered within two standard errors."""
    hits: dict[str, list[bool]] = {name: [] for name in UNITS}
    for seed in seeds:
        pattern = (None, "RGGB", "GBRG")[seed % 3]
        frames = draw(seed, pattern=pattern, **given)
        for channel in found(frames, pattern=pattern).channels.values():
            for name, quantity in channel.quantities().items():
                if quantity.value is not None and quantity.standard_error is not None:
                    hits[name].append(abs(quantity.value - frames.truth[name]) <= 2 * quantity.standard_error)
    return hits


def check_coverage(hits: dict[str, list[bool]], *, share: float = 0.95) -> None:
    """Each quantity on its own may miss as often as chance has it; channels of one camera share some of their noise."""
    for name, each in hits.items():
        least = scipy.stats.binom.ppf(1e-3, len(each), share) / max(len(each), 1)
        assert np.mean(each) >= least, (name, np.mean(each), len(each))
    assert np.mean([hit for each in hits.values() for hit in each]) >= share - 0.01


def test_a_camera_is_recovered_within_two_standard_errors() -> None:
    hits = within_two_errors(range(24), size=64)
    assert min(map(len, hits.values())) >= 48
    check_coverage(hits)


@pytest.mark.slow
def test_a_hundred_cameras_are_recovered_95_times_in_100() -> None:
    check_coverage(within_two_errors(range(1000, 1100)))


def test_gains_behind_the_well_give_dark_electrons_a_pattern_that_is_no_dsnu() -> None:
    check_coverage(within_two_errors(range(9), size=96, late=True, dark_current=90.0, levels=10))


@pytest.mark.slow
def test_noise_below_a_step_is_recovered_or_said_to_be_hidden() -> None:
    """Steps of 3 to 20 electrons and a read noise of 1 to 3."""
    hidden, seen = 0, []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        frames = draw(
            seed, gain=rng.uniform(0.05, 0.3), read_noise=rng.uniform(1, 3), dsnu=rng.choice([0.0, 1.0, 3.0]), bits=12
        )
        channel = found(frames).channels["mono"]
        for name in ("gain", "read_noise", "dsnu", "full_well"):
            quantity = getattr(channel, name)
            if quantity.value is None:
                hidden += 1
                assert "rounding hides it" in quantity.reason
            else:
                seen.append(abs(quantity.value - frames.truth[name]) <= 2 * quantity.standard_error)
    assert hidden > 3
    assert np.mean(seen) > 0.94


@pytest.mark.parametrize(
    ("gain", "noise", "dsnu", "current"),
    [((0.04, 0.12), (1.5, 3.5), (0.0, 2.5), (5, 25)), ((0.048, 0.052), (3.1, 3.3), (1.9, 2.1), (14.5, 15.5))],
)
def test_dark_current_of_noise_below_a_step_is_within_its_errors(
    gain: tuple[float, float], noise: tuple[float, float], dsnu: tuple[float, float], current: tuple[float, float]
) -> None:
    """In a wide class, and in a narrow one, whose short darks all lie at one place between two numbers."""
    off = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        frames = draw(
            seed, gain=rng.uniform(*gain), read_noise=rng.uniform(*noise), dsnu=rng.uniform(*dsnu), bits=12, black=64,
            dark_current=rng.uniform(*current), dark_times=[0.01, 1.0, 5.0], well=1.0, prnu=0.005, size=96, levels=5,
        )  # fmt: skip
        found_ = found(frames).channels["mono"].dark_current
        off.append((found_.value - frames.truth["dark_current"]) / found_.standard_error)
    assert abs(np.mean(off)) < 0.6
    assert np.sqrt(np.mean(np.square(off))) < 1.2


def test_standard_errors_shrink_with_the_pixels() -> None:
    small, large = (
        found(draw(3, size=size, levels=12, gain=0.5, read_noise=5.0, dsnu=4.0, prnu=0.01)).channels["mono"]
        for size in (64, 256)
    )
    for name in ("gain", "read_noise", "prnu", "dsnu"):
        ratio = getattr(small, name).standard_error / getattr(large, name).standard_error
        assert 2.5 < ratio < 6.5, (name, ratio)  # 4, and what the errors of errors allow


def test_rounding_adds_what_a_sum_over_places_between_steps_adds() -> None:
    rng = np.random.default_rng(0)
    for sigma in (0.02, 0.1, 0.25, 0.6):
        place = rng.uniform(0, 1, 1_000_000)
        one, two = (np.rint(place + sigma * rng.standard_normal(place.size)) for _ in "ab")
        variance = float(((one - two) ** 2).mean() / 2)
        assert variance == pytest.approx(sigma**2 + float(rounding_variance(sigma**2)), abs=6e-4, rel=5e-3)
        assert unrounded(variance) == pytest.approx(sigma**2, abs=1.5e-3, rel=0.01)


def test_the_root_of_a_variance_is_covered_also_at_0() -> None:
    draws = np.random.default_rng(0).normal(0.0, 1.0, 2000)
    covered = [abs(root(float(draw), 1.0)[0]) <= 2 * root(float(draw), 1.0)[1] for draw in draws]
    assert np.mean(covered) > 0.95


def test_the_black_level_and_the_fitted_levels() -> None:
    frames = draw(7, bits=12, gain=0.3, well=0.7, levels=20)
    channel = found(frames).channels["mono"]
    assert channel.black_level == pytest.approx(frames.truth["black_level"], abs=0.2)
    top = max(level.mean for level in channel.flats) - channel.black_level
    assert all(level.mean - channel.black_level <= 0.701 * top for level in channel.flats if level.linear)
    assert sum(level.linear for level in channel.flats) >= 8


def test_a_response_that_bends_has_the_linearity_error_of_its_expected_values() -> None:
    """Against the standard's formula on the curve itself: 5 % loss at saturation, uneven light and noise aside."""
    bend = 0.05
    frames = draw(
        11, bend=bend, falloff=0.0, prnu=0.002, bits=14, gain=0.5, well=2.0, levels=20, brightest=0.9, size=160
    )
    quantity = found(frames).channels["mono"].linearity_error
    time = np.array(frames.times)
    signal = time * (1 - bend * time / 0.1)
    inside = signal >= 0.05 * signal.max() / 0.95
    time, signal = time[inside], signal[inside]
    basis = np.stack([np.ones_like(time), time], 1) / signal[:, None]
    line = np.stack([np.ones_like(time), time], 1) @ np.linalg.lstsq(basis, np.ones_like(time), rcond=None)[0]
    truth = float(np.abs(signal / line - 1).mean())
    assert truth > 2e-3
    assert quantity.value == pytest.approx(truth, rel=0.05)


def test_dark_current_behind_a_black_clamp_is_read_from_the_variance() -> None:
    frames = draw(5, clamp=True, dark_current=80.0, gain=1.0, read_noise=4.0, bits=14, size=128, levels=10)
    channel = found(frames).channels["mono"]
    current = channel.dark_current
    assert "from the variance" in current.reason
    for name in ("dark_current", "read_noise", "gain"):
        quantity = getattr(channel, name)
        assert abs(quantity.value - frames.truth[name]) < 3 * quantity.standard_error, name


def test_rows_and_columns_are_told_apart_from_pixels() -> None:
    rng = np.random.default_rng(0)
    columns, rows, pixels = (sigma * rng.standard_normal(n) for sigma, n in ((2.0, 256), (1.0, 256), (3.0, 256**2)))
    fixed = columns[None, :] + rows[:, None] + pixels.reshape(256, 256)

    def frame(light: float) -> np.ndarray:
        return np.rint(200 + fixed + rng.poisson(light, (256, 256)) + 2 * rng.standard_normal((256, 256)))

    flats, darks = ([[frame(light) for _ in "ab"] for light in lights] for lights in ((200, 800, 1500), (0, 0, 0)))
    pattern = photon_transfer(flats, darks, bits=12).channels["mono"].dark_pattern
    assert pattern is not None
    assert (pattern.column, pattern.row, pattern.pixel) == pytest.approx((2.0, 1.0, 3.0), rel=0.12)


def test_what_the_frames_do_not_show_is_null_with_the_reason() -> None:
    frames = draw(2, brightest=0.5, levels=6, bits=12, well=2.0)
    result = photon_transfer(frames.flats, frames.darks[:1], bits=12)
    channel = result.channels["mono"]
    assert channel.gain.value is not None
    assert channel.full_well.value is None
    assert "no flat saturates: the brightest is 0." in channel.full_well.reason
    assert "exposure times of the darks are unknown" in channel.dark_current.reason
    assert "exposure times of the flats are unknown" in channel.linearity_error.reason
    one = photon_transfer(frames.flats, frames.darks[:1], bits=12, dark_times=[0.5]).channels["mono"]
    assert "all darks were exposed 0.5 s: expected two" in one.dark_current.reason


def test_a_well_that_is_only_partly_full_is_told_with_its_doubt() -> None:
    for seed in range(6):
        frames = draw(seed, gain=0.5, bits=14, well=0.5, brightest=1.0, levels=10, prnu=0.003, falloff=0.0)
        well = found(frames).channels["mono"].full_well
        assert abs(well.value - frames.truth["full_well"]) <= 2 * well.standard_error
        assert well.standard_error < 0.02 * well.value


def test_frames_without_any_noise_are_refused() -> None:
    flat, dark = np.full((2, 2, 64, 64), 701), np.full((1, 2, 64, 64), 64)
    flat[1] += 500
    with pytest.raises(ValueError, match="does not grow with the light"):
        photon_transfer(flat, dark, bits=12)
    with pytest.raises(ValueError, match="the flats show no light"):
        photon_transfer(0 * flat, 0 * dark, bits=12)


def test_darks_that_are_cut_off_at_0_leave_the_gain() -> None:
    frames = draw(4, black=2, gain=1.0, read_noise=8.0, dsnu=3.0, bits=12, levels=12)
    result = found(frames)
    channel = result.channels["mono"]
    assert abs(channel.gain.value - frames.truth["gain"]) < 3 * channel.gain.standard_error
    for quantity in (channel.read_noise, channel.dsnu, channel.dark_current):
        assert quantity.value is None
        assert "raise the black level" in quantity.reason
    assert any("of the dark pixels are 0: raise the black level by" in note for note in result.notes)


@pytest.mark.parametrize("kind", ["levels", "pairs", "frames", "tensors"])
def test_frames_may_come_as_arrays_lists_or_tensors(kind: str) -> None:
    frames = draw(1, size=64, levels=6)
    whole = found(frames)
    how = {
        "levels": lambda stack: stack,
        "pairs": lambda stack: [(a, b) for a, b in stack],
        "frames": lambda stack: list(stack.reshape(-1, *stack.shape[2:])),
        "tensors": lambda stack: torch.from_numpy(stack.astype(np.float32)),
    }[kind]
    assert photon_transfer(how(frames.flats), how(frames.darks), **frames.arguments()) == whole


def test_more_than_two_frames_of_a_level_are_all_used() -> None:
    rng = np.random.default_rng(0)
    flats = [np.rint(100 + rng.poisson(n, (8, 64, 64)) + 3 * rng.standard_normal((8, 64, 64))) for n in (500, 1000)]
    darks = [np.rint(100 + 3 * rng.standard_normal((8, 64, 64)))]
    many = photon_transfer(flats, darks, bits=12).channels["mono"]
    few = photon_transfer([f[:2] for f in flats], [d[:2] for d in darks], bits=12).channels["mono"]
    assert many.gain.standard_error < 0.5 * few.gain.standard_error
    assert abs(many.gain.value - 1) < 3 * many.gain.standard_error


# ---- frames that cannot be right ---------------------------------------------------------------------------------


GOOD = draw(0, size=64, levels=8, bits=12, gain=0.5, well=2.0, read_noise=5.0)


def spoilt(flats: np.ndarray, value: float) -> np.ndarray:
    spoilt = flats.astype(np.float32)
    spoilt[1, 0, 3, 3] = value
    return spoilt


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"darks": []}, "there are no darks: expected at least one pair of frames with the lens capped"),
        ({"flats": []}, "there are no flats: expected at least one pair of frames of even light"),
        ({"flats": GOOD.flats[3, 0]}, "flats: one frame is no pair"),
        ({"flats": GOOD.flats[3, :1]}, "flats: one frame is no pair"),
        ({"darks": GOOD.darks[:, :1]}, r"darks\[0\] is 1 frame: expected a pair"),
        ({"flats": GOOD.flats[-1:]}, "all flats are saturated in mono"),
        ({"darks": GOOD.flats[-1:]}, "all darks are saturated in mono: their lowest mean is 40.* Cap the lens"),
        ({"flats": GOOD.darks[:1], "darks": GOOD.darks[:1]}, "the flats show no light in mono"),
        ({"flats": spoilt(GOOD.flats, math.nan)}, r"flats\[1\]\[0\] has 1 values that are NaN or inf"),
        ({"flats": spoilt(GOOD.flats, 7.5)}, r"flats\[1\]\[0\] has values that are no whole numbers, such as 7.5"),
        ({"flats": spoilt(GOOD.flats, -3)}, r"values below 0, such as -3: the black level was subtracted"),
        ({"flats": GOOD.flats / np.float32(4095)}, r"shares of full scale: use \(frame \* \(2\*\*bits - 1\)\).round"),
        ({"flats": GOOD.flats[..., :48]}, "has 64 x 48 pixels, the frames before it 64 x 64: expected one size"),
        ({"flats": GOOD.flats.astype(np.uint8)}, "has 8 bits"),
        ({"flats": GOOD.flats >> 4, "darks": GOOD.darks >> 4}, "8-bit numbers, whatever the files hold"),
        (
            {"flats": GOOD.flats >> 4, "darks": GOOD.darks >> 4, "bits": None},
            "the highest value of all frames is 255 DN: 8-bit numbers, .* with all its bits. If the frames are",
        ),
        ({"flats": GOOD.flats * 16, "darks": GOOD.darks * 16}, "all values are multiples of 16: 12-bit numbers"),
        ({"bits": 10}, "the highest value is 4095 DN, above 1023, full scale of 10 bits|saturated pixels"),
        ({"bits": 14}, "saturated pixels stand at 4095 DN, full scale of 12 bits, but bits is 14. Use bits=12"),
        ({"bits": 12.0}, "bits must be a whole number from 9 to 24"),
        ({"pattern": "RGGG"}, "pattern 'RGGG' is unknown"),
        ({"exposure_times": [0.0] * 8}, r"flats\[0\] has an exposure time of 0 s: expected seconds > 0, such as 0.01"),
        ({"exposure_times": [1.0]}, "1 exposure times for 8 levels of flats"),
        ({"flats": GOOD.flats[[0, 1, 2, 3]][:, [0, 0]]}, "the noise in mono does not grow with the light"),
        ({"flats": np.stack([GOOD.flats[:-1, 0], GOOD.flats[1:, 0]], 1)}, "are no pair: their means are"),
        ({"flats": GOOD.flats[..., :4, :4], "darks": GOOD.darks[..., :4, :4]}, "too small: expected at least 8 x 8"),
    ],
)  # fmt: skip
def test_hard_cases_end_in_clear_errors(change: dict[str, Any], text: str) -> None:
    arguments = {"flats": GOOD.flats, "darks": GOOD.darks, "bits": 12} | change
    with pytest.raises((ValueError, TypeError), match=text):
        photon_transfer(arguments.pop("flats"), arguments.pop("darks"), **arguments)


def test_frames_that_are_no_more_than_dim_are_taken_where_bits_say_so() -> None:
    frames = draw(0, size=64, levels=5, bits=12, gain=0.1, well=2.0, read_noise=20.0, dsnu=1.0, brightest=0.03)
    assert frames.flats.max() <= 255
    gain = found(frames, bits=12).channels["mono"].gain
    assert abs(gain.value - 0.1) < 3 * gain.standard_error
    with pytest.raises(ValueError, match="8-bit numbers, .* If the frames are only that dim, say bits, such as 12"):
        found(frames, bits=None)


def test_a_pattern_on_a_monochrome_sensor_is_noted() -> None:
    result = photon_transfer(GOOD.flats, GOOD.darks, bits=12, pattern="RGGB")
    (note,) = result.notes
    assert "the four cells of RGGB see the same light within" in note
    assert "leave the pattern out" in note


@pytest.mark.parametrize("true", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_a_colour_filter_off_by_one_pixel_is_named(true: str) -> None:
    frames = draw(8, pattern=true, size=64, levels=6)
    result = found(frames, pattern=true)
    assert list(result.channels) == ["R", "G", "B"]
    assert not result.notes
    other = "GRBG" if true in ("RGGB", "BGGR") else "RGGB"
    with pytest.raises(
        ValueError, match=f"the two greens of {other} differ by .*off by one pixel. Use pattern"
    ) as told:
        found(frames, pattern=other)
    assert true in str(told.value)
    with pytest.raises(ValueError, match="a colour filter lies on this sensor. Say its pattern, such as") as told:
        found(frames)
    assert true in str(told.value)


# ---- files and the command ---------------------------------------------------------------------------------------


def write(frames: Frames, folder: Path, suffix: str = ".tif", *, timed: bool = True) -> None:
    for letter, stack, times in (("f", frames.flats, frames.times), ("d", frames.darks, frames.dark_times)):
        for index, (level, time) in enumerate(zip(stack, times, strict=True)):
            for twin, frame in enumerate(level):
                number = 2 * index + twin + 1
                path = folder / (f"{letter}{number}_{time:.9f}s{suffix}" if timed else f"{letter}{number}{suffix}")
                if suffix == ".npy":
                    np.save(path, frame)
                elif suffix == ".png":
                    Image.fromarray(frame).save(path)
                else:
                    tifffile.imwrite(path, frame)


@pytest.mark.parametrize("suffix", [".tif", *(pytest.param(s, marks=pytest.mark.slow) for s in (".npy", ".png"))])
def test_the_command_writes_numbers_and_a_report(suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    frames = draw(6, pattern="RGGB", size=64, levels=12)
    write(frames, tmp_path, suffix)
    said = run(
        "calibrate-sensor", "--darks", f"d*{suffix}", "--flats", f"f?_*{suffix}", "--flats", f"f??_*{suffix}",
        "--pattern", "RGGB", "--bits", frames.bits, "--out", "sensor.json",
    )  # fmt: skip
    assert said.endswith("sensor.json\nsensor.html\n")
    document = json.loads(Path("sensor.json").read_text())
    assert (document["bits"], document["pattern"], list(document["channels"])) == (frames.bits, "RGGB", ["R", "G", "B"])
    expected = found(frames, pattern="RGGB")
    for name, channel in document["channels"].items():
        for title, unit in UNITS.items():
            quantity = getattr(expected.channels[name], title)
            assert channel[title]["unit"] == unit
            assert channel[title]["value"] == pytest.approx(quantity.value, rel=1e-4, abs=1e-7)  # times of 9 digits
            assert channel[title]["standard_error"] > 0
    page = Path("sensor.html").read_text()
    assert page.count("<img") == 7
    assert "gain" in page


def test_raw_files_of_cameras_are_frames_too(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    numbers = torch.randint(60, 1000, (1, 1, 24, 32), generator=torch.Generator().manual_seed(0)).float()
    levels = {"black_level": 64, "white_level": 1023, "neutral": [0.6, 1.0, 0.8], "colour_matrix": torch.eye(3)}
    Raw(numbers, pattern="RGGB", exposure_time=0.02, **levels).write(tmp_path / "flat.dng")
    assert (read_frame(tmp_path / "flat.dng") == numbers[0, 0].numpy()).all()
    assert exposure_time(tmp_path / "flat.dng") == pytest.approx(0.02)
    (tmp_path / "broken.nef").write_bytes(b"II*")
    assert exposure_time(tmp_path / "broken.nef") is None
    with pytest.raises(ValueError, match="broken.nef is damaged"):
        read_frame(tmp_path / "broken.nef")


@pytest.mark.slow
def test_without_times_a_file_says_null_and_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    frames = draw(6, size=64, levels=12, bits=12, well=2.0)
    write(frames, tmp_path, timed=False)
    run("calibrate-sensor", "--darks", "d*.tif", "--flats", "f*.tif", "--out", "sensor.json")
    channel = json.loads(Path("sensor.json").read_text())["channels"]["mono"]
    assert channel["dark_current"]["value"] is channel["dark_current"]["standard_error"] is None
    assert "exposure times" in channel["dark_current"]["reason"]
    names = [f"f{2 * i + k},{time}" for i, time in enumerate(frames.times) for k in (1, 2)]
    names += [f"d{2 * i + k},{time}" for i, time in enumerate(frames.dark_times) for k in (1, 2)]
    Path("times.csv").write_text("file,seconds\n" + "\n".join(name.replace(",", ".tif,") for name in names))
    run("calibrate-sensor", "--darks", "d*.tif", "--flats", "f*.tif", "--times", "times.csv", "--out", "sensor.json")
    channel = json.loads(Path("sensor.json").read_text())["channels"]["mono"]
    error = channel["dark_current"]["standard_error"]
    assert abs(channel["dark_current"]["value"] - frames.truth["dark_current"]) < 3 * error


def test_exposure_times_are_read_from_exif(tmp_path: Path) -> None:
    tag = (33434, 5, 1, (1, 50), True)  # a rational number
    tifffile.imwrite(tmp_path / "flat.tif", np.full((4, 4), 64, dtype=np.uint16), extratags=[tag])
    assert calibration.exposure_time(tmp_path / "flat.tif") == pytest.approx(0.02)
    tifffile.imwrite(tmp_path / "other.tif", np.full((4, 4), 64, dtype=np.uint16))
    assert calibration.exposure_time(tmp_path / "other.tif") is None


def test_what_the_command_refuses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write(GOOD, tmp_path, timed=False)
    both = ("--darks", "d*.tif", "--flats", "f*.tif")
    assert '--darks is missing: expected pairs of raw frames, such as --darks "d*.tif"' in fails(
        "calibrate-sensor", "--flats", "f*.tif"
    )
    assert '--darks "x*.tif" matches no file' in fails("calibrate-sensor", "--darks", "x*.tif", "--flats", "f*.tif")
    assert "its name must end in .json" in fails("calibrate-sensor", *both, "--out", "sensor.txt")
    assert "cannot write sensor.json: there is no folder nowhere" in fails(
        "calibrate-sensor", *both, "--out", "nowhere/sensor.json"
    )
    shell = ("--darks", "d1.tif", "d2.tif", "d3.tif", "--flats", "f1.tif", "f2.tif")
    assert "got 3 names that follow no option, such as d2.tif" in (said := fails("calibrate-sensor", *shell))
    assert 'Put patterns in quotes: --darks "d*.tif"' in said
    assert "is among the darks and the flats" in fails("calibrate-sensor", "--darks", "d1.tif", "--flats", "d*.tif")
    assert "1 flats are no pairs" in fails("calibrate-sensor", "--darks", "d*.tif", "--flats", "f1.tif")
    Path("times.csv").write_text("f1.tif,0.01\nf2.tif,soon\n")
    assert 'times.csv, line 2: "f2.tif,soon" is no file and its seconds' in fails(
        "calibrate-sensor", *both, "--times", "times.csv"
    )
    Path("times.csv").write_text("f1.tif,0.01\n")
    assert "has no line for d1.tif" in fails("calibrate-sensor", *both, "--times", "times.csv")
    tifffile.imwrite("f3.tif", np.zeros((64, 64), np.uint8))
    assert "f3.tif has 8 bits" in fails("calibrate-sensor", *both)
    tifffile.imwrite("f3.tif", np.zeros((64, 64, 3), np.uint16))
    assert "f3.tif has shape (64, 64, 3), expected one plane" in fails("calibrate-sensor", *both)
    Path("f3.tif").write_bytes(b"no more")
    assert "f3.tif is damaged, or no .tif file" in fails("calibrate-sensor", *both)
    os.rename("f3.tif", "f3.jpg")
    assert "f3.jpg is no raw frame that can be read: expected one of .arw, .cr2" in fails(
        "calibrate-sensor", "--darks", "d*.tif", "--flats", "f[12].tif", "--flats", "f3.jpg", "--flats", "f4.tif"
    )
    assert not Path("sensor.json").exists()


def test_pairs_of_files_are_sorted_by_time_and_number(tmp_path: Path) -> None:
    names = [Path(f"f{i}_{time}.tif") for time in ("20ms", "3ms") for i in (10, 2)]
    made, times = calibration.pairs(names, what="flats")
    assert [(a.name, b.name) for a, b in made] == [("f2_3ms.tif", "f10_3ms.tif"), ("f2_20ms.tif", "f10_20ms.tif")]
    assert times == [0.003, 0.02]
    with pytest.raises(ValueError, match=r"f1_1ms.tif \(0.001 s\) and f2_2ms.tif \(0.002 s\) would be a pair"):
        calibration.pairs([Path("f1_1ms.tif"), Path("f2_2ms.tif")], what="flats")


def test_an_exposure_without_its_twin_is_named() -> None:
    names = [Path(f"f_{time}ms_{twin}.tif") for time in (5, 20, 40) for twin in "ab"]
    lone = "5 flats are no pairs: .* of 0.02 s there is 1: f_20ms_a.tif. Add its twin, or leave it out"
    with pytest.raises(ValueError, match=lone):
        calibration.pairs([name for name in names if name.name != "f_20ms_b.tif"], what="flats")
    with pytest.raises(ValueError, match="3 flats are no pairs: .* does f3.tif or another lack its twin?"):
        calibration.pairs([Path(f"f{index}.tif") for index in (1, 2, 3)], what="flats")


def test_a_flat_of_no_exposure_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    frames = draw(0, size=64, levels=4, bits=12)
    write(Frames(frames.flats, frames.darks, [0.0, *frames.times[1:]], frames.dark_times, 12, {}), tmp_path)
    said = fails("calibrate-sensor", "--darks", "d*.tif", "--flats", "f*.tif")
    assert "f1_0.000000000s.tif has an exposure time of 0 s" in said
    assert "A frame of no exposure is a dark: give it to --darks" in said


# ---- the stages of a calibrated sensor ---------------------------------------------------------------------------


def photograph(stages: list[Any], bits: int, *, time: float) -> Frames:
    """Frames that stages take of even light, and of none."""
    generator = torch.Generator().manual_seed(1)
    camera = torch.nn.Sequential(*stages)

    def pair(share: float) -> np.ndarray:
        light = torch.full((1, 1, 192, 192), share, dtype=torch.float64)
        frames = []
        for _ in "ab":
            signal = light
            for stage in camera:
                noisy = isinstance(stage, sensor.ShotNoise | sensor.DarkCurrent | sensor.ReadNoise)
                signal = stage(signal, generator=generator) if noisy else stage(signal)
            frames.append(torch.round(signal[0, 0] * (2**bits - 1)).numpy())
        return np.stack(frames)

    shares = [0.05 * i for i in range(1, 20)] + [1.5]
    return Frames(np.stack([pair(share) for share in shares]), pair(0.0)[None], [], [time], bits, {})


@pytest.mark.parametrize("well", [0.6, 1.4])
def test_the_stages_take_frames_that_give_the_calibration_again(well: float, tmp_path: Path) -> None:
    frames = draw(9, gain=0.4, read_noise=6.0, dsnu=4.0, prnu=0.01, dark_current=30.0, bits=12, well=well, size=160)
    first = found(frames)
    first.save(tmp_path / "sensor.json")
    again = photograph(sensor.from_calibration(tmp_path / "sensor.json"), 12, time=0.0)
    second = photon_transfer(again.flats, again.darks, bits=12).channels["mono"]
    for name in ("gain", "read_noise", "prnu", "dsnu", "full_well"):
        one, two = getattr(first.channels["mono"], name), getattr(second, name)
        assert abs(one.value - two.value) < 3 * two.standard_error, (name, str(one), str(two))
    assert second.black_level == pytest.approx(first.black_level, abs=0.1)


def test_dark_current_of_an_exposure_comes_in(tmp_path: Path) -> None:
    frames = draw(9, gain=0.4, read_noise=6.0, dark_current=90.0, bits=12, size=128)
    found(frames).save(tmp_path / "sensor.json")
    stages = sensor.from_calibration(tmp_path / "sensor.json", exposure_time=2.0)
    assert [type(stage).__name__ for stage in stages] == [
        "ShotNoise", "DarkCurrent", "FixedPattern", "ReadNoise", "ADC"
    ]  # fmt: skip
    dark = photograph(stages, 12, time=2.0).darks
    assert dark.mean() - frames.truth["black_level"] == pytest.approx(0.4 * 180, rel=0.03)


def test_a_calibrated_camera_takes_pictures_and_is_saved(tmp_path: Path) -> None:
    frames = draw(6, pattern="RGGB", size=64, levels=8)
    found(frames, pattern="RGGB").save(tmp_path / "sensor.json")
    stages = sensor.from_calibration(tmp_path / "sensor.json")
    camera = Camera(sensor.Mosaic("RGGB"), sensor.Exposure(), *stages)
    picture = torch.rand(1, 3, 16, 16)
    camera.save(tmp_path / "mine.safetensors")
    loaded = Camera.load(tmp_path / "mine.safetensors")
    one, two = (c(picture, generator=torch.Generator().manual_seed(0)) for c in (camera, loaded))
    assert one.shape == (1, 1, 16, 16)
    assert torch.equal(one, two)


def test_channels_are_averaged_by_their_errors_or_chosen(tmp_path: Path) -> None:
    frames = draw(6, pattern="RGGB", size=64, levels=8)
    result = found(frames, pattern="RGGB")
    result.save(tmp_path / "sensor.json")
    noises = [channel.read_noise for channel in result.channels.values()]
    weights = np.array([1 / noise.standard_error**2 for noise in noises])
    mean = float((weights * [noise.value for noise in noises]).sum() / weights.sum())
    read = next(s for s in sensor.from_calibration(tmp_path / "sensor.json") if isinstance(s, sensor.ReadNoise))
    assert read.sigma_electrons == pytest.approx(mean)
    chosen = sensor.from_calibration(tmp_path / "sensor.json", channel="B")
    read = next(s for s in chosen if isinstance(s, sensor.ReadNoise))
    assert read.sigma_electrons == pytest.approx(result.channels["B"].read_noise.value)


def test_files_that_are_no_calibration_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "sensor.json"
    with pytest.raises(FileNotFoundError, match="Write one with: kcam calibrate-sensor --out"):
        sensor.from_calibration(path)
    photon_transfer(GOOD.flats, GOOD.darks, bits=12).save(path)
    document = json.loads(path.read_text())
    with pytest.raises(ValueError, match="has no channel 'G': expected one of mono"):
        sensor.from_calibration(path, channel="G")
    with pytest.raises(ValueError, match="has no dark current for an exposure of 1 s: leave exposure_time out"):
        sensor.from_calibration(path, exposure_time=1.0)
    with pytest.raises(ValueError, match="exposure_time"):
        sensor.from_calibration(path, exposure_time=0.0)
    document["channels"]["mono"]["gain"]["value"] = "high"
    path.write_text(json.dumps(document))
    with pytest.raises(ValueError, match="is no calibration of a sensor: .*high.* Calibrate again"):
        sensor.from_calibration(path)
    document["channels"]["mono"]["gain"]["value"] = None
    path.write_text(json.dumps(document))
    with pytest.raises(ValueError, match="has no gain, got None"):
        sensor.from_calibration(path)
    path.write_text(json.dumps(document | {"format": 9}))
    with pytest.raises(ValueError, match="has format 9; this kcam reads up to 1"):
        sensor.from_calibration(path)
