"""A lens as a function of what trains in it: its PSFs for the targets of a picture, and their slope by autograd."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from kcam import optics
from kcam.calibration.targets import Targets
from kcam.optics.propagation.question import residual_path

MOST_VALUES = 64  # that train
_NOTICED = 0.1  # relative change of a PSF that makes the scale of a value
_MOST_SAMPLES = 1024  # along a PSF
_PUPIL = 33  # points across, of a wavefront


@dataclass(frozen=True)
class Conditions:
    """How pictures (H, W) were taken: pixels, light, and where the targets and the sensor stood for each.

    pitch [m]. width: of a pixel's light-sensitive square [pixels]. wavelengths, shares: (L,). distances: (N,) [m].
    shifts: (N,) of the sensor, away from the lens [m]. upright: turned by 180 degrees against the light on the sensor.
    """

    shape: tuple[int, int]
    pitch: float
    width: float
    wavelengths: Tensor
    shares: Tensor
    distances: list[float]
    shifts: list[float]
    upright: bool


@dataclass(frozen=True)
class TrainedLens:
    """Copies of a lens, one for each picture, as a function of the vector of all that trains.

    fields: of the targets of each picture, where the PSF varies. which: (S,) PSF of each target. names, start: (P,) of
    what trains. step: between samples of a PSF [pixels]; samples: along one.
    """

    copies: list[Any]
    conditions: Conditions
    fields: list[Tensor | None]
    which: Tensor
    names: list[str]
    start: Tensor
    step: float
    samples: int

    @classmethod
    def of(cls, lens: nn.Module, targets: Targets, conditions: Conditions) -> TrainedLens:
        """Raises: TypeError, ValueError for what is no lens, or one in which nothing trains or too much."""
        if not callable(getattr(lens, "psf", None)):
            raise TypeError(f"lens must be an optics.Lens or an optics.CompoundLens, got {type(lens).__name__}.")
        names, values = _trained(lens)
        copies = []
        for shift in conditions.shifts:
            own: Any = copy.deepcopy(lens).double().cpu()
            if not any(p is own.sensor_distance for p in own.parameters()):
                own.sensor_distance = own.sensor_distance + shift
            copies.append(own)
        number, pitch = float(copies[0].f_number), conditions.pitch
        # the irradiance has no frequency beyond 1 / lambda N
        step = min(1.0, 0.9 * float(conditions.wavelengths.min()) * number / 2 / pitch)
        samples = 2 * math.ceil((1.5 if targets.kind == "edge" else 1.0) * (targets.reach + 2) / step) + 1
        if samples > _MOST_SAMPLES:
            raise ValueError(
                f"PSFs {2 * targets.reach:.0f} pixels wide of {pitch * 1e6:.3g} um at f/{number:.3g} take {samples} "
                f"samples a side, more than {_MOST_SAMPLES}. Focus better, or cut the picture smaller."
            )
        fields: list[Tensor | None] = [None] * len(copies)
        which = targets.picture
        if getattr(lens, "varies", False) and targets.kind == "points":
            middle = (torch.tensor(conditions.shape[::-1], dtype=torch.float64) - 1) / 2
            places = (targets.origin + targets.start - middle) * (-pitch if conditions.upright else pitch)
            middle_colour = conditions.wavelengths[[len(conditions.wavelengths) // 2]]
            fields = [
                _field(own, places[targets.picture == index], middle_colour, conditions.distances[index])
                for index, own in enumerate(copies)
            ]
            which = targets.picture.argsort(stable=True).argsort()
        return cls(copies, conditions, fields, which, names, values, step, samples)

    def put(self, values: Tensor) -> None:
        """Give the copies these values."""
        for own, shift in zip(self.copies, self.conditions.shifts, strict=True):
            put_values(own, values, shift)

    def bank(self, values: Tensor) -> Tensor:
        """PSFs (Q, M, M) at these values, with a graph to `parameters`."""
        self.put(values)
        asked_of, parts = self.conditions, []
        for own, distance, field in zip(self.copies, asked_of.distances, self.fields, strict=True):
            asked: dict[str, Any] = {} if field is None else {"field": field}
            found = own.psf(
                asked_of.wavelengths,
                distances=distance,
                pixel_pitch=asked_of.pitch * self.step,
                shape=(self.samples, self.samples),
                integrate=False,
                dtype=torch.float64,
                **asked,
            )
            found = torch.einsum("...lyx,l->...yx", found, asked_of.shares)
            parts.append(found.flatten(0, -3))
        return torch.cat(parts)

    def slope(self, loss: Tensor) -> Tensor:
        """d loss / d values (P,), through the lens."""
        held = [p for own in self.copies for p in own.parameters() if p.requires_grad]
        grads = torch.autograd.grad(loss, held, allow_unused=True)
        flat = [torch.zeros_like(p).flatten() if g is None else g.flatten() for p, g in zip(held, grads, strict=True)]
        return torch.cat(flat).view(len(self.copies), -1).sum(0)

    @torch.no_grad()
    def scales(self) -> Tensor:
        """Change of each value that changes PSFs by a tenth, (P,); inf where nothing does."""
        base = self.bank(self.start)

        def change(index: int, by: float) -> float:
            try:
                moved = self.bank(self.start + by * unit(index, len(self.start)))
            except ValueError:
                return math.inf
            return float((moved - base).norm() / base.norm())

        found = []
        for index in range(len(self.start)):
            low, high = math.nan, math.inf
            for power in range(-12, 3):
                if change(index, 10.0**power) > _NOTICED:
                    low, high = 10.0 ** (power - 1), 10.0**power
                    break
            for _ in range(5 if high < math.inf else 0):
                middle = math.sqrt(low * high)
                low, high = (low, middle) if change(index, middle) > _NOTICED else (middle, high)
            found.append(high)
        return torch.tensor(found, dtype=torch.float64)

    @torch.no_grad()
    def wavefront(self, values: Tensor) -> Tensor | None:
        """Residual path over the pupil of the first picture, (n, n) [m], NaN outside; None where the lens has none."""
        self.put(values)
        own, side = self.copies[0], torch.linspace(-1, 1, _PUPIL, dtype=torch.float64)
        colours, distance = self.conditions.wavelengths, self.conditions.distances[0]
        middle = colours[[len(colours) // 2]]
        if isinstance(own, optics.Lens):
            query = own.query(middle, distances=distance, pixel_pitch=1e-6, shape=(1, 1))
            coefficients, maps = residual_path(query, query.pupil(side[None, :], side[:, None]))
            found = torch.einsum("t,tyx->yx", coefficients[0, 0], maps)
            return found.masked_fill(side[None, :] ** 2 + side[:, None] ** 2 > 1, math.nan) if own.round else found
        if isinstance(own, optics.CompoundLens):
            waves, passes = own.opd(middle, distances=distance, samples=_PUPIL)
            return (waves[0, 0] * middle).masked_fill(~passes[0, 0], math.nan)
        return None


def unit(index: int, count: int) -> Tensor:
    """Of one of so many values."""
    return torch.nn.functional.one_hot(torch.tensor(index), count).double()


def _trained(lens: nn.Module) -> tuple[list[str], Tensor]:
    """Names and values of what trains."""
    zernikes = [name for name, part in lens.named_modules() if isinstance(part, optics.ZernikeAberration)]
    names, values = [], []
    for name, parameter in lens.named_parameters():
        if not parameter.requires_grad:
            continue
        if parameter.numel() > MOST_VALUES:
            raise ValueError(
                f"{name} has {parameter.numel()} numbers that train, more than {MOST_VALUES}: use Zernikes."
            )
        values.append(parameter.detach().double().cpu().flatten())
        owner = name.rpartition(".")[0]
        if owner in zernikes:
            prefix = "Z" if len(zernikes) == 1 else f"{owner}.Z"
            names += [f"{prefix}{j + 1}" for j in range(parameter.numel())]
        else:
            names += [name] if parameter.ndim == 0 else [f"{name}[{k}]" for k in range(parameter.numel())]
    if not names:
        raise ValueError(
            "nothing trains in this lens: make what is to be found a Parameter, such as "
            "optics.ZernikeAberration(nn.Parameter(torch.zeros(11))) or Surface(thickness=nn.Parameter(...))."
        )
    if len(names) > MOST_VALUES:
        raise ValueError(f"{len(names)} numbers of the lens train, more than {MOST_VALUES}: p.requires_grad_(False).")
    return names, torch.cat(values)


def put_values(lens: nn.Module, values: Tensor, shift: float = 0.0) -> None:
    """Give a lens the values (P,) of all that trains, on a sensor moved back by `shift` [m]."""
    first = 0
    for name, parameter in lens.named_parameters():
        if parameter.requires_grad:
            own = values[first : first + parameter.numel()].view_as(parameter)
            parameter.data.copy_(own + shift if name == "sensor_distance" else own)
            first += parameter.numel()


@torch.no_grad()
def _field(lens: Any, places: Tensor, wavelength: Tensor, distance: float) -> Tensor:
    """Object points (F, 2) whose chief rays fall at places (F, 2) [m]."""
    field = -places / lens.image_scale
    radius = places.norm(dim=1, keepdim=True).clamp(min=1e-12)
    for _ in range(5):
        fallen = lens.image_point(wavelength, distances=distance, field=field)[:, 0, 0].norm(dim=1, keepdim=True)
        field = field * torch.where(fallen > 1e-9, radius / fallen.clamp(min=1e-12), 1.0)
    return field
