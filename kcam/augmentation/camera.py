"""A whole random camera: a picture or a cube, photographed again by one of several cameras."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from kcam.augmentation.base import (
    LEAST_VERGENCE,
    CameraAugmentation,
    each_generator,
    finite_vergence,
    is_picture,
    wavelengths_of,
)
from kcam.augmentation.distributions import Bounds, Choice, Draw, Seed, Uniform
from kcam.cache import Settings
from kcam.camera import PRESETS, Camera
from kcam.planner.planner import check_tolerance
from kcam.scene import Scene
from kcam.ste import clip_ste
from kcam.units import wavelength_grid

_PLANS = 64  # kept
_SCENE = "coffee"  # what is planned for: detail of all sizes, saturated colours


class RandomCamera(CameraAugmentation):
    """Photograph each sample with a camera drawn from several: optics, filter, noise, ADC, demosaic and tone.

    A picture counts as a scene whose paints have its colours (`Scene.from_rgb`), a cube as spectral radiance in
    daylight (`Scene.from_bands`); both become pictures. A map of inverse depth, from `CameraSequential` or as
    ``augment(image, inverse_depth=map)``, (B,1,H,W) or one number per sample (B,) [1/m], takes the place of the drawn
    distance.

    Each camera is planned once for each size of picture, on a fixed scene at both ends of the range of distances, never
    for a batch: the result for a sample does not depend on the others. With a map it is planned from infinity to the
    near end of that range, or for a nearer map, to the next power of 2 [1/m] beyond its nearest point. It is planned
    again where it was changed in between, in anything but the values of what it trains.

    A PSF is no wider than the picture, as in any camera here: small pictures of things far out of focus get darker.

    Args:      cameras: presets by name, files that `Camera.save` wrote, or cameras. Presets and files are not trained;
                   a camera of one's own keeps its parameters, and gradients reach them.
               tolerance: of the plan, see `kcam.planner.make_plan`; 0 for the reference physics.
               distance: of the picture [m], uniform in 1/m.
               wavelengths: of a cube's bands [m].
    Raises:    ValueError for no cameras, an unknown preset, a bad tolerance; at the call, for cameras that do not end
        in three channels, and for p < 1 where the channels change.

    Example:
    >>> augment = KC.RandomCamera(["ideal"], tolerance=0, distance=2.0)  # "phone" by default
    >>> augment(torch.rand(2, 3, 24, 32)).shape
    torch.Size([2, 3, 24, 32])
    """

    in_light = False
    takes_depth = True

    def __init__(
        self,
        cameras: Sequence[str | os.PathLike[str] | Camera] = ("phone",),
        tolerance: float | str = 0.02,
        *,
        distance: Bounds = (0.5, 5.0),
        wavelengths: Tensor | list[float] | None = None,
        same_on_batch: bool = False,
        p: float = 1.0,
        keepdim: bool = False,
    ) -> None:
        if isinstance(cameras, (str, os.PathLike, Camera)):
            cameras = [cameras]
        if not cameras:
            raise ValueError('cameras is empty: give at least one, such as cameras=["phone"].')
        check_tolerance(tolerance)
        draws: dict[str, Draw] = {
            "camera": Choice(len(cameras)),
            "distance": Uniform(distance, "vergence", least=1e-2, unit="[m]"),
            "noise_seed": Seed(),
        }
        super().__init__(draws, same_on_batch=same_on_batch, p=p, keepdim=keepdim)
        self.cameras = nn.ModuleList(_opened(camera) for camera in cameras)
        self.tolerance = tolerance
        names = (type(camera).__name__ if isinstance(camera, Camera) else str(camera) for camera in cameras)
        self.flags = {"cameras": "/".join(names), "tolerance": tolerance}
        self.wavelengths = None if wavelengths is None else wavelength_grid(wavelengths)
        self._planned: dict[tuple[Any, ...], tuple[Settings, Camera]] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Plans are made again after a copy: they refer to the cameras of the original."""
        return {**super().__getstate__(), "_planned": {}}

    def output_channels(self, channels: int) -> int:
        """A picture of three channels."""
        return 3

    def planned(self, index: int, signal: Tensor, *, nearest: float | None = None) -> Camera:
        """The camera that photographs such signals: with its plan for their size, made when it is first asked for, or
        was changed since.

        nearest: the largest value of a map [1/m]; None without one.
        """
        shape, bands = (signal.shape[-2], signal.shape[-1]), None if is_picture(signal) else self._bands(signal)
        near, far = (1 / bound for bound in self.bounds("distance"))
        beyond = None  # what of the map lies nearer than the range; the range itself may be trained
        if nearest is not None:
            beyond = 2.0 ** math.ceil(math.log2(nearest)) if nearest > near else 0.0
            near, far = max(near, beyond), 0.0
        camera: Any = self.cameras[index]
        trains = torch.is_grad_enabled() and any(p.requires_grad for p in camera.parameters())  # a plan for gradients
        key = (index, shape, beyond, trains, self.tolerance, None if bands is None else tuple(bands.tolist()))
        settings = Settings(camera)
        if key not in self._planned or self._planned[key][0] != settings:
            scene = Scene.builtin(_SCENE, shape, wavelengths=bands).to(device=signal.device)
            if nearest is not None:
                ramp = torch.linspace(far, near, shape[1], dtype=torch.float64).clamp(min=LEAST_VERGENCE)
                scenes = [replace(scene, depth=(1 / ramp).expand(1, 1, *shape).to(signal.device))]
            else:
                scenes = [replace(scene, depth=1 / max(end, LEAST_VERGENCE)) for end in {near, far}]
            plan = camera.plan(scenes, tolerance=self.tolerance)
            # a plain camera: a PlannedCamera would warn of each picture that is not like the fixed scene
            self._planned[key] = settings, Camera(*plan.apply(camera), context=camera.resolve())
        if len(self._planned) > _PLANS:  # of pictures of ever other sizes, the oldest goes
            del self._planned[next(iter(self._planned))]
        return self._planned[key][1]

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """Row by row, each with its own camera, distance and seed."""
        distance = drawn["distance"]
        depths: Sequence[float | Tensor] = distance.unbind() if distance.requires_grad else distance.tolist()
        nearest: Sequence[float | None] = [None] * len(signal)
        if "inverse_depth" in drawn:
            vergence = finite_vergence(drawn["inverse_depth"], signal)
            depths, nearest = (1 / vergence).split(1), vergence.detach().amax((1, 2, 3)).tolist()
        generators = each_generator(drawn["noise_seed"], signal.device)
        pictures = []
        for row, index, depth, near, generator in zip(
            signal.split(1), drawn["camera"].tolist(), depths, nearest, generators, strict=True
        ):
            picture = self.planned(index, signal, nearest=near)(self._scene(row, depth), generator=generator)
            if picture.shape[1] != 3:
                raise ValueError(
                    f"camera {index} of RandomCamera ends in {picture.shape[1]} channels, expected a picture of 3. Add "
                    "isp.Demosaic(), isp.ColourMatrix() and isp.ToneCurve()."
                )
            pictures.append(picture)
        return torch.cat(pictures)

    def _bands(self, signal: Tensor) -> Tensor:
        return wavelengths_of(signal, self.wavelengths)

    def _scene(self, row: Tensor, depth: float | Tensor) -> Scene:
        if is_picture(row):
            scene = Scene.from_rgb(clip_ste(row, 0.0, 1.0))
        else:
            scene = Scene.from_bands(clip_ste(row, 0.0, None), wavelengths=self._bands(row))
        return replace(scene, depth=depth)  # of a distance that was drawn nobody asks whether millimetres were meant


def _opened(camera: str | os.PathLike[str] | Camera) -> Camera:
    if isinstance(camera, Camera):
        return camera
    if not isinstance(camera, (str, os.PathLike)):
        raise TypeError(f"cameras must be names, files or cameras, got {camera!r}.")
    if str(camera) in PRESETS:
        return Camera.preset(str(camera)).requires_grad_(False)
    if Path(camera).suffix:
        return Camera.load(camera).requires_grad_(False)
    raise ValueError(f"unknown camera {str(camera)!r}. There are: {', '.join(PRESETS)}; or give a .safetensors file.")
