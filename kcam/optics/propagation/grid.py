"""PSFs by a transform of a Cartesian pupil grid: a matrix product, a chirp-z transform or an FFT."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from torch import Tensor

from kcam.optics.numerics import fast_length
from kcam.optics.propagation import sampling
from kcam.optics.propagation.cells import Cells
from kcam.optics.propagation.curved import Curvature, CurvedTransform, mean_slope
from kcam.optics.propagation.estimates import ROUNDING, grid_error, paraxial_error, trace
from kcam.optics.propagation.intensity import pupil_intensity
from kcam.optics.propagation.lines import lines
from kcam.optics.propagation.question import Query, residual_amplitude, residual_path
from kcam.optics.propagation.row import FFT_SLOWNESS, PRODUCTS, Propagator
from kcam.optics.propagation.transforms import ChirpZTransform, FFTTransform, MatrixTransform, Transform
from kcam.optics.pupil.coordinates import EDGE_MARGIN, from_image_side, grid_nodes, grid_spacing, to_image_side
from kcam.optics.pupil.rim import round_weights
from kcam.optics.pupil.warp import Warp

_GROUP_NUMBERS = 2**26  # pupils and images that wavelengths computed together may hold: 256 MB in float32
_MAP_SETUP, _SETUP = 2e5, 1e4  # operations for each pupil sample of a new grid, of weights that bring a map of pixels
# onto it, and of paths alone where the grid is larger than a processor's cache; measured on a CPU


def grid_psf(query: Query, *, method: str) -> Tensor:
    """PSFs by a transform of a Cartesian pupil grid: `matrix`, `chirp_z` or `fft`; (Z, L, H, W)."""
    bands: list[Tensor] = [torch.empty(0)] * query.wavelengths.numel()
    for members, count, per_pixel in _groups(query, method=method):
        images = _grid_group(query, members, count=count, per_pixel=per_pixel, method=method)
        for index, image in zip(members, images.unbind(0), strict=True):
            bands[index] = image
    return torch.stack(bands, dim=1)


def samples_by_rule(query: Query, index: int) -> int:
    """Pupil samples for a wavelength of a query by the rule of `sampling.pupil_samples`, however many."""
    needed = sampling.pupil_samples(**_geometry(query, index), kappa=query.how.kappa)
    if query.has_pixels:  # few distinct grids: each needs weights of its own for the map
        step = max(64, 2 ** (needed.bit_length() - 4))
        needed = step * math.ceil(needed / step)
    return needed


def sample_counts(query: Query) -> list[int]:
    """Pupil samples for each wavelength, as given or by the rule, also where so many would be refused."""
    key = f"samples, {query.paraxial}"
    if key not in query.kept:
        query.kept[key] = [
            query.how.samples or samples_by_rule(query, index) for index in range(len(query.wavelengths))
        ]
    found: list[int] = query.kept[key]
    return found


def _geometry(query: Query, index: int) -> dict[str, float]:
    key = f"geometry, {query.paraxial}"
    if key not in query.kept:  # a number at a time costs more than all that is done with it
        (a, d), half_window = query.scale, query.half_window
        query.kept[key] = [
            {
                "semi_aperture": a,
                "sensor_distance": d,
                "wavelength": wavelength,
                "half_window": half_window,
                "displacement": displacement,
            }
            for wavelength, displacement in zip(query.wavelengths.tolist(), query.displacement.tolist(), strict=True)
        ]
    found: dict[str, float] = query.kept[key][index]
    return found


def _checked_samples(query: Query, index: int) -> int:
    """Pupil samples for a wavelength: the rule's, or the user's after a check that no replica enters the window.

    Raises: ValueError with the sampling that would do.
    """
    geometry, needed = _geometry(query, index), samples_by_rule(query, index)
    if query.how.samples is None:
        if needed > sampling.MAX_PUPIL_SAMPLES:
            raise ValueError(
                f"this PSF needs {needed} pupil samples at {geometry['wavelength'] * 1e9:.4g} nm (blur "
                f"{geometry['displacement'] * 1e3:.3g} mm, window {2 * query.half_window * 1e3:.3g} mm), more than "
                f"the limit of {sampling.MAX_PUPIL_SAMPLES}. Use a smaller shape, method='radial', or "
                "propagator='geometric'."
            )
        return needed
    if sampling.kappa_of(query.how.samples, **geometry) <= 1:
        raise ValueError(
            f"a pupil of {query.how.samples} samples is too coarse at {geometry['wavelength'] * 1e9:.4g} nm: its "
            f"replicas would enter the window. Use samples >= {needed}, or leave samples out."
        )
    return query.how.samples + query.how.samples % 2


def _groups(query: Query, *, method: str) -> Iterator[tuple[list[int], int, float]]:
    """Wavelengths that share a grid: (their indices, pupil samples, points per pixel)."""
    groups: dict[tuple[int, float, int], list[int]] = {}
    for index, wavelength in enumerate(query.wavelengths.tolist()):
        count = _checked_samples(query, index)
        own_grid = index if method == "fft" else -1  # its pupil grid scales with the wavelength
        groups.setdefault((count, query.evaluation_grid(wavelength)[0], own_grid), []).append(index)
    for (count, per_pixel, _), members in groups.items():
        points = 2 * math.ceil(per_pixel * query.half_pixels) + 1
        each = 2 * count**2 + 3 * query.vergences.numel() * points**2  # numbers held for each wavelength
        length = max(1, _GROUP_NUMBERS // each)
        for first in range(0, len(members), length):
            yield members[first : first + length], count, per_pixel


def _grid_group(query: Query, members: list[int], *, count: int, per_pixel: float, method: str) -> Tensor:
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
        count, length, spacing = _fft_grid(query, members[0])
    nodes = grid_nodes(count, spacing=spacing)

    def straight(scale: float) -> Transform:
        if method == "fft":
            return FFTTransform(count, length, reach)
        build = MatrixTransform.build if method == "matrix" else ChirpZTransform.build
        return build(nodes, scale=scale * slope, step=step, reach=reach, like=like)

    kernels = [straight(float(scale)) for scale in scales.detach()]
    if curved:
        kernels = _curve(query, kernels, scales, nodes, step=step, reach=reach, like=like)

    along = nodes[count // 2 :].to(query.device)
    x, y = along[None, :], along[:, None]
    pupil = query.pupil(*((x, y) if curved else from_image_side(x, y, query.tau)))
    seen = pupil if query.even else pupil.mirrored()
    coefficients, maps = residual_path(replace(query, wavelengths=query.wavelengths[members]), seen)
    amplitude = residual_amplitude(query, pupil, curved=curved)
    cell_area = (semi_aperture * spacing) ** 2
    cells = Cells.of(query, wavelengths, count=count, spacing=spacing)
    if cells is None:
        weights = _disc_weights(query, count=count, spacing=spacing)
        energy = 4 * (weights * amplitude**2).sum((-2, -1)) * cell_area
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
    return query.how.curved_kernel and query.has_pixels and not query.paraxial


def _fft_grid(query: Query, index: int) -> tuple[int, int, float]:
    """(pupil samples, length, spacing) for a wavelength: of the FFT whose bins fall on the points.

    Raises:    ValueError for points so coarse that no length is long enough.
    """
    wavelength, displacement = float(query.wavelengths[index]), float(query.displacement[index])
    per_pixel, reach = query.evaluation_grid(wavelength)
    step = query.pixel_pitch / per_pixel
    semi_aperture, distance = query.scale
    if _curved(query):
        semi_aperture = float(query.semi_aperture.detach()) * mean_slope(float(query.tau.detach()))
    shortest = max(math.ceil(2 * query.how.kappa * (query.half_window + displacement) / step), 2 * reach + 1)
    scale_step = 2 * math.pi * semi_aperture * step / (wavelength * distance)
    length = fast_length(shortest)
    if scale_step >= math.pi:
        raise ValueError(f"an FFT {_too_coarse(query, math.pi / scale_step * step)}")
    while True:
        spacing = 2 * math.pi / (length * scale_step)
        count = 2 * math.ceil(1 / spacing + EDGE_MARGIN)
        if count <= length:
            return count, length, spacing
        length = fast_length(count)  # a longer transform has finer samples, and so more of them


def _disc_weights(query: Query, *, count: int, spacing: float) -> Tensor:
    """Quadrature weights of an aperture made of discs, for x, y > 0."""

    def rims(tau: float) -> Tensor:
        discs = ((to_image_side(radius, tau), weight) for radius, weight in query.lens.aperture.discs())
        return round_weights(tuple(discs), count, spacing=spacing)

    return _following(query.tau.cpu(), rims, spacing=spacing).to(query.device)


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
    round = query.lens.round
    return Warp.build(count, spacing=spacing, tau=tau, round=round, dtype=query.dtype, device=query.device)


def _error(query: Query, *, method: str) -> float:
    semi_aperture, distance = query.scale
    worst = 0.0
    for rays in trace(query):
        index = int((query.wavelengths - rays.wavelength).abs().argmin())
        if method == "fft":
            _, length, _ = _fft_grid(query, index)
            period = length * query.pixel_pitch / query.evaluation_grid(rays.wavelength)[0]
        else:
            count = query.how.samples or samples_by_rule(query, index)
            period = rays.wavelength * distance * (count - 2 * EDGE_MARGIN) / (2 * semi_aperture)
        rounding = ROUNDING[query.dtype] * (5 if method == "fft" else 1)
        error = grid_error(query, rays, period=period) + paraxial_error(rays, query)
        worst = max(worst, rounding + error)
    return min(2.0, worst)


def matrix_cost(query: Query) -> float:
    """Operations of two matrix products for each PSF, and of 24 for each of its pupil samples."""
    return query.vergences.numel() * sum(2 * m * n * (n + m) + 24 * n * n for n, m in _sizes(query))


def _chirp_z_cost(query: Query) -> float:
    return query.vergences.numel() * sum(_chirp_z_operations(n + m) for n, m in _sizes(query))


@functools.lru_cache(maxsize=1024)
def _chirp_z_operations(points: int) -> float:
    length = fast_length(points)
    return FFT_SLOWNESS * 10 * points * length * math.log2(length)


def _fft_cost(query: Query) -> float:
    # its grid scales with the wavelength, and each grid needs paths and weights of its own
    total, setup = 0.0, _MAP_SETUP if query.has_pixels else _SETUP
    for n, m in _sizes(query):
        length = max(2 * n, m)
        total += FFT_SLOWNESS * 10 * length**2 * math.log2(length) + setup * n**2
    return query.vergences.numel() * total


def _sizes(query: Query) -> Iterator[tuple[int, int]]:
    """(pupil samples, points) on each axis, for each wavelength."""
    return zip(sample_counts(query), query.points_per_axis, strict=True)


def _needs_fine_points(query: Query) -> str | None:
    """An FFT as long as its pupil has bins lambda d / 2a apart; coarser points would fold the pupil onto itself.

    And bins that fall on the points ask for up to twice the samples of other transforms.
    """
    semi_aperture, distance = query.scale
    finest = float(query.wavelengths.min()) * distance / (2 * semi_aperture)
    if query.grid.integrate or query.pixel_pitch < 0.9 * finest:
        count = max((_fft_grid(query, index)[0] for index in range(len(query.wavelengths))), default=0)
        if count <= sampling.MAX_PUPIL_SAMPLES:
            return None
        return (
            f"needs {count} pupil samples for bins that fall on the points, more than the limit of "
            f"{sampling.MAX_PUPIL_SAMPLES}; use method='matrix' or a smaller shape."
        )
    return _too_coarse(query, 0.9 * finest)


def _too_coarse(query: Query, finest: float) -> str:
    return (
        f"cannot place its bins on points {query.pixel_pitch:g} m apart (needs less than {finest:.3g} m); use "
        "method='matrix', or integrate over the pixels."
    )


def _row(
    method: str, *, cost: Callable[[Query], float], about: str, valid: Callable[[Query], str | None] | None = None
) -> Propagator:
    return Propagator(
        "nonparaxial",
        method,
        function=lambda query: grid_psf(query, method=method),
        error=lambda query: _error(query, method=method),
        cost=cost,
        rate=PRODUCTS,
        valid=valid,
        on_grid=method != "fft",
        lines=lines,
        about=about,
    )


MATRIX = _row("matrix", cost=matrix_cost, about="split matrix triple product")
CHIRP_Z = _row("chirp_z", cost=_chirp_z_cost, about="Bluestein's FFTs onto the pixels")
FFT = _row("fft", cost=_fft_cost, about="one FFT on a grid scaled to the pixels", valid=_needs_fine_points)
