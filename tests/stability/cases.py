"""The table of hard cases: every item of issue 4's list, each as a small camera and a scene.

To add a case, write a builder (and a limit, where nature has an answer) and a row. `NAMES` lists them for the README.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import io
import itertools
import math
import pickle
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import oracles
import torch
from contract import SINGLE, BadCase, Case, Shot, l1, recorded, relative
from torch import Tensor, nn

from kcam import Camera, Scene, isp, optics, sensor
from kcam.optics.lens import TESTED_F_NUMBERS
from kcam.units import mm, nm, um

WAVELENGTH = 550 * nm
FEW = torch.linspace(430, 690, 5, dtype=torch.float64) * nm
DIAMETER, FOCAL, PITCH = 2 * mm, 20 * mm, 4 * um
PHONE = 4.3 * mm  # focal length at which the range of f-numbers was tested
INFINITY = math.inf

ITEMS = (
    "exact focus with a flat DOE", "object at infinity", "approach to infinity", "object at 5 cm",
    "100 waves of defocus",
    "pinhole under one pupil sample", "f-number at the ends of the tested range", "lens at r -> R",
    "PSF far smaller than a pixel", "PSF larger than the window", "PSF larger than the image",
    "DOE height 0", "DOE height 1000 waves", "DOE white noise of 30 radians", "DOE height NaN",
    "DOE wrapped and unwrapped", "wavelengths at both ends", "equal wavelengths", "cube with 1 band",
    "cube with 301 bands", "image of 1x1", "image of 1xN", "image of odd size", "image of prime size",
    "very wide image", "empty batch", "black scene", "one photon", "saturated scene", "dynamic range 1e8",
    "negative radiance", "NaN radiance", "depth map with one value", "depth 0", "depth map with inf",
    "depth map with a step edge", "depth map with all layers different", "full well reached", "sigma 0", "1 bit",
    "24 bits", "gradient through Poisson at 0", "non-contiguous input", "expanded input", "half-precision input",
    "autocast", "deterministic repeat", "train, evaluate, train again", "deepcopy between two calls",
    "pickle between two calls", "load_state_dict between two calls", ".to() between two calls",
    "float32 matmul precision high", "anomaly detection",
)  # fmt: skip


# ---- cameras -----------------------------------------------------------------------------------------------------


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def trained(value: float) -> nn.Parameter:
    return nn.Parameter(torch.tensor(value))


def lens(
    *others: optics.Element, diameter: float = DIAMETER, focal: float = FOCAL, focus: float = 2.0, singlet: bool = False
) -> optics.Lens:
    """An ideal or a plano-convex lens in focus; its curvature,
    the sensor's distance and the others' parameters train."""
    curved = optics.PlanoConvexLens(trained(focal * 0.5185)) if singlet else optics.ThinLens(trained(focal))
    elements = (optics.CircularAperture(diameter), curved, *others)
    in_focus = optics.Lens(*elements, focus_distance=focus).sensor_distance
    return optics.Lens(*elements, sensor_distance=nn.Parameter(torch.tensor(in_focus, dtype=torch.float64)))


def fixed_lens() -> optics.Lens:
    """Of which only the DOE trains: three times as fast."""
    return optics.Lens(optics.CircularAperture(DIAMETER), optics.ThinLens(FOCAL), doe(), focus_distance=2.0)


def fixed_singlet(*, focal: float, share: float) -> optics.Lens:
    """Its aperture reaches a share of the radius of curvature, which trains."""
    radius = focal * 0.5185
    elements = optics.CircularAperture(2 * share * radius), optics.PlanoConvexLens(trained(radius))
    return optics.Lens(*elements, focus_distance=2.0)


def doe(phase: Tensor | None = None, **arguments: Any) -> optics.DOE:
    return optics.DOE(nn.Parameter(6 * random(9, 9) if phase is None else phase), **arguments)


def camera(
    of: optics.Lens | None = None,
    *,
    full_well: float = 10_000,
    sigma: Any = 3.0,
    bits: int = 12,
    black_level: float = 0.0,
    exposure: sensor.Exposure | None = None,
    pitch: float = PITCH,
    psf_shape: tuple[int, int] | None = (15, 15),
    **imaging: Any,
) -> Camera:
    """All stages of a camera; by default a singlet with a random DOE, all of which trains, and so do the filters."""
    of = lens(doe(), singlet=True) if of is None else of
    kodak = sensor.ColourFilter.kodak()
    return Camera(
        optics.Imaging(of, pixel_pitch=pitch, psf_shape=psf_shape, **imaging),
        sensor.ColourFilter(nn.Parameter(kodak.coefficients.clone()), width=kodak.width),
        sensor.Mosaic("RGGB"),
        exposure or sensor.Exposure(),
        sensor.ShotNoise(full_well=full_well),
        sensor.ReadNoise(sigma),
        sensor.ADC(bits, black_level=black_level),
        isp.Demosaic(),
        isp.WhiteBalance(),
        isp.ColourMatrix(),
        isp.ToneCurve(),
    )


def photo(height: int = 24, width: int = 24, *, batch: int = 1, **arguments: Any) -> Scene:
    """Mid tones of all colours, in five bands."""
    arguments = {"wavelengths": FEW} | arguments
    return Scene.from_rgb(0.1 + 0.8 * random(batch, 3, height, width, seed=1), **arguments)


def even(height: int = 24, width: int = 24, level: float = 0.5, **arguments: Any) -> Scene:
    """A gray wall: one pixel repeated, for a power of a whole picture differs in its last bit between its elements."""
    pixel = Scene.from_rgb(torch.full((1, 3, 1, 1), level), wavelengths=FEW)
    planes = pixel.coefficients.expand(-1, -1, height, width).clone()
    return Scene(planes, pixel.spectra, wavelengths=FEW, **arguments)


def half_white() -> Scene:
    return Scene.from_rgb(torch.where(torch.arange(24) < 12, 0.2, 1.0).expand(1, 3, 24, 24), wavelengths=FEW)


def cube(bands: Tensor, wavelengths: Tensor, **arguments: Any) -> Scene:
    return Scene.from_bands(bands, wavelengths=wavelengths, **arguments)


def case(name: str, item: str, of: Callable[[], Camera], scene: Callable[[], Scene], **arguments: Any) -> Case:
    return Case(name, item, lambda: (of(), scene()), **arguments)


def number(value: Tensor) -> float:
    return float(value.detach())


# ---- what limits are made of -------------------------------------------------------------------------------------


def psf(
    shot: Shot, *, of: optics.Lens | None = None, wavelengths=(WAVELENGTH,), distance: Any = None, **arguments: Any
) -> Tensor:
    """(Z, L, H, W) of the shot's lens on its pixels, without a graph."""
    imaging = shot.camera[0]
    arguments = {"pixel_pitch": imaging.pixel_pitch, "shape": (15, 15), "dtype": shot.dtype} | arguments
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the contract has seen them
        distance = shot.scene.depth if distance is None else distance
        return (of or imaging.lens).psf(list(wavelengths), distances=distance, **arguments)


