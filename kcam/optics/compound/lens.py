"""A real lens from its prescription: exact rays in float64, and the PSFs of any point of the field."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from kcam.cache import ValueCache
from kcam.inputs import as_values
from kcam.optics.compound import analysis, pupil
from kcam.optics.compound.distortion import Even, ImageHeights, chebyshev_radii
from kcam.optics.compound.field import FieldPSFs, bank
from kcam.optics.compound.files import read_lens, write_lens
from kcam.optics.compound.images import Frame, areas
from kcam.optics.compound.presets import preset_surfaces
from kcam.optics.compound.surface import Surface
from kcam.optics.compound.table import tabulate
from kcam.optics.compound.tracing import Rays, system_matrix, trace
from kcam.optics.elements.element import check_numbers, place_sensor
from kcam.optics.numerics import Scalar, float64, phasor, squared
from kcam.optics.source import Defocus, PixelGrid, Points
from kcam.threads import no_more_than_free
from kcam.units import check_distances, check_pixel_pitch, check_positive, wavelength_grid

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WIDEST, _INTERVALS, _NESTED = 60.0, 16, 4  # degrees; of a search for the edge of the field
_AIMING = 10  # steps of the secant that aims a chief ray, at most
_INNER = 0.4  # of the stop's radius: rays that tell how the stop lies in the entrance pupil
_AIMED = 1e-11  # of the entrance pupil: a last Newton step squares what is left
_STEP = 1e-3  # of differences in the entrance pupil, of that
_AIMING_EACH = 60  # at most, of a ray to its point of the stop: a phone's, on a steep stop, takes some 40


@dataclass(frozen=True)
class FirstOrder:
    """Paraxial quantities at one wavelength [m]; positions are along the axis, of the entrance pupil from the first
    vertex and of the others from the last, positive behind it.
    """

    focal_length: Tensor
    back_focus: Tensor
    entrance_pupil: Tensor
    entrance_semi_diameter: Tensor
    exit_pupil: Tensor
    exit_semi_diameter: Tensor


class CompoundLens(nn.Module):
    """Refracting surfaces with a common axis, an aperture stop among them, in front of a sensor.

    Args:
        surfaces: in the order of the light; exactly one is the stop.
        focus_distance: sets the sensor where an object at this distance in front of the first vertex is imaged [m],
            paraxially, at `focus_wavelength`, once. sensor_distance: from the last vertex to the sensor [m], instead.
        focus_wavelength: [m].
    Raises: ValueError for not exactly one stop, both or neither distance, a focus that does not exist, glass in front
        of the sensor; TypeError for what is no Surface.
    Rays are traced on the CPU, wherever the lens is, as they are few; what it is asked for itself is answered there,
    and the PSFs of a picture are made where that is.
    Valid for scalar light; surfaces are refracting, without coatings, and share one axis. PSFs are good to 1e-3 of
    their light down to f/4, and 3e-3 at f/1.85, against a sum over rays (tests/optics/test_compound.py).
    Object points are (X / D, Y / D) with D from the paraxial entrance pupil; light falls as in `units`: a point at
    (0, +t) lands at y of about -f t.

    Example:
    >>> front = optics.Surface(radius=50 * mm, thickness=4 * mm, glass=1.5, semi_diameter=5 * mm, stop=True)
    >>> lens = optics.CompoundLens(front, optics.Surface(), focus_distance=math.inf)
    >>> f"{lens.focal_length() / mm:.1f} mm"  # R / (n - 1)
    '100.0 mm'
    """

    surfaces: Sequence[Surface]
    sensor_distance: Scalar
    varies = True

    def __init__(
        self,
        *surfaces: Surface,
        focus_distance: float | None = None,
        sensor_distance: Scalar | None = None,
        focus_wavelength: float = 550e-9,
    ) -> None:
        super().__init__()
        for surface in surfaces:
            if not isinstance(surface, Surface):
                raise TypeError(f"a compound lens takes optics.Surface, got {type(surface).__name__}.")
        stops = sum(surface.stop for surface in surfaces)
        if stops != 1:
            raise ValueError(f"a compound lens has exactly one stop, got {stops}: Surface(..., stop=True).")
        if surfaces[-1].glass is not None:
            raise ValueError("the last surface has glass behind it, but the sensor stands in air: glass=None.")
        self.surfaces = nn.ModuleList(surfaces)  # type: ignore[assignment]
        self._heights_cache = ValueCache()
        self.focus_wavelength = float(wavelength_grid([focus_wavelength]))
        place_sensor(self, focus_distance, sensor_distance, image_distance=self._focused)

    @classmethod
    def preset(cls, name: str, *, focus_distance: float = math.inf, focus_wavelength: float = 550e-9) -> CompoundLens:
        """A lens from its patent: a name in `presets.PRESETS`; focus_distance [m], inf allowed, focus_wavelength [m].

        Raises: ValueError for an unknown name, and as the constructor.
        """
        return cls(*preset_surfaces(name), focus_distance=focus_distance, focus_wavelength=focus_wavelength)

    @classmethod
    def from_file(cls, path: str | os.PathLike[str], *, focus_distance: float | None = None) -> CompoundLens:
        """A lens from sequential Zemax text (.zmx) or Optiland's JSON (.json), its primary wavelength that of focus.

        focus_distance: as of the constructor; None leaves the sensor where the file has the image. Raises: as
        `files.read_lens`: FileNotFoundError; ValueError that names the line or surface that kcam cannot be.
        """
        found = read_lens(path, focused=focus_distance is not None)
        distance = found.sensor_distance if focus_distance is None else None
        return cls(
            *found.surfaces,
            focus_distance=focus_distance,
            sensor_distance=distance,
            focus_wavelength=found.focus_wavelength,
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the lens as .zmx or .json, parameters by their values. Raises: ValueError, as `files.write_lens`."""
        self.check()
        write_lens(path, self.surfaces, sensor_distance=self.sensor_distance, focus_wavelength=self.focus_wavelength)

    def configuration(self) -> dict[str, object]:
        """Constructor arguments, for saving: the sensor's distance, which was set once, rather than the focus."""
        return {
            "surfaces": list(self.surfaces),
            "sensor_distance": self.sensor_distance,
            "focus_wavelength": self.focus_wavelength,
        }

    def check(self) -> None:
        """What the constructors refuse must not come in by an optimiser's step or a loaded file either."""
        check_numbers(self)
        for surface in self.surfaces:
            surface.check()
        check_positive(self.sensor_distance, name="sensor_distance")

    # ---- paraxial --------------------------------------------------------------------------------------------------

    @property
    def stop(self) -> int:
        """Which surface is the aperture stop."""
        return next(k for k, surface in enumerate(self.surfaces) if surface.stop)

    def indices(self, wavelengths: Tensor) -> list[Tensor]:
        """Refractive index in front of the lens and behind each surface, K + 1 of (L,) float64."""
        return [torch.ones_like(wavelengths), *(surface.index(wavelengths) for surface in self.surfaces)]

    @property
    def _stop_semi_diameter(self) -> Tensor:
        return float64(self.surfaces[self.stop].semi_diameter).cpu()  # type: ignore[arg-type]

    @property
    def _sensor_away(self) -> Tensor:
        """From the last vertex [m]."""
        return float64(self.sensor_distance).cpu()

    def first_order(self, wavelength: float | None = None) -> FirstOrder:
        """Focal length and pupils [m] at a wavelength [m]; None for that of focus."""
        grid = wavelength_grid([self.focus_wavelength if wavelength is None else wavelength])
        indices = [index[0] for index in self.indices(grid)]
        matrix = system_matrix(self.surfaces, indices)
        front = system_matrix(self.surfaces[: self.stop + 1], indices, refract_last=False)
        # behind the stop: from its vertex, which refracts, to the last
        back = system_matrix(self.surfaces[self.stop :], indices[self.stop :])
        semi = self._stop_semi_diameter
        return FirstOrder(
            focal_length=-1 / matrix[1, 0],
            back_focus=-matrix[0, 0] / matrix[1, 0],
            entrance_pupil=front[0, 1] / front[0, 0],
            entrance_semi_diameter=semi / front[0, 0].abs(),
            exit_pupil=-back[0, 1] / back[1, 1],
            exit_semi_diameter=semi / back[1, 1].abs(),
        )

    def focal_length(self, wavelength: float | None = None) -> float:
        """Paraxial focal length [m] at a wavelength [m]; None for that of focus."""
        return float(self.first_order(wavelength).focal_length.detach())

    @property
    def f_number(self) -> float:
        """Working f-number: from the exit pupil to the sensor, over its width."""
        first = self.first_order()
        distance = self._sensor_away - first.exit_pupil
        return float((distance / (2 * first.exit_semi_diameter)).detach())

    def _focused(self, distance: float) -> float:
        indices = [index[0].detach() for index in self.indices(wavelength_grid([self.focus_wavelength]))]
        matrix = system_matrix(self.surfaces, indices).detach()
        ray = matrix @ torch.tensor([1.0, 1 / distance], dtype=torch.float64)  # of height 1 at the first vertex
        if float(ray[1]) >= 0:
            raise ValueError(
                f"an object at {distance:g} m has no real image: the focal length is {-1 / float(matrix[1, 0]):g} m. "
                "Focus farther away."
            )
        image = float(-ray[0] / ray[1])
        if image <= 0:
            raise ValueError(f"an object at {distance:g} m is imaged {-image:g} m inside the lens, not behind it.")
        return image

    # ---- exact rays ------------------------------------------------------------------------------------------------

    def launch(
        self, heights: Tensor, vergences: Tensor, px: Tensor, py: Tensor, *, entrance: Tensor | None = None
    ) -> Rays:
        """Rays at the plane of the first vertex, from points at (0, heights) through (px, py) of the entrance pupil.

        Args: heights: Y / D. vergences: 1 / distance from the first vertex [1/m]. px, py: [m]; all broadcast.
            entrance: where that pupil is [m], where it is known: see `first_order`.
        """
        e = self.first_order().entrance_pupil if entrance is None else entrance
        v = vergences / (1 + vergences * e)  # from the entrance pupil
        sx, sy = px * v, py * v - heights
        n = torch.rsqrt(1 + sx**2 + sy**2)
        x, y = px - e * sx, py - e * sy
        tau = heights * (1 + vergences * e)
        # from the object to here, less what its ray through the vertex travels: does not cancel at any distance
        root = torch.sqrt((vergences * x) ** 2 + (vergences * y - tau) ** 2 + 1)
        path = (vergences * (x**2 + y**2) - 2 * y * tau) / (root + torch.sqrt(tau**2 + 1))
        alive = torch.ones_like(n, dtype=torch.bool)
        x, y, dx, dy, path = torch.broadcast_tensors(x, y, sx * n, sy * n, path)
        return Rays(x, y, dx, dy, path, alive)

    def aimed(self, heights: Tensor, vergences: Tensor, indices: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Height in the entrance pupil at which chief rays pass the middle of the stop [m], and how the stop's x and y
        follow those of the entrance pupil there; shape of what broadcasts.
        """
        first = self.first_order()
        step = _STEP * first.entrance_semi_diameter.detach()

        def landed(px: Tensor, py: Tensor) -> Rays:
            return trace(
                self.surfaces,
                self.launch(heights, vergences, px, py, entrance=first.entrance_pupil),
                indices,
                until=self.stop,
            )

        zero = torch.zeros_like(torch.broadcast_tensors(heights, vergences, *indices)[0])
        with torch.no_grad():
            before, now = zero, zero + step
            low, high = (landed(zero, at).y for at in (before, now))
            for _ in range(_AIMING):
                slope = (high - low) / torch.where(now == before, 1.0, now - before)
                slope = torch.where(slope.abs() < 1e-6, 1.0, slope)
                before, low, now = now, high, now - high / slope
                high = landed(zero, now).y
                if bool((high.abs() < _AIMED * step / _STEP).all()):
                    break
            along = (landed(zero, now + step).y - high) / step
            across = landed(zero + step, now).x / step
        return now - landed(zero, now).y / along, across, along

    def _nodes(self, wavelengths: Tensor, vergences: Tensor, heights: Tensor) -> _Nodes:
        """Chief rays of heights (F,), vergences (Z,) and wavelengths (L,). Raises: ValueError where one is lost."""
        nodes = self._chiefs(wavelengths, vergences, heights)
        alive = nodes.chief.alive
        if not bool(alive.all()):
            height = float(nodes.heights.expand(alive.shape)[~alive].max())
            raise ValueError(
                f"the chief ray of a point at {height:.3g} (Y / D) misses a surface or is totally reflected: the field "
                "of this lens is smaller. Use smaller fields."
            )
        return nodes

    def _chiefs(self, wavelengths: Tensor, vergences: Tensor, heights: Tensor) -> _Nodes:
        """The same where some may be lost: `chief.alive` says which are not."""
        indices = [index[None, None, :, None] for index in self.indices(wavelengths)]
        t, v = heights[:, None, None, None], vergences[None, :, None, None]
        aim, across, along = self.aimed(t, v, indices)
        chief = self._at_sensor(self.launch(t, v, torch.zeros_like(aim), aim), indices)
        return _Nodes(indices, t, v, aim, across, along, chief, self._towards(t, v, indices, aim, across, along))

    @torch.no_grad()
    def _towards(
        self, t: Tensor, v: Tensor, indices: list[Tensor], aim: Tensor, across: Tensor, along: Tensor
    ) -> Tensor:
        """Where rays cross the entrance pupil that come to (x, y) of the stop, in its radii, about: coefficients of x,
        y and y^2 beside the chief ray's height, (..., 3) [m]. By rays to points `_INNER` of the radius from its middle.
        """
        first = self.first_order()
        semi = self._stop_semi_diameter
        beside = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64, device=aim.device)
        above = torch.tensor([0.0, 1.0, -1.0], dtype=torch.float64, device=aim.device)
        x, y = _INNER * semi * beside / across, _INNER * semi * above / along
        rays = trace(
            self.surfaces,
            self.launch(t, v, x, aim + y, entrance=first.entrance_pupil),
            indices,
            until=self.stop,
        )
        up, down = rays.y[..., 1:2], rays.y[..., 2:]
        slope, bend = (up - down) / (2 * y[..., 1:2]), (up + down) / (2 * y[..., 1:2] ** 2)
        straight = semi / torch.cat([rays.x[..., :1] / x[..., :1], slope], dim=-1)
        curved = torch.cat([straight, -bend / slope * straight[..., 1:] ** 2], dim=-1)
        linear = torch.cat([semi / across, semi / along, torch.zeros_like(along)], dim=-1)
        return torch.where(rays.alive.all(-1, keepdim=True), curved, linear)

    def _at_sensor(self, rays: Rays, indices: list[Tensor]) -> Rays:
        rays = trace(self.surfaces, rays, indices)
        t = self._sensor_away / rays.dz
        return replace(rays, x=rays.x + t * rays.dx, y=rays.y + t * rays.dy, path=rays.path + t)

    @no_more_than_free()
    def opd(
        self,
        wavelengths: Tensor | list[float],
        *,
        distances: Tensor | float,
        field: Tensor | None = None,
        samples: int = 65,
    ) -> tuple[Tensor, Tensor]:
        """Wavefront over the stop in waves, and where light passes: (F, Z, L, S, S), without `field` (Z, L, S, S).

        On the sphere about the image of the chief ray through the middle of the paraxial exit pupil; positive where
        light comes late. Rays are aimed at the stop: S x S points of its bounding square, rows along +y.

        Args: wavelengths, distances, field: as of `psf`. samples: S, points on each side.
        """
        asked = self._asked(wavelengths, distances, field)
        nodes = self._nodes(asked.wavelengths, asked.vergences, asked.heights)
        chief = nodes.chief
        semi = self._stop_semi_diameter
        side = torch.linspace(-1, 1, samples, dtype=torch.float64)
        x, y = (part.flatten() for part in torch.meshgrid(side, side, indexing="xy"))
        # the stop's own axes turn with the field
        cx, cy = (part[:, None, None, None] for part in asked.directions.unbind(1))
        to_x, to_y = semi * (x * cy - y * cx), semi * (x * cx + y * cy)
        with torch.no_grad():
            px, py = to_x / nodes.across, nodes.aim + to_y / nodes.along
            for _ in range(_AIMING_EACH):
                started = self.launch(nodes.heights, nodes.vergences, px, py)
                at = trace(self.surfaces, started, nodes.indices, until=self.stop)
                off = torch.maximum((at.x - to_x).abs(), (at.y - to_y).abs()).masked_fill(~at.alive, 0.0)
                if float(off.max()) < 1e-13:
                    break
                px, py = px - (at.x - to_x) / nodes.across, py - (at.y - to_y) / nodes.along
        rays = self._at_sensor(self.launch(nodes.heights, nodes.vergences, px, py), nodes.indices)
        away = self._sensor_away - self.first_order().exit_pupil
        radius = away.sign() * torch.sqrt(away**2 + chief.y**2)
        ox, oy = rays.x - chief.x, rays.y - chief.y
        onto = ox * rays.dx + oy * rays.dy
        back = onto + radius.sign() * torch.sqrt((onto**2 - ox**2 - oy**2 + radius**2).clamp(min=0))
        waves = (rays.path - back - chief.path + radius) / asked.wavelengths[:, None]
        clearances = torch.stack(rays.clearance, dim=-2)
        passes = rays.alive & (clearances > -1e-9).all(-2) & (x**2 + y**2 <= 1 + 1e-9)
        found = [part.expand(waves.shape).unflatten(-1, (samples, samples)) for part in (waves, passes)]
        return (found[0], found[1]) if field is not None else (found[0][0], found[1][0])

    def pupils(self, wavelengths: Tensor, vergences: Tensor, heights: Tensor) -> pupil.PupilFit:
        """Pupils of F x Z x L nodes, in this order: heights (F,) >= 0, vergences (Z,) [1/m], wavelengths (L,) [m]."""
        nodes = self._nodes(wavelengths, vergences, heights)
        x, y, area = pupil.rays_over_stop(heights.device)
        px, py = nodes.towards(x, y)
        chief = nodes.chief
        rays = self._at_sensor(self.launch(nodes.heights, nodes.vergences, px, py), nodes.indices)
        wavefront = rays.path - rays.dx * rays.x - rays.dy * (rays.y - chief.y) - chief.path
        clearances = torch.stack([*rays.clearance, rays.margin], dim=-2)  # type: ignore[list-item]
        flat = [part.flatten(0, 2) for part in (rays.dx, rays.dy, wavefront, clearances, rays.alive, chief.y[..., 0])]
        return pupil.fit(*flat, area=area, enough=pupil.ENOUGH * float(wavelengths.min()))

    # ---- images of points ------------------------------------------------------------------------------------------

    def image_point(
        self, wavelengths: Tensor | list[float], *, distances: Tensor | float, field: Tensor | None = None
    ) -> Tensor:
        """Where each wavelength's chief ray lands on the sensor [m]: (F, Z, L, 2), without `field` (Z, L, 2).

        Args: as of `psf`.
        """
        asked = self._asked(wavelengths, distances, field)
        chief = self._nodes(asked.wavelengths, asked.vergences, asked.heights).chief.y[..., 0]
        found = chief[..., None] * asked.directions[:, None, None]
        return found if field is not None else found[0]

    def relative_illumination(
        self,
        field: Tensor,
        *,
        wavelengths: Tensor | list[float] | None = None,
        distances: Tensor | float = math.inf,
    ) -> Tensor:
        """Irradiance of a uniform radiance, over that on the axis, (F,): mean over wavelengths and distances.

        Args: field: (F, 2) of X / D and Y / D. wavelengths: (L,) [m], None for that of focus. distances: [m], inf
            allowed.
        """
        asked = self._asked([self.focus_wavelength] if wavelengths is None else wavelengths, distances, field)
        heights = torch.cat([asked.heights.new_zeros(1), asked.heights])
        fitted = self.pupils(asked.wavelengths, asked.vergences, heights)
        found = areas(fitted, Frame.upright(fitted))
        found = found.view(len(heights), -1)
        return (found[1:] / found[:1]).mean(1)

    def distortion(self, field: Tensor, *, wavelength: float | None = None, distance: float = math.inf) -> Tensor:
        """Height of the chief ray's image over that of a lens without distortion, less 1, (F,).

        Args: field: (F, 2) of X / D and Y / D. wavelength: [m], None for that of focus. distance: [m], inf allowed.
        """
        asked = self._asked([self.focus_wavelength if wavelength is None else wavelength], distance, field)
        near = 1e-4 * torch.ones(1, dtype=torch.float64)
        heights = torch.cat([near, asked.heights])
        landed = self._nodes(asked.wavelengths, asked.vergences, heights).chief.y[:, 0, 0, 0]
        ideal = landed[0] / near[0] * asked.heights
        return torch.where(asked.heights > 0, landed[1:] / torch.where(ideal == 0, 1.0, ideal) - 1, 0.0)

    @no_more_than_free()
    def psf(
        self,
        wavelengths: Tensor | list[float],
        *,
        distances: Tensor | float,
        pixel_pitch: float,
        shape: tuple[int, int],
        field: Tensor | None = None,
        dtype: torch.dtype = torch.float32,
        integrate: bool = True,
    ) -> Tensor:
        """Energy of a point's image in each pixel, relative to the light of a point on the axis.

        Args: as of `Lens.psf`; field: (F, 2) of object points.
        Returns: (F, Z, L, H, W), without `field` (Z, L, H, W); sums to the relative illumination, less what leaves the
            window, whose centre is where the chief ray of the focus wavelength lands.
        """
        asked = self._asked(wavelengths, distances, field)
        pixels = PixelGrid(check_pixel_pitch(pixel_pitch), shape, integrate=integrate, dtype=dtype)
        heights = torch.cat([asked.heights, asked.heights.new_zeros(1)])
        fitted = self.pupils(asked.wavelengths, asked.vergences, heights)
        middle = self._nodes(wavelength_grid([self.focus_wavelength]), asked.vergences, heights).chief.y[..., 0]
        chief = fitted.chief.view(len(heights), len(asked.vergences), -1)
        found = bank(fitted, asked.wavelengths, asked.directions, (chief - middle)[:-1], pixels)
        return found if field is not None else found[0]

    # ---- as a source of PSFs ---------------------------------------------------------------------------------------

    @property
    def focus_distance(self) -> float:
        """Object distance from the first vertex that is imaged onto the sensor paraxially [m]; inf for beyond."""
        vergence = float(self._focus().detach())
        return 1 / vergence if vergence > 1e-9 else math.inf

    def _focus(self, wavelength: float | None = None) -> Tensor:
        """Vergence of what the sensor is focused on [1/m]; 0 where that lies beyond infinity."""
        indices = [index[0] for index in self.indices(wavelength_grid([wavelength or self.focus_wavelength]))]
        (a, b), (c, d) = system_matrix(self.surfaces, indices)
        away = self._sensor_away
        return (-(a + away * c) / (b + away * d)).clamp(min=0)

    @property
    def image_scale(self) -> Tensor:
        """Height of the image of a point near the axis over the point's own (Y / D) [m]."""
        first = self.first_order()
        away = self._sensor_away - first.exit_pupil
        return away * first.entrance_semi_diameter / first.exit_semi_diameter

    def aperture_area(self) -> float:
        """The pupil's area in direction cosines times the squared sensor distance [m^2]: as exposure takes it."""
        with torch.no_grad():
            zero = torch.zeros(1, dtype=torch.float64)
            fitted = self.pupils(wavelength_grid([self.focus_wavelength]), zero + self._focus(), zero)
            area = areas(fitted, Frame.upright(fitted))
        return float(area) * float(self.sensor_distance) ** 2

    @no_more_than_free()
    def bank(self, points: Points, wavelengths: Tensor, pixels: PixelGrid) -> Tensor:
        """PSFs (N, L, h, w) of source points, on the axis unless they have positions: see `PSFSource`."""
        places = torch.zeros(len(points.vergences), 2) if points.positions is None else points.positions
        places = places.to("cpu", torch.float64)
        field = self.over_field(float(places.norm(dim=1).max()), points.vergences, wavelengths)
        if points.positions is None:
            return field.bank(places[:1], pixels)[0]
        found = field.bank(places, pixels)
        return found[torch.arange(len(places)), torch.arange(len(places))]

    def window(self, points: Points, wavelengths: Tensor, pixels: PixelGrid) -> tuple[int, int]:
        """The window (H, W) that holds all but 0.5 % of the light of points [pixels], on the axis unless they have
        positions.
        """
        reach = 0.0 if points.positions is None else float(points.positions.norm(dim=1).max())
        return self.over_field(reach, points.vergences, wavelengths).window(pixels)

    def defocus_waves(self, wavelengths: Tensor) -> float:
        """a^2 / (2 lambda) of the entrance pupil at the shortest wavelength: waves at the rim for each 1/m."""
        return float(self.first_order().entrance_semi_diameter.detach()) ** 2 / (2 * float(wavelengths.min()))

    def defocus(self, wavelengths: Tensor, pixel_pitch: float) -> Defocus:
        """How far light is spread on the axis, for a planner: by its rays in focus, and by a cone out of focus."""
        with torch.no_grad():
            ends = torch.stack(list(wavelengths.aminmax())).to(torch.float64)
            focus = [float(self._focus(float(end))) for end in ends]
            spread = float(self.first_order().entrance_semi_diameter * self.image_scale) / pixel_pitch
            middle = torch.tensor([sum(focus) / 2], dtype=torch.float64)
            side = self.over_field(0.0, middle, ends).blur()
        airy = 0.61 * float(ends.max()) * 2 * self.f_number
        return Defocus((min(focus), max(focus)), spread, (side + airy) / pixel_pitch)

    def image_heights(self, reach: float) -> ImageHeights:
        """How images lie on the sensor, up to `reach` from the axis [m]: by chief rays of the focus.

        Raises: ValueError for a sensor that reaches beyond the field of the lens.
        """
        if reach == 0:
            return ImageHeights(Even(1 / self.image_scale[None], 1.0), self.image_scale)
        grid, focus = wavelength_grid([self.focus_wavelength]), self._focus()[None]
        scale = self.image_scale

        def landed(heights: Tensor) -> Tensor:
            return -self._nodes(grid, focus, heights).chief.y[:, 0, 0, 0]

        with torch.no_grad():
            highest = reach / scale
            try:
                for _ in range(_AIMING):  # the image of the highest point lies at the sensor's corner
                    before, highest = highest, highest * reach / landed(highest[None])[0]
                    if bool((highest / before - 1).abs() < 1e-4):
                        break
                highest = 1.005 * highest
                landed(highest[None])
            except ValueError as error:
                raise ValueError(
                    f"the sensor reaches {reach * 1e3:.3g} mm from the axis, beyond the field of this lens: {error}"
                ) from error
        heights = chebyshev_radii(1.0) * highest
        radii = landed(heights)
        over_radius = Even.through(heights / radii, radii, reach=float(radii.detach().max()))
        return ImageHeights(over_radius, scale)

    @no_more_than_free()
    def over_field(self, reach: float, vergences: Tensor, wavelengths: Tensor) -> FieldPSFs:
        """PSFs of all places up to `reach` from the axis [m], for points at vergences (Z,) [1/m] and wavelengths (L,)
        [m].
        """
        self.check()
        vergences, wavelengths = (values.to("cpu", torch.float64) for values in (vergences, wavelengths))
        heights = self._heights_cache.get((self, reach), lambda: self.image_heights(reach))
        square = torch.tensor(reach, dtype=torch.float64) ** 2
        highest = reach * float(heights.over_radius.at(square).detach())
        table = tabulate(
            lambda t, v, colours: self.pupils(colours, v, t),
            highest=highest,
            vergences=vergences,
            wavelengths=wavelengths,
        )
        return FieldPSFs(table, heights, vergences, wavelengths, reach)

    def _asked(self, wavelengths: Tensor | list[float], distances: Tensor | float, field: Tensor | None) -> _Asked:
        self.check()
        points = torch.zeros(1, 2, dtype=torch.float64)
        if field is not None:
            points = as_values(field, name="field", unit="X / D, Y / D").to("cpu", torch.float64)
        if points.ndim != 2 or points.shape[1] != 2 or not len(points) or not bool(points.isfinite().all()):
            raise ValueError(f"field must be finite, (F, 2) of X / D and Y / D, got shape {tuple(points.shape)}.")
        heights = points.square().sum(1).clamp(min=1e-300).sqrt() * (points != 0).any(1)
        away = torch.where(heights[:, None] > 0, points / heights.clamp(min=1e-150)[:, None], points.new_tensor([0, 1]))
        return _Asked(wavelength_grid(wavelengths), 1 / check_distances(distances).reshape(-1).cpu(), heights, away)

    # ---- analysis --------------------------------------------------------------------------------------------------

    @no_more_than_free()
    def mtf(
        self,
        wavelengths: Tensor | list[float],
        *,
        distances: Tensor | float,
        pixel_pitch: float,
        shape: tuple[int, int],
        field: Tensor | None = None,
        dtype: torch.dtype = torch.float32,
        integrate: bool = True,
    ) -> Tensor:
        """Modulation transfer function, |OTF| / OTF(0), times the pixel's own sinc.

        Args: those of `psf`; integrate=False leaves out the pixel's sinc: the optics alone.
        Returns: (F, Z, L, H, W) in [0, 1], without `field` (Z, L, H, W); index n // 2 is frequency 0, the step is
            1 / (n * pixel_pitch) cycles per metre. Frequencies lie on the sensor's axes, +x right and +y down: for a
            point above or below the axis those along W are sagittal and those along H tangential, for one beside it the
            other way round; `modulation` has both at any point.
        Raises: as `psf`.
        Of all light but diffraction far outside the window, which counts for a share of less than 5e-3.
        """
        asked = self._asked(wavelengths, distances, field)
        pixels = PixelGrid(check_pixel_pitch(pixel_pitch), shape, integrate=integrate, dtype=dtype)
        fitted = self.pupils(asked.wavelengths, asked.vergences, asked.heights)
        node = torch.arange(len(fitted.centre)).view(len(asked.heights), len(asked.vergences), -1)
        maps = [
            analysis.modulation_map(
                fitted,
                int(node[f, z, k]),
                direction=direction,
                wavelength=wavelength,
                pixel_pitch=pixels.pitch,
                shape=pixels.shape,
            )
            for f, direction in enumerate(asked.directions)
            for z in range(len(asked.vergences))
            for k, wavelength in enumerate(asked.wavelengths.tolist())
        ]
        found = torch.stack(maps).view(*node.shape, *pixels.shape)
        if integrate:
            rows, columns = (torch.sinc((torch.arange(n, dtype=torch.float64) - n // 2) / n) for n in pixels.shape)
            found = found * rows[:, None] * columns
        return (found if field is not None else found[0]).to(dtype)

    @no_more_than_free()
    def modulation(
        self,
        frequencies: Tensor | Sequence[float],
        *,
        wavelengths: Tensor | list[float] | None = None,
        distance: float = math.inf,
        field: Tensor,
    ) -> Tensor:
        """MTF of all wavelengths together, each with the same energy, and without pixels: sagittal and tangential.

        Args:
            frequencies: (K,) >= 0 [cycles per metre]: 30 line pairs per mm are 30 / mm.
            wavelengths: (L,) [m], None for those of `analysis.SPECTRAL_LINES`. distance: of the object [m].
            field: (F, 2) of object points.
        Returns: (F, 2, K) in [0, 1]: of sagittal lines, which run along the direction in which the point's image lies
            from the axis, so that their frequency is across it, and of tangential ones; on the axis, in x and in y.
        Raises: ValueError for frequencies that are negative or not finite; as `psf`.
        """
        lines = as_values(frequencies, name="frequencies", unit="cycles per metre").to("cpu", torch.float64).reshape(-1)
        if not bool((lines.isfinite() & (lines >= 0)).all()):
            raise ValueError(
                f"frequencies must be finite and >= 0 cycles per metre, got {lines.tolist()}. 30 line pairs per mm are "
                "30 / mm."
            )
        asked = self._asked(self._colours(wavelengths), distance, field)
        fitted = self.pupils(torch.cat([asked.wavelengths, self._focus_line()]), asked.vergences, asked.heights)
        node = torch.arange(len(fitted.centre)).view(len(asked.heights), -1)
        found = []
        for own in node:
            offsets = fitted.chief[own[:-1]] - fitted.chief[own[-1]]
            parts = [
                analysis.transfer(fitted, int(index), lines, wavelength=wavelength)
                # lateral colour moves the light of a wavelength along the meridian
                * torch.stack([torch.ones_like(lines) + 0j, phasor(-2 * math.pi * lines * offset)])
                for index, wavelength, offset in zip(own, asked.wavelengths.tolist(), offsets, strict=False)
            ]
            found.append(torch.stack(parts).mean(0))
        # a floor far below rounding: no NaN gradient at the zeros of an MTF
        return torch.sqrt(squared(torch.stack(found)) + torch.finfo(torch.float64).tiny)

    @no_more_than_free()
    def spots(
        self,
        wavelengths: Tensor | list[float],
        *,
        distances: Tensor | float,
        field: Tensor | None = None,
        rings: int = 12,
    ) -> tuple[Tensor, Tensor]:
        """Where rays land, relative to the chief ray of the focus wavelength, and the light that each carries.

        Args: as of `psf`; rings: of rays over the stop and a little beyond, R = 1 + 3 rings (rings + 1).
        Returns: points (F, Z, L, R, 2) [m] on the sensor's axes; weights (F, Z, L, R) that sum to the relative
            illumination, to 2 %: 0 for rays that do not pass, a part for those at an edge, and more where rays
            stand farther apart as seen from the image. Without `field` (Z, L, R, 2) and (Z, L, R).
        Raises: ValueError for a point of which no ray passes, and as `psf`.
        """
        asked = self._asked(wavelengths, distances, field)
        points, _, weights = self._landed(asked, rings)
        return (points, weights) if field is not None else (points[0], weights[0])

    @no_more_than_free()
    def refocus(
        self,
        criterion: str = "rms",
        *,
        field: Tensor | None = None,
        distance: float = math.inf,
        wavelengths: Tensor | list[float] | None = None,
        weights: Tensor | None = None,
    ) -> CompoundLens:
        """The same lens with its sensor where spots are least: a new lens of the same surfaces, which are shared.

        Rays that pass go straight on, so the mean squared radius about the centroid is a quadratic in the sensor's
        distance, and the best is exact, for the rays that are there.

        Args:
            criterion: "rms": the sum over fields of the mean squared radius of their spots, of all wavelengths and all
                light that passes.
            field: (F, 2) of object points, None for the axis. distance: of the object [m].
            wavelengths: (L,) [m], None for those of `analysis.SPECTRAL_LINES`.
            weights: (F, L), what each field and wavelength counts; None: all alike.
        Returns: a lens whose `sensor_distance` is a number, or a new Parameter where it was one.
        Raises: ValueError for an unknown criterion, weights that are negative, all 0 or of another shape, a best focus
            that is not behind the lens, and as `spots`.
        """
        if criterion not in analysis.CRITERIA:
            raise ValueError(f"unknown criterion {criterion!r}; known: {', '.join(analysis.CRITERIA)}.")
        asked = self._asked(self._colours(wavelengths), distance, field)
        counts = torch.ones(len(asked.heights), len(asked.wavelengths), dtype=torch.float64)
        if weights is not None:
            given = as_values(weights, name="weights", unit="of each field and wavelength").to("cpu", torch.float64)
            if given.shape != counts.shape or not bool((given >= 0).all() and (given.sum(1) > 0).any()):
                raise ValueError(
                    f"weights must be {tuple(counts.shape)} for fields and wavelengths, >= 0 and not all 0, got shape "
                    f"{tuple(given.shape)}."
                )
            counts = given
        with torch.no_grad():
            points, slopes, light = (part[:, 0] for part in self._landed(asked, rings=24))
            light = light / light.sum(-1, keepdim=True) * counts[..., None]
            lit = counts.sum(1) > 0
            shift = analysis.sharpest(*(part[lit].flatten(1, 2) for part in (points, slopes, light)))
            best = float(float64(self.sensor_distance).detach()) + shift
        if best <= 0:
            raise ValueError(f"the best focus is {-best:g} m inside the lens, not behind it: focus farther away.")
        trained = isinstance(self.sensor_distance, nn.Parameter)
        placed = nn.Parameter(torch.full_like(self.sensor_distance, best)) if trained else best  # type: ignore[arg-type]
        arguments = self.configuration() | {"sensor_distance": placed}
        del arguments["surfaces"]
        return type(self)(*self.surfaces, **arguments)  # type: ignore[arg-type]

    @no_more_than_free()
    def field_limit(self, *, least: float = 0.2, distance: float = math.inf) -> float:
        """Largest height Y / D up to which the relative illumination is above `least` and chief rays pass: by nested
        intervals of the angle, to 0.001 degrees; that of 60 degrees where they do so up to there. distance: of the
        object [m], inf allowed.
        """
        self.check()
        vergences = 1 / check_distances(distance).reshape(-1)
        low, high = 0.0, math.radians(_WIDEST)
        with torch.no_grad():
            for _ in range(_NESTED):
                angles = torch.linspace(low, high, _INTERVALS + 1, dtype=torch.float64)
                heights = torch.cat([angles.new_zeros(1), angles.tan()])
                nodes = self._chiefs(self._focus_line(), vergences, heights)
                light = self._sent(nodes, rings=8)[1].sum(-1)[:, 0, 0]
                passes = nodes.chief.alive[:, 0, 0, 0] & (light > least * light[0])
                fails = torch.nonzero(~passes[1:])
                if not len(fails):
                    return math.tan(high)
                first = int(fails[0])
                low, high = float(angles[max(first - 1, 0)]), float(angles[first])
        return math.tan(low)

    @no_more_than_free()
    def field_curves(
        self,
        heights: Tensor | list[float] | None = None,
        *,
        wavelengths: Tensor | list[float] | None = None,
        distance: float = math.inf,
        frequencies: Tensor | Sequence[float] = (10e3, 30e3),
    ) -> analysis.FieldCurves:
        """What this lens does over its field, in numbers.

        Args: heights: Y / D of object points (F,); None for 11 up to `field_limit`. The others as of `modulation`.
        Raises: as `modulation` and `relative_illumination`.
        """
        if heights is None:
            heights = torch.linspace(0, self.field_limit(distance=distance), 11, dtype=torch.float64)
        field = analysis.upwards(heights)
        grid = self._colours(wavelengths)
        landed = self.image_point(torch.cat([grid, self._focus_line()]), distances=distance, field=field)[:, 0, :, 1]
        points, weights = self.spots(grid, distances=distance, field=field)
        return analysis.FieldCurves(
            heights=field[:, 1],
            image_heights=landed[:, -1].abs(),
            relative_illumination=self.relative_illumination(field, distances=distance),
            distortion=self.distortion(field, distance=distance),
            lateral_colour=landed[:, -1:] - landed[:, :-1],
            rms_spot=analysis.rms_radius(points.flatten(1, 3), weights.flatten(1, 3)),
            mtf=self.modulation(frequencies, wavelengths=grid, distance=distance, field=field),
            wavelengths=grid,
            frequencies=torch.as_tensor(frequencies, dtype=torch.float64, device="cpu"),
        )

    def paths(
        self, heights: Tensor | list[float], *, distance: float = math.inf, count: int = 7, lead: float = 5e-3
    ) -> Tensor:
        """Rays in the plane of the axis that pass, for a drawing: (F, count, K + 3, 2) of z and y [m].

        From `lead` in front of the first vertex, where z = 0, to each of K surfaces and to the sensor, at the focus
        wavelength; evenly from one edge of what passes to the other.
        Raises: ValueError for a point of which no ray passes.
        """
        asked = self._asked([self.focus_wavelength], distance, analysis.upwards(heights))
        with torch.no_grad():
            nodes = self._nodes(asked.wavelengths, asked.vergences, asked.heights)
            px, py = nodes.towards(torch.zeros(241).double(), torch.linspace(-1.2, 1.2, 241, dtype=torch.float64))
            rays = self.launch(nodes.heights, nodes.vergences, px, py)
            landed = self._at_sensor(rays, nodes.indices)
            passes = landed.alive & (torch.stack(landed.clearance) > 0).all(0)
            kept = analysis.evenly(passes[:, 0, 0], count)
            started = rays.y - lead * rays.dy / rays.dz
            vertex, points = torch.zeros((), dtype=torch.float64), [torch.stack([0 * rays.y - lead, started], -1)]
            for k, surface in enumerate(self.surfaces):
                y = trace(self.surfaces, rays, nodes.indices, until=k).y
                points.append(torch.stack([vertex + surface.sag(y**2)[0], y], -1))
                behind = self.sensor_distance if k == len(self.surfaces) - 1 else surface.thickness
                vertex = vertex + float64(behind)
            points.append(torch.stack([vertex + 0 * rays.y, landed.y], -1))
            found = torch.stack(points, dim=-2)[:, 0, 0]
        return torch.gather(found, 1, kept[:, :, None, None].expand(-1, -1, *found.shape[2:]))

    def draw(self, path: str | os.PathLike[str] | None = None) -> Figure:
        """The lens in section, with rays of three points of its field; written to `path` if there is one.

        Raises: ValueError for a file that cannot be written, and as `paths`.
        """
        from kcam import plots  # figures are made of lenses

        figure = plots.section_figure(self)
        if path is not None:
            plots.save_figure(figure, path)
        return figure

    def _colours(self, wavelengths: Tensor | list[float] | None) -> Tensor:
        return wavelength_grid(list(analysis.SPECTRAL_LINES) if wavelengths is None else wavelengths)

    def _focus_line(self) -> Tensor:
        return wavelength_grid([self.focus_wavelength])

    def _sent(self, nodes: _Nodes, rings: int) -> tuple[Rays, Tensor]:
        """Rays over the stop, at the sensor, and the light of each, (F, Z, L, R): see `analysis.light`."""
        x, y, area = analysis.hexapolar(rings)
        beside = analysis.STEP * torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
        x, y = (part + step[:, None, None, None, None] for part, step in zip((x, y), beside, strict=True))
        px, py = nodes.towards(x, y)
        rays = self._at_sensor(self.launch(nodes.heights, nodes.vergences, px, py), nodes.indices)
        return analysis.first(rays), analysis.light(rays, area)

    def _landed(self, asked: _Asked, rings: int) -> tuple[Tensor, Tensor, Tensor]:
        """Points [m] and slopes of rays on the sensor's axes (F, Z, L, R, 2), and their light (F, Z, L, R)."""
        nodes = self._nodes(
            torch.cat([asked.wavelengths, self._focus_line()]),
            asked.vergences,
            torch.cat([asked.heights, asked.heights.new_zeros(1)]),
        )
        rays, light = self._sent(nodes, rings)
        whole = light.sum(-1, keepdim=True)
        if not bool((whole > 0).all()):
            height = float(asked.heights[(whole[:-1] <= 0).flatten(1).any(1)].max())
            raise ValueError(
                f"no ray of a point at {height:.3g} (Y / D) passes this lens. Use smaller fields, or a larger "
                "semi_diameter."
            )
        cx, cy = (part[:, None, None, None] for part in asked.directions.unbind(1))

        def on_sensor(x: Tensor, y: Tensor) -> Tensor:
            x, y = x[:-1, :, :-1], y[:-1, :, :-1]
            return torch.stack([x * cy + y * cx, y * cy - x * cx], dim=-1)

        points = on_sensor(rays.x, rays.y - nodes.chief.y[:, :, -1:])
        return points, on_sensor(rays.dx / rays.dz, rays.dy / rays.dz), light[:-1, :, :-1] / whole[-1:, :, :-1]


@dataclass(frozen=True)
class _Asked:
    """wavelengths (L,), vergences (Z,); heights (F,) of field points, and their directions on the sensor (F, 2)."""

    wavelengths: Tensor
    vergences: Tensor
    heights: Tensor
    directions: Tensor


@dataclass(frozen=True)
class _Nodes:
    """What rays to F x Z x L nodes start from: heights, vergences and indices as they broadcast against rays (..., R);
    where chief rays cross the entrance pupil, and how the stop follows it there: see `CompoundLens.aimed`; the chief
    rays at the sensor, (F, Z, L, 1); and what leads to places of the stop, (F, Z, L, 3): see `CompoundLens._towards`.
    """

    indices: list[Tensor]
    heights: Tensor
    vergences: Tensor
    aim: Tensor
    across: Tensor
    along: Tensor
    chief: Rays
    stop: Tensor

    def towards(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Where rays that come to (x, y) of the stop, in its radii, cross the entrance pupil, about: px and py [m]."""
        beside, above, bent = self.stop.split(1, dim=-1)
        return x * beside.abs(), self.aim + y * above.abs() + y**2 * bent
