"""`CameraSequential`: Kornia's container for pipelines in which channels change and depth counts."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextvars import ContextVar
from typing import Any

import kornia.augmentation as K
import torch
from kornia.augmentation.base import _AugmentationBase
from kornia.augmentation.container.base import ImageSequentialBase
from kornia.augmentation.container.image import _get_new_batch_shape
from kornia.augmentation.container.ops import AugmentationSequentialOps, InputSequentialOps
from kornia.augmentation.container.params import ParamItem
from kornia.constants import DataKey
from torch import Tensor, nn

from kcam.augmentation.base import (
    TAKES,
    CameraAugmentation,
    check_layout,
    check_values,
    finite_vergence,
    is_picture,
    wavelengths_of,
)
from kcam.augmentation.lens import RandomLens
from kcam.camera import DEMOSAICING, Camera
from kcam.context import Context, Stage, applied
from kcam.inputs import check_array, check_floats
from kcam.isp import ToneCurve
from kcam.optics import Imaging
from kcam.scene import Scene
from kcam.sensor import ColourFilter, Mosaic
from kcam.srgb import to_code, to_light
from kcam.units import wavelength_grid

_NEAR = 100.0  # 1/m, a centimetre: nearer than pictures are taken from


class CameraSequential(K.AugmentationSequential):
    """`K.AugmentationSequential` in which camera stages may stand, channels may change, and stages see depth.

    - Plain kcam stages (`optics.Imaging`, `sensor.Mosaic`, ...) are told of each other as in a `Camera`: a Demosaic
      knows the pattern of the Mosaic before it, and a contradiction is an error when the container is built. Our
      augmentations between a ColourFilter and a ToneCurve work on the linear light that is there.
    - Every augmentation draws for the channels that really reach it (Kornia's containers draw for those of the input).
      A module of one's own says what it gives by a method ``output_channels(channels)``.
    - A picture stays in linear light between neighbours that all work there, and is coded once behind them.
    - The first mask is a map of inverse depth [1/m], 0 at infinity, which `RandomDefocus`, `RandomCamera` and `Imaging`
      see as it is when they are reached: flipped and cropped with the picture. Inside another container there are no
      masks to see, so a nested one takes its own distances.

    Args:      depth: False where the first mask is no depth.
               depth_key: which mask it is instead: its place in data_keys, or its name in a dict call ("mask_depth").
               wavelengths: of the channels that come in [m], for plain stages; None for the primaries of a picture of 3
               channels, and for other numbers as many bands from 420 to 720 nm.
               Others: as for `K.AugmentationSequential`.
    Raises:    ValueError for stages that contradict each other or stand in an impossible order, geometry between a
        mosaic and its demosaic, random_apply with stages; at the call for a depth_key that is no mask, or a module that
        changes its channels without saying so.

    Example:
    >>> picture, near = torch.rand(2, 3, 32, 32), torch.full((2, 1, 32, 32), 0.5)  # 2 m everywhere [1/m]
    >>> augment = KC.CameraSequential(KC.RandomDefocus(p=1.0), KC.RandomBayer(), data_keys=["input", "mask"])
    >>> [tuple(part.shape) for part in augment(picture, near)]
    [(2, 3, 32, 32), (2, 1, 32, 32)]
    """

    def __init__(
        self,
        *args: Any,
        data_keys: Sequence[str] | Sequence[int] | Sequence[DataKey] | None = (DataKey.INPUT,),
        depth: bool = True,
        depth_key: int | str | None = None,
        wavelengths: Tensor | list[float] | None = None,
        same_on_batch: bool | None = None,
        keepdim: bool | None = None,
        random_apply: int | bool | tuple[int, int] = False,
        random_apply_weights: Sequence[float] | Tensor | None = None,
        extra_args: dict[DataKey, dict[str, Any]] | None = None,
    ) -> None:
        super().__init__(
            *args,
            data_keys=data_keys,
            same_on_batch=same_on_batch,
            keepdim=keepdim,
            random_apply=random_apply,
            random_apply_weights=random_apply_weights,
            extra_args=extra_args,
        )
        self.depth, self.depth_key = depth, depth_key
        self.wavelengths = None if wavelengths is None else wavelength_grid(wavelengths)
        self._bands: Tensor | None = None
        self.transform_op: _Ops = _Ops(self.data_keys, self)
        if random_apply and self._stages():
            raise ValueError("random_apply would shuffle camera stages, which light passes in order. Leave it out.")
        self.context()
        _check_geometry(_flat(self.children()))
        self._linear = _in_linear_light(self.named_children())

    def _stages(self) -> list[nn.Module]:
        return [module for module in _flat(self.children()) if isinstance(module, Stage)]

    def context(self) -> Context:
        """What the stages tell each other, and the wavelengths of what came in."""
        context = Camera(*self._stages()).resolve()
        return context if self._bands is None else dataclasses.replace(context, wavelengths=self._bands)

    def output_channels(self, channels: int) -> int:
        """Channels of the result for so many of the input."""
        context = self.context()
        for module in self.children():
            channels = self._after(module, channels, context)
        return channels

    @staticmethod
    def _after(module: nn.Module, channels: int, context: Context | None = None) -> int:
        if isinstance(module, Stage):
            return module.output_channels(channels, context)
        known: Any = getattr(module, "output_channels", None)
        return known(channels) if callable(known) else channels

    def forward_parameters(self, batch_shape: torch.Size) -> list[ParamItem]:
        """Kornia's, for the shape that really reaches each module."""
        params = []
        context = self.context()
        module: Any
        for name, module in self.get_forward_sequence():
            draws = isinstance(module, (_AugmentationBase, K.MixAugmentationBaseV2, ImageSequentialBase))
            param = ParamItem(name, module.forward_parameters(batch_shape) if draws else None)
            after = list(_get_new_batch_shape(param, batch_shape, module))
            after[-3] = self._after(module, batch_shape[-3], context)
            batch_shape = torch.Size(after)
            params.append(param)
        light = None if torch.compiler.is_compiling() else _LIGHT.get()
        if light is not None and light.owner is self:
            light.begin(params)
        return params

    def transform_inputs(
        self, input: Tensor, params: list[ParamItem], extra_args: dict[str, Any] | None = None
    ) -> Tensor:
        """What another container calls: pictures alone."""
        self.clear_state()
        self._enters(input)
        light = _Light(self)
        if not torch.compiler.is_compiling():
            light.begin(params)
        for param in params:
            module = self.get_submodule(param.name)
            if self.runs(module):
                input = self.run(module, input, depth=None)
            else:
                input, told = light.enter(module, param, input)
                told = {**(extra_args or {}), **self.told(param.name), **told}
                input = InputSequentialOps.transform(input, module=module, param=param, extra_args=told)
                input = light.leave(param, input)
            self._update_transform_matrix_by_module(module)
        self._params = params
        return input

    def told(self, name: str) -> dict[str, Tensor]:
        """What a child is told of where it stands: that what reaches it is linear light, not a coded picture.

        Or that the wavelengths of what came in are known: four channels are then bands, not red, green, blue and alpha.
        """
        if name in self._linear:
            return {"linear": torch.ones(())}
        module = self.get_submodule(name)
        ours = self.wavelengths is not None and isinstance(module, (CameraAugmentation, RandomLens))
        return {"cube": torch.ones(())} if ours else {}

    def takes_light(self, params: list[ParamItem]) -> list[bool]:
        """Which of the modules that a call runs takes a picture as linear light, and gives a picture."""
        return [
            isinstance(module, (CameraAugmentation, RandomLens))
            and module.in_light
            and name not in self._linear
            and self._after(module, 3) == 3
            for name, module in ((param.name, self.get_submodule(param.name)) for param in params)
        ]

    @staticmethod
    def runs(module: nn.Module) -> bool:
        """Whether it is a plain module, which Kornia would call without context and without looking at its result."""
        return not isinstance(module, (_AugmentationBase, K.MixAugmentationBaseV2, ImageSequentialBase))

    def run(self, module: nn.Module, input: Tensor, *, depth: Tensor | None) -> Tensor:
        """A plain module; a stage is told of its neighbours, and an Imaging of the depth.

        A picture (C,H,W) or (H,W), which no augmentation has yet made a batch of, is one for as long.
        """
        if input.ndim < 4:
            result = self.run(module, input.reshape((1,) * (4 - input.ndim) + input.shape), depth=depth)
            alone = result[0]
            return alone[0] if input.ndim == 2 and alone.shape[0] == 1 else alone
        channels = input.shape[1]
        context = self.context()
        seen = _scene(input, depth, context) if isinstance(module, Imaging) and depth is not None else input
        result = applied(module, seen, context)
        if isinstance(module, Stage):
            return result
        after = result.shape[1] if isinstance(result, Tensor) and result.ndim == 4 else channels
        expected = self._after(module, channels)
        if after != expected:
            raise ValueError(
                f"{type(module).__name__} gave {after} channels for {channels}, and what follows was drawn for "
                f"{expected}. Give it a method output_channels(channels) that returns {after}."
            )
        return result

    def _enters(self, input: Tensor) -> None:
        """The wavelengths of what comes in: stages behind a filter still ask for them."""
        self._bands = None
        if self._stages() and input.ndim >= 3:
            self._bands = wavelengths_of(input, self.wavelengths)

    def forward(self, *args: Any, params: list[ParamItem] | None = None, data_keys: Any = None) -> Any:
        """As `K.AugmentationSequential`."""
        self.transform_op.names = []
        if torch.compiler.is_compiling():
            return super().forward(*args, params=params, data_keys=data_keys)
        light = _Light(self)
        if params is not None:  # given again; else they are drawn in `forward_parameters`
            light.begin(params)
        token = _LIGHT.set(light)
        try:
            return super().forward(*args, params=params, data_keys=data_keys)
        finally:
            _LIGHT.reset(token)

    def _arguments_preproc(self, *args: Any, data_keys: Any, params: Any = None) -> Any:
        seeing = self.depth and any(
            isinstance(module, Imaging) or getattr(module, "takes_depth", False) for module in self.children()
        )
        for place, (value, key) in enumerate(zip(args, data_keys, strict=False)):
            if key == DataKey.INPUT:
                if not isinstance(value, Tensor):
                    check_array(value, name="image", bands=self._known_bands())
                check_floats(value, name="image", takes=TAKES, channels=None)
                check_layout(value, wavelengths=self.wavelengths, alpha=True)
                self._enters(value)
            if key == DataKey.MASK and seeing and self.transform_op.is_depth(place, data_keys):
                _check_is_depth(value)
        return super()._arguments_preproc(*args, data_keys=data_keys, params=params)

    def to_tensor(self, x: Any) -> Tensor:
        """Kornia's, of what it reads as it is meant."""
        if not isinstance(x, (Tensor, str)):
            check_array(x, name="image", bands=self._known_bands())
        return super().to_tensor(x)

    def _known_bands(self) -> int | None:
        return None if self.wavelengths is None else len(self.wavelengths)

    def _preproc_dict_data(self, data: dict[str, Any]) -> Any:
        prepared = super()._preproc_dict_data(data)
        self.transform_op.names = list(prepared[0])  # without the keys that Kornia passes through: places count
        return prepared


class _Ops(AugmentationSequentialOps):
    """Hands the depth and the context to the modules that want them."""

    def __init__(self, data_keys: list[DataKey] | None, owner: CameraSequential) -> None:
        super().__init__(data_keys)
        self.owner = [owner]  # in a list: a module in an attribute would be its child
        self.names: list[str] = []

    def transform(self, *arg: Any, module: nn.Module, param: ParamItem, extra_args: Any, data_keys: Any = None) -> Any:
        owner = self.owner[0]
        keys = self.preproc_datakeys(data_keys)
        if owner.runs(module):
            depth = self._depth(arg, keys) if isinstance(module, Imaging) else None
            outputs = [
                owner.run(module, value, depth=depth) if key == DataKey.INPUT else value
                for value, key in zip(arg, keys, strict=True)
            ]
            return outputs[0] if len(outputs) == 1 else outputs
        own = owner.told(param.name)
        if getattr(module, "takes_depth", False):
            depth = self._depth(arg, keys)
            own |= {} if depth is None else {"inverse_depth": depth}
        inputs: list[Any] = list(arg)
        light = None if torch.compiler.is_compiling() else _LIGHT.get()
        picture = keys.index(DataKey.INPUT) if keys.count(DataKey.INPUT) == 1 else None
        if light is not None and light.owner is owner and picture is not None:
            inputs[picture], told = light.enter(module, param, inputs[picture])
            own |= told
        if own:
            extra_args = {**extra_args, DataKey.INPUT: {**extra_args.get(DataKey.INPUT, {}), **own}}
        found: Any = super().transform(*inputs, module=module, param=param, extra_args=extra_args, data_keys=data_keys)
        results = [found] if len(arg) == 1 else list(found)
        if light is not None and light.owner is owner and picture is not None:
            results[picture] = light.leave(param, results[picture])
        return results[0] if len(arg) == 1 else results

    def _place(self, keys: Sequence[DataKey]) -> int | None:
        """Which argument is the depth; None where none is."""
        owner = self.owner[0]
        masks = [index for index, key in enumerate(keys) if key == DataKey.MASK]
        wanted = owner.depth_key
        if not owner.depth or (wanted is None and not masks):
            return None
        if wanted is None:
            return masks[0]
        if isinstance(wanted, str):
            index = self.names.index(wanted) if wanted in self.names else -1
        else:
            index = wanted
        if index not in masks:
            raise ValueError(
                f"depth_key={wanted!r} is none of the masks of this call, which are at {masks} of "
                f"{[key.name for key in keys]}. Give its place in data_keys, or its name in the dict."
            )
        return index

    def is_depth(self, place: int, keys: Sequence[DataKey]) -> bool:
        """Whether the argument at a place is the depth, in the order in which the caller gave them."""
        return place == self._place(keys)

    def _depth(self, arg: Sequence[Any], keys: list[DataKey]) -> Tensor | None:
        """The mask that is a depth, as it is now."""
        index = self._place(keys)
        if index is None:
            return None
        if not isinstance(arg[index], Tensor):
            raise TypeError("the depth is a list of masks of different sizes; expected one tensor (B,1,H,W).")
        return arg[index]


class _Light:
    """The way of a picture through neighbours that all take linear light: taken there once, and coded once behind them.

    Rows that none of them drew come out as they went in. It belongs to one call.

    Args:      owner: whose call it is.
    """

    def __init__(self, owner: CameraSequential) -> None:
        self.owner = owner
        self._params: list[ParamItem] = []
        self._takes = [False]
        self._coded: Tensor | None = None

    def begin(self, params: list[ParamItem]) -> None:
        """Look ahead at what is to be run: which of it takes light."""
        self._params, self._takes = params, [*self.owner.takes_light(params), False]

    def _place(self, param: ParamItem) -> int:
        return next((place for place, own in enumerate(self._params) if own is param), len(self._params))

    def enter(self, module: Any, param: ParamItem, input: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """What a module gets, and is told of it."""
        place = self._place(param)
        if not self._takes[place]:
            return input, {}
        if self._coded is None:
            picture = input.ndim in (3, 4) and input.numel() > 0 and is_picture(input)
            if not picture or not self._takes[place + 1]:
                return input, {}
            check_values(input, picture=True)
            self._coded, self._keepdim = input, True
            batch = input if input.ndim == 4 else input[None]
            self._drawn = torch.zeros(len(batch), dtype=torch.bool)
            input = to_light(batch if batch.dtype in (torch.float32, torch.float64) else batch.float())
        drawn: Any = param.data
        self._drawn |= True if module.p == 1 else torch.atleast_1d(drawn["batch_prob"] > 0.5).cpu()
        self._keepdim &= bool(module.keepdim)
        return input, {"linear": torch.ones(()), "run": torch.ones(())}

    def leave(self, param: ParamItem, output: Tensor) -> Tensor:
        """What comes out of it."""
        coded = self._coded
        if coded is None or self._takes[self._place(param) + 1]:
            return output
        self._coded = None
        picture = to_code(output).to(coded.dtype)
        others = (~self._drawn).nonzero().flatten().to(coded.device)
        if len(others):
            picture = picture.index_copy(0, others, coded.view_as(picture)[others])
        return picture[0] if coded.ndim == 3 and self._keepdim else picture


_LIGHT: ContextVar[_Light | None] = ContextVar("light", default=None)
"""Of the call that runs in this thread; none to torch.compile, where each augmentation goes its own way."""


def _check_is_depth(mask: Any) -> None:
    """TypeError for a mask of classes, a warning for one that reaches nearer than a centimetre."""
    if not isinstance(mask, Tensor):
        return  # Kornia, or `_depth`, says what is wrong
    if not mask.is_floating_point():
        raise TypeError(
            f"the first mask is taken for inverse depth in 1/m, and is of {mask.dtype}: classes, it seems. Say "
            "depth=False where it is none, or depth_key= which mask it is."
        )
    nearest = float(mask.detach().max()) if mask.numel() else 0.0
    if nearest > _NEAR:
        warnings.warn(
            f"the first mask is taken for inverse depth and reaches {nearest:g} 1/m, {1e3 / nearest:.2g} mm from the "
            "lens. If it is none, say depth=False.",
            stacklevel=4,
        )


def _scene(bands: Tensor, depth: Tensor, context: Context) -> Scene:
    light = "D65" if context.illuminant is None else context.illuminant
    scene = Scene.from_bands(bands, wavelengths=context.wavelengths, illuminant=light)
    return dataclasses.replace(scene, depth=1 / finite_vergence(depth, bands))


def _flat(modules: Iterable[nn.Module]) -> Iterator[nn.Module]:
    for module in modules:
        if isinstance(module, ImageSequentialBase):
            yield from _flat(module.children())
        else:
            yield module


def _in_linear_light(children: Iterable[tuple[str, nn.Module]]) -> set[str]:
    """Names of our augmentations that stand behind a colour filter or a mosaic and before the tone curve."""
    linear, found = False, set()
    for name, module in children:
        if isinstance(module, (ColourFilter, Mosaic)):
            linear = True
        elif isinstance(module, ToneCurve):
            linear = False
        elif linear and isinstance(module, (CameraAugmentation, RandomLens)):
            found.add(name)
    return found


def _check_geometry(modules: Iterable[nn.Module]) -> None:
    mosaic = None
    for module in modules:
        if isinstance(module, Mosaic) or (isinstance(module, ColourFilter) and module.is_tile):
            mosaic = type(module).__name__
        elif isinstance(module, DEMOSAICING):
            mosaic = None
        elif mosaic and isinstance(module, K.GeometricAugmentationBase2D):
            raise ValueError(
                f"{type(module).__name__} stands between {mosaic} and the demosaic: moved pixels would get the colour "
                f"of others. Put it before {mosaic} or after the Demosaic."
            )
