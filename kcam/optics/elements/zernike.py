"""Zernike polynomials over the pupil, and aberrations made of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcam.optics.elements.element import Element, Term, check_vector, set_tensor
from kcam.optics.numerics import float64
from kcam.optics.pupil.coordinates import Pupil
from kcam.optics.pupil.quadrants import of_parities


class ZernikeAberration(Element):
    """Aberrations of the lens as Zernike coefficients of OPD, the same at all wavelengths.

    Args:   coefficients: (K,) of Noll's j = 1..K [m RMS]; a Parameter trains.
    Raises: ValueError for coefficients that are no vector or not finite.
    Source: Noll, J. Opt. Soc. Am. 66, 207 (1976).

    Example:
    >>> spherical = optics.ZernikeAberration(torch.tensor([0.0] * 10 + [550 * nm / 14]))  # Z11, lambda / 14
    >>> lenses = (optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), *more, focus_distance=2.0)
    ...           for more in ([], [spherical]))
    >>> ideal, real = (lens.psf([550 * nm], distances=2.0, pixel_pitch=1 * um, shape=(9, 9)).max() for lens in lenses)
    >>> round(float(real / ideal), 2)  # Marechal: a Strehl ratio of exp(-(2 pi / 14)^2) = 0.82
    0.82
    """

    coefficients: Tensor

    def __init__(self, coefficients: Tensor) -> None:
        super().__init__()
        check_vector(coefficients, name="coefficients")
        set_tensor(self, "coefficients", coefficients)

    def terms(self, pupil: Pupil, wavelengths: Tensor) -> list[Term]:
        return [(torch.ones_like(wavelengths), zernike_sum(self.coefficients, pupil))]


def noll_indices(j: int) -> tuple[int, int]:
    """(n, m) of Noll's single index j >= 1; m < 0 for the sine terms."""
    n = 0
    while (n + 1) * (n + 2) // 2 < j:
        n += 1
    rest = j - n * (n + 1) // 2 - 1
    m = (-1) ** j * ((n % 2) + 2 * ((rest + (n + 1) % 2) // 2))
    return n, m


def zernike_sum(coefficients: Tensor, pupil: Pupil) -> Tensor:
    """sum_j c_j Z_j over the pupil, Noll-normalised (unit variance on the unit circle), float64.

    Z = sqrt(n + 1) [sqrt 2] rho^|m| R'(rho^2) cos or sin(m theta), with rho^|m| exp(i m theta) = (x + iy)^|m|: a
    polynomial, so value and gradient are finite on the axis. Cosines are even in y, and in x where m is; sines are odd
    in y, and in x where m is even: of a mirrored pupil one quadrant does.
    """
    part = pupil.quadrant or pupil
    rho2, (x, y) = part.rho2, torch.broadcast_tensors(part.x, part.y)
    powers = torch.ones_like(rho2), torch.zeros_like(rho2)
    total = {(False, False): torch.zeros_like(rho2)}  # by whether it is odd in x, and in y
    every = float64(coefficients).to(rho2.device).unbind()
    indices = [noll_indices(index + 1) for index in range(len(every))]
    for order in range(1 + max((abs(m) for _, m in indices), default=-1)):
        if order:
            re, im = powers
            powers = re * x - im * y, re * y + im * x
        for sign, power in zip((1, -1) if order else (1,), powers, strict=False):
            own = [(n, c) for (n, m), c in zip(indices, every, strict=True) if m == sign * order]
            if own:  # all polynomials of one angle are one polynomial
                radial, *others = _radial(own, order)
                for coefficient in others:
                    radial = torch.addcmul(coefficient, radial, rho2)
                odd = (order % 2 == (sign > 0), sign < 0) if part is pupil.quadrant else (False, False)
                before = total.get(odd)
                total[odd] = radial * power if before is None else torch.addcmul(before, radial, power)
    even, rest = total[False, False], [total.get(odd) for odd in ((True, False), (False, True), (True, True))]
    return even if all(part is None for part in rest) else of_parities(even, *rest)


def _radial(own: Sequence[tuple[int, Tensor]], order: int) -> list[Tensor]:
    """Coefficients of sum c sqrt(n + 1) [sqrt 2] R_n^m / rho^m, a polynomial in rho^2, the highest power first."""
    half = (max(n for n, _ in own) - order) // 2
    found = [torch.zeros_like(own[0][1]) for _ in range(half + 1)]
    for n, coefficient in own:
        steps, term = (n - order) // 2, _zernike_scale(n, order)
        for s in range(steps + 1):  # by their ratio
            found[half - steps + s] = found[half - steps + s] + coefficient * term
            term *= -((n - s - steps) * (steps - s)) / ((s + 1) * (n - s)) if n > s else 0.0
    return found


def _zernike_scale(n: int, m: int) -> float:
    """Leading coefficient of R_n^m times Noll's normalisation."""
    order = abs(m)
    leading = 1.0
    half_sum, half_difference = (n + order) // 2, (n - order) // 2
    for i in range(1, half_difference + 1):  # binomial(n, half_difference) = n! / (half_sum! half_difference!)
        leading *= (half_sum + i) / i
    return leading * (n + 1) ** 0.5 * (2**0.5 if m else 1.0)
