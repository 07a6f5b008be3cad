"""Pieces of an exemplar, such as a painting, laid so that they fit what is asked for and each other.

    minimise over places s(p):  sum_p |f(s(p)) - g(p)|^2_w(p) + k sum_(p, q neighbours) |e(s(p)) - e(s(q) + p - q)|^2
                                                    + |e(s(p) + q - p) - e(s(q))|^2 + j [s(p) - p is not s(q) - q]

e is what the exemplar shows, f what is compared of it, g what is asked for. Neighbours whose places are neighbours too
cost nothing: the exemplar goes on as it is, and pieces grow; where two meet, the sum asks that each would show what the
other does, and j for meeting at all. The least is looked for from an eighth of the size on, pixel by pixel, among
places that neighbours, chance and small steps suggest. What only a few pixels would gain by changing together is found
at the coarser levels.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor
from torch.nn import functional as F

BESIDE = ((0, 1), (0, -1), (1, 0), (-1, 0))
FIRST = 2048  # places, of which each pixel of the coarsest level takes the one that fits best
COMPARED = 2**22  # numbers at once
JUMPS = (1, 2, 4, 1)  # pixels: how far away a neighbour's piece is offered
SMALL = 8000  # pixels of a level that chance can help
CHANCES, FEW = 24, 4  # places by chance in a round, of a small level and of others
AT_ONCE = 2**15  # pixels
SOFT = 0.5  # pixels: Gaussian by which pieces are averaged where they meet


def picked(table: Tensor, index: Tensor) -> Tensor:
    """table[index], four times as fast."""
    return table.index_select(0, index.flatten()).view(*index.shape, *table.shape[1:])


@dataclass(frozen=True)
class Book:
    """The places of an exemplar in all its turns, at one size: a place is an index into the tables.

    shown: (E,3), what is seen there. compared: (E,F), what it is chosen by. allowed: (E,) whether there is a pixel all
    around it. height, width: of each turn, one after the other in the tables.
    """

    shown: Tensor
    compared: Tensor
    allowed: Tensor
    height: int
    width: int

    @property
    def places(self) -> Tensor:
        """Those that are allowed."""
        return self.allowed.nonzero()[:, 0]

    def at(self, places: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Turn, row and column."""
        turn, rest = places // (self.height * self.width), places % (self.height * self.width)
        return turn, rest // self.width, rest % self.width

    def place(self, turn: Tensor, row: Tensor, column: Tensor, otherwise: Tensor) -> Tensor:
        """Its index, or another one where there is no such place."""
        inside = (row >= 0) & (row < self.height) & (column >= 0) & (column < self.width)
        row, column = row.clamp(0, self.height - 1), column.clamp(0, self.width - 1)
        found = (turn * self.height + row) * self.width + column
        return torch.where(inside & picked(self.allowed, found), found, otherwise)

    def shows(self, places: Tensor) -> Tensor:
        """What is seen one step beside a place, (...,3): there is something all around the allowed ones."""
        return picked(self.shown, places.clamp(0, len(self.shown) - 1))


def turned(planes: Tensor, angle: float, *, mode: str = "bilinear") -> tuple[Tensor, Tensor]:
    """Planes (C,H,W) turned about their middle, by an angle from +x to +y, and where they still are, (H,W)."""
    height, width = planes.shape[-2:]
    y, x = (torch.arange(size, dtype=planes.dtype, device=planes.device) - (size - 1) / 2 for size in (height, width))
    cos, sin = math.cos(angle), math.sin(angle)
    across, down = cos * x + sin * y[:, None], cos * y[:, None] - sin * x
    grid = torch.stack([across * 2 / max(width - 1, 1), down * 2 / max(height - 1, 1)], dim=-1)
    found = F.grid_sample(planes[None], grid[None], mode=mode, padding_mode="border", align_corners=True)[0]
    inside = (across.abs() <= (width - 1) / 2 + 1e-3) & (down.abs() <= (height - 1) / 2 + 1e-3)
    return found, inside


