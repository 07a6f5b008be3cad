from __future__ import annotations

import copy
import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from skimage.color import deltaE_ciede2000, rgb2lab
from torch import Tensor, nn

import kcam
from kcam import Camera, Context, Scene, Stage, demo, isp, optics, sensor
from kcam.camera import PRESETS
from kcam.units import mm, nm, um

GENERATOR_SEED = 3


class Probe(Stage):
    """Passes the signal on, and remembers what it was told."""

    def __init__(self, pattern: str | None = None, full_well: float | None = None) -> None:
        super().__init__()
        self.pattern = pattern
        self.full_well = full_well
        self.context: Context | None = None

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        self.context = context
        return signal

    def provides(self) -> dict[str, Any]:
        return {name: value for name in ("pattern", "full_well") if (value := getattr(self, name)) is not None}


class Noise(Stage):
    def __init__(self, weight: nn.Parameter) -> None:
        super().__init__()
        self.weight = weight

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        generator = (context or Context()).generator
        return signal * self.weight + torch.randn(signal.shape, generator=generator)

    def mean(self) -> nn.Module:
        return Gain(self.weight)


class Gain(Stage):
    def __init__(self, weight: nn.Parameter) -> None:
        super().__init__()
        self.weight = weight

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        return signal * self.weight


REAL = ("phone_lens", "slr")  # seconds to trace and fit
SOME = [pytest.param(name, marks=pytest.mark.slow) if name in REAL else name for name in PRESETS]


def rgb_scene(height: int = 24, width: int = 32, **arguments: Any) -> Scene:
    g = torch.Generator().manual_seed(1)
    return Scene.from_rgb(torch.rand(3, height, width, generator=g), **arguments)


FEW = torch.linspace(430, 690, 5, dtype=torch.float64) * nm
"""Wavelengths enough for a test: the thesis's camera computes a PSF of 297 x 297 for each."""


def lens() -> optics.Lens:
    return optics.Lens(
        optics.CircularAperture(diameter=2 * mm), optics.ThinLens(focal_length=20 * mm), focus_distance=2.0
    )


def full_camera() -> Camera:
    return Camera(
        optics.Imaging(lens(), pixel_pitch=4 * um, psf_shape=(15, 15)),
        sensor.ColourFilter.kodak(),
        sensor.Mosaic("GRBG"),
        sensor.Exposure(),
        sensor.ShotNoise(full_well=5_000),
        sensor.ReadNoise(3.0),
        sensor.ADC(bits=12),
        isp.Demosaic(),
        isp.WhiteBalance(),
        isp.ColourMatrix(),
        isp.ToneCurve(),
    )


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(GENERATOR_SEED)


def test_stages_know_their_neighbours_and_the_scene() -> None:
    probe = Probe()
    camera = Camera(probe, Probe(pattern="GRBG"), Probe(full_well=123.0))
    scene = rgb_scene(illuminant="A", luminance=77.0)
    g = seeded()
    camera(scene, generator=g)
    told = probe.context
    assert told is not None
    assert (told.pattern, told.full_well, told.luminance, told.generator) == ("GRBG", 123.0, 77.0, g)
    assert torch.equal(told.wavelengths, scene.wavelengths)
    assert told.illuminant is not None
    assert torch.equal(told.illuminant, scene.illuminant)
    camera(torch.zeros(1, 28, 4, 4))
    told = probe.context
    assert told is not None
    assert (told.illuminant, told.luminance, told.generator) == (None, 1000.0, None)


def test_context_holds_where_no_stage_speaks() -> None:
    probe = Probe()
    camera = Camera(probe, Probe(pattern="BGGR"), context=Context(pattern="RGGB", luminance=5.0))
    camera(torch.zeros(1, 28, 4, 4))
    assert probe.context is not None
    assert (probe.context.pattern, probe.context.luminance) == ("BGGR", 5.0)


def test_contradiction() -> None:
    Camera(Probe(full_well=5.0), Probe(full_well=5))
    with pytest.raises(ValueError, match=r"contradict.*Probe \(stage 0\) has full_well = 5.0, Probe \(stage 2\).* 6.0"):
        Camera(Probe(full_well=5.0), Probe(), Probe(full_well=6.0))
    with pytest.raises(ValueError, match=r"ShotNoise \(stage 0\) has full_well = 5000.*ReadNoise \(stage 1\).*9000"):
        Camera(sensor.ShotNoise(full_well=5000), sensor.ReadNoise(3.0, full_well=9000))


