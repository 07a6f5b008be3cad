"""A picture through optics whose PSF varies over it: distortion, then PSFs of a grid of places, as dense as it needs.

The error of bilinear windows between neighbouring nodes is of second order in their distance. It is estimated on the
scene itself before the picture is made: the PSF in the middle of a cell against the mean of its corners, applied to
those parts of the picture that hold most of its detail.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from kcam.optics.regions import pixel_positions
from kcam.optics.rendering.borders import extend
from kcam.optics.rendering.resampling import Resampling, resampling
from kcam.optics.rendering.zones import Axis, blend
from kcam.optics.source import FieldPSFs, PixelGrid

ALLOWED = 1.5e-3
"""Of the picture's light (rms): what nodes may lie apart for, unless Accuracy(spacing=) says how far [pixels]."""
_FINEST, _COARSEST = 4, 512  # pixels between nodes
_PATCH, _PATCHES = 96, 4  # on which the error is estimated: their side [pixels], and how many
PROBE = 128  # pixels between the places that are tried
_SAMPLED = 2**18  # pixels by which a picture's light is known
_CELLS = ((0.12, 0.09), (0.45, 0.4), (0.68, 0.74), (0.97, 0.94))  # places of the quadrant, of half its sides
PROBED = 5 * len(_CELLS)  # places whose PSFs are computed to try

Render = Callable[..., Tensor]
"""Light of PSFs (Z, G, h, w), planes (B, K, H, W) and shares of layers (B, Z, H, W), dark all around; occlusion=False:
sums over the layers."""


@dataclass(frozen=True)
class FieldEstimate:
    """What a picture over the field is off by, of its light (rms); print it.

    places: PSFs computed for it, rows x columns; apart: pixels between them. blending: by PSFs between the places;
    pupils: by polynomials between the heights that were traced; colours: by PSFs between wavelengths; sampling: of
    pupils; outside: light beyond the window.
    """

    places: tuple[int, int]
    apart: int
    blending: float
    pupils: float
    colours: float
    sampling: float
    outside: float

    @property
    def total(self) -> float:
        """Their sum."""
        return self.blending + self.pupils + self.colours + self.sampling + self.outside

    def __str__(self) -> str:
        rows = (
            (f"between {self.places[0]} x {self.places[1]} places, {self.apart} pixels apart", self.blending),
            ("between traced heights", self.pupils),
            ("between wavelengths", self.colours),
            ("pupil sampling", self.sampling),
            ("light outside the window", self.outside),
            ("together, at most", self.total),
        )
        return "\n".join(f"{name:<44} {error:.1e}" for name, error in rows)


