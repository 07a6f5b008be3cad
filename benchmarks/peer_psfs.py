"""One PSF by kcam, the textbook, hcipy, prysm and TorchOptics, and its truth by quadrature: all from one `Case`.

Each library computes as its own documentation does for a given pixel grid, point-sampled. Each function returns
(what is timed, the share of the light that one unit of its picture stands for); all before its `return` is setup.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import oracles
import torch
from scipy.fft import next_fast_len
from torch import Tensor

from benchmarks.baselines import angular_spectrum_psf, textbook_psf_bank
from kcam import optics
from kcam.units import mm, nm, um

WAVELENGTH = 550 * nm
SINGLE, DOUBLE = torch.float32, torch.float64
EXACT = "Rayleigh-Sommerfeld"
Ready = tuple[Callable[[], Tensor], float]


@dataclass(frozen=True)
class Case:
    """A PSF: an ideal lens of f = `distance`, whose vergence (1 / object distance) and aberrations are given.

    defocus: path at the rim, spherical: RMS of Noll's Z11, both in waves and for the radius of 2.5 mm.
    """

    diameter: float = 5 * mm
    distance: float = 50 * mm
    pitch: float = 1 * um
    window: int = 297
    vergence: float = 0.0
    defocus: float = 0.0
    spherical: float = 0.0

    radius = 2.5 * mm

    @property
    def width(self) -> float:
        """Of the pupil's grid, which stays when the aperture is shut [m]."""
        return self.diameter or 2 * self.radius

    @property
    def shape(self) -> tuple[int, int]:
        return self.window, self.window

    def aberration(self, r2: Any) -> Any:
        """OPD [m] at squared radii; arrays or tensors."""
        rho2 = r2 / self.radius**2
        return WAVELENGTH * (self.defocus * rho2 + self.spherical * math.sqrt(5) * (6 * rho2 * (rho2 - 1) + 1))

    def residual(self, r2: Any) -> Any:
        """OPD beyond the sphere that focuses on the sensor, paraxially [m]."""
        return self.aberration(r2) + self.vergence / 2 * r2

    def path(self, r2: Any, *, lens: bool) -> Any:
        """The residual, with or without the lens itself."""
        return self.residual(r2) - (r2 / (2 * self.distance) if lens else 0)


