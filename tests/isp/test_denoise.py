"""Denoising by the camera's own noise."""

from __future__ import annotations

import sys

import pytest
import torch

from kcam import Camera, Scene, isp, sensor


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize(
    ("full_well", "read_noise", "gain"), [(1000.0, 0.0, 1.0), (5000.0, 3.0, 4.0), (50.0, 1.0, 1.0)]
)
def test_flat_gray_loses_most_of_its_noise_at_every_brightness(full_well, read_noise, gain):
    for level in (0.05, 0.2, 0.8):
        clean = torch.full((1, 3, 96, 96), level)
        variance = gain * level / full_well + (gain * read_noise / full_well) ** 2
        noisy = clean + variance**0.5 * torch.randn(clean.shape, generator=seeded())
        quiet = isp.denoise(noisy, full_well=full_well, read_noise=read_noise, gain=gain)
        assert quiet.std() < 0.6 * noisy.std()
        assert abs(float(quiet.mean() - level)) < 0.2 * variance**0.5


def test_an_edge_of_twenty_deviations_stays():
    edge = torch.full((1, 3, 16, 16), 0.2)
    edge[..., 8:] = 0.2 + 20 * (0.2 / 1000) ** 0.5
    assert (isp.denoise(edge, full_well=1000.0) - edge).abs().max() < 0.01 * (0.2 / 1000) ** 0.5


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_a_constant_is_unchanged(channels):
    constant = torch.rand(2, channels, 1, 1, generator=seeded()).double().expand(2, channels, 7, 5)
    gains = 1 + torch.rand(channels, generator=seeded(1)).double()
    torch.testing.assert_close(isp.denoise(constant, gains=gains), constant)


def test_strips_change_nothing(monkeypatch):
    picture = torch.rand(2, 3, 31, 20, generator=seeded(), dtype=torch.float64)
    whole = isp.denoise(picture, full_well=30.0)
    monkeypatch.setattr(sys.modules["kcam.isp.denoise"], "STRIP", 100)
    torch.testing.assert_close(isp.denoise(picture, full_well=30.0), whole)


def test_one_channel_is_the_bilateral_filter_written_out():
    picture = torch.rand(1, 1, 5, 6, generator=seeded(), dtype=torch.float64)
    slope, expected = 1 / 40.0, torch.empty(5, 6).double()
    offset = (2 * slope) ** 2 + 3 / 8 * slope**2
    x = picture[0, 0]
    t = 2 / slope * (slope * x + offset).sqrt()
    for i in range(5):
        for j in range(6):
            total = weight = 0.0
            for di in range(-2, 3):
                for dj in range(-2, 3):
                    k, m = min(max(i + di, 0), 4), min(max(j + dj, 0), 5)
                    w = float(torch.exp(-((t[k, m] - t[i, j]) ** 2) / (2 * 1.0**2))) * 2.718281828459045 ** (
                        -(di**2 + dj**2) / 9
                    )
                    total, weight = total + w * float(x[k, m]), weight + w
            expected[i, j] = total / weight
    actual = isp.denoise(picture, full_well=40.0, read_noise=2.0, radius=2)[0, 0]
    torch.testing.assert_close(actual, expected)


@pytest.mark.parametrize("train", ["signal", "luma"])
def test_gradients_are_those_of_finite_differences(train):
    picture = (0.1 + 0.8 * torch.rand(1, 3, 4, 5, generator=seeded(), dtype=torch.float64)).requires_grad_(
        train == "signal"
    )
    width = torch.tensor(1.5, dtype=torch.float64, requires_grad=train == "luma")
    assert torch.autograd.gradcheck(lambda p, k: isp.denoise(p, full_well=50.0, luma=k), (picture, width))


def test_the_camera_tells_its_noise_and_two_read_noises_add_up():
    camera = Camera(sensor.ShotNoise(full_well=500.0), sensor.ReadNoise(3.0), sensor.ReadNoise(4.0), isp.Denoise())
    context = camera.resolve()
    assert (context.full_well, context.read_noise) == (500.0, 5.0)


def test_a_saved_camera_denoises_alike(tmp_path):
    camera = Camera.phone_lens()
    camera.save(tmp_path / "camera.safetensors")
    loaded = Camera.load(tmp_path / "camera.safetensors")
    assert [type(stage) for stage in loaded] == [type(stage) for stage in camera]


def test_low_light_gains_and_bright_light_does_not_lose():
    scene = Scene.from_rgb(
        torch.nn.functional.interpolate(torch.rand(1, 3, 8, 8, generator=seeded()), size=(96, 96))[0]
    )
    errors = []
    for full_well in (200.0, 100_000.0):
        stages = [
            sensor.ColourFilter.kodak(),
            sensor.Mosaic(),
            sensor.Exposure(),
            sensor.ShotNoise(full_well=full_well),
            isp.Demosaic(),
            isp.Denoise(),
            isp.WhiteBalance(),
            isp.ColourMatrix(),
            isp.ToneCurve(),
        ]
        plain = Camera(*stages[:5], *stages[6:])
        clean = plain.noiseless()(scene)
        errors.append(
            [(camera(scene, generator=seeded()) - clean).square().mean() for camera in (plain, Camera(*stages))]
        )
    (dark, dark_denoised), (bright, bright_denoised) = errors
    assert dark_denoised < dark / 10**0.1  # a gain of more than 1 dB
    assert bright_denoised < 1.02 * bright


@pytest.mark.parametrize("shape", [(0, 3, 4, 4), (1, 3, 1, 1), (1, 1, 1, 7)])
def test_small_pictures_and_none(shape):
    assert isp.Denoise()(torch.full(shape, 0.4).half()).shape == shape


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"radius": 0}, "radius 0 is outside 1..16"), ({"luma": 0.0}, "luma"), ({"read_noise": -1.0}, "read_noise")],
)
def test_values_out_of_range_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        isp.Denoise(**arguments)
