"""The ways to render a layer of depth: one table of what is contracted first, each row with what it takes.

    I_c = sum_l kappa_cl (I_l * h_l),   I_l = sum_k S_kl C_k

The sum over wavelengths stands *inside* the Fourier transform: the picture is transformed once per plane of the scene's
factors, and back once per channel, not once per band; but of few planes and PSFs before many channels. To add a way,
write what it does with a `Bank`, what it takes, and a row: the choice and a picture's work follow.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, dataclass, replace
from math import inf, prod
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from kcam.cache import ValueCache, has_derivative, is_plain
from kcam.optics.rendering.borders import extend, part
from kcam.optics.rendering.contraction import contract
from kcam.optics.rendering.convolution import Convolution, correlate

Blur = Callable[[Tensor], Tensor]  # planes (B, K, H, W) to channels (B, C, H, W), of one square

_WHOLE = 5 * 2**20  # pixels of a picture that are transformed at once, with a window of any size: measured on a CPU
_SIDE = 1024  # of the squares of a larger one, at most
CONTRACTED = 8  # products of a contraction, a matrix product, that take the time of one that stands alone


@dataclass(eq=False)
class Bank:
    """PSFs (Z, G, h, w) of the layers of depth, what mixes planes into channels, and how they are convolved."""

    psfs: Tensor
    _: KW_ONLY
    spectra: Tensor | None  # (K, L) of the planes, or None where the planes are the bands
    weights: Tensor | None  # (C, L) of the channels, or None for all bands
    picture: tuple[int, int]
    shares: Tensor | None = None  # (L, G) of the PSFs in that of each band; None where each has its own
    border: str = "reflect"  # what lies beyond the picture, one of `BORDERS`; or "given", where that comes with it
    direct: bool = False  # sum over the window instead of by FFT; with the same result, faster for small windows
    tile: int | None = None  # side of squares that the picture is cut into [pixels]; None: those of a large one
    max_memory: float = 2e9  # bytes that the transforms may take
    cache: ValueCache | None = None  # for transfer functions, while the optics stay

    def __post_init__(self) -> None:
        self.layers, self.groups, *window = self.psfs.shape
        self.window = (window[0], window[1])
        self.bands = self.groups if self.shares is None else len(self.shares)
        self.planes = self.bands if self.spectra is None else len(self.spectra)
        self.channels = self.bands if self.weights is None else len(self.weights)
        height, width = self.square = self.picture  # what is convolved at once
        if self.border != "dark" and self.tile is not None:
            self.square = (min(self.tile, height), min(self.tile, width))
        elif self.border != "dark" and height * width > _WHOLE:  # far from the processor: in even parts
            self.square = (-(-height // -(-height // _SIDE)), -(-width // -(-width // _SIDE)))
        self.squares = (-(-self.picture[0] // self.square[0]), -(-self.picture[1] // self.square[1]))

    @functools.cached_property
    def sizes(self) -> Convolution:
        """Of a square with the picture's border."""
        itemsize, memory, layers = self.psfs.element_size(), self.max_memory, self.layers
        return Convolution.of(
            self.square, self.window, border=self.border, itemsize=itemsize, max_memory=memory, layers=layers
        )

    @property
    def seen(self) -> tuple[int, int]:
        """Pixels of the result."""
        return self.sizes.seen if self.squares == (1, 1) else self.picture

    @functools.cached_property
    def convolution(self) -> Convolution:
        """The transforms of a square: one of several comes with what lies around it."""
        return self.sizes if self.squares == (1, 1) else replace(self, border="given").sizes

    def extend(self, planes: Tensor) -> Tensor:
        """The picture with the border that the window reaches."""
        return planes if self.border == "given" else extend(planes, self.window, self.border)

    def of_bands(self, psfs: Tensor) -> Tensor:
        """The PSF of each band, (L, h, w)."""
        return psfs if self.shares is None else torch.einsum("lg,ghw->lhw", self.shares.to(psfs), psfs)

    def grouped(self, weights: Tensor) -> Tensor:
        """Weights of the bands, (..., L), as weights of the PSFs that they take theirs from: (..., G)."""
        return weights if self.shares is None else weights @ self.shares.to(weights)

    def kappa(self) -> Tensor:
        """Weights (C, L) of the channels, which without a filter are the bands."""
        return torch.eye(self.bands).to(self.psfs) if self.weights is None else self.weights

    def mixing(self) -> Tensor:
        """M_ckg, the sum of kappa_cl S_kl over the bands that take of a PSF: (C, K, G)."""
        spectra = torch.eye(self.bands).to(self.psfs) if self.spectra is None else self.spectra  # bands are planes too
        return self.grouped(self.kappa()[:, None] * spectra)

    def keeps(self, count: int, *sources: Tensor) -> bool:
        """Whether so many transfer functions are kept between calls: while they fit, and nothing is trained."""
        fit = count * prod(self.convolution.size) * self.psfs.element_size() <= self.max_memory / 4
        return fit and self.layers == 1 and not any(source.requires_grad for source in sources)

    def transfers(self, kernels: Callable[[], Tensor], count: int, *sources: Tensor) -> Tensor:
        """Transfer functions of so many kernels, kept while what they come from is the same."""
        if self.cache is None or not self.keeps(count, *sources):
            return self.convolution.transfer(kernels())
        return self.cache.get((*sources, self.convolution.size), lambda: self.convolution.transfer(kernels()))

    def in_squares(self, planes: Tensor, blur: Blur) -> Tensor:
        """The picture in squares, each blurred with what the window reaches around it; or whole."""
        if self.direct or self.squares == (1, 1):
            return blur(planes)
        (height, width), (rows, columns) = self.picture, self.square
        tops, lefts = range(0, height, rows), range(0, width, columns)

        def square(top: int, left: int) -> Tensor:
            return blur(self._around(planes, top, left))[..., : height - top, : width - left]

        first = square(0, 0)
        if not is_plain(first):
            strips = ([square(top, left) if top or left else first for left in lefts] for top in tops)
            return torch.cat([torch.cat(strip, dim=-1) for strip in strips], dim=-2)
        result = first.new_empty(*first.shape[:-2], height, width)  # to join them takes twice the memory
        for top, left in itertools.product(tops, lefts):
            own = square(top, left) if top or left else first
            result[..., top : top + rows, left : left + columns] = own
        return result

    def _around(self, planes: Tensor, top: int, left: int) -> Tensor:
        """A square of the picture with what the window reaches around it; the last of a row or column is filled up."""
        sides, missing = [], []
        for dim, start, length, m, n in zip((-2, -1), (top, left), self.square, self.window, self.picture, strict=True):
            before, end = 0 if self.border == "given" else m // 2, min(start + length, n)
            sides.append((dim, start - before, end - before + m - 1))
            missing.append(start + length - end)
        within = {dim: start >= 0 and stop <= planes.shape[dim] for dim, start, stop in sides}
        for dim, start, stop in sorted(sides, key=lambda side: not within[side[0]]):  # what copies comes last
            if within[dim]:
                planes = planes.narrow(dim, start, stop - start)
            else:
                planes = part(planes, start, stop, self.border, dim=dim)
        return torch.nn.functional.pad(planes, (0, missing[1], 0, missing[0])) if any(missing) else planes


