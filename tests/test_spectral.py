from __future__ import annotations

import sys
import warnings
from pathlib import Path
from types import ModuleType
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize
from torch import Tensor

from kcam import spectral
from kcam.spectral.bands import cubic_weights
from kcam.units import nm, wavelength_grid

DEFAULT = wavelength_grid()
TENS = torch.arange(400, 701, 10, dtype=torch.float64) * nm
CASSI = [453.5, 457.5, 462, 466, 471.5, 476.5, 481.5, 487, 492.5, 498, 504, 510, 516, 522.5]
CASSI += [529.5, 536.5, 544, 551.5, 558.5, 567.5, 575.5, 584.5, 594.5, 604, 614.5, 625, 636.5, 648]
CASSI = torch.tensor(CASSI, dtype=torch.float64) * nm
FINE = torch.arange(360, 831, dtype=torch.float64) * nm

grids = st.lists(st.integers(3600, 8300), min_size=1, max_size=40, unique=True)


@pytest.fixture(scope="session")
def observer(colour: ModuleType):
    return colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]


def as_colour_sees(colour: ModuleType, observer, spectra: list, lamp: str) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        light = colour.SDS_ILLUMINANTS[lamp]
        return np.stack([colour.sd_to_XYZ(sd, observer, light, method="Integration") / 100 for sd in spectra])


def delta_e(colour: ModuleType, xyz: np.ndarray, other: np.ndarray, white: np.ndarray) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        labs = [colour.XYZ_to_Lab(value, white[:2] / white.sum()) for value in (xyz, other)]
        return colour.delta_E(*labs, method="CIE 2000")


class TestTables:
    def test_committed_tables_are_what_the_tool_writes(self, tables: ModuleType) -> None:
        built = tables.build()
        assert {path.stem for path in tables.TABLES.glob("*.npz")} == set(built)
        for name, arrays in built.items():
            with np.load(tables.TABLES / f"{name}.npz") as stored:
                assert set(stored) == set(arrays)
                for key, values in arrays.items():
                    assert stored[key].dtype == values.dtype
                    if np.issubdtype(values.dtype, np.inexact):  # other processors sum in another order
                        scale = np.abs(values).max(initial=0)
                        np.testing.assert_allclose(stored[key], values, rtol=1e-12, atol=1e-14 * scale)
                    else:
                        np.testing.assert_array_equal(stored[key], values)

    def test_the_tool_writes_the_same_bytes(self, tables: ModuleType, tmp_path: Path, monkeypatch) -> None:
        monkeypatch.setattr(tables, "TABLES", tmp_path)
        tables.main()
        first = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
        tables.main()
        assert first == {path.name: path.read_bytes() for path in tmp_path.iterdir()}
        assert sum(map(len, first.values())) < 100_000

    def test_importing_colour_leaves_no_mocks(self, colour: ModuleType) -> None:
        assert not [name for name, module in sys.modules.items() if isinstance(module, MagicMock)]


