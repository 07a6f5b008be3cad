"""Raw files: what a sensor recorded, with all that its picture needs beside the numbers, in DNG, TIFF and NumPy files.

The numbers of a raw file are linear in the light. What a reader has to know beside them is `Raw`; a DNG has it in its
tags, so that any raw converter develops it, and `develop` runs kcam's own stages on it:

    linear sRGB = 2^EV / (white - black)  M diag(1 / neutral) demosaic(DN - black)
    M^-1 = rows of (ColorMatrix1 XYZ_from_sRGB), each divided by its sum

so that the neutral of the shot becomes gray for any ColorMatrix1, as in LibRaw; the eye's adaptation to the light is
the white balance. A DNG of kcam's says the same in the words of the DNG specification, by its ForwardMatrix1.
"""

from __future__ import annotations

import io
import math
import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from kcam import files, spectral
from kcam.context import Context, Stage
from kcam.inputs import describe
from kcam.isp.colour import (
    ColourMatrix,
    WhiteBalance,
    apply_colour_matrix,
    as_shot_colour_matrix,
    as_shot_gains,
    tone_curve,
    white_balance,
)
from kcam.isp.demosaic import Demosaic, demosaic
from kcam.sensor.adc import ADC, saturation
from kcam.sensor.exposure import Exposure
from kcam.sensor.mosaic import PATTERNS
from kcam.sensor.noise import FixedPattern, RandomStage, in_float32
from kcam.ste import round_ste
from kcam.units import as_numbers, check_positive

if TYPE_CHECKING:
    from kcam.camera import Camera
    from kcam.scene import Scene

SUFFIXES = (".dng", ".tif", ".tiff", ".npy")
"""Of the files that are written."""
COLOURED = tuple(name for name, tile in PATTERNS.items() if max(max(row) for row in tile) < 3)
"""Patterns of red, green and blue: DNG's colour tags have no room for white."""
EIGHT_BITS = 255
MOST_DN = 65_535
LIBRAWS = ((2, 2), (6, 6))
"""Tiles that LibRaw knows; of others it takes what it finds for one of these."""
D50 = (0.9642, 1.0, 0.8249)
"""The white of the ICC's connection space, to which a ForwardMatrix leads."""

