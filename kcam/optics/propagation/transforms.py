"""From the pupil to the sensor: the Fourier transforms that hit the pixel grid, and their adjoints.

All compute U(x, y) = sum_jk P(xi_j, eta_k) exp(-i s (x xi_j + y eta_k)) for points x = m * step, m = -K..K, and differ
in cost alone; `CurvedTransform` bends the kernel of any of them. Each is used through `pupil_intensity`, which forms P
from its phase, keeps only U for the backward pass and computes sines and cosines again there (a bank of PSFs would
otherwise hold every pupil in memory).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from kcam.optics.numerics import Pair, fast_length, phasor
from kcam.optics.propagation.pixels import Pixels
from kcam.optics.pupil.quadrants import by_x, join, parities, split


class Transform(Protocol):
    """One Fourier transform with its adjoint, in the layout that suits it."""

    def arrange(self, maps: Tensor) -> Tensor:
        """Pupil maps (..., N, N) in this transform's layout."""

    def disarrange(self, maps: Tensor) -> Tensor:
        """The inverse of `arrange`, and its transpose."""

    def arrange_quadrants(self, maps: Tensor) -> Tensor:
        """The same of their quadrants (..., 4 or 1, N / 2, N / 2), broadcastable: of one, where all are alike."""

    def forward(self, pupil: Pair) -> Pair:
        """Field on the points, up to a phase that |U|^2 does not see."""

    def adjoint(self, field: Pair) -> Pair:
        """Conjugate transpose of `forward`."""

    def arrange_points(self, image: Tensor) -> Tensor:
        """An image (2K+1, 2K+1) of values at the points, in the layout of the field."""

    def to_pixels(self, intensity: Tensor, pixels: Pixels) -> Tensor:
        """An intensity in the layout of the field on pixels."""


