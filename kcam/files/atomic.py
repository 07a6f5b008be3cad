"""Files that are whole or not there: checked before anything is computed, written beside their place."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def check_place(path: str | os.PathLike[str]) -> None:
    """ValueError where no file of that name can be: where there is a folder, or none to put it into.

    Example:
    >>> from kcam import files
    >>> files.check_place("nowhere/picture.png")
    Traceback (most recent call last):
    ValueError: cannot write picture.png: there is no folder nowhere.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"cannot write {path.name}: there is a folder of that name. Choose another name.")
    if not path.absolute().parent.is_dir():
        raise ValueError(f"cannot write {path.name}: there is no folder {path.parent}.")


def check_other(path: str | os.PathLike[str], given: str | os.PathLike[str] | None) -> None:
    """ValueError where a file that will be written is the one that is read.

    Example:
    >>> from kcam import files
    >>> plots.write_picture(torch.rand(3, 8, 8), "photo.png")
    >>> files.check_other("photo.png", "photo.png")
    Traceback (most recent call last):
    ValueError: photo.png is what is read, and would be lost. Choose another name for --out.
    """
    if given and Path(path).exists() and Path(given).exists() and Path(path).samefile(given):
        raise ValueError(f"{path} is what is read, and would be lost. Choose another name for --out.")


def replace(path: str | os.PathLike[str], content: bytes) -> None:
    """Write beside the file, then take its place: a crash or a full disk leaves the old file whole.

    Example:
    >>> from pathlib import Path
    >>> from kcam import files
    >>> files.replace("notes.txt", b"the whole of it")
    >>> Path("notes.txt").read_bytes()
    b'the whole of it'
    """
    with replacing(path) as temporary:
        temporary.write_bytes(content)


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Where to write a file that takes the place of `path` when all of it is on the disk, and not before.

    Example:
    >>> from pathlib import Path
    >>> from kcam import files
    >>> with files.replacing("notes.txt") as beside:
    ...     written = beside.write_text("the whole of it")
    >>> Path("notes.txt").read_text(), beside.exists()
    ('the whole of it', False)
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