# Tags of TIFF/EP and DNG 1.4, by their names there.
CFA_REPEAT_PATTERN_DIM, CFA_PATTERN, EXPOSURE_TIME, EXIF, ISO_SPEED = 33421, 33422, 33434, 34665, 34855
DNG_VERSION, DNG_BACKWARD_VERSION, UNIQUE_CAMERA_MODEL = 50706, 50707, 50708
CFA_PLANE_COLOR, CFA_LAYOUT, BLACK_LEVEL_REPEAT_DIM, BLACK_LEVEL, WHITE_LEVEL = 50710, 50711, 50713, 50714, 50717
DEFAULT_CROP_ORIGIN, DEFAULT_CROP_SIZE, ACTIVE_AREA = 50719, 50720, 50829
COLOR_MATRIX, CALIBRATION_ILLUMINANT, FORWARD_MATRIX = 50721, 50778, 50964  # those of the first of two lights
AS_SHOT_NEUTRAL, BASELINE_EXPOSURE, NOISE_PROFILE = 50728, 50730, 51041
PROFILE_NAME, PROFILE_TONE_CURVE, DEFAULT_BLACK_RENDER = 50936, 50940, 51110
PHOTOMETRIC, MAKE, MODEL, ORIENTATION, LINEAR_RAW = 262, 271, 272, 274, 34892
SHORT, LONG, RATIONAL, SRATIONAL = 3, 4, 5, 10
"""Types of a tag's values."""
D65_LIGHT, NO_BLACK_RENDER = 21, 1
Tag = tuple[int, str, int, Any, bool]


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
        if black.ndim and tuple(black.shape) != self._tile_shape():
            raise ValueError(
                f"black_level of shape {tuple(black.shape)} fits no {self.pattern or 'monochrome'} sensor: expected "
                f"one number, or {self._tile_shape()}, one for each cell of the tile."
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

    def _tile_shape(self) -> tuple[int, int]:
        tile = PATTERNS[self.pattern] if self.pattern else ((0,),)
        return len(tile), len(tile[0])

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
        """From white balanced channels to XYZ under D50, (3,3) float64: DNG's ForwardMatrix1."""
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
        context = camera.resolve(scene)
        adc = next((stage for stage in camera if isinstance(stage, ADC)), None)
        if adc is None:
            raise ValueError(
                "the camera has no ADC, so its raw signal has no numbers. Put sensor.ADC(bits=12, black_level=64) "
                "before its demosaic."
            )
        _check_signal(raw)
        pattern = _pattern_of(camera, context)
        top = 2**adc.bits - 1
        black = _number(adc.black_level, "black_level of the ADC", "DN")
        white = round(top * saturation(camera, context))
        numbers = top * (raw.float() if raw.dtype in (torch.float16, torch.bfloat16) else raw)
        exposure = next((stage.time for stage in camera if isinstance(stage, Exposure)), None)
        return cls(
            mosaic=round_ste(numbers) if adc.rounding else numbers,
            pattern=pattern,
            black_level=black,
            white_level=white,
            **_colours(camera, context, mono=pattern is None, share=(white - black) / top),
            noise_profile=_noise_profile(camera, context, adc, range_=white - black, size=raw.shape[-2:]),
            exposure_time=None if exposure is None else float(exposure),
            iso=100 * float(torch.as_tensor(_gain(adc, context)).detach()),
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
        import tifffile

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
        tags = self._tags(dng=suffix == ".dng") if suffix != ".npy" else []
        cfa = suffix == ".dng" and self.pattern is not None
        with io.BytesIO() as file:
            if suffix == ".npy":
                np.save(file, words)
            else:
                exif = (EXIF - 1, "I", 1, 0, True)  # tifffile refuses the tag of EXIF: one beside it keeps its place
                light = "cfa" if cfa else "minisblack"
                options: dict[str, Any] = {"metadata": None, "software": False, "byteorder": "<"}
                tifffile.imwrite(file, words, photometric=light, extratags=[*tags, exif], **options)
                self._complete(file, linear_raw=suffix == ".dng" and not cfa)
            files.replace(path, file.getvalue())

    def _tags(self, *, dng: bool) -> list[Tag]:
        """The fields as tags of TIFF; for a DNG with those that make it one."""
        tags: list[Tag] = [
            _ascii(UNIQUE_CAMERA_MODEL, self.camera),
            *self._level_tags(),
            _rational(BASELINE_EXPOSURE, [self.baseline_exposure], signed=True),
        ]
        if self.pattern:
            rows, columns = self._tile_shape()
            cells = bytes(np.array(PATTERNS[self.pattern], dtype=np.uint8).ravel())
            tags += [
                (CFA_REPEAT_PATTERN_DIM, "H", 2, (rows, columns), True),
                (CFA_PATTERN, "B", len(cells), cells, True),
            ]
        if self.neutral is not None:
            tags.append(_rational(AS_SHOT_NEUTRAL, self.neutral.tolist()))
        if self.colour_matrix is not None:
            tags.append(_rational(COLOR_MATRIX, self.colour_matrix.flatten().tolist(), signed=True))
        if self.noise_profile is not None:
            tags.append((NOISE_PROFILE, "d", 2, self.noise_profile, True))
        if self.exposure_time is not None:
            tags.append(_rational(EXPOSURE_TIME, [self.exposure_time]))  # here by TIFF/EP; and again as EXIF
        if self.iso is not None:
            tags.append((ISO_SPEED, "H", 1, self._whole_iso(), True))
        return tags + (self._dng_tags() if dng else [])

    def _complete(self, file: io.BytesIO, *, linear_raw: bool) -> None:
        """What tifffile does not write: exposure time and ISO as EXIF at the end, and that one plane is linear."""
        content = file.getvalue()
        (start,) = struct.unpack_from("<I", content, 4)
        (tags,) = struct.unpack_from("<H", content, start)
        end = len(content) + len(content) % 2
        for at in range(start + 2, start + 2 + 12 * tags, 12):
            (code,) = struct.unpack_from("<H", content, at)
            file.seek(at)
            if code == PHOTOMETRIC and linear_raw:
                file.write(struct.pack("<HHIHH", PHOTOMETRIC, SHORT, 1, LINEAR_RAW, 0))
            if code == EXIF - 1:
                file.write(struct.pack("<HHII", EXIF, LONG, 1, end))
        entries, fraction = [], b""
        count = (self.exposure_time is not None) + (self.iso is not None)
        if self.exposure_time is not None:
            fraction = struct.pack("<2I", *_rational(EXPOSURE_TIME, [self.exposure_time])[3])
            entries.append(struct.pack("<HHII", EXPOSURE_TIME, RATIONAL, 1, end + 2 + 12 * count + 4))
        if self.iso is not None:
            entries.append(struct.pack("<HHIHH", ISO_SPEED, SHORT, 1, self._whole_iso(), 0))
        file.seek(end)
        file.write(struct.pack("<H", count) + b"".join(entries) + bytes(4) + fraction)

    def _whole_iso(self) -> int:
        return min(MOST_DN, max(1, round(self.iso or 0)))

    def _level_tags(self) -> list[Tag]:
        black = torch.as_tensor(self.black_level, dtype=torch.float64)
        shape = tuple(black.shape) or (1, 1)
        return [
            (BLACK_LEVEL_REPEAT_DIM, "H", 2, shape, True),
            _rational(BLACK_LEVEL, black.flatten().tolist()),
            (WHITE_LEVEL, "I", 1, round(self.white_level), True),
        ]

    def _dng_tags(self) -> list[Tag]:
        height, width = self.mosaic.shape[-2:]
        tags: list[Tag] = [
            (DNG_VERSION, "B", 4, bytes((1, 4, 0, 0)), True),
            (DNG_BACKWARD_VERSION, "B", 4, bytes((1, 1, 0, 0)), True),
            _ascii(MAKE, "kcam"),
            _ascii(MODEL, self.camera),
            (ORIENTATION, "H", 1, 1, True),
            (ACTIVE_AREA, "I", 4, (0, 0, height, width), True),
            (DEFAULT_CROP_ORIGIN, "I", 2, (0, 0), True),
            (DEFAULT_CROP_SIZE, "I", 2, (width, height), True),
        ]
        if not self.pattern:
            return tags
        if self.neutral is None or self.colour_matrix is None:
            raise ValueError(
                "a DNG of colours needs the neutral and the colour matrix of the camera, and this raw lacks one. Use "
                "dataclasses.replace(raw, neutral=[0.6, 1.0, 0.8], colour_matrix=...), or write .tif."
            )
        return [
            *tags,
            (CFA_PLANE_COLOR, "B", 3, bytes((0, 1, 2)), True),
            (CFA_LAYOUT, "H", 1, 1, True),  # rectangular
            (CALIBRATION_ILLUMINANT, "H", 1, D65_LIGHT, True),
            _rational(FORWARD_MATRIX, self.forward_matrix.flatten().tolist(), signed=True),
            _ascii(PROFILE_NAME, "kcam"),  # without a curve of its own a converter would take one that flatters
            (PROFILE_TONE_CURVE, "f", 4, (0.0, 0.0, 1.0, 1.0), True),
            (DEFAULT_BLACK_RENDER, "I", 1, NO_BLACK_RENDER, True),
        ]

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
        read = _from_tiff if path.suffix.lower() in (".tif", ".tiff") else _from_libraw
        fields = read(path)
        try:
            return cls(**fields)
        except ValueError as error:
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


def _check_signal(raw: Any) -> None:
    """TypeError, ValueError unless it is one picture's raw signal, (1,1,H,W) in 0..1."""
    if not isinstance(raw, Tensor) or not raw.is_floating_point():
        raise TypeError(f"raw must be what camera.raw(scene) gives, a float tensor (1,1,H,W), got {describe(raw)}.")
    if raw.ndim == 4 and raw.shape[1] > 1:
        raise ValueError(
            f"raw has {raw.shape[1]} full planes, {tuple(raw.shape)}, and no mosaic, expected (1,1,H,W). Put "
            "sensor.Mosaic('RGGB') before the ADC, and use camera.raw(scene)."
        )
    if raw.ndim == 4 and len(raw) != 1:
        raise ValueError(
            f"raw is a batch of {len(raw)}, and a file holds one picture. Use [Raw.from_camera(camera, one[None]) for "
            "one in raw]."
        )
    if raw.ndim != 4 or raw.numel() == 0:
        raise ValueError(f"raw has shape {tuple(raw.shape)}, expected (1,1,H,W) of at least one pixel.")
    low, high = (float(end) for end in raw.detach().aminmax())
    if not (low >= 0 and high <= 1):
        odd = "NaN" if math.isnan(low) else f"{low if low < 0 else high:g}"
        raise ValueError(
            f"raw must be in 0..1, 1.0 = full scale, got {odd}. Use what camera.raw(scene) gives; numbers "
            "are divided by 2**bits - 1."
        )


def _pattern_of(camera: Camera, context: Context) -> str | None:
    """The name of the mosaic, None for a monochrome sensor; ValueError for what raw files cannot say."""
    if getattr(context.colour_filter, "is_tile", False):
        raise ValueError(
            "the camera's colour filter is a learned tile, whose pixels have curves of their own: raw files know named "
            "patterns only. Use ColourFilter.nikon() with sensor.Mosaic('RGGB')."
        )
    named = any("pattern" in stage.provides() for stage in camera if isinstance(stage, Stage))
    if not named and not any(isinstance(stage, Demosaic) for stage in camera):
        return None
    if context.pattern not in COLOURED:
        raise ValueError(
            f"pattern {context.pattern!r} has white pixels, for which raw files have no colours. Expected one of "
            f"{', '.join(COLOURED)}."
        )
    return context.pattern


def _colours(camera: Camera, context: Context, *, mono: bool, share: float) -> dict[str, Any]:
    """Neutral, colour matrix and baseline exposure that develop as the camera does.

    Args:      share: what of full scale lies above the black level.
    """
    channels = 1 if mono else 3
    gains = next((stage.gains for stage in camera if isinstance(stage, WhiteBalance)), None)
    matrix = next((stage.matrix for stage in camera if isinstance(stage, ColourMatrix)), None)
    gains = as_shot_gains(context, channels=channels) if gains is None else gains
    matrix = as_shot_colour_matrix(context, channels=channels) if matrix is None else matrix
    whole = (matrix.detach().double() * gains.detach().double().to(matrix.device)).cpu()  # channels to linear sRGB
    if mono:
        if not float(whole.mean()) > 0:
            raise ValueError(
                f"the colour matrix makes {float(whole.mean()):g} of a white; expected more than 0, such as 1."
            )
        return {"baseline_exposure": math.log2(float(whole.mean()) * share)}
    # What becomes gray: 1 / gains, if the matrix leaves white white.
    neutral, failed = torch.linalg.solve_ex(whole, torch.ones(3, dtype=torch.float64))
    if int(failed) or not bool((neutral > 0).all() & neutral.isfinite().all()):
        raise ValueError(
            f"with its gains and colour matrix no light becomes gray in this camera (channels {neutral.tolist()}), and "
            "a raw file must name its neutral. Give ColourMatrix rows that add up to one positive number."
        )
    brightness, neutral = 1 / float(neutral[1]), neutral / neutral[1]
    to_srgb = whole * neutral / brightness
    daylight = neutral
    if context.colour_filter is not None:
        curves = context.colour_filter
        daylight = curves.white(context.wavelengths).detach().double().cpu()
        daylight = daylight / daylight[1]
    colour_matrix = daylight[:, None] * torch.linalg.solve(to_srgb, spectral.xyz_to_srgb_matrix())
    return {
        "neutral": neutral,
        "colour_matrix": colour_matrix,
        "baseline_exposure": math.log2(brightness * share),
    }


def _gain(adc: ADC, context: Context) -> Tensor | float:
    return context.gain if adc.gain is None else adc.gain


def _noise_profile(
    camera: Camera, context: Context, adc: ADC, *, range_: float, size: Sequence[int]
) -> tuple[float, float] | None:
    """(S, O) of the variance S x + O of a signal with black at 0 and white at 1; None if a stage does not say it.

    Args:      range_: from black to white level [DN].
    """
    half = torch.full((1, 1, *size), 0.5, dtype=torch.float64)
    in_half = in_dark = 0.0
    for stage in camera:
        if stage is adc:
            break
        if isinstance(stage, RandomStage) and not isinstance(stage, FixedPattern):
            try:
                light, dark = (torch.as_tensor(stage.sigma(at, context)).detach() for at in (half, 0 * half))
            except NotImplementedError:
                return None
            in_half += float(light.double().square().mean())
            in_dark += float(dark.double().square().mean())
    scale = float(torch.as_tensor(_gain(adc, context)).detach()) * (2**adc.bits - 1) / range_
    step = 1 / range_ if adc.rounding else 0.0
    return scale * (in_half - in_dark) / 0.5, scale**2 * in_dark + step**2 / 12


def _ascii(code: int, text: str) -> Tag:
    plain = text.encode("ascii", "replace") + b"\0"
    return code, "s", len(plain), plain, True


def _rational(code: int, values: Sequence[float], *, signed: bool = False) -> Tag:
    """Numbers as fractions of 32 bits, as close as these come."""
    parts: list[int] = []
    for value in values:
        most = min(10**8, 2**31 // (math.ceil(abs(value)) + 1))
        fraction = Fraction(value).limit_denominator(max(1, most))
        if value and not fraction:  # shorter than any denominator in use
            fraction = Fraction(1, min(2**31 - 1, round(1 / abs(value)))) * (1 if value > 0 else -1)
        parts += [fraction.numerator, fraction.denominator]
    return code, "2i" if signed else "2I", len(values), tuple(parts), True


def _reals(value: Any) -> list[float]:
    """The numbers of a tag, one or many."""
    parts = list(value) if isinstance(value, (tuple, list)) else [value]
    return [float(part) for part in parts]


def _divided(value: Any) -> list[float]:
    """The numbers of a tag of fractions, which tifffile gives as numerators and denominators in turn."""
    parts = _reals(value)
    return [above / below for above, below in zip(parts[::2], parts[1::2], strict=True)]


def _said_by_tags(tags: dict[int, Any]) -> dict[str, Any]:
    """Fields that tags of DNG hold, and LibRaw does not give of cameras that it does not know."""
    fields: dict[str, Any] = {}
    if BASELINE_EXPOSURE in tags:
        fields["baseline_exposure"] = _reals(tags[BASELINE_EXPOSURE])[0]
    if NOISE_PROFILE in tags:
        pairs = _reals(tags[NOISE_PROFILE])  # one pair, or one per colour
        fields["noise_profile"] = tuple(float(np.mean(pairs[first::2])) for first in (0, 1))
    lights = {tags.get(CALIBRATION_ILLUMINANT + which): which for which in (0, 1) if COLOR_MATRIX + which in tags}
    if lights:  # that of daylight, else the second, which is the cooler light's
        which = lights.get(D65_LIGHT, max(lights.values()))
        numbers = _reals(tags[COLOR_MATRIX + which])
        if len(numbers) == 9:
            fields["colour_matrix"] = np.reshape(numbers, (3, 3))
    name = tags.get(UNIQUE_CAMERA_MODEL) or " ".join(str(tags[code]) for code in (MAKE, MODEL) if code in tags)
    return fields | ({"camera": str(name)} if name else {})


def _tags_of(page: Any) -> dict[int, Any]:
    """Tags of a page and of the pages inside of it, fractions as numbers; the first that has one."""
    found: dict[int, Any] = {}
    for each in (page, *(page.pages or ())):
        for tag in getattr(each, "tags", ()):
            found.setdefault(tag.code, _divided(tag.value) if tag.dtype in (RATIONAL, SRATIONAL) else tag.value)
    return found


def _from_tiff(path: Path) -> dict[str, Any]:
    """The fields of a TIFF by `Raw.write`, or of any of 16 bits with its levels in DNG's tags."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            page = file.pages.first
            words, tags = page.asarray(), _tags_of(page)
    except Exception as error:  # a damaged header makes tifffile raise anything
        raise ValueError(f"{path} is damaged, or no TIFF: {error}.") from error
    if words.dtype != np.uint16 or words.ndim != 2:
        refused = " 8 bits are refused for raw data." if words.dtype.itemsize == 1 else ""
        raise ValueError(
            f"{path} holds {words.dtype} of shape {words.shape}, expected one plane of 16 bits, uint16 (H,W).{refused}"
        )
    lacking = [name for name, code in (("BlackLevel", BLACK_LEVEL), ("WhiteLevel", WHITE_LEVEL)) if code not in tags]
    if lacking:
        raise ValueError(
            f"{path} is a picture without the tags {' and '.join(lacking)} of raw data. Use Raw(torch.from_numpy("
            f"tifffile.imread({path.name!r}))[None, None], pattern='RGGB', black_level=64, white_level=1023)."
        )
    tile = tuple(tags.get(CFA_REPEAT_PATTERN_DIM, (2, 2)))
    fields: dict[str, Any] = {
        "mosaic": torch.from_numpy(words.astype(np.float32))[None, None],
        "pattern": _named(tags[CFA_PATTERN], tile, path) if CFA_PATTERN in tags else None,
        "black_level": np.reshape(_reals(tags[BLACK_LEVEL]), tags.get(BLACK_LEVEL_REPEAT_DIM, (1, 1))),
        "white_level": _reals(tags[WHITE_LEVEL])[0],
    }
    if AS_SHOT_NEUTRAL in tags:
        fields["neutral"] = tags[AS_SHOT_NEUTRAL]
    exif = tags.get(EXIF, {})
    if "ExposureTime" in exif:
        fields["exposure_time"] = _divided(exif["ExposureTime"])[0]
    if "ISOSpeedRatings" in exif:
        fields["iso"] = float(exif["ISOSpeedRatings"])
    return fields | _said_by_tags(tags)


def _named(cells: Any, shape: Sequence[int], path: Path) -> str:
    """The name of a pattern in CFA tags."""
    tile = _tile(cells, shape).tolist()
    for name in COLOURED:
        if [list(row) for row in PATTERNS[name]] == tile:
            return name
    raise ValueError(f"{path} has the mosaic {tile}, which is none of {', '.join(COLOURED)}.")


def _from_libraw(path: Path) -> dict[str, Any]:
    try:
        import rawpy
    except ImportError as error:
        raise ImportError(f"{path} is read by LibRaw, which comes with the extra: pip install 'kcam[raw]'.") from error
    try:
        with rawpy.imread(str(path)) as file:
            tags = _tags_in(path)
            return _fields_of(file, path, tags) | _said_by_tags(tags)
    except (rawpy.LibRawError, rawpy.NotSupportedError) as error:
        reason = error.args[0].decode() if error.args and isinstance(error.args[0], bytes) else str(error)
        raise ValueError(
            f"{path} is damaged, or no raw file that LibRaw reads, of 22 x 22 pixels at least: {reason}."
        ) from error


def _tags_in(path: Path) -> dict[int, Any]:
    """Tags of a raw file; none for one that is not built on TIFF, or only for those who know it."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            return _tags_of(file.pages.first)
    except Exception:
        return {}


def _fields_of(file: Any, path: Path, tags: dict[int, Any]) -> dict[str, Any]:
    """The fields that LibRaw knows."""
    import rawpy

    if file.raw_type is not rawpy.RawType.Flat:
        raise ValueError(f"{path} holds full colours and no mosaic. Use Scene.from_file for a picture.")
    words = np.array(file.raw_image_visible)
    other = file.other
    fields: dict[str, Any] = {
        "white_level": file.white_level,
        "exposure_time": other.shutter_speed or None,
        "iso": other.iso_speed or None,
    }
    if file.num_colors == 1:
        return fields | {
            "mosaic": torch.from_numpy(words.astype(np.float32))[None, None],
            "pattern": None,
            "black_level": file.black_level_per_channel[0],
        }
    cells, letters = np.array(file.raw_colors_visible), file.color_desc.decode()
    if not set(letters) <= set("RGB"):
        raise ValueError(f"{path} has a mosaic of {letters}, expected red, green and blue.")
    channels = np.array(["RGB".index(letter) for letter in letters])[cells]
    shape = tuple(tags.get(CFA_REPEAT_PATTERN_DIM, (2, 2)))
    if shape not in LIBRAWS and not any(tags.get(ACTIVE_AREA, (0,))[:2]):
        cells = channels = _repeated(_tile(tags[CFA_PATTERN], shape), words.shape)
    name, top, left = _found(channels, path)
    words, cells = words[top:, left:], cells[top:, left:]
    rows, columns = len(PATTERNS[name]), len(PATTERNS[name][0])
    black = np.array(file.black_level_per_channel, dtype=float)[cells[:rows, :columns]]
    gains = np.array(file.camera_whitebalance[:3])
    gains = gains if (gains > 0).all() else np.array(file.daylight_whitebalance[:3])
    matrix = file.rgb_xyz_matrix[:3].astype(float)
    return fields | {
        "mosaic": torch.from_numpy(words.astype(np.float32))[None, None],
        "pattern": name,
        "black_level": float(black.flat[0]) if (black == black.flat[0]).all() else black,
        "neutral": gains[1] / gains if (gains > 0).all() else None,
        "colour_matrix": matrix if matrix.any() else None,
    }


def _tile(cells: Any, shape: Sequence[int]) -> np.ndarray:
    """The tile in CFA tags."""
    return np.frombuffer(bytes(cells), dtype=np.uint8).reshape(tuple(shape))


def _repeated(tile: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A tile over (H,W)."""
    return tile[np.arange(size[0])[:, None] % len(tile), np.arange(size[1]) % len(tile[0])]


def _found(channels: np.ndarray, path: Path) -> tuple[str, int, int]:
    """The pattern whose tile repeats over (H,W) channels, and the row and column where it begins."""
    for name in COLOURED:
        tile = np.array(PATTERNS[name])
        offsets = [(0, 0)] if tile.shape == (2, 2) else list(np.ndindex(*tile.shape))
        for top, left in offsets:
            if np.array_equal(_repeated(np.roll(tile, (top, left), (0, 1)), channels.shape), channels):
                return name, top, left
    raise ValueError(f"{path} has the mosaic {channels[:6, :6].tolist()}, which is none of {', '.join(COLOURED)}.")
