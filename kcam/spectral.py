"""Light, reflectance, sensitivity and colour over wavelength.

A spectrum is a vector over the bands at hand, `wavelengths` (L,) [m], in any order and at any distances. The tables
(`kcam/tables`, written by `tools/make_tables.py` from colour-science) are resampled to it in float64 on the CPU.

**Light is relative**: the spectrum E of the light on a perfect white is scaled so that the white has Y = 1. A band's
radiance is reflectance times E, so its colour needs no further mention of the light: see `spectrum_to_xyz`.

**Bands are samples of a curve.** Between them, reflectance and radiance are interpolated by cubics, and beyond the
outermost bands held constant; colours are integrals of that curve at steps of 1 nm. Lamps have lines far narrower than
a band, so E is the lamp's average over each band, not its value at one wavelength.
"""

from __future__ import annotations

import functools
import itertools
import math
import os
import warnings
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcam.units import WAVELENGTH_RANGE, check_flag, nm, wavelength_grid

SINGLE_BAND_WIDTH = 10 * nm
"""Width of a band that has no neighbour to reach half-way to."""

SENSITIVITIES = ("kodak", "nikon_5100", "sigma_sd_merrill")
"""The cameras that `sensitivity` knows."""

Grid = tuple[float, ...]  # wavelengths in nm, the key of the caches below


class SpectralTable(NamedTuple):
    """Columns over wavelength, as `read_csv` found them: wavelengths (L,) rising [m], values (C, L), names of columns.

    Example:
    >>> table = spectral.SpectralTable(torch.tensor([400.0, 500.0]) * nm, torch.tensor([[0.0, 1.0]]), ("white",))
    >>> table.at(torch.tensor([425.0, 600.0]) * nm)  # linear between, 0 outside
    tensor([[0.2500, 0.0000]], dtype=torch.float64)
    """

    wavelengths: Tensor
    values: Tensor
    names: tuple[str, ...]

    def at(self, wavelengths: Tensor) -> Tensor:
        """The columns at other wavelengths (N,) [m]: (C, N) float64, linear between and 0 outside of the table."""
        return self.values.double() @ interpolation(rising(self.wavelengths), wavelengths)


def read_csv(path: str | os.PathLike[str], *, percent: bool = False) -> SpectralTable:
    r"""Read curves over wavelength: a header line, the first column in nanometres, then a column for each curve.

    Columns are parted by commas, semicolons or tabs; empty lines and those that begin with # are passed over. What a
    column means is for whom it is given to: `illuminant`, `sensor.Transmission`, `sensor.ColourFilter.from_curves`.

    Args:      percent: whether values are percent; they are divided by 100. A UserWarning says so where none is above 1
               and no header speaks of percent.
    Returns:   wavelengths (L,) rising float64 [m], values (C, L) float64, the names of the columns.
    Raises:    ValueError that names the file and the line: without a header or numbers, with rows of unequal length,
               wavelengths that are no nanometres (micrometres, metres, angstroms) or come twice, values that are no
               number, not finite or negative, or a header that says percent where `percent` does not;
               FileNotFoundError.

    Example:
    >>> from pathlib import Path
    >>> written = Path("led.csv").write_text("nm, power\n440, 0\n450, 1.0\n470, 0\n")
    >>> table = spectral.read_csv("led.csv")
    >>> (table.wavelengths / nm).round().tolist(), table.values.tolist(), table.names
    ([440.0, 450.0, 470.0], [[0.0, 1.0, 0.0]], ('power',))
    """
    check_flag(percent, name="percent")
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}. Expected a table of spectra, .csv.")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is no text ({error}). Expected a table of spectra: save it as CSV, UTF-8.") from None
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1)]
    lines = [(number, line) for number, line in lines if line.strip(",;\t ") and not line.startswith("#")]
    if len(lines) < 3:
        raise ValueError(f"{path} has {max(0, len(lines) - 1)} rows behind its header: expected two or more.")
    (first, header), *rows = lines
    mark = next((mark for mark in ";\t" if mark in header), ",")
    names = [name.strip().strip('"') for name in header.split(mark)]
    if len(names) < 2 or _is_number(names[0]):
        raise ValueError(f"{path}, line {first}: expected a header such as nm, red, green, blue; got {header[:60]!r}.")
    said = [name for name in names[1:] if "%" in name or "percent" in name.lower()]
    if said and not percent:
        raise ValueError(f"{path}, line {first}: column {said[0]!r} is in percent. Say so: percent=True.")
    numbers = [_row(path, number, line.split(mark), names) for number, line in rows]
    table = torch.tensor(numbers, dtype=torch.float64)
    if table[0, 0] > table[-1, 0]:
        table, rows = table.flip(0), rows[::-1]
    _check_nanometres(path, [number for number, _ in rows], table[:, 0].tolist(), names[0])
    values = table[:, 1:].T.contiguous()
    if percent and not said and 0 < values.max() <= 1:
        warnings.warn(
            f"{path}: the highest value is {values.max():g}, and percent=True divides it by 100. If these are shares, "
            "0..1, leave percent=True off; if they are percent, write % into the header.",
            stacklevel=3,
        )
    return SpectralTable(table[:, 0] * nm, values / 100 if percent else values, tuple(names[1:]))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _row(path: Path, number: int, cells: list[str], names: list[str]) -> list[float]:
    """The numbers of a line."""
    if len(cells) != len(names):
        raise ValueError(
            f"{path}, line {number}: {len(cells)} columns, and the header has {len(names)} ({', '.join(names)})."
        )
    found = []
    for name, cell in zip(names, cells, strict=True):
        cell = cell.strip().strip('"')
        if not _is_number(cell):
            comma = f" Write {cell.replace(',', '.')} for it." if _is_number(cell.replace(",", ".")) else ""
            raise ValueError(f"{path}, line {number}: {name} {cell!r} is no number.{comma}")
        value = float(cell)
        if not 0 <= value < math.inf:
            fix = "Measured noise below 0 is no light: write 0." if value < 0 else "Leave the line out."
            raise ValueError(f"{path}, line {number}: {name} must be finite and >= 0, got {value:g}. {fix}")
        found.append(value)
    return found


