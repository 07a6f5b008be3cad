"""Plans of optics that vary over the picture: what of that a scene calls for, and what leaving it out costs."""

from __future__ import annotations

import functools

import pytest
import torch
from draws import Draw
from torch import Tensor

from kcam import Camera, Scene, optics
from kcam.planner import Plan, Planner, costs, noiseless_raw
from kcam.units import mm, nm, um, wavelength_grid

LINES = wavelength_grid([480 * nm, 550 * nm, 640 * nm])
ROWS = ("field variation", "distortion", "lateral colour", "relative illumination")


@functools.cache
def camera(name: str = "cooke_triplet", pitch: float = 8 * um, **arguments) -> Camera:
    """Behind a preset at a tenth of its size: much of its field on few pixels."""
    surfaces = [
        optics.Surface(
            radius=float(surface.radius) / 10,
            thickness=float(surface.thickness) / 10,
            glass=surface.glass,
            semi_diameter=float(surface.semi_diameter) / 10,
            stop=surface.stop,
        )
        for surface in optics.CompoundLens.preset(name).surfaces
    ]
    lens = optics.CompoundLens(*surfaces, focus_distance=1.0)
    return Camera(optics.Imaging(lens, pixel_pitch=pitch, **{"border": "zero"} | arguments))


def symmetric() -> Camera:
    """Two equal lenses about a stop, object and image equally far: nothing is distorted."""
    front = optics.Surface(radius=60 * mm, thickness=4 * mm, glass="N-BK7", semi_diameter=9 * mm)
    back = optics.Surface(radius=-60 * mm, thickness=5 * mm, semi_diameter=9 * mm)
    stop = optics.Surface(radius=torch.inf, thickness=5 * mm, semi_diameter=0.7 * mm, stop=True)
    last = optics.Surface(radius=-60 * mm, thickness=0.0, semi_diameter=9 * mm)
    lens = optics.CompoundLens(front, back, stop, front, last, focus_distance=0.0554)
    return Camera(optics.Imaging(lens, pixel_pitch=120 * um, border="zero"))


def stars(height: int = 48, width: int = 72, *, within: float = 1.0, seed: int = 0, depth: float = 1.0) -> Scene:
    """Points of light in the middle of a black picture, or all over it."""
    draw, light = Draw(seed), torch.zeros(1, 3, height, width)
    for _ in range(30):
        y, x = (int((0.5 + within * (draw.number(0, 1) - 0.5)) * n) for n in (height, width))
        light[0, :, y, x] += 1 + torch.tensor([draw.number(0, 1) for _ in range(3)])
    return Scene.from_bands(light, wavelengths=LINES, depth=depth)


def rows(plan: Plan) -> dict[str, str]:
    return {row.effect: row.chosen for row in plan.decisions}


def plan_of(shot: Camera, light: Scene, tolerance: float) -> Plan:
    """Whose true error is inside its tolerance, against the camera that finds the places by itself."""
    with torch.no_grad():
        plan = shot.plan(light, tolerance=tolerance)
        assert plan.measure(shot, light) <= tolerance
    assert plan.bound <= tolerance
    return plan


@pytest.mark.slow
def test_a_centred_subject_needs_one_psf_and_a_star_field_many() -> None:
    shot = camera()
    assert rows(plan_of(shot, stars(within=0.1), 0.003))["field variation"] == "1 PSF"
    plan = plan_of(shot, stars(), 0.003)
    assert "places" in rows(plan)["field variation"]
    assert all(effect in rows(plan) for effect in ROWS)
    assert all(word in str(plan) for word in ("field", "variation", "distortion", "lateral", "illumination"))
    assert plan.apply(shot)[0].relative_illumination is plan.changes.get("relative_illumination", True)


@pytest.mark.parametrize(
    ("name", "pitch", "seed"),
    [pytest.param("wide_angle", 10 * um, 1, marks=pytest.mark.slow), ("cooke_triplet", 8 * um, 2)],
)
def test_plans_over_the_field_are_inside_their_tolerance(name: str, pitch: float, seed: int) -> None:
    shot, light = camera(name, pitch), stars(seed=seed)
    with torch.no_grad():
        planner, truth = Planner(shot, light), noiseless_raw(shot)(light)
        for tolerance in (0.1, 0.02, 0.004):
            plan = planner.plan(tolerance)
            assert plan.measure(shot, light, truth=truth) <= tolerance
            assert plan.bound <= tolerance


def test_a_lens_that_is_symmetric_about_its_stop_has_no_distortion() -> None:
    plan = plan_of(symmetric(), stars(depth=0.0554), 0.01)
    assert rows(plan)["distortion"] == "none"


def test_cameras_with_one_psf_have_no_such_rows() -> None:
    shot = camera(field=False)
    found = rows(plan_of(shot, stars(), 0.01))
    assert not set(ROWS) & set(found)


SWITCHES = ("distortion", "field_variation", "lateral_colour", "relative_illumination", "blur", "occlusion")
SETTINGS = {"spacing": 20, "bands": 2, "interpolate_bands": True, "psf_shape": (9, 9), "layers": 2, "kappa": None}


