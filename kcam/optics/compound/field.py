"""The PSFs of a real lens at places of its sensor: what a picture with it asks for."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from kcam.optics.compound.distortion import Even, ImageHeights, chebyshev_radii
from kcam.optics.compound.images import CLOSE, QUICK, QUICK_ERROR, Closeness, Frame, areas, axis_light, images
from kcam.optics.compound.pupil import PupilFit
from kcam.optics.compound.table import PupilTable
from kcam.optics.numerics import chebyshev_between, lagrange_weights
from kcam.optics.source import PixelGrid

_LOOKED = 9  # heights at which a window is asked for
_COLOURS = (5, 7, 10, 14, 20)  # wavelengths at which PSFs are computed
COLOUR_ERROR = 1e-2
OUTSIDE = 5e-3
"""Share of the light that the default window may leave out; it is put back into the window, see `Imaging`."""
_HALVINGS = 30
_FEWEST = 64  # samples along a pupil
KEPT = 2e8  # bytes of PSFs that are kept


def bank(
    fitted: PupilFit,
    wavelengths: Tensor,
    directions: Tensor,
    moved: Tensor,
    pixels: PixelGrid,
    *,
    how: Closeness = CLOSE,
    whole: bool = False,
) -> Tensor:
    """PSFs (F, Z, L, h, w) of F places, moved (F, Z, L) [m] along their directions (F, 2) on the sensor.

    fitted: of F + 1 x Z x L pupils; those on the axis come last, and their light counts as 1.
    """
    places, vergences, count = moved.shape
    towards = directions.repeat_interleave(vergences, dim=0)
    of_place, axis = torch.arange(len(fitted.centre)).view(-1, count).split([places * vergences, vergences])
    light = axis_light(fitted, axis, wavelengths).repeat(places, 1)
    offsets = moved.view(-1, count, 1) * towards[:, None]
    found = images(fitted, of_place, towards, wavelengths, offsets, pixels, relative_to=light, how=how, whole=whole)
    return found.view(places, vergences, count, *pixels.shape)


@dataclass(frozen=True)
class FieldPSFs:
    """PSFs of places of the sensor, for some vergences (Z,) [1/m] and wavelengths (L,) [m]."""

    table: PupilTable
    image_heights: ImageHeights
    vergences: Tensor
    wavelengths: Tensor
    reach: float  # of places, from the axis [m]
    lateral_colour: bool = True

    kept: dict[tuple[object, ...], tuple[Tensor, Tensor, float]] = field(default_factory=dict, repr=False)
    kept_banks: dict[tuple[object, ...], Tensor] = field(default_factory=dict, repr=False)

    def at_wavelengths(self, wavelengths: Tensor, *, lateral_colour: bool = True) -> FieldPSFs:
        """Of others (L,) [m] in the same range; see `source.FieldPSFs`."""
        wavelengths = wavelengths.to(torch.float64)
        return replace(self, wavelengths=wavelengths, lateral_colour=lateral_colour, kept={}, kept_banks={})

    def _fitted(self, radii: Tensor, wavelengths: Tensor) -> PupilFit:
        """Pupils of places at radii (F,) from the axis, and on it: F + 1 x Z x L."""
        grid = torch.meshgrid(self._heights(radii), self.vergences, wavelengths, indexing="ij")
        return self.table.at(*(part.flatten() for part in grid))

    def _heights(self, radii: Tensor) -> Tensor:
        """Of the object points whose images lie so far from the axis (F,), and of that on it: (F + 1,)."""
        return torch.cat([radii * self.image_heights.over_radius.at(radii**2), radii.new_zeros(1)])

    def bank(self, places: Tensor, pixels: PixelGrid, *, whole: bool = False, mixing: Tensor | None = None) -> Tensor:
        """PSFs (F, Z, L, h, w) of what falls at places (F, 2) [m] by the chief ray of the focus, relative to the light
        of a point on the axis. whole, mixing: see `source.FieldPSFs`.

        Places that mirror each other share their PSF; of many wavelengths the PSFs' pixels are polynomials through
        those of a few (`colours`). Without gradients they are kept for another picture, up to `KEPT` bytes.
        """
        key = (pixels, whole, _bytes(mixing), _bytes(places))
        if key in self.kept_banks:
            return self.kept_banks[key]
        found = self._mirrored(places, pixels, whole=whole, mixing=mixing).to(pixels.device)
        held = sum(bank.nbytes for bank in self.kept_banks.values())
        if not found.requires_grad and held + found.nbytes <= KEPT:
            self.kept_banks[key] = found
        return found

    def _mirrored(self, places: Tensor, pixels: PixelGrid, *, whole: bool, mixing: Tensor | None) -> Tensor:
        height, width = pixels.shape
        odd = replace(pixels, shape=(height + 1 - height % 2, width + 1 - width % 2))  # about the middle
        own, which = (places.abs() / (1e-6 * pixels.pitch)).round().unique(dim=0, return_inverse=True)
        nodes, shares, _ = self.colours(pixels, mixing)
        psfs = self._bank(own * (1e-6 * pixels.pitch), nodes, odd, whole=whole)
        if len(nodes) < len(self.wavelengths):
            psfs = torch.einsum("ln,fznhw->fzlhw", shares.to(psfs), psfs)
        mirrored = [
            psf.flip([axis for axis, side in ((-1, x), (-2, y)) if side < 0])
            for psf, (x, y) in zip(psfs[which], places.tolist(), strict=True)
        ]
        return torch.stack(mirrored)[..., :height, :width]

    def _bank(self, places: Tensor, wavelengths: Tensor, pixels: PixelGrid, *, whole: bool = False) -> Tensor:
        radii = places.norm(dim=1)
        away = radii.clamp(min=1e-150)[:, None]
        towards = torch.where(radii[:, None] > 0, places / away, places.new_tensor([0.0, 1.0]))
        fitted = self._fitted(radii, wavelengths)
        chief = fitted.chief.view(len(places) + 1, len(self.vergences), -1)[:-1]
        # what is above the axis falls below it: heights of chief rays count along the object's direction
        if not self.lateral_colour:
            middle = self._fitted(radii, (self.wavelengths.min() + self.wavelengths.max())[None] / 2).chief
            chief = middle.view(len(places) + 1, len(self.vergences), 1)[:-1].expand_as(chief)
        moved = chief + radii[:, None, None]
        return bank(fitted, wavelengths, -towards, moved, pixels, how=QUICK, whole=whole)

    def colours(self, pixels: PixelGrid, mixing: Tensor | None = None) -> tuple[Tensor, Tensor, float]:
        """Wavelengths (n,) at which PSFs are computed, and what each gives to those that are asked for, (L, n): as few
        as leave `COLOUR_ERROR` of the light in what the picture adds up of them; and what these leave.
        """
        key = (pixels, _bytes(mixing))
        if key not in self.kept:
            self.kept[key] = self._few(pixels, mixing)
        return self.kept[key]

    @torch.no_grad()
    def _few(self, pixels: PixelGrid, mixing: Tensor | None) -> tuple[Tensor, Tensor, float]:
        every = torch.eye(len(self.wavelengths), dtype=torch.float64)
        if len(self.wavelengths) <= _COLOURS[0]:
            return self.wavelengths, every, 0.0
        places = torch.tensor([[0.0, 0.0], [0.42, 0.56]], dtype=torch.float64) * self.reach
        mixing = every if mixing is None else mixing.double().cpu()
        mixing = mixing / mixing.abs().sum(1, keepdim=True).clamp(min=1e-300)
        truth = torch.einsum("ml,fzlhw->fzmhw", mixing.to(pixels.dtype), self._bank(places, self.wavelengths, pixels))
        for n in _COLOURS:
            if n >= len(self.wavelengths):
                break
            nodes = chebyshev_between(*self.wavelengths.aminmax(), n)
            shares = lagrange_weights(nodes, self.wavelengths)
            found = torch.einsum("mn,fznhw->fzmhw", (mixing @ shares).to(truth), self._bank(places, nodes, pixels))
            off = float((found - truth).abs().sum((-2, -1)).max())
            if off < COLOUR_ERROR:
                return nodes, shares, off
        return self.wavelengths, every, 0.0

    @torch.no_grad()
    def deviations(self, pixels: PixelGrid, *, mixing: Tensor | None = None) -> dict[str, float]:
        """What PSFs may be off by, of their light: see `field.FieldEstimate`."""
        places = torch.tensor([[0.0, 0.0], [0.54, 0.72]], dtype=torch.float64) * self.reach
        psfs = self.bank(places, pixels, mixing=mixing)
        radii = places.norm(dim=1)
        fitted = self._fitted(radii, self.wavelengths)
        frame = Frame.upright(fitted)
        light = areas(fitted, frame).view(3, len(self.vergences), -1)
        lost = 1 - psfs.sum((-2, -1)).double() / (light[:2] / light[2:])
        pupils = self.table.deviation + 2 * math.pi * float(
            (fitted.residual.view(-1, len(self.wavelengths)) / self.wavelengths).max()
        )
        return {
            "pupils": pupils,
            "colours": self.colours(pixels, mixing)[2],
            "sampling": QUICK_ERROR,
            "outside": float(lost.max().clamp(min=0)),
        }

    def undistorted(self, places: Tensor) -> Tensor:
        """Where a lens without distortion would bring what falls at places (..., 2) [m]."""
        magnified = self.image_heights.scale * self.image_heights.over_radius.at(places.square().sum(-1))
        return places * magnified[..., None]

    def illumination(self, places: Tensor) -> Tensor:
        """Irradiance of an even scene at places (..., 2) [m], over that on the axis: at the middle wavelength and
        vergence, by a smooth curve, as what varies is to be divided out.
        """
        return self._illumination.at(places.square().sum(-1))

    @functools.cached_property
    def _illumination(self) -> Even:
        reach = max(self.reach, 1e-9)
        radii = chebyshev_radii(reach)
        heights = self._heights(radii)
        middle = (part[len(part) // 2].expand(len(heights)) for part in (self.vergences, self.wavelengths))
        fitted = self.table.at(heights, *middle)
        light = areas(fitted, Frame.upright(fitted))
        return Even.through(light[:-1] / light[-1], radii, reach=reach)

    @torch.no_grad()
    def blur(self) -> float:
        """How far rays fall from where they should, at most, over all heights in the table [m]."""
        return float(self._spread[0].max())

    @torch.no_grad()
    def points(self, pixels: PixelGrid) -> float:
        """Points of the transform that one PSF takes, about: for a planner."""
        slopes, areas = self._spread
        shortest = float(self.wavelengths.min())
        per_pixel = 2 * float((areas / math.pi).sqrt().max()) * pixels.pitch / shortest
        reach = max(pixels.shape) / 2 + QUICK.margin + float(slopes.max()) / pixels.pitch
        return max(_FEWEST, QUICK.kappa * reach * max(1.0, per_pixel)) ** 2

    @torch.no_grad()
    def window(self, pixels: PixelGrid) -> tuple[int, int]:
        """The window that holds all but `OUTSIDE` of the light of any height in the table.

        A rim of length P around an area A sends the share lambda d P / (2 pi^2 A r) beyond a radius r, see
        `Lens.window`; of each ray that falls x from the middle, what lies beyond r - x.
        """
        slopes, area = self._spread
        colours = self.wavelengths.repeat(len(slopes) // len(self.wavelengths))
        # the rim of an area is that of a disc at least: 2 sqrt(pi area)
        tail = (colours * (math.pi / area).sqrt() / math.pi**2)[:, None]
        low, high = slopes.new_zeros(len(slopes), 1), slopes.amax(1, keepdim=True) + tail / OUTSIDE
        for _ in range(_HALVINGS):
            radius = (low + high) / 2
            left = (radius - slopes).clamp(min=1e-12)
            beyond = (tail / left).clamp(max=1).mean(1, keepdim=True)
            low, high = torch.where(beyond > OUTSIDE, radius, low), torch.where(beyond > OUTSIDE, high, radius)
        side = 2 * math.ceil(float(high.max()) / pixels.pitch) + 1
        return side, side

    @functools.cached_property
    def _spread(self) -> tuple[Tensor, Tensor]:
        """How far shares of the light of some nodes fall from where they should [m], and the areas of their pupils."""
        radii = torch.linspace(0, self.reach, _LOOKED if self.reach else 1, dtype=torch.float64)
        fitted = self._fitted(radii, self.wavelengths)
        frame = Frame.upright(fitted)
        own = torch.cat([radii, radii.new_zeros(1)]).repeat_interleave(len(self.vergences) * len(self.wavelengths))
        return frame.slopes + (fitted.chief + own).abs()[:, None], areas(fitted, frame)


def _bytes(values: Tensor | None) -> bytes | None:
    return None if values is None else values.detach().cpu().numpy().tobytes()