def _check_nanometres(path: Path, lines: list[int], wavelengths: list[float], name: str) -> None:
    """ValueError unless wavelengths rise, and are nanometres."""
    low, high = (end / nm for end in WAVELENGTH_RANGE)
    for number, value in zip(lines, wavelengths, strict=True):
        if not low <= value <= high:
            unit = "micrometres: multiply by 1000" if low / 1e3 <= value <= high / 1e3 else "metres: multiply by 1e9"
            meant = f" They look like {unit}." if 0 < value < low else ""
            raise ValueError(
                f"{path}, line {number}: {name} {value:g} is outside {low:g}..{high:g} nm. The first column is in "
                f"nanometres.{meant}"
            )
    if wavelengths[0] >= 2500 and wavelengths[-1] >= 3500:  # silicon ends at 1100 nm, InGaAs at 2600 nm
        raise ValueError(
            f"{path}, line {lines[0]}: {name} from {wavelengths[0]:g} to {wavelengths[-1]:g} nm is beyond what any "
            "silicon sees. They look like angstroms: divide by 10."
        )
    for (before, after), number in zip(itertools.pairwise(wavelengths), lines[1:], strict=True):
        if after <= before:
            raise ValueError(
                f"{path}, line {number}: {name} {after:g} nm does not follow {before:g} nm. Sort the lines."
            )


def rising(wavelengths: Tensor, *, either_way: bool = False) -> Tensor:
    """Wavelengths of a table as float64 on the CPU, (L,) strictly rising, L >= 2; either_way: or falling, then turned.

    Raises:    ValueError for others, or out of range.

    Example:
    >>> (spectral.rising(torch.tensor([500.0, 400.0]) * nm, either_way=True) / nm).round().tolist()
    [400.0, 500.0]
    """
    grid = wavelength_grid(wavelengths)
    if len(grid) > 1 and either_way and grid[0] > grid[-1]:
        grid = grid.flip(0)
    if len(grid) < 2 or not (grid.diff() > 0).all():
        shown = ", ".join(f"{value / nm:g}" for value in grid[:5].tolist())
        raise ValueError(f"a table needs two or more wavelengths that rise, got {shown}{', ...' * (len(grid) > 5)} nm.")
    return grid


