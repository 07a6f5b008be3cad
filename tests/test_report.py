"""The contact sheet, the loss curve and the closing page of a training run."""

from __future__ import annotations

import base64
import io
import re
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from kcam import Camera, Scene, isp, optics, plots, report, sensor
from kcam.style.presets import style_camera
from kcam.units import mm, nm, um

STYLE = torch.rand(3, 60, 80, generator=torch.Generator().manual_seed(3))
SCENES = [Scene.builtin("astronaut", (32, 40)), Scene.builtin("colour_chart", (32, 40))]
LENS = {"DOE phase", "450 nm", "550 nm", "650 nm"}
CAMERAS: dict[str, tuple[Any, set[str]]] = {
    "style": (style_camera, LENS | {"Camera and style stage", "Filter curves", "3 x 3 weights"}),
    "no stage": (lambda: style_camera(stage=False), LENS | {"Filter curves", "3 x 3 weights"}),
    "thesis": (Camera.thesis, LENS | {"Filter tile", "Mean curve", "3 x 3 weights"}),
    "phone": (Camera.phone, LENS - {"DOE phase"} | {"Filter curves"}),
    "ideal": (Camera.ideal, {"Filter curves"}),
}
EVERY_PANEL = set().union(*(panels for _, panels in CAMERAS.values()))


def texts(figure: Figure) -> set[str]:
    return {text.get_text() for text in figure.texts} - {""}


