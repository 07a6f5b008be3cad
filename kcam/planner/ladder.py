"""A choice of a plan: its rungs from the cheapest to the reference, and how their errors are found as it is climbed."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from kcam.planner.band_counts import GREY
from kcam.planner.evaluation import Evaluator
from kcam.planner.spectra import Care

ORDERS = (1.0, 1.5)
"""A ladder's error falls at least with such a power of its step: one where phases jump, two where it is fine enough."""

STEP = 1.5
"""How much finer the rung is at least, by whose step from here an error is foretold: of smaller ones most would be
foretold, not seen.
"""

COLOURFUL = 2.0
"""How many times as much windows may cost at a few wavelengths as at one that tells of them."""

LITTLE = 1 / 2
"""Of the error that there may be, that a rough estimate may be at its largest and be taken."""

SMALL = 0.4
"""The same of what is said of all optics."""


@dataclass(frozen=True)
class Level:
    """A rung: what it is called, what it changes in the Imaging, and how fine it is (where rungs converge)."""

    label: str
    changes: dict[str, Any]
    fineness: float = 1.0


@dataclass
class Ladder:
    """A choice: its rungs from the cheapest to the reference, the settings beside which it is priced, and where it is.

    successive: an error follows from the steps between rungs, by their order of convergence: for ladders whose top
    costs as much as the reference picture; orders: in between those two. Else it is that against the top.
    blurs: whether it only matters where there is blur.
    alternatives: for each rung, other changes of the same cost, of which the one with the smallest error is taken.
    follows: a ladder on whose rung the errors depend, such as that of occlusion on the number of layers; settled: the
    fineness of its rungs beyond which they do not.
    off_by: how many times too large or too small a rough estimate may be; 1 where there is none. rough: the care of
    those; little: see `LITTLE`, infinite where they are enough.
    from_top: whether rungs are looked at from the top down, to the last that may do alone; where there is a rough
    estimate, that is asked first, the others are priced at one wavelength, and it says what more of them add. fastest:
    with which power of its step its error falls at most, so that rungs which cannot do are not looked at; None where
    any may do. marks: fineness of the rungs by which others are priced, of successive ones: few, so that these are
    computed once.
    seams: what a rung errs in all, where layers hide each other, by what it errs without and what was allowed when it
    was last priced (`most`): asked for where it may do without.
    least: the error that any rung is said to have, of rounding that its pricing does not see.
    confirmed_beside: other settings, beside which a rung that may do is priced again.
    bounds: errors that rungs have at most, by their position: where so much is `small` (`SMALL`), it needs no pricing.
    at_least: about what they err at least: where that is too much, they are not priced.
    doubtful: whether it is left out where its foot saves no time, or for a single picture less than pricing takes;
    tried: whether pricing takes so much that it is looked at last, where it saves enough, see `Prices.worth`; takes:
    seconds for it, None for those of the PSFs of its foot and its top; foreseen: about what its foot errs, by which it
    is then left alone, or 0; urgency: how much more its error counts than others' where the next ladder to climb is
    chosen.
    """

    effect: str
    levels: list[Level]
    beside: dict[str, Any]
    successive: bool = False
    blurs: bool = True
    alternatives: Callable[[Level], list[Level]] | None = None
    follows: Ladder | None = None
    settled: float = math.inf
    off_by: float = 1.0
    rough: Care = Care.ROUGH
    little: float = LITTLE
    orders: tuple[float, float] = ORDERS
    from_top: bool = False
    fastest: float | None = None
    marks: tuple[int, ...] = ()
    seams: Callable[[Level, float, float], float] | None = None
    least: float = 0.0
    confirmed_beside: dict[str, Any] | None = None
    bounds: dict[int, float] = field(default_factory=dict)
    at_least: dict[int, float] = field(default_factory=dict)
    small: float = SMALL
    doubtful: bool = False
    tried: bool = False
    takes: float | None = None
    foreseen: float = 0.0
    urgency: float = 1.0
    most: float = math.inf
    position: int = 0
    errors: dict[tuple[int, int], float] = field(default_factory=dict)
    roughly: dict[Care, dict[tuple[int, int], float]] = field(default_factory=lambda: defaultdict(dict))
    grey: dict[tuple[int, int], float] = field(default_factory=dict)
    compared: set[tuple[int, int]] = field(default_factory=set)

    @property
    def level(self) -> Level:
        """The rung that it stands on."""
        return self.levels[self.position]

    @property
    def at_top(self) -> bool:
        """Whether it is the reference physics."""
        return self.position == len(self.levels) - 1

    @property
    def error(self) -> float:
        """Estimated, of the rung that it stands on: what is known roughly alone is as large as it may be, and at one
        wavelength as large as it is at least.
        """
        return self._error(self.position)

    def _error(self, position: int) -> float:
        key = self._key(position)
        if position == len(self.levels) - 1:
            return 0.0
        known = self.errors if key in self.errors else self.grey
        if key in known:
            error = max(known[key], self.least)
        elif key in self.roughly[self.rough]:
            error = self.off_by * self.roughly[self.rough][key]
        else:
            error = self.at_least[position]
        if self.seams is not None and error <= self.most:
            error = self.seams(self.levels[position], error, self.most)
        return math.inf if math.isnan(error) else error

    def _key(self, position: int) -> tuple[int, int]:
        return position, self._followed

    @property
    def nothing(self) -> bool:
        """Whether its errors are 0 beside the rung that it follows: one layer hides nothing, one PSF has one colour."""
        return self.follows is not None and self.follows.level.fineness == 1

    def bounded(self, most: float) -> int:
        """The lowest rung that may be taken unseen where there may be so much error, or the top."""
        top = len(self.levels) - 1
        return min((place for place, bound in self.bounds.items() if bound <= self.small * most), default=top)

    @property
    def _followed(self) -> int:
        """The rung of the ladder that it follows, if any, or one that tells as much."""
        if self.follows is None:
            return 0
        position, below = self.follows.position, self.follows.levels[: self.follows.position]
        return next((index for index, level in enumerate(below) if level.fineness >= self.settled), position)

    def price(self, evaluator: Evaluator, most: float) -> None:
        """Estimate the error of the rung that it stands on, of which there may be so much at most."""
        self.most = most
        if self.from_top and self.position == 0:
            self.position = self._lowest(evaluator, most)
        self._price(evaluator, self.position, most)

    def _lowest(self, evaluator: Evaluator, most: float) -> int:
        """The lowest rung whose error may do alone, as may those of all above it."""
        low = len(self.levels) - 1
        if low > 0 and self._by_one and self._roughly(evaluator, low - 1, Care.AT_FIRST) > self.off_by * most:
            return low
        while low > 0:
            self._price(evaluator, low - 1, most)
            if self._error(low - 1) > most:
                break
            low -= 1
        return low

    def _price(self, evaluator: Evaluator, position: int, most: float) -> None:
        key = self._key(position)
        if position == len(self.levels) - 1 or key in self.errors or self.at_least.get(position, 0.0) > most:
            return
        if self.nothing:
            self.errors[key] = 0.0
        elif position in self.bounds and self.bounds[position] <= self.small * most:
            self.errors[key] = self.bounds[position]
        elif self.successive:
            self.errors[key] = self._beyond(evaluator)
        elif self._by_one:
            if key not in self.grey:
                self.levels[position], self.grey[key] = self._best(evaluator, position, **GREY)
            if self.grey[key] <= most:
                self.errors[key] = self._coloured(evaluator, position)
        elif self.off_by == 1 or not self._settled(self._roughly(evaluator, position), most):
            self.levels[position], self.errors[key] = self._best(evaluator, position)
            if self.confirmed_beside is not None and self.errors[key] <= most:
                self.errors[key] = max(self.errors[key], self._best(evaluator, position, **self.confirmed_beside)[1])

    @property
    def _by_one(self) -> bool:
        """Whether rungs are priced at one wavelength, and roughly at more."""
        return self.from_top and self.off_by > 1 and math.isfinite(self.little)

    def _coloured(self, evaluator: Evaluator, position: int) -> float:
        """The error of a rung by what it is at one wavelength, and how much more it is at a few, roughly. Where that is
        much, of a lens that one wavelength sees in focus, halfway to what is said of these few.
        """
        roughly = self._roughly(evaluator, position)
        grey = self._best(evaluator, position, Care.ROUGH, **GREY)[1]
        more = max(1.0, roughly / grey) if grey else 1.0
        error = self.grey[self._key(position)] * more
        return error if more < COLOURFUL else max(error, math.sqrt(error * roughly))

    def _best(
        self, evaluator: Evaluator, position: int, care: Care = Care.FULL, **settings: Any
    ) -> tuple[Level, float]:
        """Of a rung and its alternatives that with the smallest error; settings: beside its own."""
        beside = self.beside | settings | (self.follows.levels[self._followed].changes if self.follows else {})
        level = self.levels[position]
        candidates = [level] + (self.alternatives(level) if self.alternatives else [])
        top = beside | self.levels[-1].changes
        errors = [evaluator.error(beside | level.changes, top, care) for level in candidates]
        best = min(range(len(errors)), key=errors.__getitem__)
        return candidates[best], max(errors[best], self.least)

    def _roughly(self, evaluator: Evaluator, position: int, care: Care | None = None) -> float:
        key, known = self._key(position), self.roughly[care or self.rough]
        if key not in known:
            best, known[key] = self._best(evaluator, position, care or self.rough)
            if not math.isfinite(self.little):
                self.levels[position] = best
        return known[key]

    def _settled(self, roughly: float, most: float) -> bool:
        """Whether a rough estimate says enough: that this may do in any case, or in none."""
        return self.off_by * roughly <= self.little * most or roughly > self.off_by * most

    def _beyond(self, evaluator: Evaluator) -> float:
        """What is left from here to where rungs converge, by the steps up to here; at the foot, and where rungs are
        marked, by the next one.

        Of order p, e = step r / (1 - r), r = (fineness below / fineness)^p; p from two steps, if there are two: that
        of their middles.
        """
        if self.marks:
            foretold = self._foretold(evaluator)
            return self._by_the_next(evaluator, self.position) if foretold is None else foretold
        priced = {position for position, _ in self.errors}
        below = sorted(low for low in priced if STEP * self.levels[low].fineness <= self.level.fineness)[-2:]
        if not below:
            return self._by_the_next(evaluator, self.position)
        places = (*below, self.position)
        known = [self.beside | self.levels[position].changes for position in places]
        steps = [evaluator.error(below, above) for below, above in pairwise(known)]
        finer = [math.log(above / below) for below, above in pairwise(self.levels[at].fineness for at in places)]
        order, most = self.orders
        if len(steps) > 1 and 0 < steps[1] < steps[0]:
            fall = math.log(steps[0] / steps[1] * finer[1] / finer[0])
            order = min(max(2 * fall / sum(finer), order), most)
        return steps[-1] / math.expm1(order * finer[-1])

    def _foretold(self, evaluator: Evaluator) -> float | None:
        """What is left from here, up to a mark, by how errors fall on the rungs that are priced by it: the next one, of
        twice as much, need not be looked at. None where that is not how they fall where rungs converge.
        """
        top = self._above(self.position)
        marks = [index for index in range(self.position, top) if self.levels[index].fineness in self.marks]
        seen = [low for low in range(self.position) if marks and self._above(low) == marks[0]]
        coarse = [low for low in seen if STEP * self.levels[low].fineness <= self.levels[seen[-1]].fineness]
        if not coarse:
            return None
        places = coarse[-1], seen[-1], self.position
        first, last = (self._by_the_next(evaluator, place) for place in places[:2])
        finer = [math.log(self.levels[b].fineness / self.levels[a].fineness) for a, b in pairwise(places)]
        order = math.log(first / last) / finer[0] if first > last > 0 else 0.0
        least, most = self.orders
        return None if order < least else last * math.exp(-min(order, most) * finer[1])

    def _by_the_next(self, evaluator: Evaluator, position: int) -> float:
        """What is left from a rung, by the step to the next that is finer enough, and the order from there on."""
        level, upper = self.levels[position], self.levels[self._above(position)]
        step = evaluator.error(self.beside | level.changes, self.beside | upper.changes)
        top = upper is self.levels[-1]
        return step if top else step / (1 - (level.fineness / upper.fineness) ** self.orders[1])

    def _above(self, position: int) -> int:
        """The next rung by a `STEP`, or mark, or the top."""
        least = STEP * self.levels[position].fineness
        finer = (index for index, level in enumerate(self.levels) if level.fineness >= least)
        marked = (index for index in finer if not self.marks or self.levels[index].fineness in self.marks)
        return next(marked, len(self.levels) - 1)

    def climb(self, evaluator: Evaluator, most: float) -> None:
        """One rung up, and its error, of which there may be so much at most; first, what a finer one says of this one,
        which may then do. Rungs that cannot do, at the fastest that errors fall, are not looked at.
        """
        key = self._key(self.position)
        unseen = not self.marks and self._above(self.position) + 1 < len(self.levels) and key not in self.compared
        if self.successive and self.position > 0 and unseen:
            self.compared.add(key)
            self.errors[key] = self._by_the_next(evaluator, self.position)
            return
        before = self.position
        self.position += 1
        while not self.at_top and self._at_best(before) > most:
            self.position += 1
        self.price(evaluator, most)

    def _at_best(self, known: int) -> float:
        """The error of this rung, if from a known one it fell as fast as any."""
        if self.fastest is None:
            return 0.0
        return self.errors[self._key(known)] * (self.levels[known].fineness / self.level.fineness) ** self.fastest

    def why(self) -> str:
        """The number that decided."""
        if self.position == 0:
            return "" if len(self.levels) == 1 else "the least there is suffices"
        parts = (*self.roughly.values(), self.grey, self.errors)
        known = {(position, 0): error for position, error in self.at_least.items()}
        known |= {key: error for part in parts for key, error in part.items()}
        below = max((key for key in known if key[0] < self.position), default=None)
        if below is None:
            return "would save less time than it takes to find out"
        cost = known[below] if self.seams is None else max(known[below], self._error(below[0]))
        return f"{self.levels[below[0]].label} would cost {cost:.2g}"
