"""PSFs from elsewhere: another tool's, or photographs of a point."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor, nn

from kcam.inputs import as_values, describe
from kcam.optics.elements.element import set_tensor
from kcam.optics.numerics import linear_weights
from kcam.optics.regions import field_shares
from kcam.optics.source import Defocus, PixelGrid, Points
from kcam.precision import full_precision
from kcam.units import check_distances, check_pixel_pitch, check_positive, wavelength_grid

_SAME = 1e-6  # relative: two pitches, wavelengths or distances that are one
_NEEDED = ("psfs", "wavelengths", "distances", "pixel_pitch")
_NAMES = (*_NEEDED, "positions", "focus_distance", "aperture_area", "sensor_distance")  # in a file


@dataclass(frozen=True)
class Deviation:
    """What a picture with measured PSFs may be off by, of their light (L1); `print` it.

    between_distances, between_wavelengths: half-way between two that were measured, as the others tell it. resampling:
    from their pixels to those asked for. NaN where too little was measured to tell.
    """

    between_distances: float
    between_wavelengths: float
    resampling: float

    def __str__(self) -> str:
        def say(value: float) -> str:
            return "not known: too few were measured" if value != value else f"{value:.1e}"

        return (
            f"between distances    {say(self.between_distances)}\n"
            f"between wavelengths  {say(self.between_wavelengths)}\n"
            f"resampling           {say(self.resampling)}"
        )


class MeasuredPSF(nn.Module):
    """PSFs that are known at some wavelengths and distances, perhaps at several places of the picture.

    Between them they are interpolated linearly, in wavelength and in vergence (1 / distance); `deviation` states the
    error. Onto another pixel pitch light is brought by a cubic spline of its running sum, and none is lost. A scene
    beyond the measured distances is blurred as the nearest of them.

    Args:
        psfs: (Z, L, H, W), or (F, Z, L, H, W) at image positions: energy in each pixel, relative to what passes the
            optics, as light falls (not turned); index n // 2 is the origin. A Parameter trains.
        wavelengths: (L,) [m]. distances: of the point, (Z,) [m], inf allowed. pixel_pitch: of the PSFs [m].
        positions: (F, 2), x and y on the sensor [m], from its middle, +x right and +y down, as light falls; None: one
            set of PSFs is everywhere.
        focus_distance [m], aperture_area [m^2], sensor_distance [m]: where they are known; automatic exposure needs
            none of them, exposure in seconds the last two.
    Raises:  TypeError, ValueError for shapes that do not fit, NaN, negative light, lengths that are not in metres; at
        the first picture for wavelengths of the scene that were not measured.
    Valid where the light of a pixel of the scene is the same over the PSF's place of the picture.

    Example:
    >>> point = torch.zeros(1, 2, 5, 5)
    >>> point[..., 2, 2] = 1.0  # all light in the middle: a perfect lens
    >>> lens = optics.MeasuredPSF(point, wavelengths=[450 * nm, 650 * nm], distances=2.0, pixel_pitch=4 * um)
    >>> scene = Scene.from_bands(torch.rand(1, 2, 16, 16), wavelengths=[450 * nm, 650 * nm], depth=2.0)
    >>> torch.allclose(optics.Imaging(lens, pixel_pitch=4 * um)(scene), scene.bands(), atol=1e-5)
    True
    """

    psfs: Tensor
    wavelengths: Tensor
    distances: Tensor
    positions: Tensor | None

    def __init__(
        self,
        psfs: Tensor,
        *,
        wavelengths: Tensor | list[float],
        distances: Tensor | list[float] | float,
        pixel_pitch: float,
        positions: Tensor | None = None,
        focus_distance: float | None = None,
        aperture_area: float | None = None,
        sensor_distance: float | None = None,
    ) -> None:
        super().__init__()
        _check_psfs(psfs)
        grid = wavelength_grid(wavelengths)
        places = check_distances(as_values(distances, name="distances", unit="m"), name="distances")
        places = places.to(torch.float64).reshape(-1).cpu()
        fields = None if psfs.ndim == 4 else psfs.shape[0]
        if tuple(psfs.shape[-4:-2]) != (len(places), len(grid)):
            raise ValueError(
                f"psfs {tuple(psfs.shape)} are of {psfs.shape[-4]} distances and {psfs.shape[-3]} wavelengths, but "
                f"{len(places)} and {len(grid)} are given: (Z, L, H, W), or (F, Z, L, H, W) with positions=(F, 2)."
            )
        for name, values, unit in (("distances", 1 / places, "distance"), ("wavelengths", grid, "wavelength")):
            if len(values.unique()) < len(values):
                raise ValueError(f"{name} holds a {unit} twice. Give each once, with one PSF.")
        if (positions is None) != (fields is None):
            raise ValueError(
                f"psfs {tuple(psfs.shape)} and positions={describe(positions)} do not go together: "
                "(F, Z, L, H, W) has a position (F, 2) for each of F, (Z, L, H, W) has none."
            )
        if positions is not None:
            positions = as_values(positions, name="positions", unit="m").to(torch.float64)
            if positions.shape != (fields, 2) or not bool(positions.isfinite().all()):
                raise ValueError(f"positions must be finite, ({fields}, 2) [m], got {describe(positions)}.")
            if len(positions.unique(dim=0)) < len(positions):
                raise ValueError("positions holds a place twice. Give each once, with one PSF.")
            if float(positions.abs().max()) > 1:
                raise ValueError("positions are beyond 1 m from the middle of the sensor. They are in metres: * mm?")
        if focus_distance is not None:
            focus_distance = float(check_distances(focus_distance, name="focus_distance"))
        for name, value, unit in (("aperture_area", aperture_area, "m^2"), ("sensor_distance", sensor_distance, "m")):
            if value is not None:
                check_positive(value, name=name, unit=unit)
        set_tensor(self, "psfs", psfs)
        self.register_buffer("wavelengths", grid)
        self.register_buffer("distances", places)
        self.register_buffer("positions", positions)
        self.pixel_pitch = check_pixel_pitch(pixel_pitch)
        self.focus_distance = focus_distance
        self._area = None if aperture_area is None else float(aperture_area)
        self.sensor_distance = None if sensor_distance is None else float(sensor_distance)

    def configuration(self) -> dict[str, object]:
        """Constructor arguments, for saving."""
        names = ("psfs", "wavelengths", "distances", "pixel_pitch", "positions", "focus_distance", "sensor_distance")
        return {name: getattr(self, name) for name in names} | {"aperture_area": self._area}

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> MeasuredPSF:
        """Read a file whose arrays, data sets or HDUs have the arguments' names, in SI units.

        .npz (without pickles), .h5 or .hdf5 (by h5py, the extra [data]), .fits (by astropy, the extra [fits]).

        Raises:    FileNotFoundError; ValueError for another kind of file, a damaged one, or one that lacks an argument;
                   ImportError that names the extra.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"there is no file {path}. Expected PSFs: {', '.join(_READERS)}.")
        reader = _READERS.get(path.suffix.lower())
        if reader is None:
            raise ValueError(f"{path.name} is none of {', '.join(_READERS)}. Save PSFs with numpy.savez, for instance.")
        try:
            found = reader(path)
        except ImportError:
            raise
        except Exception as error:  # of a damaged file these libraries raise anything
            raise ValueError(f"cannot read {path}: {error}. It is damaged, or no such file.") from error
        missing = [name for name in _NEEDED if name not in found]
        if missing:
            raise ValueError(f"{path} has no {', '.join(missing)}; it holds {', '.join(sorted(found)) or 'nothing'}.")
        given: dict[str, Any] = {}
        for name, values in found.items():
            if values.dtype.kind not in "fui":
                raise ValueError(f"{path}: {name} must hold numbers, got {values.dtype}.")
            number = name not in ("psfs", "wavelengths", "distances", "positions")
            native = values.astype(np.float32 if name == "psfs" and values.itemsize <= 4 else np.float64)
            given[name] = float(native.reshape(-1)[0]) if number and native.size == 1 else torch.from_numpy(native)
        psfs = given.pop("psfs")
        return cls(psfs, **given)

    # ---- as a source of PSFs ---------------------------------------------------------------------------------------

    def bank(self, points: Points, wavelengths: Tensor, pixels: PixelGrid) -> Tensor:
        """PSFs (N, L, h, w): see `PSFSource`. Raises: ValueError for wavelengths that were not measured."""
        with full_precision(pixels.device):
            psfs = self._resampled(pixels)
            psfs = torch.einsum("nz,fzlhw->nflhw", self._of_distances(points.vergences).to(psfs), psfs)
            if self.positions is None:
                psfs = psfs[:, 0]
            else:
                at = torch.zeros(len(psfs), 2) if points.positions is None else points.positions
                psfs = torch.einsum("nf,nflhw->nlhw", field_shares(self.positions, at).to(psfs), psfs)
            return torch.einsum("kl,nlhw->nkhw", self._of_wavelengths(wavelengths).to(psfs), psfs)

    def window(self, points: Points, wavelengths: Tensor, pixels: PixelGrid) -> tuple[int, int]:
        """All that was measured, (H, W) [pixels]."""
        ratio = self.pixel_pitch / pixels.pitch
        if abs(ratio - 1) < _SAME:
            return self.psfs.shape[-2], self.psfs.shape[-1]
        height, width = (2 * int(np.ceil((n // 2 + 0.5) * ratio - 0.5 - _SAME)) + 1 for n in self.psfs.shape[-2:])
        return height, width

    @property
    def vergences(self) -> Tensor:
        """Between which PSFs are interpolated linearly, ascending [1/m]: layers of depth lie there."""
        return (1 / self.distances).sort().values

    def defocus_waves(self, wavelengths: Tensor) -> float:
        """Not known of a measured PSF, and not asked: its layers lie where it was measured."""
        return 0.0

    def defocus(self, wavelengths: Tensor, pixel_pitch: float) -> Defocus:
        """How far light is spread, from the rms radius of the PSFs at each distance: see `source.Defocus`."""
        with torch.no_grad():
            light = self.psfs.double().reshape(-1, *self.psfs.shape[-4:]).sum((0, 2))
            y, x = (torch.arange(n, device=light.device) - n // 2 for n in light.shape[-2:])
            r2 = (x**2 + y[:, None] ** 2).double()
            radii = ((light * r2).sum((-2, -1)) / light.sum((-2, -1))).sqrt().cpu() * 2 * self.pixel_pitch / pixel_pitch
            vergences, order = (1 / self.distances.cpu()).sort()
            radii = radii[order]
            slopes = radii.diff().abs() / vergences.diff()
        focus = float(vergences[radii.argmin()])
        return Defocus((focus, focus), float(slopes.max()) if len(slopes) else 0.0, float(radii.min()))

    def aperture_area(self) -> float | None:
        """As given [m^2]."""
        return self._area

    def deviation(self, *, pixel_pitch: float | None = None) -> Deviation:
        """What interpolation, and resampling to this pitch, may cost: measured on the PSFs themselves, L1.

        Half-way between two nodes an interpolation errs by a quarter of what it errs by where a node between is left
        out; with two nodes alone, by at most a half of what these differ by. Resampling: against light that is
        even over each measured pixel.
        """
        with torch.no_grad():
            psfs = self.psfs.double().reshape(-1, *self.psfs.shape[-4:])
            resampling = 0.0
            if pixel_pitch is not None and abs(pixel_pitch / self.pixel_pitch - 1) >= _SAME:
                shape = self.window(Points(self.vergences), self.wavelengths, PixelGrid(pixel_pitch, (1, 1)))
                ways = [_over(psfs, shape, pixel_pitch / self.pixel_pitch, even=even) for even in (False, True)]
                resampling = _difference(*ways)
            return Deviation(
                _left_out(psfs.transpose(0, 1), 1 / self.distances),
                _left_out(psfs.permute(2, 0, 1, 3, 4), self.wavelengths),
                resampling,
            )

    def _of_distances(self, vergences: Tensor) -> Tensor:
        nodes = (1 / self.distances).to(vergences.device)
        return linear_weights(nodes, vergences.to(torch.float64))

    def _of_wavelengths(self, wavelengths: Tensor) -> Tensor:
        low, high = (float(bound) for bound in self.wavelengths.aminmax())
        outside = wavelengths[(wavelengths < low * (1 - _SAME)) | (wavelengths > high * (1 + _SAME))]
        if outside.numel():
            raise ValueError(
                f"these PSFs were measured from {low * 1e9:.4g} to {high * 1e9:.4g} nm, and the scene has "
                f"{float(outside[0]) * 1e9:.4g} nm. Measure there, or cut the scene to wavelengths that were measured."
            )
        return linear_weights(self.wavelengths, wavelengths.to(self.wavelengths))

    def _resampled(self, pixels: PixelGrid) -> Tensor:
        """(F, Z, L, h, w) on the pixels that are asked for."""
        psfs = self.psfs.to(pixels.device, pixels.dtype)
        psfs = psfs.reshape(-1, *psfs.shape[-4:])
        ratio, active = pixels.pitch / self.pixel_pitch, pixels.fill_factor**0.5
        if abs(ratio - 1) < _SAME and active == 1:
            for dim, n in zip((-2, -1), pixels.shape, strict=True):
                psfs = _centred(psfs, n, dim=dim)
            return psfs
        return _over(psfs, pixels.shape, ratio, active=active)


def _check_psfs(psfs: Tensor) -> None:
    if not isinstance(psfs, Tensor) or not psfs.is_floating_point():
        raise TypeError(f"psfs must be a floating-point tensor (Z, L, H, W), got {describe(psfs)}.")
    if psfs.ndim not in (4, 5) or 0 in psfs.shape:
        raise ValueError(f"psfs must be (Z, L, H, W), or (F, Z, L, H, W) with positions, got {tuple(psfs.shape)}.")
    values = psfs.detach()
    if not bool(values.isfinite().all()):
        raise ValueError("psfs has values that are NaN or infinite. Mask them before, such as torch.nan_to_num(psfs).")
    if float(values.min()) < 0:
        raise ValueError(
            f"psfs goes down to {float(values.min()):.3g}, but light is not negative: background subtraction leaves "
            "such values. Subtract the background's mean, then use psfs.clamp(min=0)."
        )
    if not bool((values.sum((-2, -1)) > 0).all()):
        raise ValueError("psfs has one that is dark everywhere. Leave out what was not measured.")


def _centred(psfs: Tensor, n: int, *, dim: int) -> Tensor:
    """Cut or filled up with darkness to n pixels, the origin at n // 2."""
    own = psfs.shape[dim]
    before = n // 2 - own // 2
    after = n - own - before
    return torch.nn.functional.pad(psfs, (before, after) if dim == -1 else (0, 0, before, after))


def _shares(own: int, wanted: int, ratio: float, active: float, even: bool = False) -> Tensor:
    """Share (wanted, own) of each measured pixel's light in each pixel, whose pitch is `ratio` of theirs.

    What lies left of each edge is known: between the edges it is interpolated by a cubic spline, so that no light is
    lost; or, even, linearly: as if each pixel's light were spread evenly over it.
    """
    edges = np.arange(own + 1) - own // 2 - 0.5
    left_of = np.concatenate([np.zeros((1, own)), np.cumsum(np.eye(own), axis=0)])
    between = scipy.interpolate.make_interp_spline(edges, left_of, k=1 if even or own < 3 else 3)
    centres = (np.arange(wanted) - wanted // 2) * ratio
    upper, lower = (between((centres + side * ratio * active / 2).clip(edges[0], edges[-1])) for side in (1, -1))
    return torch.as_tensor((upper - lower) / active)


def _over(psfs: Tensor, shape: tuple[int, int], ratio: float, *, active: float = 1.0, even: bool = False) -> Tensor:
    """PSFs (..., H, W) on other pixels, scaled to the light that whole ones receive: where the spline is below 0 it is
    cut, and a sensitive part may hit or miss a point.
    """
    sides = tuple(zip(psfs.shape[-2:], shape, strict=True))
    rows, columns = (_shares(own, n, ratio, active, even).to(psfs) for own, n in sides)
    inside = (_shares(own, n, ratio, 1.0, even).sum(0).to(psfs) for own, n in sides)
    light = (rows @ psfs @ columns.mT).clamp(min=0)
    total = light.sum((-2, -1)).clamp(min=torch.finfo(psfs.dtype).tiny)
    whole = torch.einsum("...hw,h,w->...", psfs, *inside)
    return light * (whole / total)[..., None, None]


def _left_out(psfs: Tensor, nodes: Tensor) -> float:
    """Largest L1 error half-way between nodes, of PSFs (n, ..., H, W), as a node that is left out tells it."""
    ordered, order = nodes.sort()
    psfs = psfs[order]
    if len(nodes) == 1:
        return float("nan")
    if len(nodes) == 2:
        return _difference(psfs[0], psfs[1]) / 2
    share = ((ordered[1:-1] - ordered[:-2]) / (ordered[2:] - ordered[:-2])).view(-1, *[1] * (psfs.ndim - 1))
    return _difference(psfs[:-2] * (1 - share) + psfs[2:] * share, psfs[1:-1]) / 4


def _difference(first: Tensor, second: Tensor) -> float:
    """L1 of the worst PSF, of its light."""
    return float(((first - second).abs().sum((-2, -1)) / second.sum((-2, -1))).max())


# ---- files -----------------------------------------------------------------------------------------------------------


def _from_npz(path: Path) -> dict[str, np.ndarray]:
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:  # np.load loses it where damaged
        return {name: file[name] for name in _NAMES if name in file.files}


def _from_hdf5(path: Path) -> dict[str, np.ndarray]:
    try:
        import h5py
    except ImportError as error:
        raise ImportError("reading .h5 needs h5py: pip install 'kcam[data]'.") from error
    with h5py.File(path, "r") as file:
        return {name: np.asarray(file[name]) for name in _NAMES if name in file}


def _from_fits(path: Path) -> dict[str, np.ndarray]:
    try:
        from astropy.io import fits
    except ImportError as error:
        raise ImportError("reading .fits needs astropy: pip install 'kcam[fits]'.") from error
    with path.open("rb") as stream, fits.open(stream, memmap=False) as file:
        named = {unit.name.lower(): unit for unit in file if unit.name}
        if "psfs" not in named and file[0].data is not None:
            named["psfs"] = file[0]  # the primary HDU is often left without a name
        return {name: np.asarray(named[name].data) for name in _NAMES if name in named}


_READERS: Mapping[str, Callable[[Path], dict[str, np.ndarray]]] = {
    ".npz": _from_npz,
    ".h5": _from_hdf5,
    ".hdf5": _from_hdf5,
    ".fits": _from_fits,
}
