"""A chart's patches and the matrix from them, against colour-science and a camera of numpy."""

from __future__ import annotations

import math

import colour
import numpy as np
import pytest
import torch

from kcam import Camera, isp, sensor, spectral
from kcam.calibration import ColourFit, chart_patches, colour_matrix, delta_e

WAVELENGTHS = np.arange(380, 731, 5.0)
CHART = colour.SDS_COLOURCHECKERS["BabelColor Average"]
OBSERVER = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]


def spectra() -> np.ndarray:
    """Reflectances of the patches (24, L) by colour-science's interpolation."""
    shape = colour.SpectralShape(380, 730, 5)
    return np.stack([sd.copy().align(shape).values for sd in CHART.values()])


def light(name: str) -> np.ndarray:
    return colour.SDS_ILLUMINANTS[name].copy().align(colour.SpectralShape(380, 730, 5)).values


def curves(seed: int) -> np.ndarray:
    """Sensitivities of a camera that kcam has not: skewed bumps."""
    draws = np.random.default_rng(seed)
    peaks = np.array([600.0, 535.0, 455.0]) + draws.normal(0, 5, 3)
    widths = np.array([38.0, 42.0, 30.0]) * draws.uniform(0.9, 1.1, 3)
    at = WAVELENGTHS[:, None]
    return np.exp(-0.5 * ((at - peaks) / (widths * np.where(at > peaks, 1.15, 0.9))) ** 2).T


def camera_raw(seed: int, illuminant: str, *, exposure: float = 0.8) -> tuple[np.ndarray, np.ndarray]:
    """Raw of the patches (24, 3) and of a perfect white (3,), whose green has this exposure."""
    seen = curves(seed) * light(illuminant)
    seen = seen / seen.sum(1)[1]
    return exposure * spectra() @ seen.T, exposure * seen.sum(1)


def lab(linear: np.ndarray) -> np.ndarray:
    """By colour-science, of linear sRGB with the white that the library's matrix has."""
    to_xyz = torch.linalg.inv(spectral.xyz_to_srgb_matrix()).numpy()
    white = to_xyz.sum(1)
    return colour.XYZ_to_Lab(linear @ to_xyz.T, white[:2] / white.sum())


def test_delta_e_is_that_of_colour_science() -> None:
    draws = np.random.default_rng(0)
    one = draws.uniform(0, 1, (3000, 3))
    other = np.concatenate([one[:1500] + draws.normal(0, 0.02, (1500, 3)), draws.uniform(0, 1, (1500, 3))])
    ours = delta_e(torch.from_numpy(one), torch.from_numpy(other)).numpy()
    assert ours == pytest.approx(colour.delta_E(lab(one), lab(other), method="CIE 2000"), abs=1e-5)


def test_delta_e_has_its_gradient_and_a_finite_one_where_colours_agree_or_are_gray() -> None:
    draws = torch.Generator().manual_seed(0)
    one, other = (0.1 + 0.8 * torch.rand(6, 3, generator=draws, dtype=torch.float64) for _ in range(2))
    assert torch.autograd.gradcheck(delta_e, (one.requires_grad_(), other.requires_grad_()))
    same = torch.tensor([[0.5, 0.5, 0.5], [0.0, 0.0, 0.0], [0.2, 0.4, 0.1]], dtype=torch.float64, requires_grad=True)
    value = delta_e(same, same.detach())
    value.sum().backward()
    assert same.grad is not None
    assert bool(same.grad.isfinite().all())
    assert float(value.detach().max()) < 1e-4


@pytest.mark.parametrize("illuminant", ["D65", "A", "D50"])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_the_errors_reported_are_those_of_colour_science(seed: int, illuminant: str) -> None:
    """Through the stages, by the oracle's own spectra, illuminants and observer."""
    raw, _ = camera_raw(seed, illuminant)
    fit = colour_matrix(torch.from_numpy(raw), illuminant=illuminant)
    planes = torch.from_numpy(raw).T.reshape(1, 3, 4, 6)
    for stage in fit.stages():
        planes = stage(planes)
    found = lab(planes[0].flatten(1).T.numpy())
    shape = OBSERVER.shape
    seen = colour.SDS_ILLUMINANTS["D65"].copy().align(shape).values[:, None] * OBSERVER.values
    white = seen.sum(0) / seen[:, 1].sum()
    xyz = np.stack([sd.copy().align(shape).values for sd in CHART.values()]) @ seen / seen[:, 1].sum()
    truth = colour.XYZ_to_Lab(xyz, white[:2] / white.sum())
    theirs = colour.delta_E(found, truth, method="CIE 2000")
    assert fit.delta_e.numpy() == pytest.approx(theirs, rel=0.01, abs=0.03)
    assert fit.mean == pytest.approx(theirs.mean(), rel=0.01)
    assert fit.mean < 4
    assert fit.worst == float(fit.delta_e.max())
    assert fit.mean < fit.unseen_delta_e < 3 * fit.mean


