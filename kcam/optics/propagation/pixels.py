"""From the intensity at points to the mean over each pixel."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from kcam.optics.autograd import apply_linear
from kcam.optics.propagation import sampling
from kcam.optics.pupil.quadrants import by_x, join, join_adjoint, parities, split

_FEW = 2**17  # points below which two plain products are faster than their parts by parity


@dataclass(frozen=True)
class Pixels:
    """Pixels over a square grid of points that reaches K points from the axis to each side.

    shape: (H, W); the axis goes through the centre of pixel n // 2. per_pixel: points in each, on each axis.
    active: width of the light-sensitive part of a pixel.
    integrate: the mean over that part; False: the value at the centre, of one point a pixel.
    whole: scaled to the light that whole pixels receive together: of a point, which a sensitive part may hit or miss.
    """

    shape: tuple[int, int]
    per_pixel: float = 1.0
    active: float = 1.0
    integrate: bool = True
    whole: bool = False

    def of_image(self, image: Tensor) -> Tensor:
        """(..., H, W) of the intensity (..., 2K + 1, 2K + 1)."""
        reach = image.shape[-1] // 2
        if self.integrate and image.shape[-1] ** 2 >= _FEW:
            return self.of_quadrants(split(image))
        if self.integrate:
            pixels = apply_linear(image, _Products(*(_box(n, **self._how(reach, image)) for n in self.shape)))
            return self._scaled(pixels, lambda same: same.of_image(image))
        top, left = (reach - n // 2 for n in self.shape)
        return image[..., top : top + self.shape[0], left : left + self.shape[1]]

    def of_quadrant(self, quadrant: Tensor) -> Tensor:
        """(..., H, W) of an intensity that is even in x and y, given for x, y >= 0: (..., J + 1, K + 1)."""
        pixels = quadrant
        if self.integrate:
            reaches = (length - 1 for length in quadrant.shape[-2:])
            even = (2 * _halves(n, **self._how(k, quadrant))[0] for n, k in zip(self.shape, reaches, strict=True))
            pixels = apply_linear(quadrant, _Products(*even))
        for axis, n in ((-1, self.shape[1]), (-2, self.shape[0])):  # each pixel of the quadrant stands on both sides
            mirrored = pixels.narrow(axis, 1, n // 2).flip(axis)
            pixels = torch.cat([mirrored, pixels.narrow(axis, 0, n - n // 2)], dim=axis)
        return self._scaled(pixels, lambda same: same.of_quadrant(quadrant))

    def of_quadrants(self, quadrants: Tensor) -> Tensor:
        """(..., H, W) of the intensity as `split` gives it, (..., 4, K + 1, K + 1)."""
        if not self.integrate or quadrants.numel() < _FEW:
            return self.of_image(join(quadrants, odd=True))
        rows, columns = (_halves(n, **self._how(quadrants.shape[-1] - 1, quadrants)) for n in self.shape)
        pixels = apply_linear(quadrants, _Parities(rows, columns, self.shape))
        return self._scaled(pixels, lambda same: same.of_quadrants(quadrants))

    def _scaled(self, pixels: Tensor, of: Callable[[Pixels], Tensor]) -> Tensor:
        if not self.whole or self.active == 1:
            return pixels
        whole = of(replace(self, active=1.0, whole=False))
        return pixels / pixels.sum((-2, -1), keepdim=True) * whole.sum((-2, -1), keepdim=True)

    def _how(self, reach: int, like: Tensor) -> dict[str, Any]:
        how = {"per_pixel": self.per_pixel, "reach": reach, "active": self.active}
        return how | {"dtype": like.dtype, "device": like.device}


@functools.lru_cache(maxsize=64)
@torch.inference_mode(False)
def _box(pixels: int, *, dtype: torch.dtype, device: torch.device, **grid: Any) -> Tensor:
    return sampling.pixel_box(pixels, **grid).to(device, dtype)


@functools.lru_cache(maxsize=64)
@torch.inference_mode(False)
def _halves(pixels: int, *, dtype: torch.dtype, device: torch.device, **grid: Any) -> Tensor:
    """Even and odd part of `pixel_box` for pixels and points from the axis on, (2, pixels // 2 + 1, reach + 1)."""
    half, reach = pixels // 2, grid["reach"]
    box = sampling.pixel_box(2 * half + 1, **grid)[half:]
    right, left = box[:, reach:].clone(), box[:, : reach + 1].flip(1)
    right[:, 0] = left[:, 0] = right[:, 0] / 2  # the point on the axis is in both halves
    return torch.stack([right + left, right - left]).div_(2).to(device, dtype)


@dataclass(frozen=True)
class _Products:
    """Points (..., M, M) -> pixels (..., H, W) by a matrix for each axis."""

    rows: Tensor
    columns: Tensor

    def forward(self, points: Tensor) -> Tensor:
        """Sums over the points of each pixel."""
        return self.rows @ points @ self.columns.mT

    def adjoint(self, pixels: Tensor) -> Tensor:
        """Transpose of `forward`."""
        return self.rows.mT @ pixels @ self.columns


@dataclass(frozen=True)
class _Parities:
    """Quadrants (..., 4, K + 1, K + 1) -> pixels (..., H, W); with even and odd parts apart, half the operations.

    rows, columns: `_halves` of both axes.
    """

    rows: Tensor
    columns: Tensor
    shape: tuple[int, int]

    def forward(self, quadrants: Tensor) -> Tensor:
        """Sums over the points of each pixel."""
        sums = self._along_both(quadrants, self.rows, self.columns)
        return join(sums, odd=True)[..., : self.shape[0], : self.shape[1]]

    def adjoint(self, pixels: Tensor) -> Tensor:
        """Transpose of `forward`."""
        last = [1 - n % 2 for n in self.shape]  # an even number of pixels has one less on the positive side
        whole = torch.nn.functional.pad(pixels, (0, last[1], 0, last[0]))
        return self._along_both(join_adjoint(whole), self.rows.mT, self.columns.mT)

    def _along_both(self, quadrants: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        batch, (length, width) = quadrants.shape[:-3], quadrants.shape[-2:]
        quadrants = quadrants.reshape(-1, 4, length, width)
        count = quadrants.shape[0]
        folded = quadrants.new_empty(2, 2, count, length, width)  # parity in x, parity in y
        parities(by_x(quadrants), out=folded.flatten(0, 1).unbind())
        along_x = torch.bmm(folded.view(2, -1, width), columns.mT).view(*folded.shape[:-1], columns.shape[-2])
        sums = [rows[y] @ along_x[x, y] for x, y in itertools.product(range(2), range(2))]
        result = quadrants.new_empty(count, 4, *sums[0].shape[1:])
        parities(sums, out=by_x(result))
        return result.view(*batch, *result.shape[1:])
