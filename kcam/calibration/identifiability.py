"""What a picture tells of a lens and what not: covariance, values that are not seen, and lenses that fit as well."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import scipy
import torch
from torch import Tensor

from kcam.calibration.levenberg_marquardt import Equations, Search, State
from kcam.calibration.trained import unit

_UNSEEN = 5.0  # scales: a value known no better than this is not seen
_INFLATED = 3e3  # times the variance that it would have if all else were known: it is another value's twin
_APART = 3.0  # standard errors between two fits: a value that is ambiguous


def covariance_of(search: Search, equations: Equations) -> tuple[Tensor, Tensor]:
    """Of the values (P, P), and by what each variance is more than if all else were known (P,)."""
    size = search.scales[search.free]
    inside = torch.linalg.inv(equations.schur() * size * size[:, None]) * size * size[:, None]
    whole, inflation = torch.diag((search.wide * search.scales) ** 2), torch.ones_like(search.scales)
    whole[search.free[:, None], search.free] = inside
    inflation[search.free] = inside.diagonal() * equations.across.diagonal()
    return whole, inflation


def unobservable(search: Search, errors: Tensor, inflation: Tensor) -> dict[str, str]:
    """Names of values that the picture does not tell, and why."""
    found = {}
    for index, name in enumerate(search.trained.names):
        if index not in search.free.tolist():
            found[name] = "no picture changes with it"
        elif bool(inflation[index] > _INFLATED):
            found[name] = "this picture changes with it as with a place, a level or another value that trains"
        elif not bool(errors[index] < _UNSEEN * search.scales[index]):
            found[name] = "to first order this picture does not change with it: another focus may show it"
    return found


def twins(search: Search, state: State) -> Iterator[State]:
    """Where the wavefront is as another one that has the same PSF, or the same edge."""
    own = search.trained.wavefront(state.values)
    if own is None:
        return

    def turned(path: Tensor) -> Tensor:
        return -path.flip(0, 1)

    ways: list[Callable[[Tensor], Tensor]] = [turned]
    if search.targets.kind == "edge":
        angle = float(state.places[0, 0])
        ways += [lambda path: _mirrored(path, angle), lambda path: -_mirrored(path, angle).flip(0, 1)]
    for way in ways:
        values = _with_wavefront(search, state.values, way(own))
        if values is not None and bool((values - state.values).abs().gt(1e-3 * search.scales).any()):
            yield State(values, state.places, math.inf)


def _with_wavefront(search: Search, values: Tensor, wanted: Tensor) -> Tensor | None:
    """Values whose wavefront comes closest to one, up to a piston and tilts."""
    side = torch.linspace(-1, 1, wanted.shape[-1], dtype=torch.float64)
    plane = [torch.ones_like(wanted), side[None, :].expand_as(wanted), side[:, None].expand_as(wanted)]
    for _ in range(3):
        try:
            now, *moved = _wavefronts(search, values)
        except ValueError:  # no such lens
            return None
        columns = torch.stack([*(path - now for path in moved), *(1e-7 * part for part in plane)])
        known = columns.isfinite().all(0) & wanted.isfinite()
        solved = scipy.linalg.lstsq(columns[:, known].T.numpy(), (wanted - now)[known].numpy(), cond=1e-6)[0]
        step = torch.from_numpy(solved)[: len(search.free)] * search.scales[search.free]
        values = values.index_add(0, search.free, step)
    return values


def _wavefronts(search: Search, values: Tensor) -> list[Tensor]:
    """At these values, and with each that acts a scale beyond."""
    steps = [search.scales[index] * unit(index, len(values)) for index in search.free.tolist()]
    found = [search.trained.wavefront(values + step) for step in (torch.zeros_like(values), *steps)]
    return [path for path in found if path is not None]


def rival_of(
    search: Search, best: State, rivals: list[State], errors: dict[str, Tensor]
) -> tuple[State, tuple[str, ...]]:
    """Of the fits that are as good the one in which most of what is seen is another, and the names of that."""

    def others(state: State) -> tuple[str, ...]:
        apart = dict(zip(search.trained.names, (state.values - best.values).abs(), strict=True))
        return tuple(name for name, error in errors.items() if bool(apart[name] > _APART * error))

    equal = [state for state in rivals if state.cost < best.cost + search.close(best.cost)]
    found = max(equal, key=lambda state: len(others(state)), default=best)
    return found, others(found)


def _mirrored(path: Tensor, angle: float) -> Tensor:
    """A map over the pupil, mirrored in the line through its middle at an angle."""
    side = torch.linspace(-1, 1, path.shape[-1], dtype=torch.float64)
    x, y = side[None, :], side[:, None]
    cos, sin = math.cos(2 * angle), math.sin(2 * angle)
    grid = torch.stack([x * cos + y * sin, x * sin - y * cos], dim=-1)
    found = torch.nn.functional.grid_sample(
        path.nan_to_num()[None, None], grid[None], mode="bicubic", align_corners=True
    )[0, 0]
    inside = (x**2 + y**2 < 0.85) if bool(path.isnan().any()) else torch.ones_like(path, dtype=torch.bool)
    return found.masked_fill(~inside, math.nan)
