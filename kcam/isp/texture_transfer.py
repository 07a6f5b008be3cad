"""Texture transfer: a picture painted anew with pieces of another one, such as a painting."""

from __future__ import annotations

import copy
import math
from typing import Any

import torch
from kornia.filters import guided_blur
from torch import Tensor
from torch.nn import functional as F

from kcam.cache import ValueCache, recorded
from kcam.context import Context, Stage
from kcam.inputs import check_signal, remedy
from kcam.isp.exemplar import (
    LEVELS,
    OCTAVES,
    Exemplar,
    asked_of,
    blur,
    check_exemplar,
    cropped,
    drawn_directions,
    luma_of,
)
from kcam.isp.film import carried, in_whole_pixels, motions
from kcam.isp.pieces import lay_pieces, shown_by
from kcam.sensor.arguments import check_not_negative, hold, in_float32, like
from kcam.srgb import LUMINANCE
from kcam.ste import clip_ste
from kcam.texture.descent import descend
from kcam.texture.features import OPPONENT, SteerableFeatures
from kcam.texture.losses import StyleLoss

ROUNDS = (12, 10, 8, 4)
"""How often pieces of each level are offered others."""
JOINT = 0.03
"""What a seam costs where its colours agree: without it even areas are the same few pixels again and again."""
GLAZED, STROKE = 17, 4e-3
"""Side of the windows in which what is laid over follows the strokes [pixels], and variance of what is none."""
STEADY = 0.1
"""Of the exemplar's covariance of colours, added to both: of a picture that shows one tone little is made."""
FINISH: dict[str, Any] = {"colour": 1.0, "content": 0.3, "flat": 1e-2, "sparse": 0.05}
"""Of the loss that a picture of pieces is moved down on, beside the style's weight of 1."""
RATE = 0.0075
PAINTS, ALIKE = 512, 0.04
"""Pixels of the exemplar whose colours are its paints, and deviation of colours that count as the same."""
BASIS = (LUMINANCE, *OPPONENT[1:])
"""In which colours are brought to others': what is bright, and two of what is not seen of it."""
KEEP = 1.0
"""What it costs in a film that a pixel leaves the piece that it was of."""
AT_ONCE, SHARED = 1024, 64
"""Pixels a side that are moved down at once, with 1.6 GB, and that neighbours share."""


def _transferred(
    picture: Tensor,
    exemplar: Exemplar,
    *,
    local: float,
    seam: float,
    glaze: Tensor | float,
    palette: float,
    loss: StyleLoss | None,
    steps: int,
    generator: torch.Generator,
    before: tuple[Tensor, Tensor, Tensor] | None,
) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """One picture (3,H,W), and its places and chances. before: those of the frame before it, and how it moved since."""
    height, width = picture.shape[-2:]
    border = (0, -width % LEVELS[0], 0, -height % LEVELS[0])
    whole = F.pad(picture[None], border, mode="replicate")[0]
    chance, kept = drawn_directions(whole, generator), None
    if before is not None:
        moved = F.pad(before[2][None], border, mode="replicate")[0]
        kept = carried(before[0], torch.full_like(before[0], -1), moved)
        chance = carried(before[1], chance, moved)
    asked, weight, tone = asked_of(whole, exemplar, local, chance)
    with torch.no_grad():
        unit = max(2 * float(exemplar.picture.flatten(1).var(1).sum()), 1e-4)
        weights = torch.ones_like(asked)
        weights[0] = weight
        places = lay_pieces(
            exemplar.books,
            [F.avg_pool2d(asked[None], level)[0] for level in LEVELS],
            [F.avg_pool2d(weights[None], level)[0] for level in LEVELS],
            seam=seam / unit,
            joint=JOINT * unit,
            rounds=ROUNDS,
            kept=kept,
            keep=KEEP,
            generator=generator,
        )
    book = exemplar.books[-1]
    painted = shown_by(book, book.shown, places)
    if isinstance(glaze, Tensor) or glaze:
        painted = painted + like(glaze, painted) * _by_strokes(tone - blur(luma_of(painted)[None], OCTAVES[0]), painted)
    if palette:
        painted = torch.lerp(painted, _with_colours_of(painted, exemplar.picture), palette)
    painted = clip_ste(painted, 0.0, 1.0)[:, :height, :width]
    if loss is not None:
        with torch.no_grad():
            better = _finished(painted, picture, loss, steps)
            if palette:
                mixed = _by_paints(better, exemplar.picture)
                better = torch.lerp(better, _with_colours_of(mixed, exemplar.picture), palette)
            change = better.clamp(0, 1) - painted
        painted = painted + change
    return painted, (places, chance)


