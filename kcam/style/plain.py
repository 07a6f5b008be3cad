"""Plain values as JSON, every float to its last bit; what JSON has no number for is {"float": "nan"}, "inf" or "-inf".

A tuple comes back as a list.
"""

from __future__ import annotations

import json
import math
from typing import Any


def to_json(document: dict[str, Any]) -> bytes:
    """The document as text, for a person too. Raises: TypeError for what would not come back as it was."""
    return (json.dumps(_plain(document, "document"), indent=1, allow_nan=False) + "\n").encode()


def from_json(held: bytes) -> Any:
    """What `to_json` wrote."""
    return json.loads(held, object_hook=lambda found: float(found["float"]) if found.keys() == {"float"} else found)


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
