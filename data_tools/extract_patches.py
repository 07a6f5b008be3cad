"""Cut a folder of cube files into a store of patches to train on."""

from __future__ import annotations

import re
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from common import INTERRUPTED, SOME_FAILED, Json, Workers, end, progress, run, stop, usage

from kcam.data.patches import Settings, StoreError, StoreStopped, extract, make_plan, parse_split

RATE = 100e6  # bytes of patches per second and worker, roughly: for the estimate of --dry-run


def main(
    cubes: Annotated[Path, typer.Argument(help="a folder of cube files, or one file")],
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
    workers: Workers = 1,
    resume: Annotated[bool, typer.Option("--resume", help="go on where an earlier run stopped")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="only say what would be done")] = False,
    shard: Annotated[str | None, typer.Option("--shard", help="i/n: every n-th scene from the i-th, from 1")] = None,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", help="tcp://... of a Dask scheduler; the extra kcam[dask]")
    ] = None,
    as_json: Json = False,
    report: Annotated[Path | None, typer.Option("--report", help="write the result as JSON here")] = None,
) -> None:
    """Cut a folder of cube files into a store of patches to train on."""
    try:
        settings = Settings(size, stride, parse_split(split), group, min_mean, min_contrast, max_clipped, max_invalid)
        part = _shard(shard)
        if not cubes.exists():
            usage(f"there is no {cubes}.")
        plan = make_plan(cubes, settings)
    except StoreError as error:
        usage(str(error))
    if dry_run:
        splits = Counter(job.split for job in plan.scenes)
        result = {
            "scenes": len(plan.scenes),
            "patches": plan.most_patches,
            "bytes": plan.most_bytes,
            "seconds": plan.most_bytes / RATE / workers,
            "splits": dict(splits),
            "plan": plan.hash,
        }
        lines = [
            f"{len(plan.scenes)} scenes ({', '.join(f'{count} {name}' for name, count in sorted(splits.items()))})",
            f"at most {plan.most_patches} patches, {plan.most_bytes / 1e9:.3g} GB, about {result['seconds']:.0f} s",
        ]
        end(result, lines, as_json=as_json, failed=plan.failed, report=report)
    with progress("extract", len(plan.scenes)) as advance:

        def one(name: str, _: int) -> None:
            advance(name, len(plan.scenes))

        try:
            if scheduler is None:
                outcome = extract(plan, out, workers=workers, resume=resume, shard=part, advance=one)
            else:
                with _client(scheduler) as client:
                    submit = partial(client.submit, pure=False)  # pure: the result of an earlier run would do
                    outcome = extract(plan, out, resume=resume, shard=part, advance=one, submit=submit)
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
        "skipped": outcome.skipped,
        "patches": outcome.patches,
        "dropped": outcome.dropped,
        "warnings": outcome.warnings,
        "finished": outcome.finished,
    }
    end(result, lines, as_json=as_json, failed=outcome.failed, report=report)


def _client(scheduler: str):
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
        raise StoreError(f"shard {text!r} is not i/n with 1 <= i <= n, such as 1/8.")
    return int(match[1]), int(match[2])


if __name__ == "__main__":
    run(main)
