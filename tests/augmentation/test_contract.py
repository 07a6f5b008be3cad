"""What every augmentation keeps to, over the table in `cases`."""

from __future__ import annotations

import copy
import io
import math
import pickle
from collections.abc import Callable
from typing import Any

import kornia.augmentation as K
import numpy as np
import pytest
import torch
from augmented_cases import BY_NAME, CASES, LENS, SIZE, Case, Pictures, picture, pipeline
from PIL import Image
from torch import Tensor, nn
from torch.utils.data import DataLoader

import kcam.augmentation as KC
from kcam import Camera


def table(wanted: Callable[[Case], bool] = lambda case: True) -> pytest.MarkDecorator:
    """Rows of the table for which something holds, as the parameter `case`."""
    rows = [case for case in CASES if wanted(case)]
    return pytest.mark.parametrize("case", [pytest.param(case, id=case.name, marks=case.marks()) for case in rows])


def table_of_channels() -> pytest.MarkDecorator:
    """Every row with every number of channels that it takes; `make test` tries a slow one with three."""
    rows = [
        pytest.param(case, channels, id=f"{case.name}-{channels}", marks=case.marks() if channels != 3 else [])
        for case in CASES
        for channels in case.channels()
    ]
    return pytest.mark.parametrize(("case", "channels"), rows)


def seeded(module: Callable[..., Any], *inputs: Any, seed: int = 0, **arguments: Any) -> Any:
    torch.manual_seed(seed)
    return module(*inputs, **arguments)


def annotated(batch: int) -> tuple[Tensor, Tensor, Tensor]:
    """A mask, keypoints and boxes for pictures of SIZE."""
    height, width = SIZE
    mask = (picture(batch, 1, height, width, seed=1) > 0.4).float()
    points = torch.tensor([[[3.0, 4.0], [width - 2.5, height - 3.0]]]).expand(batch, -1, -1).clone()
    boxes = torch.tensor([[[2.0, 3.0, 9.0, 12.0]]]).expand(batch, -1, -1).clone()
    return mask, points, boxes


KEYS = ["input", "mask", "keypoints", "bbox_xyxy"]


def test_the_table_has_every_augmentation() -> None:
    public = {getattr(KC, name) for name in KC.__all__ if name.startswith("Random")}
    assert {type(case()) for case in CASES} == public


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_each_refuses_another_scale_and_what_is_not_finite(case: Case) -> None:
    augment = case(p=1.0)
    for wrong, text in (
        (picture() * 255, r"expected sRGB in \[0,1\]. Use image / 255"),
        (picture() - 3, r"expected sRGB in \[0,1\].*normalised by mean"),
        (picture() * torch.nan, "expected finite ones. Remove NaN and inf"),
        (picture().index_fill(0, torch.tensor([1]), torch.inf), "expected finite ones. Remove NaN and inf"),
    ):
        with pytest.raises(ValueError, match=text):
            augment(wrong)


@pytest.mark.parametrize("case", [case for case in CASES if case.geometric and not case.slow], ids=lambda c: c.name)
def test_masks_may_have_any_values(case: Case) -> None:
    pipeline = K.AugmentationSequential(case(p=1.0), data_keys=["input", "mask"])
    mask = torch.full((2, 1, *SIZE), 200.0)
    mask[..., 8:10, 8:12] = torch.nan
    moved = pipeline(picture(), mask)[1]
    assert moved.isnan().any()
    assert moved.nan_to_num(0).max() == 200


class TestShapes:
    @table_of_channels()
    def test_shape_and_type(self, case: Case, channels: int, device: torch.device) -> None:
        x = picture(2, channels, *SIZE).to(device)
        before = x.clone()
        y = case(p=1.0)(x)
        assert y.shape == (2, case.channels_after(channels), *SIZE)
        assert y.dtype == x.dtype
        assert y.device == x.device
        assert y.isfinite().all()
        assert torch.equal(x, before)
        if case.changes_gray or channels > 1:
            assert not torch.equal(y, x)

    @table()
    @pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64], ids=str)
    def test_types(self, case: Case, dtype: torch.dtype) -> None:
        augment = case(p=1.0)
        x = picture(dtype=dtype)
        y = seeded(augment, x)
        assert y.dtype == dtype
        assert y.isfinite().all()
        if not case.rough:
            # Twice the rounding of input and output: half of eps each, times a slope of the tone curve up to 4.
            expected = seeded(augment, x.double())
            torch.testing.assert_close(y.double(), expected, atol=4 * torch.finfo(dtype).eps + 1e-12, rtol=0)

    @table()
    @pytest.mark.parametrize("shape", [(16, 9), (1, 13), (1, 1)], ids=str)
    def test_sizes(self, case: Case, shape: tuple[int, int]) -> None:
        for channels in case.channels():
            y = case(p=1.0)(picture(2, channels, *shape))
            assert y.shape == (2, case.channels_after(channels), *shape)
            assert y.isfinite().all()

    @table()
    def test_strides_do_not_matter(self, case: Case) -> None:
        x = picture().transpose(-1, -2)
        augment = case(p=1.0)
        torch.testing.assert_close(seeded(augment, x), seeded(augment, x.contiguous()), atol=1e-6, rtol=0)

    @table()
    @pytest.mark.parametrize("p", [1.0, 0.5])
    def test_channels_last_in_channels_last_out(self, case: Case, p: float) -> None:
        x, augment = picture(4, 3, *SIZE), case(p=p)
        y = seeded(augment, x.contiguous(memory_format=torch.channels_last))
        assert y.is_contiguous(memory_format=torch.channels_last)
        torch.testing.assert_close(y, seeded(augment, x), atol=1e-6, rtol=0)

    @table(lambda case: case.cubes)
    def test_cubes_far_above_white_and_below_black(self, case: Case) -> None:
        assert case(p=1.0)(picture(2, 28, *SIZE) * 50 - 10).isfinite().all()

    @table(lambda case: case.name != "camera")
    def test_odd_size_with_the_defaults(self, case: Case) -> None:
        y = case.build(p=1.0, **case.fixed)(picture(1, 3, 33, 47))
        assert y.shape == (1, 3, 33, 47)
        assert y.isfinite().all()

    @table_of_channels()
    @pytest.mark.parametrize("p", [1.0, 0.5])
    def test_empty_batch(self, case: Case, channels: int, p: float) -> None:
        after = case.channels_after(channels)
        if p < 1 and after != channels:
            pytest.skip("needs p = 1")
        x = torch.zeros(0, channels, *SIZE, requires_grad=True)
        y = case(p=p)(x)
        assert y.shape == (0, after, *SIZE)
        y.sum().backward()
        assert x.grad is not None

    @table()
    def test_keepdim(self, case: Case) -> None:
        for channels in case.channels():
            x = picture(channels, *SIZE)
            after = case.channels_after(channels)
            kept = case(p=1.0, keepdim=True)
            y = seeded(kept, x)
            assert y.shape == (after, *SIZE)
            batched = seeded(case(p=1.0), x)
            assert batched.shape == (1, after, *SIZE)
            assert torch.equal(batched[0], y)
            if channels == after == 1:
                flat = seeded(kept, x[0])
                assert flat.shape == SIZE
                assert torch.equal(flat, y[0])

    @table(lambda case: case.cube_to_picture)
    def test_a_cube_needs_all_rows(self, case: Case) -> None:
        cube = picture(2, 28, *SIZE)
        with pytest.raises(ValueError, match=r"turns 28 channels into 3.*Use p=1\.0, not p=0\.5"):
            case(p=0.5)(cube)
        with pytest.raises(ValueError, match=r"Use p=1\.0"):
            K.AugmentationSequential(case(p=0.5), data_keys=["input"])(cube)

    @table(lambda case: case.gray_to_picture)
    def test_a_gray_picture_needs_all_rows(self, case: Case) -> None:
        with pytest.raises(ValueError, match=r"turns 1 channels into 3.*Use p=1\.0"):
            case(p=0.5)(picture(2, 1, *SIZE))

    @table(lambda case: not case.cubes)
    def test_refuses_cubes(self, case: Case) -> None:
        with pytest.raises(ValueError, match="got 28 channels"):
            case(p=1.0)(picture(2, 28, *SIZE))


