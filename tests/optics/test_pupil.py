"""Edge weights of a disc, and the way to the image-side plane."""

from __future__ import annotations

import math
import random

import pytest
import torch

from kcam import measure
from kcam.optics.pupil import rim
from kcam.optics.pupil.coordinates import grid_nodes, grid_spacing
from kcam.optics.pupil.rim import disc_weights
from kcam.optics.pupil.warp import Warp


@pytest.mark.parametrize(("count", "radius"), [(64, 1.0), (66, 0.37), (200, 0.9), (3000, 1.0)])
def test_edge_weights_sum_to_the_area_of_the_disc(count: int, radius: float) -> None:
    spacing = grid_spacing(count)
    weights = disc_weights(count, spacing=spacing, radius=radius)
    # 2e-7 measured at 24 samples across the smallest disc: what the low-pass of 6 samples leaves of a rim that it sees
    assert float(weights.sum()) * 4 * spacing**2 == pytest.approx(math.pi * radius**2, rel=1e-6)


@pytest.mark.parametrize("at_once", [1, 7, 10**6])
def test_edge_weights_do_not_depend_on_their_blocks(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = disc_weights(130, spacing=grid_spacing(130))
    monkeypatch.setattr(rim, "_NODES_AT_ONCE", at_once)
    blocks = disc_weights.__wrapped__(130, spacing=grid_spacing(130))
    # what is not near the rim is 1, or the second difference of areas of some 1e3 cells, as their digits leave it
    torch.testing.assert_close(blocks, expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("seed", range(12))
def test_edge_weights_are_1_inside_and_0_outside(seed: int) -> None:
    """Of random discs, small and large, on random grids, wherever the rim crosses their blocks."""
    rng = random.Random(seed)
    count, radius = 2 * rng.randint(1, 300), rng.choice([1.0, rng.uniform(1e-3, 1.3)])
    spacing = rng.choice([grid_spacing(max(count, 40)), rng.uniform(1e-3, 0.2)])
    weights = disc_weights(count, spacing=spacing, radius=radius)
    nodes = (torch.arange(count // 2, dtype=torch.float64) + 0.5) * spacing
    inside = (radius - torch.hypot(nodes[:, None], nodes)) / spacing
    away = inside.abs() > 8.5  # samples: the low-pass reaches six along each axis
    assert float((weights - (inside > 0).double())[away].abs().sum()) < 1e-8
    assert float(weights.abs().max()) < 1.5


def test_edge_weights_take_little_memory() -> None:
    count = 1200
    disc_weights(64, spacing=grid_spacing(64))  # taps and libraries are not what is measured
    _, _, peak = measure.watched(lambda: disc_weights.__wrapped__(count, spacing=grid_spacing(count)))
    if peak is None:
        pytest.skip("the system does not say how much memory a process takes")
    # 2 N^2 bytes of weights and a block of 0.1 N MB: 9 x 8 N^2 bytes here; all cells at once took 107 of them
    assert peak < 25 * 8 * count**2


# ---- the way to the image-side plane -----------------------------------------------------------------------------


@pytest.mark.parametrize(("frequency", "bound"), [((0.0, 0.0), 5e-6), ((0.2, 0.1), 2e-5), ((0.38, 0.0), 1e-4)])
@pytest.mark.parametrize(
    ("tau", "count", "round"),
    [
        (0.002, 256, True),
        (0.05, 256, True),
        (0.08, 600, True),
        (0.2, 300, True),
        (0.01, 64, False),
        (0.13, 400, False),
    ],
)
def test_a_wave_is_carried_to_the_image_side(
    tau: float, count: int, round: bool, frequency: tuple[float, float], bound: float
) -> None:
    """rho^2 = rho'^2 / (1 + tau - tau rho'^2): a plane wave of the true plane, evaluated there. Cycles per sample."""
    spacing = grid_spacing(count)
    warp = Warp.build(count, spacing=spacing, tau=tau, round=round, dtype=torch.float64, device=torch.device("cpu"))
    assert warp is not None
    nodes = grid_nodes(count, spacing=spacing)
    x, y = nodes[None, :], nodes[:, None]

    def wave(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return torch.cos(2 * math.pi * (frequency[0] * x + frequency[1] * y) / spacing + 0.4)

    scale = torch.rsqrt(1 + tau * (1 - x**2 - y**2))
    inside = (x**2 + y**2 < 0.9) if round else (torch.maximum(x.abs(), y.abs()) < 0.85)  # no tap is beyond the grid
    error = float(((warp.forward(wave(x + 0 * y, y + 0 * x)) - wave(x * scale, y * scale)) * inside).abs().max())
    print(f"tau {tau}, {frequency}: {error:.1e}")
    assert error <= bound


@pytest.mark.parametrize("seed", range(4))
def test_the_way_back_is_the_transpose(seed: int) -> None:
    """Of any wide aperture, round or square, in as many tiles as it takes: <W a, b> = <a, W^T b>."""
    draw = torch.Generator().manual_seed(seed)
    tau = 10 ** float(torch.rand((), generator=draw) * 2 - 3)
    count = 2 * int(torch.randint(40, 200, (), generator=draw))
    like = {"dtype": torch.float64, "device": torch.device("cpu")}
    warp = Warp.build(count, spacing=grid_spacing(count), tau=tau, round=seed % 2 == 0, **like)
    assert warp is not None
    a, b = torch.randn(2, count, count, generator=draw, dtype=torch.float64)
    assert float((warp.forward(a) * b).sum()) == pytest.approx(float((a * warp.adjoint(b)).sum()), rel=1e-10)


def test_an_aperture_that_is_too_wide_says_so() -> None:
    like = {"dtype": torch.float64, "device": torch.device("cpu")}
    with pytest.raises(ValueError, match=r"aperture of f/0\.71\. Use a smaller aperture"):
        Warp.build(600, spacing=grid_spacing(600), tau=0.5, round=False, **like)