def grid(count: int, pitch: float) -> np.ndarray:
    x, y = np.meshgrid(oracles.pixel_centres(count, pitch), oracles.pixel_centres(count, pitch))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def raw(shot: Shot, scene: Scene, of: Camera | None = None) -> Tensor:
    """What the exact camera records of another scene."""
    of = of or shot.exact
    with torch.no_grad():
        return recorded(of, {str(index): s for index, (_, s) in enumerate(of.steps(scene))})


def like(shot: Shot, scene: Scene) -> Scene:
    return scene.to(shot.device, shot.dtype)


def same(value: Tensor, truth: Tensor, bound: float) -> None:
    assert value.shape == truth.shape
    error = relative(value, truth)
    print(f"from the limit: {error:.1e} (at most {bound:.0e})")
    assert error <= bound


def stays_even(shot: Shot) -> None:
    """An even wall gives an even picture of its own light times the PSF's share in the window, whatever the sizes."""
    _, _, height, width = shot.scene.coefficients.shape
    scene = like(shot, even(height, width, depth=shot.scene.depth))
    with torch.no_grad():
        image = shot.camera[:2](scene)
        share = psf(shot, wavelengths=FEW.tolist(), shape=shot.camera[0].psf_shape).sum((-2, -1))[0]
        bands = scene.bands()[:, :, :1, :1] * share[:, None, None].to(shot.device)
        expected = torch.einsum("cl,blhw->bchw", shot.camera[1].contraction(FEW).to(bands), bands).expand_as(image)
    same(image, expected, shot.bound(2e-6, 1e-12))  # sums of 225 non-negative pixels through FFTs


# ---- focus and distance ------------------------------------------------------------------------------------------


def is_airy(shot: Shot) -> None:
    """Paraxial PSF, integrated over the pixels, against the closed form.

    3e-5 is the edge weights' error at the default sampling; the rim cuts flat pixels in cells, for which the table of
    propagators states 1.5e-3.
    """
    radius, distance = DIAMETER / 2, number(shot.camera[0].lens.sensor_distance)
    found = psf(shot, propagator="fresnel")[0, 0]

    def airy(points: np.ndarray) -> np.ndarray:
        return oracles.airy(*points.T, wavelength=WAVELENGTH, aperture_radius=radius, sensor_distance=distance)

    truth = oracles.pixel_integrate(airy, grid(15, PITCH), pitch=PITCH).reshape(15, 15)
    error = l1(found, truth)
    print(f"Airy: {error:.1e}")
    assert error <= (1.5e-3 if shot.camera[0].lens.has_pixel_phase else 3e-5)


def infinity_is_a_map_of_infinity(shot: Shot) -> None:
    """And V = 1/z is exactly 0 there: the same numbers."""
    height, width = shot.scene.shape[1:]
    mapped = shot.scene.with_depth(torch.full((height, width), INFINITY))
    is_the_same_sum(raw(shot, mapped), raw(shot, shot.scene))


def approaches_infinity(shot: Shot) -> None:
    """W20 = a^2 / 2z is 1e-2 waves at 100 m, and the raw is smooth in it: it comes closer at least as 1 / z."""
    distances = [10.0**power for power in range(2, 13)]
    with_inf = raw(shot, shot.scene)
    errors = [relative(raw(shot, replace(shot.scene, depth=distance)), with_inf) for distance in distances]
    print("1e2 .. 1e12 m against inf:", " ".join(f"{error:.0e}" for error in errors))
    floor = 3e-7  # of float32's FFTs, and a few steps of 24 bits
    assert errors[0] > 1e-5
    assert all(after <= before / 5 + floor for before, after in itertools.pairwise(errors))
    assert errors[-1] <= floor


def is_reference(bound: float) -> Callable[[Shot], None]:
    def limit(shot: Shot) -> None:
        error = l1(psf(shot), psf(shot, propagator="reference"))
        print(f"reference: {error:.1e}")
        assert error <= bound

    return limit


def is_direct_sum(shot: Shot) -> None:
    """Rayleigh-Sommerfeld, pixel by pixel of the map; the table of propagators states 4e-3 for flat pixels."""
    of, pitch = shot.camera[0].lens, shot.camera[0].pixel_pitch
    truth = oracles.direct_sum_psf(
        phase_map(of), grid(15, pitch), pitch=DIAMETER / 9, aperture_radius=DIAMETER / 2,
        sensor_distance=number(of.sensor_distance), wavelength=WAVELENGTH, opd=singlet_opd(of), source_distance=0.05,
    )  # fmt: skip
    error = l1(psf(shot, integrate=False)[0, 0], truth.reshape(15, 15) * pitch**2)
    print(f"direct sum: {error:.1e}")
    assert error <= 4e-3


def phase_map(of: optics.Lens) -> np.ndarray:
    """Of its DOE, at the design wavelength."""
    return of.elements[2].phase.detach().cpu().double().numpy()


def singlet_opd(of: optics.Lens) -> oracles.OPD:
    radius = number(of.elements[1].radius_of_curvature)
    index = 1 + number(of.power(torch.tensor([WAVELENGTH], dtype=torch.float64))[0]) * radius
    return oracles.plano_convex_opd(index=index, radius_of_curvature=radius)


def is_lommel(waves: float, bound: float) -> Callable[[Shot], None]:
    """So many waves at the rim, in Lommel's series; points, in the paraxial model."""

    def limit(shot: Shot) -> None:
        of, pitch = shot.camera[0].lens, shot.camera[0].pixel_pitch
        found = psf(shot, propagator="fresnel", integrate=False)[0, 0].cpu().double().numpy() / pitch**2
        # what float32 left of the focus counts too
        vergence = -1 / number(of.elements[1].focal_length) + 1 / number(of.sensor_distance) + 1 / shot.scene.depth
        all_waves = waves + vergence * (DIAMETER / 2) ** 2 / 2 / WAVELENGTH
        points = grid(15, pitch)
        truth = oracles.lommel(
            np.hypot(*points.T), defocus=all_waves * WAVELENGTH, wavelength=WAVELENGTH, aperture_radius=DIAMETER / 2,
            sensor_distance=number(of.sensor_distance),
        ).reshape(15, 15)  # fmt: skip
        error = float(np.abs(found - truth).sum() / truth.sum())
        print(f"Lommel: {error:.1e}")
        assert error <= bound

    return limit


# ---- apertures ---------------------------------------------------------------------------------------------------


