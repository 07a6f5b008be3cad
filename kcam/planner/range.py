"""What the scenes of a plan were like, and how much larger its errors could be in others."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from kcam.optics.accuracy import OVER_THE_FIELD
from kcam.optics.source import Defocus
from kcam.optics.wavelengths import few_wavelengths
from kcam.planner.survey import KINDS, NEIGHBOURS, OF_DEPTH, Survey
from kcam.scene import Scene

LEAST, COLOUR, DEPTH, RING, OTHER_LIGHT = 1e-6, 0.01, 0.1, 0.1, 1.5
"""Potentials, and shares of bands, distances and rings, beside which smaller ones do not count; how far those may
differ."""


@dataclass(frozen=True)
class Range:
    """What the scenes of a plan were like: outside of it the plan's errors are not known.

    farthest, nearest: vergences [1/m]. wavelengths [m]. Of a plan that was saved before they were kept the rest is
    empty, and not asked for: contrast: RMS between neighbouring pixels, relative to what is recorded. potential: of
    the `KINDS` of what a choice could hurt, the most, relative likewise. light, depths: the largest share of each band
    and of each range of defocus. saturated: the least light beyond what is recorded, relative likewise. darkest,
    brightest: RMS of what is recorded [share of the full well]. defocus: how the lens blurred.
    rings: the largest share of contrast in each ring about the middle of the picture, of optics that vary over it.

    Example:
    >>> known = Camera.phone().plan(Scene.from_rgb(torch.rand(3, 24, 32), depth=2.0), tolerance=0.02).range
    >>> known.height, known.width, 1 / known.nearest
    (24, 32, 2.0)
    """

    height: int
    width: int
    farthest: float
    nearest: float
    contrast: float
    wavelengths: tuple[float, ...]
    potential: tuple[float, ...] = ()
    light: tuple[float, ...] = ()
    depths: tuple[float, ...] = ()
    saturated: float = 0.0
    darkest: float = 0.0
    brightest: float = 0.0
    defocus: Defocus | None = None
    rings: tuple[float, ...] = ()

    @classmethod
    def of(cls, scenes: Sequence[Scene], surveys: Sequence[Survey], defocus: Defocus, *, varies: bool = False) -> Range:
        """The range that scenes span, by what was found in each item of their batches."""
        ends = []
        for scene in scenes:
            depth = torch.as_tensor(scene.depth, dtype=torch.float64).detach()
            ends += [] if depth.numel() == 0 else [1 / float(depth.max()), 1 / float(depth.min())]
        nothing = torch.zeros(1, len(KINDS), dtype=torch.float64), torch.zeros(1, len(scenes[0].wavelengths))
        potential = torch.stack([found.relative() for found in surveys]) if surveys else nothing[0]
        light = torch.stack([found.light for found in surveys]) if surveys else nothing[1]
        depths = torch.stack([found.depths for found in surveys]) if surveys else torch.zeros(1, 1)
        return cls(
            height=max(scene.shape[1] for scene in scenes),
            width=max(scene.shape[2] for scene in scenes),
            farthest=min(ends, default=0.0),
            nearest=max(ends, default=0.0),
            contrast=math.sqrt(float(potential[:, NEIGHBOURS].max())),
            wavelengths=tuple(scenes[0].wavelengths.tolist()),
            potential=tuple(potential.amax(0).tolist()),
            light=tuple(shares(light).amax(0).tolist()),
            depths=tuple(shares(depths).amax(0).tolist()),
            saturated=float(potential[:, -1].min()),
            darkest=min((found.level for found in surveys), default=0.0),
            brightest=max((found.level for found in surveys), default=0.0),
            defocus=defocus,
            rings=tuple(torch.stack([_rings(found) for found in surveys]).amax(0).tolist())
            if surveys and varies
            else (),
        )

    def growth(self, found: Survey, changes: Mapping[str, Any], *, hides: bool) -> Iterator[tuple[str, float]]:
        """How many times as large the error of changes could be in a scene, for each kind of reason, in words.

        hides: whether what the full well cut off of the planned scenes was left out of their errors.

        What differs between wavelengths and distances is foretold to the power of 2: in one scene errors cancel, or lie
        in the dark, that add up in another.
        """
        depth = bool({"layers", "occlusion", "psf_shape"} & set(changes))  # a window holds what is not far out of focus
        relative = found.relative().tolist()
        hidden = max(1.0, math.sqrt((1 + self.saturated) / (1 + relative[-1]))) if hides else 1.0
        for kind, ours, planned in zip(KINDS, relative, self.potential, strict=True):
            if depth or kind not in OF_DEPTH:
                yield kind, hidden * math.sqrt((ours + LEAST) / (planned + LEAST))
        if depth:
            share, known = shares(found.depths), torch.tensor(self.depths).to(found.depths)
            yield "light at some distances", float(((share + DEPTH) / (known + DEPTH)).max()) ** 2 / OTHER_LIGHT
        if self.rings and {"spacing", *OVER_THE_FIELD} & set(changes):
            share, known = _rings(found), torch.tensor(self.rings).double()
            yield "contrast as far from the middle", float(((share + RING) / (known + RING)).max()) ** 2 / OTHER_LIGHT
        light, known = shares(found.light), torch.tensor(self.light).to(found.light)
        ratios = (light + COLOUR) / (known + COLOUR)
        band = int(ratios.argmax())
        yield f"share of light at {self.wavelengths[band] * 1e9:.0f} nm", float(ratios[band]) ** 2 / OTHER_LIGHT
        if "bands" in changes and bool(light.any()):
            groups = min(int(changes["bands"]), len(light))
            _, members = few_wavelengths(torch.tensor(self.wavelengths), groups, interpolate=False)
            uneven = [_unevenness(one, members.to(one)) + COLOUR for one in (light, known)]
            yield "differences of light between neighbouring wavelengths", (uneven[0] / uneven[1]) ** 2

    def leaves(self, scene: Scene) -> str | None:
        """In what a scene's geometry lies outside, or None; a tenth of the depth is let pass."""
        other = Range.of([scene], [], Defocus())
        slack = 0.1 * (self.nearest - self.farthest) + 1e-9
        if other.wavelengths != self.wavelengths:
            return f"has other wavelengths ({len(other.wavelengths)}) than were planned for ({len(self.wavelengths)})"
        if other.nearest > self.nearest + slack:
            return f"comes as near as {metres(other.nearest)}; the nearest planned for was {metres(self.nearest)}"
        if other.farthest < self.farthest - slack:
            return f"goes out to {metres(other.farthest)}; the farthest planned for was {metres(self.farthest)}"
        if other.height * other.width > 1.2 * self.height * self.width:
            return f"has {other.height} x {other.width} pixels; the plan was for {self.height} x {self.width}"
        return None


