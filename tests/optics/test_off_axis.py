"""Thin elements off the axis: against sums over the pupil with exact distances, and what pictures make of them."""

from __future__ import annotations

import math

import pytest
import torch
from draws import Draw
from torch import Tensor, nn

from kcam import Scene, optics
from kcam.optics.propagation.off_axis import off_axis_psf
from kcam.optics.pupil.coordinates import Pupil
from kcam.optics.source import Points
from kcam.units import mm, nm, um

DOUBLE = torch.float64
LINE = torch.tensor([550 * nm], dtype=DOUBLE)
ZERNIKES = torch.tensor([0, 0, 0, 0, 0, 40, 0, 60, 0, 20], dtype=DOUBLE) * nm


def lens_of(
    *elements: optics.Element, width: float = 0.5 * mm, focal_length: float = 8 * mm, focus: float = 1.0
) -> optics.Lens:
    return optics.Lens(optics.CircularAperture(width), optics.ThinLens(focal_length), *elements, focus_distance=focus)


def seen(lens: optics.Lens, field: list[list[float]], *, distance: float = 1.0, **how) -> Tensor:
    arguments = {"pixel_pitch": 3 * um, "shape": (21, 21), "dtype": DOUBLE} | how
    return lens.psf(LINE, distances=distance, field=torch.tensor(field, dtype=DOUBLE), **arguments)[:, 0, 0]


