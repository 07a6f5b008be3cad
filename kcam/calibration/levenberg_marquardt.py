"""chi^2 of the targets of a picture, brought down by Levenberg and Marquardt from several starts: see `fit_psf`.

Its slope comes back through the optics by autograd, exactly; its curvature is that of Gauss and Newton, whose columns
are differences of PSFs, and whose inverse is the covariance of the values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import scipy
import torch
from torch import Tensor

from kcam.calibration.targets import Targets
from kcam.calibration.trained import TrainedLens, unit

WIDE = 25.0  # scales: the prior, far beyond what a linear fit can say; it holds what the picture does not
_DIFFERENCE = 1e-3  # of the scale: steps of the differences that make columns
_PLACE_STEP = 1e-4  # pixels, or radians: of central ones
_FARTHEST = 10.0  # scales of a step: what a picture does not tell leads to lenses of a hundred waves, slow to compute
_STARTS, _STEPS, _MENDED = 8, 40, 4
_SCAN = (1.0, 50.0)  # scales, on either side: what a scan looks at
_FEW = 3  # values, which are scanned closely: blurs of defocus agree within a tenth of it only
_QUIET = 3e-5  # of the peak: the least noise that is estimated; PSFs are no better
_SAME_FIT = 9.0  # of chi^2: three standard deviations, below which two fits are equally good


@dataclass(frozen=True)
class State:
    """Values (P,), places (S, 2) and what they leave."""

    values: Tensor
    places: Tensor
    cost: float


@dataclass(frozen=True)
class Seen:
    """PSFs at some values (P,), and how they change with each, over its scale: (Q, M, M), (P, Q, M, M)."""

    values: Tensor
    bank: Tensor
    changes: Tensor


@dataclass(frozen=True)
class Equations:
    """Of a step by Gauss and Newton: half the curvature of chi^2, and minus half its slope.

    across: of the values (P, P). between: with the targets' own (S, P, 4). within: of these (S, 4, 4). slope (P,),
    own_slope (S, 4).
    """

    across: Tensor
    between: Tensor
    within: Tensor
    slope: Tensor
    own_slope: Tensor

    def schur(self) -> Tensor:
        """What the targets leave to the values, (P, P): the inverse of their covariance."""
        inverse = torch.linalg.inv(self.within)
        return self.across - torch.einsum("spk,skl,sql->pq", self.between, inverse, self.between)

    def solved(self, damping: float) -> tuple[Tensor, Tensor]:
        """A damped step of the values (P,) and of the targets' own (S, 4), which are eliminated first."""
        across = self.across + damping * torch.diag(self.across.diagonal())
        within = self.within + damping * torch.diag_embed(self.within.diagonal(dim1=-2, dim2=-1))
        inverse = torch.linalg.inv(within)
        right = self.slope - torch.einsum("spk,skl,sl->p", self.between, inverse, self.own_slope)
        damped = replace(self, across=across, within=within)
        step = torch.linalg.solve(damped.schur(), right)
        return step, torch.einsum("skl,sl->sk", inverse, self.own_slope - torch.einsum("spk,p->sk", self.between, step))


