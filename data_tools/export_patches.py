"""Write one split of a patch store as HDF5 or Zarr, for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from common import INTERRUPTED, Json, end, progress, run, stop, usage

from kcam.data.export import export_patches
from kcam.data.patches import StoreError


def main(
    split: Annotated[Path, typer.Argument(help="a split of a store, such as patches/train")],
    out: Annotated[Path, typer.Option("--out", help="the file or folder to write: .h5, .hdf5 or .zarr")],
    as_json: Json = False,
) -> None:
    """Write one split of a patch store as HDF5 or Zarr, for other tools."""
    with progress("export", 0) as advance:
        try:
            count = export_patches(split, out, advance=advance)
        except KeyboardInterrupt:
            stop("interrupted; nothing was written.", INTERRUPTED)
        except (StoreError, OSError, ImportError) as error:
            usage(str(error))
    end({"patches": count}, [f"{count} patches in {out}"], as_json=as_json, failed={})


if __name__ == "__main__":
    run(main)
