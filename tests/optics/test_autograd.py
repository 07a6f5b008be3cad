"""Derivatives by hand: right where they exist, an error where they do not."""

from __future__ import annotations

import pytest
import torch

from kcam import optics, sensor
from kcam.camera import Camera
from kcam.optics.autograd import once_differentiable
from kcam.scene import Scene
from kcam.units import mm, nm, um

DOUBLE = torch.float64


class Scale(torch.autograd.Function):
    """x * y, by hand."""

    @staticmethod
    def forward(ctx, x, y):
        ctx.save_for_backward(x, y)
        return x * y

    @staticmethod
    @once_differentiable
    def backward(ctx, saved, grad):
        x, y = saved
        return grad * y, grad * x if ctx.needs_input_grad[1] else None


def test_once_means_once_even_where_the_incoming_gradient_has_no_graph() -> None:
    x, y = (torch.tensor([2.0, 3.0], dtype=DOUBLE, requires_grad=True) for _ in range(2))
    assert torch.autograd.gradcheck(Scale.apply, (x, y))
    (first,) = torch.autograd.grad(Scale.apply(x, y).sum(), x, create_graph=True)
    assert torch.equal(first, y)
    with pytest.raises(RuntimeError, match="first derivatives only"):
        torch.autograd.grad(first.sum(), y)
    assert torch.autograd.grad(Scale.apply(x, torch.ones(2, dtype=DOUBLE)).sum(), x)[0].tolist() == [1, 1]


def test_a_second_derivative_through_a_grid_is_refused_and_never_zero() -> None:
    """A loss that is linear in the PSF: torch's own decorator would give 0."""
    of = optics.Lens(optics.CircularAperture(1 * mm), optics.ThinLens(20 * mm), focus_distance=2.0)

    def peak(vergence: torch.Tensor, method: str) -> torch.Tensor:
        near = optics.Lens(*of.elements, optics.Defocus(vergence), sensor_distance=of.sensor_distance)
        image = near.psf([550 * nm], distances=2.0, pixel_pitch=4 * um, shape=(5, 5), method=method, dtype=DOUBLE)
        return image[0, 0, 2, 2]

    at = torch.tensor(0.3, dtype=DOUBLE)
    second = torch.autograd.functional.hessian(lambda v: peak(v, "radial"), at)
    assert abs(float(second)) > 1e-3
    with pytest.raises(RuntimeError, match="first derivatives only"):
        torch.autograd.functional.hessian(lambda v: peak(v, "matrix"), at)
    first = torch.autograd.functional.jacobian(lambda v: peak(v, "matrix"), at, create_graph=True)
    torch.testing.assert_close(
        first, torch.autograd.functional.jacobian(lambda v: peak(v, "radial"), at), rtol=1e-4, atol=1e-9
    )


def test_a_second_derivative_through_a_rendering_is_refused() -> None:
    lens = optics.Lens(optics.CircularAperture(2 * mm), optics.PlanoConvexLens(25 * mm), focus_distance=2.0)
    camera = Camera(
        optics.Imaging(lens, pixel_pitch=4 * um, psf_shape=(9, 9), direct=False), sensor.ColourFilter.kodak()
    )
    bands = torch.rand(1, 4, 16, 16, requires_grad=True, generator=torch.Generator().manual_seed(0))
    wavelengths = torch.linspace(450, 650, 4, dtype=DOUBLE) * nm

    def brightness(values: torch.Tensor) -> torch.Tensor:
        return camera(Scene.from_bands(values, wavelengths=wavelengths, depth=2.0)).square().sum()

    (first,) = torch.autograd.grad(brightness(bands), bands, create_graph=True)
    with pytest.raises(RuntimeError, match="first derivatives only"):
        torch.autograd.grad(first.sum(), bands)


@pytest.mark.parametrize("method", ["matrix", "chirp_z", "radial"])
def test_a_backward_pass_of_a_psf_inside_autocast_stays_in_full_precision(method: str) -> None:
    gradients = []
    for enabled in (False, True):
        power = torch.tensor(0.5, dtype=DOUBLE, requires_grad=True)
        lens = optics.Lens(
            optics.CircularAperture(2 * mm), optics.ThinLens(30 * mm), optics.Defocus(power), focus_distance=2.0
        )
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=enabled):
            psf = lens.psf([550 * nm], distances=2.0, pixel_pitch=4 * um, shape=(33, 33), method=method)
            gradients += torch.autograd.grad(psf.square().sum(), power)
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-5, atol=0.0)


@pytest.mark.parametrize("row", [("nonparaxial", "radial"), ("reference", "quadrature")], ids="-".join)
def test_derivatives_in_batches(row: tuple[str, str]) -> None:
    """vmap over what is pulled back, as torch's vectorised Jacobian does."""

    def psf(vergence: torch.Tensor) -> torch.Tensor:
        lens = optics.Lens(
            optics.CircularAperture(1 * mm), optics.ThinLens(20 * mm), optics.Defocus(vergence), sensor_distance=20 * mm
        )
        asked = lens.query([550 * nm], distances=2.0, pixel_pitch=4 * um, shape=(5, 4), dtype=DOUBLE)
        return optics.PROPAGATORS[row](asked)

    at = torch.tensor(0.3, dtype=DOUBLE)
    one_by_one = torch.autograd.functional.jacobian(psf, at)
    torch.testing.assert_close(torch.autograd.functional.jacobian(psf, at, vectorize=True), one_by_one)
