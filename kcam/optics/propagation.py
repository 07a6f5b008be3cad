"""The propagators: one table of rows, each a thin module over one function, with its range, error and cost.

`propagator` names the physics and `method` the transform. To add a row, write a function from `Query` to (Z, L, H, W)
and a row; contract tests, the default choice and the documentation iterate over the table.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from kcam.optics import sampling
from kcam.optics.psf import Query, grid_psf, ray_displacement, residual_path, samples_by_rule, to_pixels
from kcam.optics.pupil import Pupil, disc_weights, from_image_side, unfold_quadrant
from kcam.optics.transforms import fast_length

_TABLE_STEP = math.pi / 12  # of the Hankel table; eight-point interpolation is then good to 2e-8
_REFERENCE_KAPPA = 4.5
_PANEL = 512  # nodes that one Gauss-Legendre rule has at most: they are eigenvalues, at the cost of n^3
_MOST_RINGS = 2**20
_RINGS_AT_ONCE = 2**24  # entries of the Hankel table: 128 MB
_FFT_SLOWNESS = 10.0  # operations of a matrix product in the time of one of an FFT, measured on a CPU in float32


# ---- rotationally symmetric pupils -------------------------------------------------------------------------------


def radial_psf(query: Query) -> Tensor:
    """PSFs of a rotationally symmetric pupil by one Hankel transform, U(t) = 2 pi INT A exp(ikW) J0(t rho) rho d rho.

    Gauss-Legendre nodes from rim to rim, so that the edge is exact; J0 is tabulated over t = k a' r / d, in which all
    wavelengths and distances share one table, and U is interpolated onto the pixels' radii by eight points.
    """
    wavelengths = query.wavelengths.to(query.device)
    a, d = query.image_side_semi_aperture, query.sensor_distance
    scales = 2 * math.pi / wavelengths * a / d
    largest = float(scales.detach().max())
    displacement = float(ray_displacement(query).max())
    corner = math.sqrt(2) * query.half_window
    count = math.ceil(largest * (corner + displacement) / 2) + 32
    rho, weights = _ring_nodes(query, count)

    x, y = from_image_side(rho, torch.zeros_like(rho), query.tau)
    pupil = query.pupil(x, y)
    coefficients, maps = residual_path(query, pupil)
    phase = 2 * math.pi / wavelengths[:, None, None] * (coefficients @ maps)  # (L, Z, n)
    amplitude, energy = _ring_amplitude(query, pupil, rho * weights)
    field = torch.stack([phase.cos(), phase.sin()]) * amplitude  # (2, L, Z, n)

    t = torch.arange(math.ceil(largest * corner / _TABLE_STEP) + 8, dtype=torch.float64, device=query.device)
    parts = [part.split(max(1, _RINGS_AT_ONCE // t.numel()), dim=-1) for part in (field, rho)]
    if len(parts[1]) == 1:
        transformed = _hankel(field, t, rho)
    else:  # the table of each part is built again in the backward pass, not kept
        transformed = sum(checkpoint(_hankel, f, t, r, use_reentrant=False) for f, r in zip(*parts, strict=True))

    bands = []
    for index, wavelength in enumerate(query.wavelengths.tolist()):
        arguments = (transformed[:, index], scales[index], query, wavelength)
        image = (
            checkpoint(_ring_image, *arguments, use_reentrant=False)
            if transformed.requires_grad
            else (_ring_image(*arguments))
        )
        factor = (a * query.pixel_pitch / (wavelengths[index] * d)) ** 2 / energy
        bands.append(image * factor[:, None, None].to(query.dtype))
    return torch.stack(bands, dim=1)


def _hankel(field: Tensor, t: Tensor, rho: Tensor) -> Tensor:
    """2 pi SUM field J0(t rho) at the table's arguments: (..., n) -> (..., T)."""
    return 2 * math.pi * field @ _BesselJ0.apply(t[:, None] * _TABLE_STEP * rho).T


