"""A camera for these tests that shares nothing with kcam: its own Zernikes, diffraction, pixels and noise, in numpy.

Conventions as of kcam's `units`: an OPD that rises towards +x moves light towards +x; Noll's Zernikes, metres RMS.
"""

from __future__ import annotations

import math

import numpy as np

NOLL = {1: (0, 0), 2: (1, 1), 3: (1, -1), 4: (2, 0), 5: (2, -2), 6: (2, 2), 7: (3, -1), 8: (3, 1), 9: (3, -3),
        10: (3, 3), 11: (4, 0)}  # fmt: skip
"""Noll, J. Opt. Soc. Am. 66, 207 (1976), table I: j -> (n, m), m < 0 for sines."""


def zernike(j: int, rho: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Of unit variance on the unit disc, by Noll's sum of factorials."""
    n, m = NOLL[j]
    order = abs(m)
    radial = sum(
        (-1) ** s * math.factorial(n - s)
        / (math.factorial(s) * math.factorial((n + order) // 2 - s) * math.factorial((n - order) // 2 - s))
        * rho ** (n - 2 * s)
        for s in range((n - order) // 2 + 1)
    )  # fmt: skip
    turn = np.cos(order * theta) if m >= 0 else np.sin(order * theta)
    return np.sqrt((n + 1) * (2 if m else 1)) * radial * turn


def amplitude(
    coefficients: dict[int, float], x: np.ndarray, y: np.ndarray, *, wavelength: float, f_number: float
) -> np.ndarray:
    """Field of a point at sensor places x, y [m], (Y, X), relative: its square is the share of light per metre^2.

    U = 1 / (lambda d sqrt(pi) a) INT exp(ikW - ik x.u / d) d^2 u over the disc, in rows of Gauss-Legendre nodes: with
    u = a r and a / d = 1 / 2F, rows at r_y = sin t, each cos t wide on either side, so that the rim has no steps.
    """
    node, weight = np.polynomial.legendre.leggauss(96)
    t = node * np.pi / 2
    kernel = -1j * np.pi / (wavelength * f_number)
    rows = []
    for tilt in t:
        rx, ry = np.cos(tilt) * node, np.full(len(node), np.sin(tilt))
        rho, theta = np.hypot(rx, ry), np.arctan2(ry, rx)
        path = sum(value * zernike(j, rho, theta) for j, value in coefficients.items())
        field = np.exp(2j * np.pi / wavelength * (path + 0 * rho)) * weight * np.cos(tilt)
        rows.append(field @ np.exp(kernel * rx[:, None] * x[None, :]))
    across = np.exp(kernel * y[:, None] * np.sin(t)[None, :]) * (weight * np.cos(t) * np.pi / 2)
    return across @ np.stack(rows) / (2 * f_number * wavelength * np.sqrt(np.pi))


def pixel_psf(
    coefficients: dict[int, float], *, wavelength: float, f_number: float, pitch: float, window: int,
    moved: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:  # fmt: skip
    """Share of the light in each of window x window pixels, as light falls, the image moved by (x, y) pixels.

    8 x 8 Gauss-Legendre nodes in each.
    """
    node, weight = np.polynomial.legendre.leggauss(8)
    middle = (np.arange(window) - (window - 1) / 2) * pitch
    x, y = ((middle[:, None] + node * pitch / 2).ravel() - shift * pitch for shift in moved)
    light = np.abs(amplitude(coefficients, x, y, wavelength=wavelength, f_number=f_number)) ** 2
    each = light.reshape(window, len(node), window, len(node))
    return np.einsum("aibj,i,j->ab", each, weight, weight) * pitch**2 / 4


def point_picture(
    coefficients: dict[int, float], *, wavelength: float, f_number: float, pitch: float,
    places: np.ndarray, shape: tuple[int, int], electrons: float, background: float, window: int = 41,
) -> np.ndarray:  # fmt: skip
    """Expected electrons of points at places (K, 2), x and y in pixels."""
    half = window // 2
    picture = np.full((shape[0] + 2 * half, shape[1] + 2 * half), float(background))
    for x, y in places:
        left, top = round(x), round(y)
        picture[top : top + window, left : left + window] += electrons * pixel_psf(
            coefficients, wavelength=wavelength, f_number=f_number, pitch=pitch, window=window,
            moved=(x - left, y - top),
        )  # fmt: skip
    return picture[half:-half, half:-half]


def edge_picture(
    coefficients: dict[int, float], *, wavelength: float, f_number: float, pitch: float, angle: float, offset: float,
    shape: tuple[int, int], dark: float, bright: float, oversampling: int = 4,
) -> np.ndarray:  # fmt: skip
    """Expected electrons of a half plane, bright where x cos + y sin > offset [pixels from the middle].

    The half plane is drawn on subpixels by its covered area, convolved by an FFT with samples of the PSF (a box of one
    subpixel is blurred by neither of both twice), and averaged over pixels.
    """
    window = 2 * max(shape)
    at = (np.arange((window + 1) * oversampling) - ((window + 1) * oversampling - 1) / 2) * pitch / oversampling
    psf = np.abs(amplitude(coefficients, at, at, wavelength=wavelength, f_number=f_number)) ** 2
    height, width = (side + window for side in shape)
    y, x = np.meshgrid(
        (np.arange(height * oversampling) + 0.5) / oversampling - height / 2,
        (np.arange(width * oversampling) + 0.5) / oversampling - width / 2,
        indexing="ij",
    )
    distance = x * math.cos(angle) + y * math.sin(angle) - offset
    wide, high = (abs(f(angle)) / oversampling for f in (math.cos, math.sin))

    # area of a subpixel on the bright side: a box wide x high's trapezoid, integrated
    def ramp2(t: np.ndarray) -> np.ndarray:
        return np.maximum(t, 0) ** 2 / 2

    far, near = (wide + high) / 2, (wide - high) / 2
    covered = ramp2(distance + far) - ramp2(distance + near) - ramp2(distance - near) + ramp2(distance - far)
    covered = covered / (wide * high)
    size = (covered.shape[0] + psf.shape[0] - 1, covered.shape[1] + psf.shape[1] - 1)
    size = tuple(int(2 ** math.ceil(math.log2(side))) for side in size)
    seen = np.fft.irfft2(np.fft.rfft2(covered, size) * np.fft.rfft2(psf / psf.sum(), size), size)
    half = psf.shape[0] // 2
    seen = seen[half : half + covered.shape[0], half : half + covered.shape[1]]
    pixels = seen.reshape(height, oversampling, width, oversampling).mean((1, 3))
    top, left = (height - shape[0]) // 2, (width - shape[1]) // 2
    return dark + (bright - dark) * pixels[top : top + shape[0], left : left + shape[1]]


def taken(expected: np.ndarray, *, read_noise: float, seed: int) -> np.ndarray:
    """Electrons as a sensor counts and reads them."""
    draws = np.random.default_rng(seed)
    return draws.poisson(expected) + draws.normal(0, read_noise, expected.shape)
