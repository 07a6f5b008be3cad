"""What the optics of a stage do to light in rings of frequency, for estimates: slices of transfer functions along x and
y, or the diagonals, from tables or line spreads where there are any, else from PSFs; each is computed once.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum, auto
from typing import Any

import torch
from torch import Tensor

from kcam.optics import Imaging, Lens
from kcam.optics.imaging import is_deep
from kcam.optics.numerics import cubic_weights
from kcam.optics.propagation.estimates import beyond_paraxial, is_oblique
from kcam.optics.propagation.question import Query
from kcam.optics.propagation.row import Propagator, Transfer
from kcam.optics.propagation.sampling import along_axis
from kcam.optics.source import Defocus, Points
from kcam.planner.band_counts import FEW_BANDS, ROUND, group_counts, interpolated, node_counts
from kcam.planner.cross_spectra import rings
from kcam.scene import Scene

PARAXIAL = {"propagator": "fresnel"}
"""The model that leaves out what spheres have beyond their parabolas, as changes of an Imaging."""

_FEW_LINES = 12  # wavelengths of a scene, between whose line spreads those of others lie
_APART = 0.25  # of their steps, at least; of two that are less far apart cubics take one
_BETWEEN = {6.0: 1.0, 3.0: 1.1, 2.4: 1.2}  # line spreads for each PSF, at least, of which its own lies between some;
# and times the error that they tell then: 0.6 to 1.25 times what each one's own tell, of which the truth is half in the
# median (600 choices before random, strange and adversarial pairs)
_WIDEST_STEP = 1.25e5  # of 1/wavelength, between such neighbours [1/m]: between 14 bands from 380 to 900 nm, up to
# 2.5e5 apart, 0.26 of what a lens of dense flint errs was told; 12 of 28 bands from 420 to 720 nm are 1.16e5 apart
_BESIDE = 1.7  # line spreads for each PSF, at least, between which only those of all bands lie: 0.9 to 1.15 times what
# they are by each one's own (5 to 95 % of 36 deep scenes behind maps)
_CUT, _CUT_ROUND = 2.0, 1.4  # times the error where a window as large as the picture cuts rays off, of a smooth pupil
# and a round one: no slice knows its corners. Pixels scatter into all directions alike
CUT_COLOURS = 1.6  # the same of wavelengths, of pupils that are smooth and not round: 0.63 to 1.38 of 71 (2 %, median)
# would be told too little without; few lights may fall into a corner
_ASKED = (1, FEW_BANDS, ROUND)  # groups of wavelengths, beside which other choices than these are priced
_MISSED, _DIMMER = 0.3, 0.8  # of the light, that a window holds from any distance, from which on line spreads tell
# what models differ in; else it holds more or less by this times (a / d)^2: 0.4 to 1.3 times what 53 maps of pixels do
_HARDLY, _HARDLY_PIXELS = 0.04, 0.025  # of the light from a distance, that a window holds, below which line spreads do
# not tell what is in it, 0.06 to 0.8 times what wavelengths cost 50 aberrated lenses; the same of phases of pixels, of
# which a map of noise was told 0.24 to 0.75 times
_ALIKE, _UNLIKE = 3.0, 1.75  # RMS of what the paraxial model leaves out of the phase [rad], up to which errors of the
# one model are those of the other; times the error beyond: of 5, a window of 17 pixels was told 0.44 of what it costs
_AROUND = 4  # pixels around the rays of a PSF, within which there is light that varies with the wavelength
GAPS = 0.95  # of a pixel's width, that is sensitive, up to which light from all directions folds onto slices: errors
# of optics that are not round were told 0.4 times what they are
_FEW_LAYERS = 3  # of which the transfer functions of all wavelengths are found at once
_HELD = 1e8  # bytes of PSFs that are computed together


class Way(Enum):
    """How transfer functions are found that are in no table: by PSFs; by line spreads, where there are any: of each
    wavelength; of a few of the scene's, between which others lie, or all bands beside PSFs for several; of all of them,
    between which PSFs for several lie; or of the whole window, of which a smaller one cuts some off.
    """

    PSFS = auto()
    LINES = auto()
    BETWEEN_FEW = auto()
    BESIDE_FEW = auto()
    BETWEEN_ALL = auto()
    WHOLE_LINES = auto()


@dataclass(frozen=True)
class Table:
    """Wavelengths, and their transfer functions; middle: of three distances, of which the one in the middle counts."""

    wavelengths: list[float]
    transfer: Transfer
    middle: bool = False

    def __call__(self, frequencies: Tensor, window: tuple[int, int], wavelengths: Tensor) -> Tensor:
        """At frequencies (F,) and some of the wavelengths (L,), (Z, L, 2, F)."""
        places = [self.wavelengths.index(one) for one in wavelengths.tolist()]
        found = self.transfer(frequencies, window, places)
        return found[1:2] if self.middle else found


class Transfers:
    """Those of a stage, and of others changed from it, before a batch of scenes.

    picture: (H, W) of the wholes that the scenes are part of.
    """

    def __init__(self, imaging: Imaging, scene: Scene, picture: tuple[int, int]) -> None:
        self.imaging, self.wavelengths, self.picture = imaging, scene.wavelengths, picture
        self.deep, self.frequencies = is_deep(scene), rings()
        self._like = imaging.working(scene)[:, :0]
        vergences = (1 / torch.as_tensor(scene.depth, dtype=torch.float64)).flatten().cpu()
        self.ends = torch.stack([vergences.min(), vergences.max()])  # the farthest and the nearest
        self._among: Tensor | None = None  # see `Imaging.psf_window`
        self._stages: dict[Any, Imaging] = {}  # by changes
        self._tabled: dict[Any, bool] = {}  # by propagator
        self._windows: dict[Any, tuple[int, int]] = {}  # by what a stage says of them, and vergences
        self._line_rows: dict[Any, Propagator] = {}  # whose lines are asked for, by propagator and window
        self._lines: dict[Any, Transfer] = {}  # the last, of other distances, by these and wavelengths
        self._tables: dict[Any, Table | None] = {} if imaging.known is None else dict(imaging.known.others)
        self._unions: dict[Any, Tensor] = {}  # by wavelengths
        self._sliced: dict[Any, Tensor] = {}  # by table, or how PSFs are computed, window and wavelengths

    def stage(self, changes: Mapping[str, Any]) -> Imaging:
        """With changes: kept, because each setting is asked about often."""
        key = tuple(sorted(changes.items()))
        if key not in self._stages:
            self._stages[key] = self.imaging.changed(**changes)
        return self._stages[key]

    def cut(self, imaging: Imaging) -> Tensor | None:
        """Vergences of the layers that a stage cuts the whole into of which scenes are parts, (Z,) [1/m]; None where
        they are no parts.
        """
        return None

    @functools.cached_property
    def defocus(self) -> Defocus:
        """How far light is spread."""
        return self.imaging.defocus(self.wavelengths)

    @functools.cached_property
    def few(self) -> Tensor:
        """Wavelengths that tell of others."""
        return self.stage({"bands": FEW_BANDS}).psf_wavelengths(self.wavelengths)

    @functools.cached_property
    def _every(self) -> Tensor:
        """All wavelengths at which PSFs may stand for those of others."""
        own, deep = self.wavelengths, self.deep
        counts = (group_counts if deep else node_counts)(len(own))
        some = [{"bands": n} if deep else interpolated(n) for n in counts]
        stages = [*map(self.stage, ({"bands": None}, {"bands": 1}, {"bands": FEW_BANDS}, *some)), self.imaging]
        return torch.cat([stage.psf_wavelengths(own, deep=deep) for stage in stages]).unique()

    def _every_and(self, wavelengths: Tensor) -> Tensor:
        """These, and those of `_every`: mostly they are among them."""
        key = tuple(wavelengths.tolist())
        if key not in self._unions:
            self._unions[key] = torch.cat([self._every, wavelengths]).unique()
        return self._unions[key]

    @functools.cached_property
    def _usual(self) -> Tensor:
        """All bands, between which others lie if they are dense, and the few that are asked for beside them."""
        own = self.wavelengths
        few = [self.stage({"bands": count}).psf_wavelengths(own, deep=self.deep) for count in _ASKED]
        return torch.cat([own if self._dense[1] else self._every, *few]).unique()

    @functools.cached_property
    def _nodes(self) -> Tensor:
        """Of all bands, those between whose line spreads those of others lie."""
        own = self.wavelengths
        return own if len(own) <= _FEW_LINES else _ends_and_between(own, _FEW_LINES)

    @functools.cached_property
    def _dense(self) -> tuple[int, int]:
        """How many nodes, and bands, there are; 0 where they lie too far apart for others to lie between them."""
        nodes, bands = (len(own) if _steps(own) < _WIDEST_STEP else 0 for own in (self._nodes, self.wavelengths))
        return nodes, bands

    def between(self, psfs: int | None, *, lines: bool) -> tuple[Way, float]:
        """How line spreads, or else tables of all bands, tell what so many PSFs for all wavelengths cost, and times the
        error that they tell.
        """
        if psfs is None or len(self.wavelengths) <= _FEW_LINES:
            return Way.LINES, 1.0
        nodes, bands = self._dense if lines else (0, self._dense[1])
        few, every = (
            next((factor for each, factor in _BETWEEN.items() if each * psfs <= known), None)
            for known in (nodes, bands)
        )
        if few is not None:
            return Way.BETWEEN_FEW, few
        if _BESIDE * psfs <= nodes:
            return Way.BESIDE_FEW, 1.0
        return (Way.LINES, 1.0) if every is None else (Way.BETWEEN_ALL, every)

    def of(self, imaging: Imaging, vergences: Tensor, wavelengths: Tensor, way: Way) -> tuple[Tensor, Tensor | None]:
        """Slices along x and y, or both diagonals, at G wavelengths, (Z, G, 2, F), and what each gives to each band of
        light of wavelengths (L,), (L, G).
        """
        groups = imaging.psf_wavelengths(wavelengths, deep=self.deep)
        shares = imaging.shares(wavelengths, deep=self.deep)
        nodes = wavelengths
        if way is Way.BETWEEN_FEW or (way is Way.BESIDE_FEW and shares is None):
            nodes = self._nodes
        elif way is not Way.BETWEEN_ALL:
            nodes = groups
        if not set(groups.tolist()) <= set(nodes.tolist()):
            between = _cubics(nodes, groups)
            groups, shares = nodes, between if shares is None else shares.to(between) @ between
        return self.slices(imaging, vergences, groups, way, grey=len(wavelengths) <= len(self.few)), shares

    def slices(self, imaging: Imaging, vergences: Tensor, wavelengths: Tensor, way: Way, *, grey: bool) -> Tensor:
        """Along x and y, or both diagonals, at wavelengths (G,), (Z, G or 1, 2, F); grey: which are few."""
        if not imaging.accuracy.blur:
            return torch.ones(len(vergences), 1, 2, len(self.frequencies), dtype=torch.float64)
        window = self.window(imaging, vergences)
        known = self.table(imaging, vergences, wavelengths, grey=grey)
        if known is None and way is not Way.PSFS:
            own = self._wider(imaging, vergences) if way is Way.WHOLE_LINES else imaging
            known = self.lines(own, vergences, wavelengths)
        how = (imaging.accuracy.recipe, *vergences.tolist()) if known is None else id(known)
        key = how, window, tuple(wavelengths.tolist())
        if key not in self._sliced:
            self._sliced[key] = (
                self._of_psfs(imaging, vergences, wavelengths, window)
                if known is None
                else known(self.frequencies, window, wavelengths).cpu()
            )
        found = self._sliced[key]
        return found / found[..., :1] if imaging.accuracy.renormalise else found

    def _wider(self, imaging: Imaging, vergences: Tensor) -> Imaging:
        """The stage with the window of a whole PSF, if its own, which may be that of other distances, lies in it."""
        whole = imaging.changed(psf_shape=self.imaging.accuracy.psf_shape)
        fits = all(map(operator.le, self.window(imaging, vergences), self.window(whole, vergences)))
        return whole if fits else imaging

    def _of_psfs(self, imaging: Imaging, vergences: Tensor, wavelengths: Tensor, window: tuple[int, int]) -> Tensor:
        pixels = imaging.pixels(window, self._like)
        each = len(wavelengths) * math.prod(window) * pixels.dtype.itemsize
        parts = vergences.split(max(1, int(_HELD // each)))
        if len(parts) > 1:
            return torch.cat([self._of_psfs(imaging, part, wavelengths, window) for part in parts])
        return self.slices_of(imaging.bank(Points(vergences), wavelengths, pixels))

    def slices_of(self, bank: Tensor) -> Tensor:
        """Of PSFs (Z, G, h, w), (Z, G, 2, F)."""
        if self.turned:
            return _along_diagonals(bank, self.frequencies)
        along, across = along_axis(self.frequencies)
        axis, slices = along < 0.5, []
        sums = []  # over x, and over y: of every other pixel, the middle one among the first
        for planes in (bank, bank.mT):
            first = planes.shape[-1] // 2 % 2
            sums.append([planes[..., start::2].sum(-1, dtype=torch.float64) for start in (first, 1 - first)])
        for (even, odd), (even_across, odd_across) in (sums[::-1], sums):
            own = _spectrum(even + odd, along[axis]), _spectrum(even_across - odd_across, across[~axis])
            slices.append(torch.cat(own, dim=-1))
        return torch.stack(slices, dim=2)

    def window(self, imaging: Imaging, vergences: Tensor) -> tuple[int, int]:
        """Of the PSFs of a stage [pixels]."""
        key = imaging.accuracy.blur, imaging.accuracy.psf_shape, *vergences.tolist()
        if key not in self._windows:
            self._windows[key] = imaging.psf_window(
                self.wavelengths, vergences=vergences, picture=self.picture, among=self._among
            )
        return self._windows[key]

    @functools.cached_property
    def fits(self) -> bool:
        """Whether the window of a whole PSF cuts nothing but diffraction off."""
        return self._widest is None or _inside(self._widest)

    @functools.cached_property
    def turned(self) -> bool:
        """Whether slices are along the diagonals: those along x and y would not see what depth changes."""
        return self.deep and self._widest is not None and is_oblique(self._widest)

    @functools.cached_property
    def folded_across(self) -> bool:
        """Whether light finer than the pixels counts in all directions, of pixels that do not integrate: slices
        straight from the pupil tell of what is folded along them.
        """
        return self._widest is not None and self._widest.folded()

    @functools.cached_property
    def corners(self) -> float:
        """Times the error along x and y that there is in the mean, at most."""
        query = self._widest
        if query is None or query.has_pixel_phase or self.fits:
            return 1.0
        return _CUT_ROUND if query.symmetric else _CUT

    @functools.cached_property
    def passed(self) -> Tensor:
        """Of the light from the farthest and the nearest, what falls into the window, (2 or 1, L) of a few wavelengths;
        of maps of pixels by the model that stands for the others.
        """
        maps = self._widest is not None and self._widest.has_pixels
        imaging = self.stage(PARAXIAL) if maps and not self.folded_across else self.imaging
        return self.of(imaging, self.ends.unique(), self.few, Way.LINES)[0][..., 0].real.mean(-1)

    @property
    def missed(self) -> bool:
        """Whether hardly any light from some distance of the scene, as far as line spreads tell, falls into the window
        at some wavelength.
        """
        if self.fits or self._widest is None:
            return False
        return bool(self.passed.min() < (_HARDLY_PIXELS if self.has_pixel_phase else _HARDLY))

    @property
    def lost_between_ends(self) -> float:
        """How much less light, as a share, falls into the window from one end of the scene than from the other: all of
        it, of what is blurred far wider, or onto pixels that are points.
        """
        if self.fits and not self.folded_across:
            return 0.0
        light = self.passed.mean(1)
        return 1 - float(light.min() / light.max().clamp(min=1e-300))

    def untold(self, imaging: Imaging, vergences: Tensor, wavelengths: Tensor) -> float:
        """What a picture of the paraxial model errs at least, behind maps of pixels whose light mostly misses the
        window: line spreads hardly know what falls into it instead.
        """
        query = self._widest
        if query is None or not query.has_pixels:
            return 0.0
        if imaging.accuracy.renormalise:
            imaging = imaging.changed(renormalise=False)
        passed = self.of(imaging, vergences, wavelengths, Way.LINES)[0][..., 0].real
        return _DIMMER * float(query.tau.detach()) if float(passed.min()) < _MISSED else 0.0

    @property
    def has_pixel_phase(self) -> bool:
        """Whether a map of pixels turns the phase."""
        return self._widest is not None and self._widest.has_pixel_phase

    @functools.cached_property
    def corners_of_colours(self) -> float:
        """As `corners`, of choices of wavelengths alone, unless a few lights stand out."""
        return min(self.corners, CUT_COLOURS)

    @functools.cached_property
    def left_out(self) -> float:
        """RMS of what the paraxial model leaves out of the phase [rad]."""
        return 0.0 if self._widest is None else beyond_paraxial(self._widest)

    @property
    def by_paraxial(self) -> float:
        """Times the error that the paraxial model tells of these optics."""
        return 1.0 if self.left_out < _ALIKE else _UNLIKE

    @functools.cached_property
    def _widest(self) -> Query | None:
        """The scene's ends in a whole window."""
        return self._query(self.imaging, self.ends, self.wavelengths, self.window(self.imaging, self.ends))

    def _query(self, imaging: Imaging, vergences: Tensor, wavelengths: Tensor, window: tuple[int, int]) -> Query | None:
        if not isinstance(lens := imaging.lens, Lens):
            return None
        pixels = imaging.pixels(window, torch.empty(0, dtype=torch.float64))
        return replace(lens.question(Points(vergences), wavelengths, pixels, imaging.accuracy), whole=True)

    def table(self, imaging: Imaging, vergences: Tensor, wavelengths: Tensor, *, grey: bool = False) -> Table | None:
        """Transfer functions of these wavelengths and others, where optics know them without PSFs.

        Of many layers, and in grey light, a few wavelengths have a table, else all that are usually asked for. One
        layer of several has it beside the ends of the scene: of the same rings, whose kernel takes the time.
        """
        if self.folded_across:
            return None
        one = self.deep and len(vergences) == 1
        among = torch.cat([self.ends[:1], vergences.cpu(), self.ends[1:]]) if one else vergences
        window, propagator = self.window(self.imaging, among), imaging.accuracy.propagator  # none is larger
        if propagator not in self._tabled:
            query = self._query(imaging, among, wavelengths, window)
            # in the mean over directions a window that cuts rays off is not what it is; rings reach far with little
            self._tabled[propagator] = (
                query is not None
                and imaging.accuracy.row(query).transfer_of is not None
                and (self.fits or query.has_rings)
            )
        if not self._tabled[propagator]:
            return None
        few = grey or len(vergences) > _FEW_LAYERS
        asked = set(wavelengths.tolist())
        sets = [some for some in (self._usual, self.few) if asked <= set(some.tolist())] or [wavelengths]
        keys = [(propagator, window, tuple(vergences.tolist()), tuple(some.tolist())) for some in sets]
        if (found := next((self._tables[key] for key in keys if key in self._tables), None)) is not None:
            return found
        some, key = (sets[-1], keys[-1]) if few else (sets[0], keys[0])
        query = self._query(imaging, among, some, window)
        transfer = None if query is None else imaging.accuracy.row(query).transfer(query)
        if transfer is None:  # for more wavelengths another row is cheaper
            self._tabled[propagator] = False
            return None
        self._tables[key] = found = Table(some.tolist(), transfer, middle=one)
        if imaging.known is not None:
            imaging.known.keep(key, found)
        return found

    def lines(self, imaging: Imaging, vergences: Tensor, wavelengths: Tensor) -> Table | None:
        """About the transfer functions of these wavelengths and others in this stage's window, if there is a way."""
        if self._widest is None or self._widest.folded(GAPS):
            return None
        if self.turned and (self._widest.has_pixels or not self._widest.lens.round):
            return None
        window, some = self.window(imaging, vergences), self._every_and(wavelengths)
        lens, bands = (imaging.accuracy.propagator, window), tuple(some.tolist())
        key = "lines", *lens, bands, tuple(vergences.tolist())
        if key not in self._tables:
            query, lines = self._query(imaging, vergences, some, window), None
            if query is not None:
                query = replace(query, turned=self.turned)
                if lens not in self._line_rows:  # the price of all wavelengths takes as long
                    self._line_rows[lens] = imaging.accuracy.row(replace(query, wavelengths=self.few))
                lines = self._line_rows[lens].lines(query, self._lines.get((lens, bands)))
            self._tables[key] = None if lines is None else Table(list(bands), lines)
            if lines is not None:
                self._lines[lens, bands] = lines
        return self._tables[key]


