"""One function for a batch of lenses: equal to the lenses one by one, with gradients to every drawn number."""

import pytest
import torch

from kcam import optics
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


def test_gradients_to_every_drawn_number() -> None:
    def total(vergence, radius, coefficients, distance):
        psf = optics.batch_psf(
            vergence,
            radii=radius * mm,
            coefficients=coefficients * 1e-7,
            wavelengths=[550e-9],
            sensor_distance=distance * mm,
            pixel_pitch=6 * um,
            shape=(5, 5),
            dtype=torch.float64,
        )
        weight = torch.linspace(1, 2, psf.numel(), dtype=torch.float64).view_as(psf)
        return (psf * weight).sum() * 10

    numbers = [
        torch.tensor([0.3, -0.2], dtype=torch.float64),
        torch.tensor([1.1, 0.9], dtype=torch.float64),
        torch.tensor([[0.0, 0.1, 0.2, 0.3], [0.1, 0.0, -0.1, 0.2]], dtype=torch.float64),
        torch.tensor(50.0, dtype=torch.float64),
    ]
    inputs = [n.requires_grad_() for n in numbers]
    assert torch.autograd.gradcheck(total, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


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
        ({"radii": torch.tensor([0.1]), "sensor_distance": 0.01}, "needs .* pupil samples, more than"),
    ],
)
def test_bad_input(change: dict, message: str) -> None:
    good = {"radii": torch.tensor([1e-3]), "wavelengths": WAVELENGTHS, "sensor_distance": SENSOR}
    good |= {"pixel_pitch": 4 * um, "shape": (301, 301)}
    with pytest.raises(ValueError, match=message):
        optics.batch_psf(torch.zeros(1), **(good | change))