class Takes(NamedTuple):
    """What a way takes for one picture, in planes but for the pixels touched where planes are contracted, and PSFs."""

    inputs: int  # transformed
    kernels: int  # transformed
    outputs: int  # transformed back
    products: int
    cost: float  # of each picture, by which the way is chosen, in transforms beside those back to the channels; ten
    # products take the time of one
    once: float  # for a batch
    held: float  # in memory
    touched: float = 0.0
    contracted: float = 0.0  # once for a batch, as kernels are


class Way(NamedTuple):
    """A row: what it takes, and what the PSFs of a layer do to planes, computed once but for what these change."""

    takes: Callable[[Bank], Takes]
    blur: Callable[[Bank, Tensor], Blur]


def _each_takes(n: Bank) -> Takes:
    held = 4 + n.bands * prod(n.picture) / prod(n.sizes.size)
    return Takes(n.bands, n.bands, n.channels, n.bands, cost=0.0 if n.weights is None else inf, once=0.0, held=held)


def _each(bank: Bank, psfs: Tensor) -> Blur:
    """Each band by itself, for a sensor that sees all bands."""
    spectra, convolution = bank.spectra, bank.convolution

    def direct(planes: Tensor) -> Tensor:
        light = planes if spectra is None else torch.einsum("bkhw,kl->blhw", planes, spectra)
        return correlate(bank.extend(light), bank.of_bands(psfs)[:, None], groups=bank.bands)

    def band(planes: Tensor, psf: Tensor, index: int) -> Tensor:
        plane = planes[:, index] if spectra is None else torch.einsum("bkhw,k->bhw", planes, spectra[:, index])
        return convolution.back(convolution.transform(plane) * convolution.transfer(psf))

    def blur(planes: Tensor) -> Tensor:
        of_bands = bank.of_bands(psfs)
        run: Callable[..., Tensor] = band
        if torch.is_grad_enabled() and has_derivative((planes, psfs, spectra)):
            # between the forward and the backward pass only the results are kept, not 28 spectra
            run = functools.partial(checkpoint, band, use_reentrant=False)
        return torch.stack([run(planes, of_bands[index], index) for index in range(bank.bands)], dim=1)

    return direct if bank.direct else blur


