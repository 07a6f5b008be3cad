"""A device that computes on the CPU but mixes with it no more than a GPU does.

`pytest --device pretend` runs the tests that take `device` on it: a tensor left on the CPU or a `.numpy()` fails here
as it would on CUDA, without one. A tensor there is a wrapper (`Away`) around one of the CPU's; every operation checks
where its tensors are, does the CPU's work, and wraps what comes out.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils import backend_registration
from torch.utils._mode_utils import no_dispatch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

NAME = "pretend"
MIXES = ("aten::copy", "aten::_to_copy", "aten::index", "aten::_index", "aten::_unsafe_index")
"""Operations that CUDA allows tensors of two devices in: copies, and indices on the CPU."""

_AT_ONCE = {
    torch.ops.aten._conj.default: torch.ops.aten.conj_physical.default,
    torch.ops.aten._neg_view.default: torch.ops.aten.neg.default,
}
"""What is done lazily elsewhere: a wrapper has no bit that says it is yet to be conjugated."""


class Away(Tensor):
    """A tensor on the pretended device; `here` holds its numbers."""

    here: Tensor

    @staticmethod
    def __new__(cls, here: Tensor) -> Away:
        return Tensor._make_wrapper_subclass(
            cls, here.shape, here.stride(), here.storage_offset(), dtype=here.dtype, device=torch.device(NAME, 0)
        )

    def __init__(self, here: Tensor) -> None:
        self.here = here

    def tolist(self) -> Any:
        """torch has none for wrappers."""
        return self.here.tolist()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class _Everywhere(TorchDispatchMode):
    """Factories have no tensor that would bring them to `Away`."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    name = func._schema.name
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    away = [tensor for tensor in tensors if isinstance(tensor, Away)]
    left = [tuple(t.shape) for t in tensors if t.dim() and not isinstance(t, Away)]
    if away and left and not name.startswith(MIXES):
        raise RuntimeError(f"{name}: tensors on two devices; on the CPU: {left}")
    device = kwargs.get("device")
    to = bool(away) if device is None else torch.device(device).type == NAME
    here = {key: tree_map(_here, value) for key, value in kwargs.items()}
    if device is not None:
        here["device"] = torch.device("cpu")
    result = _AT_ONCE.get(func, func)(*tree_map(_here, args), **here)
    written = [a for a, s in zip(args, func._schema.arguments, strict=False) if s.alias_info and s.alias_info.is_write]
    if torch.Tag.inplace_view in func.tags:  # `squeeze_`: the wrapper's shape changes too
        with no_dispatch():
            func(*args, **kwargs)
    if written and isinstance(result, Tensor):
        return written[0]
    return tree_map(lambda leaf: Away(leaf) if to and isinstance(leaf, Tensor) else leaf, result)


def _here(leaf: Any) -> Any:
    return leaf.here if isinstance(leaf, Away) else leaf


class _Module(backend_registration._DummyBackendModule):
    """What torch asks of a backend."""

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16, torch.float16]


class Generator(torch.Generator):
    """The CPU's, whatever the device."""

    def __new__(cls, device: Any = "cpu") -> Generator:
        return super().__new__(cls, "cpu")


def register() -> None:
    """Before the first backward pass, which counts the devices."""
    backend_registration._setup_privateuseone_for_python_backend(NAME, backend_module=_Module())


@contextmanager
def device() -> Iterator[torch.device]:
    """The device, usable inside of the context."""
    before = torch.Generator, torch.__future__.get_swap_module_params_on_conversion()
    torch.Generator = Generator  # type: ignore[misc]
    torch.__future__.set_swap_module_params_on_conversion(True)  # a wrapper's `data` cannot be set
    torch._C._set_only_lift_cpu_tensors(True)
    try:
        with _Everywhere():
            yield torch.device(NAME, 0)
    finally:
        torch._C._set_only_lift_cpu_tensors(False)
        torch.__future__.set_swap_module_params_on_conversion(before[1])
        torch.Generator = before[0]  # type: ignore[misc]
