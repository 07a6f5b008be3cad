"""What a style is measured on: the layers of features of a picture.

A module from a picture (B,3,H,W), sRGB in [0,1], to a dictionary of layers, name -> (B,C,h,w). `SteerableFeatures`
needs no weights; `kcam.style.vgg` has the network of the papers.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from kcam.inputs import check_picture

SCALES = 4
ORIENTATIONS = 6
BANDWIDTH = 0.62  # of the radial log-Gaussian, in ln(frequency)
FINEST = 0.32  # centre of the finest scale [cycles / pixel]
ANGULAR = math.pi / 6 / 1.3  # sigma of the angular Gaussian [rad]
GAIN = 6.0
MAGNITUDE_FLOOR = 1e-8  # inside the root: |c| has no slope at 0
GRAY = 0.45  # what a picture is measured from

OPPONENT = ((2 / 3, 2 / 3, 2 / 3), (1.0, 0.0, -1.0), (-0.5, 1.0, -0.5))
"""Rows: luminance, red against blue, green against both."""

NATURAL = {"colour": 0.25, "low": 0.2, "scale 0": 0.02, "scale 1": 0.008, "scale 2": 0.003, "scale 3": 0.0013}
"""Variance per channel of each layer, of kcam's four built-in photographs: what a flat style is measured against."""


