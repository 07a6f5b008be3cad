"""A lens from a picture of points or of a slanted edge: what trains in it, found by descent through the camera.

    minimise over lens, places, levels:   chi^2 = sum_i (v_i - m_i)^2 / s_i^2,   s^2 = sigma_d^2 + K m

m is what the lens's own PSF makes of points at unknown sub-pixel places, or of an edge at an unknown angle, with a
brightness and a background each. The slope of chi^2 comes back through the optics by autograd, exactly; its curvature
is that of Gauss and Newton, whose columns are differences of PSFs, and whose inverse is the covariance of the values.
What a picture cannot tell has no standard error, and a fit from the other side finds what it can tell but for a sign.
"""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor, nn

from kcam.calibration.targets import Targets, find_targets
from kcam.calibration.trained import Conditions, TrainedLens, put_values, unit
from kcam.inputs import describe
from kcam.units import as_numbers, check_length, check_pixel_pitch, wavelength_grid

_DIFFERENCE = 1e-3  # of the scale: steps of the differences that make columns
_PLACE_STEP = 1e-4  # pixels, or radians: of central ones
_WIDE = 25.0  # scales: the prior, far beyond what a linear fit can say; it holds what the picture does not
_UNSEEN = 5.0  # scales: a value known no better than this is not seen
_INFLATED = 3e3  # times the variance that it would have if all else were known: it is another value's twin
_CLOSE = 1.0  # scales: the prior of what is not seen, once that is known
_FARTHEST = 10.0  # scales of a step: what a picture does not tell leads to lenses of a hundred waves, slow to compute
_STARTS, _STEPS, _MENDED = 8, 40, 4
_SCAN = (1.0, 50.0)  # scales, on either side: what a scan looks at
_FEW = 3  # values, which are scanned closely: blurs of defocus agree within a tenth of it only
_QUIET = 3e-5  # of the peak: the least noise that is estimated; PSFs are no better
_ELSEWHERE = 0.3  # scales: an end of a start that is another one
_APART = 3.0  # standard errors between two fits: a value that is ambiguous
_SAME_FIT = 9.0  # of chi^2: three standard deviations, below which two fits are equally good
_MISFIT = 3.0  # of chi^2 per degree of freedom: a model or a noise that is wrong
_LEVEL, _NEARLY = 1e-6, 1e-3  # relative: values at one converter's end; noise is more
_PLATEAU = 3  # pixels that touch: two photon counts may be the same
_NAMES = {
    1: "piston", 2: "tilt x", 3: "tilt y", 4: "defocus", 5: "astigmatism 45", 6: "astigmatism 0", 7: "coma y",
    8: "coma x", 9: "trefoil y", 10: "trefoil x", 11: "spherical",
}  # fmt: skip