def boxes(figure: Figure) -> tuple[list[Any], list[Any]]:
    """Where texts stand, those of axes too, and where axes do, in pixels."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # the label of an axis finds its place below the ticks only then
    renderer = canvas.get_renderer()
    written = [text for text in figure.texts if text.get_text()]
    for axes in figure.axes:
        low, high = axes.get_xlim()
        ticks = [t for t, x in zip(axes.get_xticklabels(), axes.get_xticks(), strict=True) if low <= x <= high]
        written += [t for t in (*axes.texts, axes.xaxis.label, *ticks) if t.get_text()]
    return [text.get_window_extent(renderer) for text in written], [axes.bbox for axes in figure.axes]


def disturbed(camera: Camera) -> Camera:
    """With a style stage that changes the picture."""
    with torch.no_grad():
        for stage in camera:
            if isinstance(stage, isp.StyleStage):
                stage.leave.weight += 0.05 * torch.randn(
                    stage.leave.weight.shape, generator=torch.Generator().manual_seed(1)
                )
    return camera


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name == "no stage" else name for name in CAMERAS]
)
def test_a_sheet_has_the_panels_that_its_camera_has_and_nothing_overlaps(name: str) -> None:
    make, panels = CAMERAS[name]
    figure = report.style_sheet(make(), style=STYLE, scenes=SCENES, step=7, start=make())
    assert texts(figure) & EVERY_PANEL == panels
    assert {"After step 7", "Style", "Scene", "Camera alone"} <= texts(figure)
    columns = 4 if "Camera and style stage" in panels else 3
    below = len(panels - {"Camera and style stage"})
    assert len(figure.axes) == columns * len(SCENES) + below
    written, drawn = boxes(figure)
    assert not [pair for pair in combinations(drawn, 2) if pair[0].overlaps(pair[1])]
    assert not [pair for pair in combinations(written, 2) if pair[0].overlaps(pair[1])]
    pictures = [axes.bbox for axes in figure.axes if axes.images]
    assert not [text for text in written if any(text.overlaps(picture) for picture in pictures)]
    assert all(figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1 for box in (*written, *drawn))
    assert all(figure.bbox.y0 <= box.y0 and box.y1 <= figure.bbox.y1 for box in (*written, *drawn))
    assert len(plots.figure_bytes(figure, resolution=30)) > 1000  # it draws, and warnings are errors


def test_each_picture_stands_in_its_column() -> None:
    camera = disturbed(style_camera())
    figure = report.style_sheet(camera, style=STYLE, scenes=SCENES, seed=5)
    shown = [np.asarray(axes.images[0].get_array()) for axes in figure.axes if axes.images]
    for row, scene in enumerate(SCENES):
        style, seen, alone, both = shown[4 * row : 4 * row + 4]
        expected = STYLE if row == 0 else None
        assert style.shape == ((60, 80, 3) if row == 0 else (32, 40, 3))  # whole, then at the pictures' scale
        assert expected is None or np.array_equal(style, plots.as_image(expected))
        assert np.array_equal(seen, plots.as_image(scene.to_srgb()[0]))
        with torch.no_grad():
            whole = camera(scene, generator=torch.Generator().manual_seed(5))
            before = camera[:-1](scene, generator=torch.Generator().manual_seed(5))
        assert np.array_equal(both, plots.as_image(whole[0]))
        assert np.array_equal(alone, plots.as_image(before[0]))
        assert np.abs(both - alone).mean() > 0.01  # the stage that was disturbed paints


def test_a_sheet_takes_scenes_of_any_kind_and_leaves_the_random_state_alone() -> None:
    camera, state = style_camera(), torch.get_rng_state()
    batch = Scene.from_rgb(torch.rand(2, 3, 24, 40, generator=torch.Generator().manual_seed(0)))
    deep = Scene.builtin("motorcycle", (40, 24))
    figure = report.style_sheet(camera, style=STYLE[:, :20, :20], scenes=[batch, deep])
    assert torch.equal(torch.get_rng_state(), state)
    assert "The camera" in texts(figure)
    shown = [axes for axes in figure.axes if axes.images]
    shapes = [axes.images[0].get_array().shape[:2] for axes in shown[:8]]
    assert shapes == [(20, 20), *[(24, 40)] * 3, (20, 20), *[(40, 24)] * 3]
    ratios = [axes.bbox.width / axes.bbox.height for axes in shown[:8]]
    assert ratios == pytest.approx([width / height for height, width in shapes])  # nothing is stretched
    assert shown[4].bbox.width / 20 == pytest.approx(shown[5].bbox.width / 24)  # pixels of the style and of the scene


def test_no_scene_and_no_picture_say_so() -> None:
    with pytest.raises(ValueError, match="at least one scene"):
        report.style_sheet(Camera.ideal(), style=STYLE, scenes=[])
    with pytest.raises(ValueError, match=r"use picture\[0\]"):
        report.style_sheet(Camera.ideal(), style=STYLE[None], scenes=SCENES[:1])


def lens_of(element: optics.Element) -> optics.Lens:
    aperture = optics.CircularAperture(diameter=2 * mm)
    return optics.Lens(aperture, optics.ThinLens(focal_length=20 * mm), element, focus_distance=2.0)


def test_phase_maps_of_all_diffractive_elements_agree_on_a_defocus() -> None:
    """rho^2 as a pixel map, along the radius, and as Noll's 4, sqrt(3) (2 rho^2 - 1): the same about their means."""
    axis = (torch.arange(255, dtype=torch.float64) + 0.5) * 2 / 255 - 1
    rho2 = axis.square() + axis[:, None].square()
    elements = (
        optics.DOE(3.0 * rho2),
        optics.RadialDOE(3.0 * torch.linspace(0, 1, 200, dtype=torch.float64) ** 2),
        optics.ZernikeDOE(torch.tensor([0.0, 0, 0, 3.0 / (2 * 3**0.5)], dtype=torch.float64)),
    )
    maps = [report._doe_phase(lens_of(element)) for element in elements]
    for phase in maps:
        assert phase is not None
        assert np.array_equal(np.isnan(phase), (rho2 > 1).numpy())  # nothing is shown outside the aperture
        assert np.nanmax(np.abs(phase - maps[0])) < 1e-3  # the cubic through 200 radii errs by less
    assert np.nanmin(maps[0]) == pytest.approx(-1.5, abs=0.02)  # rho^2 has its mean at half of it


def test_a_doe_larger_than_the_aperture_shows_the_part_that_light_passes() -> None:
    phase = report._doe_phase(lens_of(optics.DOE(torch.zeros(40, 40), pitch=100 * um)))  # 4 mm behind 2 mm
    assert phase is not None
    assert np.isfinite(phase).mean() == pytest.approx(np.pi / 16, rel=0.03)  # pixels at the rim count whole or not


