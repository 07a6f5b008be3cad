"""Questions about lenses: PSFs of every kind of lens by every row of the table, with gradients, and what else a lens
says of itself.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import torch
from draws import Draw
from golden.lenses import KINDS, SMOOTH, SYMMETRIC, lens, pitch, wavelengths
from golden.question import Answer, Question, gradients, parameter, projected

from kcam import optics
from kcam.units import um

DTYPES = {"float32": torch.float32, "float64": torch.float64}
OF_ROWS = {
    "radial": SYMMETRIC,
    "rays": SMOOTH,
    "fft": tuple(kind for kind in KINDS if kind != "wrapped radial DOE"),  # whose grid takes ten seconds
}
MEMBERS = 3
"""Random members for each row of the table and type."""


def _arguments(draw: Draw, dtype: torch.dtype, *, most: int = 3) -> dict[str, Any]:
    shape = draw.one_of((17, 17), (21, 12), (10, 25), (1, 9), (33, 33))
    return {
        "wavelengths": wavelengths(draw, draw.one_of(*range(1, most + 1))),
        "pixel_pitch": pitch(draw),
        "shape": shape,
        "fill_factor": draw.one_of(1.0, 0.5, 0.81),
        "integrate": draw.one_of(True, True, False),
        "dtype": dtype,
    }


def _distances(draw: Draw, dtype: torch.dtype) -> torch.Tensor:
    far = draw.one_of(float("inf"), 1e3, 4.0)
    every = torch.tensor([draw.number(0.3, 0.6), far, draw.number(0.8, 3.0)], dtype=torch.float64)
    return parameter(every[: draw.one_of(1, 2, 3)], dtype)


def _differentiated(optic: optics.Lens, draw: Draw, dtype: torch.dtype, arguments: dict[str, Any]) -> Answer:
    distances = _distances(draw, dtype)
    psf = optic.psf(distances=distances, **arguments)
    to = dict(optic.named_parameters()) | {"distances": distances}
    if arguments.get("propagator") == "angular_spectrum":  # in which the size of the aperture has no gradient but noise
        to = {name: value for name, value in to.items() if not name.endswith(("diameter", "width"))}
    return {"psf": psf, **gradients(projected(psf, draw.noise(*psf.shape) - 0.5), to)}


def of_kind(kind: str, dtype: torch.dtype, seed: int) -> Answer:
    """By the row that kcam takes."""
    draw = Draw(seed)
    return _differentiated(lens(kind, draw, dtype), draw, dtype, _arguments(draw, dtype))


def by_row(physics: str, method: str, dtype: torch.dtype, seed: int, kind: str = "") -> Answer:
    """A random member of the class that the row can answer."""
    draw = Draw(seed)
    kinds = OF_ROWS.get(method, tuple(KINDS))
    kind = kind or kinds[seed % len(kinds)]
    arguments = _arguments(draw, dtype, most=2)
    if method == "fft" and physics != "angular_spectrum":
        arguments |= {"integrate": True, "shape": draw.one_of((17, 17), (8, 13))}  # bins do not fall on coarse points
    if method in ("matrix", "chirp_z") and kind != "wrapped radial DOE" and draw.one_of(True, False):
        arguments["samples"] = draw.one_of(192, 250)
    if physics == "reference":
        arguments |= {"shape": draw.one_of((9, 9), (6, 11))}
    arguments |= {"propagator": physics, "method": method}
    return {"kind": kind} | _differentiated(lens(kind, draw, dtype), draw, dtype, arguments)


def fast_by_spectrum() -> Answer:
    """The same by the angular spectrum, whose grid is large."""
    return fast(torch.float64, ("angular_spectrum",))


def fast(dtype: torch.dtype, propagators: tuple[str, ...] = ("nonparaxial", "fresnel")) -> Answer:
    """Non-paraxial terms count, and pixels are larger than the PSF: a phone at f/1.8, in and out of focus."""
    answer: Answer = {}
    for propagator in propagators:
        stop, glass = optics.CircularAperture(parameter(1e-3, dtype)), optics.ThinLens(parameter(1.8e-3, dtype))
        phone = optics.Lens(stop, glass, focus_distance=1.0)
        draw = Draw(7)
        arguments = {"wavelengths": [450e-9, 620e-9], "pixel_pitch": 1.4 * um, "shape": (15, 15), "dtype": dtype}
        found = _differentiated(phone, draw, dtype, arguments | {"propagator": propagator})
        answer |= {f"{propagator}, {name}": value for name, value in found.items()}
    return answer


def curves(kind: str, dtype: torch.dtype, seed: int) -> Answer:
    """MTF and encircled energy, and their gradients."""
    draw = Draw(seed)
    optic = lens(kind, draw, dtype)
    answer: Answer = {}
    for name in ("mtf", "encircled_energy"):
        arguments = _arguments(draw, dtype, most=2) | {"shape": draw.one_of((9, 9), (7, 12))}
        distances = _distances(draw, dtype)
        found = getattr(optic, name)(distances=distances, **arguments)
        to = dict(optic.named_parameters()) | {"distances": distances}
        slopes = gradients(projected(found, draw.noise(*found.shape) - 0.5), to)
        answer |= {name: found, **{f"{name}, {key}": value for key, value in slopes.items()}}
    return answer


def said(kind: str, seed: int) -> Answer:
    """What `explain` states of a lens, and the lens's own numbers."""
    draw = Draw(seed)
    optic = lens(kind, draw, torch.float64)
    arguments = _arguments(draw, torch.float64)
    distances = _distances(draw, torch.float64)
    plain = dataclasses.asdict(optic.explain(distances=distances.detach(), **arguments))
    grid = arguments["wavelengths"]
    numbers = {name: getattr(optic, name) for name in ("focus_distance", "f_number", "focus_wavelength", "symmetric")}
    return {
        "explained": plain,
        "numbers": numbers | {"area": optic.aperture_area(), "focal length": optic.focal_length()},
        "power": optic.power(grid),
        "focal lengths": optic.focal_length(grid),
    }


