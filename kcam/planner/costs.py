"""What a plan costs: counts of operations times rates, measured once on a machine by `kcam calibrate`."""

from __future__ import annotations

import json
import math
import os
import statistics
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from time import perf_counter
from typing import Any, TypedDict

import numpy as np
import scipy
import torch

from kcam import files, measure, optics
from kcam.effects import Work
from kcam.optics.propagation.row import Propagator
from kcam.plain import from_json
from kcam.scene import Scene
from kcam.sensor import ColourFilter
from kcam.units import mm, um

RATES: dict[str, float] = {row.kind: row.rate for row in optics.PROPAGATORS.values()} | {
    "map": 1.2e-08,
    "bank": 6e-3,
    "psf": 3.5e-4,
    "field": 8e-2,
    "field psf": 2e-3,
    "field point": 1e-8,
    "transform": 1.5e-10,
    "product": 3e-10,
    "touch": 6e-10,
    "large": 1.6e-8,
    "layer": 8e-4,
}
"""Kind of work -> seconds for one operation, on the machine where the defaults were measured (one core, float32).

Those of the rows of `optics.PROPAGATORS`: an operation as `Propagator.cost` counts it. map: a pixel of a DOE at a
wavelength. bank, psf: a call, and each wavelength in it. field, field psf, field point: a picture over the field of a
real lens, a PSF of one of its places, and a point of what that is computed on. transform: n log2(n) of a real FFT of n
points. product: a multiplication and addition in a convolution without FFT. touch: one pass over a number. large: a
number of a picture of more than a megapixel, once if in tiles. layer: of depth, beside its transforms.
"""


def seconds(work: Work, rates: Mapping[str, float]) -> float:
    """Predicted time of a work.

    Raises: ValueError for a kind of work without a rate.
    """
    for kind in work.operations:
        if kind not in rates:
            raise ValueError(
                f"no rate for work of the kind {kind!r}; known: {', '.join(rates)}. Give seconds for one of its "
                f"operations, such as seconds(work, rates | {{{kind!r}: 1e-10}})."
            )
    return sum(count * rates[kind] for kind, count in work.operations.items())


def rates_path() -> Path:
    """Where `kcam calibrate` keeps this machine's rates: $KCAM_CACHE, else kcam in $XDG_CACHE_HOME or ~/.cache."""
    base = os.environ.get("KCAM_CACHE")
    folder = Path(base) if base else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "kcam"
    return folder / "rates.json"


class _Kept(TypedDict):
    rates: dict[str, float]


def current_rates(propagator: str | Propagator = "") -> dict[str, float]:
    """This machine's rates where it was calibrated, else the defaults; a damaged file counts as none.

    propagator: of an `Imaging`; a row of one's own brings the rate of its own kind of work.
    """
    own = {propagator.kind: propagator.rate} if isinstance(propagator, Propagator) else {}
    try:
        kept = from_json(rates_path().read_bytes(), _Kept, wrong=f"{rates_path()} is damaged")["rates"]
    except (OSError, ValueError):
        return own | RATES
    return own | RATES | {kind: float(rate) for kind, rate in kept.items() if kind in RATES and 0 < rate < math.inf}


def save_rates(rates: Mapping[str, float]) -> Path:
    """Keep rates for this machine; gives the file."""
    path = rates_path()
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"rates": {kind: float(f"{rate:.3g}") for kind, rate in rates.items()}}
    files.replace(path, json.dumps(content | {"environment": measure.environment()}, indent=1).encode())
    return path


def calibrate(*, rounds: int = 3, advance: Callable[[str, int], None] | None = None) -> tuple[dict[str, float], float]:
    """Measure this machine's rates: the least squares, without negative rates, of pictures of many kinds.

    Args:      rounds: calls of each, of which the median counts.
               advance: told what is being measured, and how many pictures there are.
    Returns:   (kind -> seconds for one operation, the median factor by which they mispredict those pictures).
    """
    works, times = [], []
    pictures = list(_pictures())
    for name, imaging, scene, colours in pictures:
        if advance is not None:
            advance(name, len(pictures))
        found = []
        with torch.no_grad():
            for _ in range(rounds + 1):
                fresh = imaging.fresh()
                start = perf_counter()
                fresh(scene, colour_filter=colours)
                found.append(perf_counter() - start)
        channels = None if colours is None else colours.contraction(scene.wavelengths).shape[0]
        works.append(imaging.work(scene, channels=channels))
        times.append(statistics.median(found[1:]))
    kinds = [kind for kind in RATES if any(kind in work.operations for work in works)]
    counts = np.array([[work.operations.get(kind, 0.0) for kind in kinds] for work in works]) / np.array(times)[:, None]
    scale = counts.max(axis=0)
    solution = scipy.optimize.nnls(counts / scale, np.ones(len(times)))[0] / scale
    # what took no time beside the others keeps a small rate: a price of nothing would be chosen without end
    fitted = {kind: float(max(rate, 0.02 * RATES[kind])) for kind, rate in zip(kinds, solution, strict=True)}
    rates = RATES | fitted
    off = [max(p / t, t / p) for p, t in zip((seconds(work, rates) for work in works), times, strict=True)]
    return rates, statistics.median(off)


