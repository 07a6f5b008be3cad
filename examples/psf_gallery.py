"""A gallery of PSFs: what each element does to a point of light, from near focus to far.

    python examples/psf_gallery.py [--out psf_gallery.png]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor

from kcam import optics, plots, spectral
from kcam.units import mm, nm, um

DISTANCES = torch.tensor([1.0, 2.0, 5.0])  # m; in focus at 2 m
BANDS = torch.linspace(430, 690, 14, dtype=torch.float64) * nm
PIXELS, PITCH = 101, 3 * um


def square_grid(n: int) -> tuple[Tensor, Tensor]:
    """x and y over the aperture's bounding square, -1 to 1, at the centres of n x n pixels."""
    axis = (torch.arange(n, dtype=torch.float64) + 0.5) * 2 / n - 1
    return axis.expand(n, n), axis[:, None].expand(n, n)


def coded_aperture() -> optics.Element:
    """An open square with closed cells drawn at random."""
    cells = torch.rand(7, 7, generator=torch.Generator().manual_seed(4)) > 0.45
    return optics.ApertureMap(cells.double(), width=4 * mm)


def coma() -> optics.Element:
    """Noll's Zernike polynomial 8: 0.2 um RMS of optical path, the same at all wavelengths."""
    return optics.ZernikeAberration(torch.tensor([0, 0, 0, 0, 0, 0, 0, 0.2]) * um)


def vortex() -> optics.Element:
    """A phase that turns twice around the axis: a ring of light."""
    x, y = square_grid(256)
    return optics.DOE(2 * torch.atan2(y, x))


def cubic() -> optics.Element:
    """x^3 + y^3, the wavefront coding of Dowski and Cathey (1995): nearly the same PSF at all distances."""
    x, y = square_grid(256)
    return optics.DOE(15 * (x**3 + y**3))


ROUND = optics.CircularAperture(4 * mm)
LENSES: dict[str, Callable[[], list[optics.Element]]] = {
    "perfect lens": lambda: [ROUND, optics.ThinLens(50 * mm)],
    "N-BK7 singlet": lambda: [ROUND, optics.PlanoConvexLens(25.8 * mm, glass="N-BK7")],
    "obstruction": lambda: [optics.AnnularAperture(4 * mm, obscuration=0.6), optics.ThinLens(50 * mm)],
    "coded aperture": lambda: [coded_aperture(), optics.ThinLens(50 * mm)],
    "coma": lambda: [ROUND, optics.ThinLens(50 * mm), coma()],
    "vortex DOE": lambda: [ROUND, optics.ThinLens(50 * mm), vortex()],
    "cubic DOE": lambda: [ROUND, optics.ThinLens(50 * mm), cubic()],
}


def gallery(*, pixels: int = PIXELS) -> list[Tensor]:
    """Pictures (distances, 3, H, W) for each lens: its PSFs in daylight, each to its own peak, square root shown."""
    weights = spectral.xyz_weights(BANDS, "D65")
    columns = []
    for make in LENSES.values():
        lens = optics.Lens(*make(), focus_distance=2.0)
        psf = lens.psf(BANDS, distances=DISTANCES, pixel_pitch=PITCH, shape=(pixels, pixels)).double()
        colours = spectral.xyz_to_linear_srgb(torch.einsum("dlhw,lc->dchw", psf, weights)).clamp(min=0)
        columns.append((colours / colours.amax((-3, -2, -1), keepdim=True)) ** (0.5 / 1.1))
    return columns


def figure(columns: list[Tensor]) -> Figure:
    """A column for each lens, a row for each distance."""
    side, gap, left, top = 1.2, 0.05, 0.5, 0.38
    width, height = left + len(columns) * (side + gap) + gap, top + len(DISTANCES) * (side + gap) + gap
    sheet = plots.Sheet(width, height)
    for column, (name, pictures) in enumerate(zip(LENSES, columns, strict=True)):
        x = left + column * (side + gap)
        sheet.text(x + side / 2, top - 0.09, name, ha="center", va="bottom")
        for row, picture in enumerate(pictures):
            sheet.picture(plots.as_image(picture), x, top + row * (side + gap), side, side)
    for row, distance in enumerate(DISTANCES.tolist()):
        y = top + row * (side + gap) + side / 2
        sheet.text(left - 0.09, y, plots.metres(distance), ha="right", va="center")
    return sheet.figure


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pixels", type=int, default=PIXELS, help="width of each window")
    parser.add_argument("--out", type=Path, default=Path("psf_gallery.png"))
    options = parser.parse_args(arguments)
    plots.save_figure(figure(gallery(pixels=options.pixels)), options.out)
    print(options.out)


if __name__ == "__main__":
    main()