class TestReplay:
    @table_of_channels()
    def test_bare(self, case: Case, channels: int) -> None:
        augment = case(p=1.0)
        x = picture(3, channels, *SIZE)
        y = augment(x)
        params = copy.deepcopy(augment._params)
        augment(x)  # another draw in between
        assert torch.equal(augment(x, params=params), y)

    @table()
    def test_some_rows(self, case: Case) -> None:
        augment = case(p=0.5)
        x = picture(6, 3, *SIZE)
        y = seeded(augment, x)
        assert torch.equal(augment(x, params=augment._params), y)

    CONTAINERS = {  # noqa: RUF012
        "augmentation": lambda *stages: K.AugmentationSequential(*stages, data_keys=KEYS),
        "camera": lambda *stages: KC.CameraSequential(*stages, data_keys=KEYS, depth=False),
        "image in augmentation": lambda *stages: K.AugmentationSequential(K.ImageSequential(*stages), data_keys=KEYS),
        "camera in augmentation": lambda *stages: K.AugmentationSequential(
            KC.CameraSequential(*stages), data_keys=KEYS
        ),
        "augmentation in camera": lambda *stages: KC.CameraSequential(
            K.AugmentationSequential(*stages), data_keys=KEYS, depth=False
        ),
    }

    @table()
    @pytest.mark.parametrize("container", CONTAINERS)
    def test_in_containers(self, case: Case, container: str) -> None:
        # A flip before and Kornia's own noise after: both draw, and neither may disturb the other.
        sequence = self.CONTAINERS[container](
            K.RandomHorizontalFlip(p=0.5), case(p=1.0 if case.name == "bayer" else 0.7), K.RandomGaussianNoise(p=0.5)
        )
        inputs = (picture(3, 3, *SIZE), *annotated(3))
        first = seeded(sequence, *inputs)
        params = sequence._params
        seeded(sequence, *inputs, seed=1)
        again = sequence(*inputs, params=params)
        for one, other in zip(first, again, strict=True):
            assert torch.equal(one, other)

    @table_of_channels()
    def test_in_image_sequential(self, case: Case, channels: int) -> None:
        # K.RandomGaussianNoise draws a field of the shape that the container believes in: after 28 -> 3 it must be 3.
        stages: list[nn.Module] = [case(p=1.0), K.RandomGaussianNoise(p=1.0, std=0.1)]
        x = picture(2, channels, *SIZE)
        for sequence in (K.ImageSequential(*stages), K.ImageSequential(K.ImageSequential(*stages))):
            y = sequence(x)
            assert y.shape == (2, case.channels_after(channels), *SIZE)
            assert torch.equal(sequence(x, params=sequence._params), y)

    @table()
    def test_later_stages_cannot_break_it(self, case: Case) -> None:
        alone = K.AugmentationSequential(case(p=1.0), data_keys=["input"])
        x = picture()
        y = seeded(alone, x)
        followed = K.AugmentationSequential(
            case(p=1.0), K.RandomGaussianNoise(p=1.0), K.RandomRotation(20.0, p=1.0), data_keys=["input"]
        )
        seeded(followed, x)
        own = followed._params[0].data
        followed._params = None
        assert torch.equal(followed[0](x, params=own), y)

    @table()
    def test_a_seed_decides(self, case: Case) -> None:
        augment = case(p=0.5)
        x = picture(4, 3, *SIZE)
        y = seeded(augment, x)
        assert torch.equal(seeded(case(p=0.5), x), y)
        assert torch.equal(seeded(augment, x), y)
        assert any(not torch.equal(seeded(augment, x, seed=seed), y) for seed in (1, 2, 3))


