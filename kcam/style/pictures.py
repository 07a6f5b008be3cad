"""Style pictures that kcam paints itself: nothing to download, nobody's copyright, the same bytes for the same seed.

Strokes, tiles, lines and blotches keep their size in pixels whatever the picture's size, and any 256-pixel crop looks
like any other, so that the statistics of a style mean something. All six wrap around at their borders.
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

GROVE, CROWN, BLOOM = 88.0, 42.0, 0.26  # pixels from grove to grove, from crown to crown; share of trees in bloom
CAST, RIPPLE = 11, (1.6, 11.0)  # pixels: how far trees cast shade, right and down; a ripple (sigma), down and right
DOT, CELL, ROUNDS = (4.2, 6.8), 12, 16  # pixels across; pixels between dots of one of the rounds, the largest first
MIXED, STREWN = 0.10, 0.11  # spread of the dots' light about their place's; share of the complement in the shade
PRIMER = "#f6ecd6"
SCENE = (  # the height from which it begins; the complement strewn into its shade; its pigments, from shade to light
    (0.00, "#f4a968", ("#20308c", "#3449ae", "#2f6cc4", "#4192d4", "#62b2dc", "#93d0dc", "#d3e6d2")),  # water
    (0.36, "#5a62c4", ("#8a5fb0", "#c286b8", "#f0a58c", "#f8c48c", "#fbdc9c", "#fbeab8", "#fdf3d2")),  # sand
    (0.46, "#c23a5a", ("#2a3d94", "#1f7a58", "#4da04a", "#8fbf3f", "#c3d34b", "#efe063", "#f9ec9c")),  # a lawn
    (0.66, "#c92f49", ("#22286f", "#1b4a6e", "#17684c", "#2f8c45", "#6aab3b", "#b3c93f", "#f4df58")),  # trees
    (1.00, "#1f8a70", ("#4a2478", "#8a2470", "#c4304f", "#e4573f", "#f08a3e", "#f7b25a", "#fbdc9a")),  # some in bloom
)

FOLD, EVEN = 100.0, 12.0  # pixels from one fold to the next, and (sigma) over which strokes agree on a direction
HALF, SHORTEST = 22, 9  # pixels from a stroke's middle to its ends, at most; of the shortest stroke
PEN, TREMBLE, OUTLINED = (0.9, 2.1), 0.35, 1.6  # pixels: wide in light and in shade; off the line; of the creases
HATCHES = ((0.30, 0.0, 3.9), (0.55, 0.85, 3.9), (0.77, -0.75, 3.6))  # shade to begin at, turn [rad], gap [pixels]
LAID, GALL = "#f3dfb2", "#1a2142"


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
    depth = lines - 0.75 + shading
    cut = fields.smooth_step(depth, np.maximum(0.5, 1.5 * np.hypot(*fields.gradient(depth))))[..., None]  # no stairs
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


def pointillism(shape: tuple[int, int], rng: Generator) -> Array:
    """Dots of nearly pure colours that mix in the eye: islands in the Seine on a Sunday, after Seurat."""
    matter, light = _islands(shape, rng)
    pigments = np.array([[fields.rgb(code) for code in (strewn, *codes)] for _, strewn, codes in SCENE])
    steps = pigments.shape[1] - 1
    picture, relief = np.broadcast_to(fields.rgb(PRIMER), (*shape, 3)).copy(), np.zeros(shape)
    for turn, phase in enumerate(rng.permutation(ROUNDS)):
        rows, columns, cover = _dots(shape, divmod(phase, 4), turn / (ROUNDS - 1), rng)
        middle = rows[:, CELL // 3], columns[:, CELL // 3]
        count, lit = len(rows), light[middle]
        pigment = 1 + np.clip(steps * (lit + rng.normal(0, MIXED, count)), 0, steps - 1).astype(int)
        pigment[rng.random(count) < STREWN * np.clip(1.6 - 2 * lit, 0.2, 1)] = 0
        paint = pigments[matter[middle], pigment] * rng.normal(1, 0.05, (count, 1))
        boxes = rows[:, :, None], columns[:, None, :]
        picture[boxes] += cover[..., None] * (paint[:, None, None] - picture[boxes])
        relief[boxes] += cover * (1.2 * cover - relief[boxes])
    return _lit(picture, relief)


def _islands(shape: tuple[int, int], rng: Generator) -> tuple[Array, Array]:
    """Each pixel's row of `SCENE`, and its light, 0 to 1: the sun is at the upper left, and trees cast shade."""
    cloud = partial(fields.noise, shape, rng)
    height = fields.ranks(cloud(GROVE))
    matter = fields.ink_index(tuple((start, strewn) for start, strewn, _ in SCENE), height)
    trees, water = matter == 3, matter == 0
    cast = gaussian_filter(np.roll(trees, (CAST, CAST), (0, 1)).astype(float), 2.5, mode="wrap")
    ripples = gaussian_filter(rng.standard_normal(shape), RIPPLE, mode="wrap")
    sparkle = fields.ranks(ripples / ripples.std() + 0.9 * cloud(GROVE / 2) - 2.5 * cast)
    light = np.where(water, sparkle, 0.72 + 0.1 * cloud(CROWN) - 0.6 * cast)
    light = np.where(trees, fields.ranks(np.add(*fields.gradient(6 * height + 0.4 * cloud(CROWN)))), light)
    return np.where(trees & (fields.ranks(cloud(1.5 * CROWN)) > 1 - BLOOM), 4, matter), light


