"""The reference: the non-paraxial PSF in float64, which checks its own convergence before it speaks.

Polar quadrature for smooth pupils; for maps of flat pixels a fine Cartesian grid, on which the rim is cut from cells
much smaller than the map's pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy
import torch
from torch import Tensor

from kcam.optics.propagation.grid import grid_psf, matrix_cost
from kcam.optics.propagation.polar import polar_psf
from kcam.optics.propagation.question import Query, Sampling
from kcam.optics.propagation.row import PRODUCTS, Propagator
from kcam.optics.source import Points

_KAPPA = 4.5
_CELLS_PER_SAMPLE = 6.8
_SPOTS = 9  # points on each axis, spread over the window, at which the sampling is doubled
SMOOTH_LIMIT = 1e-7  # of what doubling the sampling may change, as a share of the mean light in the window
PIXELS_LIMIT = 3e-4  # likewise for maps of flat pixels, whose rim is cut by area


@dataclass(frozen=True)
class Convergence:
    """How far the reference is from itself at twice its sampling, and from a closed form of its own aperture.

    Both are mean absolute differences at points spread over the window, relative to the mean light in it.
    """

    doubled: float
    closed_form: float
    limit: float

    @property
    def reached(self) -> bool:
        """Whether both are within the limit."""
        return max(self.doubled, self.closed_form) <= self.limit


def reference_psf(query: Query) -> Tensor:
    """The non-paraxial PSF, (Z, L, H, W) in the query's dtype, computed in float64; slow by design.

    Raises: ValueError as `checked_psf`. Not checked while gradients are recorded.
    """
    answer = _evaluate(_refined(query), doubling=1)
    return (answer if answer.requires_grad else checked_psf(query, answer)[0]).to(query.dtype)


def checked_psf(query: Query, answer: Tensor | None = None) -> tuple[Tensor, Convergence]:
    """The reference's PSF in float64, and how well it is converged.

    Args:   answer: the PSF if it was computed already.
    Raises: ValueError where doubling its own sampling changes it by more than 1e-7 (smooth pupils) or 3e-4 (maps of
            flat pixels) of the mean light, so that it is no reference.
    """
    measured = convergence(query)
    if not measured.reached:
        raise ValueError(
            f"the reference is not converged here: twice its sampling changes it by {measured.doubled:.1e}, a closed "
            f"form by {measured.closed_form:.1e} of the light (at most {measured.limit:.0e}). Use a smaller shape, or "
            "distances nearer to the focus, so that the default sampling suffices."
        )
    return _evaluate(_refined(query), doubling=1) if answer is None else answer, measured


def _refined(query: Query) -> Query:
    cells = max(query.how.cells_per_sample, _CELLS_PER_SAMPLE)
    how = Sampling(max(query.how.kappa, _KAPPA), cells_per_sample=cells, curved_kernel=True)
    return replace(query.on(dtype=torch.float64), how=how)


def _evaluate(query: Query, *, doubling: int) -> Tensor:
    if query.lens.round and not query.has_pixels:
        return polar_psf(query, density=doubling)
    how = query.how
    query = query.sampled(kappa=doubling * how.kappa, cells_per_sample=doubling * how.cells_per_sample)
    return grid_psf(query, method="matrix")


def convergence(query: Query) -> Convergence:
    """Measure the reference at the shortest wavelength of a query, at 9 x 9 points spread over its window."""
    with torch.no_grad():
        half = max(query.half_pixels, 1)
        pitch = query.pixel_pitch * half / (_SPOTS // 2)
        refined = _refined(query).on(pitch=pitch, shape=(_SPOTS, _SPOTS), integrate=False)
        points = replace(query.points, vergences=query.vergences.detach())
        spots = replace(refined, wavelengths=query.wavelengths.min()[None], points=points)
        own, doubled = _evaluate(spots, doubling=1), _evaluate(spots, doubling=2)
        difference = float(((own - doubled).abs().mean((-2, -1)) / doubled.mean((-2, -1))).max())
        return Convergence(difference, _closed_form_error(spots), _limit(query))


def _limit(query: Query) -> float:
    return PIXELS_LIMIT if query.has_pixels else SMOOTH_LIMIT


def _closed_form_error(spots: Query) -> float:
    """The aperture alone, in a wave that converges on the sensor, paraxial, against its Fourier transform."""
    a, d = float(spots.semi_aperture.detach()), float(spots.sensor_distance.detach())
    focused = spots.vergences.new_full((1,), -1 / d)
    alone = spots.lens.aperture_alone(pixels=101 if spots.lens.has_pixel_phase else None)
    bare = replace(spots, lens=alone, paraxial=True, points=Points(focused))
    points = (np.arange(_SPOTS) - _SPOTS // 2) * spots.pixel_pitch
    frequency = points / (float(spots.wavelengths[0]) * d)  # cycles per metre of pupil
    discs = spots.lens.aperture.discs()
    if discs:
        v = 2 * math.pi * a * np.hypot(frequency[:, None], frequency)
        amplitude = sum(w * math.pi * (r * a) ** 2 * _jinc(r * v) for r, w in discs)
        energy = sum(w * math.pi * (r * a) ** 2 for r, w in discs)
    else:
        values = spots.aperture_pixels().detach().double().cpu().numpy()
        side = 2 * a / values.shape[-1]
        centres = (np.arange(values.shape[-1]) + 0.5) * side - a
        along = np.exp(-2j * math.pi * frequency[:, None] * centres) * np.sinc(frequency * side)[:, None] * side
        amplitude = along @ values @ along.T
        energy = (values**2).sum() * side**2
    truth = np.abs(amplitude) ** 2 * (spots.pixel_pitch / (float(spots.wavelengths[0]) * d)) ** 2 / energy
    own = _evaluate(bare, doubling=1)[0, 0].cpu().numpy()
    return float(np.abs(own - truth).mean() / truth.mean())


def _jinc(v: np.ndarray) -> np.ndarray:
    """2 J1(v) / v."""
    safe = np.where(v == 0, 1, v)
    return np.where(v == 0, 1.0, 2 * scipy.special.j1(safe) / safe)


REFERENCE = Propagator(
    "reference",
    "quadrature",
    function=reference_psf,
    error=_limit,
    cost=lambda query: 1e3 * matrix_cost(query),
    rate=PRODUCTS,
    about="polar quadrature in float64, slow by design; a fine grid for flat pixels",
)
