"""Sensor augmentations are the sensor's own functions with the drawn numbers, and keep the statistics of EMVA 1288."""

from __future__ import annotations

import math

import pytest
import torch
from drawing import BANDS, augmented, coded, in_light, picture, relative
from kornia.color.raw import CFA, raw_to_rgb, rgb_to_raw
from torch import Tensor

import kcam.augmentation as KC
from kcam import Camera, Context, isp, sensor, spectral
from kcam.augmentation.sensor import BAYER
from kcam.isp.demosaic import DOMAINS
from kcam.ste import clip_ste
from kcam.units import wavelength_grid

CFAS = {"RGGB": CFA.BG, "GRBG": CFA.GB, "BGGR": CFA.RG, "GBRG": CFA.GR}
"""Kornia names a pattern by its pixel (1, 1)."""
ROUNDING = 1e-12  # of float64; vectorised powers differ in the last bit with the place of a number in memory


class TestBayer:
    @pytest.mark.parametrize("shape", [(12, 14), (13, 11), (7, 8)])
    @pytest.mark.parametrize("method", [None, "bilinear", "difference"])
    @pytest.mark.parametrize("pattern", [*BAYER, "quad_bayer", "x_trans"])
    def test_is_mosaic_and_demosaic_in_linear_light(
        self, pattern: str, method: str | None, shape: tuple[int, int]
    ) -> None:
        signal = picture(2, 3, *shape)
        result, _ = augmented(KC.RandomBayer(pattern, method=method), signal)
        recorded = sensor.mosaic(in_light(signal), pattern=pattern)
        expected = isp.demosaic(recorded, pattern=pattern, method=method)
        assert torch.equal(result, coded(expected, like=signal))

    def test_each_row_has_the_pattern_that_it_drew(self) -> None:
        signal = picture(12, 3, 9, 10)
        result, drawn = augmented(KC.RandomBayer(), signal)
        assert set(drawn["pattern"].tolist()) == {0, 1, 2, 3}
        for index, pattern in enumerate(drawn["pattern"].tolist()):
            alone, _ = augmented(KC.RandomBayer(BAYER[pattern]), signal[index : index + 1])
            assert (result[index : index + 1] - alone).abs().max() < ROUNDING

    @pytest.mark.parametrize("pattern", BAYER)
    def test_kornia_gives_the_same(self, pattern: str) -> None:
        signal = picture(2, 3, 12, 14)
        result, _ = augmented(KC.RandomBayer(pattern, method="kornia"), signal)
        encode, decode = DOMAINS["sqrt"]  # kcam interpolates on the root, where Kornia takes what it is given
        theirs = decode(raw_to_rgb(encode(rgb_to_raw(in_light(signal), CFAS[pattern])), CFAS[pattern]))
        assert (result - coded(theirs, like=signal)).abs().max() < ROUNDING

    def test_gray_keeps_its_channel(self) -> None:
        signal = picture(1, 1, 6, 7)
        result, _ = augmented(KC.RandomBayer("RGGB"), signal)
        assert result.shape == signal.shape

    @pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "rgbw"])
    @pytest.mark.parametrize("count", [28, 7])
    def test_a_cube_becomes_the_picture_of_a_noiseless_camera(self, pattern: str, count: int) -> None:
        cube = picture(2, count, 12, 15)
        result, _ = augmented(KC.RandomBayer(pattern), cube)
        own = sensor.ColourFilter.rgbw() if pattern == "rgbw" else sensor.ColourFilter.kodak()
        camera = Camera(
            own,
            sensor.Mosaic(pattern),
            sensor.Exposure(),
            isp.Demosaic(),
            isp.WhiteBalance(),
            isp.ColourMatrix(),
            isp.ToneCurve(),
            context=Context(wavelengths=wavelength_grid(count=count)),
        )
        assert result.shape == (2, 3, 12, 15)
        assert torch.equal(result, camera(cube))

    def test_a_white_cube_is_a_white_picture(self) -> None:
        """Of a cube a perfect white has the spectrum of daylight, relative: Y = 1."""
        white = spectral.illuminant("D65", wavelengths=BANDS)[:, None, None].expand(1, -1, 8, 8)
        for level in (1.0, 0.3):
            result, _ = augmented(KC.RandomBayer("RGGB"), level * white)
            expected = coded(torch.full((1, 3, 8, 8), level, dtype=torch.float64), like=result)
            assert (result - expected).abs().max() < 1e-6  # balanced by the same sums over the bands

    def test_a_cube_needs_p_1(self) -> None:
        with pytest.raises(ValueError, match=r"turns 28 channels into 3.*Use p=1.0, not p=0.5"):
            KC.RandomBayer("RGGB", p=0.5)(picture(2, 28, 4, 4))


