"""An exemplar, such as a painting, for its pieces: what is seen in it, and what a picture asks of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn import functional as F

from kcam.inputs import check_picture
from kcam.isp.pieces import Book, turned
from kcam.srgb import LUMINANCE
from kcam.texture.features import OPPONENT

LEVELS = (8, 4, 2, 1)
"""By how much each level is smaller."""
LEAST = 32
"""Pixels of an exemplar's shorter side: four of the coarsest level, of which two are no border."""
MOST = 2**19
"""Pixels of an exemplar: of a larger one the middle is taken. In eight turns it takes 150 MB."""
OCTAVES = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Gaussians [pixels]: of the tone that is compared, of its octaves, and last of what is around it."""
AROUND, NEAR = 16.0, 2.0
"""Gaussians [pixels] of the contrast that is evened out, and of that which says where a picture is even."""
FAINT, EVENED = 0.25, 0.6
"""Contrast, of the picture's, that counts half where it says what is even, and where it is evened out."""
GRAIN = 3e-4
"""Deviation of an octave that counts half: steps of 8-bit values in a smooth sky are no detail."""
GAIN = 1.5
"""Contrast that is asked for, of the exemplar's: strokes hide some of it."""
EVEN = 0.01
"""Share of its weight that the tone keeps where the picture is even: there the exemplar's own texture is free."""
SPARSEST = 0.25
"""Of `_fullness`, as far as it counts."""
SLOPE, ALONG = 1.0, 4.0
"""Gaussians of the slopes whose directions are compared, and of their average [pixels]."""
FURTHER = (8.0, 16.0, 32.0)
"""Gaussians [pixels] by which directions flow from edges into even areas."""
FLOW_CELL = 8
"""Pixels between random directions where there are none."""
SHADE = 5.0
"""Gaussian of the colours that are compared [pixels]."""
QUANTILES = 128
LEAST_DEVIATION = 2e-3
"""Of an exemplar's luma: below it is flat, and has no pieces to take."""


def luma_of(picture: Tensor) -> Tensor:
    """Of coded values, (H,W)."""
    return torch.einsum("c,chw->hw", picture.new_tensor(LUMINANCE), picture)


