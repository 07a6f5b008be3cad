"""A small set of cubes from the built-in scenes, to try the other tools on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
import typer

from kcam import Scene
from kcam.cli.console import end, progress, run
from kcam.data import Cube, write_cube

SCENES = ("astronaut", "chelsea", "coffee", "colour_chart", "motorcycle", "star")


def main(
    out: Annotated[Path, typer.Option("--out", help="folder for the cubes")],
    size: Annotated[int, typer.Option("--size", help="of a scene's longer side [pixels]")] = 400,
) -> None:
    """Write the built-in scenes as cubes: 28 bands of spectral radiance in daylight, the motorcycle with its depth."""
    out.mkdir(parents=True, exist_ok=True)
    with progress("demo cubes", len(SCENES)) as advance:
        for name in SCENES:
            scene = Scene.builtin(name, size)
            depth = scene.depth[0, 0] if isinstance(scene.depth, torch.Tensor) else None
            source = {"format": "kcam demo", "scaling": "a perfect white in D65 has Y = 1"}
            cube = Cube(
                scene.bands()[0].clamp(min=0), scene.wavelengths, "relative radiance", None, depth, name, source
            )
            write_cube(out / f"{name}.tif", cube)
            advance(name)
    end({"cubes": list(SCENES)}, [f"{len(SCENES)} cubes in {out}"], as_json=False, failed={})


if __name__ == "__main__":
    run(main)
