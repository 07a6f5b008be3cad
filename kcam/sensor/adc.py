"""The analogue-to-digital converter: gain, black level, clipping and steps."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

from kcam.cache import is_plain
from kcam.context import Context, Stage
from kcam.sensor.arguments import check_not_negative, hold, in_float32, like
from kcam.sensor.noise import DarkCurrent, ShotNoise
from kcam.sensor.random_stage import rms
from kcam.ste import clip_ste, round_ste
from kcam.units import check_flag, check_positive


@in_float32
def quantise(
    signal: Tensor,
    *,
    bits: int | Tensor,
    black_level: Tensor | float = 0.0,
    gain: Tensor | float = 1.0,
    rounding: bool = True,
    clamp_black: bool = False,
) -> Tensor:
    """Convert a voltage to one of 2^bits numbers.

    y = round_ste( (2^bits - 1) clip_ste(gain signal + black_level / (2^bits - 1), 0, 1) ) / (2^bits - 1)

    in this order: amplify, add the black level, clip, round. With `clamp_black` what noise takes below the black level
    is cut to it first, so that in the dark the mean of a noise sigma is sigma / sqrt(2 pi) above it. The gradient is
    `gain` inside the range, whatever the rounding, and that of `clip_ste` outside.

    Args:      signal: any shape, 1.0 = full well.  bits: 1..24, the steps that float32 can hold; a tensor
               of whole numbers is broadcast against the signal.
               black_level: the number that no light gives [DN].  gain: analogue gain, 1 at base ISO.
               rounding: False leaves the steps out.  clamp_black: of cameras that cut raw values off at black.
    Returns:   same shape, 1.0 = full scale (2^bits - 1 DN).
    Valid when the dtype holds the steps: float16 has 11 bits, bfloat16 8, and is given back with those.

    Example:
    >>> [round(float(15 * sensor.quantise(torch.tensor(share), bits=4)), 3) for share in (0.0, 0.31, 1.7)]  # DN of 15
    [0.0, 5.0, 15.0]
    """
    top = 2**bits - 1 if isinstance(bits, int) else like(2 ** bits.long() - 1, signal)
    amplified = signal if _is(gain, 1.0) else signal * like(gain, signal)
    if clamp_black:
        amplified = clip_ste(amplified, 0.0, None)
    level = clip_ste(amplified if _is(black_level, 0.0) else amplified + like(black_level, signal) / top, 0.0, 1.0)
    if not rounding:
        return level
    counts = level * top
    return counts.round_().div_(top) if is_plain(counts) else round_ste(counts) / top


def _is(value: Tensor | float, neutral: float) -> bool:
    return not isinstance(value, Tensor) and value == neutral


def saturation(stages: Iterable[nn.Module], context: Context) -> float:
    """The highest raw value of a sensor, as a share of full scale: of its converter, or of a well that is full first.

    min(1, gain + black_level);   1 without a stage that ends at the full well (ShotNoise, DarkCurrent)

    Args:      stages: of a camera.  context: as `Camera.resolve` gives it.

    Example:
    >>> stages = [sensor.ShotNoise(5_000), sensor.ADC(bits=12, black_level=64, gain=0.5)]
    >>> round(4095 * sensor.saturation(stages, Camera(*stages).resolve()), 1)  # DN
    2111.5
    """
    stages = list(stages)
    converter = next((stage for stage in stages if isinstance(stage, ADC)), None)
    if converter is None or not any(isinstance(stage, (ShotNoise, DarkCurrent)) for stage in stages):
        return 1.0
    gain, black = converter.gain_in(context), converter.black_level / (2**converter.bits - 1)
    return min(1.0, float(torch.as_tensor(gain + black).detach().max()))


class ADC(Stage):
    """The analogue-to-digital converter: `quantise`. Before it 1.0 is the full well, after it full scale.

    The overall system gain of EMVA 1288 is K = gain (2^bits - 1) / full_well [DN / electron].

    Args:      bits: 1..24.  black_level: the number that no light gives, 0 <= black_level < 2^bits - 1 [DN].
               gain: analogue gain, > 0; None to take it from the context (ISO / 100). The black level is added behind
               it, so that at a high gain it holds fewer electrons of read noise above 0.
               rounding: False leaves the steps out, as a `Plan` may.
               clamp_black: whether values below the black level are cut to it, as cameras do that subtract it before
               they write: a noise sigma then lifts the dark by sigma / sqrt(2 pi), which no later stage can tell from
               light. A `Plan` never leaves it out.
    Raises:    TypeError for bits that are no integer, or a flag that is none; ValueError for a value out of range.

    Example:
    >>> adc = sensor.ADC(bits=12, black_level=64)
    >>> (4095 * adc(torch.tensor([0.0, 0.5, 2.0]))).tolist()  # DN: black, half of the well, clipped
    [64.0, 2112.0, 4095.0]
    """

    bits: int
    black_level: Tensor | float
    gain: Tensor | float | None
    rounding: bool
    clamp_black: bool

    def __init__(
        self,
        bits: int = 12,
        *,
        black_level: Tensor | float = 0.0,
        gain: Tensor | float | None = None,
        rounding: bool = True,
        clamp_black: bool = False,
    ):
        super().__init__()
        if isinstance(bits, bool) or not isinstance(bits, int):
            raise TypeError(f"bits must be an integer such as 12, got {bits!r}.")
        if not 1 <= bits <= 24:
            raise ValueError(f"bits {bits} is outside 1..24; float32 holds no finer steps than 24 bits.")
        check_not_negative(black_level, name="black_level", unit="DN")
        highest = torch.as_tensor(black_level).detach().max().item()
        if highest >= 2**bits - 1:
            raise ValueError(
                f"black_level {highest:g} DN leaves no range: expected less than full scale, "
                f"{2**bits - 1} DN at {bits} bits. Black levels are in DN, not in shares of full scale."
            )
        check_flag(rounding, name="rounding")
        check_flag(clamp_black, name="clamp_black")
        if gain is not None:
            check_positive(gain, name="gain", unit="(1 at base ISO)")
        hold(self, bits=bits, black_level=black_level, gain=gain, rounding=rounding, clamp_black=clamp_black)

    def configuration(self) -> dict[str, Any]:
        """Constructor arguments, for saving: a clamp only where there is one: older versions read the others."""
        names = ("bits", "black_level", "gain", "rounding", *(("clamp_black",) if self.clamp_black else ()))
        return {name: getattr(self, name) for name in names}

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,C,H,W) to the same shape: see `quantise`."""
        return quantise(
            signal,
            bits=self.bits,
            black_level=self.black_level,
            gain=self.gain_in(context),
            rounding=self.rounding,
            clamp_black=self.clamp_black,
        )

    def gain_in(self, context: Context | None) -> Tensor | float:
        """Its own gain, or else the camera's."""
        return (context or Context()).gain if self.gain is None else self.gain

    def error_if_skipped(self, signal: Tensor, context: Context | None = None) -> float:
        """One step / sqrt(12), relative to the RMS of the signal; see `kcam.effects.Skippable`."""
        step = 1 / ((2**self.bits - 1) * float(torch.as_tensor(self.gain_in(context)).detach().max()))
        return step / 12**0.5 / rms(signal)

    def cost(self, signal: Tensor, context: Context | None = None) -> float:
        """Passes over the signal."""
        return 4.0

    def reason(self, signal: Tensor, context: Context | None = None) -> str:
        """The steps."""
        clamped = ", black clamped" if self.clamp_black else ""
        return f"{2**self.bits - 1} steps, {self.error_if_skipped(signal, context):.1e} of the signal's RMS{clamped}"

    def bypass(self) -> ADC:
        """What stands in for it when it is left out: its gain, black level and limits, without the steps."""
        return ADC(
            self.bits,
            black_level=self.black_level,
            gain=self.gain,
            rounding=False,
            clamp_black=self.clamp_black,
        )

    def provides(self) -> dict[str, Any]:
        """The black level as a share of full scale, and the gain where it was given."""
        fields: dict[str, Any] = {"black_level": self.black_level / (2**self.bits - 1)}
        return fields if self.gain is None else {**fields, "gain": self.gain}
