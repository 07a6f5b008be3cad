"""How far a picture is from a style, and from what it shows: the thesis's losses, and the ones that train well.

Pictures are (B,3,H,W) sRGB in [0,1]; every loss is a 0-d tensor, the mean over the batch.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from kcam.inputs import check_floats, check_picture, remedy
from kcam.srgb import LUMINANCE
from kcam.texture.features import SteerableFeatures

FLOOR = 0.1  # of a natural picture's variance: what a flat style is divided by
DIRECTIONS = 16  # of colour
TURNS = 4
COLOUR_FLOOR = 0.05  # least standard deviation that a style's colours are divided by


# ---- the thesis's, eq. 3.10 to 3.13 -------------------------------------------------------------------------------


def content_loss(features: Tensor, target: Tensor) -> Tensor:
    """l_content = ||phi(y) - phi(t)||^2 / (C H W), features (B,C,H,W). Source: eq. 3.10; Johnson et al. (2016)."""
    return (features - target).square().mean()


def gram_matrix(features: Tensor) -> Tensor:
    """G_cd = sum_hw phi_hwc phi_hwd / (C H W), (B,C,H,W) to (B,C,C). Source: eq. 3.11; Johnson et al. (2016)."""
    flat = features.flatten(2)
    return flat @ flat.mT / (flat.shape[1] * flat.shape[2])


def gram_loss(gram: Tensor, target: Tensor) -> Tensor:
    """l_style = ||G(y) - G(t)||_F^2, (B,C,C) or (C,C). Source: eq. 3.12."""
    return (gram - target).square().sum((-2, -1)).mean()


def l2_loss(picture: Tensor, target: Tensor) -> Tensor:
    """l_l2 = ||y - t||^2 / (C H W). Source: the l_l2 of eq. 3.13; Johnson et al. (2016), pixel loss."""
    return (picture - target).square().mean()


def total_variation(picture: Tensor) -> Tensor:
    """Mean squared difference of neighbours, down and across. Source: Johnson et al. (2016), after Mahendran (2015)."""
    down = (picture[..., 1:, :] - picture[..., :-1, :]).square().mean()
    across = (picture[..., 1:] - picture[..., :-1]).square().mean()
    return down + across


# ---- what trains well ---------------------------------------------------------------------------------------------


def moments(features: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (B,C) and centred covariance (B,C,C) of features (B,C,H,W) over the pixels."""
    return _Moments.apply(features.flatten(2))


class _Moments(torch.autograd.Function):
    """Mean and covariance of (B,C,N) over N, whose gradient goes through memory once instead of six times."""

    generate_vmap_rule = True

    @staticmethod
    def forward(flat):
        mean = flat.mean(2)
        centred = flat - mean[:, :, None]
        return mean, centred @ centred.mT / flat.shape[2]

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.save_for_backward(inputs[0], output[0])

    @staticmethod
    def backward(ctx, d_mean, d_covariance):
        flat, mean = ctx.saved_tensors
        count = flat.shape[2]
        both = (d_covariance + d_covariance.mT).to(flat) / count
        # onto both @ (flat - mean), without a centred copy; what moves the mean moves no covariance
        shift = d_mean.to(flat) / count - torch.einsum("bcd,bd->bc", both, mean.to(flat))
        return torch.bmm(both, flat).add_(shift[:, :, None])


def moment_loss(
    mean: Tensor, covariance: Tensor, *, target_mean: Tensor, target_covariance: Tensor, natural: float
) -> Tensor:
    """How far mean and covariance are from a style's, relative to how much the style itself varies.

    ||mu - mu_s||^2 / (tr C_s + c v)  +  ||C - C_s||_F^2 / (||C_s||_F^2 + c v^2),   c channels, v = 0.1 natural

    Unlike a Gram matrix it does not weigh the layers by their scale, and a style without contrast stays finite.

    Args:      mean: (B,c).  covariance: (B,c,c).  target_mean: (c,).  target_covariance: (c,c).
               natural: variance per channel of natural pictures.
    """
    channels, floor = len(target_mean), FLOOR * natural
    of_mean = (mean - target_mean).square().sum(-1) / (target_covariance.trace() + channels * floor)
    scale = target_covariance.square().sum() + channels * floor**2
    of_covariance = (covariance - target_covariance).square().sum((-2, -1)) / scale
    return (of_mean + of_covariance).mean()


