"""White balance, colour matrix and tone: the ISP's functions with the drawn numbers, and Planck's law."""

from __future__ import annotations

import warnings

import pytest
import torch
from drawing import BANDS, PRIMARIES, augmented, coded, in_light, picture, relative
from scipy import constants
from torch import Tensor

import kcam.augmentation as KC
from kcam import isp, spectral
from kcam.augmentation.isp import planck_ratio
from kcam.units import nm, wavelength_grid

DAYLIGHT = 6504.0  # K, the correlated colour temperature of D65 in CIE 15


def planck(wavelengths: Tensor, temperature: float) -> Tensor:
    exponent = constants.h * constants.c / constants.k / (wavelengths * temperature)
    return 2 * constants.h * constants.c**2 / wavelengths**5 / torch.expm1(exponent)


class TestPlanckRatio:
    @pytest.mark.parametrize("temperature", [1000.0, 2856.0, 6504.0, 1e5])
    def test_is_plancks_law(self, temperature: float) -> None:
        grid, green = BANDS, wavelength_grid([550 * nm])
        expected = planck(grid, temperature) / planck(grid, DAYLIGHT)
        expected = expected * planck(green, DAYLIGHT) / planck(green, temperature)
        found = planck_ratio(grid, temperature=torch.tensor([temperature], dtype=torch.float64))[0]
        # the second radiation constant has seven digits in the code: 1e-7 of an exponent of up to 35
        assert relative(found / expected, torch.ones(28, dtype=torch.float64)) < 1e-5

    def test_is_colour_sciences_black_body(self, colour) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            bodies = [
                colour.sd_blackbody(kelvin, colour.SpectralShape(420, 720, 10)).values for kelvin in (3200.0, DAYLIGHT)
            ]
        expected = torch.as_tensor(bodies[0] / bodies[1])
        grid = wavelength_grid([band * nm for band in range(420, 721, 10)])
        found = planck_ratio(grid, temperature=torch.tensor([3200.0], dtype=torch.float64))[0]
        assert relative(found, expected / expected[13]) < 2e-5  # CODATA of another year; 550 nm is band 13


class TestWhiteBalance:
    def test_a_picture_gets_the_gains_that_the_light_leaves(self) -> None:
        signal = picture(3, 3, 8, 9)
        result, drawn = augmented(KC.RandomWhiteBalance(p=1.0), signal)
        for index in range(3):
            gains = planck_ratio(PRIMARIES, temperature=drawn["temperature"][index : index + 1])[0]
            gains = gains * torch.tensor([1.0, 2 ** float(drawn["tint"][index]), 1.0], dtype=torch.float64)
            expected = isp.white_balance(in_light(signal)[index : index + 1], gains=gains)
            assert relative(result[index : index + 1], coded(expected, like=signal)) < 1e-12

    def test_daylight_changes_nothing_and_lamps_are_red(self) -> None:
        signal = 0.5 * picture(1, 3, 4, 4)
        augmentation = KC.RandomWhiteBalance(DAYLIGHT, 0.0, p=1.0)
        result, _ = augmented(augmentation, signal)
        assert (result - signal).abs().max() < 1e-6  # sRGB's two pieces meet to 1e-7
        warm, _ = augmented(KC.RandomWhiteBalance(3000.0, 0.0, p=1.0), signal)
        assert (warm[:, 0] > signal[:, 0]).all()
        assert (warm[:, 2] < signal[:, 2]).all()
        assert (warm[:, 1] - signal[:, 1]).abs().max() < 3e-3  # the ratio is 1 at 550 nm, 0.8 % off at 549.1

    def test_a_cube_is_lit_by_illuminant_a(self) -> None:
        """A is a black body of 2856 K by definition, in CIE's table."""
        cube = picture(1, 28, 5, 6)
        result, _ = augmented(KC.RandomWhiteBalance(2856.0, p=1.0), cube)
        lamp = spectral.illuminant("A", wavelengths=BANDS)
        daylight = planck(BANDS, DAYLIGHT)
        expected = cube * (lamp / daylight)[:, None, None]
        # kcam's lamp is averaged over each band, which adds 0.7 % at the blue end, and scaled to Y = 1, not at 550 nm
        scale = float((result / expected).mean())
        assert relative(result, scale * expected) < 0.01
        assert (
            float((result[:, -1] / cube[:, -1]).mean() / (result[:, 0] / cube[:, 0]).mean()) > 5
        )  # and it is no small thing

    def test_gray_stays(self) -> None:
        signal = picture(2, 1, 4, 5)
        augmentation = KC.RandomWhiteBalance(p=1.0)
        _, drawn = augmented(augmentation, signal)
        assert torch.equal(augmentation.simulate(signal, drawn), signal)


