"""Texts for sphinx-gallery's small pictures, which it leaves without: the title that stands below each."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes

TITLE = re.compile(r'<div class="sphx-glr-thumbnail-title">(.*?)</div>', re.DOTALL)


def setup(app: Any) -> dict[str, bool]:
    """Sphinx's hook."""

    def read(app: Any, tree: nodes.document) -> None:
        waiting: nodes.image | None = None
        for node in tree.findall(lambda node: isinstance(node, (nodes.image, nodes.raw))):
            if isinstance(node, nodes.image):
                waiting = None if node.get("alt") else node
            elif waiting is not None and (title := TITLE.search(node.astext())):
                waiting["alt"], waiting = " ".join(title[1].split()), None

    app.connect("doctree-read", read)
    return {"parallel_read_safe": True}