def _groups_take(n: Bank) -> Takes:
    parts = n.channels * n.groups
    touched = parts * n.planes * prod(n.picture) / CONTRACTED
    held = 3 * n.channels + n.groups
    return Takes(parts, n.groups, n.channels, parts, cost=parts, once=n.groups, held=held, touched=touched)


def _groups(bank: Bank, psfs: Tensor) -> Blur:
    """sum_g h_g (sum_k M_ckg C_k): for few PSFs the planes are contracted, before the transform."""
    mixing = bank.mixing()

    def parts(planes: Tensor) -> Iterator[Tensor]:
        at_once = max(bank.planes, bank.convolution.at_once(len(planes))) // bank.channels
        for some in mixing.split(max(1, at_once), dim=2):  # a product each, of no more than there is, or stays near
            yield from torch.einsum("ckg,bkhw->gbchw", some, planes)

    def direct(part: Tensor, psf: Tensor) -> Tensor:
        extended = bank.extend(part).flatten(0, 1)[:, None]
        return correlate(extended, psf[None, None]).unflatten(0, part.shape[:2]).squeeze(2)

    if bank.direct:
        return lambda planes: functools.reduce(torch.add, map(direct, parts(planes), psfs))
    convolution, transfers = bank.convolution, bank.transfers(lambda: psfs, bank.groups, psfs)

    def blur(planes: Tensor) -> Tensor:
        pairs = zip(parts(planes), transfers, strict=True)
        return convolution.back(functools.reduce(torch.add, (convolution.transform(p) * t for p, t in pairs)))

    return blur


def _apart_takes(n: Bank) -> Takes:
    parts = n.planes * n.groups
    touched = n.channels * parts * prod(n.picture) / CONTRACTED
    cost, held = n.planes + parts - n.channels + parts / 10, n.planes + n.groups + 2 + parts
    return Takes(n.planes, n.groups, parts, parts, cost=cost, once=n.groups, held=held, touched=touched)