@dataclass(frozen=True)
class PSFFit:
    """A lens as a picture shows it: `fit_psf`.

    lens: a copy with the values found. values, standard_errors: of each number that trained, by name: Zernike terms by
        Noll's index, "Z4", in metres RMS; others as `named_parameters` calls them. covariance: (P, P) in that order.
    ambiguous: names whose sign, or branch, the picture leaves open: `alternative` fits it as well.
    unobservable: name -> why the picture does not tell it. Its error is inf, its value that of the fit nearest to the
        lens that was given, so that `lens` still makes the picture.
    chi_squared: per degree of freedom; 1 where model and noise are right (and, of an estimated noise, always near).
        Where it is above 1 by more than chance, standard errors are widened by its root, and the covariance by itself;
        a wrong model may move values by more than that.
    places: (S, 3) of each target: picture, x, y [pixels]; of an edge picture, angle of the normal [rad], distance from
        the picture's middle [pixels].

    Example:
    >>> given = optics.ZernikeAberration(torch.nn.Parameter(torch.zeros(8)))
    >>> lens = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), given, focus_distance=2.0)
    >>> picture = lens.psf([550 * nm], distances=2.0, pixel_pitch=4 * um, shape=(33, 33)).detach()
    >>> fit = kcam.calibration.fit_psf(picture, lens=lens, pixel_pitch=4 * um)
    >>> sorted(fit.unobservable)[:3]  # piston, and tilts, which move a point as its place does
    ['Z1', 'Z2', 'Z3']
    """

    lens: nn.Module
    values: dict[str, float]
    standard_errors: dict[str, float]
    covariance: Tensor
    ambiguous: tuple[str, ...]
    alternative: dict[str, float] | None
    unobservable: dict[str, str]
    chi_squared: float
    places: Tensor

    def __str__(self) -> str:
        lines = [f"chi^2 per degree of freedom {self.chi_squared:.3g}, {len(self.places)} targets"]
        for name, value in self.values.items():
            error = self.standard_errors[name]
            words = [f"{name:>12} {value: .4e} +- {error:.1e}"]
            if name.startswith("Z") and int(name[1:]) in _NAMES:
                words.append(f"({_NAMES[int(name[1:])]})")
            if name in self.ambiguous and self.alternative is not None:
                words.append(f"or {self.alternative[name]:.4e}: the sign is ambiguous")
            words += [f"not seen: {self.unobservable[name]}"] if name in self.unobservable else []
            lines.append(" ".join(words))
        return "\n".join(lines)


