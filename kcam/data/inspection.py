"""Look at cubes before they are trained on: a contact sheet, spectra, bad bands and pixels, dynamic range."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcam import spectral
from kcam.data.cube import Source
from kcam.data.readers import Options, open_source
from kcam.isp import tone_curve
from kcam.units import nm

LOOKED_AT = 2**18  # pixels of a cube, at most: an even grid of whole rows and columns
_UNLIKE = 0.5  # correlation with the neighbouring bands below which a band is bad
_HOT = 12.0  # robust standard deviations from the bands beside it, at which a value is bad


@dataclass(frozen=True)
class Findings:
    """What is known of one cube.

    low, middle, high: 1st, 50th and 99th percentile of the values. top: the largest. stops: log2 of the 99.9th over
    the noise, or over the 0.1th percentile where there is no noise. negative, clipped, invalid: shares of the values,
    and pixels. noise: robust deviation from the neighbours' median, relative to the middle. bad_bands: places of bands
    that are constant or unlike their neighbours. bad_pixels: share of values unlike those of the bands beside them.
    spectrum: mean of each band.
    """

    name: str
    shape: tuple[int, int, int]
    wavelengths: tuple[float, ...]
    unit: str
    format: str
    low: float
    middle: float
    high: float
    top: float
    stops: float
    negative: float
    clipped: float
    invalid: float
    noise: float
    bad_bands: tuple[int, ...]
    bad_pixels: float
    extrapolated: tuple[int, ...]
    spectrum: tuple[float, ...]

    def remarks(self) -> list[str]:
        """What a person should know, in words."""
        found = []
        if self.bad_bands:
            places = ", ".join(f"{self.wavelengths[band] / nm:.0f}" for band in self.bad_bands)
            found.append(f"bad bands at {places} nm")
        if self.extrapolated:
            found.append(f"{len(self.extrapolated)} bands extrapolated")
        for share, what in ((self.invalid, "invalid pixels"), (self.negative, "negative"), (self.clipped, "clipped")):
            if share > 1e-3:
                found.append(f"{share:.2%} {what}")
        if self.bad_pixels > 1e-4:
            found.append(f"{self.bad_pixels:.2%} hot or dead values")
        return found


def inspect(
    path: Path, *, format: str | None = None, options: Options | None = None
) -> tuple[Findings, Tensor, np.ndarray]:
    """Findings of a cube, a thumbnail (3,h,w) sRGB, and five spectra (5,L): the percentiles 5, 25, 50, 75 and 95.

    Args:      format, options: as for `readers.open_source`.
    Raises:    CubeError, FileNotFoundError as `readers.read_cube`.
    """
    source = open_source(path, format=format, options=options)
    values, valid = _sample(source)
    bands = len(values)
    inside = values[:, valid] if valid.any() else values.reshape(bands, -1)
    percentiles = np.percentile(inside, (0.1, 1, 50, 99, 99.9))
    noise = _noise(values, valid)
    floor = max(noise, float(percentiles[0]), 1e-9)
    top = float(inside.max())
    findings = Findings(
        name=source.name,
        shape=source.shape,
        wavelengths=tuple(source.wavelengths.tolist()),
        unit=source.unit,
        format=str(source.facts.get("format", "kcam")),
        low=float(percentiles[1]),
        middle=float(percentiles[2]),
        high=float(percentiles[3]),
        top=top,
        stops=float(np.log2(max(float(percentiles[4]), floor) / floor)),
        negative=float((inside < 0).mean()),
        clipped=_clipped(inside, top),
        invalid=float(1 - valid.mean()),
        noise=noise / max(float(percentiles[2]), 1e-9),
        bad_bands=tuple(_bad_bands(inside)),
        bad_pixels=_hot(values, valid),
        extrapolated=() if source.extrapolated is None else tuple(np.flatnonzero(source.extrapolated).tolist()),
        spectrum=tuple(inside.mean(1).tolist()),
    )
    spectra = np.percentile(inside, (5, 25, 50, 75, 95), axis=1)
    return findings, thumbnail(values, source), spectra


def _sample(source: Source) -> tuple[np.ndarray, np.ndarray]:
    """A central block of whole pixels, and which are valid: neighbours stay neighbours."""
    _, height, width = source.shape
    rows = max(1, min(height, LOOKED_AT // width))
    first = (height - rows) // 2
    values, valid = source.checked_rows(first, first + rows)
    return values, np.ones(values.shape[1:], bool) if valid is None else valid


def _noise(values: np.ndarray, valid: np.ndarray) -> float:
    """Robust deviation of values from the median of their 3 x 3 neighbours: of the quietest half of the bands."""
    import cv2

    if min(values.shape[1:]) < 3 or not valid.any():
        return 0.0
    differences = [(plane - cv2.medianBlur(np.ascontiguousarray(plane), 3))[valid] for plane in values]
    return 1.4826 * float(np.median([np.median(np.abs(difference)) for difference in differences]))


def _clipped(values: np.ndarray, top: float) -> float:
    """Share of values at the top, if several bands share it: a flat white has a top of its own in each band."""
    full = values >= top
    return float(full.mean()) if full.any(1).sum() > 1 else 0.0


def _hot(values: np.ndarray, valid: np.ndarray) -> float:
    """Share of values far from the mean of the bands beside them, alone in their surroundings: hot and dead pixels."""
    import cv2

    if len(values) < 3 or min(values.shape[1:]) < 3 or not valid.any():
        return 0.0
    residual = values[1:-1] - (values[:-2] + values[2:]) / 2
    mean = np.abs(values[:, valid]).mean()
    size = np.pad(np.abs(residual), ((1, 1), (0, 0), (0, 0)))
    hot = 0
    for band, plane in enumerate(residual):
        alone = plane - cv2.medianBlur(np.ascontiguousarray(plane), 3)  # a steep spectrum is so in pixels around it too
        deviation = 1.4826 * np.median(np.abs(plane[valid] - np.median(plane[valid])))
        beside = np.maximum(np.abs(values[band + 1]), (np.abs(values[band]) + np.abs(values[band + 2])) / 2)
        found = np.minimum(size[band + 1], np.abs(alone)) > np.maximum(max(_HOT * deviation, 0.2 * mean), 0.5 * beside)
        found &= (size[band + 1] >= size[band]) & (size[band + 1] >= size[band + 2])  # its neighbours look half as bad
        hot += int(found[valid].sum())
    return hot / (len(residual) * int(valid.sum()))


def _bad_bands(values: np.ndarray) -> list[int]:
    """Bands that are constant while their neighbours are not, or hardly correlate with them."""
    spread = np.ptp(values, axis=1)  # a deviation of float32 is not 0 where all values are equal
    bad = []
    for band in range(len(values)):
        beside = [other for other in (band - 1, band + 1) if 0 <= other < len(values) and spread[other] > 0]
        flat = spread[band] == 0
        if beside and (flat or max(np.corrcoef(values[band], values[other])[0, 1] for other in beside) < _UNLIKE):
            bad.append(band)
    return bad


def thumbnail(values: np.ndarray, source: Source, *, side: int = 160) -> Tensor:
    """What a cube looks like: (3,h,w) sRGB in daylight, its bright parts near white."""
    grid = torch.from_numpy(np.asarray(source.wavelengths))
    bands = torch.from_numpy(values)
    step = max(1, max(bands.shape[1:]) // side)
    bands = bands[:, ::step, ::step].double()
    light = "D65" if source.unit == "reflectance" else "E"
    weights = spectral.xyz_weights(grid, light)
    colours = torch.einsum("lhw,lc->chw", bands, weights)
    linear = spectral.xyz_to_linear_srgb(colours)
    bright = torch.quantile(linear.flatten()[:: max(1, linear.numel() // 100_000)], 0.99).clamp(min=1e-9)
    return tone_curve((linear / bright).clamp(min=0)[None])[0].float()


def figures(found: list[tuple[Findings, Tensor, np.ndarray]]) -> dict[str, Any]:
    """Matplotlib figures by name: the contact sheet, and the spectra."""
    from matplotlib.figure import Figure

    columns = min(4, max(1, len(found)))
    rows = -(-len(found) // columns)
    sheet = Figure(figsize=(2.4 * columns + 0.3, 2.5 * rows + 0.4), layout="constrained")
    curves = Figure(figsize=(2.6 * columns + 0.3, 2.0 * rows + 0.3), layout="constrained")
    for place, (findings, picture, spectra) in enumerate(found):
        axes = sheet.add_subplot(rows, columns, place + 1)
        axes.imshow(picture.permute(1, 2, 0).clamp(0, 1).numpy())
        axes.set_axis_off()
        bands, height, width = findings.shape
        axes.set_title(f"{findings.name[:26]}\n{bands} x {height} x {width}", fontsize=7)
        axes = curves.add_subplot(rows, columns, place + 1)
        grid = np.asarray(findings.wavelengths) / nm
        axes.fill_between(grid, spectra[0], spectra[4], color="0.9", linewidth=0)
        axes.fill_between(grid, spectra[1], spectra[3], color="0.75", linewidth=0)
        axes.plot(grid, spectra[2], color="black", linewidth=1)
        for band in findings.bad_bands:
            axes.axvline(grid[band], color="tab:red", linewidth=0.8)
        for band in findings.extrapolated:
            axes.axvline(grid[band], color="tab:orange", linewidth=0.8, linestyle=":")
        axes.set_title(findings.name[:30], fontsize=7)
        axes.tick_params(labelsize=6)
        axes.set_ylim(bottom=min(0.0, float(spectra.min())))
    curves.supxlabel("wavelength [nm]; median, quartiles, 5 to 95 %; red: bad band, orange: extrapolated", fontsize=7)
    return {"contact_sheet": sheet, "spectra": curves}
