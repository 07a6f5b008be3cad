"""A model card: what a trained camera is, for people who get its file without its story."""

from __future__ import annotations

import json
import os
import shlex
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from kcam import files

MARK = "---\nlibrary_name: kcam\n"
"""How each card begins: a file that does not is somebody else's, and is not replaced."""
LICENCES = ("mit", "apache-2.0", "cc0-1.0", "cc-by-4.0", "cc-by-sa-4.0", "cc-by-nc-4.0", "cc-by-nc-sa-4.0", "unknown")
"""Names that hubs know, of those a painting may have; another one is called other, with its text beside."""
SHOWN = ("sheet.png", "loss.png")
"""Pictures of a run's folder that a card shows, and takes along."""


@dataclass(frozen=True)
class Card:
    """What a card tells. title: its head. style: what the camera learned, and `licence` whose that is.

    facts: (name, value) of the settings. measures: rows of a table, the first of them the heads. notes: paragraphs.
    holds: whether the camera holds the painting.

    Example:
    >>> from kcam.card import Card
    >>> card = Card("A camera", style="my.png", licence=None, facts=[("steps", "3")], measures=[], notes=[])
    >>> card.text("painter.safetensors", {"sheet.png": "sheet.png"}).splitlines()[:3]
    ['---', 'library_name: kcam', 'license: unknown']
    """

    title: str
    style: str
    licence: str | None
    facts: Sequence[tuple[str, str]]
    measures: Sequence[Sequence[str]]
    notes: Sequence[str]
    holds: bool = False

    def text(self, camera: str, pictures: Mapping[str, str]) -> str:
        """Markdown, with the head that hubs read. pictures: where those of the run are found from here."""
        known = (self.licence or "unknown").lower()
        named = [f"license: {known}"] if known in LICENCES else ["license: other", f"license_name: {json.dumps(known)}"]
        head = [*MARK.splitlines(), *named, "tags: [kcam, camera, style-transfer]", "---"]
        parts = ["\n".join(head), f"# {_plain(self.title)}"]
        if "sheet.png" in pictures:
            parts.append(f"![The style, scenes, and this camera's pictures of them]({quote(pictures['sheet.png'])})")
        parts += [
            "A differentiable camera, made with kcam: optics, colour filter, noise, demosaic, tone, and if it has one "
            "what paints. It is one file of weights and JSON; no code is run to open it. This card is written anew "
            "when the camera is trained anew.",
            f"```sh\nkcam shoot photo.jpg --camera {shlex.quote(camera)} --out shot.png\n```",
            "```python\nfrom kcam import Camera, Scene\n\n"
            f'shot = Camera.load({json.dumps(camera)})(Scene.from_file("photo.jpg"))\n```',
            "## The style\n\n" + self._style(),
            "## How it was trained\n\n" + _table([("setting", "value"), *self.facts]),
        ]
        if self.measures:
            parts.append("## How near it comes\n\n" + _table(self.measures))
        if "loss.png" in pictures:
            parts.append(f"![The loss at each step]({quote(pictures['loss.png'])})")
        return "\n\n".join([*parts, *self.notes]) + "\n"

    def _style(self) -> str:
        known = (
            f"licence: {_plain(self.licence)}."
            if self.licence
            else ("licence: unknown. Say whose it is before you pass this camera on (`kcam train --licence`).")
        )
        holds = " The camera paints with pieces of it, and holds all of it in its file." if self.holds else ""
        return f"{_plain(self.style)}; {known}{holds}"


def check_own(path: str | os.PathLike[str]) -> None:
    """ValueError if there is a file of that name that is no card."""
    path = Path(path)
    if path.exists() and (path.is_dir() or not path.read_text(errors="replace").startswith(MARK)):
        raise ValueError(f"{path} is no model card of kcam's, and would be lost. Move it, or choose another --out.")


def check_folder(folder: str | os.PathLike[str], *, run: str | os.PathLike[str]) -> None:
    """Make a folder for a hub; ValueError for one that holds something else than an earlier card, or is the run's."""
    folder = Path(folder)
    inside = folder.resolve()
    if inside == Path(run).resolve() or Path(run).resolve() in inside.parents:
        raise ValueError(f"--card {folder} is the run's own folder, with checkpoints. Choose another one.")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--card {folder} is a file: expected a folder for the camera and its card.")
    if folder.is_dir() and any(folder.iterdir()):
        readme = folder / "README.md"
        if not readme.exists():
            raise ValueError(f"--card {folder} holds files and no card of kcam's: expected a new or an empty folder.")
        check_own(readme)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"--card {folder} cannot be made: {error.strerror}. Choose another folder.") from error


def write(card: Card, camera: Path, run: Path) -> Path:
    """NAME.md beside NAME.safetensors, with the pictures of the run's folder."""
    path = camera.with_suffix(".md")
    check_own(path)
    shown = {name: f"{run.name}/{name}" for name in SHOWN if (run / name).exists()}
    files.replace(path, card.text(camera.name, shown).encode(errors="replace"))
    return path


def write_folder(card: Card, camera: Path, run: Path, folder: Path) -> None:
    """A folder ready for a hub: the camera, the pictures, and README.md last. No paths of this machine."""
    check_folder(folder, run=run)
    shown = [name for name in SHOWN if (run / name).exists()]
    for source in (camera, *(run / name for name in shown)):
        with files.replacing(folder / source.name) as temporary:
            shutil.copyfile(source, temporary)
    files.replace(folder / "README.md", card.text(camera.name, {name: name for name in shown}).encode(errors="replace"))


def _table(rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(_plain(cell) for cell in row) + " |" for row in rows]
    return "\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]])


def _plain(text: str) -> str:
    """One line of a table or a head: a name may hold anything."""
    plain = "".join(c if c.isprintable() else " " for c in " ".join(str(text).split()))
    return plain.replace("\\", "\\\\").replace("|", "\\|").replace("`", "'").replace("<", "&lt;")
