"""From pupils to PSFs: many points of the field at once, each with its own grid over what is open.

    h(x, y) = |sum_jk P(dx_j, dy_k) exp(i k (W(dx_j, dy_k) + x dx_j + y dy_k))|^2

for all x and y by one FFT. Grids lie along the sensor's axes, and the pupil is turned: pixels never are. A polynomial
of degree d is known from (d + 1)^2 Chebyshev points of the grid's square, wherever it is turned to, and a matrix for
each axis takes it from there to all nodes.
"""

from __future__ import annotations

import functools
import math
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
import scipy
import torch
from torch import Tensor

from kcam.optics.compound.pupil import PupilFit
from kcam.optics.numerics import fast_length, lagrange_weights, phasor, squared
from kcam.optics.propagation import sampling
from kcam.optics.propagation.pixels import Pixels
from kcam.optics.pupil.rim import Openings, edge_distance, opening
from kcam.optics.source import PixelGrid

_SHARES = 100  # of the light, of which it is known how far they fall
_LOOK = 41  # points across a pupil, to see what of it is open
_ALIKE = 1.2  # wavelengths that differ by no more than this factor share the grid of their pupils
_EDGES = 3  # of these, at which the edges of a pupil are looked at
_ROOM = 12  # samples of a grid beyond what is open, for the low-pass of its edge
_ACROSS = 96  # samples across what is open, at least: its edge is spread over twelve, and 64 are off by 0.5 %
_AREA_SAMPLES = 128
_NEARLY = 0.1  # of a clearance: what it is nowhere below takes no light away, also between the points where it is known
_AT_ONCE = 2**20  # points of pupils, or of images, that are held together


@dataclass(frozen=True)
class Closeness:
    """How finely a PSF is sampled. kappa: see `sampling.pupil_samples`. margin: pixels evaluated beyond the window."""

    kappa: float = sampling.KAPPA
    margin: int = sampling.WINDOW_MARGIN


CLOSE = Closeness()
QUICK = Closeness(kappa=1.5, margin=2)
"""Takes half of the time, and is at most `QUICK_ERROR` of a PSF's light from `CLOSE` (L1)."""
QUICK_ERROR = 1e-3  # measured: at most 8e-4, Cooke triplet and EF50 at f/4