class TestShotReadNoise:
    @pytest.mark.parametrize("channels", [1, 3, 28])
    def test_is_shot_noise_and_read_noise_from_the_drawn_seed(self, channels: int) -> None:
        signal = picture(3, channels, 9, 10)
        augmentation = KC.RandomShotReadNoise(p=1.0, full_well=(500.0, 20_000.0), read_noise=(1.0, 8.0))
        result, drawn = augmented(augmentation, signal)
        light = in_light(signal)
        for index in range(3):
            gain, well, sigma = (float(drawn[name][index]) for name in ("iso", "full_well", "read_noise"))
            gain /= 100
            generator = torch.Generator().manual_seed(int(drawn["noise_seed"][index]))
            counted = sensor.shot_noise(light[index : index + 1] / gain, full_well=well, generator=generator)
            read = sensor.read_noise(counted, sigma_electrons=sigma, full_well=well, generator=generator)
            expected = clip_ste(read * gain, None, 1.0)
            found = augmentation.simulate(
                light[index : index + 1], {name: value[index : index + 1] for name, value in drawn.items()}
            )
            assert torch.equal(found, expected)
            assert (result[index : index + 1] - coded(expected, like=signal)).abs().max() < ROUNDING
        assert len(set(drawn["noise_seed"].tolist())) == 3

    @pytest.mark.parametrize("iso", [100.0, 800.0, 3200.0])
    @pytest.mark.parametrize("level", [0.0, 0.01, 0.2, 0.6])
    def test_variance_against_mean_is_the_photon_transfer_line(self, iso: float, level: float) -> None:
        """var = (g / w) x + (g sigma / w)^2 and an unbiased mean, each within 5 standard errors of 160 000 pixels."""
        well, sigma, count = 10_000.0, 3.0, 160_000
        augmentation = KC.RandomShotReadNoise(iso, full_well=well, read_noise=sigma, p=1.0)
        light = torch.full((4, 5, 100, 100), level, dtype=torch.float64)
        _, drawn = augmented(augmentation, light)
        found = augmentation.simulate(light, drawn)
        gain = iso / 100
        variance = gain / well * level + (gain * sigma / well) ** 2
        assert level + 5 * math.sqrt(variance) < 1  # nothing saturates
        assert float(found.mean()) == pytest.approx(level, abs=5 * math.sqrt(variance / count))
        # var(s^2) = variance^2 (2 + kurtosis) / count, and a Poisson's excess is 1 / N
        electrons = max(level * well / gain, sigma**2)
        spread = variance * math.sqrt((2 + 1 / electrons) / count)
        assert float(found.var()) == pytest.approx(variance, abs=5 * spread)

    def test_neighbours_channels_and_samples_are_independent(self) -> None:
        augmentation = KC.RandomShotReadNoise(1600.0, p=1.0)
        light = torch.full((2, 3, 150, 150), 0.3, dtype=torch.float64)
        _, drawn = augmented(augmentation, light)
        noise = augmentation.simulate(light, drawn) - 0.3
        noise = noise / noise.std()
        pairs = {
            "neighbours": (noise[..., :-1], noise[..., 1:]),
            "rows": (noise[..., :-1, :], noise[..., 1:, :]),
            "channels": (noise[:, :-1], noise[:, 1:]),
            "samples": (noise[0], noise[1]),
        }
        for name, (one, other) in pairs.items():
            assert abs(float((one * other).mean())) < 5 / math.sqrt(one.numel()), name

    def test_it_saturates_at_white_and_keeps_below_it_what_read_noise_takes(self) -> None:
        augmentation = KC.RandomShotReadNoise((100.0, 25_600.0), p=1.0)
        light = torch.full((8, 5, 30, 30), 1.0, dtype=torch.float64)
        _, drawn = augmented(augmentation, light)
        found = augmentation.simulate(light * 3, drawn)
        assert found.max() == 1  # and no more
        dark = augmentation.simulate(light * 0, drawn)
        assert dark.min() < 0  # no clipping at black, which would bias it: that is the tone curve's

    @pytest.mark.parametrize("level", [0.0, 1.0])
    def test_gradients_are_finite_at_black_and_white(self, level: float) -> None:
        signal = torch.full((2, 3, 6, 6), level, requires_grad=True)
        result, _ = augmented(KC.RandomShotReadNoise(p=1.0), signal)
        result.square().sum().backward()
        assert signal.grad.isfinite().all()

    def test_gradients_to_range_and_light_are_unbiased_in_the_mean(self) -> None:
        """d mean / d light is 1 at every level: the mean of `poisson`'s slope, within 5 standard errors."""
        augmentation = KC.RandomShotReadNoise(400.0, p=1.0)
        light = torch.full((1, 5, 100, 100), 0.2, dtype=torch.float64, requires_grad=True)
        _, drawn = augmented(augmentation, light)
        augmentation.simulate(light, drawn).sum().backward()
        spread = 0.5 / math.sqrt(0.2 * 10_000 / 4)  # (N - lambda) / 2 lambda
        assert float(light.grad.mean()) == pytest.approx(1, abs=5 * spread / math.sqrt(light.numel()))


