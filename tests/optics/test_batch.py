"""One function for a batch of lenses: equal to the lenses one by one, with gradients to every drawn number."""

import pytest
import torch

from kcam import optics
from kcam.optics.propagation import batch
from kcam.units import mm, um

WAVELENGTHS = torch.tensor([450e-9, 650e-9], dtype=torch.float64)
SENSOR = 51 * mm


def test_a_batch_equals_lenses_one_by_one() -> None:
    vergences = torch.tensor([[0.0, 0.4], [-0.3, 0.1], [0.2, 0.0]], dtype=torch.float64)
    radii = torch.tensor([2.5, 1.2, 0.6], dtype=torch.float64) * mm
    coefficients = torch.zeros(3, 8, dtype=torch.float64)
    coefficients[0, 6], coefficients[2, 3] = 60e-9, -40e-9
    batch = optics.batch_psf(
        vergences,
        radii=radii,
        coefficients=coefficients,
        wavelengths=WAVELENGTHS,
        sensor_distance=SENSOR,
        pixel_pitch=4 * um,
        shape=(41, 40),
        dtype=torch.float64,
    )
    assert batch.shape == (3, 2, 2, 41, 40)
    for b in range(3):
        for z in range(2):
            # an ideal lens in focus at infinity, and the drawn defocus on top
            lens = optics.Lens(
                optics.CircularAperture(2 * float(radii[b])),
                optics.ThinLens(SENSOR),
                optics.ZernikeAberration(coefficients[b]),
                optics.Defocus(float(vergences[b, z])),
                sensor_distance=SENSOR,
            )
            alone = lens.psf(
                WAVELENGTHS,
                distances=float("inf"),
                pixel_pitch=4 * um,
                shape=(41, 40),
                propagator="fresnel",
                dtype=torch.float64,
            )[0]
            error = (batch[b, z] - alone).abs().sum() / alone.sum()
            assert error < 1e-4  # two samplings of the same pupil, each good to 5e-5


def weighted(
    vergence: torch.Tensor, radius: torch.Tensor, distance: torch.Tensor, coefficients: torch.Tensor | None = None
) -> torch.Tensor:
    """One number of a bank, which every drawn number changes [1/m, mm, mm, 100 nm]."""
    psf = optics.batch_psf(
        vergence,
        radii=radius * mm,
        coefficients=None if coefficients is None else coefficients * 1e-7,
        wavelengths=[550e-9],
        sensor_distance=distance * mm,
        pixel_pitch=6 * um,
        shape=(5, 5),
        dtype=torch.float64,
    )
    weight = torch.linspace(1, 2, psf.numel(), dtype=torch.float64).view_as(psf)
    return (psf * weight).sum() * 10