def is_a_pinhole(shot: Shot) -> None:
    """The irradiance on the axis is that of the hole's area: A / (lambda d)^2, and the first minimum is far outside."""
    of = shot.camera[0].lens
    area, distance = of.aperture_area(), number(of.sensor_distance)
    found = psf(shot, integrate=False)[0, 0]
    peak = area * shot.camera[0].pixel_pitch ** 2 / (WAVELENGTH * distance) ** 2
    # the oblique share of the Debye map's normalisation is (a / d)^2 = 2e-8
    assert abs(float(found[7, 7]) / peak - 1) <= shot.bound(1e-5, 1e-6)
    assert float(found.min()) > 0.9 * peak


def sees_one_doe_pixel(shot: Shot) -> None:
    """All light passes the middle pixel of the map, whose phase is a piston."""
    bare = optics.Lens(*shot.camera[0].lens.elements[:2], sensor_distance=shot.camera[0].lens.sensor_distance)
    error = l1(psf(shot), psf(shot, of=bare))
    print(f"without the DOE: {error:.1e}")
    assert error <= 2e-4  # the rim cuts cells of the map by their area


def is_rayleigh_sommerfeld(bound: float) -> Callable[[Shot], None]:
    """The claim of `TESTED_F_NUMBERS`, at one end: points on a row, weighted by the ring that each stands for."""

    def limit(shot: Shot) -> None:
        of = shot.camera[0].lens
        radius, distance = float(of.aperture.semi_aperture()), number(of.sensor_distance)
        step = WAVELENGTH * distance / (8 * radius)  # half the Nyquist pitch of the intensity
        r = np.arange(60) * step
        if isinstance(of.elements[1], optics.ThinLens):
            path = stigmatic(2.0, 1 / (1 / number(of.elements[1].focal_length) - 1 / 2.0))
        else:
            path = singlet_opd(of)
        for source in (0.5, 2.0, INFINITY):
            truth = step**2 * oracles.rayleigh_sommerfeld(
                np.stack([r, 0 * r], axis=1), aperture_radius=radius, sensor_distance=distance, wavelength=WAVELENGTH,
                element_opd=path, source_distance=source, symmetric=True,
            )  # fmt: skip
            for method in ("radial", "matrix"):
                image = psf(shot, distance=source, pixel_pitch=step, shape=(119, 119), integrate=False, method=method)
                row = image[0, 0, 59, 59:].cpu().double().numpy()
                error = float(np.sum(np.abs(row - truth) * (r + step / 6)) / np.sum(truth * (r + step / 6)))
                print(f"Rayleigh-Sommerfeld at {source} m, {method}: {error:.1e}")
                assert error <= bound

    return limit