@dataclass(frozen=True)
class Frame:
    """Where pupils are open, by N squares along the sensor's axes; no derivative passes through it.

    directions (N, 2): from the axis to the image, on the sensor. middle (N, 2), half (N,): of the squares, in direction
    cosines. slope (N,): how far the wavefront sends light from the chief ray's image, at most [m]. slopes (N, Q): of
    equal shares of the light, ascending.
    """

    directions: Tensor
    middle: Tensor
    half: Tensor
    slope: Tensor
    slopes: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, fitted: PupilFit, directions: Tensor, nodes: Tensor | None = None) -> Frame:
        """Seen on a coarse grid; nodes (N, E): of pupils that share a square, None for one each. Raises: ValueError for
        a pupil that nothing passes.
        """
        nodes = torch.arange(len(fitted.centre), device=fitted.centre.device)[:, None] if nodes is None else nodes
        length = max(1, _AT_ONCE // (8 * _LOOK**2 * nodes.shape[1]))
        parts = [_looked(fitted, *own) for own in zip(nodes.split(length), directions.split(length), strict=True)]
        return cls(directions, *(torch.cat(part) for part in zip(*parts, strict=True)))

    @classmethod
    def upright(cls, fitted: PupilFit) -> Frame:
        """Seen with the meridional plane along y: middle[:, 1] and half are about dy."""
        return cls.of(fitted, fitted.centre.new_tensor([[0.0, 1.0]]).expand(len(fitted.centre), 2))

    def __getitem__(self, index: Tensor) -> Frame:
        own = (part[index] for part in (self.directions, self.middle, self.half, self.slope, self.slopes))
        return Frame(*own)


def _looked(fitted: PupilFit, nodes: Tensor, directions: Tensor) -> tuple[Tensor, ...]:
    side = torch.linspace(-1, 1, _LOOK, dtype=torch.float64, device=directions.device)
    r, centre = fitted.radius[nodes, None, None], fitted.centre[nodes, None, None]
    dx, dy = torch.broadcast_tensors(r * side, centre + r * side[:, None])
    path, clearances = (
        part.unflatten(0, nodes.shape) for part in fitted.at(nodes.flatten(), dx.flatten(0, 1), dy.flatten(0, 1))
    )
    passes = (clearances > 0).all(2)
    if not bool(passes.flatten(2).any(2).all()):
        raise ValueError("a point's light is stopped completely. Use smaller fields, or larger semi-diameters.")
    step = r * (2 / (_LOOK - 1))
    slope = torch.hypot(*(_steepest(path, passes, dim=dim) for dim in (-2, -1))) / step
    ordered = torch.where(passes, slope, math.inf).flatten(2).sort(dim=2).values
    count = passes.flatten(2).sum(2, keepdim=True)
    rank = ((torch.arange(_SHARES) + 0.5) / _SHARES * count).long()  # each of as many of the rays that pass
    slopes, slope = ordered.gather(2, rank).amax(1), ordered.gather(2, count - 1)[..., 0].amax(1)
    x, y = (part[:, None, None, None] for part in directions.unbind(1))
    place = torch.stack([dx * y + dy * x, dy * y - dx * x])  # on the sensor's axes: `_meridional` undone
    low = torch.where(passes, place, math.inf).flatten(3).amin((2, 3))
    high = torch.where(passes, place, -math.inf).flatten(3).amax((2, 3))
    half = ((high - low).amax(0) / 2 + step[..., 0, 0].amax(1)).clamp(max=1.5 * fitted.radius[nodes].amax(1))
    half = 2 ** (torch.ceil(16 * torch.log2(half) + 0.5) / 16)  # in steps: it does not follow small changes
    grain = half / 16
    return (((low + high).T / 2) / grain[:, None]).round() * grain[:, None], half, slope, slopes


def _steepest(path: Tensor, passes: Tensor, *, dim: int) -> Tensor:
    """How much a path changes to either neighbour along a dimension, at most, where both are open: beyond an edge it is
    known less.
    """
    n = path.shape[dim]
    both = passes.narrow(dim, 1, n - 1) & passes.narrow(dim, 0, n - 1)
    change = torch.where(both, path.diff(dim=dim).abs(), 0.0)
    none = torch.zeros_like(change.narrow(dim, 0, 1))
    return torch.maximum(torch.cat([change, none], dim), torch.cat([none, change], dim))


def _meridional(x: Tensor, y: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Direction cosines along the sensor's axes (n, ...), in the plane of the chief ray."""
    cx, cy = (part.view(-1, *[1] * (x.ndim - 1)) for part in directions.unbind(1))
    return x * cy - y * cx, x * cx + y * cy


@functools.lru_cache(maxsize=64)
@torch.inference_mode(False)
def _from_chebyshev(degree: int, count: int) -> tuple[Tensor, Tensor]:
    """Chebyshev points of (-1, 1), and what takes a polynomial's values there to `count` nodes: (count, degree + 1)."""
    points = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    nodes = (np.arange(count) + 0.5) * 2 / count - 1
    matrix = scipy.interpolate.BarycentricInterpolator(points, np.eye(degree + 1))(nodes)
    return torch.as_tensor(points), torch.as_tensor(matrix)


def _known(
    fitted: PupilFit, nodes: Tensor, frame: Frame, reach: Tensor | float, offsets: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Wavefronts (N, L, G, G) [m], rows along +y, and clearances (N, L, S, G, G) at the Chebyshev points of N squares,
    of pupils with indices `nodes` (N, L); reach: of these squares, from the middle of their frames. offsets (N, L, 2)
    [m]: of what is to be seen in the image's middle.
    """
    points = _from_chebyshev(fitted.degree, 1)[0].to(frame.half.device)
    reach = torch.as_tensor(reach, device=points.device).expand(len(nodes))
    x, y = (frame.middle[:, k, None] + reach[:, None] * points for k in (0, 1))
    x, y = torch.broadcast_tensors(x[:, None, :], y[:, :, None])
    places = [part.repeat_interleave(nodes.shape[1], dim=0) for part in _meridional(x, y, frame.directions)]
    path, clearances = (part.unflatten(0, nodes.shape) for part in fitted.at(nodes.flatten(), *places))
    if offsets is not None:
        path = path - offsets[..., :1, None] * x[:, None] - offsets[..., 1:, None] * y[:, None]
    return path, clearances


def areas(fitted: PupilFit, frame: Frame, nodes: Tensor | None = None) -> Tensor:
    """Of the open pupils in direction cosines, (N,): of all, or of those with the indices `nodes` (N,)."""
    found = []
    nodes = torch.arange(len(frame.half)) if nodes is None else nodes
    for part in torch.arange(len(nodes)).split(max(1, _AT_ONCE // _AREA_SAMPLES**2)):
        own = frame[part]
        spacing = 2 * own.half / (_AREA_SAMPLES - _ROOM)
        _, clearances = _known(fitted, nodes[part, None], own, spacing * (_AREA_SAMPLES / 2))
        matrix = _from_chebyshev(fitted.degree, _AREA_SAMPLES)[1].to(spacing.device)
        found.append(opening(matrix @ clearances[:, 0] @ matrix.mT).sum((-2, -1)) * spacing**2)
    return torch.cat(found)


def light(fitted: PupilFit, nodes: Tensor, wavelengths: Tensor) -> Tensor:
    """Areas of the open pupils with indices in nodes, (R, L)."""
    colours, weights = _seen_at(wavelengths)
    nodes = nodes[:, colours]
    upright = fitted.centre.new_tensor([[0.0, 1.0]]).expand(nodes.numel(), 2)
    return (
        areas(fitted, Frame.of(fitted, upright, nodes.reshape(-1, 1)), nodes.flatten()).view(len(nodes), -1) @ weights.T
    )


def _seen_at(wavelengths: Tensor) -> tuple[Tensor, Tensor]:
    """Indices of a few wavelengths (E,) at which openings of pupils are looked at, and what each gives to all, (L, E).

    An edge hardly moves from one end of a spectrum to the other, and by a polynomial.
    """
    turned = wavelengths.detach() ** -2  # in which indices are nearly straight
    low, high = turned.aminmax()
    wanted = torch.linspace(float(low), float(high), _EDGES, dtype=torch.float64, device=turned.device)
    nearest = (turned - wanted[:, None]).abs().argmin(1).unique()
    return nearest, lagrange_weights(turned[nearest], turned)


def _together(wavelengths: Tensor, *, ratio: float) -> list[Tensor]:
    """Indices of wavelengths of which the longest is so many times as long as the shortest, at most."""
    order = wavelengths.detach().argsort()
    steps = (wavelengths.detach()[order] / wavelengths.detach().min()).log() / max(math.log(ratio), 1e-9)
    _, counts = steps.clamp(min=0).floor().unique_consecutive(return_counts=True)
    return list(order.split(counts.tolist()))


def images(
    fitted: PupilFit,
    nodes: Tensor,
    directions: Tensor,
    wavelengths: Tensor,
    offsets: Tensor,
    pixels: PixelGrid,
    *,
    relative_to: Tensor,
    how: Closeness = CLOSE,
    whole: Tensor | None = None,
) -> Tensor:
    """PSFs (R, L, h, w) of R points at wavelengths (L,), whose pupils have the indices `nodes` (R, L), turned towards
    directions (R, 2), each moved by (R, L, 2) [m]; 1 is the light of an area in direction cosines, (R, L). whole: areas
    of these pupils, (R, L), where what leaves the window is put back into it: coarse grids know them to 1 %.

    The field at points p / q apart is one FFT of length F: of a pupil sampled at lambda q / (p F). Its rows that are
    dark, and columns that nobody asks for, are left out. Pupils of similar wavelengths are sampled alike, so that
    q goes with 1 / lambda, and their edges are looked at a few times only.
    Raises: ValueError for blur that needs more than `sampling.MAX_PUPIL_SAMPLES`.
    """
    groups = _together(wavelengths, ratio=_ALIKE if pixels.integrate else 1.0)  # of point samples q is to be whole
    if len(groups) > 1:
        found = [
            images(
                fitted,
                nodes[:, own],
                directions,
                wavelengths[own],
                offsets[:, own],
                pixels,
                relative_to=relative_to[:, own],
                how=how,
                whole=None if whole is None else whole[:, own],
            )
            for own in groups
        ]
        return _ordered(found, torch.cat(groups), dim=1)
    colours, weights = _seen_at(wavelengths)
    frame = Frame.of(fitted, directions, nodes[:, colours])
    margin, shortest = max(pixels.shape) // 2 + how.margin, float(wavelengths.min())
    reach = margin + (frame.slope + offsets.detach().abs().amax((1, 2))) / pixels.pitch
    alike: dict[tuple[int, float], list[int]] = defaultdict(list)
    for index, (half, far) in enumerate(zip(frame.half.tolist(), reach.tolist(), strict=True)):
        per_pixel = sampling.points_per_pixel(
            pixel_pitch=pixels.pitch, semi_aperture=half, sensor_distance=1.0, wavelength=shortest
        )
        if not pixels.integrate:
            per_pixel = float(math.ceil(per_pixel))  # of which one is taken
        fewest = math.ceil(_ACROSS * shortest * per_pixel / (2 * half * pixels.pitch))
        wanted = math.ceil(how.kappa * far * per_pixel)
        length = fast_length(max(wanted, fewest, 2 * math.ceil(per_pixel * margin) + 1))
        if length > sampling.MAX_PUPIL_SAMPLES:
            raise ValueError(
                f"this PSF needs {length} pupil samples (blur {far * pixels.pitch * 1e3:.3g} mm), more than "
                f"{sampling.MAX_PUPIL_SAMPLES}. Use a smaller shape or a distance nearer to the focus."
            )
        alike[length, per_pixel].append(index)
    found, order = [], []
    for (length, per_pixel), indices in alike.items():
        spacing = shortest * per_pixel / (pixels.pitch * length)
        for part in torch.tensor(indices).split(max(1, _AT_ONCE // length**2)):
            own = frame[part]
            count = min(length, 2 * math.ceil(float(own.half.max()) / spacing) + _ROOM)
            known = _known(fitted, nodes[part], own, spacing * (count / 2), offsets[part])
            # from here on each of the PSF's points is computed, where the picture is
            asked = relative_to[part], relative_to[part] if whole is None else whole[part]
            path, clearances, chebyshev_points, matrix, unit, energy = (
                values.to(pixels.device) for values in (*known, *_from_chebyshev(fitted.degree, count), *asked)
            )
            low = matrix.to(pixels.dtype)
            openings = Openings(edge_distance(low @ _limiting(clearances[:, colours]).to(pixels.dtype) @ low.mT))
            lights = []
            for index, wavelength in enumerate(wavelengths.tolist()):
                points_per_pixel = per_pixel * (shortest / wavelength)  # so rounded it is never above per_pixel
                points = math.ceil(points_per_pixel * margin)
                tilt = (math.pi * points * count / length) * chebyshev_points  # brings the image's first point to 0
                waves = path[:, index] * (2 * math.pi / wavelength) - tilt - tilt[:, None]
                phase = (matrix @ waves @ matrix.mT).remainder_(2 * math.pi)
                passed = openings.at(weights[index])
                field = phasor(phase.to(pixels.dtype)) * passed
                image = squared(_first(_first(field, length, 2 * points + 1).mT, length, 2 * points + 1).mT)
                if not pixels.integrate:
                    image = _every(image, int(per_pixel))
                seen = Pixels(pixels.shape, points_per_pixel, integrate=pixels.integrate).of_image(image)
                if whole is None:
                    factor = (spacing**2 * pixels.pitch / wavelength) ** 2 / unit[:, index]
                else:
                    factor = energy[:, index] / unit[:, index] / seen.sum((-2, -1))
                lights.append(seen * factor[:, None, None].to(pixels.dtype))
            found.append(torch.stack(lights, dim=1))
        order += indices
    return _ordered(found, torch.tensor(order), dim=0)


def _limiting(clearances: Tensor) -> Tensor:
    """Those of clearances (n, E, S, G, G) at Chebyshev points that take light away which all others let pass."""
    if clearances.shape[2] == 1:
        return clearances
    least, second = clearances.detach().topk(2, dim=2, largest=False).values.split(1, dim=2)
    others = torch.where(clearances.detach() > least, least, second)
    limits = ((clearances.detach() < _NEARLY) & (others > -_NEARLY)).transpose(0, 2).flatten(1).any(1)
    return clearances[:, :, limits] if bool(limits.any()) else clearances[:, :, :1]


def _ordered(parts: list[Tensor], order: Tensor, *, dim: int) -> Tensor:
    """Parts along a dimension, put in order: what is in order already is not copied once more."""
    found = torch.cat(parts, dim) if len(parts) > 1 else parts[0]
    return found if bool((order.diff() > 0).all()) else found.index_select(dim, order.argsort().to(found.device))


def _first(field: Tensor, length: int, count: int) -> Tensor:
    """Spectrum (..., A, count) of rows (..., A, B) at the first frequencies."""
    return torch.fft.ifft(field, n=length, norm="forward")[..., :count]


def _every(image: Tensor, step: int) -> Tensor:
    """Points of an image (..., 2K + 1, 2K + 1) in steps from its middle."""
    first = (image.shape[-1] // 2) % step
    return image[..., first::step, first::step]
