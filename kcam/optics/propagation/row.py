"""A row of the table of propagators: a function that answers a query, and all that is known of it before it does."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from torch import Tensor, nn

from kcam.optics.propagation.estimates import debye_error, trace
from kcam.optics.propagation.question import Query
from kcam.precision import full_precision


class Rate(NamedTuple):
    """A kind of work, and seconds for one of its operations on the machine of the defaults (one core, float32)."""

    kind: str
    seconds: float


PRODUCTS = Rate("matrix", 5e-11)
"""Of operations as in a product of matrices."""
FFT_SLOWNESS = 10.0  # operations of a matrix product in the time of one of an FFT, measured on a CPU in float32


Transfer = Callable[[Tensor, tuple[int, int], Sequence[int]], Tensor]
"""From frequencies (F,) along an axis of the pixels [cycles per pixel], a window (h, w) that is not larger than the
query's, and indices of L of its wavelengths, to slices of the transfer functions along x and y of what falls into that
window: (Z, L, 2, F), real or complex.
"""


class Propagator(nn.Module):
    """A row of the table: a function from `Query` to PSFs, with its range, error estimate and cost.

    Args:
        physics: what the user names as `propagator`. method: what the user names as `method`.
        function: Query -> (Z, L, H, W). paraxial: the model drops what spheres have beyond their parabolas.
        valid: returns why the row cannot answer a query, or None; without it the row answers all.
        error: estimated L1 error of the PSF against the reference row. cost: floating-point operations, > 0.
        rate: of an operation of the cost, which a plan turns into time [s]; without one they count as those of a matrix
            product. A number is for operations of a kind of its own; a `Rate` may be that of other rows.
        exact: whether only sampling separates the row from its physics, so that it may be chosen by cost alone.
        on_grid: whether it samples the pupil on a Cartesian grid, of so many samples as `Query.samples` says.
        transfer: query -> `Transfer`, where transfer functions are known without the PSFs.
        lines: query, and what it gave for other distances -> `Transfer`, or None, for estimates: right enough to tell
            what other wavelengths and distances change in the window of the query, and in smaller ones to a factor of
            2, see `LineTransfer`.
        about: what it does, in a line of the documentation.
    Raises: ValueError for a rate that is not > 0.
    """

    def __init__(
        self,
        physics: str,
        method: str,
        *,
        function: Callable[[Query], Tensor],
        error: Callable[[Query], float],
        cost: Callable[[Query], float],
        valid: Callable[[Query], str | None] | None = None,
        rate: Rate | float = PRODUCTS,
        paraxial: bool = False,
        exact: bool = True,
        on_grid: bool = False,
        transfer: Callable[[Query], Transfer] | None = None,
        lines: Callable[[Query, Any], Transfer | None] | None = None,
        about: str = "",
    ) -> None:
        super().__init__()
        self.physics, self.method, self.paraxial, self.exact = physics, method, paraxial, exact
        self.function, self.error_of, self.cost_of, self.reason_of = function, error, cost, valid
        self.kind, self.rate = rate if isinstance(rate, Rate) else (f"{physics}/{method}", float(rate))
        self.on_grid, self.transfer_of, self.lines_of, self.about = on_grid, transfer, lines, about
        if not self.rate > 0:
            raise ValueError(f"rate must be > 0 seconds for an operation of {physics}/{method}, got {self.rate:g}.")

    def in_fresnel_range(self) -> Propagator:
        """The same transform of the paraxial model, equation (3.4)."""
        row = copy.deepcopy(self)
        row.physics, row.paraxial = "fresnel", True
        return row

    def forward(self, query: Query) -> Tensor:
        """(Z, L, H, W) energy in each pixel relative to what passes the aperture.

        Raises: ValueError where the row is not valid for this query.
        """
        reason = self.valid_for(query)
        if reason is not None:
            raise ValueError(f"{self.physics}/{self.method} {reason}")
        with full_precision(query.device):
            return self.function(query.modelled(paraxial=self.paraxial))

    def transfer(self, query: Query) -> Transfer | None:
        """The transfer functions of a query, or None where only the PSFs tell."""
        if self.transfer_of is None or self.valid_for(query) is not None:
            return None
        return self.transfer_of(query.modelled(paraxial=self.paraxial))

    def lines(self, query: Query, like: Transfer | None = None) -> Transfer | None:
        """About the transfer functions of a query, in a fraction of the time of its PSFs, or None.

        like: those of the same question about other distances, from which it takes what is the same.
        """
        if self.lines_of is None or self.valid_for(query) is not None:
            return None
        return self.lines_of(query.modelled(paraxial=self.paraxial), like)

    def valid_for(self, query: Query) -> str | None:
        """Why the row cannot answer a query, or None."""
        return None if self.reason_of is None else self.reason_of(query.modelled(paraxial=self.paraxial))

    def error(self, query: Query) -> float:
        """Estimated L1 error of the worst PSF of a query against the `reference` row, before anything is computed.

        Never more than 3 times too small (above 1e-6), 4 times too large in the median of random cameras.
        """
        return self.error_of(query.modelled(paraxial=self.paraxial))

    def model_error(self, query: Query) -> float:
        """Estimated L1 error of the reference itself against Rayleigh-Sommerfeld, over the window of the query.

        Never more than 4 times too small (above 1e-6) nor 40 times too large over random lenses, round, annular and
        coded, in focus and out; right in their median. See `estimates.debye_error`.
        """
        return min(2.0, max(debye_error(query, rays) for rays in trace(query)))

    def cost(self, query: Query) -> float:
        """Estimated floating-point operations, weighted by how fast the row's kind of work runs.

        Raises: ValueError where the row states none: a plan would take it for free.
        """
        cost = self.cost_of(query.modelled(paraxial=self.paraxial))
        if not cost > 0:
            raise ValueError(
                f"{self.physics}/{self.method} states a cost of {cost:g} operations, and none is free. Give cost=, "
                "such as lambda query: 1e6, in operations as of a matrix product, or rate= seconds for each."
            )
        return cost
