"""Questions about `optics.Imaging`: pictures of small random scenes under each of its arguments, and gradients."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from draws import Draw
from golden.lenses import lens
from golden.psfs import DTYPES
from golden.question import Answer, Question, gradients, in_float32, parameter, projected
from torch import Tensor

from kcam import Context, Scene, optics, sensor
from kcam.units import nm, um

SIZE = 20, 26


def picture(draw: Draw, dtype: torch.dtype, *, batch: int = 1, bands: int = 11) -> Scene:
    """Three planes times three spectra."""
    grid = torch.linspace(430, 690, bands, dtype=torch.float64) * nm
    return Scene.from_rgb((0.05 + 0.9 * draw.noise(batch, 3, *SIZE)).to(dtype), wavelengths=grid, depth=0.7)


def cube(draw: Draw, dtype: torch.dtype, *, batch: int = 1, bands: int = 5) -> Scene:
    grid = torch.linspace(450, 650, bands, dtype=torch.float64) * nm
    return Scene.from_bands((0.1 + draw.noise(batch, bands, *SIZE)).to(dtype), wavelengths=grid, depth=0.7)


def ramp(draw: Draw) -> Tensor:
    """Distances that fall from left to right."""
    return 1 / torch.linspace(0.4, 1.8, SIZE[1], dtype=torch.float64).expand(1, 1, *SIZE)


def step(draw: Draw) -> Tensor:
    """A near square before a far wall."""
    depth = torch.full((1, 1, *SIZE), 2.0, dtype=torch.float64)
    depth[..., 5:14, 6:17] = 0.6
    return depth


def rough(draw: Draw) -> Tensor:
    return 1 / (0.4 + 1.2 * draw.noise(1, 1, *SIZE))


def lamps(draw: Draw, dtype: torch.dtype) -> Scene:
    """Few lights before much that is dark: computed in float64 whatever the scene's type."""
    planes = 1e-4 * draw.noise(1, 5, *SIZE)
    planes[..., 4, 5] += 300
    planes[..., 13, 18] += 500
    grid = torch.linspace(450, 650, 5, dtype=torch.float64) * nm
    return Scene.from_bands(planes.to(dtype), wavelengths=grid, depth=step(draw))


def take(
    kind: str,
    make: Callable[[Draw, torch.dtype], Scene],
    depth: Callable[[Draw], Any] | None,
    arguments: dict[str, Any],
    dtype: torch.dtype,
    seed: int,
    *,
    filtered: bool,
    trains: tuple[str, ...] = (),
) -> Answer:
    """The picture behind a lens, and its gradients to the scene's planes and the lens; `trains`: to its depth too."""
    draw = Draw(seed)
    optic = lens(kind, draw, dtype)
    imaging = optics.Imaging(optic, pixel_pitch=draw.number(2.5, 4.5) * um, **arguments)
    scene = make(draw, dtype)
    if depth is not None:
        found = depth(draw)
        scene = scene.with_depth(parameter(found, dtype) if "depth" in trains else found)
    curves = sensor.ColourFilter.kodak() if filtered else None
    leaves = dict(optic.named_parameters())
    if "planes" in trains or not trains:
        scene.coefficients.requires_grad_()
        leaves["planes"] = scene.coefficients
    if "depth" in trains:
        leaves["depth"] = scene.depth
    result = imaging(scene, colour_filter=curves)
    weights = draw.noise(*result.shape) - 0.5
    vergences = imaging.depth_layers(torch.as_tensor(scene.depth).detach(), scene.wavelengths)
    window = imaging.psf_window(scene.wavelengths, vergences=vergences.detach(), picture=SIZE)
    answer = {
        "picture": result,
        **gradients(projected(result, weights), leaves),
        "layers": vergences,
        "window": list(window),
    }
    return in_float32(answer) if imaging.precision == "float32" else answer


def plain_bands(dtype: torch.dtype, seed: int) -> Answer:
    """A tensor of bands, alone and told of its wavelengths by a context, at the focus and at a distance."""
    draw = Draw(seed)
    optic = lens("round convex", draw, dtype)
    bands = (0.1 + draw.noise(1, 3, *SIZE)).to(dtype)
    context = Context(wavelengths=torch.tensor([460, 540, 630], dtype=torch.float64) * nm)
    every = (0.1 + draw.noise(1, 28, 8, 9)).to(dtype)
    return {
        "told": optics.Imaging(optic, pixel_pitch=3 * um, distance=0.5)(bands, context),
        "untold": optics.Imaging(optic, pixel_pitch=3 * um, distance=0.5)(every),
        "changed": optics.Imaging(optic, distance=0.5).changed(pixel_pitch=3 * um, border="zero")(bands, context),
    }


def kept(dtype: torch.dtype, seed: int) -> Answer:
    """PSFs are kept between pictures, and made anew when the lens was changed."""
    draw = Draw(seed)
    optic = lens("DOE", draw, dtype)
    imaging = optics.Imaging(optic, pixel_pitch=3 * um, psf_shape=(9, 11))
    scene = cube(draw, dtype)
    answer: Answer = {}
    for turn in ("first", "second", "changed"):
        with torch.no_grad():
            if turn == "changed":
                optic.get_parameter("elements.2.phase")[:8] += 0.7
            answer[turn] = imaging(scene)
    like, vergences = scene.coefficients, torch.tensor([0.5, 1.5], dtype=torch.float64)
    answer["bank"] = imaging.psf_bank(scene.wavelengths, vergences=vergences, shape=(9, 7), like=like)
    work = imaging.work(scene, channels=3)
    return answer | {"operations": work.operations, "memory": work.memory}


def distant(draw: Draw) -> float:
    return float("inf")


