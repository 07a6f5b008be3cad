"""From the intensity at points to the mean over each pixel."""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from kcam.optics import sampling
from kcam.optics.linear import apply_linear
from kcam.optics.quadrants import by_x, join, join_adjoint, parities


def to_pixels(
    quadrants: Tensor,
    shape: tuple[int, int],
    *,
    per_pixel: float = 1.0,
    active: float = 1.0,
    integrate: bool = True,
) -> Tensor:
    """Mean intensity over each pixel, or its value at the centre: (..., H, W).

    Args:
        quadrants: (..., 4, K + 1, K + 1) of the intensity at `per_pixel` points a pixel, as `split` gives them.
        shape: (H, W) pixels; the axis goes through the centre of pixel n // 2.
        active: width of the light-sensitive part of a pixel. integrate: False takes the values at the centres, of one
        point a pixel.
    """
    height, width = (n // 2 + 1 for n in shape)
    if not integrate:
        return join(quadrants[..., :height, :width], odd=True)[..., : shape[0], : shape[1]]
    reach = quadrants.shape[-1] - 1
    rows, columns = (
        _halves(n, per_pixel=per_pixel, reach=reach, active=active, dtype=quadrants.dtype, device=quadrants.device)
        for n in shape
    )
    pixels = apply_linear(quadrants.flatten(0, -4), _PixelSums(rows, columns, shape))
    return pixels.unflatten(0, quadrants.shape[:-3])


@functools.lru_cache(maxsize=16)
@torch.inference_mode(False)
def _halves(
    pixels: int, *, per_pixel: float, reach: int, active: float, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Even and odd part of `pixel_box` for pixels and points from the axis on, (2, pixels // 2 + 1, reach + 1)."""
    half = pixels // 2
    box = sampling.pixel_box(2 * half + 1, per_pixel=per_pixel, reach=reach, active=active)[half:]
    right, left = box[:, reach:].clone(), box[:, : reach + 1].flip(1)
    right[:, 0] = left[:, 0] = right[:, 0] / 2  # the point on the axis is in both halves
    return torch.stack([right + left, right - left]).div_(2).to(device, dtype)


@dataclass(frozen=True)
class _PixelSums:
    """Quadrants (B, 4, K + 1, K + 1) -> pixels (B, H, W); with even and odd parts apart, half the operations.

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
        count, _, length, width = quadrants.shape
        folded = quadrants.new_empty(2, 2, count, length, width)  # parity in x, parity in y
        parities(by_x(quadrants), out=folded.flatten(0, 1).unbind())
        along_x = torch.bmm(folded.view(2, -1, width), columns.mT).view(*folded.shape[:-1], columns.shape[-2])
        sums = [rows[y] @ along_x[x, y] for x, y in itertools.product(range(2), range(2))]
        result = quadrants.new_empty(count, 4, *sums[0].shape[1:])
        parities(sums, out=by_x(result))
        return result