class Search:
    """chi^2 as a function of the lens and of places, and its descent; the levels of targets are solved for.

    noise: the variance, first + second * value, where it is known. scales: (P,) of the values, 1 where nothing changes;
    free: which act. wide: (P,) widths of the prior, in scales. weight: (S, n) of the pixels.
    """

    def __init__(self, targets: Targets, trained: TrainedLens, noise: tuple[float, float] | None) -> None:
        self.targets, self.trained, self.noise = targets, trained, noise
        scales = trained.scales()
        self.free = torch.nonzero(scales.isfinite()).flatten()
        self.scales = torch.where(scales.isfinite(), scales, 1.0)
        self.wide = torch.full_like(scales, WIDE)
        self.weight = self._first_weight()

    # -- noise

    def _first_weight(self) -> Tensor:
        values, used = self.targets.values, self.targets.used
        if self.noise is not None:
            first, second = self.noise
            floor = max(first, 1e-2 * second * float(values.max()))  # of what is noise itself
            return used / (first + second * values).clamp(min=floor)
        spread = (values - values.mean(1, keepdim=True))[used].square().mean()
        return used / (1e-4 * spread).expand_as(values)

    @torch.no_grad()
    def weight_at(self, state: State) -> Tensor:
        """1 / variance at the model, of known noise or of what is left."""
        targets = self.targets
        model, _ = self._model(self.trained.bank(state.values), state.places)
        light = model.clamp(min=0)
        peak = float(light.max())
        if self.noise is None:
            first, second = _line(light[targets.used], (targets.values - model)[targets.used] ** 2)
            first = max(first, (_QUIET * peak) ** 2)
        else:
            first, second = self.noise
        return targets.used / (first + second * light).clamp(min=max(1e-14 * peak**2, 1e-4 * second * peak))

    # -- chi^2

    def _shapes(self, bank: Tensor, places: Tensor) -> Tensor:
        """(..., S, n)."""
        trained, how = self.trained, self.trained.conditions
        return self.targets.shapes(bank, trained.which, places, step=trained.step, width=how.width, upright=how.upright)

    def _levels(self, shape: Tensor) -> Tensor:
        """Brightness and background of each target (S, 2), by least squares."""
        columns = torch.stack([shape.detach(), torch.ones_like(shape)], dim=-1)
        normal = torch.einsum("snk,sn,snl->skl", columns, self.weight, columns)
        right = torch.einsum("snk,sn,sn->sk", columns, self.weight, self.targets.values)
        return torch.linalg.lstsq(normal, right[..., None]).solution[..., 0]

    def _model(self, bank: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
        """What the pixels should be (S, n), and the levels."""
        shape = self._shapes(bank, places)
        levels = self._levels(shape)
        return levels[:, 0, None] * shape + levels[:, 1, None], levels

    def _prior(self, values: Tensor) -> Tensor:
        return (values - self.trained.start) / (self.wide * self.scales)

    @torch.no_grad()
    def _cost(self, values: Tensor, places: Tensor) -> float:
        try:
            model, _ = self._model(self.trained.bank(values), places)
        except ValueError:  # no such lens
            return math.inf
        left = (self.targets.values - model).square() * self.weight
        return float(left.sum() + self._prior(values).square().sum())

    # -- descent

    @torch.no_grad()
    def _differences(self, values: Tensor, bank: Tensor) -> Tensor:
        """Change of PSFs with each value that acts, over its scale, (P, Q, M, M)."""
        units = self.scales[self.free, None] * torch.eye(len(self.scales), dtype=torch.float64)[self.free]
        moved = [self.trained.bank(values + _DIFFERENCE * unit) - bank for unit in units]
        return torch.stack(moved) / _DIFFERENCE

    def normal(self, state: State, before: Seen | None = None) -> tuple[Equations, Seen]:
        """The equations of a step, and what they were made of; `before`: of the last step, whose differences of PSFs
        are mended by what this step has changed (Broyden) instead of taken anew.
        """
        graph = self.trained.bank(state.values)
        model, levels = self._model(graph, state.places)
        left = self.targets.values - model
        slope = self.trained.slope((left.square() * self.weight).sum())
        bank, left = graph.detach(), left.detach()
        with torch.no_grad():
            if before is None:
                changes = self._differences(state.values, bank)
            else:
                step = ((state.values - before.values) / self.scales)[self.free]
                missed = bank - before.bank - torch.einsum("p,pqyx->qyx", step, before.changes)
                changes = before.changes + step[:, None, None, None] * missed / step.square().sum().clamp(min=1e-30)
            shape = self._shapes(bank, state.places)
            columns = self._shapes(changes, state.places) / self.scales[self.free, None, None]
            columns = columns * levels[:, 0, None]
            tangents = []
            for along in _PLACE_STEP * torch.eye(2, dtype=torch.float64):
                ahead, behind = (self._shapes(bank, state.places + by) for by in (along, -along))
                tangents.append((ahead - behind) / (2 * _PLACE_STEP))
        own = torch.stack([*(levels[:, 0, None] * t for t in tangents), shape, torch.ones_like(shape)], dim=-1)
        weighted = own * self.weight[..., None]
        within = torch.einsum("snk,snl->skl", weighted, own)
        between = torch.einsum("psn,snk->spk", columns, weighted)
        flat = (columns * self.weight.sqrt()).flatten(1)
        across = flat @ flat.T + torch.diag((self.wide * self.scales)[self.free] ** -2)
        prior = self._prior(state.values) / (self.wide * self.scales)
        own_slope = torch.einsum("snk,sn->sk", weighted, left)
        equations = Equations(across, between, within, (-slope / 2 - prior)[self.free], own_slope)
        return equations, Seen(state.values, bank, changes)

    def descend(self, state: State, *, until: float = 1e-4) -> State:
        """Down to where a step gains less of chi^2 than this."""
        state = replace(state, cost=self._cost(state.values, state.places))
        freedom, damping = int(self.targets.used.sum()), 1e-3
        seen, age = None, 0
        for _ in range(_STEPS):
            equations, seen = self.normal(state, seen)
            while damping < 1e8:
                step, own_step = equations.solved(damping)
                if bool((step / self.scales[self.free]).abs().max() > _FARTHEST):
                    damping *= 8
                    continue
                values = state.values.index_add(0, self.free, step)
                places = state.places + own_step[:, :2].clamp(-2, 2)
                cost = self._cost(values, places)
                if cost < state.cost:
                    break
                if age:  # with differences that are not its own
                    equations, seen = self.normal(state)
                    age = 0
                    continue
                damping *= 8
            else:
                return state
            gained, state = state.cost - cost, State(values, places, cost)
            damping = max(damping / 10, 1e-9)
            if gained < until * max(1.0, cost / freedom):
                return state
            age += 1
            if age == _MENDED:
                seen, age = None, 0
        return state

    def from_all_starts(self) -> tuple[State, list[State]]:
        """The best of several starts, and others that end about as low."""
        first, seeded = self._scanned(), torch.Generator().manual_seed(0)
        ends: list[State] = []
        for index in range(_STARTS):
            away = torch.randn(len(self.free), generator=seeded, dtype=torch.float64) * (0.3 if index == 0 else index)
            values = first.index_add(0, self.free, away * self.scales[self.free])
            ends.append(self.descend(State(values, self.targets.start, math.inf), until=0.1))
            lowest = min(end.cost for end in ends)
            if sum(end.cost < lowest + self.close(lowest) for end in ends) > 1:
                break
        ends.sort(key=lambda end: end.cost)
        return ends[0], [end for end in ends[1:] if end.cost < ends[0].cost + self.close(ends[0].cost)]

    def _scanned(self) -> Tensor:
        """Values that are better than those given, one after the other, by steps of many sizes."""
        values, places = self.trained.start, self.targets.start
        lowest = self._cost(values, places)
        count = 20 if len(self.free) <= _FEW else 4
        low, high = _SCAN
        sizes = [low * (high / low) ** (k / (count - 1)) for k in range(count)]
        for index in self.free.tolist():
            by = self.scales[index] * unit(index, len(values))
            tried = [(self._cost(values + size * by, places), size) for size in (*sizes, *(-size for size in sizes))]
            cost, size = min(tried)
            if cost < lowest:
                lowest, values = cost, values + size * by
        return values

    def close(self, cost: float) -> float:
        """Difference of chi^2 between fits that may be equally good, before the noise is known."""
        return _SAME_FIT * max(1.0, cost / int(self.targets.used.sum()))


def _line(light: Tensor, squares: Tensor) -> tuple[float, float]:
    """Variance at no light, >= 0, and its rise with light, >= 0, from the squares of what a fit leaves."""
    first, second = float(squares.mean()), 0.0
    columns = torch.stack([torch.ones_like(light), light], dim=1)
    least = 1e-14 * float(light.max()) ** 2
    for _ in range(10):
        weight = 1 / (first + second * light).clamp(min=max(least, 1e-3 * second * float(light.max())))
        solved, _ = scipy.optimize.nnls((columns * weight[:, None]).numpy(), (squares * weight).numpy())
        first, second = (float(part) for part in solved)
    return first, second
