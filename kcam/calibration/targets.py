"""What a picture of points or of a slanted edge shows of a PSF: where the targets are, and how they would look.

Both are linear in the PSF, which comes as samples of the irradiance that are fine enough to hold all of it (half of
lambda N apart), so a picture of it at any sub-pixel place follows by Fourier sums without an interpolation's error:

    point   m(p) = b + a sum_f H(f) sinc(f_x w) sinc(f_y w) exp(2 pi i f.(p - p_0)),   H the PSF's spectrum
    edge    m(p) = b + a [ 1/2 + 2/pi sum_k Im( H(f_k n) sincs exp(2 pi i f_k d) ) / k ],  k odd, d = n.p - d_0

with w the width of a pixel's light-sensitive square.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy
import torch
from torch import Tensor

LEAST_SLANT = 1.5  # degrees from the rows or columns
_SMOOTH = 1.2  # pixels, sigma of what finds targets
_POINT_SHARE = 0.05  # of the brightest pixel: a point's outline
_FAINTEST = 0.2  # of the brightest point's light: what is fainter is a ghost, or a part of a blur
_LEAST_HALF = 4  # pixels from a point to the edge of its window
_EDGE_REACH = (8.0, 40.0)  # pixels on either side of an edge that are looked at, at least and at most
_STRAIGHT = 0.6  # coherence of the gradients of a straight edge; of round points it is 0
_LEVEL, _NEARLY = 1e-6, 1e-3  # relative: values at one converter's end; noise is more
_PLATEAU = 3  # pixels that touch: two photon counts may be the same


@dataclass(frozen=True)
class Targets:
    """Pixels of S targets, and where these start: n pixels each, of which `used` count.

    values, used, x, y: (S, n), x and y in pixels from the target's own origin. picture: (S,) which it is in.
    origin: (S, 2) x, y of that origin in the picture [pixels]. start: (S, 2) of a point its place, of an edge the angle
    of its normal [rad] and its distance from the origin [pixels]. reach: pixels that a PSF may spread over.
    """

    kind: str
    values: Tensor
    used: Tensor
    x: Tensor
    y: Tensor
    picture: Tensor
    origin: Tensor
    start: Tensor
    reach: float

    def shapes(self, bank: Tensor, which: Tensor, place: Tensor, *, step: float, width: float, upright: bool) -> Tensor:
        """How the targets look for PSFs bank (..., Q, M, M) of samples `step` pixels apart, (..., S, n).

        which: (S,) PSF of each target. place: (S, 2), as `start`. width: of a pixel's light-sensitive square.
        upright: whether the picture is turned by 180 degrees against the light on the sensor.
        """
        draw = self._points if self.kind == "points" else self._edges
        return draw(bank, which, place, step, width, upright)

    def _points(self, bank: Tensor, which: Tensor, place: Tensor, step: float, width: float, upright: bool) -> Tensor:
        count = bank.shape[-1]
        side = round(math.sqrt(self.x.shape[1]))
        frequency = torch.fft.fftfreq(count, d=step, dtype=torch.float64)  # cycles per pixel
        spectrum = torch.fft.fft2(torch.fft.ifftshift(bank, dim=(-2, -1)))
        spectrum = spectrum.conj() if upright else spectrum  # of a real PSF, turned
        blur = torch.sinc(frequency * width)
        along = [(axis - place[:, index, None]) for index, axis in enumerate((self.x[:, :side], self.y[:, ::side]))]
        waves = [torch.polar(blur.expand(*p.shape, -1), 2 * math.pi * p[..., None] * frequency) for p in along]
        found = torch.einsum("sjf,...sfg->...sjg", waves[1], spectrum[..., which, :, :])
        found = torch.einsum("...sjg,skg->...sjk", found, waves[0]).real
        return found.flatten(-2) / (count * step) ** 2

    def _edges(self, bank: Tensor, which: Tensor, place: Tensor, step: float, width: float, upright: bool) -> Tensor:
        count = bank.shape[-1]
        at = (torch.arange(count, dtype=torch.float64) - count // 2) * step
        cos, sin = place[:, 0].cos(), place[:, 0].sin()
        distance = self.x * cos[:, None] + self.y * sin[:, None] - place[:, 1, None]
        period = 2 * (math.sqrt(2) * float(at[-1]) + self.reach + 2)  # no light reaches the next edge
        orders = torch.arange(1, math.ceil(period / (2 * step)) + 1, 2, dtype=torch.float64)
        frequency = orders / period
        turns = 2 * math.pi * frequency[:, None]
        one = torch.ones((), dtype=torch.float64)
        columns, rows = (torch.polar(one, -(turns * at) * part[:, None, None]) for part in (cos, sin))  # (S, K, M)
        own = bank[..., which, :, :].to(columns.dtype)
        transfer = (torch.einsum("...sab,skb->...ska", own, columns) * rows).sum(-1)
        transfer = transfer.conj() if upright else transfer
        blur = torch.sinc(frequency * width * cos[:, None]) * torch.sinc(frequency * width * sin[:, None])
        waves = torch.polar(one, 2 * math.pi * distance[..., None] * frequency)  # (S, n, K)
        rise = torch.einsum("...sk,snk->...sn", transfer * (blur / orders), waves).imag
        return 0.5 * bank[..., which, :, :].sum((-2, -1))[..., None] + 2 / math.pi * rise


def coherence(pictures: Tensor) -> float:
    """How far gradients have one direction, 0..1: of a straight edge 1, of points 0."""
    return max(_gradient_direction(picture)[1] for picture in pictures[:, 0].numpy())


def find_targets(pictures: Tensor, *, kind: str, points: Tensor | None) -> Targets:
    """Points or an edge in pictures (N,1,H,W) float64; points (K, 2) where somebody knows them, x and y [pixels]."""
    if kind == "auto":
        kind = "points" if points is not None or not _has_edge(pictures) else "edge"
    return find_points(pictures, points) if kind == "points" else find_edges(pictures)


def _has_edge(pictures: Tensor) -> bool:
    smooth = scipy.ndimage.gaussian_filter(pictures[0, 0].numpy(), _SMOOTH)
    low, high = np.quantile(smooth, [0.01, 0.999])
    return coherence(pictures) > _STRAIGHT and 0.05 < float((smooth > (low + high) / 2).mean()) < 0.95


def find_points(pictures: Tensor, known: Tensor | None) -> Targets:
    """Windows around the points of each picture.

    Raises: ValueError where there are none, or no window fits.
    """
    height, width = pictures.shape[-2:]
    found: list[tuple[int, float, float]] = []
    extent = 0.0
    for index, picture in enumerate(pictures[:, 0].numpy()):
        places, size = _blobs(picture)
        if known is not None:
            places = [(float(x), float(y)) for x, y in known]
        if not places:
            raise ValueError(
                f"picture {index} shows no points: nothing stands out of its noise by 6 sigma. Expose longer, or give "
                "their places, points=torch.tensor([[x, y]]) in pixels."
            )
        extent = max(extent, size)
        found += [(index, *place) for place in places]
    middle = np.array(found)
    half = math.ceil(0.75 * extent + 5)
    for index in range(len(pictures)):
        own = middle[middle[:, 0] == index, 1:]
        if len(own) > 1:
            apart = np.hypot(*(own[:, None] - own[None]).transpose(2, 0, 1)) + 1e9 * np.eye(len(own))
            half = min(half, int(apart.min() / 2))
    corner = np.rint(middle[:, 1:])
    room = np.minimum(corner, [width - 1, height - 1] - corner).min(axis=1)
    half = min(half, int(room.max()))
    if half < _LEAST_HALF:
        raise ValueError(
            f"the windows around the points would be {2 * half + 1} pixels wide, expected {2 * _LEAST_HALF + 1} or "
            f"more: the picture of {width} x {height} pixels is too small, its points lie at its border, or closer "
            f"than {2 * _LEAST_HALF} pixels to each other."
        )
    keep = room >= half
    middle, corner = middle[keep], corner[keep]
    side = np.arange(-half, half + 1)
    rows, columns = (corner[:, axis, None].astype(int) + side for axis in (1, 0))
    picked = pictures[:, 0].numpy()[middle[:, 0].astype(int)[:, None, None], rows[:, :, None], columns[:, None, :]]
    y, x = (torch.from_numpy(np.broadcast_to(a, picked.shape).reshape(len(picked), -1).astype(float)) for a in
            (side[None, :, None], side[None, None, :]))  # fmt: skip
    values = torch.from_numpy(picked.reshape(len(picked), -1))
    return Targets(
        "points",
        values,
        torch.ones_like(values, dtype=torch.bool),
        x,
        y,
        torch.from_numpy(middle[:, 0].astype(int)),
        torch.from_numpy(corner),
        torch.from_numpy(middle[:, 1:] - corner),
        reach=half + 3.0,
    )


def _blobs(picture: np.ndarray) -> tuple[list[tuple[float, float]], float]:
    """Middles (x, y) of what stands out, and how wide the widest is [pixels]."""
    background = float(np.median(picture))
    smooth = scipy.ndimage.gaussian_filter(picture - background, _SMOOTH, mode="nearest")
    noise = 1.4826 * float(np.median(np.abs(smooth - np.median(smooth))))
    peak = float(smooth.max())
    if peak <= 6 * noise:
        return [], 0.0
    outline = scipy.ndimage.binary_closing(np.pad(smooth > max(6 * noise, _POINT_SHARE * peak), 4), np.ones((5, 5)))
    labels, count = scipy.ndimage.label(outline[4:-4, 4:-4], np.ones((3, 3)))
    index = np.arange(1, count + 1)
    light = np.asarray(scipy.ndimage.sum_labels(smooth, labels, index))
    kept = index[light > _FAINTEST * light.max()]
    middles = scipy.ndimage.center_of_mass(np.maximum(smooth, 0), labels, kept)
    spans = [scipy.ndimage.find_objects(labels)[k - 1] for k in kept]
    extent = max(max(s.stop - s.start for s in span) for span in spans)
    return [(float(x), float(y)) for y, x in middles], float(extent)


def _gradient_direction(picture: np.ndarray) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Angle of the gradient [rad], coherence, and the gradients along x and y."""
    gy, gx = (scipy.ndimage.gaussian_filter(picture, 2.0, order=order, mode="nearest") for order in ((1, 0), (0, 1)))
    strength = np.hypot(gx, gy)
    clear = strength > 0.3 * strength.max()
    xx, yy, xy = ((a * b)[clear].sum() for a, b in ((gx, gx), (gy, gy), (gx, gy)))
    angle = 0.5 * math.atan2(2 * xy, xx - yy)
    if (gx * math.cos(angle) + gy * math.sin(angle))[clear].sum() < 0:
        angle += math.pi
    return angle, float(np.hypot(xx - yy, 2 * xy) / max(xx + yy, 1e-300)), gx, gy


