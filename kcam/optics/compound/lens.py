"""A real lens from its prescription: exact rays in float64, and the PSFs of any point of the field."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from kcam.cache import ValueCache
from kcam.optics.compound import analysis, modulation, pupil, spots
from kcam.optics.compound.aiming import Asked, Beam, aimed, launch, nodes
from kcam.optics.compound.distortion import ImageHeights, image_heights
from kcam.optics.compound.field import FieldPSFs, bank
from kcam.optics.compound.files import read_lens, write_lens
from kcam.optics.compound.images import Frame, areas
from kcam.optics.compound.prescription import FirstOrder, Prescription, image_distance, refractive_indices
from kcam.optics.compound.presets import preset_surfaces
from kcam.optics.compound.surface import Surface
from kcam.optics.compound.table import tabulate
from kcam.optics.compound.tracing import Rays
from kcam.optics.elements.element import check_numbers, place_sensor
from kcam.optics.numerics import Scalar
from kcam.optics.source import Defocus, PixelGrid, Points
from kcam.threads import no_more_than_free
from kcam.units import check_distances, check_pixel_pitch, check_positive, wavelength_grid

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
        place = functools.partial(image_distance, self.surfaces, self.focus_wavelength)
        place_sensor(self, focus_distance, sensor_distance, image_distance=place)

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
        write_lens(path, self._prescription)

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

    @property
    def _prescription(self) -> Prescription:
        """The lens as data, which the rooms of this package take."""
        return Prescription(tuple(self.surfaces), self.sensor_distance, self.focus_wavelength)

    # ---- paraxial --------------------------------------------------------------------------------------------------

    @property
    def stop(self) -> int:
        """Which surface is the aperture stop."""
        return self._prescription.stop

    def indices(self, wavelengths: Tensor) -> list[Tensor]:
        """Refractive index in front of the lens and behind each surface, K + 1 of (L,) float64."""
        return refractive_indices(self.surfaces, wavelengths)

    def first_order(self, wavelength: float | None = None) -> FirstOrder:
        """Focal length and pupils [m] at a wavelength [m]; None for that of focus."""
        return self._prescription.first_order(wavelength)

    def focal_length(self, wavelength: float | None = None) -> float:
        """Paraxial focal length [m] at a wavelength [m]; None for that of focus."""
        return float(self.first_order(wavelength).focal_length.detach())

    @property
    def f_number(self) -> float:
        """Working f-number: from the exit pupil to the sensor, over its width."""
        first = self.first_order()
        distance = self._prescription.sensor_away - first.exit_pupil
        return float((distance / (2 * first.exit_semi_diameter)).detach())

    # ---- exact rays ------------------------------------------------------------------------------------------------

    def launch(
        self, heights: Tensor, vergences: Tensor, px: Tensor, py: Tensor, *, entrance: Tensor | None = None
    ) -> Rays:
        """Rays at the plane of the first vertex, from points at (0, heights) through (px, py) of the entrance pupil.

        Args: heights: Y / D. vergences: 1 / distance from the first vertex [1/m]. px, py: [m]; all broadcast.
            entrance: where that pupil is [m], where it is known: see `first_order`.
        """
        known = self.first_order().entrance_pupil if entrance is None else entrance
        return launch(heights, vergences, px, py, entrance=known)

    def aimed(self, heights: Tensor, vergences: Tensor, indices: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Height in the entrance pupil at which chief rays pass the middle of the stop [m], and how the stop's x and y
        follow those of the entrance pupil there; shape of what broadcasts.
        """
        return aimed(Beam(self._prescription, heights, vergences, indices, self.first_order()))

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
        waves, passes = pupil.opd(self._prescription, self._asked(wavelengths, distances, field), samples)
        return (waves, passes) if field is not None else (waves[0], passes[0])

    def pupils(self, wavelengths: Tensor, vergences: Tensor, heights: Tensor) -> pupil.PupilFit:
        """Pupils of F x Z x L nodes, in this order: heights (F,) >= 0, vergences (Z,) [1/m], wavelengths (L,) [m]."""
        return pupil.pupils(self._prescription, wavelengths, vergences, heights)

    # ---- images of points ------------------------------------------------------------------------------------------

    def image_point(
        self, wavelengths: Tensor | list[float], *, distances: Tensor | float, field: Tensor | None = None
    ) -> Tensor:
        """Where each wavelength's chief ray lands on the sensor [m]: (F, Z, L, 2), without `field` (Z, L, 2).

        Args: as of `psf`.
        """
        asked = self._asked(wavelengths, distances, field)
        chief = self._chief_heights(asked.wavelengths, asked.vergences, asked.heights)
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
        landed = self._chief_heights(asked.wavelengths, asked.vergences, heights)[:, 0, 0]
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
        middle = self._chief_heights(self._prescription.focus_line, asked.vergences, heights)
        chief = fitted.chief.view(len(heights), len(asked.vergences), -1)
        found = bank(fitted, asked.wavelengths, asked.directions, (chief - middle)[:-1], pixels)
        return found if field is not None else found[0]

    # ---- as a source of PSFs ---------------------------------------------------------------------------------------

    @property
    def focus_distance(self) -> float:
        """Object distance from the first vertex that is imaged onto the sensor paraxially [m]; inf for beyond."""
        vergence = float(self._prescription.focus().detach())
        return 1 / vergence if vergence > 1e-9 else math.inf

    @property
    def image_scale(self) -> Tensor:
        """Height of the image of a point near the axis over the point's own (Y / D) [m]."""
        return self._prescription.image_scale

    def aperture_area(self) -> float:
        """The pupil's area in direction cosines times the squared sensor distance [m^2]: as exposure takes it."""
        with torch.no_grad():
            zero = torch.zeros(1, dtype=torch.float64)
            fitted = self.pupils(self._prescription.focus_line, zero + self._prescription.focus(), zero)
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
            focus = [float(self._prescription.focus(float(end))) for end in ends]
            spread = float(self.first_order().entrance_semi_diameter * self.image_scale) / pixel_pitch
            middle = torch.tensor([sum(focus) / 2], dtype=torch.float64)
            side = self.over_field(0.0, middle, ends).blur()
        airy = 0.61 * float(ends.max()) * 2 * self.f_number
        return Defocus((min(focus), max(focus)), spread, (side + airy) / pixel_pitch)

    def image_heights(self, reach: float) -> ImageHeights:
        """How images lie on the sensor, up to `reach` from the axis [m]: by chief rays of the focus.

        Raises: ValueError for a sensor that reaches beyond the field of the lens.
        """
        return image_heights(self._prescription, reach)

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

    def _asked(self, wavelengths: Tensor | list[float], distances: Tensor | float, field: Tensor | None) -> Asked:
        self.check()
        return Asked.of(wavelengths, distances, field)

    def _chief_heights(self, wavelengths: Tensor, vergences: Tensor, heights: Tensor) -> Tensor:
        """Where chief rays land, along the direction of their points, (F, Z, L) [m]."""
        return nodes(self._prescription, wavelengths, vergences, heights).chief.y[..., 0]

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
        found = modulation.maps(self._prescription, asked, pixels)
        return found if field is not None else found[0]

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
        asked = self._asked(self._colours(wavelengths), distance, field)
        return modulation.curves(self._prescription, asked, frequencies)

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
        points, _, weights = spots.landed(self._prescription, self._asked(wavelengths, distances, field), rings)
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
        if criterion not in spots.CRITERIA:
            raise ValueError(f"unknown criterion {criterion!r}; known: {', '.join(spots.CRITERIA)}.")
        asked = self._asked(self._colours(wavelengths), distance, field)
        best = spots.best_focus(self._prescription, asked, weights)
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
        return spots.field_limit(self._prescription, 1 / check_distances(distance).reshape(-1), least)

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
        colours = torch.cat([grid, self._prescription.focus_line])
        landed = self.image_point(colours, distances=distance, field=field)[:, 0, :, 1]
        points, weights = self.spots(grid, distances=distance, field=field)
        return analysis.FieldCurves(
            heights=field[:, 1],
            image_heights=landed[:, -1].abs(),
            relative_illumination=self.relative_illumination(field, distances=distance),
            distortion=self.distortion(field, distance=distance),
            lateral_colour=landed[:, -1:] - landed[:, :-1],
            rms_spot=spots.rms_radius(points.flatten(1, 3), weights.flatten(1, 3)),
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
        return analysis.paths(self._prescription, asked, count, lead)

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