def interpolation(nodes: Tensor, points: Tensor) -> Tensor:
    """Weights (L, N) that interpolate a table linearly: values (C, L) @ weights. 0 outside of the table.

    Args:      nodes: (L,) rising.  points: (N,).

    Example:
    >>> spectral.interpolation(torch.tensor([0.0, 1.0, 3.0]), torch.tensor([0.5, 2.0, 4.0])).tolist()
    [[0.5, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, 0.5, 0.0]]
    """
    nodes, points = nodes.double().to(points.device), points.double()
    after = torch.searchsorted(nodes, points, right=True).clamp(1, len(nodes) - 1)
    share = (points - nodes[after - 1]) / (nodes[after] - nodes[after - 1])
    share, rest = (torch.where((points >= nodes[0]) & (points <= nodes[-1]), part, 0.0) for part in (share, 1 - share))
    weights = points.new_zeros(len(nodes), len(points))
    columns = torch.arange(len(points), device=points.device)
    weights[after - 1, columns], weights[after, columns] = rest, share
    return weights


def illuminant(light: str | Tensor | SpectralTable, *, wavelengths: Tensor) -> Tensor:
    """The spectrum of the light on a perfect white, per band, relative: the white has Y = 1.

    E_l = average of the lamp over the triangle between band l's neighbours, then adjusted by the smallest relative
    amount that gives the lamp's own white point on these bands: by at most 0.04 % for D65, 2 % for a sodium lamp, with
    the 28 default bands. (Samples at the bands would make the white of a fluorescent tube wrong by 7 delta-E2000, of
    the sodium lamp by 14.) No band changes by more than 90 %; more is wanted only where bands miss much of the light.

    Args:      light: a name in `illuminant_names()`, CIE's; a lamp that was measured, a table of one column such as
               `read_csv` gives, dark outside of it; or a relative power per band (L,), which is only scaled.
               wavelengths: (L,) [m].
    Returns:   (L,) float64; all ones for "E", equal energy.
    Raises:    ValueError for an unknown name, or a power that is negative, not finite, all zero or of another length;
               TypeError for neither a name nor a tensor.
    Source:    CIE 15 tables in steps of 5 nm, linear between; constant beyond their ends, as in ASTM E308.

    Example:
    >>> wavelengths = kcam.units.wavelength_grid()
    >>> red, blue = (spectral.illuminant("A", wavelengths=wavelengths)[band] for band in (-1, 0))
    >>> round(float(red / blue))  # a filament is mostly red
    10
    """
    grid = _grid(wavelengths)
    if isinstance(light, str):
        return torch.tensor(_lamp(light, grid))
    if isinstance(light, SpectralTable):
        return torch.tensor(_on_bands(*_measured_at_1nm(light, grid), grid))
    if not isinstance(light, Tensor):
        raise TypeError(
            f"illuminant must be a name such as 'D65', a tensor (L,) or a table of spectral.read_csv, got "
            f"{type(light).__name__}."
        )
    power = light.detach().double().cpu()
    if power.shape != (len(grid),):
        raise ValueError(f"illuminant has shape {tuple(power.shape)}, expected one value per band: ({len(grid)},).")
    if not (power.isfinite().all() and (power >= 0).all() and power.any()):
        raise ValueError(f"illuminant must be finite, >= 0 and not all zero, got {power.min():g} to {power.max():g}.")
    return power / (torch.tensor(_colour_matching(grid))[:, 1] @ power)


def illuminant_names() -> tuple[str, ...]:
    """The lights that `illuminant` knows by name.

    Example:
    >>> "D65" in spectral.illuminant_names(), len(spectral.illuminant_names())
    (True, 14)
    """
    return tuple(_table("illuminants")["names"].tolist())


def observer(wavelengths: Tensor) -> Tensor:
    """The CIE 1931 2 degree colour matching functions xbar, ybar, zbar at the given wavelengths.

    Args:      wavelengths: (L,) [m].
    Returns:   (L, 3) float64, linear between the table's steps of 1 nm, 0 outside 360..830 nm.

    Example:
    >>> wavelengths = torch.arange(500, 601).double() * nm
    >>> round(float(wavelengths[spectral.observer(wavelengths)[:, 1].argmax()]) / nm)  # the eye sees green best
    555
    """
    table = _table("observer")
    points = np.array(_grid(wavelengths))
    curves = [np.interp(points, table["wavelengths"], curve, left=0, right=0) for curve in table["values"].T]
    return torch.tensor(np.stack(curves, axis=1))


