"""From the pupil to the sensor: the Fourier transforms that hit the pixel grid, and their adjoints.

All compute U(x, y) = sum_jk P(xi_j, eta_k) exp(-i s (x xi_j + y eta_k)) for points x = m * step, m = -K..K, and differ
in cost alone; `CurvedTransform` bends the kernel of any of them. Each is used through `pupil_intensity`, which forms P
from its phase, keeps only U for the backward pass and computes sines and cosines again there (a bank of PSFs would
otherwise hold every pupil in memory).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from kcam.optics.autograd import once_differentiable
from kcam.optics.pixels import Pixels
from kcam.optics.quadrants import by_x, join, parities, split, unfold
from kcam.precision import full_precision

Pair = tuple[Tensor, Tensor]  # real and imaginary part: complex tensors cost twice here, in layout and in polar()


def fast_length(minimum: int) -> int:
    """The smallest length >= `minimum` that FFTs like: no prime factor above 7, a multiple of 32 from 256 up."""
    step = 32 if minimum >= 256 else 2 if minimum > 2 else 1
    steps = max(1, math.ceil(minimum / step))
    odd = [1]  # a power of two is below 2 * steps, so nothing beyond that is shortest
    for factor in (3, 5, 7):
        for known in odd:  # grows meanwhile, by all powers of the factor
            if known * factor < 2 * steps:
                odd.append(known * factor)
    return step * min(known << (math.ceil(steps / known) - 1).bit_length() for known in odd)


class Transform(Protocol):
    """One Fourier transform with its adjoint, in the layout that suits it."""

    def arrange(self, maps: Tensor) -> Tensor:
        """Pupil maps (..., N, N) in this transform's layout."""

    def disarrange(self, maps: Tensor) -> Tensor:
        """The inverse of `arrange`, and its transpose."""

    def arrange_even(self, quadrant: Tensor) -> Tensor:
        """Maps that are even in x and y, given for x, y > 0 (..., N / 2, N / 2); broadcastable to the layout."""

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

    def arrange_even(self, quadrant: Tensor) -> Tensor:
        return quadrant.unsqueeze(-3)

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
class _PlainLayout:
    """Layout of the transforms that work on the whole grid."""

    def arrange(self, maps: Tensor) -> Tensor:
        return maps

    disarrange = arrange_points = arrange

    def arrange_even(self, quadrant: Tensor) -> Tensor:
        return unfold(quadrant)

    def to_pixels(self, intensity: Tensor, pixels: Pixels) -> Tensor:
        return pixels.of_image(intensity)


@dataclass(frozen=True)
class ChirpZTransform(_PlainLayout):
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

        def phasor(angle: Tensor) -> Tensor:
            return torch.complex(angle.cos(), angle.sin())

        complex_dtype = torch.complex128 if like.dtype == torch.float64 else torch.complex64
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
class FFTTransform(_PlainLayout):
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
        angle = 2 * math.pi * m * ((self.count - 1) / 2) / self.length
        phase = torch.complex(angle.cos(), angle.sin()).to(like.dtype)
        return phase[:, None] * phase[None, :]


def mean_slope(tau: float) -> float:
    """What of 1 / q = 1 / sqrt(1 + tau rho^2) is split off as its mean: leaves the least max |rho delta|, rho <= 1.

    Near tau / 8 for small tau, where 1 / q - 1 itself reaches tau / 2.
    """
    return 1 - 0.75 * (1 - 1 / math.sqrt(1 + tau))


