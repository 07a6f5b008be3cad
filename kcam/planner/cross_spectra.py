"""Cross-spectra of planes of light, in rings of frequency."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import scipy
import torch
from torch import Tensor

_FINEST, _FINE, _STEP = 2.0**-10, 2.0**-4, 2.0**-7  # cycles per pixel: rings are 1/8 wide below the second, then even,
_EDGE = 2.0**-6  # and in the corners of the pixels' frequencies
_PART = 32  # frequencies that are summed at once
_AT_ONCE = 2**23  # numbers that are computed together
MANY = 48  # planes, of more of which what cross-spectra are made of is kept instead
_DARK = 1.5  # sides of a picture, with the dark beside it: errors are 0.96 to 1.08 times those with 4 sides (5 to 95 %)


def rings() -> Tensor:
    """Frequencies in the middle of rings, (F,) ascending from 0 [cycles per pixel]."""
    fine = _FINEST * 2 ** (torch.arange(0, 8 * round(math.log2(_FINE / _FINEST)), dtype=torch.float64) / 8)
    even = torch.arange(_FINE, 0.5, _STEP, dtype=torch.float64)
    corners = torch.arange(0.5, math.sqrt(0.5) + _EDGE, _EDGE, dtype=torch.float64)
    return torch.cat([torch.zeros(1, dtype=torch.float64), fine, even, corners])


@dataclass(frozen=True)
class InRings:
    """Spectra of planes (P, K, n), of parts of rings; of light along x, and then along y, or of both at once (`both`).

    into: (P,) the ring of each part, those of light along y behind the F of light along x.
    """

    parts: Tensor
    into: Tensor
    rings: int
    both: bool

    @property
    def many_planes(self) -> bool:
        """Whether cross-spectra of so many planes take longer, and more memory, than what they are made of."""
        return self.parts.shape[1] > MANY

    def crossed(self) -> Tensor:
        """Cross-spectra, (2, F, K, K)."""
        count = self.parts.shape[1]
        sums = torch.zeros(2 * self.rings, count, count, dtype=torch.float64)
        for parts, into in self._few(count**2):
            sums.index_add_(0, into, (parts @ parts.mT).double())
        sums = sums.unflatten(0, (2, -1))
        return (sums[:1] / 2).expand(2, -1, -1, -1) if self.both else sums

    def energy(self, mixed: Tensor) -> Tensor:
        """Of sums of the planes with real factors in each ring, (2, F, R, K): the same as by cross-spectra."""
        sums = mixed.new_zeros(())
        for rings in mixed if self.both else mixed.flatten(0, 1)[None]:
            for parts, into in self._few(rings[0].numel()):
                sums = sums + (rings[into].to(parts) @ parts).square_().sum(dtype=sums.dtype)
        return sums / 2 if self.both else sums

    def _few(self, numbers: int) -> Iterator[tuple[Tensor, Tensor]]:
        """So many parts, and their rings, that what takes so many numbers of each fits into little memory."""
        step = max(1, _AT_ONCE // numbers)
        return zip(self.parts.split(step), self.into.split(step), strict=True)


def cross_spectra(planes: Tensor, frequencies: Tensor, *, dark: bool, turned: bool = False) -> Tensor:
    """Cross-spectra of planes (K, H, W), mirrored at the borders, or in the dark: (2, F, K, K) of light that runs along
    x, and y; turned: along the falling and the rising diagonal.
    """
    return in_rings(planes, frequencies, dark=dark, turned=turned).crossed()


def in_rings(planes: Tensor, frequencies: Tensor, *, dark: bool, turned: bool = False) -> InRings:
    """Spectra of which cross-spectra are made; arguments: as `cross_spectra`."""
    height, width = planes.shape[-2:]
    order, beyond, into = _in_rings(height, width, tuple(frequencies.tolist()), dark=dark, turned=turned)
    if dark:
        sides = padded(height), padded(width)
        found = torch.fft.rfft2(planes.cpu(), s=sides, norm="ortho")
        found[..., 1 : sides[1] // 2] *= math.sqrt(2)  # each stands for one to the left of the middle, too
        spectrum = found.flatten(1).gather(1, order.expand(len(planes), -1))  # index_select takes four times as long
    else:
        found = torch.as_tensor(scipy.fft.dctn(planes.cpu().numpy(), axes=(-2, -1), norm="ortho"))
        spectrum = found.flatten(1).index_select(1, order)
    spectrum = spectrum.index_fill_(1, beyond, 0)
    if dark:
        spectrum = torch.view_as_real(spectrum).flatten(1)
    parts = spectrum.unflatten(1, (len(into), -1)).transpose(0, 1)
    both = turned and not dark  # what is mirrored runs along both diagonals
    return InRings(parts, into, len(frequencies), both=both)


def padded(side: int) -> int:
    """Of a side with the dark beside it: half as much, which little light crosses; even, and as FFTs like it."""
    return 2 * scipy.fft.next_fast_len(math.ceil(_DARK * side / 2))


@functools.lru_cache(maxsize=8)
@torch.inference_mode(False)
def _in_rings(
    height: int, width: int, frequencies: tuple[float, ...], *, dark: bool, turned: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """The order in which a spectrum's frequencies lie in rings, first of light that runs along x, then along y, in
    parts of `_PART`, the last of a ring filled up; which of them fill up; and the ring of each part.
    """
    if dark:
        fy = torch.fft.fftfreq(padded(height), dtype=torch.float64)
        fx = torch.fft.rfftfreq(padded(width), dtype=torch.float64)
    else:
        fy, fx = (torch.arange(n, dtype=torch.float64) / (2 * n) for n in (height, width))
    middles = torch.tensor(frequencies, dtype=torch.float64)
    ring = torch.bucketize(torch.hypot(fy[:, None], fx).flatten(), (middles[1:] + middles[:-1]) / 2)
    second = (fy[:, None] < 0).expand(-1, len(fx)) if turned else fy.abs()[:, None] > fx
    label = ring + len(frequencies) * second.flatten()
    counts = label.bincount(minlength=2 * len(frequencies))  # the widest waves of a small picture are few
    parts = -(-counts // _PART)
    into = torch.arange(len(counts)).repeat_interleave(parts)
    before = (parts.cumsum(0) - parts) * _PART - (counts.cumsum(0) - counts)  # what fills up the rings before
    place = torch.arange(len(label)) + before.repeat_interleave(counts)
    order = torch.zeros(len(into) * _PART, dtype=torch.long).index_copy_(0, place, label.argsort(stable=True))
    return order, torch.ones_like(order).index_fill_(0, place, 0).nonzero()[:, 0], into