def shares(values: Tensor) -> Tensor:
    """Of the root of the sum of squares."""
    return values / values.norm(dim=-1, keepdim=True).clamp(min=1e-30)


def _rings(found: Survey) -> Tensor:
    """Share of the contrast between neighbours in rings about the middle of the picture, by tiles, (4,)."""
    energy = found.potential[NEIGHBOURS]
    y, x = (torch.linspace(-1, 1, 2 * n + 1, dtype=torch.float64)[1::2] for n in energy.shape)
    ring = (4 * (y[:, None] ** 2 + x**2).div(2).sqrt()).long().clamp(max=3)
    return shares(torch.bincount(ring.flatten(), energy.double().flatten(), minlength=4).sqrt())


def _unevenness(light: Tensor, members: Tensor) -> float:
    """RMS of the differences between bands and the mean of their group (L, G), relative to that of all."""
    apart = light - members @ (light @ members / members.sum(0))
    return float(apart.norm() / light.norm().clamp(min=1e-30))


def metres(vergence: float) -> str:
    """A distance as text, by its vergence [1/m]."""
    distance = 1 / vergence if vergence > 1e-9 else float("inf")
    return "infinity" if distance > 1e9 else f"{distance:.3g} m" if distance < 1000 else f"{distance:.0f} m"
