"""PSFs of a batch of lenses in one call, for augmentations that draw a lens per sample."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from numbers import Integral

import numpy as np
import scipy
import torch
from torch import Tensor

from kcam.inputs import as_values, describe
from kcam.optics.autograd import once_differentiable
from kcam.optics.elements.zernike import zernike_sum
from kcam.optics.numerics import lagrange, legendre, phasor
from kcam.optics.propagation import sampling
from kcam.optics.propagation.intensity import pupil_intensity
from kcam.optics.propagation.pixels import Pixels
from kcam.optics.propagation.radial import KEPT, even_between, hankel_kernel
from kcam.optics.propagation.transforms import MatrixTransform
from kcam.optics.pupil.coordinates import Pupil, grid_nodes, grid_spacing
from kcam.optics.pupil.quadrants import split
from kcam.optics.pupil.rim import disc_weights
from kcam.units import check_pixel_pitch, check_positive, wavelength_grid

_STEP = math.pi / 24  # of t in the table of J0: |U|^2 by cubic interpolation is then good to 1e-4 of its fringes
_PROFILE_STEPS = 16  # of the profile for each of its fringes; cubic between them
_TAPS = range(-1, 3)  # of a cubic
_MOST_FRINGES = 2**20


def batch_psf(
    vergences: Tensor,
    *,
    radii: Tensor,
    coefficients: Tensor | None = None,
    wavelengths: Tensor | list[float],
    sensor_distance: Tensor | float,
    pixel_pitch: float,
    shape: tuple[int, int],
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """PSFs of a batch of ideal round lenses, each with its own defocus, aperture and aberrations.

    W = V r^2 / 2 + sum_j c_j Z_j(r / a), propagated paraxially; c_j is the same at all wavelengths. No module is built
    per sample: an augmentation draws these numbers and calls this once.

    Args:
        vergences: residual V, (B,), (B, Z), or (B, Z, L) where it depends on the wavelength, as the power of a lens of
            glass does [1/m]; 0 is in focus, 1/z - 1/z_focus for an object at z.
        radii: semi-apertures a, (B,) [m], > 0.
        coefficients: (B, K) of Noll's Zernikes j = 1..K [m RMS], or None.
        wavelengths: (L,) [m]. sensor_distance: d, a number or (B,) [m]. pixel_pitch: [m]. shape: (H, W) pixels.
    Returns:   (B, Z, L, H, W) energy in each pixel relative to what passes the aperture; Z is 1 for vergences (B,).
               Differentiable in vergences, radii, coefficients and sensor_distance.
    Raises:    ValueError for shapes that do not fit, radii or distances that are not > 0, a pupil grid beyond the
        limit.
    Valid in the paraxial range: 1 % where w4 = a^4 / (8 d^3 lambda) is below 0.005 waves.
    Source:    equation (3.4), and Noll, J. Opt. Soc. Am. 66, 207 (1976).

    Example:
    >>> psf = optics.batch_psf(torch.tensor([0.0, 0.3]), radii=torch.tensor([2.5, 2.5]) * mm, wavelengths=[550 * nm],
    ...                        sensor_distance=50 * mm, pixel_pitch=4 * um, shape=(33, 33))
    >>> psf.shape, bool((psf.sum((-2, -1)) > 0.97).all())  # all light but the tails
    (torch.Size([2, 1, 1, 33, 33]), True)
    """
    grid = wavelength_grid(wavelengths)
    check_pixel_pitch(pixel_pitch)
    check_positive(radii, name="radii")
    check_positive(sensor_distance, name="sensor_distance")
    given = as_values(vergences, name="vergences", unit="1/m")
    if given.ndim not in (1, 2, 3) or not bool(given.isfinite().all()):
        raise ValueError(
            f"vergences must be finite, (B,), (B, Z) or (B, Z, {grid.numel()}) [1/m], got {describe(given)}"
            f"{'' if given.ndim in (1, 2, 3) else '. Use torch.tensor([0.0]) for one lens in focus'}."
        )
    if not isinstance(shape, Sequence) or len(shape) != 2 or not all(isinstance(n, Integral) and n >= 1 for n in shape):
        raise ValueError(f"shape must be two positive integers (H, W) in pixels, got {shape!r}. Use shape=(65, 65).")
    device = given.device
    residual = given.to(torch.float64)
    residual = residual[:, None] if residual.ndim == 1 else residual
    residual = residual[..., None] if residual.ndim == 2 else residual  # (B, Z, 1 or L)
    batch, layers = residual.shape[:2]
    if residual.ndim != 3 or residual.shape[2] not in (1, grid.numel()):
        raise ValueError(
            f"vergences must be (B,), (B, Z) or (B, Z, {grid.numel()}), one per wavelength, got {tuple(given.shape)}."
        )
    a, d = (
        _one_each(value, batch, name=name).to(device)
        for name, value in (("radii", radii), ("sensor_distance", sensor_distance))
    )
    if coefficients is not None:
        coefficients = as_values(coefficients, name="coefficients", unit="m RMS")
    if coefficients is not None and (coefficients.ndim != 2 or coefficients.shape[0] != batch):
        raise ValueError(f"coefficients must be (B, K) with B = {batch}, got {tuple(coefficients.shape)}.")
    if batch == 0:
        return residual.new_zeros(0, layers, grid.numel(), *shape, dtype=dtype)
    if coefficients is None:
        return _radial_bank(residual, a=a, d=d, grid=grid, pixel_pitch=pixel_pitch, shape=shape, dtype=dtype)

    terms = coefficients.shape[1]
    # OPD as coefficients of rho^2 and of the Zernikes, (B, 1 or L, Z, T)
    opd = (residual.transpose(1, 2) * a[:, None, None] ** 2 / 2)[..., None]
    own = coefficients.to(device, torch.float64)[:, None, None].expand(-1, opd.shape[1], layers, -1)
    opd = torch.cat([opd, own], dim=-1)
    with torch.no_grad():
        down, across = ((opd @ slope.to(device)).square() for slope in _zernike_slopes(terms))
        displacement = (down + across).sqrt().amax(dim=(1, 2, 3)) * d / a
    # lens by lens: a slow lens needs a smaller pupil and fewer points than the fastest of the batch
    images = [
        _aberrated(
            opd[b], a=a[b], d=d[b], displacement=float(displacement[b]), grid=grid, pixel_pitch=pixel_pitch,
            shape=shape, dtype=dtype,
        )
        for b in range(batch)
    ]  # fmt: skip
    return torch.stack(images)


def _one_each(value: Tensor | float, batch: int, *, name: str) -> Tensor:
    """One number for all lenses, or one for each, (B,) float64."""
    values = as_values(value, name=name, unit="m").to(torch.float64)
    if values.shape not in ((), (1,), (batch,)):
        raise ValueError(f"{name} must be a number or ({batch},), one per lens, got shape {tuple(values.shape)}.")
    return values.expand(batch)


def _aberrated(
    opd: Tensor,
    *,
    a: Tensor,
    d: Tensor,
    displacement: float,
    grid: Tensor,
    pixel_pitch: float,
    shape: tuple[int, int],
    dtype: torch.dtype,
) -> Tensor:
    """PSFs (Z, L, H, W) of one lens by matrix products; opd (1 or L, Z, T), displacement: of its rays [m]."""
    device = opd.device
    shortest = float(grid.min())
    margin = max(shape) // 2 + sampling.WINDOW_MARGIN
    count = sampling.pupil_samples(
        semi_aperture=float(a.detach()),
        sensor_distance=float(d.detach()),
        wavelength=shortest,
        half_window=margin * pixel_pitch,
        displacement=displacement,
    )
    if count > sampling.MAX_PUPIL_SAMPLES:
        raise ValueError(
            f"this batch needs {count} pupil samples, more than {sampling.MAX_PUPIL_SAMPLES}: the largest blur "
            f"reaches {displacement * 1e3:.3g} mm. Use smaller radii, vergences or shape."
        )
    per_pixel = sampling.points_per_pixel(
        pixel_pitch=pixel_pitch,
        semi_aperture=float(a.detach()),
        sensor_distance=float(d.detach()),
        wavelength=shortest,
    )
    reach, step = math.ceil(per_pixel * margin), pixel_pitch / per_pixel
    count = _rounded(count)
    nodes = grid_nodes(count)
    like = torch.empty(0, dtype=dtype, device=device)
    wavenumbers = (2 * math.pi / grid).to(device)
    weights = disc_weights(count, spacing=grid_spacing(count)).to(device)
    scales = wavenumbers * (a / d)
    intensity = pupil_intensity(
        (wavenumbers[:, None, None] * opd).to(dtype),
        maps=_pupil_maps(count, opd.shape[-1] - 1, dtype).to(device),
        amplitude=weights[None].to(dtype),
        field=None,
        scales=scales.to(dtype),
        transforms=[
            MatrixTransform.build(nodes, scale=float(s), step=step, reach=reach, like=like) for s in scales.detach()
        ],
        nodes=nodes,
        points=torch.arange(-reach, reach + 1, dtype=torch.float64) * step,
    )
    area = grid_spacing(count) ** 2 / (4 * float(weights.sum()))
    factor = area * (a * pixel_pitch / (grid.to(device) * d)) ** 2  # (L,)
    pixels = Pixels(shape, per_pixel).of_quadrants(intensity)
    return (pixels * factor[:, None, None, None].to(dtype)).transpose(0, 1)


def _zernike_maps(nodes: Tensor, terms: int) -> Tensor:
    """rho^2 and Noll's j = 1..terms on a grid of normalised nodes, (1 + terms, N, N)."""
    one = torch.ones((), dtype=torch.float64)
    pupil = Pupil(nodes[None, :], nodes[:, None], one, one, paraxial=True)
    unit = torch.eye(terms, dtype=torch.float64)
    maps = [pupil.rho2, *(zernike_sum(unit[j], pupil) for j in range(terms))]
    return torch.stack([m.expand(len(nodes), len(nodes)) for m in maps])


