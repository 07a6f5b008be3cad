"""What goes in by mistake, at every door: refused with code that mends it, or taken as what it is.

The code in an error is run: what it makes of the mistake must be the picture that was meant, and the door must take it.
"""

from __future__ import annotations

import functools
import random
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.autograd import forward_ad

import kcam
import kcam.augmentation as KC
from kcam import Camera, Scene, isp, optics, plots, sensor, style
from kcam.inputs import check_bands, check_picture, check_signal, describe
from kcam.optics.rendering.depth import alike
from kcam.units import mm, um
from tests.augmentation.augmented_cases import LENS, small_camera

MEAN = torch.tensor([0.485, 0.456, 0.406])[:, None, None]
STD = torch.tensor([0.229, 0.224, 0.225])[:, None, None]


# ---- the mistakes ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mistake:
    """What somebody makes of pictures (B,3,H,W) in [0,1]. error: of the type that doors raise.

    off: how far the mended pictures may be. first: only the first of the batch is in it. gray: only its green is.
    """

    make: Callable[[Tensor], Any]
    error: type[Exception] = ValueError
    off: float = 1e-6
    first: bool = False
    gray: bool = False


def levels(pictures: Tensor, top: int = 255) -> np.ndarray:
    return (pictures * top).round().numpy().astype(np.uint8 if top == 255 else np.uint16)


def last(pictures: Tensor) -> Tensor:
    return pictures.movedim(-3, -1).contiguous()


def with_alpha(pictures: Tensor) -> Tensor:
    return torch.cat([pictures, torch.ones_like(pictures[..., :1, :, :])], dim=-3)


def as_pil(pictures: Tensor, mode: str = "RGB") -> Image.Image:
    return Image.fromarray(levels(last(pictures[0]))).convert(mode)


BYTE = 0.5 / 255 + 1e-6
LAYOUT = {
    "channels last": Mistake(last),
    "one with channels last": Mistake(lambda x: last(x[0]), first=True),
    "alpha": Mistake(with_alpha),
    "alpha, channels last": Mistake(lambda x: last(with_alpha(x))),
    "clips": Mistake(lambda x: x[None]),
}
TYPES = {
    "8 bits": Mistake(lambda x: torch.from_numpy(levels(x)), TypeError, BYTE),
    "16 bits": Mistake(lambda x: torch.from_numpy(levels(x, 65535)), TypeError, 1e-5),
    "whole numbers": Mistake(lambda x: torch.from_numpy(levels(x)).long(), TypeError, BYTE),
    "complex": Mistake(lambda x: x.to(torch.complex64), TypeError),
}
OBJECTS = {
    "array of 8 bits": Mistake(lambda x: levels(last(x[0])), TypeError, BYTE, first=True),
    "arrays of floats": Mistake(lambda x: last(x).numpy(), TypeError),
    "array with channels first": Mistake(lambda x: x.numpy(), TypeError),
    "array turned from BGR": Mistake(lambda x: levels(last(x[0])[..., [2, 1, 0]])[..., ::-1], TypeError, BYTE, True),
    "array of another byte order": Mistake(lambda x: x.numpy().astype(">f4"), TypeError),
    "PIL image": Mistake(as_pil, TypeError, BYTE, first=True),
    "PIL image with alpha": Mistake(lambda x: as_pil(x, "RGBA"), TypeError, BYTE, first=True),
    "PIL image in CMYK": Mistake(lambda x: as_pil(x, "CMYK"), TypeError, 0.1, first=True),
    "list of tensors": Mistake(lambda x: list(x), TypeError),
    "tuple of arrays": Mistake(lambda x: tuple(levels(last(one)) for one in x), TypeError, BYTE),
    "nested lists": Mistake(lambda x: x.tolist(), TypeError),
    "file": Mistake(lambda x: picture_file(x), TypeError, BYTE, first=True),
}
SCALES = {
    "to 255": Mistake(lambda x: x * 255),
    "to 65535": Mistake(lambda x: x * 65535),
    "normalised": Mistake(lambda x: (x - MEAN.to(x)) / STD.to(x), off=1e-5),
    "from -1": Mistake(lambda x: x * 2 - 1),
}
HOPELESS = {  # no code can know what was meant
    "nothing": Mistake(lambda x: None, TypeError),
    "a mapping": Mistake(lambda x: {"image": x}, TypeError),
    "an empty list": Mistake(lambda x: [], TypeError),
    "pictures of two sizes": Mistake(lambda x: [x[0], x[0, :, 1:]], TypeError),
}
MISTAKES = {**LAYOUT, **TYPES, **OBJECTS, **SCALES, **HOPELESS}
_FOLDER: list[Path] = []