@pytest.mark.parametrize("illuminant", ["D65", "A", "D50"])
@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2))])
def test_the_white_of_all_patches_is_that_of_a_perfect_white(seed: int, illuminant: str) -> None:
    raw, white = camera_raw(seed, illuminant, exposure=3.7)
    fit = colour_matrix(torch.from_numpy(raw), illuminant=illuminant)
    assert fit.white.numpy() == pytest.approx(white, rel=0.01)
    assert fit.gains.numpy() == pytest.approx(white[1] / white, rel=0.015)
    assert fit.matrix.sum(1).numpy() == pytest.approx(np.ones(3), abs=1e-9)


def test_it_is_better_than_least_squares_in_what_is_seen() -> None:
    for seed in range(4):
        raw = torch.from_numpy(camera_raw(seed, "D65")[0])
        fit = colour_matrix(raw, illuminant="D65")
        _, wavelengths, reflectances = spectral.colour_chart()
        colours = reflectances @ spectral.xyz_weights(wavelengths, "D65") @ spectral.xyz_to_srgb_matrix().T
        plain = isp.fit_colour_matrix(raw / fit.white, colours=colours)
        before = delta_e(raw / fit.white @ plain.T, colours)
        assert float(fit.delta_e.square().mean()) < 0.95 * float(before.square().mean())


def test_noise_of_the_patches_moves_the_colours_by_little() -> None:
    raw = camera_raw(0, "D65")[0]
    noisy = raw * (1 + np.random.default_rng(0).normal(0, 2e-3, raw.shape))
    clean, other = (colour_matrix(torch.from_numpy(values), illuminant="D65") for values in (raw, noisy))
    assert other.mean == pytest.approx(clean.mean, abs=0.15)


def test_exposure_does_not_count_and_the_stages_stand_in_a_camera() -> None:
    raw = torch.from_numpy(camera_raw(1, "D65")[0])
    one, other = (colour_matrix(scale * raw, illuminant="D65") for scale in (1.0, 7.0))
    assert one.matrix.numpy() == pytest.approx(other.matrix.numpy(), abs=1e-6)
    white = torch.full((1, 3, 1, 1), 0.8) / one.gains[:, None, None].float()
    camera = Camera(*one.stages(white_share=0.8), isp.ToneCurve())
    assert float((camera(white) - 1).abs().max()) < 1e-3
    assert "dark skin" in str(one)


# ---- patches ---------------------------------------------------------------------------------------------------------

CORNERS = np.array([[21.0, 15.0], [171.0, 30.0], [160.0, 128.0], [12.0, 110.0]])


def drawn(values: np.ndarray, corners: np.ndarray = CORNERS, *, gap: float = 0.1, size: tuple[int, int] = (140, 190),
          ) -> np.ndarray:  # fmt: skip
    """(3, H, W) of a chart in perspective, with dark gaps between the patches, by OpenCV's homography."""
    import cv2

    fine = 60
    board = np.full((4 * fine, 6 * fine, 3), 0.02)
    for k, value in enumerate(values):
        row, column = divmod(k, 6)
        edge = int(gap * fine / 2)
        board[row * fine + edge : (row + 1) * fine - edge, column * fine + edge : (column + 1) * fine - edge] = value
    # pixel centres: the board's outer edge lies half a pixel outside of its first pixel's middle
    source = np.array([[-0.5, -0.5], [6 * fine - 0.5, -0.5], [6 * fine - 0.5, 4 * fine - 0.5], [-0.5, 4 * fine - 0.5]])
    mapping = cv2.getPerspectiveTransform(source.astype(np.float32), corners.astype(np.float32))
    picture = cv2.warpPerspective(board, mapping, size[::-1], flags=cv2.INTER_AREA, borderValue=(0.3, 0.3, 0.3))
    return np.moveaxis(picture, -1, 0)


def test_patches_in_perspective_come_back_with_their_errors() -> None:
    raw = camera_raw(0, "D65")[0]
    clean = drawn(raw)
    noisy = clean + np.random.default_rng(0).normal(0, 0.01, clean.shape)
    found = chart_patches(torch.from_numpy(noisy), corners=CORNERS)
    assert found.names[18].startswith("white")
    deviation = (found.values.numpy() - raw) / found.standard_errors.numpy()
    assert (np.abs(deviation) < 2).mean() > 0.9
    assert np.abs(deviation).max() < 4.5
    assert colour_matrix(found, illuminant="D65").mean < 3


