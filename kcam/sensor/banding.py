"""Row and column noise: what all pixels of a row, or of a column, have in common.

A row is read at one time, through a common reference, and a column through its own amplifier and converter. Errors of
these show as stripes, which the eye finds at a tenth of the noise of single pixels. In EMVA's terms the spatial
variance of a sensor is sigma^2 = sigma_row^2 + sigma_column^2 + sigma_pixel^2; here are the first two, of each frame
and fixed, beside `ReadNoise` and `FixedPattern`, which have the third.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kcam.context import Context
from kcam.sensor.arguments import (
    MOST_ELECTRONS,
    check_full_well,
    check_not_negative,
    check_seed,
    hold,
    in_float32,
    like,
)
from kcam.sensor.random_stage import RandomStage


def _stripes(
    signal: Tensor, *, row: Tensor | float, column: Tensor | float, generator: torch.Generator | None
) -> Tensor:
    """row e_y + column e_x for each picture, the same for all of its channels: a row is read at once."""
    *batch, _, height, width = signal.shape
    drawn = torch.randn(*batch, 1, height + width, generator=generator, dtype=torch.float64, device=_device(generator))
    rows, columns = drawn.to(signal).split([height, width], -1)
    return like(row, signal) * rows[..., :, None] + like(column, signal) * columns[..., None, :]


def _device(generator: torch.Generator | None) -> torch.device | str:
    return "cpu" if generator is None else generator.device


def _check_rows(signal: Tensor) -> None:
    if signal.ndim < 3:
        raise ValueError(f"expected (..., C, H, W), got shape {tuple(signal.shape)}. Use signal[None] for one channel.")


@in_float32
def row_column_noise(
    signal: Tensor,
    *,
    row: Tensor | float,
    column: Tensor | float,
    full_well: Tensor | float,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Add an offset to each row and each column, drawn anew for each frame.

    result(y, x) = signal(y, x) + (sigma_row e_y + sigma_column e_x) / full_well,   e ~ N(0, 1)

    Args:      signal: (..., C, H, W), share of the full well; the channels of a pixel are read together.
               row, column: sigma of the offsets, >= 0 [electrons].  full_well: saturation capacity [electrons].
               generator: source of the draw; None for torch's default one.
    Returns:   share of the full well, no longer bounded: the ADC clips it.
    Raises:    ValueError for a signal of fewer than three axes.
    Source:    EMVA 1288 release 4.0, the variances of rows, columns and pixels.

    Example:
    >>> dark, drawn = torch.zeros(1, 1, 500, 500), torch.Generator().manual_seed(0)
    >>> noise = 10_000 * sensor.row_column_noise(dark, row=2.0, column=0.0, full_well=10_000, generator=drawn)
    >>> round(float(noise.std()), 1), float(noise.std(-1).max())  # electrons; none within a row
    (2.0, 0.0)
    """
    _check_rows(signal)
    return signal + _stripes(signal, row=row, column=column, generator=generator) / like(full_well, signal)


@in_float32
def fixed_stripes(
    signal: Tensor, *, row: Tensor | float, column: Tensor | float, full_well: Tensor | float, seed: int
) -> Tensor:
    """Add an offset to each row and each column, the same in every frame: the rows' and columns' part of the DSNU.

    Args:      as of `row_column_noise`.  seed: names the sensor: one seed and (H, W) give the same stripes in every
               frame, in every channel and on every device.

    Example:
    >>> dark = torch.zeros(2, 1, 8, 300)
    >>> stripes = 10_000 * sensor.fixed_stripes(dark, row=0.0, column=3.0, full_well=10_000, seed=0)
    >>> round(float(stripes.std(-1).mean())), bool((stripes[0] == stripes[1]).all())
    (3, True)
    """
    _check_rows(signal)
    one = signal.new_empty(1, *signal.shape[-2:])
    generator = torch.Generator().manual_seed(seed)
    return signal + _stripes(one, row=row, column=column, generator=generator) / like(full_well, signal)


class RowColumnNoise(RandomStage):
    """Banding: offsets of whole rows and columns, of each frame and fixed: `row_column_noise`, `fixed_stripes`.

    Its mean over frames and sensors is the signal. It belongs where ReadNoise stands: behind ShotNoise, before the ADC.

    Args:      row, column: sigma of the offsets that each frame has of its own, >= 0 [electrons].
               fixed_row, fixed_column: sigma of those that the sensor keeps, >= 0 [electrons].
               seed: names the sensor, an integer.
               full_well: saturation capacity [electrons]; None to take it from the context.
    Raises:    ValueError for a negative sigma or a full well <= 0; TypeError for a seed that is no integer.

    Example:
    >>> dark, noise = torch.zeros(1, 1, 400, 400), sensor.RowColumnNoise(2.0, column=1.0, full_well=10_000)
    >>> frame = 10_000 * noise(dark, generator=torch.Generator().manual_seed(1))
    >>> [round(float(frame.mean(axis).std())) for axis in (-1, -2)]  # electrons: of rows, of columns
    [2, 1]
    """

    row: Tensor | float
    column: Tensor | float
    fixed_row: Tensor | float
    fixed_column: Tensor | float
    seed: int

    def __init__(
        self,
        row: Tensor | float = 0.5,
        *,
        column: Tensor | float = 0.0,
        fixed_row: Tensor | float = 0.0,
        fixed_column: Tensor | float = 0.5,
        seed: int = 0,
        full_well: Tensor | float | None = None,
    ):
        super().__init__()
        sigmas = {"row": row, "column": column, "fixed_row": fixed_row, "fixed_column": fixed_column}
        for name, value in sigmas.items():
            check_not_negative(value, name=name, unit="electrons", most=MOST_ELECTRONS)
        check_seed(seed)
        check_full_well(full_well)
        hold(self, **sigmas, seed=seed, full_well=full_well)

    def forward(
        self, signal: Tensor, context: Context | None = None, *, generator: torch.Generator | None = None
    ) -> Tensor:
        """(B,C,H,W) to the same shape: see `row_column_noise`."""
        full_well, generator = self._resolve(context, generator)
        striped = fixed_stripes(
            signal, row=self.fixed_row, column=self.fixed_column, full_well=full_well, seed=self.seed
        )
        return row_column_noise(striped, row=self.row, column=self.column, full_well=full_well, generator=generator)

    def sigma(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """The root of the sum of the four variances."""
        variances = [
            like(torch.as_tensor(value), signal) ** 2
            for value in (self.row, self.column, self.fixed_row, self.fixed_column)
        ]
        return torch.stack(torch.broadcast_tensors(*variances)).sum(0).sqrt() / like(self._well(context), signal)

    def cost(self, signal: Tensor, context: Context | None = None) -> float:
        """Two sums over the signal; what is drawn is few."""
        return 2.0
