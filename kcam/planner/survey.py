"""Where in a scene a choice could hurt: one cheap pass over its pixels, per tile and item of the batch.

No choice changes more than blur itself does: contrast that is finer than the local blur, or than what a wrong depth
would make of it. So each tile has a potential of each of `KINDS`, an energy that is counted in the recorded light, and

    error^2 of a choice over a picture = sum over its tiles of gain x potential

with a gain that is much the same from tile to tile. The potentials say which tiles and items must be looked at, what
share of the picture those stand for, and whether a later scene asks for more than what was planned for.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from kcam.camera import Camera
from kcam.isp import Clip
from kcam.optics.source import Defocus
from kcam.scene import Scene
from kcam.sensor import ColourFilter, DarkCurrent, Exposure, ShotNoise
from kcam.sensor.random_stage import Mean

TILE, OCTAVES = 64, 6  # pixels, and their powers of 2
_STRIP = 2**20  # pixels that are surveyed at once

DEFOCUSED = (-64.0, -32.0, -16.0, -8.0, -4.0, -2.0, 0.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)  # pixels

KINDS = (
    "contrast finer than its blur, of what is recorded",
    "contrast finer than its blur, of the light before the full well",
    "contrast finer than the blur between its distances",
    "contrast at edges of depth",
    "light behind edges of depth",
    "contrast between neighbours",
    "light beyond what is recorded",
)
"""What a tile may have much of."""

OF_DEPTH, NEIGHBOURS, BEYOND = KINDS[2:5], 5, 6
"""The kinds that nothing but depth makes hurt; the contrast between neighbours; and what the full well cuts off."""

RANKS = (1, 2, 3, 4, 6, 9, 14)
"""Numbers of spectra that may stand for all of a batch's."""

CLIPPING = (ShotNoise, DarkCurrent, Clip)
"""Stages that stop at the full well."""


@dataclass(frozen=True)
class Survey:
    """Of one scene: potentials (7, R, C) of the `KINDS` in tiles, and of each tile, (R, C), the energy that is
    recorded, the radius of the blur [pixels], and the farthest and the nearest vergence [1/m].

    light: RMS of each band as the sensor weighs it, but for a factor, (L,). depths: RMS of the light in each of the
    `DEFOCUSED` ranges of signed defocus, but for a factor. level: RMS of what is recorded [share of
    the full well]. hidden: RMS of the light that something nearer may hide, relative to it; behind: how many of the
    pixels that is, as a share. left_out: RMS of the light, relative to it, that each of `RANKS` leaves out of it, of
    all that the batch has in common, (R,).
    """

    potential: Tensor
    recorded: Tensor
    blur: Tensor
    far: Tensor
    near: Tensor
    light: Tensor
    depths: Tensor
    level: float
    hidden: float
    behind: float
    left_out: Tensor

    def relative(self) -> Tensor:
        """Potentials of the whole scene, in the energy that is recorded of it: (7,)."""
        return self.potential.sum((-2, -1)) / self.recorded.sum().clamp(min=1e-30)


