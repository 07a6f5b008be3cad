"""`CameraSequential`: channels that change, contexts, depth, and what cannot stand in it."""

from __future__ import annotations

import copy
import pickle
import random
import threading
from typing import Any

import kornia.augmentation as K
import pytest
import torch
from augmented_cases import BY_NAME, LENS, SIZE, picture
from torch import Tensor, nn

import kcam.augmentation as KC
from kcam import Scene, isp, optics, sensor
from kcam.srgb import to_code
from kcam.units import mm, um

SQUARE = (20, 28)  # even, so that a flip moves every pixel


def imaging(**arguments: Any) -> optics.Imaging:
    lens = optics.Lens(
        optics.CircularAperture(diameter=3 * mm), optics.ThinLens(focal_length=8 * mm), focus_distance=2.0
    )
    return optics.Imaging(lens, pixel_pitch=10 * um, psf_shape=(11, 11), **arguments)


def defocus(**arguments: Any) -> KC.RandomDefocus:
    fixed = {"focus": 2.0, "f_number": 2.0, "distance": 2.0, "p": 1.0}
    return KC.RandomDefocus(**{**LENS, **fixed, **arguments})


def step_depth(batch: int) -> Tensor:
    """Inverse depth that is near at the top left and far elsewhere, so that flips and crops are seen."""
    depth = torch.full((batch, 1, *SQUARE), 0.5)
    depth[..., : SQUARE[0] // 2, : SQUARE[1] // 2] = 4.0
    return depth


def params_of(sequence: nn.Module) -> Any:
    return copy.deepcopy(sequence._params)


class Fold(nn.Module):
    """Two channels to one, which Kornia cannot know."""

    def forward(self, x: Tensor) -> Tensor:
        return x.unflatten(1, (-1, 2)).mean(2)


class SaidFold(Fold):
    def output_channels(self, channels: int) -> int:
        return channels // 2


class TestChannels:
    def chain(self, **arguments: Any) -> KC.CameraSequential:
        return KC.CameraSequential(
            imaging(),
            sensor.ColourFilter.kodak(),
            sensor.Mosaic("RGGB"),
            K.RandomGaussianNoise(std=0.02, p=1.0),
            isp.Demosaic(),
            isp.WhiteBalance(),
            isp.ColourMatrix(),
            isp.ToneCurve(),
            K.RandomJPEG(p=1.0),
            **arguments,
        )

    def test_28_to_1_to_3(self) -> None:
        sequence = self.chain(data_keys=["input"])
        cube = picture(2, 28, *SQUARE)
        y = sequence(cube)
        assert y.shape == (2, 3, *SQUARE)
        noise = next(item.data for item in sequence._params if "RandomGaussianNoise" in item.name)
        assert noise["gaussian_noise"].shape == (2, 1, *SQUARE)
        assert torch.equal(sequence(cube, params=params_of(sequence)), y)
        assert sequence.output_channels(28) == 3

    def test_kornias_own_container_cannot(self) -> None:
        # Why CameraSequential is: the noise is drawn for 28 channels and meets a mosaic of one.
        stages = [sensor.ColourFilter.kodak(), sensor.Mosaic("RGGB"), K.RandomGaussianNoise(p=1.0)]
        assert K.AugmentationSequential(*stages, data_keys=["input"])(picture(1, 28, *SQUARE)).shape[1] == 28
        assert KC.CameraSequential(*stages, data_keys=["input"])(picture(1, 28, *SQUARE)).shape[1] == 1

    def test_equals_the_stages_one_by_one(self) -> None:
        stages = [sensor.ColourFilter.kodak(), sensor.Mosaic("GBRG"), isp.Demosaic(), isp.ToneCurve()]
        sequence = KC.CameraSequential(*stages, data_keys=["input"])
        x = picture(2, 28, *SQUARE)
        context = sequence.context()
        expected = x
        for stage in stages:
            expected = stage(expected, context)
        assert torch.equal(sequence(x), expected)

    def test_stages_alone_in_a_plain_sequential(self) -> None:
        plain = nn.Sequential(imaging(), sensor.ColourFilter.kodak(), sensor.Mosaic("RGGB"), isp.Demosaic())
        assert plain(picture(1, 28, *SQUARE)).shape == (1, 3, *SQUARE)

    @pytest.mark.parametrize("p", [1.0, 0.5])
    def test_random_stages_between(self, p: float) -> None:
        sequence = KC.CameraSequential(
            KC.RandomVignetting(p=p),
            sensor.ColourFilter.kodak(),
            KC.RandomShotReadNoise(p=p),
            sensor.Mosaic("RGGB"),
            KC.RandomFixedPattern(p=p),
            K.RandomGaussianNoise(p=p),
            isp.Demosaic(),
            isp.ToneCurve(),
            KC.RandomToneCurve(p=p),
            K.RandomRotation(10.0, p=p),
            data_keys=["input", "mask"],
            depth=False,
        )
        x, mask = picture(4, 28, *SQUARE), (picture(4, 1, *SQUARE) > 0.4).float()
        y, moved = sequence(x, mask)
        assert y.shape == (4, 3, *SQUARE)
        again = sequence(x, mask, params=params_of(sequence))
        assert torch.equal(again[0], y)
        assert torch.equal(again[1], moved)

    @pytest.mark.parametrize("outer", [K.AugmentationSequential, KC.CameraSequential])
    def test_nested(self, outer: type) -> None:
        sequence = outer(
            K.RandomHorizontalFlip(p=0.5), self.chain(), K.RandomGaussianNoise(p=1.0), data_keys=["input", "mask"]
        )
        x, mask = picture(3, 28, *SQUARE), picture(3, 1, *SQUARE)
        if outer is KC.CameraSequential:
            y, moved = sequence(x, mask)
            assert y.shape == (3, 3, *SQUARE)
            again = sequence(x, mask, params=params_of(sequence))
            assert torch.equal(again[0], y)
            assert torch.equal(again[1], moved)
        else:  # Kornia's outer container draws its last noise for 28 channels and cannot know better
            with pytest.raises(RuntimeError, match="must match"):
                sequence(x, mask)

    def test_nested_last(self) -> None:
        sequence = K.AugmentationSequential(K.RandomHorizontalFlip(p=0.5), self.chain(), data_keys=["input", "mask"])
        x, mask = picture(3, 28, *SQUARE), picture(3, 1, *SQUARE)
        y, moved = sequence(x, mask)
        assert y.shape == (3, 3, *SQUARE)
        again = sequence(x, mask, params=params_of(sequence))
        assert torch.equal(again[0], y)
        assert torch.equal(again[1], moved)

    def test_channels_of_augmentations(self) -> None:
        for name in ("bayer", "camera"):
            sequence = KC.CameraSequential(
                BY_NAME[name](p=1.0), K.RandomGaussianNoise(p=1.0), K.RandomJPEG(p=1.0), data_keys=["input"]
            )
            x = picture(2, 28, *SQUARE)
            y = sequence(x)
            assert y.shape == (2, 3, *SQUARE)
            assert torch.equal(sequence(x, params=params_of(sequence)), y)

    def test_a_module_must_say_its_channels(self) -> None:
        x = picture(1, 4, *SQUARE)
        with pytest.raises(ValueError, match=r"Fold gave 2 channels for 4.*output_channels\(channels\) that returns 2"):
            KC.CameraSequential(Fold(), K.RandomGaussianNoise(p=1.0))(x)
        assert KC.CameraSequential(SaidFold(), K.RandomGaussianNoise(p=1.0))(x).shape == (1, 2, *SQUARE)

    def test_crop_then_stages(self) -> None:
        sequence = KC.CameraSequential(
            K.RandomCrop((12, 16)), sensor.ColourFilter.kodak(), K.RandomGaussianNoise(p=1.0), data_keys=["input"]
        )
        x = picture(2, 28, *SQUARE)
        y = sequence(x)
        assert y.shape == (2, 3, 12, 16)
        assert torch.equal(sequence(x, params=params_of(sequence)), y)

    def test_keepdim_and_empty(self) -> None:
        chain = self.chain(data_keys=["input"], keepdim=True)
        assert chain(picture(28, *SQUARE)).shape == (3, *SQUARE)
        mosaic = KC.CameraSequential(sensor.Mosaic("RGGB"), KC.RandomExposure(p=1.0), isp.Demosaic(), keepdim=True)
        assert mosaic(picture(3, *SQUARE)).shape == (3, *SQUARE)
        flat = KC.CameraSequential(sensor.ReadNoise(3.0), KC.RandomExposure(p=1.0), keepdim=True)
        assert flat(picture(*SQUARE)).shape == SQUARE
        small = KC.CameraSequential(sensor.ColourFilter.kodak(), sensor.Mosaic("RGGB"), isp.Demosaic())
        assert small(torch.zeros(0, 28, *SQUARE)).shape == (0, 3, *SQUARE)

    def test_gradients(self) -> None:
        x = picture(1, 28, *SQUARE).requires_grad_()
        self.chain(data_keys=["input"])(x).sum().backward()
        assert x.grad is not None
        assert x.grad.isfinite().all()
        assert x.grad.abs().max() > 0

    def test_seed_copies(self) -> None:
        chain = self.chain(data_keys=["input"])
        x = picture(2, 28, *SQUARE)
        torch.manual_seed(0)
        y = chain(x)
        for twin in (copy.deepcopy(chain), pickle.loads(pickle.dumps(chain))):
            torch.manual_seed(0)
            assert torch.equal(twin(x), y)
            assert twin.transform_op.owner[0] is twin

    def test_what_users_write(self) -> None:
        sequence = KC.CameraSequential(
            imaging(),
            sensor.ColourFilter.kodak(),
            sensor.Mosaic("RGGB"),
            K.RandomGaussianNoise(),
            isp.Demosaic(),
            K.RandomJPEG(),
            data_keys=["input"],
        )
        assert sequence(picture(2, 28, *SQUARE)).shape == (2, 3, *SQUARE)


class TestContext:
    def test_the_mosaic_tells_the_demosaic(self) -> None:
        sequence = KC.CameraSequential(sensor.Mosaic("GRBG"), isp.Demosaic(), data_keys=["input"])
        x = picture(1, 3, *SQUARE)
        expected = isp.demosaic(sensor.mosaic(x, pattern="GRBG"), pattern="GRBG")
        assert torch.equal(sequence(x), expected)
        wrong = isp.demosaic(sensor.mosaic(x, pattern="GRBG"), pattern="RGGB")
        assert (expected - wrong).abs().max() > 0.05

    def test_across_nested_containers(self) -> None:
        inner = K.ImageSequential(K.RandomGaussianNoise(p=0.0))
        sequence = KC.CameraSequential(sensor.Mosaic("BGGR"), inner, isp.Demosaic(), data_keys=["input"])
        x = picture(1, 3, *SQUARE)
        assert torch.equal(sequence(x), isp.demosaic(sensor.mosaic(x, pattern="BGGR"), pattern="BGGR"))

    def test_a_contradiction(self) -> None:
        with pytest.raises(ValueError, match="contradict each other: Mosaic.*GRBG.*Demosaic.*RGGB"):
            KC.CameraSequential(sensor.Mosaic("GRBG"), isp.Demosaic(pattern="RGGB"))

    def test_an_impossible_order(self) -> None:
        with pytest.raises(ValueError, match="Mosaic stands after Demosaic"):
            KC.CameraSequential(isp.Demosaic(), sensor.Mosaic("RGGB"))

    @pytest.mark.parametrize(
        "geometry", [lambda: K.RandomHorizontalFlip(), lambda: K.RandomCrop((8, 8)), lambda: KC.RandomLensDistortion()]
    )
    def test_geometry_after_a_mosaic(self, geometry: Any) -> None:
        with pytest.raises(ValueError, match="between Mosaic and the demosaic.*before Mosaic or after the Demosaic"):
            KC.CameraSequential(sensor.Mosaic("RGGB"), geometry(), isp.Demosaic())
        with pytest.raises(ValueError, match="between Mosaic and the demosaic"):
            KC.CameraSequential(sensor.Mosaic("RGGB"), K.ImageSequential(geometry()), isp.Demosaic())
        KC.CameraSequential(geometry(), sensor.Mosaic("RGGB"), isp.Demosaic(), geometry())

    def test_geometry_after_a_tile(self) -> None:
        with pytest.raises(ValueError, match="between ColourFilter and the demosaic"):
            KC.CameraSequential(sensor.ColourFilter.learned(tile=4), K.RandomVerticalFlip())
        KC.CameraSequential(sensor.ColourFilter.kodak(), K.RandomVerticalFlip())

    def test_random_apply(self) -> None:
        with pytest.raises(ValueError, match="random_apply would shuffle camera stages"):
            KC.CameraSequential(sensor.Mosaic("RGGB"), isp.Demosaic(), random_apply=1)
        one = KC.CameraSequential(KC.RandomExposure(p=1.0), KC.RandomVignetting(p=1.0), random_apply=1)
        assert one(picture(2, 3, *SQUARE)).shape == (2, 3, *SQUARE)


class TestDepth:
    def test_flipped_and_cropped(self) -> None:
        x, depth = picture(2, 3, *SQUARE), step_depth(2)
        sequence = KC.CameraSequential(
            K.RandomHorizontalFlip(p=1.0), K.CenterCrop((16, 20)), defocus(), data_keys=["input", "mask"]
        )
        y, moved = sequence(x, depth)
        flipped = depth.flip(-1)[..., 2:18, 4:24]
        assert torch.equal(moved, flipped)
        expected = defocus()(x.flip(-1)[..., 2:18, 4:24], inverse_depth=flipped)
        torch.testing.assert_close(y, expected, atol=1e-6, rtol=0)
        unmoved = defocus()(x.flip(-1)[..., 2:18, 4:24], inverse_depth=depth[..., 2:18, 4:24])
        assert (y - unmoved).abs().max() > 0.02  # what the test would miss without moving depth
        again = sequence(x, depth, params=params_of(sequence))
        assert torch.equal(again[0], y)

    def test_params_do_not_keep_the_map(self) -> None:
        sequence = KC.CameraSequential(defocus(), data_keys=["input", "mask"])
        first = len(pickle.dumps(sequence._params))
        sequence(picture(2, 3, *SQUARE), step_depth(2))
        assert len(pickle.dumps(sequence._params)) - first < 4000  # the map alone is 4480 bytes

    def test_replay_with_another_map(self) -> None:
        # The map is an input, not a drawn number: a replay sees the map that it is given.
        sequence = KC.CameraSequential(defocus(), data_keys=["input", "mask"])
        x = picture(2, 3, *SQUARE)
        sequence(x, step_depth(2))
        y, _ = sequence(x, torch.full((2, 1, *SQUARE), 0.5), params=params_of(sequence))
        expected = defocus()(x, inverse_depth=torch.full((2, 1, *SQUARE), 0.5))
        torch.testing.assert_close(y, expected, atol=1e-6, rtol=0)

    @pytest.mark.parametrize("p", [0.5, 0.0])
    def test_some_rows(self, p: float) -> None:
        sequence = KC.CameraSequential(defocus(p=p), data_keys=["input", "mask"])
        x = picture(6, 3, *SQUARE)
        torch.manual_seed(0)
        y, moved = sequence(x, step_depth(6))
        drawn = sequence._params[0].data["batch_prob"] > 0.5
        assert torch.equal(y[~drawn], x[~drawn])
        assert torch.equal(moved, step_depth(6))
        expected = defocus()(x, inverse_depth=step_depth(6))
        torch.testing.assert_close(y[drawn], expected[drawn], atol=1e-6, rtol=0)

    def test_no_depth(self) -> None:
        x, mask = picture(2, 3, *SQUARE), torch.randint(0, 20, (2, 1, *SQUARE)).float()
        expected = defocus(distance=0.5)(x)
        sequence = KC.CameraSequential(defocus(distance=0.5), data_keys=["input", "mask"], depth=False)
        y, kept = sequence(x, mask)
        torch.testing.assert_close(y, expected, atol=1e-6, rtol=0)
        assert torch.equal(kept, mask)

    def test_second_mask_by_place(self) -> None:
        x, depth, classes = picture(2, 3, *SQUARE), step_depth(2), torch.full((2, 1, *SQUARE), 1.0)
        expected = defocus()(x, inverse_depth=depth)
        sequence = KC.CameraSequential(defocus(), data_keys=["input", "mask", "mask"], depth_key=2)
        torch.testing.assert_close(sequence(x, classes, depth)[0], expected, atol=1e-6, rtol=0)

    def test_by_name(self) -> None:
        x, depth, classes = picture(2, 3, *SQUARE), step_depth(2), torch.full((2, 1, *SQUARE), 1.0)
        sequence = KC.CameraSequential(K.RandomHorizontalFlip(p=1.0), defocus(), data_keys=None, depth_key="mask_depth")
        for order in (("image", "mask", "mask_depth"), ("image", "name", "mask_depth", "mask")):
            given = {"image": x, "mask": classes, "mask_depth": depth, "name": "a picture"}
            out = sequence({key: given[key] for key in order})
            expected = defocus()(x.flip(-1), inverse_depth=depth.flip(-1))
            torch.testing.assert_close(out["image"], expected, atol=1e-6, rtol=0)
            assert torch.equal(out["mask_depth"], depth.flip(-1))

    def test_a_dict_without_a_key(self) -> None:
        x, depth = picture(2, 3, *SQUARE), step_depth(2)
        out = KC.CameraSequential(defocus(), data_keys=None)({"image": x, "mask_depth": depth})
        torch.testing.assert_close(out["image"], defocus()(x, inverse_depth=depth), atol=1e-6, rtol=0)

    @pytest.mark.parametrize("key", [0, 2, "mask_depth", "depth"])
    def test_a_wrong_key(self, key: int | str) -> None:
        sequence = KC.CameraSequential(defocus(), data_keys=["input", "mask"], depth_key=key)
        with pytest.raises(ValueError, match=rf"depth_key={key!r} is none of the masks of this call.*at \[1\]"):
            sequence(picture(2, 3, *SQUARE), step_depth(2))

    def test_a_wrong_name(self) -> None:
        sequence = KC.CameraSequential(defocus(), data_keys=None, depth_key="mask_z")
        with pytest.raises(ValueError, match="depth_key='mask_z' is none of the masks"):
            sequence({"image": picture(2, 3, *SQUARE), "mask_depth": step_depth(2)})

    def test_a_list_of_masks(self) -> None:
        sequence = KC.CameraSequential(defocus(), data_keys=["input", "mask"])
        with pytest.raises(TypeError, match=r"list of masks of different sizes; expected one tensor \(B,1,H,W\)"):
            sequence(picture(2, 3, *SQUARE), list(step_depth(2)))

    def test_metres_by_mistake_are_not_caught_but_negative_is(self) -> None:
        sequence = KC.CameraSequential(defocus(), data_keys=["input", "mask"])
        with pytest.raises(ValueError, match="expected finite ones >= 0"):
            sequence(picture(2, 3, *SQUARE), -step_depth(2))

    def test_imaging_sees_it(self) -> None:
        x, depth = picture(1, 28, *SQUARE), step_depth(1)
        stage = imaging()
        sequence = KC.CameraSequential(K.RandomHorizontalFlip(p=1.0), stage, data_keys=["input", "mask"])
        y, _ = sequence(x, depth)
        expected = stage(Scene.from_bands(x.flip(-1), depth=1 / depth.flip(-1)))
        torch.testing.assert_close(y, expected, atol=1e-6, rtol=0)
        plane = KC.CameraSequential(K.RandomHorizontalFlip(p=1.0), stage, data_keys=["input", "mask"], depth=False)
        assert (plane(x, depth)[0] - y).abs().max() > 0.02

    def test_camera_sees_it(self) -> None:
        x, depth = picture(2, 3, *SQUARE), step_depth(2)
        augment = BY_NAME["camera"](p=1.0)
        sequence = KC.CameraSequential(augment, data_keys=["input", "mask"])
        torch.manual_seed(0)
        y, _ = sequence(x, depth)
        torch.manual_seed(0)
        assert torch.equal(augment(x, inverse_depth=depth), y)

    def test_keypoints_and_boxes_go_along(self) -> None:
        x, depth = picture(2, 3, *SQUARE), step_depth(2)
        sequence = KC.CameraSequential(
            K.RandomHorizontalFlip(p=1.0), defocus(), data_keys=["input", "mask", "keypoints", "bbox_xyxy"]
        )
        points = torch.tensor([[[3.0, 4.0]]]).repeat(2, 1, 1)
        boxes = torch.tensor([[[2.0, 3.0, 8.0, 9.0]]]).repeat(2, 1, 1)
        _, _, moved, moved_boxes = sequence(x, depth, points, boxes)
        assert moved[0, 0].tolist() == [SQUARE[1] - 1 - 3, 4]
        assert moved_boxes.shape == boxes.shape

    def test_keepdim(self) -> None:
        sequence = KC.CameraSequential(defocus(), data_keys=["input", "mask"], keepdim=True)
        y, mask = sequence(picture(3, *SQUARE), step_depth(1)[0])
        assert y.shape == (3, *SQUARE)
        assert mask.shape == (1, *SQUARE)

    def test_one_odd_size(self) -> None:
        sequence = KC.CameraSequential(defocus(), data_keys=["input", "mask"])
        assert sequence(picture(), picture(2, 1, *SIZE))[0].shape == (2, 3, *SIZE)


# ---- neighbours that take light ------------------------------------------------------------------------------------


def neighbours(seed: int, *, p: float, keepdim: bool = False) -> list[nn.Module]:
    """Two to five augmentations, some on coded pictures; without steps or photons, which would show a rounding."""
    draw = random.Random(seed)
    kinds = [KC.RandomExposure, KC.RandomWhiteBalance, KC.RandomVignetting, KC.RandomDefocus, KC.RandomToneCurve,
             KC.RandomColourMatrix, KC.RandomLensDistortion]  # fmt: skip
    drawn = [kind(p=p, keepdim=keepdim) for kind in draw.choices(kinds, k=draw.randint(2, 5))]
    drawn.insert(draw.randint(0, len(drawn)), nn.Identity())  # what is no augmentation, Kornia calls by itself
    return drawn


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("p", [1.0, 0.5])
def test_light_that_is_kept_gives_the_same_picture(seed: int, p: float) -> None:
    """As Kornia's container, which codes the picture behind each; rows that nobody drew keep every bit."""
    generator = torch.Generator().manual_seed(seed)
    shape = [(4, 3, 24, 40), (3, 24, 40), (2, 1, 24, 24), (1, 3, 33, 17)][seed % 4]
    picture = torch.rand(shape, generator=generator, dtype=[torch.float32, torch.float64][seed % 2])
    pipeline = neighbours(seed, p=p, keepdim=seed % 3 == 0)
    torch.manual_seed(seed)
    expected = K.AugmentationSequential(*pipeline)(picture)
    torch.manual_seed(seed)
    ours = KC.CameraSequential(*pipeline)
    found = ours(picture)
    assert (found.shape, found.dtype) == (expected.shape, expected.dtype)
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-6)
    gates = [torch.atleast_1d(param.data["batch_prob"]) < 0.5 for param in ours._params if param.data is not None]
    idle = torch.stack(gates).all(0)
    batch = picture if picture.ndim == 4 else picture[None]
    assert torch.equal((found if found.ndim == 4 else found[None])[idle], batch[idle])
    torch.testing.assert_close(ours(picture, params=ours._params), found, rtol=0, atol=0)  # a replay
    if picture.ndim == 4:
        nested = K.AugmentationSequential(ours)
        torch.manual_seed(seed)
        torch.testing.assert_close(nested(picture), found, rtol=0, atol=2e-6)