def _dots(shape: tuple[int, int], phase: tuple[int, int], turn: float, rng: Generator) -> tuple[Array, ...]:
    """Rows, columns and cover of the boxes of one round of dots, of which no two meet: all are painted at once."""
    grid = [np.arange(n // CELL) * n / (n // CELL) + part * CELL / 4 for n, part in zip(shape, phase, strict=True)]
    corners = np.stack(np.meshgrid(*grid, indexing="ij"), -1).reshape(-1, 2).astype(int)
    reach, count = CELL // 3, len(corners)
    corners = corners + rng.integers(0, CELL - 2 * reach, corners.shape)
    steps = np.arange(2 * reach + 1)
    rows, columns = ((corners[:, [axis]] + steps) % shape[axis] for axis in (0, 1))
    y, x = np.moveaxis(steps - reach + rng.uniform(-0.5, 0.5, (count, 2, 1)), 1, 0)
    z = x[:, None, :] + 1j * y[:, :, None]
    distance = abs(z) + 1e-9
    radius = DOT[1] / 2 - turn * (DOT[1] - DOT[0]) / 2 * rng.uniform(0.5, 1, (count, 1, 1))
    oval, knob = rng.normal(0, 0.07, (2, count, 1, 1, 2)) @ np.array([1, 1j])
    edge = radius * (1 + (oval * (z / distance) ** 2 + knob * (z / distance) ** 3).real)
    return rows, columns, np.clip(edge - distance + 0.5, 0, 1)


def hatching(shape: tuple[int, int], rng: Generator) -> Array:
    """Strokes of the pen along folds, crossed in the shade: a study of drapery in ink on laid paper, after Dürer."""
    cloud = partial(fields.noise, shape, rng)
    folds = cloud(FOLD), cloud(FOLD)
    front = np.argmax(folds, axis=0)
    tangent = np.where(front, *(_evened(fields.along(fold)) for fold in folds[::-1]))
    gx, gy = np.where(front, *(fields.gradient(fold) for fold in folds[::-1]))
    step = folds[1] - folds[0]
    crease = abs(step) / (np.hypot(*fields.gradient(step)) + 2e-3)  # pixels, to first order
    shade = fields.ranks(0.03 * np.exp(-crease / 7) - gx - gy)
    ink = np.clip(np.maximum(OUTLINED * (0.5 + 0.6 * shade) + 0.35 * cloud(FOLD / 3), 0.7) - crease, 0, 1)
    for start, turn, gap in HATCHES:
        across = np.stack([-tangent[1], tangent[0]])
        strength = shade + 0.04 * cloud(FOLD / 4) - start
        hatch = _hatch(np.cos(turn) * tangent + np.sin(turn) * across, strength, front, gap, shade, rng)
        ink = np.maximum(ink, hatch)
    grain = gaussian_filter(rng.standard_normal(shape), (0.6, 2.5), mode="wrap")
    paper = fields.rgb(LAID) * (1 + 0.012 * grain / grain.std())[..., None]
    return paper + (0.95 * ink)[..., None] * (fields.rgb(GALL) - paper)


def _evened(tangent: Array) -> Array:
    """Lines of a field without its whirls: of vectors of double angle, to which a line's sense is the same."""
    doubled = gaussian_filter((tangent[0] + 1j * tangent[1]) ** 2, EVEN, mode="wrap")
    line = np.sqrt(doubled / (abs(doubled) + 1e-12))
    return np.stack([line.real, line.imag])


def _hatch(tangent: Array, strength: Array, front: Array, gap: float, shade: Array, rng: Generator) -> Array:
    """Cover of strokes along a tangent, where a strength is positive, evenly apart.

    The longest free piece of each of many lines (Jobard and Lefer, Creating evenly-spaced streamlines, 1997).
    """
    shape = strength.shape
    middles = rng.permutation(strength.size)[: round(3 * strength.size / gap**2)]
    middles = middles[strength.flat[middles] > 0]
    places, ways = _traced(tangent, np.stack(np.unravel_index(middles, shape)) + 0.5)
    pixels = np.floor(places).astype(int) % np.array(shape)[:, None, None]
    straight = abs(np.sum(ways * ways[:, :, [HALF]], axis=0)) > 0.6
    clear = straight & (strength[*pixels] > 0) & (front[*pixels] == front[*pixels[:, :, [HALF]]])
    disc = np.mgrid[-4:5, -4:5].reshape(2, -1)
    disc = disc[:, np.hypot(*disc) < gap - 0.5]
    taken, t = np.zeros(shape, bool), np.zeros(clear.shape)
    for stroke, (row, column) in enumerate(zip(*pixels, strict=True)):
        if taken[row[HALF], column[HALF]]:
            continue
        ends = np.flatnonzero(~clear[stroke] | taken[row, column])
        start, stop = ends[ends < HALF].max(initial=-1) + 1, ends[ends > HALF].min(initial=len(row))
        if stop - start >= SHORTEST:
            t[stroke, start:stop] = (np.arange(stop - start) + 0.5) / (stop - start)
            around = row[start:stop, None] + disc[0], column[start:stop, None] + disc[1]
            taken[around[0] % shape[0], around[1] % shape[1]] = True
    drawn = t > 0
    which, step = np.nonzero(drawn)
    pen = np.interp(shade[*pixels[:, drawn]], (0, 1), PEN) * rng.normal(1, 0.12, len(t))[which]
    half = pen / 2 * np.minimum(1, 0.35 + 2.5 * t[drawn]) * np.sqrt(1 - t[drawn] ** 2.5)
    hand = TREMBLE * np.sin(step / rng.uniform(2.5, 5, len(t))[which] + rng.uniform(0, 2 * np.pi, len(t))[which])
    way = ways[:, drawn]
    place = places[:, drawn] + hand * np.stack([way[1], -way[0]])
    cover = np.zeros(shape)
    for offset in np.ndindex(5, 5):
        pixel = np.floor(place).astype(int) + np.array(offset)[:, None] - 2
        y, x = pixel + 0.5 - place
        near = np.clip(half + 0.5 - abs(y * way[1] - x * way[0]), 0, 1) * (abs(y * way[0] + x * way[1]) < 0.75)
        np.maximum.at(cover, tuple(pixel % np.array(shape)[:, None]), near)
    return cover


def _traced(tangent: Array, middles: Array) -> tuple[Array, Array]:
    """Places (2, N, 2 HALF + 1) on the lines of a field through the middles, and its directions there, as (y, x)."""
    side = np.array(tangent.shape[1:])[:, None]
    halves = []
    for sense in (-1, 1):
        place, way, half = middles, sense * tangent[::-1, *np.floor(middles).astype(int)], []
        for _ in range(HALF + 1):
            half.append((place, sense * way))
            place = place + way
            line = tangent[::-1, *(np.floor(place).astype(int) % side)]
            way = line * np.copysign(1, np.sum(line * way, axis=0))
        halves.append(half)
    path = np.array(halves[0][:0:-1] + halves[1])
    return path[:, 0].transpose(1, 2, 0), path[:, 1].transpose(1, 2, 0)


def _lit(canvas: Array, relief: Array) -> Array:
    """Thick paint under a lamp at the upper left."""
    slope = (relief - np.roll(relief, (1, 1), (0, 1))) / 2
    return canvas * (1 + RELIEF * np.clip(slope, -1, 1))[..., None]


STYLES: dict[str, Callable[[tuple[int, int], Generator], Array]] = {
    "strokes": strokes,
    "mosaic": mosaic,
    "woodcut": woodcut,
    "watercolour": watercolour,
    "pointillism": pointillism,
    "hatching": hatching,
}
"""Name -> what paints a style picture of a size: see `painting`."""
"""Each paints (H, W, 3) of a given shape."""
