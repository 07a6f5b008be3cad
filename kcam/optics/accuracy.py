"""How accurately a picture is computed: every choice between error and time, as one value that a plan weighs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from numbers import Integral
from typing import Any, TypedDict

import torch
from torch import Tensor

from kcam.optics.propagation.question import Query
from kcam.optics.propagation.row import Propagator
from kcam.optics.propagation.sampling import KAPPA
from kcam.optics.propagation.table import PHYSICS, choose
from kcam.optics.source import is_count
from kcam.units import as_numbers, check_distances

COVERAGES = ("channel", "band")
OVER_THE_FIELD = ("field_variation", "distortion", "lateral_colour", "relative_illumination")
"""What optics may do that vary over the picture, each of which can be left out by itself."""


def check_memory(max_memory: Any) -> None:
    """ValueError for a memory that is not positive, TypeError for what is no number."""
    if type(max_memory) is float and max_memory > 0:  # a plan changes stages often
        return
    given = as_numbers(max_memory, name="max_memory", expected="a positive number of bytes")
    if not given > 0:
        raise ValueError(f"max_memory must be a positive number of bytes, got {given:g}.")


@dataclass(frozen=True)
class Recipe:
    """How a lens computes its PSFs; arguments: as of `Lens.psf`, and kappa of `sampling.pupil_samples`."""

    propagator: str | Propagator = "nonparaxial"
    method: str | None = None
    samples: int | None = None
    kappa: float | None = None

    def row(self, query: Query) -> Propagator:
        """The row of the table that answers."""
        return choose(query, propagator=self.propagator, method=self.method)


@dataclass(frozen=True)
class Accuracy(Recipe):
    """What `Imaging` computes, and what it leaves out: the defaults leave out nothing that a picture shows.

    Args:
        propagator, method, samples: as in `Lens.psf`. A number of samples freezes the pupil grid, which otherwise
            follows the parameters in steps: give it together with psf_shape where a camera is differenced. A propagator
            may also be a row of one's own, an `optics.propagation.Propagator`; such a camera cannot be saved.
        kappa: pupil samples per fringe, see `optics.propagation.sampling.pupil_samples`; None for its default.
        blur: False lets each point light its own pixel only.
        bands: number of wavelengths whose PSFs are computed; None: all. Fewer: neighbouring bands share the PSF of
            their group's mean wavelength, whatever their number.
        interpolate_bands: of fewer, give each band the cubic in 1/wavelength through the PSFs of the four nearest: once
            they resolve the fringes errors fall with the square of their number and more, not the first power. Such
            PSFs may be below zero, and what hides something must not: of scenes with a map of depth, and over the
            field, neighbouring bands share a PSF all the same.
        psf_shape: (H, W) of the PSF's window in pixels; None: see `Imaging.psf_window`.
        renormalise: give a PSF that psf_shape cuts its whole light again.
        layers: number of depth layers over the range of a depth map, at equal steps of 1/z, or their distances [m];
            None: see `Imaging.depth_layers`. Of given ones a warning says where pixels lie too far from all.
        interpolate: between the layers, linearly in vergence; False puts each pixel into its nearest layer.
        occlusion: False adds the layers up, also where a nearer one hides a farther one.
        coverage: where layers hide each other, count it per "channel" of the filter that is absorbed, or per "band":
            the colours at an edge are then exact, at the cost of the bands.
        spacing: pixels between the places whose PSFs are computed, where they vary over the picture; None: as the
            estimate on the scene asks, see `Imaging.explain`.
        field_variation, distortion, lateral_colour, relative_illumination: of optics that vary over the picture; each
            may be False by itself. Then every pixel sees the PSF of the axis; no light is moved; chief rays of all
            wavelengths fall where that of the spectrum's middle does; an even scene is even. `Imaging(field=False)`
            leaves out all four.
        rank: of the scene's spectra, at most, see `Scene.low_rank`; None for its own.
        precision: "float32" computes so whatever the scene's type; None for the scene's, or float64 where its light
            spans more than float32's transforms hold, see `rendering.rounding.wide_range`.
    With the same result, for less memory or time:
        max_memory: bytes that the transforms may take; bands are split to stay below.
        tile: side of the squares that are convolved one by one [pixels]; None: only a picture of more than 5
            megapixels is cut.
        direct: convolve in the picture, without a Fourier transform: faster for small windows.
    Raises: ValueError for an unknown propagator, coverage or precision, a shape, count or memory that is not positive,
        a distance not in metres, a kappa of 1 or less; TypeError for layers that are neither a number nor distances.

    Example:
    >>> lens = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), focus_distance=2.0)
    >>> imaging = optics.Imaging(lens, accuracy=optics.Accuracy(bands=4, occlusion=False))
    >>> imaging.psf_wavelengths(kcam.units.wavelength_grid()).shape
    torch.Size([4])
    """

    blur: bool = True
    bands: int | None = None
    interpolate_bands: bool = False
    psf_shape: tuple[int, int] | None = None
    renormalise: bool = False
    layers: int | Sequence[float] | Tensor | None = None
    interpolate: bool = True
    occlusion: bool = True
    coverage: str = "channel"
    spacing: int | None = None
    field_variation: bool = True
    distortion: bool = True
    lateral_colour: bool = True
    relative_illumination: bool = True
    rank: int | None = None
    precision: str | None = None
    max_memory: float = 2e9
    tile: int | None = None
    direct: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.propagator, Propagator) and self.propagator not in PHYSICS:
            raise ValueError(f"unknown propagator {self.propagator!r}; known: {', '.join(PHYSICS)}.")
        if self.coverage not in COVERAGES:
            raise ValueError(f"unknown coverage {self.coverage!r}; known: {', '.join(COVERAGES)}.")
        for name, of in (("bands", "wavelengths"), ("tile", "pixels"), ("rank", "factors"), ("spacing", "pixels")):
            value = getattr(self, name)
            if value is not None and not is_count(value):
                raise ValueError(f"{name} must be a positive number of {of}, or None, got {value!r}.")
        shape = self.psf_shape
        if shape is not None and not (isinstance(shape, Sequence) and len(shape) == 2 and all(map(is_count, shape))):
            fix = f" Use ({shape}, {shape})." if is_count(shape) else ""
            raise ValueError(f"psf_shape must be two positive integers (H, W) in pixels, or None, got {shape!r}.{fix}")
        if self.kappa is not None:
            kappa = as_numbers(self.kappa, name="kappa", expected="a number above 1 sample per fringe")
            if not kappa > 1:
                raise ValueError(f"kappa must be above 1 sample per fringe, got {kappa:g}. Its default is {KAPPA:g}.")
        if self.precision not in (None, "float32", "float64"):
            raise ValueError(
                f'precision must be "float32", "float64" or None for the scene\'s, got {self.precision!r}.'
            )
        check_memory(self.max_memory)
        own: dict[str, Any] = {"max_memory": float(self.max_memory)}
        own |= {} if self.layers is None else {"layers": _count_or_distances(self.layers)}
        own |= {} if shape is None else {"psf_shape": (int(shape[0]), int(shape[1]))}
        vars(self).update(own)

    def settings(self) -> dict[str, Any]:
        """The arguments, by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def recipe(self) -> Recipe:
        """How PSFs are computed, without all else."""
        return Recipe(**{field.name: getattr(self, field.name) for field in fields(Recipe)})

    @property
    def per_band(self) -> bool:
        """Whether bands are kept apart until the layers of depth are over one another."""
        return self.occlusion and self.coverage == "band"

    @property
    def node_spacing(self) -> float | None:
        """Pixels between the nodes of a picture over the field: inf for one PSF, None where the scene tells."""
        return self.spacing if self.field_variation else math.inf