def test_a_kernel_is_shown_from_its_inputs_to_its_outputs() -> None:
    weight = torch.zeros(3, 3, 3, 3)
    weight[0, 2, 1, 1] = 2.0  # from blue to red
    weight[2, 0, 0, 0] = -2.0
    camera = Camera(sensor.ColourFilter.nikon(), isp.Convolution(weight, torch.zeros(3)))
    figure = report.style_sheet(camera, style=STYLE, scenes=SCENES[:1])
    image = np.asarray([axes for axes in figure.axes if axes.images][-1].images[0].get_array())
    assert image.shape == (11, 11, 3)  # 3 kernels of 3, and 1 between them
    red, _, blue = np.moveaxis(image, -1, 0)
    assert np.unravel_index(np.argmax(blue - red), blue.shape) == (1, 9)
    assert np.unravel_index(np.argmax(red - blue), blue.shape) == (8, 0)


def test_the_filter_at_the_start_is_dashed() -> None:
    start = style_camera(stage=False)
    camera = style_camera(stage=False)
    with torch.no_grad():
        camera[1].coefficients.mul_(0.5)
    figure = report.style_sheet(camera, style=STYLE, scenes=SCENES[:1], start=start)
    (axes,) = [axes for axes in figure.axes if axes.lines]
    dashed = [line for line in axes.lines if line.is_dashed()]
    assert (len(dashed), len(axes.lines)) == (3, 6)
    wavelengths = torch.linspace(420, 720, 151, dtype=torch.float64) * nm
    for lines, whose in ((axes.lines[:3], start), (axes.lines[3:], camera)):
        response = whose[1].response(wavelengths).detach()
        assert np.allclose([line.get_ydata() for line in lines], response)
    figure = report.style_sheet(camera, style=STYLE, scenes=SCENES[:1])
    assert [len(axes.lines) for axes in figure.axes if axes.lines] == [3]


NAMES = ("total", "style", "colour", "content")


def history(steps: int) -> torch.Tensor:
    terms = torch.rand(steps, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) + 0.1
    return torch.cat([terms.sum(1, keepdim=True), terms], dim=1)


@pytest.mark.parametrize("steps", [1, 2, 14, 15, 300])
def test_a_loss_curve_names_every_term_beside_its_end(steps: int) -> None:
    figure = report.loss_figure(history(steps), NAMES)
    (axes,) = figure.axes
    assert [text.get_text().split()[0] for text in axes.texts] == [
        name
        for _, name in sorted((float(line.get_ydata()[-1]), name) for line, name in zip(bold(axes), NAMES, strict=True))
    ]
    assert axes.get_yscale() == "log"
    assert all(tick == round(tick) for tick in axes.get_xticks())  # a step is whole
    assert axes.get_legend() is None
    written, _ = boxes(figure)
    assert not [pair for pair in combinations(written, 2) if pair[0].overlaps(pair[1])]
    assert all(box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1 for box in written)
    assert len(axes.lines) == (8 if steps >= 15 else 4)  # with a median, each step stands behind it
    plots.figure_bytes(figure, resolution=30)


def bold(axes: Any) -> list[Any]:
    return [line for line in axes.lines if line.get_linewidth() > 1]


