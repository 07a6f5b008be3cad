"""Sizes and parts of a convolution by FFT, and one without."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from kcam.optics.numerics import fast_length
from kcam.optics.rendering.borders import border_index, extend_along

_UNFOLDED = 2**25  # bytes of a strip that is convolved directly
_PIXELS_IN_CACHE = 2**16  # of planes that are transformed at once
_POINTS_AT_ONCE = 2**18  # of spectra that are multiplied and transformed back at once: calls of small ones count
_STRIP = 2**17  # values of a strip of columns of half spectra
_LINE = 8  # complex numbers that lie in one line of a processor's cache
_ALL = slice(None)


@dataclass(frozen=True)
class Convolution:
    """Sizes of a convolution by FFT, and its parts.

    The picture is upright, which turns the PSF by 180 degrees: a correlation, so transfer functions are conjugated,
    and the window's origin needs no shift: the picture is extended by window // 2 before its first pixel.
    Half spectra are (..., F, rows), F = columns // 2 + 1: what is transformed last lies in lines of memory.
    In the dark it is all that the window reaches that is seen, window - 1 pixels before the picture too: these come out
    at the end of a transform.
    """

    picture: tuple[int, int]
    window: tuple[int, int]
    border: str  # one of BORDERS, "dark", or "given": planes come with what lies around them
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

        def reached(m: int) -> int:
            return m // 2 if border == "zero" else m - 1  # zeros may share their place with those before the picture

        rows, columns = (fast_length(max(m, n + reached(m))) for n, m in zip(picture, window, strict=True))
        quarter = int(max_memory // (4 * rows * columns * itemsize))
        held = 0 if border == "given" else quarter // layers
        return cls(picture, window, border, (rows, columns), max(1, quarter), held)

    @property
    def seen(self) -> tuple[int, int]:
        """Pixels of the result."""
        beyond = [m - 1 if self.border == "dark" else 0 for m in self.window]
        return self.picture[0] + beyond[0], self.picture[1] + beyond[1]

    def parts(self, count: int, batch: int) -> list[slice]:
        """So many bands of so many pictures, as many at once as there is room for."""
        step = max(1, self.bands // (batch + 1))
        return [slice(start, min(start + step, count)) for start in range(0, count, step)]

    def at_once(self, batch: int) -> int:
        """Spectra of each picture of a batch that are multiplied and transformed back at once."""
        return max(1, _POINTS_AT_ONCE // (batch * self.size[0] * self.size[1]))

    def strips(self, like: Tensor, count: int) -> list[slice]:
        """Columns of so many half spectra: on a CPU as many at once as stay in its cache."""
        columns = self.size[1] // 2 + 1
        step = max(_LINE, _STRIP // (count * self.size[0])) if like.device.type == "cpu" else columns
        return [slice(start, min(start + step, columns)) for start in range(0, columns, step)]

    def transform(self, planes: Tensor) -> Tensor:
        """Half spectra of planes (..., H, W) with their border."""
        return in_cache(lambda part: self.columns(self.rows(part)), planes)

    def rows(self, planes: Tensor) -> Tensor:
        """Half spectra of the rows of planes (..., H, W) with their border."""
        return in_cache(lambda part: torch.fft.rfft(self._extend(part, dim=-1), n=self.size[1]), planes)

    def columns(self, rows: Tensor, strip: slice = _ALL) -> Tensor:
        """Spectra of a strip of columns. A row of the border repeats one of the picture: it was transformed once."""
        return torch.fft.fft(self._extend(rows[..., strip], dim=-2).mT, n=self.size[0])

    def _extend(self, planes: Tensor, *, dim: int) -> Tensor:
        """The border on both sides. A mirror, a seam or an edge goes on up to the transform's length: no pixel that is
        kept sees so far, and zeros would be one more copy.
        """
        if self.border in ("given", "dark"):
            return planes
        return extend_along(planes, self.window[dim], self.border, dim=dim, length=self.size[dim])

    def rows_adjoint(self, rows: Tensor) -> Tensor:
        """Gradient to planes (..., H, W), from `columns_adjoint`."""
        return in_cache(lambda part: self._fold(torch.fft.irfft(part, n=self.size[1]), dim=-1), rows)

    def columns_adjoint(self, conjugate: Tensor) -> Tensor:
        """What becomes the gradient to planes, from the conjugate of that to spectra times the number of points."""
        return self._fold(torch.fft.ifft(conjugate.conj()).mT, dim=-2)

    def _fold(self, extended: Tensor, *, dim: int) -> Tensor:
        """Transpose of `_extend`, and of the zeros up to the transform's length."""
        n, m = self.picture[dim], self.window[dim]
        before, after = m // 2, (m - 1) // 2
        if self.border == "zero":
            return extended.narrow(dim, before, n)
        if self.border == "dark":
            return extended.narrow(dim, 0, n)
        extended = extended.narrow(dim, 0, n + before + after)
        if self.border == "given":
            return extended
        index = border_index(torch.arange(-before, n + after, device=extended.device), n, self.border)
        shape = list(extended.shape)
        shape[dim] = n
        return extended.new_zeros(shape).index_add_(dim, index, extended)

    def transfer(self, kernels: Tensor) -> Tensor:
        """Conjugate transfer functions of kernels (..., h, w)."""
        return in_cache(lambda part: self.conjugate_columns(self.conjugate_rows(part)), kernels)

    def conjugate_rows(self, planes: Tensor) -> Tensor:
        """Conjugate half spectra of the rows of planes (..., h, w) with nothing around them."""
        # in memory: a lazy conjugate would be copied at every product
        return in_cache(lambda part: torch.fft.rfft(part, n=self.size[1]).conj_physical_(), planes)

    def conjugate_columns(self, rows: Tensor, strip: slice = _ALL) -> Tensor:
        """Conjugate spectra of a strip of columns."""
        return torch.fft.ifft(rows[..., strip].mT, n=self.size[0], norm="forward")

    def back(self, spectrum: Tensor) -> Tensor:
        """The picture of a half spectrum."""
        return in_cache(lambda part: self.seen_rows(self.seen_columns(part)), spectrum)

    def seen_columns(self, spectra: Tensor) -> Tensor:
        """The rows of the result, of a strip of columns; no others go on to the second transform."""
        return self._seen(torch.fft.ifft(spectra), axis=0).mT

    def seen_rows(self, rows: Tensor) -> Tensor:
        """The pixels of the result in each row."""
        return in_cache(lambda part: self._seen(torch.fft.irfft(part, n=self.size[1]), axis=1), rows)

    def _seen(self, cycle: Tensor, *, axis: int) -> Tensor:
        """Pixels of the result along an axis, which comes last, out of a transform."""
        before = self.seen[axis] - self.picture[axis]
        own = cycle[..., : self.picture[axis]]
        return torch.cat([cycle[..., cycle.shape[-1] - before :], own], dim=-1) if before else own

    def unseen(self, light: Tensor) -> Tensor:
        """Transpose of what is seen: its pixels (..., H, W) as they lie in transforms, zeros behind or between them."""
        if self.border != "dark":
            return light
        for dim in (-2, -1):
            before = self.window[dim] - 1
            gap = list(light.shape)
            gap[dim] = self.size[dim] - light.shape[dim]
            first, own = light.split([before, light.shape[dim] - before], dim)
            light = torch.cat([own, light.new_zeros(gap), first], dim)
        return light

    def kernel_columns(self, spectra: Tensor) -> Tensor:
        """The rows of kernels, of a strip of columns."""
        return torch.fft.ifft(spectra)[..., : self.window[0]].mT

    def kernel_rows(self, rows: Tensor) -> Tensor:
        """The pixels of kernels in each row."""
        return in_cache(lambda part: torch.fft.irfft(part, n=self.size[1])[..., : self.window[1]], rows)

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


def in_cache(function: Callable[[Tensor], Tensor], planes: Tensor) -> Tensor:
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
