"""A training run's checkpoints: whole or not there, whenever the process dies. One process owns the folder.

    folder/step-000500/tensors.safetensors  state.json  MANIFEST.json     the last few, and the best

A checkpoint is written beside its place, put on the disk, and renamed: `step-N` is there when all of it is. Its
manifest holds the size and the sha256 of the others; what does not match is set aside as `.corrupt-step-N-...`, and the
one before is used. Nothing is pickled. `.tmp-...` and `.old-...` are what a dead process left; the next clears it up.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import shutil
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

import torch
from safetensors import SafetensorError
from safetensors.torch import load as from_bytes
from safetensors.torch import save as to_bytes
from torch import Tensor

from kcam.plain import from_json, to_json

FORMAT = 1
"""Version of the layout: raised when an older kcam could no longer read what a newer one writes."""
MANIFEST = "MANIFEST.json"
DTYPES = {torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.bool, torch.uint8, torch.int8, torch.int16}
DTYPES |= {torch.int32, torch.int64}


@dataclass(frozen=True)
class Checkpoint:
    """What was saved at one step, read and checked; the tensors are on the CPU and depend on no file."""

    step: int
    tensors: dict[str, Tensor]
    document: dict[str, Any]
    path: Path
    best: bool


class _Damaged(ValueError):
    """A checkpoint is not what was written."""


class _File(TypedDict):
    size: int
    sha256: str


_Files = TypedDict("_Files", {"tensors.safetensors": _File, "state.json": _File})


class _Manifest(TypedDict):
    format: int
    step: int
    best: bool
    files: _Files
    sha256: str


class Checkpoints:
    """The checkpoints in one folder, which is made if need be.

    Args:      folder: of this run alone.
               keep: how many of the last ones stay, at least 1; the best stays besides.
    """

    def __init__(self, folder: str | os.PathLike[str], *, keep: int = 3) -> None:
        if isinstance(keep, bool) or not isinstance(keep, int) or keep < 1:
            raise ValueError(f"keep must be a whole number of at least 1, got {keep!r}. Use keep=3.")
        self.folder, self.keep = Path(folder), keep
        if self.folder.exists() and not self.folder.is_dir():
            raise ValueError(f"{folder} is a file, and checkpoints need a folder. Choose another name.")
        self.folder.mkdir(parents=True, exist_ok=True)
        self._clear_up()

    def steps(self) -> list[int]:
        """The steps that have a checkpoint, ascending; none of them is checked yet."""
        numbers = (int(path.name[5:]) for path in self.folder.iterdir() if re.fullmatch(r"step-\d{6,}", path.name))
        return sorted({number for number in numbers if self._path(number).exists()})

    def save(self, step: int, *, tensors: Mapping[str, Tensor], document: dict[str, Any], best: bool = False) -> Path:
        """Write a checkpoint, then remove all but the last `keep` and the newest that was saved as the best.

        A step that is saved again, as after a resume, takes the place of the one there, and stays the best if that was.

        Raises:    ValueError, TypeError for what cannot be written, or a step before one that is there: before anything
                   is written. OSError, on a full disk: all is as it was.
        """
        if isinstance(step, bool) or not isinstance(step, int) or step < 0:
            raise ValueError(f"step must be a whole number of at least 0, got {step!r}. Use step=0 for the start.")
        newest = max(self.steps(), default=step)
        if newest > step:
            raise ValueError(
                f"cannot save step {step}: {self.folder} already holds step {newest}. If the run went back, call "
                f"discard(after={step}) first; if it is another run, give it another folder."
            )
        files = {"tensors.safetensors": _tensors(tensors), "state.json": to_json(document)}
        there = self._newest([step] if self._path(step).exists() else [])
        manifest = {
            "format": FORMAT,
            "step": step,
            "best": bool(best or (there and there.best)),
            "files": {name: {"size": len(held), "sha256": _sha256(held)} for name, held in files.items()},
        }
        files[MANIFEST] = to_json(manifest | {"sha256": _sha256(to_json(manifest))})
        temporary = self.folder / f".tmp-step-{step:06d}-{secrets.token_hex(4)}"
        try:
            temporary.mkdir()
            for name, held in files.items():
                _write(temporary / name, held)
            _sync(temporary)
            if there:
                there.path.rename(self.folder / f".old-{there.path.name}-{secrets.token_hex(4)}")
            temporary.rename(self._path(step))
            _sync(self.folder)
            self._prune()
        finally:
            self._clear_up()
        return self._path(step)

    def latest(self, *, before: int | None = None) -> Checkpoint | None:
        """The newest whole checkpoint, of a step less than `before` if that is given; None if there is none.

        A damaged one is set aside, with a warning that says which and why.
        """
        steps = (step for step in reversed(self.steps()) if before is None or step < before)
        return self._newest(steps)

    def best(self) -> Checkpoint | None:
        """The newest whole checkpoint that was saved as the best; None if there is none."""
        steps = (step for step in reversed(self.steps()) if self._is_best(step))
        return self._newest(steps)

    def discard(self, *, after: int) -> None:
        """Remove the checkpoints of later steps than this, the newest first: the run has gone back to it."""
        for step in reversed(self.steps()):
            if step > after:
                self._remove(self._path(step))

    def _path(self, step: int) -> Path:
        return self.folder / f"step-{step:06d}"

    def _newest(self, steps: Iterable[int]) -> Checkpoint | None:
        """The first whole one of these."""
        for step in steps:
            path = self._path(step)
            try:
                return _read(path, step)
            except _Damaged as damage:
                aside = path.with_name(f".corrupt-{path.name}-{secrets.token_hex(4)}")
                path.rename(aside)
                warnings.warn(f"checkpoint {path} is damaged: {damage}. It is now {aside.name}.", stacklevel=3)
        return None

    def _is_best(self, step: int) -> bool:
        try:
            return _manifest(self._path(step), step)["best"]
        except _Damaged:
            return False

    def _prune(self) -> None:
        steps = self.steps()
        best = next((step for step in reversed(steps) if self._is_best(step)), None)
        for step in steps[: -self.keep]:
            if step != best:
                self._remove(self._path(step))

    def _clear_up(self) -> None:
        for path in self.folder.iterdir():
            place = self.folder / path.name[len(".old-") :].rpartition("-")[0]
            if path.name.startswith(".old-step-") and not place.exists():
                path.rename(place)  # died between two renames: what was to be replaced is all there is
            elif path.name.startswith((".tmp-", ".old-step-")):
                self._remove(path)

    def _remove(self, path: Path) -> None:
        """Out of sight at once: half a checkpoint must not be met as one."""
        gone = path.with_name(f".tmp-gone-{secrets.token_hex(4)}")
        path.rename(gone)
        shutil.rmtree(gone)


def _manifest(path: Path, step: int) -> _Manifest:
    """The manifest of a checkpoint, which vouches for itself."""
    try:
        held = (path / MANIFEST).read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        raise _Damaged(f"it has no {MANIFEST}") from None
    manifest: _Manifest = from_json(held, _Manifest, wrong=f"its {MANIFEST} cannot be read", error=_Damaged)
    if manifest["sha256"] != _sha256(to_json({key: value for key, value in manifest.items() if key != "sha256"})):
        raise _Damaged(f"its {MANIFEST} is not what was written")
    if manifest["format"] > FORMAT:
        raise ValueError(f"{path} has format {manifest['format']}; this kcam reads up to format {FORMAT}. Update kcam.")
    if manifest["step"] != step:
        raise _Damaged(f"it is the checkpoint of step {manifest['step']}")
    return manifest


def _read(path: Path, step: int) -> Checkpoint:
    manifest = _manifest(path, step)
    held: dict[str, bytes] = {}
    files: Any = manifest["files"]
    for name in _Files.__annotations__:
        expected: _File = files[name]
        try:
            held[name] = (path / name).read_bytes()
        except FileNotFoundError:
            raise _Damaged(f"it has no {name}") from None
        if len(held[name]) != expected["size"]:
            raise _Damaged(f"its {name} has {len(held[name])} bytes of {expected['size']}")
        if _sha256(held[name]) != expected["sha256"]:
            raise _Damaged(f"its {name} is not what was written: its sha256 differs")
    document = from_json(held["state.json"], dict[str, Any], wrong="its state.json cannot be read", error=_Damaged)
    try:
        tensors = from_bytes(held["tensors.safetensors"])
    except SafetensorError as error:
        raise _Damaged(f"its tensors.safetensors cannot be read: {error}") from error
    return Checkpoint(step, tensors, document, path, manifest["best"])


def _tensors(tensors: Mapping[str, Tensor]) -> bytes:
    for name, tensor in tensors.items():
        if not isinstance(name, str) or name == "__metadata__":
            raise ValueError(f"cannot save the tensor {name!r}: its name must be a str, not __metadata__. Rename it.")
        if not isinstance(tensor, Tensor) or tensor.layout != torch.strided or tensor.dtype not in DTYPES:
            what = f"{tensor.layout} of {tensor.dtype}" if isinstance(tensor, Tensor) else f"a {type(tensor).__name__}"
            raise TypeError(f"cannot save {name!r}: it is {what}, and must be a dense tensor of real numbers or bool.")
    plain = torch.contiguous_format  # a copy each: safetensors takes neither strides nor shared memory
    return to_bytes({name: tensor.detach().cpu().clone(memory_format=plain) for name, tensor in tensors.items()})


def _sha256(held: bytes) -> str:
    return hashlib.sha256(held).hexdigest()


def _write(path: Path, held: bytes) -> None:
    with path.open("wb") as file:
        file.write(held)
        file.flush()
        os.fsync(file.fileno())


def _sync(folder: Path) -> None:
    """Put the names in a folder on the disk, where a folder can be opened for that (not on Windows)."""
    if os.name == "posix":
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)
