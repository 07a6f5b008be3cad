"""What torch.compile is told of our functions, without importing the compiler until something is compiled.

torch.compiler's own decorators import it where they are applied: 1.9 s at every `import kcam`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch._compile import _disable_dynamo

Function = TypeVar("Function", bound=Callable[..., Any])


def uncompiled(function: Function) -> Function:
    """As torch.compiler.disable: a graph breaks at the function, and neither it nor what it calls is traced."""
    broken = _disable_dynamo(function)

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        return (broken if torch.compiler.is_compiling() else function)(*arguments, **named)

    return call  # type: ignore[return-value]


def constant(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compute once per argument; to torch.compile a constant, where a bare lru_cache makes it warn and trace inside.

    As torch.compiler.assume_constant_result, which sets this mark.
    """
    cached = functools.lru_cache(function)
    marked: Any = functools.wraps(function)(lambda *arguments: cached(*arguments))
    marked._dynamo_marked_constant = True
    return marked
