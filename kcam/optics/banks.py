"""PSFs that are computed once: of points on the axis for a planner; at places of the sensor, those that mirror each
other share theirs, and so do wavelengths.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor

from kcam.cache import value_of
from kcam.optics.source import PixelGrid
from kcam.optics.wavelengths import chebyshev_wavelengths

_COLOURS = (5, 7, 10, 14, 20)  # wavelengths at which PSFs are computed
OUTSIDE = 5e-3
"""Share of the light that the default window may leave out; it is put back into the window, see `Imaging`."""
KEPT = 2e8  # bytes of PSFs that are kept
_HALVINGS = 30

T = TypeVar("T")
OnAxis = Callable[[Tensor, Tensor, PixelGrid], Tensor]
"""PSFs (Z, L, h, w) of vergences (Z,), at wavelengths (L,), on pixels."""

Compute = Callable[[Tensor, Tensor, PixelGrid, bool], Tensor]
"""PSFs (F, Z, L, h, w) of places (F, 2), at wavelengths (L,), on pixels, whole or not: see `source.FieldPSFs`."""


@dataclass(frozen=True)
class KnownPSFs:
    """PSFs of points on the axis, each kept by itself: a smaller window has the middle of a larger one. For a planner,
    which asks for the same ones again and again; up to `KEPT` bytes.

    ends: wavelengths (2,) that are computed with those asked for, so that any part of a spectrum is computed alike.
    psfs: (h, w), by all that they depend on. windows: by what was asked. others: what else is known of the same optics,
    see `keep`. seen: of scenes and lenses, see `once`.
    """

    remembers: ClassVar[bool] = True  # and is no part of what a stage is, see `cache.value_of`

    ends: Tensor
    psfs: dict[tuple[object, ...], Tensor] = field(default_factory=dict, repr=False)
    windows: dict[tuple[object, ...], tuple[int, int]] = field(default_factory=dict, repr=False)
    others: dict[tuple[object, ...], Any] = field(default_factory=dict, repr=False)
    seen: dict[tuple[object, ...], tuple[object, Any]] = field(default_factory=dict, repr=False)

    def bank(self, how: object, vergences: Tensor, wavelengths: Tensor, pixels: PixelGrid, compute: OnAxis) -> Tensor:
        """PSFs (Z, L, h, w); how: what else they depend on."""
        how = how, replace(pixels, shape=(1, 1))
        rows, columns = ([(how, value) for value in values.tolist()] for values in (vergences, wavelengths))
        missing = torch.tensor([[not self._holds((row, column), pixels.shape) for column in columns] for row in rows])
        if bool(missing.any()):
            size = math.prod(missing.shape) * math.prod(pixels.shape) * pixels.dtype.itemsize
            if sum(psf.nbytes for psf in self.psfs.values()) + size > KEPT:
                return compute(vergences, wavelengths, pixels)
            layers, colours = vergences[missing.any(1).to(vergences.device)], wavelengths[missing.any(0)]
            asked = torch.cat([colours, self.ends.to(colours)]).unique()
            for value, psfs in zip(layers.tolist(), compute(layers, asked, pixels), strict=True):
                self.psfs.update({((how, value), (how, w)): psf for w, psf in zip(asked.tolist(), psfs, strict=True)})
        return torch.stack(
            [torch.stack([middle(self.psfs[row, column], pixels.shape) for column in columns]) for row in rows]
        )

    def window(
        self, vergences: Tensor, wavelengths: Tensor, pixels: PixelGrid, compute: Callable[[], tuple[int, int]]
    ) -> tuple[int, int]:
        """The window of PSFs, as `PSFSource` tells it."""
        key = tuple(vergences.tolist()), tuple(wavelengths.tolist()), pixels
        if key not in self.windows:
            self.windows[key] = compute()
        return self.windows[key]

    def keep(self, key: tuple[object, ...], value: Any) -> None:
        """Know a dataclass of tensors too, while all of these are together below `KEPT` bytes."""
        tensors: list[Tensor] = []
        value_of((*self.others.values(), value), tensors)
        if sum(tensor.nbytes for tensor in tensors) <= KEPT:
            self.others[key] = value

    def once(self, parts: tuple[object, ...], how: object, look: Callable[[], T]) -> T:
        """What a look at parts of a scene, or of optics, tells, which stay as they are and the same objects; how: and
        what else.
        """
        key = *map(id, parts), how
        if key not in self.seen:
            self.seen[key] = parts, look()  # held, so that nothing else gets their place
        found: T = self.seen[key][1]
        return found

    def _holds(self, key: tuple[object, ...], shape: tuple[int, int]) -> bool:
        known = self.psfs.get(key)
        return known is not None and all(n >= m for n, m in zip(known.shape, shape, strict=True))


def middle(psf: Tensor, shape: tuple[int, int]) -> Tensor:
    """The middle (..., h, w) of PSFs with a larger window, not copied."""
    for dim, length in zip((-2, -1), shape, strict=True):
        psf = psf.narrow(dim, psf.shape[dim] // 2 - length // 2, length)
    return psf


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

    kept: dict[tuple[object, ...], Tensor] = field(default_factory=dict, repr=False)  # of each place

    def bank(
        self,
        places: Tensor,
        pixels: PixelGrid,
        *,
        whole: bool = False,
        mixing: Tensor | None = None,
        colours: float = math.inf,
    ) -> Tensor:
        """PSFs (F, Z, L, h, w) of places (F, 2) [m]; of many wavelengths the PSFs' pixels are polynomials through those
        of a few. Without gradients they are kept, up to `KEPT` bytes. whole, mixing, colours: see `source.FieldPSFs`.
        """
        height, width = pixels.shape
        odd = replace(pixels, shape=(height + 1 - height % 2, width + 1 - width % 2))  # about the middle
        grain = 1e-6 * pixels.pitch
        own, which = ((places.abs() if self.mirrored else places) / grain).round().unique(dim=0, return_inverse=True)
        how = (odd, whole, colours, _bytes(mixing), torch.is_grad_enabled())  # those without a graph never serve one
        keys = [(how, *place) for place in own.tolist()]
        found = {key: self.kept[key] for key in keys if key in self.kept}
        if missing := [row for row, key in enumerate(keys) if key not in found]:
            psfs = self._compute(own[missing] * grain, odd, whole=whole, mixing=mixing, colours=colours)
            found |= zip((keys[row] for row in missing), psfs, strict=True)
            if not psfs.requires_grad and self.held + psfs.nbytes <= KEPT:
                self.kept.update(found)
        return torch.stack([self._turned(found[keys[row]], place) for row, place in zip(which, places, strict=True)])[
            ..., :height, :width
        ]

    def _turned(self, psf: Tensor, place: Tensor) -> Tensor:
        """That of a place with positive x and y, as it is at one that mirrors it."""
        turned = [axis for axis, side in zip((-1, -2), place.tolist(), strict=True) if self.mirrored and side < 0]
        return psf.flip(turned) if turned else psf

    @property
    def held(self) -> int:
        """Bytes of the PSFs that are kept."""
        return sum(psf.nbytes for psf in [*self.kept.values()])

    @property
    def fewer(self) -> tuple[int, ...]:
        """How many wavelengths may stand for all."""
        return tuple(n for n in _COLOURS if n < len(self.wavelengths)) if self.few else ()

    def _few(self, count: float) -> tuple[Tensor, Tensor]:
        """So many wavelengths, at most all, and what each gives to those that are asked for."""
        if count >= len(self.wavelengths):
            return self.wavelengths, torch.eye(len(self.wavelengths), dtype=torch.float64)
        return chebyshev_wavelengths(self.wavelengths, int(count))

    def _compute(
        self, places: Tensor, pixels: PixelGrid, *, whole: bool, mixing: Tensor | None, colours: float
    ) -> Tensor:
        nodes, shares = self._few(colours)
        psfs = self.compute(places, nodes, pixels, whole)
        if mixing is not None:
            shares = mixing.to(shares) @ shares
        if mixing is not None or len(nodes) < len(self.wavelengths):  # else each stands for itself
            psfs = torch.einsum("ln,fznhw->fzlhw", shares.to(psfs), psfs)
        return psfs.to(pixels.device)


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
