"""Dying at a chosen change of the disk, in this process: what a kill or a power cut would leave behind."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


class Killed(BaseException):
    """Nothing in the library may catch it."""


BOUNDARIES = ("replace", "rename", "fsync", "mkdir", "unlink", "rmdir")


class Death:
    """Dies at the n-th call that changes the disk, before or after it; from then on nothing changes the disk."""

    def __init__(self, patch: pytest.MonkeyPatch, number: int, *, after: bool) -> None:
        self.left, self.after, self.dead = number, after, False
        for name in BOUNDARIES:
            patch.setattr(os, name, self.guard(getattr(os, name)))

    def guard(self, call):
        def guarded(*arguments, **named):
            if self.dead:
                raise Killed
            self.left -= 1
            if self.left >= 0:
                return call(*arguments, **named)
            self.dead = True
            if self.after:
                call(*arguments, **named)
            self.last()
            raise Killed

        return guarded

    def last(self) -> None:
        """What else happens at that moment."""


class PowerCut(Death):
    """Files that were not put on the disk by then are cut to half their length, under whatever name they have."""

    def __init__(self, patch: pytest.MonkeyPatch, number: int, *, after: bool, folder: Path) -> None:
        self.folder, self.safe = folder, {path.stat().st_ino for path in self.files(folder)}
        fsync = os.fsync

        def noted(descriptor: int) -> None:
            fsync(descriptor)
            self.safe.add(os.fstat(descriptor).st_ino)

        patch.setattr(os, "fsync", noted)
        super().__init__(patch, number, after=after)

    @staticmethod
    def files(folder: Path) -> list[Path]:
        return [path for path in folder.rglob("*") if path.is_file()]

    def last(self) -> None:
        for path in self.files(self.folder):
            if path.stat().st_ino not in self.safe:
                os.truncate(path, path.stat().st_size // 2)
