"""Point spread functions: from the elements of a lens to the energy in each pixel.

    h(x, y) = |U|^2,  U(x) = 1 / (lambda d sqrt(E)) INT A exp(i k W) exp(-i k x.u' / d) d^2 u'

W is the *residual* optical path: source, lens and propagation are each thousands of radians and cancel in focus, so
their vergences are summed as float64 scalars first. E is the energy that passes the aperture: a PSF sums to the share
of that light which falls into its window, and is not normalised to 1.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from kcam.cache import differentiated
from kcam.optics import sampling
from kcam.optics.cells import Cells
from kcam.optics.pixels import Pixels
from kcam.optics.pupil import (
    EDGE_MARGIN,
    Pupil,
    disc_weights,
    from_image_side,
    grid_nodes,
    grid_spacing,
    pupil_tau,
)
from kcam.optics.quadrants import unfold
from kcam.optics.rings import Scatter, panels_of, scatter
from kcam.optics.transforms import (
    ChirpZTransform,
    Curvature,
    CurvedTransform,
    FFTTransform,
    MatrixTransform,
    Transform,
    fast_length,
    mean_slope,
    pupil_intensity,
)
from kcam.optics.warp import Warp

if TYPE_CHECKING:
    from kcam.optics.elements import Element
    from kcam.optics.lens import Lens

_SPREAD = 1e-6  # share of the light that the structure of a radius may send beyond the displacement that is sampled
_GROUP_NUMBERS = 2**26  # pupils and images that wavelengths computed together may hold: 256 MB in float32


@dataclass(frozen=True)
class Query:
    """What is asked of a propagator: a lens, where the light comes from, and which pixels to fill.

    wavelengths: (L,) float64 [m]; vergences: (Z,) float64 [1/m], 0 for infinity, may carry gradients.
    pixel_pitch [m]; shape: (H, W) pixels; integrate: over pixels (else point samples times the pixel's area).
    active: width of the light-sensitive part of a pixel (square root of the fill factor).
    samples: across the pupil, or None for the rule of `sampling.pupil_samples` with `kappa`.
    cells_per_sample: of pixel maps, at least, for each pupil sample and axis: the rim cuts cells by their area.
    curved_kernel: beyond the paraxial range leave flat pixels in the true pupil plane and curve the kernel, exact and
        slow, instead of interpolating their field into the plane where the kernel is straight.
    """

    lens: Lens
    wavelengths: Tensor
    vergences: Tensor
    pixel_pitch: float
    shape: tuple[int, int]
    dtype: torch.dtype
    device: torch.device
    paraxial: bool = False
    integrate: bool = True
    active: float = 1.0
    kappa: float = sampling.KAPPA
    samples: int | None = None
    cells_per_sample: float = 1.7
    curved_kernel: bool = False

    @property
    def semi_aperture(self) -> Tensor:
        """a [m], 0-d float64."""
        return self.lens.aperture.semi_aperture().to(self.device)

    @property
    def sensor_distance(self) -> Tensor:
        """d [m], 0-d float64."""
        return torch.as_tensor(self.lens.sensor_distance, dtype=torch.float64, device=self.device)

    @property
    def tau(self) -> Tensor:
        """(a / d)^2, 0 where paraxial."""
        return pupil_tau(self.semi_aperture, self.sensor_distance, paraxial=self.paraxial)

    @property
    def image_side_semi_aperture(self) -> Tensor:
        """a' = a / sqrt(1 + tau) [m]."""
        return self.semi_aperture / torch.sqrt(1 + self.tau)

    @property
    def half_window(self) -> float:
        """From the origin to the edge of what is evaluated [m]."""
        return self.half_pixels * self.pixel_pitch

    @property
    def half_pixels(self) -> int:
        """Pixels from the origin to the edge of what is evaluated."""
        return max(self.shape) // 2 + (sampling.WINDOW_MARGIN if self.integrate else 0)

    def evaluation_grid(self, wavelength: float) -> tuple[float, int]:
        """(points per pixel, points from the origin to the edge) at which the intensity of a wavelength is
        evaluated.
        """
        per_pixel = 1.0
        if self.integrate:
            semi_aperture, distance = self.scale
            per_pixel = sampling.points_per_pixel(
                pixel_pitch=self.pixel_pitch,
                semi_aperture=semi_aperture,
                sensor_distance=distance,
                wavelength=wavelength,
            )
        return per_pixel, math.ceil(per_pixel * self.half_pixels)

    @functools.cached_property
    def scale(self) -> tuple[float, float]:
        """(a', d) as numbers [m], without a gradient; kept, because sampling rules ask for it at each wavelength."""
        with torch.no_grad():  # a checkpoint that computes again must find the same graph
            return float(self.image_side_semi_aperture), float(self.sensor_distance)

    @functools.cached_property
    def has_pixel_phase(self) -> bool:
        """Whether the lens has; kept, because sampling rules ask for it at each wavelength."""
        return self.lens.has_pixel_phase

    @functools.cached_property
    def displacement(self) -> Tensor:
        """How far the smooth part of the pupil sends its rays on the sensor, max d |grad W|, (L,) float64 [m].

        Where a profile of rings is part of it, as far as that scatters all but 1e-6 of its light. Without a gradient;
        kept, because every row of the table that is priced asks for it.
        """
        return self.spread(_SPREAD)

    def spread(self, share: float) -> Tensor:
        """As `displacement`, for another share of the light that a profile of rings may scatter beyond it."""
        return _ray_displacement(self, share)

    @functools.cached_property
    def panels(self) -> Tensor:
        """Edges of the panels of the radius in which the rotationally symmetric path is smooth, from 0 to 1."""
        return _panels(self)

    @functools.cached_property
    def scatter(self) -> Scatter | None:
        """What the rings of the pupil scatter, at the outermost wavelengths and distances; None where it has none."""
        if not self.lens.has_rings:
            return None
        with torch.no_grad():
            return scatter(self.panels, radial_phase(self))

    def aperture_pixels(self) -> Tensor:
        """The transmission of an aperture that is a map of pixels, (n, n)."""
        pixels = self.lens.aperture.pixel_map(self.wavelengths)
        if pixels is None:
            raise TypeError(f"{type(self.lens.aperture).__name__} has neither discs() nor a pixel_map().")
        return pixels.values

    def pixels(self, per_pixel: float) -> Pixels:
        """The pixels that are asked for, over so many points each."""
        return Pixels(self.shape, per_pixel, active=self.active, integrate=self.integrate)

    def pupil(self, x: Tensor, y: Tensor) -> Pupil:
        """The pupil at true normalised coordinates."""
        return Pupil(x, y, self.semi_aperture, self.sensor_distance, self.paraxial, round=self.lens.round)


# ---- the residual optical path -----------------------------------------------------------------------------------


def residual_vergence(query: Query) -> Tensor:
    """V = 1/z + 1/d + sum of the elements' vergences, (L, Z) float64 [1/m]; 0 in focus."""
    lens = sum(element.vergence(query.wavelengths.to(query.device)) for element in query.lens.elements)
    return (lens + 1 / query.sensor_distance)[:, None] + query.vergences[None, :]


def residual_path(query: Query, pupil: Pupil, elements: Sequence[Element] | None = None) -> tuple[Tensor, Tensor]:
    """The residual OPD as (coefficients (L, Z, T), maps (T, ...)), W = coefficients . maps, both float64.

    The first map is rho^2 with V a^2 / 2; then what the image-side and the object-side sphere have beyond their
    parabolas, then the terms of the elements, or of those that are given. Pixel maps are not part of it.
    """
    wavelengths = query.wavelengths.to(query.device)
    bands, distances = wavelengths.numel(), query.vergences.numel()
    ones = wavelengths.new_ones(bands, distances)
    coefficients = [residual_vergence(query) * query.semi_aperture**2 / 2]
    maps = [pupil.rho2]
    if not query.paraxial:
        coefficients.append(ones)
        maps.append(pupil.beyond_paraxial(1 / query.sensor_distance))
        for index, vergence in enumerate(query.vergences):
            if differentiated(vergence) or float(vergence) != 0:
                coefficients.append(ones * (torch.arange(distances, device=query.device) == index))
                maps.append(pupil.beyond_paraxial(vergence))
    for element in query.lens.elements if elements is None else elements:
        for coefficient, term in element.terms(pupil, wavelengths):
            coefficients.append(coefficient[:, None] * ones)
            maps.append(term)
    return torch.stack(coefficients, dim=-1), _stacked(maps)


def _stacked(maps: Sequence[Tensor]) -> Tensor:
    return torch.stack(torch.broadcast_tensors(*maps))


def _outermost(query: Query) -> Query:
    """The shortest and longest wavelength, the nearest and farthest distance; |grad W| is convex in the vergence."""
    wavelengths = torch.stack([query.wavelengths.min(), query.wavelengths.max()]).unique()
    vergences = query.vergences.detach()
    return replace(query, wavelengths=wavelengths, vergences=torch.stack([vergences.min(), vergences.max()]).unique())


def radial_phase(query: Query) -> Callable[[Tensor], Tensor]:
    """The rotationally symmetric part of the residual phase at true radii (n,), (P, n) [rad], without a gradient.

    P: the outermost wavelengths and distances.
    """
    outermost = _outermost(query)
    elements = [element for element in query.lens.elements if element.symmetric]
    wavenumbers = 2 * math.pi / outermost.wavelengths.to(query.device)

    def phase(rho: Tensor) -> Tensor:
        with torch.no_grad():
            coefficients, maps = residual_path(outermost, query.pupil(rho, torch.zeros_like(rho)), elements)
            return ((wavenumbers[:, None, None] * coefficients) @ maps).flatten(0, 1)

    return phase


def _panels(query: Query) -> Tensor:
    wavelengths = _outermost(query).wavelengths.to(query.device)
    known = [torch.tensor([0.0, 1.0], dtype=torch.float64)]
    unknown = []
    for element in query.lens.elements:
        if element.symmetric and element.knots is None:
            unknown.append(element)
        elif element.symmetric:
            known.append(torch.as_tensor(element.knots, dtype=torch.float64))
    knots = torch.cat(known).to(query.device).unique()
    knots = knots[(knots >= 0) & (knots <= 1)]

    def phase(rho: Tensor) -> Tensor:
        with torch.no_grad():
            pupil = query.pupil(rho, torch.zeros_like(rho))
            terms = [term for element in unknown for term in element.terms(pupil, wavelengths)]
            found = [2 * math.pi / wavelengths[:, None] * c[:, None] * m for c, m in terms]
            return torch.stack([path.expand(wavelengths.numel(), rho.numel()) for path in found])

    if not unknown:
        return knots
    trained = any(p.requires_grad for element in unknown for p in element.parameters())
    return panels_of(phase, knots, first=512 if trained else 32)  # a flat start tells nothing of what may grow


def _ray_displacement(query: Query, share: float) -> Tensor:
    """Of all elements together on a grid; where some are profiles of rings, of those along a radius and of the rest."""
    lens, outermost = query.lens, replace(_outermost(query), wavelengths=query.wavelengths)
    with torch.no_grad():
        side = torch.linspace(-1, 1, 97, dtype=torch.float64, device=query.device)
        if lens.symmetric:
            side = side[48:]
            x, y = side, torch.zeros_like(side)
        else:
            x, y = side[None, :], side[:, None]
        pupil = query.pupil(x, y)
        rings = query.wavelengths.new_zeros(query.wavelengths.numel())
        if query.scatter is None:
            coefficients, maps = residual_path(outermost, pupil)
        else:
            rings += _ring_displacement(query, query.scatter, share)
            others = [element for element in lens.elements if not element.symmetric]
            terms = [term for element in others for term in element.terms(pupil, query.wavelengths.to(query.device))]
            if not terms:
                return rings
            coefficients = torch.stack([coefficient for coefficient, _ in terms], dim=-1)[:, None]
            maps = _stacked([term for _, term in terms])
        inside = (pupil.rho2 <= 1.0001) | (not lens.round)
        step = float(side[1] - side[0]) * float(query.semi_aperture)
        gradients = torch.gradient(maps, spacing=step, dim=-1 if maps.ndim == 2 else (-2, -1))
        slope2 = torch.stack([(coefficients.flatten(0, 1) @ g.flatten(1)) ** 2 for g in gradients]).sum(0)
        slope2 = torch.where(inside.flatten(), slope2, slope2.new_zeros(()))
        slope = slope2.amax(dim=1).sqrt().view(query.wavelengths.numel(), -1).amax(dim=1)
        return rings + (slope * query.sensor_distance).cpu()


def _ring_displacement(query: Query, scatter: Scatter, share: float) -> float:
    """Where the steepest ray of the symmetric path lands, or all but a share of what its rings scatter [m]."""
    edges, outermost = query.panels, _outermost(query)
    rho = edges[:-1, None] + edges.diff()[:, None] * torch.linspace(0, 1, 13).to(edges)
    phase = radial_phase(query)(rho.flatten()).unflatten(-1, (-1, 13))
    slope = (phase.diff() * (12 / edges.diff()[:, None])).abs().amax(dim=(1, 2)) / (2 * math.pi)
    farthest = torch.maximum(slope, scatter.reach(share)).view(outermost.wavelengths.numel(), -1).amax(1)
    return float(
        (farthest.cpu() * outermost.wavelengths).max() * query.sensor_distance.cpu() / query.semi_aperture.cpu()
    )


# ---- propagation on a Cartesian pupil grid -----------------------------------------------------------------------


def grid_psf(query: Query, *, method: str) -> Tensor:
    """PSFs by a transform of a Cartesian pupil grid: `matrix`, `chirp_z` or `fft`; (Z, L, H, W)."""
    displacement = query.displacement
    bands: list[Tensor] = [torch.empty(0)] * query.wavelengths.numel()
    for members, count, per_pixel in _groups(query, displacement, method=method):
        images = _grid_group(query, members, count=count, per_pixel=per_pixel, method=method, displacement=displacement)
        for index, image in zip(members, images.unbind(0), strict=True):
            bands[index] = image
    return torch.stack(bands, dim=1)


def samples_by_rule(query: Query, *, displacement: float, wavelength: float) -> int:
    """Pupil samples by the rule of `sampling.pupil_samples`, however many."""
    geometry = _geometry(query, displacement=displacement, wavelength=wavelength)
    needed = sampling.pupil_samples(**geometry, kappa=query.kappa)
    if query.has_pixel_phase:  # few distinct grids: each needs weights of its own for the map
        step = max(64, 2 ** (needed.bit_length() - 4))
        needed = step * math.ceil(needed / step)
    return needed


def _geometry(query: Query, *, displacement: float, wavelength: float) -> dict[str, float]:
    return {
        "semi_aperture": query.scale[0],
        "sensor_distance": query.scale[1],
        "wavelength": wavelength,
        "half_window": query.half_window,
        "displacement": displacement,
    }


def grid_samples(query: Query, *, displacement: Tensor, wavelength: float, index: int) -> int:
    """Pupil samples for one wavelength: the rule's, or the user's after a check that no replica enters the window.

    Raises: ValueError with the sampling that would do.
    """
    geometry = _geometry(query, displacement=float(displacement[index]), wavelength=wavelength)
    needed = samples_by_rule(query, displacement=float(displacement[index]), wavelength=wavelength)
    if query.samples is None:
        if needed > sampling.MAX_PUPIL_SAMPLES:
            raise ValueError(
                f"this PSF needs {needed} pupil samples at {wavelength * 1e9:.4g} nm (blur "
                f"{geometry['displacement'] * 1e3:.3g} mm, window {2 * query.half_window * 1e3:.3g} mm), more than "
                f"the limit of {sampling.MAX_PUPIL_SAMPLES}. Use a smaller shape, method='radial', or "
                "propagator='geometric'."
            )
        return needed
    if sampling.kappa_of(query.samples, **geometry) <= 1:
        raise ValueError(
            f"a pupil of {query.samples} samples is too coarse at {wavelength * 1e9:.4g} nm: its replicas would enter "
            f"the window. Use samples >= {needed}, or leave samples out."
        )
    return query.samples + query.samples % 2


def _groups(query: Query, displacement: Tensor, *, method: str) -> Iterator[tuple[list[int], int, float]]:
    """Wavelengths that share a grid: (their indices, pupil samples, points per pixel)."""
    groups: dict[tuple[int, float, int], list[int]] = {}
    for index, wavelength in enumerate(query.wavelengths.tolist()):
        count = grid_samples(query, displacement=displacement, wavelength=wavelength, index=index)
        own_grid = index if method == "fft" else -1  # its pupil grid scales with the wavelength
        groups.setdefault((count, query.evaluation_grid(wavelength)[0], own_grid), []).append(index)
    for (count, per_pixel, _), members in groups.items():
        points = 2 * math.ceil(per_pixel * query.half_pixels) + 1
        each = 2 * count**2 + 3 * query.vergences.numel() * points**2  # numbers held for each wavelength
        length = max(1, _GROUP_NUMBERS // each)
        for first in range(0, len(members), length):
            yield members[first : first + length], count, per_pixel


def _grid_group(
    query: Query, members: list[int], *, count: int, per_pixel: float, method: str, displacement: Tensor
) -> Tensor:
    wavelengths = query.wavelengths[members].to(query.device)
    wavenumbers = 2 * math.pi / wavelengths
    curved = _curved(query)
    semi_aperture = query.semi_aperture if curved else query.image_side_semi_aperture
    slope = mean_slope(float(query.tau.detach())) if curved else 1.0
    scales = wavenumbers * semi_aperture / query.sensor_distance
    step = query.pixel_pitch / per_pixel
    reach = math.ceil(per_pixel * query.half_pixels)
    like = torch.empty(0, dtype=query.dtype, device=query.device)

    spacing, length = grid_spacing(count), 0
    if method == "fft":
        spread, wavelength = float(displacement[members[0]]), float(wavelengths[0])
        count, length, spacing = fft_grid_for(query, displacement=spread, wavelength=wavelength)
    nodes = grid_nodes(count, spacing=spacing)

    def straight(scale: float) -> Transform:
        if method == "fft":
            return FFTTransform(count, length, reach)
        build = MatrixTransform.build if method == "matrix" else ChirpZTransform.build
        return build(nodes, scale=scale * slope, step=step, reach=reach, like=like)

    kernels = [straight(float(scale)) for scale in scales.detach()]
    if curved:
        kernels = _curve(query, kernels, scales, nodes, step=step, reach=reach, like=like)

    along = (nodes[count // 2 :] if query.lens.even else nodes).to(query.device)
    x, y = along[None, :], along[:, None]
    pupil = query.pupil(*((x, y) if curved else from_image_side(x, y, query.tau)))
    coefficients, maps = residual_path(replace(query, wavelengths=query.wavelengths[members]), pupil)
    amplitude = _amplitude(query, pupil, curved=curved)
    cell_area = (semi_aperture * spacing) ** 2
    cells = Cells.of(query, wavelengths, count=count, spacing=spacing)
    if cells is None:
        quadrant = _disc_weights(query, count=count, spacing=spacing)
        weights, share = (quadrant, 4) if query.lens.even else (unfold(quadrant), 1)
        energy = share * (weights * amplitude**2).sum((-2, -1)) * cell_area
        amplitude, field = weights * amplitude, None
    else:  # they hold the aperture, for its rim cuts their pixels
        energy = cells.energy(query.semi_aperture, 0 * query.vergences[:1] if query.paraxial else query.vergences)
        field = _pixel_field(query, cells, kernels[0], count=count, spacing=spacing, curved=curved)
    intensity = pupil_intensity(
        (wavenumbers[:, None, None] * coefficients).to(query.dtype),
        maps=maps.to(query.dtype),
        amplitude=amplitude.to(query.dtype),
        field=field,
        scales=scales.to(query.dtype),
        transforms=kernels,
        nodes=nodes,
        points=torch.arange(-reach, reach + 1, dtype=torch.float64) * step,
        tau=query.tau if curved else None,
    )
    # |sum w P|^2 -> share of the energy per pixel: (a^2 h^2)^2 p^2 / (lambda d)^2 / E
    factor = (cell_area * query.pixel_pitch / (wavelengths * query.sensor_distance)[:, None]) ** 2 / energy
    image = kernels[0].to_pixels(intensity, query.pixels(per_pixel))
    return image * factor[..., None, None].to(query.dtype)


def _curve(
    query: Query, kernels: list[Transform], scales: Tensor, nodes: Tensor, *, step: float, reach: int, like: Tensor
) -> list[Transform]:
    """The kernels of a group, curved as far as each needs it."""
    tau = float(query.tau.detach())
    strengths = [float(scale) * max(reach, 1) * step for scale in scales.detach()]
    corner = 1.0 if query.lens.round else math.sqrt(2)
    orders = [Curvature.order_for(strength, tau=tau, error=1e-8, corner=corner) for strength in strengths]
    shared = Curvature.build(kernels[0], nodes, tau=tau, step=step, reach=reach, order=max(orders), like=like)
    return [CurvedTransform(*parts) for parts in zip(kernels, itertools.repeat(shared), strengths, orders)]


def _curved(query: Query) -> bool:
    return query.curved_kernel and query.lens.has_pixels and not query.paraxial


def fft_grid_for(query: Query, *, displacement: float, wavelength: float) -> tuple[int, int, float]:
    """`fft_grid` for one wavelength of a query, whose light is displaced so far [m]."""
    per_pixel, reach = query.evaluation_grid(wavelength)
    step = query.pixel_pitch / per_pixel
    semi_aperture, distance = query.scale
    if _curved(query):
        semi_aperture = float(query.semi_aperture.detach()) * mean_slope(float(query.tau.detach()))
    shortest = max(math.ceil(2 * query.kappa * (query.half_window + displacement) / step), 2 * reach + 1)
    return fft_grid(2 * math.pi * semi_aperture * step / (wavelength * distance), shortest=shortest)


def fft_grid(scale_step: float, *, shortest: int) -> tuple[int, int, float]:
    """(pupil samples, length, spacing) of the FFT whose bins fall on the points: spacing = 2 pi / (length * s *
    step).
    """
    length = fast_length(shortest)
    while True:
        spacing = 2 * math.pi / (length * scale_step)
        count = 2 * math.ceil(1 / spacing + EDGE_MARGIN)
        if count <= length:
            return count, length, spacing
        length = fast_length(count)  # a longer transform has finer samples, and so more of them


def _amplitude(query: Query, pupil: Pupil, *, curved: bool) -> Tensor:
    """Obliquity and source amplitude on the pupil's points, (1 or Z, ...)."""
    if query.paraxial:
        return torch.ones_like(pupil.rho2)[None]
    # a spherical wave's amplitude falls as 1 / R over the pupil: 1 / sqrt(1 + V^2 r^2)
    falloff = torch.rsqrt(1 + query.vergences[:, None, None] ** 2 * pupil.rho2 * query.semi_aperture**2)
    # the Debye map's amplitude is `measure` in the image-side plane; d^2 u' / d^2 u is measure^-2
    return falloff * (1 / pupil.measure if curved else pupil.measure)


def _disc_weights(query: Query, *, count: int, spacing: float) -> Tensor:
    """Quadrature weights of an aperture made of discs, for x, y > 0."""
    weights = torch.zeros(count // 2, count // 2, dtype=torch.float64)
    for radius, weight in query.lens.aperture.discs():

        def rim(tau: float, radius: float = radius) -> Tensor:
            image_side = radius * math.sqrt((1 + tau) / (1 + tau * radius**2))
            return disc_weights(count, spacing=spacing, radius=image_side)

        weights = weights + weight * _following(query.tau.cpu(), rim, spacing=spacing)
    return weights.to(query.device)


def _following(tau: Tensor, evaluate: Callable[[float], Tensor], *, spacing: float) -> Tensor:
    """evaluate(tau), with the gradient to tau by a central difference where tau has one (value unchanged).

    tau moves edges on the image-side grid by up to 0.19 tau semi-apertures: the step moves them by a twentieth of a
    sample.
    """
    value = evaluate(float(tau.detach()))
    if not (tau.requires_grad and torch.is_grad_enabled()):
        return value
    step = 0.05 * spacing / 0.19
    with torch.no_grad():
        slope = (evaluate(float(tau) + step) - evaluate(float(tau) - step)) / (2 * step)
    return value + ((tau - tau.detach()) * slope).to(value)


def _pixel_field(query: Query, cells: Cells, layout: Transform, *, count: int, spacing: float, curved: bool) -> Tensor:
    """The pixel maps' transmission and phase on the pupil grid: real and imaginary part (2, L, ...) in a transform's
    layout.
    """

    def both(tau: float) -> Tensor:
        return cells.field(_warp(query, tau, count=count, spacing=spacing, curved=curved), layout)

    return _following(query.tau, both, spacing=spacing)


def _warp(query: Query, tau: float, *, count: int, spacing: float, curved: bool) -> Warp | None:
    """The way from the true pupil plane to the image-side plane, where the kernel needs it."""
    if curved or query.paraxial:
        return None
    corner = 1.05 if query.lens.round else 1.05 * math.sqrt(2)
    return Warp.build(count, spacing=spacing, tau=tau, corner=corner, dtype=query.dtype, device=query.device)
