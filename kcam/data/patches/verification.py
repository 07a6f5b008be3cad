"""Whether a store is as it was written."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from kcam.data.patches.manifest import MANIFEST, WORK, read_manifest, scene_array, sha256
from kcam.data.patches.plan import StoreError, split_of


def verify(store: str | os.PathLike[str], *, advance: Callable[[str, int], None] | None = None) -> list[str]:
    """What is wrong with a store, or with one split of it, a line each; nothing where all files are as written.

    Every file against its sha256, none missing and none too many (but run logs, *.log), all splits there and of one
    plan, every group of scenes in the split that its name's hash says and in no other.

    Args:      advance: told of each scene that was read, and how many there are.

    Example:
    >>> data.write_cube("wall.tif", data.Cube(torch.rand(8, 64, 64), torch.linspace(420, 700, 8) * nm, "reflectance"))
    >>> done = data.extract(data.make_plan(".", data.Settings(size=32, stride=32)), "patches")
    >>> data.verify("patches")  # nothing is wrong
    []
    """
    store = Path(store)
    one = (store / MANIFEST).is_file()
    folders = [store] if one else sorted(path.parent for path in store.glob(f"*/{MANIFEST}"))
    problems = []
    if (store / WORK).exists():
        problems.append(f"{store} is not finished: go on with kcam data extract --resume.")
    if not folders:
        return [*problems, f"{store} holds no {MANIFEST}: it is no patch store."]
    groups: dict[str, str] = {}
    known = {folder / MANIFEST for folder in folders}
    documents = {}
    for folder in folders:
        try:
            documents[folder] = read_manifest(folder)
        except (StoreError, OSError) as error:
            problems.append(str(error))
    count = sum(len(document["scenes"]) for document in documents.values())
    for folder, document in documents.items():
        split, shares = document["split"], document["settings"]["split"]
        if not one and split != folder.name:
            problems.append(f"{folder} holds the split {split}.")
        for record in document["scenes"]:
            known.add(folder / record["file"])
            group = record["group"]
            other = groups.setdefault(group, split)
            if other != split:
                problems.append(f"the group {group} stands in {other} and in {split}.")
            elif split_of(group, shares) != split:
                problems.append(f"the group {group} stands in {split} and belongs to {split_of(group, shares)}.")
            problems += _file_problems(folder, document, record)
            if advance is not None:
                advance(record["scene"], count)
    if not one:
        expected = {name for document in documents.values() for name, _ in document["settings"]["split"]}
        missing = sorted(name for name in expected if not (store / name / MANIFEST).is_file())
        problems += [f"{store / name} has no {MANIFEST}." for name in missing]
    if len({document["plan"] for document in documents.values()}) > 1:
        problems.append("the splits are of different plans.")
    if len(documents) == len(folders):  # else, all that a damaged manifest speaks of would be too much
        for path in sorted(store.rglob("*")):
            inside = WORK in path.relative_to(store).parts
            if path not in known and not inside and path.suffix != ".log" and not path.is_dir():
                problems.append(f"{path} is in no manifest.")
    return problems


def _file_problems(folder: Path, document: dict[str, Any], record: dict[str, Any]) -> list[str]:
    try:
        scene_array(folder, document, record)
        digest = sha256(folder / record["file"])
    except (StoreError, OSError) as error:
        return [str(error)]
    if digest != record["sha256"]:
        return [f"{folder / record['file']} is not what was written: its sha256 differs."]
    return []
