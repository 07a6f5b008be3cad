"""The propagators: one table of the rows that stand in the files of their functions.

`propagator` names the physics and `method` the transform. To add one, write a function from `Query` to (Z, L, H, W) and
its row in one file, and name it here; contract tests, the default choice, plans and the documentation take it from
there.
"""

from __future__ import annotations

from kcam.optics.propagation.grid import CHIRP_Z, FFT, MATRIX
from kcam.optics.propagation.off_axis import OFF_AXIS
from kcam.optics.propagation.question import Query
from kcam.optics.propagation.radial import RADIAL
from kcam.optics.propagation.rays import RAYS
from kcam.optics.propagation.reference import REFERENCE
from kcam.optics.propagation.row import Propagator
from kcam.optics.propagation.spectrum import ANGULAR_SPECTRUM

_EXACT = (MATRIX, CHIRP_Z, FFT, RADIAL)
_ROWS = (*_EXACT, *(row.in_fresnel_range() for row in _EXACT), ANGULAR_SPECTRUM, RAYS, REFERENCE)
PROPAGATORS = {(row.physics, row.method): row for row in _ROWS}
"""(propagator, method) -> the row that computes PSFs so: its function, range, error and cost."""
PHYSICS = tuple(dict.fromkeys(physics for physics, _ in PROPAGATORS))


def choose(query: Query, *, propagator: str | Propagator = "nonparaxial", method: str | None = None) -> Propagator:
    """The row that answers a query: the method named, or the cheapest exact one that is valid; a row is itself.

    With `samples` given, the cheapest that has a grid of so many.

    Points off the axis have one row.

    Raises: ValueError for an unknown propagator or method, listing the known ones.
    """
    if query.points.positions is not None:
        if propagator != OFF_AXIS.physics or method is not None:
            raise ValueError("off the axis PSFs are computed in one way: leave out propagator= and method=.")
        return OFF_AXIS
    if isinstance(propagator, Propagator):
        return propagator
    if propagator not in PHYSICS:
        raise ValueError(f"unknown propagator {propagator!r}; known: {', '.join(PHYSICS)}.")
    rows = [row for row in PROPAGATORS.values() if row.physics == propagator]
    if method is not None:
        for row in rows:
            if row.method == method:
                return row
        raise ValueError(f"{propagator} has no method {method!r}; known: {', '.join(row.method for row in rows)}.")
    if query.how.samples is not None:  # a number of samples asks for a grid that has one
        rows = [row for row in rows if row.on_grid] or rows
    if len(rows) == 1:
        return rows[0]
    cheapest = sorted(rows, key=lambda row: row.cost(query))  # what is dear need not be asked whether it is valid
    return next((row for row in cheapest if row.valid_for(query) is None), cheapest[0])
