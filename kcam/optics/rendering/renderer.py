"""From the planes of a scene and a bank of PSFs to the light in each channel, with the work that this is."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import torch
from torch import Tensor

from kcam.effects import Work
from kcam.optics.numerics import fast_length
from kcam.optics.rendering.borders import part
from kcam.optics.rendering.place import Place
from kcam.optics.rendering.ways import Bank, choose

_NEAR = 2**20  # pixels beyond which a plane is no longer near the processor
_CUT = ("reflect", "replicate", "zero")  # borders beyond which is only what lies near them
_SAVED = 0.8  # of the work for a layer: less of it is worth cutting out where it is
_length = functools.lru_cache(maxsize=4096)(fast_length)  # what is compiled asks for none


class Renderer(Bank):
    """Convolves pictures (B, K, H, W) with a bank of PSFs (Z, G, h, w), contracted to the channels. Args: as `Bank`."""

    def blur(self, planes: Tensor, *, layer: int) -> Tensor:
        """The scene's planes (B, K, H, W) through the PSFs of one layer: (B, C, H, W)."""
        return self.in_squares(planes, choose(self, len(planes)).blur(self, self.psfs[layer]))

    def coverage(self, share: Tensor, *, layer: int) -> Tensor:
        """How masks (B, 1, H, W) spread in each channel, relative to the PSFs' own sum: (B, C, H, W)."""
        weights = self.kappa()
        sums = self.grouped(weights) @ self.psfs[layer].sum((-2, -1))
        sums = torch.where(sums == 0, 1, sums)  # a channel that records none of these bands is covered by nothing
        return self._of_masks(weights / sums[:, None]).blur(share, layer=layer)

    def near(self, place: Place, *, batch: int) -> Renderer | None:
        """The renderer of what a layer reaches from its place, to which `around` brings what lies around; None where
        that takes about as long as the whole.
        """
        if self.reached(place, batch=batch) is None:
            return None
        (top, bottom), (left, right) = place.box(self.window, self.picture)
        return replace(self, picture=(bottom - top, right - left), border="given", cache=None)

    def around(self, planes: Tensor, place: Place, *, masks: bool = False) -> Tensor:
        """Planes (..., H, W), or masks, in what a layer reaches from its place, with what lies around."""
        border = self._border_of_masks if masks else self.border
        for dim, (start, stop), m in zip((-2, -1), place.box(self.window, self.picture), self.window, strict=True):
            planes = part(planes, start - m // 2, stop + (m - 1) // 2, border, dim=dim)
        return planes

    def reached(self, place: Place, *, batch: int) -> tuple[int, float] | None:
        """In how many pictures of a batch a layer is rendered, and in what share of each; None for all, where little
        would be saved.
        """
        if self.border not in _CUT:
            return None
        sides = [stop - start for start, stop in place.box(self.window, self.picture)]
        if self.direct:
            share = math.prod(sides) / math.prod(self.picture)
        else:
            points = math.prod(_length(n + m - 1) for n, m in zip(sides, self.window, strict=True))
            share = points / (math.prod(self.sizes.size) * math.prod(self.squares))
        items = len(place.items)
        return (items, min(1.0, share)) if items * share < _SAVED * batch else None

    @property
    def at_once(self) -> int:
        """Layers whose PSFs are computed together: as many as fit into a quarter of the memory."""
        return max(1, int(self.max_memory / 4 // (self.bands * math.prod(self.window) * self.psfs.element_size())))

    def of_sums(self) -> Renderer:
        """The same for PSFs that `mixing` has summed up: each is a band of its own, of one plane, for one channel."""
        of_plane = torch.eye(self.planes).repeat(1, self.channels)
        of_channel = torch.eye(self.channels).repeat_interleave(self.planes, 1)
        return replace(self, spectra=of_plane.to(self.psfs), weights=of_channel.to(self.psfs), shares=None)

    def _of_masks(self, weights: Tensor) -> Renderer:
        """Of masks, which are pictures of one plane, as bright in all bands."""
        even = torch.ones(1, self.bands).to(self.psfs)
        return replace(self, spectra=even, weights=weights, border=self._border_of_masks, cache=None)

    @property
    def _border_of_masks(self) -> str:
        """Where zeros lie beyond the picture it is dark there, not empty: what stands at the border goes on."""
        return "replicate" if self.border == "zero" else self.border

    def work(self, *, batch: int, coverage: bool) -> Work:
        """What one layer of a batch takes, with its coverage or without; of tensors the shapes are enough."""
        inputs, kernels, back, products, *_, held, touched, contracted = choose(self, batch).takes(self)
        points, pixels, kernel = (math.prod(size) for size in (self.sizes.size, self.picture, self.window))
        tiles, itemsize = math.prod(self.squares), self.psfs.element_size()
        if self.direct:
            slow = 4 if pixels > 2**17 else 1  # measured: unfolded, a larger picture is far from the processor
            memory = float(batch * itemsize * ((2 * inputs + back) * pixels + products * kernel))
            touched += float((inputs + 2 * self.channels) * pixels)
            operations = {"product": float(batch * products * pixels * kernel * slow)}
        else:
            memory = float(batch * itemsize * (held * points + (inputs + back) * pixels))
            touched += float(tiles * points * (inputs + back + products))
            contracted += kernels * points
            transforms = float(batch * tiles * (inputs + back) + kernels)  # those of the PSFs once
            operations = {"transform": transforms * points * math.log2(max(2, points))}
            if pixels > _NEAR:  # whole it is touched again and again in far memory, in tiles once
                operations["large"] = float(batch * pixels * (inputs + back) * (2 if tiles == 1 else 1))
        work = Work(operations | {"touch": batch * touched + contracted}, memory)
        if not coverage:
            return work
        laid_over = Work({"touch": float(6 * batch * self.channels * pixels)})
        return work + laid_over + self._of_masks(self.kappa()).work(batch=2 * batch, coverage=False)
