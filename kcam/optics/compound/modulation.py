"""The modulation that the pupils of a real lens leave: at any point of the field, in curves and in maps."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcam.inputs import as_values
from kcam.optics.compound.aiming import Asked
from kcam.optics.compound.images import Frame
from kcam.optics.compound.prescription import Prescription
from kcam.optics.compound.pupil import PupilFit, pupils
from kcam.optics.numerics import fast_length, phasor, squared
from kcam.optics.propagation import sampling
from kcam.optics.pupil.rim import opening
from kcam.optics.source import PixelGrid

_RIM = 7  # samples of a grid beyond the pupil's edge, where the edge's low-pass ends
_COARSE = 65  # samples across a pupil that tell how finely it must be sampled
_FEWEST, _FEWEST_OF_MAP = 96, 384  # samples across a pupil for a curve, and for a map, which has no weights at the edge
_PER_FRINGE = 4  # samples across the fastest fringe between two copies of a pupil


def maps(lens: Prescription, asked: Asked, pixels: PixelGrid) -> Tensor:
    """|OTF| / OTF(0) of each point and wavelength, (F, Z, L, H, W): see `CompoundLens.mtf`."""
    fitted = pupils(lens, asked.wavelengths, asked.vergences, asked.heights)
    node = torch.arange(len(fitted.centre)).view(len(asked.heights), len(asked.vergences), -1)
    found = [
        _map(fitted, int(node[f, z, k]), direction, wavelength, pixels)
        for f, direction in enumerate(asked.directions)
        for z in range(len(asked.vergences))
        for k, wavelength in enumerate(asked.wavelengths.tolist())
    ]
    modulation = torch.stack(found).view(*node.shape, *pixels.shape)
    if pixels.integrate:
        rows, columns = (torch.sinc((torch.arange(n, dtype=torch.float64) - n // 2) / n) for n in pixels.shape)
        modulation = modulation * rows[:, None] * columns
    return modulation.to(pixels.dtype)


def curves(lens: Prescription, asked: Asked, frequencies: Tensor | Sequence[float]) -> Tensor:
    """MTF of all wavelengths together, sagittal and tangential, (F, 2, K): see `CompoundLens.modulation`."""
    lines = as_values(frequencies, name="frequencies", unit="cycles per metre").to("cpu", torch.float64).reshape(-1)
    if not bool((lines.isfinite() & (lines >= 0)).all()):
        raise ValueError(
            f"frequencies must be finite and >= 0 cycles per metre, got {lines.tolist()}. 30 line pairs per mm are "
            "30 / mm."
        )
    fitted = pupils(lens, torch.cat([asked.wavelengths, lens.focus_line]), asked.vergences, asked.heights)
    node = torch.arange(len(fitted.centre)).view(len(asked.heights), -1)
    found = []
    for own in node:
        offsets = fitted.chief[own[:-1]] - fitted.chief[own[-1]]
        parts = [
            _transfer(fitted, int(index), lines, wavelength=wavelength)
            # lateral colour moves the light of a wavelength along the meridian
            * torch.stack([torch.ones_like(lines) + 0j, phasor(-2 * math.pi * lines * offset)])
            for index, wavelength, offset in zip(own, asked.wavelengths.tolist(), offsets, strict=False)
        ]
        found.append(torch.stack(parts).mean(0))
    # a floor far below rounding: no NaN gradient at the zeros of an MTF
    return torch.sqrt(squared(torch.stack(found)) + torch.finfo(torch.float64).tiny)


def _open_part(fitted: PupilFit, node: int) -> tuple[float, float]:
    """Half the width of the square around what is open, and dy of its middle."""
    frame = Frame.upright(fitted.one(node))
    return float(frame.half), float(frame.middle[0, 1])


def _slopes(fitted: PupilFit, node: int) -> tuple[float, float]:
    """Largest distance of a ray from the chief ray [m], and the largest change of it with direction [m]."""
    half, middle = _open_part(fitted, node)
    side = torch.linspace(-half, half, _COARSE, dtype=torch.float64)
    with torch.no_grad():
        path, q = fitted.at(node, side[None, :], middle + side[:, None])
        first = torch.gradient(path, spacing=float(side[1] - side[0]))
        second = [part for one in first for part in torch.gradient(one, spacing=float(side[1] - side[0]))]
        inside = (q > 0).all(0)
        return tuple(  # type: ignore[return-value]
            float(torch.where(inside, torch.stack(tuple(parts)).square().sum(0).sqrt(), 0.0).max())
            for parts in (first, second)
        )


def _check_count(count: int, spread: float) -> None:
    """ValueError for more samples across a pupil than fit."""
    if count > sampling.MAX_PUPIL_SAMPLES:
        raise ValueError(
            f"this MTF needs {count} pupil samples (blur {spread * 1e3:.3g} mm), more than "
            f"{sampling.MAX_PUPIL_SAMPLES}. Use lower frequencies, a smaller field or a distance nearer to the focus."
        )


def _transfer(fitted: PupilFit, node: int, frequencies: Tensor, *, wavelength: float) -> Tensor:
    """OTF of one node, complex (2, K), about its own chief ray: sagittal, and tangential.

    OTF(f) = integral of P(p + lambda f / 2) P*(p - lambda f / 2) dp / integral of |P|^2,   P = exp(2 pi i W / lambda)

    over direction cosines, where both copies of the pupil are open: edges get quadrature weights, as for a PSF.

    Args: frequencies: (K,) [cycles per metre]. wavelength: [m].
    Raises: ValueError for a blur that takes too many samples.
    """
    spread, bend = _slopes(fitted, node)
    reach, middle = _open_part(fitted, node)

    def overlap(frequency: float, axis: int) -> Tensor:
        shift = wavelength * frequency / 2
        fringes = 2 * reach * min(frequency * bend, 2 * spread / wavelength)
        count = max(_FEWEST, 32 * math.ceil(_PER_FRINGE * fringes / 32))
        _check_count(count, spread)
        spacing = 2 * reach / (count - 2 * _RIM)
        counts, to = [count, count], [0.0, 0.0]
        counts[axis], to[axis] = math.ceil(count - 2 * shift / spacing), shift
        if counts[axis] <= 2 * _RIM:  # the copies lie beside each other
            return fitted.wavefront.new_zeros((), dtype=torch.complex128)
        x, y = (_centred(n, spacing) for n in counts)
        (ahead, q), (behind, other) = (
            fitted.at(node, (x + sign * to[0])[None, :], (middle + y + sign * to[1])[:, None]) for sign in (1, -1)
        )
        weights = opening(torch.minimum(q, other)[None])[0]
        return (weights * phasor(2 * math.pi / wavelength * (ahead - behind))).sum() * spacing**2

    whole = overlap(0.0, 0).real
    return (
        torch.stack([torch.stack([overlap(frequency, axis) for frequency in frequencies.tolist()]) for axis in (0, 1)])
        / whole
    )


def _centred(count: int, spacing: float) -> Tensor:
    """So many points about 0, (count,)."""
    return (torch.arange(count, dtype=torch.float64) + 0.5 - count / 2) * spacing


def _map(fitted: PupilFit, node: int, direction: Tensor, wavelength: float, pixels: PixelGrid) -> Tensor:
    """|OTF| / OTF(0) of one node at frequencies k / (n pitch) on the sensor's axes, (H, W), 0 at index n // 2.

    The autocorrelation of its pupil, by FFT, on a grid whose spacing divides lambda / (n pitch).

    Args: direction: in which the point's image lies on the sensor (2,).
    Raises: ValueError for a blur that takes too many samples.
    """
    shape, pitch = pixels.shape, pixels.pitch
    spread, _ = _slopes(fitted, node)
    reach, at_middle = _open_part(fitted, node)
    window = max(shape) * pitch / 2
    fringes = 2 * reach * (spread + window) / wavelength
    count = max(_FEWEST_OF_MAP, 32 * math.ceil(sampling.KAPPA * fringes / 32))
    _check_count(count, spread)
    widest = 2 * reach / (count - 2 * _RIM)
    every = [math.ceil(wavelength / (n * pitch) / widest) for n in shape]  # samples for one step in frequency
    spacing = [wavelength / (n * pitch * steps) for n, steps in zip(shape, every, strict=True)]
    counts = [math.ceil(2 * reach / step) + 2 * _RIM for step in spacing]
    middle = at_middle * direction.flip(0)
    y, x = (at + _centred(n, step) for at, n, step in zip(middle.tolist(), counts, spacing, strict=True))
    across = x[None, :] * direction[1] - y[:, None] * direction[0]
    along = x[None, :] * direction[0] + y[:, None] * direction[1]
    path, q = fitted.at(node, across, along)
    field = phasor(2 * math.pi / wavelength * path) * opening(q[None])[0]
    shifts = [(torch.arange(n) - n // 2) * steps for n, steps in zip(shape, every, strict=True)]
    lengths = [fast_length(n + min(n, int(-part[0]))) for n, part in zip(counts, shifts, strict=True)]
    otf = torch.fft.ifft2(squared(torch.fft.fft2(field, s=lengths)))
    rows, columns = (part % length for part, length in zip(shifts, lengths, strict=True))
    # a floor far below the transform's own rounding: no NaN gradient at the zeros of an MTF
    modulation = torch.sqrt(squared(otf[rows[:, None], columns[None, :]]) + torch.finfo(torch.float64).tiny)
    overlap = [part.abs() < n for part, n in zip(shifts, counts, strict=True)]  # beyond, the shift wraps around
    return torch.where(overlap[0][:, None] & overlap[1][None, :], modulation / otf[0, 0].real, 0.0)
