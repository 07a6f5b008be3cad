"""A wavefront that was measured, or computed by another tool, as an element: its path as a spline, its light as pixels.

W(x, y) = sum_ij c_ij B(x - i) B(y - j),   c from the samples by solving for them, B the cubic B-spline
"""

from __future__ import annotations

import functools
import os
import re
from pathlib import Path

import numpy as np
import scipy
import torch
from torch import Tensor

from kcam.inputs import describe
from kcam.optics.elements.element import Element, Term, check_map, set_tensor
from kcam.optics.numerics import linear_weights
from kcam.optics.pupil.coordinates import Pupil
from kcam.optics.pupil.maps import PixelMap
from kcam.units import check_length, wavelength_grid

_WIDTHS = (1e-5, 10.0)  # of a map [m]
_DEGREE = 6  # of the polynomial that goes on where nothing was measured
_SAME = 1e-6  # relative: two wavelengths that are one


class MeasuredPupil(Element):
    """The wavefront that leaves a lens, beside the ideal one, as an interferometer or another tool gives it.

    Added to an ideal lens of the same exit pupil: ``Lens(CircularAperture(pupil.width), ThinLens(50 * mm), pupil,
    ...)``. Between the samples the path is a bicubic spline, beyond the outermost it goes on as it ends; what has no
    value (NaN) follows from a polynomial of degree 6 through what has one.

    Args:
        opd: optical path that the lens adds to the ideal one, (n, n) [m]; (L, n, n) with wavelengths; rows along +y,
            columns along +x, at the centres of n x n squares that fill the width. A Parameter trains. NaN: not known.
            Arrays of poppy are in metres, those of prysm in nanometres (``opd * nm``). A tool that counts a wavefront
            ahead of the ideal one as positive has the other sign.
        amplitude: transmission of the amplitude, (m, m) in [0, 1], on flat pixels that fill the width too; a Parameter
            trains. None: all light passes. It vignettes or apodises; the aperture is still an element of its own.
        width: of the maps [m].
        wavelengths: (L,) [m] of the opd; between them it is linear in wavelength. None: one path for all.
    Raises: TypeError, ValueError for maps that are not square, all NaN or infinite, NaN in a Parameter, amplitudes
        outside [0, 1], wavelengths that do not fit, a width not in metres; at the first PSF for a wavelength outside
        those given.
    Valid where the path is smooth between samples: a spline is off by 0.01 (2 pi h / P)^4 of a ripple of period P over
        samples h apart, 4e-3 of it at 8 samples a period.

    Example:
    >>> tilt = 2 * um * (torch.arange(32) - 15.5) / 16
    >>> pupil = optics.MeasuredPupil(tilt.expand(32, 32), width=2 * mm)
    >>> lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(50 * mm), pupil, focus_distance=math.inf)
    >>> psf = lens.psf([550 * nm], distances=math.inf, pixel_pitch=10 * um, shape=(33, 33))
    >>> int(psf[0, 0, 16].argmax()) - 16  # 50 mm * 2 um / 1 mm is 100 um
    10
    """

    opd: Tensor
    amplitude: Tensor | None
    wavelengths: Tensor | None

    def __init__(
        self,
        opd: Tensor,
        *,
        amplitude: Tensor | None = None,
        width: float,
        wavelengths: Tensor | list[float] | None = None,
    ) -> None:
        super().__init__()
        self.width = float(check_length(width, name="width", within=_WIDTHS, example="5 * mm"))
        grid = None if wavelengths is None else wavelength_grid(wavelengths)
        set_tensor(self, "opd", _filled(opd, count=None if grid is None else len(grid)))
        if grid is not None and len(grid.unique()) < len(grid):
            raise ValueError("wavelengths holds a wavelength twice. Give each once, with one opd.")
        self.register_buffer("wavelengths", grid)
        self.amplitude = None
        if amplitude is not None:
            check_map(amplitude, name="amplitude")
            del self.amplitude
            set_tensor(self, "amplitude", amplitude)
        self.check()

    @classmethod
    def from_zemax(cls, path: str | os.PathLike[str]) -> MeasuredPupil:
        """The "Listing of Wavefront Map Data" that Zemax OpticStudio writes as text, UTF-16 or ASCII.

        Waves become metres at the file's wavelength. The width is that of the exit pupil; rows run along the file's
        +y, from the side on which Zemax leaves a row empty. Where the pupil is vignetted or obscured (its zeros) there
        is an amplitude, else the aperture beside it bounds the light. Raises: FileNotFoundError; ValueError for another
        or a damaged file, which says what is missing.
        """
        waves, open_part, wavelength, diameter = _read_zemax(Path(path))
        count = len(waves)
        x = (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * (2 / count)
        samples = torch.from_numpy(_extrapolated(np.where(open_part, waves * wavelength, np.nan)))[None]
        inward = x * (1 - 1 / count)  # the outermost samples lie on the rim; of our squares the outermost edges do
        opd = _spline(samples, inward[None, :], inward[:, None])[0]
        rho = np.hypot(*np.broadcast_arrays(x[:, None].numpy(), x[None, :].numpy()))
        closed = ~open_part & (rho <= 1 - 2 / count)
        if not closed.any():
            return cls(opd, width=diameter)
        nearest = scipy.ndimage.distance_transform_edt(rho > 1 - 2 / count, return_distances=False, return_indices=True)
        return cls(opd, amplitude=torch.from_numpy(1.0 - closed[tuple(nearest)]), width=diameter)

    def check(self) -> None:
        if self.amplitude is None:
            return
        low, high = (float(value) for value in self.amplitude.detach().aminmax())
        if low < 0 or high > 1 or high == 0:
            raise ValueError(
                f"amplitude must be in [0, 1] and let light pass, got {low:g}..{high:g}; divide by its maximum, and "
                "where it trains, clamp_(0, 1) it after each step."
            )

    def terms(self, pupil: Pupil, wavelengths: Tensor) -> list[Term]:
        maps = self.opd if self.opd.ndim == 3 else self.opd[None]
        x, y = (side * (pupil.semi_aperture * 2 / self.width) for side in (pupil.x, pupil.y))
        found = _spline(maps.to(x), x, y)
        return list(zip(self._shares(wavelengths).unbind(1), found.unbind(0), strict=True))

    def pixel_map(self, wavelengths: Tensor) -> PixelMap | None:
        return None if self.amplitude is None else PixelMap(self.amplitude, self.width / 2, factors=None)

    def _shares(self, wavelengths: Tensor) -> Tensor:
        """Of each map in the path at each wavelength, (L, maps)."""
        if self.wavelengths is None:
            return wavelengths.new_ones(len(wavelengths), 1)
        known = self.wavelengths.to(wavelengths)
        low, high, first, last = (float(bound) for grid in (wavelengths, known) for bound in grid.aminmax())
        if low < first - _SAME * last or high > last * (1 + _SAME):
            raise ValueError(
                f"the pupil was measured from {1e9 * first:.4g} to {1e9 * last:.4g} nm, and {1e9 * low:.4g} to "
                f"{1e9 * high:.4g} nm are asked for. Give the opd of more wavelengths, or wavelengths=None: one path "
                "for all."
            )
        return linear_weights(known, wavelengths)


def _filled(opd: Tensor, *, count: int | None) -> Tensor:
    """The maps, checked, with values where there were none."""
    if not isinstance(opd, Tensor) or not opd.is_floating_point():
        raise TypeError(f"opd must be a floating-point tensor (n, n) or (L, n, n), got {describe(opd)}.")
    wanted = "(n, n)" if count is None else f"({count}, n, n), one for each wavelength"
    if opd.ndim != (2 if count is None else 3) or opd.shape[-1] != opd.shape[-2] or opd.shape[-1] < 4:
        raise ValueError(f"opd must be {wanted}, n >= 4, got {tuple(opd.shape)}.")
    if count is not None and len(opd) != count:
        raise ValueError(f"opd must be {wanted}, got {tuple(opd.shape)}.")
    if bool(opd.isinf().any()):
        raise ValueError("opd is infinite somewhere; leave NaN where nothing was measured.")
    if float(opd.detach().nan_to_num().abs().max()) > 1e-2:
        largest = float(opd.detach().nan_to_num().abs().max())
        raise ValueError(f"opd reaches {largest:g} m, and is in metres: nanometres * nm, waves * wavelength.")
    unknown = opd.detach().isnan()
    if not bool(unknown.any()):
        return opd
    if isinstance(opd, torch.nn.Parameter):
        raise ValueError("opd is a Parameter with NaN. Fill it first: nn.Parameter(MeasuredPupil(opd, ...).opd).")
    maps = opd.double().cpu().numpy().reshape(-1, *opd.shape[-2:])
    return torch.from_numpy(np.stack([_extrapolated(one) for one in maps])).to(opd).view(opd.shape)


def _extrapolated(values: np.ndarray) -> np.ndarray:
    """A polynomial where there is no value, and what the nearest values are off it."""
    known = np.isfinite(values)
    side = np.linspace(-1, 1, len(values))
    degree = min(_DEGREE, int(np.sqrt(known.sum() / 4)))
    if not known.any():
        raise ValueError("opd is NaN everywhere: nothing was measured.")
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    legendre = np.polynomial.legendre.legvander(side, degree)
    basis = np.stack([legendre[:, i, None] * legendre[None, :, j] for i, j in powers], axis=-1)
    fitted = basis @ np.linalg.lstsq(basis[known], values[known], rcond=None)[0]
    nearest = scipy.ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.where(known, values, fitted + (values - fitted)[tuple(nearest)])


@functools.lru_cache(maxsize=8)
def _coefficients(count: int) -> Tensor:
    """From samples (n,) to coefficients of cubic B-splines, 2n + 2: not-a-knot at the ends, straight beyond them."""
    collocation = np.zeros((count + 2, count + 2))
    for sample in range(count):
        collocation[sample, sample : sample + 3] = np.array([1, 4, 1]) / 6
    fourth = np.array([1, -4, 6, -4, 1])[: count + 2]
    collocation[count, :5], collocation[count + 1, -5:] = fourth, fourth
    inside = np.linalg.inv(collocation)[:, :count]
    more = np.arange(count // 2, 0, -1)[:, None]
    before = inside[0] + more * (inside[0] - inside[1])
    after = inside[-1] + more[::-1] * (inside[-1] - inside[-2])
    return torch.from_numpy(np.concatenate([before, inside, after]))


def _spline(maps: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Maps (K, n, n) over [-1, 1], samples at the centres of n squares, at coordinates x, y: (K, ...)."""
    count = maps.shape[-1]
    solve = _coefficients(count).to(maps)
    table = solve @ maps @ solve.T
    (left, across), (top, down) = (_taps(side, count) for side in (x, y))
    found = maps.new_zeros(())
    for row, high in enumerate(down):
        line = maps.new_zeros(())
        for column, wide in enumerate(across):
            line = line + wide * table[:, top + row, left + column]
        found = found + high * line
    return found


def _taps(side: Tensor, count: int) -> tuple[Tensor, list[Tensor]]:
    """The first of four coefficients at each coordinate, and their weights."""
    last = count + 2 + 2 * (count // 2)
    position = ((side + 1) / 2 * count - 0.5 + count // 2 + 1).clamp(1, last - 2.001)
    first = position.detach().floor()
    t = position - first
    weights = [(1 - t) ** 3, 4 - 6 * t**2 + 3 * t**3, 1 + 3 * t + 3 * t**2 - 3 * t**3, t**3]
    return first.long() - 1, [weight / 6 for weight in weights]


# ---- Zemax -----------------------------------------------------------------------------------------------------------

_NUMBER = r"([-+]?\d[\d.]*(?:[eE][-+]?\d+)?)"
_LENGTHS = {"millimeters": 1e-3, "centimeters": 1e-2, "inches": 25.4e-3, "meters": 1.0}


def _read_zemax(path: Path) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Waves (n, n), rows along +y, with the outermost on the rim; where light passes; wavelength, diameter [m]."""
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}. Expected the text of a Zemax wavefront map.")
    held = path.read_bytes()
    wide = held[:2] in (b"\xff\xfe", b"\xfe\xff")
    text = held.decode("utf-16" if wide else "utf-16-le" if held[1:2] == b"\0" else "latin-1", errors="replace")
    head, _, body = text.partition("Center point is")

    def read(pattern: str, what: str, *, inside: str = head) -> tuple[str, ...]:
        found = re.search(pattern, inside, re.IGNORECASE)
        if found is None:
            raise ValueError(f"{path} has no {what}: it is no Zemax wavefront map as text, or damaged.")
        return found.groups()

    if "wavefront map data" not in head.lower():
        raise ValueError(f"{path} is no Zemax 'Listing of Wavefront Map Data'. Save the Wavefront Map's text.")
    wavelength = float(read(_NUMBER + r"\s*\S{0,3}m\s+at\b", "wavelength, such as '0.5500 µm at 0.00 (deg)'")[0]) * 1e-6
    diameter, unit = read(r"Exit Pupil Diameter:?\s*" + _NUMBER + r"\s*([a-z]*)", "'Exit Pupil Diameter'")
    if unit.lower() not in _LENGTHS:
        raise ValueError(f"{path} has its exit pupil in {unit or 'no unit'}; known: {', '.join(_LENGTHS)}.")
    columns, rows = (int(n) for n in read(r"Pupil grid size:?\s*(\d+)\s*by\s*(\d+)", "'Pupil grid size'"))
    line, _, table = body.partition("\n")
    column, row = (int(n) for n in read(r"(\d+)\D+(\d+)", "'Center point is: Col 33, Row 33'", inside=line))
    try:
        values = np.array(table.split(), dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"{path}: {error} among its waves: it is damaged.") from None
    if values.size != rows * columns or rows != columns or not np.isfinite(values).all():
        raise ValueError(f"{path} has {values.size} values, expected {rows} x {columns} finite ones, as many rows.")
    waves = values.reshape(rows, columns)
    if not waves[-1].any() and waves[0].any():  # Zemax leaves the row at -y empty: this text begins at +y
        waves = waves[::-1]
    return *_centred(waves, column - 1, row - 1), wavelength, float(diameter) * _LENGTHS[unit.lower()]


def _centred(waves: np.ndarray, column: int, row: int) -> tuple[np.ndarray, np.ndarray]:
    """The square of samples whose outermost lie on the rim, and where light passes.

    Zemax puts n / 2 - 1 samples from the centre to the rim, others n / 2: what is not 0 fills one of these circles.
    """
    count = len(waves)
    open_part = ~scipy.ndimage.binary_opening(np.pad(waves == 0, 2, constant_values=True), np.ones((3, 3)))[2:-2, 2:-2]
    open_part |= not open_part.any()  # of a perfect wavefront
    lines = np.hypot(*np.meshgrid(np.arange(count) - column, np.arange(count) - row))
    radius = min((count // 2, (count - 1) // 2), key=lambda r: abs(float((lines <= r).sum()) - float(open_part.sum())))
    around = [(place - radius, place + radius + 1) for place in (row, column)]
    short = max(0, *(max(-low, high - count) for low, high in around))  # a rim that lies on the array's last line
    waves, open_part = np.pad(waves, short), np.pad(open_part, short)
    rows, columns = (slice(low + short, high + short) for low, high in around)
    return waves[rows, columns], open_part[rows, columns]
