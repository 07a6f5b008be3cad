"""Check a patch store: every file against what was written, and no group of scenes in two splits."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from common import Json, end, run, usage

from kcam.data.patches import MANIFEST, verify


def main(
    store: Annotated[Path, typer.Argument(help="a patch store, or one split of it")], as_json: Json = False
) -> None:
    """Check a patch store: every file against what was written, and no group of scenes in two splits."""
    if not store.is_dir():
        usage(f"there is no folder {store}.")
    problems = verify(store)
    manifests = [store / MANIFEST] if (store / MANIFEST).is_file() else list(store.glob(f"*/{MANIFEST}"))
    lines = [] if problems else [f"{store}: {len(manifests)} splits, all as written"]
    failed = {f"{index + 1}": problem for index, problem in enumerate(problems)}
    end({"problems": problems}, lines, as_json=as_json, failed=failed)


if __name__ == "__main__":
    run(main)
