"""What a camera is worth, measured by photographing charts with it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from kcam import isp, optics, sensor, spectral, srgb
from kcam.analysis.edge import EdgeResponse, slanted_edge_mtf
from kcam.analysis.noise import NoisePower, noise_power_spectrum
from kcam.camera import DEMOSAICING, PAINTING, Camera
from kcam.scene import Scene

FINE = 4  # samples per pixel of the light on the sensor: no lens that is used passes twice the pixels' frequency
SOFT = 0.25  # of the edge in the scene [pixels]: none of it is above the limit of the samples; divided out again
LIGHTS = ("D65", "A", "FL2", "LED-B3")
"""The four lights of a report: daylight, a filament, a fluorescent tube, an LED."""
FLAT = 128  # pixels
FIELD_BANDS = 9  # of a lens that is traced over its field: MTF50 as of 28 to 1 %


class NotMeasured(ValueError):
    """A quantity that this camera does not have; its text says why.

    Example:
    >>> try:
    ...     kcam.analysis.shading(Camera.ideal())
    ... except kcam.analysis.NotMeasured as reason:
    ...     print(reason)
    this camera has no lens: no optics.Imaging among its stages.
    """


@dataclass(frozen=True)
class SignalToNoise:
    """SNR over exposure, of temporal noise in the raw.

    exposures: (N,), share of what saturates.  electrons: (N,), mean above black.  noise: (N,) [electrons].  snr: (N,).

    Example:
    >>> curve = kcam.analysis.signal_to_noise(Camera.phone(), [0.5])
    >>> round(float(curve.electrons), -2), 0.97 < float(curve.snr) / 2812**0.5 < 1.02  # of 5625: black takes 64 of 1023
    (2800.0, True)
    """

    exposures: Tensor
    electrons: Tensor
    noise: Tensor
    snr: Tensor


@dataclass(frozen=True)
class DynamicRange:
    """Saturation over the noise in the dark, both [electrons]; `ratio`, `decibels` and `stops` of it.

    Example:
    >>> found = kcam.analysis.DynamicRange(saturation=8000.0, dark_noise=8.0)
    >>> found.decibels, round(found.stops, 2)
    (60.0, 9.97)
    """

    saturation: float
    dark_noise: float

    @property
    def ratio(self) -> float:
        """Saturation over noise."""
        return self.saturation / self.dark_noise

    @property
    def decibels(self) -> float:
        """20 log10 of the ratio."""
        return 20 * math.log10(self.ratio)

    @property
    def stops(self) -> float:
        """log2 of the ratio."""
        return math.log2(self.ratio)


@dataclass(frozen=True)
class ColourError:
    """CIEDE2000 of the 24 patches under one light, and their colours in linear sRGB as they should be and as they are.

    light: its name.  delta_e: (24,).  wanted, got: (24,3).

    Example:
    >>> (found,) = kcam.analysis.colour_error(Camera.ideal(), ["D65"])
    >>> round(found.mean, 1)
    0.9
    """

    light: str
    delta_e: Tensor
    wanted: Tensor
    got: Tensor

    @property
    def mean(self) -> float:
        """Over the patches."""
        return float(self.delta_e.mean())

    @property
    def largest(self) -> float:
        """Of any patch."""
        return float(self.delta_e.max())


# ---- parts of a camera -----------------------------------------------------------------------------------------------


def imaging_of(camera: Camera) -> optics.Imaging | None:
    """The Imaging of a camera; None without. NotMeasured where it is not its first stage.

    Example:
    >>> kcam.analysis.imaging_of(Camera.ideal()) is None
    True
    """
    for index, stage in enumerate(camera):
        if isinstance(stage, optics.Imaging):
            if index:
                raise NotMeasured(
                    f"{type(camera[0]).__name__} stands before the Imaging, so no light can be laid on the pixels."
                )
            return stage
    return None


def _lens_of(camera: Camera) -> optics.Imaging:
    imaging = imaging_of(camera)
    if imaging is None:
        raise NotMeasured("this camera has no lens: no optics.Imaging among its stages.")
    return imaging


def _behind(camera: Camera) -> Camera:
    """All that is behind the lens; it still knows what the lens said."""
    return camera if imaging_of(camera) is None else camera[1:]


def _raw_part(camera: Camera) -> Camera:
    """From the light on the pixels to the raw."""
    after = _behind(camera)
    ends = (*DEMOSAICING, isp.WhiteBalance, isp.ColourMatrix, isp.ToneCurve, *PAINTING)
    end = next((index for index, stage in enumerate(after) if isinstance(stage, ends)), len(after))
    return after[:end]


def _stage(camera: Camera, kind: type) -> Any:
    return next((stage for stage in camera if isinstance(stage, kind)), None)


def _evenly(camera: Camera, level: float, *, size: int = FLAT) -> Scene:
    """An even white of so many times the scene's white, as light on the pixels."""
    grid = camera.resolve().wavelengths
    light = spectral.illuminant("D65", wavelengths=grid)
    return Scene(torch.full((1, 1, size, size), level), light[None], grid, 2.0, light)


