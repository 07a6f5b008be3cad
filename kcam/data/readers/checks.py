"""What a header shows before anything is read: sizes that no cube has, promises that no file can keep."""

from __future__ import annotations

from collections.abc import Iterable
from math import prod

from kcam.data.cube import MOST_VALUES, CubeError

_SLACK = 2**26  # bytes that a header may promise in any case


def check_size(shape: Iterable[int], what: str = "its array") -> tuple[int, ...]:
    """A shape as it stands in a header; CubeError for one that no cube has."""
    sizes = tuple(int(size) for size in shape)
    if not 1 <= prod(max(size, 0) for size in sizes) <= MOST_VALUES:
        raise CubeError(f"{what} says it is {' x '.join(map(str, sizes))}: no cube has that size.")
    return sizes


def check_promise(promised: int, stored: int, what: str = "its header") -> None:
    """CubeError where a header promises far more than its bytes can hold: no picture compresses to a 64th."""
    if promised > 64 * stored + _SLACK:
        raise CubeError(f"{what} promises {promised / 1e6:.0f} MB in {stored / 1e6:.3g} MB of data: it is damaged.")


def lacking(wanted: str, names: Iterable[str]) -> CubeError:
    """The error of a file that lacks what was asked for."""
    return CubeError(f"it has no {wanted}, only {', '.join(names) or 'nothing'}.")
