"""What a picture is computed with, as one value: the same one by one, all at once, set, and in a file."""

from __future__ import annotations

import copy
import inspect
import typing
from dataclasses import FrozenInstanceError, fields, replace
from pathlib import Path

import pytest
import torch
from draws import Draw

from kcam import Camera, Scene, optics
from kcam.optics.accuracy import Shortcuts
from kcam.optics.propagation import textbook
from kcam.units import mm, um, wavelength_grid


def lens() -> optics.Lens:
    return optics.Lens(optics.CircularAperture(3 * mm), optics.ThinLens(30 * mm), focus_distance=2.0)


def scene() -> Scene:
    generator = torch.Generator().manual_seed(1)
    bands = torch.rand(1, 5, 14, 17, generator=generator)
    depth = 1 + torch.rand(1, 1, 14, 17, generator=generator)
    return Scene.from_bands(bands, wavelengths=wavelength_grid(count=5), depth=depth)


def random_settings(draw: Draw) -> dict[str, typing.Any]:
    """Some arguments of an Accuracy, none of them its default."""
    every = {
        "propagator": "fresnel",
        "method": draw.one_of("matrix", "chirp_z"),
        "samples": draw.one_of(64, 96),
        "kappa": 3.0,
        "blur": False,
        "bands": draw.one_of(1, 2, 3, 4),
        "interpolate_bands": True,
        "psf_shape": (draw.one_of(3, 6, 9), draw.one_of(4, 7)),
        "renormalise": True,
        "layers": draw.one_of(3, (1.9, 1.1)),
        "interpolate": False,
        "occlusion": False,
        "coverage": "band",
        "rank": draw.one_of(1, 2, 3),
        "precision": "float64",
        "max_memory": 1e6,
        "tile": draw.one_of(5, 8, 12),
        "direct": True,
        "spacing": draw.one_of(8, 64),
        "field_variation": False,
        "distortion": False,
        "lateral_colour": False,
        "relative_illumination": False,
    }
    assert every.keys() == {field.name for field in fields(optics.Accuracy)}
    return {name: value for name, value in every.items() if draw.number(0, 1) < 0.4}


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.filterwarnings("ignore:layers=")
def test_one_by_one_at_once_and_set_are_the_same(seed: int, tmp_path: Path) -> None:
    settings = random_settings(Draw(seed))
    physics = {"pixel_pitch": 5 * um, "fill_factor": 0.7, "border": "replicate"}
    accuracy = optics.Accuracy(**settings)
    one_by_one = optics.Imaging(lens(), **physics, **settings)
    at_once = optics.Imaging(lens(), **physics, accuracy=accuracy)
    some, rest = dict(list(settings.items())[::2]), dict(list(settings.items())[1::2])
    mixed = optics.Imaging(lens(), **physics, accuracy=optics.Accuracy(**some), **rest)
    placed = optics.Imaging(lens(), **physics)
    for name, value in settings.items():
        setattr(placed, name, value)
    camera = Camera(one_by_one)
    camera.save(tmp_path / "camera.safetensors")
    loaded = Camera.load(tmp_path / "camera.safetensors")[0]
    expected = one_by_one(scene())
    for stage in (at_once, mixed, placed, loaded, copy.deepcopy(placed), one_by_one.changed()):
        assert stage.accuracy == accuracy
        assert torch.equal(stage(scene()), expected)
        for name, value in settings.items():
            assert getattr(stage, name) == value


def test_a_setting_that_is_set_changes_the_picture_that_was_kept() -> None:
    stage = optics.Imaging(lens(), psf_shape=(9, 9))
    before = stage(scene())
    stage.bands = 1
    assert not torch.equal(stage(scene()), before)
    stage.accuracy = replace(stage.accuracy, bands=None)
    assert torch.equal(stage(scene()), before)


def test_the_names_and_types_are_those_of_the_constructor() -> None:
    assert typing.get_type_hints(Shortcuts) == typing.get_type_hints(optics.Accuracy)
    own = set(inspect.signature(optics.Imaging).parameters) - {"shortcuts"}
    assert own | Shortcuts.__annotations__.keys() == {*optics.Imaging(lens()).configuration(), "accuracy"}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"propagator": "ray"}, "unknown propagator 'ray'"),
        ({"coverage": "pixel"}, "unknown coverage 'pixel'"),
        ({"bands": 0}, "bands must be a positive"),
        ({"bands": 2.5}, "bands must be a positive"),
        ({"psf_shape": 5}, r"psf_shape must be two positive integers .* got 5. Use \(5, 5\)"),
        ({"psf_shape": (0, 4)}, "psf_shape must be two positive integers"),
        ({"tile": "big"}, "tile must be a positive number of pixels, or None, got 'big'"),
        ({"tile": -1}, "tile must be a positive"),
        ({"rank": 0}, "rank must be a positive"),
        ({"kappa": 1.0}, "kappa must be above 1"),
        ({"precision": "half"}, "precision must be"),
        ({"max_memory": 0}, "max_memory must be a positive"),
        ({"layers": 0}, "layers must be a positive"),
        ({"layers": []}, "layers holds no distance"),
    ],
)
def test_bad_settings_are_refused_wherever_they_come_in(settings: dict[str, typing.Any], message: str) -> None:
    for refused in (optics.Accuracy, lambda **given: optics.Imaging(lens(), **given)):
        with pytest.raises(ValueError, match=message):
            refused(**settings)
    stage = optics.Imaging(lens())
    with pytest.raises(ValueError, match=message):
        setattr(stage, *settings.popitem())


def test_what_is_no_accuracy_is_refused() -> None:
    with pytest.raises(TypeError, match=r"accuracy must be an optics.Accuracy"):
        optics.Imaging(lens(), accuracy={"bands": 3})
    with pytest.raises(TypeError, match="unexpected keyword argument 'band'"):
        optics.Imaging(lens(), band=3)
    with pytest.raises(FrozenInstanceError):
        optics.Accuracy().bands = 3


def test_a_propagator_of_ones_own_brings_its_parameters() -> None:
    row = textbook.textbook_row(64)
    row.function = torch.nn.Linear(2, 2)
    stage = optics.Imaging(lens())
    stage.propagator = row
    assert len(list(stage.parameters())) == 2
    stage.propagator = "fresnel"
    assert not list(stage.parameters())