def _plane(signal: Tensor, camera: Camera) -> Tensor:
    """The pixels of green of a raw (B,C,H,W), (B,N): the lightest channel where there is no green."""
    if signal.shape[1] > 1:
        return signal[:, 1].flatten(1)
    if _stage(camera, sensor.Mosaic) is None:
        return signal.flatten(1)
    masks = sensor.channel_masks(camera.resolve().pattern, *signal.shape[-2:])
    return signal[:, 0][:, masks[min(1, len(masks) - 1)].bool()]


@torch.no_grad()
def _response(camera: Camera) -> tuple[float, float]:
    """Of the raw in green, noiseless: the value without light, and its rise for the scene's white, not saturated."""
    part, most = _raw_part(camera).noiseless(), _saturation(camera)
    dark = float(_plane(part(_evenly(camera, 0.0, size=56)), camera).double().mean())
    level = 1e-2
    rise = 0.0
    for _ in range(12):  # to where steps of an ADC do not matter and nothing saturates
        rise = float(_plane(part(_evenly(camera, level, size=56)), camera).double().mean()) - dark
        if not 0.2 < rise / max(most - dark, 1e-6) < 0.6:
            level *= min(max(0.4 * (most - dark) / max(rise, 1e-4), 0.02), 50.0)
        else:
            break
    if not rise > 0:
        raise NotMeasured("the raw does not rise with the light.")
    return dark, rise / level


def _electrons(camera: Camera) -> float:
    """Of one unit of the raw, in which 1.0 is full scale: full well over gain."""
    context = camera.resolve()
    return float(context.full_well) / (1.0 if _stage(camera, sensor.ADC) is None else float(context.gain))


def _saturation(camera: Camera) -> float:
    return sensor.saturation(camera, camera.resolve())


# ---- resolution ------------------------------------------------------------------------------------------------------


