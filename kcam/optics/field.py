"""A picture through optics whose PSF varies over it: distortion, then PSFs of a grid of places, as dense as it needs.

The error of bilinear windows between neighbouring nodes is of second order in their distance. It is estimated on the
scene itself before the picture is made: the PSF in the middle of a cell against the mean of its corners, applied to
those parts of the picture that hold most of its detail.
"""

from __future__ import annotations

import functools
import math
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from kcam.optics.accuracy import Accuracy
from kcam.optics.rendering.borders import part
from kcam.optics.rendering.depth import Layers
from kcam.optics.rendering.places import Bank, Between
from kcam.optics.rendering.renderer import Renderer
from kcam.optics.rendering.resampling import Resampling, multiplied, resampling
from kcam.optics.rendering.zones import Axis, blend
from kcam.optics.source import FieldPSFs, PixelGrid

ALLOWED = 3e-3
"""Of the picture's light (rms): what nodes may lie apart for, unless Accuracy(spacing=) says how far [pixels]. It is an
upper bound, of which pictures show a third or less."""
BETWEEN, COLOURED = 0.75, 0.6  # of that, what PSFs between those that are computed, and between wavelengths, may leave
SHARED = 0.4
"""What blending leaves (rms), of what linear windows are off by in the middle between nodes that have their own PSFs:
see `places.cubic_weights`; 0.3 for what bends along one axis."""
_FINEST, _COARSEST = 4, 512  # pixels between nodes
_PATCH, _PATCHES = 96, 4  # on which the error is estimated: their side [pixels], and how many
PROBE = 128  # pixels between the places that are tried
_TOGETHER = 2**17  # pixels of PSFs of places, for each wavelength, whose graph is held
_SAMPLED = 2**18  # pixels by which a picture's light is known
_CELLS = ((0.12, 0.09), (0.45, 0.4), (0.68, 0.74), (0.97, 0.94))  # places of the quadrant, of half its sides
_COLOUR_CELLS = _CELLS[1::2]
PROBED = 5 * len(_CELLS)  # places whose PSFs are computed to try


@dataclass(frozen=True)
class FieldEstimate:
    """What a picture over the field is off by, of its light (rms); print it.

    places: PSFs computed for it, rows x columns. apart: pixels between nodes, of which each has a PSF. blending: by
    these between the nodes; between: by cubics between the places; pupils: by polynomials between the heights that were
    traced; colours: by PSFs between wavelengths; sampling: of pupils; outside: light beyond the window.
    """

    places: tuple[int, int]
    apart: int
    blending: float
    between: float
    pupils: float
    colours: float
    sampling: float
    outside: float

    @property
    def total(self) -> float:
        """Their sum."""
        return self.blending + self.between + self.pupils + self.colours + self.sampling + self.outside

    def __str__(self) -> str:
        rows = (
            (f"between nodes, {self.apart} pixels apart", self.blending),
            (f"between {self.places[0]} x {self.places[1]} places", self.between),
            ("between traced heights", self.pupils),
            ("between wavelengths", self.colours),
            ("pupil sampling", self.sampling),
            ("light outside the window", self.outside),
            ("together, at most", self.total),
        )
        return "\n".join(f"{name:<44} {error:.1e}" for name, error in rows)


@dataclass(frozen=True)
class _How:
    """Pixels between nodes, and the error that this leaves; the PSFs from which nodes have theirs, and the error that
    these leave; at how many wavelengths PSFs are computed, and what this leaves.
    """

    apart: float
    blending: float = 0.0
    known: Between | None = None
    between: float = 0.0
    colours: float = math.inf
    coloured: float = 0.0


@dataclass(frozen=True)
class _Detail:
    """Those parts of a picture that hold most of its detail, with what lies around them, those of one size together;
    how much more of it the whole has; the picture's light, squared and summed.
    """

    patches: list[tuple[Tensor, Tensor | None]]
    weight: float
    light: float


