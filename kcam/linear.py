"""The linear part of a camera, from the light of a scene to the raw signal, with its transpose.

All that stands in the way of a reconstruction but the noise: blur, field, distortion, filter, mosaic, gain. What is not
linear is left out (saturation, steps) or fixed at one scene (what a camera decides by the look of it).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from kcam import isp, optics, sensor
from kcam.camera import DEVELOPING, Camera, is_random
from kcam.context import Context, applied
from kcam.inputs import describe
from kcam.optics.linear import LinearImaging, constant_optics
from kcam.precision import full_precision
from kcam.scene import Scene
from kcam.sensor.arguments import like
from kcam.threads import no_more_than_free

LINEAR = (sensor.Transmission, sensor.ColourFilter, sensor.Motion, sensor.Mosaic, sensor.Exposure)
NOISE = (sensor.ShotNoise, sensor.ReadNoise, sensor.FixedPattern, sensor.DarkCurrent, sensor.RowColumnNoise)
RECORDING = (*NOISE, isp.Clip, sensor.ADC)
"""What makes of each pixel's signal what is recorded: linear but for noise, limits and steps."""
_ROUNDING = {torch.float64: 1e-9}  # of a stage of the user's that is taken for linear; else 1e-4


class LinearCamera(nn.Module):
    """raw = A light + offset: the linear part A of a camera, for scenes like one; `Camera.linear` makes it.

    The light x (B, K, H, W) are a scene's coefficient planes: three of linear sRGB for a picture, the bands of a cube.
    It may be negative. Depth, spectra, illuminant and size are the given scene's, and B too, unless that has one
    sample, which stands for all of a batch. Parameters are the camera's own, and gradients reach them from `forward`
    and from `adjoint`; settings are those that the camera had.
    """

    def __init__(self, camera: Camera, scene: Scene) -> None:
        super().__init__()
        if not isinstance(scene, Scene):
            raise TypeError(
                f"camera.linear() takes a Scene, got {describe(scene)}. Use Scene.from_rgb(image, depth=2.0): the "
                "operator is for its depth, its spectra and its size."
            )
        self.camera, self._scenes = camera, {scene.shape[0]: scene}
        self.given = scene
        self._stages = self._checked()
        imaging = self._stages[0] if self._stages else None
        self.imaging = LinearImaging.of(imaging) if isinstance(imaging, optics.Imaging) else None
        with torch.no_grad():
            signal, context = self._light(scene.coefficients), camera.resolve(scene)
            self._seen = tuple(signal.shape[1:])  # by the sensor
            for index, stage in self._behind_the_light():
                if not isinstance(stage, (*LINEAR, *RECORDING)):
                    _check_linear(stage, signal, context, index=index)
                signal = self._linear(stage, signal, context)
        self.scene_shape, self.raw_shape = tuple(scene.coefficients.shape), tuple(signal.shape)

    # ---- the map and its transpose ---------------------------------------------------------------------------------

    @no_more_than_free()
    def forward(self, x: Tensor) -> Tensor:
        """A x: what a sensor without noise, limits and steps makes of light, without the black level.

        Args:      x: light (B, K, H, W) of any sign; a perfect white is 1.
        Returns:   (B, C, H, W), 1.0 = full scale; dtype and device of x.
        Raises:    TypeError, ValueError for another shape, dtype or device.
        """
        self._check(x, self.scene_shape, name="x")
        if torch.is_inference_mode_enabled():  # what is kept there would be no good to the adjoint, nor the other way
            with torch.inference_mode(False), torch.no_grad():
                return self.forward(x)
        signal, context = self._light(x), self.camera.resolve(self.given)
        for _, stage in self._behind_the_light():
            signal = self._linear(stage, signal, context)
        return signal.to(x.dtype)

    @no_more_than_free()
    def adjoint(self, y: Tensor) -> Tensor:
        """A^T y, with <A x, y> = <x, A^T y>: exact, the vector-Jacobian product of `forward`, at some 2 to 3 times its
        time. Where gradients are asked for, those to y and to the camera's parameters are computed on the way back.

        Args:      y: (B, C, H, W), such as a raw signal less `offset`.
        Returns:   (B, K, H, W); dtype and device of y.
        Raises:    TypeError, ValueError for another shape, dtype or device.
        """
        self._check(y, self.raw_shape, name="y")
        return _Adjoint.apply(y, self, *self._learning())

    def _transposed(self, y: Tensor) -> Tensor:
        with constant_optics(), torch.inference_mode(False), torch.enable_grad():
            x = y.new_zeros(len(y), *self.scene_shape[1:]).requires_grad_()
            return torch.autograd.grad(self.forward(x), x, y.clone() if y.is_inference() else y)[0]

    @torch.no_grad()
    def norm(self, *, tolerance: float = 1e-3, steps: int = 100) -> float:
        """The largest singular value, ||A||, by power iteration on A^T A: from below, to about the tolerance.

        Args:      tolerance: relative change from step to step at which it ends. steps: at most.
        """
        generator = torch.Generator().manual_seed(0)  # of one sign: no direction of light with light alone is missed
        start = torch.rand(self.scene_shape, generator=generator, dtype=torch.float64) + 1
        x, found = start.to(self.light), 0.0
        for _ in range(steps):
            x = x / _norms(x).clamp(min=torch.finfo(x.dtype).tiny)
            y = self(x)
            before, found = found, float(_norms(y).max())
            if abs(found - before) <= tolerance * found:
                break
            x = self.adjoint(y)
        return found

    # ---- around it -------------------------------------------------------------------------------------------------

    @property
    def light(self) -> Tensor:
        """x of the scene that the operator is made for, (B, K, H, W)."""
        return self.given.coefficients

    def scene(self, x: Tensor) -> Scene:
        """The scene of such light: `to_srgb()` shows it, and a camera takes its picture. Of planes whose spectra are
        nowhere negative, what is below 0 counts as dark.

        Raises:    ValueError for light that no scene has.
        """
        spectra = self.given.spectra
        dark = spectra is None or bool((spectra >= 0).all())
        return replace(self._batch(len(x)), coefficients=x.clamp(min=0) if dark else x)

    @property
    def offset(self) -> Tensor:
        """What no light gives, (1, C, H, W): black level and dark current. ``camera.raw(scene) - A.offset`` is A x, but
        for noise, limits and steps.
        """
        signal, context = self.light.new_zeros(1, *self._seen), self.camera.resolve(self.given)
        for _, stage in self._behind_the_light():
            signal = self._linear(stage, signal, context, affine=True)
        return signal

    def record(self, clean: Tensor, *, generator: torch.Generator | None = None) -> Tensor:
        """What the sensor records of A x: its noise, its limits and its steps, without the offset.

        ``A.record(A(A.light))`` is ``camera.raw(scene) - A.offset``.

        Args:      clean: (B, C, H, W), as of `forward`. generator: source of all noise; None for torch's default one.
        Raises:    ValueError where other stages stand between noise and raw: what they mix is no pixel's own.
        """
        stages = [stage for _, stage in self._behind_the_light()]
        first = len(stages)
        while first and isinstance(_bare(stages[first - 1]), RECORDING):
            first -= 1
        early = [type(stage).__name__ for stage in stages[:first] if is_random(stage)]
        if early:
            raise ValueError(
                f"{early[0]} stands before {type(stages[first - 1]).__name__}, so its noise is not each pixel's own. "
                "Take it from the camera: camera.raw(A.scene(x), generator=g) - A.offset."
            )
        context = self.camera.resolve(self.given, generator=generator)
        gain: Tensor | float = 1.0
        for stage in stages[first:]:
            gain = gain * (like(_gain(stage, context), clean) if isinstance(stage, sensor.ADC) else 1.0)
        signal = clean / gain
        for stage in stages[first:]:
            signal = applied(stage, signal, context)
        return signal - self.offset.to(signal)

    def physics(self) -> Any:
        """The same for deepinv: a `deepinv.physics.LinearPhysics` with this A and A_adjoint, whose noise is the
        sensor's own (`record`).

        Raises:    ImportError without deepinv, or where it does not load.
        """
        try:
            from deepinv.physics import LinearPhysics
        except ImportError as error:
            raise ImportError(f"{error}. A.physics() needs deepinv: pip install kcam[deepinv].") from error
        except RuntimeError as error:  # of a torchvision that was built for another torch
            raise ImportError(
                f"deepinv does not load: {error}. Install the torchvision that was built for torch {torch.__version__}."
            ) from error
        device = self.light.device
        return LinearPhysics(
            A=self, A_adjoint=self.adjoint, img_size=self.scene_shape[1:], noise_model=self.record, device=device
        )

    def __repr__(self) -> str:
        return f"LinearCamera({self.scene_shape} -> {self.raw_shape})"

    # ---- stages ----------------------------------------------------------------------------------------------------

    def _checked(self) -> list[nn.Module]:
        """The stages up to the raw signal, of which an Imaging comes first and is one that is linear."""
        stages = list(self.camera)
        end = next((index for index, stage in enumerate(stages) if isinstance(stage, DEVELOPING)), len(stages))
        for index, stage in enumerate(stages[:end]):
            if not isinstance(stage, optics.Imaging):
                continue
            if index:
                raise ValueError(
                    f"Imaging (stage {index}) stands behind {type(stages[index - 1]).__name__}, and no depth comes "
                    "through there. camera.linear() takes a camera whose first stage it is."
                )
            if type(stage) is not optics.Imaging:
                raise ValueError(
                    f"nobody knows what is linear of {type(stage).__name__}, a stage of yours. Use Imaging."
                )
            rank = stage.accuracy.rank
            if rank is not None and rank < self.given.coefficients.shape[1]:
                raise ValueError(
                    f"Imaging(rank={rank}) fits spectra to each scene, which is not linear in its light. Use "
                    f"rank=None, and camera.linear(scene.low_rank({rank})) for as few planes."
                )
        return stages[:end]

    def _behind_the_light(self) -> list[tuple[int, nn.Module]]:
        """Stages behind what `_light` has done."""
        done = 0 if self.imaging is None else 1 + self.camera.absorbed(0)[0]
        return list(enumerate(self._stages))[done:]

    def _light(self, x: Tensor) -> Tensor:
        """Of light x, what falls on the sensor, or what its filter lets through."""
        scene = self._batch(len(x))
        if self.imaging is not None:
            return self.imaging.light(x, scene, self.camera.absorbed(0)[1])
        if scene.spectra is None:
            return x
        with full_precision(x.device):
            return torch.einsum("bkhw,kl->blhw", x, scene.spectra.to(x))

    def _linear(self, stage: nn.Module, signal: Tensor, context: Context, *, affine: bool = False) -> Tensor:
        """What a stage makes of a signal, as far as that is linear; affine: with what it makes of none."""
        stage = _bare(stage)
        if isinstance(stage, LINEAR):
            return applied(stage, signal, context)
        if isinstance(stage, sensor.ADC):
            signal = signal * like(_gain(stage, context), signal)
            return signal + like(stage.black_level, signal) / (2**stage.bits - 1) if affine else signal
        if isinstance(stage, sensor.DarkCurrent):
            full_well = context.full_well if stage.full_well is None else stage.full_well
            return signal + like(stage.electrons(), signal) / like(full_well, signal) if affine else signal
        if isinstance(stage, RECORDING):
            return signal
        made = _of_other(stage, signal, context)
        return made if affine else made - _of_other(stage, torch.zeros_like(signal[:1]), context)

    # ---- tensors ---------------------------------------------------------------------------------------------------

    def _batch(self, count: int) -> Scene:
        """The scene for so many samples."""
        if count not in self._scenes:
            planes, depth = self.given.coefficients, self.given.depth
            if isinstance(depth, Tensor) and depth.ndim == 4:
                depth = depth.expand(count, -1, -1, -1)
            self._scenes[count] = replace(self.given, coefficients=planes.expand(count, -1, -1, -1), depth=depth)
        return self._scenes[count]

    def _learning(self) -> list[Tensor]:
        """Tensors beside the light through which a derivative passes."""
        own = (*self.parameters(), *self.buffers(), self.given.spectra, self.given.depth)
        return [tensor for tensor in own if isinstance(tensor, Tensor) and tensor.requires_grad]

    def _check(self, values: Any, shape: tuple[int, ...], *, name: str) -> None:
        if not isinstance(values, Tensor) or not values.is_floating_point():
            raise TypeError(f"{name} must be a floating-point tensor {shape}, got {describe(values)}.")
        batch = shape[0]
        if values.ndim != 4 or values.shape[1:] != shape[1:] or (batch != 1 and len(values) != batch):
            expected = ", ".join(map(str, (batch if batch != 1 else "B", *shape[1:])))
            raise ValueError(
                f"{name} has shape {tuple(values.shape)}, expected ({expected}): this operator is for scenes "
                f"{self.scene_shape}, whose raw is {self.raw_shape}."
            )
        if values.device != self.light.device:
            raise ValueError(
                f"{name} is on {values.device}, and the scene of the operator on {self.light.device}. Use "
                f"camera.linear(scene.to({str(values.device)!r}))."
            )


