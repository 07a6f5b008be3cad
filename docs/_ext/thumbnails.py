"""Texts for the pictures of sphinx-gallery's overviews, which it leaves without: the title that stands below each."""

from __future__ import annotations

import re
from typing import Any

ENTRY = re.compile(r"(\n\s*:alt:)[ \t]*(\n.*?<div class=\"sphx-glr-thumbnail-title\">(.*?)</div>)", re.DOTALL)


def setup(app: Any) -> dict[str, bool]:
    """Sphinx's hook."""

    def read(app: Any, name: str, source: list[str]) -> None:
        if "sphx-glr-thumbcontainer" in source[0]:
            source[0] = ENTRY.sub(lambda m: f"{m[1]} {' '.join(m[3].split())}{m[2]}", source[0])

    app.connect("source-read", read)
    return {"parallel_read_safe": True}
