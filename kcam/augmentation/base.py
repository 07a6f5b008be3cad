"""What all camera augmentations share: pictures in linear light, work for drawn rows only, noise from seeds.

A tensor of 3 channels (or 1, gray) is a *picture*: sRGB, coded, in [0,1]. It is taken to linear light, and back, where
the physics needs it; the result lies in [0,1]. Any other number of channels is a *cube*: spectral bands of light, from
420 to 720 nm in equal steps unless `wavelengths` says otherwise. A perfect white has the spectrum of daylight with
Y = 1, as in `Scene.from_bands`: about 1 in each band, not 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import kornia.augmentation as K
import torch
from torch import Tensor

from kcam.augmentation.distributions import Draw, Draws
from kcam.cache import is_plain
from kcam.inputs import ALPHA, as_map, as_values, channels_last, check_floats, remedy, scale_remedy
from kcam.precision import full_precision
from kcam.srgb import to_code, to_light
from kcam.ste import clip_ste
from kcam.units import nm, wavelength_grid

RGB_WAVELENGTHS = (611.4 * nm, 549.1 * nm, 464.2 * nm)
"""Dominant wavelengths of the primaries of sRGB, seen against its white (from CIE 1931 chromaticities)."""


_LARGE = 2**20
"""Numbers of a row, a cube's, from which on a CPU rows are given one by one: see `on_drawn_rows`."""
TOLD = frozenset({"linear", "run", "cube"})
"""What a `CameraSequential` says of where an augmentation stands: nothing that was drawn."""
LEAST_VERGENCE = 1e-9
"""1/m: where a distance is asked for, a map's 0 is a million kilometres."""
TAKES = "(B,C,H,W), a picture in [0,1] or a cube"
_LEAST, _LARGEST = -0.5, 2.5
"""Of a picture: some beyond 0 and 1 come from other augmentations; from here on it is another scale."""


def is_picture(signal: Tensor) -> bool:
    """Whether a tensor (..., C, H, W) is a coded picture rather than a cube of linear light."""
    return signal.shape[-3] in (1, 3)


def wavelengths_of(signal: Tensor, given: Tensor | None) -> Tensor:
    """Wavelength of each channel (C,) float64 [m]: those given, the primaries of a picture, or the bands of a cube."""
    channels = signal.shape[-3]
    if given is not None:
        if len(given) != channels:
            raise ValueError(
                f"{len(given)} wavelengths do not fit {channels} channels; pass one for each channel, in metres."
            )
        return given
    if channels == 3:
        return wavelength_grid(list(RGB_WAVELENGTHS))
    return wavelength_grid([RGB_WAVELENGTHS[1]]) if channels == 1 else wavelength_grid(count=channels)


def each_generator(seeds: Tensor, device: torch.device) -> Iterator[torch.Generator | None]:
    """A generator for each sample; under torch.compile, which cannot hold one, torch's own."""
    for seed in seeds.unbind():
        if torch.compiler.is_compiling():
            yield None
        else:
            yield torch.Generator(device).manual_seed(int(seed))


def per_sample(values: Tensor, signal: Tensor) -> Tensor:
    """(B,) in the type of a signal (B,C,H,W), to be multiplied with it."""
    return values.to(signal)[:, None, None, None]


def check_probability(p: float) -> None:
    """ValueError, TypeError unless p is a probability."""
    if isinstance(p, bool) or not isinstance(p, (int, float)):
        raise TypeError(f"p must be a probability such as 0.5, got {p!r}.")
    if not 0 <= p <= 1:
        raise ValueError(f"p must be a probability from 0 to 1, got {p:g}.")


