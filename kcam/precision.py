"""Where reduced precision would be read as light: no autocast and no shortened matrix products.

It is also where the time goes, so on a CPU no more threads take part than there are free cores.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch

from kcam.threads import no_more_than_free


@contextlib.contextmanager
def full_precision(device: torch.device) -> Iterator[None]:
    """No autocast, and no matrix products or convolutions of reduced precision, as torch has the latter on a GPU unless
    told: their 1e-3 would be read as light (restored on exit).

    On a CPU with no more threads than other work leaves cores: see `kcam.threads`.

    torch.compile cannot trace a change of the global precision: a compiled stage takes that of its caller.
    """
    if torch.compiler.is_compiling():
        with torch.autocast(device.type, enabled=False):
            yield
        return
    before = torch.get_float32_matmul_precision(), torch.backends.cudnn.allow_tf32
    torch.set_float32_matmul_precision("highest")
    if device.type == "cuda":
        torch.backends.cudnn.allow_tf32 = False
    try:
        threads = no_more_than_free() if device.type == "cpu" else contextlib.nullcontext()
        with threads, torch.autocast(device.type, enabled=False):
            yield
    finally:
        torch.set_float32_matmul_precision(before[0])
        torch.backends.cudnn.allow_tf32 = before[1]
