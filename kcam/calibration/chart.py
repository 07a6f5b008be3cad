"""A camera's colour from a picture of the chart of 24 patches: their raw values, the matrix to sRGB, its errors.

    minimise over M:   mean_k dE00(M s_k, t_k)^2    with   M (1,..,1)^T = (1,1,1)^T

s_k: the patches' white balanced raw, a perfect white = 1; t_k: their linear sRGB in daylight, as of `isp.ColourMatrix`.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor, nn

from kcam import isp, spectral
from kcam.inputs import check_floats
from kcam.sensor import channel_masks
from kcam.sensor.mosaic import CHANNELS
from kcam.units import as_numbers

ROWS, COLUMNS = 4, 6
_MIDDLE = 0.5  # of a patch's width: what is averaged
_FEWEST = 4  # pixels of a channel in a patch
_LEVEL = 1e-6  # relative: values at the converter's end
_SATURATED = 0.01  # share of a patch's pixels
_UNEVEN, _DARK = 0.2, 0.03  # spread in a patch: of its own mean, and of the brightest patch
_GRAYS = slice(18, 24)  # from white to black
_SMOOTH = 1e-3  # weight of the second differences of a sensitivity
_FOLDS = 6
_EPSILON = 1e-12


@dataclass(frozen=True)
class ChartPatches:
    """Raw of the 24 patches of a chart in a picture: `chart_patches`.

    values, standard_errors: (24, C) means and their errors, in the picture's unit. names: of the patches.

    Example:
    >>> colours = torch.rand(24, 3, generator=torch.Generator().manual_seed(0)).mul(0).add(0.5)
    >>> kcam.calibration.ChartPatches(colours, 0 * colours, spectral.colour_chart()[0]).names[18][:5]
    'white'
    """

    values: Tensor
    standard_errors: Tensor
    names: tuple[str, ...]


@dataclass(frozen=True)
class ColourFit:
    """A camera's colour in one light: `colour_matrix`.

    matrix: (3, C) from white balanced raw, in which a perfect white is 1, to linear sRGB; its rows add up to 1.
    gains: (C,) white balance, 1 in green. white: (C,) raw of a perfect white. delta_e: (24,) CIEDE2000 of each patch.
    unseen_delta_e: mean CIEDE2000 of patches that a fit to the others did not see. names: of the patches.

    Example:
    >>> _, wavelengths, reflectances = spectral.colour_chart()
    >>> light = spectral.illuminant("D65", wavelengths=wavelengths)
    >>> raw = (reflectances * light) @ spectral.sensitivity("nikon_5100", wavelengths=wavelengths).T
    >>> fit = kcam.calibration.colour_matrix(raw, illuminant="D65")
    >>> round(fit.mean, 1), [type(stage).__name__ for stage in fit.stages()]
    (0.8, ['WhiteBalance', 'ColourMatrix'])
    """

    matrix: Tensor
    gains: Tensor
    white: Tensor
    delta_e: Tensor
    unseen_delta_e: float
    names: tuple[str, ...]

    @property
    def mean(self) -> float:
        """Mean CIEDE2000 of the patches."""
        return float(self.delta_e.mean())

    @property
    def worst(self) -> float:
        """Largest CIEDE2000 of a patch."""
        return float(self.delta_e.max())

    def stages(self, *, white_share: float | None = None) -> list[nn.Module]:
        """White balance and colour matrix for a `Camera`.

        white_share: of full scale that a perfect white has in green, 0.8 behind an automatic `Exposure`; None for what
        it has in the chart's picture.
        """
        share = float(self.white[min(1, len(self.white) - 1)]) if white_share is None else white_share
        return [isp.WhiteBalance(self.gains), isp.ColourMatrix(self.matrix / share)]

    def __str__(self) -> str:
        lines = [f"delta E 2000: mean {self.mean:.2f}, worst {self.worst:.2f}, unseen {self.unseen_delta_e:.2f}"]
        lines += [f"{name:>22} {value:5.2f}" for name, value in zip(self.names, self.delta_e.tolist(), strict=True)]
        return "\n".join(lines)


def chart_patches(
    picture: Tensor, *, corners: Tensor | Any, pattern: str | None = None, saturation: float | None = None
) -> ChartPatches:
    """Mean raw of the 24 patches of a chart that lies in a picture at four corners.

    The corners' plane is mapped onto the grid of 6 x 4 patches (a homography); pixels in the middle half of each
    patch's width and height are averaged: of a mosaic, those of each channel, without a demosaic.

    Args:      picture: linear raw, black subtracted, (C,H,W) or (1,C,H,W); a mosaic (1,H,W) or (1,1,H,W) with pattern.
               corners: (4, 2) x and y [pixels] of the outer corners of the patches' grid, from that of the dark skin's
               patch (top left) over that of bluish green (top right) and black (bottom right) to white (bottom left);
               the middle of the first pixel is (0, 0).
               pattern: of the mosaic, as of `sensor.Mosaic`.
               saturation: value at which pixels clip; None: 1.0 if that is the highest, or else the highest value, if a
               patch has it in more of its pixels than other patches have their own highest values.
    Returns:   `ChartPatches`, (24, C), row by row.
    Raises:    TypeError, ValueError for another shape, NaN; corners outside, crossing or not convex; patches too small,
               saturated or uneven, by name; a chart upside down or mirrored.
    Source:    Hartley, Zisserman, Multiple View Geometry, 2nd ed., section 4.1 (the homography).

    Example:
    >>> colours = spectral.reflectances(torch.tensor([600.0, 540.0, 460.0]) * nm)  # (24, 3)
    >>> picture = colours.T.reshape(3, 4, 6).repeat_interleave(10, 1).repeat_interleave(10, 2)
    >>> found = kcam.calibration.chart_patches(picture, corners=[(0, 0), (59, 0), (59, 39), (0, 39)])
    >>> torch.allclose(found.values, colours)
    True
    """
    check_floats(picture, name="picture", takes="(C,H,W) of linear raw", channels=None)
    planes = picture.detach().double().cpu()
    if planes.ndim == 4 and len(planes) == 1:
        planes = planes[0]
    if planes.ndim != 3 or 0 in planes.shape:
        raise ValueError(f"picture has shape {tuple(picture.shape)}, expected (C,H,W), or (1,H,W) of a mosaic.")
    if not bool(planes.isfinite().all()):
        raise ValueError(f"picture has {int((~planes.isfinite()).sum())} values that are NaN or infinite.")
    height, width = planes.shape[-2:]
    recorded = torch.ones_like(planes, dtype=torch.bool)
    if pattern is not None:
        if len(planes) != 1:
            raise ValueError(f"a mosaic has one channel, got {len(planes)}: leave out pattern={pattern!r}.")
        recorded = channel_masks(pattern, height, width)
        planes = planes.expand(len(recorded), -1, -1)
    elif len(planes) == 1:
        raise ValueError("a picture of one channel is a mosaic: give its pattern, such as pattern='RGGB'.")
    names = spectral.colour_chart()[0]
    index, inside = _grid_cells(_checked_corners(corners, height, width), height, width)
    highest = float(planes.max())
    if saturation is None and highest == 1:
        saturation = 1.0
    means, errors, full, uneven, piled, at_top = [], [], [], [], [], []
    for patch in range(ROWS * COLUMNS):
        chosen = recorded & inside & (index == patch)
        counts = chosen.sum((1, 2))
        if int(counts.min()) < _FEWEST:
            raise ValueError(
                f"the middle of patch {names[patch]!r} holds {int(counts.min())} pixels of a channel, expected "
                f"{_FEWEST} or more. Take the chart from nearer, or correct the corners."
            )
        values = [plane[where] for plane, where in zip(planes, chosen, strict=True)]
        means.append(torch.stack([v.mean() for v in values]))
        spread = torch.stack([v.std() for v in values])
        errors.append(spread / counts.sqrt())
        uneven.append(spread)
        full.append(max(float((v >= (saturation or math.inf)).double().mean()) for v in values) > _SATURATED)
        at_top.append([float((v >= highest * (1 - _LEVEL)).double().mean()) for v in values])
        piled.append([float((v >= v.max() - _LEVEL * highest).double().mean()) for v in values])
    if saturation is None:  # black was taken off: more pixels at the end of the converter than other patches' have
        usual = torch.tensor(piled).median(0).values
        full = (torch.tensor(at_top) > 3 * usual + _SATURATED).any(1).tolist()
        saturation = highest
    if any(full):
        clipped = ", ".join(name for name, is_full in zip(names, full, strict=True) if is_full)
        raise ValueError(f"saturated patches: {clipped}, at {saturation:g} and above. Expose white at 0.8 or less.")
    found, spreads = torch.stack(means), torch.stack(uneven)
    wrong = (spreads > _UNEVEN * found.abs() + _DARK * found.amax(0)).any(1)
    if bool(wrong.any()):
        which = ", ".join(name for name, bad in zip(names, wrong.tolist(), strict=True) if bad)
        raise ValueError(
            f"uneven patches: {which}. The corners are not those of the grid of patches (x, y in pixels, from dark "
            "skin's over bluish green's and black's to white's), or something lies on the chart."
        )
    _check_order(found)
    return ChartPatches(found, torch.stack(errors), names)


def _checked_corners(corners: Any, height: int, width: int) -> Tensor:
    """(4, 2) float64, in a turn with the clock (y down)."""
    expected = "four corners (x, y) in pixels, such as [(10, 10), (300, 12), (298, 210), (8, 205)]"
    places = as_numbers(corners, name="corners", expected=expected).detach().cpu()
    if places.shape != (4, 2) or not bool(places.isfinite().all()):
        raise ValueError(f"corners must be {expected}, got shape {tuple(places.shape)}.")
    for x, y in places.tolist():
        if not (-1 <= x <= width and -1 <= y <= height):
            raise ValueError(f"corner ({x:g}, {y:g}) lies outside of the picture, {width} x {height} pixels (x, y).")
    sides = places.roll(-1, 0) - places
    after = sides.roll(-1, 0)
    turns = sides[:, 0] * after[:, 1] - sides[:, 1] * after[:, 0]
    if not bool((turns.sign() == turns[0].sign()).all()) or float(turns.abs().min()) < 1e-6:
        raise ValueError(
            f"corners {places.tolist()} do not enclose a convex four-sided field in their order: from dark skin's over "
            "bluish green's and black's to white's, without crossing."
        )
    return places


def _grid_cells(corners: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """The patch that each pixel lies in, row by row, and whether in its middle, (H, W)."""
    grid = torch.tensor([[0, 0], [COLUMNS, 0], [COLUMNS, ROWS], [0, ROWS]], dtype=torch.float64)
    lines = []
    for (x, y), (u, v) in zip(corners.tolist(), grid.tolist(), strict=True):
        lines += [[x, y, 1, 0, 0, 0, -u * x, -u * y, u], [0, 0, 0, x, y, 1, -v * x, -v * y, v]]
    system = torch.tensor(lines, dtype=torch.float64)
    a, b, c, d, e, f, g, h = torch.linalg.solve(system[:, :8], system[:, 8]).tolist()
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (height, width)), indexing="ij")
    scale = g * x + h * y + 1
    u, v = (a * x + b * y + c) / scale, (d * x + e * y + f) / scale
    within = (scale > 0) & (u >= 0) & (u < COLUMNS) & (v >= 0) & (v < ROWS)
    middle = ((u % 1 - 0.5).abs() <= _MIDDLE / 2) & ((v % 1 - 0.5).abs() <= _MIDDLE / 2)
    return (v.floor() * COLUMNS + u.floor()).long(), within & middle


def _check_order(patches: Tensor) -> None:
    """ValueError where the patches agree better with a chart that is turned or mirrored."""
    _, wavelengths, reflectances = spectral.colour_chart()
    light = reflectances @ spectral.xyz_weights(wavelengths, "D65")[:, 1]
    seen = patches[:, min(1, patches.shape[1] - 1)].clamp(min=0).sqrt().view(ROWS, COLUMNS)
    known = light.sqrt().view(ROWS, COLUMNS)
    ways = {
        "": seen,
        "upside down": seen.flip(0, 1),
        "mirrored": seen.flip(1),
        "mirrored and upside down": seen.flip(0),
    }
    alike = {way: float(torch.corrcoef(torch.stack([t.flatten(), known.flatten()]))[0, 1]) for way, t in ways.items()}
    best = max(alike, key=lambda way: alike[way])
    if best and alike[best] > alike[""] + 0.1:
        raise ValueError(
            f"the chart seems {best}: its patches agree with the known ones by {alike['']:.2f}, and by "
            f"{alike[best]:.2f} if they are turned back. Give them, or the corners, from dark skin's over bluish "
            "green's and black's to white's."
        )
    if not max(alike.values()) > 0.6:
        raise ValueError(
            f"these are not the 24 patches of the chart: their brightness agrees with the known one by {alike['']:.2f},"
            " expected 0.9. Order them row by row from dark skin, and subtract the black level."
        )


def colour_matrix(raw_patches: Tensor | ChartPatches, *, illuminant: str | Tensor) -> ColourFit:
    """White balance gains and the colour matrix of a camera, from its raw of the chart's 24 patches in a known light.

    The raw of a perfect white follows from the row of grays, as far as they are not gray by the smoothest sensitivities
    that see all patches so in this light. The matrix takes it to (1,1,1) and the patches as close as can be to their
    colours under D65 (the colour of a surface is what it is in daylight, as of `isp.ColourMatrix`, in whatever light it
    was taken): by least squares first, then in CIEDE2000.

    Args:      raw_patches: (24, C) linear, black subtracted, any exposure, row by row from dark skin; or what
               `chart_patches` gives.
               illuminant: of the chart, a name as of `spectral.illuminant`, or its power at 380, 390, .. 730 nm, (36,).
    Returns:   a `ColourFit`, float64.
    Raises:    TypeError, ValueError for another shape, NaN, negative means, or patches in another order. Warns where
               red and blue are swapped.
    Source:    Sharma, Wu, Dalal, Color Res. Appl. 30 (2005) 21 (CIEDE2000).

    Example:
    >>> _, wavelengths, reflectances = spectral.colour_chart()
    >>> light = spectral.illuminant("A", wavelengths=wavelengths)
    >>> raw = 0.01 * (reflectances * light) @ spectral.sensitivity("nikon_5100", wavelengths=wavelengths).T
    >>> red, green, blue = kcam.calibration.colour_matrix(raw, illuminant="A").gains
    >>> bool(blue > 2 * green)  # a filament is short of blue
    True
    """
    raw = _checked_patches(raw_patches)
    names, wavelengths, reflectances = spectral.colour_chart()
    light = spectral.illuminant(illuminant, wavelengths=wavelengths)
    white = _white(raw, reflectances * light, light)
    signals = raw / white
    colours = reflectances @ spectral.xyz_weights(wavelengths, "D65") @ spectral.xyz_to_srgb_matrix().T
    matrix = _refined(signals, colours)
    if bool(matrix[0, 2] > matrix[0, 0]) and bool(matrix[2, 0] > matrix[2, 2]):
        warnings.warn(
            "red comes mostly from the third channel and blue from the first: they are swapped, or the pattern is off "
            "by a row and a column, such as RGGB for BGGR. Flats cannot tell that; the matrix makes up for it here.",
            stacklevel=2,
        )
    squares = torch.arange(len(signals)) % _FOLDS
    unseen = []
    for fold in range(_FOLDS):
        own = _refined(signals[squares != fold], colours[squares != fold])
        unseen.append(delta_e(signals[squares == fold] @ own.T, colours[squares == fold]))
    return ColourFit(
        matrix,
        white[min(1, len(white) - 1)] / white,
        white,
        delta_e(signals @ matrix.T, colours),
        float(torch.cat(unseen).mean()),
        names,
    )


def _checked_patches(given: Tensor | ChartPatches) -> Tensor:
    expected = "(24, C) raw values of the chart's patches, C >= 3"
    values = as_numbers(
        given.values if isinstance(given, ChartPatches) else given, name="raw_patches", expected=expected
    )
    raw = values.detach().cpu()
    if raw.ndim != 2 or len(raw) != ROWS * COLUMNS or raw.shape[1] not in (3, len(CHANNELS)):
        fix = " Use raw_patches.T." if raw.ndim == 2 and raw.shape[1] == ROWS * COLUMNS else ""
        raise ValueError(f"raw_patches must be {expected}, got shape {tuple(raw.shape)}.{fix}")
    if not bool(raw.isfinite().all()):
        raise ValueError(f"raw_patches has {int((~raw.isfinite()).sum())} values that are NaN or infinite.")
    if float(raw.min()) < 0:
        raise ValueError(f"raw_patches must be >= 0, got {float(raw.min()):g}: was too much black subtracted?")
    if not float(raw.amax(0).min()) > 0:
        raise ValueError("a channel of raw_patches is 0 in all patches: it saw no light.")
    _check_order(raw)
    return raw


def _white(raw: Tensor, reflected: Tensor, light: Tensor) -> Tensor:
    """Raw of a perfect white, (C,), by the row of grays: raw over what they reflect of what each channel sees.

    Gray is not quite gray, so that share is weighted by the smoothest sensitivities s (L, C) >= 0 with reflected @ s
    = raw.
    """
    shared = reflected / light.sum()
    dark = torch.zeros(2, len(light), dtype=torch.float64)  # beyond the ends
    bend = torch.eye(len(light), dtype=torch.float64).diff(n=2, dim=0, prepend=dark, append=dark)
    system = torch.cat([shared, torch.sqrt(_SMOOTH * shared.square().sum() / len(light)) * bend])
    known = torch.cat([raw / raw.amax(0), raw.new_zeros(len(bend), raw.shape[1])])
    solved = [scipy.optimize.nnls(system.numpy(), column.numpy())[0] for column in known.T]
    curves = torch.from_numpy(np.stack(solved, axis=1))
    shares = (reflected @ curves / (light @ curves))[_GRAYS]
    return raw[_GRAYS].sum(0) / shares.sum(0)


def _refined(signals: Tensor, colours: Tensor) -> Tensor:
    """The matrix with the least mean square of CIEDE2000 that leaves white white, from that of least squares."""
    start = isp.fit_colour_matrix(signals, colours=colours)
    free = torch.zeros(3, start.shape[1] - 1, dtype=torch.float64, requires_grad=True)
    search = torch.optim.LBFGS([free], max_iter=100, tolerance_grad=1e-9, line_search_fn="strong_wolfe")

    def matrix() -> Tensor:
        return start + torch.cat([free, -free.sum(1, keepdim=True)], dim=1)

    def loss() -> Tensor:
        search.zero_grad()
        value = delta_e(signals @ matrix().T, colours).square().mean()
        value.backward()
        return value

    with torch.enable_grad():
        search.step(loss)  # type: ignore[arg-type]
    with torch.no_grad():
        better = matrix()
        ends = [float(delta_e(signals @ m.T, colours).square().mean()) for m in (better, start)]
    return better if ends[0] <= ends[1] else start


def _lab(colours: Tensor) -> Tensor:
    """CIE L*, a*, b* of linear sRGB (..., 3), a perfect white = (1,1,1)."""
    matrix = torch.linalg.inv(spectral.xyz_to_srgb_matrix()).to(colours)
    relative = (colours @ matrix.T) / matrix.sum(1)
    bend = 6 / 29
    root = relative.clamp(min=bend**3) ** (1 / 3)
    f = torch.where(relative > bend**3, root, relative / (3 * bend**2) + 4 / 29)
    x, y, z = f.unbind(-1)
    return torch.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], dim=-1)


def delta_e(colours: Tensor, other: Tensor) -> Tensor:
    """The difference of colours as it is seen, CIEDE2000, under D65: 1 is just noticed.

    Args:      colours, other: linear sRGB (..., 3), a perfect white (1,1,1); may leave [0,1].
    Returns:   (...), >= 0; its gradient is finite, also where both agree.
    Source:    Sharma, Wu, Dalal, Color Res. Appl. 30 (2005) 21.

    Example:
    >>> gray = torch.tensor([0.5, 0.5, 0.5], dtype=torch.float64)
    >>> round(float(kcam.calibration.delta_e(1.02 * gray, gray)), 2)  # a fiftieth of the light
    0.44
    """
    (l1, a1, b1), (l2, a2, b2) = (_lab(values).unbind(-1) for values in (colours, other))

    def length(*parts: Tensor) -> Tensor:
        return torch.sqrt(sum(part**2 for part in parts) + _EPSILON)  # type: ignore[arg-type]

    mean7 = ((length(a1, b1) + length(a2, b2)) / 2) ** 7
    stretch = 1 + 0.5 * (1 - torch.sqrt(mean7 / (mean7 + 25.0**7)))
    c1, c2 = length(stretch * a1, b1), length(stretch * a2, b2)
    h1, h2 = (
        torch.where(length(a, b) > 2e-6, torch.atan2(b, torch.where(length(a, b) > 2e-6, a, 1.0)), 0.0)
        for a, b in ((stretch * a1, b1), (stretch * a2, b2))
    )
    turn = torch.remainder(h2 - h1 + math.pi, 2 * math.pi) - math.pi
    hue = 2 * torch.sqrt(c1 * c2) * torch.sin(turn / 2)
    light, chroma, mean_hue = (l1 + l2) / 2, (c1 + c2) / 2, h1 + turn / 2
    weight = (
        1
        - 0.17 * torch.cos(mean_hue - math.radians(30))
        + 0.24 * torch.cos(2 * mean_hue)
        + 0.32 * torch.cos(3 * mean_hue + math.radians(6))
        - 0.20 * torch.cos(4 * mean_hue - math.radians(63))
    )
    degrees = torch.rad2deg(torch.remainder(mean_hue, 2 * math.pi))
    bend = math.radians(60) * torch.exp(-(((degrees - 275) / 25) ** 2))
    chroma7 = chroma**7
    rotation = -2 * torch.sqrt(chroma7 / (chroma7 + 25.0**7)) * torch.sin(bend)
    middle = (light - 50) ** 2
    by_light = (l2 - l1) / (1 + 0.015 * middle / torch.sqrt(20 + middle))
    by_chroma, by_hue = (c2 - c1) / (1 + 0.045 * chroma), hue / (1 + 0.015 * chroma * weight)
    total = by_light**2 + by_chroma**2 + by_hue**2 + rotation * by_chroma * by_hue
    return torch.sqrt(total.clamp(min=0) + _EPSILON)