def test_light_is_kept_from_one_to_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    """Coded once behind three neighbours, and on both sides of a flip."""
    coded: list[Tensor] = []

    def count(light: Tensor) -> Tensor:
        coded.append(light)
        return to_code(light)

    for module in ("base", "sequential"):
        monkeypatch.setattr(f"kcam.augmentation.{module}.to_code", count)
    stages = KC.RandomExposure(p=1.0), KC.RandomWhiteBalance(p=1.0), KC.RandomVignetting(p=1.0)
    KC.CameraSequential(*stages)(torch.rand(2, 3, 16, 16))
    assert len(coded) == 1
    KC.CameraSequential(stages[0], stages[1], K.RandomHorizontalFlip(), stages[2])(torch.rand(2, 3, 16, 16))
    assert len(coded) == 3


def test_gradients_through_light_that_is_kept() -> None:
    picture = torch.rand(2, 3, 12, 12, dtype=torch.float64, requires_grad=True)
    pipeline = KC.RandomExposure((-1.0, 0.0), p=1.0), KC.RandomVignetting(p=1.0), KC.RandomWhiteBalance(p=0.5)
    found = []
    for container in (KC.CameraSequential, K.AugmentationSequential):
        torch.manual_seed(5)
        found.append(torch.autograd.grad(container(*pipeline)(picture).square().sum(), picture)[0])
    torch.testing.assert_close(*found)


