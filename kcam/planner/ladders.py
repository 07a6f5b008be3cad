"""The choices that a plan makes about the optics: ladders from the cheapest setting to the reference physics.

To add a choice, write a function that gives its ladder, and a row of `LADDERS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch

from kcam.optics import Imaging, Lens
from kcam.optics.imaging import is_deep
from kcam.optics.propagation.grid import sample_counts
from kcam.optics.propagation.sampling import KAPPA
from kcam.optics.rendering.depth import few_values
from kcam.optics.source import Points
from kcam.planner.band_counts import FEW_BANDS, GRIDS, ROUND, group_counts, interpolated, node_counts
from kcam.planner.evaluation import CROP, HARDLY, Evaluator
from kcam.planner.ladder import LITTLE, Ladder, Level
from kcam.planner.spectra import Care
from kcam.planner.survey import RANKS
from kcam.planner.transfers import GAPS, PARAXIAL
from kcam.scene import Scene

FEW_LAYERS, FEWER_LAYERS, TAIL = 3, 2, 16
"""Of the settings beside which a choice is priced: layers, those of one scene behind maps of pixels (an item of a batch
may lie anywhere between: it was told 0.65 of what it errs), and pixels of the PSF beyond its rays.
Behind maps wavelengths of 73 deep scenes cost 0.78 to 1 times what they cost with all layers (5 to 95 %), and with 3
layers 0.83 to 1 times.
"""

BRIGHTEST = 4
"""Pixels whose distances count where a few lights stand out."""

SPREAD, BY_THREE = 8.0, 1.2
"""By how many pixels blur differs from one end of a scene to the other, from which on wavelengths cost more than they
do beside three layers; and times that: beside them 7 lenses were told 0.46 to 0.95 of what they cost with all layers,
and beside five around what is in focus 0.75 to 1.08, which takes a quarter more of a plan.
"""

BLUR_APART = 1 / 2
"""Of the shorter side of a picture, by which the radius of the blur differs at most between these layers: far out of
focus a few of many hold most of the light that falls into the picture, and a lens was told 0.17 of what it errs.
"""

QUADRATURE = (1.25, 2.0)
"""`ORDERS` of groups of wavelengths: with these 51 estimates from below were 1.1 to 25 times the truth."""

FASTEST, FASTEST_COLOURS = 2.0, 4.0
"""With which power of its step hardly a ladder's error falls, of layers and of groups of wavelengths: of 36 deep scenes
behind maps errors of such groups fall with 2.8 at most from one on, with 4.3 from two (6 from two to three).
"""

FEW_DISTANCES = 33
"""Of a scene whose layers are at its own distances, up to which others do not converge; more are a ramp."""

ONE_PLANE = 2e-3
"""What one plane for all distances errs at least, of the whole picture, for each pixel by which the blur of either end
differs from that in the middle: 1.8e-3 to 0.8 of 202 scenes, less of 4 whose ends hardly differ.
"""

HIDING, HIDING_LIGHTS, BY_FEWER = 4, 17, 1.2
"""Layers of depth with which what hides what costs what it does with more: 0.8 to 1.16 times of 107 scenes, times what
makes up for that; and of a few lights: 0.93 to 1.07 times, where 9 told 0.57 of a lamp on a ramp.
"""

BY_LINES, BY_ONE = 4.0, 4.0
"""How many times too large or too small rough errors may be: of the PSF's window by line spreads instead of PSFs, which
only refuse, and of pupil samples at one wavelength instead of a few. Of the largest windows of 61 random pairs they
were 0.52 to 3.1 times the others, of 150, where they were above `COARSE`, 0.37 to 3.7 times.
"""

BY_LINES_OF_PIXELS, BY_ONE_MODEL = 1.2, 1.25
"""The same of what line spreads tell of pictures behind maps of pixels well enough: what windows cost, and the paraxial
model, at one wavelength. Of 79 windows behind 60 maps they were 0.88 to 5.2 times the truth, of models of 104 maps
0.64 to 6 times, and to 13 of a few lights.
"""

HIDES_NOTHING = {"occlusion": False}

FINE = 7e-3
"""Error below which seams between layers count: above, what planes between others miss is more."""

TAKES, TAKES_RANK = 1.2e-2, (2e-2, 3e-8)
"""Seconds, on the machine of the rates, for what line spreads tell of models; and for the ranks of a cube, and each of
its numbers.
"""

FORESEEN = {False: 1.5, True: 6.0}
"""Times (a / d)^2, what models are told to cost in the median of 104 maps of pixels: of pictures, and of few lights."""

BEYOND, SMALL_BEYOND = 4.0, 0.2
"""What pictures of the paraxial model err at most, times (a / d)^2 and a tenth of the RMS that it leaves out of the
phase [rad]: 0.03 to 1.5 times these of 107 maps of pixels, and 2.8 and 3.8 times of two; more where a few lights stand
out. And `SMALL` for it: it leaves others most of the error that there may be.
"""

COARSE = 2e-4
"""Of pupil samples at one wavelength, which may have the same grid either way, where others have not."""

KAPPAS, KAPPAS_OF_PIXELS = {1.3: 1.3e-3, 1.7: 8e-4, 2.1: 3e-4}, {1.7: 4e-3, 1.9: 1.4e-3, 2.1: 3.5e-4}
"""Pupil samples for each fringe, and how far off transfer functions then are, of all light: see `Evaluator.error_of`.
Pictures erred at most 1.0e-3, 7.3e-4 and 2.3e-4 times what all of the light would, of 117 random pairs with smooth
pupils, round, square and annular; and 3.1e-3, 1.1e-3 and 2.6e-4 of 250 with maps of pixels in round ones, of more than
`FEWEST` samples, the noisy ones most.
"""

FEWEST = 64
"""Pupil samples of any grid under a map of pixels, at least: fewer for each fringe then save nothing."""

URGENT = 10.0
"""Of what saves next to nothing: it is left out where it matters ten times less than what else is."""

EXACT = "nonparaxial"
"""The model beside `PARAXIAL`. What other choices cost is the same in both, to 10 % (of 24 maps, f/5 to f/50)."""

CANCELLED = {torch.float32: 2e-5, torch.float64: 1e-13}
"""What is left of a picture's precision where planes of either sign add up to it."""