@dataclass(frozen=True)
class Curvature:
    """The terms of a curved kernel that all wavelengths on one grid share.

    terms: (p, r, (xi delta)^p (eta delta)^r over the pupil, (x / extent)^p (y / extent)^r over the points), by p + r,
    in the layout of the transform that they go with. extent: from the origin to the edge of the points [m].
    """

    terms: tuple[tuple[int, int, Tensor, Tensor], ...]
    extent: float

    @staticmethod
    def order_for(strength: float, *, tau: float, error: float, corner: float) -> int:
        """The highest power p + r that leaves `error` at the corner of window and pupil.

        strength: scale * extent. corner: largest rho, 1 in a round pupil and sqrt 2 in a square one.
        """
        rho = torch.linspace(0, corner, 33, dtype=torch.float64)
        delta = torch.rsqrt(1 + tau * rho**2) - mean_slope(tau)
        phase = math.sqrt(2) * strength * float((rho * delta).abs().max())
        order, remainder = 0, phase
        while remainder > error:
            order += 1
            remainder *= phase / (order + 1)
        return order

    @staticmethod
    def build(layout: Transform, nodes: Tensor, *, tau: float, step: float, reach: int, order: int, like: Tensor):
        """Terms up to `order` on pupil nodes (N,) and points m * step, |m| <= reach."""
        extent = max(reach, 1) * step
        delta = torch.rsqrt(1 + tau * (nodes[:, None] ** 2 + nodes**2)) - mean_slope(tau)
        along_x, along_y = nodes[None, :] * delta, nodes[:, None] * delta
        points = torch.arange(-reach, reach + 1, dtype=torch.float64) * (step / extent)
        terms = []
        for p, r in ((p, total - p) for total in range(order + 1) for p in range(total + 1)):
            over_pupil = layout.arrange((along_x**p * along_y**r).to(like))
            over_points = layout.arrange_points((points[None, :] ** p * points[:, None] ** r).to(like))
            terms.append((p, r, over_pupil, over_points))
        return Curvature(tuple(terms), extent)


@dataclass(frozen=True)
class CurvedTransform:
    """The kernel beyond the paraxial range, exp(-i s (x xi + y eta) / q), q = sqrt(1 + tau rho^2), in the true plane.

    The inner transform has the mean of 1 / q; the rest, delta, is a phase of a radian or so, and its exponential a
    short series, each term of which is separable:

        sum_pr (-i s x)^p (-i s y)^r / (p! r!) T[(xi delta)^p (eta delta)^r P],  p + r <= order.

    inner: built with scale * mean_slope(tau). strength: scale * extent.
    """

    inner: Transform
    curvature: Curvature
    strength: float
    order: int

    def _terms(self) -> Iterator[tuple[int, float, Tensor, Tensor]]:
        for p, r, over_pupil, over_points in self.curvature.terms:
            if p + r <= self.order:
                weight = self.strength ** (p + r) / (math.factorial(p) * math.factorial(r))
                yield p + r, weight, over_pupil, over_points

    def forward(self, pupil: Pair) -> Pair:
        total = self.inner.forward(pupil)
        for power, weight, over_pupil, over_points in itertools.islice(self._terms(), 1, None):
            part = self.inner.forward((pupil[0] * over_pupil, pupil[1] * over_pupil))
            for sums, values in zip(total, _times_power_of_i(part, -power), strict=True):
                sums.addcmul_(values, over_points, value=weight)
        return total

    def adjoint(self, field: Pair) -> Pair:
        total = self.inner.adjoint(field)
        for power, weight, over_pupil, over_points in itertools.islice(self._terms(), 1, None):
            part = self.inner.adjoint((field[0] * over_points, field[1] * over_points))
            for sums, values in zip(total, _times_power_of_i(part, power), strict=True):
                sums.addcmul_(values, over_pupil, value=weight)
        return total

    def arrange(self, maps: Tensor) -> Tensor:
        return self.inner.arrange(maps)

    def disarrange(self, maps: Tensor) -> Tensor:
        return self.inner.disarrange(maps)

    def arrange_even(self, quadrant: Tensor) -> Tensor:
        return self.inner.arrange_even(quadrant)

    def arrange_points(self, image: Tensor) -> Tensor:
        return self.inner.arrange_points(image)

    def to_pixels(self, intensity: Tensor, pixels: Pixels) -> Tensor:
        return self.inner.to_pixels(intensity, pixels)


def _times_power_of_i(values: Pair, power: int) -> Pair:
    re, im = values
    return ((re, im), (-im, re), (-re, -im), (im, -re))[power % 4]