@pytest.mark.parametrize("seed", [0, 1, 2, *(pytest.param(n, marks=pytest.mark.slow) for n in range(3, 8))])
def test_plans_for_cameras_with_shortcuts_of_their_own(seed: int) -> None:
    """Whatever a camera leaves out by itself, a plan is made beside it, and holds."""
    draw = Draw(seed)
    own: dict = {name: False for name in SWITCHES if draw.number(0, 1) < 0.4}
    own |= {name: value for name, value in SETTINGS.items() if draw.number(0, 1) < 0.3}
    shot, light = camera(**own), stars(seed=seed)
    plan = plan_of(shot, light, 0.02)
    assert plan.measure(shot, light) <= 0.02, own


def test_shortcuts_and_plans_are_saved(tmp_path) -> None:
    shot = camera(distortion=False, field_variation=False)
    shot.save(tmp_path / "camera.safetensors")
    again = Camera.load(tmp_path / "camera.safetensors")[0]
    assert (again.distortion, again.field_variation, again.lateral_colour) == (False, False, True)
    plan = plan_of(camera(), stars(within=0.1), 0.01)
    plan.save(tmp_path / "plan.json")
    assert Plan.load(tmp_path / "plan.json").changes == plan.changes
    assert plan.changes["field_variation"] is False


@pytest.mark.slow
def test_light_elsewhere_is_out_of_range() -> None:
    """A plan for what stands in the middle says so where a scene has its light in the corners."""
    shot = camera(pitch=2 * um)
    light = torch.zeros(1, 3, 192, 192)
    light[..., 70:120, 70:120] = torch.rand(50, 50, generator=torch.Generator().manual_seed(0))
    moved = light.roll((80, 80), (-2, -1))
    centred, corner = (Scene.from_bands(one, wavelengths=LINES, depth=1.0) for one in (light, moved))
    plan = plan_of(shot, centred, 0.05)
    assert plan.changes["field_variation"] is False
    assert plan.outside(shot, centred) is None
    assert "far from the middle" in str(plan.outside(shot, corner))


def test_crops_of_a_large_picture_know_their_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """A part of the picture is what the whole shows there."""
    imaging, light = camera()[0], stars(seed=3)
    with torch.no_grad():
        whole = imaging.changed(spacing=8)(light)
        part = imaging.changed(spacing=8).part((-12.0, 4.0), reach=imaging.reach((48, 72)))
        found = part(light.crop(top=12, left=0, height=32, width=48))
    inner = (..., slice(8, -8), slice(8, -8))
    expected = whole[..., 12:44, 0:48][inner]
    assert float((found[inner] - expected).norm() / expected.norm()) < 5e-3


def test_work_over_the_field_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    imaging, light = camera()[0], stars()

    def predicted(**changes) -> float:
        return costs.seconds(imaging.changed(**changes).work(light), costs.RATES)

    assert predicted(field_variation=False) < predicted(spacing=40) < predicted(spacing=16) < predicted(spacing=4)
    assert predicted(spacing=16, bands=1) < predicted(spacing=16)


def leave_out(imaging: optics.Imaging, name: str, light: Scene) -> Tensor:
    with torch.no_grad():
        return imaging.changed(**{name: False}, spacing=16)(light)


def test_each_shortcut_leaves_out_what_it_says() -> None:
    imaging = camera("wide_angle", 10 * um, border="replicate")[0]
    even = Scene.from_bands(torch.ones(1, 3, 32, 48), wavelengths=LINES, depth=1.0)
    assert float((leave_out(imaging, "relative_illumination", even) - 1).abs().max()) < 5e-3


def test_without_lateral_colour_chief_rays_of_all_wavelengths_fall_where_the_middle_one_s_does() -> None:
    imaging = camera("wide_angle", 1 * um)[0]
    psfs = imaging.lens.over_field(0.3 * mm, torch.tensor([1.0]).double(), LINES)
    place = torch.tensor([[0.16 * mm, 0.2 * mm]]).double()
    lens, pixels = imaging.lens, imaging.pixels((41, 41), torch.empty(0, dtype=torch.float64))
    y = torch.arange(41, dtype=torch.float64) - 20

    def centres(lateral_colour: bool) -> Tensor:
        found = psfs.at_wavelengths(LINES, lateral_colour=lateral_colour).bank(place, pixels, whole=True)[0, 0]
        return torch.stack([(found * y).sum((1, 2)), (found * y[:, None]).sum((1, 2))], 1) / found.sum((1, 2))[:, None]

    height = psfs._heights(place.norm(dim=1))[0]
    field = -(height * place / place.norm())
    middle = (LINES[:1] + LINES[-1:]) / 2
    landed = lens.image_point(torch.cat([LINES, middle]), distances=1.0, field=field)[0, 0] / imaging.pixel_pitch
    moved = centres(True) - centres(False)
    assert float((moved - (landed[:-1] - landed[-1])).abs().max()) < 3e-3  # the window cuts tails
    assert float(moved.abs().max()) > 0.02
