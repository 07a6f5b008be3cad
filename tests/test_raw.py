"""Raw files: what a camera recorded goes out as DNG, TIFF and NumPy, is what LibRaw reads, and comes back whole."""

from __future__ import annotations

import dataclasses
import io
import math
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import torch
from torch import nn

import kcam
from kcam import Camera, Context, Raw, Scene, isp, sensor, spectral
from kcam.sensor import PATTERNS
from kcam.sensor.noise import RandomStage

BAYER = ("RGGB", "GRBG", "GBRG", "BGGR")
PATTERNED = (*BAYER, "x_trans", "quad_bayer")
FILTERS = (sensor.ColourFilter.nikon, sensor.ColourFilter.kodak, sensor.ColourFilter.sigma)


def camera_of(
    pattern: str = "RGGB",
    *,
    bits: int = 12,
    black: float = 64,
    colours: sensor.ColourFilter | None = None,
    method: str | None = None,
    iso: float | None = None,
    share: float = 0.8,
    full_well: float = 10_000,
    rounding: bool = True,
) -> Camera:
    return Camera(
        colours or sensor.ColourFilter.nikon(), sensor.Mosaic(pattern), sensor.Exposure(share, iso=iso),
        sensor.ShotNoise(full_well), sensor.ReadNoise(3.0), sensor.ADC(bits, black_level=black, rounding=rounding),
        isp.Demosaic(method), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(),
    )  # fmt: skip


def picture(seed: int, size: tuple[int, int] = (40, 54)) -> torch.Tensor:
    """A random smooth picture, (3,H,W) in 0.05..0.9 of light, coded as sRGB."""
    generator = torch.Generator().manual_seed(seed)
    coarse = 0.3 + 0.6 * torch.rand(1, 3, 3, 4, generator=generator)
    return nn.functional.interpolate(coarse, size=size, mode="bicubic", align_corners=True)[0].clamp(0.1, 0.95)


def scene_of(seed: int, *, size: tuple[int, int] = (40, 54), light: str = "D65") -> Scene:
    return Scene.from_rgb(picture(seed, size), depth=2.0, illuminant=light)


def taken(seed: int, *, pattern: str | None = None) -> tuple[Camera, Scene, Raw]:
    """A random camera of the class, without noise, a scene in a random light, and the raw."""
    rng = np.random.default_rng(seed)
    camera = camera_of(
        pattern or str(rng.choice(PATTERNED)),
        bits=int(rng.integers(10, 17)),
        black=float(rng.integers(0, 200)),
        colours=FILTERS[int(rng.integers(3))](),
        iso=float(rng.choice([100, 400, 1600])),
        share=float(rng.uniform(0.3, 0.9)),
    ).noiseless()
    size = (int(rng.integers(24, 60)), int(rng.integers(24, 60)))
    scene = scene_of(seed, size=size, light=str(rng.choice(["D65", "A", "D50", "FL2"] if seed else ["D65"])))
    return camera, scene, Raw.from_camera(camera, camera.raw(scene), scene=scene)


@pytest.mark.parametrize("seed", range(12))
def test_developed_it_is_the_picture_of_the_camera(seed: int) -> None:
    camera, scene, raw = taken(seed, pattern=PATTERNED[seed % 6])
    torch.testing.assert_close(isp.develop(raw), camera(scene), atol=1e-5, rtol=0)


@pytest.mark.parametrize("method", ["bilinear", "menon"])
def test_develop_takes_the_demosaic_by_name(method: str) -> None:
    camera = camera_of(method=method).noiseless()
    scene = Scene.builtin("astronaut", size=48)
    raw = Raw.from_camera(camera, camera.raw(scene))
    torch.testing.assert_close(isp.develop(raw, method=method), camera(scene), atol=1e-5, rtol=0)
    assert (isp.develop(raw) - camera(scene)).abs().max() > 1e-2


def test_gains_and_matrix_of_the_camera_s_own_stages_count() -> None:
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        gains = torch.rand(3, generator=generator) + 0.5
        matrix = torch.eye(3) + 0.2 * torch.rand(3, 3, generator=generator)  # white does not stay white
        stages = list(camera_of().noiseless())[:-4]
        camera = Camera(
            *stages, isp.Demosaic(gains=gains), isp.WhiteBalance(gains), isp.ColourMatrix(matrix), isp.ToneCurve()
        )
        scene = scene_of(3)
        raw = Raw.from_camera(camera, camera.raw(scene))
        torch.testing.assert_close(isp.develop(raw), camera(scene), atol=2e-3, rtol=0)  # another balance to fill in by
        assert (raw.camera_to_srgb.sum(1) - 1).abs().max() < 1e-12


def test_it_prints_shapes_not_pixels() -> None:
    raw = Raw(torch.full((1, 1, 64, 64), 100.0), "RGGB", 64.0, 1023.0, neutral=torch.tensor([0.6, 1.0, 0.8]))
    assert str(raw).startswith("Raw(mosaic=(1, 1, 64, 64), pattern='RGGB', black_level=64.0, white_level=1023.0, neut")
    assert len(str(raw)) < 200