class _PupilIntensity(torch.autograd.Function):
    """|transform(amplitude * field * exp(i coefficients @ maps))|^2 for each group, nothing kept but U.

    maps, amplitude and field (2, G, ...) are in the transforms' layout, the first two perhaps of even maps.
    """

    @staticmethod
    def forward(ctx, coefficients, maps, amplitude, field, scales, tau, transforms, nodes, points):
        intensities, kept = [], []
        for group, transform in enumerate(transforms):
            cosine, sine = _phasor(coefficients[group], maps)
            pupil = _product((cosine * amplitude, sine * amplitude), None if field is None else field[:, group])
            re, im = transform.forward(pupil)
            intensities.append(re.square().addcmul_(im, im))  # never abs()**2: its gradient is NaN at 0
            kept += [re, im]
        ctx.transforms, ctx.nodes, ctx.points = transforms, nodes, points
        ctx.save_for_backward(coefficients, maps, amplitude, field, scales, tau, *kept)
        return torch.stack(intensities)

    @staticmethod
    @once_differentiable
    def backward(ctx, saved, grad):
        coefficients, maps, amplitude, field, scales, tau, *kept = saved
        need_coefficients, need_maps, need_amplitude, need_field, need_scales, need_tau = ctx.needs_input_grad[:6]
        d_coefficients = torch.empty_like(coefficients)
        d_maps = torch.zeros_like(maps) if need_maps else None
        d_amplitude = torch.zeros_like(amplitude) if need_amplitude else None
        d_field = torch.empty_like(field) if need_field else None
        d_scales = torch.empty_like(scales)
        d_tau = torch.zeros_like(tau)
        q2 = 1 + tau * (ctx.nodes[:, None] ** 2 + ctx.nodes**2).to(tau)
        with full_precision(grad.device):
            for group, transform in enumerate(ctx.transforms):
                re, im = kept[2 * group], kept[2 * group + 1]
                weight = 2 * grad[group]
                d_u = (weight * re, weight * im)
                d_pupil = transform.adjoint(d_u)
                own = None if field is None else field[:, group]
                phasor = _phasor(coefficients[group], maps)
                if need_amplitude:
                    onto = _turned_back(d_pupil, phasor)
                    into = onto[0] if own is None else onto[0] * own[0] + onto[1] * own[1]
                    d_amplitude += into.sum_to_size(d_amplitude.shape)
                weighted = (phasor[0] * amplitude, phasor[1] * amplitude)
                if need_field or need_coefficients or need_maps:
                    onto = _turned_back(d_pupil, weighted)
                    if need_field:
                        for part, values in zip(d_field[:, group], onto, strict=True):
                            torch.sum(values, dim=0, out=part)
                    if need_coefficients or need_maps:  # of the phase: Im(conj(F) dF)
                        d_phase = onto[1] if own is None else onto[1] * own[0] - onto[0] * own[1]
                        flat = d_phase.sum_to_size(phasor[0].shape).flatten(1)
                        d_coefficients[group] = flat @ maps.flatten(1).T
                        if need_maps:
                            d_maps += (coefficients[group].T @ flat).view_as(d_maps)
                if need_scales or need_tau:
                    pupil = _product(weighted, own)
                if need_scales:  # the kernel's exponent is -i s (x xi + y eta) / q
                    d_scales[group] = _kernel_gradient(transform, pupil, d_u, ctx.nodes, ctx.points, q2.rsqrt())
                if need_tau:  # d(1 / q) / d tau = (1 - q^2) / (2 tau q^3)
                    slope = -(ctx.nodes[:, None] ** 2 + ctx.nodes**2).to(tau) / (2 * q2**1.5)
                    d_tau += scales[group] * _kernel_gradient(transform, pupil, d_u, ctx.nodes, ctx.points, slope)
        found = (d_coefficients, d_maps, d_amplitude, d_field, d_scales, d_tau)
        needed = (d if need else None for d, need in zip(found, ctx.needs_input_grad, strict=False))
        return *needed, None, None, None


