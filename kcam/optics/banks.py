"""PSFs at places of the sensor, computed once: places that mirror each other share theirs, and so do wavelengths."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from kcam.optics.numerics import chebyshev_between, lagrange_weights
from kcam.optics.source import PixelGrid

_COLOURS = (5, 7, 10, 14, 20)  # wavelengths at which PSFs are computed
COLOUR_ERROR = 1e-2
OUTSIDE = 5e-3
"""Share of the light that the default window may leave out; it is put back into the window, see `Imaging`."""
KEPT = 2e8  # bytes of PSFs that are kept
_HALVINGS = 30

Compute = Callable[[Tensor, Tensor, PixelGrid, bool], Tensor]
"""PSFs (F, Z, L, h, w) of places (F, 2), at wavelengths (L,), on pixels, whole or not: see `source.FieldPSFs`."""


@dataclass(frozen=True)
class Banks:
    """What `compute` finds for wavelengths (L,) and places up to `reach` [m], kept for another picture.

    mirrored: whether PSFs of places that mirror each other in x or y do so too. few: whether the PSFs' pixels may be
    polynomials of the wavelength.
    """

    compute: Compute
    wavelengths: Tensor
    reach: float
    mirrored: bool = True
    few: bool = True

    kept: dict[tuple[object, ...], tuple[Tensor, Tensor, float]] = field(default_factory=dict, repr=False)
    kept_banks: dict[tuple[object, ...], Tensor] = field(default_factory=dict, repr=False)

    def bank(
        self,
        places: Tensor,
        pixels: PixelGrid,
        *,
        whole: bool = False,
        mixing: Tensor | None = None,
        mixed: bool = False,
    ) -> Tensor:
        """PSFs (F, Z, L, h, w) of places (F, 2) [m]; of many wavelengths the PSFs' pixels are polynomials through those
        of a few (`colours`). Without gradients they are kept, up to `KEPT` bytes. whole, mixing, mixed:
        see `source.FieldPSFs`.
        """
        key = (pixels, whole, mixed, _bytes(mixing), _bytes(places))
        if key in self.kept_banks:
            return self.kept_banks[key]
        found = self._distinct(places, pixels, whole=whole, mixing=mixing, mixed=mixed).to(pixels.device)
        held = sum(bank.nbytes for bank in self.kept_banks.values())
        if not found.requires_grad and held + found.nbytes <= KEPT:
            self.kept_banks[key] = found
        return found

    def _distinct(
        self, places: Tensor, pixels: PixelGrid, *, whole: bool, mixing: Tensor | None, mixed: bool
    ) -> Tensor:
        height, width = pixels.shape
        odd = replace(pixels, shape=(height + 1 - height % 2, width + 1 - width % 2))  # about the middle
        grain = 1e-6 * pixels.pitch
        own, which = ((places.abs() if self.mirrored else places) / grain).round().unique(dim=0, return_inverse=True)
        nodes, shares, _ = self.colours(pixels, mixing)
        psfs = self.compute(own * grain, nodes, odd, whole)
        if mixed and mixing is not None:
            shares = mixing.to(shares) @ shares
        if mixed or len(nodes) < len(self.wavelengths):
            psfs = torch.einsum("ln,fznhw->fzlhw", shares.to(psfs), psfs)
        psfs = psfs[which]
        if self.mirrored:
            psfs = torch.stack(
                [
                    psf.flip([axis for axis, side in ((-1, x), (-2, y)) if side < 0])
                    for psf, (x, y) in zip(psfs, places.tolist(), strict=True)
                ]
            )
        return psfs[..., :height, :width]

    def colours(self, pixels: PixelGrid, mixing: Tensor | None = None) -> tuple[Tensor, Tensor, float]:
        """Wavelengths (n,) at which PSFs are computed, and what each gives to those that are asked for, (L, n): as few
        as leave `COLOUR_ERROR` of the light in what the picture adds up of them; and what these leave.
        """
        key = (pixels, _bytes(mixing))
        if key not in self.kept:
            self.kept[key] = self._fewest(pixels, mixing)
        return self.kept[key]

    @torch.no_grad()
    def _fewest(self, pixels: PixelGrid, mixing: Tensor | None) -> tuple[Tensor, Tensor, float]:
        every = torch.eye(len(self.wavelengths), dtype=torch.float64)
        if len(self.wavelengths) <= _COLOURS[0] or not self.few:
            return self.wavelengths, every, 0.0
        places = torch.tensor([[0.0, 0.0], [0.42, 0.56]], dtype=torch.float64) * self.reach
        mixing = every if mixing is None else mixing.double().cpu()
        mixing = mixing / mixing.abs().sum(1, keepdim=True).clamp(min=1e-300)
        truth = self.compute(places, self.wavelengths, pixels, False)
        truth = torch.einsum("ml,fzlhw->fzmhw", mixing.to(pixels.dtype), truth)
        for n in _COLOURS:
            if n >= len(self.wavelengths):
                break
            nodes = chebyshev_between(*self.wavelengths.aminmax(), n)
            shares = lagrange_weights(nodes, self.wavelengths)
            found = self.compute(places, nodes, pixels, False)
            found = torch.einsum("mn,fznhw->fzmhw", (mixing @ shares).to(truth), found)
            off = float((found - truth).abs().sum((-2, -1)).max())
            if off < COLOUR_ERROR:
                return nodes, shares, off
        return self.wavelengths, every, 0.0


def window_side(slopes: Tensor, tail: Tensor, *, pitch: float) -> int:
    """Pixels of the window that holds all but `OUTSIDE` of the light of any of N points.

    slopes: how far equal shares of their light fall from the middle by rays, (N, Q) [m]. tail: of (N, 1), such that
    tail / r of a ray's light is diffracted beyond a radius r: of each that falls x from the middle, tail / (r - x).
    """
    low, high = slopes.new_zeros(len(slopes), 1), slopes.amax(1, keepdim=True) + tail / OUTSIDE
    for _ in range(_HALVINGS):
        radius = (low + high) / 2
        left = (radius - slopes).clamp(min=1e-12)
        beyond = (tail / left).clamp(max=1).mean(1, keepdim=True)
        low, high = torch.where(beyond > OUTSIDE, radius, low), torch.where(beyond > OUTSIDE, high, radius)
    return 2 * math.ceil(float(high.max()) / pitch) + 1


def _bytes(values: Tensor | None) -> bytes | None:
    return None if values is None else values.detach().cpu().numpy().tobytes()
