import pytest
import torch

from kcam.ste import clip_ste, round_ste


def test_rounding_is_exact_and_passes_every_gradient():
    x = torch.tensor([-1.5, -0.2, 0.5, 1.5, 2.49, 1e7 + 1], dtype=torch.float64, requires_grad=True)
    y = round_ste(x)
    assert torch.equal(y, torch.round(x.detach()))
    weights = torch.arange(1.0, 7.0, dtype=torch.float64)
    (y * weights).sum().backward()
    assert torch.equal(x.grad, weights)


@pytest.mark.parametrize(
    ("value", "slope", "expected"),
    [
        (1.5, -1.0, 0.0),  # too high, and descending would raise it
        (1.5, 1.0, 1.0),  # too high, and descending brings it back
        (-0.5, 1.0, 0.0),
        (-0.5, -1.0, -1.0),
        (0.5, 3.0, 3.0),
        (0.5, -3.0, -3.0),
        (0.0, 2.0, 2.0),  # the bounds themselves are inside
        (1.0, -2.0, -2.0),
    ],
)
def test_clip_gradient_follows_its_formula(value, slope, expected):
    x = torch.tensor([value], requires_grad=True)
    y = clip_ste(x, 0.0, 1.0)
    assert y.item() == min(max(value, 0.0), 1.0)
    (y * slope).sum().backward()
    assert x.grad.item() == expected


def test_descending_brings_a_saturated_value_back():
    x = torch.tensor([5.0], requires_grad=True)
    optimiser = torch.optim.SGD([x], lr=0.5)
    for _ in range(40):
        optimiser.zero_grad()
        (clip_ste(x, 0.0, 1.0) - 0.25).square().sum().backward()
        optimiser.step()
    assert x.item() == pytest.approx(0.25, abs=1e-3)


def test_one_bound_and_infinite_values():
    x = torch.tensor([-torch.inf, 0.5, torch.inf], requires_grad=True)
    y = clip_ste(x, None, 1.0)
    assert y.tolist() == [-torch.inf, 0.5, 1.0]
    (g,) = torch.autograd.grad(clip_ste(x, 0.0, None).clamp(max=3).sum(), x)
    assert g.isfinite().all()


def test_clip_works_under_vmap():
    x = torch.linspace(-1, 2, 12).reshape(3, 4)
    assert torch.equal(torch.vmap(lambda row: round_ste(clip_ste(row, 0.0, 1.0)))(x), x.clamp(0, 1).round())


def test_bounds_are_checked():
    with pytest.raises(ValueError, match="needs a bound"):
        clip_ste(torch.zeros(1))
    with pytest.raises(ValueError, match=r"low <= high, got low=1 and high=0; swap"):
        clip_ste(torch.zeros(1), 1.0, 0.0)