def _phasor(coefficients: Tensor, maps: Tensor) -> Pair:
    """Real and imaginary part of exp(i coefficients @ maps) for the distances of one group."""
    return sines((coefficients @ maps.flatten(1)).view(coefficients.shape[0], *maps.shape[1:]))


def _product(pupil: Pair, field: Tensor | None) -> Pair:
    """Pupil times field."""
    if field is None:
        return pupil
    (re, im), (own_re, own_im) = pupil, field
    return re * own_re - im * own_im, re * own_im + im * own_re


def _turned_back(values: Pair, phasor: Pair) -> Pair:
    """Values times the conjugate of a phasor."""
    (re, im), (cosine, sine) = values, phasor
    return cosine * re + sine * im, cosine * im - sine * re


def sines(angle: Tensor) -> Pair:
    """Cosine and sine, for the inside of an `autograd.Function`: without a graph.

    Measured: in float32 numpy takes half of torch's time, but one thread; torch.polar costs five times as much.
    """
    if angle.dtype != torch.float32 or angle.device.type != "cpu" or torch.get_num_threads() > 2:
        return angle.cos(), angle.sin()
    values = angle.numpy()
    with np.errstate(invalid="ignore"):  # of an infinite phase: NaN, as torch has it
        return torch.from_numpy(np.cos(values)), torch.from_numpy(np.sin(values))


def _kernel_gradient(
    transform: Transform, pupil: Pair, d_field: Pair, nodes: Tensor, points: Tensor, slope: Tensor
) -> Tensor:
    """d(loss) for d(kernel's exponent) = -i (x xi + y eta) slope: dU = -i (x T[xi slope P] + y T[eta slope P])."""
    total = pupil[0].new_zeros(())
    grid = nodes.to(pupil[0])
    for along_x in (True, False):
        ramp, position = (v[None, :] if along_x else v[:, None] for v in (grid, points.to(grid)))
        ramp = transform.arrange(ramp * slope.to(grid))
        position = transform.arrange_points(position.expand(points.numel(), points.numel()))
        re, im = transform.forward((pupil[0] * ramp, pupil[1] * ramp))
        total = total + ((d_field[0] * im - d_field[1] * re) * position).sum()  # Re(conj(dU) (-i) T)
    return total


def pupil_intensity(
    coefficients: Tensor,
    *,
    maps: Tensor,
    amplitude: Tensor,
    field: Tensor | None,
    scales: Tensor,
    transforms: Sequence[Transform],
    nodes: Tensor,
    points: Tensor,
    tau: Tensor | None = None,
) -> Tensor:
    """Intensity of the transformed pupils amplitude * field * exp(i coefficients @ maps).

    Args:
        coefficients: (G, Z, T) of the phase's maps [rad per unit of the map]; G groups share a kernel.
        maps: (T, N, N), or for x, y > 0 alone where all are even, (T, N / 2, N / 2).
        amplitude: (1 or Z, ...) likewise, quadrature weights included.
        field: real and imaginary part of what does not fit into a phase (a low-passed pixel map), (2, G, ...) in the
            transforms' layout, or None.
        scales: (G,) kernel scales s [1/m], for their gradient. transforms: one for each group, built with that scale.
        nodes: (N,) normalised, in the pupil; points: (2K + 1,) on the sensor [m]; of each axis.
        tau: 0-d, the curvature that `CurvedTransform`s were built with, for its gradient; None: straight kernels.
    Returns:
        (G, Z, ...) in the transforms' layout, for `to_pixels`; differentiable once in all tensors.
    """
    layout = transforms[0]
    maps, amplitude = (
        layout.arrange(m) if m.shape[-1] == nodes.numel() else layout.arrange_even(m) for m in (maps, amplitude)
    )
    with full_precision(coefficients.device):
        curvature = torch.zeros_like(scales[0]) if tau is None else tau.to(scales)
        return _PupilIntensity.apply(coefficients, maps, amplitude, field, scales, curvature, transforms, nodes, points)
