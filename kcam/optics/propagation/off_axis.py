"""PSFs off the axis: thin screens in one plane, exact paths from the object point and to where its chief ray lands.

    U(xi) = 1 / lambda INT T(p) exp(i k (W(p) + xi.s(p))) D / R1 d / R0^2 d^2 p,   W = R1 + R0 + sum of the elements

R1 and R0 lead from the object point to p and from p to the place x0 = -d (X / D, Y / D) on the sensor, less those of
the chief ray through the middle of the elements; s = (x0 - p) / R0 are the direction cosines towards the sensor, in
which the kernel is straight and the pupil is sampled. On the axis it is the Debye map of `pupil.coordinates`.
Nodes of the pupil do not move with what is trained: derivatives are those of the integrand, at fixed p / a.
"""

from __future__ import annotations

import functools
import math
from collections import defaultdict
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from kcam.cache import differentiated
from kcam.optics.autograd import apply_linear
from kcam.optics.numerics import phasor, squared
from kcam.optics.propagation import sampling
from kcam.optics.propagation.cells import Cells
from kcam.optics.propagation.grid import matrix_cost
from kcam.optics.propagation.question import Query
from kcam.optics.propagation.row import PRODUCTS, Propagator
from kcam.optics.propagation.transforms import PlainLayout
from kcam.optics.pupil.coordinates import EDGE_MARGIN, Pupil, grid_nodes, grid_spacing
from kcam.optics.pupil.rim import opening
from kcam.optics.pupil.warp import Interpolation
from kcam.optics.source import Points

_LOOK = 97  # points across the pupil at which the slope of the path is seen
_OUTLINE = 65  # points of each side of the pupil's outline
_FARTHEST = 2.0  # semi-apertures: nodes beyond stay here, where nothing is open
_UNBENT = 0.01  # of the finest detail: a kernel less bent is straight
_STEPS = 3
_MARGIN = 16  # points beyond the window
ERROR = 3e-4  # of a PSF's light (L1), from what more samples give: measured, with maps of pixels
_AREA_SAMPLES = 192


def off_axis_psf(query: Query) -> Tensor:
    """(N, L, H, W) of N points with places on the sensor; sums to the relative illumination, less what leaves the
    window, whose centre is the place.

    Raises: ValueError for blur that needs more than `sampling.MAX_PUPIL_SAMPLES`.
    """
    places, vergences = _places(query), query.vergences
    alike: dict[tuple[float, ...], list[int]] = defaultdict(list)
    for index, place in enumerate(places.detach().tolist()):
        alike[(*place, float(index) if places.requires_grad else 0.0)].append(index)
    found: list[Tensor] = [torch.empty(0)] * len(vergences)
    for members in alike.values():
        for index, image in zip(members, Seen(query, places[members[0]]).psfs(vergences[members]), strict=True):
            found[index] = image
    return torch.stack(found)


def relative_illumination(query: Query) -> Tensor:
    """Irradiance of an even scene at the places of a query's points, over that on the axis, (N,) float64."""
    return torch.stack([Seen(query, place).illumination() for place in _places(query)])


def _places(query: Query) -> Tensor:
    if query.points.positions is None:
        raise ValueError("points off the axis have positions on the sensor: Points(vergences, positions).")
    return query.points.positions.to(query.device, torch.float64)


@dataclass(frozen=True)
class Grid:
    """Nodes of the pupil as a place of the sensor sees it: even in the direction cosines s, rows along +y.

    sines: of the columns and the rows, from their middle, (nx,) and (ny,). x, y: in semi-apertures, (ny, nx).
    area: of each node there.
    """

    sines: tuple[Tensor, Tensor]
    x: Tensor
    y: Tensor
    area: Tensor


@dataclass(frozen=True)
class Bend:
    """points (M,) [m] of both axes where a field is computed; the window's own by interpolation along x, then along y,
    and how much denser the light is there. None: the same.
    """

    points: Tensor
    across: Interpolation | None = None
    down: Interpolation | None = None
    density: Tensor | None = None

    def unbent(self, intensity: Tensor) -> Tensor:
        """(..., M, M) -> (..., m, m)."""
        if self.across is None or self.down is None or self.density is None:
            return intensity
        return self.down.forward(self.across.forward(intensity).mT).mT * self.density


