"""kcam: a differentiable camera, from the light of a scene to the finished picture, in PyTorch and Kornia."""

import importlib
from typing import Any

from kcam import isp, optics, sensor, units
from kcam.camera import Camera
from kcam.context import Context, Stage
from kcam.isp.raw import Raw
from kcam.planner import Plan
from kcam.scene import Scene

__version__ = "0.1.0"
__all__ = ["Camera", "Context", "Plan", "Raw", "Scene", "Stage", "__version__", "isp", "optics", "sensor", "units"]


def __getattr__(name: str) -> Any:
    """``kcam.calibration`` and ``kcam.analysis``, imported when they are asked for."""
    if name in ("analysis", "calibration"):
        return importlib.import_module(f"kcam.{name}")
    raise AttributeError(f"module 'kcam' has no attribute {name!r}")
