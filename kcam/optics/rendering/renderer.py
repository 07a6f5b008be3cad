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
from kcam.optics.rendering.convolution import correlate
from kcam.optics.rendering.place import Place
from kcam.optics.rendering.ways import CONTRACTED, Bank, choose

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
        bank, kernels, mixing = self._of_masks, self.psfs[layer], self.grouped(self.kappa())
        if self._few:
            mixing = mixing / (mixing @ kernels.sum((-2, -1)))[:, None]
        else:
            if not (self.weights is self.shares is None):  # else each channel has its own
                kernels = torch.einsum("cg,gyx->cyx", mixing, kernels)
            kernels = kernels / kernels.sum((-2, -1), keepdim=True)
        if self.direct:
            spread = correlate(bank.extend(share), kernels[:, None])
        else:
            convolution, transfers = bank.convolution, bank.convolution.transfer(kernels)
            spread = bank.in_squares(share, lambda part: convolution.back(convolution.transform(part) * transfers))
        return torch.einsum("cg,bghw->bchw", mixing, spread) if self._few else spread

    @property
    def _few(self) -> bool:
        """Whether there are fewer PSFs than channels, so that masks are spread by these."""
        return self.groups < self.channels

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
        border = self._of_masks.border if masks else self.border
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

    @property
    def _of_masks(self) -> Bank:
        """Where zeros lie beyond the picture it is dark there, not empty: what stands at the border goes on."""
        return replace(self, border="replicate") if self.border == "zero" else self

    def work(self, *, batch: int, coverage: bool) -> Work:
        """What one layer of a batch takes, with its coverage or without; of tensors the shapes are enough."""
        inputs, kernels, back, products, *_, held, touched, contracted = choose(self, batch).takes(self)
        points, pixels, kernel = (math.prod(size) for size in (self.sizes.size, self.picture, self.window))
        tiles, out, itemsize = math.prod(self.squares), self.channels, self.psfs.element_size()
        spread = min(out, self.groups)  # of each mask
        if coverage and self.weights is not None and not self._few:
            contracted += out * self.groups * kernel / CONTRACTED
        if self.direct:
            summed = products + (2 * spread if coverage else 0)
            slow = 4 if pixels > 2**17 else 1  # measured: unfolded, a larger picture is far from the processor
            memory = float(itemsize * (2 * inputs * pixels + summed * kernel + back * pixels))
            touched += float((inputs + 2 * out) * pixels)
            operations = {"product": float(batch * summed * pixels * kernel * slow)}
            return Work(operations | {"touch": batch * touched + contracted}, batch * memory)
        transforms = float(batch * tiles * (inputs + back) + kernels)  # those of the PSFs once
        touched += float(tiles * points * (inputs + back + products))
        contracted += kernels * points
        if coverage:
            ratio = math.prod(self._of_masks.sizes.size) / points
            transforms += ratio * (batch * tiles * 2 * (1 + spread) + spread)
            touched += ratio * tiles * points * spread + 6 * out * pixels
            touched += 2 * out * self.groups * pixels / CONTRACTED if self._few else 0.0
        memory = float(batch * itemsize * (held * points + (inputs + back) * pixels))
        operations = {"transform": transforms * points * math.log2(max(2, points))}
        operations["touch"] = batch * touched + contracted
        if pixels > _NEAR:  # whole it is touched again and again in far memory, in tiles once
            operations["large"] = float(batch * pixels * (inputs + back) * (2 if tiles == 1 else 1))
        return Work(operations, memory)
