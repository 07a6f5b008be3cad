"""A lens: thin elements in one pupil plane, at a distance from the sensor."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from numbers import Integral
from typing import Any, Required, TypedDict, Unpack

import torch
from torch import Tensor

from kcam.cache import seen
from kcam.inputs import as_values
from kcam.optics.accuracy import Recipe
from kcam.optics.elements.stack import ElementStack
from kcam.optics.numerics import float64
from kcam.optics.propagation.analysis import encircled_energy, mtf
from kcam.optics.propagation.explanation import Explanation, explain_query
from kcam.optics.propagation.grid import sample_counts
from kcam.optics.propagation.off_axis import relative_illumination
from kcam.optics.propagation.question import Query, Sampling, residual_vergence
from kcam.optics.propagation.sampling import KAPPA, MAX_PUPIL_SAMPLES
from kcam.optics.propagation.table import choose
from kcam.optics.propagation.thin_field import ThinFieldPSFs
from kcam.optics.pupil.warp import warp_terms
from kcam.optics.source import Defocus, PixelGrid, Points
from kcam.units import check_distances, check_pixel_pitch, wavelength_grid

OUTSIDE_SHARE = 1e-3  # of the light that the default window may leave out
WIDEST = 60.0  # degrees from the axis
TESTED_F_NUMBERS = (1.8, 100.0)
"""Within these the non-paraxial PSF is held to Rayleigh-Sommerfeld.