def summed(
    lens: optics.Lens, point: list[float], *, pitch: float, shape: tuple[int, int], distance: float = 1.0, nodes: int
) -> Tensor:
    """Rayleigh-Sommerfeld by midpoints of a polar or square grid; every path is a square root of its own."""
    a, d, k = float(lens.aperture.semi_aperture()), float(lens.sensor_distance), 2 * math.pi / float(LINE)
    if lens.round:
        rho = ((torch.arange(nodes, dtype=DOUBLE) + 0.5) / nodes).sqrt()  # rings of one area
        angle = torch.arange(2 * nodes, dtype=DOUBLE) * (math.pi / nodes)
        x, y = (rho[:, None] * angle.cos()).flatten(), (rho[:, None] * angle.sin()).flatten()
    else:  # by pixels, each of many nodes
        side = (torch.arange(nodes, dtype=DOUBLE) + 0.5) * (2 / nodes) - 1
        x, y = side.repeat(nodes), side.repeat_interleave(nodes)
    one = torch.ones((), dtype=DOUBLE)
    pupil = Pupil(x, y, one * a, one * d, paraxial=False, round=True)
    opd = torch.zeros_like(x)
    for element in lens.elements:
        opd = opd + element.vergence(LINE)[0] * pupil.rho2 * a**2 / 2
        for coefficient, term in element.terms(pupil, LINE):
            opd = opd + coefficient[0] * term
        pixels = element.pixel_map(LINE)
        if pixels is not None and pixels.factors is not None:
            n = len(pixels.values)
            row, column = (((part + 1) / 2 * n).floor().long().clamp(0, n - 1) for part in (y, x))
            opd = opd + pixels.factors[0] * pixels.values[row, column] / k
    tx, ty = point
    there = torch.sqrt((a * x - tx * distance) ** 2 + (a * y - ty * distance) ** 2 + distance**2)
    light = distance / there
    x0, y0 = -tx * d, -ty * d
    rows, columns = ((torch.arange(n, dtype=DOUBLE) - n // 2) * pitch for n in shape)
    found = torch.zeros(shape, dtype=DOUBLE)
    for i, down in enumerate(rows):
        for j, along in enumerate(columns):
            far = torch.sqrt((x0 + along - a * x) ** 2 + (y0 + down - a * y) ** 2 + d**2)
            phase = k * (there + opd + far)
            wave = light * d / far**2
            found[i, j] = (wave * phase.cos()).sum() ** 2 + (wave * phase.sin()).sum() ** 2
    area = (math.pi if lens.round else 4) * a**2 / len(x)
    here = torch.sqrt((x0 - a * x) ** 2 + (y0 - a * y) ** 2 + d**2)
    share = (here**-4).sum() / ((d**2 + a**2 * pupil.rho2) ** -2).sum()
    return found * area * pitch**2 / float(LINE) ** 2 / light.square().sum() * share


ROUND = optics.CircularAperture(0.5 * mm)
SQUARES = torch.arange(64, dtype=DOUBLE).view(8, 8) * 2.3 % 6.0


@pytest.mark.parametrize(
    ("aperture", "elements", "point", "nodes", "limit"),
    [
        (ROUND, [], [0.0, 0.1], 200, 3e-4),
        (ROUND, [], [0.2, 0.1], 300, 8e-4),
        (ROUND, [optics.ZernikeAberration(ZERNIKES)], [-0.1, 0.1], 200, 6e-4),
        (ROUND, [optics.PlanoConvexLens(60 * mm)], [0.0, 0.15], 300, 6e-4),
        (optics.SquareAperture(0.5 * mm), [optics.DOE(SQUARES / 3)], [0.05, 0.1], 320, 2e-3),
    ],
    ids=["near", "far", "zernike", "singlet", "doe"],
)
def test_a_psf_is_the_sum_over_the_pupil_with_exact_distances(
    aperture, elements, point, nodes: int, limit: float
) -> None:
    lens = optics.Lens(aperture, optics.ThinLens(8 * mm), *elements, focus_distance=1.0)
    own = seen(lens, [point], shape=(11, 11), integrate=False)[0]
    truth = summed(lens, point, pitch=3 * um, shape=(11, 11), nodes=nodes)
    assert float((own - truth).abs().sum() / truth.sum()) < limit


APERTURES = [
    optics.CircularAperture(1 * mm),
    optics.AnnularAperture(1 * mm, obscuration=0.4),
    optics.SquareAperture(1 * mm),
    optics.ApertureMap((Draw(2).noise(7, 7) > 0.3).double(), width=1 * mm),
]


@pytest.mark.parametrize("aperture", APERTURES, ids=lambda aperture: type(aperture).__name__)
@pytest.mark.parametrize(
    "element", [optics.ZernikeDOE(ZERNIKES / (80 * nm)), optics.DOE(SQUARES)], ids=["smooth", "map"]
)
def test_the_middle_of_the_field_is_the_axis(aperture: optics.Element, element: optics.Element) -> None:
    lens = optics.Lens(aperture, optics.ThinLens(8 * mm), element, focus_distance=1.0)
    axis = lens.psf(LINE, distances=0.5, pixel_pitch=3 * um, shape=(21, 24), dtype=DOUBLE)[0, 0]
    middle = seen(lens, [[0.0, 0.0]], distance=0.5, shape=(21, 24))[0]
    limit = 1e-3 if isinstance(element, optics.DOE) else 1e-4  # flat pixels are sampled to 1e-3
    assert float((axis - middle).abs().sum()) < limit


def test_a_round_lens_turns_with_the_field() -> None:
    down, right, up = seen(lens_of(), [[0.0, 0.2], [0.2, 0.0], [0.0, -0.2]])
    assert float((down.mT - right).abs().sum()) < 1e-5
    assert float((down.flip(0) - up).abs().sum()) < 1e-5
    assert float((down - right).abs().sum()) > 0.1


@pytest.mark.parametrize("aperture", APERTURES, ids=lambda aperture: type(aperture).__name__)
def test_light_is_the_pupil_in_direction_cosines(aperture: optics.Element) -> None:
    """By a sum over midpoints of the aperture's square; a psf sums to it, less what leaves the window."""
    lens = optics.Lens(aperture, optics.ThinLens(4 * mm), focus_distance=1.0)
    d, n = float(lens.sensor_distance), 700
    side = ((torch.arange(n, dtype=DOUBLE) + 0.5) / n * 2 - 1) * 0.5 * mm
    rho = torch.hypot(side[:, None], side) / (0.5 * mm)
    discs, own = aperture.discs(), aperture.pixel_map(LINE)
    power = sum((w * (rho <= r) for r, w in discs), torch.zeros(n, n, dtype=DOUBLE))
    if own is not None:
        m = own.values.shape[-1]
        power = own.values.double().repeat_interleave(n // m, 0).repeat_interleave(n // m, 1) ** 2
    field = torch.tensor([[0.0, 0.0], [0.3, 0.1], [0.0, -0.6], [1.0, 1.0]], dtype=DOUBLE)
    shares = [(power / (d**2 + (-tx * d - side) ** 2 + (-ty * d - side[:, None]) ** 2) ** 2).sum() for tx, ty in field]
    expected = torch.stack(shares) / shares[0]
    found = lens.relative_illumination(field)
    assert float((found / expected - 1).abs().max()) < 3e-4
    assert float(lens.relative_illumination(torch.zeros(1, 2))) == 1
    cos4 = (1 + field.square().sum(1)) ** -2
    assert float((found / cos4 - 1).abs().max()) < 0.05
    wide = seen(lens, [[0.3, 0.1]], pixel_pitch=20 * um, shape=(17, 17), dtype=torch.float32)
    assert float(wide.sum()) == pytest.approx(float(expected[1]), rel=0.03)


def test_chief_rays_go_straight_and_light_lands_around_them() -> None:
    lens = lens_of(width=0.2 * mm)
    field = torch.tensor([[0.0, 0.1], [-0.2, 0.05]], dtype=DOUBLE)
    points = lens.image_point([450 * nm, 550 * nm], distances=[0.5, 1.0, math.inf], field=field)
    assert points.shape == (2, 3, 2, 2)
    assert torch.allclose(points, (-field * lens.sensor_distance)[:, None, None].expand_as(points))
    assert lens.image_point(LINE, distances=1.0).abs().max() == 0
    psfs = seen(lens, field.tolist(), shape=(61, 61))
    k = (torch.arange(61, dtype=DOUBLE) - 30) * 3 * um
    middle = torch.stack([(psfs * k).sum((1, 2)), (psfs * k[:, None]).sum((1, 2))], -1) / psfs.sum((1, 2))[:, None]
    assert float(middle.abs().max()) < 1 * um


def test_astigmatism_of_a_thin_lens() -> None:
    """-r^2 / 2f is cancelled along y by a sensor at d = f cos^3, and along x by one at f cos."""
    t, f = 0.5, 8 * mm
    cos = 1 / math.hypot(1, t)
    for power, along in ((3, -2), (1, -1)):
        lens = optics.Lens(optics.CircularAperture(0.6 * mm), optics.ThinLens(f), sensor_distance=f * cos**power)
        psf = seen(lens, [[0.0, t]], distance=math.inf, pixel_pitch=4 * um, shape=(61, 61))[0]
        k = torch.arange(61, dtype=DOUBLE) - 30
        across = (psf.sum(-1) if along == -2 else psf.sum(-2)) * k.abs()
        other = (psf.sum(-2) if along == -2 else psf.sum(-1)) * k.abs()
        assert float(across.sum()) < 0.3 * float(other.sum())


def test_it_is_the_compound_lens_that_is_as_thin() -> None:
    """A plano-convex lens 5 um thick, its stop at the glass: what glass adds to a screen, Petzval's t^2 / 2 n f, is
    small where the field is.
    """
    radius = 20 * mm
    thin = optics.Lens(optics.CircularAperture(0.5 * mm), optics.PlanoConvexLens(radius), focus_distance=1.0)
    distance = float(thin.sensor_distance)
    compound = optics.CompoundLens(
        optics.Surface(radius=radius, thickness=5 * um, glass="N-BK7", semi_diameter=0.25 * mm, stop=True),
        optics.Surface(radius=math.inf, thickness=0.0, glass=None),
        sensor_distance=distance,
    )
    field = torch.tensor([[0.0, 0.05]], dtype=DOUBLE)
    arguments = {"distances": 1.0, "pixel_pitch": 10 * um, "shape": (41, 41), "dtype": DOUBLE, "field": field}
    one, other = (lens.psf(LINE, **arguments)[0, 0, 0] for lens in (thin, compound))
    # the compound lens weighs a point's light by its own rays, which field curvature lets converge elsewhere
    assert float((one / one.sum() - other / other.sum()).abs().sum()) < 0.012
    landed = compound.image_point(LINE, distances=1.0, field=field)
    assert float((landed - thin.image_point(LINE, distances=1.0, field=field)).abs().max()) < 2 * um


@pytest.mark.parametrize("what", ["field", "sensor_distance", "focal_length", "diameter", "coefficients", "phase"])
def test_gradients_are_those_of_differences(what: str) -> None:
    values = {
        "field": torch.tensor([[0.1, 0.2]], dtype=DOUBLE),
        "sensor_distance": torch.tensor(8.1 * mm, dtype=DOUBLE),
        "focal_length": torch.tensor(8 * mm, dtype=DOUBLE),
        "diameter": torch.tensor(0.3 * mm, dtype=DOUBLE),
        "coefficients": ZERNIKES.clone(),
        "phase": SQUARES.clone(),
    }
    scale = {"coefficients": 100 * nm, "phase": 1.0, "field": 1.0}.get(what, float(values[what].max()))
    weights = Draw(4).noise(9, 9).double()

    def loss(unit: Tensor) -> Tensor:
        own = values | {what: unit * scale}
        parts = [optics.ThinLens(own["focal_length"]), optics.ZernikeAberration(own["coefficients"])]
        if what == "phase":
            parts.append(optics.DOE(own["phase"]))
        lens = optics.Lens(optics.CircularAperture(own["diameter"]), *parts, sensor_distance=own["sensor_distance"])
        psf = lens.psf(LINE, distances=0.5, pixel_pitch=6 * um, shape=(9, 9), field=own["field"], dtype=DOUBLE)
        return (psf[0, 0, 0] * weights).sum()

    start = (values[what] / scale).requires_grad_()
    (gradient,) = torch.autograd.grad(loss(start), start)
    direction = Draw(5).noise(*start.shape).double() if start.ndim else torch.ones((), dtype=DOUBLE)
    step = 1e-5
    with torch.no_grad():
        slope = (loss(start + step * direction) - loss(start - step * direction)) / (2 * step)
    assert float((gradient * direction).sum()) == pytest.approx(float(slope), rel=2e-3)


def test_the_mtf_off_the_axis() -> None:
    lens = lens_of()
    field = torch.tensor([[0.0, 0.0], [0.0, 0.2]], dtype=DOUBLE)
    found = lens.mtf(LINE, distances=1.0, pixel_pitch=3 * um, shape=(33, 33), dtype=DOUBLE, field=field)[:, 0, 0]
    axis = lens.mtf(LINE, distances=1.0, pixel_pitch=3 * um, shape=(33, 33), dtype=DOUBLE)[0, 0]
    assert float((found[0] - axis).abs().max()) < 1e-3
    assert float(found[1, 20, 16]) < float(found[1, 16, 20])  # tangential lines blur more


# ---- pictures ------------------------------------------------------------------------------------------------------


def scene_of(light: Tensor) -> Scene:
    return Scene.from_bands(light, wavelengths=LINE, depth=1.0)


def test_an_even_scene_gives_relative_illumination() -> None:
    lens = lens_of(width=0.25 * mm, focal_length=4 * mm)
    imaging = optics.Imaging(lens, pixel_pitch=24 * um, field=True, border="replicate", spacing=16)
    light = imaging(scene_of(torch.ones(1, 1, 33, 49, dtype=DOUBLE)))[0, 0]
    y, x = torch.meshgrid(torch.tensor([0, 8, 16, 32]), torch.tensor([0, 16, 24, 48]), indexing="ij")
    field = torch.stack([x - 24, y - 16], -1).view(-1, 2) * (24 * um / float(lens.sensor_distance))
    expected = lens.relative_illumination(field).view(4, 4)
    assert float((light[y, x] / expected - 1).abs().max()) < 2e-3


def test_a_small_picture_about_the_axis_is_that_of_one_psf() -> None:
    lens, light = lens_of(focal_length=8 * mm), Draw(1).noise(1, 1, 16, 16).double()
    varied, alone = (
        optics.Imaging(lens, pixel_pitch=2 * um, field=field, psf_shape=(15, 15), border="zero")
        for field in (True, None)
    )
    assert varied.varies
    assert not alone.varies
    assert float((varied(scene_of(light)) - alone(scene_of(light))).abs().max()) < 1e-3


@pytest.mark.slow
def test_a_picture_is_that_of_one_psf_for_each_pixel() -> None:
    """60 dB, and an estimate of at least a third of the error."""
    lens = lens_of(optics.ZernikeAberration(ZERNIKES), width=0.3 * mm, focal_length=3 * mm)
    light, window = Draw(1).noise(1, 1, 12, 16).double() ** 2, (11, 11)
    imaging = optics.Imaging(lens, pixel_pitch=40 * um, field=True, border="zero", psf_shape=window)
    psfs = imaging._over_field((12, 16), torch.ones(1, dtype=DOUBLE), LINE)
    y, x = torch.meshgrid(torch.arange(12) - 5.5, torch.arange(16) - 7.5, indexing="ij")
    places = -torch.stack([x, y], -1).view(-1, 2).double() * 40 * um
    bank = psfs.bank(places, imaging.pixels(window, light))[:, 0, 0].flip(-2, -1).view(12, 16, *window)
    truth = torch.zeros(22, 26, dtype=DOUBLE)
    for row in range(12):
        for column in range(16):
            truth[row : row + 11, column : column + 11] += bank[row, column] * light[0, 0, row, column]
    truth = truth[5:-5, 5:-5]
    off = float((imaging(scene_of(light))[0, 0] - truth).square().mean().sqrt())
    assert 20 * math.log10(float(truth.max()) / off) > 60
    estimate = imaging.explain(scene_of(light))
    assert estimate.total > off / float(truth.square().mean().sqrt()) / 3


def test_a_bank_of_places_is_that_of_their_field() -> None:
    lens = lens_of()
    places = torch.tensor([[0.0, 0.8 * mm], [0.4 * mm, 0.0]], dtype=DOUBLE)
    pixels = optics.Imaging(lens, pixel_pitch=3 * um).pixels((9, 9), places)
    found = lens.bank(Points(torch.ones(2, dtype=DOUBLE), places), LINE, pixels)
    expected = seen(lens, (-places / lens.sensor_distance).tolist(), shape=(9, 9))
    assert torch.allclose(found[:, 0], expected, atol=1e-9)


def test_what_cannot_be_is_a_clear_error() -> None:
    lens = lens_of()
    for field, words in (
        ([0.0, 0.1], r"\(F, 2\)"),
        ([[0.0, math.nan]], "finite"),
        ([[0.0, 2.0]], "63.4 degrees, and thin elements are known up to 60"),
    ):
        with pytest.raises(ValueError, match=words):
            lens.image_point(LINE, distances=1.0, field=torch.tensor(field))
    for recipe in ({"propagator": "fresnel"}, {"method": "matrix"}):
        with pytest.raises(ValueError, match="leave out propagator= and method="):
            seen(lens, [[0.0, 0.1]], **recipe)
    with pytest.raises(ValueError, match="Use samples >="):
        seen(lens, [[0.0, 0.1]], samples=32, shape=(101, 101), pixel_pitch=10 * um)
    with pytest.raises(ValueError, match="more than the limit of 8192"):
        seen(lens_of(width=4.2 * mm), [[0.0, 0.1]], distance=0.003, shape=(9, 9))
    with pytest.raises(ValueError, match="over the field there is one way"):
        optics.Imaging(lens, field=True, propagator="fresnel")
    with pytest.raises(ValueError, match="the sensor reaches"):
        optics.Imaging(lens, field=True, pixel_pitch=1 * mm)(scene_of(torch.ones(1, 1, 64, 64)))
    query = lens.query(LINE, distances=1.0, pixel_pitch=3 * um, shape=(9, 9))
    with pytest.raises(ValueError, match="have positions on the sensor"):
        off_axis_psf(query)


def test_a_lens_that_trains_sharpens_a_corner() -> None:
    curvature = nn.Parameter(torch.tensor(8.0 * mm, dtype=DOUBLE))
    lens = optics.Lens(optics.CircularAperture(0.5 * mm), optics.ThinLens(8 * mm), sensor_distance=curvature)
    imaging = optics.Imaging(lens, pixel_pitch=6 * um, field=True, psf_shape=(9, 9), spacing=16, centre=(0.0, 1 * mm))
    light = torch.zeros(1, 1, 17, 17, dtype=DOUBLE)
    light[..., 8, 8] = 1
    (gradient,) = torch.autograd.grad(imaging(scene_of(light)).max(), curvature)
    assert bool(gradient.isfinite())
    assert float(gradient) < 0  # nearer, where the field curves
