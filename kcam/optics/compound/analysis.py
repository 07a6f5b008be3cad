"""What a real lens does over its field, in numbers, and its rays for a drawing."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kcam.inputs import as_values
from kcam.optics.compound.aiming import Asked, nodes
from kcam.optics.compound.prescription import Prescription
from kcam.optics.numerics import float64

SPECTRAL_LINES = (486.1e-9, 546.1e-9, 656.3e-9)
"""F, e and C [m]: the colours in which a lens is looked at unless others are named."""


@dataclass(frozen=True)
class FieldCurves:
    """What a lens does over its field, at F heights.

    heights: Y / D of object points (F,). image_heights: of chief rays of the focus wavelength, from the axis (F,) [m].
    Printed, a table: light is the relative illumination, the difference of two wavelengths is lateral colour, and MTFs
    are sagittal and tangential.
    relative_illumination, distortion (F,). lateral_colour: how much farther from the axis than the focus wavelength
    each wavelength lands (F, L) [m]. rms_spot: of all light about its centroid (F,) [m]. mtf: of all wavelengths
    together, sagittal and tangential at each frequency (F, 2, K). wavelengths (L,) [m], frequencies (K,) [cycles per
    metre].
    """

    heights: Tensor
    image_heights: Tensor
    relative_illumination: Tensor
    distortion: Tensor
    lateral_colour: Tensor
    rms_spot: Tensor
    mtf: Tensor
    wavelengths: Tensor
    frequencies: Tensor

    def __str__(self) -> str:
        lines = [f"{value * 1e9:.0f}" for value in self.wavelengths.tolist()]
        columns = {
            "Y / D": [f"{value:.3f}" for value in self.heights.tolist()],
            "image [mm]": [f"{value * 1e3:.2f}" for value in self.image_heights.tolist()],
            "light [%]": [f"{100 * value:.1f}" for value in self.relative_illumination.tolist()],
            "distortion [%]": [f"{100 * value:.2f}" for value in self.distortion.tolist()],
            f"{lines[-1]} - {lines[0]} nm [um]": [
                f"{value * 1e6:.2f}" for value in (self.lateral_colour[:, -1] - self.lateral_colour[:, 0]).tolist()
            ],
            "rms spot [um]": [f"{value * 1e6:.1f}" for value in self.rms_spot.tolist()],
        }
        for index, frequency in enumerate(self.frequencies.tolist()):
            columns[f"MTF at {frequency / 1e3:.3g} / mm"] = [
                f"{sagittal:.2f} {tangential:.2f}" for sagittal, tangential in self.mtf[:, :, index].tolist()
            ]
        widths = [max(len(name), *map(len, values)) for name, values in columns.items()]
        rows = [list(columns), *map(list, zip(*columns.values(), strict=True))]
        text = ("  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)) for row in rows)
        return "\n".join(text)


def upwards(heights: Tensor | list[float]) -> Tensor:
    """Object points (F, 2) on the y axis at heights Y / D (F,)."""
    up = as_values(heights, name="heights", unit="Y / D").to(torch.float64).reshape(-1)
    return torch.stack([torch.zeros_like(up), up], dim=1)


def _evenly(passes: Tensor, count: int) -> Tensor:
    """Which of R rays to draw, (F, count): so many of those that pass (F, R), from the first to the last.

    Raises: ValueError for a row in which none passes.
    """
    if not bool(passes.any(1).all()):
        raise ValueError("no ray of a point passes this lens in the plane of the axis. Use smaller heights.")
    chosen = [torch.nonzero(row)[:, 0] for row in passes]
    return torch.stack([open_[torch.linspace(0, len(open_) - 1, count).round().long()] for open_ in chosen])


@torch.no_grad()
def paths(lens: Prescription, asked: Asked, count: int, lead: float) -> Tensor:
    """Rays in the plane of the axis that pass, (F, count, K + 3, 2) of z and y [m]: see `CompoundLens.paths`."""
    found = nodes(lens, asked.wavelengths, asked.vergences, asked.heights)
    px, py = found.towards(torch.zeros(241).double(), torch.linspace(-1.2, 1.2, 241, dtype=torch.float64))
    rays, landed = found.beam.launched(px, py), found.beam.at_sensor(px, py)
    passes = landed.alive & (torch.stack(landed.clearance) > 0).all(0)
    kept = _evenly(passes[:, 0, 0], count)
    started = rays.y - lead * rays.dy / rays.dz
    vertex, points = torch.zeros((), dtype=torch.float64), [torch.stack([0 * rays.y - lead, started], -1)]
    for k, surface in enumerate(lens.surfaces):
        y = found.beam.at(k, px, py).y
        points.append(torch.stack([vertex + surface.sag(y**2)[0], y], -1))
        vertex = vertex + float64(lens.sensor_distance if k == len(lens.surfaces) - 1 else surface.thickness)
    points.append(torch.stack([vertex + 0 * rays.y, landed.y], -1))
    drawn = torch.stack(points, dim=-2)[:, 0, 0]
    return torch.gather(drawn, 1, kept[:, :, None, None].expand(-1, -1, *drawn.shape[2:]))
