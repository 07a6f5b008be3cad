"""The style measures tell colour from texture, texture from wallpaper, and a scene from what is left of it."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from scipy.stats import wasserstein_distance
from skimage import data
from torch import Tensor

sys.path.append(str(Path(__file__).parents[1]))

from benchmarks import style_measures as measures

SIDE = 128


def tinted(gray: np.ndarray) -> Tensor:
    dark, light = torch.tensor([0.1, 0.05, 0.3])[:, None, None], torch.tensor([0.95, 0.8, 0.3])[:, None, None]
    return dark + (light - dark) * torch.from_numpy(gray).float() / 255


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def blurred(picture: Tensor, sigma: float) -> Tensor:
    return torch.from_numpy(gaussian_filter(picture.numpy(), (0, sigma, sigma)))


@pytest.fixture(scope="module")
def gravel() -> Tensor:
    return tinted(data.gravel())


@pytest.fixture(scope="module")
def brick() -> Tensor:
    return tinted(data.brick())


@pytest.fixture(scope="module")
def photographs() -> dict[str, Tensor]:
    return measures.photographs(SIDE)


@pytest.fixture(scope="module")
def closed(gravel: Tensor, photographs: dict[str, Tensor]):
    style, other = gravel[:, :SIDE, :SIDE], gravel[:, -SIDE:, -SIDE:]

    def all_measures(take) -> dict[str, list[float]]:
        rows = [
            measures.measure(take(photo, style), scene=photo, ordinary=photo, style=style, other_style=other)
            for photo in photographs.values()
        ]
        return {name: [row[name] for row in rows] for name in rows[0]}

    return all_measures


def test_they_know_nothing_of_what_cameras_are_trained_on():
    tree = ast.parse(Path(measures.__file__).read_text())
    imported = [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    imported += [name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names]
    assert "torch" in imported
    assert not [name for name in imported if name.split(".")[0] == "kcam"]


@pytest.mark.parametrize("distance", [measures.patch_swd, measures.oriented_texture])
class TestBothDistances:
    def test_zero_to_itself_and_the_same_both_ways(self, distance, gravel, brick):
        a, b = gravel[:, :96, :96], brick[:, :64, :80]
        assert distance(a, a) == 0
        assert distance(a, b) == distance(b, a) > 0.005  # the smaller is .009

    def test_other_sizes_of_one_texture_are_near(self, distance, gravel, brick):
        large, small, odd = gravel[:, :256, :256], gravel[:, 300:428, 300:428], gravel[:, 256:365, :131]
        # the nearer of two different textures is 2.9 times as far as the farther of two crops of one
        far = distance(large, brick[:, :256, :256])
        assert distance(large, small) < far / 2
        assert distance(large, odd) < far / 2

    def test_a_turned_texture_is_near(self, distance, gravel):
        a = gravel[:, :128, :128]
        assert distance(a, a.rot90(1, (1, 2))) < 0.1 * distance(a, noise(3, 128, 128))

    def test_takes_what_a_camera_gives(self, distance, gravel):
        a, b = gravel[:, :64, :64], gravel[:, 64:128, 64:128]
        assert distance(a.clone().requires_grad_(), b.double()) == pytest.approx(distance(a, b), rel=1e-6)

    @pytest.mark.parametrize("shape", [(1, 64, 64), (1, 3, 64, 64), (3, 63, 64)])
    def test_refuses_what_is_no_picture_or_too_small(self, distance, shape):
        with pytest.raises(ValueError, match=r"expected a picture \(3, H, W\) of at least 64 pixels a side"):
            distance(torch.zeros(shape), torch.zeros(3, 64, 64))


@pytest.mark.parametrize(("count", "others"), [(500, 500), (700, 9000)])
def test_the_distance_along_a_line_is_the_wasserstein_distance(count, others):
    a, b = noise(4, count), noise(4, others, seed=1) ** 2 + 0.1
    exact = np.mean([wasserstein_distance(x, y) for x, y in zip(a.numpy(), b.numpy(), strict=True)])
    # 2048 quantiles for up to 9000 values; measured: within 2e-4
    assert measures._apart([measures._quantiles(a)], [measures._quantiles(b)]) == pytest.approx(exact, rel=2e-3)


def test_patches_see_colour_where_ranks_do_not(gravel):
    a = gravel[:, :96, :96]
    assert measures.patch_swd(a, a.flip(0)) > 0.05  # red and blue exchanged
    gray = a.mean(0, keepdim=True).expand(3, -1, -1)
    assert measures.oriented_texture(gray, 0.7 * gray**2.2) < 1e-9


def test_flat_pictures_have_no_texture():
    dim, bright = torch.full((3, 70, 70), 0.3), torch.full((3, 64, 99), 0.83)
    # float32 sums of 1; a texture is 1e-2 away
    assert measures.oriented_texture(dim, bright) < 1e-7


def grating(wavelength: float, degrees: float) -> Tensor:
    y, x = torch.meshgrid(torch.arange(128.0), torch.arange(128.0), indexing="ij")
    angle = torch.deg2rad(torch.tensor(degrees))
    wave = torch.sin(2 * torch.pi / wavelength * (x * angle.cos() + y * angle.sin()))
    return (0.5 + 0.4 * wave).expand(3, -1, -1)


def test_texture_is_how_coarse_and_how_directed_and_not_which_way():
    base = grating(8, 0)
    turned = measures.oriented_texture(base, grating(8, 45))
    crossed = measures.oriented_texture(base, (grating(8, 0) + grating(8, 90)) / 2)
    coarser = measures.oriented_texture(base, grating(16, 0))
    # measured: .0045, .0201, .0429
    assert turned < crossed / 3
    assert crossed < coarser / 1.5


def test_a_grating_answers_at_its_own_wavelength_and_direction():
    ranks = grating(8, 22.5)[0]
    amplitudes = {w: measures._gabor(ranks - ranks.mean(), w).square().sum(1).sqrt()[:, 64, 64] for w in (4, 8, 16)}
    assert max(amplitudes, key=lambda w: float(amplitudes[w].max())) == 8
    assert int(amplitudes[8].argmax()) == 1  # 22.5 degrees
    # the filters have gain 1/2 at the wave's own frequency: cos = half of two exponentials
    assert float(amplitudes[8].max()) == pytest.approx(0.4 / 2, rel=0.02)


def test_a_colour_match_closes_the_patches_and_not_the_texture(closed):
    histogram = closed(measures.histogram_match)
    # measured: .928, .824, .899 and .011, -.004, .000
    assert min(histogram["patch_swd"]) > 0.72
    assert max(map(abs, histogram["oriented_texture"])) < 0.15
    assert min(histogram["luminance_correlation"] + histogram["detail_correlation"]) > 0.7


def test_a_blend_has_the_texture_and_is_a_wallpaper(closed, photographs, gravel):
    blended = closed(measures.blend)
    assert np.mean(blended["oriented_texture"]) > 0.55  # measured: .675
    assert measures.wallpaper([measures.blend(x, gravel) for x in photographs.values()]) > 0.6  # measured: .82
    assert measures.wallpaper(photographs.values()) < 0.1  # measured: .03


def test_a_wallpaper_is_found_in_any_pair_of_any_sizes_and_in_the_negative(photographs, gravel):
    hopper, rocket, retina = photographs.values()
    one, other = measures.blend(rocket, gravel)[:, :100], 1 - measures.blend(retina, gravel)[:, :, :90]
    assert measures.wallpaper([one, hopper, other]) > 0.6
    with pytest.raises(ValueError, match="two or more, not 1"):
        measures.wallpaper([hopper])


def test_noise_closes_no_texture_and_the_style_itself_closes_all(closed):
    other = closed(lambda photo, style: noise(*photo.shape))
    assert np.mean(other["oriented_texture"]) < 0.15  # measured: -.46; of the three at most .12
    assert max(other["patch_swd"]) < 0.3
    assert max(map(abs, other["luminance_correlation"] + other["detail_correlation"])) < 0.1
    assert min(closed(lambda photo, style: style)["oriented_texture"]) > 1


def test_a_negative_is_told_by_its_sign(photographs):
    hopper = photographs["hopper"]
    assert measures.luminance_correlation(1 - hopper, hopper) == pytest.approx(-1)
    assert measures.detail_correlation(1 - hopper, hopper) == pytest.approx(-1)


def test_luminance_is_rec_709():
    noisy, dark = noise(3, 64, 64), torch.zeros(3, 64, 64)
    shares = []
    for channel in range(3):
        only = dark.clone()
        only[channel] = noisy[channel]
        shares.append(measures.luminance_correlation(only, noisy))
    # of three independent channels each explains its weight over the norm of the weights
    weights = np.array([0.2126, 0.7152, 0.0722])
    assert shares == pytest.approx(list(weights / np.linalg.norm(weights)), abs=0.05)  # 3 sigma of 4096 pixels


def test_detail_is_lost_where_luminance_is_not(photographs, gravel):
    # strokes over a scene of which only large patches of light are left: .65 and .48, next to 1 and 1
    strokes = gravel[:, :SIDE, :SIDE] - blurred(gravel[:, :SIDE, :SIDE], 8)
    hopper = photographs["hopper"]
    lost = (blurred(hopper, 6) + strokes).clamp(0, 1)
    assert measures.luminance_correlation(lost, hopper) > 0.6
    assert measures.detail_correlation(lost, hopper) < 0.55
    with pytest.raises(ValueError, match=r"\(3, 100, 128\) must be as large as its scene \(3, 128, 128\)"):
        measures.detail_correlation(lost[:, :100], hopper)


def test_detail_is_the_band_between_two_and_eight_pixels():
    inside, above, below = grating(20, 0), grating(4, 0), grating(128, 0)
    mixed = (inside + above + below) / 3
    assert measures.detail_correlation(mixed, inside) > 0.95
    assert measures.luminance_correlation(mixed, inside) < 0.65  # one of three equal waves: 3 ** -0.5
    flat = torch.full_like(inside, 0.5)
    assert measures.detail_correlation(flat, inside) == 0


def test_the_gap_is_closed_from_the_ordinary_picture_to_the_style():
    assert measures.gap_closed(0.25, ordinary=1.0, other=0.5) == 1.5
    assert measures.gap_closed(1.0, ordinary=1.0, other=0.5) == 0
    with pytest.raises(ValueError, match=r"no gap .* ordinary picture \(0.5\) is as near as the style \(0.5\)"):
        measures.gap_closed(0.25, ordinary=0.5, other=0.5)


def test_an_ordinary_picture_closes_nothing_and_another_crop_everything(photographs, gravel):
    hopper, style, other = photographs["hopper"], gravel[:, :SIDE, :SIDE], gravel[:, -SIDE:, -SIDE:]
    darker = hopper / 2
    found = measures.measure(darker, scene=hopper, ordinary=darker, style=style, other_style=other)
    assert found == pytest.approx(
        {"patch_swd": 0, "oriented_texture": 0, "luminance_correlation": 1, "detail_correlation": 1}
    )
    found = measures.measure(other, scene=hopper, ordinary=darker, style=style, other_style=other)
    assert (found["patch_swd"], found["oriented_texture"]) == (1, 1)


def test_the_photographs_are_pictures_of_their_own(photographs):
    assert list(photographs) == ["hopper", "rocket", "retina"]
    own = measures.photographs(None)
    for name, picture in photographs.items():
        assert picture.shape == (3, SIDE, SIDE)
        assert 0 <= picture.min() < 0.2 < 0.7 < picture.max() <= 1
        assert own[name].shape[-1] == own[name].shape[-2] >= 427
        # shrunk in linear light, the mean light stays to 1e-4; averaging coded values loses .1 to 5 % of it (measured)
        light = [measures.rgb_to_linear_rgb(x[None]).mean().item() for x in (picture, own[name])]
        assert light[0] == pytest.approx(light[1], rel=5e-4)


def test_a_blend_needs_a_style_that_covers_the_photograph(gravel):
    assert torch.equal(measures.blend(torch.zeros(3, 64, 70), gravel), gravel[:, :64, :70] / 2)
    with pytest.raises(ValueError, match=r"\(3, 60, 512\) must cover the photograph \(3, 64, 64\)"):
        measures.blend(torch.zeros(3, 64, 64), gravel[:, :60])


def waves(width: float = 6.0, *, length: float = 1000.0) -> Tensor:
    """Level strokes of even colours by chance, of a width and a length [pixel]."""
    rows, columns = torch.arange(SIDE), torch.arange(SIDE)
    row = (rows // width).long()
    start = (length * noise(int(row.max()) + 1, seed=1))[row]
    column = ((columns + start[:, None]) // length).long()
    return noise(int(row.max()) + 1, int(column.max()) + 1, 3, seed=2)[row[:, None], column].permute(2, 0, 1)


def test_strokes_that_are_broken_are_shorter() -> None:
    lengths = [measures.stroke_length(waves(length=length)) for length in (12.0, 24.0, 1000.0)]
    assert lengths[0] < lengths[1] < lengths[2]
    assert 5 < lengths[0] < 16  # the mean over places within a stroke of how far both its ends are: its own length
    contrast = measures.stroke_length(0.5 + (waves(length=24.0) - 0.5) / 4)
    assert contrast == pytest.approx(lengths[1], rel=0.05)  # contrast does not count


def test_a_stroke_has_one_colour_along_and_many_across() -> None:
    assert measures.along_across(waves()) < 0.2
    assert measures.along_across(noise(3, SIDE, SIDE)) > 0.7
    assert measures.along_across(waves(length=12.0)) > 2 * measures.along_across(waves())


def test_mazes_are_finer_than_strokes(gravel: Tensor) -> None:
    own = gravel[:, :SIDE, :SIDE]
    noisy = (own + 0.1 * (noise(1, SIDE, SIDE) - 0.5)).clamp(0, 1)
    assert measures.pixel_noise(blurred(own, 1.0)) < measures.pixel_noise(own) < measures.pixel_noise(noisy)


def test_coherence_tells_directed_from_mottled(gravel: Tensor) -> None:
    assert measures.coherence(waves(), gravel) > 4 * measures.coherence(gravel[:, :SIDE, :SIDE], gravel[:, -SIDE:])


def test_a_halo_is_an_overshoot_beside_steps() -> None:
    for photo in measures.photographs(256).values():
        sharper = (photo + (photo - blurred(photo, 6))).clamp(0, 1)
        assert abs(measures.halo(photo, photo)) < 0.06
        assert measures.halo(sharper, photo) > measures.halo(photo, photo) + 0.03


def test_a_face_is_looked_for_in_its_box(photographs) -> None:
    hopper, box = photographs["hopper"], measures.FACES["hopper"]
    top, bottom, left, right = (round(SIDE * share) for share in box)
    without = hopper.clone()
    without[:, top:bottom, left:right] = noise(3, bottom - top, right - left)
    assert abs(measures.face_correlation(without, hopper, box)) < 0.3
    assert measures.detail_correlation(without, hopper) > 0.4
    assert measures.face_correlation(hopper, hopper, box) == pytest.approx(1)


def test_the_style_s_own_is_one(gravel: Tensor, photographs) -> None:
    found = measures.seen(gravel[:, :SIDE, :SIDE], scene=photographs["hopper"], style=gravel[:, :SIDE, :SIDE])
    assert found["stroke_length"] == found["along_across"] == found["pixel_noise"] == 1
    assert found["coherence"] == 0