def colour_directions() -> Tensor:
    """Directions spread evenly over half of a sphere, (16,3) float64: a Fibonacci lattice."""
    index = torch.arange(DIRECTIONS, dtype=torch.float64) + 0.5
    z = 1 - index / DIRECTIONS
    angle = index * math.pi * (3 - math.sqrt(5))
    ring = torch.sqrt(1 - z**2)
    return torch.stack([ring * torch.cos(angle), ring * torch.sin(angle), z], dim=1)


def colour_loss(picture: Tensor, *, directions: Tensor, quantiles: Tensor, deviation: Tensor) -> Tensor:
    """Sliced Wasserstein distance of the colours: how far pixels must move, seen along some directions.

    mean over directions d of  mean_i |sort(d . x)_i - quantiles_d((i + 1/2) / n)| / deviation_d

    Args:      picture: (B,3,H,W).  directions: (D,3).  quantiles: (D,Q) of the style's projections, ascending.
               deviation: (D,) of these.
    Source:    Rabin et al., Wasserstein barycenter and its application to texture mixing (2011).
    """
    projected = torch.einsum("dc,bcn->bdn", directions, picture.flatten(2)).sort(-1).values
    moved = (projected - resampled(quantiles, projected.shape[-1])).abs().mean(-1)
    return (moved / deviation).mean()


def resampled(quantiles: Tensor, count: int) -> Tensor:
    """Ascending values (D,Q) at the ranks (i + 1/2) / count, (D,count)."""
    own = quantiles.shape[-1]
    if own == count:
        return quantiles
    place = ((torch.arange(count, device=quantiles.device) + 0.5) * (own / count) - 0.5).clamp(0, own - 1)
    low = place.long().clamp(max=max(own - 2, 0))
    share = (place - low).to(quantiles)
    return quantiles[:, low] * (1 - share) + quantiles[:, (low + 1).clamp(max=own - 1)] * share


def luminance(picture: Tensor) -> Tensor:
    """(B,3,H,W) to (B,1,H,W): the luma of Rec. 709, of coded values."""
    return torch.einsum("c,bchw->bhw", picture.new_tensor(LUMINANCE), picture)[:, None]


def correlation_loss(
    picture: Tensor,
    scene: Tensor,
    *,
    levels: tuple[int, ...],
    window: int = 11,
    whole: bool = False,
    flat: float = 1e-3,
    sparse: float = 1.0,
) -> Tensor:
    """How much of what the scene shows is lost: local correlation of luminance, blind to colour, not to the sign.

    mean over levels and windows of  w (1 - cov(y, t) / sqrt(var y var t)),   w = var t / (var t + flat)

    A negative scores up to twice as high as a picture that shows nothing. Coarse levels leave room for strokes, and
    with `whole` what is bright stays brighter than what is dark, strokes and all.

    Args:      picture, scene: (B,3,H,W).  levels: factors by which both are averaged first.  window: side [pixels].
               whole: count the whole picture, at full size and as one window, as one level more.
               flat: local variance of luminance below which the scene's contents count less.
               sparse: the mean is divided by that of w, yet by no less than this. At 1 it is one over all windows, near
               0 one over those that show something: a face before a wall counts like one among leaves.
    """
    y, t = (x - x.mean((-2, -1), keepdim=True) for x in (luminance(picture), luminance(scene)))  # for rounding alone
    losses = []
    for level in levels:
        coarse = F.avg_pool2d(y, level), F.avg_pool2d(t, level)
        side = min(window, *coarse[0].shape[-2:])
        losses.append(_lost(*coarse, (side, side), flat, sparse))
    if whole:
        losses.append(_lost(y, t, y.shape[-2:], flat, sparse))
    return torch.stack(losses).mean()


