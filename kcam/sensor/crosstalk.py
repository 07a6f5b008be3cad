"""Crosstalk: light and electrons that a pixel loses to its neighbours, before they are counted.

Light that enters a pixel at an angle may cross into the next one below its filter (optical), and electrons that are
freed deep in the silicon diffuse before they are collected (electrical): red light, which goes deepest, most. Both are
a 3 x 3 of shares that belong to the pixel that the light fell on, so behind a mosaic they mix its colours.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from kcam.context import Context, Stage
from kcam.effects import relative_change
from kcam.sensor.arguments import hold, in_float32
from kcam.sensor.mosaic import at_pixels
from kcam.units import as_numbers, percent_hint


def crosstalk_kernel(optical: Tensor | float, electrical: Tensor | float) -> Tensor:
    """Where what falls on a pixel ends up: shares of the 3 x 3 around it.

    k = delta + o (n - delta) + (p (x) p - delta),   n = 1/4 at the four sides,   p = [q, 1 - 2 q, q],
    q = (1 - sqrt(1 - e)) / 2,   so that the middle keeps 1 - o - e, and the nine add up to 1

    Args:      optical: o, the share of the light that crosses into the four pixels beside it.
               electrical: e, the share of the electrons that diffuse into all eight.  Both (...), o + e <= 1.
    Returns:   (..., 3, 3), of sum 1; float64 unless given in another type.
    Source:    K. Hirakawa, Cross-Talk Explained, ICIP (2008), eq. (4): a 3 x 3 for each colour of the pattern.

    Example:
    >>> sensor.crosstalk_kernel(0.04, 0.0).tolist()
    [[0.0, 0.01, 0.0], [0.01, 0.96, 0.01], [0.0, 0.01, 0.0]]
    """
    middle, side, corner = _shares(optical, electrical)
    row = torch.stack([corner, side, corner], -1)
    return torch.stack([row, torch.stack([side, middle, side], -1), row], -2)


def _shares(optical: Tensor | float, electrical: Tensor | float) -> tuple[Tensor, Tensor, Tensor]:
    """Of the middle, of each side and of each corner."""
    light, electrons = (
        value if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)
        for value in (optical, electrical)
    )
    crossed = electrons / (2 * (1 + (1 - electrons).clamp(min=0).sqrt()))  # q, without a difference of near numbers
    side, corner = light / 4 + crossed * (1 - 2 * crossed), crossed**2 + torch.zeros_like(light)
    return 1 - light - electrons, side, corner


@in_float32
def crosstalk(signal: Tensor, *, optical: Tensor | float, electrical: Tensor | float, pattern: str = "RGGB") -> Tensor:
    """Move shares of what falls on each pixel to the eight around it.

    result(q) = sum over p of k_c(p)(q - p) signal(p),   c(p) the channel of the pixel that the light fell on

    No light crosses the edge of the picture, so its sum stays.

    Args:      signal: (..., C, H, W), or (..., 1, H, W) of a mosaic.  optical, electrical: see `crosstalk_kernel`; a
               number, or one for each channel (C,).  pattern: of the mosaic, for values by channel.
    Returns:   same shape.
    Raises:    ValueError for another number of values, or an unknown pattern.
    Source:    Hirakawa (2008).

    Example:
    >>> red = torch.zeros(1, 1, 4, 4)
    >>> red[..., 2, 2] = 1.0  # a red pixel of RGGB
    >>> mixed = sensor.crosstalk(red, optical=torch.tensor([0.2, 0.1, 0.1]), electrical=0.0)
    >>> [round(float(mixed[0, 0, 2, column]), 2) for column in range(4)]  # the greens beside it
    [0.0, 0.05, 0.8, 0.05]
    """
    if not signal.numel():
        return signal * 1.0
    shares = _shares(*(torch.as_tensor(value).to(signal) for value in (optical, electrical)))
    middle, side, corner = (at_pixels(share, signal, pattern=pattern, name="crosstalk") for share in shares)
    height, width = signal.shape[-2:]
    beside, across = (_around(signal * share) for share in (side, corner))

    def of(planes: Tensor, row: int, column: int) -> Tensor:
        return planes[..., 1 + row : 1 + row + height, 1 + column : 1 + column + width]

    sides = of(beside, 0, 1) + of(beside, 0, -1) + of(beside, 1, 0) + of(beside, -1, 0)
    corners = of(across, 1, 1) + of(across, 1, -1) + of(across, -1, 1) + of(across, -1, -1)
    return signal * middle + sides + corners


def _around(planes: Tensor) -> Tensor:
    """With one pixel more on each side, like its neighbour: what would leave comes back."""
    shape = planes.shape
    padded = F.pad(planes.reshape(1, -1, *shape[-2:]), (1, 1, 1, 1), mode="replicate")
    return padded.reshape(*shape[:-2], shape[-2] + 2, shape[-1] + 2)


class Crosstalk(Stage):
    """Light and electrons that pixels lose to their neighbours: `crosstalk`.

    It belongs behind the Mosaic, where it mixes colours, and before ShotNoise: electrons that wander are still counted
    one by one. Before the Mosaic it only blurs each channel.

    Args:      optical: share of the light that crosses into the four pixels beside it, 0 to 1; a number, or one for
               each channel in the order of the pattern (red, green, blue).
               electrical: share of the electrons that diffuse into all eight, likewise.
    Raises:    ValueError for a share below 0, or shares that leave a pixel less than nothing; TypeError for what is
               no number; at the call ValueError for another number of channels.
    Source:    Hirakawa (2008).

    Example:
    >>> flat = torch.full((1, 1, 6, 6), 0.5)
    >>> mixed = sensor.Crosstalk(0.02, electrical=(0.10, 0.06, 0.03))(flat)
    >>> round(float(mixed.sum() / flat.sum()), 6), round(float(mixed[0, 0, 2, 2]), 3)  # red loses 12 %, and gains 8
    (1.0, 0.48)
    """

    optical: Tensor | float
    electrical: Tensor | float

    def __init__(
        self,
        optical: Tensor | float | Sequence[float] = 0.02,
        *,
        electrical: Tensor | float | Sequence[float] = 0.02,
    ):
        super().__init__()
        given = {"optical": optical, "electrical": electrical}
        shares = {
            name: as_numbers(value, name=name, expected="a share from 0 to 1, or one for each channel").detach()
            for name, value in given.items()
        }
        for name, values in shares.items():
            bad = ~((values >= 0) & (values <= 1))
            if values.ndim > 1 or not values.numel() or bad.any():
                worst = float(values[bad].max()) if bad.any() else math.nan
                what = f"{worst:g}" if bad.any() else f"shape {tuple(values.shape)}"
                raise ValueError(
                    f"{name} must be a share from 0 to 1, or one for each channel (C,), got {what}."
                    f"{percent_hint(worst)}"
                )
        counts = {values.numel() for values in shares.values()} - {1}
        if len(counts) > 1:
            raise ValueError(f"optical and electrical are for {max(counts)} and {min(counts)} channels; give as many.")
        most = float((shares["optical"] + shares["electrical"]).max())
        if most > 1:
            raise ValueError(
                f"optical and electrical together are {most:g}, more than all light. They are shares: 2 % is 0.02."
            )
        hold(self, **{name: _numbers(value) for name, value in given.items()})

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,C,H,W) to the same shape: see `crosstalk`."""
        pattern = (context or Context()).pattern
        return crosstalk(signal, optical=self.optical, electrical=self.electrical, pattern=pattern)

    def error_if_skipped(self, signal: Tensor, context: Context | None = None) -> float:
        """The change of this signal; see `kcam.effects.Skippable`."""
        return relative_change(self, signal, context)

    def cost(self, signal: Tensor, context: Context | None = None) -> float:
        """Passes over the signal."""
        return 12.0

    def reason(self, signal: Tensor, context: Context | None = None) -> str:
        """What a pixel loses at most."""
        lost = float((torch.as_tensor(self.optical) + torch.as_tensor(self.electrical)).detach().max())
        return f"pixels lose up to {lost:.2%}, {self.error_if_skipped(signal, context):.1e} of the signal's RMS"


def _numbers(value: Tensor | float | Sequence[float]) -> Tensor | float:
    """A sequence of numbers as a tensor; numbers and tensors as they are."""
    return torch.tensor(value, dtype=torch.float64) if isinstance(value, Sequence) else value