class TestRows:
    @table()
    def test_same_on_batch(self, case: Case) -> None:
        x = picture(1, 3, *SIZE).expand(3, -1, -1, -1)
        same = case(p=1.0, same_on_batch=True)(x)
        # The rows of one FFT need not round alike: 1e-6 is some ten roundings of float32; a quantised step is larger.
        torch.testing.assert_close(same, same[:1].expand_as(same), atol=1e-6, rtol=0)
        if case.name == "x_trans":
            return  # one pattern only, nothing is drawn
        several = seeded(case(p=1.0), picture(1, 3, *SIZE).expand(8, -1, -1, -1))
        assert (several - several[:1]).abs().max() > 1e-4

    @table(lambda case: case.cubes)
    def test_same_on_batch_for_cubes(self, case: Case) -> None:
        same = case(p=1.0, same_on_batch=True)(picture(1, 28, *SIZE).expand(2, -1, -1, -1))
        torch.testing.assert_close(same[:1], same[1:], atol=1e-6, rtol=0)

    @table()
    def test_p_0_is_the_identity(self, case: Case) -> None:
        x = picture(3, 3, *SIZE) * 3 - 1  # also outside of 0..1
        assert torch.equal(case(p=0.0)(x), x)
        mask, points, boxes = annotated(3)
        outputs = K.AugmentationSequential(case(p=0.0), data_keys=KEYS)(x, mask, points, boxes)
        for one, other in zip(outputs, (x, mask, points, boxes), strict=True):
            assert torch.equal(one, other)

    @table()
    def test_rows_that_were_not_drawn(self, case: Case) -> None:
        x = picture(6, 3, *SIZE)
        augment = case(p=0.5)
        y = seeded(augment, x)
        drawn = augment._params["batch_prob"] > 0.5
        assert 0 < drawn.sum() < 6  # else the seed above tells nothing
        assert torch.equal(y[~drawn], x[~drawn])
        assert (y[drawn] != x[drawn]).flatten(1).any(1).all()
        # Each drawn row with its own numbers, not with those of the row at its place among the drawn ones.
        every = case(p=1.0)(x, params=augment._params | {"batch_prob": torch.ones(6)})
        torch.testing.assert_close(y[drawn], every[drawn], atol=1e-6, rtol=0)  # FFTs of other batch sizes

    @table()
    def test_rows_do_not_see_each_other(self, case: Case) -> None:
        augment = case(p=1.0)
        x = picture(3, 3, *SIZE)
        y = augment(x)
        params = augment._params
        brighter = torch.cat([x[:1], x[1:] * 0.5])
        torch.testing.assert_close(augment(brighter, params=params)[:1], y[:1], atol=1e-6, rtol=0)


class TestGradients:
    @table_of_channels()
    def test_to_the_input(self, case: Case, channels: int) -> None:
        x = picture(2, channels, *SIZE).requires_grad_()
        case(p=1.0)(x).square().sum().backward()
        assert x.grad is not None
        assert x.grad.isfinite().all()
        assert (x.grad.flatten(1) != 0).any(1).all()

    @table()
    def test_at_black_white_and_beyond(self, case: Case) -> None:
        x = torch.tensor([0.0, 1.0, -0.5, 2.0]).repeat_interleave(2)[:, None, None, None].repeat(1, 3, *SIZE)
        x.requires_grad_()
        y = seeded(case(p=0.5), x)
        y.sum().backward()
        assert y.isfinite().all()
        assert x.grad is not None
        assert x.grad.isfinite().all()

    RANGES = [(case, name) for case in CASES for name in case.ranges]  # noqa: RUF012

    @pytest.mark.parametrize(("case", "name"), RANGES, ids=[f"{case.name}-{name}" for case, name in RANGES])
    def test_ranges_train(self, case: Case, name: str) -> None:
        # 3 steps of 1e-3 of the bounds down the slope of a loss under one seed, which then is smaller.
        x = picture(dtype=torch.float64)
        bounds = nn.Parameter(torch.tensor(case.ranges[name], dtype=torch.float64))
        augment = case(p=1.0, **{name: bounds})
        assert any(parameter is bounds for parameter in augment.parameters())

        def loss() -> Tensor:
            return (seeded(augment, x) - x).square().mean()

        losses = []
        scale = bounds.detach().abs().max()
        for _ in range(3):
            bounds.grad = None
            value = loss()
            value.backward()
            losses.append(float(value.detach()))
            assert bounds.grad is not None
            assert bounds.grad.isfinite().all()
            assert (bounds.grad != 0).all()
            with torch.no_grad():
                bounds -= 1e-3 * scale * bounds.grad / bounds.grad.abs().max()
        if not case.rough:  # Poisson noise moves in steps: its slope is that of the mean
            assert float(loss().detach()) < losses[-1] < losses[0]

    SMOOTH = [(case, name) for case, name in RANGES if not case.rough]  # noqa: RUF012

    @pytest.mark.parametrize(("case", "name"), SMOOTH, ids=[f"{case.name}-{name}" for case, name in SMOOTH])
    def test_slope_of_a_range(self, case: Case, name: str) -> None:
        x = picture(dtype=torch.float64)

        def loss(low: float | Tensor, high: float | Tensor) -> Tensor:
            pair = torch.stack([torch.as_tensor(low, dtype=torch.float64), torch.as_tensor(high, dtype=torch.float64)])
            augment = case(p=1.0, **{name: nn.Parameter(pair)})
            value = (seeded(augment, x) - x).square().mean()
            value.backward()
            parameter: Tensor = next(augment.parameters())
            return torch.stack([value.detach(), *parameter.grad])

        low, high = case.ranges[name]
        step = 1e-5
        _, *slopes = loss(low, high).tolist()
        for slope, one, other, size in (
            (slopes[0], (low * (1 + step), high), (low * (1 - step), high), low),
            (slopes[1], (low, high * (1 + step)), (low, high * (1 - step)), high),
        ):
            quotient = float(loss(*one)[0] - loss(*other)[0]) / (2 * step * size)
            # Central differences in float64: 1e-10 of curvature, 1e-16 / 1e-5 of rounding on a loss of 1e-2, against
            # slopes down to 1e-6: 1e-5 of them; kinks of a bilinear pixel or a clip that is crossed, 1e-3.
            assert slope == pytest.approx(quotient, rel=2e-3)

    def test_trained_out_of_its_limits(self) -> None:
        bounds = nn.Parameter(torch.tensor([0.5, 1.0]))
        augment = KC.RandomVignetting(field=30.0, shade=bounds, p=1.0)
        with torch.no_grad():
            bounds += 0.5
        with pytest.raises(ValueError, match=r"shade was trained or loaded to \(1, 1\.5\), outside 0 <= low"):
            augment(picture())

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16], ids=str)
    def test_limits_in_other_types(self, dtype: torch.dtype) -> None:
        # 0.49 rounds to more than the 0.49 that is allowed, and 0.2 too.
        bounds = nn.Parameter(torch.tensor([-0.49, 0.49], dtype=dtype))
        for augment in (KC.RandomToneCurve(contrast=bounds, p=1.0), KC.RandomToneCurve(contrast=(0.1, 0.49), p=1.0)):
            assert augment.to(dtype)(picture()).isfinite().all()
        assert KC.RandomChromaticAberration(lateral=0.2, p=1.0, **LENS).to(dtype)(picture()).isfinite().all()

    def test_loaded_bounds_count(self) -> None:
        # Kornia's own samplers keep the old range (#4428)
        source = KC.RandomExposure(stops=(-2.0, -2.0), p=1.0)
        target = KC.RandomExposure(stops=(1.0, 1.0), p=1.0)
        target.load_state_dict(source.state_dict())
        x = picture()
        assert torch.equal(target(x), source(x))