def fit_psf(
    picture: Tensor,
    *,
    lens: nn.Module,
    pixel_pitch: float,
    distances: Tensor | Sequence[float] | float | None = None,
    wavelengths: Tensor | Sequence[float] | None = None,
    weights: Tensor | Sequence[float] | None = None,
    defocus: Tensor | Sequence[float] | float = 0.0,
    target: str = "auto",
    points: Tensor | Sequence[Sequence[float]] | None = None,
    full_well: float | None = None,
    read_noise: float = 0.0,
    fill_factor: float = 1.0,
    upright: bool = True,
) -> PSFFit:
    """Find what trains in a lens from a picture of points or of a slanted edge.

    Levenberg-Marquardt on chi^2, weighted by the noise, with its gradient by autograd through the lens, from several
    starts; then from the twin that mirrors the wavefront, to learn whether a sign is open. All targets of a picture
    share the lens; each has its own place, brightness and background. Windows are cut around targets, so light far
    from them does not count.

    **What a picture tells.** The even terms (defocus, astigmatism, spherical) have one joint sign that a single picture
    leaves open: W(r) and -W(-r) have the same PSF. Two focuses, or a known defocus while none is fitted, settle it. An
    edge shows the transfer function along its normal only: terms that do not act there are unobservable, and those that
    mirror it keep their sign. Tilts move the picture like its unknown place, a piston does nothing.

    Args:
        picture: linear raw with black subtracted, (H,W), (1,H,W) or (N,1,H,W); N pictures of the same lens at N
            focuses. Of a mosaic, one channel's pixels.
        lens: `optics.Lens`, `optics.CompoundLens` or another with `psf`; its Parameters train and give the first
            guess. It is not changed.
        pixel_pitch: [m].  distances: of the targets [m], a number or (N,); None for the focus distance of the lens.
        wavelengths, weights: (L,) [m], and the share of each in the picture; None for the focus wavelength, and for
            equal shares.
        defocus: how far the sensor stood behind where the lens has it, a number or (N,) [m]: known steps of focus.
        target: "points", "edge", or "auto" to tell by the picture.
        points: (K, 2) x and y about where points are [pixels]; None to find them.
        full_well: electrons that the value 1.0 stands for (1.0 for a picture in electrons): then the noise is known,
            with read_noise [electrons], and chi^2 tells whether the model is right: above 3 per degree of freedom, as
            of a wrong pixel_pitch, a UserWarning says so. None: shot and read noise are estimated from what the fit
            leaves, no less than 3e-5 of the peak, which is what PSFs are good to.
        fill_factor: light-sensitive share of a pixel.
        upright: the picture is as a camera shows it, turned by 180 degrees against the light on the sensor; False for
            light as it falls, as `Lens.psf` gives it.
    Returns:   a `PSFFit`.
    Raises:    TypeError, ValueError for a picture that is no float tensor of these shapes, has NaN, is saturated (of
               pixels at 1.0 in a picture in [0,1], or of three or more that touch at its highest value), shows no
               target, or too small; an edge slanted by less than 1.5 degrees; a lens in which nothing trains, or more
               than 64 numbers; lengths that are not in metres.
    Valid for isoplanatic pictures of a `Lens`; a `CompoundLens` has the PSF of each point's place, if the middle of the
        picture is its axis. Standard errors are linear: of half a wave and more, trust several pictures rather.
    Source:    Gonsalves, Phase retrieval and diversity in adaptive optics, Opt. Eng. 21 (1982) 829 (two focuses, the
               sign); Press et al., Numerical Recipes, 3rd ed., 15.5 (Levenberg-Marquardt and its covariance).

    Example:
    >>> def lens(coma):  # Z8, nm RMS
    ...     given = optics.ZernikeAberration(torch.nn.Parameter(torch.tensor([0.0] * 7 + [coma * nm])))
    ...     return optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), given, focus_distance=2.0)
    >>> seen = lens(40.0).psf([550 * nm], distances=2.0, pixel_pitch=3 * um, shape=(41, 41)).detach()
    >>> round(kcam.calibration.fit_psf(seen, lens=lens(0.0), pixel_pitch=3 * um, upright=False).values["Z8"] / nm)
    40
    """
    pictures = _checked(picture)
    pitch = check_pixel_pitch(pixel_pitch)
    bands = wavelength_grid([getattr(lens, "focus_wavelength", 550e-9)] if wavelengths is None else wavelengths)  # type: ignore[arg-type]
    shares = _shares(weights, len(bands))
    if target not in ("auto", "points", "edge"):
        raise ValueError(f"target {target!r} is unknown; expected points, edge or auto.")
    if (full_well is not None and not full_well > 0) or not read_noise >= 0:
        raise ValueError(f"full_well must be > 0 and read_noise >= 0 electrons, got {full_well} and {read_noise}.")
    if not 0 < fill_factor <= 1:
        raise ValueError(f"fill_factor {fill_factor:g} must be in (0, 1]: the light-sensitive share of a pixel.")
    if points is not None:
        points = as_numbers(points, name="points", expected="x and y of each point in pixels, (K, 2)").detach().cpu()
        if points.ndim != 2 or points.shape[1] != 2 or not len(points) or not bool(points.isfinite().all()):
            raise ValueError(f"points must be finite x and y in pixels, (K, 2), got shape {tuple(points.shape)}.")
    far = getattr(lens, "focus_distance", math.inf) if distances is None else distances
    away = _each(far, len(pictures), name="distances")
    steps = _each(defocus, len(pictures), name="defocus")
    for step in steps.tolist():
        check_length(abs(step), name="defocus", within=(0.0, 0.05), example="50 * um")
    found = find_targets(pictures, kind=target, points=points)
    _check_saturation(found, pictures)
    shape = (pictures.shape[2], pictures.shape[3])
    width = math.sqrt(fill_factor)
    conditions = Conditions(shape, pitch, width, bands, shares, away.tolist(), steps.tolist(), upright)
    problem = _Problem(found, TrainedLens.of(lens, found, conditions))
    noise = None if full_well is None else (read_noise**2 / full_well**2, 1 / full_well)
    with torch.enable_grad(), warnings.catch_warnings():
        problem.trained.bank(problem.trained.start)  # may warn of the lens that was given; not of what the search tries
        warnings.filterwarnings("ignore", message=r"f/\S+ is outside", category=UserWarning)
        fit = _Fit(problem, noise).result(lens)
    if fit.chi_squared > _MISFIT:
        warnings.warn(
            f"chi^2 per degree of freedom is {fit.chi_squared:.3g}, expected 1: no such lens makes this picture with "
            f"this noise. Standard errors are {math.sqrt(fit.chi_squared):.2g} times as wide as the noise has them; "
            "values may be off by more. Check pixel_pitch, the f-number, wavelengths, full_well, read_noise, and that "
            "no pixel is saturated.",
            stacklevel=2,
        )
    return fit


