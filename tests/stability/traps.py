"""Traps of float32 and autograd: each as it is usually written, and through kcam, against an independent truth.

`rows()` computes the table. The usual form is the textbook's formula in float32. So that nothing but the trap separates
it from the truth, everything around it is exact: phases are summed over the quadrature nodes of `oracles.py` in
float64. kcam is called by its public names, in float32.
"""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import oracles
import torch
from torch import Tensor, nn

from kcam import optics
from kcam.sensor.noise import poisson
from kcam.units import mm, nm, um

WAVELENGTH = 550 * nm
WAVENUMBER = 2 * math.pi / WAVELENGTH
INDEX, RADIUS, SEMI = 1.5, 25 * mm, 2.5 * mm  # an f/10 singlet of 50 mm
FOCUS = 2.0
DISTANCE = 1 / ((INDEX - 1) / RADIUS - 1 / FOCUS)  # of the sensor
PITCH, SIZE = 3 * um, 49
FAR = (1e3, 1e4, 1e6, 1e8, 1e12)
Phase = Callable[[Tensor], Tensor]  # of r^2 [m^2]
Outcome = float | str  # an error, or the words of a refusal


@dataclass(frozen=True)
class Row:
    """A trap: how it is usually written, what the two numbers mean, and both of them."""

    case: str
    usual: str
    measure: str
    naive: float
    kcam: Outcome


# ---- what is exact around the traps ----------------------------------------------------------------------------------


@functools.cache
def _nodes(semi: float = SEMI, radial: int = 96, angular: int = 192) -> tuple[Tensor, Tensor, Tensor]:
    return tuple(
        torch.from_numpy(part) for part in oracles.polar_nodes(aperture_radius=semi, radial=radial, angular=angular)
    )


def _image(phase: Tensor, *, size: int = SIZE, tilt: Tensor | float = 0.0) -> Tensor:
    """Fresnel intensity per pixel of a phase at the nodes, summed in float64; the gradient goes through."""
    u, v, weight = _nodes()
    phase = phase.double() + tilt
    along = torch.from_numpy(oracles.pixel_centres(size, PITCH)) * (WAVENUMBER / DISTANCE)
    field = torch.complex(phase.cos() * weight, phase.sin() * weight)
    across, down = along[:, None] * u, along[:, None] * v
    total = (torch.complex(down.cos(), -down.sin()) * field) @ torch.complex(across.cos(), -across.sin()).T
    scale = PITCH**2 / ((WAVELENGTH * DISTANCE) ** 2 * float(weight.sum()))
    return (total.real.square() + total.imag.square()) * scale


def _residual(r2: Tensor, *, vergence: Tensor | float = 1 / FOCUS, radius: Tensor | float = RADIUS) -> Tensor:
    """Phase of source, lens and propagation without what cancels: `oracles.fresnel_opd`, differentiable."""
    total = vergence + 1 / DISTANCE - (INDEX - 1) / radius
    sphere = (INDEX - 1) * r2**2 / (2 * radius * (radius + (radius**2 - r2).sqrt()) ** 2)
    return WAVENUMBER * (total * r2 / 2 - sphere)


def _truth(distance: float = FOCUS, *, size: int = SIZE) -> Tensor:
    """The same image from `oracles.fresnel_image`, which shares no code with this module or kcam."""
    centres = oracles.pixel_centres(size, PITCH)
    opd = oracles.fresnel_opd(index=INDEX, radius_of_curvature=RADIUS, distance=distance, sensor_distance=DISTANCE)
    image = oracles.fresnel_image(
        centres, centres, aperture_radius=SEMI, sensor_distance=DISTANCE, wavelength=WAVELENGTH, opd=opd
    )
    return torch.from_numpy(image) * PITCH**2


def _singlet(radius: nn.Parameter | float = RADIUS, *others: optics.Element) -> optics.Lens:
    lens = optics.PlanoConvexLens(radius, glass=INDEX)
    return optics.Lens(optics.CircularAperture(2 * SEMI), lens, *others, sensor_distance=DISTANCE)


def _psf(lens: optics.Lens, *, distances: Tensor | float = FOCUS, size: int = SIZE, **arguments) -> Tensor:
    # 512 samples: the sampling error falls below float32's own, which is what the traps are about
    settings = {"propagator": "fresnel", "method": "matrix", "samples": 512, "integrate": False, "pixel_pitch": PITCH}
    settings |= arguments
    return lens.psf([WAVELENGTH], distances=distances, shape=(size, size), **settings)[0, 0]


