"""Pictures over the field of a real lens: where light lands, how much, and with which PSF: one for each pixel."""

from __future__ import annotations

import math
import random
from pathlib import Path

import pytest
import torch
from draws import Draw
from torch import Tensor, nn

from kcam import Camera, Scene, optics, sensor
from kcam.optics.compound import aiming
from kcam.optics.compound.images import QUICK
from kcam.optics.numerics import fast_length
from kcam.optics.propagation import sampling
from kcam.optics.rendering.resampling import resampling
from kcam.optics.rendering.zones import Axis
from kcam.optics.source import PixelGrid
from kcam.units import mm, nm, um

DOUBLE = torch.float64
LINES = torch.tensor([480 * nm, 550 * nm, 640 * nm], dtype=DOUBLE)


def small(name: str = "cooke_triplet", scale: float = 0.1, *, stop: float = 1.0, **where) -> optics.CompoundLens:
    """A preset at a tenth of its size: its whole field on few pixels."""
    surfaces = [
        optics.Surface(
            radius=surface.radius * scale,
            thickness=float(surface.thickness) * scale,
            glass=surface.glass,
            semi_diameter=float(surface.semi_diameter) * scale * (stop if surface.stop else 1),
            stop=surface.stop,
        )
        for surface in optics.CompoundLens.preset(name).surfaces
    ]
    return optics.CompoundLens(*surfaces, **({"focus_distance": 1.0} | where))


def scene_of(light: Tensor, depth: float | Tensor = 1.0) -> Scene:
    return Scene.from_bands(light, wavelengths=LINES[: light.shape[1]], depth=depth)


def noise(*shape: int, seed: int = 0) -> Tensor:
    return Draw(seed).noise(*shape).double() if shape else torch.zeros(())


# ---- distortion ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("border", ["reflect", "replicate", "periodic"])
def test_an_even_scene_stays_even_under_distortion(border: str) -> None:
    moves = resampling(lambda at: at * (1 + 3e-5 * at.square().sum(-1, keepdim=True)), (40, 61), border)
    assert moves is not None
    assert float((moves(torch.ones(1, 2, 40, 61)) - 1).abs().max()) < 1e-6


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("strength", "off", "light_off"), [(3e-6, 0.012, 1e-3), (8e-6, 0.02, 1e-2)])
def test_distortion_moves_light_where_it_belongs(strength: float, off: float, light_off: float, sign: int) -> None:
    """For cushion and barrel that stretch pixels by 2 and by 6 % in the corners: a point keeps its place, and its light
    what area it covers.
    """

    def ideal(at: Tensor) -> Tensor:
        return at * (1 + sign * strength * at.square().sum(-1, keepdim=True))

    moves = resampling(ideal, (61, 81), "zero")
    assert moves is not None
    y, x = (torch.arange(n, dtype=DOUBLE) - (n - 1) / 2 for n in (61, 81))
    draw = Draw(7)
    anywhere = [(draw.one_of(*range(3, 58)), draw.one_of(*range(4, 77))) for _ in range(20)]
    for row, column in [(3, 4), (57, 76), (30, 40), *anywhere]:
        point = torch.zeros(1, 1, 61, 81, dtype=DOUBLE)
        point[..., row, column] = 1
        light = moves(point)[0, 0]
        where = torch.stack([(light * x).sum(), (light * y[:, None]).sum()]) / light.sum()
        jacobian = torch.autograd.functional.jacobian(ideal, where)
        away = torch.linalg.solve(jacobian, ideal(where) - torch.stack([x[column], y[row]]))
        assert float(away.norm()) < off
        assert float(light.sum() * jacobian.det()) == pytest.approx(1, rel=light_off)


def test_what_is_not_moved_is_not_touched() -> None:
    assert resampling(lambda at: at * (1 + 1e-6), (50, 50), "reflect") is None


