"""RandomCamera is a planned camera, planned once for each size, and its noise is that of the drawn seed."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from drawing import BANDS, augmented, picture
from torch import Tensor, nn

import kcam.augmentation as KC
from kcam import Camera, Scene, isp, optics, sensor
from kcam.planner.plan import noiseless_raw, relative_rms
from kcam.units import mm, um

SIZE = (40, 48)


def small_camera(*, focal_length: float | Tensor = 4.3 * mm) -> Camera:
    """A phone's camera with larger pixels, which is quick to plan."""
    lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(focal_length), focus_distance=2.0)
    return Camera(
        optics.Imaging(lens, pixel_pitch=3 * um),
        sensor.ColourFilter.nikon(),
        sensor.Mosaic("RGGB"),
        sensor.Exposure(),
        sensor.ShotNoise(full_well=6_000),
        sensor.ReadNoise(2.0),
        sensor.ADC(bits=10, black_level=64),
        isp.Demosaic(),
        isp.WhiteBalance(),
        isp.ColourMatrix(),
        isp.ToneCurve(),
    )


def photographs(count: int, *, channels: int = 3) -> Tensor:
    """Crops of real pictures, or cubes of them."""
    scenes = [Scene.builtin(name, SIZE) for name in ("astronaut", "chelsea", "coffee")[:count]]
    return torch.cat([scene.to_srgb() if channels == 3 else scene.bands() for scene in scenes])


def scene_of(row: Tensor, depth: float | Tensor) -> Scene:
    if row.shape[1] == 3:
        return Scene.from_rgb(row, depth=depth)
    return Scene.from_bands(row, wavelengths=BANDS, depth=depth)


@pytest.mark.parametrize("channels", [3, 28])
@pytest.mark.parametrize("tolerance", [0.02, 0])
def test_is_the_planned_camera_with_the_drawn_distance_and_seed(channels: int, tolerance: float) -> None:
    camera = small_camera()
    signal = photographs(3, channels=channels)
    augmentation = KC.RandomCamera([camera, "ideal"], tolerance, distance=(0.5, 5.0))
    result, drawn = augmented(augmentation, signal, seed=1)
    assert set(drawn["camera"].tolist()) == {0, 1}
    bands = {} if channels == 3 else {"wavelengths": BANDS}
    fixed = [Scene.builtin("coffee", SIZE, **bands).with_depth(distance) for distance in (0.5, 5.0)]
    for index in range(3):
        chosen = [camera, Camera.ideal()][int(drawn["camera"][index])]
        generator = torch.Generator().manual_seed(int(drawn["noise_seed"][index]))
        scene = scene_of(signal[index : index + 1], float(drawn["distance"][index]))
        planned = chosen.plan(fixed, tolerance=tolerance).apply(chosen)
        expected = planned(scene, generator=generator)
        assert result.shape == (3, 3, *SIZE)
        # the same plan, since planning is deterministic; its transforms are rounded to float32
        assert (result[index] - expected[0]).abs().max() < 1e-6


@pytest.mark.slow
def test_a_depth_map_takes_the_place_of_the_distance() -> None:
    camera = small_camera()
    signal = photographs(2)
    inverse = torch.linspace(0, 2, SIZE[1]).expand(2, 1, *SIZE).clone()  # infinity to 0.5 m
    augmentation = KC.RandomCamera([camera], 0, distance=(0.5, 5.0))
    with torch.random.fork_rng():
        torch.manual_seed(0)
        result = augmentation(signal, inverse_depth=inverse)
    for index in range(2):
        generator = torch.Generator().manual_seed(int(augmentation._params["noise_seed"][index]))
        depth = 1 / inverse[index : index + 1].double().clamp(min=1e-9)
        expected = camera(scene_of(signal[index : index + 1], depth), generator=generator)
        assert (result[index] - expected[0]).abs().max() < 1e-6
    sharp = camera.noiseless()(scene_of(signal[:1], 2.0))
    assert (camera.noiseless()(scene_of(signal[:1], depth)) - sharp).abs().max() > 0.02  # the map matters


