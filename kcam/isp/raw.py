"""Raw: what a sensor recorded, with all that its picture needs beside the numbers; and its development."""

from __future__ import annotations

import io
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from kcam import files, spectral
from kcam.inputs import describe
from kcam.isp import camera_profile, libraw, tiff
from kcam.isp.colour import apply_colour_matrix, tone_curve, white_balance
from kcam.isp.demosaic import demosaic
from kcam.isp.tiff import COLOURED, MOST_DN
from kcam.sensor.adc import ADC, saturation
from kcam.sensor.arguments import in_float32
from kcam.sensor.exposure import Exposure
from kcam.sensor.mosaic import PATTERNS
from kcam.ste import round_ste
from kcam.units import as_numbers, check_positive

if TYPE_CHECKING:
    from kcam.camera import Camera
    from kcam.scene import Scene

SUFFIXES = (".dng", ".tif", ".tiff", ".npy")
"""Of the files that are written."""
EIGHT_BITS = 255
D50 = (0.9642, 1.0, 0.8249)
"""The white of the ICC's connection space, to which a ForwardMatrix leads."""


@dataclass(frozen=True, eq=False, repr=False)
class Raw:
    """What a sensor recorded, and what its picture needs: one picture, as it lies on the sensor (not turned).

    Fields:    mosaic: (1,1,H,W) [DN], float32 or float64, which hold 16 bits exactly; whole numbers become float32.
               pattern: name in `kcam.sensor.PATTERNS`, its tile's corner on the picture's; None for monochrome.
               black_level: the number of no light [DN]: one, or a tensor of one for each cell of the pattern's tile.
               white_level: the number of a full pixel, of its well or of the converter, above 255 [DN].
               neutral: (3,) what a white gives in each channel in the light of the shot, 1 in green (DNG's
               AsShotNeutral, 1 / gains; brought there by its green); None where nothing is known, or monochrome.
               colour_matrix: (3,3) XYZ in daylight to the camera's channels (DNG's ColorMatrix1 for D65), or None.
               noise_profile: (S, O): the variance is S x + O of a signal x, black at 0 and white at 1, or None.
               baseline_exposure: by how much the developed picture is to be brighter than that x [EV].
               exposure_time [s], iso: None where unknown.  camera: its name.
    Raises:    TypeError, ValueError for fields that cannot be: another shape, NaN, 8 bits, black at white.
    Source:    Adobe, Digital Negative Specification 1.4.0.0, chapters 4 to 6, and 1.3 for the NoiseProfile.

    Example:
    >>> camera = Camera.phone()
    >>> raw = kcam.Raw.from_camera(camera, camera.raw(Scene.builtin("colour_chart", size=96)))
    >>> raw.pattern, raw.black_level, raw.white_level, [round(gain, 2) for gain in raw.gains.tolist()]
    ('RGGB', 64.0, 1023.0, [1.65, 1.0, 1.18])
    """

    mosaic: Tensor
    pattern: str | None
    black_level: float | Tensor
    white_level: float
    neutral: Tensor | None = None
    colour_matrix: Tensor | None = None
    noise_profile: tuple[float, float] | None = None
    baseline_exposure: float = 0.0
    exposure_time: float | None = None
    iso: float | None = None
    camera: str = "kcam"

    def __post_init__(self) -> None:
        for name, value in (
            ("mosaic", _checked_mosaic(self.mosaic)),
            ("white_level", _number(self.white_level, "white_level", "DN")),
            ("black_level", self._checked_black()),
            ("neutral", _finite(self.neutral, "neutral", (3,))),
            ("colour_matrix", _finite(self.colour_matrix, "colour_matrix", (3, 3))),
            ("noise_profile", _pair(self.noise_profile)),
            ("baseline_exposure", _number(self.baseline_exposure, "baseline_exposure", "EV")),
        ):
            object.__setattr__(self, name, value)
        if self.white_level <= EIGHT_BITS:
            raise ValueError(
                f"white_level {self.white_level:g} is that of 8 bits or less, whose steps are coarser than the "
                "noise of the shadows: 8 bits are refused for raw data. Record it with sensor.ADC(bits=12)."
            )
        if self.pattern not in (None, *COLOURED):
            white = " It has white pixels, for which raw files have no colours." if self.pattern in PATTERNS else ""
            raise ValueError(f"pattern must be one of {', '.join(COLOURED)}, or None, got {self.pattern!r}.{white}")
        black = torch.as_tensor(self.black_level)
        tile = np.shape(PATTERNS[self.pattern]) if self.pattern else (1, 1)
        if black.ndim and tuple(black.shape) != tile:
            raise ValueError(
                f"black_level of shape {tuple(black.shape)} fits no {self.pattern or 'monochrome'} sensor: expected "
                f"one number, or {tile}, one for each cell of the tile."
            )
        low, high = float(black.min()), float(black.max())
        if not (low >= 0 and high < self.white_level):
            raise ValueError(
                f"black_level must be from 0 to below the white level of {self.white_level:g} DN, such as 64, got "
                f"{low if not low >= 0 else high:g}."
            )
        if self.neutral is not None:
            if not bool((self.neutral > 0).all()):
                raise ValueError(f"neutral must be above 0, such as [0.6, 1.0, 0.8], got {self.neutral.tolist()}.")
            object.__setattr__(self, "neutral", self.neutral / self.neutral[1])
        if self.colour_matrix is not None and not abs(torch.linalg.det(self.colour_matrix)) > 1e-9:
            raise ValueError(
                f"colour_matrix cannot be inverted: its determinant is {torch.linalg.det(self.colour_matrix):g}. "
                "Expected three channels that differ, a determinant such as 0.5."
            )
        if not isinstance(self.camera, str):
            raise TypeError(f"camera must be the camera's name, got {describe(self.camera)}.")
        for name, unit in (("exposure_time", "s"), ("iso", "(100 is base)")):
            if getattr(self, name) is not None:
                check_positive(getattr(self, name), name=name, unit=unit)

    def __repr__(self) -> str:
        """What is known of it; tensors by their shapes."""
        held = {name: value for name, value in vars(self).items() if value is not None}
        shown = (f"{name}={tuple(v.shape) if isinstance(v, Tensor) else repr(v)}" for name, v in held.items())
        return f"Raw({', '.join(shown)})"

    def _checked_black(self) -> float | Tensor:
        values = as_numbers(self.black_level, name="black_level", expected="a number of DN such as 64").detach().cpu()
        return float(values) if values.numel() == 1 else values

    @property
    def gains(self) -> Tensor:
        """White balance gains, 1 / neutral, (3,) float64.

        Raises:    ValueError where the neutral is not known.
        """
        if self.neutral is None:
            raise ValueError(
                "the neutral of this raw is not known, so it has no white balance. Measure what a gray card gives in "
                "each channel, such as dataclasses.replace(raw, neutral=[0.6, 1.0, 0.8])."
            )
        return 1 / self.neutral

    @property
    def camera_to_srgb(self) -> Tensor:
        """The matrix M from white balanced channels to linear sRGB, white to white, (3,3) float64; see `develop`.

        M^-1 = rows of (ColorMatrix1 XYZ_from_sRGB), each divided by its sum

        so that the neutral of the shot becomes gray for any ColorMatrix1, as in LibRaw; the eye's adaptation to the
        light is the white balance.

        Raises:    ValueError where the colour matrix is not known.
        """
        if self.colour_matrix is None:
            raise ValueError(
                "the colours of this camera are not known. Give its matrix from XYZ in daylight to its channels, "
                "dataclasses.replace(raw, colour_matrix=...), 3 x 3."
            )
        channels = self.colour_matrix @ torch.linalg.inv(spectral.xyz_to_srgb_matrix())
        return torch.linalg.inv(channels / channels.sum(1, keepdim=True))

    @property
    def forward_matrix(self) -> Tensor:
        """From white balanced channels to XYZ under D50, (3,3) float64: DNG's ForwardMatrix1, its word for M."""
        to_xyz = torch.linalg.inv(spectral.xyz_to_srgb_matrix())
        change = spectral.adaptation(to_xyz.sum(1), torch.tensor(D50, dtype=torch.float64))
        return change @ to_xyz @ self.camera_to_srgb

    @classmethod
    def from_camera(cls, camera: Camera, raw: Tensor, *, scene: Scene | None = None) -> Raw:
        """A camera's raw signal as a raw file has it, with the levels, colours and noise of the camera's own stages.

        DN = (2^bits - 1) raw,   neutral = 1 / gains,   S = k,   O = k^2 sigma_d^2 + 1 / (12 (white - black)^2),
        k = gain (2^bits - 1) / ((white - black) full_well)

        White balance and colour matrix are those that the camera develops with: what its stages were given, else what
        follows from its filter and the light. ColorMatrix1 has the filter's neutral in D65 as its white.

        Args:      camera: with an ADC, of more than 8 bits.
                   raw: what ``camera.raw(scene)`` gave, (1,1,H,W), 1.0 = full scale. Its gradient goes on to `mosaic`.
                   scene: what was photographed, for its light; without one the camera's context says it (D65).
        Raises:    TypeError for what is no camera or no float tensor; ValueError for a camera without an ADC or with
                   one of 8 bits, full planes, a learned tile, a pattern with white, a batch, NaN, or values outside
                   0..1.
        Valid when all noise is in stages that say its `sigma`; fixed patterns are not part of the noise profile, a
                   stage of yours without one leaves it out.

        Example:
        >>> camera = Camera(sensor.Mosaic("RGGB"), sensor.ShotNoise(5_000), sensor.ReadNoise(2.0), sensor.ADC(12))
        >>> slope, offset = kcam.Raw.from_camera(camera, camera(torch.rand(1, 3, 8, 8))).noise_profile
        >>> round(1 / slope), round(5_000 * (offset - 1 / 4095**2 / 12) ** 0.5, 3)  # electrons: full well, read noise
        (5000, 2.0)
        """
        if not (callable(getattr(camera, "resolve", None)) and hasattr(camera, "stages")):
            raise TypeError(f"camera must be a kcam.Camera, got {describe(camera)}. Use Raw.from_camera(camera, raw).")
        context, stages = camera.resolve(scene), list(camera)
        adc = next((stage for stage in stages if isinstance(stage, ADC)), None)
        if adc is None:
            raise ValueError(
                "the camera has no ADC, so its raw signal has no numbers. Put sensor.ADC(bits=12, black_level=64) "
                "before its demosaic."
            )
        camera_profile.check_recorded(raw)
        pattern = camera_profile.pattern_of(stages, context)
        top = 2**adc.bits - 1
        black = _number(adc.black_level, "black_level of the ADC", "DN")
        white = round(top * saturation(stages, context))
        numbers = top * (raw.float() if raw.dtype in (torch.float16, torch.bfloat16) else raw)
        exposure = next((stage.time for stage in stages if isinstance(stage, Exposure)), None)
        return cls(
            mosaic=round_ste(numbers) if adc.rounding else numbers,
            pattern=pattern,
            black_level=black,
            white_level=white,
            **camera_profile.colours(stages, context, mono=pattern is None, share=(white - black) / top),
            noise_profile=camera_profile.noise_profile(stages, context, adc, range_=white - black, size=raw.shape[-2:]),
            exposure_time=None if exposure is None else float(exposure),
            iso=100 * camera_profile.gain(adc, context),
        )

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a file of 16 bits, whole or not at all, by its suffix.

        .dng         with all fields in the tags of DNG 1.4: for raw converters, and for `from_file` through LibRaw
        .tif, .tiff  the mosaic as a gray picture, in which the fields are tags that viewers pass over
        .npy         the mosaic alone, (H,W) uint16

        Numbers stay what they are: 10 bits stay 0..1023, and the white level says so. Fractions are rounded.

        Args:      path: replaced if it exists.
        Raises:    ValueError for another suffix, a folder that does not exist, numbers outside 0..65535, and in a DNG
                   for a mosaic without neutral or colour matrix.
        Valid when raw converters know the pattern: LibRaw has Bayer's four, and x_trans of 512 x 512 pixels and more;
                   of quad_bayer a DNG says all, but few converters listen. LibRaw opens no less than 22 x 22 pixels.

        Example:
        >>> numbers = torch.randint(64, 1024, (1, 1, 24, 32))
        >>> kcam.Raw(numbers, pattern="GBRG", black_level=64, white_level=1023).write("shot.tif")
        >>> again = kcam.Raw.from_file("shot.tif")
        >>> again.pattern, again.black_level, torch.equal(again.mosaic, numbers.float())
        ('GBRG', 64.0, True)
        """
        path = Path(path)
        suffix = path.suffix.lower()
        if suffix not in SUFFIXES:
            raise ValueError(
                f"cannot write {path.name}: raw data are 16 bits with their levels beside them, in "
                f"{', '.join(SUFFIXES)}. Use {path.stem}.dng, or, for a picture, "
                f"plots.write_picture(isp.develop(raw)[0], {path.name!r})."
            )
        files.check_place(path)
        numbers = self.mosaic.detach().round()
        high = max(float(numbers.max()), self.white_level)
        if high > MOST_DN:
            raise ValueError(
                f"cannot write {path.name}: {high:g} DN do not fit into 16 bits, expected at most {MOST_DN}. Use "
                "sensor.ADC(bits=16)."
            )
        words = numbers[0, 0].cpu().numpy().astype(np.uint16)
        if suffix == ".npy":
            with io.BytesIO() as file:
                np.save(file, words)
                content = file.getvalue()
        else:
            content = self._as_tiff(words, dng=suffix == ".dng")
        files.replace(path, content)

    def _as_tiff(self, words: np.ndarray, *, dng: bool) -> bytes:
        tags, photometric = tiff.field_tags(vars(self)), "minisblack"
        if dng and self.pattern and (self.neutral is None or self.colour_matrix is None):
            raise ValueError(
                "a DNG of colours needs the neutral and the colour matrix of the camera, and this raw lacks one. Use "
                "dataclasses.replace(raw, neutral=[0.6, 1.0, 0.8], colour_matrix=...), or write .tif."
            )
        if dng:
            forward = self.forward_matrix if self.pattern else None
            tags += tiff.dng_tags(camera=self.camera, size=words.shape, forward_matrix=forward)
            photometric = "cfa" if self.pattern else "linear_raw"
        return tiff.encode(words, tags, photometric=photometric)

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> Raw:
        """Read a camera's raw file (.dng, .nef, .cr2, .arw, ...) through LibRaw, or a .tif of `write`.

        The visible part of the sensor; an X-Trans mosaic loses up to 5 rows and columns, so that it begins where the
        pattern does. What LibRaw does not say (baseline exposure, noise profile, name) is read from the tags.

        Args:      path: the file. LibRaw comes with the extra ``kcam[raw]``.
        Raises:    FileNotFoundError; ImportError where LibRaw is needed and not there; ValueError for a file that is
                   damaged or no raw, has 8 bits, full colours, another pattern than kcam's, or no levels.

        Example:
        >>> kcam.Raw.from_file("photo.jpg")
        Traceback (most recent call last):
        FileNotFoundError: there is no file photo.jpg. Expected a raw file: .dng, .nef, .cr2, .arw, ..., or kcam's .tif.
        """
        if not isinstance(path, (str, os.PathLike)):
            raise TypeError(f"path must be the name of a file, got {describe(path)}.")
        path = Path(path)
        if not path.is_file():
            what = f"{path} is a folder" if path.is_dir() else f"there is no file {path}"
            raise FileNotFoundError(f"{what}. Expected a raw file: .dng, .nef, .cr2, .arw, ..., or kcam's .tif.")
        if path.suffix.lower() == ".npy":
            raise ValueError(
                f"{path} holds numbers alone, and neither levels nor colours. Use Raw(torch.from_numpy(np.load("
                f"{path.name!r}))[None, None], pattern='RGGB', black_level=64, white_level=1023)."
            )
        fields = (tiff if path.suffix.lower() in (".tif", ".tiff") else libraw).read(path)
        try:
            return cls(**fields)
        except (TypeError, ValueError) as error:
            raise ValueError(f"cannot read {path} as raw data: {error}") from error


@in_float32
def _linear(mosaic: Tensor, *, raw: Raw, method: str | None, domain: str) -> Tensor:
    black = torch.as_tensor(raw.black_level).to(mosaic)
    height, width = mosaic.shape[-2:]
    rows, columns = black.shape or (1, 1)
    plane = black.expand(rows, columns).repeat(-(-height // rows), -(-width // columns))[:height, :width]
    signal = (mosaic - plane) / raw.white_level
    scale = 2**raw.baseline_exposure * raw.white_level / (raw.white_level - float(black.max()))
    if raw.pattern is None:
        return apply_colour_matrix(signal, matrix=torch.full((3, 1), scale, dtype=torch.float64))
    planes = demosaic(signal, pattern=raw.pattern, method=method, domain=domain, gains=raw.gains)
    balanced = white_balance(planes, gains=raw.gains)
    return apply_colour_matrix(balanced, matrix=scale * raw.camera_to_srgb)


def develop(raw: Raw, *, method: str | None = None, domain: str = "sqrt") -> Tensor:
    """Develop raw data with the camera's stages: black level, demosaic, white balance, colour matrix, sRGB curve.

    v = tone_curve( 2^EV / (white - black)  M diag(1 / neutral) demosaic(DN - black) )

    M is `Raw.camera_to_srgb`. Of a raw by `Raw.from_camera` it is the picture that the camera itself makes, if the
    camera has the same demosaic and nothing of its own after it but white balance, colour matrix and sRGB curve.

    Args:      raw: from a camera or a file.  method, domain: of the `demosaic`.
    Returns:   (1,3,H,W) sRGB in [0,1], in the dtype of the mosaic; differentiable in ``raw.mosaic``.
    Raises:    TypeError for what is no Raw; ValueError where its neutral or its colour matrix is not known.
    Source:    for the matrix, LibRaw's ``cam_xyz_coeff``: rows of the camera's response to sRGB, normalised by white.

    Example:
    >>> camera = Camera.ideal()[:2], sensor.Mosaic("RGGB"), sensor.ADC(12, black_level=64), isp.Demosaic()
    >>> camera = Camera(*camera[0], *camera[1:], isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve())
    >>> scene = Scene.builtin("coffee", size=32)
    >>> raw = kcam.Raw.from_camera(camera, camera.raw(scene))
    >>> bool((isp.develop(raw) - camera(scene)).abs().max() < 1e-4)
    True
    """
    if not isinstance(raw, Raw):
        raise TypeError(
            f"develop takes a kcam.Raw, got {describe(raw)}. Use kcam.Raw.from_camera(camera, raw) or "
            "kcam.Raw.from_file('photo.dng')."
        )
    return tone_curve(_linear(raw.mosaic, raw=raw, method=method, domain=domain))


def _number(value: Any, name: str, unit: str) -> float:
    number = as_numbers(value, name=name, expected=f"one number of {unit}").detach()
    if number.numel() != 1 or not math.isfinite(float(number)):
        raise ValueError(f"{name} must be one finite number [{unit}], got {describe(value)}.")
    return float(number)


def _finite(value: Any, name: str, shape: tuple[int, ...]) -> Tensor | None:
    """None, or finite numbers of this shape, float64 on the CPU."""
    if value is None:
        return None
    numbers = as_numbers(value, name=name, expected=f"{' x '.join(map(str, shape))} numbers").detach().cpu()
    if numbers.shape != shape or not bool(numbers.isfinite().all()):
        raise ValueError(f"{name} must be {' x '.join(map(str, shape))} finite numbers, got {numbers.tolist()}.")
    return numbers


def _pair(value: Any) -> tuple[float, float] | None:
    numbers = _finite(value, "noise_profile", (2,))
    return None if numbers is None else (float(numbers[0]), float(numbers[1]))


def _checked_mosaic(mosaic: Any) -> Tensor:
    """(1,1,H,W) of floats."""
    if not isinstance(mosaic, Tensor) or mosaic.is_complex() or mosaic.dtype is torch.bool:
        raise TypeError(f"mosaic must be a tensor (1,1,H,W) [DN], got {describe(mosaic)}.")
    if mosaic.dtype in (torch.uint8, torch.int8):
        raise ValueError(
            f"mosaic is of {mosaic.dtype}: 8 bits are refused for raw data, since its steps are coarser than the noise "
            "of the shadows. Expected 9 to 16 bits, such as mosaic.to(torch.int32) of an ADC of 12."
        )
    if mosaic.dtype in (torch.float16, torch.bfloat16):
        raise ValueError(f"mosaic is of {mosaic.dtype}, which does not hold 16 bits. Use mosaic.float().")
    if mosaic.ndim != 4 or mosaic.shape[:2] != (1, 1) or mosaic.numel() == 0:
        raise ValueError(
            f"mosaic has shape {tuple(mosaic.shape)}, expected (1,1,H,W): one plane of one picture, not empty."
        )
    mosaic = mosaic if mosaic.is_floating_point() else mosaic.float()
    low, high = (float(end) for end in mosaic.detach().aminmax())
    if not (math.isfinite(low) and math.isfinite(high) and low >= 0):
        odd = "NaN" if math.isnan(low) else f"{low if low < 0 else high:g}"
        raise ValueError(f"mosaic must be finite and >= 0 DN, got {odd}.")
    return mosaic
