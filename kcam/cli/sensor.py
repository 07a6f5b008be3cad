"""`kcam calibrate-sensor`: a sensor's constants from its frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kcam.cli.console import one_line_errors, progress


def calibrate_sensor(
    flats: Annotated[list[str], typer.Option("--flats", help='frames of an even light, in pairs: a name or "f*.tif"')],
    darks: Annotated[list[str], typer.Option("--darks", help="frames with the lens capped, in pairs, likewise")],
    out: Annotated[Path, typer.Option("--out", help="what was found, .json; beside it a report, .html")] = Path(
        "sensor.json"
    ),
    pattern: Annotated[str, typer.Option("--pattern", help="of the colour filter: RGGB, ...; none: monochrome")] = "",
    bits: Annotated[int, typer.Option("--bits", min=0, max=24, help="of the ADC; 0: what the frames need")] = 0,
    times: Annotated[
        str, typer.Option("--times", help="a table: file, seconds; else from TIFF tags, or names such as f_10ms_1.tif")
    ] = "",
) -> None:
    """Measure gain, noise, non-uniformity, full well, dark current and linearity of a sensor, by EMVA 1288.

    Raw frames of 16 bits (.tif, .png, .npy), two of each exposure, from dim to saturated. Options may be repeated.
    """
    with one_line_errors():
        from kcam import files, plots
        from kcam.calibration import frames, photon_transfer
        from kcam.report import write_report

        if out.suffix.lower() != ".json":
            raise ValueError(
                f"cannot write {out.name}: a calibration ends in .json, such as {out.with_suffix('.json')}."
            )
        files.check_place(out)
        page = out.with_suffix(".html")
        plots.check_writable(page, suffixes=(".html",))
        known = frames.read_times(times) if times else None
        with progress("calibrate-sensor"):
            dark, dark_times = frames.pairs_of(frames.expanded(darks, name="--darks"), name="darks", times=known)
            flat, flat_times = frames.pairs_of(frames.expanded(flats, name="--flats"), name="flats", times=known)
            found = photon_transfer(
                flat, dark, exposure_times=flat_times, dark_times=dark_times, pattern=pattern or None, bits=bits or None
            )
            middle = min(flat, key=lambda pair: abs(pair[0].mean() - 0.5 * max(one[0].mean() for one in flat)))
            figures = [
                ("Photon transfer and signal to noise", plots.transfer_figure(found)),
                ("Linearity", plots.linearity_figure(found)),
                ("What is fixed in the dark", plots.uniformity_figure(dark[0], title="Dark frames")),
                (
                    "What is fixed in the light",
                    plots.uniformity_figure(middle, title="Flat frames at half of the range"),
                ),
            ]
            summary = [
                (f"{name}: {quantity.replace('_', ' ')}", str(measured))
                for name, quantities in found.channels.items()
                for quantity, measured in quantities.items()
            ]
            notes = [
                f"{found.bits} bits, black level {found.black_level:.2f} DN, {found.pattern or 'no mosaic'}; "
                f"{len(flat)} pairs of flats, {len(dark)} of darks. EMVA Standard 1288, release 4.0, linear.",
                *found.notes,
            ]
            found.save(out)
            shown = [(title, figure) for title, figure in figures if figure is not None]
            write_report(page, title=f"Sensor: {out.stem}", summary=summary, figures=shown, notes=notes)
        typer.echo(f"{found}\n{out}\n{page}")