ROUNDED = {torch.float32: 2e-6, torch.float64: 1e-15}
"""By which two ways to the same picture differ."""

SINGLE = 6e-6
"""What pictures in float32 are said to err at least: of few wavelengths and layers 2.4e-6 was told, of all 4.4e-6."""

WINDOWS = (5, 9, 17, 33, 65, 129, 257, 513)  # sides of those of PSFs that may stand for the whole [pixels]
UNRECORDED, FARTHER = 1e-3, 1.2  # RMS of light of a wavelength, of that of all, of which windows may cut off what they
# like; how much farther rays may go at others than at those that tell of a window
LAYERS = (1, 2, 3, 4, 5, 7, 9, 13, 17, 25, 33, 49, 65, 97, 129)
MOST = 0.7  # of all layers: more of them save next to nothing, and where each distance has its own, miss some of these
MARKS = (5, 13, 33, 65)  # of these, by which the others are priced
SEEN = 1.5  # pixels that blur of lights differs by from one of these to the next: of coarser ones none may be in focus


def ladders(evaluator: Evaluator, scene: Scene, *, one: bool = False) -> list[Ladder]:
    """The choices that exist for a camera and a scene (the one that takes longest), of which the evaluator has then
    seen what it needs; one: those that pay for a single picture.
    """
    imaging = evaluator.imaging
    if imaging is None:
        evaluator.look({})
        return []
    view = _View(evaluator, imaging, scene, one=one)
    evaluator.look(view.beside | view.coarse)
    if evaluator.missed:  # which is known now
        view = _View(evaluator, imaging, scene, one=one)
    make_ladders = (_blur, _precision, _rank) if evaluator.missed and one else LADDERS  # the others take PSFs to know
    found = [ladder for make in make_ladders for ladder in make(view)]
    for ladder in found:
        ladder.least = max(ladder.least, ROUNDED[view.dtype])
    return found


