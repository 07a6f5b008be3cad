"""The cameras and settings that training starts from."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from skimage.color import deltaE_ciede2000, rgb2lab
from torch import Tensor, nn

from kcam import Camera, Scene, isp, optics, sensor
from kcam.context import Context
from kcam.style import PRESETS, BuiltinScenes, painting, style_camera
from kcam.style.presets import smooth_phase
from kcam.style.settings import trained_parameters
from kcam.texture.losses import luminance
from kcam.units import mm, um

SCENES = ("coffee", "chelsea", "motorcycle")


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def ordinary_camera() -> Camera:
    """The same optics, sensor and demosaic without what learns: fixed curves, no DOE, no convolution."""
    lens = optics.Lens(
        optics.CircularAperture(diameter=5 * mm), optics.ThinLens(focal_length=50 * mm), focus_distance=2.0
    )
    return Camera(
        optics.Imaging(lens, pixel_pitch=4 * um, psf_shape=(41, 41), bands=12),
        sensor.ColourFilter.nikon(),
        sensor.Mosaic("RGGB"),
        sensor.Exposure(),
        sensor.ShotNoise(full_well=10_000),
        sensor.ReadNoise(3.0),
        sensor.ADC(bits=12),
        isp.Demosaic("bilinear"),
        isp.WhiteBalance(),
        isp.ColourMatrix(),
        isp.ToneCurve(),
    )


@pytest.fixture(scope="module")
def pictures() -> dict[str, tuple[Tensor, Tensor, Tensor]]:
    """Of each scene: itself, from the ordinary camera, and from the one that trains."""
    cameras = ordinary_camera(), style_camera().noiseless()
    found = {}
    with torch.no_grad():
        for name in SCENES:
            scene = Scene.builtin(name, 160).with_depth(2.0)
            found[name] = (scene.to_srgb(), *(camera(scene, generator=seeded()) for camera in cameras))
    return found


def lab(picture: Tensor) -> Tensor:
    return rgb2lab(picture[0].permute(1, 2, 0).double().numpy())


@pytest.mark.parametrize("name", SCENES)
def test_the_camera_starts_with_an_ordinary_picture(name: str, pictures: dict) -> None:
    scene, ordinary, picture = pictures[name]
    assert picture.shape == scene.shape
    # a DOE of 0.05 rad, curves raised by 0.01 and black raised to 0.03: measured 1.7 to 2.2 and 39 to 41 dB
    assert deltaE_ciede2000(lab(ordinary), lab(picture)).mean() < 2.5
    assert -10 * math.log10((ordinary - picture).square().mean()) > 37
    one, two = (luminance(each).flatten() for each in (scene, picture))
    assert torch.corrcoef(torch.stack([one, two]))[0, 1] > 0.95  # measured 0.97 to 0.99: upright, no negative


@pytest.mark.parametrize("level", [0.2, 0.5, 0.9])
def test_gray_stays_gray(level: float) -> None:
    """Gains and matrix are those of the curves as they start: within 2 levels of 8 bits, measured 1.6."""
    with torch.no_grad():
        picture = style_camera().noiseless()(Scene.from_rgb(torch.full((3, 96, 96), level)))
    colour = picture[0, :, 20:-20, 20:-20].mean((1, 2))  # a PSF is no wider than the picture: its rim is darker
    assert (colour - level).abs().max() < 2.5 / 255
    assert colour.max() - colour.min() < 2 / 255


def test_the_stage_is_left_out_on_demand() -> None:
    assert isinstance(style_camera()[-1], isp.StyleStage)
    assert isinstance(style_camera(stage=False)[-1], isp.ToneCurve)
    assert len(style_camera()) == len(style_camera(stage=False)) + 1


def test_cameras_start_alike_and_leave_the_random_state_alone() -> None:
    torch.manual_seed(1)
    before = torch.get_rng_state()
    one = style_camera()
    assert torch.equal(before, torch.get_rng_state())
    torch.manual_seed(2)
    for a, b in zip(one.parameters(), style_camera().parameters(), strict=True):
        assert torch.equal(a, b)


def test_the_phase_starts_smooth_and_small() -> None:
    phase = smooth_phase(64)
    assert phase.shape == (64, 64)
    assert float(phase.square().mean().sqrt()) == pytest.approx(0.05, rel=1e-5)
    assert abs(float(phase.mean())) < 0.01  # no piston: that does nothing
    # cosines of at most 3 half periods over 64 samples: neighbours differ by 3 pi / 64 of the amplitude
    assert phase.diff(dim=0).abs().max() < 3 * math.pi / 64 * phase.abs().max() * 1.5
    fine = smooth_phase(128)
    torch.testing.assert_close(nn.functional.avg_pool2d(fine[None], 2)[0], phase, atol=2e-3, rtol=0)


def gradients(camera: Camera, preset: str, size: int) -> dict[str, list[tuple[str, nn.Parameter]]]:
    """The parameters that a preset trains, with the gradient of the loss on two of its scenes."""
    scene, _ = BuiltinScenes(size).draw([0, 1], seed=0, step=0)
    picture = camera(scene, generator=seeded())
    weights = torch.randn(picture.shape, generator=seeded())
    ((picture - picture.detach().mean()) * weights).mean().backward()
    return trained_parameters(camera, PRESETS[preset].settings)


def without_effect(name: str) -> bool:
    """The bias of a convolution that a normalisation follows: it is taken off again."""
    return name.endswith("bias") and "norm" not in name and not name.endswith(("leave.bias", ".8.bias", "mix.bias"))


def test_all_that_trains_learns() -> None:
    """After the last layer of the stage, which starts at 0, has taken its first step."""
    camera = style_camera()
    with torch.no_grad():
        camera[-1].leave.weight += 0.01 * torch.randn(camera[-1].leave.weight.shape, generator=seeded())
    parts = gradients(camera, "quick", 48)
    assert list(parts) == ["optics", "filter", "demosaic", "tone", "stage"]
    names = [name for named in parts.values() for name, _ in named]
    assert names == [name for name, p in camera.named_parameters() if p.requires_grad]  # nothing is left out
    for named in parts.values():
        for name, parameter in named:
            assert parameter.grad is not None, name
            assert parameter.grad.isfinite().all(), name
            if not without_effect(name):
                assert parameter.grad.abs().max() > 0, name
    phase, curves = parts["optics"][0][1], parts["filter"][0][1]
    assert (phase.grad != 0).float().mean() > 0.7  # all within the round aperture: pi / 4 of the square
    assert (curves.grad != 0).all()


def test_the_first_step_reaches_all_but_the_inside_of_the_stage() -> None:
    camera = style_camera()
    parts = gradients(camera, "quick", 48)
    for part in ("optics", "filter", "demosaic", "tone"):
        assert all(p.grad.abs().max() > 0 for _, p in parts[part]), part
    assert {name.split(".", 2)[2] for name, p in parts["stage"] if p.grad.abs().max() > 0} == {
        "colour",
        "leave.weight",
        "leave.bias",
    }


def test_gradients_survive_black_and_overexposure() -> None:
    """Clips and the converter would stop them."""
    for level in (0.0, 1.0):
        camera = style_camera(stage=False)
        scene = Scene.from_rgb(torch.full((1, 3, 48, 48), level), depth=2.0)
        scene = dataclasses.replace(scene, coefficients=scene.coefficients * (20 if level else 1))
        (camera(scene, generator=seeded()) - 0.5).square().mean().backward()
        for name, parameter in camera.named_parameters():
            assert parameter.grad is not None, name
            assert parameter.grad.isfinite().all(), name
        if level:
            assert camera[1].coefficients.grad.abs().max() > 0


# ---- presets --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_makes_its_camera_and_its_loss(name: str) -> None:
    preset = PRESETS[name]
    parts = trained_parameters(preset.camera(), preset.settings)
    assert set(parts) == set(preset.settings.rates)  # no rate for what its camera does not have
    loss = preset.style_loss(painting("mosaic", size=64))
    assert preset.note
    assert loss.weights["content"] == preset.loss["content"]
    assert preset.style_loss(painting("mosaic", size=64), content=7.0).weights["content"] == 7.0


def test_quick_and_standard_differ_in_size_and_steps() -> None:
    quick, standard = PRESETS["quick"].settings, PRESETS["standard"].settings
    assert dataclasses.replace(quick, size=256, steps=standard.steps) == standard
    assert (quick.size, quick.batch) == (128, 2)
    assert standard.steps > quick.steps


def test_the_thesis_is_table_4_1() -> None:
    preset = PRESETS["thesis"]
    settings, camera = preset.for_scenes(1000), preset.camera()
    assert settings.batch == 2
    assert preset.epochs == 50
    assert set(settings.rates.values()) == {1e-3}
    assert settings.betas[0] == 0.5
    assert settings.size == 256
    assert settings.weight_decay == 1e-4
    assert set(settings.decayed) == set(settings.rates) == {"optics", "filter", "demosaic"}
    imaging, (phase,) = camera[0], list(camera[0].parameters())
    assert phase.shape == (891, 891)
    assert imaging.psf_shape == (297, 297)
    assert imaging.propagator == "fresnel"
    assert len(Context().wavelengths) == 28
    assert imaging.bands is None  # a PSF for each of the 28 bands
    assert camera[1].coefficients.shape == (28, 28, 12)
    assert preset.loss == {"statistic": "gram", "colour": 0.0, "content": 0.0, "l2": 300.0}


def test_the_thesis_has_a_plain_adam() -> None:
    """No warm-up, schedule, clipped gradient or averaged weights."""
    settings = PRESETS["thesis"].for_scenes(10)
    assert {settings.rate(step) for step in range(settings.steps)} == {1.0}
    assert settings.clip == math.inf
    assert settings.average == 0


@pytest.mark.parametrize(
    ("count", "changes", "steps"),
    [
        (100, {}, 50 * 50),
        (101, {}, 50 * 51),
        (1, {}, 50),
        (100, {"batch": 4}, 50 * 25),
        (100, {"steps": 7}, 7),
        (100, {"steps": 7, "batch": 4}, 7),
    ],
)
def test_epochs_are_counted_in_scenes(count: int, changes: dict, steps: int) -> None:
    settings = PRESETS["thesis"].for_scenes(count, **changes)
    assert settings.steps == steps
    assert settings.batch == changes.get("batch", 2)


def test_presets_without_epochs_keep_their_steps() -> None:
    assert PRESETS["quick"].for_scenes(10**6) == PRESETS["quick"].settings
    assert PRESETS["quick"].for_scenes(10, seed=4).seed == 4


@pytest.mark.slow
def test_the_camera_of_the_thesis_learns() -> None:
    for part, named in gradients(Camera.thesis(), "thesis", 256).items():
        for name, parameter in named:
            assert parameter.grad.isfinite().all(), name
            assert parameter.grad.abs().max() > 0, (part, name)
