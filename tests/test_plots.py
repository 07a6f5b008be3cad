"""Figures of a camera's stages and of several cameras: all is there, labelled, and as it was computed."""

from __future__ import annotations

import itertools
import re
from typing import Any

import numpy as np
import pytest
import torch
from draws import Draw
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from skimage.metrics import peak_signal_noise_ratio
from torch import Tensor, nn

from kcam import Camera, Scene, Stage, demo, isp, optics, plots, sensor
from kcam.units import mm, nm, um


class Darker(Stage):
    """Halves the light $x$. A stage of a user's own, whose docstring goes on and on, far beyond what a column holds."""

    def forward(self, signal: Tensor, context: Any = None) -> Tensor:
        return signal / 2


class Smaller(nn.Module):
    def forward(self, signal: Tensor) -> Tensor:
        return nn.functional.avg_pool2d(signal, 3)


class Mean(nn.Module):
    """No picture any more"""

    def forward(self, signal: Tensor) -> Tensor:
        return signal.mean((2, 3))


def mono() -> Camera:
    curve = sensor.ColourFilter(torch.full((1, 12), 0.5))
    adc = sensor.ADC(10, black_level=64)
    return Camera(Camera.phone()[0], curve, sensor.Exposure(), sensor.ShotNoise(full_well=2000), adc)


def own() -> Camera:
    first, last = list(Camera.phone())[:7], list(Camera.phone())[7:]
    layers = nn.Sequential(nn.Conv2d(3, 3, 1), nn.ReLU())
    return Camera(*first, Darker(), *last, layers, isp.Convolution(), isp.StyleStage(width=4), Darker())


CAMERAS = {
    "ideal": Camera.ideal,
    "thesis": Camera.thesis,
    "phone": Camera.phone,
    "phone_lens": Camera.phone_lens,
    "mono": mono,
    "own": own,
    "bands": lambda: Camera(Camera.phone()[0], Darker(), sensor.ColourFilter.rgbw(), sensor.Mosaic("rgbw")),
    "no picture": lambda: Camera(*Camera.ideal(), Mean()),
    "smaller": lambda: Camera(*Camera.ideal(), Smaller()),
    "five channels": lambda: Camera(*Camera.ideal(), nn.Conv2d(3, 5, 1)),
    "lens alone": lambda: Camera(Camera.phone()[0]),
}


