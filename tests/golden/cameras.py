"""Questions about whole cameras, as they are built and as the commit before saved them.

Pictures behind noise or steps of an ADC are in float64: in float32 another rounding lets a photon fall otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from draws import Draw
from golden.question import Answer, Question, gradients, in_float32, parameter, projected
from torch import Tensor, nn

from kcam import Camera, Scene, demo, isp, optics, sensor, style
from kcam.style import StyleLoss, painting, style_camera
from kcam.units import mm, nm, um

FILES = Path(__file__).parent / "files"


def painted(height: int = 30, width: int = 36, *, bands: int = 11, seed: int = 1) -> Scene:
    """Blocks of random colours with texture, in float64: the built-in scenes are made in float32."""
    draw = Draw(seed)
    blocks = draw.noise(1, 3, height // 4 + 1, width // 4 + 1).repeat_interleave(4, 2).repeat_interleave(4, 3)
    rgb = 0.05 + 0.6 * blocks[..., :height, :width] + 0.3 * draw.noise(1, 3, height, width)
    return Scene.from_rgb(rgb, wavelengths=torch.linspace(430, 700, bands, dtype=torch.float64) * nm)


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def noiseless(camera: Camera) -> Camera:
    """Without noise and steps, up to what a demosaic is given or the end."""
    stages = [stage for stage in camera.noiseless() if not isinstance(stage, sensor.ADC)]
    return Camera(*stages, context=camera.resolve())


# ---- cameras ---------------------------------------------------------------------------------------------------------


def trained(camera: Camera, seed: int, *, by: float = 0.05) -> Camera:
    """All parameters disturbed, as training leaves them: maps by more."""
    draw = Draw(seed)
    with torch.no_grad():
        for value in camera.parameters():
            noise = draw.noise(*value.shape) - 0.5
            size = 40 * by if value.ndim == 2 and value.shape[0] == value.shape[1] > 8 else by * (value.abs() + 0.1)
            value.add_((noise * size).to(value))
    return camera


def behind(lens: optics.Lens, *others: nn.Module, curves: sensor.ColourFilter | None = None, **arguments) -> Camera:
    """A camera with a lens, without noise unless stages for that are given."""
    return Camera(
        optics.Imaging(lens, **{"pixel_pitch": 4 * um} | arguments),
        curves or sensor.ColourFilter.kodak(infrared_cut=680 * nm),
        sensor.Mosaic("RGGB"),
        sensor.Exposure(),
        *others,
        isp.Demosaic("bilinear"),
        isp.WhiteBalance(),
        isp.ColourMatrix(),
        isp.ToneCurve(),
    )


def noisy() -> list[nn.Module]:
    return [sensor.ShotNoise(full_well=8000), sensor.ReadNoise(3.0), sensor.ADC(bits=12, black_level=32)]


def small_thesis() -> Camera:
    """The thesis's network at a size that a file can have."""
    lens = optics.Lens(
        optics.CircularAperture(5 * mm),
        optics.PlanoConvexLens(25.8 * mm, glass="N-BK7"),
        optics.DOE(nn.Parameter(torch.zeros(40, 40))),
        focus_distance=2.0,
    )
    imaging = optics.Imaging(lens, propagator="fresnel", psf_shape=(31, 31))
    curves = sensor.ColourFilter.learned(tile=4)
    camera = Camera(imaging, curves, sensor.Exposure(), isp.Clip(), isp.LearnedDemosaic(), isp.ToneCurve())
    return trained(camera, 11)


def style_with_stage() -> Camera:
    camera = Camera(*list(style_camera(stage=False)), isp.StyleStage(width=4, dilations=(1,)))
    return trained(camera, 12, by=0.03)


def coded() -> Camera:
    """Elements and arguments that are no defaults."""
    draw = Draw(13)
    lens = optics.Lens(
        optics.ApertureMap((draw.noise(7, 7) > 0.3).float(), width=2 * mm),
        optics.PlanoConvexLens(15 * mm, glass="N-SF5"),
        optics.Defocus(parameter(0.2, torch.float64)),
        optics.DOE(nn.Parameter(((draw.noise(12, 12) - 0.5) * 5).float()), pitch=120 * um, levels=8, glass="PMMA"),
        optics.ZernikeAberration(parameter((draw.noise(8) - 0.5) * 100 * nm, torch.float64)),
        focus_distance=1.2,
        focus_wavelength=580 * nm,
    )
    arguments = {"border": "periodic", "layers": (2.0, 1.0, 0.5), "coverage": "band", "fill_factor": 0.6, "bands": 5}
    return behind(lens, *noisy(), curves=sensor.ColourFilter.sigma(), psf_shape=(17, 15), **arguments)


