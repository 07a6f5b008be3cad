"""PSFs of rotationally symmetric pupils: Gauss-Legendre in radius from rim to rim, so that no edge is cut."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from kcam.cache import ValueCache
from kcam.optics.numerics import BesselJ0, lagrange
from kcam.optics.propagation import sampling
from kcam.optics.propagation.estimates import paraxial_error, trace
from kcam.optics.propagation.question import Query, radial_phase, residual_path
from kcam.optics.propagation.rings import fewer_nodes, panel_nodes, panel_orders
from kcam.optics.propagation.row import Propagator, Rate
from kcam.optics.pupil.coordinates import Pupil, from_image_side, to_image_side
from kcam.optics.pupil.rim import kaiser_sinc

_SUMMED = math.pi / 2  # step of t at which the pupil is summed up: a disc of radius 1 has no frequency above 1
_LIGHT_FINER = 12  # as finely |U|^2 is tabulated; eight-point interpolation is then good to 2e-8
_EVEN_FINER = 2  # as finely in the sum over the light: half of the largest step that tells its frequencies
_SINC_TAPS, _SINC_BETA = 12, 18.0  # on either side, and Kaiser's window: the steps between are then good to 4e-9
_REFINED_AT_ONCE = 16
_MOST_RINGS = 2**20
_RINGS_AT_ONCE = 2**24  # entries of the Hankel table: 128 MB
KEPT = 2**22
"""Entries of a table of J0 that is kept: 34 MB."""
_KERNELS = ValueCache(8)  # the last tables
_EVEN = 128  # steps by which tables grow, so that a lens that is focused anew finds its own
_FEWEST = 256  # frequencies in a table of transfer functions
_BEYOND_RAYS = 80.0  # times what the rim diffracts beyond all, for transfer functions
_TAIL = 64  # rings of what it diffracts farther
_AT_RIM = 1e-6  # of a radius, from its rim to where the slope there is told
_CUBIC, _EIGHT = range(-1, 3), range(-3, 5)  # points on both sides of a value between them
_NEAR_0 = (0.0947421, -0.0124339, 0.0010251)
"""Of f(t) t at 0, h and 2 h, beside the trapezium rule's weights: what Euler and Maclaurin add to it, to h^8."""
LOOKUPS = Rate("radial", 1e-10)
"""Of operations of which most look numbers up."""


def radial_psf(query: Query) -> Tensor:
    """PSFs of a rotationally symmetric pupil by one Hankel transform, U(t) = 2 pi INT A exp(ikW) J0(t rho) rho d rho.

    Gauss-Legendre nodes from rim to rim, so that the edge is exact; J0 is tabulated over t = k a' r / d, in which all
    wavelengths and distances share one table, and |U|^2 is interpolated onto the pixels' radii by eight points.
    """
    wavelengths = query.wavelengths.to(query.device)
    a, d = query.image_side_semi_aperture, query.sensor_distance
    scales = 2 * math.pi / wavelengths * a / d
    farthest = max(math.hypot(*reaches) / n for n, reaches in (_reaches(query, w) for w in query.wavelengths.tolist()))
    light, energy = _light(query, scales, farthest * query.pixel_pitch, finer=_LIGHT_FINER)
    light = torch.cat([light[..., 1 : -_EIGHT.start + 1].flip(-1), light], dim=-1).to(query.dtype)
    bands = []
    for index, wavelength in enumerate(query.wavelengths.tolist()):
        arguments = (light[index], scales[index], query, wavelength)
        image = (
            checkpoint(_ring_image, *arguments, use_reentrant=False) if light.requires_grad else _ring_image(*arguments)
        )
        factor = (a * query.pixel_pitch / (wavelengths[index] * d)) ** 2 / energy
        bands.append(image * factor[:, None, None].to(query.dtype))
    return torch.stack(bands, dim=1)