@torch.no_grad()
def edge_response(
    camera: Camera,
    *,
    place: tuple[float, float] = (0.0, 0.0),
    angle: float = 5.0,
    horizontal: bool = False,
    whole: bool = False,
    size: int | None = None,
    distance: float | None = None,
) -> EdgeResponse:
    """Photograph a slanted edge, and say what contrast it keeps over frequency.

    The light on the sensor is computed at 4 samples per pixel and summed over each pixel, as in a camera: the edge is
    continuous, not made of pixels. What the chart itself lacks is divided out. There is no noise.

    Args:      place: of the middle of the edge, x and y on the sensor from the axis [m].
               angle: from the columns, or from the rows if `horizontal` [degrees].
               whole: the luminance of the finished picture before its tone curve, with all that demosaicing and
               sharpening do to it; else that of the light on the pixels, optics and pixel aperture alone.
               size: of the part that is measured [pixels]; None for 128, or 64 where the lens is traced over its field:
               the tails of a wide blur that lie outside raise MTF50, by 1 % for f/5.6 on 64 pixels of 1.5 um.
               distance: of the chart [m]; None for where the lens is focused.
    Returns:   an `EdgeResponse`.
    Raises:    NotMeasured for a camera whose signal is not a picture; ValueError as `slanted_edge_mtf`.
    Source:    ISO 12233:2017, e-SFR, with the edge's contrast of 4:1.

    Example:
    >>> sharp = kcam.analysis.edge_response(Camera.ideal())  # no lens: the pixel's aperture, sinc(0.603) = 0.5
    >>> round(sharp.mtf50, 2)
    0.6
    """
    imaging, context = imaging_of(camera), camera.resolve()
    margin = 16
    size = size or (64 if imaging is not None and imaging.varies else 128)
    side = size + 2 * margin
    grid = context.wavelengths
    if imaging is not None and imaging.varies:  # tracing a field takes seconds a band
        grid = _few(grid)
    light = spectral.illuminant("D65", wavelengths=grid)
    dark, rise = _response(camera) if whole else (0.0, 1.0)
    bright = 0.8 if not whole else min(0.8, 0.75 * (_saturation(camera) - dark) / rise)
    at = (torch.arange(side * FINE, dtype=torch.float64) + 0.5) / FINE - side / 2
    tangent = math.tan(math.radians(angle))
    across = (at[None] - tangent * at[:, None]) * math.cos(math.radians(angle))
    edge = bright * (0.625 + 0.375 * torch.erf(across / (SOFT * math.sqrt(2))))
    edge = edge.T if horizontal else edge
    if imaging is None:
        planes, pixel, pitch, away = edge[None, None], 1.0, None, 2.0
        spectra = light[None]
    else:
        pitch = float(imaging.pixel_pitch)
        pixel = math.sqrt(float(imaging.fill_factor)) if imaging.integrate else 1e-6
        away = distance if distance is not None else float(getattr(imaging.lens, "focus_distance", 2.0))
        away = away if away > 0 else 2.0
        fine = imaging.changed(
            pixel_pitch=pitch / FINE, fill_factor=1.0, integrate=True, psf_shape=None, border="replicate", centre=place
        )
        planes = fine(Scene(edge[None, None].float(), light[None], grid, away, light), context)
        spectra = None
    weights = _overlap(pixel)
    kernel = (weights[:, None] * weights)[None, None].to(planes)
    planes = nn.functional.conv2d(planes.transpose(0, 1), kernel, stride=FINE).transpose(0, 1)
    if spectra is not None:
        planes = planes * spectra[0][:, None, None]
    if whole:
        after = _behind(camera).noiseless()
        linear = after[: next((i for i, s in enumerate(after) if isinstance(s, isp.ToneCurve)), len(after))]
        picture = linear(Scene(planes.float(), torch.eye(len(grid)).double(), grid, 2.0, light))
        if picture.shape[-2:] != planes.shape[-2:]:
            raise NotMeasured(f"the picture has {tuple(picture.shape[-2:])} pixels where the sensor has another count.")
        luma = spectral.xyz_to_srgb_matrix().inverse()[1].to(picture)
        picture = torch.einsum("c,chw->hw", luma, picture[0]) if picture.shape[1] == 3 else picture[0].mean(0)
    else:
        luminance = spectral.xyz_weights(grid)[:, 1]
        picture = torch.einsum("l,lhw->hw", luminance, planes[0].double())
    found = slanted_edge_mtf(picture[margin:-margin, margin:-margin], pixel_pitch=pitch)
    chart = torch.exp(-2 * (math.pi * SOFT * found.frequencies) ** 2)
    for turned in (math.cos(math.radians(angle)), math.sin(math.radians(angle))):
        along = found.frequencies * turned
        taken = (weights[:, None] * torch.cos(2 * math.pi * along * (_sample_places()[:, None]))).sum(0)
        taken = taken if imaging is None else taken * torch.sinc(along / FINE)
        chart = chart * taken / torch.sinc(pixel * along)
    return EdgeResponse(found.frequencies, found.mtf / chart, found.angle, found.contrast, pitch)


def _few(grid: Tensor) -> Tensor:
    """As far as these bands, but few of them."""
    return torch.linspace(float(grid.min()), float(grid.max()), min(len(grid), FIELD_BANDS), dtype=torch.float64)


def _overlap(width: float) -> Tensor:
    """How much of each of the samples of a pixel its active width covers, (FINE,), together 1."""
    edges = torch.linspace(-0.5, 0.5, FINE + 1, dtype=torch.float64).clamp(-width / 2, width / 2)
    return edges.diff() / edges.diff().sum()


def _sample_places() -> Tensor:
    """Of the samples of a pixel, from its middle [pixels]."""
    return (torch.arange(FINE, dtype=torch.float64) + 0.5) / FINE - 0.5


# ---- noise -----------------------------------------------------------------------------------------------------------