def test_numbers_are_those_of_the_adc() -> None:
    camera, scene, raw = taken(5)
    bits = camera[5].bits
    assert torch.equal(raw.mosaic / (2**bits - 1), camera.raw(scene))
    assert torch.equal(raw.mosaic, raw.mosaic.round())
    assert raw.white_level == 2**bits - 1
    assert raw.black_level == camera[5].black_level


def test_the_neutral_is_what_a_white_gives_and_the_matrix_leads_there() -> None:
    white = Scene.from_rgb(torch.ones(3, 24, 24), depth=2.0)
    for colours in FILTERS:
        camera = camera_of(colours=colours(), bits=16, black=1000).noiseless()
        raw = Raw.from_camera(camera, camera.raw(white))
        signal = (raw.mosaic - raw.black_level)[0, 0]
        recorded = torch.stack([signal[0, 0], signal[0, 1], signal[1, 1]]).double()
        torch.testing.assert_close(raw.neutral, recorded / recorded[1], atol=1e-4, rtol=0)
        xyz = torch.linalg.inv(spectral.xyz_to_srgb_matrix()).sum(1)  # of the white of D65
        torch.testing.assert_close(raw.colour_matrix @ xyz, raw.neutral, atol=1e-9, rtol=0)
        d50 = torch.tensor([0.9642, 1.0, 0.8249], dtype=torch.float64)  # the specification's condition
        torch.testing.assert_close(raw.forward_matrix.sum(1), d50, atol=1e-9, rtol=0)
        linear = 2**raw.baseline_exposure * signal[0, 1] / (raw.white_level - raw.black_level)
        assert abs(float(linear) - 1) < 1e-3