def _light(query: Query, scales: Tensor, reach: float, *, finer: int) -> tuple[Tensor, Tensor]:
    """|U|^2 at t = 0, `_SUMMED` / finer, ... as far as a reach [m], (L, Z, T); the energy that passes, (1 or Z,).

    Args: scales: (L,) t per metre on the sensor.
    """
    wavelengths = query.wavelengths.to(query.device)
    largest = float(scales.detach().max()) * reach
    rho, weights = ring_nodes(query, largest)
    x, y = from_image_side(rho, torch.zeros_like(rho), query.tau)
    pupil = query.pupil(x, y)
    coefficients, maps = residual_path(query, pupil)
    phase = 2 * math.pi / wavelengths[:, None, None] * (coefficients @ maps)  # (L, Z, n)
    amplitude, energy = ring_amplitude(query, pupil, rho * weights)
    field = torch.stack([phase.cos(), phase.sin()]) * amplitude  # (2, L, Z, n)
    field, rho = fewer_nodes(field, rho, frequency=largest)
    steps = math.ceil(largest * finer / _SUMMED) + len(_EIGHT)
    length = max(1, finer * _RINGS_AT_ONCE // steps)
    parts = list(zip(*(part.split(length, dim=-1) for part in (field, rho)), strict=True))
    if len(parts) == 1:
        return hankel(field, steps, rho, finer=finer).square().sum(0), energy
    # the table of each part is built again in the backward pass, not kept
    transformed = [checkpoint(hankel, f, steps, r, finer=finer, use_reentrant=False) for f, r in parts]
    return torch.stack(transformed).sum(0).square().sum(0), energy


@dataclass(frozen=True)
class RadialTransfer:
    """Transfer functions of a rotationally symmetric pupil, of light on pixels, without a picture of its PSF.

    H(f) = 1 / (2 pi E) INT |U(t)|^2 J0(kappa t) t dt,   kappa = f lambda d / a

    of what falls into a window in the mean over directions, times that of a pixel, folded at the pixels' frequency.
    Well beyond its rays light is diffracted at the rims alone, half of it towards the axis: outside a radius r falls
    T r / (r^2 - b^2), of which `Lens.window` tells T, around where the rays at a rim fall, b.

    Args:      light: |U|^2 t dt / (2 pi E) at even t, (L, Z, T), with Euler and Maclaurin's corrections near 0.
               kernel: J0(kappa t) at even kappa up to 2, (T, K).
               step: of t [pixels], (L,). kappa: entries of the kernel for each cycle per pixel, (L,).
               rims: of each rim T, (R, L, 1), and b, (R, L, Z) [pixels].
               active: width of the light-sensitive part of a pixel; 0 where no pixel is integrated over.
               whole: scaled to what whole pixels receive together, see `sampling.of_whole_pixels`.
    """

    light: Tensor
    kernel: Tensor
    step: Tensor
    kappa: Tensor
    rims: tuple[Tensor, Tensor]
    active: float
    whole: bool

    def __call__(self, frequencies: Tensor, shape: tuple[int, int], bands: Sequence[int]) -> Tensor:
        """As `Transfer`: float64, the same along x and y."""
        frequencies, chosen = frequencies.to(self.light.device), torch.as_tensor(bands, device=self.light.device)
        step, kappa = self.step[chosen], self.kappa[chosen]
        end = min(self.light.shape[-1], math.ceil(math.hypot(*shape) / 2 / float(step.detach().min())) + 1)
        inside = _share_inside(shape, torch.arange(end, device=step.device) * step[:, None])
        table = ((self.light[chosen, :, :end] * inside[:, None].float()) @ self.kernel[:end]).double()  # (L, Z, K)
        cutoff = (self.kernel.shape[-1] - 1) / float(kappa.detach().min())
        index, asked, weights = sampling.folded(frequencies, cutoff, self.active)
        place = (kappa[:, None] * asked.abs()).clamp(max=table.shape[-1] - 1)  # beyond 2 there is nothing
        value = even_between(table, place) * weights
        found = value.new_zeros(*value.shape[:-1], len(frequencies)).index_add(-1, index, value)
        beyond = self._beyond(frequencies, shape, chosen).expand_as(found)
        found = found + beyond
        if self.whole:
            found = sampling.of_whole_pixels(found, value[..., (index == 0) & (asked == 0)] + beyond[..., :1])
        return found.transpose(0, 1)[:, :, None].expand(-1, -1, 2, -1)

    def _beyond(self, frequencies: Tensor, shape: tuple[int, int], chosen: Tensor) -> Tensor:
        """Of the light in a window beyond the table, INT share(r) J0(2 pi f r) (-dP / dr) dr of P = sum of
        T r / (r^2 - b^2), (L, Z, F).
        """
        reach = (self.light.shape[-1] - 0.5) * self.step[chosen, None, None]  # the last step goes half as far again
        much, around = (part[:, chosen, :, None] for part in self.rims)
        nearest, rim, corner = float(reach.detach().min()), float(around.detach().max()), math.hypot(*shape) / 2
        if corner <= max(nearest, rim):
            return torch.zeros((), dtype=torch.float64, device=reach.device)
        # even steps of 1 / (r - b), of which each wavelength takes those beyond its own reach
        ends = 1 / (corner - rim), 1 / (nearest - rim)
        steps = torch.linspace(*ends, _TAIL + 1, dtype=torch.float64, device=reach.device)
        edges, radius = rim + 1 / steps, rim + 2 / (steps[1:] + steps[:-1])
        outside = edges.clamp(min=reach)  # (L, 1, R)
        width = (much * outside / (outside**2 - around**2)).sum(0).diff()
        rings = BesselJ0.apply(2 * math.pi * frequencies[:, None] * radius)
        return (width * _share_inside(shape, radius)) @ rings.T


def radial_transfer(query: Query) -> RadialTransfer:
    """The transfer functions of a query: one Hankel transform of its pupil, and another of the light on the sensor."""
    wavelengths, pitch = query.wavelengths.to(query.device), query.pixel_pitch
    a, d = query.image_side_semi_aperture, query.sensor_distance
    scales = 2 * math.pi / wavelengths * a / d
    rim = wavelengths * d / (2 * math.pi**2) * query.lens.rim_per_area()
    corner, rims = math.hypot(*query.half_sides) * query.pixel_pitch, _rims(query, rim / pitch)
    rays = max(float(query.displacement.max()), float(rims[1].detach().max()) * pitch)
    reach = min(corner, rays + float(_BEYOND_RAYS * rim.detach().max()))
    intensity, energy = _light(query, scales, reach, finer=_EVEN_FINER)
    step = _SUMMED / _EVEN_FINER
    t = torch.arange(intensity.shape[-1], dtype=torch.float64, device=query.device) * step
    weights = t * step
    weights[: len(_NEAR_0)] += step**2 * torch.tensor(_NEAR_0, dtype=torch.float64, device=query.device)
    light = intensity * weights
    count = max(_FEWEST, _EVEN * math.ceil(len(t) / _EVEN))  # as many as there are t: two for each fringe
    return RadialTransfer(
        light=(light / (2 * math.pi * energy[:, None])).float(),
        kernel=_even_kernel(count, step=step * 2 / (count - 1), device=query.device)[: len(t)],
        step=step / (scales * pitch),
        kappa=wavelengths * d / (a * pitch) * ((count - 1) / 2),
        rims=rims,
        active=query.grid.active if query.grid.integrate else 0.0,
        whole=query.has_gaps,
    )


def _rims(query: Query, diffracted: Tensor) -> tuple[Tensor, Tensor]:
    """What each rim of the aperture diffracts, (R, L, 1), of so much (L,), and how far its rays fall, (R, L, Z), in
    pixels.
    """
    radii, weights = diffracted.new_tensor(query.lens.aperture.discs()).T
    rho = radii[:, None] * (1 - _AT_RIM * torch.arange(2).to(radii) * weights.sign()[:, None])  # on the open side
    coefficients, maps = residual_path(query, query.pupil(rho, torch.zeros_like(rho)))
    slopes = (coefficients @ (maps.diff() / to_image_side(rho, query.tau).diff())[..., 0]).abs().permute(2, 0, 1)
    fallen = slopes * (query.sensor_distance / (query.image_side_semi_aperture * query.pixel_pitch))
    return (radii / radii.sum())[:, None, None] * diffracted[:, None], fallen


def _share_inside(shape: tuple[int, int], radius: Tensor) -> Tensor:
    """How much of each circle about its middle lies in a window [pixels]."""
    halves = torch.tensor(shape, dtype=torch.float64, device=radius.device) / 2
    outside = torch.acos((halves / radius.clamp(min=1e-9)[..., None]).clamp(max=1)).sum(-1)
    return (1 - 2 / math.pi * outside).clamp(min=0)


def even_between(values: Tensor, position: Tensor) -> Tensor:
    """An even function that is known at 0, 1, ..., (..., Z, T), at positions (..., R): (..., Z, R), by cubics."""
    low = position.detach().floor().long().clamp(max=values.shape[-1] - _CUBIC.stop)
    found = torch.zeros(())
    for tap, weight in zip(_CUBIC, lagrange(position - low, taps=_CUBIC), strict=True):
        index = (low + tap).abs().unsqueeze(-2).expand(*values.shape[:-1], -1)
        found = found + weight.unsqueeze(-2) * values.gather(-1, index)
    return found


def hankel_kernel(rho: Tensor, steps: int, *, step: float) -> Tensor:
    """J0(t rho) at t = 0, step, ..., (n, steps): what a field over rings (..., n) is multiplied with.

    A table that is not large is kept for others with the same rings: most of the time of one PSF goes into it.
    """

    def build(count: int) -> Tensor:
        t = torch.arange(count, dtype=torch.float64, device=rho.device) * step
        return BesselJ0.apply(rho[:, None] * t)

    count = _EVEN * math.ceil(steps / _EVEN)
    if rho.numel() * count > KEPT:
        return build(steps)
    return _KERNELS.get((rho, count, step), lambda: build(count))[:, :steps]


def _even_kernel(count: int, *, step: float, device: torch.device) -> Tensor:
    """J0(i j step), (count, count) in float32, of which half is computed: `hankel_kernel` of even radii."""

    def build() -> Tensor:
        table = torch.empty(count, count, dtype=torch.float32, device=device)
        numbers = torch.arange(count, dtype=torch.float64, device=device)
        for first in range(0, count, _EVEN):
            rows = slice(first, first + _EVEN)
            table[rows, first:] = BesselJ0.apply(numbers[rows, None] * numbers[first:] * step).float()
            table[first:, rows] = table[rows, first:].T
        return table

    return build() if count**2 > 2 * KEPT else _KERNELS.get((count, step, device), build)  # half the bytes


def hankel(field: Tensor, steps: int, rho: Tensor, *, finer: int) -> Tensor:
    """2 pi sum_n field_n J0(t rho_n) of a field over rings (..., n) at t = 0, `_SUMMED` / finer, ..., (..., steps)."""
    coarse = math.ceil(steps / finer) + _SINC_TAPS
    return _refined(2 * math.pi * field @ hankel_kernel(rho, coarse, step=_SUMMED), finer)[..., :steps]


def _refined(values: Tensor, finer: int) -> Tensor:
    """An even function without frequencies above pi / 2 that is known at 0, 1, ... (..., C), so many times as finely,
    but for the last `_SINC_TAPS`.
    """
    mirrored = torch.cat([values[..., 1:_SINC_TAPS].flip(-1), values], dim=-1)
    weights = _sinc_weights(finer).to(values.device)
    missing = -(mirrored.shape[-1] - 2 * _SINC_TAPS + 1) % _REFINED_AT_ONCE
    blocks = torch.nn.functional.pad(mirrored, (0, missing)).unfold(-1, len(weights), _REFINED_AT_ONCE)
    return (blocks @ weights).flatten(-2)


@functools.cache
@torch.inference_mode(False)
def _sinc_weights(finer: int) -> Tensor:
    """What each of so many neighbours gives to `_REFINED_AT_ONCE` steps and those between them."""
    between = np.arange(_REFINED_AT_ONCE * finer) / finer
    off = between - np.arange(1 - _SINC_TAPS, _REFINED_AT_ONCE + _SINC_TAPS)[:, None]
    return torch.as_tensor(kaiser_sinc(off, half_width=_SINC_TAPS, beta=_SINC_BETA))


def ring_nodes(query: Query, frequency: float, *, density: float = 1.0) -> tuple[Tensor, Tensor]:
    """Gauss-Legendre nodes and weights over the open part of the radius, image-side coordinates.

    Args: frequency: of the kernel, in radians per image-side semi-aperture; density: of the nodes, relative to what
    converges to 1e-9.
    """
    discs = query.lens.aperture.discs()
    inner = discs[1][0] if len(discs) > 1 else 0.0
    edges = query.panels
    edges = torch.cat([edges.new_full((1,), inner), edges[edges > inner]])
    orders = panel_orders(edges, radial_phase(query), frequency=frequency, density=density)
    if float(orders.sum()) > _MOST_RINGS:
        raise ValueError(
            f"this PSF needs {float(orders.sum()):.3g} rings of the pupil, more than {_MOST_RINGS}: rays at the rim of "
            "the lens are sent too far beyond the window. Use a smaller aperture or a larger radius of curvature."
        )
    # edges move with tau, for a step there moves light; 0 and 1 do not, and nodes without a gradient cost less
    tau = query.tau if edges.numel() > 2 or inner > 0 else query.tau.detach()
    return panel_nodes(to_image_side(edges, tau), orders)


def ring_amplitude(query: Query, pupil: Pupil, quadrature: Tensor) -> tuple[Tensor, Tensor]:
    """Amplitude times quadrature (1 or Z, n), and the energy that passes in units of a'^2, (1 or Z,)."""
    amplitude = energy = quadrature[None]
    if not query.paraxial:
        falloff = 1 / (1 + query.vergences[:, None] ** 2 * pupil.rho2 * query.semi_aperture**2)
        amplitude = quadrature * pupil.measure * torch.sqrt(falloff)
        energy = quadrature * pupil.measure**2 * falloff
    return amplitude, 2 * math.pi * energy.sum(-1)


def _ring_image(light: Tensor, scale: Tensor, query: Query, wavelength: float) -> Tensor:
    """Intensity on the pixels from that of one wavelength at even t from `_EIGHT.start` steps before 0 on, (Z, T)."""
    per_pixel, reaches = _reaches(query, wavelength)
    radii2, inverse = _lattice(*reaches, query.device)
    position = scale * torch.sqrt(radii2) * (query.pixel_pitch * _LIGHT_FINER / (per_pixel * _SUMMED))
    low = position.detach().long()
    weights = torch.stack(lagrange((position - low).to(query.dtype), taps=_EIGHT))
    # eight neighbours lie side by side: one look for all, and a distance at a time fits the processor's memory
    found = [(row.unfold(-1, len(_EIGHT), 1)[low].mT * weights).sum(0) for row in light]
    intensity = torch.stack(found).clamp(min=0)  # (Z, radii); in dark rings eight points may leave less than nothing
    return query.pixels(per_pixel).of_quadrant(intensity[:, inverse].unflatten(-1, [reach + 1 for reach in reaches]))


def _reaches(query: Query, wavelength: float) -> tuple[float, list[int]]:
    """(points per pixel, points from the origin to the edges of the window along y, and x)."""
    per_pixel, _ = query.evaluation_grid(wavelength)
    return per_pixel, [math.ceil(per_pixel * half) for half in query.half_sides]


@functools.lru_cache(maxsize=8)
@torch.inference_mode(False)
def _lattice(rows: int, columns: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Distinct squared radii of the grid points in one quadrant, and where each point finds its own."""
    y, x = (torch.arange(reach + 1, device=device) ** 2 for reach in (rows, columns))
    squares = (y[:, None] + x).flatten()
    there = torch.zeros(int(squares[-1]) + 1, dtype=torch.bool, device=device)
    there[squares] = True
    return there.nonzero()[:, 0].to(torch.float64), (there.cumsum(0) - 1)[squares]


def _error(query: Query) -> float:
    """Interpolation in the Hankel table, 2e-7 measured, and the model."""
    return min(2.0, 3e-7 + max(paraxial_error(rays, query) for rays in trace(query)))


def lookup_cost(query: Query) -> float:
    """Operations of 40 for each point at which the intensity is evaluated, and for its weights."""
    points = (math.prod(2 * reach + 1 for reach in _reaches(query, w)[1]) for w in query.wavelengths.tolist())
    return (query.vergences.numel() + 1) * 40.0 * sum(points)


def _needs_symmetry(query: Query) -> str | None:
    if query.symmetric:
        return None
    names = sorted({type(element).__name__ for element in query.lens.elements if not element.symmetric})
    return f"needs a lens of rotationally symmetric elements, but has {', '.join(names)}; use method='matrix'."


RADIAL = Propagator(
    "nonparaxial",
    "radial",
    function=radial_psf,
    error=_error,
    cost=lookup_cost,
    rate=LOOKUPS,
    valid=_needs_symmetry,
    transfer=radial_transfer,
    about="one Hankel transform",
)
