"""Real lenses: exact rays against closed forms and an independent tracer, PSFs against a sum over rays."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from draws import Draw
from torch import Tensor, nn

from kcam import optics
from kcam.optics.compound.tracing import trace
from kcam.optics.pupil.rim import opening
from kcam.units import mm, nm, um

DOUBLE = torch.float64
LINE = 550 * nm


def singlet(**changes) -> optics.CompoundLens:
    """A plano-convex lens of N-BK7 with its stop in front."""
    back = {"radius": -25.8 * mm, "semi_diameter": 6 * mm} | changes
    return optics.CompoundLens(
        optics.Surface(semi_diameter=2.5 * mm, stop=True),
        optics.Surface(thickness=3 * mm, glass="N-BK7", semi_diameter=6 * mm),
        optics.Surface(**back),
        focus_distance=math.inf,
    )


def spherical_trace(lens: optics.CompoundLens, point: np.ndarray, direction: np.ndarray, indices: list[float]):
    """An independent tracer of spheres and planes in numpy, (R, 3) each: on the sensor, direction, path, r at each."""
    position, d, path, radii, z = point.astype(float), direction.astype(float), np.zeros(len(point)), [], 0.0
    for k, surface in enumerate(lens.surfaces):
        radius = float(surface.radius)
        if math.isinf(radius):
            t = (z - position[:, 2]) / d[:, 2]
            normal = np.broadcast_to([0.0, 0.0, 1.0], d.shape)
        else:
            centre = np.array([0, 0, z + radius])
            b = ((position - centre) * d).sum(1)
            c = ((position - centre) ** 2).sum(1) - radius**2
            t = -b - np.sign(radius) * np.sqrt(b**2 - c)
            normal = (centre - position - t[:, None] * d) / radius
        position, path = position + t[:, None] * d, path + indices[k] * t
        radii.append(np.hypot(position[:, 0], position[:, 1]))
        ratio, cosine = indices[k] / indices[k + 1], (d * normal).sum(1)
        d = ratio * d + (np.sqrt(1 - ratio**2 * (1 - cosine**2)) - ratio * cosine)[:, None] * normal
        z += float(surface.thickness) if k < len(lens.surfaces) - 1 else float(lens.sensor_distance)
    t = (z - position[:, 2]) / d[:, 2]
    return position + t[:, None] * d, d, path + t, np.array(radii)


def numbers(lens: optics.CompoundLens, wavelength: float) -> list[float]:
    return [float(index) for index in lens.indices(torch.tensor([wavelength], dtype=DOUBLE))]


# ---- closed forms ------------------------------------------------------------------------------------------------


def test_a_hyperbola_focuses_collimated_light_without_aberration() -> None:
    index, radius = 1.5, 20 * mm
    lens = optics.CompoundLens(
        optics.Surface(thickness=5 * mm, glass=index, semi_diameter=8 * mm, stop=True),
        optics.Surface(radius=-radius, conic=-(index**2)),
        focus_distance=math.inf,
    )
    assert lens.focal_length() == pytest.approx(radius / (index - 1), rel=1e-12)
    assert float(lens.sensor_distance) == pytest.approx(radius / (index - 1), rel=1e-12)
    fitted = lens.pupils(torch.tensor([LINE], dtype=DOUBLE), torch.zeros(1, dtype=DOUBLE), torch.zeros(1, dtype=DOUBLE))
    dx = torch.linspace(0, 0.15, 7, dtype=DOUBLE)
    path, _ = fitted.at(0, dx, 0 * dx)
    assert float((path - path[0]).abs().max()) < 1e-6 * LINE


@pytest.mark.parametrize(("name", "focal"), [("ef50", 51.5), ("cooke_triplet", 50.0)])
def test_presets_have_the_focal_length_of_their_source(name: str, focal: float) -> None:
    lens = optics.CompoundLens.preset(name, focus_wavelength=587.6 * nm)
    assert lens.focal_length() == pytest.approx(focal * mm, rel=5e-3)
    assert lens.f_number == pytest.approx({"ef50": 1.85, "cooke_triplet": 4.32}[name], rel=0.03)


def test_first_order_is_the_limit_of_rays_near_the_axis() -> None:
    lens = optics.CompoundLens.preset("ef50", focus_distance=3.0)
    first = lens.first_order()
    tiny = torch.tensor([[0.0, 1e-5]], dtype=DOUBLE)
    height = float(lens.image_point([LINE], distances=3.0, field=tiny)[0, 0, 0, 1])
    distance = 3.0 + float(first.entrance_pupil)
    image = float(lens.sensor_distance) - float(first.exit_pupil)
    angular = float(first.entrance_semi_diameter / first.exit_semi_diameter)
    assert height == pytest.approx(-1e-5 * image * angular, rel=1e-6)
    assert distance > 0


# ---- rays --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["ef50", "cooke_triplet"])
@pytest.mark.parametrize("distance", [0.6, math.inf])
def test_rays_are_those_of_an_independent_tracer(name: str, distance: float) -> None:
    lens, draw = optics.CompoundLens.preset(name, focus_distance=2.0), Draw(4)
    indices = numbers(lens, LINE)
    vergence = torch.tensor(1 / distance, dtype=DOUBLE)
    field, py = torch.tensor(0.2, dtype=DOUBLE), (draw.noise(50) - 0.5) * 6 * mm
    px = (draw.noise(50) - 0.5) * 6 * mm
    rays = lens.launch(field, vergence, px, py)
    start = np.stack([rays.x, rays.y, torch.zeros_like(rays.x)], 1)
    found = trace(lens.surfaces, rays, [torch.tensor(index, dtype=DOUBLE) for index in indices])
    reach = float(lens.sensor_distance) / found.dz
    point, direction, path, _ = spherical_trace(lens, start, np.stack([rays.dx, rays.dy, rays.dz], 1), indices)
    alive = found.alive.numpy()
    assert alive.sum() > 20
    own = torch.stack([found.x + reach * found.dx, found.y + reach * found.dy, found.dx, found.dy], 1).numpy()
    assert np.abs(own - np.concatenate([point[:, :2], direction[:, :2]], 1))[alive].max() < 1e-13
    assert np.abs((found.path - rays.path + reach).numpy() - path)[alive].max() < 1e-13


@pytest.mark.parametrize("distance", [0.3, 5.0, 1e6, math.inf])
def test_the_path_to_the_first_vertex_is_the_distance_from_the_object(distance: float) -> None:
    lens, draw = singlet(), Draw(1)
    field, px, py = torch.tensor(0.3, dtype=DOUBLE), *((draw.noise(2, 20) - 0.5) * 8 * mm)
    rays = lens.launch(field, torch.tensor(1 / distance, dtype=DOUBLE), px, py)
    if math.isinf(distance):
        expected = rays.x * rays.dx + rays.y * rays.dy
    else:
        height = 0.3 * (distance + float(lens.first_order().entrance_pupil))
        expected = torch.sqrt(rays.x**2 + (rays.y - height) ** 2 + distance**2) - math.hypot(distance, height)
    assert float((rays.path - expected).abs().max()) < 1e-15 * max(1, 0 if math.isinf(distance) else distance)


@pytest.mark.parametrize("name", ["ef50", "cooke_triplet"])
def test_chief_rays_pass_the_middle_of_the_stop(name: str) -> None:
    lens = optics.CompoundLens.preset(name)
    heights = torch.tensor([0.0, 0.1, 0.25, 0.36], dtype=DOUBLE)
    indices = [index[None] for index in lens.indices(torch.tensor([450 * nm, 650 * nm], dtype=DOUBLE))]
    zero = torch.zeros(1, 1, dtype=DOUBLE)
    aim, _, _ = lens.aimed(heights[:, None], zero, indices)
    at = trace(lens.surfaces, lens.launch(heights[:, None], zero, 0 * aim, aim), indices, until=lens.stop)
    assert float(at.y.abs().max()) < 1e-12


def test_images_turn_with_their_objects() -> None:
    lens = optics.CompoundLens.preset("cooke_triplet", focus_distance=1.0)
    where = {"distances": [0.8, math.inf]}
    up = lens.image_point([LINE], field=torch.tensor([[0.0, 0.2]]), **where)
    aside = lens.image_point([LINE], field=torch.tensor([[0.12, -0.16]]), **where)
    assert up.shape == (1, 2, 1, 2)
    assert (up[..., 0] == 0).all()
    assert float(up[0, 1, 0, 1]) == pytest.approx(-0.2 * lens.focal_length(), rel=0.06)
    assert torch.allclose(aside[0, :, 0], up[0, :, 0, 1:] * torch.tensor([0.6, -0.8], dtype=DOUBLE))
    assert lens.image_point([LINE], **where).abs().max() < 1e-12
    assert abs(float(lens.distortion(torch.tensor([[0.0, 0.36]])))) < 0.05


def test_the_wavefront_over_the_stop_is_that_of_the_pupil() -> None:
    """Where the fit has no image curvature of its own to tell them apart: on the axis, and of a round lens turned."""
    lens = optics.CompoundLens.preset("cooke_triplet", focus_distance=2.0)
    waves, passes = lens.opd([LINE], distances=[2.0], samples=33)
    assert waves.shape == passes.shape == (1, 1, 33, 33)
    assert float(waves[0, 0, 16, 16]) == pytest.approx(0, abs=1e-9)
    assert passes[0, 0].sum() == (torch.linspace(-1, 1, 33)[:, None] ** 2 + torch.linspace(-1, 1, 33) ** 2 <= 1).sum()
    turned = waves[0, 0].rot90()
    assert float((waves[0, 0] - turned)[passes[0, 0]].abs().max()) < 1e-6
    up, aside = (
        lens.opd([LINE], distances=2.0, field=torch.tensor([point], dtype=DOUBLE), samples=33)[0][0, 0, 0]
        for point in ([0.0, 0.2], [0.2, 0.0])
    )
    assert float((up - aside.T).abs().max()) < 1e-6
    assert float(up[8:25, 8:25].std()) > 0.05


# ---- gradients -----------------------------------------------------------------------------------------------------


NUMBERS = {
    "radius": 30 * mm, "thickness": 4 * mm, "conic": 0.3, "asphere": 100.0, "asphere2": 1.0, "odd_asphere": 1e-3
}  # fmt: skip
SERIES = ("asphere", "odd_asphere")


@pytest.mark.parametrize("what", NUMBERS)
def test_where_light_lands_has_a_gradient_to_every_number_of_a_surface(what: str) -> None:
    def landed(value: Tensor | float) -> Tensor:
        own = {
            what: torch.atleast_1d(torch.as_tensor(value, dtype=DOUBLE))
            if "sphere" in what and what != "asphere2"
            else value
        }
        front = {"radius": 30 * mm, "thickness": 4 * mm, "glass": 1.6, "conic": 0.3}
        lens = optics.CompoundLens(
            optics.Surface(thickness=3 * mm, semi_diameter=3 * mm, stop=True),
            optics.Surface(**(front | own)),
            optics.Surface(radius=-60 * mm),
            sensor_distance=33 * mm,
        )
        asked = torch.tensor([0.0, 0.15], dtype=DOUBLE)
        fitted = lens.pupils(torch.tensor([LINE], dtype=DOUBLE), torch.tensor([0.5], dtype=DOUBLE), asked)
        dx = torch.tensor([0.0, 0.02, 0.05], dtype=DOUBLE)
        paths = [fitted.at(node, dx, towards + 0.3 * dx)[0] for node, towards in enumerate((0.0, -0.16))]
        return torch.cat([fitted.chief, *paths])

    at = {"radius": 30 * mm, "thickness": 4 * mm, "conic": 0.3, "asphere": 100.0, "asphere2": 1.0, "odd_asphere": 1e-3}[
        what
    ]
    step = 1e-3 * at if what in ("conic", "asphere") else 1e-5 * at
    parameter = nn.Parameter(torch.tensor(at, dtype=DOUBLE))
    value = nn.Parameter(parameter.detach().reshape(1)) if what in SERIES else parameter
    found = landed(value)
    with torch.no_grad():
        slopes = (landed(at + step) - landed(at - step)) / (2 * step)
    for index in range(len(found)):
        (own,) = torch.autograd.grad(found[index], value, retain_graph=True)
        assert float(own) == pytest.approx(float(slopes[index]), rel=1e-5, abs=1e-5 * float(slopes.abs().max()))


@pytest.mark.parametrize(
    ("name", "height"),
    [
        ("cooke_triplet", 0.3),
        pytest.param("ef50", 0.1, marks=pytest.mark.slow),
        pytest.param("ef50", 0.3, marks=pytest.mark.slow),
    ],
)
def test_illumination_and_psfs_have_a_gradient_through_vignetting(name: str, height: float) -> None:
    """EF50 at f/1.85, where rings of the bundle are clipped, miss surfaces or are totally reflected."""
    lens = optics.CompoundLens.preset(name, focus_distance=2.0)
    for surface, name in ((lens.surfaces[-2], "radius"), (lens.surfaces[1], "thickness")):
        value = getattr(surface, name)
        delattr(surface, name)
        surface.register_parameter(name, nn.Parameter(torch.tensor(value, dtype=DOUBLE)))
    field = torch.tensor([[0.6 * height, 0.8 * height]], dtype=DOUBLE)
    weights = Draw(2).noise(9, 9)

    def both() -> Tensor:
        where = {"distances": 2.0, "pixel_pitch": 8 * um, "shape": (9, 9), "dtype": DOUBLE}
        light = lens.relative_illumination(field, distances=2.0)
        return torch.cat([light, (lens.psf([LINE], field=field, **where) * weights).sum()[None]])

    found = both()
    for parameter in lens.parameters():
        step = 5e-6 * float(parameter.detach().abs())
        with torch.no_grad():
            ends = []
            for sign in (1, -1):
                parameter += sign * step
                ends.append(both())
                parameter -= sign * step
            slopes = (ends[0] - ends[1]) / (2 * step)
        for own, slope in zip(found, slopes, strict=True):
            (gradient,) = torch.autograd.grad(own, parameter, retain_graph=True)
            scale = float(own.detach() / parameter.detach().abs())
            assert float(gradient) == pytest.approx(float(slope), rel=2e-3, abs=1e-3 * scale)


def test_the_middle_of_a_pupil_has_a_gradient() -> None:
    """Where a clearance is 1: its distance from the edge has no slope there."""
    axis = torch.linspace(-1.2, 1.2, 49)
    clearances = (1 - axis**2 - axis[:, None] ** 2)[None, None].requires_grad_()
    passed = opening(clearances)
    (slope,) = torch.autograd.grad(passed.sum(), clearances)
    assert bool(slope.isfinite().all())
    assert float(slope.abs().amax()) > 0


def test_light_that_cannot_pass_is_a_clear_error() -> None:
    with pytest.raises(ValueError, match=r"chief ray of a point at 3 "):
        optics.CompoundLens.preset("ef50").image_point([LINE], distances=math.inf, field=torch.tensor([[0.0, 3.0]]))
    where = {"distances": math.inf, "pixel_pitch": 4 * um, "shape": (5, 5)}
    narrow, lens = singlet(semi_diameter=0.01 * mm), singlet()
    with pytest.raises(ValueError, match="rays of a point pass"):
        narrow.psf([LINE], field=torch.tensor([[0.0, 0.3]]), **where)
    lens.surfaces[1].thickness = math.nan
    with pytest.raises(ValueError, match="thickness of a surface is NaN"):
        lens.psf([LINE], **where)


# ---- PSFs ----------------------------------------------------------------------------------------------------------


def huygens(lens: optics.CompoundLens, height: float, distance: float, points: np.ndarray, *, rays: int) -> np.ndarray:
    """|sum over rays|^2 at points (P, 2) about where the chief ray lands, by the independent tracer."""
    vergence = torch.tensor(1 / distance, dtype=DOUBLE)
    indices = numbers(lens, LINE)
    field = torch.tensor(height, dtype=DOUBLE)
    aim = float(lens.aimed(field, vergence, [torch.tensor(i, dtype=DOUBLE) for i in indices])[0])
    reach = 1.4 * float(lens.first_order().entrance_semi_diameter)
    side = (np.arange(rays) + 0.5) / rays * 2 - 1
    x, y = np.meshgrid(side * reach, side * reach + aim)
    x, y = np.append(x.ravel(), 0), np.append(y.ravel(), aim)
    started = lens.launch(field, vergence, torch.as_tensor(x), torch.as_tensor(y))
    start = np.stack([started.x, started.y, torch.zeros_like(started.x)], 1)
    with np.errstate(invalid="ignore"):
        point, direction, path, radii = spherical_trace(
            lens, start, np.stack([started.dx, started.dy, started.dz], 1), indices
        )
    path = path + started.path.numpy()
    open_part = np.ones(len(x), dtype=bool)
    for radius, surface in zip(radii, lens.surfaces, strict=True):
        open_part &= radius <= float(surface.semi_diameter)
    dx, dy = (direction[:, k] for k in (0, 1))
    wave = path - dx * point[:, 0] - dy * (point[:, 1] - point[-1, 1]) - path[-1]
    square = [part[:-1].reshape(rays, rays) for part in (dx, dy)]
    (xy, xx), (yy, yx) = (np.gradient(part) for part in square)
    area = np.abs(xx * yy - xy * yx).ravel()
    inside = open_part[:-1] & np.isfinite(wave[:-1]) & np.isfinite(area)
    k = 2 * math.pi / LINE
    amplitude = area[inside] * np.exp(1j * k * wave[:-1][inside])
    kernel = np.exp(1j * k * (points[:, :1] * dx[:-1][inside] + points[:, 1:] * (dy[:-1][inside] - dy[-1])))
    return np.abs(kernel @ amplitude) ** 2 / area[inside].sum() / LINE**2


@pytest.mark.parametrize(
    ("name", "height", "distance", "rays", "allowed"),
    [
        ("cooke_triplet", 0.25, 2.0, 300, 5e-3),
        pytest.param("cooke_triplet", 0.0, 2.0, 700, 1.5e-3, marks=pytest.mark.slow),
        pytest.param("cooke_triplet", 0.25, 2.0, 700, 1.5e-3, marks=pytest.mark.slow),
        pytest.param("cooke_triplet", 0.36, 1.5, 700, 1.5e-3, marks=pytest.mark.slow),
        pytest.param("ef50", 0.2, 2.0, 700, 4e-3, marks=pytest.mark.slow),
    ],
)
def test_psfs_are_those_of_a_sum_over_rays(
    name: str, height: float, distance: float, rays: int, allowed: float
) -> None:
    """Whose edge is a staircase: twice as many change it by 1e-3 (triplet) and 2e-3 (EF50)."""
    lens = optics.CompoundLens.preset(name, focus_distance=2.0)
    side = np.arange(-5, 6) * 4 * um
    points = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    field = torch.tensor([[0.0, height]], dtype=DOUBLE)
    where = {"distances": distance, "pixel_pitch": 4 * um, "shape": (11, 11), "dtype": DOUBLE, "integrate": False}
    found = lens.psf([LINE], field=field, **where)[0, 0, 0]
    truth = torch.as_tensor(huygens(lens, height, distance, points, rays=rays)).view(11, 11)
    truth = truth * (4 * um) ** 2 * float(lens.relative_illumination(field, distances=distance))
    error = float((found - truth).abs().sum() / truth.sum())
    print(f"{name} at {height}: {error:.1e}")
    assert error < allowed


def test_a_psf_sums_to_the_relative_illumination() -> None:
    lens = optics.CompoundLens.preset("cooke_triplet", focus_distance=2.0)
    field = torch.tensor([[0.0, 0.0], [0.1, 0.2]], dtype=DOUBLE)
    psf = lens.psf([LINE], distances=2.0, pixel_pitch=4 * um, shape=(151, 151), field=field)
    light = lens.relative_illumination(field, distances=2.0)
    assert float(light[0]) == pytest.approx(1, abs=1e-12)
    assert 0.2 < float(light[1]) < 0.99
    for own, whole in zip(psf.sum((-2, -1)).flatten().tolist(), light.tolist(), strict=True):
        assert own == pytest.approx(whole, rel=1e-2)


def test_a_thin_lens_with_its_stop_at_the_lens_is_a_lens_on_the_axis() -> None:
    """Plano-convex, thin, and slow enough for the thin element's own limits."""
    thin = optics.Lens(
        optics.CircularAperture(3 * mm), optics.PlanoConvexLens(51.6 * mm, glass=1.5), focus_distance=math.inf
    )
    real = optics.CompoundLens(
        optics.Surface(radius=math.inf, thickness=1e-6, glass=1.5, semi_diameter=1.5 * mm, stop=True),
        optics.Surface(radius=-51.6 * mm),
        focus_distance=math.inf,
    )
    where = {"distances": math.inf, "pixel_pitch": 4 * um, "shape": (25, 25), "dtype": DOUBLE}
    one, other = thin.psf([LINE], **where), real.psf([LINE], **where)
    assert float((one - other).abs().sum() / one.sum()) < 5e-3


