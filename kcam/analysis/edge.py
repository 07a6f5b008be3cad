"""The MTF from a picture of a slanted edge, as ISO 12233 asks (e-SFR)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

OVERSAMPLING = 4  # bins per pixel, ISO 12233
LEAST_SIDE = 16  # pixels
LEAST_ANGLE, MOST_ANGLE = 1.5, 40.0  # degrees from the rows or columns


@dataclass(frozen=True)
class EdgeResponse:
    """What a slanted edge tells: contrast over frequency across the edge.

    frequencies: (F,) float64 [cycles/pixel], from 0 to 1; the pixels' limit is 0.5.  mtf: (F,) float64, 1 at 0.
    angle: of the edge from the rows or columns it is closest to [degrees].  contrast: Michelson's, of the edge.
    pixel_pitch: [m], or None where it is not known.

    Example:
    >>> response = kcam.analysis.EdgeResponse(torch.tensor([0.0, 0.2, 0.4]), torch.tensor([1.0, 0.6, 0.4]), 5.0, 0.6)
    >>> round(response.mtf50, 3)  # cycles/pixel
    0.3
    """

    frequencies: Tensor
    mtf: Tensor
    angle: float
    contrast: float
    pixel_pitch: float | None = None

    @property
    def mtf50(self) -> float:
        """The lowest frequency at which the contrast falls to a half [cycles/pixel]; inf if it does not up to 1."""
        return self.frequency_at(0.5)

    @property
    def mtf50_per_metre(self) -> float:
        """`mtf50` on the sensor [cycles/m]; ValueError without a pixel pitch."""
        if self.pixel_pitch is None:
            raise ValueError("MTF50 per metre needs the pixel pitch: use slanted_edge_mtf(..., pixel_pitch=4e-6).")
        return self.mtf50 / self.pixel_pitch

    def frequency_at(self, contrast: float) -> float:
        """The lowest frequency at which the MTF falls to this contrast [cycles/pixel], inf if it does not."""
        below = torch.nonzero(self.mtf <= contrast)
        if not len(below):
            return math.inf
        last = max(int(below[0]), 1)
        (f0, f1), (m0, m1) = self.frequencies[last - 1 : last + 1].tolist(), self.mtf[last - 1 : last + 1].tolist()
        return f1 if m0 == m1 else f0 + (m0 - contrast) / (m0 - m1) * (f1 - f0)


def slanted_edge_mtf(
    picture: Tensor, *, pixel_pitch: float | None = None, limits: tuple[float, float] | None = None
) -> EdgeResponse:
    """The MTF of what took a picture of one slanted edge, from linear values.

    MTF(f) = |DFT(w LSF)| / (sinc(f / 2) sinc(f / 4)),   LSF: central difference of the edge in bins of 1/4 pixel

    The edge is found in each row by the centroid of the windowed derivative, and a line laid through; distances are
    taken across that line. The two sinc are those of the difference and of the bin.

    Args:      picture: (H,W), or (1,H,W) or (1,1,H,W), linear in the light, finite; one edge near a row or a column.
               pixel_pitch: [m].  limits: least and largest value that the camera gives, to refuse a clipped edge.
    Returns:   an `EdgeResponse`.
    Raises:    TypeError for no tensor; ValueError for a picture that is too small, not finite or clipped, without an
               edge, with two, or with one that is not slanted by 1.5 to 40 degrees.
    Valid when the edge is straight and its blur is narrower than a quarter of the picture.
    Source:    ISO 12233:2017, annex D; Burns, Slanted-edge MTF for digital camera analysis, PICS 2000.

    Example:
    >>> y, x = torch.meshgrid(*[torch.arange(80.0, dtype=torch.float64)] * 2, indexing="ij")
    >>> across = (x - 40 - 0.1 * (y - 40)) / math.hypot(1, 0.1)
    >>> edge = 0.5 + 0.3 * torch.erf(across / 2**0.5)  # a blur of 1 pixel: sqrt(ln 2 / 2) / pi = 0.187
    >>> round(kcam.analysis.slanted_edge_mtf(edge).mtf50, 3)
    0.187
    """
    image, angle_off = _checked(picture), (pixel_pitch is not None and not pixel_pitch > 0)
    if angle_off:
        raise ValueError(f"pixel_pitch must be above 0 m, got {pixel_pitch}. Use e.g. pixel_pitch=4e-6.")
    low, high = float(image.min()), float(image.max())
    if high - low <= 1e-6 * max(abs(high), abs(low)):
        raise ValueError(f"the picture has no edge: its values lie from {low:g} to {high:g}. Use one of contrast 4:1.")
    if limits is not None:
        at_limit = ((image <= limits[0]) | (image >= limits[1])).double().mean()
        if at_limit > 0.005:
            raise ValueError(
                f"the edge is clipped: {float(at_limit):.0%} of the picture lie at the limits {limits[0]:g} and "
                f"{limits[1]:g}. Expose so that it lies between, such as from 0.2 to 0.8."
            )
    across, down = ((image.diff(dim=dim).mean(1 - dim)).abs().sum() for dim in (1, 0))
    if down > across:
        image = image.T
    offset, slope = _line(image)
    angle = math.degrees(math.atan(abs(slope)))
    if not LEAST_ANGLE <= angle <= MOST_ANGLE:
        raise ValueError(
            f"the edge is slanted by {angle:.2f} degrees, expected {LEAST_ANGLE} to {MOST_ANGLE:g}: "
            "the rows would not sample it between the pixels. Turn it to 5 degrees."
        )
    rows = image.shape[0]
    turns = math.floor(rows * abs(slope))  # whole pixels only, so that all phases weigh the same
    if turns >= 1:
        image = image[: round(turns / abs(slope))]
    bins = _edge_spread(image, offset, slope)
    spread = bins[2:] - bins[:-2]  # the line spread
    _check_single(_coarse_steps(image, offset, slope))
    centre = float((spread.abs() ** 2 * torch.arange(len(spread))).sum() / (spread.abs() ** 2).sum())
    half = min(centre, len(spread) - 1 - centre)
    place = ((torch.arange(len(spread), dtype=torch.float64) - centre) / half).abs()
    window = torch.where(place <= 0.5, 1.0, 0.5 + 0.5 * torch.cos(2 * math.pi * (place - 0.5)))
    windowed = torch.where(place < 1, spread * window, 0.0)
    count = 16 * len(spread)
    spectrum = torch.fft.rfft(windowed, n=count).abs()
    frequencies = torch.arange(len(spectrum), dtype=torch.float64) * (OVERSAMPLING / count)
    kept = frequencies <= 1.0
    frequencies, spectrum = frequencies[kept], spectrum[kept]
    mtf = spectrum / spectrum[0] / (torch.sinc(2 * frequencies / OVERSAMPLING) * torch.sinc(frequencies / OVERSAMPLING))
    edges = bins[: OVERSAMPLING * 2].mean(), bins[-OVERSAMPLING * 2 :].mean()
    total = abs(float(edges[0] + edges[1]))
    contrast = abs(float(edges[1] - edges[0])) / total if total else math.inf
    return EdgeResponse(frequencies, mtf, angle, contrast, pixel_pitch)


def _checked(picture: Tensor) -> Tensor:
    if not isinstance(picture, Tensor):
        raise TypeError(f"picture must be a tensor (H,W), got {type(picture).__name__}. Use torch.as_tensor(picture).")
    shape = tuple(picture.shape)
    while picture.ndim > 2 and picture.shape[0] == 1:
        picture = picture[0]
    if picture.ndim != 2:
        raise ValueError(f"picture has shape {shape}, expected one plane (H,W). Use picture[0, 1] for green.")
    if min(picture.shape) < LEAST_SIDE:
        raise ValueError(f"picture has {shape[-2]} x {shape[-1]} pixels, an edge takes {LEAST_SIDE} x {LEAST_SIDE}.")
    image = picture.detach().double().cpu()
    if not bool(image.isfinite().all()):
        bad = int((~image.isfinite()).sum())
        raise ValueError(f"{bad} pixels of the picture are not finite. Cut them out, or use torch.nan_to_num.")
    return image


def _line(image: Tensor) -> tuple[float, float]:
    """Where the edge crosses row 0, and its slope [pixels per row]."""
    steps = image.diff(dim=1)
    steps = steps * torch.sign(steps.sum())
    columns = torch.arange(steps.shape[1], dtype=torch.float64) + 0.5
    rows = torch.arange(len(steps), dtype=torch.float64)
    smooth = torch.nn.functional.avg_pool1d(steps[:, None], 5, 1, 2, count_include_pad=False)[:, 0]
    places = columns[smooth.argmax(1)]
    offset, slope = _median_line(rows, places)
    for width in (1.0, 0.5, 0.5):  # of the picture, as the line gets better
        reach = max(width * image.shape[1] / 2, 6.0)
        where = (columns - (offset + slope * rows)[:, None]) / reach
        weight = torch.where(where.abs() < 1, 0.54 + 0.46 * torch.cos(math.pi * where), 0.0) * steps
        light = weight.sum(1)
        used = light > 0.2 * light.median().clamp(min=0)
        if int(used.sum()) < LEAST_SIDE // 2:
            raise ValueError("the picture has no edge that runs from side to side. Cut out a part with one edge.")
        found = (weight * columns).sum(1)[used] / light[used]
        slope, offset = _least_squares(rows[used], found)
    off = float((found - offset - slope * rows[used]).square().mean().sqrt())
    if off > max(1.0, 0.05 * image.shape[1]):
        raise ValueError(
            f"the picture has no straight edge: in its rows it lies {off:.1f} pixels off a line, expected below 1. "
            "Cut out a part with one edge, of less noise."
        )
    return offset, slope


def _median_line(rows: Tensor, places: Tensor) -> tuple[float, float]:
    """A line that few wrong rows do not turn (Theil and Sen)."""
    half = len(rows) // 2
    slope = float(((places[half : 2 * half] - places[:half]) / half).median())
    return float((places - slope * rows).median()), slope


def _least_squares(rows: Tensor, places: Tensor) -> tuple[float, float]:
    centred = rows - rows.mean()
    slope = float((centred * places).sum() / centred.square().sum())
    return slope, float(places.mean()) - slope * float(rows.mean())


def _edge_spread(image: Tensor, offset: float, slope: float) -> Tensor:
    """Means of the pixels in bins of 1/4 pixel across the edge; empty ones between their neighbours."""
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in image.shape)
    away = (columns - (offset + slope * rows)[:, None]) / math.hypot(1, slope)
    # only as far as every row goes, on both sides alike
    reach = min(float(-away[:, 0].max()), float(away[:, -1].min()))
    if reach < 5:
        raise ValueError(
            f"the edge comes within {max(reach, 0):.1f} pixels of the picture's side, expected 5 or more: cut out a "
            "wider part around it, or turn the edge less."
        )
    half = math.floor(reach * OVERSAMPLING)
    index = torch.floor(away * OVERSAMPLING + 0.5).long() + half
    inside = (index >= 0) & (index <= 2 * half)
    count = torch.bincount(index[inside], minlength=2 * half + 1).double()
    total = torch.bincount(index[inside], weights=image[inside], minlength=2 * half + 1)
    places = torch.bincount(index[inside], weights=away[inside], minlength=2 * half + 1)
    known = torch.nonzero(count).flatten()
    means = total[known] / count[known]
    off = places[known] / count[known] - (known - half) / OVERSAMPLING  # pixels do not lie evenly in their bin
    if len(known) > 2:
        means = means - off * torch.gradient(means, spacing=(known.double() / OVERSAMPLING,))[0]
    if len(known) == len(count):
        return means
    wanted = torch.arange(len(count))
    right = torch.searchsorted(known, wanted).clamp(1, len(known) - 1)
    share = ((wanted - known[right - 1]) / (known[right] - known[right - 1])).clamp(0, 1)
    return means[right - 1] + share * (means[right] - means[right - 1])


def _coarse_steps(image: Tensor, offset: float, slope: float) -> Tensor:
    """Steps between bins of two pixels across the edge, over all of the picture that half of the rows reach."""
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in image.shape)
    index = torch.floor((columns - (offset + slope * rows)[:, None]) / 2).long()
    index = (index - index.min()).flatten()
    count = torch.bincount(index).double()
    means = torch.bincount(index, weights=image.flatten()) / count.clamp(min=1)
    return means[count >= len(rows)].diff()


def _check_single(steps: Tensor) -> None:
    """ValueError for a second edge, of either sign, or for noise alone."""
    steps = steps * torch.sign(steps[steps.abs().argmax()])
    peak = int(steps.argmax())
    for values in (steps[peak + 1 :], steps[:peak].flip(0)):
        if not len(values):
            continue
        lowest = torch.cummin(values, 0).values
        again = ((values > 0.3 * steps[peak]) & (lowest < 0.5 * values)) | (values < -0.4 * steps[peak])
        if bool(again.any()):
            raise ValueError(
                f"the picture has a second edge, {2 * int(torch.nonzero(again)[0]) + 2} pixels from the first, or more "
                "noise than edge: cut out one."
            )
