"""Train a lens end to end: a Cooke triplet with two curvatures off gets its sharpness back, over the whole field.

    python examples/train_lens.py [--steps 30] [--out lens.png]

The loss is the error of a picture, made with exact rays, fitted pupils and a PSF that varies over the field. Five
curvatures train, and nothing tells them what they were in the patent; the last one follows, so that the focal length is
held: a solve, as lens designers say.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor, nn

from kcam import Scene, optics, plots
from kcam.units import mm, nm, um

SCALE = 0.1  # of the patent's 50 mm: a lens of 5 mm brings its whole field onto few pixels
FOCAL_LENGTH = 5 * mm
PICTURE, PITCH = (144, 216), 13 * um  # to 0.34 (Y / D) in the corners; the triplet images to 0.36
WINDOW = 25
WAVELENGTHS = torch.tensor([640, 550, 480], dtype=torch.float64) * nm  # red, green, blue as three lines
BENT = 1.1255  # the first curvature, of that in the patent; the last one is off with it, by 10 %
FIELD = torch.tensor([[0.0, 0.0], [0.0, 0.12], [0.0, 0.24], [0.0, 0.33]])
CORNER, DETAIL = (0.13, 0.1), 36  # of the details: where (shares of height and width), and how large [pixels]


def triplet(*, bent: float = 1.0) -> optics.CompoundLens:
    """The Cooke triplet at a tenth of its size, its first curvature times a factor, its focal length and its sensor as
    they were. All radii train but the last.
    """
    patent = optics.CompoundLens.preset("cooke_triplet")
    surfaces = []
    for k, surface in enumerate(patent.surfaces):
        radius = (SCALE / (1 if k else bent)) / surface.curvature
        surfaces.append(
            optics.Surface(
                radius=radius if k == len(patent.surfaces) - 1 else nn.Parameter(radius),
                thickness=SCALE * surface.thickness,
                glass=surface.glass,
                semi_diameter=SCALE * surface.semi_diameter,
                stop=surface.stop,
            )
        )
    return held(optics.CompoundLens(*surfaces, sensor_distance=SCALE * patent.sensor_distance))


def held(lens: optics.CompoundLens) -> optics.CompoundLens:
    """The same lens with the last curvature that gives it its focal length: the power is linear in each of them."""
    last = lens.surfaces[-1]
    plane, bent = torch.tensor([math.inf, -2 * mm], dtype=torch.float64).unbind()
    powers = []
    for last.radius in (plane, bent):
        powers.append(1 / lens.first_order().focal_length)
    last.radius = bent * (powers[1] - powers[0]) / (1 / FOCAL_LENGTH - powers[0])
    return lens


def photograph() -> Tensor:
    """A motorcycle's colours (1, 3, H, W), linear."""
    return Scene.builtin("motorcycle", size=PICTURE).to_srgb() ** 2.2


def through(lens: optics.CompoundLens, light: Tensor) -> Tensor:
    """The picture (1, 3, H, W) of colours at infinity, each the light of one line.

    The window and the places of PSFs are the same in all steps, so that nothing but the lens changes the loss.
    """
    scene = Scene.from_bands(light, wavelengths=WAVELENGTHS, depth=math.inf)
    return optics.Imaging(lens, pixel_pitch=PITCH, psf_shape=(WINDOW, WINDOW), spacing=48)(scene)


def relative_error(picture: Tensor, sharp: Tensor) -> Tensor:
    """rms of the difference, of the rms of the light."""
    return ((picture - sharp).square().mean() / sharp.square().mean()).sqrt()


def spots(lens: optics.CompoundLens) -> Tensor:
    """rms radii of all colours' rays about their centroid, at each point of `FIELD` [m]."""
    with torch.no_grad():
        points, light = (part[:, 0].flatten(1, 2) for part in lens.spots(WAVELENGTHS, distances=math.inf, field=FIELD))
    light = (light / light.sum(1, keepdim=True))[..., None]
    return ((points - (light * points).sum(1, keepdim=True)).square() * light).sum((1, 2)).sqrt()


