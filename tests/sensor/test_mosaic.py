import pytest
import torch
from kornia.color import CFA, rgb_to_raw

from kcam.sensor import PATTERNS, Mosaic, channel_masks, mosaic

CHANNELS = {name: 4 if name == "rgbw" else 3 for name in PATTERNS}


# Kornia names a Bayer phase after OpenCV's: by the 2 x 2 square one pixel further down and right.
@pytest.mark.parametrize(("pattern", "cfa"), [("RGGB", CFA.BG), ("GRBG", CFA.GB), ("GBRG", CFA.GR), ("BGGR", CFA.RG)])
@pytest.mark.parametrize("shape", [(6, 8), (5, 7), (1, 1), (1, 4)])
def test_bayer_equals_kornia(pattern, cfa, shape):
    image = torch.rand(2, 3, *shape)
    assert torch.equal(mosaic(image, pattern=pattern), rgb_to_raw(image, cfa))


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("shape", [(12, 12), (13, 7), (1, 1), (0, 5)])
def test_masks_take_each_pixel_once_and_mosaic_follows_them(pattern, shape):
    masks = channel_masks(pattern, *shape)
    assert masks.shape == (CHANNELS[pattern], *shape)
    assert masks.dtype == torch.bool
    assert (masks.sum(0) == 1).all()
    image = torch.rand(2, CHANNELS[pattern], *shape)
    assert torch.equal(mosaic(image, pattern=pattern), (image * masks).sum(1, keepdim=True))


@pytest.mark.parametrize("pattern", PATTERNS)
def test_the_tile_starts_at_the_top_left_and_repeats(pattern):
    tile = torch.tensor(PATTERNS[pattern])
    rows, columns = tile.shape
    index = torch.arange(CHANNELS[pattern], dtype=torch.float32)[None, :, None, None]
    raw = Mosaic(pattern)(index.expand(1, -1, 3 * rows + 1, 2 * columns + 1))
    assert torch.equal(raw[0, 0, :rows, :columns], tile.float())
    assert torch.equal(raw[0, 0, rows:], raw[0, 0, : 2 * rows + 1])
    assert torch.equal(raw[0, 0, :, columns:], raw[0, 0, :, : columns + 1])


def test_x_trans_has_every_colour_in_every_row_and_column():
    tile = torch.tensor(PATTERNS["x_trans"])
    assert [(tile == c).sum().item() for c in range(3)] == [8, 20, 8]
    assert all(set(line.tolist()) == {0, 1, 2} for line in [*tile, *tile.T])


def test_rgbw_is_half_white():
    tile = torch.tensor(PATTERNS["rgbw"])
    assert [(tile == c).sum().item() for c in range(4)] == [2, 4, 2, 8]


def test_the_pattern_rolls_as_the_image_rolls():
    image = torch.rand(1, 3, 6, 6)
    assert torch.equal(mosaic(image.roll(1, -1), pattern="GRBG"), mosaic(image, pattern="RGGB").roll(1, -1))
    assert torch.equal(mosaic(image.roll(1, -2), pattern="GBRG"), mosaic(image, pattern="RGGB").roll(1, -2))


@pytest.mark.parametrize("pattern", PATTERNS)
def test_gradcheck(pattern):
    image = torch.rand(1, CHANNELS[pattern], 5, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: mosaic(x, pattern=pattern), image)


def test_an_infinite_channel_stays_where_it_is_recorded():
    image = torch.zeros(1, 3, 4, 4, requires_grad=True)
    blown = torch.stack([image[:, 0] + torch.inf, image[:, 1], image[:, 2]], 1)
    raw = Mosaic("RGGB")(blown)
    assert raw.isinf().sum() == 4
    raw[0, 0, 0, 1].backward()
    assert image.grad.isfinite().all()


def test_unbatched_empty_and_half():
    assert mosaic(torch.rand(3, 5, 4), pattern="RGGB").shape == (1, 5, 4)
    assert Mosaic()(torch.rand(0, 3, 5, 4)).shape == (0, 1, 5, 4)
    assert Mosaic()(torch.rand(1, 3, 5, 4).half()).dtype == torch.float16
    assert Mosaic("x_trans").provides() == {"pattern": "x_trans"}


def test_errors_name_the_pattern_and_the_channels():
    with pytest.raises(ValueError, match=r"pattern 'rggb' is unknown; expected one of RGGB, GRBG"):
        Mosaic("rggb")
    with pytest.raises(
        ValueError, match=r"selects among 3 channels \(R, G, B\).*got shape \(1, 1, 4, 4\).*learned tile"
    ):
        Mosaic("RGGB")(torch.rand(1, 1, 4, 4))
    with pytest.raises(ValueError, match=r"selects among 4 channels \(R, G, B, W\)"):
        Mosaic("rgbw")(torch.rand(1, 3, 4, 4))