To 1e-2 at f/1.8 and f/100 for focal lengths of 4.3 mm, ideal or plano-convex, from 0.5 m to infinity (tests/stability);
to what `explain` states from 4 to 100 mm and f/1.8 to f/64 (tests/optics/test_model_error.py). Faster, aberrations send
light where the Debye map does not hold: 0.5 for a plano-convex lens at f/1.4. Slower, pinholes spread it to angles at
which obliquity counts: 0.07 at f/1000.
"""


class PSFArguments(TypedDict, total=False):
    """What `Lens.psf` takes beside the wavelengths, and all that looks at its PSFs too."""

    distances: Required[Tensor | float]
    pixel_pitch: Required[float]
    shape: Required[tuple[int, int]]
    propagator: str
    method: str | None
    samples: int | None
    fill_factor: float
    integrate: bool
    dtype: torch.dtype


_DEFAULT = Recipe()


def _by_field(found: Tensor, field: Tensor | None) -> Tensor:
    """(F, Z, ...) of what is known of F x Z points, (Z, ...) without field."""
    return found if field is None else found.unflatten(0, (len(field), -1))


class Lens(ElementStack):
    """Thin elements whose optical paths add in one pupil plane, in front of a sensor.

    Args:
        elements: the parts of the lens; exactly one is an aperture.
        focus_distance: sets the sensor where the lens focuses an object at this distance [m], inf allowed; paraxially,
            at `focus_wavelength`, once: training the elements later does not move the sensor.
        sensor_distance: pupil to sensor [m], instead; may be a Parameter.
        focus_wavelength: [m].
    Field points are (X / D, Y / D) of an object in the plane at the axial distance D from the elements; light falls as
    in `units`: a point at (0, +t) lands at y = -d t.
    Raises:
        ValueError for no or two apertures, both or neither distance, a focus inside the focal length, r >= R.
        TypeError for something that is no element.

    Example:
    >>> lens = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), focus_distance=2.0)
    >>> f"{lens.sensor_distance / mm:.2f} mm, f/{lens.f_number:.1f}"  # 1 / d = 1 / f - 1 / z
    '51.28 mm, f/10.3'
    """

    varies = False

    def psf(
        self,
        wavelengths: Tensor | list[float],
        *,
        distances: Tensor | float,
        pixel_pitch: float,
        shape: tuple[int, int],
        propagator: str = "nonparaxial",
        method: str | None = None,
        samples: int | None = None,
        fill_factor: float = 1.0,
        integrate: bool = True,
        dtype: torch.dtype = torch.float32,
        field: Tensor | None = None,
    ) -> Tensor:
        """Energy of a point source's image in each pixel, relative to the light that passes the aperture.

        Args:
            wavelengths: (L,) [m]. distances: object distances, a number or (Z,) [m], inf allowed.
            pixel_pitch: [m]. shape: (H, W) of the window in pixels; index n // 2 is the origin.
            propagator: the physics: nonparaxial, fresnel, angular_spectrum, geometric, reference.
            method: the transform: matrix, chirp_z, fft, radial; None: the cheapest that is exact for this lens.
            samples: across the pupil; None: by the rule of `sampling.pupil_samples`.
            fill_factor: light-sensitive share of a pixel; the PSF is averaged over that square in its centre.
            integrate: over the pixels; False: the irradiance at their centres times the pixel's area.
            dtype: of the result, float32 or float64.
            field: (F, 2) of object points, X / D and Y / D; None: the axis. Elements are then thin screens in one
                plane, with the phase that they have on the axis, and paths to and from them are exact: coma,
                astigmatism, field curvature (3 : 1, without the 1 / n that glass adds) and cos^4 come of themselves.
        Returns:   (Z, L, H, W), >= 0 up to the sampling error; sums to the share of light in the window. With field
                   (F, Z, L, H, W), relative to the light of a point on the axis: sums to the relative illumination,
                   less what leaves the window, in whose centre is the image of the chief ray, `image_point`.
        Raises:    ValueError for lengths that are not in metres, distances <= 0, an unknown propagator or method, a
                   shape that is not two positive integers, a pupil too coarse for the window (with the sampling that
                   would do), a lens whose parameters were trained or loaded into NaN, a field of another shape, not
                   finite or beyond 60 degrees, and for a propagator or method of choice off the axis.
        Warns:     UserWarning for an f-number outside `TESTED_F_NUMBERS`.
        Valid for thin elements and scalar light; `explain` estimates the error on the axis. Off it the kernel is off by
        a phase of about pi a^2 r^2 / (lambda d^3) a distance r from the centre: 1e-3 of the light in windows of 0.3 mm
        at 50 mm f/12 or of 0.2 mm at 8 mm f/8, up to 12 degrees; 1e-2 where r is 45 um at 4 mm f/2.
        """
        query = self.query(
            wavelengths,
            distances=distances,
            pixel_pitch=pixel_pitch,
            shape=shape,
            samples=samples,
            fill_factor=fill_factor,
            integrate=integrate,
            dtype=dtype,
            field=field,
        )
        return _by_field(choose(query, propagator=propagator, method=method)(query), field)

    def explain(self, wavelengths: Tensor | list[float], **arguments: Unpack[PSFArguments]) -> Explanation:
        """What `psf` will do with the same arguments: the row, its sampling, its error, and the energy in the window.

        Args: those of `psf`.
        Returns: a value to print; its fields are the numbers. Errors are estimated without computing the PSFs: never
            more than 3 times too small, down to 1e-6, over random cameras. The captured energy is computed.
        """
        query, how = self._asked(wavelengths, **arguments)
        return explain_query(query, **how)

    def _asked(
        self,
        wavelengths: Tensor | list[float],
        *,
        propagator: str = "nonparaxial",
        method: str | None = None,
        **asked: Any,
    ) -> tuple[Query, dict[str, Any]]:
        """The question in the arguments of `psf`, and how it is to be answered."""
        return self.query(wavelengths, **asked), {"propagator": propagator, "method": method}

    def query(
        self,
        wavelengths: Tensor | list[float],
        *,
        distances: Tensor | float,
        pixel_pitch: float,
        shape: tuple[int, int],
        samples: int | None = None,
        fill_factor: float = 1.0,
        integrate: bool = True,
        dtype: torch.dtype = torch.float32,
        device: torch.device | None = None,
        field: Tensor | None = None,
    ) -> Query:
        """The arguments of `psf`, checked, as one value, which a row of `PROPAGATORS` answers: ``row(query)``."""
        if device is None:
            device = next((t.device for t in (*self.parameters(), *self.buffers())), torch.device("cpu"))
        pixels = PixelGrid(check_pixel_pitch(pixel_pitch), shape, fill_factor, integrate, dtype, device)
        grid = check_distances(distances)
        if grid.ndim > 1 or grid.numel() == 0:
            raise ValueError(
                f"distances must be a number or a vector (Z,) with Z >= 1, got shape {tuple(grid.shape)}. Use [2.0]."
            )
        points = Points(1 / grid.reshape(-1))
        if field is not None:
            places, depths = self._places(field), len(points.vergences)
            points = Points(points.vergences.repeat(len(places)), places.repeat_interleave(depths, dim=0))
        return self._question(points, wavelengths, pixels, Recipe(samples=samples))

    def _places(self, field: Tensor) -> Tensor:
        """Where the chief rays of object points (F, 2) land, (F, 2) [m]: they go straight on."""
        points = as_values(field, name="field", unit="X / D, Y / D").to(torch.float64)
        if points.ndim != 2 or points.shape[1] != 2 or not len(points) or not bool(points.isfinite().all()):
            raise ValueError(f"field must be finite, (F, 2) of X / D and Y / D, got shape {tuple(points.shape)}.")
        angle = math.degrees(math.atan(float(points.detach().norm(dim=1).max())))
        if angle > WIDEST:
            raise ValueError(
                f"field reaches {angle:.3g} degrees, and thin elements are known up to {WIDEST:g}. It is a tangent, "
                f"X / D: keep it below {math.tan(math.radians(WIDEST)):.3g}."
            )
        return -points * float64(self.sensor_distance).to(points.device)

    def mtf(
        self, wavelengths: Tensor | list[float], *, field: Tensor | None = None, **arguments: Unpack[PSFArguments]
    ) -> Tensor:
        """Modulation transfer function, |OTF| / OTF(0) of the light in the window, times the pixel's own sinc.

        Args: those of `psf`; integrate=False leaves out the pixel's sinc: the optics alone.
        Returns: (Z, L, H, W) in [0, 1], with `field` (F, Z, L, H, W); index n // 2 is frequency 0, the step is
            1 / (n * pixel_pitch) cycles per metre.
        """
        query, how = self._asked(wavelengths, field=field, **arguments)
        return _by_field(mtf(query, **how), field)

    def encircled_energy(self, wavelengths: Tensor | list[float], **arguments: Unpack[PSFArguments]) -> Tensor:
        """Share of the light through the aperture that falls within a circle around the origin.

        The irradiance is evaluated between the pixels, at a quarter of its Nyquist pitch, and summed with the edge
        weights of a disc: no pixel counts as a whole.

        Args: those of `psf`; fill_factor and integrate change nothing, for the irradiance is what counts here.
        Returns: (Z, L, K + 1) for radii k * pixel_pitch, k = 0..K = min(H, W) // 2, rising from 0.
        """
        query, how = self._asked(wavelengths, **arguments)
        return encircled_energy(query, **how)

    def image_point(
        self, wavelengths: Tensor | list[float], *, distances: Tensor | float, field: Tensor | None = None
    ) -> Tensor:
        """Where each chief ray lands on the sensor [m], straight through the middle of the elements: (F, Z, L, 2),
        without `field` (Z, L, 2); field: (F, 2) of X / D and Y / D.
        """
        places = self._places(torch.zeros(1, 2) if field is None else field)
        shape = (check_distances(distances).numel(), len(wavelength_grid(wavelengths)))
        found = places[:, None, None].expand(-1, *shape, -1)
        return found[0] if field is None else found

    def relative_illumination(self, field: Tensor) -> Tensor:
        """Irradiance of an even scene over that on the axis, (F,) float64; field: (F, 2) of X / D and Y / D.

        The aperture's area in direction cosines as seen from the image, nearly cos^4: INT d^2 / R0^4 d^2 p.
        """
        arguments: Any = {"distances": math.inf, "pixel_pitch": 1e-6, "shape": (1, 1)}
        return relative_illumination(self.query([self.focus_wavelength], field=field, **arguments))

    # ---- as a source of PSFs ---------------------------------------------------------------------------------------

    def question(self, points: Points, wavelengths: Tensor, pixels: PixelGrid, recipe: Recipe = _DEFAULT) -> Query:
        """What `bank` asks of a propagator."""
        check_distances(1 / points.vergences.detach())
        check_pixel_pitch(pixels.pitch)
        return self._question(points, wavelengths, pixels, recipe)

    def _question(self, points: Points, wavelengths: Tensor | list[float], pixels: PixelGrid, recipe: Recipe) -> Query:
        samples, kappa = recipe.samples, recipe.kappa
        if samples is not None and (not isinstance(samples, Integral) or samples < 32):
            raise ValueError(f"samples must be an integer >= 32 across the pupil, or None, got {samples!r}.")
        if samples is not None and samples > MAX_PUPIL_SAMPLES:
            raise ValueError(
                f"samples {samples} across the pupil is above the limit of {MAX_PUPIL_SAMPLES}. Leave samples out for "
                "as many as this PSF needs, or use a smaller shape."
            )
        seen(self, "check", self.check)
        seen(self, "f-number", self._check_f_number)
        where = points.positions
        where = None if where is None else where.to(pixels.device, torch.float64)
        points = Points(points.vergences.to(pixels.device, torch.float64), where)
        how = Sampling(KAPPA if kappa is None else kappa, None if samples is None else int(samples))
        return Query(self, wavelength_grid(wavelengths), points, pixels, how)

    def bank(self, points: Points, wavelengths: Tensor, pixels: PixelGrid, recipe: Recipe = _DEFAULT) -> Tensor:
        """PSFs (N, L, h, w) of source points: see `PSFSource`."""
        query = replace(self.question(points, wavelengths, pixels, recipe), whole=True)
        return recipe.row(query)(query)

    def operations(
        self, points: Points, wavelengths: Tensor, pixels: PixelGrid, recipe: Recipe = _DEFAULT
    ) -> dict[str, float]:
        """What a bank takes, by kind of work; twice as many bytes take twice as long.

        map: pixels of the maps, and the samples that their field is warped onto, times the terms that this takes; of
        transmissions alone, which have no imaginary part, once for all wavelengths that share a grid.
        """
        query = self.question(points, wavelengths, pixels, recipe)
        row = recipe.row(query)
        found = {row.kind: row.cost(query) * pixels.dtype.itemsize / 4}
        if query.has_pixels:
            maps = sum(map_.values.numel() for map_ in self.pixel_maps(query.wavelengths))
            counts, share = (sample_counts(query), 1.0) if query.has_pixel_phase else ({*sample_counts(query)}, 0.5)
            tau = float(query.tau.detach())
            warps = (0.0 if row.paraxial else warp_terms(count, tau) * count**2 for count in counts)
            found["map"] = sum(maps + warp for warp in warps) * share
        return found

    def window(self, points: Points, wavelengths: Tensor, pixels: PixelGrid) -> tuple[int, int]:
        """The window (H, W) that holds all but 0.1 % of the light [pixels].

        Half width = blur + lambda d P / (2 pi^2 A 1e-3): the rays' displacement, and the tail that diffraction at a
        rim of length P around an area A spreads beyond a radius. Profiles of rings scatter light beyond their rays:
        then the blur holds all but a tenth of the share.
        """
        query = self.question(points, wavelengths, replace(pixels, shape=(1, 1), dtype=torch.float64))
        blur = float((query.spread(OUTSIDE_SHARE / 10) + self.pixel_phase_displacement(query.wavelengths)).max())
        tail = float(wavelengths.max()) * float(query.sensor_distance.detach()) / (2 * math.pi**2 * OUTSIDE_SHARE)
        side = 2 * math.ceil((blur + tail * self.rim_per_area()) / pixels.pitch) + 1
        return side, side

    def defocus_waves(self, wavelengths: Tensor) -> float:
        """a^2 / (2 lambda) at the shortest wavelength: waves at the rim for each 1/m of vergence."""
        return float(self.aperture.semi_aperture().detach()) ** 2 / (2 * float(wavelengths.min()))

    def defocus(self, wavelengths: Tensor, pixel_pitch: float) -> Defocus:
        """How far light is spread, for a planner: see `source.Defocus`; wavelengths (L,) [m], pixel_pitch [m]."""
        pixels = PixelGrid(pixel_pitch, (1, 1))
        with torch.no_grad():
            query = self.question(Points(torch.zeros(1, dtype=torch.float64)), wavelengths, pixels)
            low, high = sorted((-residual_vergence(query)).aminmax())
            middle = ((low + high)[None] / 2).clamp(min=1e-9)  # a lens may be focused behind itself
            query = self.question(Points(middle.cpu()), wavelengths, pixels)
            semi, distance = float(query.semi_aperture), float(query.sensor_distance)
            spread = semi * distance / pixel_pitch
            rays = float(query.displacement.max()) + self.pixel_phase_displacement(query.wavelengths)
            airy = 0.61 * float(wavelengths.max()) * distance / semi
        floor = (
            max(0.0, rays / pixel_pitch - spread * float(torch.maximum(high - middle, middle - low)))
            + airy / pixel_pitch
        )
        return Defocus((float(low), float(high)), spread, floor)

    def over_field(self, reach: float, vergences: Tensor, wavelengths: Tensor) -> ThinFieldPSFs:
        """PSFs of all places up to `reach` from the axis [m], for points at vergences (Z,) [1/m], wavelengths (L,) [m].

        Raises: ValueError for places more than `WIDEST` from the axis.
        """
        farthest = float(float64(self.sensor_distance).detach()) * math.tan(math.radians(WIDEST))
        if reach > farthest:
            raise ValueError(
                f"the sensor reaches {reach * 1e3:.3g} mm from the axis, and thin elements are known up to {WIDEST:g} "
                f"degrees, {farthest * 1e3:.3g} mm. Use a smaller picture, or field=False."
            )
        pixels = PixelGrid(1e-6, (1, 1), device=vergences.device)
        return ThinFieldPSFs(self.question(Points(vergences), wavelengths, pixels), reach)

    def _check_f_number(self) -> None:
        (fastest, slowest), width = TESTED_F_NUMBERS, 2 * float(self.aperture.semi_aperture().detach())
        if not fastest * (1 - 1e-6) <= self.f_number <= slowest * (1 + 1e-6):  # f/100 is within, for all rounding
            limits = (width * self.f_number / number * 1e3 for number in (slowest, fastest))
            warnings.warn(
                f"f/{self.f_number:.3g} is outside f/{fastest:g}..f/{slowest:g}, where PSFs were tested against "
                "Rayleigh-Sommerfeld: computed all the same, but with an unknown error. An aperture of "
                "{:.2g} to {:.2g} mm is within.".format(*limits),
                UserWarning,
                stacklevel=4,
            )