@dataclass(frozen=True)
class Training:
    """The lens, pictures (3, H, W) before, after and as they should be, and the losses of all steps."""

    lens: optics.CompoundLens
    before: Tensor
    after: Tensor
    sharp: Tensor
    losses: list[float]


def train(steps: int = 30, *, rate: float = 4.0, advance: Callable[[int, float], None] | None = None) -> Training:
    """rate: of Adam, in curvature [1/m]; it falls to 0 along a cosine. advance: called after each step."""
    light = photograph()
    lens = triplet(bent=BENT)
    with torch.no_grad():
        before = through(lens, light)
        sharp = light * through(lens, torch.ones_like(light))  # each point a point, as bright as the lens has it there
    # a step of a radius is one of its curvature times R^2, so that all surfaces bend alike
    radii = [{"params": [radius], "lr": rate * float(radius.detach()) ** 2} for radius in lens.parameters()]
    optimiser = torch.optim.Adam(radii, betas=(0.8, 0.95))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    losses = []
    for step in range(steps):
        loss = relative_error(through(held(lens), light), sharp)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        losses.append(loss.item())
        if advance is not None:
            advance(step, losses[-1])
    with torch.no_grad():
        return Training(held(lens), before[0], through(lens, light)[0], sharp[0], losses)


def figure(training: Training) -> Figure:
    """Pictures above, their centres and corners enlarged below."""
    pictures = {"Before": training.before, "After": training.after, "Sharp": training.sharp}
    side, gap, edge, head = 3.0, 0.06, 0.08, 0.3
    tall, detail = side * PICTURE[0] / PICTURE[1], (side - gap) / 2
    sheet = plots.Sheet(2 * edge + 3 * side + 4 * gap, head + tall + gap + detail + edge)
    for column, (name, picture) in enumerate(pictures.items()):
        image = plots.as_image(picture.clamp(0, 1) ** (1 / 2.2))
        x = edge + column * (side + 2 * gap)
        sheet.text(x, 0.08, name, weight="bold")
        sheet.picture(image, x, head, side, tall, smooth=False)
        for k, place in enumerate(((0.5, 0.5), CORNER)):
            top, left = (
                min(max(0, round(at * n) - DETAIL // 2), n - DETAIL) for at, n in zip(place, PICTURE, strict=True)
            )
            part = image[top : top + DETAIL, left : left + DETAIL]
            sheet.picture(part, x + k * (detail + gap), head + tall + gap, detail, detail, smooth=False)
    return sheet.figure


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--out", type=Path, help="a figure of the pictures before and after, such as lens.png")
    options = parser.parse_args(arguments)
    every = max(1, options.steps // 6)
    bent = triplet(bent=BENT)

    def told(step: int, loss: float) -> None:
        if step % every == 0 or step == options.steps - 1:
            print(f"step {step:3d}   loss {loss:.4f}", flush=True)

    training = train(options.steps, advance=told)
    patent = triplet()
    with torch.no_grad():
        designed = through(patent, photograph())[0]
    rows = [
        ("before", bent, training.before),
        ("after", training.lens, training.after),
        ("the patent", patent, designed),
    ]
    print(
        "\nrms spot at Y / D of " + "".join(f"{y:>8.2f}" for y in FIELD[:, 1].tolist()) + "   picture's error       f"
    )
    for name, lens, picture in rows:
        radii = "".join(f"{radius / um:5.1f} um" for radius in spots(lens).tolist())
        error = f"{relative_error(picture, training.sharp):.1%}"
        print(f"{name:<20} {radii}   {error:>15}  {lens.focal_length() / mm:.3f} mm")
    if options.out is not None:
        plots.save_figure(figure(training), options.out)
        print(f"written to {options.out}")


if __name__ == "__main__":
    main()