def find_edges(pictures: Tensor) -> Targets:
    """The pixels along a straight edge in each picture.

    Raises: ValueError where there is none, or it runs along the rows or columns.
    """
    height, width = pictures.shape[-2:]
    if min(height, width) < 2 * _EDGE_REACH[0]:
        raise ValueError(
            f"a picture of {width} x {height} pixels is too small for a slanted edge, expected {2 * _EDGE_REACH[0]:g} "
            "pixels or more on each side."
        )
    middle = ((width - 1) / 2, (height - 1) / 2)
    y, x = np.meshgrid(np.arange(height) - middle[1], np.arange(width) - middle[0], indexing="ij")
    starts, spans = [], []
    for index, picture in enumerate(pictures[:, 0].numpy()):
        angle, straight, gx, gy = _gradient_direction(picture)
        if straight < _STRAIGHT:
            raise ValueError(
                f"picture {index} shows no straight edge: its gradients agree in direction by {straight:.2f}, expected "
                f"{_STRAIGHT:g} or more. Cut out the edge alone, with a flat dark and a flat bright side."
            )
        slant = abs((math.degrees(angle) + 45) % 90 - 45)
        if slant < LEAST_SLANT:
            raise ValueError(
                f"the edge of picture {index} is {slant:.2f} degrees off the pixels' rows or columns, so that all rows "
                f"sample it alike; expected {LEAST_SLANT:g} degrees or more. Slant it by 5 degrees."
            )
        along = np.maximum(gx * math.cos(angle) + gy * math.sin(angle), 0) ** 4
        distance = x * math.cos(angle) + y * math.sin(angle)
        offset = float((along * distance).sum() / along.sum())
        spread = math.sqrt(float((along * (distance - offset) ** 2).sum() / along.sum()))
        starts.append((angle, offset))
        spans.append(spread)
    reach = min(max(8 * max(spans), _EDGE_REACH[0]), _EDGE_REACH[1])
    close = [np.abs(x * math.cos(a) + y * math.sin(a) - d) <= reach for a, d in starts]
    count = max(int(part.sum()) for part in close)
    pixels = [np.flatnonzero(part) for part in close]
    padded = torch.from_numpy(np.stack([np.pad(part, (0, count - len(part))) for part in pixels]))
    used = torch.stack([torch.arange(count) < len(part) for part in pixels])
    flat_x, flat_y = (torch.from_numpy(part.ravel())[padded] for part in (x, y))
    return Targets(
        "edge",
        pictures[:, 0].flatten(1).gather(1, padded),
        used,
        flat_x,
        flat_y,
        torch.arange(len(pictures)),
        torch.tensor([middle] * len(pictures), dtype=torch.float64),
        torch.tensor(starts, dtype=torch.float64),
        reach=reach,
    )