class _Laid:
    """Pieces on one picture at one level, while they are being laid."""

    def __init__(
        self, book: Book, asked: Tensor, weights: Tensor, shape: tuple[int, int], seam: float, joint: float
    ) -> None:
        self.book, self.asked, self.weights, self.seam, self.joint = book, asked, weights, seam, joint
        self.height, self.width = shape
        self.sites = torch.arange(self.height * self.width, device=asked.device)
        row, column = self.sites // self.width, self.sites % self.width
        self.halves = [self.sites[(row + column) % 2 == part] for part in (0, 1)]
        self.steps = torch.tensor([dy * book.width + dx for dy, dx in BESIDE], device=asked.device)
        self.allowed = book.places
        widest = max(2, max(book.height, book.width) // 4)
        radii = [widest / 4**k for k in range(math.ceil(math.log(widest, 4)) + 1)]
        self.radii = torch.tensor([max(radius, 1.0) for radius in radii], device=asked.device)

    def lay(self, places: Tensor, *, kept: Tensor | None = None, keep: float = 0.0) -> None:
        """Begin with these; leaving those that are kept, where these are not -1, has a price."""
        self.kept, self.keep = kept, keep
        self.places, self.shown = places.clone(), self.book.shown[places]
        self.misfit = (self.weights * (self.book.compared[places] - self.asked).square()).sum(1)

    def best_of(self, places: Tensor) -> Tensor:
        """For each pixel the place that fits best, whatever is beside it."""
        own = self.book.compared[places]
        found = []
        for some in self.sites.split(max(1, COMPARED // len(places))):
            asked, weights = self.asked[some], self.weights[some]
            misfit = weights @ own.square().T - 2 * (weights * asked) @ own.T
            found.append(places[misfit.argmin(1)])
        return torch.cat(found)

    def _beside(self, sites: Tensor, jump: int = 1) -> tuple[Tensor, Tensor]:
        """The pixels so far away on four sides, (N,4), and whether they are in the picture."""
        y, x = (jump * torch.tensor(side, device=sites.device) for side in zip(*BESIDE, strict=True))
        y, x = (sites // self.width)[:, None] + y, (sites % self.width)[:, None] + x
        inside = (y >= 0) & (y < self.height) & (x >= 0) & (x < self.width)
        return y.clamp(0, self.height - 1) * self.width + x.clamp(0, self.width - 1), inside

    def offer(self, sites: Tensor, places: Tensor) -> None:
        """Take the best of some places (N,K) at each of these pixels (N,), no two of them neighbours, if it helps.

        Seams cost nothing or something: where a place fits worse by more than its pixel's seams cost now, its own need
        not be known.
        """
        book = self.book
        own = picked(self.places, sites)
        other = places != own[:, None]
        some = other.any(1).nonzero()[:, 0]
        if not len(some):
            return
        sites, places, other, own = (picked(given, some) for given in (sites, places, other, own))
        beside, inside = self._beside(sites)
        goes_on = picked(self.places, beside) - self.steps
        around = (goes_on, book.shows(goes_on), picked(self.shown, beside), inside)

        def seams(places: Tensor, goes_on: Tensor, theirs: Tensor, there: Tensor, inside: Tensor) -> Tensor:
            """What they cost beside what is around each, (N,)."""
            cost = (picked(book.shown, places)[:, None] - theirs).square().sum(2)
            cost += (book.shows(places[:, None] + self.steps) - there).square().sum(2)
            cost += self.joint * (places[:, None] != goes_on)
            return self.seam * (cost * inside).sum(1)

        now = seams(own, *around)
        pairs = other.flatten().nonzero()[:, 0]
        at, found = pairs // places.shape[1], picked(places.flatten(), pairs)
        here = picked(sites, at)
        apart = picked(book.compared, found) - picked(self.asked, here)
        misfit = (picked(self.weights, here) * apart.square()).sum(1)
        if self.kept is not None:
            kept = picked(self.kept, here)
            misfit = misfit + self.keep * ((found != kept) & (kept >= 0))
        worse = misfit - picked(self.misfit, here) - picked(now, at)
        able = (worse < 0).nonzero()[:, 0]
        pairs, at, found, misfit, worse = (picked(given, able) for given in (pairs, at, found, misfit, worse))
        gains, misfits = misfit.new_zeros(2, *places.shape)
        gains.view(-1)[pairs] = worse + seams(found, *(picked(given, at) for given in around))
        misfits.view(-1)[pairs] = misfit
        gain, best = gains.min(1)
        taken = (gain < 0).nonzero()[:, 0]
        sites, best = picked(sites, taken), picked(best, taken)[:, None]
        self.places[sites] = places = picked(places, taken).gather(1, best)[:, 0]
        self.misfit[sites] = picked(misfits, taken).gather(1, best)[:, 0]
        self.shown[sites] = picked(book.shown, places)

    def _at_seams(self, sites: Tensor) -> Tensor:
        """Whether two pieces meet at these pixels: inside of one, another place would have seams all around."""
        beside, inside = self._beside(sites)
        return (inside & (picked(self.places, beside) - self.steps != picked(self.places, sites)[:, None])).any(1)

    def round(self, generator: torch.Generator) -> None:
        """Offer to each pixel the pieces of its neighbours, places near its own, and some by chance."""
        book, allowed = self.book, self.allowed

        def draw(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, device=generator.device).to(self.asked)

        def neighbours(jump: int, sites: Tensor) -> Tensor:
            beside, _ = self._beside(sites, jump)
            down = beside // self.width - sites[:, None] // self.width
            right = beside % self.width - sites[:, None] % self.width
            turn, row, column = book.at(picked(self.places, beside))
            return book.place(turn, row - down, column - right, picked(self.places, sites)[:, None])

        def near(sites: Tensor) -> Tensor:
            own = picked(self.places, sites)[:, None]
            turn, row, column = book.at(own)
            down, right = ((draw(len(sites), len(self.radii)) * 2 - 1) * self.radii for _ in range(2))
            return book.place(turn, row + down.round().long(), column + right.round().long(), own)

        def anywhere(sites: Tensor) -> Tensor:
            count = CHANCES if len(self.sites) < SMALL else FEW
            return picked(allowed, (draw(len(sites), count) * len(allowed)).long().clamp(max=len(allowed) - 1))

        ways: list[Callable[[Tensor], Tensor]] = [partial(neighbours, jump) for jump in JUMPS]
        for offers in (*ways, near, anywhere):
            for half in self.halves:
                for sites in half.split(AT_ONCE):
                    if len(self.sites) >= SMALL and offers in (near, anywhere):
                        sites = sites[self._at_seams(sites)]
                    self.offer(sites, offers(sites))


@torch.no_grad()
def lay_pieces(
    books: Sequence[Book],
    asked: Sequence[Tensor],
    weights: Sequence[Tensor],
    *,
    seam: float,
    joint: float = 0.0,
    rounds: Sequence[int],
    kept: Tensor | None = None,
    keep: float = 0.0,
    generator: torch.Generator,
) -> Tensor:
    """Choose a place of an exemplar for each pixel of a picture, from the coarsest level to the finest.

    Args:      books: of each level, each twice as large as the one before.  asked, weights: (F,h,w) of each level.
               seam, joint: k and j.  rounds: of each level.  generator: of what chance offers.
               kept: (H,W) places to begin with at the finest level, or -1; leaving one costs `keep`.
    Returns:   (H,W) indices into the last book.
    Source:    Pritch, Kav-Venaki and Peleg, Shift-map image editing, ICCV 2009, the sum; Barnes et al., PatchMatch,
               SIGGRAPH 2009, the offers; Besag, On the statistical analysis of dirty pictures (1986), the descent.
    """
    laid: _Laid | None = None
    for book, wanted, weight, count in zip(books, asked, weights, rounds, strict=True):
        flat, heavy = (plane.flatten(1).T.contiguous() for plane in (wanted, weight))
        coarser, laid = laid, _Laid(book, flat, heavy, (wanted.shape[1], wanted.shape[2]), seam, joint)
        if coarser is None:
            some = (torch.rand(FIRST, generator=generator, device=generator.device) * len(laid.allowed)).long()
            laid.lay(laid.best_of(laid.allowed[some.clamp(max=len(laid.allowed) - 1).to(flat.device)]))
        elif book is books[-1] and kept is not None:
            known = kept.flatten()
            laid.lay(torch.where(known >= 0, known, _finer(coarser, laid)), kept=known, keep=keep)
        else:
            laid.lay(_finer(coarser, laid))
        for _ in range(count):
            laid.round(generator)
    if laid is None:
        raise ValueError("no levels: expected a book of the exemplar for at least one.")
    return laid.places.view(laid.height, laid.width)


def _finer(coarse: _Laid, fine: _Laid) -> Tensor:
    """Each piece at twice the size."""
    row, column = fine.sites // fine.width, fine.sites % fine.width
    above = (row // 2).clamp(max=coarse.height - 1) * coarse.width + (column // 2).clamp(max=coarse.width - 1)
    turn, down, right = coarse.book.at(coarse.places[above])
    any_other = fine.allowed[coarse.places[above] % len(fine.allowed)]  # a border is wider there: it happens
    return fine.book.place(turn, 2 * down + row % 2, 2 * right + column % 2, any_other)


def shown_by(book: Book, table: Tensor, places: Tensor) -> Tensor:
    """What pieces show: (E,C) at places (H,W), (C,H,W); where they meet, what those around would show, averaged."""
    height, width = places.shape
    rows, columns = torch.arange(height, device=places.device), torch.arange(width, device=places.device)
    total: Tensor | float = 0.0
    weight = 0.0
    for dy, dx in itertools.product((-1, 0, 1), repeat=2):
        share = math.exp(-(dy * dy + dx * dx) / (2 * SOFT**2))
        down, right = (rows + dy).clamp(0, height - 1) - rows, (columns + dx).clamp(0, width - 1) - columns
        there = places[rows + down][:, columns + right] - down[:, None] * book.width - right
        total = total + share * picked(table, there.flatten().clamp(0, len(table) - 1))
        weight += share
    return (total / weight).T.unflatten(1, (height, width))  # type: ignore[union-attr]