@dataclass(frozen=True)
class FieldPicture:
    """How a picture over the field is made.

    psfs: over the sensor. pixels: of their window. centre: of the picture, x and y on the sensor [m]. render: of one
    zone. border: see `Imaging`. spacing: pixels between nodes, inf for one PSF, or None. whole:
    the light outside the window is put back into it. mixing: weights (M, L) of what the picture adds up.
    """

    psfs: FieldPSFs
    pixels: PixelGrid
    centre: tuple[float, float]
    render: Render
    border: str
    spacing: float | None = None
    whole: bool = True
    mixing: Tensor | None = None

    def light(self, planes: Tensor, shares: Tensor | None) -> Tensor:
        """(B, C, H, W) of planes (B, K, H, W) and shares of layers (B, Z, H, W), None for one."""
        planes, shares = self.moved(planes, shares)
        return blend(
            planes,
            shares,
            self.bank,
            self.render,
            window=self.pixels.shape,
            apart=self.apart(planes, shares)[0] if self.spacing is None else self.spacing,
            border=self.border,
        )

    def moved(self, planes: Tensor, shares: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Where distortion brings them, planes times the relative illumination there: nodes share out what is left."""
        picture = (planes.shape[-2], planes.shape[-1])
        moves = self.distortion(picture)
        if moves is not None:
            planes, shares = moves(planes), None if shares is None else moves(shares)
        places = self._centre + pixel_positions(picture, self.pixels.pitch)
        return planes * self.psfs.illumination(places).to(planes), shares

    def distortion(self, picture: tuple[int, int]) -> Resampling | None:
        """From the scene's pixels to the picture's; None where nothing moves."""
        centre = self._centre

        def ideal(places: Tensor) -> Tensor:
            return (centre - self.psfs.undistorted(self._on_sensor(places))) / self.pixels.pitch

        return resampling(ideal, picture, self.border)

    def bank(self, places: Tensor) -> Tensor:
        """PSFs (N, Z, G, h, w) of places (N, 2) of the upright picture, in pixels from its middle."""
        on_sensor = self._on_sensor(places)
        psfs = self.psfs.bank(on_sensor, self.pixels, whole=self.whole, mixing=self.mixing)
        return psfs / self.psfs.illumination(on_sensor).to(psfs).view(-1, 1, 1, 1, 1)

    def explain(self, planes: Tensor, shares: Tensor | None) -> FieldEstimate:
        """What `light` will do, and what it is off by."""
        with torch.no_grad():
            planes, shares = self.moved(planes, shares)
            picture = (planes.shape[-2], planes.shape[-1])
            if self.spacing is None:
                apart, error = self.apart(planes, shares)
            elif math.isinf(self.spacing):  # one PSF on purpose
                apart, error = max(picture), 0.0
            else:
                apart, error = int(self.spacing), self.blending_error(planes, shares, int(self.spacing))
            rows, columns = (
                len(Axis.of(n, m, apart=apart if self.spacing is None else self.spacing).nodes)
                for n, m in zip(picture, self.pixels.shape, strict=True)
            )
            return FieldEstimate((rows, columns), apart, error, **self.psfs.deviations(self.pixels, mixing=self.mixing))

    @property
    def _centre(self) -> Tensor:
        return torch.tensor(self.centre, dtype=torch.float64)

    def _on_sensor(self, places: Tensor) -> Tensor:
        return self._centre - places * self.pixels.pitch  # the picture is upright, light falls turned about

    @torch.no_grad()
    def apart(self, planes: Tensor, shares: Tensor | None, *, allowed: float = ALLOWED) -> tuple[int, float]:
        """How many pixels nodes may lie apart for an error, and what error that leaves: planes as they were moved."""
        sides = (planes.shape[-2], planes.shape[-1])
        probe = max(2, min(PROBE, max(sides) // 2))
        error = self.blending_error(planes, shares, probe)
        steps = [2**k for k in range(int(math.log2(_FINEST)), int(math.log2(_COARSEST)) + 1)]
        fine = [step for step in steps if error * (step / probe) ** 2 <= allowed] or [_FINEST]
        return fine[-1], error * (fine[-1] / probe) ** 2

    @torch.no_grad()
    def blending_error(self, planes: Tensor, shares: Tensor | None, apart: int) -> float:
        """Of the light between nodes so far apart, rms, relative: in the worst of some cells, on the patches of the
        picture with most detail, for all of its detail.
        """
        height, width = planes.shape[-2:]
        detail = _detail(planes)
        most = detail.flatten().argsort(descending=True)[:_PATCHES]
        extended = extend(planes, self.pixels.shape, self.border)
        around = None if shares is None else extend(shares, self.pixels.shape, self.border)
        patches = []
        for row, column in zip(*(index.tolist() for index in torch.unravel_index(most, detail.shape)), strict=True):
            places = [
                slice(k * _PATCH, (k + 1) * _PATCH + m - 1)
                for k, m in zip((row, column), self.pixels.shape, strict=True)
            ]
            patches.append([None if part is None else part[..., places[0], places[1]] for part in (extended, around)])
        corners = torch.cartesian_prod(*[torch.tensor([-apart / 2, apart / 2], dtype=torch.float64)] * 2)
        last = torch.tensor([width - 1, height - 1], dtype=torch.float64) / 2
        worst, uneven, (before, left) = 0.0, 0.0, (m // 2 for m in self.pixels.shape)
        for x, y in _CELLS:
            middle = torch.tensor([[x, y]], dtype=torch.float64) * (last - apart / 2).clamp(min=0)
            psfs = self.bank(torch.cat([middle, torch.maximum(torch.minimum(middle + corners, last), -last)]))
            off, squares = psfs[0] - psfs[1:].mean(0), 0.0
            uneven = max(uneven, float(off.sum((-2, -1)).abs().max()))
            for own, part in patches:
                found = self.render(off, own, part, occlusion=False)[..., before:, left:][..., :_PATCH, :_PATCH]
                squares += float(found.double().square().sum())
            worst = max(worst, squares)
        weight = float(detail.sum() / detail.flatten()[most].sum().clamp(min=1e-300))
        step = max(1, math.isqrt(height * width // _SAMPLED))
        point = planes.new_ones(1, psfs.shape[2], 1, 1)
        light = self.render(point, planes[..., ::step, ::step].contiguous(), None).double().square().sum() * step**2
        return math.sqrt(worst * weight / max(float(light), 1e-300) + uneven**2)


def _detail(planes: Tensor) -> Tensor:
    """Energy of the differences between neighbouring pixels, summed over patches, (rows, columns)."""
    squares = planes.new_zeros(planes.shape[-2:])
    squares[1:] += planes.diff(dim=-2).square().sum((0, 1))
    squares[:, 1:] += planes.diff(dim=-1).square().sum((0, 1))
    height, width = (-n % _PATCH for n in squares.shape)
    padded = torch.nn.functional.pad(squares, (0, width, 0, height)).double()
    return padded.unflatten(0, (-1, _PATCH)).unflatten(2, (-1, _PATCH)).sum((1, 3))