def _apart(bank: Bank, psfs: Tensor) -> Blur:
    """sum_kg M_ckg (h_g C_k): before many channels each of few planes through each of few PSFs, contracted at last."""
    mixing = bank.mixing()

    def direct(planes: Tensor) -> Tensor:
        found = correlate(bank.extend(planes).flatten(0, 1)[:, None], psfs[:, None])
        return torch.einsum("ckg,bkghw->bchw", mixing, found.unflatten(0, planes.shape[:2]))

    if bank.direct:
        return direct
    convolution, transfers = bank.convolution, bank.transfers(lambda: psfs, bank.groups, psfs)

    def blur(planes: Tensor) -> Tensor:
        spectra, at_once = convolution.transform(planes).split(1, dim=1), convolution.at_once(len(planes))
        parts = [convolution.back(spectrum * some) for spectrum in spectra for some in transfers.split(at_once)]
        return torch.einsum("cp,bphw->bchw", mixing.flatten(1), torch.cat(parts, dim=1))

    return blur


def _kernels_take(n: Bank) -> Takes:
    kernels = n.channels * n.planes
    few = kernels <= n.groups  # measured: the kernels' own contraction runs well
    cost, once = (0.0, 0.0) if few else (n.planes, kernels)
    if n.spectra is None:
        cost = inf
    contracted = kernels * n.groups * prod(n.window) / CONTRACTED
    held = n.planes + kernels + 3 + n.channels
    return Takes(n.planes, kernels, n.channels, kernels, cost=cost, once=once, held=held, contracted=contracted)


def _kernels(bank: Bank, psfs: Tensor) -> Blur:
    """sum_k (sum_g M_ckg h_g) C_k: for few channels and planes the PSFs are contracted, not the spectra."""
    mixing = bank.mixing()

    def kernels() -> Tensor:
        return torch.einsum("ckg,gyx->ckyx", mixing, psfs)

    if bank.direct:
        found = kernels()
        # the picture is upright, so the PSF is turned: a correlation, which is what conv2d computes
        return lambda planes: correlate(bank.extend(planes), found)
    convolution = bank.convolution
    channels = bank.transfers(kernels, bank.channels * bank.planes, psfs, mixing)

    def blur(planes: Tensor) -> Tensor:
        spectra, lights = convolution.transform(planes).split(1, dim=1), []
        for some in channels.split(convolution.at_once(len(planes))):
            first, *others = some.unbind(1)
            light = spectra[0] * first
            for spectrum, other in zip(spectra[1:], others, strict=True):  # measured: a third of the time of a sum
                light = torch.addcmul(light, spectrum, other)
            lights.append(convolution.back(light))
        return torch.cat(lights, dim=1)

    return blur


def _bands_take(n: Bank) -> Takes:
    at_once = min(n.bands, n.sizes.bands)
    mixed = n.channels + (0 if n.spectra is None else n.planes)
    products = n.bands + n.bands * mixed // CONTRACTED  # strips that are mixed stay in the processor's cache
    cost = inf if n.direct else n.planes + products / 10
    held = (at_once if n.spectra is None else n.planes) + at_once + 2 * n.channels
    return Takes(n.planes, n.bands, n.channels, products, cost=cost, once=n.bands, held=held)


def _bands(bank: Bank, psfs: Tensor) -> Blur:
    """sum_l kappa_cl h_l (sum_k S_kl C_k): the spectra are contracted, see `contraction`."""
    psfs, weights, convolution = bank.of_bands(psfs), bank.kappa(), bank.convolution
    kept = bank.transfers(lambda: psfs, len(psfs), psfs) if bank.keeps(len(psfs), psfs) else None
    return lambda planes: contract(planes, psfs, bank.spectra, weights, kept, convolution)


WAYS = {
    "each": Way(_each_takes, _each),
    "groups": Way(_groups_take, _groups),
    "apart": Way(_apart_takes, _apart),
    "kernels": Way(_kernels_take, _kernels),
    "bands": Way(_bands_take, _bands),
}


def choose(bank: Bank, batch: int) -> Way:
    """The cheapest way for so many pictures; the first of those that cost the same."""

    def cost(way: Way) -> float:
        takes = way.takes(bank)
        return max(batch, 1) * takes.cost + takes.once

    return min(WAYS.values(), key=cost)
