"""The sum over bands inside the Fourier transform, strip by strip, with its derivative by hand."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch
from torch import Tensor

from kcam.compiled import uncompiled
from kcam.optics.autograd import once_differentiable
from kcam.optics.rendering.convolution import Convolution
from kcam.precision import full_precision


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
        parts = convolution.parts(len(psfs), len(planes))
        spectra_of_all = planes.shape[:2].numel() * (1 if spectra is None else len(parts))
        hold = any(ctx.needs_input_grad[1:4]) and spectra_of_all <= convolution.held
        held = []
        result = convolution.room(planes, len(planes), len(weights), convolution.seen[0])
        for part in parts:
            bands = _Bands(convolution, part, planes, psfs, spectra, kept)
            for strip in bands.strips():
                transfers = bands.transfers(strip)
                for b, total in enumerate(result):
                    own = bands.columns(b, strip)
                    held += [own] if hold else []
                    mixed = _mixed(weights[:, part], bands.light(own) * transfers)
                    _put(total[..., strip], convolution.seen_columns(mixed), add=part.start > 0)
        ctx.save_for_backward(planes, psfs, spectra, weights, kept, *held)
        ctx.convolution = convolution
        picture = convolution.seen_rows(result)
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
            onto_rows = convolution.conjugate_rows(convolution.unseen(grad))
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
                        d_psf_rows[..., strip] = convolution.kernel_columns(d_transfers)
                if d_psfs is not None:
                    d_psfs[part] = convolution.kernel_rows(d_psf_rows)
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
