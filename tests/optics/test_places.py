"""Cubics between places at which PSFs are known, and openings of pupils between wavelengths."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from kcam import optics
from kcam.optics.pupil.rim import Openings, edge_distance, opening
from kcam.optics.rendering.places import Between, cubic_weights, grid
from kcam.units import nm, um

GENERATOR = torch.Generator().manual_seed(7)


def smooth(places: Tensor) -> Tensor:
    """(N, 1, 1, 1, 2) of places (N, 2), a cubic of each coordinate."""
    x, y = (places / 50).unbind(1)
    return torch.stack([x**3 - y**3 + x * y, 1 + x**2 * y - y**2], dim=-1)[:, None, None, None]


@pytest.mark.parametrize("picture", [(1, 1), (1, 200), (37, 120), (300, 64)])
@pytest.mark.parametrize("apart", [3.0, 31.0, 1000.0])
def test_cubics_are_exact_between_places(picture: tuple[int, int], apart: float) -> None:
    known = Between.known(smooth, picture, apart=apart)
    half = torch.tensor([(n - 1) / 2 for n in picture[::-1]], dtype=torch.float64)
    places = (2 * torch.rand(20, 2, generator=GENERATOR, dtype=torch.float64) - 1) * half
    torch.testing.assert_close(known(places), smooth(places), rtol=0, atol=1e-10)
    middle = known.middle(places[:1])
    assert bool((middle.abs() <= half).all())


def test_places_are_no_farther_apart_than_asked() -> None:
    for n, apart in ((2, 1.0), (100, 7.0), (5, 100.0)):
        nodes = grid(n, apart=apart)
        assert float(nodes.diff().max()) <= apart
        assert float(nodes[-1]) == -float(nodes[0]) == (n - 1) / 2
    assert grid(1, apart=3.0).tolist() == [0]


def test_weights_of_cubics_are_one_together_and_reach_four_places() -> None:
    nodes = grid(90, apart=9.0)
    weights = cubic_weights(nodes, torch.linspace(-44.5, 44.5, 33, dtype=torch.float64))
    torch.testing.assert_close(weights.sum(1), torch.ones(33, dtype=torch.float64))
    assert int((weights != 0).sum(1).max()) <= 4


def test_known_places_have_gradients() -> None:
    scale = torch.tensor(1.3, dtype=torch.float64, requires_grad=True)

    def found(scale: Tensor) -> Tensor:
        return Between.known(lambda at: scale.sin() * smooth(at), (40, 60), apart=15.0)(
            torch.tensor([[3.2, -7.7]]).double()
        )

    assert torch.autograd.gradcheck(found, (scale,))


def test_openings_between_wavelengths_are_those_of_their_own_edges() -> None:
    """Two edges that move by more than a sample over the spectrum; the weights of 1 / 3 lie between the three."""
    side = torch.linspace(-1.2, 1.2, 160, dtype=torch.float64)
    x, y = side[None, :], side[:, None]

    def clearances(t: float) -> Tensor:
        disc = 1 - (x**2 + y**2) / (1 + 0.02 * t + 0.004 * t**2) ** 2
        other = 1 - (x**2 + (y - 0.5 - 0.03 * t) ** 2) / 1.3**2
        return torch.stack([disc, other])

    known = edge_distance(torch.stack([clearances(t) for t in (0.0, 0.5, 1.0)])[None])
    t = 1 / 3
    weights = torch.tensor([(t - 0.5) * (t - 1) / 0.5, t * (t - 1) / -0.25, t * (t - 0.5) / 0.5], dtype=torch.float64)
    truth = opening(clearances(t)[None])
    assert float((Openings(known).at(weights) - truth).abs().max()) < 2e-3
    nearest = opening(clearances(0.5)[None])
    assert float((nearest - truth).abs().max()) > 0.1  # that of another wavelength is not good enough


def test_psfs_of_many_wavelengths_are_those_of_each() -> None:
    lens = optics.CompoundLens.preset("cooke_triplet", focus_distance=5.0)
    wavelengths = [(430 + 20 * k) * nm for k in range(14)]
    how = {"distances": 5.0, "pixel_pitch": 8 * um, "shape": (33, 33), "field": torch.tensor([[0.05, 0.2]])}
    together = lens.psf(wavelengths, **how)
    for index in (0, 9):
        alone = lens.psf(wavelengths[index : index + 1], **how)
        assert float((together[:, :, index] - alone[:, :, 0]).abs().sum()) < 1e-3 * float(alone.sum())
