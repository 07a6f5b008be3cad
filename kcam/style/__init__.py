"""Cameras that learn a painting's style: features, losses, training, and painting itself."""

from kcam.style.painting import paint
from kcam.style.pictures import STYLES, painting
from kcam.style.presets import PRESETS, Preset, style_camera
from kcam.style.run import StyleWarning, TrainingError
from kcam.style.scenes import BuiltinScenes, PatchScenes, PhotoScenes, Source
from kcam.style.settings import Settings
from kcam.style.training import Progress, Trained, fit
from kcam.style.vgg import VGG16Features
from kcam.texture.features import SteerableFeatures
from kcam.texture.losses import StyleLoss

__all__ = [
    "PRESETS",
    "STYLES",
    "BuiltinScenes",
    "PatchScenes",
    "PhotoScenes",
    "Preset",
    "Progress",
    "Settings",
    "Source",
    "SteerableFeatures",
    "StyleLoss",
    "StyleWarning",
    "Trained",
    "TrainingError",
    "VGG16Features",
    "fit",
    "paint",
    "painting",
    "style_camera",
]