class _View:
    """What the ladders look at."""

    def __init__(self, evaluator: Evaluator, imaging: Imaging, scene: Scene, *, one: bool) -> None:
        self.imaging, self.scene, self.one = imaging, scene, one
        planes, self.vergences, _ = evaluator.laid_out(imaging, scene)
        self.dtype = planes.dtype
        depth = torch.as_tensor(scene.depth, dtype=torch.float64)
        self.layers = len(imaging.vergences(scene, depth)) if depth.ndim > 1 else 1  # a distance per item is no choice
        self.bands = min(imaging.accuracy.bands or len(scene.wavelengths), len(scene.wavelengths))
        self.window = imaging.psf_window(scene.wavelengths, vergences=self.vergences, picture=scene.shape[1:])
        ends = torch.stack([self.vergences.min(), self.vergences.max()])
        self.blur, self.row, self.query, self.few_layers = 0.0, None, None, FEW_LAYERS
        self.stand_in: dict[str, Any] = {}
        self.rays = torch.zeros(len(scene.wavelengths), dtype=torch.float64)  # of each wavelength, at most [pixels]
        if isinstance(lens := imaging.lens, Lens):
            pixels = imaging.pixels(self.window, planes)
            self.query = query = lens.question(Points(ends), scene.wavelengths, pixels, imaging.accuracy)
            self.blur = float(query.displacement.max()) + lens.pixel_phase_displacement(query.wavelengths)
            self.rays = query.displacement.cpu() / imaging.pixel_pitch
            self.row = None if imaging.varies else imaging.accuracy.row(query)
            exact = self.row is not None and self.row.physics == EXACT
            alike = not (query.folded(GAPS) or evaluator.missed)  # points, and what is left of light, are not
            if exact and lens.has_pixels and alike:
                self.stand_in = PARAXIAL  # no warp, and lines
            if query.has_pixel_phase and not imaging.varies and len(evaluator.items) == 1:
                self.few_layers = FEWER_LAYERS
        elif evaluator.varies:
            self.blur = float(evaluator.defocus.radius(ends).max()) * imaging.pixel_pitch
        self.defocused = evaluator.defocus.spread * float(ends[1] - ends[0])  # from one end to the other [pixels]
        self.least_layers = 1 + math.ceil(self.defocused / (BLUR_APART * max(1, min(scene.shape[1:]))))
        self.evaluator = evaluator
        self.apart = evaluator.apart if evaluator.varies else None
        cropped = evaluator.over_field is None and any(sample.places for sample in evaluator.samples)
        self.largest = CROP if cropped else max(scene.shape[1:])
        self.trained = any(p.requires_grad for p in imaging.parameters())
        self.computed = isinstance(lens, Lens) or imaging.varies  # else PSFs cost next to nothing
        self.beside = self.few()

    @property
    def on_grid(self) -> bool:
        """Whether how finely the pupil is sampled is a choice."""
        return self.row is not None and self.row.on_grid and self.imaging.accuracy.samples is None

    def unseen(self, few: int) -> float:
        """How far rays go at any wavelength that is recorded, where so many show much less of them, as of glass far
        out of the range for which it is corrected; else 0 [pixels].
        """
        light = torch.stack([one.light for one in self.evaluator.items]).amax(0)
        recorded = self.rays[light > UNRECORDED * light.norm()]
        wavelengths = self.imaging.changed(bands=min(few, self.bands)).psf_wavelengths(self.scene.wavelengths)
        nearest = (self.scene.wavelengths - wavelengths[:, None].to(self.scene.wavelengths)).abs().argmin(1)
        seen, farthest = float(self.rays[nearest.cpu()].max()), float(max(recorded, default=0.0))
        return farthest if farthest > FARTHER * seen else 0.0

    @property
    def many_samples(self) -> bool:
        """Whether a pupil with a map of pixels takes so many samples that it is known what fewer cost."""
        if self.query is None or not self.query.lens.round:
            return False
        return min(sample_counts(self.query.sampled(kappa=max(KAPPAS_OF_PIXELS)))) > FEWEST

    @property
    def coarse(self) -> dict[str, Any]:
        """The coarsest grid, which does for what only looks at the light."""
        return {"kappa": min(KAPPAS)} if self.on_grid else {}

    def places(self, apart: float) -> tuple[int, int]:
        """Rows and columns of places so far apart at most [pixels]."""
        height, width = self.scene.shape[1:]
        return 1 + math.ceil((height - 1) / apart), 1 + math.ceil((width - 1) / apart)

    @property
    def shift(self) -> str:
        """How far distortion moves light, at most."""
        return f"up to {self.imaging.distorted(self.scene):.2g} px"

    @property
    def darkest(self) -> str:
        """What the darkest corner has of the light on the axis."""
        return f"down to {self.imaging.illuminated(self.scene):.0%}"

    @property
    def of_lights(self) -> bool:
        """Whether what a few layers tell depends on where they are: of a few lights, and of light of few bands."""
        pixels = self.query is None or self.query.has_pixel_phase
        stands_out = self.evaluator.few_lights or self.evaluator.of_lines
        return stands_out and not pixels and self.layers > FEW_LAYERS

    @property
    def around_lights(self) -> tuple[float, ...]:
        """Distances of layers that tell what wavelengths cost a few lights: the ends, what is in focus, those between,
        and where the brightest are.
        """
        far, near = (float(end) for end in self.vergences.aminmax())
        focus = sum(self.evaluator.defocus.focus) / 2
        energy = self.scene.coefficients.detach().square().sum(1).flatten().cpu()
        vergence = 1 / torch.as_tensor(self.scene.depth, dtype=torch.float64).detach().cpu()
        lights = vergence.flatten()[energy.topk(min(BRIGHTEST, len(energy))).indices]
        middle = focus if far < focus < near else (far + near) / 2
        places = {far, (far + middle) / 2, middle, (middle + near) / 2, near, *lights.tolist()}
        return tuple(1 / place if place > 0 else math.inf for place in sorted(places))

    def few(
        self, *, bands: int = FEW_BANDS, layers: int | tuple[float, ...] | None = None, window: bool = True
    ) -> dict[str, Any]:
        """Cheap settings of the others; bands, layers: 0 for all, layers: None for a few."""
        few = dict(self.stand_in)
        if 0 < bands < self.bands and self.computed:
            few["bands"] = bands
        layers = self.few_layers if layers is None else layers
        count = layers if isinstance(layers, int) else len(layers)
        if count and max(count, self.least_layers) < self.layers:
            few["layers"] = layers if count >= self.least_layers else self.least_layers
        core = 2 * (math.ceil(self.blur / self.imaging.pixel_pitch) + TAIL) + 1
        core = min((side for side in WINDOWS if side >= core), default=core)
        if window and core < 0.75 * max(self.window):
            few["psf_shape"] = (min(core, self.window[0]), min(core, self.window[1]))
        if self.apart is not None:  # the middle, the sides and the corners
            few["spacing"] = max(self.apart, math.ceil((self.largest - 1) / 2))
        return few