def check_layout(figure: Figure) -> None:
    """Everything is inside, and nothing lies over anything else."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    boxes = [(text.get_text(), text.get_window_extent(canvas.get_renderer())) for text in figure.texts]
    boxes = [(name, box) for name, box in boxes if name.strip()]
    boxes += [("axes", axes.get_window_extent(canvas.get_renderer())) for axes in figure.axes]
    for name, box in boxes:
        assert min(box.x0, box.y0) >= 0, name
        assert box.x1 <= figure.bbox.x1, name
        assert box.y1 <= figure.bbox.y1, name
    for (name, box), (other, beside) in itertools.combinations(boxes, 2):
        across = min(box.x1, beside.x1) - max(box.x0, beside.x0)
        down = min(box.y1, beside.y1) - max(box.y0, beside.y0)
        assert across < 1.5 or down < 1.5, f"{name!r} lies over {other!r}"


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.texts]


def images(figure: Figure) -> list[np.ndarray]:
    return [axes.images[0].get_array() for axes in figure.axes if axes.images]


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)


# ---- pipeline ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name.startswith("phone") else name for name in CAMERAS]
)  # "own" has its stages and some more
def test_every_stage_of_every_camera_has_its_panel(name: str) -> None:
    camera, scene = CAMERAS[name](), Scene.builtin("motorcycle", 48)
    if name == "thesis":  # whose PSFs of many depths take long
        scene = scene.with_depth(2.0)
    figure = plots.pipeline(camera, scene, generator=seeded(), title=f"{name} costs $5 and $6")
    check_layout(figure)
    assert figure.get_figwidth() == 12.8
    said = texts(figure)
    for number, (step, _) in enumerate(camera.steps(scene), start=1):
        assert f"{number} {step}" in said
    assert {"Scene", "Picture"} < set(said)
    assert ("Depth" in said) == isinstance(scene.depth, Tensor)
    assert ("PSFs of the lens" in said) == any(isinstance(stage, optics.Imaging) for stage in camera)


def random_camera(draw: Draw) -> Camera:
    """Any stages that may follow one another."""
    imaging = draw.one_of(Camera.phone()[0], demo.singlet()[0], None)
    colour = draw.one_of(sensor.ColourFilter.nikon(), sensor.ColourFilter.kodak(), sensor.ColourFilter.learned(3))
    stages = [colour] if imaging is None else [imaging, colour]
    if not colour.is_tile:
        stages.append(draw.one_of(sensor.Mosaic("RGGB"), sensor.Mosaic("x_trans"), sensor.Mosaic("quad_bayer")))
    behind = [sensor.Exposure(), sensor.ShotNoise(full_well=800), sensor.ReadNoise(5.0), Darker()]
    behind += [sensor.ADC(8, black_level=10)]
    stages += [stage for stage in behind if draw.number(0, 1) < 0.7]
    if draw.number(0, 1) < 0.7:
        stages.append(isp.LearnedDemosaic() if colour.is_tile else isp.Demosaic(method="bilinear"))
        ending = [isp.Clip(), isp.ToneCurve(), isp.Convolution(), Darker(), Smaller()]
        stages += [stage for stage in ending if draw.number(0, 1) < 0.5]
    return Camera(*stages)


@pytest.mark.parametrize("seed", [pytest.param(n, marks=pytest.mark.slow) if n > 1 else n for n in range(12)])
def test_random_cameras_and_scenes(seed: int) -> None:
    draw = Draw(seed)
    camera = random_camera(draw)
    shape = (int(draw.number(6, 90)), int(draw.number(6, 90)))
    depth = draw.one_of(2.0, float("inf"), 1 + 5 * draw.noise(*shape))
    bands = draw.noise(3, 28, *shape).float()
    picture = draw.noise(3, *shape).float()
    scene = draw.one_of(Scene.from_rgb(picture, depth=depth), Scene.from_bands(bands, depth=depth))
    check_layout(plots.pipeline(camera, scene, generator=seeded()))


def test_the_picture_shown_is_the_one_that_the_camera_takes() -> None:
    camera, scene = Camera.phone(), Scene.builtin("coffee", 60)
    picture = camera(scene, generator=seeded())[0].permute(1, 2, 0).numpy()
    shown = [
        image for image in images(plots.pipeline(camera, scene, generator=seeded())) if image.shape == picture.shape
    ]
    assert sum(np.array_equal(image, picture) for image in shown) == 2  # large, and as that of the last stage
    np.testing.assert_allclose(shown[0], scene.to_srgb()[0].permute(1, 2, 0), atol=1e-6)


def test_of_a_batch_the_first_is_shown() -> None:
    batch = Scene.from_rgb(torch.rand(3, 3, 20, 30, generator=seeded()), depth=torch.tensor([1.0, 2.0, 3.0]))
    one = images(plots.pipeline(Camera.phone(), batch, generator=seeded()))
    other = images(plots.pipeline(Camera.phone(), batch.samples([0]), generator=seeded()))
    assert all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def test_captions_state_shape_range_and_brightening() -> None:
    """A wall of 0.25 in sRGB-linear light under an ideal exposure; half of it after a stage that halves it."""
    wall = Scene.from_rgb(torch.full((1, 12, 16), 0.5))
    camera = Camera(sensor.ColourFilter(torch.full((1, 12), 0.5)), sensor.Exposure(0.8), Darker())
    said = texts(plots.pipeline(camera, wall))
    signals = [float(signal.mean()) for _, signal in camera.steps(wall)]
    assert signals[1] == pytest.approx(0.8 * 0.214, rel=1e-2)
    assert [text for text in said if text.startswith("1 \u00d7 12 \u00d7 16")] != []
    for signal, unit in zip(signals, ("relative to white", "of full well", "of full well"), strict=True):
        assert any(re.fullmatch(rf"{signal:.3g} to [\d.]+ {unit}", text) for text in said), (signal, unit, said)
        assert f"shown \u00d7 {1 / signal:.3g}, sRGB gamma" in said


def test_a_mosaic_is_shown_in_the_colours_of_its_filters() -> None:
    camera = Camera(sensor.ColourFilter.nikon(), sensor.Mosaic("RGGB"))
    detail = images(plots.pipeline(camera, Scene.from_rgb(torch.ones(3, 40, 60))))[-1]
    reds, greens, blues = detail[::2, ::2], detail[::2, 1::2], detail[1::2, 1::2]
    if detail[0, 0].argmax() != 0:  # the detail begins on another pixel of the tile
        pytest.fail("a detail in the middle of 40 x 60 begins on an even pixel")
    for pixels, channel in ((reds, 0), (greens, 1), (blues, 2)):
        assert (pixels.argmax(-1) == channel).all()


def test_raw_is_shown_bright_and_black_is_black() -> None:
    """A gray wall at 0.3 beside black, in RGGB, above a black level: its mean over a tile was a dark quarter."""
    wall = 0.6 * (torch.arange(80) >= 40).float().expand(1, 60, 80)
    filters = (sensor.ColourFilter.nikon(), sensor.Mosaic("RGGB"), sensor.Exposure())
    camera = Camera(*filters, sensor.ADC(10, black_level=100))
    panel, _ = images(plots.pipeline(camera, Scene.from_rgb(wall)))[-2:]
    assert panel[:, 60].max() > 0.95
    assert panel[:, 20].max() == 0


def test_psfs_lie_as_in_the_picture() -> None:
    """Coma points to one side: to the same as the picture of a point of light does, which lies turned about."""
    coma = optics.ZernikeAberration(torch.tensor([0, 0, 0, 0, 0, 0, 0, 0.1e-6]))
    stop, lens = optics.CircularAperture(diameter=2 * mm), optics.ThinLens(focal_length=10 * mm)
    imaging = optics.Imaging(optics.Lens(stop, lens, coma, focus_distance=2.0), pixel_pitch=2 * um)
    camera = Camera(imaging, sensor.ColourFilter.nikon())
    point = torch.zeros(1, 61, 61)
    point[:, 30, 30] = 1
    scene = Scene.from_rgb(point, depth=2.0)
    figure = plots.pipeline(camera, scene)
    psf = images(figure)[3].sum(-1)  # of 550 nm, behind the scene, its detail and the PSF of 450 nm
    photographed = camera(scene)[0, 1].numpy()
    aside = [(np.arange(one.shape[1]) - one.shape[1] // 2) * one.sum(0) for one in (psf, photographed)]
    assert [float(one.sum()) > 0 for one in aside] in ([True, True], [False, False])
    assert abs(aside[0].sum()) > 0.1 * psf.sum()


def test_psfs_are_of_light_that_the_scene_has() -> None:
    infrared = torch.linspace(900, 1000, 5) * nm
    scene = Scene.from_bands(torch.rand(5, 20, 30), wavelengths=infrared, illuminant=torch.ones(5), depth=2.0)
    figure = plots.pipeline(Camera(Camera.phone()[0], Darker()), scene)
    check_layout(figure)
    assert {"900 nm", "950 nm", "1000 nm"} < set(texts(figure))
    assert images(figure)[0].max() > 0.9


def test_what_is_not_finite_is_counted() -> None:
    class Broken(nn.Module):
        def forward(self, signal: Tensor) -> Tensor:
            signal = signal.clone()
            signal[..., 0, :3] = float("nan")
            return signal

    figure = plots.pipeline(Camera(*Camera.ideal(), Broken()), Scene.builtin("astronaut", 20))
    assert any(text.endswith("9 not finite") for text in texts(figure))


def test_nothing_is_left_that_has_gradients() -> None:
    camera = Camera.thesis()
    plots.pipeline(camera, Scene.builtin("coffee", 30))
    assert all(parameter.grad is None for parameter in camera.parameters())


def test_pipeline_refuses_what_it_cannot_show() -> None:
    scene = Scene.builtin("coffee", 16)
    with pytest.raises(TypeError, match=r"plots.pipeline takes a Camera, got .*Imaging.*Use Camera\(Imaging\(...\)\)"):
        plots.pipeline(Camera.phone()[0], scene)
    with pytest.raises(TypeError, match=r"takes a Scene, got .*Use Scene.from_rgb\(image, depth=2.0\)"):
        plots.pipeline(Camera.phone(), torch.rand(3, 16, 16))
    with pytest.raises(ValueError, match="this one has none. Use Camera.phone"):
        plots.pipeline(Camera(), scene)
    with pytest.raises(ValueError, match="this one is empty: shape"):
        plots.pipeline(Camera.phone(), Scene.from_rgb(torch.rand(0, 3, 16, 16)))
    with pytest.raises(ValueError, match=r"zoom must be two shares 0..1 .* got \(200, 300\)"):
        plots.pipeline(Camera.phone(), scene, zoom=(200, 300))


# ---- compare -----------------------------------------------------------------------------------------------------


def numbers(figure: Figure, name: str) -> list[tuple[float, float]]:
    found = (re.fullmatch(rf"to {name}: ([\d.]+) dB, \u0394E ([\d.]+)", text) for text in texts(figure))
    return [(float(match[1]), float(match[2])) for match in found if match]


@pytest.mark.parametrize("count", [1, 2, *(pytest.param(n, marks=pytest.mark.slow) for n in (3, 5))])
def test_compare_shows_all_cameras(count: int) -> None:
    names = ["phone", "ideal", "a name that is much too long for the column in which it shall stand", "$x^", "thesis"]
    makes = [Camera.phone, Camera.ideal, mono, Camera.phone, Camera.thesis]
    cameras = {name: make() for name, make in zip(names[:count], makes, strict=False)}
    figure = plots.compare(cameras, Scene.builtin("coffee", 64))
    check_layout(figure)
    assert figure.get_figwidth() == 12.8
    assert {"Scene", "phone"} <= set(texts(figure))
    assert len(images(figure)) == 2 + 3 * count
    assert len(numbers(figure, "scene")) == count
    assert sum(text.startswith("to phone: ") for text in texts(figure)) == count - 1


def test_the_numbers_are_psnr_and_colour_difference() -> None:
    from skimage.color import deltaE_ciede2000, rgb2lab

    scene, cameras = Scene.builtin("coffee", 64), [Camera.ideal(), Camera.phone()]
    figure = plots.compare(cameras, scene, seed=3)
    pictures = [c(scene, generator=torch.Generator().manual_seed(3))[0].permute(1, 2, 0) for c in cameras]
    ideal, phone = (picture.double().numpy() for picture in pictures)
    seen = scene.to_srgb()[0].permute(1, 2, 0).double().numpy()
    for found, (one, other) in zip(
        [*numbers(figure, "scene"), *numbers(figure, "camera 1")],
        [(ideal, seen), (phone, seen), (phone, ideal)],
        strict=True,
    ):
        expected = (
            peak_signal_noise_ratio(other, one, data_range=1),
            deltaE_ciede2000(rgb2lab(other), rgb2lab(one)).mean(),
        )
        assert found == pytest.approx(expected, abs=0.06)


def test_equal_cameras_see_the_same_noise() -> None:
    figure = plots.compare([Camera.phone(), Camera.phone()], Scene.builtin("coffee", 32))
    assert "to camera 1: equal" in texts(figure)
    grey = images(figure)[-1]
    np.testing.assert_array_equal(grey, np.full_like(grey, 0.5))


def test_another_seed_is_another_noise() -> None:
    one, other = (images(plots.compare([Camera.phone()], Scene.builtin("coffee", 32), seed=s))[2] for s in (0, 1))
    assert not np.array_equal(one, other)


def test_pictures_of_another_size_have_no_difference() -> None:
    figure = plots.compare({"ideal": Camera.ideal(), "small": CAMERAS["smaller"]()}, Scene.builtin("coffee", 60))
    check_layout(figure)
    assert "to ideal: another size" in texts(figure)
    assert any(text.startswith("no difference to ideal: 20 \u00d7 13") for text in texts(figure))


def test_compare_refuses_what_it_cannot_show() -> None:
    scene = Scene.builtin("coffee", 16)
    with pytest.raises(TypeError, match=r"a dict by name or a list of them, got one Camera. Use plots.compare\(\{"):
        plots.compare(Camera.phone(), scene)
    with pytest.raises(TypeError, match="a dict by name or a list of them, got"):
        plots.compare("phone", scene)
    with pytest.raises(ValueError, match="there is no camera to compare: got an empty dict"):
        plots.compare({}, scene)
    with pytest.raises(TypeError, match=r"plots.compare takes a Camera, got .*"):
        plots.compare([Camera.phone()[0]], scene)
    with pytest.raises(TypeError, match="plots.compare takes a Scene"):
        plots.compare([Camera.phone()], "photo.jpg")
    with pytest.raises(ValueError, match=r"five gives 1 x 5 x 11 x 16, expected a picture .* plots.pipeline shows any"):
        plots.compare({"five": CAMERAS["five channels"]()}, scene)


# ---- what they share ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(8))
def test_a_shortened_text_fits(seed: int) -> None:
    draw = Draw(seed)
    words = ["light", "W" * 9, "i" * 30, "$x$", "\u00d7", "0.001"]
    text = " ".join(draw.one_of(*words) for _ in range(int(draw.number(1, 30))))
    width = draw.number(0.5, 6)
    found = plots.shortened(text, width)
    sheet = plots.Sheet(20, 1)
    sheet.text(0, 0, found, parse_math=False)
    canvas = FigureCanvasAgg(sheet.figure)
    assert sheet.figure.texts[0].get_window_extent(canvas.get_renderer()).width <= width * sheet.figure.dpi + 1
    assert found == " ".join(text.split()) or found.endswith("\u2026")
    assert sheet.figure.texts[0].get_fontproperties() == FontProperties(size=plots.LABEL)
