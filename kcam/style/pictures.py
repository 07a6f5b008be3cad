"""Style pictures that kcam paints itself: nothing to download, nobody's copyright, the same bytes for the same seed.

Strokes, tiles, lines and blotches keep their size in pixels whatever the picture's size, and any 256-pixel crop looks
like any other, so that the statistics of a style mean something. All four wrap around at their borders.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from zlib import crc32

import numpy as np
import torch
from numpy.random import Generator, Philox
from scipy import fft
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from torch import Tensor

from kcam.style import fields

Array = np.ndarray
LEAST, MOST = 64, 2048  # pixels of a side: below, a stroke meets itself around the border; above, memory
SWIRL = 66.0  # pixels from one swirl to the next
STROKE_LENGTH, STROKE_WIDTH = (14.0, 38.0), (3.2, 6.6)  # pixels
STROKE_LAYERS = 4.0  # strokes over each pixel, on average
BEND, TURN = 1 / 12, 1.4  # a stroke's strongest curvature [1/pixel], and how far it turns [rad]
DRIFT, PATCHES = 0.45, 0.5  # of the swirls towards the right; of colour that does not follow them
TONES, ACCENTS = 0.08, 0.05  # spread of neighbours on the palette; share of strokes of any colour
BRISTLES, JITTER = 0.17, 0.10  # contrast of the bristles in a stroke, and of strokes of one colour
RELIEF = 0.32  # strength of the light on the thick paint
NIGHT = (
    (0.00, "#101c55"), (0.14, "#1a2f86"), (0.27, "#2148ab"), (0.40, "#2f6cc4"), (0.54, "#4b9bd0"), (0.66, "#7fc3d2"),
    (0.75, "#bfdcc4"), (0.81, "#f5ebc2"), (0.88, "#f6cb45"), (0.95, "#e6952a"),
)  # fmt: skip

BAND = 84.0  # pixels from one band of colour to the next
STONE, GROUT, LLOYD = 7.0, 0.8, 5  # pixels of a side, of a joint; steps that even the stones out
JOINT = "#6b6052"
FLOOR = (
    (0.00, "#1f5b61"), (0.15, "#3b8a86"), (0.28, "#8fb8a4"), (0.36, "#4a2c22"), (0.41, "#f1e6c8"), (0.56, "#e2c688"),
    (0.67, "#d09a3e"), (0.77, "#c2623a"), (0.90, "#8f3324"),
)  # fmt: skip

WAVE = 78.0  # pixels from crest to crest
LINE, COMBS, TURNS = 6.5, 4, 12  # pixels from line to line; rounds of combing, directions of the comb
OUTLINE = 2.2  # pixels
KEY = "#131b3a"
INKS = ((0.0, "#1d2f63"), (0.22, "#2f5d8f"), (0.42, "#9db9bd"), (0.56, "#efe3c6"), (0.86, "#c9472b"))
CUTS = ((0.0, "#b9cdc9"), (0.22, "#131b3a"), (0.42, "#2f5d8f"), (0.56, "#24406f"), (0.86, "#4a1620"))  # lines on them

POOL, TOOTH = 92.0, 4.5  # pixels from pool to pool of colour, and from grain to grain of the paper
RIM = 0.6  # pigment that gathers where a pool dries
PAPER, INK = "#f8f1e6", "#2b1f3d"
GLAZES = (  # each pigment's share of the picture; the two of a row, which would turn to mud, never meet
    (0.36, "#f7bdb4", "#bcd79f"), (0.30, "#cdb4e3", "#f6e0b4"),
    (0.20, "#e0527f", "#62a66c"), (0.13, "#7648ab", "#2f8577"),
)  # fmt: skip
SPLASHES = 1 / 900  # drops to a pixel


def painting(name: str, *, size: int | tuple[int, int] = 512, seed: int = 0) -> Tensor:
    """A style picture, painted by rule and chance.

    Args:      name: a key of `STYLES`.
               size: side, or (height, width) [pixels], each 64 to 2048; the strokes keep their size.
               seed: of all that is left to chance, 0 or more.
    Returns:   float32 (3, H, W), sRGB in [0, 1], in steps of 1/255: an 8-bit file holds the same picture.
    Raises:    ValueError for an unknown name, a size or a seed out of range.

    Example:
    >>> from kcam.style import painting
    >>> painting("mosaic", size=(64, 96)).shape
    torch.Size([3, 64, 96])
    """
    if name not in STYLES:
        raise ValueError(f'unknown style picture "{name}": expected one of {", ".join(STYLES)}. Try "strokes".')
    shape = (size, size) if isinstance(size, int) else size
    if len(shape) != 2 or not all(isinstance(side, int) and LEAST <= side <= MOST for side in shape):
        raise ValueError(
            f"size {size} of a style picture: expected a side or (height, width), {LEAST} to {MOST} whole pixels each. "
            "Try size=512."
        )
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed {seed} of a style picture: expected 0 to 2**63 - 1. Try seed=0.")
    picture = STYLES[name](shape, Generator(Philox(key=[seed, crc32(name.encode())])))
    levels = np.rint(255 * np.clip(picture, 0, 1)).astype(np.float32)
    return torch.from_numpy(np.ascontiguousarray(levels.transpose(2, 0, 1)) / np.float32(255))


def strokes(shape: tuple[int, int], rng: Generator) -> Array:
    """Thick, tapered strokes of oil that follow swirls: a night sky in the manner of van Gogh."""
    sky = fields.noise(shape, rng, SWIRL)
    tangent = fields.along(sky, drift=DRIFT)
    bend = np.clip(fields.curvature(tangent), -BEND, BEND)
    tone = fields.ranks(sky + PATCHES * fields.noise(shape, rng, SWIRL))
    count = round(STROKE_LAYERS * shape[0] * shape[1] / (np.mean(STROKE_LENGTH) * np.mean(STROKE_WIDTH)))
    rows, columns = (rng.integers(side, size=count) for side in shape)
    colours = fields.colours(NIGHT, tone[rows, columns] + rng.normal(0, TONES, count))
    accent = rng.random(count) < ACCENTS
    colours[accent] = fields.colours(NIGHT, rng.random(int(accent.sum())))
    canvas, relief = fields.colours(NIGHT, tone), np.zeros(shape)
    for row, column, colour in zip(rows, columns, colours, strict=True):
        turn = bend[row, column]
        length = min(rng.uniform(*STROKE_LENGTH), TURN / (abs(turn) + 1e-3))
        width = rng.uniform(*STROKE_WIDTH)
        reach = int((length + width) / 2) + 1
        steps = np.arange(-reach, reach + 1)
        cover, shade, ridge = _stroke(steps, length, width, tangent[:, row, column], turn, rng)
        paint = colour + shade[..., None] * (0.85 * colour + 0.12)
        box = np.ix_((row + steps) % shape[0], (column + steps) % shape[1])
        canvas[box] += cover[..., None] * (paint - canvas[box])
        relief[box] += cover * (ridge - relief[box])
    return _lit(canvas, relief)


def _stroke(
    steps: Array, length: float, width: float, tangent: Array, bend: float, rng: Generator
) -> tuple[Array, Array, Array]:
    """Cover, shade and height of one stroke: round where it starts, thin where it ends, combed by the bristles."""
    y, x = steps[:, None], steps[None, :]
    along = x * tangent[0] + y * tangent[1]
    across = y * tangent[0] - x * tangent[1] - bend * along**2 / 2
    t = np.clip(along / length + 0.5, 0, 1)
    half = width / 2 * np.minimum(1, 2.2 * np.sqrt(t)) * np.sqrt(1 - t**3)
    cover = np.clip(half - abs(across) + 0.5, 0, 1) * (abs(along) < length / 2)
    comb = np.interp(across, np.linspace(-6, 6, 12), rng.normal(0, 1, 12))
    shade = np.clip(BRISTLES * comb, -0.3, 0.3) + rng.normal(0, JITTER)
    return cover, shade, 1 - 0.5 * (across / (half + 0.5)) ** 2 + 0.35 * comb


def mosaic(shape: tuple[int, int], rng: Generator) -> Array:
    """Small stones laid in rows along bands of colour: a Roman floor."""
    bands = fields.noise(shape, rng, BAND)
    tangent = fields.along(bands)
    stone, edge = _stones(shape, tangent, rng)
    count = stone.max() + 1
    area = np.maximum(np.bincount(stone.ravel(), minlength=count), 1)
    tone = np.bincount(stone.ravel(), fields.ranks(bands).ravel(), minlength=count) / area
    worn = rng.normal(0, (0.07, 0.07), (count, 2))
    stones = fields.colours(FLOOR, tone + rng.normal(0, 0.012, count))
    stones = stones * (1 + worn[:, :1]) + worn[:, 1:] * (0.4, 0.1, -0.4)
    relief = np.clip(edge / 1.6, 0, 1) + gaussian_filter(rng.normal(0, 0.5, shape), 0.8, mode="wrap")
    joint = np.clip(edge - GROUT / 2, 0, 1)[..., None]
    return _lit(fields.rgb(JOINT) * (1 - joint) + stones[stone] * joint, relief)


def _stones(shape: tuple[int, int], tangent: Array, rng: Generator) -> tuple[Array, Array]:
    """Each pixel's stone, and its distance to the next stone [pixels].

    Square cells turned along the tangent, evened out by Lloyd's steps (Hausner, Simulating decorative mosaics, 2001).
    """
    side = np.array(shape)
    count = [max(1, round(n / STONE)) for n in shape]
    start = np.stack(np.meshgrid(*(np.arange(n) for n in count), indexing="ij"), -1).reshape(-1, 2)
    centres = (start + rng.random(start.shape)) * side / count
    pixels = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1).reshape(-1, 2)
    for _ in range(LLOYD):
        centres = centres % side
        tree = cKDTree(np.where(centres < side, centres, 0.0), boxsize=side)  # -1e-17 % side is side itself
        near = tree.query(pixels, k=6)[1]
        axis = tangent[:, *tree.data.astype(int).T][:, near]
        step = (pixels[:, None] - tree.data[near] + side / 2) % side - side / 2
        far = np.maximum(
            abs(step[..., 1] * axis[0] + step[..., 0] * axis[1]), abs(step[..., 0] * axis[0] - step[..., 1] * axis[1])
        )
        order = np.argpartition(far, 1, axis=1)[:, :2]
        first, second = np.take_along_axis(far, order, 1).T
        stone = np.take_along_axis(near, order[:, :1], 1)[:, 0]
        step = np.take_along_axis(step, order[:, :1, None], 1)[:, 0]
        area = np.maximum(np.bincount(stone, minlength=len(centres)), 1)
        shift = np.stack([np.bincount(stone, step[:, k], minlength=len(centres)) / area for k in (0, 1)], -1)
        centres = tree.data + shift
    return stone.reshape(shape), (second - first).reshape(shape) / 2


def woodcut(shape: tuple[int, int], rng: Generator) -> Array:
    """Lines cut along the waves, over flat inks with dark outlines: a coloured woodblock print after Hokusai."""
    waves = fields.noise(shape, rng, WAVE)
    tangent = fields.along(waves, drift=DRIFT)
    tone = fields.ranks(waves)
    lines = _lines(shape, tangent, rng)
    picture = fields.colours(INKS, tone)
    # Swelling lines: a cutter shades each form from one side, and leaves the other clear.
    starts, ink = np.array([*(start for start, _ in INKS), 1.0]), fields.ink_index(INKS, tone)
    across = (tone - starts[ink]) / (starts[ink + 1] - starts[ink])
    shading = 1.0 - 1.1 * across + 0.25 * fields.noise(shape, rng, WAVE / 2)
    cut = fields.smooth_step(lines - 0.75 + shading, 0.5)[..., None]
    picture = picture + cut * (fields.colours(CUTS, tone) - picture)
    slope = np.hypot(*fields.gradient(tone)) + 1e-4
    distance = np.min([abs(tone - start) for start in starts[1:-1]], axis=0) / slope  # pixels, to first order
    swell = OUTLINE * (1 + 0.4 * fields.noise(shape, rng, 24))
    outline = np.clip(swell / 2 - distance + 0.5, 0, 1)[..., None]
    picture = picture + outline * (fields.rgb(KEY) - picture)
    grain = gaussian_filter(rng.standard_normal(shape), (0.7, 9), mode="wrap")
    return picture * (1 + 0.03 * grain / grain.std())[..., None] + 0.012 * rng.standard_normal((*shape, 1))


def _lines(shape: tuple[int, int], tangent: Array, rng: Generator) -> Array:
    """-1 to 1 across near-parallel lines that follow the tangent: noise, combed over and over by turned filters."""
    fy, fx = fft.fftfreq(shape[0])[:, None], fft.rfftfreq(shape[1])[None, :]
    with np.errstate(divide="ignore"):
        band = np.exp(-(np.log2(np.hypot(fy, fx) * LINE) ** 2) / (2 * 0.3**2))
    across = np.arctan2(fx, -fy)  # a wave's lines run at right angles to its frequency
    along = np.arctan2(tangent[1], tangent[0])
    field = rng.standard_normal(shape)
    for _ in range(COMBS):
        spectrum, combed = fft.rfft2(field) * band, np.zeros(shape)
        for angle in np.arange(TURNS) * np.pi / TURNS:
            turned = np.exp(-(fields.between_lines(across - angle) ** 2) / (2 * 0.22**2))
            response = fft.irfft2(spectrum * turned, s=shape)
            combed += response * np.clip(1 - abs(fields.between_lines(along - angle)) * TURNS / np.pi, 0, 1)
        field = np.tanh(2 * combed / combed.std())
    return field


def watercolour(shape: tuple[int, int], rng: Generator) -> Array:
    """Glazes with dark rims that dried one over the other on rough paper, ink lines and splashes: a wet garden."""
    cloud = partial(fields.noise, shape, rng)
    tooth = cloud(TOOTH, octaves=0.6)
    picture = np.broadcast_to(fields.rgb(PAPER), (*shape, 3))
    for share, *pair in GLAZES:
        pool = cloud(POOL) + 0.3 * cloud(POOL / 3) + 0.06 * cloud(POOL / 9)
        for pigment, side in zip(pair, (pool, -pool), strict=True):
            inside = fields.distance(side, 1 - share)
            wash = 0.55 + 0.25 * np.clip(cloud(POOL / 2), -1.5, 1.5) + 0.13 * tooth
            rim = RIM * np.exp(-np.maximum(inside, 0) / 2)
            thickness = fields.smooth_step(inside, 2.0) * np.maximum(wash + rim, 0.1)
            picture = picture * fields.rgb(pigment) ** thickness[..., None]  # Beer's law
    pen = cloud(POOL, octaves=0.5) + 0.15 * cloud(POOL / 5)
    pressure = 0.8 + 0.9 * cloud(POOL / 2)
    ink = np.clip(pressure - abs(fields.distance(pen, 0.5)) + 0.5, 0, 1)
    picture = picture * fields.rgb(INK) ** np.maximum(0.9 * ink, _splashes(shape, rng))[..., None]
    return picture * (1 + 0.035 * (tooth - np.roll(tooth, (1, 1), (0, 1))))[..., None]


def _splashes(shape: tuple[int, int], rng: Generator) -> Array:
    """Drops of ink, many small and few large."""
    cover = np.zeros(shape)
    steps = np.arange(-6, 7)
    for _ in range(round(SPLASHES * shape[0] * shape[1])):
        row, column = rng.integers(shape)
        radius, squash, angle = 0.6 + rng.exponential(0.9), rng.uniform(1, 1.5), rng.uniform(0, np.pi)
        u = np.cos(angle) * steps + np.sin(angle) * steps[:, None]
        v = np.cos(angle) * steps[:, None] - np.sin(angle) * steps
        box = np.ix_((row + steps) % shape[0], (column + steps) % shape[1])
        cover[box] = np.maximum(cover[box], np.clip(min(radius, 4.5) - np.hypot(u / squash, v * squash) + 0.5, 0, 1))
    return cover


def _lit(canvas: Array, relief: Array) -> Array:
    """Thick paint under a lamp at the upper left."""
    slope = (relief - np.roll(relief, (1, 1), (0, 1))) / 2
    return canvas * (1 + RELIEF * np.clip(slope, -1, 1))[..., None]


STYLES: dict[str, Callable[[tuple[int, int], Generator], Array]] = {
    "strokes": strokes,
    "mosaic": mosaic,
    "woodcut": woodcut,
    "watercolour": watercolour,
}
"""Name -> what paints a style picture of a size: see `painting`."""
"""Each paints (H, W, 3) of a given shape."""