@pytest.fixture(scope="module", autouse=True)
def folder(tmp_path_factory: pytest.TempPathFactory) -> None:
    _FOLDER[:] = [tmp_path_factory.mktemp("pictures")]


def picture_file(pictures: Tensor) -> str:
    path = _FOLDER[0] / "picture.png"
    as_pil(pictures).save(path)
    return str(path)


# ---- the doors ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Door:
    """A call that takes pictures, or cubes and is given pictures by mistake.

    takes: mistakes that are none here. one: it takes one picture, not a batch. side: of the pictures, a multiple of.
    optional: what means something else here, such as None for no photo. arrays: it takes them, so that they are never
    of a wrong type.
    """

    call: Callable[[Any], Any]
    takes: frozenset[str] = field(default_factory=frozenset)
    one: bool = False
    side: int = 1
    optional: frozenset[str] = frozenset()
    arrays: bool = False


@functools.cache
def imaging() -> optics.Imaging:
    lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(8 * mm), focus_distance=2.0)
    return optics.Imaging(lens, pixel_pitch=10 * um, psf_shape=(5, 5), propagator="fresnel", bands=3)


@functools.cache
def a_style() -> style.StyleLoss:
    return style.StyleLoss(torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(7)))


def rows(given: Any) -> int:
    return len(given) if isinstance(given, Tensor) and given.ndim == 4 else 1


SCALED, UNASKED = frozenset(SCALES), frozenset({"nothing"})
ARRAYS = frozenset(OBJECTS) - {
    "array with channels first",
    "array turned from BGR",
    "array of another byte order",
    "PIL image with alpha",
    "PIL image in CMYK",
    "list of tensors",
    "tuple of arrays",
    "nested lists",
}
PICTURES: dict[str, Door] = {
    "Scene.from_rgb": Door(Scene.from_rgb),
    "write_picture": Door(lambda x: plots.write_picture(x, _FOLDER[0] / "written.png"), frozenset({"from -1"}), True),
    "StyleLoss": Door(style.StyleLoss, one=True, side=64),
    "paint": Door(lambda x: style.paint(a_style(), photo=x, steps=1), one=True, side=64, optional=UNASKED),
    "SteerableFeatures": Door(style.SteerableFeatures(), SCALED, side=64),
    "a style loss": Door(lambda x: a_style()(x, torch.rand(rows(x), 3, 64, 64)), SCALED, side=64),
    "its scene": Door(
        lambda x: a_style()(torch.rand(rows(x), 3, 64, 64), x), SCALED, side=64, optional=frozenset({"nothing"})
    ),
    "StyleStage": Door(isp.StyleStage(), SCALED, side=16),
    "TextureTransfer": Door(isp.TextureTransfer(style.painting("mosaic", size=64), turns=1), SCALED, side=16),
    "Mosaic": Door(sensor.Mosaic(), SCALED | {"clips"}),
    "ToneCurve": Door(isp.ToneCurve(), SCALED | {"clips"}),
    "Convolution": Door(isp.Convolution(), SCALED | {"clips"}),
    "WhiteBalance": Door(isp.WhiteBalance(), SCALED | {"clips", "alpha"}),
    "ColourMatrix": Door(isp.ColourMatrix(), SCALED | {"clips", "alpha"}),
}
"""WhiteBalance and ColourMatrix take four channels, those of a sensor with white pixels."""
ANY_CHANNELS = {
    name: Door(stage, SCALED | set(LAYOUT))
    for name, stage in {
        "Exposure": sensor.Exposure(),
        "ShotNoise": sensor.ShotNoise(),
        "ReadNoise": sensor.ReadNoise(2.0),
        "FixedPattern": sensor.FixedPattern(0.01),
        "RowColumnNoise": sensor.RowColumnNoise(),
        "DefectPixels": sensor.DefectPixels(),
        "Crosstalk": sensor.Crosstalk(),
        "MicrolensShading": sensor.MicrolensShading(pupil_distance=5 * mm),
        "Nonlinearity": sensor.Nonlinearity(),
        "VeilingGlare": optics.VeilingGlare(focal_length=5 * mm),
        "ADC": sensor.ADC(),
        "Clip": isp.Clip(),
    }.items()
}
CUBES: dict[str, Door] = {
    "Scene.from_bands": Door(Scene.from_bands),
    "Scene": Door(Scene),
    "a camera with optics": Door(lambda x: small_camera()(x)),
    "a camera without": Door(lambda x: Camera.ideal()(x)),
    "Imaging": Door(lambda x: imaging()(x)),
    "ColourFilter": Door(sensor.ColourFilter.kodak()),
}
AUGMENTATIONS: dict[str, Door] = {
    name: Door(augmentation)
    for name, augmentation in {
        "RandomDefocus": KC.RandomDefocus(p=1.0, **LENS),
        "RandomDiffraction": KC.RandomDiffraction(p=1.0, **LENS),
        "RandomAberration": KC.RandomAberration((0.0, 0.1), 8.0, p=1.0, **LENS),
        "RandomChromaticAberration": KC.RandomChromaticAberration(p=1.0, **LENS),
        "RandomVignetting": KC.RandomVignetting(p=1.0),
        "RandomBayer": KC.RandomBayer(),
        "RandomShotReadNoise": KC.RandomShotReadNoise(p=1.0),
        "RandomFixedPattern": KC.RandomFixedPattern(p=1.0),
        "RandomMotion": KC.RandomMotion(p=1.0),
        "RandomBanding": KC.RandomBanding(p=1.0),
        "RandomHotPixels": KC.RandomHotPixels(p=1.0),
        "RandomVeilingGlare": KC.RandomVeilingGlare(p=1.0),
        "RandomExposure": KC.RandomExposure(p=1.0),
        "RandomQuantisation": KC.RandomQuantisation(p=1.0),
        "RandomWhiteBalance": KC.RandomWhiteBalance(p=1.0),
        "RandomColourMatrix": KC.RandomColourMatrix(p=1.0),
        "RandomToneCurve": KC.RandomToneCurve(p=1.0),
        "RandomCamera": KC.RandomCamera([Camera.ideal()], tolerance=0),
        "RandomLens": KC.RandomLens("phone", p=1.0, steps=1),
    }.items()
}
AUGMENTATIONS |= {
    "RandomLensDistortion": Door(KC.RandomLensDistortion(p=1.0), frozenset({"alpha"})),
    "RandomRollingShutter": Door(KC.RandomRollingShutter(p=1.0), frozenset({"alpha"})),
    "CameraSequential": Door(
        KC.CameraSequential(KC.RandomExposure(p=1.0)),
        ARRAYS,
        arrays=True,
        optional=frozenset({"nothing", "a mapping"}),
    ),
    "corrupt": Door(
        lambda x: KC.corrupt(x, "vignetting"),
        ARRAYS - {"file"},
        arrays=True,
    ),
}
DOORS = {**PICTURES, **ANY_CHANNELS, **CUBES, **AUGMENTATIONS}
GIVEN = ("image", "picture", "photo", "scene", "signal", "mosaic", "bands", "coefficients")