@pytest.mark.parametrize("seed", range(3))
def test_a_converter_by_the_specification_makes_the_same_picture(seed: int) -> None:
    """XYZ under D50 = ForwardMatrix1 diag(1 / AsShotNeutral) camera, then adapted to D65: by colour-science."""
    colour = pytest.importorskip("colour")
    _, _, raw = taken(seed)
    light = torch.rand(3, 100, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    d65 = torch.linalg.inv(spectral.xyz_to_srgb_matrix()).sum(1).numpy()
    adapt = colour.adaptation.matrix_chromatic_adaptation_VonKries([0.9642, 1.0, 0.8249], d65, transform="Bradford")
    xyz = adapt @ raw.forward_matrix.numpy() @ (light / raw.neutral[:, None]).numpy()
    theirs = spectral.xyz_to_srgb_matrix().numpy() @ xyz
    np.testing.assert_allclose(theirs, raw.camera_to_srgb @ (raw.gains[:, None] * light), atol=1e-6)


def test_in_another_light_the_neutral_follows_and_the_matrix_s_white_stays_daylight_s() -> None:
    camera = camera_of()
    day, bulb = (scene_of(0, light=light) for light in ("D65", "A"))
    in_day, in_bulb = (Raw.from_camera(camera, camera.raw(scene), scene=scene) for scene in (day, bulb))
    expected = 1 / isp.as_shot_gains(camera.resolve(bulb))
    torch.testing.assert_close(in_bulb.neutral, expected, atol=1e-9, rtol=0)
    white = torch.linalg.inv(spectral.xyz_to_srgb_matrix()).sum(1)
    torch.testing.assert_close(in_bulb.colour_matrix @ white, in_day.neutral, atol=1e-6, rtol=0)
    in_context = Camera(*camera, context=Context(illuminant=bulb.illuminant))
    torch.testing.assert_close(Raw.from_camera(in_context, camera.raw(bulb)).neutral, expected, atol=1e-9, rtol=0)


@pytest.mark.parametrize(("iso", "rounding", "bits"), [(100, True, 12), (1600, False, 14), (400, True, 10)])
def test_the_noise_profile_is_the_variance_of_the_recorded_signal(iso: float, rounding: bool, bits: int) -> None:
    camera = camera_of(iso=iso, rounding=rounding, bits=bits, black=2**bits // 16)[3:]
    generator = torch.Generator().manual_seed(0)
    for share in (0.0, 0.01, 0.3):
        light = torch.full((1, 1, 700, 700), share / (iso / 100))
        raw = Raw.from_camera(camera, camera.raw(light, generator=generator))
        signal = (raw.mosaic.double() - raw.black_level) / (raw.white_level - raw.black_level)
        slope, offset = raw.noise_profile
        gain = iso / 100 * raw.white_level / (raw.white_level - raw.black_level) / 10_000
        assert slope == pytest.approx(gain, rel=1e-6)
        assert float(signal.var()) == pytest.approx(slope * float(signal.mean()) + offset, rel=0.02)


def test_noise_of_a_stage_that_does_not_tell_is_left_out() -> None:
    class Hiss(RandomStage):
        def __init__(self) -> None:
            super().__init__()
            self.full_well = None

        def forward(self, signal: torch.Tensor, context: Context | None = None) -> torch.Tensor:
            return signal

    camera = Camera(sensor.Mosaic(), Hiss(), sensor.ADC(), isp.Demosaic())
    assert Raw.from_camera(camera, torch.rand(1, 1, 8, 8)).noise_profile is None
    quiet = Camera(sensor.Mosaic(), sensor.FixedPattern(), sensor.ADC(12), isp.Demosaic())
    assert Raw.from_camera(quiet, torch.rand(1, 1, 8, 8)).noise_profile == (0.0, pytest.approx(1 / 4095**2 / 12))


def tags_of(path: Path) -> dict[int, Any]:
    with tifffile.TiffFile(path) as file:
        return {tag.code: tag.value for tag in file.pages[0].tags}


def fractions(value: tuple[int, ...]) -> np.ndarray:
    return np.array(value[::2]) / np.array(value[1::2])


def test_the_tags_of_a_dng_are_those_of_the_specification(tmp_path: Path) -> None:
    raw = dataclasses.replace(taken(7, pattern="GBRG")[2], exposure_time=1 / 125, iso=400.0, camera="Bench 3")
    path = tmp_path / "shot.dng"
    raw.write(path)
    tags = tags_of(path)
    height, width = raw.mosaic.shape[-2:]
    assert (tags[256], tags[257], tags[258], tags[259], tags[277], tags[262]) == (width, height, 16, 1, 1, 32803)
    assert (tags[50706], tags[33421], tags[33422], tags[50710]) == (b"\1\4\0\0", (2, 2), b"\1\2\0\1", b"\0\1\2")
    assert tags[254] == 0 if 254 in tags else True
    assert (tags[50717], fractions(tags[50714])[0], tags[50778]) == (raw.white_level, raw.black_level, 21)
    np.testing.assert_allclose(fractions(tags[50721]).reshape(3, 3), raw.colour_matrix, atol=1e-8)
    np.testing.assert_allclose(fractions(tags[50964]).reshape(3, 3), raw.forward_matrix, atol=1e-8)
    np.testing.assert_allclose(fractions(tags[50728]), 1 / raw.gains, atol=1e-8)
    assert fractions(tags[50730])[0] == pytest.approx(raw.baseline_exposure, abs=1e-8)
    assert tags[51041] == pytest.approx(raw.noise_profile, rel=1e-12)
    assert tags[50708] == "Bench 3"
    assert (tags[33434], tags[34855]) == ((1, 125), 400)
    assert tags[34665]["ExposureTime"] == (1, 125)
    assert tags[34665]["ISOSpeedRatings"] == 400
    codes = [struct.unpack_from("<H", path.read_bytes(), at)[0] for at in directory(path.read_bytes())]
    assert codes == sorted(codes)  # as TIFF demands
    assert {path.name for path in tmp_path.iterdir()} == {"shot.dng"}


def directory(content: bytes) -> range:
    (start,) = struct.unpack_from("<I", content, 4)
    (count,) = struct.unpack_from("<H", content, start)
    return range(start + 2, start + 2 + 12 * count, 12)


def same(one: Raw, other: Raw, *, atol: float) -> None:
    assert torch.equal(one.mosaic, other.mosaic)
    for field in ("pattern", "white_level", "camera"):
        assert getattr(one, field) == getattr(other, field)
    numbers = ("black_level", "neutral", "colour_matrix", "noise_profile", "baseline_exposure", "exposure_time", "iso")
    for field in numbers:
        here, there = (getattr(raw, field) for raw in (one, other))
        assert (here is None) == (there is None), field
        if here is not None:
            a, b = (torch.as_tensor(value, dtype=torch.float64) for value in (here, there))
            torch.testing.assert_close(a, b, atol=atol, rtol=1e-6, msg=field)


@pytest.mark.parametrize("seed", range(6))
def test_a_tiff_comes_back_whole(seed: int, tmp_path: Path) -> None:
    raw = dataclasses.replace(taken(seed)[2], exposure_time=0.02, camera="Müller"[:1])
    raw.write(tmp_path / "shot.tif")
    same(Raw.from_file(tmp_path / "shot.tif"), raw, atol=1e-7)
    words = tifffile.imread(tmp_path / "shot.tif")
    assert words.dtype == np.uint16
    assert np.array_equal(words, raw.mosaic[0, 0].numpy())


def test_a_numpy_file_holds_the_numbers(tmp_path: Path) -> None:
    raw = taken(2)[2]
    raw.write(tmp_path / "shot.npy")
    words = np.load(tmp_path / "shot.npy")
    assert words.dtype == np.uint16
    assert np.array_equal(words, raw.mosaic[0, 0].numpy())
    with pytest.raises(ValueError, match="numbers alone"):
        Raw.from_file(tmp_path / "shot.npy")


# ---------------------------------------------------------------------------------------------- through LibRaw


def by_libraw(file: Any, raw: Raw, *, linear: bool = False) -> np.ndarray:
    """LibRaw's own development, in 0..1."""
    import rawpy

    algorithm = rawpy.DemosaicAlgorithm.LINEAR if linear else rawpy.DemosaicAlgorithm.AHD
    picture = file.postprocess(
        use_camera_wb=True, output_color=rawpy.ColorSpace.sRGB, gamma=(2.4, 12.92), no_auto_bright=True, output_bps=16,
        adjust_maximum_thr=0.0, user_flip=0, demosaic_algorithm=algorithm,
        bright=2**raw.baseline_exposure * float(raw.gains.min()),  # it scales so that the least gain is 1
    )  # fmt: skip
    return picture / 65535


@pytest.mark.parametrize("seed", range(8))
def test_libraw_reads_what_was_written(seed: int, tmp_path: Path) -> None:
    rawpy = pytest.importorskip("rawpy")
    _, _, raw = taken(seed, pattern=(*BAYER, "x_trans")[seed % 5])
    raw = dataclasses.replace(raw, exposure_time=1 / 60)
    path = tmp_path / "shot.dng"
    raw.write(path)
    with rawpy.imread(str(path)) as file:
        assert np.array_equal(file.raw_image_visible, raw.mosaic[0, 0].numpy())
        assert file.black_level_per_channel == [raw.black_level] * 4
        assert file.white_level == raw.white_level
        tile = np.array(PATTERNS[raw.pattern])
        cells = np.array([0, 1, 2, 1])[file.raw_pattern]
        assert np.array_equal(cells, tile)
        np.testing.assert_allclose(file.camera_whitebalance[:3], raw.gains, rtol=1e-6)
        np.testing.assert_allclose(file.color_matrix[:, :3], raw.camera_to_srgb, atol=1e-4)  # its sRGB is rounded
        assert file.other.shutter_speed == pytest.approx(1 / 60)
        assert file.other.iso_speed == pytest.approx(raw.iso)
    again = Raw.from_file(path)
    same(again, raw, atol=2e-7)
    torch.testing.assert_close(isp.develop(again), isp.develop(raw), atol=1e-5, rtol=0)


@pytest.mark.parametrize("seed", range(6))
def test_libraw_develops_to_our_picture(seed: int, tmp_path: Path) -> None:
    """Where no demosaic has to guess, to its own rounding; in detail, to less than two demosaics of ours differ."""
    rawpy = pytest.importorskip("rawpy")
    rng = np.random.default_rng(seed)
    light = str(rng.choice(["D65", "A", "D50"]))
    camera = camera_of(
        BAYER[seed % 4], bits=14, black=float(rng.integers(0, 900)), colours=FILTERS[seed % 3](), share=0.4
    )
    camera = camera.noiseless()
    gray = Scene.from_rgb(picture(seed, (64, 80)).mean(0, keepdim=True).expand(3, -1, -1), depth=2.0, illuminant=light)
    uniform = Scene.from_rgb(picture(seed, (1, 1)).expand(3, 40, 52), depth=2.0, illuminant=light)
    detail = Scene.builtin("astronaut", size=128, illuminant=light)
    for scene, mean, most in ((uniform, 3e-4, 1e-3), (gray, 2e-3, 1e-2), (detail, None, None)):
        raw = Raw.from_camera(camera, camera.raw(scene), scene=scene)
        raw.write(tmp_path / "shot.dng")
        with rawpy.imread(str(tmp_path / "shot.dng")) as file:
            theirs = torch.from_numpy(by_libraw(file, raw)).permute(2, 0, 1)[None]
        inner = (..., slice(8, -8), slice(8, -8))
        ours = isp.develop(raw)
        off = (theirs - ours)[inner].abs()
        if mean is None:
            explained = (isp.develop(raw, method="bilinear") - isp.develop(raw, method="menon"))[inner].abs()
            assert off.mean() < explained.mean()
        else:
            assert off.mean() < mean
            assert off.max() < most


def test_quad_bayer_comes_back_by_its_tags(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    raw = taken(4, pattern="quad_bayer")[2]
    raw.write(tmp_path / "shot.dng")
    same(Raw.from_file(tmp_path / "shot.dng"), raw, atol=2e-7)


def test_a_monochrome_sensor_goes_out_and_comes_back(tmp_path: Path) -> None:
    kodak = sensor.ColourFilter.kodak()
    camera = Camera(
        sensor.ColourFilter(kodak.coefficients[1:2], width=kodak.width), sensor.Exposure(), sensor.ADC(12),
        isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(),
    )  # fmt: skip
    scene = scene_of(1)
    raw = Raw.from_camera(camera, camera[:3](scene))
    assert raw.pattern is None
    torch.testing.assert_close(isp.develop(raw), camera(scene), atol=1e-5, rtol=0)
    raw.write(tmp_path / "shot.tif")
    same(Raw.from_file(tmp_path / "shot.tif"), raw, atol=1e-7)
    rawpy = pytest.importorskip("rawpy")
    raw.write(tmp_path / "shot.dng")
    with rawpy.imread(str(tmp_path / "shot.dng")) as file:
        assert np.array_equal(file.raw_image_visible, raw.mosaic[0, 0].numpy())
    same(Raw.from_file(tmp_path / "shot.dng"), raw, atol=1e-7)


def foreign(path: Path, words: np.ndarray, *, pattern: str, active: tuple[int, int, int, int], **tags: Any) -> None:
    """A DNG as another camera writes it: margins around the active area, levels of each cell, another light first."""
    tile = np.array(PATTERNS[pattern], dtype=np.uint8)
    one = (0, 1, 1, 1, 0, 1)
    extra = [
        (50706, "B", 4, bytes((1, 4, 0, 0)), True), (50708, "s", 8, b"Other X\0", True),
        (33421, "H", 2, tile.shape, True), (33422, "B", tile.size, tile.tobytes(), True),
        (50829, "I", 4, active, True), (50713, "H", 2, (2, 2), True), (50714, "H", 4, tags["black"], True),
        (50717, "I", 1, tags["white"], True), (50728, "2I", 3, (1, 2, 1, 1, 3, 4), True),
        (50778, "H", 1, 17, True), (50721, "2i", 9, (1, 1, *one, *one, *one, 1, 1)[:18], True),
        (50779, "H", 1, 21, True), (50722, "2i", 9, tags["matrix"], True),
    ]  # fmt: skip
    tifffile.imwrite(path, words, photometric="cfa", extratags=extra, metadata=None, software=False)


@pytest.mark.parametrize("margins", [(0, 0), (2, 4), (1, 0), (0, 1), (3, 5)])
@pytest.mark.parametrize("pattern", BAYER)
def test_a_foreign_dng_is_read_in_its_active_area(pattern: str, margins: tuple[int, int], tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    top, left = margins
    words = np.random.default_rng(0).integers(300, 16000, (40 + top, 50 + left + 2)).astype(np.uint16)
    matrix = torch.tensor([[0.9, -0.2, -0.1], [-0.5, 1.2, 0.3], [-0.1, 0.3, 0.7]], dtype=torch.float64)
    parts = [part for value in matrix.flatten().tolist() for part in (round(10 * value), 10)]
    active = (top, left, top + 40, left + 50)
    above, beside = top % 2, left % 2  # LibRaw begins at even rows and columns
    odd = above or beside
    black = (256,) * 4 if odd else (256, 258, 260, 262)
    path = tmp_path / "foreign.dng"
    foreign(path, words, pattern=pattern, active=active, black=black, white=16000, matrix=tuple(parts))
    raw = Raw.from_file(path)
    first = words[top + above : top + 40, left + beside : left + 50]
    assert np.array_equal(raw.mosaic[0, 0].numpy(), first)
    tile = np.array(PATTERNS[pattern])
    assert np.array_equal(PATTERNS[raw.pattern], np.roll(tile, (-above, -beside), (0, 1)))
    assert raw.black_level == 256 if odd else raw.black_level.tolist() == [[256, 258], [260, 262]]
    assert (raw.white_level, raw.camera, raw.neutral.tolist()) == (16000, "Other X", pytest.approx([0.5, 1, 0.75]))
    torch.testing.assert_close(raw.colour_matrix, matrix)  # the one for daylight
    assert isp.develop(raw).isfinite().all()
    raw.write(tmp_path / "again.dng")
    same(Raw.from_file(tmp_path / "again.dng"), raw, atol=1e-6)


def test_a_dng_with_a_preview_first_is_read_below_it(tmp_path: Path) -> None:
    """As Adobe's converter writes it: colours beside an 8-bit preview, mosaic and noise (per colour) in a SubIFD."""
    pytest.importorskip("rawpy")
    words = np.random.default_rng(0).integers(300, 16000, (64, 80)).astype(np.uint16)
    matrix = (9, 10, -2, 10, -1, 10, -5, 10, 12, 10, 3, 10, -1, 10, 3, 10, 7, 10)
    outer = [
        (50706, "B", 4, bytes((1, 4, 0, 0)), True), (50708, "s", 8, b"Other X\0", True),
        (50728, "2I", 3, (1, 2, 1, 1, 3, 4), True), (50778, "H", 1, 21, True), (50721, "2i", 9, matrix, True),
        (50730, "2i", 1, (-1, 4), True),
    ]  # fmt: skip
    inner = [
        (33421, "H", 2, (2, 2), True), (33422, "B", 4, b"\1\2\0\1", True), (50714, "H", 1, 256, True),
        (50717, "I", 1, 16000, True), (51041, "d", 6, (1e-4, 1e-7, 2e-4, 1e-7, 3e-4, 1e-7), True),
    ]  # fmt: skip
    preview = np.full((16, 20, 3), 90, np.uint8)
    with tifffile.TiffWriter(tmp_path / "preview.dng") as file:
        options: dict[str, Any] = {"metadata": None, "software": False}
        file.write(preview, photometric="rgb", subifds=1, subfiletype=1, extratags=outer, **options)
        file.write(words, photometric="cfa", subfiletype=0, extratags=inner, **options)
    raw = Raw.from_file(tmp_path / "preview.dng")
    assert (raw.pattern, raw.black_level, raw.white_level, raw.camera) == ("GBRG", 256, 16000, "Other X")
    assert np.array_equal(raw.mosaic[0, 0].numpy(), words)
    assert raw.baseline_exposure == -0.25
    assert raw.noise_profile == pytest.approx((2e-4, 1e-7))
    np.testing.assert_allclose(raw.colour_matrix, np.reshape(fractions(matrix), (3, 3)))


def test_x_trans_begins_where_its_pattern_does(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    raw = taken(4, pattern="x_trans")[2]
    raw.write(tmp_path / "shot.dng")
    content = bytearray((tmp_path / "shot.dng").read_bytes())
    for at in directory(content):  # the pattern in the tag begins at the active area, so both are moved
        if struct.unpack_from("<H", content, at)[0] == 33422:
            (place,) = struct.unpack_from("<I", content, at + 8)
            tile = np.roll(np.array(PATTERNS["x_trans"], dtype=np.uint8), (2, 4), (0, 1))
            content[place : place + 36] = tile.tobytes()
    (tmp_path / "moved.dng").write_bytes(content)
    moved = Raw.from_file(tmp_path / "moved.dng")
    assert moved.pattern == "x_trans"
    assert torch.equal(moved.mosaic, raw.mosaic[..., 2:, 4:])


# ---------------------------------------------------------------------------------------------- gradients


@pytest.mark.parametrize("pattern", ["RGGB", "x_trans", None])
def test_develop_passes_gradcheck(pattern: str | None) -> None:
    generator = torch.Generator().manual_seed(0)
    mosaic = 200 + 400 * torch.rand(1, 1, 6, 7, generator=generator, dtype=torch.float64)
    known = {} if pattern is None else {"neutral": [0.6, 1.0, 0.8], "colour_matrix": spectral.xyz_to_srgb_matrix()}

    def picture(mosaic: torch.Tensor) -> torch.Tensor:
        return isp.develop(Raw(mosaic, pattern=pattern, black_level=64, white_level=1023, **known))

    assert torch.autograd.gradcheck(picture, mosaic.requires_grad_())


def test_the_gradient_goes_from_the_developed_picture_to_the_scene() -> None:
    camera = camera_of().noiseless()
    bands = (0.5 * torch.rand(1, 28, 12, 12, generator=torch.Generator().manual_seed(0))).requires_grad_()
    raw = Raw.from_camera(camera, camera.raw(bands))
    (ours,) = torch.autograd.grad(isp.develop(raw).sum(), bands, retain_graph=True)
    (expected,) = torch.autograd.grad(camera(bands).sum(), bands)
    torch.testing.assert_close(ours, expected, rtol=1e-3, atol=1e-5)


# ---------------------------------------------------------------------------------------------- hard cases

RAW = torch.rand(1, 1, 8, 8, generator=torch.Generator().manual_seed(0))
RIGHT = Camera(sensor.Mosaic(), sensor.ADC(12), isp.Demosaic())


@pytest.mark.parametrize(
    ("camera", "raw", "error", "match"),
    [
        ("phone", RAW, TypeError, "must be a kcam.Camera"),
        (RIGHT, RAW.numpy(), TypeError, "camera.raw"),
        (RIGHT, (4095 * RAW).int(), TypeError, "float tensor"),
        (RIGHT, 4095 * RAW, ValueError, "0..1"),
        (RIGHT, RAW - 1, ValueError, "0..1"),
        (RIGHT, RAW / 0, ValueError, "0..1"),
        (RIGHT, RAW * math.nan, ValueError, "NaN"),
        (RIGHT, RAW[0], ValueError, r"\(1,1,H,W\)"),
        (RIGHT, RAW[..., :0], ValueError, "at least one pixel"),
        (RIGHT, RAW.expand(2, 1, 8, 8), ValueError, r"batch of 2.*one\[None\]"),
        (RIGHT, RAW.expand(1, 3, 8, 8), ValueError, "3 full planes"),
        (Camera(sensor.Mosaic(), isp.Demosaic()), RAW, ValueError, "no ADC.*bits=12"),
        (Camera(sensor.Mosaic(), sensor.ADC(8), isp.Demosaic()), RAW, ValueError, "8 bits are refused"),
        (Camera(sensor.Mosaic("rgbw"), sensor.ADC(), isp.Demosaic()), RAW, ValueError, "white pixels"),
        (Camera(sensor.ColourFilter.learned(4), sensor.ADC(), isp.LearnedDemosaic()), RAW, ValueError, "learned tile"),
        (
            Camera(sensor.Mosaic(), sensor.ADC(black_level=torch.ones(1, 1, 8, 8)), isp.Demosaic()),
            RAW, ValueError, "one finite number",
        ),
        (
            Camera(sensor.Mosaic(), sensor.ADC(), isp.Demosaic(), isp.ColourMatrix(torch.ones(3, 3))),
            RAW, ValueError, "no light becomes gray",
        ),
    ],
)  # fmt: skip
def test_what_no_raw_file_can_hold_is_refused(camera: Any, raw: Any, error: type[Exception], match: str) -> None:
    with pytest.raises(error, match=match):
        Raw.from_camera(camera, raw)


@pytest.mark.parametrize(
    ("changes", "error", "match"),
    [
        ({"mosaic": torch.zeros(1, 1, 4, 4, dtype=torch.uint8)}, ValueError, "8 bits are refused"),
        ({"mosaic": torch.zeros(1, 1, 4, 4, dtype=torch.float16)}, ValueError, "does not hold 16 bits"),
        ({"mosaic": torch.zeros(1, 3, 4, 4)}, ValueError, "one plane"),
        ({"mosaic": torch.full((1, 1, 4, 4), math.nan)}, ValueError, "got NaN"),
        ({"mosaic": torch.full((1, 1, 4, 4), -3.0)}, ValueError, "got -3"),
        ({"mosaic": [[1]]}, TypeError, "tensor"),
        ({"white_level": 255}, ValueError, "8 bits are refused"),
        ({"white_level": math.inf}, ValueError, "finite"),
        ({"black_level": 1023}, ValueError, "below the white level of 1023 DN, such as 64, got 1023"),
        ({"black_level": -1}, ValueError, "got -1"),
        ({"black_level": math.nan}, ValueError, "got nan"),
        ({"black_level": torch.ones(3)}, ValueError, r"fits no RGGB sensor.*\(2, 2\)"),
        ({"pattern": "RGBG"}, ValueError, "RGGB, GRBG"),
        ({"pattern": "rgbw"}, ValueError, "white pixels"),
        ({"neutral": [0.5, 0.0, 1.0]}, ValueError, "above 0"),
        ({"neutral": [0.5, 1.0]}, ValueError, "3 finite numbers"),
        ({"colour_matrix": torch.full((3, 3), math.nan)}, ValueError, "3 x 3 finite"),
        ({"colour_matrix": torch.ones(3, 3)}, ValueError, "cannot be inverted"),
        ({"exposure_time": 0.0}, ValueError, "exposure_time"),
        ({"noise_profile": (1e-4, math.nan)}, ValueError, "noise_profile must be 2 finite numbers"),
        ({"camera": None}, TypeError, "the camera's name"),
    ],
)
def test_fields_that_cannot_be_are_refused(changes: dict[str, Any], error: type[Exception], match: str) -> None:
    fields = {"mosaic": torch.zeros(1, 1, 4, 4), "pattern": "RGGB", "black_level": 64, "white_level": 1023}
    Raw(**fields)
    with pytest.raises(error, match=match):
        Raw(**(fields | changes))


def test_what_is_not_known_is_asked_for() -> None:
    raw = Raw(torch.full((1, 1, 8, 8), 500), pattern="RGGB", black_level=64, white_level=1023)
    with pytest.raises(ValueError, match=r"neutral.*dataclasses.replace\(raw, neutral="):
        isp.develop(raw)
    with pytest.raises(ValueError, match=r"colours of this camera.*colour_matrix="):
        isp.develop(dataclasses.replace(raw, neutral=[0.6, 1.0, 0.8]))
    with pytest.raises(TypeError, match=r"takes a kcam.Raw, got a tensor"):
        isp.develop(raw.mosaic)
    with pytest.raises(ValueError, match="unknown"):
        isp.develop(Camera_raw(), method="best")


def Camera_raw() -> Raw:
    return Raw.from_camera(RIGHT, RAW)


def test_files_that_cannot_be_written_are_refused(tmp_path: Path) -> None:
    raw = Camera_raw()
    for name in ("shot.png", "shot.jpg", "shot.nef", "shot"):
        with pytest.raises(ValueError, match=r"16 bits.*Use shot.dng"):
            raw.write(tmp_path / name)
    with pytest.raises(ValueError, match="no folder"):
        raw.write(tmp_path / "nowhere" / "shot.dng")
    (tmp_path / "folder.dng").mkdir()
    with pytest.raises(ValueError, match="there is a folder"):
        raw.write(tmp_path / "folder.dng")
    with pytest.raises(ValueError, match=r"1.04858e\+06 DN do not fit.*ADC\(bits=16\)"):
        Raw.from_camera(Camera(sensor.Mosaic(), sensor.ADC(20), isp.Demosaic()), RAW).write(tmp_path / "shot.npy")
    bare = dataclasses.replace(raw, colour_matrix=None)
    with pytest.raises(ValueError, match="colour matrix.*or write .tif"):
        bare.write(tmp_path / "shot.dng")
    assert [path.name for path in tmp_path.iterdir()] == ["folder.dng"]


def test_files_that_cannot_be_read_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileNotFoundError, match="there is no file"):
        Raw.from_file(tmp_path / "photo.nef")
    with pytest.raises(FileNotFoundError, match="is a folder"):
        Raw.from_file(tmp_path)
    with pytest.raises(TypeError, match="name of a file"):
        Raw.from_file(RAW)  # type: ignore[arg-type]
    path = tmp_path / "a.tif"
    path.write_bytes(b"no TIFF")
    with pytest.raises(ValueError, match="damaged, or no TIFF"):
        Raw.from_file(path)
    tifffile.imwrite(path, np.zeros((8, 8), np.uint8))
    with pytest.raises(ValueError, match="uint8.*8 bits are refused"):
        Raw.from_file(path)
    tifffile.imwrite(path, np.zeros((8, 8), np.uint16))
    with pytest.raises(ValueError, match="BlackLevel and WhiteLevel"):
        Raw.from_file(path)
    Camera_raw().write(tmp_path / "shot.dng")
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(ImportError, match=r"pip install 'kcam\[raw\]'"):
        Raw.from_file(tmp_path / "shot.dng")


def refused_by_name(path: Path) -> bool:
    """Whether a file is refused; that by another error than one that names it is raised."""
    try:
        Raw.from_file(path)
    except ValueError as error:
        if path.name in str(error):
            return True
        raise
    return False


@pytest.mark.parametrize("suffix", [".tif", ".dng"])
@pytest.mark.parametrize("seed", range(3))
def test_damaged_tags_are_an_error_that_names_the_file(seed: int, suffix: str, tmp_path: Path) -> None:
    """Numbers written over in what stands beside the pixels: read, or refused by name."""
    if suffix == ".dng":
        pytest.importorskip("rawpy")
    generator = np.random.default_rng(seed)
    whole, path = tmp_path / f"whole{suffix}", tmp_path / f"torn{suffix}"
    taken(seed)[2].write(whole)
    with tifffile.TiffFile(whole) as file:
        own = [tag for tag in file.pages.first.tags if tag.code >= 33421]
        entries = [at for tag in own for at in range(tag.offset + 2, tag.offset + 12)]
        values = [at for tag in own for at in range(tag.valueoffset, tag.valueoffset + tag.valuebytecount)]
    content, refused = whole.read_bytes(), 0
    for _ in range(60):
        torn = bytearray(content)
        for at in generator.choice(entries + values, size=generator.integers(1, 6)):
            torn[at] = generator.choice([0, 1, 2, 255])
        path.write_bytes(torn)
        refused += refused_by_name(path)
    assert refused


@pytest.mark.parametrize(
    ("code", "dtype", "count", "value"),
    [(50714, "2I", 1, (64, 0)), (50713, "H", 2, (3, 3)), (33421, "H", 2, (4, 4)), (51041, "d", 1, (1e-4,))],
    ids=["a black level over nothing", "black levels of no tile", "a mosaic of no tile", "half a noise profile"],
)
def test_tags_that_do_not_fit_each_other(code: int, dtype: str, count: int, value: Any, tmp_path: Path) -> None:
    tags = {
        33421: (33421, "H", 2, (2, 2), True),
        33422: (33422, "B", 4, bytes((0, 1, 1, 2)), True),
        50714: (50714, "H", 1, 64, True),
        50717: (50717, "I", 1, 1023, True),
    }
    tags[code] = (code, dtype, count, value, True)
    path = tmp_path / "odd.tif"
    tifffile.imwrite(path, np.full((8, 8), 100, np.uint16), photometric="minisblack", extratags=[*tags.values()])
    with pytest.raises(ValueError, match=r"odd\.tif"):
        Raw.from_file(path)


def test_libraw_s_refusals_name_the_file(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    camera = camera_of()
    Raw.from_camera(camera, camera.raw(scene_of(0))).write(tmp_path / "shot.dng")
    whole = (tmp_path / "shot.dng").read_bytes()
    for content in (b"", b"photo", whole[:300], whole[: len(whole) // 3]):
        (tmp_path / "cut.dng").write_bytes(content)
        with pytest.raises(ValueError, match=r"cut.dng is damaged, or no raw file"):
            Raw.from_file(tmp_path / "cut.dng")
    from PIL import Image

    buffer = io.BytesIO()
    Image.new("RGB", (64, 64)).save(buffer, "JPEG")
    (tmp_path / "photo.jpg").write_bytes(buffer.getvalue())
    with pytest.raises(ValueError, match="photo.jpg"):
        Raw.from_file(tmp_path / "photo.jpg")
    linear = [(50706, "B", 4, bytes((1, 4, 0, 0)), True), (50708, "s", 2, b"X\0", True)]
    tifffile.imwrite(
        tmp_path / "full.dng",
        np.zeros((64, 64, 3), np.uint16),
        photometric="linear_raw",
        extratags=linear,
        metadata=None,
    )
    with pytest.raises(ValueError, match="full.dng holds full colours"):
        Raw.from_file(tmp_path / "full.dng")


def test_values_at_the_ends_stay_finite() -> None:
    for value in (0.0, 1.0):
        raw = Raw.from_camera(RIGHT, torch.full((1, 1, 1, 1), value))
        assert isp.develop(raw).isfinite().all()
    above = dataclasses.replace(raw, mosaic=torch.full((1, 1, 3, 5), 60_000.0))  # hot pixels above the white level
    assert isp.develop(above).max() == 1


def test_the_version_is_importable() -> None:
    assert kcam.Raw is Raw
