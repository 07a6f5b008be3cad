"""A real lens from its prescription: exact rays in float64, and the PSFs of any point of the field."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from kcam.inputs import as_values
from kcam.optics.compound import pupil
from kcam.optics.compound.distortion import NODES, ImageHeights
from kcam.optics.compound.field import FieldPSFs, bank
from kcam.optics.compound.files import read_lens, write_lens
from kcam.optics.compound.images import Frame, areas
from kcam.optics.compound.presets import preset_surfaces
from kcam.optics.compound.surface import Surface
from kcam.optics.compound.table import tabulate
from kcam.optics.compound.tracing import Rays, system_matrix, trace
from kcam.optics.elements.element import check_numbers, place_sensor
from kcam.optics.numerics import Scalar, float64
from kcam.optics.source import Defocus, PixelGrid, Points
from kcam.units import check_distances, check_pixel_pitch, check_positive, wavelength_grid

_AIMING = 10  # steps of the secant that aims a chief ray
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
    Valid for scalar light; surfaces are refracting, without coatings, and share one axis. PSFs are good to 1e-3 of
    their light down to f/4, and 3e-3 at f/1.85, against a sum over rays (tests/optics/test_compound.py).
    Object points are (X / D, Y / D) with D from the paraxial entrance pupil; light falls as in `units`: a point at
    (0, +t) lands at y of about -f t.
    """

    surfaces: Sequence[Surface]
    sensor_distance: Scalar

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
        self.focus_wavelength = float(wavelength_grid([focus_wavelength]))
        place_sensor(self, focus_distance, sensor_distance, image_distance=self._focused)

    @classmethod
    def preset(cls, name: str, *, focus_distance: float = math.inf, focus_wavelength: float = 550e-9) -> CompoundLens:
        """A lens from its patent: a name in `presets.PRESETS`. Raises: ValueError for an unknown one."""
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

    def first_order(self, wavelength: float | None = None) -> FirstOrder:
        """Focal length and pupils at a wavelength [m]; None for that of focus."""
        grid = wavelength_grid([self.focus_wavelength if wavelength is None else wavelength])
        indices = [index[0] for index in self.indices(grid)]
        matrix = system_matrix(self.surfaces, indices)
        front = system_matrix(self.surfaces[: self.stop + 1], indices, refract_last=False)
        # behind the stop: from its vertex, which refracts, to the last
        back = system_matrix(self.surfaces[self.stop :], indices[self.stop :])
        semi = float64(self.surfaces[self.stop].semi_diameter)  # type: ignore[arg-type]
        return FirstOrder(
            focal_length=-1 / matrix[1, 0],
            back_focus=-matrix[0, 0] / matrix[1, 0],
            entrance_pupil=front[0, 1] / front[0, 0],
            entrance_semi_diameter=semi / front[0, 0].abs(),
            exit_pupil=-back[0, 1] / back[1, 1],
            exit_semi_diameter=semi / back[1, 1].abs(),
        )

    def focal_length(self, wavelength: float | None = None) -> float:
        """Paraxial [m]."""
        return float(self.first_order(wavelength).focal_length.detach())

    @property
    def f_number(self) -> float:
        """Working f-number: from the exit pupil to the sensor, over its width."""
        first = self.first_order()
        distance = float64(self.sensor_distance) - first.exit_pupil
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
        e = (self.first_order().entrance_pupil if entrance is None else entrance).to(px.device)
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
        step = 1e-3 * first.entrance_semi_diameter.detach()

        def landed(px: Tensor, py: Tensor) -> Rays:
            return trace(
                self.surfaces,
                self.launch(heights, vergences, px, py, entrance=first.entrance_pupil),
                indices,
                until=self.stop,
            )

        shape = torch.broadcast_shapes(heights.shape, vergences.shape, *(index.shape for index in indices))
        zero = torch.zeros(shape, dtype=torch.float64, device=heights.device)
        with torch.no_grad():
            before, now = zero, zero + step
            low, high = (landed(zero, at).y for at in (before, now))
            for _ in range(_AIMING):
                slope = (high - low) / torch.where(now == before, 1.0, now - before)
                slope = torch.where(slope.abs() < 1e-6, 1.0, slope)
                before, low, now = now, high, now - high / slope
                high = landed(zero, now).y
            along = (landed(zero, now + step).y - high) / step
            across = landed(zero + step, now).x / step
        return now - landed(zero, now).y / along, across, along

    def _nodes(self, wavelengths: Tensor, vergences: Tensor, heights: Tensor) -> _Nodes:
        """Chief rays of heights (F,), vergences (Z,) and wavelengths (L,). Raises: ValueError where one is lost."""
        indices = [index.to(heights.device)[None, None, :, None] for index in self.indices(wavelengths)]
        t, v = heights[:, None, None, None], vergences[None, :, None, None]
        aim, across, along = self.aimed(t, v, indices)
        chief = self._at_sensor(self.launch(t, v, torch.zeros_like(aim), aim), indices)
        if not bool(chief.alive.all()):
            height = float(t.expand(chief.alive.shape)[~chief.alive].max())
            raise ValueError(
                f"the chief ray of a point at {height:.3g} (Y / D) misses a surface or is totally reflected: the field "
                "of this lens is smaller. Use smaller fields."
            )
        return _Nodes(indices, t, v, aim, across, along, chief)

    def _at_sensor(self, rays: Rays, indices: list[Tensor]) -> Rays:
        rays = trace(self.surfaces, rays, indices)
        t = float64(self.sensor_distance).to(rays.x.device) / rays.dz
        return Rays(
            rays.x + t * rays.dx, rays.y + t * rays.dy, rays.dx, rays.dy, rays.path + t, rays.alive, rays.clearance
        )

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
        """
        asked = self._asked(wavelengths, distances, field)
        nodes = self._nodes(asked.wavelengths, asked.vergences, asked.heights)
        chief = nodes.chief
        semi = float64(self.surfaces[self.stop].semi_diameter)  # type: ignore[arg-type]
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
        away = float64(self.sensor_distance) - self.first_order().exit_pupil
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
        semi = float64(self.surfaces[self.stop].semi_diameter).detach()  # type: ignore[arg-type]
        x, y = pupil.rays_over_stop(heights.device)
        px, py = x * (semi / nodes.across.abs()), nodes.aim + y * (semi / nodes.along.abs())
        chief = nodes.chief
        rays = self._at_sensor(self.launch(nodes.heights, nodes.vergences, px, py), nodes.indices)
        wavefront = rays.path - rays.dx * rays.x - rays.dy * (rays.y - chief.y) - chief.path
        clearances = torch.stack(rays.clearance, dim=-2)
        flat = [part.flatten(0, 2) for part in (rays.dx, rays.dy, wavefront, clearances, rays.alive, chief.y[..., 0])]
        return pupil.fit(*flat, enough=pupil.ENOUGH * float(wavelengths.min()))

    # ---- images of points ------------------------------------------------------------------------------------------

    def image_point(
        self, wavelengths: Tensor | list[float], *, distances: Tensor | float, field: Tensor | None = None
    ) -> Tensor:
        """Where each wavelength's chief ray lands on the sensor [m]: (F, Z, L, 2), without `field` (Z, L, 2)."""
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
        """Irradiance of a uniform radiance, over that on the axis, (F,): mean over wavelengths and distances."""
        asked = self._asked([self.focus_wavelength] if wavelengths is None else wavelengths, distances, field)
        heights = torch.cat([asked.heights.new_zeros(1), asked.heights])
        fitted = self.pupils(asked.wavelengths, asked.vergences, heights)
        found = areas(fitted, Frame.of(fitted, heights.new_tensor([[0.0, 1.0]]).expand(len(fitted.centre), 2)))
        found = found.view(len(heights), -1)
        return (found[1:] / found[:1]).mean(1)

    def distortion(self, field: Tensor, *, wavelength: float | None = None, distance: float = math.inf) -> Tensor:
        """Height of the chief ray's image over that of a lens without distortion, less 1, (F,)."""
        asked = self._asked([self.focus_wavelength if wavelength is None else wavelength], distance, field)
        near = 1e-4 * torch.ones(1, dtype=torch.float64)
        heights = torch.cat([near, asked.heights])
        landed = self._nodes(asked.wavelengths, asked.vergences, heights).chief.y[:, 0, 0, 0]
        ideal = landed[0] / near[0] * asked.heights
        return torch.where(asked.heights > 0, landed[1:] / torch.where(ideal == 0, 1.0, ideal) - 1, 0.0)

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
        away = float64(self.sensor_distance)
        return (-(a + away * c) / (b + away * d)).clamp(min=0)

    @property
    def image_scale(self) -> Tensor:
        """Height of the image of a point near the axis over the point's own (Y / D) [m]."""
        first = self.first_order()
        away = float64(self.sensor_distance) - first.exit_pupil
        return away * first.entrance_semi_diameter / first.exit_semi_diameter

    def aperture_area(self) -> float:
        """The pupil's area in direction cosines times the squared sensor distance [m^2]: as exposure takes it."""
        with torch.no_grad():
            zero = torch.zeros(1, dtype=torch.float64)
            fitted = self.pupils(wavelength_grid([self.focus_wavelength]), zero + self._focus(), zero)
            area = areas(fitted, Frame.of(fitted, torch.tensor([[0.0, 1.0]], dtype=torch.float64)))
        return float(area) * float(self.sensor_distance) ** 2

    def bank(self, points: Points, wavelengths: Tensor, pixels: PixelGrid) -> Tensor:
        """PSFs (N, L, h, w) of source points, on the axis unless they have positions: see `PSFSource`."""
        places = torch.zeros(len(points.vergences), 2) if points.positions is None else points.positions
        places = places.to(torch.float64)
        field = self.over_field(float(places.norm(dim=1).max()), points.vergences, wavelengths)
        if points.positions is None:
            return field.bank(places[:1], pixels)[0]
        found = field.bank(places, pixels)
        return found[torch.arange(len(places)), torch.arange(len(places))]

    def window(self, points: Points, wavelengths: Tensor, pixels: PixelGrid) -> tuple[int, int]:
        """The window that holds all but 0.1 % of the light of points on the axis: see `PSFSource`."""
        reach = 0.0 if points.positions is None else float(points.positions.norm(dim=1).max())
        return self.over_field(reach, points.vergences, wavelengths).window(pixels)

    def defocus_waves(self, wavelengths: Tensor) -> float:
        """a^2 / (2 lambda) at the shortest wavelength, of the entrance pupil."""
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
        grid, focus = wavelength_grid([self.focus_wavelength]), self._focus()[None]
        scale = self.image_scale

        def landed(heights: Tensor) -> Tensor:
            return -self._nodes(grid, focus, heights).chief.y[:, 0, 0, 0]

        with torch.no_grad():
            highest = reach / scale
            try:
                for _ in range(_AIMING):  # the image of the highest point lies at the sensor's corner
                    highest = highest * reach / landed(highest[None])[0]
                highest = 1.005 * highest
                landed(highest[None])
            except ValueError as error:
                raise ValueError(
                    f"the sensor reaches {reach * 1e3:.3g} mm from the axis, beyond the field of this lens: {error}"
                ) from error
            angles = (torch.arange(NODES, dtype=torch.float64) + 0.5) * (math.pi / (2 * NODES))
        heights = highest * torch.cos(angles)
        return ImageHeights.through(heights, landed(heights), scale)

    def over_field(
        self, reach: float, vergences: Tensor, wavelengths: Tensor, *, mixing: Tensor | None = None
    ) -> FieldPSFs:
        """PSFs of all places up to `reach` from the axis [m], for points at vergences (Z,) [1/m] and wavelengths (L,)
        [m]; mixing: see `source.FieldSource`.
        """
        self.check()
        heights = self.image_heights(max(reach, 1e-9))
        square = torch.tensor(reach, dtype=torch.float64) ** 2
        highest = reach * float(heights.over_radius(square).detach())
        table = tabulate(
            lambda t, v, colours: self.pupils(colours, v, t),
            highest=highest,
            vergences=vergences.to(torch.float64),
            wavelengths=wavelengths.to(torch.float64),
        )
        return FieldPSFs(table, heights, vergences.to(torch.float64), wavelengths.to(torch.float64), reach, mixing)

    def _asked(self, wavelengths: Tensor | list[float], distances: Tensor | float, field: Tensor | None) -> _Asked:
        self.check()
        points = torch.zeros(1, 2, dtype=torch.float64)
        if field is not None:
            points = as_values(field, name="field", unit="X / D, Y / D").to(torch.float64)
        if points.ndim != 2 or points.shape[1] != 2 or not len(points) or not bool(points.isfinite().all()):
            raise ValueError(f"field must be finite, (F, 2) of X / D and Y / D, got shape {tuple(points.shape)}.")
        heights = points.square().sum(1).clamp(min=1e-300).sqrt() * (points != 0).any(1)
        away = torch.where(heights[:, None] > 0, points / heights.clamp(min=1e-150)[:, None], points.new_tensor([0, 1]))
        return _Asked(wavelength_grid(wavelengths), 1 / check_distances(distances).reshape(-1), heights, away)


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
    where chief rays cross the entrance pupil, and how the stop follows it there: see `CompoundLens.aimed`; and the
    chief rays at the sensor, (F, Z, L, 1).
    """

    indices: list[Tensor]
    heights: Tensor
    vergences: Tensor
    aim: Tensor
    across: Tensor
    along: Tensor
    chief: Rays