def _by_strokes(tone: Tensor, painted: Tensor) -> Tensor:
    """(1,H,W) evened out within each stroke, not over its edge: a soft shadow would look like a photograph's."""
    guide = luma_of(painted)[None, None]
    return guided_blur(guide, tone[None], GLAZED, STROKE, border_type="replicate", separable=True)[0]


def _finished(painted: Tensor, scene: Tensor, loss: StyleLoss, steps: int) -> Tensor:
    """(3,H,W) some steps down the loss: where pieces meet it mends what no piece could."""
    height, width = painted.shape[-2:]
    total, weights = torch.zeros_like(painted), torch.zeros_like(painted[:1])
    for rows, down in _parts(height):
        for columns, right in _parts(width):
            part = descend(
                loss, painted[None, :, rows, columns], scene=scene[None, :, rows, columns], steps=steps, rate=RATE
            )
            share = down[:, None].to(part) * right.to(part)
            total[:, rows, columns] += share * part[0]
            weights[:, rows, columns] += share
    return total / weights


def _parts(length: int) -> list[tuple[slice, Tensor]]:
    """Where to cut a side, and how much each part counts there: less and less in what it shares."""
    count = max(1, math.ceil((length - SHARED) / (AT_ONCE - SHARED)))
    size = math.ceil((length + (count - 1) * SHARED) / count)
    starts = [min(index * (size - SHARED), length - size) for index in range(count)]
    place = torch.arange(size) + 0.5
    return [(slice(start, start + size), torch.minimum(place, size - place).clamp(max=SHARED)) for start in starts]


def _with_colours_of(picture: Tensor, other: Tensor) -> Tensor:
    """With the mean and covariance of another one's colours; what is brighter stays brighter."""
    basis = picture.new_tensor(BASIS)
    own, theirs = (basis @ one.flatten(1) for one in (picture, other))
    aim = torch.cov(theirs, correction=0)
    steady = STEADY * aim + 1e-5 * torch.eye(3).to(aim)
    have, want = (torch.linalg.cholesky(part + steady) for part in (torch.cov(own, correction=0), aim))
    back = torch.linalg.inv(basis) @ want
    moved = back @ torch.linalg.solve_triangular(have, own - own.mean(1, keepdim=True), upper=False)
    return (moved + other.flatten(1).mean(1, keepdim=True)).view_as(picture)


def _by_paints(picture: Tensor, exemplar: Tensor) -> Tensor:
    """As bright as it is, in what the exemplar has of such colours: a loss also tints what no paint would."""
    flat = exemplar.flatten(1)
    some = torch.randperm(flat.shape[1], generator=torch.Generator().manual_seed(0))[:PAINTS]
    paints, basis = flat[:, some.to(flat.device)].T, flat.new_tensor(BASIS)
    parts = []
    for part in picture.flatten(1).T.split(2**14):  # 34 MB at once
        mixed = torch.softmax(torch.cdist(part, paints).square() / (-2 * ALIKE**2), dim=1) @ paints
        parts.append(torch.cat([part @ basis[:1].T, mixed @ basis[1:].T], dim=1))
    return (torch.cat(parts) @ torch.linalg.inv(basis).T).T.view_as(picture)


