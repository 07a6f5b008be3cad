"""Layers of depth: the share of each pixel in each, and how nearer ones hide farther ones."""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from kcam.cache import differentiated, is_plain
from kcam.optics.numerics import bracketed
from kcam.optics.rendering.place import Place
from kcam.optics.rendering.renderer import Renderer
from kcam.scene import Scene

LAYER_WAVES = 0.125  # defocus between neighbouring depth layers
_COMPARED = 16  # different values, of which each pixel is told by comparing; with more sorting takes less time
_LOOKED_AT = 2**20  # pixels of a large map that are looked at, at least
_COVERAGE_FLOOR = 1e-4  # below it a layer is hidden by nearer ones, and its share is lost in the FFT's rounding


def few_values(values: Tensor, *, at_most: int) -> Tensor | None:
    """The different values, ascending, or None where there are more of them."""
    flat = values.flatten()
    found = flat[:: max(1, flat.numel() // 4096)].unique()  # tells a ramp from planes without sorting all pixels
    if found.numel() > at_most:
        return None
    if found.numel() > _COMPARED:
        found = flat.unique()
    elif bool((other := functools.reduce(torch.logical_and, (flat != one for one in found))).any()):
        found = torch.cat([found, flat[other]]).unique()
    return found if found.numel() <= at_most else None


def layer_vergences(
    vergence: Tensor,
    layers: int | Sequence[float] | Tensor | None,
    *,
    known: Tensor | None,
    steps: Callable[[float], float],
) -> Tensor:
    """Vergences of the layers that a scene is cut into, ascending (Z,), as `Imaging.depth_layers` tells [1/m].

    Args: vergence: of pixels or samples [1/m]. layers: how many, or their distances [m]; None for the rule. known: at
        which the optics have PSFs, if not at all. steps: that a span of vergence takes.
    """
    if vergence.ndim == 1 and len(vergence) > 1:
        return vergence.unique()
    low, high = vergence.min(), vergence.max()
    span = float((high - low).detach())
    if span == 0:
        return vergence.mean()[None] if differentiated(vergence) else low[None]
    if not isinstance(layers, int | None):
        return 1 / torch.as_tensor(layers, dtype=torch.float64, device=vergence.device)
    if layers is None and known is not None:  # between them PSFs are linear, as shares of layers are
        known = known.to(vergence.device)
        return torch.cat([low[None], known[(known > low.detach()) & (known < high.detach())], high[None]])
    if layers is None:
        layers = 1 + math.ceil(steps(span))
        own = None if differentiated(vergence) else few_values(vergence, at_most=layers)
        if own is not None:
            return own
    if layers == 1:
        return (low + high)[None] / 2
    share = torch.linspace(0, 1, layers, dtype=torch.float64, device=vergence.device)
    return low + (high - low) * share


def alike(scene: Scene) -> list[Tensor]:
    """Rows of a batch at one distance each, in the order in which distances come first; one list for all but (B,).

    Where a derivative passes through the distances each sample is alone: one PSF for two would share it out.
    """
    depth, batch = scene.depth, scene.shape[0]
    if not isinstance(depth, Tensor) or depth.ndim != 1 or batch < 2:
        return [torch.arange(batch)]
    if differentiated(depth):
        return list(torch.arange(batch)[:, None])
    groups: dict[float, list[int]] = {}
    for row, distance in enumerate(depth.tolist()):
        groups.setdefault(distance, []).append(row)
    return [torch.tensor(rows) for rows in groups.values()]


def layer_shares(
    vergence: Tensor, layers: Tensor, *, interpolate: bool = True, dtype: torch.dtype = torch.float64
) -> Tensor:
    """Share of each pixel in each layer of a map: linear between neighbours, or all in the nearest.

    Args:      vergence: (B, 1, H, W) [1/m]; beyond the layers all is in the last. layers: (Z,) ascending, Z > 1 [1/m].
               dtype: of the shares.
    Returns:   (B, Z, H, W), sums to 1 over the layers.
    """
    position = _positions(vergence, layers, interpolate=interpolate)
    shares = [torch.clamp(1 - (position - layer).abs(), min=0).to(dtype) for layer in range(layers.numel())]
    return torch.cat(shares, dim=1)  # one by one they stay near the processor: all at once take five times as long


def _positions(vergence: Tensor, layers: Tensor, *, interpolate: bool) -> Tensor:
    before, share = bracketed(layers.to(vergence.device), vergence)
    position = (before + share).clamp(0, layers.numel() - 1)
    return position if interpolate else position.round()


def places(vergence: Tensor, layers: Tensor, *, interpolate: bool = True) -> list[Place | None]:
    """Where there is anything in each layer, without the shares. Args: as of `layer_shares`.

    Of large maps every so many rows and columns are looked at, `_LOOKED_AT` pixels at least, and what is farthest and
    nearest: a layer between that is found nowhere else is left out.
    """
    height, width = vergence.shape[-2:]
    every = max(1, math.isqrt(height * width // _LOOKED_AT))
    found = _found(vergence[..., ::every, ::every], layers, interpolate=interpolate)
    if every == 1:
        return found
    found = [place and place.of_every(every, (height, width)) for place in found]
    for layer, end in ((0, torch.argmin), (-1, torch.argmax)):
        if found[layer] is None:
            item, _, row, column = (int(place) for place in torch.unravel_index(end(vergence), vergence.shape))
            own = _found(vergence[item, 0, row, column].view(1, 1, 1, 1), layers, interpolate=interpolate)
            pixel = Place((item,), (row, row + 1), (column, column + 1))
            found = [known or (there and pixel) for known, there in zip(found, own, strict=True)]
    return found


def _found(vergence: Tensor, layers: Tensor, *, interpolate: bool) -> list[Place | None]:
    position = _positions(vergence.detach(), layers, interpolate=interpolate)[:, 0]
    sides = []
    for own in (position, position.mT):
        filled = torch.zeros(*own.shape[:2], layers.numel(), dtype=torch.bool, device=own.device)
        for one in (own.floor(), own.ceil()):
            filled.scatter_(-1, one.long(), True)
        sides.append(filled)
    return Place.of(*sides)


def warn_of_few(layers: object, nodes: Tensor, *, vergence: Tensor, defocus_waves: float) -> None:
    """Warn where a pixel's distance is farther from all given layers than from the next of the rule's.

    Args: layers: as they were given; nodes: their vergences (Z,), ascending. vergence: of the pixels [1/m].
        defocus_waves: at the rim for each unit of vergence [m].
    """
    nodes, vergence = nodes.detach(), vergence.detach().contiguous()
    after = torch.searchsorted(nodes, vergence).clamp(max=len(nodes) - 1)
    away = torch.minimum((nodes[after] - vergence).abs(), (vergence - nodes[(after - 1).clamp(min=0)]).abs())
    worst = float(away.max()) * defocus_waves
    if worst > LAYER_WAVES / 2 * (1 + 1e-6):
        distance = float(1 / vergence.flatten()[away.argmax()])
        warnings.warn(
            f"layers={layers} lie up to {worst:.3g} waves of defocus from the map's distances (at {distance:.4g} m), "
            f"and {LAYER_WAVES / 2:g} keep its blur. Take layers=None, or give the distances that count, such as "
            f"layers=({distance:.4g}, ...).",
            stacklevel=3,
        )


class Layers:
    """Depth layers from far to near: each is blurred with its own coverage and laid over what is behind it.

    E_k = K_k * sum_(j <= k) m_j,   l_k = (h_k * m_k I) / E_k,   a_k = (K_k * m_k) / E_k,   out <- l_k + (1 - a_k) out

    with K_k the PSFs of layer k weighted by the channel's filter, relative to their own sum: coverage per *channel*, so
    that the sum over wavelengths stays inside the transform. Dividing by E_k, the share of what is not hidden by nearer
    layers, extends each layer behind those, whose blurred edge would otherwise show black. The nearest layer has
    E = 1: its blurred mask covers what is behind. Where all layers share one PSF this is exactly the plain
    convolution. Without occlusion the layers are added up as they are. Where a layer does not reach nothing changes: it
    is rendered in the part of the picture, and for the items of a batch, where it is seen, but for periodic borders.
    Source: Ikoma et al., Depth from Defocus with Learned Optics, ICCP 2021 (normalised over-compositing).
    """

    def __init__(self, planes: Tensor, shares: Tensor | None, *, occlusion: bool = True) -> None:
        self.planes, self.shares, self.occlusion = planes, shares, occlusion
        self.light: Tensor = planes.new_zeros(())
        self._unhidden = planes.new_zeros(())  # pixels that lie in the layers so far

    def add(self, renderer: Renderer, *, first: int) -> None:
        """Lay the layers of one bank of PSFs, `first` and the following, over those before: each only where it is."""
        if self.shares is None:
            self.light = renderer.blur(self.planes, layer=0)
            return
        if self.light.ndim == 0:
            self.light = self.planes.new_zeros(len(self.planes), renderer.channels, *renderer.seen)
        for layer in range(renderer.psfs.shape[0]):
            masks = [self.shares[:, first + layer : first + layer + 1]]
            if self.occlusion:
                self._unhidden = self._unhidden + masks[0]
                masks.append(self._unhidden)
            if self._places is None:
                self.light = self._over(self.light, renderer, layer, self.planes, masks)
            elif (place := self._places[first + layer]) is not None:
                self._lay(place, renderer, layer, masks)

    @functools.cached_property
    def _places(self) -> list[Place | None] | None:
        """Where each layer is; None where a derivative goes through what is empty, too, or nothing is computed yet."""
        if self.shares is None or not is_plain(self.shares):
            return None
        return Place.of(*((self.shares.amax(dim) > 0).mT for dim in (-1, -2)))

    def _lay(self, place: Place, renderer: Renderer, layer: int, masks: list[Tensor]) -> None:
        """Lay a layer over the part of the picture that it reaches."""
        if (near := renderer.near(place, batch=len(self.planes))) is None:
            self.light = self._over(self.light, renderer, layer, self.planes, masks)
            return
        (top, bottom), (left, right) = place.box(renderer.window, renderer.picture)
        everywhere = len(place.items) == len(self.planes)
        items = slice(None) if everywhere else list(place.items)
        planes = renderer.around(self.planes[items], place)
        masks = [renderer.around(mask[items], place, masks=True) for mask in masks]
        whole = self.light[items]
        own = self._over(whole[..., top:bottom, left:right], near, layer, planes, masks)
        if is_plain(own) and is_plain(self.light):
            self.light[items, :, top:bottom, left:right] = own
            return
        rows = whole[..., top:bottom, :].slice_scatter(own, -1, left, right)
        whole = whole.slice_scatter(rows, -2, top, bottom)
        self.light = whole if everywhere else self.light.index_copy(0, torch.tensor(items).to(own.device), whole)

    def _over(self, behind: Tensor, renderer: Renderer, layer: int, planes: Tensor, masks: list[Tensor]) -> Tensor:
        """What is seen of a layer over what is behind it; masks: its own, and of what nothing has hidden so far."""
        light = renderer.blur(planes * masks[0], layer=layer)
        if not self.occlusion:
            return behind + light
        cover, unhidden = renderer.coverage(torch.cat(masks), layer=layer).chunk(2)
        floor = unhidden.clamp(min=_COVERAGE_FLOOR)
        opacity = (cover / floor).clamp(0, 1)
        return light / floor + (1 - opacity) * behind
