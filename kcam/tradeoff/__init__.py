"""What accuracy costs in time: every knob of a camera turned by itself, its error beside its time.

Each setting differs from the camera in one thing. The errors are against the non-paraxial physics in float64: of the
PSFs against the `reference` propagator, of the raw and of the picture against the same camera, finely sampled.
"""

from kcam.tradeoff.knobs import KNOBS, Setting, settings
from kcam.tradeoff.measurement import sweep
from kcam.tradeoff.results import Row, Sweep, front

__all__ = ["KNOBS", "Row", "Setting", "Sweep", "front", "settings", "sweep"]
