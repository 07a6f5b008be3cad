"""A real lens: pictures are `Imaging`'s, and what goes with a picture goes where its light goes."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import kornia.augmentation as K
import pytest
import torch
from drawing import PRIMARIES, augmented, coded, in_light, picture
from torch import Tensor, nn

import kcam.augmentation as KC
from kcam import Scene, optics
from kcam.optics.compound.presets import PRESETS
from kcam.units import mm

SHAPE = (48, 64)
KEYS = ["input", "mask", "keypoints", "bbox_xyxy"]


def small_lens(*, focus_distance: float = 2.0) -> optics.CompoundLens:
    """A single lens of 0.6 mm with its stop in front: it blurs, and its barrel is 5 % at 30 degrees."""
    glass = optics.Glass(1.5168, 64.2)
    return optics.CompoundLens(
        optics.Surface(radius=math.inf, thickness=0.15 * mm, semi_diameter=0.04 * mm, stop=True),
        optics.Surface(radius=1.2 * mm, thickness=0.15 * mm, glass=glass, semi_diameter=0.4 * mm),
        optics.Surface(radius=-0.45 * mm, thickness=0.0, semi_diameter=0.4 * mm),
        focus_distance=focus_distance,
    ).requires_grad_(False)


@pytest.fixture(scope="module")
def lens() -> optics.CompoundLens:
    return small_lens()


@pytest.fixture(scope="module")
def shared(lens: optics.CompoundLens) -> KC.RandomLens:
    """One view, for the tests of where things go."""
    return KC.RandomLens(lens, 0.7, distance=2.0, p=1.0)


def by_hand(lens: optics.CompoundLens, light: Tensor, *, pitch: float, distance: float) -> Tensor:
    scene = dataclasses.replace(Scene.from_bands(light, wavelengths=PRIMARIES), depth=distance)
    return optics.Imaging(lens, pixel_pitch=pitch, spacing=16)(scene)


def test_the_picture_is_that_of_imaging(lens: optics.CompoundLens) -> None:
    augmentation = KC.RandomLens([lens, small_lens(focus_distance=1.0)], 0.7, distance=1.5, p=1.0)
    image = picture(3, 3, *SHAPE)
    found, drawn = augmented(augmentation, image)
    assert set(drawn["lens"].tolist()) == {0, 1}
    for index, row in enumerate(in_light(image).split(1)):
        own, reach, distance = (drawn[name][index].item() for name in ("lens", "reach", "distance"))
        pitch = augmentation.pixel_pitch(int(own), shape=SHAPE, reach=reach)
        expected = by_hand(augmentation.lenses[int(own)], row, pitch=pitch, distance=distance)
        assert (found[index : index + 1] - coded(expected, like=image)).abs().max() < 1e-9
        assert (expected - row).abs().max() > 0.01


def test_the_corners_lie_where_reach_says() -> None:
    preset = KC.RandomLens("phone")
    own = optics.CompoundLens.preset("phone", focus_distance=2.0)
    top = torch.tensor([[0.0, PRESETS["phone"].field]])
    circle = float(own.image_point([550e-9], distances=2.0, field=top).norm())
    for shape in ((480, 640), (300, 900)):
        pitch = preset.pixel_pitch(0, shape=shape, reach=0.8)
        assert pitch * math.hypot(*shape) / 2 == pytest.approx(0.8 * circle, rel=1e-6)
    tiny = preset.pixel_pitch(0, shape=(1, 1), reach=0.8)
    assert tiny == pytest.approx(200 * 550e-9 * preset.lenses[0].f_number)
    assert preset.lenses[0].f_number == pytest.approx(
        math.sqrt(2) * optics.CompoundLens.preset("phone", focus_distance=2.0).f_number, rel=1e-9
    )  # one stop


def test_keypoints_land_where_bright_points_do(shared: KC.RandomLens) -> None:
    height, width = SHAPE
    points = torch.tensor([[12.0, 10.0], [52.0, 12.0], [33.0, 25.0], [10.0, 38.0], [50.0, 35.0]])
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    _, _, moved, _ = K.AugmentationSequential(shared, data_keys=KEYS)(
        torch.zeros(1, 3, *SHAPE).double(), torch.zeros(1, 1, *SHAPE), points[None], torch.zeros(1, 1, 4)
    )
    assert (moved[0] - points).norm(dim=1).max() > 0.5
    drawn = {name: shared._params[name] for name in ("lens", "reach", "distance")}
    for (column, row), own in zip(points.long().tolist(), moved[0], strict=True):
        dot = torch.zeros(1, 3, *SHAPE, dtype=torch.float64)
        dot[..., row, column] = 1.0
        light = shared.simulate(dot, drawn)[0, 1]
        centroid = torch.stack([(light * x).sum(), (light * y).sum()]) / light.sum()
        assert (centroid - own).norm() < 0.1  # coma included


def test_masks_and_boxes_follow(shared: KC.RandomLens) -> None:
    boxes = torch.tensor([[[4.0, 5.0, 16.0, 17.0], [40.0, 28.0, 58.0, 43.0]]])
    mask = torch.zeros(1, 1, *SHAPE)
    for left, top, right, bottom in boxes[0].long().tolist():
        mask[..., top : bottom + 1, left : right + 1] = 1
    sequence = K.AugmentationSequential(shared, data_keys=KEYS)
    out = sequence(mask.expand(-1, 3, -1, -1), mask, boxes[..., :2], boxes)
    _, found, _, moved = out
    assert set(found.unique().tolist()) == {0.0, 1.0}
    for one in moved[0]:
        left, top, right, bottom = one.tolist()
        y, x = torch.nonzero(found[0, 0], as_tuple=True)
        near = (x > left - 4) & (x < right + 4) & (y > top - 4) & (y < bottom + 4)
        held = torch.stack([x[near].min(), y[near].min(), x[near].max(), y[near].max()])
        assert (held - one).abs().max() < 1.01  # pixels, of the nearest
    assert (moved - boxes).abs().max() > 0.5
    light = out[0][0, 1] > 0.735  # half the light, coded
    assert (light != (found[0, 0] > 0)).float().mean() < 0.03
    back = sequence.inverse(*out)
    assert (back[2] - boxes[..., :2]).abs().max() < 1e-3


@pytest.mark.parametrize("border", ["reflect", "zero"])
def test_the_mask_goes_on_as_its_picture_does(lens: optics.CompoundLens, border: str) -> None:
    sequence = K.AugmentationSequential(
        KC.RandomLens(lens, 0.9, distance=2.0, border=border, p=1.0), data_keys=["input", "mask"]
    )
    image, mask = sequence(torch.ones(1, 3, *SHAPE), torch.ones(1, 1, *SHAPE))
    assert (mask.min() == 1) == (border == "reflect")
    assert (image[..., 0, 0].max() > 0.3) == (border == "reflect")


def test_a_seed_decides_and_samples_are_alone(lens: optics.CompoundLens) -> None:
    arguments = {"reach": (0.4, 0.7), "distance": 2.0, "steps": 2}
    image = picture(3, 3, 20, 24)
    augmentation = KC.RandomLens(lens, p=1.0, **arguments)
    found, _ = augmented(augmentation, image, seed=1)
    params = augmentation._params
    again, _ = augmented(KC.RandomLens(lens, p=1.0, **arguments), image, seed=1)
    assert torch.equal(found, again)
    other = torch.cat([image[:1], picture(2, 3, 20, 24, seed=5) ** 4])
    assert torch.equal(augmentation(other, params=params)[:1], found[:1])
    assert torch.equal(augmentation(image, params=params), found)


@pytest.mark.slow
def test_a_lens_that_changed_is_not_the_one_that_is_kept() -> None:
    lens = small_lens()
    augmentation = KC.RandomLens(lens, 0.5, distance=2.0, p=1.0)
    image = picture(1, 3, 20, 24)
    before = augmentation(image)
    lens.surfaces[0].semi_diameter = 0.03 * mm
    fresh = KC.RandomLens(lens, 0.5, distance=2.0, p=1.0)(image)
    found = augmentation(image)
    assert torch.equal(found, fresh)
    assert not torch.equal(found, before)


def test_gradients_reach_a_lens_of_ones_own() -> None:
    glass = optics.Glass(1.5168, 64.2)
    front = optics.Surface(
        radius=nn.Parameter(torch.tensor(0.6 * mm)),
        thickness=0.1 * mm,
        glass=glass,
        semi_diameter=0.05 * mm,
        stop=True,
    )
    back = optics.Surface(radius=-0.6 * mm, thickness=0.0, semi_diameter=0.1 * mm)
    lens = optics.CompoundLens(front, back, focus_distance=2.0)
    KC.RandomLens(lens, 0.4, distance=0.05, p=1.0)(picture(1, 3, 16, 18)).square().sum().backward()
    assert front.radius.grad is not None
    assert front.radius.grad.isfinite()
    assert front.radius.grad != 0


@pytest.mark.slow
def test_files(tmp_path: Path, lens: optics.CompoundLens) -> None:
    image = picture(1, 3, 16, 20)
    for name in ("lens.zmx", "lens.json"):
        lens.save(tmp_path / name)
        read = KC.RandomLens(tmp_path / name, 0.5, distance=2.0, stops=0.0, p=1.0)
        expected = KC.RandomLens(lens, 0.5, distance=2.0, p=1.0)(image)
        assert (read(image) - expected).abs().max() < 1e-4  # a file has some of the digits


@pytest.mark.slow
def test_behind_a_colour_filter_light_is_linear(lens: optics.CompoundLens) -> None:
    augmentation = KC.RandomLens(lens, 0.5, distance=2.0, p=1.0)
    light = picture(1, 3, 16, 20) / 2
    found = augmentation(light, linear=torch.ones(()))
    drawn = {name: augmentation._params[name] for name in ("lens", "reach", "distance")}
    assert torch.equal(found, augmentation.simulate(light, drawn))


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ({"lens": []}, ValueError, "lens is empty: give at least one"),
        ({"lens": ["zeiss"]}, ValueError, "unknown lens 'zeiss'. There are: cooke_triplet"),
        ({"lens": [3]}, TypeError, "lens must be names, files or an optics.CompoundLens, got"),
        ({"lens": "none.zmx"}, FileNotFoundError, "none.zmx"),
        ({"reach": (0.6, 1.2)}, ValueError, r"reach must be .*of the image circle with 0.01 <= low <= high <= 0.99"),
        ({"reach": nn.Parameter(torch.tensor([0.5, 0.6]))}, ValueError, "reach cannot be trained: its values are"),
        ({"distance": 0.0}, ValueError, r"distance must be .*\[m\] with 0.01 <= low"),
        ({"steps": 0}, ValueError, "steps must be a whole number of 1 or more, got 0"),
        ({"stops": -1.0}, ValueError, "stops must be a number from 0, wide open, to 10, got -1"),
        ({"focus": 0.0}, ValueError, "focus"),
        ({"focus": 0.01}, ValueError, "Focus farther away"),
        ({"border": "black"}, ValueError, "unknown border 'black'; known: reflect"),
        ({"p": 2.0}, ValueError, "p must be a probability"),
    ],
)
def test_errors(arguments: dict, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        KC.RandomLens(**{"lens": "ef50"} | arguments)


def test_steps_are_what_is_drawn() -> None:
    augmentation = KC.RandomLens("ef50", (0.6, 0.9), distance=(1.0, math.inf), steps=3, p=1.0)
    drawn = augmentation.generate_parameters((200, 3, 8, 8))
    assert {round(value, 6) for value in drawn["reach"].tolist()} == {0.6, 0.75, 0.9}
    assert {round(1 / value, 6) for value in drawn["distance"].tolist()} == {0.0, 0.5, 1.0}
    one = KC.RandomLens("ef50", (0.6, 0.9), steps=1).generate_parameters((4, 3, 8, 8))
    assert one["reach"].tolist() == pytest.approx([0.75] * 4)


@pytest.mark.parametrize(
    "f_number", [pytest.param(8.0, marks=pytest.mark.slow), 16.0, pytest.param(30.0, marks=pytest.mark.slow)]
)
def test_a_slow_lens_and_a_small_picture_keep_pixels_within_their_range(f_number: float) -> None:
    """200 wavelengths times the f-number are above a millimetre beyond f/9."""
    front = optics.Surface(radius=52 * mm, thickness=1 * mm, glass="N-BK7", semi_diameter=25 / f_number * mm, stop=True)
    lens = optics.CompoundLens(front, optics.Surface(radius=-52 * mm, semi_diameter=10 * mm), focus_distance=2.0)
    out = KC.RandomLens(lens, reach=0.1, steps=1, p=1.0)(picture(1, 3, 16, 16))
    assert out.isfinite().all()
