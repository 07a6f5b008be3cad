"""From expected to recorded electrons: shot noise, dark current, fixed pattern and read noise, in EMVA 1288 terms.

A signal of 1.0 is the full well; every stage counts in electrons inside, N = signal * full_well. The words are those
of EMVA Standard 1288 (release 4.0):

    full_well      saturation capacity, mu_e.sat [electrons]
    K              overall system gain [DN / electron]; after an `ADC`, K = gain (2^bits - 1) / full_well
    sigma_d        temporal dark noise [electrons]; `ReadNoise.sigma_electrons`
    mu_I           dark current [electrons / s]; `DarkCurrent.electrons_per_second`
    PRNU, DSNU     photo response and dark signal non-uniformity; `FixedPattern` [share of the signal, electrons]

Together they give the photon transfer line, the variance of the recorded value against its mean:
sigma_y^2 = K^2 sigma_d^2 + 1/12 + K (mu_y - mu_y.dark), in DN^2.

Every argument may be an `nn.Parameter` (it trains) or a tensor that broadcasts over (B,C,H,W) (a buffer), such as one
value per picture, (B,1,1,1). float16 and bfloat16 signals are computed in float32, since a step of the former is
5 electrons at a full well of 10 000, and given back in their own dtype.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from kcam.cache import is_plain
from kcam.context import Context, Stage
from kcam.inputs import check_signal
from kcam.precision import full_precision
from kcam.sensor import counting
from kcam.ste import clip_ste
from kcam.units import as_numbers, check_positive


def hold(stage: nn.Module, **arguments: Any) -> None:
    """Store a stage's arguments under their own names: a plain tensor as a buffer, everything else as it is."""
    for name, value in arguments.items():
        if isinstance(value, Tensor) and not isinstance(value, nn.Parameter):
            stage.register_buffer(name, value)
        else:
            setattr(stage, name, value)


def like(value: Tensor | float, signal: Tensor) -> Tensor | float:
    """A number as it is; a tensor or parameter in the signal's dtype, on its device, with its gradient."""
    return value.to(signal) if isinstance(value, Tensor) else value


MOST_ELECTRONS = 1e30
"""In a full well, or as the spread of a noise: the square still is a float32."""
COUNTED = 2.0**40
"""Electrons up to which torch.poisson is right: from 1e14 its variance is off, by 20 % at 1e16, and from 2^63 electrons
its counts overflow and are negative.
"""


def check_not_negative(value: Tensor | float, *, name: str, unit: str, most: float = math.inf, fix: str = "") -> None:
    """ValueError unless every element of `value` is finite, >= 0, and not above `most`."""
    values = as_numbers(value, name=name, expected=f"a number >= 0 {unit}").detach()
    bad = ~((values >= 0) & values.isfinite())
    if bad.any():
        raise ValueError(f"{name} must be finite and >= 0 {unit}, got {values[bad].flatten()[0].item():g}.")
    if (values > most).any():
        raise ValueError(f"{name} must be at most {most:g} {unit}, got {values.max().item():g}.{fix and ' '}{fix}")


def check_full_well(value: Tensor | float | None) -> None:
    """ValueError unless every element of a full well is from 1e-3 to 1e30 electrons; None is left to the context."""
    if value is not None:
        check_positive(value, name="full_well", unit="electrons")
        low, high = (float(end) for end in torch.as_tensor(value, dtype=torch.float64).detach().aminmax())
        if not 1e-3 <= low <= high <= MOST_ELECTRONS:
            raise ValueError(
                f"full_well {low if low < 1e-3 else high:g} is outside 0.001..{MOST_ELECTRONS:g} electrons, such as "
                "10_000."
            )


def check_seed(seed: int) -> None:
    """TypeError unless the seed that names a sensor is an integer."""
    if isinstance(seed, bool) or not isinstance(seed, int):
        raise TypeError(f"seed must be an integer such as 0, got {seed!r}.")