class TestIlluminant:
    @pytest.mark.parametrize("name", spectral.illuminant_names())
    @pytest.mark.parametrize("grid", [DEFAULT, TENS], ids=["default", "tens"])
    def test_white_point_is_that_of_colour_science(self, colour, observer, name: str, grid: Tensor) -> None:
        light = spectral.illuminant(name, wavelengths=grid)
        assert light.dtype == torch.float64
        assert light.shape == grid.shape
        assert (light > 0).all()
        white = as_colour_sees(colour, observer, [colour.sd_ones(observer.shape)], name)[0]
        torch.testing.assert_close((light @ spectral.xyz_weights(grid)).numpy(), white, rtol=0, atol=1e-12)

    def test_names_cover_daylight_tungsten_tubes_and_leds(self) -> None:
        assert {"A", "D50", "D65", "E", "FL2", "FL11", "LED-B3"} <= set(spectral.illuminant_names())

    def test_equal_energy_is_one(self) -> None:
        for grid in (DEFAULT, CASSI, DEFAULT[:1]):
            torch.testing.assert_close(
                spectral.illuminant("E", wavelengths=grid), torch.ones(len(grid)).double(), rtol=0, atol=1e-12
            )

    def test_a_is_a_planckian_radiator(self) -> None:
        planck = DEFAULT**-5 / (torch.exp(1.4388e-2 / (DEFAULT * 2856)) - 1)
        ratio = spectral.illuminant("A", wavelengths=DEFAULT) / planck
        assert (ratio / ratio.mean() - 1).abs().max() < 0.006

    def test_lines_are_averaged_over_the_band(self) -> None:
        # The green mercury line, 546 nm, lies between two of the bands: a sample there would miss or exaggerate it.
        totals = []
        for shift in range(0, 11):
            grid = torch.arange(400 + shift, 700 + shift, 11, dtype=torch.float64) * nm
            light = spectral.illuminant("FL11", wavelengths=grid)
            totals.append(light[(grid > 515 * nm) & (grid < 575 * nm)].sum().item())
        fine = spectral.illuminant("FL11", wavelengths=FINE)
        true = fine[515 - 360 + 1 : 575 - 360].sum().item() / 11
        assert np.abs(np.array(totals) / true - 1).max() < 0.12  # the window's edges count whole bands

    def test_own_light_is_only_scaled(self) -> None:
        power = torch.linspace(1, 3, 28)
        light = spectral.illuminant(power, wavelengths=DEFAULT)
        torch.testing.assert_close(light / light[0], power.double())
        assert (light @ spectral.xyz_weights(DEFAULT))[1].item() == pytest.approx(1, abs=1e-12)
        torch.testing.assert_close(spectral.illuminant(7 * light, wavelengths=DEFAULT), light)

    def test_order_does_not_matter(self) -> None:
        order = torch.randperm(28, generator=torch.Generator().manual_seed(0))
        for function in (
            lambda grid: spectral.illuminant("FL11", wavelengths=grid),
            lambda grid: spectral.xyz_weights(grid, "D65"),
            lambda grid: spectral.rgb_basis(grid).T,
            lambda grid: spectral.reflectances(grid).T,
            lambda grid: spectral.sensitivity("kodak", wavelengths=grid).T,
            spectral.observer,
            spectral.band_widths,
        ):
            torch.testing.assert_close(function(DEFAULT[order]), function(DEFAULT)[order], rtol=1e-10, atol=1e-12)

    def test_errors(self) -> None:
        with pytest.raises(ValueError, match=r"unknown illuminant 'D66'. There are: A, C, D50.*or give a tensor"):
            spectral.illuminant("D66", wavelengths=DEFAULT)
        with pytest.raises(TypeError, match=r"must be a name such as 'D65', a tensor \(L,\) or a table .*, got int"):
            spectral.illuminant(65, wavelengths=DEFAULT)
        with pytest.raises(ValueError, match=r"shape \(27,\), expected one value per band: \(28,\)"):
            spectral.illuminant(torch.ones(27), wavelengths=DEFAULT)
        for bad in (torch.zeros(28), -torch.ones(28), torch.full((28,), float("nan"))):
            with pytest.raises(ValueError, match="finite, >= 0 and not all zero, got"):
                spectral.illuminant(bad, wavelengths=DEFAULT)
        with pytest.raises(ValueError, match="wavelength 550 nm occurs more than once: expected distinct bands"):
            spectral.illuminant("D65", wavelengths=torch.tensor([550, 600, 550]).double() * nm)
        with pytest.raises(ValueError, match=r"did you mean 550 \* nm"):
            spectral.illuminant("D65", wavelengths=torch.tensor([550.0]))


class TestObserverAndBands:
    def test_observer_is_the_table(self, observer) -> None:
        curves = spectral.observer(FINE)
        np.testing.assert_allclose(curves.numpy(), observer.values, rtol=0, atol=2e-6)  # metres round by 1e-6 nm
        assert curves.sum(0).numpy() == pytest.approx([106.865, 106.857, 106.892], abs=1e-3)
        assert not spectral.observer(torch.tensor([300, 900]).double() * nm).any()

    def test_widths_add_up_to_the_range(self) -> None:
        torch.testing.assert_close(spectral.band_widths(TENS), torch.full((31,), 10 * nm).double())
        torch.testing.assert_close(
            spectral.band_widths(torch.tensor([600, 400, 500, 520]).double() * nm),
            torch.tensor([80, 100, 60, 50]).double() * nm,
        )

    def test_single_band_has_a_stated_width(self) -> None:
        assert spectral.band_widths(torch.tensor([550 * nm])).item() == spectral.SINGLE_BAND_WIDTH == 10 * nm

    def test_repeated_band(self) -> None:
        with pytest.raises(ValueError, match="550 nm occurs more than once"):
            spectral.band_widths(torch.tensor([550 * nm, 550 * nm]))