@torch.no_grad()
def signal_to_noise(
    camera: Camera, exposures: Sequence[float] | Tensor | None = None, *, seed: int = 0
) -> SignalToNoise:
    """SNR of the raw over exposure: from two pictures each of an even scene, in green.

    SNR = (mean - black) / sigma,   sigma^2 = var(a - b) / 2

    The difference of two pictures leaves temporal noise alone, without what is fixed in the pixels.

    Args:      exposures: shares of the one that saturates, > 0; None for 13 from 2^-12 to 0.9.
               seed: of the noise.
    Returns:   a `SignalToNoise`; SNR is inf where there is no noise.
    Raises:    ValueError for no exposures or such that are not above 0.
    Valid to 1 % (128 x 128 pixels, half of them green).
    Source:    EMVA Standard 1288, release 4.0, 6.6.

    Example:
    >>> curve = kcam.analysis.signal_to_noise(Camera.phone(), [0.1, 0.4])
    >>> 1.9 < float(curve.snr[1] / curve.snr[0]) < 2.1  # as the root of the light
    True
    """
    shares = torch.as_tensor([2.0**-k for k in range(12, 0, -1)] + [0.9] if exposures is None else exposures).double()
    if shares.ndim != 1 or not len(shares) or not bool((shares > 0).all() and shares.isfinite().all()):
        raise ValueError(f"exposures must be shares of saturation above 0, such as [0.01, 0.1], got {exposures}.")
    part, (dark, rise), unit = _raw_part(camera), _response(camera), _electrons(camera)
    full = (_saturation(camera) - dark) / rise
    generator = torch.Generator().manual_seed(seed)
    means, sigmas = [], []
    for share in shares.tolist():
        mean, sigma = _temporal(camera, part, share * full, generator)
        means.append((mean - dark) * unit)
        sigmas.append(sigma * unit)
    electrons, noise = torch.tensor(means, dtype=torch.float64), torch.tensor(sigmas, dtype=torch.float64)
    return SignalToNoise(shares, electrons, noise, torch.where(noise > 0, electrons / noise, math.inf))


def _temporal(camera: Camera, part: Camera, level: float, generator: torch.Generator) -> tuple[float, float]:
    """Mean and temporal noise of green in the raw."""
    scene = _evenly(camera, level)
    a, b = (_plane(part(scene, generator=generator).double(), camera) for _ in range(2))
    return float((a + b).mean() / 2), float((a - b).var() / 2) ** 0.5


@torch.no_grad()
def dynamic_range(camera: Camera, *, seed: int = 0) -> DynamicRange:
    """Saturation above black over the temporal noise in the dark, quantisation included.

    DR = saturation / sqrt(sigma_dark^2 + step^2 / 12),   sigma_dark: before the ADC

    Saturated is a full well or the end of the converter, whichever comes first.

    Raises:    NotMeasured for a camera without noise and without steps: nothing limits it.
    Source:    EMVA Standard 1288, release 4.0, 6.8.

    Example:
    >>> found = kcam.analysis.dynamic_range(Camera.slr())  # 60 000 electrons over 4 of read noise and steps of 14.65
    >>> abs(found.dark_noise / math.hypot(4.0, 14.65 / 12**0.5) - 1) < 0.06
    True
    """
    part, (dark, _), unit = _raw_part(camera), _response(camera), _electrons(camera)
    # before the ADC: its black level may cut the noise, and less noise than a step would round away
    converter = next((index for index, stage in enumerate(part) if isinstance(stage, sensor.ADC)), None)
    _, sigma = _temporal(camera, part[:converter], 0.0, torch.Generator().manual_seed(seed))
    if converter is None:
        noise = sigma * unit
    else:
        step = unit / (2 ** float(part[converter].bits) - 1)
        noise = math.hypot(sigma * float(camera.resolve().full_well), step / math.sqrt(12))
    if noise == 0:
        raise NotMeasured("no noise and no ADC: nothing limits the dynamic range.")
    return DynamicRange((_saturation(camera) - dark) * unit, noise)