def test_contradiction_that_comes_later() -> None:
    camera = Camera(Probe(full_well=5.0), Probe(full_well=5.0))
    camera[1].full_well = 7.0
    with pytest.raises(ValueError, match="two stages contradict each other"):
        camera(torch.zeros(1, 28, 4, 4))


def test_bad_stages() -> None:
    with pytest.raises(TypeError, match=r"stage 1 of the camera is .*tanh.*not an nn.Module"):
        Camera(Probe(), torch.tanh)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"stage 0 of the camera.*Call it: Probe\(\.\.\.\)"):
        Camera(Probe)  # type: ignore[arg-type]


def test_bad_order() -> None:
    with pytest.raises(ValueError, match="Mosaic stands after Demosaic, but light passes it first"):
        Camera(isp.Demosaic(), sensor.Mosaic())
    with pytest.raises(ValueError, match="two Mosaic stages"):
        Camera(sensor.Mosaic(), Probe(), sensor.Mosaic())
    with pytest.raises(ValueError, match="Imaging stands after ColourFilter"):
        Camera(sensor.ColourFilter.kodak(), optics.Imaging(lens(), pixel_pitch=4 * um))


RAW_STAGES = (
    sensor.RowColumnNoise(),
    sensor.DefectPixels(),
    sensor.DarkCurrent(1.0, time=0.01),
    sensor.Nonlinearity(),
    sensor.MicrolensShading(pupil_distance=5 * mm),
    sensor.Crosstalk(),
    sensor.ReadNoise(1.0),
)
FINISHING = (isp.JPEG(), isp.Sharpen(), isp.LocalToneMapping(), isp.Denoise())


def named(stage: nn.Module) -> str:
    return type(stage).__name__


@pytest.mark.parametrize("stage", RAW_STAGES, ids=named)
def test_what_pixels_do_stands_between_the_filter_and_the_demosaic(stage: nn.Module) -> None:
    name, stages, ideal = named(stage), [*full_camera()], [*Camera.ideal()]
    with pytest.raises(ValueError, match=f"{name} stands before ColourFilter, which takes bands. Move it behind Col"):
        Camera(stages[0], stage, *stages[1:])
    with pytest.raises(ValueError, match=f"{name} stands before .*which takes a scene. Move it behind"):
        Camera(stage, stages[0])
    for place, there in ((8, "Demosaic"), (len(stages), "Demosaic")):
        with pytest.raises(ValueError, match=f"{name} stands after {there}, .*raw signal has ended. Move it before"):
            Camera(*stages[:place], stage, *stages[place:])
    with pytest.raises(ValueError, match=f"{name} stands after ToneCurve"):
        Camera(ideal[0], ideal[-1], stage)
    for place in (2, 3, 6):
        Camera(*stages[:place], stage, *stages[place:])
    assert Camera(stage)(torch.full((1, 1, 6, 6), 0.5)).shape == (1, 1, 6, 6)


@pytest.mark.parametrize("stage", FINISHING, ids=named)
def test_what_finishes_a_picture_stands_behind_its_demosaic(stage: nn.Module) -> None:
    name, stages = named(stage), [*full_camera()]
    for place in (1, 2, 4, 7):
        with pytest.raises(ValueError, match=f"{name} stands before Demosaic, which takes a mosaic. Move it behind"):
            Camera(*stages[:place], stage, *stages[place:])
    for raw in (stages[:7], [sensor.ColourFilter.learned(tile=4), isp.Clip()]):
        with pytest.raises(ValueError, match=f"{name} stands on a mosaic.* Put isp.Demosaic\\(\\) before"):
            Camera(*raw, stage)
    Camera(*stages[:7], nn.Identity(), stage)  # which may be a demosaic of the user's
    for kept in (stages[:8], [*Camera.ideal()][:2], monochrome()):
        assert Camera(*kept, stage)(rgb_scene(16, 16)).shape[-2:] == (16, 16)
    with pytest.raises(ValueError, match=f"{name} stands before ADC, which takes the sensor's signal"):
        Camera(*monochrome()[:-1], stage, monochrome()[-1])


