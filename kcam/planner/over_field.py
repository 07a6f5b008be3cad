"""What choices change in a picture whose PSF varies over it, from spectra: of its parts, each with PSFs of one place.

    E^2 = sum_p E_p^2,   E_p by the spectra of what stands in a part, and transfer functions in its middle

Layers of depth lie in each part where they lie in the whole. Windows cost what they do to waves longer than parts, too:
of the whole, with the PSFs of each place. What moves light (distortion), or dims it smoothly, is told by the light that
it moves; and where PSFs bring light beside their places, it is spread over more or less of the sensor than by one PSF.
"""

from __future__ import annotations

import functools
import math
import operator
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from kcam.camera import Camera
from kcam.optics import Imaging
from kcam.optics.accuracy import OVER_THE_FIELD
from kcam.optics.banks import KEPT, middle
from kcam.optics.field import PROBE, SHARED, FieldBank, nodes_apart
from kcam.optics.numerics import lagrange_weights, linear_weights
from kcam.optics.rendering.zones import Axis
from kcam.optics.source import FieldPSFs
from kcam.optics.wavelengths import chebyshev_wavelengths
from kcam.planner.band_counts import FEW_BANDS
from kcam.planner.light import blurred, compressed, contrast, few_lights, hues, recorded
from kcam.planner.samples import Sample
from kcam.planner.spectra import COLOURS, WINDOW, Care, Spectra, differ
from kcam.planner.transfers import CUT_COLOURS, Transfers, Way
from kcam.scene import Scene

TOLD = {"blur", "spacing", "layers", "occlusion", *COLOURS, *WINDOW, *OVER_THE_FIELD}
"""Changes of an Imaging over the field whose cost is told."""

MOVES = ("distortion", "relative_illumination")
"""Of these, those that act on light before it is blurred."""

_EVEN = dict.fromkeys(OVER_THE_FIELD, False)  # what hides what is tried out with one PSF all over

_FEW = {"bands": FEW_BANDS}
_OUTER = 0.29  # of a side, either part beside that in its middle: charts have edges at thirds, which a cut would hide
_MIDDLE = 0.78  # of half a side, the place that stands for its outer part: a little farther than where what grows with
# the distance from the axis, or its square, has its mean square (0.73, 0.76; with its fourth power 0.81)
_TRIED = 2 * PROBE  # pixels between nodes, whose error tells how far apart they may be: it goes with the square
_RADII, _POWERS = 8, 3  # places that tell how far light falls beside them, and even powers of the distance for that
_GRID = 16  # places along a side of a picture, at which that is looked at
_FEW_LAYERS = 3  # that tell how far apart nodes lie
_HELD = 0.9  # of the light, that a window holds which cuts nothing but diffraction off
_ALONE = 4  # wavelengths that have PSFs of their own
_COLOURS, _FEWER, _LEFT = 14, 10, 7e-3  # wavelengths of which the transfer functions of all others are polynomials,
# where so many are off from these by so little, of usual light (RMS): beyond twice that a choice was told 0.25 times


