"""What a linear choice changes in the noiseless raw, from spectra: no picture is rendered for it.

    E^2 = sum_f tr(A D(f) C(f) D(f)^H),   D_ck = sum_l kappa_cl S_kl (H_l - G_l)

C are the cross-spectra of a scene's planes, mirrored at its borders (a cosine transform), in rings of frequency; H and
G are transfer functions, of which slices through the middle suffice: light that runs more along x sees that along x. A
says how much of each pair of channels a pixel records. With layers of depth each plane is split among them, without
occlusion, and each layer has transfer functions of its own.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from scipy.fft import dctn
from torch import Tensor

from kcam.camera import Camera
from kcam.isp import Clip
from kcam.optics import Imaging, Lens
from kcam.optics.propagation.question import Query
from kcam.optics.rendering.depth import alike
from kcam.optics.rendering.renderer import Renderer
from kcam.optics.source import Points
from kcam.scene import Scene
from kcam.sensor import ColourFilter, DarkCurrent, Exposure, Mosaic, ReadNoise, ShotNoise
from kcam.sensor.mosaic import pattern_tile
from kcam.sensor.noise import Mean

LINEAR = {"blur", "bands", "psf_shape", "renormalise", "kappa", "propagator", "layers"}
"""Changes of an Imaging that act as transfer functions do."""

_OF_PSFS = ("psf_shape", "renormalise", "kappa")  # what changes PSFs, and no transfer function of the optics

_HIDDEN = 1.5  # times the error without occlusion: at edges of depth what is hidden is not added up, but replaced
_CUT = 1.4  # times the error where a window as large as the picture cuts rays off: no slice knows its corners
_AROUND = 4  # pixels around the rays of a PSF, within which there is light that varies with the wavelength
FEW_BANDS = 3
"""Wavelengths of the settings beside which a choice is priced."""

_FINEST, _FINE, _STEP = 2.0**-10, 2.0**-4, 2.0**-7  # cycles per pixel: rings are 1/8 wide below the second, then even


@dataclass(frozen=True)
class _Layered:
    """Of rows that are cut into the same layers: their vergences (Z,), and cross-spectra (B, 2, F, K Z, K Z) of light
    that runs along x, and y.
    """

    vergences: Tensor
    crossed: Tensor


class _Table(NamedTuple):
    """Wavelengths, and transfer functions (Z, L, 2, F)."""

    wavelengths: list[float]
    transfer: Tensor


class Spectra:
    """A batch of scenes before a camera, as spectra; picture: (H, W) of the wholes that they are part of."""

    def __init__(self, camera: Camera, imaging: Imaging, scene: Scene, *, picture: tuple[int, int]) -> None:
        self.imaging, self.scene, self.picture = imaging, scene, picture
        self.weights, self.pairs = _recorded(camera, scene)
        self.frequencies = _rings()
        self.groups = [(rows, scene.samples(rows.tolist())) for rows in alike(scene)]
        self._layered: dict[tuple[int, Any], _Layered] = {}
        self._known: dict[tuple[Any, ...], Tensor] = {}
        self._banks: dict[Any, Tensor] = {}
        self._tables: dict[Any, _Table | None] = {}

    def tabled(self, settings: Mapping[str, Any]) -> bool:
        """Whether transfer functions of all wavelengths are known at once."""
        imaging = self.imaging.changed(**settings)
        vergences = [self._of(index, settings.get("layers")).vergences for index in range(len(self.groups))]
        return all(self._table(imaging, own, self._window(imaging, own)) is not None for own in vergences)

    def energies(self, changes: Mapping[str, Any], against: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
        """For each row: the energy of the difference that changes make, and that of what it is against, (B,)."""
        seen = any(changes.get(name) != against.get(name) for name in _OF_PSFS)
        found = torch.zeros(2, len(self.scene.coefficients), dtype=torch.float64)
        for index, (rows, _) in enumerate(self.groups):
            layered = self._of(index, against.get("layers"))
            # that with the larger window first
            theirs, ours = (self._once(index, layered, own, psfs=seen) for own in (against, changes))
            found[0, rows], found[1, rows] = (self._energy(mixed, layered) for mixed in (ours - theirs, theirs))
            hidden = len(layered.vergences) > 1 and self.imaging.accuracy.occlusion
            found[0, rows] *= (_HIDDEN if hidden else 1.0) ** 2
        return found[0] * (1.0 if self.fits else _CUT) ** 2, found[1]

    def _energy(self, mixed: Tensor, layered: _Layered) -> Tensor:
        """Of transfer functions (C, K Z, 2, F), recorded, (B,)."""
        at_once = mixed.permute(2, 3, 0, 1)  # (2, F, C, K Z)
        half = at_once.mH @ self.pairs.to(mixed.dtype) @ at_once
        return torch.einsum("ofkj,bofjk->b", half, layered.crossed.to(mixed.dtype)).real.clamp(min=0)

    def _of(self, index: int, layers: Any) -> _Layered:
        key = index, str(layers)
        if key not in self._layered:
            scene, imaging = self.groups[index][1], self.imaging.changed(layers=layers)
            planes = imaging.working(scene)
            vergences, shares = imaging.layers_of(scene, planes)
            if shares is not None:
                planes = (planes[:, :, None] * shares[:, None]).flatten(1, 2)
            crossed = torch.stack([_crossed(own, self.frequencies) for own in planes])
            self._layered[key] = _Layered(vergences, crossed)
        return self._layered[key]

    def _once(self, index: int, layered: _Layered, changes: Mapping[str, Any], *, psfs: bool) -> Tensor:
        key = index, psfs, *sorted(changes.items())
        if key not in self._known:
            self._known[key] = self._mixed(layered, changes, psfs=psfs)
        return self._known[key]

    def _mixed(self, layered: _Layered, changes: Mapping[str, Any], *, psfs: bool) -> Tensor:
        """Of each channel for each plane in each layer, (C, K Z, 2, F); psfs: as PSFs of its window have them."""
        imaging, scene = self.imaging.changed(**changes), self.scene
        groups = imaging.psf_wavelengths(scene.wavelengths)
        transfer = self._transfer(imaging, layered.vergences, groups, psfs=psfs)  # (Z, G, 2, F)
        spectra = None if scene.spectra is None else scene.spectra.double().cpu()
        owner = imaging.groups(scene.wavelengths)
        shaped = torch.empty(1, transfer.shape[1], 1, 1, dtype=torch.float64)
        mixing = Renderer(shaped, spectra=spectra, weights=self.weights, picture=(1, 1), owner=owner).mixing()
        return torch.einsum("ckg,zgof->ckzof", mixing.to(transfer.dtype), transfer).flatten(1, 2)

    def _transfer(self, imaging: Imaging, vergences: Tensor, wavelengths: Tensor, *, psfs: bool) -> Tensor:
        """Slices of transfer functions along x and y, (Z, G, 2, F)."""
        if not imaging.accuracy.blur:
            return torch.ones(len(vergences), 1, 2, len(self.frequencies), dtype=torch.complex128)
        window = self._window(imaging, vergences)
        if not psfs and (known := self._table(imaging, vergences, window)) is not None:
            places = [known.wavelengths.index(one) for one in wavelengths.tolist()]
            return known.transfer[:, places]
        bank = self._bank(imaging, vergences, wavelengths, window)
        sums = bank.sum((-2, -1), dtype=torch.float64).cpu()
        slices = []
        for dim in (-2, -1):
            along = bank.sum(dim, dtype=torch.float64).cpu()
            x = torch.arange(along.shape[-1], dtype=torch.float64) - along.shape[-1] // 2
            slices.append(along.to(torch.complex128) @ torch.exp(-2j * math.pi * x[:, None] * self.frequencies))
        found = torch.stack(slices, dim=2)
        return found / sums[..., None, None] if imaging.accuracy.renormalise else found

    def _window(self, imaging: Imaging, vergences: Tensor) -> tuple[int, int]:
        return imaging.psf_window(self.scene.wavelengths, vergences=vergences, picture=self.picture)

    @functools.cached_property
    def fits(self) -> bool:
        """Whether the window of a whole PSF cuts nothing but diffraction off."""
        vergences = (1 / torch.as_tensor(self.scene.depth, dtype=torch.float64)).flatten().cpu()
        ends = torch.stack([vergences.min(), vergences.max()])
        query = self._query(self.imaging, ends, self.scene.wavelengths, self._window(self.imaging, ends))
        return query is None or _inside(query)

    def _query(self, imaging: Imaging, vergences: Tensor, wavelengths: Tensor, window: tuple[int, int]) -> Query | None:
        if not isinstance(lens := imaging.lens, Lens):
            return None
        pixels = imaging.pixels(window, torch.empty(0, dtype=torch.float64))
        return lens.question(Points(vergences), wavelengths, pixels, imaging.accuracy)

    def _table(self, imaging: Imaging, vergences: Tensor, window: tuple[int, int]) -> _Table | None:
        """Transfer functions of all wavelengths for which PSFs may stand, where optics know them without PSFs, and the
        window cuts nothing but diffraction off.
        """
        key = (imaging.accuracy.propagator, imaging.accuracy.kappa, tuple(vergences.tolist()), window)
        if key not in self._tables:
            own = self.scene.wavelengths
            counts = {imaging.accuracy.bands, *even_counts(len(own)), FEW_BANDS, None}
            every = [self.imaging.changed(bands=count).psf_wavelengths(own) for count in counts]
            wavelengths = torch.cat(every).unique()
            found, query = None, self._query(imaging, vergences, wavelengths, window)
            if query is not None and _inside(query):
                found = imaging.accuracy.row(query).transfer(query, self.frequencies)
            known = None if found is None else found.cpu().to(torch.complex128)
            self._tables[key] = None if known is None else _Table(wavelengths.tolist(), known)
        return self._tables[key]

    def _bank(self, imaging: Imaging, vergences: Tensor, wavelengths: Tensor, window: tuple[int, int]) -> Tensor:
        """PSFs (Z, G, h, w); those of a smaller window than was asked for before are the middle of what is known."""
        recipe = imaging.accuracy
        key = (recipe.propagator, recipe.kappa, tuple(vergences.tolist()), tuple(wavelengths.tolist()))
        known = self._banks.get(key)
        if known is None or any(n < m for n, m in zip(known.shape[-2:], window, strict=True)):
            pixels = imaging.pixels(window, imaging.working(self.scene)[:, :0])
            asked = wavelengths
            if isinstance(imaging.lens, Lens) and imaging.lens.symmetric:  # with its ends any part finds the same rings
                asked = torch.cat([wavelengths, torch.stack(self.scene.wavelengths.aminmax())])
            found = imaging.bank(Points(vergences), asked, pixels)
            known = self._banks[key] = found[:, : len(wavelengths)]
        for dim, length in zip((-2, -1), window, strict=True):
            known = known.narrow(dim, known.shape[dim] // 2 - length // 2, length)
        return known


def _inside(query: Query) -> bool:
    """Whether all rays fall well inside the window."""
    return float(query.displacement.max()) < (min(query.shape) // 2 - _AROUND) * query.pixel_pitch


def even_counts(total: int) -> list[int]:
    """Numbers of groups, ascending, each about twice the one before; those into which `total` divides evenly first.

    Groups of one size are a better quadrature than more groups of two sizes: of 28 bands, 7 are closer to all than 12
    are, and 14 than 23.
    """
    counts = [1]
    while counts[-1] < total:
        near = range(math.ceil(1.5 * counts[-1]), math.floor(2.5 * counts[-1]) + 1)
        even = [count for count in near if total % count == 0]
        counts.append(even[-1] if even else 2 * counts[-1])
    return [count for count in counts if count < total]


def linear(camera: Camera) -> bool:
    """Whether a camera's noiseless raw is linear in light that is not clipped, and its PSF one all over."""
    known = (Clip, ColourFilter, DarkCurrent, Exposure, Imaging, Mosaic, ReadNoise, ShotNoise)
    stages = [stage.stage if isinstance(stage, Mean) else stage for stage in camera]
    one = all(getattr(stage.lens, "positions", None) is None for stage in stages if isinstance(stage, Imaging))
    return one and all(isinstance(stage, known) for stage in stages)