def check_values(signal: Tensor, *, picture: bool) -> None:
    """ValueError for NaN or infinity, which a blur would spread over all, and for a picture on another scale."""
    if torch.compiler.is_compiling():
        return
    low, high = (float(value) for value in signal.detach().aminmax())
    if not (math.isfinite(low) and math.isfinite(high)):
        raise ValueError(f"the input has values from {low:g} to {high:g}, expected finite ones. Remove NaN and inf.")
    if picture and (high > _LARGEST or low < _LEAST):
        fix = scale_remedy(low, high, name="image")
        raise ValueError(f"the picture has values from {low:g} to {high:g}, expected sRGB in [0,1].{fix}")


def check_layout(input: Tensor, *, wavelengths: Tensor | None = None, alpha: bool = False) -> None:
    """ValueError for a tensor that is neither a picture nor a cube (..., C, H, W): channels last, with alpha, clips.

    Args:      wavelengths: where there is one for each channel, it is a cube.  alpha: whether it may be there.
    """
    shape = tuple(input.shape)
    if 2 <= len(shape) <= 4 and (len(shape) == 2 or is_picture(input)):
        return
    known = wavelengths is not None and len(wavelengths) == shape[-3]
    if len(shape) not in (3, 4) or (not known and (channels_last(shape) or (shape[-3] == ALPHA and not alpha))):
        fix = remedy(input, name="image", channels=(1, 3, ALPHA) if alpha else (1, 3), scaled=False)
        bands = (
            f" If these are {shape[-3]} bands, give a CameraSequential their wavelengths=." if len(shape) > 2 else ""
        )
        raise ValueError(
            f"the input has shape {shape}, expected (B,C,H,W): a picture of 3 channels, or 1 if gray, or a cube."
            f"{fix}{bands}"
        )


def check_inverse_depth(depth: Tensor, signal: Tensor) -> Tensor:
    """A map of inverse depth as (B,1,H,W) on the device of a signal (B,C,H,W): of a map, or one number per sample.

    Raises:    TypeError, ValueError for what can be none.
    """
    values = as_values(depth, name="inverse_depth", unit="1/m")
    batch, _, height, width = signal.shape
    values = as_map(values, shape=(batch, height, width), name="inverse_depth", unit=" in 1/m")
    if values.numel():
        low, high = (float(bound) for bound in values.detach().aminmax())
        if not (low >= 0 and math.isfinite(high)):
            raise ValueError(
                f"inverse_depth has values from {low:g} to {high:g}, expected finite ones >= 0 [1/m]: 1 over the "
                "distance in metres, 0 at infinity. Use 1 / depth."
            )
    values = values if values.ndim == 4 else values.reshape(-1, 1, 1, 1).expand(batch, 1, height, width)
    return values.to(signal.device)


def finite_vergence(depth: Tensor, signal: Tensor) -> Tensor:
    """A map of inverse depth that a distance can be made of, float64; errors as `check_inverse_depth`."""
    return check_inverse_depth(depth, signal).double().clamp(min=LEAST_VERGENCE)


class Checked:
    """What every augmentation here says of an input that it cannot take, before Kornia does."""

    wavelengths: Tensor | None = None
    takes_alpha = False
    """Whether all channels are treated alike, whatever they hold."""

    def forward(self, input: Tensor, params: dict[str, Any] | None = None, **kwargs: Any) -> Tensor:
        """As Kornia's. Raises: TypeError, ValueError with the code that makes the input right."""
        check_floats(input, name="image", takes=TAKES, channels=None)
        if not {"linear", "cube"} & kwargs.keys():  # from `CameraSequential`, which knows what it gives
            check_layout(input, wavelengths=self.wavelengths, alpha=self.takes_alpha)
        return super().forward(input, params, **kwargs)  # type: ignore[misc]

    def transform_inputs(
        self,
        input: Tensor,
        params: dict[str, Any],
        flags: dict[str, Any],
        transform: Tensor | None = None,
        **kwargs: Any,
    ) -> Tensor:
        """Kornia's, without its choice between two whole batches: `on_drawn_rows` leaves the other rows as they are.
        What comes with channels last in memory goes so.

        torch.compile must not ask which rows were drawn: there all are transformed, and Kornia chooses.
        """
        if torch.compiler.is_compiling():
            return super().transform_inputs(input, params, flags, transform, **kwargs)  # type: ignore[misc]
        own: Any = self
        params, flags = own._process_kwargs_to_params_and_flags(params, flags, **kwargs)
        batch = own.transform_tensor(input)
        own.validate_tensor(batch)
        output = own.apply_transform(batch, params, flags, transform=transform)
        if batch.is_contiguous(memory_format=torch.channels_last) and not batch.is_contiguous():
            output = output.contiguous(memory_format=torch.channels_last)
        own._commit_state(params={name: value for name, value in params.items() if name not in TOLD})  # for a replay
        return own.transform_output_tensor(output, input.shape)