def mended(message: str, mistake: Any) -> Any:
    """What the code at the end of an error makes of a mistake."""
    code = re.findall(r"[Uu]se (.+?)\.(?: |$)", message)[-1]
    known = {"torch": torch, "np": np, "kcam": kcam, "Scene": Scene, "mean": MEAN, "std": STD}
    return eval(code, known | dict.fromkeys(GIVEN, mistake))


def pictures(door: Door, seed: int) -> Tensor:
    """Of random size, with black and white in each, so that a scale can be told."""
    generator = torch.Generator().manual_seed(seed)

    def draw(low: int, high: int) -> int:
        return int(torch.randint(low, high, (1,), generator=generator))

    height, width = (door.side * (1 if door.side == 64 else draw(1, 3)) if door.side > 1 else draw(9, 28) for _ in "hw")
    drawn = torch.rand(draw(1, 4), 3, height, width, generator=generator)
    drawn[..., 0, 0], drawn[..., -1, -1] = 0, 1
    return drawn


PAIRS = [(name, door) for door in DOORS for name in MISTAKES]
QUICK = sorted(random.Random(0).sample(PAIRS, 160))


@pytest.mark.parametrize(("name", "door"), QUICK)
def test_a_mistake_is_refused_with_what_mends_it_or_taken(name: str, door: str) -> None:
    check_pair(name, door)


@pytest.mark.slow
@pytest.mark.parametrize("door", DOORS)
def test_every_mistake_at_every_door(door: str) -> None:
    for name in MISTAKES:
        check_pair(name, door)