class TestDataKeys:
    @table(lambda case: not case.geometric)
    def test_intensity_leaves_the_rest(self, case: Case) -> None:
        sequence = K.AugmentationSequential(case(p=1.0), data_keys=KEYS)
        mask, points, boxes = annotated(2)
        _, *rest = sequence(picture(), mask, points, boxes)
        for one, other in zip(rest, (mask, points, boxes), strict=True):
            assert torch.equal(one, other)

    @pytest.mark.parametrize(
        "arguments",
        [{"k1": (-0.25, -0.15)}, {"k1": (0.15, 0.3)}, {"k1": -0.1, "p1": (-0.02, 0.02), "p2": (-0.02, 0.02)}],
        ids=["barrel", "pincushion", "decentred"],
    )
    @pytest.mark.parametrize("p", [1.0, 0.5])
    def test_lens_distortion_moves_all(self, arguments: dict[str, Any], p: float) -> None:
        height, width, batch, spread = 48, 64, 6, 1.5
        y, x = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
        points = torch.tensor([[12.0, 10.0], [50.0, 12.0], [14.0, 36.0], [33.0, 25.0]])
        blobs = torch.exp(
            -((x - points[:, 0, None, None]) ** 2 + (y - points[:, 1, None, None]) ** 2) / (2 * spread**2)
        )
        sequence = K.AugmentationSequential(KC.RandomLensDistortion(**arguments, p=p), data_keys=KEYS)
        images = blobs.expand(batch, -1, -1, -1)  # one blob for each channel: 4 is a cube
        mask = (blobs.sum(0, keepdim=True) > 0.2).float().expand(batch, 1, -1, -1)
        boxes = torch.cat([points - 4, points + 4], 1).expand(batch, -1, -1)
        image, moved_mask, moved, moved_boxes = seeded(
            sequence, images, mask, points.expand(batch, -1, -1).clone(), boxes.clone()
        )
        drawn = sequence._params[0].data["batch_prob"] > 0.5
        light = image.sum((-2, -1))
        centroid = torch.stack([(image * x).sum((-2, -1)), (image * y).sum((-2, -1))], -1) / light[..., None]
        assert (centroid - moved).norm(dim=-1).max() < 0.5
        assert set(moved_mask.unique().tolist()) <= {0.0, 1.0}
        # The blobs of 0.2 and more are the mask: nearest against bilinear, up to half a pixel along their edges.
        inside = image.amax(1, keepdim=True)
        assert moved_mask[inside > 0.45].min() == 1
        assert inside[moved_mask > 0].min() > 0.05
        centre = (moved_boxes[..., :2] + moved_boxes[..., 2:]) / 2
        # A box of 8 pixels bends by less than half of one about its moved centre.
        assert (centre - moved).norm(dim=-1).max() < 0.5
        displacement = (moved - points).norm(dim=-1).amax(1)
        assert (displacement[drawn] > 0.3).all()  # so that nothing that stands still would pass
        assert (displacement[~drawn] == 0).all()
        assert torch.equal(image[~drawn], images[~drawn])
        assert torch.equal(moved_boxes[~drawn], boxes[~drawn])
        assert torch.equal(moved_mask[~drawn], mask[~drawn])
        assert (p < 1) == bool((~drawn).any())

    def test_lens_distortion_has_an_inverse(self) -> None:
        y, x = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
        image = (0.5 + 0.25 * torch.sin(x * torch.pi / 8) + 0.25 * torch.sin(y * torch.pi / 8)).expand(4, 3, -1, -1)
        augment = KC.RandomLensDistortion(k1=(-0.3, -0.2), p=0.5)
        distorted = seeded(augment, image)
        drawn = augment._params["batch_prob"] > 0.5
        assert 0 < drawn.sum() < 4
        back = augment.inverse(distorted)
        assert torch.equal(back[~drawn], image[~drawn])
        # Two bilinear interpolations, each off by up to 1/8 of the second difference, 0.25 (pi / 8)^2, in each axis.
        assert (back - image).abs()[..., 8:-8, 8:-8].max() < 4 * 0.25 * (torch.pi / 8) ** 2 / 8
        assert (distorted - image)[drawn].abs()[..., 8:-8, 8:-8].amax((1, 2, 3)).min() > 0.1

    def test_inverse_of_points_and_boxes(self) -> None:
        sequence = K.AugmentationSequential(KC.RandomLensDistortion(k1=(-0.25, -0.2), p=0.5), data_keys=KEYS)
        points = torch.tensor([[5.0, 6.0], [60.0, 40.0]]).repeat(4, 1, 1)
        boxes = torch.tensor([[4.0, 5.0, 12.0, 14.0]]).repeat(4, 1, 1)
        image = picture(4, 3, 48, 64)
        out = seeded(sequence, image, image[:, :1], points, boxes)
        drawn = sequence._params[0].data["batch_prob"] > 0.5
        assert (out[2] - points)[drawn].abs().max() > 1
        _, _, back, boxes_back = sequence.inverse(*out)
        torch.testing.assert_close(back, points, atol=1e-3, rtol=0)
        # The box around a bent box holds it, and no more than the bend of its edges, here some tenths of a pixel.
        grown = torch.cat([boxes[..., :2] - boxes_back[..., :2], boxes_back[..., 2:] - boxes[..., 2:]], -1)
        assert grown.min() > -1e-3
        assert grown.max() < 0.5
        assert torch.equal(back[~drawn], points[~drawn])

    def test_lens_distortion_no_points(self) -> None:
        sequence = K.AugmentationSequential(KC.RandomLensDistortion(p=1.0), data_keys=["input", "keypoints"])
        _, points = sequence(picture(), torch.zeros(2, 0, 2))
        assert points.shape == (2, 0, 2)