def _along_diagonals(bank: Tensor, frequencies: Tensor) -> Tensor:
    """Slices of the transfer functions of PSFs (Z, G, h, w) along the falling and the rising diagonal, (Z, G, 2, F)."""
    right, down = along_axis(frequencies, turned=True)
    y = torch.arange(bank.shape[-2], dtype=torch.float64) - bank.shape[-2] // 2
    turns, found = torch.exp(-2j * math.pi * y[:, None] * down), []
    for psfs in bank:
        rows = _spectrum(psfs.double(), right)  # (G, h, F)
        found.append(torch.stack([torch.einsum("ghf,hf->gf", part, turns) for part in (rows, rows.conj())], dim=1))
    return torch.stack(found)


def _spectrum(light: Tensor, frequencies: Tensor) -> Tensor:
    """Of light along a line (..., N) at frequencies (F,), (..., F)."""
    x = torch.arange(light.shape[-1], dtype=torch.float64) - light.shape[-1] // 2
    return light.cpu().to(torch.complex128) @ torch.exp(-2j * math.pi * x[:, None] * frequencies)


def _ends_and_between(wavelengths: Tensor, count: int) -> Tensor:
    """The outermost of the wavelengths (L,), and so many less two of those between, so that 1/wavelength goes in even
    steps, nearly.
    """
    numbers = 1 / wavelengths
    even = torch.linspace(float(numbers.min()), float(numbers.max()), count).to(numbers)
    found = wavelengths[(numbers - even[:, None]).abs().argmin(1)].unique()
    apart = -(1 / found).diff() > _APART * (even[1] - even[0])
    apart[-2] &= apart[-1]  # the last but one, from the one before and from the end
    return torch.cat([found[:1], found[1:-1][apart[:-1]], found[-1:]])


def _steps(wavelengths: Tensor) -> float:
    """The largest between neighbours, of 1/wavelength [1/m]."""
    return max((1 / wavelengths).sort().values.diff().tolist(), default=0.0)


def _cubics(nodes: Tensor, wavelengths: Tensor) -> Tensor:
    """Weights (L, n) of cubics in 1/wavelength through the four nearest of the nodes (n,)."""
    numbers, order = (1e-6 / nodes).sort()
    return cubic_weights(numbers, 1e-6 / wavelengths)[:, order.argsort()]


def _inside(query: Query) -> bool:
    """Whether all rays fall well inside the window."""
    return float(query.displacement.max()) < (min(query.shape) // 2 - _AROUND) * query.pixel_pitch