def check_pair(name: str, door: str) -> None:
    mistake, entrance = MISTAKES[name], DOORS[door]
    meant = pictures(entrance, sum(map(ord, name + door)))
    given = mistake.make(meant)
    found = given = given[0] if entrance.one and name in SCALES else given
    if name in entrance.optional:
        return
    if name in entrance.takes:
        entrance.call(given)
        return
    error = ValueError if entrance.arrays and name in OBJECTS else mistake.error
    with pytest.raises((error, mistake.error)) as caught:
        entrance.call(given)
    message = str(caught.value)
    shape = getattr(given, "shape", (0, 0, 0))
    count = shape[-3] if len(shape) > 2 else 0
    named = (describe(given), str(tuple(shape)), f"{count} bands", f"got {count}", f"{count} channels", "values from")
    assert any(what in message for what in named), message
    if name in HOPELESS:
        return
    for _ in range(2):  # what nobody can see before it is a tensor takes a second error
        found = mended(message, found)
        try:
            if not isinstance(found, Scene):
                entrance.call(found)
            break
        except (TypeError, ValueError) as error:
            message = str(error)
    else:
        pytest.fail(f"still refused: {message}")
    expected = meant[:1] if mistake.first else meant
    if isinstance(found, Scene):
        assert door in CUBES
        torch.testing.assert_close(found.to_srgb(), expected, rtol=0, atol=max(mistake.off, 1e-5))
    elif isinstance(found, Tensor) and door not in ANY_CHANNELS:
        assert not entrance.one or found.ndim == 3
        expected = expected[0] if found.ndim == 3 else expected
        torch.testing.assert_close(found.float()[..., :3, :, :], expected, rtol=0, atol=mistake.off)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda x: Camera.ideal()(x), r"Probably a picture: use Scene.from_rgb\(image, depth=2.0\)."),
        (lambda x: imaging()(last(x)), r"a picture, channels last: use Scene.from_rgb\(bands.permute\(0, 3, 1, 2\)"),
        (lambda x: KC.RandomExposure(p=1.0)(last(x)), r"Probably channels last: use image.permute\(0, 3, 1, 2\)."),
        (lambda x: KC.RandomExposure(p=1.0)(with_alpha(x)), r"alpha, which to drop: use image\[..., :3, :, :\]."),
        (lambda x: KC.RandomExposure(p=1.0)((x - 0.45) / 0.22), r"by mean and deviation: use image \* std \+ mean."),
        (lambda x: Scene.from_rgb((x - 0.45) / 0.22), r"by mean and deviation: use image \* std \+ mean."),
        (
            lambda x: KC.RandomExposure(p=1.0)(as_pil(x)),
            r"use torch.from_numpy\(np.array\(image\)\).permute\(2, 0, 1\)",
        ),
        (lambda x: Scene.from_rgb(x * torch.nan), "values from nan to nan.* Remove NaN and inf where they come from"),
        (lambda x: Scene.from_rgb(x * 1.1), r"values from 0 to 1.1, .* Use image.clamp\(0, 1\)."),
        (lambda x: Scene.from_file(x), r"path must be the name of a file, got a tensor .* goes to Scene.from_rgb"),
        (lambda x: sensor.ShotNoise()(x * torch.nan), "1512 values that are NaN: photons cannot be counted"),
        (lambda x: KC.RandomExposure(p=1.0)(x.bool()), r"Use image.float\(\)."),
        (
            lambda x: Camera.ideal()(cube(2, 31)),
            r"31, 9, 12\), expected .* 28 .* Scene.from_bands\(image, wavelengths=",
        ),
        (lambda x: Camera.ideal()(last(cube(2))), r"use image.permute\(0, 3, 1, 2\)."),
        (lambda x: Scene.from_bands(cube(2)[..., :0]), r"shape \(2, 28, 9, 0\)"),
    ],
)
def test_what_is_said(call: Callable[[Tensor], Any], message: str) -> None:
    drawn = torch.rand(2, 3, 14, 18, generator=torch.Generator().manual_seed(1))
    drawn[..., 0, 0], drawn[..., 1, 1] = 0, 1
    with pytest.raises((TypeError, ValueError), match=message):
        call(drawn)


def cube(batch: int, bands: int = 28, height: int = 9, width: int = 12) -> Tensor:
    return torch.rand(batch, bands, height, width, generator=torch.Generator().manual_seed(2))


