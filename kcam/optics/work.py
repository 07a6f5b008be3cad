"""What a picture takes, told by its sizes before it is made: operations, by their kind, and memory at the peak."""

from __future__ import annotations

import functools
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from kcam.effects import Work
from kcam.optics.accuracy import Accuracy
from kcam.optics.field import PROBE, PROBED
from kcam.optics.rendering.place import Place
from kcam.optics.rendering.renderer import Renderer
from kcam.optics.rendering.zones import Axis

_FEW_COLOURS, _COLOURS = 5, 12  # PSFs of more wavelengths are polynomials of those of some: that many, about


@dataclass(frozen=True)
class PictureWork:
    """That of a picture of planes (B, K, H, W), at some layers of depth; of all tensors the shapes are enough.

    renderer: of the picture, with the PSFs of one layer. accuracy: what is computed. where: each layer is, if not
    everywhere.
    """

    planes: Tensor
    renderer: Renderer
    layers: int
    accuracy: Accuracy
    where: Sequence[Place] = ()

    def on_axis(self, psfs: Mapping[str, float], *, zones: int) -> Work:
        """With one PSF for all pixels of each zone; psfs: what the optics take to compute theirs, of all layers."""
        first, renderer = self._factored
        batch = len(self.planes)
        reached: dict[int, float] = defaultdict(float)
        for place in self.where:
            items, share = renderer.reached(place, batch=batch) or (batch, 1.0)
            reached[items] += share
        parts = [self._rendering(renderer, n, batch=items) for items, n in (reached or {batch: self.layers}).items()]
        rendering, bank = sum(parts, Work()), 0.0
        operations = {**rendering.operations, "layer": float(self.layers)}
        if self.accuracy.blur:
            at_once = min(self.layers, renderer.at_once)
            banks = math.ceil(self.layers / at_once)  # at each wavelength all layers are found together
            operations |= {"bank": float(banks), "psf": float(banks * renderer.groups), **psfs}
            bank = self._bytes(at_once)
        operations = {kind: count * zones for kind, count in operations.items()}
        return first + Work(operations, rendering.memory + bank + self._shares)

    def over_field(self, points: float, *, apart: int | None, mirrored: bool) -> Work:
        """With PSFs of places and zones between them. Where the places follow from the scene those count too at which
        that is tried.

        points: of the transforms of one PSF. apart: pixels between places where the scene tells, if that is known.
        mirrored: the picture lies about the axis.
        """
        first, renderer = self._factored
        own, picture, groups, layers = self.accuracy, renderer.picture, renderer.groups, self.layers
        spacing = own.node_spacing or apart or PROBE
        nodes = [len(Axis.of(n, m, apart=spacing).nodes) for n, m in zip(picture, renderer.window, strict=True)]
        zones = math.prod(nodes)
        places = float(math.prod((n + 1) // 2 for n in nodes) if mirrored else zones)  # others mirror these
        tried = PROBED if own.node_spacing is None else 0
        colours = 4.0 * (2 * groups) if groups > _FEW_COLOURS else 0.0
        computed = (places + tried) * float(min(groups, _COLOURS)) + colours
        sides = [min(n, math.ceil(2 * n / max(1, k - 1))) for n, k in zip(picture, nodes, strict=True)]
        border = "dark" if layers == 1 else "zero"
        zone = self._rendering(
            replace(renderer, border=border, picture=(sides[0], sides[1])), layers, batch=len(self.planes)
        )
        operations = {kind: n * (zones + tried) for kind, n in zone.operations.items()}
        operations |= {"field": 1.0, "layer": float(layers * zones)}
        operations |= {"field psf": layers * computed, "field point": layers * points * computed}
        operations["touch"] += 60.0 * self.planes.numel() * (own.distortion + 0.1 * own.relative_illumination)
        return first + Work(operations, zone.memory + self._bytes(nodes[1] * layers) + self._shares)

    @functools.cached_property
    def _factored(self) -> tuple[Work, Renderer]:
        """What it takes to find fewer spectra, and the renderer of these."""
        (batch, count, height, width), rank = self.planes.shape, self.accuracy.rank
        if rank is None or rank >= count:
            return Work(), self.renderer
        touched = float(batch * height * width * count * (count / 8 + rank))
        spectra = self.renderer.psfs.new_empty(rank, self.renderer.bands)
        memory = self.planes.element_size() * touched / count
        return Work({"touch": touched}, memory), replace(self.renderer, spectra=spectra)

    def _rendering(self, renderer: Renderer, layers: float, *, batch: int) -> Work:
        """That of so many layers that are everywhere in a batch, with one PSF each."""
        one = renderer.work(batch=batch, coverage=self.layers > 1 and self.accuracy.occlusion)
        scale = self.planes.element_size() / 4  # twice as many bytes take twice as long
        return Work({kind: number * layers * scale for kind, number in one.operations.items()}, one.memory)

    def _bytes(self, count: int) -> float:
        """Of so many PSFs at all wavelengths, while they are made."""
        return float(2 * count * self.renderer.groups * math.prod(self.renderer.window) * self.planes.element_size())

    @property
    def _shares(self) -> float:
        """Bytes of the pixels' shares in the layers."""
        return float(self.layers * math.prod(self.renderer.picture) * len(self.planes) * 16) if self.layers > 1 else 0.0