class _Adjoint(torch.autograd.Function):
    """A^T y as a function of y and of the tensors in A: <A^T y, v> = <y, A v>, whose derivatives are first ones of A v.

    Through the graph of a vector-Jacobian product they would be second ones, which rendering does not have for all.
    """

    @staticmethod
    def forward(ctx: Any, y: Tensor, operator: LinearCamera, *tensors: Tensor) -> Tensor:
        ctx.operator = operator
        ctx.save_for_backward(y, *tensors)
        return operator._transposed(y)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        y, *tensors = ctx.saved_tensors
        again = torch.is_grad_enabled()
        asked = [tensor for tensor, needed in zip(tensors, ctx.needs_input_grad[2:], strict=True) if needed]
        with torch.set_grad_enabled(again or bool(asked)):
            raw = ctx.operator(grad)
        derivatives: Any = ()
        if asked:  # the graph that leads to them is also others'
            derivatives = torch.autograd.grad(raw, asked, y, retain_graph=True, create_graph=again, allow_unused=True)
        found = iter(derivatives)
        others = (next(found) if needed else None for needed in ctx.needs_input_grad[2:])
        return (raw if again else raw.detach()) if ctx.needs_input_grad[0] else None, None, *others


def _bare(stage: nn.Module) -> nn.Module:
    """A stage itself, of one at its mean."""
    while isinstance(stage, sensor.Mean):
        stage = stage.stage
    return stage


