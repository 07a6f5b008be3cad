"""The recipes of CONTRIBUTING.md, each carried out once from outside of the package."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

from kcam import Camera, isp, optics, sensor
from kcam.planner import costs

TEXT = (Path(__file__).parents[1] / "CONTRIBUTING.md").read_text()


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the recipes define, after they ran in order."""
    names: dict[str, Any] = {}
    known = dict(isp.DEMOSAICS)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("recipes"))
        for code in re.findall(r"^```python\n(.*?)^```", TEXT, flags=re.M | re.S):
            exec(code, names)
        yield names
    isp.DEMOSAICS.clear()
    isp.DEMOSAICS.update(known)


def test_a_propagator(done: dict[str, Any]) -> None:
    row, scene, camera = done["gaussian"], done["scene"], done["camera"]
    assert optics.PROPAGATORS.keys().isdisjoint({("gaussian", "closed_form")})
    psf = camera[0].psf_bank(scene.wavelengths, vergences=torch.tensor([0.5]), shape=(9, 9), like=scene.coefficients)
    assert torch.allclose(psf.sum((-2, -1)), torch.ones(1, len(scene.wavelengths)))
    assert costs.seconds(camera[0].work(scene, channels=3), costs.current_rates(row)) > 0
    square = optics.Lens(optics.SquareAperture(0.003), optics.ThinLens(0.05), focus_distance=2.0)
    with pytest.raises(ValueError, match="gaussian/closed_form needs a round aperture"):
        optics.Imaging(square, propagator=row)(scene)


def test_an_element(done: dict[str, Any]) -> None:
    ring = done["ring"].detach()[0].sum(0)
    assert float(ring[11:22, 11:22].sum() / ring.sum()) < 0.3  # a cone sends its light onto a ring around the axis
    slope, cone = done["slope"], done["cone"]

    def centre(value: float) -> float:
        with torch.no_grad():
            slope.fill_(value)
            psf = cone.psf(done["wavelengths"], distances=2.0, pixel_pitch=4e-6, shape=(33, 33), dtype=torch.float64)
        return float(psf[0, :, 16, 16].sum())

    step = 1e-8
    expected = (centre(8e-4 + step) - centre(8e-4 - step)) / (2 * step)
    assert float(slope.grad) == pytest.approx(expected, rel=1e-5)


def test_a_demosaic(done: dict[str, Any]) -> None:
    assert done["picture"].shape == (1, 3, 32, 32)
    even = torch.tensor([0.2, 0.4, 0.6])[:, None, None].expand(1, 3, 8, 8)
    for pattern in ("RGGB", "GBRG"):
        found = Camera(sensor.Mosaic(pattern), isp.Demosaic("nearest"))(even.contiguous())
        assert torch.allclose(found, even, atol=1e-6)


def test_a_stage(done: dict[str, Any]) -> None:
    scene, dark, again = done["scene"], done["darker"], done["again"]
    assert torch.equal(again(scene), dark(scene))
    assert again[2].width == dark[2].width
    stage = dark[2]
    assert float(stage(torch.ones(1, 1, 5, 5))[..., 2, 2]) == 1
    assert float(stage(torch.ones(1, 1, 5, 5))[..., 0, 0]) == pytest.approx((1 + 0.35**2) ** -2)


def test_a_source_of_psfs(done: dict[str, Any]) -> None:
    scene = done["scene"]
    source = done["Pillbox"](0.003, 0.0513, 2.0)
    assert optics.source.is_source(source)
    camera = Camera(
        optics.Imaging(source), sensor.ColourFilter.kodak(), sensor.Mosaic("RGGB"), sensor.Exposure(time=0.01)
    )
    depth = torch.linspace(1.5, 4, 32 * 32).view(32, 32)
    assert torch.isfinite(camera(scene.with_depth(depth))).all()
    sharp = optics.Imaging(source)(scene.with_depth(2.0))
    assert torch.allclose(sharp, scene.bands(), atol=1e-5)
    assert float((done["discs"] - scene.bands()).abs().max()) > 0.05
    plan = camera.plan(scene.with_depth(3.0), tolerance=0.01)
    assert plan.apply(camera)(scene.with_depth(3.0)).isfinite().all()
