"""The PSFs of thin elements at places of the sensor: what a picture over their field asks for."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from kcam.optics.banks import OUTSIDE, Banks, window_side
from kcam.optics.propagation.grid import samples_by_rule
from kcam.optics.propagation.off_axis import ERROR, Seen, off_axis_psf, relative_illumination
from kcam.optics.propagation.question import Query
from kcam.optics.source import PixelGrid, Points

_SHARES = 100  # of the light, of which it is known how far they fall
_LOOKED = 5  # places along each direction at which a window is asked for
_MODEL = 1 / 3  # of the kernel's phase error: of the light; measured
_EACH = 24.0  # points of a transform for each sample of a pupil: 21 to 37, of ten lenses


@dataclass(frozen=True)
class ThinFieldPSFs:
    """PSFs of places of the sensor, for the vergences (Z,) and wavelengths (L,) of a query; its pixels do not count.

    reach: of places, from the axis [m].
    """

    query: Query
    reach: float

    def bank(
        self,
        places: Tensor,
        pixels: PixelGrid,
        *,
        whole: bool = False,
        mixing: Tensor | None = None,
        colours: float = math.inf,
    ) -> Tensor:
        """PSFs (F, Z, L, h, w) of what the chief ray brings to places (F, 2) [m]: see `banks.Banks`."""
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
        """Whether PSFs of places that mirror each other in x or y do so too."""
        return self._banks.mirrored

    @functools.cached_property
    def _banks(self) -> Banks:
        lens = self.query.lens
        plain = not lens.has_pixels
        return Banks(self._bank, self.query.wavelengths, self.reach, mirrored=plain and lens.even, few=plain)

    def _bank(self, places: Tensor, wavelengths: Tensor, pixels: PixelGrid, whole: bool) -> Tensor:
        vergences = self.query.vergences
        points = Points(vergences.repeat(len(places)), places.repeat_interleave(len(vergences), dim=0))
        query = replace(self.query, points=points, grid=pixels, wavelengths=wavelengths, whole=True)
        found = off_axis_psf(query).unflatten(0, (len(places), -1))
        if whole:
            light = relative_illumination(self._seen(places))[:, None, None].to(found)
            found = found * (light / found.sum((-2, -1)))[..., None, None]
        return found

    def _seen(self, places: Tensor) -> Query:
        """The query of one point for each place."""
        return replace(self.query, points=Points(self.query.vergences[:1].expand(len(places)), places))

    def points(self, pixels: PixelGrid) -> float:
        """Points of the transforms that one PSF takes, about: for a planner."""
        query = self.query
        count = max(samples_by_rule(replace(query, grid=pixels), index) for index in range(len(query.wavelengths)))
        return _EACH * float(count) ** 2

    def at_wavelengths(self, wavelengths: Tensor, *, lateral_colour: bool = True) -> ThinFieldPSFs:
        """Of others (L,) [m]; chief rays of all wavelengths fall together, with lateral colour or without."""
        return replace(self, query=replace(self.query, wavelengths=wavelengths.to(self.query.wavelengths)))

    def at_vergences(self, vergences: Tensor) -> ThinFieldPSFs:
        """Of others (Z,) [1/m]."""
        return replace(self, query=replace(self.query, points=Points(vergences.to(self.query.vergences))))

    def undistorted(self, places: Tensor) -> Tensor:
        """The places: chief rays go straight on."""
        return places

    def illumination(self, places: Tensor) -> Tensor:
        """About the irradiance of an even scene at places (..., 2) [m], over that on the axis: cos^4."""
        return (1 + places.square().sum(-1) / self.query.sensor_distance.to(places.device) ** 2) ** -2

    @torch.no_grad()
    def window(self, pixels: PixelGrid) -> tuple[int, int]:
        """The window that holds all but `OUTSIDE` of the light of any place; see `Lens.window`."""
        query, lens = self.query, self.query.lens
        around = torch.tensor([[0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [-1.0, 1.0]], dtype=torch.float64)
        around = around[: 1 if lens.symmetric else 4]
        slopes, tails = [], []
        scattered = query.spread(OUTSIDE / 10) if query.has_rings else 0 * query.wavelengths
        scattered = (scattered + lens.pixel_phase_displacement(query.wavelengths)).to(query.device)
        for share in torch.linspace(0, 1, _LOOKED if self.reach else 1).tolist():
            for place in share * self.reach * around / around.norm(dim=1, keepdim=True):
                seen = Seen(query, place.to(query.device))
                far = torch.linalg.vector_norm(seen.slopes(query.vergences), dim=2).sort(dim=-1).values
                ranks = ((torch.arange(_SHARES) + 0.5) / _SHARES * far.shape[-1]).long()
                slopes.append((far[..., ranks] + seen.stretch * scattered[:, None, None]).flatten(0, 1))
                scale = seen.stretch * float(query.sensor_distance) * lens.rim_per_area() / (2 * math.pi**2)
                tails.append(scale * query.wavelengths.to(far).repeat_interleave(len(query.vergences)))
        side = window_side(torch.cat(slopes), torch.cat(tails)[:, None], pitch=pixels.pitch)
        return side, side

    @torch.no_grad()
    def deviations(self, pixels: PixelGrid, *, colours: float = math.inf) -> dict[str, float]:
        """What PSFs may be off by, of their light: see `field.FieldEstimate`. pupils: by the kernel, which is good to
        the first order in either of the place in the pupil and that in the window: pi a^2 r^2 / (lambda R0^3).
        """
        query = self.query
        places = torch.tensor([[0.0, 0.0], [0.54, 0.72]], dtype=torch.float64, device=query.device) * self.reach
        psfs = self.bank(places, pixels, colours=colours).double()
        lost = 1 - psfs.sum((-2, -1)) / relative_illumination(self._seen(places))[:, None, None]
        y, x = (
            (torch.arange(n, dtype=torch.float64, device=psfs.device) - n // 2) * pixels.pitch for n in pixels.shape
        )
        r2 = (psfs * (x**2 + y[:, None] ** 2)).sum((-2, -1)) / psfs.sum((-2, -1))
        far = torch.sqrt(places.square().sum(1) + query.sensor_distance**2)[:, None, None]
        phase = math.pi * query.semi_aperture**2 * r2 / (query.wavelengths.to(r2) * far**3)
        return {
            "pupils": min(1.0, _MODEL * float(phase.max())),
            "sampling": ERROR,
            "outside": float(lost.max().clamp(min=0)),
        }
