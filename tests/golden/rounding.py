"""How much further than the tolerance an answer may be off, where rounding alone moves it: measured by other kernels.

``ATEN_CPU_CAPABILITY=default MKL_CBWR=COMPATIBLE ONEDNN_MAX_CPU_ISA=SSE41 OPENBLAS_CORETYPE=Prescott
PYTHONPATH=tests python -m golden.record --spread`` lists what comes near. Float64 needs one of these.
"""

from __future__ import annotations

from fnmatch import fnmatchcase

FACTORS = (
    # a gradient sums thousands of numbers of either sign; its twin in float64 is held to 1e-12
    ("*, float32", "*d *", 10.0),
    ("psf *, float32", "d *", 30.0),
    ("gradients of camera *", "d *", 10.0),
    ("picture in float32*", "d *", 10.0),
    ("picture *, filtered, float32", "d *", 20.0),
    ("camera thesis*", "d *", 10.0),
    ("plan *", "d *", 10.0),
    # nodes of rings are eigenvalues, times phases of hundreds of radians
    ("psf by reference/quadrature *, float64", "d *", 4.0),
    # layers of depth: what one takes of a pixel the next one gives
    ("gradient to *, float32", "d depth", 100.0),
    ("picture layers in tiles*, float32", "d *", 100.0),
    # of discs in an image: what moves over a rim is little
    ("curves *, float32", "encircled_energy, d *", 200.0),
    # sums over a rim in another order: 1.03 times on another processor
    ("picture *, float64", "d elements.0.diameter", 10.0),
    # an FFT twice as long as the window, with chirps of hundreds of radians
    ("psf by */chirp_z *, float32", "psf", 10.0),
    ("psf by */fft *, float32", "psf", 2.0),
    # whole cameras, in which a mosaic leaves out most of the light and a colour matrix takes differences
    ("file *", "in float32", 2.0),
    ("camera *", "in float32", 2.0),
    ("gradients of camera *", "picture", 2.0),
    ("plan *", "picture", 2.0),
    ("plan from a file, plan_thesis", "picture", 10.0),
    # softplus of a tile, logits and instance normalisation
    ("file small_thesis", "*", 10.0),
    ("file style_with_stage", "*", 10.0),
    ("a camera in training by a style", "*", 10.0),
    # what a plan states is the difference of two pictures of float32: 1e-7 of what is 1e-3
    ("plan *", "error*", 300.0),
    # of plans that leave out nothing but float64, whose error is rounding itself
    *((f"plan singlet, {scenes}, 0.02", "error", 1e6) for scenes in ("deep", "several", "a batch")),
)
"""Question, answer, factor; the largest of those that fit counts."""


def factor(question: str, answer: str) -> float:
    """Times the tolerance that an answer may be off."""
    fitting = [f for asked, of, f in FACTORS if fnmatchcase(question, asked) and fnmatchcase(answer, of)]
    return max(fitting, default=1.0)