def radial() -> Camera:
    draw = Draw(14)
    lens = optics.Lens(
        optics.AnnularAperture(nn.Parameter(torch.tensor(2.5e-3)), obscuration=0.3),
        optics.ThinLens(nn.Parameter(torch.tensor(20e-3))),
        optics.RadialDOE(nn.Parameter(((draw.noise(10) - 0.5) * 4).float())),
        optics.ZernikeDOE(nn.Parameter(((draw.noise(6) - 0.5) * 2).float()), glass="CaF2"),
        sensor_distance=nn.Parameter(torch.tensor(20.4e-3, dtype=torch.float64)),
    )
    return behind(lens, tile=12, psf_shape=(13, 13), interpolate=False, layers=3)


def photometric() -> Camera:
    """Exposure in physical units asks the lens for its aperture and distance."""
    lens = optics.Lens(optics.SquareAperture(3 * mm), optics.ThinLens(24 * mm), focus_distance=float("inf"))
    return Camera(
        optics.Imaging(lens, pixel_pitch=5 * um, fill_factor=0.5, precision="float64", direct=True, psf_shape=(9, 9)),
        sensor.ColourFilter.nikon(),
        sensor.Mosaic("quad_bayer"),
        sensor.Exposure(time=0.004, iso=200),
        sensor.ShotNoise(full_well=9000),
        sensor.ADC(bits=10),
        isp.Demosaic("bilinear"),
        isp.WhiteBalance(),
        isp.ToneCurve(),
    )


def planned() -> Camera:
    """A plan's choices, saved as a plain camera."""
    camera = demo.singlet()
    with torch.no_grad():
        plan = camera.plan(Scene.builtin("coffee", 40), tolerance=0.05)
    return plan.apply(camera)


CAMERAS: dict[str, Callable[[], Camera]] = {
    "phone": Camera.phone,
    "singlet": demo.singlet,
    "small_thesis": small_thesis,
    "style_with_stage": style_with_stage,
    "coded": coded,
    "radial": radial,
    "photometric": photometric,
    "planned": planned,
}
"""Those that were saved, as files/NAME.safetensors."""
ROUNDED = "small_thesis", "style_with_stage"
"""Whose filter or network computes in float32."""


# ---- what they give --------------------------------------------------------------------------------------------------


def ramped(scene: Scene) -> Scene:
    depth = 1 / torch.linspace(0.5, 1.8, scene.shape[2], dtype=torch.float64)
    return scene.with_depth(depth.expand(1, 1, *scene.shape[1:]))


def pictures(camera: Camera, seed: int, *, rounded: bool = False) -> Answer:
    """With noise and without, flat and deep, and in float32 what is not yet rounded.

    rounded: the camera computes something in float32 whatever the scene: then without noise and steps.
    """
    flat, deep = painted(), ramped(painted(24, 30))
    quiet = noiseless(camera)
    with torch.no_grad():
        answer = {"noiseless": quiet(flat, generator=seeded(seed)), "in float32": quiet[:4](deep.to(torch.float32))}
        if rounded:
            return in_float32(answer | {"deep": quiet(deep, generator=seeded(seed))})
        return answer | {
            name: camera(scene, generator=seeded(seed)) for name, scene in (("flat", flat), ("deep", deep))
        }


def of_a_file(name: str, seed: int) -> Answer:
    """Of a camera that was saved before."""
    camera = Camera.load(FILES / f"{name}.safetensors")
    found = pictures(camera, seed, rounded=name in ROUNDED)
    return found | {f"parameter {key}": value for key, value in camera.state_dict().items()}


def slopes(make: Callable[[], Camera], seed: int) -> Answer:
    """Gradients of a picture to all that trains, in float32 as it is trained."""
    camera = noiseless(make())
    picture = camera(ramped(painted(24, 30)).to(torch.float32))
    weights = Draw(seed).noise(*picture.shape) - 0.5
    return {"picture": picture, **gradients(projected(picture, weights), dict(camera.named_parameters()))}


def thesis(bands: int, size: tuple[int, int]) -> Answer:
    """The preset at its own size, before a small scene of a few bands."""
    camera = Camera.thesis()
    grid = torch.linspace(450, 650, bands, dtype=torch.float64) * nm
    radiance = 0.1 + Draw(8).noise(bands, *size)
    scene = Scene.from_bands(radiance.to(torch.float32), wavelengths=grid)
    with torch.no_grad():
        untrained = camera(scene)
    picture = trained(camera, 9)(scene)
    (slope,) = torch.autograd.grad(projected(picture, Draw(9).noise(*picture.shape)), camera[0].lens.elements[2].phase)
    return {"untrained": untrained, "trained": picture, "d phase": slope}