# ---- the whole picture ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("shape", "centre"), [((48, 64), None), ((31, 40), (0.7 * mm, -0.5 * mm))])
def test_an_even_scene_gives_relative_illumination_without_seams(shape: tuple[int, int], centre) -> None:
    lens = small()
    imaging = optics.Imaging(
        lens, pixel_pitch=40 * um if centre is None else 20 * um, centre=centre, border="replicate"
    )
    light = imaging(scene_of(torch.ones(1, 1, *shape, dtype=DOUBLE)))[0, 0]
    psfs = imaging._over_field(shape, torch.ones(1, dtype=DOUBLE), LINES[:1])
    rows, columns = ([0, n // 3, n // 2, n - 1] for n in shape)
    y, x = torch.meshgrid(torch.tensor(rows), torch.tensor(columns), indexing="ij")
    pitch, (height, width) = imaging.pixel_pitch, shape
    middle = torch.tensor(centre or (0.0, 0.0), dtype=DOUBLE)
    places = middle - torch.stack([x - (width - 1) / 2, y - (height - 1) / 2], -1).double().view(-1, 2) * pitch
    field = -psfs.undistorted(places) / lens.image_scale  # light falls turned about
    expected = lens.relative_illumination(field, wavelengths=LINES[:1], distances=1.0).view(4, 4)
    assert float((light[y, x] / expected - 1).abs().max()) < 1e-3
    assert float(light.diff(n=2, dim=-1).abs().max()) < 2e-3


@pytest.mark.parametrize("centre", [None, (0.6 * mm, 0.4 * mm)])
def test_a_point_anywhere_lands_at_its_image_point(centre) -> None:
    lens, shape, pitch = small(), (75, 91), 12 * um
    imaging = optics.Imaging(lens, pixel_pitch=pitch, centre=centre, border="zero", spacing=16)
    y, x = (torch.arange(n, dtype=DOUBLE) - (n - 1) / 2 for n in shape)
    middle = torch.tensor(centre or (0.0, 0.0), dtype=DOUBLE)
    for row, column in ((37, 45), (20, 22), (60, 70)):
        light = torch.zeros(1, 1, *shape, dtype=DOUBLE)
        light[..., row, column] = 1
        ideal = middle - torch.stack([x[column], y[row]]) * pitch
        field = -ideal / lens.image_scale
        lands = lens.image_point([550 * nm], distances=1.0, field=field[None])[0, 0, 0]
        picture = imaging(Scene.from_bands(light, wavelengths=[550 * nm], depth=1.0))[0, 0]
        found = torch.stack([(picture * x).sum(), (picture * y[:, None]).sum()]) / picture.sum()
        psf = lens.psf([550 * nm], distances=1.0, pixel_pitch=pitch, shape=(61, 61), field=field[None], dtype=DOUBLE)[
            0, 0, 0
        ]
        k = torch.arange(61, dtype=DOUBLE) - 30
        own = torch.stack([(psf * k).sum(), (psf * k[:, None]).sum()]) / psf.sum()  # coma has a centre of its own
        expected = (middle - lands) / pitch - own
        assert float((found - expected).abs().max()) < 0.02


def truth(imaging: optics.Imaging, light: Tensor, window: tuple[int, int]) -> Tensor:
    """One PSF for each pixel of the scene that distortion has moved; dark beyond the picture."""
    height, width = light.shape[-2:]
    scene = scene_of(light)
    weights = torch.eye(light.shape[1], dtype=DOUBLE)
    field = imaging._field_picture(scene, vergences=torch.ones(1, dtype=DOUBLE), weights=weights, like=light)
    planes, _ = field.moved(light, None)
    y, x = (torch.arange(n, dtype=DOUBLE) - (n - 1) / 2 for n in (height, width))
    m, n = (side // 2 for side in window)
    picture = light.new_zeros(light.shape[1], height + 2 * m, width + 2 * n)
    for row in range(height):
        psfs = field.bank(torch.stack([x, y[row].expand(width)], -1))[:, 0].flip(-2, -1)
        for column in range(width):
            picture[:, row : row + window[0], column : column + window[1]] += (
                psfs[column] * planes[0, :, row, column, None, None]
            )
    return picture[:, m : m + height, n : n + width]


LENSES = [
    ("cooke_triplet", 1.0, 45 * um),
    ("ef50", 0.45, 60 * um),
    ("tessar", 0.8, 60 * um),
    ("wide_angle", 0.7, 30 * um),
]


@pytest.mark.parametrize(
    ("name", "stop", "pitch", "shape"),
    [(*LENSES[0][:2], 80 * um, (6, 16)), *(pytest.param(*row, (24, 32), marks=pytest.mark.slow) for row in LENSES)],
)
def test_a_picture_is_that_of_one_psf_for_each_pixel(name: str, stop: float, pitch: float, shape) -> None:
    """60 dB; the estimate is at least a third of the error, at any spacing."""
    window = (9, 9)
    lens = small(name, stop=stop, focus_distance=0.3)
    light = noise(1, 1, *shape, seed=1) ** 2
    imaging = optics.Imaging(lens, pixel_pitch=pitch, border="zero", psf_shape=window)
    expected = truth(imaging, light, window)
    for spacing in (None, 16, 8):
        own = imaging.changed(spacing=spacing)
        off = own(scene_of(light))[0] - expected
        rms = float(off.square().mean().sqrt())
        estimate = own.explain(scene_of(light))
        assert (
            estimate.blending + estimate.pupils + estimate.sampling > rms / float(expected.square().mean().sqrt()) / 3
        )
        if spacing is None:
            assert 20 * math.log10(float(expected.max()) / rms) > 60
    assert "places" in str(estimate)
    assert estimate.total > 0


OTHERS = [
    pytest.param("ef50", 10 * um, marks=pytest.mark.slow),
    pytest.param("cooke_triplet", 9 * um, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("name", "pitch"), [("tessar", 14 * um), *OTHERS])
def test_a_scene_tells_at_how_many_wavelengths_its_psfs_are_computed(name: str, pitch: float) -> None:
    """60 dB of a picture of 28 bands, against PSFs of all of them at places near each other."""
    scene = Scene.from_rgb(noise(1, 3, 64, 80, seed=5) ** 2, depth=1.0)
    imaging = optics.Imaging(small(name), pixel_pitch=pitch)
    colours = sensor.ColourFilter.kodak()
    picture = imaging(scene, colour_filter=colours)
    field, planes, shares = imaging._asked(scene, colours)
    how = field.how(*field.moved(planes, shares))
    assert how.colours is not None
    assert how.colours < 28
    expected = imaging.changed(spacing=10)
    every = expected(scene, colour_filter=colours)
    rms = float((picture - every).square().mean().sqrt())
    assert 20 * math.log10(float(every.max()) / rms) > 60
    estimate = imaging.explain(scene, colour_filter=colours)
    assert estimate.colours == pytest.approx(how.coloured)
    assert estimate.total > rms / float(every.square().mean().sqrt()) / 3


def test_the_adjoint_of_the_linear_part() -> None:
    imaging = optics.Imaging(small(), pixel_pitch=50 * um, psf_shape=(9, 9), spacing=16)
    x = (noise(1, 2, 20, 27) + 0.1).requires_grad_()
    picture = imaging(scene_of(x))
    y = noise(*picture.shape, seed=3)
    (back,) = torch.autograd.grad((picture * y).sum(), x)
    assert float((picture.detach() * y).sum()) == pytest.approx(float((x.detach() * back).sum()), rel=1e-5)


@pytest.mark.parametrize("depth", ["map", "batch"])
def test_distances_over_the_field(depth: str) -> None:
    """Of a map each half, away from the edge between them, is as if all were there; of a batch each item alone."""
    imaging = optics.Imaging(small(), pixel_pitch=8 * um, psf_shape=(11, 11), spacing=12)
    light = noise(2, 1, 24, 40)
    near, far = (imaging(scene_of(light, distance)) for distance in (0.15, 2.0))
    assert float((near - far).abs().max()) > 0.02
    if depth == "batch":
        found = imaging(scene_of(light, torch.tensor([0.15, 2.0], dtype=DOUBLE)))
        assert float((found - torch.stack([near[0], far[1]])).abs().max()) < 1e-6
        return
    places = torch.full((2, 1, 24, 40), 2.0, dtype=DOUBLE)
    places[..., :20] = 0.15
    found = imaging(scene_of(light, places))
    assert float((found - near)[..., :12].abs().max()) < 1e-4
    assert float((found - far)[..., 28:].abs().max()) < 1e-4


@pytest.mark.parametrize(
    "what", ["radius", *(pytest.param(name, marks=pytest.mark.slow) for name in ("thickness", "semi_diameter"))]
)
def test_pictures_have_gradients_to_the_surfaces(what: str) -> None:
    lens = small()
    surface = lens.surfaces[lens.stop if what == "semi_diameter" else 1 if what == "thickness" else 4]
    value = float(getattr(surface, what))
    delattr(surface, what)
    parameter = nn.Parameter(torch.tensor(value, dtype=DOUBLE))
    surface.register_parameter(what, parameter)
    imaging = optics.Imaging(lens, pixel_pitch=50 * um, psf_shape=(9, 9), spacing=16)
    light, weights = noise(1, 1, 20, 24), noise(1, 1, 20, 24, seed=5)

    def loss() -> Tensor:
        return (imaging(scene_of(light)) * weights).sum()

    (gradient,) = torch.autograd.grad(loss(), parameter)
    step = 3e-6 * abs(value)
    with torch.no_grad():
        ends = []
        for sign in (1, -1):
            parameter += sign * step
            ends.append(float(loss()))
            parameter -= sign * step
    slope = (ends[0] - ends[1]) / (2 * step)
    assert float(gradient) == pytest.approx(slope, rel=5e-3, abs=3e-4 * float(loss().detach()) / abs(value))


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (17, 2), (33, 20)])
@pytest.mark.parametrize("border", ["reflect", "zero"])
def test_pictures_of_any_shape(shape: tuple[int, int], border: str) -> None:
    imaging = optics.Imaging(small(), pixel_pitch=50 * um, border=border)
    picture = imaging(scene_of(torch.ones(1, 1, *shape)), colour_filter=None)
    assert picture.shape == (1, 1, *shape)
    assert bool((picture > 0).all())
    assert bool((picture < 1.01).all())


def test_the_axis_alone_is_a_picture_of_one_psf() -> None:
    lens, light = small(), noise(1, 1, 16, 20)
    alone = optics.Imaging(lens, pixel_pitch=10 * um, field=False, psf_shape=(9, 9))
    psf = lens.psf(LINES[:1], distances=1.0, pixel_pitch=10 * um, shape=(9, 9), dtype=DOUBLE)
    measured = optics.MeasuredPSF(psf, wavelengths=LINES[:1], distances=1.0, pixel_pitch=10 * um)
    expected = optics.Imaging(measured, pixel_pitch=10 * um)(scene_of(light))
    assert float((alone(scene_of(light)) - expected).abs().max()) < 2e-3
    assert float((optics.Imaging(lens, pixel_pitch=10 * um)(scene_of(light)) - expected).abs().max()) > 5e-3


@pytest.mark.slow
def test_a_camera_with_a_real_lens_comes_back_from_its_file(tmp_path: Path) -> None:
    imaging = optics.Imaging(small(), pixel_pitch=40 * um, centre=(0.1 * mm, 0.0), spacing=16, psf_shape=(9, 9))
    camera = Camera(imaging, sensor.ColourFilter.nikon())
    camera.save(tmp_path / "camera.safetensors")
    scene = Scene.builtin("coffee", (20, 30)).with_depth(1.0)
    assert torch.equal(Camera.load(tmp_path / "camera.safetensors")(scene), camera(scene))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["slr", "phone_lens"])
def test_presets_with_real_lenses_take_pictures(name: str) -> None:
    """The middle of the picture is what the lens' own PSF on the axis makes of it; the second picture is the first."""
    camera = Camera.preset(name)
    scene = Scene.builtin("coffee", (20, 30)).with_depth(2.0 if name == "phone_lens" else 5.0)
    seeds = [torch.Generator().manual_seed(1) for _ in range(2)]
    first, second = (camera(scene, generator=seed) for seed in seeds)
    assert torch.equal(first, second)
    axis = Camera(camera[0].changed(field=False, psf_shape=(33, 33)), camera[1])(scene)
    varied = Camera(camera[0].changed(psf_shape=(33, 33)), camera[1])(scene)
    assert float((axis - varied).abs().max() / axis.max()) < 0.02


def test_what_cannot_be_is_a_clear_error() -> None:
    with pytest.raises(ValueError, match="beyond the field of this lens"):
        optics.Imaging(small(), pixel_pitch=400 * um)(scene_of(torch.ones(1, 1, 64, 64)))
    with pytest.raises(ValueError, match="centre must be x and y"):
        optics.Imaging(small(), centre=(1.0, 2.0, 3.0))
    with pytest.raises(ValueError, match="centre must be x and y"):
        optics.Imaging(small(), centre=(5.0, 2.0))
    thin = optics.Lens(optics.CircularAperture(3 * mm), optics.ThinLens(20 * mm), focus_distance=1.0)
    measured = optics.MeasuredPSF(torch.ones(1, 1, 3, 3), wavelengths=LINES[:1], distances=1.0, pixel_pitch=4 * um)
    with pytest.raises(ValueError, match="one PSF, that on the axis"):
        optics.Imaging(measured, field=True)
    with pytest.raises(ValueError, match="sees one PSF"):
        optics.Imaging(thin).explain(scene_of(torch.ones(1, 1, 8, 8)))


# ---- between what is traced ------------------------------------------------------------------------------------------


NAMES = ("cooke_triplet", "phone", "ef50", "tessar", "wide_angle", "double_gauss", "telephoto")


def some(names: tuple[str, ...], *, quick: int) -> list:
    """The first few among the quick tests, the others among the slow."""
    return [*names[:quick], *(pytest.param(name, marks=pytest.mark.slow) for name in names[quick:])]


@pytest.mark.parametrize("name", some(NAMES, quick=1))
def test_pupils_between_heights_are_those_of_their_rays(name: str) -> None:
    """At random heights up to where most of the light is gone: the wavefront as estimated, and open where rays pass."""
    lens = optics.CompoundLens.preset(name, focus_distance=3.0)
    draw, where = Draw(3), torch.tensor([0.5], dtype=DOUBLE)
    colours = torch.linspace(420 * nm, 700 * nm, 8, dtype=DOUBLE)
    highest = 0.9 * lens.field_limit()
    reach = -lens.image_point([LINES[1]], distances=2.0, field=points(highest))[0, 0, 0, 1]
    psfs = lens.over_field(float(reach), where, colours)
    heights = torch.tensor([draw.number(0, highest) for _ in range(5)], dtype=DOUBLE)
    pupils = psfs.table.at(heights, where.expand(5), colours[3].expand(5))
    nodes = aiming.nodes(lens._prescription, colours[3:4], where, heights)
    radius, angle = 1.1 * draw.noise(2000).sqrt(), math.pi * draw.noise(2000)
    rays = nodes.beam.at_sensor(*nodes.towards(radius * angle.sin(), radius * angle.cos()))
    chief, least = nodes.chief, torch.stack(rays.clearance).amin(0)
    path = rays.path - rays.dx * rays.x - rays.dy * (rays.y - chief.y) - chief.path
    dx, dy, path, least, alive = (part.flatten(0, 2) for part in (rays.dx, rays.dy, path, least, rays.alive))
    found, clearances = pupils.at(torch.arange(5), dx, dy)
    passes, open_ = alive & (least > 0), (clearances > 0).all(1)
    off = torch.where(passes & open_, 2 * math.pi * (found - path) / colours[3], math.nan)
    rms = (off - off.nanmean(1, keepdim=True)).square().nanmean(1).sqrt()
    assert float(rms.max()) < max(5e-3, 3 * psfs.table.deviation)
    assert not bool((alive & (least > 0.02) & ~open_).any())
    assert int((alive & (least < -0.02) & open_).sum()) <= 2e-3 * passes.sum()


def points(height: float) -> Tensor:
    return torch.tensor([[0.0, height]], dtype=DOUBLE)


@pytest.mark.parametrize("name", some(NAMES, quick=1))
def test_rays_fill_what_is_open_from_anywhere_in_the_field(name: str) -> None:
    """A phone's stop is a steep asphere: seen from the corner its rim is a quarter farther away than by its slopes."""
    lens = optics.CompoundLens.preset(name, focus_distance=3.0)
    heights = torch.tensor([0.3, 0.6, 0.9], dtype=DOUBLE) * lens.field_limit()
    nodes = aiming.nodes(lens._prescription, LINES[1:2], torch.tensor([0.3], dtype=DOUBLE), heights)
    for x, y in ((0.0, 1.12), (0.0, -1.12), (1.12, 0.0)):
        rays = nodes.beam.at_sensor(*nodes.towards(*torch.tensor([[x], [y]], dtype=DOUBLE)))
        assert bool((~rays.alive | (torch.stack(rays.clearance).amin(0) < 0.02)).all())
    field = torch.stack([0 * heights, heights], 1)
    _, weights = lens.spots([LINES[1]], distances=3.0, field=field, rings=40)
    illumination = lens.relative_illumination(field, wavelengths=LINES[1:2], distances=3.0)
    assert float((weights[:, 0, 0].sum(-1) / illumination - 1).abs().max()) < 1e-2


@pytest.mark.parametrize("name", some(NAMES, quick=1))
def test_a_point_of_a_preset_lands_at_its_image_point(name: str) -> None:
    """Anywhere in four fifths of its field, to 0.02 pixels."""
    lens, shape, draw = optics.CompoundLens.preset(name, focus_distance=5.0), (181, 201), Draw(11)
    pitch, side = (2 if name == "phone" else 8) * um, 121
    reach = 0.8 * lens.field_limit() * float(lens.image_scale)
    y, x = (torch.arange(n, dtype=DOUBLE) - (n - 1) / 2 for n in shape)
    k = torch.arange(side, dtype=DOUBLE) - side // 2

    def centroid(light: Tensor, x: Tensor, y: Tensor) -> Tensor:
        return torch.stack([(light * x).sum(), (light * y[:, None]).sum()]) / light.sum()

    for _ in range(2):
        angle, away = draw.number(0, 2 * math.pi), reach * math.sqrt(draw.number(0, 1))
        middle = torch.tensor([away * math.cos(angle), away * math.sin(angle)], dtype=DOUBLE)
        imaging = optics.Imaging(
            lens, pixel_pitch=pitch, border="zero", centre=tuple(middle.tolist()), psf_shape=(side, side)
        )
        psfs = imaging._over_field(shape, torch.tensor([0.2], dtype=DOUBLE), LINES[1:2])
        moved = ((middle - psfs.undistorted(middle)) / pitch).round().long()
        column, row = int(moved[0]) + 100, int(moved[1]) + 90
        if not (0 <= column < shape[1] and 0 <= row < shape[0]):
            continue  # distortion moves what is seen here by more than this picture
        light = torch.zeros(1, 1, *shape, dtype=DOUBLE)
        light[..., row, column] = 1
        field = -(middle - torch.stack([x[column], y[row]]) * pitch)[None] / lens.image_scale
        where = {"distances": 5.0, "field": field}
        psf = lens.psf(LINES[1:2], pixel_pitch=pitch, shape=(side, side), dtype=DOUBLE, **where)[0, 0, 0]
        expected = (middle - lens.image_point(LINES[1:2], **where)[0, 0, 0]) / pitch - centroid(psf, k, k)
        picture = imaging(Scene.from_bands(light, wavelengths=LINES[1:2], depth=5.0))[0, 0]
        assert float((centroid(picture, x, y) - expected).abs().max()) < 0.02


@pytest.mark.parametrize("seed", range(5))
def test_a_transform_that_is_just_long_enough(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Points in a pixel follow from a wavelength by a product and a quotient: rounded up, they once needed one more."""
    draw = random.Random(seed)
    while True:
        per_pixel, half, wavelength = draw.randrange(5, 24) / 4, draw.randrange(20, 60), draw.uniform(4.2e-7, 7e-7)
        margin = half + QUICK.margin
        points = math.ceil(per_pixel * margin)
        rounded = math.ceil(per_pixel * wavelength / wavelength * margin)
        if rounded > points and fast_length(2 * points + 1) <= 2 * points + 2:
            break
    lens, own = small(stop=0.25), torch.tensor([wavelength], dtype=DOUBLE)
    pixels = PixelGrid(4e-6, (2 * half, 2 * half), 1.0, True, DOUBLE, torch.device("cpu"))

    def psf() -> Tensor:
        return lens.over_field(1e-4, torch.tensor([1.0], dtype=DOUBLE), own).bank(
            torch.zeros(1, 2, dtype=DOUBLE), pixels
        )

    usual = psf()
    monkeypatch.setattr(sampling, "points_per_pixel", lambda **_: per_pixel)
    assert float((psf() - usual).abs().sum()) < 2e-3


def test_nodes_that_mirror_each_other_have_as_many_pixels() -> None:
    """Of a node on a pixel rounding leaves 1e-17 of a share on one side, and its twin's zone was a pixel smaller."""
    for n in range(20, 420, 7):
        for apart in (17, 20, 23, 54, 64, 101):
            axis = Axis.of(n, 31, apart=apart)
            sizes = [last - first for first, last in map(axis.reach, range(len(axis.nodes)))]
            assert sizes == sizes[::-1], (n, apart)
            assert torch.allclose(axis.weights.sum(0), torch.ones(n + 30, dtype=DOUBLE), atol=1e-8)


@pytest.mark.parametrize("name", ["phone", "phone_odd", "cooke_triplet", pytest.param("ef50", marks=pytest.mark.slow)])
def test_a_smaller_window_holds_the_middle_of_a_psf_and_all_of_its_light(name: str) -> None:
    """It takes fewer samples of the pupil, of whose edge these know less: 1.3 % of a PSF's light, and 0.8 % of its
    brightness, were off where they took the edge of an asphere's pupil for straight.
    """
    draw = Draw(len(name))
    lens, pitch = optics.CompoundLens.preset(name, focus_distance=2.0), draw.number(1, 3) * um
    reach = 100 * pitch
    psfs = lens.over_field(reach, torch.tensor([0.5], dtype=torch.float64), torch.tensor([450, 650]).double() * nm)
    places = reach * torch.tensor([[0.0, 0.0], [draw.number(0, 0.7), draw.number(0, 0.7)]], dtype=torch.float64)
    with torch.no_grad():
        whole = psfs.bank(places, PixelGrid(pitch, (161, 161)), whole=True).double()
        for side in (17, 33, 65):
            seen = whole[..., 80 - side // 2 : 81 + side // 2, 80 - side // 2 : 81 + side // 2]
            if float((seen.sum((-2, -1)) / whole.sum((-2, -1))).min()) < 0.95:
                continue
            own = psfs.bank(places, PixelGrid(pitch, (side, side)), whole=True).double()
            torch.testing.assert_close(own.sum((-2, -1)), whole.sum((-2, -1)), rtol=1e-5, atol=0)
            off = own - seen * (whole.sum((-2, -1)) / seen.sum((-2, -1)))[..., None, None]
            assert float(off.abs().sum((-2, -1)).max()) < 3e-3
