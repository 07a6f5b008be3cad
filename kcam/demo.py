"""The demonstration: built-in scenes through two cameras, as pictures and figures that show every step."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import torch

from kcam import isp, optics, plots, sensor
from kcam.camera import Camera
from kcam.scene import Scene
from kcam.units import mm, nm, um

DISTANCE = 2.3
"""Of the flat scenes, and of the singlet's focus, which puts the motorcycle's tank into it [m]."""

SCENES: dict[str, tuple[str, tuple[float, float]]] = {
    "motorcycle": ("Motorcycle, with depth", (0.345, 0.72)),
    "coffee": ("Coffee", (0.72, 0.61)),
    "chelsea": ("Chelsea", (0.38, 0.385)),
    "colour_chart": ("Colour chart: 24 measured reflectances", (0.39, 0.53)),
}
"""Built-in scene -> what to call it, and where to look closely (shares of height and width)."""


def singlet() -> Camera:
    """A camera with one simple lens: plano-convex N-BK7, f = 50 mm at f/10, with its colour errors."""
    lens = optics.Lens(
        optics.CircularAperture(diameter=5 * mm),
        optics.PlanoConvexLens(radius_of_curvature=25.8 * mm, glass="N-BK7"),
        focus_distance=DISTANCE,
    )
    return Camera(
        optics.Imaging(lens, pixel_pitch=4 * um),
        sensor.ColourFilter.kodak(infrared_cut=680 * nm),
        sensor.Mosaic("RGGB"),
        sensor.Exposure(),
        sensor.ShotNoise(full_well=10_000),
        sensor.ReadNoise(3.0),
        sensor.ADC(bits=12),
        isp.Demosaic(),
        isp.WhiteBalance(),
        isp.ColourMatrix(),
        isp.ToneCurve(),
    )


CAMERAS: dict[str, tuple[str, Callable[[], Camera]]] = {
    "phone": ("Phone: 4.3 mm f/1.8, pixels of 1.4 \u00b5m, 10 bits", Camera.phone),
    "singlet": ("Singlet: one plano-convex lens, 50 mm f/10, pixels of 4 \u00b5m, 12 bits", singlet),
}
STEPS = len(CAMERAS) * (len(SCENES) + 1) + 1


def run(
    out: str | os.PathLike[str], *, seed: int = 0, size: int | None = None, advance: Callable[[str], None] | None = None
) -> list[Path]:
    """Photograph the built-in scenes with both cameras.

    Args:      out: folder; made if it is missing.
               seed: of the noise.
               size: longer side of the scenes [pixels]; None for their own.
               advance: called after each of `STEPS` steps with what was done.
    Returns:   the files written: an overview, a figure per scene and camera, a PSF figure per camera, and the pictures.
    Raises:    ValueError if a file stands where the folder should.
    """
    out = Path(out)
    try:
        (out / "pictures").mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise ValueError(f"cannot make the folder {out}: there is a file in its place. Choose a folder.") from error
    advance = advance or (lambda what: None)
    cameras = {name: make() for name, (_, make) in CAMERAS.items()}
    paths, rows = [], []
    with torch.no_grad():
        for scene_name, (scene_title, zoom) in SCENES.items():
            scene = Scene.builtin(scene_name, size=size)
            if not isinstance(scene.depth, torch.Tensor):
                scene = scene.with_depth(DISTANCE)
            rows.append([scene.to_srgb()[0]])
            for name, camera in cameras.items():
                generator = torch.Generator().manual_seed(seed)
                taken = list(plots.steps(camera, scene, generator=generator))
                picture = taken[-1].signal
                rows[-1].append(picture[0])
                figure = plots.pipeline_figure(
                    camera, scene, taken, title=f"{scene_title}, through the {name}", zoom=zoom
                )
                paths += [out / f"{scene_name}-{name}.png", out / "pictures" / f"{scene_name}-{name}.png"]
                plots.save_figure(figure, paths[-2])
                plots.write_picture(picture[0], paths[-1])
                advance(f"{scene_name} through {name}")
        for name, camera in cameras.items():
            paths.append(out / f"psf-{name}.png")
            plots.save_figure(plots.psf_figure(camera[0], title=CAMERAS[name][0].split(":")[0]), paths[-1])
            advance(f"PSFs of {name}")
        titles = ["Scene", *(title.split(":")[0] for title, _ in CAMERAS.values())]
        paths.insert(0, out / "overview.png")
        sheet = plots.contact_sheet(rows, titles=titles, labels=[title for title, _ in SCENES.values()])
        plots.save_figure(sheet, paths[0])
        advance("overview")
    return paths
