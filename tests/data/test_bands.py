"""The matrix between grids of wavelengths: exact where it can be, and errors on the colour chart as numbers."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import writers
from scipy.io import savemat

from kcam import spectral
from kcam.data import CubeError, parse_bands, read_cube, resampling, write_cube
from kcam.data.bands import COARSER, METHODS, band_text
from kcam.data.readers import CASSI_NM, open_source, resampled
from kcam.units import nm

S31 = np.arange(400, 701, 10.0) * nm
T28 = np.linspace(420, 700, 28) * nm


def chart(points: np.ndarray) -> np.ndarray:
    """The 24 measured reflectances (24,L), by colour-science's own interpolation: none of kcam's."""
    import colour

    rows = []
    for spectrum in colour.SDS_COLOURCHECKERS["BabelColor Average"].values():
        interpolator = colour.SpragueInterpolator(spectrum.wavelengths, spectrum.values)
        rows.append(interpolator(points / nm))
    return np.asarray(rows)


def rms(source: np.ndarray, target: np.ndarray, method: str) -> float:
    matrix = resampling(source, target, method=method).matrix
    return float(np.sqrt(np.mean((chart(source) @ matrix.T - chart(target)) ** 2)))


@pytest.mark.parametrize("method", METHODS)
def test_rows_add_up_to_one_and_grid_points_are_kept(method: str) -> None:
    for source, target in ((S31, T28), (S31, S31), (np.asarray(CASSI_NM) * nm, T28[4:20]), (T28, np.array([550 * nm]))):
        found = resampling(source, target, method=method)
        np.testing.assert_allclose(found.matrix.sum(1), 1, atol=1e-12)  # white stays white, to float64's rounding
        assert not found.extrapolated.any()
    np.testing.assert_allclose(resampling(S31, S31, method=method).matrix, np.eye(31), atol=1e-12)


def test_pchip_makes_no_negative_values_of_those_that_are_not() -> None:
    random = np.random.default_rng(0)
    spectra = np.concatenate([random.uniform(0, 1, (2000, 31)) ** 8, np.eye(31)])  # spiky: cubic overshoots on these
    for target in (T28, np.linspace(420, 700, 97) * nm, np.linspace(420, 680, 9) * nm):
        assert resampling(S31, target).apply(spectra.T).min() >= 0
        dark = spectra.T - 0.1  # noise about black: nothing falls below the darkest band
        assert (resampling(S31, target).apply(dark).min(0) >= dark.min(0) - 1e-6).all()
    assert (spectra @ resampling(S31, T28).matrix.T).min() < -0.01
    assert resampling(S31, T28, method="cubic").apply(spectra.T).min() < -0.01


@pytest.mark.parametrize(
    ("method", "bound"),
    [
        # Measured: cubic 0.00005, Hermite 0.00015. Fritsch and Carlson's limiter, which is no matrix, has 0.00026,
        # linear 0.00115. A tenth above.
        ("cubic", 0.000055),
        ("pchip", 0.00029),
    ],
)
def test_errors_on_the_colour_chart_from_31_to_28_bands(method: str, bound: float) -> None:
    assert rms(S31, T28, method) < bound


def test_the_chart_of_kcam_is_that_of_colour_science() -> None:
    # Sprague (order 5) against cubics, between samples 10 nm apart
    np.testing.assert_allclose(spectral.reflectances(torch_grid(T28)).numpy(), chart(T28), atol=1e-3)


def torch_grid(points: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(points)


def test_no_band_reaches_beyond_the_chart_of_a_coarser_grid() -> None:
    """A coarser target is the mean over its band: against integration at 1 nm of the chart."""
    fine = np.arange(400, 701, 2.0) * nm
    target = np.linspace(430, 670, 9) * nm  # 30 nm apart
    truth = np.stack([chart(np.linspace(c - 15 * nm, c + 15 * nm, 301)).mean(1) for c in target], axis=1)
    sampled = chart(target)
    for method in METHODS:
        made = chart(fine) @ resampling(fine, target, method=method).matrix.T
        assert (
            np.abs(made - truth).max() < 1e-3
        )  # 33 samples a band: (30/33)^2 / 24 of the curvature, and measured 2e-4
    assert np.abs(sampled - truth).max() > 5e-3  # so averaging is not the same as sampling


def test_when_it_averages() -> None:
    fine = np.arange(400, 701, 10.0) * nm
    just_below = np.arange(420, 680, 10 * COARSER - 0.1) * nm
    assert np.count_nonzero(resampling(fine, just_below[:1]).matrix[0]) <= 4  # one band has no width
    row = resampling(fine, np.array([450, 500, 550.0]) * nm).matrix[1]
    np.testing.assert_allclose(row @ fine, 500 * nm, rtol=1e-6)  # symmetric about its band
    used = fine[row > 1e-9] / nm
    assert used.min() <= 480  # a band 50 nm wide takes 475 to 525 nm
    assert used.max() >= 520
    assert np.count_nonzero(resampling(fine, just_below).matrix[1] > 1e-9) <= 4


def test_any_order_of_source_and_target() -> None:
    random = np.random.default_rng(1)
    p, q = random.permutation(31), random.permutation(28)
    straight = resampling(S31, T28).matrix
    np.testing.assert_allclose(resampling(S31[p], T28[q]).matrix, straight[q][:, p], atol=1e-15)
    coarse = np.linspace(430, 670, 5) * nm
    mixed = random.permutation(5)
    np.testing.assert_allclose(
        resampling(S31[p], coarse[mixed]).matrix, resampling(S31, coarse).matrix[mixed][:, p], atol=1e-15
    )


def test_extrapolation_is_an_error_unless_held_and_then_marked() -> None:
    target = np.linspace(420, 720, 28) * nm
    with pytest.raises(ValueError, match=r"1 of 28 bands lie outside of the source's 400 to 700 nm"):
        resampling(S31, np.append(T28[:-1], 720 * nm))
    with pytest.raises(ValueError, match="2 of 28 bands"):
        resampling(S31, target)
    held = resampling(S31, target, edge="hold")
    assert held.extrapolated.tolist() == [False] * 26 + [True] * 2
    np.testing.assert_allclose(held.matrix[26:], np.eye(31)[[30, 30]], atol=1e-12)
    assert not resampling(S31, np.array([399.95]) * nm).extrapolated.any()  # 0.1 nm is within any calibration


def test_errors_in_words() -> None:
    with pytest.raises(ValueError, match="unknown method 'spline'; known: pchip, cubic"):
        resampling(S31, T28, method="spline")
    with pytest.raises(ValueError, match="unknown edge 'guess'; known: error, hold"):
        resampling(S31, T28, edge="guess")
    with pytest.raises(ValueError, match="the same wavelength, 410 nm"):
        resampling(np.append(S31, 410 * nm), T28)


def test_parse_bands() -> None:
    np.testing.assert_allclose(parse_bands("420:720:28"), np.linspace(420, 720, 28) * nm, rtol=1e-15)
    assert parse_bands("550:550:1").tolist() == [550 * nm]
    for text in (
        "420:720",
        "a:b:c",
        "720:420:28",
        "420:720:0",
        "420:420:2",
        "-1:3:4",
        "",
        "420:720:28:1",
        "nan:720:3",
        "420:720:9999999999",
    ):
        with pytest.raises(ValueError, match="start:stop:count"):
            parse_bands(text)
    with pytest.raises(ValueError, match="outside 1e-07"):
        parse_bands("1:50:3")
    assert band_text(parse_bands("420:720:28")) == "28 bands, 420 to 720 nm"
    assert band_text(parse_bands("550:550:1")) == "1 band, 550 to 550 nm"


def test_cassi_onto_the_default_bands_says_how_many_are_guesses(tmp_path) -> None:
    path = writers.cassi(tmp_path).path
    target = parse_bands("420:720:28")
    source = open_source(path)
    with pytest.raises(CubeError, match=r"11 of 28 bands lie outside of the source's 453\.5 to 648 nm"):
        resampled(source, target)
    held = resampled(source, target, edge="hold")
    assert held.extrapolated.sum() == 11
    assert held.facts["resampled"] == "pchip from 28 bands"
    cube = held.cube()
    assert (~cube.mask).all(dim=(1, 2)).sum() == 11
    write_cube(tmp_path / "held.tif", cube)
    again = read_cube(tmp_path / "held.tif")
    assert (again.mask == cube.mask).all()
    assert (again.values == cube.values).all()  # what was held is kept, and marked
    # a band that leans on a guess is a guess: here the two nearest to each end of what was measured
    onward = resampled(open_source(tmp_path / "held.tif"), parse_bands("425:715:28"))
    assert onward.extrapolated.sum() >= 11


def test_resampling_keeps_the_mask_and_works_by_strips(tmp_path) -> None:
    written = writers.envi(tmp_path, ignore=True)
    target = parse_bands("420:700:28")
    source = resampled(open_source(written.path), target)
    cube = source.cube()
    assert (cube.mask.numpy() == written.mask).all()
    matrix = resampling(np.asarray(written.nm) * nm, target).matrix
    expected = np.einsum("ts,shw->thw", matrix, written.values)[:, written.mask]
    np.testing.assert_allclose(cube.values.numpy()[:, written.mask], expected, atol=1e-6)  # float32
    part, _ = source.checked_rows(3, 5)
    np.testing.assert_allclose(part, cube.values[:, 3:5].numpy(), atol=1e-6)


def test_the_same_grid_is_left_alone(tmp_path) -> None:
    savemat(tmp_path / "a.mat", {"HSI": writers.cube(28).transpose(1, 2, 0)})
    source = open_source(tmp_path / "a.mat")
    assert resampled(source, source.wavelengths.copy()) is source