@dataclass(frozen=True)
class FieldBank:
    """PSFs of places of a picture.

    psfs: over the sensor. pixels: of their window. centre: of the picture, x and y on the sensor [m]. accuracy: what is
    computed. mixing: weights (M, L) of sums that stand instead, None for PSFs.
    """

    psfs: FieldPSFs
    pixels: PixelGrid
    centre: tuple[float, float]
    accuracy: Accuracy
    mixing: Tensor | None

    def bank(self, places: Tensor, *, colours: float = math.inf) -> Tensor:
        """PSFs (N, Z, G, h, w) of places (N, 2) of the upright picture, in pixels from its middle."""
        own = self._on_sensor(places) if self.accuracy.field_variation else torch.zeros_like(places[:1])
        whole = self.accuracy.renormalise or self.accuracy.psf_shape is None  # light outside is put back
        psfs = self.psfs.bank(own, self.pixels, whole=whole, mixing=self.mixing, colours=colours)
        psfs = psfs / self.psfs.illumination(own).to(psfs).view(-1, 1, 1, 1, 1)
        return psfs.expand(len(places), *psfs.shape[1:])

    def off_between_nodes(self, place: tuple[float, float], picture: tuple[int, int]) -> Tensor:
        """What PSFs (Z, G, h, w) are off by in a picture (H, W) that shares light out among nodes as far apart as
        `Accuracy(spacing=)` says: at a place, or in the middle of its cell, where that is more.
        """
        apart, own = self.accuracy.node_spacing or math.inf, torch.tensor(place, dtype=torch.float64)
        sides = zip(place, picture[::-1], self.pixels.shape[::-1], strict=True)
        cell = torch.stack([_around(Axis.of(n, m, apart=apart).nodes, at) for at, n, m in sides])
        x, y = ((own - cell[:, 0]) / (cell[:, 1] - cell[:, 0]).clamp(min=1e-9)).clamp(0, 1).tolist()
        corners = self.bank(torch.cartesian_prod(*cell))
        there, middle = self.bank(torch.stack([own, cell.mean(1)]))
        shares = corners.new_tensor([(1 - x) * (1 - y), (1 - x) * y, x * (1 - y), x * y])
        off = torch.stack([torch.tensordot(shares, corners, dims=1) - there, corners.mean(0) - middle])
        return off[off.square().flatten(1).sum(1).argmax()]

    @property
    def mirrored(self) -> bool:
        """Whether places that mirror each other have PSFs that do."""
        return self.psfs.mirrored and not any(self.centre) and all(m % 2 for m in self.pixels.shape)

    @property
    def _centre(self) -> Tensor:
        return torch.tensor(self.centre, dtype=torch.float64)

    def _on_sensor(self, places: Tensor) -> Tensor:
        return self._centre - places * self.pixels.pitch  # the picture is upright, light falls turned about


