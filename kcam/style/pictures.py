"""Style pictures that kcam paints itself: nothing to download, nobody's copyright, the same bytes for the same seed.

Strokes, tiles, lines and blotches keep their size in pixels whatever the picture's size, and any 256-pixel crop looks
like any other, so that the statistics of a style mean something. All four wrap around at their borders.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.random import Generator, Philox
from scipy import fft
from scipy.ndimage import gaussian_filter
from torch import Tensor

Array = np.ndarray
LEAST, MOST = 64, 8192  # pixels of a side: below, a stroke meets itself around the border
NEIGHBOURHOOD = 50.0  # pixels (sigma) over which the palette is used up: a 256-pixel crop holds a few

SWIRL = 72.0  # pixels from one swirl to the next
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


def painting(name: str, *, size: int | tuple[int, int] = 512, seed: int = 0) -> Tensor:
    """A style picture, painted by rule and chance.

    Args:      name: a key of `STYLES`.
               size: side, or (height, width) [pixels], each 64 to 8192; the strokes keep their size.
               seed: of all that is left to chance, 0 or more.
    Returns:   float32 (3, H, W), sRGB in [0, 1], in steps of 1/255: an 8-bit file holds the same picture.
    Raises:    ValueError for an unknown name, a size or a seed out of range.
    >>> painting("mosaic", size=(64, 96)).shape
    torch.Size([3, 64, 96])
    """
    if name not in STYLES:
        raise ValueError(f'unknown style picture "{name}": expected one of {", ".join(STYLES)}. Try "{next(iter(STYLES))}".')
    shape = (size, size) if isinstance(size, int) else tuple(size)
    if len(shape) != 2 or not all(isinstance(side, int) and LEAST <= side <= MOST for side in shape):
        raise ValueError(f"size {size} of a style picture: expected a side or (height, width), {LEAST} to {MOST} pixels each. Try size=512.")
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed {seed} of a style picture: expected 0 to 2**63 - 1. Try seed=0.")
    picture = STYLES[name](shape, Generator(Philox(key=seed)))
    levels = np.rint(255 * np.clip(picture, 0, 1)).astype(np.float32)
    return torch.from_numpy(np.ascontiguousarray(levels.transpose(2, 0, 1)) / np.float32(255))


def strokes(shape: tuple[int, int], rng: Generator) -> Array:
    """Thick, tapered strokes of oil that follow swirls: a night sky in the manner of van Gogh."""
    sky = _noise(shape, rng, SWIRL)
    tangent = _along(sky, drift=DRIFT)
    bend = np.clip(_curvature(tangent), -BEND, BEND)
    tone = _ranks(sky + PATCHES * _noise(shape, rng, SWIRL))
    count = round(STROKE_LAYERS * shape[0] * shape[1] / (np.mean(STROKE_LENGTH) * np.mean(STROKE_WIDTH)))
    rows, columns = (rng.integers(side, size=count) for side in shape)
    colours = _colour(NIGHT, tone[rows, columns] + rng.normal(0, TONES, count))
    accent = rng.random(count) < ACCENTS
    colours[accent] = _colour(NIGHT, rng.random(int(accent.sum())))
    canvas, height = _colour(NIGHT, tone), np.zeros(shape)
    for row, column, colour in zip(rows, columns, colours, strict=True):
        length, width = rng.uniform(*STROKE_LENGTH), rng.uniform(*STROKE_WIDTH)
        length = min(length, TURN / (abs(bend[row, column]) + 1e-3))
        _stroke(canvas, height, (row, column), tangent[:, row, column], bend[row, column], length, width, colour, rng)
    return _lit(canvas, height)


def _stroke(canvas, height, centre, tangent, bend, length, width, colour, rng) -> None:
    """One stroke, in place: opaque, round where it starts, thin where it ends, combed by the bristles."""
    reach = int(length / 2 + width / 2) + 1
    steps = np.arange(-reach, reach + 1)
    y, x = steps[:, None], steps[None, :]
    along = x * tangent[0] + y * tangent[1]
    across = y * tangent[0] - x * tangent[1] - bend * along**2 / 2
    t = np.clip(along / length + 0.5, 0, 1)
    half = width / 2 * np.minimum(1, 2.2 * np.sqrt(t)) * np.sqrt(1 - t**3)
    cover = np.clip(half - np.abs(across) + 0.5, 0, 1) * (np.abs(along) < length / 2)
    hairs = rng.normal(0, 1, 12)
    comb = np.interp(across, np.linspace(-6, 6, 12), hairs)
    shade = np.clip(BRISTLES * comb, -0.3, 0.3) + rng.normal(0, JITTER)
    paint = colour + shade[..., None] * (colour + 0.2)
    box = np.ix_((centre[0] + steps) % canvas.shape[0], (centre[1] + steps) % canvas.shape[1])
    canvas[box] += cover[..., None] * (paint - canvas[box])
    ridge = 1 - 0.5 * (across / (half + 0.5)) ** 2 + 0.35 * comb
    height[box] += cover * (ridge - height[box])


def _lit(canvas: Array, height: Array) -> Array:
    """Thick paint under a lamp at the upper left."""
    slope = (height - np.roll(height, (1, 1), (0, 1))) / 2
    return canvas * (1 + RELIEF * np.clip(slope, -1, 1))[..., None]


def _noise(shape: tuple[int, int], rng: Generator, wavelength: float, *, octaves: float = 0.35) -> Array:
    """Isotropic periodic noise of unit variance around one wavelength: nothing slower, so that all crops look alike."""
    frequency = np.hypot(fft.fftfreq(shape[0])[:, None], fft.rfftfreq(shape[1])[None, :])
    with np.errstate(divide="ignore"):
        gain = np.exp(-(np.log2(frequency * wavelength) ** 2) / (2 * octaves**2))
    field = fft.irfft2(fft.rfft2(rng.standard_normal(shape)) * gain, s=shape)
    return field / field.std()


def _gradient(field: Array) -> tuple[Array, Array]:
    """d/dx and d/dy, around the border."""
    return tuple((np.roll(field, -1, axis) - np.roll(field, 1, axis)) / 2 for axis in (1, 0))


def _along(field: Array, *, drift: float = 0.0) -> Array:
    """Unit vectors (x, y) along the level lines of a field, pulled towards +x by a share of its usual slope."""
    gx, gy = _gradient(field)
    gy = gy - drift * np.sqrt(np.mean(gx**2 + gy**2))
    return np.stack([-gy, gx]) / (np.hypot(gx, gy) + 1e-9)


def _curvature(tangent: Array) -> Array:
    """Of the lines that follow a field of unit vectors, [1/pixel]."""
    (xx, xy), (yx, yy) = _gradient(tangent[0]), _gradient(tangent[1])
    turn = [tangent[0] * dy - tangent[1] * dx for dx, dy in ((xx, yx), (xy, yy))]
    return turn[0] * tangent[0] + turn[1] * tangent[1]


def _ranks(field: Array) -> Array:
    """Even shares of 0 to 1, for a palette whose colours are all used, and used in every neighbourhood."""
    field = field - gaussian_filter(field, NEIGHBOURHOOD, mode="wrap")
    field = field / np.sqrt(gaussian_filter(field**2, NEIGHBOURHOOD, mode="wrap"))
    order = np.empty(field.size)
    order[np.argsort(field, axis=None, kind="stable")] = (np.arange(field.size) + 0.5) / field.size
    return order.reshape(field.shape)


def _rgb(code: str) -> Array:
    return np.array([int(code[i : i + 2], 16) / 255 for i in (1, 3, 5)])


def _colour(palette: tuple[tuple[float, str], ...], tone: Array) -> Array:
    """The palette's colours at tones 0 to 1, each from its own tone upwards."""
    index = np.searchsorted([start for start, _ in palette], tone, side="right") - 1
    return np.stack([_rgb(code) for _, code in palette])[np.clip(index, 0, None)]


STYLES: dict[str, Callable[[tuple[int, int], Generator], Array]] = {"strokes": strokes}
