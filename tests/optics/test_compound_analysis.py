"""Spots, best focus, MTF and drawings of real lenses: against closed forms, the FFT of PSFs, and Snell's law."""

from __future__ import annotations

import math
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor, nn

from kcam import optics, plots
from kcam.units import mm, nm, um

DOUBLE = torch.float64
LINE = 550 * nm
AXIS = torch.zeros(1, 2, dtype=DOUBLE)


def singlet(**changes) -> optics.CompoundLens:
    """A plano-convex lens of N-BK7 with its stop in front, which bends its field towards itself."""
    front = {"thickness": 4 * mm, "semi_diameter": 1.5 * mm, "stop": True} | changes
    return optics.CompoundLens(
        optics.Surface(**front),
        optics.Surface(thickness=3 * mm, glass="N-BK7", semi_diameter=6 * mm),
        optics.Surface(radius=-25.8 * mm, semi_diameter=6 * mm),
        focus_distance=math.inf,
    )


def perfect(reach: float, *, away: float = 0.0) -> tuple[optics.CompoundLens, float]:
    """A plano-hyperbolic lens of 40 mm, with nothing but diffraction on its axis, and the sine of its outermost ray."""
    index, radius = 1.5, 20 * mm
    lens = optics.CompoundLens(
        optics.Surface(thickness=5 * mm, glass=index, semi_diameter=reach, stop=True),
        optics.Surface(radius=-radius, conic=-(index**2)),
        sensor_distance=radius / (index - 1) + away,
    )
    # collimated within the glass, the ray leaves at its height, where z = -(root of the hyperbola)
    behind = (math.sqrt(1 + (index**2 - 1) * (reach / radius) ** 2) - 1) * radius / (index**2 - 1)
    return lens, reach / math.hypot(reach, radius / (index - 1) + behind)


def disc_mtf(relative: Tensor) -> Tensor:
    """Of a circular pupil, at frequencies relative to where it ends. Source: Goodman, Fourier Optics, 6.3.3."""
    nu = relative.clamp(0, 1)
    return 2 / math.pi * (torch.arccos(nu) - nu * torch.sqrt(1 - nu**2))