@torch.no_grad()
def noise_power(camera: Camera, *, level: float = 0.18, seed: int = 0) -> NoisePower:
    """Noise power of the raw's rows and columns of green, or of the picture's luminance where there is a picture.

    Measured at an even grey of `level` of white, as half the power of the difference of two pictures, four times.

    Raises:    NotMeasured for a camera without noise.

    Example:
    >>> power = kcam.analysis.noise_power(Camera.phone())  # demosaicing smooths: less power at the pixels' limit
    >>> bool(power.radial[-1] < power.radial[4])
    True
    """
    after = _behind(camera)
    linear = after[: next((i for i, s in enumerate(after) if isinstance(s, isp.ToneCurve)), len(after))]
    generator = torch.Generator().manual_seed(seed)
    scene, differences = _evenly(camera, level), []
    for _ in range(4):
        a, b = (linear(scene, generator=generator).double() for _ in range(2))
        luma = spectral.xyz_to_srgb_matrix().inverse()[1].to(a)
        difference = torch.einsum("c,bchw->bhw", luma, a - b) if a.shape[1] == 3 else (a - b).mean(1)
        differences.append(difference[0, 8:-8, 8:-8] / math.sqrt(2))
    if not any(bool(one.any()) for one in differences):
        raise NotMeasured("this camera has no noise.")
    imaging = imaging_of(camera)
    return noise_power_spectrum(
        torch.stack(differences), pixel_pitch=None if imaging is None else float(imaging.pixel_pitch)
    )


# ---- colour ----------------------------------------------------------------------------------------------------------


@torch.no_grad()
def colour_error(camera: Camera, illuminants: Sequence[str] = LIGHTS) -> list[ColourError]:
    """How far the colours of the chart's 24 patches are from what the eye sees, under each light.

    The patches are even fields without noise; white balance and colour matrix follow the light as the camera's stages
    do. What should be is the observer's colour under that light, adapted to D65 by Bradford's matrix.

    Args:      illuminants: names of `spectral.illuminant_names()`.
    Returns:   a `ColourError` for each.
    Raises:    ValueError for an unknown name; NotMeasured for a camera that gives no picture of three channels.
    Source:    ISO 17321-1; CIE 142-2001 (CIEDE2000); ICC.1:2022, annex E (Bradford).

    Example:
    >>> [round(found.mean) for found in kcam.analysis.colour_error(Camera.phone(), ["D65", "A"])]
    [1, 3]
    """
    from skimage.color import deltaE_ciede2000, xyz2lab

    after, grid, found = _behind(camera).noiseless(), camera.resolve().wavelengths, []
    daylight, stages = spectral.xyz_weights(grid, "D65").sum(0), []
    for stage in after:  # a fixed time is made up for by the light: the chart is lit as the ISP expects it
        timed = isinstance(stage, sensor.Exposure) and stage.time is not None
        iso = stage.iso if timed else None
        stages.append(sensor.Exposure(stage.white_share, iso=iso) if timed else stage)  # type: ignore[arg-type]
    after = Camera(*stages, context=after.resolve())
    for name in illuminants:
        light = spectral.illuminant(name, wavelengths=grid)
        patches = spectral.reflectances(grid)
        side = 56
        # 24 even fields side by side would bleed into each other: each is a picture
        scene = Scene(
            torch.eye(24)[:, :, None, None].expand(24, 24, side, side).contiguous(),
            patches * light,
            grid,
            2.0,
            light,
        )
        picture = after(scene).double()
        if picture.shape[1] != 3:
            raise NotMeasured(f"the camera gives {picture.shape[1]} channels, no colours.")
        got = picture[..., 8:-8, 8:-8].mean((-2, -1)) if picture.shape[-1] > 16 else picture.mean((-2, -1))
        got = srgb.to_light(got.clamp(0, 1)) if _stage(camera, isp.ToneCurve) is not None else got.clamp(0, 1)
        weights = spectral.xyz_weights(grid, name)
        wanted = patches @ weights @ spectral.adaptation(weights.sum(0), daylight).T
        seen = got @ spectral.xyz_to_srgb_matrix().inverse().T
        white = daylight.numpy()
        labs = [xyz2lab((xyz.numpy() / white) * np.array([0.95047, 1.0, 1.08883])) for xyz in (wanted, seen)]
        delta = torch.as_tensor(deltaE_ciede2000(*labs))
        found.append(ColourError(name, delta, wanted @ spectral.xyz_to_srgb_matrix().T, got))
    return found


# ---- over the field --------------------------------------------------------------------------------------------------


def half_diagonal(camera: Camera, size: tuple[int, int] | None = None) -> float:
    """From the axis to the corner of a picture of this size (height, width) [m]; as far as the lens reaches for None.

    Raises:    NotMeasured for a camera without a lens, or, without a size, with one that does not say how far it goes.

    Example:
    >>> round(kcam.analysis.half_diagonal(Camera.phone(), (3000, 4000)) * 1e3, 2)  # mm
    3.5
    """
    imaging = _lens_of(camera)
    if size is not None:
        return float(imaging.pixel_pitch) * math.hypot(*size) / 2
    lens = imaging.lens
    if not isinstance(lens, optics.CompoundLens):
        raise NotMeasured(
            f"the field of a {type(lens).__name__} has no end: say how large the sensor is, size=(3000, 4000)."
        )
    field = torch.tensor([[0.0, lens.field_limit(distance=lens.focus_distance)]], dtype=torch.float64)
    where = lens.image_point([lens.focus_wavelength], distances=lens.focus_distance, field=field)
    return 0.95 * float(where.detach().abs().max())