def _blur(view: _View) -> Iterator[Ladder]:
    label = f"{view.row.physics}, {view.row.method}" if view.row else "as measured"
    levels = [Level("none", {"blur": False}), Level(label, {})]
    if view.trained:
        levels = levels[1:]  # a parameter of the lens that trains acts through it
    ladder = Ladder("diffraction", levels, view.beside, blurs=False)
    if "bands" in view.beside:
        ladder.confirmed_beside = {"bands": view.imaging.accuracy.bands}
    yield ladder


def _model(view: _View) -> Iterator[Ladder]:
    """Paraxial only where that is cheaper: a map of pixels needs no warp then."""
    query, row = view.query, view.row
    if not view.stand_in or query is None or row is None or (view.one and not view.evaluator.certain):
        return
    beside = {name: value for name, value in view.few().items() if name not in PARAXIAL}
    ladder = Ladder("model", [Level("fresnel", PARAXIAL), Level(EXACT, {})], beside, doubtful=True, tried=True)
    if view.evaluator.certain:
        ladder.off_by, ladder.little = BY_ONE_MODEL, math.inf
        if row.lines_of is not None and view.imaging.integrate:
            ladder.takes = TAKES
        tau, few = float(query.tau.detach()), view.evaluator.few_lights
        ladder.foreseen = FORESEEN[few] * tau
        if not few:
            ladder.bounds, ladder.small = {0: BEYOND * (tau + view.evaluator.left_out / 10)}, SMALL_BEYOND
    yield ladder