def rows(seed: int) -> Answer:
    """What the rows of the table state and cost of a query, and answer."""
    draw = Draw(seed)
    optic = lens("round convex", draw, torch.float64)
    query = optic.query([500e-9], distances=[0.5, 2.0], pixel_pitch=3 * um, shape=(11, 11), dtype=torch.float64)
    answer: Answer = {"rows": [list(name) for name in optics.PROPAGATORS]}
    for (physics, method), row in optics.PROPAGATORS.items():
        stated = {"error": row.error(query), "model error": row.model_error(query), "cost": row.cost(query)}
        answer |= {f"{physics}/{method}": stated, f"{physics}/{method} psf": row(query)}
    return answer


def sampled(seed: int) -> Answer:
    """What many queries cost, which their pupil grids decide: large windows, so that a little denser grid shows."""
    draw, answer = Draw(seed), {}
    for kind in KINDS:
        optic = lens(kind, draw, torch.float64)
        for member in range(4):
            side = int(draw.number(50, 500))
            query = optic.query(
                wavelengths(draw, 3), distances=draw.number(0.3, 3), pixel_pitch=pitch(draw), shape=(side, side),
                dtype=torch.float64,
            )  # fmt: skip
            answer[f"{kind} {member}"] = optics.PROPAGATORS["nonparaxial", "matrix"].cost(query)
    return answer


def batch(terms: int, layers: int, dtype: torch.dtype, seed: int) -> Answer:
    """`batch_psf`: with and without aberrations, one or several layers, one vergence for each wavelength."""
    draw = Draw(seed)
    bands, lenses = 2, 3
    shape = (lenses, layers, bands) if layers > 1 else draw.one_of((lenses,), (lenses, 1), (lenses, 1, bands))
    vergences = parameter((draw.noise(*shape) - 0.5) * 6, dtype)
    radii = parameter(draw.number(0.3, 0.6) * 1e-3 * (1 + draw.noise(lenses)), dtype)
    distance = parameter(draw.number(4, 8) * 1e-3 * (1 + 0.1 * draw.noise(lenses)), dtype)
    leaves = {"vergences": vergences, "radii": radii, "sensor_distance": distance}
    if terms:
        leaves["coefficients"] = parameter((draw.noise(lenses, terms) - 0.5) * 2e-7, dtype)
    psf = optics.batch_psf(
        **leaves, wavelengths=wavelengths(draw, bands), pixel_pitch=2 * um, shape=draw.one_of((15, 15), (9, 16)),
        dtype=dtype,
    )  # fmt: skip
    return {"psf": psf, **gradients(projected(psf, draw.noise(*psf.shape) - 0.5), leaves)}


def indices() -> Answer:
    """Of every glass."""
    grid = torch.linspace(540, 720, 9, dtype=torch.float64) * 1e-9
    return {glass: optics.refractive_index(glass, wavelengths=grid) for glass in optics.GLASSES}


def heights() -> Answer:
    """Profiles to etch."""
    draw = Draw(3)
    phase = (draw.noise(9, 9) - 0.5) * 9
    plain, etched = optics.DOE(phase, glass="PMMA"), optics.DOE(phase, design_wavelength=600e-9, levels=4)
    return {"plain": plain.height_map(), "etched": etched.height_map()}


def _questions() -> list[Question]:
    found = []
    for name, dtype in DTYPES.items():
        for seed, kind in enumerate(KINDS):
            found.append(Question(f"psf of {kind}, {name}", partial(of_kind, kind, dtype, 100 + seed)))
        for place, (physics, method) in enumerate(optics.PROPAGATORS):
            for member in range(MEMBERS):
                ask = partial(by_row, physics, method, dtype, 7 * place + 5 * member + (name == "float64"))
                found.append(Question(f"psf by {physics}/{method} {member}, {name}", ask))
        found.append(Question(f"psf of a fast lens, {name}", partial(fast, dtype)))
        for seed, kind in enumerate(("round convex", "square aberrated", "DOE")):
            found.append(Question(f"curves of {kind}, {name}", partial(curves, kind, dtype, 200 + seed)))
        for seed, (terms, layers) in enumerate(((0, 1), (0, 3), (11, 1), (8, 2))):
            ask = partial(batch, terms, layers, dtype, 300 + seed)
            found.append(Question(f"batch_psf of {terms} Zernikes and {layers} layers, {name}", ask))
    for seed, kind in enumerate(KINDS):
        found.append(Question(f"what is said of {kind}", partial(said, kind, 400 + seed)))
    found.append(Question("rows of the table", partial(rows, 500)))
    found.append(Question("costs of many queries", partial(sampled, 502)))
    ask = partial(by_row, "nonparaxial", "fft", torch.float64, 501, "wrapped radial DOE")
    found.append(Question("psf by nonparaxial/fft of many rings, float64", ask, slow=True))
    found.append(Question("psf by angular_spectrum of a fast lens, float64", fast_by_spectrum, slow=True))
    found += [Question("glasses", indices), Question("height maps", heights)]
    return found


QUESTIONS = _questions()
