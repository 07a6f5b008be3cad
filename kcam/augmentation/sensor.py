"""The sensor: its mosaic, its noise, its pattern, its well and its steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from kcam.augmentation.base import CameraAugmentation, each_generator, is_picture, per_sample
from kcam.augmentation.distributions import Bounds, Choice, Draw, Seed, Uniform
from kcam.cache import is_plain
from kcam.camera import Camera
from kcam.context import Context
from kcam.isp import ColourMatrix, Demosaic, ToneCurve, WhiteBalance, demosaic
from kcam.sensor import (
    ColourFilter,
    Exposure,
    Mosaic,
    defect_pixels,
    fixed_stripes,
    mosaic,
    quantise,
    read_noise,
    row_column_noise,
    shot_noise,
)
from kcam.sensor.noise import MOST_PRNU, fixed_pattern
from kcam.ste import clip_ste
from kcam.units import check_positive, wavelength_grid

BAYER = ("RGGB", "GRBG", "GBRG", "BGGR")


class RandomBayer(CameraAugmentation):
    """Mosaic and demosaic: what a sensor of one colour per pixel loses.

    A picture is mosaiced in linear light and filled in again, on its square root as by `isp.demosaic`. A cube of bands
    becomes a picture: through the colour filter, the mosaic and the demosaic, white balance, colour matrix and tone
    curve of a noiseless camera.

    Args:      pattern: "random" for one of the four phases of the Bayer pattern, a name in `sensor.PATTERNS` (of three
                   channels on pictures), or several names.
               method: a name in `isp.DEMOSAICS`; None for the default of the pattern.
               colour_filter: for cubes; None for `ColourFilter.kodak()`, or `rgbw()` for the pattern of that name.
               wavelengths: of a cube's bands [m].
    Raises:    ValueError for an unknown pattern or method, or none; at the call, for a cube with p < 1.

    Example:
    >>> gray = torch.full((1, 3, 16, 16), 0.5)
    >>> torch.allclose(KC.RandomBayer("RGGB")(gray), gray, atol=1e-5)  # without colour nothing is lost
    True
    """

    def __init__(
        self,
        pattern: str | Sequence[str] = "random",
        *,
        method: str | None = None,
        colour_filter: ColourFilter | None = None,
        wavelengths: Tensor | None = None,
        same_on_batch: bool = False,
        p: float = 1.0,
        keepdim: bool = False,
    ) -> None:
        if not isinstance(pattern, Sequence):
            raise TypeError(f'pattern must be "random", a name such as "RGGB", or several, got {pattern!r}.')
        names = BAYER if pattern == "random" else (pattern,) if isinstance(pattern, str) else tuple(pattern)
        if not names:
            raise ValueError(f'pattern is empty: give "random", or at least one of {", ".join(BAYER)}.')
        for name in names:
            Demosaic(method, pattern=name)  # refuses what does not exist
        super().__init__({"pattern": Choice(len(names))}, same_on_batch=same_on_batch, p=p, keepdim=keepdim)
        self.patterns, self.method = names, method
        self.flags = {"patterns": "/".join(names), "method": method}
        self.colour_filter = colour_filter
        self.wavelengths = None if wavelengths is None else wavelength_grid(wavelengths)

    def output_channels(self, channels: int) -> int:
        """A picture stays one; a cube becomes one of three channels."""
        return channels if channels == 1 else 3

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """Each pattern's rows at once."""
        order = drawn["pattern"].argsort(stable=True)
        found, counts = drawn["pattern"].unique(return_counts=True)
        sorted_rows = signal.index_select(0, order.to(signal.device)).split(counts.tolist())
        parts = [self._one(rows, self.patterns[index]) for rows, index in zip(sorted_rows, found.tolist(), strict=True)]
        return torch.cat(parts).index_select(0, order.argsort().to(signal.device))

    def _one(self, signal: Tensor, pattern: str) -> Tensor:
        if is_picture(signal):
            recorded = mosaic(signal.expand(-1, 3, -1, -1), pattern=pattern)
            return demosaic(recorded, pattern=pattern, method=self.method)[:, : signal.shape[1]]
        own = self.colour_filter
        if own is None:
            own = ColourFilter.rgbw() if pattern == "rgbw" else ColourFilter.kodak()
        wavelengths = wavelength_grid(count=signal.shape[1]) if self.wavelengths is None else self.wavelengths
        stages = (own, Mosaic(pattern), Exposure(), Demosaic(self.method), WhiteBalance(), ColourMatrix(), ToneCurve())
        return Camera(*stages, context=Context(wavelengths=wavelengths))(signal)