def test_glare_stands_before_the_mosaic() -> None:
    stages, glare = [*full_camera()], optics.VeilingGlare(focal_length=8 * mm)
    for place, there in ((3, "Mosaic.*one colour each"), (len(stages), "Mosaic")):
        with pytest.raises(ValueError, match=f"VeilingGlare stands after {there}.* Move it before"):
            Camera(*stages[:place], glare, *stages[place:])
    with pytest.raises(ValueError, match="VeilingGlare stands after WhiteBalance"):
        Camera(*Camera.ideal(), glare)
    for place in (1, 2):
        Camera(*stages[:place], glare, *stages[place:])


def monochrome() -> list[nn.Module]:
    curve = sensor.ColourFilter.from_curves(torch.tensor([400.0, 700.0]) * nm, torch.tensor([[0.6, 0.6]]))
    return [curve, sensor.Exposure(), sensor.ShotNoise(full_well=5_000), sensor.ADC(bits=12)]


@pytest.mark.parametrize("stage", [isp.Demosaic(), isp.LearnedDemosaic(), sensor.Mosaic()], ids=named)
def test_a_monochrome_camera_needs_no_mosaic(stage: nn.Module) -> None:
    place = 1 if isinstance(stage, sensor.Mosaic) else 4
    with pytest.raises(ValueError, match=f"monochrome camera needs no {named(stage)}: .*Leave {named(stage)} out"):
        Camera(*monochrome()[:place], stage, *monochrome()[place:])


@pytest.mark.parametrize("scene", ["photo.jpg", None, torch.zeros(1, 3, 4, 4).numpy()])
def test_no_scene(scene: Any) -> None:
    with pytest.raises(TypeError, match=r"a camera takes a Scene or a tensor \(B,L,H,W\), got .*Scene.from_rgb"):
        Camera(Probe())(scene)


def test_no_generator() -> None:
    with pytest.raises(TypeError, match=r"generator must be a torch.Generator, got 3. Use torch.Generator\("):
        Camera(Probe())(torch.zeros(1, 28, 4, 4), generator=3)  # type: ignore[arg-type]


def test_a_camera_prints_its_values() -> None:
    text = str(Camera.phone())
    for part in ("ThinLens(focal_length=0.0043)", "ReadNoise(sigma_electrons=2)", "ADC(bits=10, black_level=64"):
        assert part in text
    assert "ShotNoise(full_well=(2, 1, 1, 1))" in str(sensor.ShotNoise(torch.ones(2, 1, 1, 1)))
    assert str(Probe()) == "Probe()"


def test_sequence() -> None:
    camera = full_camera()
    assert len(camera) == 11
    assert [type(stage) for stage in camera][:3] == [optics.Imaging, sensor.ColourFilter, sensor.Mosaic]
    assert isinstance(camera[2], sensor.Mosaic)
    assert isinstance(camera[-1], isp.ToneCurve)
    assert isinstance(camera[:4], Camera)
    assert camera[:4][1] is camera[1]


def test_steps_raw_and_slices_agree() -> None:
    camera, scene = full_camera(), rgb_scene()
    names, signals = zip(*camera.steps(scene, generator=seeded()), strict=True)
    assert names[:2] == ("Imaging + ColourFilter", "Mosaic")
    assert len(names) == len(camera) - 1
    assert torch.equal(signals[-1], camera(scene, generator=seeded()))
    assert torch.equal(signals[5], camera.raw(scene, generator=seeded()))
    for cut in (2, 3, 5, 7, 9):
        g = seeded()
        assert torch.equal(signals[-1], camera[cut:](camera[:cut](scene, generator=g), generator=g)), cut


def test_the_raw_of_a_camera_without_a_demosaic_ends_before_it_is_developed() -> None:
    ideal, scene = Camera.ideal(), rgb_scene()
    assert torch.equal(ideal.raw(scene), ideal[:2](scene))
    bare = Camera(sensor.ColourFilter.kodak(), sensor.Mosaic("RGGB"))
    assert torch.equal(bare.raw(scene), bare(scene))


def test_absorbed_filter_gives_the_staged_result() -> None:
    camera, scene = full_camera(), rgb_scene(40, 40)
    fused = camera[:2](scene)
    staged = camera[1](camera[0](scene, camera.resolve(scene)), camera.resolve(scene))
    assert fused.shape == (1, 3, 40, 40)
    torch.testing.assert_close(fused, staged, rtol=1e-5, atol=1e-5 * float(staged.max()))


def test_scene_and_its_bands_are_the_same_without_optics() -> None:
    camera, scene = full_camera()[1:].noiseless(), rgb_scene()
    torch.testing.assert_close(camera(scene), camera(scene.bands()))
    assert torch.equal(camera[:0](scene), scene.bands())