@dataclass(frozen=True)
class Seen:
    """A query's pupil as one place of the sensor (2,) [m] sees it; of its points the others do not count."""

    query: Query
    place: Tensor

    # ---- paths -----------------------------------------------------------------------------------------------------

    def cosines(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Towards the place from (x, y) in semi-apertures, along x and y; and the way there R0 [m]."""
        a, d = self.query.semi_aperture, self.query.sensor_distance
        along, down = self.place[0] - a * x, self.place[1] - a * y
        far = torch.sqrt(along**2 + down**2 + d**2)
        return along / far, down / far, far

    def paths(self, x: Tensor, y: Tensor, vergences: Tensor) -> Tensor:
        """R1 + R0 of each vergence, (Z, ...) [m]: of the light through (x, y), beyond that of the chief ray."""
        a, v0 = self.query.semi_aperture, 1 / self.query.sensor_distance
        px, py = a * x, a * y
        tx, ty = -self.place * v0
        r2, onto, chief = px**2 + py**2, 2 * (px * tx + py * ty), torch.sqrt(1 + tx**2 + ty**2)

        def beyond(v: Tensor, sign: int) -> Tensor:
            far = torch.sqrt(1 + (v * px - sign * tx) ** 2 + (v * py - sign * ty) ** 2)
            return (v * r2 - sign * onto) / (far + chief)

        return torch.stack([beyond(v, 1) for v in vergences]) + beyond(v0, -1)

    def elements(self, pupil: Pupil, wavelengths: Tensor) -> Tensor:
        """What the elements add, (L, ...) [m], as on the axis; maps of pixels are not part of it."""
        r2 = pupil.rho2 * self.query.semi_aperture**2 / 2
        found = wavelengths.new_zeros(len(wavelengths), *r2.shape)
        for element in self.query.lens.elements:
            parts = [(element.vergence(wavelengths), r2), *element.terms(pupil, wavelengths)]
            found = functools.reduce(lambda sums, part: sums + part[0].view(-1, 1, 1) * part[1], parts, found)
        return found

    # ---- sampling --------------------------------------------------------------------------------------------------

    @functools.cached_property
    def frame(self) -> tuple[Tensor, Tensor]:
        """Middle and half width, (2,) each, of what light passes: in direction cosines, without a gradient."""
        with torch.no_grad():
            side = torch.linspace(-1, 1, _OUTLINE, dtype=torch.float64, device=self.place.device)
            if self.query.lens.round:
                x, y = torch.cos(math.pi * side), torch.sin(math.pi * side)
            else:
                one = torch.ones_like(side)
                x, y = torch.cat([side, side, one, -one]), torch.cat([one, -one, side, side])
            ends = [part.aminmax() for part in self.cosines(x, y)[:2]]
            low, high = (torch.stack([end[k] for end in ends]) for k in (0, 1))
            return (low + high) / 2, (high - low) / 2

    def grid(self, counts: tuple[int, int]) -> Grid:
        """counts: of columns and rows."""
        with torch.no_grad():
            a, d = self.query.semi_aperture, self.query.sensor_distance
            spacing = [grid_spacing(count) * half for count, half in zip(counts, self.frame[1], strict=True)]
            sines = [
                grid_nodes(count).to(half.device) * half for count, half in zip(counts, self.frame[1], strict=True)
            ]
            along, down = self.frame[0][0] + sines[0][None, :], self.frame[0][1] + sines[1][:, None]
            forward = torch.sqrt((1 - along**2 - down**2).clamp(min=1e-4))
            x, y = (self.place[0] - d * along / forward) / a, (self.place[1] - d * down / forward) / a
            # d^2 p / d^2 s = R0^4 / d^2
            area = spacing[0] * spacing[1] * (d / a) ** 2 / forward**4
            near = (_FARTHEST * torch.rsqrt((x**2 + y**2).clamp(min=1e-9))).clamp(max=1)
            return Grid((sines[0], sines[1]), x * near, y * near, area)

    def slopes(self, vergences: Tensor) -> Tensor:
        """How far the smooth part of the pupil sends its rays from the place, along x and y, of each wavelength and
        vergence, at nodes that pass: (L, Z, 2, K) [m].
        """
        query = self.query
        with torch.no_grad():
            grid = self.grid((_LOOK, _LOOK))
            path = self.paths(grid.x, grid.y, vergences)
            if query.has_rings:  # too fine to be seen here: `displacement` has what they do on the axis
                on_axis = Seen(query, torch.zeros_like(self.place)).paths(grid.x, grid.y, vergences)
                path = (path - on_axis).expand(len(query.wavelengths), *path.shape)
            else:
                own = self.elements(query.pupil(grid.x, grid.y), query.wavelengths.to(query.device))
                path = path + own[:, None]
            steps = [float(part[1] - part[0]) for part in grid.sines]
            slope = torch.stack(torch.gradient(path, spacing=steps[::-1], dim=(-2, -1))[::-1], dim=2)
            inside = grid.x**2 + grid.y**2 <= 1 if query.lens.round else torch.maximum(grid.x.abs(), grid.y.abs()) <= 1
            return slope[..., inside].abs()

    def displacements(self, vergences: Tensor) -> Tensor:
        """The farthest of them, (L, 2) [m]."""
        farthest = self.slopes(vergences).amax((1, 3))
        if self.query.has_rings:
            farthest = farthest + self.query.displacement[:, None].to(farthest) * self.stretch
        return farthest

    @property
    def stretch(self) -> float:
        """How much farther off the axis a slope of the path sends light: 1 / cos^3."""
        return float((1 + (self.place.detach() / self.query.sensor_distance.detach()).square().sum()) ** 1.5)

    def evaluation(self, wavelength: float) -> tuple[float, int]:
        """(points per pixel, pixels from the middle to the edge of what is evaluated): as many points beyond the window
        as a pixel's sinc filter finds its light at.
        """
        per_pixel, margin = self.query.evaluation_grid(wavelength)[0], 0
        if self.query.grid.integrate:
            margin = min(max(2, math.ceil(_MARGIN / per_pixel)), sampling.WINDOW_MARGIN)
        return per_pixel, max(self.query.shape) // 2 + margin

    def counts(self, vergences: Tensor) -> list[tuple[int, int, int]]:
        """Columns and rows for each wavelength, and samples across the true plane where maps of pixels are low-passed.

        Raises: ValueError for too many, or for a number given too small.
        """
        query, found = self.query, []
        for wavelength, far in zip(query.wavelengths.tolist(), self.displacements(vergences).tolist(), strict=True):
            needed, enough = [], True
            for half, displacement in zip(self.frame[1].tolist(), far, strict=True):
                geometry = {"semi_aperture": half, "sensor_distance": 1.0, "wavelength": wavelength}
                half_window = self.evaluation(wavelength)[1] * query.pixel_pitch
                geometry |= {"half_window": half_window, "displacement": displacement}
                needed.append(sampling.pupil_samples(**geometry, kappa=query.how.kappa))
                enough &= query.how.samples is None or sampling.kappa_of(query.how.samples, **geometry) > 1
            if not enough:
                raise ValueError(
                    f"a pupil of {query.how.samples} samples is too coarse at {wavelength * 1e9:.4g} nm: its replicas "
                    f"would enter the window. Use samples >= {max(needed)}, or leave samples out."
                )
            if query.how.samples is None and max(needed) > sampling.MAX_PUPIL_SAMPLES:
                window = max(query.shape) * query.pixel_pitch
                raise ValueError(
                    f"this PSF needs {max(needed)} pupil samples at {wavelength * 1e9:.4g} nm (blur "
                    f"{max(far) * 1e3:.3g} mm, window {window * 1e3:.3g} mm), more than the limit of "
                    f"{sampling.MAX_PUPIL_SAMPLES}. Use a smaller shape or field, or a distance nearer to the focus."
                )
            given = query.how.samples and query.how.samples + query.how.samples % 2
            found.append(self._with_maps(*((given, given) if given else (_in_steps(n) for n in needed))))
        return found

    def _with_maps(self, *counts: int) -> tuple[int, int, int]:
        """The grid is everywhere at least as fine as the true plane's, whose samples hold all that the grid must."""
        if not self.query.has_pixels:
            return counts[0], counts[1], 0
        with torch.no_grad():
            grid = self.grid((_LOOK, _LOOK))
            inside = torch.maximum(grid.x.abs(), grid.y.abs()) <= 1
            sx, sy, far = (part[inside] for part in self.cosines(grid.x, grid.y))
            away, cross = far / self.query.semi_aperture, (sx * sy).abs()
            ends = [((1 - part**2 + cross) / away, (1 - part**2 - cross) / away) for part in (sx, sy)]
            margin = 2 * EDGE_MARGIN
            true = [
                (count - margin) * float(steep.max() / half)
                for count, (steep, _), half in zip(counts, ends, self.frame[1], strict=True)
            ]
            across = 32 * math.ceil((max(true) + margin) / 32)
            fine = [
                margin + 2 * math.ceil((across - margin) * float(half / flat.min()) / 2)
                for (_, flat), half in zip(ends, self.frame[1], strict=True)
            ]
        return fine[0], fine[1], across

    # ---- light -----------------------------------------------------------------------------------------------------

    def opened(self, grid: Grid) -> Tensor:
        """Quadrature weights of an aperture made of discs, (ny, nx)."""
        r2 = grid.x**2 + grid.y**2
        discs = [weight * opening((1 - r2 / radius**2)[None, None])[0] for radius, weight in self._discs]
        return functools.reduce(torch.add, discs)

    @property
    def _discs(self) -> tuple[tuple[float, float], ...]:
        return self.query.lens.aperture.discs()

    def passed(self, grid: Grid, cells: Cells | None) -> tuple[Tensor, Tensor, Tensor]:
        """Where how much light passes: x, y in semi-apertures, and its share times the area there."""
        if cells is None:
            return grid.x, grid.y, self.opened(grid) * grid.area
        parts = math.ceil(_AREA_SAMPLES / len(cells.power))
        sides = cells.edges.to(grid.x).diff().repeat_interleave(parts) / parts
        centres = sides.cumsum(0) - sides / 2 - 1
        power = cells.power.double().repeat_interleave(parts, 0).repeat_interleave(parts, 1)
        return centres[None, :], centres[:, None], power * (sides[:, None] * sides)

    def illumination(self) -> Tensor:
        """Of the place, over that of the axis."""
        count = _AREA_SAMPLES
        grid = self.grid((count, count))
        one = self.query.wavelengths[:1].to(self.query.device)
        own = replace(self.query, grid=replace(self.query.grid, dtype=torch.float64))
        return self._illumination(*self.passed(grid, Cells.of(own, one, count=count, spacing=grid_spacing(count))))

    def _illumination(self, x: Tensor, y: Tensor, light: Tensor) -> Tensor:
        axis = Seen(self.query, torch.zeros_like(self.place))
        here, there = (light / seen.cosines(x, y)[2] ** 4 for seen in (self, axis))  # d^2 s = d^2 / R0^4 d^2 p
        return here.sum() / there.sum()

    def _falloff2(self, x: Tensor, y: Tensor, vergences: Tensor) -> Tensor:
        """Of the power of spherical waves over the pupil, (Z, ...)."""
        a, (tx, ty) = self.query.semi_aperture, -self.place / self.query.sensor_distance
        v = vergences[:, None, None] * a
        return 1 / (1 + (v * x - tx) ** 2 + (v * y - ty) ** 2)

    def psfs(self, vergences: Tensor) -> Tensor:
        """(Z, L, H, W)."""
        query = self.query
        alike: dict[tuple[int, int, int], list[int]] = defaultdict(list)
        for index, counts in enumerate(self.counts(vergences)):
            alike[counts].append(index)
        found: list[Tensor] = [torch.empty(0)] * len(query.wavelengths)
        for counts, members in alike.items():
            wavelengths = query.wavelengths[members]
            per_pixel, half = self.evaluation(float(wavelengths.min()))
            reach = math.ceil(per_pixel * half)
            images = self._group(wavelengths.to(query.device), vergences, counts, per_pixel, reach)
            for index, image in zip(members, images, strict=True):
                found[index] = image
        return torch.stack(found, dim=1)

    def _group(
        self, wavelengths: Tensor, vergences: Tensor, counts: tuple[int, int, int], per_pixel: float, reach: int
    ) -> list[Tensor]:
        query, grid, count = self.query, self.grid(counts[:2]), counts[2]
        a, d, dtype = query.semi_aperture, query.sensor_distance, query.dtype
        cells = Cells.of(query, wavelengths, count=count, spacing=grid_spacing(count or _LOOK))
        light = self.passed(grid, cells)
        share = self._illumination(*light)
        energy = (light[2] * self._falloff2(light[0], light[1], vergences)).sum((-2, -1)) * a**2  # (Z,)
        own = self.elements(query.pupil(grid.x, grid.y), wavelengths)
        paths = self.paths(grid.x, grid.y, vergences)
        sx, sy, far = self.cosines(grid.x, grid.y)
        falloff = self._falloff2(grid.x, grid.y, vergences).sqrt()
        amplitude = falloff * (d / far**2) * (a**2 * grid.area)
        if cells is None:
            field = self.opened(grid).to(dtype).expand(len(wavelengths), *grid.x.shape)
        else:
            parts = self._onto(cells.field(None, PlainLayout()), grid, count)
            field = torch.complex(parts[0], parts[1])
        bend = self._bend(per_pixel, reach, wavelengths)
        points = bend.points
        moves = [part - part.detach() for part in (sx, sy)] if differentiated(sx) else []  # 0, with a gradient
        images = []
        for wavelength, path, passed in zip(wavelengths, own, field, strict=True):
            k = 2 * math.pi / wavelength
            phase = (k * (paths + path)).remainder(2 * math.pi)
            pupil = phasor(phase.to(dtype)) * (amplitude.to(dtype) * passed)
            columns, rows = (phasor((k * points[:, None] * part).to(dtype)) for part in grid.sines)
            image = rows @ pupil @ columns.mT
            for move, along in zip(moves, (points[None, :], points[:, None]), strict=False):
                image = image + 1j * (k * along).to(dtype) * (rows @ (pupil * move.to(dtype)) @ columns.mT)
            pixels = query.pixels(per_pixel).of_image(bend.unbent(squared(image)))
            factor = share * (query.pixel_pitch / wavelength) ** 2 / energy
            images.append(pixels * factor[:, None, None].to(dtype))
        return images

    def _bend(self, per_pixel: float, reach: int, wavelengths: Tensor) -> Bend:
        """From where the kernel is straight to the points xi of the window.

        R(p, x0 + xi) is R(p, x0) + xi'.s(p) and what does not depend on p, up to terms of second order in both p and
        xi, for xi' by which the direction cosines seen from the middle of the elements move as far as by xi.
        """
        query = self.query
        d, dtype = query.sensor_distance, torch.float64
        step = query.pixel_pitch / per_pixel
        points = torch.arange(-reach, reach + 1, dtype=dtype, device=query.device) * step
        (x0, y0), far2 = self.place, self.place.square().sum() + d**2

        def straight(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
            scale = torch.sqrt(far2 / (d**2 + (x0 + x) ** 2 + (y0 + y) ** 2))
            along, down = x0 * (scale - 1) + x * scale, y0 * (scale - 1) + y * scale
            common = (along * x0 + down * y0) / d**2
            return along + x0 * common, down + y0 * common

        x, y = points[None, :], points[:, None]
        sx, sy = straight(x, y)
        off = max(float((sx - x).detach().abs().max()), float((sy - y).detach().abs().max()))
        finest = float(wavelengths.min()) / (4 * float(self.frame[1].max()))
        if off < _UNBENT * finest:
            return Bend(points)
        fine = 1 if query.grid.integrate else math.ceil(step / finest / 0.95)
        more = math.ceil((reach * step + off) / step * fine)
        before = torch.arange(-more, more + 1, dtype=dtype, device=query.device) * (step / fine)
        between = before[:, None].expand(-1, len(points))  # rows still straight, columns not
        for _ in range(_STEPS):
            between = between - (straight(x, between)[1] - before[:, None])
        across, down = (
            Interpolation.by_polynomial(at * (fine / step) + more, len(before), dtype=query.dtype)
            for at in (straight(x, between)[0], sy.mT)
        )
        density = (far2 / (d**2 + (x0 + x) ** 2 + (y0 + y) ** 2)) ** 2
        return Bend(before, across, down, density.to(query.dtype))

    # ---- maps of pixels ---------------------------------------------------------------------------------------------

    def _onto(self, field: Tensor, grid: Grid, count: int) -> Tensor:
        """Fields (..., N, N) in the true plane on the grid, (..., ny, nx): along x at true y, then along y."""
        with torch.no_grad():
            a, d = self.query.semi_aperture, self.query.sensor_distance
            (x0, y0), spacing = self.place, grid_spacing(count)
            true = grid_nodes(count).to(grid.x)
            along, down = self.frame[0][0] + grid.sines[0], self.frame[0][1] + grid.sines[1]
            ahead = torch.sqrt(d**2 + (y0 - a * true) ** 2)[:, None] * along * torch.rsqrt((1 - along**2).clamp(1e-4))
            x = (x0 - ahead) / a
            y = (y0 - d * down[:, None] * torch.rsqrt((1 - along**2 - down[:, None] ** 2).clamp(min=1e-4))) / a
            first, last = (
                Interpolation.by_sinc((at / spacing + (count - 1) / 2).clamp(-64, count + 64), count, dtype=field.dtype)
                for at in (x, y.T)
            )
        return apply_linear(apply_linear(field, first).mT.contiguous(), last).mT


def _in_steps(count: int) -> int:
    """Few distinct numbers of samples: wavelengths that have one share their nodes and paths."""
    return 32 * math.ceil(2 ** (math.ceil(4 * math.log2(count)) / 4) / 32)


def _cost(query: Query) -> float:
    return 2 * matrix_cost(replace(query, points=Points(query.vergences)))


OFF_AXIS = Propagator(
    "nonparaxial",
    "off_axis",
    function=off_axis_psf,
    error=lambda query: ERROR,
    cost=_cost,
    rate=PRODUCTS,
    about="exact paths to one place of the sensor, matrix products",
)
