"""Exposure in time: what moves while the shutter is open, and rows that see later moments.

E(x) = 1/T INT_0^T S(x - u(x, t_r + t)) dt,     t_r = readout r / H

S is the still image on the sensor, u how far its content has moved since the exposure of the first row began
[pixels, +x right, +y down], T the exposure time, r the row. At t = 0 the picture stands where the scene has it.

Where all pixels move alike and at once (`velocity`, `path`, a global shutter) this is a convolution, and exact for
light that the pixels sample without aliasing: a straight piece of the path from a to b that takes a share s of the time
has the transfer function s exp(-i pi f.(a + b)) sinc(f.(b - a)). Where rows see later moments, a convolution for the
time of one row is followed by a shift of each row; where each pixel has its own velocity (`flow`), some moments are
averaged.
"""

from kcam.sensor.motion.resampling import LONGEST, move_rows, path_blur, warp
from kcam.sensor.motion.shake import tremor
from kcam.sensor.motion.stage import MOST_SAMPLES, STEP, Motion

__all__ = ["LONGEST", "MOST_SAMPLES", "STEP", "Motion", "move_rows", "path_blur", "tremor", "warp"]
