"""Fields that style pictures are drawn from: periodic noise, the lines along it, even tones, palettes of inks.

All wrap around at the borders; an axis 0 points down the rows, vectors are (x, y).
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from scipy import fft
from scipy.ndimage import gaussian_filter

Array = np.ndarray
Palette = tuple[tuple[float, str], ...]
"""Rows of the tone, 0 to 1, from which on a colour is used, and the colour: "#rrggbb"."""
NEIGHBOURHOOD = 40.0  # pixels (sigma) over which a palette is used up: a 256-pixel crop holds a few


def noise(shape: tuple[int, int], rng: Generator, wavelength: float, *, octaves: float = 0.3) -> Array:
    """Isotropic periodic noise of unit variance around one wavelength: nothing slower, so that all crops look alike."""
    frequency = np.hypot(fft.fftfreq(shape[0])[:, None], fft.rfftfreq(shape[1])[None, :])
    with np.errstate(divide="ignore"):
        gain = np.exp(-(np.log2(frequency * wavelength) ** 2) / (2 * octaves**2))
    field = fft.irfft2(fft.rfft2(rng.standard_normal(shape)) * gain, s=shape)
    return field / field.std()


def gradient(field: Array) -> tuple[Array, Array]:
    """d/dx and d/dy, around the border."""
    return tuple((np.roll(field, -1, axis) - np.roll(field, 1, axis)) / 2 for axis in (1, 0))


def along(field: Array, *, drift: float = 0.0) -> Array:
    """Unit vectors (x, y) along the level lines of a field, pulled towards +x by a share of its usual slope."""
    gx, gy = gradient(field)
    gy = gy - drift * np.sqrt(np.mean(gx**2 + gy**2))
    return np.stack([-gy, gx]) / (np.hypot(gx, gy) + 1e-9)


def curvature(tangent: Array) -> Array:
    """Of the lines that follow a field of unit vectors, [1/pixel]."""
    (xx, xy), (yx, yy) = gradient(tangent[0]), gradient(tangent[1])
    turn = [tangent[0] * dy - tangent[1] * dx for dx, dy in ((xx, yx), (xy, yy))]
    return turn[0] * tangent[0] + turn[1] * tangent[1]


def ranks(field: Array) -> Array:
    """Even shares of 0 to 1, for a palette whose colours are all used, and used in every neighbourhood."""
    field = field - gaussian_filter(field, NEIGHBOURHOOD, mode="wrap")
    field = field / np.sqrt(gaussian_filter(field**2, NEIGHBOURHOOD, mode="wrap"))
    order = np.empty(field.size)
    order[np.argsort(field, axis=None, kind="stable")] = (np.arange(field.size) + 0.5) / field.size
    return order.reshape(field.shape)


def distance(field: Array, level: float) -> Array:
    """How far inside the contour above which the field's share 1 - level lies [pixels], to first order."""
    tone = ranks(field)
    return (tone - level) / (np.hypot(*gradient(tone)) + 2e-3)


def smooth_step(value: Array, width: float) -> Array:
    """0 to 1 around 0, smoothly."""
    t = np.clip(value / width + 0.5, 0, 1)
    return t * t * (3 - 2 * t)


def between_lines(angle: Array) -> Array:
    """The angle between two lines, -pi/2 to pi/2."""
    return (angle + np.pi / 2) % np.pi - np.pi / 2


def rgb(code: str) -> Array:
    """A colour written as "#rrggbb", 0 to 1."""
    return np.array([int(code[i : i + 2], 16) / 255 for i in (1, 3, 5)])


def ink_index(palette: Palette, tone: Array) -> Array:
    """The palette's row for each tone."""
    return np.clip(np.searchsorted([start for start, _ in palette], tone, side="right") - 1, 0, None)


def colours(palette: Palette, tone: Array) -> Array:
    """The palette's colours at tones 0 to 1, each from its own tone upwards."""
    return np.stack([rgb(code) for _, code in palette])[ink_index(palette, tone)]