# ---- what goes in ----------------------------------------------------------------------------------------------------


def _checked(picture: Tensor) -> Tensor:
    """(N,1,H,W) float64 on the CPU."""
    if not isinstance(picture, Tensor) or not picture.is_floating_point():
        raise TypeError(f"picture must be a floating-point tensor (N,1,H,W) of linear raw, got {describe(picture)}.")
    shaped = picture.detach().double().cpu()
    shaped = shaped[None, None] if shaped.ndim == 2 else shaped[None] if shaped.ndim == 3 else shaped
    if shaped.ndim != 4 or shaped.shape[1] != 1 or shaped.numel() == 0:
        raise ValueError(
            f"picture has shape {tuple(picture.shape)}, expected (N,1,H,W): one channel, such as green, "
            "picture[:, 1:2], and N pictures of one size."
        )
    if not bool(shaped.isfinite().all()):
        count = int((~shaped.isfinite()).sum())
        raise ValueError(f"picture has {count} values that are NaN or infinite. Cut the targets out without them.")
    return shaped


def _shares(weights: Tensor | Sequence[float] | None, count: int) -> Tensor:
    if weights is None:
        return torch.full((count,), 1 / count, dtype=torch.float64)
    values = as_numbers(weights, name="weights", expected="one number per wavelength").detach().cpu()
    if values.shape != (count,) or not bool((values >= 0).all()) or not float(values.sum()) > 0:
        raise ValueError(f"weights must be {count} numbers >= 0, one per wavelength, not all 0, got {values.tolist()}.")
    return values / values.sum()


def _each(value: Any, count: int, *, name: str) -> Tensor:
    """One number for each picture."""
    values = as_numbers(value, name=name, expected="a number of metres, or one per picture").detach().cpu()
    if values.numel() not in (1, count) or values.ndim > 1:
        raise ValueError(f"{name} has {values.numel()} values, expected one, or one for each of {count} pictures.")
    return values.reshape(-1).expand(count).clone()


def _check_saturation(found: Targets, pictures: Tensor) -> None:
    """ValueError where a target has pixels at 1.0, or a plateau at the highest value, as of black taken off after it.

    Light has no plateau but in pictures without noise: there the pixels around it are alike too, or as bright within
    a step or two of the converter.
    """
    for index, values in enumerate(found.values):
        used = found.used[index]
        picture = pictures[int(found.picture[index]), 0].numpy()
        top = float(picture.max())
        x, y = (found.origin[index] + torch.stack([found.x[index], found.y[index]], -1)[used]).round().long().T.numpy()
        labels, _ = scipy.ndimage.label(picture >= top * (1 - _LEVEL), np.ones((3, 3)))
        most = 0
        for label in set(labels[y, x].tolist()) - {0} if top > 0 else ():
            plateau = labels == label
            around = picture[scipy.ndimage.binary_dilation(plateau, np.ones((3, 3))) & ~plateau]
            levels = np.unique((around / (top * _LEVEL)).round()) * top * _LEVEL
            unlike = len(levels) > 4  # more than of a PSF in the middle of four pixels
            if (
                plateau.sum() >= _PLATEAU
                and unlike
                and top - around.mean() > max(_NEARLY * top, 2 * np.diff(levels).min())
            ):
                most = max(most, int(plateau.sum()))
        full = int(((values >= 1.0) & used).sum())
        if most or (float(values.max()) == 1.0 and full > 1):
            x, y = found.origin[index].tolist()
            raise ValueError(
                f"{most or full} pixels of the target near x = {x:.0f}, y = {y:.0f} are at {top:.4g}: saturated, so "
                "that the shape of its peak is lost. Expose at most 0.8 of the full well."
            )