def in_float32(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Compute a function of a signal in at least float32 and give the result back in the signal's own dtype."""

    @functools.wraps(function)
    def wrapper(signal: Tensor, **arguments: Any) -> Tensor:
        check_signal(signal)
        working = signal.float() if signal.dtype in (torch.float16, torch.bfloat16) else signal
        with full_precision(signal.device):
            return function(working, **arguments).to(signal.dtype)

    return wrapper


class _Poisson(torch.autograd.Function):
    @staticmethod
    def forward(rate: Tensor, generator: torch.Generator | None) -> Tensor:
        if counting.can_count(rate):
            return counting.counts(rate, generator)
        few = rate.device.type == "cpu" and not torch.compiler.is_compiling() and not (rate > COUNTED).any()
        counted = rate if few else rate.clamp(max=COUNTED)
        try:
            count = torch.poisson(counted, generator=generator)
        except RuntimeError as error:
            if not rate.isnan().any():
                raise
            raise ValueError(
                f"the signal has {int(rate.isnan().sum())} values that are NaN: photons cannot be counted. Remove NaN "
                "where it comes from, or use signal.nan_to_num(0)."
            ) from error
        if few:
            return count
        # beyond, the deviation has the same size in units of its own sigma
        return torch.where(rate > COUNTED, rate + (count - counted) * (rate / COUNTED).sqrt(), count)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        ctx.save_for_backward(inputs[0], output)

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:
        rate, count = ctx.saved_tensors
        return grad * (1 + (count - rate) / (2 * rate.clamp(min=1))), None


def poisson(electrons: Tensor, *, generator: torch.Generator | None = None) -> Tensor:
    """Count random independent arrivals: an exact Poisson draw, with a gradient to its expectation.

    N ~ Poisson(lambda),   dN/d lambda := 1 + (N - lambda) / (2 max(lambda, 1))

    It is the slope of lambda + sqrt(lambda) e at the e that gives this N, kept finite below one electron. Its mean is
    exactly 1 at every lambda, so the gradient of any loss linear in N is unbiased.

    Args:      electrons: expected number lambda >= 0, any shape, float32 or float64.
               generator: source of the draw, on the device of `electrons`; None for torch's default one.
    Returns:   whole numbers in the dtype of `electrons`. Above 2^40 they are normal: what is left of the Poisson's
               skewness there is 1e-6.

    Example:
    >>> electrons = torch.full((400, 400), 100.0, requires_grad=True)
    >>> counts = sensor.poisson(electrons, generator=torch.Generator().manual_seed(0))
    >>> counts.mean().backward()
    >>> counts = counts.detach()
    >>> round(float(counts.mean())), round(float(counts.std())), round(float(electrons.grad.sum()), 2)
    (100, 10, 1.0)
    """
    return _Poisson.apply(electrons, generator)


OVERFLOWING = 100.0
"""Full wells that overflow with certainty: more give the same, and an infinite rate could not be drawn."""


@in_float32
def saturate(signal: Tensor) -> Tensor:
    """Clip at the full well, 1.0, and at no light, 0, with the gradient of `clip_ste`."""
    return clip_ste(signal, 0.0, 1.0)


@in_float32
def shot_noise(signal: Tensor, *, full_well: Tensor | float, generator: torch.Generator | None = None) -> Tensor:
    """Turn expected into counted photoelectrons, and stop at the full well.

    N ~ Poisson(signal full_well),   result = min(N, full_well) / full_well

    Gradient: that of `poisson` times that of `clip_ste` at the well and at 0 (a negative signal counts as no light).

    Args:      signal: expected electrons as a share of the full well.  full_well: saturation capacity [electrons].
               generator: see `poisson`.
    Returns:   counted electrons as a share of the full well, 0..1.
    Source:    EMVA 1288 release 4.0, eq. (1): photon noise.

    Example:
    >>> light = torch.full((400, 400), 0.01)  # 100 of 10 000 electrons
    >>> counts = 10_000 * sensor.shot_noise(light, full_well=10_000, generator=torch.Generator().manual_seed(0))
    >>> round(float(counts.mean())), round(float(counts.std()))
    (100, 10)
    """
    capacity = like(full_well, signal)
    if _in_place(signal, capacity):
        electrons = poisson(signal.clamp(0, OVERFLOWING).mul_(capacity), generator=generator)
        return electrons.div_(capacity).clamp_(max=1)
    rate = clip_ste(signal, 0.0, OVERFLOWING) * capacity
    return clip_ste(poisson(rate, generator=generator) / capacity, None, 1.0)


def _in_place(signal: Tensor, value: Tensor | float) -> bool:
    """Whether a new tensor of the signal's shape may be multiplied by a value where it lies."""
    if not isinstance(value, Tensor):
        return is_plain(signal)
    return is_plain(signal) and is_plain(value) and torch.broadcast_shapes(value.shape, signal.shape) == signal.shape


@in_float32
def read_noise(
    signal: Tensor,
    *,
    sigma_electrons: Tensor | float,
    full_well: Tensor | float,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Add the Gaussian noise of the read-out.

    result = signal + (sigma_d / full_well) e,   e ~ N(0, 1);   d result / d sigma_d = e / full_well

    Args:      signal: share of the full well.  sigma_electrons: temporal dark noise sigma_d, >= 0 [electrons].
               full_well: saturation capacity [electrons].  generator: see `poisson`.
    Returns:   share of the full well, no longer bounded: the ADC clips it.

    Example:
    >>> noise = sensor.read_noise(torch.zeros(1000, 1000), sigma_electrons=3.0, full_well=10_000,
    ...                           generator=torch.Generator().manual_seed(0))
    >>> round(10_000 * float(noise.std()), 1)  # electrons
    3.0
    """
    noise = torch.randn(signal.shape, generator=generator, dtype=signal.dtype, device=signal.device)
    share = like(sigma_electrons, signal) / like(full_well, signal)
    if _in_place(signal, share):
        return noise.mul_(share).add_(signal)
    return signal + noise * share


def dark_electrons(
    electrons_per_second: Tensor | float,
    *,
    time: Tensor | float,
    temperature: Tensor | float | None = None,
    reference_temperature: float = 25.0,
    doubling_temperature: float = 8.0,
) -> Tensor | float:
    """Expected number of thermally generated electrons in one exposure.

    mu_d = mu_I time 2^((temperature - reference) / doubling)

    Args:      electrons_per_second: dark current mu_I at the reference temperature, >= 0 [electrons / s].
               time: exposure [s].  temperature: of the sensor [degrees C]; None for the reference temperature.
               doubling_temperature: rise that doubles the dark current, > 0 [K].
    Returns:   expected electrons per pixel.
    Source:    EMVA 1288 release 4.0, dark current and its doubling temperature. 8 K is typical of silicon.
    """
    mean = electrons_per_second * time
    if temperature is not None:
        doublings = (temperature - reference_temperature) / doubling_temperature
        most = 120  # beyond, 2^x would overflow; any well has by then
        mean = mean * 2 ** (doublings.clamp(max=most) if isinstance(doublings, Tensor) else min(doublings, most))
    return mean


@in_float32
def dark_current(
    signal: Tensor,
    *,
    electrons: Tensor | float,
    full_well: Tensor | float,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Add dark electrons, Poisson distributed, to the same well as the light's.

    result = min(signal + N / full_well, 1),   N ~ Poisson(electrons);   gradients of `poisson` and `clip_ste`

    Args:      signal: share of the full well.  electrons: expected dark electrons, see `dark_electrons`.
               full_well: saturation capacity [electrons].  generator: see `poisson`.
    Returns:   share of the full well, <= 1.

    Example:
    >>> dark = torch.zeros(400, 400)
    >>> counts = sensor.dark_current(dark, electrons=9.0, full_well=10_000, generator=torch.Generator().manual_seed(0))
    >>> round(10_000 * float(counts.mean()), 1), round(10_000 * float(counts.std()), 1)  # 9 and its root
    (9.0, 3.0)
    """
    capacity = like(full_well, signal)
    rate = torch.zeros_like(signal) + like(_overflowing(electrons, full_well), signal)
    count = poisson(rate, generator=generator)
    return clip_ste(signal + count / capacity, None, 1.0)


def _overflowing(electrons: Tensor | float, full_well: Tensor | float) -> Tensor | float:
    """Expected electrons, but no more than overflow the well with certainty."""
    if not isinstance(electrons, Tensor) and not isinstance(full_well, Tensor):
        return min(electrons, OVERFLOWING * full_well)
    wells = torch.as_tensor(electrons, dtype=torch.float64) / torch.as_tensor(full_well).detach()
    return clip_ste(wells, None, OVERFLOWING) * torch.as_tensor(full_well).detach()


def fixed_pattern_fields(shape: tuple[int, ...], *, seed: int) -> Tensor:
    """Standard normal gain and offset fields of one sensor, (2, *shape) float32 on the CPU, the same at every call."""
    return torch.randn((2, *shape), generator=torch.Generator().manual_seed(seed), dtype=torch.float32)


@in_float32
def fixed_pattern(
    signal: Tensor, *, prnu: Tensor | float, dsnu: Tensor | float, full_well: Tensor | float, seed: int
) -> Tensor:
    """Give every pixel its own gain and offset, the same in every frame.

    result = signal (1 + prnu g) + (dsnu / full_well) o,   g, o ~ N(0, 1) drawn once per sensor

    Args:      signal: (..., C, H, W), share of the full well.  prnu: relative spread of the gain (0.01 is 1 %).
               dsnu: spread of the offset [electrons].  full_well: saturation capacity [electrons].
               seed: names the sensor: one seed and (C,H,W) give the same fields in every frame and on every device.
    Returns:   share of the full well.
    Source:    EMVA 1288 release 4.0, PRNU and DSNU (white, without its column and row parts).

    Example:
    >>> gray = torch.full((1, 64, 64), 0.5)
    >>> one, other = (sensor.fixed_pattern(gray, prnu=0.0, dsnu=20.0, full_well=10_000, seed=seed) for seed in (0, 1))
    >>> round(10_000 * float((one - other).std() / 2**0.5))  # electrons: two sensors differ by both their spreads
    20
    """
    gain, offset = fixed_pattern_fields(tuple(signal.shape[-3:]), seed=seed).to(signal)
    return signal * (1 + like(prnu, signal) * gain) + offset * (like(dsnu, signal) / like(full_well, signal))


def _rms(signal: Tensor) -> float:
    return max(float(signal.detach().double().square().mean().sqrt()), 1e-12) if signal.numel() else 1.0


class Mean(Stage):
    """A random stage at its mean: it holds that stage, so parameters are shared, and calls its `expected`.

    Example:
    >>> noise = sensor.ShotNoise(full_well=10_000)
    >>> sensor.Mean(noise)(torch.tensor([0.25, 1.5])).tolist()  # as expected, up to the full well
    [0.25, 1.0]
    """

    def __init__(self, stage: RandomStage):
        super().__init__()
        self.stage = stage

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """The expected result of the stage."""
        return self.stage.expected(signal, context)

    def provides(self) -> dict[str, Any]:
        """What the stage itself provides."""
        return self.stage.provides()


class RandomStage(Stage):
    """A stage with noise. A subclass draws in `forward`, and gives its mean over all draws in `expected`."""

    full_well: Tensor | float | None

    def expected(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """The signal without the noise: by default unchanged (noise of zero mean)."""
        return signal

    def mean(self) -> Mean:
        """The same stage at its mean, sharing parameters."""
        return Mean(self)

    def sigma(self, signal: Tensor, context: Context | None = None) -> Tensor | float:
        """Standard deviation of the noise [share of the full well]: a number, or for each element of the signal."""
        raise NotImplementedError(f"{type(self).__name__} does not say how large its noise is.")

    def error_if_skipped(self, signal: Tensor, context: Context | None = None) -> float:
        """RMS of `sigma` relative to the RMS of the signal; see `kcam.effects.Skippable`."""
        sigma = torch.as_tensor(self.sigma(signal, context)).detach().double()
        return float(sigma.square().mean().sqrt() / _rms(signal))

    def cost(self, signal: Tensor, context: Context | None = None) -> float:
        """Passes over the signal: a random number takes some ten of them."""
        return 10.0

    def reason(self, signal: Tensor, context: Context | None = None) -> str:
        """How many electrons it is, beside the signal's."""
        full_well = float(torch.as_tensor(self._resolve(context, None)[0]).detach().max())
        sigma, level = self.error_if_skipped(signal, context), _rms(signal) * full_well
        return f"sigma {sigma * level:.3g} of {level:.{0 if level >= 10 else 2}f} electrons"

    def bypass(self) -> Mean:
        """What stands in for it when it is left out: its mean."""
        return self.mean()

    def provides(self) -> dict[str, Any]:
        """The full well, where it was given."""
        return {} if self.full_well is None else {"full_well": self.full_well}

    def _resolve(
        self, context: Context | None, generator: torch.Generator | None
    ) -> tuple[Tensor | float, torch.Generator | None]:
        context = context or Context()
        full_well = context.full_well if self.full_well is None else self.full_well
        return full_well, context.generator if generator is None else generator


class ShotNoise(RandomStage):
    """Photon noise and saturation: `shot_noise`. Its mean is the signal clipped at the full well.

    Args:      full_well: saturation capacity [electrons]; None to take it from the context (10 000).
    Raises:    ValueError for a full well <= 0.

    Example:
    >>> light = torch.full((1, 1, 400, 400), 0.5)  # 5000 electrons
    >>> counts = 10_000 * sensor.ShotNoise(10_000)(light, generator=torch.Generator().manual_seed(0))
    >>> round(float(counts.var() / counts.mean()), 1)  # Poisson
    1.0
    """

    def __init__(self, full_well: Tensor | float | None = None):
        super().__init__()
        check_full_well(full_well)
        hold(self, full_well=full_well)

    def forward(
        self, signal: Tensor, context: Context | None = None, *, generator: torch.Generator | None = None
    ) -> Tensor:
        """(B,C,H,W) to the same shape: see `shot_noise`."""
        full_well, generator = self._resolve(context, generator)
        return shot_noise(signal, full_well=full_well, generator=generator)

    def expected(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """The expected electrons, clipped at the full well.

        The clip of the mean, not the mean of the clip: they differ by 0.4 sigma at the well itself, less elsewhere.
        """
        return saturate(signal)

    def sigma(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """sqrt(N) electrons, none above the full well."""
        full_well, _ = self._resolve(context, None)
        return (signal.clamp(0, 1) / like(full_well, signal)).sqrt()

    def cost(self, signal: Tensor, context: Context | None = None) -> float:
        """Poisson draws take longer than others."""
        return 40.0


class ReadNoise(RandomStage):
    """The noise of the read-out, EMVA's temporal dark noise sigma_d: `read_noise`. Its mean is the signal.

    Args:      sigma_electrons: standard deviation, >= 0 [electrons].
               full_well: saturation capacity [electrons]; None to take it from the context.
    Raises:    ValueError for a negative sigma or a full well <= 0.

    Example:
    >>> dark = torch.zeros(1, 1, 1000, 1000)
    >>> noise = sensor.ReadNoise(3.0, full_well=10_000)(dark, generator=torch.Generator().manual_seed(0))
    >>> round(10_000 * float(noise.std()), 1)  # electrons
    3.0
    """

    sigma_electrons: Tensor | float

    def __init__(self, sigma_electrons: Tensor | float = 3.0, *, full_well: Tensor | float | None = None):
        super().__init__()
        check_not_negative(sigma_electrons, name="sigma_electrons", unit="electrons", most=MOST_ELECTRONS)
        check_full_well(full_well)
        hold(self, sigma_electrons=sigma_electrons, full_well=full_well)

    def forward(
        self, signal: Tensor, context: Context | None = None, *, generator: torch.Generator | None = None
    ) -> Tensor:
        """(B,C,H,W) to the same shape: see `read_noise`."""
        full_well, generator = self._resolve(context, generator)
        return read_noise(signal, sigma_electrons=self.sigma_electrons, full_well=full_well, generator=generator)

    def sigma(self, signal: Tensor, context: Context | None = None) -> Tensor | float:
        """sigma_d."""
        full_well, _ = self._resolve(context, None)
        return like(self.sigma_electrons, signal) / like(full_well, signal)

    def provides(self) -> dict[str, Any]:
        """The read noise, for the denoising, and what every noise provides."""
        return {**super().provides(), "read_noise": self.sigma_electrons}


class DarkCurrent(RandomStage):
    """Thermal electrons in every pixel: `dark_current`. Its mean adds their expected number.

    It belongs after ShotNoise: before it, the dark electrons would be counted at random twice.

    Args:      see `dark_electrons`; full_well: saturation capacity [electrons]; None to take it from the context.
    Raises:    ValueError for a negative current or time, a doubling temperature or full well <= 0, or a temperature
               that is none in degrees C.

    Example:
    >>> warm = sensor.DarkCurrent(50.0, time=0.1, temperature=33.0)  # 8 degrees above 25: twice the current
    >>> round(warm.electrons(), 6)
    10.0
    """

    electrons_per_second: Tensor | float
    time: Tensor | float
    temperature: Tensor | float | None
    reference_temperature: float
    doubling_temperature: float

    def __init__(
        self,
        electrons_per_second: Tensor | float,
        *,
        time: Tensor | float,
        temperature: Tensor | float | None = None,
        reference_temperature: float = 25.0,
        doubling_temperature: float = 8.0,
        full_well: Tensor | float | None = None,
    ):
        super().__init__()
        check_not_negative(electrons_per_second, name="electrons_per_second", unit="electrons / s")
        check_not_negative(time, name="time", unit="s")
        check_positive(doubling_temperature, name="doubling_temperature", unit="K")
        for name, value in (("temperature", temperature), ("reference_temperature", reference_temperature)):
            degrees = torch.as_tensor(0.0 if value is None else value).detach()
            odd = ~((degrees >= -273.15) & (degrees <= 200))
            if odd.any():
                raise ValueError(
                    f"{name} {degrees[odd][0]:g} is outside -273.15..200 degrees C, such as 25. From kelvin subtract "
                    "273.15."
                )
        check_full_well(full_well)
        hold(
            self,
            electrons_per_second=electrons_per_second,
            time=time,
            temperature=temperature,
            reference_temperature=reference_temperature,
            doubling_temperature=doubling_temperature,
            full_well=full_well,
        )

    def electrons(self) -> Tensor | float:
        """Expected dark electrons per pixel: see `dark_electrons`."""
        return dark_electrons(
            self.electrons_per_second,
            time=self.time,
            temperature=self.temperature,
            reference_temperature=self.reference_temperature,
            doubling_temperature=self.doubling_temperature,
        )

    def forward(
        self, signal: Tensor, context: Context | None = None, *, generator: torch.Generator | None = None
    ) -> Tensor:
        """(B,C,H,W) to the same shape: see `dark_current`."""
        full_well, generator = self._resolve(context, generator)
        return dark_current(signal, electrons=self.electrons(), full_well=full_well, generator=generator)

    def expected(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """The signal with the expected dark electrons, clipped at the full well."""
        full_well, _ = self._resolve(context, None)
        return _add_mean(signal, electrons=self.electrons(), full_well=full_well)

    def sigma(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """The square root of the dark electrons."""
        full_well, _ = self._resolve(context, None)
        return torch.as_tensor(_overflowing(self.electrons(), full_well)).sqrt() / torch.as_tensor(full_well)

    def cost(self, signal: Tensor, context: Context | None = None) -> float:
        """Poisson draws take longer than others."""
        return 40.0


@in_float32
def _add_mean(signal: Tensor, *, electrons: Tensor | float, full_well: Tensor | float) -> Tensor:
    return clip_ste(signal + like(electrons, signal) / like(full_well, signal), None, 1.0)


MOST_PRNU = 0.5
"""Spread of the gain beyond which many pixels of a sensor would count less than nothing."""


class FixedPattern(RandomStage):
    """Gain and offset errors of the pixels, EMVA's PRNU and DSNU, the same in every frame: `fixed_pattern`.

    Its mean over sensors is the signal. After ShotNoise its offsets reach the picture whole; before it, negative ones
    would be cut off in the dark.

    Args:      prnu: relative spread of the gain, 0 to 0.5 (0.01 is 1 %).  dsnu: spread of the offset, >= 0 [electrons].
               seed: names the sensor, an integer.
               full_well: saturation capacity [electrons]; None to take it from the context.
    Raises:    ValueError for a negative spread, a prnu above 0.5 or a full well <= 0; TypeError for a
               seed that is no integer.

    Example:
    >>> gray = torch.full((1, 1, 64, 64), 0.5)
    >>> one, two = (sensor.FixedPattern(0.02, dsnu=0.0, seed=7)(gray) for _ in range(2))
    >>> torch.equal(one, two), round(float((one / gray).std()), 3)  # the same sensor, 2 % PRNU
    (True, 0.02)
    """

    prnu: Tensor | float
    dsnu: Tensor | float
    seed: int

    def __init__(
        self,
        prnu: Tensor | float = 0.01,
        *,
        dsnu: Tensor | float = 2.0,
        seed: int = 0,
        full_well: Tensor | float | None = None,
    ):
        super().__init__()
        percent = f"It is a share: did you mean {prnu} / 100?" if not isinstance(prnu, Tensor) else "It is a share."
        check_not_negative(prnu, name="prnu", unit="(relative gain)", most=MOST_PRNU, fix=percent)
        check_not_negative(dsnu, name="dsnu", unit="electrons", most=MOST_ELECTRONS)
        check_seed(seed)
        check_full_well(full_well)
        hold(self, prnu=prnu, dsnu=dsnu, seed=seed, full_well=full_well)

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,C,H,W) to the same shape: see `fixed_pattern`. It draws nothing, so it takes no generator."""
        full_well, _ = self._resolve(context, None)
        return fixed_pattern(signal, prnu=self.prnu, dsnu=self.dsnu, full_well=full_well, seed=self.seed)

    def sigma(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """Spread of gain and offset, over many sensors."""
        full_well, _ = self._resolve(context, None)
        offset = torch.as_tensor(self.dsnu).to(signal) / like(full_well, signal)
        return torch.hypot(like(self.prnu, signal) * signal, offset.expand_as(signal))
