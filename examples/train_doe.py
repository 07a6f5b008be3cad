"""Train a diffractive element for depth of field: a point should stay a point from near to far.

    python examples/train_doe.py [--steps 30] [--out doe.png]

The loss is the light that misses the central 3 x 3 pixels, at the distance where most of it does.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from torch import Tensor

from kcam import optics, plots
from kcam.units import mm, nm, um

DISTANCES = torch.tensor([0.8, 1.0, 1.4, 2.0, 3.5])  # m: -1.0 to +1.0 waves of defocus around the focus
WINDOW = 33
WAVELENGTHS = [500 * nm, 550 * nm, 600 * nm]


def make_lens(phase: Tensor) -> optics.Lens:
    """A perfect lens of 20 mm at f/6.8 in focus at 1.3 m, and a DOE of flat pixels in its aperture."""
    return optics.Lens(
        optics.CircularAperture(diameter=3 * mm),
        optics.ThinLens(focal_length=20 * mm),
        optics.DOE(phase, design_wavelength=550 * nm, glass="fused silica"),
        focus_distance=1.3,
    )


def psf_of(lens: optics.Lens) -> Tensor:
    """(distances, wavelengths, rows, columns)."""
    return lens.psf(WAVELENGTHS, distances=DISTANCES, pixel_pitch=4 * um, shape=(WINDOW, WINDOW))


def light_in_the_middle(psf: Tensor) -> Tensor:
    """Share of the light in the central 3 x 3 pixels, (distances,): the mean over the wavelengths."""
    middle = slice(WINDOW // 2 - 1, WINDOW // 2 + 2)
    return psf[..., middle, middle].sum((-2, -1)).mean(1)


def train(steps: int = 30, *, learning_rate: float = 0.4) -> tuple[Tensor, Tensor, list[float]]:
    """PSFs before and after, and the loss of each step."""
    generator = torch.Generator().manual_seed(0)
    phase = torch.nn.Parameter(0.1 * torch.randn(64, 64, generator=generator))  # radians; flat is a saddle point
    lens = make_lens(phase)
    optimiser = torch.optim.Adam([phase], lr=learning_rate)
    with torch.no_grad():
        before = psf_of(lens)
    losses = []
    for _ in range(steps):
        shares = light_in_the_middle(psf_of(lens))
        loss = 1 + torch.logsumexp(-30 * shares, dim=0) / 30  # a smooth minimum, so that the worst distance counts
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    with torch.no_grad():
        return before, psf_of(lens), losses


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--out", type=Path, help="a figure of the PSFs before and after, such as doe.png")
    options = parser.parse_args(arguments)
    before, after, losses = train(options.steps)
    last = len(losses) - 1
    for step in sorted({*range(0, last, max(1, len(losses) // 6)), last}):
        print(f"step {step:3d}   loss {losses[step]:.4f}")
    print("\nlight in the central 3 x 3 pixels")
    old, new = light_in_the_middle(before), light_in_the_middle(after)
    for index, distance in enumerate(DISTANCES.tolist()):
        print(f"{distance:4.1f} m   {old[index]:5.1%}  ->  {new[index]:5.1%}")
    print(f"worst    {old.min():5.1%}  ->  {new.min():5.1%}")
    if options.out is not None:
        # blue, green, red light to a picture, each distance to its own peak, square root shown
        rows = [[(picture.flip(0) / picture.max()).sqrt() for picture in psf] for psf in (before, after)]
        titles = [f"{distance:g} m" for distance in DISTANCES.tolist()]
        plots.save_figure(plots.contact_sheet(rows, titles=titles, labels=["before", "after"]), options.out)
        print(f"written to {options.out}")


if __name__ == "__main__":
    main()
