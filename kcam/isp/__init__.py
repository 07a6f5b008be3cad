"""From the raw picture to the finished one: demosaic, white balance, colour matrix, tone curve, style."""

from kcam.isp.colour import (
    Clip,
    ColourMatrix,
    ToneCurve,
    WhiteBalance,
    apply_colour_matrix,
    as_shot_colour_matrix,
    as_shot_gains,
    fit_colour_matrix,
    render_tones,
    tone_curve,
    white_balance,
)
from kcam.isp.convolution import Convolution, convolve_planes
from kcam.isp.demosaic import (
    DEMOSAICS,
    Demosaic,
    DemosaicMethod,
    LearnedDemosaic,
    demosaic,
    learned_demosaic,
)
from kcam.isp.raw import develop
from kcam.isp.style_stage import StyleStage

__all__ = [
    "DEMOSAICS",
    "Clip",
    "ColourMatrix",
    "Convolution",
    "Demosaic",
    "DemosaicMethod",
    "LearnedDemosaic",
    "StyleStage",
    "ToneCurve",
    "WhiteBalance",
    "apply_colour_matrix",
    "as_shot_colour_matrix",
    "as_shot_gains",
    "convolve_planes",
    "demosaic",
    "develop",
    "fit_colour_matrix",
    "learned_demosaic",
    "render_tones",
    "tone_curve",
    "white_balance",
]
