"""Point spread functions: from the elements of a lens to the energy in each pixel.

    h(x, y) = |U|^2,  U(x) = 1 / (lambda d sqrt(E)) INT A exp(i k W) exp(-i k x.u' / d) d^2 u'

W is the *residual* optical path: source, lens and propagation are each thousands of radians and cancel in focus, so
their vergences are summed as float64 scalars first. E is the energy that passes the aperture: a PSF sums to the share
of that light which falls into its window, and is not normalised to 1.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from kcam.cache import ValueCache, differentiated, seen
from kcam.optics.elements.element import Element, is_even
from kcam.optics.elements.stack import ElementStack
from kcam.optics.propagation import sampling
from kcam.optics.propagation.pixels import Pixels
from kcam.optics.propagation.rings import Scatter, panels_of, scatter
from kcam.optics.pupil.coordinates import Pupil, pupil_tau
from kcam.optics.pupil.maps import pixel_under
from kcam.optics.source import PixelGrid, Points

_AT_ONCE = 8  # wavelengths whose rays are looked at: more do not stay in a processor's cache
_DISPLACEMENTS = ValueCache(16)  # the last: a picture asks for its own at each step
_SPREAD = 1e-6  # share of the light that the structure of a radius may send beyond the displacement that is sampled


@dataclass(frozen=True)
class Sampling:
    """How closely a query is answered; what it asks does not depend on it.

    kappa: pupil samples per fringe, see `sampling.pupil_samples`. samples: across the pupil, instead.
    cells_per_sample: of pixel maps, at least, for each pupil sample and axis: the rim cuts cells by their area.
    curved_kernel: beyond the paraxial range leave flat pixels in the true pupil plane and curve the kernel, exact and
        slow, instead of interpolating their field into the plane where the kernel is straight.
    """

    kappa: float = sampling.KAPPA
    samples: int | None = None
    cells_per_sample: float = 1.7
    curved_kernel: bool = False


@dataclass(frozen=True)
class Query:
    """What is asked of a propagator: a lens, where the light comes from, and which pixels to fill.

    wavelengths: (L,) float64 [m]. points: whose vergences are on the grid's device. grid: the pixels.
    how: closely it is answered. paraxial: by the model of a row. whole: scaled to what whole pixels receive together,
    see `Pixels`. turned: where slices are asked for, along the diagonals, of smooth round pupils.
    """

    lens: ElementStack
    wavelengths: Tensor
    points: Points
    grid: PixelGrid
    how: Sampling = Sampling()
    paraxial: bool = False
    whole: bool = False
    turned: bool = False

    def on(self, **grid: Any) -> Query:
        """The same question of other pixels; arguments: as of `PixelGrid`."""
        return replace(self, grid=replace(self.grid, **grid))

    def sampled(self, **how: Any) -> Query:
        """The same question, answered more or less closely; arguments: as of `Sampling`."""
        return replace(self, how=replace(self.how, **how))

    @property
    def vergences(self) -> Tensor:
        """Of the points, (Z,) float64 [1/m]."""
        return self.points.vergences

    @property
    def pixel_pitch(self) -> float:
        """[m]."""
        return self.grid.pitch

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) pixels."""
        return self.grid.shape

    @property
    def dtype(self) -> torch.dtype:
        """Of the answer."""
        return self.grid.dtype

    @property
    def device(self) -> torch.device:
        """Of the answer."""
        return self.grid.device

    @property
    def symmetric(self) -> bool:
        """Whether what is asked is rotationally symmetric: the lens, and the points lie on its axis."""
        return self.points.positions is None and self.lens.symmetric

    @property
    def has_rings(self) -> bool:
        """Whether a rotationally symmetric path may have structure along the radius."""
        return self.lens.has_rings

    @property
    def even(self) -> bool:
        """Whether no path tells x from -x or y from -y; maps of pixels may."""
        return self.points.positions is None and self.lens.even

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
        return max(self.half_sides)

    @property
    def half_sides(self) -> tuple[int, int]:
        """The same of rows, and of columns."""
        margin = sampling.WINDOW_MARGIN if self.grid.integrate else 0
        return self.shape[0] // 2 + margin, self.shape[1] // 2 + margin

    def evaluation_grid(self, wavelength: float) -> tuple[float, int]:
        """(points per pixel, points from the origin to the edge) at which the intensity of a wavelength is
        evaluated.
        """
        per_pixel = 1.0
        if self.grid.integrate:
            semi_aperture, distance = self.scale
            per_pixel = sampling.points_per_pixel(
                pixel_pitch=self.pixel_pitch,
                semi_aperture=semi_aperture,
                sensor_distance=distance,
                wavelength=wavelength,
            )
        return per_pixel, math.ceil(per_pixel * self.half_pixels)

    @functools.cached_property
    def points_per_axis(self) -> list[int]:
        """On each axis, at which the intensity of each wavelength is evaluated; kept, because each row's price asks."""
        return [2 * self.evaluation_grid(wavelength)[1] + 1 for wavelength in self.wavelengths.tolist()]

    @functools.cached_property
    def scale(self) -> tuple[float, float]:
        """(a', d) as numbers [m], without a gradient; kept, because sampling rules ask for it at each wavelength."""
        with torch.no_grad():  # a checkpoint that computes again must find the same graph
            a, d = float(self.semi_aperture), float(self.sensor_distance)
        return a if self.paraxial else a / math.sqrt(1 + (a / d) ** 2), d

    @functools.cached_property
    def has_pixels(self) -> bool:
        """Whether the lens has; kept, because sampling rules ask for it at each wavelength."""
        return self.lens.has_pixels

    @functools.cached_property
    def has_pixel_phase(self) -> bool:
        """Whether the lens has."""
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
        with torch.no_grad():
            wavelengths = self.wavelengths.tolist()
            scattered = (share, *wavelengths) if self.has_rings else ()  # by the outermost of these
            ends = *map(float, self.vergences.detach().aminmax()), self.device, self.paraxial
            look = functools.partial(_DISPLACEMENTS.get, (self.lens, ends, scattered), dict[float, float])
            known = seen(self.lens, ("spread", ends, scattered), look)  # by wavelength
            if missing := [index for index, wavelength in enumerate(wavelengths) if wavelength not in known]:
                some = (
                    self if len(missing) == len(wavelengths) else replace(self, wavelengths=self.wavelengths[missing])
                )
                found = _ray_displacement(some, share)
                known.update(zip((wavelengths[index] for index in missing), found.tolist(), strict=True))
            return self.wavelengths.new_tensor([known[wavelength] for wavelength in wavelengths])

    @functools.cached_property
    def panels(self) -> Tensor:
        """Edges of the panels of the radius in which the rotationally symmetric path is smooth, from 0 to 1."""
        return _panels(self)

    @functools.cached_property
    def scatter(self) -> Scatter | None:
        """What the rings of the pupil scatter, at the outermost wavelengths and distances; None where it has none."""
        if not self.has_rings:
            return None
        with torch.no_grad():
            return scatter(self.panels, radial_phase(self))

    def modelled(self, *, paraxial: bool) -> Query:
        """The same question to the paraxial model or the exact one, with what it has kept: itself, or its other one."""
        return self if self.paraxial == paraxial else self._other_model

    @functools.cached_property
    def _other_model(self) -> Query:
        other = replace(self, paraxial=not self.paraxial)
        vars(other)["kept"] = self.kept
        return other

    @functools.cached_property
    def kept(self) -> dict[str, Any]:
        """What others have computed that is the same for both models, by name."""
        return {}

    def aperture_pixels(self) -> Tensor:
        """The transmission of an aperture that is a map of pixels, (n, n)."""
        pixels = self.lens.aperture.pixel_map(self.wavelengths)
        if pixels is None:
            raise TypeError(f"{type(self.lens.aperture).__name__} has neither discs() nor a pixel_map().")
        return pixels.values

    def transmission(self, axis: Tensor) -> Tensor:
        """Amplitude that maps of pixels let pass, the aperture's too, on a square grid with this axis [m]."""
        passed = torch.ones((), dtype=axis.dtype, device=axis.device)
        for pixels in self.lens.pixel_maps(self.wavelengths):
            if pixels.factors is None:
                passed = passed * pixel_under(pixels.values.to(axis), pixels.half_width, axis, self.semi_aperture)
        return passed

    def folded(self, active: float = 0.0) -> bool:
        """Whether light is finer than the pixels, of which so much of their width at most is sensitive; 0: points."""
        (a, d), finest = self.scale, float(self.wavelengths.min())
        sensitive = self.grid.active if self.grid.integrate else 0.0
        return sensitive <= active and 2 * a * self.pixel_pitch > d * finest

    @property
    def has_gaps(self) -> bool:
        """Whether it is scaled to what whole pixels receive together, and these are not what is integrated over."""
        return self.whole and self.grid.integrate and self.grid.active < 1

    def pixels(self, per_pixel: float) -> Pixels:
        """The pixels that are asked for, over so many points each."""
        return Pixels(self.shape, per_pixel, active=self.grid.active, integrate=self.grid.integrate, whole=self.whole)

    def pupil(self, x: Tensor, y: Tensor) -> Pupil:
        """The pupil at true normalised coordinates."""
        return Pupil(x, y, self.semi_aperture, self.sensor_distance, self.paraxial, round=self.lens.round)