class TestColourMatrix:
    def test_is_a_colour_matrix_that_keeps_white(self) -> None:
        signal = picture(3, 3, 6, 7)
        augmentation = KC.RandomColourMatrix((0.05, 0.2), p=1.0)
        result, drawn = augmented(augmentation, signal)
        for index, matrix in enumerate(augmentation.matrix(drawn)):
            stage = isp.ColourMatrix(matrix)
            expected = stage(in_light(signal)[index : index + 1])
            assert relative(result[index : index + 1], coded(expected, like=signal)) < 1e-12
            assert torch.allclose(matrix.sum(1), torch.ones(3, dtype=torch.float64))
        white, _ = augmented(augmentation, torch.ones(3, 3, 4, 4, dtype=torch.float64))
        assert (white - 1).abs().max() < 1e-9
        gray, _ = augmented(augmentation, torch.full((3, 3, 4, 4), 0.4, dtype=torch.float64))
        assert (gray - 0.4).abs().max() < 1e-6  # sRGB's two pieces meet to 1e-7

    def test_off_diagonals_spread_by_the_strength(self) -> None:
        augmentation = KC.RandomColourMatrix(0.1, p=1.0)
        _, drawn = augmented(augmentation, torch.rand(400, 3, 1, 1))
        mixed = augmentation.matrix(drawn)[:, ~torch.eye(3, dtype=torch.bool)]
        assert float(mixed.std()) == pytest.approx(0.1, rel=5 / (2 * mixed.numel()) ** 0.5)  # 5 standard errors

    def test_it_needs_three_channels(self) -> None:
        with pytest.raises(ValueError, match="mixes red, green and blue, got 28 channels"):
            KC.RandomColourMatrix(p=1.0)(picture(1, 28, 4, 4))


class TestToneCurve:
    @pytest.mark.parametrize("gamma", [0.1, 0.7, 1.0, 1.4, 10.0])
    @pytest.mark.parametrize("contrast", [-0.49, 0.0, 0.49])
    @pytest.mark.parametrize("channels", [3, 28])
    def test_rises_and_keeps_black_and_white(self, gamma: float, contrast: float, channels: int) -> None:
        ramp = torch.linspace(0, 1, 1001, dtype=torch.float64).expand(1, channels, 1, -1)
        result, _ = augmented(KC.RandomToneCurve(gamma, contrast, p=1.0), ramp)
        assert (result.diff() > 0).all()
        assert (result[..., 0].abs().max(), (result[..., -1] - 1).abs().max()) < (1e-12, 1e-12)

    def test_neutral_numbers_change_nothing(self) -> None:
        signal = picture(1, 3, 5, 6)
        result, _ = augmented(KC.RandomToneCurve(1.0, 0.0, p=1.0), signal)
        assert (result - signal).abs().max() < 1e-12

    def test_is_its_formula(self) -> None:
        signal = picture(3, 3, 5, 6)
        result, drawn = augmented(KC.RandomToneCurve(p=1.0), signal)
        for index in range(3):
            gamma, c = (float(drawn[name][index]) for name in ("gamma", "contrast"))
            u = ((signal[index] + 0.01) ** gamma - 0.01**gamma) / (1.01**gamma - 0.01**gamma)
            assert relative(result[index], u + 2 * c * u * (1 - u) * (2 * u - 1)) < 1e-12


COLOUR = {"white_balance": KC.RandomWhiteBalance, "colour_matrix": KC.RandomColourMatrix, "tone": KC.RandomToneCurve}
on_colour = pytest.mark.parametrize("name", sorted(COLOUR))


@on_colour
@pytest.mark.parametrize("level", [0.0, 1.0])
@pytest.mark.parametrize("shape", [(1, 1), (2, 3)])
def test_black_white_and_tiny_pictures(name: str, level: float, shape: tuple[int, int]) -> None:
    signal = torch.full((2, 3, *shape), level, requires_grad=True)
    result, _ = augmented(COLOUR[name](p=1.0), signal)
    assert result.shape == signal.shape
    assert 0 <= float(result.detach().min()) <= float(result.detach().max()) <= 1
    if level == 0:
        assert result.detach().abs().max() < 1e-6
    result.square().sum().backward()
    assert signal.grad.isfinite().all()


@pytest.mark.parametrize(
    ("name", "channels"), [("white_balance", 3), ("white_balance", 28), ("colour_matrix", 3), ("tone", 3), ("tone", 28)]
)
def test_float32_is_close_to_float64(name: str, channels: int) -> None:
    augmentation, light = COLOUR[name](p=1.0), picture(2, channels, 8, 9)
    _, drawn = augmented(augmentation, light)
    single = augmentation.simulate(light.float(), drawn)
    assert single.dtype == torch.float32
    assert relative(single.double(), augmentation.simulate(light, drawn)) < 1e-6  # a few roundings of 6e-8


@on_colour
def test_gradients_to_the_light_and_to_every_drawn_number(name: str) -> None:
    augmentation, light = COLOUR[name](p=1.0), 0.1 + 0.8 * picture(2, 3, 2, 3)
    _, drawn = augmented(augmentation, light)
    scale = {"temperature": 1e3}  # kelvin, of which 1e-6 is no step

    def simulate(light: Tensor, *numbers: Tensor) -> Tensor:
        named = dict(zip(drawn, numbers, strict=True))
        return augmentation.simulate(light, {key: value * scale.get(key, 1) for key, value in named.items()})

    numbers = [(value.double() / scale.get(key, 1)).requires_grad_() for key, value in drawn.items()]
    assert torch.autograd.gradcheck(simulate, [light.requires_grad_(), *numbers], eps=1e-6, atol=1e-7)