def _sampling(view: _View) -> Iterator[Ladder]:
    """Under a map of pixels by what is known of all: what a coarse grid makes of it differs from one wavelength to the
    next, 4 times and more, so that a few would not tell.
    """
    lens, told = view.imaging.lens, view.evaluator.certain and not view.imaging.accuracy.renormalise
    if not view.on_grid or not isinstance(lens, Lens) or (lens.has_pixels and not (told and view.many_samples)):
        return
    own, off = view.imaging.accuracy.kappa or KAPPA, KAPPAS_OF_PIXELS if lens.has_pixels else KAPPAS
    levels = [Level(f"kappa {kappa:g}", {"kappa": kappa}, kappa) for kappa in off if kappa < own]
    ladder = Ladder("pupil samples", [*levels, Level(f"kappa {own:g}", {}, own)], view.few(bands=GRIDS))
    ladder.doubtful = not lens.has_pixels
    if view.evaluator.certain:
        ladder.off_by, ladder.least = BY_ONE, COARSE
    if told:
        ladder.tried = ladder.doubtful
        ladder.bounds = {i: view.evaluator.error_of(off[level.fineness]) for i, level in enumerate(levels)}
    if lens.has_pixels:
        ladder.errors |= {(position, 0): bound for position, bound in ladder.bounds.items()}
    yield ladder


def _precision(view: _View) -> Iterator[Ladder]:
    precision = view.imaging.accuracy.precision
    if precision == "float64" or (precision is None and view.scene.dtype == torch.float64):
        levels = [Level("float32", {"precision": "float32"}), Level("float64", {})]
        yield Ladder("precision", levels, view.beside, doubtful=True, least=SINGLE)


def _wavelengths(view: _View) -> Iterator[Ladder]:
    """Of scenes at one distance, where all are compared at no cost, those between a few; else groups."""
    pixels = view.query is not None and view.query.has_pixel_phase
    lamps = view.of_lights
    beside = view.few(bands=0, layers=view.around_lights if lamps else None)
    query, tabled = view.query, view.evaluator.tabled(beside)
    folded = query is not None and (query.folded() or (query.folded(GAPS) and not tabled))
    unsteady = folded or view.evaluator.missed or (view.evaluator.of_lines and not tabled)
    if unsteady and view.one:
        return  # it takes all PSFs to know: what few cost falls in no order with their number
    over_field = view.evaluator.over_field is not None  # where each of few groups is compared with all
    successive = view.computed and not (unsteady or tabled or over_field)
    deep = any(is_deep(scene) for scene in view.evaluator.scenes)
    if successive or deep or view.imaging.varies:
        few: list[dict[str, Any]] = [{"bands": n} for n in group_counts(view.bands)]
    else:
        few = [interpolated(n) for n in node_counts(view.bands)]
    spread = "layers" in beside and view.defocused > SPREAD and not (lamps or pixels)
    shallow = view.layers <= FEW_LAYERS
    if view.one and successive and shallow and not view.stand_in:  # half of the PSFs would save what that takes
        few = [changes for changes in few if 3 * changes["bands"] <= view.bands]
    levels = [Level(f"{n} PSFs" if (n := changes["bands"]) > 1 else "1 PSF", changes, n) for changes in few]
    yield Ladder(
        "wavelengths",
        [*levels, Level(f"{view.bands} PSFs", {}, view.bands)],
        beside,
        successive=successive,
        orders=QUADRATURE,
        fastest=FASTEST if successive else FASTEST_COLOURS if deep else None,
        seams=_behind_edges(view, BY_THREE if spread else 1.0) if deep and view.evaluator.certain else None,
    )


def _behind_edges(view: _View, factor: float) -> Callable[[Level, float, float], float]:
    """What fewer wavelengths err, times a factor, and behind edges of depth, in light of few bands: there so much of
    what hiding nothing costs, 1.1 to 1.5 times the truth; of other light next to nothing.
    """
    evaluator, most_hidden = view.evaluator, max(view.evaluator.hidden, default=0.0)
    counts = evaluator.of_lines and view.imaging.accuracy.occlusion

    def seams(level: Level, error: float, most: float) -> float:
        off = evaluator.behind_edges(level.changes, {}) if counts else 0.0
        if off * most_hidden < LITTLE * most:
            return error * factor
        return math.hypot(error * factor, off * _hidden(view, HIDES_NOTHING, view.few(layers=0)))

    return seams


