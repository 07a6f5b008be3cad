"""Pictures whose content has moved: along a path, row by row, or pixel by pixel."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from kcam.optics.numerics import fast_length
from kcam.optics.rendering.borders import part
from kcam.sensor.arguments import in_float32

LONGEST = 4096.0
"""Pixels that anything may move."""
_TAPS, _BEYOND = 8, 16  # of the interpolation of rows, and pixels of border beside what moves in


@in_float32
def path_blur(signal: Tensor, *, path: Tensor, border: str = "reflect") -> Tensor:
    """The mean of a picture that moves along a path of straight pieces, each of equal time: exact.

    Args:      signal: (B,C,H,W).  path: (N,2) or (B,N,2), N >= 2, x and y [pixels].  border: what lies beyond the
               picture and moves in: reflect, replicate, periodic or zero.
    Returns:   (B,C,H,W).

    Example:
    >>> line = torch.zeros(1, 1, 1, 32)
    >>> line[..., 10] = 1
    >>> moved = sensor.path_blur(line, path=torch.tensor([[3.0, 0.0], [3.0, 0.0]]), border="periodic")
    >>> int(moved.argmax()), round(float(moved.max()), 4)
    (13, 1.0)
    """
    most = min(float(path.detach().abs().max()) if path.numel() else 0.0, LONGEST)
    reach = 8 * (1 + math.floor(most / 8))  # in steps, so that a derivative sees the same border
    height, width = signal.shape[-2:]
    planes = _periodic(_periodic(signal, reach, border, dim=-2), reach, border, dim=-1)
    size = planes.shape[-2:]
    path = path.to(signal)
    path = path if path.ndim == 3 else path[None]
    fy = torch.fft.fftfreq(size[0], dtype=signal.dtype, device=signal.device)[:, None]
    fx = torch.fft.rfftfreq(size[1], dtype=signal.dtype, device=signal.device)
    transfer: Any = 0.0
    pieces = path.shape[1] - 1
    for start, stop in zip(path[:, :-1].unbind(1), path[:, 1:].unbind(1), strict=True):
        middle, span = ((start + stop) / 2)[..., None, None], (stop - start)[..., None, None]
        phase = -2 * math.pi * (fx * middle[:, 0] + fy * middle[:, 1])
        size_of = torch.sinc(fx * span[:, 0] + fy * span[:, 1]) / pieces
        transfer = transfer + torch.complex(size_of * phase.cos(), size_of * phase.sin())
    moved = torch.fft.irfft2(torch.fft.rfft2(planes) * transfer[:, None], s=size)
    return moved[..., :height, :width]


def _periodic(planes: Tensor, reach: int, border: str, *, dim: int) -> Tensor:
    """Planes with what moves in from beyond both ends, that before the first at the end, where the two fade into each
    other: a jump would ring.
    """
    n = planes.shape[dim]
    if border == "periodic":
        return planes
    length = fast_length(n + 2 * (reach + _BEYOND) + _BEYOND)
    fade = length - n - 2 * (reach + _BEYOND)
    own = part(planes, 0, n + reach + _BEYOND + fade, border, dim=dim)
    before = part(planes, -reach - _BEYOND - fade, 0, border, dim=dim)
    kept, going = own.split([n + reach + _BEYOND, fade], dim=dim)
    coming, last = before.split([fade, reach + _BEYOND], dim=dim)
    weight = torch.linspace(0, math.pi, fade, dtype=planes.dtype, device=planes.device).cos() / 2 + 0.5
    mixed = torch.lerp(coming, going, weight if dim == -1 else weight[:, None])
    return torch.cat([kept, mixed, last], dim=dim)


@in_float32
def move_rows(signal: Tensor, *, shifts: Tensor, border: str = "reflect") -> Tensor:
    """Each row of the picture as it is when the content has moved so far: result[r] = S(x - shifts[r]).

    By the polynomial through the eight nearest pixels, in x and in y: flat where light is smooth, to 1e-5 of what has
    ten pixels a period, 2e-3 of five, 0.05 of three.

    Source:    Laakso et al., Splitting the unit delay, IEEE Signal Processing Magazine 13 (1), 30 (1996): Lagrange.

    Args:      signal: (B,C,H,W).  shifts: (H,2) or (B,H,2), x and y [pixels].  border: as of `path_blur`.
    Returns:   (B,C,H,W).

    Example:
    >>> column = torch.zeros(1, 1, 3, 9)
    >>> column[..., 4] = 1
    >>> leaning = sensor.move_rows(column, shifts=torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]))
    >>> leaning.argmax(-1).flatten().tolist()
    [4, 5, 6]
    """
    batch, _, height, width = signal.shape
    shifts = shifts.to(signal).expand(batch, -1, -1) if shifts.ndim == 3 else shifts.to(signal)[None]
    rows = torch.arange(height, device=signal.device, dtype=signal.dtype)
    index, weights = _taps(rows - shifts[..., 1])  # (B or 1, H) -> (B or 1, 8, H)
    found: Any = 0.0
    planes, first = _reaching(signal, index, border, dim=-2)
    for tap in range(_TAPS):
        at = (index[:, tap] - first).clamp(0, planes.shape[-2] - 1)[:, None, :, None]
        taken = planes.gather(-2, at.expand(*signal.shape))
        found = found + weights[:, tap, :][:, None, :, None] * taken
    index, weights = _taps(-shifts[..., 0])
    columns = torch.arange(width, device=signal.device)
    planes, first = _reaching(found, index + columns[-1:], border, dim=-1, least=index)
    moved: Any = 0.0
    for tap in range(_TAPS):
        at = (index[:, tap, :, None] + columns - first).clamp(0, planes.shape[-1] - 1)[:, None]
        moved = moved + weights[:, tap, :, None][:, None] * planes.gather(-1, at.expand(*signal.shape))
    return moved


def _taps(places: Tensor) -> tuple[Tensor, Tensor]:
    """Which eight pixels, and with what weights, make the value at each place: (..., N) to (..., 8, N)."""
    before = places.detach().floor()
    steps = torch.arange(1 - _TAPS // 2, 1 + _TAPS // 2, device=places.device, dtype=places.dtype)[:, None]
    share = (places - before)[..., None, :] - steps
    weights = [
        math.prod(share[..., other, :] / (other - tap) for other in range(_TAPS) if other != tap) * (-1) ** (_TAPS - 1)
        for tap in range(_TAPS)
    ]
    return (before[..., None, :] + steps).long(), torch.stack(weights, dim=-2)


def _reaching(
    planes: Tensor, index: Tensor, border: str, *, dim: int, least: Tensor | None = None
) -> tuple[Tensor, int]:
    """Planes with as much of their border as the indices reach, and the place of their first pixel."""
    n = planes.shape[dim]
    low = int((index if least is None else least).min()) if index.numel() else 0
    high = int(index.max()) + 1 if index.numel() else n
    most = int(LONGEST) + _BEYOND  # nothing moves farther
    low, high = max(low, -most), min(high, n + most)
    return part(planes, min(low, 0), max(high, n), border, dim=dim), min(low, 0)


@in_float32
def warp(signal: Tensor, *, shifts: Tensor, border: str = "reflect") -> Tensor:
    """The picture as it is when the content at each pixel has moved so far: result(x) = S(x - shifts(x)).

    By cubic convolution of 4 x 4 pixels. Args: signal (B,C,H,W); shifts (B or 1,2,H,W), x and y [pixels].

    Source:    Keys, Cubic convolution interpolation for digital image processing, IEEE Trans. ASSP 29, 1153 (1981).

    Example:
    >>> sensor.warp(torch.arange(5.0).view(1, 1, 1, 5), shifts=torch.full((1, 2, 1, 5), 0.5))[0, 0, 0, 2:4].tolist()
    [1.5, 2.5]
    """
    batch, channels, height, width = signal.shape
    x, y = shifts.to(signal).unbind(1)
    x = torch.arange(width, device=signal.device, dtype=signal.dtype) - x
    y = torch.arange(height, device=signal.device, dtype=signal.dtype)[:, None] - y
    left, top = (place.detach().floor().clamp(-LONGEST, LONGEST + size) for place, size in ((x, width), (y, height)))
    ends = [(int(one.min()) - 1, int(one.max()) + 3) for one in (top, left)]
    (up, down), (before, after) = ((min(a, 0), max(b, n)) for (a, b), n in zip(ends, (height, width), strict=True))
    planes = part(part(signal, up, down, border, dim=-2), before, after, border, dim=-1)
    across, along = _cubic(x - left), _cubic(y - top)
    flat, result = planes.flatten(-2), signal.new_zeros(())
    for row in range(4):
        for column in range(4):
            at = ((top.long() + row - 1 - up) * planes.shape[-1] + left.long() + column - 1 - before)[:, None].flatten(
                -2
            )
            taken = flat.gather(-1, at.expand(batch, channels, -1)).unflatten(-1, (height, width))
            result = result + (along[row] * across[column])[:, None] * taken
    return result


def _cubic(share: Tensor) -> list[Tensor]:
    """Keys' weights of the pixels at -1, 0, 1, 2 for a place so far from 0 to 1."""
    t, square, cube = share, share.square(), share**3
    return [
        (-cube + 2 * square - t) / 2,
        (3 * cube - 5 * square + 2) / 2,
        (-3 * cube + 4 * square + t) / 2,
        (cube - square) / 2,
    ]
