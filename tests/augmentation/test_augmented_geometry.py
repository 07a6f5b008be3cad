"""Lens distortion is OpenCV's, for points and for pictures; boxes hold what they held; folded pictures are refused."""

from __future__ import annotations

import cv2
import kornia.augmentation as K
import numpy as np
import pytest
import torch
from drawing import augmented, picture
from torch import Tensor

import kcam.augmentation as KC
from kcam.augmentation.geometry import _moved_pixels

SHAPES = pytest.mark.parametrize("shape", [(60, 80), (81, 55)])
LENSES = {
    "barrel": {"k1": -0.2},
    "pincushion": {"k1": 0.3},
    "both": {"k1": -0.25, "k2": 0.1},
    "decentred": {"k1": 0.1, "k2": -0.05, "p1": 0.01, "p2": -0.02},
}
lenses = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)


def opencv(lens: dict[str, float], shape: tuple[int, int], *, focal_length: float = 1.0) -> tuple[np.ndarray, ...]:
    """Camera matrix and coefficients."""
    height, width = shape
    focal = focal_length * max(shape)
    camera = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return camera, np.array([lens.get(name, 0.0) for name in ("k1", "k2", "p1", "p2")])


def smooth(shape: tuple[int, int]) -> Tensor:
    """A picture of waves of 14 pixels and more, on which bilinear weights are good to 3 %."""
    y, x = torch.arange(shape[0], dtype=torch.float64)[:, None], torch.arange(shape[1], dtype=torch.float64)
    waves = [torch.sin(x / 3.1) * torch.cos(y / 2.7), torch.sin((x + y) / 4), torch.cos(x / 5 - y / 3.5)]
    return (0.5 + 0.4 * torch.stack(waves))[None]


def box_around(points: np.ndarray) -> np.ndarray:
    return np.concatenate([points.min(0), points.max(0)])


@SHAPES
@lenses
@pytest.mark.parametrize("focal_length", [1.0, 1.4])
def test_keypoints_go_where_opencv_projects_them(
    lens: dict[str, float], shape: tuple[int, int], focal_length: float
) -> None:
    height, width = shape
    camera, coefficients = opencv(lens, shape, focal_length=focal_length)
    points = picture(1, 50, 2).numpy()[0] * (width - 1, height - 1)
    ideal = np.concatenate([(points - camera[:2, 2]) / camera[0, 0], np.ones((50, 1))], axis=1)
    expected = cv2.projectPoints(ideal, np.zeros(3), np.zeros(3), camera, coefficients)[0][:, 0]
    augment = K.AugmentationSequential(
        KC.RandomLensDistortion(**lens, focal_length=focal_length, p=1.0), data_keys=["input", "keypoints"]
    )
    _, found = augment(torch.zeros(1, 3, *shape, dtype=torch.float64), torch.as_tensor(points)[None])
    assert np.abs(found[0].numpy() - expected).max() < 1e-6  # the same formula; Kornia's container may round to float32


@SHAPES
@lenses
def test_a_picture_is_opencvs_remap(lens: dict[str, float], shape: tuple[int, int]) -> None:
    """Each pixel from where cv2.undistortPoints finds it; inside, bilinear weights of 1/32 pixel in OpenCV."""
    height, width = shape
    camera, coefficients = opencv(lens, shape)
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    distorted = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    source = cv2.undistortPoints(distorted, camera, coefficients, P=camera, criteria=criteria)
    source = source.reshape(height, width, 2).astype(np.float32)
    image = smooth(shape)
    expected = cv2.remap(image[0].permute(1, 2, 0).numpy(), source, None, cv2.INTER_LINEAR)
    found, _ = augmented(KC.RandomLensDistortion(**lens, p=1.0), image)
    inside = np.all((source >= 0) & (source <= (width - 1, height - 1)), axis=-1)
    assert inside.mean() > 0.6
    difference = np.abs(found[0].permute(1, 2, 0).numpy() - expected)[inside]
    # a 64th of a pixel on slopes of up to 0.4 / 2.7 per pixel, in two directions
    assert difference.max() < 2 * 0.4 / 2.7 / 64
    moved = np.linalg.norm(source - np.stack([x, y], axis=-1), axis=-1)
    assert moved.max() > 1


