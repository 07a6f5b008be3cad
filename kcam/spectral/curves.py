"""Curves over wavelength: read from tables of files, and linear between their rows."""

from __future__ import annotations

import itertools
import math
import os
import warnings
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kcam.units import WAVELENGTH_RANGE, check_flag, nm, wavelength_grid


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