class OverField:
    """A sample of scenes, as `Spectra` are: the same questions; hidden: as of these."""

    def __init__(self, camera: Camera, imaging: Imaging, sample: Sample, *, hidden: Tensor | None = None) -> None:
        self.sample, self.imaging, self.hidden = sample, imaging, hidden
        self.scene = compressed(sample.scene)
        self.weights = recorded(camera, sample.scene)
        self.optics = _TransfersAt(imaging, self.scene, sample.picture)
        self._unlike = torch.ones(len(sample.owners), dtype=torch.float64)  # see `compare`
        self._moved_known: dict[tuple[bool, ...], Tensor] = {}

    @functools.cached_property
    def _parts(self) -> list[tuple[Tensor, Spectra, _TransfersAt]]:
        """Rows of the sample (M,), each as often as parts of it see one PSF, the spectra of these parts, and what the
        optics do there.
        """
        alike: dict[Any, list[tuple[int, Scene]]] = defaultdict(list)
        for row, scene, (x, y) in self._cut():
            alike[(x, y) if self.imaging.centre else (abs(x), abs(y))].append((row, scene))  # others mirror it
        found = []
        for place, parts in alike.items():
            rows, scenes = zip(*parts, strict=True)
            there, own = self.optics.at(place), None if self.hidden is None else self.hidden[[*rows]]
            found.append((torch.tensor(rows), Spectra(there, _together(scenes), self.weights, hidden=own), there))
        return found

    @functools.cached_property
    def _whole(self) -> Spectra:
        """All of it, with the PSFs of one place."""
        return Spectra(self.optics, self.scene, self.weights, hidden=self.hidden)

    @functools.cached_property
    def _wholes(self) -> list[tuple[float, Spectra]]:
        """What windows cost, whose waves are longer than the parts: the spectra of the whole sample with the PSFs of
        each place, and the share of the sample that sees these.
        """
        sizes = [len(rows) * math.prod(spectra.scene.shape[1:]) for rows, spectra, _ in self._parts]
        own = (self._whole.through(there) for *_, there in self._parts)
        return [(size / sum(sizes), spectra) for size, spectra in zip(sizes, own, strict=True)]

    def _cut(self) -> Iterator[tuple[int, Scene, tuple[float, float]]]:
        """Of each row of the sample parts, and the places that stand for these."""
        for row in range(len(self.sample.owners)):
            scene = self.scene.samples([row])
            if self.sample.places is not None:
                yield row, scene, self.sample.places[row]
                continue
            rows, columns = map(_thirds, scene.shape[1:])
            for (top, height, y), (left, width, x) in ((one, other) for one in rows for other in columns):
                yield row, scene.crop(top=top, left=left, height=height, width=width), (x, y)

    @torch.no_grad()
    def energies(
        self, changes: Mapping[str, Any], against: Mapping[str, Any], care: Care = Care.FULL
    ) -> tuple[Tensor, Tensor]:
        """As `Spectra.energies`."""
        found = torch.zeros(2, len(self._unlike), dtype=torch.float64)
        alike = {*MOVES} if changes.get("spacing") != against.get("spacing") else {*MOVES, "spacing"}
        ours, theirs = ({name: own[name] for name in own.keys() - alike} for own in (changes, against))
        if self.sample.places is None and differ(ours, theirs, WINDOW):
            for share, spectra in self._wholes:
                found += share * torch.stack(spectra.energies(ours, theirs, care))
        else:
            for rows, spectra, _ in self._parts:
                found.index_add_(1, rows, torch.stack(spectra.energies(ours, theirs, care)))
        off, all_of_it = found
        if differ(ours, theirs, {"field_variation", "spacing"}):
            off = off + (self._thinned(ours) - self._thinned(theirs)) ** 2 * all_of_it
        before, after = map(self._moves, (against, changes))
        if before != after:
            off = off + self._blurred(self._moved(after) - self._moved(before), theirs)
        return off * self._unlike, all_of_it

    @functools.cached_property
    def _factors(self) -> Tensor:
        """Of r c(r / R), how far light falls beside the places that stand for it, c_0 + c_1 (r / R)^2 + ..., of a lens
        that is round, up to its farthest place R [pixels].
        """
        parts = torch.linspace(0, 1, _RADII + 1, dtype=torch.float64)[1:]
        places = self._axis + self._reach * torch.stack([parts, torch.zeros_like(parts)], dim=1)
        off = self.optics.beside(places, max(self.optics.ends.split(1), key=self._blur))
        powers = torch.arange(0, 2 * _POWERS, 2)
        return torch.linalg.lstsq(parts[:, None] ** (1 + powers), off[:, None] / self._reach).solution[:, 0]

    def _blur(self, vergence: Tensor) -> float:
        """How far light is spread from there, (1,)."""
        return float(self.optics.defocus.radius(vergence).max())

    @property
    def _reach(self) -> float:
        return self.imaging.reach(self.sample.picture) / self.imaging.pixel_pitch

    @property
    def _axis(self) -> Tensor:
        """Where it lies, x and y from the picture's middle [pixels]."""
        return torch.tensor(self.imaging.centre or (0.0, 0.0), dtype=torch.float64) / self.imaging.pixel_pitch

    def _beside(self, x: Tensor, y: Tensor) -> Tensor:
        """How far light of columns and rows falls beside them, (2, Y, X) [pixels]."""
        from_axis = torch.stack(torch.meshgrid(x, y, indexing="xy")) - self._axis[:, None, None]
        far = from_axis.norm(dim=0) / self._reach
        return from_axis * (far[..., None] ** torch.arange(0, 2 * _POWERS, 2) @ self._factors)

    def _thinned(self, settings: Mapping[str, Any]) -> float:
        """How much less, or more, light falls on pixels than by PSFs of each place, RMS. Where it falls beside the
        places that stand for it, the farther the farther these are from the axis, it spreads over more of the sensor;
        of light that nodes share, as these alone say.
        """
        apart, sides = self.imaging.changed(**settings).accuracy.node_spacing, self.sample.picture[::-1]
        if apart is None:
            return 0.0
        x, y = ((torch.arange(_GRID, dtype=torch.float64) + 0.5) * n / _GRID - n / 2 for n in sides)

        def spread(beside: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
            wider = beside(x + 0.5, y)[0] - beside(x - 0.5, y)[0]
            return wider + beside(x, y + 0.5)[1] - beside(x, y - 0.5)[1]

        off = spread(self._beside)
        across, down = (Axis.of(n, 1, apart=apart).nodes for n in sides)
        known = self._beside(across, down)
        off = off - spread(lambda x, y: linear_weights(down, y) @ known @ linear_weights(across, x).T)
        return float(off.square().mean().sqrt())

    def _moves(self, settings: Mapping[str, Any]) -> tuple[bool, ...]:
        accuracy = self.imaging.accuracy.settings() | dict(settings)
        return tuple(accuracy["blur"] and accuracy[name] for name in MOVES)

    def _moved(self, moves: tuple[bool, ...]) -> Tensor:
        """What is recorded, (B, J, H, W), as so much of the optics brings it to the picture."""
        if moves not in self._moved_known:
            planes, sample = self._light, self.sample
            own = self.imaging.changed(**dict(zip(MOVES, moves, strict=True)))
            if any(moves) and sample.places is None:
                planes = own.moved(self.scene, planes, vergences=self.optics.layers)
            elif any(moves):
                reach = own.reach(sample.picture)
                parts = [own.part(place, reach=reach) for place in sample.places or ()]
                rows = zip(parts, planes.split(1), strict=True)
                found = (
                    part.moved(self.scene.samples([k]), one, vergences=self.optics.layers)
                    for k, (part, one) in enumerate(rows)
                )
                planes = torch.cat([*found])
            self._moved_known[moves] = planes
        return self._moved_known[moves]

    def _blurred(self, light: Tensor, settings: Mapping[str, Any]) -> Tensor:
        """The energy of light (B, J, H, W) that is blurred as the first part is where it is sharpest, (B,)."""
        *_, optics = self._parts[0]
        sharpest = min(optics.layers.split(1), key=self._blur)
        transfer = optics.of(optics.stage(settings), sharpest, optics.wavelengths, Way.PSFS)[0].mean(1)
        hue_by_hue = (blurred(hue, transfer, optics.frequencies, "reflect")[0] for hue in light.split(1, dim=1))
        return torch.stack(list(hue_by_hue)).sum(0)

    @functools.cached_property
    def apart(self) -> int:
        """About how many pixels the nodes of the reference lie apart."""
        longest = max(self.sample.picture)
        tried = min(_TRIED, longest)
        few = _FEW | ({"layers": _FEW_LAYERS} if len(self.optics.layers) > _FEW_LAYERS else {})
        off, all_of_it = self.energies({**few, "spacing": tried}, few)
        error = SHARED * float((off / all_of_it.clamp(min=1e-300)).max()) ** 0.5
        return min(nodes_apart(error, tried)[0], longest)

    def compare(self, settings: Mapping[str, Any], recorded: Tensor, *, cut: Tensor) -> bool:
        """As `Spectra.compare`."""
        said = self.energies(settings, settings)[1]
        self._unlike = (said / recorded.to(said).clamp(min=1e-300)).clamp(min=1)
        return True

    def frame(self, settings: Mapping[str, Any]) -> bool:
        """As `Spectra.frame`: what is lost beyond borders is not known without PSFs."""
        return False

    @property
    def unlike(self) -> float:
        """As of `Spectra`."""
        return float(self._unlike.max())

    def dimmed(self, settings: Mapping[str, Any]) -> list[float]:
        """As `Spectra.dimmed`."""
        sharp, seen = (self.energies(own, own)[1] for own in ({**settings, "blur": False}, settings))
        found: list[float] = (sharp / seen.clamp(min=1e-300)).sqrt().clamp(min=1).tolist()
        return found

    @torch.no_grad()
    def hiding(self, changes: Mapping[str, Any], against: Mapping[str, Any], rows: list[int]) -> tuple[Tensor, Tensor]:
        """As `Spectra.hiding`."""
        return self._whole.hiding({**changes, **_EVEN}, {**against, **_EVEN}, rows)

    def behind_edges(self, changes: Mapping[str, Any], against: Mapping[str, Any]) -> float:
        """As `Spectra.behind_edges`."""
        return self._whole.behind_edges(changes, against)

    @property
    def of_lines(self) -> bool:
        """As of `Spectra`, where that counts: at edges of depth."""
        return self.optics.deep and self._whole.of_lines

    @functools.cached_property
    def _light(self) -> Tensor:
        return hues(self.scene, self.weights)

    @functools.cached_property
    def contrast(self) -> Tensor:
        """As of `Spectra`."""
        return contrast(self._light)

    @functools.cached_property
    def few_lights(self) -> Tensor:
        """As of `Spectra`."""
        return few_lights(self._light.square().sum(1, keepdim=True).sqrt())


class _TransfersAt(Transfers):
    """Those of places of a picture."""

    def __init__(self, imaging: Imaging, scene: Scene, picture: tuple[int, int]) -> None:
        super().__init__(imaging, scene, picture)
        self._among = self.layers = imaging.spanning(scene)
        self.place, self._scene = (0.0, 0.0), scene
        self._cuts: dict[str, Tensor] = {}  # by what a stage says of them
        self._psfs: dict[Any, FieldPSFs] = {}  # by vergences, wavelengths and lateral colour

    def at(self, place: tuple[float, float]) -> _TransfersAt:
        """The same at another place, x and y from the picture's middle [pixels]; what they know is shared."""
        own = type(self).__new__(type(self))
        vars(own).update(vars(self), place=place)
        vars(own).pop("corners_of_colours", None)  # which differ
        return own

    def cut(self, imaging: Imaging) -> Tensor | None:
        """As of `Transfers`; kept, because all parts ask."""
        key = str((imaging.accuracy.layers, imaging.accuracy.blur))
        if self.deep and key not in self._cuts:
            depth = torch.as_tensor(self._scene.depth, dtype=torch.float64)
            self._cuts[key] = imaging.vergences(self._scene, depth, wavelengths=self.wavelengths).cpu()
        return self._cuts.get(key)

    def beside(self, places: Tensor, vergences: Tensor) -> Tensor:
        """How far light of places (N, 2) falls beside them along x, (N,) [pixels]."""
        field = self._field(self.imaging, vergences, self.few, self.window(self.imaging, vergences))
        rows = field.bank(places).double().sum((1, 2, 3)).cpu()
        return rows @ (torch.arange(rows.shape[1]) - rows.shape[1] // 2).double() / rows.sum(1)

    @functools.cached_property
    def corners_of_colours(self) -> float:
        """As of `Transfers`, of a window as large as the picture that cuts more off than diffraction."""
        ends = self.ends.unique()
        window = self.window(self.imaging, ends)
        if self.imaging.accuracy.psf_shape is not None or all(map(operator.lt, window, self.picture)):
            return 1.0
        seen = self._field(self.imaging.changed(psf_shape=window), ends, self.few, window)
        light = seen.bank(torch.tensor([self.place], dtype=torch.float64)).sum((-2, -1))
        return CUT_COLOURS if float(light.min()) < _HELD else 1.0

    def slices(self, imaging: Imaging, vergences: Tensor, wavelengths: Tensor, way: Way, *, grey: bool) -> Tensor:
        """By PSFs there, and what they are off by between nodes."""
        accuracy, window = imaging.accuracy, self.window(imaging, vergences)
        if not accuracy.blur:
            return super().slices(imaging, vergences, wavelengths, way, grey=grey)
        key = self.place, tuple(vergences.tolist()), tuple(wavelengths.tolist()), *accuracy.settings().values()
        if key not in self._sliced:
            found = self._by_colours(imaging, vergences, wavelengths)
            if accuracy.spacing is not None and accuracy.field_variation:
                field = self._field(imaging, vergences, wavelengths, window)
                found = found + self.slices_of(field.off_between_nodes(self.place, self.picture))
            self._sliced[key] = found
        return self._sliced[key]

    def _by_colours(self, imaging: Imaging, vergences: Tensor, wavelengths: Tensor) -> Tensor:
        """Those of all wavelengths by a polynomial through `_COLOURS`, where fewer would nearly do; but of a few where
        lateral colour is left out.
        """
        usual = imaging.accuracy.lateral_colour is self.imaging.accuracy.lateral_colour
        alone = self.deep and len(wavelengths) <= _ALONE  # of layers that are not asked for in other colours
        if not usual or alone or len(self.wavelengths) <= _COLOURS:
            return self._at(imaging, vergences, wavelengths)
        nodes, fewer = (chebyshev_wavelengths(self.wavelengths, count)[0] for count in (_COLOURS, _FEWER))
        known = self._at(imaging, vergences, nodes)
        left = known - _between(fewer, _between(nodes, known, fewer), nodes)
        if float((left.abs().square().mean((0, 1, 2)) * self._usual_light).sum()) < _LEFT**2:
            return _between(nodes, known, wavelengths)
        return self._at(imaging, vergences, wavelengths)  # which vary too fast even for cubics between all bands

    @functools.cached_property
    def _usual_light(self) -> Tensor:
        """The share of each ring of frequency, of pictures that have as much of any octave."""
        octaves = torch.gradient(self.frequencies)[0] / self.frequencies.clamp(min=float(self.frequencies[1]))
        return octaves / octaves.sum()

    def _at(self, imaging: Imaging, vergences: Tensor, nodes: Tensor) -> Tensor:
        """By the PSFs of these wavelengths: those of smaller windows are the middle of the whole."""
        whole, window = imaging.changed(psf_shape=self.imaging.accuracy.psf_shape), self.window(imaging, vergences)
        height, width = map(max, self.window(whole, vergences), window)  # what is in focus may have a smaller one
        field = self._field(whole, vergences, nodes, (height, width))
        psfs = field.bank(torch.tensor([self.place], dtype=torch.float64))[0]
        seen = middle(psfs, window)
        if not imaging.accuracy.renormalise:
            return self.slices_of(seen)
        light = psfs.sum((-2, -1)) / seen.sum((-2, -1))
        return self.slices_of(seen) * light[..., None, None].double().cpu()

    def _field(self, imaging: Imaging, vergences: Tensor, wavelengths: Tensor, window: tuple[int, int]) -> FieldBank:
        key = *vergences.tolist(), *wavelengths.tolist(), imaging.accuracy.lateral_colour
        if key not in self._psfs:  # which keep those of each place
            while sum(psfs.held for psfs in self._psfs.values()) > KEPT:
                del self._psfs[next(iter(self._psfs))]
            traced = self.layers, self.wavelengths
            self._psfs[key] = imaging.field_psfs(self.picture, traced, vergences=vergences, wavelengths=wavelengths)
        return imaging.field_bank(self._psfs[key], imaging.pixels(window, self._like))

    @property
    def _widest(self) -> None:
        """Nothing is known but PSFs."""


def _between(nodes: Tensor, known: Tensor, wavelengths: Tensor) -> Tensor:
    """Slices at wavelengths (G,) by a polynomial through those at nodes, (Z, n, 2, F)."""
    weights = lagrange_weights(1e-6 / nodes, 1e-6 / wavelengths.to(nodes))
    return torch.einsum("gn,znof->zgof", weights.to(known), known)


def _together(scenes: Sequence[Scene]) -> Scene:
    """One batch of scenes of one size."""
    first, depths = scenes[0], [torch.as_tensor(scene.depth, dtype=torch.float64) for scene in scenes]
    depth = torch.cat([own.view(-1) if own.ndim < 2 else own for own in depths]) if len(scenes) > 1 else first.depth
    return replace(first, coefficients=torch.cat([scene.coefficients for scene in scenes]), depth=depth)


def _thirds(side: int) -> list[tuple[int, int, float]]:
    """Start, length, and the place that stands for it from the middle, of parts of a side [pixels]."""
    outer = int(_OUTER * side)
    if outer == 0:
        return [(0, side, 0.0)]
    away = _MIDDLE * side / 2
    return [(0, outer, -away), (outer, side - 2 * outer, 0.0), (side - outer, outer, away)]