def residual_vergence(query: Query) -> Tensor:
    """V = 1/z + 1/d + sum of the elements' vergences, (L, Z) float64 [1/m]; 0 in focus."""
    lens = sum(element.vergence(query.wavelengths.to(query.device)) for element in query.lens.elements)
    return (lens + 1 / query.sensor_distance)[:, None] + query.vergences[None, :]


def residual_path(query: Query, pupil: Pupil, elements: Sequence[Element] | None = None) -> tuple[Tensor, Tensor]:
    """The residual OPD as (coefficients (L, Z, T), maps (T, ...)), W = coefficients . maps, both float64.

    The first map is rho^2 with V a^2 / 2; then what the image-side and the object-side sphere have beyond their
    parabolas, then the terms of the elements, or of those that are given. Pixel maps are not part of it. Of a mirrored
    pupil, what is even is found in one quadrant.
    """
    first = pupil.quadrant or pupil
    wavelengths = query.wavelengths.to(query.device)
    bands, distances = wavelengths.numel(), query.vergences.numel()
    ones = wavelengths.new_ones(bands, distances)
    coefficients = [residual_vergence(query) * query.semi_aperture**2 / 2]
    maps = [first.rho2]
    if not query.paraxial:
        coefficients.append(ones)
        maps.append(first.beyond_paraxial(1 / query.sensor_distance))
        every = torch.arange(distances, device=query.device)
        near = every if differentiated(query.vergences) else every[query.vergences != 0]
        coefficients += (ones * (every == near[:, None, None])).unbind(0)
        maps += first.beyond_paraxial(query.vergences[near][(..., *[None] * first.rho2.ndim)]).unbind(0)
    for element in query.lens.elements if elements is None else elements:
        for coefficient, term in element.terms(first if is_even(element) else pupil, wavelengths):
            coefficients.append(coefficient[:, None] * ones)
            maps.append(term)
    return torch.stack(coefficients, dim=-1), _stacked(maps)


