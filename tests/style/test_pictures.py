from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from kcam.style import fields
from kcam.style.pictures import STYLES, painting

NAMES = [name if name == "strokes" else pytest.param(name, marks=pytest.mark.slow) for name in STYLES]  # seconds each


@pytest.fixture(scope="module")
def paintings() -> dict[str, Tensor]:
    class Painted(dict):
        """Each when it is first asked for."""

        def __missing__(self, name: str) -> Tensor:
            self[name] = painting(name)
            return self[name]

    return Painted()


def crop_means(picture: Tensor, *, crop: int = 256, stride: int = 32) -> Tensor:
    """(3, N): mean colours of all crops on a grid, around the border too."""
    wrapped = functional.pad(picture[None], (0, crop, 0, crop), mode="circular")
    return functional.avg_pool2d(wrapped, crop, stride)[0].flatten(1)


def spectrum(picture: Tensor, *, bins: int = 24) -> np.ndarray:
    """Shares of the luminance's power in rings of frequency [1/pixel], which do not depend on the picture's size."""
    gray = picture.mean(0).numpy()
    power = abs(np.fft.fft2(gray - gray.mean())) ** 2
    frequency = np.hypot(np.fft.fftfreq(gray.shape[0])[:, None], np.fft.fftfreq(gray.shape[1])[None, :])
    shares = np.histogram(frequency, bins=bins, range=(0, 0.6), weights=power)[0]
    return shares / shares.sum()


def test_the_six_styles_are_there():
    assert list(STYLES) == ["strokes", "mosaic", "woodcut", "watercolour", "pointillism", "hatching"]


@pytest.mark.parametrize("name", NAMES)
def test_the_same_seed_gives_the_same_bytes_whatever_numpy_drew_before(name):
    first = painting(name, size=64, seed=3)
    state = np.random.get_state()[1].copy()
    np.random.default_rng().random(10)
    second = painting(name, size=64, seed=3)
    assert first.numpy().tobytes() == second.numpy().tobytes()
    assert np.array_equal(np.random.get_state()[1], state)  # the global generator is not touched


@pytest.mark.parametrize("name", NAMES)
def test_another_seed_gives_another_picture_of_the_same_manner(name, paintings):
    first, other = paintings[name], painting(name, size=256, seed=1)
    # Two draws share no stroke, so luminances are unrelated: by chance +-0.1 over some 60 independent patches.
    assert abs(np.corrcoef(first[:, :256, :256].mean(0).flatten(), other.mean(0).flatten())[0, 1]) < 0.3
    assert (first.mean((1, 2)) - other.mean((1, 2))).abs().max() < 0.03  # one more crop of 256 pixels, as below


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("size", [64, (64, 96), (130, 65)])
def test_shape_type_and_range(name, size):
    picture = painting(name, size=size)
    assert picture.shape == (3, *((size, size) if isinstance(size, int) else size))
    assert picture.dtype == torch.float32
    assert picture.is_contiguous()
    assert picture.min() >= 0
    assert picture.max() <= 1
    # The tensor is what an 8-bit file holds; float32 rounds k / 255 * 255 to 255 * 6e-8 = 1.5e-5.
    assert ((255 * picture) - (255 * picture).round()).abs().max() < 1e-4


@pytest.mark.parametrize("name", NAMES)
def test_every_crop_of_256_pixels_has_the_colours_of_the_whole(name, paintings):
    picture = paintings[name]
    off = crop_means(picture) - picture.mean((1, 2))[:, None]
    assert off.abs().max() < 0.03  # measured 0.015 to 0.029, where the pixels' own spread is 0.15 to 0.32


@pytest.mark.parametrize("name", NAMES)
def test_colours_are_rich_and_hardly_clipped(name, paintings):
    picture = paintings[name]
    assert picture.std((1, 2)).min() > 0.14  # measured 0.16 to 0.23: a dull picture teaches little
    chroma = (picture.amax(0) - picture.amin(0)).mean()
    assert chroma > 0.15  # measured 0.19 to 0.43; 0 is gray
    assert ((picture == 0) | (picture == 1)).float().mean() < 0.06  # measured 0 to 0.046: navy has no red


@pytest.mark.parametrize("name", NAMES)
def test_strokes_keep_their_size_in_a_larger_picture(name, paintings):
    small, large = spectrum(paintings[name]), spectrum(painting(name, size=(256, 640), seed=2))
    # Total variation between the spectra: measured 0.013 to 0.031 for two pictures of a manner ...
    assert abs(small - large).sum() / 2 < 0.04
    # ... and 0.07 to 0.25 for the same painting at three quarters of its scale, which the measure must see.
    shrunk = functional.interpolate(paintings[name][None], scale_factor=0.75, mode="area")[0]
    assert abs(small - spectrum(shrunk)).sum() / 2 > 0.05


