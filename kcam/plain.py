"""Plain values as JSON, written to the last bit, and read as what was expected or refused: all that is in our files.

What JSON has no number for is {"float": "nan"}, "inf" or "-inf". A tuple is written as a list.
"""

from __future__ import annotations

import dataclasses
import json
import math
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

LARGEST = 2**1023
"""Whole numbers from here on are no floats."""


def to_json(document: dict[str, Any]) -> bytes:
    """The document as text, for a person too. Raises: TypeError for what would not come back as it was."""
    return (json.dumps(_plain(document, "document"), indent=1, allow_nan=False) + "\n").encode()


def number(found: dict[str, Any]) -> Any:
    """{"float": "inf"} and the like as the float that it stands for, any other dict as it is."""
    return float(found["float"]) if found.keys() == {"float"} else found


def from_json(
    held: bytes | str,
    expected: Any = Any,
    *,
    wrong: str,
    fix: str = "",
    error: type[ValueError] = ValueError,
    hook: Callable[[dict[str, Any]], Any] | None = number,
) -> Any:
    """What a JSON text says, where it is of the type that is expected: the one way in which kcam reads metadata.

    Args:      held: the text.  expected: as for `fitting`.
               wrong, fix: how the error begins and ends, with the file's name: "x.json is damaged", "Save it again."
               hook: what each dict in it becomes, as for `json.loads`.
    Raises:    `error` for text that is no JSON, is too deeply nested or not of this type.
    """
    try:
        return fitting(json.loads(held, object_hook=hook), expected)
    except RecursionError:
        reason = "it is nested too deeply"
    except (ValueError, TypeError) as found:
        reason = str(found)
    raise error(f"{wrong}: {reason}.{fix and ' '}{fix}") from None


def fitting(value: Any, expected: Any, where: str = "") -> Any:
    """A value of the expected type; lists become tuples, and dicts dataclasses, where those are expected.

    Args:      expected: Any, None, a class, X | Y, Literal, list[X], tuple[X, ...], tuple[X, Y], dict[str, X], a
               dataclass, which has its keys and no other, or a TypedDict, which has at least its keys. An int is a
               float, but a bool is no int. Of what else there is in typing (protocols, variables) nothing is expected.
    Raises:    ValueError that says where what else stands.
    """
    place = where or "it"
    origin, inside = typing.get_origin(expected), typing.get_args(expected)
    if origin in (typing.Union, types.UnionType):
        for kind in inside:
            try:
                return fitting(value, kind, where)
            except ValueError:
                continue
    elif typing.is_typeddict(expected) or (_is_record(expected) and not isinstance(value, expected)):
        if isinstance(value, dict):
            kinds = typing.get_type_hints(expected)
            missing = sorted(_required(expected) - value.keys())
            more = sorted(value.keys() - kinds.keys()) if _is_record(expected) else []
            if missing or more:
                what = f"has no {missing[0]!r}" if missing else f"has {more[0]!r}, which it should not have"
                raise ValueError(f"{place} {what}")
            found = {key: fitting(value[key], kind, join(where, key)) for key, kind in kinds.items() if key in value}
            return expected(**found) if _is_record(expected) else value | found
    elif origin in (list, tuple, Sequence):
        if isinstance(value, (list, tuple)):
            each = inside if origin is tuple and inside[-1:] != (...,) else inside[:1] * len(value)
            if len(each) == len(value):
                pairs = enumerate(zip(value, each, strict=True))
                items = (fitting(item, kind, f"{where}[{index}]") for index, (item, kind) in pairs)
                return list(items) if origin is list else tuple(items)
    elif origin in (dict, Mapping):
        if isinstance(value, dict):
            return {key: fitting(item, inside[1], join(where, key)) for key, item in value.items()}
    elif origin is typing.Literal:
        if value in inside:
            return value
    elif _is_one(value, expected):
        return value
    raise ValueError(f"{place} is {_short(value)}, expected {_name(expected)}")


def _is_record(expected: Any) -> bool:
    return isinstance(expected, type) and dataclasses.is_dataclass(expected)


def _is_one(value: Any, expected: Any) -> bool:
    if expected is None:
        return value is None
    if expected is Any or not isinstance(expected, type) or getattr(expected, "_is_protocol", False):
        return True
    if expected is float:
        return isinstance(value, float) or (_is_one(value, int) and abs(value) < LARGEST)
    if expected is torch.Size:
        return isinstance(value, (list, tuple))
    return isinstance(value, expected) and not (expected is int and isinstance(value, bool))


def _required(expected: Any) -> frozenset[str]:
    """The keys without which it is no such thing."""
    if typing.is_typeddict(expected):
        return expected.__required_keys__
    given = (dataclasses.MISSING, dataclasses.MISSING)
    return frozenset(f.name for f in dataclasses.fields(expected) if (f.default, f.default_factory) == given)


def join(where: str, key: str | int) -> str:
    """The place of a key within a place."""
    return f"{where}.{key}" if where else str(key)


def _name(expected: Any) -> str:
    kinds = typing.get_args(expected)
    if typing.get_origin(expected) in (typing.Union, types.UnionType):
        return " or ".join(map(_name, kinds))
    if typing.is_typeddict(expected) or _is_record(expected):
        return f"names and values, as of a {expected.__name__}"
    return "null" if expected in (None, type(None)) else expected.__name__ if not kinds else str(expected)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _plain(value: Any, where: str) -> Any:
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else {"float": str(float(value))}
    if isinstance(value, (list, tuple)):
        return [_plain(item, f"{where}[{index}]") for index, item in enumerate(value)]
    if isinstance(value, dict) and all(isinstance(key, str) for key in value) and value.keys() != {"float"}:
        return {key: _plain(item, f"{where}[{key!r}]") for key, item in value.items()}
    expected = 'None, bool, int, float, str, list, tuple, or dict with str keys (and not the one key "float")'
    raise TypeError(f"cannot save {where}: {value!r} is a {type(value).__name__}, and must be {expected}.")