@pytest.mark.parametrize(
    "call",
    [
        lambda: Camera.ideal()(cube(1, height=7, width=3)),  # too low to be the sides of a picture
        lambda: Scene.from_bands(cube(1, height=28, width=3)),  # who says bands means bands
        lambda: Scene.from_bands(cube(2) * 4000),
        lambda: KC.RandomExposure(p=1.0)(cube(2) * 30),
        lambda: KC.RandomExposure(p=1.0)(cube(2) - 0.05),
        lambda: KC.RandomExposure(p=1.0)(cube(2, 3) * 1.2 - 0.1),
        lambda: KC.CameraSequential(KC.RandomExposure(p=1.0), wavelengths=[450e-9, 550e-9, 650e-9, 750e-9])(cube(2, 4)),
        lambda: KC.RandomDefocus(p=1.0, wavelengths=[450e-9, 550e-9, 650e-9, 750e-9], **LENS)(cube(2, 4)),
        lambda: KC.RandomDefocus(p=1.0, wavelengths=torch.linspace(400, 700, 31) * 1e-9, **LENS)(cube(1, 31, 20, 4)),
        lambda: KC.CameraSequential(KC.RandomExposure(p=1.0), wavelengths=torch.linspace(400, 700, 4) * 1e-9)(
            cube(1, 4, 9, 12)[0].permute(1, 2, 0).numpy()
        ),
        lambda: isp.ToneCurve()(cube(1, 3) * 9 - 3),  # within a camera there is noise below 0, and light above 1
        lambda: isp.Demosaic()(cube(1, 1) - 0.5),
        lambda: isp.WhiteBalance()(cube(1, 4)),  # of a sensor with white pixels
        lambda: Camera.ideal()[2:](cube(1, 3) - 0.1),
        lambda: KC.RandomLensDistortion(p=1.0)(cube(1, 4)),  # alpha moves with its picture
        lambda: Scene.from_rgb(cube(0, 3)),
        lambda: KC.RandomExposure(p=1.0)(cube(0, 3)),
    ],
)
def test_what_is_unusual_but_right_is_taken(call: Callable[[], Any]) -> None:
    result = call()
    values = result.bands() if isinstance(result, Scene) else result
    assert values.isfinite().all()


def test_rows_of_28_pixels_are_no_bands() -> None:
    """A batch of pictures of 28 x 28 pixels with channels last has the shape of cubes."""
    for camera in (Camera.ideal(), small_camera(), imaging()):
        with pytest.raises(ValueError, match=r"Probably a picture, channels last: use Scene.from_rgb"):
            camera(torch.rand(5, 28, 28, 3))


def test_a_right_input_costs_a_look_at_its_type(monkeypatch: pytest.MonkeyPatch) -> None:
    """No door reads values that did not before, and none looks for a remedy unless it refuses."""
    read = []
    plain = torch.Tensor.aminmax
    monkeypatch.setattr(torch.Tensor, "aminmax", lambda self, **how: read.append(1) or plain(self, **how))
    monkeypatch.setattr("kcam.inputs._code", lambda *given: pytest.fail("a remedy for what is right"))
    counts = []
    for call in (
        lambda: check_signal(cube(1)),
        lambda: check_bands(cube(1), name="image", count=28, ndims=(4,), sure=False),
        lambda: check_picture(cube(1, 3), name="image"),
        lambda: KC.RandomExposure(p=1.0)(cube(1, 3)),
    ):
        read.clear()
        call()
        counts.append(len(read))
    assert counts == [0, 0, 1, 1]


# ---- distances ---------------------------------------------------------------------------------------------------


def draws(seed: int) -> tuple[torch.Generator, int, int, int]:
    generator = torch.Generator().manual_seed(seed)
    batch, height, width = (int(n) for n in torch.randint(2, 6, (3,), generator=generator))
    return generator, batch, height + 4, width + 10


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64, torch.int64])
def test_distances_of_every_shape_are_a_number_one_per_sample_or_a_map(dtype: torch.dtype, seed: int) -> None:
    generator, batch, height, width = draws(seed)
    image = torch.rand(batch, 3, height, width, generator=generator)
    each = (1 + 9 * torch.rand(batch, generator=generator)).to(dtype)
    for given in (each, each[:, None], each[:, None, None], each[:, None, None, None]):
        for depth in (given, given.numpy()):
            kept = Scene.from_rgb(image, depth=depth).depth
            assert kept.shape == (batch,)
            assert kept.dtype == torch.float64
            assert torch.equal(kept, each.double())
    assert torch.equal(Scene.from_rgb(image, depth=each.tolist()).depth, each.double())
    per_pixel = (1 + 9 * torch.rand(batch, 1, height, width, generator=generator)).to(dtype)
    same = per_pixel[:1]
    maps = {
        per_pixel: per_pixel,
        per_pixel[:, 0]: per_pixel,
        same: same,
        same[0]: same,
        same[0, 0]: same,
    }
    for given, expected in maps.items():
        for depth in (given, given.numpy(), given.numpy()[..., ::-1][..., ::-1]):
            kept = Scene.from_rgb(image, depth=depth).depth
            assert kept.shape == (batch, 1, height, width)
            assert torch.equal(kept, expected.float().expand_as(kept))
    for number in (each[0], each[:1], each[:1, None], float(each[0]), each[0].numpy()):
        assert Scene.from_rgb(image, depth=number).depth == float(each[0])


