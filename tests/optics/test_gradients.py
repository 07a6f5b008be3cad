"""Gradients: against finite differences in float64, and of a fine pixel map against the native grid.

`samples=` is frozen wherever a parameter is differenced: the default sampling follows the lens, and steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn
from torch.autograd import gradcheck

from kcam import optics
from kcam.scene import Scene
from kcam.sensor import ColourFilter
from kcam.units import mm, nm, um

DIAMETER, FOCAL = 1.5 * mm, 30 * mm
WAVELENGTHS = [500 * nm, 600 * nm]
GRIDS = ["matrix", "chirp_z", "fft"]
ALL = [*GRIDS, "radial"]
PROPAGATORS = ["fresnel", "nonparaxial"]


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64, requires_grad=True)


def noise(*shape: int, scale: float = 1.0, seed: int = 0) -> Tensor:
    return scale * torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


class Given:
    """Elements whose constructor argument is a plain tensor with a history: what gradcheck hands over."""

    @staticmethod
    def put(module: nn.Module, **values: Tensor) -> nn.Module:
        for name, value in values.items():
            for registry in (module._parameters, module._buffers):
                registry.pop(name, None)
            object.__setattr__(module, name, value)
        return module


def aperture(diameter: float | Tensor = DIAMETER) -> optics.Element:
    if isinstance(diameter, Tensor):
        return Given.put(optics.CircularAperture(DIAMETER), diameter=diameter)
    return optics.CircularAperture(diameter)


def psf(
    *elements: optics.Element, propagator: str, method: str, sensor_distance: float | Tensor = FOCAL,
    distances: tuple[float, ...] = (1.2,), integrate: bool = True,
) -> Tensor:  # fmt: skip
    """A 7 x 5 window of 9 um pixels at two wavelengths, scaled so that gradients are of order 1."""
    lens = optics.Lens(*elements, sensor_distance=FOCAL)
    if isinstance(sensor_distance, Tensor):
        Given.put(lens, sensor_distance=sensor_distance)
    return 10 * lens.psf(
        WAVELENGTHS, distances=list(distances), pixel_pitch=9 * um, shape=(7, 5), propagator=propagator, method=method,
        samples=None if method == "radial" else 96, integrate=integrate, dtype=torch.float64,
    )  # fmt: skip


LENS = optics.ThinLens(FOCAL)


def check(function: Callable[..., Tensor], *at: Tensor, scale: float = 1.0, atol: float = 1e-6) -> None:
    """gradcheck of `function` over variables in units of `scale`, so that one step fits all.

    Fast mode projects the Jacobian on random directions: every entry takes part, at the cost of two evaluations.
    """
    at = tuple((value.detach() / scale).requires_grad_() for value in at)
    # central differences at 1e-6: truncation 1e-12 times third derivatives of order 1e3, rounding 1e-16 / 1e-6
    torch.manual_seed(0)
    assert gradcheck(lambda *x: function(*(v * scale for v in x)), at, eps=1e-6, atol=atol, rtol=1e-5, fast_mode=True)


@pytest.mark.parametrize("propagator", PROPAGATORS)
@pytest.mark.parametrize("method", GRIDS)
def test_doe_phase(method: str, propagator: str) -> None:
    def function(phase: Tensor) -> Tensor:
        doe = Given.put(optics.DOE(torch.zeros_like(phase)), phase=phase)
        return psf(aperture(), LENS, doe, propagator=propagator, method=method)

    check(function, noise(5, 5))


@pytest.mark.parametrize("propagator", PROPAGATORS)
@pytest.mark.parametrize("method", GRIDS)
def test_zernike_coefficients(method: str, propagator: str) -> None:
    def function(coefficients: Tensor) -> Tensor:
        doe = Given.put(optics.ZernikeDOE(torch.zeros_like(coefficients)), coefficients=coefficients)
        return psf(aperture(), LENS, doe, propagator=propagator, method=method)

    check(function, noise(9))


@pytest.mark.parametrize("propagator", PROPAGATORS)
@pytest.mark.parametrize("method", ["matrix", "radial"])
def test_radial_profile(method: str, propagator: str) -> None:
    def function(profile: Tensor) -> Tensor:
        doe = Given.put(optics.RadialDOE(torch.zeros_like(profile)), profile=profile)
        return psf(aperture(), LENS, doe, propagator=propagator, method=method)

    check(function, noise(8))


SCALARS = {
    "radius_of_curvature": (
        lambda v: {"lens": Given.put(optics.PlanoConvexLens(15 * mm, glass=1.5), radius_of_curvature=v)},
        15.2 * mm,
    ),
    "focal_length": (lambda v: {"lens": Given.put(optics.ThinLens(FOCAL), focal_length=v)}, 30.4 * mm),
    "defocus": (lambda v: {"other": Given.put(optics.Defocus(0.0), added_vergence=v)}, 0.3),
    "sensor_distance": (lambda v: {"sensor_distance": v}, 29.6 * mm),
    "diameter": (lambda v: {"aperture": aperture(v)}, 1.4 * mm),
}


@pytest.mark.parametrize("propagator", PROPAGATORS)
@pytest.mark.parametrize("method", ALL)
@pytest.mark.parametrize("scalar", SCALARS)
def test_scalars(scalar: str, method: str, propagator: str) -> None:
    build, value = SCALARS[scalar]

    def function(given: Tensor) -> Tensor:
        parts = build(given)
        elements = [parts.get("aperture", aperture()), parts.get("lens", LENS)]
        elements += [parts["other"]] if "other" in parts else []
        if method != "radial":  # something that is not symmetric beside it
            elements.append(optics.ZernikeDOE(torch.tensor([0, 0.5, 0.2, 0, 0.7], dtype=torch.float64)))
        distance = parts.get("sensor_distance", FOCAL)
        # two distances, one of them infinite: the vergence may be 0
        return psf(*elements, propagator=propagator, method=method, sensor_distance=distance, distances=(0.9, math.inf))

    # the fft's grid is stretched with the pupil: differences see its sampling error move, the gradient rightly does not
    moves = method == "fft" and scalar in ("diameter", "sensor_distance")
    check(function, torch.tensor(value, dtype=torch.float64), scale=abs(value), atol=2e-3 if moves else 1e-6)


@pytest.mark.parametrize("propagator", PROPAGATORS)
@pytest.mark.parametrize("method", ["matrix", "radial"])
def test_diameter_of_an_annulus(method: str, propagator: str) -> None:
    def function(diameter: Tensor) -> Tensor:
        stop = Given.put(optics.AnnularAperture(DIAMETER, obscuration=0.4), diameter=diameter)
        return psf(stop, LENS, propagator=propagator, method=method)

    check(function, torch.tensor(1.4 * mm, dtype=torch.float64), scale=1.4 * mm)


@pytest.mark.parametrize("propagator", PROPAGATORS)
@pytest.mark.parametrize("method", GRIDS)
def test_transmission_of_a_coded_aperture(method: str, propagator: str) -> None:
    def function(transmission: Tensor) -> Tensor:
        mask = Given.put(optics.ApertureMap(torch.ones(4, 4), width=DIAMETER), transmission=transmission)
        return psf(mask, LENS, optics.Defocus(0.2), propagator=propagator, method=method)

    check(function, torch.rand(4, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.8 + 0.1)


@pytest.mark.parametrize("propagator", PROPAGATORS)
def test_width_of_a_square_aperture_beside_a_doe(propagator: str) -> None:
    doe = optics.DOE(noise(5, 5))

    def function(width: Tensor) -> Tensor:
        stop = Given.put(optics.SquareAperture(DIAMETER), width=width)
        return psf(stop, LENS, doe, propagator=propagator, method="matrix")

    check(function, torch.tensor(1.4 * mm, dtype=torch.float64), scale=1.4 * mm)


def test_a_trainable_aperture_over_a_doe_of_its_own_pitch_is_refused() -> None:
    """The map would have to stay where it is while the aperture grows over it: an error, not a wrong gradient."""
    diameter = nn.Parameter(torch.tensor(1.4 * mm, dtype=torch.float64))
    lens = optics.Lens(
        optics.CircularAperture(diameter), LENS, optics.DOE(noise(5, 5), pitch=0.35 * mm), sensor_distance=FOCAL
    )
    with pytest.raises(ValueError, match="pitch of its own does not follow a trainable aperture.*leave pitch=None"):
        lens.psf([550 * nm], distances=math.inf, pixel_pitch=9 * um, shape=(5, 5))


def test_point_samples_have_gradients_too() -> None:
    def function(coefficients: Tensor) -> Tensor:
        doe = Given.put(optics.ZernikeDOE(torch.zeros_like(coefficients)), coefficients=coefficients)
        return psf(aperture(), LENS, doe, propagator="nonparaxial", method="matrix", integrate=False)

    check(function, noise(5))


def test_several_parameters_at_once() -> None:
    phase, focal, diameter = (
        noise(4, 4),
        torch.tensor(1.01, dtype=torch.float64),
        torch.tensor(0.97, dtype=torch.float64),
    )

    def function(phase: Tensor, focal: Tensor, diameter: Tensor) -> Tensor:
        doe = Given.put(optics.DOE(torch.zeros(4, 4)), phase=phase)
        lens = Given.put(optics.ThinLens(FOCAL), focal_length=focal * FOCAL)
        return psf(aperture(diameter * DIAMETER), lens, doe, propagator="nonparaxial", method="matrix")

    check(function, phase, focal, diameter)


@pytest.mark.parametrize("physics", ["angular_spectrum", "reference"])
def test_the_other_rows(physics: str) -> None:
    """Wrt a map of flat pixels, which their grids do not follow."""

    def function(phase: Tensor) -> Tensor:
        doe = Given.put(optics.DOE(torch.zeros_like(phase)), phase=phase)
        lens = optics.Lens(optics.CircularAperture(0.5 * mm), optics.ThinLens(20 * mm), doe, sensor_distance=20 * mm)
        return 10 * lens.psf(
            [550 * nm], distances=1.0, pixel_pitch=9 * um, shape=(3, 3), propagator=physics, dtype=torch.float64
        )

    check(function, noise(5, 5))


def test_rays() -> None:
    """Each ray is shared bilinearly among its four nearest pixels: differentiable but for kinks of single rays."""
    weight = noise(9, 9, seed=2)

    def function(vergence: Tensor) -> Tensor:
        defocus = Given.put(optics.Defocus(0.0), added_vergence=vergence)
        lens = optics.Lens(optics.CircularAperture(3 * mm), LENS, defocus, sensor_distance=FOCAL)
        image = lens.psf(
            [550 * nm],
            distances=math.inf,
            pixel_pitch=9 * um,
            shape=(9, 9),
            propagator="geometric",
            dtype=torch.float64,
        )
        return (image * weight).sum()

    at = number(0.6)
    (gradient,) = torch.autograd.grad(function(at), at)
    with torch.no_grad():
        difference = (function(at + 1e-5) - function(at - 1e-5)) / 2e-5
    assert float(gradient) == pytest.approx(float(difference), rel=1e-3)


@pytest.mark.parametrize("method", ["matrix", "radial"])
def test_a_lens_trained_by_its_constructor_parameters(method: str) -> None:
    """The same through `nn.Parameter`, as users write it."""
    parameters = {
        "diameter": nn.Parameter(torch.tensor(DIAMETER, dtype=torch.float64)),
        "radius": nn.Parameter(torch.tensor(15 * mm, dtype=torch.float64)),
        "vergence": nn.Parameter(torch.tensor(0.1, dtype=torch.float64)),
        "distance": nn.Parameter(torch.tensor(FOCAL, dtype=torch.float64)),
    }
    lens = optics.Lens(
        optics.CircularAperture(parameters["diameter"]),
        optics.PlanoConvexLens(parameters["radius"], glass=1.5),
        optics.Defocus(parameters["vergence"]),
        sensor_distance=parameters["distance"],
    )
    assert len(list(lens.parameters())) == 4
    weight = torch.linspace(0, 1, 35, dtype=torch.float64).view(7, 5)

    def loss() -> Tensor:
        image = lens.psf(
            WAVELENGTHS, distances=1.0, pixel_pitch=9 * um, shape=(7, 5), method=method, dtype=torch.float64,
            samples=None if method == "radial" else 96,
        )  # fmt: skip
        return (image * weight).sum()

    gradients = torch.autograd.grad(loss(), list(parameters.values()))
    for (name, parameter), gradient in zip(parameters.items(), gradients, strict=True):
        step = 1e-6 * abs(float(parameter.detach()))
        with torch.no_grad():
            parameter += step
            above = loss()
            parameter -= 2 * step
            below = loss()
            parameter += step
        assert float(gradient) == pytest.approx(float((above - below) / (2 * step)), rel=1e-5), name


def test_float32_gradients_are_those_of_float64() -> None:
    gradients = []
    for dtype in (torch.float32, torch.float64):
        phase = nn.Parameter(noise(32, 32).to(dtype))
        lens = optics.Lens(aperture(), LENS, optics.DOE(phase), sensor_distance=FOCAL)
        image = lens.psf(WAVELENGTHS, distances=1.0, pixel_pitch=4 * um, shape=(33, 33), dtype=dtype)
        (gradient,) = torch.autograd.grad(image[..., 10:20, 16:].sum(), phase)
        assert gradient.dtype == dtype
        gradients.append(gradient.double())
    assert (gradients[0] - gradients[1]).norm() < 1e-4 * gradients[1].norm()  # the note: 2.7e-6 .. 2e-5


def test_no_nan_where_nothing_arrives() -> None:
    phase = nn.Parameter(torch.zeros(16, 16, dtype=torch.float64))
    lens = optics.Lens(aperture(), LENS, optics.DOE(phase), sensor_distance=FOCAL)
    image = lens.psf([550 * nm], distances=math.inf, pixel_pitch=4 * um, shape=(65, 65), dtype=torch.float64)
    for loss in (image.sum(), image.square().sum(), (image + 1e-12).log().sum()):
        (gradient,) = torch.autograd.grad(loss, phase, retain_graph=True)
        assert torch.isfinite(gradient).all()


# ---- the pixel map -----------------------------------------------------------------------------------------------


def test_levels_let_the_gradient_of_the_etched_profile_through() -> None:
    weight = noise(9, 9, seed=3)

    def gradient(values: Tensor, levels: int | None) -> Tensor:
        phase = nn.Parameter(values)
        lens = optics.Lens(aperture(), LENS, optics.DOE(phase, levels=levels), sensor_distance=FOCAL)
        image = lens.psf([550 * nm], distances=1.0, pixel_pitch=4 * um, shape=(9, 9), dtype=torch.float64)
        return torch.autograd.grad((image * weight).sum(), phase)[0]

    phase = noise(20, 20, scale=2.0)
    step = 2 * math.pi / 16
    etched = (phase / step).round() * step
    # straight through: d loss / d phase := d loss / d etched, evaluated at the etched profile
    torch.testing.assert_close(gradient(phase, 16), gradient(etched, None), rtol=1e-9, atol=1e-15)
    assert not torch.allclose(gradient(phase, 16), gradient(phase, None), rtol=1e-3)


@pytest.mark.parametrize(
    ("profile", "propagator"),
    [
        ("flat", "nonparaxial"),
        ("noise", "fresnel"),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in [("flat", "fresnel"), ("noise", "nonparaxial")]),
        *(pytest.param("smooth", propagator, marks=pytest.mark.slow) for propagator in PROPAGATORS),
    ],
)
def test_the_gradient_at_every_pixel_of_a_fine_map(profile: str, propagator: str) -> None:
    n = 301
    side = torch.linspace(-1, 1, n, dtype=torch.float64)
    phase = {
        "flat": torch.zeros(n, n, dtype=torch.float64),
        "smooth": 12 * torch.sin(3 * side + 1) * torch.cos(2 * side[:, None]) + 8 * side**2 * side[:, None],
        "noise": 6 * torch.rand(n, n, generator=torch.Generator().manual_seed(0), dtype=torch.float64),
    }[profile]
    weight = torch.rand(33, 33, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def gradient(dtype: torch.dtype, samples: int | None) -> Tensor:
        parameter = nn.Parameter(phase.to(dtype))
        lens = optics.Lens(
            optics.CircularAperture(5 * mm), optics.PlanoConvexLens(25 * mm, glass=1.5),
            optics.DOE(parameter, glass=1.5), focus_distance=2.0,
        )  # fmt: skip
        image = lens.psf(
            [550 * nm], distances=2.0, pixel_pitch=4 * um, shape=(33, 33), propagator=propagator, dtype=dtype,
            samples=samples,
        )[0, 0]  # fmt: skip
        return torch.autograd.grad((image * weight.to(dtype)).sum(), parameter)[0].double()

    ours, native = gradient(torch.float32, None), gradient(torch.float64, 2 * n)  # about 128 samples against 602
    cosine = float((ours * native).sum() / (ours.norm() * native.norm()))
    relative = float((ours - native).norm() / native.norm())
    print(f"DOE gradient {profile} {propagator}: cosine {cosine:.5f}, relative error {relative:.1e}")
    assert cosine >= 0.999  # Done-when and the issue; binning gives 0.64
    assert relative <= 0.01  # of the whole gradient: what is left at the pixels that the rim cuts


# ---- from the scene to the picture -------------------------------------------------------------------------------


@pytest.mark.parametrize("fused", [True, False])
def test_imaging_wrt_scene_and_doe(fused: bool) -> None:
    wavelengths = torch.tensor([450, 550, 650], dtype=torch.float64) * nm
    spectra = torch.rand(2, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    planes = torch.rand(1, 2, 6, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 0.1
    colour_filter = ColourFilter.kodak().double() if fused else None

    def function(planes: Tensor, phase: Tensor) -> Tensor:
        doe = Given.put(optics.DOE(torch.zeros(4, 4)), phase=phase)
        lens = optics.Lens(aperture(), LENS, doe, sensor_distance=FOCAL)
        imaging = optics.Imaging(lens, pixel_pitch=9 * um, psf_shape=(5, 5))
        # gradcheck's steps never change the sampling here: a DOE of 4 x 4 pixels asks for none of its own
        return imaging(Scene(planes, spectra, wavelengths, depth=1.0), colour_filter=colour_filter)

    check(function, planes, noise(4, 4))


def test_imaging_wrt_the_scene_with_depth() -> None:
    wavelengths = torch.tensor([500, 600], dtype=torch.float64) * nm
    depth = torch.tensor([[0.6, 0.6, 2.0], [0.6, 2.0, 2.0], [1.0, 2.0, 2.0]], dtype=torch.float64)[None, None]
    lens = optics.Lens(aperture(), LENS, focus_distance=2.0)
    imaging = optics.Imaging(lens, pixel_pitch=9 * um, psf_shape=(5, 5), layers=3)

    def function(bands: Tensor) -> Tensor:
        return imaging(Scene.from_bands(bands, wavelengths=wavelengths, depth=depth))

    bands = torch.rand(1, 2, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 0.1
    check(function, bands)


def test_split_memory_gives_the_same_gradient() -> None:
    gradients = []
    for max_memory in (2e9, 1e4):
        phase = nn.Parameter(noise(6, 6))
        lens = optics.Lens(aperture(), LENS, optics.DOE(phase), sensor_distance=FOCAL)
        imaging = optics.Imaging(lens, pixel_pitch=9 * um, psf_shape=(9, 9), max_memory=max_memory)
        bands = torch.rand(2, 28, 20, 18, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        picture = imaging(Scene.from_bands(bands, depth=1.0), colour_filter=ColourFilter.kodak().double())
        gradients.append(torch.autograd.grad(picture.square().sum(), phase)[0])
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-9, atol=1e-12)
