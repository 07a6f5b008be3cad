"""What a new user hands in: arrays, wrong scales, masks that are no depth, words that are no argument."""

from __future__ import annotations

import kornia.augmentation as K
import numpy as np
import pytest
import torch
from PIL import Image

import kcam.augmentation as KC
from kcam import Camera, isp, optics, sensor
from kcam.units import mm, um

PICTURE = torch.rand(1, 3, 24, 32, generator=torch.Generator().manual_seed(0))
PIXELS = (PICTURE[0].permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
MAP = torch.ones(1, 1, 24, 32)


@pytest.mark.parametrize("name", ["RandomDefocus", "RandomShotReadNoise", "RandomLensDistortion", "RandomBayer"])
def test_arrays_become_float32(name: str) -> None:
    """Kornia makes a picture in the type of a module's first buffer: double would not fit the user's network."""
    for container in (K.AugmentationSequential, KC.CameraSequential):
        for given in (PIXELS, Image.fromarray(PIXELS)):
            assert container(getattr(KC, name)(p=1.0))(given).dtype == torch.float32
    assert KC.corrupt(PIXELS, "defocus", severity=2).dtype == torch.float32


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow) if name == "real_lens" else name for name in sorted(KC.CORRUPTIONS)],
)
def test_a_corruption_does_not_depend_on_the_batch(name: str) -> None:
    alone = KC.corrupt(PICTURE, name, severity=3)
    assert torch.equal(KC.corrupt(PICTURE.expand(3, -1, -1, -1), name, severity=3)[:1], alone)


@pytest.mark.parametrize("bands", [3, 28, 31])
def test_plain_stages_take_the_bands_that_come_in(bands: int) -> None:
    lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(8 * mm), focus_distance=2.0)
    stages = KC.CameraSequential(
        optics.Imaging(lens, pixel_pitch=4 * um, psf_shape=(9, 9)),
        sensor.ColourFilter.kodak(),
        sensor.Mosaic(),
        isp.Demosaic(),
        isp.WhiteBalance(),
    )
    assert stages(torch.ones(2, bands, 16, 20)).shape == (2, 3, 16, 20)


def test_plain_stages_are_told_the_wavelengths() -> None:
    """Under light of one wavelength a filter gives what its curve has there."""
    chosen = KC.CameraSequential(sensor.ColourFilter.kodak(), wavelengths=[450e-9, 460e-9])
    usual = KC.CameraSequential(sensor.ColourFilter.kodak())
    red, _, blue = chosen(torch.ones(1, 2, 1, 1)).flatten().tolist()
    assert blue > 5 * red
    red, _, blue = usual(torch.ones(1, 2, 1, 1)).flatten().tolist()  # 420 and 720 nm
    assert blue < 5 * red


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: KC.RandomExposure(float("inf")), ValueError, "stops must be .* finite, got"),
        (lambda: KC.RandomDefocus(p=1.0)(PICTURE * 255), ValueError, r"expected sRGB in \[0,1\]. Use image / 255"),
        (lambda: KC.RandomVignetting(p=1.0)(PICTURE * torch.nan), ValueError, "Remove NaN and inf"),
        (lambda: KC.RandomDefocus(p=1.0)(PICTURE, depth=MAP), TypeError, "give inverse_depth=1 / depth"),
        (lambda: KC.RandomVignetting(p=1.0)(PICTURE, inverse_depth=MAP), TypeError, "takes no inverse_depth"),
        (lambda: KC.RandomBayer(3), TypeError, "pattern must be"),
        (lambda: KC.RandomQuantisation(8.5), ValueError, "bits must be whole numbers"),
        (lambda: KC.RandomQuantisation([8, 10, 12]), ValueError, "bits must be whole numbers"),
        (lambda: KC.RandomCamera([3]), TypeError, "cameras must be names, files or cameras"),
        (lambda: KC.corrupt("a.png", "defocus"), TypeError, "name of a file: use kcam.scene.read_picture"),
        (lambda: KC.corrupt(PICTURE, "defocus", seed="a"), TypeError, "seed must be an integer"),
        (lambda: KC.RandomDefocus(p=2.0), ValueError, "p must be a probability from 0 to 1"),
        (lambda: KC.RandomLensDistortion(p="a"), TypeError, "p must be a probability"),
        (lambda: KC.RandomLensDistortion(resample="cubic"), ValueError, 'resample must be "bilinear" or "nearest"'),
    ],
)
def test_what_cannot_be_meant(call, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        call()


def test_a_mask_of_classes_is_no_depth() -> None:
    pipeline = KC.CameraSequential(KC.RandomDefocus(p=1.0), data_keys=["input", "mask"])
    classes = torch.ones(1, 1, 24, 32, dtype=torch.int64)
    with pytest.raises(TypeError, match="classes, it seems. Say depth=False"):
        pipeline(PICTURE, classes)
    with pytest.warns(UserWarning, match=r"reaches 255 1/m, 3.9 mm from the lens"):
        pipeline(PICTURE, MAP * 255)
    plain = KC.CameraSequential(KC.RandomDefocus(p=1.0), data_keys=["input", "mask"], depth=False)
    assert torch.equal(plain(PICTURE, classes)[1], classes)
    geometry = KC.CameraSequential(K.RandomHorizontalFlip(p=1.0), data_keys=["input", "mask"])
    assert torch.equal(geometry(PICTURE, classes)[1], classes)  # no stage asks for a depth


def test_values_a_little_above_white_are_white() -> None:
    bright = PICTURE.clone()
    bright[..., 0, 0] = 1.3
    result = KC.RandomExposure(0.0, p=1.0)(bright)
    assert result.max() <= 1
    assert np.isclose(float(result[..., 0, 0].min()), 1.0)


def test_between_filter_and_tone_curve_the_light_is_linear() -> None:
    """A raw plane has one channel, as a gray picture has: it must not be taken through the sRGB curve."""
    noise = KC.RandomShotReadNoise(iso=400.0, p=1.0)
    stages = sensor.ColourFilter.kodak(), sensor.Exposure(), sensor.Mosaic("RGGB")
    cube = torch.rand(2, 28, 12, 14, generator=torch.Generator().manual_seed(1))
    pipeline = KC.CameraSequential(
        *stages, noise, isp.Demosaic(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve()
    )
    result = pipeline(cube)
    seeds = pipeline._params[3].data["noise_seed"]
    clean = Camera(*stages)(cube)
    expected = []
    for plane, seed in zip(clean.split(1), seeds.tolist(), strict=True):
        generator = torch.Generator().manual_seed(seed)
        counted = sensor.shot_noise(plane / 4, full_well=10_000.0, generator=generator)
        read = sensor.read_noise(counted, sigma_electrons=3.0, full_well=10_000.0, generator=generator)
        expected.append((read * 4).clamp(max=1))
    developed = Camera(*stages, isp.Demosaic(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve())[3:](
        torch.cat(expected)
    )
    assert (result - developed).abs().max() < 1e-5
    nested = K.ImageSequential(pipeline)
    assert nested(cube).shape == (2, 3, 12, 14)
    # behind the tone curve it is a picture again
    after = KC.CameraSequential(*stages, isp.Demosaic(), isp.ColourMatrix(), isp.ToneCurve(), noise)
    assert after(cube).max() <= 1
    assert after.told("RandomShotReadNoise_6") == {}
    assert pipeline.told("RandomShotReadNoise_3") != {}
