"""Processes that work for this one: Ctrl-C is this one's to hear, and they end with it, however it ends."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, connection, get_context, parent_process
from threading import Thread
from typing import Any


class Workers(ProcessPoolExecutor):
    """A pool whose processes never hear Ctrl-C; leaving its `with` by an error ends them at once."""

    def __init__(self, count: int) -> None:
        self._others = active_children()
        super().__init__(count, mp_context=get_context("spawn"), initializer=_begin)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        with _deaf():
            return super().submit(fn, *args, **kwargs)

    def __exit__(self, kind: type[BaseException] | None, *error: Any) -> bool | None:
        if kind is not None:
            self.shutdown(wait=False, cancel_futures=True)
            for child in active_children():
                if child not in self._others:
                    child.terminate()
        return super().__exit__(kind, *error)


@contextmanager
def _deaf() -> Iterator[None]:
    """Processes that are started in here inherit a blocked SIGINT: they are deaf before Python's first line runs in
    them, where `_begin` comes after seconds of imports. (Windows knows no such mask.)
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin() -> None:
    """A worker that outlives its parent would wait for work forever."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:

        def end() -> None:
            connection.wait([parent.sentinel])
            os._exit(1)

        Thread(target=end, daemon=True).start()