@in_float32
def texture_transfer(
    picture: Tensor,
    *,
    exemplar: Tensor,
    detail: float = 4.0,
    seam: float = 6.0,
    flow: float = 2.0,
    colour: float = 0.0,
    local: float = 1.0,
    glaze: Tensor | float = 0.6,
    palette: float = 1.0,
    turns: int = 8,
    steps: int = 20,
    motion: Any = None,
    generator: torch.Generator | None = None,
    kept: ValueCache | None = None,
) -> Tensor:
    """Paint pictures anew with pieces of an exemplar, which lie where tone, direction and colour ask for them.

    minimise over places:  detail w (t - t')^2 / var t' + (m - m')^2 / var(t' + m') + flow |v - v'|^2
                           + colour |c - c'|^2 + seam (|where pieces meet|^2 / (2 var) + 0.03)   (`pieces`)

    t is the luma beside what is around it (Gaussians of 1 and 16 pixels), in four octaves, each evened out and as
    strong beside the others as the exemplar's, all together of 1.5 times its deviation; m is the luma around, brought
    to the exemplar's distribution, v the direction of level lines at twice the angle, c the colour around; those with
    a prime are the exemplar's own, in each of its turns. w is small where a picture is even: there the exemplar goes on
    as it is. All of it is the larger the fewer places show something, since strokes all around would hide that: by
    (pi/2 mean(|t|)^2 / mean(t^2))^-2, 1 where tones are as in noise and at most 16. Directions flow from edges into
    even areas; where there are none they are drawn. What the pieces show, with the glaze, is brought to the mean and
    covariance of the exemplar's colours, and then moved a little way down on the loss that cameras are trained by, so
    that what pieces have broken goes on and a face is one, in colours that the exemplar has.

    Args:      picture: (B,3,H,W) sRGB in [0,1].  exemplar: (3,h,w) sRGB in [0,1], at least 32 pixels each way, at its
               own pixels; of more than half a megapixel the middle is taken.
               detail, seam, flow, colour: weights, >= 0.  local: share of the contrast that is evened out, 0..1.
               glaze: share of t + m, as far as the pieces do not show it, that is laid over them, by strokes, >= 0.
               palette: share of the way to the exemplar's colours, 0..1.
               turns: of the exemplar, evenly spread over a whole one; 1 leaves its strokes as they lie.
               steps: down on the loss (`style.StyleLoss`), two thirds of the time; none where the picture or the
               exemplar has a side of less than 64 pixels.
               motion: the pictures are frames of a film, and what they show moves by so many pixels (x, y) from each
               to the next: (2,), (B-1,2), or (B-1,2,H,W) of each pixel of the later one. Strokes move with it. One that
               points out of the picture says that a pixel was not in view.
               generator: of what chance offers; None for torch's default one.
               kept: keeps what is made of the exemplar for the next call.
    Returns:   same shape, in [0,1]. Differentiable in the exemplar, by the pieces that were taken, and in the picture
               and the glaze as far as that is laid over: which piece lies where has no slope, and the steps pass
               slopes on as they are. Transforms of torch.func need steps=0.
    Raises:    TypeError, ValueError for what is no picture, NaN, or an exemplar that is too small or flat.
    Source:    Efros and Freeman, Image quilting for texture synthesis and transfer, SIGGRAPH 2001, texture transfer;
               Hertzmann et al., Image analogies, SIGGRAPH 2001, by luminance and in turns; Reinhard et al., Color
               transfer between images (2001), the palette, with covariances, triangular from the luma on; He,
               Sun and Tang, Guided image filtering, ECCV 2010, the glaze.

    Example:
    >>> stripes = (torch.arange(64) % 8 < 4).float().expand(3, 64, 64) * 0.8 + 0.1
    >>> painted = isp.texture_transfer(torch.rand(1, 3, 32, 40), exemplar=stripes)
    >>> painted.shape, bool(painted.std() > 0.3)  # stripes, whatever it shows
    (torch.Size([1, 3, 32, 40]), True)
    """
    if picture.numel() == 0:
        return picture
    check_exemplar(exemplar)
    _check_whole(turns=(turns, 1), steps=(steps, 0))
    if not picture.isfinite().all():  # tones are compared with those of the whole picture
        count = int((~picture.isfinite()).sum())
        raise ValueError(
            f"picture has {count} values that are NaN or infinite. Use picture.nan_to_num() or find out why."
        )
    if generator is None:
        generator = torch.Generator("cpu").manual_seed(int(torch.randint(2**62, (), dtype=torch.long)))
    shown = cropped(exemplar.to(picture))
    if not recorded(shown):  # what trains elsewhere, shown without a graph
        shown = shown.detach()
    finished = bool(steps) and min(*picture.shape[-2:], *shown.shape[-2:]) >= SteerableFeatures.least

    def build() -> tuple[Exemplar, StyleLoss | None]:
        source = Exemplar.of(shown, turns=turns, detail=detail, flow=flow, colour=colour)
        return source, StyleLoss(shown.detach(), **FINISH) if finished else None

    source, loss = (kept or ValueCache()).get((shown, turns, detail, flow, colour, finished), build)
    how: Any = {"local": local, "seam": seam, "glaze": glaze, "palette": palette, "loss": loss, "steps": steps}
    moved = None if motion is None else in_whole_pixels(motions(motion, picture))
    painted: list[Tensor] = []
    before = None
    for index, one in enumerate(picture):
        along = None if moved is None or not index else (*before, moved[index - 1])  # type: ignore[misc]
        shot, before = _transferred(one, source, **how, before=along, generator=generator)
        painted.append(shot)
    return torch.stack(painted)