def stigmatic(*distances: float) -> oracles.OPD:
    """A point at the first distance made to converge exactly at the second."""

    def path(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        r2 = u**2 + v**2
        return -sum(r2 / d / (1 + np.sqrt(1 + r2 / d**2)) for d in distances)

    return path


def converges_at_the_rim(shot: Shot) -> None:
    """The steepest rays leave the window: energy stays below 1, and the Hankel and the matrix form agree.

    5e-3: the two sample a rim whose slope grows without bound in different ways.
    """
    hankel, matrix = (psf(shot, method=method) for method in ("radial", "matrix"))
    assert 0 < float(hankel.sum()) < 1
    error = l1(hankel, matrix)
    print(f"radial against matrix: {error:.1e}")
    assert error <= 5e-3


def keeps_its_energy(shot: Shot) -> None:
    """A blur of millimetres: little light in the window, and the wider the window, the more."""
    shares = [float(psf(shot, shape=(n, n)).sum()) for n in (3, 15)]
    print("share of the light:", " ".join(f"{share:.2e}" for share in shares))
    assert 0 < shares[0] < shares[1] < 1


# ---- PSF sizes ---------------------------------------------------------------------------------------------------


def is_one_pixel(shot: Shot) -> None:
    """All light but the Airy pattern's wings, whose share has a closed form, falls into one pixel."""
    of, pitch = shot.camera[0].lens, shot.camera[0].pixel_pitch
    found = psf(shot, shape=(3, 3))[0, 0]
    truth = oracles.airy_square_energy(
        pitch / 2, wavelength=WAVELENGTH, aperture_radius=number(of.sensor_distance) / of.f_number / 2,
        sensor_distance=number(of.sensor_distance),
    )  # fmt: skip
    print(f"middle pixel {float(found[1, 1]):.5f}, Airy {truth:.5f}, all {float(found.sum()):.5f}")
    assert abs(float(found[1, 1]) - truth) <= 1e-3  # non-paraxial at f/5
    assert 0.97 < truth < float(found.sum()) <= 1
    same(raw(shot, shot.scene), raw(shot, shot.scene, shot.exact[1:]), 2 * (1 - truth))


def is_a_crop(shot: Shot) -> None:
    """A window's pixels are those of a larger window, and the light beyond is missing, not squeezed in."""
    small, large = psf(shot), psf(shot, shape=(61, 61))
    error = l1(small, large[..., 23:38, 23:38])
    print(f"crop of a larger window: {error:.1e}; energy {float(small.sum()):.3f} of {float(large.sum()):.3f}")
    assert error <= (4e-3 if shot.camera[0].lens.has_pixel_phase else 1e-4)  # each window has its own sampling
    assert float(small.sum()) < 0.8 * float(large.sum()) < 0.8


def window_is_the_picture(shot: Shot) -> None:
    """No pixel has light from further away than the picture is wide; what falls beside it is missing."""
    vergences = torch.tensor([1 / 0.2], dtype=torch.float64)
    shape = shot.camera[0].psf_window(shot.scene.wavelengths, vergences=vergences, picture=(7, 9))
    assert shape == (7, 9)
    assert 0 < float(psf(shot, shape=shape).sum()) < 0.1


# ---- diffractive elements ----------------------------------------------------------------------------------------


def without_doe(shot: Shot) -> optics.Lens:
    of = shot.camera[0].lens
    return optics.Lens(*of.elements[:2], sensor_distance=of.sensor_distance)


def doe_does_nothing(shot: Shot) -> None:
    error = l1(psf(shot, wavelengths=FEW.tolist()), psf(shot, of=without_doe(shot), wavelengths=FEW.tolist()))
    print(f"without the DOE: {error:.1e}")
    assert error <= 2e-3  # the rim cuts the cells of a map by their area: half of what the table states for flat pixels


def flat_doe_trains(shot: Shot) -> None:
    """Height 0 looks symmetric, but its gradient is not: nothing may be skipped for its value."""
    doe_does_nothing(shot)
    gradient = shot.gradients["stages.0.lens.elements.2.phase"]
    assert float(gradient.abs().max()) > 0
    assert relative(gradient.flip(0), gradient) > 0.1


def wraps(bound_single: float) -> Callable[[Shot], None]:
    """At the design wavelength whole waves are nothing. In float32 a phase of 2 pi n is rounded by 2 pi n 6e-8."""

    def limit(shot: Shot) -> None:
        wrapped = copy.deepcopy(shot.camera[0].lens)
        with torch.no_grad():
            wrapped.elements[2].phase.remainder_(2 * torch.pi)
        error = l1(psf(shot), psf(shot, of=wrapped))
        print(f"wrapped against unwrapped: {error:.1e}")
        assert error <= shot.bound(bound_single, 1e-9 + bound_single * 1e-3)
        assert float(psf(shot).sum()) <= 1 + 1e-4

    return limit


# ---- wavelengths -------------------------------------------------------------------------------------------------


def scales_with_the_wavelength(shot: Shot) -> None:
    """In focus the peak is A p^2 / (lambda d)^2: exactly as 1 / lambda^2 between the two ends."""
    low, high = (float(shot.scene.wavelengths[index]) for index in (0, -1))
    peaks = psf(shot, of=without_doe(shot), wavelengths=(low, high), integrate=False)[0, :, 7, 7]
    ratio = float(peaks[0] / peaks[1]) / (high / low) ** 2
    print(f"peaks: {ratio - 1:.1e} from 1 / lambda^2")
    assert abs(ratio - 1) <= 1e-4  # residual focus of float32's sensor distance, at the shortest wavelength


def equal_wavelengths_equal_psfs(shot: Shot) -> None:
    """And so do permuted ones, up to the order in which a batch is summed."""
    a, b = 450 * nm, 600 * nm
    bound = shot.bound(1e-6, 1e-14)
    found = psf(shot, wavelengths=(b, a, b, a, b))[0]
    for index, like_it in ((2, 0), (4, 0), (3, 1)):
        same(found[index], found[like_it], bound)
    same(found[:2], psf(shot, wavelengths=(a, b))[0].flip(0), bound)


def is_an_integral(shot: Shot) -> None:
    """301 bands and every tenth of them sum the same smooth spectrum, which is 0 at its ends."""
    some = slice(0, None, 10)
    bands = shot.scene.coefficients[:, some]
    few = cube(bands, shot.scene.wavelengths[some], depth=2.0)
    same(raw(shot, few), raw(shot, shot.scene), 5e-3)  # the PSF changes from band to band


def is_the_band(shot: Shot) -> None:
    """One band is a picture in one light: every channel is the same picture, times its own response."""
    with torch.no_grad():
        image = shot.camera[:2](shot.scene)
        factors = shot.camera[1].contraction(shot.scene.wavelengths).to(image)[:, 0]
        mono = shot.camera[:1](shot.scene)
    same(image, factors[:, None, None] * mono, shot.bound(1e-6, 1e-14))


# ---- light -------------------------------------------------------------------------------------------------------


def empty_picture(shot: Shot) -> None:
    assert shot.picture.shape == (0, 3, 24, 24)
    assert all(signal.shape[0] == 0 for signal in shot.signals.values())
    assert all(float(gradient.abs().sum()) == 0 for gradient in shot.gradients.values())


def is_black(shot: Shot) -> None:
    """No light and no read noise: exactly the black level, and exactly black."""
    assert (shot.signals["5 ADC"] == torch.tensor(64 / 4095, dtype=shot.dtype)).all()
    assert float(shot.picture.abs().max()) == 0


def one_photon_scene() -> Scene:
    bands = torch.zeros(1, 5, 24, 24)
    bands[..., 12, 12] = 1.0
    return cube(bands, FEW, depth=2.0)


def one_photon_camera() -> Camera:
    """Full well, exposure and all: scaled so that the raw holds one electron in the mean."""
    of = camera(sigma=0.0, bits=24, full_well=1000)
    with torch.no_grad():
        electrons = float(of[:4].noiseless()(one_photon_scene()).double().sum()) * 1000
    return camera(sigma=0.0, bits=24, full_well=1000, exposure=sensor.Exposure(0.8 / electrons))


def counts_single_electrons(shot: Shot) -> None:
    """Whole electrons, one in the mean: of 2000 frames within 4 standard errors, 4 / sqrt(2000)."""
    frames = 2000
    with torch.no_grad():
        signal = shot.camera[:4](shot.scene)
        counts = shot.camera[4](signal.expand(frames, -1, -1, -1), generator=shot.generator()) * 1000
    assert relative(counts, counts.round()) <= shot.bound(1e-6, 1e-14)
    mean = float(counts.double().sum()) / frames
    print(f"electrons a frame: {mean:.3f}")
    assert abs(float(signal.double().sum()) * 1000 - 1) <= 1e-5
    assert abs(mean - 1) <= 4 / math.sqrt(frames)


def is_full(shot: Shot) -> None:
    """Every pixel at the top of its scale, white, and a gradient that still says how to get darker."""
    assert (shot.raw == 1).all()
    assert (shot.signals["5 ADC"] == 1).all()
    assert float(shot.gradients["scene"].max()) > 0


def spread_of_1e8() -> Scene:
    bands = 1e-4 * (0.5 + random(1, 5, 24, 24))
    bands[..., 4, 4] = 1e4
    return cube(bands, FEW, depth=2.0)


def keeps_the_dark_pixels(shot: Shot) -> None:
    """Beyond the PSF's window nothing of the bright pixel arrives but the FFT's rounding, 1e-7 of it."""
    with torch.no_grad():
        image = shot.camera[:1](shot.scene)
        dark = shot.scene.bands().clone()
        dark[..., 4, 4] = 1e-4
        alone = shot.camera[:1](cube(dark, FEW, depth=2.0))
    difference = float((image - alone)[..., 13:, 13:].abs().max())
    print(f"left of a pixel of 1e4 outside its PSF: {difference:.1e}")
    assert difference <= 1e4 * shot.bound(1e-7, 1e-16)


# ---- depth -------------------------------------------------------------------------------------------------------


def is_the_same_sum(one: Tensor, other: Tensor) -> None:
    """To a few ulps: a processor may sum what lies otherwise in memory in another order."""
    ulps = 8 * torch.finfo(one.dtype).eps
    torch.testing.assert_close(one, other, rtol=ulps, atol=ulps)


def depth_map(value: Callable[[], Tensor]) -> Callable[[], Scene]:
    return lambda: photo(depth=value())


def is_its_number(shot: Shot) -> None:
    number = shot.scene.with_depth(float(shot.scene.depth.detach().flatten()[0]))
    is_the_same_sum(raw(shot, shot.scene), raw(shot, number))


def inf_is_1e12(shot: Shot) -> None:
    far = shot.scene.depth.detach()
    same(raw(shot, shot.scene), raw(shot, shot.scene.with_depth(far.clamp(max=1e12))), shot.bound(1e-6, 1e-9))


def wall_stays_even(bound: float) -> Callable[[Shot], None]:
    """An even wall shows no seam between layers, but that each one's window catches another share of its light."""

    def limit(shot: Shot) -> None:
        height, width = shot.scene.shape[1:]
        with torch.no_grad():
            wall = shot.camera[:2](like(shot, even(height, width)).with_depth(shot.scene.depth.detach()))
        mean = wall.mean((-2, -1), keepdim=True)
        error = float(((wall - mean) / mean).abs().max())
        print(f"even wall: {error:.1e}")
        assert error <= bound

    return limit


# ---- sensor ------------------------------------------------------------------------------------------------------


def stops_at_the_well(shot: Shot) -> None:
    """White fills the well in green: half of the counts are below it, the other half stop there, at whole electrons."""
    counted = shot.signals["3 ShotNoise"]
    assert float(counted.max()) == 1
    assert relative(counted * 100, (counted * 100).round()) <= shot.bound(1e-6, 1e-14)
    for share in ((counted == 1).double().mean(), (counted < 1).double().mean()):
        assert float(share) > 0.1


def read_noise_is_nothing(shot: Shot) -> None:
    """sigma 0 adds exactly nothing; its gradient is e / full_well, finite."""
    assert torch.equal(shot.signals["4 ReadNoise"], shot.signals["3 ShotNoise"])
    assert float(shot.noisy_gradients["stages.5.sigma_electrons"].abs()) > 0


def has_two_values(shot: Shot) -> None:
    values = shot.signals["5 ADC"].unique()
    assert values.tolist() == [0, 1]


def has_24_bits(shot: Shot) -> None:
    steps = shot.signals["5 ADC"].double() * (2**24 - 1)
    assert float((steps - steps.round()).abs().max()) <= shot.bound(1, 1e-6)  # float32 holds 24 bits, no fractions
    same(shot.signals["5 ADC"], shot.signals["4 ReadNoise"].clamp(0, 1), 1e-6)


def expectation_has_slope_1(shot: Shot) -> None:
    """At no light N = 0 and dN / d lambda = 1: the gradient of the noisy raw is that of the expected one, exactly."""
    gradients = []
    for of in (shot.camera, shot.camera.noiseless()):
        scene = Scene(
            shot.scene.coefficients.detach().clone().requires_grad_(), shot.scene.spectra,
            wavelengths=shot.scene.wavelengths, depth=shot.scene.depth,
        )  # fmt: skip
        signal = of[:5](scene, generator=shot.generator())
        gradients.append(torch.autograd.grad(signal.sum(), scene.coefficients)[0])
    assert torch.equal(*gradients)
    assert float(gradients[0].abs().min()) > 0


# ---- inputs ------------------------------------------------------------------------------------------------------


def turned() -> Scene:
    """A picture stored columns first."""
    stored = photo().coefficients.transpose(-2, -1).contiguous().transpose(-2, -1)
    assert not stored.is_contiguous()
    return Scene(stored, photo().spectra, wavelengths=FEW)


def repeated() -> Scene:
    """One picture that stands for a batch of three, and one row that stands for all."""
    stored = photo(1, 24).coefficients.expand(3, -1, 24, -1)
    return Scene(stored, photo().spectra, wavelengths=FEW)


def is_its_copy(shot: Shot) -> None:
    copied = Scene(
        shot.scene.coefficients.detach().clone(memory_format=torch.contiguous_format), shot.scene.spectra,
        wavelengths=shot.scene.wavelengths,
    )  # fmt: skip
    assert copied.coefficients.is_contiguous()
    is_the_same_sum(raw(shot, shot.scene), raw(shot, copied))


def is_its_dtype(shot: Shot) -> None:
    """Computed in float32 inside the stages, handed on in its own dtype: each stage rounds by half an ulp."""
    dtype = shot.scene.dtype
    assert shot.picture.dtype == shot.raw.dtype == dtype
    single = shot.scene.to(dtype=torch.float32)
    with torch.no_grad():
        truth = shot.exact(single)
    same(shot.picture, truth, 4 * torch.finfo(dtype).eps)


# ---- what happens between two calls ------------------------------------------------------------------------------


def is_unchanged_by(
    context: Callable[[], contextlib.AbstractContextManager], *, backward: bool = True
) -> Callable[[Shot], None]:
    """The same picture, PSF and gradients within a context, bit for bit.

    Under autocast torch asks that only the forward pass runs: backward=False.
    """

    def limit(shot: Shot) -> None:
        def run(context: Callable[[], contextlib.AbstractContextManager]) -> tuple[Tensor, ...]:
            of = copy.deepcopy(shot.exact)
            scene = Scene(
                shot.scene.coefficients.detach().clone().requires_grad_(), shot.scene.spectra,
                wavelengths=shot.scene.wavelengths,
            )  # fmt: skip
            with context():
                picture = of(scene)
                if backward:
                    picture.square().mean().backward()
                with torch.no_grad():
                    bare = of[0].lens.psf([WAVELENGTH], distances=1.0, pixel_pitch=PITCH, shape=(15, 15))
                    staged = of[1:](scene)
            if not backward:
                picture.square().mean().backward()
            phase = of[0].lens.elements[2].phase.grad
            return picture.detach(), phase, scene.coefficients.grad, bare, staged

        for value, truth in zip(run(context), run(contextlib.nullcontext), strict=True):
            assert value.dtype == truth.dtype
            assert torch.equal(value, truth)

    return limit


@contextlib.contextmanager
def matmul_precision_high():
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        yield
        assert torch.get_float32_matmul_precision() == "high"
    finally:
        torch.set_float32_matmul_precision(before)


@contextlib.contextmanager
def anomaly_detection():
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Anomaly Detection has been enabled")
        with torch.autograd.detect_anomaly(check_nan=True):
            yield


@contextlib.contextmanager
def autocast_on():
    with torch.autocast("cpu", dtype=torch.bfloat16), torch.autocast("cuda", enabled=torch.cuda.is_available()):
        yield


def repeats(shot: Shot) -> None:
    """The same seed, the same frame; another seed, another."""
    with torch.no_grad():
        one, two = (shot.camera(shot.scene, generator=shot.generator()) for _ in range(2))
        other = shot.camera(shot.scene, generator=shot.generator().manual_seed(1))
    assert torch.equal(one, two)
    assert not torch.equal(one, other)


def fresh(of: Camera) -> Camera:
    """A camera with the same parameters that has computed nothing yet."""
    other = camera()
    other.to(next(of.parameters()).device, next(of.parameters()).dtype).load_state_dict(of.state_dict())
    return other


def shoot(of: Camera, scene: Scene) -> Tensor:
    with torch.no_grad():
        return of.noiseless()(scene)


def move(of: Camera) -> None:
    """A step of training, by hand."""
    with torch.no_grad():
        for parameter in of.parameters():
            parameter.mul_(1 + 1e-3 * torch.linspace(-1, 1, parameter.numel()).to(parameter).view_as(parameter))


def trains_again(shot: Shot) -> None:
    """Evaluated in between,
    the camera keeps transfer functions; neither the next step nor the next look may see them."""
    of, scene = copy.deepcopy(shot.camera), shot.scene
    optimiser = torch.optim.SGD(of.parameters(), lr=1e-6)
    for _ in range(2):
        optimiser.zero_grad()
        quiet = of.noiseless()
        quiet(scene).square().mean().backward()
        fresh_copy = fresh(of)
        fresh_copy.noiseless()(scene).square().mean().backward()
        for parameter, truth in zip(of.parameters(), fresh_copy.parameters(), strict=True):
            assert torch.equal(parameter.grad, truth.grad)
        optimiser.step()
        move(of)
        assert torch.equal(shoot(of, scene), shoot(fresh(of), scene))
        assert torch.equal(shoot(of, scene), shoot(fresh(of), scene))  # now from what was kept


def is_not_stale_after(change: Callable[[Camera], Camera]) -> Callable[[Shot], None]:
    """Shoot (twice, so that everything is kept), change, move the parameters, shoot: as a camera that knows no past."""

    def limit(shot: Shot) -> None:
        of, scene = copy.deepcopy(shot.camera), shot.scene
        before = shoot(of, scene)
        assert torch.equal(shoot(of, scene), before)
        other = change(of)
        scene = scene.to(dtype=next(other.parameters()).dtype)
        after = shoot(other, scene)
        assert torch.equal(after, shoot(fresh(other), scene))
        move(other)
        moved = shoot(other, scene)
        assert torch.equal(moved, shoot(fresh(other), scene))
        assert relative(moved, after) > 1e-5
        if other is not of:
            assert torch.equal(shoot(of, shot.scene), before)

    return limit


def pickled(of: Camera) -> Camera:
    return pickle.loads(pickle.dumps(of))


def saved(of: Camera) -> Camera:
    file = io.BytesIO()
    torch.save(of, file)
    file.seek(0)
    return torch.load(file, weights_only=False)


def loaded(of: Camera) -> Camera:
    other = camera()
    move(other)
    of.load_state_dict(other.state_dict())
    return of


def in_the_other_dtype(of: Camera) -> Camera:
    return of.to(torch.float64 if next(of.parameters()).dtype == SINGLE else torch.float32)


# ---- the table ---------------------------------------------------------------------------------------------------

defocus_of_100_waves = 2 * 100 * WAVELENGTH / (DIAMETER / 2) ** 2
out_of_range = "is outside f/{:g}..f/{:g}".format(*TESTED_F_NUMBERS)
dark = (
    "most pixels hold less light than float32's FFTs round off the brightest one, 1e-7 of it; there the square root of "
    "the demosaic and the slope of the tone curve amplify it, and the clip at 0 falls on either side"
)
one_light = "in one light the white balance undoes the filters: their gradient is the rounding of a sum that cancels"
sizes = {
    "image of 1x1": (1, 1),
    "image of 1xN": (1, 24),
    "image of odd size": (25, 15),
    "image of prime size": (31, 37),
    "very wide image": (3, 1024),
}

CASES: tuple[Case, ...] = (
    case("exact_focus_flat_doe", "exact focus with a flat DOE",
         lambda: camera(lens(doe(torch.zeros(9, 9)), focus=INFINITY)), lambda: photo(depth=INFINITY), limit=is_airy),
    case("exact_focus_bare_lens", "exact focus with a flat DOE",
         lambda: camera(lens(focus=INFINITY)), lambda: photo(depth=INFINITY), limit=is_airy),
    case("object_at_infinity", "object at infinity", camera, lambda: photo(depth=INFINITY),
         limit=infinity_is_a_map_of_infinity),
    case("approach_to_infinity", "approach to infinity", lambda: camera(lens(doe(), focus=INFINITY)),
         lambda: photo(depth=INFINITY), limit=approaches_infinity),
    case("approach_to_infinity_bare_lens", "approach to infinity", lambda: camera(lens(focus=INFINITY)),
         lambda: photo(depth=INFINITY), limit=approaches_infinity),
    case("object_at_5_cm_in_focus", "object at 5 cm", lambda: camera(lens(singlet=True, focus=0.05)),
         lambda: photo(depth=0.05), limit=is_reference(1e-5)),
    case("object_at_5_cm_out_of_focus", "object at 5 cm", lambda: camera(lens(singlet=True)),
         lambda: photo(depth=0.05), limit=is_reference(1e-5)),
    case("object_at_5_cm_with_doe", "object at 5 cm", lambda: camera(lens(doe(), singlet=True, focus=0.05)),
         lambda: photo(depth=0.05), limit=is_direct_sum),
    case("defocus_of_100_waves", "100 waves of defocus",
         lambda: camera(lens(optics.Defocus(trained(defocus_of_100_waves))), pitch=50 * um),
         lambda: photo(depth=2.0), limit=is_lommel(100, 1e-6)),
    case("pinhole_under_one_pupil_sample", "pinhole under one pupil sample",
         lambda: camera(lens(diameter=5 * um)), photo, limit=is_a_pinhole, warns=out_of_range),
    case("pinhole_within_one_doe_pixel", "pinhole under one pupil sample",
         lambda: camera(lens(doe(pitch=20 * um), diameter=5 * um)), photo,
         limit=sees_one_doe_pixel, warns=out_of_range),
    case("fastest_ideal_lens", "f-number at the ends of the tested range",
         lambda: camera(lens(focal=PHONE, diameter=PHONE / 1.8), pitch=1 * um), photo,
         limit=is_rayleigh_sommerfeld(1e-2)),
    case("fastest_singlet", "f-number at the ends of the tested range",
         lambda: camera(lens(focal=PHONE, diameter=PHONE / 1.8, singlet=True), pitch=1 * um), photo,
         limit=is_rayleigh_sommerfeld(1e-2)),
    case("slowest_lens", "f-number at the ends of the tested range",
         lambda: camera(lens(focal=PHONE, diameter=PHONE / 99), pitch=30 * um), photo,
         limit=is_rayleigh_sommerfeld(1e-2)),
    case("lens_at_r_to_R", "lens at r -> R",
         lambda: camera(lens(focal=0.1 * mm, diameter=0.99 * 2 * 0.05185 * mm, singlet=True), pitch=0.5 * um), photo,
         limit=converges_at_the_rim, warns=out_of_range),
    case("lens_at_r_to_R_of_millimetres", "lens at r -> R",  # too steep for a grid: the Hankel form must be chosen
         lambda: camera(fixed_singlet(focal=4 * mm, share=0.96), psf_shape=(3, 3)),
         lambda: photo(8, 8, wavelengths=torch.tensor([WAVELENGTH])), limit=keeps_its_energy,
         gradients=1e-2, reason=one_light, warns=out_of_range),
    case("psf_far_smaller_than_a_pixel", "PSF far smaller than a pixel",
         lambda: camera(lens(diameter=4 * mm), pitch=40 * um, psf_shape=None),
         lambda: photo(wavelengths=torch.tensor([WAVELENGTH])), limit=is_one_pixel, gradients=1e-2, reason=one_light),
    case("psf_larger_than_the_window", "PSF larger than the window", lambda: camera(lens(singlet=True)),
         lambda: photo(depth=0.3), limit=is_a_crop),
    case("psf_larger_than_the_window_with_doe", "PSF larger than the window", lambda: camera(lens(doe(), singlet=True)),
         lambda: photo(depth=0.3), limit=is_a_crop),
    case("psf_larger_than_the_image", "PSF larger than the image",
         lambda: camera(lens(singlet=True), psf_shape=(61, 61)), lambda: photo(7, 9, depth=0.5), limit=stays_even),
    case("psf_larger_than_the_image_by_default", "PSF larger than the image",
         lambda: camera(psf_shape=None), lambda: photo(7, 9, depth=0.2), limit=window_is_the_picture),
    case("doe_height_0", "DOE height 0", lambda: camera(lens(doe(torch.zeros(9, 9)))), lambda: photo(depth=1.5),
         limit=flat_doe_trains),
    case("doe_height_1000_waves", "DOE height 1000 waves",
         lambda: camera(lens(doe(torch.full((9, 9), 2000 * math.pi)))), lambda: photo(depth=1.5),
         limit=doe_does_nothing),
    case("smooth_path_of_1000_waves", "DOE height 1000 waves",
         lambda: camera(lens(optics.RadialDOE(nn.Parameter(2000 * math.pi * torch.linspace(0, 1, 1001) ** 2))),
                        exposure=sensor.Exposure(time=3600.0)),  # a millionth of the light falls into the window
         # the cubic through 1001 radii ends in a straight line: 1e-3 rad at the rim
         photo, limit=is_lommel(1000, 2e-3)),
    case("doe_white_noise_30_rad", "DOE white noise of 30 radians",
         lambda: camera(lens(doe(30 * torch.randn(32, 32, generator=torch.Generator().manual_seed(2))))), photo,
         limit=wraps(1e-5)),
    case("doe_wrapped_and_unwrapped", "DOE wrapped and unwrapped",
         lambda: camera(lens(doe(20 * math.pi * torch.linspace(-1, 1, 41).square() * torch.ones(41, 41)))), photo,
         limit=wraps(1e-5)),
    case("doe_unwrapped_by_1000_waves", "DOE wrapped and unwrapped",
         lambda: camera(lens(doe(6 * random(9, 9) + 2 * math.pi * (1000 * random(9, 9, seed=5)).round()))), photo,
         limit=wraps(2e-3), values=1e-4, gradients=1e-2,
         reason="float32 rounds 6283 radians, and their product with the dispersion factor, by up to 5e-4 radians"),
    case("wavelengths_at_both_ends_of_the_visible", "wavelengths at both ends",
         lambda: camera(lens(doe())), lambda: photo(wavelengths=torch.tensor([420e-9, 720e-9], dtype=torch.float64)),
         limit=scales_with_the_wavelength),
    case("wavelengths_at_both_ends_of_the_range", "wavelengths at both ends",
         lambda: camera(lens(doe(glass=1.5))),
         lambda: cube(random(1, 2, 24, 24), torch.tensor([1e-7, 2e-5], dtype=torch.float64), depth=2.0),
         limit=scales_with_the_wavelength),
    case("equal_wavelengths_of_psfs", "equal wavelengths", camera, photo, limit=equal_wavelengths_equal_psfs),
    case("cube_with_1_band", "cube with 1 band", camera,
         lambda: cube(random(1, 1, 24, 24), torch.tensor([550e-9], dtype=torch.float64), depth=2.0), limit=is_the_band,
         gradients=1e-2, reason=one_light),
    case("cube_with_301_bands", "cube with 301 bands", lambda: camera(fixed_lens(), psf_shape=(5, 5)),
         lambda: cube(random(1, 1, 12, 12) * torch.linspace(0, math.pi, 301).sin().square().clamp(min=0)[:, None, None],
                      torch.linspace(420, 720, 301, dtype=torch.float64) * nm, depth=2.0), limit=is_an_integral,
         slow=True),
    *(case(item.replace(" ", "_"), item, camera, functools.partial(photo, *size), limit=stays_even)
      for item, size in sizes.items()),
    case("image_of_Nx1", "image of 1xN", camera, lambda: photo(24, 1), limit=stays_even),
    case("empty_batch", "empty batch", camera, lambda: photo(batch=0), limit=empty_picture),
    case("empty_batch_with_depth", "empty batch", camera, lambda: photo(batch=0, depth=torch.ones(0, 1, 24, 24)),
         limit=empty_picture),
    case("black_scene", "black scene", lambda: camera(sigma=0.0, black_level=64), lambda: even(level=0.0),
         limit=is_black),
    case("one_photon", "one photon", one_photon_camera, one_photon_scene, limit=counts_single_electrons,
         values=2e-4, gradients=5e-2, reason=dark),
    case("saturated_scene", "saturated scene", lambda: camera(sigma=0.0),
         lambda: cube(1e4 * torch.ones(1, 5, 24, 24), FEW, depth=2.0), limit=is_full),
    case("dynamic_range_1e8", "dynamic range 1e8", camera, spread_of_1e8, limit=keeps_the_dark_pixels,
         values=1e-3, gradients=1e-2, reason=dark),
    case("depth_map_with_one_value", "depth map with one value", camera, depth_map(lambda: torch.full((24, 24), 1.7)),
         limit=is_its_number),
    case("depth_map_with_inf", "depth map with inf", camera,
         depth_map(lambda: torch.where(torch.arange(24) < 12, 3.0, INFINITY).expand(24, 24)), limit=inf_is_1e12),
    case("depth_map_with_a_step_edge", "depth map with a step edge", lambda: camera(lens(singlet=True),
         psf_shape=(41, 41)),
         depth_map(lambda: torch.where(torch.arange(24) < 12, 1.0, 4.0).expand(24, 24)), limit=wall_stays_even(0.02)),
    case("depth_map_with_all_layers_different", "depth map with all layers different",
         lambda: camera(lens(singlet=True), psf_shape=(41, 41)),
         depth_map(lambda: 1 / torch.linspace(0.05, 1.5, 576).view(24, 24)), limit=wall_stays_even(0.02)),
    case("full_well_reached", "full well reached", lambda: camera(lens(), full_well=100, exposure=sensor.Exposure(1.0)),
         lambda: even(level=1.0), limit=stops_at_the_well),
    case("sigma_0", "sigma 0", lambda: camera(sigma=trained(0.0)), photo, limit=read_noise_is_nothing),
    case("bits_1", "1 bit", lambda: camera(lens(), bits=1, exposure=sensor.Exposure(1.0)), half_white,
         limit=has_two_values),
    case("bits_24", "24 bits", lambda: camera(bits=24), photo, limit=has_24_bits),
    case("gradient_through_poisson_at_0", "gradient through Poisson at 0", camera, lambda: even(level=0.0),
         limit=expectation_has_slope_1),
    case("non_contiguous_input", "non-contiguous input", camera, turned, limit=is_its_copy),
    case("expanded_input", "expanded input", camera, repeated, limit=is_its_copy),
    case("float16_input", "half-precision input", camera, lambda: photo().to(dtype=torch.float16), limit=is_its_dtype),
    case("bfloat16_input", "half-precision input", camera, lambda: photo().to(dtype=torch.bfloat16),
         limit=is_its_dtype),
    case("autocast", "autocast", camera, photo, limit=is_unchanged_by(autocast_on, backward=False)),
    case("deterministic_repeat", "deterministic repeat", camera, photo, limit=repeats),
    case("train_evaluate_train", "train, evaluate, train again", camera, photo, limit=trains_again),
    case("deepcopy_between_calls", "deepcopy between two calls", camera, photo,
         limit=is_not_stale_after(copy.deepcopy)),
    case("pickle_between_calls", "pickle between two calls", camera, photo, limit=is_not_stale_after(pickled)),
    case("torch_save_between_calls", "pickle between two calls", camera, photo, limit=is_not_stale_after(saved)),
    case("load_state_dict_between_calls", "load_state_dict between two calls", camera, photo,
         limit=is_not_stale_after(loaded)),
    case("to_another_dtype_between_calls", ".to() between two calls", camera, photo,
         limit=is_not_stale_after(in_the_other_dtype)),
    case("matmul_precision_high", "float32 matmul precision high", camera, photo,
         limit=is_unchanged_by(matmul_precision_high)),
    case("anomaly_detection", "anomaly detection", camera, photo,
         limit=is_unchanged_by(anomaly_detection)),
)  # fmt: skip


def after_training(name: str, value: float) -> Callable[[], Tensor]:
    """A parameter that an optimiser has lost, found at the next call."""

    def attempt() -> Tensor:
        of = camera()
        with torch.no_grad():
            of.get_parameter(f"stages.0.lens.{name}").flatten()[0] = value
        return of(photo())

    return attempt


def rim_of_metres() -> Tensor:
    """A singlet of 0.4 m at f/1: its rim sends rays to 2 m beside the sensor, which no quadrature follows."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of its f-number
        of = optics.Lens(optics.CircularAperture(0.398), optics.PlanoConvexLens(0.2), focus_distance=INFINITY)
        return of.psf([WAVELENGTH], distances=INFINITY, pixel_pitch=PITCH, shape=(15, 15))


def spoilt(value: float) -> Callable[[], Scene]:
    def attempt() -> Scene:
        bands = random(1, 5, 24, 24)
        bands[0, 2, 3, 4] = value
        return cube(bands, FEW)

    return attempt


def map_with(value: float) -> Tensor:
    depth = torch.ones(24, 24)
    depth[3, 4] = value
    return depth


BAD_CASES: tuple[BadCase, ...] = (
    BadCase("doe_height_nan", "DOE height NaN", lambda: doe(torch.full((3, 3), math.nan)), ValueError,
            "9 values that are NaN", "expected finite", "nan_to_num"),
    BadCase("doe_height_nan_after_a_step", "DOE height NaN", after_training("elements.2.phase", math.nan), ValueError,
            "elements.2.phase of the lens has 1 values that are NaN", "expected finite", "smaller step"),
    BadCase("curvature_nan_after_a_step", "DOE height NaN", after_training("elements.1.radius_of_curvature", math.nan),
            ValueError, "radius_of_curvature of the lens has 1 values", "expected finite", "smaller step"),
    BadCase("sensor_behind_the_lens_after_a_step",
            "lens at r -> R", after_training("sensor_distance", -0.02), ValueError,
            "got -0.02", "finite and > 0 m", "sensor_distance"),
    BadCase("lens_at_r_equal_R", "lens at r -> R",
            lambda: lens(focal=1 * mm, diameter=1.1 * mm, singlet=True), ValueError,
            "r = 0.00055", "r >= R", "Use an aperture below 0.001037 m across"),
    BadCase("lens_at_r_to_R_of_metres", "lens at r -> R", rim_of_metres, ValueError, "rings of the pupil",
            "more than 1048576", "Use a smaller aperture"),
    BadCase("curvature_below_the_aperture_after_a_step", "lens at r -> R",
            after_training("elements.1.radius_of_curvature", 0.9e-3), ValueError, "r = 0.001", "r >= R",
            "Use an aperture below"),
    BadCase("wavelength_beyond_the_end", "wavelengths at both ends",
            lambda: photo(wavelengths=torch.tensor([550.0])),
            ValueError, "wavelength 550", "1e-07..2e-05 m", "550 * nm"),
    BadCase("equal_wavelengths_in_a_scene", "equal wavelengths",
            lambda: photo(wavelengths=torch.tensor([5e-7, 6e-7, 5e-7])), ValueError, "wavelength 500 nm occurs more",
            "expected distinct bands", "Average them first"),
    BadCase("negative_radiance", "negative radiance", spoilt(-0.1), ValueError, "goes down to -0.1", "not negative",
            ".clamp(min=0)"),
    BadCase("nan_radiance", "NaN radiance", spoilt(math.nan), ValueError, "nan", "expected finite", "Remove NaN"),
    BadCase("infinite_radiance", "NaN radiance", spoilt(math.inf),
            ValueError, "inf", "expected finite", "Remove NaN and inf"),
    BadCase("depth_0", "depth 0", lambda: photo(depth=0.0),
            ValueError, "depth 0 ", "expected metres > 0", "float('inf')"),
    BadCase("depth_map_with_0", "depth 0", lambda: photo(depth=map_with(0.0)), ValueError, "depth 0 ",
            "expected metres > 0", "float('inf')"),
    BadCase("depth_map_with_nan", "depth 0", lambda: photo(depth=map_with(math.nan)), ValueError, "depth nan ",
            "expected metres > 0", "float('inf')"),
    BadCase("depth_map_behind_the_lens", "depth 0", lambda: photo(depth=map_with(-1.0)), ValueError, "depth -1 ",
            "expected metres > 0", "float('inf')"),
    BadCase("bits_0", "1 bit", lambda: sensor.ADC(0), ValueError, "bits 0", "1..24", "float32 holds"),
    BadCase("bits_25", "24 bits", lambda: sensor.ADC(25), ValueError, "bits 25", "1..24", "float32 holds"),
    BadCase("sigma_below_0", "sigma 0", lambda: sensor.ReadNoise(-1.0), ValueError, "got -1", "finite and >= 0",
            "sigma_electrons"),
    BadCase("full_well_0", "full well reached", lambda: sensor.ShotNoise(0.0), ValueError, "got 0", "> 0 electrons",
            "full_well"),
)  # fmt: skip

NAMES: tuple[str, ...] = tuple(row.name for row in (*CASES, *BAD_CASES))
"""Every hard case by name, in the order of the table."""