@dataclass(frozen=True)
class FieldPicture(FieldBank):
    """How a picture over the field is made.

    renderer: of the picture, whose PSFs are those of each zone; mixing: of sums that it takes instead of PSFs.
    """

    renderer: Renderer

    def light(self, planes: Tensor, shares: Tensor | None) -> Tensor:
        """(B, C, H, W) of planes (B, K, H, W) and shares of layers (B, Z, H, W), None for one."""
        planes, shares = self.moved(planes, shares)
        how, window = self.how(planes, shares), self.pixels.shape
        rows, columns = (Axis.of(n, m, apart=how.apart) for n, m in zip(planes.shape[-2:], window, strict=True))
        bank: Callable[[Tensor], Iterable[Tensor]] = self._of(how.colours)
        if how.known is not None:
            bank = how.known.shared(rows.nodes, columns.nodes).each
        return blend(
            planes,
            shares,
            bank,
            self.render,
            nodes=(rows, columns),
            window=window,
            border=self.renderer.border,
            mirrored=self.mirrored,
        )

    def render(
        self, psfs: Tensor, planes: Tensor, shares: Tensor | None, *, occlusion: bool = True, border: str = "zero"
    ) -> Tensor:
        """Light of one zone, of PSFs (Z, G, h, w), planes (B, K, H, W) and shares of layers (B, Z, H, W), dark all
        around; occlusion=False: sums over the layers.
        """
        picture = (planes.shape[-2], planes.shape[-1])
        layers = Layers(planes, shares, occlusion=occlusion and self.accuracy.occlusion)
        layers.add(replace(self.renderer, psfs=psfs, picture=picture, border=border, cache=None), first=0)
        return layers.light

    def moved(self, planes: Tensor, shares: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Where distortion brings them, planes times the relative illumination there: nodes share out what is left."""
        picture = (planes.shape[-2], planes.shape[-1])
        moves = self.distortion(picture) if self.accuracy.distortion else None
        if moves is not None:
            planes, shares = moves(planes), None if shares is None else moves(shares)
        if not self.accuracy.relative_illumination:
            return planes, shares
        return multiplied(planes, lambda places: self.psfs.illumination(self._on_sensor(places))), shares

    def distortion(self, picture: tuple[int, int]) -> Resampling | None:
        """From the scene's pixels to the picture's; None where nothing moves."""
        centre = self._centre

        def ideal(places: Tensor) -> Tensor:
            return (centre - self.psfs.undistorted(self._on_sensor(places))) / self.pixels.pitch

        return resampling(ideal, picture, self.renderer.border)

    def explain(self, planes: Tensor, shares: Tensor | None) -> FieldEstimate:
        """What `light` will do, and what it is off by."""
        with torch.no_grad():
            planes, shares = self.moved(planes, shares)
            picture, how = (planes.shape[-2], planes.shape[-1]), self.how(planes, shares)
            if how.known is None:
                sides = zip(picture, self.pixels.shape, strict=True)
                rows, columns = (len(Axis.of(n, m, apart=how.apart).nodes) for n, m in sides)
            else:
                rows, columns = len(how.known.rows), len(how.known.columns)
            apart, blending = how.apart, how.blending
            if math.isinf(apart):  # one PSF on purpose
                apart = max(picture)
            elif self.accuracy.spacing is not None:
                bank = self._of(how.colours)
                blending = self._left(self._detail(planes, shares, bank), self._blended(bank, picture, apart))
            deviations = self.psfs.deviations(self.pixels, colours=how.colours)
            return FieldEstimate((rows, columns), int(apart), blending, how.between, colours=how.coloured, **deviations)

    def _of(self, colours: float) -> Bank:
        """The bank of so many wavelengths. Where gradients are asked for, it is computed again on the way back, a few
        PSFs at a time.
        """
        own = functools.partial(self.bank, colours=colours)

        def bank(places: Tensor) -> Tensor:
            if not torch.is_grad_enabled():
                return own(places)
            few = places.split(max(1, _TOGETHER // math.prod(self.pixels.shape)))
            return torch.cat([checkpoint(own, part, use_reentrant=False) for part in few])

        return bank

    def how(self, planes: Tensor, shares: Tensor | None) -> _How:
        """How densely PSFs are computed, and nodes lie, for `ALLOWED`: planes as they were moved."""
        sides = (planes.shape[-2], planes.shape[-1])
        probe = probe_of(sides)
        fewest = self.psfs.fewer_colours[:1] or (math.inf,)
        detail = self._detail(planes, shares, self._of(fewest[0]))
        colours, coloured = self._colours(detail, sides)
        spacing, most_held = self.accuracy.node_spacing, self.accuracy.max_memory / 2  # bytes of PSFs
        how = _How(probe if spacing is None else spacing, colours=colours, coloured=coloured)
        if spacing is not None:
            return how
        bank, rest = self._of(colours), ALLOWED**2 - coloured**2
        places, most = 2.0 * probe, BETWEEN * ALLOWED
        while True:
            known = Between.known(bank, sides, apart=places, mirrored=self.mirrored)
            off = self._left(detail, self._interpolated(bank, known, sides))
            error = SHARED * self._left(detail, self._blended(known, sides, probe))
            apart, error = nodes_apart(error, probe, allowed=math.sqrt(rest - min(off, most) ** 2))
            if off <= most:
                return replace(how, apart=apart, blending=error, known=known, between=off)
            closer = 0.9 * (most / off) ** 0.25  # of fourth order, with something to spare
            if closer * places < apart or known.psfs.nbytes / closer**2 > most_held:
                break
            places *= closer
        error = self._left(detail, self._blended(bank, sides, probe))
        apart, better = nodes_apart(SHARED * error, probe, allowed=math.sqrt(rest))
        if known.psfs.nbytes * (places / apart) ** 2 < most_held:
            known = Between.known(bank, sides, apart=apart, mirrored=self.mirrored)
            return replace(how, apart=apart, blending=better, known=known)
        apart, error = nodes_apart(error, probe, allowed=math.sqrt(rest))
        return replace(how, apart=apart, blending=error)

    def _colours(self, detail: _Detail, sides: tuple[int, int]) -> tuple[float, float]:
        """At how many wavelengths PSFs are computed, and what this leaves."""
        every, last = self._of(math.inf), _last(sides)

        def off(cell: Tensor, count: int) -> Tensor:
            return every(cell * last) - self.bank(cell * last, colours=count)

        for count in self.psfs.fewer_colours:
            left = self._left(detail, functools.partial(off, count=count), cells=_COLOUR_CELLS)
            if left <= COLOURED * ALLOWED:
                return count, left
        return math.inf, 0.0

    def _blended(self, bank: Bank, sides: tuple[int, int], apart: float) -> Bank:
        """What windows between nodes so far apart are off by, in the middle of a cell at parts (1, 2) of a quadrant."""
        corners = torch.cartesian_prod(*[torch.tensor([-apart / 2, apart / 2], dtype=torch.float64)] * 2)
        last = _last(sides)

        def off(cell: Tensor) -> Tensor:
            middle = cell * (last - apart / 2).clamp(min=0)
            psfs = bank(torch.cat([middle, torch.maximum(torch.minimum(middle + corners, last), -last)]))
            return psfs[:1] - psfs[1:].mean(0, keepdim=True)

        return off

    def _interpolated(self, bank: Bank, between: Between, sides: tuple[int, int]) -> Bank:
        """What PSFs between those that are known are off by, in the middle of a cell at parts (1, 2) of a quadrant."""

        def off(cell: Tensor) -> Tensor:
            middle = between.middle(cell * _last(sides))
            return bank(middle) - between(middle)

        return off

    def _patch(self, planes: Tensor, place: tuple[int, int]) -> Tensor:
        """One of the patches, row and column, with as much around it as the window reaches."""
        for dim, index, m in zip((-2, -1), place, self.pixels.shape, strict=True):
            start, stop = index * _PATCH, min((index + 1) * _PATCH, planes.shape[dim])
            planes = part(planes, start - m // 2, stop + (m - 1) // 2, self.renderer.border, dim=dim)
        return planes

    @torch.no_grad()
    def _detail(self, planes: Tensor, shares: Tensor | None, bank: Bank) -> _Detail:
        height, width = planes.shape[-2:]
        detail = _detail(planes)
        most = detail.flatten().argsort(descending=True)[:_PATCHES]
        places = [divmod(at, detail.shape[1]) for at in most.tolist()]
        alike: dict[torch.Size, list[tuple[int, int]]] = defaultdict(list)
        for at in places:
            alike[self._patch(planes[:1, :1], at).shape].append(at)

        def together(of: Tensor, own: list[tuple[int, int]]) -> Tensor:
            return torch.cat([self._patch(of, at) for at in own])

        found = alike.values()
        patches = [(together(planes, own), None if shares is None else together(shares, own)) for own in found]
        step = max(1, math.isqrt(height * width // _SAMPLED))
        point = bank(torch.zeros(1, 2, dtype=torch.float64))[0].sum((-2, -1), keepdim=True)[:1]
        light = self.render(point, planes[..., ::step, ::step].contiguous(), None).double().square().sum() * step**2
        weight = detail.sum() / detail.flatten()[most].sum().clamp(min=1e-300)
        return _Detail(patches, float(weight), float(light))

    @torch.no_grad()
    def _left(self, detail: _Detail, deviation: Bank, *, cells: tuple[tuple[float, float], ...] = _CELLS) -> float:
        """Of the light where PSFs deviate so from what they should be, rms, relative: in the worst of some cells, on
        the patches of the picture with most detail, for all of its detail.
        """
        before, left = (m // 2 for m in self.pixels.shape)
        worst = uneven = 0.0
        for cell in cells:
            off, squares = deviation(torch.tensor([cell], dtype=torch.float64))[0], 0.0
            uneven = max(uneven, float(off.sum((-2, -1)).abs().max()))
            for own, around in detail.patches:
                seen = self.render(off, own, around, occlusion=False)[..., before:, left:][..., :_PATCH, :_PATCH]
                squares += float(seen.double().square().sum())
            worst = max(worst, squares)
        return math.sqrt(worst * detail.weight / max(detail.light, 1e-300) + uneven**2)


def probe_of(sides: tuple[int, int]) -> int:
    """Pixels between places that are tried."""
    return max(2, min(PROBE, max(sides) // 2))


def _around(nodes: Tensor, at: float) -> Tensor:
    """The nodes (2,) on either side of a place; one node stands for both."""
    above = min(max(1, int((nodes < at).sum())), len(nodes) - 1)
    return nodes[[max(0, above - 1), above]]


def _last(sides: tuple[int, int]) -> Tensor:
    return torch.tensor([sides[1] - 1, sides[0] - 1], dtype=torch.float64) / 2


def nodes_apart(error: float, probe: float, *, allowed: float = ALLOWED) -> tuple[int, float]:
    """How many pixels nodes may lie apart, and the error that this leaves, from that of nodes `probe` apart."""
    eighths = range(round(8 * math.log2(_FINEST)), round(8 * math.log2(_COARSEST)) + 1)
    steps = [round(2 ** (k / 8)) for k in eighths]
    fine = [step for step in steps if error * (step / probe) ** 2 <= allowed] or [_FINEST]
    return fine[-1], error * (fine[-1] / probe) ** 2


def _detail(planes: Tensor) -> Tensor:
    """Energy of the differences between neighbouring pixels, summed over patches, (rows, columns)."""
    squares = planes.new_zeros(planes.shape[-2:])
    squares[1:] += planes.diff(dim=-2).square().sum((0, 1))
    squares[:, 1:] += planes.diff(dim=-1).square().sum((0, 1))
    height, width = (-n % _PATCH for n in squares.shape)
    padded = torch.nn.functional.pad(squares, (0, width, 0, height)).double()
    return padded.unflatten(0, (-1, _PATCH)).unflatten(2, (-1, _PATCH)).sum((1, 3))
