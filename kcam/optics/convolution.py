"""Convolution of pictures with banks of PSFs by FFT, contracted to a sensor's channels before the way back.

    I_c = sum_l kappa_cl (I_l * h_l),   I_l = sum_k S_kl C_k

The sum over wavelengths stands *inside* the Fourier transform: the picture is transformed once per plane of the scene's
factors, and back once per channel, not once per band.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from kcam.cache import ValueCache
from kcam.compiled import uncompiled
from kcam.effects import Work
from kcam.optics.autograd import once_differentiable
from kcam.optics.transforms import fast_length
from kcam.precision import full_precision

BORDERS = ("reflect", "replicate", "periodic", "zero")
_CACHED = 2**20  # pixels beyond which a plane is no longer near the processor
_UNFOLDED = 2**25  # bytes of a strip that is convolved directly
_PIXELS_IN_CACHE = 2**16  # of planes that are transformed at once
_STRIP = 2**17  # values of a strip of columns of half spectra
_LINE = 8  # complex numbers that lie in one line of a processor's cache
_ALL = slice(None)


class Renderer:
    """Convolves pictures (B, K, H, W) with a bank of PSFs (Z, G, h, w), contracted to the channels.

    Args:
        owner: (L,) which of the G PSFs each band takes; None where each band has its own.
        spectra: (K, L) of the planes, or None where the planes are the bands.
        weights: (C, L) of the channels, or None for all bands.
        picture: (H, W). border: what lies beyond it, one of `BORDERS`.
        direct: sum over the window in the picture instead of by FFT; with the same result, faster for small windows.
        tile: side of the squares that the picture is cut into [pixels], or None; with the same result, in less memory.
        max_memory: bytes that the transforms may take. cache: for transfer functions, while the optics stay.
    """

    def __init__(
        self,
        psfs: Tensor,
        *,
        spectra: Tensor | None,
        weights: Tensor | None,
        picture: tuple[int, int],
        owner: Tensor | None = None,
        border: str = "reflect",
        direct: bool = False,
        tile: int | None = None,
        max_memory: float = 2e9,
        cache: ValueCache | None = None,
    ) -> None:
        self.psfs, self.owner, self.spectra, self.weights = psfs, owner, spectra, weights
        self.picture, self.border, self.direct, self.tile = picture, border, direct, tile
        self.max_memory, self.cache = max_memory, cache
        self.window = (psfs.shape[-2], psfs.shape[-1])
        self.convolution = self._convolution(border)

    def blur(self, planes: Tensor, *, layer: int) -> Tensor:
        """The scene's planes (B, K, H, W) through the PSFs of one layer: (B, C, H, W)."""
        return self._tiles(planes, self._blur(self.psfs[layer]), self.convolution, self.border)

    def coverage(self, share: Tensor, *, layer: int) -> Tensor:
        """How masks (B, 1, H, W) spread in each channel, relative to the PSFs' own sum: (B, C, H, W).

        Where zeros lie beyond the picture it is dark there, not empty: what stands at the border goes on.
        """
        border = "replicate" if self.border == "zero" else self.border
        convolution = self.convolution if border == self.border else self._convolution(border)
        psfs = self.psfs[layer]
        if self.weights is None:
            kernels = self._of_bands(psfs)
        else:
            kernels = torch.einsum("cg,gyx->cyx", self._grouped(self.weights), psfs)
        kernels = kernels / kernels.sum((-2, -1), keepdim=True)
        if self.direct:
            return correlate(extend(share, self.window, border), kernels[:, None])
        transfers = convolution.transfer(kernels)
        return self._tiles(
            share, lambda part: convolution.back(convolution.transform(part) * transfers), convolution, border
        )

    def _convolution(self, border: str) -> Convolution:
        tile, picture = self.tile, self.picture
        tiled = tile is not None and tile < max(picture)
        return Convolution.of(
            (min(tile, picture[0]), min(tile, picture[1])) if tile is not None else picture,
            self.window,
            border="given" if tiled else border,
            itemsize=self.psfs.element_size(),
            max_memory=self.max_memory,
            layers=self.psfs.shape[0],
        )

    def _of_bands(self, psfs: Tensor) -> Tensor:
        """The PSF of each band, (L, h, w)."""
        return psfs if self.owner is None else psfs[self.owner.to(psfs.device)]

    def _grouped(self, weights: Tensor) -> Tensor:
        """Weights of the bands, (..., L), added up over those that share a PSF: (..., G)."""
        if self.owner is None:
            return weights
        sums = weights.new_zeros(*weights.shape[:-1], self.psfs.shape[1])
        return sums.index_add(-1, self.owner.to(weights.device), weights)

    def _tiles(self, planes: Tensor, blur: Callable[[Tensor], Tensor], convolution: Convolution, border: str) -> Tensor:
        """The picture in squares, each with what the window reaches around it; or whole."""
        if self.direct or convolution.border != "given":
            return blur(planes)
        (height, width), (rows, columns), (h, w) = self.picture, convolution.picture, self.window
        down, across = -(-height // rows), -(-width // columns)
        extended = extend(planes, self.window, border)
        pad = (0, across * columns + w - 1 - extended.shape[-1], 0, down * rows + h - 1 - extended.shape[-2])
        extended = torch.nn.functional.pad(extended, pad)
        parts = [
            [
                blur(extended[..., i * rows : (i + 1) * rows + h - 1, j * columns : (j + 1) * columns + w - 1])
                for j in range(across)
            ]
            for i in range(down)
        ]
        return torch.cat([torch.cat(row, dim=-1) for row in parts], dim=-2)[..., :height, :width]

    def _blur(self, psfs: Tensor) -> Callable[[Tensor], Tensor]:
        """What one layer's PSFs do to planes; what does not depend on the planes is computed here, once."""
        weights, spectra, convolution = self.weights, self.spectra, self.convolution
        if weights is None:
            return lambda planes: self._per_band(planes, self._of_bands(psfs))
        ways = _ways(
            planes=None if spectra is None else spectra.shape[0],
            bands=weights.shape[1],
            groups=psfs.shape[0],
            channels=weights.shape[0],
            direct=self.direct,
        )
        if ways != "bands":
            planes_of = torch.eye(weights.shape[1]).to(weights) if spectra is None else spectra  # bands are planes too
            mixing = self._grouped(weights[:, None] * planes_of)  # (C, K, G)
            return self._by_kernels(mixing, psfs) if ways == "kernels" else self._by_groups(mixing, psfs)
        psfs = self._of_bands(psfs)
        count, kept = psfs.shape[0], None
        if self._keeps(count, psfs):
            kept = self._transfers(count, lambda: convolution.transfer(psfs), psfs)
        return lambda planes: contract(planes, psfs, spectra, weights, kept, convolution)

    def _by_kernels(self, mixing: Tensor, psfs: Tensor) -> Callable[[Tensor], Tensor]:
        """sum_k (sum_g M_ckg h_g) C_k: for few channels and planes the PSFs are contracted, not the spectra."""

        def kernels() -> Tensor:
            return torch.einsum("ckg,gyx->ckyx", mixing, psfs)

        if self.direct:
            found = kernels()
            # the picture is upright, so the PSF is turned: a correlation, which is what conv2d computes
            return lambda planes: correlate(extend(planes, self.window, self.border), found)
        convolution, count = self.convolution, mixing.shape[0] * mixing.shape[1]
        channels = self._transfers(count, lambda: convolution.transfer(kernels()), psfs, mixing)

        def blur(planes: Tensor) -> Tensor:
            spectrum = convolution.transform(planes)
            return torch.stack([convolution.back((spectrum * channel).sum(1)) for channel in channels], dim=1)

        return blur

    def _by_groups(self, mixing: Tensor, psfs: Tensor) -> Callable[[Tensor], Tensor]:
        """sum_g h_g (sum_k M_ckg C_k): for few PSFs the planes are contracted, before the transform."""
        convolution = self.convolution

        def parts(planes: Tensor) -> Iterator[Tensor]:
            return (torch.einsum("ck,bkhw->bchw", mixing[..., index], planes) for index in range(psfs.shape[0]))

        if self.direct:

            def in_picture(planes: Tensor) -> Tensor:
                total = planes.new_zeros(())
                for psf, part in zip(psfs, parts(planes), strict=True):
                    extended = extend(part, self.window, self.border).flatten(0, 1)[:, None]
                    total = total + correlate(extended, psf[None, None]).unflatten(0, part.shape[:2])
                return total.squeeze(2)

            return in_picture
        transfers = self._transfers(psfs.shape[0], lambda: convolution.transfer(psfs), psfs)

        def blur(planes: Tensor) -> Tensor:
            spectra = (
                convolution.transform(part) * transfer for part, transfer in zip(parts(planes), transfers, strict=True)
            )
            return convolution.back(functools.reduce(torch.add, spectra))

        return blur

    def _per_band(self, planes: Tensor, psfs: Tensor) -> Tensor:
        """Each band by itself, for a sensor that sees all bands."""
        if self.direct:
            light = planes if self.spectra is None else torch.einsum("bkhw,kl->blhw", planes, self.spectra)
            extended = extend(light, self.window, self.border)
            return correlate(extended, psfs[:, None], groups=psfs.shape[0])

        def band(planes: Tensor, psf: Tensor, index: int) -> Tensor:
            plane = (
                planes[:, index]
                if self.spectra is None
                else torch.einsum("bkhw,k->bhw", planes, self.spectra[:, index])
            )
            return self.convolution.back(self.convolution.transform(plane) * self.convolution.transfer(psf))

        # between the forward and the backward pass only the results are kept, not 28 spectra
        bands = (
            checkpoint(band, planes, psfs[i], i, use_reentrant=False)
            if torch.is_grad_enabled()
            else band(planes, psfs[i], i)
            for i in range(psfs.shape[0])
        )
        return torch.stack(list(bands), dim=1)

    def _keeps(self, count: int, *sources: Tensor) -> bool:
        """Whether so many transfer functions are kept between calls: while they fit, and nothing is trained."""
        size = count * self.convolution.size[0] * self.convolution.size[1] * self.psfs.element_size()
        trained = any(t.requires_grad for t in sources)
        return not trained and self.psfs.shape[0] == 1 and size <= self.max_memory / 4

    def _transfers(self, count: int, build: Callable[[], Tensor], *sources: Tensor) -> Tensor:
        """Transfer functions, kept while what they come from is the same."""
        if self.cache is None or not self._keeps(count, *sources):
            return build()
        return self.cache.get((*sources, self.convolution.size), build)


def _ways(*, planes: int | None, bands: int, groups: int, channels: int, direct: bool) -> str:
    """What is contracted first: the PSFs to "kernels", the planes to "groups" of one PSF each, or the spectra in
    "bands". Counted in transforms; ten products of two planes take the time of one.

    planes: None where they are the bands.
    """
    count = bands if planes is None else planes
    costs = {"groups": groups * (channels + 1.0)}
    if planes is not None:
        costs["kernels"] = planes * (channels + 1.0)
        if channels * planes <= groups:  # measured: the kernels' own contraction runs well
            return "kernels"
    if not direct:
        costs["bands"] = count + bands + bands * (1 + channels + (planes or 0)) / 10
    return min(costs, key=costs.__getitem__)


def rendering_work(
    picture: tuple[int, int],
    window: tuple[int, int],
    *,
    planes: int,
    factored: bool,
    bands: int,
    groups: int,
    channels: int | None,
    border: str,
    direct: bool,
    tile: int | None,
    itemsize: int,
    max_memory: float,
    coverage: bool,
) -> Work:
    """What `Renderer` does for one layer of one picture. Arguments: as its own; channels: None for all bands."""
    part = picture if tile is None else (min(tile, picture[0]), min(tile, picture[1]))
    tiles = math.ceil(picture[0] / part[0]) * math.ceil(picture[1] / part[1])
    sizes = Convolution.of(part, window, border=border, itemsize=itemsize, max_memory=max_memory)
    points, kernel, pixels = sizes.size[0] * sizes.size[1], window[0] * window[1], picture[0] * picture[1]
    out = bands if channels is None else channels
    mixed = float(out * groups * kernel if coverage and channels is not None else 0)
    held: float
    if channels is None:
        inputs, kernels, products, held = bands, bands, bands, 4 + bands * pixels / points
    else:
        own = planes if factored else None
        way = _ways(planes=own, bands=bands, groups=groups, channels=channels, direct=direct)
        if way == "kernels":
            inputs, kernels, products = planes, channels * planes, channels * planes
            mixed, held = mixed + kernels * groups * kernel, inputs + kernels + 3 + channels
        elif way == "groups":
            inputs, kernels, products = channels * groups, groups, channels * groups
            mixed, held = mixed + inputs * planes * pixels / 8, 3 * channels + groups
        else:
            inputs, kernels = (planes if factored else bands), bands
            products = bands * (1 + channels + (planes if factored else 0))
            held = (planes if factored else min(bands, sizes.bands)) + min(bands, sizes.bands) + 2 * channels
    if direct:
        summed = products + (2 * out if coverage else 0)
        touched = (inputs + 2 * out) * pixels + mixed
        memory = float(itemsize * (2 * inputs * pixels + summed * kernel + out * pixels))
        slow = 4 if pixels > 2**17 else 1  # measured: unfolded, a larger picture is far from the processor
        return Work({"product": float(summed * pixels * kernel * slow), "touch": touched}, memory)
    transforms = float(tiles * (inputs + out) + kernels)
    touched = float(tiles * points * (inputs + out + products) + kernels * points) + mixed
    if coverage:
        beyond = "replicate" if border == "zero" else border
        covering = Convolution.of(part, window, border=beyond, itemsize=itemsize, max_memory=max_memory)
        ratio = covering.size[0] * covering.size[1] / points
        transforms += ratio * (tiles * 2 * (1 + out) + out)
        touched += ratio * tiles * points * 2 * (1 + 3 * out) + 6 * out * pixels
    memory = float(itemsize * (held * points + (inputs + out) * pixels))
    operations = {"transform": transforms * points * math.log2(max(2, points)), "touch": touched}
    if pixels > _CACHED:  # whole it is touched again and again in far memory, in tiles once
        operations["large"] = float(pixels * (inputs + out) * (2 if tiles == 1 else 1))
    return Work(operations, memory)


@dataclass(frozen=True)
class Convolution:
    """Sizes of a convolution by FFT, and its parts.

    The picture is upright, which turns the PSF by 180 degrees: a correlation, so transfer functions are conjugated,
    and the window's origin needs no shift: the picture is extended by window // 2 before its first pixel.
    Half spectra are (..., F, rows), F = columns // 2 + 1: what is transformed last lies in lines of memory.
    """

    picture: tuple[int, int]
    window: tuple[int, int]
    border: str  # one of BORDERS, or "given": the planes come with what lies around them
    size: tuple[int, int]
    bands: int  # planes whose half spectra fit into a quarter of the memory
    held: int  # planes whose spectra may wait for the backward pass

    @classmethod
    def of(
        cls,
        picture: tuple[int, int],
        window: tuple[int, int],
        *,
        border: str,
        itemsize: int,
        max_memory: float,
        layers: int = 1,
    ) -> Convolution:
        """Fast lengths for a picture and a window, and as many bands at once as fit into a quarter of the memory.

        layers: of depth, which share another quarter for what is held. Tiles are many and hold none.
        """
        after = border != "zero"  # zeros may share their place with those before the picture
        rows, columns = (
            fast_length(max(m, n + (m - 1 if after else m // 2))) for n, m in zip(picture, window, strict=True)
        )
        quarter = int(max_memory // (4 * rows * columns * itemsize))
        held = 0 if border == "given" else quarter // layers
        return cls(picture, window, border, (rows, columns), max(1, quarter), held)

    def parts(self, count: int, batch: int) -> list[slice]:
        """So many bands of so many pictures, as many at once as there is room for."""
        step = max(1, self.bands // (batch + 1))
        return [slice(start, min(start + step, count)) for start in range(0, count, step)]

    def strips(self, like: Tensor, count: int) -> list[slice]:
        """Columns of so many half spectra: on a CPU as many at once as stay in its cache."""
        columns = self.size[1] // 2 + 1
        step = max(_LINE, _STRIP // (count * self.size[0])) if like.device.type == "cpu" else columns
        return [slice(start, min(start + step, columns)) for start in range(0, columns, step)]

    def transform(self, planes: Tensor) -> Tensor:
        """Half spectra of planes (..., H, W) with their border."""
        return _in_cache(lambda part: self.columns(self._rows(part)), planes)

    def rows(self, planes: Tensor) -> Tensor:
        """Half spectra of the rows of planes (..., H, W) with their border."""
        return _in_cache(self._rows, planes)

    def _rows(self, planes: Tensor) -> Tensor:
        return torch.fft.rfft(self._extend(planes, dim=-1), n=self.size[1])

    def columns(self, rows: Tensor, strip: slice = _ALL) -> Tensor:
        """Spectra of a strip of columns. A row of the border repeats one of the picture: it was transformed once."""
        return torch.fft.fft(self._extend(rows[..., strip], dim=-2).mT, n=self.size[0])

    def _extend(self, planes: Tensor, *, dim: int) -> Tensor:
        """The border on both sides. A mirror, a seam or an edge goes on up to the transform's length: no pixel that is
        kept sees so far, and zeros would be one more copy.
        """
        if self.border == "given":
            return planes
        return extend_along(planes, self.window[dim], self.border, dim=dim, length=self.size[dim])

    def rows_adjoint(self, rows: Tensor) -> Tensor:
        """Gradient to planes (..., H, W), from `columns_adjoint`."""
        return _in_cache(lambda part: self._fold(torch.fft.irfft(part, n=self.size[1]), dim=-1), rows)

    def columns_adjoint(self, conjugate: Tensor) -> Tensor:
        """What becomes the gradient to planes, from the conjugate of that to spectra times the number of points."""
        return self._fold(torch.fft.ifft(conjugate.conj()).mT, dim=-2)

    def _fold(self, extended: Tensor, *, dim: int) -> Tensor:
        """Transpose of `_extend`, and of the zeros up to the transform's length."""
        n, m = self.picture[dim], self.window[dim]
        before, after = m // 2, (m - 1) // 2
        if self.border == "zero":
            return extended.narrow(dim, before, n)
        extended = extended.narrow(dim, 0, n + before + after)
        if self.border == "given":
            return extended
        index = _border_index(torch.arange(-before, n + after, device=extended.device), n, self.border)
        shape = list(extended.shape)
        shape[dim] = n
        return extended.new_zeros(shape).index_add_(dim, index, extended)

    def transfer(self, kernels: Tensor) -> Tensor:
        """Conjugate transfer functions of kernels (..., h, w)."""
        return _in_cache(lambda part: self.conjugate_columns(self._conjugate_rows(part)), kernels)

    def conjugate_rows(self, planes: Tensor) -> Tensor:
        """Conjugate half spectra of the rows of planes (..., h, w) with nothing around them."""
        return _in_cache(self._conjugate_rows, planes)

    def _conjugate_rows(self, planes: Tensor) -> Tensor:
        # in memory: a lazy conjugate would be copied at every product
        return torch.fft.rfft(planes, n=self.size[1]).conj_physical_()

    def conjugate_columns(self, rows: Tensor, strip: slice = _ALL) -> Tensor:
        """Conjugate spectra of a strip of columns."""
        return torch.fft.ifft(rows[..., strip].mT, n=self.size[0], norm="forward")

    def back(self, spectrum: Tensor) -> Tensor:
        """The picture of a half spectrum."""
        height, width = self.picture
        return _in_cache(lambda part: self._back_rows(self.back_columns(part, height), width), spectrum)

    def back_columns(self, spectra: Tensor, height: int) -> Tensor:
        """The first `height` rows of a strip of columns; no others go on to the second transform."""
        return torch.fft.ifft(spectra)[..., :height].mT

    def back_rows(self, rows: Tensor, width: int) -> Tensor:
        """The first `width` pixels of each row."""
        return _in_cache(lambda part: self._back_rows(part, width), rows)

    def _back_rows(self, rows: Tensor, width: int) -> Tensor:
        return torch.fft.irfft(rows, n=self.size[1])[..., :width]

    def room(self, like: Tensor, *shape: int) -> Tensor:
        """For the half spectra of rows (*shape, F)."""
        return torch.view_as_complex(like.new_empty(*shape, self.size[1] // 2 + 1, 2))

    def inner(self, conjugate: Tensor, spectra: Tensor, strip: slice) -> Tensor:
        """What strips (M, F, rows) and (K, F, rows) add to the inner products (M, K) of real planes, by Parseval."""
        counted = conjugate.real.new_full((self.size[1] // 2 + 1, 1, 2), 2.0)  # the other half is implied
        counted[0] = 1.0
        if self.size[1] % 2 == 0:
            counted[-1] = 1.0
        counted[..., 1].neg_()
        counted /= self.size[0] * self.size[1]
        return (torch.view_as_real(conjugate) * counted[strip]).flatten(1) @ torch.view_as_real(spectra).flatten(1).T


def _in_cache(function: Callable[[Tensor], Tensor], planes: Tensor) -> Tensor:
    """function(planes) (..., H, W), on a CPU a few planes after the others, so that each stays in its cache.

    Measured: planes of 256 x 256 one by one take a third of the time of 28 at once, smaller ones gain nothing.
    """
    at_once = max(1, _PIXELS_IN_CACHE // max(1, planes.shape[-2] * planes.shape[-1]))
    few = planes.shape[:-2].numel() <= at_once
    if few or planes.device.type != "cpu" or torch.compiler.is_compiling():  # compiled, each would be traced by itself
        return function(planes)
    parts = planes.flatten(0, -3).split(at_once)
    if planes.requires_grad and torch.is_grad_enabled():
        return torch.cat([function(part) for part in parts]).unflatten(0, planes.shape[:-2])
    first = function(parts[0])
    out = first.new_empty(planes.shape[:-2].numel(), *first.shape[1:])
    for place, part in zip(out.split(at_once), parts, strict=True):  # each is copied while it is near
        place.copy_(first if part is parts[0] else function(part))
    return out.unflatten(0, planes.shape[:-2])


@uncompiled  # its transforms are compiled code as they are, and each strip would be traced by itself
def contract(
    planes: Tensor,
    psfs: Tensor,
    spectra: Tensor | None,
    weights: Tensor,
    kept: Tensor | None,
    convolution: Convolution,
) -> Tensor:
    """Pictures (B, C, H, W) of planes (B, K, H, W) with PSFs (L, h, w): `Contraction`, as part of a graph."""
    return Contraction.apply(planes, psfs, spectra, weights, kept, convolution)


class Contraction(torch.autograd.Function):
    """sum_l kappa_cl H_l (sum_k S_kl C_k), strip by strip of the spectra's columns.

    Rows are transformed first, of all bands that fit into memory. What then becomes of a strip of columns, from their
    transform to the transform back, stays in the processor's cache: whole spectra of all bands would be written to far
    memory and read again at every step. What a batch shares, a band's transfer function and the way back of its
    gradient, is computed once for all its pictures. The spectra of the planes are held for the backward pass where all
    layers' together take no more than a quarter of the memory.
    """

    @staticmethod
    def forward(ctx, planes, psfs, spectra, weights, kept, convolution):
        height, width = convolution.picture
        parts = convolution.parts(len(psfs), len(planes))
        spectra_of_all = planes.shape[:2].numel() * (1 if spectra is None else len(parts))
        hold = any(ctx.needs_input_grad[1:4]) and spectra_of_all <= convolution.held
        held = []
        result = convolution.room(planes, len(planes), len(weights), height)
        for part in parts:
            bands = _Bands(convolution, part, planes, psfs, spectra, kept)
            for strip in bands.strips():
                transfers = bands.transfers(strip)
                for b, total in enumerate(result):
                    own = bands.columns(b, strip)
                    held += [own] if hold else []
                    mixed = _mixed(weights[:, part], bands.light(own) * transfers)
                    _put(total[..., strip], convolution.back_columns(mixed, height), add=part.start > 0)
        ctx.save_for_backward(planes, psfs, spectra, weights, kept, *held)
        ctx.convolution = convolution
        picture = convolution.back_rows(result, width)
        return picture.clone(memory_format=torch.contiguous_format)  # of a view, nothing could be changed in place

    @staticmethod
    @once_differentiable
    def backward(ctx, saved, grad):
        planes, psfs, spectra, weights, kept, *held = saved
        convolution, in_order = ctx.convolution, iter(held)
        need_planes, need_psfs, need_spectra, need_weights = ctx.needs_input_grad[:4]
        d_psfs = torch.empty_like(psfs) if need_psfs else None
        d_spectra = torch.zeros_like(spectra) if need_spectra else None
        d_weights = torch.zeros_like(weights) if need_weights else None
        d_planes = torch.empty_like(planes) if need_planes else None
        d_rows = convolution.room(planes, *planes.shape[:-1]) if need_planes and spectra is not None else None
        with full_precision(grad.device):
            onto_rows = convolution.conjugate_rows(grad)
            for part in convolution.parts(len(psfs), len(planes)):
                bands = _Bands(convolution, part, planes, psfs, spectra, kept)
                if d_planes is not None and spectra is None:  # bands of a part are planes of its own
                    d_rows = convolution.room(planes, *planes[:, part].shape[:-1])
                d_psf_rows = convolution.room(psfs, *bands.psfs.shape[:-1]) if need_psfs else None
                for strip in bands.strips():
                    transfers = bands.transfers(strip) if need_planes or need_spectra or need_weights else None
                    d_transfers = None
                    for b, onto_row in enumerate(onto_rows):
                        onto = convolution.conjugate_columns(onto_row, strip)
                        d_product = _mixed(weights[:, part].T, onto)
                        if need_psfs or need_spectra or need_weights:
                            own = next(in_order) if held else bands.columns(b, strip)
                        if need_planes or need_spectra:
                            d_light = d_product * transfers
                            if d_spectra is not None:
                                d_spectra[:, part] += convolution.inner(d_light, own, strip).T
                            if d_rows is not None:
                                d_own = d_light if spectra is None else _mixed(spectra[:, part], d_light)
                                add = spectra is not None and part.start > 0
                                _put(d_rows[b, ..., strip], convolution.columns_adjoint(d_own), add=add)
                        if need_psfs or need_weights:
                            light = bands.light(own)
                            if d_weights is not None:
                                d_weights[:, part] += convolution.inner(onto, light * transfers, strip)
                            if d_transfers is not None:
                                d_transfers.addcmul_(light, d_product)
                            elif need_psfs:
                                d_transfers = light * d_product
                    if d_psf_rows is not None:
                        d_psf_rows[..., strip] = convolution.back_columns(d_transfers, psfs.shape[-2])
                if d_psfs is not None:
                    d_psfs[part] = convolution.back_rows(d_psf_rows, psfs.shape[-1])
                if d_planes is not None and spectra is None:
                    d_planes[:, part] = convolution.rows_adjoint(d_rows)
            if d_planes is not None and spectra is not None:
                d_planes = convolution.rows_adjoint(d_rows)
        return d_planes, d_psfs, d_spectra, d_weights, None, None


@dataclass
class _Bands:
    """Part of the bands: their transfer functions, and the spectra of their light, a strip of columns at a time."""

    convolution: Convolution
    part: slice
    planes: Tensor
    all_psfs: Tensor
    spectra: Tensor | None
    kept: Tensor | None

    @property
    def psfs(self) -> Tensor:
        return self.all_psfs[self.part]

    @functools.cached_property
    def rows(self) -> list[Tensor]:
        """Half spectra of the rows of each picture's planes."""
        planes = self.planes if self.spectra is not None else self.planes[:, self.part]
        return [self.convolution.rows(picture) for picture in planes]

    @functools.cached_property
    def _psf_rows(self) -> Tensor:
        return self.convolution.conjugate_rows(self.psfs)

    def strips(self) -> list[slice]:
        return self.convolution.strips(self.planes, len(self.psfs))

    def transfers(self, strip: slice) -> Tensor:
        """Conjugate transfer functions of the bands, (g, strip, rows)."""
        if self.kept is not None:
            return self.kept[self.part, strip]
        return self.convolution.conjugate_columns(self._psf_rows, strip)

    def columns(self, b: int, strip: slice) -> Tensor:
        """Spectra of the planes of picture b, (K, strip, rows)."""
        return self.convolution.columns(self.rows[b], strip)

    def light(self, columns: Tensor) -> Tensor:
        """Spectra of the bands, (g, strip, rows)."""
        return columns if self.spectra is None else _mixed(self.spectra[:, self.part].T, columns)


def _mixed(weights: Tensor, spectra: Tensor) -> Tensor:
    """sum_k weights_mk spectra_k of complex spectra (K, ...) with real weights (M, K)."""
    mixed = weights @ torch.view_as_real(spectra).flatten(1)
    return torch.view_as_complex(mixed.view(-1, *spectra.shape[1:], 2))


def _put(place: Tensor, values: Tensor, *, add: bool) -> None:
    """Add values to a place, or write them there."""
    place.add_(values) if add else place.copy_(values)


def correlate(planes: Tensor, kernels: Tensor, *, groups: int = 1) -> Tensor:
    """`conv2d` in strips of rows: it unfolds its input, which for a whole picture would be gigabytes."""
    rows = planes.shape[-2] - kernels.shape[-2] + 1
    unfolded = planes.shape[0] * planes.shape[-1] * planes.shape[-3] * kernels[0, 0].numel() * planes.element_size()
    strip = max(1, int(_UNFOLDED // unfolded))
    parts = [
        torch.nn.functional.conv2d(planes[..., top : top + strip + kernels.shape[-2] - 1, :], kernels, groups=groups)
        for top in range(0, rows, strip)
    ]
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim=-2)


def extend(planes: Tensor, window: tuple[int, int], border: str) -> Tensor:
    """The picture with the border that the window reaches: window // 2 before, the rest after."""
    for dim, m in zip((-2, -1), window, strict=True):
        planes = extend_along(planes, m, border, dim=dim)
    return planes


def extend_along(planes: Tensor, window: int, border: str, *, dim: int, length: int | None = None) -> Tensor:
    """`extend` along one axis, dim -2 or -1; to a length, a border other than zeros goes on up to there."""
    n, before, after = planes.shape[dim], window // 2, (window - 1) // 2
    if border == "zero":
        return torch.nn.functional.pad(planes, (0, 0, before, after) if dim == -2 else (before, after))
    index = torch.arange(-before, n + after if length is None else length - before, device=planes.device)
    index = _border_index(index, n, border)
    if dim == -2:
        return planes.index_select(dim, index)
    rows = planes.flatten(0, -2).index_select(-1, index)  # measured: of a matrix it takes a quarter of the time
    return rows.unflatten(0, planes.shape[:-1])


def _border_index(index: Tensor, n: int, border: str) -> Tensor:
    """Which pixel stands at each position beyond the picture; reflections repeat where the window is larger."""
    if border == "replicate" or n == 1:
        return index.clamp(0, n - 1)
    if border == "periodic":
        return index % n
    folded = index % (2 * n - 2)
    return torch.where(folded < n, folded, 2 * n - 2 - folded)
