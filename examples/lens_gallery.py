"""Every lens from a patent: a photograph and a grid of points through it, over the field and with one PSF everywhere.

    python examples/lens_gallery.py [--out lenses.png]

Each picture is a sensor that reaches to 95 % of the field for which the lens is meant, once on few pixels, and in its
middle and its corner on pixels of a sensor with 4000 across, where the same piece of the photograph and nine points
stand.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from kcam import Camera, Scene, optics, plots
from kcam.optics.compound.presets import PRESETS
from kcam.units import mm, nm

REACH = 0.95  # of the field, in the corner
LARGE = 5.0  # wavelengths times the f-number: pixels of the whole; where they are larger a PSF has many samples
ACROSS = 4000  # pixels of the sensor whose details are shown
WHOLE, DETAIL = (160, 240), 126  # pixels that are computed of the whole, and of a detail
WAVELENGTHS = torch.linspace(430, 690, 12, dtype=torch.float64) * nm
POINT = 60.0  # times as bright as white
PIECE = (0.42, 0.62)  # of the photograph, that stands in the details (shares of height and width)
Pictures = dict[str, Tensor]


def points(height: int, width: int, *, apart: int, moved: tuple[int, int] = (0, 0)) -> Tensor:
    """Points of light on black, (1, 3, H, W), about the middle or where it is moved to."""
    light = torch.zeros(1, 3, height, width)
    down, right = (n // 2 + by for n, by in zip((height, width), moved, strict=True))
    light[..., down % apart :: apart, right % apart :: apart] = POINT
    return light


def detail_of(photograph: Tensor, side: int, *, margin: int, moved: tuple[int, int]) -> Scene:
    """The same piece of the photograph, at its own resolution, and points; with a margin, and moved."""
    whole = side + 2 * margin
    places = [round(at * n) for at, n in zip(PIECE, photograph.shape[-2:], strict=True)]
    rows, columns = (torch.arange(whole) - whole // 2 + at - by for at, by in zip(places, moved, strict=True))
    height, width = photograph.shape[-2:]
    piece = photograph[..., rows.clamp(0, height - 1), :][..., columns.clamp(0, width - 1)]
    return scene_of(piece, points(whole, whole, apart=side // 3, moved=moved))


def scene_of(photograph: Tensor, light: Tensor) -> Scene:
    """A photograph and points as a batch at infinity: their spectra are those of colours."""
    bright = light.amax().clamp(min=1)
    both = Scene.from_rgb(torch.cat([photograph, light / bright]), depth=math.inf, wavelengths=WAVELENGTHS)
    gain = torch.tensor([1.0, float(bright)])[:, None, None, None]
    return Scene(both.coefficients * gain, both.spectra, both.wavelengths, depth=math.inf, illuminant=both.illuminant)


def scaled(lens: optics.CompoundLens, factor: float) -> optics.CompoundLens:
    """A copy so many times as large, focused alike."""
    surfaces = [
        optics.Surface(
            radius=factor * surface.radius,
            thickness=factor * surface.thickness,
            glass=surface.glass,
            semi_diameter=factor * surface.semi_diameter,
            conic=surface.conic,
            asphere=[a * factor ** (-3 - 2 * k) for k, a in enumerate(surface.asphere)],
            odd_asphere=[b * factor ** (-2 * k) for k, b in enumerate(surface.odd_asphere)],
            stop=surface.stop,
        )
        for surface in lens.surfaces
    ]
    return optics.CompoundLens(*surfaces, sensor_distance=factor * lens.sensor_distance)


def photographed(
    lens: optics.CompoundLens, scene: Scene, *, pitch: float, centre: tuple[float, float], field: bool
) -> Tensor:
    """sRGB (2, 3, H, W), without mosaic and noise."""
    how: dict[str, Any] = {"spacing": DETAIL // 2} if field else {"field": False}
    imaging = optics.Imaging(lens, pixel_pitch=pitch, centre=centre, precision="float32", **how)
    with torch.no_grad():
        return Camera(imaging, *Camera.ideal())(scene)


def pictures_of(name: str, *, across: int = ACROSS, side: int = DETAIL) -> list[Pictures]:
    """Over the field, and with one PSF: the whole, its middle and its corner, each a photograph and points."""
    lens = optics.CompoundLens.preset(name)
    diagonal = 2 * float(lens.image_scale) * REACH * PRESETS[name].field
    width, height = (diagonal * n / math.hypot(*WHOLE) for n in (WHOLE[1], WHOLE[0]))
    coarse, fine = width / WHOLE[1], width / across
    photograph = Scene.builtin("motorcycle").to_srgb()
    whole = scene_of(Scene.builtin("motorcycle", size=WHOLE).to_srgb(), points(*WHOLE, apart=20))
    # a copy of the lens takes the whole, so small that diffraction is just below its pixels
    small = min(1.0, LARGE * lens.focus_wavelength * lens.f_number / coarse)
    copy = scaled(lens, small)
    # the picture's upper left corner: light falls turned about, to the right and below of the axis
    corner = (width / 2 - fine * side / 2, height / 2 - fine * side / 2)
    found = []
    for field in (True, False):
        own = {"whole": photographed(copy, whole, pitch=coarse * small, centre=(0.0, 0.0), field=field)}
        for place, centre in (("middle", (0.0, 0.0)), ("corner", corner)):
            moved = distorted(lens, centre, fine) if field else (0, 0)
            margin = max(map(abs, moved))
            scene = detail_of(photograph, side, margin=margin, moved=moved)
            picture = photographed(lens, scene, pitch=fine, centre=centre, field=field)
            own[place] = picture[..., margin : margin + side, margin : margin + side]
        found.append(own)
    return found


def distorted(lens: optics.CompoundLens, centre: tuple[float, float], pitch: float) -> tuple[int, int]:
    """Rows and columns between what falls at a place of the sensor and what would without distortion [pixels]."""
    radius = math.hypot(*centre)
    if not radius:
        return 0, 0
    heights = lens.image_heights(radius)
    away = 1 - float(heights.scale * heights.over_radius.at(torch.tensor(radius, dtype=torch.float64) ** 2))
    return round(centre[1] * away / pitch), round(centre[0] * away / pitch)


def figure(found: dict[str, list[Pictures]]) -> Figure:
    """Two lenses side by side, each a row over the field and a row with one PSF."""
    side, gap, edge, head, label = 0.86, 0.03, 0.08, 0.2, 0.2
    wide = side * WHOLE[1] / WHOLE[0]
    block = label + 2 * (wide + 2 * side) + 6 * gap
    tall = head + 2 * (side + gap) + 0.08
    rows = -(-len(found) // 2)
    sheet = plots.Sheet(2 * edge + 2 * block + 0.1, edge + rows * tall)
    for index, (name, pictures) in enumerate(found.items()):
        left, top = edge + index % 2 * (block + 0.1), edge + index // 2 * tall
        lens = optics.CompoundLens.preset(name)
        angle = math.degrees(math.atan(REACH * PRESETS[name].field))
        sheet.text(left + label, top, name, size=8.5, weight="bold")
        what = f"{lens.focal_length() / mm:.3g} mm f/{lens.f_number:.1f}, {angle:.0f} degrees in the corner"
        sheet.text(left + label + 1.0, top, what, size=7.5, colour=plots.MUTED)
        for row, (own, text) in enumerate(zip(pictures, ("over the field", "one PSF"), strict=True)):
            y = top + head + row * (side + gap)
            sheet.text(
                left + 0.14, y + side / 2, text, size=7, colour=plots.MUTED, rotation=90, va="center", ha="right"
            )
            x = left + label
            for which in (0, 1):
                for place, picture in own.items():
                    across = wide if place == "whole" else side
                    sheet.picture(plots.as_image(picture[which]), x, y, across, side, smooth=place == "whole")
                    x += across + gap
    return sheet.figure


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lenses", default=",".join(PRESETS), help=f"some of {', '.join(PRESETS)}")
    parser.add_argument("--across", type=int, default=ACROSS, help="pixels of the sensor whose details are shown")
    parser.add_argument("--out", type=Path, default=Path("lenses.png"))
    options = parser.parse_args(arguments)
    found = {}
    for name in options.lenses.split(","):
        found[name] = pictures_of(name, across=options.across)
        print(name, flush=True)
    plots.save_figure(figure(found), options.out, resolution=165)
    print(f"written to {options.out}")


if __name__ == "__main__":
    main()
