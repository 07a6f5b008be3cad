"""What a PSF will be computed with, how wrong it is expected to be, and what else could answer: a value that prints."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from kcam.optics.propagation.estimates import trace
from kcam.optics.propagation.grid import sample_counts
from kcam.optics.propagation.question import Query
from kcam.optics.propagation.row import Propagator
from kcam.optics.propagation.table import PROPAGATORS, choose
from kcam.optics.source import Points


@dataclass(frozen=True)
class Candidate:
    """A row of the table for this query: its error and cost, or why it cannot answer.

    cost: in units of the chosen row's. refusal: None where the row is valid.
    """

    propagator: str
    method: str
    error: float
    cost: float
    refusal: str | None


@dataclass(frozen=True)
class Explanation:
    """The answer of `Lens.explain`; `print` it.

    propagator, method: the row chosen. samples: fewest and most across the pupil over the wavelengths, None without a
    grid. points_per_pixel: on each axis, likewise. error: estimated L1 error of the worst PSF against the reference.
    model_error: estimated L1 error of the reference against Rayleigh-Sommerfeld, over this window.
    wavelengths (L',) [m], distances (Z',) [m], energy (Z', L'): share of the light that the window captures, computed
    at the shortest and longest wavelength, at the nearest, farthest and best focused distance.
    candidates: every row of the table.
    """

    propagator: str
    method: str
    samples: tuple[int, int] | None
    points_per_pixel: tuple[float, float]
    shape: tuple[int, int]
    pixel_pitch: float
    error: float
    model_error: float
    wavelengths: Tensor
    distances: Tensor
    energy: Tensor
    candidates: tuple[Candidate, ...]

    def __str__(self) -> str:
        height, width = self.shape
        grid = "no grid" if self.samples is None else f"{_span(*self.samples)} samples across the pupil"
        least = int(self.energy.argmin())
        row, column = divmod(least, self.energy.shape[1])
        where = f"{self.wavelengths[column] * 1e9:.0f} nm, {float(self.distances[row]):.4g} m"
        lines = [
            f"{self.propagator}/{self.method} on {height} x {width} pixels of {self.pixel_pitch * 1e6:.3g} um",
            f"  sampling         {grid}, {_span(*self.points_per_pixel)} points per pixel and axis",
            f"  estimated error  {self.error:.1e} (L1 of the worst PSF, against the reference)",
            f"  model            {self.model_error:.1e} (of the reference, against Rayleigh-Sommerfeld)",
            f"  captured energy  {_span(*(round(float(e), 4) for e in self.energy.aminmax()))} (least at {where})",
            "",
            f"  {'row':<26}{'error':>9}{'cost':>9}",
        ]
        for other in self.candidates:
            name = f"{other.propagator}/{other.method}"
            mark = ">" if (other.propagator, other.method) == (self.propagator, self.method) else " "
            if other.refusal is None:
                lines.append(f"{mark} {name:<26}{other.error:>9.1e}{other.cost:>9.3g}")
            else:
                lines.append(f"{mark} {name:<26}  {_short(other.refusal)}")
        return "\n".join(lines)


def _span(low: float, high: float) -> str:
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _short(reason: str) -> str:
    first = reason.split(";")[0]
    return first if len(first) <= 68 else first[:67] + "\u2026"


def explain_query(
    query: Query, *, propagator: str | Propagator = "nonparaxial", method: str | None = None
) -> Explanation:
    """Choose the row for a query and say what is to be expected of it; computes few PSFs, for the captured energy.

    Raises: ValueError as `choose`, and as the row itself where it cannot answer.
    """
    chosen = choose(query, propagator=propagator, method=method)
    rays = trace(query)
    wavelengths = torch.tensor(sorted({ray.wavelength for ray in rays}), dtype=torch.float64)
    vergences = torch.tensor(sorted({ray.vergence for ray in rays}, reverse=True), dtype=torch.float64)
    few = replace(query, wavelengths=wavelengths, points=Points(vergences.to(query.device)))
    with torch.no_grad():
        energy = chosen(few).sum((-2, -1)).cpu()
    samples = None
    if chosen.on_grid:
        counts = sample_counts(query)
        samples = (min(counts), max(counts))
    points = [query.evaluation_grid(wavelength)[0] for wavelength in query.wavelengths.tolist()]
    cost = chosen.cost(query)
    candidates = []
    for row in PROPAGATORS.values():
        refusal = row.valid_for(query)
        error = float("nan") if refusal else row.error(query)
        candidates.append(Candidate(row.physics, row.method, error, row.cost(query) / cost, refusal))
    return Explanation(
        propagator=chosen.physics,
        method=chosen.method,
        samples=samples,
        points_per_pixel=(min(points), max(points)),
        shape=query.shape,
        pixel_pitch=query.pixel_pitch,
        error=chosen.error(query),
        model_error=chosen.model_error(query),
        wavelengths=wavelengths,
        distances=1 / vergences,
        energy=energy,
        candidates=tuple(candidates),
    )