# ---- MTF -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reach", [3 * mm, 0.6 * mm])
def test_the_mtf_of_a_perfect_lens_is_that_of_a_disc(reach: float) -> None:
    lens, sine = perfect(reach)
    relative = torch.tensor([0.0, 0.02, 0.1, 0.3, 0.6, 0.9, 1.2], dtype=DOUBLE)
    found = lens.modulation(relative * 2 * sine / LINE, wavelengths=[LINE], field=AXIS)
    assert found.shape == (1, 2, 7)
    assert float((found - disc_mtf(relative)).abs().max()) < 2e-4
    pitch = LINE / (8 * sine)  # half its Nyquist frequency is where the MTF ends
    where = {"distances": math.inf, "pixel_pitch": pitch, "dtype": DOUBLE, "integrate": False}
    square = lens.mtf([LINE], shape=(64, 33), **where)
    rows, columns = ((torch.arange(n, dtype=DOUBLE) - n // 2) / n * 4 for n in (64, 33))
    expected = disc_mtf(torch.hypot(rows[:, None], columns))
    assert square.shape == (1, 1, 64, 33)
    assert float((square - expected).abs().max()) < 5e-3
    assert float(square[0, 0, 32, 16]) == 1


def test_a_stopped_down_triplet_is_limited_by_diffraction() -> None:
    lens = optics.CompoundLens.preset("cooke_triplet")
    lens.surfaces[lens.stop].semi_diameter = 0.4 * mm
    relative = torch.tensor([0.05, 0.2, 0.5, 0.8], dtype=DOUBLE)
    ends = 1 / (LINE * lens.f_number)
    found = lens.modulation(relative * ends, wavelengths=[LINE], field=AXIS)
    assert float((found - disc_mtf(relative)).abs().max()) < 3e-3


def otf_of(images: Tensor) -> Tensor:
    """FFT of images (H, W) whose origin is at index n // 2, relative to all light."""
    return torch.fft.fftshift(torch.fft.fft2(torch.fft.ifftshift(images))) / images.sum()


def test_the_mtf_off_the_axis_is_the_fft_of_the_psf() -> None:
    """And does not depend on which way the field points, but for the axes."""
    lens = optics.CompoundLens.preset("cooke_triplet", focus_distance=2.0)
    points = torch.tensor([[0.0, 0.25], [0.15, -0.2]], dtype=DOUBLE)
    where = {"distances": 2.0, "pixel_pitch": 1 * um, "dtype": DOUBLE, "field": points, "integrate": False}
    side, low = 255, slice(127 - 25, 127 + 26)
    with torch.no_grad():
        truth = torch.stack([otf_of(image).abs() for image in lens.psf([LINE], shape=(side, side), **where)[:, 0, 0]])
        found = lens.mtf([LINE], shape=(side, side), **where)[:, 0, 0]
        lines = torch.arange(1, 25, dtype=DOUBLE) / (side * um)
        cuts = lens.modulation(lines, wavelengths=[LINE], distance=2.0, field=points)
    assert float((found - truth)[:, low, low].abs().max()) < 8e-3  # the light outside the PSF's window
    assert float((found[0] - found[1])[low, low].abs().max()) > 0.3
    upright = torch.stack([truth[0, 127, 128:152], truth[0, 128:152, 127]])
    assert float((cuts[0] - upright).abs().max()) < 8e-3
    assert float((cuts[0] - cuts[1]).abs().max()) < 1e-4
    assert float((cuts[0, 0] - cuts[0, 1]).abs().max()) > 0.3
    with torch.no_grad():
        pixels = lens.mtf([LINE], shape=(side, side), **(where | {"integrate": True, "field": points[:1]}))
    assert float(pixels[0, 0, 0, 127, 177] / found[0, 127, 177]) == pytest.approx(np.sinc(50 / 255), rel=1e-6)


def test_lateral_colour_takes_contrast_along_the_meridian() -> None:
    """Two colours that land beside each other, as a sum of their PSFs in one window."""
    lens, colours = singlet(), [500 * nm, 600 * nm]
    field = torch.tensor([[0.0, 0.15]], dtype=DOUBLE)
    where = {"distances": math.inf, "pixel_pitch": 1.5 * um, "shape": (255, 255), "dtype": DOUBLE, "integrate": False}
    with torch.no_grad():
        one, two = lens.psf(colours, field=field, **where)[0, 0]
        lines = torch.arange(1, 12, dtype=DOUBLE) / (255 * 1.5 * um)
        found = lens.modulation(lines, wavelengths=colours, field=field)[0]
        alone = torch.stack([lens.modulation(lines, wavelengths=[colour], field=field)[0] for colour in colours])
    truth = otf_of(one / one.sum() + two / two.sum()).abs()
    assert float((found[0] - truth[127, 128:139]).abs().max()) < 1.2e-2  # the light outside the window
    assert float((found[1] - truth[128:139, 127]).abs().max()) < 1.2e-2
    assert float((alone.mean(0) - found)[1].max()) > 0.1


def test_modulation_has_a_gradient() -> None:
    def at(radius: Tensor | float) -> Tensor:
        lens = optics.CompoundLens(
            optics.Surface(thickness=2 * mm, semi_diameter=1.5 * mm, stop=True),
            optics.Surface(thickness=3 * mm, glass=1.6),
            optics.Surface(radius=radius),
            sensor_distance=50 * mm,
        )
        return lens.modulation([2e4], wavelengths=[LINE], field=torch.tensor([[0.0, 0.1]]))[0, :, 0]

    radius = nn.Parameter(torch.tensor(-30 * mm, dtype=DOUBLE))
    with torch.no_grad():
        slopes = (at(-30 * mm + 1e-7) - at(-30 * mm - 1e-7)) / 2e-7
    for value, slope in zip(at(radius), slopes, strict=True):
        (own,) = torch.autograd.grad(value, radius, retain_graph=True)
        assert float(own) == pytest.approx(float(slope), rel=1e-3)


@pytest.mark.parametrize("frequency", [-1.0, math.nan, math.inf])
def test_frequencies_are_positive(frequency: float) -> None:
    with pytest.raises(ValueError, match="frequencies must be finite and >= 0 cycles per metre"):
        singlet().modulation([frequency], field=AXIS)


def test_a_blur_that_takes_too_many_samples_is_refused() -> None:
    lens = optics.CompoundLens.preset("ef50", focus_distance=0.5)
    with pytest.raises(ValueError, match=r"this MTF needs \d+ pupil samples \(blur"):
        lens.mtf([LINE], distances=math.inf, pixel_pitch=4 * um, shape=(2048, 2048))
    with pytest.raises(ValueError, match=r"this MTF needs \d+ pupil samples .* Use lower frequencies"):
        lens.modulation([1e6], wavelengths=[LINE], distance=0.2, field=AXIS)


# ---- spots and focus -----------------------------------------------------------------------------------------------


def test_spots_of_a_perfect_lens_out_of_focus_are_tangents() -> None:
    """A ray at an angle u lands at away tan u, and light is even in sin u: <tan^2 u> in closed form."""
    lens, sine = perfect(6 * mm, away=50 * um)
    points, weights = lens.spots([LINE], distances=math.inf, rings=60)
    assert points.shape == (1, 1, 1 + 3 * 60 * 61, 2)
    assert weights.shape == (1, 1, 1 + 3 * 60 * 61)
    assert float(weights.sum()) == pytest.approx(1, abs=1e-12)
    square = float((weights[..., None] * points.square()).sum())
    expected = 50 * um * math.sqrt(-math.log1p(-(sine**2)) / sine**2 - 1)
    assert math.sqrt(square) == pytest.approx(expected, rel=3e-3)
    lit = points[0, 0][weights[0, 0] > 0].norm(dim=1)
    assert float(lit.max()) == pytest.approx(50 * um * sine / math.sqrt(1 - sine**2), rel=0.02)


@pytest.mark.parametrize(
    ("name", "heights"),
    [("cooke_triplet", [0.2, 0.4]), pytest.param("ef50", [0.1, 0.2, 0.4], marks=pytest.mark.slow)],
)
def test_light_in_spots_is_the_relative_illumination(name: str, heights: list[float]) -> None:
    """Counted by rays, and as an area of the fitted pupil."""
    lens = optics.CompoundLens.preset(name)
    field = torch.tensor([[0.6 * height, 0.8 * height] for height in heights], dtype=DOUBLE)
    _, weights = lens.spots([LINE], distances=math.inf, field=field, rings=24)
    expected = lens.relative_illumination(field)
    assert torch.allclose(weights.sum((1, 2, 3)), expected, rtol=2e-2)


def test_spots_turn_with_their_points_and_hold_lateral_colour() -> None:
    lens, where = singlet(), {"distances": math.inf}
    up, aside = (
        lens.spots([450 * nm, 650 * nm], field=torch.tensor([point], dtype=DOUBLE), **where)
        for point in ([0.0, 0.2], [0.12, -0.16])
    )
    assert torch.allclose(up[1], aside[1], atol=1e-12)
    turned = up[0] @ torch.tensor([[-0.8, -0.6], [0.6, -0.8]], dtype=DOUBLE)
    assert torch.allclose(turned, aside[0], atol=1e-12)
    landed = lens.image_point([450 * nm, 650 * nm, LINE], distances=math.inf, field=torch.tensor([[0.0, 0.2]]))[0, 0]
    middle = up[0][0, 0, :, 0]  # the ray in the middle is the chief ray
    assert torch.allclose(middle, landed[:2] - landed[2], atol=1e-12)
    assert float((middle[0] - middle[1]).abs().max()) > 5 * um


def rms_from_wavefront(lens: optics.CompoundLens, height: float, away: float) -> float:
    """Of the rays that the fitted pupil's slopes stand for: x = -dW / dl, a grid in direction cosines."""
    moved = optics.CompoundLens(*lens.surfaces, sensor_distance=float(lens.sensor_distance) + away)
    fitted = moved.pupils(*(torch.tensor([value], dtype=DOUBLE) for value in (LINE, 0.0, height)))
    side = torch.linspace(-1, 1, 401, dtype=DOUBLE) * float(fitted.radius[0])
    path, q = fitted.at(0, side[None, :], side[:, None] + fitted.centre[0])
    y, x = torch.gradient(path, spacing=float(side[1] - side[0]))
    inside = (q > 0).all(0)
    return float(torch.sqrt(x[inside].var() + y[inside].var()))


@pytest.mark.parametrize("height", [0.0, 0.25])
def test_the_best_focus_is_a_minimum_of_the_rms_radius(height: float) -> None:
    lens = optics.CompoundLens.preset("cooke_triplet")
    best = lens.refocus("rms", field=torch.tensor([[0.0, height]]), wavelengths=[LINE])
    with torch.no_grad():
        before, here, behind = (rms_from_wavefront(best, height, away) ** 2 for away in (-10 * um, 0.0, 10 * um))
    assert here < min(before, behind)
    vertex = 10 * um * (before - behind) / (2 * (before - 2 * here + behind))
    assert abs(vertex) < 3 * um
    assert abs(float(best.sensor_distance) - float(lens.sensor_distance)) > 50 * um


def test_refocus_brings_a_perfect_lens_back() -> None:
    lens, _ = perfect(6 * mm, away=0.3 * mm)
    best = lens.refocus(wavelengths=[LINE])
    assert float(best.sensor_distance) == pytest.approx(40 * mm, abs=1e-12)
    near = lens.refocus(wavelengths=[LINE], distance=2.0)
    assert float(near.sensor_distance) == pytest.approx(40 * mm * 2 / (2 - 40 * mm), rel=5e-3)


def test_a_simple_lens_bends_its_field_towards_itself() -> None:
    """As height squared, and by more than Petzval's surface, of radius n f: astigmatism adds to it."""
    lens, sharp = singlet(), {}
    for height in (0.0, 0.1, 0.2):
        sharp[height] = float(lens.refocus(field=torch.tensor([[0.0, height]])).sensor_distance)
    image = 0.2 * lens.focal_length()
    petzval = image**2 / (2 * 1.5168 * lens.focal_length())
    assert sharp[0.0] - sharp[0.2] > petzval
    assert sharp[0.0] - sharp[0.2] == pytest.approx(4 * (sharp[0.0] - sharp[0.1]), rel=0.1)


def test_weights_say_what_each_field_and_wavelength_counts() -> None:
    lens, colours = singlet(), [450 * nm, 650 * nm]
    field = torch.tensor([[0.0, 0.0], [0.0, 0.2]])

    def best(weights: list[list[float]] | None, **how) -> float:
        given = None if weights is None else torch.tensor(weights)
        return float(lens.refocus(wavelengths=colours, field=field, weights=given, **how).sensor_distance)

    alone = float(lens.refocus(wavelengths=colours).sensor_distance)
    blue = float(lens.refocus(wavelengths=colours[:1]).sensor_distance)
    assert best([[1, 1], [0, 0]]) == pytest.approx(alone, abs=1e-12)
    assert best([[5, 0], [0, 0]]) == pytest.approx(blue, abs=1e-12)
    assert best([[2, 2], [2, 2]]) == pytest.approx(best(None), abs=1e-12)
    assert blue < alone
    assert best(None) < best([[3, 3], [1, 1]]) < alone
    for wrong in ([[1.0, 1.0]], [[1.0, -1.0], [1.0, 1.0]], [[0.0, 0.0], [0.0, 0.0]]):
        with pytest.raises(ValueError, match=r"weights must be \(2, 2\) for fields and wavelengths"):
            best(wrong)


def test_refocus_shares_the_surfaces_and_keeps_what_trains() -> None:
    lens = optics.CompoundLens(
        optics.Surface(thickness=3 * mm, glass=1.5, semi_diameter=2 * mm, stop=True),
        optics.Surface(radius=nn.Parameter(torch.tensor(-25 * mm, dtype=DOUBLE))),
        sensor_distance=nn.Parameter(torch.tensor(45 * mm, dtype=DOUBLE)),
        focus_wavelength=600 * nm,
    )
    best = lens.refocus("rms")
    assert list(best.surfaces) == list(lens.surfaces)
    assert isinstance(best.sensor_distance, nn.Parameter)
    assert lens.sensor_distance.item() == 45 * mm
    assert best.sensor_distance.item() == pytest.approx(50 * mm, rel=0.01)
    assert best.focus_wavelength == lens.focus_wavelength
    best.image_point([LINE], distances=math.inf, field=torch.tensor([[0.0, 0.1]])).sum().backward()
    assert all(parameter.grad is not None for parameter in best.parameters())
    assert type(singlet().refocus().sensor_distance) is float


def test_bad_questions_are_refused() -> None:
    lens = singlet()
    with pytest.raises(ValueError, match="unknown criterion 'mtf'; known: rms"):
        lens.refocus("mtf")
    with pytest.raises(ValueError, match="rings >= 2 around the chief ray, got 1"):
        lens.spots([LINE], distances=math.inf, rings=1)
    with pytest.raises(ValueError, match="best focus is .* m inside the lens"):
        lens.refocus(distance=0.02)
    lens.surfaces[1].semi_diameter = 0.4 * mm
    with pytest.raises(ValueError, match="no ray of a point at 0.5"):
        lens.spots([LINE], distances=math.inf, field=torch.tensor([[0.0, 0.0], [0.0, 0.5]]))
    with pytest.raises(ValueError, match="no ray of a point passes this lens in the plane of the axis"):
        lens.paths([0.0, 0.5])


# ---- over the field ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "least"),
    [
        ("cooke_triplet", 0.2),
        pytest.param("cooke_triplet", 0.5, marks=pytest.mark.slow),
        pytest.param("ef50", 0.2, marks=pytest.mark.slow),
    ],
)
def test_the_field_ends_where_little_of_the_light_is_left(name: str, least: float) -> None:
    lens = optics.CompoundLens.preset(name)
    edge = lens.field_limit(least=least)
    assert float(lens.relative_illumination(torch.tensor([[0.0, edge]]))) == pytest.approx(least, abs=0.015)


def test_the_field_ends_where_chief_rays_are_lost() -> None:
    lens = optics.CompoundLens(
        optics.Surface(thickness=4 * mm, semi_diameter=0.2 * mm, stop=True),
        optics.Surface(radius=-4.5 * mm, thickness=8 * mm, glass=1.7),
        optics.Surface(radius=-12 * mm),
        sensor_distance=20 * mm,
    )
    edge = lens.field_limit(least=0.0)
    assert 0.1 < edge < 5
    lens.image_point([LINE], distances=math.inf, field=torch.tensor([[0.0, 0.999 * edge]]))
    with pytest.raises(ValueError, match="chief ray"):
        lens.image_point([LINE], distances=math.inf, field=torch.tensor([[0.0, 1.001 * edge]]))


def test_a_field_without_an_edge_ends_at_sixty_degrees() -> None:
    lens, _ = perfect(1 * mm)
    assert lens.field_limit() == pytest.approx(math.tan(math.pi / 3))


def test_field_curves_of_a_simple_lens() -> None:
    """A stop in front: rays off the axis are bent back to it, blue more than red; and the table says it."""
    lens = singlet()
    curves = lens.field_curves([0.0, 0.1, 0.2], wavelengths=[450 * nm, 550 * nm, 650 * nm], frequencies=[2e4])
    assert curves.mtf.shape == (3, 2, 1)
    assert (curves.lateral_colour[1:, 0] < 0).all()
    assert (curves.lateral_colour[1:, 2] > 0).all()
    assert curves.lateral_colour[:, 1].abs().max() < 1e-12
    assert torch.allclose(
        curves.image_heights, curves.heights * lens.focal_length() * (1 + curves.distortion), rtol=1e-6
    )
    assert (curves.rms_spot.diff() > 0).all()
    lines = str(curves).splitlines()
    assert len(lines) == 4
    assert "650 - 450 nm [um]" in lines[0]
    assert "MTF at 20 / mm" in lines[0]
    assert len({len(line) for line in lines}) == 1
    assert lines[1].split()[:4] == ["0.000", "0.00", "100.0", "0.00"]


# ---- drawings ------------------------------------------------------------------------------------------------------


def test_drawn_rays_obey_snell_and_end_where_points_land() -> None:
    lens = optics.CompoundLens.preset("cooke_triplet")
    indices = [float(index) for index in lens.indices(torch.tensor([LINE], dtype=DOUBLE))]
    paths = lens.paths([0.0, 0.2, 0.4], count=9).numpy()
    assert paths.shape == (3, 9, 8, 2)
    steps = np.diff(paths, axis=2)
    steps /= np.linalg.norm(steps, axis=-1, keepdims=True)
    vertex = 0.0
    for k, surface in enumerate(lens.surfaces):
        z, y = np.moveaxis(paths[:, :, k + 1], -1, 0)
        radius = float(surface.radius)
        assert np.abs(np.hypot(z - vertex - radius, y) - abs(radius)).max() < 1e-12
        normal = np.stack([radius - (z - vertex), -y], -1) / radius
        before, behind = (
            part[..., 0] * normal[..., 1] - part[..., 1] * normal[..., 0]
            for part in (steps[:, :, k], steps[:, :, k + 1])
        )
        assert np.abs(indices[k] * before - indices[k + 1] * behind).max() < 1e-9
        assert (np.abs(y) <= float(surface.semi_diameter)).all()
        vertex += float(surface.thickness)
    chief = lens.image_point([LINE], distances=math.inf, field=torch.tensor([[0.0, 0.0], [0.0, 0.2]]))[:, 0, 0, 1]
    assert paths[0, 4, -1, 1] == pytest.approx(float(chief[0]), abs=1e-9)
    assert np.abs(paths[1, :, -1, 1] - float(chief[1])).max() < 0.1 * mm


def outlines(figure: Figure, kind: str) -> dict[int, np.ndarray]:
    """What is drawn of surfaces or of glass, (P, 2) [mm], by the index of the surface."""
    found = {}
    for artist in (*figure.axes[0].lines, *figure.axes[0].patches):
        name, _, index = str(artist.get_gid()).partition(" ")
        if name == kind:
            found[int(index)] = artist.get_xydata() if hasattr(artist, "get_xydata") else artist.get_xy()
    return found


@pytest.mark.parametrize("name", ["cooke_triplet", pytest.param("ef50", marks=pytest.mark.slow)])
def test_the_section_holds_every_surface_and_piece_of_glass(name: str, tmp_path: Path) -> None:
    lens = optics.CompoundLens.preset(name)
    figure = lens.draw(tmp_path / "section.png")
    assert (tmp_path / "section.png").stat().st_size > 10_000
    surfaces, glass = outlines(figure, "surface"), outlines(figure, "glass")
    assert set(glass) == {k for k, surface in enumerate(lens.surfaces) if surface.glass is not None}
    assert set(surfaces) == {k for k in range(len(lens.surfaces)) if k in glass or k - 1 in glass}
    vertices = np.cumsum([0.0, *(float(surface.thickness) / mm for surface in lens.surfaces)])
    for k, (z, y) in ((k, points.T) for k, points in surfaces.items()):
        radius, reach = float(lens.surfaces[k].radius) / mm, float(lens.surfaces[k].semi_diameter) / mm
        assert np.abs(np.hypot(z - vertices[k] - radius, y) - abs(radius)).max() < 1e-9
        assert (y.min(), y.max()) == pytest.approx((-reach, reach))
    for k, outline in glass.items():
        assert np.array_equal(outline[0], outline[-1]), "an element is closed"
        tall = max(float(lens.surfaces[index].semi_diameter) for index in (k, k + 1)) / mm
        assert np.abs(outline[:, 1]).max() == pytest.approx(tall)
        both = {tuple(point) for index in (k, k + 1) for point in surfaces[index]}
        assert both <= {tuple(point) for point in outline}
    stops = [line for line in figure.axes[0].lines if line.get_gid() == "stop"]
    reach = float(lens.surfaces[lens.stop].semi_diameter) / mm
    assert sorted(float(line.get_ydata()[0]) for line in stops) == pytest.approx([-reach, reach])
    left, right = figure.axes[0].get_xlim()
    low, high = figure.axes[0].get_ylim()
    box = figure.axes[0].get_position()
    scale = box.width * figure.get_figwidth() / (right - left)
    assert scale == pytest.approx(box.height * figure.get_figheight() / (high - low)), "one scale along and across"


def test_a_surface_that_clips_nothing_is_drawn_as_wide_as_its_light() -> None:
    lens, _ = perfect(6 * mm)
    figure = plots.section_figure(lens, heights=[0.0, 0.1])
    back = outlines(figure, "surface")[1]
    rays = lens.paths([0.0, 0.1]).numpy()[:, :, 2, 1] / mm
    assert np.abs(back[:, 1]).max() == pytest.approx(1.02 * np.abs(rays).max())


def overlapping(figure: Figure) -> list[tuple[str, str]]:
    """Pairs of texts and panels, with their labels, that cover each other; and what leaves the figure."""
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    boxes = [(text.get_text(), text.get_window_extent(renderer)) for text in figure.texts]
    boxes += [(f"panel {index}", axes.get_tightbbox(renderer)) for index, axes in enumerate(figure.axes)]
    width, height = figure.get_size_inches() * figure.dpi
    found = [(name, "") for name, box in boxes if min(box.x0, box.y0, width - box.x1, height - box.y1) < 0]
    for (name, box), (other, beside) in combinations(boxes, 2):
        covered = min(box.x1, beside.x1) - max(box.x0, beside.x0), min(box.y1, beside.y1) - max(box.y0, beside.y0)
        if min(covered) > 1:
            found.append((name, other))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cooke_triplet", "ef50"])
def test_texts_of_a_sheet_do_not_cover_each_other(name: str) -> None:
    lens = optics.CompoundLens.preset(name)
    with torch.no_grad():
        curves = lens.field_curves([0.0, 0.2, 0.4])
        figure = plots.lens_figure(lens, curves)
    assert overlapping(figure) == []
    assert len(figure.axes) == 1 + 4 * 5


def test_a_lens_that_trains_is_drawn() -> None:
    radius = nn.Parameter(torch.tensor(-25 * mm, dtype=DOUBLE))
    lens = optics.CompoundLens(
        optics.Surface(thickness=3 * mm, glass=1.5, semi_diameter=2 * mm, stop=True),
        optics.Surface(radius=radius),
        sensor_distance=nn.Parameter(torch.tensor(49 * mm, dtype=DOUBLE)),
    )
    curves = lens.field_curves([0.0, 0.05], wavelengths=[LINE], frequencies=[1e4])
    assert curves.rms_spot.requires_grad
    figure = plots.lens_figure(lens, curves)
    assert len(figure.axes) == 21
    assert overlapping(figure) == []
    assert "focal length    50 mm" in plots.lens_text(lens)


def test_figures_of_their_own() -> None:
    lens = singlet()
    with torch.no_grad():
        spots = plots.spot_figure(lens, heights=[0.0, 0.2], wavelengths=[LINE])
        waves = plots.opd_figure(lens, heights=[0.0, 0.1, 0.2])
        field = plots.field_figure(lens, lens.field_curves([0.0, 0.1, 0.2], frequencies=[1e4]))
    assert [len(figure.axes) for figure in (spots, waves, field)] == [2, 6, 5]
    for figure in (spots, waves, field):
        assert overlapping(figure) == []
    points, weights = lens.spots([LINE], distances=math.inf, field=torch.tensor([[0.0, 0.0], [0.0, 0.2]]))
    drawn = spots.axes[1].collections[0].get_offsets()
    assert np.allclose(drawn, points[1, 0, 0][weights[1, 0, 0] > 0] / um)
    assert spots.axes[1].yaxis_inverted(), "+y is down, as on the sensor"
    with pytest.raises(ValueError, match="1 to 5 heights, got 6"):
        plots.spot_figure(lens, heights=[0.0] * 6)
