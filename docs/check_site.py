"""What a built site must keep: no link, picture or anchor that leads nowhere, and a text for every picture.

python docs/check_site.py [docs/_build/html]
"""

from __future__ import annotations

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

OURS = ("start", "learn", "do", "understand", "gallery", "reference", "index.html")
"""Parts of the site that are checked; not the source listings."""


class Page(HTMLParser):
    """Links, anchors, and pictures without a text, of one page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.without_text: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attributes}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        self.links += [values[name] for name in ("href", "src") if values.get(name)]
        if tag == "img" and not values.get("alt", "").strip():
            self.without_text.append(values.get("src", ""))


def problems(site: Path) -> list[str]:
    """What is wrong, a line each."""
    known: dict[Path, Page] = {}
    found = []
    for path in sorted(site.rglob("*.html")):
        name = path.relative_to(site)
        if name.parts[0] not in OURS:
            continue
        page = known.setdefault(path, Page(path))
        found += [f"{name}: {source} has no alt text" for source in page.without_text]
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.exists():
                found.append(f"{name}: {link} leads nowhere")
            elif parts.fragment and target.suffix == ".html":
                anchors = known.setdefault(target, Page(target)).anchors
                if unquote(parts.fragment) not in anchors:
                    found.append(f"{name}: {link} has no such place")
    return found


if __name__ == "__main__":
    lines = problems(Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent / "_build" / "html"))
    sys.stdout.write("".join(f"{line}\n" for line in dict.fromkeys(lines)))
    raise SystemExit(bool(lines))