@SHAPES
@lenses
def test_the_inverse_is_opencvs_undistortion_and_gives_the_picture_back(
    lens: dict[str, float], shape: tuple[int, int]
) -> None:
    height, width = shape
    camera, coefficients = opencv(lens, shape)
    image = smooth(shape)
    augmentation = KC.RandomLensDistortion(**lens, p=1.0)
    distorted, _ = augmented(augmentation, image)
    back = augmentation.inverse(distorted)
    maps = cv2.initUndistortRectifyMap(camera, coefficients, None, camera, (width, height), cv2.CV_32FC1)
    inside = (maps[0] >= 0) & (maps[0] <= width - 1) & (maps[1] >= 0) & (maps[1] <= height - 1)
    theirs = cv2.remap(distorted[0].permute(1, 2, 0).numpy(), *maps, cv2.INTER_LINEAR)
    ours = back[0].permute(1, 2, 0).numpy()
    # two pixels from what lies beyond the picture, which is black
    within = cv2.erode(inside.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=0).astype(bool)
    assert within.mean() > 0.5
    assert np.abs(ours - theirs)[within].max() < 2 * 0.4 / 2.7 / 64  # as above
    # bilinear twice, each off by (1/8) f'' in two directions, f'' <= 0.4 / 2.7^2
    assert np.abs(ours - image[0].permute(1, 2, 0).numpy())[within].max() < 2 * 2 * 0.4 / 2.7**2 / 8


