"""The PSFs of a real lens at places of its sensor: what a picture with it asks for."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from kcam.optics.banks import Banks, window_side
from kcam.optics.compound.distortion import Even, ImageHeights, chebyshev_radii
from kcam.optics.compound.images import CLOSE, QUICK, QUICK_ERROR, Closeness, Frame, areas, images, light
from kcam.optics.compound.pupil import PupilFit
from kcam.optics.compound.table import PupilTable
from kcam.optics.source import PixelGrid

_LOOKED, _COLOURS = 9, 5  # heights and wavelengths at which a window is asked for
_FEWEST = 64  # samples along a pupil


def bank(
    fitted: PupilFit,
    wavelengths: Tensor,
    directions: Tensor,
    moved: Tensor,
    pixels: PixelGrid,
    *,
    how: Closeness = CLOSE,
    whole: bool = False,
    unit: Tensor | None = None,
) -> Tensor:
    """PSFs (F, Z, L, h, w) of F places, moved (F, Z, L) [m] along their directions (F, 2) on the sensor.

    fitted: of F + 1 x Z x L pupils; those on the axis come last, and their light counts as 1. unit: that light, (Z, L),
    if it is known.
    """
    places, vergences, count = moved.shape
    towards = directions.repeat_interleave(vergences, dim=0)
    of_place, axis = torch.arange(len(fitted.centre)).view(-1, count).split([places * vergences, vergences])
    unit = (light(fitted, axis, wavelengths) if unit is None else unit).repeat(places, 1)
    energy = light(fitted, of_place, wavelengths) if whole else None
    offsets = moved.view(-1, count, 1) * towards[:, None]
    found = images(fitted, of_place, towards, wavelengths, offsets, pixels, relative_to=unit, how=how, whole=energy)
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
    middle: Tensor | None = None  # wavelength whose light illuminates [m], () of those that were traced
    illuminates: Even | None = None  # which takes as long to know as a PSF
    spreads: dict[tuple[float, ...], tuple[Tensor, Tensor]] = field(default_factory=dict, repr=False)
    units: dict[tuple[float, ...], Tensor] = field(default_factory=dict, repr=False)
    # without graphs, by vergences and wavelengths, for all that are traced

    def at_wavelengths(self, wavelengths: Tensor, *, lateral_colour: bool = True) -> FieldPSFs:
        """Of others (L,) [m] in the same range; see `source.FieldPSFs`. They illuminate alike."""
        known = None if torch.is_grad_enabled() else self._illumination
        own = wavelengths.to("cpu", torch.float64)
        return replace(self, wavelengths=own, lateral_colour=lateral_colour, middle=self._middle, illuminates=known)

    def at_vergences(self, vergences: Tensor) -> FieldPSFs:
        """Of others (Z,) [1/m] in the same range; they illuminate alike."""
        known = None if torch.is_grad_enabled() else self._illumination
        return replace(self, vergences=vergences.to("cpu", torch.float64), illuminates=known)

    @property
    def _middle(self) -> Tensor:
        return self.wavelengths[len(self.wavelengths) // 2] if self.middle is None else self.middle

    def _fitted(self, radii: Tensor, wavelengths: Tensor) -> PupilFit:
        """Pupils of places at radii (F,) from the axis, and on it: F + 1 x Z x L."""
        grid = torch.meshgrid(self._heights(radii), self.vergences, wavelengths, indexing="ij")
        return self.table.at(*(part.flatten() for part in grid))

    def _heights(self, radii: Tensor) -> Tensor:
        """Of the object points whose images lie so far from the axis (F,), and of that on it: (F + 1,)."""
        return torch.cat([radii * self.image_heights.over_radius.at(radii**2), radii.new_zeros(1)])

    def bank(
        self,
        places: Tensor,
        pixels: PixelGrid,
        *,
        whole: bool = False,
        mixing: Tensor | None = None,
        colours: float = math.inf,
    ) -> Tensor:
        """PSFs (F, Z, L, h, w) of what falls at places (F, 2) [m] by the chief ray of the focus, relative to the light
        of a point on the axis: see `banks.Banks`.
        """
        return self._banks.bank(places, pixels, whole=whole, mixing=mixing, colours=colours)

    @property
    def fewer_colours(self) -> tuple[int, ...]:
        """How many wavelengths may stand for all."""
        return self._banks.fewer

    @property
    def held(self) -> int:
        """Bytes of the PSFs that are kept."""
        return self._banks.held

    @property
    def mirrored(self) -> bool:
        """PSFs of places that mirror each other in x or y do so too."""
        return True

    @functools.cached_property
    def _banks(self) -> Banks:
        return Banks(self._bank, self.wavelengths, self.reach)

    def _bank(self, places: Tensor, wavelengths: Tensor, pixels: PixelGrid, whole: bool) -> Tensor:
        places = places.cpu()
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
        unit = None if torch.is_grad_enabled() else self._on_axis(wavelengths)
        return bank(fitted, wavelengths, -towards, moved, pixels, how=QUICK, whole=whole, unit=unit)

    def _on_axis(self, wavelengths: Tensor) -> Tensor:
        """Light of points on the axis, (Z, L), kept."""
        key = *self.vergences.tolist(), *wavelengths.tolist()
        if key not in self.units:
            fitted = self._fitted(wavelengths[:0], wavelengths)
            nodes = torch.arange(len(fitted.centre)).view(-1, len(wavelengths))
            self.units[key] = light(fitted, nodes, wavelengths)
        return self.units[key]

    @torch.no_grad()
    def deviations(self, pixels: PixelGrid, *, colours: float = math.inf) -> dict[str, float]:
        """What PSFs may be off by, of their light: see `field.FieldEstimate`."""
        places = torch.tensor([[0.0, 0.0], [0.54, 0.72]], dtype=torch.float64) * self.reach
        psfs = self.bank(places, pixels, colours=colours).cpu()
        radii = places.norm(dim=1)
        fitted = self._fitted(radii, self.wavelengths)
        frame = Frame.upright(fitted)
        all_of_it = areas(fitted, frame).view(3, len(self.vergences), -1)
        lost = 1 - psfs.sum((-2, -1)).double() / (all_of_it[:2] / all_of_it[2:])
        pupils = self.table.deviation + 2 * math.pi * float(
            (fitted.residual.view(-1, len(self.wavelengths)) / self.wavelengths).max()
        )
        return {
            "pupils": pupils,
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
        if self.illuminates is not None:
            return self.illuminates
        reach = max(self.reach, 1e-9)
        radii = chebyshev_radii(reach)
        heights = self._heights(radii)
        middle = self.vergences[len(self.vergences) // 2], self._middle
        fitted = self.table.at(heights, *(one.expand(len(heights)) for one in middle))
        passed = areas(fitted, Frame.upright(fitted))
        return Even.through(passed[:-1] / passed[-1], radii, reach=reach)

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
        """The window that holds all but `OUTSIDE` of the light of any height in the table, from the farthest and the
        nearest: what lies between is less out of focus than one of them.

        A rim of length P around an area A sends the share lambda d P / (2 pi^2 A r) beyond a radius r, see
        `Lens.window`; of each ray that falls x from the middle, what lies beyond r - x.
        """
        slopes, area = self._spread
        colours = self._looked.repeat(len(slopes) // len(self._looked))
        # the rim of an area is that of a disc at least: 2 sqrt(pi area)
        tail = (colours * (math.pi / area).sqrt() / math.pi**2)[:, None]
        side = window_side(slopes, tail, pitch=pixels.pitch)
        return side, side

    @property
    def _looked(self) -> Tensor:
        """Wavelengths at which a window is asked for: some of them, the shortest and the longest too."""
        index = torch.linspace(0, len(self.wavelengths) - 1, min(_COLOURS, len(self.wavelengths))).round().long()
        return self.wavelengths.sort().values[index]

    @property
    def _spread(self) -> tuple[Tensor, Tensor]:
        """How far shares of the light of some nodes fall from where they should [m], and the areas of their pupils."""
        ends = torch.stack([*self.vergences.aminmax()]).unique()
        key = *ends.tolist(), *self._looked.tolist()
        if key not in self.spreads:
            self.spreads[key] = replace(self, vergences=ends)._spread_of_all()
        return self.spreads[key]

    def _spread_of_all(self) -> tuple[Tensor, Tensor]:
        radii = torch.linspace(0, self.reach, _LOOKED if self.reach else 1, dtype=torch.float64)
        fitted = self._fitted(radii, self._looked)
        frame = Frame.upright(fitted)
        own = torch.cat([radii, radii.new_zeros(1)]).repeat_interleave(len(self.vergences) * len(self._looked))
        return frame.slopes + (fitted.chief + own).abs()[:, None], areas(fitted, frame)