class TestColour:
    # Mean and largest delta-E2000 over the 24 patches, rounded up from what was measured.
    @pytest.mark.parametrize(
        ("grid", "lamp", "mean", "largest"),
        [
            ("default", "D65", 0.08, 0.46),
            ("default", "D50", 0.06, 0.33),
            ("default", "A", 0.05, 0.20),
            ("default", "E", 0.10, 0.60),
            ("default", "FL2", 0.08, 0.31),
            ("default", "FL11", 0.11, 0.21),
            ("default", "HP1", 0.18, 0.40),
            ("default", "LED-B3", 0.04, 0.15),
            ("tens", "D65", 0.01, 0.03),
            ("tens", "A", 0.02, 0.08),
            ("tens", "FL11", 0.09, 0.19),
            ("cassi", "D65", 0.68, 2.73),
            ("fourteen", "D65", 0.11, 0.39),
        ],
    )
    def test_patches_against_colour_science(self, colour, observer, grid, lamp, mean, largest) -> None:
        wavelengths = {"default": DEFAULT, "tens": TENS, "cassi": CASSI, "fourteen": wavelength_grid(count=14)}[grid]
        chart = colour.SDS_COLOURCHECKERS["BabelColor Average"]
        true = as_colour_sees(colour, observer, list(chart.values()), lamp)
        weights = spectral.xyz_weights(wavelengths, lamp)
        ours = (spectral.reflectances(wavelengths) @ weights).numpy()
        error = delta_e(colour, true, ours, weights.sum(0).numpy())
        assert error.mean() < mean
        assert error.max() < largest

    def test_radiance_needs_no_mention_of_the_light(self) -> None:
        light = spectral.illuminant("A", wavelengths=DEFAULT)
        patches = spectral.reflectances(DEFAULT)
        xyz = spectral.spectrum_to_xyz((patches * light).T[None, :, :, None], wavelengths=DEFAULT)
        assert xyz.shape == (1, 3, 24, 1)
        torch.testing.assert_close(xyz[0, :, :, 0].T, patches @ spectral.xyz_weights(DEFAULT, "A"))

    def test_srgb_matrix_has_exactly_our_white(self, colour) -> None:
        matrix = spectral.xyz_to_srgb_matrix()
        np.testing.assert_allclose(matrix, colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB, atol=4e-4)
        for grid in (DEFAULT, TENS, CASSI):
            white = spectral.xyz_weights(grid, "D65").sum(0)[:, None, None]
            torch.testing.assert_close(
                spectral.xyz_to_linear_srgb(white), torch.ones(3, 1, 1).double(), rtol=0, atol=1e-12
            )

    def test_follows_dtype_and_gradient(self, dtype: torch.dtype) -> None:
        bands = torch.rand(2, 28, 3, 4, dtype=dtype, requires_grad=True)
        rgb = spectral.xyz_to_linear_srgb(spectral.spectrum_to_xyz(bands, wavelengths=DEFAULT))
        assert rgb.dtype == dtype
        rgb.sum().backward()
        assert bands.grad.isfinite().all()

    def test_errors(self) -> None:
        for shape in ((1, 27, 4, 4), (28, 4)):
            with pytest.raises(ValueError, match=r"expected \(\.\.\., 28, H, W\): one plane per wavelength"):
                spectral.spectrum_to_xyz(torch.ones(shape), wavelengths=DEFAULT)