def _rank(view: _View) -> Iterator[Ladder]:
    """Priced without blur, which only smooths what is missing."""
    own = view.scene.coefficients.shape[1]
    if view.scene.spectra is None and own > 1:
        levels = [Level(f"rank {rank}", {"rank": rank}, rank) for rank in RANKS if rank < own]
        least = CANCELLED[view.dtype]
        levels.append(Level(f"{own} bands", {}, own))
        ladder = Ladder("spectra", levels, {"blur": False}, doubtful=True, least=least)
        ladder.takes = TAKES_RANK[0] + TAKES_RANK[1] * view.scene.coefficients.numel()
        yield ladder


def _depth(view: _View) -> Iterator[Ladder]:
    """Layers, and what hides what: that depends on how many there are."""
    if view.layers == 1:
        return
    names = {1: "one plane"}
    distances = few_values(torch.as_tensor(view.scene.depth), at_most=FEW_DISTANCES)
    own = distances is not None and len(distances) == view.layers  # which other layers miss
    few = [n for n in LAYERS if n <= MOST * view.layers]
    if distances is not None and own and not view.evaluator.samples_have(distances):
        few = []  # nothing tells of what lies there
    levels = [Level(names.get(n, f"{n} layers"), {"layers": n}, n) for n in few]
    top = Level(f"{view.layers} layers", {}, view.layers)
    beside = view.few(layers=0)
    if own:
        layers = Ladder("depth", [*levels, top], beside)
        if view.evaluator.certain:
            layers.at_least = {0: ONE_PLANE * view.defocused / 2}
    else:
        marks: tuple[int, ...] = MARKS if view.evaluator.certain else ()
        if view.of_lights:
            marks = tuple(mark for mark in marks if mark > view.defocused / SEEN)
        layers = Ladder("depth", [*levels, top], beside, successive=True, fastest=FASTEST, marks=marks)
    if view.evaluator.certain and view.imaging.accuracy.occlusion:
        layers.seams = _seams(view, beside, own=own)
    yield layers
    if view.imaging.accuracy.occlusion:
        levels = [Level("none", HIDES_NOTHING), Level("over", {})]
        tried = any(light >= HARDLY for light in view.evaluator.hidden)
        if view.one and tried:
            levels = levels[1:]  # what would be saved is less than what it takes to find out
        hiding, off_by = _hiding(view)
        occlusion = Ladder("occlusion", levels, beside, follows=layers, settled=hiding, off_by=off_by, tried=tried)
        if off_by > 1:
            occlusion.rough, occlusion.little = Care.FULL, math.inf
        yield occlusion


def _hiding(view: _View) -> tuple[int, float]:
    """Layers that tell what hides what, and times what they tell there may be."""
    few = view.evaluator.certain and not view.evaluator.few_lights
    layers, factor = (HIDING, BY_FEWER) if few else (HIDING_LIGHTS, 1.0)
    return max(layers, view.least_layers), factor


def _seams(view: _View, beside: dict[str, Any], *, own: bool) -> Callable[[Level, float, float], float]:
    """What layers hide otherwise than more of them do: of 11 scenes 0.2 to 1.4 times what hiding nothing costs, times
    1/n less 1/n of all of them. What planes between others miss falls faster.

    own: whether all layers are at distances of the scene. Then, and of one plane for a few lights, that may be most of
    the error, of what lies at a distance of these few layers, and is tried out; one plane for others is told to err 1.1
    to 4 times what it does (of 100 ramps).
    """

    def seams(level: Level, error: float, most: float) -> float:
        one = level.fineness == 1
        if own or (one and view.evaluator.few_lights):
            return max(error, _hidden(view, level.changes, beside, own=own))
        if one or most >= FINE:
            return error
        return math.hypot(error, _hidden(view, HIDES_NOTHING, beside) * max(0.0, 1 / level.fineness - 1 / view.layers))

    return seams


def _hidden(view: _View, changes: dict[str, Any], beside: dict[str, Any], *, own: bool = False) -> float:
    """What hides what otherwise costs, beside a few layers, or, own, all of them."""
    layers, factor = _hiding(view)
    few = beside | ({"layers": layers} if view.layers > layers and not own else {})
    return factor * view.evaluator.hiding(few | changes, few)