def _pictures() -> Iterator[tuple[str, optics.Imaging, Scene, ColourFilter | None]]:
    """Pictures that take all kinds of work in different shares."""
    glass = optics.PlanoConvexLens(25.8 * mm, glass="N-BK7")
    wide, narrow = optics.CircularAperture(5 * mm), optics.CircularAperture(2 * mm)
    noise = torch.Generator().manual_seed(0)
    smooth = optics.ZernikeDOE(torch.tensor([0, 0, 0, 2.0, 3.0, 1.0]))
    small, large_map = (optics.DOE(6 * torch.rand(n, n, generator=noise)) for n in (300, 600))
    elements: dict[str, tuple[optics.Element, ...]] = {
        "symmetric": (wide, glass),
        "small": (narrow, glass),
        "smooth DOE": (wide, glass, smooth),
        "pixel DOE": (wide, glass, small),
        "large DOE": (narrow, glass, large_map),
    }
    lenses = {name: optics.Lens(*parts, focus_distance=2.0) for name, parts in elements.items()}
    optical: dict[str, dict[str, Any]] = {"": {}, ", 33 px": {"psf_shape": (33, 33)}, ", 3 bands": {"bands": 3}}
    layered: list[dict[str, Any]] = [
        {},
        {"occlusion": False},
        {"layers": 4},
        {"layers": 4, "psf_shape": (33, 33), "bands": 3},
    ]
    colours = ColourFilter.kodak()
    flat = Scene.builtin("coffee", 160)
    large = Scene.builtin("coffee", 480)
    deep = flat.with_depth(torch.linspace(1.5, 3.0, flat.shape[2]).expand(1, 1, *flat.shape[1:]).double())
    for name, lens in lenses.items():
        for label, arguments in optical.items():
            yield name + label, _imaging(lens, **arguments), flat, colours
    symmetric = lenses["symmetric"]
    for side in (7, 17, 33):
        yield f"direct {side}", _imaging(symmetric, psf_shape=(side, side), direct=True, bands=2), flat, colours
    for arguments in layered:
        yield f"layers {arguments}", _imaging(symmetric, **arguments), deep, colours
    yield "layers, smooth DOE", _imaging(lenses["smooth DOE"], layers=3), deep, colours
    yield "all bands", _imaging(symmetric, psf_shape=(65, 65)), flat, None
    yield "a large picture", _imaging(symmetric, psf_shape=(65, 65), bands=2), large, colours
    huge = Scene.builtin("astronaut", 1300)
    for label, tile in {"whole": None, "tiles": 256}.items():
        yield f"a huge picture, {label}", _imaging(symmetric, psf_shape=(65, 65), bands=1, tile=tile), huge, colours
    triplet = optics.CompoundLens.preset("cooke_triplet", focus_distance=2.0)
    for label, arguments in {"": {}, ", 3 bands": {"bands": 3}, ", 9 places": {"bands": 3, "spacing": 80}}.items():
        yield f"over the field{label}", _imaging(triplet, **arguments), flat, colours
    yield "without blur", _imaging(symmetric, blur=False), large, colours
    yield "a cube", _imaging(symmetric, bands=2), Scene.from_bands(flat.bands(), depth=2.0), colours
    yield "a cube of low rank", _imaging(symmetric, bands=2, rank=4), Scene.from_bands(flat.bands(), depth=2.0), colours


def _imaging(lens: optics.source.PSFSource, **arguments: Any) -> optics.Imaging:
    return optics.Imaging(lens, pixel_pitch=4 * um).changed(**arguments)  # which does not warn of few layers
