"""Scripts that run for longer than twenty seconds: `make docs-all` runs them, and their pages are committed with the
hash of the script, by which sphinx-gallery knows that it need not run them, and `check` that they are of this script.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

SCRIPTS, PAGES = Path("recipes", "long"), Path("do", "recipes", "long")
"""Under docs/: where they are, and where sphinx-gallery puts their pages."""


def check(docs: Path) -> None:
    """RuntimeError where the committed page of a long script is missing or not of this script."""
    if os.environ.get("KCAM_DOCS_ALL"):
        return
    for script in sorted((docs / SCRIPTS).glob("plot_*.py")):
        kept = docs / PAGES / f"{script.name}.md5"
        if not kept.exists() or kept.read_text().strip() != digest(script):
            raise RuntimeError(f"{kept.relative_to(docs)} is not of {script.relative_to(docs)}: run make docs-all.")


def digest(script: Path) -> str:
    """As sphinx-gallery has it: MD5 of the text with Unix line ends."""
    return hashlib.md5(script.read_text().encode(), usedforsecurity=False).hexdigest()