@SHAPES
@lenses
def test_a_box_holds_its_moved_edges(lens: dict[str, float], shape: tuple[int, int]) -> None:
    height, width = shape
    camera, coefficients = opencv(lens, shape)
    low = picture(6, 2, seed=1).numpy() * (width * 0.5, height * 0.5)
    high = low + 3 + picture(6, 2, seed=2).numpy() * (width * 0.4, height * 0.4)
    boxes = np.concatenate([low, high], axis=1)
    augment = K.AugmentationSequential(KC.RandomLensDistortion(**lens, p=1.0), data_keys=["input", "bbox_xyxy"])
    image = torch.zeros(1, 3, *shape, dtype=torch.float64)
    _, found = augment(image, torch.as_tensor(boxes)[None])
    found = found[0].numpy()
    for (left, top, right, bottom), own in zip(boxes, found, strict=True):
        along = np.linspace(0, 1, 201)[:, None]
        corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
        edges = np.concatenate(
            [a + (b - a) * along for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
        )
        ideal = np.concatenate([(edges - camera[:2, 2]) / camera[0, 0], np.ones((len(edges), 1))], axis=1)
        moved = cv2.projectPoints(ideal, np.zeros(3), np.zeros(3), camera, coefficients)[0][:, 0]
        # nine samples of an edge: what bulges between two of them is (1/8) (length / 8)^2 of its curvature
        assert np.abs(own - box_around(moved)).max() < 0.1


@pytest.mark.parametrize(
    "lens",
    [
        {"k1": -1.5},
        {"k1": -10.0},
        {"k1": 0.0, "k2": -5.0},
        {"p1": 3.0},
        # decentred so far that corners and middles of the sides converge, and points between them do not
        {"k1": -0.6396, "k2": 0.6052, "p1": -0.149, "p2": 0.126, "focal_length": 1.1152},
    ],
)
def test_a_picture_that_folds_is_refused(lens: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="fold the picture over itself, or nearly so"):
        KC.RandomLensDistortion(**lens, p=1.0)(torch.rand(1, 3, 48, 64))


def test_no_distortion_is_the_identity() -> None:
    image = picture(2, 3, 17, 20)
    found, _ = augmented(KC.RandomLensDistortion(0.0, p=1.0), image)
    assert (found - image).abs().max() < 1e-12
    empty = KC.RandomLensDistortion(p=1.0)(torch.zeros(0, 3, 8, 8))
    assert empty.shape == (0, 3, 8, 8)


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (1, 9)])
def test_tiny_pictures(shape: tuple[int, int]) -> None:
    image = picture(2, 3, *shape)
    found, _ = augmented(KC.RandomLensDistortion(p=1.0), image)
    assert found.shape == image.shape
    assert found.isfinite().all()
    middle = (..., shape[0] // 2, shape[1] // 2)
    if shape[0] % 2 and shape[1] % 2:
        assert torch.allclose(found[middle], image[middle])  # the centre stays


def test_masks_take_the_nearest_pixel() -> None:
    image, mask = picture(1, 3, 40, 50), torch.randint(0, 5, (1, 1, 40, 50)).double()
    augment = K.AugmentationSequential(KC.RandomLensDistortion(0.3, p=1.0), data_keys=["input", "mask"])
    _, found = augment(image, mask)
    assert set(found.unique().tolist()) <= set(range(5))


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_float32_is_close_to_float64(lens: dict[str, float]) -> None:
    image = smooth((64, 80))
    augmentation = KC.RandomLensDistortion(**lens, p=1.0)
    exact, _ = augmented(augmentation, image)
    single, _ = augmented(augmentation, image.float())
    assert single.dtype == torch.float32
    # coordinates of up to 80 pixels to a few 6e-8, on slopes of up to 0.2 per pixel; at the very border a pixel may
    # fall outside in one of the two
    difference = (single.double() - exact).abs().amax((0, 1))
    assert difference[1:-1, 1:-1].quantile(0.99) < 1e-4


def test_gradients_to_the_picture_and_to_the_coefficients() -> None:
    image = smooth((7, 8))
    augmentation = KC.RandomLensDistortion((0.05, 0.1), (0.01, 0.02), (0.01, 0.02), (0.01, 0.02), p=1.0)
    augmented(augmentation, image)
    params = dict(augmentation._params)
    names = ("k1", "k2", "p1", "p2")

    def distort(image: Tensor, *numbers: Tensor) -> Tensor:
        own = params | dict(zip(names, numbers, strict=True))
        return augmentation.apply_transform(image, own, augmentation.flags)

    inputs = [image.requires_grad_(), *(params[name].double().clone().requires_grad_() for name in names)]
    # the inverse is a fixed point that stops at 1e-4 pixels: its slope is as good
    assert torch.autograd.gradcheck(distort, inputs, eps=1e-6, atol=1e-4, fast_mode=True)


@pytest.mark.parametrize("seed", range(8))
def test_the_polynomial_between_nodes_is_where_pixels_go(seed: int) -> None:
    """To 1e-3 pixels, by the inverse of each pixel, for random lenses and pictures; where it would not be, all are."""
    generator = torch.Generator().manual_seed(seed)
    shape = tuple(torch.randint(50, 160, (2,), generator=generator).tolist())
    k1, k2, p1, p2 = (2 * torch.rand(4, generator=generator) - 1).mul(torch.tensor([0.3, 0.1, 0.02, 0.02])).tolist()
    augmentation = KC.RandomLensDistortion(k1=k1, k2=k2, p1=p1, p2=p2, p=1.0)
    params = augmentation.forward_parameters(torch.Size((1, 3, *shape)))
    for inverse in (False, True):
        asked: list[int] = []

        def move(points: Tensor, inverse: bool = inverse, asked: list[int] = asked) -> Tensor:
            asked.append(points.shape[-2])
            return augmentation._through(points, params, shape, inverse=inverse)

        found = _moved_pixels(shape, move, torch.zeros((), dtype=torch.float64))
        if seed == 0 and not inverse:
            assert asked == [400, 81]  # nodes and probes: no pixel
        y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in shape), indexing="ij")
        exact = move(torch.stack([x, y], dim=-1).flatten(0, 1)[None]).mT.unflatten(2, shape)
        torch.testing.assert_close(found, exact, rtol=0, atol=1e-3)