class RandomShotReadNoise(CameraAugmentation):
    """Photon noise and read-out noise at a random ISO, in EMVA 1288 terms, in linear light.

    y = min(g (N / w + (sigma_d / w) e), 1),   N ~ Poisson(x w / g),   e ~ N(0, 1),   g = iso / 100

    with w the full well [electrons] and x = 1 the white that fills the range: its variance against its mean is the
    photon transfer line  var = (g / w) x + (g sigma_d / w)^2.

    Args:      iso: 100 is base, drawn uniformly in its logarithm. full_well: [electrons] at base ISO.
               read_noise: sigma_d [electrons].
               photons: "poisson", or "normal" for one normal number of this mean and variance instead of N and e, in
               a third of the time: it has no steps of whole electrons and lacks Poisson's skewness, 1 / sqrt(N).
    Raises:    ValueError for bounds that are not positive, or other photons.
    Source:    EMVA 1288 release 4.0; "normal" is the model of Foi et al., IEEE Trans. Image Processing 17, 1737 (2008).

    Example:
    >>> gray = torch.full((8, 3, 64, 64), 0.5)
    >>> low, high = (KC.RandomShotReadNoise(iso=iso, p=1.0)(gray).std() for iso in (100.0, 1600.0))
    >>> round(float(high / low))  # the root of 16
    4
    """

    alone = True

    def __init__(
        self,
        iso: Bounds = (100.0, 3200.0),
        *,
        full_well: Bounds = 10_000.0,
        read_noise: Bounds = 3.0,
        photons: Literal["poisson", "normal"] = "poisson",
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        if photons not in ("poisson", "normal"):
            raise ValueError(f'photons must be "poisson" or "normal", got {photons!r}.')
        draws: dict[str, Draw] = {
            "iso": Uniform(iso, "log", least=1e-3, unit="(100 is base)"),
            "full_well": Uniform(full_well, "log", least=1.0, unit="[electrons]"),
            "read_noise": Uniform(read_noise, least=0.0, unit="[electrons]"),
            "noise_seed": Seed(),
        }
        super().__init__(draws, same_on_batch=same_on_batch, p=p, keepdim=keepdim)
        self.flags = {"photons": photons}
        self.photons = photons

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """Row by row, each from its own seed."""
        gain, well, sigma = (per_sample(drawn[name], signal) for name in ("iso", "full_well", "read_noise"))
        gain = gain / 100
        generators = each_generator(drawn["noise_seed"], signal.device)
        rows = []
        for index, generator in enumerate(generators):
            row = slice(index, index + 1)
            if self.photons == "normal":
                rows.append(_normal_noise(signal[row], gain[row], well[row], sigma[row], generator))
                continue
            exposed = shot_noise(signal[row] / gain[row], full_well=well[row], generator=generator)
            read = read_noise(exposed, sigma_electrons=sigma[row], full_well=well[row], generator=generator)
            rows.append(read.mul_(gain[row]).clamp_(max=1) if is_plain(read) else clip_ste(read * gain[row], None, 1.0))
        return torch.cat(rows)


def _normal_noise(
    signal: Tensor, gain: Tensor, well: Tensor, sigma: Tensor, generator: torch.Generator | None
) -> Tensor:
    """min(x + sqrt((g / w) x + (g sigma / w)^2) e, 1), with a spread of a tenth of an electron at least: its slope."""
    noise = torch.randn(signal.shape, generator=generator, dtype=signal.dtype, device=signal.device)
    electron = gain / well
    light = clip_ste(torch.minimum(signal, gain), 0.0, None)
    spread = (light * electron + electron.square() * sigma.square().clamp(min=0.01)).sqrt()
    return clip_ste(light + spread * noise, None, 1.0)


class RandomFixedPattern(CameraAugmentation):
    """The uneven pixels of one sensor, PRNU and DSNU: `sensor.fixed_pattern`, a new sensor for each sample.

    In `K.VideoSequential` the frames of a clip share their sensor.

    Args:      prnu: relative spread of the gain, 0 to 0.5 (0.01 is 1 %). dsnu: spread of the offset [electrons].
               full_well: [electrons].

    Example:
    >>> gray = torch.full((1, 3, 64, 64), 0.5)
    >>> uneven = KC.RandomFixedPattern(prnu=0.02, dsnu=0.0, p=1.0)(gray)
    >>> round(float((((uneven + 0.055) / 1.055) ** 2.4 / 0.214).std()), 3)  # of the light
    0.02
    """

    alone = True

    def __init__(
        self,
        prnu: Bounds = (0.0, 0.02),
        dsnu: Bounds = (0.0, 10.0),
        *,
        full_well: float = 10_000.0,
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        check_positive(full_well, name="full_well", unit="electrons")
        draws: dict[str, Draw] = {
            "prnu": Uniform(prnu, least=0.0, most=MOST_PRNU, unit="(a share: 0.01 is 1 %)"),
            "dsnu": Uniform(dsnu, least=0.0, unit="[electrons]"),
            "sensor_seed": Seed(),
        }
        super().__init__(draws, same_on_batch=same_on_batch, p=p, keepdim=keepdim)
        self.flags = {"full_well": full_well}
        self.full_well = full_well

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """Row by row, each from its own seed."""
        prnu, dsnu = (per_sample(drawn[name], signal) for name in ("prnu", "dsnu"))
        rows = []
        for index, seed in enumerate(drawn["sensor_seed"].tolist()):
            row = slice(index, index + 1)
            rows.append(fixed_pattern(signal[row], prnu=prnu[row], dsnu=dsnu[row], full_well=self.full_well, seed=seed))
        return torch.cat(rows)


class RandomBanding(CameraAugmentation):
    """Stripes of a sensor: offsets of its rows, new in each frame, and of its columns, which are the sensor's.

    Rows as of `sensor.row_column_noise`, columns as of `sensor.fixed_stripes`; a new sensor for each sample. In
    `K.VideoSequential` the frames of a clip share their columns, and each has its own rows.

    Args:      row, column: sigma of the offsets [electrons].  full_well: [electrons].

    Example:
    >>> gray = torch.full((1, 3, 64, 64), 0.5)
    >>> striped = KC.RandomBanding(row=20.0, column=0.0, p=1.0)(gray)
    >>> bool((striped.std(-1) < 1e-6).all()), bool(striped.std(-2).min() > 0)  # even along rows, not across
    (True, True)
    """

    alone = True

    def __init__(
        self,
        row: Bounds = (0.0, 10.0),
        column: Bounds = (0.0, 10.0),
        *,
        full_well: float = 10_000.0,
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        check_positive(full_well, name="full_well", unit="electrons")
        draws: dict[str, Draw] = {
            "row": Uniform(row, least=0.0, unit="[electrons]"),
            "column": Uniform(column, least=0.0, unit="[electrons]"),
            "noise_seed": Seed(),
            "sensor_seed": Seed(),
        }
        super().__init__(draws, same_on_batch=same_on_batch, p=p, keepdim=keepdim)
        self.flags = {"full_well": full_well}
        self.full_well = full_well

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """Row by row, each from its own seeds."""
        row, column = (per_sample(drawn[name], signal) for name in ("row", "column"))
        generators = each_generator(drawn["noise_seed"], torch.device("cpu"))
        rows, well = [], self.full_well
        for index, (generator, seed) in enumerate(zip(generators, drawn["sensor_seed"].tolist(), strict=True)):
            one = slice(index, index + 1)
            striped = fixed_stripes(signal[one], row=0.0, column=column[one], full_well=well, seed=seed)
            rows.append(row_column_noise(striped, row=row[one], column=0.0, full_well=well, generator=generator))
        return torch.cat(rows)


class RandomHotPixels(CameraAugmentation):
    """Hot and dead pixels: `sensor.defect_pixels`, a new sensor for each sample, and the full well.

    In `K.VideoSequential` the frames of a clip share their sensor. On a picture each channel has defects of its own, as
    if it were a sensor; on a mosaic between plain stages they are those of its pixels.

    Args:      hot: share of the pixels, 0 to 1, drawn uniformly in its logarithm: least 1e-9.
               dead: share of the pixels, 0 to 1.
               electrons: mean dark electrons of a hot pixel, drawn uniformly in its logarithm.
               full_well: [electrons].
    Raises:    ValueError for shares that are together more than 1, or other bounds that cannot be.

    Example:
    >>> gray = torch.full((1, 1, 100, 100), 0.5)
    >>> shot = KC.RandomHotPixels(hot=0.01, dead=0.0, electrons=2000.0, p=1.0)(gray)
    >>> int((shot > 0.5001).sum())  # about 100 of 10 000
    102
    """

    alone = True

    def __init__(
        self,
        hot: Bounds = (1e-5, 1e-3),
        dead: Bounds = (0.0, 1e-4),
        electrons: Bounds = (100.0, 3000.0),
        *,
        full_well: float = 10_000.0,
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        check_positive(full_well, name="full_well", unit="electrons")
        draws: dict[str, Draw] = {
            "hot": Uniform(hot, "log", least=1e-9, most=1.0, unit="(a share: 1e-4 is 100 per megapixel)"),
            "dead": Uniform(dead, least=0.0, most=1.0, unit="(a share: 1e-4 is 100 per megapixel)"),
            "electrons": Uniform(electrons, "log", least=1e-3, unit="[electrons]"),
            "sensor_seed": Seed(),
        }
        super().__init__(draws, same_on_batch=same_on_batch, p=p, keepdim=keepdim)
        most = self.bounds("hot")[1] + self.bounds("dead")[1]
        if most > 1 + 1e-6:
            raise ValueError(f"hot and dead are up to {most:g} of the pixels together, more than all. 1e-4 is usual.")
        self.flags = {"full_well": full_well}
        self.full_well = full_well

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """Row by row, each from its own seed."""
        electrons, rows = per_sample(drawn["electrons"], signal), []
        shares = zip(drawn["hot"].detach().tolist(), drawn["dead"].detach().tolist(), strict=True)
        for index, ((hot, dead), seed) in enumerate(zip(shares, drawn["sensor_seed"].tolist(), strict=True)):
            one = slice(index, index + 1)
            shot = defect_pixels(
                signal[one], hot=hot, dead=dead, electrons=electrons[one], full_well=self.full_well, seed=seed
            )
            rows.append(clip_ste(shot, None, 1.0))
        return torch.cat(rows)


class RandomExposure(CameraAugmentation):
    """Over- and underexposure: linear light times 2^stops, cut off at the full well, 1.0.

    Args:      stops: of exposure; above 0 the highlights saturate.

    Example:
    >>> brighter = KC.RandomExposure(stops=1.0, p=1.0)(torch.full((1, 3, 4, 4), 0.5))  # sRGB: 0.214 of the light
    >>> round(float(brighter[0, 0, 0, 0]), 3)  # 0.428 of it
    0.686
    """

    alone = True

    def __init__(
        self, stops: Bounds = (-1.0, 1.5), *, same_on_batch: bool = False, p: float = 0.5, keepdim: bool = False
    ) -> None:
        super().__init__({"stops": Uniform(stops, unit="[stops]")}, same_on_batch=same_on_batch, p=p, keepdim=keepdim)

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """The gradient beyond the well is that of `clip_ste`."""
        exposed = signal * per_sample(2 ** drawn["stops"], signal)
        return exposed.clamp_(0, 1) if is_plain(exposed) else clip_ste(exposed, 0.0, 1.0)


class RandomQuantisation(CameraAugmentation):
    """The steps of an ADC in linear light, `sensor.quantise`, with its straight-through gradient.

    Args:      bits: (fewest, most), whole numbers 1 to 24; each number of bits is as likely.
    Raises:    ValueError for other numbers.

    Example:
    >>> steps = KC.RandomQuantisation(bits=2, p=1.0)(torch.linspace(0, 1, 100).view(1, 1, 10, 10))
    >>> len(steps.unique())
    4
    """

    alone = True

    def __init__(
        self,
        bits: tuple[int, int] | int = (6, 10),
        *,
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        ends = (bits, bits) if isinstance(bits, int) else tuple(bits) if isinstance(bits, Sequence) else ()
        if len(ends) != 2 or not all(type(end) is int for end in ends) or not 1 <= ends[0] <= ends[1] <= 24:
            raise ValueError(f"bits must be whole numbers (fewest, most) within 1..24, got {bits!r}.")
        low, high = ends
        super().__init__({"bits": Choice(high - low + 1)}, same_on_batch=same_on_batch, p=p, keepdim=keepdim)
        self.flags = {"range": (low, high)}
        self.fewest = low

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """Each row with its own steps."""
        return quantise(signal, bits=(self.fewest + drawn["bits"])[:, None, None, None])