class TextureTransfer(Stage):
    """Texture transfer behind ToneCurve: `texture_transfer`, which paints a picture with pieces of a painting.

    It learns nothing by itself: what it needs is the painting. An exemplar that is an nn.Parameter trains. What was
    made of it is kept for the next picture.

    Args:      exemplar: (3,h,w) sRGB in [0,1], at least 32 pixels each way; it is saved with the camera.
               detail, seam, flow, colour: weights, >= 0.  local, palette: 0..1.  glaze: >= 0.  turns: 1 or more.
               steps: 0 or more.
               seed: of what chance offers; None: from the camera's generator, each picture another one.
    Raises:    TypeError, ValueError for an exemplar that is no picture, flat or too small, or values out of range.

    Example:
    >>> from kcam.style import painting
    >>> camera = Camera(*Camera.phone(), isp.TextureTransfer(painting("woodcut", size=128)))
    >>> camera(Scene.builtin("coffee", size=48)).shape
    torch.Size([1, 3, 32, 48])
    """

    exemplar: Tensor
    glaze: Tensor | float

    def __init__(
        self,
        exemplar: Tensor,
        *,
        detail: float = 4.0,
        seam: float = 6.0,
        flow: float = 2.0,
        colour: float = 0.0,
        local: float = 1.0,
        glaze: Tensor | float = 0.6,
        palette: float = 1.0,
        turns: int = 8,
        steps: int = 20,
        seed: int | None = None,
    ) -> None:
        super().__init__()
        check_exemplar(exemplar)
        for name, value in (("detail", detail), ("seam", seam), ("flow", flow), ("colour", colour), ("glaze", glaze)):
            check_not_negative(value, name=name, unit="(0 for nothing)")
        for name, value in (("local", local), ("palette", palette)):
            check_not_negative(value, name=name, unit="(0 for nothing)", most=1.0)
        _check_whole(turns=(turns, 1), steps=(steps, 0), seed=(0 if seed is None else seed, 0))
        hold(self, exemplar=exemplar, glaze=glaze)
        self.detail, self.seam, self.flow, self.colour = detail, seam, flow, colour
        self.local, self.palette, self.turns, self.steps, self.seed = local, palette, turns, steps, seed
        self._kept = ValueCache()

    def mean(self) -> TextureTransfer:
        """One picture of those that it paints, always the same, not their mean. Shares the exemplar."""
        still = copy.copy(self)
        still.seed = 0 if self.seed is None else self.seed
        return still

    def film(self, frames: Tensor, motion: Any, *, generator: torch.Generator | None = None) -> Tensor:
        """Paint the frames (T,3,H,W) of a film so that strokes move with what they show.

        Args:      motion: from each frame to the next, pixels (x, y): (2,), (T-1,2), or (T-1,2,H,W) of each pixel of
                   the later one, such as another library's optical flow, backward and negated.
        Raises:    TypeError, ValueError for a motion of another shape, or one that is not finite.
        """
        return self._painted(frames, generator, motion)

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,3,H,W) sRGB in [0,1] to the same shape."""
        return self._painted(signal, (context or Context()).generator, None)

    def _painted(self, signal: Tensor, told: torch.Generator | None, motion: Any) -> Tensor:
        check_signal(signal, channels=(3,))
        if signal.ndim != 4 or signal.shape[1] != 3:
            raise ValueError(
                f"TextureTransfer repaints pictures (B,3,H,W), got shape {tuple(signal.shape)}. Put it behind the "
                f"ToneCurve.{remedy(signal, name='signal', channels=(3,), ndims=(4,), scaled=False)}"
            )
        return texture_transfer(
            signal,
            exemplar=self.exemplar,
            detail=self.detail,
            seam=self.seam,
            flow=self.flow,
            colour=self.colour,
            local=self.local,
            glaze=self.glaze,
            palette=self.palette,
            turns=self.turns,
            steps=self.steps,
            motion=motion,
            generator=told if self.seed is None else torch.Generator("cpu").manual_seed(self.seed),
            kept=self._kept,
        )


def _check_whole(**numbers: tuple[int, int]) -> None:
    """ValueError for a number that is none or less than its least."""
    for name, (number, least) in numbers.items():
        if isinstance(number, bool) or not isinstance(number, int) or number < least:
            raise ValueError(f"{name} must be a whole number of at least {least}, got {number!r}.")
