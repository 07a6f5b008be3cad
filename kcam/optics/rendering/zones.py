"""A picture whose PSF varies over it: bilinear windows before the convolution, each with the PSF of its node.

    I(x) = sum_n (w_n I_0) * h_n,   sum_n w_n = 1

Light is shared out among the nodes where it comes *from*, so that a node's PSF spreads what lies around that node, and
what the windows share out is all there was. Between two nodes the error is of second order in their distance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from kcam.optics.numerics import linear_weights
from kcam.optics.rendering.borders import extend

Bank = Callable[[Tensor], Iterable[Tensor]]
"""PSFs (Z, G, h, w) of places (N, 2), x and y in pixels from the picture's middle, as the upright picture has it."""
Render = Callable[..., Tensor]
"""Light (B, C, H, W) of PSFs (Z, G, h, w), planes (B, K, H, W) and shares of layers (B, Z, H, W); dark all around, or
with a border="dark"."""


@dataclass(frozen=True)
class Axis:
    """Nodes along one axis of a picture of n pixels with a border, and which pixels each has a share in."""

    nodes: Tensor  # (N,) pixels from the middle
    weights: Tensor  # (N, n + border) of the pixels with their border
    first: list[int]  # in which a node has a share, and behind the last
    last: list[int]

    @classmethod
    def of(cls, n: int, window: int, *, apart: float) -> Axis:
        """Nodes at both ends and at most `apart` pixels from the next; of inf one, that stands for all."""
        count = 1 + math.ceil((n - 1) / apart)
        nodes = (
            torch.linspace(-(n - 1) / 2, (n - 1) / 2, count, dtype=torch.float64) if n > 1 else torch.zeros(1).double()
        )
        at = torch.arange(-(window // 2), n + (window - 1) // 2, dtype=torch.float64) - (n - 1) / 2
        weights = linear_weights(nodes, at).T
        own = [row.nonzero()[:, 0] for row in weights]
        return cls(nodes, weights, [int(pixels[0]) for pixels in own], [int(pixels[-1]) + 1 for pixels in own])


def blend(
    planes: Tensor,
    shares: Tensor | None,
    bank: Bank,
    render: Render,
    *,
    window: tuple[int, int],
    apart: float,
    border: str,
) -> Tensor:
    """The picture (B, C, H, W) of planes (B, K, H, W), with PSFs at nodes at most `apart` pixels from the next.

    Two rows of nodes at a time, which mirror each other: their PSFs too, where the optics are centred. Where gradients
    are asked for, these are computed again on the way back.
    """
    height, width = picture = (planes.shape[-2], planes.shape[-1])
    rows, columns = (Axis.of(n, m, apart=apart) for n, m in zip(picture, window, strict=True))
    planes = extend(planes, window, border)
    if shares is not None:  # what hides the light of a zone may stand beyond what it reaches
        wide = (4 * window[0], 4 * window[1])
        shares = extend(shares, wide, "replicate" if border == "zero" else border)

    def strips(planes: Tensor, shares: Tensor | None, pair: list[int]) -> list[Tensor]:
        places = torch.cartesian_prod(rows.nodes[pair], columns.nodes).flip(1)
        psfs = iter(bank(places))
        lights = []
        for row in pair:
            band, light = planes[..., rows.first[row] : rows.last[row], :], planes.new_zeros(())
            for column in range(len(columns.nodes)):
                zone, psf = _Zone(rows, columns, row, column, window), next(psfs)
                if shares is None:
                    found = render(psf, zone.cut(band), None, border="dark")
                else:
                    found = zone.inside(render(psf, zone.cut_wide(band), zone.cut_shares(shares)))
                if not column:
                    light = found.new_zeros(*found.shape[:-1], width + 2 * (window[1] - 1))
                left = columns.first[column]
                light[..., left : left + found.shape[-1]] += found
            lights.append(light[..., window[1] - 1 : window[1] - 1 + width])
        return lights

    result = planes.new_zeros(())
    count = len(rows.nodes)
    for first in range((count + 1) // 2):
        pair = sorted({first, count - 1 - first})
        if torch.is_grad_enabled():
            lights = checkpoint(strips, planes, shares, pair, use_reentrant=False)
        else:
            lights = strips(planes, shares, pair)
        for row, light in zip(pair, lights, strict=True):
            if not result.ndim:
                result = light.new_zeros(*light.shape[:-2], height, width)
            top = rows.first[row] - (window[0] - 1)  # of the picture
            cut = slice(max(0, -top), min(light.shape[-2], height - top))
            result[..., top + cut.start : top + cut.stop, :] += light[..., cut, :]
    return result


@dataclass(frozen=True)
class _Zone:
    """What one node has a share in."""

    rows: Axis
    columns: Axis
    row: int
    column: int
    window: tuple[int, int]

    def cut(self, band: Tensor) -> Tensor:
        """The node's share of its rows of planes, that come with their border, and before it the dark that its PSF
        reaches: around the transform it is that behind it too.
        """
        return torch.nn.functional.pad(self._own(band), [self.window[1] - 1, 0, self.window[0] - 1, 0])

    def cut_wide(self, band: Tensor) -> Tensor:
        """The node's share, and the dark around it, where what hides the light of a zone may stand."""
        sides = [((m - 1) // 2 + m - 1, m // 2 + m - 1) for m in self.window]
        return torch.nn.functional.pad(self._own(band), [*sides[1], *sides[0]])

    def inside(self, light: Tensor) -> Tensor:
        """What the PSF reaches, of the light of `cut_wide`."""
        (above, before), (height, width) = (m - 1 for m in self.window), light.shape[-2:]
        return light[..., above : height - above, before : width - before]

    def _own(self, band: Tensor) -> Tensor:
        top, bottom = self.rows.first[self.row], self.rows.last[self.row]
        left, right = self.columns.first[self.column], self.columns.last[self.column]
        weights = self.rows.weights[self.row, top:bottom, None] * self.columns.weights[self.column, left:right]
        return band[..., left:right] * weights.to(band)

    def cut_shares(self, shares: Tensor) -> Tensor:
        """Shares of layers there, and as far again around it as the PSF reaches; they come with a border of 4."""
        places = []
        for axis, index, m in ((self.rows, self.row, self.window[0]), (self.columns, self.column, self.window[1])):
            start = axis.first[index] - m // 2 + 2 * m - (m - 1) // 2 - (m - 1)
            places.append(slice(start, start + axis.last[index] - axis.first[index] + 3 * (m - 1)))
        return shares[..., places[0], places[1]]
