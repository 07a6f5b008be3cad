"""The table of demosaics: contracts over every row and pattern, published oracles, and the measured defaults."""

from __future__ import annotations

import sys

import cv2
import numpy as np
import pytest
import torch
from kornia.color import CFA, linear_rgb_to_rgb, raw_to_rgb, rgb_to_linear_rgb
from skimage import data
from torch import Tensor, nn

from kcam import isp, sensor
from kcam.context import Context
from kcam.isp.demosaic import BAYER, DOMAINS
from kcam.sensor import PATTERNS, mosaic

ROWS = [(method, pattern) for method, row in isp.DEMOSAICS.items() for pattern in row.patterns]
rows = pytest.mark.parametrize(("method", "pattern"), ROWS, ids=[f"{m}-{p}" for m, p in ROWS])
NIKON_D65 = torch.tensor([1.65, 1.0, 1.18, 1.0])


def channels(pattern: str) -> int:
    return max(max(row) for row in PATTERNS[pattern]) + 1


def picture(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def psnr(result: Tensor, truth: Tensor, border: int = 8) -> float:
    error = (result - truth)[..., border:-border, border:-border]
    return float(-10 * torch.log10(error.square().mean()))


@pytest.fixture(scope="module")
def photographs() -> list[Tensor]:
    pictures = (data.astronaut(), data.coffee(), data.chelsea(), data.stereo_motorcycle()[0])
    return [torch.tensor(image).permute(2, 0, 1)[None] / 255 for image in pictures]


def score(photographs: list[Tensor], *, pattern: str = "RGGB", balance: bool = True, iso: float = 0, **how) -> float:
    """Mean PSNR [dB] as `demosaic` says it: linear light, white at 0.8, error after sRGB encoding."""
    scores = []
    for seed, photograph in enumerate(photographs):
        light = rgb_to_linear_rgb(photograph)
        if channels(pattern) == 4:
            light = torch.cat([light, light.mean(1, keepdim=True)], 1)
        gains = NIKON_D65[: light.shape[1]]
        raw = mosaic(0.8 * light / gains[:, None, None], pattern=pattern)
        if iso:
            g, full_well = torch.Generator().manual_seed(seed), 1e4 * 100 / iso
            read = 3e-4 * torch.randn(raw.shape, generator=g)
            raw = torch.poisson(raw * full_well, generator=g) / full_well + read
        result = isp.demosaic(raw, pattern=pattern, gains=gains if balance else None, **how) * gains[:, None, None]
        coded = linear_rgb_to_rgb((result[:, :3] / 0.8).clamp(0, 1))
        scores.append(psnr(coded, photograph))
    return float(np.mean(scores))


class TestContract:
    @rows
    @pytest.mark.parametrize("domain", DOMAINS)
    def test_uniform_colour_is_exact(self, method: str, pattern: str, domain: str, dtype: torch.dtype) -> None:
        colour = torch.tensor([0.7, 0.2, 0.4, 0.9], dtype=dtype)[: channels(pattern)]
        image = colour[:, None, None].expand(1, -1, 13, 14)
        for gains in (None, 1 / colour):
            result = isp.demosaic(
                mosaic(image, pattern=pattern), pattern=pattern, method=method, domain=domain, gains=gains
            )
            torch.testing.assert_close(result, image.contiguous(), atol=20 * torch.finfo(dtype).eps, rtol=0)

    @rows
    def test_any_size(self, method: str, pattern: str) -> None:
        for size in ((1, 1), (1, 7), (5, 1), (2, 2), (2, 3), (3, 3), (9, 7), (10, 13)):
            raw = picture(2, 1, *size).requires_grad_()
            result = isp.demosaic(raw, pattern=pattern, method=method)
            assert result.shape == (2, channels(pattern), *size)
            result.square().sum().backward()
            assert result.isfinite().all()
            assert raw.grad is not None
            assert raw.grad.isfinite().all()
            gray = isp.demosaic(torch.full((1, 1, *size), 0.3), pattern=pattern, method=method)
            torch.testing.assert_close(gray, torch.full_like(gray, 0.3))

    @rows
    def test_recorded_values_are_kept(self, method: str, pattern: str) -> None:
        raw = picture(2, 1, 11, 12) - 0.1
        gains = torch.tensor([2.0, 1.0, 1.5, 0.4])[: channels(pattern)]
        result = isp.demosaic(raw, pattern=pattern, method=method, gains=gains)
        torch.testing.assert_close(mosaic(result, pattern=pattern), raw, atol=1e-14, rtol=0)

    @rows
    def test_gray_ramp(self, method: str, pattern: str) -> None:
        y, x = torch.meshgrid(*[torch.arange(n, dtype=torch.float64) for n in (29, 30)], indexing="ij")
        inside = {"malvar": 2, "bilinear": 1 if pattern in BAYER else 2, "kornia": 1}.get(method, 6)
        allowed = 0.0
        if (method, pattern) == ("difference", "quad_bayer"):
            allowed = 1 / 3
        elif method == "bilinear" and pattern not in BAYER:
            allowed = 0.6
        for right, down in ((1.0, 0.0), (0.0, 1.0), (0.6, -0.4)):
            ramp = (right * x + down * y).expand(1, channels(pattern), -1, -1)
            result = isp.demosaic(mosaic(ramp, pattern=pattern), pattern=pattern, method=method, domain="linear")
            error = (result - ramp).abs()
            assert error[..., inside:-inside, inside:-inside].max() <= allowed + 1e-12
            assert error.max() <= 2.5 + 1e-12

    @pytest.mark.parametrize(("method", "pattern"), [row for row in ROWS if row[1] not in BAYER[1:]])
    def test_gradcheck(self, method: str, pattern: str) -> None:
        size = (7, 8) if method == "menon" else (5, 6)
        raw = (picture(1, 1, *size, seed=3) * 0.8 + 0.1).requires_grad_()
        gains = torch.linspace(1.0, 1.7, channels(pattern), dtype=torch.float64).requires_grad_()
        assert torch.autograd.gradcheck(
            lambda raw, gains: isp.demosaic(raw, pattern=pattern, method=method, gains=gains), (raw, gains)
        )

    @rows
    def test_gradient_is_finite_without_light(self, method: str, pattern: str) -> None:
        raw = torch.zeros(1, 1, 8, 9, requires_grad=True)
        isp.demosaic(raw, pattern=pattern, method=method).sum().backward()
        assert raw.grad is not None
        assert raw.grad.isfinite().all()
        assert abs(raw.grad.sum() - 72 * channels(pattern)) < 1e-2

    @rows
    def test_dtype_device_leading_dimensions_and_empty(
        self, method: str, pattern: str, device: torch.device, dtype: torch.dtype
    ) -> None:
        raw = picture(2, 3, 1, 6, 8).to(device, dtype)
        kept = raw.clone()
        result = isp.demosaic(raw, pattern=pattern, method=method)
        assert result.dtype == dtype
        assert result.device == raw.device
        assert result.shape == (2, 3, channels(pattern), 6, 8)
        assert torch.equal(raw, kept)
        torch.testing.assert_close(result[1, 2], isp.demosaic(raw[1, 2], pattern=pattern, method=method))
        half = isp.demosaic(raw[0].half(), pattern=pattern, method=method)
        assert half.dtype == torch.float16
        torch.testing.assert_close(half.to(dtype), result[0], atol=0.05 if method == "menon" else 4e-3, rtol=0)
        empty = isp.demosaic(raw[:, :0], pattern=pattern, method=method)
        assert empty.shape == (2, 0, channels(pattern), 6, 8)

    def test_the_mosaic_moves_with_the_picture(self) -> None:
        image = picture(1, 3, 16, 18)
        whole = isp.demosaic(mosaic(image, pattern="RGGB"), pattern="RGGB")
        for pattern, y, x in (("GRBG", 0, 1), ("GBRG", 1, 0), ("BGGR", 1, 1)):
            part = isp.demosaic(mosaic(image[..., y:, x:], pattern=pattern), pattern=pattern)
            torch.testing.assert_close(part[..., 2:-2, 2:-2], whole[..., y + 2 : -2, x + 2 : -2])

    @pytest.mark.parametrize("method", ["bilinear", "difference"])
    def test_a_new_pattern_is_a_new_row(self, method: str, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(PATTERNS, "odd", ((0, 1, 1, 2, 1), (1, 2, 1, 1, 0), (2, 0, 1, 1, 1)))
        image = torch.tensor([0.7, 0.2, 0.4])[:, None, None].expand(1, -1, 17, 19)
        result = isp.demosaic(mosaic(image, pattern="odd"), pattern="odd", method=method)
        torch.testing.assert_close(result, image.contiguous())

    @pytest.mark.parametrize(
        "method", ["malvar", *(pytest.param(name, marks=pytest.mark.slow) for name in ("difference", "bilinear"))]
    )
    def test_compile_fullgraph(self, method: str) -> None:
        def call(raw: Tensor, gains: Tensor) -> Tensor:
            return isp.demosaic(raw, pattern="GRBG", method=method, gains=gains)

        raw = picture(1, 1, 7, 10, dtype=torch.float32).requires_grad_()
        result = torch.compile(call, fullgraph=True, backend="aot_eager")(raw, NIKON_D65[:3])
        torch.testing.assert_close(result, call(raw, NIKON_D65[:3]))
        result.sum().backward()
        assert raw.grad is not None

    def test_first_call_in_inference_mode_does_not_spoil_training(self) -> None:
        with torch.inference_mode():
            isp.demosaic(picture(1, 1, 4, 4), pattern="BGGR")
        raw = picture(1, 1, 4, 4).requires_grad_()
        isp.demosaic(raw, pattern="BGGR").square().sum().backward()


class TestOracles:
    @pytest.mark.parametrize("pattern", BAYER)
    def test_malvar_is_colour_demosaicing(self, pattern: str) -> None:
        oracle = pytest.importorskip("colour_demosaicing").demosaicing_CFA_Bayer_Malvar2004
        raw = picture(1, 1, 20, 23)
        ours = isp.demosaic(raw, pattern=pattern, method="malvar", domain="linear")[0].permute(1, 2, 0).numpy()
        theirs = oracle(raw[0, 0].numpy(), pattern)
        np.testing.assert_allclose(ours[2:-2, 2:-2], theirs[2:-2, 2:-2], atol=1e-14)

    @pytest.mark.parametrize("pattern", BAYER)
    def test_menon_is_colour_demosaicing(self, pattern: str) -> None:
        oracle = pytest.importorskip("colour_demosaicing").demosaicing_CFA_Bayer_Menon2007
        image = torch.tensor(data.astronaut()[100:190, 150:251] / 255).permute(2, 0, 1)
        raw = mosaic(image, pattern=pattern) + 1e-6 * picture(1, 90, 101)  # dithered: no ties to be decided by rounding
        ours = isp.demosaic(raw, pattern=pattern, method="menon", domain="linear").permute(1, 2, 0).numpy()
        np.testing.assert_allclose(ours, oracle(raw[0].numpy(), pattern), atol=1e-12)

    @pytest.mark.parametrize("pattern", BAYER)
    def test_bilinear_is_opencv_inside(self, pattern: str) -> None:
        code = {
            "RGGB": cv2.COLOR_BayerRGGB2RGB,
            "GRBG": cv2.COLOR_BayerGRBG2RGB,
            "GBRG": cv2.COLOR_BayerGBRG2RGB,
            "BGGR": cv2.COLOR_BayerBGGR2RGB,
        }[pattern]
        raw = (picture(1, 1, 16, 20) * 65535).round()
        theirs = cv2.cvtColor(raw[0, 0].numpy().astype(np.uint16), code)
        ours = isp.demosaic(raw, pattern=pattern, method="bilinear", domain="linear")[0].permute(1, 2, 0).numpy()
        np.testing.assert_allclose(ours[1:-1, 1:-1], theirs[1:-1, 1:-1], atol=0.76)  # theirs is rounded

    def test_bilinear_is_kornia_inside_and_kornia_is_kornia(self) -> None:
        raw = picture(2, 1, 12, 14)
        theirs = raw_to_rgb(raw, CFA.BG)
        assert torch.equal(isp.demosaic(raw, method="kornia", domain="linear"), theirs)
        ours = isp.demosaic(raw, method="bilinear", domain="linear")
        torch.testing.assert_close(ours[..., 1:-1, 1:-1], theirs[..., 1:-1, 1:-1])


class TestQuality:
    @pytest.mark.parametrize("method", isp.DEMOSAICS)
    def test_table_says_what_is_measured(self, method: str, photographs: list[Tensor]) -> None:
        assert abs(score(photographs, method=method) - isp.DEMOSAICS[method].psnr) < 0.1

    @pytest.mark.parametrize(
        ("method", "expected"), [("malvar", 34.74), ("bilinear", 30.71), ("menon", 36.60)], ids=lambda v: str(v)
    )
    def test_published_comparison_on_coded_pictures(
        self, method: str, expected: float, photographs: list[Tensor]
    ) -> None:
        scores = [
            psnr(isp.demosaic(mosaic(image, pattern="RGGB"), method=method, domain="linear").clamp(0, 1), image)
            for image in photographs
        ]
        assert abs(np.mean(scores) - expected) < 0.05

    def test_domain_and_balance_are_the_best_measured(self, photographs: list[Tensor]) -> None:
        for iso, sqrt, unbalanced, linear in ((0, 34.40, 34.20, 30.78), (1600, 30.00, 29.84, 27.64)):
            assert abs(score(photographs, iso=iso) - sqrt) < 0.1
            assert abs(score(photographs, iso=iso, balance=False) - unbalanced) < 0.1
            assert abs(score(photographs, iso=iso, domain="linear") - linear) < 0.1

    @pytest.mark.parametrize(
        ("pattern", "difference", "bilinear"),
        [("quad_bayer", 30.26, 27.55), ("x_trans", 33.03, 29.96), ("rgbw", 31.81, 26.59)],
    )
    def test_other_patterns(self, pattern: str, difference: float, bilinear: float, photographs: list[Tensor]) -> None:
        assert abs(score(photographs, pattern=pattern) - difference) < 0.1  # the default
        assert abs(score(photographs, pattern=pattern, method="bilinear") - bilinear) < 0.1


class TestDomain:
    def test_sqrt_is_undone_and_smooth(self) -> None:
        encode, decode = DOMAINS["sqrt"]
        x = torch.linspace(-0.5, 2, 501, dtype=torch.float64).requires_grad_()
        y = encode(x)
        torch.testing.assert_close(decode(y), x, atol=1e-15, rtol=1e-14)
        (slope,) = torch.autograd.grad(y.sum(), x)
        assert slope.isfinite().all()
        assert (slope > 0).all()
        assert (slope.diff() <= 0).all()  # steepest in the dark, without a jump
        assert slope.max() < 10


class TestDemosaic:
    def test_defaults_follow_the_pattern(self) -> None:
        raw = picture(1, 1, 9, 10)
        for pattern in PATTERNS:
            default = "malvar" if pattern in BAYER else "difference"
            expected = isp.demosaic(raw, pattern=pattern, method=default, domain="sqrt")
            assert torch.equal(isp.Demosaic()(raw, Context(pattern=pattern)), expected)
            assert torch.equal(isp.Demosaic(pattern=pattern)(raw), expected)
        assert isp.Demosaic().provides() == {}
        assert isp.Demosaic(pattern="x_trans").provides() == {"pattern": "x_trans"}
        assert "malvar" in repr(isp.Demosaic("malvar"))

    def test_balances_with_the_filter_of_the_context(self) -> None:
        raw = picture(1, 1, 9, 10)
        context = Context(colour_filter=sensor.ColourFilter.nikon())
        gains = isp.as_shot_gains(context)
        assert torch.equal(isp.Demosaic()(raw, context), isp.demosaic(raw, gains=gains))
        own = torch.tensor([2.0, 1.0, 3.0])
        stage = isp.Demosaic(gains=own)
        assert torch.equal(stage(raw, context), isp.demosaic(raw, gains=own))
        assert "gains" in stage.state_dict()

    @pytest.mark.parametrize("black_level", [0, 256])
    @pytest.mark.parametrize("stage", [isp.Demosaic(), isp.LearnedDemosaic()], ids=["table", "learned"])
    def test_takes_off_the_black_level_that_the_adc_put_on(self, stage: nn.Module, black_level: int) -> None:
        light = torch.full((1, 1, 6, 8), 0.5, dtype=torch.float64)
        adc = sensor.ADC(bits=16, black_level=black_level)
        context = Context(**adc.provides())
        assert (stage(adc(light, context), context) - stage(light)).abs().max() < 2**-15

    def test_rebuilds_from_its_attributes(self) -> None:
        stage = isp.Demosaic("bilinear", domain="linear", pattern="BGGR", gains=torch.ones(3))
        names = ("method", "domain", "pattern", "gains")
        again = isp.Demosaic(**{name: getattr(stage, name) for name in names})
        raw = picture(1, 1, 6, 6)
        assert torch.equal(stage(raw), again(raw))


class TestLearnedDemosaic:
    def test_is_trainable_and_starts_the_same_and_leaves_the_random_state(self) -> None:
        before = torch.get_rng_state()
        first = isp.LearnedDemosaic()
        assert torch.equal(before, torch.get_rng_state())
        torch.manual_seed(5)
        second = isp.LearnedDemosaic()
        assert torch.equal(first.weight, second.weight)
        assert {name: tuple(p.shape) for name, p in first.named_parameters()} == {"weight": (3, 1, 3, 3), "bias": (3,)}
        assert first.provides() == {}
        assert "(3, 1, 3, 3)" in repr(first)

    def test_starts_as_an_upright_picture(self) -> None:
        image = torch.tensor(data.astronaut()).permute(2, 0, 1)[None] / 255
        with torch.no_grad():
            result = isp.LearnedDemosaic()(mosaic(image, pattern="RGGB"))
        assert ((result < 0) | (result > 1)).float().mean() < 0.05
        for channel in result[0]:
            assert np.corrcoef(channel.flatten(), image.mean(1).flatten())[0, 1] > 0.95

    @pytest.mark.parametrize("size", [(1, 1), (1, 4), (5, 6)], ids=str)
    def test_any_size_and_gradcheck(self, size: tuple[int, int]) -> None:
        stage = isp.LearnedDemosaic()
        inputs = tuple(x.detach().double().requires_grad_() for x in (picture(2, 1, *size), stage.weight, stage.bias))
        assert torch.autograd.gradcheck(lambda x, w, b: isp.learned_demosaic(x, weight=w, bias=b), inputs)
        assert stage(inputs[0][:0]).shape == (0, 3, *size)
        assert stage(inputs[0]).dtype == torch.float64

    def test_is_the_convolution(self) -> None:
        weight, bias = picture(3, 1, 3, 3), picture(3)
        stage = isp.LearnedDemosaic(weight, bias)
        assert not list(stage.parameters())
        assert set(stage.state_dict()) == {"weight", "bias"}
        raw = picture(1, 1, 6, 7)
        expected = nn.functional.conv2d(raw, weight, bias)
        torch.testing.assert_close(stage(raw)[..., 1:-1, 1:-1], expected)
        again = isp.LearnedDemosaic(**{name: getattr(stage, name) for name in ("weight", "bias")})
        assert torch.equal(again(raw), stage(raw))


class TestErrors:
    def test_unknown_method_lists_the_table(self) -> None:
        for call in (lambda: isp.Demosaic("vng"), lambda: isp.demosaic(picture(1, 1, 4, 4), method="vng")):
            with pytest.raises(
                ValueError, match=r"'vng' is unknown; there are: malvar \(default.*menon.*LearnedDemosaic"
            ):
                call()

    def test_method_that_needs_bayer(self) -> None:
        message = "'malvar' is valid for RGGB, GRBG, GBRG, BGGR, not for 'x_trans'. Use difference, bilinear"
        with pytest.raises(ValueError, match=message):
            isp.Demosaic("malvar", pattern="x_trans")
        with pytest.raises(ValueError, match=message):
            isp.Demosaic("malvar")(picture(1, 1, 6, 6), Context(pattern="x_trans"))

    def test_unknown_pattern_and_domain(self) -> None:
        with pytest.raises(ValueError, match="pattern 'foveon' is unknown"):
            isp.Demosaic(pattern="foveon")
        with pytest.raises(ValueError, match="domain 'log' is unknown; expected one of sqrt, linear"):
            isp.Demosaic(domain="log")
        with pytest.raises(ValueError, match="domain 'log' is unknown"):
            isp.demosaic(picture(1, 1, 4, 4), domain="log")

    @pytest.mark.parametrize("stage", [isp.Demosaic(), isp.LearnedDemosaic()], ids=["table", "learned"])
    def test_number_of_channels(self, stage: nn.Module) -> None:
        for shape in ((1, 3, 4, 4), (4, 4)):
            with pytest.raises(ValueError, match=r"takes the one mosaiced plane \(\.\.\., 1, H, W\), got shape"):
                stage(torch.zeros(shape))

    def test_integers(self) -> None:
        with pytest.raises(TypeError, match="floating-point"):
            isp.demosaic(torch.zeros(1, 1, 4, 4, dtype=torch.uint8))

    def test_gains(self) -> None:
        with pytest.raises(ValueError, match=r"gains of shape \(4,\) do not fit pattern 'RGGB': expected \(3,\)"):
            isp.demosaic(picture(1, 1, 4, 4), gains=torch.ones(4))

    def test_learned_shapes(self) -> None:
        with pytest.raises(ValueError, match=r"weight of shape \(3, 3\) and bias of shape \(3,\) are no 3x3 conv"):
            isp.LearnedDemosaic(torch.zeros(3, 3))
        with pytest.raises(ValueError, match=r"expected \(3, 1, 3, 3\) and \(3,\)"):
            isp.LearnedDemosaic(torch.zeros(3, 1, 3, 3), torch.zeros(2))


@pytest.mark.parametrize("shape", [(1, 1, 70, 33), (3, 1, 41, 24), (2, 1, 9, 50), (1, 1, 64, 64)])
@pytest.mark.parametrize("gains", [None, torch.tensor([1.7, 1.0, 1.3])])
def test_strips_give_the_whole_picture(shape: tuple[int, ...], gains, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the number of rows in each."""
    raw = torch.rand(shape, generator=torch.Generator().manual_seed(shape[2]))
    for pattern in ("RGGB", "GBRG"):
        whole = isp.demosaic(raw.clone().requires_grad_(), pattern=pattern, gains=gains).detach()  # which is not cut
        for pixels in (1, 700, 2**18):
            monkeypatch.setattr(sys.modules["kcam.isp.demosaic"], "_IN_CACHE", pixels)
            torch.testing.assert_close(isp.demosaic(raw, pattern=pattern, gains=gains), whole, rtol=0, atol=1e-6)
