"""A cube of spectral radiance with depth, and what it is made from."""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from numbers import Integral
from typing import TypeGuard

import numpy as np
import torch
from torch import Tensor

from kcam import spectral, srgb
from kcam.cache import differentiated
from kcam.inputs import as_map, as_values, band_remedy, check_bands, check_picture, describe
from kcam.precision import full_precision
from kcam.scene.builtin import BUILTIN, CHARTS, PHOTOGRAPHS
from kcam.scene.picture import read_picture
from kcam.scene.resizing import fitted, target_shape
from kcam.units import LEAST_DISTANCE, check_distances, check_positive, warn_of_millimetres, wavelength_grid

_BLOCK = 2**12  # pixels whose light in all bands is formed at once
ROUGH = 1 / 255
"""Error of the way from sRGB to spectra and back from which on `Scene.from_rgb` warns of too few bands."""


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """Spectral radiance with depth, under a light.

    radiance_l(x, y) = sum_k coefficients_k(x, y) * spectra_kl

    The radiance is relative: a perfect white has the illuminant's spectrum, scaled to Y = 1, and `luminance` says how
    bright it is. Derive scenes with the methods, or with `dataclasses.replace`. Gradients reach `coefficients`,
    `spectra` and a tensor `depth`. Everything is checked here, so stages need not. The constructors below also warn
    (UserWarning) of depths that look like millimetres: all of them finite and 300 m or more.

    Args:      coefficients: (B,K,H,W); their dtype and device are the scene's.
               spectra: (K,L), the light included; None if the coefficients are the bands, K = L.
               wavelengths: (L,) [m], kept as float64 on the CPU; by default 28 from 420 to 720 nm.
               depth: distance from the lens [m], inf allowed: a number, kept as a float; one for each sample, (B,),
               also where B is H, kept so as float64 on the CPU; or a map (H,W), (1,H,W), (B,H,W), (1,1,H,W) or
               (B,1,H,W), kept as the last. A lone number with a derivative becomes a map of it.
               illuminant: a name or (L,), see `spectral.illuminant`; kept as (L,) float64 on the CPU.
               luminance: of a perfect white [cd/m^2].
    Raises:    TypeError, ValueError for shapes that do not fit, integers, NaN or inf, negative radiance, depth <= 0.

    Example:
    >>> wall = Scene.from_rgb(torch.full((3, 4, 6), 0.5), depth=2.0)  # sRGB 0.5 is 0.214 of white
    >>> wall.shape, len(wall.wavelengths), wall.depth
    ((1, 4, 6), 28, 2.0)
    >>> x, y, z = spectral.spectrum_to_xyz(wall.bands(), wavelengths=wall.wavelengths)[0, :, 0, 0]
    >>> round(float(y), 3)
    0.214
    """

    coefficients: Tensor
    spectra: Tensor | None = None
    wavelengths: Tensor = field(default_factory=wavelength_grid)
    depth: float | Tensor = 2.0  # numbers in a list or an array become one of these
    illuminant: Tensor = "D65"  # type: ignore[assignment]  # a name is replaced by its spectrum
    luminance: float = 1000.0

    def __post_init__(self) -> None:
        planes, spectra = self.coefficients, self.spectra
        wavelengths = wavelength_grid(self.wavelengths)
        bands = len(wavelengths)
        if not isinstance(planes, Tensor) or not planes.is_floating_point():
            raise TypeError(
                f"coefficients must be a floating-point tensor (B,K,H,W), got {describe(planes)}."
                f"{band_remedy(planes, name='coefficients', bands=bands)}"
            )
        if planes.ndim != 4 or 0 in planes.shape[1:]:
            raise ValueError(
                f"coefficients have shape {tuple(planes.shape)}, expected (B,K,H,W) with K, H, W >= 1."
                f"{'' if spectra is not None else band_remedy(planes, name='coefficients', bands=bands)}"
            )
        factors = planes.shape[1]
        if spectra is not None:
            if not isinstance(spectra, Tensor):
                raise TypeError(f"spectra must be a tensor (K,L) or None, got {describe(spectra)}.")
            spectra = spectra.to(planes)
            if spectra.shape != (factors, bands):
                raise ValueError(
                    f"spectra have shape {tuple(spectra.shape)}, expected ({factors}, {bands}): a row for each of the "
                    f"{factors} coefficient planes, a column for each of the {bands} wavelengths."
                )
        elif factors != bands:
            raise ValueError(
                f"{factors} bands, but {bands} wavelengths: expected as many. Pass wavelengths= ({factors},) in metres."
                f"{band_remedy(planes, name='coefficients', bands=bands)}"
            )
        _check_radiance(planes, spectra)
        check_positive(self.luminance, name="luminance", unit="cd/m^2")
        for name, value in (
            ("spectra", spectra),
            ("wavelengths", wavelengths),
            ("depth", _depth_map(self.depth, planes)),
            ("illuminant", spectral.illuminant(self.illuminant, wavelengths=wavelengths)),
            ("luminance", float(self.luminance)),
        ):
            object.__setattr__(self, name, value)

    @classmethod
    def from_rgb(
        cls,
        image: Tensor,
        *,
        depth: float | Tensor = 2.0,
        wavelengths: Tensor | None = None,
        illuminant: str | Tensor | spectral.SpectralTable = "D65",
        luminance: float = 1000.0,
    ) -> Scene:
        """A scene whose reflectance has the colours of an sRGB picture: white paint is 1, and the light falls on it.

        reflectance = linear rgb @ `spectral.rgb_basis`: three factors, exactly; one, flat, for a grey picture. Under
        D65 the scene has the colours of the picture; under another light, those that such paints would have there.
        Bands too few for that are warned of (UserWarning), with the error.

        Args:      image: (3,H,W), (B,3,H,W), (1,H,W) or (B,1,H,W), sRGB in [0,1] as files have it (gamma-coded).
                   Others: as for `Scene`.
        Raises:    TypeError for integers or what is no tensor; ValueError for another shape or values outside [0,1];
                   with the code that makes it right.
        """
        check_picture(image, name="image")
        image = image[None] if image.ndim == 3 else image
        channels = image.shape[1]
        linear = srgb.to_light(image)
        grid = wavelength_grid(wavelengths)
        error = spectral.rgb_error(grid) if channels == 3 else 0.0
        if error > ROUGH:
            warnings.warn(
                f"these {len(grid)} bands do not carry all colours of sRGB: some come back off by {error:.2f}. Use "
                "more, such as wavelengths=torch.linspace(420, 720, 28) * nm.",
                stacklevel=2,
            )
        basis = spectral.rgb_basis(grid) if channels == 3 else torch.ones(1, len(grid))
        light = spectral.illuminant(illuminant, wavelengths=grid)
        return _in_metres(cls(linear, basis * light, grid, depth, light, luminance))

    @classmethod
    def from_bands(
        cls,
        bands: Tensor,
        *,
        wavelengths: Tensor | None = None,
        depth: float | Tensor = 2.0,
        illuminant: str | Tensor | spectral.SpectralTable = "D65",
        luminance: float = 1000.0,
    ) -> Scene:
        """A scene from a measured cube of spectral radiance.

        The scale of the cube does not matter if the white that it was taken with is given as `illuminant`, (L,) in the
        same unit. For a cube of *reflectance* R multiply by the light first:
        ``Scene.from_bands(R * spectral.illuminant("D65", wavelengths=w)[:, None, None], wavelengths=w)``.

        Args:      bands: (L,H,W) or (B,L,H,W), finite, >= 0.
                   illuminant: by name, the light is normalised and `bands` taken as they are (white is E_l); as a
                   tensor, the radiance of a perfect white in the unit of `bands`.
                   Others: as for `Scene`.
        """
        grid = wavelength_grid(wavelengths)
        check_bands(bands, name="bands", count=len(grid), ndims=(3, 4))
        bands = bands[None] if bands.ndim == 3 else bands
        light = spectral.illuminant(illuminant, wavelengths=grid)
        if isinstance(illuminant, Tensor):
            bands = bands * (light.sum() / illuminant.detach().double().cpu().sum()).item()
        return _in_metres(cls(bands, None, grid, depth, light, luminance))

    @classmethod
    def from_file(
        cls,
        path: str | os.PathLike[str],
        *,
        depth: float | Tensor = 2.0,
        wavelengths: Tensor | None = None,
        illuminant: str | Tensor | spectral.SpectralTable = "D65",
        luminance: float = 1000.0,
    ) -> Scene:
        """A scene from a photograph, taken as sRGB; see `read_picture` and `from_rgb`."""
        image = read_picture(path)
        return cls.from_rgb(image, depth=depth, wavelengths=wavelengths, illuminant=illuminant, luminance=luminance)

    @classmethod
    def from_folder(
        cls,
        folder: str | os.PathLike[str],
        depth_folder: str | os.PathLike[str] | None = None,
        *,
        depth: float | None = None,
        depth_scale: float = 1e-3,
        size: int | tuple[int, int] | None = None,
        wavelengths: Tensor | None = None,
        illuminant: str | Tensor | spectral.SpectralTable = "D65",
        luminance: float = 1000.0,
    ) -> Scene:
        """The photographs of a folder, with their depth maps, as one batch (B,H,W) in natural order of their names.

        Which files these are, and what is done about depth that was not measured, says `kcam.data.PhotoDataset`; all
        stand in memory at once, 12 bytes a pixel. ``PhotoDataset(...).scene(i)`` reads one at a time: it knows their
        names, and they may be of several sizes.

        Args:      depth_folder: of maps of the same names; None if there are none.
                   depth: of photographs without a map [m]. None: 2 m where there is no `depth_folder`; where there is
                   one, all must have maps.
                   depth_scale: metres per count of maps in whole numbers: 1e-3 for millimetres, 1/5000 for TUM's.
                   size: of the longer side [pixels], or (height, width), to which they are cropped: see `resized`.
                   Others: as for `Scene`.
        Raises:    as `PhotoDataset`; ValueError for photographs of several sizes.
        """
        from kcam.data import PhotoDataset

        alike = 2.0 if depth is None else depth
        photos = PhotoDataset(
            folder,
            depth_folder,
            depth=alike if depth_folder is None else depth,
            depth_scale=depth_scale,
            size=size,
        )
        images: list[Tensor] = []
        maps: list[Tensor] = []
        for index, name in enumerate(photos.names):
            image, own, _, _ = photos[index]
            if images and image.shape != images[0].shape:
                (_, height, width), (_, rows, columns) = images[0].shape, image.shape
                raise ValueError(
                    f"a batch has one size: {photos.names[0]} has {height} x {width} pixels, {name} {rows} x "
                    f"{columns}. Crop them to one, size=({min(height, rows)}, {min(width, columns)}), or take them one "
                    "by one: kcam.data.PhotoDataset(...).scene(i)."
                )
            images.append(image)
            maps.append(own)
        return cls.from_rgb(
            torch.stack(images),
            depth=alike if depth_folder is None else torch.stack(maps),
            wavelengths=wavelengths,
            illuminant=illuminant,
            luminance=luminance,
        )

    @classmethod
    def builtin(
        cls,
        name: str,
        size: int | tuple[int, int] | None = None,
        *,
        wavelengths: Tensor | None = None,
        illuminant: str | Tensor | spectral.SpectralTable = "D65",
        luminance: float = 1000.0,
    ) -> Scene:
        """A scene that needs no file and no network, at 2 m, in float32.

        - motorcycle: 500 x 741 with true depth, 2.1 to 5.0 m (Middlebury stereo, Scharstein et al. 2014)
        - astronaut 512 x 512, coffee 400 x 600, chelsea (a cat) 300 x 451: photographs
        - colour_chart: the 24 patches of the ColorChecker with their measured reflectances, 400 x 600
        - star: a Siemens star of 36 periods, black on white, 512 x 512
        - point_grid: points of light, one pixel each, 30 times as bright as white, 64 pixels apart on black, 512 x 512

        Args:      size: the longer side [pixels]; or (height, width), for which a photograph is cropped in its middle.
                   Charts are drawn at that size, photographs resized in linear light.
                   Others: as for `Scene`.
        Raises:    ValueError for an unknown name or a size below 1.
        """
        if name not in BUILTIN:
            raise ValueError(f"unknown scene {name!r}. There are: {', '.join(BUILTIN)}; or use Scene.from_file(path).")
        grid = wavelength_grid(wavelengths)
        light = spectral.illuminant(illuminant, wavelengths=grid)
        if name in PHOTOGRAPHS:
            picture, depth = PHOTOGRAPHS[name]()
            image = torch.tensor(picture).permute(2, 0, 1) / 255
            scene = cls.from_rgb(image, depth=depth, wavelengths=grid, illuminant=light, luminance=luminance)
            return scene if size is None else scene.resized(size)
        draw, shape = CHARTS[name]
        planes, reflectance = draw(*target_shape(size, shape), grid)
        return cls(planes, reflectance * light, grid, illuminant=light, luminance=luminance)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(B, H, W)."""
        batch, _, height, width = self.coefficients.shape
        return batch, height, width

    @property
    def dtype(self) -> torch.dtype:
        """Of the coefficients."""
        return self.coefficients.dtype

    @property
    def device(self) -> torch.device:
        """Of the coefficients."""
        return self.coefficients.device

    def bands(self) -> Tensor:
        """The whole cube of relative radiance, (B,L,H,W): 1.3 GB for 12 megapixels in 28 bands of float32."""
        if self.spectra is None:
            return self.coefficients
        with full_precision(self.device):
            return torch.einsum("bkhw,kl->blhw", self.coefficients, self.spectra)

    def xyz(self) -> Tensor:
        """The scene's colours, (B,3,H,W) CIE XYZ; `luminance` * Y is in cd/m^2. The cube is not formed."""
        weights = spectral.xyz_weights(self.wavelengths).to(self.coefficients)
        with full_precision(self.device):
            if self.spectra is not None:
                weights = self.spectra @ weights
            return torch.einsum("bkhw,kc->bchw", self.coefficients, weights)

    def to_srgb(self) -> Tensor:
        """The picture that an ideal camera without lens would take, (B,3,H,W) sRGB clipped to [0,1], for looking at."""
        return srgb.to_code(spectral.xyz_to_linear_srgb(self.xyz()))

    def to(self, device: torch.device | str | torch.dtype | None = None, dtype: torch.dtype | None = None) -> Scene:
        """The scene on another device or in another floating-point type. What is kept as float64 stays so."""
        if isinstance(device, torch.dtype):
            device, dtype = None, device
        return replace(self, coefficients=self.coefficients.to(device=device, dtype=dtype))

    def with_depth(self, depth: float | Tensor) -> Scene:
        """The same scene at other distances [m]."""
        return _in_metres(replace(self, depth=depth))

    def samples(self, rows: Sequence[int] | Tensor | slice) -> Scene:
        """Some samples of the batch, with the distances that are theirs."""
        planes = self.coefficients[rows]
        if planes.ndim != 4:
            raise TypeError(f"samples of a batch are named in a list, such as [{rows}], got {rows!r}.")
        return self._part(planes, self.depth[rows] if isinstance(self.depth, Tensor) else self.depth)

    def _part(self, coefficients: Tensor, depth: float | Tensor) -> Scene:
        """A part of it, which is not looked at again: a dip of a thousandth of the whole may be all the light here."""
        part = copy.copy(self)
        vars(part).update(coefficients=coefficients, depth=depth)
        return part

    def resized(self, size: int | tuple[int, int]) -> Scene:
        """The scene at another size: the longer side [pixels], or (height, width), for which it is cropped in its
        middle. Colours are filtered in linear light, distances picked.

        Raises:    ValueError for a size below 1.
        """
        shape = target_shape(size, self.shape[1:])
        if shape == self.shape[1:]:
            return self
        depth = fitted(self.depth, shape, pick=True) if _is_map(self.depth) else self.depth
        return replace(self, coefficients=fitted(self.coefficients, shape), depth=depth)

    def low_rank(self, rank: int, *, principal: Tensor | None = None) -> Scene:
        """The scene as `rank` coefficient planes times `rank` spectra: the closest in least squares that stays light.

        principal: `principal_spectra` of what it is a part of; None for its own.

        bands = U S V^T, the first `rank` columns of V kept. Where that would be negative, a pixel keeps only so much of
        the columns after the first, which has one sign, that it is not. With the scene's own rank it is the same scene.

        Raises:    ValueError for a rank below 1. A rank above what the scene can have is that one.
        """
        if not isinstance(rank, Integral) or rank < 1:
            raise ValueError(f"rank must be at least 1, got {rank}. Use a whole number such as rank=3.")
        planes, spectra = self.coefficients, self.spectra
        principal = self.principal_spectra() if principal is None else principal
        directions = principal[:, : min(rank, planes.shape[1])].to(planes, copy=True)
        directions[:, 0].abs_()
        with full_precision(self.device):
            onto = directions if spectra is None else spectra @ directions
            new = torch.einsum("bkhw,kr->brhw", planes, onto)
            brightness = new[:, 0].clamp(min=0)  # of a factored scene that dips below zero, too
            share = torch.ones_like(brightness)
            for direction in directions:
                first = brightness * direction[0]
                rest = torch.einsum("brhw,r->bhw", new[:, 1:], direction[1:])
                most = -first / rest.clamp(max=-torch.finfo(rest.dtype).tiny)  # no NaN gradient where rest is 0
                share = torch.where(first + share * rest < 0, most, share)
        new = torch.cat([brightness[:, None], new[:, 1:] * share[:, None]], dim=1)
        return replace(self, coefficients=new, spectra=directions.T)

    def principal_spectra(self) -> Tensor:
        """Orthogonal spectra (L, L) float64 in columns, those that hold most of the light first; without a gradient."""
        flat = self.coefficients.detach().double().transpose(0, 1).flatten(1)
        gram = flat @ flat.T
        if self.spectra is not None:
            mixing = self.spectra.detach().double()
            gram = mixing.T @ gram @ mixing
        return torch.linalg.eigh(gram).eigenvectors.flip(-1)

    def crop(self, *, top: int, left: int, height: int, width: int) -> Scene:
        """A window of the scene, `height` x `width` pixels. Raises: ValueError unless it lies inside."""
        _, full_height, full_width = self.shape
        if not all(isinstance(number, Integral) for number in (top, left, height, width)):
            raise TypeError(
                f"a window is of whole pixels, got {height} x {width} at row {top}, column {left}. Use int(...)."
            )
        if not (0 <= top < top + height <= full_height and 0 <= left < left + width <= full_width):
            raise ValueError(
                f"a window of {height} x {width} at row {top}, column {left} is not inside the scene's "
                f"{full_height} x {full_width} pixels."
            )
        window = (..., slice(top, top + height), slice(left, left + width))
        depth = self.depth[window] if _is_map(self.depth) else self.depth
        return self._part(self.coefficients[window], depth)

    def __repr__(self) -> str:
        batch, height, width = self.shape
        factors = "" if self.spectra is None else f"{len(self.spectra)} factors x "
        low, high = self.wavelengths.min() * 1e9, self.wavelengths.max() * 1e9
        depth = "depth map"
        if isinstance(self.depth, float):
            depth = f"depth {self.depth:g} m"
        elif self.depth.numel():
            depth = "depth {:.3g}..{:.3g} m".format(*(value.item() for value in self.depth.detach().aminmax()))
        return (
            f"Scene({batch} x {height} x {width}, {factors}{len(self.wavelengths)} bands {low:.0f}..{high:.0f} nm, "
            f"{depth}, {self.luminance:g} cd/m^2, {self.dtype}, {self.device})"
        )


