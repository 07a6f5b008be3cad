"""The propagators: one table of rows, each a thin module over one function, with its range, error and cost.

`propagator` names the physics and `method` the transform. To add a row, write a function from `Query` to (Z, L, H, W)
and a row; contract tests, the default choice and the documentation iterate over the table.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from torch import Tensor, nn

from kcam.optics.angular_spectrum import angular_spectrum_psf, spectrum_grids
from kcam.optics.estimates import ROUNDING, Rays, debye_error, grid_error, jumps, map_phase, ring_turns, trace
from kcam.optics.polar import radial_psf
from kcam.optics.psf import Query, fft_grid_for, grid_psf, samples_by_rule
from kcam.optics.pupil import EDGE_MARGIN
from kcam.optics.rays import geometric_psf
from kcam.optics.reference import PIXELS_LIMIT, SMOOTH_LIMIT, reference_psf
from kcam.optics.sampling import MAX_PUPIL_SAMPLES
from kcam.optics.transforms import fast_length
from kcam.precision import full_precision

_FFT_SLOWNESS = 10.0  # operations of a matrix product in the time of one of an FFT, measured on a CPU in float32
_MOST_SPECTRUM_SAMPLES = 8192  # on each axis, of a field in complex128: 1 GB
_MAP_SETUP = 2e5  # operations for each pupil sample, of weights that bring a map onto a new grid; measured likewise


class Propagator(nn.Module):
    """A row of the table: a function from `Query` to PSFs, with its range, error estimate and cost.

    Args:
        physics: what the user names as `propagator`. method: what the user names as `method`.
        function: Query -> (Z, L, H, W). paraxial: the model drops what spheres have beyond their parabolas.
        valid: returns why the row cannot answer a query, or None.
        error: estimated L1 error of the PSF against the reference row. cost: floating-point operations.
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
        query = _as(query, paraxial=self.paraxial)
        reason = self.valid_for(query)
        if reason is not None:
            raise ValueError(f"{self.physics}/{self.method} {reason}")
        with full_precision(query.device):
            return self.function(query)

    @property
    def on_grid(self) -> bool:
        """Whether the row samples the pupil on a Cartesian grid, of so many samples as `Query.samples` says."""
        return self.method in ("matrix", "chirp_z")

    def error(self, query: Query) -> float:
        """Estimated L1 error of the worst PSF of a query against the `reference` row, before anything is computed.

        Never more than 3 times too small (above 1e-6), 4 times too large in the median of random cameras.
        """
        return self.error_of(_as(query, paraxial=self.paraxial))

    def model_error(self, query: Query) -> float:
        """Estimated L1 error of the reference itself against Rayleigh-Sommerfeld, over the window of the query.

        Never more than 4 times too small (above 1e-6) nor 40 times too large over random lenses, round, annular and
        coded, in focus and out; right in their median. See `estimates.debye_error`.
        """
        return min(2.0, max(debye_error(query, rays) for rays in trace(query)))

    def cost(self, query: Query) -> float:
        """Estimated floating-point operations, weighted by how fast the row's kind of work runs."""
        return self.cost_of(_as(query, paraxial=self.paraxial))


def _as(query: Query, *, paraxial: bool) -> Query:
    """The query for a model; the same one where it is for it already, with what it has kept."""
    return query if query.paraxial == paraxial else replace(query, paraxial=paraxial)


def _paraxial_error(rays: Rays, query: Query) -> float:
    """What dropping the spheres' higher terms costs: the rms of their phase, and of the scale of the pattern.

    1.5 times their sum (a fit: the sum itself is 0.85 of the truth in the median, and 3 times too small at worst). A
    map's phase is moved by up to tau / 2 of its width, which counts like as much of its phase; and where its jumps send
    light to the edge of the window, the kernel's own curvature counts there.
    """
    tau = float(query.semi_aperture.detach() / query.sensor_distance.detach()) ** 2
    if not query.paraxial:
        return 0.0
    a, d = float(query.semi_aperture.detach()), float(query.sensor_distance.detach())
    kernel = 2 * math.pi / rays.wavelength * a / d * query.half_window  # its phase at the corner of pupil and window
    return 1.5 * (rays.beyond + tau * (1 + map_phase(query) / 2 + 0.1 * kernel * min(1.0, jumps(query))))


def _grid_estimate(method: str) -> Callable[[Query], float]:
    def estimate(query: Query) -> float:
        displacement = query.displacement
        d, semi = (float(v.detach()) for v in (query.sensor_distance, query.image_side_semi_aperture))
        worst = 0.0
        for rays in trace(query):
            index = int((query.wavelengths - rays.wavelength).abs().argmin())
            spread = float(displacement[index])
            if method == "fft":
                _, length, _ = fft_grid_for(query, displacement=spread, wavelength=rays.wavelength)
                period = length * query.pixel_pitch / query.evaluation_grid(rays.wavelength)[0]
            else:
                count = query.samples or samples_by_rule(query, displacement=spread, wavelength=rays.wavelength)
                period = rays.wavelength * d * (count - 2 * EDGE_MARGIN) / (2 * semi)
            rounding = ROUNDING[query.dtype] * (5 if method == "fft" else 1)
            error = grid_error(query, rays, period=period) + _paraxial_error(rays, query)
            worst = max(worst, rounding + error)
        return min(2.0, worst)

    return estimate


