"""Results that are kept while what they were computed from has not changed - by value, so never stale."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn


def fingerprint(module: nn.Module) -> tuple[Any, ...]:
    """Everything that a module's result can depend on: its parameters and buffers by value, and its plain attributes.

    Version counters and addresses would be cheaper, but `.data`, `.to()`, a load or a copy change values behind them.
    """
    plain = tuple(
        (name, key, value)
        for name, part in module.named_modules()
        for key, value in sorted(vars(part).items())
        if key != "training" and isinstance(value, bool | int | float | str | tuple | None)
    )
    tensors = tuple(t.detach().clone() for t in (*module.parameters(), *module.buffers()))
    return (plain, *tensors)


class ValueCache:
    """One result and the values that it was computed from."""

    def __init__(self) -> None:
        self._key: tuple[Any, ...] | None = None
        self._value: Any = None

    def get(self, key: tuple[Any, ...], build: Callable[[], Any]) -> Any:
        """The kept result if `key` (tensors and plain values) equals the kept one, else a new one.

        Nothing that carries a graph is kept, nor mixed between inference mode and outside, where autograd refuses it.
        """
        key = (*key, torch.is_inference_mode_enabled())
        if self._key is not None and _equal(self._key, key):
            return self._value
        value = build()
        if not _carries_graph(value):
            self._key, self._value = key, value
        return value

    def __deepcopy__(self, memo: dict[int, Any]) -> ValueCache:
        return ValueCache()

    def __getstate__(self) -> dict[str, Any]:
        return {"_key": None, "_value": None}


def _equal(a: Any, b: Any) -> bool:
    if isinstance(a, Tensor) or isinstance(b, Tensor):
        same_kind = isinstance(a, Tensor) and isinstance(b, Tensor) and a.device == b.device and a.dtype == b.dtype
        return same_kind and a.shape == b.shape and bool(torch.equal(a, b))
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(_equal(x, y) for x, y in zip(a, b, strict=True))
    return type(a) is type(b) and a == b


def _carries_graph(value: Any) -> bool:
    if isinstance(value, Tensor):
        return value.requires_grad
    return isinstance(value, tuple | list) and any(_carries_graph(v) for v in value)