def survey(scene: Scene, camera: Camera, defocus: Defocus) -> list[Survey]:
    """Look the scenes of a batch over, as a camera records them."""
    weights, clips = _recording(camera, scene)
    planes, spectra = scene.coefficients.detach(), torch.eye(len(scene.wavelengths), dtype=torch.float64)
    if scene.spectra is not None:
        spectra = scene.spectra.detach().double().cpu()
    vergence = 1 / torch.as_tensor(scene.depth, dtype=torch.float64).detach().cpu()
    span = defocus.spread * float(vergence.max() - vergence.min()) if vergence.numel() else 0.0
    rows, columns = (-(-length // TILE) for length in planes.shape[2:])
    found, grams = [], []
    for index, item in enumerate(planes):
        own_depth = vergence if vergence.ndim == 0 else vergence[index]  # a number for all, or each's own, or its map
        depth = own_depth.expand(1, *item.shape[1:])
        far, near = _ends(depth, rows, columns)
        blur = torch.maximum(defocus.radius(far), defocus.radius(near))
        edge = defocus.spread * (_around(near) + _around(-far))
        potential, recorded = torch.zeros(len(KINDS), rows, columns, dtype=torch.float64), torch.zeros_like(blur)
        depths = torch.zeros(len(DEFOCUSED) + 1, dtype=torch.float64)
        gram = torch.zeros(len(item), len(item), dtype=torch.float64)
        nearest, hidden, behind = _around(_around(near)), 0.0, 0.0
        for part in _strips(rows, columns):
            light = _tiled(item, part).float()
            flat = light.flatten(1)
            gram += (flat @ flat.T).double().cpu()
            seen = ((weights @ spectra.T).to(light) @ flat).unflatten(1, light.shape[1:])
            full = clips and bool((seen > 1).any())
            kept = seen.clamp(max=1) if full else seen
            finer = _contrast(seen)
            finer_kept = _contrast(kept) if full else finer
            own = _at(finer_kept, blur[part])
            blurred = defocus.spread * _tiled(depth, part)[0] if span else torch.zeros(())
            potential[:, part] = torch.stack(
                [
                    own,
                    _at(finer, blur[part]),
                    _at(finer, torch.full_like(own, span)),
                    _at(finer, edge[part]),
                    _behind(seen, blurred) if span else torch.zeros_like(own),
                    finer_kept[1],
                    _sums(seen - kept) if full else torch.zeros_like(own),
                ]
            )
            recorded[part] = (_sums(kept) - own).clamp(min=0)
            if span:
                depths += _by_defocus(seen, blurred - defocus.spread * sum(defocus.focus) / 2)
                share = _farther(blurred, defocus.spread * nearest[part])
                of_it = _per_tile(seen.square().sum(0) * share.to(seen), TILE) / _sums(seen).clamp(min=1e-30)
                hidden += float((of_it * recorded[part]).sum())
                behind += float(share.mean()) * recorded[part].numel() / recorded.numel()
        grams.append(spectra.T @ gram @ spectra)
        bands = grams[-1].diagonal().clamp(min=0).sqrt() * weights.abs().sum(0)
        level = math.sqrt(float(recorded.mean()) / (TILE * TILE * len(weights))) if recorded.numel() else 0.0
        hidden = math.sqrt(hidden / max(float(recorded.sum()), 1e-30))
        none = torch.zeros(len(RANKS), dtype=torch.float64)
        found.append(Survey(potential, recorded, blur, far, near, bands, depths.sqrt(), level, hidden, behind, none))
    if len(found) > 1 and scene.spectra is None:
        left_out = _left_out(torch.stack(grams), weights)
        found = [replace(one, left_out=own) for one, own in zip(found, left_out, strict=True)]
    return found


def _left_out(grams: Tensor, weights: Tensor) -> Tensor:
    """Of items of a batch whose bands have inner products (B, L, L), see `Survey`: (B, R)."""
    directions = torch.linalg.eigh(grams.sum(0)).eigenvectors.flip(-1)
    turned, seen = directions.T @ grams @ directions, weights @ directions
    rest = [(seen[:, rank:], turned[:, rank:, rank:]) for rank in (0, *RANKS)]
    energies = torch.stack([torch.einsum("cl,blm,cm->b", own, of, own) for own, of in rest], dim=1).clamp(min=0)
    return (energies[:, 1:] / energies[:, :1].clamp(min=1e-300)).sqrt()


def _recording(camera: Camera, scene: Scene) -> tuple[Tensor, bool]:
    """What each channel records of each band, (C, L) [share of the full well], and whether it stops at a full well."""
    weights = torch.eye(len(scene.wavelengths), dtype=torch.float64)
    clips = False
    for stage in camera:
        if isinstance(stage, ColourFilter):
            weights = stage.contraction(scene.wavelengths).detach().double().cpu()
            if stage.is_tile:
                weights = stage.alpha().detach().double().cpu().mean((0, 1))[None] @ weights
        elif isinstance(stage, Exposure):
            weights = weights * float(stage.factor(camera.resolve(scene)).detach())
        clips = clips or stops(stage)
    return weights, clips


def stops(stage: Any) -> bool:
    """Whether a stage, or the random one whose mean it is, stops at the full well."""
    return isinstance(stage.stage if isinstance(stage, Mean) else stage, CLIPPING)


def _strips(rows: int, columns: int) -> Iterator[slice]:
    """Rows of tiles that are surveyed at once."""
    step = max(1, _STRIP // (TILE * TILE * columns))
    return (slice(top, min(top + step, rows)) for top in range(0, rows, step))


def _tiled(planes: Tensor, part: slice) -> Tensor:
    """Some rows of tiles of planes (K, H, W), mirrored beyond the picture to the end of the last tile."""
    found = planes[:, part.start * TILE : part.stop * TILE]
    for dim, tiles in ((1, part.stop - part.start), (2, -(-planes.shape[2] // TILE))):
        length = found.shape[dim]
        if beyond := tiles * TILE - length:
            index = torch.arange(length, length + beyond, device=planes.device) % (2 * length)
            index = torch.where(index < length, index, 2 * length - 1 - index)
            found = torch.cat([found, found.index_select(dim, index)], dim)
    return found


def _ends(vergence: Tensor, rows: int, columns: int) -> tuple[Tensor, Tensor]:
    """Farthest and nearest vergence of each tile, (R, C)."""
    if not any(vergence.stride()):  # one for all
        return vergence.flatten()[:1].expand(rows, columns), vergence.flatten()[:1].expand(rows, columns)
    tiles = _tiled(vergence, slice(0, rows))[0].unflatten(-1, (-1, TILE)).unflatten(0, (-1, TILE))
    return tiles.amin((1, 3)), tiles.amax((1, 3))


def _around(values: Tensor) -> Tensor:
    """The largest of a tile and those around it."""
    return torch.nn.functional.max_pool2d(values[None, None], 3, stride=1, padding=1)[0, 0]


def _sums(light: Tensor) -> Tensor:
    """Energy of tiles, (R, C)."""
    return _per_tile(light.square().sum(0), TILE)


def _behind(light: Tensor, blur: Tensor) -> Tensor:
    """Energy in tiles of what lies farther at steps of the blur (H, W) between neighbours, times those, (R, C)."""
    energy, found = light.square().sum(0), torch.zeros_like(light[0])
    for dim in (0, 1):
        length = blur.shape[dim] - 1
        step = blur.diff(dim=dim).to(energy)
        farther = torch.where(step > 0, energy.narrow(dim, 0, length), energy.narrow(dim, 1, length))
        found.narrow(dim, 1, length).add_(farther * step.abs())
    return _per_tile(found, TILE)


def _farther(pixels: Tensor, nearest: Tensor) -> Tensor:
    """What of pixels (H, W) lies farther than the nearest in tiles around (R, C): all of it from a pixel of blur on."""
    around = nearest.repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)
    return (around - pixels).clamp(0, 1)


def _by_defocus(light: Tensor, pixels: Tensor) -> Tensor:
    """Energy in each range of a signed defocus (H, W) [pixels]."""
    bins = torch.bucketize(pixels.flatten(), torch.tensor(DEFOCUSED, dtype=pixels.dtype))
    return torch.bincount(bins, light.square().sum(0).flatten().double().cpu(), minlength=len(DEFOCUSED) + 1)


def _per_tile(values: Tensor, side: int) -> Tensor:
    """Sums over squares of a side, (R, C) float64."""
    return values.unflatten(0, (-1, side)).sum(1).unflatten(-1, (-1, side)).sum(-1).double().cpu()


def _contrast(light: Tensor) -> Tensor:
    """Energy of tiles that is finer than blocks of 1, 2, 4, ... 64 pixels, (7, R, C): 0 first, and ascending."""
    found = [torch.zeros(light.shape[-2] // TILE, light.shape[-1] // TILE, dtype=torch.float64)]
    for octave in range(OCTAVES):
        corners = [light[:, row::2, column::2] for row in (0, 1) for column in (0, 1)]
        light = (corners[0] + corners[1] + corners[2] + corners[3]) / 4
        finer = sum((corner - light).square().sum(0) for corner in corners)
        found.append(found[-1] + 4**octave * _per_tile(torch.as_tensor(finer), TILE >> (octave + 1)))
    return torch.stack(found)


def _at(finer: Tensor, radius: Tensor) -> Tensor:
    """Contrast finer than a blur of a radius [pixels], between the octaves in proportion."""
    octave = torch.log2(2 * radius + 1).clamp(0, OCTAVES)
    low = octave.floor().long().clamp(max=OCTAVES - 1)
    below, above = (finer.gather(0, index[None])[0] for index in (low, low + 1))
    return below + (octave - low) * (above - below)
