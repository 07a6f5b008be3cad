"""What passes between the stages of a camera beside the picture: one small frozen value.

A stage works alone from its own arguments; what it leaves open (None) it takes from here. A `Camera` fills the fields
that its stages provide when it is built, and those that the scene provides at each call.
"""

from __future__ import annotations

import inspect
from collections.abc import Container
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from kcam.units import wavelength_grid


@runtime_checkable
class Photometric(Protocol):
    """What exposure in seconds asks of optics; None where they do not know it."""

    def aperture_area(self) -> float | None:
        """Open area of the aperture [m^2]."""

    @property
    def sensor_distance(self) -> float | Tensor | None:
        """From the pupil to the sensor [m]."""


@runtime_checkable
class Curves(Protocol):
    """What exposure, white balance and colour matrix ask of a colour filter."""

    def response(self, wavelengths: Tensor) -> Tensor:
        """Transmission of each channel (C, L)."""

    def contraction(self, wavelengths: Tensor) -> Tensor:
        """Weights of the bands in each channel, (C, L), widths included."""

    def white(self, wavelengths: Tensor, *, illuminant: Tensor | None = None) -> Tensor:
        """What a perfect white gives in each channel, (C,)."""


@dataclass(frozen=True)
class Context:
    """Defaults that a stage falls back on: 28 bands, D65, RGGB, a full well of 10 000 electrons.

    Fields that a scene sets at each call:
        wavelengths: (L,) float64 [m].
        illuminant: (L,) relative spectral power of the light on a perfect white, or None for D65.
        luminance: of a perfect white [cd/m^2].
        depth: of what is seen, as a `Scene` has it [m]; None where there is no scene.
        generator: source of all randomness, or None for torch's default one.
    Fields that stages set when the camera is built:
        lens, pixel_pitch [m], fill_factor: the optics, for photometry.
        exposure_time [s], or None where nobody says.
        colour_filter: the filter whose curves white balance, exposure and colour matrix use.
        pattern: name of the mosaic.
        full_well, read_noise [electrons], gain (analogue, 1 at base ISO),
        white_share (of full scale), black_level (of full scale).

    Example:
    >>> context = kcam.Context()
    >>> len(context.wavelengths), context.pattern, context.full_well
    (28, 'RGGB', 10000.0)
    """

    wavelengths: Tensor = field(default_factory=wavelength_grid)
    illuminant: Tensor | None = None
    luminance: float = 1000.0
    generator: torch.Generator | None = None
    depth: Tensor | float | None = None
    lens: Photometric | None = None
    pixel_pitch: float = 4e-6
    fill_factor: float = 1.0
    exposure_time: Tensor | float | None = None
    colour_filter: Curves | None = None
    pattern: str = "RGGB"
    full_well: float = 10_000.0
    read_noise: float = 0.0
    gain: float = 1.0
    white_share: float = 0.8
    black_level: float = 0.0

    @property
    def exposed_white(self) -> Tensor | float:
        """A perfect white in green behind the ADC, of full scale: `white_share` of it, or of a well that is full first.

        Example:
        >>> [kcam.Context(gain=gain).exposed_white for gain in (0.5, 1.0, 8.0)]
        [0.4, 0.8, 0.8]
        """
        gain: Any = self.gain
        return self.white_share * (gain.clamp(max=1) if isinstance(gain, Tensor) else min(gain, 1.0))


def arguments_text(module: nn.Module, *, but: Container[str] = ()) -> str:
    """The constructor arguments that a module holds, as ``print`` shows them: a tensor of many values by its shape.

    Modules among them print themselves, and what was left open is left out, as are names in `but`.
    """
    configuration: Any = getattr(module, "configuration", None)
    if callable(configuration):
        held = configuration()
    else:
        own = vars(module) | dict(module.named_buffers(recurse=False)) | dict(module.named_parameters(recurse=False))
        held = {name: own.get(name) for name in inspect.signature(type(module)).parameters}
    shown = []
    for name, value in held.items():
        if name in but:
            continue
        if isinstance(value, Tensor):
            value = f"{value.item():g}" if value.numel() == 1 else tuple(value.shape)
            shown.append(f"{name}={value}")
        elif isinstance(value, (bool, int, str, tuple)):
            shown.append(f"{name}={value!r}")
        elif isinstance(value, float):
            shown.append(f"{name}={value:g}")
    return ", ".join(shown)


def applied(stage: nn.Module, signal: Any, context: Context, **others: Any) -> Any:
    """What a module makes of a signal: a stage is told its context, any other module is not."""
    return stage(signal, context, **others) if isinstance(stage, Stage) else stage(signal)


class Stage(nn.Module):
    """A module from tensor to tensor that may read a `Context`: ``stage(signal)`` or ``stage(signal, context)``.

    Example:
    >>> class Halve(kcam.Stage):
    ...     def forward(self, signal, context=None):
    ...         return signal / 2
    >>> (255 * Camera(Halve(), sensor.ADC(bits=8))(torch.ones(1, 1, 2, 2))).round().unique().tolist()  # DN
    [128.0]
    """

    def extra_repr(self) -> str:
        """The arguments."""
        return arguments_text(self)

    def output_channels(self, channels: int, context: Context | None = None) -> int:
        """Channels of the result for so many of the input: for containers that must know them beforehand."""
        return channels

    def provides(self) -> dict[str, Any]:
        """The `Context` fields that this stage determines for its neighbours (arguments left open are left out)."""
        return {}