class TestCopies:
    @table()
    def test_pickle_and_deepcopy(self, case: Case) -> None:
        augment = case(p=0.7)
        x = picture(4, 3, *SIZE)
        y = seeded(augment, x)
        params = augment._params
        for twin in (copy.deepcopy(augment), pickle.loads(pickle.dumps(augment))):
            assert torch.equal(seeded(twin, x), y)
            assert torch.equal(twin(x, params=params), y)

    @table()
    def test_size_of_a_pickle(self, case: Case) -> None:
        # Seeds are kept, not fields, and a plan or a PSF for one size of picture stays behind.
        augment = case(p=1.0)
        augment(picture(2, 3, 8, 8))
        small = len(pickle.dumps(augment))
        augment(picture(2, 3, 40, 40))
        assert len(pickle.dumps(augment)) - small < 500  # bytes: a field of it would be 38 400

    @table()
    def test_state_dict(self, case: Case) -> None:
        augment, buffer = case(), io.BytesIO()
        torch.save(augment.state_dict(), buffer)
        buffer.seek(0)
        case().load_state_dict(torch.load(buffer))

    @table()
    def test_building_draws_nothing(self, case: Case) -> None:
        before = torch.get_rng_state()
        case.build(**{**case.fixed, "p": 0.25})
        assert torch.equal(torch.get_rng_state(), before)

    @pytest.mark.parametrize("cameras", [["phone"], ["thesis"], ["phone", "thesis", "ideal"]], ids=str)
    def test_building_cameras_draws_nothing(self, cameras: list[str]) -> None:
        before = torch.get_rng_state()
        KC.RandomCamera(cameras=cameras)
        assert torch.equal(torch.get_rng_state(), before)

    def test_planning_draws_nothing_of_the_stream(self) -> None:
        # The first picture of a size is planned for; the second is not: both must leave the stream at the same place.
        states = []
        augment = BY_NAME["camera"].build(p=1.0, tolerance=0.02)
        pictures = []
        for _ in range(2):
            pictures.append(seeded(augment, picture(1, 3, 12, 12)))
            states.append(torch.get_rng_state())
        assert torch.equal(*states)
        assert torch.equal(*pictures)
        twin = pickle.loads(pickle.dumps(augment))  # which plans again
        assert torch.equal(seeded(twin, picture(1, 3, 12, 12)), pictures[0])

    @table()
    def test_repr(self, case: Case) -> None:
        text = repr(case(p=0.25))
        assert "p=0.25" in text
        for name, (low, high) in case.ranges.items():
            assert f"{name}=({low:g}, {high:g})" in text

    @pytest.mark.slow  # two new interpreters, which each import torch and kornia: some 15 s
    def test_workers(self) -> None:
        def batches(seed: int, workers: int = 2) -> list[Tensor]:
            loader = DataLoader(
                Pictures(pipeline(), count=8),
                batch_size=2,
                num_workers=workers,
                multiprocessing_context="spawn" if workers else None,
                generator=torch.Generator().manual_seed(seed),
            )
            return list(loader)

        first, again = batches(0), batches(0)
        for one, other in zip(first, again, strict=True):
            assert torch.equal(one, other)
        rows = torch.cat(first)  # of one and the same picture
        assert rows.shape == (8, 3, *SIZE)
        for index in range(1, 8):
            assert not torch.equal(rows[0], rows[index])


class Compose:
    """What every framework has."""

    def __init__(self, *stages: Callable[[Tensor], Tensor]) -> None:
        self.stages = stages

    def __call__(self, x: Tensor) -> Tensor:
        for stage in self.stages:
            x = stage(x)
        return x