@pytest.mark.parametrize("distance", [0.5, 1.0, 5.0])
def test_is_within_the_tolerance_of_the_reference_physics(distance: float) -> None:
    """As `Plan.measure` has it: the noiseless raw, over a picture that is not the one that was planned for."""
    camera, signal = small_camera(), photographs(1)
    augmentation = KC.RandomCamera([camera], 0.02, distance=(0.5, 5.0))
    planned = augmentation.planned(0, signal)
    scene = scene_of(signal, distance)
    with torch.no_grad():
        error = relative_rms(noiseless_raw(planned)(scene), noiseless_raw(camera)(scene))
    assert error < 0.02


@pytest.mark.slow
def test_it_plans_once_for_each_camera_and_size(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    plan = Camera.plan

    def counted(self: Camera, scenes, **arguments):
        calls.append((len(scenes), scenes[0].shape))
        return plan(self, scenes, **arguments)

    monkeypatch.setattr(Camera, "plan", counted)
    augmentation = KC.RandomCamera([small_camera()])
    assert not calls  # not when it is built
    small, large = photographs(2), photographs(1)[..., :32, :32]
    for signal in (small, small[:1], small, large, small, large):
        augmentation(signal)
    assert calls == [(2, (1, *SIZE)), (2, (1, 32, 32))]
    augmentation(small, inverse_depth=torch.ones(2, 1, *SIZE))
    augmentation(small, inverse_depth=torch.zeros(2, 1, *SIZE))
    assert calls[2:] == [(1, (1, *SIZE))]
    augmentation(small.double())
    assert len(calls) == 3


def test_a_sample_does_not_depend_on_the_others() -> None:
    signal = photographs(3)
    augmentation = KC.RandomCamera([small_camera(), "ideal"])
    together, drawn = augmented(augmentation, signal)
    for index in range(3):
        own = {name: value[index : index + 1] for name, value in drawn.items()}
        alone = augmentation.simulate(signal[index : index + 1], own)
        assert (together[index] - alone[0]).abs().max() < 1e-6
    again = augmentation(signal, params=augmentation._params)
    assert torch.equal(again, together)


@pytest.mark.parametrize("level", [0.0, 1.0])
@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (9, 7)])
def test_black_white_and_tiny_pictures(level: float, shape: tuple[int, int]) -> None:
    result, _ = augmented(KC.RandomCamera([small_camera()]), torch.full((2, 3, *shape), level))
    assert result.shape == (2, 3, *shape)
    assert result.isfinite().all()
    if level == 0:
        assert result.max() < 0.1  # read noise of 2 of 6000 electrons, brightened by the tone curve's slope of 13
    elif shape != (1, 1):  # whose one pixel is not all of the blur: a window is at most the picture
        assert result.min() > 0.8  # exposed for white, with shot noise of 1.3 %


def test_far_away_and_focused_at_infinity() -> None:
    augmentation = KC.RandomCamera([small_camera()], distance=(1.0, math.inf))
    result, drawn = augmented(augmentation, photographs(2))
    assert result.isfinite().all()
    assert (drawn["distance"] > 1).all()
    endless, _ = augmented(KC.RandomCamera([small_camera()], distance=math.inf), photographs(1))
    assert endless.isfinite().all()


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_depth_maps_that_can_be_none(value: float) -> None:
    inverse = torch.ones(1, 1, *SIZE)
    inverse[..., 3, 4] = value
    with pytest.raises(ValueError, match="expected finite ones >= 0"):
        KC.RandomCamera([small_camera()])(photographs(1), inverse_depth=inverse)


@pytest.mark.slow
def test_gradients_reach_the_picture_and_a_camera_of_ones_own() -> None:
    focal_length = nn.Parameter(torch.tensor(4.3 * mm))
    own = small_camera(focal_length=focal_length)
    signal = photographs(1).clamp(0.05, 0.95).requires_grad_()
    result, _ = augmented(KC.RandomCamera([own], distance=0.7), signal)
    result.square().sum().backward()
    assert signal.grad.isfinite().all()
    assert signal.grad.abs().max() > 0
    assert focal_length.grad.isfinite()
    assert focal_length.grad != 0
    assert not any(parameter.requires_grad for parameter in KC.RandomCamera(["phone", "thesis"]).parameters())


