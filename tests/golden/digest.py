"""What is kept of an answer, so that any change of its values shows: projections, not all numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from golden.question import Scaled
from torch import Tensor

WHOLE = 24
"""A tensor of at most so many numbers is kept as it is."""
PROJECTIONS = 16
TOLERANCES = {"float32": 1e-6, "float64": 1e-12}
DIGITS = {"float32": 9, "float64": 16}
PLAIN_TOLERANCE = 1e-9
"""Of plain numbers: float64 results and estimates."""


def digest(value: Any) -> Any:
    """A tensor as shape, dtype, norm, sum and values or projections; all else as plain values of JSON."""
    if isinstance(value, Scaled):
        return digest(value.value) | {"scale": float(f"{value.scale:.3g}")}
    if isinstance(value, Tensor):
        return _of_tensor(value.detach())
    if isinstance(value, dict):
        return {str(key): digest(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [digest(part) for part in value]
    return value


def _of_tensor(value: Tensor) -> dict[str, Any]:
    flat = _flat(value)
    whole = len(flat) <= WHOLE
    dtype = str(value.dtype).removeprefix("torch.")
    numbers = [float(np.linalg.norm(flat)), float(flat.sum()), *(flat if whole else signs(len(flat)) @ flat).tolist()]
    norm, total, *rest = (float(f"{number:.{DIGITS.get(dtype, 17)}g}") for number in numbers)
    name = "values" if whole else "projections"
    return {"shape": list(value.shape), "dtype": dtype, "norm": norm, "sum": total, name: rest}


def _flat(value: Tensor) -> np.ndarray:
    if value.is_complex():
        value = torch.view_as_real(value)
    return value.double().cpu().flatten().numpy()


def signs(count: int) -> np.ndarray:
    """Rows of random signs, the same on every machine: the root mean square of a difference's products with them is its
    norm, give or take a fifth, wherever in the tensor it lies. Unit vectors would hide it by the root of the count.
    """
    return np.random.RandomState(count).randint(0, 2, (PROJECTIONS, count)) * 2.0 - 1.0


def differences(kept: Any, found: Any, path: str = "") -> Iterator[tuple[float, str]]:
    """What is another now, as (times its tolerance, in words): kept and found are digests."""
    if isinstance(kept, dict) and "dtype" in kept and isinstance(found, dict):
        yield from _of_tensors(kept, found, path)
    elif isinstance(kept, dict) and isinstance(found, dict) and kept.keys() == found.keys():
        for key in kept:
            yield from differences(kept[key], found[key], f"{path}.{key}" if path else key)
    elif isinstance(kept, list) and isinstance(found, list) and len(kept) == len(found):
        for index, pair in enumerate(zip(kept, found, strict=True)):
            yield from differences(*pair, f"{path}[{index}]")
    elif isinstance(kept, float) and isinstance(found, float) and not (math.isnan(kept) and math.isnan(found)):
        off = 0.0 if kept == found else abs(found - kept) / max(abs(kept), 1e-300)
        times = math.inf if math.isnan(off) else off / PLAIN_TOLERANCE
        yield times, f"{path}: was {kept:.12g}, is {found:.12g}, {off:.1e} of it off"
    elif type(kept) is not type(found) or (kept != found and not isinstance(kept, float)):
        yield math.inf, f"{path}: was {kept!r}, is {found!r}"


def _of_tensors(kept: dict[str, Any], found: dict[str, Any], path: str) -> Iterator[tuple[float, str]]:
    for name in ("shape", "dtype"):
        if kept[name] != found.get(name):
            yield math.inf, f"{path}: {name} was {kept[name]}, is {found.get(name)}"
            return
    off = relative_difference(kept, found)
    tolerance = TOLERANCES.get(kept["dtype"])
    times = off / tolerance if tolerance else math.inf if off else 0.0
    yield times, f"{path}: {kept['dtype']}, {off:.1e} of its norm {kept['norm']:.4g} off"


def relative_difference(kept: dict[str, Any], found: dict[str, Any]) -> float:
    """The norm of the difference of two tensors relative to the first's, or what their norms and sums say if that is
    more; NaN and inf must stand where they stood.
    """
    name = "values" if "values" in kept else "projections"
    old, new = np.array(kept[name], dtype=float), np.array(found[name], dtype=float)
    if not np.array_equal(np.isfinite(old), np.isfinite(new)):
        return math.inf
    finite = np.isfinite(old)
    if not np.array_equal(old[~finite], new[~finite], equal_nan=True):
        return math.inf
    step = new[finite] - old[finite]
    norms = [float(np.linalg.norm(step)) / (1 if name == "values" else math.sqrt(PROJECTIONS))]
    if finite.all():
        norms.append(abs(found["norm"] - kept["norm"]))
        norms.append(abs(found["sum"] - kept["sum"]) / math.sqrt(max(1, math.prod(kept["shape"]))))
    worst = max(norms)
    if worst == 0:
        return 0.0
    scale = kept["norm"] if math.isfinite(kept["norm"]) else float(np.linalg.norm(old[finite]))
    scale = max(scale, kept.get("scale", 0.0))
    return worst / scale if scale else math.inf