# ---- the fit ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _State:
    """Values (P,), places (S, 2) and what they leave."""

    values: Tensor
    places: Tensor
    cost: float


@dataclass(frozen=True)
class _Seen:
    """PSFs at some values (P,), and how they change with each, over its scale: (Q, M, M), (P, Q, M, M)."""

    values: Tensor
    bank: Tensor
    changes: Tensor


@dataclass(frozen=True)
class _Equations:
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


@dataclass(frozen=True)
class _Problem:
    """chi^2 of the targets as a function of the lens and of places; levels are solved for."""

    targets: Targets
    trained: TrainedLens

    def shapes(self, bank: Tensor, places: Tensor) -> Tensor:
        """(..., S, n)."""
        trained, how = self.trained, self.trained.conditions
        return self.targets.shapes(bank, trained.which, places, step=trained.step, width=how.width, upright=how.upright)

    def levels(self, shape: Tensor, weight: Tensor) -> Tensor:
        """Brightness and background of each target (S, 2), by least squares."""
        columns = torch.stack([shape.detach(), torch.ones_like(shape)], dim=-1)
        normal = torch.einsum("snk,sn,snl->skl", columns, weight, columns)
        right = torch.einsum("snk,sn,sn->sk", columns, weight, self.targets.values)
        return torch.linalg.lstsq(normal, right[..., None]).solution[..., 0]

    def model(self, bank: Tensor, places: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """What the pixels should be (S, n), and the levels."""
        shape = self.shapes(bank, places)
        levels = self.levels(shape, weight)
        return levels[:, 0, None] * shape + levels[:, 1, None], levels


class _Fit:
    """The search. `noise`: the variance, first + second * value, where it is known.

    scales: (P,) of the values, 1 where nothing changes; free: which act. wide: (P,) widths of the prior, in scales.
    weight: (S, n) of the pixels.
    """

    def __init__(self, problem: _Problem, noise: tuple[float, float] | None) -> None:
        self.problem, self.noise = problem, noise
        scales = problem.trained.scales()
        self.free = torch.nonzero(scales.isfinite()).flatten()
        self.scales = torch.where(scales.isfinite(), scales, 1.0)
        self.wide = torch.full_like(scales, _WIDE)
        self.weight = self._first_weight()

    def result(self, lens: nn.Module) -> PSFFit:
        """All of it."""
        trained, targets = self.problem.trained, self.problem.targets
        best, others = self._search()
        for _ in range(2 if self.noise else 3):
            self.weight = self._weight_at(best)
            best = self._descend(best)
        elsewhere = [end for end in others if float(((end.values - best.values) / self.scales).norm()) > _ELSEWHERE]
        rivals = [self._descend(start) for start in (*self._twins(best), *elsewhere)]
        better = min(rivals, key=lambda state: state.cost, default=best)
        if better.cost < best.cost - 1e-3:
            rivals.append(best)
            best = better
        equations, _ = self._normal(best)
        covariance, inflation = self._covariance(equations)
        unseen = self._unseen(covariance.diagonal().sqrt(), inflation)
        names = trained.names
        freedom = max(1, int(targets.used.sum()) - (len(names) - len(unseen)) - 4 * len(targets.values))
        excess = best.cost / freedom
        covariance = covariance * (excess if excess > 1 + 3 * math.sqrt(2 / freedom) else 1.0)
        errors = covariance.diagonal().sqrt()
        rival, ambiguous = self._rival(
            best, rivals, {n: e for n, e in zip(names, errors, strict=True) if n not in unseen}
        )
        if unseen:  # of all fits that are as good, the one nearest to the lens that was given
            self.wide = torch.tensor([_CLOSE if name in unseen else _WIDE for name in names], dtype=torch.float64)
            best = self._descend(best)
        fitted = copy.deepcopy(lens)
        put_values(fitted, best.values)
        places = best.places if targets.kind == "edge" else best.places + targets.origin
        return PSFFit(
            fitted,
            dict(zip(names, best.values.tolist(), strict=True)),
            {n: math.inf if n in unseen else e for n, e in zip(names, errors.tolist(), strict=True)},
            covariance,
            ambiguous,
            dict(zip(names, rival.values.tolist(), strict=True)) if ambiguous else None,
            unseen,
            best.cost / freedom,
            torch.cat([targets.picture[:, None].double(), places], dim=1),
        )

    # -- noise

    def _first_weight(self) -> Tensor:
        values, used = self.problem.targets.values, self.problem.targets.used
        if self.noise is not None:
            first, second = self.noise
            floor = max(first, 1e-2 * second * float(values.max()))  # of what is noise itself
            return used / (first + second * values).clamp(min=floor)
        spread = (values - values.mean(1, keepdim=True))[used].square().mean()
        return used / (1e-4 * spread).expand_as(values)

    @torch.no_grad()
    def _weight_at(self, state: _State) -> Tensor:
        """1 / variance at the model, of known noise or of what is left."""
        targets = self.problem.targets
        model, _ = self.problem.model(self.problem.trained.bank(state.values), state.places, self.weight)
        light = model.clamp(min=0)
        peak = float(light.max())
        if self.noise is None:
            first, second = _line(light[targets.used], (targets.values - model)[targets.used] ** 2)
            first = max(first, (_QUIET * peak) ** 2)
        else:
            first, second = self.noise
        return targets.used / (first + second * light).clamp(min=max(1e-14 * peak**2, 1e-4 * second * peak))

    # -- descent

    def _prior(self, values: Tensor) -> Tensor:
        return (values - self.problem.trained.start) / (self.wide * self.scales)

    @torch.no_grad()
    def _cost(self, values: Tensor, places: Tensor) -> float:
        try:
            model, _ = self.problem.model(self.problem.trained.bank(values), places, self.weight)
        except ValueError:  # no such lens
            return math.inf
        left = (self.problem.targets.values - model).square() * self.weight
        return float(left.sum() + self._prior(values).square().sum())

    @torch.no_grad()
    def _differences(self, values: Tensor, bank: Tensor) -> Tensor:
        """Change of PSFs with each value that acts, over its scale, (P, Q, M, M)."""
        units = self.scales[self.free, None] * torch.eye(len(self.scales), dtype=torch.float64)[self.free]
        moved = [self.problem.trained.bank(values + _DIFFERENCE * unit) - bank for unit in units]
        return torch.stack(moved) / _DIFFERENCE

    def _normal(self, state: _State, before: _Seen | None = None) -> tuple[_Equations, _Seen]:
        """The equations of a step, and what they were made of; `before`: of the last step, whose differences of PSFs
        are mended by what this step has changed (Broyden) instead of taken anew.
        """
        problem, trained = self.problem, self.problem.trained
        graph = trained.bank(state.values)
        model, levels = problem.model(graph, state.places, self.weight)
        left = problem.targets.values - model
        slope = trained.slope((left.square() * self.weight).sum())
        bank, left = graph.detach(), left.detach()
        with torch.no_grad():
            if before is None:
                changes = self._differences(state.values, bank)
            else:
                step = ((state.values - before.values) / self.scales)[self.free]
                missed = bank - before.bank - torch.einsum("p,pqyx->qyx", step, before.changes)
                changes = before.changes + step[:, None, None, None] * missed / step.square().sum().clamp(min=1e-30)
            shape = problem.shapes(bank, state.places)
            columns = problem.shapes(changes, state.places) / self.scales[self.free, None, None]
            columns = columns * levels[:, 0, None]
            tangents = []
            for along in _PLACE_STEP * torch.eye(2, dtype=torch.float64):
                ahead, behind = (problem.shapes(bank, state.places + by) for by in (along, -along))
                tangents.append((ahead - behind) / (2 * _PLACE_STEP))
        own = torch.stack([*(levels[:, 0, None] * t for t in tangents), shape, torch.ones_like(shape)], dim=-1)
        weighted = own * self.weight[..., None]
        within = torch.einsum("snk,snl->skl", weighted, own)
        between = torch.einsum("psn,snk->spk", columns, weighted)
        flat = (columns * self.weight.sqrt()).flatten(1)
        across = flat @ flat.T + torch.diag((self.wide * self.scales)[self.free] ** -2)
        prior = self._prior(state.values) / (self.wide * self.scales)
        own_slope = torch.einsum("snk,sn->sk", weighted, left)
        equations = _Equations(across, between, within, (-slope / 2 - prior)[self.free], own_slope)
        return equations, _Seen(state.values, bank, changes)

    def _descend(self, state: _State, *, until: float = 1e-4) -> _State:
        """Down to where a step gains less of chi^2 than this."""
        state = replace(state, cost=self._cost(state.values, state.places))
        freedom, damping = int(self.problem.targets.used.sum()), 1e-3
        seen, age = None, 0
        for _ in range(_STEPS):
            equations, seen = self._normal(state, seen)
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
                    equations, seen = self._normal(state)
                    age = 0
                    continue
                damping *= 8
            else:
                return state
            gained, state = state.cost - cost, _State(values, places, cost)
            damping = max(damping / 10, 1e-9)
            if gained < until * max(1.0, cost / freedom):
                return state
            age += 1
            if age == _MENDED:
                seen, age = None, 0
        return state

    def _search(self) -> tuple[_State, list[_State]]:
        """The best of several starts, and others that end about as low."""
        targets, seeded = self.problem.targets, torch.Generator().manual_seed(0)
        first = self._scanned()
        ends: list[_State] = []
        for index in range(_STARTS):
            away = torch.randn(len(self.free), generator=seeded, dtype=torch.float64) * (0.3 if index == 0 else index)
            values = first.index_add(0, self.free, away * self.scales[self.free])
            ends.append(self._descend(_State(values, targets.start, math.inf), until=0.1))
            lowest = min(end.cost for end in ends)
            if sum(end.cost < lowest + self._close(lowest) for end in ends) > 1:
                break
        ends.sort(key=lambda end: end.cost)
        return ends[0], [end for end in ends[1:] if end.cost < ends[0].cost + self._close(ends[0].cost)]

    def _scanned(self) -> Tensor:
        """Values that are better than those given, one after the other, by steps of many sizes."""
        values, places = self.problem.trained.start, self.problem.targets.start
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

    def _close(self, cost: float) -> float:
        """Difference of chi^2 between fits that may be equally good, before the noise is known."""
        freedom = int(self.problem.targets.used.sum())
        return _SAME_FIT * max(1.0, cost / freedom)

    # -- what it means

    def _covariance(self, equations: _Equations) -> tuple[Tensor, Tensor]:
        """Of the values (P, P), and by what each variance is more than if all else were known (P,)."""
        size = self.scales[self.free]
        inside = torch.linalg.inv(equations.schur() * size * size[:, None]) * size * size[:, None]
        whole, inflation = torch.diag((self.wide * self.scales) ** 2), torch.ones_like(self.scales)
        whole[self.free[:, None], self.free] = inside
        inflation[self.free] = inside.diagonal() * equations.across.diagonal()
        return whole, inflation

    def _unseen(self, errors: Tensor, inflation: Tensor) -> dict[str, str]:
        """Names of values that the picture does not tell, and why."""
        found = {}
        for index, name in enumerate(self.problem.trained.names):
            if index not in self.free.tolist():
                found[name] = "no picture changes with it"
            elif bool(inflation[index] > _INFLATED):
                found[name] = "this picture changes with it as with a place, a level or another value that trains"
            elif not bool(errors[index] < _UNSEEN * self.scales[index]):
                found[name] = "to first order this picture does not change with it: another focus may show it"
        return found

    def _twins(self, state: _State) -> Iterator[_State]:
        """Where the wavefront is as another one that has the same PSF, or the same edge."""
        own = self.problem.trained.wavefront(state.values)
        if own is None:
            return

        def turned(path: Tensor) -> Tensor:
            return -path.flip(0, 1)

        ways: list[Callable[[Tensor], Tensor]] = [turned]
        if self.problem.targets.kind == "edge":
            angle = float(state.places[0, 0])
            ways += [lambda path: _mirrored(path, angle), lambda path: -_mirrored(path, angle).flip(0, 1)]
        for way in ways:
            values = self._with_wavefront(state.values, way(own))
            if values is not None and bool((values - state.values).abs().gt(1e-3 * self.scales).any()):
                yield _State(values, state.places, math.inf)

    def _with_wavefront(self, values: Tensor, wanted: Tensor) -> Tensor | None:
        """Values whose wavefront comes closest to one, up to a piston and tilts."""
        side = torch.linspace(-1, 1, wanted.shape[-1], dtype=torch.float64)
        plane = [torch.ones_like(wanted), side[None, :].expand_as(wanted), side[:, None].expand_as(wanted)]
        for _ in range(3):
            try:
                now, *moved = self._wavefronts(values)
            except ValueError:  # no such lens
                return None
            columns = torch.stack([*(path - now for path in moved), *(1e-7 * part for part in plane)])
            known = columns.isfinite().all(0) & wanted.isfinite()
            solved = scipy.linalg.lstsq(columns[:, known].T.numpy(), (wanted - now)[known].numpy(), cond=1e-6)[0]
            step = torch.from_numpy(solved)[: len(self.free)] * self.scales[self.free]
            values = values.index_add(0, self.free, step)
        return values

    def _wavefronts(self, values: Tensor) -> list[Tensor]:
        """At these values, and with each that acts a scale beyond."""
        steps = [self.scales[index] * unit(index, len(values)) for index in self.free.tolist()]
        found = [self.problem.trained.wavefront(values + step) for step in (torch.zeros_like(values), *steps)]
        return [path for path in found if path is not None]

    def _rival(self, best: _State, rivals: list[_State], errors: dict[str, Tensor]) -> tuple[_State, tuple[str, ...]]:
        """Of the fits that are as good the one in which most of what is seen is another, and the names of that."""

        def others(state: _State) -> tuple[str, ...]:
            apart = dict(zip(self.problem.trained.names, (state.values - best.values).abs(), strict=True))
            return tuple(name for name, error in errors.items() if bool(apart[name] > _APART * error))

        equal = [state for state in rivals if state.cost < best.cost + self._close(best.cost)]
        rival = max(equal, key=lambda state: len(others(state)), default=best)
        return rival, others(rival)


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


def _mirrored(path: Tensor, angle: float) -> Tensor:
    """A map over the pupil, mirrored in the line through its middle at an angle."""
    side = torch.linspace(-1, 1, path.shape[-1], dtype=torch.float64)
    x, y = side[None, :], side[:, None]
    cos, sin = math.cos(2 * angle), math.sin(2 * angle)
    grid = torch.stack([x * cos + y * sin, x * sin - y * cos], dim=-1)
    found = torch.nn.functional.grid_sample(
        path.nan_to_num()[None, None], grid[None], mode="bicubic", align_corners=True
    )[0, 0]
    inside = (x**2 + y**2 < 0.85) if bool(path.isnan().any()) else torch.ones_like(path, dtype=torch.bool)
    return found.masked_fill(~inside, math.nan)