def _recorded(camera: Camera, scene: Scene) -> tuple[Tensor | None, Tensor]:
    """Weights (C, L) of a filter's channels, or None; and the mean over pixels of what each records of two, (C, C)."""
    weights, pairs = None, torch.eye(len(scene.wavelengths), dtype=torch.float64)
    for stage in camera:
        if isinstance(stage, ColourFilter):
            weights = stage.contraction(scene.wavelengths).detach().double().cpu()
            pairs = torch.eye(len(weights), dtype=torch.float64)
            if stage.is_tile:
                alpha = stage.alpha().detach().double().cpu().flatten(0, 1)
                pairs = alpha.T @ alpha / len(alpha)
        elif isinstance(stage, Mosaic):
            pairs = pattern_tile(stage.pattern).flatten().bincount(minlength=len(pairs)).double().diag()
    return weights, pairs


def _rings() -> Tensor:
    """Frequencies in the middle of rings, (F,) ascending from 0 [cycles per pixel]."""
    fine = _FINEST * 2 ** (torch.arange(0, 8 * round(math.log2(_FINE / _FINEST)), dtype=torch.float64) / 8)
    even = torch.arange(_FINE, math.sqrt(0.5) + _STEP, _STEP, dtype=torch.float64)
    return torch.cat([torch.zeros(1, dtype=torch.float64), fine, even])


def _crossed(planes: Tensor, frequencies: Tensor) -> Tensor:
    """Cross-spectra of planes (K, H, W), mirrored at the borders: (2, F, K, K) of light that runs along x, and y."""
    spectrum = torch.as_tensor(dctn(planes.cpu().double().numpy(), axes=(-2, -1), norm="ortho"))
    fy, fx = (torch.arange(n, dtype=torch.float64) / (2 * n) for n in planes.shape[-2:])
    radius = torch.hypot(fy[:, None], fx)
    ring = torch.bucketize(radius.flatten(), (frequencies[1:] + frequencies[:-1]) / 2)
    label = ring + len(frequencies) * (fy[:, None] > fx).flatten()
    order = label.argsort(stable=True)
    counts = label.bincount(minlength=2 * len(frequencies)).tolist()
    parts = spectrum.flatten(1)[:, order].split(counts, dim=1)
    return torch.stack([part @ part.T for part in parts]).unflatten(0, (2, -1))