class TestRgbBasis:
    @pytest.mark.parametrize("grid", [DEFAULT, TENS, CASSI, wavelength_grid(count=24), FINE])
    def test_round_trip_is_exact(self, grid: Tensor) -> None:
        basis = spectral.rgb_basis(grid)
        back = basis @ spectral.xyz_weights(grid, "D65") @ spectral.xyz_to_srgb_matrix().T
        torch.testing.assert_close(back, torch.eye(3).double(), rtol=0, atol=1e-12)
        assert 0 <= basis.min() < basis.max() < 0.985
        torch.testing.assert_close(basis.sum(0), torch.ones(len(grid)).double(), rtol=0, atol=1e-12)

    @pytest.mark.parametrize(("count", "limit"), [(20, 0.003), (14, 0.02), (10, 0.051), (8, 0.08)])
    def test_few_bands_stay_physical(self, count: int, limit: float) -> None:
        grid = wavelength_grid(count=count)
        basis = spectral.rgb_basis(grid)
        back = basis @ spectral.xyz_weights(grid, "D65") @ spectral.xyz_to_srgb_matrix().T
        assert (back - torch.eye(3)).abs().max() < limit
        assert -1e-15 <= basis.min() < basis.max() <= 1
        torch.testing.assert_close(basis.sum(0), torch.ones(count).double(), rtol=0, atol=1e-12)

    def test_uneven_bands_of_the_issue_are_exact(self) -> None:
        grid = torch.cat([torch.linspace(420, 500, 20), torch.linspace(520, 720, 8)]).double() * nm
        assert spectral.rgb_error(grid) < 1e-12

    @pytest.mark.parametrize("seeds", [range(20), pytest.param(range(20, 400), marks=pytest.mark.slow)])
    def test_any_bands_are_exact_where_linear_programming_finds_a_way(self, seeds: range) -> None:
        """B >= 0, columns that add up to 1, B A = 1: whether there is such a B at all is known independently."""
        exact = 0
        for seed in seeds:
            generator = np.random.default_rng(seed)
            count = int(generator.integers(3, 40))
            grid = torch.tensor(np.sort(generator.uniform(400, 720, count))) * nm
            if seed % 3 == 0:  # even ones, moved a little
                grid = wavelength_grid(count=count) + torch.tensor(generator.normal(0, 2, count)) * nm
            basis = spectral.rgb_basis(grid)
            assert basis.min() >= 0
            torch.testing.assert_close(basis.sum(0), torch.ones(count).double(), rtol=0, atol=1e-9)
            to_rgb = (spectral.xyz_weights(grid, "D65") @ spectral.xyz_to_srgb_matrix().T).numpy()
            equations = np.concatenate([np.kron(np.eye(3), to_rgb.T), np.tile(np.eye(count), 3)])
            aims = np.concatenate([np.eye(3).ravel(), np.ones(count)])
            found = optimize.linprog(np.zeros(3 * count), A_eq=equations, b_eq=aims, bounds=(0, None))
            error = spectral.rgb_error(grid)
            assert (error < 1e-7) == (found.status == 0), f"{seed}: {error}, {found.message}"
            exact += error < 1e-12
            colours = generator.random((300, 3))
            linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
            back = (linear @ basis.numpy() @ to_rgb).clip(0, 1)
            back = np.where(back <= 0.0031308, 12.92 * back, 1.055 * back ** (1 / 2.4) - 0.055)
            assert np.abs(back - colours).max() <= 1.1 * error + 1e-12
        assert exact > 0.4 * len(seeds)

    def test_stays_close_to_mallett(self, colour) -> None:
        for rgb in np.random.default_rng(0).random((20, 3)):
            true = colour.recovery.RGB_to_sd_Mallett2019(rgb)
            true = np.interp(DEFAULT.numpy() / nm, true.wavelengths, true.values)
            error = rgb @ spectral.rgb_basis(DEFAULT).numpy() - true
            assert np.abs(error).max() < 0.08  # where an edge is steeper than a band is wide
            assert np.abs(error).mean() < 0.015

    def test_single_band_is_mallett_itself(self, colour) -> None:
        table = colour.recovery.MSDS_BASIS_FUNCTIONS_sRGB_MALLETT2019
        np.testing.assert_allclose(
            spectral.rgb_basis(torch.tensor([550 * nm]))[:, 0], table.values[table.wavelengths == 550][0], atol=1e-3
        )