class TestGuests:
    @table()
    def test_five_line_compose(self, case: Case) -> None:
        compose = Compose(torch.nn.Identity(), case(p=1.0, keepdim=True), lambda x: x.clamp(0, 1))
        assert compose(picture(3, *SIZE)).shape == (3, *SIZE)

    def test_torchvision(self) -> None:
        transforms = pytest.importorskip("torchvision.transforms.v2")
        compose = transforms.Compose([case(p=1.0, keepdim=True) for case in CASES])
        assert compose(picture(3, *SIZE)).shape == (3, *SIZE)

    @table()
    def test_numpy_and_pil(self, case: Case) -> None:
        pixels = (picture(*SIZE, 3) * 255).to(torch.uint8).numpy()
        x = torch.tensor(pixels).permute(2, 0, 1)[None].double() / 255
        for container in (
            K.ImageSequential(case(p=1.0)),
            K.AugmentationSequential(case(p=1.0), data_keys=["input"]),
            KC.CameraSequential(case(p=1.0)),
        ):
            for guest in (pixels, Image.fromarray(pixels), pixels.astype(np.float32) / 255):
                y = seeded(container, guest)
                assert isinstance(y, Tensor)
                expected = seeded(case(p=1.0), x.to(y))  # Kornia makes float64 of bytes
                torch.testing.assert_close(y.reshape(expected.shape), expected, atol=1e-6, rtol=0)

    @table()
    def test_autocast(self, case: Case) -> None:
        augment = case(p=1.0)
        x = picture()
        expected = seeded(augment, x)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            y = seeded(augment, x)
        assert y.dtype == x.dtype
        # Computed outside of it: bfloat16 alone would be off by 4e-3.
        torch.testing.assert_close(y, expected, atol=1e-6, rtol=0)

    def test_video(self) -> None:
        frames = picture(2, 1, 3, *SIZE).expand(2, 4, -1, -1, -1)  # B, T: two clips, in which nothing moves
        for name in ("defocus", "lens_distortion", "fixed_pattern", "white_balance", "bayer"):
            sequence = K.VideoSequential(BY_NAME[name](p=1.0), data_format="BTCHW", same_on_frame=True)
            clips = sequence(frames)
            torch.testing.assert_close(clips, clips[:, :1].expand_as(clips), atol=1e-6, rtol=0)
            assert torch.equal(sequence(frames, params=sequence._params), clips)

    @pytest.mark.parametrize("name", ["shot_read_noise", "camera"])
    @pytest.mark.parametrize("same_on_frame", [True, False])
    @pytest.mark.parametrize("p", [1.0, 0.6])
    def test_noise_of_a_video(self, name: str, same_on_frame: bool, p: float) -> None:
        x = picture(1, 1, 3, *SIZE).expand(2, 3, -1, -1, -1)
        augment = BY_NAME[name](p=p)
        sequence = K.VideoSequential(augment, data_format="BTCHW", same_on_frame=same_on_frame)
        clips = seeded(sequence, x)
        assert clips.shape == x.shape
        drawn = (sequence._params[0].data["batch_prob"] > 0.5).view(2, 3)
        frames = [frame for clip, gate in zip(clips, drawn, strict=True) for frame in clip[gate]]
        assert len(frames) > 1
        for index, one in enumerate(frames):
            for other in frames[index + 1 :]:
                assert not torch.equal(one, other)
        assert torch.equal(sequence(x, params=sequence._params), clips)
        if same_on_frame:  # the numbers of a clip are its own; only the noise differs
            drawn_numbers = next(iter(BY_NAME[name].ranges))
            values = sequence._params[0].data[drawn_numbers].view(2, 3)
            assert torch.equal(values, values[:, :1].expand(2, 3))
            assert values[0, 0] != values[1, 0]

    def test_video_and_data_keys(self) -> None:
        sequence = K.AugmentationSequential(
            K.VideoSequential(*(BY_NAME[name](p=1.0) for name in ("lens_distortion", "shot_read_noise"))),
            data_keys=["input", "mask"],
        )
        x = picture(2, 1, 3, *SIZE).expand(2, 3, -1, -1, -1)
        mask = (x[:, :, :1] > 0.4).float()
        clips, masks = sequence(x, mask)
        assert clips.shape == x.shape
        assert torch.equal(masks, masks[:, :1].expand_as(masks))
        assert not torch.equal(masks, mask)
        again = sequence(x, mask, params=sequence._params)
        assert torch.equal(again[0], clips)
        assert torch.equal(again[1], masks)


