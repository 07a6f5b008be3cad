"""White balance, colour matrix and tone curve: white is white, and the colour chart within a stated delta-E."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from skimage.color import deltaE_ciede2000
from torch import Tensor, nn

from kcam import Camera, isp, sensor, spectral
from kcam.context import Context
from kcam.isp.colour import LEAST_WHITE
from kcam.sensor import ColourFilter

LIGHTS = ("D65", "D50", "A", "FL11")
FILTERS = {name: getattr(ColourFilter, name)() for name in ("kodak", "nikon", "sigma", "rgbw")}


def context(name: str, light: str = "D65", **fields) -> Context:
    grid = Context().wavelengths
    return Context(colour_filter=FILTERS[name], illuminant=spectral.illuminant(light, wavelengths=grid), **fields)


def chart(here: Context) -> Tensor:
    """The 24 patches and a perfect white as an exposed camera sees them, (25,C,1,1)."""
    reflectance = torch.cat([spectral.reflectances(here.wavelengths), torch.ones(1, 28, dtype=torch.float64)])
    bands = (reflectance * here.illuminant)[:, :, None, None]
    return sensor.Exposure()(here.colour_filter(bands, here), here)


def lab(linear_srgb: Tensor) -> np.ndarray:
    to_xyz = torch.linalg.inv(spectral.xyz_to_srgb_matrix())
    relative = (linear_srgb @ to_xyz.T / to_xyz.sum(1)).numpy()
    f = np.where(relative > 216 / 24389, np.cbrt(relative), (24389 / 27 * relative + 16) / 116)
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)


def chart_colours() -> Tensor:
    _, wavelengths, reflectances = spectral.colour_chart()
    return reflectances @ spectral.xyz_weights(wavelengths, "D65") @ spectral.xyz_to_srgb_matrix().T


class TestWhite:
    @pytest.mark.parametrize("light", LIGHTS)
    @pytest.mark.parametrize("name", FILTERS)
    def test_perfect_white_is_one(self, name: str, light: str) -> None:
        here = context(name, light, white_share=0.6)
        balanced = isp.WhiteBalance()(chart(here), here)
        torch.testing.assert_close(balanced[24], torch.full_like(balanced[24], 0.6), atol=1e-9, rtol=0)
        result = isp.ColourMatrix()(balanced, here)
        torch.testing.assert_close(result[24], torch.ones_like(result[24]), atol=1e-9, rtol=0)

    def test_gains_are_white_in_green_over_white(self) -> None:
        here = context("nikon", "A")
        white = FILTERS["nikon"].white(here.wavelengths, illuminant=here.illuminant)
        gains = isp.as_shot_gains(here)
        torch.testing.assert_close(gains, white[1] / white)
        assert gains[1] == 1
        assert gains[2] > 1.5 * gains[0]  # tungsten has little blue

    def test_defaults_are_kodak_and_d65(self) -> None:
        assert torch.equal(isp.as_shot_gains(Context()), isp.as_shot_gains(context("kodak")))
        assert torch.equal(isp.as_shot_gains(Context(), channels=4), isp.as_shot_gains(context("rgbw"), channels=4))
        picture = torch.rand(1, 3, 2, 2)
        torch.testing.assert_close(isp.ColourMatrix()(picture), isp.ColourMatrix()(picture, context("kodak")))

    def test_one_channel_becomes_gray(self) -> None:
        gray = torch.full((1, 1, 2, 2), 0.4)
        assert torch.equal(isp.WhiteBalance()(gray), gray)
        torch.testing.assert_close(isp.ColourMatrix()(gray), torch.full((1, 3, 2, 2), 0.5))

    def test_a_filter_that_sees_nothing_stays_finite(self) -> None:
        blind = Context(colour_filter=ColourFilter(torch.zeros(3, 12)))
        assert isp.as_shot_gains(blind).isfinite().all()
        assert isp.as_shot_colour_matrix(blind).isfinite().all()
        assert LEAST_WHITE > 0


class TestColourMatrix:
    # mean and largest delta-E2000 of the 24 patches, as measured
    @pytest.mark.parametrize(
        ("name", "light", "mean", "largest"),
        [
            ("kodak", "D65", 2.67, 7.46),
            ("nikon", "D65", 0.91, 2.93),
            ("sigma", "D65", 1.91, 4.61),
            ("rgbw", "D65", 2.46, 6.01),
            ("kodak", "A", 3.88, 10.04),
            ("nikon", "A", 2.15, 7.25),
            ("nikon", "FL11", 1.73, 5.51),
        ],
    )
    def test_chart(self, name: str, light: str, mean: float, largest: float) -> None:
        here = context(name, light)
        result = isp.ColourMatrix()(isp.WhiteBalance()(chart(here), here), here)[:24, :, 0, 0]
        error = deltaE_ciede2000(lab(result), lab(chart_colours()))
        assert abs(error.mean() - mean) < 0.1
        assert abs(error.max() - largest) < 0.5

    @pytest.mark.parametrize("channels", [1, 2, 3, 4])
    def test_fit_is_the_constrained_least_squares(self, channels: int) -> None:
        g = torch.Generator().manual_seed(channels)
        signals = torch.rand(24, channels, generator=g, dtype=torch.float64)
        colours = torch.rand(24, 3, generator=g, dtype=torch.float64)
        noise = 0.05
        matrix = isp.fit_colour_matrix(signals, colours=colours, noise=noise)
        torch.testing.assert_close(matrix.sum(1), torch.ones(3, dtype=torch.float64))
        # The same by elimination: the last column is 1 minus the others, and noise is K rows of data in sqrt(K).
        rows = torch.cat([signals, noise * 24**0.5 * torch.eye(channels, dtype=torch.float64)])
        targets = torch.cat([colours, torch.zeros(channels, 3, dtype=torch.float64)])
        free = rows[:, :-1] - rows[:, -1:]
        first = torch.linalg.lstsq(free, targets - rows[:, -1:]).solution.T
        torch.testing.assert_close(matrix, torch.cat([first, 1 - first.sum(1, keepdim=True)], 1))

    def test_identical_channels_share_the_work(self) -> None:
        signals = torch.linspace(0.1, 0.9, 24, dtype=torch.float64)[:, None].expand(-1, 3)
        matrix = isp.fit_colour_matrix(signals, colours=signals)
        torch.testing.assert_close(matrix, torch.full_like(matrix, 1 / 3))

    def test_a_camera_with_the_eyes_curves_is_exact(self) -> None:
        colours = chart_colours()
        mixing = torch.tensor([[0.7, 0.2, 0.1], [0.3, 0.6, 0.1], [0.0, 0.3, 0.7]], dtype=torch.float64)
        matrix = isp.fit_colour_matrix(colours @ mixing.T, colours=colours, noise=1e-7)
        torch.testing.assert_close(matrix @ mixing, torch.eye(3, dtype=torch.float64), atol=1e-8, rtol=0)

    def test_gradient_reaches_the_filter(self) -> None:
        start = torch.rand(3, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 0.3

        def fit(coefficients: Tensor) -> tuple[Tensor, Tensor]:
            here = Context(colour_filter=ColourFilter(coefficients, softplus=True))
            return isp.as_shot_gains(here), isp.as_shot_colour_matrix(here)

        assert torch.autograd.gradcheck(fit, (start.requires_grad_(),), eps=1e-7, rtol=1e-4)


class TestToneCurve:
    def test_is_the_srgb_curve(self, dtype: torch.dtype) -> None:
        x = torch.tensor([-0.5, 0.0, 0.001, 0.0031308, 0.18, 0.5, 1.0, 1.7], dtype=dtype)
        expected = torch.tensor([0, 0, 0.01292, 0.0404499, 0.461356, 0.735357, 1, 1], dtype=dtype)
        for channels in (1, 3):
            picture = x.expand(2, channels, 1, -1)
            result = isp.ToneCurve()(picture)
            torch.testing.assert_close(result, expected.expand_as(picture), atol=1e-6, rtol=0)
            assert result.dtype == dtype

    def test_gradient_is_finite_and_leads_back(self) -> None:
        x = torch.tensor([-0.5, 0.0, 0.5, 1.7], dtype=torch.float64).expand(1, 3, 1, -1).clone().requires_grad_()
        isp.ToneCurve()(x).sum().backward()
        assert x.grad is not None
        assert x.grad.isfinite().all()
        torch.testing.assert_close(x.grad[0, 0, 0, :2], torch.tensor([0.0, 12.92], dtype=torch.float64))
        assert x.grad[0, 0, 0, 3] > 0  # too bright, and raising the sum is a descent away from it: it may come down
        inside = torch.rand(1, 3, 2, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 0.9 + 0.05
        assert torch.autograd.gradcheck(isp.tone_curve, (inside.requires_grad_(),))
        assert torch.autograd.gradcheck(isp.tone_curve, (inside[:, :1].detach().requires_grad_(),))

    def test_gamma_and_contrast_follow_their_equation(self, dtype: torch.dtype) -> None:
        x = torch.rand(2, 3, 4, 5, dtype=dtype, generator=torch.Generator().manual_seed(0))
        gamma, contrast = [0.7, 1.0, 1.6], [-0.3, 0.0, 0.4]
        result = isp.ToneCurve(torch.tensor(gamma), torch.tensor(contrast))(x)
        assert result.dtype == dtype
        for channel, (g, c) in enumerate(zip(gamma, contrast, strict=True)):
            v = isp.tone_curve(x)[:, channel].double()
            u = ((v + 0.01) ** g - 0.01**g) / (1.01**g - 0.01**g)
            expected = u + 2 * c * u * (1 - u) * (2 * u - 1)
            torch.testing.assert_close(result[:, channel].double(), expected, atol=2e-6, rtol=0)
        torch.testing.assert_close(isp.ToneCurve(torch.ones(3), 0.0)(x), isp.ToneCurve()(x), atol=2e-6, rtol=0)
        torch.testing.assert_close(isp.ToneCurve(gamma=1.6)(x[:, :1]), isp.ToneCurve([1.6] * 3)(x)[:, :1])

    def test_gamma_and_contrast_train_and_come_back(self) -> None:
        g = torch.Generator().manual_seed(0)
        x = (0.05 + 0.9 * torch.rand(1, 3, 2, 3, dtype=torch.float64, generator=g)).requires_grad_()
        gamma = torch.tensor([0.8, 1.0, 1.7], dtype=torch.float64, requires_grad=True)
        contrast = torch.tensor([-0.2, 0.0, 0.3], dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(lambda x, g, c: isp.tone_curve(x, gamma=g, contrast=c), (x, gamma, contrast))
        gone = nn.Parameter(torch.tensor([-3.0, 50.0, 1.0]))  # as a training step of any size may leave it
        stage = isp.ToneCurve(nn.Parameter(torch.ones(3)))
        stage.gamma = gone
        bright, dark, _ = stage(x.detach()).unbind(1)
        assert bright.isfinite().all()
        assert dark.isfinite().all()
        (bright.sum() + (1 - dark).sum()).backward()  # to descend: darker red, brighter green
        assert gone.grad is not None
        assert gone.grad[0] < 0 < gone.grad[1]

    @pytest.mark.parametrize(
        ("arguments", "match"),
        [
            ({"gamma": 0.0}, "gamma must be a number from 0.1 to 10, or three of them"),
            ({"gamma": math.nan}, "gamma must be .* got nan"),
            ({"contrast": torch.ones(3)}, "contrast must be a number from -0.49 to 0.49"),
            ({"gamma": torch.ones(4)}, "gamma must be"),
        ],
    )
    def test_a_rendering_that_is_none(self, arguments: dict, match: str) -> None:
        with pytest.raises(ValueError, match=match):
            isp.ToneCurve(**arguments)

    def test_three_gammas_for_one_channel(self) -> None:
        with pytest.raises(ValueError, match="three channels do not fit one of gray"):
            isp.ToneCurve(torch.ones(3))(torch.zeros(1, 1, 2, 2))

    def test_a_trained_rendering_is_saved(self, tmp_path: Path) -> None:
        gamma = nn.Parameter(torch.tensor([0.9, 1.0, 1.2]))
        Camera(isp.ToneCurve(gamma, contrast=0.1)).save(tmp_path / "c.safetensors")
        (stage,) = Camera.load(tmp_path / "c.safetensors")
        assert isinstance(stage.gamma, nn.Parameter)
        assert stage.gamma.tolist() == pytest.approx([0.9, 1.0, 1.2])
        assert float(stage.contrast) == pytest.approx(0.1)

    def test_clip(self) -> None:
        x = torch.tensor([-1.0, 0.5, 2.0], requires_grad=True)
        y = isp.Clip()(x)
        assert y.tolist() == [0.0, 0.5, 1.0]
        y.sum().backward()
        assert x.grad is not None
        assert x.grad.tolist() == [0.0, 1.0, 1.0]


class TestStages:
    @pytest.mark.parametrize(
        ("stage", "name", "shape"), [(isp.WhiteBalance, "gains", (3,)), (isp.ColourMatrix, "matrix", (3, 3))]
    )
    def test_a_parameter_trains_and_a_tensor_is_a_buffer(self, stage: type, name: str, shape: tuple[int, ...]) -> None:
        value = torch.rand(shape, generator=torch.Generator().manual_seed(0))
        trained, fixed = stage(nn.Parameter(value)), stage(value)
        assert [key for key, _ in trained.named_parameters()] == [name]
        assert not list(fixed.parameters())
        assert list(fixed.state_dict()) == [name]
        picture = torch.rand(2, 3, 4, 5, dtype=torch.float64)
        result = stage(**{name: getattr(trained, name)})(picture)
        assert result.dtype == torch.float64
        torch.testing.assert_close(result, fixed(picture))
        result.sum().backward()
        assert getattr(trained, name).grad.isfinite().all()

    def test_gradcheck(self) -> None:
        g = torch.Generator().manual_seed(0)
        picture = torch.rand(1, 4, 2, 3, dtype=torch.float64, generator=g).requires_grad_()
        gains = torch.rand(4, dtype=torch.float64, generator=g).requires_grad_()
        matrix = torch.rand(3, 4, dtype=torch.float64, generator=g).requires_grad_()
        assert torch.autograd.gradcheck(lambda x, g: isp.white_balance(x, gains=g), (picture, gains))
        assert torch.autograd.gradcheck(lambda x, m: isp.apply_colour_matrix(x, matrix=m), (picture, matrix))

    @pytest.mark.parametrize("stage", [isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(), isp.Clip()], ids=repr)
    def test_dtype_device_empty_and_untouched_input(
        self, stage: nn.Module, dtype: torch.dtype, device: torch.device
    ) -> None:
        picture = torch.rand(2, 3, 4, 5, dtype=dtype, device=device) * 2 - 0.5
        kept = picture.clone()
        result = stage(picture)
        assert (result.shape, result.dtype, result.device) == (picture.shape, dtype, picture.device)
        assert torch.equal(picture, kept)
        assert stage(picture[:0]).shape == (0, 3, 4, 5)
        assert stage(picture[0]).shape == (3, 4, 5)
        assert stage(picture.half()).dtype == torch.float16

    def test_the_whole_chain_gives_a_white_wall_white(self) -> None:
        here = context("nikon", black_level=256 / 4095)
        bands = here.illuminant.expand(1, 12, 14, -1).permute(0, 3, 1, 2)
        signal = bands
        stages = (here.colour_filter, sensor.Mosaic(), sensor.Exposure(), sensor.ADC(bits=12, black_level=256))
        for stage in (*stages, isp.Demosaic(), isp.WhiteBalance(), isp.ColourMatrix()):
            signal = stage(signal, here)
        assert (signal - 1).abs().max() < 2e-3  # 12 bits


class TestErrors:
    def test_channels_of_filter_and_signal(self) -> None:
        here = Context(colour_filter=FILTERS["kodak"])
        for stage in (isp.WhiteBalance(), isp.ColourMatrix()):
            with pytest.raises(ValueError, match="the signal has 1 channels and the colour filter 3 curves"):
                stage(torch.zeros(1, 1, 2, 2), here)
            with pytest.raises(ValueError, match=r"Give gains=torch.ones\(3\) to Demosaic and WhiteBalance"):
                stage(torch.zeros(1, 3, 2, 2), Context(colour_filter=ColourFilter.learned(4)))
            with pytest.raises(ValueError, match="the signal has 2 channels"):
                stage(torch.zeros(1, 2, 2, 2))

    def test_sequences_are_taken(self) -> None:
        signal = torch.rand(1, 3, 4, 4)
        rows = [[1.5, -0.5, 0.0], [0.0, 1.0, 0.0], [0.0, -0.25, 1.25]]
        for stage, same in (
            (isp.WhiteBalance([1.65, 1.0, 1.18]), isp.WhiteBalance(torch.tensor([1.65, 1.0, 1.18]))),
            (isp.ColourMatrix(rows), isp.ColourMatrix(torch.tensor(rows))),
        ):
            torch.testing.assert_close(stage(signal), same(signal), rtol=0, atol=0)
        mosaic, plain = torch.rand(1, 1, 8, 8), isp.Demosaic(gains=torch.tensor([1.65, 1.0, 1.18]))
        torch.testing.assert_close(isp.Demosaic(gains=(1.65, 1.0, 1.18))(mosaic), plain(mosaic))

    def test_what_no_signal_can_fit_is_refused_at_once(self) -> None:
        with pytest.raises(ValueError, match=r"matrix must be three rows .* torch.eye\(3\), .* got shape \(1, 1\)"):
            isp.ColourMatrix([[1]])
        with pytest.raises(ValueError, match=r"matrix must be three rows .* got shape \(3,\)"):
            isp.ColourMatrix(torch.ones(3))
        with pytest.raises(TypeError, match="matrix must be three rows .* got 'identity'"):
            isp.ColourMatrix("identity")
        with pytest.raises(ValueError, match=r"gains must be one number per channel .* got shape \(1, 3\)"):
            isp.WhiteBalance([[1.0, 1.0, 1.0]])
        with pytest.raises(TypeError, match="gains must be one number per channel such as .* got 'auto'"):
            isp.Demosaic(gains="auto")

    def test_shapes(self) -> None:
        with pytest.raises(ValueError, match=r"gains of shape \(4,\) do not fit a signal of 3 channels"):
            isp.WhiteBalance(torch.ones(4))(torch.zeros(1, 3, 2, 2))
        with pytest.raises(ValueError, match=r"a matrix of shape \(3, 4\) does not fit a signal of 3 channels"):
            isp.ColourMatrix(torch.ones(3, 4))(torch.zeros(1, 3, 2, 2))
        with pytest.raises(ValueError, match=r"expected a picture \(\.\.\., C, H, W\), got shape \(2, 2\)"):
            isp.WhiteBalance()(torch.zeros(2, 2))
        with pytest.raises(ValueError, match="the sRGB curve takes 3 channels, or 1 of gray, got 4"):
            isp.ToneCurve()(torch.zeros(1, 4, 2, 2))


def test_tones_broadcast_with_and_without_a_gradient() -> None:
    """One plane rendered in three ways, and a batch of planes each in its own."""
    plane = torch.rand(1, 5, 6, generator=torch.Generator().manual_seed(0))
    gamma, contrast = torch.tensor([0.5, 1.0, 2.0])[:, None, None], torch.tensor(0.2)
    found = isp.render_tones(plane, gamma=gamma, contrast=contrast)
    assert found.shape == (3, 5, 6)
    traced = isp.render_tones(plane.clone().requires_grad_(), gamma=gamma, contrast=contrast)
    torch.testing.assert_close(found, traced.detach(), atol=1e-6, rtol=0)
