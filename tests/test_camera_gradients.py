"""Finite differences through a whole camera, from the optics to the picture."""

import torch
from torch import nn

from kcam import Camera, Scene, isp, optics, sensor
from kcam.units import mm, um


def small_camera(phase: torch.Tensor) -> Camera:
    lens = optics.Lens(
        optics.CircularAperture(1.5 * mm),
        optics.PlanoConvexLens(25.8 * mm),
        optics.DOE(nn.Parameter(phase)),
        focus_distance=1.0,
    )
    return Camera(
        optics.Imaging(lens, pixel_pitch=8 * um, psf_shape=(7, 7)),
        sensor.ColourFilter.kodak(),
        sensor.Mosaic("RGGB"),
        sensor.Exposure(),
        sensor.ShotNoise(full_well=10_000),
        sensor.ReadNoise(3.0),
        isp.Demosaic(),
        isp.WhiteBalance(),
        isp.ColourMatrix(),
        isp.ToneCurve(),
    ).noiseless()


def test_gradcheck_from_the_doe_and_the_scene_to_the_picture() -> None:
    """A noiseless, unquantised camera away from its clips; sampling does not depend on the phase of a pixel map."""
    generator = torch.Generator().manual_seed(3)
    phase = torch.rand(5, 5, generator=generator, dtype=torch.float64)
    # mid tones only: no pixel meets a clip, and no colour leaves the gamut
    planes = 0.3 + 0.2 * torch.rand(1, 3, 6, 6, generator=generator, dtype=torch.float64)
    template = Scene.from_rgb(planes, depth=1.4, wavelengths=torch.linspace(430e-9, 690e-9, 6, dtype=torch.float64))
    camera = small_camera(phase)
    weight = torch.rand(1, 3, 6, 6, generator=generator, dtype=torch.float64)

    def loss(doe: torch.Tensor, coefficients: torch.Tensor) -> torch.Tensor:
        name = "stages.0.lens.elements.2.phase"
        scene = Scene(coefficients, template.spectra, wavelengths=template.wavelengths, depth=1.4)
        picture = torch.func.functional_call(camera, {name: doe}, (scene,))
        return (picture * weight).sum()

    picture = camera(template).detach()
    assert picture.min() > 0.05
    assert picture.max() < 0.95
    inputs = (phase.clone().requires_grad_(), template.coefficients.clone().requires_grad_())
    assert torch.autograd.gradcheck(loss, inputs, eps=1e-6, atol=1e-7, rtol=1e-5)


def test_gradients_pass_a_noisy_quantised_camera() -> None:
    """Every surrogate in the chain lets the optics train: finite and not zero, on a scene that also clips."""
    camera = Camera(
        *small_camera(torch.zeros(5, 5))[:4],
        sensor.ShotNoise(full_well=2_000),
        sensor.ReadNoise(5.0),
        sensor.ADC(bits=8),
        isp.Demosaic(),
        isp.WhiteBalance(),
        isp.ColourMatrix(),
        isp.ToneCurve(),
    )
    image = torch.rand(1, 3, 9, 11, generator=torch.Generator().manual_seed(0))
    picture = camera(Scene.from_rgb(image, depth=1.2), generator=torch.Generator().manual_seed(1))
    picture.square().mean().backward()
    gradient = camera[0].lens.elements[2].phase.grad
    assert torch.isfinite(gradient).all()
    assert float(gradient.abs().max()) > 0
