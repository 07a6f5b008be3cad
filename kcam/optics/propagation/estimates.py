"""What a PSF is expected to be wrong by, before it is computed: L1 against the `reference` row of the same query.

On a Cartesian grid nothing but the rim is approximated (its edge weights are low-passed), so the estimate follows the
light that the rim diffracts: how much of it reaches each part of the window, and what the low-pass takes from it or
folds back. The rest are fits; `tests/optics/test_estimates.py` holds all of them to random cameras.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from kcam.optics.propagation.cells import sizes
from kcam.optics.propagation.question import Query, radial_phase, residual_path
from kcam.optics.pupil.coordinates import from_image_side
from kcam.optics.pupil.maps import map_response
from kcam.optics.pupil.rim import FINE, edge_response
from kcam.optics.source import Points

_SIDE = 65  # of the grid on which rays are traced
_COARSE = 17  # of that on which their second order is looked at
_TURNED, _COHERENT = 2.0, 0.2  # c [rad], and its share of the energy of all slopes, from which on a phase is oblique
_NEAR = 1e-5  # of the semi-aperture: the step over which a slope is taken
_RADII = 96  # of the window over which errors are summed
_QUANTILES = (0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95, 1.0)  # of the rim's displacements
_SAFETY = 1.7  # for light that caustics heap up where the rim's loss is largest: 4 times too small without, at worst
ROUNDING = {torch.float32: 1e-6, torch.float64: 1e-12}


@dataclass(frozen=True)
class Rays:
    """Where the smooth part of a pupil sends its light, for one wavelength and distance (1 / vergence); in metres.

    rms: of the displacement over the pupil; rim: quantiles of it along the rim. phase: rms of the residual [rad];
    beyond: rms of what the paraxial model leaves out of it [rad].
    """

    wavelength: float
    vergence: float
    rms: float
    rim: np.ndarray
    phase: float
    beyond: float


def trace(query: Query) -> list[Rays]:
    """Rays at the shortest and longest wavelength, for the outermost distances and that in best focus; kept."""
    if "rays" not in query.kept:
        query.kept["rays"] = _trace(query)
    return query.kept["rays"]


def _trace(query: Query) -> list[Rays]:
    with torch.no_grad():
        wavelengths = torch.stack([query.wavelengths.min(), query.wavelengths.max()]).unique()
        vergences = query.vergences.detach()
        power = float(query.lens.power(wavelengths).mean()) - 1 / float(query.sensor_distance)
        nearest = vergences[(vergences - power).abs().argmin()]
        vergences = torch.stack([vergences.min(), vergences.max(), nearest]).unique()
        side = torch.linspace(-1, 1, _SIDE, dtype=torch.float64, device=query.device)
        exact = replace(query, wavelengths=wavelengths, points=Points(vergences), paraxial=False)
        flat = replace(exact, paraxial=True)
        x, y = side[None, :], side[:, None]

        def path(right: float, down: float) -> torch.Tensor:
            pupil = exact.pupil(*from_image_side(x + right, y + down, exact.tau))
            return torch.einsum("lzt,tvu->lzvu", *residual_path(exact, pupil))

        paths = path(0, 0)
        # from so near that a profile of rings has the slope that it has there, not the mean over several
        slopes = [(path(*step) - path(*(-s for s in step))) / (2 * _NEAR) for step in ((_NEAR, 0.0), (0.0, _NEAR))]
        beyond = paths - torch.einsum("lzt,tvu->lzvu", *residual_path(flat, flat.pupil(x, y)))

        rho2 = x**2 + y**2
        open_part = rho2 <= 1.0001 if query.lens.round else torch.ones_like(rho2, dtype=torch.bool)
        rim = open_part & (rho2 > 0.9 if query.lens.round else torch.maximum(x.abs(), y.abs()) > 0.9)
        displacements = torch.hypot(*slopes) * float(query.sensor_distance / query.semi_aperture)
        found = []
        for index, wavelength in enumerate(wavelengths.tolist()):
            wavenumber = 2 * math.pi / wavelength
            each = zip(vergences.tolist(), displacements[index], paths[index], beyond[index], strict=True)
            for vergence, displacement, whole, rest in each:
                rms = float(displacement[open_part].square().mean().sqrt())
                quantiles = np.quantile(displacement[rim].cpu().numpy(), _QUANTILES)
                phase, left_out = (wavenumber * float(part[open_part].std()) for part in (whole, rest))
                found.append(Rays(wavelength, vergence, rms, quantiles, phase, left_out))
        return found


def beyond_paraxial(query: Query) -> float:
    """About the largest `Rays.beyond`, from one radius: 1 to 1.1 times that of round apertures, 2 times of others."""
    with torch.no_grad():
        exact = replace(query, wavelengths=query.wavelengths.min()[None], paraxial=False)
        flat = replace(exact, paraxial=True)
        x = torch.linspace(0, 1 if query.lens.round else math.sqrt(2), _SIDE, dtype=torch.float64, device=query.device)
        paths = (
            torch.einsum("lzt,tx->lzx", *residual_path(model, model.pupil(*from_image_side(x, 0 * x, model.tau))))
            for model in (exact, flat)
        )
        left_out = next(paths) - next(paths)
        weights = x / x.sum()
        mean = (weights * left_out).sum(-1, keepdim=True)
        rms = (weights * (left_out - mean).square()).sum(-1).sqrt().max()
        return 2 * math.pi * float(rms / exact.wavelengths[0])


def is_oblique(query: Query) -> bool:
    """Whether a change of focus shows along the diagonals more than along x and y, of optics that are astigmatic.

    A phase of m (u^2 + v^2) / 2 + q (u^2 - v^2) / 2 + c u v spreads light by m + q and m - q along x and y, and by
    m + c and m - c along the diagonals. Between the outermost distances, at the shortest wavelength, if that is much of
    what the elements do.
    """
    if query.symmetric:
        return False
    with torch.no_grad():
        query = replace(query, wavelengths=query.wavelengths.min()[None].to(query.device))
        side = torch.linspace(-1, 1, _COARSE, dtype=torch.float64, device=query.device)
        coefficients, maps = residual_path(query, query.pupil(*from_image_side(side, side[:, None], query.tau)))
        phases = torch.einsum("zt,tvu->zvu", 2 * math.pi / query.wavelengths * coefficients[0], maps)
        down, across = torch.gradient(phases, spacing=float(side[1] - side[0]), dim=(-2, -1))
        found = _second_order(query, down, across, side)
        for pixels in query.lens.pixel_maps(query.wavelengths):
            if pixels.factors is None or (count := len(pixels.values)) < 3:
                continue
            share = 1.0 if pixels.half_width is None else float(pixels.half_width / query.semi_aperture)
            corners = (torch.arange(1, count).to(side) * (2 / count) - 1) * share
            down, across = (step.to(side) * (count / (2 * share)) for step in pixels.steps())
            down, across = (down[:, 1:] + down[:, :-1]) / 2, (across[1:] + across[:-1]) / 2
            found = found + _second_order(query, down, across, corners)
        (low, high), (_, q, c, energy) = found[0].aminmax(), found.amin(1)  # energy: where slopes are least
        focus = (low**2 + low * high + high**2) / 3  # in the mean over distances in between
        return bool((c.abs() > _TURNED) & (c**2 > focus + 2 * q**2) & (c**2 > _COHERENT * energy))


def _second_order(query: Query, down: Tensor, across: Tensor, side: Tensor) -> Tensor:
    """m, q and c of a phase with slopes (..., N, N) at places (N,), see `is_oblique`, and what c^2 would be if all of
    its slopes were of it: (4, Z or 1).
    """
    u, v = side, side[:, None]
    r2 = u**2 + v**2
    weights = (r2 <= 1) if query.lens.round else torch.maximum(u.abs(), v.abs()) <= 1
    weights = weights / (weights * r2).sum().clamp(min=1e-300)  # of pixels as wide as the pupil no corner may lie in it
    parts = across * u + down * v, across * u - down * v, across * v + down * u, across**2 + down**2
    return torch.stack([(weights * part).sum((-2, -1)) for part in parts]).view(4, -1)


def grid_error(query: Query, rays: Rays, *, period: float) -> float:
    """What a Cartesian grid costs: its edge weights, and its maps of flat pixels, relative to the light in the window.

    The rim sends light to a distance Delta from where its ray lands, of the irradiance lambda N / (2 pi^3 Delta^2 r) on
    each side of the axis (the envelope of the Airy pattern, for a pupil in focus). Edge weights pass H(Delta / period)
    of its amplitude and fold in what they should stop one period away; the cells in which they measure the rim's area
    fold in a little from FINE periods away.

    Args: period: at which the transform repeats, lambda d / spacing [m].
    """
    airy = rays.wavelength * float(query.sensor_distance.detach()) / (2 * float(query.semi_aperture.detach()))
    edge = query.pixel_pitch * (max(query.shape) / 2 + (1 if query.grid.integrate else 0))
    r = (np.arange(_RADII) + 0.5) / _RADII * edge
    blur = max(math.sqrt(2) * rays.rms, airy / 2)
    light = np.where(r < blur, 1 / (math.pi * blur**2), 0.0)
    losses = []
    for side in (1, -1):
        landed = side * rays.rim[:, None]
        here = np.abs(r - landed)
        from_rim = _from_rim(here, r, airy)
        light = light + from_rim.mean(0)
        loss = from_rim * (1 - edge_response(here / period)) ** 2
        for repeat, response in ((period, edge_response), (FINE * period, _cell_response)):
            folded = np.abs(repeat - r + landed)
            loss = loss + 4 * _from_rim(folded, np.abs(repeat - r), airy) * response(folded / period) ** 2
        losses.append(np.sqrt(loss.mean(0)))
    wrong = sum(2 * np.sqrt(light) * loss + loss**2 for loss in losses)
    captured = min(1.0, float((light * r).sum()) * 2 * math.pi * edge / _RADII)
    of_maps = _map_error(query, wavelength=rays.wavelength, period=period, captured=captured)
    of_rings = _ring_error(query, wavelength=rays.wavelength, period=period, captured=captured)
    return _SAFETY * float((wrong * r).sum() / (light * r).sum()) + of_maps + of_rings


def paraxial_error(rays: Rays, query: Query) -> float:
    """What dropping the spheres' higher terms costs: the rms of their phase, and of the scale of the pattern.

    1.5 times their sum (a fit: the sum itself is 0.85 of the truth in the median, and 3 times too small at worst). A
    map's phase is moved by up to tau / 2 of its width, which counts like as much of its phase; and where its jumps send
    light to the edge of the window, the kernel's own curvature counts there.
    """
    if not query.paraxial:
        return 0.0
    a, d = float(query.semi_aperture.detach()), float(query.sensor_distance.detach())
    tau = (a / d) ** 2
    kernel = 2 * math.pi / rays.wavelength * a / d * query.half_window  # its phase at the corner of pupil and window
    return 1.5 * (rays.beyond + tau * (1 + map_phase(query) / 2 + 0.1 * kernel * min(1.0, jumps(query))))


def debye_error(query: Query, rays: Rays) -> float:
    """What the Debye map leaves out of Rayleigh-Sommerfeld's kernel, over the light in the window of a query.

        |R - d| + x u / R_0 = x^2 / 2 R_0 + x^2 (x u) / 2 R_0^3 - (x u)^2 / 2 R_0^3 + ...

    At a radius r of the sensor the pupil's rim is thus off by a phase of k a r^2 (r + a) / 2 d^3, and the amplitude by
    r (r + a) / d^2, relatively: nothing on the axis, whatever the f-number, and more the wider the light spreads. The
    field of a round pupil in focus is real: what a adds to it is imaginary then, and counts by its square.
    Integration over the pixels, whose tails end a margin beyond the window, adds 8e-5 of the light there, and up to
    1e-3 where most of it falls outside (a fit).
    """
    d, a = float(query.sensor_distance.detach()), float(query.semi_aperture.detach())
    edge = query.pixel_pitch * max(query.shape) / 2 * math.sqrt(4 / math.pi)  # of a disc as large as the window
    share = ((np.arange(_RADII) + 0.5) / _RADII) ** 2  # a core in focus is far smaller than the window
    r = share * edge
    ring = r * np.sqrt(share)
    light = _light(query, rays, r)
    phase = math.pi / rays.wavelength * a * r**2 / d**3
    aside = phase * a + r * a / d**2
    if query.lens.round and not query.has_pixel_phase:
        aside = aside * np.minimum(1.0, aside + rays.phase)
    wrong = np.minimum(2.0, phase * r + r**2 / d**2 + aside)
    captured = min(1.0, 4 * math.pi * edge / _RADII * float((light * ring).sum()))
    margin = min(1e-3, 8e-5 / captured) if query.grid.integrate else 0.0
    return margin + float((wrong * light * ring).sum() / (light * ring).sum())


def _light(query: Query, rays: Rays, r: np.ndarray) -> np.ndarray:
    """Irradiance at radii on the sensor, roughly: what the path spreads, and the tail that the rim diffracts."""
    d, a = float(query.sensor_distance.detach()), float(query.semi_aperture.detach())
    airy = rays.wavelength * d / (2 * a)
    blur = max(math.sqrt(2) * rays.rms, query.lens.pixel_phase_displacement(query.wavelengths), airy / 2)
    spread = np.where(r < blur, 1 / (math.pi * blur**2), 0.0)
    if query.scatter is not None:
        frequency = np.linspace(0, 1.01, 4 * _RADII) * r[-1] * a / (rays.wavelength * d)
        beyond = np.array([float(query.scatter.share(f).max()) for f in frequency])
        radii = frequency * rays.wavelength * d / a
        density = -np.diff(beyond) / (math.pi * np.diff(radii**2))
        spread = spread + np.interp(r, (radii[1:] + radii[:-1]) / 2, density)
    beyond_rays = np.maximum(r - rays.rim.max(), 0)
    tail = airy * a * query.lens.rim_per_area() / (2 * math.pi**3)
    return spread + tail / ((r + airy / 2) * (beyond_rays**2 + airy**2))


def _cell_response(frequency: np.ndarray) -> np.ndarray:
    """What the area of a cell, 1 / FINE samples wide, leaves of a frequency in cycles per sample."""
    return np.sinc(frequency / FINE)


def _from_rim(distance: np.ndarray, r: np.ndarray, airy: float) -> np.ndarray:
    """Irradiance of one side of the rim, averaged over its fringes and finite where the ray itself lands."""
    return airy / (2 * math.pi**3) / ((distance**2 + airy**2 / 4) * (r + airy / 2))


def _ring_error(query: Query, *, wavelength: float, period: float, captured: float) -> float:
    """What the structure of the radius scatters beyond the period, folded back: 2 Re(u* du) of the field in the window.

    Its power spreads over the period's square; 400 times that (a fit), for it leaves out the outermost rings, which may
    be the finest.
    """
    if query.scatter is None:
        return 0.0
    scale = float(query.semi_aperture.detach()) / (wavelength * float(query.sensor_distance.detach()))
    share = float(query.scatter.share((period - query.half_window) * scale).max())
    folded = 400 * share * min(1.0, 2 * query.half_window / period) ** 2 / captured
    return 2 * min(1.0, math.sqrt(folded))


def ring_turns(query: Query) -> float:
    """The rms by which the phase turns from one panel of the radius to the next [rad]; 0 without rings."""
    if query.scatter is None:
        return 0.0
    edges, widths = query.panels, query.panels.diff()
    slopes = radial_phase(query)(edges).diff(dim=-1) / widths
    return float((slopes.diff(dim=-1) * torch.minimum(widths[1:], widths[:-1])).square().mean(-1).max().sqrt())


def _map_error(query: Query, *, wavelength: float, period: float, captured: float) -> float:
    """What maps of flat pixels cost: the rim cuts their pixels in cells of a finite size, and their low-pass droops.

    The first is a fit: it goes by the length of the rim for the light that passes, is 3 times as much where cells are
    pixels, so that none takes light over from another, and weighs more where little is captured. The droop is averaged
    over a window that the light fills, and weighted by 0.3, for most light falls short of that.
    """
    found = query.lens.pixel_maps(query.wavelengths)
    if not found:
        return 0.0
    cut, discs = 0.0, query.lens.aperture.discs()
    if discs:
        spacing = wavelength * float((query.sensor_distance / query.semi_aperture).detach()) / period
        pixel = min(2 * half_width / count for count, half_width in sizes(query, found))
        per_pixel = math.ceil(pixel * query.how.cells_per_sample / spacing)
        rim = sum(radius for radius, _ in discs) / sum(weight * radius**2 for radius, weight in discs)
        cut = 4e-4 * rim * {1: 3.0, 2: 1.6}.get(per_pixel, 1.0) / captured ** (1 / 3)
    r = (np.arange(_RADII) + 0.5) / _RADII
    frequency = r * query.half_window / period
    droop = np.abs(1 - map_response(frequency) ** 2) + map_response(1 - frequency) ** 2
    return cut + 0.3 * float((droop * r).sum() / r.sum())


def jumps(query: Query) -> float:
    """The rms step between neighbouring pixels of the phase maps, wrapped [rad]."""
    total = 0.0
    for pixels in query.lens.pixel_maps(query.wavelengths):
        if pixels.factors is not None and pixels.values.shape[-1] > 1:
            total += float(torch.cat([step.flatten() for step in pixels.steps()]).square().mean())
    return math.sqrt(total)


def map_phase(query: Query) -> float:
    """The rms of what the phase maps add, unwrapped as they are given [rad]."""
    total = 0.0
    for pixels in query.lens.pixel_maps(query.wavelengths):
        if pixels.factors is not None:
            total += float(pixels.largest_phase().var(correction=0))
    return math.sqrt(total)
