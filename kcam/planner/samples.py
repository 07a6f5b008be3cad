"""What choices are tried on: scenes, or a few crops of them, and what share of the picture they stand for.

Which follows from a `survey`: the items and tiles where a choice could hurt most.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from kcam.planner.range import COLOUR, DEPTH, OTHER_LIGHT, shares
from kcam.planner.survey import KINDS, TILE, Survey
from kcam.scene import Scene

SPECTRA_OF = 2**18  # pixels at most that say which spectra a batch has
SPECTRUM = 5e-4  # RMS of light that fewer spectra may leave out of any item


@dataclass(frozen=True)
class Sample:
    """Scenes to try choices on, or crops of them, as one batch: of the nearest and the farthest point too, so that
    layers of depth lie where they lie in the whole.

    owners: whose each row is. places: of optics that vary over the picture, where the middle of each row lies from that
    of its `picture` (H, W), x and y, upright [pixels]; None where they are whole. factors: on their relative
    errors, for the part of a scene that its crops stand for. batch: of which they are part.
    """

    scene: Scene
    owners: tuple[int, ...]
    factors: tuple[float, ...]
    places: tuple[tuple[float, float], ...] | None = None
    picture: tuple[int, int] = (0, 0)
    batch: Scene | None = None

    def low_rank(self, rank: int) -> Scene:
        """What the scene is where the batch is said in fewer spectra: those of other items count, too."""
        if rank >= self.scene.coefficients.shape[1]:
            return self.scene
        return self.scene.low_rank(rank, principal=self._principal_spectra)

    @functools.cached_property
    def _principal_spectra(self) -> Tensor:
        """Of the batch; kept, because each rank asks for them."""
        batch = self.batch
        if batch is None or batch.coefficients.shape == self.scene.coefficients.shape:
            return self.scene.principal_spectra()
        step = math.ceil(math.sqrt(math.prod(batch.shape) / SPECTRA_OF))
        thin = replace(batch, coefficients=batch.coefficients[..., ::step, ::step], depth=1.0)
        return thin.principal_spectra()

    def of_owners(self) -> list[tuple[list[int], float]]:
        """The rows of each whole, and the factor on their error."""
        wholes = dict(zip(self.owners, self.factors, strict=True))
        return [([row for row, own in enumerate(self.owners) if own == whole], f) for whole, f in wholes.items()]


def samples_of(
    scenes: Sequence[Scene], surveys: Sequence[Sequence[Survey]], *, pixels: int, side: int | None = None
) -> list[Sample]:
    """What choices are tried on: all that there is while it has not more than so many pixels; else the scenes with the
    largest potential of each kind, relative to what is recorded of them, those of light, distances or spectra that none
    of these has, for potentials do not tell how wrong a choice is at one wavelength or distance, and others as they
    come closest to the first.

    side: of the crops that are made of a single scene with more than so many pixels; None: so that they have as many.
    """
    every = [(index, row) for index, found in enumerate(surveys) for row in range(len(found))]
    if not every:
        return []
    sizes = [scenes[index].shape[1] * scenes[index].shape[2] for index, _ in every]
    chosen = _chosen([surveys[index][row] for index, row in every], sizes, pixels) if len(every) > 1 else [0]
    if side is None:
        pixels //= len(chosen)
        side = int((pixels / (len(KINDS) + 2)) ** 0.5)
    samples = []
    for index, (scene, found) in enumerate(zip(scenes, surveys, strict=True)):
        rows = {row for owner, (of, row) in enumerate(every) if of == index and owner in chosen}
        if rows:
            ends = [min(range(len(found)), key=lambda row: found[row].far.min().item())]
            ends += [max(range(len(found)), key=lambda row: found[row].near.max().item())]
            rows |= set(ends) if found[ends[0]].far.min() < found[ends[1]].near.max() else set()
            first = every.index((index, 0))
            samples.append(_sample(scene, found, sorted(rows), first=first, side=side, pixels=pixels))
    return samples


def _chosen(looked_at: Sequence[Survey], sizes: Sequence[int], pixels: int) -> list[int]:
    """Of items that were looked over, those that tell of all."""
    relative = torch.stack([one.relative() for one in looked_at])
    score = (relative / relative.amax(0).clamp(min=1e-30)).amax(1)
    chosen = list(dict.fromkeys(relative.argmax(0).tolist()))
    for own in (
        shares(torch.stack([one.light for one in looked_at])) + COLOUR,
        shares(torch.stack([one.depths for one in looked_at])) + DEPTH,
        torch.stack([one.left_out for one in looked_at]) + SPECTRUM,
    ):
        while float((more := (own / own[chosen].amax(0)).amax(1)).max()) > math.sqrt(OTHER_LIGHT):
            chosen.append(int(more.argmax()))
    for other in score.argsort(descending=True, stable=True).tolist():
        if other not in chosen and sum(sizes[k] for k in chosen) + sizes[other] <= pixels:
            chosen.append(other)
    return chosen


def _sample(
    scene: Scene, surveys: Sequence[Survey], rows: Sequence[int], *, first: int, side: int, pixels: int
) -> Sample:
    """Some scenes of a batch, whole or in crops: of each the tile with the largest potential of each kind, with what
    its blur reaches, and the tiles of the farthest and the nearest point.

    By gain x potential the error of the crops stands for that of the scene, relative to what is recorded of it.
    """
    _, height, width = scene.shape
    whole = height * width <= pixels
    if not whole:
        extent = side + 2 * math.ceil(max(float(surveys[row].blur.max()) for row in rows))
        size = {"height": min(extent, height), "width": min(extent, width)}
        crops, factors = _crops(surveys, rows, extent, (height, width))
        whole = len(rows) * height * width <= len(crops) * math.prod(size.values())
    if whole:
        own = scene if len(rows) == len(surveys) else scene.samples(rows)
        return Sample(own, tuple(first + row for row in rows), (1.0,) * len(rows), None, (height, width), scene)
    part = [scene.crop(top=top, left=left, **size).samples([row]) for row, top, left in crops]
    maps = [one.depth for one in part if isinstance(one.depth, Tensor)]
    depth: float | Tensor = scene.depth
    if isinstance(depth, Tensor):  # maps, or numbers of one per sample
        depth = torch.cat(maps) if maps else torch.tensor([one.depth for one in part], dtype=torch.float64)
    together = replace(scene, coefficients=torch.cat([one.coefficients for one in part]), depth=depth)
    owners, own_factors = tuple(first + row for row, _, _ in crops), tuple(factors[row] for row, _, _ in crops)
    middle = (together.shape[2] - width) / 2, (together.shape[1] - height) / 2
    places = tuple((left + middle[0], top + middle[1]) for _, top, left in crops)
    return Sample(together, owners, own_factors, places, (height, width), scene)


def _crops(
    surveys: Sequence[Survey], rows: Sequence[int], extent: int, picture: tuple[int, int]
) -> tuple[list[tuple[int, int, int]], dict[int, float]]:
    """Of an extent: (row, top, left) of each, and the factor of each row's."""
    crops, factors = [], {}
    for row in rows:
        found = surveys[row]
        ends = [1e9 - found.far, found.near] if float(found.near.max()) > float(found.far.min()) else []
        kinds = [*found.potential, found.recorded]
        seen, whole = (torch.zeros_like(found.recorded, dtype=torch.bool) for _ in range(2))
        for kind, known in [*((kind, seen) for kind in kinds), *((end, whole) for end in ends)]:
            tile = divmod(int(kind.argmax()), kind.shape[1])
            if not seen.any() or (bool(kind.any()) and not bool(known[tile])):
                top, *of_rows = _window(tile[0], len(kind), extent, picture[0])
                left, *of_columns = _window(tile[1], kind.shape[1], extent, picture[1])
                for tiles, inside, beside in zip((seen, whole), of_rows, of_columns, strict=True):
                    tiles |= inside[:, None] & beside
                crops.append((row, top, left))
        covered = [float(kind[seen].sum() / kind.sum()) for kind in kinds if kind.any()]
        factors[row] = math.sqrt(covered[-1] / min(covered)) if covered else 1.0
    return crops, factors


def _window(tile: int, count: int, extent: int, length: int) -> tuple[int, Tensor, Tensor]:
    """Where a window around a tile starts along one side of a picture, which tiles have their centre in it, and which
    it holds whole: the nearest point may be anywhere in its tile.
    """
    extent = min(extent, length)
    start = min(max(0, tile * TILE + (TILE - extent) // 2), length - extent)
    tops, stop = torch.arange(count) * TILE, start + extent
    centres, bottoms = (tops + TILE // 2).clamp(max=length - 1), (tops + TILE).clamp(max=length)
    return start, (centres >= start) & (centres < stop), (tops >= start) & (bottoms <= stop)
