"""Look at cubes before training on them: contact sheet, spectra, bad bands and pixels, dynamic range."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from common import Json, end, progress, run, usage
from rich.console import Console
from rich.table import Table

from kcam.data.bands import band_text
from kcam.data.inspection import figures, inspect
from kcam.data.readers import scenes_in
from kcam.plots import save_figure


def main(
    cubes: Annotated[list[Path], typer.Argument(help="cube files, or folders of them")],
    out: Annotated[Path, typer.Option("--out", help="folder for contact_sheet.png, spectra.png and cubes.json")],
    as_json: Json = False,
) -> None:
    """Contact sheet, spectra, bad bands and pixels, dynamic range: pictures and a table."""
    if out.exists() and not out.is_dir():
        usage(f"--out {out} is a file, expected a folder.")
    try:
        paths = [path for given in cubes for path in scenes_in(given)]
    except OSError as error:
        usage(str(error))
    if not paths:
        usage(f"there are no cubes in {', '.join(map(str, cubes))}.")
    found, failed = [], {}
    with progress("inspect", len(paths)) as advance:
        for path in paths:
            try:
                found.append(inspect(path))
            except (ValueError, OSError, ImportError) as error:
                failed[str(path)] = str(error)
            advance(path.name, len(paths))
    out.mkdir(parents=True, exist_ok=True)
    if found:
        for name, figure in figures(found).items():
            save_figure(figure, out / f"{name}.png")
    facts = [asdict(findings) | {"remarks": findings.remarks()} for findings, _, _ in found]
    (out / "cubes.json").write_text(json.dumps(facts, indent=1) + "\n")
    if not as_json:
        Console(width=110).print(_table(found))
    end({"cubes": facts}, [str(path) for path in sorted(out.glob("*.*"))], as_json=as_json, failed=failed)


def _table(found: list) -> Table:
    table = Table(box=None)
    for name in ("cube", "size", "bands", "median", "99 %", "stops", "noise", "remarks"):
        table.add_column(name, justify="left" if name in ("cube", "remarks", "bands") else "right")
    for findings, _, _ in found:
        _, height, width = findings.shape
        table.add_row(
            findings.name,
            f"{height} x {width}",
            band_text(findings.wavelengths),
            f"{findings.middle:.3g}",
            f"{findings.high:.3g}",
            f"{findings.stops:.1f}",
            f"{findings.noise:.2%}",
            "; ".join(findings.remarks()),
        )
    return table


if __name__ == "__main__":
    run(main)