def on_drawn_rows(
    input: Tensor,
    params: dict[str, Any],
    drawn: dict[str, Tensor],
    effect: Callable[[Tensor, dict[str, Tensor]], Tensor],
    *,
    p: float,
    alone: bool = False,
) -> Tensor:
    """effect(rows, their numbers) of the rows of a batch that were drawn; the others as they are, and at no cost.

    drawn: the numbers of all rows, (B, ...) each. alone: for an effect that costs a few passes over memory, or works
    row by row anyway, and keeps the channels: large rows are given one by one, so that what it needs on the way stays
    near, where a batch would take fresh memory for each step.
    """
    if torch.compiler.is_compiling():
        return effect(input, drawn)
    gate = torch.atleast_1d(params["batch_prob"] > 0.5) if p < 1 and "batch_prob" in params else None
    if alone and len(input) > 1 and input[0].numel() >= _LARGE and input.device.type == "cpu" and is_plain(input):
        output = torch.empty_like(input)
        for index, chosen in enumerate([True] * len(input) if gate is None else gate.tolist()):
            row = slice(index, index + 1)
            own = {name: value[row] for name, value in drawn.items()} if chosen else {}
            output[row] = effect(input[row], own) if chosen else input[row]
        return output
    if gate is None or bool(gate.all()):
        return effect(input, drawn)
    rows = gate.nonzero().flatten()
    if rows.numel() == 0:
        return input
    here = rows.to(input.device)
    result = effect(input.index_select(0, here), {name: value[rows] for name, value in drawn.items()})
    if result.shape[1:] != input.shape[1:]:
        raise mixed(input.shape[1], result.shape[1], p=p)
    return input.index_copy(0, here, result)


def mixed(channels: int, after: int, *, p: float) -> ValueError:
    """What is wrong where some rows of a batch would get other channels."""
    return ValueError(
        f"this augmentation turns {channels} channels into {after}, which only some rows of a batch cannot have. "
        f"Use p=1.0, not p={p:g}."
    )


