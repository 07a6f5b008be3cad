"""Hot and dead pixels: the few of a sensor that record something else than light.

A hot pixel has a dark current far above the others', the tail of a distribution that falls off exponentially; a dead
one records nothing, a stuck one always a full well. Which they are is the sensor's, so that all frames have the same.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kcam.context import Context, Stage
from kcam.effects import relative_change
from kcam.sensor.arguments import (
    MOST_ELECTRONS,
    check_full_well,
    check_not_negative,
    check_seed,
    hold,
    in_float32,
    like,
)
from kcam.units import as_numbers, percent_hint


def defect_fields(shape: tuple[int, ...], *, seed: int) -> tuple[Tensor, Tensor]:
    """Of each pixel of one sensor: a number in 0..1 that decides what it is, and its dark electrons if it is hot, over
    their mean; float64 on the CPU, the same at every call.
    """
    generator = torch.Generator().manual_seed(seed)
    kind, tail = torch.rand((2, *shape), generator=generator, dtype=torch.float64)
    return kind, -torch.log1p(-tail)


@in_float32
def defect_pixels(
    signal: Tensor,
    *,
    hot: float,
    dead: float,
    stuck: float = 0.0,
    electrons: Tensor | float,
    full_well: Tensor | float,
    seed: int,
) -> Tensor:
    """Replace what some pixels of a sensor record.

    result = signal + m a / full_well of the hot pixels, m the mean and a ~ Exp(1) each pixel's own; 0 of the dead, 1 of
    the stuck, the signal of all others

    Args:      signal: (..., C, H, W), expected electrons as a share of the full well.
               hot, dead, stuck: shares of the pixels, together at most 1.
               electrons: m, mean dark electrons of a hot pixel in this exposure: see `dark_electrons`.
               full_well: saturation capacity [electrons].
               seed: names the sensor: one seed and (C,H,W) give the same pixels in every frame and on every device, and
               a larger share those of a smaller one and more.
    Returns:   share of the full well, not clipped: ShotNoise counts, and stops at the well.
    Source:    R. Widenhorn et al., Temperature dependence of dark current in a CCD, Proc. SPIE 4669, 193 (2002), for
               the exponential tail of dark currents; EMVA 1288 release 4.0 for defect pixels.

    Example:
    >>> gray = torch.full((1, 1, 200, 200), 0.25)
    >>> shot = sensor.defect_pixels(gray, hot=0.01, dead=0.005, electrons=500.0, full_well=10_000, seed=0)
    >>> int((shot > 0.25).sum()), int((shot == 0).sum())  # about 400 and 200 of 40 000
    (408, 180)
    """
    kind, tail = (field.to(signal.device) for field in defect_fields(tuple(signal.shape[-3:]), seed=seed))
    # counted from both ends, so that a share does not move the pixels of another
    is_dead, is_stuck = kind < dead, (kind >= dead) & (kind < dead + stuck)
    is_hot = (kind >= 1 - hot) & ~is_dead & ~is_stuck
    amount = like(electrons, signal) * (tail * is_hot).to(signal) / like(full_well, signal)
    working = torch.where(is_dead | is_stuck, torch.zeros_like(signal), signal) + amount
    return working + is_stuck.to(signal)


class DefectPixels(Stage):
    """Hot, dead and stuck pixels of one sensor: `defect_pixels`.

    It stands before ShotNoise, which counts the dark electrons of hot pixels as it counts light, and is no noise
    itself: a camera that is `noiseless` keeps its defects, and `camera.linear(scene)` knows them.

    Args:      hot, dead, stuck: shares of the pixels, each 0 to 1 and together at most 1: 1e-4 is 100 per megapixel.
               electrons: mean dark electrons of a hot pixel in this exposure, >= 0; they are spread exponentially.
               seed: names the sensor, an integer.
               full_well: saturation capacity [electrons]; None to take it from the context.
    Raises:    ValueError for shares that cannot be, negative electrons or a full well <= 0; TypeError for a seed that
               is no integer.

    Example:
    >>> defects = sensor.DefectPixels(hot=0.02, dead=0.0, electrons=300.0, seed=3)
    >>> one, two = (defects(torch.full((1, 1, 50, 50), level)) - level for level in (0.1, 0.2))
    >>> bool(torch.allclose(one, two, atol=1e-6)), int((one > 0).sum())  # the same of every frame: 2 % of 2500
    (True, 49)
    """

    whole_picture = True
    """It depends on which pixels there are: what a crop of a picture changes by tells little of the whole."""

    hot: float
    dead: float
    stuck: float
    electrons: Tensor | float
    seed: int
    full_well: Tensor | float | None

    def __init__(
        self,
        hot: float = 1e-4,
        *,
        dead: float = 1e-5,
        stuck: float = 0.0,
        electrons: Tensor | float = 500.0,
        seed: int = 0,
        full_well: Tensor | float | None = None,
    ):
        super().__init__()
        shares = {"hot": hot, "dead": dead, "stuck": stuck}
        for name, value in shares.items():
            number = as_numbers(value, name=name, expected="a share of the pixels such as 1e-4").detach()
            if number.numel() != 1 or not 0 <= float(number) <= 1:
                shown = f"{float(number):g}" if number.numel() == 1 else f"{number.numel()} of them"
                hint = percent_hint(float(number.max())) if number.numel() == 1 else ""
                raise ValueError(f"{name} must be a share of the pixels from 0 to 1, such as 1e-4, got {shown}.{hint}")
            shares[name] = float(number)
        if sum(shares.values()) > 1:
            raise ValueError(f"hot, dead and stuck are {sum(shares.values()):g} of the pixels together, more than all.")
        check_not_negative(electrons, name="electrons", unit="electrons", most=MOST_ELECTRONS)
        check_seed(seed)
        check_full_well(full_well)
        hold(self, **shares, electrons=electrons, seed=seed, full_well=full_well)

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,C,H,W) to the same shape: see `defect_pixels`. It draws nothing, so it takes no generator."""
        full_well = (context or Context()).full_well if self.full_well is None else self.full_well
        return defect_pixels(
            signal,
            hot=self.hot,
            dead=self.dead,
            stuck=self.stuck,
            electrons=self.electrons,
            full_well=full_well,
            seed=self.seed,
        )

    def provides(self) -> dict[str, Tensor | float]:
        """The full well, where it was given."""
        return {} if self.full_well is None else {"full_well": self.full_well}

    def error_if_skipped(self, signal: Tensor, context: Context | None = None) -> float:
        """The change of this signal; see `kcam.effects.Skippable`."""
        return relative_change(self, signal, context)

    def cost(self, signal: Tensor, context: Context | None = None) -> float:
        """Two random numbers for each pixel, and a logarithm."""
        return 25.0

    def reason(self, signal: Tensor, context: Context | None = None) -> str:
        """How many there are in a megapixel."""
        found = [f"{share * 1e6:.6g} {name}" for name in ("hot", "dead", "stuck") if (share := getattr(self, name))]
        pixels = f"{', '.join(found) or 'no defect'} pixels per megapixel"
        return f"{pixels}, {self.error_if_skipped(signal, context):.1e} of the signal's RMS"
