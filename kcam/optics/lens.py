"""A lens: thin elements in one pupil plane, at a distance from the sensor."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from numbers import Integral

import torch
from torch import Tensor, nn

from kcam.optics.elements import DOE, Aperture, Element, PixelMap, PlanoConvexLens, Scalar, float64, set_scalar
from kcam.optics.explain import Explanation, explain
from kcam.optics.propagation import choose
from kcam.optics.psf import Query
from kcam.optics.pupil import disc_weights
from kcam.optics.quadrants import unfold
from kcam.optics.sampling import MAX_PUPIL_SAMPLES
from kcam.units import check_distances, check_pixel_pitch, check_positive, check_trained, wavelength_grid

TESTED_F_NUMBERS = (1.8, 100.0)
"""Within these the non-paraxial PSF is held to Rayleigh-Sommerfeld.

To 1e-2 at f/1.8 and f/100 for focal lengths of 4.3 mm, ideal or plano-convex, from 0.5 m to infinity (tests/stability);
to what `explain` states from 4 to 100 mm and f/1.8 to f/64 (tests/optics/test_model_error.py). Faster, aberrations send
light where the Debye map does not hold: 0.5 for a plano-convex lens at f/1.4. Slower, pinholes spread it to angles at
which obliquity counts: 0.07 at f/1000.
"""
_ORDERS_LEFT_OUT = 3e-4  # share of the light in the grating orders of a pixel map that a default window leaves out


class Lens(nn.Module):
    """Thin elements whose optical paths add in one pupil plane, in front of a sensor.

    Args:
        elements: the parts of the lens; exactly one is an aperture.
        focus_distance: sets the sensor where the lens focuses an object at this distance [m], inf allowed; paraxially,
            at
            `focus_wavelength`, once: training the elements later does not move the sensor.
        sensor_distance: pupil to sensor [m], instead; may be a Parameter.
        focus_wavelength: [m].
    Raises:
        ValueError for no or two apertures, both or neither distance, a focus inside the focal length, r >= R.
        TypeError for something that is no element.
    """

    elements: Sequence[Element]  # held by an nn.ModuleList
    sensor_distance: Scalar

    def __init__(
        self,
        *elements: Element,
        focus_distance: float | None = None,
        sensor_distance: Scalar | None = None,
        focus_wavelength: float = 550e-9,
    ) -> None:
        super().__init__()
        for element in elements:
            if not isinstance(element, Element):
                raise TypeError(f"a lens takes elements such as CircularAperture or DOE, got {type(element).__name__}.")
        apertures = [element for element in elements if isinstance(element, Aperture)]
        if len(apertures) != 1:
            raise ValueError(
                f"a lens has exactly one aperture, got {len(apertures)}; add CircularAperture(diameter=5 * mm) or "
                "remove all but one."
            )
        self.elements = nn.ModuleList(elements)  # type: ignore[assignment]
        self.focus_wavelength = float(wavelength_grid([focus_wavelength]))
        if focus_distance is not None and sensor_distance is None:
            sensor_distance = self._sensor_distance_for(float(check_distances(focus_distance, name="focus_distance")))
        elif focus_distance is not None or sensor_distance is None:
            raise ValueError("give either focus_distance= or sensor_distance= [m], not both and not neither.")
        check_positive(sensor_distance, name="sensor_distance")
        set_scalar(self, "sensor_distance", sensor_distance)
        self._check_curvature()

    def configuration(self) -> dict[str, object]:
        """Constructor arguments, for saving: the sensor's distance, which was set once, rather than the focus."""
        return {
            "elements": list(self.elements),
            "sensor_distance": self.sensor_distance,
            "focus_wavelength": self.focus_wavelength,
        }

    def extra_repr(self) -> str:
        """The sensor's place, for print()."""
        return f"sensor_distance={float(float64(self.sensor_distance).detach()):.6g}"

    @property
    def aperture(self) -> Aperture:
        """The element that bounds the pupil."""
        return next(element for element in self.elements if isinstance(element, Aperture))

    def aperture_alone(self, *, pixels: int | None = None) -> Lens:
        """The same pupil at the same distance from the sensor, with nothing in it, or with a flat DOE of n pixels."""
        flat = [] if pixels is None else [DOE(torch.zeros(pixels, pixels))]
        return Lens(self.aperture, *flat, sensor_distance=self.sensor_distance)

    @property
    def symmetric(self) -> bool:
        """Whether every element is rotationally symmetric by its type."""
        return all(element.symmetric for element in self.elements)

    @property
    def has_rings(self) -> bool:
        """Whether a rotationally symmetric path may have structure along the radius, by its type."""
        return any(e.symmetric and (e.knots is None or len(e.knots) > 0) for e in self.elements)

    @property
    def even(self) -> bool:
        """Whether no element's path tells x from -x and y from -y, by its type; maps of pixels may."""
        return all(e.symmetric or getattr(e.terms, "__func__", None) is Element.terms for e in self.elements)

    @property
    def round(self) -> bool:
        """Whether the rim of the aperture is a circle."""
        return bool(self.aperture.discs())

    @property
    def has_pixels(self) -> bool:
        """Whether an element is a map of flat pixels, a phase or a transmission."""
        grid = wavelength_grid([self.focus_wavelength])
        return any(element.pixel_map(grid) is not None for element in self.elements)

    @property
    def has_pixel_phase(self) -> bool:
        """Whether an element has its phase on flat pixels, which has no slope."""
        grid = wavelength_grid([self.focus_wavelength])
        return any(pixels.factors is not None for pixels in self.pixel_maps(grid))

    def pixel_maps(self, wavelengths: Tensor) -> list[PixelMap]:
        """The maps of flat pixels among the elements, for wavelengths (L,) [m], in the order of the light."""
        return [pixels for pixels in (e.pixel_map(wavelengths) for e in self.elements) if pixels is not None]

    def pixel_phase_displacement(self, query: Query) -> float:
        """How far flat pixels send all but a few 1e-4 of their light on the sensor [m].

        A step of delta radians between neighbours turns light by delta lambda d / 2 pi p, at most to the pixels'
        Nyquist angle; and flat pixels on a slope are a blazed grating, of whose light delta^2 / 2 pi^2 M lies beyond
        order M.
        """
        total = 0.0
        for pixels in self.pixel_maps(query.wavelengths):
            if pixels.factors is None or pixels.values.shape[-1] < 2:
                continue
            half_width = query.semi_aperture.detach() if pixels.half_width is None else pixels.half_width
            pitch = 2 * float(half_width) / pixels.values.shape[-1]
            steps = pixels.steps()
            sizes = torch.cat([step.abs().flatten() for step in steps])
            slope = float(sizes.kthvalue(math.ceil(0.999 * sizes.numel())).values) / (2 * torch.pi)
            lost = sum(float(step.square().mean()) for step in steps) / (2 * torch.pi**2)
            orders = math.ceil(lost / _ORDERS_LEFT_OUT) if lost > _ORDERS_LEFT_OUT else 0
            cycle = float(query.wavelengths.max()) * float(query.sensor_distance.detach()) / pitch
            total += (slope + orders) * cycle
        return total

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
        Returns:   (Z, L, H, W), >= 0 up to the sampling error; sums to the share of light in the window.
        Raises:    ValueError for lengths that are not in metres, distances <= 0, an unknown propagator or method, a
            shape
                   that is not two positive integers, a pupil too coarse for the window (with the sampling that
                   would do), or a lens whose parameters were trained or loaded into NaN.
        Warns:     UserWarning for an f-number outside `TESTED_F_NUMBERS`.
        Valid on the axis, for thin elements and scalar light; `explain` estimates the error.
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
        )
        return choose(query, propagator=propagator, method=method)(query)

    def explain(
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
    ) -> Explanation:
        """What `psf` will do with the same arguments: the row, its sampling, its error, and the energy in the window.

        Args: those of `psf`.
        Returns: a value to print; its fields are the numbers. Errors are estimated without computing the PSFs: never
            more than 3 times too small, down to 1e-6, over random cameras. The captured energy is computed.
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
        )
        return explain(query, propagator=propagator, method=method)

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
    ) -> Query:
        """The arguments of `psf`, checked, as one value."""
        if not isinstance(shape, Sequence) or len(shape) != 2 or not all(_is_count(n) for n in shape):
            fix = f" Use shape=({shape}, {shape})." if isinstance(shape, int) and shape >= 1 else ""
            raise ValueError(f"shape must be two positive integers (H, W) in pixels, got {shape!r}.{fix}")
        if not 0 < fill_factor <= 1:
            raise ValueError(f"fill_factor {fill_factor:g} must be in (0, 1]: the light-sensitive share of a pixel.")
        if samples is not None and (not isinstance(samples, Integral) or samples < 32):
            raise ValueError(f"samples must be an integer >= 32 across the pupil, or None, got {samples!r}.")
        if samples is not None and samples > MAX_PUPIL_SAMPLES:
            raise ValueError(
                f"samples {samples} across the pupil is above the limit of {MAX_PUPIL_SAMPLES}. Leave samples out for "
                "as many as this PSF needs, or use a smaller shape."
            )
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype}; cast the result instead.")
        if device is None:
            device = next((t.device for t in (*self.parameters(), *self.buffers())), torch.device("cpu"))
        grid = check_distances(distances).to(device)
        if grid.ndim > 1 or grid.numel() == 0:
            raise ValueError(
                f"distances must be a number or a vector (Z,) with Z >= 1, got shape {tuple(grid.shape)}. Use [2.0]."
            )
        self._check_trained()
        self._check_curvature()
        self._check_f_number()
        return Query(
            lens=self,
            wavelengths=wavelength_grid(wavelengths),
            vergences=1 / grid.reshape(-1),
            pixel_pitch=check_pixel_pitch(pixel_pitch),
            shape=(int(shape[0]), int(shape[1])),
            dtype=dtype,
            device=device,
            integrate=integrate,
            active=math.sqrt(fill_factor),
            samples=None if samples is None else int(samples),
        )

    def mtf(
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
    ) -> Tensor:
        """Modulation transfer function, |OTF| / OTF(0) of the light in the window, times the pixel's own sinc.

        Args: those of `psf`; integrate=False leaves out the pixel's sinc: the optics alone.
        Returns: (Z, L, H, W) in [0, 1]; index n // 2 is frequency 0, the step is 1 / (n * pixel_pitch) cycles per
            metre.
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
        )
        height, width = query.shape
        curves = []
        for wavelength in query.wavelengths:
            # sampled finer than the pixels, and times the pixel's sinc: the pixels' own samples would alias
            fine = 2 * _points_per_pixel(query, wavelength) + 1
            points = _between_pixels(query, wavelength, fine=fine, shape=(height * fine, width * fine))
            image = choose(points, propagator=propagator, method=method)(points)[:, 0]
            otf = torch.fft.fftshift(torch.fft.fft2(image), dim=(-2, -1))
            magnitude2 = otf.real.square() + otf.imag.square()
            # a floor far below the transform's own rounding: no NaN gradient at the zeros of an MTF
            modulation = torch.sqrt(magnitude2 + torch.finfo(dtype).tiny)
            total = modulation[..., height * fine // 2, width * fine // 2][..., None, None]
            for dim, n in zip((-2, -1), query.shape, strict=True):
                modulation = modulation.narrow(dim, n * fine // 2 - n // 2, n)
                frequency = (torch.arange(n, device=modulation.device) - n // 2) / n  # cycles per pixel
                if integrate:
                    sinc = torch.sinc(frequency * query.active).abs().to(modulation)
                    modulation = modulation * (sinc[:, None] if dim == -2 else sinc)
            curves.append(modulation / total)
        return torch.stack(curves, dim=1)

    def encircled_energy(
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
    ) -> Tensor:
        """Share of the light through the aperture that falls within a circle around the origin.

        The irradiance is evaluated between the pixels, at a quarter of its Nyquist pitch, and summed with the edge
        weights of a disc: no pixel counts as a whole.

        Args: those of `psf`; fill_factor and integrate change nothing, for the irradiance is what counts here.
        Returns: (Z, L, K + 1) for radii k * pixel_pitch, k = 0..K = min(H, W) // 2, rising from 0.
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
        )
        largest = min(query.shape) // 2
        curves = []
        for wavelength in query.wavelengths:
            fine = 3 * _points_per_pixel(query, wavelength)
            side = 2 * (largest * fine + 8) + 3
            points = _between_pixels(query, wavelength, fine=fine, shape=(side, side))
            image = choose(points, propagator=propagator, method=method)(points)[:, 0]
            curves.append(torch.stack([_disc_sum(image, k * fine) for k in range(largest + 1)], dim=-1))
        return torch.stack(curves, dim=1)

    def power(self, wavelengths: Tensor) -> Tensor:
        """Paraxial power at each wavelength, (L,) float64 [1/m], without any `Defocus`."""
        vergences = (element.vergence(wavelengths) for element in self.elements if element.focuses)
        return -sum(vergences, torch.zeros_like(wavelengths))

    def focal_length(self, wavelength: float | Tensor = 550e-9) -> float | Tensor:
        """Paraxial focal length [m]: a float for a float, (L,) float64 for wavelengths (L,); inf without power."""
        grid = wavelength_grid(wavelength if isinstance(wavelength, Tensor) else [wavelength])
        focal = 1 / self.power(grid).detach()
        return focal if isinstance(wavelength, Tensor) and wavelength.ndim else float(focal[0])

    @property
    def focus_distance(self) -> float:
        """Object distance that is imaged onto the sensor paraxially at `focus_wavelength` [m]; inf, or < 0 if
        virtual.
        """
        vergence = float(self.power(wavelength_grid([self.focus_wavelength])).detach()[0]) - 1 / float(
            float64(self.sensor_distance).detach()
        )
        # below 1e-9 1/m nothing tells the distance from infinity: 1e-14 waves in a 5 mm aperture
        return math.inf if abs(vergence) < 1e-9 else 1 / vergence

    @property
    def f_number(self) -> float:
        """Working f-number: sensor distance over the width of the aperture."""
        return float(float64(self.sensor_distance).detach() / (2 * self.aperture.semi_aperture().detach()))

    def aperture_area(self) -> float:
        """Open area of the aperture [m^2]."""
        side = 2 * float(self.aperture.semi_aperture().detach())
        return side**2 * float(torch.as_tensor(self.aperture.open_share()).detach())

    def _sensor_distance_for(self, focus_distance: float) -> float:
        power = float(self.power(wavelength_grid([self.focus_wavelength])).detach()[0])
        if power <= 0:
            raise ValueError(
                f"this lens has a power of {power:g} 1/m at {self.focus_wavelength * 1e9:.4g} nm and cannot focus: add "
                "a ThinLens or a PlanoConvexLens, or give sensor_distance=."
            )
        image_vergence = power - 1 / focus_distance
        if image_vergence <= 0:
            raise ValueError(
                f"focus_distance {focus_distance:g} m is inside the focal length {1 / power:g} m: no real image. "
                f"Focus beyond {1 / power:g} m."
            )
        return 1 / image_vergence

    def _check_trained(self) -> None:
        """What the constructors refuse must not come in by an optimiser's step or a loaded file either."""
        for name, value in (*self.named_parameters(), *self.named_buffers()):
            check_trained(value, name=f"{name} of the lens")
        for element in self.elements:
            element.check()
        check_positive(self.sensor_distance, name="sensor_distance")
        check_positive(self.aperture.semi_aperture(), name="semi-aperture")

    def _check_f_number(self) -> None:
        (fastest, slowest), width = TESTED_F_NUMBERS, 2 * float(self.aperture.semi_aperture().detach())
        if not fastest <= self.f_number <= slowest:
            limits = (width * self.f_number / number * 1e3 for number in (slowest, fastest))
            warnings.warn(
                f"f/{self.f_number:.3g} is outside f/{fastest:g}..f/{slowest:g}, where PSFs were tested against "
                "Rayleigh-Sommerfeld: computed all the same, but with an unknown error. An aperture of "
                "{:.2g} to {:.2g} mm is within.".format(*limits),
                UserWarning,
                stacklevel=3,
            )

    def _check_curvature(self) -> None:
        reach = float(self.aperture.semi_aperture().detach()) * (1 if self.round else math.sqrt(2))
        for element in self.elements:
            if not isinstance(element, PlanoConvexLens):
                continue
            radius = float(float64(element.radius_of_curvature).detach())
            if reach >= radius:
                raise ValueError(
                    f"the aperture reaches r = {reach:g} m, but the surface ends at its radius of curvature "
                    f"R = {radius:g} m (r >= R). Use an aperture below {2 * radius:g} m across or a larger R."
                )


def _is_count(value: object) -> bool:
    return isinstance(value, Integral) and int(value) >= 1


def _points_per_pixel(query: Query, wavelength: Tensor) -> int:
    """Whole points per pixel that sample the irradiance, whether or not the query integrates over its pixels."""
    return math.ceil(replace(query, integrate=True).evaluation_grid(float(wavelength))[0])


def _between_pixels(query: Query, wavelength: Tensor, *, fine: int, shape: tuple[int, int]) -> Query:
    """The same question of one wavelength at points `fine` times as close, not integrated."""
    pitch = query.pixel_pitch / fine
    return replace(query, wavelengths=wavelength[None], pixel_pitch=pitch, shape=shape, integrate=False)


def _disc_sum(image: Tensor, radius: int) -> Tensor:
    """Integral over a disc around the centre of an odd image (..., 2K+1, 2K+1), radius in samples; (...)."""
    if radius == 0:
        return image.sum((-2, -1)) * 0
    half = radius + 8
    centre = image.shape[-1] // 2
    weights = unfold(disc_weights(2 * half, spacing=1.0, radius=float(radius))).to(image)
    # the weights' nodes lie half-way between the image's points: shift by half a sample in the frequency domain
    window = image[..., centre - half : centre + half, centre - half : centre + half]
    return (window * _half_shifted(weights)).sum((-2, -1))


def _half_shifted(weights: Tensor) -> Tensor:
    """The weights at integer positions instead of half-integer ones, by their band-limited interpolation."""
    n = weights.shape[-1]
    frequency = torch.fft.fftfreq(n, device=weights.device, dtype=torch.float64)
    turn = torch.complex((torch.pi * frequency).cos(), -(torch.pi * frequency).sin())
    spectrum = torch.fft.fft2(weights.to(torch.float64)) * turn[:, None] * turn
    return torch.fft.ifft2(spectrum).real.to(weights)