def _l1(image: Tensor, truth: Tensor) -> float:
    return float((image.double() - truth).abs().sum() / truth.abs().sum())


def _derivative(function: Callable[[float], Tensor], at: float, step: float) -> Tensor:
    """By the five-point formula."""
    near = function(at + step) - function(at - step)
    return (8 * near - (function(at + 2 * step) - function(at - 2 * step))) / (12 * step)


def _refusal(call: Callable[[], object]) -> str:
    try:
        call()
    except ValueError as error:
        return f"ValueError: {error}"
    return "nothing"


def _largest(*errors: list[float]) -> tuple[float, ...]:
    return tuple(float(np.max(values)) for values in errors)  # NaN if any is


def _weights(size: int = SIZE) -> Tensor:
    return torch.rand(size, size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def _r2_in_float32(semi: float = SEMI) -> Tensor:
    u, v, _ = _nodes(semi)
    return u.float() ** 2 + v.float() ** 2


# ---- phases ----------------------------------------------------------------------------------------------------------


def _whole_paths(r2: Tensor) -> Tensor:
    """ulp(k z) at 2 m is 2 radians."""
    source = WAVENUMBER * (FOCUS**2 + r2).sqrt()
    lens = WAVENUMBER * (INDEX - 1) * (RADIUS**2 - r2).sqrt()
    return source + lens + WAVENUMBER * r2 / (2 * DISTANCE)


def _chirps(r2: Tensor) -> Tensor:
    """The mildest trap: hundreds of radians of opposite sign, each right to its ulp of 6e-5, their sum to no better."""
    lens = -WAVENUMBER * (INDEX - 1) * r2 / (RADIUS + (RADIUS**2 - r2).sqrt())
    return WAVENUMBER * r2 / (2 * FOCUS) + lens + WAVENUMBER * r2 / (2 * DISTANCE)


def _with_piston(r2: Tensor) -> Tensor:
    """A constant changes no intensity, but it takes the digits of what is added to it."""
    return torch.tensor(WAVENUMBER * FOCUS, dtype=r2.dtype) + _chirps(r2)


def _piston_taken_off(r2: Tensor) -> Tensor:
    """What the root has rounded away does not come back."""
    source = WAVENUMBER * ((FOCUS**2 + r2).sqrt() - FOCUS)
    lens = WAVENUMBER * (INDEX - 1) * ((RADIUS**2 - r2).sqrt() - RADIUS)
    return source + lens + WAVENUMBER * r2 / (2 * DISTANCE)


PHASES: dict[str, tuple[str, Phase]] = {
    "path from the source": ("k sqrt(z^2 + r^2)", _whole_paths),
    "a piston": ("k z + k r^2 / 2z + ...", _with_piston),
    "a piston taken off after the root": ("k (sqrt(z^2 + r^2) - z)", _piston_taken_off),
    "large opposite chirps": ("k r^2 / 2z - k r^2 / 2f + k r^2 / 2d", _chirps),
}


def phase_error(phase: Phase, dtype: torch.dtype) -> float:
    """L1 error of the PSF of a phase that is computed in this precision."""
    u, v, _ = _nodes()
    return _l1(_image(phase(u.to(dtype) ** 2 + v.to(dtype) ** 2)), _truth())


def _phase_row(case: str) -> Row:
    usual, phase = PHASES[case]
    return Row(case, usual, "L1 of the PSF", phase_error(phase, torch.float32), _l1(_psf(_singlet()), _truth()))


def transfer_function() -> Row:
    """Over half a metre ulp(k z) is half a radian; at 1024 samples of 16 um the wave itself is well sampled."""
    semi, distance, count, pitch, size = 2.5 * mm, 0.5, 1024, 16 * um, 33
    centres = (torch.arange(count, dtype=torch.float64) - count // 2) * pitch
    r2 = centres[:, None] ** 2 + centres**2
    opd = oracles.thin_lens_opd(focal_length=distance)
    path = torch.from_numpy(opd(centres[None].numpy(), centres[:, None].numpy()))
    mask = ((semi - r2.sqrt()) / pitch + 0.5).clamp(0, 1)  # the rim's samples by their share
    field = torch.polar(mask, WAVENUMBER * path).to(torch.complex64)
    frequency = torch.fft.fftfreq(count, pitch)
    phase = WAVENUMBER * distance * (1 - WAVELENGTH**2 * (frequency[:, None] ** 2 + frequency**2)).sqrt()
    sensor = torch.fft.ifft2(torch.fft.fft2(field) * torch.polar(torch.ones_like(phase), phase))
    half = slice(count // 2 - size // 2, count // 2 + size // 2 + 1)
    naive = sensor.abs()[half, half].double() ** 2 * pitch**2 / (math.pi * semi**2)

    grid = torch.from_numpy(oracles.pixel_centres(size, pitch))
    points = torch.stack(torch.meshgrid(grid, grid, indexing="xy"), dim=-1).reshape(-1, 2).numpy()
    along = oracles.radial_function(
        lambda r: oracles.rayleigh_sommerfeld(
            np.stack([r, 0 * r], axis=1), aperture_radius=semi, sensor_distance=distance, wavelength=WAVELENGTH,
            element_opd=opd, symmetric=True,
        ),
        largest=1.5 * size / 2 * pitch, spacing=WAVELENGTH * distance / (16 * semi),
    )  # fmt: skip
    truth = torch.from_numpy(along(points)).reshape(size, size) * pitch**2
    # an element without kcam's own correction for the spheres: the plain parabola, as above
    lens = optics.Lens(optics.CircularAperture(2 * semi), optics.Defocus(-1 / distance), sensor_distance=distance)
    ours = _psf(lens, distances=math.inf, size=size, pixel_pitch=pitch, propagator="angular_spectrum", method="fft")
    return Row(  # in float64 the usual form is off by 8e-5
        "angular spectrum", "exp(i k z sqrt(1 - (lambda f)^2))", "L1 of the PSF", _l1(naive, truth), _l1(ours, truth)
    )


# ---- distances and radii ---------------------------------------------------------------------------------------------


def _subtracted(distance: Tensor, r2: Tensor, *, radius: Tensor | float = RADIUS) -> Tensor:
    """The source's path as it is written first, in float32; the rest of the path exact."""
    return WAVENUMBER * ((distance**2 + r2).sqrt() - distance) + _residual(_r2(), vergence=0.0, radius=radius)


def _r2() -> Tensor:
    u, v, _ = _nodes()
    return u**2 + v**2


def at_infinity() -> Row:
    naive = _l1(_image(_subtracted(torch.tensor(math.inf), _r2_in_float32())), _truth(math.inf))
    ours = _l1(_psf(_singlet(), distances=math.inf), _truth(math.inf))
    return Row("object at infinity", "k (sqrt(z^2 + r^2) - z)", "L1 of the PSF", naive, ours)


def towards_infinity() -> Row:
    """From 1e3 m on float32 sees no difference between z and sqrt(z^2 + r^2): the worst over `FAR`."""
    naive, ours = [], []
    for distance in FAR:
        truth = _truth(distance)
        naive.append(_l1(_image(_subtracted(torch.tensor(distance), _r2_in_float32())), truth))
        ours.append(_l1(_psf(_singlet(), distances=distance), truth))
    return Row("objects at 1e3 .. 1e12 m", "k (sqrt(z^2 + r^2) - z)", "largest L1", *_largest(naive, ours))


def gradient_towards_infinity() -> Row:
    """d / dz of a weighted sum of the PSF; the truth by differences in the vergence, dV / dz = -1 / z^2."""
    weights = _weights()

    def loss(vergence: float) -> Tensor:
        return (_image(_residual(_r2(), vergence=vergence)) * weights).sum()

    naive, ours = [], []
    for distance in FAR[::2]:
        truth = -float(_derivative(loss, 1 / distance, 1e-3)) / distance**2
        for errors, image in (
            (naive, lambda z: _image(_subtracted(z.float(), _r2_in_float32()))),
            (ours, lambda z: _psf(_singlet(), distances=z)),
        ):
            z = torch.tensor(distance, dtype=torch.float64, requires_grad=True)
            (gradient,) = torch.autograd.grad((image(z) * weights).sum(), z)
            errors.append(abs(float(gradient) / truth - 1))
    return Row(
        "gradient to z at 1e3 .. 1e12 m", "k (sqrt(z^2 + r^2) - z)", "largest relative error", *_largest(naive, ours)
    )


def gradient_at_infinity() -> Row:
    """Where dV / dz = 0 nothing moves with z."""
    results = []
    for image in (
        lambda z: _image(_subtracted(z, _r2_in_float32())),
        lambda z: _psf(_singlet(), distances=z),
    ):
        z = torch.tensor(math.inf, requires_grad=True)
        (gradient,) = torch.autograd.grad((image(z) * _weights()).sum(), z)
        results.append(abs(float(gradient)))
    return Row("gradient to z at infinity", "k (sqrt(z^2 + r^2) - z)", "the gradient, which is 0", *results)


def lens_before_infinity() -> Row:
    """Gradient to R of a weighted sum of the PSF."""
    truth = float(
        _derivative(lambda r: (_image(_residual(_r2(), vergence=0.0, radius=r)) * _weights()).sum(), RADIUS, 1e-3 * mm)
    )
    results = []
    for image in (
        lambda radius: _image(_subtracted(torch.tensor(math.inf), _r2_in_float32(), radius=radius)),
        lambda radius: _psf(_singlet(radius), distances=math.inf),
    ):
        radius = nn.Parameter(torch.tensor(RADIUS))
        (gradient,) = torch.autograd.grad((image(radius) * _weights()).sum(), radius)
        results.append(abs(float(gradient) / truth - 1))
    return Row(
        "gradient to a lens, object at infinity", "k (sqrt(z^2 + r^2) - z)", "gradient to R, relative error", *results
    )


def beyond_the_sphere() -> Row:
    """A 60 mm aperture on a sphere of R = 25 mm."""
    semi = 30 * mm
    u = torch.linspace(-semi, semi, 101)
    naive = (WAVENUMBER * (INDEX - 1) * (RADIUS**2 - u[:, None] ** 2 - u**2).sqrt()).sum()

    def build() -> optics.Lens:
        return optics.Lens(
            optics.CircularAperture(2 * semi), optics.PlanoConvexLens(RADIUS, glass=INDEX), sensor_distance=DISTANCE
        )

    return Row("aperture beyond the sphere, r >= R", "sqrt(R^2 - r^2)", "the path", float(naive), _refusal(build))


def close_to_the_sphere() -> Row:
    """A microlens open to 0.95 R, on a square grid whose corners lie beyond the sphere; gradient to R."""
    radius, semi, size, pitch = 50 * um, 47.5 * um, 33, 0.5 * um
    distance = radius / (INDEX - 1)
    weights = _weights(size)
    centres = oracles.pixel_centres(size, pitch)
    radii, where = np.unique(np.hypot(*np.meshgrid(centres, centres)), return_inverse=True)

    def loss(value: float) -> Tensor:
        opd = oracles.fresnel_opd(index=INDEX, radius_of_curvature=value, distance=math.inf, sensor_distance=distance)
        intensity = oracles.fresnel_radial(
            radii, aperture_radius=semi, sensor_distance=distance, wavelength=WAVELENGTH, opd=opd
        )
        return (torch.from_numpy(intensity[where]).reshape(size, size) * weights).sum() * pitch**2

    truth = float(_derivative(loss, radius, 1e-4 * radius))

    parameter = nn.Parameter(torch.tensor(radius))
    u = torch.linspace(-1, 1, 257) * semi
    r2 = u[:, None] ** 2 + u**2
    sag = torch.where(r2 <= semi**2, (parameter**2 - r2).sqrt() - parameter, 0.0)
    path = (r2 / (2 * distance) + (INDEX - 1) * sag) * WAVENUMBER
    field = torch.polar((r2 <= semi**2).float(), path)
    angle = torch.from_numpy(centres).float()[:, None] * u * (WAVENUMBER / distance)
    kernel = torch.complex(angle.cos(), -angle.sin())
    sensor = kernel @ field @ kernel.T
    share = (u[1] - u[0]) ** 4 * pitch**2 / ((WAVELENGTH * distance) ** 2 * math.pi * semi**2)
    image = (sensor.real**2 + sensor.imag**2) * share
    (naive,) = torch.autograd.grad((image * weights).sum(), parameter)

    parameter = nn.Parameter(torch.tensor(radius))
    lens = optics.Lens(
        optics.CircularAperture(2 * semi), optics.PlanoConvexLens(parameter, glass=INDEX), sensor_distance=distance
    )
    with warnings.catch_warnings():  # f/1.1 is beyond the f-numbers that were tested, which is the point here
        warnings.simplefilter("ignore", UserWarning)
        psf = _psf(lens, distances=math.inf, size=size, pixel_pitch=pitch, samples=1024)
    (ours,) = torch.autograd.grad((psf * weights).sum(), parameter)
    errors = (abs(float(value) / truth - 1) for value in (naive, ours))
    return Row(
        "corners beyond the sphere, aperture 0.95 R", "where(inside, sqrt(R^2 - r^2), 0)",
        "gradient to R, relative error", *errors,
    )  # fmt: skip


# ---- roots at 0 ------------------------------------------------------------------------------------------------------


def root_on_the_axis() -> Row:
    """Zernike terms in polar coordinates, and the gradient to the aperture's size, on a grid with a node at 0."""
    coefficients = {4: 40 * nm, 6: 60 * nm, 8: 50 * nm}  # Noll: defocus, astigmatism, coma [m RMS]
    weights = _weights(33)
    centres = oracles.pixel_centres(33, PITCH)

    def loss(semi: float) -> Tensor:
        # the map keeps its own size: what the aperture opens is the same glass
        opd = oracles.zernike_opd(coefficients, aperture_radius=semi)
        image = oracles.fresnel_image(
            centres, centres, aperture_radius=semi, sensor_distance=DISTANCE, wavelength=WAVELENGTH, opd=opd,
            radial_nodes=64, angular_nodes=128,
        )  # fmt: skip
        return (torch.from_numpy(image) * PITCH**2 * weights).sum()

    truth = float(_derivative(loss, SEMI, 1e-3 * SEMI))

    semi = nn.Parameter(torch.tensor(SEMI))
    u = torch.linspace(-1, 1, 257) * semi
    r = (u[:, None] ** 2 + u**2).sqrt()
    theta = torch.atan2(u[:, None].expand_as(r), u.expand_as(r))
    rho = r / semi
    path = (
        coefficients[4] * math.sqrt(3) * (2 * rho**2 - 1)
        + coefficients[6] * math.sqrt(6) * rho**2 * (2 * theta).cos()
        + coefficients[8] * math.sqrt(8) * (3 * rho**3 - 2 * rho) * theta.cos()
    )
    field = torch.polar((rho <= 1).float(), WAVENUMBER * path)
    angle = torch.from_numpy(centres).float()[:, None] * u * (WAVENUMBER / DISTANCE)
    kernel = torch.complex(angle.cos(), -angle.sin())
    sensor = kernel @ field @ kernel.T
    share = (u[1] - u[0]) ** 4 * PITCH**2 / ((WAVELENGTH * DISTANCE) ** 2 * math.pi * semi**2)
    (naive,) = torch.autograd.grad(((sensor.real**2 + sensor.imag**2) * share * weights).sum(), semi)

    diameter = nn.Parameter(torch.tensor(2 * SEMI))
    aberration = torch.zeros(8)
    for j, value in coefficients.items():
        aberration[j - 1] = value
    lens = optics.Lens(
        optics.CircularAperture(diameter), optics.ThinLens(DISTANCE), optics.ZernikeAberration(aberration),
        sensor_distance=DISTANCE,
    )  # fmt: skip
    (ours,) = torch.autograd.grad((_psf(lens, distances=math.inf, size=33) * weights).sum(), diameter)
    errors = (abs(float(naive) / truth - 1), abs(2 * float(ours) / truth - 1))
    return Row("Zernike terms on the axis", "r = sqrt(u^2 + v^2), atan2", "gradient to a, relative error", *errors)


def root_in_the_dark() -> Row:
    """A plate of half a wave over one half of a square pupil: exactly 0 on the axis. Gradient to a tilt.

    U(x) = INT sign(u) exp(-i b u) du = -2i (1 - cos(b a)) / b over -a..a, b = k x / d - 2 k c / a for a tilt c of
    Noll's Z2, times a sinc in y.
    """
    size = 33
    weights = _weights(size)
    centres = torch.from_numpy(oracles.pixel_centres(size, PITCH))

    def loss(tilt: float) -> Tensor:
        b = SEMI * WAVENUMBER * (centres / DISTANCE - 2 * tilt / SEMI)
        plate = torch.where(b == 0, 0.0, (1 - b.cos()) / torch.where(b == 0, 1.0, b))
        sinc = torch.sinc(SEMI * WAVENUMBER * centres / DISTANCE / math.pi)
        image = sinc[:, None] ** 2 * plate**2 * (2 * SEMI) ** 2 / (WAVELENGTH * DISTANCE) ** 2 * PITCH**2
        return (image * weights).sum()

    truth = float(_derivative(loss, 0.0, 1e-9))

    tilt = nn.Parameter(torch.zeros(()))
    u = (torch.arange(256) - 127.5) * (SEMI / 128)
    field = torch.polar(torch.ones(256, 256), (WAVENUMBER * 2 * tilt / SEMI * u).expand(256, 256)) * u.sign()
    angle = centres.float()[:, None] * u * (WAVENUMBER / DISTANCE)
    kernel = torch.complex(angle.cos(), -angle.sin())
    sensor = kernel @ field @ kernel.T
    amplitude = (sensor.real**2 + sensor.imag**2).sqrt()
    share = (SEMI / 128) ** 4 * PITCH**2 / ((WAVELENGTH * DISTANCE) ** 2 * (2 * SEMI) ** 2)
    (naive,) = torch.autograd.grad((amplitude**2 * share * weights).sum(), tilt)

    coefficients = nn.Parameter(torch.zeros(3))
    plate = torch.tensor([[math.pi, 0.0], [math.pi, 0.0]])
    lens = optics.Lens(
        optics.SquareAperture(2 * SEMI), optics.ThinLens(DISTANCE), optics.ZernikeAberration(coefficients),
        optics.DOE(plate, design_wavelength=WAVELENGTH), sensor_distance=DISTANCE,
    )  # fmt: skip
    (ours,) = torch.autograd.grad((_psf(lens, distances=math.inf, size=size) * weights).sum(), coefficients)
    errors = (abs(float(value) / truth - 1) for value in (naive, ours[1]))
    return Row("a dark pixel", "sqrt(re^2 + im^2)", "gradient to a tilt, relative error", *errors)


def poisson_in_the_dark() -> Row:
    """d E[N] / d lambda is 1 at every expectation lambda; at 0 the reparameterised draw has no slope."""
    results = []
    for count in (
        lambda rate: rate + rate.sqrt() * torch.randn(rate.shape, generator=torch.Generator().manual_seed(0)),
        lambda rate: poisson(rate, generator=torch.Generator().manual_seed(0)),
    ):
        rate = torch.zeros(1000, requires_grad=True)
        (gradient,) = torch.autograd.grad(count(rate).sum(), rate)
        results.append(abs(float(gradient.mean()) - 1))
    return Row(
        "Poisson noise where nothing arrives", "x + sqrt(x) randn", "mean gradient, which is 1: its error", *results
    )


# ---- energy ----------------------------------------------------------------------------------------------------------


def light_beside_the_window() -> Row:
    """Rays tilted by 60 pixels miss a window of 33: it holds no light. Its share, and the gradient to the tilt."""
    tilt = 60 * PITCH / DISTANCE * SEMI / 2  # of Noll's Z2 [m RMS]

    def rays() -> tuple[Tensor, Tensor]:
        coefficients = nn.Parameter(torch.tensor([0.0, tilt, 0.0]))
        lens = _singlet(RADIUS, optics.ZernikeAberration(coefficients))
        return _psf(lens, size=33, propagator="geometric", method="rays", samples=None), coefficients

    image, coefficients = rays()
    normalised = image / image.sum()
    (slope,) = torch.autograd.grad(normalised.square().sum(), coefficients)
    naive = float(normalised.detach().sum()) + float(slope.sum())
    image, coefficients = rays()
    (slope,) = torch.autograd.grad(image.square().sum(), coefficients)
    return Row(
        "no light in the window", "psf / psf.sum()", "energy and its gradient, both 0", naive,
        abs(float(image.detach().sum())) + float(slope.abs().sum()),
    )  # fmt: skip


def light_mostly_beside_the_window() -> Row:
    """Such a beam as a wave: what diffracts into the window is the whole light after a division by its sum."""
    tilt = 60 * PITCH / DISTANCE * SEMI / 2
    size = 33
    opd = oracles.defocus_opd(vergence=0.0, extra=lambda u, v: 2 * tilt * u / SEMI)
    centres = oracles.pixel_centres(size, PITCH)
    truth = PITCH**2 * oracles.fresnel_image(
        centres, centres, aperture_radius=SEMI, sensor_distance=DISTANCE, wavelength=WAVELENGTH, opd=opd
    )
    lens = optics.Lens(
        optics.CircularAperture(2 * SEMI), optics.ThinLens(DISTANCE),
        optics.ZernikeAberration(torch.tensor([0.0, tilt, 0.0])), sensor_distance=DISTANCE,
    )  # fmt: skip
    image = _psf(lens, distances=math.inf, size=size)
    share = float(truth.sum())
    return Row(
        "light beside the window", "psf / psf.sum()", f"energy in the window, {share:.1e}: its error",
        abs(float((image / image.sum()).sum()) - share), abs(float(image.sum()) - share),
    )  # fmt: skip


def replicas() -> Row:
    """256 pupil samples over 10 mm repeat the PSF every 0.7 mm, in a window of 1.8 mm."""
    semi, count, size, pitch = 5 * mm, 256, 301, 6 * um
    u = (torch.arange(count) - (count - 1) / 2) * (2 * semi / count)
    r2 = u[:, None] ** 2 + u**2
    field = (r2 <= semi**2).to(torch.complex64)
    angle = torch.from_numpy(oracles.pixel_centres(size, pitch)).float()[:, None] * u * (WAVENUMBER / DISTANCE)
    kernel = torch.complex(angle.cos(), -angle.sin())
    sensor = kernel @ field @ kernel.T
    share = (2 * semi / count) ** 4 * pitch**2 / ((WAVELENGTH * DISTANCE) ** 2 * math.pi * semi**2)
    naive = float((sensor.real**2 + sensor.imag**2).sum()) * share
    lens = optics.Lens(optics.CircularAperture(2 * semi), optics.ThinLens(DISTANCE), sensor_distance=DISTANCE)
    refusal = _refusal(
        lambda: _psf(lens, distances=math.inf, size=size, pixel_pitch=pitch, samples=count, integrate=True)
    )
    return Row("pupil sampled too coarsely", "256 samples over 10 mm", "energy in a window of 1.8 mm", naive, refusal)


def smaller_than_a_pixel() -> Row:
    """An f/2 lens on pixels of 10 um: an Airy disc of 2.7 um."""
    semi, distance, pitch, size = 5 * mm, 20 * mm, 10 * um, 17
    case = {"wavelength": WAVELENGTH, "aperture_radius": semi, "sensor_distance": distance}
    grid = oracles.pixel_centres(size, pitch).astype(np.float32)
    naive = float(oracles.airy(grid, grid[:, None], **case).sum()) * pitch**2
    truth = oracles.airy_square_energy(size / 2 * pitch, **case)
    lens = optics.Lens(optics.CircularAperture(2 * semi), optics.ThinLens(distance), sensor_distance=distance)
    ours = float(_psf(lens, distances=math.inf, size=size, pixel_pitch=pitch, integrate=True, samples=None).sum())
    return Row(
        "PSF smaller than a pixel", "|U|^2 at the pixel's centre", f"energy, {truth:.3f}: its error",
        abs(naive - truth), abs(ours - truth),
    )  # fmt: skip


# ---- precision of products -------------------------------------------------------------------------------------------


def reduced_products(device: str | torch.device = "cpu") -> Row:
    """Matrix products in TF32, 10 bits of mantissa: by the GPU itself, on a CPU by rounding the factors so."""
    device = torch.device(device)
    count = 256
    u = (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * (2 * SEMI / count)
    r2 = u[:, None] ** 2 + u**2
    mask = ((SEMI - r2.sqrt()) * count / (2 * SEMI) + 0.5).clamp(0, 1)
    phase = _residual(r2)
    angle = torch.from_numpy(oracles.pixel_centres(SIZE, PITCH))[:, None] * u * (WAVENUMBER / DISTANCE)

    def image(left: Tensor, field: tuple[Tensor, Tensor], product: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """|E P E^T|^2 in real products, as tensor cores do them."""
        parts = torch.cat([angle.cos(), -angle.sin()]).to(left)
        along_x = [product(part, parts.mT) for part in field]
        c, s = SIZE, SIZE
        re = along_x[0][:, :c] - along_x[1][:, c:]
        im = along_x[0][:, s:] + along_x[1][:, :s]
        both_re, both_im = product(parts, re), product(parts, im)
        total_re, total_im = both_re[:c] - both_im[c:], both_re[c:] + both_im[:c]
        return (total_re**2 + total_im**2).double().cpu()

    field = tuple((mask * part).float().to(device) for part in (phase.cos(), phase.sin()))
    exact = image(field[0].double(), tuple(part.double() for part in field), torch.matmul)
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        product = torch.matmul if device.type == "cuda" else lambda a, b: _to_tf32(a) @ _to_tf32(b)
        naive = image(field[0], field, product)
        ours = _psf(_singlet().to(device)).cpu()
    finally:
        torch.set_float32_matmul_precision(before)
    return Row(
        'float32 products set to "high"', "E @ P @ E.T in TF32", "L1 of the PSF", _l1(naive, exact),
        _l1(ours, _truth()),
    )  # fmt: skip


def _to_tf32(values: Tensor) -> Tensor:
    """Round to 10 bits of mantissa."""
    mantissa, exponent = torch.frexp(values)
    return torch.ldexp((mantissa * 2**11).round() / 2**11, exponent)


# ---- pixel maps ------------------------------------------------------------------------------------------------------


def binned_map() -> Row:
    """A DOE of 297 x 297 flat pixels, its field binned 3 x 3 and the PSF corrected by the bins' sinc: 2 % off.

    The gradient of a weighted sum over the window to every pixel's phase, by its direction. Truth: each pixel in 3 x 3
    nodes, the rim's by their share.
    """
    n, bins, size, pitch = 297, 3, 199, 4 * um
    side = torch.linspace(-1, 1, n, dtype=torch.float64)
    phase = 12 * (3 * side + 1).sin() * (2 * side[:, None]).cos() + 8 * side**2 * side[:, None]
    weights = _weights(size)
    centres = torch.from_numpy(oracles.pixel_centres(size, pitch))
    scale = pitch**2 / ((WAVELENGTH * DISTANCE) ** 2 * math.pi * SEMI**2)

    def axis(count: int) -> Tensor:
        return (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * (2 * SEMI / count)

    u = axis(3 * n)
    r2 = u[:, None] ** 2 + u**2
    mask = ((SEMI - r2.sqrt()) * 3 * n / (2 * SEMI) + 0.5).clamp(0, 1)

    def gradient(to_image: Callable[[Tensor], Tensor]) -> Tensor:
        field = mask.to(torch.complex128) * torch.polar(torch.ones_like(r2), _residual(r2))
        values = phase.clone().requires_grad_()
        fine = values.repeat_interleave(3, 0).repeat_interleave(3, 1)
        sensor = to_image(field * torch.polar(torch.ones_like(fine), fine))
        image = (sensor.real.square() + sensor.imag.square()) * scale
        return torch.autograd.grad((image * weights).sum(), values)[0]

    def transform(field: Tensor) -> Tensor:
        angle = centres[:, None] * axis(len(field)) * (WAVENUMBER / DISTANCE)
        kernel = torch.complex(angle.cos(), -angle.sin())
        return kernel @ field @ kernel.T * (2 * SEMI / len(field)) ** 2

    def binned(field: Tensor) -> Tensor:
        sinc = torch.sinc(centres * (2 * SEMI * bins / n) / (WAVELENGTH * DISTANCE))
        return transform(field.unflatten(0, (-1, 3 * bins)).unflatten(2, (-1, 3 * bins)).mean((1, 3))) / (
            sinc[:, None] * sinc
        )

    truth, naive = gradient(transform), gradient(binned)
    values = nn.Parameter(phase.float())
    lens = _singlet(RADIUS, optics.DOE(values, design_wavelength=WAVELENGTH))
    image = _psf(lens, size=size, pixel_pitch=pitch, samples=None)
    (ours,) = torch.autograd.grad((image * weights).sum(), values)

    def missing(value: Tensor) -> float:
        return 1 - float((value * truth).sum() / (value.norm() * truth.norm()))

    return Row(
        "DOE finer than the pupil grid", "field binned 3 x 3", "gradient to the DOE, 1 - cosine", missing(naive),
        missing(ours.double()),
    )  # fmt: skip


TRAPS: tuple[Callable[[], Row], ...] = (
    *(functools.wraps(phase)(functools.partial(_phase_row, case)) for case, (_, phase) in PHASES.items()),
    transfer_function,
    at_infinity,
    towards_infinity,
    gradient_towards_infinity,
    gradient_at_infinity,
    lens_before_infinity,
    beyond_the_sphere,
    close_to_the_sphere,
    root_on_the_axis,
    root_in_the_dark,
    poisson_in_the_dark,
    light_beside_the_window,
    light_mostly_beside_the_window,
    replicas,
    smaller_than_a_pixel,
    reduced_products,
    binned_map,
)


def rows() -> list[Row]:
    """The whole table, on the CPU: a few seconds."""
    return [trap() for trap in TRAPS]