def test_a_loss_curve_is_a_running_median() -> None:
    values = history(300)
    values[150, 0] = 1e6  # one step that a mean would show
    (axes,) = report.loss_figure(values, NAMES).axes
    line = bold(axes)[0].get_ydata()
    window = 2 * (300 // 15) + 1
    assert line[150] == pytest.approx(values[150 - window // 2 : 151 + window // 2, 0].median().item())
    assert line.max() < 4


@pytest.mark.parametrize(
    ("values", "names"),
    [
        (torch.zeros(0, 1), ()),
        (torch.zeros(0, 4), NAMES),
        (torch.zeros(3, 4), NAMES),
        (torch.full((1, 4), torch.nan), NAMES),
    ],
    ids=["nothing", "no steps", "zeros", "NaN"],
)
def test_a_loss_curve_of_nothing_says_so(values: torch.Tensor, names: tuple[str, ...]) -> None:
    figure = report.loss_figure(values, names)
    assert [text.get_text() for text in figure.axes[0].texts] == ["no steps yet"]
    plots.figure_bytes(figure, resolution=30)


def test_a_term_without_weight_and_a_lost_step_leave_the_others() -> None:
    values = history(40)
    values[:, 2] = 0.0
    values[7] = torch.nan
    figure = report.loss_figure(values, NAMES)
    assert {text.get_text().split()[0] for text in figure.axes[0].texts} == {"total", "style", "content"}
    plots.figure_bytes(figure, resolution=30)


def test_labels_keep_apart_and_inside() -> None:
    assert report._apart([0.1, 0.5, 0.9], least=0.1) == [0.1, 0.5, 0.9]
    assert report._apart([0.5, 0.5, 0.51], least=0.1) == pytest.approx([0.5, 0.6, 0.7])
    assert report._apart([0.2, 0.97, 0.98, 0.99], least=0.1) == pytest.approx([0.2, 0.8, 0.9, 1.0])
    assert report._apart([], least=0.1) == []


def figures() -> list[tuple[str, Figure]]:
    return [("The last sheet", Figure(figsize=(3, 2))), ('Loss <of> "it" & more', Figure(figsize=(2, 1)))]


def write(path: Path, **more: Any) -> str:
    arguments = {"title": "A <b>bold</b> & title", "summary": [("Style <i>", "a&b.png")], "figures": figures()}
    report.write_report(path, **(arguments | more))
    return path.read_text()


def test_a_page_holds_all_it_shows(tmp_path: Path) -> None:
    page = write(tmp_path / "report.html", advice=["step 20: <clipped>"], notes=["1 < 2 & so on"])
    assert "<title>A &lt;b&gt;bold&lt;/b&gt; &amp; title</title>" in page
    for text in ("<b>", "<i>", "<clipped>", "<of>", "a&b.png", "1 < 2"):
        assert text not in page
    for text in ("a&amp;b.png", "step 20: &lt;clipped&gt;", "1 &lt; 2 &amp; so on", "Loss &lt;of&gt; &quot;it&quot;"):
        assert text in page
    sources = re.findall(r'src="([^"]*)"', page)
    assert [source.partition(",")[0] for source in sources] == ["data:image/png;base64"] * 2
    sizes = [Image.open(io.BytesIO(base64.b64decode(source.partition(",")[2]))).size for source in sources]
    assert sizes == [(3 * 144, 2 * 144), (2 * 144, 144)]
    assert not re.search(r"https?:|//|<script|<link|@import|url\(", re.sub(r'src="[^"]*"', "", page))
    assert 'name="viewport"' in page
    assert "prefers-color-scheme:dark" in page
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]


def test_a_page_is_well_formed_and_leaves_out_what_there_is_not(tmp_path: Path) -> None:
    from html.parser import HTMLParser

    class Tags(HTMLParser):
        def __init__(self) -> None:
            super().__init__()
            self.open: list[str] = []

        def handle_starttag(self, tag: str, attrs: object) -> None:
            self.open += [tag] * (tag not in {"meta", "img"})

        def handle_endtag(self, tag: str) -> None:
            assert self.open.pop() == tag

    for more in ({}, {"advice": ["a"], "notes": ["b"]}, {"figures": [], "summary": []}):
        tags = Tags()
        page = write(tmp_path / "report.html", **more)
        tags.feed(page)
        assert tags.open == []
        assert ("<h2>Advice</h2>" in page, "<h2>Notes</h2>" in page) == ("advice" in more, "notes" in more)


def test_a_page_is_replaced_as_a_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "report.html"
    path.write_text("old")

    def full(*_: object) -> None:
        raise OSError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr("os.replace", full)
        with pytest.raises(OSError, match="full"):
            write(path)
    assert path.read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1  # nothing half written is left
    assert write(path).startswith("<!DOCTYPE html>")
    for wrong, message in (("report.txt", "must end in one of .html"), ("none/report.html", "there is no folder")):
        with pytest.raises(ValueError, match=message):
            write(tmp_path / wrong)