@pytest.mark.parametrize("name", NAMES)
def test_pictures_wrap_around(name, paintings):
    picture = paintings[name].mean(0)
    for axis in (0, 1):
        steps = (picture - picture.roll(1, axis)).abs().mean(1 - axis)
        # The step over the border is one of the 512 steps between neighbours, no edge: measured -1.6 to 0.9 deviations.
        assert steps[0] < steps[1:].mean() + 4 * steps[1:].std()


def coherence(gray: np.ndarray) -> np.ndarray:
    """Of the structure tensor in squares of 16 pixels: 1 where all lines are parallel, 0 where none is preferred."""
    gy, gx = np.gradient(gray)
    xx, yy, xy = (blocks(v) for v in (gx * gx, gy * gy, gx * gy))
    return np.sqrt((xx - yy) ** 2 + 4 * xy**2) / (xx + yy)


def blocks(values: np.ndarray, side: int = 16) -> np.ndarray:
    """Means over squares."""
    return functional.avg_pool2d(torch.from_numpy(values)[None, None], side)[0, 0].numpy()


@pytest.mark.parametrize("name", ["strokes", "woodcut", pytest.param("hatching", marks=pytest.mark.slow)])
def test_strokes_follow_their_swirls(name, paintings):
    """Directed: the local structure tensor is far more coherent than that of noise of the same spectrum."""
    gray = paintings[name].mean(0).double().numpy()
    phase = np.angle(np.fft.fft2(np.random.Generator(np.random.Philox(key=0)).standard_normal(gray.shape)))
    noise = np.fft.ifft2(abs(np.fft.fft2(gray)) * np.exp(1j * phase)).real
    assert coherence(gray).mean() > 2 * coherence(noise).mean()  # measured 0.52 to 0.60 over 0.13 to 0.18


@pytest.mark.slow
def test_dots_are_purer_than_what_they_mix_to(paintings):
    def chroma(picture: Tensor) -> float:
        return float((picture.amax(0) - picture.amin(0)).mean())

    gain = {name: chroma(paintings[name]) / chroma(functional.avg_pool2d(paintings[name], 16)) for name in STYLES}
    assert gain.pop("pointillism") > 1.05 * max(gain.values())  # measured 1.49 over 1.19 to 1.34


@pytest.mark.slow
def test_hatching_is_one_ink_on_paper(paintings):
    variances = torch.linalg.eigvalsh(paintings["hatching"].flatten(1).cov())
    assert variances[-1] > 0.995 * variances.sum()  # colours lie between two; measured 0.9999, of others 0.63 to 0.88
    gray = paintings["hatching"].mean(0)
    between = (gray - gray.min()) / (gray.median() - gray.min())
    assert ((between > 0.25) & (between < 0.75)).float().mean() < 0.22  # the strokes' rims; measured 0.17


@pytest.mark.slow
def test_hatches_tell_the_tone(monkeypatch):
    """The darker the shade, the more ink; and parallel strokes become crossed ones."""
    shades, ranks = [], fields.ranks
    monkeypatch.setattr(fields, "ranks", lambda field: shades.append(ranks(field)) or shades[-1])
    picture = painting("hatching").mean(0).double().numpy()
    (shade,) = (blocks(field) for field in shades)
    assert np.corrcoef(shade.ravel(), blocks(picture).ravel())[0, 1] < -0.9  # measured -0.96
    tones = [(shade > low) & (shade < high) for low, high in pairwise((0.3, 0.55, 0.77, 1.0))]
    one, two, three = (coherence(picture)[tone].mean() for tone in tones)
    assert one > 1.2 * two > 1.2**2 * three  # measured 0.65, 0.46, 0.26


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": "fresco"}, '"fresco": expected one of strokes, mosaic, woodcut, watercolour, pointillism, hatching'),
        ({"name": "strokes", "size": 63}, "size 63 of a style picture: expected .* 64 to 2048 .* Try size=512"),
        ({"name": "strokes", "size": (64, 4096)}, r"size \(64, 4096\) of a style picture"),
        ({"name": "strokes", "size": (64, 64, 3)}, r"size \(64, 64, 3\) of a style picture"),
        ({"name": "strokes", "size": (64.0, 64)}, "whole pixels"),
        ({"name": "strokes", "seed": -1}, r"seed -1 of a style picture: expected 0 to 2\*\*63 - 1. Try seed=0"),
    ],
)
def test_errors_say_what_was_expected(arguments, message):
    with pytest.raises(ValueError, match=message):
        painting(**arguments)
