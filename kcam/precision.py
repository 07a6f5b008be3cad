"""Where reduced precision would be read as light: no autocast and no shortened matrix products.

It is also where the time goes, so on a CPU no more threads take part than there are free cores.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import torch

from kcam.threads import no_more_than_free


@contextlib.contextmanager
def full_precision(device: torch.device) -> Iterator[None]:
    """No autocast, and no matrix products or convolutions of reduced precision, as torch has the latter on a GPU unless
    told: their 1e-3 would be read as light (restored on exit).

    On a CPU with no more threads than other work leaves cores: see `kcam.threads`. What runs later, such as the
    backward pass of a convolution, is as torch has it.

    torch.compile cannot trace a change of the global precision: a compiled stage takes that of its caller.
    """
    if torch.compiler.is_compiling():
        with torch.autocast(device.type, enabled=False):
            yield
        return
    switches = _switches(device)
    before = [getattr(switch, name) for switch, name, _ in switches]
    for switch, name, exact in switches:
        setattr(switch, name, exact)
    try:
        threads = no_more_than_free() if device.type == "cpu" else contextlib.nullcontext()
        with threads, torch.autocast(device.type, enabled=False):
            yield
    finally:
        for (switch, name, _), value in zip(switches, before, strict=True):
            setattr(switch, name, value)


def _switches(device: torch.device) -> list[tuple[Any, str, Any]]:
    """Where torch keeps the precision of products and convolutions on a device, and what is exact there.

    From torch 2.9 on each has its own, and to read the older ones is an error once a user has set one of these.
    """
    own: Any = torch.backends
    if hasattr(own.cudnn, "conv"):
        found = (own.cuda.matmul, own.cudnn.conv) if device.type == "cuda" else (own.mkldnn.matmul, own.mkldnn.conv)
        return [(switch, "fp32_precision", "ieee") for switch in found]
    convolutions = [(own.cudnn, "allow_tf32", False)] if device.type == "cuda" else []
    return [(_Products(), "matmul", "highest"), *convolutions]


class _Products:
    """torch's older setting of matrix products, as an attribute."""

    @property
    def matmul(self) -> str:
        return torch.get_float32_matmul_precision()

    @matmul.setter
    def matmul(self, precision: str) -> None:
        torch.set_float32_matmul_precision(precision)