def _lost(y: Tensor, t: Tensor, side: tuple[int, ...], flat: float, sparse: float) -> Tensor:
    """One level of `correlation_loss`, in windows of some rows and columns."""
    mean_y, mean_t, square_y, square_t, product = F.avg_pool2d(
        torch.cat([y, t, y * y, t * t, y * t], dim=1), side, stride=1
    ).split(1, dim=1)
    var_y = (square_y - mean_y**2).clamp(min=0) + 1e-5
    var_t = (square_t - mean_t**2).clamp(min=0)
    correlation = (product - mean_y * mean_t) / (var_y * (var_t + 1e-5)).sqrt()
    weight = var_t / (var_t + flat)
    weight = weight / weight.mean((1, 2, 3), keepdim=True).clamp(min=sparse)
    return (weight * (1 - correlation)).mean()


# ---- all together -------------------------------------------------------------------------------------------------

STATISTICS = ("moments", "gram")
CONTENTS = ("correlation", "features")


class StyleLoss(nn.Module):
    """How far a picture is from a style picture and from what it should show: a weighted sum of named terms.

    total = style L_style + colour L_colour + content L_content + l2 L_l2 + tv L_tv                       (eq. 3.13)

    The style's own side is computed once, here, from crops at the picture's own pixels, which are never shrunk.

    Args:
        picture: the style, (3,H,W) sRGB in [0,1], at least as large as the features ask.
        features: a module of layers, such as `SteerableFeatures` (the default) or `VGG16Features`.
        statistic: "moments" (`moment_loss`) or "gram" (eq. 3.12), the mean and the sum over the layers.
        content_by: "correlation" (`correlation_loss`), or "features": eq. 3.10 at the layer `content_layer`.
        style, colour, content, l2, tv: weights; a term of weight 0 is not computed.
        levels, window, whole, flat, sparse: of the correlation.
        content_layer: of the features, where content_by is "features".
        crop: side of the crops of the style; None: 128 pixels, or the style's shorter side.
    Raises:    ValueError for an unknown name, weights that are negative or all 0, or a style that is too small;
               TypeError for what is no picture.

    Example:
    >>> from kcam.style import StyleLoss, painting
    >>> loss, picture = StyleLoss(painting("woodcut", size=128)), torch.rand(1, 3, 64, 64)
    >>> terms = loss.terms(picture, scene=picture)
    >>> list(terms), bool(terms["content"] < 1e-3)  # a picture shows itself
    (['style', 'colour', 'content'], True)
    """

    features: Any
    quantiles: Tensor
    deviation: Tensor

    def __init__(
        self,
        picture: Tensor,
        *,
        features: nn.Module | None = None,
        statistic: str = "moments",
        content_by: str = "correlation",
        style: float = 1.0,
        colour: float = 0.5,
        content: float = 0.2,
        l2: float = 0.0,
        tv: float = 0.0,
        levels: tuple[int, ...] = (1, 2, 4),
        window: int = 11,
        whole: bool = False,
        flat: float = 1e-3,
        sparse: float = 1.0,
        content_layer: str = "relu3_3",
        crop: int | None = None,
    ) -> None:
        super().__init__()
        for name, value, known in (("statistic", statistic, STATISTICS), ("content_by", content_by, CONTENTS)):
            if value not in known:
                raise ValueError(f"unknown {name} {value!r}; known: {', '.join(known)}.")
        self.weights = {"style": style, "colour": colour, "content": content, "l2": l2, "tv": tv}
        for name, weight in self.weights.items():
            if not 0 <= weight < math.inf:
                raise ValueError(f"the weight of {name} must be a finite number >= 0, got {weight!r}.")
        if not any(self.weights.values()):
            raise ValueError("all weights are 0: no term is left. Give one, such as style=1.")
        if not levels or min(levels) < 1:
            raise ValueError(f"levels must be whole numbers of at least 1, got {levels!r}. Use levels=(1, 2, 4).")
        if window < 2:
            raise ValueError(f"window must be at least 2 pixels, got {window!r}. Use window=11.")
        if not 0 < flat < math.inf:
            raise ValueError(f"flat must be a finite variance > 0, got {flat!r}. Use flat=1e-3.")
        if not 0 < sparse <= 1:
            raise ValueError(f"sparse must be a share of the windows within 0..1, not 0, got {sparse!r}. Use sparse=1.")
        self.features = SteerableFeatures() if features is None else features
        self.statistic, self.content_by = statistic, content_by
        self.correlation: dict[str, Any] = {
            "levels": tuple(levels), "window": window, "whole": whole, "flat": flat, "sparse": sparse,
        }  # fmt: skip
        self.content_layer = content_layer
        with torch.inference_mode(False), torch.no_grad():  # what is made there cannot be differentiated through
            own = picture.clone() if isinstance(picture, Tensor) else picture
            crops = style_crops(own, side=crop, multiple=self.features.multiple, least=self.features.least)
            self.crop = crops.shape[-1]
            self._remember(crops)
        if content_by == "features" and content_layer not in self.targets:
            raise ValueError(f"unknown content_layer {content_layer!r}; known: {', '.join(self.targets)}.")

    def _remember(self, crops: Tensor) -> None:
        """The style's own side of each term: pooled over its crops."""
        projected = torch.einsum("dc,bcn->dbn", colour_directions().to(crops), crops.flatten(2)).flatten(1)
        self.register_buffer("quantiles", resampled(projected.sort(-1).values, self.crop**2), persistent=False)
        self.register_buffer("deviation", projected.std(-1).clamp(min=COLOUR_FLOOR), persistent=False)
        sums: dict[str, list[Tensor]] = {}
        for crop in crops.split(4):
            for name, layer in self.features(crop).items():
                for index, part in enumerate(self._statistics(layer)):
                    sums.setdefault(f"{name}/{index}", []).append(part)
        self.targets: dict[str, tuple[Tensor, ...]] = {}
        for name in dict.fromkeys(key.split("/")[0] for key in sums):
            if self.statistic == "gram":
                self.targets[name] = (torch.cat(sums[f"{name}/0"]).mean(0),)
                continue
            means, covariances = torch.cat(sums[f"{name}/0"]), torch.cat(sums[f"{name}/1"])
            mean = means.mean(0)
            spread = means - mean
            self.targets[name] = (mean, covariances.mean(0) + spread.T @ spread / len(means))

    def _apply(self, fn: Any, recurse: bool = True) -> StyleLoss:
        super()._apply(fn, recurse)
        self.targets = {name: tuple(fn(value) for value in target) for name, target in self.targets.items()}
        return self

    def _statistics(self, layer: Tensor) -> tuple[Tensor, ...]:
        return moments(layer) if self.statistic == "moments" else (gram_matrix(layer),)

    def terms(
        self,
        picture: Tensor,
        scene: Tensor | None = None,
        *,
        recorded: tuple[Tensor, Tensor] | None = None,
        turn: int | None = None,
    ) -> dict[str, Tensor]:
        """Each term times its weight, by name; their sum is the loss.

        Args:      picture: (B,3,H,W).  scene: what it should show, (B,3,H,W), for content and, unless `recorded`, l2.
                   recorded: (y, y_l2) of eq. 3.13's l2 term, such as what a sensor records with and without optics.
                   turn: colours are compared along 4 of the 16 directions, others at the next turn: a training step's
                   number. None: along all.
        Raises:    ValueError where a term lacks what it compares with.
        """
        weights = self.weights
        terms: dict[str, Tensor] = {}
        of_features = weights["style"] or (weights["content"] and self.content_by == "features")
        layers = self.features(picture) if of_features else {}
        if weights["style"]:
            terms["style"] = weights["style"] * self._style(layers)
        if weights["colour"]:
            some = slice(None) if turn is None else slice(turn % TURNS, None, TURNS)
            terms["colour"] = weights["colour"] * colour_loss(
                picture,
                directions=colour_directions().to(picture)[some],
                quantiles=self.quantiles[some],
                deviation=self.deviation[some],
            )
        if weights["content"]:
            terms["content"] = weights["content"] * self._content(picture, _given(scene, "content", picture), layers)
        if weights["l2"]:
            pair = (picture, _given(scene, "l2", picture)) if recorded is None else recorded
            terms["l2"] = weights["l2"] * l2_loss(*pair)
        if weights["tv"]:
            terms["tv"] = weights["tv"] * total_variation(picture)
        return terms

    def forward(self, picture: Tensor, scene: Tensor | None = None) -> Tensor:
        """The sum of the terms, 0-d. Arguments: as `terms`."""
        return torch.stack(list(self.terms(picture, scene).values())).sum()

    def _style(self, layers: dict[str, Tensor]) -> Tensor:
        losses = []
        for name, target in self.targets.items():
            own = self._statistics(layers[name])
            if self.statistic == "gram":
                losses.append(gram_loss(own[0], target[0].to(own[0])))
            else:
                mean, covariance = (value.to(own[0]) for value in target)
                natural = self.features.natural[name]
                losses.append(moment_loss(*own, target_mean=mean, target_covariance=covariance, natural=natural))
        stacked = torch.stack(losses)
        return stacked.sum() if self.statistic == "gram" else stacked.mean()

    def _content(self, picture: Tensor, scene: Tensor, layers: dict[str, Tensor]) -> Tensor:
        if self.content_by == "correlation":
            return correlation_loss(picture, scene, **self.correlation)
        with torch.no_grad():
            target = self.features(scene)[self.content_layer]
        return content_loss(layers[self.content_layer], target)