def band_widths(wavelengths: Tensor) -> Tensor:
    """How much of the spectrum each band stands for: sum(values * widths) approximates an integral over wavelength.

    A band reaches half-way to its neighbours; the outermost ones reach as far outwards as inwards.

    Args:      wavelengths: (L,) [m], in any order.
    Returns:   (L,) float64 [m], in the same order; 10 nm for a single band.

    Example:
    >>> (spectral.band_widths(torch.tensor([500.0, 510.0, 530.0]) * nm) / nm).round().tolist()  # nm
    [10.0, 15.0, 20.0]
    """
    grid = np.array(_grid(wavelengths)) * nm
    if len(grid) == 1:
        return torch.tensor([SINGLE_BAND_WIDTH], dtype=torch.float64)
    order = np.argsort(grid)
    gaps = np.diff(grid[order])
    widths = np.empty_like(grid)
    widths[order] = (np.append(gaps[0], gaps) + np.append(gaps, gaps[-1])) / 2
    return torch.tensor(widths)


def xyz_weights(wavelengths: Tensor, light: str | Tensor = "E") -> Tensor:
    """Weights that turn reflectances under a light into CIE XYZ: xyz = reflectances @ weights.

    W_lc = E_l * INT phi_l(lambda) xyzbar_c(lambda) d lambda / INT ybar d lambda,   phi_l: cubic through band l alone

    so a perfect white gets sum_l W_l, the light's white point with Y = 1. With the default, equal energy (E_l = 1), the
    weights apply to radiance.

    Args:      wavelengths: (L,) [m].  light: as in `illuminant`.
    Returns:   (L, 3) float64.
    Valid when the bands cover 420..680 nm in steps of some 15 nm. The 24 patches, against integration at 1 nm:
               delta-E2000 under D65 is 0.07 in the mean and 0.46 at most for the 28 default bands (they lack the ends
               of the spectrum), 0.01 and 0.03 for 400..700 nm in steps of 10 nm, 0.11 and 0.39 for 14 bands.
    Source:    Lagrange interpolation as in ASTM E2022, ends as in ASTM E308, but for bands at any distances.

    Example:
    >>> weights = spectral.xyz_weights(kcam.units.wavelength_grid(), "D65")
    >>> x, y, z = weights.sum(0)  # XYZ of a perfect white
    >>> round(float(x / (x + y + z)), 4), round(float(y / (x + y + z)), 4)  # D65: 0.3127, 0.3290
    (0.3127, 0.329)
    """
    return torch.tensor(_colour_matching(_grid(wavelengths))) * illuminant(light, wavelengths=wavelengths)[:, None]


def spectrum_to_xyz(bands: Tensor, *, wavelengths: Tensor) -> Tensor:
    """The colour of relative radiance, in CIE XYZ where the perfect white under the scene's light has Y = 1.

    Args:      bands: (..., L, H, W) relative radiance.  wavelengths: (L,) [m].
    Returns:   (..., 3, H, W).
    Raises:    ValueError if L differs.

    Example:
    >>> wavelengths = kcam.units.wavelength_grid()
    >>> white = spectral.illuminant("D65", wavelengths=wavelengths)[:, None, None]
    >>> [round(float(value), 3) for value in spectral.spectrum_to_xyz(white, wavelengths=wavelengths).flatten()]
    [0.95, 1.0, 1.089]
    """
    weights = xyz_weights(wavelengths).to(bands)
    if bands.ndim < 3 or bands.shape[-3] != len(weights):
        raise ValueError(
            f"bands have shape {tuple(bands.shape)}, expected (..., {len(weights)}, H, W): one plane per wavelength."
        )
    return torch.einsum("...lhw,lc->...chw", bands, weights)


@functools.cache
def _xyz_to_srgb() -> np.ndarray:
    table, lamp = _table("observer"), _lamp_at_1nm("D65")
    white = table["values"].T @ lamp / (table["values"][:, 1] @ lamp)
    x, y = np.array([[0.64, 0.30, 0.15], [0.33, 0.60, 0.06]])
    primaries = np.stack([x / y, np.ones(3), (1 - x - y) / y])
    return np.linalg.inv(primaries * np.linalg.solve(primaries, white))


