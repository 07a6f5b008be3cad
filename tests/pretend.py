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
from torch.overrides import TorchFunctionMode
from torch.utils import backend_registration
from torch.utils._mode_utils import no_dispatch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

NAME = "pretend"
COPIES = ("aten::copy", "aten::copy_", "aten::_to_copy")
INDEXED = ("aten::index", "aten::_unsafe_index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_")
"""Operations that CUDA lets a device's tensor have indices of the CPU in."""
JOINED = ("aten::cat", "aten::stack")
"""Others take a number of the CPU's, of no dimension, beside a device's tensors."""

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


class _Draws(TorchFunctionMode):
    """Refuses a generator of another device: behind this, torch forgets whose object one is."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        device = torch.device(kwargs.get("device") or (NAME if _any_away((args, kwargs)) else "cpu")).type
        for leaf in tree_leaves((args, kwargs)):
            if isinstance(leaf, torch._C.Generator) and leaf.device.type != device:
                raise RuntimeError(f"a generator on {leaf.device} for what is on {device}")
        return func(*args, **kwargs)


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    _refuse_mixes(func._schema.name, args, kwargs)
    device = kwargs.get("device")
    to = _any_away((args, kwargs)) if device is None else torch.device(device).type == NAME
    here = {key: tree_map(_here, value) for key, value in kwargs.items()}
    if device is not None:
        here["device"] = torch.device("cpu")
    result = _AT_ONCE.get(func, func)(*tree_map(_here, args), **here)
    written = [a for a, s in zip(args, func._schema.arguments, strict=False) if s.alias_info and s.alias_info.is_write]
    if torch.Tag.inplace_view in func.tags and isinstance(args[0], Away):  # `squeeze_`: the wrapper's shape changes too
        with no_dispatch():
            func(*args, **kwargs)
    if written and isinstance(result, Tensor):
        return written[0]
    return tree_map(lambda leaf: Away(leaf) if to and isinstance(leaf, Tensor) else leaf, result)


def _refuse_mixes(name: str, args: Any, kwargs: dict[str, Any]) -> None:
    """RuntimeError for tensors of two devices, where CUDA raises one."""
    counted = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    if name in INDEXED:
        counted = [args[0], *args[2:3]]
    away = [tensor for tensor in counted if isinstance(tensor, Away)]
    left = [t for t in counted if not isinstance(t, Away) and (t.dim() or name in JOINED)]
    if name not in COPIES and away and left:
        raise RuntimeError(f"{name}: tensors on two devices; on the CPU: {[tuple(tensor.shape) for tensor in left]}")
    if name in INDEXED and not isinstance(args[0], Away) and _any_away(args[1:]):
        raise RuntimeError(f"{name}: a tensor on the CPU is indexed by one on {NAME}")


def _any_away(tree: Any) -> bool:
    return any(isinstance(leaf, Away) for leaf in tree_leaves(tree))


def _here(leaf: Any) -> Any:
    return leaf.here if isinstance(leaf, Away) else leaf


class _Module(backend_registration._DummyBackendModule):
    """What torch asks of a backend."""

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16, torch.float16]


class Generator(torch.Generator):
    """One of the CPU's, which knows the device that it was made for."""

    def __new__(cls, device: Any = "cpu") -> Generator:
        return super().__new__(cls, "cpu")

    def __init__(self, device: Any = "cpu") -> None:
        self._asked = torch.device(device)

    @property
    def device(self) -> torch.device:  # type: ignore[override]
        return self._asked


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
        with _Everywhere(), _Draws():
            yield torch.device(NAME, 0)
    finally:
        torch._C._set_only_lift_cpu_tensors(False)
        torch.__future__.set_swap_module_params_on_conversion(before[1])
        torch.Generator = before[0]  # type: ignore[misc]