def test_gradients_to_every_drawn_number() -> None:

    numbers = [
        torch.tensor([0.3, -0.2], dtype=torch.float64),
        torch.tensor([1.1, 0.9], dtype=torch.float64),
        torch.tensor(50.0, dtype=torch.float64),
        torch.tensor([[0.0, 0.1, 0.2, 0.3], [0.1, 0.0, -0.1, 0.2]], dtype=torch.float64),
    ]
    inputs = [n.requires_grad_() for n in numbers]
    assert torch.autograd.gradcheck(weighted, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("f_number", [1.8, 8, 32])
@pytest.mark.parametrize("shape", [(41, 40), pytest.param((64, 31), marks=pytest.mark.slow)])
def test_without_aberrations_one_hankel_transform_gives_the_same(f_number: float, shape: tuple[int, int]) -> None:
    """Against the matrix form, good to 5e-5; a fringe is much smaller than a pixel at f/1.8, larger at f/32."""
    vergences = torch.tensor([[0.0, 1.5], [-0.7, 4.0]], dtype=torch.float64)
    lenses = {
        "radii": torch.tensor([1.0, 0.6], dtype=torch.float64) * 8 * mm / (2 * f_number),
        "wavelengths": torch.tensor([420e-9, 700e-9], dtype=torch.float64),
        "sensor_distance": torch.tensor([8.0, 8.2], dtype=torch.float64) * mm,
        "pixel_pitch": 4 * um,
        "shape": shape,
    }
    exact = optics.batch_psf(vergences, coefficients=torch.zeros(2, 1), dtype=torch.float64, **lenses)
    for dtype in (torch.float64, torch.float32):
        fast = optics.batch_psf(vergences, dtype=dtype, **lenses)
        assert fast.dtype == dtype
        error = (fast - exact).abs().sum((-2, -1)) / exact.sum((-2, -1))
        assert error.max() < 1e-4


def test_gradients_of_the_hankel_form() -> None:
    numbers = [
        torch.tensor([0.3, -0.2], dtype=torch.float64),
        torch.tensor([1.1, 0.9], dtype=torch.float64),
        torch.tensor(50.0, dtype=torch.float64),
    ]
    # the profile is interpolated between tabulated arguments, so its slope is good to 1e-4, not to rounding
    inputs = [n.requires_grad_() for n in numbers]
    assert torch.autograd.gradcheck(weighted, inputs, eps=1e-6, atol=1e-4, rtol=3e-4)


@pytest.mark.parametrize("rim", [0.0, 0.3, 40.0, -300.0, 2500.0])
def test_the_projection_gives_what_the_table_of_j0_gives(rim: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Amplitudes and their slope to the defocus; the trapezium rule's 1e-6 where the disc's projection ends."""
    nodes, arguments = 64 + int(abs(rim)) * 2, 1024
    found = []
    for kept in (2**30, 0):
        monkeypatch.setattr(batch, "KEPT", kept)
        defocus = torch.tensor([[rim]], dtype=torch.float64, requires_grad=True)
        amplitude = batch._amplitude(defocus, nodes=nodes, arguments=arguments)
        weight = torch.linspace(1, 2, arguments, dtype=torch.float64)
        found.append((amplitude.detach(), torch.autograd.grad((amplitude * weight).sum(), defocus)[0]))
    (table, table_slope), (projected, projected_slope) = found
    assert table.shape == (2, 1, 1, arguments)
    assert (table - projected).abs().max() < 1e-6
    assert torch.allclose(table_slope, projected_slope, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("aberrated", [False, True])
def test_each_wavelength_may_have_its_own_defocus(aberrated: bool) -> None:
    vergences = torch.tensor([[[0.5, -0.5]]], dtype=torch.float64)
    lenses = {"radii": torch.tensor([2.0]) * mm, "sensor_distance": SENSOR, "pixel_pitch": 4 * um, "shape": (31, 31)}
    if aberrated:
        lenses["coefficients"] = torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.0, 50e-9]])
    both = optics.batch_psf(vergences, wavelengths=WAVELENGTHS, **lenses)
    for index in range(2):
        alone = optics.batch_psf(vergences[..., index], wavelengths=WAVELENGTHS[index : index + 1].clone(), **lenses)
        # a wavelength alone has its own sampling, good to 5e-5
        assert (both[0, 0, index] - alone[0, 0, 0]).abs().sum() < 1e-4 * alone.sum()


def test_an_empty_batch_gives_an_empty_bank() -> None:
    empty = optics.batch_psf(
        torch.zeros(0),
        radii=torch.ones(1),
        wavelengths=WAVELENGTHS,
        sensor_distance=SENSOR,
        pixel_pitch=4 * um,
        shape=(3, 3),
    )
    assert empty.shape == (0, 1, 2, 3, 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"radii": torch.tensor([-1e-3])}, "radii must be finite and > 0"),
        ({"sensor_distance": 0.0}, "sensor_distance must be finite and > 0"),
        ({"coefficients": torch.zeros(3, 4)}, r"coefficients must be \(B, K\) with B = 1"),
        ({"pixel_pitch": 4.0}, r"did you mean 4 \* um"),
        ({"vergences": torch.zeros(1, 1, 3)}, r"vergences must be \(B,\), \(B, Z\) or \(B, Z, 2\)"),
        ({"vergences": torch.tensor([5e5])}, "needs .* samples of the pupil and the PSF, more than"),
        (
            {"radii": torch.tensor([0.1]), "sensor_distance": 0.01, "coefficients": torch.zeros(1, 4)},
            "needs .* pupil samples, more than",
        ),
    ],
)
def test_bad_input(change: dict, message: str) -> None:
    given = {"vergences": torch.zeros(1), "radii": torch.tensor([1e-3]), "wavelengths": WAVELENGTHS}
    given |= {"sensor_distance": SENSOR, "pixel_pitch": 4 * um, "shape": (301, 301)} | change
    with pytest.raises(ValueError, match=message):
        optics.batch_psf(given.pop("vergences"), **given)


@pytest.mark.parametrize("aberrated", [False, True])
def test_a_first_call_in_inference_mode_does_not_spoil_training(aberrated: bool) -> None:
    """Tables that are kept would be inference tensors, which autograd refuses."""

    def bank(radii: torch.Tensor) -> torch.Tensor:
        return optics.batch_psf(
            torch.tensor([0.37]),
            radii=radii,
            coefficients=torch.full((1, 5), 20e-9) if aberrated else None,
            wavelengths=WAVELENGTHS,
            sensor_distance=SENSOR,
            pixel_pitch=3.7 * um,  # no other test's tables
            shape=(23, 23),
            dtype=torch.float64,
        )

    radii = torch.tensor([1.37 * mm], dtype=torch.float64, requires_grad=True)
    with torch.inference_mode():
        bank(radii)
    gradient = torch.autograd.grad(bank(radii).amax(), radii)[0]
    assert bool(gradient.isfinite().all())
    assert float(gradient.abs()) > 0
