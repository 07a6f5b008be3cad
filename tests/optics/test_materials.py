"""Refractive indices against what the makers and the papers published, not against the formulas they were fitted by."""

from __future__ import annotations

import re

import oracles
import pytest
import torch

from kcam.optics import GLASSES, Glass, refractive_index
from kcam.units import nm, wavelength_grid

PUBLISHED = oracles.sellmeier_published()


def index(glass: str | float, *wavelengths: float) -> list[float]:
    return refractive_index(glass, wavelengths=torch.tensor(wavelengths, dtype=torch.float64)).tolist()


@pytest.mark.parametrize("glass", sorted(PUBLISHED))
def test_dispersion_as_published(glass: str) -> None:
    lines, precision = PUBLISHED[glass]
    got = index(glass, *lines)
    # one unit of the table's last digit: half for its rounding, half for the scatter of the fit about the measurement
    for wavelength, n, expected in zip(lines, got, lines.values(), strict=True):
        assert abs(n - expected) <= 1.01 * precision, f"{glass} at {wavelength / nm:.1f} nm: {n:.6f}, not {expected}"


@pytest.mark.parametrize("glass", sorted(oracles.ABBE_NUMBERS))
def test_abbe_number_as_published(glass: str) -> None:
    n_d, n_f, n_c = index(glass, *(oracles.LINES[line] for line in "dFC"))
    assert (n_d - 1) / (n_f - n_c) == pytest.approx(oracles.ABBE_NUMBERS[glass], abs=0.005)  # V_d has two decimals


def test_every_glass_is_cited_and_has_an_independent_table() -> None:
    assert len(GLASSES) >= 10
    assert all(glass.source for glass in GLASSES.values())
    assert set(GLASSES) == set(PUBLISHED)


@pytest.mark.parametrize("glass", sorted(GLASSES))
def test_normal_dispersion_over_the_visible(glass: str) -> None:
    low = max(400.0, GLASSES[glass].valid[0] * 1e3)
    n = refractive_index(glass, wavelengths=torch.linspace(low, 750, 50, dtype=torch.float64) * nm)
    assert (n.diff() < 0).all(), "every one of these materials bends blue more than red"
    assert n.dtype == torch.float64


def test_a_number_is_an_index_without_dispersion() -> None:
    assert index(1.5, 400 * nm, 700 * nm) == [1.5, 1.5]


@pytest.mark.parametrize("glass", [1.0, 0.9, 1, float("nan")])
def test_an_index_that_does_not_refract_is_an_error(glass: float) -> None:
    with pytest.raises(ValueError, match="refractive index .* must be > 1, or the name of a glass"):
        index(glass, 550 * nm)


def test_unknown_glass_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"unknown glass 'BK7'; known: .*N-BK7.*; or give a refractive index"):
        index("BK7", 550 * nm)


def test_the_default_bands_are_within_all_glasses_but_these() -> None:
    bands, refused = wavelength_grid(), set()
    for glass in GLASSES:
        try:
            refractive_index(glass, wavelengths=bands)
        except ValueError as error:
            refused.add(glass)
            (first,) = re.findall(r"wavelengths within it, such as torch.linspace\((\d+), 720, 28\) \* nm", str(error))
            refractive_index(glass, wavelengths=torch.linspace(int(first), 720, 28) * nm)
    assert refused == {"PMMA", "polycarbonate", "ZnSe"}
    with pytest.raises(ValueError, match=r"wavelength 420 nm is outside .* PMMA, 436\.8\.\.1052 nm .*linspace\(440,"):
        refractive_index("PMMA", wavelengths=bands)


def test_wavelength_beyond_the_fit_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"wavelength 2600 nm is outside the Sellmeier range of N-BK7, 300\.\.2500 nm"):
        index("N-BK7", 550 * nm, 2600 * nm)


def test_wavelengths_may_be_a_list() -> None:
    for glass in ("N-BK7", Glass(1.5168, 64.2), 1.5):
        listed = refractive_index(glass, wavelengths=[450e-9, 550e-9])
        assert torch.equal(listed, refractive_index(glass, wavelengths=torch.tensor([450e-9, 550e-9]).double()))


def test_an_index_that_is_kept_is_nobodys() -> None:
    """Who changes it in place changes no other's, and a derivative by the wavelength passes."""
    wavelengths = wavelength_grid()
    first = refractive_index("N-BK7", wavelengths=wavelengths)
    expected = first.clone()
    first.mul_(0)
    assert torch.equal(refractive_index("N-BK7", wavelengths=wavelengths), expected)
    assert torch.equal(refractive_index("N-BK7", wavelengths=wavelengths[3]), expected[3])
    trained = wavelengths.clone().requires_grad_()
    (slope,) = torch.autograd.grad(refractive_index("N-BK7", wavelengths=trained).sum(), trained)
    ahead = refractive_index("N-BK7", wavelengths=wavelengths + 0.01 * nm)
    torch.testing.assert_close(slope, (ahead - expected) / (0.01 * nm), rtol=1e-3, atol=0)