@pytest.mark.filterwarnings("ignore:.*should not be instantiated:DeprecationWarning")  # torch's own, of its own tracing
class TestCompile:
    @pytest.mark.slow  # 1 to 6 s each; noise and some rows of vignetting: below
    @pytest.mark.parametrize(
        "name",
        [
            "vignetting",
            "exposure",
            "tone_curve",
            "white_balance",
            "lens_distortion",
            "chromatic_aberration",
            "defocus",
        ],
    )
    def test_equals_eager(self, name: str) -> None:
        torch.compiler.reset()
        augment = BY_NAME[name](p=1.0)
        x = picture()
        expected = seeded(augment, x)
        compiled = torch.compile(augment, backend="aot_eager")
        torch.testing.assert_close(seeded(compiled, x), expected, atol=1e-5, rtol=0)

    @pytest.mark.parametrize("name", ["shot_read_noise", pytest.param("fixed_pattern", marks=pytest.mark.slow)])
    def test_noise(self, name: str) -> None:
        torch.compiler.reset()
        compiled = torch.compile(BY_NAME[name](p=1.0), backend="aot_eager")
        x = picture()
        y = compiled(x)
        assert y.isfinite().all()
        assert not torch.equal(y[0] - x[0], y[1] - x[1])

    def test_some_rows(self) -> None:
        torch.compiler.reset()
        augment = BY_NAME["vignetting"](p=0.5)
        x = picture(6, 3, *SIZE)
        expected = seeded(augment, x)
        torch.testing.assert_close(seeded(torch.compile(augment, backend="aot_eager"), x), expected, atol=1e-6, rtol=0)

    @pytest.mark.slow  # 30 s of C++ compiler
    @pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's own, where it imports inductor
    def test_inductor(self) -> None:
        torch.compiler.reset()
        augment = BY_NAME["vignetting"](p=1.0)
        x = picture()
        expected = seeded(augment, x)
        torch.testing.assert_close(seeded(torch.compile(augment), x), expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("build", "error", "text"),
    [
        (lambda: KC.RandomDefocus(focus=(5.0, 0.5)), ValueError, r"focus must be .*low <= high.*got \(5, 0\.5\)"),
        (lambda: KC.RandomDefocus(focus=(0.0, 1.0)), ValueError, r"focus must be .*0\.001 <= low.*got \(0, 1\)"),
        (lambda: KC.RandomDefocus(focus=(float("nan"), 1.0)), ValueError, r"focus must be .*got \(nan, 1\)"),
        (lambda: KC.RandomDefocus(f_number=(0.1, 8.0)), ValueError, r"f_number must be .*0\.5 <= low"),
        (lambda: KC.RandomDefocus(focus=(0.005, 1.0)), ValueError, r"focus 0\.005 m is inside the focal length"),
        (lambda: KC.RandomDefocus(layers=0), ValueError, "layers must be a whole number of 1 or more, got 0"),
        (lambda: KC.RandomDefocus(layers=True), ValueError, "layers must be a whole number"),
        (lambda: KC.RandomDefocus(outside=0.0), ValueError, "outside must be a share of the light.*got 0"),
        (lambda: KC.RandomDefocus(pixel_pitch=4.0), ValueError, "pixel_pitch"),
        (lambda: KC.RandomDefocus(wavelengths=[550.0, 450.0, 650.0]), ValueError, "metres"),
        (lambda: KC.RandomDiffraction(f_number=(8.0, 320.0)), ValueError, "f_number must be .*high <= 200"),
        (lambda: KC.RandomDiffraction(focal_length=50.0), ValueError, "focal_length"),
        (lambda: KC.RandomAberration(rms=-0.1), ValueError, r"rms must be .*\[waves\] with 0 <= low"),
        (lambda: KC.RandomChromaticAberration(lateral=0.5), ValueError, "lateral must be .*high <= 0.2"),
        (lambda: KC.RandomChromaticAberration(glass="butter"), ValueError, "butter"),
        (lambda: KC.RandomLensDistortion(k1=20.0), ValueError, "k1 must be .*high <= 10"),
        (lambda: KC.RandomLensDistortion(focal_length=0.0), ValueError, "focal_length must be > 0"),
        (lambda: KC.RandomVignetting(field=170.0), ValueError, r"field must be .*\[degrees\].*high <= 160"),
        (lambda: KC.RandomVignetting(shade=1.5), ValueError, "shade must be .*high <= 1"),
        (lambda: KC.RandomBayer(pattern="GRRB"), ValueError, "GRRB"),
        (lambda: KC.RandomBayer(method="magic"), ValueError, "magic"),
        (lambda: KC.RandomShotReadNoise(iso=(0.0, 100.0)), ValueError, r"iso must be .*\(100 is base\)"),
        (lambda: KC.RandomShotReadNoise(read_noise=-1.0), ValueError, r"read_noise must be .*\[electrons\]"),
        (lambda: KC.RandomFixedPattern(prnu=-0.1), ValueError, "prnu must be"),
        (lambda: KC.RandomFixedPattern(prnu=(0, 6)), ValueError, r"prnu must be .* share: 0.01 is 1 %.* <= 0.5"),
        (lambda: KC.RandomFixedPattern(full_well=0.0), ValueError, "full_well"),
        (lambda: KC.RandomExposure(stops=(1.0, 2.0, 3.0)), ValueError, r"stops must be .*got shape \(3,\)"),
        (lambda: KC.RandomExposure(stops=nn.Parameter(torch.tensor(1.0))), ValueError, r"parameter must be \(2,\)"),
        (lambda: KC.RandomExposure(stops="bright"), TypeError, "stops must be"),
        (lambda: KC.RandomQuantisation(bits=0), ValueError, r"bits must be whole numbers .*got 0"),
        (lambda: KC.RandomQuantisation(bits=(8, 6)), ValueError, r"bits must be .*got \(8, 6\)"),
        (lambda: KC.RandomQuantisation(bits=(6, 8.5)), ValueError, "bits must be whole numbers"),
        (lambda: KC.RandomWhiteBalance(temperature=500.0), ValueError, r"temperature must be .*\[K\] with 1000 <="),
        (lambda: KC.RandomColourMatrix(strength=-1.0), ValueError, "strength must be"),
        (lambda: KC.RandomToneCurve(contrast=0.6), ValueError, "contrast must be .*high <= 0.49"),
        (lambda: KC.RandomToneCurve(gamma=0.0), ValueError, "gamma must be .*0.1 <= low"),
        (lambda: KC.RandomCamera(cameras=[]), ValueError, "cameras is empty"),
        (lambda: KC.RandomCamera(tolerance=-1), ValueError, "tolerance must be a relative error >= 0.*got -1"),
        (lambda: KC.RandomCamera(tolerance="sharp"), ValueError, 'unknown tolerance "sharp"'),
        (lambda: KC.RandomBayer(pattern=[]), ValueError, "pattern is empty"),
        (lambda: KC.RandomCamera(cameras=["nokia"]), ValueError, "unknown camera 'nokia'. There are: thesis"),
        (lambda: KC.RandomCamera(distance=0.0), ValueError, r"distance must be .*\[m\] with 0.01 <= low"),
    ],
)
def test_errors(build: Callable[[], Any], error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        build()


def test_errors_at_the_call() -> None:
    with pytest.raises(ValueError, match="3 wavelengths do not fit 28 channels"):
        KC.RandomDefocus(wavelengths=[450e-9, 550e-9, 650e-9], p=1.0)(picture(1, 28, 8, 8))
    with pytest.raises(ValueError, match="fold the picture over itself"):
        KC.RandomLensDistortion(k1=-3.0, p=1.0)(picture())
    defocus = KC.RandomDefocus(p=1.0)
    x = picture(2, 3, 8, 8)
    with pytest.raises(ValueError, match=r"inverse_depth has shape \(2, 1, 4, 4\), .* \(2, 1, 8, 8\), .* in 1/m"):
        defocus(x, inverse_depth=torch.ones(2, 1, 4, 4))
    with pytest.raises(ValueError, match=r"values from -1 to -1, expected finite ones >= 0"):
        defocus(x, inverse_depth=-torch.ones(2, 1, 8, 8))
    with pytest.raises(ValueError, match="expected finite ones"):
        defocus(x, inverse_depth=torch.full((2, 1, 8, 8), torch.inf))
    gray = KC.RandomCamera(cameras=[KC.RandomCamera().cameras[0][:6]], p=1.0)
    with pytest.raises(ValueError, match="ends in 1 channels, expected a picture of 3"):
        gray(x)


class TestDepth:
    def test_a_constant_map_is_that_distance(self) -> None:
        for name in ("defocus", "camera"):
            x = picture()
            augment = BY_NAME[name](p=1.0, distance=0.5)
            expected = seeded(augment, x)
            mapped = seeded(augment, x, inverse_depth=torch.full((2, 1, *SIZE), 2.0))
            # A camera ends in an ADC of 10 bits: one step of it where rounding falls the other way.
            torch.testing.assert_close(mapped, expected, atol=1e-5 if name == "defocus" else 5e-3, rtol=0)

    def test_a_map_beyond_the_range_of_distances(self) -> None:
        # The window of the PSFs is that of the map: 35 pixels here, where the range would give 13.
        x = picture(2, 3, 41, 41)
        lens = {"focus": 2.0, "f_number": 2.0, "p": 1.0}
        expected = KC.RandomDefocus(distance=0.3, **lens)(x)
        near = torch.full((2, 1, 41, 41), 1 / 0.3)
        mapped = KC.RandomDefocus(distance=(1.8, 2.2), **lens)(x, inverse_depth=near)
        torch.testing.assert_close(mapped, expected, atol=1e-5, rtol=0)

    def test_a_camera_is_planned_for_maps_beyond_its_range(self) -> None:
        # With a plan for 1.9 to 2.1 m, or for the near one alone, one of these would keep its blur or get none: 0.1 of
        # the range. What is left is noise, which a plan may draw in another order: 1 % of the range on average.
        arguments = {"cameras": ["phone"], "distance": (1.9, 2.1), "p": 1.0}
        planned, exact = (KC.RandomCamera(tolerance=tolerance, **arguments) for tolerance in (0.02, 0))
        x = picture(1, 3, 24, 32)
        for vergence in (0.5, 5.0, 4.0, 0.0):
            depth = torch.full((1, 1, 24, 32), vergence)
            y, expected = (seeded(augment, x, inverse_depth=depth) for augment in (planned, exact))
            assert (y - expected).abs().mean() < 0.02
        assert len(planned._planned) == 3  # of the range, up to 8 and up to 4 per metre: not one for each map

    @pytest.mark.parametrize("tolerance", [0, 0.05])
    def test_nobody_asks_whether_what_was_drawn_far_away_was_in_millimetres(self, tolerance: float) -> None:
        """Warnings are errors here: of a sky in a map, and of distances up to infinity, there were some."""
        x = picture(1, 3, *SIZE)
        for distance in ((400.0, 500.0), (0.5, math.inf), math.inf):
            KC.RandomCamera(distance=distance, tolerance=tolerance, p=1.0)(x)
        camera = KC.RandomCamera(tolerance=tolerance, p=1.0)
        for vergence in (0.0, 1 / 500):
            far = torch.full((1, 1, *SIZE), vergence)
            KC.CameraSequential(camera, data_keys=["input", "mask"])(x, far)
            imaging = Camera.phone()[0]
            KC.CameraSequential(imaging, data_keys=["input", "mask"])(picture(1, 28, *SIZE), far)

    @pytest.mark.parametrize("name", ["defocus", "camera"])
    def test_rows_and_replay(self, name: str) -> None:
        augment = BY_NAME[name](p=0.5)
        x = picture(6, 3, *SIZE)
        depth = picture(6, 1, *SIZE, seed=3) * 3
        y = seeded(augment, x, inverse_depth=depth)
        drawn = augment._params["batch_prob"] > 0.5
        assert 0 < drawn.sum() < 6
        assert torch.equal(y[~drawn], x[~drawn])
        assert torch.equal(augment(x, params=augment._params, inverse_depth=depth), y)

    def test_gradient_to_the_map(self) -> None:
        depth = (picture(2, 1, *SIZE, seed=3) * 3).requires_grad_()
        BY_NAME["defocus"](p=1.0)(picture(), inverse_depth=depth).square().sum().backward()
        assert depth.grad is not None
        assert depth.grad.isfinite().all()
        assert depth.grad.abs().max() > 0


class TestWhatUsersWrite:
    def test_augmentation_sequential(self) -> None:
        augment = K.AugmentationSequential(
            K.RandomHorizontalFlip(p=0.5),
            KC.RandomDefocus(focus=(0.5, 5.0), f_number=(1.8, 8.0), p=0.5),
            KC.RandomChromaticAberration(),
            KC.RandomLensDistortion(),
            KC.RandomVignetting(),
            KC.RandomBayer(pattern="random"),
            KC.RandomShotReadNoise(iso=(100, 3200), p=0.8),
            KC.RandomWhiteBalance(),
            KC.RandomCamera(cameras=["phone"], tolerance=0.02),
            K.RandomJPEG(p=0.3),
            data_keys=["input", "mask", "keypoints", "bbox_xyxy"],
        )
        image, (mask, points, boxes) = picture(4, 3, *SIZE), annotated(4)
        out = augment(image, mask, points, boxes)
        again = augment(image, mask, points, boxes, params=augment._params)
        assert out[0].shape == image.shape
        assert out[0].isfinite().all()
        for one, other in zip(out, again, strict=True):
            assert torch.equal(one, other)

    @pytest.mark.slow  # planning the thesis camera, whose DOE is 891 x 891, takes 6 s
    def test_two_cameras(self) -> None:
        augment = KC.RandomCamera(cameras=["phone", "thesis"], tolerance=0.02)
        x = picture(4, 3, *SIZE)
        y = seeded(augment, x)
        assert set(augment._params["camera"].tolist()) == {0, 1}
        assert y.shape == x.shape
        assert torch.equal(augment(x, params=augment._params), y)


@pytest.mark.parametrize("p", [1.0, 0.5])
def test_large_rows_one_by_one_are_the_batch(p: float, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = [case for case in CASES if getattr(type(case()), "alone", False) and case.cubes]
    assert len(alone) >= 6
    for case in alone:
        for channels in (3, 28):
            x, augment = picture(4, channels, *SIZE), case(p=p)
            whole = seeded(augment, x)
            with monkeypatch.context() as patch:
                patch.setattr("kcam.augmentation.base._LARGE", 1)
                torch.testing.assert_close(seeded(augment, x), whole, atol=1e-6, rtol=0, msg=case.name)