class Shortcuts(TypedDict, total=False):
    """The arguments of `Accuracy`, which `Imaging` takes one by one too."""

    propagator: str | Propagator
    method: str | None
    samples: int | None
    kappa: float | None
    blur: bool
    bands: int | None
    interpolate_bands: bool
    psf_shape: tuple[int, int] | None
    renormalise: bool
    layers: int | Sequence[float] | Tensor | None
    interpolate: bool
    occlusion: bool
    coverage: str
    spacing: int | None
    field_variation: bool
    distortion: bool
    lateral_colour: bool
    relative_illumination: bool
    rank: int | None
    precision: str | None
    max_memory: float
    tile: int | None
    direct: bool


def _count_or_distances(layers: int | Sequence[float] | Tensor) -> int | tuple[float, ...]:
    """A number of layers, or their distances [m] from far to near, each once."""
    if isinstance(layers, Integral) and not isinstance(layers, bool):
        if layers < 1:
            raise ValueError(f"layers must be a positive number of depth layers, or None, got {layers}.")
        return int(layers)
    try:
        if isinstance(layers, bool):
            raise TypeError("a truth value is no number")
        found = torch.as_tensor(layers, dtype=torch.float64).detach().flatten()
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(
            f"layers must be a number, distances in metres such as (0.5, 2.0), or None, got {layers!r}."
        ) from error
    if not found.numel():
        raise ValueError("layers holds no distance; give some, such as layers=(0.5, 2.0) in metres, a number, or None.")
    for distance in found.tolist():
        check_distances(distance)
    return tuple(sorted(set(found.tolist()), reverse=True))