def blur(planes: Tensor, sigma: float) -> Tensor:
    """(C,H,W) by a Gaussian that continues the border; a wide one on a smaller picture."""
    shrink = max(1, 2 ** math.floor(math.log2(sigma / 2)))
    shape = planes.shape[-2:]
    small = planes[None]
    if shrink > 1:
        small = F.interpolate(small, size=[-(-side // shrink) for side in shape], mode="area")
    reach = math.ceil(3 * sigma / shrink)
    wide = F.pad(small, [reach] * 4, mode="replicate")
    soft = gaussian_blur2d(wide, 2 * reach + 1, (sigma / shrink, sigma / shrink))[..., reach:-reach, reach:-reach]
    return (F.interpolate(soft, size=shape, mode="bilinear") if shrink > 1 else soft)[0]


def _directions(luma: Tensor) -> Tensor:
    """Of level lines, as vectors of twice the angle times squared slope, and squared slope, (3,H,W)."""
    soft = F.pad(blur(luma[None], SLOPE)[None], [1] * 4, mode="replicate")[0, 0]
    x, y = (soft[1:-1, 2:] - soft[1:-1, :-2]) / 2, (soft[2:, 1:-1] - soft[:-2, 1:-1]) / 2
    return blur(torch.stack([y * y - x * x, -2 * x * y, x * x + y * y]), ALONG)


def _tones(luma: Tensor) -> Tensor:
    """By octaves, each beside what is around it, and around them all, (5,H,W)."""
    soft = torch.cat([blur(luma[None], sigma) for sigma in OCTAVES])
    return torch.cat([soft[:-1] - soft[1:], soft[-1:]])


def _deviation(planes: Tensor) -> Tensor:
    """Of each of (C,H,W), (C,1,1)."""
    return planes.std((1, 2), correction=0, keepdim=True)


def _standard(planes: Tensor) -> Tensor:
    """(C,H,W) of mean 0 and deviation 1; nothing of what does not vary."""
    return (planes - planes.mean((1, 2), keepdim=True)) / _deviation(planes).clamp(min=1e-4)


def _colours(picture: Tensor) -> Tensor:
    """Of the neighbourhood, beside its brightness, (2,H,W)."""
    return _standard(blur(torch.einsum("nc,chw->nhw", picture.new_tensor(OPPONENT[1:]), picture), SHADE))


def _with_tones_of(values: Tensor, others: Tensor) -> Tensor:
    """Values brought to the distribution of others, by lines between quantiles."""
    ends = torch.linspace(0, 1, QUANTILES, dtype=values.dtype, device=values.device)

    def quantiles(plane: Tensor) -> Tensor:
        flat = plane.flatten()
        flat = flat[:: max(1, len(flat) // 2**16)].sort().values
        at = ends * (len(flat) - 1)
        low = at.long().clamp(max=max(len(flat) - 2, 0))
        return torch.lerp(flat[low], flat[(low + 1).clamp(max=len(flat) - 1)], at - low)

    own, theirs = quantiles(values), quantiles(others)
    flat = values.detach().contiguous()
    slack = 4 * torch.finfo(flat.dtype).eps  # values that are equal differ by rounding
    left, right = torch.searchsorted(own.detach(), flat - slack), torch.searchsorted(own.detach(), flat + slack)
    index = ((left + right) // 2 - 1).clamp(0, QUANTILES - 2)  # the middle of equal ones
    low, high = own[index], own[index + 1]
    share = ((values - low) / (high - low).clamp(min=1e-6)).clamp(0, 1)
    return torch.lerp(theirs[index], theirs[index + 1], share)


@dataclass(frozen=True)
class Exemplar:
    """What pieces are taken from: a picture (3,h,w), its tones (5,h,w), in which units what is compared is, and its
    places in all turns at all levels.
    """

    picture: Tensor
    tones: Tensor
    units: tuple[float, float, float, float]
    books: tuple[Book, ...]

    @classmethod
    def of(cls, picture: Tensor, *, turns: int, detail: float, flow: float, colour: float) -> Exemplar:
        luma = luma_of(picture)
        tones, slopes = _tones(luma), _directions(luma)
        units = (
            math.sqrt(detail / max(float(tones[:-1].detach().sum(0).var()), 1e-6)),
            1 / max(float(tones.detach().sum(0).std()), 1e-3),
            math.sqrt(flow),
            math.sqrt(colour),
        )
        bare = cls(picture, tones, units, ())
        vectors = slopes[:2] / (slopes[2] + 1e-5)
        planes = torch.cat([tones[:-1].sum(0, keepdim=True), tones[-1:], _colours(picture), vectors])
        parts: list[list[tuple[Tensor, Tensor, Tensor]]] = [[] for _ in LEVELS]
        for turn in range(turns):
            angle = 2 * math.pi * turn / turns
            seen, inside = turned(picture, angle, mode="bicubic")
            found = turned(planes, angle)[0]
            cos, sin = math.cos(2 * angle), math.sin(2 * angle)
            along = torch.stack([cos * found[4] - sin * found[5], sin * found[4] + cos * found[5]])
            found = torch.cat([seen.clamp(0, 1), bare.scaled(torch.cat([found[:4], along]))])
            for level, own in zip(LEVELS, parts, strict=True):
                small = F.avg_pool2d(found[None], level)[0]
                whole = F.avg_pool2d(inside[None, None].to(found), level)[0, 0] > 1 - 1e-4
                whole = F.pad(whole[None, None].to(found), [1] * 4)  # a step beyond is beyond
                allowed = -F.max_pool2d(-whole, 3, 1)[0, 0] > 0.5
                own.append((small[:3].flatten(1).T, small[3:].flatten(1).T, allowed.flatten()))
        books = []
        for level, own in zip(LEVELS, parts, strict=True):
            seen, compared, allowed = (torch.cat(part).contiguous() for part in zip(*own, strict=True))
            books.append(Book(seen, compared, allowed, picture.shape[1] // level, picture.shape[2] // level))
        return replace(bare, books=tuple(books))

    def scaled(self, planes: Tensor) -> Tensor:
        """Tone, what is around it, two colours and two of a direction, in the unit in which they are compared."""
        fine, wide, flow, colour = self.units
        return torch.cat([fine * planes[:1], wide * planes[1:2], colour * planes[2:4], flow * planes[4:6]])


def _in_proportion(octaves: Tensor, theirs: Tensor, local: float) -> Tensor:
    """Octaves of a picture, evened out, each as strong beside the others as the exemplar's; their sum (1,H,W)."""
    spread = _deviation(octaves) + GRAIN
    around = (blur(octaves.square(), AROUND) + 1e-8).sqrt()
    octaves = (1 - local) * octaves / spread + local * octaves / (around + EVENED * spread)
    strength = _deviation(theirs) * (1 - GRAIN / spread)  # without it wide areas of light and dark are the strongest
    fine = (octaves * strength / (_deviation(octaves) + 1e-4)).sum(0, keepdim=True)
    whole = theirs.sum(0)
    most = whole.abs().flatten().kthvalue(math.ceil(0.995 * whole.numel())).values + 1e-4
    return most * torch.tanh(GAIN * whole.std() * fine / (_deviation(fine) + 1e-4) / most)


def _fullness(tone: Tensor) -> float:
    """How much of a picture shows something: 1 where tones are as in noise, near 0 where few pixels have all of it."""
    mean, square = float(tone.abs().mean()) + GRAIN, float(tone.square().mean()) + GRAIN**2
    return min(max(math.pi / 2 * mean**2 / square, SPARSEST), 1.0)


def asked_of(picture: Tensor, exemplar: Exemplar, local: float, chance: Tensor) -> tuple[Tensor, ...]:
    """Of (3,H,W): what pieces should be like (6,H,W), how much the tone counts (H,W), and the tone (1,H,W)."""
    luma = luma_of(picture)
    octaves, wide = _tones(luma).split([len(OCTAVES) - 1, 1])
    fine = octaves.sum(0, keepdim=True)
    with torch.no_grad():  # where little shows something, strokes all around hide it: what there is must be met
        near = blur(fine.square(), NEAR)[0].clamp(min=0).sqrt()
        weight = EVEN + (1 - EVEN) * near / (near + FAINT * _deviation(fine)[0] + GRAIN)
        weight = weight / _fullness(fine) ** 2
    fine = _in_proportion(octaves, exemplar.tones[:-1], local)
    wide = _with_tones_of(wide, exemplar.tones[-1])
    lines = _directions(luma)
    slopes = lines + 0.1 * sum(blur(lines, sigma) for sigma in FURTHER)
    known = slopes[2] / (slopes[2] + 1e-4)
    flow = slopes[:2] / (slopes[2] + 1e-9) * known + (1 - known) * chance / (chance.norm(dim=0).mean() + 1e-9)
    flow = 0.8 * flow / (flow.norm(dim=0) + 1e-6)
    asked = torch.cat([fine, wide, _colours(picture), flow])
    return exemplar.scaled(asked), weight, fine + wide


def drawn_directions(picture: Tensor, generator: torch.Generator) -> Tensor:
    """Directions that flow over a picture (C,H,W), (2,H,W)."""
    shape = picture.shape[-2:]
    cells = [-(-side // FLOW_CELL) + 2 for side in shape]
    drawn = torch.randn(2, *cells, generator=generator, device=generator.device).to(picture)
    return F.interpolate(blur(drawn, 2.0)[None], size=shape, mode="bicubic")[0]


def cropped(exemplar: Tensor) -> Tensor:
    """The middle of an exemplar: of a size that all levels divide, and of which a shorter side stays whole."""
    shorter = min(*exemplar.shape[-2:], math.isqrt(MOST))
    tall, broad = (min(side, MOST // shorter) // LEVELS[0] * LEVELS[0] for side in exemplar.shape[-2:])
    top, left = ((size - side) // 2 for size, side in zip(exemplar.shape[-2:], (tall, broad), strict=True))
    return exemplar[:, top : top + tall, left : left + broad]


def check_exemplar(exemplar: Tensor) -> None:
    """TypeError, ValueError unless it is a picture that has pieces to take."""
    check_picture(exemplar, name="exemplar", channels=(3,), ndims=(3,))
    if min(exemplar.shape[-2:]) < LEAST:
        raise ValueError(
            f"an exemplar of {exemplar.shape[-2]} x {exemplar.shape[-1]} is too small: expected at least {LEAST} "
            "pixels each way. Use a larger picture, not an enlarged one: strokes are measured in pixels."
        )
    spread = float(luma_of(exemplar.detach()).std())
    if spread < LEAST_DEVIATION:
        raise ValueError(
            f"the exemplar is flat: its luma deviates by {spread:.2g}, expected at least {LEAST_DEVIATION:g}. A "
            "picture of one colour has no strokes."
        )
