"""Convert spectral cubes of public data sets, or photographs, into cube files: one TIFF per scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from common import Json, Workers, end, progress, run, usage

from kcam.data import FORMATS, PROFILES
from kcam.data.bands import EDGES, METHODS, parse_bands, profile
from kcam.data.convert import Conversion, convert
from kcam.data.readers import Options


def main(
    inputs: Annotated[list[Path], typer.Argument(help="files, scene folders, or folders of scenes")],
    out: Annotated[Path, typer.Option("--out", help="folder for <scene>.tif")],
    format: Annotated[str | None, typer.Option("--format", help=f"of the inputs: {', '.join(FORMATS)}")] = None,
    bands: Annotated[str | None, typer.Option("--bands", help="resample to start:stop:count in nm")] = None,
    wavelengths: Annotated[
        str | None, typer.Option("--wavelengths", help="start:stop:count in nm, of files that hold none")
    ] = None,
    named: Annotated[str | None, typer.Option("--profile", help=f"wavelengths by name: {', '.join(PROFILES)}")] = None,
    key: Annotated[str | None, typer.Option("--key", help="name of the array inside the files")] = None,
    resample: Annotated[str, typer.Option("--resample", help=" or ".join(METHODS))] = "pchip",
    edge: Annotated[str, typer.Option("--edge", help="bands beyond the source's: error, or hold and mark")] = "error",
    depth: Annotated[Path | None, typer.Option("--depth", help="folder of depth maps [m], <scene>.npy")] = None,
    workers: Workers = 1,
    as_json: Json = False,
    report: Annotated[Path | None, typer.Option("--report", help="write the result as JSON here")] = None,
) -> None:
    """Convert spectral cubes of public data sets, or photographs (--format rgb), into cube files."""
    for name, value, known in (
        ("--format", format, FORMATS),
        ("--resample", resample, METHODS),
        ("--edge", edge, EDGES),
    ):
        if value is not None and value not in known:
            usage(f"{name} {value} is unknown; known: {', '.join(known)}.")
    if named and wavelengths:
        usage("--profile and --wavelengths say the same thing; give one of them.")
    if out.exists() and not out.is_dir():
        usage(f"--out {out} is a file, expected a folder.")
    try:
        grid = profile(named) if named else parse_bands(wavelengths) if wavelengths else None
        target = parse_bands(bands) if bands else None
    except ValueError as error:
        usage(str(error))
    how = Conversion(format, Options(grid, key), target, resample, edge, depth)
    with progress("convert", 0) as advance:
        found = convert(inputs, out, how, workers=workers, advance=advance)
    lines = [
        f"{facts['name']}: {' x '.join(map(str, facts['shape']))}, {facts['low']:.3g} to {facts['high']:.3g}"
        + (f", {facts['invalid']:.2%} invalid" if facts["invalid"] else "")
        + (f", {facts['extrapolated']} bands extrapolated and marked" if facts["extrapolated"] else "")
        for _, facts in sorted(found.written.items())
    ]
    lines.append(f"{len(found.written)} cubes in {out}")
    end({"written": found.written}, lines, as_json=as_json, failed=found.failed, report=report)


if __name__ == "__main__":
    run(main)
