"""The commands `kcam data`: convert, inspect, extract, verify, export; the scripts of data_tools/ call them too."""

from __future__ import annotations

import re
from collections import Counter
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kcam.cli.console import INTERRUPTED, SOME_FAILED, end, progress, stop, usage

if TYPE_CHECKING:
    from rich.table import Table

    from kcam.data.readers import Options

RATE = 100e6  # bytes of patches per second and worker, roughly: for the estimate of --dry-run
app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Spectral cubes to train on: read them from public data sets or your own arrays, look at them, cut patches.",
)

FORMATS_HELP = "kcam, kaist, cave, icvl, arad1k, harvard, cassi28, envi, tiff, npy, npz, hdf5, mat, rgb"
PROFILES_HELP = "cassi28, cave31, harvard31, kaist31"
FormatOption = Annotated[
    str | None, typer.Option("--format", help=f"of the files; else as they say themselves: {FORMATS_HELP}")
]
WavelengthsOption = Annotated[
    str | None, typer.Option("--wavelengths", help="start:stop:count in nm, of files that hold none: 400:700:31")
]
ProfileOption = Annotated[str | None, typer.Option("--profile", help=f"wavelengths by name: {PROFILES_HELP}")]
KeyOption = Annotated[
    str | None, typer.Option("--key", help="name of the array inside the files; not needed where one has three axes")
]
AxesOption = Annotated[
    str | None,
    typer.Option("--axes", help="order of the axes of .npy, .npz, HDF5 and .mat arrays: hwc, chw, ...; c: the bands"),
]
OutFolder = Annotated[Path, typer.Option("--out", help="folder for <scene>.tif")]
Json = Annotated[bool, typer.Option("--json", help="print the result as JSON, for scripts")]
Report = Annotated[Path | None, typer.Option("--report", help="write the result as JSON here")]
Workers = Annotated[int, typer.Option("--workers", min=1, help="processes")]


@app.command()
def convert(
    inputs: Annotated[list[Path], typer.Argument(help="files, scene folders, or folders of scenes")],
    out: OutFolder,
    format: FormatOption = None,
    bands: Annotated[str | None, typer.Option("--bands", help="resample to start:stop:count in nm")] = None,
    wavelengths: WavelengthsOption = None,
    named: ProfileOption = None,
    key: KeyOption = None,
    axes: AxesOption = None,
    resample: Annotated[str, typer.Option("--resample", help="pchip or cubic")] = "pchip",
    edge: Annotated[str, typer.Option("--edge", help="bands beyond the source's: error, or hold and mark")] = "error",
    depth: Annotated[Path | None, typer.Option("--depth", help="folder of depth maps [m], <scene>.npy")] = None,
    workers: Workers = 1,
    as_json: Json = False,
    report: Report = None,
) -> None:
    """Convert data sets, arrays or photographs into cube files.

    Photographs are upsampled to spectra, and must be named: --format rgb. What is no scene is named, and why.
    """
    from kcam.data.bands import EDGES, METHODS, parse_bands
    from kcam.data.convert import Conversion
    from kcam.data.convert import convert as convert_all

    options = _options(format, wavelengths, named, key, axes)
    for name, value, known in (("--resample", resample, METHODS), ("--edge", edge, EDGES)):
        if value not in known:
            usage(f"{name} {value} is unknown; known: {', '.join(known)}.")
    if out.exists() and not out.is_dir():
        usage(f"--out {out} is a file, expected a folder.")
    try:
        target = parse_bands(bands) if bands else None
    except ValueError as error:
        usage(str(error))
    how = Conversion(format, options, target, resample, edge, depth)
    with progress("convert") as advance:
        found = convert_all(inputs, out, how, workers=workers, advance=advance)
    lines = [
        f"{facts['name']}: {' x '.join(map(str, facts['shape']))}, {facts['low']:.3g} to {facts['high']:.3g}"
        + (f", {facts['invalid']:.2%} invalid" if facts["invalid"] else "")
        + (f", {facts['extrapolated']} bands extrapolated and marked" if facts["extrapolated"] else "")
        for _, facts in sorted(found.written.items())
    ]
    lines.append(f"{len(found.written)} cubes in {out}")
    result = {"written": found.written}
    end(result, lines, as_json=as_json, failed=found.failed, skipped=found.skipped, report=report)


