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

from typing import Any

import torch
from torch import Tensor

from kcam.cache import is_plain
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
from kcam.sensor.counting import COUNTED as COUNTED
from kcam.sensor.counting import poisson
from kcam.sensor.random_stage import Mean as Mean
from kcam.sensor.random_stage import RandomStage
from kcam.ste import clip_ste
from kcam.units import check_positive

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
        return (signal.clamp(0, 1) / like(self._well(context), signal)).sqrt()

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
        return like(self.sigma_electrons, signal) / like(self._well(context), signal)

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
        return _add_mean(signal, electrons=self.electrons(), full_well=self._well(context))

    def sigma(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """The square root of the dark electrons."""
        full_well = self._well(context)
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
        full_well = self._well(context)
        return fixed_pattern(signal, prnu=self.prnu, dsnu=self.dsnu, full_well=full_well, seed=self.seed)

    def sigma(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """Spread of gain and offset, over many sensors."""
        offset = torch.as_tensor(self.dsnu).to(signal) / like(self._well(context), signal)
        return torch.hypot(like(self.prnu, signal) * signal, offset.expand_as(signal))
