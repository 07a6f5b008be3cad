"""kcam: a differentiable camera, from the light of a scene to the finished picture, in PyTorch and Kornia."""

from kcam import isp, optics, sensor, units
from kcam.camera import Camera
from kcam.context import Context, Stage
from kcam.isp.raw import Raw
from kcam.planner import Plan
from kcam.scene import Scene

__version__ = "0.1.0"
__all__ = ["Camera", "Context", "Plan", "Raw", "Scene", "Stage", "__version__", "isp", "optics", "sensor", "units"]
