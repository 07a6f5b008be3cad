"""From the raw picture to the finished one: demosaic, denoise, white balance, colour, tones, style, JPEG."""

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
from kcam.isp.denoise import Denoise, denoise
from kcam.isp.finish import JPEG, LocalToneMapping, Sharpen, jpeg, map_tones_locally, sharpen
from kcam.isp.raw import develop
from kcam.isp.style_stage import StyleStage
from kcam.isp.texture_transfer import TextureTransfer, texture_transfer

__all__ = [
    "DEMOSAICS",
    "JPEG",
    "Clip",
    "ColourMatrix",
    "Convolution",
    "Demosaic",
    "DemosaicMethod",
    "Denoise",
    "LearnedDemosaic",
    "LocalToneMapping",
    "Sharpen",
    "StyleStage",
    "TextureTransfer",
    "ToneCurve",
    "WhiteBalance",
    "apply_colour_matrix",
    "as_shot_colour_matrix",
    "as_shot_gains",
    "convolve_planes",
    "demosaic",
    "denoise",
    "develop",
    "fit_colour_matrix",
    "jpeg",
    "learned_demosaic",
    "map_tones_locally",
    "render_tones",
    "sharpen",
    "texture_transfer",
    "tone_curve",
    "white_balance",
]