def style_crops(picture: Tensor, *, side: int | None, multiple: int, least: int, most: int = 64) -> Tensor:
    """Crops that cover a style picture evenly, (N,3,s,s): at its own pixels, at most `most` of them.

    Raises:    TypeError, ValueError for what is no picture in [0,1], or one that is smaller than the features ask.
    """
    check_picture(picture, name="picture", channels=(3,), ndims=(3,))
    if side is not None and side < least:
        raise ValueError(f"crops of {side} pixels are too small: the features need at least {least}. Use crop={least}.")
    shorter = min(picture.shape[-2:])
    side = min(side or 128, shorter) // multiple * multiple
    if side < least:
        raise ValueError(
            f"a style of {picture.shape[-2]} x {picture.shape[-1]} is too small: its features need at least {least} "
            "pixels each way. Use a larger picture, not an enlarged one: strokes are measured in pixels."
        )
    counts = [max(1, math.ceil(size / side)) for size in picture.shape[-2:]]
    while counts[0] * counts[1] > most:
        counts = [max(1, count - 1) for count in counts]
    tops, lefts = (
        torch.linspace(0, size - side, count).round().int().tolist()
        for size, count in zip(picture.shape[-2:], counts, strict=True)
    )
    return torch.stack([picture[:, top : top + side, left : left + side] for top in tops for left in lefts])


def _given(scene: Tensor | None, term: str, picture: Tensor) -> Tensor:
    if scene is None:
        raise ValueError(f"the {term} term compares with a scene, and none was given. Pass scene=, or {term}=0.")
    check_floats(scene, name="scene", takes="(B,3,H,W) in [0,1]", channels=(3,), ndims=(4,))
    if scene.shape != picture.shape:
        fix = remedy(scene, name="scene", channels=(3,), ndims=(4,), scaled=False)
        raise ValueError(f"scene has shape {tuple(scene.shape)}, expected the picture's, {tuple(picture.shape)}.{fix}")
    return scene
