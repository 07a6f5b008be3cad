"""A lens from a picture of points or of a slanted edge: what trains in it, found by descent through the camera.

    minimise over lens, places, levels:   chi^2 = sum_i (v_i - m_i)^2 / s_i^2,   s^2 = sigma_d^2 + K m

m is what the lens's own PSF makes of points at unknown sub-pixel places, or of an edge at an unknown angle, with a
brightness and a background each. What a picture cannot tell has no standard error, and a fit from the other side finds
what it can tell but for a sign.
"""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from kcam.calibration.identifiability import covariance_of, rival_of, twins, unobservable
from kcam.calibration.levenberg_marquardt import WIDE, Search
from kcam.calibration.targets import check_saturation, find_targets
from kcam.calibration.trained import Conditions, TrainedLens, put_values
from kcam.inputs import describe
from kcam.units import as_numbers, check_length, check_pixel_pitch, wavelength_grid

_MISFIT = 3.0  # of chi^2 per degree of freedom: a model or a noise that is wrong
_ELSEWHERE = 0.3  # scales: an end of a start that is another one
_CLOSE = 1.0  # scales: the prior of what is not seen, once that is known
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
    check_saturation(found, pictures)
    shape = (pictures.shape[2], pictures.shape[3])
    width = math.sqrt(fill_factor)
    conditions = Conditions(shape, pitch, width, bands, shares, away.tolist(), steps.tolist(), upright)
    trained = TrainedLens.of(lens, found, conditions)
    noise = None if full_well is None else (read_noise**2 / full_well**2, 1 / full_well)
    with torch.enable_grad(), warnings.catch_warnings():
        trained.bank(trained.start)  # may warn of the lens that was given; not of what the search tries
        warnings.filterwarnings("ignore", message=r"f/\S+ is outside", category=UserWarning)
        fit = _result(Search(found, trained, noise), lens)
    if fit.chi_squared > _MISFIT:
        warnings.warn(
            f"chi^2 per degree of freedom is {fit.chi_squared:.3g}, expected 1: no such lens makes this picture with "
            f"this noise. Standard errors are {math.sqrt(fit.chi_squared):.2g} times as wide as the noise has them; "
            "values may be off by more. Check pixel_pitch, the f-number, wavelengths, full_well, read_noise, and that "
            "no pixel is saturated.",
            stacklevel=2,
        )
    return fit


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


def _result(search: Search, lens: nn.Module) -> PSFFit:
    """What is found, how well, and what is open."""
    names, targets = search.trained.names, search.targets
    best, others = search.from_all_starts()
    for _ in range(2 if search.noise else 3):
        search.weight = search.weight_at(best)
        best = search.descend(best)
    elsewhere = [end for end in others if float(((end.values - best.values) / search.scales).norm()) > _ELSEWHERE]
    rivals = [search.descend(start) for start in (*twins(search, best), *elsewhere)]
    better = min(rivals, key=lambda state: state.cost, default=best)
    if better.cost < best.cost - 1e-3:
        rivals.append(best)
        best = better
    equations, _ = search.normal(best)
    covariance, inflation = covariance_of(search, equations)
    unseen = unobservable(search, covariance.diagonal().sqrt(), inflation)
    freedom = max(1, int(targets.used.sum()) - (len(names) - len(unseen)) - 4 * len(targets.values))
    excess = best.cost / freedom
    covariance = covariance * (excess if excess > 1 + 3 * math.sqrt(2 / freedom) else 1.0)
    errors = covariance.diagonal().sqrt()
    seen = {n: e for n, e in zip(names, errors, strict=True) if n not in unseen}
    rival, ambiguous = rival_of(search, best, rivals, seen)
    if unseen:  # of all fits that are as good, the one nearest to the lens that was given
        search.wide = torch.tensor([_CLOSE if name in unseen else WIDE for name in names], dtype=torch.float64)
        best = search.descend(best)
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