def _support(view: _View) -> Iterator[Ladder]:
    def level(side: int, *, renormalise: bool) -> Level:
        shape = (min(side, view.window[0]), min(side, view.window[1]))
        changes = {"psf_shape": shape} | ({"renormalise": True} if renormalise else {})
        return Level(f"{shape[0]} x {shape[1]} px" + (", rescaled" if renormalise else ""), changes, side)

    missed = view.evaluator.missed  # then each wavelength has its own of what falls into the window
    by_lines = view.evaluator.by_lines(view.beside)
    tabled = not by_lines and view.evaluator.tabled(view.beside)
    pixels = by_lines and view.query is not None and view.query.has_pixel_phase
    over_field = view.evaluator.over_field is not None
    bands = 0 if missed or over_field else FEW_BANDS if by_lines else ROUND  # over the field all are known
    beside = view.few(bands=bands, layers=view.few_layers if pixels else FEW_LAYERS, window=False)
    largest, unseen = max(view.window), view.unseen(beside.get("bands", view.bands))
    core = tabled and view.evaluator.few_lights  # of which little may count that is far, as beyond wrapped profiles
    least = float(view.evaluator.defocus.radius(view.vergences).max()) if view.one and not core else 0.0
    sides = [side for side in WINDOWS if max(2 * unseen, least) < side < largest]
    levels = [level(side, renormalise=over_field) for side in sides]  # others lose what is put back
    top = Level(f"{view.window[0]} x {view.window[1]} px", {}, largest)

    def rescaled(plain: Level) -> list[Level]:
        return [] if plain is top else [level(int(plain.fineness), renormalise=True)]

    levels = [*levels, top]
    # behind maps line spreads told rescaled ones to cost 0.3 to 1.2 times what they do
    alternatives = None if pixels or over_field else rescaled
    ladder = Ladder("PSF support", levels, beside, alternatives=alternatives, from_top=view.evaluator.certain)
    ladder.doubtful = view.one and not (tabled or pixels or over_field)  # for what takes PSFs of its own
    if pixels:
        ladder.off_by, ladder.rough, ladder.little = BY_LINES_OF_PIXELS, Care.AT_FIRST, math.inf
    elif by_lines and view.imaging.fill_factor == 1:  # else lines do not tell what colours of aliases cost
        ladder.off_by = BY_LINES
    yield ladder


def _field(view: _View) -> Iterator[Ladder]:
    """Of optics that vary over the picture."""
    if view.apart is None:
        return
    imaging, beside = view.imaging, view.few(bands=FEW_BANDS if view.evaluator.over_field is None else ROUND)
    beside.pop("spacing", None)
    counts: dict[tuple[int, int], int] = {}
    spacing = view.largest
    while spacing > view.apart:
        counts.setdefault(view.places(spacing), spacing)
        spacing //= 2
    counts.pop(own := view.places(view.apart), None)
    counts[own] = view.apart
    levels = [
        Level(f"{rows} x {columns} places", {"spacing": apart}, rows * columns)
        for (rows, columns), apart in counts.items()
    ]
    rows, columns = own
    top = Level("places as the scene asks", {}, rows * columns + 1)
    levels = [*levels, top] if imaging.accuracy.spacing is None else [*levels[:-1], replace(levels[-1], changes={})]
    foot = [] if view.trained else [Level("1 PSF", {"field_variation": False}, 1)]
    if not imaging.accuracy.field_variation:
        levels, foot = [Level("1 PSF", {}, 1)], []
    variation = Ladder("field variation", [*foot, *levels], beside)
    yield variation
    few = view.few()
    for effect, size, follows in (
        ("distortion", view.shift, None),
        ("lateral colour", "kept", variation),
        ("relative illumination", view.darkest, None),
    ):
        name = effect.replace(" ", "_")
        levels = [Level("none", {name: False}), Level(size, {})]
        if not getattr(imaging.accuracy, name):
            levels = [Level("none", {})]
        elif view.trained:
            levels = levels[1:]
        yield Ladder(effect, levels, beside if follows else few, follows=follows, urgency=URGENT)


LADDERS: Sequence[Callable[[_View], Iterator[Ladder]]] = (
    _blur,
    _field,
    _model,
    _sampling,
    _precision,
    _wavelengths,
    _rank,
    _depth,
    _support,
)