class TestReflectancesAndSensitivities:
    def test_chart(self, colour) -> None:
        names, wavelengths, values = spectral.colour_chart()
        chart = colour.SDS_COLOURCHECKERS["BabelColor Average"]
        assert names == tuple(chart)
        assert wavelengths.shape == (36,)
        np.testing.assert_array_equal(values, np.stack([patch.values for patch in chart.values()]))
        torch.testing.assert_close(spectral.reflectances(wavelengths), values, rtol=0, atol=1e-7)

    def test_patches_between_measurements(self) -> None:
        # Leave every second measurement out: the cubic through the others, 20 nm apart, finds it.
        _, wavelengths, values = spectral.colour_chart()
        grid = wavelengths.numpy() / nm
        found = values.numpy()[:, ::2] @ cubic_weights(grid[::2], grid[1:-1:2])
        assert np.sqrt(np.mean((found - values.numpy()[:, 1:-1:2]) ** 2)) < 5e-3
        ends = spectral.reflectances(torch.tensor([370, 380, 730, 800]).double() * nm)
        torch.testing.assert_close(ends[:, ::3], ends[:, 1:3], rtol=0, atol=1e-7)

    @pytest.mark.parametrize(
        ("name", "key"), [("nikon_5100", "Nikon 5100 (NPL)"), ("sigma_sd_merrill", "Sigma SDMerill (NPL)")]
    )
    def test_measured_cameras(self, colour, name: str, key: str) -> None:
        measured = colour.characterisation.MSDS_CAMERA_SENSITIVITIES[key]
        curves = spectral.sensitivity(name, wavelengths=torch.tensor(measured.wavelengths) * nm)
        np.testing.assert_allclose(curves.T, measured.values, atol=1e-7)
        assert curves.max(1).values.tolist() == pytest.approx([1, 1, 1], abs=1e-6)
        assert not spectral.sensitivity(name, wavelengths=torch.tensor([300, 800]).double() * nm).any()

    def test_kodak_has_the_peaks_of_the_data_sheets(self) -> None:
        grid = torch.arange(380, 781, 5, dtype=torch.float64) * nm
        efficiency = spectral.sensitivity("kodak", wavelengths=grid) / grid
        peaks = efficiency.max(1)
        assert (grid[peaks.indices] / nm).tolist() == pytest.approx([620, 540, 470])
        assert (peaks.values / peaks.values[1]).tolist() == pytest.approx([38 / 42, 1, 43 / 42])
        curves = spectral.sensitivity("kodak", wavelengths=grid)
        assert curves[1].max().item() == pytest.approx(1)
        assert (curves >= 0).all()

    def test_unknown_camera(self) -> None:
        with pytest.raises(ValueError, match="unknown sensitivity 'canon'. There are: kodak, nikon_5100, sigma_sd_mer"):
            spectral.sensitivity("canon", wavelengths=DEFAULT)


class TestAnyGrid:
    @given(tenths=grids)
    @settings(max_examples=25, deadline=None)
    def test_everything_is_finite_and_physical(self, tenths: list[int]) -> None:
        grid = torch.tensor(tenths, dtype=torch.float64) * 0.1 * nm
        for lamp in ("D65", "HP1"):
            light = spectral.illuminant(lamp, wavelengths=grid)
            assert light.isfinite().all()
            assert (light >= 0).all()
            assert spectral.xyz_weights(grid, lamp).sum(0)[1].item() == pytest.approx(1, abs=1e-9)
        basis = spectral.rgb_basis(grid)
        assert basis.isfinite().all()
        assert (basis >= -1e-12).all()
        torch.testing.assert_close(basis.sum(0), torch.ones(len(grid)).double(), rtol=0, atol=1e-9)
        assert (spectral.band_widths(grid) > 0).all()
        assert spectral.reflectances(grid).isfinite().all()

    def test_uneven_bands_do_not_amplify(self) -> None:
        # A cubic through 500, 501 and 700 nm would weigh a band with -26; straight lines do not.
        weights = spectral.xyz_weights(torch.tensor([500, 501, 700, 710]).double() * nm)
        assert (weights >= 0).all()