def check_saturation(found: Targets, pictures: Tensor) -> None:
    """ValueError where a target has pixels at 1.0, or a plateau at the highest value, as of black taken off after it.

    Light has no plateau but in pictures without noise: there the pixels around it are alike too, or as bright within
    a step or two of the converter.
    """
    for index, values in enumerate(found.values):
        used = found.used[index]
        picture = pictures[int(found.picture[index]), 0].numpy()
        top = float(picture.max())
        x, y = (found.origin[index] + torch.stack([found.x[index], found.y[index]], -1)[used]).round().long().T.numpy()
        labels, _ = scipy.ndimage.label(picture >= top * (1 - _LEVEL), np.ones((3, 3)))
        most = 0
        for label in set(labels[y, x].tolist()) - {0} if top > 0 else ():
            plateau = labels == label
            around = picture[scipy.ndimage.binary_dilation(plateau, np.ones((3, 3))) & ~plateau]
            levels = np.unique((around / (top * _LEVEL)).round()) * top * _LEVEL
            unlike = len(levels) > 4  # more than of a PSF in the middle of four pixels
            if (
                plateau.sum() >= _PLATEAU
                and unlike
                and top - around.mean() > max(_NEARLY * top, 2 * np.diff(levels).min())
            ):
                most = max(most, int(plateau.sum()))
        full = int(((values >= 1.0) & used).sum())
        if most or (float(values.max()) == 1.0 and full > 1):
            x, y = found.origin[index].tolist()
            raise ValueError(
                f"{most or full} pixels of the target near x = {x:.0f}, y = {y:.0f} are at {top:.4g}: saturated, so "
                "that the shape of its peak is lost. Expose at most 0.8 of the full well."
            )