@pytest.mark.parametrize("pattern", ["RGGB", "x_trans"])
def test_a_mosaic_gives_each_channel_from_its_own_pixels(pattern: str) -> None:
    raw = camera_raw(0, "D65")[0]
    planes = torch.from_numpy(drawn(raw))[None]
    found = chart_patches(sensor.mosaic(planes, pattern=pattern), corners=CORNERS, pattern=pattern)
    assert found.values.numpy() == pytest.approx(raw, abs=2e-3)


def test_black_taken_off_a_saturated_chart_leaves_patches_that_are_seen() -> None:
    raw, draws = camera_raw(0, "D65")[0], np.random.default_rng(0)
    black = 64 / 4095
    for exposure, clipped in ((0.9, False), (1.15, True), (2.0, True)):  # white reflects 0.9
        clean = exposure / 0.8 * drawn(raw)
        noisy = clean + draws.normal(0, 1, clean.shape) * np.sqrt(1e-6 + clean.clip(0) / 10_000)
        picture = torch.from_numpy(((noisy + black).clip(0, 1) * 4095).round() / 4095 - black)
        for given in (picture, picture.float(), 4095 * picture):
            if clipped:
                with pytest.raises(ValueError, match="saturated patches: .*white.*, at .* and above"):
                    chart_patches(given, corners=CORNERS)
            else:
                chart_patches(given, corners=CORNERS)


@pytest.mark.parametrize("illuminant", ["D65", "A"])
@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2))])
def test_red_taken_for_blue_warns(seed: int, illuminant: str) -> None:
    raw = torch.from_numpy(camera_raw(seed, illuminant)[0])
    colour_matrix(raw, illuminant=illuminant)
    with pytest.warns(UserWarning, match="they are swapped, or the pattern is off by a row and a column"):
        colour_matrix(raw.flip(1), illuminant=illuminant)


RAW = camera_raw(0, "D65")[0]


@pytest.mark.parametrize(
    ("picture", "more", "text"),
    [
        (drawn(RAW), {"corners": CORNERS + np.array([30, 0])}, r"corner \(201, 30\) lies outside"),
        (drawn(RAW), {"corners": CORNERS[[0, 2, 1, 3]]}, "do not enclose a convex"),
        (drawn(RAW), {"corners": CORNERS[:3]}, r"four corners .* got shape \(3, 2\)"),
        (drawn(RAW), {"corners": "here"}, "four corners"),
        (drawn(RAW), {"corners": CORNERS[[2, 3, 0, 1]]}, "the chart seems upside down"),
        (drawn(RAW), {"corners": CORNERS[[1, 0, 3, 2]]}, "the chart seems mirrored"),
        (drawn(RAW), {"corners": CORNERS + np.array([[12, 8], [-12, 8], [-12, -8], [12, -8]])}, "uneven patches: "),
        (np.minimum(3 * drawn(RAW), 1), {}, "saturated patches: .*white"),
        (drawn(RAW) * np.nan, {}, "NaN or infinite"),
        (drawn(RAW)[0], {}, r"expected \(C,H,W\)"),
        (drawn(RAW)[:1], {}, "give its pattern, such as pattern='RGGB'"),
        (drawn(RAW), {"pattern": "RGGB"}, "a mosaic has one channel, got 3"),
        (drawn(RAW), {"corners": [(10, 10), (20, 10), (20, 17), (10, 17)]}, "holds . pixels of a channel"),
        (np.random.default_rng(0).normal(0.5, 0.01, (3, 140, 190)), {}, "not the 24 patches"),
    ],
)  # fmt: skip
def test_what_is_no_chart_says_why(picture: np.ndarray, more: dict[str, object], text: str) -> None:
    with pytest.raises((TypeError, ValueError), match=text):
        chart_patches(torch.from_numpy(picture), **({"corners": CORNERS} | more))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("raw", "illuminant", "text"),
    [
        (RAW.T, "D65", r"Use raw_patches.T"),
        (RAW[:20], "D65", r"must be \(24, C\)"),
        (RAW - 0.1, "D65", "too much black subtracted"),
        (RAW * np.nan, "D65", "NaN or infinite"),
        (RAW * [1, 1, 0], "D65", "saw no light"),
        (RAW[::-1].copy(), "D65", "seems upside down"),
        (RAW, "D66", "D66"),
        (RAW, torch.ones(5), r"expected one value per band: \(36,\)"),
    ],
)
def test_raw_that_cannot_be_a_chart_s_says_why(raw: np.ndarray, illuminant: str | torch.Tensor, text: str) -> None:
    with pytest.raises((TypeError, ValueError), match=text):
        colour_matrix(torch.from_numpy(raw), illuminant=illuminant)


def test_the_result_is_a_value() -> None:
    fit = colour_matrix(torch.from_numpy(RAW), illuminant="D65")
    assert isinstance(fit, ColourFit)
    with pytest.raises(AttributeError):
        fit.matrix = torch.eye(3)  # type: ignore[misc]
    assert math.isfinite(fit.unseen_delta_e)