def check_pictures(picture: Tensor, *, multiple: int, least: int) -> None:
    """TypeError, ValueError unless it is (B,3,H,W) of a size that the features can be taken of."""
    check_picture(picture, name="picture", takes="(B,3,H,W)", channels=(3,), ndims=(4,), within=None)
    height, width = picture.shape[-2:]
    if min(height, width) < least or height % multiple or width % multiple:
        better = tuple(max(least, size // multiple * multiple) for size in (height, width))
        raise ValueError(
            f"a picture of {height} x {width} has no features: both sides must be multiples of {multiple} and at least "
            f"{least} pixels. Crop or resize it, to {better[0]} x {better[1]} for instance."
        )


class SteerableFeatures(nn.Module):
    """A steerable pyramid of complex log-Gabor filters: texture features without weights and without a seed.

    y = M (x - 0.45), M in opponent colours, and for scale s = 0..3 and orientation k = 0..5

        c_sk = IFFT[ 2 exp(-ln^2(f 2^s / 0.32) / (2 0.62^2)) exp(-(angle - k pi / 6)^2 / (2 sigma^2)) FFT[y] ],
        sigma = pi / 6 / 1.3,   |f| < 0.5 / 2^s,   0 at f = 0

    decimated to 1 / 2^s by cropping the spectrum and scaled by 6 / 2^s. The layer of scale s holds |c_s|, |c_(s+1)|
    brought to its size (not the last), Re c_s and max(Re c_s, 0): 72 or 54 channels. The layer "low" holds 2 y averaged
    over 8 x 8 pixels and its positive part, "colour" 2 y, its positive part and its square. The picture is periodic.

    Args:      picture, to the call: (B,3,H,W) sRGB in [0,1], H and W multiples of 16 and at least 64.
    Returns:   from the call: {"colour", "low", "scale 0", .., "scale 3"}: (B,C,h,w).
    Raises:    TypeError for another type; ValueError for another shape.
    Source:    Field, Relations between the statistics of natural images and the response properties of cortical cells
               (1987), the log-Gabor filter; Portilla and Simoncelli, A parametric texture model based on joint
               statistics of complex wavelet coefficients (2000), which coefficients tell textures apart.

    Example:
    >>> from kcam.style import SteerableFeatures
    >>> layers = SteerableFeatures()(torch.rand(1, 3, 64, 64))
    >>> {name: tuple(layer.shape) for name, layer in layers.items() if "scale" in name}
    {'scale 0': (1, 72, 64, 64), 'scale 1': (1, 72, 32, 32), 'scale 2': (1, 72, 16, 16), 'scale 3': (1, 54, 8, 8)}
    """

    name = "steerable"
    multiple = 16
    least = 64
    natural = NATURAL

    def __init__(self) -> None:
        super().__init__()
        self._filters: dict[tuple, list[Tensor]] = {}

    def forward(self, picture: Tensor) -> dict[str, Tensor]:
        """The layers of a picture."""
        check_pictures(picture, multiple=self.multiple, least=self.least)
        matrix = picture.new_tensor(OPPONENT)
        y = torch.einsum("nc,bchw->bnhw", matrix, picture - GRAY)
        double = 2 * y
        low = F.avg_pool2d(double, 8)
        layers = {
            "colour": torch.cat([double, F.relu(double), double.square()], dim=1),
            "low": torch.cat([low, F.relu(low)], dim=1),
        }
        spectrum = torch.fft.fft2(y)
        scales = [self._scale(spectrum, filters, scale) for scale, filters in enumerate(self._bank(y))]
        magnitudes = [(c.real.square() + c.imag.square() + MAGNITUDE_FLOOR).sqrt() for c in scales]
        for scale, (c, magnitude) in enumerate(zip(scales, magnitudes, strict=True)):
            parent = [_doubled(magnitudes[scale + 1])] if scale + 1 < SCALES else []
            layers[f"scale {scale}"] = torch.cat([magnitude, *parent, c.real, F.relu(c.real)], dim=1)
        return layers

    def _scale(self, spectrum: Tensor, filters: Tensor, scale: int) -> Tensor:
        """The coefficients of a scale, (B,18,h,w) complex."""
        height, width = filters.shape[-2:]
        low = _low_frequencies(spectrum, height, width)
        decimated = low[:, :, None] * filters * (GAIN * 0.5**scale * 0.25**scale)
        return torch.fft.ifft2(decimated).flatten(1, 2)

    def _bank(self, y: Tensor) -> list[Tensor]:
        """The filters of each scale, (6,h,w)."""
        key = (*y.shape[-2:], y.dtype, y.device)
        if key not in self._filters:
            with torch.inference_mode(False):  # what is kept must serve training too
                self._filters[key] = [
                    _filters(*y.shape[-2:], scale=scale).to(y.device, y.dtype) for scale in range(SCALES)
                ]
        return self._filters[key]


def _filters(height: int, width: int, *, scale: int) -> Tensor:
    """Transfer functions of one scale on the frequencies that are kept, (6,h,w) float64."""
    rows, columns = (torch.fft.fftfreq(size, dtype=torch.float64) for size in (height, width))
    v = _low_frequencies(rows[:, None], height >> scale, 1)
    u = _low_frequencies(columns[None], 1, width >> scale)
    radius = torch.hypot(u, v)
    inside = (radius > 0) & (radius < 0.5 / 2**scale)
    octaves = torch.log(torch.where(inside, radius, 1.0) * 2**scale / FINEST)
    radial = torch.where(inside, torch.exp(-(octaves**2) / (2 * BANDWIDTH**2)), 0.0)
    direction = torch.arange(ORIENTATIONS, dtype=torch.float64)[:, None, None] * (math.pi / ORIENTATIONS)
    turn = torch.remainder(torch.atan2(v, u) - direction + math.pi, 2 * math.pi) - math.pi
    return 2 * radial * torch.exp(-(turn**2) / (2 * ANGULAR**2))


def _low_frequencies(spectrum: Tensor, height: int, width: int) -> Tensor:
    """The height x width frequencies around 0 of a spectrum in the order of the FFT."""
    for dim, size in ((-2, height), (-1, width)):
        full = spectrum.shape[dim]
        if size < full:
            parts = (spectrum.narrow(dim, 0, size // 2), spectrum.narrow(dim, full - size // 2, size // 2))
            spectrum = torch.cat(parts, dim)
    return spectrum


def _doubled(plane: Tensor) -> Tensor:
    """Twice the size, bilinear and periodic, as the transform is: so that rolling a picture rolls its features."""
    height, width = plane.shape[-2:]
    around = F.pad(plane, (1, 1, 1, 1), mode="circular")
    large = F.interpolate(around, scale_factor=2, mode="bilinear", align_corners=False)
    return large[..., 2 : 2 + 2 * height, 2 : 2 + 2 * width]