@dataclass(frozen=True)
class MatrixTransform:
    """Split matrix triple product: even and odd parts on both axes, so that real matrices of half the size do.

    2 M N (N + M) real operations; any points that are symmetric about 0. Layout: quadrants ++, +-, -+, -- (sign of y,
    x), each ordered away from the axis.
    Source: Soummer et al., Opt. Express 15, 15935 (2007), for the matrix form; the split is exact algebra.
    """

    cosine_sine: Tensor  # (2, n, K + 1)

    @staticmethod
    def build(nodes: Tensor, *, scale: float, step: float, reach: int, like: Tensor) -> MatrixTransform:
        """Matrices for pupil nodes (N,) symmetric about 0, kernel scale s [1/m] and points m * step, |m| <= reach."""
        positive = nodes[nodes.numel() // 2 :]
        angle = scale * step * positive[:, None] * torch.arange(reach + 1, dtype=torch.float64)
        return MatrixTransform(torch.stack([angle.cos(), angle.sin()]).to(like))

    def arrange(self, maps: Tensor) -> Tensor:
        return split(maps)

    def disarrange(self, maps: Tensor) -> Tensor:
        return join(maps, odd=False)

    def arrange_quadrants(self, maps: Tensor) -> Tensor:
        return maps

    def forward(self, pupil: Pair) -> Pair:
        batch, _, n, _ = pupil[0].shape
        k = self.cosine_sine.shape[-1]
        folded = pupil[0].new_empty(2, 2, 2, batch, n, n)  # parity in x, parity in y, re/im, batch, v, u
        for part, values in enumerate(pupil):
            parities(by_x(values.expand(-1, 4, -1, -1)), out=folded[:, :, part].flatten(0, 1).unbind())
        along_x = torch.bmm(folded.view(2, 4 * batch * n, n), self.cosine_sine)
        by_v = along_x.view(2, 2, 2 * batch, n, k).permute(1, 3, 0, 2, 4).reshape(2, n, 4 * batch * k)
        parts = torch.bmm(self.cosine_sine.mT, by_v).view(2, k, 2, 2, batch, k)
        re, im = (pupil[0].new_empty(batch, 4, k, k) for _ in range(2))
        # U(+-y, +-x) = ee -+ i eo -+ i oe -+ oo: the odd parts carry -i for each of their axes
        (ee_re, ee_im), (eo_re, eo_im) = parts[0].permute(1, 2, 3, 0, 4)  # even in y; by parity in x, re/im
        (oe_re, oe_im), (oo_re, oo_im) = parts[1].permute(1, 2, 3, 0, 4)
        _join_parts((ee_re, eo_im, oe_im, oo_re), out=re.unbind(1))
        _join_parts((ee_im, eo_re, oe_re, oo_im), out=im.unbind(1)[::-1])  # -i turns their signs
        return re, im

    def adjoint(self, field: Pair) -> Pair:
        batch, _, k, _ = field[0].shape
        n = self.cosine_sine.shape[1]
        parts = field[0].new_empty(2, k, 2, 2, batch, k)
        (ee_re, ee_im), (eo_re, eo_im) = parts[0].permute(1, 2, 3, 0, 4)
        (oe_re, oe_im), (oo_re, oo_im) = parts[1].permute(1, 2, 3, 0, 4)
        _part(field[0].unbind(1), out=(ee_re, eo_im, oe_im, oo_re))
        _part(field[1].unbind(1)[::-1], out=(ee_im, eo_re, oe_re, oo_im))
        by_v = torch.bmm(self.cosine_sine, parts.view(2, k, 4 * batch * k))
        along_x = by_v.view(2, n, 2, 2 * batch, k).permute(2, 0, 3, 1, 4).reshape(2, 4 * batch * n, k)
        folded = torch.bmm(along_x, self.cosine_sine.mT).view(2, 2, 2, batch, n, n)
        pupil = tuple(field[0].new_empty(batch, 4, n, n) for _ in range(2))
        for part, values in enumerate(pupil):
            parities(folded[:, :, part].flatten(0, 1).unbind(), out=by_x(values))
        return pupil[0], pupil[1]

    def arrange_points(self, image: Tensor) -> Tensor:
        return split(image)

    def to_pixels(self, intensity: Tensor, pixels: Pixels) -> Tensor:
        return pixels.of_quadrants(intensity)


def _join_parts(parts: Sequence[Tensor], out: Sequence[Tensor]) -> None:
    """even - odd + (odd_x + odd_y) and so on for each quadrant, from (even, odd_x, odd_y, odd in both)."""
    even, odd_x, odd_y, odd = parts
    agree, differ = even - odd, even + odd
    total, cross = odd_x + odd_y, odd_y - odd_x
    torch.add(agree, total, out=out[0])
    torch.add(differ, cross, out=out[1])
    torch.sub(differ, cross, out=out[2])
    torch.sub(agree, total, out=out[3])


def _part(quadrants: Sequence[Tensor], out: Sequence[Tensor]) -> None:
    """The transpose of `_join_parts`."""
    pp, pm, mp, mm = quadrants
    agree, differ = pp + mm, pm + mp
    total, cross = pp - mm, pm - mp
    torch.add(agree, differ, out=out[0])
    torch.sub(total, cross, out=out[1])
    torch.add(total, cross, out=out[2])
    torch.sub(differ, agree, out=out[3])


@dataclass(frozen=True)
class PlainLayout:
    """Layout of the transforms that work on the whole grid."""

    def arrange(self, maps: Tensor) -> Tensor:
        return maps

    disarrange = arrange_points = arrange

    def arrange_quadrants(self, maps: Tensor) -> Tensor:
        return join(maps.expand(*maps.shape[:-3], 4, -1, -1), odd=False)

    def to_pixels(self, intensity: Tensor, pixels: Pixels) -> Tensor:
        return pixels.of_image(intensity)


@dataclass(frozen=True)
class ChirpZTransform(PlainLayout):
    """Bluestein's chirp-z transform on both axes: exact like the matrix form, O(L^2 log L).

    m j = (m^2 + j^2 - (m - j)^2) / 2 turns the sum into a convolution of length L >= N + M - 1.
    Source: Bluestein 1970; Hu et al., Light Sci. Appl. 9, 119 (2020).
    """

    before: Tensor  # (N,) chirp on the samples
    spectrum: Tensor  # (L,) transform of the convolving chirp
    after: Tensor  # (M,)

    @staticmethod
    def build(nodes: Tensor, *, scale: float, step: float, reach: int, like: Tensor) -> ChirpZTransform:
        """Chirps for equally spaced nodes, built in float64 (their arguments reach thousands of radians)."""
        count, points = nodes.numel(), 2 * reach + 1
        alpha = scale * step * float(nodes[1] - nodes[0])
        j, m = torch.arange(count, dtype=torch.float64), torch.arange(points, dtype=torch.float64)
        length = fast_length(count + points - 1)
        lag = torch.arange(length, dtype=torch.float64)
        lag = torch.where(lag < points, lag, lag - length)  # lags -(N-1)..M-1, wrapped
        centre = (count - 1) / 2

        complex_dtype = like.dtype.to_complex()
        return ChirpZTransform(
            before=phasor(-alpha * (j**2 / 2 - reach * j)).to(like.device, complex_dtype),
            spectrum=torch.fft.fft(phasor(alpha * lag**2 / 2)).to(like.device, complex_dtype),
            after=phasor(-alpha * (m**2 / 2 - centre * m)).to(like.device, complex_dtype),
        )

    def forward(self, pupil: Pair) -> Pair:
        field = torch.complex(*pupil)
        for _ in range(2):  # along x, then (transposed) along y
            spectrum = torch.fft.fft(field * self.before, n=self.spectrum.numel()) * self.spectrum
            field = (torch.fft.ifft(spectrum)[..., : self.after.numel()] * self.after).mT
        return field.real, field.imag

    def adjoint(self, field: Pair) -> Pair:
        values = torch.complex(*field)
        for _ in range(2):
            values = values.mT * self.after.conj()
            spectrum = torch.fft.fft(values, n=self.spectrum.numel()) * self.spectrum.conj()
            values = torch.fft.ifft(spectrum)[..., : self.before.numel()] * self.before.conj()
        return values.real, values.imag


@dataclass(frozen=True)
class FFTTransform(PlainLayout):
    """One padded FFT, as equation (3.4) has it, on a pupil grid scaled so that its bins fall exactly on the points.

    Valid for nodes with scale * step * spacing = 2 pi / length.
    """

    count: int
    length: int
    reach: int

    def forward(self, pupil: Pair) -> Pair:
        spectrum = torch.fft.fft2(torch.complex(*pupil), s=(self.length, self.length))
        bins = torch.arange(-self.reach, self.reach + 1, device=spectrum.device) % self.length
        # the grid's origin is at (N - 1) / 2, the FFT's at 0: a pure phase on U, but the adjoint must know it too
        field = spectrum[..., bins, :][..., bins] * self._shift(spectrum)
        return field.real, field.imag

    def adjoint(self, field: Pair) -> Pair:
        values = torch.complex(*field)
        values = values * self._shift(values).conj()
        bins = torch.arange(-self.reach, self.reach + 1, device=values.device) % self.length
        spectrum = values.new_zeros(*values.shape[:-2], self.length, self.length)
        spectrum[..., bins[:, None], bins[None]] = values
        pupil = torch.fft.ifft2(spectrum, norm="forward")[..., : self.count, : self.count]
        return pupil.real, pupil.imag

    def _shift(self, like: Tensor) -> Tensor:
        m = torch.arange(-self.reach, self.reach + 1, device=like.device, dtype=torch.float64)
        phase = phasor(2 * math.pi * m * ((self.count - 1) / 2) / self.length).to(like.dtype)
        return phase[:, None] * phase[None, :]
