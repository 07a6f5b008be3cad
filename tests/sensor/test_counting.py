"""Photons counted in bulk against Poisson's law."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats

from kcam.sensor import counting, poisson


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


MEANS = [0.0, 0.02, 0.7, 3.0, 9.99, 10.0, 10.5, 17.3, 60.0, 400.25, 5000.7, 1e5, 4e6]


@pytest.mark.parametrize("mean", MEANS)
def test_the_law(mean: float) -> None:
    """Chi-square over all counts that are expected 25 times, and mean, variance and skewness: within 4.5 sigma."""
    size = 400_000
    found = counting.counts(torch.full((size,), mean), seeded(round(1000 * mean))).double().numpy()
    assert np.array_equal(found, np.floor(found))
    if mean == 0:
        assert not found.any()
        return
    law = stats.poisson(np.float32(mean))
    edges = np.unique(law.ppf(np.linspace(0, 1, 1000)[1:-1]))
    expected = size * np.diff(np.concatenate([[0.0], law.cdf(edges), [1.0]]))
    observed = np.bincount(np.searchsorted(edges, found), minlength=len(edges) + 1)
    kept = expected > 25
    freedom = max(kept.sum() - 1, 1)
    chi = ((observed - expected) ** 2 / np.where(kept, expected, 1))[kept].sum()
    assert stats.chi2(freedom).sf(chi) > 1e-5
    away = (found - mean) / math.sqrt(mean)
    assert abs(away.mean()) * math.sqrt(size) < 4.5
    assert abs(away.var() - 1) < 4.5 * math.sqrt((2 + 1 / mean) / size)
    if mean > 1:
        assert abs((away**3).mean() - 1 / math.sqrt(mean)) < 4.5 * math.sqrt((15 + 130 / mean) / size)


@pytest.mark.parametrize("mean", [10.0, 11.3, 25.0, 130.0, 900.0])
def test_what_the_rejection_rests_on(mean: float) -> None:
    """p / q >= 1 - (mu - k)^3 / (6 mu^2), and the hat lies above (p - q)+ wherever it is drawn from."""
    deviation = math.sqrt(mean)
    k = torch.arange(max(0.0, mean - 12 * deviation), mean + 14 * deviation).floor().double().unique()
    mu = torch.full_like(k, mean)
    p, q = counting._laws(mu, k)
    np.testing.assert_allclose(p, stats.poisson(mean).pmf(k), rtol=1e-9, atol=1e-300)
    exact = stats.norm.sf((k - mean) / deviation) - stats.norm.sf((k + 1 - mean) / deviation)
    np.testing.assert_allclose(q, exact, rtol=1e-7, atol=1e-15)
    likely = q > 1e-13
    assert (p[likely] >= q[likely] * (1 - (mu - k)[likely] ** 3 / (6 * mean**2)) * (1 - 1e-9)).all()
    ends = torch.stack([k - mean, k + 1 - mean]) / deviation
    drawn = ends[1] > counting._EDGE
    far = (ends.clamp(min=counting._EDGE) - counting._SHIFT).abs().amax(0)
    assert ((p - q) * far.exp() <= counting._HAT / mean)[drawn].all()
    assert (p <= q * (1 + 1e-12))[(ends[1] <= counting._EDGE) & likely].all()


def test_pixels_of_all_means_beside_each_other() -> None:
    """A picture from dark to bright, in pieces of its own: its sum over each band of means, within 4.5 sigma."""
    means = torch.logspace(-3, 6, 300_000)[torch.randperm(300_000, generator=seeded(1))].reshape(-1, 3)
    found = counting.counts(means, seeded(2))
    assert found.shape == means.shape
    for low in range(-3, 6):
        inside = (means >= 10.0**low) & (means < 10.0 ** (low + 1))
        total = float(means[inside].double().sum())
        assert abs(float(found[inside].double().sum()) - total) < 4.5 * math.sqrt(total)
        away = (found - means)[inside].double().square().sum() - total
        spread = math.sqrt(float((2 * means[inside].double().square() + means[inside].double()).sum()))
        assert abs(float(away)) < 4.5 * spread


def test_a_seed_gives_the_same_counts_whatever_the_threads() -> None:
    means = 300 * torch.rand(200_000, generator=seeded(0))
    threads = torch.get_num_threads()
    found = []
    for count in (1, 2):
        torch.set_num_threads(count)
        found.append(counting.counts(means, seeded(3)))
    torch.set_num_threads(threads)
    assert torch.equal(*found)
    assert not torch.equal(found[0], counting.counts(means, seeded(4)))
    torch.manual_seed(5)
    first = poisson(means)
    torch.manual_seed(5)
    assert torch.equal(first, poisson(means))


def test_neighbours_are_independent() -> None:
    """Of counts next to each other, and a piece apart: correlations within 4.5 sigma."""
    away = counting.counts(torch.full((400_000,), 40.0), seeded(9)).double() - 40
    for lag in (1, 2, 8, 2**16):
        product = (away[lag:] * away[:-lag]) / 40
        assert abs(float(product.mean())) * math.sqrt(len(product)) < 4.5


def test_what_cannot_be_counted_so() -> None:
    for means in (torch.tensor([1.0, math.nan]), torch.tensor([-1.0]), torch.tensor([3e7]), torch.tensor([]),
                  torch.tensor([4.0], dtype=torch.float64)):  # fmt: skip
        assert not counting.can_count(means)
    assert counting.can_count(torch.tensor([0.0, 8e6]))
    assert abs(float(poisson(torch.tensor([3e7]), generator=seeded(0))) - 3e7) < 5 * math.sqrt(3e7)


def test_torch_s_defaults_do_not_matter() -> None:
    means = 20 * torch.rand(1000, generator=seeded(0))
    expected = counting.counts(means, seeded(1))
    before = torch.get_default_dtype()
    try:
        torch.set_default_dtype(torch.float64)
        with torch.device("meta"):
            found = counting.counts(means, seeded(1))
    finally:
        torch.set_default_dtype(before)
    assert found.dtype == torch.float32
    assert torch.equal(found, expected)