def near(draw: Draw) -> float:
    return draw.number(0.4, 0.6)


def of_each(draw: Draw) -> Tensor:
    return torch.tensor([0.5, 1.5, 0.5], dtype=torch.float64)


def of_each_apart(draw: Draw) -> Tensor:
    return torch.tensor([0.5, 1.5, 0.8], dtype=torch.float64)


def maps(draw: Draw) -> Tensor:
    return torch.cat([ramp(draw), step(draw), rough(draw)])


def pictures(draw: Draw, dtype: torch.dtype) -> Scene:
    return picture(draw, dtype, batch=3)


def cubes(draw: Draw, dtype: torch.dtype) -> Scene:
    return cube(draw, dtype, batch=3)


TAKES: dict[str, tuple[str, Callable, Callable | None, dict[str, Any]]] = {
    "as it is": ("round convex", picture, None, {}),
    "of a cube": ("round convex", cube, near, {}),
    "border replicate": ("round thin", picture, near, {"border": "replicate"}),
    "border periodic": ("annular convex", cube, near, {"border": "periodic"}),
    "border zero": ("coded", picture, near, {"border": "zero"}),
    "at infinity": ("two glasses", cube, distant, {}),
    "few bands": ("round convex", picture, near, {"bands": 4}),
    "a window": ("Zernike", cube, near, {"psf_shape": (9, 13)}),
    "a window rescaled": ("round thin", cube, near, {"psf_shape": (7, 5), "renormalise": True}),
    "tiles": ("round convex", cube, near, {"tile": 8, "psf_shape": (9, 9)}),
    "direct": ("DOE", picture, near, {"direct": True, "psf_shape": (5, 7)}),
    "little memory": ("round convex", cube, near, {"max_memory": 3e4}),
    "sensitive part": ("round thin", cube, None, {"fill_factor": 0.5}),
    "point samples": ("annular thin", picture, near, {"integrate": False, "fill_factor": 0.7}),
    "without blur": ("round convex", picture, ramp, {"blur": False}),
    "fresnel": ("square convex", cube, near, {"propagator": "fresnel"}),
    "chirp_z": ("Zernike DOE", cube, near, {"method": "chirp_z"}),
    "samples": ("own", cube, near, {"samples": 160, "psf_shape": (11, 11)}),
    "kappa": ("square convex", picture, near, {"kappa": 1.7, "method": "matrix"}),
    "rays": ("round convex", cube, near, {"propagator": "geometric"}),
    "angular spectrum": ("fixed stop", cube, near, {"propagator": "angular_spectrum", "bands": 1}),
    "rank": ("round convex", cube, near, {"rank": 2}),
    "in float32": ("round convex", cube, near, {"precision": "float32"}),
    "in float64": ("round convex", cube, ramp, {"precision": "float64"}),
    "a ramp": ("round convex", picture, ramp, {}),
    "a ramp in 3 layers": ("coded", cube, ramp, {"layers": 3}),
    "layers that are given": ("round thin", cube, rough, {"layers": (2.0, 1.0, 0.6)}),
    "nearest layers": ("round thin", picture, ramp, {"layers": 4, "interpolate": False}),
    "a step": ("round convex", picture, step, {}),
    "a step, coverage per band": ("round convex", picture, step, {"coverage": "band"}),
    "rough depth, coverage per band": ("annular thin", cube, rough, {"coverage": "band", "layers": 5}),
    "without occlusion": ("round thin", cube, ramp, {"occlusion": False, "layers": 4}),
    "a ramp through a DOE": ("DOE", cube, ramp, {"layers": 2, "bands": 2}),
    "layers in tiles": ("round thin", cube, step, {"tile": 9, "psf_shape": (9, 9), "border": "periodic"}),
    "layers in little memory": ("round thin", cube, ramp, {"max_memory": 5e4, "layers": 5}),
    "a batch at distances": ("round convex", pictures, of_each, {}),
    "a batch of maps": ("round thin", cubes, maps, {"layers": 3}),
    "lamps": ("round thin", lamps, None, {}),
}
"""What is asked -> kind of lens, scene, depth, arguments of the Imaging."""

DEPTHS: dict[str, tuple[str, Callable, Callable | None, dict[str, Any]]] = {
    "a ramp": ("round convex", cube, ramp, {"layers": 4}),
    "a rough map": ("round thin", picture, rough, {"coverage": "band", "layers": 3}),
    "distances of a batch": ("annular convex", cubes, of_each_apart, {}),
    "one distance": ("round convex", cube, near, {}),
}
"""Whose depth trains."""


def _questions() -> list[Question]:
    found = []
    for seed, (what, (kind, make, depth, arguments)) in enumerate(TAKES.items()):
        for place, (name, dtype) in enumerate(DTYPES.items()):
            for filtered in (True, False) if what in ("as it is", "a step") else ((seed + place) % 2 == 0,):
                ask = partial(take, kind, make, depth, arguments, dtype, 600 + seed, filtered=filtered)
                behind = ", filtered" if filtered else ""
                found.append(Question(f"picture {what}{behind}, {name}", ask))
    for name, dtype in DTYPES.items():
        for seed, (what, (kind, make, depth, arguments)) in enumerate(DEPTHS.items()):
            trains = ("planes", "depth")
            ask = partial(take, kind, make, depth, arguments, dtype, 700 + seed, filtered=seed == 0, trains=trains)
            found.append(Question(f"gradient to {what}, {name}", ask))
        found.append(Question(f"pictures of bands, {name}", partial(plain_bands, dtype, 800)))
        found.append(Question(f"pictures through kept PSFs, {name}", partial(kept, dtype, 801)))
    return found


QUESTIONS = _questions()
