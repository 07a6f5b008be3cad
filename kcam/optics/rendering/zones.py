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

from kcam.optics.autograd import add_at, cut
from kcam.optics.numerics import linear_weights
from kcam.optics.rendering.borders import extend

_NOTHING = 1e-9  # of a share
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
        end = (n - 1) / 2 if count > 1 else 0.0
        nodes = torch.linspace(-end, end, count, dtype=torch.float64)
        at = torch.arange(-(window // 2), n + (window - 1) // 2, dtype=torch.float64) - (n - 1) / 2
        weights = linear_weights(nodes, at).T
        weights[weights < _NOTHING] = 0  # of a node on a pixel, rounding leaves some on one side, and not on its twin's
        own = [row.nonzero()[:, 0] for row in weights]
        return cls(nodes, weights, [int(pixels[0]) for pixels in own], [int(pixels[-1]) + 1 for pixels in own])

    def reach(self, index: int) -> tuple[int, int]:
        """The first pixel in which a node has a share, and that behind the last."""
        return self.first[index], self.last[index]

    def twins(self, mirrored: bool) -> list[list[int]]:
        """Nodes that are worked on together: from the middle on, each with the one that mirrors it."""
        count = len(self.nodes)
        if not mirrored:
            return [[index] for index in range(count)]
        return [sorted({index, count - 1 - index}, reverse=True) for index in range(count // 2, count)]


def blend(
    planes: Tensor,
    shares: Tensor | None,
    bank: Bank,
    render: Render,
    *,
    nodes: tuple[Axis, Axis],
    window: tuple[int, int],
    border: str,
    mirrored: bool = False,
) -> Tensor:
    """The picture (B, C, H, W) of planes (B, K, H, W), with PSFs at nodes along rows and columns of a window of pixels.

    mirrored: nodes that mirror each other have PSFs that do. Then light is mirrored instead, and one transfer function
    serves four zones. Where gradients are asked for, these are computed again on the way back.
    """
    height, width = planes.shape[-2:]
    rows, columns = nodes
    planes = extend(planes, window, border)
    if shares is not None:  # what hides the light of a zone may stand beyond what it reaches
        wide = (4 * window[0], 4 * window[1])
        shares = extend(shares, wide, "replicate" if border == "zero" else border)
    bands = cut(planes, [(slice(*rows.reach(row)), slice(None)) for row in range(len(rows.nodes))])

    def light_of(psf: Tensor, twins: list[_Zone], bands: list[Tensor]) -> tuple[Tensor, ...]:
        """Of zones that mirror each other, of bands of their rows."""
        turns = [[-2] * (zone.row != twins[0].row) + [-1] * (zone.column != twins[0].column) for zone in twins]
        turned = list(zip(twins, bands, turns, strict=True))
        if shares is None:
            found = render(psf, torch.cat([zone.cut(band, turn) for zone, band, turn in turned]), None, border="dark")
        else:
            seen = torch.cat([zone.cut_wide(band, turn) for zone, band, turn in turned])
            hidden = torch.cat([zone.cut_shares(shares).flip(turn) for zone, _, turn in turned])
            found = twins[0].inside(render(psf, seen, hidden))
        return tuple(part.flip(turn) for part, turn in zip(found.split(len(planes)), turns, strict=True))

    result = planes.new_zeros(())
    again = torch.is_grad_enabled()
    sides = columns.twins(mirrored)
    middle = columns.nodes[[twins[0] for twins in sides]]
    for row_twins in rows.twins(mirrored):
        lights: dict[int, Tensor] = {}
        psfs = bank(torch.cartesian_prod(rows.nodes[row_twins[:1]], middle).flip(1))
        for psf, column_twins in zip(psfs, sides, strict=True):
            twins = [_Zone(rows, columns, row, column, window) for row in row_twins for column in column_twins]
            arguments = psf, twins, [bands[zone.row] for zone in twins]
            found = checkpoint(light_of, *arguments, use_reentrant=False) if again else light_of(*arguments)
            for zone, part in zip(twins, found, strict=True):
                light = lights.get(zone.row)
                if light is None:
                    light = part.new_zeros(*part.shape[:-1], width + 2 * (window[1] - 1))
                left = columns.first[zone.column]
                lights[zone.row] = add_at(light, part, (slice(None), slice(left, left + part.shape[-1])))
        for row, light in lights.items():
            if not result.ndim:
                result = light.new_zeros(*light.shape[:-2], height, width)
            top = rows.first[row] - (window[0] - 1)  # of the picture
            seen = slice(max(0, -top), min(light.shape[-2], height - top))
            (own,) = cut(light, [(seen, slice(window[1] - 1, window[1] - 1 + width))])
            result = add_at(result, own, (slice(top + seen.start, top + seen.stop), slice(None)))
    return result


@dataclass(frozen=True)
class _Zone:
    """What one node has a share in. Where it is cut, it may be turned about some dimensions."""

    rows: Axis
    columns: Axis
    row: int
    column: int
    window: tuple[int, int]

    def cut(self, band: Tensor, turn: list[int]) -> Tensor:
        """The node's share of its rows of planes, that come with their border."""
        return self._own(band).flip(turn)

    def cut_wide(self, band: Tensor, turn: list[int]) -> Tensor:
        """The node's share, and the dark around it, where what hides the light of a zone may stand."""
        sides = [((m - 1) // 2 + m - 1, m // 2 + m - 1) for m in self.window]
        return torch.nn.functional.pad(self._own(band).flip(turn), [*sides[1], *sides[0]])

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
