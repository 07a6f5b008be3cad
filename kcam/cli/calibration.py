"""The command `kcam calibrate-sensor`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kcam.cli.console import one_line_errors, progress


def calibrate_sensor(
    context: typer.Context,
    darks: Annotated[
        list[str] | None, typer.Option("--darks", help='frames without light, in pairs: a file, or "d*.tif"; repeat it')
    ] = None,
    flats: Annotated[
        list[str] | None,
        typer.Option("--flats", help='frames of even light, in pairs, dark to saturated: "f*.tif"; repeat it'),
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="the numbers, as JSON; the report stands beside it")] = Path(
        "sensor.json"
    ),
    bits: Annotated[int, typer.Option("--bits", min=0, help="of the converter; 0: as saturated pixels show")] = 0,
    pattern: Annotated[
        str, typer.Option("--pattern", help='of the colour filter: RGGB, ...; "": a monochrome sensor')
    ] = "",
    times: Annotated[
        Path | None,
        typer.Option("--times", help="a table of file,seconds; else from names (f_10ms_1.tif) or EXIF"),
    ] = None,
) -> None:
    """Calibrate a sensor from pairs of raw frames: gain, noises, fixed pattern, full well (EMVA 1288 release 4.0).

    Frames are .tif, .png or .npy of 16 bits, two of each exposure; in order of their times, where known, and names.
    """
    with one_line_errors():
        from kcam import calibration, files, plots
        from kcam.calibration import find

        if context.args:  # a shell put a pattern's files in its place; whose they are is lost
            raise ValueError(
                f"got {len(context.args)} names that follow no option, such as {context.args[0]}: the shell "
                'put the files of a pattern in its place. Put patterns in quotes: --darks "d*.tif" --flats "f*.tif".'
            )
        for option, given in (("--darks", darks), ("--flats", flats)):
            if not given:
                raise ValueError(
                    f'{option} is missing: expected pairs of raw frames, such as {option} "{option[2]}*.tif".'
                )
        if out.suffix.lower() != ".json":
            raise ValueError(f"cannot write {out.name}: its name must end in .json.")
        files.check_place(out)
        page = out.with_suffix(".html")
        plots.check_writable(page, suffixes=(".html",))
        table = None if times is None else calibration.read_times(times)
        dark_files, flat_files = find(darks or [], option="--darks"), find(flats or [], option="--flats")
        both = set(dark_files) & set(flat_files)
        if both:
            raise ValueError(f"{min(both)} is among the darks and the flats: name it once.")
        dark_pairs, dark_times = calibration.pairs(dark_files, what="darks", times=table)
        flat_pairs, flat_times = calibration.pairs(flat_files, what="flats", times=table)
        with progress("calibrate-sensor"):
            found = calibration.photon_transfer(
                flat_pairs,
                dark_pairs,
                bits=bits or None,
                pattern=pattern or None,
                exposure_times=flat_times,
                dark_times=dark_times,
            )
            found.save(out)
            calibration.save_report(found, page)
        typer.echo(f"{found}\n\n{out}\n{page}")
