"""The command `kcam report`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from kcam.cli.console import CAMERAS, one_line_errors, progress


def report(
    camera: Annotated[str, typer.Argument(help=CAMERAS)],
    out: Annotated[Path, typer.Option("--out", help="the page to write: .html")] = Path("report.html"),
    size: Annotated[
        str, typer.Option("--size", help="of the sensor, height x width [pixels], for the field: 3000x4000")
    ] = "",
    json: Annotated[Path | None, typer.Option("--json", help="also write the numbers, as .json")] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, max=2**63 - 1, help="of the noise")] = 0,
) -> None:
    """Measure what a camera is worth: MTF50, SNR, dynamic range, colour, distortion, shading, noise power, PSFs."""
    with one_line_errors():
        from kcam import analysis, files, plots
        from kcam.cli import open_camera

        plots.check_writable(out, suffixes=(".html",))
        if json is not None:
            files.check_place(json)
            files.check_other(json, out)
        shape = None
        if size:
            match = re.fullmatch(r"\s*(\d+)\s*[x,]\s*(\d+)\s*", size)
            if not match or not int(match[1]) * int(match[2]):
                raise ValueError(f'size "{size}" is no height x width in pixels: expected e.g. --size 3000x4000.')
            shape = (int(match[1]), int(match[2]))
        stages = open_camera(camera)
        with progress("report", analysis.STEPS) as advance:
            found = analysis.report(stages, name=Path(camera).stem, size=shape, seed=seed, advance=advance)
        found.save(out)
        if json is not None:
            found.to_json(json)
        for what, value, method in found.table()[1:]:
            why = f", {method}" if value == "not measured" else ""
            typer.echo(f"{what}: {value}{why}")
        typer.echo(out)