def test_plain_modules_get_the_signal() -> None:
    camera = Camera(sensor.ColourFilter.kodak(), nn.AvgPool2d(2), nn.Conv2d(3, 1, 1))
    assert camera(rgb_scene(24, 32)).shape == (1, 1, 12, 16)


def test_generator_decides_the_noise() -> None:
    camera, scene = full_camera(), rgb_scene()
    first, second = camera(scene, generator=seeded()), camera(scene, generator=seeded())
    assert torch.equal(first, second)
    torch.manual_seed(0)
    third = camera(scene)
    torch.manual_seed(0)
    assert torch.equal(third, camera(scene))
    assert not torch.equal(first, third)


def test_noiseless_shares_parameters() -> None:
    weight = nn.Parameter(torch.tensor(2.0))
    camera = Camera(Noise(weight))
    quiet = camera.noiseless()
    assert list(quiet.parameters()) == [weight]
    assert torch.equal(quiet(torch.ones(1, 1, 2, 2)), torch.full((1, 1, 2, 2), 2.0))
    full = full_camera()
    scene = rgb_scene()
    assert torch.equal(full.noiseless()(scene), full.noiseless()(scene))
    difference = full.raw(scene, generator=seeded()) - full.noiseless().raw(scene)
    assert 0 < float(difference.abs().mean()) < 0.02
    assert abs(float(difference.mean())) < 2e-3


def test_copies_are_independent() -> None:
    camera = full_camera()
    other = copy.deepcopy(camera)[:5]
    assert other.context is not None
    assert other.context.lens is other[0].lens
    assert other[0].lens is not camera[0].lens


@pytest.mark.parametrize("name", SOME)
def test_presets_are_deterministic(name: str) -> None:
    state = torch.random.get_rng_state()
    one, two = Camera.preset(name), Camera.preset(name)
    assert torch.equal(state, torch.random.get_rng_state())
    for (key, a), (other, b) in zip(one.state_dict().items(), two.state_dict().items(), strict=True):
        assert key == other
        assert torch.equal(a, b)


@pytest.mark.parametrize("name", SOME)
def test_presets_take_pictures(name: str) -> None:
    picture = Camera.preset(name)(rgb_scene(30, 41, wavelengths=FEW), generator=seeded()).detach()
    assert picture.shape == (1, 3, 30, 41)
    assert picture.isfinite().all()
    assert 0 <= float(picture.min()) < float(picture.max()) <= 1


@pytest.mark.parametrize("name", ["ideal", "phone"])
def test_white_is_white(name: str) -> None:
    scene = Scene.from_rgb(torch.ones(3, 48, 48) * 0.9)
    picture = Camera.preset(name).noiseless()(scene)[0, :, 16:-16, 16:-16]
    torch.testing.assert_close(picture, torch.full_like(picture, 0.9), rtol=0, atol=0.01)


def test_the_ideal_camera_sees_the_scene() -> None:
    image = torch.rand(3, 24, 24, generator=seeded()) * 0.6 + 0.2
    picture = Camera.ideal()(Scene.from_rgb(image))[0]
    assert float((picture - image).abs().mean()) < 0.03


@pytest.mark.parametrize("name", SOME)
def test_save_and_load(name: str, tmp_path: Path) -> None:
    camera, path = Camera.preset(name), tmp_path / "camera.safetensors"
    with torch.no_grad():
        for index, parameter in enumerate(camera.parameters()):
            parameter.add_(0.01 * torch.rand(parameter.shape, generator=seeded()))
            parameter.requires_grad_(index % 2 == 0)
    camera.save(path)
    state = torch.random.get_rng_state()
    other = Camera.load(path)
    assert torch.equal(state, torch.random.get_rng_state())
    assert [p.requires_grad for p in other.parameters()] == [p.requires_grad for p in camera.parameters()]
    assert other.state_dict().keys() == camera.state_dict().keys()
    scene = rgb_scene(20, 24, depth=3.0, wavelengths=FEW)
    assert torch.equal(camera(scene, generator=seeded()), other(scene, generator=seeded()))


def test_save_slices_and_noiseless(tmp_path: Path) -> None:
    path, camera, scene = tmp_path / "camera.safetensors", full_camera(), rgb_scene()
    for part, signal in ((camera[:4], scene), (camera[7:], camera.raw(scene)), (camera.noiseless(), scene)):
        part.save(path)
        assert torch.equal(Camera.load(path)(signal), part(signal))