# ---- what is refused -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"radius": 0.0}, "radius 0 m is outside"),
        ({"radius": 50.0}, "radius 50 m is outside"),
        ({"radius": math.nan}, "radius of a surface is NaN"),
        ({"thickness": 3.0}, "thickness 3 m is outside"),
        ({"semi_diameter": 5.0}, "semi_diameter 5 m is outside"),
        ({"radius": 5 * mm}, "is beyond where a surface of radius 0.005 m exists"),
        ({"glass": "window"}, "unknown glass 'window'"),
        ({"stop": True, "semi_diameter": None}, "the stop needs a semi_diameter"),
        ({"asphere": [1.0, math.nan]}, "asphere of a surface is NaN"),
    ],
)
def test_bad_surfaces_are_refused(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        optics.Surface(**({"radius": 20 * mm, "semi_diameter": 6 * mm} | change))


def test_bad_lenses_are_refused() -> None:
    plane = optics.Surface(semi_diameter=2 * mm, stop=True)
    glass = optics.Surface(radius=20 * mm, thickness=2 * mm, glass="N-BK7")
    back = optics.Surface(radius=-20 * mm)
    for surfaces, arguments, message in (
        ((glass, back), {"focus_distance": 1.0}, "exactly one stop, got 0"),
        ((plane, glass, plane, back), {"focus_distance": 1.0}, "exactly one stop, got 2"),
        ((plane, glass), {"sensor_distance": 0.02}, "glass behind it"),
        ((plane, glass, back), {}, "either focus_distance"),
        ((plane, glass, back), {"focus_distance": 0.01}, "no real image"),
        ((plane, glass, back), {"sensor_distance": -0.02}, "sensor_distance"),
    ):
        with pytest.raises(ValueError, match=message):
            optics.CompoundLens(*surfaces, **arguments)
    with pytest.raises(TypeError, match=r"takes optics.Surface"):
        optics.CompoundLens(optics.CircularAperture(2 * mm), focus_distance=1.0)
    with pytest.raises(
        ValueError, match="unknown lens 'zoom'; known: cooke_triplet, double_gauss, ef50, phone, phone_odd, "
    ):
        optics.CompoundLens.preset("zoom")
    with pytest.raises(ValueError, match="field must be finite"):
        singlet().image_point([LINE], distances=1.0, field=torch.zeros(2))
