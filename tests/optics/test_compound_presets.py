"""Lenses from patents: what their sources state of them, and images as sharp as a right prescription gives."""

from __future__ import annotations

import math

import pytest
import torch

from kcam import optics
from kcam.optics.compound import aiming
from kcam.optics.compound.presets import PRESETS
from kcam.optics.compound.tracing import trace
from kcam.units import mm, nm, um

DOUBLE = torch.float64
D_LINE = 587.5618 * nm

# name: focal length [mm], back focus [mm] or None, f-number; as their sources state them, at the d line
STATED = {
    "cooke_triplet": (50.0, 42.44, None),
    "double_gauss": (50.0, 50 * 0.71436, 2.0),
    "ef50": (51.5, None, 1.8),
    "phone": (None, 0.12, 2.8),
    "phone_odd": (5.555, 0.5678, 3.5),
    "telephoto": (100.0, 18.96, 5.6),
    "tessar": (100.0, 79.831, 2.8),
    "wide_angle": (28.0, 0.28 * 137.35, 3.5),
}
# name: rms radius of a spot on the axis and at 0.7 of the field, at the d line and the paraxial focus [um]
SPOTS = {
    "cooke_triplet": (20, 25),
    "double_gauss": (13, 37),
    "ef50": (12, 32),
    "phone": (1, 3),
    "phone_odd": (5, 31),
    "telephoto": (2, 3),
    "tessar": (35, 85),
    "wide_angle": (15, 22),
}


def at_d(name: str) -> optics.CompoundLens:
    return optics.CompoundLens.preset(name, focus_wavelength=D_LINE)


def test_every_preset_is_tested() -> None:
    assert STATED.keys() == SPOTS.keys() == PRESETS.keys()


@pytest.mark.parametrize("name", PRESETS)
def test_first_order_is_what_the_source_states(name: str) -> None:
    lens, (focal, back, f_number) = at_d(name), STATED[name]
    first = lens.first_order()
    if focal is not None:
        assert float(first.focal_length) == pytest.approx(focal * mm, rel=3e-3)
    if back is not None:
        assert float(first.back_focus) == pytest.approx(back * mm, rel=5e-3, abs=0.01 * mm)
    if f_number is not None:
        assert lens.f_number == pytest.approx(f_number, rel=0.03)


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("place", [0, 1])
def test_spots_are_as_small_as_those_of_a_right_prescription(name: str, place: int) -> None:
    """A wrong digit shows at once: rms radii over what all surfaces let pass."""
    lens, height = at_d(name), (0.0, 0.7)[place] * PRESETS[name].field
    line, far, up = (torch.tensor([value], dtype=DOUBLE) for value in (D_LINE, 0.0, height))
    nodes = aiming.nodes(lens._prescription, line, far, up)
    semi = float(lens.surfaces[lens.stop].semi_diameter)
    side = torch.linspace(-semi, semi, 41, dtype=DOUBLE)
    x, y = (part.flatten() for part in torch.meshgrid(side, side, indexing="xy"))
    rays = nodes.beam.at_sensor(x / nodes.across, nodes.aim + y / nodes.along)
    passed = (rays.alive & (torch.stack(rays.clearance) >= 0).all(0))[0, 0, 0]
    spot = torch.stack([rays.x, rays.y])[:, 0, 0, 0, passed]
    assert passed.sum() > 300
    assert float((spot - spot.mean(1, keepdim=True)).square().sum(0).mean().sqrt()) < SPOTS[name][place] * um


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "phone" else pytest.mark.slow) for name in PRESETS]
)
def test_the_field_is_what_the_lens_images(name: str) -> None:
    lens, field = at_d(name), PRESETS[name].field
    corner = torch.tensor([[0.0, field]], dtype=DOUBLE)
    assert 0.15 < float(lens.relative_illumination(corner)) < 0.85
    assert abs(float(lens.distortion(corner))) < 0.05


def test_rays_of_the_phone_with_odd_aspheres_are_those_that_ray_optics_lists() -> None:
    """The ray of the axis 1 mm high in d light: heights and directions behind some surfaces, to their five digits."""
    lens = at_d("phone_odd")
    zero, one = torch.zeros(1, dtype=DOUBLE), torch.ones(1, dtype=DOUBLE)
    indices = lens.indices(torch.tensor([D_LINE], dtype=DOUBLE))
    started = lens.launch(zero, zero, zero, one * mm)
    for until, height in ((2, 0.84711), (3, 0.61108), (4, 0.59188), (6, 0.45281), (8, 0.27126), (10, 0.09476)):
        met = trace(lens.surfaces, started, indices, until=until)
        assert float(met.y) == pytest.approx(height * mm, abs=5.1e-6 * mm)
    behind = trace(lens.surfaces, started, indices)
    assert float(behind.dy) == pytest.approx(-0.185004, abs=5.1e-7)
    assert float(behind.y + 0.64 * mm * behind.dy / behind.dz) == pytest.approx(-0.02573 * mm, abs=1e-5 * mm)


def test_every_source_is_a_patent_or_says_what_else() -> None:
    for name, lens in PRESETS.items():
        assert "US " in lens.source or "Japanese patent" in lens.source or "Zemax" in lens.source, name
        assert 0 < lens.field < 1.2
        assert math.isfinite(sum(row.thickness for row in lens.rows))