def test_custom_stage(tmp_path: Path) -> None:
    path = tmp_path / "camera.safetensors"
    Camera(Probe(pattern="BGGR"), Gain(nn.Parameter(torch.tensor(3.0)))).save(path)
    with pytest.raises(ValueError, match=r"needs the class 'Probe'.*custom=\[Probe\]"):
        Camera.load(path)
    camera = Camera.load(path, custom=[Probe, Gain])
    assert camera[0].pattern == "BGGR"
    assert camera[1].weight.item() == 3.0


@pytest.mark.parametrize("name", ["painter", "painter.safetensors"])
def test_a_training_that_was_stopped_is_no_camera_yet(name: str, tmp_path: Path) -> None:
    (tmp_path / "painter" / "checkpoints").mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match=f"{name} is no camera yet: its training was stopped. Go on with"):
        Camera.load(tmp_path / name)


def test_load_something_else(tmp_path: Path) -> None:
    path = tmp_path / "lens.safetensors"
    kcam.camera.files.save(lens(), path, classes=kcam.camera._classes(), version="0")
    with pytest.raises(ValueError, match="holds a Lens, not a Camera"):
        Camera.load(path)


def test_the_ideal_camera_has_its_filters_colours() -> None:
    """What README says of it: 2.2 on coffee (2.15 at this size), nothing on gray."""
    scene, gray = Scene.builtin("coffee", size=96), Scene.from_rgb(torch.full((3, 4, 4), 0.5))
    with torch.no_grad():
        picture, flat = Camera.ideal()(scene), Camera.ideal()(gray)
    lab = [rgb2lab(image[0].permute(1, 2, 0).double().numpy()) for image in (scene.to_srgb(), picture)]
    assert 1.9 < deltaE_ciede2000(*lab).mean() < 2.5
    assert flat.amax() - flat.amin() < 1e-3  # rounding of the fitted matrix, a quarter of a step of 8 bits


def test_the_thesis_starts_without_colour_but_a_cast_of_lilac() -> None:
    scene = Scene.from_rgb(torch.full((3, 56, 56), 0.5), wavelengths=FEW)
    with torch.no_grad():
        red, green, blue = Camera.thesis()(scene)[0].mean((-2, -1)).tolist()
    assert blue > red > green
    assert blue - green < 0.1  # measured 0.03: a cast, no colour


def test_unknown_preset() -> None:
    with pytest.raises(ValueError, match="unknown preset 'pinhole'. There are: thesis, ideal, phone"):
        Camera.preset("pinhole")


def test_resolved_context_is_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        full_camera().resolve().pattern = "RGGB"  # type: ignore[misc]


def test_float64_scene_gives_float64_picture() -> None:
    camera, scene = full_camera(), rgb_scene().to(dtype=torch.float64)
    assert camera(scene, generator=seeded()).dtype == torch.float64


def test_gradient_reaches_the_lens() -> None:
    radius = nn.Parameter(torch.tensor(25.8 * mm, dtype=torch.float64))
    glass = optics.PlanoConvexLens(radius_of_curvature=radius, glass="N-BK7")
    stages = [*full_camera()][1:]
    camera = Camera(
        optics.Imaging(
            optics.Lens(optics.CircularAperture(diameter=2 * mm), glass, focus_distance=2.0),
            pixel_pitch=4 * um,
            psf_shape=(15, 15),
        ),
        *stages,
    )
    camera(rgb_scene(), generator=seeded()).square().mean().backward()
    assert radius.grad is not None
    assert radius.grad.isfinite()
    assert float(radius.grad) != 0


def test_other_wavelengths() -> None:
    wavelengths = torch.tensor([450.0, 530.0, 610.0]) * nm
    scene = Scene.from_bands(torch.rand(1, 3, 16, 16, generator=seeded()), wavelengths=wavelengths)
    assert full_camera()(scene).shape == (1, 3, 16, 16)


@pytest.mark.parametrize(("size", "percent"), [(64, 0.8), (128, 0.4)])
def test_white_is_dark_by_the_light_outside_a_small_picture(size: int, percent: float) -> None:
    """A PSF is no wider than the picture: the README's numbers, mean over bands and pixels."""
    white = Scene.from_rgb(torch.ones(3, size, size), depth=2.0)
    loss = 1 - demo.singlet()[0](white).mean() / white.bands().mean()
    assert 100 * float(loss) == pytest.approx(percent, abs=0.05)