@app.command()
def inspect(
    cubes: Annotated[list[Path], typer.Argument(help="cube files, or folders of them")],
    out: Annotated[Path, typer.Option("--out", help="folder for contact_sheet.png, spectra.png and cubes.json")],
    format: FormatOption = None,
    wavelengths: WavelengthsOption = None,
    named: ProfileOption = None,
    key: KeyOption = None,
    axes: AxesOption = None,
    as_json: Json = False,
) -> None:
    """Look at cubes: contact sheet, spectra, bad bands and pixels.

    Dynamic range, noise and what else is remarkable stand in a table, and in cubes.json.
    """
    import json
    from dataclasses import asdict

    from rich.console import Console

    from kcam.data.inspection import figures
    from kcam.data.inspection import inspect as inspect_one
    from kcam.data.readers import find_scenes
    from kcam.plots import save_figure

    options = _options(format, wavelengths, named, key, axes)
    if out.exists() and not out.is_dir():
        usage(f"--out {out} is a file, expected a folder.")
    missing = [path for path in cubes if not path.exists()]
    if missing:
        usage(f"there is no file or folder {missing[0]}.")
    met = find_scenes(cubes)
    if not met.scenes:
        usage(f"there are no cubes in {', '.join(map(str, cubes))}.")
    found = []
    with progress("inspect", len(met.scenes)) as advance:
        for path in met.scenes:
            try:
                found.append(inspect_one(path, format=format, options=options))
            except (ValueError, OSError, ImportError) as error:
                met.failed[str(path)] = str(error)
            advance(path.name)
    out.mkdir(parents=True, exist_ok=True)
    if found:
        for name, figure in figures(found).items():
            save_figure(figure, out / f"{name}.png")
    facts = [asdict(findings) | {"remarks": findings.remarks()} for findings, _, _ in found]
    (out / "cubes.json").write_text(json.dumps(facts, indent=1) + "\n")
    if not as_json:
        Console(width=110).print(_table(found))
    lines = [str(path) for path in sorted(out.glob("*.*"))]
    end({"cubes": facts}, lines, as_json=as_json, failed=met.failed, skipped=met.skipped)


def _table(found: list[Any]) -> Table:
    from rich.table import Table

    from kcam.data.bands import band_text

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


@app.command()
def extract(
    cubes: Annotated[Path, typer.Argument(help="a folder of cube files or arrays, or one file")],
    out: Annotated[Path, typer.Option("--out", help="folder for the store, empty or absent")],
    size: Annotated[int, typer.Option("--size", help="of a patch [pixels]")] = 256,
    stride: Annotated[int, typer.Option("--stride", help="between patches [pixels]")] = 128,
    split: Annotated[str, typer.Option("--split", help="shares of train/val/test, by groups of scenes")] = "0.9/0.1",
    group: Annotated[
        str | None, typer.Option("--group-regex", help="names the group of a scene; (.*)_\\d+ takes its first part")
    ] = None,
    min_mean: Annotated[float, typer.Option("--min-mean", help="darker patches are left out")] = 1e-3,
    min_contrast: Annotated[float, typer.Option("--min-contrast", help="flatter patches are left out")] = 0.02,
    max_clipped: Annotated[float, typer.Option("--max-clipped", help="largest share of saturated pixels")] = 0.05,
    max_invalid: Annotated[float, typer.Option("--max-invalid", help="largest share of invalid pixels")] = 0.0,
    wavelengths: WavelengthsOption = None,
    named: ProfileOption = None,
    key: KeyOption = None,
    axes: AxesOption = None,
    workers: Workers = 1,
    resume: Annotated[bool, typer.Option("--resume", help="go on where an earlier run stopped")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="only say what would be done")] = False,
    shard: Annotated[str | None, typer.Option("--shard", help="i/n: every n-th scene from the i-th, from 1")] = None,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", help="tcp://... of a Dask scheduler; the extra kcam[dask]")
    ] = None,
    as_json: Json = False,
    report: Report = None,
) -> None:
    """Cut cubes into a store of patches to train on.

    Cube files (.tif) are cut as they are; arrays (.npy, .npz, HDF5, .mat) too where --axes, --key, --wavelengths or
    --profile says how they are read, or where there is nothing else.
    """
    from kcam.data.patches import Settings, StoreError, StoreStopped, make_plan, parse_split
    from kcam.data.patches import extract as extract_all

    options = _options(None, wavelengths, named, key, axes)
    try:
        settings = Settings(size, stride, parse_split(split), group, min_mean, min_contrast, max_clipped, max_invalid)
        part = _shard(shard)
        if not cubes.exists():
            usage(f"there is no {cubes}.")
        plan = make_plan(cubes, settings, **_readers(cubes, options))
    except StoreError as error:
        usage(str(error))
    if dry_run:
        found = Counter(job.split for job in plan.scenes)
        splits = {name: found[name] for name, _ in settings.split}  # those that stay empty too
        result: dict[str, Any] = {
            "scenes": len(plan.scenes),
            "patches": plan.most_patches,
            "bytes": plan.most_bytes,
            "seconds": plan.most_bytes / RATE / workers,
            "splits": splits,
            "plan": plan.hash,
        }
        lines = [
            f"{len(plan.scenes)} scenes ({', '.join(f'{count} {name}' for name, count in sorted(splits.items()))})",
            f"at most {plan.most_patches} patches, {plan.most_bytes / 1e9:.3g} GB, about {result['seconds']:.0f} s",
        ]
        end(result, lines, as_json=as_json, failed=plan.failed, skipped=plan.skipped, report=report)
    with progress("extract", len(plan.scenes)) as advance:

        def one(name: str, _: int) -> None:
            advance(name)

        try:
            if scheduler is None:
                outcome = extract_all(plan, out, workers=workers, resume=resume, shard=part, advance=one)
            else:
                with _client(scheduler) as client:
                    submit = partial(client.submit, pure=False)  # pure: the result of an earlier run would do
                    outcome = extract_all(plan, out, resume=resume, shard=part, advance=one, submit=submit)
        except (StoreStopped, OSError) as error:
            stop(f"{str(error).rstrip('.')}. --resume goes on.", SOME_FAILED)
        except StoreError as error:
            usage(str(error))
        except KeyboardInterrupt:
            stop("interrupted; --resume goes on.", INTERRUPTED)
    lines = [f"warning: {warning}" for warning in outcome.warnings]
    if outcome.finished and not outcome.found:
        left = ", ".join(f"{count} {reason}" for reason, count in sorted(outcome.dropped.items()) if count)
        lines.append(f"{outcome.patches} patches in {out}" + (f"; left out: {left}" if left else ""))
    elif outcome.finished:
        lines.append(f"{out} is finished already")
    else:
        lines.append(f"{len(outcome.done)} scenes done, {len(outcome.skipped)} were; --resume completes the store")
    result = {
        "done": outcome.done,
        "patches": outcome.patches,
        "dropped": outcome.dropped,
        "warnings": outcome.warnings,
        "finished": outcome.finished,
    }
    skipped = plan.skipped | dict.fromkeys(outcome.skipped, "it was done by an earlier run.")
    end(result, lines, as_json=as_json, failed=outcome.failed, skipped=skipped, report=report)