class _BesselJ0(torch.autograd.Function):
    """J0 with its derivative -J1, which torch.special leaves out without a word."""

    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return torch.special.bessel_j0(x)

    @staticmethod
    def backward(ctx, grad):
        (x,) = ctx.saved_tensors
        return -grad * torch.special.bessel_j1(x)


def _ring_nodes(query: Query, count: int) -> tuple[Tensor, Tensor]:
    """Gauss-Legendre nodes and weights over the open part of the radius, image-side coordinates."""
    if count > _MOST_RINGS:
        raise ValueError(
            f"this PSF needs {count} rings of the pupil, more than {_MOST_RINGS}: rays at the rim of the lens are sent "
            "too far beyond the window. Use a smaller aperture or a larger radius of curvature."
        )
    nodes, weights = (torch.as_tensor(v, device=query.device) for v in _legendre(count))
    discs = query.lens.aperture.discs()
    inner = discs[1][0] if len(discs) > 1 else 0.0
    if inner:
        inner = inner * torch.sqrt((1 + query.tau) / (1 + query.tau * inner**2))
    return inner + (1 - inner) * (nodes + 1) / 2, weights * (1 - inner) / 2


@functools.lru_cache(maxsize=16)
def _legendre(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights on [-1, 1]: one rule, or panels of one rule that together resolve as much."""
    panels = math.ceil(count / _PANEL)
    order = count if panels == 1 else math.ceil(count / panels) + 32
    nodes, weights = np.polynomial.legendre.leggauss(order)
    centres = (2 * np.arange(panels) + 1) / panels - 1
    return (centres[:, None] + nodes / panels).ravel(), np.tile(weights / panels, panels)


def _ring_amplitude(query: Query, pupil: Pupil, quadrature: Tensor) -> tuple[Tensor, Tensor]:
    """Amplitude times quadrature (1 or Z, n), and the energy that passes in units of a'^2, (1 or Z,)."""
    amplitude = energy = quadrature[None]
    if not query.paraxial:
        falloff = 1 / (1 + query.vergences[:, None] ** 2 * pupil.rho2 * query.semi_aperture**2)
        amplitude = quadrature * pupil.measure * torch.sqrt(falloff)
        energy = quadrature * pupil.measure**2 * falloff
    return amplitude, 2 * math.pi * energy.sum(-1)


def _ring_image(transformed: Tensor, scale: Tensor, query: Query, wavelength: float) -> Tensor:
    """Intensity on the pixels from the tabulated transform (2, Z, T) of one wavelength."""
    per_pixel, reach = query.evaluation_grid(wavelength)
    radii2, inverse = _lattice(reach, query.device)
    position = scale * torch.sqrt(radii2) * (query.pixel_pitch / per_pixel) / _TABLE_STEP
    low = torch.clamp(position.detach().floor().long() - 3, max=transformed.shape[-1] - 8)
    offset = position - low
    value = 0.0
    for tap, weight in enumerate(_lagrange(offset)):
        value = value + weight * transformed[..., torch.abs(low + tap)]  # U is even in t
    intensity = value.square().sum(0).to(query.dtype)  # (Z, radii)
    quadrant = intensity[:, inverse].view(-1, reach + 1, reach + 1)
    right = torch.cat([quadrant[..., 1:].flip(-1), quadrant], dim=-1)
    return to_pixels(torch.cat([right[..., 1:, :].flip(-2), right], dim=-2), query, per_pixel=per_pixel, reach=reach)


@functools.lru_cache(maxsize=8)
def _lattice(reach: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Distinct squared radii of the grid points in one quadrant, and where each point finds its own."""
    squares = torch.arange(reach + 1, device=device) ** 2
    distinct, inverse = torch.unique(squares[:, None] + squares, return_inverse=True)
    return distinct.to(torch.float64), inverse.flatten()


def _lagrange(offset: Tensor, points: int = 8) -> list[Tensor]:
    """Weights of the Lagrange polynomial through 0..points-1 at `offset`."""
    weights = []
    for tap in range(points):
        weight = torch.ones_like(offset)
        for other in range(points):
            if other != tap:
                weight = weight * (offset - other) / (tap - other)
        weights.append(weight)
    return weights


# ---- a second opinion: propagating the field itself ---------------------------------------------------------------


def angular_spectrum_psf(query: Query) -> Tensor:
    """PSFs by the band-limited angular spectrum of the field behind the lens, which must sample the converging wave.

    H = exp(i k d (sqrt(1 - lambda^2 f^2) - 1)), zero where the sampled H would alias. The spectrum is summed straight
    onto the evaluation points, so that the grid behind the lens need not fit the pixels.
    Source: Goodman, Introduction to Fourier Optics, angular spectrum; Matsushima and Shimobaba, Opt. Express 17, 19662
        (2009).
    """
    a, d = float(query.semi_aperture.detach()), float(query.sensor_distance.detach())
    displacement = ray_displacement(query)
    bands = []
    for index, wavelength in enumerate(query.wavelengths.tolist()):
        spread = float(displacement[index])
        # from the rim light goes to the far edge of the window, and a little further: its cycles per metre in the grid
        across = a + max(query.half_window, spread) + 10 * wavelength * d / (2 * a)
        steepest = across / math.hypot(across, d) / wavelength
        pitch = 1 / (2.2 * steepest)
        # beyond the rays the rim diffracts light into tails, which must not wrap around into the window
        tails = 50 * wavelength * d / (2 * a)
        count = fast_length(math.ceil(1.25 * (2 * a + 2 * max(query.half_window, spread) + 2 * tails) / pitch))
        count += count % 2
        if count > 8192:
            raise ValueError(
                f"angular_spectrum needs a grid of {count} at {wavelength * 1e9:.4g} nm to sample the wave that "
                f"converges from {2 * a * 1e3:g} mm; use propagator='nonparaxial', which samples the residual only."
            )
        bands.append(_spectrum_band(query, index, count=count, pitch=pitch))
    return torch.stack(bands, dim=1)


def _spectrum_band(query: Query, index: int, *, count: int, pitch: float) -> Tensor:
    wavelength = query.wavelengths[index].to(query.device)
    wavenumber = 2 * math.pi / wavelength
    a, d = query.semi_aperture, query.sensor_distance
    axis = (torch.arange(count, dtype=torch.float64, device=query.device) - count // 2 + 0.5) * pitch
    pupil = query.pupil(axis[None, :] / a, axis[:, None] / a)
    one = replace(query, wavelengths=query.wavelengths[index : index + 1])
    coefficients, maps = residual_path(one, pupil)
    r2 = pupil.rho2 * a**2
    converging = r2 / (d * (1 + torch.sqrt(1 + r2 / d**2)))  # sqrt(d^2 + r^2) - d without cancellation
    phase = wavenumber * (torch.einsum("zt,tvu->zvu", coefficients[0], maps) - converging)

    transmission, power = _point_transmission(query, pupil, pitch=pitch, count=count)
    falloff = 1 / (1 + query.vergences[:, None, None] ** 2 * r2)
    field = torch.complex(phase.cos(), phase.sin()) * (transmission * torch.sqrt(falloff))
    for element in query.lens.elements:
        pixels = element.pixel_map(one.wavelengths.to(query.device))
        if pixels is not None and pixels.factors is not None:
            angle = pixels.factors * _lookup(pixels.values.to(a), pixels.half_width, axis, a)
            field = field * torch.complex(angle.cos(), angle.sin())
    energy = (power * falloff).sum((-2, -1)) * pitch**2

    frequency = torch.fft.fftfreq(count, pitch, dtype=torch.float64, device=query.device)
    sine2 = wavelength**2 * (frequency[:, None] ** 2 + frequency**2)
    travel = -wavenumber * d * sine2 / (1 + torch.sqrt(torch.clamp(1 - sine2, min=0)))
    limit = 1 / (wavelength * torch.sqrt((2 * d.detach() / (count * pitch)) ** 2 + 1))
    inside = (frequency.abs() <= limit)[:, None] & (frequency.abs() <= limit) & (sine2 < 1)
    transfer = torch.complex(travel.cos(), travel.sin()) * inside

    complex_dtype = torch.complex128 if query.dtype == torch.float64 else torch.complex64
    spectrum = torch.fft.fft2(field.to(complex_dtype)) * transfer.to(complex_dtype)
    per_pixel, reach = query.evaluation_grid(float(wavelength))
    points = torch.arange(-reach, reach + 1, dtype=torch.float64, device=query.device) * query.pixel_pitch / per_pixel
    angle = 2 * math.pi * frequency * (points[:, None] - axis[0])
    kernel = torch.complex(angle.cos(), angle.sin()).to(complex_dtype) / count
    sensor = kernel @ spectrum @ kernel.T
    intensity = sensor.real.square() + sensor.imag.square()
    factor = query.pixel_pitch**2 / energy
    return to_pixels(intensity, query, per_pixel=per_pixel, reach=reach) * factor[:, None, None].to(query.dtype)


def _point_transmission(query: Query, pupil: Pupil, *, pitch: float, count: int) -> tuple[Tensor, Tensor]:
    """Amplitude and power that the aperture passes on the true pupil plane: edge weights of discs, a look-up in
    maps.
    """
    aperture, a = query.lens.aperture, float(query.semi_aperture.detach())
    if not aperture.discs():
        mask = aperture.pixel_map(query.wavelengths)
        inside = (pupil.x.abs() <= 1) & (pupil.y.abs() <= 1)
        values = _lookup(mask.values.to(pupil.rho2), None, pupil.x[0] * a, query.semi_aperture) * inside
        return values, values**2
    half = min(count // 2, math.ceil(a / pitch) + 8)
    quadrant = sum(w * disc_weights(2 * half, spacing=pitch / a, radius=r) for r, w in aperture.discs())
    margin = count // 2 - half
    weights = nn.functional.pad(unfold_quadrant(quadrant).to(query.device), (margin, margin, margin, margin))
    return weights, weights


def _lookup(values: Tensor, half_width, axis: Tensor, semi_aperture: Tensor) -> Tensor:
    """Value of the flat pixel under each grid point; the outermost pixels continue."""
    n = values.shape[-1]
    width = semi_aperture if half_width is None else half_width
    cell = torch.clamp(((axis / width + 1) / 2 * n).detach().floor().long(), 0, n - 1)
    return values[cell][:, cell]


# ---- rays ----------------------------------------------------------------------------------------------------------


def geometric_psf(query: Query) -> Tensor:
    """PSFs by rays: each pupil sample lands at x = d grad W and is shared among its four nearest pixels.

    Source: the geometrical limit of equation (3.4) by stationary phase.
    """
    displacement = float(ray_displacement(query).max())
    count = min(1024, max(256, 32 * math.ceil(4 * displacement / query.pixel_pitch / 32)))
    half = count // 2
    spacing = 2.0 / count
    axis = (torch.arange(count, dtype=torch.float64, device=query.device) + 0.5 - half) * spacing
    with torch.enable_grad():
        x = axis[None, :].expand(count, count).clone().requires_grad_()
        y = axis[:, None].expand(count, count).clone().requires_grad_()
        pupil = query.pupil(x, y)
        coefficients, maps = residual_path(query, pupil)
        slopes = [torch.autograd.grad(m.sum(), (x, y), create_graph=True, allow_unused=True) for m in maps]
    slopes_x, slopes_y = (torch.stack([torch.zeros_like(x) if s[i] is None else s[i] for s in slopes]) for i in (0, 1))
    if query.lens.round:
        quadrant = sum(w * disc_weights(count, spacing=spacing, radius=r) for r, w in query.lens.aperture.discs())
        power = unfold_quadrant(quadrant).to(query.device)
    else:
        mask = query.lens.aperture.pixel_map(query.wavelengths).values.to(axis)
        power = _lookup(mask, None, axis * query.semi_aperture, query.semi_aperture) ** 2
    power = power.expand(query.vergences.numel(), count, count)
    if not query.paraxial:
        power = power / (1 + query.vergences[:, None, None] ** 2 * pupil.rho2.detach() * query.semi_aperture**2)
    power = power / power.sum((-2, -1), keepdim=True)
    scale = query.sensor_distance / query.semi_aperture / query.pixel_pitch
    bands = []
    for coefficient in coefficients:
        column = torch.einsum("zt,tvu->zvu", coefficient, slopes_x) * scale + query.shape[1] // 2
        row = torch.einsum("zt,tvu->zvu", coefficient, slopes_y) * scale + query.shape[0] // 2
        bands.append(_splat(power, row, column, query.shape))
    images = torch.stack(bands, dim=1).to(query.dtype)
    # the rays' own coordinates carry a graph; the result does only where something else in the path has a gradient
    centre = torch.zeros(1, dtype=torch.float64, device=query.device)
    trained = any(part.requires_grad for part in residual_path(query, query.pupil(centre, centre)))
    return images if trained else images.detach()


def _splat(power: Tensor, row: Tensor, column: Tensor, shape: tuple[int, int]) -> Tensor:
    """Add each ray's power to its four nearest pixels, (Z, N, N) -> (Z, H, W)."""
    distances = power.shape[0]
    image = power.new_zeros(distances, shape[0] * shape[1])
    low_row, low_column = row.detach().floor(), column.detach().floor()
    for dr in (0, 1):
        for dc in (0, 1):
            r, c = low_row + dr, low_column + dc
            weight = (1 - (row - r).abs()) * (1 - (column - c).abs()) * power
            inside = (r >= 0) & (r < shape[0]) & (c >= 0) & (c < shape[1])
            target = (r.clamp(0, shape[0] - 1) * shape[1] + c.clamp(0, shape[1] - 1)).long()
            image = image.scatter_add(1, target.flatten(1), (weight * inside).flatten(1))
    return image.view(distances, *shape)


# ---- the reference -------------------------------------------------------------------------------------------------


def reference_psf(query: Query) -> Tensor:
    """The non-paraxial PSF in float64: polar quadrature for smooth pupils, a fine Cartesian grid for pixel maps.

    Slow by design: Gauss-Legendre in radius times a trapezium in angle has no edge error and converges spectrally.
    """
    dtype = query.dtype
    query = replace(query, dtype=torch.float64, kappa=max(query.kappa, _REFERENCE_KAPPA), samples=None)
    if not query.lens.round or query.lens.has_pixel_phase:
        return grid_psf(query, method="matrix").to(dtype)
    wavelengths = query.wavelengths.to(query.device)
    a, d = query.image_side_semi_aperture, query.sensor_distance
    displacement = ray_displacement(query)
    bands = []
    for index, wavelength in enumerate(query.wavelengths.tolist()):
        scale = 2 * math.pi / wavelengths[index] * a / d
        fringes = float(scale.detach()) * (math.sqrt(2) * query.half_window + float(displacement[index]))
        rho, weights = _ring_nodes(query, math.ceil(0.75 * fringes) + 48)
        angles = 2 * math.ceil(1.2 * fringes + 32)
        theta = torch.arange(angles, dtype=torch.float64, device=query.device) * (2 * math.pi / angles)
        xi, eta = (rho[:, None] * theta.cos()).flatten(), (rho[:, None] * theta.sin()).flatten()
        x, y = from_image_side(xi, eta, query.tau)
        pupil = query.pupil(x, y)
        quadrature = (rho * weights)[:, None].expand(-1, angles).flatten() / angles
        coefficients, maps = residual_path(replace(query, wavelengths=query.wavelengths[index : index + 1]), pupil)
        phase = 2 * math.pi / wavelengths[index] * (coefficients[0] @ maps)
        amplitude, energy = _ring_amplitude(query, pupil, quadrature)
        field = torch.complex(phase.cos(), phase.sin()) * amplitude * 2 * math.pi
        per_pixel, reach = query.evaluation_grid(wavelength)
        points = torch.arange(-reach, reach + 1, dtype=torch.float64, device=query.device)
        points = points * (query.pixel_pitch / per_pixel) * scale
        image = sum(_direct_sums(field, points, xi, eta))
        factor = (a * query.pixel_pitch / (wavelengths[index] * d)) ** 2 / energy
        bands.append(to_pixels(image, query, per_pixel=per_pixel, reach=reach) * factor[:, None, None])
    return torch.stack(bands, dim=1).to(dtype)


def _direct_sums(field: Tensor, points: Tensor, xi: Tensor, eta: Tensor) -> tuple[Tensor, Tensor]:
    """Re^2 and Im^2 of sum_p field_p exp(-i (x xi_p + y eta_p)) at all pairs of points."""
    total = field.new_zeros(field.shape[0], points.numel(), points.numel())
    for part in torch.arange(xi.numel(), device=xi.device).split(16_384):
        along_x, along_y = points[:, None] * xi[part], points[:, None] * eta[part]
        kernel_x = torch.complex(along_x.cos(), -along_x.sin())
        kernel_y = torch.complex(along_y.cos(), -along_y.sin())
        total = total + (kernel_y * field[:, None, part]) @ kernel_x.T
    return total.real.square(), total.imag.square()


# ---- the table -----------------------------------------------------------------------------------------------------


class Propagator(nn.Module):
    """A row of the table: a function from `Query` to PSFs, with its range, error estimate and cost.

    Args:
        physics: what the user names as `propagator`. method: what the user names as `method`.
        function: Query -> (Z, L, H, W). paraxial: the model drops what spheres have beyond their parabolas.
        valid: returns why the row cannot answer a query, or None.
        error: estimated L1 error of the PSF against Rayleigh-Sommerfeld. cost: floating-point operations.
        exact: whether only sampling separates the row from its physics, so that it may be chosen by cost alone.
    """

    def __init__(
        self,
        physics: str,
        method: str,
        *,
        function: Callable[[Query], Tensor],
        error: Callable[[Query], float],
        cost: Callable[[Query], float],
        valid: Callable[[Query], str | None],
        paraxial: bool = False,
        exact: bool = True,
    ) -> None:
        super().__init__()
        self.physics, self.method, self.paraxial, self.exact = physics, method, paraxial, exact
        self.function, self.error_of, self.cost_of, self.valid_for = function, error, cost, valid

    def forward(self, query: Query) -> Tensor:
        """(Z, L, H, W) energy in each pixel relative to what passes the aperture.

        Raises: ValueError where the row is not valid for this query.
        """
        query = replace(query, paraxial=self.paraxial)
        reason = self.valid_for(query)
        if reason is not None:
            raise ValueError(f"{self.physics}/{self.method} {reason}")
        return self.function(query)

    def error(self, query: Query) -> float:
        """Estimated L1 error before anything is computed."""
        return self.error_of(replace(query, paraxial=self.paraxial))

    def cost(self, query: Query) -> float:
        """Estimated floating-point operations, weighted by how fast the row's kind of work runs."""
        return self.cost_of(replace(query, paraxial=self.paraxial))


def wave_front_error(query: Query) -> float:
    """w4 = a^4 / (8 d^3 lambda): waves that a converging sphere has beyond its parabola, the Fresnel model's
    measure.
    """
    a, d = float(query.semi_aperture.detach()), float(query.sensor_distance.detach())
    return a**4 / (8 * d**3 * float(query.wavelengths.min()))


def _sampling_error(query: Query) -> float:
    """Worst L1 error of a Cartesian grid at the query's kappa, 10^(0.5 - 1.31 kappa), down to a floor for float32.

    Fitted to the worst of 36 configurations in the numerics note, section 5.1 (3.5e-2 at kappa 1.5, 9e-5 at 3.5).
    """
    kappa = query.kappa
    if query.samples is not None:
        displacement = ray_displacement(query)
        kappa = min(
            sampling.kappa_of(
                query.samples,
                semi_aperture=float(query.image_side_semi_aperture.detach()),
                sensor_distance=float(query.sensor_distance.detach()),
                wavelength=wavelength,
                half_window=query.half_window,
                displacement=float(displacement[index]),
            )
            for index, wavelength in enumerate(query.wavelengths.tolist())
        )
    return max(10 ** (0.5 - 1.31 * kappa), 1e-12 if query.dtype == torch.float64 else 1e-6)


def _model_error(query: Query) -> float:
    """3 w4 for the paraxial model, 0.013 w4 with the Debye map (numerics note, section 3)."""
    return min(2.0, (3.0 if query.paraxial else 0.013) * wave_front_error(query))


def _map_error(query: Query) -> float:
    """What flat pixels add where their jumps are large: curved edges taken in blocks, and cells cut by the rim.

    The worst of white noise of 6 radians on 101..301 pixels at f/10 and f/5 (tests/optics/test_physics.py).
    """
    if not query.lens.has_pixel_phase:
        return 0.0
    return 1.5e-3 if query.paraxial else 4e-3


def _spectrum_error(query: Query) -> float:
    """3e-3 for smooth pupils; a pixel map is looked up at the grid's points, and white noise is then off by 0.2."""
    return 3e-3 + _model_error(query) + (0.25 if query.lens.has_pixel_phase else 0.0)


def _grid_error(query: Query) -> float:
    return min(2.0, _sampling_error(query) + _model_error(query) + _map_error(query))


def _grid_sizes(query: Query) -> list[tuple[int, int]]:
    """(pupil samples, points) of each wavelength, also where so many would be refused: a cost is no refusal."""
    displacement = ray_displacement(query).tolist()
    return [
        (
            query.samples or samples_by_rule(query, displacement=displacement[index], wavelength=wavelength),
            2 * query.evaluation_grid(wavelength)[1] + 1,
        )
        for index, wavelength in enumerate(query.wavelengths.tolist())
    ]


def _matrix_cost(query: Query) -> float:
    return query.vergences.numel() * sum(2 * m * n * (n + m) + 24 * n * n for n, m in _grid_sizes(query))


def _chirp_z_cost(query: Query) -> float:
    total = 0.0
    for n, m in _grid_sizes(query):
        length = fast_length(n + m)
        total += _FFT_SLOWNESS * 10 * (n + m) * length * math.log2(length)
    return query.vergences.numel() * total


def _fft_cost(query: Query) -> float:
    total = 0.0
    for n, m in _grid_sizes(query):
        length = max(2 * n, m)
        total += _FFT_SLOWNESS * 10 * length**2 * math.log2(length)
        if query.lens.has_pixel_phase:
            total += (
                1e9  # the pupil grid scales with the wavelength, and each grid needs weights of its own for the map
            )
    return query.vergences.numel() * total


def _radial_cost(query: Query) -> float:
    return query.vergences.numel() * sum(40.0 * m * m for _, m in _grid_sizes(query))


def _always(query: Query) -> str | None:
    return None


def _needs_fine_points(query: Query) -> str | None:
    """An FFT as long as its pupil has bins lambda d / 2a apart; coarser points would fold the pupil onto itself."""
    finest = (
        float(query.wavelengths.min())
        * float(query.sensor_distance.detach())
        / (2 * float(query.image_side_semi_aperture.detach()))
    )
    if query.integrate or query.pixel_pitch < 0.9 * finest:
        return None
    return (
        f"cannot place its bins on points {query.pixel_pitch:g} m apart (needs less than {0.9 * finest:.3g} m); use "
        "method='matrix', or integrate over the pixels."
    )


def _needs_symmetry(query: Query) -> str | None:
    if query.lens.symmetric:
        return None
    names = sorted({type(element).__name__ for element in query.lens.elements if not element.symmetric})
    return f"needs a lens of rotationally symmetric elements, but has {', '.join(names)}; use method='matrix'."


def _needs_smooth_path(query: Query) -> str | None:
    if query.lens.has_pixel_phase:
        return "has no rays for a DOE of flat pixels, whose slope is 0 or infinite; use propagator='nonparaxial'."
    return None


def _geometric_error(query: Query) -> float:
    """0.6 W^(-1/3) for W waves of path over the pupil (numerics note, section 5.5), and below one wave no agreement."""
    a, d = float(query.semi_aperture.detach()), float(query.sensor_distance.detach())
    waves = float(ray_displacement(query).max()) / d * a / 2 / float(query.wavelengths.max())
    return 0.6 * waves ** (-1 / 3) if waves > 1 else 2.0


def _rows() -> dict[tuple[str, str], Propagator]:
    rows = []
    for physics, paraxial in (("nonparaxial", False), ("fresnel", True)):
        for method, cost in (("matrix", _matrix_cost), ("chirp_z", _chirp_z_cost), ("fft", _fft_cost)):
            rows.append(
                Propagator(
                    physics,
                    method,
                    function=_grid_function(method),
                    error=_grid_error,
                    cost=cost,
                    valid=_needs_fine_points if method == "fft" else _always,
                    paraxial=paraxial,
                )
            )
        rows.append(
            Propagator(
                physics,
                "radial",
                function=radial_psf,
                error=lambda q: 1e-6 + _model_error(q),
                cost=_radial_cost,
                valid=_needs_symmetry,
                paraxial=paraxial,
            )
        )
    rows.append(
        Propagator(
            "angular_spectrum",
            "fft",
            function=angular_spectrum_psf,
            error=_spectrum_error,
            cost=_fft_cost,
            valid=_always,
        )
    )
    rows.append(
        Propagator(
            "geometric",
            "rays",
            function=geometric_psf,
            error=_geometric_error,
            cost=_radial_cost,
            valid=_needs_smooth_path,
            exact=False,
        )
    )
    rows.append(
        Propagator(
            "reference",
            "quadrature",
            function=reference_psf,
            error=lambda q: 1e-9 + _model_error(q) + _map_error(q),
            cost=lambda q: 1e3 * _matrix_cost(q),
            valid=_always,
        )
    )
    return {(row.physics, row.method): row for row in rows}


def _grid_function(method: str) -> Callable[[Query], Tensor]:
    def compute(query: Query) -> Tensor:
        return grid_psf(query, method=method)

    return compute


PROPAGATORS = _rows()
PHYSICS = tuple(dict.fromkeys(physics for physics, _ in PROPAGATORS))


def choose(query: Query, *, propagator: str = "nonparaxial", method: str | None = None) -> Propagator:
    """The row that answers a query: the method named, or the cheapest exact one that is valid.

    Raises: ValueError for an unknown propagator or method, listing the known ones.
    """
    if propagator not in PHYSICS:
        raise ValueError(f"unknown propagator {propagator!r}; known: {', '.join(PHYSICS)}.")
    rows = [row for (physics, _), row in PROPAGATORS.items() if physics == propagator]
    if method is not None:
        for row in rows:
            if row.method == method:
                return row
        raise ValueError(f"{propagator} has no method {method!r}; known: {', '.join(row.method for row in rows)}.")
    valid = [row for row in rows if row.valid_for(query) is None] or rows
    return valid[0] if len(valid) == 1 else min(valid, key=lambda row: row.cost(query))
