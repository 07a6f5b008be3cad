"""The intensity of a transformed pupil, with its derivative by hand: nothing is kept but the field on the sensor."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcam.optics.autograd import once_differentiable
from kcam.optics.numerics import Pair, sines
from kcam.optics.propagation.transforms import Transform
from kcam.precision import full_precision


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
        maps: of the quadrants of the grid, see `Pupil.mirrored`: (T, 4, N / 2, N / 2), or (T, N / 2, N / 2) where all
            are even. amplitude: even (1 or Z, N / 2, N / 2), quadrature weights included.
        field: real and imaginary part of what does not fit into a phase (a low-passed pixel map), (2, G, ...) in the
            transforms' layout, or None.
        scales: (G,) kernel scales s [1/m], for their gradient. transforms: one for each group, built with that scale.
        nodes: (N,) normalised, in the pupil; points: (2K + 1,) on the sensor [m]; of each axis.
        tau: 0-d, the curvature that `CurvedTransform`s were built with, for its gradient; None: straight kernels.
    Returns:
        (G, Z, ...) in the transforms' layout, for `to_pixels`; differentiable once in all tensors.
    """
    layout = transforms[0]
    maps = layout.arrange_quadrants(maps if maps.ndim == 4 else maps.unsqueeze(1))
    amplitude = layout.arrange_quadrants(amplitude.unsqueeze(1))
    with full_precision(coefficients.device):
        curvature = torch.zeros_like(scales[0]) if tau is None else tau.to(scales)
        return _PupilIntensity.apply(coefficients, maps, amplitude, field, scales, curvature, transforms, nodes, points)