def _readers(cubes: Path, options: Options) -> dict[str, Any]:
    """What `make_plan` is told of arrays: they are read where a user says how, or where there is nothing else."""
    from kcam.data.cube import SUFFIX
    from kcam.data.readers import ARRAYS, open_source

    said = [options.axes, options.key, None if options.wavelengths is None else options.wavelengths.tolist()]
    others = cubes.suffix.lower() in ARRAYS if cubes.is_file() else not any(cubes.glob(f"*{SUFFIX}"))
    if said == [None] * 3 and not others:
        return {}
    return {"readers": dict.fromkeys(ARRAYS, partial(open_source, options=options)), "told": repr(said)}


def _client(scheduler: str) -> Any:
    try:
        from dask.distributed import Client
    except ImportError:
        usage("--scheduler needs Dask: pip install 'kcam[dask]'.")
    try:
        return Client(scheduler, timeout=30)
    except (OSError, ValueError) as error:
        usage(f"there is no Dask scheduler at {scheduler}: {(str(error).splitlines() or [''])[0]}")


def _shard(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    if not match or not 1 <= int(match[1]) <= int(match[2]):
        usage(f"shard {text!r} is not i/n with 1 <= i <= n, such as 1/8.")
    return int(match[1]), int(match[2])


@app.command()
def verify(
    store: Annotated[Path, typer.Argument(help="a patch store, or one split of it")], as_json: Json = False
) -> None:
    """Check that a patch store is as it was written.

    Every file against its sha256, and no group of scenes in two splits.
    """
    from kcam.data.patches import MANIFEST
    from kcam.data.patches import verify as problems_of

    if not store.is_dir():
        usage(f"there is no folder {store}.")
    with progress("verify") as advance:
        problems = problems_of(store, advance=advance)
    manifests = [store / MANIFEST] if (store / MANIFEST).is_file() else list(store.glob(f"*/{MANIFEST}"))
    lines = [] if problems else [f"{store}: {len(manifests)} splits, all as written"]
    failed = {f"{index + 1}": problem for index, problem in enumerate(problems)}
    end({"problems": problems}, lines, as_json=as_json, failed=failed)


@app.command()
def export(
    split: Annotated[Path, typer.Argument(help="a split of a store, such as patches/train")],
    out: Annotated[Path, typer.Option("--out", help="the file or folder to write: .h5, .hdf5 or .zarr")],
    as_json: Json = False,
) -> None:
    """Write one split of a store as HDF5 or Zarr, for other tools."""
    from kcam.data.export import export_patches
    from kcam.data.patches import StoreError

    with progress("export") as advance:
        try:
            count = export_patches(split, out, advance=advance)
        except KeyboardInterrupt:
            stop("interrupted; nothing was written.", INTERRUPTED)
        except (StoreError, OSError, ImportError) as error:
            usage(str(error))
    end({"patches": count}, [f"{count} patches in {out}"], as_json=as_json, failed={})


def _options(
    format: str | None, wavelengths: str | None, named: str | None, key: str | None, axes: str | None
) -> Options:
    """What a user says of how files are read."""
    from kcam.data.bands import parse_bands, profile
    from kcam.data.readers import FORMATS, Options

    if format is not None and format not in FORMATS:
        usage(f"--format {format} is unknown; known: {', '.join(FORMATS)}.")
    if named and wavelengths:
        usage("--profile and --wavelengths say the same thing; give one of them.")
    try:
        grid = profile(named) if named else parse_bands(wavelengths) if wavelengths else None
        return Options(grid, key, axes=axes)
    except ValueError as error:
        usage(str(error))