@functools.lru_cache(maxsize=8)
@torch.inference_mode(False)
def _zernike_slopes(terms: int) -> tuple[Tensor, Tensor]:
    """Of the maps along y and x, on a coarse grid in the pupil, (1 + terms, n) each."""
    side = torch.linspace(-1, 1, 65, dtype=torch.float64)
    inside = (side[None, :] ** 2 + side[:, None] ** 2 <= 1.0001).flatten()
    down, across = torch.gradient(_zernike_maps(side, terms), spacing=2 / 64, dim=(-2, -1))
    return down.flatten(1)[:, inside], across.flatten(1)[:, inside]


@functools.lru_cache(maxsize=16)  # 13 MB for 15 terms on 448 nodes
@torch.inference_mode(False)
def _pupil_maps(count: int, terms: int, dtype: torch.dtype) -> Tensor:
    return split(_zernike_maps(grid_nodes(count), terms)).to(dtype)


def _radial_bank(
    residual: Tensor,
    *,
    a: Tensor,
    d: Tensor,
    grid: Tensor,
    pixel_pitch: float,
    shape: tuple[int, int],
    dtype: torch.dtype,
) -> Tensor:
    """PSFs (B, Z, L, H, W) of round lenses with nothing but defocus, which need one Hankel transform each.

    U(t) = 2 INT_0^1 exp(i k V a^2 rho^2 / 2) J0(t rho) rho d rho,   I(r) = pi a^2 / (lambda d)^2 |U(k a r / d)|^2

    One table of J0 serves all lenses and wavelengths. What the profile I(r), cubic between steps of r, sends into each
    pixel is a fixed sparse matrix: also one for all.
    """
    wavenumbers = (2 * math.pi / grid).to(residual.device)
    scales = wavenumbers * (a / d)[:, None]  # (B, L): t per metre
    half = max(shape) // 2
    with torch.no_grad():
        fastest = float(scales.max()) * pixel_pitch  # t per pixel
        defocus = float((residual.abs().amax((1, 2)) * a**2).max() * wavenumbers.max())  # of the rim ray, in t
        per_pixel = 2 ** max(3, math.ceil(math.log2(_PROFILE_STEPS * fastest / math.pi)))
        corner = math.sqrt(2) * (half + 0.5)
        nodes, arguments = _rounded((fastest * corner + defocus) / 2 + 32), _rounded(fastest * corner / _STEP + 8)
    if max(nodes, arguments) > _MOST_FRINGES:
        raise ValueError(
            f"this batch needs {max(nodes, arguments)} samples of the pupil and the PSF, more than {_MOST_FRINGES}: it "
            "has that many fringes. Use a smaller shape, larger f-numbers or distances nearer to the focus."
        )
    rim = wavenumbers[:, None] * residual.transpose(1, 2) * (a[:, None, None] ** 2 / 2)  # (B, L, Z)
    intensity = _amplitude(rim, nodes=nodes, arguments=arguments).square().sum(0)  # (B, L, Z, T)
    steps = torch.arange(math.ceil(corner * per_pixel) + 3, dtype=torch.float64, device=residual.device)
    position = scales[..., None] * (steps * (pixel_pitch / per_pixel / _STEP))  # (B, L, R)
    profile = even_between(intensity, position)
    factor = math.pi * (a[:, None] * pixel_pitch / (grid.to(residual.device) * d[:, None])) ** 2
    profile = (profile * factor[..., None, None]).to(dtype)
    octant = torch.sparse.mm(_ring_shares(half, per_pixel, dtype, residual.device), profile.flatten(0, 2).T)
    rows, columns = (torch.arange(-(n // 2), n - n // 2, device=residual.device).abs() for n in shape)
    near, far = torch.minimum(rows[:, None], columns), torch.maximum(rows[:, None], columns)
    bank = octant[(far * (far + 1) // 2 + near).flatten()].T
    return bank.view(*profile.shape[:3], *shape).transpose(1, 2)


def _rounded(count: float) -> int:
    """Up to one of four sizes per octave, so that a few tables serve all draws."""
    step = 2 ** max(4, math.floor(math.log2(count)) - 2)
    return int(step * math.ceil(count / step))


def _amplitude(rim: Tensor, *, nodes: int, arguments: int) -> Tensor:
    """U = 2 INT_0^1 exp(i w rho^2) J0(t rho) rho d rho at t = 0, _STEP, ...: w (...) [rad] at the rim to (2, ..., T).

    By Gauss-Legendre and a table of J0 that is kept, or, where that would be too large, through the projection.
    """
    if nodes * arguments > KEPT:
        return _projected(rim, nodes=nodes, arguments=arguments)
    rho, weights = (torch.as_tensor(value, device=rim.device) for value in legendre(nodes))
    rho = (rho + 1) / 2
    phase = rim[..., None] * rho**2
    field = torch.stack([phase.cos(), phase.sin()]) * (rho * weights)
    return field @ hankel_kernel(rho, arguments, step=_STEP)


def _projected(rim: Tensor, *, nodes: int, arguments: int) -> Tensor:
    """The same by the projection-slice theorem: one FFT for each PSF, however many fringes it has.

    U(t) = 1 / pi INT_-1^1 exp(i t x + i w x^2) 2 E(sqrt(1 - x^2)) dx,   E(Y) = INT_0^Y exp(i w y^2) dy, Fresnel's

    The trapezium rule errs by the 1.5th power of its step, where the disc's projection ends like a root: 1e-6 here.
    """
    count = 2 ** math.ceil(math.log2(max(4 * nodes, 2 * arguments, 2**12) * 2 * math.pi / _STEP / 2))
    step = 2 * math.pi / (_STEP * count)
    half = math.floor(1 / step)
    x = torch.arange(-half, half + 1, dtype=torch.float64, device=rim.device) * step
    chord = torch.sqrt(torch.clamp(1 - x**2, min=0))
    parts = []
    for one in rim.flatten():  # one at a time: each takes megabytes
        phase = one * x**2
        wave = phasor(phase) * _Fresnel.apply(one, chord)
        padded = torch.nn.functional.pad(wave, (0, count - len(x)))
        # the origin of x stands at place `half`: a shift by it is a phase
        shift = torch.arange(arguments, dtype=torch.float64, device=rim.device) * (2 * math.pi * half / count)
        spectrum = torch.fft.ifft(padded)[:arguments] * phasor(-shift)
        parts.append(spectrum * (2 * step * count / math.pi))
    return torch.view_as_real(torch.stack(parts)).movedim(-1, 0).unflatten(1, rim.shape)


class _Fresnel(torch.autograd.Function):
    """E(w, Y) = INT_0^Y exp(i w y^2) dy, with its derivative (Y exp(i w Y^2) - E) / 2 w to w."""

    @staticmethod
    def forward(ctx, rim, chord):
        scale = math.sqrt(2 * max(abs(float(rim)), 1e-12) / math.pi)
        parts = scipy.special.fresnel(chord.cpu().numpy() * scale)
        sine, cosine = (torch.as_tensor(part, device=chord.device) for part in parts)
        result = torch.complex(cosine, sine if rim > 0 else -sine) / scale
        ctx.save_for_backward(rim, chord, result)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx, saved, grad):
        rim, chord, result = saved
        phase = rim * chord**2
        slope = torch.complex(torch.zeros_like(chord), chord**3 / 3)  # its limit in focus
        if abs(float(rim)) > 1e-4:
            slope = (chord * phasor(phase) - result) / (2 * rim)
        return (grad.conj() * slope).real.sum(), None


@functools.lru_cache(maxsize=16)
@torch.inference_mode(False)
def _ring_shares(half: int, per_pixel: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Integral over each pixel (far, near), 0 <= near <= far <= half, of a radial function, cubic between steps.

    Returns:   sparse (pixels, R), pixel far (far + 1) / 2 + near; R steps of 1 / per_pixel pixels. Gauss-Legendre in
    each pixel, exact for the fringes that the steps resolve.
    """
    nodes, weights = np.polynomial.legendre.leggauss(math.ceil(per_pixel * math.pi / (2 * _PROFILE_STEPS)) + 10)
    area = np.outer(weights, weights).ravel() / 4
    rings = math.ceil(math.sqrt(2) * (half + 0.5) * per_pixel) + 3
    pixels, columns, values = [], [], []
    for far in range(half + 1):
        x = (far + nodes / 2) ** 2
        for near in range(far + 1):
            r = np.sqrt(x[:, None] + (near + nodes / 2) ** 2).ravel() * per_pixel
            low = r.astype(np.int64)
            first = low.min() - 1
            width = low.max() + 2 - first + 1
            share = np.zeros(width)
            for tap, weight in zip(_TAPS, lagrange(r - low, taps=_TAPS), strict=True):
                share += np.bincount(low + tap - first, weights=weight * area, minlength=width)
            pixels.append(np.full(width, far * (far + 1) // 2 + near))
            columns.append(np.abs(np.arange(first, first + width)))  # even in r
            values.append(share)
    index = torch.as_tensor(np.stack([np.concatenate(pixels), np.concatenate(columns)]))
    shape = ((half + 1) * (half + 2) // 2, rings)
    with torch.sparse.check_sparse_tensor_invariants(False):  # by this name also torch 2.11 on a GPU does not warn
        found = torch.sparse_coo_tensor(index, torch.as_tensor(np.concatenate(values)), shape)
    return found.coalesce().to(device=device, dtype=dtype)
