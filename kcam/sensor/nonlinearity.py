"""The response of a pixel that is not quite proportional to its electrons: followers and converters that bend."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcam.context import Context, Stage
from kcam.effects import relative_change
from kcam.sensor.arguments import hold, in_float32
from kcam.units import as_numbers

_STEPS = 1001  # between none and a full well, at which a curve is looked at
_LOW, _HIGH = 0.05, 0.95  # of saturation, between which EMVA fits a line


@in_float32
def nonlinear_response(signal: Tensor, *, coefficients: Tensor) -> Tensor:
    """Bend a signal by a polynomial that keeps no light and the full well where they are.

    y = x + sum_k a_k (x - x^k),   k = 2, 3, ...;   below 0 and above 1 the curve goes on along its tangents

    Args:      signal: share of the full well, any shape.  coefficients: a_2, a_3, ... (K,); a_2 > 0 alone is the usual
               compression, by a_2 / 4 in the middle.
    Returns:   same shape.

    Example:
    >>> bent = sensor.nonlinear_response(torch.tensor([0.0, 0.5, 1.0]), coefficients=torch.tensor([0.04]))
    >>> [round(float(value), 3) for value in bent]
    [0.0, 0.51, 1.0]
    """
    a = coefficients.to(signal)
    powers = torch.arange(2, len(a) + 2, dtype=signal.dtype, device=signal.device)
    first, last = 1 + a.sum(), 1 - (a * (powers - 1)).sum()
    inside = signal.clamp(0, 1)
    high = torch.zeros_like(inside)
    for coefficient in a.flip(0).unbind():  # sum of a_k x^(k-2)
        high = high * inside + coefficient
    bent = inside * (first - inside * high)
    return torch.where(signal < 0, first * signal, torch.where(signal > 1, 1 + last * (signal - 1), bent))


def linearity_error(signal: Tensor, response: Tensor) -> float:
    """EMVA's linearity error: mean relative distance of a response from its line, from 5 to 95 % of saturation.

    The line y = b_0 + b_1 x has the least squares of its relative distances.

    Args:      signal, response: (N,), what was given, and what it gave, N >= 3 between 5 and 95 % of the most.
    Returns:   mean |y / (b_0 + b_1 x) - 1|.
    Raises:    ValueError for fewer points, or of other shapes.
    Source:    EMVA 1288 release 4.0, linearity error LE.

    Example:
    >>> x = torch.linspace(0.05, 1, 20).double()
    >>> round(sensor.linearity_error(x, x + 0.04 * (x - x**2)), 4), round(sensor.linearity_error(x, 3 * x), 4)
    (0.0067, 0.0)
    """
    x, y = (part.detach().double().flatten().cpu() for part in (signal, response))
    if x.shape != y.shape:
        raise ValueError(f"signal and response must have as many values, got {len(x)} and {len(y)}.")
    seen = (x >= _LOW * x.max()) & (x <= _HIGH * x.max()) if len(x) else x > 0
    x, y = x[seen], y[seen]
    if len(x) < 3 or not bool((y > 0).all()):
        raise ValueError(
            f"a line needs at least 3 responses above 0 between {_LOW:.0%} and {_HIGH:.0%} of the largest signal, got "
            f"{int((y > 0).sum())}."
        )
    line = torch.stack([torch.ones_like(x), x], 1)
    fitted = line @ torch.linalg.lstsq(line / y[:, None], torch.ones_like(x)[:, None]).solution[:, 0]
    return float((y / fitted - 1).abs().mean())


class Nonlinearity(Stage):
    """A response that bends: `nonlinear_response`. The ISP does not undo it.

    It stands behind the noise, before the ADC, and no `camera.linear(scene)` has it.

    Args:      coefficients: a_2, a_3, ... of the polynomial: a number for a_2 alone, or several. A curve
               rises from 0 to the full well.
    Raises:    ValueError for coefficients that are not finite, or of which a curve falls; TypeError for what is no
               number.

    Example:
    >>> stage = sensor.Nonlinearity(0.04)
    >>> [round(float(value), 3) for value in stage(torch.tensor([0.0, 0.5, 1.0]))], f"{stage.linearity_error():.2%}"
    ([0.0, 0.51, 1.0], '0.57%')
    """

    coefficients: Tensor

    def __init__(self, coefficients: Tensor | float | Sequence[float] = 0.02):
        super().__init__()
        given = as_numbers(coefficients, name="coefficients", expected="a number such as 0.02, or several")
        values = given.detach().cpu()
        if values.ndim > 1 or not values.numel() or not bool(values.isfinite().all()):
            raise ValueError(f"coefficients must be finite numbers (K,), K >= 1, got {coefficients!r}.")
        x = torch.linspace(0, 1, _STEPS, dtype=torch.float64)
        slopes = 1 + sum(a * (1 - k * x ** (k - 1)) for k, a in enumerate(values.flatten().tolist(), start=2))
        if float(slopes.min()) < 0:
            raise ValueError(
                f"the response falls at {float(x[slopes.argmin()]):.2g} of the full well, by a slope of "
                f"{float(slopes.min()):.3g}. Of a_2 alone expected from -1 to 1, such as 0.02."
            )
        hold(self, coefficients=coefficients if isinstance(coefficients, Tensor) else given.float())

    @classmethod
    def from_curve(cls, signal: Tensor, response: Tensor, *, degree: int = 3) -> Nonlinearity:
        """The polynomial that comes nearest to a measured curve, by least squares.

        Args:      signal: (N,), share of the full well.  response: (N,), what it gave, as a share of what a full well
                   gives.  degree: highest power, 2 to 6.
        Raises:    ValueError for fewer values than coefficients, other shapes, or values outside -0.1..1.1.
        """
        if not 2 <= degree <= 6:
            raise ValueError(f"degree must be 2 to 6, got {degree}.")
        x, y = (as_numbers(v, name=n, expected="numbers (N,)").flatten() for v, n in
                ((signal, "signal"), (response, "response")))  # fmt: skip
        if len(x) != len(y) or len(x) < degree - 1:
            raise ValueError(
                f"signal and response must have as many values, at least {degree - 1}, got {len(x)} and {len(y)}."
            )
        if not bool(((x > -0.1) & (x < 1.1) & (y > -0.1) & (y < 1.1)).all()):
            raise ValueError(
                "signal and response must be shares of the full well, 0..1. Divide by what a full well gives."
            )
        basis = torch.stack([x - x**k for k in range(2, degree + 1)], 1)
        return cls(torch.linalg.lstsq(basis, (y - x)[:, None]).solution[:, 0].float())

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,C,H,W) to the same shape: see `nonlinear_response`."""
        return nonlinear_response(signal, coefficients=self.coefficients.flatten())

    def linearity_error(self) -> float:
        """Of the curve: see `linearity_error`."""
        x = torch.linspace(0, 1, _STEPS, dtype=torch.float64)
        return linearity_error(x, self(x.to(self.coefficients.device)))

    def error_if_skipped(self, signal: Tensor, context: Context | None = None) -> float:
        """The change of this signal; see `kcam.effects.Skippable`."""
        return relative_change(self, signal, context)

    def cost(self, signal: Tensor, context: Context | None = None) -> float:
        """Passes over the signal."""
        return 5.0 + self.coefficients.numel()

    def reason(self, signal: Tensor, context: Context | None = None) -> str:
        """How far it is from a line."""
        error = self.error_if_skipped(signal, context)
        return f"linearity error {self.linearity_error():.2%}, {error:.1e} of the signal's RMS"
