"""Real lenses beside Optiland: wavefronts, chief rays and what passes, as `tools/lens_goldens.py` recorded them."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from kcam.optics.compound.presets import PRESETS
from tools import lens_goldens as goldens

QUICK = {("double_gauss", 1), ("phone", 1)}
CASES = [
    pytest.param(name, line, marks=() if (name, line) in QUICK else pytest.mark.slow)
    for name in goldens.LENSES
    for line in range(len(goldens.WAVELENGTHS))
]


@cache
def recorded() -> dict[str, np.ndarray]:
    with np.load(goldens.GOLDENS) as file:
        return dict(file)


def field(name: str) -> Tensor:
    """Optiland's positive angles are of light that travels towards +y: of points at -y."""
    return torch.tensor([[0.0, -height * PRESETS[name].field] for height in goldens.FIELDS], dtype=torch.float64)


@pytest.mark.parametrize(("name", "line"), CASES)
def test_the_wavefront_is_that_of_optiland(name: str, line: int) -> None:
    """2e-10 waves for spheres; 3e-7 for the phones, whose aspheres Optiland meets to 1e-10 mm."""
    wavelength = goldens.WAVELENGTHS[line]
    lens = goldens.at_wavelength(name, wavelength)
    waves, passes = lens.opd([wavelength], distances=math.inf, field=field(name), samples=goldens.SAMPLES)
    expected = torch.from_numpy(recorded()[f"{name} waves"][line])[:, None, None]
    both = passes & expected.isfinite()
    assert float((waves - expected)[both].abs().max()) < (1e-6 if "phone" in name else 1e-9)
    assert int((passes ^ expected.isfinite()).sum()) <= 0.01 * passes.numel()  # rays on the rim itself


@pytest.mark.parametrize(("name", "line"), CASES)
def test_chief_rays_land_where_optiland_has_them(name: str, line: int) -> None:
    wavelength = goldens.WAVELENGTHS[line]
    lens = goldens.at_wavelength(name, wavelength)
    landed = lens.image_point([wavelength], distances=math.inf, field=field(name))[:, 0, 0, 1]
    assert np.abs(landed.numpy() - recorded()[f"{name} chief"][line]).max() < 1e-13  # m; 1e-10 mm


@pytest.mark.parametrize(
    ("name", "line"),
    [pytest.param(*case.values, marks=case.marks if "phone" in case.values else pytest.mark.slow) for case in CASES],
)
def test_the_same_share_of_the_stop_passes(name: str, line: int) -> None:
    wavelength = goldens.WAVELENGTHS[line]
    lens = goldens.at_wavelength(name, wavelength)
    _, passes = lens.opd([wavelength], distances=math.inf, field=field(name), samples=goldens.SHARES)
    expected = torch.from_numpy(recorded()[f"{name} open"][line])[:, None, None]
    aimed = expected >= 0
    counts = [float((part & aimed).sum()) for part in (passes, expected == 1)]
    assert counts[0] == pytest.approx(counts[1], rel=0.005)
    assert float(((passes ^ (expected == 1)) & aimed).sum()) < 0.005 * counts[1]
    assert float(aimed.sum()) > 0.85 * math.pi / 4 * aimed.numel()