def _radial_estimate(query: Query) -> float:
    """Interpolation in the Hankel table, 2e-7 measured, and the model."""
    return min(2.0, 3e-7 + max(_paraxial_error(rays, query) for rays in trace(query)))


def _spectrum_estimate(query: Query) -> float:
    """1e-3 for a smooth pupil; pixels are looked up at the grid's points, which misplaces every jump by up to half one.

    White noise of 6 radians is then off by 0.3, a square rim by 1e-2; rings that scatter beyond its grid by 3e-3.
    """
    rim, rings = 0.0 if query.lens.round else 7e-3, 2e-3 if query.lens.has_rings else 0.0
    return 1e-3 + rim + rings + 0.12 * jumps(query)


def _grid_sizes(query: Query) -> list[tuple[int, int]]:
    """(pupil samples, points) of each wavelength, also where so many would be refused: a cost is no refusal."""
    displacement = query.displacement.tolist()
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
        if query.lens.has_pixels:
            total += _MAP_SETUP * n**2  # its grid scales with the wavelength, and each grid needs weights of its own
    return query.vergences.numel() * total


def _spectrum_cost(query: Query) -> float:
    query = replace(query, samples=None)  # a cost is no refusal
    total = sum(_FFT_SLOWNESS * 10 * n**2 * math.log2(n) for n, _ in spectrum_grids(query))
    return query.vergences.numel() * total


def _radial_cost(query: Query) -> float:
    return query.vergences.numel() * sum(40.0 * m * m for _, m in _grid_sizes(query))


def _always(query: Query) -> str | None:
    return None


def _needs_few_samples(query: Query) -> str | None:
    try:
        count = max((count for count, _ in spectrum_grids(query)), default=0)
    except ValueError as error:  # samples that the user gave
        return str(error)
    if count <= _MOST_SPECTRUM_SAMPLES:
        return None
    return (
        f"needs a grid of {count} to sample the wave that converges from the aperture, more than "
        f"{_MOST_SPECTRUM_SAMPLES}; use propagator='nonparaxial', which samples the residual only."
    )


def _needs_fine_points(query: Query) -> str | None:
    """An FFT as long as its pupil has bins lambda d / 2a apart; coarser points would fold the pupil onto itself.

    And bins that fall on the points ask for up to twice the samples of other transforms.
    """
    finest = (
        float(query.wavelengths.min())
        * float(query.sensor_distance.detach())
        / (2 * float(query.image_side_semi_aperture.detach()))
    )
    if query.integrate or query.pixel_pitch < 0.9 * finest:
        grids = zip(query.displacement.tolist(), query.wavelengths.tolist(), strict=True)
        count = max((fft_grid_for(query, displacement=s, wavelength=w)[0] for s, w in grids), default=0)
        if count <= MAX_PUPIL_SAMPLES:
            return None
        return (
            f"needs {count} pupil samples for bins that fall on the points, more than the limit of "
            f"{MAX_PUPIL_SAMPLES}; use method='matrix' or a smaller shape."
        )
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


def _geometric_estimate(query: Query) -> float:
    """1.2 / (1 + phase / 3)^(1/3), phase the rms of the residual [rad]: the decay with waves of numerics note, 5.5.

    Rings between which the phase turns have no rays of their own: twice the turn is added.
    """
    return min(2.0, max(1.2 / (1 + rays.phase / 3) ** (1 / 3) for rays in trace(query)) + 2 * ring_turns(query))


def _rows() -> dict[tuple[str, str], Propagator]:
    rows = []
    for physics, paraxial in (("nonparaxial", False), ("fresnel", True)):
        for method, cost in (("matrix", _matrix_cost), ("chirp_z", _chirp_z_cost), ("fft", _fft_cost)):
            rows.append(
                Propagator(
                    physics,
                    method,
                    function=_grid_function(method),
                    error=_grid_estimate(method),
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
                error=_radial_estimate,
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
            error=_spectrum_estimate,
            cost=_spectrum_cost,
            valid=_needs_few_samples,
        )
    )
    rows.append(
        Propagator(
            "geometric",
            "rays",
            function=geometric_psf,
            error=_geometric_estimate,
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
            error=lambda q: PIXELS_LIMIT if q.lens.has_pixels else SMOOTH_LIMIT,
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


def choose(query: Query, *, propagator: str | Propagator = "nonparaxial", method: str | None = None) -> Propagator:
    """The row that answers a query: the method named, or the cheapest exact one that is valid; a row is itself.

    With `samples` given, the cheapest that has a grid of so many.

    Raises: ValueError for an unknown propagator or method, listing the known ones.
    """
    if isinstance(propagator, Propagator):
        return propagator
    if propagator not in PHYSICS:
        raise ValueError(f"unknown propagator {propagator!r}; known: {', '.join(PHYSICS)}.")
    rows = [row for (physics, _), row in PROPAGATORS.items() if physics == propagator]
    query = _as(query, paraxial=rows[0].paraxial)
    if method is not None:
        for row in rows:
            if row.method == method:
                return row
        raise ValueError(f"{propagator} has no method {method!r}; known: {', '.join(row.method for row in rows)}.")
    if query.samples is not None:  # a number of samples asks for a grid that has one
        rows = [row for row in rows if row.on_grid] or rows
    valid = [row for row in rows if row.valid_for(query) is None] or rows
    return valid[0] if len(valid) == 1 else min(valid, key=lambda row: row.cost(query))
