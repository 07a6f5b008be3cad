"""From the raw picture to the finished one: demosaic, white balance, colour matrix, tone curve."""

from kcam.isp.colour import (
    Clip,
    ColourMatrix,
    ToneCurve,
    WhiteBalance,
    apply_colour_matrix,
    as_shot_colour_matrix,
    as_shot_gains,
    fit_colour_matrix,
    tone_curve,
    white_balance,
)
from kcam.isp.demosaic import (
    DEMOSAICS,
    Demosaic,
    DemosaicMethod,
    LearnedDemosaic,
    demosaic,
    learned_demosaic,
)

__all__ = [
    "DEMOSAICS",
    "Clip",
    "ColourMatrix",
    "Demosaic",
    "DemosaicMethod",
    "LearnedDemosaic",
    "ToneCurve",
    "WhiteBalance",
    "apply_colour_matrix",
    "as_shot_colour_matrix",
    "as_shot_gains",
    "demosaic",
    "fit_colour_matrix",
    "learned_demosaic",
    "tone_curve",
    "white_balance",
]