@functools.cache
def truth(case: Case, *, physics: str = "Fresnel") -> Tensor:
    """Share of the light per pixel by float64 quadrature: point-sampled, or in focus integrated over the pixels.

    Args:   physics: "Fresnel", "Rayleigh-Sommerfeld" (kcam's ThinLens, perfect for infinity) or "pixels".
    Raises: RuntimeError where twice the nodes give another picture: then it is no truth.
    """
    squared = np.add.outer(*[(np.arange(case.window) - case.window // 2) ** 2] * 2)
    distinct, where = np.unique(squared, return_inverse=True)
    r = np.sqrt(distinct) * case.pitch
    optic = {"aperture_radius": case.diameter / 2, "sensor_distance": case.distance, "wavelength": WAVELENGTH}

    def exact(u: Any, v: Any) -> Any:
        r2 = u**2 + v**2
        return case.aberration(r2) - r2 / (case.distance + np.sqrt(case.distance**2 + r2))

    def picture(more: int) -> Tensor:
        if physics == "pixels":
            x, y = np.meshgrid(*[oracles.pixel_centres(case.window, case.pitch)] * 2)
            centres = np.stack([x.ravel(), y.ravel()], axis=1)
            values = oracles.pixel_integrate(
                lambda points: oracles.airy(*points.T, **optic), centres, pitch=case.pitch, order=40 * more
            )
            return torch.from_numpy(values.reshape(case.shape))
        if physics == "Fresnel":
            opd = lambda u, v: case.residual(u**2 + v**2)  # noqa: E731
            values = oracles.fresnel_radial(r, opd=opd, radial_nodes=800 * more, **optic)
        else:
            points, nodes = np.stack([r, 0 * r], axis=1), {"radial_nodes": 56 * more, "angular_nodes": 160 * more}
            values = oracles.rayleigh_sommerfeld(points, element_opd=exact, symmetric=True, **nodes, **optic)
        return torch.from_numpy(values[where.reshape(squared.shape)] * case.pitch**2)

    coarse, fine = picture(1), picture(2)
    if (difference := l1(coarse, fine)) > 1e-8:
        raise RuntimeError(f"the quadrature has not converged: twice the nodes change it by {difference:.1e}.")
    return fine


def l1(picture: Tensor, reference: Tensor) -> float:
    """L1 between two pictures after scaling both to unit sum."""
    picture = picture.to(DOUBLE)
    return float((picture / picture.sum() - reference / reference.sum()).abs().sum())


# ---- the same PSF by each library ----------------------------------------------------------------------------------


class Spherical(optics.Element):
    """Noll's Z11 as an element of its own, which by its type is symmetric: what `radial` asks for."""

    symmetric = True

    def __init__(self, case: Case) -> None:
        super().__init__()
        self.case = case

    def terms(self, pupil: Any, wavelengths: Tensor) -> list[tuple[Tensor, Tensor]]:
        rho2 = pupil.rho2
        return [(torch.ones_like(wavelengths), self.case.spherical * WAVELENGTH * 5**0.5 * (6 * rho2 * (rho2 - 1) + 1))]


def kcam_psf(case: Case, *, dtype: torch.dtype = SINGLE, integrate: bool = False, **options: Any) -> Ready:
    """Options as `Lens.psf` has them. The call starts from coefficients, not from a pupil at hand."""
    elements: list[optics.Element] = [optics.CircularAperture(case.diameter), optics.ThinLens(case.distance)]
    if case.defocus:
        elements.append(optics.Defocus(2 * case.defocus * WAVELENGTH / case.radius**2))
    if case.spherical and options.get("method") == "radial":
        elements.append(Spherical(case))
    elif case.spherical:
        elements.append(optics.ZernikeAberration(case.spherical * WAVELENGTH * torch.eye(11, dtype=DOUBLE)[10]))
    lens = optics.Lens(*elements, sensor_distance=case.distance)
    where = {"distances": 1 / case.vergence if case.vergence else math.inf, "pixel_pitch": case.pitch}
    where |= {"shape": case.shape, "integrate": integrate, "dtype": dtype}
    return lambda: lens.psf([WAVELENGTH], **where, **options)[0, 0].detach(), 1.0


def textbook_psf(case: Case, *, samples: int) -> Ready:
    """A plano-convex lens of the same power; the map holds the aberration and what the sphere has beyond it."""
    radius, index = case.distance / 2, 1.5
    axis = (torch.arange(samples, dtype=DOUBLE) - (samples - 1) / 2) * (case.diameter / samples)
    r2 = axis[:, None] ** 2 + axis**2
    sphere = (index - 1) * r2**2 / (2 * radius * (radius + torch.sqrt(radius**2 - r2)) ** 2)
    optic = {"aperture_diameter": case.diameter, "radius_of_curvature": radius, "sensor_distance": case.distance}
    light = {"wavelengths": WAVELENGTH, "lens_index": index, "distances": math.inf}
    optic |= {name: torch.tensor([value], dtype=DOUBLE) for name, value in light.items()}
    optic |= {"pixel_pitch": case.pitch, "shape": case.shape}
    phase = 2 * math.pi / WAVELENGTH * (case.aberration(r2) + sphere)
    return lambda: textbook_psf_bank(phase, **optic)[0, 0], 1.0


def textbook_spectrum(case: Case, *, margin: float) -> Ready:
    """The angular spectrum on a grid of the pixels' pitch, `margin` times as wide as aperture and window together."""
    samples = 2 * math.ceil(margin * (case.diameter + case.window * case.pitch) / (2 * case.pitch))
    axis = (torch.arange(samples, dtype=DOUBLE) - samples // 2) * case.pitch
    r2 = axis[:, None] ** 2 + axis**2
    opd = case.aberration(r2) - r2 / (case.distance + torch.sqrt(case.distance**2 + r2))
    optic = {"aperture_diameter": case.diameter, "sensor_distance": case.distance, "grid_pitch": case.pitch}
    return lambda: angular_spectrum_psf(opd, wavelength=WAVELENGTH, shape=case.shape, **optic), 1.0


def hcipy_psf(case: Case, *, samples: int, dtype: torch.dtype = DOUBLE, spectrum: bool = False) -> Ready:
    """FraunhoferPropagator onto a uniform grid, which is a matrix Fourier transform; the aperture's edge supersampled.

    spectrum: a lens and AngularSpectrumPropagator instead, on a grid of the pixels' pitch.
    """
    import hcipy

    pixels = hcipy.make_uniform_grid(case.shape, case.window * case.pitch, has_center=True)
    grid = hcipy.make_uniform_grid([samples] * 2, samples * case.pitch, has_center=True)
    propagator = hcipy.AngularSpectrumPropagator(grid, case.distance)
    if not spectrum:
        grid = hcipy.make_pupil_grid(samples, case.width)
        propagator = hcipy.FraunhoferPropagator(grid, pixels, focal_length=case.distance)
    aperture = hcipy.evaluate_supersampled(hcipy.make_circular_aperture(case.diameter), grid, 1 if spectrum else 8)
    values = aperture * np.exp(2j * np.pi / WAVELENGTH * case.path(grid.x**2 + grid.y**2, lens=spectrum))
    wavefront = hcipy.Wavefront(hcipy.Field(values.astype(_complex(dtype)), grid), WAVELENGTH)
    wavefront.total_power = 1
    return lambda: _centre(propagator(wavefront).power.shaped, case), 1.0


def prysm_psf(
    case: Case, *, samples: int, dtype: torch.dtype = DOUBLE, method: str = "mdft", spectrum: bool = False
) -> Ready:
    """focus_fixed_sampling: a matrix DFT (mdft) or a chirp z-transform (czt); mm, um and nm as prysm has them.

    spectrum: a lens and free_space instead, on a grid of the pixels' pitch. Odd samples: with even ones prysm's grid is
    not symmetric, its error twice as large, and czt onto an odd window is off by a pixel.
    """
    from prysm import conf, coordinates, fttools, geometry, propagation

    bits, engine = (32 if dtype == SINGLE else 64), fttools.MatrixDFTExecutor()
    conf.config.precision = bits
    step = (case.pitch if spectrum else case.width / samples) / mm
    r, _ = coordinates.cart_to_polar(*coordinates.make_xy_grid(samples, dx=step))
    mask = geometry.circle(case.diameter / 2 / mm, r)
    path = case.path((r.astype(float) * mm) ** 2, lens=spectrum) / nm
    wavefront = propagation.Wavefront.from_amp_and_phase(mask, path, WAVELENGTH / um, step)
    wavefront.data = wavefront.data.astype(_complex(dtype))

    def psf() -> Tensor:
        # both are global, and prysm's own engine keeps its matrices whatever the precision is now
        conf.config.precision, propagation.mdft = bits, engine
        if spectrum:
            out = wavefront.free_space(case.distance / mm, Q=1)
        else:
            out = wavefront.focus_fixed_sampling(case.distance / mm, case.pitch / um, case.window, method=method)
        return _centre(out.intensity.data, case)

    return psf, 1 / float(mask.sum())


def torchoptics_psf(
    case: Case, *, spacing: float, dtype: torch.dtype = DOUBLE, spherical_source: float | None = None, **options: Any
) -> Ready:
    """Field.propagate from the lens onto the pixels; options are its own. `spherical_source`: where its wave starts."""
    import torchoptics
    from torchoptics import profiles

    torchoptics.set_default_dtype(dtype)
    # odd, so that points meet pixels; and of a length that suits the FFT, which 5000 + 297, a prime, does not
    other = 2 * options["asm_pad"] if "asm_pad" in options else math.ceil((case.window - 1) * case.pitch / spacing) + 1
    least = round(case.width / spacing) | 1
    samples = next(n for n in itertools.count(least, 2) if next_fast_len(n + other) == n + other)
    grid = {"shape": (samples, samples), "spacing": spacing}
    x, y = torchoptics.PlanarGrid(**grid).meshgrid()
    phase = profiles.lens_phase(focal_length=case.distance, wavelength=WAVELENGTH, **grid)
    phase = phase + 2 * math.pi / WAVELENGTH * case.residual(x**2 + y**2)
    if spherical_source is not None:
        phase = phase + profiles.spherical_wave_phase(z=spherical_source, wavelength=WAVELENGTH, **grid)
    light = torch.polar(profiles.circle(radius=case.diameter / 2, **grid), phase)
    pupil = torchoptics.Field(light, WAVELENGTH, z=0, spacing=spacing)
    interpolation = "nearest" if spacing == case.pitch else "bicubic"

    def psf() -> Tensor:
        torchoptics.set_default_dtype(dtype)
        plane = {"z": case.distance, "spacing": case.pitch, "interpolation_mode": interpolation}
        return pupil.propagate(case.shape, **plane, **options).intensity()

    return psf, case.pitch**2 / float(pupil.power())


def _complex(dtype: torch.dtype) -> str:
    return "complex64" if dtype == SINGLE else "complex128"


def _centre(picture: Any, case: Case) -> Tensor:
    first = picture.shape[-1] // 2 - case.window // 2
    return torch.from_numpy(np.asarray(picture))[first : first + case.window, first : first + case.window]