class CameraAugmentation(Checked, K.IntensityAugmentationBase2D):
    """Base of the augmentations that keep the pixel grid. A subclass computes in `simulate`.

    Kornia transforms all rows and then throws away those that were not drawn; here they cost nothing. Half precision
    is computed in float32, outside of autocast, and given back as it came. An empty batch gives an empty one.

    Example:
    >>> from kcam.augmentation.distributions import Uniform
    >>> class RandomDim(KC.CameraAugmentation):
    ...     def simulate(self, signal, drawn):  # linear light
    ...         return signal * drawn["share"].to(signal)[:, None, None, None]
    >>> round(float(RandomDim({"share": Uniform(0.5)}, p=1.0)(torch.full((1, 3, 4, 4), 1.0))[0, 0, 0, 0]), 3)  # of sRGB
    0.735
    """

    in_light = True
    """Whether `simulate` wants pictures in linear light."""
    takes_depth = False
    """Whether a map of inverse depth matters to it."""
    alone = False
    """Whether rows as large as a cube's are better given to `simulate` one by one: see `on_drawn_rows`."""

    def __init__(
        self, draws: Mapping[str, Draw], *, same_on_batch: bool = False, p: float = 0.5, keepdim: bool = False
    ) -> None:
        check_probability(p)
        super().__init__(p=p, same_on_batch=same_on_batch, p_batch=1.0, keepdim=keepdim)
        self._param_generator: Draws = Draws(draws)

    def bounds(self, name: str) -> tuple[float, float]:
        """The bounds that a number is drawn between."""
        return self._param_generator.bounds(name)

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """The effect on (B,C,H,W), B > 0, float32 or float64, with what was drawn for these rows."""
        raise NotImplementedError(f"{type(self).__name__} does not say what it does.")

    def output_channels(self, channels: int) -> int:
        """Channels of the result for so many of the input."""
        return channels

    def generate_parameters(self, batch_shape: tuple[int, ...]) -> dict[str, Tensor]:
        """What is drawn; where the channels change, also the shape after it.

        Kornia's containers draw for later stages beforehand, and would for the channels of the input.
        """
        drawn = super().generate_parameters(batch_shape)
        batch, channels = batch_shape[0], batch_shape[-3]
        after = self.output_channels(channels)
        if after == channels:
            return drawn
        if self.p < 1:
            raise mixed(channels, after, p=self.p)
        return drawn | {"output_size": torch.tensor([[after, *batch_shape[-2:]]]).expand(batch, 3)}

    def apply_transform(
        self, input: Tensor, params: dict[str, Any], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """Kornia's hook: the rows that were drawn through `simulate`."""
        drawn = self._drawn(params, input)
        if input.numel() == 0:
            shape = (input.shape[0], self.output_channels(input.shape[1]), *input.shape[2:])
            return input.new_zeros(shape) + input.sum()

        def effect(rows: Tensor, own: dict[str, Tensor]) -> Tensor:
            return simulated(rows, lambda light: self.simulate(light, own), told=params, in_light=self.in_light)

        return on_drawn_rows(input, params, drawn, effect, p=self.p, alone=self.alone)

    def _drawn(self, params: dict[str, Any], input: Tensor) -> dict[str, Tensor]:
        """The drawn numbers, (B, ...) each; frames of one clip get their own noise, but the same lens and sensor."""
        drawn = {name: params[name] for name in self._param_generator.draws}
        if "noise_seed" in drawn and "video_batch_size" in params:
            rows = drawn["noise_seed"].shape[0]
            frames = rows // max(1, int(params["video_batch_size"]))
            drawn["noise_seed"] = drawn["noise_seed"] + torch.arange(rows) % max(1, frames)
        if "depth" in params:
            raise TypeError("depth= is not known: give inverse_depth=1 / depth, in 1/m, 0 at infinity.")
        if "inverse_depth" in params:
            if not self.takes_depth:
                raise TypeError(f"{type(self).__name__} takes no inverse_depth: what it does is the same everywhere.")
            drawn["inverse_depth"] = check_inverse_depth(params["inverse_depth"], input)
        return drawn


def simulated(
    input: Tensor, effect: Callable[[Tensor], Tensor], *, told: Mapping[str, Any], in_light: bool = True
) -> Tensor:
    """An effect on (B,C,H,W), checked, in float32 at least and outside of autocast; of the type of the input.

    told: by a `CameraSequential`: "linear", that a picture is linear light already, between a colour filter and a tone
    curve; and "run", between neighbours that take light too, so that it is still to be clipped as a picture is.
    in_light: whether the effect wants light.
    """
    working = input if input.dtype in (torch.float32, torch.float64) else input.float()
    picture = is_picture(working) and "linear" not in told
    check_values(working, picture=picture)
    with full_precision(input.device):
        coded = in_light and picture
        result = effect(to_light(working) if coded else working)
        if "run" in told:
            result = clip_ste(result, 0.0, 1.0)  # not in place: what `simulate` gives may be kept by its class
        return (to_code(result) if coded else result).to(input.dtype)
