"""From the pupil to the sensor: a question, and the table of rows that answer it."""

from kcam.optics.propagation.question import Query
from kcam.optics.propagation.row import Propagator, Rate
from kcam.optics.propagation.table import PHYSICS, PROPAGATORS, choose

__all__ = ["PHYSICS", "PROPAGATORS", "Propagator", "Query", "Rate", "choose"]