def residual_amplitude(query: Query, pupil: Pupil, *, curved: bool = False) -> Tensor:
    """Obliquity and source amplitude on the pupil's points, (1 or Z, ...); curved: in the true plane."""
    if query.paraxial:
        return torch.ones_like(pupil.rho2)[None]
    # a spherical wave's amplitude falls as 1 / R over the pupil: 1 / sqrt(1 + V^2 r^2)
    falloff = torch.rsqrt(1 + query.vergences[:, None, None] ** 2 * pupil.rho2 * query.semi_aperture**2)
    # the Debye map's amplitude is `measure` in the image-side plane; d^2 u' / d^2 u is measure^-2
    return falloff * (1 / pupil.measure if curved else pupil.measure)


def _stacked(maps: Sequence[Tensor]) -> Tensor:
    return torch.stack(torch.broadcast_tensors(*maps))


def _outermost(query: Query) -> Query:
    """The shortest and longest wavelength, the nearest and farthest distance; |grad W| is convex in the vergence."""
    wavelengths = torch.stack([query.wavelengths.min(), query.wavelengths.max()]).unique()
    vergences = query.vergences.detach()
    ends = torch.stack([vergences.min(), vergences.max()]).unique()
    return replace(query, wavelengths=wavelengths, points=Points(ends))


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
        if query.symmetric:
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
        inside = ((pupil.rho2 <= 1.0001) | (not lens.round)).flatten().nonzero()[:, 0]
        step = float(side[1] - side[0]) * float(query.semi_aperture)
        gradients = torch.gradient(maps, spacing=step, dim=-1 if maps.ndim == 2 else (-2, -1))
        along = [gradient.flatten(1).index_select(1, inside) for gradient in gradients]
        farthest = []
        for some in coefficients.split(_AT_ONCE):
            slopes2 = functools.reduce(Tensor.add_, [(some.flatten(0, 1) @ own).square_() for own in along])
            farthest.append(slopes2.amax(dim=1).view(len(some), -1).amax(dim=1))
        return rings + (torch.cat(farthest).sqrt() * query.sensor_distance).cpu()


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