@torch.no_grad()
def shading(
    camera: Camera, radii: Sequence[float] | Tensor | None = None, *, size: tuple[int, int] | None = None
) -> tuple[Tensor, Tensor]:
    """Light of an even scene over the field relative to the axis: radii (N,) [m] and shares (C,N) of each channel.

    Raises:    NotMeasured as `half_diagonal`, and for optics that are computed on the axis alone.

    Example:
    >>> radii, shares = kcam.analysis.shading(Camera.phone_lens(), [0.0, 1e-3])
    >>> bool(shares[1, 1] < 0.95 * shares[1, 0])
    True
    """
    imaging, context = _lens_of(camera), camera.resolve()
    if not imaging.varies:
        raise NotMeasured("these optics are computed on the axis alone: no shading. Use a CompoundLens or field=True.")
    places = torch.linspace(0, half_diagonal(camera, size), 9) if radii is None else torch.as_tensor(radii)
    places, behind, grid = places.double(), _behind(camera), _few(context.wavelengths)
    first = behind[0] if len(behind) else None
    weights = spectral.xyz_weights(grid)[:, 1:2].T
    if isinstance(first, sensor.ColourFilter):
        weights = first.contraction(grid).detach().double().cpu()
    weights = weights * spectral.illuminant("D65", wavelengths=grid)
    lens: Any = imaging.lens
    if not hasattr(lens, "relative_illumination"):
        raise NotMeasured(f"a {type(lens).__name__} does not say how its light falls off over the field.")
    fields = torch.tensor([[0.0, _height(lens, radius)] for radius in [0.0, *places.tolist()]], dtype=torch.float64)
    bands = [
        lens.relative_illumination(fields, wavelengths=[one], distances=lens.focus_distance) for one in grid.tolist()
    ]
    values = weights @ torch.stack(bands).detach().double().cpu()
    return places, values[:, 1:] / values[:, :1]


def _height(lens: optics.CompoundLens, radius: float) -> float:
    """Y / D of the point whose image lies at a radius [m]."""
    if radius == 0:
        return 0.0
    height = radius / (float(_landed(lens, 1e-4)) / 1e-4)
    for _ in range(30):
        height, before = height * radius / float(_landed(lens, height)), height
        if abs(height / before - 1) < 1e-9:
            break
    return height


@torch.no_grad()
def distortion(
    camera: Camera, radii: Sequence[float] | Tensor | None = None, *, size: tuple[int, int] | None = None
) -> tuple[Tensor, Tensor]:
    """How far images lie from where a lens without distortion has them: radii (N,) [m] and shares (N,), < 0 for barrel.

    D = h / (m y) - 1,   h: the chief ray's height on the sensor,  m y: that of a small field, extended

    Raises:    NotMeasured as `half_diagonal`, and for optics without a field.
    Source:    ISO 17850:2015.

    Example:
    >>> radii, shares = kcam.analysis.distortion(Camera.phone_lens(), [1e-3])
    >>> abs(float(shares)) < 0.05
    True
    """
    imaging = _lens_of(camera)
    if not imaging.varies or not hasattr(imaging.lens, "image_heights"):
        raise NotMeasured(
            "these optics have no distortion: they are computed on the axis alone, or have no chief rays."
        )
    places = (torch.linspace(0, half_diagonal(camera, size), 9) if radii is None else torch.as_tensor(radii)).double()
    lens: Any = imaging.lens
    scale = float(_landed(lens, 1e-4)) / 1e-4
    found = [radius / (scale * _height(lens, radius)) - 1 if radius else 0.0 for radius in places.tolist()]
    return places, torch.tensor(found, dtype=torch.float64)


def _landed(lens: optics.CompoundLens, height: float) -> Tensor:
    field = torch.tensor([[0.0, height]], dtype=torch.float64)
    return lens.image_point([lens.focus_wavelength], distances=lens.focus_distance, field=field).detach().abs().max()