def test_as_many_samples_as_rows() -> None:
    """(B,) is one per sample, and (H,W) a map, whatever else they could be."""
    image = torch.rand(3, 3, 3, 3)
    numbers = torch.tensor([1.0, 2.0, 3.0])
    assert Scene.from_rgb(image, depth=numbers).depth.shape == (3,)
    assert Scene.from_rgb(image, depth=numbers.expand(3, 3)).depth.shape == (3, 1, 3, 3)
    column = Scene.from_rgb(image[..., :1], depth=numbers[:, None])  # a map of three rows and one column
    assert torch.equal(column.depth, numbers[:, None].expand(3, 1, 3, 1))
    single = Scene.from_rgb(image[:1], depth=numbers[:1]).depth
    assert isinstance(single, float)


@pytest.mark.parametrize(
    ("depth", "error", "message"),
    [
        (torch.ones(3), ValueError, r"3 numbers stand for 3 pictures, not for 2."),
        ([1.0, 2.0, 3.0], ValueError, r"expected a number, \(2,\) for one per sample"),
        (torch.ones(8, 6), ValueError, r"Rows come first: use depth.mT."),
        (torch.ones(2, 8, 6), ValueError, r"Rows come first: use depth.mT."),
        (torch.ones(6, 8, 1), ValueError, r"Use depth\[..., 0\]."),
        (torch.ones(6, 8, 3), ValueError, r"Use depth\[..., 0\]."),
        (torch.ones(1, 1, 12, 16), ValueError, r"another size use torch.nn.functional.interpolate\(depth.reshape"),
        (torch.ones(3, 1, 6, 8), ValueError, r"depth has shape \(3, 1, 6, 8\), expected .* or \(2, 1, 6, 8\)"),
        (torch.tensor([1.0, 0.0]), ValueError, "depth 0 is not a distance in front of the lens"),
        ([1.0, -2.0], ValueError, "depth -2 is not a distance"),
        (np.array([1.0, np.nan]), ValueError, "depth nan is not a distance"),
        (torch.tensor([1.0, 1e-9]), ValueError, "depth 1e-09 is too near"),
        (torch.ones(2, dtype=torch.complex64), TypeError, "got a tensor .2,. of torch.complex64"),
        (torch.ones(2, dtype=torch.bool), TypeError, "got a tensor .2,. of torch.bool"),
        ("2 m", TypeError, r"got str '2 m'. Use depth=2.0"),
        (["near", "far"], TypeError, r"got a list of 2 \(str\)"),
        ([torch.ones((), requires_grad=True)] * 2, TypeError, r"Use torch.stack\(depth\)"),
        (None, TypeError, "got NoneType None"),
        (torch.ones(0), ValueError, r"0 numbers stand for 0 pictures"),
    ],
)
def test_distances_that_cannot_be(depth: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        Scene.from_rgb(torch.rand(2, 3, 6, 8), depth=depth)


def test_the_code_for_a_map_of_another_size_makes_one() -> None:
    depth, image = 1 + torch.rand(2, 1, 12, 16), torch.rand(2, 3, 6, 8)
    with pytest.raises(ValueError) as caught:
        Scene.from_rgb(image, depth=depth)
    code = re.findall(r"use (.+?)\.(?: |$)", str(caught.value))[-1]
    assert Scene.from_rgb(image, depth=eval(code, {"torch": torch, "depth": depth})).depth.shape == (2, 1, 6, 8)


@pytest.mark.parametrize("seed", range(3))
def test_one_distance_per_sample_is_each_sample_alone(seed: int) -> None:
    """Pictures to 1e-6 and gradients, among them those onto the distances; some distances are equal."""
    generator, batch, height, width = draws(seed)
    image = torch.rand(batch, 3, height, width, generator=generator, dtype=torch.float64)
    distances = (0.5 + 4 * torch.rand(batch, generator=generator)).double()
    distances[-1] = distances[0]
    stage = imaging().changed(psf_shape=None)  # each sample has its own window
    with torch.no_grad():
        ends = torch.cat([distances[:-1], torch.tensor([torch.inf], dtype=torch.float64)])
        for depth in (distances, ends):
            together = stage(Scene.from_rgb(image, depth=depth))
            alone = torch.cat(
                [stage(Scene.from_rgb(one[None], depth=float(z))) for one, z in zip(image, depth, strict=True)]
            )
            assert (together - alone).abs().max() < 1e-6 * alone.max()
    leaf = distances.clone().requires_grad_()
    light = image.clone().requires_grad_()
    weight = torch.rand(alone.shape, generator=generator, dtype=torch.float64)
    (stage(Scene.from_rgb(light, depth=leaf)) * weight).sum().backward()
    for row in range(batch):
        own, seen = distances[row].clone().requires_grad_(), image[row : row + 1].clone().requires_grad_()
        (stage(Scene.from_rgb(seen, depth=own)) * weight[row : row + 1]).sum().backward()
        torch.testing.assert_close(leaf.grad[row], own.grad, rtol=1e-6, atol=1e-9)
        torch.testing.assert_close(light.grad[row : row + 1], seen.grad, rtol=1e-6, atol=1e-9)


def test_gradients_onto_distances_are_difference_quotients() -> None:
    stage = imaging().changed(psf_shape=(7, 7), samples=256)
    image = torch.rand(3, 3, 6, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    depth = torch.tensor([0.8, 1.7, 0.8], dtype=torch.float64, requires_grad=True)
    weight = torch.rand(3, 28, 6, 8, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda z: (stage(Scene.from_rgb(image, depth=z)) * weight).sum(), depth)


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")  # torch's own, from its dual numbers
def test_samples_share_a_psf_only_where_no_derivative_is_asked_for() -> None:
    image, depth = torch.rand(3, 3, 6, 8), torch.tensor([0.8, 2.0, 0.8])

    def groups(distances: Tensor) -> list[list[int]]:
        return [rows.tolist() for rows in alike(Scene.from_rgb(image, depth=distances))]

    assert groups(depth) == [[0, 2], [1]]
    assert groups(depth.clone().requires_grad_()) == [[0], [1], [2]]
    with forward_ad.dual_level():
        assert groups(forward_ad.make_dual(depth, torch.ones(3))) == [[0], [1], [2]]
    assert groups(torch.tensor(0.8)) == [[0, 1, 2]]


def test_equal_distances_share_a_psf(monkeypatch: pytest.MonkeyPatch) -> None:
    stage, asked = imaging(), []
    bank = optics.Imaging._grouped_bank

    def counted(self: optics.Imaging, wavelengths: Tensor, **how: Any) -> Tensor:
        asked.append(how["points"].vergences.numel())
        return bank(self, wavelengths, **how)

    monkeypatch.setattr(optics.Imaging, "_grouped_bank", counted)
    image = torch.rand(6, 3, 8, 12)
    depth = torch.tensor([1.0, 2.0, 1.0, 3.0, 2.0, 1.0])
    with torch.no_grad():
        stage(Scene.from_rgb(image, depth=depth))
        assert asked == [1, 1, 1]
        assert len(stage.depth_layers(depth.double(), Scene.from_rgb(image).wavelengths)) == 3
    work = stage.work(Scene.from_rgb(image, depth=depth)).operations
    assert work["psf"] == 3 * stage.work(Scene.from_rgb(image, depth=1.0)).operations["psf"]


def test_one_distance_per_sample_goes_where_the_scene_goes() -> None:
    image = torch.rand(3, 3, 20, 24, generator=torch.Generator().manual_seed(0))
    depth = torch.tensor([1.0, 2.0, 3.0], requires_grad=True)
    scene = Scene.from_rgb(image, depth=depth)
    for derived in (
        scene.crop(top=2, left=3, height=5, width=6),
        scene.resized(12),
        scene.resized((8, 20)),
        scene.low_rank(2),
        scene.to(dtype=torch.float64),
        scene.with_depth(depth),
        Scene.from_rgb(image).with_depth(depth),
        Scene.from_bands(scene.bands(), depth=depth),
    ):
        assert torch.equal(derived.depth, depth.double())
        assert torch.equal(torch.autograd.grad(derived.depth.sum(), depth)[0], torch.ones(3))
    assert "depth 1..3 m" in repr(scene)
    assert "depth map" in repr(Scene.from_rgb(image[:0], depth=torch.ones(0)))
    assert imaging()(Scene.from_rgb(image[:0], depth=torch.ones(0))).shape == (0, 28, 20, 24)


def test_a_plan_for_one_distance_per_sample_keeps_its_tolerance() -> None:
    image = torch.rand(3, 3, 20, 24, generator=torch.Generator().manual_seed(0))
    scene = Scene.from_rgb(image, depth=[0.4, 2.0, 5.0])
    camera = small_camera().noiseless()
    with torch.no_grad():
        plan = camera.plan(scene, tolerance=0.05)
        ours, truth = plan.apply(camera).raw(scene), camera.raw(scene)
    for one, other in zip(ours, truth, strict=True):
        assert (one - other).square().mean().sqrt() <= 0.05 * other.square().mean().sqrt()


@pytest.mark.parametrize("seed", range(3))
def test_augmentations_take_one_vergence_per_sample(seed: int) -> None:
    generator, batch, height, width = draws(seed)
    image = torch.rand(batch, 3, height, width, generator=generator)
    each = 0.2 + 2 * torch.rand(batch, generator=generator)
    expected = each[:, None, None, None].expand(batch, 1, height, width)
    for augment in (KC.RandomDefocus(p=1.0, **LENS), KC.RandomCamera([Camera.ideal()], tolerance=0)):
        torch.manual_seed(seed)
        truth = augment(image, inverse_depth=expected)
        for given in (each, each[:, None], each[:, None, None, None], each.tolist(), each.numpy()):
            torch.manual_seed(seed)
            assert torch.equal(augment(image, inverse_depth=given), truth)
        with pytest.raises(ValueError, match=r"inverse_depth has shape \(7,\).* in 1/m"):
            augment(image, inverse_depth=torch.ones(7))
        with pytest.raises(ValueError, match=r"values from -1 to .* expected finite ones >= 0"):
            augment(image, inverse_depth=-torch.ones(batch))
    half = KC.RandomDefocus(p=0.5, **LENS)  # only some rows are drawn
    torch.manual_seed(3)
    some = half(image, inverse_depth=expected)
    torch.manual_seed(3)
    assert torch.equal(half(image, inverse_depth=each), some)


def test_imaging_takes_one_distance_of_a_plain_tensor() -> None:
    lens = imaging().lens
    assert optics.Imaging(lens, distance=torch.tensor(2.0)).distance == 2.0
    with pytest.raises(
        TypeError, match=r"distance must be one number of metres, got a tensor \(2,\).*Scene.from_bands"
    ):
        optics.Imaging(lens, distance=torch.tensor([1.0, 2.0]))


# ---- lenses of a batch, and the rest of what was tried by hand ------------------------------------------------------

LENSES = {"radii": 1 * mm, "wavelengths": [550e-9], "sensor_distance": 0.05, "pixel_pitch": 4 * um, "shape": (9, 9)}


def test_lenses_of_a_batch_in_lists_and_arrays() -> None:
    truth = optics.batch_psf(torch.tensor([0.0, 0.3]), **LENSES)
    for given in ([0.0, 0.3], np.array([0.0, 0.3])):
        torch.testing.assert_close(optics.batch_psf(given, **LENSES), truth, rtol=1e-5, atol=1e-7)
    for radii in ([1 * mm, 1 * mm], np.full(2, 1 * mm), torch.tensor([1 * mm], dtype=torch.float64)):
        found = optics.batch_psf([0.0, 0.3], **LENSES | {"radii": radii})
        torch.testing.assert_close(found, truth, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(
    ("vergences", "changes", "error", "message"),
    [
        (0.0, {}, ValueError, r"must be finite, \(B,\).*Use torch.tensor\(\[0.0\]\)"),
        (torch.tensor(0.0), {}, ValueError, r"must be finite, \(B,\).*Use torch.tensor\(\[0.0\]\)"),
        ([0.0, np.nan], {}, ValueError, "vergences must be finite"),
        ("far", {}, TypeError, "vergences must be .* got str 'far'"),
        ([0.0, 1.0], {"radii": torch.full((3,), 1e-3)}, ValueError, r"radii must be a number or \(2,\), one per lens"),
        ([0.0, 1.0], {"sensor_distance": [0.05] * 3}, ValueError, r"sensor_distance must be a number or \(2,\)"),
        ([0.0, 1.0], {"shape": 9}, ValueError, r"two positive integers \(H, W\) in pixels, got 9"),
        ([0.0, 1.0], {"coefficients": [0.0, 1e-7]}, ValueError, r"coefficients must be \(B, K\) with B = 2"),
    ],
)
def test_lenses_that_cannot_be(vergences: Any, changes: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        optics.batch_psf(vergences, **LENSES | changes)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda x: Camera.ideal()([Scene.from_rgb(x)]), TypeError, r"\[camera\(scene\) for scene in scenes\]"),
        (lambda x: plots.write_picture("a.png", x[0]), TypeError, "path must be .* The picture comes first"),
        (lambda x: Scene.from_rgb(x.to_sparse()), TypeError, r"a sparse tensor .* Use image.to_dense\(\)"),
        (lambda x: Scene.from_rgb(x).crop(top=0.5, left=0, height=4, width=4), TypeError, "of whole pixels, got 4 x 4"),
        (lambda x: Scene.from_rgb(x).low_rank(1.5), ValueError, "got 1.5. Use a whole number such as rank=3"),
        (lambda x: style.paint(style.StyleLoss(torch.rand(3, 64, 64), content=0), shape=256), TypeError, "shape=.256"),
        (lambda x: style.fit(a_style(), Camera.ideal()), TypeError, "got StyleLoss and Camera. Use fit.camera"),
    ],
)
def test_what_was_tried_by_hand(call: Callable[[Tensor], Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        call(torch.rand(2, 3, 9, 12))


def test_a_scene_is_converted_as_a_tensor_is() -> None:
    assert Scene.from_rgb(torch.rand(3, 4, 5)).to(torch.float64).dtype == torch.float64