class TestFixedPattern:
    @pytest.mark.parametrize("channels", [3, 28])
    def test_is_fixed_pattern_of_the_drawn_sensor(self, channels: int) -> None:
        signal = picture(3, channels, 9, 10)
        augmentation = KC.RandomFixedPattern(p=1.0, full_well=5000.0)
        result, drawn = augmented(augmentation, signal)
        for index in range(3):
            expected = sensor.fixed_pattern(
                in_light(signal)[index : index + 1],
                prnu=float(drawn["prnu"][index]),
                dsnu=float(drawn["dsnu"][index]),
                full_well=5000.0,
                seed=int(drawn["sensor_seed"][index]),
            )
            assert relative(result[index : index + 1], coded(expected, like=signal)) < 1e-12  # rounding

    def test_its_spread_is_the_drawn_one(self) -> None:
        augmentation = KC.RandomFixedPattern(prnu=0.02, dsnu=10.0, full_well=1000.0, p=1.0)
        bright = torch.full((1, 5, 100, 100), 0.5, dtype=torch.float64)
        _, drawn = augmented(augmentation, bright)
        dark = augmentation.simulate(bright * 0, drawn)
        assert float(dark.std()) == pytest.approx(0.01, rel=5 / math.sqrt(2 * dark.numel()))
        found = augmentation.simulate(bright, drawn) - dark - bright  # the offset is the same in every exposure
        assert float(found.std()) == pytest.approx(0.01, rel=5 / math.sqrt(2 * found.numel()))


@pytest.mark.parametrize("channels", [3, 28])
def test_exposure_is_a_gain_and_a_full_well(channels: int) -> None:
    signal = picture(4, channels, 6, 7)
    result, drawn = augmented(KC.RandomExposure((-3.0, 2.0), p=1.0), signal)
    expected = (in_light(signal) * 2 ** drawn["stops"][:, None, None, None]).clamp(0, 1)
    assert relative(result, coded(expected, like=signal)) < 1e-12
    assert (expected == 1).any()
    assert drawn["stops"].min() < 0 < drawn["stops"].max()


@pytest.mark.parametrize("channels", [3, 28])
def test_quantisation_is_that_of_the_adc(channels: int) -> None:
    signal = picture(16, channels, 6, 7)
    result, drawn = augmented(KC.RandomQuantisation((3, 6), p=1.0), signal)
    for index, choice in enumerate(drawn["bits"].tolist()):
        expected = sensor.quantise(in_light(signal)[index : index + 1], bits=3 + choice)
        assert (result[index : index + 1] - coded(expected, like=signal)).abs().max() < ROUNDING
        assert len(expected.unique()) <= 2 ** (3 + choice)
    assert set(drawn["bits"].tolist()) == {0, 1, 2, 3}


SENSOR = {
    "bayer": KC.RandomBayer(p=1.0),
    "exposure": KC.RandomExposure(p=1.0),
    "fixed_pattern": KC.RandomFixedPattern(p=1.0),
    "quantisation": KC.RandomQuantisation(p=1.0),
    "shot_read_noise": KC.RandomShotReadNoise(p=1.0),
}
on_sensor = pytest.mark.parametrize("name", sorted(SENSOR))


@on_sensor
@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (1, 8)])
def test_tiny_pictures(name: str, shape: tuple[int, int]) -> None:
    result, _ = augmented(SENSOR[name], picture(3, 3, *shape))
    assert result.shape == (3, 3, *shape)
    assert result.isfinite().all()
    assert 0 <= float(result.min()) <= float(result.max()) <= 1


@pytest.mark.parametrize("name", ["bayer", "exposure", "fixed_pattern", "quantisation"])
@pytest.mark.parametrize("channels", [3, 28])
def test_float32_is_close_to_float64(name: str, channels: int) -> None:
    light = in_light(picture(2, channels, 12, 13))
    if name == "quantisation":  # away from the steps' edges, where rounding decides
        light = (light * 15).floor() / 15 + 0.2 / 15
        augmentation = KC.RandomQuantisation(4, p=1.0)
    else:
        augmentation = SENSOR[name]
    _, drawn = augmented(augmentation, light)
    single = augmentation.simulate(light.float(), drawn)
    assert single.dtype == torch.float32
    # 3e-6: sums of 28 bands, a matrix and curves with a slope of up to 13, each rounded to 6e-8
    assert relative(single.double(), augmentation.simulate(light, drawn)) < 3e-6


@pytest.mark.parametrize("name", ["bayer", "fixed_pattern", "exposure"])
def test_gradients_to_the_light_and_to_every_drawn_number(name: str) -> None:
    augmentation = {
        "bayer": KC.RandomBayer("RGGB", method="bilinear"),
        "fixed_pattern": KC.RandomFixedPattern(p=1.0),
        "exposure": KC.RandomExposure((-2.0, -1.0), p=1.0),
    }[name]
    light = picture(2, 3, 5, 4)
    _, drawn = augmented(augmentation, light)
    smooth = {key: value for key, value in drawn.items() if value.is_floating_point()}
    fixed = {key: value for key, value in drawn.items() if key not in smooth}

    def simulate(light: Tensor, *numbers: Tensor) -> Tensor:
        return augmentation.simulate(light, dict(zip(smooth, numbers, strict=True)) | fixed)

    inputs = [light.requires_grad_(), *(value.clone().requires_grad_() for value in smooth.values())]
    assert torch.autograd.gradcheck(simulate, inputs, eps=1e-6, atol=1e-7)
