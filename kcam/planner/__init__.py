"""The planner: simulate only the effects that a scene calls for, inside a tolerance, and say what was left out."""

from kcam.planner.plan import (
    Decision,
    OutOfRange,
    Plan,
    PlannedCamera,
    noiseless_raw,
    relative_rms,
    with_imaging,
)
from kcam.planner.planner import Planner, explain, make_plan, measured, shoot, timed
from kcam.planner.range import Range

__all__ = [
    "Decision",
    "OutOfRange",
    "Plan",
    "PlannedCamera",
    "Planner",
    "Range",
    "explain",
    "make_plan",
    "measured",
    "noiseless_raw",
    "relative_rms",
    "shoot",
    "timed",
    "with_imaging",
]