def xyz_to_srgb_matrix() -> Tensor:
    """The matrix from XYZ to linear sRGB, (3, 3) float64: its primaries, and its white at exactly our D65.

    Rounded matrices (IEC 61966-2-1, Kornia) differ by up to 4e-4 and tint a perfect white; this one gives 1, 1, 1.

    Example:
    >>> white = spectral.xyz_weights(kcam.units.wavelength_grid(), "D65").sum(0)
    >>> torch.allclose(spectral.xyz_to_srgb_matrix() @ white, torch.ones(3).double(), atol=1e-6)
    True
    """
    return torch.tensor(_xyz_to_srgb())


def xyz_to_linear_srgb(xyz: Tensor) -> Tensor:
    """Linear sRGB from XYZ, (..., 3, H, W); not clipped, and not adapted to another white than D65.

    Example:
    >>> xyz = torch.tensor([0.4124, 0.2126, 0.0193])[:, None, None]  # the red primary
    >>> [round(float(value), 2) + 0.0 for value in spectral.xyz_to_linear_srgb(xyz).flatten()]
    [1.0, 0.0, 0.0]
    """
    return torch.einsum("rc,...chw->...rhw", xyz_to_srgb_matrix().to(xyz), xyz)


def adaptation(white: Tensor, target: Tensor) -> Tensor:
    """Bradford's matrix from colours under one white to those under another, XYZ to XYZ, (3, 3) float64.

    Args:      white, target: XYZ of the two whites, (3,).
    Source:    ICC.1:2022, annex E; as in the DNG specification.

    Example:
    >>> d50, d65 = torch.tensor([0.9642, 1.0, 0.8249]), torch.tensor([0.9505, 1.0, 1.089])
    >>> torch.allclose(spectral.adaptation(d50, d65) @ d50.double(), d65.double())
    True
    """
    rows = [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
    cones = torch.tensor(rows, dtype=torch.float64)
    change = (cones @ target.double()) / (cones @ white.double())
    return torch.linalg.inv(cones) @ (change[:, None] * cones)


def rgb_basis(wavelengths: Tensor) -> Tensor:
    """Three reflectance spectra that a linear sRGB colour mixes: reflectance = rgb @ basis.

    B = inv(M A) M,   M: Mallett's basis, averaged over the bands,  A: reflectance to linear sRGB under D65, (L, 3)

    The factor inv(M A) makes the way back exact: B A = 1. All values are between 0 and 1 and the rows add up to 1, so
    a colour in [0,1] is a possible reflectance, and white is 1 in every band. Where B would leave [0,1], it is the one
    nearest to M that does not and has B A = 1; where there is none such, the one with the least error.

    Args:      wavelengths: (L,) [m].
    Returns:   (3, L) float64.
    Valid when there is such a B: with 11 or more even bands over 420..720 nm, or uneven ones without gaps in which a
               primary would fall. `rgb_error` states what is lost elsewhere. Below 3 bands it is M itself.
    Source:    Mallett, Yuksel, Spectral Primary Decomposition for Rendering with sRGB Reflectance, EGSR 2019.

    Example:
    >>> basis = spectral.rgb_basis(kcam.units.wavelength_grid())
    >>> torch.allclose(basis.sum(0), torch.ones(28).double()), bool((basis >= 0).all())  # white is 1 everywhere
    (True, True)
    """
    return torch.tensor(_rgb_basis(_grid(wavelengths)))


def rgb_error(wavelengths: Tensor) -> float:
    """By how much sRGB colours come back changed from `rgb_basis` under D65: the most of any, over a grid of 9^3.

    Args:      wavelengths: (L,) [m].
    Returns:   of coded sRGB, 0..1: some 1e-14 where the bands carry the colours, 0.1 for 10 even bands, 0.4 for 6.

    Example:
    >>> [spectral.rgb_error(kcam.units.wavelength_grid(count=count)) > 0.01 for count in (28, 6)]
    [False, True]
    """
    return _rgb_error(_grid(wavelengths))


def colour_chart() -> tuple[tuple[str, ...], Tensor, Tensor]:
    """The 24 patches of the ColorChecker as measured: names, wavelengths (36,) [m], reflectances (24, 36).

    Row by row, dark skin first. Source: BabelColor, average of 30 charts, through colour-science.

    Example:
    >>> names, wavelengths, values = spectral.colour_chart()
    >>> len(names), names[0], tuple(values.shape)
    (24, 'dark skin', (24, 36))
    """
    table = _table("colour_chart")
    return tuple(table["names"].tolist()), torch.tensor(table["wavelengths"]) * nm, torch.tensor(table["values"])


def reflectances(wavelengths: Tensor) -> Tensor:
    """The 24 patches' reflectances at the given wavelengths, (24, L) float64.

    Cubic between the measurements, which are 10 nm apart; constant beyond 380..730 nm.

    Example:
    >>> red = spectral.colour_chart()[0].index("red")
    >>> [round(float(share), 2) for share in spectral.reflectances(torch.tensor([450.0, 650.0]) * nm)[red]]
    [0.05, 0.68]
    """
    table = _table("colour_chart")
    return torch.tensor(table["values"] @ _interpolation(table["wavelengths"], np.array(_grid(wavelengths))))


def sensitivity(name: str, *, wavelengths: Tensor) -> Tensor:
    """Spectral sensitivities of a camera's red, green and blue pixels, per unit of energy.

    Args:      name: "nikon_5100" and "sigma_sd_merrill", measured with their infrared cut, each channel peaking at 1;
               or "kodak", a smooth approximation without infrared cut, not a measurement: sums of Gaussians whose peak
               places and heights are those of Kodak's interline CCD data sheets (see tools/make_tables.py).
               wavelengths: (L,) [m].
    Returns:   (3, L) float64, green peaking at 1; linear between the steps of the table (5 or 10 nm), 0 outside it.
    Raises:    ValueError for an unknown name.
    Source:    Darrodi et al., Reference data set for camera spectral sensitivity estimation, JOSA A 32 (2015) 381.

    Example:
    >>> wavelengths = torch.arange(400, 701, 10).double() * nm
    >>> curves = spectral.sensitivity("nikon_5100", wavelengths=wavelengths)
    >>> (wavelengths[curves.argmax(1)] / nm).round().tolist()  # red, green, blue
    [590.0, 530.0, 460.0]
    """
    if name not in SENSITIVITIES:
        raise ValueError(f"unknown sensitivity {name!r}. There are: {', '.join(SENSITIVITIES)}.")
    table, points = _table(f"sensitivity_{name}"), np.array(_grid(wavelengths))
    curves = [np.interp(points, table["wavelengths"], curve, left=0, right=0) for curve in table["values"]]
    return torch.tensor(np.stack(curves))


@functools.cache
def _table(name: str) -> dict[str, np.ndarray]:
    with resources.files("kcam").joinpath("tables", f"{name}.npz").open("rb") as file, np.load(file) as archive:
        return dict(archive)


def _grid(wavelengths: Tensor) -> Grid:
    # Rounded to 1e-6 nm, so that 420e-9 / 1e-9 = 420.00000000000006 is a point of the tables.
    grid = tuple(np.round(wavelength_grid(wavelengths).numpy() / nm, 6).tolist())
    if len(set(grid)) < len(grid):
        twice = next(value for value in grid if grid.count(value) > 1)
        raise ValueError(f"wavelength {twice:g} nm occurs more than once: expected distinct bands. Average them first.")
    return grid


def _interpolation(grid: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Weights (L, N) that interpolate values on `grid` at `points`: cubic in between, constant beyond the ends.

    Where neighbouring distances are so unequal that a cubic would amplify errors, linear in between.
    """
    order = np.argsort(grid)
    nodes, points = grid[order], np.clip(points, grid.min(), grid.max())
    size = min(4, len(nodes))
    first = np.clip(np.searchsorted(nodes, points, side="right") - size // 2, 0, len(nodes) - size)
    stencil = nodes[first[:, None] + np.arange(size)]
    weights = np.zeros((len(nodes), len(points)))
    for k in range(size):
        others = np.delete(stencil, k, axis=1)
        lagrange = np.prod((points[:, None] - others) / (stencil[:, [k]] - others), axis=1)
        weights[first + k, np.arange(len(points))] = lagrange
    if np.abs(weights).max() > 1.3:  # 1.06 for equal distances
        weights = _triangles(nodes, points)
    result = np.empty_like(weights)
    result[order] = weights
    return result


def _triangles(nodes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """`interpolation` of arrays."""
    return interpolation(torch.tensor(nodes), torch.tensor(points)).numpy()


@functools.lru_cache(maxsize=64)
def _colour_matching(grid: Grid) -> np.ndarray:
    """(L, 3): the integrals over the colour matching functions in `xyz_weights`."""
    table = _table("observer")
    return _interpolation(np.array(grid), table["wavelengths"]) @ table["values"] / table["values"][:, 1].sum()


def _lamp_at_1nm(name: str) -> np.ndarray:
    table, names = _table("illuminants"), illuminant_names()
    if name not in names:
        raise ValueError(f"unknown illuminant {name!r}. There are: {', '.join(names)}; or give a tensor (L,).")
    return np.interp(_table("observer")["wavelengths"], table["wavelengths"], table["values"][names.index(name)])


def _band_averages(curves: np.ndarray, grid: Grid, fine: np.ndarray | None = None) -> np.ndarray:
    """Curves (..., N) in steps of 1 nm, by default the observer's 471, averaged over each band's triangle: (..., L).

    The triangles of the outermost bands are symmetric, as are their widths in `band_widths`.
    """
    bands, fine = np.array(grid), _table("observer")["wavelengths"] if fine is None else fine
    order = np.argsort(bands)
    nodes = bands[order]
    first, last = (nodes[1] - nodes[0], nodes[-1] - nodes[-2]) if len(nodes) > 1 else [SINGLE_BAND_WIDTH / nm] * 2
    triangles = np.empty((len(bands), len(fine)))
    triangles[order] = _triangles(np.concatenate([[nodes[0] - first], nodes, [nodes[-1] + last]]), fine)[1:-1]
    for band in np.flatnonzero(triangles.sum(axis=1) == 0):  # it falls between two steps, or outside the range
        triangles[band, np.abs(fine - bands[band]).argmin()] = 1
    return curves @ (triangles / triangles.sum(axis=1, keepdims=True)).T


def _measured_at_1nm(light: SpectralTable, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """A lamp of a table in steps of 1 nm that reach over the eye's and all bands: mean powers, and where [nm]."""
    if len(light.values) != 1:
        raise ValueError(
            f"an illuminant has one column, and this table {len(light.values)} ({', '.join(light.names)}). Take one: "
            "table._replace(values=table.values[:1], names=table.names[:1])."
        )
    nodes, power = rising(light.wavelengths).numpy() / nm, light.values[0].detach().double().cpu().numpy()
    if not (np.isfinite(power).all() and (power >= 0).all() and power.any()):
        raise ValueError(f"illuminant must be finite, >= 0 and not all zero, got {power.min():g} to {power.max():g}.")
    eye = _table("observer")["wavelengths"]
    fine = np.arange(min(eye[0], math.floor(min(grid) - 50)), max(eye[-1], math.ceil(max(grid) + 50)) + 1)
    area = np.concatenate([[0.0], np.cumsum(np.diff(nodes) * (power[1:] + power[:-1]) / 2)])

    def integral(ends: np.ndarray) -> np.ndarray:
        ends = np.clip(ends, nodes[0], nodes[-1])
        before = np.clip(np.searchsorted(nodes, ends, side="right") - 1, 0, len(nodes) - 2)
        step = ends - nodes[before]
        slope = np.diff(power)[before] / np.diff(nodes)[before]
        return area[before] + step * (power[before] + slope * step / 2)

    return integral(fine + 0.5) - integral(fine - 0.5), fine


@functools.lru_cache(maxsize=64)
def _lamp(name: str, grid: Grid) -> np.ndarray:
    return _on_bands(_lamp_at_1nm(name), _table("observer")["wavelengths"], grid)


def _on_bands(lamp: np.ndarray, fine: np.ndarray, grid: Grid) -> np.ndarray:
    """The power of a lamp, in steps of 1 nm, on bands."""
    matching_1nm = observer(torch.tensor(fine) * nm).numpy()
    matching = _colour_matching(grid)
    power = _band_averages(lamp, grid, fine)
    if not (lamp @ matching_1nm[:, 1] > 0 and power @ matching[:, 1] > 0):
        raise ValueError(
            "the illuminant has no light that the eye sees, or none on these bands, so its white has no luminance. "
            "Give a relative power per band (L,) with some in 360..830 nm."
        )
    white = lamp @ matching_1nm / (lamp @ matching_1nm[:, 1])
    power = power / (power @ matching[:, 1])
    relative = power[:, None] * matching  # d XYZ by a relative change of each band; least squares keeps it small
    change = np.linalg.lstsq(relative.T, white - relative.sum(axis=0), rcond=None)[0]
    power = power * (1 + change * min(1.0, 0.9 / max(np.abs(change).max(), 1e-300)))
    return power / (power @ matching[:, 1])


@functools.lru_cache(maxsize=64)
def _rgb_basis(grid: Grid) -> np.ndarray:
    table, fine = _table("rgb_basis"), _table("observer")["wavelengths"]
    curves = np.stack([np.interp(fine, table["wavelengths"], curve) for curve in table["values"]])
    mallett = _band_averages(curves / curves.sum(axis=0), grid)  # the table's sums differ from 1 by 1e-7
    to_rgb = _colour_matching(grid) * _lamp("D65", grid)[:, None] @ _xyz_to_srgb().T
    if len(grid) < 3:
        return mallett
    exact = np.linalg.pinv(mallett @ to_rgb) @ mallett
    exact -= (exact - mallett).mean(axis=0)  # already so where the lamp's white is exact: the rows go on adding up to 1
    return exact if exact.min() >= 0 and exact.max() <= 1 else _nearest_basis(mallett, to_rgb)


def _nearest_basis(start: np.ndarray, to_rgb: np.ndarray) -> np.ndarray:
    """The reflectances nearest to `start`, (3, L), with columns >= 0 that add up to 1, and B to_rgb = 1.

    Where there are none such, those with the least error of it, near to them.

    minimise |B - start|^2 / 2 + weight |1 - B A + P / weight|^2 / 2 over the columns' simplices, by its dual: for
    multipliers Y (3, 3) each column of B is that of start + Y A^T brought onto the simplex, and Newton's method finds
    the nine numbers. P, the multipliers so far, takes the rest of the error away (method of multipliers).
    """
    unit, multipliers, before = np.eye(3), np.zeros((3, 3)), np.zeros((3, 3))
    weight, found = 1e5, []

    def at(now: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        basis = _on_simplex(start + now @ to_rgb.T)
        missing = unit - basis @ to_rgb
        dual = 0.5 * ((basis - start) ** 2).sum() + (now * missing).sum() - ((now - before) ** 2).sum() / (2 * weight)
        return basis, missing, dual

    for power in range(5, 20):
        weight, before = 10.0 ** min(power, 10), multipliers  # what is barely possible needs more of it
        basis, missing, dual = at(multipliers)
        for _ in range(60):
            slope = missing - (multipliers - before) / weight
            free = (basis > 0).astype(float)
            moves = free[:, None] * unit[:, :, None] - free[:, None] * free / free.sum(axis=0)  # of each column
            hessian = np.einsum("abl,lk,lm->akbm", moves, to_rgb, to_rgb).reshape(9, 9) + np.eye(9) / weight
            step = np.linalg.solve(hessian, slope.ravel()).reshape(3, 3)
            rise, length = (slope * step).sum(), 1.0
            floor = dual - 1e-14 * max(1.0, abs(dual))  # of rounding
            while length > 1e-6 and at(multipliers + length * step)[2] < floor + 1e-4 * length * rise:
                length /= 2
            if length <= 1e-6 or np.abs(slope).max() < 2e-16:
                break
            multipliers = multipliers + length * step
            basis, missing, dual = at(multipliers)
        found.append((float(np.abs(missing).max()), basis))
        if found[-1][0] < 4e-16:
            break
    error, nearest = min(found, key=lambda pair: pair[0])
    return nearest if error < 1e-7 else found[0][1]


def _on_simplex(columns: np.ndarray) -> np.ndarray:
    """The nearest columns with entries >= 0 that add up to 1."""
    falling = -np.sort(-columns, axis=0)
    excess = (falling.cumsum(axis=0) - 1) / np.arange(1, len(columns) + 1)[:, None]
    kept = (falling > excess).sum(axis=0)
    return np.maximum(columns - excess[kept - 1, np.arange(columns.shape[1])], 0)


@functools.lru_cache(maxsize=64)
def _rgb_error(grid: Grid) -> float:
    rgb = np.stack(np.meshgrid(*[np.linspace(0, 1, 9)] * 3), axis=-1).reshape(-1, 3)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    back = linear @ _rgb_basis(grid) @ (_colour_matching(grid) * _lamp("D65", grid)[:, None] @ _xyz_to_srgb().T)
    back = back.clip(0, 1)
    return float(np.abs(np.where(back <= 0.0031308, 12.92 * back, 1.055 * back ** (1 / 2.4) - 0.055) - rgb).max())