def steps() -> Answer:
    """Stage by stage."""
    with torch.no_grad():
        return dict(demo.singlet().steps(ramped(painted()), generator=seeded(5)))


def builtin_scenes() -> Answer:
    """In float32, before any rounding; without the star, whose edges fall on either side of a pixel by rounding."""
    answer: Answer = {}
    camera, grid = noiseless(demo.singlet()), torch.linspace(430, 700, 11, dtype=torch.float64) * nm
    for name in ("motorcycle", "astronaut", "coffee", "chelsea", "colour_chart", "point_grid"):
        with torch.no_grad():
            answer[name] = camera(Scene.builtin(name, 32, wavelengths=grid))
    return answer


def own_radius() -> Answer:
    """README's first code, small."""
    radius = nn.Parameter(torch.tensor(25.8 * mm))
    elements = optics.CircularAperture(5 * mm), optics.PlanoConvexLens(radius, glass="N-BK7")
    lens = optics.Lens(*elements, focus_distance=2.3)
    psf = lens.psf([450 * nm, 550 * nm, 650 * nm], distances=[2.3, 5.0], pixel_pitch=4 * um, shape=(65, 65))
    picture = noiseless(behind(lens))(Scene.builtin("motorcycle", size=48))
    (slope,) = torch.autograd.grad(picture.var(), radius)
    return {"psf": psf, "picture": picture, "slope": slope, "focal length": lens.focal_length()}


def described() -> Answer:
    """What cameras print and save of their configuration."""
    found: dict[str, Any] = {}
    for name, make in CAMERAS.items():
        if name != "planned":
            camera = make()
            found[name] = {"parameters": {key: list(value.shape) for key, value in camera.named_parameters()}}
            found[name]["printed"] = str(camera)
    return found


def doe_in_training() -> Answer:
    """README's training of a diffractive element, five steps of it."""
    phase = nn.Parameter(0.1 * (Draw(0).noise(32, 32) - 0.5))
    elements = optics.CircularAperture(3 * mm), optics.ThinLens(20 * mm), optics.DOE(phase)
    lens = optics.Lens(*elements, focus_distance=1.3)
    optimiser = torch.optim.SGD([phase], lr=3.0)
    found: list[Tensor] = []
    for _ in range(5):
        arguments = {"pixel_pitch": 4 * um, "shape": (17, 17), "dtype": torch.float64}
        psf = lens.psf([550 * nm], distances=[0.8, 1.3, 3.5], **arguments)
        share = psf[:, 0, 7:10, 7:10].sum()
        optimiser.zero_grad()
        (-share).backward()
        optimiser.step()
        found.append(share.detach())
    return {"shares": torch.stack(found), "phase": phase}


def style_steps() -> Answer:
    """Training by a style, two steps, of a camera without noise."""
    lens = optics.Lens(
        optics.CircularAperture(5 * mm),
        optics.ThinLens(50 * mm),
        optics.DOE(nn.Parameter((0.3 * (Draw(3).noise(16, 16) - 0.5)).float())),
        focus_distance=2.0,
    )
    curves = sensor.ColourFilter.nikon().trainable()
    camera = behind(lens, curves=curves, psf_shape=(11, 11), bands=4)
    loss = StyleLoss(painting("woodcut", size=64), crop=64)
    taken = style.fit(camera, loss, settings=style.Settings(steps=2, size=64, average=0.0))
    return {"history": taken.history.float(), "names": list(taken.names), "phase": lens.elements[2].phase}


def _questions() -> list[Question]:
    found = [Question(f"file {name}", partial(of_a_file, name, 20 + seed)) for seed, name in enumerate(CAMERAS)]
    for seed, name in enumerate(("phone", "singlet", "photometric")):
        found.append(Question(f"camera {name}", lambda name=name, seed=seed: pictures(CAMERAS[name](), 30 + seed)))
    found.append(Question("camera ideal", lambda: pictures(Camera.ideal(), 33)))
    found.append(Question("camera style", lambda: pictures(style_camera(stage=False), 34, rounded=True)))
    for seed, name in enumerate(("small_thesis", "radial", "coded")):
        found.append(Question(f"gradients of camera {name}", partial(slopes, CAMERAS[name], 40 + seed)))
    found.append(Question("camera thesis", partial(thesis, 2, (16, 20))))
    found.append(Question("camera thesis, 28 bands", partial(thesis, 28, (64, 80)), slow=True))
    found.append(Question("camera singlet, step by step", steps))
    found.append(Question("camera singlet on the built-in scenes", builtin_scenes))
    found.append(Question("camera of the README", own_radius))
    found.append(Question("cameras in words", described))
    found.append(Question("a DOE in training", doe_in_training))
    found.append(Question("a camera in training by a style", style_steps))
    return found


QUESTIONS = _questions()