def test_pictures_out_of_range_are_refused_where_light_is_kept() -> None:
    pipeline = KC.CameraSequential(KC.RandomExposure(p=1.0), KC.RandomVignetting(p=1.0))
    with pytest.raises(ValueError, match="expected sRGB in"):
        pipeline(255 * torch.rand(1, 3, 8, 8))
    torch.testing.assert_close(pipeline(torch.zeros(1, 3, 8, 8)), torch.zeros(1, 3, 8, 8))  # and what follows is right


class Raising(KC.CameraAugmentation):
    """An effect of somebody's own that fails."""

    def __init__(self) -> None:
        super().__init__({}, p=1.0)

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        raise RuntimeError("no light today")


class Gray(Raising):
    """One whose result has less memory than it has pixels."""

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        return signal.mean(1, keepdim=True).expand_as(signal)


def test_a_stage_or_a_module_before_neighbours_changes_nothing_about_them() -> None:
    exposure, vignetting = KC.RandomExposure(stops=0.5, p=1.0), KC.RandomVignetting(p=1.0, field=60.0, shade=0.2)
    other = KC.RandomVignetting(p=1.0, field=50.0, shade=0.1)
    x = torch.rand(2, 3, 12, 12)
    for modules in ([nn.Identity(), exposure, vignetting], [sensor.ADC(8), exposure, vignetting],
                    [exposure, nn.Identity(), vignetting, other]):  # fmt: skip
        expected = x
        for module in modules:
            expected = module(expected)
        torch.testing.assert_close(KC.CameraSequential(*modules)(x), expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("shape", [(0, 3, 8, 8), (2, 3, 0, 8)])
def test_nothing_in_neighbours_gives_nothing(shape: tuple[int, ...]) -> None:
    assert KC.CameraSequential(KC.RandomExposure(p=1.0), KC.RandomVignetting(p=1.0))(torch.rand(shape)).shape == shape


def test_light_belongs_to_a_call() -> None:
    """Threads get their own pictures, and after an error nothing is left that a copy would take along."""
    stages = KC.RandomExposure(stops=0.5, p=1.0), KC.RandomVignetting(p=1.0, field=60.0, shade=0.2)
    pipeline, found = KC.CameraSequential(*stages), {}
    pictures = [torch.rand(2, 3, 48, 48, generator=torch.Generator().manual_seed(seed)) for seed in range(8)]
    threads = [
        threading.Thread(target=lambda i=i, x=x: found.update({i: pipeline(x)})) for i, x in enumerate(pictures)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for index, x in enumerate(pictures):
        torch.testing.assert_close(found[index], stages[1](stages[0](x)), rtol=0, atol=2e-6)
    failing = KC.CameraSequential(stages[0], Raising())
    with pytest.raises(RuntimeError, match="no light today"):
        failing(torch.rand(1, 3, 8, 8, requires_grad=True))
    copy.deepcopy(failing)
    assert len(pickle.dumps(failing)) < 100_000


def test_a_result_of_ones_own_is_not_written_to() -> None:
    assert KC.CameraSequential(Gray(), KC.RandomExposure(p=1.0))(torch.rand(1, 3, 8, 8)).isfinite().all()


def test_a_child_of_neighbours_is_replayed_alone() -> None:
    exposure = KC.RandomExposure(p=1.0)
    x = torch.rand(2, 3, 8, 8)
    KC.CameraSequential(exposure, KC.RandomVignetting(p=1.0))(x)
    drawn = {name: exposure._params[name] for name in ("stops", "batch_prob", "forward_input_shape")}
    assert torch.equal(exposure(x, params=exposure._params), exposure(x, params=drawn))