def _gain(stage: sensor.ADC, context: Context) -> Tensor | float:
    return context.gain if stage.gain is None else stage.gain


def _of_other(stage: Any, signal: Tensor, context: Context) -> Tensor:
    """What a stage of the user's makes of a signal, at its mean."""
    return applied(stage.mean() if is_random(stage) else stage, signal, context)


def _check_linear(stage: nn.Module, signal: Tensor, context: Context, *, index: int) -> None:
    """ValueError unless a stage makes of sums and multiples of signals, of any sign and size, those of each."""
    generator = torch.Generator().manual_seed(0)

    def made(of: Tensor) -> Tensor:
        return _of_other(stage, of.to(signal), context)

    one, other = (torch.randn(signal.shape, generator=generator, dtype=torch.float64) for _ in range(2))
    none = made(torch.zeros_like(one))
    parts = 3 * (made(one) - none) - 2 * (made(other) - none)
    off = float((made(3 * one - 2 * other) - none - parts).norm() / parts.norm().clamp(min=1e-30))
    if not off <= _ROUNDING.get(signal.dtype, 1e-4):
        name = type(stage).__name__
        raise ValueError(
            f"{name} (stage {index}) is not linear in the light: what it makes of 3 a - 2 b is {off:.1g} off what it "
            f"makes of a and b. Put it behind the demosaic, or take the camera without it: "
            f"Camera(*camera[:{index}], *camera[{index + 1}:]).linear(scene)."
        )


def _norms(values: Tensor) -> Tensor:
    """Of each sample, (B, 1, 1, 1)."""
    return values.flatten(1).norm(dim=1).view(-1, 1, 1, 1)