def _check_radiance(planes: Tensor, spectra: Tensor | None) -> None:
    if not planes.numel():
        return
    low, high = (value.item() for value in planes.detach().aminmax())
    if spectra is not None:
        low, high = _product_range(planes.detach(), spectra.detach(), low, high)
    if not (np.isfinite(low) and np.isfinite(high)):
        raise ValueError(f"the radiance runs from {low:g} to {high:g}, expected finite values. Remove NaN and inf.")
    # A factored cube may dip below zero by the error of its factorisation: a thousandth of the brightest is let pass.
    if low < (0 if spectra is None else -1e-3 * high):
        fix = "Undo what was subtracted from it, such as bands * std + mean; or use" if low < -0.1 * high else "Use"
        raise ValueError(f"the radiance goes down to {low:g}, but light is not negative. {fix} .clamp(min=0).")


def _product_range(planes: Tensor, spectra: Tensor, low: float, high: float) -> tuple[float, float]:
    """Lowest and highest radiance of a factored scene; bounds where no factor is negative, which are cheap."""
    lowest, highest = (value.item() for value in spectra.aminmax())
    if (low >= 0 and lowest >= 0) or not np.isfinite([low, high, lowest, highest]).all():
        return low * lowest, high * highest
    ranges = [(spectra.T @ block).aminmax() for item in planes.flatten(2) for block in item.split(_BLOCK, 1)]
    return min(pair.min.item() for pair in ranges), max(pair.max.item() for pair in ranges)


def _in_metres(scene: Scene) -> Scene:
    """A scene that a user made, after a look at its distances."""
    warn_of_millimetres(scene.depth)
    return scene


def _depth_map(depth: float | Sequence[float] | Tensor, planes: Tensor) -> float | Tensor:
    """A float, one number per sample (B,), or a map (B,1,H,W) like the planes, as `Scene` says."""
    values = as_values(depth, name="depth", unit="m")
    if not (values >= LEAST_DISTANCE).all():
        check_distances(values, name="depth")
    batch, _, height, width = planes.shape
    values = as_map(values, shape=(batch, height, width), name="depth")
    if values.ndim == 4:
        return values.to(planes)
    if values.ndim == 0 and differentiated(values):
        return values.to(planes).expand(batch, 1, height, width)
    if values.numel() == 1 and not differentiated(values):
        return float(values)
    return values.to("cpu", torch.float64)


def _is_map(depth: float | Tensor) -> TypeGuard[Tensor]:
    return isinstance(depth, Tensor) and depth.ndim == 4
