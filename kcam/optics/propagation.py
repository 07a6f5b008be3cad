"""The propagators: one table of rows, each a thin module over one function, with its range, error and cost.

`propagator` names the physics and `method` the transform. To add a row, write a function from `Query` to (Z, L, H, W)
and a row; contract tests, the default choice and the documentation iterate over the table.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor, nn

from kcam.optics import sampling
from kcam.optics.angular_spectrum import angular_spectrum_psf
from kcam.optics.polar import radial_psf
from kcam.optics.psf import Query, grid_psf, ray_displacement, samples_by_rule
from kcam.optics.rays import geometric_psf
from kcam.optics.reference import reference_psf
from kcam.optics.transforms import fast_length
from kcam.precision import full_precision

_FFT_SLOWNESS = 10.0  # operations of a matrix product in the time of one of an FFT, measured on a CPU in float32


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
        with full_precision(query.device):
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


def choose(query: Query, *, propagator: str | Propagator = "nonparaxial", method: str | None = None) -> Propagator:
    """The row that answers a query: the one given, the method named, or the cheapest exact one that is valid.

    Raises: ValueError for an unknown propagator or method, listing the known ones.
    """
    if isinstance(propagator, Propagator):
        return propagator
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