def test_a_plan_without_gradients_is_not_trained_through() -> None:
    """A validation pass before the training must not leave its plan to it."""
    focal_length = nn.Parameter(torch.tensor(4.3 * mm, dtype=torch.float64))
    augmentation = KC.RandomCamera([small_camera(focal_length=focal_length)], 0.1)
    signal = photographs(1)
    with torch.no_grad():
        quick = augmentation.planned(0, signal)
    assert augmentation.planned(0, signal) is not quick
    with torch.no_grad():
        assert augmentation.planned(0, signal) is quick


def test_a_saved_camera_takes_the_same_pictures(tmp_path: Path) -> None:
    camera = small_camera()
    camera.save(tmp_path / "own.safetensors")
    signal = photographs(1)
    result, _ = augmented(KC.RandomCamera([camera], 0), signal)
    loaded, _ = augmented(KC.RandomCamera(tmp_path / "own.safetensors", 0), signal)
    assert torch.equal(result, loaded)


def test_building_draws_nothing_from_the_global_generator() -> None:
    before = torch.get_rng_state()
    KC.RandomCamera(["phone", "thesis", "ideal"])
    assert torch.equal(torch.get_rng_state(), before)


def test_bad_arguments() -> None:
    with pytest.raises(ValueError, match="cameras is empty"):
        KC.RandomCamera([])
    with pytest.raises(ValueError, match="unknown camera 'fone'"):
        KC.RandomCamera(["fone"])
    raw = Camera(sensor.ColourFilter.nikon(), sensor.Mosaic("RGGB"), sensor.Exposure())
    with pytest.raises(ValueError, match="ends in 1 channels, expected a picture of 3"):
        KC.RandomCamera([raw], 0)(picture(1, 3, 8, 8))
    with pytest.raises(ValueError, match="turns 28 channels into 3"):
        KC.RandomCamera(["ideal"], p=0.5)(picture(1, 28, 8, 8))


def _pitch(camera: Camera) -> None:
    camera[0].pixel_pitch = 2 * camera[0].pixel_pitch


def _stage(camera: Camera) -> None:
    camera.stages[1] = sensor.ColourFilter.kodak()


def _added(camera: Camera) -> None:
    camera[0].lens.elements.append(optics.Defocus(0.5))


def _trained(camera: Camera) -> None:
    camera.requires_grad_(True)


class _Own(optics.Element):
    """Of which nothing can be known."""


@pytest.mark.parametrize(
    ("change", "own"),  # own: with a part that is not known
    [
        (_pitch, False),
        *(pytest.param(change, False, marks=pytest.mark.slow) for change in (_stage, _added, _trained)),
        *(pytest.param(change, True, marks=pytest.mark.slow) for change in (_pitch, _stage, _added, _trained)),
    ],
)
def test_it_plans_again_for_a_camera_that_was_changed(change, own: bool) -> None:
    camera = small_camera()
    if own:
        camera[0].lens.elements.append(_Own())
    augmentation, signal = KC.RandomCamera([camera]), photographs(1)
    with torch.no_grad():
        _, drawn = augmented(augmentation, signal)
        change(camera)
        found = augmentation.simulate(signal, drawn)
        assert torch.equal(found, KC.RandomCamera([camera]).simulate(signal, drawn))


def test_training_does_not_plan_again() -> None:
    camera = small_camera()
    camera.stages[1] = sensor.ColourFilter.kodak().trainable()
    augmentation, signal = KC.RandomCamera([camera], tolerance=0.1), photographs(1)
    with torch.no_grad():
        before = augmentation.planned(0, signal)
        camera[1].coefficients.mul_(1.01)
        assert augmentation.planned(0, signal) is before
